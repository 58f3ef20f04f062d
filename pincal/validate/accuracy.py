"""Errors of a model at measured poses, in the words and units that people use.

The error at a pose is the distance between the predicted and the measured target: the pose accuracy of position of
ISO 9283 for a single measurement (for replicates and repeatability see :mod:`pincal.validate.replicates`). Orientation
likewise, as one angle.
"""

from __future__ import annotations

import numpy as np

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
    if len(station) == 0:
        return {}
    units = {block.name: readable_unit(block.unit).name for block in station.sensor.blocks}
    found: dict[str, float] = {}
    for block, errors in pose_errors(station, values).items():
        statistics = {
            "mean": np.mean(errors),
            "median": np.median(errors),
            "rms": np.sqrt(np.mean(errors**2)),
            "p95": np.percentile(errors, 95),
            "max": np.max(errors),
        }
        found |= {f"{name}_{units.get(block, 'mm')}": float(value) for name, value in statistics.items()}
    return found
