"""``pincal simulate``: a table of measurements of a machine with chosen errors and effects."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_origin, get_type_hints

import click
import numpy as np

from pincal.cli.arguments import verb
from pincal.cli.cell_defaults import is_cell_beside, written_cell
from pincal.cli.cell_file import CELL_KEYS
from pincal.cli.outputs import print_json, provenance, write_all, write_plain
from pincal.errors import BadInputError, Exit, OutputError, counted, nearest_first
from pincal.robot.cell import read_cell, robot_files
from pincal.simulate.cli.part_options import looking_at, truth_of
from pincal.simulate.cli.simulate_options import (
    MachineArguments,
    SimulateArguments,
    via_path,
)
from pincal.thresholds import Count

if TYPE_CHECKING:
    from pincal.robot.robot import Robot
    from pincal.simulate.effect import HiddenEffect
    from pincal.simulate.machine import TrueMachine
    from pincal.simulate.request import SetupOptions
    from pincal.simulate.session import MovingSession
    from pincal.simulate.setup import Campaign, SensorSetup
    from pincal.simulate.true_part import TrueFeature

_Files = dict[str, tuple[Path | None, Callable[[Path], None]]]
# Number of poses of a path at which the sizes of effects are evaluated for the truth.
_LOOKED_AT: Count = 500
_EXAMPLES = """Examples:
  pincal simulate robot.urdf --poses 300 --out tracker.csv
  pincal simulate robot.urdf --poses 300 --payload 0,80 --masses-off 3 \\
      --effect gear_eccentricity:joint_3:size=1e-4,order=1 --out tracker.csv --truth truth.json
  pincal simulate robot.urdf --poses 500 --pose-seed 1 --noise 0mm --out exact.csv   \
# the same machine
Other sensors:
  pincal simulate robot.urdf --sensor pose --noise-angle 0.05mrad --poses 200 --out poses.csv
  pincal simulate robot.urdf --sensor camera_point --points-out object.csv --out seen.csv   \
# as in the paper
  pincal simulate robot.urdf --sensor camera_pixel --object grid --poses 60 --noise 0.1px \\
      --points-out grid.csv --camera-out camera.json --out image.csv
  pincal simulate robot.urdf --sockets 6 --poses 240 --points-out sockets.csv --out contacts.csv
  pincal simulate robot.urdf --anchors 3 --poses 200 --points-out anchors.csv --out wires.csv
  pincal simulate robot.urdf --ball-bar 300mm --anchors 2 --poses 200 --out bar.csv
A part, for pincal measure:
  pincal simulate robot.urdf --features part.toml --cycles 2 --out readings.csv --truth part.json
In motion:
  pincal simulate robot.urdf --path 300s --imu --out monday   \
# joints.csv and imu.csv, each on its own clock
  pincal simulate robot.urdf --path 5min --imu --sensor position --effect joint_lag:joint_2 \
--out tuesday
Then:
  pincal check tracker.csv               # with the cell.toml that simulate writes beside it
