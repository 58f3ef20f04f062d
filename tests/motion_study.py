"""What an IMU on the flange and a tracker in motion tell of simulated arms: ``python tests/motion_study.py``.

A Gauss-Newton fit of a hundred lines on the library's model, its sensor of IMUs, paths and clocks; the truth comes from the
simulator, which shares no code with them. It prints how far the axes are off that were found, what intervals cover, and how
long an evaluation takes.
"""

from __future__ import annotations

import argparse
import time as clock_of_wall
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.measure.sensors.imu import ImuErrors, Inertial, Window, imu_parameters, inertial_columns
from pincal.model.catalogue import InstrumentClock
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions, nominal_moments
from pincal.model.effect import Effect
from pincal.model.effects import ELASTIC, GEOMETRIC, BaseFrame, ToolFrame
from pincal.model.model import Model
from pincal.motion.clocks import Clock
from pincal.motion.imu_rows import ImuRows
from pincal.motion.joint_path import JointPath
from pincal.motion.moving_arm import MovingArm, level_chain
from pincal.motion.sessions import stream_of
from pincal.motion.starts import start_imu, start_positions
from pincal.parameters import FRAME_SYMBOLS, Parameter
from pincal.robot.robot import Robot
from pincal.robot.se3 import align, nearest_rotation
from pincal.robot.urdf_file import find_file
from pincal.simulate.moving import draw_path
from pincal.simulate.session import Clock as TrueClock
from pincal.simulate.session import ImuSetup, MovingSession
from pincal.simulate.typical import draw_typical_elasticity, draw_typical_errors
from pincal.units import STANDARD_GRAVITY

# Noise of the IMU: 1 mg/sqrt(Hz) and 0.01 deg/s/sqrt(Hz).
ACC_DENSITY, GYRO_DENSITY = 1e-3 * STANDARD_GRAVITY, np.deg2rad(0.01)
# Of the tracker [m].
TRACKER = 3e-5
G = (0.0, 0.0, -STANDARD_GRAVITY)
ARMS = {"kuka (6R)": (kuka_urdf_path, "tool0"), "panda (7R)": (lambda: find_file("panda"), "panda_hand_tcp")}
# Rows of a piece, and standard deviation of a window [s].
PIECE, WIDTH = 1000, 0.03


@dataclass(frozen=True)
class Truth:
    """A machine, its session, and what was logged of it."""

    robot: Robot
    machine: sim.TrueMachine
    session: MovingSession
    tables: dict[str, dict[str, np.ndarray]]

    @classmethod
    def draw(
        cls, name: str, seed: int, *, duration: float, elastic: float = 0.0, tracker: bool = False, **imu: float
    ) -> Truth:
        """Draw a machine, a path and what logs it."""
        urdf, tip = ARMS[name]
        rng = np.random.default_rng([seed, 31])
        robot = Robot.from_urdf(urdf(), tip=tip)
        machine = sim.TrueMachine.from_urdf(
            robot.urdf.decode(), tip=robot.tip, base=robot.base, gravity=G, moment_frame="after"
        )
        machine = draw_typical_errors(machine, rng)
        if elastic:
            machine = draw_typical_elasticity(machine, rng, scale=elastic)
        path = draw_path(machine.nominal, duration, rng)
        given = {"acc_density": ACC_DENSITY, "gyro_density": GYRO_DENSITY} | imu
        session = MovingSession(
            path=path,
            duration=duration,
            imu=None if tracker else ImuSetup.draw(rng, **given),
            tracker=_tracker(machine, rng) if tracker else None,
            clocks={
                "imu": TrueClock.draw(rng, middle=0.5 * duration),
                "tracker": TrueClock.draw(rng, middle=0.5 * duration),
            },
            resolution=2e-5,
            dropped=0.01,
        )
        return cls(robot, machine, session, session.measure(machine, rng))

    @cached_property
    def arm(self) -> MovingArm:
        """The arm on its path as it was logged."""
        joints = self.tables["joints"]
        path = JointPath.through(joints["time"], np.column_stack([joints[name] for name in self.robot.joint_names]))
        return MovingArm.of(self.robot, path)


