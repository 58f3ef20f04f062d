r"""Noise of new rows under a calibrated model: that of the calibration, carried over to another
plan of measurement.

The noise of a calibration is that of its rows, :math:`\sigma^2 = m^2 + s^2`, with m what the model
lacks at a pose and s the scatter of the means that were fitted, of n readings in each of v stops. A
row of one stop, the mean of n' readings, has
:math:`m^2 + s'^2`. Where repeats of the calibration, or of the new rows, show the scatter within
  and between stops, m
follows from the difference. It is taken at its upper limit, as it counts in full at each pose,
however often visited.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pincal.calibration.change_numbers import CHANGES
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.repeatability import Repeatability
from pincal.identify.station import count
from pincal.identify.stop_numbers import STOPS
from pincal.identify.stop_scatter import StopScatter
from pincal.sensors.registry import blocks_of
from pincal.sensors.sensor import Block


@dataclass(frozen=True, eq=False)
class RowNoise:
    """Noise of one component of each block of the readings of new rows, shape (blocks,) each.

    Attributes:
        sigma: standard deviations [m, rad, px].
        is_known: where they are declared or known from the calibration; the others are of a good
            instrument, and are to be estimated from the rows.
        of_pose: fraction of the variance that all stops at a pose have in common.
        of_drives: fraction of the variance that follows the levers of the drives, as far as the
            calibration shows it.
        scatter: variances within a stop and between stops, as far as these rows or the calibration
            show them.
    """

    sigma: np.ndarray
    is_known: np.ndarray
    of_pose: np.ndarray
    of_drives: np.ndarray
    scatter: StopScatter

    @property
    def repeatability(self) -> Repeatability | None:
        """The record of the scatter; None where none is known."""
        return Repeatability.of(self.scatter) if self.scatter.is_known else None

    @property
    def declared(self) -> tuple[float | None, ...]:
        """The standard deviations, None where they are to be estimated."""
        pairs = zip(self.sigma.tolist(), self.is_known.tolist(), strict=True)
        return tuple(size if is_known else None for size, is_known in pairs)

    def estimated(self, sigma: np.ndarray) -> np.ndarray:
        """Return the standard deviations, those that are not known from an estimate, shape
        (blocks,).
        """
        return np.where(self.is_known, self.sigma, sigma)

    def with_unknown(self, uncertainty: float, blocks: Sequence[Block]) -> RowNoise:
        """Return it with a further uncertainty of each coordinate [m] of these blocks."""
        is_length = np.array([block.unit == "m" for block in blocks])
        widened = np.hypot(self.sigma, uncertainty)
        return replace(self, sigma=np.where(is_length, widened, self.sigma))

    def with_declared(self, size: float, blocks: Sequence[Block], unit: str) -> RowNoise:
        """Return it with noise that is declared for the blocks in a unit, which takes precedence
        if it is larger.
        """
        is_declared = np.array([block.unit == unit for block in blocks])
        at_least = np.where(self.is_known, np.maximum(self.sigma, size), size)
        sigma = np.where(is_declared, at_least, self.sigma)
        return replace(self, sigma=sigma, is_known=self.is_known | is_declared)


def noise_of_rows(
    known: FittedRobot,
    kind: str,
    blocks: Sequence[Block],
    *,
    declared: np.ndarray | None = None,
    scatter: StopScatter | None = None,
    sigma_orientation: float | None = None,
) -> RowNoise:
    """Return the noise of rows of one stop each.

    Args:
        known: the calibrated model.
        kind: of the readings.
        blocks: of the readings.
        declared: shape (N,), declared noise of each row [m], which takes precedence if it is
            larger; default: none.
        scatter: of the single readings behind them; default: none was repeated.
        sigma_orientation: declared noise of orientations [rad].
    """
    of_calibration, is_known = calibrated_noise(known, kind, blocks)
    own = _calibrated_scatter(known, kind, blocks)
    here = StopScatter.none(len(blocks)) if scatter is None else scatter
    best = here.known_with(own)
    before = own.known_with(best)
    # Scatter of a calibration's rows can't exceed their noise.
    square = before.row_variance(of_calibration)
    shown = np.minimum(before.of_row(own.readings, own.stops), square)
    is_shown = shown > 0.0
    lacking = _lacking(square, shown, _degrees(known, blocks), before.within_degrees)
    variance = np.where(is_shown, lacking + best.of_row(here.readings), of_calibration**2)
    positive = np.maximum(variance, 1e-300)
    has_visits = best.between_degrees > 0.0
    of_pose = np.where(has_visits & is_shown, lacking / positive, 0.0)
    # Noise of readings within a stop does not follow the levers.
    of_stops = 1.0 - best.within / here.readings / positive
    of_drives = _following(own, square, before.within) * of_stops
    of_drives = np.where(own.drives > 0.0, np.clip(of_drives, 0.0, 1.0), 0.0)
    sigma = np.where(is_known, np.sqrt(variance), of_calibration)
    drives = float(of_drives[0])
    of_one_stop = replace(
        best, readings=here.readings, stops=1.0, shared=own.shared, drives=drives, of_single=False
    )
    found = RowNoise(sigma, is_known, of_pose, of_drives, of_one_stop)
    if sigma_orientation is not None:
        found = found.with_declared(sigma_orientation, blocks, "rad")
    if declared is not None:
        found = found.with_declared(float(np.sqrt(np.mean(declared**2))), blocks, "m")
    return found


def _lacking(
    square: np.ndarray, shown: np.ndarray, degrees: float, of_scatter: np.ndarray
) -> np.ndarray:
    """Return the upper limit of the variance that the model lacks at a pose, shape (blocks,); 0
    where no repeats show the scatter of the rows.

    Args:
        square: shape (blocks,), variance of the calibration's rows.
        shown: shape (blocks,), that of it which repeats show as scatter.
        degrees: of freedom of the first.
        of_scatter: shape (blocks,), of the second.
    """
    doubt = (
        np.sqrt(2.0 / degrees) * square
        + np.sqrt(2.0 / np.maximum(of_scatter, STOPS.fewest)) * shown
    )
    limit = np.clip(square - shown + STOPS.sure * doubt, 0.0, square)
    return np.where(shown > 0.0, limit, 0.0)


def _following(own: StopScatter, square: np.ndarray, within: np.ndarray) -> np.ndarray:
    """Return which fraction of a calibration's variance beyond that of readings within a stop
    followed the levers of the drives, shape (blocks,).
    """
    read = within / (own.readings * own.stops)
    rest = np.maximum(square - read, 1e-300)
    apart = np.clip((1.0 - own.drives) * square - read, 0.0, None) / rest
    return np.asarray(1.0 - apart)


def calibrated_noise(
    known: FittedRobot, kind: str, blocks: Sequence[Block]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the noise of a calibration for each block of readings, and whether it has any for it,
    shape (blocks,) each.

    It is the calibration's of blocks in the same unit, which includes unmodelled errors, else that
    of good instruments.
    """
    if known.sensor_kind == kind:
        return np.array(known.sigma, float), np.ones(len(blocks), bool)
    of_kind = blocks_of(known.sensor_kind)
    by_unit = dict(zip((block.unit for block in of_kind), known.sigma, strict=True))
    is_known = np.array([block.unit in by_unit for block in blocks], bool)
    return np.array([by_unit.get(block.unit, block.noise) for block in blocks], float), is_known


def _calibrated_scatter(known: FittedRobot, kind: str, blocks: Sequence[Block]) -> StopScatter:
    """Return the scatter of a calibration's readings for each block of other readings."""
    repeatability = known.station.repeatability
    if repeatability is None:
        return StopScatter.none(len(blocks))
    found = repeatability.scatter
    if known.sensor_kind == kind:
        return found
    units = [block.unit for block in blocks_of(known.sensor_kind)]
    places = [units.index(block.unit) if block.unit in units else -1 for block in blocks]

    def taken(values: np.ndarray) -> np.ndarray:
        return np.array([values[k] if k >= 0 else 0.0 for k in places])

    return StopScatter(
        within=taken(found.within),
        between=taken(found.between),
        within_degrees=taken(found.within_degrees),
        between_degrees=taken(found.between_degrees),
        readings=found.readings,
        stops=found.stops,
        shared=found.shared,
        drives=found.drives,
        of_single=found.of_single,
    )


def _degrees(known: FittedRobot, blocks: Sequence[Block]) -> float:
    """Return the degrees of freedom of a calibration's noise."""
    size = sum(block.size for block in blocks)
    rows = count(known.rows)
    return max(rows * size - float(known.estimate.free.sum()), 1.0) if rows else CHANGES.degrees
