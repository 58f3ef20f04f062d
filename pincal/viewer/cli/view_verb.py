"""``pincal view``: the deviations of a calibrated robot in three dimensions."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from pincal.cli.arguments import Output, argument, group, option, verb
from pincal.cli.common import GeneralOptions, TableArguments, model_argument, station_option
from pincal.cli.outputs import print_json
from pincal.errors import BadInputError, Exit
from pincal.units import plain_numbers

if TYPE_CHECKING:
    from pincal.calibration.fitted_robot import FittedRobot
    from pincal.measure.measurements import Measurements
    from pincal.viewer.scene import Scene

_VIEW_EXAMPLES = """
Examples:
  pincal view results/model.json tracker.csv --html view.html
  pincal view results/model.json tracker.csv --pose 17
  pincal view results/model.json --pose "0, -1.2, 1.5, 0, 0.3, 0" --grid 3000

The page opens offline in any browser with WebGL. Without --html it is served to this computer only,
until Ctrl-C. Layers are switched on and off by name in the panel.
"""


@dataclass(frozen=True, kw_only=True)
class ViewArguments:
    """Arguments of view."""

    model: Path = model_argument()
    data: Path | None = argument("[DATA.csv]", "Measurements to show.", required=False)
    html_file: Path | None = option(
        "Write one self-contained page, not served.",
        metavar="FILE.html",
        name="--html",
        type=Output(".html", ".htm"),
    )
    pose: str | None = option(
        "Initial pose: a row of DATA, counted from 1, or joint positions [rad or m].",
        metavar='ROW|"q1,q2,.."',
    )
    scale: float | None = option("Arrow scale factor.", metavar="FACTOR", words="automatic")
    axis_scale: float | None = option(
        "Scale factor for tilts and offsets of axes.", metavar="FACTOR", words="automatic"
    )
    grid: int = option(
        "Number of workspace points with an arrow.", 1000, type=click.IntRange(0, 100000)
    )
    station: str | None = station_option(words="the first one")
    holdout: Path | None = option(
        "More measurements, marked as held out; all rows of DATA then count as fitted."
    )
    meshes: tuple[Path, ...] = option(
        "Another folder with the URDF's meshes and packages.", (), metavar="DIR"
    )
    port: int = option("Server port.", 0, type=click.IntRange(0, 65535), words="any free port")
    open_page: bool | None = option(
        "Open the page in a browser.",
        name="--open/--no-open",
        words="only a served page, on a terminal",
    )
    table: TableArguments = group("Tables")
    general: GeneralOptions = group("General")


@verb(
    ViewArguments,
    examples=_VIEW_EXAMPLES,
    shown=(
        "html_file",
        "pose",
        "scale",
        "grid",
        "station",
        "holdout",
        "meshes",
        "port",
        "open_page",
    ),
)
def view(arguments: ViewArguments) -> Exit:
    """Show the robot and its deviations in 3D.

    They are shown before and after calibration, and for each effect alone.
    """
    from pincal.viewer import show, write_html

    scene = _scene(arguments)
    as_json = arguments.general.as_json
    if arguments.html_file is not None:
        size = write_html(arguments.html_file, scene)
        _print_scene(scene, {"html": str(arguments.html_file), "bytes": size}, as_json=as_json)
        if arguments.open_page:
            click.launch(str(arguments.html_file))
        return Exit.DONE
    browser = sys.stdout.isatty() if arguments.open_page is None else arguments.open_page
    with show(scene, port=arguments.port, browser=browser) as live:
        _print_scene(scene, {"url": live.url}, as_json=as_json)
        try:
            live.wait()
        except KeyboardInterrupt:
            if not arguments.general.quiet:
                click.echo("pincal: stopped", err=True)
    return Exit.DONE


@dataclass(frozen=True)
class _Shown:
    """The measurements of a scene.

    Attributes:
        table: their N rows; None if there are none.
        held_out: shape (N,), which of them the calibration did not use; None if it is unknown.
        notes: how this is known, for the user.
    """

    table: Measurements | None = None
    held_out: np.ndarray | None = None
    notes: tuple[str, ...] = ()


def _shown_rows(arguments: ViewArguments, calibrated: FittedRobot) -> _Shown:
    """Return the rows of the tables, and which of them were held out: those of ``--holdout``, or
    by the files of the calibration.
    """
    from pincal.cli.inputs import load_table
    from pincal.measure.table import concatenate
    from pincal.viewer import held_out_rows

    robot = calibrated.model.chain.robot
    data = arguments.data
    holdout = arguments.holdout
    if data is None and holdout is not None:
        raise BadInputError(
            f"{holdout}: --holdout without DATA.csv; give the fitted table first, or only this one"
        )
    if data is None:
        return _Shown()
    table = load_table(robot, data, options=arguments.table.options)
    if holdout is None:
        residuals = arguments.model.with_name("residuals.csv")
        held, why = held_out_rows(calibrated.provenance, residuals, data, table)
        return _Shown(table, held, (why,))
    more = load_table(robot, holdout, options=arguments.table.options)
    held = np.repeat([False, True], [len(table), len(more)])
    return _Shown(concatenate([table, more]), held)


def _scene(arguments: ViewArguments) -> Scene:
    from pincal.calibration.fitted_robot import load_model
    from pincal.viewer import build_scene

    stations = load_model(arguments.model)
    calibrated = stations.at(stations.names[0] if arguments.station is None else arguments.station)
    robot = calibrated.model.chain.robot
    shown = _shown_rows(arguments, calibrated)
    q = _pose(arguments.pose, shown.table)
    if q is not None and len(q) == robot.n_joints:
        q = robot.from_reported(q[None])[0]
    scene = build_scene(
        calibrated,
        shown.table,
        held_out=shown.held_out,
        grid=arguments.grid,
        scale=arguments.scale,
        axis_scale=arguments.axis_scale,
        mesh_folders=arguments.meshes,
    )
    return scene.opening(q, notes=shown.notes)


def _pose(text: str | None, table: Measurements | None) -> np.ndarray | None:
    """Return the pose that the user gives: a row of the table, or joint positions."""
    if text is None:
        return None
    words = text.replace(",", " ").split()
    values = np.array(plain_numbers(words))
    if not len(values):
        raise BadInputError(
            f'--pose {text!r}; expected a row of DATA or joint positions such as "0, -1.2, 1.5"'
        )
    if len(words) > 1 or not words[0].isdigit():
        return values
    if table is None:
        raise BadInputError(
            f"--pose {text}: a row, but no DATA.csv is given; give it, or joint positions "
            '"q1,q2,.."'
        )
    row = int(words[0])
    if not 1 <= row <= len(table):
        raise BadInputError(
            f"--pose {row}: {table.source} has {len(table)} rows; expected 1 to {len(table)}"
        )
    return np.asarray(table.q[row - 1])


def _print_scene(scene: Scene, where: dict[str, Any], *, as_json: bool) -> None:
    layers: list[dict[str, Any]] = [
        {
            "name": layer.name,
            "arrows": len(layer.sizes),
            "mean_mm": 1e3 * float(layer.sizes.mean()),
            "max_mm": 1e3 * float(layer.sizes.max()),
            "words": layer.words,
        }
        for layer in scene.fields.layers
    ]
    if as_json:
        scales = {"scale": scene.scale, "axis_scale": scene.axis_scale}
        print_json(where | scales | {"layers": layers, "notes": list(scene.notes)})
        return
    width = max(len(layer["name"]) for layer in layers)
    for layer in layers:
        sizes = f"mean {layer['mean_mm']:.4f} mm, max {layer['max_mm']:.4f} mm"
        click.echo(f"{layer['name']:{width}}  {layer['arrows']:6d} arrows, {sizes}")
    click.echo(
        f"arrows are enlarged {scene.scale:g} times, tilts and offsets of axes "
        f"{scene.axis_scale:g} times"
    )
    for note in scene.notes:
        click.echo(f"note: {note}")
    if "html" in where:
        click.echo(f"written to {where['html']}, {where['bytes'] / 1e6:.1f} MB")
    else:
        click.echo(f"open {where['url']} (from this computer only; Ctrl-C stops)")
    sys.stdout.flush()
