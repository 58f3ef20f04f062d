"""``pincal check``: what a table can identify."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

import click

from pincal.cli.arguments import group, option, verb, words_given
from pincal.cli.cell_defaults import words_beyond_cell, written_cell
from pincal.cli.common import CalibrationOptions, GeneralOptions, InputOptions, verbose_option
from pincal.cli.outputs import print_json, problem_report
from pincal.errors import Exit

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
    from pincal.calibration.precheck import precheck
    from pincal.cli.inputs import prepare
    from pincal.cli.progress import log_step

    prepared = prepare(arguments.source, arguments.chosen)
    log_step("analysing what these poses can identify")
    found = precheck(prepared.robot, prepared.tables, prepared.options)
    ends = {"base": prepared.robot.base, "tip": prepared.robot.tip}
    cell = written_cell("pincal check", usual=ends)
    if arguments.general.as_json:
        print_json(found.to_dict())
    else:
        from pincal.cli.progress import console
        from pincal.cli.screen import print_brief_check, print_precheck

        if arguments.verbose or arguments.report:
            print_precheck(found, console())
        else:
            print_brief_check(found, prepared.robot, console(), command=_next_command(arguments))
    if cell is not None and not arguments.general.quiet:
        click.echo(
            f"written to {cell}: what describes the cell; ROBOT may now be left out",
            err=arguments.general.as_json,
        )
    return Exit.DONE


def _next_command(arguments: CheckArguments) -> str:
    """Return the command that calibrates: with the cell file just written, tables are enough."""
    beyond = words_beyond_cell()
    tables = map(str, arguments.source.data)
    words = words_given() if beyond is None else (*tables, *beyond)
    return shlex.join(["pincal", "calibrate", *words])
