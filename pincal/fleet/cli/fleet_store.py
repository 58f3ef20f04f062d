"""``pincal fleet add``, ``calibrate``, ``discover`` and ``diagnose``: a store of measurements, and
work on all of it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pincal.cli.arguments import argument, group, option, pair, verb
from pincal.cli.common import (
    GeneralOptions,
    ModelOptions,
    TableArguments,
    base_option,
    robot_argument,
    tip_option,
)
from pincal.cli.fitting import workers
from pincal.cli.outputs import echo_notes, print_json
from pincal.cli.quantities import ANGLE, LENGTH
from pincal.errors import BadInputError, Exit, counted, few, nearest_first
from pincal.thresholds import Count

if TYPE_CHECKING:
    from pincal.fleet.jobs import Done, Job
    from pincal.fleet.store import Key, Store
    from pincal.identify.options import Options
    from pincal.identity import Identity
    from pincal.robot.robot import Robot

# Number of failures, and of names of machines, that are listed.
_FAILURES: Count = 5
_NEAREST: Count = 4
# Number of tables from which on starting processes, which takes seconds, pays off.
_SEVERAL: Count = 12
# Names of files that do not name the machine; the folder does.
_GENERIC = ("model", "information", "diagnosis")
_ADD_EXAMPLES = """
Examples:
  pincal fleet add fleet-store r1/model.json r2/model.json --label hall=north
  pincal fleet add fleet-store tracker.csv --machine R17 --day 2026-11-03 --robot robot.urdf
  pincal fleet add fleet-store check.csv --check --machine R17
  pincal fleet add fleet-store diagnosis/diagnosis.json --machine R17

A store is a folder, or a URL that fsspec can open, such as s3://bucket/fleet; it is created with
the first file. Several processes may add files at the same time; a file that is added twice is
stored once.
"""
_SHOWN = ("noise", "noise_angle", "tip", "base", "model", "dask", "as_json", "quiet")
_JOB_EXAMPLES = """
Examples:
  pincal fleet {0} fleet-store --noise 0.05mm
  pincal fleet {0} fleet-store --dask tcp://10.0.0.5:8786

