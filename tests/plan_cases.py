"""Tables as people plan them: programs run again and again, dwells, several targets, sessions in which something changes.

A kind is one entry of ``PLANS``: where its poses are (a region), how they are visited (a program), what is read at each
stop, and what goes wrong. The robot comes from :mod:`pincal.simulate`, which shares no code with the model, and the rest
is plain numpy. What is known of a table: where everything is wrong with it, and the truth at poses never measured.

At each stop every drive arrives with an error of its own, which all readings of the stop share, whatever their target.
"""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np
from diagnosis_cases import seven_joints
from discovery_cases import _JOINT, _LINK, FRESH_ARMS, Name, _origin, _placed, _row, random_urdf
from row_cases import _upright
from scipy.spatial.transform import Rotation

from pincal import Measurements, Options, Robot, Setup, measurements_from_arrays
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.simulate.planning import reach

# Noise of a coordinate of a tracker [m], and how drives arrive at a stop [rad, prismatic m].
SIGMA, ARRIVAL = 15e-6, 10e-6
# Noise of a marker that a camera sees [m, rad], of a point by a stereo camera [m], and of a point in an image [px].
_MARKER, _MARKER_TURN, _STEREO, _PIXEL = 3e-3, 10e-3, 50e-6, 0.05
# A shift, in standard deviations of the difference between the means before and after it, and one nobody overlooks [m].
_SIGMAS, _CLEAR_SHIFT = 5.0, 1e-3
# A joint is remastered by at most so much [rad], and at least by what moves the tool by so many such deviations.
_REMASTERED, _BARELY = 1e-3, 7.0
# Least distance of the tool from the axis of that joint, in the root of the mean square [m].
_LEVER = 0.15
_WRONG, _WRONG_SHARE = 3e-3, 0.04
_BACKLASH = (5e-5, 2e-4)
_MISSING = 0.08
# Parts of the joint ranges of a grid and of sweeps, levels of the grid, and positions of a sweep.
_GRID, _SWEEP, _LEVELS, _POSITIONS = 0.7, 0.75, (4, 3, 3, 2, 2, 2), 20
# Edge of a small cube as a part of the reach, and the largest turn of the tool in it [rad].
_CUBE, _TURN = 0.2, 0.5
# Corners of ISO 9283's cube that its plane has, with the centre, in halves of its edge.
_ISO = np.array([[0, 0, 0], [-0.8, -0.8, -0.8], [-0.8, 0.8, -0.8], [0.8, 0.8, 0.8], [0.8, -0.8, 0.8]])
_TRIES = 200
# From stop to stop and from reading to reading [s], and how many tables have times.
_STOP_TIME, _READING_TIME, _TIMED = 40.0, 2.0, 0.3
# How many tables have a load, which stays the same and is recorded.
_LOADED = 0.5
# Poses of a robot that is measured again to see whether it has changed.
_CHECKED = 30
_POINTS_OF_BOARD = (3, 4)


# Arms -------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Arm:
    """A class of arms.

    Attributes:
        urdf: draws one.
        soft: compliance of each drive [rad/(N m)], 0 for a rigid one, about which those of an arm are drawn.
        floor: lowest height of its poses [m]; None for none.
        load: what it carries [kg].
        com: where that is in the tip frame [m].
        errors: standard deviations of its lengths [m] and joint offsets [rad or m].
    """

    urdf: Callable[[np.random.Generator], str]
    soft: tuple[float, ...]
    floor: float | None = -0.5
    load: float = 6.0
    com: tuple[float, float, float] = (0.01, 0.02, 0.08)
    errors: tuple[float, float] = (2e-4, 1e-3)

    @property
    def is_heavy(self) -> bool:
        """Whether it carries more than a person does."""
        return self.load > 50.0


def _softness(unit: float, *relative: float) -> tuple[float, ...]:
    return tuple(unit * one for one in relative)


_SIX = (1.0, 1.0, 1.5, 8.0, 8.0, 12.0)
_HEAVY: dict[str, Any] = {
    "soft": _softness(2e-7, *_SIX),
    "floor": 0.1,
    "load": 100.0,
    "com": (0.06, 0.03, 0.2),
    "errors": (5e-4, 2e-3),
}
_LIGHT: dict[str, Any] = {"soft": _softness(5e-6, *_SIX)}


class _Link(NamedTuple):
    """A joint and the link that it moves: turn, d, a [m] and quarters of a turn to the next axis; mass [kg], range."""

    kind: str
    d: float
    a: float
    quarters: int
    mass: float
    lower: float
    upper: float


_FIVE = (
    _Link("revolute", 0.16, 0.05, 1, 6.0, -2.9, 2.9),
    _Link("revolute", 0.0, 0.45, 0, 5.0, -0.4, 2.2),
    _Link("revolute", 0.0, 0.40, 0, 3.0, -2.2, 0.4),
    _Link("revolute", 0.0, 0.0, 1, 1.5, -0.3, 2.3),
    _Link("revolute", 0.12, 0.0, 0, 0.5, -2.9, 2.9),
)
_SCARA = (
    _Link("revolute", 0.40, 0.30, 0, 8.0, -2.2, 2.2),
    _Link("revolute", 0.05, 0.25, 2, 5.0, -2.4, 2.4),
    _Link("prismatic", 0.05, 0.0, 0, 1.5, 0.0, 0.2),
    _Link("revolute", 0.04, 0.0, 0, 0.5, -2.9, 2.9),
)


