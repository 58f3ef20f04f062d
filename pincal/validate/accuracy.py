"""Errors of a model at measured poses, in the words and units that people use.

The error at a pose is the distance between the predicted and the measured target: the pose accuracy of position of
ISO 9283 for a single measurement (for replicates and repeatability see :mod:`pincal.validate.replicates`). Orientation
likewise, as one angle.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from pincal.identify.station import Station
from pincal.units import readable_unit


@dataclass(frozen=True)
class Errors:
    """Statistics of the errors at N poses.

    Attributes:
        unit: "mm" or "mrad".
        mean, median, rms, p95, max: of the errors, in this unit.
        rows: N.
    """

    unit: str
    mean: float
    median: float
    rms: float
    p95: float
    max: float
    rows: int

    @classmethod
    def of(cls, errors: np.ndarray, unit: str) -> Errors:
        """Return the statistics of errors, shape (N,), given in ``unit``."""
        if len(errors) == 0:
            raise ValueError("no rows to take errors of")
        return cls(
            unit,
            float(np.mean(errors)),
            float(np.median(errors)),
            float(np.sqrt(np.mean(errors**2))),
            float(np.percentile(errors, 95)),
            float(np.max(errors)),
            len(errors),
        )

    def named(self) -> dict[str, float]:
        """Return the statistics by name and unit: ``mean_mm`` and so on."""
        values = asdict(self)
        return {f"{name}_{self.unit}": values[name] for name in ("mean", "median", "rms", "p95", "max")}


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


def statistics(station: Station, values: np.ndarray) -> list[Errors]:
    """Return the statistics of the errors as :func:`pose_errors` has them, those in mm first; empty without rows."""
    if len(station) == 0:
        return []
    units = {block.name: readable_unit(block.unit).name for block in station.sensor.blocks}
    return [Errors.of(errors, units.get(name, "mm")) for name, errors in pose_errors(station, values).items()]


def error_table(station: Station, values: np.ndarray) -> dict[str, float]:
    """Return the statistics of all blocks in one dictionary: ``mean_mm``, ..., and ``mean_mrad``, ... for poses."""
    return {name: value for errors in statistics(station, values) for name, value in errors.named().items()}
