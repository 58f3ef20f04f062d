"""Fleets whose truth is known: information drawn by NumPy alone, siblings of an arm, and machines as makers measured them.

A family of information forms needs no robot: parameters are drawn, each machine has information of its own and a score of
this covariance. Siblings are true machines, measured and calibrated. Real ones stand in ../shared/data/ur_fleet.
"""

from __future__ import annotations

import csv
import random
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from pincal import GEOMETRIC, FittedRobot, Measurements, Options, Robot, calibrate, measurements_from_arrays
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.calibration.information import RobotInformation
from pincal.errors import BadInputError
from pincal.fleet.checks import FALSE_DISCOVERIES, FleetWatch
from pincal.fleet.history import FleetChange, Visit
from pincal.fleet.machines import Machine
from pincal.fleet.robot_type import RobotType
from pincal.fleet.store import Key, Store
from pincal.identify.quadratic import Quadratic
from pincal.parameters import Parameter

FLEET = Path(__file__).resolve().parents[2] / "shared" / "data" / "ur_fleet"
NOISE = 5e-5  # [m]
OPTIONS = Options(effects=GEOMETRIC, sigma=NOISE)
PRIOR = 3e-3  # [m, rad]
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
TOOL, INSTRUMENT = np.array([0.05, 0.03, 0.10]), np.array([2.0, 0.5, -0.3])  # [m]


