"""``pincal predict`` and ``pincal compensate``: from joint positions to poses of the real robot,
and back.
"""

from __future__ import annotations

import re
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click
import numpy as np

from pincal.cli.arguments import argument, group, option, verb
from pincal.cli.common import TABLE, GeneralOptions, PlaceOptions, TableArguments, model_argument
from pincal.cli.identity_options import HEADING, IdentityOptions
from pincal.cli.outputs import columns_of_poses, echo_notes, extrapolation, print_json
from pincal.cli.quantities import ANGLE
from pincal.cli.target_files import PROGRAMS, FileCorrection, TargetFiles
from pincal.errors import Exit, counted, few
from pincal.recorded import RECORDABLE
from pincal.thresholds import Count
from pincal.units import format_joint, plain_number

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from pincal.calibration.fitted_robot import FittedRobot
    from pincal.cli.inputs import PlacedModel
    from pincal.compensate.targets import CompensatedTable, Targets
    from pincal.model.conditions import Conditions
    from pincal.robot.robot import Robot

# Number of rows that are listed individually.
_SHOWN: Count = 5
_CONDITIONS = [name for name, variable in RECORDABLE.items() if not variable.of_joints]

_OPEN_BASE = (
    "the readings of the calibration do not tell where the base stands, which the standard "
    "deviations of positions include; ten rows of an instrument tell it (--placement)"
)
_PREDICT_EXAMPLES = """
Examples:
  pincal predict results/model.json poses.csv --out predicted.csv
  pincal predict results/model.json poses.csv --out predicted.csv --placement ten_rows_of_today.csv
"""
_EXAMPLES = """
Examples:
  pincal compensate results/model.json program.csv --out corrected.csv
  pincal compensate results/model.json program.csv --out corrected.csv --false-targets tip
  pincal compensate results/model.json program.csv --out corrected.csv \
--placement ten_rows_of_today.csv
  pincal compensate results/model.json poses.csv --out joints.csv \
--seed-joints "0 -90 90 0 90 0 deg"
  pincal compensate results/model.json weld.src --out corrected/weld.src \
--tool 'TOOL_DATA[1]=0,0,250,0,0,0'

TARGETS may be a controller's program: KUKA .src and .dat, ABB .mod, .prg and .sys, FANUC .ls,
Universal Robots .script, Yaskawa .jbi. Only its numbers change; points that can't be interpreted
are listed and left unchanged. The rest applies to tables.

TARGETS.csv has the desired target position x y z (and orientation qx qy qz qw) in the instrument's
frame, joint positions to start from, and, where they matter, payload, target, temperature, time and
approach_<joint>. Without a quaternion, the orientation of the nominal robot at these joint
positions is kept. Without x y z, the joint positions are a nominal program: the desired pose is the
one that the nominal robot would reach, in its base frame. Without joint positions, the search
starts from --seed-joints (default: the middle of the joint ranges, and any orientation if there is
no quaternion).

FILE.csv has the joint positions to command, the desired pose, the remaining error predicted by the
model (error_mm, error_mrad), the uncertainty of the model in this frame (sigma_mm; where contacts,
distances or an IMU alone leave open where the base stands: once base and target are located), the
largest change of a joint from its start (change_max, rad or m; if any is more than --max-change,
the column large_change is 1 in these rows: check them before the robot moves) and a status:

\b
  ok           reached
  singular     a small correction would need large joint motions; the joints stay close to their
               start, and position has priority over orientation
  joint_limit  a joint stops at its limit
  unreachable  no joint positions were found

Rows that are not ok hold the closest pose within the limits and are listed on stderr. The exit code
is 4 if no row is ok or, with --strict, if any row is not.
"""


