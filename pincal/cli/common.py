"""Groups of options that several verbs share."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from pincal.cli.arguments import NumberType, Output, argument, group, option, pair
from pincal.cli.quantities import (
    ANGLE,
    COLUMNS,
    LENGTH,
    LENGTH_UNITS,
    NoiseType,
    QuantityType,
    beside,
    columns,
    resting,
    station_links,
    xacro_argument,
)
from pincal.cli.streams import MOTION, Streams
from pincal.errors import BadInputError, warn
from pincal.measure.table_schema import TABLE_ENDINGS, TableOptions
from pincal.robot.cell import Beside
from pincal.units import GRAVITIES, is_gravity, is_of_earth

if TYPE_CHECKING:
    from pincal.identify.options import Options

Triple = tuple[float, float, float]

verbose_option = partial(option, "Print all tables and notes, not just the summary.", False)
max_error_option = partial(
    option, "Fail (exit code 5) if the mean error exceeds this.", type=LENGTH
)
tip_option = partial(option, "Last link of the arm.", metavar="LINK", in_cell=True)
from_option = partial(
    option,
    "Link in whose frame the target is measured, such as the other hand, or the one with a camera.",
    metavar="LINK",
    name="--from",
    words="the base",
)
to_option = partial(
    option, "Link that carries the target; the same as --tip.", metavar="LINK", words="--tip"
)
base_option = partial(
    option, "First link of the arm.", metavar="LINK", words="root of the URDF", in_cell=True
)
_ROBOT = "URDF or xacro file, or the name of a robot that comes with example-robot-data"
robot_argument = partial(argument, "ROBOT.urdf", f"{_ROBOT}.", in_cell=True)
xacro_option = partial(
    option,
    "Argument of a xacro file.",
    (),
    metavar="NAME:=VALUE",
    name="--xacro-arg",
    in_cell=True,
    type=xacro_argument,
)


def _check_gravity(
    context: click.Context, parameter: click.Parameter, given: Triple | None
) -> Triple | None:
    if given is not None and not is_gravity(given):
        raise click.BadParameter(
            f"{' '.join(f'{number:g}' for number in given)}; expected {GRAVITIES}",
            context,
            parameter,
        )
    if given is not None and not is_of_earth(given):
        size = math.hypot(*given)
        loads = "no joint bears a load" if size == 0.0 else "loads are taken in proportion"
        warn(
            f"gravity {' '.join(f'{number:g}' for number in given)} is {size:.3g} m/s^2, which it "
            f"is nowhere on earth (9.76 to 9.84): {loads}; on earth, state it in m/s^2 in the "
            "robot's base frame, such as 0 0 -9.81"
        )
    return given


gravity_option = partial(
    option,
    "Gravity in the robot's base frame [m/s^2].",
    words="standard gravity along -z",
    callback=_check_gravity,
    in_cell=True,
)
mass_option = partial(
    option,
    "Total mass of the robot including its base [kg], from its data sheet: the masses of "
    "the links are then estimated.",
    metavar="KG",
    words="those of the URDF, if it has any",
    in_cell=True,
)
coupling_option = partial(
    option,
    "Coupled joint: its position is the reported one plus (+) or minus (-) that of "
    "another joint, or a fraction of it such "
    "as -1/3*joint_4.",
    (),
    metavar="joint_3=+joint_2",
    name="--coupling",
    in_cell=True,
)
sign_option = partial(
    option,
    "Joint whose sign is opposite to that of the URDF.",
    (),
    metavar="JOINT",
    name="--sign",
    in_cell=True,
)
beside_option = partial(
    option,
    "Further robot of the cell, and the pose of its root link in that of the first robot "
    "[m, rad]. Its links and "
    "joints are called NAME_... if two robots have the same names.",
    (),
    metavar="[NAME=]URDF[@X,Y,Z,ROLL,PITCH,YAW]",
    name="--beside",
    in_cell=True,
    type=beside,
)
model_argument = partial(
    argument, "MODEL.json", "Calibrated model, as written by calibrate or discover."
)
type_option = partial(
    option,
    "Prior knowledge of this type of robot, from fleet learn; few poses are then enough.",
    metavar="TYPE.json",
    in_cell=True,
)
noise_angle_option = partial(
    option,
    "Standard deviation of one orientation component of the new measurements.",
    type=ANGLE,
    words="that of the calibration; estimated from the rows if it had no orientations",
    in_cell=True,
)
station_option = partial(
    option,
    "Use the placement of instrument and targets of this station of the model.",
    metavar="NAME",
)


def _load_plugins(
    context: click.Context, parameter: click.Parameter, names: tuple[str, ...]
) -> tuple[str, ...]:
    """Load the modules that the user names, in this process."""
    if names:
        from pincal.plugins import load_plugin

        for name in names:
            load_plugin(name)
    return names


def tip_or_to(tip: str | None, to: str | None) -> str | None:
    """Return the last link of the arm, as either option gives it.

    Raises:
        UsageError: if they give different ones.
    """
    if tip and to and tip != to:
        raise click.UsageError(f"--tip {tip} and --to {to} are the same; leave one of them out")
    return tip or to


@dataclass(frozen=True, kw_only=True)
class GeneralOptions:
    """Options of every verb."""

    plugins: tuple[str, ...] = option(
        "Module or .py file that registers effects or sensors of your own.",
        (),
        metavar="MODULE",
        name="--plugin",
        is_eager=True,
        callback=_load_plugins,
    )
    as_json: bool = option("Print the result as JSON.", False, name="--json")
    quiet: bool = option("Print neither progress nor notes.", False)


TABLE = Output(*TABLE_ENDINGS)
"""A table to write."""


@dataclass(frozen=True, kw_only=True)
class TableArguments:
    """How tables are to be read."""

    columns: dict[str, str] | None = option(
        "Assign columns to quantities.",
        type=columns,
        metavar=COLUMNS,
        words="by the names of the columns",
    )
    orientation: Literal["kuka", "fanuc", "abb", "ur", "rpy", "xyzw", "wxyz", "none"] | None = (
        option(
            "Convention of the orientation: A B C, W P R, q1..q4, rx ry rz, roll pitch yaw, "
            "or a quaternion in this order; none leaves orientations out.",
            words="from the names of its columns",
        )
    )
    joints: Path | None = option(
        "Log of the joint positions, if the table lacks them: joined by a common column, "
        "by time while the arm stands "
        "still, or by order.",
        metavar="LOG",
    )
    ignore: tuple[str, ...] = option("Ignore this column of the table.", (), metavar="COLUMN")
    sheet: str | None = option(
        "Worksheet of an Excel workbook.",
        metavar="NAME",
        words="the first that has columns of joints",
    )
    rows_in_order: bool = option(
        "Rows are in the order of measurement, or their times give it: the approach "
        "direction of a joint without a column "
        "approach_<joint> follows from the previous row.",
        False,
    )

    @property
    def options(self) -> TableOptions:
        """The options for the library."""
        return TableOptions(**vars(self) | {"columns": self.columns or {}})


@dataclass(frozen=True, kw_only=True)
class LinkOptions:
    """Links of the instrument and of the target, if not base and tip."""

    start: str | None = option(
        "Link that carries the instrument, such as the one with a camera.",
        metavar="LINK",
        name="--from",
        words="the base; or the column from",
        in_cell=True,
    )
    to: str | None = to_option(words="the column to")
    stations: tuple[tuple[str, str, str], ...] = option(
        "Links between which the rows of one station or table were measured.",
        (),
        metavar="NAME:FROM:TO",
        name="--station",
        type=station_links,
    )
    rest: tuple[tuple[str, float], ...] = option(
        "Position of a joint that stood still and has no column.",
        (),
        metavar="JOINT=POSITION",
        type=resting,
        words="zero",
        in_cell=True,
    )


@dataclass(frozen=True, kw_only=True)
class InputOptions:
    """A robot and tables of measurements."""

    robot: str = argument(
        "ROBOT.urdf", f"{_ROBOT}; may be left out where cell.toml names it.", in_cell=True
    )
    data: tuple[Path, ...] = argument(
        "DATA.csv...",
        "Measurements, one row per measured pose (CSV, Excel or Parquet). Each of several "
        "tables is a station, named after "
        "its file unless it has a column station. A folder with joints.csv, and imu.csv "
        "or tracker.csv or both, is a "
        "session of an arm in motion.",
        required=False,
    )
    tip: str | None = tip_option(words="from the joint columns")
    base: str | None = base_option(words="root of the URDF, or where the joints of the table begin")
    links: LinkOptions = group("Links")
    beside: tuple[Beside, ...] = beside_option(words="identified from the readings")
    xacro_args: tuple[tuple[str, str], ...] = xacro_option()
    mass: float | None = mass_option()
    payload: float | None = option(
        "Mass at the tip, in tables without a column payload.",
        metavar="KG",
        type=NumberType(0.0),
        words="none",
        in_cell=True,
    )
    couplings: tuple[str, ...] = coupling_option()
    signs: tuple[str, ...] = sign_option()
    table: TableArguments = group("Tables")
    motion: Streams = group(MOTION, is_handed_in=True)


@dataclass(frozen=True, kw_only=True)
class PlaceOptions:
    """Placement of instrument and target, if not that of the calibration."""

    placement: Path | None = option(
        "Locate instrument and target from these few measured rows.", metavar="FEW.csv"
    )
    station: str | None = station_option(words="the only one")
    start: str | None = option(
        "Link in whose frame poses are given, without an instrument.",
        metavar="LINK",
        name="--from",
        words="its base",
    )
    to: str | None = option(
        "Link whose poses are given, without a target; a link of any arm of the robot.",
        metavar="LINK",
    )


@dataclass(frozen=True, kw_only=True)
class ModelOptions:
    """The model and its loads."""

    model: Literal["geometric", "elastic"] = option(
        "Geometry alone, or with elasticity of joints and bearings.", "elastic"
    )
    moment_frame: Literal["auto", "paper", "before", "after"] = option(
        "Frame convention for gravity torque and compliance: both before or both after "
        "the joint motion; "
        "paper: torque before, compliance after; auto: the one that fits best.",
        "auto",
    )
    payload_com: Triple = option(
        "Centre of mass of the payload in the tip frame [m].", (0.0, 0.0, 0.0), in_cell=True
    )
    gravity: Triple | None = gravity_option()

    def options(self, noise: float | None, noise_angle: float | None) -> Options:
        """Return the options for the library, with the noise of readings [m, rad]."""
        from pincal.identify.options import Options
        from pincal.model.effects import ELASTIC, GEOMETRIC

        return Options(
            effects={"geometric": GEOMETRIC, "elastic": ELASTIC}[self.model],
            sigma=noise,
            sigma_orientation=noise_angle,
            moment_frame=self.moment_frame,
            gravity=self.gravity,
            payload_centre=self.payload_com,
        )


@dataclass(frozen=True, kw_only=True)
class SetupOptions:
    """The noise of the instrument, and known parts of the measurement setup."""

    noise: tuple[float, str] | None = option(
        "Standard deviation of one position or image coordinate; it decides the verdict.",
        type=NoiseType(),
        metavar="0.05mm|0.1px",
        words="estimated",
        in_cell=True,
    )
    noise_angle: float | None = option(
        "Standard deviation of one orientation component.",
        type=ANGLE,
        words="estimated",
        in_cell=True,
    )
    instrument: str | None = option(
        "Noise of positions by range and direction: an instrument (leica_at500, "
        "leica_at960), or its maximum permissible "
        "errors along and across the line of sight (10um+0.3um/m,15um+6um/m), half of "
        "which is the standard deviation. "
        "Positions are in the instrument's own frame.",
        metavar="NAME|MPE",
        words="the same everywhere",
        in_cell=True,
    )
    tool: Triple | None = option(
        "Target position in the tip frame [m], if known.", words="identified", in_cell=True
    )
    anchor: Triple | None = option(
        "Distances: the instrument's fixed point in the robot's base frame [m], if known.",
        words="identified",
        in_cell=True,
    )
    points: Path | None = option(
        "Known positions of sockets, anchors or points of a calibration object: columns "
        "point, x, y, z.",
        in_cell=True,
    )
    points_in: Literal["own", "base"] = option(
        "Frame of --points: their own, to be identified, or the robot's base.",
        "own",
        in_cell=True,
    )
    gaps: tuple[tuple[str, str, float], ...] = option(
        "Known distance between two sockets, anchors or points; a number without a unit "
        "is in metres.",
        (),
        metavar="A B LENGTH",
        type=(str, str, QuantityType(LENGTH_UNITS, "50mm", bare=1.0)),
        name="--socket-distance",
        in_cell=True,
    )
    distances: Path | None = option(
        "Known distances as a table: columns first, second, distance and optionally sigma.",
        in_cell=True,
    )
    camera: Path | None = option(
        "Camera parameters: fx, fy, u0, v0 [px], k1, k2, p1, p2, k3, and T_tip_camera if "
        "the mount is known.",
        metavar="FILE.json",
        words="identified",
        in_cell=True,
    )
    fit_camera: bool = option("Refine the parameters given by --camera.", False)


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """How the model is fitted."""

    add: tuple[str, ...] = option(
        "Also fit this effect: NAME, NAME:JOINT or NAME:JOINT:KEY=VALUE, e.g. "
        "gear_eccentricity:joint_2:order=2.",
        (),
        metavar="EFFECT",
    )
    fix: tuple[str, ...] = option(
        "Hold this parameter at nominal: a name such as joint_2.s_x, or a pattern such as '*.s_x'.",
        (),
        metavar="NAME",
    )
    free: tuple[str, ...] = option(
        "Fit this parameter, or all that match a pattern, without a prior.", (), metavar="NAME"
    )
    prior: tuple[str, ...] = option(
        "Expected standard deviation from nominal of this parameter, or of all that match "
        "a pattern: '*.theta=2mrad', "
        "'joint_3.k_drive=0.2urad/Nm'.",
        (),
        metavar="NAME=SIZE",
    )
    equilibrium: bool = option(
        "Compute moments in the deflected configuration, not the undeflected one.", False
    )
    stages: Literal["joint", "paper"] = option(
        "Fit all parameters jointly, or in the paper's four stages.", "joint"
    )
    loss: Literal["screen", "huber", "none"] = option(
        "Outlier handling: reject, down-weight (Huber), or none.", "screen"
    )
    zeros: str | None = option(
        "Joints whose zeros are completely unknown: unknown for all, or unknown:joint_3,joint_5.",
        metavar="unknown[:JOINT,...]",
        words="within a few mrad of the URDF's, unless the data show otherwise",
    )
    length_bound: float = option(
        "Largest allowed deviation of a length from nominal.", 0.01, type=LENGTH, words="10mm"
    )
    type: Path | None = type_option()

    @property
    def priors(self) -> dict[str, float | str]:
        """Priors by name or pattern: given sizes, then free parameters, then fixed ones.

        Raises:
            click.UsageError: for one without a size.
        """
        sizes: dict[str, float | str] = dict(
            pair(text, "NAME=SIZE, such as '*.theta=2mrad'") for text in self.prior
        )
        return sizes | dict.fromkeys(self.free, float("inf")) | dict.fromkeys(self.fix, 0.0)

    @property
    def unknown_zeros(self) -> tuple[str, ...]:
        """The joints whose zeros are unknown, by names or patterns.

        Raises:
            BadInputError: for other words than "unknown" and joints.
        """
        word, _, names = ("unknown", "", "-") if self.zeros is None else self.zeros.partition(":")
        if word.strip() != "unknown":
            raise BadInputError(f"--zeros {self.zeros}; expected unknown, or unknown:JOINT,JOINT")
        found = tuple(filter(None, (name.strip() for name in names.split(","))))
        return () if self.zeros is None else found or ("*",)


@dataclass(frozen=True, kw_only=True)
class CalibrationOptions:
    """All options of a fit to a table of measurements."""

    model: ModelOptions = group("Model")
    setup: SetupOptions = group("Measurement setup")
    fit: FitOptions = group("Fit")


@dataclass(frozen=True, kw_only=True)
class SplitOptions:
    """How the error at poses that were not fitted is found."""

    test_fraction: float = option(
        "Fraction of the poses to hold out for good; by default all are fitted, and each "
        "is predicted by a fit without it.",
        0.0,
    )
    split: Literal["both", "random", "blocked", "station"] = option(
        "Predict each pose without its region of joint space, and without its stretch of "
        "consecutive rows, and report the "
        "worse of the two first; or without poses at random, or its region alone "
        "(blocked); or predict each station by the "
        "others.",
        "both",
    )
    holdout: Path | None = option("Validate on this table instead; all rows of DATA are fitted.")
    seed: int = option("Random seed of this division.", 0)
