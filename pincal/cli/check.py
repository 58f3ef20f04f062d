"""``pincal check``: what can be identified from a table, before any fit is trusted."""

from __future__ import annotations

from dataclasses import dataclass

from pincal.cli.arguments import group, verb
from pincal.cli.common import CalibrationOptions, GeneralOptions, InputOptions
from pincal.cli.outputs import print_json
from pincal.errors import Exit


@dataclass(frozen=True, kw_only=True)
class CheckArguments:
    """Arguments of check."""

    source: InputOptions = group("Input")
    chosen: CalibrationOptions = group("Model")
    general: GeneralOptions = group("General")


@verb(CheckArguments, examples="Example:\n  pincal check robot.urdf tracker.csv --noise 0.05mm", exits=(Exit.UNDECIDED,))
def check(arguments: CheckArguments) -> Exit:
    """Report what can and cannot be identified from a table.

    Units, ranges and coverage are checked, and the reason is given for what cannot be identified.
    """
    from pincal.cli.inputs import prepare
    from pincal.discover.precheck import precheck

    prepared = prepare(arguments.source, arguments.chosen)
    found = precheck(prepared.robot, prepared.tables, prepared.options)
    if arguments.general.as_json:
        print_json(found.to_dict())
    else:
        from pincal.cli.progress import console
        from pincal.cli.tables import print_precheck

        print_precheck(found, console())
    return Exit.DONE
