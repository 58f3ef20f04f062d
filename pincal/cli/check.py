"""``pincal check``: what a table can tell, before any fit is trusted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pincal.cli import show_progress
from pincal.cli.common import model_options, output_options, print_json, robot_options

_EPILOG = "\b\nExample:\n  pincal check robot.urdf tracker.csv --noise 0.05mm\n"


@click.command(epilog=_EPILOG)
@robot_options
@model_options
@output_options
def check(robot: str, data: Path, as_json: bool, quiet: bool, **chosen: Any) -> int:
    """Check units, ranges and coverage of a table; say what it can and can't tell, why, and which effects it would show."""
    show_progress(quiet)
    from pincal.cli.inputs import load_robot, load_table, options_of
    from pincal.discover.precheck import precheck

    arm = load_robot(robot, data, tip=chosen["tip"], base=chosen["base"])
    table = load_table(arm, data, ignore=chosen["ignore"])
    found = precheck(arm, table, options_of(chosen, table))
    if as_json:
        print_json(found.to_dict())
        return 0
    from pincal.cli.tables import console, print_precheck

    print_precheck(found, console())
    return 0