@dataclass(frozen=True, eq=False)
class Family:
    """A population of machines in P parameters, all in units of 3 mm and 3 mrad.

    Attributes:
        mean: shape (P,).
        root: shape (P, P), L with L L^T the covariance.
        seen: shape (P, n), orthonormal columns: what readings of any machine determine.
    """

    mean: np.ndarray
    root: np.ndarray
    seen: np.ndarray

    @classmethod
    def drawn(cls, rng: np.random.Generator, *, parameters: int = 40, unseen: int = 0, correlated: bool = False) -> Family:
        """Return a family with spreads of 0.05 in the median, from a fifth of that to five times as much."""
        spread = np.exp(rng.normal(-3.0, 0.7, parameters))
        root = np.diag(spread)
        if correlated:
            mix = np.eye(parameters) + rng.normal(size=(parameters, parameters)) * 0.6 / np.sqrt(parameters)
            root = spread[:, None] * mix / np.linalg.norm(mix, axis=1, keepdims=True)
        axes = np.linalg.qr(rng.normal(size=(parameters, parameters)))[0]
        return cls(1.5 * spread * rng.normal(size=parameters), root, axes[:, unseen:])

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the machines."""
        return self.root @ self.root.T

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of several joints, of three kinds."""
        kinds = (("d", "m", "link_geometry"), ("theta", "rad", "joint_offset"), ("s_x", "rad", "axis_distortion"))
        found = []
        for k in range(len(self.mean)):
            symbol, unit, effect = kinds[k % 3]
            found.append(Parameter(f"joint_{k // 6 + 1}.{symbol}{k % 6 // 3}", unit, effect, 0.0, PRIOR))
        return tuple(found)

    def draw(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return machines, shape (count, P)."""
        return self.mean + rng.normal(size=(count, len(self.mean))) @ self.root.T

    def measured(
        self, x: np.ndarray, rng: np.random.Generator, *, least: float = 1e2, most: float = 1e5, name: str = ""
    ) -> Machine:
        """Return what readings say of a machine, shape (P,): information from ``least`` to ``most`` along what they see."""
        n = self.seen.shape[1]
        sizes = np.exp(rng.uniform(np.log(least), np.log(most), n))
        rows = (self.seen @ np.linalg.qr(rng.normal(size=(n, n)))[0] * np.sqrt(sizes)).T
        return machine_of(self.parameters, rows / PRIOR, rows @ x + rng.normal(size=n), name)


def machine_of(parameters: tuple[Parameter, ...], J: np.ndarray, r: np.ndarray, name: str = "") -> Machine:
    """Return a machine by rows in units of their noise, J of shape (R, P) and r of shape (R,)."""
    form = Quadratic.of_rows([p.name for p in parameters], J, r)
    return Machine(name, RobotInformation.of_form(form, "arm", 1, {p.name: (p, p.size) for p in parameters}))


@cache
def _links(file: str) -> dict[tuple[str, ...], list[dict[str, str]]]:
    found = dict[tuple[str, ...], list[dict[str, str]]]()
    with (FLEET / file).open(encoding="utf-8") as stream:
        for row in csv.DictReader(stream):
            found.setdefault((row["type"], *([row["machine"]] if "machine" in row else [])), []).append(row)
    return found


def urdf_of(links: list[dict[str, str]]) -> bytes:
    """Return the URDF of an arm of Universal Robots by the frames of its links."""
    text, parent = '<robot name="arm"><link name="base"/>', "base"
    for joint, row in zip(JOINTS, links, strict=True):
        place = " ".join(row[axis] for axis in "xyz"), " ".join(row[axis] for axis in ("roll", "pitch", "yaw"))
        text += f'<link name="{row["link"]}"/><joint name="{joint}" type="revolute"><parent link="{parent}"/>'
        text += f'<child link="{row["link"]}"/><origin xyz="{place[0]}" rpy="{place[1]}"/><axis xyz="0 0 1"/>'
        text += '<limit lower="-3.1" upper="3.1" effort="1" velocity="1"/></joint>'
        parent = row["link"]
    return (text + "</robot>").encode()


def nominal_arm(kind: str) -> Robot:
    """Return the arm of a type as its data sheet has it."""
    return Robot.from_urdf(urdf_of(_links("nominal.csv")[(kind,)]))


def real_machines() -> Iterator[tuple[str, str, sim.TrueMachine]]:
    """Yield type, name and true machine of all real ones."""
    for (kind, name), links in _links("machines.csv").items():
        yield kind, name, sim.TrueMachine.from_urdf(urdf_of(links).decode(), tip="wrist_3")


def table_of(robot: Robot, machine: sim.TrueMachine, poses: int, seed: int, *, noise: float = NOISE) -> Measurements:
    """Return positions of a reflector in random poses."""
    rng = np.random.default_rng(seed)
    q = robot.random_configurations(poses, rng)
    tip = machine.tip(q)
    position = tip[:, :3, :3] @ TOOL + tip[:, :3, 3] + INSTRUMENT
    return measurements_from_arrays(robot.joint_names, q, position=position + noise * rng.normal(size=position.shape))


def siblings(count: int) -> list[sim.TrueMachine]:
    """Return machines of the KUKA that differ by a quarter of a millimetre and of a milliradian."""
    nominal, rng = sim.TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0"), np.random.default_rng(1)
    return [nominal.draw_errors(rng, sigma_length=2.5e-4, sigma_angle=2.5e-4) for _ in range(count)]


def rows_of(robot: Robot, machine: sim.TrueMachine, poses: int, seed: int) -> Measurements:
    """Return what a tracker reads of a reflector."""
    rng = np.random.default_rng(seed)
    q = robot.random_configurations(poses, rng)
    tip = machine.tip(q)
    position = tip[:, :3, :3] @ [0.1, 0.0, 0.2] + tip[:, :3, 3] + 5e-5 * rng.normal(size=(poses, 3))
    return measurements_from_arrays(robot.joint_names, q, position=position, temperature=np.full(poses, 21.0))


def error_of(fit: FittedRobot, truth: Measurements) -> float:
    """Return the mean error of predictions [mm]."""
    assert truth.position is not None
    return 1e3 * float(np.linalg.norm(fit.predict(truth.q)[:, :, 3] - truth.position, axis=1).mean())


def sibling_of(robot: Robot, machine: sim.TrueMachine, name: str, *, poses: int, seed: int) -> Machine:
    """Return what a calibration says of a machine."""
    return Machine.of(calibrate(robot, table_of(robot, machine, poses, seed), OPTIONS).fit, name)


class Year:
    """Robots of a family, calibrated and then checked week by week.

    Attributes:
        family, of: what they are drawn from, and what is known of that.
        x: shape (robots, P), what they are now.
        what: of robots that were changed, the parameter.
        watch: what is made of it.
        changes: what was found.
    """

    def __init__(
        self,
        family: Family,
        of: RobotType,
        *,
        robots: int,
        seed: int,
        labels: Callable[[int], dict[str, str]] = lambda _: {},
        alpha: float = FALSE_DISCOVERIES,
    ) -> None:
        """Draw robots and calibrate them."""
        self.family, self.of, self.rng = family, of, np.random.default_rng(seed)
        self.x, self.labels = family.draw(robots, self.rng), [labels(k) for k in range(robots)]
        self.what, self.changes = dict[int, str](), list[FleetChange]()
        self.watch = FleetWatch(of, alpha)
        self._take(0, [self._calibration(k, 0) for k in range(robots)])

    def check(self, week: int) -> tuple[FleetChange, ...]:
        """Check all robots by a few poses."""
        visits = []
        for k, x in enumerate(self.x):
            visits.append(Visit(f"r{k}", self.day_of(week), self._few(x)))
        return self._take(week, visits)

    def calibrate(self, robot: int, week: int) -> None:
        """Calibrate a robot anew."""
        self._take(week, [self._calibration(robot, week)])

    def change(self, robot: int, strength: float) -> None:
        """Change a parameter of a robot so that a check shows it with this lambda."""
        K, P = self.family.seen, self.x.shape[1]
        seen = np.flatnonzero(np.sum(K**2, axis=1) > 0.3)
        k = int(self.rng.choice(seen))
        # A typical check after a calibration, which is known much better.
        Q = np.mean([self._few(self.x[robot]).information.form.H[k, k] for _ in range(9)]) * PRIOR**2
        self.x[robot] += np.sign(self.rng.normal()) * np.sqrt(strength / Q) * np.eye(P)[k]
        self.what[robot] = self.family.parameters[k].name

    def drift(self, label: str, value: str, *, place: int, by: float) -> None:
        """Move a parameter of all robots with a label."""
        for k, labels in enumerate(self.labels):
            self.x[k, place] += by * (labels.get(label) == value)

    @staticmethod
    def day_of(week: int) -> str:
        """Return the day of a week."""
        return str(np.datetime64("2026-01-01") + 7 * week)

    @staticmethod
    def week_of(day: str) -> int:
        """Return the week of a day."""
        return int((np.datetime64(day) - np.datetime64("2026-01-01")).astype(int)) // 7

    def _few(self, x: np.ndarray) -> Machine:
        return self.family.measured(x, self.rng, least=3e2, most=1e4)

    def _calibration(self, robot: int, week: int) -> Visit:
        many = self.family.measured(self.x[robot], self.rng, least=1e4, most=1e6, name=f"r{robot}")
        return Visit(f"r{robot}", self.day_of(week), replace(many, labels=self.labels[robot]), is_calibration=True)

    def _take(self, week: int, visits: list[Visit]) -> tuple[FleetChange, ...]:
        found = self.watch.take(week, visits)
        self.changes += found
        return found


def bit_flips(store: Store, key: Key, count: int) -> Counter[str]:
    """Return how often a file with one bit changed is ``refused``, read as it ``was``, or read as ``other`` content."""
    path, found = Path(store.place) / key.path, Counter[str]()
    good, was = path.read_bytes(), store.frame(key)
    for seed in range(count):
        rng, content = random.Random(seed), bytearray(good)
        content[rng.randrange(len(good))] ^= 1 << rng.randrange(8)
        path.write_bytes(content)
        try:
            found["was" if store.frame(key).equals(was) else "other"] += 1
        except BadInputError:
            found["refused"] += 1
    path.write_bytes(good)
    return found
