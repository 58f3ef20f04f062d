"""What is smooth and has no name, on a table of one's own: ``python tests/remainder_study.py ROBOT TABLE.csv``.

Each of eight parts of joint space is predicted by fits of the others, with elasticity alone and with the remainder that a
discovery would take after it, all parameters fitted again. Errors are means over the rows of a part.
"""

from __future__ import annotations

import argparse
import warnings

import numpy as np

from pincal import Options, Robot, calibrate
from pincal.discover.smooth_rest import predicting_remainder
from pincal.identify.calibrate import Tolerance, refit
from pincal.identify.fit import ModelFit
from pincal.identify.split import row_groups
from pincal.measure.table import read_measurements
from pincal.model.effects import ELASTIC

PARTS = 8


def left_out(fit: ModelFit, part: np.ndarray) -> np.ndarray:
    """Return the mean error [mm] of each part by a fit of the others; parts have shape (N,)."""
    found = []
    for k in range(PARTS):
        others = fit.select(np.flatnonzero(part != k))
        again = refit(others, fit.options.effects, start={}, until=Tolerance.CLOSE)
        (station,) = fit.select(np.flatnonzero(part == k)).problem.stations
        found.append(1e3 * float(np.mean(np.linalg.norm(station.displacements(again.values), axis=1))))
    return np.array(found)


def main() -> None:
    """Print the errors of each part without and with the remainder."""
    parser = argparse.ArgumentParser(description="Print what a smooth remainder gains at regions that are left out.")
    parser.add_argument("robot", help="URDF, or the name of a robot, as for pincal calibrate")
    parser.add_argument("table", help="measured poses")
    chosen = parser.parse_args()
    warnings.simplefilter("ignore")
    robot = Robot.from_urdf(chosen.robot)
    rows = read_measurements(chosen.table, robot)
    part = row_groups(rows, split="blocked", seed=0) % PARTS
    fit = calibrate(robot, rows, Options(effects=ELASTIC)).fit
    errors = [left_out(fit, part)]
    remainder = predicting_remainder(fit, part)
    if remainder is None:
        print("nothing smooth predicts each part better")
    else:
        print(f"remainder over {remainder.length:g} rad, prior of {1e6 * remainder.size:.0f} urad")
        errors.append(left_out(refit(fit, [*fit.options.effects, remainder], start={}), part))
    weights = np.bincount(part) / len(part)
    for words, of in zip(("without", "with"), errors, strict=False):
        print(f"{words:8}", " ".join(f"{error:.4f}" for error in of), f"mean {of @ weights:.4f} mm")


if __name__ == "__main__":
    main()
