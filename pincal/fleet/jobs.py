"""Jobs on every table of a store, on any workers; finished work is not repeated.

A result is a file whose name is determined by the rows and the job. So a job that was killed
resumes where it stopped, concurrent runs do no harm, and results are identical to the last byte.
"""

from __future__ import annotations

import hashlib
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import final

import msgspec
import numpy as np
import polars as pl

from pincal.calibration.checked_fit import fitted
from pincal.calibration.fitted_robot import FittedRobot, load_model
from pincal.calibration.information import RobotInformation
from pincal.diagnosis.diagnosis_file import DiagnosisFile
from pincal.diagnosis.robot_diagnosis import FALSE_ALARM, diagnose
from pincal.discover.run import run_discovery
from pincal.errors import BadInputError, ModelFileError, PincalError
from pincal.fleet.history import Visit
from pincal.fleet.machines import Machine
from pincal.fleet.robot_type import RobotType, calibrate_of_type
from pincal.fleet.store import DIAGNOSES, DISCOVERIES, INFORMATION, TABLES, Key, Store
from pincal.fleet.stored_rows import (
    CALIBRATION,
    CHECK,
    information_frame,
    measurements_of,
    text_frame,
)
from pincal.identify.options import Options
from pincal.identify.quadratic import Quadratic
from pincal.io.strict_json import FileKind, read_json
from pincal.measure.admit import check_table
from pincal.measure.measurements import Measurements
from pincal.robot.robot import Robot
from pincal.spread import spread

# End of the names of results that contain the reason of a failure.
_FAILED = "-failed"


class _NotYetError(BadInputError):
    """The store lacks something that may be added later: nothing is written, so that the table is
    tried again.
    """


class Job(ABC):
    """What to do with each table of a store."""

    kind: str
    """Of its results, one of :data:`pincal.fleet.store.STORED`."""
    role: str | None = None
    """Of the tables, one of :data:`pincal.fleet.store.ROLES`; None for all."""

    @property
    @abstractmethod
    def facts(self) -> str:
        """Everything except the rows on which results depend, as text."""

    @abstractmethod
    def row(
        self, store: Store, key: Key, table: Measurements, labels: Mapping[str, str]
    ) -> pl.DataFrame:
        """Return the result of a table as one row.

        Raises:
            PincalError: for rows that can't be processed.
        """

    @abstractmethod
    def nothing(self, key: Key, labels: Mapping[str, str]) -> pl.DataFrame:
        """Return the row of a table that can't be processed."""

    @cached_property
    def name(self) -> str:
        """Kind and checksum, equal for jobs with the same results."""
        return f"{self.kind}-{hashlib.sha256(self.facts.encode()).hexdigest()[:8]}"

    @final
    def result(self, key: Key) -> Key:
        """Return the key of the result of a table."""
        return replace(key, kind=self.kind, id=f"{key.id}-{self.name}")


@dataclass(frozen=True)
class CalibrateTables(Job):
    """Information on machines, from each table alone.

    Attributes:
        robot: the arm.
        options: how to calibrate.
        type: the type of the machines, if known.
        role: of the tables.
    """

    robot: Robot
    options: Options
    type: RobotType | None = None
    role: str | None = None
    kind = INFORMATION

    @property
    def facts(self) -> str:
        """Robot, options and type."""
        robot = self.robot
        of = (
            ""
            if self.type is None
            else f"{self.type.mean.tolist()} {self.type.covariance.tolist()}"
        )
        borne = [array.tolist() for array in (robot.masses, robot.centres, robot.gravity)]
        return (
            f"{robot.frames!r} {robot.joint_names} {robot.joint_types} {robot.couplings} "
            f"{borne} {self.options!r} {of}"
        )

    def row(
        self, store: Store, key: Key, table: Measurements, labels: Mapping[str, str]
    ) -> pl.DataFrame:
        """Return the information, and how well the rows fit."""
        _check(self.robot, table)
        off: tuple[str, ...] = ()
        if self.type is None:
            fit = fitted(self.robot, table, self.options)
        else:
            fit, member = calibrate_of_type(
                self.robot, table, self.type, self.options, name=key.machine
            )
            off = member.off
        machine = Machine.of(fit.fit, key.machine, labels=labels)
        how = {
            "rows": len(table),
            "converged": fit.solution.converged,
            "noise": fit.solution.sigma.tolist(),
            "off": off,
        }
        return information_frame(machine, "", **how)

    def nothing(self, key: Key, labels: Mapping[str, str]) -> pl.DataFrame:
        """Return a machine without information."""
        empty = Quadratic(
            np.zeros((0, 0)), np.zeros(0), np.zeros(0), names=(), square=0.0, degrees=0.0
        )
        machine = Machine(
            key.machine, RobotInformation.of_form(empty, self.robot.name, 0, {}), labels
        )
        return information_frame(machine, "", converged=False)