def _tracker(machine: sim.TrueMachine, rng: np.random.Generator) -> sim.Instrument:
    from pincal.simulate.contact import draw_instrument, draw_targets

    targets = draw_targets(machine.nominal, 1, rng)
    return sim.Instrument(pose=draw_instrument(machine.nominal, rng), targets=next(iter(targets.values())), sigma=TRACKER)


@dataclass
class Session:
    """Rows of one instrument: a model, parameters of its own, a clock."""

    name: str
    arm: MovingArm
    model: Model
    own: tuple[Parameter, ...]
    clock: Clock

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """All of them, those of a session with its name; compliances bend by their size under the largest moment."""
        begin, end = self.arm.path.span
        moments = np.abs(nominal_moments(self.model.chain, self.arm.conditions(np.arange(begin, end, 1.0)))).max(axis=0)
        most = np.maximum(moments, 0.05 * moments.max())
        of_joint = {
            f"{name}.k_{axis}": 3 * i + "xyz".index(axis)
            for i, name in enumerate(self.arm.robot.joint_names)
            for axis in "xyz"
        }
        pairs = zip(self.model.parameters, self.model.of_station, strict=True)
        mine = [replace(p, name=f"{self.name}/{p.name}") for p in self.own]
        found = [replace(p, name=f"{self.name}/{p.name}") if own else p for p, own in pairs]
        return (*(replace(p, size=p.size / most[of_joint[p.name]]) if p.name in of_joint else p for p in found), *mine)

    def linearise(self, values: np.ndarray, free: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield residuals and Jacobian, shape (m, n) and (free, m, n), piece by piece, in units of their noise."""
        raise NotImplementedError

    def settle(self, values: np.ndarray, left: np.ndarray) -> np.ndarray:
        """Move clocks by what was found; return values without it."""
        values, names = values.copy(), [p.name for p in self.parameters]
        found = [f"{self.name}/instrument.clock_offset", f"{self.name}/instrument.clock_drift"]
        offset, drift = (names.index(name) for name in found)
        self.clock = self.clock.moved(float(values[offset]), float(values[drift]))
        values[[offset, drift]] = 0.0
        return values


@dataclass
class ImuSession(Session):
    """Rows of an IMU."""

    stamps: np.ndarray = field(default_factory=lambda: np.zeros(0))
    force: np.ndarray = field(default_factory=lambda: np.zeros(0))
    rate: np.ndarray = field(default_factory=lambda: np.zeros(0))
    delay: float = 0.0
    scatter: np.ndarray = field(default_factory=lambda: np.ones(2))

    @classmethod
    def of(cls, truth: Truth, effects: Sequence[Effect]) -> ImuSession:
        """Find clock and mount by the rates of the nominal arm, and put together the model."""
        table, arm = truth.tables["imu"], truth.arm
        force, rate = (np.column_stack([table[letter + axis] for axis in "xyz"]) for letter in "aw")
        stream = stream_of("imu", table["time"], {"specific_force": force, "angular_rate": rate})
        found = start_imu(arm, stream, window=Window(WIDTH))
        chain = level_chain(Chain.of(arm.robot, gravity=np.array(G), moment_frame="after"))
        chain = chain.with_references(chain.base_rotation, found.mount[None])
        own = (BaseFrame(("rx", "ry")), ToolFrame(FRAME_SYMBOLS), InstrumentClock(found.clock.middle))
        model = Model(chain, (*effects, *own))
        return cls("imu", arm, model, imu_parameters(), found.clock, stream.time, force, rate)

    @cached_property
    def rows(self) -> ImuRows:
        """The filtered readings that the path covers."""
        rows = ImuRows.of(self.stamps, self.force, self.rate, Window(WIDTH), delay=self.delay)
        return rows.select(self.arm.path.covers(self.clock.to_joints(rows.time), 4.0 * WIDTH))

    def linearise(self, values: np.ndarray, free: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield weighted residuals and Jacobian."""
        P, window = self.model.n_parameters, self.rows.window
        errors = ImuErrors.of(values[P:])
        for k in range(0, len(self.rows), PIECE):
            rows = self.rows.select(np.arange(k, min(k + PIECE, len(self.rows))))
            conditions = self.arm.conditions(self.clock.to_joints(rows.time), window.offsets)
            # The drift is of the stamps, and stands still within a window.
            conditions = replace(conditions, time=np.repeat(rows.time, len(window.offsets)))
            poses, motion = self.model.linearise(values[:P], conditions, free=free[:P], rows=6)
            ideal = Inertial.of(poses, window, STANDARD_GRAVITY)
            columns = errors.columns(*inertial_columns(poses, motion.transpose(2, 1, 0), window, STANDARD_GRAVITY))
            columns = np.concatenate([columns, errors.own_columns(ideal)[free[P:]]])
            weights = np.repeat(1.0 / (rows.sigma * self.scatter[:, None]), 3, axis=0)
            yield (rows.readings - errors.readings(ideal)) * weights, columns * weights

    def settle(self, values: np.ndarray, left: np.ndarray) -> np.ndarray:
        """Move the clock and the gyroscope's delay by what was found; take the noise to be what was left."""
        self.scatter = self.scatter * [_scatter(left[:3]), _scatter(left[3:])]
        values = super().settle(values, left)
        self.delay += float(values[-1])
        values[-1] = 0.0
        self.__dict__.pop("rows", None)
        return values


def _scatter(left: np.ndarray) -> float:
    """Return by how much noise is larger than was thought, the correlation of neighbouring rows counted."""
    centred = left - left.mean(axis=1, keepdims=True)
    square = np.mean(centred**2)
    alike = [np.mean(centred[:, k:] * centred[:, :-k]) / square for k in range(1, 4)]
    return float(np.sqrt(square * max(1.0 + 2.0 * sum(alike), 0.1)))


@dataclass
class TrackerSession(Session):
    """Positions of a tracker in motion, or held."""

    stamps: np.ndarray = field(default_factory=lambda: np.zeros(0))
    position: np.ndarray = field(default_factory=lambda: np.zeros(0))
    held: Conditions | None = None

    @classmethod
    def of(cls, truth: Truth, effects: Sequence[Effect]) -> TrackerSession:
        """Find clock, base and tool by the nominal arm."""
        table, arm = truth.tables["tracker"], truth.arm
        position = np.column_stack([table[axis] for axis in "xyz"])
        found = start_positions(arm, stream_of("tracker", table["time"], {"position": position}), position)
        chain = Chain.of(arm.robot, gravity=np.array(G), moment_frame="after").with_references(found.base, np.eye(3)[None])
        own = (BaseFrame(), ToolFrame(), InstrumentClock(found.clock.middle))
        session = cls("tracker", arm, Model(chain, (*effects, *own)), (), found.clock, table["time"], position)
        places = (*found.origin, *found.target)
        names = [f"{element}.{axis}" for element in ("base", "tool") for axis in "xyz"]
        session.start = dict(zip(names, places, strict=True))
        return session

    start: dict[str, float] = field(default_factory=dict)

    def linearise(self, values: np.ndarray, free: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield weighted residuals and Jacobian."""
        at = self.clock.to_joints(self.stamps)
        rows = np.flatnonzero(self.arm.path.covers(at) if self.held is None else np.ones(len(at), bool))
        for k in range(0, len(rows), 4096):
            some = rows[k : k + 4096]
            conditions = (
                replace(self.arm.conditions(at[some]), time=self.stamps[some])
                if self.held is None
                else self.held.select(some)
            )
            poses, motion = self.model.linearise(values, conditions, free=free)
            yield (self.position[some].T - poses[:, :, 3].T) / TRACKER, motion.transpose(2, 1, 0) / TRACKER


@dataclass(frozen=True)
class Fit:
    """Values by name, their covariance, and how it went."""

    names: list[str]
    values: np.ndarray
    covariance: np.ndarray
    chi_square: float
    readings: int
    steps: int
    seconds: float


# Lengths that are held: the IMU does not see them.
LENGTHS = ("d", "a")


def fit(sessions: Sequence[Session], *, held: Sequence[str] = LENGTHS, rounds: int = 12) -> Fit:
    """Return the fit of sessions of one robot, clocks moved between the steps."""
    names = list(dict.fromkeys(p.name for session in sessions for p in session.parameters))
    known = {p.name: p for session in sessions for p in session.parameters}
    sizes = np.array([known[name].size for name in names])
    free = np.array([name.rsplit(".", 1)[-1] not in held or "/" in name for name in names])
    values = np.zeros(len(names))
    for session in sessions:
        for name, value in getattr(session, "start", {}).items():
            values[names.index(f"{session.name}/{name}")] = value
    begin = clock_of_wall.process_time()
    steps = 0
    while steps < rounds:
        steps += 1
        H, g = np.diag(1.0 / sizes**2), -values / sizes**2
        H[~np.isfinite(H)] = 0.0
        left: list[list[np.ndarray]] = [[] for _ in sessions]
        for session, own in zip(sessions, left, strict=True):
            place = np.array([names.index(p.name) for p in session.parameters])
            at = place[free[place]]
            for residuals, columns in session.linearise(values[place], free[place]):
                J = columns.reshape(len(columns), -1)
                H[np.ix_(at, at)] += J @ J.T
                g[at] += J @ residuals.ravel()
                own.append(residuals)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(H)[free], 1e-300))
        inverse = np.linalg.inv(H[np.ix_(free, free)] * scale * scale[:, None])
        change = scale * (inverse @ (scale * g[free]))
        values[free] += change
        rows = [np.concatenate(own, axis=1) for own in left]
        for session, own_rows in zip(sessions, rows, strict=True):
            place = np.array([names.index(p.name) for p in session.parameters])
            values[place] = session.settle(values[place], own_rows)
        if np.max(np.abs(change) / (scale * np.sqrt(np.diag(inverse)))) < 0.02:
            break
    covariance = np.zeros((len(names), len(names)))
    covariance[np.ix_(free, free)] = inverse * scale * scale[:, None]
    total, count = sum(float(np.sum(own**2)) for own in rows), sum(own.size for own in rows)
    return Fit(names, values, covariance, total, count, steps, clock_of_wall.process_time() - begin)


def axis_errors(truth: Truth, found: Fit, effects: Sequence[Effect], n: int = 200) -> np.ndarray:
    """Return the rms angle between found and true axes as the tool sees them, shape (joints,) [rad].

    In random poses within the path's ranges, the tool turned so that they agree best: what no IMU can tell does not count.
    """
    rng, robot = np.random.default_rng(0), truth.robot
    q = truth.session.path.at(rng.uniform(0.0, truth.session.duration, n))
    model = Model(Chain.of(robot, gravity=np.array(G), moment_frame="after"), tuple(effects))
    values = np.array([found.values[found.names.index(name)] for name in model.names])

    def in_tool(tip: np.ndarray, others: np.ndarray) -> np.ndarray:
        turned = np.swapaxes(tip[:, :3, :3], 1, 2) @ others[:, :3, :3]
        return np.stack(
            [turned[:, 2, 1] - turned[:, 1, 2], turned[:, 0, 2] - turned[:, 2, 0], turned[:, 1, 0] - turned[:, 0, 1]], 1
        )

    ours, theirs = [], []
    for j in range(robot.n_joints):
        moved = q.copy()
        moved[:, j] += 0.5
        conditions = [Conditions.at(at) for at in (q, moved)]
        ours.append(in_tool(*(model.predict(values, c) for c in conditions)))
        theirs.append(in_tool(*(truth.machine.tip(at) for at in (q, moved))))
    a, b = (np.array([axes / np.linalg.norm(axes, axis=1, keepdims=True) for axes in both]) for both in (ours, theirs))
    R = nearest_rotation(np.einsum("jna,jnb->ab", b, a))
    angle = np.linalg.norm(a @ R.T - b, axis=2)
    return np.sqrt(np.mean(angle**2, axis=1))


def clock_error(truth: Truth, session: Session) -> float:
    """Return the largest difference of a found clock and the true one [s]."""
    stamps = np.linspace(0.0, truth.session.duration, 100)
    return float(np.abs(session.clock.to_joints(stamps) - truth.session.clocks[session.name].to_joints(stamps)).max())


def turned_between(model: Model, values: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotations between two poses of an IMU in its own axes, shape (K, 3, 3), and their Jacobian, (3 K, P).

    They are what it sees of an arm: neither the place of the base nor the offsets of the first and last joint are in them.

    Args:
        model: the model of the IMU's station.
        values: of its parameters.
        q: joint positions, shape (K, 2, n).
    """
    poses, J = model.linearise(values, Conditions.at(q.reshape(-1, q.shape[2])), rows=6)
    R, J = poses[:, :, :3].reshape(-1, 2, 3, 3), J[:, 3:].reshape(len(q), 2, 3, -1)
    turns = np.swapaxes(R[:, 1], 1, 2) @ (J[:, 1] - J[:, 0])
    return np.swapaxes(R[:, 0], 1, 2) @ R[:, 1], turns.reshape(-1, turns.shape[2])


def coverage(name: str, seed: int, duration: float, draws: int) -> tuple[np.ndarray, np.ndarray]:
    """Return in how many of so many draws of noise 95 % intervals cover: of rotations (each of 150) and of the clock."""
    truth = Truth.draw(name, seed, duration=duration, acc_density=0.0, gyro_density=0.0)
    first, rng = ImuSession.of(truth, GEOMETRIC), np.random.default_rng([seed, 77])
    imu = truth.session.imu
    assert imu is not None
    q = truth.session.path.at(rng.uniform(0.0, duration, 100)).reshape(50, 2, -1)
    tips = np.stack([truth.machine.tip(q[:, k]) @ imu.mount for k in range(2)])[:, :, :3, :3]
    expected = np.swapaxes(tips[0], 1, 2) @ tips[1]
    of_turns, of_clock = [], []
    for _ in range(draws):
        white = rng.standard_normal((2, *first.force.shape)) * np.sqrt(50.0)
        session = replace(first, force=first.force + ACC_DENSITY * white[0], rate=first.rate + GYRO_DENSITY * white[1])
        found = fit([session])
        P = session.model.n_parameters
        R, J = turned_between(session.model, found.values[:P], q)
        off = Rotation.from_matrix(np.swapaxes(R, 1, 2) @ expected).as_rotvec().ravel()
        sigma = np.sqrt(np.einsum("ip,pq,iq->i", J, found.covariance[:P, :P], J))
        of_turns.append(np.mean(np.abs(off) < 1.96 * sigma))
        k = found.names.index("imu/instrument.clock_offset")
        off = session.clock.to_joints(session.clock.middle) - truth.session.clocks["imu"].to_joints(session.clock.middle)
        of_clock.append(abs(float(off)) < 1.96 * np.sqrt(found.covariance[k, k]))
    return np.array(of_turns), np.array(of_clock)


def against_held(name: str, seed: int, duration: float) -> None:
    """Print what positions of a tracker tell while the arm moves, against as many of held poses."""
    truth = Truth.draw(name, seed, duration=duration, tracker=True)
    session = TrackerSession.of(truth, GEOMETRIC)
    start = clock_error(truth, session)
    found = fit([session], held=())
    n = len(session.model.names)
    rng = np.random.default_rng(seed)
    q = truth.session.path.at(rng.uniform(0.0, duration, 300))
    target = truth.session.tracker.targets[""]
    expected = truth.session.tracker.pose @ truth.machine.tip(q) @ target
    poses, J = session.model.linearise(found.values, Conditions.at(q))
    off = np.linalg.norm(poses[:, :, 3] - expected[:, :3, 3], axis=1)
    sigma = np.sqrt(np.einsum("nip,pq,niq->n", J, found.covariance[:n, :n], J))
    rows = np.arange(0, len(session.stamps), 25)
    some = replace(session, stamps=session.stamps[rows], position=session.position[rows])
    held = {
        "the path's own poses": truth.session.path.at(rng.uniform(0.0, duration, len(rows))),
        "random poses": sim.plan_poses(truth.machine.nominal, len(rows), rng),
    }
    v = found.values
    sizes = [
        np.sqrt(np.einsum("nip,pq,niq->n", J, C, J))
        for C in (_covariance(some, v), *(_covariance(some, v, q) for q in held.values()))
    ]
    ratios = ", ".join(f"{what} {np.mean(sizes[0]) / np.mean(size):.3f}" for what, size in zip(held, sizes[1:], strict=True))
    print(
        f"{name}, seed {seed}: {len(session.stamps)} positions in {duration:.0f} s: off by {1e3 * np.mean(off):.4f} mm mean "
        f"(sigma {1e3 * np.mean(sigma):.4f}), clock {1e3 * clock_error(truth, session):.4f} ms (start {1e3 * start:.2f}), "
        f"chi-square {found.chi_square / found.readings:.3f}, {found.steps} steps, {found.seconds:.1f} s; standard "
        f"deviation of a prediction over that of as many held poses: {ratios}"
    )


def together(name: str, seed: int, duration: float, counts: Sequence[int] = (6, 8, 10, 25)) -> None:
    """Print what a few held poses before a tracker tell, alone and beside an IMU, by errors elsewhere."""
    truth = Truth.draw(name, seed, duration=duration)
    rng, robot = np.random.default_rng([seed, 5]), truth.robot
    tracker = _tracker(truth.machine, rng)
    q, far = (sim.plan_poses(truth.machine.nominal, n, rng) for n in (max(counts), 300))
    seen, expected = ((tracker.pose @ truth.machine.tip(at) @ tracker.targets[""])[:, :3, 3] for at in (q, far))
    seen = seen + TRACKER * rng.standard_normal(seen.shape)
    imu = ImuSession.of(truth, GEOMETRIC)
    found = []
    for n in counts:
        conditions = replace(Conditions.at(q[:n]), time=np.zeros(n))
        R, origin = align(robot.forward_kinematics(q[:n])[:, :3, 3], seen[:n])
        chain = Chain.of(robot, gravity=np.array(G), moment_frame="after").with_references(R, np.eye(3)[None])
        model = Model(chain, (*GEOMETRIC, BaseFrame(), ToolFrame(), InstrumentClock()))
        poses = TrackerSession("tracker", truth.arm, model, (), Clock(), np.zeros(n), seen[:n], held=conditions)
        poses.start = dict(zip(("base.x", "base.y", "base.z"), origin, strict=True))
        errors = []
        for sessions in ([poses], [poses, replace(imu, scatter=np.ones(2))]):
            values = fit(sessions, held=())
            at = np.array([values.names.index(p.name) for p in poses.parameters])
            tips = model.predict(values.values[at], Conditions.at(far))[:, :, 3]
            errors.append(1e3 * float(np.mean(np.linalg.norm(tips - expected, axis=1))))
        found.append(f"{n}: {errors[0]:.3f} -> {errors[1]:.3f}")
    print(f"{name}, seed {seed}: mean error [mm] by tracker poses, alone -> with the IMU: {', '.join(found)}")


def _covariance(session: TrackerSession, values: np.ndarray, q: np.ndarray | None = None) -> np.ndarray:
    """Return the covariance that the rows of a path give, or as many in poses that are held, without any clock."""
    free = np.ones(len(session.parameters), bool)
    if q is not None:
        conditions = Conditions.at(q)
        session = replace(session, held=replace(conditions, time=np.zeros(len(q))))
        free = np.array(["clock" not in p.name for p in session.parameters])
    H = np.diag([1.0 / p.size**2 for p, is_free in zip(session.parameters, free, strict=True) if is_free])
    for _, columns in session.linearise(values, free):
        H += columns.reshape(len(columns), -1) @ columns.reshape(len(columns), -1).T
    scale = 1.0 / np.sqrt(np.diag(H))
    out = np.zeros((len(free), len(free)))
    out[np.ix_(free, free)] = np.linalg.inv(H * scale * scale[:, None]) * scale * scale[:, None]
    return out


def timed(name: str) -> None:
    """Print how long one evaluation takes, residuals and Jacobian: 10 minutes of an IMU and of a tracker at 250 Hz."""
    truth = Truth.draw(name, 0, duration=600.0, tracker=True)
    begin = clock_of_wall.process_time()
    arm = truth.arm
    path = clock_of_wall.process_time() - begin
    tracker = TrackerSession.of(truth, GEOMETRIC)
    aligned_in = clock_of_wall.process_time() - begin - path
    stamps = np.arange(0.0, 600.0, 0.01)
    ideal = arm.ideal(stamps)
    tables = {"imu": {"time": stamps} | {f"a{x}": v for x, v in zip("xyz", ideal.force.T, strict=True)}
              | {f"w{x}": v for x, v in zip("xyz", ideal.rate.T, strict=True)}}  # fmt: skip
    begin = clock_of_wall.process_time()
    imu = ImuSession.of(replace(truth, tables=truth.tables | tables), GEOMETRIC)
    imu_in = clock_of_wall.process_time() - begin
    found = fit([imu, tracker], held=())
    print(
        f"{name}, processor time: path {path:.2f} s, clock of the tracker {aligned_in:.2f} s, of the IMU {imu_in:.2f} s, "
        f"fit of both {found.seconds:.2f} s in {found.steps} steps; sum {path + aligned_in + imu_in + found.seconds:.2f} s"
    )
    for session in (imu, tracker):
        free = np.array([p.name.rsplit(".", 1)[-1] not in LENGTHS or "/" in p.name for p in session.parameters])
        for effects in (GEOMETRIC, ELASTIC):
            session.model = replace(session.model, effects=(*effects, *session.model.effects[-3:]))
            session.__dict__.pop("parameters", None)
            free = np.array([p.name.rsplit(".", 1)[-1] not in LENGTHS or "/" in p.name for p in session.parameters])
            values, best = np.zeros(len(free)), np.inf
            for _ in range(3):
                begin = clock_of_wall.process_time()
                H, rows = np.zeros((free.sum(), free.sum())), 0
                for residuals, columns in session.linearise(values, free):
                    H, rows = (
                        H + columns.reshape(len(columns), -1) @ columns.reshape(len(columns), -1).T,
                        rows + residuals.shape[1],
                    )
                best = min(best, clock_of_wall.process_time() - begin)
            print(
                f"  {session.name}, {free.sum()} parameters: {rows} rows in {best:.2f} s, {1e6 * best / rows:.1f} us a row"
            )


def one(name: str, seed: int, duration: float, elastic: float, vibration: float) -> None:
    """Print what the IMU of one session tells."""
    truth = Truth.draw(name, seed, duration=duration, elastic=elastic, vibration=vibration)
    effects = ELASTIC if elastic else GEOMETRIC
    session = ImuSession.of(truth, effects)
    start = clock_error(truth, session)
    found = fit([session])
    errors = 1e3 * axis_errors(truth, found, effects)
    before = 1e3 * axis_errors(truth, replace(found, values=0.0 * found.values), effects)
    print(
        f"{name}, seed {seed}: axes {np.array2string(errors, precision=3)} mrad (nominal {before.max():.1f}), clock "
        f"{1e3 * clock_error(truth, session):.3f} ms (start {1e3 * start:.2f}), delay off by "
        f"{1e3 * (session.delay - truth.session.imu.delay):.3f} ms, chi-square {found.chi_square / found.readings:.3f}, "
        f"{len(session.rows)} rows, {found.steps} steps, {found.seconds:.1f} s"
    )


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--duration", type=float, default=300.0)
    parser.add_argument("--elastic", type=float, default=0.0)
    parser.add_argument("--vibration", type=float, default=0.0)
    parser.add_argument("--draws", type=int, default=0, help="of noise, for the coverage of intervals")
    parser.add_argument("--tracker", action="store_true", help="a tracker in motion against held poses")
    parser.add_argument("--together", action="store_true", help="a few tracker poses beside an IMU")
    parser.add_argument("--time", action="store_true", help="one evaluation of ten minutes")
    given = parser.parse_args()
    for name in ARMS:
        if given.time:
            timed(name)
            continue
        for seed in range(given.seeds):
            if given.tracker:
                against_held(name, seed, given.duration)
            elif given.together:
                together(name, seed, given.duration)
            elif given.draws:
                turns, clocks = coverage(name, seed, given.duration, given.draws)
                spread = turns.std() / len(turns) ** 0.5
                print(f"{name}, seed {seed}: rotations {turns.mean():.3f} +- {spread:.3f}, clock {clocks.mean():.2f}")
            else:
                one(name, seed, given.duration, given.elastic, given.vibration)


if __name__ == "__main__":
    main()