"""


def effect_help() -> str:
    """Return the end of the help text: a line of keys and units for each effect, which are imported
    for this.
    """
    from pincal.simulate.effect import HIDDEN_EFFECTS, Scope

    lines = [
        "Effects, the joint on which they act, and their keys (default: a random joint "
        "and typical values):"
    ]
    for name, kind in HIDDEN_EFFECTS.items():
        keys = ", ".join([f"size [{kind.unit}]", *_keys(kind)[1:]])
        lines.append(f"  {name}{'' if kind.scope is Scope.ARM else ':JOINT'}: {keys}")
    return "\n".join(lines)


def _keys(kind: type[HiddenEffect]) -> list[str]:
    """Return the keys of an effect, size first."""
    return ["size", *(field.name for field in fields(kind) if field.name not in ("joint", "size"))]


@verb(
    SimulateArguments,
    examples=_EXAMPLES,
    shown=(
        "out",
        "truth",
        "poses",
        "at",
        "payload",
        "seed",
        "pose_seed",
        "sensor",
        "noise",
        "path",
        "effects",
        "as_json",
    ),
    ending=effect_help,
    cell="written",
)
def simulate(arguments: SimulateArguments) -> Exit:
    """Simulate measurements of a machine with chosen errors."""
    from pincal.cli.progress import end_progress, log_step
    from pincal.measure.table import write_table

    arguments.check()
    robot = _robot(arguments)
    _check_path(robot, arguments)
    machine = _machine(robot, arguments)
    if arguments.motion.path is not None:
        return _drive(robot, machine, arguments)
    log_step("planning poses")
    features = _true_features(arguments)
    campaign = _campaign(robot, machine, arguments, features)
    log_step("measuring them")
    table = _measured(robot, machine, campaign, arguments, features)
    rows = len(table[machine.names[0]])
    seen = campaign.truth(machine, tip=robot.tip)
    found = _origin(robot, machine, arguments) | seen | truth_of(features, seen)
    out: _Files = {"--out": (arguments.out, lambda path: write_table(path, table))}
    truth = found | _made_by(robot, arguments)
    write_all(out | _further_files(arguments, campaign.setup, truth))
    end_progress()
    if arguments.general.as_json:
        print_json({"rows": rows, "columns": list(table), "out": str(arguments.out)} | found)
    else:
        click.echo(_summary(arguments, found, setup=campaign.setup, rows=rows))
    return Exit.DONE


def _measured(
    robot: Robot,
    machine: TrueMachine,
    campaign: Campaign,
    arguments: SimulateArguments,
    features: tuple[TrueFeature, ...],
) -> dict[str, np.ndarray]:
    """Return the columns of the table: the robot's own joints first, then what was read."""
    from pincal.simulate.request import Stream
    from pincal.simulate.true_part import readings_of_features

    # The same seed gives a calibration and readings of a part, whose noise is not the same.
    noise = Stream.READINGS if features else Stream.NOISE
    table = campaign.measure(machine, noise.generator(arguments.pose_seed))
    if features:
        first_pass = campaign.q[: len(campaign.q) // arguments.campaign.cycles, 0]
        named = [feature.name for feature in features]
        table = readings_of_features(table, machine.names[0], first_pass, named)
    table = {name: table[name] for name in (robot.joint_names[i] for i in robot.own_joints)} | table
    start = robot.path.start
    rows = len(table[machine.names[0]])
    if start != robot.base or robot.links:
        table |= {"from": np.repeat(start, rows), "to": np.repeat(robot.tip, rows)}
    return table


def _check_path(robot: Robot, arguments: SimulateArguments) -> None:
    """Refuse a path for readings that are simulated at rest."""
    if arguments.motion.path is not None and _is_from_hand(robot):
        raise click.UsageError(
            f"--path: readings from {robot.path.start} to {robot.tip}, which no joint moves, are "
            "simulated at rest; give --poses N"
        )


def _robot(arguments: SimulateArguments) -> Robot:
    """Return the arm, and others of the same URDF if the command line names their ends."""
    from pincal.robot.arm_of_tree import TreeRequest
    from pincal.robot.robot import Robot

    given = arguments.machine
    tree = read_cell(arguments.robot, given.beside, xacro_args=dict(given.xacro_args))
    wanted = TreeRequest(given.end, given.start, given.base)
    robot = Robot.from_tree(tree, wanted)
    if not given.also:
        return robot
    return Robot.from_tree(tree, replace(wanted, paths=[(robot.base, link) for link in given.also]))


def _drive(robot: Robot, machine: TrueMachine, arguments: SimulateArguments) -> Exit:
    """Write the logs of joints, IMU and tracker of a path driven by the machine."""
    from pincal.cli.progress import end_progress, log_step
    from pincal.simulate.request import Stream

    log_step("planning a path")
    session = _drawn_session(robot, machine, arguments)
    log_step("driving it")
    tables = session.measure(machine, Stream.NOISE.generator(arguments.pose_seed))
    seen = _seen_along(session)
    found = _origin(robot, machine, arguments) | seen.truth(machine, tip=robot.tip)
    found |= session.truth(machine.nominal)
    _make_folder(arguments.out)
    truth = found | _made_by(robot, arguments)
    write_all(_log_files(arguments.out, tables) | _further_files(arguments, seen.setup, truth))
    end_progress()
    rows = {name: len(table["time"]) for name, table in tables.items()}
    if arguments.general.as_json:
        print_json({"rows": rows, "out": str(arguments.out)} | found)
        return Exit.DONE
    written = f", the truth to {arguments.truth}" if arguments.truth else ""
    lines = [
        *_log_lines(robot, session, rows),
        *_hidden_lines(found),
        f"written to {arguments.out}{written}",
        *_next_words(arguments, None),
    ]
    click.echo("\n".join(lines))
    return Exit.DONE


def _log_files(folder: Path, tables: dict[str, dict[str, np.ndarray]]) -> _Files:
    """Return the files of the logs, by name."""
    from pincal.measure.table import write_table

    return {
        f"--out {name}": (
            folder / f"{name}.csv",
            lambda path, table=table: write_table(path, table),  # type: ignore[misc]
        )
        for name, table in tables.items()
    }


def _seen_along(session: MovingSession) -> Campaign:
    """Return poses along a path, at which the sizes of effects are evaluated for the truth."""
    from pincal.simulate.instrument import Instrument
    from pincal.simulate.moving import conditions_along
    from pincal.simulate.setup import Campaign

    time = np.linspace(0.0, session.duration, _LOOKED_AT)
    along = conditions_along(session.path, time, **session.conditions)
    return Campaign(
        q=session.path.at(time),
        conditions=along,  # type: ignore[arg-type]
        setup=session.tracker or Instrument(),
        hidden=(),
    )


def _drawn_session(
    robot: Robot, machine: TrueMachine, arguments: SimulateArguments
) -> MovingSession:
    """Draw the sensors and the path that the machine drives."""
    from pincal.simulate.request import Stream, draw_setup
    from pincal.simulate.session import draw_session

    rng = Stream.LAYOUT.generator(arguments.setup_seed)
    tracker = draw_setup(
        arguments.kind, machine.nominal, rng=rng, options=_setup_options(robot, arguments)
    )
    path = arguments.motion.path
    course = via_path(robot, machine.names, path) if isinstance(path, Path) else None
    duration = path if course is None else float(course.time[-1])
    return draw_session(
        machine.nominal,
        arguments.session_options(duration),  # type: ignore[arg-type]
        tracker=None if arguments.motion.imu and arguments.sensor.sensor is None else tracker,
        path=course or Stream.POSES.generator(arguments.pose_seed),
        setup=rng,
    )


def _make_folder(folder: Path) -> None:
    """Make the folder of the logs, if it is not there yet.

    Raises:
        OutputError: if it can't be made.
    """
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"{folder}: can't be created ({error.strerror}); choose another --out"
        ) from None


