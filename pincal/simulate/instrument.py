"""An instrument next to the robot, such as a laser tracker or a camera, that measures targets on
the tool.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.arm import Arm, transform
from pincal.simulate.lens import Lens
from pincal.simulate.planning import plan_poses
from pincal.simulate.setup import (
    Machine,
    Reading,
    SensorSetup,
    Table,
    as_lists,
    draw_noise,
    refuse_scale,
    tips_of,
    transformed,
)
from pincal.simulate.state import Poses
from pincal.simulate.tracker import as_read

KINDS = ("position", "pose", "distance")
"""Quantities that an instrument next to the robot can measure."""


@dataclass(frozen=True, kw_only=True)
class Instrument(SensorSetup):
    """An instrument next to the robot.

    Attributes:
        reads: One of ``KINDS``.
        pose: Transform from the robot's base frame to the instrument's frame, shape (4, 4).
        targets: Target in the tip frame: a position [m], shape (3,), or a transform, shape (4, 4);
            or a mapping from name to one of these. Each target gives a row for every pose.
        sigma_angle: Standard deviation of the orientation about each axis [rad].
        anchors: Points in the robot's base frame [m], shape (3,), by name, from which distances are
            measured; default: the instrument's origin.

    Raises:
        BadInputError: If an attribute has a wrong shape or the kind is unknown.

    Example:
        >>> from pincal.builtin import kuka_urdf_path
        >>> from pincal.simulate.machine import TrueMachine
        >>> machine = TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0")
        >>> Instrument(targets=(0.0, 0.0, 0.1)).measure(machine, np.zeros((1, 6)))["x"].round(6)
        array([2.72])
    """

    reads: str = "position"
    pose: np.ndarray = field(default_factory=lambda: np.eye(4))
    targets: Any = (0.0, 0.0, 0.0)
    sigma_angle: float = 0.0
    anchors: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Validate the kind of measurement; store targets as transforms by name."""
        if self.reads not in KINDS:
            raise BadInputError(f"kind {self.reads!r}; expected one of {', '.join(KINDS)}")
        if self.anchors and self.reads != "distance":
            raise BadInputError(
                f"anchors with kind {self.reads!r}; expected 'distance', or no anchors"
            )
        named = self.targets if isinstance(self.targets, Mapping) else {"": self.targets}
        object.__setattr__(
            self, "targets", {name: _transform(target) for name, target in named.items()}
        )

    @property
    def kind(self) -> str:
        return self.reads

    @property
    def points(self) -> dict[str, np.ndarray]:
        return transformed(self.pose, self.anchors)

    def plan(
        self, arm: Arm, n: int, *, rng: np.random.Generator, min_height: float | None = 0.1
    ) -> np.ndarray:
        return plan_poses(arm, n, rng, min_height=min_height)

    def _read(self, machine: Machine, poses: Poses, rng: np.random.Generator | None) -> Reading:
        offsets = np.array([*self.targets.values()])
        seen = self._seen(tips_of(machine, poses)[:, None], offsets).reshape(-1, 4, 4)
        rows = np.repeat(np.arange(len(poses.q)), len(offsets))
        columns = Table()
        if len(offsets) > 1:
            columns["target"] = np.tile(np.array(list(self.targets)), len(poses.q))
        if self.anchors:
            count = len(self.anchors)
            rows = np.repeat(rows, count)
            seen = np.repeat(seen, count, axis=0)
            seen[:, :3, 3] -= np.tile(np.array([*self.points.values()]), (len(seen) // count, 1))
            columns = {name: np.repeat(column, count) for name, column in columns.items()}
            columns["anchor"] = np.tile(np.array(list(self.anchors)), len(seen) // count)
        return Reading(poses, rows, columns | self._readings(machine, seen, rng))

    def _seen(self, tips: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Return the pose of a target in the instrument's frame, shape (..., 4, 4), where the tip
        is.
        """
        return np.asarray(self.pose @ tips @ target)

    def _readings(
        self, machine: Machine, seen: np.ndarray, rng: np.random.Generator | None
    ) -> Table:
        """Return the readings of transforms from target to instrument or anchor, shape
        (M, 4, 4).
        """
        position = as_read(machine.effects, seen[:, :3, 3])
        if self.reads == "distance":
            distance = np.linalg.norm(position, axis=1)
            return {"distance": distance + draw_noise(distance.shape, self.sigma, rng)}
        position = position + draw_noise(position.shape, self.sigma, rng)
        columns = dict(zip("xyz", position.T, strict=True))
        return (
            columns | _quaternion(seen[:, :3, :3], self.sigma_angle, rng)
            if self.reads == "pose"
            else columns
        )

    def line_of_sight(self, tip: np.ndarray) -> np.ndarray:
        """Return the first target in the frame of the instrument, or relative to the
        first anchor.
        """
        seen = self._seen(tip, next(iter(self.targets.values())))[:, :3, 3]
        return np.asarray(seen - next(iter(self.points.values()), np.zeros(3)))

    def truth(self) -> dict[str, Any]:
        found: dict[str, Any] = {
            "noise": {
                "sigma_m": self.sigma,
                "sigma_rad": self.sigma_angle if self.reads == "pose" else None,
            },
            "T_instrument_base": self.pose.tolist(),
            "targets": {name: target.tolist() for name, target in self.targets.items()},
        }
        return found | ({"anchors_in_base_m": as_lists(self.anchors)} if self.anchors else {})


@dataclass(frozen=True, kw_only=True)
class OnHand(Instrument):
    """An instrument on the hand, such as a camera, that measures an object beside the robot.

    Attributes:
        pose: Transform from the frame of the robot's first link to the object's, shape (4, 4).
        targets: The instrument in the frame of the hand; one alone.

    Raises:
        BadInputError: For several instruments, or anchors, which belong beside the robot.
    """

    def __post_init__(self) -> None:
        """Validate as any instrument, and that there is one."""
        super().__post_init__()
        if len(self.targets) != 1 or self.anchors:
            raise BadInputError(
                f"{len(self.targets)} targets and {len(self.anchors)} anchors of an instrument on "
                "the hand; expected one object, and no anchors"
            )

    def _seen(self, tips: np.ndarray, target: np.ndarray) -> np.ndarray:
        return np.linalg.inv(super()._seen(tips, target))

    def truth(self) -> dict[str, Any]:
        """Return what is known of it: the path of the readings begins at the hand."""
        (on_hand,) = self.targets.values()
        placed = {
            "T_instrument_base": np.linalg.inv(on_hand).tolist(),
            "targets": {"": np.linalg.inv(self.pose).tolist()},
        }
        return super().truth() | placed


@dataclass(frozen=True, kw_only=True)
class CellCamera(Instrument):
    """A camera in front of the robot that sees targets on the tool; its frame has z along the
    optical axis.

    Attributes:
        lens: The camera; points outside its image are not measured.
    """

    lens: Lens

    @property
    def kind(self) -> str:
        return "fixed_camera_pixel"

    def _read(self, machine: Machine, poses: Poses, rng: np.random.Generator | None) -> Reading:
        refuse_scale(machine, "an image has none")
        exact = Instrument(pose=self.pose, targets=self.targets)._read(machine, poses, None)
        seen = np.column_stack([exact.columns[axis] for axis in "xyz"])
        names = exact.columns.get(
            "target", np.full(len(seen), next(iter(self.targets)) or "target")
        )
        inside = self.lens.sees(seen)
        if not inside.any():
            raise BadInputError(
                "the camera sees the target in no pose; use poses in front of it, or a "
                "lens of shorter focal length"
            )
        image = self.lens.project(seen[inside])
        image = image + draw_noise(image.shape, self.sigma, rng)
        return Reading(
            poses, exact.rows[inside], {"target": names[inside], "u": image[:, 0], "v": image[:, 1]}
        )

    def truth(self) -> dict[str, Any]:
        noise = {"sigma_m": None, "sigma_rad": None, "sigma_px": self.sigma}
        return super().truth() | {"noise": noise, "camera": self.lens.intrinsics}


def _transform(target: Any) -> np.ndarray:
    value = np.asarray(target, float)
    if value.shape == (4, 4):
        return value
    if value.shape != (3,):
        raise BadInputError(f"target has shape {value.shape}; expected (3,) or (4, 4)")
    return transform(place=value)


def _quaternion(rotation: np.ndarray, sigma: float, rng: np.random.Generator | None) -> Table:
    from scipy.spatial.transform import Rotation

    jitter = Rotation.from_rotvec(draw_noise((len(rotation), 3), sigma, rng))
    quaternion = (jitter * Rotation.from_matrix(rotation)).as_quat(canonical=True)
    return dict(zip(("qx", "qy", "qz", "qw"), quaternion.T, strict=True))