def _serial(links: tuple[_Link, ...], rng: np.random.Generator) -> str:
    """Return an arm of some links, its lengths and masses drawn to +- 20 %."""
    text = ['<robot name="drawn"><link name="base"/>']
    T, parent = np.eye(4), "base"
    for i, link in enumerate(links):
        name = f"axis_{i + 1}"
        limits = float(link.lower), float(link.upper)
        text.append(_JOINT.format(name, link.kind, parent, f"link_{i + 1}", *_origin(T), *limits))
        parent = f"link_{i + 1}"
        xyz = np.array([link.a, 0.0, link.d]) * rng.uniform(0.8, 1.2)
        T = _placed(xyz, np.array([link.quarters * np.pi / 2, 0.0, 0.0]))
        centre = rng.uniform(0.2, 0.7) * xyz + rng.normal(0.0, 0.015, 3)
        text.append(_LINK.format(parent, _row(centre), float(link.mass * rng.uniform(0.8, 1.2))))
    text.append(_JOINT.format("flange", "fixed", parent, "tool0", *_origin(T), 0.0, 0.0))
    return "".join(text) + '<link name="tool0"/></robot>'


def _on_track(length: float, rng: np.random.Generator) -> str:
    """Return a light arm on a level track of a length [m]."""
    arm = random_urdf(rng, heavy=False)
    rail = '<robot name="drawn"><link name="rail"/><joint name="track" type="prismatic"><parent link="rail"/>'
    rail += '<child link="base"/><origin xyz="0 0 0.2" rpy="0 1.5707963267948966 0"/><axis xyz="0 0 1"/>'
    rail += f'<limit lower="0" upper="{length!r}" effort="1" velocity="1"/></joint>'
    # The track runs along its z axis, and the arm on it stands upright.
    upright = '<link name="base"/><joint name="stand" type="fixed"><parent link="base"/><child link="foot"/>'
    upright += '<origin xyz="0 0 0" rpy="0 -1.5707963267948966 0"/></joint><link name="foot"/>'
    arm = arm.replace('<parent link="base"/>', '<parent link="foot"/>', 1)
    return arm.replace('<robot name="drawn"><link name="base"/>', rail + upright, 1)


def _six(frames: str, heavy: bool) -> Callable[[np.random.Generator], str]:
    return partial(random_urdf, heavy=heavy, frames=frames)


def _kuka(rng: np.random.Generator) -> str:
    return Path(kuka_urdf_path()).read_text(encoding="utf-8")


_ARMS = {
    "kuka": _Arm(_kuka, **_HEAVY),
    "heavy": _Arm(_six("plain", True), **_HEAVY),
    "light": _Arm(_six("plain", False), **_LIGHT),
    "turned heavy": _Arm(_six("turned", True), **_HEAVY),
    "turned light": _Arm(_six("turned", False), **_LIGHT),
    "skew heavy": _Arm(_six("skew", True), **_HEAVY),
    "skew light": _Arm(_six("skew", False), **_LIGHT),
    "seven": _Arm(seven_joints, _softness(5e-6, 1.0, 1.0, 1.2, 1.5, 6.0, 8.0, 12.0)),
    "five": _Arm(partial(_serial, _FIVE), _softness(5e-6, 1.0, 1.0, 1.5, 8.0, 12.0), load=2.0),
    "scara": _Arm(partial(_serial, _SCARA), _softness(5e-6, 1.0, 1.0, 0.0, 8.0), floor=None, load=2.0),
    "track 0.3": _Arm(partial(_on_track, 0.3), (0.0, *_LIGHT["soft"])),
    "track 3": _Arm(partial(_on_track, 3.0), (0.0, *_LIGHT["soft"])),
    "track 10": _Arm(partial(_on_track, 10.0), (0.0, *_LIGHT["soft"])),
}
SIX_AXES = ("kuka", "heavy", "light", *FRESH_ARMS)
_LIGHT_SIX = ("light", "turned light")
# Arms whose errors are hardly larger than the noise of a marker.
_OF_MARKERS = ("light", "turned light", "skew light")


