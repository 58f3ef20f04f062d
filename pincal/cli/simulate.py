"""``pincal simulate``: the table that a machine with chosen errors and effects would give."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np

from pincal.cli import show_progress
from pincal.cli.common import output_options
from pincal.cli.outputs import print_json, provenance
from pincal.cli.simulate_options import RECORDED, campaign_options, machine_options, setup_options
from pincal.cli.simulate_setup import (
    known_beside,
    noise_words,
    point_columns,
    settle_options,
    setup_of,
    write_files,
    write_json,
)
from pincal.errors import BadInputError

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

Effects, the joint on which they act and their keys; typical sizes and a joint at random unless given:
"""
# Parts of the simulation that draw from sources of their own: one changed leaves the others as they were.
_ERRORS, _ELASTICITY, _MASSES, _EFFECTS, _PLACES, _POSES, _CONDITIONS, _NOISE = range(8)


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
    """Make the table that a machine with chosen errors and hidden effects gives when it is measured."""
    show_progress(quiet)
    from pincal.measure.table import write_table
    from pincal.robot.robot import Robot

    settle_options(chosen)
    if (chosen["poses"] is None) == (chosen["at"] is None):
        raise click.UsageError("give either --poses N or --at FILE.csv")
    if chosen["pose_seed"] is None:
        chosen["pose_seed"] = chosen["seed"]
    arm = Robot.from_urdf(robot, tip=chosen["tip"], base=chosen["base"])
    machine = _machine(arm, chosen)
    campaign = _campaign(arm, machine, chosen)
    table = campaign.measure(machine, _rng(chosen["pose_seed"], _NOISE))
    found = _truth(arm, machine, campaign, chosen)
    origin = {"made_by": provenance([Path(arm.source)])}
    write_files({
        "--out": (out, lambda path: write_table(path, table)),
        "--truth": (truth, lambda path: write_json(path, found | origin)),
        "--points-out": (chosen["points_out"], lambda path: write_table(path, point_columns(campaign.setup))),
        "--camera-out": (chosen["camera_out"], lambda path: write_json(path, found["camera"])),
    })  # fmt: skip
    if as_json:
        print_json({"rows": len(table[machine.names[0]]), "columns": list(table), "out": str(out)} | found)
    else:
        _tell(robot, out, truth, table, campaign, found, chosen)
    return 0


def _rng(seed: int, part: int) -> np.random.Generator:
    if seed < 0:
        raise BadInputError(f"seed {seed}; expected 0 or more")
    return np.random.default_rng([seed, part])


def _machine(arm: Any, chosen: dict[str, Any]) -> Any:
    """Return the machine that is measured."""
    from pincal.cli.effect_option import parse_effect
    from pincal.simulate.machine import TrueMachine
    from pincal.simulate.typical import LOADED, draw_typical_elasticity, draw_typical_errors, typical_effect

    seed, names = chosen["seed"], arm.joint_names
    wanted = [parse_effect(text, names) for text in chosen["effects"]]
    loaded = ["elasticity"] if chosen["elastic"] else []
    loaded += [name for name, _ in wanted if name in LOADED]
    if arm.massless and loaded:
        raise BadInputError(
            f"{loaded[0]} needs inertial data, and {', '.join(arm.massless)} of the URDF "
            f"{'has' if len(arm.massless) == 1 else 'have'} no mass; leave it out (--elastic 0)"
        )
    machine = TrueMachine.from_urdf(Path(arm.source), tip=arm.tip, base=arm.base, moment_frame=chosen["moment_frame"],
                                    gravity=tuple(chosen["gravity"] or arm.gravity.tolist()))  # fmt: skip
    machine = draw_typical_errors(machine, _rng(seed, _ERRORS), scale=chosen["errors"])
    machine = machine.draw_masses(_rng(seed, _MASSES), sigma=chosen["masses_off"] / 100.0)
    scale = (0.0 if arm.massless else 1.0) if chosen["elastic"] is None else chosen["elastic"]
    if scale:
        machine = draw_typical_elasticity(machine, _rng(seed, _ELASTICITY), scale=scale)
    rng = _rng(seed, _EFFECTS)
    return machine.with_effects(*(typical_effect(machine, name, rng, **values) for name, values in wanted))


def _campaign(arm: Any, machine: Any, chosen: dict[str, Any]) -> Any:
    """Return poses, conditions and set-up."""
    from pincal.simulate.campaign import Campaign

    setup = setup_of(machine, chosen, _rng(chosen["seed"], _PLACES))
    q, conditions = _poses(arm, machine, setup, chosen)
    return Campaign(q=q, conditions=conditions, payload_com=chosen["payload_com"], setup=setup, hidden=chosen["hide"])


