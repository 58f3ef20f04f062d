"""``pincal update``: new rows taken into a calibration."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, replace
from pathlib import Path

import click

from pincal.cli.arguments import argument, group, option, verb
from pincal.cli.common import LENGTH, GeneralOptions, TableArguments, model_argument
from pincal.cli.outputs import print_json, print_notes, provenance
from pincal.errors import Exit
from pincal.io.result_folder import output_folder

_EXAMPLES = """
Examples:
  pincal update results/model.json new.csv --out updated
  pincal update results/model.json new.csv --anew transmission_error:joint_1 --out updated
"""


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
    anew: tuple[str, ...] = option(
        "An effect of the model that is found anew, as diagnose named it; whether anything has changed is not asked then.",
        (),
        metavar="EFFECT[:JOINT]",
    )
    table: TableArguments = group("Tables")
    general: GeneralOptions = group("General")


@verb(UpdateArguments, examples=_EXAMPLES, exits=(Exit.UNDECIDED, Exit.CHANGED))
def update(arguments: UpdateArguments) -> Exit:
    """Take new measurements into a calibrated model for good.

    The result is that of a calibration with the old and the new rows, without the old ones. Rows of a robot that has changed
    are refused (exit code 6): see diagnose. With --anew, what it named is found anew beside all that stays known.
    """
    from pincal.calibration.stations import load_stations
    from pincal.cli.inputs import load_table
    from pincal.diagnosis.update import update as run
    from pincal.validate.accuracy import error_table

    calibrated = load_stations(arguments.model).robot_model()
    table = load_table(calibrated.model.chain.robot, arguments.data, options=arguments.table.options)
    with output_folder(arguments.out) as draft:
        found = run(calibrated, table, sigma=arguments.noise, anew=arguments.anew)
        replace(found, provenance=provenance([arguments.model, arguments.data])).save(draft / "model.json")
    error = error_table(found.readings(table), found.values)
    if arguments.general.as_json:
        print_json({"rows": len(table), "error": error, "out": str(arguments.out)})
    else:
        anew = f", {', '.join(arguments.anew)} found anew" if arguments.anew else ""
        click.echo(f"{len(table)} rows taken in{anew}; mean error {error['mean_mm']:.4f} mm")
        click.echo(f"written to {arguments.out}: model.json")
    print_notes(calibrated.notes_on_day(table), quiet=arguments.general.quiet)
    return Exit.DONE
