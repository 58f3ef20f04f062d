"""Identity of a calibration: which robot, by which instrument, where, when and by whom.

A model of another robot of the same type fits no better than the nominal one, and nothing in its
numbers says so: its identity does. It is stated by the user and carried along unchanged.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from datetime import date
from typing import Any

import msgspec

from pincal.errors import BadInputError, nearest_first, printable
from pincal.thresholds import Count, Scale

LONGEST_ENTRY: Count = 200
"""Longest entry [characters]: a line on a page of A4."""
# Most notes.
_MOST_NOTES: Count = 50
# Lowest temperature [deg C].
_ABSOLUTE_ZERO: Scale = -273.15
# Keys of further entries begin with this.
_NOTE = "note."

KEYS: dict[str, str] = {
    "robot": "serial number of the robot",
    "controller": "serial number of its controller",
    "instrument": "measuring instrument with its serial number",
    "certificate": "number of the instrument's calibration certificate",
    "operator": "person who measured",
    "date": "day of the measurement, YYYY-MM-DD",
    "temperature": "ambient temperature during the measurement [deg C]",
    "place": "where it was measured",
    "laboratory": "who calibrates",
    "customer": "for whom",
    "country": "of the laboratory, two letters of ISO 3166-1",
}
"""What can be stated, in the order of all output; anything else is a ``note.NAME``."""


class Identity(msgspec.Struct, frozen=True, omit_defaults=True):
    """What is stated of robot, instrument and circumstances of a calibration; all of it optional.

    Attributes:
        robot: serial number of the robot.
        controller: serial number of its controller.
        instrument: measuring instrument with its serial number.
        certificate: number of the instrument's calibration certificate.
        operator: person who measured.
        date: day of the measurement, YYYY-MM-DD.
        temperature: ambient temperature during the measurement [deg C].
        place: where it was measured.
        laboratory: who calibrates.
        customer: for whom.
        country: of the laboratory, two letters of ISO 3166-1.
        note: further entries, by names of the user's own.

    Example:
        >>> stated = Identity.of({"robot": "2021-17", "date": "2026-11-29", "note.order": "4711"})
        >>> stated.robot, stated.note, list(stated.entries())[0]
        ('2021-17', {'order': '4711'}, ('robot', 'serial number of the robot', '2021-17'))
    """

    robot: str = ""
    controller: str = ""
    instrument: str = ""
    certificate: str = ""
    operator: str = ""
    date: str = ""
    temperature: float | None = None
    place: str = ""
    laboratory: str = ""
    customer: str = ""
    country: str = ""
    note: dict[str, str] = {}

    @classmethod
    def of(cls, entries: Mapping[str, str]) -> Identity:
        """Return what entries state.

        Args:
            entries: by key, one of :data:`KEYS` or ``note.NAME``.

        Raises:
            BadInputError: for an unknown key, or a value that is none.
        """
        known = dict[str, Any]()
        notes = dict[str, str]()
        for key, text in entries.items():
            if key.startswith(_NOTE) and len(key) > len(_NOTE):
                notes[key.removeprefix(_NOTE)] = text.strip()
            elif key == "temperature":
                known[key] = _temperature(text)
            elif key in KEYS:
                known[key] = _text(key, text.strip())
            else:
                raise BadInputError(
                    f"id.{printable(key, LONGEST_ENTRY)}: no such entry; expected one of "
                    f"{', '.join(nearest_first([key], KEYS))}, or id.note.NAME for anything else"
                )
        return cls(**known, note=notes)

    def __post_init__(self) -> None:
        for key in KEYS.keys() - {"temperature"}:
            if value := getattr(self, key):
                _text(key, value)
        for name, value in self.note.items():
            _text(f"note.{name}", name)
            _text(f"note.{name}", value)
        if len(self.note) > _MOST_NOTES:
            raise BadInputError(
                f"id.note: {len(self.note)} entries; expected at most {_MOST_NOTES}"
            )
        if self.temperature is not None and not _is_temperature(self.temperature):
            raise BadInputError(
                f"id.temperature {self.temperature:g}; expected deg C, such as 20.5"
            )
        if self.date and not is_day(self.date):
            raise BadInputError(f"id.date {self.date!r}; expected a day as YYYY-MM-DD")
        if self.country and not re.fullmatch("[A-Z]{2}", self.country):
            raise BadInputError(
                f"id.country {self.country!r}; expected two capital letters, such as DE"
            )

    def __bool__(self) -> bool:
        return any(True for _ in self.entries())

    def entries(self) -> Iterator[tuple[str, str, str]]:
        """Yield key, meaning and value of what is stated, in the order of :data:`KEYS`; notes
        last.
        """
        for key, meaning in KEYS.items():
            value = getattr(self, key)
            if key == "temperature" and value is not None:
                yield key, meaning, f"{value:g}"
            elif value:
                yield key, meaning, value
        for name, value in self.note.items():
            yield f"{_NOTE}{name}", name, value

    @property
    def machine(self) -> str:
        """Robot and controller in words; empty if neither is stated."""
        stated = {"robot": self.robot, "controller": self.controller}
        return ", ".join(f"{what} {serial}" for what, serial in stated.items() if serial)

    def over(self, earlier: Identity) -> Identity:
        """Return what is stated here, and of the rest what was stated earlier."""
        here = {key: value for key in KEYS if (value := getattr(self, key)) not in ("", None)}
        return msgspec.structs.replace(earlier, **here, note=earlier.note | self.note)

    @property
    def lasting(self) -> Identity:
        """What is still true when the calibrated robot measures something else: all but who took
        the readings, and when, where and at which temperature.
        """
        return msgspec.structs.replace(self, operator="", date="", temperature=None, place="")

    def require(self, known: Identity, file: str) -> None:
        """Refuse a file that is of another robot than stated here.

        Args:
            known: identity in the file.
            file: its name.

        Raises:
            BadInputError: with both serial numbers.
        """
        if not self.is_of(known):
            raise BadInputError(
                f"{file}: is of robot {known.robot}, and id.robot={self.robot}, of --set or the "
                f"cell file, expects another one; choose the file of robot {self.robot}, or "
                "correct the serial number"
            )

    def is_of(self, other: Identity) -> bool:
        """Return whether two are not of different robots: the same one, or one says nothing."""
        if not (self.robot and other.robot):
            return True
        return _folded(self.robot) == _folded(other.robot)


def _folded(serial: str) -> str:
    """Return a serial number as it is compared: without case and blanks."""
    return "".join(serial.casefold().split())


def _text(key: str, value: str) -> str:
    """Return a line of text.

    Raises:
        BadInputError: for an empty, long or unprintable one.
    """
    if not value.strip() or len(value) > LONGEST_ENTRY or not value.isprintable():
        raise BadInputError(
            f"id.{printable(key, LONGEST_ENTRY)} {printable(value, LONGEST_ENTRY)!r}; expected a "
            f"line of text of at most {LONGEST_ENTRY} characters"
        )
    return value


def _temperature(text: str) -> float:
    """Return a temperature [deg C] from a number with or without its unit."""
    found = re.fullmatch(r"([-+]?\d+(?:[.,]\d+)?)\s*(?:deg ?C|°C|C)?", text.strip())
    if found is None:
        raise BadInputError(f"id.temperature {text!r}; expected deg C, such as 20.5")
    return float(found[1].replace(",", "."))


def _is_temperature(value: float) -> bool:
    return math.isfinite(value) and value > _ABSOLUTE_ZERO


def is_day(text: str) -> bool:
    """Return whether a text is a date as YYYY-MM-DD, whose order as text is that of the days."""
    try:
        return date.fromisoformat(text).isoformat() == text
    except ValueError:
        return False
