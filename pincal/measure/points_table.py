"""Tables of known points, and of known distances between points."""

from __future__ import annotations

import os

import numpy as np

from pincal.errors import MeasurementError
from pincal.measure.reader import read_columns
from pincal.sensors.setup import GAP_SIGMA, KnownDistance, PointPlace


def read_points(path: str | os.PathLike[str]) -> dict[str, PointPlace]:
    """Read positions of named points from a table with columns ``point x y z`` and units in the
    header.

    Raises:
        MeasurementError: if the file can't be read, or a name occurs twice.
    """
    columns = read_columns(path, {"point": "name", "x": "length", "y": "length", "z": "length"})
    places = np.column_stack([columns[axis] for axis in "xyz"]).tolist()
    found: dict[str, PointPlace] = {}
    for name, (x, y, z) in zip(columns["point"], places, strict=True):
        if str(name) in found:
            raise MeasurementError(
                f"{path}: point {str(name)!r} occurs twice; expected each name once"
            )
        found[str(name)] = (x, y, z)
    return found


def read_distances(path: str | os.PathLike[str]) -> tuple[KnownDistance, ...]:
    """Read known distances from a table with columns ``first second distance`` and optionally
    ``sigma``.

    Raises:
        MeasurementError: if the file can't be read, a cell is empty, or a value is invalid.
    """
    quantities = {"first": "name", "second": "name", "distance": "length", "sigma": "length"}
    columns = read_columns(path, quantities, optional=("sigma",), is_whole=True)
    sigma = columns.get("sigma", np.full(len(columns["first"]), GAP_SIGMA))
    rows = zip(columns["first"], columns["second"], columns["distance"], sigma, strict=True)
    try:
        return tuple(KnownDistance(str(a), str(b), float(d), float(s)) for a, b, d, s in rows)
    except MeasurementError as error:
        raise MeasurementError(f"{path}: {error}") from None
