"""Files in TOML, and their tables with units in keys or values: ``size_mm = 20``,
``size = "2 cm"``.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pincal.errors import BadInputError, nearest_first
from pincal.thresholds import Count
from pincal.units import LARGEST, SIZES, plain_number

UNITS_OF = {
    "length": ("m", "mm", "um", "cm", "in"),
    "angle": ("rad", "mrad", "urad", "deg"),
    "number": (),
}
"""Units of values by dimension; the SI unit is the first."""

# The unit that messages suggest.
_USUAL = {"length": "mm", "angle": "deg"}
# Keys that a message lists.
_LISTED: Count = 12


def read_toml(path: str | os.PathLike[str], expected: str) -> dict[str, Any]:
    """Return the content of a file.

    Args:
        path: the file.
        expected: what it should be, for the message.

    Raises:
        BadInputError: if it can't be read or is no TOML.
    """
    try:
        # Windows' editors begin a file with a byte order mark.
        content = tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        # ValueError: no UTF-8, no TOML, or an integer of thousands of digits.
        raise BadInputError(f"{path}: can't be read ({error}); expected {expected}") from None
    for key, value in content.items():
        _require_no_nul(f"{path}: {key}", value)
    return content


def _require_no_nul(where: str, value: Any) -> None:
    """Refuse text with the character NUL, which no name of a file or of a joint has.

    Raises:
        BadInputError: with its place.
    """
    if isinstance(value, dict):
        for key, each in value.items():
            _require_no_nul(f"{where}.{key}", each)
    elif isinstance(value, list):
        for each in value:
            _require_no_nul(where, each)
    elif isinstance(value, str) and "\0" in value:
        raise BadInputError(f"{where} = {value!r}; expected text without the character NUL")


def require_known(where: str, keys: Iterable[str], known: Iterable[str]) -> None:
    """Refuse keys that are not known.

    Raises:
        BadInputError: with the place, the key and the nearest that are known.
    """
    known = tuple(known)
    for key in keys:
        if key not in known:
            near = ", ".join(nearest_first([key], known)[:_LISTED])
            raise BadInputError(f"{where}: unknown key {key!r}; expected one of {near}")


@dataclass(frozen=True)
class DefaultUnits:
    """Units of values that name none; empty where they have to name one."""

    length: str = ""
    angle: str = ""

    def of(self, dimension: str) -> str:
        """Return the unit of a dimension."""
        return {"length": self.length, "angle": self.angle}.get(dimension, "")


@dataclass(frozen=True)
class KeyedTable:
    """A table of a TOML file, from which values are taken by their names without units.

    Attributes:
        where: file and name of the table, for messages.
        entries: its content.
        units: of values that name none.
        known: names that it may have, each with its dimension; "" for a value without a unit.
    """

    where: str
    entries: Mapping[str, Any]
    units: DefaultUnits
    known: Mapping[str, str]
    _units_of_keys: dict[str, tuple[str, str, str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse keys that are not known, and values that are given twice."""
        keys = self._possible()
        require_known(self.where, self.entries, keys)
        for key in self.entries:
            name, unit = keys[key]
            if name in self._units_of_keys:
                other = self._units_of_keys[name][0]
                raise BadInputError(
                    f"{self.where}: {other!r} and {key!r} give {name} twice; expected one of them"
                )
            self._units_of_keys[name] = (key, unit, self.known[name])

    def _possible(self) -> dict[str, tuple[str, str]]:
        """Return the keys that the table may have, with their names and units."""
        found = {name: (name, "") for name in self.known}
        for name, dimension in self.known.items():
            for unit in UNITS_OF.get(dimension, ()):
                found[f"{name}_{unit}"] = (name, unit)
        return found

    def __contains__(self, name: str) -> bool:
        return name in self._units_of_keys

    def inner(self, name: str, known: Mapping[str, str]) -> KeyedTable:
        """Return the table that a value is, whose values have the unit of its key unless they name
        another one.
        """
        _, unit, _ = self._units_of_keys[name]
        units = self.units
        if unit:
            is_angle = unit in UNITS_OF["angle"]
            units = replace(units, angle=unit) if is_angle else replace(units, length=unit)
        return KeyedTable(f"{self.where}.{name}", self.raw(name), units, known)

    def error(self, name: str, expected: str) -> BadInputError:
        """Return the error that a value is another one than expected."""
        key = self._units_of_keys[name][0] if name in self else name
        got = f"{key} = {self.entries[key]!r}" if key in self.entries else f"no {key}"
        return BadInputError(f"{self.where}: {got}; expected {expected}")

    def raw(self, name: str) -> Any:
        """Return a value as it stands in the file, None if it is absent."""
        return self.entries[self._units_of_keys[name][0]] if name in self else None

    def text(self, name: str, choices: Iterable[str]) -> str:
        """Return one of some words."""
        given = self.raw(name)
        if given in (known := tuple(choices)):
            return str(given)
        raise self.error(name, f"one of {', '.join(nearest_first([str(given)], known))}")

    def names(self, name: str) -> tuple[str, ...]:
        """Return a list of names, which may be absent."""
        given = self.raw(name)
        if given is None:
            return ()
        if not isinstance(given, list) or not all(isinstance(each, str) for each in given):
            raise self.error(name, 'a list of names, such as ["hole_1", "hole_2"]')
        return tuple(given)

    def number(self, name: str) -> float:
        """Return a number in SI units."""
        return float(self.numbers(name, (1,))[0])

    def numbers(self, name: str, counts: tuple[int, ...]) -> np.ndarray:
        """Return numbers in SI units, shape (n,), n being one of some counts; a number that is no
        list is one.
        """
        given = self.raw(name)
        values = given if isinstance(given, list) else [given]
        _, unit, dimension = self._units_of_keys[name]
        found = [self._in_si(name, value, unit, dimension) for value in values]
        if len(found) not in counts:
            words = " or ".join("a number" if n == 1 else f"{n} numbers" for n in counts)
            raise self.error(name, words)
        return np.array(found)

    def _in_si(self, name: str, value: Any, unit: str, dimension: str) -> float:
        """Return one number in SI units, from a number or a text with its unit."""
        known = UNITS_OF.get(dimension, ())
        if isinstance(value, str):
            number, found = _divided(value, known)
            if found and unit:
                raise self.error(name, f"numbers without units, as the key has {unit}")
            value = number
            unit = found or unit
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(
                name, "a number" + (f", or a text such as '0.5 {known[1]}'" if known else "")
            )
        unit = unit or self.units.of(dimension)
        if known and not unit:
            usual = _USUAL[dimension]
            top = "unit" if dimension == "length" else "angle_unit"
            raise self.error(name, f"a unit: {name}_{usual} = ..., or {top} = '{usual}' at the top")
        size = float(value) * SIZES.get(unit, 1.0)
        if not abs(size) <= LARGEST:
            raise self.error(name, "finite numbers of plausible size")
        return size


def _divided(text: str, units: tuple[str, ...]) -> tuple[float | None, str]:
    """Return the number and the unit of a text; None for what is none."""
    text = text.strip()
    for unit in sorted(units, key=len, reverse=True):
        if text.endswith(unit):
            return _plain(text.removesuffix(unit)), unit
    return _plain(text), ""


def _plain(text: str) -> float | None:
    try:
        return plain_number(text)
    except ValueError:
        return None