Completed work is not repeated: a run that was stopped continues with the rest. To repeat all of it,
delete the folder {1} of the store.
"""
_dask = "Work on this Dask cluster, which needs access to the store."
store_argument = partial(argument, "STORE", "Folder or URL of the store.")


def machine_names(texts: Iterable[str]) -> dict[str, str]:
    """Return names of machines by file: its stem, or its folder's; the whole path if these are
    ambiguous.
    """
    paths = {text: Path(text) for text in texts}
    own = {
        text: path.absolute().parent.name if path.stem in _GENERIC else path.stem
        for text, path in paths.items()
    }
    count = Counter(own.values())
    return {
        text: name if count[name] == 1 else paths[text].as_posix() for text, name in own.items()
    }


@dataclass(frozen=True, kw_only=True)
class AddArguments:
    """Arguments of fleet add."""

    store: str = store_argument()
    files: tuple[Path, ...] = argument(
        "FILE...", "Calibrated models, diagnoses (.json), or tables of measurements."
    )
    machine: str | None = option(
        "Name of the machine.",
        metavar="NAME",
        words="the serial number that a model or diagnosis states, or the name of the file, or "
        "its folder",
    )
    day: str | None = option("Day of the measurement.", metavar="YYYY-MM-DD", words="today")
    check: bool = option("Add tables as checks of machines that are calibrated already.", False)
    label: tuple[str, ...] = option(
        "Property that machines share which may drift together: a supplier, a batch, a hall.",
        (),
        metavar="KEY=VALUE",
    )
    robot: str | None = option(
        "URDF of the arm, for tables.", metavar="URDF", words="that of a model in the store"
    )
    tip: str | None = tip_option(words="flange or tool at the end of the longest chain")
    base: str | None = base_option()
    table: TableArguments = group("Tables")
    general: GeneralOptions = group("General")


@dataclass(frozen=True)
class _Entry:
    """What a file adds to a store.

    Attributes:
        kind: of the file.
        machine: of which it is.
        path: the file.
        add: adds it, and returns False for a model without information.
    """

    kind: str
    machine: str
    path: Path
    add: Callable[[Store], object]


@dataclass(frozen=True)
class _Reader:
    """Reads the files of a command line for a store."""

    arguments: AddArguments
    day: str
    labels: dict[str, str]
    names: dict[str, str]

    def entry(self, path: Path) -> _Entry:
        """Return what a file adds.

        Raises:
            BadInputError: for a folder, a file or a name of a machine that is invalid.
        """
        from pincal.fleet.store import named_machine

        machine = named_machine(
            self.names[str(path)] if self.arguments.machine is None else self.arguments.machine
        )
        if path.suffix.lower() == ".json":
            return self._document(path, machine)
        if path.is_dir():
            raise BadInputError(
                f"{path}: a folder, such as a session in motion; calibrate it and add its "
                "model.json"
            )
        return self._table(path, machine)

    def _document(self, path: Path, machine: str) -> _Entry:
        """Return what a model or a diagnosis adds."""
        from pincal.calibration.fitted_robot import load_model
        from pincal.fleet.jobs import add_diagnosis, add_model, load_diagnosis
        from pincal.io.strict_json import MODEL_FILE, read_bounded

        if b'"excluded"' in read_bounded(path, MODEL_FILE):
            machine = self._stated(load_diagnosis(path).id) or machine
            add_it = partial(add_diagnosis, machine=machine, day=self.day, path=path)
            return _Entry("diagnosis", machine, path, add_it)
        machine = self._stated(load_model(path).identity) or machine
        add = partial(add_model, machine=machine, day=self.day, path=path, labels=self.labels)
        return _Entry("model", machine, path, add)

    def _stated(self, identity: Identity | None) -> str:
        """Return the serial number that a file states, as the name of its machine; empty if there
        is none, or another name was given.
        """
        from pincal.fleet.store import named_machine

        if self.arguments.machine is not None or identity is None or not identity.robot:
            return ""
        return named_machine(identity.robot)

    def _table(self, path: Path, machine: str) -> _Entry:
        """Return what a table of measurements adds."""
        from pincal.cli.inputs import load_table
        from pincal.fleet.store import Store
        from pincal.fleet.stored_rows import CALIBRATION, CHECK

        if self._robot is None:
            raise BadInputError(
                f"{path}: the store has no model, so it is unknown which columns are "
                "joints; give --robot URDF"
            )
        table = load_table(self._robot, path, options=self.arguments.table.options)
        role = CHECK if self.arguments.check else CALIBRATION
        add = partial(
            Store.add_table,
            machine=machine,
            day=self.day,
            table=table,
            role=role,
            labels=self.labels,
        )
        return _Entry(CHECK if self.arguments.check else "table", machine, path, add)

    @cached_property
    def _robot(self) -> Robot | None:
        """The arm of all tables: of the command line, or of the last model of the store."""
        from pincal.fleet.jobs import last_model
        from pincal.fleet.store import open_store
        from pincal.robot.robot import Robot

        given = self.arguments
        if given.robot is not None:
            return Robot.from_urdf(given.robot, tip=given.tip, base=given.base)
        known = None
        with suppress(BadInputError):
            known = last_model(open_store(given.store))
        return None if known is None else known.model.chain.robot


@verb(
    AddArguments,
    examples=_ADD_EXAMPLES,
    shown=("machine", "day", "check", "label", "robot", "tip", "base", "orientation", "as_json"),
    cell="none",
)
def fleet_add(arguments: AddArguments) -> Exit:
    """Add models, diagnoses or tables of measurements to a store."""
    import datetime

    from pincal.fleet.store import iso_day, open_store

    day = iso_day(arguments.day or datetime.datetime.now(tz=datetime.UTC).date().isoformat())
    labels = dict(pair(text, "KEY=VALUE, such as hall=north") for text in arguments.label)
    names = machine_names([str(path) for path in arguments.files])
    reader = _Reader(arguments, day, labels, names)
    # Everything is read before anything is written.
    entries = [reader.entry(path) for path in arguments.files]
    _refuse_uncalibrated(arguments.store, entries, day)
    store = open_store(arguments.store, create=True)
    without = [entry.add(store) for entry in entries].count(False)
    kinds = Counter(entry.kind for entry in entries)
    if arguments.general.as_json:
        print_json({"store": arguments.store, "day": day, "added": dict(kinds)})
    else:
        found = ", ".join(counted(count, kind) for kind, count in kinds.items())
        click.echo(f"added to {arguments.store}: {found} of {day}")
    if without:
        words = (
            f"{counted(without, 'model')} of a version that stored no information matrix: "
            "calibrate again"
        )
        echo_notes([words], quiet=arguments.general.quiet)
    return Exit.DONE


def _refuse_uncalibrated(place: str, entries: Sequence[_Entry], day: str) -> None:
    """Refuse checks and diagnoses of machines that are not calibrated by that day, which would
    never count: mostly a name is misspelt, or left to the name of the file.

    Raises:
        BadInputError: for these.
    """
    from pincal.fleet.store import open_store

    added = {entry.machine for entry in entries if entry.kind in ("model", "table")}
    store = None
    with suppress(BadInputError):
        store = open_store(place)
    for entry in entries:
        if entry.machine in added:
            continue
        first = None if store is None else store.first_calibration(entry.machine)
        if first is None:
            raise BadInputError(_uncalibrated(entry, place, store))
        if first > day:
            raise BadInputError(
                f"{entry.path}: of {day}, but {entry.machine} was first calibrated on {first}, "
                "before which a check tells nothing; expected the day of the check (--day)"
            )


def _uncalibrated(entry: _Entry, place: str, store: Store | None) -> str:
    """Return why a check of a machine without a calibration is refused, and what to do."""
    from pincal.fleet.store import INFORMATION, MODELS, TABLES

    kinds = (MODELS, INFORMATION, TABLES)
    there = [] if store is None else [key for kind in kinds for key in store.keys(kind)]
    names = sorted({key.machine for key in there} - {entry.machine})
    listed = few(nearest_first([entry.machine], names), _NEAREST)
    others = f"--machine, nearest first: {listed}; or " if listed else ""
    return (
        f"{entry.path}: {entry.machine} has no calibration in {place}, without which a check of it "
        f"tells nothing; expected {others}its calibration first: "
        f"pincal fleet add {place} MODEL.json --machine {entry.machine}"
    )


@dataclass(frozen=True, kw_only=True)
class _TablesArguments:
    """Arguments of work on all tables of a store."""

    robot: str = robot_argument()
    store: str = store_argument()
    noise: float | None = option(
        "Noise of one position coordinate.", type=LENGTH, words="estimated for each table"
    )
    noise_angle: float | None = option(
        "Noise of one orientation component.", type=ANGLE, words="estimated for each table"
    )
    tip: str | None = tip_option(words="flange or tool at the end of the longest chain")
    base: str | None = base_option()
    dask: str | None = option(_dask, metavar="ADDRESS", words="this machine, all its cores")
    model: ModelOptions = group("Model")
    general: GeneralOptions = group("General")


@dataclass(frozen=True, kw_only=True)
class FitTablesArguments(_TablesArguments):
    """Arguments of fleet calibrate."""

    type: Path | None = option(
        "Prior knowledge of machines of this type; checks are then also calibrated.",
        metavar="TYPE.json",
    )


def _fitted_with(arguments: _TablesArguments) -> tuple[Robot, Options]:
    from pincal.robot.robot import Robot

    options = arguments.model.options(arguments.noise, arguments.noise_angle)
    return Robot.from_urdf(arguments.robot, tip=arguments.tip, base=arguments.base), options


@verb(
    FitTablesArguments,
    examples=_JOB_EXAMPLES.format("calibrate robot.urdf", "information"),
    shown=("type", *_SHOWN),
    cell="none",
)
def fleet_calibrate(arguments: FitTablesArguments) -> Exit:
    """Calibrate all tables of a store that are not calibrated yet.

    The store then contains the information of each table, for fleet learn and fleet check.
    """
    from pincal.fleet.jobs import CalibrateTables, without_information
    from pincal.fleet.robot_type import load_type
    from pincal.fleet.store import open_store
    from pincal.fleet.stored_rows import CALIBRATION

    store = open_store(arguments.store)
    of = None if arguments.type is None else load_type(arguments.type)
    robot, options = _fitted_with(arguments)
    if of is not None:
        of.prior_of(robot, options.effects)
    job = CalibrateTables(robot, options, of, role=CALIBRATION if of is None else None)
    return _run(
        store, job, without_information(store), arguments.dask, arguments.general, done="calibrated"
    )


@verb(
    _TablesArguments,
    examples=_JOB_EXAMPLES.format("discover robot.urdf", "discoveries"),
    shown=_SHOWN,
    cell="none",
)
def fleet_discover(arguments: _TablesArguments) -> Exit:
    """Identify the effects that machines' models lack."""
    from pincal.fleet.jobs import DiscoverTables
    from pincal.fleet.store import TABLES, open_store

    store = open_store(arguments.store)
    job = DiscoverTables(*_fitted_with(arguments))
    return _run(
        store,
        job,
        store.keys(TABLES),
        arguments.dask,
        arguments.general,
        done="searched for missing effects",
    )


