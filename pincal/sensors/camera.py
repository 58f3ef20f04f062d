"""Cameras: in the hand, observing named points of a fixed object in space or in the image, or
fixed, observing the tool.

For a camera in the hand the target on the tool is the camera's frame (z along the view, x right, y
down), and the instrument's frame is the object's. If no point of the object is known, points are
found in the robot's base frame (paper, section IV.A).

Starts: P - R_i (W c_i + t) = p_i, with a point c_i in the camera's frame and P in the base frame,
is linear in P and in the camera's pose t, W on the tool. P is eliminated by subtracting the mean
over each point's rows. An image lacks the depth of c_i: :mod:`pincal.sensors.lens` finds the pose
at which lines of sight intersect in the points.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Self, final

import numpy as np

from pincal.parameters import FRAME_SYMBOLS, Parameter
from pincal.robot.se3 import nearest_rotation, transform
from pincal.sensors.extrinsics import Extrinsics, by_target
from pincal.sensors.fields import CONDITIONS, POINT, Field, TableRows
from pincal.sensors.lens import NEAREST, Lens, camera_starts, slopes
from pincal.sensors.point_sensor import PointSensor, centred, solved
from pincal.sensors.pose import check_spread
from pincal.sensors.row_samples import sample_rows
from pincal.sensors.sensor import (
    Additive,
    Block,
    Excluded,
    KnownParameters,
    OwnParameters,
    Plausible,
)
from pincal.sensors.setup import Setup
from pincal.thresholds import Count

PIXEL = Field("pixel", ("u", "v"), "pixel")
# Rows in the search for a start, per target for a fixed camera.
_SAMPLE: Count = 300


@dataclass(frozen=True)
class Images(Additive, KnownParameters):
    """2D: images in a camera, whose parameters are the last of the sensor's own.

    Attributes:
        pixel: the images, shape (N, 2) [px].
        setup: with the camera, if it is known.
    """

    blocks: ClassVar[tuple[Block, ...]] = (
        Block("image", "px", 2, rounding=1e-9, noise=0.1, axes="uv"),
    )
    follows: ClassVar[str] = "as ratios"
    deviation_end: ClassVar[str] = "the component across the view that the image measures"

    pixel: np.ndarray
    setup: Setup

    @property
    @final
    def known_parameters(self) -> np.ndarray:
        """The camera's parameters if it is known, and always those of unusual lenses."""
        fixed = self.setup.lens_fixed()
        return np.append(np.zeros(len(self.parameters) - len(fixed), bool), fixed)

    @property
    @final
    def is_given(self) -> bool:
        return self.setup.lens is not None

    @property
    @final
    def doubt(self) -> str:
        return "the images contradict the given camera parameters: --fit-camera identifies them"

    @final
    def lens(self, own: np.ndarray) -> Lens:
        """Return the camera for values of the sensor's parameters."""
        parameters = self.setup.lens_parameters()
        return Lens(
            *(
                p.nominal + value
                for p, value in zip(parameters, own[-len(parameters) :], strict=True)
            )
        )


