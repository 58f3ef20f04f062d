"""Random cases with a hidden effect of known strength, and what a discovery made of them.

The strength is lambda, the squared signal that a refitted elastic model can't absorb over the noise variance, over all
rows of the table. It is found from two noise-free tables, with and without the effect.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from scipy.spatial.transform import Rotation

from pincal import GEOMETRIC, Options, Robot, calibrate, measurements_from_arrays
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.discover.elastic import instead_of, significant_compliances
from pincal.discover.levers import compliances_of
from pincal.discover.loop import discover_effects, fit_cost
from pincal.discover.steps import History
from pincal.identify.calibrate import refit
from pincal.identify.fit import ModelFit
from pincal.identify.mass_error import MassError
from pincal.identify.split import hold_out, row_groups
from pincal.measure.approach import moves_by_order, sides_of
from pincal.measure.measurements import Measurements
from pincal.model import catalogue
from pincal.model.chain import MOMENT_FRAMES, MomentFrame
from pincal.model.effect import Effect
from pincal.model.effects import ELASTIC, BearingElasticity, JointElasticity
from pincal.model.model import Model
from pincal.simulate.effect import DeformingEffect, HiddenEffect
from pincal.simulate.state import Deformation, Loads, Poses

SIGMA = 5e-5  # standard deviation of one coordinate [m]
ELASTICITY = ("joint_elasticity", "bearing_elasticity", "oblique_bearing", "bearing_place")
Name = tuple[str, str | None, str | None]  # effect, joint, source

# Standard DH: o, d, a, alpha of each joint; masses, share of the way to the next joint where they sit; range of each joint.
_HEAVY = (
    ((0, 0.74, 0.38, -1), (0, 0, 1.05, 0), (0, 0.03, 0.06, -1), (0, 1.05, 0, 1), (0, 0, 0, -1), (0, 0.23, 0, 0)),
    (310.0, 205.0, 175.0, 68.0, 36.0, 11.0),
    (150, 75, 110, 170, 110, 175),
    (-90, -90, 0, 0, 0, 0),
)
_LIGHT = (
    ((0, 0.163, 0, 1), (0, 0.02, -0.63, 0), (0, 0, -0.57, 0), (0, 0.135, 0, 1), (0, 0.115, 0, -1), (0, 0.21, 0, 0)),
    (7.4, 13.1, 4.2, 2.0, 2.0, 0.4),
    (175, 170, 150, 175, 175, 175),
    (0, -90, 0, 0, 0, 0),
)
_LINK = '<link name="{0}"><inertial><origin xyz="{1}"/><mass value="{2!r}"/>'
_LINK += '<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>'
_JOINT = '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/><origin xyz="{4}" rpy="{5}"/>'
_JOINT += '<axis xyz="0 0 1"/><limit lower="{6!r}" upper="{7!r}" effort="1" velocity="1"/></joint>'
# Joint frames that a URDF may as well have are turned about their axes, and shifted along them by this part of a link.
_SHIFTED = 0.15
# Classes of arms by their frames and their kind, beside "heavy", "light" and the built-in "kuka", whose frames are those of
# Denavit and Hartenberg, at right angles. "turned": anywhere about and along the axes; "skew": so too, and the axes meet at
# any angle, with offsets anywhere.
FRESH_ARMS = ("turned heavy", "turned light", "skew heavy", "skew light")


def random_urdf(rng: np.random.Generator, *, heavy: bool, frames: str = "plain") -> str:
    """Return a 6R arm of a class, its lengths and masses drawn to +- 20 %, its frames "plain", "turned" or "skew"."""
    rows, masses, ranges, middles = _HEAVY if heavy else _LIGHT
    text = ['<robot name="drawn"><link name="base"/>']
    T_link_joint, own, parent = np.eye(4), np.eye(4), "base"
    size = 1.0 if heavy else 0.4
    for i, (o, d, a, quarter) in enumerate(rows):
        d, a = d * rng.uniform(0.8, 1.2), a * rng.uniform(0.8, 1.2)
        half, middle = np.deg2rad(ranges[i]), np.deg2rad(middles[i])
        limits = float(middle - half), float(middle + half)
        before, own = own, np.eye(4) if frames == "plain" else _along_axis(rng, _SHIFTED * size)
        placed = np.linalg.solve(before, T_link_joint @ own)
        text.append(_JOINT.format(f"axis_{i + 1}", "revolute", parent, f"link_{i + 1}", *_origin(placed), *limits))
        xyz, rpy, parent = np.array([a, 0.0, d]), np.array([quarter * np.pi / 2, 0.0, o]), f"link_{i + 1}"
        if frames == "skew":
            xyz += rng.normal(0.0, 0.05 * size, 3)
            rpy += rng.choice([-1.0, 1.0], 3) * rng.uniform(0.1, 0.6, 3)
        T_link_joint = _placed(xyz, rpy)
        centre = rng.uniform(0.2, 0.7) * xyz + rng.normal(0.0, 0.04 if heavy else 0.015, 3)
        centre = own[:3, :3].T @ (centre - own[:3, 3])
        text.append(_LINK.format(parent, _row(centre), float(masses[i] * rng.uniform(0.8, 1.2))))
    placed = np.linalg.solve(own, T_link_joint)
    text.append(_JOINT.format("flange", "fixed", parent, "tool0", *_origin(placed), 0.0, 0.0))
    return "".join(text) + '<link name="tool0"/></robot>'


def _along_axis(rng: np.random.Generator, shift: float) -> np.ndarray:
    """Return a transform about and along z, which leaves a joint with this axis what it is."""
    return _placed(np.array([0.0, 0.0, rng.normal(0.0, shift)]), np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))


def _placed(xyz: np.ndarray, rpy: np.ndarray) -> np.ndarray:
    """Return the transform of a URDF's origin."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", rpy).as_matrix(), xyz
    return T


