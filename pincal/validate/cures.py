"""Hypotheses about a table, or the description of its robot, by topic: columns exchanged, signs and
couplings, readings mixed up, other positions of the joints, rows late, lengths scaled, another
robot.

Each is a :class:`Mistake`, which says how to undo it. A new one is an entry of a topic, a new topic
a function in :data:`TOPICS`; :mod:`pincal.validate.trials` tries them all.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import combinations, permutations
from pathlib import Path

import numpy as np

from pincal.errors import BadInputError, PincalWarning, counted
from pincal.hypotheses.hypothesis import Hypothesis, exchange_order
from pincal.measure.measurements import Measurements
from pincal.robot.mastering import free_joints, remastered, resized
from pincal.robot.robot import Robot
from pincal.robot.tree import Coupling
from pincal.robot.urdf_file import find_file
from pincal.sensors.fields import Field
from pincal.thresholds import Count, Scale

# Frames that are closer than this [m, rad] belong to the same robot.
_SAME: Scale = 1e-5
HEADER = "correct the header of the table and run again"
NONE = "or leave the orientations out: --orientation none"
W_FIRST = (
    "say what its columns hold: --columns 'qx=qw,qy=qx,qz=qy,qw=qz', or --orientation wxyz if it "
    "is a list"
)
INVERT = f"invert them, {NONE}"
_TABLE = "correct the table and run again"
_FRAME = "give positions and orientations in a right-handed frame and run again"
_RECORD = "map the other columns to the joints (--columns) and run again"
_OPTION = "if so, declare it (--sign, --coupling or --zeros), and run again"
_UNITS = "check the units of the table and the scale of the instrument, and run again"
# Rows by which a column may be late: it was recorded before or after the motion.
_DELAYS = tuple(sign * rows for rows in (1, 2, 3, 4, 5) for sign in (1, -1))
# Parts of a neighbour's position that joints report; those of wrists, and the number of wrist
# joints; and their fractions.
_ADDED: tuple[Scale, ...] = (1.0, -1.0)
_WRIST: Count = 3
_OF_WRISTS = tuple(sign * part for part in (1 / 2, 1 / 3, 2 / 3, 1 / 4) for sign in (1, -1))
_FRACTIONS = {1.0: "", 1 / 2: "1/2 of ", 1 / 3: "1/3 of ", 2 / 3: "2/3 of ", 1 / 4: "1/4 of "}


@dataclass(frozen=True)
class Case:
    """A table, and the robot that it is supposed to be of."""

    robot: Robot
    table: Measurements

    def with_q(self, q: np.ndarray) -> Case:
        """Return the case with other joint positions, shape (N, n)."""
        return replace(self, table=replace(self.table, q=q))


@dataclass(frozen=True)
class Correction:
    """Correction of a robot's description to agree with its controller.

    Attributes:
        shifts: positions of joints by the URDF when they report zero [rad], by name.
        turned: names of the joints that count the other way.
        couplings: joints that report a combination of positions.
        lengths: what lengths between joints have more than the URDF's [m], by the names of their
            parameters.
    """

    shifts: Mapping[str, float] = field(default_factory=dict)
    turned: tuple[str, ...] = ()
    couplings: tuple[Coupling, ...] = ()
    lengths: Mapping[str, float] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """The number of things in which it differs from the description."""
        return sum(map(len, (self.shifts, self.turned, self.couplings, self.lengths)))

    def of(self, robot: Robot) -> Robot:
        """Return the robot with its description corrected."""
        robot = resized(robot, self.lengths)
        if self.shifts or self.turned:
            robot = remastered(robot, shifts=self.shifts, turned=self.turned)
        return robot.with_couplings(*self.couplings) if self.couplings else robot

    def then(self, other: Correction) -> Correction | None:
        """Return this correction and, of the robot so corrected, another one as a single one; None
        if the other one is of couplings, whose reports are of the positions in between.
        """
        if other.couplings:
            return None
        shifts = dict(self.shifts)
        for name, shift in other.shifts.items():
            shifts[name] = shifts.get(name, 0.0) + (-shift if name in self.turned else shift)
        turned = sorted({*self.turned} ^ {*other.turned})
        lengths = dict(self.lengths)
        for name, more in other.lengths.items():
            lengths[name] = lengths.get(name, 0.0) + more
        return replace(self, shifts=shifts, turned=tuple(turned), lengths=lengths)

    def of_urdf(self, robot: Robot, reported: np.ndarray) -> np.ndarray:
        """Return the positions that joints have by the uncorrected description, for reported ones,
        shape (N, n) each.
        """
        shifts = [self.shifts.get(name, 0.0) for name in robot.joint_names]
        signs = np.where(np.isin(robot.joint_names, self.turned), -1.0, 1.0)
        found = robot.with_couplings(*self.couplings) if self.couplings else robot
        return np.asarray(found.from_reported(reported) * signs + shifts)

    def undone(self, case: Case) -> Case:
        """Return a table with the positions that the robot would have reported by its uncorrected
        description, except for lengths, which the robot of the case then has.
        """
        robot = case.robot
        q = self.of_urdf(robot, case.table.q)
        return replace(case.with_q(robot.as_reported(q)), robot=resized(robot, self.lengths))

    def mistake(self, words: str) -> Mistake:
        """Return the hypothesis that the description needs this correction."""
        return Mistake(words, self.undone, _OPTION, self)

    @property
    def lacks(self) -> tuple[str, ...]:
        """The reports of coupled joints in words, one each."""
        ways = (
            f"{'minus' if one.factor > 0.0 else 'plus'} {_FRACTIONS.get(abs(one.factor), '')}"
            for one in self.couplings
        )
        return tuple(
            f"its position {way}that of {one.source!r}"
            for way, one in zip(ways, self.couplings, strict=True)
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """The notes on it, in words."""
        notes = [shift_words(name, shift) for name, shift in self.shifts.items()]
        notes += [
            f"{name} counts in the opposite sense to the URDF: the model reverses its axis, and "
            "accepts and returns positions as they are reported"
            for name in self.turned
        ]
        for one, lacks in zip(self.couplings, self.lacks, strict=True):
            way = lacks.replace("'", "")
            added = (
                f"{'+' if one.factor > 0.0 else '-'} "
                f"{_FRACTIONS.get(abs(one.factor), '')}{one.source} reported"
            )
            notes.append(
                f"{one.joint} reports {way}, as coupled drives do: the model has "
                f"{one.joint} = {one.joint} reported {added}"
            )
        notes += [length_words(name, more) for name, more in self.lengths.items()]
        return tuple(notes)

    @property
    def words(self) -> str:
        """What differs from the description, in a sentence."""
        parts = [f"{name!r} counts in the opposite sense" for name in self.turned]
        pairs = zip(self.couplings, self.lacks, strict=True)
        parts += [f"{one.joint!r} reports {lacks}" for one, lacks in pairs]
        parts += [
            f"{name!r} is shifted by {np.rad2deg(shift):+.1f} deg"
            for name, shift in self.shifts.items()
        ]
        parts += [length_words(name, more) for name, more in self.lengths.items()]
        return " and ".join(parts)


def length_words(parameter: str, more: float) -> str:
    """Return the note on a length, by the name of its parameter, that differs from the URDF [m]."""
    joint, symbol = parameter.split(".")
    of = "along its axis" if symbol == "d" else "to the next axis"
    way = "longer" if more > 0.0 else "shorter"
    return (
        f"the length {symbol} of {joint} ({of}) is {abs(more) * 1e3:.1f} mm {way} than in the URDF"
    )


def shift_words(joint: str, shift: float) -> str:
    """Return the note on a joint whose true position differs from the reported one [rad]."""
    return f"{joint} is shifted by {np.rad2deg(shift):+.1f} deg: has it been mastered?"


@dataclass(frozen=True)
class Mistake(Hypothesis[Case]):
    """A possible mistake in a table, or in the description of its robot.

    Attributes:
        correction: of the robot's description, if that is the mistake; nobody has to do anything
            then.
    """

    advice: str = HEADER
    correction: Correction | None = None


def exchanges(robot: Robot, table: Measurements) -> Iterator[Mistake]:
    """Yield joint columns swapped."""
    names = robot.joint_names
    for i, j in combinations(range(robot.n_joints), 2):
        words = f"the columns {names[i]!r} and {names[j]!r} appear to be swapped"
        yield _in_order(words, exchange_order(robot.n_joints, i, j))


def _in_order(words: str, order: np.ndarray) -> Mistake:
    return Mistake(words, lambda case: case.with_q(case.table.q[:, order]))


def descriptions(robot: Robot, table: Measurements) -> Iterator[Mistake]:
    """Yield joints that count the other way, or report a combination of positions, as manufacturers
    define them.

    The position of a joint is the sum or difference of its own report and its neighbour's, or in
    wrists a part of it.
    """
    for name in free_joints(robot):
        correction = Correction(turned=(name,))
        yield correction.mistake(f"the column {name!r} appears to have the wrong sign")
    for coupling in couplings_of(robot):
        correction = Correction(couplings=(coupling,))
        yield correction.mistake(
            f"the column {coupling.joint!r} appears to hold {correction.lacks[0]}"
        )


def couplings_of(robot: Robot) -> Iterator[Coupling]:
    """Yield the reports of coupled drives that a robot may have."""
    for i, j in _neighbours(robot):
        for factor in (*_ADDED, *(_OF_WRISTS if min(i, j) >= robot.n_joints - _WRIST else ())):
            yield Coupling(robot.joint_names[i], robot.joint_names[j], factor)


def _neighbours(robot: Robot) -> Iterator[tuple[int, int]]:
    """Yield the revolute joints that may be coupled to a neighbour, and the neighbour.

    Two joints are coupled once: mutual couplings would not determine positions.
    """
    free = free_joints(robot)
    coupled = [
        {robot.joint_names.index(name) for name in (one.joint, one.source)}
        for one in robot.couplings
    ]
    turns = [
        kind != "prismatic" and name in free
        for name, kind in zip(robot.joint_names, robot.joint_types, strict=True)
    ]
    for i, j in permutations(robot.own_joints, 2):
        if abs(i - j) == 1 and {i, j} not in coupled and turns[i] and turns[j]:
            yield i, j


def misreadings(robot: Robot, table: Measurements) -> Iterator[Mistake]:
    """Yield the mix-ups of columns that the fields of the sensor describe."""
    fields = () if table.sensor is None else table.sensor.fields
    for of in fields:
        for words, undo in of.mistakes:
            yield Mistake(words, _of_readings({of.name: undo}), _advice_on(of, words))
    mirrors = {of.name: of.mirror for of in fields if of.mirror is not None}
    # For a single field that is one of its own mistakes.
    if len(mirrors) > 1:
        words = "the frame of the readings appears to be left-handed"
        yield Mistake(words, _of_readings(mirrors), _FRAME)


def _advice_on(field: Field, words: str) -> str:
    """Return what cures a mix-up of the columns of a field."""
    if not field.is_unit:
        return HEADER
    return f"{W_FIRST}, {NONE}" if "w first" in words and "inverted" not in words else INVERT


def _of_readings(
    undo: Mapping[str, Callable[[np.ndarray], np.ndarray]],
) -> Callable[[Case], Case]:
    """Return the function that undoes a mistake in some fields of the readings, by name."""

    def undone(case: Case) -> Case:
        readings = case.table.readings
        changed = {name: of_field(readings[name]) for name, of_field in undo.items()}
        return replace(case, table=case.table.with_readings(**changed))

    return undone


def from_hand(robot: Robot, table: Measurements) -> Iterator[Mistake]:
    """Yield that a camera on the hand saw an object beside the robot, not an instrument there the
    hand.
    """
    sensor = table.sensor
    if sensor is None or not sensor.reads_pose or table.from_link is not None:
        return
    if table.to_link is not None or table.is_of_motion:
        return
    words = f"the rows appear to be of an object beside the robot, seen from {robot.tip!r}"
    advice = f"if a camera is on the hand, state it (--from {robot.tip} --to {robot.base})"

    def undone(case: Case) -> Case:
        links = (np.full(len(case.table), link) for link in (robot.tip, robot.base))
        from_link, to_link = links
        return replace(case, table=replace(case.table, from_link=from_link, to_link=to_link))

    yield Mistake(words, undone, f"{advice} and run again")


def records(robot: Robot, table: Measurements) -> Iterator[Mistake]:
    """Yield the other positions of the joints, where a table has both commanded and
    read-back ones.
    """
    if table.droop is not None:
        yield _recorded("commanded", "read back", 1.0)
        yield _recorded("read-back", "commanded", -1.0)


def _recorded(name: str, other: str, sign: float) -> Mistake:
    def undone(case: Case) -> Case:
        assert case.table.droop is not None
        q = case.table.q + sign * case.table.droop
        return replace(case, table=replace(case.table, q=q, droop=None))

    words = (
        f"the joints stood at their {name} positions, not at those in the joint "
        f"columns, which are {other}"
    )
    return Mistake(words, undone, _RECORD)


def delays(robot: Robot, table: Measurements) -> Iterator[Mistake]:
    """Yield a joint column, or all of them, recorded some rows too late or too early."""
    each = np.eye(robot.n_joints, dtype=bool)
    columns = {
        f"the column {name!r} appears to be": column
        for name, column in zip(robot.joint_names, each, strict=True)
    }
    columns["all joint columns appear to be"] = np.ones(robot.n_joints, bool)
    for rows in _DELAYS:
        if len(table) - abs(rows) < 2:
            continue
        word = f"{counted(abs(rows), 'row')} {'late' if rows > 0 else 'early'}"
        for name, column in columns.items():
            yield _delayed(f"{name} {word}", rows, column)


def _delayed(words: str, rows: int, column: np.ndarray) -> Mistake:
    """Return the hypothesis that some columns, shape (n,), are so many rows late."""

    def undone(case: Case) -> Case:
        table = case.table
        kept = np.arange(max(-rows, 0), len(table) - max(rows, 0))
        found = table.select(kept)
        q = np.where(column, table.q[kept + rows], found.q)
        return replace(case, table=replace(found, q=q))

    return Mistake(words, undone, _TABLE)


def others(robot: Robot, table: Measurements) -> Iterator[Mistake]:
    """Yield other robots with joints of these names."""
    for name, other in _robots_alike(robot):
        yield _of_robot(f"the table appears to be of a {name}", other)


def _of_robot(words: str, other: Robot) -> Mistake:
    advice = "give the URDF of that robot and run again"
    return Mistake(words, lambda case: Case(other, case.table), advice)


Topic = Callable[[Robot, Measurements], Iterable[Mistake]]
"""A kind of mistakes that a table of a robot may have."""

TOPICS: tuple[Topic, ...] = (
    exchanges,
    descriptions,
    misreadings,
    from_hand,
    records,
    delays,
    others,
)
"""All of them but a scale, which has to be estimated; of mistakes that are undone equally well, the
first counts.
"""


def mistakes(robot: Robot, table: Measurements, topics: Sequence[Topic]) -> Iterator[Mistake]:
    """Yield all possible mistakes of some topics, in their order."""
    for topic in topics:
        yield from topic(robot, table)


def lengths_of(table: Measurements) -> tuple[str, ...]:
    """Return the names of the measured lengths."""
    fields = () if table.sensor is None else table.sensor.fields
    return tuple(of.name for of in fields if of.quantity == "length" and of.name in table.readings)


def scaled(lengths: Iterable[str], factor: float) -> Mistake:
    """Return the hypothesis that measured lengths, by name, have to be multiplied by a factor."""
    undone = _of_readings({name: lambda values: values * factor for name in lengths})
    words = f"the measured lengths appear scaled by {1.0 / factor:.3g}"
    return Mistake(words, undone, _UNITS)


def _robots_alike(robot: Robot) -> Iterator[tuple[str, Robot]]:
    """Yield the robots of example-robot-data with the same joint names but another geometry, by
    name, each size once.
    """
    try:
        from example_robot_data import robots_loader
    except ImportError:
        return
    marks = [f'"{name}"'.encode() for name in robot.joint_names]
    middle = np.clip(0.3, robot.lower, robot.upper)[None]
    seen = [robot.forward_kinematics(middle)]
    for name, path in _robot_files(robots_loader.ROBOTS):
        try:
            text = path.read_bytes()
            if not all(mark in text for mark in marks):
                continue
            with warnings.catch_warnings(action="ignore", category=PincalWarning):
                other = Robot.from_urdf(path, joints=robot.joint_names)
        except (BadInputError, OSError):
            continue
        found = (
            other.forward_kinematics(middle) if other.joint_names == robot.joint_names else seen[0]
        )
        if not any(np.allclose(found, one, atol=_SAME) for one in seen):
            seen.append(found)
            yield name, other


def _robot_files(names: Iterable[str]) -> list[tuple[str, Path]]:
    """Return the files of robots, first those that bear the robot's own name: some loaders share
    one.
    """
    found = []
    with warnings.catch_warnings(action="ignore", category=PincalWarning):
        for name in names:
            with suppress(BadInputError):
                found.append((name, find_file(name)))
    return sorted(found, key=lambda one: (not one[1].name.startswith(one[0]), len(one[0]), one[0]))
