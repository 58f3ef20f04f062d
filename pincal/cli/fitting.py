"""``pincal calibrate``: from a URDF and tables to a calibrated model; and what other verbs that fit
share with it.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from pincal.cli.arguments import group, option, verb, words_to_repeat
from pincal.cli.check import DRY, run_check
from pincal.cli.common import (
    CalibrationOptions,
    GeneralOptions,
    InputOptions,
    SplitOptions,
    max_error_option,
    verbose_option,
)
from pincal.cli.fit_output import FitOutput
from pincal.cli.identity_options import HEADING, IdentityOptions
from pincal.cli.outputs import print_json, provenance, require_accuracy, robot_notes_in_result
from pincal.cli.result_place import results_option
from pincal.cli.robot_priors import load_prior
from pincal.errors import BadInputError, Exit, IdentificationError
from pincal.io.result_folder import output_folder
from pincal.satellites import Place
from pincal.spread import own_processes
from pincal.thresholds import Scale

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from pincal.calibration.calibration import Calibration
    from pincal.calibration.fitted_robot import FittedRobot
    from pincal.calibration.result import Result
    from pincal.cli.inputs import Prepared
    from pincal.measure.measurements import Measurements
    from pincal.report.judgement import Act

# The view in three dimensions that accompanies the report.
VIEW = "view3d.html"
# What writes views of a calibration to a folder.
# Kinds of readings of which a program's targets may be: of an instrument that sees positions.
_PLACES = ("position", "pose")
_VIEWS: Place[Callable[[Path, Calibration], None]] = Place("views")
# Times within which a cluster has to answer, and then to have a worker [s].
_ANSWER: Scale = 5.0
_WORKER: Scale = 10.0
_NOTHING_AT_TASK = (
    "nothing is stated of the error at the poses of {}: no reading is of an instrument that sees "
    "positions; measure some poses by one, as a table of its own beside these"
)
FIT_FILES = (
    "DIR then holds model.json (predicts without the URDF), result.json, calibrated.urdf, "
    "residuals.csv and report.html"
)
FIT_EXITS = (Exit.UNDECIDED, Exit.INACCURATE)
FIT_SHOWN = (
    "out",
    "noise",
    "tip",
    "points",
    "camera",
    "model",
    "max_error",
    "verbose",
    "as_json",
)
"""Options that the short help text of a fit shows."""
_CALIBRATE_EXAMPLES = f"""
Examples:
  pincal calibrate tracker.csv           # with a cell.toml beside it, which pincal check writes
  pincal calibrate robot.urdf tracker.csv --out results --noise 0.05mm
  pincal calibrate ur10 series.csv --out results --max-error 0.2mm
  pincal calibrate robot.urdf monday.csv tuesday.csv --split station --out results