@dataclass(frozen=True)
class Scene:
    """A machine before a sensor.

    Attributes:
        machine: as it truly is.
        robot: as its URDF has it.
        arm: its class.
        setup: the sensor, which reads without noise.
        sigma: noise of its readings, by the names of ``Measurements``.
        load: what the arm carries [kg].
    """

    machine: sim.TrueMachine
    robot: Robot
    arm: _Arm
    setup: sim.Instrument | sim.EyeInHand
    sigma: dict[str, float]
    load: float

    @property
    def nominal(self) -> sim.Arm:
        """The arm of the URDF."""
        return self.machine.nominal

    @property
    def range(self) -> tuple[np.ndarray, np.ndarray]:
        """Middle and half of the range of each joint."""
        lower, upper = self.nominal.lower, self.nominal.upper
        return 0.5 * (upper + lower), 0.5 * (upper - lower)

    @property
    def frames(self) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Base to instrument, shape (4, 4), and each target in the tip frame, shape (4, 4), by name."""
        if isinstance(self.setup, sim.EyeInHand):
            return np.linalg.inv(self.setup.object_pose), {"camera": self.setup.camera_pose}
        targets = {name or "tool": T for name, T in self.setup.targets.items()}
        return self.setup.pose, targets


def _machine(rng: np.random.Generator, arm: _Arm) -> tuple[sim.TrueMachine, Robot]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.urdf"
        path.write_text(arm.urdf(rng), encoding="utf-8")
        robot = Robot.from_urdf(path, tip="tool0")
        machine = sim.TrueMachine.from_urdf(path, tip="tool0")
    length, offset = arm.errors
    machine = machine.draw_errors(rng, sigma_length=length, sigma_angle=1e-3, sigma_offset=offset)
    machine = machine.draw_masses(rng, sigma=0.03)
    n = len(arm.soft)
    drive = np.array(arm.soft) * rng.uniform(0.7, 1.3, n)
    bearing = np.outer([0.15, 0.15], drive * rng.uniform(0.5, 1.5, n)) * rng.uniform(0.4, 1.6, (2, n))
    return replace(machine, compliance=np.vstack([bearing, drive]).T, moment_frame="after"), robot


# Sensors ----------------------------------------------------------------------------------------------------------------

_Sensor = Callable[[np.random.Generator, sim.TrueMachine, _Arm], tuple[Any, dict[str, float]]]


def _tool(rng: np.random.Generator, arm: _Arm) -> np.ndarray:
    """Return a place off the axis of the last joint, or nothing could be seen of it."""
    beside = rng.choice([-1.0, 1.0], 2) * rng.uniform(0.05, 0.2, 2)
    return np.append(beside, rng.uniform(0.05, 0.25)) * (1.0 if arm.is_heavy else 0.6)


def _reflector(rng: np.random.Generator, machine: sim.TrueMachine, arm: _Arm) -> tuple[sim.Instrument, dict[str, float]]:
    return sim.Instrument(pose=_upright(rng), targets=_tool(rng, arm)), {"position": SIGMA}


def _five_reflectors(
    rng: np.random.Generator, machine: sim.TrueMachine, arm: _Arm
) -> tuple[sim.Instrument, dict[str, float]]:
    around = 2.0 * np.pi * np.arange(5) / 5.0 + rng.uniform(0.0, 6.28)
    radius = rng.uniform(0.08, 0.15)
    places = np.column_stack([radius * np.cos(around), radius * np.sin(around), rng.uniform(0.0, 0.15, 5)])
    targets = {f"smr{k}": place for k, place in enumerate(places)}
    return sim.Instrument(pose=_upright(rng), targets=targets), {"position": SIGMA}


def _marker(rng: np.random.Generator, machine: sim.TrueMachine, arm: _Arm) -> tuple[sim.Instrument, dict[str, float]]:
    target = np.eye(4)
    target[:3, :3] = Rotation.random(rng=rng).as_matrix()
    target[:3, 3] = _tool(rng, arm)
    setup = sim.Instrument(reads="pose", pose=_upright(rng), targets=target)
    return setup, {"position": _MARKER, "quaternion": _MARKER_TURN}


def _board(
    rng: np.random.Generator, machine: sim.TrueMachine, arm: _Arm, *, in_metres: bool
) -> tuple[sim.EyeInHand, dict[str, float]]:
    board = sim.grid_object(*_POINTS_OF_BOARD)
    for _ in range(_TRIES):
        object_pose, camera_pose = np.eye(4), np.eye(4)
        azimuth, distance = rng.uniform(-np.pi, np.pi), rng.uniform(0.5, 0.9)
        place = [distance * np.cos(azimuth), distance * np.sin(azimuth), rng.uniform(-0.2, 0.2)]
        object_pose[:3, :3] = Rotation.from_rotvec(rng.normal(0.0, 0.15, 3)).as_matrix()
        object_pose[:3, 3] = place
        camera_pose[:3, :3] = Rotation.from_rotvec(rng.normal(0.0, 0.05, 3)).as_matrix()
        camera_pose[:3, 3] = rng.uniform(-0.05, 0.05, 3)
        lens = None if in_metres else sim.Lens(k1=float(rng.uniform(-0.16, -0.08)))
        setup = sim.EyeInHand(target=board, object_pose=object_pose, camera_pose=camera_pose, lens=lens, in_metres=in_metres)
        if setup.has_views(machine.nominal, rng, min_height=arm.floor):
            return setup, {"camera_point": _STEREO} if in_metres else {"pixel": _PIXEL}
    raise ValueError("no place of a board that a camera on the arm sees")


# Regions ----------------------------------------------------------------------------------------------------------------


class Region(NamedTuple):
    """Where the poses of a plan are.

    Attributes:
        measured: a number of poses to measure, in order, shape (N, n); a plan of fixed poses gives its own number.
        fresh: a number of poses of the same plan that it has not measured.
    """

    measured: Callable[[int, np.random.Generator], np.ndarray]
    fresh: Callable[[int, np.random.Generator], np.ndarray]


def anywhere(scene: Scene, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return poses at random within the joint limits, shape (count, n)."""
    return sim.plan_poses(scene.nominal, count, rng, min_height=scene.arm.floor)


def _random(scene: Scene, rng: np.random.Generator) -> Region:
    draw = partial(anywhere, scene)
    return Region(draw, draw)


def _views(scene: Scene, rng: np.random.Generator) -> Region:
    def draw(count: int, rng: np.random.Generator) -> np.ndarray:
        return scene.setup.plan(scene.nominal, count, rng=rng, min_height=scene.arm.floor)

    return Region(draw, draw)


