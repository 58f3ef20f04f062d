"""``pincal check``: what a table can identify."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pincal.cli.arguments import group, option, verb, words_given, words_to_repeat
from pincal.cli.cell_defaults import words_beyond_cell, written_cell
from pincal.cli.common import CalibrationOptions, GeneralOptions, InputOptions, verbose_option
from pincal.cli.outputs import print_json, problem_report, robot_notes_in_result
from pincal.errors import Exit

if TYPE_CHECKING:
    from pincal.calibration.precheck import DataReport
    from pincal.robot.robot import Robot

# The option of calibrate that only checks.
DRY = "--dry"
_SHOWN = (
    "tip",
    "base",
    "couplings",
    "noise",
    "noise_angle",
    "instrument",
    "points",
    "camera",
    "verbose",
    "as_json",
    "quiet",
)


@dataclass(frozen=True, kw_only=True)
class CheckArguments:
    """Arguments of check."""

    source: InputOptions = group("Input")
    chosen: CalibrationOptions = group("Model")
    verbose: bool = verbose_option()
    report: bool = option(
        "Print what a bug report needs, without the data: versions, command, files, and "
        "the complete check.",
        False,
    )
    general: GeneralOptions = group("General")


@verb(
    CheckArguments,
    examples="Example:\n  pincal check robot.urdf tracker.csv --noise 0.05mm",
    exits=(Exit.UNDECIDED,),
    shown=_SHOWN,
    cell="read, written",
)
def check(arguments: CheckArguments) -> Exit:
    """Report what can and cannot be identified from a table.

    Units, ranges and coverage are checked, and the reason is given for what cannot be identified.
    Where there is no cell.toml beside the table, one is written.
    """
    if arguments.report:
        # Before anything is read, so that it is printed even if the check fails.
        for line in problem_report(
            ["check", *words_given()], [Path(arguments.source.robot), *arguments.source.data]
        ):
            click.echo(line)
    written: list[Path] = []

    def write_cell(robot: Robot) -> None:
        ends = {"base": robot.base, "tip": robot.tip}
        cell = written_cell("pincal check", usual=ends)
        written.extend([] if cell is None else [cell])

    as_json = arguments.general.as_json
    run_check(
        arguments.source,
        arguments.chosen,
        as_json=as_json,
        is_full=arguments.verbose or arguments.report,
        then=write_cell,
    )
    if written and not arguments.general.quiet:
        words = f"written to {written[0]}: what describes the cell; ROBOT may now be left out"
        click.echo(words, err=as_json)
    return Exit.DONE


def run_check(
    source: InputOptions,
    chosen: CalibrationOptions,
    *,
    as_json: bool,
    is_full: bool,
    then: Callable[[Robot], None] | None = None,
) -> Exit:
    """Print what can be identified from tables; nothing is written but by ``then``.

    Args:
        source: the robot and its tables.
        chosen: how they would be calibrated.
        as_json: whether it is printed for programs.
        is_full: whether all tables are printed.
        then: what is done once the tables were found to be sound, before anything is printed.
    """
    from pincal.calibration.precheck import precheck
    from pincal.cli.inputs import prepare
    from pincal.cli.progress import log_step

    with robot_notes_in_result():
        prepared = prepare(source, chosen)
        log_step("analysing what these poses can identify")
        found = precheck(prepared.robot, prepared.tables, prepared.options)
    if then is not None:
        then(prepared.robot)
    if as_json:
        print_json(found.to_dict())
        return Exit.DONE
    from pincal.cli.progress import console
    from pincal.cli.screen import print_brief_check, print_precheck

    if is_full:
        print_precheck(found, console())
    else:
        command = _calibrating(found, source)
        print_brief_check(found, prepared.robot, console(), command=command)
    return Exit.DONE


def _calibrating(found: DataReport, source: InputOptions) -> str:
    """Return the command that calibrates what was checked, with the noise where it is to be
    stated; with a cell file just written, tables are enough.
    """
    from pincal.report.words import noise_to_state

    beyond = words_beyond_cell()
    words = words_to_repeat() if beyond is None else (*map(str, source.data), *beyond)
    command = shlex.join(["pincal", "calibrate", *(word for word in words if word != DRY)])
    ask = noise_to_state(found.noise)
    return f"{command} {ask}  # your instrument's" if ask else command
