"""Where a camera in the hand and the points that it sees are, from images alone and without a first guess.

With the nominal arm's poses (R_i, p_i) in the robot's base frame, a point P that stands still there and the camera's place
t, W on the tool, P - R_i (W c_i + t) = p_i holds for the point c_i in the camera's frame. An image lacks the depth of c_i:
what is left is linear in P and t once W and the focal length are given, which are looked for on a grid. P is eliminated.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pincal.measure.extrinsics import RANK
from pincal.measure.lens import Lens
from pincal.robot.se3 import transform

# Focal lengths that are tried where none is known, in widths of the part of the image that is used.
_FOCAL = (0.5, 0.8, 1.2, 1.8, 2.7, 4.0, 6.0)
# Starts of the search that are made better, and those of them that are kept.
_GRID_STARTS, _KEPT = 6, 3
# A point is not looked for nearer to the camera than this [m].
_NEAR = 0.02
# Rounds that take the distortion of a known camera out of an image.
_ROUNDS = 20


@dataclass(frozen=True)
class Views:
    """Images of named points.

    Attributes:
        index: shape (N,), the point of each row.
        n_points: how many points there are.
        tips: shape (N, 3, 4), nominal tips in the robot's base frame.
        pixel: shape (N, 2), the images [px].
    """

    index: np.ndarray
    n_points: int
    tips: np.ndarray
    pixel: np.ndarray

    def sight(self, lens: Lens, turn: np.ndarray) -> _Sight:
        """Return the camera's place and the points nearest to their lines of sight, for a camera turned on the tool.

        Args:
            lens: the camera.
            turn: shape (3, 3), camera to tip frame.
        """
        index, R, p = self.index, self.tips[:, :, :3], self.tips[:, :, 3]
        sight = np.einsum("nab,nb->na", R, rays(lens, self.pixel) @ turn.T)
        across = np.eye(3) - sight[:, :, None] * sight[:, None, :]
        push = np.einsum("nab,nb->na", across, p)
        turned = across @ R
        S, b, B = np.zeros((self.n_points, 3, 3)), np.zeros((self.n_points, 3)), np.zeros((self.n_points, 3, 3))
        np.add.at(S, index, across)
        np.add.at(b, index, push)
        np.add.at(B, index, turned)
        inverse = np.linalg.pinv(S, rcond=RANK, hermitian=True)
        H = np.einsum("nba,nbc->ac", R, turned) - np.einsum("kba,kbc,kcd->ad", B, inverse, B)
        h = np.einsum("kba,kbc,kc->a", B, inverse, b) - np.einsum("nba,nb->a", R, push)
        t = np.linalg.lstsq(H, h, rcond=RANK)[0]
        places = np.einsum("kab,kb->ka", inverse, b + B @ t)
        away = places[index] - p - R @ t
        depth = np.einsum("na,na->n", away, sight)
        missed = np.einsum("nab,nb->na", across, away)
        angle = np.arctan2(np.linalg.norm(missed, axis=1), depth)
        image = lens.fx * missed / np.maximum(depth, _NEAR)[:, None]
        return _Sight(lens.fx * float(np.mean(angle)), image.ravel(), t, places)


def camera_starts(views: Views, known: Lens | None, *, rows: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, Lens]]:
    """Yield the best places and focal lengths of the camera: those on a grid, made better one by one.

    Args:
        views: the images.
        known: the camera, where it is known.
        rows: those that the search looks at.

    Yields:
        The camera's frame in the tip frame, shape (4, 4), the points in the robot's base frame [m], shape (K, 3), the lens.
    """
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    sample = Views(views.index[rows], views.n_points, views.tips[rows], views.pixel[rows])
    lens, focal = _guessed(views.pixel, known)

    def missed(x: np.ndarray) -> _Sight:
        return sample.sight(_scaled(lens, x[3:]), Rotation.from_rotvec(x[:3]).as_matrix())

    turns = Rotation.create_group("I").as_rotvec()
    grid = [np.append(turn, scale) for scale in focal for turn in turns]
    best = sorted(grid, key=lambda x: missed(x).error)[:_GRID_STARTS]
    found = [least_squares(lambda x: missed(x).image, x, max_nfev=_ROUNDS).x for x in best]
    for x in sorted(found, key=lambda x: missed(x).error)[:_KEPT]:
        turn, scaled = Rotation.from_rotvec(x[:3]).as_matrix(), _scaled(lens, x[3:])
        sight = views.sight(scaled, turn)
        yield transform(turn, sight.camera), sight.points, scaled


def _guessed(pixel: np.ndarray, known: Lens | None) -> tuple[Lens, list[list[float]]]:
    """Return a camera, and the logarithms of the factors on its focal length that are tried (none where it is known)."""
    if known is not None:
        return known, [[]]
    low, high = pixel.min(axis=0), pixel.max(axis=0)
    width = float(np.max(high - low))
    u0, v0 = 0.5 * (low + high)
    return Lens(width, width, float(u0), float(v0)), [[float(np.log(f))] for f in _FOCAL]


def _scaled(lens: Lens, log_factor: np.ndarray) -> Lens:
    factor = float(np.exp(log_factor.sum()))
    return replace(lens, fx=lens.fx * factor, fy=lens.fy * factor)


def rays(lens: Lens, pixel: np.ndarray) -> np.ndarray:
    """Return unit vectors in the camera's frame along the lines of sight, shape (N, 3)."""
    ideal = (pixel - (lens.u0, lens.v0)) / (lens.fx, lens.fy)
    slopes = ideal
    ones = np.ones((len(pixel), 1))
    for _ in range(_ROUNDS if np.any(lens.values[4:]) else 0):
        bent = (lens.project(np.hstack([slopes, ones])) - (lens.u0, lens.v0)) / (lens.fx, lens.fy)
        slopes = slopes + 0.5 * (ideal - bent)
    rays = np.hstack([slopes, ones])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


@dataclass(frozen=True)
class _Sight:
    """How well lines of sight meet.

    Attributes:
        error: by which they miss their points, mean over the rows [px].
        image: the same row by row, shape (3 N,) [px]; in pixels, as a long lens sees any points at small angles.
        camera: the camera's place in the tip frame, shape (3,) [m].
        points: the points in the base frame, shape (K, 3) [m].
    """

    error: float
    image: np.ndarray
    camera: np.ndarray
    points: np.ndarray
