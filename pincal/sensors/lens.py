"""The camera model: a pinhole with radial and tangential distortion.

With x = X / Z, y = Y / Z and r^2 = x^2 + y^2 of a point in the camera's frame (z along the view, x
right, y down):

    x'' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y'' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y
    u = fx x'' + u0,  v = fy y'' + v0

(Brown 1966; the same order and signs as OpenCV's.)

The poses of a camera in the hand and the points that it sees are found from images alone, without a
first guess. For a point P fixed in the robot's base frame, P - R_i (W c_i + t) = p_i with the
nominal arm's poses (R_i, p_i), the orientation W and position t of the camera on the tool, and the
point c_i in its frame. An image lacks the depth of c_i; the other equations are linear in P and t
once W and the focal length, which are searched on a grid, are given. P is eliminated.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from pincal.robot.se3 import transform
from pincal.sensors.extrinsics import RANK
from pincal.thresholds import Count, Scale

PINHOLE = ("fx", "fy", "u0", "v0")
DISTORTION = ("k1", "k2", "p1", "p2", "k3")
# Least depth of a point [m]: the prediction of points nearer to the lens, or behind it, remains
# finite.
NEAREST: Scale = 1e-3


@dataclass(frozen=True)
class Lens:
    """Intrinsic parameters of a camera.

    Attributes:
        fx, fy: focal lengths [px].
        u0, v0: principal point [px].
        k1, k2, k3: radial distortion, as in OpenCV [1].
        p1, p2: tangential distortion [1].

    Example:
        >>> Lens(1000.0, 1000.0, 320.0, 240.0).project(np.array([[0.1, 0.0, 1.0]])).tolist()
        [[420.0, 240.0]]
    """

    fx: float
    fy: float
    u0: float
    v0: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    @property
    def values(self) -> np.ndarray:
        """The parameters in the order of ``PINHOLE`` and ``DISTORTION``, shape (9,)."""
        return np.array([getattr(self, name) for name in (*PINHOLE, *DISTORTION)], float)

    def project(self, seen: np.ndarray) -> np.ndarray:
        """Return the image [px], shape (N, 2), of points in the camera's frame [m],
        shape (N, 3).
        """
        return _bent(self, _slopes(seen)[0])[0]

    def linearise(self, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the image [px], shape (N, 2), of points in the camera's frame [m], shape (N, 3),
        and its derivatives.

        Returns:
            The image; its derivatives with respect to the point, shape (N, 2, 3), and to the
            parameters, shape (N, 2, 9).
        """
        slopes, depth = _slopes(seen)
        image, by_slope, by_lens = _bent(self, slopes)
        by_point = np.empty((len(seen), 2, 3))
        by_point[:, :, :2] = by_slope / depth[:, None, None]
        by_point[:, :, 2] = -np.einsum("nab,nb->na", by_slope, slopes) / depth[:, None]
        return image, by_point, by_lens