@dataclass(frozen=True)
class DiagnoseTables(Job):
    """Whether machines have changed, from each table and the machine's last model of that day or
    earlier.

    Attributes:
        alpha: probability of an alarm on a robot that has not changed.
        sigma: noise of one component of the readings [m]; default: the column ``sigma``.
    """

    alpha: float = FALSE_ALARM
    sigma: float | None = None
    kind = DIAGNOSES
    role: str | None = CHECK

    @property
    def facts(self) -> str:
        """Probability of a false alarm, and noise."""
        return f"{self.alpha} {self.sigma}"

    def row(
        self, store: Store, key: Key, table: Measurements, labels: Mapping[str, str]
    ) -> pl.DataFrame:
        """Return the diagnosis."""
        model = last_model(store, key.machine, key.day)
        if model is None:
            raise _NotYetError(
                f"machine {key.machine!r} has no model of {key.day} or earlier; add its model.json"
            )
        found = diagnose(model, table, alpha=self.alpha, sigma=self.sigma)
        return text_frame(
            msgspec.json.encode(found.found).decode(),
            changed=found.changed,
            p_value=found.found.p_value,
        )

    def nothing(self, key: Key, labels: Mapping[str, str]) -> pl.DataFrame:
        """Return no diagnosis."""
        return text_frame("", changed=False, p_value=1.0)


@dataclass(frozen=True)
class DiscoverTables(Job):
    """Effects missing from the model of machines, from each table alone.

    Attributes:
        robot: the arm.
        options: how to calibrate.
        role: of the tables.
    """

    robot: Robot
    options: Options
    role: str | None = CALIBRATION
    kind = DISCOVERIES

    @property
    def facts(self) -> str:
        """Robot and options."""
        return CalibrateTables(self.robot, self.options).facts

    def row(
        self, store: Store, key: Key, table: Measurements, labels: Mapping[str, str]
    ) -> pl.DataFrame:
        """Return the discovery."""
        _check(self.robot, table)
        found = run_discovery(self.robot, table, self.options).findings
        return text_frame(msgspec.json.encode(found).decode(), verdict=str(found.verdict))

    def nothing(self, key: Key, labels: Mapping[str, str]) -> pl.DataFrame:
        """Return no discovery."""
        return text_frame("", verdict="")


@dataclass(frozen=True)
class Done:
    """Outcome of a job.

    Attributes:
        done: number of tables whose results were added.
        before: number of tables with earlier results.
        failed: reasons of tables that can't be processed, by their path.
        failed_before: number of tables that this job could not process earlier; the reasons are in
            the store.
    """

    done: int
    before: int
    failed: dict[str, str]
    failed_before: int = 0


def without_information(store: Store) -> list[Key]:
    """Return the tables without information from any job.

    Information added for a machine and day counts as derived from its table of that day, unless the
    table is a check.
    """
    known = store.keys(INFORMATION)
    done = {key.id.partition("-")[0] for key in known if not key.id.endswith(_FAILED)}
    added = {(key.machine, key.day) for key in known if "-" not in key.id}
    left = [key for key in store.keys(TABLES) if key.id not in done]
    return [
        key
        for key in left
        if (key.machine, key.day) not in added or store.frame(key)["role"][0] == CHECK
    ]


def run_job(
    store: Store, job: Job, *, tables: Sequence[Key] | None = None, executor: Executor | None = None
) -> Done:
    """Do a job for every table of a store that has no result of it yet.

    Args:
        store: the store.
        job: what to do.
        tables: restrict the job to these.
        executor: does the work, see :mod:`pincal.spread`; default: this process, one table at a
            time.

    Raises:
        OutputError: if the store can't be written to.
        WorkersLostError: if workers died and none could take over their work; finished results are
            kept.
    """
    tables = store.keys(TABLES) if tables is None else tables
    there = set(store.keys(job.kind))
    left = [key for key in tables if not there & {job.result(key), _failure(job.result(key))}]
    failed_before = sum(_failure(job.result(key)) in there for key in tables)
    failed = dict[str, str]()
    done = 0
    for key, reason in zip(
        left,
        spread(partial(_work, store, job), left, label="table", executor=executor),
        strict=True,
    ):
        done += reason is not None
        if reason:
            failed[key.path] = reason
    return Done(done, len(tables) - len(left) - failed_before, failed, failed_before)


