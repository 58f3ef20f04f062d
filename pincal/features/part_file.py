"""Files of parts, in TOML.

.. code-block:: toml

    unit = "mm"                          # of lengths that name none; a feature may have its own
    angle_unit = "deg"                   # of angles
    points = "nominals.csv"              # columns name, x, y, z and perhaps tolerance, with units

    [feature.hole_1]
    kind = "circle"
    nominal_mm = [120.0, 40.0, 0.0]      # its position; of a distance or an angle its value
    direction = [0, 0, 1]                # or normal, or axis
    diameter_mm = 12.0
    tolerance = { x_mm = 0.3, y_mm = 0.3, diameter_mm = [-0.05, 0.10] }

    [feature.pitch]
    kind = "distance"
    of = ["hole_1", "hole_2"]
    nominal = "80 mm"
    limits_mm = [79.8, 80.3]

    [datum]
    kind = "3-2-1"
    features = ["top", "edge", "hole_1"]

    [expansion]                          # lengths are then stated at 20 deg C
    coefficient_um_per_m_K = 11.5
    u_coefficient_um_per_m_K = 1.0
    temperature_C = 26.0
    u_temperature_K = 0.5

``tolerance`` is the largest deviation, or the least and the largest one, ``limits`` are the least
and the largest value. A plain one is of what ``nominal`` is, coordinate by coordinate; in a table
they are of the quantities that are named (:mod:`pincal.features.part_feature`), of which
``position`` is the diameter of a zone as in ISO 1101, and ``direction`` another name of ``tilt``.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pincal.errors import BadInputError, counted, nearest_first
from pincal.features.part_expansion import PartExpansion
from pincal.features.part_feature import (
    DATUM_KINDS,
    DERIVED_KINDS,
    ONE_SIDED,
    QUANTITIES,
    UNIT_OF,
    PartDatum,
    PartFeature,
    ToleranceLimits,
)
from pincal.io.keyed_table import UNITS_OF, DefaultUnits, KeyedTable, read_toml, require_known
from pincal.thresholds import Count, Scale

# Length of a direction below which it is none.
_NO_DIRECTION: Scale = 1e-9
# Names that a message lists.
_LISTED: Count = 8
_TOP = ("unit", "angle_unit", "points", "name", "feature", "datum", "expansion")
_DIMENSION = {"m": "length", "rad": "angle"}
# Names of a direction: that of a line or an axis, and that of a plane's normal.
_DIRECTIONS = ("direction", "normal", "axis")


class PartContent(NamedTuple):
    """What the file of a part says."""

    features: Mapping[str, PartFeature]
    datum: PartDatum
    expansion: PartExpansion | None = None


def read_part(path: str | os.PathLike[str]) -> PartContent:
    """Read the file of a part, see :class:`pincal.features.part.Part`."""
    path = Path(path)
    content = read_toml(path, "TOML with a table [feature.NAME] for each feature")
    require_known(str(path), content, _TOP)
    return _File(path, content).content_of_part()


class _File:
    """The content of a part's file."""

    def __init__(self, path: Path, content: Mapping[str, Any]) -> None:
        self.path = path
        self.content = content
        self.units = DefaultUnits(
            length=self._unit(content, "unit", "length", str(path)),
            angle=self._unit(content, "angle_unit", "angle", str(path)),
        )
        self.points = self._points()

    def _unit(self, entries: Mapping[str, Any], key: str, dimension: str, where: str) -> str:
        """Return the unit of a dimension that a table names, empty without one."""
        unit = entries.get(key, "")
        if unit != "" and unit not in UNITS_OF[dimension]:
            raise BadInputError(
                f"{where}: {key} = {unit!r}; expected one of {', '.join(UNITS_OF[dimension])}"
            )
        return str(unit)

    def _units_of(self, entries: Mapping[str, Any], where: str) -> DefaultUnits:
        """Return the units of a feature: its own, of a length or an angle, or those of the file."""
        unit = entries.get("unit", "")
        if unit in UNITS_OF["angle"]:
            return replace(self.units, angle=str(unit))
        own = self._unit(entries, "unit", "length", where)
        return replace(self.units, length=own) if own else self.units

    def content_of_part(self) -> PartContent:
        """Return the part, with all names resolved."""
        features = {name: self._feature(name, table) for name, table in self._tables()}
        for name, point in self.points.items():
            features.setdefault(name, point)
        if not features:
            raise BadInputError(
                f"{self.path}: no features; expected a table [feature.NAME] for each, or a table "
                "of points (points = 'FILE.csv')"
            )
        for feature in features.values():
            self._check_links(feature, features)
        return PartContent(features, self._datum(features), self._expansion())

    def _expansion(self) -> PartExpansion | None:
        """Return the expansion of the part; None where its temperature is not given."""
        entries = self.content.get("expansion")
        if entries is None:
            return None
        return PartExpansion.of_table(entries, f"{self.path}, [expansion]")

    def _points(self) -> dict[str, PartFeature]:
        """Return the points of the table of points, by name."""
        given = self.content.get("points")
        if given is None:
            return {}
        if not isinstance(given, str):
            raise BadInputError(
                f"{self.path}: points = {given!r}; expected the name of a file with columns name, "
                "x, y, z"
            )
        found = dict[str, PartFeature]()
        for point in _rows(self.path.parent / given):
            if point.name in found:
                raise BadInputError(
                    f"{self.path.parent / given}: point {point.name!r} occurs twice; expected each "
                    "name once"
                )
            found[point.name] = point
        return found

    def _tables(self) -> Iterator[tuple[str, Mapping[str, Any]]]:
        tables = self.content.get("feature", {})
        if not isinstance(tables, dict):
            raise BadInputError(
                f"{self.path}: feature = {tables!r}; expected tables [feature.NAME]"
            )
        for name, table in tables.items():
            if not isinstance(table, dict) or not name.strip():
                raise BadInputError(
                    f"{self.path}: feature.{name} = {table!r}; expected a table [feature.NAME]"
                )
            yield name, table

    def _feature(self, name: str, entries: Mapping[str, Any]) -> PartFeature:
        where = f"{self.path}, [feature.{name}]"
        units = self._units_of(entries, where)
        given = {key: value for key, value in entries.items() if key == "kind"}
        kind = KeyedTable(where, given, units, {"kind": ""}).text("kind", QUANTITIES)
        table = KeyedTable(where, entries, units, _known_keys(kind))
        point = self.points.get(name)
        if point is not None and kind in (*DERIVED_KINDS, "plane"):
            raise BadInputError(
                f"{where}: a {kind}, but the table of points has a point of this name; expected "
                "another name"
            )
        bare = PartFeature(name, kind, table.names("of"), point.position if point else None)
        placed = _with_nominal(bare, table)
        limits = dict(_limits(placed, table))
        of_point = dict(point.limits) if point and not limits.keys() & set("xyz") else {}
        return replace(placed, limits=of_point | limits)

    def _check_links(self, feature: PartFeature, features: Mapping[str, PartFeature]) -> None:
        """Refuse a distance or an angle of what is not there, or is none itself."""
        where = f"{self.path}, [feature.{feature.name}]"
        if feature.is_derived and len(set(feature.of)) != 2:
            raise BadInputError(
                f"{where}: of = {list(feature.of)}; expected the names of two features"
            )
        for name in feature.of:
            other = features.get(name)
            if other is None:
                near = ", ".join(nearest_first([name], features)[:_LISTED])
                raise BadInputError(f"{where}: of {name!r}, which is no feature; expected {near}")
            if other.is_derived:
                raise BadInputError(
                    f"{where}: of {name!r}, which is {other.kind} itself; expected features that "
                    "are measured"
                )
            if feature.kind == "angle" and other.kind in ("point", "sphere"):
                raise BadInputError(
                    f"{where}: of {name!r}, a {other.kind} without a direction; expected line, "
                    "plane, circle or cylinder"
                )

    def _datum(self, features: Mapping[str, PartFeature]) -> PartDatum:
        entries = self.content.get("datum", {})
        where = f"{self.path}, [datum]"
        if not isinstance(entries, dict):
            raise BadInputError(f"{self.path}: datum = {entries!r}; expected a table [datum]")
        if not entries:
            return PartDatum()
        table = KeyedTable(where, entries, self.units, {"kind": "", "features": ""})
        datum = PartDatum(table.text("kind", DATUM_KINDS), table.names("features"))
        for name in datum.features:
            if name not in features or features[name].is_derived:
                measured = [each for each, of in features.items() if not of.is_derived]
                near = ", ".join(nearest_first([name], measured)[:_LISTED])
                raise BadInputError(
                    f"{where}: {name!r} is no measured feature; expected some of {near}"
                )
        _check_datum(datum, features, where)
        return datum


