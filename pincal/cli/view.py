"""``pincal view``: the robot and its deviations in three dimensions."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click
import numpy as np

from pincal.cli import show_progress
from pincal.cli.common import model_argument, output_options, print_json
from pincal.errors import BadInputError

_EPILOG = """\b
Examples:
  pincal view results/model.json tracker.csv --html view.html
  pincal view results/model.json tracker.csv --pose 17
  pincal view results/model.json --pose "0, -1.2, 1.5, 0, 0.3, 0" --grid 3000

The page opens offline in any browser with WebGL. Without --html it is served to this machine alone,
until Ctrl-C. Layers are switched on and off by name there, in the panel or in the control tree.
"""


@click.command(epilog=_EPILOG)
@model_argument
@click.argument("data", metavar="[DATA.csv]", required=False, type=click.Path(path_type=Path))
@click.option("--html", "html_file", metavar="FILE.html", type=click.Path(path_type=Path), help="Write one page instead.")
@click.option(
    "--pose",
    metavar='ROW|"q1,q2,.."',
    help="Pose to begin with: a row of DATA, counted from 1, or joint positions [rad or m].",
)
@click.option("--scale", type=float, metavar="FACTOR", help="Of the arrows' lengths; found from their sizes unless given.")
@click.option("--axis-scale", type=float, metavar="FACTOR", help="Of the axes' tilts and offsets, likewise.")
@click.option(
    "--grid",
    type=click.IntRange(0, 100_000),
    default=1000,
    show_default=True,
    help="Places of the workspace that get an arrow.",
)
@click.option(
    "--holdout",
    metavar="FILE.csv",
    type=click.Path(path_type=Path),
    help="More measurements, to be marked as held out; all rows of DATA then count as fitted.",
)
@click.option(
    "--meshes",
    metavar="DIR",
    multiple=True,
    type=click.Path(path_type=Path),
    help="Where else to look for the URDF's meshes and packages.",
)
@click.option("--ignore", metavar="COLUMN", multiple=True, help="A column of the table to leave unread.")
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Of the server; a free one unless given.")
@click.option(
    "--open/--no-open", "open_page", default=None, help="Open the page; a served one opens on a terminal unless told not to."
)
@output_options
def view(model: Path, html_file: Path | None, open_page: bool | None, port: int, as_json: bool, quiet: bool,
         **chosen: Any) -> int:  # fmt: skip
    """Show the robot and the field of its deviations: before, after, and what each effect explains."""
    show_progress(quiet)
    from pincal.viewer import show, write_html

    scene = _scene(model, **chosen)
    if html_file is not None:
        size = write_html(html_file, scene)
        _tell(scene, {"html": str(html_file), "bytes": size}, as_json)
        if open_page:
            click.launch(str(html_file))
        return 0
    browser = sys.stdout.isatty() if open_page is None else open_page
    with show(scene, port=port, browser=browser) as live:
        _tell(scene, {"url": live.url}, as_json)
        try:
            live.wait()
        except KeyboardInterrupt:
            if not quiet:
                click.echo("pincal: stopped", err=True)
    return 0


def _scene(model: Path, data: Path | None, pose: str | None, holdout: Path | None, ignore: tuple[str, ...],
           grid: int, scale: float | None, axis_scale: float | None, meshes: tuple[Path, ...]) -> Any:  # fmt: skip
    from pincal.calibration.calibrated import load_model
    from pincal.cli.inputs import load_table
    from pincal.cli.use import _check_targets
    from pincal.measure.table import concatenate
    from pincal.viewer import build_scene, held_out_rows

    calibrated = load_model(model)
    robot = calibrated.model.chain.robot
    table, held, words = None, None, []
    if data is not None:
        table = load_table(robot, data, ignore=ignore)
        if holdout is None:
            held, why = held_out_rows(calibrated.provenance, model.with_name("residuals.csv"), data, table)
            words.append(why)
    if holdout is not None:
        if table is None:
            raise BadInputError(f"{holdout}: --holdout without DATA.csv; give the fitted table first, or only this one")
        more = load_table(robot, holdout, ignore=ignore)
        held = np.repeat([False, True], [len(table), len(more)])
        table = concatenate([table, more])
    if table is not None:
        _check_targets(calibrated, table)
    return build_scene(
        calibrated,
        table,
        held_out=held,
        q=_pose(pose, table),
        grid=grid,
        scale=scale,
        axis_scale=axis_scale,
        mesh_folders=meshes,
        notes=words,
    )


def _pose(text: str | None, table: Any) -> np.ndarray | None:
    """Return the pose that the user means: a row of the table, or joint positions."""
    if text is None:
        return None
    words = text.replace(",", " ").split()
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        values = np.zeros(0)
    if not len(values):
        raise BadInputError(f'--pose {text!r}; expected a row of DATA, or joint positions such as "0, -1.2, 1.5"')
    if len(words) > 1 or not words[0].isdigit():
        return values
    if table is None:
        raise BadInputError(f'--pose {text}: a row, but no DATA.csv is given; give it, or joint positions "q1,q2,.."')
    row = int(words[0])
    if not 1 <= row <= len(table):
        raise BadInputError(f"--pose {row}: {table.source} has {len(table)} rows; expected 1 to {len(table)}")
    return np.asarray(table.q[row - 1])


def _tell(scene: Any, where: dict[str, Any], as_json: bool) -> None:
    layers = [
        {"name": layer.name, "arrows": len(layer.sizes), "mean_mm": 1e3 * float(layer.sizes.mean()),
         "max_mm": 1e3 * float(layer.sizes.max()), "words": layer.words} for layer in scene.fields.layers
    ]  # fmt: skip
    if as_json:
        print_json({**where, "scale": scene.scale, "axis_scale": scene.axis_scale, "layers": layers,
                    "notes": list(scene.notes)})  # fmt: skip
        return
    width = max(len(layer["name"]) for layer in layers)
    for layer in layers:
        click.echo(f"{layer['name']:{width}}  {layer['arrows']:6d} arrows, mean {layer['mean_mm']:.4f} mm, "
                   f"max {layer['max_mm']:.4f} mm")  # fmt: skip
    click.echo(f"arrows longer than true by {scene.scale:g}, tilts and offsets of axes larger by {scene.axis_scale:g}")
    for note in scene.notes:
        click.echo(f"note: {note}")
    if "html" in where:
        click.echo(f"written to {where['html']}, {where['bytes'] / 1e6:.1f} MB")
    else:
        click.echo(f"open {where['url']} (this machine only; Ctrl-C stops)")
    sys.stdout.flush()
