r"""The temperature of a part: lengths are stated at 20 deg C (ISO 1).

A part of the coefficient :math:`\alpha` at the temperature T is larger by :math:`\alpha (T - 20)`:
its points are brought back about their centre, so that lengths, diameters and, in a datum of the
part itself, positions are those at 20 deg C. The uncertainty of this is common to all points
(JCGM 100, 5.1.2),

.. math:: u^2 = (\alpha \, u(T))^2 + ((T - 20) \, u(\alpha))^2 \quad \text{per length} .
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pincal.calibration.position_covariance import SharedErrors
from pincal.errors import BadInputError, nearest_first
from pincal.features.feature_points import LocatedPoints
from pincal.features.mounted_sensor import STATED
from pincal.thresholds import Scale

EXPANSION = "expansion"
"""Name of the source of uncertainty."""

REFERENCE: Scale = 20.0
"""Temperature at which lengths are stated [deg C]."""

# Coefficients and temperatures that are no part's [um/m/K and deg C].
_LARGEST: Scale = 500.0
_HOT: Scale = 500.0
_MICRO: Scale = 1e-6
_KEYS = (
    "coefficient_um_per_m_K",
    "u_coefficient_um_per_m_K",
    "temperature_C",
    "u_temperature_K",
)


@dataclass(frozen=True)
class PartExpansion:
    """Expansion of a part, and how well it is known.

    Attributes:
        coefficient: of linear expansion [1/K].
        temperature: of the part [deg C].
        u_coefficient: standard uncertainty of the coefficient [1/K].
        u_temperature: of the temperature [K].

    Example:
        >>> steel = PartExpansion(11.5e-6, 26.0, u_temperature=0.5)
        >>> f"{steel.growth:.2e}", f"{steel.u_growth:.2e}"
        ('6.90e-05', '5.75e-06')
    """

    coefficient: float
    temperature: float
    u_coefficient: float = 0.0
    u_temperature: float = 0.0

    @property
    def growth(self) -> float:
        """How much larger the part is than at 20 deg C [m/m]."""
        return self.coefficient * (self.temperature - REFERENCE)

    @property
    def u_growth(self) -> float:
        """Standard uncertainty of the growth [m/m]."""
        return math.hypot(
            self.coefficient * self.u_temperature,
            (self.temperature - REFERENCE) * self.u_coefficient,
        )

    @classmethod
    def of_table(cls, entries: Any, where: str) -> PartExpansion:
        """Return the content of a table [expansion].

        Args:
            entries: as TOML has them.
            where: file and name of the table, for messages.

        Raises:
            BadInputError: for an unknown or missing key, or a value that is none.
        """
        if not isinstance(entries, dict):
            raise BadInputError(f"{where}: {entries!r}; expected a table")
        for key in entries:
            if key not in _KEYS:
                near = ", ".join(nearest_first([key], _KEYS))
                raise BadInputError(f"{where}: unknown key {key!r}; expected one of {near}")
        return cls(
            _MICRO * _number(entries, _KEYS[0], where, -_LARGEST, _LARGEST),
            _number(entries, _KEYS[2], where, -_HOT, _HOT),
            _MICRO * _number(entries, _KEYS[1], where, 0.0, _LARGEST, absent=0.0),
            _number(entries, _KEYS[3], where, 0.0, _HOT, absent=0.0),
        )

    def at_reference(self, points: LocatedPoints) -> LocatedPoints:
        """Return points as they would be at 20 deg C, about their centre, with the uncertainty of
        this.
        """
        about = points.place - points.place.mean(axis=0)
        found = points.moved(about * (1.0 / (1.0 + self.growth) - 1.0))
        if not self.u_growth:
            return found
        return found.with_source(
            EXPANSION, SharedErrors.of_all(self.u_growth * about[:, :, None]), STATED
        )

    @property
    def words(self) -> str:
        """What was done, for the sheet."""
        u = f" (u {self.u_temperature:g} K)" if self.u_temperature else ""
        return (
            f"the part was at {self.temperature:g} deg C{u}; lengths are stated at "
            f"{REFERENCE:g} deg C, by {self.coefficient / _MICRO:g} um/m per K"
        )


def _number(
    entries: Mapping[str, Any],
    key: str,
    where: str,
    least: float,
    largest: float,
    *,
    absent: float | None = None,
) -> float:
    """Return a number of a table within limits."""
    if key not in entries and absent is not None:
        return absent
    value = entries.get(key)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not least <= float(np.float64(value)) <= largest:
        got = f"no {key}" if key not in entries else f"{key} = {value!r}"
        raise BadInputError(f"{where}: {got}; expected a number from {least:g} to {largest:g}")
    return float(np.float64(value))
