"""What may be wrong with a table that does not fit its robot, each with what undoes it, so that it can be tried."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain, combinations

import numpy as np

from pincal.measure.measurements import Measurements
from pincal.robot.alike import robots_alike
from pincal.robot.robot import Robot

HEADER = "correct the header of the table and run again"
_TABLE = "correct the table and run again"
_FRAME = "give positions and orientations in a right-handed frame and run again"
_RECORD = "name their columns as the joints (--columns) and run again"
# Rows by which a column may stand off: a record that is written before or after the motion.
_DELAYS = tuple(sign * rows for rows in (1, 2, 3, 4, 5) for sign in (1, -1))


@dataclass(frozen=True)
class Cure:
    """One thing that may be wrong.

    Attributes:
        words: what looks wrong.
        robot: whose table it is then.
        table: the table with this undone.
        advice: what to do.
    """

    words: str
    robot: Robot
    table: Measurements
    advice: str = HEADER


def exchanges(robot: Robot, table: Measurements) -> Iterator[Cure]:
    """Yield joint columns swapped, or turned round in sign."""
    names = robot.joint_names
    for i, j in combinations(range(robot.n_joints), 2):
        q = table.q.copy()
        q[:, [i, j]] = q[:, [j, i]]
        yield Cure(f"the columns {names[i]!r} and {names[j]!r} look swapped", robot, replace(table, q=q))
    for i, name in enumerate(names):
        q = table.q.copy()
        q[:, i] *= -1.0
        yield Cure(f"the column {name!r} looks turned round in sign", robot, replace(table, q=q))


def delays(robot: Robot, table: Measurements) -> Iterator[Cure]:
    """Yield a joint column, or all of them, recorded some rows too late or too early."""
    n, everything = len(table), tuple(range(robot.n_joints))
    for rows in _DELAYS:
        kept = np.arange(max(-rows, 0), n - max(rows, 0))
        word = f"{abs(rows)} row{'s' * (abs(rows) > 1)} {'late' if rows > 0 else 'early'}"
        for columns in ((i,) for i in everything) if len(kept) > 1 else ():
            name = f"the column {robot.joint_names[columns[0]]!r} looks"
            yield Cure(f"{name} {word}", robot, _late(table, kept, rows, columns), _TABLE)
        if len(kept) > 1:
            yield Cure(f"all joint columns look {word}", robot, _late(table, kept, rows, everything), _TABLE)


def _late(table: Measurements, kept: np.ndarray, rows: int, columns: tuple[int, ...]) -> Measurements:
    found = table.select(kept)
    q = found.q.copy()
    q[:, columns] = table.q[kept + rows][:, columns]
    return replace(found, q=q)


def records(robot: Robot, table: Measurements) -> Iterator[Cure]:
    """Yield the other positions of the joints, where a table has those commanded and those read back."""
    if table.droop is not None:
        for name, other, sign in (("commanded", "read back", 1.0), ("read back", "commanded", -1.0)):
            words = f"the joints stood where they were {name}, not where the columns of the joints say, as {other}"
            yield Cure(words, robot, replace(table, q=table.q + sign * table.droop, droop=None), _RECORD)


def misreadings(robot: Robot, table: Measurements) -> Iterator[Cure]:
    """Yield what the sensor's fields know of how their columns get mixed up."""
    sensor = table.sensor
    for field in () if sensor is None else sensor.fields:
        for words, undo in field.mistakes:
            changed = table.with_readings(**{field.name: undo(table.readings[field.name])})
            yield Cure(words, robot, changed)
    mirrors = {field.name: field.mirror for field in (() if sensor is None else sensor.fields) if field.mirror is not None}
    # Of one field alone that is one of its own mistakes.
    if len(mirrors) > 1:
        changed = table.with_readings(**{name: mirror(table.readings[name]) for name, mirror in mirrors.items()})
        yield Cure("the frame of the readings looks left-handed", robot, changed, _FRAME)


def scaled(robot: Robot, table: Measurements, factor: float) -> Cure | None:
    """Return the cure that multiplies all measured lengths; None where no length was measured."""
    fields = () if table.sensor is None else table.sensor.fields
    lengths = [field.name for field in fields if field.quantity == "length" and field.name in table.readings]
    if not lengths:
        return None
    changed = table.with_readings(**{name: table.readings[name] * factor for name in lengths})
    advice = "check the units of the table and the scale of the instrument, and run again"
    return Cure(f"the measured lengths look {1.0 / factor:.3g} times what they should be", robot, changed, advice)


def others(robot: Robot, table: Measurements) -> Iterator[Cure]:
    """Yield other robots with joints of these names."""
    for name, other in robots_alike(robot):
        yield Cure(f"the table looks like that of a {name}", other, table, "give the URDF of that robot and run again")


def cures(robot: Robot, table: Measurements) -> Iterator[Cure]:
    """Yield all that may be wrong with a table, but for a scale, which has to be found."""
    return chain(*(kind(robot, table) for kind in (exchanges, misreadings, records, delays, others)))
