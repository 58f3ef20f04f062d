"""What a table of measurements is worth before it is fitted: coverage, rank, what can't be told and why."""

from __future__ import annotations

import warnings
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pincal.errors import PincalWarning
from pincal.identify.agreement import check_agreement
from pincal.identify.calibrate import Fit, Options, foresee
from pincal.identify.explain import explain
from pincal.measure.measurements import Measurements
from pincal.report.run import check_count, check_table
from pincal.report.validation import error_table
from pincal.robot.robot import Robot


@dataclass(frozen=True)
class JointRange:
    """How much of a joint's range a table covers [rad or m]."""

    joint: str
    low: float
    high: float
    lower_limit: float | None
    upper_limit: float | None


@dataclass(frozen=True)
class Expectation:
    """What these poses can tell of one parameter, whatever its value: sigma in SI units."""

    name: str
    unit: str
    sigma: float
    status: str
    reason: str


@dataclass(frozen=True)
class Survey:
    """What a table can tell.

    Attributes:
        kind: what was measured.
        rows: number of rows.
        joints: coverage of each joint.
        nominal: errors with base and tool fitted alone.
        noise: standard deviation that the expectations rest on [m], and where it comes from.
        rank: directions that the poses determine better than what is known beforehand.
        released: parameters that a fit would release.
        condition: of the determined directions.
        parameters: what to expect of each.
        warnings: in words.
    """

    kind: str
    rows: int
    joints: tuple[JointRange, ...]
    nominal: dict[str, float]
    noise: dict[str, Any]
    rank: int
    released: int
    condition: float
    parameters: tuple[Expectation, ...]
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the survey as plain data."""
        return asdict(self)


def survey(robot: Robot, measurements: Measurements, options: Options) -> Survey:
    """Look at a table as a calibration would, without fitting more than base and tool.

    Args:
        robot: the arm.
        measurements: the table.
        options: how it would be calibrated.

    Raises:
        BadInputError: as a calibration would.
    """
    check_count(robot, measurements)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_table(robot, measurements)
    fit = foresee(robot, measurements, options)
    check_agreement(robot, measurements, fit)
    notes = [str(w.message) for w in caught if issubclass(w.category, PincalWarning)]
    posterior = fit.solution.posterior
    sigma = options.sigma
    return Survey(
        kind=measurements.kind,
        rows=len(measurements),
        joints=_ranges(robot, measurements),
        nominal=error_table(fit.problem, fit.nominal.values),
        noise={"sigma_m": float(fit.solution.sigma[0]), "source": "declared" if sigma else "foreseen by a fit"},
        rank=posterior.told,
        released=int(fit.solution.free.sum()),
        condition=posterior.condition,
        parameters=_expectations(fit),
        warnings=tuple(dict.fromkeys([*robot.notes, *notes])),
    )


def _ranges(robot: Robot, measurements: Measurements) -> tuple[JointRange, ...]:
    return tuple(
        JointRange(
            name,
            float(measurements.q[:, i].min()),
            float(measurements.q[:, i].max()),
            float(robot.lower[i]) if np.isfinite(robot.lower[i]) else None,
            float(robot.upper[i]) if np.isfinite(robot.upper[i]) else None,
        )
        for i, name in enumerate(robot.joint_names)
    )


def _expectations(fit: Fit) -> tuple[Expectation, ...]:
    sigma = np.where(np.isfinite(fit.priors.sizes), fit.priors.sizes, 0.0)
    sigma[fit.solution.free] = np.sqrt(np.diag(fit.solution.posterior.covariance))
    return tuple(
        Expectation(p.name, p.unit, float(s), f.status, f.reason)
        for p, s, f in zip(fit.problem.parameters, sigma, explain(fit), strict=True)
    )