def _resting(scene: Scene, rng: np.random.Generator, *, at: dict[int, float | None]) -> Region:
    """Poses at random in which some joints stand still, at a position or anywhere."""
    there = anywhere(scene, 1, rng)[0]
    for joint, position in at.items():
        there[joint] = there[joint] if position is None else position

    def draw(count: int, rng: np.random.Generator) -> np.ndarray:
        q = anywhere(scene, count, rng)
        q[:, list(at)] = there[list(at)]
        return q

    return Region(draw, draw)


def _three_moved(scene: Scene, rng: np.random.Generator) -> Region:
    n = len(scene.nominal.names)
    still = rng.permutation(n)[3:]
    return _resting(scene, rng, at={int(joint): None for joint in still})


def _grid(scene: Scene, rng: np.random.Generator) -> Region:
    """A grid of joint positions along which the arm goes to and fro."""
    middle, half = scene.range
    steps = np.array(_to_and_fro(_LEVELS))

    def measured(count: int, rng: np.random.Generator) -> np.ndarray:
        return middle + _GRID * half * steps

    def fresh(count: int, rng: np.random.Generator) -> np.ndarray:
        return middle + _GRID * half * rng.uniform(-1.0, 1.0, (count, len(middle)))

    return Region(measured, fresh)


def _to_and_fro(levels: tuple[int, ...]) -> list[tuple[float, ...]]:
    """Return the nodes of a grid from -1 to 1, each beside the one before."""
    if not levels:
        return [()]
    inner = _to_and_fro(levels[1:])
    both_ways = itertools.cycle([inner, inner[::-1]])
    first = np.linspace(-1.0, 1.0, levels[0]).tolist()
    return [(value, *rest) for value, way in zip(first, both_ways, strict=False) for rest in way]


def _sweeps(scene: Scene, rng: np.random.Generator) -> Region:
    """Each joint swept alone through most of its range, as for circles about its axis."""
    middle, half = scene.range
    home = middle + 0.3 * half * rng.uniform(-1.0, 1.0, len(middle))

    def swept(part: np.ndarray, joint: np.ndarray) -> np.ndarray:
        q = np.tile(home, (len(part), 1))
        q[np.arange(len(part)), joint] = middle[joint] + _SWEEP * part * half[joint]
        return q

    def measured(count: int, rng: np.random.Generator) -> np.ndarray:
        n = len(middle)
        part = np.tile(np.linspace(-1.0, 1.0, _POSITIONS), n)
        return swept(part, np.repeat(np.arange(n), _POSITIONS))

    def fresh(count: int, rng: np.random.Generator) -> np.ndarray:
        return swept(rng.uniform(-1.0, 1.0, count), rng.integers(0, len(middle), count))

    return Region(measured, fresh)


def _cube_at(scene: Scene, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, float]:
    """Return a pose, its tip in the base frame, and half of the edge of a cube about it that the tip reaches."""
    corners = np.array(list(itertools.product([-1.0, 1.0], repeat=3)))
    # Arms of skew axes reach smaller ones only.
    for size in (1.0, 0.7, 0.5, 0.35):
        edge = 0.5 * size * _CUBE * scene.robot.reach
        for _ in range(_TRIES):
            q = anywhere(scene, 1, rng)
            tip = sim.TrueMachine.of_arm(scene.nominal).tip(q)[0]
            goal = np.tile(tip, (8, 1, 1))
            goal[:, :3, 3] += edge * corners
            if reach(scene.nominal, np.tile(q, (8, 1)), goal=goal)[1].all():
                return q[0], tip, edge
    raise ValueError("no cube within reach")


def _cube(scene: Scene, rng: np.random.Generator) -> Region:
    """Poses whose tip is in a small cube, the tool turned by half a radian at most."""
    q_middle, tip, edge = _cube_at(scene, rng)

    def draw(count: int, rng: np.random.Generator) -> np.ndarray:
        found = np.empty((0, len(q_middle)))
        while len(found) < count:
            goal = np.tile(tip, (2 * count, 1, 1))
            goal[:, :3, 3] += edge * rng.uniform(-1.0, 1.0, (2 * count, 3))
            turn = _TURN / np.sqrt(3.0) * rng.uniform(-1.0, 1.0, (2 * count, 3))
            goal[:, :3, :3] = goal[:, :3, :3] @ Rotation.from_rotvec(turn).as_matrix()
            q, reached = reach(scene.nominal, np.tile(q_middle, (2 * count, 1)), goal=goal)
            found = np.vstack([found, q[reached]])
        return found[:count]

    return Region(draw, draw)


def _iso(scene: Scene, rng: np.random.Generator) -> Region:
    """The five poses of ISO 9283 in the inclined plane of a cube, all of one orientation, and others in the cube."""
    q_middle, tip, edge = _cube_at(scene, rng)

    def within(parts: np.ndarray) -> np.ndarray:
        goal = np.tile(tip, (len(parts), 1, 1))
        goal[:, :3, 3] += edge * parts
        return reach(scene.nominal, np.tile(q_middle, (len(parts), 1)), goal=goal)[0]

    return Region(
        lambda count, rng: within(_ISO),
        lambda count, rng: within(rng.uniform(-0.8, 0.8, (count, 3))),
    )


def _iso_and_others(scene: Scene, rng: np.random.Generator) -> Region:
    iso = _iso(scene, rng)

    def measured(count: int, rng: np.random.Generator) -> np.ndarray:
        return np.vstack([iso.measured(5, rng), anywhere(scene, count, rng)])

    return Region(measured, partial(anywhere, scene))


