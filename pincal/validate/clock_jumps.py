"""Detect jumps in the clock of an instrument that reads an arm in motion, by the calibrated arm."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pincal.errors import MeasurementError
from pincal.identify.criteria import MIDWAY
from pincal.identify.fit import ModelFit
from pincal.identify.station import Station
from pincal.measure.clock_jump import Jump, likeliest_jump
from pincal.measure.measurements import Measurements
from pincal.thresholds import Count

# Rows that suffice to detect one.
_ROWS: Count = 2_000


def check_clocks(tables: Sequence[Measurements], fit: ModelFit) -> None:
    """Refuse a table whose clock jumps, given the rows of each station and their calibration.

    A nominal arm shows only large jumps (:func:`pincal.motion.starts.check_clock`); residuals of
    the calibrated one show jumps by a single image.

    Raises:
        MeasurementError: naming the row from which on the clock is shifted.
    """
    solution = fit.solution
    for (station, places, blocks), table in zip(fit.stations, tables, strict=True):
        is_offset = np.array([p.element == "clock" and p.unit == "s" for p in station.parameters])
        if not (is_offset & solution.free[places]).any() or table.time is None:
            continue
        some = station.sample(_ROWS)
        jump = _jump(
            some,
            solution.values[places],
            solution.free[places],
            is_offset,
            solution.estimated[blocks],
        )
        if jump.is_sure(MIDWAY.clock):
            line = table.rows[table.time >= jump.time].min(initial=table.rows.max())
            raise MeasurementError(f"{table.source}, about line {line}: {jump}")


def _jump(
    station: Station, values: np.ndarray, free: np.ndarray, is_offset: np.ndarray, noise: np.ndarray
) -> Jump:
    """Return the likeliest jump of a station's clock, whose offset is one of the free parameters
    (masks).
    """
    assert station.conditions.time is not None
    parts = [
        (left.T, columns.transpose(2, 1, 0)) for _, left, columns in station.linearise(values, free)
    ]
    scale = station.weights[:, None] / np.repeat(noise, station.block_sizes)
    left, columns = (np.concatenate(of) for of in zip(*parts, strict=True))
    left = left * scale
    columns = columns * scale[:, :, None]
    Q = np.linalg.qr(columns.reshape(left.size, -1))[0]

    def projected(steps: np.ndarray) -> np.ndarray:
        flat = steps.reshape(left.size, -1)
        return np.asarray((flat - Q @ (Q.T @ flat)).reshape(steps.shape))

    return likeliest_jump(
        station.conditions.time, left, columns[:, :, np.argmax(is_offset[free])], projected
    )
