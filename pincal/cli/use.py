"""``pincal validate``, ``predict`` and ``export``: what a calibrated model is used for."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
import numpy as np

from pincal.atomic import write_whole
from pincal.cli import show_progress
from pincal.cli.common import LENGTH, model_argument, output_options, print_json
from pincal.errors import AccuracyGateError, BadInputError

# Rows outside the covered range that a note lists one by one.
_SHOWN = 5


@click.command(epilog="\b\nExample:\n  pincal validate results/model.json new_measurements.csv --max-error 0.1mm\n")
@model_argument
@click.argument("data", metavar="DATA.csv", type=click.Path(path_type=Path))
@click.option("--ignore", metavar="COLUMN", multiple=True, help="A column of the table to leave unread.")
@click.option("--max-error", type=LENGTH, help="Fail (exit 5) if the mean error is larger, e.g. 0.1mm.")
@output_options
def validate(model: Path, data: Path, ignore: tuple[str, ...], max_error: float | None, as_json: bool, quiet: bool) -> int:
    """Say how true a calibrated model is on measurements that it never saw."""
    show_progress(quiet)
    from pincal.calibration.calibrated import load_model
    from pincal.calibration.run import check_table
    from pincal.cli.inputs import load_table
    from pincal.measure.admission import scorable_rows
    from pincal.validate.accuracy import error_table
    from pincal.validate.lack_of_fit import replicate_statistics

    calibrated = load_model(model)
    robot = calibrated.model.chain.robot
    table = load_table(robot, data, ignore=ignore)
    _check_targets(calibrated, table)
    if calibrated.setup.points and calibrated.sensor_kind == table.kind:
        table = scorable_rows(table, calibrated.setup)
    check_table(robot, table, minimum=1)
    problem = calibrated.readings(table)
    error = {"calibrated": {"test": error_table(problem, calibrated.values)}}
    visited = replicate_statistics(
        problem, calibrated.values, table, sigma=calibrated.sigma, covariance=calibrated.covariance
    )
    outside = calibrated.outside(problem.conditions)
    curves = [found._asdict() for found in calibrated.outside_curves(problem.conditions)]
    if as_json:
        counted = {"rows": {"test": len(table)}, "error": error}
        print_json(counted | visited | {"outside": len({row for row, *_ in outside}), "curves": curves})
    else:
        from pincal.calibration.tables import error_table as as_table
        from pincal.cli.tables import console, print_replicates

        console().print(as_table(error))
        print_replicates(visited.get("iso9283"), visited.get("lack_of_fit"), console())
    _warn_outside(outside, table.rows)
    _warn_outside_curves(curves, robot)
    mean = error["calibrated"]["test"]["mean_mm"]
    if max_error is not None and mean > max_error * 1e3:
        gate = AccuracyGateError(f"mean error {mean:.4f} mm; --max-error allows {max_error * 1e3:g} mm")
        click.echo(f"pincal: {gate}", err=True)
        return gate.exit_code
    return 0


@click.command(epilog="\b\nExample:\n  pincal predict results/model.json poses.csv --out predicted.csv\n")
@model_argument
@click.argument("poses", metavar="POSES.csv", type=click.Path(path_type=Path))
@click.option("--out", required=True, metavar="FILE.csv", type=click.Path(path_type=Path), help="Table to write.")
@output_options
def predict(model: Path, poses: Path, out: Path, as_json: bool, quiet: bool) -> int:
    """Predict where the target is at given joint positions, in the instrument's frame, with its uncertainty."""
    show_progress(quiet)
    from pincal.calibration.calibrated import load_model
    from pincal.cli.inputs import load_table
    from pincal.identify.problem import conditions_of
    from pincal.measure.table import write_table
    from pincal.robot.se3 import quaternions

    calibrated = load_model(model)
    table = load_table(calibrated.model.chain.robot, poses, joints_only=True)
    _check_targets(calibrated, table)
    conditions = conditions_of(calibrated.model, table, np.array(calibrated.payload_centre))
    found = calibrated.predict(conditions)
    columns: dict[str, np.ndarray] = {name: table.q[:, i] for i, name in enumerate(table.joint_names)}
    if len(calibrated.model.chain.targets) > 1:
        columns["target"] = table.target
    columns |= {axis: found[:, i, 3] for i, axis in enumerate("xyz")}
    if calibrated.sensor_kind in ("pose", "camera_point", "camera_pixel"):
        columns |= dict(zip(("qx", "qy", "qz", "qw"), quaternions(found[:, :, :3]).T, strict=True))
    columns |= {f"sigma_{axis}": column for axis, column in zip("xyz", calibrated.position_sigma(conditions).T, strict=True)}
    write_table(out, columns)
    outside = calibrated.outside(conditions)
    curves = [found._asdict() for found in calibrated.outside_curves(conditions)]
    if as_json:
        print_json({"rows": len(table), "out": str(out), "outside": len({row for row, *_ in outside}), "curves": curves})
    else:
        click.echo(f"{len(table)} poses predicted, written to {out}")
    _warn_outside(outside, table.rows)
    _warn_outside_curves(curves, calibrated.model.chain.robot)
    return 0


