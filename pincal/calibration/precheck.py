"""Precheck of tables before they are fitted: coverage, rank, expected uncertainty."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from msgspec import to_builtins

from pincal.calibration.assessed_station import noise_of
from pincal.calibration.calibration import unobservable
from pincal.calibration.caveats import findings_on_tools
from pincal.calibration.held_out import WAYS, StationRows, headline_of, nominal_errors
from pincal.identify.calibrate import Tables, expected_fit, tables_of
from pincal.identify.explain import Reason, Status, explain
from pincal.identify.fit import ModelFit
from pincal.identify.folds import Folds
from pincal.identify.options import Options
from pincal.measure.admit import admit
from pincal.measure.measurements import Measurements
from pincal.model.catalogue.masses import notes_on_masses
from pincal.model.conditions import distinct_values
from pincal.notes import Note, doubts_first
from pincal.robot.robot import Robot
from pincal.satellites import Place
from pincal.validate.accuracy import error_statistics, pose_error_sizes
from pincal.validate.agreement import check_agreement, refuse_exact


class Further(Protocol):
    """What a satellite finds in tables in addition."""

    @property
    def notes(self) -> Sequence[Note | str]:
        """Notes for the user."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain data."""

    def blocks(self, report: DataReport) -> Iterator[object]:
        """Yield what a terminal shows of it."""


# What satellites find in addition, from the robot and a fit of base and tool, by the name under
# which it is reported.
_FURTHER: Place[Callable[[Robot, ModelFit], Further]] = Place("prechecks")


@dataclass(frozen=True)
class JointRange:
    """Range and limits of a joint's positions in a table in its unit, "rad" or "m", and the number
    of distinct ones.
    """

    joint: str
    low: float
    high: float
    lower_limit: float | None
    upper_limit: float | None
    distinct: int
    unit: str


@dataclass(frozen=True)
class Expectation:
    """Expected standard deviation of one parameter at these poses, in SI units, and its status."""

    name: str
    unit: str
    sigma: float
    status: Status
    reason: Reason
    effect: str


@dataclass(frozen=True)
class DataReport:
    """Precheck of tables.

    Attributes:
        kind: what was measured.
        rows: number of rows.
        joints: coverage of each joint.
        nominal: errors with only base and tool fitted, each pose predicted by a fit without it, as
            a calibration has them: of the way of leaving rows out in which they are larger.
        ways: these by each way, "regions", "stretches", ...; empty if no row can be left out, and
            ``nominal`` is then of the rows that were used.
        noise: standard deviations, declared or of a preliminary fit, and their origin.
        rank: number of directions that the poses determine better than the priors do.
        released: number of parameters that a fit would release.
        condition: condition number of the determined directions.
        parameters: expected uncertainty of each.
        further: what satellites find in addition, by name.
        warnings: further messages, doubts first.
    """

    kind: str
    rows: int
    joints: tuple[JointRange, ...]
    nominal: dict[str, float]
    ways: dict[str, dict[str, float]]
    noise: dict[str, Any]
    rank: int
    released: int
    condition: float
    parameters: tuple[Expectation, ...]
    further: Mapping[str, Further]
    warnings: tuple[Note, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the precheck as plain data."""
        own = vars(self) | {
            "joints": [vars(joint) for joint in self.joints],
            "parameters": [vars(p) | {"reason": str(p.reason)} for p in self.parameters],
        }
        told = [name for name in own if name not in ("further", "warnings")]
        return {
            **{name: own[name] for name in told},
            **{name: found.to_dict() for name, found in self.further.items()},
            "warnings": to_builtins(self.warnings),
        }


def precheck(robot: Robot, measurements: Tables, options: Options) -> DataReport:
    """Check tables as a calibration with these options would, fitting only base and tool; errors as
    of a calibration.
    """
    admitted = admit(robot, tables_of(measurements), lambda name: options.at(name).setup)
    tables = admitted.tables
    fit = expected_fit(robot, tables, options)
    corrected = check_agreement(robot, tables.values(), fit)
    if corrected is not None:
        robot = corrected.of(robot)
        fit = expected_fit(robot, tables, options)
    refuse_exact(fit)
    notes: list[Note | str] = [*(() if corrected is None else corrected.notes)]
    notes += [*admitted.notes, *admitted.idle]
    notes += [*unobservable(tables, options), *notes_on_masses(robot, options.effects)]
    notes += [found.note for found in findings_on_tools(fit)]
    further = {name: _FURTHER[name](robot, fit) for name in _FURTHER.names()}
    notes += [note for found in further.values() for note in found.notes]
    posterior = fit.solution.posterior
    ways = _nominal_by_way(fit, tables)
    return DataReport(
        kind=" and ".join(dict.fromkeys(table.kind for table in tables.values())),
        rows=sum(map(len, tables.values())),
        joints=tuple(_ranges(robot, fit.problem.conditions.q)),
        nominal=ways[headline_of(ways)] if ways else _nominal_of_fitted(fit),
        ways=ways,
        noise=_noise(fit),
        rank=posterior.identifiable_rank,
        released=int(fit.solution.free.sum()),
        condition=posterior.condition,
        parameters=tuple(_expectations(fit)),
        further=further,
        warnings=doubts_first([*robot.notes, *notes]),
    )


def _noise(fit: ModelFit) -> dict[str, Any]:
    """Return the noise of a single reading: declared, that of repeated poses, or of a preliminary
    fit, which is to means of poses.
    """
    found: dict[str, Any] = dict(noise_of(fit))
    declared = found["declared"]
    repeated = {
        name: found[f"repeated_{name}"]
        for name in found
        if f"repeated_{name}" in found and name not in declared
    }
    if not fit.is_declared and not repeated:
        found["source"] = "estimated from a preliminary fit"
    return found | repeated


def _nominal_by_way(
    fit: ModelFit, tables: Mapping[str, Measurements]
) -> dict[str, dict[str, float]]:
    """Return the errors of the nominal robot at rows that were not used to place it, by each way of
    leaving rows out.
    """
    rows = [
        replace(StationRows.of(name, table), name=at.name)
        for (name, table), at in zip(tables.items(), fit.problem.stations, strict=True)
    ]
    return nominal_errors(fit, rows, Folds.of(fit.problem, WAYS["both"]))


def _nominal_of_fitted(fit: ModelFit) -> dict[str, float]:
    """Return the errors of the nominal robot at the rows that were used to place it."""
    return error_statistics(
        pose_error_sizes(at, fit.nominal.values[places]) for at, places, _ in fit.stations
    )


def _ranges(robot: Robot, poses: np.ndarray) -> Iterator[JointRange]:
    """Yield the coverage of each joint, infinite limits as None, and those of joints that follow
    from others, whose range is that of these.
    """
    bounds = np.full((2, robot.n_joints), np.inf)
    bounds[:, robot.own_joints] = robot.lower[robot.own_joints], robot.upper[robot.own_joints]
    joints = zip(robot.joint_names, robot.joint_units, strict=True)
    for (name, unit), q, *limits in zip(joints, poses.T, *bounds, strict=True):
        lower, upper = (float(limit) if np.isfinite(limit) else None for limit in limits)
        covered = (float(q.min()), float(q.max()))
        yield JointRange(name, *covered, lower, upper, distinct_values(q), unit)


def _expectations(fit: ModelFit) -> Iterator[Expectation]:
    for p, sigma, finding in zip(
        fit.problem.parameters, fit.estimate.sigma, explain(fit), strict=True
    ):
        known = float(sigma) if np.isfinite(sigma) else 0.0
        yield Expectation(p.name, p.unit, known, finding.status, finding.reason, p.effect)