# Programs ---------------------------------------------------------------------------------------------------------------


class _Visits(NamedTuple):
    """The pose of each stop, and the pass to which it belongs, shape (S,) each."""

    pose: np.ndarray
    turn: np.ndarray


def _once(poses: int) -> _Visits:
    return _Visits(np.arange(poses), np.zeros(poses, int))


def _cycles(count: int, poses: int) -> _Visits:
    """The whole program so many times."""
    return _Visits(np.tile(np.arange(poses), count), np.repeat(np.arange(count), poses))


def _twice_each(poses: int) -> _Visits:
    """Each pose twice, one after the other."""
    return _Visits(np.repeat(np.arange(poses), 2), np.tile([0, 1], poses))


def _iso_then_others(poses: int) -> _Visits:
    """Five poses 30 times, then the others once."""
    pose = np.append(np.tile(np.arange(5), 30), np.arange(5, poses))
    return _Visits(pose, np.zeros(len(pose), int))


# What goes wrong --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stops:
    """Stops of the robot in their order.

    Attributes:
        q: joint positions of the table [rad or m], shape (S, n).
        turn: number of the pass of each, shape (S,).
        offset: where joints are beside that [rad or m], shape (S, n).
        payload: truly carried [kg], shape (S,).
        approach: side from which each joint comes, shape (S, n); None where it does not matter.
        shift: added to what the instrument reads [m], shape (S, 3).
    """

    q: np.ndarray
    turn: np.ndarray
    offset: np.ndarray
    payload: np.ndarray
    approach: np.ndarray | None
    shift: np.ndarray


@dataclass(frozen=True)
class Trouble:
    """What is wrong with a session.

    Attributes:
        stops: the stops with it.
        effects: what the robot has that no column tells.
        truth: names of the robot that are right.
        changes: whether something is other from some stop on.
        first: the first stop at which something is other than before; -1 where it is so throughout, or nowhere.
        size: how large it is, in its unit.
        sigmas: how far it moves the target, in standard deviations of the difference between the means before and after.
        wrong: part of the rows that are wrong.
    """

    stops: Stops
    effects: tuple[Any, ...] = ()
    truth: tuple[Name, ...] = ()
    changes: bool = False
    first: int = -1
    size: float = 0.0
    sigmas: float = 0.0
    wrong: float = 0.0


_Disturbance = Callable[[Scene, Stops, float, np.random.Generator], Trouble]


def _nothing(scene: Scene, stops: Stops, arrival: float, rng: np.random.Generator) -> Trouble:
    return Trouble(stops)


def _in_pass(stops: Stops, rng: np.random.Generator) -> tuple[np.ndarray, int]:
    """Return which stops are after a change between two passes, shape (S,), and the first of them."""
    after = stops.turn >= rng.integers(1, stops.turn.max() + 1)
    return after, int(np.argmax(after))


def _scatter(scene: Scene, stops: Stops, arrival: float) -> float:
    """Return the standard deviation of a coordinate of one reading, of instrument and drives [m]."""
    missed = arrival * np.random.default_rng(0).standard_normal(stops.q.shape)
    moved = _target_at(scene, stops.q + missed, stops.payload) - _target_at(scene, stops.q, stops.payload)
    return float(np.hypot(scene.sigma["position"], np.sqrt(np.mean(moved**2))))


def _of_means(scene: Scene, stops: Stops, arrival: float, after: np.ndarray) -> float:
    """Return the standard deviation of the difference between the means of stops before and after a change [m]."""
    both = 1.0 / np.count_nonzero(after) + 1.0 / np.count_nonzero(~after)
    return _scatter(scene, stops, arrival) * float(np.sqrt(both))


def _shifted(scene: Scene, stops: Stops, arrival: float, rng: np.random.Generator, *, size: float | None = None) -> Trouble:
    """The instrument is moved between two passes, by a length or just so that it can be seen."""
    after, first = _in_pass(stops, rng)
    unit = _of_means(scene, stops, arrival, after)
    size = _SIGMAS * unit if size is None else size
    away = rng.standard_normal(3)
    shift = np.outer(after, size * away / np.linalg.norm(away))
    return Trouble(replace(stops, shift=shift), changes=True, first=first, size=size, sigmas=size / unit)


def _remastered(scene: Scene, stops: Stops, arrival: float, rng: np.random.Generator) -> Trouble:
    """A joint is remastered between two passes, or where a plan has one pass, midway."""
    if stops.turn.max():
        after, first = _in_pass(stops, rng)
    else:
        first = int(rng.uniform(0.35, 0.65) * len(stops.q))
        after = np.arange(len(stops.q)) >= first
    for joint in rng.permutation(len(scene.nominal.names)):
        turned = _REMASTERED * np.eye(len(scene.nominal.names))[joint]
        moved = _target_at(scene, stops.q + turned, stops.payload) - _target_at(scene, stops.q, stops.payload)
        most = float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))
        if most > _LEVER * _REMASTERED:
            break
    unit = _of_means(scene, stops, arrival, after)
    part = float(np.exp(rng.uniform(np.log(min(_BARELY * unit / most, 1.0)), 0.0)))
    name = scene.nominal.names[joint]
    truth = (("remastered", name, None), ("joint_offset", name, None))
    changed = replace(stops, offset=np.outer(after, part * turned))
    sizes = {"size": part * _REMASTERED, "sigmas": part * most / unit}
    return Trouble(changed, truth=truth, changes=True, first=first, **sizes)


