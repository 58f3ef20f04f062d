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
  pincal export results/model.json --python arm.py --mjcf arm.xml --dh arm.csv
  pincal export results/model.json --frames kuka

Each file is read back and compared with the model before it is written (of --c its formulas: C would need a
compiler), and says in its first lines what it can't carry. --c and --python carry every effect of the model
and compensate, too; the others carry the geometry, --mjcf springs, too. --urdf, --mjcf, --dh and
--ur-kinematics are of the robot alone and need no --station.
"""


@dataclass(frozen=True, kw_only=True)
class ExportArguments:
    """Arguments of export."""

    model: Path = model_argument()
    urdf: Path | None = option("Write the calibrated URDF.", metavar="FILE.urdf")
    c: Path | None = option("Write C99 for a controller: one header, one source, no dependencies.", metavar="DIR")
    python: Path | None = option("Write a Python file that needs NumPy alone.", metavar="FILE.py")
    mjcf: Path | None = option("Write a MuJoCo model: geometry, masses, and compliances as springs.", metavar="FILE.xml")
    ur_kinematics: Path | None = option("Write the kinematics yaml of ur_description (UR robots).", metavar="FILE.yaml")
    dh: Path | None = option("Write Denavit-Hartenberg parameters, standard and modified.", metavar="FILE.csv")
    frames: Literal["kuka", "fanuc", "abb", "ur"] | None = option("Print base and tool as a controller has them.")
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

    # A plugin's format has no option here: it is written from Python.
    known = {name: cls for name, cls in FORMATS.registered().items() if hasattr(arguments, name.replace("-", "_"))}
    places = {name: getattr(arguments, name.replace("-", "_")) for name in known}
    places = {name: place for name, place in places.items() if place is not None}
    if not places:
        options = ", ".join(f"--{name} ({cls.meaning})" for name, cls in known.items())
        raise click.UsageError(f"nothing to export; give at least one of {options}")
    if all(known[name].of_robot for name in places) and not arguments.place.placement:
        calibrated = load_stations(arguments.model).robot_model()
    else:
        found = find_place(arguments.model, arguments.place, arguments.table.options)
        if found.doubt:
            tell_doubt(found.doubt, arguments.model)
            return Exit.CHANGED
        calibrated = found.model
    told: dict[str, Any] = {}
    lines: list[str] = []
    for name, place in places.items():
        # The frames of a controller are a few numbers to type in, not a file.
        path = place if isinstance(place, Path) else None
        exported = export_model(calibrated, name, path, **_options(name, arguments))
        agrees = exported.max_error_m
        told |= {name: exported.text if path is None else str(path)}
        told.setdefault("notes", []).extend(exported.notes)
        if agrees is not None:
            told["max_error_m"] = max(agrees, told.get("max_error_m", 0.0))
        if path is None:
            lines.append(exported.text.rstrip())
        else:
            also = "" if agrees is None else f"; its forward kinematics agree with the model to {agrees:.1e} m"
            lines += [f"written to {path}{also}", *(f"note: {note}" for note in exported.notes)]
    if arguments.general.as_json:
        print_json(told)
    else:
        click.echo("\n".join(dict.fromkeys(lines)))
    return Exit.DONE


def _options(name: str, arguments: ExportArguments) -> dict[str, str]:
    """Return the options of a format that the command line has."""
    if name == "frames":
        return {"controller": str(arguments.frames)}
    return {"frame": arguments.frame} if name in ("c", "python") else {}
