"""True machines and hidden effects of a size that is typical of their arm."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.effect import HiddenEffect
from pincal.simulate.hidden import HIDDEN_EFFECTS, hidden_effect
from pincal.simulate.machine import TrueMachine
from pincal.simulate.planning import plan_poses

WHOLE_ARM = ("base_elasticity", "payload_error", "base_drift", "measurement_scale")
"""Effects that act on no joint in particular."""

LOADED = (
    "joint_elasticity",
    "bearing_elasticity",
    "nonlinear_elasticity",
    "link_bending",
    "base_elasticity",
    "gravity_compensator",
    "payload_error",
    "load_backlash",
)
"""Effects that follow from loads and need an arm with masses."""

NEEDED_COLUMNS = {
    "backlash": "approach",
    "thermal_expansion": "temperature",
    "thermal_offset": "temperature",
    "base_drift": "time",
}
"""Column of the table without which an effect can't be told from the others."""

SIZE_UNITS = dict.fromkeys(
    ("gear_eccentricity", "transmission_error", "axis_wobble", "backlash", "load_backlash", "joint_scatter"), "rad"
) | {
    "joint_elasticity": "rad/(N m)",
    "bearing_elasticity": "rad/(N m)",
    "nonlinear_elasticity": "rad/(N m)",
    "base_elasticity": "rad/(N m)",
    "link_bending": "1/(N m^2)",
    "gravity_compensator": "N/m",
    "payload_error": "kg",
    "gear_ratio": "1",
    "joint_coupling": "1",
    "measurement_scale": "1",
    "thermal_expansion": "1/K",
    "thermal_offset": "rad/K",
    "base_drift": "m/s",
}
"""Unit of ``size`` by the name of the effect; on a sliding joint m instead of rad."""

# Geometric errors of an industrial arm: displacements relative to its reach, angles [rad].
_LENGTH, _ANGLE, _OFFSET = 2e-4, 1e-3, 2e-3
# What a drive winds up under the largest moment of the arm [rad], and what a bearing tilts, relative to it.
_WINDUP, _BEARING = 1e-3, 0.15
# A load that the arm is made for, relative to its own mass.
_LOAD = 0.1
# No joint is so soft that it is made for less than this part of the largest moment.
_LEAST_MOMENT = 0.02
# Poses by which moments are judged.
_PROBES = 100
# Reach of the arm to whose size the gravity compensator's own dimensions belong [m].
_COMPENSATOR_REACH = 2.6

# Typical sizes that don't depend on the arm: some tens of arcseconds for gears, steel that grows.
_SIZES = {
    "gear_eccentricity": 1.5e-4,
    "transmission_error": 1e-4,
    "gear_ratio": 1e-4,
    "joint_coupling": 2e-4,
    "axis_wobble": 1e-4,
    "backlash": 2e-4,
    "load_backlash": 2e-4,
    "thermal_expansion": 1.2e-5,
    "thermal_offset": 1e-5,
    "base_drift": 2e-8,
    "measurement_scale": 2e-5,
    "joint_scatter": 1e-4,
}


def arm_reach(machine: TrueMachine) -> float:
    """Return the sum of the distances from joint to joint and to the tip [m]."""
    return float(np.linalg.norm(machine.nominal.placements[1:, :3, 3], axis=1).sum())


def typical_moments(machine: TrueMachine) -> np.ndarray:
    """Return the moment for which each joint is made: the largest in random poses with a tenth of the arm's mass as load.

    Args:
        machine: The machine; only its nominal arm and gravity count.

    Returns:
        Moments [N m], shape (n,), none below a fiftieth of the largest.

    Raises:
        BadInputError: If the arm has no mass.
    """
    arm = machine.nominal
    load = _LOAD * float(arm.masses.sum())
    if load <= 0.0:
        raise BadInputError("the arm has no mass, so that nothing bends it; expected inertial data in the URDF")
    fields = ("placement_errors", "joint_offsets", "com_errors", "compliance")
    nothing: dict[str, Any] = {name: 0.0 * getattr(machine, name) for name in fields}
    bare = replace(machine, mass_factors=np.ones(len(machine.names)), effects=(), **nothing)
    q = plan_poses(arm, _PROBES, np.random.default_rng(0), min_height=None)
    com = (0.0, 0.0, 0.1 * arm_reach(machine))
    loads = bare.equilibrium(bare.poses(q, payload=load, payload_com=com)).loads
    moments = np.linalg.norm(loads.before, axis=2).max(axis=0)
    return np.asarray(np.maximum(moments, _LEAST_MOMENT * moments.max()))


def draw_typical_errors(machine: TrueMachine, rng: np.random.Generator, *, scale: float = 1.0) -> TrueMachine:
    """Return the machine with random errors: 0.2 mm a metre of reach, 1 mrad, 2 mrad of joint zeros, all times ``scale``."""
    return machine.draw_errors(
        rng, sigma_length=scale * _LENGTH * arm_reach(machine), sigma_angle=scale * _ANGLE, sigma_offset=scale * _OFFSET
    )


