"""What may be wrong with a table, or with the description of its robot, each with what undoes it; and zeros far off."""

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

# Rows from which a typical error is told.
_TYPICAL = 1000
# Step of the search around the turn of one joint [rad], whose fits reach some 20 deg; how many joints are tried, the most
# promising ones.
_STEP, _TRIED = np.deg2rad(15.0), 4
# Of shifts that leave as much but for this factor the smallest are meant: the first joint's is a turn of the base.
_ALIKE = 1.2
# Frames that are closer than this [m, rad] make no other robot.
_SAME = 1e-5
UNFIT = (BadInputError, IdentificationError, np.linalg.LinAlgError)
"""What fits to a table end with that is not of the robot."""


def typical_left(station: Station, values: np.ndarray) -> tuple[float, float]:
    """Return the robust size of the errors of position [m] and orientation [rad]: outliers have no say."""
    if not station.sensor.reads_place:
        return 0.0, 0.0
    station = station.sample(_TYPICAL)
    position = float(np.median(np.linalg.norm(station.displacements(values), axis=1)))
    turned = [rows for rows, b in zip(station.block_rows, station.sensor.blocks, strict=True) if b.unit == "rad"]
    if not turned:
        return position, 0.0
    residuals = station.residuals(values)
    return position, max(float(np.median(np.linalg.norm(residuals[part], axis=0))) for part in turned)


def shifts_found(robot: Robot, table: Measurements, options: Options) -> dict[str, float]:
    """Return the zeros of joints with which base and tool alone leave least [rad], by name.

    One joint may be off by any angle, the others by as much as a fit reaches from zero.

    Args:
        robot: the arm.
        table: some rows of it.
        options: how the robot is placed.
    """
    options = replace(options, effects=(JointOffset(),), zeros=("*",), earlier=None, moment_frame="paper")
    names = free_joints(robot)
    turning = [i for i, kind in enumerate(robot.joint_types) if kind != "prismatic" and robot.joint_names[i] in names]

    def shifted(shift: np.ndarray) -> Measurements:
        return replace(table, q=table.q + robot.as_reported(shift[None])[0])

    def starts() -> Iterator[tuple[float, np.ndarray]]:
        for i in turning:
            angles = np.arange(_STEP, 2.0 * np.pi - 0.5 * _STEP, _STEP)
            shifts = [np.eye(robot.n_joints)[i] * (angle - 2.0 * np.pi * (angle > np.pi)) for angle in angles]
            sizes = (least_left(robot, shifted(shift), options, lambda left: left[0]) for shift in shifts)
            yield min(zip(sizes, shifts, strict=True), key=lambda one: one[0])

    likely = sorted(starts(), key=lambda one: one[0])[:_TRIED]
    found = []
    for shift in (np.zeros(robot.n_joints), *(shift for _, shift in likely)):
        with suppress(*UNFIT):
            station, values = roughly_placed(robot, shifted(shift), options, offsets=True)
            pairs = zip(station.parameters, values.tolist(), strict=True)
            offsets = {p.name.split(".")[0]: value for p, value in pairs if p.effect == JointOffset.name}
            rest = typical_left(station, values)[0]
            found.append((rest, shift + [offsets.get(name, 0.0) for name in robot.joint_names]))
    if not found:
        return {}
    least = min(rest for rest, _ in found)
    alike = [shift - 2.0 * np.pi * np.round(shift / (2.0 * np.pi)) for rest, shift in found if rest < _ALIKE * least]
    best = min(alike, key=lambda shift: float(np.abs(shift).sum()))
    return {robot.joint_names[i]: float(best[i]) for i in turning}


def least_left(robot: Robot, table: Measurements, options: Options, size: Callable[[tuple[float, float]], float]) -> float:
    """Return the size of what the best of some first placements leaves, inf if there is none."""
    with suppress(*UNFIT):
        return min(size(typical_left(*start)) for start in starts_of(robot, table, options))
    return np.inf


def roughly_placed(
    robot: Robot, table: Measurements, options: Options, *, offsets: bool = False
) -> tuple[Station, np.ndarray]:
    """Return a station and its values, of which base and tool are fitted, and offsets of joints that turn if asked for."""
    ((station, values),) = place(robot, {"": table}, options)
    problem = Problem((station,))
    free, priors = is_frame(problem), Priors(np.full(len(values), np.inf), bounds_of(problem, options))
    if offsets:
        free = free | np.array([p.effect == JointOffset.name and p.unit == "rad" for p in problem.parameters])
        priors = priors_of(problem, options)
    free, noise = free & released_of(problem, options), Noise((None,) * len(problem.blocks))
    return station, likeliest_values(problem, values, free, priors, noise, Course("huber", rough=True))