def _failure(result: Key) -> Key:
    """Return the key of the reason why there is no result."""
    return replace(result, id=result.id + _FAILED)


def _work(store: Store, job: Job, key: Key) -> str | None:
    """Do a job for a table; return why it failed, "" if it did not, or None if the job is not for
    such tables.
    """
    frame = store.frame(key)
    role = frame["role"][0]
    reason = ""
    if job.role not in (None, role):
        return None
    labels = {entry["key"]: entry["value"] for entry in frame["labels"][0]}
    result = job.result(key)
    try:
        row = job.row(store, key, measurements_of(frame, f"{store.place}/{key.path}"), labels)
    except _NotYetError as error:
        return str(error)
    except PincalError as error:
        row = job.nothing(key, labels)
        reason = str(error)
        result = _failure(result)
    store.add(result, row, role=role, job=job.name, table=key.id, failure=reason)
    return reason


def visits_of(store: Store, *, job: str | None = None) -> Iterator[Visit]:
    """Yield calibrations and checks of a store: information on machines, and p-values of diagnoses
    if there is none.

    Args:
        store: the store.
        job: the one that computed the information; default: any.

    Raises:
        BadInputError: if several jobs computed information from the same rows.
    """
    informed = set[tuple[str, str]]()
    chances = dict[tuple[str, str, str], float]()
    for key, machine, role in store.machines(job=job, role=None):
        if role == CHECK:
            informed.add((key.machine, key.day))
        yield Visit(key.machine, key.day, machine, role == CALIBRATION)
    for keys, frame in store.frames(DIAGNOSES):
        for key, p, table, failure in zip(
            keys, *(frame[n] for n in ("p_value", "table", "failure")), strict=True
        ):
            if not failure and (key.machine, key.day) not in informed:
                # Rows diagnosed more than once, such as with another noise, count once.
                rows = key.machine, key.day, table or key.id
                chances[rows] = max(p, chances.get(rows, 0.0))
    yield from (Visit(machine, day, p_value=p) for (machine, day, _), p in chances.items())


def add_model(
    store: Store, machine: str, day: str, path: Path, *, labels: Mapping[str, str] | None = None
) -> bool:
    """Add a ``model.json`` of a machine and the information in it; return whether it has any.

    Raises:
        ModelFileError: if it can't be read.
        OutputError: if the store can't be written to.
    """
    information = load_model(path).robot_model().information
    store.add_model(machine, day, path.read_text(encoding="utf-8"))
    if information is not None:
        store.add_information(day, Machine(machine, information, dict(labels or {})))
    return information is not None


def load_diagnosis(path: Path) -> DiagnosisFile:
    """Read a ``diagnosis.json``.

    Raises:
        ModelFileError: if it can't be read.
    """
    return read_json(
        path,
        DiagnosisFile,
        FileKind("a diagnosis", ModelFileError, whole="a file written by pincal diagnose"),
    )


def add_diagnosis(store: Store, machine: str, day: str, path: Path) -> None:
    """Add a ``diagnosis.json`` of a machine.

    Raises:
        ModelFileError: if it can't be read.
        OutputError: if the store can't be written to.
    """
    found = load_diagnosis(path)
    facts = {
        "changed": found.changed,
        "p_value": found.p_value,
        "role": CHECK,
        "job": "",
        "table": "",
        "failure": "",
    }
    store.add_text(DIAGNOSES, machine, day, path.read_text(encoding="utf-8"), **facts)


def last_model(store: Store, machine: str | None = None, day: str = "9999") -> FittedRobot | None:
    """Return the last model of a machine, default any, from a day or earlier; None if there is
    none. Of several of one day, it is the one that was added last.
    """
    text = store.last_model(machine, day)
    if text is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.json"
        path.write_text(text, encoding="utf-8")
        return load_model(path).robot_model()


def _check(robot: Robot, table: Measurements) -> None:
    """Refuse rows that do not match a robot."""
    if table.joint_names != robot.joint_names:
        names = ", ".join(table.joint_names), ", ".join(robot.joint_names)
        raise BadInputError(f"{table.source}: joints {names[0]}; {robot.name} has {names[1]}")
    check_table(robot, table)
