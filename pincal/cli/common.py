"""What several verbs share: options, units on the command line, files written whole or not at all."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import click

from pincal.errors import OutputError
from pincal.plugins import load_plugin

F = TypeVar("F", bound=Callable[..., Any])

_LENGTHS = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0}
_ANGLES = {"urad": 1e-6, "mrad": 1e-3, "rad": 1.0, "deg": 0.017453292519943295}


class Quantity(click.ParamType[float]):
    """A number with its unit, such as ``0.05mm``."""

    def __init__(self, units: dict[str, float], name: str) -> None:
        self._units = units
        self.name = name

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the value in SI units."""
        if isinstance(value, float):
            return value
        text = str(value).strip()
        for unit in sorted(self._units, key=len, reverse=True):
            if text.endswith(unit):
                try:
                    number = float(text.removesuffix(unit))
                except ValueError:
                    break
                if not 0.0 < number < float("inf"):
                    self.fail(f"{text!r} is not a positive number", param, ctx)
                return number * self._units[unit]
        self.fail(f"{text!r}; expected a number with a unit, such as {self.name} ({', '.join(self._units)})", param, ctx)


class Noise(click.ParamType[tuple[float, str]]):
    """The noise of a reading: a length in metres, or pixels; with the unit, "m" or "px"."""

    name = "0.05mm"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, str]:
        """Return the value in SI units, or in pixels, and its unit."""
        is_image = str(value).strip().endswith("px")
        units = {"px": 1.0} if is_image else _LENGTHS
        return Quantity(units, "0.1px" if is_image else "0.05mm").convert(str(value), param, ctx), "px" if is_image else "m"


LENGTH = Quantity(_LENGTHS, "0.05mm")
ANGLE = Quantity(_ANGLES, "0.1mrad")


def options(*decorators: Callable[[F], F]) -> Callable[[F], F]:
    """Stack option decorators into one."""

    def stacked(function: F) -> F:
        for decorator in reversed(decorators):
            function = decorator(function)
        return function

    return stacked


def _load_plugins(context: click.Context, parameter: click.Parameter, names: tuple[str, ...]) -> tuple[str, ...]:
    for name in names:
        load_plugin(name)
    return names


# Of every verb that reads a robot, a table or a model. Plugins are loaded before anything else is looked at.
plugin_option = click.option(
    "--plugin", metavar="MODULE", multiple=True, expose_value=False, is_eager=True, callback=_load_plugins,
    help="A module or .py file that registers effects or sensors of your own; may be repeated.",
)  # fmt: skip

robot_options = options(
    click.argument("robot", metavar="ROBOT.urdf"),
    click.argument("data", metavar="DATA.csv", type=click.Path(path_type=Path)),
    click.option("--tip", metavar="LINK", help="Link at the end of the arm; found from the joint columns unless given."),
    click.option("--base", metavar="LINK", help="Link at its start; the root of the URDF unless given."),
    click.option("--ignore", metavar="COLUMN", multiple=True, help="A column of the table to leave unread."),
    plugin_option,
)

model_argument = options(
    click.argument("model", metavar="MODEL.json", type=click.Path(path_type=Path)),
    plugin_option,
)

