"""``pincal simulate``: the table that a machine with chosen errors and effects would give."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from pincal.atomic import replacing
from pincal.cli.arguments import verb
from pincal.cli.outputs import print_json, provenance
from pincal.cli.simulate_options import SimulateArguments
from pincal.errors import BadInputError, Exit, OutputError

if TYPE_CHECKING:
    from pincal.robot.robot import Robot
    from pincal.simulate.campaign import Campaign
    from pincal.simulate.machine import TrueMachine
    from pincal.simulate.setup import SensorSetup

_EXAMPLES = """Examples:
  pincal simulate robot.urdf --poses 300 --out tracker.csv
  pincal simulate robot.urdf --poses 300 --payload 0,80 --masses-off 3 \\
      --effect gear_eccentricity:joint_3:size=1e-4,order=1 --out tracker.csv --truth truth.json
  pincal simulate robot.urdf --poses 500 --pose-seed 1 --noise 0mm --out exact.csv   # the same machine
Other sensors:
  pincal simulate robot.urdf --sensor pose --noise-angle 0.05mrad --poses 200 --out poses.csv
  pincal simulate robot.urdf --sensor camera_point --points-out object.csv --out seen.csv   # as in the paper
  pincal simulate robot.urdf --sensor camera_pixel --object grid --poses 60 --noise 0.1px \\
      --points-out grid.csv --camera-out camera.json --out image.csv
  pincal simulate robot.urdf --sockets 6 --poses 240 --points-out sockets.csv --out contacts.csv
  pincal simulate robot.urdf --anchors 3 --poses 200 --points-out anchors.csv --out wires.csv
  pincal simulate robot.urdf --ball-bar 300mm --anchors 2 --poses 200 --out bar.csv
Then:
  pincal discover robot.urdf tracker.csv --out results --noise 0.05mm
