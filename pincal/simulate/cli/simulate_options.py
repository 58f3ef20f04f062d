"""Arguments of ``pincal simulate``: the machine, the sensor, and the campaign in which it is
measured.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click
import numpy as np

from pincal.cli.arguments import NumberType, Output, group, option
from pincal.cli.common import (
    GeneralOptions,
    Triple,
    base_option,
    beside_option,
    from_option,
    gravity_option,
    robot_argument,
    tip_option,
    tip_or_to,
    to_option,
    xacro_option,
)
from pincal.cli.quantities import ANGLES, LENGTH, NoiseType, QuantityType, masses
from pincal.errors import BadInputError, MeasurementError, OutputError
from pincal.measure.table_schema import TABLE_ENDINGS
from pincal.robot.cell import Beside
from pincal.simulate.cli.part_options import VIEWS, PartArguments
from pincal.simulate.cli.path_options import MotionArguments
from pincal.thresholds import Count, Scale
from pincal.units import plain_numbers

if TYPE_CHECKING:
    from pincal.robot.robot import Robot
    from pincal.simulate.moving import ViaPath
    from pincal.simulate.request import SetupOptions
    from pincal.simulate.session import SessionOptions


_BESIDE = ("position", "pose", "distance")
_CAMERAS = ("camera_point", "camera_pixel")
_PIXELS = ("camera_pixel", "fixed_camera_pixel")
# Options of some sensors only, and the sensor that some of them imply.
_GOES_WITH = {
    "sockets": ("socket",),
    "socket_spacing": ("socket",),
    "anchors": ("distance",),
    "ball_bar": ("distance",),
    "object": _CAMERAS,
    "lens": (*_CAMERAS, "fixed_camera_pixel"),
    "camera_out": _PIXELS,
    "targets": (*_BESIDE, "fixed_camera_pixel"),
    "instrument": (*_BESIDE, "socket"),
    "noise_angle": ("pose",),
}
_IMPLIED = {"sockets": "socket", "anchors": "distance", "ball_bar": "distance"}
_NOISE = {"m": 5e-5, "px": 0.1}
_NOISE_ANGLE: Scale = 1e-4
# Ten million poses take an hour and 4 GB (100 000: 39 s and 33 MB more than 1000, on one core).
_MOST_POSES: Count = 10_000_000
# Images of the paper's object: three blocks on each of two sides, two joint configurations each.
_PAPER_POSES: Count = 12


class _LensType(click.ParamType[dict[str, float]]):
    """Intrinsics of a camera, such as ``fx=1200,k1=-0.1``."""

    name = "lens"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> dict[str, float]:
        """Return values by name; a key or value that is invalid is bad input, which a plain
        function's would not be.
        """
        from pincal.simulate.lens import Lens

        known = tuple(Lens().intrinsics)
        found = dict[str, float]()
        for pair in str(value).split(","):
            key, _, word = (part.strip() for part in pair.partition("="))
            if key not in known:
                raise BadInputError(
                    f"lens {value!r}: no key {key!r}; expected one of {', '.join(known)}, "
                    "as key=value"
                )
            least = 1.0 if key in ("fx", "fy", "width", "height") else -math.inf
            (found[key],) = plain_numbers([word]) or [math.nan]
            if not math.isfinite(found[key]) or found[key] < least:
                wanted = "finite number" if least < 1.0 else "number of at least 1"
                raise BadInputError(f"lens {value!r}: {key}={word}; expected a {wanted}")
        return found


_SCALE = NumberType(0.0)
_COUNT = click.IntRange(1, 100)
_Recorded = Literal["temperature", "time", "approach"]


@dataclass(frozen=True, kw_only=True)
class MachineArguments:
    """The simulated machine."""

    tip: str | None = tip_option(words="flange or tool at the end of the longest chain")
    base: str | None = base_option()
    start: str | None = from_option()
    to: str | None = to_option()
    also: tuple[str, ...] = option(
        "Further link whose joints belong to the machine; the same set of links and seed "
        "gives the same machine.",
        (),
        metavar="LINK",
    )
    beside: tuple[Beside, ...] = beside_option()
    xacro_args: tuple[tuple[str, str], ...] = xacro_option()
    errors: float = option(
        "Size of the geometric errors: 1 is typical, 0 none.", 1.0, metavar="SCALE", type=_SCALE
    )
    type: Path | None = option(
        "Draw the geometry by --seed from this type of robots, as written by fleet learn.",
        metavar="TYPE.json",
    )
    elastic: float = option(
        "Compliance of drives and bearings: 1 is typical, 0 rigid. Masses that the URDF "
        "lacks are drawn.",
        1.0,
        metavar="SCALE",
        type=_SCALE,
    )
    moment_frame: Literal["paper", "before", "after"] = option(
        "Frame convention of the bearings' compliance, in the URDF's own joint frames; "
        "discover identifies it.",
        "after",
    )
    masses_off: float = option(
        "Error of the URDF's masses and centres of mass (standard deviation).",
        0.0,
        metavar="PERCENT",
        type=NumberType(0.0, 30.0),
    )
    gravity: Triple | None = gravity_option()
    effects: tuple[str, ...] = option(
        "Hidden effect; see below.", (), metavar="NAME[:JOINT][:KEY=VALUE,...]", name="--effect"
    )

    @property
    def end(self) -> str | None:
        """The link that is measured, as either option gives it; None for the default."""
        return tip_or_to(self.tip, self.to)


@dataclass(frozen=True, kw_only=True)
class CampaignArguments:
    """The poses, and the conditions of their measurement."""

    poses: int | None = option(
        "Number of random poses.", metavar="N", type=click.IntRange(1, _MOST_POSES)
    )
    at: Path | None = option(
        "Take joint positions (and payload, temperature, ...) from this table instead."
    )
    cycles: int = option(
        "Number of measurements of each pose, in rounds; ISO 9283 requires 30.",
        1,
        metavar="N",
        type=click.IntRange(1, 1000),
    )
    floor: float = option(
        "Height in the base frame above which random poses keep the arm [m].", 0.0, metavar="Z"
    )
    no_floor: bool = option("Random poses anywhere within the joint limits.", False)
    payload: Sequence[float] | None = option(
        "One payload or several.", metavar="KG[,KG...]", type=masses
    )
    payload_order: Literal["blocks", "alternating"] = option(
        "Several payloads: one block of poses after the other, or in turn.", "blocks"
    )
    payload_com: Triple = option(
        "Centre of mass of the payload in the tip frame [m].", (0.0, 0.0, 0.0)
    )
    recorded: tuple[_Recorded, ...] = option(
        "Record this column even if no effect needs it.", (), name="--with"
    )
    hide: tuple[Literal["temperature", "time", "approach", "payload", "read"], ...] = option(
        "Omit this column; the condition still has its effect.", ()
    )
    seed: int = option("Random seed of the machine, the set-up and everything else.", 0)
    pose_seed: int | None = option(
        "Random seed of poses, conditions and noise.", words="the value of --seed"
    )
    setup_seed: int | None = option(
        "Random seed of the set-up: a different one moves instrument and target but "
        "leaves the machine unchanged.",
        words="the value of --seed",
    )


@dataclass(frozen=True, kw_only=True)
class SensorArguments:
    """The sensor that measures the machine."""

    sensor: str | None = option(
        "Kind of measurement: position, pose, distance, socket, camera_point, "
        "camera_pixel or fixed_camera_pixel.",
        metavar="KIND",
        words="position, or what --sockets, --anchors or --ball-bar imply",
    )
    noise: tuple[float, str] | None = option(
        "Standard deviation of a coordinate, a distance, the point in its socket, or "
        "image coordinates; 0mm: exact.",
        metavar="LEVEL",
        type=NoiseType(zero=True),
        words="0.05mm, 0.1px",
    )
    noise_angle: float | None = option(
        "Standard deviation of one orientation component (pose).",
        metavar="LEVEL",
        type=QuantityType(ANGLES, "0.1mrad", zero=True),
        words="0.1mrad",
    )
    targets: int | None = option(
        "Number of targets on the tool, each measured in every pose.",
        metavar="K",
        type=click.IntRange(1, 20),
        words="1",
    )
    tool: Triple | None = option(
        "Target, tool point or camera position in the tip frame [m].", words="random"
    )
    instrument: Literal["drawn", "base"] | None = option(
        "Pose of the instrument: random, or the robot's base frame.", words="drawn"
    )
    sockets: int | None = option(
        "Number of sockets for the tool point; the poses are divided among them.",
        metavar="K",
        type=_COUNT,
        words="4",
    )
    socket_spacing: float | None = option(
        "Distance between the two sockets of a pair.", metavar="LENGTH", type=LENGTH, words="50mm"
    )
    anchors: int | None = option(
        "Number of fixed points from which distances are measured.",
        metavar="K",
        type=_COUNT,
        words="one without a name",
    )
    ball_bar: float | None = option(
        "Length of a bar that holds the tool point on a sphere about each anchor; the "
        "poses are divided among them.",
        metavar="LENGTH",
        type=LENGTH,
    )
    object: Literal["paper", "grid"] | None = option(
        "Calibration object: two sides with three fields of 25 points each (the poses, 12 "
        "by default, are divided among "
        "them), or a plane grid of 63 points.",
        words="paper",
    )
    lens: dict[str, float] | None = option(
        "Camera parameters: fx, fy, u0, v0 [px], k1, k2, k3, p1, p2, width, height [px].",
        metavar="KEY=VALUE,...",
        type=_LensType(),
        words="random",
    )
    points_out: Path | None = option(
        "Write the named points: sockets and anchors in the instrument's frame, an "
        "object's points in its own."
    )
    camera_out: Path | None = option(
        "Write the camera (camera_pixel, fixed_camera_pixel).", metavar="FILE.json"
    )


@dataclass(frozen=True, kw_only=True)
class SimulateArguments:
    """Arguments of simulate."""

    robot: str = robot_argument()
    out: Path = option(
        "Table to write; with --path, a folder.", MISSING, type=Output(*TABLE_ENDINGS, "")
    )
    truth: Path | None = option(
        "Write the true errors, effects, noise and seeds.", metavar="FILE.json"
    )
    campaign: CampaignArguments = group("Poses and conditions")
    sensor: SensorArguments = group("Sensor")
    motion: MotionArguments = group("Motion")
    part: PartArguments = group("Part")
    machine: MachineArguments = group("Machine")
    general: GeneralOptions = group("General")

    @property
    def pose_seed(self) -> int:
        """Seed of poses, conditions and noise."""
        return self.campaign.seed if self.campaign.pose_seed is None else self.campaign.pose_seed

    @property
    def setup_seed(self) -> int:
        """Seed of the poses of instrument and target."""
        return self.campaign.seed if self.campaign.setup_seed is None else self.campaign.setup_seed

    @property
    def floor(self) -> float | None:
        """Height of the floor [m]; None for no floor."""
        return None if self.campaign.no_floor else self.campaign.floor

    @property
    def kind(self) -> str:
        """The sensor, given or implied by another option."""
        implied = (
            kind for name, kind in _IMPLIED.items() if getattr(self.sensor, name) is not None
        )
        default = "position" if self.part.features is None else "camera_point"
        return self.sensor.sensor or next(implied, default)

    @property
    def n_poses(self) -> int | None:
        """Number of poses, with a part of each feature; None if they are those of a table."""
        if self.part.features is not None:
            return self.campaign.poses or VIEWS
        if self.campaign.poses is None and self.campaign.at is None and self.kind in _CAMERAS:
            return None if self.sensor.object == "grid" else _PAPER_POSES
        return self.campaign.poses

    def check(self) -> None:
        """Refuse options that do not go together.

        Raises:
            UsageError: If an option has nothing to do with the sensor, or not one source of poses
                is given.
            BadInputError: If the number of poses is invalid.
        """
        given = self.sensor
        kind = self.kind
        self._check_motion()
        self.part.check(kind, self._given_without_part())
        for name in sorted(name for name in _GOES_WITH if getattr(given, name) is not None):
            if kind not in _GOES_WITH[name]:
                flag = f"--{name.replace('_', '-')}"
                raise click.UsageError(
                    f"{flag} is for --sensor {' or '.join(_GOES_WITH[name])}, not for {kind}"
                )
        if given.ball_bar is not None and given.targets is not None:
            raise click.UsageError("--ball-bar holds one tool point; leave out --targets")
        if (
            given.points_out is not None
            and kind in (*_BESIDE, "fixed_camera_pixel")
            and not (given.anchors or given.ball_bar)
        ):
            raise click.UsageError(
                f"--points-out: --sensor {kind} has no named points; expected socket, a "
                "camera or --anchors"
            )
        if self.motion.path is None and (self.n_poses is None) == (self.campaign.at is None):
            raise click.UsageError("give either --poses N, --at FILE.csv or --path DURATION|FILE")

    def _given_without_part(self) -> dict[str, object]:
        """Return the options that a part takes the place of, with their values."""
        return {
            "--at": self.campaign.at,
            "--path": self.motion.path,
            "--object": self.sensor.object,
            "--points-out": self.sensor.points_out,
        }

    def _check_motion(self) -> None:
        """Refuse options of poses at rest for a path, and options of a path for poses at rest."""
        if self.motion.path is None:
            self._check_at_rest()
            return
        campaign = self.campaign
        if self.kind == "socket" or self.sensor.ball_bar is not None:
            raise click.UsageError(
                f"--path is logged by an IMU or a --sensor that reads in motion, not by {self.kind}"
            )
        held = {"--poses": campaign.poses, "--at": campaign.at}
        if wrong := [name for name, value in held.items() if value is not None] + ["--cycles"] * (
            campaign.cycles > 1
        ):
            raise click.UsageError(
                f"{wrong[0]} is for poses at rest; leave out {wrong[0]} or --path"
            )
        if campaign.payload is not None and len(campaign.payload) > 1:
            raise click.UsageError("--payload: a path has one payload; give one")
        if self.out.suffix:
            raise OutputError(
                f"--out {self.out}: with --path a folder is written; give the name of a folder"
            )

    def _check_at_rest(self) -> None:
        """Refuse options of a path, and a folder instead of a table."""
        if name := self.motion.first_given():
            raise click.UsageError(
                f"--{name.replace('_', '-')} is for an arm in motion; add --path DURATION|FILE"
            )
        if self.out.suffix.lower() not in TABLE_ENDINGS:
            raise OutputError(
                f"--out {self.out}: a table can't be written as a file without an "
                "extension; end the name in "
                f"{' or '.join(TABLE_ENDINGS)}"
            )

    def session_options(self, duration: float) -> SessionOptions:
        """Return the options of the logs of a path of this duration [s]."""
        payload = self.campaign.payload
        wanted = self.motion.session_options(duration)
        load = {"payload": payload[0] if payload else 0.0, "payload_com": self.campaign.payload_com}
        return replace(wanted, min_height=self.floor, **load)  # type: ignore[arg-type]

    def setup_options(self) -> SetupOptions:
        """Return the options of the set-up.

        Raises:
            UsageError: if the noise is not in the sensor's unit.
        """
        from pincal.simulate.request import SetupOptions

        given = {
            field.name: getattr(self.sensor, field.name, None) for field in fields(SetupOptions)
        }
        wanted = SetupOptions(
            sigma=self._sigma(),
            noise_angle=_NOISE_ANGLE,
            min_height=self.floor,
            at_base=self.sensor.instrument == "base",
        )
        return replace(
            wanted, **{name: value for name, value in given.items() if value is not None}
        )

    def _sigma(self) -> float:
        """Return the noise in the unit of the sensor."""
        unit = "px" if self.kind in _PIXELS else "m"
        value, given = self.sensor.noise or (_NOISE[unit], unit)
        if value and given != unit:
            example = "0.1px" if unit == "px" else "0.05mm"
            raise click.UsageError(
                f"--noise: {self.kind} is measured in {unit}; expected a value such as {example}"
            )
        return value


def via_path(robot: Robot, names: Sequence[str], path: Path) -> ViaPath:
    """Return the path through the poses of a table at its times, with joints in the order of
    ``names``.

    Raises:
        MeasurementError: for a table without times that increase from 0.
    """
    from pincal.cli.inputs import load_table
    from pincal.simulate.moving import ViaPath

    table = load_table(robot, path, joints_only=True)
    if (
        table.time is None
        or len(table) < 2
        or table.time[0] != 0.0
        or np.any(np.diff(table.time) <= 0.0)
    ):
        raise MeasurementError(
            f"{path.name}: expected a column time that increases from 0, when each pose "
            "is reached [s]"
        )
    q = dict(zip(robot.joint_names, table.q.T, strict=True))
    return ViaPath(table.time, np.column_stack([q[name] for name in names]))