{FIT_FILES}.
"""


@dataclass(frozen=True, kw_only=True)
class FitArguments:
    """Arguments of calibrate and discover."""

    source: InputOptions = group("Input")
    out: Path = results_option("results")
    max_error: float | None = max_error_option()
    verbose: bool = verbose_option()
    view: bool = option(f"Also write {VIEW}: the robot and its errors in 3D.", False)
    chosen: CalibrationOptions = group("Model")
    split: SplitOptions = group("Validation")
    task: Path | None = option(
        "Joint positions where accuracy matters; the error to expect there is printed.",
        words="anywhere within the joint limits",
    )
    accept_shift: bool = option(
        "Exit with 0 even if readings shift at some row, as if instrument or target had "
        "been moved.",
        False,
    )
    dask: str | None = option(
        "Run repeated fits, on subsamples or on all stations but one, on this Dask cluster.",
        metavar="ADDRESS",
        words="this machine",
    )
    identity: IdentityOptions = group(HEADING)
    general: GeneralOptions = group("General")


@dataclass(frozen=True, kw_only=True)
class CalibrateArguments(FitArguments):
    """Arguments of calibrate."""

    dry: bool = option(
        "Fit and write nothing; print what the tables can identify, as check does.", False, name=DRY
    )


@verb(
    CalibrateArguments,
    examples=_CALIBRATE_EXAMPLES,
    exits=FIT_EXITS,
    shown=(*FIT_SHOWN, "holdout", "view"),
)
def calibrate_verb(arguments: CalibrateArguments) -> Exit:
    """Calibrate a robot from a table of measured poses.

    All rows are fitted; errors are stated by cross-validation, each pose predicted by a fit without
    it.
    """
    if arguments.dry:
        return run_check(
            arguments.source,
            arguments.chosen,
            as_json=arguments.general.as_json,
            is_full=arguments.verbose,
        )
    from pincal.calibration.calibration import run_calibration

    with workers(
        arguments.dask, repeats=arguments.split.split == "station", processes=False
    ) as executor:

        def run(*given: Any, **choice: Any) -> FitOutput:
            return FitOutput(run_calibration(*given, **choice, executor=executor))

        return run_fit(arguments, run)


@dataclass(frozen=True)
class _Inputs:
    """What the files of a command line give to a fit.

    Attributes:
        prepared: robot, tables and options.
        holdout: the tables of ``--holdout``.
        task: the joint positions where accuracy matters.
        doubts: on whether the robot is of the type whose prior is used.
    """

    prepared: Prepared
    holdout: dict[str, Measurements] | None
    task: Measurements | None
    doubts: tuple[str, ...]

    @classmethod
    def read(cls, arguments: FitArguments) -> _Inputs:
        """Read all files of a command line."""
        from pincal.cli.inputs import load_table, load_tables, prepare, with_payload

        source = arguments.source
        held = arguments.split.holdout
        known = arguments.chosen.fit.type
        prepared = prepare(source, arguments.chosen)
        robot = prepared.robot
        shared = replace(source.table.options, shares_log=True)
        holdout = None if held is None else load_tables(robot, [held], options=shared)
        if holdout is not None:
            holdout = {name: with_payload(of, source.payload) for name, of in holdout.items()}
        task = (
            None if arguments.task is None else load_table(robot, arguments.task, joints_only=True)
        )
        if task is not None:
            task = with_payload(task, source.payload)
        doubts: tuple[str, ...] = ()
        if known is not None:
            options, doubts = load_prior(known).compared(robot, prepared.tables, prepared.options)
            prepared = replace(prepared, options=options)
        return cls(prepared, holdout, task, doubts)

    def fit(self, run: Callable[..., FitOutput], split: SplitOptions) -> FitOutput:
        """Return the output of a fit, divided as chosen."""
        return run(
            self.prepared.robot,
            self.prepared.tables,
            self.prepared.options,
            test_fraction=split.test_fraction,
            split=split.split,
            seed=split.seed,
            holdout=self.holdout,
        )

    def completed(self, output: FitOutput) -> FitOutput:
        """Return the output with the doubts, and with the error to expect of the task."""
        from msgspec import UNSET

        from pincal.calibration.elsewhere import elsewhere_of
        from pincal.notes import doubts_first

        result = output.calibration.result
        said = list(self.doubts)
        if self.task is not None:
            elsewhere = elsewhere_of(output.calibration.fit, self.task)
            result = replace(result, elsewhere=elsewhere or UNSET)
            said += [] if elsewhere else [_NOTHING_AT_TASK.format(self.task.source)]
        if said:
            result = replace(result, warnings=doubts_first([*said, *result.warnings]))
        return output.with_result(result)


def run_fit(arguments: FitArguments, run: Callable[..., FitOutput]) -> Exit:
    """Run a fit on the files of the command line, write and print its output.

    Raises:
        IdentificationError: if the fit did not converge, or instrument or target was touched
            between two rows; the files are written nevertheless.
        AccuracyGateError: if the error exceeds the limit; files as above.
    """
    from pincal.cli.progress import log_step

    # A missing matplotlib is reported here, not after the fit.
    from pincal.report import plots  # noqa: F401

    split = arguments.split
    if arguments.view:
        # Before the fit.
        _VIEWS.only("--view", "pincal.viewer")
    with robot_notes_in_result(), output_folder(arguments.out) as draft:
        inputs = _Inputs.read(arguments)
        output = inputs.fit(run, split).with_identity(arguments.identity.given)
        log_step("writing the model")
        files = [*inputs.prepared.files, *filter(None, [split.holdout])]
        origin = provenance(files, seed=split.seed)
        output = inputs.completed(output)
        notes = write_results(draft, output, origin, view=arguments.view)
        written = " ".join(sorted(file.name for file in draft.iterdir()))
    if arguments.general.as_json:
        print_json(output.to_dict())
    else:
        _print_fit(arguments, output, notes)
        click.echo(f"written to {arguments.out}: {written}")
    _require_usable(output.calibration.result, arguments)
    return Exit.DONE


def _print_fit(arguments: FitArguments, output: FitOutput, notes: tuple[str, ...]) -> None:
    """Print the output of a fit, briefly or in full; ``notes`` are on what the URDF lacks."""
    from pincal.cli.brief import print_brief
    from pincal.cli.progress import console

    if arguments.verbose:
        output.print_all(console())
        for note in notes:
            click.echo(f"note: {note}")
        return
    print_brief(
        output.calibration,
        console(),
        more=f"--verbose, or {arguments.out / 'report.html'}",
        search=output.search,
        found=output.found(),
        notes=notes,
        commands=_commands(arguments, output.calibration.result),
    )


def _commands(arguments: FitArguments, result: Result) -> dict[Act, str]:
    """Return what to type next: the same with the noise of the instrument, a search of the same
    tables, or a program to correct.
    """
    from pincal.report.judgement import Act, noise_option

    verb = click.get_current_context().info_name
    words = shlex.join(words_to_repeat())
    model = shlex.quote(str(arguments.out / "model.json"))
    noise = f"pincal {verb} {words} {noise_option(result)}"
    return {
        Act.DECLARE: f"{noise}  # your instrument's",
        Act.SEARCH: f"pincal discover {words}",
        Act.USE: f"pincal compensate {model} PROGRAM.csv{_at_a_station(result)} --out "
        "corrected.csv  # your program; or measure, predict",
    }


def _at_a_station(result: Result) -> str:
    """Return the option for one of several stations, of which a program needs one: the first at
    which an instrument measured positions, if there is one.
    """
    from msgspec import UNSET

    if result.stations is UNSET:
        return ""
    stations = sorted(result.stations, key=lambda record: record["kind"] not in _PLACES)
    return f" --station {shlex.quote(stations[0]['name'])}"


def _require_usable(result: Result, arguments: FitArguments) -> None:
    """Raise unless the fit converged, its rows agree, and its error is within the limit."""
    if not result.converged:
        raise IdentificationError("the fit did not converge; the files hold its last state")
    if result.doubt:
        raise IdentificationError(f"do not use: {result.doubt}")
    if result.shift and not arguments.accept_shift:
        raise IdentificationError(
            f"{result.shift}. The files are written; --accept-shift accepts the result"
        )
    errors = result.error["calibrated"]
    part = "test" if "test" in errors else "train"
    rows = {"test": "held-out", "train": "fitted"}[part]
    require_accuracy(errors[part].get("mean_mm"), arguments.max_error, rows=rows)


def write_results(
    folder: Path,
    output: FitOutput,
    origin: dict[str, Any],
    *,
    view: bool = False,
) -> tuple[str, ...]:
    """Write all files of a fit to a folder; return notes on what the URDF can't represent."""
    from pincal.io.strict_json import write_json
    from pincal.report.html import report_page
    from pincal.report.subject import Subject

    calibration = output.calibration
    fit = calibration.fit
    fit.save(folder / "model.json", provenance=origin)
    write_json(folder / "result.json", calibration.result.to_dict())
    output.write(folder)
    notes = _write_urdf(folder, fit)
    _write_residuals(folder / "residuals.csv", calibration)
    if view:
        for write in _VIEWS.all():
            write(folder, calibration)
    page = report_page(
        Subject(calibration, origin, notes, output.search, view=VIEW if view else None)
    )
    (folder / "report.html").write_text(page, encoding="utf-8")
    return notes