@click.command(epilog="\b\nExample:\n  pincal export results/model.json --urdf calibrated.urdf\n")
@model_argument
@click.option("--urdf", metavar="FILE.urdf", type=click.Path(path_type=Path), help="URDF to write.")
@click.option("--camera", metavar="FILE.json", type=click.Path(path_type=Path),
              help="Camera to write: lens and mount, as calibrate reads it.")  # fmt: skip
@output_options
def export(model: Path, urdf: Path | None, camera: Path | None, as_json: bool, quiet: bool) -> int:
    """Write the calibrated URDF: the original file with its joint origins corrected, checked against the model."""
    show_progress(quiet)
    from pincal.calibration.calibrated import load_model
    from pincal.io.urdf_export import calibrated_urdf

    if urdf is None and camera is None:
        raise click.UsageError("give --urdf FILE.urdf, --camera FILE.json, or both")
    calibrated = load_model(model)
    if camera is not None:
        write_whole(camera, json.dumps(calibrated.camera(), indent=1) + "\n", advice="choose another file")
        if urdf is None:
            print_json({"camera": str(camera)}) if as_json else click.echo(f"written to {camera}")
            return 0
    assert urdf is not None
    if not calibrated.model.chain.robot.urdf:
        raise BadInputError(f"{model}: holds no URDF to correct; calibrate again from a URDF file")
    written = calibrated_urdf(calibrated.model, calibrated.values)
    write_whole(urdf, written.text, advice="choose another file")
    if as_json:
        print_json({"urdf": str(urdf), "max_error_m": written.max_error_m, "notes": list(written.notes)})
        return 0
    click.echo(f"written to {urdf}; its forward kinematics equal the model's to {written.max_error_m:.1e} m")
    for note in written.notes:
        click.echo(f"note: {note}")
    return 0


def _check_targets(calibrated: Any, table: Any) -> None:
    known = calibrated.model.chain.targets
    unknown = sorted(set(map(str, table.target)) - set(known))
    if unknown and len(known) > 1:
        raise BadInputError(f"{table.source}: target {unknown[0]!r} is not in the model; expected one of {', '.join(known)}")


def _warn_outside(outside: list[Any], lines: np.ndarray) -> None:
    """Say which rows lie outside what the calibration has seen: there it extrapolates."""
    rows = sorted({row for row, *_ in outside})
    if not rows:
        return
    click.echo(f"pincal: note: {len(rows)} rows lie outside the poses that the calibration covered", err=True)
    for row, name, value, low, high in outside[:_SHOWN]:
        click.echo(f"pincal: note: line {lines[row]}: {name} = {value:.4g}, covered {low:.4g} to {high:.4g}", err=True)


def _warn_outside_curves(curves: list[dict[str, Any]], robot: Any) -> None:
    """Say which curves of joints are asked for where they were never seen."""
    for curve in curves:
        unit = {"time": "s", "temperature": "deg C", "payload": "kg"}.get(curve["variable"])
        if unit is None:
            unit = "m" if robot.joint_types[robot.joint_names.index(curve["variable"])] == "prismatic" else "rad"
        click.echo(
            f"pincal: note: {curve['rows']} rows ask for the {curve['effect']} of {curve['joint']} at {curve['variable']} "
            f"{curve['lowest']:.4g} to {curve['highest']:.4g} {unit}; it was seen from {curve['lower']:.4g} to "
            f"{curve['upper']:.4g} only and keeps its end value there",
            err=True,
        )
