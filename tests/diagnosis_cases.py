"""Robots measured twice: drawn arms with true masses 3 % off, calibrated from 100 poses, and changed since or not.

The strength of a change is lambda, its squared signal over the variance of noise and of what the calibration leaves open,
the new station's base and target projected out; found from two noise-free tables, with and without the change.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from discovery_cases import SIGMA, random_urdf
from scipy.spatial.transform import Rotation

from pincal import ELASTIC, FittedRobot, Measurements, Options, Robot, calibrate, measurements_from_arrays
from pincal import simulate as sim
from pincal.calibration.placing import place_station

ARMS = ("light", "heavy", "seven")
KINDS = ("offset", "bent", "tilt", "softer", "worn", "loose", "payload")
REFERENCE_ROWS = 100
# d of each joint, its turn about x behind it in quarters, mass and half range [m, kg, deg] of an arm of seven joints.
_SEVEN = (
    (0.36, -1, 5.8, 165),
    (0.0, 1, 6.3, 115),
    (0.42, 1, 3.5, 165),
    (0.0, -1, 3.5, 115),
    (0.40, -1, 2.2, 165),
    (0.0, 1, 1.8, 115),
    (0.126, 0, 0.5, 170),
)
_JOINT = '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/><origin xyz="0 0 {4!r}" rpy="{5!r} 0 0"/>'
_JOINT += '<axis xyz="0 0 1"/><limit lower="{6!r}" upper="{7!r}" effort="1" velocity="1"/></joint>'
_LINK = '<link name="{0}"><inertial><origin xyz="{1!r} {2!r} {3!r}"/><mass value="{4!r}"/>'
_LINK += '<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>'

Truth = tuple[tuple[str, ...], tuple[str | None, ...]]  # names of the effect and of the joint, any of which is right


def seven_joints(rng: np.random.Generator) -> str:
    """Return an arm of seven joints, its lengths and masses drawn to +- 20 %."""
    text, d, turn, parent = ['<robot name="drawn"><link name="base"/>'], 0.0, 0.0, "base"
    for i, (length, quarters, mass, half) in enumerate(_SEVEN):
        limit = float(np.deg2rad(half))
        text.append(_JOINT.format(f"axis_{i + 1}", "revolute", parent, f"link_{i + 1}", d, turn, -limit, limit))
        d, turn, parent = float(length * rng.uniform(0.8, 1.2)), quarters * np.pi / 2, f"link_{i + 1}"
        centre = rng.normal(0.0, 0.02, 3) + d * np.array([0.0, 0.0, rng.uniform(0.2, 0.7)])
        text.append(_LINK.format(parent, *map(float, centre), float(mass * rng.uniform(0.8, 1.2))))
    text.append(_JOINT.format("flange", "fixed", parent, "tool0", d, turn, 0.0, 0.0))
    return "".join(text) + '<link name="tool0"/></robot>'


@dataclass(frozen=True)
class Case:
    """A calibrated robot and rows measured later.

    Attributes:
        model: the calibrated robot.
        new: the rows.
        truth: what has changed; None for nothing.
        strength: its lambda.
        measure_others: measures 100 other poses of the later robot in the later station, without noise.
        size: of the change, where its kind has one number: of an offset [rad].
    """

    model: FittedRobot
    new: Measurements
    truth: Truth | None
    strength: float
    measure_others: Callable[[], Measurements]
    size: float | None = None


@dataclass(frozen=True)
class _Scene:
    """A machine before an instrument."""

    machine: sim.TrueMachine
    q: np.ndarray
    hall: np.ndarray
    tool: np.ndarray
    com: tuple[float, float, float]
    conditions: dict[str, Any]

    def positions(self, machine: sim.TrueMachine | None = None) -> np.ndarray:
        tracker = sim.Instrument(pose=self.hall, targets=self.tool)
        seen = tracker.measure(machine or self.machine, self.q, payload_com=self.com, **self.conditions)
        return np.column_stack([seen[axis] for axis in "xyz"])

    def table(self, positions: np.ndarray) -> Measurements:
        return measurements_from_arrays(self.machine.names, self.q, position=positions, **self.conditions)


def draw_case(
    seed: int, kind: str = "null", *, strength: float = 80.0, temperature: bool = False, missed: int = 0
) -> Case | None:
    """Draw a robot, calibrate it and measure it again; None if no change of the kind has the strength.

    Args:
        seed: of everything.
        kind: "null" or one of ``KINDS``.
        strength: lambda of the change.
        temperature: whether its links grow, at one temperature when it was calibrated and at another later, both recorded.
        missed: number of strong effects that it always had and that the calibrated model lacks.
    """
    rng = np.random.default_rng([seed, 14])
    light = ARMS[seed % 3] != "heavy"
    machine, robot = _machine(rng, ARMS[seed % 3])
    machine = machine.with_effects(*_missed(machine, missed, light=light, rng=np.random.default_rng([seed, 15])))
    warm: tuple[float | None, float | None] = (None, None)
    if temperature:
        machine = machine.with_effects(sim.ThermalExpansion(size=float(rng.uniform(1e-5, 2.4e-5))))
        first = float(rng.uniform(18.0, 25.0))
        warm = first, first + float(rng.uniform(-10.0, 10.0))
    old = _scene(machine, REFERENCE_ROWS, rng, light=light, temperature=warm[0])
    table = old.table(old.positions() + SIGMA * rng.standard_normal((REFERENCE_ROWS, 3)))
    options = Options(effects=ELASTIC, payload_centre=old.com, moment_frame="after")
    fit = calibrate(robot, table, options)
    model = fit.at()
    few = kind in ("null", "offset", "bent", "tilt")
    new = _scene(machine, int(rng.integers(12 if few else 30, 61)), rng, light=light, temperature=warm[1])
    later, truth, got, by = machine, None, 0.0, None
    if kind != "null":
        changed, truth = _change(kind, machine, rng)
        size = _sized(changed, model, new, strength)
        if size is None:
            return None
        later, got, by = changed(size), strength, 1e-3 * size if kind == "offset" else None
    noise = SIGMA * rng.standard_normal((len(new.q), 3))
    there = replace(_scene(machine, 100, rng, light=light, temperature=warm[1]), hall=new.hall, tool=new.tool)
    table = new.table(new.positions(later) + noise)
    return Case(model, table, truth, got, lambda: there.table(there.positions(later)), by)


def _missed(
    machine: sim.TrueMachine, n: int, *, light: bool, rng: np.random.Generator
) -> Iterator[sim.GearEccentricity | sim.Backlash]:
    """Yield strong effects on different joints: gears and play of 0.07 to 0.3 mrad."""
    for i in rng.choice(len(machine.names) - 1, n, replace=False):
        joint, size = machine.names[i], float(rng.uniform(0.7, 1.5)) * (2e-4 if light else 1e-4)
        if rng.random() < 1.0 / 3.0:
            yield sim.Backlash(joint=joint, size=size)
        else:
            yield sim.GearEccentricity(
                joint=joint, size=size, order=int(rng.integers(1, 3)), phase=float(rng.uniform(-3.0, 3.0))
            )


def _machine(rng: np.random.Generator, arm: str) -> tuple[sim.TrueMachine, Robot]:
    light = arm != "heavy"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.urdf"
        path.write_text(seven_joints(rng) if arm == "seven" else random_urdf(rng, heavy=not light), encoding="utf-8")
        robot, machine = Robot.from_urdf(path, tip="tool0"), sim.TrueMachine.from_urdf(path, tip="tool0")
    machine = machine.draw_errors(
        rng, sigma_length=2e-4 if light else 5e-4, sigma_angle=1e-3, sigma_offset=1e-3 if light else 2e-3
    ).draw_masses(rng, sigma=0.03)
    soft = np.array([1.0, 1.0, 1.5, 8.0, 8.0, 12.0] if robot.n_joints == 6 else [1.0, 1.0, 1.2, 1.5, 6.0, 8.0, 12.0])
    drive = soft * rng.uniform(0.7, 1.3, len(soft)) * (5e-6 if light else 2e-7)
    bearing = 0.15 * drive * rng.uniform(0.5, 1.5, len(soft))
    return replace(machine, compliance=np.column_stack([bearing, bearing, drive]), moment_frame="after"), robot


def _scene(machine: sim.TrueMachine, n: int, rng: np.random.Generator, *, light: bool, temperature: float | None) -> _Scene:
    hall = np.eye(4)
    hall[:3, :3], hall[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.uniform(-4.0, 4.0, 3)
    tool = np.append(rng.choice([-1.0, 1.0], 2) * rng.uniform(0.05, 0.2, 2), rng.uniform(0.05, 0.25))
    q = sim.plan_poses(machine.nominal, n, rng, min_height=-0.5 if light else 0.1)
    conditions: dict[str, Any] = {
        "payload": np.where(rng.random(n) < 0.5, 0.0, 6.0 if light else 100.0),
        "approach": rng.choice([-1, 1], q.shape),
    }
    if temperature is not None:
        conditions["temperature"] = temperature + rng.normal(0.0, 0.3, n)
    return _Scene(
        machine, q, hall, tool * (0.6 if light else 1.0), (0.01, 0.02, 0.08) if light else (0.06, 0.03, 0.2), conditions
    )


def _change(
    kind: str, machine: sim.TrueMachine, rng: np.random.Generator
) -> tuple[Callable[[float], sim.TrueMachine], Truth]:
    """Return the machine changed by so much, and any names that are right."""
    names, n = machine.names, len(machine.names)
    i = int(rng.integers(1, n - 1))
    geometry = ("joint_offset", "link_geometry", "axis_distortion")
    if kind == "offset":
        return lambda s: replace(machine, joint_offsets=machine.joint_offsets + 1e-3 * s * np.eye(n)[i]), (
            ("joint_offset",),
            (names[i],),
        )
    if kind in ("bent", "tilt"):
        i = int(rng.integers(1, n))
        way = 1e-3 * rng.standard_normal(6) * (1.0 if kind == "bent" else np.array([0, 0, 0, 1, 1, 0]))
        place = np.outer(np.eye(n + 1)[i], way)
        return lambda s: replace(machine, placement_errors=machine.placement_errors + s * place), (
            geometry,
            (names[i - 1], names[i]),
        )
    if kind == "softer":
        i = int(rng.integers(1, 4))
        more = np.zeros_like(machine.compliance)
        more[i, 2] = machine.compliance[i, 2]
        return lambda s: replace(machine, compliance=machine.compliance + s * more), (("joint_elasticity",), (names[i],))
    if kind == "worn":
        order, phase = int(rng.integers(1, 3)), float(rng.uniform(-3.0, 3.0))
        worn = sim.GearEccentricity(joint=names[i], size=1e-3, order=order, phase=phase)
        return lambda s: machine.with_effects(replace(worn, size=1e-3 * s)), (("gear_eccentricity",), (names[i],))
    if kind == "loose":
        return lambda s: machine.with_effects(sim.Backlash(joint=names[i], size=1e-4 * s)), (("backlash",), (names[i],))
    return lambda s: machine.with_effects(sim.PayloadError(size=s)), (("payload_error",), (None,))


def _sized(changed: Callable[[float], sim.TrueMachine], model: FittedRobot, new: _Scene, wanted: float) -> float | None:
    """Return the size at which a change has the wanted lambda."""
    placed = place_station(model, new.table(new.positions()))
    ((_, _, J),) = placed.station.linearise(placed.values, np.ones(len(placed.values), bool))
    A = J.reshape(len(J), -1).T / SIGMA
    own = placed.station.is_own
    names = [p.name for p, is_own in zip(placed.station.parameters, own, strict=True) if not is_own]
    C = model.estimate.take(names).dense_covariance()
    white = np.linalg.inv(np.linalg.cholesky(np.eye(len(A)) + A[:, ~own] @ C @ A[:, ~own].T))
    Q = np.linalg.qr(white @ (A[:, own] / np.linalg.norm(A[:, own], axis=0)))[0]
    size, nothing = 1.0, new.positions()
    for _ in range(6):
        signal = white @ ((new.positions(changed(size)) - nothing).T.ravel() / SIGMA)
        got = float(signal @ signal - np.sum((Q.T @ signal) ** 2))
        if abs(got / wanted - 1.0) < 0.02:
            return size
        if got < 1e-9:
            return None
        size *= float(np.sqrt(wanted / got))
        if size > 50.0:
            return None
    return None
