"""Errors of a model at measured poses, in the words and units that people use.

The error at a pose is the distance between the predicted and the measured target: the pose accuracy of position of
ISO 9283 for a single visit (its repeatability needs replicates). Orientation likewise, as one angle.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from pincal.identify.problem import Problem

_BLOCK_UNITS = {"m": (1e3, "mm"), "rad": (1e3, "mrad")}


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


def pose_errors(problem: Problem, values: np.ndarray) -> dict[str, np.ndarray]:
    """Return the size of the error at each row, in mm for what is measured in metres and in mrad for angles.

    Args:
        problem: model and readings.
        values: shape (P,), its parameters.

    Returns:
        Block name ("position", "orientation", "distance") -> shape (N,).
    """
    residuals = problem.residuals(values)
    ends = np.cumsum([0, *(block.size for block in problem.sensor.blocks)])
    return {
        block.name: np.linalg.norm(residuals[a : a + block.size], axis=0) * _BLOCK_UNITS[block.unit][0]
        for block, a in zip(problem.sensor.blocks, ends, strict=False)
    }


def statistics(problem: Problem, values: np.ndarray) -> list[Errors]:
    """Return the statistics of each block's errors; empty without rows."""
    if len(problem) == 0:
        return []
    errors = pose_errors(problem, values)
    return [Errors.of(errors[b.name], _BLOCK_UNITS[b.unit][1]) for b in problem.sensor.blocks]


def error_table(problem: Problem, values: np.ndarray) -> dict[str, float]:
    """Return the statistics of all blocks in one dictionary: ``mean_mm``, ..., and ``mean_mrad``, ... for poses."""
    return {name: value for errors in statistics(problem, values) for name, value in errors.named().items()}
