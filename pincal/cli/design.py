"""``pincal design``: which poses to measure, how many, and what they will tell."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np

from pincal.cli import show_progress
from pincal.cli.common import ANGLE, LENGTH, options, output_options, plugin_option, print_json

_EPILOG = """\b
Examples:
  pincal design robot.urdf --poses 40 --instrument 3.5 -1 1.2 --payload 80 --out poses.csv
  pincal design robot.urdf --accuracy 0.05mm --noise 0.03mm --out poses.csv     # how many poses do I need?
  pincal design robot.urdf --poses 20 --measured tracker.csv --out more.csv     # and where to go on?
  pincal design robot.urdf --poses 40 --out poses.csv \\
      --tell-apart gear_eccentricity:joint_2 gravity_compensator:joint_2
To practise:
  pincal simulate robot.urdf --at poses.csv --out tracker.csv

An effect is NAME[:JOINT][:KEY=VALUE,...] of the catalogue that discover uses. Nothing is known of
the ways from pose to pose, nor of what stands around the robot: check them before it moves.
"""

_POINT: dict[str, Any] = {"nargs": 3, "type": float, "metavar": "X Y Z"}
_FILE: dict[str, Any] = {"metavar": "FILE.csv", "type": click.Path(path_type=Path)}

_wanted = options(
    click.option("--poses", type=click.IntRange(min=1), metavar="N", help="Number of poses to choose."),
    click.option("--accuracy", type=LENGTH,
                 help="Instead of N: the fewest poses that reach this predicted error, e.g. 0.05mm."),
    click.option("--out", required=True, **_FILE, help="Table of the poses to write, to be filled in."),
    click.option("--criterion", type=click.Choice(["task", "determinant"]), default="task", show_default=True,
                 help="Smallest predicted error over the task, or smallest uncertainty of all parameters together."),
    click.option("--task", **_FILE, help="Joint positions that have to be accurate; anywhere in reach unless given."),
    click.option("--measured", **_FILE, help="Poses measured already: what they tell counts, N are added."),
    click.option("--tell-apart", nargs=2, metavar="EFFECT EFFECT", help="Tell these two effects apart instead."),
    click.option("--candidates", type=click.IntRange(min=2), metavar="N",
                 help="Number of random poses to choose from.  [default: 1500, or twice the poses]"),
    click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of all that is drawn."),
)  # fmt: skip

_constraints = options(
    click.option("--instrument", **_POINT, help="Where it stands, in the robot's base frame [m]: it has to see the target."),
    click.option("--normal", **_POINT, help="Where the target looks, in the tip frame; seen from all sides unless given."),
    click.option("--cone", type=ANGLE, metavar="ANGLE", default="30deg", show_default=True,
                 help="How far off its normal it is still seen."),
    click.option("--box", nargs=6, type=float, metavar="X Y Z X Y Z",
                 help="Least and largest coordinates of the target where it is measured, in the base frame [m]."),
    click.option("--floor", type=float, metavar="Z",
                 help="Height in the base frame above which arm and target stay [m].  [default: 0 if upright]"),
    click.option("--no-floor", is_flag=True, help="No floor."),
    click.option("--clearance", type=LENGTH, metavar="LENGTH", default="10mm", show_default=True,
                 help="Distance that the arm keeps from itself, where the URDF has collision geometry."),
    click.option("--span", type=float, default=0.95, show_default=True, help="Part of the joint range that is used."),
)  # fmt: skip

_model = options(
    click.option("--tip", metavar="LINK", help="Link at the end of the arm; the end of the longest chain unless given."),
    click.option("--base", metavar="LINK", help="Link at its start; the root of the URDF unless given."),
    click.option("--sensor", type=click.Choice(["position", "pose", "distance"]), default="position", show_default=True,
                 help="What will be measured."),
    click.option("--tool", **_POINT,
                 help="About where the target sits in the tip frame [m]; a little off the last axis unless given."),
    click.option("--model", type=click.Choice(["geometric", "elastic"]), default="elastic", show_default=True,
                 help="What will be calibrated: geometry, or elasticity of joints and bearings, too."),
    click.option("--noise", type=LENGTH, default="0.05mm", show_default=True,
                 help="Standard deviation of one coordinate of a position, or of a distance."),
    click.option("--noise-angle", type=ANGLE, default="0.1mrad", show_default=True, help="Likewise of an orientation."),
    click.option("--payload", metavar="KG[,KG...]", help="One load or several, from which each pose is given the best."),
    click.option("--payload-com", **_POINT, default=(0.0, 0.0, 0.0),
                 help="Centre of mass of the payload in the tip frame [m]."),
    click.option("--moment-frame", type=click.Choice(["paper", "before", "after"]), default="paper", show_default=True,
                 help="Where moments are taken and bend: paper takes them before and bends after the joint."),
    click.option("--gravity", **_POINT, help="In the robot's base frame [m/s^2]; -z unless given."),
)  # fmt: skip


@click.command(epilog=_EPILOG)
@click.argument("robot", metavar="ROBOT.urdf")
@_wanted
@_constraints
@_model
@plugin_option
@output_options
def design(robot: str, out: Path, as_json: bool, quiet: bool, **chosen: Any) -> int:
    """Choose the poses to measure: those that tell most, within reach and in sight, and how many are needed."""
    show_progress(quiet)
    from pincal.cli.inputs import load_table
    from pincal.design.design import design_poses
    from pincal.measure.table import write_table
    from pincal.robot.robot import Robot

    if chosen["poses"] is None and chosen["accuracy"] is None:
        raise click.UsageError("give --poses N, or --accuracy for as many as are needed")
    arm = Robot.from_urdf(robot, tip=chosen["tip"], base=chosen["base"])
    task, measured = (None if chosen[name] is None else load_table(arm, chosen[name], joints_only=True)
                      for name in ("task", "measured"))  # fmt: skip
    found = design_poses(
        arm,
        chosen["poses"],
        _options(chosen),
        rig=_rig(chosen),
        limits=_limits(arm, chosen),
        criterion=chosen["criterion"],
        tell_apart=chosen["tell_apart"] or None,
        accuracy=chosen["accuracy"],
        task=task,
        measured=measured,
        payloads=_loads(chosen["payload"]),
        candidates=chosen["candidates"],
        seed=chosen["seed"],
    )
    write_table(out, found.columns())
    if as_json:
        print_json(found.to_dict() | {"out": str(out)})
    else:
        from pincal.cli.tables import console, print_design

        print_design(found, console())
        click.echo(f"written to {out}, in an order of short ways")
    return 0


def _options(chosen: dict[str, Any]) -> Any:
    from pincal.identify.calibrate import Options
    from pincal.model.effects import ELASTIC, GEOMETRIC

    return Options(
        effects=GEOMETRIC if chosen["model"] == "geometric" else ELASTIC,
        sigma=chosen["noise"],
        sigma_orientation=chosen["noise_angle"],
        moment_frame=chosen["moment_frame"],
        gravity=chosen["gravity"] or None,
        payload_centre=chosen["payload_com"],
    )


def _rig(chosen: dict[str, Any]) -> Any:
    from pincal.design.reach import SensorSetup

    names = ("sensor", "tool", "instrument", "normal", "cone")
    return SensorSetup(**{name: chosen[name] for name in names if chosen[name] is not None})


def _limits(arm: Any, chosen: dict[str, Any]) -> Any:
    """Return the limits; an arm on a wall or a ceiling has no floor at its base."""
    from pincal.design.reach import Limits

    if chosen["no_floor"] and chosen["floor"] is not None:
        raise click.UsageError("--floor and --no-floor exclude each other")
    gravity = np.array(chosen["gravity"] or arm.gravity)
    is_upright = gravity[2] < -0.9 * np.linalg.norm(gravity)
    floor = 0.0 if chosen["floor"] is None and is_upright and not chosen["no_floor"] else chosen["floor"]
    return Limits(span=chosen["span"], floor=floor, box=chosen["box"] or None, clearance=chosen["clearance"])


def _loads(text: str | None) -> tuple[float, ...] | None:
    if text is None:
        return None
    try:
        return tuple(float(part.strip().removesuffix("kg")) for part in text.split(","))
    except ValueError:
        raise click.BadParameter(f"{text!r}; expected one or several masses in kg, such as 80 or 0,80",
                                 param_hint="--payload") from None  # fmt: skip
