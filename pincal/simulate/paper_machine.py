"""The true KUKA KR 125/2 of the paper's case study, evaluated exactly by its model DH,s,e.

Plain products of 4x4 matrices in NumPy, for all poses at once. Source of all numbers except the
masses, the centre of mass of the payload and the elastic constants: Table I of Radkhah, Hemker,
Friedmann, von Stryk, "Towards the deployment of industrial robots as measurement instruments".
Equation numbers are the paper's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Unpack

import numpy as np

from pincal.builtin import kuka_urdf_path
from pincal.simulate.arm import Arm, transform
from pincal.simulate.effect import DeformingEffect, HiddenEffect
from pincal.simulate.planning import point_at
from pincal.simulate.state import Conditions, Deformation, Equilibrium, Loads, Poses, poses_of
from pincal.simulate.urdf_arm import read_arm

_HALF_TURN = np.pi
_QUARTER_TURN = np.pi / 2.0

NOMINAL: dict[str, tuple[float, ...]] = {
    "o": (0.0, 0.0, _QUARTER_TURN, 0.0, 0.0, _HALF_TURN),
    "a": (0.41, 1.0, 0.045, 0.0, 0.0, 0.0),
    "d": (0.865, 0.0, 0.0, 1.0, 0.0, 0.21),
    "alpha": (_QUARTER_TURN, 0.0, _QUARTER_TURN, -_QUARTER_TURN, _QUARTER_TURN, 0.0),
    "s_x": (0.0,) * 6,
    "s_y": (0.0,) * 6,
}
"""Column "initial estimates" of Table I, joint by joint [rad, m]; 1.5708 and 3.1416 mean pi/2 and
pi.
"""

REAL: dict[str, tuple[float, ...]] = {
    "o": (0.002, 0.0, 1.572, 0.0, 0.004, _HALF_TURN),
    "a": (0.41, 1.0, 0.04509, 0.0, 0.0, 0.0),
    "d": (0.8651, 0.0, 0.0, 1.0, 0.0, 0.20998),
    "alpha": (_QUARTER_TURN, 0.0, _QUARTER_TURN, -_QUARTER_TURN, _QUARTER_TURN, 0.0),
    "s_x": (1e-4, 5e-4, 2e-4, 2e-4, 1e-4, 1e-4),
    "s_y": (2e-4, 3e-4, 1e-4, 2e-4, 4e-4, 2e-4),
}
"""Column "real values" of Table I [rad, m]; 1.5708 and 3.1416 mean pi/2 and pi, o_3 is 1.572 as
printed.
"""

ELASTICITY: dict[str, tuple[float, ...]] = {
    "k_x": (4.0e-7, 2.4e-7, 3.5e-7, 0.0, 0.0, 0.0),
    "k_y": (4.0e-7, 2.2e-7, 2.8e-7, 0.0, 0.0, 0.0),
    "k_z": (3.0e-7, 4.0e-7, 4.0e-7, 0.0, 0.0, 0.0),
}
"""Elastic constants [rad/(N m)] of joints 1 to 3, as in the paper's case study, which does not
print their values.

With the geometry of Table I and 125 kg the initial deviation over the workspace is 6 mm on average
and 15 mm at most; the paper reports 7 to 20 mm.
"""

GRAVITY = 9.81
"""Acceleration of gravity along -z of the base [m/s^2]; the paper's is a unit vector."""

PAYLOAD_MASS = 125.0
"""Payload of the paper's case study [kg]."""

PAYLOAD_COM = (0.08, -0.05, 0.22)
"""Its centre of mass in the flange frame S_6 [m]; chosen here."""

Vector = Sequence[float]
Geometry = Mapping[str, Sequence[float]]


