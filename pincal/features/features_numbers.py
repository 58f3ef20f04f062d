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


FEATURES = FeatureNumbers()
