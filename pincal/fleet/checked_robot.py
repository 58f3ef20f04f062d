"""Interim checks of one calibrated robot: its readings on a day against its model, and what all
checks since the calibration show.

What may have moved are the base (or the instrument), the tool with its targets, a drive, and the
length of all links, as by temperature. What the calibration does not know of its parameters and of
what its model lacks is common to all checks, so that a constant error of the model is no change.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import msgspec
import numpy as np

from pincal.calibration.check_record import (
    ALARM,
    CHECKED,
    CheckedChange,
    CheckedRows,
    CheckRecord,
    InterimCheck,
    Withdrawal,
    model_mark,
    required_day,
)
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.placing import fitted_rows
from pincal.diagnosis.diagnosis_numbers import DIAGNOSIS
from pincal.errors import BadInputError, MeasurementError, counted
from pincal.fleet.checked_motion import (
    BASE,
    SEVERAL,
    TEMPERATURE,
    TOOL_MOVED,
    CheckMotion,
    chances_of,
    kinds_of_changes,
)
from pincal.fleet.fleet_numbers import INTERIM
from pincal.fleet.interim_evidence import CheckRows, InterimEvidence, Suspect, interim_evidence
from pincal.measure.measurements import Measurements
from pincal.measure.stops import StopRows
from pincal.parameters import root_of
from pincal.robot.se3 import align
from pincal.thresholds import Count, Scale

# Joint positions that are the same pose of a check [rad or m], and how many poses have errors of
# their own by what the model lacks; those of more are taken for noise.
_SAME: Scale = 2e-3
_POSES: Count = 40
# Standard deviations, in units of the noise, below which a direction of what the calibration does
# not know is left out.
_NOTHING: Scale = 0.01
# Coverage factor of expanded uncertainties.
_K: Scale = 2.0
# Expansion of steel [1/K], by which a growth of all lengths is said as a temperature.
_STEEL: Scale = 1.2e-5


@dataclass(frozen=True, eq=False)
class CheckedRobot:
    """A calibrated robot and its checks so far.

    Attributes:
        fitted: the robot as it was calibrated, with all its stations.
        record: its checks.
    """

    fitted: FittedRobot
    record: CheckRecord

    @classmethod
    def of(cls, fitted: FittedRobot, record: CheckRecord | None = None) -> CheckedRobot:
        """Return a robot with its record; default: an empty one."""
        name = fitted.robot_model().model.chain.robot.name
        return cls(fitted, record or CheckRecord(model=model_mark(fitted), robot=name))

    def checked(
        self,
        measurements: Measurements,
        day: str,
        *,
        station: str | None = None,
        is_new_station: bool = False,
        sigma: float | None = None,
        false_alarms: float = INTERIM.false_alarms,
    ) -> CheckedRobot:
        """Return the robot with a further check, the last of its record.

        Args:
            measurements: rows of the day: of the calibration's targets and points, at any three or
                more poses.
            day: ISO date.
            station: of the calibration, with whose instrument and target they were measured;
                default: the first one with such readings.
            is_new_station: whether the instrument was set up anew, so that it is located from the
                rows; the target is where it was.
            sigma: noise of one coordinate [m]; default: the column ``sigma``, or as calibrated.
            false_alarms: probability of any alarm, over the whole life of an unchanged robot.

        Raises:
            BadInputError: for rows that were checked before, or that the model was fitted to, too
                few of them, a day before the last check, or a rate outside 0 to 0.5.
            MeasurementError: if the table can't be of this robot and station, or misses the model
                by more than any change explains.
        """
        if not 0.0 < false_alarms < 0.5:
            raise BadInputError(
                f"false alarms {false_alarms:g}; expected their probability over the whole life of "
                "a robot, such as 0.05"
            )
        table = self._table(measurements, station)
        if sigma is not None:
            table = replace(table, sigma=np.full(len(table), sigma))
        rows = CheckedRows.of(
            table,
            day,
            self._noise(table, station),
            station=station or "",
            is_new_station=is_new_station,
        )
        self._refuse_known(rows)
        series = CheckSeries(self.fitted, (*(one.rows for one in self.record.counting), rows))
        check = series.judged(false_alarms)
        self._refuse_strange(check)
        return replace(self, record=self.record.with_check(check))

    def withdrawn(self, which: str, reason: str, day: str) -> CheckedRobot:
        """Return the robot without a check, which its record keeps with the reason; all later ones
        are judged again without it.

        Args:
            which: day of the check, or its number from 1.
            reason: why it does not count, which must have nothing to do with what it showed: the
                rate of false alarms holds for checks that were not chosen by their results.
            day: of the withdrawal, an ISO date.

        Raises:
            BadInputError: if there is no such check, no reason, or no such day.
        """
        if not reason.strip():
            raise BadInputError(f"check {which}: no reason; expected why it does not count")
        k = self.record.number_of(which) - 1
        checks = list(self.record.checks)
        mark = Withdrawal(day=required_day(day), reason=reason.strip())
        checks[k] = msgspec.structs.replace(checks[k], withdrawn=mark)
        before = [check.rows for check in checks[:k] if check.withdrawn is None]
        for later in range(k + 1, len(checks)):
            if checks[later].withdrawn is None:
                before.append(checks[later].rows)
                series = CheckSeries(self.fitted, tuple(before))
                checks[later] = series.judged(1.0 / checks[later].limit)
        record = msgspec.structs.replace(self.record, checks=tuple(checks))
        return replace(self, record=record)

    def _refuse_strange(self, check: InterimCheck) -> None:
        """Refuse readings that no change of a robot explains: recorded, they would be an alarm that
        no later check takes back.
        """
        reach = self.fitted.robot_model().model.chain.robot.reach
        if check.unit == "m" and check.error > DIAGNOSIS.strange * reach:
            raise MeasurementError(
                f"{check.rows.table}: readings miss the model by {1e3 * check.error:.0f} mm rms, "
                f"where the robot reaches {reach:.2f} m. They belong to another robot or target, "
                "the instrument was set up anew (--new-station), or columns or units are wrong; "
                "expected readings of this robot as it was calibrated. Nothing was recorded"
            )

    def _table(self, measurements: Measurements, station: str | None) -> Measurements:
        """Return the means of stops of a table.

        Raises:
            MeasurementError: if there are too few, or the model was fitted to them.
        """
        model = self.fitted.robot_model().model
        stops = StopRows.of(measurements.in_order_of(model.chain.robot))
        if len(stops.table) < INTERIM.fewest:
            raise MeasurementError(
                f"{measurements.source}: {counted(len(stops.table), 'stop')} of the robot; "
                f"expected {INTERIM.fewest} or more, such as three points of an artefact"
            )
        one = station_robot(self.fitted, stops.table.kind, station)
        if one.reads(stops.table):
            known = int(np.sum(fitted_rows(one.rows, one, stops)))
            if known > DIAGNOSIS.same_by_chance:
                raise MeasurementError(
                    f"{measurements.source}: the model was fitted to {known} of these "
                    f"{len(stops.readings)} rows, so they can't show whether the robot has "
                    "changed since; expected rows measured later"
                )
        return stops.table

    def _noise(self, table: Measurements, station: str | None) -> np.ndarray:
        """Return the stated noise of each block of readings."""
        sigma = station_robot(self.fitted, table.kind, station).sigma.copy()
        if table.sigma is not None:
            sigma[0] = float(np.sqrt(np.mean(table.sigma**2)))
        return sigma

    def _refuse_known(self, rows: CheckedRows) -> None:
        """Refuse rows that were checked before."""
        same = next((one for one in self.record.counting if one.rows.mark == rows.mark), None)
        if same is not None:
            raise BadInputError(
                f"{rows.table}: these rows were checked on {same.day} already (as "
                f"{same.rows.table}); expected a new table: counted twice they would be false "
                "evidence"
            )


def station_robot(fitted: FittedRobot, kind: str, station: str | None) -> FittedRobot:
    """Return the robot at one station of its calibration: the first one with such readings, or by
    name.
    """
    if station is not None:
        return fitted.at(station)
    return next((one for one in fitted.each if one.sensor_kind == kind), fitted.each[0])


@dataclass(frozen=True, eq=False)
class CheckSeries:
    """All checks of a robot, judged together.

    Attributes:
        fitted: the robot.
        checks: their rows, in the order of their days.
    """

    fitted: FittedRobot
    checks: tuple[CheckedRows, ...]

    @cached_property
    def motions(self) -> tuple[CheckMotion, ...]:
        """Each check's dependence on everything."""
        return tuple(map(self._motion, self.checks))

    def _motion(self, check: CheckedRows) -> CheckMotion:
        table = check.measurements()
        one = station_robot(self.fitted, table.kind, check.station or None)
        if check.is_new_station:
            table = in_calibrated_frame(one, table)
        return CheckMotion(one, one.readings(table), np.array(check.sigma), check.is_new_station)

    @cached_property
    def known(self) -> tuple[np.ndarray, ...]:
        """What the calibration does not know, for each check, shape (R, G), all in the same G
        directions.
        """
        columns = list(map(np.hstack, zip(self._of_parameters(), self._of_model(), strict=True)))
        whole = np.vstack(columns)
        _, sizes, axes = np.linalg.svd(whole, full_matrices=False)
        kept = axes[sizes > _NOTHING]
        return tuple(part @ kept.T for part in columns)

    def _of_parameters(self) -> Iterator[np.ndarray]:
        """Yield the errors of readings by the parameters."""
        for motion in self.motions:
            root = root_of(motion.robot.covariance)
            repeated = motion.robot.repeatability
            if repeated is not None:
                # A calibration takes the targets of a stop to be independent.
                root = root * np.sqrt(repeated.shared)
            yield motion.by_parameters @ root

    def _of_model(self) -> Iterator[np.ndarray]:
        """Yield the errors of readings by what the model lacks."""
        lacks = self.fitted.discrepancy
        if lacks is None:
            yield from (np.zeros((len(motion.residuals), 0)) for motion in self.motions)
            return
        poses = same_poses([motion.station.conditions.q for motion in self.motions])
        of_drives = list(lacks.of_drives(np.vstack([at for at, _ in poses])))
        own = lacks.factor * np.sqrt(lacks.rest)
        first = 0
        for motion, (at, number) in zip(self.motions, poses, strict=True):
            m = motion.station.reading_size
            rows = slice(first, first + len(at))
            first += len(at)
            found = [
                motion.drives[j][:, None] * np.repeat(shared[rows], m, axis=0)
                for j, shared, _ in of_drives
            ]
            found += [own * column for column in _of_each(motion.base[:, :3], number, m)]
            yield np.hstack(found)

    @cached_property
    def rows(self) -> tuple[CheckRows, ...]:
        """The checks as evidence takes them."""
        days = [np.datetime64(check.day, "D").astype(int) for check in self.checks]
        begun = _day_of(self.fitted)
        before = [days[0] - 1 if begun is None else min(begun, days[0]), *days[:-1]]
        return tuple(
            CheckRows(
                motion.residuals,
                known,
                motion.base,
                motion.changes,
                float(day - last),
                motion.is_new_station,
            )
            for motion, known, day, last in zip(self.motions, self.known, days, before, strict=True)
        )

    @cached_property
    def evidence(self) -> InterimEvidence:
        """What all checks show."""
        joints = self.motions[-1].station.model.chain.robot.joint_names
        return interim_evidence(self.rows, kinds_of_changes(joints), chances_of(joints))

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints."""
        return self.motions[-1].station.model.chain.robot.joint_names

    def judged(self, false_alarms: float) -> InterimCheck:
        """Return the last check, as all of them show it."""
        found = self.evidence
        limit = 1.0 / false_alarms
        is_alarm = found.log_e >= np.log(limit)
        return InterimCheck(
            rows=self.checks[-1],
            verdict=ALARM if is_alarm else CHECKED,
            log_e=found.log_e,
            limit=limit,
            noise=found.noise,
            drift=self._drift(),
            change=self._described(found.suspect) if is_alarm else None,
            **self._errors(),
        )

    def _errors(self) -> dict[str, Any]:
        """Return the errors of the last check, and what was expected of them."""
        motion = self.motions[-1]
        known = self.known[-1]
        covariance = known @ known.T + np.eye(len(known))
        if motion.is_new_station:
            # The best fit of the frame takes its part.
            B = motion.base
            left = np.eye(len(B)) - B @ np.linalg.pinv(B)
            covariance = left @ covariance @ left.T
        block = motion.station.sensor.blocks[0]
        shape = len(motion.station), motion.station.reading_size
        size = (motion.sigma[0] / motion.station.weights)[:, None]
        errors = (motion.residuals.reshape(shape)[:, : block.size] * size).ravel()
        variance = np.diag(covariance).reshape(shape)[:, : block.size] * size**2
        U = _K * np.sqrt(np.maximum(variance.ravel(), 0.0))
        return {
            "error": float(np.sqrt(np.mean(errors**2))),
            "expanded": float(np.sqrt(np.mean(U**2))),
            "largest": float(np.abs(errors).max()),
            "unit": block.unit,
            "within": int(np.sum(np.abs(errors) <= U)),
            "of": len(errors),
        }

    def _drift(self) -> float:
        """Return the standard uncertainty of a coordinate of a position by what has moved since the
        calibration [m]: a walk of the base, and the likeliest change as far as it is likely.
        """
        found = self.evidence
        motion = self.motions[-1]
        by_base = motion.displacements[:, :, :6]
        square = _mean_square(by_base, found.base, found.base_covariance)
        if motion.is_new_station:
            square = 0.0
        suspect = found.suspect
        at = kinds_of_changes(self.joints)[suspect.kind]
        moved = _mean_square(motion.displacements[:, :, at], suspect.change, suspect.covariance)
        return float(np.sqrt(square + found.chance * moved))

    def _described(self, suspect: Suspect) -> CheckedChange:
        """Return a change in words and numbers."""
        sigma = np.sqrt(np.diag(suspect.covariance))
        is_joint = suspect.kind in self.joints
        return CheckedChange(
            what=suspect.kind,
            joint=suspect.kind if is_joint else None,
            since=self.checks[suspect.since].day,
            sizes=dict(_sizes(suspect, sigma, self._unit_of(suspect.kind))),
            equals=suspect.equals,
        )

    def _unit_of(self, kind: str) -> str:
        robot = self.motions[-1].station.model.chain.robot
        units = dict(zip(robot.joint_names, robot.joint_units, strict=True))
        return units.get(kind, "")


def _mean_square(J: np.ndarray, values: np.ndarray, covariance: np.ndarray) -> float:
    """Return the mean square of a coordinate that moves by J, shape (N, 3, k), with values, (k,),
    of a covariance, (k, k).
    """
    return float(np.einsum("nak,nal,kl->na", J, J, covariance + np.outer(values, values)).mean())


def _sizes(
    suspect: Suspect, sigma: np.ndarray, unit: str
) -> Iterator[tuple[str, tuple[float, float, str]]]:
    """Yield what of a change is said in numbers."""
    change = suspect.change
    if suspect.kind in (BASE, TOOL_MOVED):
        for name, part, of in (("moved", slice(0, 3), "m"), ("turned", slice(3, 6), "rad")):
            size = float(np.linalg.norm(change[part]))
            yield name, (size, float(np.linalg.norm(sigma[part])), of)
    elif suspect.kind == TEMPERATURE:
        yield "grown", (float(change[0]), float(sigma[0]), "1")
        yield "as steel", (float(change[0] / _STEEL), float(sigma[0] / _STEEL), "K")
    elif suspect.kind != SEVERAL:
        yield "offset", (float(change[0]), float(sigma[0]), unit)


def _of_each(columns: np.ndarray, number: np.ndarray, m: int) -> Iterator[np.ndarray]:
    """Yield columns, shape (R, 3), for each of the poses that have errors of their own, of rows
    with m readings each.
    """
    of_row = np.repeat(number, m)
    for pose in range(_POSES):
        yield columns * (of_row == pose)[:, None]


def same_poses(series: Sequence[np.ndarray]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the poses of each check, each as it was first measured, and their numbers.

    Args:
        series: joint positions of each check, shape (N, n) [rad or m].
    """
    first = list[np.ndarray]()
    found = []
    for q in series:
        number = np.empty(len(q), int)
        for i, pose in enumerate(q):
            apart = [float(np.abs(pose - other).max()) for other in first]
            k = int(np.argmin(apart)) if apart else 0
            if not apart or apart[k] > _SAME:
                k = len(first)
                first.append(pose)
            number[i] = k
        found.append((np.array([first[k] for k in number]), number))
    return found


def in_calibrated_frame(robot: FittedRobot, table: Measurements) -> Measurements:
    """Return positions from an instrument that was set up anew in the frame of the calibration's,
    by the best fit of the rows to the model.

    Raises:
        MeasurementError: for readings that are not positions alone.
    """
    if not table.is_of_positions or table.position is None:
        raise MeasurementError(
            f"{table.source}: measurements of kind {table.kind} from a new station; expected "
            "positions (x y z): leave --new-station out, or see pincal diagnose"
        )
    predicted = robot.predict(robot.of_its_day(robot.conditions(table)))[:, :, 3]
    R, t = align(table.position, predicted)
    return table.with_readings(position=table.position @ R.T + t)


def _day_of(fitted: FittedRobot) -> int | None:
    """Return the day of the calibration as a number, None where it is not stated."""
    day = fitted.identity.date
    return int(np.datetime64(day, "D").astype(int)) if day else None
