"""Detect jumps in the clock of an instrument that reads an arm in motion, by the calibrated arm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pincal.errors import MeasurementError
from pincal.identify.criteria import MIDWAY
from pincal.identify.fit import ModelFit
from pincal.identify.station import Station
from pincal.measure.clock_jump import OFTEN, Jump, sure_jumps
from pincal.measure.measurements import Measurements
from pincal.measure.reading_numbers import JUMPS
from pincal.thresholds import Count

# Rows that suffice to detect one.
_ROWS: Count = 2_000


class SteppingClocksError(MeasurementError):
    """Clocks that step where the tables have no step: with them the tables are to be fitted again.

    Attributes:
        steps: of the clock of each such station, the stamp of the first reading after each step and
            what it adds to stamps from there on [s].
    """

    def __init__(self, message: str, steps: Mapping[str, tuple[tuple[float, float], ...]]) -> None:
        super().__init__(message)
        self.steps = steps


def check_clocks(tables: Mapping[str, Measurements], fit: ModelFit) -> None:
    """Refuse tables whose clocks jump, given the rows of each station and their calibration.

    A nominal arm shows only large jumps (:func:`pincal.motion.clocks.aligned`); residuals of the
    calibrated one show jumps by a single image.

    Raises:
        SteppingClocksError: naming the row from which on a clock is shifted.
        MeasurementError: for a clock that jumps more often than one does.
    """
    found = dict[str, tuple[tuple[float, float], ...]]()
    words = list[str]()
    for k, (name, table) in enumerate(tables.items()):
        jumps = _jumps(fit, k, table)
        if not jumps or table.time is None:
            continue
        line = table.rows[table.time >= jumps[0].time].min(initial=table.rows.max())
        text = f"{table.source}, about line {line}: {jumps[0]}"
        known = _fitted_steps(fit, k, table)
        if len(known) + len(jumps) > JUMPS.most:
            raise MeasurementError(f"{text}, {OFTEN}")
        found[name] = (*known, *((jump.time, jump.size) for jump in jumps))
        words.append(text)
    if found:
        advice = "give the parts before and after as separate sessions"
        raise SteppingClocksError(f"{'; '.join(words)}; {advice}", found)


def _fitted_steps(fit: ModelFit, k: int, table: Measurements) -> list[tuple[float, float]]:
    """Return the steps that a table has, with what the fit of the k-th station adds to each."""
    assert table.moving is not None
    station, places, _ = list(fit.stations)[k]
    values = dict(
        zip((p.symbol for p in station.parameters), fit.values[places].tolist(), strict=True)
    )
    return [
        (at, size + values.get(f"step_{number}", 0.0))
        for number, (at, size) in enumerate(table.moving.steps, 1)
    ]


def _jumps(fit: ModelFit, k: int, table: Measurements) -> list[Jump]:
    """Return the jumps of the clock of the k-th station, whose offset is fitted."""
    solution = fit.solution
    station, places, blocks = list(fit.stations)[k]
    is_offset = np.array(
        [p.element == "clock" and p.symbol == "offset" for p in station.parameters]
    )
    if not (is_offset & solution.free[places]).any() or table.time is None:
        return []
    assert table.moving is not None
    return _jumps_of(
        station.sample(_ROWS),
        [at for at, _ in table.moving.steps],
        solution.values[places],
        solution.free[places],
        is_offset,
        solution.estimated[blocks],
    )


def _jumps_of(
    station: Station,
    known: Sequence[float],
    values: np.ndarray,
    free: np.ndarray,
    is_offset: np.ndarray,
    noise: np.ndarray,
) -> list[Jump]:
    """Return the jumps of a station's clock, whose offset is one of the free parameters (masks),
    beside those known at some stamps [s].
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

    rate = columns[:, :, np.argmax(is_offset[free])]
    return sure_jumps(station.conditions.time, left, rate, projected, MIDWAY.clock, known)
