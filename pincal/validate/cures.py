"""Possible mistakes in a table, or in the description of its robot, each with its correction; and
large zero errors.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain, combinations, permutations
from pathlib import Path

import numpy as np

from pincal.errors import BadInputError, IdentificationError, PincalWarning, counted
from pincal.identify.beliefs import bounds_of, is_frame, priors_of, released_of
from pincal.identify.fit import Priors
from pincal.identify.initial import place, starts_of
from pincal.identify.noise import Noise
from pincal.identify.options import Options
from pincal.identify.problem import Problem
from pincal.identify.solve import Course, likeliest_values
from pincal.identify.station import Station
from pincal.measure.measurements import Measurements
from pincal.model.effects import JointOffset
from pincal.robot.mastering import free_joints, remastered
from pincal.robot.robot import Robot
from pincal.robot.tree import Coupling
from pincal.robot.urdf_file import find_file

# Rows that suffice for a typical error.
_TYPICAL = 1000
# Step of the search over a turn of one joint [rad], fits converging from some 20 deg; number of
# joints tried, the most promising ones.
_STEP = np.deg2rad(15.0)
_TRIED = 4
# The smallest of the shifts whose residuals agree to this factor is taken: the first joint's is a
# turn of the base.
_ALIKE = 1.2
# Frames that are closer than this [m, rad] belong to the same robot.
_SAME = 1e-5
UNFIT = (BadInputError, IdentificationError, np.linalg.LinAlgError)
"""Errors that end fits to a table which is not of the robot."""


def typical_residuals(station: Station, values: np.ndarray) -> tuple[float, float]:
    """Return the median error of position [m] and of orientation [rad], robust against outliers."""
    if not station.sensor.reads_place:
        return 0.0, 0.0
    station = station.sample(_TYPICAL)
    position = float(np.median(np.linalg.norm(station.displacements(values), axis=1)))
    turned = [
        rows
        for rows, b in zip(station.block_rows, station.sensor.blocks, strict=True)
        if b.unit == "rad"
    ]
    if not turned:
        return position, 0.0
    residuals = station.residuals(values)
    return position, max(
        float(np.median(np.linalg.norm(residuals[part], axis=0))) for part in turned
    )


def zero_shifts(robot: Robot, table: Measurements, options: Options) -> dict[str, float]:
    """Return the zero shifts of joints that minimise the residuals with base and tool fitted [rad],
    by name.

    One joint may be shifted by any angle, the others as far as a fit converges from zero. ``table``
    holds some of the rows.
    """
    options = replace(
        options, effects=(JointOffset(),), zeros=("*",), earlier=None, moment_frame="paper"
    )
    names = free_joints(robot)
    turning = [
        i
        for i, kind in enumerate(robot.joint_types)
        if kind != "prismatic" and robot.joint_names[i] in names
    ]

    def shifted(shift: np.ndarray) -> Measurements:
        return replace(table, q=table.q + robot.as_reported(shift[None])[0])

    def starts() -> Iterator[tuple[float, np.ndarray]]:
        for i in turning:
            angles = np.arange(_STEP, 2.0 * np.pi - 0.5 * _STEP, _STEP)
            shifts = [
                np.eye(robot.n_joints)[i] * (angle - 2.0 * np.pi * (angle > np.pi))
                for angle in angles
            ]
            sizes = (
                least_size(robot, shifted(shift), options, lambda left: left[0]) for shift in shifts
            )
            yield min(zip(sizes, shifts, strict=True), key=lambda one: one[0])

    likely = sorted(starts(), key=lambda one: one[0])[:_TRIED]
    found = []
    for shift in (np.zeros(robot.n_joints), *(shift for _, shift in likely)):
        with suppress(*UNFIT):
            station, values = roughly_placed(robot, shifted(shift), options, offsets=True)
            pairs = zip(station.parameters, values.tolist(), strict=True)
            offsets = {
                p.name.split(".")[0]: value for p, value in pairs if p.effect == JointOffset.name
            }
            rest = typical_residuals(station, values)[0]
            found.append((rest, shift + [offsets.get(name, 0.0) for name in robot.joint_names]))
    if not found:
        return {}
    least = min(rest for rest, _ in found)
    alike = [
        shift - 2.0 * np.pi * np.round(shift / (2.0 * np.pi))
        for rest, shift in found
        if rest < _ALIKE * least
    ]
    best = min(alike, key=lambda shift: float(np.abs(shift).sum()))
    return {robot.joint_names[i]: float(best[i]) for i in turning}


def least_size(
    robot: Robot,
    table: Measurements,
    options: Options,
    size: Callable[[tuple[float, float]], float],
) -> float:
    """Return the size of the residuals of the best first placement, inf if there is none."""
    with suppress(*UNFIT):
        return min(size(typical_residuals(*start)) for start in starts_of(robot, table, options))
    return np.inf


def roughly_placed(
    robot: Robot, table: Measurements, options: Options, *, offsets: bool = False
) -> tuple[Station, np.ndarray]:
    """Return a station and its values, with base and tool fitted, and the offsets of revolute
    joints if asked for.
    """
    ((station, values),) = place(robot, {"": table}, options)
    problem = Problem((station,))
    free = is_frame(problem)
    priors = Priors(np.full(len(values), np.inf), bounds_of(problem, options))
    if offsets:
        free = free | np.array(
            [p.effect == JointOffset.name and p.unit == "rad" for p in problem.parameters]
        )
        priors = priors_of(problem, options)
    free = free & released_of(problem, options)
    noise = Noise((None,) * len(problem.blocks))
    return station, likeliest_values(
        problem, values, free, priors, noise, Course("huber", rough=True)
    )


HEADER = "correct the header of the table and run again"
_TABLE = "correct the table and run again"
_FRAME = "give positions and orientations in a right-handed frame and run again"
_RECORD = "map the other columns to the joints (--columns) and run again"
# Rows by which a column may be late: it was recorded before or after the motion.
_DELAYS = tuple(sign * rows for rows in (1, 2, 3, 4, 5) for sign in (1, -1))
_OPTION = "if so, declare it (--sign, --coupling or --zeros), and run again"
# Parts of a neighbour's position that joints report; those of wrists, and the number of wrist
# joints; and their fractions.
_ADDED = (1.0, -1.0)
_WRIST = 3
_OF_WRISTS = tuple(sign * part for part in (1 / 2, 1 / 3, 2 / 3, 1 / 4) for sign in (1, -1))
_FRACTIONS = {1.0: "", 1 / 2: "1/2 of ", 1 / 3: "1/3 of ", 2 / 3: "2/3 of ", 1 / 4: "1/4 of "}


@dataclass(frozen=True)
class Correction:
    """Correction of a robot's description to agree with its controller.

    Attributes:
        shifts: positions of joints by the URDF when they report zero [rad], by name.
        turned: names of the joints that count the other way.
        couplings: joints that report a combination of positions.
    """

    shifts: Mapping[str, float] = dataclasses.field(default_factory=dict)
    turned: tuple[str, ...] = ()
    couplings: tuple[Coupling, ...] = ()

    def of(self, robot: Robot) -> Robot:
        """Return the robot with its description corrected."""
        if self.shifts or self.turned:
            robot = remastered(robot, shifts=self.shifts, turned=self.turned)
        return robot.with_couplings(*self.couplings) if self.couplings else robot

    def cure(self, robot: Robot, table: Measurements, words: str) -> TableCorrection:
        """Return a table with the positions that the robot would have reported by its uncorrected
        description.
        """
        shifts = [self.shifts.get(name, 0.0) for name in robot.joint_names]
        signs = np.where(np.isin(robot.joint_names, self.turned), -1.0, 1.0)
        found = robot.with_couplings(*self.couplings) if self.couplings else robot
        q = robot.as_reported(found.from_reported(table.q)) * signs + shifts
        return TableCorrection(words, robot, replace(table, q=q), _OPTION, self)

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
            f"{name} counts in the opposite sense to the URDF: the model reverses its "
            "axis, and accepts and "
            "returns positions as they are reported"
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
        return tuple(notes)


def shift_words(joint: str, shift: float) -> str:
    """Return the note on a joint whose true position differs from the reported one [rad]."""
    return f"{joint} is shifted by {np.rad2deg(shift):+.1f} deg: has it been mastered?"


@dataclass(frozen=True)
class TableCorrection:
    """One possible mistake.

    Attributes:
        words: the mistake in words.
        robot: the robot of the table if it was made.
        table: the table with it undone.
        advice: what to do.
        correction: of the robot's description, if that is the mistake; nobody has to do anything
            then.
    """

    words: str
    robot: Robot
    table: Measurements
    advice: str = HEADER
    correction: Correction | None = None


def exchanges(robot: Robot, table: Measurements) -> Iterator[TableCorrection]:
    """Yield joint columns swapped."""
    names = robot.joint_names
    for i, j in combinations(range(robot.n_joints), 2):
        q = table.q.copy()
        q[:, [i, j]] = q[:, [j, i]]
        yield TableCorrection(
            f"the columns {names[i]!r} and {names[j]!r} appear to be swapped",
            robot,
            replace(table, q=q),
        )


def descriptions(robot: Robot, table: Measurements) -> Iterator[TableCorrection]:
    """Yield joints that count the other way, or report a combination of positions, as manufacturers
    define them.

    The position of a joint is the sum or difference of its own report and its neighbour's, or in
    wrists a part of it.
    """
    free = free_joints(robot)
    for name in free:
        correction = Correction(turned=(name,))
        yield correction.cure(robot, table, f"the column {name!r} appears to have the wrong sign")
    # Two joints are coupled once: mutual couplings would not determine positions.
    coupled = [
        {robot.joint_names.index(name) for name in (one.joint, one.source)}
        for one in robot.couplings
    ]
    pairs = [
        (i, j)
        for i, j in permutations(robot.own_joints, 2)
        if abs(i - j) == 1 and {i, j} not in coupled
    ]
    turns = [
        kind != "prismatic" and name in free
        for name, kind in zip(robot.joint_names, robot.joint_types, strict=True)
    ]
    for i, j in (pair for pair in pairs if turns[pair[0]] and turns[pair[1]]):
        for factor in (*_ADDED, *(_OF_WRISTS if min(i, j) >= robot.n_joints - _WRIST else ())):
            correction = Correction(
                couplings=(Coupling(robot.joint_names[i], robot.joint_names[j], factor),)
            )
            yield correction.cure(
                robot,
                table,
                f"the column {robot.joint_names[i]!r} appears to hold {correction.lacks[0]}",
            )


def delays(robot: Robot, table: Measurements) -> Iterator[TableCorrection]:
    """Yield a joint column, or all of them, recorded some rows too late or too early."""
    n = len(table)
    each = np.eye(robot.n_joints, dtype=bool)
    columns = {
        f"the column {name!r} appears to be": column
        for name, column in zip(robot.joint_names, each, strict=True)
    }
    columns["all joint columns appear to be"] = np.ones(robot.n_joints, bool)
    for rows in _DELAYS:
        kept = np.arange(max(-rows, 0), n - max(rows, 0))
        if len(kept) < 2:
            continue
        word = f"{counted(abs(rows), 'row')} {'late' if rows > 0 else 'early'}"
        found = table.select(kept)
        for name, column in columns.items():
            moved = replace(found, q=np.where(column, table.q[kept + rows], found.q))
            yield TableCorrection(f"{name} {word}", robot, moved, _TABLE)


def records(robot: Robot, table: Measurements) -> Iterator[TableCorrection]:
    """Yield the other positions of the joints, where a table has both commanded and
    read-back ones.
    """
    if table.droop is not None:
        for name, other, sign in (
            ("commanded", "read back", 1.0),
            ("read-back", "commanded", -1.0),
        ):
            words = (
                f"the joints stood at their {name} positions, not at those in the joint "
                f"columns, which are {other}"
            )
            yield TableCorrection(
                words, robot, replace(table, q=table.q + sign * table.droop, droop=None), _RECORD
            )


def misreadings(robot: Robot, table: Measurements) -> Iterator[TableCorrection]:
    """Yield the mix-ups of columns that the fields of the sensor describe."""
    sensor = table.sensor
    for field in () if sensor is None else sensor.fields:
        for words, undo in field.mistakes:
            changed = table.with_readings(**{field.name: undo(table.readings[field.name])})
            yield TableCorrection(words, robot, changed)
    mirrors = {
        field.name: field.mirror
        for field in (() if sensor is None else sensor.fields)
        if field.mirror is not None
    }
    # For a single field that is one of its own mistakes.
    if len(mirrors) > 1:
        changed = table.with_readings(
            **{name: mirror(table.readings[name]) for name, mirror in mirrors.items()}
        )
        yield TableCorrection(
            "the frame of the readings appears to be left-handed", robot, changed, _FRAME
        )


def scaled(robot: Robot, table: Measurements, factor: float) -> TableCorrection | None:
    """Return the correction that multiplies all measured lengths; None where no length was
    measured.
    """
    fields = () if table.sensor is None else table.sensor.fields
    lengths = [
        field.name
        for field in fields
        if field.quantity == "length" and field.name in table.readings
    ]
    if not lengths:
        return None
    changed = table.with_readings(**{name: table.readings[name] * factor for name in lengths})
    advice = "check the units of the table and the scale of the instrument, and run again"
    return TableCorrection(
        f"the measured lengths appear scaled by {1.0 / factor:.3g}", robot, changed, advice
    )


def others(robot: Robot, table: Measurements) -> Iterator[TableCorrection]:
    """Yield other robots with joints of these names."""
    for name, other in _robots_alike(robot):
        yield TableCorrection(
            f"the table appears to be of a {name}",
            other,
            table,
            "give the URDF of that robot and run again",
        )


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


def cures(robot: Robot, table: Measurements) -> Iterator[TableCorrection]:
    """Yield all possible mistakes in a table, except for a scale, which has to be estimated."""
    return chain(
        *(
            kind(robot, table)
            for kind in (exchanges, descriptions, misreadings, records, delays, others)
        )
    )
