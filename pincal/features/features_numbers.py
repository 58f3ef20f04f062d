"""The numbers by which readings of a part are refused."""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number


@dataclass(frozen=True, kw_only=True)
class FeatureNumbers:
    """Thresholds of what a robot reads of a part."""

    parallax: float = number(
        0.01745,
        "rad",
        "test_features_reading.py::test_images_that_cannot_tell_the_depth_are_refused",
        "between the lines of sight of a point, below which its distance is not told",
        "at a degree the depth is sixty times less certain than the rest",
    )
    farthest: float = number(
        20.0,
        "m",
        "test_features_reading.py::test_tables_that_cannot_be_right_are_refused",
        "median distance of what a sensor on the flange reads, above which its unit is wrong",
        "chosen: beyond the sight of sensors on flanges, of which few see 5 m; numbers in mm are "
        "above it from 20 mm",
    )


FEATURES = FeatureNumbers()