def _poses(arm: Any, machine: Any, setup: Any, chosen: dict[str, Any]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return joint positions and the conditions under which they are measured."""
    from pincal.simulate.campaign import draw_conditions, spread_payloads
    from pincal.simulate.typical import NEEDED_COLUMNS

    given: dict[str, np.ndarray] = {}
    if chosen["at"] is not None:
        from pincal.cli.inputs import load_table

        rows = load_table(arm, chosen["at"], joints_only=True)
        rows = rows.select(_visits(rows))
        q = rows.q
        given = {name: value for name in (*RECORDED, "payload") if (value := getattr(rows, name)) is not None}
    else:
        q = _planned_poses(machine, setup, chosen)
    needed = {NEEDED_COLUMNS[e.effect] for e in machine.effects if e.effect in NEEDED_COLUMNS} | set(chosen["recorded"])
    names = [name for name in RECORDED if name in needed]
    cycles, poses = chosen["cycles"], len(q)
    drawn = draw_conditions(names, cycles * poses, len(machine.names), _rng(chosen["pose_seed"], _CONDITIONS))
    loads = chosen["payload"]
    if loads is not None:
        given |= {"payload": spread_payloads(loads, poses, order=chosen["payload_order"])}
    if "approach" in drawn:
        # Every round comes to a pose from the same side, as ISO 9283 has it.
        given = {"approach": drawn["approach"][:poses]} | given
    again = {name: np.tile(value, (cycles, *[1] * (value.ndim - 1))) for name, value in given.items()}
    return np.tile(q, (cycles, 1)), drawn | again


def _visits(rows: Any) -> np.ndarray:
    """Return which rows of a table begin a visit of a pose: several targets or points are seen in one, shape (N,)."""
    labels = rows.target if rows.point is None else rows.point
    begins, seen = np.ones(len(rows), bool), set[str]()
    for i, label in enumerate(labels):
        begins[i] = i == 0 or label in seen or not np.array_equal(rows.q[i], rows.q[i - 1])
        seen = {label} if begins[i] else seen | {label}
    return begins


def _planned_poses(machine: Any, setup: Any, chosen: dict[str, Any]) -> np.ndarray:
    if chosen["poses"] < 1:
        raise BadInputError(f"--poses {chosen['poses']}; expected 1 or more")
    floor = None if chosen["no_floor"] else chosen["floor"]
    try:
        q: np.ndarray = setup.plan(machine, chosen["poses"], _rng(chosen["pose_seed"], _POSES), min_height=floor)
    except BadInputError as error:
        raise BadInputError(
            f"{error}; a lower --floor, or --no-floor, gives the arm more room, another --seed another place"
        ) from None
    return q


def _truth(arm: Any, machine: Any, campaign: Any, chosen: dict[str, Any]) -> dict[str, Any]:
    """Return what was put in, for programs."""
    names = machine.names
    ends = (*names, arm.tip)
    found = {
        "robot": arm.name,
        "base": arm.base,
        "tip": arm.tip,
        "poses": len(campaign.q),
        "sensor": campaign.setup.kind,
        "seed": chosen["seed"],
        "pose_seed": chosen["pose_seed"],
        "noise": _noise(campaign.setup),
        "effects": [_entry(machine, campaign, effect) for effect in machine.effects],
        "geometry": {
            "placement_errors": {
                end: {"translation_m": row[:3].tolist(), "rotation_rad": row[3:].tolist()}
                for end, row in zip(ends, machine.placement_errors, strict=True)
            },
            "joint_offsets": dict(zip(names, machine.joint_offsets.tolist(), strict=True)),
        },
        "compliance": {
            name: dict(zip(("k_x", "k_y", "k_z"), row.tolist(), strict=True))
            for name, row in zip(names, machine.compliance, strict=True)
        },
        "moment_frame": machine.moment_frame,
        "mass_factors": dict(zip(names, machine.mass_factors.tolist(), strict=True)),
        "com_errors_m": dict(zip(names, machine.com_errors.tolist(), strict=True)),
        "gravity": list(machine.gravity),
        "payload_com": list(campaign.payload_com),
        "not_recorded": list(campaign.hidden),
    }
    return found | dict(campaign.setup.truth())


def _noise(setup: Any) -> dict[str, float | None]:
    sigmas = {"sigma_m": setup.sigma, "sigma_rad": setup.sigma_angle if setup.kind == "pose" else None}
    return sigmas if setup.kind != "camera_pixel" else {"sigma_m": None, "sigma_rad": None, "sigma_px": setup.sigma}


def _entry(machine: Any, campaign: Any, effect: Any) -> dict[str, Any]:
    """Return an effect with its unit and what it does."""
    from pincal.simulate.typical import SIZE_UNITS

    values = {name: list(v) if isinstance(v, tuple) else v for name, v in vars(effect).items()}
    shift = 1e3 * campaign.shift(machine, effect)
    return {"effect": effect.effect} | values | {"unit": SIZE_UNITS[effect.effect], "moves_target_rms_mm": shift}


def _tell(robot: str, out: Path, truth: Path | None, table: Any, campaign: Any, found: dict[str, Any],
          chosen: dict[str, Any]) -> None:  # fmt: skip
    rows, noise = len(next(iter(table.values()))), noise_words(campaign.setup)
    click.echo(
        f"{rows} rows in {found['poses']} poses of {found['robot']} ({found['base']} to {found['tip']}): "
        f"{found['sensor']}, noise {noise}"
    )
    for entry in found["effects"]:
        place = f" of {entry['joint']}" if entry["joint"] else ""
        place += f" by {entry['source']}" if "source" in entry else ""
        unit = "" if entry["unit"] == "1" else f" {entry['unit']}"
        moved = f"moves the target by {entry['moves_target_rms_mm']:.3f} mm rms"
        click.echo(f"  hidden: {entry['effect']}{place}, size {entry['size']:.3g}{unit}, {moved}")
    beside = {"what was put in": truth, "named points": chosen["points_out"], "the camera": chosen["camera_out"]}
    click.echo(f"written to {out}" + "".join(f", {what} to {path}" for what, path in beside.items() if path))
    words = [f"pincal discover {robot} {out} --out results"]
    words += [f"--{name} {chosen[name]}" for name in ("tip", "base") if chosen[name]]
    words += [f"--noise {noise}"] if chosen["noise"] else []
    words += [f"--noise-angle {chosen['noise_angle'] * 1e3:g}mrad"] if found["noise"]["sigma_rad"] else []
    words += known_beside(campaign.setup, chosen)
    for name in ("payload_com", "gravity"):
        if chosen[name] not in (None, (0.0, 0.0, 0.0)):
            words.append(f"--{name.replace('_', '-')} {' '.join(f'{value:g}' for value in chosen[name])}")
    click.echo(f"next: {' '.join(words)}")