def _slopes(seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    depth = np.maximum(seen[:, 2], NEAREST)
    return seen[:, :2] / depth[:, None], depth


def _bent(lens: Lens, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the image of slopes x, y, shape (N, 2), and its derivatives with respect to slopes and
    parameters.
    """
    x, y = slopes.T
    r2 = x * x + y * y
    radial = 1.0 + r2 * (lens.k1 + r2 * (lens.k2 + r2 * lens.k3))
    change = lens.k1 + r2 * (2.0 * lens.k2 + r2 * 3.0 * lens.k3)  # d radial / d r2
    bent_x = x * radial + 2.0 * lens.p1 * x * y + lens.p2 * (r2 + 2.0 * x * x)
    bent_y = y * radial + lens.p1 * (r2 + 2.0 * y * y) + 2.0 * lens.p2 * x * y
    cross = 2.0 * x * y * change + 2.0 * lens.p1 * x + 2.0 * lens.p2 * y
    by_slope = np.empty((len(x), 2, 2))
    by_slope[:, 0, 0] = lens.fx * (
        radial + 2.0 * x * x * change + 2.0 * lens.p1 * y + 6.0 * lens.p2 * x
    )
    by_slope[:, 0, 1] = lens.fx * cross
    by_slope[:, 1, 0] = lens.fy * cross
    by_slope[:, 1, 1] = lens.fy * (
        radial + 2.0 * y * y * change + 6.0 * lens.p1 * y + 2.0 * lens.p2 * x
    )
    by_lens = np.zeros((len(x), 2, 9))
    by_lens[:, 0, 0] = bent_x
    by_lens[:, 1, 1] = bent_y
    by_lens[:, 0, 2] = by_lens[:, 1, 3] = 1.0
    for k, power in zip((4, 5, 8), (r2, r2**2, r2**3), strict=True):
        by_lens[:, 0, k] = lens.fx * x * power
        by_lens[:, 1, k] = lens.fy * y * power
    by_lens[:, 0, 6] = lens.fx * 2.0 * x * y
    by_lens[:, 1, 6] = lens.fy * (r2 + 2.0 * y * y)
    by_lens[:, 0, 7] = lens.fx * (r2 + 2.0 * x * x)
    by_lens[:, 1, 7] = lens.fy * 2.0 * x * y
    image = np.stack([lens.fx * bent_x + lens.u0, lens.fy * bent_y + lens.v0], axis=1)
    return image, by_slope, by_lens


# Focal lengths tried where none is known, in widths of the used part of the image.
_FOCAL: tuple[Scale, ...] = (0.5, 0.8, 1.2, 1.8, 2.7, 4.0, 6.0)
# Starts of the search that are refined, and how many of them are kept.
_GRID_STARTS: Count = 6
_KEPT: Count = 3
# Least distance of a point from the camera in the search [m].
_NEAR: Scale = 0.02
# Iterations that remove the distortion of a known camera.
_ROUNDS: Count = 20


@dataclass(frozen=True)
class Views:
    """Images of named points.

    Attributes:
        index: shape (N,), the point of each row.
        n_points: number of points.
        tips: shape (N, 3, 4), nominal tips in the robot's base frame.
        slopes: shape (N, 2), undistorted directions x/z, y/z of the points from a camera.
        focal: the focal length of that camera [px].
    """

    index: np.ndarray
    n_points: int
    tips: np.ndarray
    slopes: np.ndarray
    focal: float

    def of(self, rows: np.ndarray) -> Views:
        """Return some of the rows."""
        return replace(self, index=self.index[rows], tips=self.tips[rows], slopes=self.slopes[rows])

    def sight(self, turn: np.ndarray, factor: float) -> _Sight:
        """Return the camera's position and the points nearest to their lines of sight, for a given
        orientation.

        Args:
            turn: shape (3, 3), rotation from the camera to the tip frame.
            factor: on the focal length.
        """
        index = self.index
        R = self.tips[:, :, :3]
        p = self.tips[:, :, 3]
        seen = np.column_stack([self.slopes / factor, np.ones(len(p))])
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        sight = (R @ (seen @ turn.T)[:, :, None])[:, :, 0]
        across = np.eye(3) - sight[:, :, None] * sight[:, None, :]
        push = (across @ p[:, :, None])[:, :, 0]
        turned = across @ R
        S = np.zeros((self.n_points, 3, 3))
        b = np.zeros((self.n_points, 3))
        B = np.zeros((self.n_points, 3, 3))
        np.add.at(S, index, across)
        np.add.at(b, index, push)
        np.add.at(B, index, turned)
        # The position of a point along its only line of sight is undetermined, so that this ridge
        # changes nothing else.
        inverse = np.linalg.inv(S + RANK * np.eye(3))
        solved = inverse @ B
        H = np.tensordot(R, turned, ((0, 1), (0, 1))) - np.tensordot(B, solved, ((0, 1), (0, 1)))
        h = np.tensordot(solved, b, ((0, 1), (0, 1))) - np.tensordot(R, push, ((0, 1), (0, 1)))
        t = np.linalg.lstsq(H, h, rcond=RANK)[0]
        places = (inverse @ (b + B @ t)[:, :, None])[:, :, 0]
        away = places[index] - p - R @ t
        depth = np.sum(away * sight, axis=1)
        missed = (across @ away[:, :, None])[:, :, 0]
        angle = np.arctan2(np.linalg.norm(missed, axis=1), depth)
        focal = factor * self.focal
        image = focal * missed / np.maximum(depth, _NEAR)[:, None]
        return _Sight(focal * float(np.mean(angle)), image.ravel(), t, places)


def camera_starts(
    index: np.ndarray,
    n_points: int,
    tips: np.ndarray,
    pixel: np.ndarray,
    *,
    known: Lens | None,
    rows: np.ndarray,
) -> Iterator[tuple[np.ndarray, np.ndarray, Lens]]:
    """Yield the best poses and focal lengths of the camera: those on a grid, each refined.

    Args:
        index: shape (N,), the point of each row.
        n_points: number of points.
        tips: shape (N, 3, 4), nominal tips in the robot's base frame.
        pixel: shape (N, 2), the images [px].
        known: the camera, where it is known.
        rows: the subsample used by the search.

    Yields:
        The camera's frame in the tip frame, shape (4, 4), the points in the robot's base frame [m],
        shape (K, 3), the lens.
    """
    from scipy.optimize import least_squares

    lens = known
    scales = [np.zeros(0)]
    if lens is None:
        low = pixel.min(axis=0)
        high = pixel.max(axis=0)
        width = float(np.max(high - low))
        (u0, v0) = (0.5 * (low + high)).tolist()
        lens = Lens(width, width, u0, v0)
        scales = [np.log([factor]) for factor in _FOCAL]
    views = Views(index, n_points, tips, slopes(lens, pixel), lens.fx)
    sample = views.of(rows)

    def missed(x: np.ndarray) -> _Sight:
        return sample.sight(Rotation.from_rotvec(x[:3]).as_matrix(), float(np.exp(x[3:].sum())))

    turns = Rotation.create_group("I").as_rotvec()
    grid = [np.append(turn, scale) for scale in scales for turn in turns]
    best = sorted(grid, key=lambda x: missed(x).error)[:_GRID_STARTS]
    found = [least_squares(lambda x: missed(x).image, x, max_nfev=_ROUNDS).x for x in best]
    for x in sorted(found, key=lambda x: missed(x).error)[:_KEPT]:
        turn = Rotation.from_rotvec(x[:3]).as_matrix()
        factor = float(np.exp(x[3:].sum()))
        sight = views.sight(turn, factor)
        yield (
            transform(turn, sight.camera),
            sight.points,
            replace(lens, fx=factor * lens.fx, fy=factor * lens.fy),
        )


def slopes(lens: Lens, pixel: np.ndarray) -> np.ndarray:
    """Return the undistorted directions of points in the camera's frame: x/z and y/z,
    shape (N, 2).
    """
    ideal = (pixel - (lens.u0, lens.v0)) / (lens.fx, lens.fy)
    found = ideal
    for _ in range(_ROUNDS if np.any(lens.values[4:]) else 0):
        bent = (_bent(lens, found)[0] - (lens.u0, lens.v0)) / (lens.fx, lens.fy)
        found = found + 0.5 * (ideal - bent)
    return np.asarray(found)


@dataclass(frozen=True)
class _Sight:
    """Intersection of lines of sight.

    Attributes:
        error: mean miss distance of the lines from their points [px].
        image: miss vectors, shape (3 N,) [px]; in pixels, as angles vanish for long focal lengths.
        camera: the camera's position in the tip frame, shape (3,) [m].
        points: the points in the base frame, shape (K, 3) [m].
    """

    error: float
    image: np.ndarray
    camera: np.ndarray
    points: np.ndarray
