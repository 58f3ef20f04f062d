"""``pincal design``: poses to be measured, or a motion to be driven, and what they can identify."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import MISSING, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click
import numpy as np

from pincal.cli.arguments import argument, group, option, verb
from pincal.cli.common import (
    TABLE,
    GeneralOptions,
    ModelOptions,
    Triple,
    base_option,
    beside_option,
    coupling_option,
    from_option,
    sign_option,
    tip_option,
    tip_or_to,
    to_option,
    type_option,
    xacro_option,
)
from pincal.cli.outputs import print_json, robot_notes_in_result
from pincal.cli.quantities import ANGLE, DURATION, LENGTH, masses
from pincal.design.cli.acceptance_planning import (
    AcceptancePlanOptions,
    OutputWanted,
    write_acceptance_plan,
)
from pincal.errors import Exit
from pincal.robot.cell import Beside

if TYPE_CHECKING:
    from pincal.design.health import HealthCheck
    from pincal.design.motion_design import MotionDesign
    from pincal.design.pose_design import Design
    from pincal.design.reach import Limits, SensorSetup
    from pincal.design.request import DesignRequest
    from pincal.identify.options import Options
    from pincal.robot.robot import Robot

_EXAMPLES = """
Examples:
  pincal design robot.urdf --poses 40 --instrument 3.5 -1 1.2 --payload 80 --out poses.csv
  pincal design robot.urdf --accuracy 0.05mm --noise 0.03mm --out poses.csv     \
# how many poses do I need?
  pincal design robot.urdf --poses 20 --measured tracker.csv --out more.csv     \
# which poses to add?
  pincal design robot.urdf --poses 40 --out poses.csv \\
      --tell-apart gear_eccentricity:joint_2 gravity_compensator:joint_2
  pincal design robot.urdf --motion 300s --out motion.csv                       \
# what to drive with an IMU?
  pincal design robot.urdf --acceptance 300mm,800mm --out test.csv              \
# where to put calibrated lengths?
  pincal design results/model.json --check --notice 0.2mm --out check.csv       # has it changed?
  pincal design results/model.json --check --notice 0.5mm --out check.csv \\
      --socket 0.7 0.3 0.2 --socket 0.5 -0.4 0.4                                \
# the same with two sockets
To practise:
  pincal simulate robot.urdf --at poses.csv --out tracker.csv