def _unrecorded_load(scene: Scene, stops: Stops, arrival: float, rng: np.random.Generator) -> Trouble:
    """Nothing and then the load, pass by pass or at each pose in turn, and no column says so."""
    payload = np.where(stops.turn % 2, scene.arm.load, 0.0)
    between_passes = np.count_nonzero(np.diff(stops.turn)) == stops.turn.max()
    first = int(np.argmax(stops.turn > 0)) if between_passes else -1
    return Trouble(replace(stops, payload=payload), changes=True, first=first, size=scene.arm.load)


def _from_both_sides(scene: Scene, stops: Stops, arrival: float, rng: np.random.Generator) -> Trouble:
    """A joint with backlash is brought to each pose from one side and then from the other, and no column says so."""
    joint = str(rng.choice(scene.nominal.names[:4]))
    size = float(np.exp(rng.uniform(*np.log(_BACKLASH))))
    side = np.where(stops.turn % 2, -1.0, 1.0)
    approach = np.tile(side[:, None], (1, stops.q.shape[1]))
    backlash = sim.Backlash(joint=joint, size=size)
    return Trouble(replace(stops, approach=approach), (backlash,), (("backlash", joint, None),), size=size)


def _wrong_readings(scene: Scene, stops: Stops, arrival: float, rng: np.random.Generator) -> Trouble:
    return Trouble(stops, wrong=_WRONG_SHARE, size=_WRONG)


def _target_at(scene: Scene, q: np.ndarray, payload: np.ndarray) -> np.ndarray:
    """Return the first target in the instrument's frame [m], shape (N, 3)."""
    tip = scene.machine.tip(q, payload=payload, payload_com=scene.arm.com)
    hall, targets = scene.frames
    return (hall @ tip @ next(iter(targets.values())))[:, :3, 3]


# Kinds ------------------------------------------------------------------------------------------------------------------

DEFAULT_VERBS = ("calibrate", "discover")


@dataclass(frozen=True)
class Plan:
    """How a table of a kind comes about.

    Attributes:
        poses: fewest and most different poses; a region of fixed poses has its own number.
        region: where they are.
        visits: in which order they are visited, by their number.
        readings: of each stop, one after the other.
        sensor: what is read.
        missing: part of the readings that failed.
        trouble: what goes wrong.
        arms: classes of arms, in turn.
        verbs: what is made of the table by default.
        is_marker: whether the readings are too coarse for most of the arm's errors.
    """

    poses: tuple[int, int] = (100, 200)
    region: Callable[[Scene, np.random.Generator], Region] = _random
    visits: Callable[[int], _Visits] = _once
    readings: int = 1
    sensor: _Sensor = _reflector
    missing: float = 0.0
    trouble: _Disturbance = _nothing
    arms: tuple[str, ...] = SIX_AXES
    verbs: tuple[str, ...] = DEFAULT_VERBS
    is_marker: bool = False


def _again(count: int, poses: tuple[int, int], **others: Any) -> Plan:
    return Plan(poses, visits=partial(_cycles, count), **others)


def _dwell(readings: int, poses: tuple[int, int]) -> Plan:
    return Plan(poses, readings=readings, verbs=(*DEFAULT_VERBS, "diagnose"))


_ONLY_CALIBRATE = ("calibrate",)
PLANS = {
    "once": Plan(verbs=(*DEFAULT_VERBS, "diagnose")),
    "cycles2": _again(2, (50, 80)),
    "cycles3": _again(3, (50, 80)),
    "cycles5": _again(5, (50, 80)),
    "cycles10": _again(10, (50, 60)),
    "cycles30": _again(30, (18, 20)),
    "iso9283": _again(30, (5, 5), region=_iso),
    "iso9283_and_60": Plan((60, 60), region=_iso_and_others, visits=_iso_then_others),
    "dwell3": _dwell(3, (60, 100)),
    "dwell5": _dwell(5, (60, 100)),
    "dwell20": _dwell(20, (30, 30)),
    "five_targets": Plan((50, 80), sensor=_five_reflectors, missing=_MISSING),
    "board_points": Plan((40, 50), _views, sensor=partial(_board, in_metres=True), arms=_LIGHT_SIX),
    "board_pixels": Plan((20, 25), _views, sensor=partial(_board, in_metres=False), arms=_LIGHT_SIX, verbs=_ONLY_CALIBRATE),
    "both_approaches": Plan((60, 100), visits=_twice_each, trouble=_from_both_sides),
    "passes2_shift": _again(2, (60, 80), trouble=_shifted),
    "passes3_shift": _again(3, (60, 80), trouble=_shifted),
    "passes2_shift_1mm": _again(2, (60, 80), trouble=partial(_shifted, size=_CLEAR_SHIFT)),
    "passes2_remastered": _again(2, (60, 80), trouble=_remastered),
    "remastered_midway": Plan((120, 200), trouble=_remastered),
    "passes2_load": _again(2, (60, 80), trouble=_unrecorded_load),
    "load_alternates": Plan((60, 80), visits=_twice_each, trouble=_unrecorded_load),
    "wrong_in_cycles3": _again(3, (60, 80), trouble=_wrong_readings),
    "wrong_in_cycles5": _again(5, (50, 60), trouble=_wrong_readings),
    "joint6_at_45deg": Plan((100, 150), partial(_resting, at={5: np.pi / 4})),
    "joints_1_to_3_rest": Plan((80, 120), partial(_resting, at={0: None, 1: None, 2: None})),
    "three_joints_moved": Plan((80, 120), _three_moved),
    "serpentine_grid": Plan(region=_grid),
    "circle_point": Plan(region=_sweeps),
    "small_cube": Plan((80, 120), _cube),
    "track_0.3m": Plan((120, 180), arms=("track 0.3",)),
    "track_3m": Plan((120, 180), arms=("track 3",)),
    "track_10m": Plan((120, 180), arms=("track 10",)),
    "seven_joints": Plan((100, 150), arms=("seven",)),
    "five_joints": Plan((100, 150), arms=("five",)),
    "scara": Plan((80, 120), arms=("scara",)),
    "markers14": Plan((14, 14), sensor=_marker, arms=_OF_MARKERS, verbs=_ONLY_CALIBRATE, is_marker=True),
    "markers30": Plan((30, 30), sensor=_marker, arms=_OF_MARKERS, verbs=_ONLY_CALIBRATE, is_marker=True),
}
PLAN_KINDS = tuple(PLANS)


