"""``pincal diagnose``: whether a calibrated robot has changed, and what."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pincal.cli.arguments import argument, group, option, verb
from pincal.cli.common import LENGTH, GeneralOptions, TableArguments, model_argument
from pincal.cli.outputs import print_doubts, print_json, print_notes, provenance
from pincal.errors import Exit, IdentificationError
from pincal.io.result_folder import output_folder

if TYPE_CHECKING:
    from pincal.diagnosis.run import Diagnosis

_EXAMPLES = """
Example:
  pincal diagnose results/model.json new.csv --out diagnosis

DIR then holds diagnosis.json, report.html and model.json: the mended model, in which only what changed
was found anew, or the model as it was where nothing has changed; it predicts at the new station.
"""


@dataclass(frozen=True, kw_only=True)
class DiagnoseArguments:
    """Arguments of diagnose."""

    model: Path = model_argument()
    data: Path = argument("NEW.csv", "Measurements made since; instrument and target may stand elsewhere.")
    out: Path = option("Folder for the results.", MISSING, metavar="DIR")
    alpha: float = option("Chance of an alarm on a robot that has not changed.", 0.01)
    noise: float | None = option(
        "Noise of one coordinate of the new measurements, if it is more than that of the calibration.",
        type=LENGTH,
        words="that of the calibration",
    )
    table: TableArguments = group("Tables")
    general: GeneralOptions = group("General")


@verb(DiagnoseArguments, examples=_EXAMPLES, exits=(Exit.UNDECIDED, Exit.CHANGED))
def diagnose(arguments: DiagnoseArguments) -> Exit:
    """Find out whether a calibrated robot has changed, and what.

    Ten to sixty poses are enough: what the calibration knows of the robot is taken into account, with its uncertainty.
    """
    from pincal.calibration.stations import load_stations
    from pincal.cli.inputs import load_table
    from pincal.cli.progress import console
    from pincal.diagnosis.run import diagnose as run
    from pincal.notes import doubts_of
    from pincal.report.diagnosis import curve_table, lines

    calibrated = load_stations(arguments.model)
    table = load_table(calibrated.robot_model().model.chain.robot, arguments.data, options=arguments.table.options)
    with output_folder(arguments.out) as draft:
        found = run(calibrated, table, alpha=arguments.alpha, sigma=arguments.noise)
        write_diagnosis(draft, found, provenance([arguments.model, arguments.data]))
    if arguments.general.as_json:
        print_json(found.report)
    else:
        print_doubts(found.found.warnings)
        for line in lines(found.found):
            click.echo(line)
        if found.found.curves is not None:
            console().print(curve_table(found.found.curves))
        click.echo(f"written to {arguments.out}: diagnosis.json model.json report.html")
    print_notes(found.found.warnings, quiet=arguments.general.quiet)
    if not found.found.is_judged:
        raise IdentificationError(f"not to be judged: {'; '.join(map(str, doubts_of(found.found.warnings)))}")
    return Exit.CHANGED if found.changed else Exit.DONE


def write_diagnosis(folder: Path, diagnosis: Diagnosis, origin: dict[str, Any]) -> None:
    """Write ``diagnosis.json``, the page and the mended model, which says where it comes from."""
    from pincal.io.strict_json import write_json
    from pincal.report.diagnosis import diagnosis_page

    replace(diagnosis.model, provenance=origin).save(folder / "model.json")
    write_json(folder / "diagnosis.json", diagnosis.report)
    (folder / "report.html").write_text(diagnosis_page(diagnosis, version=origin["pincal"]), encoding="utf-8")