@dataclass(frozen=True, kw_only=True)
class _AtPlace:
    """Arguments of both commands."""

    model: Path = model_argument()
    place: PlaceOptions = group("Placement of instrument and target")
    table: TableArguments = group("Tables")
    identity: IdentityOptions = group(HEADING)
    general: GeneralOptions = group("General")

    def find_place(self) -> PlacedModel:
        """Return the model at the place chosen, with a note if it does not state its robot.

        Raises:
            BadInputError: if it is of another robot than stated; further as for
                :func:`pincal.cli.inputs.find_place`.
        """
        from pincal.cli.checked import said_by_checks
        from pincal.cli.inputs import find_place

        place = find_place(self.model, self.place, self.table.options)
        notes = self.identity.of_model(place.model.identity, self.model)
        return place.stated([*notes, *said_by_checks(self.model)])


@dataclass(frozen=True, kw_only=True)
class PredictArguments(_AtPlace):
    """Arguments of predict."""

    poses: Path = argument(
        "POSES.csv", "Joint positions and conditions; other columns are ignored."
    )
    out: Path = option("Table to write.", MISSING, type=TABLE)
    components: bool = option(
        "Also write the uncertainty of the position by each source, u_SOURCE_x u_SOURCE_y "
        "u_SOURCE_z [m]: of the parameters, the model, the arrival, the conditions.",
        False,
    )


@verb(
    PredictArguments,
    examples=_PREDICT_EXAMPLES,
    exits=(Exit.CHANGED,),
    shown=("out", "components", "placement", "station", "start", "to", "as_json", "quiet"),
)
def predict(arguments: PredictArguments) -> Exit:
    """Predict target positions at given joint positions.

    They are given in the instrument's frame, with their uncertainty.
    """
    from pincal.cli.inputs import load_table
    from pincal.cli.progress import end_progress, log_step
    from pincal.measure.table import write_table

    place = arguments.find_place()
    chain = place.model.model.chain
    table = load_table(
        chain.robot, arguments.poses, options=arguments.table.options, joints_only=True
    )
    place = place.over(table)
    calibrated = place.model
    conditions = calibrated.conditions(table)
    log_step(f"predicting {counted(len(table), 'pose')}, with uncertainty")
    found = calibrated.predict(conditions)
    columns: dict[str, np.ndarray] = dict(zip(table.joint_names, table.q.T, strict=True))
    if len(chain.targets) > 1:
        columns["target"] = table.target
    columns |= columns_of_poses(found, with_orientation=calibrated.model.has_tool_orientation)
    columns |= _uncertainties(calibrated, conditions, by_source=arguments.components)
    write_table(arguments.out, columns)
    beyond, notes = extrapolation(calibrated, conditions, table.rows)
    end_progress()
    if arguments.general.as_json:
        print_json({"rows": len(table), "out": str(arguments.out)} | place.contents | beyond)
    else:
        _echo_machine(calibrated)
        click.echo(f"{counted(len(table), 'pose')} predicted, written to {arguments.out}")
    notes = [*place.notes, *notes, *([] if calibrated.station.is_placed else [_OPEN_BASE])]
    echo_notes(notes, quiet=arguments.general.quiet)
    return Exit.DONE


def _uncertainties(
    calibrated: FittedRobot, conditions: Conditions, *, by_source: bool
) -> dict[str, np.ndarray]:
    """Return the columns of standard uncertainties of predicted poses [m, rad]."""
    turns = calibrated.model.has_tool_orientation
    axes = ("x", "y", "z", "rx", "ry", "rz") if turns else ("x", "y", "z")
    variances = calibrated.uncertainty.variances(conditions, turns=turns)
    columns = _of_axes("sigma", axes, np.sqrt(sum(variances.values())))
    if by_source:
        for source, variance in variances.items():
            columns |= _of_axes(f"u_{source}", axes[:3], np.sqrt(variance[:, :3]))
    return columns


def _of_axes(name: str, axes: Sequence[str], values: np.ndarray) -> dict[str, np.ndarray]:
    """Return values along axes, shape (N, 3), as columns."""
    return {f"{name}_{axis}": column for axis, column in zip(axes, values.T, strict=True)}