def _log_lines(robot: Robot, session: MovingSession, rows: dict[str, int]) -> list[str]:
    """Return the lines that say how long each log is and how far its clock is off."""
    logs = ", ".join(f"{count} rows of {name}" for name, count in rows.items())
    lines = [
        f"{session.duration:g} s of {robot.name} ({robot.base} to {robot.tip}) in motion: {logs}"
    ]
    for name, clock in session.clocks.items():
        if name in rows:
            lines.append(
                f"  the clock of the {name} is {clock.offset:+.3f} s off and drifts by "
                f"{1e6 * clock.drift:+.0f} ppm"
            )
    return lines


def _further_files(
    arguments: SimulateArguments, setup: SensorSetup, truth: dict[str, Any]
) -> _Files:
    """Return the files that are written in addition to the table or the logs."""
    from pincal.measure.table import write_table

    given = arguments.sensor
    named = setup.points
    points = {
        "point": np.array(list(named)),
        **dict(zip("xyz", np.array([*named.values()], float).T, strict=False)),
    }
    return {
        "--truth": (arguments.truth, lambda path: write_plain(path, contents=truth)),
        "--points-out": (given.points_out, lambda path: write_table(path, points)),
        "--camera-out": (
            given.camera_out,
            lambda path: write_plain(path, contents=truth["camera"]),
        ),
    }


