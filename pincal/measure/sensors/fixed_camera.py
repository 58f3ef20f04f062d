r"""A camera that stands in the cell and sees targets on the tool in its image (eye-to-hand).

The instrument's frame is the camera's (z along the view, x to the right, y down). Poses or points that the camera gives in
metres need no sensor of their own: they are poses or positions in the frame of an instrument.

Where it starts: with the nominal arm's poses (R_i, p_i), the camera's place R, b, its matrix K and the target t on the tool,
u_i ~ K (R p_i + R R_i t + b) is linear in K R, K b and the products K R (x) t, up to one factor (direct linear transform;
Hartley and Zisserman, Multiple View Geometry, section 7.1).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from pincal.measure.extrinsics import Extrinsics, by_target
from pincal.measure.fields import CONDITIONS, Field, TableRows
from pincal.measure.sampling import sample_rows
from pincal.measure.sensor import OwnParameters
from pincal.measure.sensors.camera import PIXEL, Images
from pincal.measure.setup import Setup
from pincal.measure.triangulation import rays
from pincal.parameters import FRAME_SYMBOLS, Parameter
from pincal.robot.se3 import nearest_rotation, transform

# Rows of each target that the start looks at.
_SAMPLE = 300


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
        """Return the images of a table."""
        return cls(table.array("pixel"), setup)

    @property
    def own_parameters(self) -> tuple[Parameter, ...]:
        """The camera's own."""
        return self.setup.lens_parameters()

    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return reading minus prediction, shape (2, N) [px]."""
        return np.asarray((self.pixel - self.lens(own).project(poses[:, :, 3])).T)

    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the motion of the image, by the target's motion and by the camera's parameters."""
        _, by_seen, by_lens = self.lens(own).linearise(poses[:, :, 3])
        return np.concatenate([np.einsum("nab,pbn->pan", by_seen, motion), by_lens.transpose(2, 1, 0)])

    def displacement(self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the part across the line of sight."""
        return self.least_displacement(residuals, poses, own)

    def starts(self, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Extrinsics]:
        """Yield where the camera sees the tips, then the targets, which the images place on the tool if they can."""
        rows = sample_rows(len(self), _SAMPLE, target)
        lens, tips, target, pixel = self.setup.lens, tips[rows], target[rows], self.pixel[rows]
        if lens is not None:
            sight = rays(lens, pixel)
            pixel = sight[:, :2] / sight[:, 2:]
        p, R = tips[:, :, 3], tips[:, :, :3]
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
        """Yield the scale."""
        yield "images do not determine the scale, which relies on the nominal lengths of the arm"

    def _start(self, M: np.ndarray, tools: np.ndarray) -> Extrinsics:
        """Return where all stands for a camera matrix from the robot's base, shape (3, 4)."""
        from scipy.linalg import rq

        nominal = self.setup.lens_values
        if self.setup.lens is not None:
            scale = np.linalg.svd(M[:, :3], compute_uv=False).mean()
            return Extrinsics(transform(nearest_rotation(M[:, :3]), M[:, 3] / scale), tools, np.zeros(len(nominal)))
        K, R = rq(M[:, :3])
        signs = np.where(np.diag(K) < 0.0, -1.0, 1.0)
        K, R = K * signs, signs[:, None] * R
        place = np.linalg.solve(K, M[:, 3])
        K = K / K[2, 2]
        values = np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], np.zeros(len(nominal) - 4)])
        return Extrinsics(transform(nearest_rotation(R), place), tools, values - nominal)


def _matrix(p: np.ndarray, image: np.ndarray, columns: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the matrix that projects points to their images, and with it what multiplies further columns.

    Args:
        p: shape (N, 3), points in the robot's base frame.
        image: shape (N, 2).
        columns: shape (N, 9 T), rotations of the tip, target by target.

    Returns:
        Shape (3, 4), of a right-handed camera before which the points lie; shape (T, 3, 3, 3), [a, c, d] multiplies the
        element [c, d] of the rotation in row a. The latter is None without columns, or if there are too few rows for them.
    """
    n, middle = len(p), image.mean(axis=0)
    width, size = np.abs(image - middle).max(), np.abs(p).max()
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
