"""``pincal check``: what a table can identify."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pincal.cli.arguments import group, option, verb, words_given
from pincal.cli.common import CalibrationOptions, GeneralOptions, InputOptions, verbose_option
from pincal.cli.outputs import print_json, problem_report
from pincal.errors import Exit

if TYPE_CHECKING:
    from pincal.calibration.precheck import DataReport

# The option of calibrate that only checks.
DRY = "--dry"


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
)
def check(arguments: CheckArguments) -> Exit:
    """Report what can and cannot be identified from a table.

    Units, ranges and coverage are checked, and the reason is given for what cannot be identified.
    """
    if arguments.report:
        # Before anything is read, so that it is printed even if the check fails.
        for line in problem_report(
            ["check", *words_given()], [Path(arguments.source.robot), *arguments.source.data]
        ):
            click.echo(line)
    return run_check(
        arguments.source,
        arguments.chosen,
        as_json=arguments.general.as_json,
        is_full=arguments.verbose or arguments.report,
    )


def run_check(
    source: InputOptions, chosen: CalibrationOptions, *, as_json: bool, is_full: bool
) -> Exit:
    """Print what can be identified from tables; nothing is written.

    Args:
        source: the robot and its tables.
        chosen: how they would be calibrated.
        as_json: whether it is printed for programs.
        is_full: whether all tables are printed.
    """
    from pincal.calibration.precheck import precheck
    from pincal.cli.inputs import prepare
    from pincal.cli.progress import log_step

    prepared = prepare(source, chosen)
    log_step("analysing what these poses can identify")
    found = precheck(prepared.robot, prepared.tables, prepared.options)
    if as_json:
        print_json(found.to_dict())
        return Exit.DONE
    from pincal.cli.progress import console
    from pincal.cli.screen import print_brief_check, print_precheck

    if is_full:
        print_precheck(found, console())
    else:
        print_brief_check(found, prepared.robot, console(), command=_calibrating(found))
    return Exit.DONE


def _calibrating(found: DataReport) -> str:
    """Return the command that calibrates what was checked, with the noise where it is to be
    stated.
    """
    from pincal.report.words import noise_to_state

    words = [word for word in words_given() if word != DRY]
    has_folder = any(word == "--out" or word.startswith("--out=") for word in words)
    folder = [] if has_folder else ["--out", "results"]
    command = shlex.join(["pincal", "calibrate", *words, *folder])
    ask = noise_to_state(found.noise)
    return f"{command} {ask}  # your instrument's" if ask else command
