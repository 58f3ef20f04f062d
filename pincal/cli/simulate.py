"""``pincal simulate``: the table that a machine with chosen errors and effects would give."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import click
import numpy as np

from pincal.cli import show_progress
from pincal.cli.common import output_options, print_json, provenance
from pincal.cli.simulate_options import RECORDED, campaign_options, machine_options
from pincal.errors import BadInputError, OutputError

_EXAMPLES = """Examples:
  pincal simulate robot.urdf --poses 300 --out tracker.csv
  pincal simulate robot.urdf --poses 300 --payload 0,80 --masses-off 3 \\
      --effect gear_eccentricity:joint_3:size=1e-4,order=1 --out tracker.csv --truth truth.json
  pincal simulate robot.urdf --poses 500 --pose-seed 1 --noise 0mm --out exact.csv   # the same machine
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
@machine_options
@output_options
def simulate(robot: str, out: Path, truth: Path | None, as_json: bool, quiet: bool, **chosen: Any) -> int:
    """Make the table that a machine with chosen errors and hidden effects gives when it is measured."""
    show_progress(quiet)
    from pincal.measure.table import write_table
    from pincal.robot.robot import Robot

    if (chosen["poses"] is None) == (chosen["at"] is None):
        raise click.UsageError("give either --poses N or --at FILE.csv")
    if truth is not None and truth.absolute() == out.absolute():
        raise OutputError(f"{out}: named by --out and --truth; expected two files")
    if chosen["pose_seed"] is None:
        chosen["pose_seed"] = chosen["seed"]
    arm = Robot.from_urdf(robot, tip=chosen["tip"], base=chosen["base"])
    machine = _machine(arm, chosen)
    campaign = _campaign(arm, machine, chosen)
    table = campaign.measure(machine, _rng(chosen["pose_seed"], _NOISE))
    found = _truth(arm, machine, campaign, chosen)
    _write(truth, found | {"made_by": provenance([Path(arm.source)])}, lambda: write_table(out, table))
    if as_json:
        print_json({"rows": len(table[machine.names[0]]), "columns": list(table), "out": str(out)} | found)
    else:
        _tell(robot, out, truth, table, found, chosen)
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
    """Return poses, conditions and instrument."""
    from pincal.simulate.campaign import Campaign, draw_instrument, draw_targets

    q, conditions = _poses(arm, machine, chosen)
    rng = _rng(chosen["seed"], _PLACES)
    instrument, targets = draw_instrument(machine, rng), draw_targets(machine, chosen["targets"], rng)
    if chosen["tool"]:
        if len(targets) > 1:
            raise BadInputError("--tool places one target; leave it out or use --targets 1")
        next(iter(targets.values()))[:3, 3] = chosen["tool"]
    return Campaign(
        q=q,
        conditions=conditions,
        payload_com=chosen["payload_com"],
        instrument=np.eye(4) if chosen["instrument"] == "base" else instrument,
        targets=targets,
        sensor=chosen["sensor"],
        sigma=chosen["noise"],
        sigma_angle=chosen["noise_angle"],
        hidden=chosen["hide"],
    )


