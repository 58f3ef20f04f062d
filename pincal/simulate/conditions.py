"""The conditions under which poses are taken."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypedDict, Unpack

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.arm import Arm
from pincal.simulate.state import Poses


class Conditions(TypedDict, total=False):
    """Conditions of N poses; a number stands for all of them, and what is None or missing is not declared.

    Attributes:
        payload: Declared mass at the tip [kg], shape (N,); 0 by default.
        payload_com: Its centre of mass in the tip frame [m], shape (3,) or (N, 3); the tip by default.
        temperature: Temperature [deg C], shape (N,); the machine's reference temperature by default.
        time: Time [s], shape (N,); 0 by default.
        approach: Direction from which each joint arrived (-1, 0, 1), shape (N, n), or by joint name, shape (N,).
    """

    payload: Any
    payload_com: Any
    temperature: Any
    time: Any
    approach: Mapping[str, Any] | np.ndarray | None


def poses_of(
    arm: Arm,
    q: np.ndarray,
    *,
    reference_temperature: float = 20.0,
    scatter: np.ndarray | None = None,
    **conditions: Unpack[Conditions],
) -> Poses:
    """Put together poses and the conditions under which they are taken.

    Args:
        arm: The arm whose joints they are.
        q: Recorded joint positions [rad or m], shape (N, n).
        reference_temperature: Temperature at which nothing has grown [deg C].
        scatter: Standard normal draws for unrepeatable effects, shape (N, n); 0 if None.
        **conditions: Conditions of the poses.

    Returns:
        The poses.

    Raises:
        BadInputError: If a shape does not fit or a joint is unknown.
    """
    if unknown := sorted(conditions.keys() - Conditions.__annotations__.keys()):
        raise BadInputError(f"{', '.join(unknown)}: unknown; expected {', '.join(Conditions.__annotations__)}")
    n = len(arm.names)
    q = np.array(q, float)
    if q.ndim != 2 or q.shape[1] != n:
        raise BadInputError(f"q has shape {q.shape}; expected (N, {n}), one column per joint: {', '.join(arm.names)}")
    rows = len(q)
    approach, temperature = conditions.get("approach"), conditions.get("temperature")
    if isinstance(approach, Mapping):
        columns = {arm.index(joint): value for joint, value in approach.items()}
        approach = np.column_stack([np.broadcast_to(columns.get(j, 0.0), rows) for j in range(n)])
    warm = 0.0 if temperature is None else np.asarray(temperature, float) - reference_temperature
    payload, time = conditions.get("payload"), conditions.get("time")
    return Poses(
        q=q,
        payload=broadcast_copy("payload", 0.0 if payload is None else payload, (rows,)),
        payload_com=broadcast_copy("payload_com", conditions.get("payload_com", (0.0, 0.0, 0.0)), (rows, 3)),
        temperature=broadcast_copy("temperature", warm, (rows,)),
        time=broadcast_copy("time", 0.0 if time is None else time, (rows,)),
        approach=None if approach is None else broadcast_copy("approach", approach, (rows, n)),
        scatter=broadcast_copy("scatter", 0.0 if scatter is None else scatter, (rows, n)),
    )


def broadcast_copy(name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return a copy of a number or an array that broadcasts to a shape.

    Raises:
        BadInputError: If it does not broadcast; the message calls it ``name``.
    """
    try:
        return np.array(np.broadcast_to(np.asarray(value, float), shape))
    except ValueError:
        raise BadInputError(f"{name} has shape {np.shape(value)}; expected {shape}") from None
