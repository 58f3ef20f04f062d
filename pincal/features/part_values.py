r"""What is told of a part: the quantities of its features in its frame, with their sensitivity.

Each value is a smooth function of the numbers of one or two features and of the part's frame; its
derivatives go on to the points. Errors of the datum and those of the features, which come from the
same readings, are hence in the covariance of the values with their correlation:

.. math:: \delta v = \Big(\frac{\partial v}{\partial z} + \frac{\partial v}{\partial \xi}
    \frac{\partial \xi}{\partial z}\Big) A \, \delta x .
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from pincal.features.datum import frame_of
from pincal.features.feature_kinds import OF_DIRECTION, OF_POSITION, OF_RADIUS, across
from pincal.features.feature_set import FeatureSet, plus_own_errors
from pincal.features.fit_numbers import FIT
from pincal.features.part import Part
from pincal.features.part_feature import QUANTITIES, PartFeature, ToleranceLimits
from pincal.features.part_frame import PartFrame, differentiate
from pincal.thresholds import Scale

# Length below which a deviation has no direction of its own [m, 1].
_NO_DIRECTION: Scale = 1e-12
_SPATIAL = ("x", "y", "z")
_ALONG = ("i", "j", "k")
_AXIS = ("line", "cylinder")

# A quantity by the numbers of its features in the part's frame, shape (1 or 2, 7).
_Quantity = Callable[[np.ndarray], float]


@dataclass(frozen=True, eq=False)
class PartValue:
    """A quantity of a feature.

    Attributes:
        feature: its name.
        quantity: of ``pincal.features.part_feature.QUANTITIES``, or i, j, k of a direction.
        value: in SI units.
        nominal: None if there is none.
        limits: None without a tolerance.
    """

    feature: str
    quantity: str
    value: float
    nominal: float | None = None
    limits: ToleranceLimits | None = None

    @property
    def deviation(self) -> float | None:
        """Value minus nominal, None without a nominal value."""
        return None if self.nominal is None else self.value - self.nominal


@dataclass(frozen=True, eq=False)
class PartValues:
    """All quantities of a part, Q of them.

    Attributes:
        values: the quantities.
        sensitivity: shape (Q, 3N), motion of the values by errors of the points. A source of
            errors with covariance C_s contributes sensitivity C_s sensitivity^T.
        frame: the part's frame.
        features: the features in the frame of the points.
    """

    values: tuple[PartValue, ...]
    sensitivity: np.ndarray
    frame: PartFrame
    features: FeatureSet

    def covariance(self, covariance: np.ndarray) -> np.ndarray:
        """Return the covariance of the values, shape (Q, Q), by that of the points, shape
        (3N, 3N) [m^2], and by deviations of the features from their form.
        """
        total = plus_own_errors(covariance, self.features.form_blocks)
        return np.asarray(self.sensitivity @ total @ self.sensitivity.T)

    def index(self, feature: str, quantity: str) -> int:
        """Return where a quantity is among the values."""
        names = [(value.feature, value.quantity) for value in self.values]
        return names.index((feature, quantity))


def evaluate_part(part: Part, measured: FeatureSet, covariance: np.ndarray) -> PartValues:
    """Return what is told of a part.

    Args:
        part: its nominals, tolerances and datum.
        measured: its features that were measured; distances and angles of others are left out.
        covariance: shape (3N, 3N), of the points [m^2], which weights a best fit of the datum.

    Raises:
        BadInputError: for features that do not make the datum.
        IdentificationError: if the fit of the datum does not converge.
    """
    by_points = measured.sensitivity
    total = plus_own_errors(covariance, measured.form_blocks)
    frame = frame_of(part, measured, by_points @ total @ by_points.T)
    values = []
    rows = []
    for feature in part.features.values():
        names = feature.of if feature.is_derived else (feature.name,)
        if any(name not in measured.fits for name in names):
            continue
        functions = dict(_functions(part, feature, measured, frame))
        found, slopes = _linearised(tuple(functions.values()), names, measured, frame)
        rows.append(slopes @ by_points)
        for quantity, value in zip(functions, found.tolist(), strict=True):
            values.append(
                PartValue(
                    feature=feature.name,
                    quantity=quantity,
                    value=value,
                    nominal=_nominal(feature, quantity),
                    limits=feature.limits.get(quantity),
                )
            )
    sensitivity = np.vstack([np.zeros((0, by_points.shape[1])), *rows])
    return PartValues(tuple(values), sensitivity, frame, measured)


def _nominal(feature: PartFeature, quantity: str) -> float | None:
    if quantity in _ALONG:
        direction = feature.direction
        return None if direction is None else float(direction[_ALONG.index(quantity)])
    return feature.nominal_of(quantity)


def _linearised(
    functions: tuple[_Quantity, ...], names: tuple[str, ...], measured: FeatureSet, frame: PartFrame
) -> tuple[np.ndarray, np.ndarray]:
    """Return quantities of some features, shape (m,), and their derivatives by the numbers of all
    features, shape (m, 7F).
    """
    numbers = np.concatenate([measured.fits[name].numbers for name in names])

    def at(moves: np.ndarray) -> np.ndarray:
        there = frame.moved(moves[:6])
        seen = np.array([there.see(of) for of in (numbers + moves[6:]).reshape(-1, 7)])
        return np.array([function(seen) for function in functions])

    still = np.zeros(6 + len(numbers))
    slopes = differentiate(at, still)
    found = slopes[:, :6] @ frame.by_numbers
    for i, name in enumerate(names):
        found[:, measured.at(name)] += slopes[:, 6 + 7 * i : 13 + 7 * i]
    return at(still), found


def _functions(
    part: Part, feature: PartFeature, measured: FeatureSet, frame: PartFrame
) -> Iterator[tuple[str, _Quantity]]:
    """Yield the quantities that a feature has, with the functions that give them."""
    if feature.is_derived:
        pair = _Pair.of(part, feature, measured, frame)
        yield feature.kind, pair.distance if feature.kind == "distance" else pair.angle
        return
    single = _Single.of(feature, frame.see(measured.fits[feature.name].numbers))
    for quantity in QUANTITIES[feature.kind]:
        if quantity in _SPATIAL:
            yield quantity, single.coordinate(_SPATIAL.index(quantity))
        elif quantity == "diameter":
            yield quantity, single.diameter
        elif quantity == "offset":
            yield quantity, single.offset
        elif quantity == "position" and feature.position is not None:
            yield quantity, single.zone
        elif quantity == "tilt" and feature.direction is not None:
            yield quantity, single.tilt
    if "i" in measured.fits[feature.name].names:
        for i, quantity in enumerate(_ALONG):
            yield quantity, single.along(i)


@dataclass(frozen=True, eq=False)
class _Single:
    """The quantities of one feature, near the place where it was measured.

    A deviation that is 0 at best, as the size of a vector, is taken along the direction that the
    vector has there: its uncertainty is that of this component.

    Attributes:
        kind: of the feature.
        position: nominal one, or the origin [m].
        direction: nominal one, or the measured one.
        sign: of the measured direction, by which it is like the nominal one.
        off: unit vector of the deviation of the position.
        turned: unit vector of the deviation of the direction.
    """

    kind: str
    position: np.ndarray
    direction: np.ndarray
    is_placed: bool
    sign: float
    off: np.ndarray
    turned: np.ndarray

    @classmethod
    def of(cls, feature: PartFeature, seen: np.ndarray) -> _Single:
        """Return the quantities of a feature with these numbers in the part's frame."""
        direction = seen[OF_DIRECTION]
        main = direction[np.argmax(np.abs(direction))]
        along = direction * (1.0 if main >= 0.0 else -1.0)
        nominal = along if feature.direction is None else feature.direction
        sign = 1.0 if direction @ nominal >= 0.0 else -1.0
        bare = cls(
            kind=feature.kind,
            position=np.zeros(3) if feature.position is None else feature.position,
            direction=nominal,
            is_placed=feature.position is not None,
            sign=sign,
            off=np.zeros(3),
            turned=np.zeros(3),
        )
        turned = sign * direction - nominal * (sign * direction @ nominal)
        return replace(bare, off=_unit(bare._beside(seen), nominal), turned=_unit(turned, nominal))

    def _place(self, seen: np.ndarray) -> np.ndarray:
        """Return the position; of a line or an axis the point nearest to the nominal position."""
        if self.kind not in _AXIS or not self.is_placed:
            return np.asarray(seen[OF_POSITION])
        direction = seen[OF_DIRECTION]
        off = self.position - seen[OF_POSITION]
        return np.asarray(seen[OF_POSITION] + direction * (direction @ off))

    def _beside(self, seen: np.ndarray) -> np.ndarray:
        """Return the deviation of the position: of what has an axis, across the nominal one."""
        off = self._place(seen) - self.position
        if self.kind in ("point", "sphere"):
            return np.asarray(off)
        return np.asarray(off - self.direction * (self.direction @ off))

    def coordinate(self, axis: int) -> _Quantity:
        """Return the function that gives x, y or z [m]."""
        return lambda seen: float(self._place(seen[0])[axis])

    def along(self, axis: int) -> _Quantity:
        """Return the function that gives i, j or k."""
        return lambda seen: float(self.sign * seen[0, OF_DIRECTION][axis])

    def diameter(self, seen: np.ndarray) -> float:
        """Return the diameter [m]."""
        return float(2.0 * seen[0, OF_RADIUS][0])

    def offset(self, seen: np.ndarray) -> float:
        """Return the distance of a plane from the nominal position along the nominal normal [m]."""
        direction = seen[0, OF_DIRECTION]
        off = direction @ (seen[0, OF_POSITION] - self.position)
        cosine = direction @ self.direction
        least = FIT.flat * self.sign
        return float(off / (cosine if abs(cosine) > FIT.flat else least))

    def zone(self, seen: np.ndarray) -> float:
        """Return twice the deviation of the position [m]."""
        return float(2.0 * self.off @ self._beside(seen[0]))

    def tilt(self, seen: np.ndarray) -> float:
        """Return the angle to the nominal direction [rad]."""
        direction = self.sign * seen[0, OF_DIRECTION]
        return float(np.arctan2(self.turned @ direction, self.direction @ direction))


