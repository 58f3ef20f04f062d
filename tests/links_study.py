"""How well a hand that no tracker saw is predicted after contacts: ``python tests/links_study.py [MACHINES]``.

Baxter's hands touch in two sockets, 300 rows, and a tracker sees the left hand, 150 rows, noise 0.05 mm each. Printed are
the mean errors of the right hand against exact positions at 300 other poses, of this calibration and of one by 150 rows of a
tracker on the right hand itself; how much of it the intervals of 95 % cover; and the errors of the nominal robot and of a
calibration by the contacts alone, without a known length.
"""

from __future__ import annotations

import logging
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pincal import Options, Robot, calibrate
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.placing import place_station
from pincal.cli.inputs import load_table
from pincal.measure.measurements import Measurements

HANDS = "left_gripper", "right_gripper"
SIGMA = 5e-5


def simulated(words: str, out: Path, robot: Robot) -> Measurements:
    """Return the table of a simulation."""
    command = [sys.executable, "-m", "pincal", "simulate", "baxter", *words.split(), "--no-floor", "--out", str(out)]
    subprocess.run(command, check=True, capture_output=True)
    return load_table(robot, out)


def judged(model: FittedRobot, table: Measurements) -> tuple[float, float]:
    """Return the mean error at exact positions once the instrument is placed [m], and the part within 1.96 sigma."""
    placed = place_station(model, table)
    residuals = placed.station.residuals(placed.values)
    sigma = placed.model.position_sigma(placed.model.conditions(table)).T
    return float(np.linalg.norm(residuals, axis=0).mean()), float(np.mean(np.abs(residuals) < 1.96 * sigma))


def main() -> None:
    """Print a line for each machine, and the means."""
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore")
    robot = Robot.from_urdf("baxter", start=HANDS[0], tip=HANDS[1], paths=[("base", hand) for hand in HANDS])
    found = []
    print(
        "machine  contacts and left [mm]  tracker on it [mm]  ratio  covered  covered by tracker  "
        "nominal [mm]  contacts alone [mm]  ratio  covered"
    )
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(int(sys.argv[1]) if len(sys.argv) > 1 else 5):
            at, noise = Path(folder), f"--seed {seed} --noise 0.05mm"
            left = simulated(f"--tip {HANDS[0]} --also {HANDS[1]} --poses 150 {noise}", at / "left.csv", robot)
            right = simulated(f"--tip {HANDS[1]} --also {HANDS[0]} --poses 150 {noise}", at / "right.csv", robot)
            words = f"--tip {HANDS[1]} --also {HANDS[0]} --poses 300 --seed {seed} --pose-seed {1000 + seed} --noise 0mm"
            exact = simulated(words, at / "exact.csv", robot)
            words = f"--from {HANDS[0]} --tip {HANDS[1]} --also {HANDS[0]} --sockets 2 --poses 300 {noise}"
            touch = simulated(words, at / "touch.csv", robot)
            options = Options(sigma=SIGMA, moment_frame="auto")
            both, alone = calibrate(robot, {"touch": touch, "left": left}, options), calibrate(robot, right, options)
            contacts = calibrate(robot, touch, options)
            nominal = calibrate(robot, right, Options(effects=(), sigma=SIGMA))
            (error, covered), (other, by_tracker) = judged(both.at("touch"), exact), judged(alone.at(), exact)
            (rest, held), before = judged(contacts.at(), exact), judged(nominal.at(), exact)[0]
            row = 1e3 * error, 1e3 * other, error / other, covered, by_tracker, 1e3 * before, 1e3 * rest, rest / before, held
            found.append(row)
            print(f"{seed:7d}  {words_of(row)}", flush=True)
    mean = np.mean(found, axis=0)
    mean[2], mean[7] = mean[0] / mean[1], mean[6] / mean[5]
    print(f"   mean  {words_of(mean)}")


def words_of(row: Sequence[float]) -> str:
    """Return a line of the table."""
    error, other, ratio, covered, by_tracker, before, rest, harm, held = row
    seen = f"{error:22.4f}  {other:18.4f}  {ratio:5.2f}  {covered:7.3f}  {by_tracker:18.3f}"
    return f"{seen}  {before:12.4f}  {rest:18.4f}  {harm:5.2f}  {held:7.3f}"


if __name__ == "__main__":
    main()
