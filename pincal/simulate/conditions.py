"""Checks and fills in the conditions under which poses are taken."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.arm import Arm
from pincal.simulate.state import Poses


def poses_of(
    arm: Arm,
    q: np.ndarray,
    *,
    reference_temperature: float = 20.0,
    payload: Any = None,
    payload_com: Any = (0.0, 0.0, 0.0),
    temperature: Any = None,
    time: Any = None,
    approach: Mapping[str, Any] | np.ndarray | None = None,
    scatter: np.ndarray | None = None,
) -> Poses:
    """Put together poses and the conditions under which they are taken.

    Args:
        arm: The arm whose joints they are.
        q: Recorded joint positions [rad or m], shape (N, n).
        reference_temperature: Temperature at which nothing has grown [deg C].
        payload: Declared mass at the tip [kg], shape (N,) or one number; 0 if None.
        payload_com: Its centre of mass in the tip frame [m], shape (3,) or (N, 3).
        temperature: Temperature [deg C], shape (N,) or one number; the reference temperature if None.
        time: Time [s], shape (N,) or one number; 0 if None.
        approach: -1, 0 or 1 for each pose and joint, shape (N, n), or a mapping from
            joint name to shape (N,).
        scatter: Standard normal draws for unrepeatable effects, shape (N, n); 0 if None.

    Returns:
        The poses.

    Raises:
        BadInputError: If a shape does not fit or a joint is unknown.
    """
    n = len(arm.names)
    q = np.array(q, float)
    if q.ndim != 2 or q.shape[1] != n:
        raise BadInputError(f"q has shape {q.shape}; expected (N, {n}), one column a joint: {', '.join(arm.names)}")
    rows = len(q)
    if isinstance(approach, Mapping):
        columns = {arm.index(joint): value for joint, value in approach.items()}
        approach = np.column_stack([np.broadcast_to(columns.get(j, 0.0), rows) for j in range(n)])
    warm = 0.0 if temperature is None else np.asarray(temperature, float) - reference_temperature
    return Poses(
        q=q,
        payload=fitted("payload", 0.0 if payload is None else payload, (rows,)),
        payload_com=fitted("payload_com", payload_com, (rows, 3)),
        temperature=fitted("temperature", warm, (rows,)),
        time=fitted("time", 0.0 if time is None else time, (rows,)),
        approach=None if approach is None else fitted("approach", approach, (rows, n)),
        scatter=fitted("scatter", 0.0 if scatter is None else scatter, (rows, n)),
    )


def fitted(name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return a copy of a value that broadcasts to a shape.

    Args:
        name: What the value is, for the message.
        value: A number or an array.
        shape: Wanted shape.

    Returns:
        New array of that shape.

    Raises:
        BadInputError: If the value does not broadcast.
    """
    try:
        return np.array(np.broadcast_to(np.asarray(value, float), shape))
    except ValueError:
        raise BadInputError(f"{name} has shape {np.shape(value)}; expected {shape}") from None