def _unit(vector: np.ndarray, across_what: np.ndarray) -> np.ndarray:
    """Return the direction of a vector; of none, one across another."""
    size = float(np.linalg.norm(vector))
    if size > _NO_DIRECTION:
        return np.asarray(vector / size)
    if not np.any(across_what):
        return np.array([1.0, 0.0, 0.0])
    return np.asarray(across(across_what)[:, 0])


@dataclass(frozen=True, eq=False)
class _Pair:
    """Distance or angle of two features near the place where they were measured.

    Attributes:
        kinds: of the two.
        is_parallel: whether two axes are, so that their distance is that of places beside each
            other.
        sign: of the second direction, by which the angle is the one meant.
        normal: unit vector about which the second direction is turned from the first.
    """

    kinds: tuple[str, str]
    is_parallel: bool
    sign: float
    normal: np.ndarray

    @classmethod
    def of(cls, part: Part, feature: PartFeature, measured: FeatureSet, frame: PartFrame) -> _Pair:
        """Return the pair of a derived feature."""
        first, second = (frame.see(measured.fits[name].numbers) for name in feature.of)
        a = first[OF_DIRECTION]
        b = second[OF_DIRECTION]
        sine = float(np.linalg.norm(np.cross(a, b)))
        kinds = (part.features[feature.of[0]].kind, part.features[feature.of[1]].kind)
        sign = 1.0 if a @ b >= 0.0 else -1.0
        pair = cls(kinds, sine < FIT.parallel, sign, _unit(np.cross(a, sign * b), a))
        nominal = feature.nominal.get("angle", 0.0)
        acute = pair.angle(np.array([first, second]))
        is_obtuse = abs(np.pi - acute - nominal) < abs(acute - nominal)
        if not is_obtuse or pair._has_one_plane:
            return pair
        return cls(kinds, pair.is_parallel, -sign, _unit(np.cross(a, -sign * b), a))

    @property
    def _has_one_plane(self) -> bool:
        """Whether the angle is that of a line or an axis, as of a hole, to a plane: the complement
        of that to its normal.
        """
        return self.kinds.count("plane") == 1

    def angle(self, seen: np.ndarray) -> float:
        """Return the angle between the features [rad]."""
        first, second = seen[:, OF_DIRECTION]
        second = self.sign * second
        turn = float(np.arctan2(self.normal @ np.cross(first, second), first @ second))
        return np.pi / 2.0 - turn if self._has_one_plane else turn

    def distance(self, seen: np.ndarray) -> float:
        """Return the distance of the features [m]."""
        first, second = seen
        off = second[OF_POSITION] - first[OF_POSITION]
        if "plane" in self.kinds:
            plane = first if self.kinds[0] == "plane" else second
            return abs(float(plane[OF_DIRECTION] @ off))
        axes = [
            of[OF_DIRECTION] for of, kind in zip(seen, self.kinds, strict=True) if kind in _AXIS
        ]
        if len(axes) == 2 and not self.is_parallel:
            normal = np.cross(axes[0], axes[1])
            return abs(float(normal @ off)) / float(np.linalg.norm(normal))
        if axes:
            off = off - axes[0] * (axes[0] @ off)
        return float(np.linalg.norm(off))
