"""Quantities that readings and their conditions are given in, each in one column or several."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from pincal.errors import MeasurementError
from pincal.recorded import RECORDABLE
from pincal.units import SMALLEST


@dataclass(frozen=True)
class Rule:
    """Which values are valid."""

    expected: str
    """The valid values in words, for messages."""
    is_met: Callable[[np.ndarray], np.ndarray]
    """Returns which values of an array, shape (N,) or (N, k), are valid, in the same
    shape or (N,).
    """


FINITE = Rule("a finite number", np.isfinite)
POSITIVE = Rule(
    f"a number > 0, at least {SMALLEST:g}", lambda value: np.isfinite(value) & (value >= SMALLEST)
)
NOT_NEGATIVE = Rule(
    f"0 or a number > 0, at least {SMALLEST:g}",
    lambda value: np.isfinite(value) & ((value == 0.0) | (value >= SMALLEST)),
)
SIGN = Rule("-1, 0 or 1", lambda value: np.isin(value, (-1, 0, 1)))


@dataclass(frozen=True)
class Field:
    """One quantity of a table, in one column or several.

    Attributes:
        name: of the array that holds it.
        columns: their names without units, in the order of the components.
        quantity: physical quantity, which determines the possible units: "length", "angle",
            "pixel", "noise", "mass", "time", "temperature", "number" or "name".
        rule: which values are valid; names always are.
        is_unit: whether the components form a unit vector, to be normalised.
        mistakes: how its columns get mixed up: in words, and a function that returns the right
            values.
        mirror: returns the values in the frame with y reversed; None where that is undefined.
    """

    name: str
    columns: tuple[str, ...]
    quantity: str
    rule: Rule = FINITE
    is_unit: bool = False
    mistakes: tuple[tuple[str, Callable[[np.ndarray], np.ndarray]], ...] = ()
    mirror: Callable[[np.ndarray], np.ndarray] | None = None

    @property
    def is_name(self) -> bool:
        """Whether the values are names, not numbers."""
        return self.quantity == "name"

    def __str__(self) -> str:
        return " ".join(self.columns)


POINT = Field("point", ("point",), "name")
_RECORDED = tuple(
    Field(name, (name,), of.quantity, Rule(of.expected, of.is_possible))
    for name, of in RECORDABLE.items()
    if not of.of_joints
)
_TARGET, _STOP, _STATION = (Field(name, (name,), "name") for name in ("target", "stop", "station"))
CONDITIONS = {of.name: of for of in (POINT, _TARGET, *_RECORDED, _STOP, _STATION)}
CONDITIONS |= {f"{end}_link": Field(f"{end}_link", (end,), "name") for end in ("from", "to")}
"""Conditions of a pose that a table can contain in addition to the readings."""

FIRST, SECOND = (Field(name, (name,), "name") for name in ("first", "second"))
"""The points of a contact, each ``LINK:NAME``."""

SIGMA = Field("sigma", ("sigma",), "noise", POSITIVE)
"""The standard deviation of a row's reading."""


def link_of(point: str, *, where: str) -> str:
    """Return the link of a point; refuse a name that is not LINK:NAME."""
    link, _, name = point.rpartition(":")
    if not link.strip() or not name.strip():
        raise MeasurementError(f"{where}: point {point!r}; expected LINK:NAME, such as tool0:ball")
    return link.strip()


class TableRows(Protocol):
    """The interface of a table of N rows for sensors;
    :class:`pincal.measure.measurements.Measurements` implements it.
    """

    @property
    def source(self) -> str:
        """Name of the file, for messages."""

    @property
    def q(self) -> np.ndarray:
        """Joint positions [rad], prismatic [m], shape (N, n)."""

    @property
    def rows(self) -> np.ndarray:
        """Line of each row in its file, shape (N,)."""

    @property
    def units(self) -> Mapping[str, str]:
        """The units in the header, by column."""

    @property
    def point_names(self) -> np.ndarray | None:
        """Name of each row's fixed point, shape (N,); None where rows involve none."""

    def array(self, name: str) -> np.ndarray:
        """Return the values of a field of the table, shape (N,) or (N, k)."""


def __getattr__(name: str) -> Any:
    if name == "Table":
        warnings.warn(
            "pincal.sensors.fields.Table is now TableRows", DeprecationWarning, stacklevel=2
        )
        return TableRows
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