@dataclass(frozen=True, kw_only=True)
class DiagnoseTablesArguments:
    """Arguments of fleet diagnose."""

    store: str = store_argument()
    noise: float | None = option(
        "Noise of one coordinate.", type=LENGTH, words="that of the calibration"
    )
    alpha: float = option("Probability of a false alarm, for each table.", 0.01)
    dask: str | None = option(_dask, metavar="ADDRESS", words="this machine, all its cores")
    general: GeneralOptions = group("General")


@verb(
    DiagnoseTablesArguments,
    examples=_JOB_EXAMPLES.format("diagnose", "diagnoses"),
    cell="none",
)
def fleet_diagnose(arguments: DiagnoseTablesArguments) -> Exit:
    """Diagnose every check with its machine's last model.

    Each check is tested by itself; fleet check evaluates all of them together.
    """
    from pincal.fleet.jobs import DiagnoseTables
    from pincal.fleet.store import TABLES, open_store

    store = open_store(arguments.store)
    job = DiagnoseTables(arguments.alpha, arguments.noise)
    return _run(store, job, store.keys(TABLES), arguments.dask, arguments.general, done="diagnosed")


def _run(
    store: Store,
    job: Job,
    tables: Sequence[Key],
    dask: str | None,
    general: GeneralOptions,
    *,
    done: str,
) -> Exit:
    """Do a job for tables of a store and print its result.

    Raises:
        BadInputError: if there was work and all of it failed.
    """
    from pincal.fleet.jobs import run_job
    from pincal.fleet.store import TABLES

    before = len(store.keys(TABLES)) - len(tables)
    with workers(dask, repeats=dask is not None or len(tables) >= _SEVERAL) as executor:
        found = run_job(store, job, tables=tables, executor=executor)
    good = found.done - len(found.failed)
    before += found.before
    if general.as_json:
        counts = {"done": good, "before": before, "failed_before": found.failed_before}
        print_json({"job": job.name, **counts, "failed": found.failed})
    else:
        words = f"; {before} done before" if before else ""
        click.echo(f"{counted(good, 'table')} {done}{words}")
        for line in _failures(found, job.kind):
            click.echo(line)
    if found.failed and not good:
        all_of_them = counted(found.done, "table")
        raise BadInputError(
            f"{store.place}: none of {all_of_them} could be processed; the reasons are in the store"
        )
    return Exit.DONE


def _failures(found: Done, kind: str) -> Iterator[str]:
    """Yield lines on the tables that failed, now and before; ``kind`` is where the reasons are."""
    for path, reason in list(found.failed.items())[:_FAILURES]:
        yield f"failed: {path}: {reason}"
    if len(found.failed) > _FAILURES:
        yield (
            f"failed: {len(found.failed) - _FAILURES} more, see the column failure of "
            f"{kind} in the store"
        )
    if found.failed_before:
        yield (
            f"{found.failed_before} failed before, not tried again: see the column "
            f"failure of {kind}"
        )