@dataclass(frozen=True, kw_only=True)
class CompensateArguments(_AtPlace):
    """Arguments of compensate."""

    targets: Path = argument(
        "TARGETS.csv",
        "Desired poses with or without start values, a nominal program, or a controller's program.",
    )
    out: Path = option("Table or program to write.", MISSING)
    frame: Literal["instrument", "base"] = option(
        "Frame of x y z in both tables: the instrument's or the robot's base.", "instrument"
    )
    free_orientation: bool = option("Reach the positions x y z in any orientation.", False)
    seed_joints: str | None = option(
        "Joint positions to start from, if the table has none: rad or m, or degrees with "
        "'deg' at the end.",
        metavar='"Q1 Q2 ..."',
        words="middle of the joint ranges",
    )
    false_targets: Literal["tip", "target"] | None = option(
        "Also write poses for a controller that uses the nominal model: of the tip, or of "
        "the calibrated target."
    )
    max_change: float = option(
        "Mark rows in which a joint moves by more than this from its start (prismatic: "
        "the same number in m).",
        float(np.deg2rad(2.0)),
        type=ANGLE,
        metavar="ANGLE",
        words="2deg",
    )
    ignore_limits: bool = option("Ignore the joint limits of the URDF.", False)
    only_numbers: bool = option(
        "Change only the numbers of a table of joints and add no columns; rows that are "
        "not ok keep theirs.",
        False,
    )
    strict: bool = option(
        "Fail (exit code 4) if any row is not ok; the table is written nevertheless.", False
    )
    program: TargetFiles = group(PROGRAMS, is_handed_in=True)


@verb(
    CompensateArguments,
    examples=_EXAMPLES,
    exits=(Exit.UNDECIDED, Exit.CHANGED),
    shown=(
        "out",
        "frame",
        "free_orientation",
        "seed_joints",
        "false_targets",
        "max_change",
        "placement",
        "payload",
        "explain",
        "strict",
        "as_json",
    ),
)
def compensate(arguments: CompensateArguments) -> Exit:
    """Find the joint positions that reach desired poses.

    Of all solutions for the real robot, the one closest to the given joint positions is chosen.
    """
    place = arguments.find_place()
    if arguments.program.reads(arguments.targets):
        if not arguments.general.as_json:
            _echo_machine(place.model)
        robot = place.model.model.chain.robot
        code = arguments.program.correct(place.model, _correction(robot, arguments))
        echo_notes(place.notes, quiet=arguments.general.quiet)
        return code
    return _compensate_table(place, arguments)


def _compensate_table(place: PlacedModel, arguments: CompensateArguments) -> Exit:
    """Write the joint positions to command for a table of targets, and print how well they
    reach these.
    """
    from pincal.cli.progress import end_progress
    from pincal.compensate.returned_table import write_returned
    from pincal.compensate.targets import read_targets, unreached_turns

    robot = place.model.model.chain.robot
    table = read_targets(arguments.targets, robot, options=arguments.table.options)
    place = place.over(table.rows)
    calibrated = place.model
    done = _compensated(calibrated, table, arguments)
    columns = _returned_columns(calibrated, done, arguments)
    write_returned(arguments.out, table.cells, columns, robot.joint_names)
    beyond, notes = extrapolation(calibrated, done.commanded, table.rows.rows)
    result = _result(robot, done, beyond, max_change=arguments.max_change)
    result |= place.contents | {"out": str(arguments.out)}
    result["is_placed"] = calibrated.station.is_placed
    result["holds_lengths"] = calibrated.holds_lengths
    result["turn"]["unreached"] = unreached_turns(calibrated, done)
    end_progress()
    if arguments.general.as_json:
        print_json(result)
    else:
        _echo_machine(calibrated)
        click.echo("\n".join(_summary(result)))
    failures = _failures(result, has_summary=not arguments.general.as_json)
    echo_notes([*failures, *place.notes, *notes], quiet=arguments.general.quiet)
    tolerated = 0 if arguments.strict else result["rows"] - 1
    return Exit.UNDECIDED if len(result["not_ok"]) > tolerated else Exit.DONE