@dataclass(frozen=True)
class CameraSensor(PointSensor):
    """Readings of a camera, each of one point; ``has_scale`` if they determine its distance."""

    tool_symbols: ClassVar[tuple[str, ...]] = FRAME_SYMBOLS
    twist_rows: ClassVar[int] = 6
    names_points: ClassVar[str | None] = "point"
    default_target: ClassVar[str] = "camera"
    pose_limit: ClassVar[str] = (
        "of the camera; each image determines six coordinates, however many points it shows"
    )
    has_camera: ClassVar[bool] = True
    is_on_tool: ClassVar[bool] = True
    thing: ClassVar[str] = "a point"
    fewest: ClassVar[int] = 2
    needs_all_rows: ClassVar[bool] = False
    has_scale: ClassVar[bool]

    @final
    def unobservable_with(self, known: int) -> Iterator[str]:
        """Yield the pose of the object, if none of its points is known, and the scale, if images do
        not determine it.
        """
        if not known:
            yield (
                "the points of the calibration object are unknown, so they are identified in the "
                "robot's base frame; --points FILE.csv (columns point x y z) adds information"
            )
            if not (self.has_scale or self.points.distances):
                yield (
                    "images of unknown points do not determine the scale, which relies on the "
                    "nominal lengths of the arm"
                )

    @final
    def seen(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return each row's point in the camera's frame, shape (N, 3) [m]."""
        away = self.points.positions(own)[self.index] - poses[:, :, 3]
        return np.asarray(np.einsum("nij,ni->nj", poses[:, :, :3], away))

    @final
    def seen_motion(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the motion of each row's point in the camera's frame, shape (P, 3, N)."""
        away = (self.points.positions(own)[self.index] - poses[:, :, 3]).T
        shift = motion[:, :3]
        turn = motion[:, 3:]
        moved = np.empty(shift.shape)
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            moved[:, i] = turn[:, k] * away[j] - turn[:, j] * away[k] - shift[:, i]
        return _each_times(poses[:, :, :3].swapaxes(1, 2), moved)


@dataclass(frozen=True)
class CameraPointSensor(CameraSensor, Additive, Plausible):
    """3D: the point in the camera's frame, shape (N, 3) [m]."""

    kind: ClassVar[str] = "camera_point"
    fields: ClassVar[tuple[Field, ...]] = (
        Field("camera_point", ("cx", "cy", "cz"), "length"),
        POINT,
    )
    blocks: ClassVar[tuple[Block, ...]] = (Block("position", "m", 3),)
    per_row: ClassVar[tuple[str, ...]] = ("index", "camera_point")
    has_scale: ClassVar[bool] = True
    other_parameters: ClassVar[tuple[Parameter, ...]] = ()
    deviation_end: ClassVar[str] = "where the camera would have to be for its reading"

    camera_point: np.ndarray

    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        return np.asarray((self.camera_point - self.seen(poses, own)).T)

    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        by_place = poses[:, :, :3].transpose(1, 2, 0)
        return np.concatenate([self.seen_motion(poses, motion, own), self.by_points(by_place)])

    def displacement(self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        return np.asarray(-np.einsum("nij,jn->ni", poses[:, :, :3], residuals))

    def starts(self, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Extrinsics]:
        """Yield the camera's pose in the hand at which the points of the object are fixed."""
        p = tips[:, :, 3]
        R = tips[:, :, :3]
        c = self.camera_point
        products = np.einsum("nab,nc->nabc", R, c).reshape(len(p), 3, 9)
        A = np.concatenate([products, R], axis=2)
        W = nearest_rotation(
            solved(-centred(A, self.index), centred(p, self.index))[:9].reshape(3, 3)
        )
        seen = np.einsum("nab,bc,nc->na", R, W, c)
        t = solved(-centred(R, self.index), centred(p + seen, self.index))
        yield self.start_at_means(p + seen + R @ t, transform(W, t)[None])

    @property
    def impossible(self) -> Excluded:
        behind = self.camera_point[:, 2] <= 0.0
        return Excluded(
            behind, "have cz <= 0, a point behind the camera", "points in front of the camera"
        )

    @classmethod
    def check_plausible(cls, table: TableRows, reach_m: float) -> None:
        ranges = np.linalg.norm(table.array("camera_point"), axis=1, keepdims=True)
        check_spread(table, ranges, label="cx", reach_m=reach_m)


@dataclass(frozen=True)
class CameraPixelSensor(CameraSensor, Images):
    """2D: the point's image, shape (N, 2) [px]."""

    kind: ClassVar[str] = "camera_pixel"
    fields: ClassVar[tuple[Field, ...]] = (PIXEL, POINT)
    per_row: ClassVar[tuple[str, ...]] = ("index", "pixel")
    has_scale: ClassVar[bool] = False
    impossible: ClassVar[None] = None

    @property
    def other_parameters(self) -> tuple[Parameter, ...]:
        return self.setup.lens_parameters()

    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        return np.asarray((self.pixel - self.lens(own).project(self.seen(poses, own))).T)

    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        _, by_seen, by_lens = self.lens(own).linearise(self.seen(poses, own))
        moved = _each_times(by_seen, self.seen_motion(poses, motion, own))
        by_place = np.einsum("nab,nib->ian", by_seen, poses[:, :, :3])
        return np.concatenate([moved, self.by_points(by_place), by_lens.transpose(2, 1, 0)])

    def displacement(self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the component across the view, at the distance of the point."""
        depth = np.maximum(self.seen(poses, own)[:, 2], NEAREST)
        lens = self.lens(own)
        across = np.stack(
            [residuals[0] / lens.fx * depth, residuals[1] / lens.fy * depth, 0.0 * depth]
        )
        return np.asarray(-np.einsum("nij,jn->ni", poses[:, :, :3], across))

    def starts(self, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Extrinsics]:
        """Yield the best poses and focal lengths of the camera."""
        rows = sample_rows(len(self), _SAMPLE, self.groups)
        nominal = self.setup.lens_values
        known = self.setup.lens
        views = self.index, len(self.points.names), tips, self.pixel
        for hand, places, lens in camera_starts(*views, known=known, rows=rows):
            yield self.start_with_points(places, hand[None], rest=lens.values - nominal)


@dataclass(frozen=True)
class FixedCameraSensor(Images, OwnParameters):
    """2D: the image of a target on the tool, shape (N, 2) [px], in a fixed camera."""

    kind: ClassVar[str] = "fixed_camera_pixel"
    fields: ClassVar[tuple[Field, ...]] = (PIXEL, CONDITIONS["target"])
    tool_symbols: ClassVar[tuple[str, ...]] = FRAME_SYMBOLS[:3]
    base_symbols: ClassVar[tuple[str, ...]] = FRAME_SYMBOLS
    twist_rows: ClassVar[int] = 3
    per_row: ClassVar[tuple[str, ...]] = ("pixel",)
    has_camera: ClassVar[bool] = True
    own_words: ClassVar[str] = ""

    @classmethod
    def of(cls, table: TableRows, setup: Setup) -> Self:
        return cls(table.array("pixel"), setup)

    @property
    def own_parameters(self) -> tuple[Parameter, ...]:
        return self.setup.lens_parameters()

    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        return np.asarray((self.pixel - self.lens(own).project(poses[:, :, 3])).T)

    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        _, by_seen, by_lens = self.lens(own).linearise(poses[:, :, 3])
        return np.concatenate([_each_times(by_seen, motion), by_lens.transpose(2, 1, 0)])

    def displacement(self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        return self.least_displacement(residuals, poses, own)

    def starts(self, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Extrinsics]:
        """Yield the pose by images of the tips, then of the targets, if the images determine their
        positions on the tool.
        """
        rows = sample_rows(len(self), _SAMPLE, target)
        lens = self.setup.lens
        tips = tips[rows]
        target = target[rows]
        pixel = self.pixel[rows]
        if lens is not None:
            pixel = slopes(lens, pixel)
        p = tips[:, :, 3]
        R = tips[:, :, :3]
        tools = np.tile(np.eye(4), (n_targets, 1, 1))
        yield self._start(_matrix(p, pixel)[0], tools)
        M, products = _matrix(p, pixel, by_target(R.reshape(-1, 9), target, n_targets))
        if products is None:
            return
        for t, product in enumerate(products):
            tools[t, :3, 3] = np.einsum("ac,acd->d", M[:, :3], product) / np.sum(M[:, :3] ** 2)
        ends = p + np.einsum("nij,nj->ni", R, tools[target, :3, 3])
        yield self._start(_matrix(ends, pixel)[0], tools.copy())

    def unobservable(self) -> Iterator[str]:
        yield "images do not determine the scale, which relies on the nominal lengths of the arm"

    def _start(self, M: np.ndarray, tools: np.ndarray) -> Extrinsics:
        """Return the poses for a camera matrix from the robot's base, shape (3, 4)."""
        from scipy.linalg import rq

        nominal = self.setup.lens_values
        if self.setup.lens is not None:
            scale = np.linalg.svd(M[:, :3], compute_uv=False).mean()
            return Extrinsics(
                transform(nearest_rotation(M[:, :3]), M[:, 3] / scale),
                tools,
                np.zeros(len(nominal)),
            )
        K, R = rq(M[:, :3])
        signs = np.where(np.diag(K) < 0.0, -1.0, 1.0)
        K = K * signs
        R = signs[:, None] * R
        place = np.linalg.solve(K, M[:, 3])
        K = K / K[2, 2]
        values = np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], np.zeros(len(nominal) - 4)])
        return Extrinsics(transform(nearest_rotation(R), place), tools, values - nominal)


