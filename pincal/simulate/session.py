"""Sessions in motion: logs of joints, IMU and instrument, each with its own clock, while the arm
follows a path.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.arm import Arm, transform
from pincal.simulate.camera import EyeInHand
from pincal.simulate.instrument import CellCamera
from pincal.simulate.machine import TrueMachine
from pincal.simulate.moving import (
    FourierPath,
    Motion,
    ViaPath,
    conditions_along,
    draw_path,
    tip_motion,
)
from pincal.simulate.setup import SensorSetup, Table

# Largest random offset [s] and drift [1] of a clock.
_OFFSET = 2.0
_DRIFT = 1e-4
# Standard deviations of low-cost IMUs' errors: scale and misalignment [1], biases [m/s^2, rad/s],
# delay [s].
_SCALE = 5e-3
_BIAS = 0.2
_RATE_BIAS = 5e-3
_DELAY = 3e-3
# Noise densities: 1 mg/sqrt(Hz) and 0.01 deg/s/sqrt(Hz).
_ACC_DENSITY = 9.80665e-3
_GYRO_DENSITY = 1.7453e-4
# Distance of an IMU from the tip along each axis, at most [m].
_LEVER = 0.06
# Vibration modes of an arm [Hz], their damping ratio, and the distance of their centre of rotation
# from the IMU [m].
_MODES = (11.0, 19.0, 31.0)
_DAMPING = 0.03
_FULCRUM = 0.5
# Time for a camera to move from one view of its object to the next [s].
_VIEW = 3.0
# Rows that a logger loses at once.
_BURST = 4


@dataclass(frozen=True)
class Clock:
    """A clock: its time t is the joints' time t + offset + drift (t - middle), in s."""

    offset: float = 0.0
    drift: float = 0.0
    middle: float = 0.0

    @classmethod
    def draw(cls, rng: np.random.Generator, *, middle: float, drift: float | None = None) -> Clock:
        """Draw a clock that was started by hand; its drift is drawn unless given."""
        drawn = float(rng.uniform(-_DRIFT, _DRIFT))
        return cls(float(rng.uniform(-_OFFSET, _OFFSET)), drawn if drift is None else drift, middle)

    def to_joints(self, time: np.ndarray) -> np.ndarray:
        """Return times of this clock as times of the joints' clock [s]."""
        return np.asarray(time + self.offset + self.drift * (time - self.middle))


@dataclass(frozen=True, kw_only=True)
class ImuSetup:
    """An IMU on the tool: a_read = acc_matrix f + acc_bias, and likewise for the angular rate.

    Attributes:
        mount: Transform from the IMU's frame to the tip, shape (4, 4).
        acc_matrix, gyro_matrix: Scale, misalignment and cross-coupling, shape (3, 3).
        acc_bias, gyro_bias: [m/s^2, rad/s], shape (3,).
        delay: Time by which the time stamps of the rate are too early [s].
        acc_density, gyro_density: Noise [m/s^2/sqrt(Hz), rad/s/sqrt(Hz)].
        vibration: Vibration of the arm at full speed, rms along each axis [m/s^2].
    """

    mount: np.ndarray = field(default_factory=lambda: np.eye(4))
    acc_matrix: np.ndarray = field(default_factory=lambda: np.eye(3))
    gyro_matrix: np.ndarray = field(default_factory=lambda: np.eye(3))
    acc_bias: np.ndarray = field(default_factory=lambda: np.zeros(3))
    gyro_bias: np.ndarray = field(default_factory=lambda: np.zeros(3))
    delay: float = 0.0
    acc_density: float = 0.0
    gyro_density: float = 0.0
    vibration: float = 0.0

    @classmethod
    def draw(cls, rng: np.random.Generator, **given: Any) -> ImuSetup:
        """Draw a typical IMU in a random pose on the tool."""
        from scipy.spatial.transform import Rotation

        # A rotation of the accelerometer is part of the mount, so its matrix is triangular.
        lower = np.tril(_SCALE * rng.standard_normal((3, 3)))
        return cls(
            mount=transform(
                Rotation.random(rng=rng).as_matrix(), _LEVER * rng.uniform(-1.0, 1.0, 3)
            ),
            acc_matrix=np.eye(3) + lower,
            gyro_matrix=np.eye(3) + _SCALE * rng.standard_normal((3, 3)),
            acc_bias=_BIAS * rng.standard_normal(3),
            gyro_bias=_RATE_BIAS * rng.standard_normal(3),
            delay=_DELAY * float(rng.standard_normal()),
            **given,
        )

    def read(
        self,
        machine: TrueMachine,
        path: Motion,
        time: np.ndarray,
        *,
        rate: float,
        rng: np.random.Generator,
        conditions: Mapping[str, Any],
    ) -> Table:
        """Return the IMU's readings at times of the joints' clock [s], shape (N,), at a sampling
        rate [Hz].
        """
        motion = tip_motion(machine, path, time, **conditions)
        R = self.mount[:3, :3]
        lever = self.mount[:3, 3]
        gravity = np.einsum("nba,b->na", motion.T[:, :3, :3], np.asarray(machine.gravity, float))
        turned = np.cross(motion.turning, lever) + np.cross(
            motion.rate, np.cross(motion.rate, lever)
        )
        force = (motion.acceleration + turned - gravity) @ R
        later = (
            motion
            if self.delay == 0.0
            else tip_motion(machine, path, time + self.delay, **conditions)
        )
        shaken = self._shaken(path, time, rate, rng)
        white = rng.standard_normal((2, len(time), 3)) * np.sqrt(0.5 * rate)
        force = (
            (force + shaken[0]) @ self.acc_matrix.T + self.acc_bias + self.acc_density * white[0]
        )
        turning = (
            (later.rate @ R + shaken[1]) @ self.gyro_matrix.T
            + self.gyro_bias
            + self.gyro_density * white[1]
        )
        return dict(
            zip(("ax", "ay", "az", "wx", "wy", "wz"), np.hstack((force, turning)).T, strict=True)
        )

    def _shaken(
        self, path: Motion, time: np.ndarray, rate: float, rng: np.random.Generator
    ) -> np.ndarray:
        """Return vibrations that grow with speed: accelerations [m/s^2] and angular rates [rad/s],
        shape (2, N, 3).
        """
        from scipy.signal import lfilter

        speed = np.linalg.norm(path.at(time, 1), axis=1)
        envelope = (0.1 + speed / max(float(speed.max(initial=0.0)), 1e-12))[:, None]
        found = np.zeros((2, len(time), 3))
        for mode in _MODES if self.vibration else ():
            # Modes above half the sampling rate alias, as in decimated logs.
            angle = 2.0 * np.pi * mode / rate
            radius = np.exp(-_DAMPING * angle)
            for k, size in enumerate((1.0, 1.0 / (_FULCRUM * 2.0 * np.pi * mode))):
                poles = [1.0, -2.0 * radius * np.cos(angle), radius**2]
                wave = lfilter([1.0], poles, rng.standard_normal((len(time), 3)), axis=0)
                found[k] += size * self.vibration * wave / (wave.std() * np.sqrt(len(_MODES)))
        return np.asarray(found * envelope)

    def truth(self) -> dict[str, Any]:
        """Return its fields, for JSON."""
        return {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in vars(self).items()
        }


