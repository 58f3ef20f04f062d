"""``pincal calibrate``: from a URDF and a table to a calibrated model."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
import numpy as np

from pincal.cli import show_progress
from pincal.cli.common import (
    LENGTH,
    model_options,
    output_folder,
    output_options,
    print_json,
    provenance,
    robot_options,
    split_options,
    view_option,
)
from pincal.errors import AccuracyGateError

# The view in three dimensions, beside the report.
VIEW = "view3d.html"

_EPILOG = """\b
Example:
  pincal calibrate robot.urdf tracker.csv --out results --noise 0.05mm
  pincal calibrate ur10 series.csv --out results --max-error 0.2mm

DIR then holds model.json (predicts without the URDF), result.json, calibrated.urdf, residuals.csv and report.html.
Exit: 0 done, 2 usage, 3 bad input, 4 not converged, 5 --max-error not met.
"""


@click.command(epilog=_EPILOG)
@robot_options
@click.option(
    "--out", type=click.Path(path_type=Path, file_okay=True), required=True, metavar="DIR", help="Folder for the results."
)
@model_options
@split_options
@click.option("--max-error", type=LENGTH, help="Fail (exit 5) if the mean held-out error is larger, e.g. 0.1mm.")
@view_option
@output_options
def calibrate(robot: str, data: Path, out: Path, as_json: bool, quiet: bool, max_error: float | None, view: bool,
              **chosen: Any) -> int:  # fmt: skip
    """Calibrate a robot from a table of measured poses and validate on rows held out of the fit."""
    show_progress(quiet)
    from pincal.calibration.run import run_calibration
    from pincal.cli.inputs import load_robot, load_table, options_of

    with output_folder(out) as draft:
        arm = load_robot(robot, data, tip=chosen["tip"], base=chosen["base"])
        table = load_table(arm, data, ignore=chosen["ignore"])
        held = None if chosen["holdout"] is None else load_table(arm, chosen["holdout"], ignore=chosen["ignore"])
        calibration = run_calibration(
            arm,
            table,
            options_of(chosen, table),
            test_fraction=chosen["test_fraction"],
            split=chosen["split"],
            seed=chosen["seed"],
            holdout=held,
        )
        others = [chosen[name] for name in ("holdout", "points", "distances", "camera") if chosen[name]]
        files = [data, *others, Path(arm.source)]
        exported = write_results(draft, calibration, provenance(files, seed=chosen["seed"]), view=view)
    if as_json:
        print_json(calibration.result.to_dict())
    else:
        from pincal.cli.tables import console, print_result

        print_result(calibration.result, console())
        for note in exported:
            click.echo(f"note: {note}")
        click.echo(f"written to {out}: model.json result.json calibrated.urdf residuals.csv report.html" + view * f" {VIEW}")
    return verdict(calibration.result, max_error)


def write_results(
    folder: Path, calibration: Any, origin: dict[str, Any], discovery: Any = None, *, view: bool = False
) -> tuple[str, ...]:
    """Write all files of a calibration, or of a discovery, to a folder; return what the URDF could not carry, in words."""
    from pincal.calibration.calibrated import calibrated_model_of, save_model
    from pincal.io.urdf_export import calibrated_urdf
    from pincal.report.html import write_report

    fit = calibration.fit
    model = calibrated_model_of(fit, origin)
    save_model(folder / "model.json", model)
    (folder / "result.json").write_text(json.dumps(calibration.result.to_dict(), indent=1, allow_nan=False))
    export = calibrated_urdf(fit.model, fit.values)
    (folder / "calibrated.urdf").write_bytes(export.text)
    write_residuals(folder / "residuals.csv", calibration)
    if view:
        _write_view(folder / VIEW, calibration, model)
    write_report(folder / "report.html", calibration, origin, export.notes, discovery, view=VIEW if view else None)
    return tuple(export.notes)


def _write_view(path: Path, calibration: Any, model: Any) -> None:
    from pincal.measure.table import concatenate
    from pincal.viewer import build_scene, write_html

    train, test = calibration.train, calibration.test
    rows = concatenate([train, test]) if len(test) else train
    write_html(path, build_scene(model, rows, held_out=np.repeat([False, True], [len(train), len(test)])))


def write_residuals(path: Path, calibration: Any) -> None:
    """Write reading minus prediction of every row, before and after, fitted and held out."""
    from pincal.measure.table import write_table

    columns: dict[str, list[np.ndarray]] = {}
    fit = calibration.fit
    for part, table, problem in (
        ("fitted", calibration.train, fit.problem),
        ("held out", calibration.test, calibration.test_problem()),
    ):
        if problem is None:
            continue
        weights = fit.solution.weights if part == "fitted" else np.ones(len(table))
        found = {"line": table.rows, "rows": np.full(len(table), part), "outlier": (weights == 0.0).astype(int)}
        for model, values in (("nominal", fit.nominal.values), ("calibrated", fit.values)):
            residuals = problem.residuals(values)
            names = [(b, axis) for b in problem.sensor.blocks for axis in {3: "xyz", 2: "uv"}.get(b.size, "1")]
            for (block, axis), row in zip(names, residuals, strict=True):
                suffix = f"_{axis}" if block.size > 1 else ""
                found[f"{model}_{block.name}{suffix} [{block.unit}]"] = row
        for name, column in found.items():
            columns.setdefault(name, []).append(column)
    write_table(path, {name: np.concatenate(parts) for name, parts in columns.items()})


def verdict(result: Any, max_error: float | None) -> int:
    """Return the exit code: 4 if the fit did not converge, 5 if the gate is not met."""
    if not result.converged:
        click.echo("pincal: the fit did not converge; the files hold its last state", err=True)
        return 4
    rows = result.error["calibrated"]
    mean = rows.get("test", rows["train"])["mean_mm"]
    if max_error is not None and mean > max_error * 1e3:
        error = AccuracyGateError(f"mean error {mean:.4f} mm on {'held-out' if 'test' in rows else 'fitted'} rows; "
                                  f"--max-error allows {max_error * 1e3:g} mm")  # fmt: skip
        click.echo(f"pincal: {error}", err=True)
        return error.exit_code
    return 0
