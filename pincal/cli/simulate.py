"""``pincal simulate``: the table that a machine with chosen errors and effects would give."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pincal.cli import show_progress
from pincal.cli.common import output_options
from pincal.cli.outputs import print_json, provenance
from pincal.cli.simulate_options import campaign_options, machine_options, settle_options, setup_of, setup_options
from pincal.cli.simulate_output import next_command, point_columns, summary, write_files, write_json
from pincal.errors import BadInputError

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

Effects, the joint on which they act, and their keys (default: a random joint and typical values):
"""


class _Command(click.Command):
    """A command whose help ends with the catalogue of effects, loaded only when it is shown."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        from pincal.cli.effect_option import effect_help

        formatter.write(f"\n{_EXAMPLES}{effect_help()}\n")


@click.command(cls=_Command)
@click.argument("robot", metavar="ROBOT.urdf")
@click.option("--out", required=True, metavar="FILE.csv", type=click.Path(path_type=Path), help="Table to write.")
@click.option("--truth", metavar="FILE.json", type=click.Path(path_type=Path),
              help="Write what was put in: errors, effects, noise, seeds.")  # fmt: skip
@campaign_options
@setup_options
@machine_options
@output_options
def simulate(robot: str, out: Path, truth: Path | None, as_json: bool, quiet: bool, **chosen: Any) -> int:
    """Simulate the measurement of a machine with chosen errors and hidden effects."""
    show_progress(quiet)
    from pincal.measure.table import write_table
    from pincal.robot.robot import Robot
    from pincal.simulate.request import Stream

    settle_options(chosen)
    arm = Robot.from_urdf(robot, tip=chosen["tip"], base=chosen["base"])
    machine = _machine(arm, chosen)
    campaign = _campaign(arm, machine, chosen)
    table = campaign.measure(machine, Stream.NOISE.generator(chosen["pose_seed"]))
    names = {"robot": arm.name, "base": arm.base, "tip": arm.tip}
    seeds = {"seed": chosen["seed"], "pose_seed": chosen["pose_seed"]}
    found = names | seeds | campaign.truth(machine, tip=arm.tip)
    origin = {"made_by": provenance([Path(arm.source)])}
    write_files({
        "--out": (out, partial(write_table, columns=table)),
        "--truth": (truth, partial(write_json, contents=found | origin)),
        "--points-out": (chosen["points_out"], lambda path: write_table(path, point_columns(campaign.setup))),
        "--camera-out": (chosen["camera_out"], lambda path: write_json(path, contents=found["camera"])),
    })  # fmt: skip
    if as_json:
        print_json({"rows": len(table[machine.names[0]]), "columns": list(table), "out": str(out)} | found)
        return 0
    rows, beside = len(table[machine.names[0]]), {"what was put in": truth}
    beside |= {"named points": chosen["points_out"], "the camera": chosen["camera_out"]}
    click.echo(summary(found, campaign.setup, rows=rows))
    click.echo(f"written to {out}" + "".join(f", {what} to {path}" for what, path in beside.items() if path))
    click.echo(f"next: {next_command(robot, out, setup=campaign.setup, truth=found, chosen=chosen)}")
    return 0


def _machine(arm: Robot, chosen: dict[str, Any]) -> TrueMachine:
    """Return the machine that is measured."""
    from pincal.cli.effect_option import parse_effect
    from pincal.simulate.machine import TrueMachine
    from pincal.simulate.request import MachineOptions, draw_machine

    wanted = MachineOptions(
        seed=chosen["seed"],
        errors=chosen["errors"],
        elastic=chosen["elastic"],
        masses_off=chosen["masses_off"],
        effects=[parse_effect(text, arm.joint_names) for text in chosen["effects"]],
    )
    gravity, frame = tuple(chosen["gravity"] or arm.gravity.tolist()), chosen["moment_frame"]
    nominal = TrueMachine.from_urdf(Path(arm.source), tip=arm.tip, base=arm.base, moment_frame=frame, gravity=gravity)
    return draw_machine(nominal, wanted, massless=arm.massless)


def _campaign(arm: Robot, machine: TrueMachine, chosen: dict[str, Any]) -> Campaign:
    """Return poses, conditions and set-up."""
    from pincal.cli.inputs import load_table
    from pincal.simulate.campaign import Campaign
    from pincal.simulate.request import ConditionOptions, Stream, poses_of_table, repeat_poses
    from pincal.simulate.sensors import draw_setup

    wanted = ConditionOptions(
        seed=chosen["pose_seed"],
        cycles=chosen["cycles"],
        recorded=chosen["recorded"],
        payload=chosen["payload"],
        payload_order=chosen["payload_order"],
        payload_com=chosen["payload_com"],
    )
    rng = Stream.LAYOUT.generator(chosen["seed"])
    setup = draw_setup(chosen["sensor"], machine.nominal, rng=rng, options=setup_of(chosen))
    given: dict[str, np.ndarray] = {}
    if chosen["at"] is not None:
        q, given = poses_of_table(load_table(arm, chosen["at"], joints_only=True))
    else:
        floor, rng = None if chosen["no_floor"] else chosen["floor"], Stream.POSES.generator(chosen["pose_seed"])
        try:
            q = setup.plan(machine.nominal, chosen["poses"], rng=rng, min_height=floor)
        except BadInputError as error:
            raise BadInputError(
                f"{error}; a lower --floor, or --no-floor, gives the arm more room, another --seed another place"
            ) from None
    q, conditions = repeat_poses(machine, q, wanted, given=given)
    return Campaign(q=q, conditions=conditions, setup=setup, hidden=chosen["hide"])
