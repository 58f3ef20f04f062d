"""A real robot: 1495 poses of a Universal Robots UR10, measured by a laser tracker with a T-Mac probe.

The measurements are those of Fraunhofer IPA (MIT licence, (c) 2021 Christian Landgraf), published in the repository
christianlandgraf/ipa-robot-accuracy on GitHub: series B, 6D poses in the tracker's frame at random joint positions. The
file is a table with the UR10's joint names, x y z [m] and qx qy qz qw. Run it as

    python examples/ur10_tracker.py series_B.csv [--fraction 0.25]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from pincal import ELASTIC, GEOMETRIC, Options, PincalError, Robot, cross_validate, read_measurements, run_calibration

FOLDS = 5
MISSING = """{path}: no such file.
The measurements are published (MIT licence) by Christian Landgraf, Fraunhofer IPA, in the repository
christianlandgraf/ipa-robot-accuracy on GitHub. Save series B as a table with the columns
{joints} x y z qx qy qz qw (rad, m)
and give its path."""


def compare(robot: Robot, path: Path, fraction: float) -> None:
    """Calibrate without and with elasticity, and print the errors at poses that the fits have not seen."""
    table = read_measurements(path, robot.joint_names)
    models = {"geometric": Options(effects=GEOMETRIC), "elastic": Options(effects=ELASTIC)}
    found = {name: run_calibration(robot, table, options, test_fraction=fraction) for name, options in models.items()}
    first = found["geometric"].result
    errors = {"nominal": first.error["nominal"]["test"]}
    errors |= {name: calibration.result.error["calibrated"]["test"] for name, calibration in found.items()}
    print(f"UR10, {path.name}: {first.rows['train']} poses to fit, {first.rows['test']} held out; position errors [mm]")
    print(f"  {'model':10s} {'mean':>8s} {'rms':>8s} {'p95':>8s} {'max':>8s}  {FOLDS}-fold mean")
    crossed = 0.0
    for name, error in errors.items():
        shown = " ".join(f"{error[f'{word}_mm']:8.3f}" for word in ("mean", "rms", "p95", "max"))
        if name in models:
            residuals = cross_validate(robot, table, models[name], folds=FOLDS).residuals[:3]
            crossed = 1e3 * float(np.linalg.norm(residuals, axis=0).mean())
            shown += f"  {crossed:11.3f}"
        print(f"  {name:10s} {shown}")
    print(f"About {crossed:.1f} mm remains that neither geometry nor gravity explains.")
    print("Most of it follows the drives' own angles, as errors of gears do.")


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
        compare(robot, chosen.path, chosen.fraction)
    except PincalError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
