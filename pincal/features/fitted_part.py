"""The features of a part, fitted to located points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pincal.calibration.position_covariance import SharedErrors
from pincal.errors import BadInputError
from pincal.features.feature_points import LocatedPoints
from pincal.features.feature_set import FeatureSet
from pincal.features.flange_sensor import FlangeSensor
from pincal.features.mounted_sensor import SourceEvidence
from pincal.features.part import Part
from pincal.features.part_values import PartValues, evaluate_part
from pincal.features.probe import contacts_of_centres
from pincal.thresholds import Count

FORM = "form"
"""Source of uncertainty: what surfaces deviate from their form beyond the errors of the points."""

# Points of one part: their covariance with each other takes 300 MB.
_MOST: Count = 2000


@dataclass(frozen=True, eq=False)
class FittedPart:
    """Features through located points.

    Attributes:
        part: what was measured.
        points: of the features; with a probe, where it touched. Form is a source among others.
        fitted: the features through them.
        covariance: shape (3K, 3K), of the points without form [m^2].
    """

    part: Part
    points: LocatedPoints
    fitted: FeatureSet
    covariance: np.ndarray

    @classmethod
    def of(cls, part: Part, centres: LocatedPoints, declared: FlangeSensor) -> FittedPart:
        """Return the features through points, or through the contacts of a ball with these centres.

        Raises:
            BadInputError: for points that do not determine their feature, a ball's contacts with
                one that has no normal, or too many points.
            IdentificationError: if a fit does not converge.
        """
        if len(centres) > _MOST:
            raise BadInputError(
                f"{len(centres)} points of the part; expected at most {_MOST}, whose errors are "
                "correlated: take every n-th of a scan"
            )
        covariance = centres.covariance.matrix
        fitted = _fit(part, centres, covariance)
        points = centres
        if declared.radius:
            points = contacts_of_centres(centres, fitted, _radii(part), declared)
            covariance = points.covariance.matrix
            fitted = _fit(part, points, covariance)
        if fitted.form_dof:
            rests_on = SourceEvidence("A", float(fitted.form_dof))
            points = points.with_source(FORM, SharedErrors.of_each(fitted.form_blocks), rests_on)
        return cls(part, points, fitted, covariance)

    def evaluated(self) -> PartValues:
        """Return the quantities of the features in the part's frame.

        Raises:
            BadInputError: for features that do not make the datum.
            IdentificationError: if the fit of the datum does not converge.
        """
        return evaluate_part(self.part, self.fitted, self.covariance)


def _fit(part: Part, points: LocatedPoints, covariance: np.ndarray) -> FeatureSet:
    return FeatureSet.fit(part.kinds, points.feature, points.place, covariance)


def _radii(part: Part) -> dict[str, float]:
    """Return the nominal radii of the round features that have one [m]."""
    nominal = {name: of.nominal_of("diameter") for name, of in part.features.items()}
    return {name: 0.5 * size for name, size in nominal.items() if size is not None}