def _origin(T: np.ndarray) -> tuple[str, str]:
    """Return the xyz and rpy of a URDF's origin."""
    return _row(T[:3, 3]), _row(Rotation.from_matrix(T[:3, :3]).as_euler("xyz"))


def _row(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)


@dataclass(frozen=True, kw_only=True)
class Foreign(DeformingEffect):
    """An effect that no catalogue lists: ``size`` times a shape of pose and conditions.

    Attributes:
        shape: from poses, joint index -> shape (N,).
        acts_on: "drive", or a transverse tilt of the bearing before q: "x" or "y".
    """

    shape: Callable[[Poses, int], np.ndarray]
    acts_on: str = "drive"
    effect = "unnamed"

    def deform(self, arm: sim.Arm, poses: Poses, loads: Loads, deformation: Deformation) -> None:
        """Turn the joint, or tilt it."""
        i = arm.index(self.joint)
        value = self.size * self.shape(poses, i)
        if self.acts_on == "drive":
            deformation.joint[:, i] += value
        else:
            deformation.before[:, i, 3 + "xy".index(self.acts_on)] += value


@dataclass(frozen=True)
class Case:
    """A robot's measured rows and what is hidden in them.

    ``strength`` is lambda over all rows; ``seen`` what is left of it on the training rows, beside masses known to 5 %, of
    the weakest effect. ``clean`` are the positions without noise, shape (N, 3), ``sound`` those without what is hidden.
    """

    kind: str
    seed: int
    robot: Robot
    rows: Measurements
    options: Options
    hidden: tuple[HiddenEffect, ...]
    strength: float
    seen: float
    elastic: bool
    arm: str
    clean: np.ndarray
    sound: np.ndarray
    moment_frame: MomentFrame

    @property
    def plain(self) -> Options:
        """How to calibrate the machine but for what is hidden."""
        return _plain(self.options, moment_frame=self.moment_frame, elastic=self.elastic or self.is_soft)

    @property
    def is_soft(self) -> bool:
        """Whether elasticity is what is hidden; it is found as a whole, since every arm has it."""
        return any(effect.effect in ELASTICITY for effect in self.hidden)

    @property
    def truth(self) -> tuple[Name, ...]:
        """Names of what is hidden."""
        return tuple((e.effect, e.joint, vars(e).get("source")) for e in self.hidden)


@dataclass
class _Setting:
    """An arm in a hall, before anything is hidden."""

    machine: sim.TrueMachine
    robot: Robot
    q: np.ndarray
    hall: np.ndarray
    tool: np.ndarray
    conditions: dict[str, Any]
    com: tuple[float, float, float]
    arm: str
    in_order: bool = False
    moments: np.ndarray = field(default_factory=lambda: np.zeros(0))
    known: dict[tuple[HiddenEffect, ...], np.ndarray] = field(default_factory=dict)

    def positions(self, *effects: HiddenEffect) -> np.ndarray:
        """Return noise-free positions with effects."""
        if effects not in self.known:
            tracker = sim.Instrument(pose=self.hall, targets=self.tool)
            table = tracker.measure(self.machine.with_effects(*effects), self.q, payload_com=self.com, **self.conditions)
            self.known[effects] = np.column_stack([table[axis] for axis in "xyz"])
        return self.known[effects]