def _check_datum(datum: PartDatum, features: Mapping[str, PartFeature], where: str) -> None:
    """Refuse features that do not make the datum."""
    n = len(datum.features)
    if datum.kind == "calibrated" and n:
        raise BadInputError(
            f"{where}: features for a calibrated datum, which takes none; leave them out, or "
            "expected kind best fit or 3-2-1"
        )
    if twice := [name for name, times in Counter(datum.features).items() if times > 1]:
        raise BadInputError(f"{where}: {twice[0]!r} occurs twice; expected each feature once")
    if datum.kind == "3-2-1" and n != 3:
        raise BadInputError(
            f"{where}: {counted(n, 'feature')}; expected three: a plane, a line and a point"
        )
    if datum.kind == "best fit" and not n:
        raise BadInputError(f"{where}: no features; expected those whose nominals are fitted")
    for name in datum.features if datum.kind == "best fit" else ():
        if features[name].position is None:
            raise BadInputError(
                f"{where}: {name!r} has no nominal position; expected nominal_mm = [x, y, z] in "
                f"[feature.{name}]"
            )


def _known_keys(kind: str) -> dict[str, str]:
    """Return the keys of a feature, with the dimensions of their values."""
    main = "angle" if kind == "angle" else "length"
    found = {"kind": "", "unit": "", "nominal": main, "tolerance": main, "limits": main}
    if kind in DERIVED_KINDS:
        return {**found, "of": ""}
    found["position"] = "length"
    if "tilt" in QUANTITIES[kind]:
        found |= dict.fromkeys(_DIRECTIONS, "number")
    if "diameter" in QUANTITIES[kind]:
        found |= dict.fromkeys(
            ("diameter", "radius", "diameter_tolerance", "diameter_limits"), "length"
        )
    return found


