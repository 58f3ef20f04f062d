"""Units that a column may have, by what it holds, the way to SI, and which values can be meant."""

from __future__ import annotations

import numpy as np

from pincal.units import LARGEST

# SI value = factor * value + offset.
_LENGTHS: dict[str, tuple[float, float]] = {
    "m": (1, 0),
    "mm": (1e-3, 0),
    "cm": (1e-2, 0),
    "um": (1e-6, 0),
    "µm": (1e-6, 0),
    "in": (0.0254, 0),
}
UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "length": _LENGTHS,
    "noise": _LENGTHS | {"px": (1, 0)},
    "angle": {"rad": (1, 0), "mrad": (1e-3, 0), "deg": (np.pi / 180, 0), "°": (np.pi / 180, 0)},
    "mass": {"kg": (1, 0), "g": (1e-3, 0), "lb": (0.45359237, 0)},
    "time": {"s": (1, 0), "ms": (1e-3, 0), "min": (60, 0), "h": (3600, 0)},
    "temperature": {"degC": (1, 0), "°C": (1, 0), "K": (1, -273.15)},
    "pixel": {"px": (1, 0)},
    "number": {},
    "name": {},
}
"""Factor and offset by physical quantity and unit; what has no unit in the header is in SI units."""


# What has its own size: counts, indices and times, which some clocks count from 1970 in nanoseconds.
_UNBOUNDED = ("time", "number", "name")


def is_possible(values: np.ndarray, quantity: str) -> np.ndarray:
    """Return which values of a quantity in SI units can be meant: finite ones, no larger than anything about a robot is."""
    return np.isfinite(values) if quantity in _UNBOUNDED else np.abs(values) <= LARGEST


def expected_number(quantity: str) -> str:
    """Return in words which values can be meant.

    Example:
        >>> expected_number("length"), expected_number("time")
        ('a finite number (at most 1e+07 m)', 'a finite number')
    """
    if quantity in _UNBOUNDED:
        return "a finite number"
    return f"a finite number (at most {LARGEST:g} {next(iter(UNITS[quantity]))})"


def in_si(values: np.ndarray, quantity: str, unit: str) -> np.ndarray:
    """Return values of a quantity in SI units; an empty unit is SI."""
    scale, offset = UNITS[quantity].get(unit, (1, 0))
    return values if (scale, offset) == (1, 0) else values * scale + offset