def _compensated(
    calibrated: FittedRobot, table: Targets, arguments: CompensateArguments
) -> CompensatedTable:
    """Return the joint positions that reach targets, as chosen on the command line."""
    from pincal.compensate.targets import run_compensation

    return run_compensation(
        calibrated,
        table,
        frame=arguments.frame,
        seed=_seed(calibrated.model.chain.robot, table, arguments.seed_joints),
        any_orientation=arguments.free_orientation,
        limits=not arguments.ignore_limits,
    )


def _echo_machine(model: FittedRobot) -> None:
    """Print of which robot a model is, if it states that."""
    if model.identity.machine:
        click.echo(f"for {model.identity.machine}")


def _correction(robot: Robot, arguments: CompensateArguments) -> FileCorrection:
    """Return how a controller's program is to be corrected."""
    return FileCorrection(
        path=arguments.targets,
        out=arguments.out,
        seed=_seed(robot, None, arguments.seed_joints),
        keeps_limits=not arguments.ignore_limits,
        max_change=arguments.max_change,
        is_strict=arguments.strict,
        as_json=arguments.general.as_json,
        quiet=arguments.general.quiet,
    )


def _seed(robot: Robot, table: Targets | None, text: str | None) -> np.ndarray | None:
    """Return the joint positions to start from if the table has none, shape (n,)."""
    if text is None:
        return None
    if table is not None and table.has_joints:
        raise click.UsageError(
            "--seed-joints is for tables without joint columns; this table has them: leave it out"
        )
    words = re.split(r"[\s,;]+", text.strip())
    in_degrees = words[-1] == "deg"
    try:
        seed = np.array([plain_number(word) for word in words[: -1 if in_degrees else None]])
    except ValueError:
        raise click.UsageError(
            f"--seed-joints {text!r}: expected {robot.n_joints} numbers, in rad (m) or deg"
        ) from None
    if len(seed) != robot.n_joints or not np.isfinite(seed).all():
        raise click.UsageError(
            f"--seed-joints {text!r}: {len(seed)} numbers; expected {robot.n_joints}, one per joint"
        )
    turns = np.array([kind != "prismatic" for kind in robot.joint_types])
    return np.where(turns & in_degrees, np.deg2rad(seed), seed)


def _returned_columns(
    calibrated: FittedRobot, done: CompensatedTable, arguments: CompensateArguments
) -> dict[str, np.ndarray]:
    """Return the columns to write: all of them, or the joints alone."""
    columns = _columns(calibrated, done, arguments)
    if arguments.only_numbers:
        return _joint_columns(calibrated.model.chain.robot, done)
    return columns


def _joint_columns(robot: Robot, done: CompensatedTable) -> dict[str, np.ndarray]:
    """Return the joint positions to command, in rows that are not ok those of the table."""
    if not done.targets.has_joints:
        raise click.UsageError(
            "--only-numbers changes the numbers of joint columns; this table has none: leave it out"
        )
    kept = np.where(done.found.is_ok[:, None], done.found.q, robot.as_reported(done.seeds.q))
    return dict(zip(robot.joint_names, kept.T, strict=True))