def _write_urdf(folder: Path, fit: FittedRobot) -> tuple[str, ...]:
    """Write the calibrated URDF; return notes on what it can't represent.

    Raises:
        RobotFileError: if it can't be written, except for an arm whose calibrated loops do not
            close as a URDF has them: the model predicts nevertheless.
    """
    if why := fit.without_urdf:
        return (f"calibrated.urdf is not written, the calibration is in model.json only: {why}",)
    export = fit.export_urdf()
    (folder / "calibrated.urdf").write_bytes(export.text)
    return tuple(export.notes)


def _write_residuals(path: Path, calibration: Calibration) -> None:
    """Write measured minus predicted readings of every row: before, after, and by a fit without the
    row's fold.
    """
    from pincal.measure.table import write_table

    parts = [part for k in range(len(calibration.stations)) for part in _residuals(calibration, k)]
    names = dict.fromkeys(name for part in parts for name in part)
    absent = [np.full(len(part["line"]), np.nan) for part in parts]
    columns = {
        n: np.concatenate([part.get(n, none) for part, none in zip(parts, absent, strict=True)])
        for n in names
    }
    write_table(path, columns)


def _residuals(calibration: Calibration, k: int) -> Iterator[dict[str, np.ndarray]]:
    """Yield the columns of residuals.csv for the fitted rows of the k-th station, and for those
    held out.
    """
    from pincal.calibration.result_tables import residuals_by_name

    fit = calibration.fit.fit
    rows = calibration.stations[k]
    _, places, _ = list(fit.stations)[k]
    for part, table in zip(("fitted", "held out"), rows.measured, strict=True):
        if not len(table):
            continue
        problem = fit.readings(table, station=fit.problem.stations[k].name)
        weights = np.ones(len(table))
        if part == "fitted":
            weights = rows.by_row(fit.solution.weights[fit.problem.rows[k]])
        found = {"station": np.full(len(table), rows.name)} if len(calibration.stations) > 1 else {}
        found |= {
            "line": table.rows,
            "rows": np.full(len(table), part),
            "outlier": (weights == 0.0).astype(int),
        }
        for model, values in (("nominal", fit.nominal.values), ("calibrated", fit.values)):
            found |= residuals_by_name(problem, model, problem.residuals(values[places]))
        validated = calibration.validated
        if part == "fitted" and validated is not None:
            left_out = validated.lead[k].residuals
            # Where only a sample of very many rows was divided into folds, most have none.
            if left_out.shape[1] == len(table):
                found |= residuals_by_name(problem, "left_out", left_out)
        yield found


