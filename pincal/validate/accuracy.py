"""Errors of a model at measured poses, in the words and units that people use.

The error at a pose is the distance between the predicted and the measured target: the pose accuracy of position of
ISO 9283 for a single measurement (for replicates and repeatability see :mod:`pincal.validate.replicates`). Orientation
likewise, as one angle.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from numpy.typing import ArrayLike

from pincal.identify.station import Station
from pincal.units import readable_unit


def pose_errors(station: Station, values: np.ndarray) -> dict[str, np.ndarray]:
    """Return the size of the error at each row, in mm for what is measured in metres, in mrad for angles, in px for images.

    Args:
        station: model and readings.
        values: shape (P,), its parameters.

    Returns:
        Block name ("position", "orientation", "distance", "image") -> shape (N,). An image's errors also stand as
        "position": what they are across the view at the distance of the point.
    """
    residuals = station.residuals(values)
    ends = np.cumsum([0, *(block.size for block in station.sensor.blocks)])
    found = {
        block.name: np.linalg.norm(residuals[a : a + block.size], axis=0) * readable_unit(block.unit).factor
        for block, a in zip(station.sensor.blocks, ends, strict=False)
    }
    if station.sensor.blocks[0].unit == "m":
        return found
    return {"position": np.linalg.norm(station.displacements(values), axis=1) * readable_unit("m").factor} | found


def error_table(station: Station, values: np.ndarray) -> dict[str, float]:
    """Return the statistics of the errors as :func:`pose_errors` has them, by name and unit; empty without rows.

    Returns:
        ``mean_mm``, ``median_mm``, ``rms_mm``, ``p95_mm`` (95th percentile) and ``max_mm``; for orientations ``mean_mrad``
        and so on, for images ``mean_px`` and so on.
    """
    return error_statistics([pose_error_sizes(station, values)])


def pose_error_sizes(station: Station, values: np.ndarray) -> dict[str, np.ndarray]:
    """Return the size of the error at each row by its unit, "mm", "mrad" or "px", shape (N,) each; empty without rows."""
    units = {block.name: readable_unit(block.unit).name for block in station.sensor.blocks}
    found = pose_errors(station, values) if len(station) else {}
    return {units.get(block, "mm"): sizes for block, sizes in found.items()}


def error_statistics(parts: Iterable[Mapping[str, ArrayLike]]) -> dict[str, float]:
    """Return the statistics of errors by unit, as :func:`pose_error_sizes` has them, of several stations together."""
    errors: dict[str, list[ArrayLike]] = {}
    for part in parts:
        for unit, sizes in part.items():
            errors.setdefault(unit, []).append(sizes)
    return {name: value for unit, of_unit in errors.items() for name, value in _statistics(np.concatenate(of_unit), unit)}


def _statistics(errors: np.ndarray, unit: str) -> Iterator[tuple[str, float]]:
    yield f"mean_{unit}", float(np.mean(errors))
    yield f"median_{unit}", float(np.median(errors))
    yield f"rms_{unit}", float(np.sqrt(np.mean(errors**2)))
    yield f"p95_{unit}", float(np.percentile(errors, 95))
    yield f"max_{unit}", float(np.max(errors))
