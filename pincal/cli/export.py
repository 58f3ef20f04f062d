"""``pincal export``: the calibrated model in other formats."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import click

from pincal.cli.arguments import group, option, verb
from pincal.cli.common import GeneralOptions, PlaceOptions, TableArguments, model_argument
from pincal.cli.outputs import print_json
from pincal.errors import Exit

_EXAMPLES = """
Examples:
  pincal export results/model.json --urdf calibrated.urdf
  pincal export results/model.json --c controller/ --frame base
  pincal export results/model.json --python arm.py --urdf calibrated.urdf

Each file is read back and compared with the model before it is written, and says in its first lines what
it can't carry. --c and --python carry every effect of the model and compensate, too; the others carry the
geometry. Formats of the robot alone (--urdf) need no --station.
"""


@dataclass(frozen=True, kw_only=True)
class ExportArguments:
    """Arguments of export."""

    model: Path = model_argument()
    urdf: Path | None = option("Write the calibrated URDF.", metavar="FILE.urdf")
    c: Path | None = option("Write C99 for a controller: one header, one source, no dependencies.", metavar="DIR")
    python: Path | None = option("Write a Python file that needs NumPy alone.", metavar="FILE.py")
    camera: Path | None = option("Write the camera, parameters and mount, as calibrate reads it.", metavar="FILE.json")
    frame: Literal["instrument", "base"] = option(
        "Frame of the poses in --c and --python: the instrument's or the robot's base.", "instrument"
    )
    place: PlaceOptions = group("Place of instrument and target")
    table: TableArguments = group("Table of --placement")
    general: GeneralOptions = group("General")


@verb(ExportArguments, examples=_EXAMPLES, exits=(Exit.CHANGED,))
def export(arguments: ExportArguments) -> Exit:
    """Write the calibrated robot in other formats."""
    from pincal.calibration.stations import load_stations
    from pincal.cli.places import find_place, tell_doubt
    from pincal.export import FORMATS, export_model

    places = {name: getattr(arguments, name.replace("-", "_")) for name in FORMATS.registered()}
    places = {name: path for name, path in places.items() if path is not None}
    if not places:
        names = ", ".join(f"--{name}" for name in FORMATS.registered())
        raise click.UsageError(f"nothing to export; give at least one of {names}")
    if all(FORMATS.registered()[name].of_robot for name in places) and not arguments.place.placement:
        calibrated = load_stations(arguments.model).robot_model()
    else:
        place = find_place(arguments.model, arguments.place, arguments.table.options)
        if place.doubt:
            tell_doubt(place.doubt, arguments.model)
            return Exit.CHANGED
        calibrated = place.model
    written: dict[str, Any] = {}
    lines: list[str] = []
    for name, path in places.items():
        options = {"frame": arguments.frame} if name in ("c", "python") else {}
        exported = export_model(calibrated, name, path, **options)
        agrees = exported.max_error_m
        also = "" if agrees is None else f"; its forward kinematics agree with the model to {agrees:.1e} m"
        written |= {name: str(path)}
        written.setdefault("notes", []).extend(exported.notes)
        if agrees is not None:
            written["max_error_m"] = max(agrees, written.get("max_error_m", 0.0))
        lines += [f"written to {path}{also}", *(f"note: {note}" for note in exported.notes)]
    if arguments.general.as_json:
        print_json(written)
    else:
        click.echo("\n".join(dict.fromkeys(lines)))
    return Exit.DONE
