"""What a table of measurements is worth before it is fitted: coverage, rank, what can't be told and why."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from msgspec import to_builtins

from pincal.discover.policy import ALPHA
from pincal.discover.power import FEWEST, POWER, Detectable, minimum_detectable
from pincal.discover.resolution import notes_on_repeats
from pincal.identify.calibrate import Tables, expected_fit, refit, tables_of
from pincal.identify.explain import explain
from pincal.identify.fit import Fit
from pincal.identify.options import Options
from pincal.identify.reasons import Reason, Status
from pincal.measure.admit import admit, unobservable_notes
from pincal.model.catalogue import candidates, untestable
from pincal.model.catalogue.masses import notes_on_masses
from pincal.model.conditions import distinct_values
from pincal.model.effects import ELASTIC
from pincal.notes import Note, doubts_first
from pincal.robot.robot import Robot
from pincal.validate.accuracy import error_statistics, pose_error_sizes
from pincal.validate.agreement import check_agreement


@dataclass(frozen=True)
class JointRange:
    """How much of a joint's range a table covers [rad or m], and at how many distinct positions."""

    joint: str
    low: float
    high: float
    lower_limit: float | None
    upper_limit: float | None
    distinct: int


@dataclass(frozen=True)
class Expectation:
    """What these poses can tell of one parameter, whatever its value: sigma in SI units."""

    name: str
    unit: str
    sigma: float
    status: Status
    reason: Reason
    effect: str


@dataclass(frozen=True)
class DetectabilityTable:
    """What a discovery could find with these poses and this noise.

    Attributes:
        model: "elastic" or "geometric": what is fitted along with every effect.
        sigma_m: the noise that it rests on [m]; of an image, at the distance of its points.
        source: "declared", "estimated" or "assumed".
        alpha: chance of any false name.
        power: chance with which an effect of the size told is found.
        effects: each effect of the catalogue.
    """

    model: str
    sigma_m: float
    source: str
    alpha: float
    power: float
    effects: tuple[Detectable, ...]


@dataclass(frozen=True)
class DataReport:
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
        detectable: how large each effect beyond the model would have to be to be found.
        warnings: what else is to be said, doubts first.
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
    detectable: DetectabilityTable
    warnings: tuple[Note, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the precheck as plain data."""
        return vars(self) | {
            "joints": [vars(joint) for joint in self.joints],
            "parameters": [vars(p) | {"reason": str(p.reason)} for p in self.parameters],
            "warnings": to_builtins(self.warnings),
            "detectable": vars(self.detectable) | {"effects": [found.to_dict() for found in self.detectable.effects]},
        }


def precheck(robot: Robot, measurements: Tables, options: Options) -> DataReport:
    """Look at tables as a calibration would, without fitting more than base and tool.

    Args:
        robot: the arm.
        measurements: the table, or several.
        options: how it would be calibrated.

    Raises:
        BadInputError: as a calibration would.
    """
    admitted = admit(robot, tables_of(measurements), lambda name: options.at(name).setup)
    tables = admitted.tables
    fit = expected_fit(robot, tables, options)
    check_agreement(robot, tables.values(), fit)
    unseen = [list(unobservable_notes(table, options.at(name).setup)) for name, table in tables.items()]
    notes = [*admitted.notes, *admitted.idle, *(n for n in unseen[0] if all(n in other for other in unseen))]
    notes += notes_on_masses(robot, options.effects)
    notes += notes_on_repeats(robot, fit.problem.conditions.q)
    posterior = fit.solution.posterior
    unit = f"sigma_{fit.problem.blocks[0].unit}"
    nominal = (pose_error_sizes(station, fit.nominal.values[places]) for station, places, _ in fit.stations)
    return DataReport(
        kind=" and ".join(dict.fromkeys(table.kind for table in tables.values())),
        rows=len(fit.problem),
        joints=tuple(_ranges(robot, fit.problem.conditions.q)),
        nominal=error_statistics(nominal),
        noise={unit: float(fit.solution.sigma[0]), "source": "declared" if fit.is_declared else "foreseen by a fit"},
        rank=posterior.identifiable_rank,
        released=int(fit.solution.free.sum()),
        condition=posterior.condition,
        parameters=tuple(_expectations(fit)),
        detectable=_outlook(robot, fit),
        warnings=doubts_first([*robot.notes, *notes]),
    )


def _outlook(robot: Robot, fit: Fit) -> DetectabilityTable:
    """Return what could be found beyond the elastic model."""
    base = refit(fit, ELASTIC)
    declared = fit.noise.declared
    assumed = np.array([block.noise for block in base.problem.blocks])
    degrees = base.solution.degrees
    estimated = base.solution.estimated if degrees >= FEWEST else assumed
    sigma = np.array([s if d is None else d for s, d in zip(estimated, declared, strict=True)])
    source = "declared" if fit.is_declared else ("estimated" if degrees >= FEWEST else "assumed")
    chain, conditions = base.problem.chain, base.problem.conditions
    tested = candidates(chain, conditions)
    sights = minimum_detectable(base, tested, sigma=sigma)
    sights += [Detectable(effect, reason=reason) for effect, reason in untestable(chain, conditions)]
    first, places, _ = next(iter(fit.stations))
    sigma_m = float(sigma[0]) * first.metres_per_reading(fit.nominal.values[places])
    return DetectabilityTable("elastic", sigma_m, source, ALPHA, POWER, tuple(sights))


def _ranges(robot: Robot, poses: np.ndarray) -> Iterator[JointRange]:
    """Yield the coverage of each joint; an endless range has no limits."""
    for name, q, *limits in zip(robot.joint_names, poses.T, robot.lower, robot.upper, strict=True):
        lower, upper = (float(limit) if np.isfinite(limit) else None for limit in limits)
        yield JointRange(name, float(q.min()), float(q.max()), lower, upper, distinct_values(q))


def _expectations(fit: Fit) -> Iterator[Expectation]:
    for p, sigma, finding in zip(fit.problem.parameters, fit.estimate.sigma, explain(fit), strict=True):
        known = float(sigma) if np.isfinite(sigma) else 0.0
        yield Expectation(p.name, p.unit, known, finding.status, finding.reason, p.effect)
