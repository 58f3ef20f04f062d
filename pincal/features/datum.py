r"""The part's frame from measured features, with its uncertainty.

``calibrated``: the frame of the points, the robot's base or the calibration's instrument.

``best fit``: nominal features are fitted to the measured ones by generalised least squares; of a
point, a circle and a sphere the position counts, of a line and an axis position and direction
across it, of a plane the distance along the normal, and the normal.

``3-2-1``: the first feature, a plane, holds two turns and a shift; the second, a line, an axis, a
plane or the direction from the third to it, a turn and a shift; the third the last shift. All three
are then where their nominals are; without nominals these are the planes and lines z = 0, y = 0 and
x = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from pincal.errors import BadInputError
from pincal.features.best_fit import best_fit_frame, misfit_of
from pincal.features.feature_kinds import OF_DIRECTION, OF_POSITION
from pincal.features.feature_set import FeatureSet
from pincal.features.fit_numbers import FIT
from pincal.features.part import Part
from pincal.features.part_feature import PartFeature
from pincal.features.part_frame import PartFrame, differentiate

_AXIS = ("line", "cylinder")


def frame_of(part: Part, measured: FeatureSet, covariance: np.ndarray) -> PartFrame:
    """Return the frame of a part by its datum.

    Args:
        part: with its datum.
        measured: its features.
        covariance: shape (7F, 7F), of their numbers, which weights a best fit.

    Raises:
        BadInputError: for a datum feature that was not measured, or features that leave the frame
            open.
    """
    n = len(measured.numbers)
    missing = [name for name in part.datum.features if name not in measured.fits]
    if missing:
        raise BadInputError(
            f"datum feature {missing[0]!r} has no readings; expected some of each of "
            f"{', '.join(part.datum.features)}"
        )
    if part.datum.kind == "calibrated":
        return PartFrame.identity(n)
    if part.datum.kind == "best fit":
        return best_fit_frame(part, measured, covariance)
    return _three_two_one(part, measured)


@dataclass(frozen=True)
class _Triple:
    """Plane, line and point of a 3-2-1 datum, by their kinds and the signs of two axes."""

    kinds: tuple[str, str, str]
    names: tuple[str, ...]
    signs: tuple[float, float] = (1.0, 1.0)

    def frame(self, numbers: np.ndarray) -> PartFrame:
        """Return the frame of three features' numbers, shape (21,)."""
        plane, line, point = numbers.reshape(3, 7)
        z = self.signs[0] * plane[OF_DIRECTION] / np.linalg.norm(plane[OF_DIRECTION])
        x = self._along(plane, line, point)
        x = x - z * (z @ x)
        size = float(np.linalg.norm(x))
        if size < FIT.flat:
            raise BadInputError(
                f"datum 3-2-1: {self.names[1]!r} is along the normal of {self.names[0]!r}, and "
                "leaves the turn about it open; expected a direction in the plane"
            )
        x = self.signs[1] * x / size
        y = np.cross(z, x)
        rows = np.array([z, self._across(line, y), self._last(point, x)])
        places = (plane, line, point)
        sides = [row @ of[OF_POSITION] for row, of in zip(rows, places, strict=True)]
        if abs(np.linalg.det(rows)) < FIT.flat:
            raise BadInputError(
                f"datum 3-2-1: {self.names[2]!r} leaves the shift along {self.names[1]!r} open; "
                "expected a point, or a plane across"
            )
        origin = np.linalg.solve(rows, np.array(sides))
        return PartFrame(np.column_stack([x, y, z]), origin, np.zeros((6, 0)))

    def _along(self, plane: np.ndarray, line: np.ndarray, point: np.ndarray) -> np.ndarray:
        """Return the direction of the x axis before it is made level, of about unit length."""
        if self.kinds[1] in _AXIS:
            return line[OF_DIRECTION]
        if self.kinds[1] == "plane":
            return np.cross(line[OF_DIRECTION], plane[OF_DIRECTION])
        between = line[OF_POSITION] - point[OF_POSITION]
        return np.asarray(between / max(float(np.linalg.norm(between)), np.finfo(float).tiny))

    def _across(self, line: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the direction in which the second feature holds the frame."""
        return line[OF_DIRECTION] if self.kinds[1] == "plane" else y

    def _last(self, point: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return the direction in which the third feature holds the frame."""
        return point[OF_DIRECTION] if self.kinds[2] == "plane" else x


def _three_two_one(part: Part, measured: FeatureSet) -> PartFrame:
    """Return the frame that three features hold, with the signs by which nominals fit best."""
    names = part.datum.features
    features = [part.features[name] for name in names]
    kinds = (features[0].kind, features[1].kind, features[2].kind)
    measured_numbers = np.concatenate([measured.fits[name].numbers for name in names])
    nominal = _Triple(kinds, names).frame(_nominal_numbers(features))
    found = []
    for z_sign, x_sign in product((1.0, -1.0), repeat=2):
        triple = _Triple(kinds, names, (z_sign, x_sign))
        frame = _composed(triple.frame(measured_numbers), nominal)
        found.append((misfit_of(part, measured, frame), triple, frame))
    _, triple, frame = min(found, key=lambda each: each[0])
    by_numbers = np.zeros((6, len(measured.numbers)))

    def motion(numbers: np.ndarray) -> np.ndarray:
        return frame.motion_to(_composed(triple.frame(numbers), nominal))

    slopes = differentiate(motion, measured_numbers)
    for i, name in enumerate(names):
        by_numbers[:, measured.at(name)] = slopes[:, 7 * i : 7 * i + 7]
    return PartFrame(frame.rotation, frame.origin, by_numbers)


def _composed(measured: PartFrame, nominal: PartFrame) -> PartFrame:
    """Return the part's frame, in which a measured frame is at a nominal place."""
    rotation = measured.rotation @ nominal.rotation.T
    origin = measured.origin - rotation @ nominal.origin
    return PartFrame(rotation, origin, np.zeros((6, 0)))


def _nominal_numbers(features: Sequence[PartFeature]) -> np.ndarray:
    """Return the nominal numbers of the three features, shape (21,); what has no nominal is at the
    origin, along z, x and x.
    """
    defaults = (np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]))
    found = []
    for feature, direction, place in zip(features, defaults, np.eye(3), strict=True):
        is_second = place[1] == 1.0
        if is_second and feature.kind == "plane":
            direction = place
        origin = np.zeros(3)
        if is_second and feature.kind not in (*_AXIS, "plane"):
            # The direction from the third to the second is that of x.
            third = features[2].position
            origin = np.array([1.0, 0.0, 0.0]) + (np.zeros(3) if third is None else third)
        found += [
            origin if feature.position is None else feature.position,
            direction if feature.direction is None else feature.direction,
            np.zeros(1),
        ]
    return np.concatenate(found)
