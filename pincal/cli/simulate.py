"""``pincal simulate``: the table that a machine with chosen errors and effects would give."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from pincal.cli.arguments import verb
from pincal.cli.outputs import print_json, provenance
from pincal.cli.simulate_options import SimulateArguments
from pincal.cli.simulate_output import point_columns, summary, write_files, write_json
from pincal.errors import BadInputError, Exit

if TYPE_CHECKING:
    import numpy as np

    from pincal.robot.robot import Robot
    from pincal.simulate.campaign import Campaign
    from pincal.simulate.machine import TrueMachine

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
    from pincal.measure.table import write_table
    from pincal.robot.robot import Robot
    from pincal.simulate.request import Stream

    arguments.check()
    robot = Robot.from_urdf(arguments.robot, tip=arguments.machine.tip, base=arguments.machine.base)
    machine = _machine(robot, arguments)
    campaign = _campaign(robot, machine, arguments)
    table = campaign.measure(machine, Stream.NOISE.generator(arguments.pose_seed))
    names = {"robot": robot.name, "base": robot.base, "tip": robot.tip}
    seeds = {"seed": arguments.campaign.seed, "pose_seed": arguments.pose_seed}
    found = names | seeds | campaign.truth(machine, tip=robot.tip)
    origin, beside = {"made_by": provenance([Path(robot.source)])}, arguments.sensor
    write_files({
        "--out": (arguments.out, lambda path: write_table(path, table)),
        "--truth": (arguments.truth, lambda path: write_json(path, contents=found | origin)),
        "--points-out": (beside.points_out, lambda path: write_table(path, point_columns(campaign.setup))),
        "--camera-out": (beside.camera_out, lambda path: write_json(path, contents=found["camera"])),
    })  # fmt: skip
    rows = len(table[machine.names[0]])
    if arguments.general.as_json:
        print_json({"rows": rows, "columns": list(table), "out": str(arguments.out)} | found)
    else:
        click.echo(summary(arguments, found, setup=campaign.setup, rows=rows))
    return Exit.DONE


def _machine(robot: Robot, arguments: SimulateArguments) -> TrueMachine:
    """Return the machine that is measured."""
    from pincal.cli.effect_option import parse_effect
    from pincal.simulate.machine import TrueMachine
    from pincal.simulate.request import draw_machine

    given = arguments.machine
    nominal = TrueMachine.from_urdf(
        Path(robot.source),
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
        massless=robot.massless,
    )


def _campaign(robot: Robot, machine: TrueMachine, arguments: SimulateArguments) -> Campaign:
    """Return poses, conditions and set-up."""
    from pincal.cli.inputs import load_table
    from pincal.simulate.campaign import Campaign
    from pincal.simulate.request import Stream, poses_of_table, repeat_poses
    from pincal.simulate.sensors import draw_setup

    given = arguments.campaign
    conditions: dict[str, np.ndarray] = {}
    rng = Stream.LAYOUT.generator(given.seed)
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
