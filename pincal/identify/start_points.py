r"""Where named points, a tool point and a camera in the hand are, in closed form and without a first guess.

With the nominal arm's poses (R_i, p_i) in the robot's base frame, a point P that stands still there and a tool t, W:

contact     P - R_i t = p_i: linear in P and t.
distance    as from an instrument's point, anchor by anchor.
camera      P - R_i (W c_i + t) = p_i with the point c_i in the camera's frame: linear in P, t and W.
image       the same without the depth of c_i: linear in P and t once W and the focal length are given, which are looked for
            on a grid.

P is eliminated by taking each point's rows about their mean. What is known of points places the robot's base.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pincal.identify.placement import RANK, Extrinsics, by_target, from_distances
from pincal.identify.rows import some_rows
from pincal.measure.camera import CameraPixelSensor, CameraPointSensor
from pincal.measure.lens import Lens
from pincal.measure.points import AnchoredDistanceSensor, ContactSensor, PointSensor
from pincal.robot.se3 import align, nearest_rotation, transform

# Focal lengths that are tried where none is known, in widths of the part of the image that is used.
_FOCAL = (0.5, 0.8, 1.2, 1.8, 2.7, 4.0, 6.0)
# Rows and starts of the search on a grid.
_GRID_ROWS, _GRID_STARTS, _KEPT = 300, 6, 3
# A point is not looked for nearer to the camera than this [m].
_NEAR = 0.02
# Rounds that take the distortion of a known camera out of an image.
_ROUNDS = 20


def from_contacts(sensor: ContactSensor, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Extrinsics]:
    """Yield the tool points that keep best still in their sockets."""
    p, R = tips[:, :, 3], tips[:, :, :3]
    columns = by_target(R, target, n_targets)
    offsets = _least_squares(-_centred(columns, sensor.index), _centred(p, sensor.index))
    tools = np.tile(np.eye(4), (n_targets, 1, 1))
    yield _placed(sensor, p, tools)
    tools = tools.copy()
    tools[:, :3, 3] = offsets.reshape(n_targets, 3)
    yield _placed(sensor, p + columns @ offsets, tools)


def from_anchors(
    sensor: AnchoredDistanceSensor, tips: np.ndarray, target: np.ndarray, n_targets: int
) -> Iterator[Extrinsics]:
    """Yield the anchors about which the distances close, each found by itself; the tool where all agree."""
    n = len(sensor.points.names)
    found = [
        list(from_distances(sensor.distance[rows], tips[rows], target[rows], n_targets)) if rows.any() else []
        for rows in (sensor.index == k for k in range(n))
    ]
    for deep in (False, True):
        chosen = [starts[min(int(deep), len(starts) - 1)] if starts else None for starts in found]
        anchors = np.array([np.zeros(3) if start is None else -start.base[:3, 3] for start in chosen])
        tools = np.mean([start.tools for start in chosen if start is not None], axis=0)
        yield _of_places(sensor, anchors, tools)


def from_camera_points(sensor: CameraPointSensor, tips: np.ndarray) -> Iterator[Extrinsics]:
    """Yield the camera's place in the hand in which the points of the object stand still."""
    p, R = tips[:, :, 3], tips[:, :, :3]
    products = np.einsum("nab,nc->nabc", R, sensor.camera_point).reshape(len(p), 3, 9)
    A = np.concatenate([products, R], axis=2)
    W = nearest_rotation(_least_squares(-_centred(A, sensor.index), _centred(p, sensor.index))[:9].reshape(3, 3))
    seen = np.einsum("nab,bc,nc->na", R, W, sensor.camera_point)
    t = _least_squares(-_centred(R, sensor.index), _centred(p + seen, sensor.index))
    yield _placed(sensor, p + seen + R @ t, transform(W, t)[None])


