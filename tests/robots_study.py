"""README's five lines on every robot at hand: ``python tests/robots_study.py [--skip COMMAND] [ROBOT ...]``.

Each robot of example-robot-data and of the published descriptions beside this project, as it is and without an option: is
it simulated, checked, calibrated, searched, are programs compensated and later rows diagnosed, and how large is the error on
poses held out. ``--skip discover`` takes a fourth of the time (8 minutes). Exit codes count.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import json
import os
import tempfile
import time
import warnings
from pathlib import Path

from example_robot_data.robots_loader import ROBOTS
from test_every_robot import PUBLISHED

from pincal.cli import main as pincal

FOLDER = next((f / "shared/robots" for f in Path(__file__).resolve().parents if (f / "shared/robots").is_dir()), None)
SIMULATIONS = ("--poses 60 --seed 1 --out tracker.csv", "--poses 20 --seed 1 --pose-seed 2 --out new.csv")


def answer(*words: str) -> tuple[int, str]:
    """Return the exit code of a command, and the last line of what it wrote to stderr."""
    said, code = io.StringIO(), 0
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(said), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            pincal(list(words))
        except SystemExit as ended:
            code = int(ended.code or 0)
    lines = [line for line in said.getvalue().splitlines() if line.strip()]
    return code, lines[-1].strip() if lines else ""


def five_lines(robot: str, options: list[str], skipped: list[str]) -> tuple[str, str]:
    """Return what failed with its message, "" for nothing, and the error on poses held out."""
    for words in SIMULATIONS:
        code, said = answer("simulate", robot, *words.split(), *options)
        if code:
            return f"simulate {code}: {said}", ""
    rows = list(csv.reader(Path("tracker.csv").read_text().splitlines()))
    count = rows[0].index("x")
    Path("program.csv").write_text("\n".join(",".join(row[:count]) for row in rows[:11]) + "\n")
    lines = (
        ["check", robot, "tracker.csv", *options],
        ["calibrate", robot, "tracker.csv", "--out", "results", *options],
        ["discover", robot, "tracker.csv", "--out", "results", *options],
        ["compensate", "results/model.json", "program.csv", "--out", "corrected.csv"],
        ["diagnose", "results/model.json", "new.csv", "--out", "diagnosis"],
    )
    failed = []
    for words in lines:
        code, said = (0, "") if words[0] in skipped else answer(*words)
        failed += [f"{words[0]} {code}: {said}"] if code else []
    held_out = ""
    if Path("results/result.json").exists():
        error = json.loads(Path("results/result.json").read_text(encoding="utf-8"))["error"]["calibrated"]["test"]
        held_out = f"{error['rms_mm']:.3f} mm"
    return "; ".join(failed), held_out


def main() -> None:
    """Print a line for each robot, and how many needed no help."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robots", nargs="*", metavar="ROBOT", help="all without any")
    parser.add_argument("--skip", action="append", default=[], metavar="COMMAND")
    given = parser.parse_args()
    published = {str(FOLDER / path): list(options) for path, options in PUBLISHED.items()} if FOLDER else {}
    robots = {name: list[str]() for name in ROBOTS} | published
    chosen = given.robots or [*robots]
    home, sound = Path.cwd(), 0
    for robot in chosen:
        begun = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            try:
                failed, held_out = five_lines(robot, robots.get(robot, []), given.skip)
            finally:
                os.chdir(home)
        sound += not failed
        print(f"{Path(robot).stem:28s} {failed or 'ok'} {held_out} {time.perf_counter() - begun:.0f} s", flush=True)
    print(f"{sound} of {len(chosen)} without an option")


if __name__ == "__main__":
    main()
