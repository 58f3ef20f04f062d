"""``pincal predict``: where the target is at given joint positions."""

from __future__ import annotations

from dataclasses import MISSING, dataclass
from pathlib import Path

import click
import numpy as np

from pincal.cli.arguments import argument, group, option, verb
from pincal.cli.common import GeneralOptions, PlaceOptions, TableArguments, model_argument
from pincal.cli.outputs import extrapolation, pose_columns, print_json, print_notes
from pincal.errors import Exit


@dataclass(frozen=True, kw_only=True)
class PredictArguments:
    """Arguments of predict."""

    model: Path = model_argument()
    poses: Path = argument("POSES.csv", "Joint positions and conditions; other columns are ignored.")
    out: Path = option("Table to write.", MISSING)
    place: PlaceOptions = group("Place of instrument and target")
    table: TableArguments = group("Tables")
    general: GeneralOptions = group("General")


_EXAMPLES = """
Examples:
  pincal predict results/model.json poses.csv --out predicted.csv
  pincal predict results/model.json poses.csv --out predicted.csv --placement ten_rows_of_today.csv
"""


@verb(PredictArguments, examples=_EXAMPLES, exits=(Exit.CHANGED,))
def predict(arguments: PredictArguments) -> Exit:
    """Predict target positions at given joint positions.

    They are given in the instrument's frame, with their uncertainty.
    """
    from pincal.cli.inputs import load_table
    from pincal.cli.places import find_place, tell_doubt
    from pincal.cli.progress import end_progress, tell_step
    from pincal.measure.table import write_table

    place = find_place(arguments.model, arguments.place, arguments.table.options)
    if place.doubt:
        tell_doubt(place.doubt, arguments.model)
        return Exit.CHANGED
    chain = place.model.model.chain
    table = load_table(chain.robot, arguments.poses, options=arguments.table.options, joints_only=True)
    place = place.over(table)
    calibrated = place.model
    conditions = calibrated.conditions(table)
    tell_step(f"predicting {len(table)} poses and their uncertainty")
    found = calibrated.predict(conditions)
    columns: dict[str, np.ndarray] = dict(zip(table.joint_names, table.q.T, strict=True))
    if len(chain.targets) > 1:
        columns["target"] = table.target
    columns |= pose_columns(found, with_orientation=calibrated.model.has_tool_orientation)
    columns |= zip(("sigma_x", "sigma_y", "sigma_z"), calibrated.position_sigma(conditions).T, strict=True)
    write_table(arguments.out, columns)
    beyond, notes = extrapolation(calibrated, conditions, table.rows)
    end_progress()
    if arguments.general.as_json:
        print_json({"rows": len(table), "out": str(arguments.out)} | place.contents | beyond)
    else:
        click.echo(f"{len(table)} poses predicted, written to {arguments.out}")
    print_notes([*place.notes, *notes], quiet=arguments.general.quiet)
    return Exit.DONE