def from_pixels(sensor: CameraPixelSensor, tips: np.ndarray) -> Iterator[Extrinsics]:
    """Yield the best places and focal lengths of the camera: those on a grid, made better one by one."""
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    rows = some_rows(len(sensor), _GRID_ROWS, sensor.groups)
    sample, here, n = sensor.select(rows), tips[rows], len(sensor.points.names)
    lens, focal = _guessed(sensor)

    def missed(x: np.ndarray) -> _Sight:
        turn, scaled = Rotation.from_rotvec(x[:3]).as_matrix(), _scaled(lens, x[3:])
        return _triangulated(sample.index, n, here, _rays(scaled, sample.pixel) @ turn.T, scaled.fx)

    turns = Rotation.create_group("I").as_rotvec()
    grid = [np.append(turn, scale) for scale in focal for turn in turns]
    best = sorted(grid, key=lambda x: missed(x).error)[:_GRID_STARTS]
    found = [least_squares(lambda x: missed(x).image, x, max_nfev=_ROUNDS).x for x in best]
    nominal = np.array([parameter.nominal for parameter in sensor.setup.lens_parameters()])
    for x in sorted(found, key=lambda x: missed(x).error)[:_KEPT]:
        turn, scaled = Rotation.from_rotvec(x[:3]).as_matrix(), _scaled(lens, x[3:])
        sight = _triangulated(sensor.index, n, tips, _rays(scaled, sensor.pixel) @ turn.T, scaled.fx)
        hand = transform(turn, sight.camera)
        yield _of_places(sensor, sight.places, hand[None], scaled.values - nominal)


def _guessed(sensor: CameraPixelSensor) -> tuple[Lens, list[list[float]]]:
    """Return a camera, and the logarithms of the factors on its focal length that are tried (none where it is known)."""
    if sensor.setup.lens is not None:
        return sensor.setup.lens, [[]]
    low, high = sensor.pixel.min(axis=0), sensor.pixel.max(axis=0)
    width = float(np.max(high - low))
    u0, v0 = 0.5 * (low + high)
    return Lens(width, width, float(u0), float(v0)), [[float(np.log(f))] for f in _FOCAL]


def _scaled(lens: Lens, log_factor: np.ndarray) -> Lens:
    factor = float(np.exp(log_factor.sum()))
    return replace(lens, fx=lens.fx * factor, fy=lens.fy * factor)


def _rays(lens: Lens, pixel: np.ndarray) -> np.ndarray:
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
        places: the points in the base frame, shape (K, 3) [m].
    """

    error: float
    image: np.ndarray
    camera: np.ndarray
    places: np.ndarray


def _triangulated(index: np.ndarray, n_points: int, tips: np.ndarray, rays: np.ndarray, focal: float) -> _Sight:
    """Return the camera's place and the points that lie nearest to their lines of sight.

    Args:
        index: shape (N,), the points that are seen.
        n_points: how many there are.
        tips: shape (N, 3, 4).
        rays: shape (N, 3), lines of sight in the tip frame.
        focal: focal length [px].
    """
    R, p = tips[:, :, :3], tips[:, :, 3]
    sight = np.einsum("nab,nb->na", R, rays)
    across = np.eye(3) - sight[:, :, None] * sight[:, None, :]
    push = np.einsum("nab,nb->na", across, p)
    turned = across @ R
    S, b, B = np.zeros((n_points, 3, 3)), np.zeros((n_points, 3)), np.zeros((n_points, 3, 3))
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
    image = focal * missed / np.maximum(depth, _NEAR)[:, None]
    return _Sight(focal * float(np.mean(angle)), image.ravel(), t, places)


def _placed(sensor: PointSensor, ends: np.ndarray, tools: np.ndarray) -> Extrinsics:
    """Return the placement in which each point stands at the mean of its rows' ``ends``, shape (N, 3), in the base frame."""
    n = len(sensor.points.names)
    count = np.bincount(sensor.index, minlength=n).astype(float)
    places = np.stack([np.bincount(sensor.index, weights=column, minlength=n) for column in ends.T], axis=1)
    return _of_places(sensor, places / np.maximum(count, 1.0)[:, None], tools)


def _of_places(sensor: PointSensor, places: np.ndarray, tools: np.ndarray, rest: np.ndarray | None = None) -> Extrinsics:
    """Return the placement of points, shape (K, 3), in the robot's base frame; the known ones say where the base is."""
    points = sensor.points
    seen = points.known & np.isin(np.arange(len(places)), sensor.index)
    base = transform(*align(places[seen], points.given[seen])) if seen.any() else np.eye(4)
    moved = places @ base[:3, :3].T + base[:3, 3]
    own = moved[~points.known].ravel()
    return Extrinsics(base, tools, own if rest is None else np.concatenate([own, rest]))


def _centred(values: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return values, shape (N, 3, ...), with the mean of each point's rows taken off, as equations, shape (3 N, ...)."""
    _, group, count = np.unique(index, return_inverse=True, return_counts=True)
    total = np.zeros((len(count), *values.shape[1:]))
    np.add.at(total, group, values)
    mean = total / count.reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray((values - mean[group]).reshape(3 * len(values), *values.shape[2:]))


def _least_squares(A: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.lstsq(A, y, rcond=RANK)[0])
