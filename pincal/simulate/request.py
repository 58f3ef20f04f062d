"""What a user may ask of a simulation, and the machine and conditions that are drawn for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.measure.measurements import Measurements
from pincal.simulate.campaign import draw_conditions, spread_payloads
from pincal.simulate.machine import TrueMachine
from pincal.simulate.state import Conditions
from pincal.simulate.typical import draw_typical_elasticity, draw_typical_errors, typical_effect
from pincal.simulate.weights import draw_weights

# Columns that a campaign may record of its conditions.
_RECORDED = ("temperature", "time", "approach")


class Stream(IntEnum):
    """Parts of a simulation, each with random numbers of its own: a change to one leaves the others as they were."""

    ERRORS, ELASTICITY, MASSES, EFFECTS, LAYOUT, POSES, CONDITIONS, NOISE, WEIGHTS = range(9)

    def generator(self, seed: int) -> np.random.Generator:
        """Return the source of randomness of this part for the seed of the whole simulation, which is 0 or more."""
        if seed < 0:
            raise BadInputError(f"seed {seed}; expected 0 or more")
        return np.random.default_rng([seed, int(self)])


def draw_machine(
    nominal: TrueMachine,
    *,
    seed: int = 0,
    errors: float = 1.0,
    elastic: float = 1.0,
    masses_off: float = 0.0,
    effects: Sequence[tuple[str, Mapping[str, Any]]] = (),
    unweighed: Sequence[str] = (),
) -> TrueMachine:
    """Draw a machine with errors, elasticity and hidden effects.

    Args:
        nominal: The machine without errors.
        seed: Seed of the machine.
        errors: Size of the geometric errors relative to typical ones, 0 for none.
        elastic: Compliance of drives and bearings relative to a typical one.
        masses_off: Standard deviation of masses and centres of mass [%].
        effects: Hidden effects: name and given fields of each.
        unweighed: Names of the joints whose links have no mass that is known: plausible ones are drawn.

    Raises:
        BadInputError: If an effect is unknown.
    """
    nominal = draw_weights(nominal, unweighed, Stream.WEIGHTS.generator(seed))
    machine = draw_typical_errors(nominal, Stream.ERRORS.generator(seed), scale=errors)
    machine = machine.draw_masses(Stream.MASSES.generator(seed), sigma=masses_off / 100.0)
    if elastic:
        machine = draw_typical_elasticity(machine, Stream.ELASTICITY.generator(seed), scale=elastic)
    rng = Stream.EFFECTS.generator(seed)
    return machine.with_effects(*(typical_effect(machine, name, rng, **values) for name, values in effects))


def repeat_poses(
    machine: TrueMachine,
    q: np.ndarray,
    *,
    given: Mapping[str, np.ndarray],
    seed: int = 0,
    cycles: int = 1,
    recorded: Sequence[str] = (),
    payload: Sequence[float] | None = None,
    payload_order: str = "blocks",
    payload_com: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> tuple[np.ndarray, Conditions]:
    """Return the poses of all cycles, shape (cycles N, n), and the conditions under which they are measured.

    Args:
        machine: The machine, whose effects decide which conditions matter.
        q: Joint positions of one cycle [rad or m], shape (N, n).
        given: Conditions of these poses that are not to be drawn, shape (N, ...).
        seed: Seed of poses, conditions and noise.
        cycles: Number of times that every pose is measured, one round after the other.
        recorded: Of temperature, time and approach, columns to record whether an effect needs them or not.
        payload: Payloads [kg]; None for no payload column.
        payload_order: As in :func:`pincal.simulate.campaign.spread_payloads`.
        payload_com: Centre of mass of the payload in the tip frame [m].
    """
    needed = {effect.column for effect in machine.effects} | set(recorded)
    names, poses = [name for name in _RECORDED if name in needed], len(q)
    rng = Stream.CONDITIONS.generator(seed)
    drawn = draw_conditions(names, cycles * poses, joints=len(machine.names), rng=rng)
    fixed = dict(given)
    if payload is not None:
        fixed["payload"] = spread_payloads(payload, poses, order=payload_order)
    if "approach" in drawn:
        # Every cycle comes to a pose from the same side, as ISO 9283 has it.
        fixed = {"approach": drawn["approach"][:poses]} | fixed
    repeated = {name: np.tile(value, (cycles, *[1] * (value.ndim - 1))) for name, value in fixed.items()}
    conditions: Any = drawn | repeated | {"payload_com": payload_com}
    return np.tile(q, (cycles, 1)), conditions


def poses_of_table(rows: Measurements) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the poses of a table [rad or m], shape (N, n), to measure them again, and the conditions that it records.

    Several targets or points may be seen in one pose; each pose is returned once.
    """
    labels = rows.target if rows.point is None else rows.point
    begins, seen = np.ones(len(rows), bool), set[str]()
    for i, label in enumerate(labels):
        begins[i] = i == 0 or label in seen or not np.array_equal(rows.q[i], rows.q[i - 1])
        seen = {label} if begins[i] else seen | {label}
    rows = rows.select(begins)
    given = {name: value for name in (*_RECORDED, "payload") if (value := getattr(rows, name)) is not None}
    return rows.q, given
