"""``pincal check``: what can be identified from a table, before any fit is trusted."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import click

from pincal.cli.arguments import as_given, group, option, verb, words_given
from pincal.cli.common import CalibrationOptions, GeneralOptions, InputOptions, verbose_option
from pincal.cli.outputs import print_json
from pincal.errors import Exit


@dataclass(frozen=True, kw_only=True)
class CheckArguments:
    """Arguments of check."""

    source: InputOptions = group("Input")
    chosen: CalibrationOptions = group("Model")
    verbose: bool = verbose_option()
    report: bool = option(
        "Print what a report of a problem needs, without the data: versions, command, files, and the whole check.",
        False,
    )
    general: GeneralOptions = group("General")


@verb(CheckArguments, examples="Example:\n  pincal check robot.urdf tracker.csv --noise 0.05mm", exits=(Exit.UNDECIDED,))
def check(arguments: CheckArguments) -> Exit:
    """Report what can and cannot be identified from a table.

    Units, ranges and coverage are checked, and the reason is given for what cannot be identified.
    """
    if arguments.report:
        from pincal.cli.problem_report import problem_report

        # Before anything is read, so that it is there whatever the check comes to.
        for line in problem_report(["check", *words_given()], [Path(arguments.source.robot), *arguments.source.data]):
            click.echo(line)
    from pincal.cli.inputs import prepare
    from pincal.cli.progress import tell_step
    from pincal.discover.precheck import precheck

    prepared = prepare(arguments.source, arguments.chosen)
    tell_step("looking at what these poses can identify")
    found = precheck(prepared.robot, prepared.tables, prepared.options)
    if arguments.general.as_json:
        print_json(found.to_dict())
    else:
        from pincal.cli.brief import print_brief_check
        from pincal.cli.progress import console
        from pincal.cli.tables import print_precheck

        if arguments.verbose or arguments.report:
            print_precheck(found, console())
        else:
            command = as_given("calibrate", "--out", "results")
            print_brief_check(found, prepared.robot, console(), command=command)
    return Exit.DONE
