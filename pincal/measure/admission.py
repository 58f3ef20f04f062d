"""Rows that have to do with named points: those that can tell nothing are left out with a word, the others served.

What a kind of measurement can't determine, however many rows there are, is said here, too.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator

import numpy as np

from pincal.errors import MeasurementError, PincalWarning
from pincal.measure.measurements import Measurements
from pincal.measure.setup import Setup, point_names

# Readings of one unknown point from which on some are left over to judge the robot by.
_FEWEST = {"socket": 2, "camera_point": 2, "camera_pixel": 2, "distance": 4}
_WHAT = {"socket": "a socket", "camera_point": "a point", "camera_pixel": "a point", "distance": "an anchor"}
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
    names = point_names(measurements)
    if names is None:
        return measurements
    keep = np.ones(len(measurements), bool)
    if measurements.camera_point is not None:
        keep &= measurements.camera_point[:, 2] > 0.0
        _tell(measurements, ~keep, "have cz <= 0, a point behind the camera")
    fewest = _FEWEST[measurements.kind]
    found, inverse, count = np.unique(names[keep], return_inverse=True, return_counts=True)
    poor = (count < fewest) & np.array([setup.points.get(str(name)) is None for name in found], bool)
    lonely = np.zeros(len(measurements), bool)
    lonely[keep] = poor[inverse]
    listed = ", ".join(str(name) for name in found[poor][:_LISTED]) + (" ..." if poor.sum() > _LISTED else "")
    what = _WHAT[measurements.kind]
    _tell(measurements, lonely, f"are of {what} with fewer than {fewest} readings, which only place it ({listed})")
    if not np.any(keep & ~lonely):
        raise MeasurementError(
            f"{measurements.source}: no row is left; expected {fewest} readings and more of {what}, in other poses"
        )
    return measurements if np.all(keep & ~lonely) else measurements.select(keep & ~lonely)


def scorable_rows(measurements: Measurements, setup: Setup) -> Measurements:
    """Return the rows that a calibration can be judged by; rows left out cause a `PincalWarning`.

    A socket that the calibration did not have is judged by the mean of its rows, so it needs two; any other point that it
    did not have can't be judged.

    Args:
        measurements: rows that it never saw.
        setup: the points that it had.
    """
    names = point_names(measurements)
    if names is None or not len(measurements):
        return measurements
    found, inverse, count = np.unique(names, return_inverse=True, return_counts=True)
    is_new = np.array([str(name) not in setup.points for name in found], bool)
    lost = (is_new & ((count < 2) | (measurements.socket is None)))[inverse]
    listed = ", ".join(sorted(set(map(str, names[lost])))[:_LISTED])
    _tell(measurements, lost, f"are of points that the calibration did not have ({listed})")
    return measurements.select(~lost) if lost.any() else measurements


def _tell(measurements: Measurements, rows: np.ndarray, reason: str) -> None:
    if rows.any():
        lines = ", ".join(str(line) for line in measurements.rows[rows][:_LISTED]) + (" ..." if rows.sum() > _LISTED else "")
        text = f"{measurements.source}: {rows.sum()} rows {reason} and are left out: lines {lines}"
        warnings.warn(text, PincalWarning, stacklevel=3)


def unobservable_notes(measurements: Measurements, setup: Setup) -> Iterator[str]:
    """Yield what measurements of this kind can't determine, in words.

    Args:
        measurements: the table.
        setup: named points, distances and camera, as far as they are known.
    """
    kind, points = measurements.kind, setup.over(measurements).named()
    known = int(points.known.sum())
    if kind == "socket":
        if not known:
            yield "contacts see only the arm against itself: neither where its base stands nor how it is turned"
        if known < 2 and not points.distances:
            yield (
                "contacts without a known length can't tell the scale of the arm, which rests on its nominal lengths: give "
                "the distance of two sockets (--socket-distance A B METRES)"
            )
    if kind == "distance":
        if measurements.anchor is None or not known:
            yield "distances see neither where the base stands nor how it is turned, only the arm against its anchors"
        if measurements.anchor is not None and len(points.names) == 1:
            yield "distances from one anchor see one direction a pose: several anchors all around the arm tell more"
    if kind in ("camera_point", "camera_pixel") and not known:
        yield (
            "the points of the calibration object are not known, so they are found in the robot's base frame; with "
            "--points FILE.csv (columns point x y z) they tell more"
        )
    if kind == "camera_pixel" and not known and not points.distances:
        yield "images of unknown points have no scale of their own: it rests on the nominal lengths of the arm"
    if known and points.are_in_line:
        some = "fewer than three of the named points are known" if known < 3 else "the known points stand in a line"
        yield f"{some}, so a turn of the base about them is undetermined: know one more, off their line"