@contextmanager
def workers(
    dask: str | None, *, repeats: bool, processes: bool = True
) -> Iterator[Executor | None]:
    """Yield the executor of a command's repeated work, None for the command itself; pending work
    ends with the context.

    Args:
        dask: address of a Dask scheduler; default: this machine.
        repeats: whether the command has repeated work.
        processes: whether this machine uses a process for each core; these take seconds to start.

    Raises:
        BadInputError: if the cluster can't be used.
    """
    if dask is not None and not repeats:
        raise click.UsageError(
            "--dask: there are no repeated fits to distribute; calibrate has them with "
            "--split station, discover unless "
            "--stability is 0"
        )
    with ExitStack() as stack:
        executor: Executor | None = None
        if dask is not None:
            executor = _connected(dask, stack).get_executor()
        elif repeats and processes:
            executor = stack.enter_context(own_processes())
        yield executor


def _connected(address: str, stack: ExitStack) -> Any:
    """Return a client of a cluster whose workers have the same pincal."""
    try:
        from distributed import Client
    except ImportError as error:
        raise BadInputError(
            "--dask needs Dask: run pip install 'pincal[cluster]', here and on the workers"
        ) from error
    _require_scheduler(address)
    client = stack.enter_context(Client(address, timeout=_ANSWER, set_as_default=False))
    try:
        client.wait_for_workers(1, timeout=_WORKER)
    except TimeoutError as error:
        raise BadInputError(
            f"--dask {address}: the cluster has no workers; start some: dask worker {address}"
        ) from error
    _require_same_version(client, address)
    return client


def _require_scheduler(address: str) -> None:
    """Refuse an address at which no scheduler answers in time."""
    import asyncio

    try:
        found = asyncio.run(asyncio.wait_for(_identity(address), _ANSWER))
        if found["type"] != "Scheduler":
            raise ValueError(f"this is the address of a {found['type'].lower()}")
    except (OSError, ValueError) as error:
        why = str(error) or f"no answer within {_ANSWER:g} s"
        raise BadInputError(
            f"--dask {address}: {why}; expected the address of a running Dask scheduler, "
            "such as tcp://10.0.0.5:8786"
        ) from error


def _require_same_version(client: Any, address: str) -> None:
    """Refuse workers that lack pincal, or have another version of it than this command."""
    from importlib.metadata import PackageNotFoundError, version

    here = version("pincal")
    try:
        there = client.run(version, "pincal")
    except PackageNotFoundError as error:
        raise BadInputError(
            f"--dask {address}: its workers lack pincal; install version {here} there"
        ) from error
    if others := set(there.values()) - {here}:
        raise BadInputError(
            f"--dask {address}: its workers have pincal {', '.join(sorted(others))}; "
            f"expected {here}, as here"
        )


async def _identity(address: str) -> dict[str, Any]:
    """Ask what listens there. A client would wait for ever for an answer if it is not a scheduler,
    but a dashboard, say.
    """
    from distributed.core import rpc
    from distributed.security import Security

    async with rpc(address, connection_args=Security().get_connection_args("client")) as there:
        return dict(await there.identity())
