"""``pincal compensate``: from wanted poses or a nominal program to the joint positions that the real robot needs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import click
import numpy as np

from pincal.cli import show_progress
from pincal.cli.common import model_argument, output_options, print_json

# Rows that are listed one by one.
_SHOWN = 5
_CONDITIONS = ("payload", "temperature", "time")
# Exit code for rows that the user has to decide on.
_UNREACHED = 4

_EPILOG = """\b
Examples:
  pincal compensate results/model.json program.csv --out corrected.csv
  pincal compensate results/model.json program.csv --out corrected.csv --false-targets tip
  pincal compensate results/model.json poses.csv --out joints.csv --seed-joints "0 -90 90 0 90 0 deg"

TARGETS.csv has x y z of the target (and qx qy qz qw) in the instrument's frame, the joints to start from, and where they
matter payload, target, temperature, time, approach_<joint>. Without a quaternion the orientation is kept that the nominal
robot has at these joints. Without x y z the joints are a nominal program: wanted is where the nominal robot would bring the
target, in its base frame. Without joints --seed-joints is the start; unless given, the middle of the joints' ranges, and
any orientation if there is no quaternion.

FILE.csv has the joints to command, the wanted pose, what is left of the error by the model (error_mm, error_mrad), the
uncertainty of the model in this frame (sigma_mm), the largest change of a joint from its seed (change_max, rad or m) and
status: ok; singular (a small correction would take a large motion of joints: they stay near, the position first);
joint_limit; unreachable. Rows that are not ok hold the nearest within the limits, and are listed on stderr. Exit code 4 if
no row is ok, or with --strict if any is not.
"""


@click.command(epilog=_EPILOG)
@model_argument
@click.argument("targets", metavar="TARGETS.csv", type=click.Path(path_type=Path))
@click.option("--out", required=True, metavar="FILE.csv", type=click.Path(path_type=Path), help="Table to write.")
@click.option(
    "--frame",
    type=click.Choice(["instrument", "base"]),
    default="instrument",
    show_default=True,
    help="Frame of x y z in both tables: the instrument's or the robot's base.",
)
@click.option("--free-orientation", is_flag=True, help="Bring the target to x y z in any orientation.")
@click.option("--seed-joints", metavar='"Q1 Q2 ..."', help="Joints to start from, for tables without [rad or m, or deg].")
@click.option(
    "--false-targets",
    type=click.Choice(["tip", "target"]),
    help="Also write poses for a controller that has the nominal model: of the tip, or of the calibrated target.",
)
@click.option("--ignore-limits", is_flag=True, help="Don't stay within the joint limits of the URDF.")
@click.option("--strict", is_flag=True, help="Fail (exit 4) if any row is not ok; the table is written all the same.")
@click.option("--ignore", metavar="COLUMN", multiple=True, help="A column of the table to leave unread.")
@output_options
def compensate(model: Path, targets: Path, out: Path, as_json: bool, quiet: bool, **chosen: Any) -> int:
    """Find the joint positions that bring the real robot where it is wanted, closest to the ones given."""
    show_progress(quiet)
    from pincal.calibration.calibrated import load_model
    from pincal.compensate.run import run_compensation
    from pincal.compensate.targets import read_targets
    from pincal.measure.table import write_table

    calibrated = load_model(model)
    robot = calibrated.model.chain.robot
    table = read_targets(targets, robot, ignore=chosen["ignore"])
    done = run_compensation(
        calibrated,
        table,
        frame=chosen["frame"],
        seed=_seed(robot, table, chosen["seed_joints"]),
        any_orientation=chosen["free_orientation"],
        limits=not chosen["ignore_limits"],
    )
    write_table(out, _columns(calibrated, done, chosen["false_targets"]))
    result = _result(calibrated, done) | {"out": str(out)}
    if as_json:
        print_json(result)
    else:
        _tell(result)
    if not quiet:
        _warn(result)
    tolerated = 0 if chosen["strict"] else result["rows"] - 1
    return _UNREACHED if len(result["not_ok"]) > tolerated else 0


def _seed(robot: Any, table: Any, text: str | None) -> np.ndarray | None:
    """Return the joint positions to start from where the table has none, shape (n,)."""
    if text is None:
        return None
    if table.has_joints:
        raise click.UsageError("--seed-joints is for tables without joints; this one has its own: leave it out")
    words = re.split(r"[\s,;]+", text.strip())
    in_degrees = words[-1] == "deg"
    try:
        seed = np.array([float(word) for word in words[: -1 if in_degrees else None]])
    except ValueError:
        raise click.UsageError(f"--seed-joints {text!r}: expected {robot.n_joints} numbers, in rad (m) or deg") from None
    if len(seed) != robot.n_joints or not np.isfinite(seed).all():
        raise click.UsageError(f"--seed-joints {text!r}: {len(seed)} numbers; expected {robot.n_joints}, one a joint")
    turns = np.array([kind != "prismatic" for kind in robot.joint_types])
    return np.where(turns & in_degrees, np.deg2rad(seed), seed)


def _columns(calibrated: Any, done: Any, false_targets: Any) -> dict[str, np.ndarray]:
    """Return the table to write."""
    from pincal.compensate.frames import false_targets as poses_to_give

    rows, found = done.targets.rows, done.found
    columns: dict[str, np.ndarray] = dict(zip(rows.joint_names, found.q.T, strict=True))
    if len(calibrated.model.chain.targets) > 1:
        columns["target"] = rows.target
    columns |= {name: column for name in _CONDITIONS if (column := getattr(rows, name)) is not None}
    if rows.approach is not None:
        columns |= {f"approach_{name}": rows.approach[:, j] for j, name in enumerate(rows.joint_names)}
    columns |= _pose_columns(found.wanted, with_orientation=done.orientation == "keep")
    columns["error_mm"] = 1e3 * found.error
    if done.orientation == "keep":
        columns["error_mrad"] = 1e3 * found.turn
    columns["sigma_mm"] = 1e3 * done.sigma
    if done.targets.has_joints:
        columns["change_max"] = np.abs(found.q - done.seeds.q).max(axis=1)
    columns["status"] = found.status
    if false_targets:
        poses = _pose_columns(poses_to_give(calibrated, done.commanded, of=false_targets), with_orientation=True)
        columns |= {f"false_{name}": column for name, column in poses.items()}
    return columns


def _pose_columns(poses: np.ndarray, *, with_orientation: bool) -> dict[str, np.ndarray]:
    from pincal.robot.se3 import quaternions

    columns = dict(zip("xyz", poses[:, :, 3].T, strict=True))
    if with_orientation:
        columns |= zip(("qx", "qy", "qz", "qw"), quaternions(poses[:, :, :3]).T, strict=True)
    return columns


def _result(calibrated: Any, done: Any) -> dict[str, Any]:
    """Return the outcome for programs."""
    from pincal.compensate.reach import STATUSES

    found, lines = done.found, done.targets.rows.rows
    left = [
        {
            "line": int(lines[i]),
            "status": str(found.status[i]),
            "error_mm": 1e3 * float(found.error[i]),
            "error_mrad": 1e3 * float(found.turn[i]),
        }
        for i in np.flatnonzero(~found.is_ok)
    ]
    errors = {"commanded": _statistics(found.error)}
    if done.targets.has_joints:
        errors = {"seeds": _statistics(found.seed_error)} | errors
    return {
        "rows": len(lines),
        "frame": found.frame,
        "status": {name: int(np.sum(found.status == name)) for name in STATUSES},
        "error": errors,
        "sigma_mm": 1e3 * float(np.sqrt(np.mean(done.sigma**2))),
        "change": _largest_change(calibrated.model.chain.robot, done) if done.targets.has_joints else None,
        "outside": len({found.row for found in calibrated.outside(done.commanded)}),
        "curves": [found._asdict() for found in calibrated.outside_curves(done.commanded)],
        "not_ok": left,
    }


def _statistics(errors: np.ndarray) -> dict[str, float]:
    return {"mean_mm": 1e3 * float(errors.mean()), "max_mm": 1e3 * float(errors.max())}


def _largest_change(robot: Any, done: Any) -> dict[str, Any]:
    change = np.abs(done.found.q - done.seeds.q)
    row, joint = np.unravel_index(np.argmax(change), change.shape)
    unit = "m" if robot.joint_types[joint] == "prismatic" else "rad"
    name, line = robot.joint_names[joint], int(done.targets.rows.rows[row])
    return {"joint": name, "line": line, "value": float(change[row, joint]), "unit": unit}


def _tell(result: dict[str, Any]) -> None:
    counts = ", ".join(f"{count} {name}" for name, count in result["status"].items() if count)
    click.echo(f"{result['rows']} rows: {counts}")
    for name, words in (("seeds", "joints as given"), ("commanded", "joints to command")):
        if name in result["error"]:
            error = result["error"][name]
            click.echo(f"  {words:18s} miss by {error['mean_mm']:8.4f} mm, at most {error['max_mm']:8.4f} mm, by the model")
    if result["change"]:
        change = result["change"]
        size = f"{1e3 * change['value']:.4g} m{change['unit']}"
        click.echo(f"  largest change of a joint: {size} ({change['joint']}, line {change['line']})")
    of = {"instrument": "the instrument", "base": "the robot's base"}[result["frame"]]
    click.echo(f"  uncertainty of the model at these joints: {result['sigma_mm']:.4f} mm rms, seen from {of}")
    click.echo(f"written to {result['out']}")


def _warn(result: dict[str, Any]) -> None:
    """Say which rows are not reached, and where nobody has checked the model."""
    for row in result["not_ok"][:_SHOWN]:
        left = f"{row['error_mm']:.4g} mm and {row['error_mrad']:.4g} mrad are left"
        click.echo(f"pincal: note: line {row['line']}: {row['status']}, {left}", err=True)
    if len(result["not_ok"]) > _SHOWN:
        click.echo(f"pincal: note: {len(result['not_ok']) - _SHOWN} more rows are not ok; see column status", err=True)
    if result["outside"]:
        click.echo(f"pincal: note: {result['outside']} rows lie outside the poses that the calibration covered", err=True)
    for curve in result["curves"]:
        click.echo(
            f"pincal: note: {curve['rows']} rows ask for the {curve['effect']} of {curve['joint']} where it was not seen; "
            "it keeps its end value there",
            err=True,
        )
