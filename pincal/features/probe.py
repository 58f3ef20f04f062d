"""Contacts of a probe with a ball: from the ball's centres to the points where it touched.

The ball touches where the normal of the surface through its centre meets it, a radius away. The
normal is that of the feature fitted to the centres, which is parallel to the one touched. Of a
plane the side is the one away from the arm; of a circle, a cylinder or a sphere a bore is larger
than the feature of the centres by the radius, and a boss smaller: the nominal says which.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pincal.calibration.position_covariance import SharedErrors
from pincal.errors import BadInputError
from pincal.features.feature_fit import FittedFeature
from pincal.features.feature_points import LocatedPoints
from pincal.features.feature_set import FeatureSet
from pincal.features.flange_sensor import FlangeSensor
from pincal.features.mounted_sensor import STATED

PROBE = "probe"
"""Name of the source of uncertainty."""

_ROUND = ("circle", "sphere", "cylinder")


def contacts_of_centres(
    centres: LocatedPoints,
    fitted: FeatureSet,
    radii: Mapping[str, float],
    declared: FlangeSensor,
) -> LocatedPoints:
    """Return where a ball touched, with the uncertainty of its radius; the points themselves if
    there is no ball.

    Args:
        centres: of the ball.
        fitted: the features through them.
        radii: nominal radius of each round feature that has one [m].
        declared: with the radius of the ball.

    Raises:
        BadInputError: for a feature without a normal, or a round one without a nominal radius.
    """
    if not declared.radius:
        return centres
    normals = np.zeros((len(centres), 3))
    for name, fit in fitted.fits.items():
        rows = fitted.rows[name]
        side = _side(name, fit, radii.get(name), declared.radius, centres.select(rows))
        normals[rows] = side * fit.normals[:, 0]
    moved = centres.moved(declared.radius * normals)
    if not declared.radius_sigma:
        return moved
    errors = SharedErrors.of_all(declared.radius_sigma * normals[:, :, None])
    return moved.with_source(PROBE, errors, STATED)


def _side(
    name: str,
    fit: FittedFeature,
    nominal: float | None,
    ball: float,
    centres: LocatedPoints,
) -> float:
    """Return on which side of the feature of the centres the surface is, +1 along the normals."""
    if fit.kind == "plane":
        towards_arm = np.mean((centres.sensor - centres.place) @ fit.direction)
        return -1.0 if towards_arm > 0.0 else 1.0
    if fit.kind not in _ROUND:
        raise BadInputError(
            f"feature {name!r} ({fit.kind}): the radius of a ball can't be taken off, as it has no "
            "normal; expected a plane, circle, cylinder or sphere, or a probe without radius"
        )
    if nominal is None:
        raise BadInputError(
            f"feature {name!r} ({fit.kind}): touched with a ball, but its nominal diameter is not "
            "given, which tells a bore from a boss; add it to the part's file"
        )
    is_bore = abs(fit.radius + ball - nominal) < abs(fit.radius - ball - nominal)
    return 1.0 if is_bore else -1.0
