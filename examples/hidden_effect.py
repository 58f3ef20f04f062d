"""A robot that stays inaccurate after calibration: find where model and data disagree, name the cause, close the gap.

The machine is a simulated KUKA KR 125/2 that shares no code with the fitted model: it has errors of geometry, it deflects
under its own weight and a load of 100 kg, its masses differ by 3 % from the URDF, and it has an effect that no standard
calibration models. A laser tracker with 0.05 mm of noise measures 300 poses. Run it as

    python examples/hidden_effect.py [--effect gear_eccentricity] [--joint joint_3] [--seed 1]
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from pincal import GEOMETRIC, Measurements, Options, Robot, measurements_from_arrays, run_calibration
from pincal.builtin import kuka_urdf_path
from pincal.discover.run import run_discovery
from pincal.simulate import HIDDEN_EFFECTS, HiddenEffect, TrueMachine, plan_poses
from pincal.simulate.effect import Scope
from pincal.simulate.request import SetupOptions, draw_setup
from pincal.simulate.setup import Campaign, draw_conditions, spread_payloads
from pincal.simulate.typical import (
    draw_typical_elasticity,
    draw_typical_errors,
    typical_effect,
)

NOISE = 5e-5  # standard deviation of one coordinate [m]
POSES = 300
LOAD, LOAD_COM = 100.0, (0.06, 0.03, 0.2)  # on the flange in every other block of poses [kg], [m in the tip frame]
# Effects whose size is the length of their vector of parameters, so that truth and estimate can be held side by side.
COMPARABLE = ("gear_eccentricity", "gear_ratio", "joint_coupling", "thermal_offset")


def build_machine(effect: str, joint: str | None, rng: np.random.Generator) -> tuple[TrueMachine, HiddenEffect]:
    """Return the true machine, and its hidden effect."""
    sound = draw_typical_errors(TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0"), rng)
    sound = draw_typical_elasticity(sound, rng).draw_masses(rng, sigma=0.03)
    given = {} if joint is None or HIDDEN_EFFECTS[effect].scope is Scope.ARM else {"joint": joint}
    hidden = typical_effect(sound, effect, rng, **given)
    return sound.with_effects(hidden), hidden


def measure(machine: TrueMachine, effect: str, rng: np.random.Generator) -> tuple[Measurements, Campaign]:
    """Return the readings of a tracker in a random pose; temperature, time or approach are recorded if they matter."""
    q = plan_poses(machine.nominal, POSES, rng)
    column = HIDDEN_EFFECTS[effect].column
    conditions: dict[str, Any] = draw_conditions([column] if column else [], POSES, joints=len(machine.names), rng=rng)
    conditions["payload"] = spread_payloads([0.0, LOAD], POSES)
    campaign = Campaign(
        q=q,
        conditions={**conditions, "payload_com": LOAD_COM},
        setup=draw_setup("position", machine.nominal, rng=rng, options=SetupOptions(sigma=NOISE)),
    )
    table = campaign.measure(machine, rng)
    position = np.column_stack([table[axis] for axis in "xyz"])
    return measurements_from_arrays(machine.names, q, position=position, **conditions), campaign


def in_words(entry: dict[str, Any]) -> str:
    """Return name and place of an effect of the report."""
    place = entry["joint"] or "the whole arm"
    return f"{entry['effect']} of {place}" + (f" by {entry['source']}" if "source" in entry else "")


def print_findings(report: dict[str, Any]) -> None:
    """Print where the disagreement was, the effects named, and the error on held-out rows after each step."""
    for place in report["where"]:
        print(f"  {place['statement']} ({100.0 * place['share']:.0f} %)")
    print("  named                                      p      gap before    after [mm]")
    for entry in report["effects"]:
        gaps = f"{entry['gap_before_mm']:10.4f} {entry['gap_after_mm']:10.4f}"
        print(f"    {in_words(entry):36s} {entry['p_value']:7.0e}  {gaps}")
        if entry["equivalent"]:
            print(f"      alternatives: {', '.join(map(in_words, entry['equivalent']))}: {entry['tell_apart']}")


def print_truth(hidden: HiddenEffect, shift: float, report: dict[str, Any]) -> None:
    """Print the simulated and the identified effect."""
    unit = hidden.unit
    print(f"  simulated  {hidden.effect} of {hidden.joint or 'the whole arm'}, size {hidden.size:.3g} {unit}, "
          f"moves the target by {1e3 * shift:.3f} mm rms")  # fmt: skip
    for entry in report["effects"]:
        if (entry["effect"], entry["joint"]) == (hidden.effect, hidden.joint):
            values = [parameter["value"] for parameter in entry["parameters"].values()]
            size = f", size {np.linalg.norm(values):.3g} {unit}" if hidden.effect in COMPARABLE else ""
            print(f"  found      {in_words(entry)}{size}")
            return
    also = [in_words(other) for entry in report["effects"] for other in entry["equivalent"]]
    print(f"  found      not by this name; equivalent in these data: {', '.join(also) or 'nothing'}")


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--effect", choices=HIDDEN_EFFECTS, default="gear_eccentricity", help="what is hidden")
    parser.add_argument("--joint", help="where; drawn unless given")
    parser.add_argument("--seed", type=int, default=1, help="of everything that is drawn (default: %(default)s)")
    chosen = parser.parse_args()
    rng = np.random.default_rng(chosen.seed)
    machine, hidden = build_machine(chosen.effect, chosen.joint, rng)
    table, campaign = measure(machine, chosen.effect, rng)

    robot, options = Robot.from_urdf(kuka_urdf_path()), Options(effects=GEOMETRIC, sigma=NOISE, payload_centre=LOAD_COM)
    error = run_calibration(robot, table, options).result.error
    nominal, geometric = (error[model]["test"]["mean_mm"] for model in ("nominal", "calibrated"))
    report = run_discovery(robot, table, options).report
    print(f"KUKA KR 125/2, {POSES} poses, {NOISE * 1e3:g} mm noise; mean errors on rows held out [mm]")
    print(f"  nominal {nominal:.3f}, geometry calibrated {geometric:.3f}")
    print("What the geometric model misses:")
    print_findings(report)
    print("Truth and estimate:")
    print_truth(hidden, campaign.shift(machine, hidden), report)
    before, after = (report["gap"][when]["rms_mm"] for when in ("before", "after"))
    print(f"  gap, rms   {before:.4f} -> {after:.4f} mm; noise alone {report['noise_floor_mm']:.4f} mm; {report['verdict']}")


if __name__ == "__main__":
    main()