model_options = options(
    click.option("--model", type=click.Choice(["geometric", "elastic"]), default="elastic", show_default=True,
                 help="elastic: geometry and elasticity of joints and bearings."),
    click.option("--moment-frame", type=click.Choice(["paper", "before", "after"]), default="paper", show_default=True,
                 help="Where moments are taken and bend: paper takes them before and bends after the joint."),
    click.option("--equilibrium", is_flag=True, help="Moments on the bent arm instead of the straight one."),
    click.option("--payload-com", nargs=3, type=float, metavar="X Y Z", default=(0.0, 0.0, 0.0),
                 help="Centre of mass of the payload in the tip frame [m]."),
    click.option("--gravity", nargs=3, type=float, metavar="X Y Z",
                 help="In the robot's base frame [m/s^2]; -z unless given."),
    click.option("--noise", type=Noise(),
                 help="Standard deviation of one coordinate of a position, e.g. 0.05mm, or of an image, e.g. 0.1px; "
                      "estimated unless given."),
    click.option("--noise-angle", type=ANGLE, help="Likewise of an orientation, e.g. 0.1mrad."),
    click.option("--points", metavar="FILE.csv", type=click.Path(path_type=Path),
                 help="Where sockets, anchors or points of a calibration object are: columns point x y z; for those known."),
    click.option("--points-in", type=click.Choice(["own", "base"]), default="own", show_default=True,
                 help="Frame of these positions: one of their own, which is found, or the robot's base."),
    click.option("--socket-distance", "gaps", type=(str, str, float), multiple=True, metavar="A B METRES",
                 help="A known distance between two sockets (anchors, points); any number of them."),
    click.option("--distances", metavar="FILE.csv", type=click.Path(path_type=Path),
                 help="The same as a table: columns first second distance, and sigma where known."),
    click.option("--camera", metavar="FILE.json", type=click.Path(path_type=Path),
                 help="Images: the camera, with fx fy u0 v0 [px], k1 k2 p1 p2 k3, and T_tip_camera where its mount is "
                      "known; found from the data unless given."),
    click.option("--fit-camera", is_flag=True, help="Find the given camera's parameters again, too."),
    click.option("--anchor", nargs=3, type=float, metavar="X Y Z",
                 help="Distances: the instrument's point in the robot's base frame [m], where known."),
    click.option("--tool", nargs=3, type=float, metavar="X Y Z", help="The target in the tip frame [m], where known."),
    click.option("--stages", type=click.Choice(["joint", "paper"]), default="joint", show_default=True,
                 help="All at once, or the paper's four stages."),
    click.option("--loss", type=click.Choice(["screen", "huber", "none"]), default="screen", show_default=True,
                 help="Outliers: leave them out, weigh them down, or take them as they are."),
    click.option("--length-bound", type=LENGTH, default=0.01, help="Largest deviation of a length.  [default: 10mm]"),
)  # fmt: skip

split_options = options(
    click.option("--test-fraction", type=float, default=0.25, show_default=True, help="Part of the rows held out."),
    click.option("--split", type=click.Choice(["random", "blocked"]), default="random", show_default=True,
                 help="Hold out rows at random, or whole regions of joint space."),
    click.option("--holdout", metavar="FILE.csv", type=click.Path(path_type=Path),
                 help="Validate on this table; all rows of DATA then train."),
    click.option("--seed", type=int, default=0, show_default=True, help="Of the choice of held-out rows."),
)  # fmt: skip

view_option = click.option("--view", is_flag=True, help="Also write view3d.html: the robot and its errors in 3D.")

output_options = options(
    click.option("--json", "as_json", is_flag=True, help="Print the result as JSON, for programs."),
    click.option("--quiet", is_flag=True, help="No progress and no notes on stderr."),
)


@contextmanager
def output_folder(path: Path) -> Iterator[Path]:
    """Yield a folder to write to; at a good end its files move to ``path``, else nothing there has changed.

    Raises:
        OutputError: if ``path`` is a file or can't be written.
    """
    is_new = not path.exists()
    try:
        path.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(prefix=".pincal-", dir=path))
    except OSError as error:
        raise OutputError(f"{path}: can't write here ({error.strerror}); choose another --out") from None
    try:
        yield draft
        for file in sorted(draft.iterdir()):
            os.replace(file, path / file.name)
    except OSError as error:
        raise OutputError(f"{path}: can't write here ({error.strerror}); choose another --out") from None
    finally:
        shutil.rmtree(draft, ignore_errors=True)
        if is_new and not any(path.iterdir()):
            path.rmdir()


def print_json(contents: dict[str, Any]) -> None:
    """Print a result for programs."""
    click.echo(json.dumps(contents, indent=2, allow_nan=False))


def provenance(files: list[Path], *, seed: int | None = None) -> dict[str, Any]:
    """Return what a result rests on: versions, command, inputs with their hashes."""
    from importlib.metadata import version

    return {
        "pincal": version("pincal"),
        "numpy": version("numpy"),
        "pin": version("pin"),
        "python": sys.version.split()[0],
        "command": " ".join(["pincal", *sys.argv[1:]]),
        "seed": seed,
        "inputs": {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in files if file.is_file()},
    }
