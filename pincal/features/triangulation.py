r"""Points from their images in several poses of a calibrated camera on the flange.

The point X of some images is where their squared deviations are least. With the pose (R_i, t_i) of
the camera, the image pi(R_i^T (X - t_i)) and its derivative B_i by X, errors d_i of what the arm
carries at X, errors e_i of the images and the derivative L_i of the images by the camera's
parameters, with errors l,

.. math:: \delta X = \Big(\sum_i B_i^T B_i\Big)^{-1} \sum_i B_i^T (B_i d_i + e_i - L_i l) .
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pincal.calibration.position_covariance import PositionCovariance, SharedErrors
from pincal.errors import BadInputError, few
from pincal.features.feature_points import LocatedPoints
from pincal.features.features_numbers import FEATURES
from pincal.features.mounted_sensor import MountedSensor
from pincal.parameters import thin_root_of
from pincal.sensors.lens import DISTORTION, PINHOLE, slopes
from pincal.thresholds import Count, Scale

# Steps of the search of a point; the first guess is within millimetres.
_STEPS: Count = 20
# Step below which a point stands still [m].
_STILL: Scale = 1e-10
# Lines of rows that a message lists.
_LISTED: Count = 5


@dataclass(frozen=True, eq=False)
class _Intersection:
    """A point and the images of it.

    Attributes:
        rows: shape (m,), indices of the images.
        place: shape (3,) [m].
        seen: shape (m, 3), the point in the frames of the camera [m].
        by_arm: shape (m, 3, 3), motion of the point by the errors of the arm at each image.
        by_image: shape (m, 3, 2), by the errors of the images [m/px].
        by_lens: shape (3, 9), by errors of the camera's parameters.
    """

    rows: np.ndarray
    place: np.ndarray
    seen: np.ndarray
    by_arm: np.ndarray
    by_image: np.ndarray
    by_lens: np.ndarray


def points_of_images(mounted: MountedSensor) -> LocatedPoints:
    """Return the points that were seen in the images of two or more stops.

    Raises:
        BadInputError: for a point that fewer stops saw, whose lines of sight are all but parallel,
            or which is behind the camera; or where camera or noise are not known.
    """
    readings = mounted.readings
    names = np.column_stack([readings.feature, readings.point, readings.passes.astype(str)])
    _, first, number = np.unique(names, axis=0, return_index=True, return_inverse=True)
    groups = [np.flatnonzero(number.ravel() == i) for i in np.argsort(first)]
    found = [_intersection(mounted, rows) for rows in groups]
    heads = np.array([rows[0] for rows in groups], int)
    covariance = _covariance(mounted, found)
    evidence = dict(mounted.arm_evidence(covariance.sources))
    located = LocatedPoints(
        feature=readings.feature[heads],
        place=np.array([of.place for of in found]),
        covariance=covariance,
        evidence=evidence,
        passes=readings.passes[heads],
        sensor=np.array([mounted.tips[rows].mean(axis=0) for rows in groups]),
        readings=np.array([len(rows) for rows in groups]),
        stops=tuple(frozenset(readings.stop[rows].tolist()) for rows in groups),
    )
    sigma, rest = mounted.pixel_noise
    blocks = np.array([np.einsum("nap,nbp->ab", of.by_image, of.by_image) for of in found])
    return located.with_source("sensor", SharedErrors.of_each(sigma**2 * blocks), rest)


def _intersection(mounted: MountedSensor, rows: np.ndarray) -> _Intersection:
    """Return the point of some images, with what moves it."""
    readings = mounted.readings
    assert readings.seen is not None
    lens = mounted.lens
    poses = mounted.poses[rows]
    pixels = readings.seen[rows]
    where = _named(mounted, rows)
    if len(np.unique(readings.stop[rows])) < 2:
        raise BadInputError(
            f"{where}: seen in one stop of the robot; expected images from two or more, as one "
            "image does not tell the distance"
        )
    place = _nearest(poses, slopes(lens, pixels), where)
    turn = poses[:, :, :3]
    for _ in range(_STEPS):
        seen = np.einsum("nij,ni->nj", turn, place - poses[:, :, 3])
        image, by_seen, by_lens = lens.linearise(seen)
        by_place = by_seen @ turn.swapaxes(1, 2)
        inverse = np.linalg.inv(np.einsum("npa,npb->ab", by_place, by_place))
        step = inverse @ np.einsum("npa,np->a", by_place, pixels - image)
        place = place + step
        if np.linalg.norm(step) < _STILL:
            break
    if np.any(seen[:, 2] <= 0.0):
        raise BadInputError(
            f"{where}: its lines of sight intersect behind the camera; expected images of one point"
        )
    by_image = inverse @ by_place.swapaxes(1, 2)
    return _Intersection(
        rows=rows,
        place=place,
        seen=seen,
        by_arm=by_image @ by_place,
        by_image=by_image,
        by_lens=-np.einsum("nap,npl->al", by_image, by_lens),
    )


def _named(mounted: MountedSensor, rows: np.ndarray) -> str:
    """Return where the images of a point are, for a message."""
    readings = mounted.readings
    point = str(readings.point[rows[0]])
    feature = str(readings.feature[rows[0]])
    lines = few(readings.rows.rows[rows], _LISTED)
    of_point = f", point {point!r}" if point else ""
    if readings.pass_name is not None:
        of_point += f", pass {str(readings.pass_name[rows[0]])!r}"
    return f"{readings.rows.source}, line {lines}: feature {feature!r}{of_point}"


def _nearest(poses: np.ndarray, directions: np.ndarray, where: str) -> np.ndarray:
    """Return the point that is nearest to some lines of sight, shape (3,).

    Args:
        poses: shape (m, 3, 4), of the camera.
        directions: shape (m, 2), x/z and y/z of each line in its frame.
        where: for a message.
    """
    rays = np.column_stack([directions, np.ones(len(directions))])
    rays = np.einsum("nij,nj->ni", poses[:, :, :3], rays)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    sizes, axes = np.linalg.eigh(across.mean(axis=0))
    # Of two lines with an angle a between them the least size is sin(a/2)^2.
    angle = 2.0 * np.arcsin(np.sqrt(np.clip(sizes[0], 0.0, 1.0)))
    if angle < FEATURES.parallax:
        raise BadInputError(
            f"{where}: its lines of sight are within {np.rad2deg(angle):.2g} deg; expected "
            f"directions that differ by {np.rad2deg(FEATURES.parallax):.2g} deg or more"
        )
    pushed = np.einsum("nij,nj->i", across, poses[:, :, 3]) / len(poses)
    return np.asarray(axes @ ((axes.T @ pushed) / sizes))


def _covariance(mounted: MountedSensor, found: list[_Intersection]) -> PositionCovariance:
    """Return the covariance of intersections by the arm, its mount and the camera."""
    n = len(mounted.readings)
    maps = np.zeros((len(found), 3, n, 3))
    seen = np.zeros((n, 3))
    for k, of in enumerate(found):
        maps[k][:, of.rows] = of.by_arm.swapaxes(0, 1)
        seen[of.rows] = of.seen
    errors = mounted.arm_errors(seen)
    sources = {name: mapped_errors(of, maps) for name, of in errors.sources.items()}
    by_lens = np.array([of.by_lens for of in found])
    if mounted.declared.lens is None:
        sources["parameters"] = _with_camera(mounted, seen, maps, by_lens)
    return PositionCovariance(sources)


def mapped_errors(errors: SharedErrors, maps: np.ndarray) -> SharedErrors:
    """Return the errors of linear functions of positions, shape (K, 3, N, 3), one point each.

    What a group of positions shares then moves several points, each in its own way: it counts as
    common to all.
    """
    common = np.einsum("kanb,nbr->kar", maps, errors.common, optimize=True)
    each = np.einsum("kanb,nbm->kanm", maps, errors.grouped, optimize=True)
    groups = int(errors.group.max(initial=-1)) + 1
    summed = np.zeros((groups, *each.shape[:2], each.shape[3]))
    np.add.at(summed, errors.group, np.moveaxis(each, 2, 0))
    flat = np.moveaxis(summed, 0, 2).reshape(*each.shape[:2], -1)
    columns = np.concatenate([common, flat], axis=2)
    return SharedErrors.of_all(columns[:, :, np.any(columns, axis=(0, 1))])


def _with_camera(
    mounted: MountedSensor, seen: np.ndarray, maps: np.ndarray, by_lens: np.ndarray
) -> SharedErrors:
    """Return the errors by the parameters of a calibration that knows the camera, whose errors are
    correlated with those of the arm.
    """
    robot = mounted.carrier
    whole = mounted.fitted.estimate
    conditions = robot.of_its_day(mounted.conditions)
    poses, J = robot.model.linearise(robot.model_values, conditions, rows=6)
    levers = np.einsum("nij,nj->ni", poses[:, :, :3], mounted.on_carrier(seen))
    moved = J[:, :3] + np.cross(J[:, 3:], levers[:, :, None], axis=1)
    camera = [f"camera.{name}" for name in (*PINHOLE, *DISTORTION)]
    names = (*robot.model.names, *(name for name in camera if name in whole.names))
    is_known = np.array([name in whole.names for name in camera], bool)
    by_arm = np.einsum("kanb,nbp->kap", maps, moved, optimize=True)
    columns = np.concatenate([by_arm, by_lens[:, :, is_known]], axis=2)
    return SharedErrors.of_all(columns @ thin_root_of(whole.take(names).dense_covariance()))
