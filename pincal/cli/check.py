"""``pincal check``: what a table can identify."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

import click

from pincal.cli.arguments import group, option, verb, words_given
from pincal.cli.common import CalibrationOptions, GeneralOptions, InputOptions, verbose_option
from pincal.cli.outputs import print_json, problem_report
from pincal.errors import Exit


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
    from pincal.calibration.precheck import precheck
    from pincal.cli.inputs import prepare
    from pincal.cli.progress import log_step

    prepared = prepare(arguments.source, arguments.chosen)
    log_step("analysing what these poses can identify")
    found = precheck(prepared.robot, prepared.tables, prepared.options)
    if arguments.general.as_json:
        print_json(found.to_dict())
    else:
        from pincal.cli.progress import console
        from pincal.cli.screen import print_brief_check, print_precheck
        from pincal.report.words import noise_to_state

        if arguments.verbose or arguments.report:
            print_precheck(found, console())
        else:
            words = shlex.join(["pincal", "calibrate", *words_given(), "--out", "results"])
            ask = noise_to_state(found.noise)
            command = f"{words} {ask}  # your instrument's" if ask else words
            print_brief_check(found, prepared.robot, console(), command=command)
    return Exit.DONE
