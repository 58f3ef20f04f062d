"""Units that a column may have, by what it holds, and the way to SI."""

from __future__ import annotations

import numpy as np

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


def in_si(values: np.ndarray, quantity: str, unit: str) -> np.ndarray:
    """Return values of a quantity in SI units; an empty unit is SI."""
    scale, offset = UNITS[quantity].get(unit, (1, 0))
    return values if (scale, offset) == (1, 0) else values * scale + offset
