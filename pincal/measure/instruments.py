"""Noise of instruments that measure ranges and angles, growing with the distance as in data sheets.

A laser tracker is most accurate along its line of sight; across it, angular errors grow with the
distance. The covariance of a row follows from the position of the target, which has to be in the
instrument's own frame.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from pincal.errors import BadInputError, MeasurementError
from pincal.measure.measurements import Measurements
from pincal.thresholds import Scale
from pincal.units import LARGEST, SMALLEST, unit_sizes

# Standard deviation over maximum permissible error (MPE): "Typical measurement results are half of
# the relevant MPE values", Leica AT500 User Manual, 2.8.1.
_OF_MPE: Scale = 0.5
# Units of a constant term [m], and of one proportional to the range [m/m].
_CONSTANT = unit_sizes("um", "µm", "mm")
_PER_METRE = (
    {f"{unit}/m": size for unit, size in _CONSTANT.items()}
    | {"ppm": 1e-6}
    | unit_sizes("urad", "mrad")
)
_TERM = re.compile(r"(?P<number>[0-9]*\.?[0-9]+(?:[eE]-?[0-9]+)?)\s*(?P<unit>\S+)")
_EXAMPLE = "10um+0.3um/m,15um+6um/m"


class _Sheet(NamedTuple):
    """MPE along and across the line of sight as stated by the manufacturer, and where."""

    mpe: str
    source: str


INSTRUMENTS = {
    # e_ADM +- 10 um + 0.3 um/m and e_T +- 15 um + 6 um/m, MPE by ISO 10360-10:2021, Annex D.
    "leica_at500": _Sheet(
        "10um+0.3um/m,15um+6um/m", "Leica Absolute Tracker AT500 User Manual, section 2.8.2"
    ),
    # U_x,y,z +- 15 um + 6 um/m, MPE of each coordinate, used in all directions.
    "leica_at960": _Sheet(
        "15um+6um/m", "Hexagon, Leica Absolute Tracker AT960, technical data: accuracy U_x,y,z"
    ),
}
"""Instruments by name, with their data sheets; for all others the numbers can be given."""


@dataclass(frozen=True)
class InstrumentNoise:
    """Standard deviations of readings at a range r: along + along_per_m r, and across +
    across_per_m r.

    Attributes:
        along: along the line of sight [m].
        along_per_m: proportional to the range [m/m].
        across: across it, in each direction [m].
        across_per_m: proportional to the range [m/m], or of an angle [rad].

    Example:
        >>> noise = InstrumentNoise.of("leica_at500")
        >>> [round(1e6 * float(sigma), 2) for sigma in noise.sigmas(np.array(3.0))]
        [5.45, 16.5]
        >>> np.allclose(InstrumentNoise.of("20um").sigmas(np.array(3.0)), 1e-5)
        True
    """

    along: float
    along_per_m: float
    across: float
    across_per_m: float

    def __post_init__(self) -> None:
        """Refuse invalid numbers."""
        numbers = (self.along, self.along_per_m, self.across, self.across_per_m)
        is_some = (
            max(self.along, self.along_per_m) > 0.0 and max(self.across, self.across_per_m) > 0.0
        )
        if not (all(n == 0.0 or SMALLEST <= n <= LARGEST for n in numbers) and is_some):
            raise BadInputError(
                f"noise of an instrument {', '.join(f'{n:g}' for n in numbers)}; expected numbers "
                f"from {SMALLEST:g} to {LARGEST:g} m or m/m, or 0, and more than 0 along and across"
            )

    @classmethod
    def of(cls, text: str) -> Self:
        """Return the noise of an instrument, half of its maximum permissible errors.

        Args:
            text: a name of ``INSTRUMENTS``, or MPE along and across the line of sight, separated by
                a comma, each a constant and a term proportional to the range, such as
                ``10um+0.3um/m,15um+6um/m``; a single one applies to both.

        Raises:
            BadInputError: for a name or a number that is invalid.
        """
        sheet = INSTRUMENTS.get(text.strip().lower())
        parts = (text if sheet is None else sheet.mpe).split(",")
        try:
            along, across = [mpe_terms(part) for part in (parts if len(parts) == 2 else parts * 2)]
        except ValueError:
            known = ", ".join(INSTRUMENTS)
            raise BadInputError(
                f"instrument {text!r}; expected {known}, or the maximum permissible errors of its "
                f"data sheet along and across the line of sight, such as {_EXAMPLE}"
            ) from None
        return cls(*(_OF_MPE * number for number in (*along, *across)))

    def sigmas(self, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the standard deviations along and across the line of sight at ranges [m]."""
        return self.along + self.along_per_m * distance, self.across + self.across_per_m * distance

    def covariance(self, position: np.ndarray) -> np.ndarray:
        """Return the covariance of readings at positions in the instrument's frame, shape (N, 3, 3)
        for (N, 3) [m].
        """
        distance = np.linalg.norm(position, axis=1)
        along, across = self.sigmas(distance)
        way = position / np.maximum(distance, 1e-9)[:, None]
        return np.asarray(
            across[:, None, None] ** 2 * np.eye(3)
            + (along**2 - across**2)[:, None, None] * way[:, :, None] * way[:, None, :]
        )

    def sigma(self, position: np.ndarray) -> float:
        """Return the standard deviation of one coordinate, the root mean square over positions,
        shape (N, 3) [m].
        """
        along, across = self.sigmas(np.linalg.norm(position, axis=1))
        return float(np.sqrt(np.mean(along**2 + 2.0 * across**2) / 3.0))

    def whitening(self, position: np.ndarray, size: int) -> np.ndarray:
        """Return the matrices that whiten the noise of readings at positions, shape (N, 3) [m], in
        units of :meth:`sigma`.

        They have the shape (size, size, N); components of a reading after the position are
        unchanged.
        """
        found = np.tile(np.eye(size)[:, :, None], (1, 1, len(position)))
        inverse = np.linalg.inv(np.linalg.cholesky(self.covariance(position)))
        found[:3, :3] = self.sigma(position) * inverse.transpose(1, 2, 0)
        return np.ascontiguousarray(found)


def seen_by(table: Measurements) -> np.ndarray:
    """Return the positions on which the noise depends, shape (N, 3) [m].

    Raises:
        MeasurementError: if it has no positions, or has the column sigma.
    """
    if table.position is None:
        raise MeasurementError(
            f"{table.source}: --instrument is for positions or poses in the instrument's own "
            f"frame, but this table holds {table.kind}; leave it out and give --noise"
        )
    if table.sigma is not None:
        raise MeasurementError(
            f"{table.source}: --instrument and a column sigma; expected only one of the two"
        )
    return table.position


def mpe_terms(text: str) -> tuple[float, float]:
    """Return the constant [m] and the factor of the range [m/m] of a maximum permissible error,
    such as ``10um+0.3um/m``.

    Raises:
        ValueError: for any other text.
    """
    constant = per_metre = 0.0
    for term in text.split("+"):
        found = _TERM.fullmatch(term.strip())
        if found is None:
            raise ValueError(term)
        number = float(found["number"])
        unit = found["unit"]
        if unit in _CONSTANT:
            constant += number * _CONSTANT[unit]
        elif unit in _PER_METRE:
            per_metre += number * _PER_METRE[unit]
        else:
            raise ValueError(term)
    return constant, per_metre
