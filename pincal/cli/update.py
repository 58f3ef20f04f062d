"""``pincal update``: new rows taken into a calibration."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, replace
from pathlib import Path

import click

from pincal.cli.arguments import argument, group, option, verb
from pincal.cli.common import LENGTH, GeneralOptions, TableArguments, model_argument
from pincal.cli.outputs import print_json, provenance
from pincal.errors import Exit
from pincal.io.result_folder import output_folder


@dataclass(frozen=True, kw_only=True)
class UpdateArguments:
    """Arguments of update."""

    model: Path = model_argument()
    data: Path = argument("NEW.csv", "Measurements made since; instrument and target may stand elsewhere.")
    out: Path = option("Folder for the results.", MISSING, metavar="DIR")
    noise: float | None = option(
        "Noise of one coordinate of the new measurements.",
        type=LENGTH,
        words="as declared for the calibration, else estimated",
    )
    table: TableArguments = group("Tables")
    general: GeneralOptions = group("General")


@verb(UpdateArguments, examples="Example:\n  pincal update results/model.json new.csv --out updated", exits=(Exit.CHANGED,))
def update(arguments: UpdateArguments) -> Exit:
    """Take new measurements into a calibrated model for good.

    The result is that of a calibration with the old and the new rows, without the old ones. Rows of a robot that has changed
    are refused (exit code 6): see diagnose.
    """
    from pincal.calibration.stations import load_stations
    from pincal.cli.inputs import load_table
    from pincal.diagnosis.update import update as run
    from pincal.validate.accuracy import error_table

    calibrated = load_stations(arguments.model).robot_model()
    table = load_table(calibrated.model.chain.robot, arguments.data, options=arguments.table.options)
    with output_folder(arguments.out) as draft:
        found = run(calibrated, table, sigma=arguments.noise)
        replace(found, provenance=provenance([arguments.model, arguments.data])).save(draft / "model.json")
    error = error_table(found.readings(table), found.values)
    if arguments.general.as_json:
        print_json({"rows": len(table), "error": error, "out": str(arguments.out)})
    else:
        click.echo(f"{len(table)} rows taken in; mean error {error['mean_mm']:.4f} mm")
        click.echo(f"written to {arguments.out}: model.json")
    return Exit.DONE