def _each_times(matrices: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the matrix of each row, shape (N, a, b), times columns, shape (P, b, N): shape (P, a,
    N).
    """
    # Eight times as fast with contiguous rows.
    return np.asarray(
        np.einsum("abn,pbn->pan", np.ascontiguousarray(matrices.transpose(1, 2, 0)), columns)
    )


def _matrix(
    p: np.ndarray, image: np.ndarray, columns: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the matrix that projects points to their images, and the coefficients of further
    columns.

    Args:
        p: shape (N, 3), points in the robot's base frame.
        image: shape (N, 2).
        columns: shape (N, 9 T), rotations of the tip, target by target.

    Returns:
        Shape (3, 4), for a right-handed camera with the points in front of it; shape (T, 3, 3, 3),
        [a, c, d] multiplies element [c, d] of the rotation in row a, None without columns or with
        too few rows for them.
    """
    n = len(p)
    middle = image.mean(axis=0)
    width = np.abs(image - middle).max()
    size = np.abs(p).max()
    X = np.hstack([p / size, np.ones((n, 1))] + ([] if columns is None else [columns]))
    k = X.shape[1]
    if 2 * n < 3 * k:
        return np.eye(3, 4), None
    u, v = ((image - middle) / width).T
    none = np.zeros_like(X)
    A = np.vstack([np.hstack([X, none, -u[:, None] * X]), np.hstack([none, X, -v[:, None] * X])])
    found = np.linalg.eigh(A.T @ A)[1][:, 0].reshape(3, k)
    found = np.array([[width, 0.0, middle[0]], [0.0, width, middle[1]], [0.0, 0.0, 1.0]]) @ found
    found[:, :3] /= size
    found *= np.sign(np.median(X[:, :4] @ (found[2, :4] * [size, size, size, 1.0])))
    products = None if columns is None else found[:, 4:].reshape(3, -1, 3, 3).swapaxes(0, 1)
    return found[:, :4], products