An effect is NAME[:JOINT][:KEY=VALUE,...], as in discover. Neither the paths from pose to pose nor
obstacles around the robot are considered: check them before the robot moves.
"""
_COUNT = click.IntRange(min=1)
# Options of poses and of an instrument, on which a motion with an IMU does not depend.
_OF_POSES = (
    "poses",
    "accuracy",
    "task",
    "measured",
    "type",
    "tell_apart",
    "candidates",
    "start",
)
_OF_RIG = ("sensor", "sockets", "tool", "payload")


@dataclass(frozen=True, kw_only=True)
class ConstraintOptions:
    """Constraints on arm, target and instrument."""

    instrument: Triple | None = option(
        "Position in the robot's base frame [m]; the target must be visible from there.",
        words="no constraint",
    )
    normal: Triple | None = option(
        "Direction in which the target faces, in the tip frame.", words="visible from all sides"
    )
    cone: float = option(
        "Largest angle from the target's normal at which it is visible.",
        float(np.deg2rad(30.0)),
        type=ANGLE,
        metavar="ANGLE",
        words="30deg",
    )
    box: tuple[float, float, float, float, float, float] | None = option(
        "Smallest, then largest coordinates of the target in the base frame [m].",
        metavar="X Y Z X Y Z",
    )
    floor: float | None = option(
        "Height in the base frame above which arm and target are kept [m].",
        metavar="Z",
        words="0 for an upright robot",
    )
    no_floor: bool = option("No floor.", False)
    clearance: float = option(
        "Smallest distance between parts of the arm, if the URDF has collision geometry.",
        0.01,
        type=LENGTH,
        metavar="LENGTH",
        words="10mm",
    )
    span: float = option("Fraction of the joint ranges that is used.", 0.95)


@dataclass(frozen=True, kw_only=True)
class InstrumentOptions:
    """Kind and noise of the measurement."""

    sensor: Literal["position", "pose", "distance", "socket"] | None = option(
        "Kind of measurement.",
        words="position; socket with --socket, and with --check of a model calibrated by sockets",
    )
    sockets: tuple[Triple, ...] = option(
        "Approximate position of a socket for the tool point, in the robot's base frame "
        "or that of --from [m].",
        (),
        metavar="X Y Z",
        name="--socket",
    )
    tool: Triple | None = option(
        "Approximate target position in the tip frame [m].",
        words="slightly off the last axis",
        in_cell=True,
    )
    noise: float = option(
        "Standard deviation of one position coordinate, or of a distance.",
        5e-05,
        type=LENGTH,
        words="0.05mm",
        in_cell=True,
    )
    noise_angle: float = option(
        "Standard deviation of one orientation component.",
        0.0001,
        type=ANGLE,
        words="0.1mrad",
        in_cell=True,
    )
    payload: Sequence[float] | None = option(
        "Payload, or several from which the best is chosen for each pose.",
        metavar="KG[,KG...]",
        type=masses,
        in_cell=True,
    )


@dataclass(frozen=True, kw_only=True)
class CheckOptions:
    """Requirements of a health check."""

    check: bool = option("Choose the fewest poses for a health check by pincal diagnose.", False)
    notice: float = option(
        "Motion of any point within reach that must be detected.", 1e-4, type=LENGTH, words="0.1mm"
    )
    power: float = option("Probability of detecting it.", 0.95)
    alpha: float = option("Probability of a false alarm.", 0.01)
    max_poses: int = option("Largest number of poses.", 40, metavar="N", type=_COUNT)


@dataclass(frozen=True, kw_only=True)
class DrivenOptions:
    """A motion to drive with an IMU."""

    motion: float | None = option(
        "Instead of poses, choose a motion of this duration to drive with an IMU on the "
        "tool; --out gives the time at which "
        "each of its poses is reached.",
        metavar="DURATION",
        type=DURATION,
    )
    speed: float = option(
        "Largest speed of a joint [rad/s], half as much for a prismatic one [m/s]; less "
        "if the URDF says so.",
        1.0,
    )
    acceleration: float = option(
        "Largest acceleration of a joint [rad/s^2], half as much for a prismatic one [m/s^2].", 3.0
    )


@dataclass(frozen=True, kw_only=True)
class DesignArguments:
    """Arguments of design."""

    robot: str = argument(
        "ROBOT",
        "URDF or xacro file, or the name of a robot of example-robot-data; with --check "
        "also a model.json.",
        in_cell=True,
    )
    out: Path = option(
        "Table of poses to write, with empty columns for the readings.", MISSING, type=TABLE
    )
    poses: int | None = option("Number of poses to choose.", metavar="N", type=_COUNT)
    accuracy: float | None = option(
        "Instead of --poses: the fewest poses that reach this predicted error.", type=LENGTH
    )
    criterion: Literal["task", "determinant"] = option(
        "Smallest predicted error over the task, or smallest joint uncertainty of all parameters.",
        "task",
    )
    task: Path | None = option(
        "Joint positions where accuracy matters.", words="anywhere within reach"
    )
    measured: Path | None = option(
        "Poses that have been measured already; N poses are added to them."
    )
    type: Path | None = type_option()
    tell_apart: tuple[str, str] | None = option(
        "Choose poses that distinguish these two effects instead.", metavar="EFFECT EFFECT"
    )
    candidates: int | None = option(
        "Number of random poses to choose from.",
        metavar="N",
        type=click.IntRange(min=2),
        words="1500, or twice the poses",
    )
    seed: int = option("Random seed.", 0, type=click.IntRange(min=0))
    degrees: bool = option("Write joint positions in degrees.", False)
    tip: str | None = tip_option(words="flange or tool at the end of the longest chain")
    base: str | None = base_option()
    start: str | None = from_option()
    to: str | None = to_option()
    beside: tuple[Beside, ...] = beside_option()
    xacro_args: tuple[tuple[str, str], ...] = xacro_option()
    couplings: tuple[str, ...] = coupling_option()
    signs: tuple[str, ...] = sign_option()
    driven: DrivenOptions = group("Motion")
    health: CheckOptions = group("Health check")
    tested: AcceptancePlanOptions = group("Acceptance test")
    constraints: ConstraintOptions = group("Constraints")
    instrument: InstrumentOptions = group("Instrument")
    model: ModelOptions = group("Model")
    general: GeneralOptions = group("General")


@verb(
    DesignArguments,
    examples=_EXAMPLES,
    exits=(Exit.INACCURATE,),
    shown=(
        "out",
        "poses",
        "accuracy",
        "task",
        "measured",
        "check",
        "motion",
        "acceptance",
        "noise",
        "payload",
        "as_json",
    ),
)
def design(arguments: DesignArguments) -> Exit:
    """Choose the most informative poses to measure.

    All are reachable and visible; the command also predicts how many poses are needed.
    """
    if arguments.health.check:
        return _check(arguments)
    if arguments.tested.acceptance is not None:
        return _acceptance(arguments)
    if arguments.driven.motion is not None:
        return _motion(arguments, arguments.driven.motion)
    return _poses(arguments)


def _poses(arguments: DesignArguments) -> Exit:
    """Choose single poses, write them, and print what they are worth.

    Raises:
        click.UsageError: if their number does not follow from the arguments.
    """
    from pincal.design.pose_design import design_poses

    if arguments.poses is None and arguments.accuracy is None:
        raise click.UsageError(
            "give --poses N, --accuracy for as many as are needed, or --motion DURATION for an IMU"
        )
    with robot_notes_in_result():
        robot = _robot(arguments)
        found = design_poses(
            robot,
            _request(arguments, robot),
            _options(arguments, robot),
            rig=_rig(arguments),
            limits=_limits(robot, arguments),
        )
    _write(arguments, robot, found, sensor=found.rig.sensor)
    return Exit.DONE


def _request(arguments: DesignArguments, robot: Robot) -> DesignRequest:
    """Return what poses are wanted; joint positions of files are read for the robot."""
    from pincal.cli.inputs import load_table
    from pincal.design.request import DesignRequest

    task, measured = (
        None if path is None else load_table(robot, path, joints_only=True)
        for path in (arguments.task, arguments.measured)
    )
    return DesignRequest(
        poses=arguments.poses,
        accuracy=arguments.accuracy,
        criterion=arguments.criterion,
        tell_apart=arguments.tell_apart,
        task=task,
        measured=measured,
        payloads=arguments.instrument.payload,
        candidates=arguments.candidates,
        seed=arguments.seed,
    )


def _check(arguments: DesignArguments) -> Exit:
    from pincal.calibration.fitted_robot import FittedRobot, load_model
    from pincal.design.health import CheckRequest, calibrated_sockets, design_check
    from pincal.robot.robot import Robot

    wanted = arguments.health
    is_model = Path(arguments.robot).suffix == ".json"
    with robot_notes_in_result():
        known = load_model(arguments.robot).robot_model() if is_model else _robot(arguments)
    payloads = tuple(arguments.instrument.payload or ())
    given = {name: value for name, value in vars(wanted).items() if name != "check"}
    request = CheckRequest(
        **given, payloads=payloads, candidates=arguments.candidates, seed=arguments.seed
    )
    robot = known if isinstance(known, Robot) else known.model.chain.robot
    options = _options(arguments, robot)
    limits = _limits(robot, arguments)
    rig = _rig(arguments)
    instrument = arguments.instrument
    is_told = instrument.sensor or instrument.sockets or arguments.constraints.instrument
    if isinstance(known, FittedRobot) and not is_told:
        rig = calibrated_sockets(known) or rig
    found = design_check(known, request, options=options, rig=rig, limits=limits)
    _write(arguments, robot, found, sensor=found.sensor)
    return Exit.DONE if found.is_met else Exit.INACCURATE


def _acceptance(arguments: DesignArguments) -> Exit:
    from pincal.design.reach import Reach

    if arguments.poses is not None or arguments.accuracy is not None:
        raise click.UsageError("--acceptance chooses all poses; leave out --poses and --accuracy")
    robot = _robot(arguments)
    reach = Reach(robot, _rig(arguments), _limits(robot, arguments))
    wanted = OutputWanted(
        out=arguments.out,
        in_degrees=arguments.degrees,
        as_json=arguments.general.as_json,
    )
    return write_acceptance_plan(reach, arguments.tested, wanted, seed=arguments.seed)


def _motion(arguments: DesignArguments, duration: float) -> Exit:
    from pincal.design.motion_design import design_motion

    _refuse_of_poses(arguments)
    robot = _robot(arguments)
    driven = arguments.driven
    found = design_motion(
        robot,
        duration,
        _options(arguments, robot),
        speed=driven.speed,
        acceleration=driven.acceleration,
        limits=_limits(robot, arguments),
        seed=arguments.seed,
    )
    _write(arguments, robot, found, sensor=None)
    return Exit.DONE


def _refuse_of_poses(arguments: DesignArguments) -> None:
    """Refuse options on which a motion does not depend."""
    constraints = arguments.constraints
    given = {name: getattr(arguments, name) for name in _OF_POSES}
    given |= {name: getattr(arguments.instrument, name) for name in _OF_RIG}
    given |= {"instrument": constraints.instrument, "normal": constraints.normal}
    if other := next((name for name, value in given.items() if value not in (None, ())), None):
        flag = {"start": "from", "sockets": "socket"}.get(other, other.replace("_", "-"))
        raise click.UsageError(f"--{flag} is for poses at rest; leave out --{flag} or --motion")


def _write(
    arguments: DesignArguments,
    robot: Robot,
    found: Design | HealthCheck | MotionDesign,
    *,
    sensor: str | None,
) -> None:
    """Write the poses with empty columns for the readings; print the predicted accuracy."""
    from pincal.measure.table import write_table
    from pincal.sensors.registry import columns_of

    turns = {
        name
        for name, kind in zip(robot.joint_names, robot.joint_types, strict=True)
        if kind == "revolute"
    }
    in_degrees = turns if arguments.degrees else set()
    columns = found.columns().items()
    shown = {
        f"{n} [deg]" if n in in_degrees else n: np.rad2deg(c) if n in in_degrees else c
        for n, c in columns
    }
    write_table(arguments.out, shown, to_fill=columns_of(sensor) if sensor else ())
    if arguments.general.as_json:
        print_json(found.to_dict() | {"out": str(arguments.out)})
    else:
        from pincal.cli.progress import console
        from pincal.design.cli.plan_screen import print_plan

        print_plan(found, console())
        click.echo(
            f"written to {arguments.out}, "
            f"{'ordered for short motions' if sensor else 'in order of time'}"
        )


def _robot(arguments: DesignArguments) -> Robot:
    from pincal.cli.inputs import as_stated
    from pincal.robot.arm_of_tree import TreeRequest
    from pincal.robot.cell import read_cell
    from pincal.robot.robot import Robot

    tree = read_cell(arguments.robot, arguments.beside, xacro_args=dict(arguments.xacro_args))
    tip = tip_or_to(arguments.tip, arguments.to)
    robot = Robot.from_tree(tree, TreeRequest(tip, arguments.start, arguments.base))
    return as_stated(robot, signs=arguments.signs, couplings=arguments.couplings)


def _options(arguments: DesignArguments, robot: Robot) -> Options:
    options = arguments.model.options(arguments.instrument.noise, arguments.instrument.noise_angle)
    if arguments.type is None:
        return options
    from pincal.cli.robot_priors import load_prior

    return replace(options, earlier=load_prior(arguments.type).prior_of(robot, options.effects))


def _rig(arguments: DesignArguments) -> SensorSetup:
    from pincal.design.reach import SensorSetup

    instrument = arguments.instrument
    constraints = arguments.constraints
    return SensorSetup(
        sensor=instrument.sensor or ("socket" if instrument.sockets else "position"),
        tool=instrument.tool,
        held_at=instrument.sockets,
        instrument=constraints.instrument,
        normal=constraints.normal,
        cone=constraints.cone,
    )


def _limits(robot: Robot, arguments: DesignArguments) -> Limits:
    """Return the limits; an arm on a wall or a ceiling has no floor at its base."""
    from pincal.design.reach import Limits

    chosen = arguments.constraints
    if chosen.no_floor and chosen.floor is not None:
        raise click.UsageError("--floor and --no-floor exclude each other")
    gravity = np.array(arguments.model.gravity or robot.gravity)
    is_upright = gravity[2] < -0.9 * np.linalg.norm(gravity)
    floor = 0.0 if chosen.floor is None and is_upright and not chosen.no_floor else chosen.floor
    return Limits(span=chosen.span, floor=floor, box=chosen.box, clearance=chosen.clearance)