def _columns(
    calibrated: FittedRobot, done: CompensatedTable, arguments: CompensateArguments
) -> dict[str, np.ndarray]:
    rows = done.targets.rows
    found = done.found
    columns: dict[str, np.ndarray] = dict(zip(rows.joint_names, found.q.T, strict=True))
    if len(calibrated.model.chain.targets) > 1:
        columns["target"] = rows.target
    columns |= {name: column for name in _CONDITIONS if (column := getattr(rows, name)) is not None}
    if rows.approach is not None:
        columns |= {
            f"approach_{name}": rows.approach[:, j] for j, name in enumerate(rows.joint_names)
        }
    columns |= columns_of_poses(found.wanted, with_orientation=done.orientation == "keep")
    columns["error_mm"] = 1e3 * found.error
    if done.orientation == "keep":
        columns["error_mrad"] = 1e3 * found.turn
    columns["sigma_mm"] = 1e3 * done.sigma
    if done.targets.has_joints:
        columns["change_max"] = np.abs(done.change).max(axis=1)
        large = columns["change_max"] > arguments.max_change
        columns |= {"large_change": large.astype(int)} if large.any() else {}
    columns["status"] = found.status
    if arguments.false_targets:
        columns |= _false_targets(calibrated, done, of=arguments.false_targets)
    return columns


def _false_targets(
    calibrated: FittedRobot, done: CompensatedTable, *, of: Literal["tip", "target"]
) -> dict[str, np.ndarray]:
    """Return the poses for a controller that uses the nominal model, in the columns of the table's
    own poses where it has some.
    """
    from pincal.compensate.returned_table import false_columns
    from pincal.compensate.robot_frames import false_targets

    poses = false_targets(calibrated, done.commanded, of=of)
    targets = done.targets
    has_poses = targets.rows.position is not None and targets.cells.orientation is not None
    own = false_columns(targets.cells, poses) if has_poses else None
    named = columns_of_poses(poses, with_orientation=True)
    return own or {f"false_{name}": column for name, column in named.items()}


def _result(
    robot: Robot, done: CompensatedTable, beyond: dict[str, Any], *, max_change: float
) -> dict[str, Any]:
    """Return the result for ``--json``."""
    from pincal.compensate.solve_ik import STATUSES

    found = done.found
    lines = done.targets.rows.rows
    errors = {"commanded": _statistics(found.error)}
    change = None
    large = list[int]()
    if done.targets.has_joints:
        errors = {"seeds": _statistics(found.seed_error)} | errors
        moved = np.abs(done.change)
        large = [int(line) for line in lines[moved.max(axis=1) > max_change]]
        change = _largest_change(robot, moved, lines)
    return {
        "rows": len(lines),
        "frame": found.frame,
        "status": {name: int(np.sum(found.status == name)) for name in STATUSES},
        "error": errors,
        "sigma_mm": 1e3 * float(np.sqrt(np.mean(done.sigma**2))),
        "change": change,
        "max_change": max_change,
        "large_changes": large,
        "not_ok": _not_ok(done),
        "turn": {
            "max_mrad": 1e3 * float(found.turn.max()),
            "line": int(lines[found.turn.argmax()]),
        },
    } | beyond


def _largest_change(robot: Robot, moved: np.ndarray, lines: np.ndarray) -> dict[str, Any]:
    """Return which joint moves most from its start, by how much, and in which line.

    Args:
        robot: the arm of n joints.
        moved: shape (N, n), changes of the joints in N rows.
        lines: shape (N,), lines of the rows.
    """
    row, joint = np.unravel_index(np.argmax(moved), moved.shape)
    return {
        "joint": robot.joint_names[joint],
        "line": int(lines[row]),
        "value": float(moved[row, joint]),
        "unit": robot.joint_units[joint],
    }


def _not_ok(done: CompensatedTable) -> list[dict[str, Any]]:
    """Return the rows that are not ok, each with its remaining error."""
    found = done.found
    return [
        {
            "line": int(done.targets.rows.rows[i]),
            "status": str(found.status[i]),
            "error_mm": 1e3 * float(found.error[i]),
            "error_mrad": 1e3 * float(found.turn[i]),
        }
        for i in np.flatnonzero(~found.is_ok)
    ]


def _statistics(errors: np.ndarray) -> dict[str, float]:
    return {"mean_mm": 1e3 * float(errors.mean()), "max_mm": 1e3 * float(errors.max())}