"""


def _catalogue() -> str:
    """Return the end of the help text, for which the effects are imported."""
    from pincal.cli.effect_option import effect_help

    heading = "Effects, the joint on which they act, and their keys (default: a random joint and typical values):"
    return f"{heading}\n{effect_help()}"


@verb(SimulateArguments, examples=_EXAMPLES, ending=_catalogue)
def simulate(arguments: SimulateArguments) -> Exit:
    """Simulate the measurement of a machine with chosen errors and hidden effects."""
    from pincal.cli.progress import end_progress, tell_step
    from pincal.measure.table import write_table
    from pincal.robot.robot import Robot
    from pincal.simulate.request import Stream

    arguments.check()
    given = arguments.machine
    robot = Robot.from_urdf(arguments.robot, tip=given.tip, base=given.base, xacro_args=dict(given.xacro_args))
    machine = _machine(robot, arguments)
    tell_step("planning poses")
    campaign = _campaign(robot, machine, arguments)
    tell_step("measuring them")
    table = campaign.measure(machine, Stream.NOISE.generator(arguments.pose_seed))
    names = {"robot": robot.name, "base": robot.base, "tip": robot.tip}
    seeds = {"seed": arguments.campaign.seed, "pose_seed": arguments.pose_seed, "setup_seed": arguments.setup_seed}
    found = names | seeds | campaign.truth(machine, tip=robot.tip) | _weights(robot, machine)
    origin, beside = {"made_by": provenance([Path(robot.source)])}, arguments.sensor
    _write_files({
        "--out": (arguments.out, lambda path: write_table(path, table)),
        "--truth": (arguments.truth, lambda path: _write_json(path, contents=found | origin)),
        "--points-out": (beside.points_out, lambda path: write_table(path, _point_columns(campaign.setup))),
        "--camera-out": (beside.camera_out, lambda path: _write_json(path, contents=found["camera"])),
    })  # fmt: skip
    rows = len(table[machine.names[0]])
    end_progress()
    if arguments.general.as_json:
        print_json({"rows": rows, "columns": list(table), "out": str(arguments.out)} | found)
    else:
        click.echo(_summary(arguments, found, setup=campaign.setup, rows=rows))
    return Exit.DONE


def _machine(robot: Robot, arguments: SimulateArguments) -> TrueMachine:
    """Return the machine that is measured."""
    from pincal.cli.effect_option import parse_effect
    from pincal.robot.urdf import arm_text
    from pincal.simulate.machine import TrueMachine
    from pincal.simulate.request import draw_machine

    given = arguments.machine
    nominal = TrueMachine.from_urdf(
        arm_text(robot.urdf, robot.joint_names, robot.source),
        tip=robot.tip,
        base=robot.base,
        moment_frame=given.moment_frame,
        gravity=given.gravity or tuple(robot.gravity.tolist()),
    )
    return draw_machine(
        nominal,
        seed=arguments.campaign.seed,
        errors=given.errors,
        elastic=given.elastic,
        masses_off=given.masses_off,
        effects=[parse_effect(text, robot.joint_names) for text in given.effects],
        unweighed=robot.unweighed,
    )


def _weights(robot: Robot, machine: TrueMachine) -> dict[str, Any]:
    """Return the masses that were drawn because the URDF has none, as for JSON."""
    drawn = [joint for joint in machine.names if joint in robot.unweighed]
    found = {joint: float(machine.arm.masses[machine.names.index(joint)]) for joint in drawn}
    return {"drawn_masses_kg": found} if found else {}


def _campaign(robot: Robot, machine: TrueMachine, arguments: SimulateArguments) -> Campaign:
    """Return poses, conditions and set-up."""
    from pincal.cli.inputs import load_table
    from pincal.simulate.campaign import Campaign
    from pincal.simulate.request import Stream, poses_of_table, repeat_poses
    from pincal.simulate.sensors import draw_setup

    given = arguments.campaign
    conditions: dict[str, np.ndarray] = {}
    rng = Stream.LAYOUT.generator(arguments.setup_seed)
    setup = draw_setup(arguments.kind, machine.nominal, rng=rng, options=arguments.setup_options())
    if given.at is not None:
        q, conditions = poses_of_table(load_table(robot, given.at, joints_only=True))
    else:
        rng = Stream.POSES.generator(arguments.pose_seed)
        try:
            q = setup.plan(machine.nominal, arguments.n_poses or 1, rng=rng, min_height=arguments.floor)
        except BadInputError as error:
            raise BadInputError(
                f"{error}; a lower --floor, or --no-floor, gives the arm more room, another --seed another place"
            ) from None
    q, all_conditions = repeat_poses(
        machine,
        q,
        given=conditions,
        seed=arguments.pose_seed,
        cycles=given.cycles,
        recorded=given.recorded,
        payload=given.payload,
        payload_order=given.payload_order,
        payload_com=given.payload_com,
    )
    return Campaign(q=q, conditions=all_conditions, setup=setup, hidden=given.hide)


def _summary(arguments: SimulateArguments, truth: dict[str, Any], *, setup: SensorSetup, rows: int) -> str:
    """Return what was simulated and written, and the next command; ``truth`` is what the truth file holds."""
    lines = [
        f"{rows} rows in {truth['poses']} poses of {truth['robot']} ({truth['base']} to {truth['tip']}): "
        f"{truth['sensor']}, noise {_noise(setup)}"
    ]
    if drawn := truth.get("drawn_masses_kg"):
        lines.append(f"  the URDF has no masses of {len(drawn)} links: {sum(drawn.values()):.3g} kg were drawn for them")
    for entry in truth["effects"]:
        place = f" of {entry['joint']}" if entry["joint"] else ""
        place += f" by {entry['source']}" if "source" in entry else ""
        unit = "" if entry["unit"] == "1" else f" {entry['unit']}"
        moved = f"moves the target by {entry['moves_target_rms_mm']:.3f} mm rms"
        lines.append(f"  hidden: {entry['effect']}{place}, size {entry['size']:.3g}{unit}, {moved}")
    given = arguments.sensor
    beside = {"what was put in": arguments.truth, "named points": given.points_out, "the camera": given.camera_out}
    written = "".join(f", {what} to {path}" for what, path in beside.items() if path)
    lines += [f"written to {arguments.out}{written}", f"next: {_next_command(arguments, setup)}"]
    return "\n".join(lines)


def _next_command(arguments: SimulateArguments, setup: SensorSetup) -> str:
    """Return the command that discovers the effects from the table."""
    machine, given = arguments.machine, arguments.sensor
    words = [f"pincal discover {arguments.robot} {arguments.out} --out results"]
    words += [f"--tip {machine.tip}"] if machine.tip else []
    words += [f"--base {machine.base}"] if machine.base else []
    words += [f"--xacro-arg {name}:={value}" for name, value in machine.xacro_args]
    words += [f"--noise {_noise(setup)}"] if setup.sigma else []
    angle = setup.truth()["noise"]["sigma_rad"]
    words += [f"--noise-angle {angle * 1e3:g}mrad"] if angle else []
    words += [f"--points {given.points_out}"] if given.points_out else []
    words += [f"--camera {given.camera_out}"] if given.camera_out else []
    if setup.kind == "socket" and not given.points_out and len(setup.points) > 1:
        (a, first), (b, second) = list(setup.points.items())[:2]
        words.append(f"--socket-distance {a} {b} {np.linalg.norm(first - second):g}")
    for name, vector in (("payload-com", arguments.campaign.payload_com), ("gravity", machine.gravity)):
        if vector not in (None, (0.0, 0.0, 0.0)):
            words.append(f"--{name} {' '.join(f'{value:g}' for value in vector)}")
    return " ".join(words)


def _noise(setup: SensorSetup) -> str:
    """Return the noise as the option ``--noise`` takes it."""
    return f"{setup.sigma:g}px" if setup.kind == "camera_pixel" else f"{setup.sigma * 1e3:g}mm"


def _point_columns(setup: SensorSetup) -> dict[str, np.ndarray]:
    """Return the named points as a table with columns ``point x y z``."""
    places = np.array([*setup.points.values()], float)
    return {"point": np.array(list(setup.points)), **dict(zip("xyz", places.T, strict=True))}


def _write_files(files: dict[str, tuple[Path | None, Callable[[Path], None]]]) -> None:
    """Write several files, all of them or none, each by its function; they are given by the options that name them."""
    wanted = {option: (path, write) for option, (path, write) in files.items() if path is not None}
    _check_places({option: path for option, (path, _) in wanted.items()})
    with ExitStack() as drafts:
        for option, (path, write) in wanted.items():
            write(drafts.enter_context(replacing(path, advice=f"choose another {option}")))


def _check_places(paths: dict[str, Path]) -> None:
    places = [path.absolute() for path in paths.values()]
    for (option, path), place in zip(paths.items(), places, strict=True):
        if path.is_dir():
            raise OutputError(f"{path}: is a folder; expected a file to write to")
        if not path.absolute().parent.is_dir():
            raise OutputError(f"{path}: can't be written (no such folder); choose another {option}")
        if places.count(place) > 1:
            named = " and ".join(other for other, there in paths.items() if there.absolute() == place)
            raise OutputError(f"{path}: named by {named}; expected {'two' if len(paths) == 2 else 'different'} files")


def _write_json(path: Path, *, contents: dict[str, Any]) -> None:
    """Write contents as JSON."""
    path.write_text(json.dumps(contents, indent=1, allow_nan=False), encoding="utf-8")
