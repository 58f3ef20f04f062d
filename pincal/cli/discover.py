"""``pincal discover``: where model and data disagree, and what makes it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from pincal.cli import show_progress
from pincal.cli.common import (
    LENGTH,
    model_options,
    output_folder,
    output_options,
    print_json,
    provenance,
    robot_options,
    split_options,
    view_option,
)

_EPILOG = """\b
Example:
  pincal discover robot.urdf tracker.csv --out results --noise 0.05mm

Unless given, the model is geometric, 20 % of the rows are held out by regions of joint
space, and the moment frame is the one that fits best.
DIR then holds what calibrate writes, for the model with all that was found, and discovery.json.
"""


@click.command(epilog=_EPILOG)
@robot_options
@click.option("--out", type=click.Path(path_type=Path), required=True, metavar="DIR", help="Folder for the results.")
@model_options
@split_options
@click.option("--max-error", type=LENGTH, help="Fail (exit 5) if the mean held-out error is larger, e.g. 0.1mm.")
@view_option
@output_options
def discover(robot: str, data: Path, out: Path, as_json: bool, quiet: bool, max_error: float | None, view: bool,
             **chosen: Any) -> int:  # fmt: skip
    """Find where model and data disagree, name the missing effect, add it, and show the gap shrink on held-out rows."""
    show_progress(quiet)
    from pincal.cli.calibrate import VIEW, verdict, write_results
    from pincal.cli.inputs import load_robot, load_table, options_of
    from pincal.discover.run import run_discovery
    from pincal.model.chain import MOMENT_FRAMES
    from pincal.model.effects import GEOMETRIC

    context = click.get_current_context()
    given = {name: context.get_parameter_source(name) is not click.core.ParameterSource.DEFAULT for name in chosen}
    with output_folder(out) as draft:
        arm = load_robot(robot, data, tip=chosen["tip"], base=chosen["base"])
        table = load_table(arm, data, ignore=chosen["ignore"])
        held = None if chosen["holdout"] is None else load_table(arm, chosen["holdout"], ignore=chosen["ignore"])
        options = options_of(chosen, table)
        if not given["model"]:
            options = replace(options, effects=GEOMETRIC)
        found = run_discovery(
            arm,
            table,
            options,
            test_fraction=chosen["test_fraction"] if given["test_fraction"] else 0.2,
            split=chosen["split"] if given["split"] else "blocked",
            seed=chosen["seed"],
            holdout=held,
            moment_frames=() if given["moment_frame"] else MOMENT_FRAMES,
        )
        inputs = [data, *([chosen["holdout"]] if chosen["holdout"] else []), Path(arm.source)]
        write_results(draft, found.calibration, provenance(inputs, seed=chosen["seed"]), found, view=view)
        (draft / "discovery.json").write_text(json.dumps(found.report, indent=1, allow_nan=False))
    if as_json:
        print_json(found.report)
    else:
        from pincal.cli.tables import console, print_discovery, print_notes

        print_discovery(found.report, console(), found.gaps)
        print_notes(found.calibration.result.warnings, console())
        files = "discovery.json model.json result.json calibrated.urdf residuals.csv report.html"
        click.echo(f"written to {out}: {files}" + view * f" {VIEW}")
    return verdict(found.calibration.result, max_error)