def _summary(result: dict[str, Any]) -> Iterator[str]:
    counts = ", ".join(f"{count} {name}" for name, count in result["status"].items() if count)
    yield f"{counted(result['rows'], 'row')}: {counts}"
    frame = {"instrument": "the instrument's frame", "base": "the robot's base frame"}[
        result["frame"]
    ]
    if "seeds" in result["error"]:
        yield f"  joints as given    miss the targets by {_sizes(result['error']['seeds'])}"
    known = f"meet them with an uncertainty of {result['sigma_mm']:.4f} mm rms"
    if result["is_placed"]:
        yield f"  joints to command  {known} in {frame}"
    else:
        yield f"  joints to command  {known} once base and target"
        yield "                     are located: the readings do not tell where the base stands"
    if result["holds_lengths"]:
        yield "                     (without the errors of its lengths, which are as in the URDF)"
    yield from _not_ok_lines(result["not_ok"])
    if result["change"]:
        change = result["change"]
        size = format_joint(change["value"], change["unit"])
        yield f"  largest change     {size} of a joint ({change['joint']}, line {change['line']})"
    yield f"written to {result['out']}"


def _not_ok_lines(not_ok: list[dict[str, Any]]) -> Iterator[str]:
    """Yield what the rows that are not ok lack and need; singular ones lack orientation alone."""
    singular = [row for row in not_ok if row["status"] == "singular"]
    missed = [row for row in not_ok if row["status"] != "singular"]
    if singular:
        worst = max(singular, key=lambda row: float(row["error_mrad"]))
        yield (
            f"  singular           {counted(len(singular), 'row')}: positions met, orientations "
            f"off by up to {_angle(worst['error_mrad'])} (line {worst['line']});"
        )
        yield "                     if that is too much, move their targets off singular poses"
    if missed:
        worst = max(missed, key=lambda row: float(row["error_mm"]))
        yield (
            f"  not reached        {counted(len(missed), 'row')}, off by up to "
            f"{worst['error_mm']:.4f} mm (line {worst['line']});"
        )
        yield "                     they need other targets, or to start from other joints"


def _sizes(error: dict[str, float]) -> str:
    return f"mean {error['mean_mm']:.4f} mm, max {error['max_mm']:.4f} mm"


def _angle(mrad: float) -> str:
    """Return an angle in the unit of the joints' motions, which the same text has."""
    return f"{np.rad2deg(1e-3 * mrad):.3g} deg"


def _failures(result: dict[str, Any], *, has_summary: bool) -> Iterator[str]:
    """Yield notes on rows that are not reached, and on rows that take large motions; a summary has
    named the worst of the former.
    """
    if large := result["large_changes"]:
        rows = f"{counted(len(large), 'row')} (line {few(large, _SHOWN)})"
        yield (
            f"{rows}: a joint moves more than {np.rad2deg(result['max_change']):.3g} deg "
            "from its start; "
            "marked in the column large_change, check them before the robot moves (--max-change)"
        )
    turn = result["turn"]
    if turn["unreached"]:
        lacks_places = any(row["status"] == "unreachable" for row in result["not_ok"])
        yield (
            f"this arm has too few joints to turn the target {turn['unreached']} in place: "
            f"{'not all positions' if lacks_places else 'positions'} are reached, "
            f"orientations remain off by up to {_angle(turn['max_mrad'])} (line {turn['line']})"
        )
    named = [] if has_summary and len(result["not_ok"]) == 1 else result["not_ok"]
    for row in named[:_SHOWN]:
        off = _angle(row["error_mrad"])
        left = (
            f"position met, orientation off by {off}"
            if row["status"] == "singular"
            else f"remaining error {row['error_mm']:.4f} mm and {off}"
        )
        yield f"line {row['line']}: {row['status']}, {left}"
    if len(result["not_ok"]) > _SHOWN:
        others = counted(len(result["not_ok"]) - _SHOWN, "further row")
        yield f"not ok: {others}; see column status"