@dataclass(frozen=True, kw_only=True)
class PaperMachine:
    """The paper's robot as a machine that a campaign can measure, with additional hidden effects of
    its joints.

    Attributes:
        effects: Effects that depend on joint positions alone.
        payload_com: Centre of mass of the payload in the flange frame [m].
    """

    effects: tuple[HiddenEffect, ...] = ()
    payload_com: tuple[float, float, float] = PAYLOAD_COM

    @cached_property
    def nominal(self) -> Arm:
        """The arm of the built-in URDF."""
        return read_arm(kuka_urdf_path(), "tool0")

    def poses(
        self, q: np.ndarray, *, scatter: np.ndarray | None = None, **conditions: Unpack[Conditions]
    ) -> Poses:
        """Return recorded poses with their conditions."""
        return poses_of(self.nominal, q, scatter=scatter, **conditions)

    def equilibrium(self, poses: Poses) -> Equilibrium:
        """Return the flange of the model DH,s,e at the joint positions changed by the effects."""
        deformation = Deformation.zero(*poses.q.shape)
        loads = Loads.zero(*poses.q.shape)
        for effect in self.effects:
            if isinstance(effect, DeformingEffect):
                effect.deform(self.nominal, poses, loads, deformation)
        tip = paper_transform(
            poses.q + deformation.joint, payload_mass=poses.payload, payload_com=self.payload_com
        )
        return Equilibrium(tip=tip, deformation=deformation, loads=loads)


def paper_positions(
    q: np.ndarray,
    *,
    with_elasticity: bool = True,
    payload_mass: float | np.ndarray = PAYLOAD_MASS,
    payload_com: Vector = PAYLOAD_COM,
    tool_offset: Vector = (0.0, 0.0, 0.0),
) -> np.ndarray:
    """Return true positions, in the base frame S_0 [m], shape (N, 3), of a point of the flange
    frame [m], shape (3,).

    The other arguments are those of :func:`paper_transform`.

    Example:
        >>> paper_positions(np.zeros((1, 6)), with_elasticity=False).round(4)
        array([[2.6201, 0.0062, 0.9122]])
    """
    flange = paper_transform(
        q, with_elasticity=with_elasticity, payload_mass=payload_mass, payload_com=payload_com
    )
    return point_at(flange, tool_offset)


def paper_transform(
    q: np.ndarray,
    *,
    with_elasticity: bool = True,
    payload_mass: float | np.ndarray = PAYLOAD_MASS,
    payload_com: Vector = PAYLOAD_COM,
    geometry: Geometry = REAL,
    elasticity: Geometry = ELASTICITY,
) -> np.ndarray:
    """Return true flange poses of the paper's robot, or of one with other parameters.

    Args:
        q: Joint positions [rad], shape (N, 6).
        with_elasticity: Whether the joints are compliant (DH,s,e) or rigid (DH,s).
        payload_mass: Mass at the flange [kg], one number or shape (N,).
        payload_com: Its centre of mass in the flange frame [m], shape (3,).
        geometry: Values of the parameters of ``REAL`` [rad, m].
        elasticity: Values of the parameters of ``ELASTICITY`` [rad/(N m)].

    Returns:
        Transforms from the flange frame S_6 to the base frame S_0 [m], shape (N, 4, 4).
    """
    q = np.asarray(q, float)
    if not with_elasticity:
        return link_frames(q, geometry)[-1]
    moments = paper_moments(
        q, payload_mass=payload_mass, payload_com=payload_com, geometry=geometry
    )
    constants = np.array([elasticity[name] for name in ("k_x", "k_y", "k_z")]).T
    return link_frames(q, geometry, gamma=constants * moments)[-1]


