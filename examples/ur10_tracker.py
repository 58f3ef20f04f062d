"""A real robot: 1495 poses of a Universal Robots UR10, measured by a laser tracker with a T-Mac probe.

The measurements are those of Fraunhofer IPA (MIT licence, (c) 2021 Christian Landgraf), published in the repository
christianlandgraf/ipa-robot-accuracy on GitHub: series B, 6D poses in the tracker's frame at random joint positions. The
file is a table with the UR10's joint names, x y z [m] and qx qy qz qw.

Geometry and elasticity leave some 0.4 mm. A discovery finds the cause: curves of the drives' own angles, validated on whole
regions of joint space used neither by the fit nor by the search. This takes about a minute. Run it as

    python examples/ur10_tracker.py series_B.csv [--fraction 0.25]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

from pincal import (
    ELASTIC,
    GEOMETRIC,
    Measurements,
    Options,
    PincalError,
    Robot,
    cross_validate,
    read_measurements,
    run_calibration,
)
from pincal.discover.run import Discovery, run_discovery
from pincal.model.catalogue import TransmissionError

FOLDS = 5
MISSING = """{path}: no such file.
The measurements are published (MIT licence) by Christian Landgraf, Fraunhofer IPA, in the repository
christianlandgraf/ipa-robot-accuracy on GitHub. Save series B as a table with the columns
{joints} x y z qx qy qz qw (rad, m)
and give its path."""


def compare(robot: Robot, table: Measurements, fraction: float) -> None:
    """Calibrate without and with elasticity, and print the errors at held-out poses."""
    models = {"geometric": Options(effects=GEOMETRIC), "elastic": Options(effects=ELASTIC)}
    found = {
        name: run_calibration(robot, table, options, test_fraction=fraction, split="random")
        for name, options in models.items()
    }
    first = found["geometric"].result
    errors = {"nominal": first.error["nominal"]["test"]}
    errors |= {name: calibration.result.error["calibrated"]["test"] for name, calibration in found.items()}
    print(f"UR10, {table.source}: {first.rows['train']} poses to fit, {first.rows['test']} held out; position errors [mm]")
    print(f"  {'model':10s} {'mean':>8s} {'rms':>8s} {'p95':>8s} {'max':>8s}  {FOLDS}-fold mean")
    crossed = 0.0
    for name, error in errors.items():
        shown = " ".join(f"{error[f'{word}_mm']:8.3f}" for word in ("mean", "rms", "p95", "max"))
        if name in models:
            residuals = cross_validate(robot, table, models[name], folds=FOLDS).residuals[:3]
            crossed = 1e3 * float(np.linalg.norm(residuals, axis=0).mean())
            shown += f"  {crossed:11.3f}"
        print(f"  {name:10s} {shown}")
    print(f"About {crossed:.1f} mm remain unexplained by geometry and gravity.")


def explain(robot: Robot, table: Measurements) -> None:
    """Find missing effects, and print the curves of the drives and the errors in held-out regions."""
    found = run_discovery(robot, table, Options(effects=GEOMETRIC))
    print("What is missing; mean position errors in held-out regions of joint space [mm]:")
    for entry in found.report["effects"]:
        gap = f"{entry['gap_before_mm']:7.3f} -> {entry['gap_after_mm']:6.3f}"
        print(f"  {_place(entry):42s} {_curve(found, entry):18s} {gap}")
    before, after = (found.report["gap"][when]["mean_mm"] for when in ("before", "after"))
    print(f"Regions held out, mean: {before:.3f} mm with geometry, {after:.3f} mm with all effects found.")


def _place(entry: dict[str, Any]) -> str:
    depends = f" by {entry['depends_on']}" if "depends_on" in entry else ""
    return f"{entry['effect']} of {entry['joint'] or 'the whole arm'}{depends}"


def _curve(found: Discovery, entry: dict[str, Any]) -> str:
    """Return the size of a drive's curve at the measured poses in words; its constant part is the joint's zero."""
    fit = found.calibration.fit.fit
    for effect in fit.model.effects:
        if isinstance(effect, TransmissionError) and (effect.name, effect.joint) == (entry["effect"], entry["joint"]):
            terms = effect.terms(fit.model.chain, fit.station.conditions, None)
            values = [fit.values[fit.model.index(parameter.name)] for parameter in effect.parameters(fit.model.chain)]
            curve = sum(values[term.parameter] * term.basis for term in terms if term.basis is not None)
            return f"{np.rad2deg(np.std(curve)) * 3600.0:5.1f} arcsec rms"
    return ""


def main() -> int:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("path", type=Path, help="table of series B of christianlandgraf/ipa-robot-accuracy")
    parser.add_argument("--fraction", type=float, default=0.25, help="of the poses to hold out (default: %(default)s)")
    chosen = parser.parse_args()
    robot = Robot.from_urdf("ur10", tip="tool0")
    if not chosen.path.is_file():
        print(MISSING.format(path=chosen.path, joints=" ".join(robot.joint_names)), file=sys.stderr)
        return 3
    try:
        table = read_measurements(chosen.path, robot.joint_names)
        compare(robot, table, chosen.fraction)
        explain(robot, table)
    except PincalError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