def draw_typical_elasticity(machine: TrueMachine, rng: np.random.Generator, *, scale: float = 1.0) -> TrueMachine:
    """Return the machine with drives that wind up by about 1 mrad under their largest moment and bearings that give way.

    Args:
        machine: The machine.
        rng: Source of randomness.
        scale: Compliance relative to a typical one.

    Returns:
        A new machine.

    Raises:
        BadInputError: If the arm has no mass.
    """
    n = len(machine.names)
    drive = scale * _WINDUP / typical_moments(machine) * rng.uniform(0.7, 1.3, n)
    # A bearing gives way alike about all axes across its own: then it doesn't matter how the URDF turns its frame.
    bearing = _BEARING * drive * rng.uniform(0.5, 1.5, n)
    return replace(machine, compliance=np.column_stack((bearing, bearing, drive)))


def typical_effect(machine: TrueMachine, name: str, rng: np.random.Generator, **given: Any) -> HiddenEffect:
    """Make a hidden effect, of typical size and at a random joint unless these are given.

    Args:
        machine: The machine that is to have it.
        name: A key of :data:`pincal.simulate.HIDDEN_EFFECTS`.
        rng: Source of randomness.
        **given: Fields of the effect: ``joint``, ``size`` and what its class adds.

    Returns:
        The effect.

    Raises:
        BadInputError: If there is no such effect, field or joint, or if it needs masses that the arm lacks.

    Example:
        >>> from pincal.builtin import kuka_urdf_path
        >>> machine = TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0")
        >>> typical_effect(machine, "backlash", np.random.default_rng(0), joint="joint_2").size
        0.0002
    """
    if name not in HIDDEN_EFFECTS:
        return hidden_effect(name)
    given = _placed(machine, name, rng, given)
    # Fields are checked before anything is worked out for them.
    hidden_effect(name, **given)
    return hidden_effect(name, **(_typical_values(machine, name, given.get("joint")) | given))


def _placed(machine: TrueMachine, name: str, rng: np.random.Generator, given: dict[str, Any]) -> dict[str, Any]:
    """Return the fields with a joint, where the effect acts on one, and the source of a coupling; both checked."""
    if name in WHOLE_ARM:
        if given.get("joint") is not None:
            raise BadInputError(f"{name}: acts on the whole arm; leave out joint {given['joint']!r}")
        return given
    for key in ("joint", "source"):
        if given.get(key) is not None:
            machine.nominal.index(given[key])
    if name == "joint_coupling":
        return _with_source(machine.names, rng, given)
    # All links together grow with temperature unless one is named.
    if name == "thermal_expansion" or given.get("joint") is not None:
        return given
    return given | {"joint": str(rng.choice(_candidates(machine, name)))}


def _candidates(machine: TrueMachine, name: str) -> list[str]:
    """Return the joints at which an effect does anything that can be seen."""
    if name == "gravity_compensator":
        return [machine.names[min(1, len(machine.names) - 1)]]
    if name == "link_bending":
        lengths = np.linalg.norm(machine.nominal.placements[1:, :3, 3], axis=1)
        return [n for n, length in zip(machine.names, lengths, strict=True) if length > 0.1 * lengths.max()]
    return list(machine.names)


def _with_source(names: tuple[str, ...], rng: np.random.Generator, given: dict[str, Any]) -> dict[str, Any]:
    """Add what is missing of a coupling: the joint, and the one before it (after the first) as its source."""
    if len(names) < 2:
        raise BadInputError("joint_coupling: the arm has one joint only; it needs two")
    joint = given.get("joint") or str(rng.choice([n for n in names if n != given.get("source")]))
    source = given.get("source") or names[names.index(joint) - 1 if joint != names[0] else 1]
    if joint == source:
        raise BadInputError(f"joint_coupling: joint {joint!r} can't be its own source; name another one")
    return given | {"joint": joint, "source": source}


def _typical_values(machine: TrueMachine, name: str, joint: str | None) -> dict[str, Any]:
    if name not in LOADED:
        return {"size": _SIZES[name]}
    moments = typical_moments(machine)
    i = 0 if joint is None else machine.nominal.index(joint)
    moment = float(moments[i])
    if name == "load_backlash":
        return {"size": _SIZES[name], "transition": _LEAST_MOMENT * moment}
    if name == "nonlinear_elasticity":
        # 0.3 mrad more at the largest moment, most of it in its first third.
        stiffening = 0.3 * moment
        return {"size": 3e-4 / (stiffening * float(np.arcsinh(1.0 / 0.3))), "stiffening": stiffening}
    if name == "gravity_compensator":
        return _compensator(machine, i, moment)
    sizes = {
        "joint_elasticity": 0.5 * _WINDUP / moment,
        "bearing_elasticity": 0.3 * _WINDUP / moment,
        "base_elasticity": 0.1 * _WINDUP / moment,
        "payload_error": 0.01 * float(machine.nominal.masses.sum()),
    }
    if name in sizes:
        return {"size": sizes[name]}
    length = float(np.linalg.norm(machine.nominal.placements[i + 1][:3, 3]))
    return {"size": 0.2 * _WINDUP / (max(length, 1e-3) * moment)}


def _compensator(machine: TrueMachine, i: int, moment: float) -> dict[str, Any]:
    """Return a spring in proportion to the arm that takes about a third of the largest moment."""
    scale = arm_reach(machine) / _COMPENSATOR_REACH
    lever = 0.3 * scale
    compliance = float(machine.compliance[i, 2]) or _WINDUP / moment
    return {
        "size": 0.3 * moment / (lever * lever),
        "compliance": compliance,
        "anchor": (-0.25 * scale, 0.55 * scale, 0.0),
        "lever": (lever, 0.0, 0.0),
        "free_length": 0.3 * scale,
    }