def _origin(robot: Robot, machine: TrueMachine, arguments: SimulateArguments) -> dict[str, Any]:
    """Return robot, seeds, and the drawn masses of links without masses in the URDF, for JSON."""
    names = {"robot": robot.name, "base": robot.path.start, "tip": robot.tip}
    seeds = {
        "seed": arguments.campaign.seed,
        "pose_seed": arguments.pose_seed,
        "setup_seed": arguments.setup_seed,
    }
    weighed = zip(machine.names, machine.arm.masses.tolist(), strict=True)
    masses = {joint: mass for joint, mass in weighed if joint in robot.unweighed}
    return names | seeds | ({"drawn_masses_kg": masses} if masses else {})


def _made_by(robot: Robot, arguments: SimulateArguments) -> dict[str, Any]:
    """Return the command and its input files, for JSON."""
    return {"made_by": provenance(robot_files(robot.source, arguments.machine.beside))}


def _machine(robot: Robot, arguments: SimulateArguments) -> TrueMachine:
    from pincal.simulate.request import draw_machine

    given = arguments.machine
    urdf = (
        robot.urdf if given.type is None else _of_type(robot, given.type, arguments.campaign.seed)
    )
    made = _machine_between(robot, given, urdf)
    # Errors are in proportion to an arm, for a tree always the same one, whatever the links of the
    # readings are.
    start, tip = _arm_ends(robot)
    measured = made(tip=tip, start=start).nominal
    ends = {tip, *(tip for _, tip in robot.links)}
    machine = draw_machine(
        made(tip=min(ends)),
        seed=arguments.campaign.seed,
        errors=given.errors if given.type is None else 0.0,
        elastic=given.elastic,
        masses_off=given.masses_off,
        effects=[parse_effect(text, robot.joint_names) for text in given.effects],
        unweighed=robot.unweighed,
    )
    return replace(
        machine,
        nominal=replace(measured, masses=machine.nominal.masses, centres=machine.nominal.centres),
    )


def _is_from_hand(robot: Robot) -> bool:
    """Return whether readings are from a hand to a link that no joint moves, as by a camera."""
    return robot.path.tip_joint < 0 <= robot.path.start_joint


def _arm_ends(robot: Robot) -> tuple[str, str]:
    """Return the first and last link of the arm that moves between the ends of the readings."""
    ends = (robot.path.start, robot.path.tip)
    return ends[::-1] if _is_from_hand(robot) else ends


def _setup_options(robot: Robot, arguments: SimulateArguments) -> SetupOptions:
    return replace(arguments.setup_options(), on_hand=_is_from_hand(robot))


def _machine_between(
    robot: Robot, given: MachineArguments, urdf: bytes
) -> Callable[..., TrueMachine]:
    """Return a function of links, ``tip`` and ``start``, that returns the machine of a URDF with
    readings between these.
    """
    from pincal.robot.urdf_file import arm_text
    from pincal.simulate.machine import TrueMachine

    return partial(
        TrueMachine.from_urdf,
        arm_text(urdf, robot.joint_names, robot.source, loops=True),
        base=robot.base,
        joints=_in_one_order(robot),
        passive=robot.passive,
        moment_frame=given.moment_frame,
        gravity=given.gravity or tuple(robot.gravity.tolist()),
    )