@dataclass(frozen=True, eq=False)
class PlanCase:
    """A table and what is true of it.

    Attributes:
        kind: one of ``PLANS``.
        seed: of everything.
        arm: class of arms.
        scene: machine and sensor.
        region: where the poses of the plan are.
        rows: the table.
        options: as those of the command; the noise is declared or not.
        trouble: what goes wrong.
        stop: the stop of each row, shape (N,).
        line: line of the table from which on something is other than before; None where there is none.
        wrong: lines of the wrong readings.
        arrival: how drives arrive [rad or m].
    """

    kind: str
    seed: int
    arm: str
    scene: Scene
    region: Region
    rows: Measurements
    options: Options
    trouble: Trouble
    stop: np.ndarray
    line: int | None
    wrong: tuple[int, ...]
    arrival: float

    @property
    def plan(self) -> Plan:
        """How the table came about."""
        return PLANS[self.kind]

    @property
    def is_declared(self) -> bool:
        """Whether the noise is declared."""
        return self.options.sigma is not None

    def rng(self, purpose: int) -> np.random.Generator:
        """Return a generator for something other than the table."""
        return np.random.default_rng([self.seed, crc32(self.kind.encode()), purpose])

    def fresh(self, q: np.ndarray, rng: np.random.Generator) -> Fresh:
        """Return poses never measured, as a table of what each is, and the truth there.

        What is read is a single reading; the mean is of as many readings and visits as a pose of the table has.
        """
        scene, load = self.scene, np.full(len(q), self.scene.load)
        machine = scene.machine.with_effects(*self.trouble.effects)
        hall, targets = scene.frames
        names = np.array(list(targets))[rng.integers(0, len(targets), len(q))]

        def read(q: np.ndarray, approach: np.ndarray) -> np.ndarray:
            tip = machine.tip(q, payload=load, payload_com=scene.arm.com, approach=approach)
            return (hall @ tip @ np.array([targets[name] for name in names]))[:, :3, 3]

        # Between the two sides from which it may come, and then as it does arrive.
        clean = read(q, np.zeros(q.shape))
        arrived = read(q + self.arrival * rng.standard_normal(q.shape), rng.choice([-1.0, 1.0], q.shape))
        noise = scene.sigma.get("position", 0.0) * rng.standard_normal(clean.shape)
        visits = (self.stop[-1] + 1) / len(np.unique(self.rows.q, axis=0))
        of_visits, of_readings = np.sqrt(visits), np.sqrt(visits * self.plan.readings)
        mean = clean + (arrived - clean) / of_visits + noise / of_readings
        payload = {"payload": load} if scene.load else {}
        table = measurements_from_arrays(scene.nominal.names, q, position=clean, target=names, **payload)
        return Fresh(table, clean, arrived, arrived + noise, mean)

    def measured_again(self) -> Measurements:
        """Return a table of the same robot, unchanged, with the sensor elsewhere: as many readings of each of few stops."""
        rng = self.rng(2)
        arm = _ARMS[self.arm]
        setup, sigma = self.plan.sensor(rng, self.scene.machine, arm)
        scene = replace(self.scene, setup=setup, sigma=sigma)
        region = self.plan.region(scene, rng)
        plan = replace(self.plan, poses=(_CHECKED, _CHECKED))
        return _taken(scene, plan, region, self.arrival, rng).rows

    def means(self) -> Measurements:
        """Return the table with the mean of the readings of each stop as a row."""
        first = np.unique(self.stop, return_index=True)[1]
        position = np.array([self.rows.position[self.stop == stop].mean(axis=0) for stop in self.stop[first]])
        return self.rows.select(first).with_readings(position=position)


class Fresh(NamedTuple):
    """Poses never measured: their table, and where the target is.

    Attributes:
        table: the poses.
        clean: where drives arrive exactly [m], shape (N, 3).
        arrived: as they do arrive.
        read: as it is read once.
        mean: in the mean of what a pose of a plan has.
    """

    table: Measurements
    clean: np.ndarray
    arrived: np.ndarray
    read: np.ndarray
    mean: np.ndarray