HEADER = "correct the header of the table and run again"
_TABLE = "correct the table and run again"
_FRAME = "give positions and orientations in a right-handed frame and run again"
_RECORD = "name their columns as the joints (--columns) and run again"
# Rows by which a column may stand off: a record that is written before or after the motion.
_DELAYS = tuple(sign * rows for rows in (1, 2, 3, 4, 5) for sign in (1, -1))
_OPTION = "if so, declare it (--sign, --coupling or --zeros), and run again"
# Parts of a neighbour's position that joints report; those of wrists, whose last joints are so many; and simple fractions.
_ADDED, _WRIST = (1.0, -1.0), 3
_OF_WRISTS = tuple(sign * part for part in (1 / 2, 1 / 3, 2 / 3, 1 / 4) for sign in (1, -1))
_FRACTIONS = {1.0: "", 1 / 2: "1/2 of ", 1 / 3: "1/3 of ", 2 / 3: "2/3 of ", 1 / 4: "1/4 of "}


@dataclass(frozen=True)
class Correction:
    """What of the description of a robot is not as its controller has it.

    Attributes:
        shifts: where joints stand by the URDF when they report zero [rad], by name.
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
        """Return a table that holds what the robot as it is described would have reported."""
        shifts = [self.shifts.get(name, 0.0) for name in robot.joint_names]
        signs = np.where(np.isin(robot.joint_names, self.turned), -1.0, 1.0)
        found = robot.with_couplings(*self.couplings) if self.couplings else robot
        q = robot.as_reported(found.from_reported(table.q)) * signs + shifts
        return TableCorrection(words, robot, replace(table, q=q), _OPTION, self)

    @property
    def lacks(self) -> tuple[str, ...]:
        """What coupled joints report, in words: one each."""
        ways = (f"{'minus' if one.factor > 0.0 else 'plus'} {_FRACTIONS.get(abs(one.factor), '')}" for one in self.couplings)
        return tuple(f"like its position {way}that of {one.source!r}" for way, one in zip(ways, self.couplings, strict=True))

    @property
    def notes(self) -> tuple[str, ...]:
        """What is to be said of it, in words."""
        told = [shift_words(name, shift) for name, shift in self.shifts.items()]
        told += [
            f"{name} counts the other way than the URDF has it: the model has its axis turned round, and takes and gives "
            "positions as they are reported"
            for name in self.turned
        ]
        for one, lacks in zip(self.couplings, self.lacks, strict=True):
            way = lacks.removeprefix("like ").replace("'", "")
            added = f"{'+' if one.factor > 0.0 else '-'} {_FRACTIONS.get(abs(one.factor), '')}{one.source} reported"
            told.append(
                f"{one.joint} reports {way}, as coupled drives do: the model has {one.joint} = {one.joint} reported {added}"
            )
        return tuple(told)


def shift_words(joint: str, shift: float) -> str:
    """Return what is to be said of a joint that stands elsewhere than it reports [rad], in words."""
    return f"{joint} is shifted by {np.rad2deg(shift):+.1f} deg: is it mastered?"


@dataclass(frozen=True)
class TableCorrection:
    """One thing that may be wrong.

    Attributes:
        words: what looks wrong.
        robot: whose table it is then.
        table: the table with this undone.
        advice: what to do.
        correction: of the robot's description, where that is what is wrong; nobody has to do anything then.
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
        yield TableCorrection(f"the columns {names[i]!r} and {names[j]!r} look swapped", robot, replace(table, q=q))


def descriptions(robot: Robot, table: Measurements) -> Iterator[TableCorrection]:
    """Yield joints that count the other way than the URDF's, or report a combination of positions as makers have it.

    A joint stands where its own position and its neighbour's, or a part of it in wrists, add up to; or at their difference.
    """
    free = free_joints(robot)
    for name in free:
        correction = Correction(turned=(name,))
        yield correction.cure(robot, table, f"the column {name!r} looks turned round in sign")
    # Two joints are coupled once: of either by the other no positions follow.
    coupled = [{robot.joint_names.index(name) for name in (one.joint, one.source)} for one in robot.couplings]
    pairs = [(i, j) for i, j in permutations(robot.own_joints, 2) if abs(i - j) == 1 and {i, j} not in coupled]
    turns = [kind != "prismatic" and name in free for name, kind in zip(robot.joint_names, robot.joint_types, strict=True)]
    for i, j in (pair for pair in pairs if turns[pair[0]] and turns[pair[1]]):
        for factor in (*_ADDED, *(_OF_WRISTS if min(i, j) >= robot.n_joints - _WRIST else ())):
            correction = Correction(couplings=(Coupling(robot.joint_names[i], robot.joint_names[j], factor),))
            yield correction.cure(robot, table, f"the column {robot.joint_names[i]!r} looks {correction.lacks[0]}")


