"""What calibrate and discover share: load, run a pipeline, write the folder of results, print, exit code."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import MISSING, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from pincal.cli.arguments import group, option
from pincal.cli.common import (
    CalibrationOptions,
    GeneralOptions,
    InputOptions,
    SplitOptions,
    max_error_option,
    verbose_option,
)
from pincal.cli.outputs import print_json, provenance, require_accuracy
from pincal.cli.workers import dask_option
from pincal.errors import Exit, IdentificationError
from pincal.io.result_folder import output_folder

if TYPE_CHECKING:
    from pincal.calibration.run import Calibration
    from pincal.discover.run import Discovery

# The view in three dimensions, beside the report.
VIEW = "view3d.html"
# Stations that have a view of their own: a page is about a megabyte.
_MOST_VIEWS = 12
FILES = "DIR then holds model.json (predicts without the URDF), result.json, calibrated.urdf, residuals.csv and report.html"
EXITS = (Exit.UNDECIDED, Exit.INACCURATE)


@dataclass(frozen=True, kw_only=True)
class FitArguments:
    """Arguments of calibrate and discover."""

    source: InputOptions = group("Input")
    out: Path = option("Folder for the results.", MISSING, metavar="DIR")
    max_error: float | None = max_error_option()
    verbose: bool = verbose_option()
    view: bool = option(f"Also write {VIEW}: the robot and its errors in 3D.", False)
    chosen: CalibrationOptions = group("Model")
    split: SplitOptions = group("Validation")
    accept_shift: bool = option(
        "Exit with 0 though readings shift from some row on, as if instrument or target had been touched.", False
    )
    dask: str | None = dask_option()
    general: GeneralOptions = group("General")


def run_fit(arguments: FitArguments, run: Callable[..., Calibration | Discovery]) -> Exit:
    """Run a calibration or a discovery on the files of the command line, write what it returns and print it.

    Raises:
        IdentificationError: if the fit did not converge, or instrument or target was touched between two rows; the files
            are written all the same.
        AccuracyGateError: if the error exceeds the limit; likewise.
    """
    from pincal.calibration.run import Calibration
    from pincal.cli.inputs import load_stations, prepare
    from pincal.cli.progress import tell_step

    split, source = arguments.split, arguments.source
    with output_folder(arguments.out) as draft:
        prepared = prepare(source, arguments.chosen)
        held = split.holdout
        shared = replace(source.table.options, shares_log=True)
        holdout = None if held is None else load_stations(prepared.robot, [held], options=shared)
        choice = {"test_fraction": split.test_fraction, "split": split.split, "seed": split.seed, "holdout": holdout}
        found = run(prepared.robot, prepared.tables, prepared.options, **choice)
        calibration, discovery = (found, None) if isinstance(found, Calibration) else (found.calibration, found)
        tell_step("writing the model")
        origin = provenance([*prepared.files, *filter(None, [held])], seed=split.seed)
        notes = write_results(draft, calibration, origin, discovery, view=arguments.view)
        written = " ".join(sorted(file.name for file in draft.iterdir()))
    result = calibration.result
    if arguments.general.as_json:
        print_json(result.to_dict() if discovery is None else discovery.report)
    else:
        from pincal.cli.brief import print_brief
        from pincal.cli.progress import console
        from pincal.cli.tables import print_discovery, print_notes, print_result

        if not arguments.verbose:
            print_brief(calibration, discovery, console(), folder=arguments.out, notes=notes)
        elif discovery is None:
            print_result(result, console())
        else:
            print_discovery(discovery, console())
            print_notes(result.warnings, console())
        for note in notes if arguments.verbose else ():
            click.echo(f"note: {note}")
        click.echo(f"written to {arguments.out}: {written}")
    if not result.converged:
        raise IdentificationError("the fit did not converge; the files hold its last state")
    if result.doubt:
        raise IdentificationError(f"not to be used: {result.doubt}")
    if result.shift and not arguments.accept_shift:
        raise IdentificationError(f"{result.shift}. The files are written; --accept-shift takes them as they are")
    part = "test" if "test" in result.error["calibrated"] else "train"
    rows = {"test": "held-out", "train": "fitted"}[part]
    require_accuracy(result.error["calibrated"][part]["mean_mm"], arguments.max_error, rows=rows)
    return Exit.DONE


def write_results(
    folder: Path,
    calibration: Calibration,
    origin: dict[str, Any],
    discovery: Discovery | None = None,
    *,
    view: bool = False,
) -> tuple[str, ...]:
    """Write all files of a calibration, or of a discovery, to a folder; return what the URDF could not carry, in words."""
    from pincal.io.strict_json import write_json
    from pincal.io.urdf_export import calibrated_urdf
    from pincal.report.html import report_page
    from pincal.report.subject import Subject

    fit = calibration.fit
    fit.save(folder / "model.json", provenance=origin)
    write_json(folder / "result.json", calibration.result.to_dict())
    if discovery is not None:
        write_json(folder / "discovery.json", discovery.report)
    robot = fit.robot_model()
    export = calibrated_urdf(robot.model, robot.values)
    (folder / "calibrated.urdf").write_bytes(export.text)
    _write_residuals(folder / "residuals.csv", calibration)
    if view:
        _write_views(folder, calibration)
    page = report_page(Subject(calibration, origin, export.notes, discovery, view=VIEW if view else None))
    (folder / "report.html").write_text(page, encoding="utf-8")
    return tuple(export.notes)


def _write_views(folder: Path, calibration: Calibration) -> None:
    """Write the view in three dimensions: of several stations a page for each, the first one under the usual name."""
    from pincal.measure.table import concatenate
    from pincal.viewer import build_scene, write_html

    stations = calibration.stations[:_MOST_VIEWS]
    names = [VIEW if k == 0 else f"{Path(VIEW).stem}-{rows.name}{Path(VIEW).suffix}" for k, rows in enumerate(stations)]
    for rows, name in zip(stations, names, strict=True):
        table = concatenate([rows.train, rows.test]) if len(rows.test) else rows.train
        held = np.repeat([False, True], [len(rows.train), len(rows.test)])
        others = ", ".join(other for other in names if other != name)
        notes = [f"station {rows.name}; the others are in {others}"] if others else []
        model = calibration.fit.at(rows.name) if others else calibration.fit.robot_model()
        write_html(folder / name.replace("/", "_"), build_scene(model, table, held_out=held, notes=notes))


def _write_residuals(path: Path, calibration: Calibration) -> None:
    """Write measured minus predicted readings of every row, before and after, fitted and held out."""
    from pincal.measure.table import write_table

    parts = [part for k in range(len(calibration.stations)) for part in _residuals(calibration, k)]
    names = dict.fromkeys(name for part in parts for name in part)
    absent = [np.full(len(part["line"]), np.nan) for part in parts]
    columns = {n: np.concatenate([part.get(n, none) for part, none in zip(parts, absent, strict=True)]) for n in names}
    write_table(path, columns)


def _residuals(calibration: Calibration, k: int) -> Iterator[dict[str, np.ndarray]]:
    """Yield the columns of residuals.csv for the fitted rows of the k-th station, and for those held out."""
    fit, rows = calibration.fit, calibration.stations[k]
    _, places, _ = list(fit.stations)[k]
    for part, table in zip(("fitted", "held out"), rows.measured, strict=True):
        if not len(table):
            continue
        problem, weights = fit.readings(table, station=fit.problem.stations[k].name), np.ones(len(table))
        if part == "fitted":
            weights = rows.by_row(fit.solution.weights[fit.problem.rows[k]])
        found = {"station": np.full(len(table), rows.name)} if len(calibration.stations) > 1 else {}
        found |= {"line": table.rows, "rows": np.full(len(table), part), "outlier": (weights == 0.0).astype(int)}
        for model, values in (("nominal", fit.nominal.values), ("calibrated", fit.values)):
            residuals = problem.residuals(values[places])
            names = [f"{component} [{block.unit}]" for block in problem.sensor.blocks for component in block.components]
            found |= {f"{model}_{name}": row for name, row in zip(names, residuals, strict=True)}
        yield found