def paper_moments(
    q: np.ndarray,
    *,
    payload_mass: float | np.ndarray = PAYLOAD_MASS,
    payload_com: Vector = PAYLOAD_COM,
    geometry: Geometry = REAL,
) -> np.ndarray:
    """Return the static moments of Eq. (3) on the geometry DH,s; arguments as in
    :func:`paper_transform`.

    They are (n_x, n_y, n_z) of each joint in its frame after s_x, s_y and before q [N m], shape (N,
    6, 3).
    """
    q = np.asarray(q, float)
    frames = link_frames(q, geometry)
    masses, centres = _link_bodies()
    payload = np.broadcast_to(np.asarray(payload_mass, float), len(q))
    moments = np.zeros((len(q), 6, 3))
    for i in range(6):
        origin = frames[i][:, :3, 3]
        total = _weigh(frames[6], payload, np.asarray(payload_com, float), origin)
        for k in range(i, 6):
            total = total + _weigh(frames[k + 1], np.full(len(q), masses[k]), centres[k], origin)
        axes = (
            frames[i][:, :3, :3]
            @ (_rotate("x", geometry["s_x"][i]) @ _rotate("y", geometry["s_y"][i]))[:3, :3]
        )
        moments[:, i] = (np.swapaxes(axes, 1, 2) @ total[..., None])[..., 0]
    return moments


def link_frames(
    q: np.ndarray, geometry: Geometry, *, gamma: np.ndarray | None = None
) -> list[np.ndarray]:
    """Return the frames S_0 to S_6 of the model DH,s,e, each as transforms to S_0 [m], shape (N, 4,
    4).

    ``q`` are joint positions [rad], shape (N, 6), and ``gamma`` the elastic angles (gamma_x,
    gamma_y, gamma_z) of each joint [rad], shape (N, 6, 3); default: 0.
    """
    gamma = np.zeros((len(q), 6, 3)) if gamma is None else gamma
    frames = [np.tile(np.eye(4), (len(q), 1, 1))]
    for i in range(6):
        s_x, s_y, theta, d, a, alpha = (
            geometry[name][i] for name in ("s_x", "s_y", "o", "d", "a", "alpha")
        )
        link = _rotate("x", s_x) @ _rotate("y", s_y) @ _rotate("z", q[:, i]) @ _rotate("z", theta)
        gamma_x, gamma_y, gamma_z = gamma[:, i].T
        link = link @ _rotate("z", gamma_z) @ _rotate("y", gamma_y) @ _rotate("x", gamma_x)
        frames.append(
            frames[-1]
            @ link
            @ transform(place=(0.0, 0.0, d))
            @ transform(place=(a, 0.0, 0.0))
            @ _rotate("x", alpha)
        )
    return frames


def _link_bodies() -> tuple[np.ndarray, np.ndarray]:
    """Return masses [kg], shape (6,), of links 1 to 6 of the built-in URDF, and their centres in
    S_k [m], shape (6, 3).

    The URDF defines link k in S_(k-1) rotated by q_k; its centre of mass is transformed to S_k by
    the nominal geometry.
    """
    arm = PaperMachine().nominal
    centres = np.empty((6, 3))
    for k in range(6):
        theta, d, a, alpha = (NOMINAL[name][k] for name in ("o", "d", "a", "alpha"))
        link = (
            _rotate("z", theta)
            @ transform(place=(0.0, 0.0, d))
            @ transform(place=(a, 0.0, 0.0))
            @ _rotate("x", alpha)
        )
        centres[k] = np.linalg.solve(link, np.append(arm.centres[k], 1.0))[:3]
    return arm.masses, centres


def _weigh(
    frame: np.ndarray, mass: np.ndarray, centre: np.ndarray, origin: np.ndarray
) -> np.ndarray:
    """Return the moment of a body's weight about an origin, (c - r) x m g in S_0 [N m], shape (N,
    3).
    """
    lever = frame[:, :3, :3] @ centre + frame[:, :3, 3] - origin
    return np.cross(lever, mass[:, None] * np.array([0.0, 0.0, -GRAVITY]))


def _rotate(axis: str, angle: float | np.ndarray) -> np.ndarray:
    """Return rotations about a coordinate axis, shape (..., 4, 4) for angles [rad] of
    shape (...).
    """
    angle = np.asarray(angle, float)
    first, second = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    turned = np.zeros((*angle.shape, 4, 4)) + np.eye(4)
    turned[..., first, first] = turned[..., second, second] = np.cos(angle)
    turned[..., second, first] = np.sin(angle)
    turned[..., first, second] = -np.sin(angle)
    return turned
