"""Features of a part as they should be: their nominal values, their tolerances, and the datum.

Nominal values are in the part's frame. What is told of a feature depends on its kind:

=========== ==================================================================================
quantity    meaning
=========== ==================================================================================
x y z       position [m]: of a line or an axis the point nearest to the nominal position
diameter    [m]
offset      of a plane: along the nominal normal at the nominal position [m]
tilt        angle between direction and nominal direction, 0 to pi/2 [rad]
position    diameter of the smallest zone about the nominal that holds the feature (ISO 1101) [m]
distance    between two features [m]
angle       between two features, 0 to pi/2, or to pi where the nominal angle is obtuse [rad]
i j k       direction, its sign that of the nominal one; told, and never tolerated
=========== ==================================================================================
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

DERIVED_KINDS = ("distance", "angle")
"""Kinds of features that are made of two others."""

DATUM_KINDS = ("calibrated", "best fit", "3-2-1")
"""How the part's frame is found."""

_SPATIAL = ("x", "y", "z")

QUANTITIES: Mapping[str, tuple[str, ...]] = {
    "point": (*_SPATIAL, "position"),
    "line": (*_SPATIAL, "position", "tilt"),
    "plane": ("offset", "tilt"),
    "circle": (*_SPATIAL, "position", "tilt", "diameter"),
    "sphere": (*_SPATIAL, "position", "diameter"),
    "cylinder": (*_SPATIAL, "position", "tilt", "diameter"),
    "distance": ("distance",),
    "angle": ("angle",),
}
"""What may be told and tolerated of a feature, by its kind."""

UNIT_OF: Mapping[str, str] = {
    **dict.fromkeys((*_SPATIAL, "position", "offset", "diameter", "distance"), "m"),
    **dict.fromkeys(("tilt", "angle"), "rad"),
    **dict.fromkeys(("i", "j", "k"), "1"),
}
"""SI units of the quantities."""

ONE_SIDED = ("position", "tilt")
"""Quantities that are 0 at best, and have an upper limit only."""


@dataclass(frozen=True)
class ToleranceLimits:
    """Limits of a quantity, both of which are allowed values; infinite where there is none."""

    lower: float = -math.inf
    upper: float = math.inf


@dataclass(frozen=True, eq=False)
class PartFeature:
    """A feature as it should be.

    Attributes:
        name: of the feature.
        kind: of ``QUANTITIES``.
        of: the two features that a distance or an angle is of.
        position: nominal one, shape (3,) [m]; None if there is none.
        direction: nominal unit direction, shape (3,).
        nominal: nominal values of the quantities diameter [m], distance [m] or angle [rad].
        limits: of the quantities that have a tolerance.
    """

    name: str
    kind: str
    of: tuple[str, ...] = ()
    position: np.ndarray | None = None
    direction: np.ndarray | None = None
    nominal: Mapping[str, float] = field(default_factory=dict)
    limits: Mapping[str, ToleranceLimits] = field(default_factory=dict)

    @property
    def is_derived(self) -> bool:
        """Whether it is made of two others."""
        return self.kind in DERIVED_KINDS

    def nominal_of(self, quantity: str) -> float | None:
        """Return the nominal value of a quantity in SI units, None if there is none."""
        if quantity in _SPATIAL and self.position is not None:
            return float(self.position[_SPATIAL.index(quantity)])
        is_placed = self.position is not None
        if quantity == "position" or quantity == "offset":
            return 0.0 if is_placed else None
        if quantity == "tilt":
            return 0.0 if self.direction is not None else None
        return self.nominal.get(quantity)


@dataclass(frozen=True)
class PartDatum:
    """How the part's frame is found.

    Attributes:
        kind: "calibrated": it is the frame of the points; "best fit": the nominal positions and
            directions of some features are fitted to them; "3-2-1": the first feature gives the
            z axis, the second the x axis, the third the origin, see
            :mod:`pincal.features.datum`.
        features: their names.
    """

    kind: str = "calibrated"
    features: tuple[str, ...] = ()
