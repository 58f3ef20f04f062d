"""Add a line to the history of speed, ``docs/benchmark_history.csv``: ``python tests/benchmark_history.py [TAG]``.

One line a release. Times of two days or machines can't be compared, so the release before (``TAG``) is checked out and timed
again, in turns with this one, and the line holds the ratios as well: the median over the turns of this over the last. Before
a release the line is called as the changelog calls it, "Unreleased", and a new one takes its place. Times are those of the
processor, on one thread, so that what else the machine does matters little.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
HISTORY = ROOT / "docs" / "benchmark_history.csv"
# What is timed, with its unit: by public names alone, as an old release has to run it, too.
FIGURES = ("import_s", "calibrate_1000_ms", "predict_10000_ms", "compensate_1000_ms", "discover_500_s")
COLUMNS = ("version", "date", "commit", *FIGURES, *(f"{figure}_ratio" for figure in FIGURES))
_TURNS, _CALLS = 5, 5


def probe(rows: int = 1000) -> dict[str, float]:
    """Return the figures of the pincal that is imported here, each the best of a few calls."""
    begun = time.process_time()
    import pincal

    pincal.calibrate  # noqa: B018
    found = {"import_s": time.process_time() - begun}
    from pincal.builtin import kuka_urdf_path
    from pincal.simulate import paper_positions

    robot, rng = pincal.Robot.from_urdf(kuka_urdf_path()), np.random.default_rng(0)
    q = robot.random_configurations(10 * rows, rng)
    position = paper_positions(q[:rows], tool_offset=(0.05, 0.03, 0.12), with_elasticity=False)
    table = pincal.measurements_from_arrays(
        robot.joint_names, q[:rows], position=position + rng.normal(0.0, 5e-5, position.shape)
    )
    options = pincal.Options(effects=pincal.GEOMETRIC, sigma=5e-5)
    fit = pincal.calibrate(robot, table, options)
    model, program = fit.at(), pincal.Conditions.at(q[:rows])
    found["calibrate_1000_ms"] = 1e3 * _best(lambda: pincal.calibrate(robot, table, options))
    found["predict_10000_ms"] = 1e3 * _best(lambda: model.predict(q))
    found["compensate_1000_ms"] = 1e3 * _best(lambda: pincal.compensate_program(model, program))
    found["discover_500_s"] = _best(lambda: pincal.run_discovery(robot, table.select(np.arange(rows // 2))), 2)
    return found


def _best(call: Callable[[], object], calls: int = _CALLS) -> float:
    """Return the shortest time of several calls [s], after one to warm up."""
    taken = []
    for _ in range(calls + 1):
        begun = time.process_time()
        call()
        taken.append(time.process_time() - begun)
    return min(taken[1:])


def _probed(checkout: Path) -> dict[str, float]:
    """Return the figures of a checkout, from a process of its own on one thread."""
    threads = {f"{name}_NUM_THREADS": "1" for name in ("NUMBA", "OPENBLAS", "OMP", "MKL")}
    environment = os.environ | threads | {"PYTHONPATH": str(checkout)}
    command = [sys.executable, str(Path(__file__).resolve()), "--probe"]
    done = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    found: dict[str, float] = json.loads(done.stdout)
    return found


def current() -> str:
    """Return what the changelog calls this version."""
    return (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").partition("\n## ")[2].split()[0]


def line(last: Path | None) -> dict[str, str]:
    """Return the line of this release, paired against the checkout of the last one."""
    turns = [(_probed(ROOT), _probed(last) if last else None) for _ in range(_TURNS)]
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, check=True, capture_output=True, text=True)
    told = {
        "version": current(),
        "date": time.strftime("%Y-%m-%d"),
        "commit": commit.stdout.strip(),
    }
    for figure in FIGURES:
        told[figure] = f"{min(new[figure] for new, _ in turns):.3g}"
        ratios = [new[figure] / old[figure] for new, old in turns if old is not None]
        told[f"{figure}_ratio"] = f"{np.median(ratios):.3f}" if ratios else ""
    return told


def main() -> None:
    """Add a line, and print it."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("tag", nargs="?", help="the release before; none for the first")
    parser.add_argument("--probe", action="store_true", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.probe:
        print(json.dumps(probe()))
        return
    with tempfile.TemporaryDirectory() as folder:
        last = Path(folder) / "last" if chosen.tag else None
        if last is not None:
            subprocess.run(["git", "worktree", "add", "--detach", str(last), chosen.tag], cwd=ROOT, check=True)
        try:
            told = line(last)
        finally:
            if last is not None:
                subprocess.run(["git", "worktree", "remove", "--force", str(last)], cwd=ROOT, check=True)
    earlier = list(csv.DictReader(HISTORY.open(encoding="utf-8"))) if HISTORY.exists() else []
    with HISTORY.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows([*(row for row in earlier if row["version"] not in ("Unreleased", told["version"])), told])
    print(", ".join(f"{name} {value}" for name, value in told.items()))


if __name__ == "__main__":
    main()
