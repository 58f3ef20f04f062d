"""``pincal export`` and ``view``: the calibrated model in other formats, and its deviations in
three dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from pincal.cli.arguments import Output, group, option, verb
from pincal.cli.common import (
    GeneralOptions,
    PlaceOptions,
    TableArguments,
    model_argument,
)
from pincal.cli.identity_options import HEADING, IdentityOptions
from pincal.cli.outputs import echo_notes, print_json
from pincal.errors import Exit
from pincal.satellites import lacking

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pincal.calibration.fitted_robot import FittedRobot
    from pincal.export import Exported, Format

_EXAMPLES = """
Examples:
  pincal export results/model.json --urdf calibrated.urdf
  pincal export results/model.json --c controller/ --frame base
  pincal export results/model.json --python arm.py --mjcf arm.xml --dh arm.csv
  pincal export results/model.json --page corrector.html
  pincal export results/model.json --frames kuka

Each file is read back and compared with the model (--c and --page by their formulas) before it is
kept, and lists what it can't represent. --c, --python and --page represent every effect of the
model and also compensate; the others represent the geometry, --mjcf also the elasticity as springs.
--urdf, --mjcf, --dh and --ur-kinematics describe the robot alone and need no --station.

--page works in a browser without a network: drop a table or a URScript program on it and save the
corrected one. The file of --python is also a program: python arm.py program.csv corrected.csv
"""


@dataclass(frozen=True, kw_only=True)
class ExportArguments:
    """Arguments of export."""

    model: Path = model_argument()
    urdf: Path | None = option(
        "Write the calibrated URDF.", metavar="FILE.urdf", type=Output(".urdf", ".xml")
    )
    c: Path | None = option(
        "Write C99 for a controller: one header, one source, no dependencies.",
        metavar="DIR",
        type=Output(),
    )
    python: Path | None = option(
        "Write a Python file that needs only NumPy.", metavar="FILE.py", type=Output(".py")
    )
    page: Path | None = option(
        "Write a page that corrects programs in any browser, offline.",
        metavar="FILE.html",
        type=Output(".html", ".htm"),
    )
    mjcf: Path | None = option(
        "Write a MuJoCo model: geometry, masses, and compliances as springs.",
        metavar="FILE.xml",
        type=Output(".xml", ".mjcf"),
    )
    ur_kinematics: Path | None = option(
        "Write the kinematics yaml of ur_description (UR robots).",
        metavar="FILE.yaml",
        type=Output(".yaml", ".yml"),
    )
    dh: Path | None = option(
        "Write Denavit-Hartenberg parameters, standard and modified.",
        metavar="FILE.csv",
        type=Output(".csv"),
    )
    frames: Literal["kuka", "fanuc", "abb", "ur"] | None = option(
        "Print base and tool frames in the convention of a controller."
    )
    camera: Path | None = option(
        "Write parameters and mount of the camera, for calibrate --camera.",
        metavar="FILE.json",
        type=Output(".json"),
    )
    frame: Literal["instrument", "base"] = option(
        "Frame of the poses in --c, --python and --page: the instrument's or the robot's base.",
        "instrument",
    )
    place: PlaceOptions = group("Placement of instrument and target")
    table: TableArguments = group("Table of --placement")
    identity: IdentityOptions = group(HEADING)
    general: GeneralOptions = group("General")


@verb(
    ExportArguments,
    examples=_EXAMPLES,
    exits=(Exit.CHANGED,),
    shown=(
        "urdf",
        "c",
        "python",
        "page",
        "mjcf",
        "ur_kinematics",
        "dh",
        "frames",
        "camera",
        "frame",
        "station",
    ),
)
def export(arguments: ExportArguments) -> Exit:
    """Write the calibrated robot in other formats."""
    from pincal.cli.checked import said_by_checks
    from pincal.export import FORMATS, export_model

    registered = FORMATS.registered()
    places = _places(arguments, registered)
    is_of_robot = all(registered[name].of_robot for name in places)
    calibrated = _model(arguments, is_of_robot=is_of_robot)
    unchecked = tuple(arguments.identity.of_model(calibrated.identity, arguments.model))
    said = [] if calibrated.statement is None else list(calibrated.statement.notes())
    said += said_by_checks(arguments.model)
    contents: dict[str, Any] = {}
    lines: list[str] = []
    for name, place in places.items():
        # The frames of a controller are a few numbers to type in, not a file.
        path = place if isinstance(place, Path) else None
        exported = export_model(calibrated, name, path, **_options(name, arguments))
        contents |= {name: exported.text if path is None else str(path)}
        contents.setdefault("notes", []).extend(exported.notes)
        if exported.max_error_m is not None:
            contents["max_error_m"] = max(exported.max_error_m, contents.get("max_error_m", 0.0))
        lines += [exported.text.rstrip()] if path is None else _written_lines(path, exported)
    contents["notes"] += said
    lines += [f"note: {note}" for note in said]
    if arguments.general.as_json:
        print_json(contents)
    else:
        click.echo("\n".join(dict.fromkeys(lines)))
    echo_notes(unchecked, quiet=arguments.general.quiet)
    return Exit.DONE


def _model(arguments: ExportArguments, *, is_of_robot: bool) -> FittedRobot:
    """Return the model at the station or the placement chosen, which formats of the robot alone do
    without.
    """
    from pincal.calibration.fitted_robot import load_model
    from pincal.cli.inputs import find_place

    if is_of_robot and not arguments.place.placement:
        return load_model(arguments.model).robot_model()
    return find_place(arguments.model, arguments.place, arguments.table.options).model


def _places(
    arguments: ExportArguments, registered: Mapping[str, type[Format]]
) -> dict[str, Path | str]:
    """Return the formats to write, and the file or the controller of each."""
    # In the order of --help, not of registration. A plugin's format has no option here: it
    # is written from Python.
    options = (field.name.replace("_", "-") for field in fields(arguments))
    known = {name: registered[name] for name in options if name in registered}
    if arguments.page is not None and "page" not in known:
        raise lacking("--page", "pincal.programs")
    places = {name: getattr(arguments, name.replace("-", "_")) for name in known}
    places = {name: place for name, place in places.items() if place is not None}
    if not places:
        choices = ", ".join(f"--{name} ({cls.meaning})" for name, cls in known.items())
        raise click.UsageError(f"nothing to export; give at least one of {choices}")
    return places


def _written_lines(path: Path, exported: Exported) -> list[str]:
    """Return the lines on a written file: how well it agrees with the model, and its notes."""
    agrees = exported.max_error_m
    also = (
        "" if agrees is None else f"; its forward kinematics agree with the model to {agrees:.1e} m"
    )
    return [f"written to {path}{also}", *(f"note: {note}" for note in exported.notes)]


def _options(name: str, arguments: ExportArguments) -> dict[str, str]:
    """Return the options of a format that are on the command line."""
    if name == "frames":
        return {"controller": str(arguments.frames)}
    return {"frame": arguments.frame} if name in ("c", "python", "page") else {}