@dataclass(frozen=True, kw_only=True)
class SessionOptions:
    """Options of a session; the rest is drawn.

    Attributes:
        duration: Duration of the path [s].
        imu: Whether there is an IMU.
        imu_noise: Densities of accelerometer and gyroscope [m/s^2/sqrt(Hz), rad/s/sqrt(Hz)].
        vibration: Vibration of the arm at full speed, rms along each axis [m/s^2].
        resolution: Step to which joint positions are rounded [rad or m].
        rates: Sampling rates of joints, IMU and tracker [Hz]; default: 150, 100, 250, or 30 for a
            camera.
        drift: Drift of the clocks of IMU and tracker [1]; drawn if None.
        dropped: Fraction of the rows that loggers lose.
        payload: Payload at the tip [kg].
        payload_com: Its centre of mass in the tip frame [m].
        min_height: Height of the floor [m]; None for no floor.
    """

    duration: float = 300.0
    imu: bool = True
    imu_noise: tuple[float, float] = (_ACC_DENSITY, _GYRO_DENSITY)
    vibration: float = 0.1
    resolution: float = 1.7453e-5
    rates: tuple[float, float, float] | None = None
    drift: float | None = None
    dropped: float = 0.005
    payload: float = 0.0
    payload_com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    min_height: float | None = 0.0


def _drawn_path(
    arm: Arm, options: SessionOptions, tracker: SensorSetup | None, rng: np.random.Generator
) -> FourierPath | ViaPath:
    """Draw a path, through views of the object for a camera on the tool."""
    duration = options.duration
    if not isinstance(tracker, EyeInHand):
        return draw_path(arm, duration, rng, min_height=options.min_height)
    # A random path would hardly ever look at the object.
    views = max(int(duration / _VIEW), 2)
    return ViaPath.through(
        tracker.plan(arm, views, rng=rng, min_height=options.min_height), duration
    )


def draw_session(
    arm: Arm,
    options: SessionOptions,
    *,
    tracker: SensorSetup | None,
    path: np.random.Generator | ViaPath,
    setup: np.random.Generator,
) -> MovingSession:
    """Draw IMU, clocks and, unless given, a path of the nominal arm.

    Raises:
        BadInputError: If the arm has no path above the floor.
    """
    acc, gyro = options.imu_noise
    imu = ImuSetup.draw(setup, acc_density=acc, gyro_density=gyro, vibration=options.vibration)
    clocks = [
        Clock.draw(setup, middle=0.5 * options.duration, drift=options.drift) for _ in range(2)
    ]
    payload = (
        {"payload": options.payload, "payload_com": options.payload_com} if options.payload else {}
    )
    is_camera = isinstance(tracker, (EyeInHand, CellCamera))
    rates = options.rates or (150.0, 100.0, 30.0 if is_camera else 250.0)
    return MovingSession(
        path=path if isinstance(path, ViaPath) else _drawn_path(arm, options, tracker, path),
        duration=options.duration,
        tracker=tracker,
        imu=imu if options.imu else None,
        rates=dict(zip(("joints", "imu", "tracker"), rates, strict=True)),
        clocks=dict(zip(("imu", "tracker"), clocks, strict=True)),
        resolution=options.resolution,
        dropped=options.dropped,
        conditions=payload,
    )