def fresh(seed: int) -> dict[str, Any]:
    """Return arm, moment frame and number of rows of a case on an arm whose frames are anywhere."""
    n = int(np.random.default_rng(seed).integers(150, 301))
    return {"n": n, "arm": FRESH_ARMS[seed % 4], "moment_frame": ("before", "after")[seed // 4 % 2]}


def is_fresh(arm: str) -> bool:
    """Return whether the frames of a class of arms are not those of Denavit and Hartenberg."""
    return arm in FRESH_ARMS


def _setting(
    rng: np.random.Generator,
    n: int,
    *,
    arm: str,
    moment_frame: MomentFrame,
    elastic: bool,
    masses: float,
    one_payload: bool,
    columns: set[str],
    in_order: bool,
) -> _Setting:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(kuka_urdf_path())
        if arm != "kuka":
            path = Path(folder) / "robot.urdf"
            frames = arm.split()[0] if is_fresh(arm) else "plain"
            path.write_text(random_urdf(rng, heavy=arm.endswith("heavy"), frames=frames), encoding="utf-8")
        robot = Robot.from_urdf(path, tip="tool0")
        machine = sim.TrueMachine.from_urdf(path, tip="tool0")
    light = arm.endswith("light")
    machine = machine.draw_errors(
        rng, sigma_length=2e-4 if light else 5e-4, sigma_angle=1e-3, sigma_offset=1e-3 if light else 2e-3
    ).draw_masses(rng, sigma=masses)
    machine = replace(machine, moment_frame=moment_frame)
    if elastic:
        # The wrist is softer than the shoulder, as it is smaller.
        drive = np.array([1.0, 1.0, 1.5, 8.0, 8.0, 12.0]) * rng.uniform(0.7, 1.3, 6) * (5e-6 if light else 2e-7)
        bearing = np.outer([0.15, 0.15], drive * rng.uniform(0.5, 1.5, 6))
        if is_fresh(arm):
            # Soft one way: where the frames of the URDF are turned, across none of Denavit and Hartenberg's axes.
            bearing *= rng.uniform(0.4, 1.6, (2, 6))
        machine = replace(machine, compliance=np.vstack([bearing, drive]).T)
    q = sim.plan_poses(machine.nominal, n, rng, min_height=-0.5 if light else 0.1)
    load = 6.0 if light else float(rng.choice([60.0, 100.0, 120.0]))
    payload = np.full(n, load)
    if not one_payload:
        payload[: n // 2] = 0.0
        if rng.random() < 0.5:
            payload = np.roll(np.where(np.arange(n) % 2, load, 0.0), 1)
    time = np.arange(n) * 40.0
    warming = 20.0 + 12.0 * (1.0 - np.exp(-time / rng.uniform(1500.0, 6000.0)))
    conditions: dict[str, Any] = {"payload": payload}
    if "temperature" in columns or rng.random() < 0.3:
        conditions["temperature"] = warming + rng.normal(0.0, 0.5, n)
    if "time" in columns or rng.random() < 0.3:
        conditions["time"] = time
    if not in_order and ("approach" in columns or rng.random() < 0.3):
        conditions["approach"] = rng.choice([-1, 1], (n, 6))
    hall = np.eye(4)
    hall[:3, :3], hall[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.uniform(-4.0, 4.0, 3)
    # Off the axis of the last joint, or nothing could be seen of it.
    tool = np.append(rng.choice([-1.0, 1.0], 2) * rng.uniform(0.05, 0.2, 2), rng.uniform(0.05, 0.25)) * (
        0.6 if light else 1.0
    )
    com = (0.01, 0.02, 0.08) if light else (0.06, 0.03, 0.2)
    setting = _Setting(machine, robot, q, hall, tool, conditions, com, arm, in_order)
    poses = machine.poses(q, payload=payload, payload_com=com)
    setting.moments = np.abs(machine.equilibrium(poses).loads.drive).max(axis=0)
    return setting


def _plain(options: Options, *, moment_frame: MomentFrame, elastic: bool) -> Options:
    """Return options for the whole machine but what is hidden."""
    return replace(options, effects=ELASTIC if elastic else GEOMETRIC, moment_frame=moment_frame)


class _Absorber:
    """Takes off a difference of positions what a refitted elastic model takes up, to first order."""

    def __init__(self, setting: _Setting, options: Options, soft: HiddenEffect | None = None) -> None:
        """Take the model of some options, and masses that show through its compliances and through what is soft."""
        rows = _table(setting, setting.positions())
        fit = calibrate(setting.robot, rows, replace(options, loss="none"))
        masses = MassError.of(*_bent(fit.fit, soft))
        model = fit.model.with_effects([*fit.model.effects, *([masses] if masses else [])])
        relative = [parameter.size for parameter in model.parameters[len(fit.values) :]]
        free = np.ones(model.n_parameters, bool)
        values = np.append(fit.values, np.zeros(len(relative)))
        # By rows, of which a fit may make fewer poses.
        pieces = fit.readings(rows).with_model(model).linearise(values, free)
        self.jacobian = np.concatenate([J.transpose(2, 1, 0) for _, _, J in pieces]) / SIGMA
        # Directions that only priors hold (parallel axes) absorb no more than their priors let them.
        self.held = 1.0 / np.append(fit.fit.priors.sizes, relative)
        self.n_fit = len(fit.values)
        self.training = hold_out(rows, 0.2, split="blocked", seed=0)[0].rows - rows.rows[0]

    def strength(self, difference: np.ndarray) -> float:
        """Return lambda of a difference of positions, shape (N, 3)."""
        return self._left(difference, self.jacobian[:, :, : self.n_fit], self.held[: self.n_fit])

    def seen(self, difference: np.ndarray) -> float:
        """Return what of it a discovery can see: on the training rows, with masses known to some per cent."""
        return self._left(difference[self.training], self.jacobian[self.training], self.held)

    @staticmethod
    def _left(difference: np.ndarray, jacobian: np.ndarray, held: np.ndarray) -> float:
        d = difference.ravel() / SIGMA
        A = np.vstack([jacobian.reshape(len(d), -1), np.diag(held)])
        scale = np.linalg.norm(A, axis=0)
        target = np.append(d, np.zeros(len(held)))
        p = np.linalg.lstsq(A / scale, target, rcond=None)[0]
        # Only what is left of the readings: parameters that leave their priors show nothing.
        return float(np.sum((target - A / scale @ p)[: len(d)] ** 2))


def _bent(fit: ModelFit, soft: HiddenEffect | None) -> tuple[Model, np.ndarray]:
    """Return a fit's model and values with the hidden compliance of one drive or bearing, as soft in all directions."""
    if soft is None:
        return fit.model, fit.values
    effect = {kind.name: kind for kind in (JointElasticity, BearingElasticity)}[soft.effect]((str(soft.joint),))
    model = fit.model.with_effects([*fit.model.effects, effect])
    sizes = [size for name, size in vars(soft).items() if name in ("size", "size_y")]
    return model, np.append(fit.values, np.full(model.n_parameters - len(fit.values), np.mean(sizes)))


def _table(setting: _Setting, positions: np.ndarray) -> Measurements:
    q = setting.q
    arrived = {"move": moves_by_order(q), "approach": sides_of(moves_by_order(q))} if setting.in_order else {}
    return measurements_from_arrays(setting.machine.names, q, position=positions, **setting.conditions, **arrived)


def _kink(joint: int, place: float) -> Callable[[Poses, int], np.ndarray]:
    return lambda poses, _: np.abs(poses.q[:, joint] - place)


# Foreign effects: (joint index) from the generator of numbers.
def _foreign(kind: str, rng: np.random.Generator, names: tuple[str, ...], q: np.ndarray) -> Foreign:
    i = int(rng.integers(0, 5))
    other = int(rng.choice([j for j in range(6) if j != i]))
    place = float(np.quantile(q[:, i], rng.uniform(0.3, 0.7)))
    width = np.ptp(q[:, other]) / 4.0
    middle = float(np.median(q[:, other]))
    acts_on = "drive"
    if kind == "step":
        shape = lambda poses, j: (poses.q[:, j] > place).astype(float)  # noqa: E731
    elif kind == "kink":
        shape = _kink(i, place)
    elif kind == "product":
        shape = lambda poses, j: np.sin(poses.q[:, j]) * np.sin(poses.q[:, other])  # noqa: E731
    elif kind == "cubed_tilt":
        i, acts_on = 4, str(rng.choice(["x", "y"]))
        shape = lambda poses, j: np.sin(poses.q[:, j]) ** 3  # noqa: E731
    elif kind == "other_joint":
        shape = lambda poses, j: np.exp(-0.5 * ((poses.q[:, other] - middle) / width) ** 2)  # noqa: E731
    elif kind == "other_wave":
        shape = lambda poses, j: np.sin(2.0 * poses.q[:, other] + 0.5)  # noqa: E731
    elif kind in INTERACTIONS:
        shape = _of_two(kind, rng, q, i, other)
    else:
        raise ValueError(kind)
    return Foreign(joint=names[i], size=1e-4, shape=shape, acts_on=acts_on)


def _of_two(kind: str, rng: np.random.Generator, q: np.ndarray, i: int, other: int) -> Callable[[Poses, int], np.ndarray]:
    """Return a smooth function of joint i's position and another's, or of the other's alone in fine waves."""
    both = q[:, [i, other]]
    if kind == "two_waves":
        orders, phases = rng.integers(1, 4, 2), rng.uniform(0.0, 2.0 * np.pi, 2)
        return lambda poses, j: np.prod(np.sin(poses.q[:, [j, other]] * orders + phases), axis=1)
    if kind == "oblique_wave":
        (own, of_other), phase = rng.uniform(0.5, 3.5, 2), rng.uniform(0.0, 2.0 * np.pi)
        of_other *= rng.choice([-1.0, 1.0])
        return lambda poses, j: np.sin(own * poses.q[:, j] + of_other * poses.q[:, other] + phase)
    if kind == "fine_wave":
        order, phase = rng.uniform(2.0, 5.5), rng.uniform(0.0, 2.0 * np.pi)
        return lambda poses, j: np.sin(order * poses.q[:, other] + phase)
    if kind == "bump":
        middle = np.quantile(both, rng.uniform(0.25, 0.75), axis=0)
        scale = rng.uniform(0.15, 0.3, 2) * np.ptp(both, axis=0)
        return lambda poses, j: np.exp(-0.5 * np.sum(((poses.q[:, [j, other]] - middle) / scale) ** 2, axis=1))
    # Waves of random directions, of about two thirds of a period over both ranges (one standard deviation).
    steep, phases = rng.normal(0.0, 4.0, (40, 2)) / np.ptp(both, axis=0), rng.uniform(0.0, 2.0 * np.pi, 40)
    return lambda poses, j: np.mean(np.cos(poses.q[:, [j, other]] @ steep.T + phases), axis=1)


FOREIGN = ("step", "kink", "product", "cubed_tilt", "other_joint", "other_wave")
# Errors of one joint's drive that follow its own position and another joint's together, or the other's in fine waves.
INTERACTIONS = ("two_waves", "oblique_wave", "fine_wave", "bump", "field")
NAMED = (
    "gear_eccentricity",
    "transmission_error",
    "gear_ratio",
    "joint_coupling",
    "axis_wobble",
    "backlash",
    "load_backlash",
    "thermal_expansion",
    "thermal_offset",
    "base_drift",
    "nonlinear_elasticity",
    "link_bending",
    "base_elasticity",
    "gravity_compensator",
    "payload_error",
    "gear_ripple",
)
# One joint's drive or bearing of an arm that is rigid otherwise.
SOFT = ("joint_elasticity", "bearing_elasticity")
NEEDS = {"backlash": "approach", "thermal_expansion": "temperature", "thermal_offset": "temperature", "base_drift": "time"}
_LOADED = ("load_backlash", "nonlinear_elasticity")


def _named(kind: str, rng: np.random.Generator, setting: _Setting) -> HiddenEffect:
    names = setting.machine.names
    i = int(rng.integers(0, 6))
    values: dict[str, Any] = {"joint": names[i], "size": 1e-4}
    if kind == "gear_eccentricity":
        values |= {"order": int(rng.integers(1, 3)), "phase": rng.uniform(0, 6.28)}
    elif kind == "gear_ripple":
        values |= {"order": float(rng.uniform(25.0, 200.0)), "phase": rng.uniform(0, 6.28)}
    elif kind == "transmission_error":
        values |= {"seed": int(rng.integers(1000)), "bumps": int(rng.integers(5, 12))}
    elif kind == "joint_coupling":
        j = int(np.clip(i + rng.choice([-1, 1]), 0, 5))
        values |= {"source": names[j if j != i else (1 if i == 0 else 4)]}
    elif kind == "axis_wobble":
        i = int(rng.integers(0, 5))
        frame, order = [("before", 2), ("after", 1), ("after", 2)][int(rng.integers(3))]
        shape = {"roundness": float(rng.uniform(0.2, 1.0)), "phase": rng.uniform(0, 6.28)}
        values |= {"joint": names[i], "order": order, "frame": frame, **shape}
    elif kind in _LOADED:
        i = int(rng.integers(1, 5))
        key = "stiffening" if kind == "nonlinear_elasticity" else "transition"
        values |= {"joint": names[i], key: float(setting.moments[i] * (0.3 if key == "stiffening" else 0.02))}
        values["size"] = 1e-7 if kind == "nonlinear_elasticity" else 1e-4
    elif kind == "thermal_expansion":
        values |= {"joint": None if rng.random() < 0.6 else names[int(rng.integers(1, 3))], "size": 1e-5}
    elif kind == "thermal_offset":
        values["size"] = 1e-5
    elif kind == "base_drift":
        direction = rng.standard_normal(3)
        values |= {"joint": None, "size": 1e-8, "direction": tuple(direction / np.linalg.norm(direction))}
    elif kind == "link_bending":
        values |= {"joint": names[int(rng.integers(1, 3))], "size": 1e-9}
    elif kind == "base_elasticity":
        values |= {"joint": None, "size": 1e-9, "weights": (1.0, float(rng.choice([0.3, 1.0])), 0.0)}
    elif kind == "gravity_compensator":
        light = setting.arm.endswith("light")
        compliance = float(setting.machine.compliance[1, 2]) or 1e-7
        values |= {"joint": names[1], "size": 1e3, "compliance": compliance}
        if light:
            values |= {"anchor": (-0.05, 0.12, 0.0), "lever": (0.08, 0.0, 0.0), "free_length": 0.06}
    elif kind == "payload_error":
        values |= {"joint": None, "size": 0.1 if setting.arm.endswith("light") else 1.0}
    elif kind == "joint_elasticity":
        values |= {"joint": names[int(rng.integers(1, 6))], "size": 1e-8}
    elif kind == "bearing_elasticity":
        soft = float(rng.uniform(0.2, 0.7))
        values |= {"size": 1e-8, "size_y": 1e-8 * soft, "moment_frame": setting.machine.moment_frame}
    return sim.hidden_effect(kind, **values)


def _scaled(
    effect: HiddenEffect, wanted: float, setting: _Setting, absorber: _Absorber
) -> tuple[HiddenEffect, float, float]:
    """Return the effect of the size that has the wanted strength, its strength and its raw rms [m]."""
    nothing = setting.positions()
    got = raw = 0.0
    for _ in range(3):
        difference = setting.positions(effect) - nothing
        got, raw = absorber.strength(difference), float(np.sqrt(np.mean(np.sum(difference**2, axis=1))))
        if got <= 1e-9:
            return effect, got, np.inf
        if abs(got / wanted - 1.0) < 0.02:
            break
        effect = _times(effect, float(np.sqrt(wanted / got)))
        if raw * np.sqrt(wanted / got) > 1e-2:
            return effect, got, np.inf
    return effect, got, raw


def _times(effect: HiddenEffect, factor: float) -> HiddenEffect:
    sizes = {name: factor * size for name, size in vars(effect).items() if name in ("size", "size_y")}
    return replace(effect, **sizes)


# Largest rms of what a hidden effect does to the tool [m]; beyond it nobody would look for it in the residuals.
_RAW = 2e-3


def draw_case(
    kind: str,
    seed: int,
    *,
    strength: float | None = None,
    n: int | None = None,
    arm: str | None = None,
    elastic: bool = True,
    masses: float = 0.03,
    noise: str = "normal",
    one_payload: bool = False,
    moment_frame: MomentFrame = "after",
    in_order: bool = False,
) -> Case:
    """Draw a case.

    Args:
        kind: "null", a name of ``NAMED``, ``FOREIGN`` or ``INTERACTIONS``, "measurement_scale", or two names of ``NAMED``
            with a plus.
        seed: of everything.
        strength: lambda of each effect; from 60 to 300 unless given.
        n: rows; from 150 to 500 unless given.
        arm: "kuka", "heavy", "light" or one of ``FRESH_ARMS``; of the first three in turn unless given.
        elastic: whether the arm is elastic; one whose elasticity is hidden has no other.
        masses: relative error of the URDF's masses and centres.
        noise: "normal", "outliers" (3 % of the rows off by millimetres) or "heavy" (Student t4).
        one_payload: the same load in all rows.
        moment_frame: where the moments on its bearings bend the arm.
        in_order: whether rows stand in the order of measurement, which then tells how joints arrived.
    """
    rng = np.random.default_rng([seed, crc32(kind.encode())])
    arm = ("kuka", "heavy", "light")[seed % 3] if arm is None else arm
    n = int(rng.integers(150, 501)) if n is None else n
    parts = [] if kind == "null" else kind.split("+")
    columns = {NEEDS[part] for part in parts if part in NEEDS}
    elastic = elastic and not set(parts) & set(ELASTICITY)
    if "base_elasticity" in parts:
        # What tilts with the link before the first joint is the base.
        moment_frame = "after"
    options = Options(effects=GEOMETRIC, sigma=SIGMA, moment_frame="paper" if is_fresh(arm) else "after")
    for _ in range(30):
        setting = _setting(
            rng,
            n,
            arm=arm,
            moment_frame=moment_frame,
            elastic=elastic,
            masses=masses,
            one_payload=one_payload,
            columns=columns,
            in_order=in_order,
        )
        options = replace(options, payload_centre=setting.com)
        hidden: list[HiddenEffect] = []
        got, raw, seen = 0.0, 0.0, np.inf
        # Also where the machine is rigid, moments may absorb what they can.
        plain = _plain(options, moment_frame=moment_frame, elastic=not set(parts) & set(ELASTICITY))
        absorber = _Absorber(setting, plain) if parts and kind != "measurement_scale" else None
        for part in parts:
            if part == "measurement_scale":
                hidden.append(sim.hidden_effect(part, size=4e-5))
                continue
            assert absorber is not None
            foreign = part in (*FOREIGN, *INTERACTIONS)
            effect = _foreign(part, rng, setting.machine.names, setting.q) if foreign else _named(part, rng, setting)
            wanted = float(np.exp(rng.uniform(np.log(60.0), np.log(300.0)))) if strength is None else strength
            effect, got, raw_one = _scaled(effect, wanted, setting, absorber)
            raw = max(raw, raw_one)
            if raw_one < _RAW:
                through = _Absorber(setting, plain, effect) if part in ELASTICITY else absorber
                seen = min(seen, through.seen(setting.positions(effect) - setting.positions()))
            hidden.append(effect)
        if raw < _RAW and (len(hidden) < 2 or (hidden[0].effect, hidden[0].joint) != (hidden[1].effect, hidden[1].joint)):
            break
    else:
        raise ValueError(f"{kind}: no arm on which it is seen without moving the tool by {_RAW} m")
    clean = setting.positions(*hidden)
    rows = _table(setting, clean + _noise(noise, clean.shape, rng))
    parts_of_machine = setting.robot, rows, options, tuple(hidden)
    return Case(kind, seed, *parts_of_machine, got, seen, elastic, arm, clean, setting.positions(), moment_frame)


def _noise(noise: str, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    if noise == "heavy":
        return SIGMA * rng.standard_t(4, shape) / np.sqrt(2.0)
    drawn = SIGMA * rng.standard_normal(shape)
    if noise == "outliers":
        wrong = rng.random(len(drawn)) < 0.03
        drawn[wrong] += rng.uniform(1e-3, 5e-3, (int(wrong.sum()), 1)) * rng.choice([-1.0, 1.0], (int(wrong.sum()), 3))
    return drawn


def discover(case: Case) -> History:
    """Discover as the command does: every fifth row held out by regions, the geometric model to start from."""
    training, _ = hold_out(case.rows, 0.2, split="blocked", seed=0)
    groups = row_groups(training, split="blocked", seed=0) % 8
    frames = MOMENT_FRAMES if is_fresh(case.arm) else ()
    return discover_effects(calibrate(case.robot, training, case.options).fit, groups, frames=frames)


def gap_over_oracle(case: Case, trail: History) -> float:
    """Return the error on held-out rows without noise, over that of a fit that is told what is hidden.

    Where the two take moments in different conventions, the told one takes that which fits better, as anybody has to.
    """
    training, held = hold_out(case.rows, 0.2, split="blocked", seed=0)
    clean = case.clean[held.rows - case.rows.rows[0]]
    told = []
    for frame in {case.moment_frame, trail.final.problem.chain.moment_frame}:
        fits = [calibrate(case.robot, training, replace(case.plain, moment_frame=frame)).fit]
        for hidden in case.hidden if not case.is_soft else ():
            fits = [refit(fit, [*fit.options.effects, effect]) for fit in fits for effect in _known_forms(hidden, fit)]
        told.append(min(fits, key=lambda fit: gap(fit, held, clean)))
    return gap(trail.final, held, clean) / gap(min(told, key=fit_cost), held, clean)


def gap(fit: ModelFit, held: Measurements, clean: np.ndarray) -> float:
    """Return the error of a fit on held-out rows without noise, root mean square [m]."""
    problem = fit.readings(held)
    poses = problem.model.predict(problem.model.own(fit.values), problem.conditions)
    return float(np.sqrt(np.mean(np.sum((poses[:, :, 3] - clean) ** 2, axis=1))))


def _known_forms(hidden: HiddenEffect, fit: ModelFit) -> list[Effect]:
    """Return the catalogue's effect that a hidden one is, a drive curve in several resolutions."""
    values, conditions = vars(hidden), fit.station.conditions
    joint = str(hidden.joint)
    if hidden.effect == "transmission_error":
        q = conditions.q[:, fit.model.chain.robot.joint_names.index(joint)]
        return [catalogue.TransmissionError.over(joint, q, size) for size in (8, 12, 18, 26) if size <= len(q) // 6]
    if hidden.effect == "payload_error":
        return [catalogue.PayloadError(compliances=tuple(compliances_of(fit.model, fit.values).tolist()))]
    if hidden.effect == "base_drift":
        return [catalogue.BaseDrift(turns=False)]
    if hidden.effect == "thermal_expansion":
        return [catalogue.ThermalExpansion(hidden.joint)]
    if hidden.effect == "base_elasticity":
        return [catalogue.BaseElasticity()]
    kind = {c.name: c for c in vars(catalogue).values() if hasattr(c, "name")}[hidden.effect]
    known = {f.name for f in fields(kind)}
    return [kind(**{name: value for name, value in values.items() if name in known})]


@dataclass(frozen=True)
class Verdict:
    """What a discovery made of a case.

    Attributes:
        kind, seed, strength, seen, arm, n: the case.
        truth: what is hidden.
        named: each accepted effect with its equivalents, elasticity left out.
        instead: what could be in the place of some compliance.
        details: the same in words, for people.
        elastic: whether joint or bearing elasticity was named.
        sound: whether that is right.
    """

    kind: str
    seed: int
    strength: float
    seen: float
    arm: str
    n: int
    truth: tuple[Name, ...]
    named: tuple[tuple[Name, ...], ...]
    instead: tuple[Name, ...]
    details: tuple[str, ...]
    elastic: bool
    sound: bool

    @property
    def detected(self) -> bool:
        """Whether anything was found, or told to be perhaps in the place of some compliance."""
        return bool(self.named) or any(_agrees(true, self.instead) for true in self.truth)

    @property
    def right(self) -> bool:
        """Whether each hidden effect stands in some class (a nameless one: its joint)."""
        return all(any(_agrees(true, c) for c in (*self.named, self.instead)) for true in self.truth)

    @property
    def first_right(self) -> bool:
        """Whether each hidden effect is the first name of some class."""
        return all(any(_agrees(true, c[:1]) for c in self.named) for true in self.truth)

    @property
    def false_names(self) -> tuple[Name, ...]:
        """Accepted names of the catalogue in whose class nothing hidden stands."""
        return tuple(c[0] for c in self.named if c[0][0] != "unnamed" and not any(_agrees(t, c) for t in self.truth))

    @property
    def joint_right(self) -> bool:
        """Whether the strongest name stands at a joint of a hidden effect."""
        return bool(self.named) and self.named[0][0][1] in {t[1] for t in self.truth}

    @property
    def joint_known(self) -> bool:
        """Whether the joint of each hidden effect stands in some class.

        A tilt across one joint can be the turn of the joint before it, to the last digit: then no data know which.
        """
        return all(any(t[1] == name[1] for c in self.named for name in c) for t in self.truth)

    @property
    def class_size(self) -> int:
        """Size of the smallest class with a hidden effect in it, 0 if none."""
        return min((len(c) for c in self.named for t in self.truth if _agrees(t, c)), default=0)

    def __str__(self) -> str:
        """Return the case and its names in a line."""
        truth = " + ".join(_words(name) for name in self.truth) or "nothing"
        case = f"{self.kind} {self.seed} {self.arm} N={self.n} lambda={self.strength:.0f} seen {self.seen:.0f}"
        return f"{case}: {truth} -> {' | '.join(self.details)}"


def _agrees(true: Name, candidates: tuple[Name, ...]) -> bool:
    return true in candidates


def _words(name: Name) -> str:
    return " ".join(part for part in name if part)


def name_of(effect: Any) -> Name:
    """Return the name of an effect; of a nameless one its joint alone."""
    _, joint, source = effect.heading
    return effect.name, joint, source


def judge(case: Case, trail: History | None = None) -> Verdict:
    """Return what a discovery made of a case; of a new one unless its trail is given."""
    trail = discover(case) if trail is None else trail
    named, details, elastic = [], [], False
    sure = [entry for step in trail.steps if step.is_elastic for entry in significant_compliances(trail.final, step.effects)]
    instead = {
        (name_of(s.effect), name_of(other)) for s in sure for other in instead_of(trail.last, s.effect, s.estimate, s.given)
    }
    for step in trail.steps:
        names = tuple(name_of(e) for e in (step.effects[0], *step.equivalent))
        if names[0][0] in ELASTICITY:
            elastic = True
            if case.is_soft:
                own = significant_compliances(trail.final, step.effects, step.equivalent)
                found = [[name_of(e) for e in (entry.effect, *entry.others)] for entry in own]
                named += map(tuple, found)
                details += [" ~ ".join(map(_words, names)) for names in found]
            else:
                details += [f"({_words(compliance)} ~ {_words(other)})" for compliance, other in sorted(instead)]
            continue
        named.append(names)
        extra = {
            k: v
            for k, v in vars(step.effects[0]).items()
            if k in ("order", "frame", "acts_on", "depends_on", "shape", "size")
        }
        words = _words(names[0]) + "".join(f" {k}={v}" for k, v in extra.items())
        words += f" T={step.score.gain:.0f}/{step.score.rank}"
        details.append(words + (f" ~ {', '.join(_words(n) for n in names[1:])}" if names[1:] else ""))
    sound = elastic == (case.elastic or case.is_soft)
    where = case.kind, case.seed, case.strength, case.seen, case.arm, len(case.rows)
    others = tuple(other for _, other in instead)
    return Verdict(*where, case.truth, tuple(named), others, tuple(details), elastic, sound)


def summary(verdicts: list[Verdict]) -> str:
    """Return rates by kind."""
    lines = []
    for kind in Counter(v.kind for v in verdicts):
        own = [v for v in verdicts if v.kind == kind]
        size = np.median([v.class_size for v in own if v.class_size] or [0])
        lines.append(
            f"{kind:22} {len(own):3} detected {np.mean([v.detected for v in own]):.2f}"
            f" right {np.mean([v.right for v in own]):.2f}"
            f" first {np.mean([v.first_right for v in own]):.2f} joint {np.mean([v.joint_right for v in own]):.2f}"
            f" class {size:.0f} false {np.mean([bool(v.false_names) for v in own]):.2f}"
            f" elastic right {np.mean([v.sound for v in own]):.2f}"
        )
    return "\n".join(lines)
