"""The deformable arm as a Pinocchio model, and the gravity loads on it.

Before and behind every joint stands a free joint that carries the deformation there, one more at the base and
one at the tip. All angles of all effects are thus placed by Pinocchio, and loads are plain sums of cross
products over the bodies where they really are.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pincal.simulate.arm import Arm
from pincal.simulate.inertia import Inertia
from pincal.simulate.state import Deformation, Loads

# Joint number in the Pinocchio model of the base, and of what stands before, at and behind arm joint 0; the
# next arm joint is 3 further.
_BASE, _BEFORE, _JOINT, _AFTER = 1, 2, 3, 4


def build_chain(arm: Arm) -> Any:
    """Return the ``pinocchio.Model`` of an arm with a free joint at every place that can deform.

    Its configurations are laid out as :func:`configurations` fills them.
    """
    import pinocchio as pin

    model = pin.Model()
    identity = pin.SE3.Identity()
    parent = model.addJoint(0, pin.JointModelFreeFlyer(), identity, "base")
    for name, slides, placement in zip(arm.names, arm.prismatic, arm.placements, strict=False):
        drive = pin.JointModelPZ() if slides else pin.JointModelRZ()
        parent = model.addJoint(parent, pin.JointModelFreeFlyer(), pin.SE3(placement), f"{name} before")
        parent = model.addJoint(parent, drive, identity, name)
        parent = model.addJoint(parent, pin.JointModelFreeFlyer(), identity, f"{name} after")
    model.addJoint(parent, pin.JointModelFreeFlyer(), pin.SE3(arm.placements[-1]), "tip")
    return model


def configurations(q: np.ndarray, deformation: Deformation) -> np.ndarray:
    """Return the configurations of the model, shape (N, 15 n + 14), at joint positions q [rad or m], shape (N, n)."""
    rows = len(q)
    joints = np.concatenate(
        (_free(deformation.before), (q + deformation.joint)[..., None], _free(deformation.after)), axis=2
    )
    return np.hstack((_free(deformation.base), joints.reshape(rows, -1), _free(deformation.tip)))


def _free(twist: np.ndarray) -> np.ndarray:
    """Return translation and quaternion of a free joint, shape (..., 7), for twists of shape (..., 6)."""
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_euler("ZYX", twist[..., :2:-1].reshape(-1, 3))
    quaternion = rotation.as_quat().reshape(*twist.shape[:-1], 4)
    return np.concatenate((twist[..., :3], quaternion), axis=-1)


def place(model: Any, data: Any, q: np.ndarray) -> np.ndarray:
    """Return where Pinocchio places each joint of :func:`build_chain`, and last the tip, in configurations q, shape (N, nq).

    ``data`` is the model's ``pinocchio.Data``: making one takes longer than a thousand poses. The transforms are those to
    the undeformed base frame, shape (N, number of joints, 4, 4).
    """
    import pinocchio as pin

    transforms = list(data.oMi)
    places = np.empty((len(q), model.njoints, 4, 4))
    for row, configuration in enumerate(q):
        pin.forwardKinematics(model, data, configuration)
        places[row] = [transform.homogeneous for transform in transforms]
    return places


def gravity_loads(
    arm: Arm,
    places: np.ndarray,
    *,
    payload: np.ndarray,
    payload_com: np.ndarray,
    gravity: np.ndarray,
    inertia: Inertia | None = None,
) -> Loads:
    """Return the loads on every joint of the arm as it is placed.

    Args:
        arm: The true arm.
        places: Transforms of :func:`place`, shape (N, 3 n + 3, 4, 4).
        payload: Mass at the tip [kg], shape (N,).
        payload_com: Its centre of mass in the tip frame [m], shape (N, 3).
        gravity: Acceleration in the undeformed base frame [m/s^2], shape (3,).
        inertia: What the bodies' inertia exerts in addition; default: they are at rest.
    """
    last = places.shape[1] - 1
    before, joint, after = (places[:, first:last:3] for first in (_BEFORE, _JOINT, _AFTER))
    tip = places[:, -1]
    links = np.einsum("njab,jb->nja", after[..., :3, :3], arm.centres) + after[..., :3, 3]
    load = np.einsum("nab,nb->na", tip[:, :3, :3], payload_com) + tip[:, :3, 3]
    centres = np.concatenate((links, load[:, None]), axis=1)
    masses = np.column_stack((np.broadcast_to(arm.masses, links.shape[:2]), payload))
    weights, couples = masses[..., None] * gravity, np.zeros((*masses.shape, 3))
    if inertia is not None:
        weights, couples = weights + inertia.forces, inertia.couples
    moments = _moments(centres, weights, couples, joint[..., :3, 3])
    ends = np.concatenate((before[:, 1:], tip[:, None]), axis=1)[..., :3, 3]
    end_moments = _moments(centres[:, 1:], weights[:, 1:], couples[:, 1:], ends)
    beyond = np.cumsum(weights[:, ::-1], axis=1)[:, ::-1]
    moment_after = _turned(after, moments)
    base = _moments(centres, weights, couples, places[:, _BASE : _BASE + 1, :3, 3])
    return Loads(
        before=_turned(before, moments),
        after=_turned(joint, moments),
        drive=np.where(arm.prismatic, _turned(joint, beyond[:, :-1])[..., 2], moment_after[..., 2]),
        end_moment=_turned(after, end_moments),
        end_force=_turned(after, beyond[:, 1:]),
        base=_turned(places[:, _BASE : _BASE + 1], base)[:, 0],
    )


def _moments(centres: np.ndarray, weights: np.ndarray, couples: np.ndarray, origins: np.ndarray) -> np.ndarray:
    """Return for origin k the sum over bodies from k on of (centre - origin) x weight + couple, shape (N, k, 3)."""
    moments = [np.cross(centres[:, k:] - origins[:, k : k + 1], weights[:, k:]) for k in range(origins.shape[1])]
    return np.stack([(own + couples[:, k:]).sum(axis=1) for k, own in enumerate(moments)], axis=1)


def _turned(frames: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return vectors of the base frame in the axes of frames, shape (N, k, 3)."""
    turned: np.ndarray = np.einsum("nkab,nka->nkb", frames[..., :3, :3], vectors)
    return turned