def _of_type(robot: Robot, path: Path, seed: int) -> bytes:
    """Return the URDF of a machine whose geometry is drawn by a seed from a type."""
    from pincal.fleet.robot_type import load_type
    from pincal.io.urdf_export import calibrated_urdf
    from pincal.model.chain import Chain
    from pincal.model.effects import GEOMETRIC
    from pincal.model.model import Model
    from pincal.simulate.request import Stream

    of = load_type(path)
    model = Model(Chain.of(robot), GEOMETRIC)
    drawn = dict(zip(of.names, of.drawn(robot, Stream.ERRORS.generator(seed)), strict=True))
    return calibrated_urdf(model, np.array([drawn.get(name, 0.0) for name in model.names])).text


def _in_one_order(robot: Robot) -> tuple[str, ...]:
    """Return the joints, of a tree in an order independent of the path, so that a seed gives the
    same machine.
    """
    if not robot.links:
        return robot.joint_names
    depth = list[int]()
    for parent in robot.parents:
        depth.append(depth[parent] + 1 if parent >= 0 else 0)
    return tuple(name for _, name in sorted(zip(depth, robot.joint_names, strict=True)))


def _true_features(arguments: SimulateArguments) -> tuple[TrueFeature, ...]:
    """Return the true features of the part that is measured, none without one."""
    from pincal.simulate.request import Stream

    if arguments.part.features is None:
        return ()
    return arguments.part.drawn(Stream.PART.generator(arguments.pose_seed))


def _setup(
    robot: Robot,
    machine: TrueMachine,
    arguments: SimulateArguments,
    features: tuple[TrueFeature, ...],
) -> SensorSetup:
    """Return the sensor, and what it looks at."""
    from pincal.simulate.request import Stream, draw_setup
    from pincal.simulate.true_part import object_of_features

    options = _setup_options(robot, arguments)
    if features:
        options = looking_at(options, object_of_features(features))
    rng = Stream.LAYOUT.generator(arguments.setup_seed)
    return draw_setup(arguments.kind, machine.nominal, rng=rng, options=options)


def _campaign(
    robot: Robot,
    machine: TrueMachine,
    arguments: SimulateArguments,
    features: tuple[TrueFeature, ...],
) -> Campaign:
    from pincal.simulate.request import Repetition, Stream, poses_of_table, repeat_poses
    from pincal.simulate.setup import Campaign

    given = arguments.campaign
    conditions: dict[str, np.ndarray] = {}
    setup = _setup(robot, machine, arguments, features)
    if given.at is not None:
        from pincal.cli.inputs import load_table

        q, conditions = poses_of_table(load_table(robot, given.at, joints_only=True))
        order = [robot.joint_names.index(name) for name in machine.names]
        q = q[:, order]
        conditions = conditions | {k: v[:, order] for k, v in conditions.items() if v.ndim == 2}
    else:
        rng = Stream.POSES.generator(arguments.pose_seed)
        try:
            count = (arguments.n_poses or 1) * max(len(features), 1)
            q = setup.plan(machine.nominal, count, rng=rng, min_height=arguments.floor)
        except BadInputError as error:
            raise BadInputError(
                f"{error}; a lower --floor, or --no-floor, gives the arm more room, "
                "another --seed another set-up"
            ) from None
    wanted = Repetition(**{field.name: getattr(given, field.name) for field in fields(Repetition)})
    q, all_conditions = repeat_poses(machine, q, wanted, given=conditions, seed=arguments.pose_seed)
    return Campaign(q=q, conditions=all_conditions, setup=setup, hidden=given.hide)


