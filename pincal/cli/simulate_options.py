"""Options of ``pincal simulate``: the machine, and the campaign in which it is measured."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

from pincal.cli.common import ANGLE, LENGTH, Quantity, options

RECORDED = ("temperature", "time", "approach")
"""Columns that a campaign may record of its conditions."""


class _Level(click.ParamType[float]):
    """A quantity that may be zero."""

    name = "level"

    def __init__(self, quantity: Quantity) -> None:
        self._quantity = quantity

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        text = str(value).strip().rstrip("umradegc")
        try:
            is_zero = float(text) == 0.0
        except ValueError:
            is_zero = False
        return 0.0 if is_zero else self._quantity.convert(value, param, ctx)


class _Loads(click.ParamType[tuple[float, ...]]):
    """Payloads separated by commas."""

    name = "payloads"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        try:
            loads = tuple(float(part.strip().removesuffix("kg")) for part in str(value).split(","))
        except ValueError:
            loads = ()
        if not loads or not all(math.isfinite(load) and load >= 0.0 for load in loads):
            self.fail(f"{value!r}; expected one or several masses in kg, such as 80 or 0,80", param, ctx)
        return loads


class _Share(click.FloatRange):
    """A finite number in a range; nan would pass every comparison."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number", param, ctx)
        return number


_SCALE = _Share(min=0.0)

machine_options = options(
    click.option("--tip", metavar="LINK", help="Link at the end of the arm; the end of the longest chain unless given."),
    click.option("--base", metavar="LINK", help="Link at its start; the root of the URDF unless given."),
    click.option("--errors", type=_SCALE, default=1.0, show_default=True, metavar="SCALE",
                 help="Size of the drawn geometric errors; 1 is typical, 0 none."),
    click.option("--elastic", type=_SCALE, metavar="SCALE",
                 help="Compliance of drives and bearings; 1 is typical, 0 rigid.  [default: 1 if the URDF has masses]"),
    click.option("--moment-frame", type=click.Choice(["paper", "before", "after"]), default="after", show_default=True,
                 help="Where bearings give way, in the URDF's own joint frames; discover finds out which."),
    click.option("--masses-off", type=_Share(0.0, 30.0), default=0.0, metavar="PERCENT",
                 help="Error of the URDF's masses and centres of mass (standard deviation)."),
    click.option("--gravity", nargs=3, type=float, metavar="X Y Z",
                 help="In the robot's base frame [m/s^2]; -z unless given."),
    click.option("--effect", "effects", multiple=True, metavar="NAME[:JOINT][:KEY=VALUE,...]",
                 help="A hidden effect, see below; any number of them."),
)  # fmt: skip

campaign_options = options(
    click.option("--poses", type=int, metavar="N", help="Number of random poses."),
    click.option("--at", type=click.Path(path_type=Path), metavar="FILE.csv",
                 help="Joint positions (and payload, temperature, ...) from this table instead."),
    click.option("--floor", type=float, default=0.0, show_default=True, metavar="Z",
                 help="Height in the base frame above which random poses keep the arm [m]."),
    click.option("--no-floor", is_flag=True, help="Random poses anywhere within the joint limits."),
    click.option("--payload", type=_Loads(), metavar="KG[,KG...]", help="One load or several; no column unless given."),
    click.option("--payload-order", type=click.Choice(["blocks", "alternating"]), default="blocks", show_default=True,
                 help="Several loads: one after the other, or in turn."),
    click.option("--payload-com", nargs=3, type=float, default=(0.0, 0.0, 0.0), metavar="X Y Z",
                 help="Centre of mass of the payload in the tip frame [m]."),
    click.option("--with", "recorded", multiple=True, type=click.Choice(RECORDED),
                 help="A column to record, whether an effect needs it or not."),
    click.option("--hide", multiple=True, type=click.Choice([*RECORDED, "payload"]),
                 help="A column that has its effect but is not recorded."),
    click.option("--sensor", default="position", show_default=True, metavar="KIND",
                 help="What is measured: position, pose or distance."),
    click.option("--noise", type=_Level(LENGTH), default="0.05mm", show_default=True,
                 help="Standard deviation of a coordinate or of the distance; 0mm for exact readings."),
    click.option("--noise-angle", type=_Level(ANGLE), default="0.1mrad", show_default=True,
                 help="Likewise of an orientation (pose)."),
    click.option("--targets", type=click.IntRange(1, 20), default=1, show_default=True, metavar="K",
                 help="Number of targets on the tool, each measured in every pose."),
    click.option("--tool", nargs=3, type=float, metavar="X Y Z",
                 help="The target in the tip frame [m]; drawn unless given."),
    click.option("--instrument", type=click.Choice(["drawn", "base"]), default="drawn", show_default=True,
                 help="Where it stands: anywhere in the hall, or in the robot's base frame."),
    click.option("--seed", type=int, default=0, show_default=True, help="Of the machine, the instrument and all else."),
    click.option("--pose-seed", type=int, help="Of poses, conditions and noise; that of the machine unless given."),
)  # fmt: skip
