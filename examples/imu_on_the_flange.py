"""An IMU on the flange and eight poses measured with a tracker: the accuracy with each alone, and with both together."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

import pincal
from pincal.cli import main


def run(*words: str) -> None:
    """Run a command; it ends with its exit code."""
    try:
        main([*words, "--quiet"])
    except SystemExit as done:
        assert not done.code, words


def simulated(folder: Path) -> tuple[Path, Path, Path]:
    """Drive the same UR5 for a minute with an IMU, measure eight poses with a tracker, and a hundred others to validate."""
    machine = ["ur5", "--elastic", "0", "--seed", "3"]
    files = folder / "monday", folder / "eight.csv", folder / "judge.csv"
    run("simulate", *machine, "--path", "60s", "--imu", "--out", str(files[0]))
    run("simulate", *machine, "--poses", "8", "--noise", "0.05mm", "--out", str(files[1]))
    run("simulate", *machine, "--poses", "100", "--pose-seed", "9", "--noise", "0mm", "--out", str(files[2]))
    return files


def error(robot: pincal.FittedRobot, table: pincal.Measurements) -> float:
    """Return the mean error at other poses, with instrument and target located again [mm]."""
    placed = pincal.place_station(robot, table)
    return 1e3 * float(np.mean(np.linalg.norm(placed.station.residuals(placed.values), axis=0)))


with tempfile.TemporaryDirectory() as place:
    monday, eight, judge = simulated(Path(place))
    robot = pincal.Robot.from_urdf("ur5")
    table, options = pincal.read_measurements(judge, robot), pincal.Options(effects=pincal.GEOMETRIC, sigma=5e-5)
    for words, files in (("IMU alone", [monday]), ("8 poses alone", [eight]), ("8 poses and IMU", [eight, monday])):
        fit = pincal.calibrate(robot, files, options)
        print(f"{words:16s} mean error elsewhere {error(fit, table):.3f} mm")
