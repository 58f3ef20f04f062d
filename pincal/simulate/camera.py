"""The set-up of the paper: a camera on the robot's flange that looks at a fixed object with marked
points.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.arm import Arm
from pincal.simulate.lens import Lens
from pincal.simulate.planning import collect_poses, is_clear, plan_poses, reach
from pincal.simulate.setup import Machine, Reading, SensorSetup, draw_noise, refuse_scale, tips_of
from pincal.simulate.state import Poses
from pincal.simulate.tracker import as_read

PITCH = 0.025
"""Spacing of the marked points of the paper's object [m]."""

# Points of one image field, in rows and columns.
_FIELD = 5
# The paper's object has two sides with three image fields each; the paper does not state their
# inclination.
_FIELDS = 3
_LEAN = np.pi / 4


@dataclass(frozen=True)
class CalibrationObject:
    """Named points on plates, in a frame of their own.

    Attributes:
        names: Names of the K points.
        places: Their positions in the object's frame [m], shape (K, 3).
        normals: Normal of the plate of each, shape (K, 3); None for points visible from all sides.
        field: Index of the image field of each, from 0, shape (K,).
    """

    names: tuple[str, ...]
    places: np.ndarray
    normals: np.ndarray | None
    field: np.ndarray

    @classmethod
    def of_points(
        cls, points: Mapping[str, Any], normals: Mapping[str, Any] | None = None
    ) -> CalibrationObject:
        """Return an object of one field from named points [m] and, if visible from one side only,
        normals, shape (3,).
        """
        towards = None if normals is None else np.array([normals[name] for name in points], float)
        return cls(
            tuple(points), np.array([*points.values()], float), towards, np.zeros(len(points), int)
        )

    @property
    def n_fields(self) -> int:
        """Number of image fields."""
        return int(self.field.max()) + 1

    def look_at(self, field: int) -> tuple[np.ndarray, np.ndarray, float]:
        """Return centre [m], shape (3,), normal, shape (3,), and radius [m] of an image field."""
        places = self.places[self.field == field]
        centre = places.mean(axis=0)
        normal = (
            np.array([0.0, 0.0, 1.0])
            if self.normals is None
            else self.normals[self.field == field][0]
        )
        return centre, normal, float(np.linalg.norm(places - centre, axis=1).max())


def paper_object() -> CalibrationObject:
    """Return the object of the paper (Fig. 5): two sides with points 25 mm apart, three image
    fields per side.

    The sides make a roof with its ridge along x; both lean by 45 degrees. Point ``a2_1_3`` is in
    row 1 and column 3 of the second field of side a.

    Example:
        >>> paper = paper_object()
        >>> paper.n_fields, len(paper.names), paper.names[-1]
        (6, 150, 'b3_5_5')
    """
    sides = []
    for side, sign in (("a", -1.0), ("b", 1.0)):
        down = np.array([0.0, sign * np.cos(_LEAN), -np.sin(_LEAN)])
        along = np.array([1.0, 0.0, 0.0])
        middle = 0.5 * (_FIELDS * _FIELD - 1) * PITCH
        for k in range(_FIELDS):
            corner = (k * _FIELD * PITCH - middle) * along + PITCH * down
            sides.append(_plate(f"{side}{k + 1}", _FIELD, _FIELD, corner, down, along))
    return _joined(sides)


def grid_object(rows: int = 7, columns: int = 9) -> CalibrationObject:
    """Return a plane grid of points 25 mm apart about the origin, normal to z, with rows along y
    and columns along x.

    Example:
        >>> grid_object().names[:2], grid_object().places[-1]
        (('p_1_1', 'p_1_2'), array([0.1  , 0.075, 0.   ]))
    """
    corner = -0.5 * PITCH * np.array([columns - 1.0, rows - 1.0, 0.0])
    return _joined(
        [_plate("p", rows, columns, corner, np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0]))]
    )


OBJECTS = {"paper": paper_object, "grid": grid_object}
"""The objects by name."""


def _plate(
    name: str, rows: int, columns: int, corner: np.ndarray, down: np.ndarray, along: np.ndarray
) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Return names, places and the normal, upwards, of a plate's points."""
    row, column = (index.ravel() for index in np.mgrid[:rows, :columns])
    names = [f"{name}_{i + 1}_{j + 1}" for i, j in zip(row, column, strict=True)]
    places = corner + PITCH * (row[:, None] * down + column[:, None] * along)
    normal = np.cross(down, along)
    return names, places, normal * np.sign(normal[2])


def _joined(plates: list[tuple[list[str], np.ndarray, np.ndarray]]) -> CalibrationObject:
    return CalibrationObject(
        names=tuple(name for names, _, _ in plates for name in names),
        places=np.vstack([places for _, places, _ in plates]),
        normals=np.vstack([np.tile(normal, (len(names), 1)) for names, _, normal in plates]),
        field=np.repeat(np.arange(len(plates)), [len(names) for names, _, _ in plates]),
    )


