"""The true machine: a robot with errors unknown to the fit.

Kinematics are Pinocchio's, loads are sums over bodies in their deformed poses and every error is a
placement. Nothing is shared with the model that pincal fits, so that the two can be compared.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.arm import Arm
from pincal.simulate.effect import DeformingEffect, HiddenEffect
from pincal.simulate.elastic import BearingElasticity, JointElasticity, PayloadError
from pincal.simulate.inertia import Inertia
from pincal.simulate.rods import closing_step
from pincal.simulate.state import (
    Deformation,
    Equilibrium,
    Loads,
    Poses,
    broadcast_copy,
    build_chain,
    configurations,
    gravity_loads,
    joints_and_links,
    place,
    poses_of,
    scratch_of,
)
from pincal.simulate.urdf_arm import read_arm

# Acceleration of gravity in the base frame of an upright robot [m/s^2].
_GRAVITY = (0.0, 0.0, -9.81)
# Change of the deformation in one round below which the arm is in equilibrium [rad and m]; far
# below any measurement.
_AT_REST = 1e-12
# Each round gains about three digits on an industrial arm; if far more than five are needed, the
# arm collapses.
_ROUNDS = 100


@dataclass(frozen=True)
class TrueMachine:
    """A robot with its true errors.

    Attributes:
        nominal: The arm of the URDF.
        placement_errors: Error of each joint's placement and last of the tip's: translation [m] and
            rotation vector [rad] in the URDF joint frame, shape (n + 1, 6).
        joint_offsets: Added to the recorded joint positions [rad or m], shape (n,).
        mass_factors: Ratio of true to nominal mass of each link [-], shape (n,).
        com_errors: True minus nominal centre of mass in the joint's working frame [m], shape (n,
            3).
        compliance: (c_x, c_y, c_z) of each joint [rad/(N m)], z the joint axis, shape (n, 3).
        moment_frame: Frame of c_x and c_y: ``paper``, ``before`` or ``after`` q.
        gravity: Acceleration in the base frame [m/s^2], shape (3,).
        reference_temperature: Temperature at which the lengths are nominal [deg C].
        effects: Hidden effects.

    Example:
        >>> from pincal.builtin import kuka_urdf_path
        >>> machine = TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0")
        >>> machine.tip(np.zeros((1, 6)))[0, 0, 3].round(6)
        np.float64(2.62)
    """

    nominal: Arm
    placement_errors: np.ndarray
    joint_offsets: np.ndarray
    mass_factors: np.ndarray
    com_errors: np.ndarray
    compliance: np.ndarray
    moment_frame: str = "paper"
    gravity: tuple[float, float, float] = _GRAVITY
    reference_temperature: float = 20.0
    effects: tuple[HiddenEffect, ...] = ()

    @classmethod
    def from_urdf(
        cls,
        urdf: str | Path,
        *,
        tip: str,
        base: str | None = None,
        start: str | None = None,
        joints: Sequence[str] = (),
        passive: Collection[str] = (),
        **errors: Any,
    ) -> TrueMachine:
        """Make the true machine of a URDF, by default without errors.

        Args:
            urdf: Path of a URDF file, or its XML text.
            tip: Frame at the end of the arm.
            base: Link on which the arm stands; default: the root of the URDF.
            start: Link in whose frame positions are given; default: the base.
            joints: Names of the moving joints, each after the one that carries it; default: those
                from base to tip.
            passive: Those of them whose positions follow from loops; default: no loops.
            **errors: Any attribute but ``nominal``.

        Raises:
            RobotFileError: If the URDF has no such arm.
            BadInputError: If an attribute has a wrong name or shape.
        """
        return cls.of_arm(
            read_arm(urdf, tip, base, start=start, joints=joints, passive=passive), **errors
        )

    @classmethod
    def of_arm(cls, nominal: Arm, **errors: Any) -> TrueMachine:
        """Make the true machine of a nominal arm, without errors by default; see
        :meth:`from_urdf`.
        """
        n = len(nominal.names)
        values = {
            "placement_errors": np.zeros((n + 1, 6)),
            "joint_offsets": np.zeros(n),
            "mass_factors": np.ones(n),
            "com_errors": np.zeros((n, 3)),
            "compliance": np.zeros((n, 3)),
        }
        known = {field.name for field in fields(cls)} - {"nominal"}
        if unknown := sorted(set(errors) - known):
            raise BadInputError(
                f"{', '.join(unknown)}: unknown; expected {', '.join(sorted(known))}"
            )
        for name in values.keys() & errors.keys():
            errors[name] = broadcast_copy(name, errors[name], values[name].shape)
        return cls(nominal, **(values | errors))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints from base to tip."""
        return self.nominal.names

    @cached_property
    def arm(self) -> Arm:
        """The true arm without deformation."""
        from scipy.spatial.transform import Rotation

        errors = np.tile(np.eye(4), (len(self.names) + 1, 1, 1))
        axes = np.concatenate((self.nominal.axes, np.eye(3)[None]))
        rotations = Rotation.from_rotvec(self.placement_errors[:, 3:]).as_matrix()
        errors[:, :3, :3] = np.swapaxes(axes, 1, 2) @ rotations @ axes
        errors[:, :3, 3] = np.einsum("iba,ib->ia", axes, self.placement_errors[:, :3])
        return replace(
            self.nominal,
            placements=self.nominal.placements @ errors,
            masses=self.nominal.masses * self.mass_factors,
            centres=self.nominal.centres + self.com_errors,
        )

    @cached_property
    def _chain(self) -> Any:
        return build_chain(self.arm)

    @cached_property
    def _data(self) -> Any:
        return scratch_of(self.arm)

    @cached_property
    def _deforming(self) -> tuple[DeformingEffect, ...]:
        elastic: list[DeformingEffect] = []
        for name, (x, y, z) in zip(self.names, self.compliance, strict=True):
            elastic += [JointElasticity(joint=name, size=z)] if z else []
            elastic += (
                [BearingElasticity(joint=name, size=x, size_y=y, moment_frame=self.moment_frame)]
                if x or y
                else []
            )
        return (
            *elastic,
            *(effect for effect in self.effects if isinstance(effect, DeformingEffect)),
        )

    def with_effects(self, *effects: HiddenEffect) -> TrueMachine:
        """Return the machine with further hidden effects."""
        return replace(self, effects=self.effects + effects)

    def draw_errors(
        self,
        rng: np.random.Generator,
        *,
        sigma_length: float,
        sigma_angle: float,
        sigma_offset: float = 0.0,
    ) -> TrueMachine:
        """Return the machine with random geometric errors.

        The standard deviations are of displacements of joints and tip along each axis [m], of their
        rotations about each axis [rad], and of joint offsets [rad or m].
        """
        n = len(self.names)
        errors = rng.standard_normal((n + 1, 6)) * np.repeat([sigma_length, sigma_angle], 3)
        return replace(
            self, placement_errors=errors, joint_offsets=sigma_offset * rng.standard_normal(n)
        )

    def draw_masses(self, rng: np.random.Generator, *, sigma: float = 0.03) -> TrueMachine:
        """Return the machine with random errors of mass and centre of mass.

        ``sigma`` is the standard deviation of masses relative to nominal, and of each component of
        a centre of mass relative to its distance from the joint's origin [-].
        """
        distance = np.linalg.norm(self.nominal.centres, axis=1, keepdims=True)
        factors = 1.0 + sigma * rng.standard_normal(len(self.names))
        shift = sigma * distance * rng.standard_normal((len(self.names), 3))
        return replace(self, mass_factors=factors, com_errors=shift)

    def poses(self, q: np.ndarray, **conditions: Any) -> Poses:
        """Return poses with the conditions of :func:`pincal.simulate.state.poses_of`."""
        return poses_of(
            self.nominal, q, reference_temperature=self.reference_temperature, **conditions
        )

    def equilibrium(self, poses: Poses) -> Equilibrium:
        """Return the equilibrium of the arm, at rest or in motion, under the loads of the deformed
        arm.

        Inertia is taken of the rigid motion; the accelerations of the deformation are a thousandth
        of it.

        Raises:
            BadInputError: If the arm is too soft to carry itself.
        """
        mass = poses.payload
        com = poses.payload_com
        for effect in self.effects:
            if isinstance(effect, PayloadError):
                mass, com = effect.true_payload(mass, com)
        poses = replace(poses, payload=mass, payload_com=com)
        q = poses.q + self.joint_offsets
        gravity = np.asarray(self.gravity, float)
        inertia = Inertia.of(self.arm, (q, poses.velocity, poses.acceleration), mass, com)
        deformation = self._deformed(poses, Loads.zero(*q.shape))
        for _ in range(_ROUNDS):
            places = place(self._chain, self._data, configurations(q, deformation))
            if self.arm.pins:
                q, places = self._closed(q, places, deformation)
            loads = gravity_loads(
                self.arm, places, payload=mass, payload_com=com, gravity=gravity, inertia=inertia
            )
            settled = self._deformed(poses, loads)
            if settled.change(deformation) < _AT_REST:
                tip = places[:, -1]
                k = self.arm.start_joint
                if k >= 0:
                    tip = np.linalg.solve(
                        joints_and_links(places)[1][:, k + 1] @ self.arm.start, tip
                    )
                return Equilibrium(tip=tip, deformation=deformation, loads=loads)
            deformation = settled
        raise BadInputError(
            f"the arm reaches no equilibrium in {_ROUNDS} rounds; use a smaller compliance"
        )

    def _closed(
        self, q: np.ndarray, places: np.ndarray, deformation: Deformation
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return joint positions at which the loops of the deformed arm close, and its places
        there.
        """
        q = q.copy()
        for _ in range(_ROUNDS):
            axes, links = joints_and_links(places)
            step, _ = closing_step(self.arm, axes, links)
            q[:, self.arm.passive] += step
            places = place(self._chain, self._data, configurations(q, deformation))
            if np.abs(step).max(initial=0.0) < _AT_REST:
                return q, places
        raise BadInputError(
            "the loops of the arm don't close in some pose; make its errors smaller"
        )

    def _deformed(self, poses: Poses, loads: Loads) -> Deformation:
        deformation = Deformation.zero(*poses.q.shape)
        for effect in self._deforming:
            effect.deform(self.arm, poses, loads, deformation)
        return deformation

    def tip(self, q: np.ndarray, **conditions: Any) -> np.ndarray:
        """Return the true tip in the base frame, shape (N, 4, 4), at recorded joint positions q
        [rad or m], shape (N, n).

        The conditions are those of :meth:`poses`.
        """
        return self.equilibrium(self.poses(q, **conditions)).tip