@dataclass(frozen=True, kw_only=True)
class MovingSession:
    """A path that is driven once, and its loggers.

    Attributes:
        path: Motion of the joints by their own clock.
        duration: Duration of the session [s].
        tracker: Instrument next to the robot; None without one.
        imu: The IMU; None without one.
        rates: Sampling rates of "joints", "imu" and "tracker" [Hz].
        clocks: Clocks of "imu" and "tracker"; default: the joints' clock.
        resolution: Step to which joint positions are rounded [rad or m].
        dropped: Fraction of the rows that loggers lose, in bursts.
        conditions: Further conditions, such as the payload.
    """

    path: Motion
    duration: float
    tracker: SensorSetup | None = None
    imu: ImuSetup | None = None
    rates: Mapping[str, float] = field(
        default_factory=lambda: {"joints": 150.0, "imu": 100.0, "tracker": 250.0}
    )
    clocks: Mapping[str, Clock] = field(default_factory=dict)
    resolution: float = 0.0
    dropped: float = 0.0
    conditions: Mapping[str, Any] = field(default_factory=dict)

    def _tracked(
        self, tracker: SensorSetup, machine: TrueMachine, rng: np.random.Generator
    ) -> Table:
        """Return the readings of the instrument with its stamps."""
        stamps = self._stamps("tracker")
        at = self._clock("tracker").to_joints(stamps)
        along = conditions_along(self.path, at, **self.conditions)
        read = tracker.measure(machine, self.path.at(at), rng=rng, **along)
        approaches = (f"approach_{name}" for name in machine.names)
        recorded = {*machine.names, *approaches, "time", "payload"}
        # A pose may be read as several rows, or none.
        seen = {"time": stamps[np.searchsorted(at, read["time"])]}
        return seen | {name: value for name, value in read.items() if name not in recorded}

    def measure(self, machine: TrueMachine, rng: np.random.Generator) -> dict[str, Table]:
        """Return the tables of "joints" and, if present, of "imu" and "tracker".

        Raises:
            BadInputError: If an effect of the machine depends on preceding poses, which do not
                exist in motion.
        """
        for effect in machine.effects:
            if effect.needs_order and effect.column != "approach":
                raise BadInputError(
                    f"{effect.effect}: depends on a sequence of held poses; leave it out, or --path"
                )
        noises = dict(zip(("joints", "imu", "tracker", "lost"), rng.spawn(4), strict=True))
        time = self._stamps("joints")
        q = self.path.at(time)
        q = self.resolution * np.round(q / self.resolution) if self.resolution else q
        tables = {"joints": {"time": time} | dict(zip(machine.names, q.T, strict=True))}
        if "payload" in self.conditions:
            tables["joints"]["payload"] = np.full(len(time), float(self.conditions["payload"]))
        if self.imu is not None:
            stamps = self._stamps("imu")
            at = self._clock("imu").to_joints(stamps)
            rate = self.rates["imu"]
            read = self.imu.read(
                machine, self.path, at, rate=rate, rng=noises["imu"], conditions=self.conditions
            )
            tables["imu"] = {"time": stamps} | read
        if self.tracker is not None:
            tables["tracker"] = self._tracked(self.tracker, machine, noises["tracker"])
        return {name: self._logged(table, noises["lost"]) for name, table in tables.items()}

    def _clock(self, name: str) -> Clock:
        return self.clocks.get(name, Clock())

    def _stamps(self, name: str) -> np.ndarray:
        """Return the time stamps of a stream by its own clock [s], which was started by hand."""
        return np.round(np.arange(0.0, self.duration, 1.0 / self.rates[name]), 6)

    def _logged(self, table: Table, rng: np.random.Generator) -> Table:
        n = len(table["time"])
        begins = rng.random(n) < self.dropped / _BURST
        lost = np.convolve(begins, np.ones(_BURST), "full")[:n] > 0.0
        lost[[0, -1]] = False
        return {name: column[~lost] for name, column in table.items()}

    def truth(self, arm: Arm) -> dict[str, Any]:
        """Return path, clocks, IMU and instrument, for JSON."""
        path = vars(self.path)
        logged = [name for name in ("imu", "tracker") if getattr(self, name) is not None]
        found: dict[str, Any] = {
            "path": {
                "joints": list(arm.names),
                "duration_s": self.duration,
                **{k: v.tolist() for k, v in path.items()},
            },
            "rates_hz": dict(self.rates),
            "clocks": {name: asdict(self.clocks[name]) for name in logged},
            "resolution": self.resolution,
            "dropped": self.dropped,
        }
        found |= {} if self.imu is None else {"imu": self.imu.truth()}
        return found if self.tracker is None else found | self.tracker.truth()