def _with_nominal(feature: PartFeature, table: KeyedTable) -> PartFeature:
    """Return a feature with its nominal values."""
    if isinstance(table.raw("nominal"), dict):
        known = {
            name: dimension
            for name, dimension in _known_keys(feature.kind).items()
            if name in ("position", *_DIRECTIONS, "diameter", "radius")
        }
        known |= dict.fromkeys("xyz", "length")
        if feature.is_derived:
            known = {feature.kind: table.known["nominal"]}
        inner = table.inner("nominal", known)
        return _with_values(_with_values(feature, inner), table)
    if "nominal" in table:
        is_scalar = not isinstance(table.raw("nominal"), list)
        has_scalar = feature.is_derived or "diameter" in QUANTITIES[feature.kind]
        if is_scalar and has_scalar:
            quantity = feature.kind if feature.is_derived else "diameter"
            feature = replace(feature, nominal={quantity: table.number("nominal")})
        elif feature.is_derived:
            raise table.error("nominal", "a number")
        else:
            feature = _placed(feature, table, "nominal")
    return _with_values(feature, table)


def _placed(feature: PartFeature, table: KeyedTable, *keys: str) -> PartFeature:
    """Return a feature at the nominal position of a key, or of one for each coordinate."""
    for key in keys:
        if feature.position is not None:
            raise table.error(key, "one nominal position, here or in the table of points")
        if key not in table:
            raise table.error(key, "x, y and z of the nominal position")
    counts = (3 // len(keys),)
    return replace(feature, position=np.concatenate([table.numbers(key, counts) for key in keys]))


def _with_values(feature: PartFeature, table: KeyedTable) -> PartFeature:
    """Return a feature with the nominal values that have keys of their own."""
    nominal = dict(feature.nominal)
    if "position" in table:
        feature = _placed(feature, table, "position")
    if any(axis in table for axis in "xyz"):
        feature = _placed(feature, table, *"xyz")
    for name in _DIRECTIONS:
        if name not in table:
            continue
        if feature.direction is not None:
            raise table.error(name, "one nominal direction")
        feature = replace(feature, direction=_unit_vector(table, name))
    if feature.is_derived and feature.kind in table:
        nominal[feature.kind] = table.number(feature.kind)
    for name, factor in (("diameter", 1.0), ("radius", 2.0)):
        if name in table:
            if "diameter" in nominal:
                raise table.error(name, "one nominal diameter or radius")
            nominal["diameter"] = factor * table.number(name)
    for name, value in nominal.items():
        if value < 0.0:
            raise BadInputError(
                f"{table.where}: the nominal {name} is below 0 ({value:g} {UNIT_OF[name]}); "
                "expected 0 or more"
            )
    return replace(feature, nominal=nominal)


def _unit_vector(table: KeyedTable, name: str) -> np.ndarray:
    found = table.numbers(name, (3,))
    size = float(np.linalg.norm(found))
    if size < _NO_DIRECTION:
        raise table.error(name, "three numbers that are not all 0")
    return np.asarray(found / size)


def _limits(feature: PartFeature, table: KeyedTable) -> Iterator[tuple[str, ToleranceLimits]]:
    """Yield the limits of all quantities that have some, each once."""
    found = dict[str, ToleranceLimits]()
    for name in ("tolerance", "limits", "diameter_tolerance", "diameter_limits"):
        for quantity, inner, key in _entries(feature, table, name):
            if quantity in found:
                raise BadInputError(
                    f"{table.where}: {name} of {quantity}, which has limits already; expected one "
                    "tolerance, or one pair of limits"
                )
            is_tolerance = name.endswith("tolerance")
            made = _tolerance if is_tolerance else _bounds
            found[quantity] = made(feature, quantity, inner, key)
    yield from found.items()


def _entries(
    feature: PartFeature, table: KeyedTable, name: str
) -> Iterator[tuple[str, KeyedTable, str]]:
    """Yield the quantities that a tolerance is of, each with the table and the key of its value."""
    if name not in table:
        return
    if not isinstance(table.raw(name), dict):
        for quantity in _main(feature, table, name):
            yield quantity, table, name
        return
    quantities = QUANTITIES[feature.kind]
    known = {each: _DIMENSION[UNIT_OF[each]] for each in quantities}
    if "tilt" in known:
        known["direction"] = "angle"
    inner = table.inner(name, known)
    for key in known:
        if key in inner:
            yield "tilt" if key == "direction" else key, inner, key


def _main(feature: PartFeature, table: KeyedTable, name: str) -> tuple[str, ...]:
    """Return the quantities of a plain tolerance: those of the nominal value."""
    if feature.is_derived:
        return (feature.kind,)
    if name.startswith("diameter"):
        return ("diameter",)
    if feature.kind == "plane":
        return ("offset",)
    if "diameter" in QUANTITIES[feature.kind] and not isinstance(table.raw("nominal"), list):
        if "nominal" not in table and feature.position is not None:
            raise table.error(name, "a table that names what it is of, such as { diameter_mm = 1 }")
        return ("diameter",)
    if name == "limits":
        raise table.error(name, "a table of pairs, such as limits = { x_mm = [9.9, 10.1] }")
    return ("x", "y", "z")


def _tolerance(feature: PartFeature, quantity: str, table: KeyedTable, key: str) -> ToleranceLimits:
    """Return the limits by the largest deviation, or by the least and the largest one."""
    given = table.numbers(key, (1,) if quantity in ONE_SIDED else (1, 2))
    nominal = feature.nominal_of(quantity)
    if nominal is None:
        what = {"tilt": "direction", "offset": "position"}.get(quantity, quantity)
        raise table.error(key, f"limits, or a nominal {what} of the feature beside a tolerance")
    lower = -given[0] if len(given) == 1 else given[0]
    upper = given[-1]
    if upper < lower or (len(given) == 1 and upper <= 0.0):
        raise table.error(key, "more than 0, or the least deviation before the largest")
    if quantity in ONE_SIDED:
        return ToleranceLimits(upper=float(upper))
    return ToleranceLimits(float(nominal + lower), float(nominal + upper))


def _bounds(feature: PartFeature, quantity: str, table: KeyedTable, key: str) -> ToleranceLimits:
    """Return limits as they are given."""
    if quantity in ONE_SIDED:
        return _tolerance(feature, quantity, table, key)
    if quantity == "offset" and feature.position is None:
        raise table.error(key, "a nominal position of the plane beside its limits")
    lower, upper = _pair(table, key)
    return ToleranceLimits(lower, upper)


def _pair(table: KeyedTable, key: str) -> tuple[float, float]:
    given = table.numbers(key, (2,))
    if not given[0] < given[1]:
        raise table.error(key, "the least value before the largest")
    return float(given[0]), float(given[1])


def _rows(path: Path) -> Iterator[PartFeature]:
    """Yield the points of a table, with limits of their coordinates where it has a tolerance."""
    from pincal.measure.reader import read_columns

    quantities = {"name": "name", **dict.fromkeys("xyz", "length"), "tolerance": "length"}
    columns = read_columns(path, quantities, optional=("tolerance",), is_whole=True)
    places = np.column_stack([columns[axis] for axis in "xyz"])
    tolerances = columns.get("tolerance", np.full(len(places), np.nan))
    for name, place, tolerance in zip(columns["name"], places, tolerances, strict=True):
        if tolerance <= 0.0:
            raise BadInputError(
                f"{path}: point {str(name)!r} has the tolerance {1e3 * tolerance:g} mm; expected "
                "more than 0"
            )
        limits = {
            axis: ToleranceLimits(value - tolerance, value + tolerance)
            for axis, value in zip("xyz", place.tolist(), strict=True)
            if np.isfinite(tolerance)
        }
        yield PartFeature(str(name), "point", position=place, limits=limits)