# Points on a plate seen more obliquely than this (cosine of the angle to its normal) can't be
# detected.
_OBLIQUE = 0.25
# Smallest number of random goals in a round.
_TRIES = 16
# Range of a field's radius relative to the image's half height, by which the distance is chosen;
# margin of the image.
_FILL = (0.45, 0.85)
_BORDER = 0.04
# Farthest distance relative to the least one where the object is small.
_FARTHER = 1.5
# Rounds of random goals for all views of a field, and to test whether there are any.
_PATIENCE = 60
_GLANCES = 3


@dataclass(frozen=True, kw_only=True)
class View:
    """Admissible views of a point by a camera.

    Attributes:
        camera_pose: Transform from camera to tip frame, shape (4, 4).
        look_at: The point in the base frame [m], shape (3,).
        facing: Normal of the object in the base frame, towards the camera, shape (3,).
        distance: Smallest and largest distance of the camera from the point [m].
        tilt: Largest angle between the optical axis and the object's normal [rad].
        accept: Returns which transforms from camera to base frame, shape (N, 4, 4), are suitable,
            shape (N,); None: all.
    """

    camera_pose: np.ndarray
    look_at: Any
    facing: Any = (0.0, 0.0, 1.0)
    distance: tuple[float, float] = (0.3, 0.6)
    tilt: float = 0.6
    accept: Callable[[np.ndarray], np.ndarray] | None = None

    def draw(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return random transforms from camera to base frame that look at the point, shape (count,
        4, 4).
        """
        goals = np.tile(np.eye(4), (count, 1, 1))
        goals[:, :3, :3] = self._orientations(count, rng)
        goals[:, :3, 3] = (
            np.asarray(self.look_at) - rng.uniform(*self.distance, (count, 1)) * goals[:, :3, 2]
        )
        return goals

    def _orientations(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return random rotations of a camera, tilted from the object's normal, shape (count, 3,
        3).
        """
        from scipy.spatial.transform import Rotation

        onto = Rotation.align_vectors(-np.asarray(self.facing, float)[None], [[0.0, 0.0, 1.0]])[0]
        spin = Rotation.from_rotvec(rng.uniform(-np.pi, np.pi, (count, 1)) * [0.0, 0.0, 1.0])
        direction = rng.uniform(-np.pi, np.pi, count)
        angle = self.tilt * np.sqrt(rng.uniform(0.0, 1.0, (count, 1)))
        axis = np.stack((np.cos(direction), np.sin(direction), 0.0 * direction), axis=1)
        return np.asarray((onto * Rotation.from_rotvec(angle * axis) * spin).as_matrix())


def plan_views(
    arm: Arm,
    n: int,
    *,
    rng: np.random.Generator,
    view: View,
    min_height: float | None = 0.1,
    rounds: int = 20,
) -> np.ndarray:
    """Draw poses of the nominal arm in which the camera looks at a point, shape (n, number of
    joints).

    The arm stays above a floor at ``min_height`` [m] (None: no floor).

    Raises:
        BadInputError: If too few poses are within reach after ``rounds`` rounds of random goals.
    """

    def draw() -> np.ndarray:
        seed = plan_poses(arm, max(4 * n, _TRIES), rng, min_height=min_height)
        goals = view.draw(len(seed), rng)
        wanted = np.ones(len(seed), bool) if view.accept is None else view.accept(goals)
        q, reached = reach(arm, seed[wanted], goal=goals[wanted] @ np.linalg.inv(view.camera_pose))
        q = q[reached]
        return np.asarray(q[is_clear(arm, q, min_height)])

    shortage = "that look at the object are within reach; move the object or widen the tilt"
    return collect_poses(draw, n, rounds=rounds, shortage=shortage)


@dataclass(frozen=True, kw_only=True)
class EyeInHand(SensorSetup):
    """A camera at the tip that looks at a fixed calibration object.

    Attributes:
        target: The calibration object.
        object_pose: Transform from the object's frame to the robot's base frame, shape (4, 4).
        camera_pose: Transform from the camera frame (z along the optical axis, x right) to the tip
            frame, shape (4, 4).
        lens: The camera, which measures only points in its image; None for a camera that sees
            everything.
        in_metres: Whether it measures points in its own frame [m], like a stereo camera, and not
            their image [px].
        least_distance: From which poses look at the object [m]; nearer ones would fill the image
            with a small one.
    """

    target: CalibrationObject
    object_pose: np.ndarray = field(default_factory=lambda: np.eye(4))
    camera_pose: np.ndarray
    lens: Lens | None = None
    in_metres: bool = False
    least_distance: float = 0.0

    def __post_init__(self) -> None:
        if self.lens is None and not self.in_metres:
            raise BadInputError("lens None; expected a lens to take images with, or in_metres=True")

    @property
    def kind(self) -> str:
        return "camera_point" if self.in_metres else "camera_pixel"

    @property
    def points(self) -> dict[str, np.ndarray]:
        return dict(zip(self.target.names, self.target.places, strict=True))

    @cached_property
    def _places(self) -> np.ndarray:
        """Points of the object in the base frame [m], shape (K, 3)."""
        return np.asarray(self.target.places @ self.object_pose[:3, :3].T + self.object_pose[:3, 3])

    def plan(
        self, arm: Arm, n: int, *, rng: np.random.Generator, min_height: float | None = 0.1
    ) -> np.ndarray:
        """Draw poses with one whole image field after the other in view."""
        owner = np.arange(n) * self.target.n_fields // n
        shares = np.bincount(owner, minlength=self.target.n_fields)
        draw = partial(plan_views, rng=rng, min_height=min_height, rounds=_PATIENCE)
        views = [draw(arm, int(share), view=self._view(i)) for i, share in enumerate(shares)]
        return np.vstack(views)

    def has_views(self, arm: Arm, rng: np.random.Generator, *, min_height: float | None) -> bool:
        """Return whether the arm easily finds views of all fields."""
        try:
            for i in range(self.target.n_fields):
                plan_views(
                    arm, 1, rng=rng, view=self._view(i), min_height=min_height, rounds=_GLANCES
                )
        except BadInputError:
            return False
        return True

    def _view(self, i: int) -> View:
        """Return the views in which an image field is wholly in the image."""
        lens = self.lens or Lens()
        centre, normal, radius = self.target.look_at(i)
        places = self._places[self.target.field == i]
        half = 0.5 * min(size / focal for size, focal in zip(lens.size, lens.focals, strict=True))

        def is_whole(camera: np.ndarray) -> np.ndarray:
            seen = in_camera(camera, places).reshape(-1, 3)
            return np.asarray(lens.sees(seen, margin=_BORDER).reshape(len(camera), -1).all(axis=1))

        return View(
            camera_pose=self.camera_pose,
            look_at=self.object_pose[:3, :3] @ centre + self.object_pose[:3, 3],
            facing=self.object_pose[:3, :3] @ normal,
            distance=(
                max(radius / (half * _FILL[1]), self.least_distance),
                max(radius / (half * _FILL[0]), _FARTHER * self.least_distance),
            ),
            accept=is_whole,
        )

    def _read(self, machine: Machine, poses: Poses, rng: np.random.Generator | None) -> Reading:
        if not self.in_metres:
            refuse_scale(machine, "an image has none")
        camera = tips_of(machine, poses) @ self.camera_pose
        seen = in_camera(camera, self._places).reshape(-1, 3)
        visible = self._faces(camera, seen) & (self.lens is None or self.lens.sees(seen))
        if not visible.any():
            raise BadInputError(
                "the camera sees no point of the object in any pose; take poses that look at it"
            )
        rows, point = np.divmod(np.flatnonzero(visible), len(self._places))
        seen = as_read(machine.effects, seen[visible])
        reading = seen if self.in_metres or self.lens is None else self.lens.project(seen)
        reading = reading + draw_noise(reading.shape, self.sigma, rng)
        names = ("cx", "cy", "cz") if self.in_metres else ("u", "v")
        columns = dict(zip(names, reading.T, strict=True))
        return Reading(poses, rows, {"point": np.array(self.target.names)[point]} | columns)

    def _faces(self, camera: np.ndarray, seen: np.ndarray) -> np.ndarray:
        """Return whether the plate of each point, at ``seen`` in the camera's frame, faces the
        camera, shape (N * K,).
        """
        if self.target.normals is None:
            return np.ones(len(seen), bool)
        normals = self.target.normals @ self.object_pose[:3, :3].T
        facing = np.einsum("nab,ka->nkb", camera[:, :3, :3], normals).reshape(-1, 3)
        cosine = -np.sum(facing * seen, axis=1) / np.maximum(np.linalg.norm(seen, axis=1), 1e-12)
        return np.asarray(cosine > _OBLIQUE)

    def line_of_sight(self, tip: np.ndarray) -> np.ndarray:
        return in_camera(tip @ self.camera_pose, self.object_pose[None, :3, 3])[:, 0]

    def truth(self) -> dict[str, Any]:
        poses = {
            "T_tip_camera": self.camera_pose.tolist(),
            "T_base_object": self.object_pose.tolist(),
        }
        if self.in_metres or self.lens is None:
            return {"noise": {"sigma_m": self.sigma, "sigma_rad": None}} | poses
        noise = {"sigma_m": None, "sigma_rad": None, "sigma_px": self.sigma}
        return {"noise": noise} | poses | {"camera": self.lens.intrinsics}


def in_camera(camera: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return points [m, base frame], shape (K, 3), in the frames of cameras, shape (N, K, 3), given
    as T_base_camera.
    """
    return np.asarray(np.einsum("nab,nka->nkb", camera[:, :3, :3], places - camera[:, None, :3, 3]))
