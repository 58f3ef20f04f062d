"""Detect jumps in the clock of an instrument that reads an arm in motion, by the calibrated arm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pincal.errors import MeasurementError
from pincal.identify.fit import ModelFit
from pincal.identify.station import Station
from pincal.measure.clock_jump import OFTEN, Jump, sure_jumps
from pincal.measure.measurements import Measurements
from pincal.measure.reading_numbers import JUMPS
from pincal.recorded import Moving
from pincal.thresholds import Count
from pincal.validate.midway_numbers import MIDWAY

# Rows that suffice to detect one.
_ROWS: Count = 2_000


@dataclass(frozen=True)
class SteppingClock:
    """A clock as it is fitted to a table, with steps that the table lacks.

    Residuals are linear in a clock near its true one only, which it may not have been by fewer
    steps.

    Attributes:
        clock: offset [s], drift [1] and the stamp about which it drifts [s], see
            :class:`pincal.recorded.Moving`.
        steps: the stamp of the first reading after each, and what it adds to stamps from there on
            [s].
    """

    clock: tuple[float, float, float]
    steps: tuple[tuple[float, float], ...]


class SteppingClocksError(MeasurementError):
    """Clocks that step where the tables have no step: with them the tables are to be fitted again.

    Attributes:
        clocks: of each such station.
    """

    def __init__(self, message: str, clocks: Mapping[str, SteppingClock]) -> None:
        super().__init__(message)
        self.clocks = clocks


def check_clocks(tables: Mapping[str, Measurements], fit: ModelFit) -> None:
    """Refuse tables whose clocks jump, given the rows of each station and their calibration.

    A nominal arm shows only large jumps (:func:`pincal.motion.clocks.aligned`); residuals of the
    calibrated one show jumps by a single image.

    Raises:
        SteppingClocksError: naming the row from which on a clock is shifted.
        MeasurementError: for a clock that jumps more often than one does.
    """
    found = dict[str, SteppingClock]()
    words = list[str]()
    solution = fit.solution
    for (name, table), (station, places, blocks) in zip(tables.items(), fit.stations, strict=True):
        at = _FittedClock(
            station, solution.values[places], solution.free[places], solution.estimated[blocks]
        )
        stepping = at.stepping(table)
        if stepping is not None:
            text, found[name] = stepping
            words.append(text)
    if found:
        advice = "give the parts before and after as separate sessions"
        raise SteppingClocksError(f"{'; '.join(words)}; {advice}", found)


def stepping_clock(
    table: Measurements,
    station: Station,
    values: np.ndarray,
    free: np.ndarray,
    noise: np.ndarray,
) -> SteppingClock | None:
    """Return the clock of a table in motion with all its steps, if residuals show further ones
    than it has; else None.

    Args:
        table: the rows.
        station: the calibrated model over them.
        values: of its parameters, shape (P,).
        free: which of these were fitted to the rows, shape (P,).
        noise: of the blocks of readings, shape (blocks,), in their units.

    Raises:
        MeasurementError: for a clock that jumps more often than one does.
    """
    stepping = _FittedClock(station, values, free, noise).stepping(table)
    return None if stepping is None else stepping[1]


@dataclass(frozen=True, eq=False)
class _FittedClock:
    """The clock of a station with a fit of its parameters; attributes as the arguments of
    :func:`stepping_clock`.
    """

    station: Station
    values: np.ndarray
    free: np.ndarray
    noise: np.ndarray

    def stepping(self, table: Measurements) -> tuple[str, SteppingClock] | None:
        """Return the first new jump of a table's clock in words, and the clock with all steps; None
        without a new one.

        Raises:
            MeasurementError: for more steps than a clock has.
        """
        if table.moving is None or table.time is None or not (self._is("offset") & self.free).any():
            return None
        rows = _Linear.of(self.station.sample(_ROWS), self.values, self.free, self.noise)
        known = [at for at, _ in table.moving.steps]
        jumps = rows.jumps(self._is("offset"), known)
        if not jumps:
            return None
        line = table.rows[table.time >= jumps[0].time].min(initial=table.rows.max())
        text = f"{table.source}, about line {line}: {jumps[0]}"
        fitted = self._fitted(table.moving, rows.beside(self.values, self._is("offset"), jumps))
        if len(fitted.steps) + len(jumps) > JUMPS.most:
            raise MeasurementError(f"{text}, {OFTEN}")
        steps = (*fitted.steps, *((jump.time, jump.size) for jump in jumps))
        return text, replace(fitted, steps=steps)

    def _is(self, symbol: str) -> np.ndarray:
        """Return which parameter is this one of the clock, shape (P,)."""
        return np.array(
            [p.element == "clock" and p.symbol == symbol for p in self.station.parameters]
        )

    def _fitted(self, moving: Moving, values: np.ndarray) -> SteppingClock:
        """Return the clock of a motion with what values of parameters, shape (P,), add to it."""

        def added(symbol: str) -> float:
            return float(values[self._is(symbol)].sum())

        offset, drift, middle = moving.clock
        steps = tuple(
            (at, size + added(f"step_{number}"))
            for number, (at, size) in enumerate(moving.steps, 1)
        )
        return SteppingClock((offset + added("offset"), drift + added("drift"), middle), steps)


@dataclass(frozen=True, eq=False)
class _Linear:
    """Readings of a station in units of their noise, linear in its p free parameters.

    Attributes:
        time: stamps, shape (N,) [s].
        left: residuals, shape (N, m).
        columns: derivatives, shape (N, m, p).
        free: which parameters these are, shape (P,).
    """

    time: np.ndarray
    left: np.ndarray
    columns: np.ndarray
    free: np.ndarray

    @classmethod
    def of(
        cls, station: Station, values: np.ndarray, free: np.ndarray, noise: np.ndarray
    ) -> _Linear:
        assert station.conditions.time is not None
        parts = [
            (left.T, columns.transpose(2, 1, 0))
            for _, left, columns in station.linearise(values, free)
        ]
        scale = station.weights[:, None] / np.repeat(noise, station.block_sizes)
        left, columns = (np.concatenate(of) for of in zip(*parts, strict=True))
        return cls(station.conditions.time, left * scale, columns * scale[:, :, None], free)

    def _rate(self, is_offset: np.ndarray) -> np.ndarray:
        """Return the derivatives of readings by time, shape (N, m), those by the clock's offset."""
        return np.asarray(self.columns[:, :, np.argmax(is_offset[self.free])])

    def jumps(self, is_offset: np.ndarray, known: Sequence[float]) -> list[Jump]:
        """Return the jumps of the clock, whose offset is one of the parameters (mask), beside those
        known at some stamps [s].
        """
        left = self.left
        Q = np.linalg.qr(self.columns.reshape(left.size, -1))[0]

        def projected(steps: np.ndarray) -> np.ndarray:
            flat = steps.reshape(left.size, -1)
            return np.asarray((flat - Q @ (Q.T @ flat)).reshape(steps.shape))

        rate = self._rate(is_offset)
        return sure_jumps(self.time, left, rate, projected, MIDWAY.clock, known)

    def beside(
        self, values: np.ndarray, is_offset: np.ndarray, jumps: Sequence[Jump]
    ) -> np.ndarray:
        """Return the values of parameters, shape (P,), that fit readings beside some jumps."""
        shifts = sum(jump.size * (self.time >= jump.time) for jump in jumps)
        left = self.left - self._rate(is_offset) * np.asarray(shifts)[:, None]
        A = self.columns.reshape(left.size, -1)
        sizes = np.maximum(np.linalg.norm(A, axis=0), 1e-300)
        found = values.copy()
        found[self.free] += np.linalg.lstsq(A / sizes, left.ravel(), rcond=1e-9)[0] / sizes
        return found
