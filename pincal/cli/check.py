"""``pincal check``: what can be identified from a table, before any fit is trusted."""

from __future__ import annotations

from dataclasses import dataclass

from pincal.cli.arguments import as_given, group, verb
from pincal.cli.common import CalibrationOptions, GeneralOptions, InputOptions, verbose_option
from pincal.cli.outputs import print_json
from pincal.errors import Exit


@dataclass(frozen=True, kw_only=True)
class CheckArguments:
    """Arguments of check."""

    source: InputOptions = group("Input")
    chosen: CalibrationOptions = group("Model")
    verbose: bool = verbose_option()
    general: GeneralOptions = group("General")


@verb(CheckArguments, examples="Example:\n  pincal check robot.urdf tracker.csv --noise 0.05mm", exits=(Exit.UNDECIDED,))
def check(arguments: CheckArguments) -> Exit:
    """Report what can and cannot be identified from a table.

    Units, ranges and coverage are checked, and the reason is given for what cannot be identified.
    """
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

        if arguments.verbose:
            print_precheck(found, console())
        else:
            command = as_given("calibrate", "--out", "results")
            print_brief_check(found, prepared.robot, console(), command=command)
    return Exit.DONE
