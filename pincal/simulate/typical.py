"""Hidden effects by name, and true machines and effects of sizes typical of the arm."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np

from pincal.errors import BadInputError, nearest_first
from pincal.simulate.effect import HIDDEN_EFFECTS, WINDUP, HiddenEffect, Scope, Site, SizedByLoad
from pincal.simulate.machine import TrueMachine
from pincal.simulate.planning import plan_poses


def hidden_effect(name: str, **values: Any) -> HiddenEffect:
    """Make a hidden effect from its name, a key of ``HIDDEN_EFFECTS``, and its fields.

    Raises:
        BadInputError: If there is no such effect, or it has no such field.

    Example:
        >>> hidden_effect("backlash", joint="joint_2", size=2e-4)
        Backlash(joint='joint_2', size=0.0002)
    """
    if name not in HIDDEN_EFFECTS:
        near = ", ".join(nearest_first([name], HIDDEN_EFFECTS))
        raise BadInputError(f"effect {name!r}: unknown; expected one of {near}")
    kind = HIDDEN_EFFECTS[name]
    known = [field.name for field in fields(kind)]
    if unknown := sorted(set(values) - set(known)):
        raise BadInputError(f"{name} has no {', '.join(unknown)}; it has {', '.join(known)}")
    try:
        return kind(**values)
    except TypeError as error:
        raise BadInputError(f"{name}: {error}; it has {', '.join(known)}") from error


# Geometric errors of an industrial arm: displacements relative to its reach, angles [rad].
_LENGTH = 2e-4
_ANGLE = 1e-3
_OFFSET = 2e-3
# Tilt of a bearing relative to the wind-up of its drive under the same moment.
_BEARING = 0.15
# Typical payload relative to the mass of the arm.
_LOAD = 0.1
# Least rated moment of a joint, as a fraction of the largest.
_LEAST_MOMENT = 0.02
# Number of random poses in which moments are computed.
_PROBES = 100


def typical_moments(machine: TrueMachine) -> np.ndarray:
    """Return the rated moment of each joint: the largest in random poses with a tenth of the arm's
    mass as payload.

    The moments [N m], shape (n,), at least a fiftieth of the largest, depend on the nominal arm and
    gravity alone.

    Raises:
        BadInputError: If the arm has no mass.
    """
    arm = machine.nominal
    load = _LOAD * float(arm.masses.sum())
    if load <= 0.0:
        raise BadInputError(
            "the arm has no mass, so nothing deflects it; expected inertial data in the URDF"
        )
    nominal = TrueMachine.of_arm(arm)
    # A robot in weightlessness is designed for moments of its accelerations, for which those on
    # earth are substituted.
    nominal = replace(nominal, gravity=machine.gravity) if any(machine.gravity) else nominal
    q = plan_poses(arm, _PROBES, np.random.default_rng(0), min_height=None)
    loads = nominal.equilibrium(
        nominal.poses(q, payload=load, payload_com=(0.0, 0.0, 0.1 * arm.reach))
    ).loads
    moments = np.linalg.norm(loads.before, axis=2).max(axis=0)
    return np.asarray(np.maximum(moments, _LEAST_MOMENT * moments.max()))


def draw_typical_errors(
    machine: TrueMachine, rng: np.random.Generator, *, scale: float = 1.0
) -> TrueMachine:
    """Return the machine with ``scale`` times 0.2 mm per metre of reach, 1 mrad, and 2 mrad of
    joint zeros.
    """
    return machine.draw_errors(
        rng,
        sigma_length=scale * _LENGTH * machine.nominal.reach,
        sigma_angle=scale * _ANGLE,
        sigma_offset=scale * _OFFSET,
    )


def draw_typical_elasticity(
    machine: TrueMachine, rng: np.random.Generator, *, scale: float = 1.0
) -> TrueMachine:
    """Return the machine with compliant bearings, and drives that wind up by about 1 mrad under
    their rated moment.

    ``scale`` is the compliance relative to a typical one.

    Raises:
        BadInputError: If the arm has no mass.
    """
    n = len(machine.names)
    drive = scale * WINDUP / typical_moments(machine) * rng.uniform(0.7, 1.3, n)
    # Equal compliance about all transverse axes, so that the orientation of the URDF's joint frame
    # does not matter.
    bearing = _BEARING * drive * rng.uniform(0.5, 1.5, n)
    return replace(machine, compliance=np.column_stack((bearing, bearing, drive)))


def typical_effect(
    machine: TrueMachine, name: str, rng: np.random.Generator, **given: Any
) -> HiddenEffect:
    """Make a hidden effect, as :func:`hidden_effect`, by default of typical size and at a random
    joint.

    Raises:
        BadInputError: If there is no such effect, field or joint, or if it needs masses that the
            arm lacks.

    Example:
        >>> from pincal.builtin import kuka_urdf_path
        >>> machine = TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0")
        >>> typical_effect(machine, "backlash", np.random.default_rng(0), joint="joint_2").size
        0.0002
    """
    if name not in HIDDEN_EFFECTS:
        return hidden_effect(name)
    kind = HIDDEN_EFFECTS[name]
    given = _with_joints(machine, kind, rng, given=given)
    # Check the fields before computing typical values, which may fail for other reasons.
    hidden_effect(name, **given)
    if not issubclass(kind, SizedByLoad):
        return hidden_effect(name, **({"size": kind.typical_size} | given))
    joint = 0 if given.get("joint") is None else machine.nominal.index(given["joint"])
    moment = float(typical_moments(machine)[joint])
    compliance = float(machine.compliance[joint, 2])
    site = Site(machine.nominal, joint, moment=moment, compliance=compliance)
    return hidden_effect(name, **(kind.typical_fields(site) | given))


def _with_joints(
    machine: TrueMachine,
    kind: type[HiddenEffect],
    rng: np.random.Generator,
    *,
    given: dict[str, Any],
) -> dict[str, Any]:
    """Return the fields with a joint, if the effect acts on one, and with the source of a coupling,
    both checked.
    """
    joint = given.get("joint")
    if kind.scope is Scope.ARM:
        if joint is not None:
            raise BadInputError(f"{kind.effect}: acts on the whole arm; leave out joint {joint!r}")
        return given
    for key in ("joint", "source"):
        if given.get(key) is not None:
            machine.nominal.index(given[key])
    if "source" in kind.__dataclass_fields__:
        return _with_source(machine.names, rng, given)
    if kind.scope is Scope.LINK_OR_ARM or joint is not None:
        return given
    return given | {"joint": str(rng.choice(kind.typical_joints(machine.nominal)))}


def _with_source(
    names: tuple[str, ...], rng: np.random.Generator, given: dict[str, Any]
) -> dict[str, Any]:
    """Add the missing fields of a coupling: the joint, and as its source the joint before it (after
    the first).
    """
    if len(names) < 2:
        raise BadInputError("joint_coupling: the arm has one joint only; it needs two")
    joint = given.get("joint") or str(rng.choice([n for n in names if n != given.get("source")]))
    source = given.get("source") or names[names.index(joint) - 1 if joint != names[0] else 1]
    if joint == source:
        raise BadInputError(
            f"joint_coupling: joint {joint!r} can't be its own source; give another joint"
        )
    return given | {"joint": joint, "source": source}