def draw_plan_case(
    kind: str, seed: int, *, arrival: float = ARRIVAL, arm: str | None = None, poses: int | None = None
) -> PlanCase:
    """Draw a table.

    Args:
        kind: one of ``PLANS``.
        seed: of everything.
        arrival: standard deviation with which each drive arrives at a stop [rad, prismatic m].
        arm: class of arms; in turn unless given.
        poses: different poses; drawn unless given.
    """
    rng = np.random.default_rng([seed, crc32(kind.encode())])
    plan = PLANS[kind]
    if poses is not None:
        plan = replace(plan, poses=(poses, poses))
    name = plan.arms[seed % len(plan.arms)] if arm is None else arm
    spec = _ARMS[name]
    machine, robot = _machine(rng, spec)
    setup, sigma = plan.sensor(rng, machine, spec)
    has_load = rng.random() < _LOADED and plan.trouble is not _unrecorded_load
    scene = Scene(machine, robot, spec, setup, sigma, spec.load if has_load else 0.0)
    region = plan.region(scene, rng)
    taken = _taken(scene, plan, region, arrival, rng)
    options = Options(moment_frame="auto", payload_centre=spec.com if has_load else (0.0, 0.0, 0.0))
    if isinstance(setup, sim.EyeInHand):
        known = {point: tuple(place.tolist()) for point, place in setup.points.items()}
        options = replace(options, setup=Setup(points=known))
    if seed % 2:
        options = replace(options, sigma=next(iter(sigma.values())), sigma_orientation=sigma.get("quaternion"))
    about = (scene, region, taken.rows, options, taken.trouble, taken.stop, taken.line, taken.wrong, arrival)
    return PlanCase(kind, seed, name, *about)


class _Taken(NamedTuple):
    """A table, what went wrong, the stop of each row, the line of a change, and those of wrong readings."""

    rows: Measurements
    trouble: Trouble
    stop: np.ndarray
    line: int | None
    wrong: tuple[int, ...]


def _taken(scene: Scene, plan: Plan, region: Region, arrival: float, rng: np.random.Generator) -> _Taken:
    """Run a plan."""
    poses = region.measured(int(rng.integers(plan.poses[0], plan.poses[1] + 1)), rng)
    visits = plan.visits(len(poses))
    q, nothing = poses[visits.pose], np.zeros((len(visits.pose), 3))
    payload = np.full(len(q), scene.load)
    trouble = plan.trouble(scene, Stops(q, visits.turn, np.zeros(q.shape), payload, None, nothing), arrival, rng)
    stop, read = _read(scene, trouble, arrival, rng)
    # Each stop again and again, without a move.
    of_stops = np.split(np.arange(len(stop)), np.flatnonzero(np.diff(stop)) + 1)
    often = np.concatenate([np.tile(rows, plan.readings) for rows in of_stops])
    often = often[rng.random(len(often)) >= plan.missing]
    stop, read = stop[often], {name: values[often] for name, values in read.items()}
    read = {name: _noisy(name, values, scene.sigma, rng) for name, values in read.items()}
    wrong = np.sort(rng.permutation(len(stop))[: round(trouble.wrong * len(stop))])
    if len(wrong):
        away = rng.standard_normal((len(wrong), 3))
        read["position"][wrong] += trouble.size * away / np.linalg.norm(away, axis=1, keepdims=True)
    columns: dict[str, np.ndarray] = {"payload": payload[stop]} if scene.load else {}
    if rng.random() < _TIMED:
        since = np.arange(len(stop)) - np.searchsorted(stop, stop)
        columns["time"] = _STOP_TIME * stop + _READING_TIME * since
    rows = measurements_from_arrays(scene.nominal.names, q[stop], **read, **columns)
    first = trouble.first
    line = int(rows.rows[np.argmax(stop >= first)]) if first >= 0 else None
    return _Taken(rows, trouble, stop, line, tuple(int(number) for number in rows.rows[wrong]))


def _read(
    scene: Scene, trouble: Trouble, arrival: float, rng: np.random.Generator
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the stop of each row, and the columns that the sensor reads without noise, by the names of Measurements."""
    stops, machine = trouble.stops, scene.machine.with_effects(*trouble.effects)
    arrived = stops.q + stops.offset + arrival * rng.standard_normal(stops.q.shape)
    conditions = {"payload": stops.payload, "payload_com": scene.arm.com, "approach": stops.approach}
    reading = scene.setup._read(machine, machine.poses(arrived, **conditions), None)
    seen = reading.columns
    found: dict[str, np.ndarray] = {name: seen[name] for name in ("target", "point") if name in seen}
    for name, axes in _COLUMNS.items():
        if axes[0] in seen:
            found[name] = np.column_stack([seen[axis] for axis in axes])
    if "position" in found:
        found["position"] = found["position"] + stops.shift[reading.rows]
    return reading.rows, found


_COLUMNS = {
    "position": ("x", "y", "z"),
    "quaternion": ("qx", "qy", "qz", "qw"),
    "camera_point": ("cx", "cy", "cz"),
    "pixel": ("u", "v"),
}


def _noisy(name: str, values: np.ndarray, sigma: dict[str, float], rng: np.random.Generator) -> np.ndarray:
    """Return a column as it is read."""
    if name not in sigma:
        return values
    if name == "quaternion":
        turn = Rotation.from_rotvec(sigma[name] * rng.standard_normal((len(values), 3)))
        return (turn * Rotation.from_quat(values)).as_quat()
    return values + sigma[name] * rng.standard_normal(values.shape)