def delays(robot: Robot, table: Measurements) -> Iterator[TableCorrection]:
    """Yield a joint column, or all of them, recorded some rows too late or too early."""
    n, everything = len(table), tuple(range(robot.n_joints))
    for rows in _DELAYS:
        kept = np.arange(max(-rows, 0), n - max(rows, 0))
        word = f"{counted(abs(rows), 'row')} {'late' if rows > 0 else 'early'}"
        for columns in ((i,) for i in everything) if len(kept) > 1 else ():
            name = f"the column {robot.joint_names[columns[0]]!r} looks"
            yield TableCorrection(f"{name} {word}", robot, _late(table, kept, rows, columns), _TABLE)
        if len(kept) > 1:
            yield TableCorrection(f"all joint columns look {word}", robot, _late(table, kept, rows, everything), _TABLE)


def _late(table: Measurements, kept: np.ndarray, rows: int, columns: tuple[int, ...]) -> Measurements:
    found = table.select(kept)
    q = found.q.copy()
    q[:, columns] = table.q[kept + rows][:, columns]
    return replace(found, q=q)


def records(robot: Robot, table: Measurements) -> Iterator[TableCorrection]:
    """Yield the other positions of the joints, where a table has those commanded and those read back."""
    if table.droop is not None:
        for name, other, sign in (("commanded", "read back", 1.0), ("read back", "commanded", -1.0)):
            words = f"the joints stood where they were {name}, not where the columns of the joints say, as {other}"
            yield TableCorrection(words, robot, replace(table, q=table.q + sign * table.droop, droop=None), _RECORD)


def misreadings(robot: Robot, table: Measurements) -> Iterator[TableCorrection]:
    """Yield what the sensor's fields know of how their columns get mixed up."""
    sensor = table.sensor
    for field in () if sensor is None else sensor.fields:
        for words, undo in field.mistakes:
            changed = table.with_readings(**{field.name: undo(table.readings[field.name])})
            yield TableCorrection(words, robot, changed)
    mirrors = {field.name: field.mirror for field in (() if sensor is None else sensor.fields) if field.mirror is not None}
    # Of one field alone that is one of its own mistakes.
    if len(mirrors) > 1:
        changed = table.with_readings(**{name: mirror(table.readings[name]) for name, mirror in mirrors.items()})
        yield TableCorrection("the frame of the readings looks left-handed", robot, changed, _FRAME)


def scaled(robot: Robot, table: Measurements, factor: float) -> TableCorrection | None:
    """Return the cure that multiplies all measured lengths; None where no length was measured."""
    fields = () if table.sensor is None else table.sensor.fields
    lengths = [field.name for field in fields if field.quantity == "length" and field.name in table.readings]
    if not lengths:
        return None
    changed = table.with_readings(**{name: table.readings[name] * factor for name in lengths})
    advice = "check the units of the table and the scale of the instrument, and run again"
    return TableCorrection(f"the measured lengths look {1.0 / factor:.3g} times what they should be", robot, changed, advice)


def others(robot: Robot, table: Measurements) -> Iterator[TableCorrection]:
    """Yield other robots with joints of these names."""
    for name, other in _robots_alike(robot):
        yield TableCorrection(
            f"the table looks like that of a {name}", other, table, "give the URDF of that robot and run again"
        )


def _robots_alike(robot: Robot) -> Iterator[tuple[str, Robot]]:
    """Yield the names of robots whose joints have the same names but stand elsewhere, and the robots, each size once.

    None without example-robot-data.
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
        found = other.forward_kinematics(middle) if other.joint_names == robot.joint_names else seen[0]
        if not any(np.allclose(found, one, atol=_SAME) for one in seen):
            seen.append(found)
            yield name, other


def _robot_files(names: Iterable[str]) -> list[tuple[str, Path]]:
    """Return the files of robots, those first whose own name the file bears: some loaders share one."""
    found = []
    with warnings.catch_warnings(action="ignore", category=PincalWarning):
        for name in names:
            with suppress(BadInputError):
                found.append((name, find_file(name)))
    return sorted(found, key=lambda one: (not one[1].name.startswith(one[0]), len(one[0]), one[0]))


def cures(robot: Robot, table: Measurements) -> Iterator[TableCorrection]:
    """Yield all that may be wrong with a table, but for a scale, which has to be found."""
    return chain(*(kind(robot, table) for kind in (exchanges, descriptions, misreadings, records, delays, others)))