def _summary(
    arguments: SimulateArguments, truth: dict[str, Any], *, setup: SensorSetup, rows: int
) -> str:
    """Return what was simulated and written, and the next command; ``truth`` is the contents of the
    truth file.
    """
    lines = [
        f"{_counts(rows, truth['poses'], arguments.campaign.cycles)} of {truth['robot']} "
        f"({truth['base']} to {truth['tip']}): {truth['sensor']}, noise {_noise(setup)}"
    ]
    if drawn := truth.get("drawn_masses_kg"):
        lines.append(
            f"  the URDF has no masses for {len(drawn)} links: {sum(drawn.values()):.3g} "
            "kg were drawn for them"
        )
    lines += _hidden_lines(truth)
    given = arguments.sensor
    further = {
        "the truth": arguments.truth,
        "named points": given.points_out,
        "the camera": given.camera_out,
    }
    written = "".join(f", {what} to {path}" for what, path in further.items() if path)
    lines += [f"written to {arguments.out}{written}", *_next_words(arguments, setup)]
    return "\n".join(lines)


def _counts(rows: int, measured: int, cycles: int) -> str:
    """Return the size of a table in words; ``measured`` are its poses in all cycles.

    Example:
        >>> _counts(125, 125, 5), _counts(480, 60, 1)
        ('125 rows at 25 poses in 5 cycles', '480 rows at 60 poses')
    """
    counts = f"{counted(rows, 'row')} at {counted(measured // cycles, 'pose')}"
    return f"{counts} in {cycles} cycles" if cycles > 1 else counts


def _hidden_lines(truth: dict[str, Any]) -> Iterator[str]:
    """Yield a line for each hidden effect."""
    for entry in truth["effects"]:
        place = f" of {entry['joint']}" if entry["joint"] else ""
        place += f" by {entry['source']}" if "source" in entry else ""
        unit = "" if entry["unit"] == "1" else f" {entry['unit']}"
        moved = f"moves the target by {entry['moves_target_rms_mm']:.3f} mm rms"
        yield f"  hidden: {entry['effect']}{place}, size {entry['size']:.3g}{unit}, {moved}"


def _next_words(arguments: SimulateArguments, setup: SensorSetup | None) -> list[str]:
    """Return the lines that say what is next: to check the table, or to measure the part; write
    the cell file for it.
    """
    if arguments.part.features is not None:
        part = f"--features {arguments.part.features}"
        return [f"next: pincal measure MODEL.json {arguments.out} {part}"]
    given = _cell_values(arguments, setup)
    folder = arguments.out.parent
    cell = written_cell("pincal simulate", more=given, place=folder)
    if cell is not None:
        return [
            f"written to {cell}: what describes the cell, for the next commands",
            f"next: pincal check {arguments.out}",
        ]
    is_beside = is_cell_beside(given, folder)
    if is_beside:
        return [f"next: pincal check {arguments.out}"]
    # A cell file of something else stays as it is.
    elsewhere = "" if is_beside is None else " --cell none"
    return [f"next: {_with_options(arguments, given)}{elsewhere}"]


def _cell_values(arguments: SimulateArguments, setup: SensorSetup | None) -> dict[str, Any]:
    """Return what describes the cell, by key, as on a command line; ``setup`` is None for logs of
    motion, whose noise is told by themselves.
    """
    machine = arguments.machine
    sensor = arguments.sensor
    found: dict[str, Any] = {
        "robot": arguments.robot,
        "tip": machine.end,
        "base": machine.base,
        "beside": [str(of) for of in machine.beside],
        "xacro_arg": [f"{name}:={value}" for name, value in machine.xacro_args],
        "points": sensor.points_out and str(sensor.points_out),
        "camera": sensor.camera_out and str(sensor.camera_out),
    }
    if setup is not None:
        found |= _of_setup(arguments, setup)
    return {key: found[key] for key in CELL_KEYS if found.get(key)}


def _of_setup(arguments: SimulateArguments, setup: SensorSetup) -> dict[str, Any]:
    """Return noise, distance of a pair of sockets and load, by key."""
    angle = setup.truth()["noise"]["sigma_rad"]
    found: dict[str, Any] = {
        "noise": _noise(setup) if setup.sigma else None,
        "noise_angle": f"{angle * 1e3:g}mrad" if angle else None,
    }
    if setup.kind == "socket" and not arguments.sensor.points_out and len(setup.points) > 1:
        (a, first), (b, second) = list(setup.points.items())[:2]
        found["socket_distance"] = [[a, b, f"{np.linalg.norm(first - second):g}"]]
    for key, vector in (
        ("payload_com", arguments.campaign.payload_com),
        ("gravity", arguments.machine.gravity),
    ):
        if vector not in (None, (0.0, 0.0, 0.0)):
            found[key] = [f"{value:g}" for value in vector]
    return found


