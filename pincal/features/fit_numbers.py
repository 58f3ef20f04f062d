"""The numbers by which points are refused as a feature, and a feature's form is told from noise."""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number

_DEGENERATE = "test_feature_fit.py::test_degenerate_points_are_refused"


@dataclass(frozen=True, kw_only=True)
class FitNumbers:
    """When points determine a feature, and when they deviate from it by more than their errors."""

    flat: float = number(
        1e-3,
        "ratio",
        _DEGENERATE,
        "of the least principal extent that a feature needs of its points to the largest one, "
        "below which they are refused",
        "a micrometre of noise on 100 mm is ten parts in a million, and a line turned by this "
        "ratio is all that tells the feature",
    )
    unsure: float = number(
        0.3,
        "rad, ratio",
        "test_feature_fit.py::test_points_that_leave_a_feature_open_are_refused",
        "standard uncertainty of a direction, or of a radius relative to the radius, above which "
        "the points do not determine the feature",
        "linear propagation of errors is off by about a tenth there",
    )
    parallel: float = number(
        0.1,
        "ratio",
        "test_part_values.py::test_distances_are_the_known_ones",
        "sine of the angle of two axes below which they count as parallel, so that their distance "
        "is that of places beside each other",
        "holes of one drilling direction are within milliradians, the axes of a gear pair that "
        "crosses are not",
    )
    form: float = number(
        0.2,
        "probability",
        "test_feature_fit.py::test_form_is_counted_where_the_noise_does_not_explain_it",
        "of larger residuals by the errors of the points alone, below which the surface is said to "
        "deviate from its form",
        "with deviations as large as the noise, 95 % intervals of a plane of 12 points hold 89.5 % "
        "at a level of 0.05 and 91.5 % at 0.2; without any they are 1.09 times as wide as needed",
    )


FIT = FitNumbers()
