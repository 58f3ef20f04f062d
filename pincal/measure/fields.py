"""What the columns of a table can hold: quantities made of one column or several, and which values are valid."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pincal.units import SMALLEST


@dataclass(frozen=True)
class Rule:
    """Which values are valid."""

    expected: str
    """What a value has to be, for messages."""
    is_met: Callable[[np.ndarray], np.ndarray]
    """Says of an array, shape (N,) or (N, k), which of its values are valid, in the same shape or (N,)."""


FINITE = Rule("a finite number", np.isfinite)
POSITIVE = Rule(f"a number > 0, at least {SMALLEST:g}", lambda value: np.isfinite(value) & (value >= SMALLEST))
SIGN = Rule("-1, 0 or 1", lambda value: np.isin(value, (-1, 0, 1)))


@dataclass(frozen=True)
class Field:
    """One quantity of a table, made of one column or several.

    Attributes:
        name: of the array that holds it.
        columns: their names, units left out, in the order of the components.
        quantity: what they hold, which says the units they may have: "length", "angle", "pixel", "noise", "mass", "time",
            "temperature", "number" or "name".
        rule: which values are valid; names always are.
        is_unit: whether the components are those of a unit vector, to be normalised.
        mistakes: how its columns get mixed up: in words, and what the right values are then.
        mirror: what the values are in the frame whose y points the other way; None where that can't be said.
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
_OF_A_POSE = {"target": "name", "payload": "mass", "temperature": "temperature", "time": "time", "station": "name"}
CONDITIONS = {"point": POINT} | {name: Field(name, (name,), quantity) for name, quantity in _OF_A_POSE.items()}
"""What a table can say of a pose beside the readings."""

SIGMA = Field("sigma", ("sigma",), "noise", POSITIVE)
"""The standard deviation of a row's reading."""


class Table(Protocol):
    """What a sensor needs of a table of N rows; :class:`pincal.measure.measurements.Measurements` is one."""

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
        """The units that the header gave, by column."""

    @property
    def point_names(self) -> np.ndarray | None:
        """Name of the fixed point that each row involves, shape (N,); None where rows involve none."""

    def array(self, name: str) -> np.ndarray:
        """Return the values of a field that the table has, shape (N,) or (N, k)."""
