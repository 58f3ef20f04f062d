"""Options of ``pincal simulate``: the machine, and the campaign in which it is measured."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from pincal.cli.common import ANGLE, LENGTH, Quantity, options
from pincal.errors import BadInputError

if TYPE_CHECKING:
    from pincal.simulate.sensors import SetupOptions


_BESIDE, _CAMERAS = ("position", "pose", "distance"), ("camera_point", "camera_pixel")
# Options that only some sensors have; the sensor that those of them which say it all stand for.
_GOES_WITH = {
    "sockets": ("socket",),
    "socket_spacing": ("socket",),
    "anchors": ("distance",),
    "ball_bar": ("distance",),
    "object": _CAMERAS,
    "lens": _CAMERAS,
    "camera_out": ("camera_pixel",),
    "targets": _BESIDE,
    "instrument": (*_BESIDE, "socket"),
    "noise_angle": ("pose",),
}
_IMPLIED = {"sockets": "socket", "anchors": "distance", "ball_bar": "distance"}
_NOISE = {"m": 5e-5, "px": 0.1}
# Images of the paper's object: three blocks on each of two sides, two joint configurations each.
_PAPER_POSES = 12
# Columns that a campaign may record of its conditions.
_RECORDED = ("temperature", "time", "approach")


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


class _Noise(click.ParamType[tuple[float, str]]):
    """A length or a number of pixels, with the unit that it was given in: "m", "px", or none for zero."""

    name = "noise"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, str]:
        text = str(value).strip()
        if not text.endswith("px"):
            number = _Level(LENGTH).convert(text, param, ctx)
            return number, "m" if number else ""
        try:
            number = float(text.removesuffix("px"))
        except ValueError:
            number = math.nan
        if not (math.isfinite(number) and number >= 0.0):
            self.fail(f"{text!r} is not a number of pixels, such as 0.1px", param, ctx)
        return number, "px"


class _Lens(click.ParamType[dict[str, float]]):
    """Intrinsics of a camera."""

    name = "lens"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> dict[str, float]:
        return value if isinstance(value, dict) else parse_lens(str(value))


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
    click.option("--cycles", type=click.IntRange(1, 1000), default=1, show_default=True, metavar="N",
                 help="Visits of every pose, one round after the other: repeatability (ISO 9283) needs 30."),
    click.option("--floor", type=float, default=0.0, show_default=True, metavar="Z",
                 help="Height in the base frame above which random poses keep the arm [m]."),
    click.option("--no-floor", is_flag=True, help="Random poses anywhere within the joint limits."),
    click.option("--payload", type=_Loads(), metavar="KG[,KG...]", help="One load or several; no column unless given."),
    click.option("--payload-order", type=click.Choice(["blocks", "alternating"]), default="blocks", show_default=True,
                 help="Several loads: one after the other, or in turn."),
    click.option("--payload-com", nargs=3, type=float, default=(0.0, 0.0, 0.0), metavar="X Y Z",
                 help="Centre of mass of the payload in the tip frame [m]."),
    click.option("--with", "recorded", multiple=True, type=click.Choice(_RECORDED),
                 help="A column to record, whether an effect needs it or not."),
    click.option("--hide", multiple=True, type=click.Choice([*_RECORDED, "payload"]),
                 help="A column that has its effect but is not recorded."),
    click.option("--seed", type=int, default=0, show_default=True, help="Of the machine, the instrument and all else."),
    click.option("--pose-seed", type=int, help="Of poses, conditions and noise; that of the machine unless given."),
)  # fmt: skip

setup_options = options(
    click.option("--sensor", metavar="KIND",
                 help="What is measured: position, pose, distance, socket, camera_point or camera_pixel.  "
                      "[default: position, or what --sockets, --anchors and --ball-bar stand for]"),
    click.option("--noise", type=_Noise(), metavar="LEVEL",
                 help="Standard deviation of a coordinate, of the distance, of the point in its socket, or of image "
                      "coordinates; 0mm for exact readings.  [default: 0.05mm, 0.1px]"),
    click.option("--noise-angle", type=_Level(ANGLE), default="0.1mrad", show_default=True,
                 help="Likewise of an orientation (pose)."),
    click.option("--targets", type=click.IntRange(1, 20), default=1, show_default=True, metavar="K",
                 help="Number of targets on the tool, each measured in every pose."),
    click.option("--tool", nargs=3, type=float, metavar="X Y Z",
                 help="Target, tool point or camera in the tip frame [m]; drawn unless given."),
    click.option("--instrument", type=click.Choice(["drawn", "base"]), default="drawn", show_default=True,
                 help="Where it stands: anywhere in the hall, or in the robot's base frame."),
    click.option("--sockets", type=click.IntRange(1, 100), metavar="K",
                 help="Number of sockets that the tool point is held in; --poses are shared out among them.  [default: 4]"),
    click.option("--socket-spacing", type=LENGTH, metavar="LENGTH",
                 help="Sockets come in pairs so far apart.  [default: 50mm]"),
    click.option("--anchors", type=click.IntRange(1, 100), metavar="K",
                 help="Number of fixed points from which distances are measured; one without a name unless given."),
    click.option("--ball-bar", type=LENGTH, metavar="LENGTH",
                 help="A bar of this length holds the tool point on a sphere about each anchor; --poses are shared out."),
    click.option("--object", type=click.Choice(["paper", "grid"]),
                 help="What the camera sees: two sides with three fields of 25 points each, --poses shared out among "
                      "them, 12 unless given; or a plane grid of 63 points.  [default: paper]"),
    click.option("--lens", type=_Lens(), metavar="KEY=VALUE,...",
                 help="Of the camera: fx fy u0 v0 [px], k1 k2 k3 p1 p2, width height [px]; drawn unless given."),
    click.option("--points-out", type=click.Path(path_type=Path), metavar="FILE.csv",
                 help="Write the named points: sockets and anchors in the instrument's frame, an object's in its own."),
    click.option("--camera-out", type=click.Path(path_type=Path), metavar="FILE.json",
                 help="Write the camera (camera_pixel)."),
)  # fmt: skip


def settle_options(chosen: dict[str, Any]) -> None:
    """Fill in what follows from other options: sensor, noise, number of poses.

    Args:
        chosen: Options of the command by name; changed in place.

    Raises:
        UsageError: If an option has nothing to do with the sensor.
    """
    context = click.get_current_context()
    given = {name for name in chosen if context.get_parameter_source(name) is not click.core.ParameterSource.DEFAULT}
    if chosen["sensor"] is None:
        implied = [kind for name, kind in _IMPLIED.items() if name in given]
        chosen["sensor"] = implied[0] if implied else "position"
    sensor = chosen["sensor"]
    for name in sorted(given & _GOES_WITH.keys()):
        if sensor not in _GOES_WITH[name]:
            option = f"--{name.replace('_', '-')}"
            raise click.UsageError(f"{option} goes with --sensor {' or '.join(_GOES_WITH[name])}, not with {sensor}")
    if chosen["ball_bar"] is not None and "targets" in given:
        raise click.UsageError("--ball-bar holds one tool point; leave out --targets")
    if chosen["points_out"] is not None and not (chosen["anchors"] or chosen["ball_bar"] or sensor not in _BESIDE):
        raise click.UsageError(
            f"--points-out: --sensor {sensor} has no named points; expected socket, a camera or --anchors"
        )
    if sensor in _CAMERAS and chosen["poses"] is None and chosen["at"] is None and chosen["object"] != "grid":
        chosen["poses"] = _PAPER_POSES
    if (chosen["poses"] is None) == (chosen["at"] is None):
        raise click.UsageError("give either --poses N or --at FILE.csv")
    if chosen["poses"] is not None and chosen["poses"] < 1:
        raise BadInputError(f"--poses {chosen['poses']}; expected 1 or more")
    if chosen["pose_seed"] is None:
        chosen["pose_seed"] = chosen["seed"]
    _settle_noise(chosen)


def _settle_noise(chosen: dict[str, Any]) -> None:
    """Put a number in the sensor's own unit in place of the noise."""
    unit = "px" if chosen["sensor"] == "camera_pixel" else "m"
    value, given = (_NOISE[unit], unit) if chosen["noise"] is None else chosen["noise"]
    if given not in (unit, ""):
        raise click.UsageError(f"--noise: {chosen['sensor']} is measured in {unit}; expected such as {_example(unit)}")
    chosen["noise"] = value