def _poses(arm: Any, machine: Any, chosen: dict[str, Any]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return joint positions and the conditions under which they are measured."""
    from pincal.simulate.campaign import draw_conditions, spread_payloads
    from pincal.simulate.typical import NEEDED_COLUMNS

    given: dict[str, np.ndarray] = {}
    if chosen["at"] is not None:
        from pincal.cli.inputs import load_table

        rows = load_table(arm, chosen["at"], joints_only=True)
        q = rows.q
        given = {name: value for name in (*RECORDED, "payload") if (value := getattr(rows, name)) is not None}
    else:
        q = _random_poses(machine, chosen)
    needed = {NEEDED_COLUMNS[e.effect] for e in machine.effects if e.effect in NEEDED_COLUMNS} | set(chosen["recorded"])
    names = [name for name in RECORDED if name in needed]
    drawn = draw_conditions(names, len(q), len(machine.names), _rng(chosen["pose_seed"], _CONDITIONS))
    loads = chosen["payload"]
    if loads is not None:
        given |= {"payload": spread_payloads(loads, len(q), order=chosen["payload_order"])}
    return q, drawn | given


def _random_poses(machine: Any, chosen: dict[str, Any]) -> np.ndarray:
    from pincal.simulate.planning import plan_poses

    if chosen["poses"] < 1:
        raise BadInputError(f"--poses {chosen['poses']}; expected 1 or more")
    floor = None if chosen["no_floor"] else chosen["floor"]
    try:
        return plan_poses(machine.nominal, chosen["poses"], _rng(chosen["pose_seed"], _POSES), min_height=floor)
    except BadInputError:
        raise BadInputError(
            f"--floor {floor}: hardly any pose keeps the arm above it; expected a lower one, or --no-floor"
        ) from None


def _truth(arm: Any, machine: Any, campaign: Any, chosen: dict[str, Any]) -> dict[str, Any]:
    """Return what was put in, for programs."""
    names = machine.names
    ends = (*names, arm.tip)
    return {
        "robot": arm.name,
        "base": arm.base,
        "tip": arm.tip,
        "poses": len(campaign.q),
        "sensor": campaign.sensor,
        "seed": chosen["seed"],
        "pose_seed": chosen["pose_seed"],
        "noise": {"sigma_m": campaign.sigma, "sigma_rad": campaign.sigma_angle if campaign.sensor == "pose" else None},
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
        "T_instrument_base": campaign.instrument.tolist(),
        "targets": {name: place.tolist() for name, place in campaign.targets.items()},
        "not_recorded": list(campaign.hidden),
    }


def _entry(machine: Any, campaign: Any, effect: Any) -> dict[str, Any]:
    """Return an effect with its unit and what it does."""
    from pincal.simulate.typical import SIZE_UNITS

    values = {name: list(v) if isinstance(v, tuple) else v for name, v in vars(effect).items()}
    shift = 1e3 * campaign.shift(machine, effect)
    return {"effect": effect.effect} | values | {"unit": SIZE_UNITS[effect.effect], "moves_target_rms_mm": shift}


def _write(truth: Path | None, contents: dict[str, Any], write_rows: Any) -> None:
    """Write the table, and the truth where it is wanted: both whole or neither."""
    if truth is None:
        write_rows()
        return
    if truth.is_dir():
        raise OutputError(f"{truth}: is a folder; expected a file to write to")
    draft = truth.with_name(f".{truth.name}.{os.getpid()}")
    try:
        draft.write_text(json.dumps(contents, indent=1, allow_nan=False), encoding="utf-8")
        write_rows()
        os.replace(draft, truth)
    except OSError as error:
        raise OutputError(f"{truth}: can't be written ({error.strerror}); choose another --truth") from None
    finally:
        if draft.exists():
            draft.unlink()


def _tell(robot: str, out: Path, truth: Path | None, table: Any, found: dict[str, Any], chosen: dict[str, Any]) -> None:
    rows = len(next(iter(table.values())))
    noise = f"noise {found['noise']['sigma_m'] * 1e3:g} mm"
    click.echo(f"{rows} rows of {found['robot']} ({found['base']} to {found['tip']}): {found['sensor']}, {noise}")
    for entry in found["effects"]:
        place = f" of {entry['joint']}" if entry["joint"] else ""
        place += f" by {entry['source']}" if "source" in entry else ""
        unit = "" if entry["unit"] == "1" else f" {entry['unit']}"
        moved = f"moves the target by {entry['moves_target_rms_mm']:.3f} mm rms"
        click.echo(f"  hidden: {entry['effect']}{place}, size {entry['size']:.3g}{unit}, {moved}")
    click.echo(f"written to {out}" + (f", what was put in to {truth}" if truth else ""))
    words = [f"pincal discover {robot} {out} --out results"]
    words += [f"--{name} {chosen[name]}" for name in ("tip", "base") if chosen[name]]
    words += [f"--noise {chosen['noise'] * 1e3:g}mm"] if chosen["noise"] else []
    words += [f"--noise-angle {chosen['noise_angle'] * 1e3:g}mrad"] if found["noise"]["sigma_rad"] else []
    for name in ("payload_com", "gravity"):
        if chosen[name] not in (None, (0.0, 0.0, 0.0)):
            words.append(f"--{name.replace('_', '-')} {' '.join(f'{value:g}' for value in chosen[name])}")
    click.echo(f"next: {' '.join(words)}")