def _with_options(arguments: SimulateArguments, given: dict[str, Any]) -> str:
    """Return the command that checks the table without a cell file."""
    words = ["pincal", "check", arguments.robot, str(arguments.out)]
    for key, value in given.items():
        if key == "robot":
            continue
        several = isinstance(value, list) and key not in ("payload_com", "gravity")
        for each in value if several else [value]:
            words += [f"--{key.replace('_', '-')}", *([each] if isinstance(each, str) else each)]
    return " ".join(words)


def _noise(setup: SensorSetup) -> str:
    """Return the noise as the option ``--noise`` takes it."""
    return f"{setup.sigma:g}px" if setup.kind.endswith("pixel") else f"{setup.sigma * 1e3:g}mm"


def parse_effect(text: str, joints: tuple[str, ...]) -> tuple[str, dict[str, Any]]:
    """Return name and given fields of a hidden effect of an arm with these joints.

    ``text`` is as on the command line, e.g. ``gear_eccentricity:joint_3:size=1e-4,order=1``;
    components of a vector are separated by a slash, as commas separate keys.

    Raises:
        BadInputError: for a name, joint, key or value that is invalid, with the valid ones.

    Example:
        >>> parse_effect("axis_wobble:j2:size=1e-4,order=1,frame=after", ("j1", "j2"))
        ('axis_wobble', {'joint': 'j2', 'size': 0.0001, 'order': 1, 'frame': 'after'})
    """
    from pincal.model.catalogue.candidates import effect_parts
    from pincal.simulate.effect import HIDDEN_EFFECTS

    name, pairs = effect_parts(text)
    if name not in HIDDEN_EFFECTS:
        raise BadInputError(
            f"effect {name!r}: unknown; expected one of "
            f"{', '.join(nearest_first([name], HIDDEN_EFFECTS))}"
        )
    kind = HIDDEN_EFFECTS[name]
    values = dict[str, Any]()
    for key, word in pairs:
        if key not in ("joint", *_keys(kind)):
            raise BadInputError(
                f"effect {text!r}: no key {key!r}; {name} has {', '.join(_keys(kind))}, "
                "as key=value"
            )
        if key in ("joint", "source") and word not in joints:
            near = ", ".join(nearest_first([word], joints))
            raise BadInputError(f"effect {text!r}: no joint {word!r}; expected one of {near}")
        if key in values:
            raise BadInputError(f"effect {text!r}: {key} is given twice")
        values[key] = _read(text, kind, key, word)
    return name, values


def _read(text: str, kind: type[HiddenEffect], key: str, word: str) -> Any:
    """Return the value of a key of an effect, read as the type of its field."""
    import msgspec

    from pincal.simulate.elastic import MOMENT_FRAMES

    choices = {"frame": ("before", "after"), "moment_frame": MOMENT_FRAMES}
    if key in choices and word not in choices[key]:
        raise BadInputError(
            f"effect {text!r}: {key}={word}; expected one of {', '.join(choices[key])}"
        )
    of = get_type_hints(kind)[key]
    try:
        found = msgspec.convert(
            word.split("/") if get_origin(of) is tuple else word, of, strict=False
        )
    except msgspec.ValidationError:
        found = math.nan
    if isinstance(found, float | tuple) and not np.isfinite(found).all():
        expected = _EXPECTED.get(of, "three numbers, such as 1/0/0")
        raise BadInputError(f"effect {text!r}: {key}={word}; expected {expected}")
    return found


_EXPECTED = {float: "a number", int: "a whole number", bool: "true or false"}
