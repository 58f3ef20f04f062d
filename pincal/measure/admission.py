"""Rows that can tell something: the others are left out with a warning, and all remaining rows are still processed.

What a kind of measurement can't determine, however many rows there are, is said here, too. The rules are the sensors' own.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator

import numpy as np

from pincal.errors import MeasurementError, PincalWarning
from pincal.measure.measurements import Measurements
from pincal.measure.sensing import sensor_like, sensor_of
from pincal.measure.sensor import Excluded, Filtered
from pincal.measure.setup import Setup

# Lines that a warning lists.
_LISTED = 8


def usable_rows(measurements: Measurements, setup: Setup) -> Measurements:
    """Return the rows that can tell something; each reason to leave rows out causes a `PincalWarning`.

    Left out are points behind the camera, sockets that were touched only once, unknown points that were seen only once, and
    unknown anchors of fewer than four distances.

    Args:
        measurements: the table.
        setup: named points that are known.

    Raises:
        MeasurementError: if no row is left.
    """
    kind = measurements.sensor
    if kind is None or not issubclass(kind, Filtered):
        return measurements
    sensor = sensor_of(measurements, setup.over(measurements))
    assert isinstance(sensor, Filtered)
    kept, expected = _kept(measurements, sensor.unusable_rows())
    if not kept.any():
        raise MeasurementError(f"{measurements.source}: no row is left; expected {expected}")
    return measurements if kept.all() else measurements.select(kept)


def scorable_rows(measurements: Measurements, setup: Setup) -> Measurements:
    """Return the rows that a calibration can be judged by; rows left out cause a `PincalWarning`.

    A socket that the calibration did not have is judged by the mean of its rows, so it needs two; any other point that it
    did not have can't be judged.

    Args:
        measurements: rows that it never saw.
        setup: the points that it had.
    """
    kept, _ = _kept(measurements, _unscorable(measurements, setup))
    return measurements if kept.all() else measurements.select(kept)


def scorable(measurements: Measurements, setup: Setup) -> np.ndarray:
    """Return which rows a calibration can be judged by, shape (N,), as :func:`scorable_rows` has it, without warnings."""
    lost = np.zeros(len(measurements), bool)
    for part in _unscorable(measurements, setup):
        lost |= part.rows
    return ~lost


def _unscorable(measurements: Measurements, setup: Setup) -> Iterator[Excluded]:
    kind = measurements.sensor
    if kind is not None and issubclass(kind, Filtered) and len(measurements):
        yield from kind.unscorable_rows(measurements, setup)


def unobservable_notes(measurements: Measurements, setup: Setup) -> Iterator[str]:
    """Yield what measurements of this kind can't determine, in words.

    Args:
        measurements: the table.
        setup: named points, distances and camera, as far as they are known.
    """
    return sensor_like(measurements, setup).unobservable()


def _kept(measurements: Measurements, excluded: Iterable[Excluded]) -> tuple[np.ndarray, str]:
    """Return which rows are kept, shape (N,), and what more of would be needed; warn of the others."""
    kept, expected = np.ones(len(measurements), bool), ""
    for part in excluded:
        kept &= ~part.rows
        expected = part.expected
        if part.rows.any():
            lines = measurements.rows[part.rows]
            listed = ", ".join(str(line) for line in lines[:_LISTED]) + (" ..." if len(lines) > _LISTED else "")
            text = f"{measurements.source}: {len(lines)} rows {part.reason} and are left out: lines {listed}"
            warnings.warn(text, PincalWarning, stacklevel=3)
    return kept, expected