def _example(unit: str) -> str:
    return "0.1px" if unit == "px" else "0.05mm"


def setup_of(chosen: dict[str, Any]) -> SetupOptions:
    """Return what the options ask of the set-up.

    Args:
        chosen: Options of the command by name, settled.
    """
    from pincal.simulate.sensors import SetupOptions

    wanted = SetupOptions(
        sigma=chosen["noise"],
        sigma_angle=chosen["noise_angle"],
        targets=chosen["targets"],
        tool=chosen["tool"],
        at_base=chosen["instrument"] == "base",
        anchors=chosen["anchors"] or 0,
        ball_bar=chosen["ball_bar"],
        lens=chosen["lens"] or {},
        min_height=None if chosen["no_floor"] else chosen["floor"],
    )
    given = {"sockets": chosen["sockets"], "spacing": chosen["socket_spacing"], "seen": chosen["object"]}
    return replace(wanted, **{name: value for name, value in given.items() if value is not None})


def parse_lens(text: str) -> dict[str, float]:
    """Return intrinsics of a camera by name.

    Args:
        text: As on the command line, e.g. ``fx=1200,k1=-0.1``.

    Returns:
        Values by name.

    Raises:
        BadInputError: For a key or a value that can't be, with those that can.

    Example:
        >>> parse_lens("fx=1200,fy=1210,width=1280")
        {'fx': 1200.0, 'fy': 1210.0, 'width': 1280.0}
    """
    from pincal.simulate.lens import Lens

    known, found = tuple(Lens().intrinsics), dict[str, float]()
    for pair in text.split(","):
        key, _, value = (word.strip() for word in pair.partition("="))
        if key not in known:
            raise BadInputError(f"lens {text!r}: no key {key!r}; expected of {', '.join(known)}, as key=value")
        try:
            found[key] = float(value)
        except ValueError:
            raise BadInputError(f"lens {text!r}: {key}={value}; expected a number") from None
        positive = key in ("fx", "fy", "width", "height")
        if not np.isfinite(found[key]) or (positive and found[key] < 1.0):
            raise BadInputError(
                f"lens {text!r}: {key}={value}; expected a {'number of at least 1' * positive or 'finite number'}"
            )
    return found
