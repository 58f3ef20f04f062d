"""How often intervals of predictions hold the readings of real arms at poses that were never fitted.

``python tests/coverage_study.py`` calibrates on a part of each real series of ``../shared/data`` and predicts the rest:
whole regions of joint space, the last stretch of the rows, or poses at random. A coordinate of a position counts as held if
it is within 1.96 (95 %) or 1.0 (68 %) standard uncertainties of its prediction. Coordinates are not independent: the rate of
one split says no more than those of several beside it.
"""

import argparse
import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.cluster.vq import kmeans2

import pincal
from pincal import Measurements, Robot, read_measurements, run_calibration
from pincal.identify.options import Options

DATA = Path(__file__).parents[2] / "shared" / "data"
# Series -> the robot, the file, every how many-th of its rows, the noise of its instrument [m].
SERIES = {
    "ur10_A": ("ur10", "ur10_tmac/series_A.csv", 4, 5e-5),
    "ur10_B": ("ur10", "ur10_tmac/series_B.csv", 1, 5e-5),
    "ur5": ("ur5", "ur5_tracker/grid.csv", 1, 2e-5),
}
WAYS = ("regions", "stretch", "random")
# Regions of joint space, and how many of them are left out; the part of rows otherwise.
REGIONS, LEFT_OUT, PART = 10, 3, 0.3
# A reading farther from its prediction than this multiple of the median is wrong.
WRONG = 6.0


@dataclass(frozen=True)
class Split:
    """Rows to fit, and rows to predict."""

    robot: Robot
    fitted: Measurements
    predicted: Measurements
    noise: float


def split(series: str, way: str, rows: int, seed: int) -> Split:
    """Return a division of a series."""
    name, path, every, noise = SERIES[series]
    robot = Robot.from_urdf(name)
    table = read_measurements(DATA / path, robot)
    table = table.select(np.arange(0, len(table), every))
    rng = np.random.default_rng(seed)
    out = np.zeros(len(table), bool)
    if way == "regions":
        spread = (table.q - table.q.mean(axis=0)) / np.maximum(table.q.std(axis=0), 1e-9)
        region = kmeans2(spread, REGIONS, rng=np.random.default_rng(seed), minit="++")[1]
        out = np.isin(region, rng.choice(REGIONS, LEFT_OUT, replace=False))
    elif way == "stretch":
        out[int((1.0 - PART) * len(table)) :] = True
    else:
        out = rng.random(len(table)) < PART
    others = np.flatnonzero(~out)
    some = np.sort(rng.choice(others, min(rows, len(others)), replace=False))
    return Split(robot, table.select(some), table.select(np.flatnonzero(out)), noise)


def covered(of: Split, *, declared: bool) -> str:
    """Return how many coordinates intervals hold, and how wide these are, in words."""
    options = Options(sigma=of.noise) if declared else Options()
    found = run_calibration(of.robot, of.fitted, options)
    model = found.fit
    station = model.readings(of.predicted)
    off = station.displacements(model.values)
    size = np.linalg.norm(off, axis=1)
    kept = size < WRONG * np.median(size)
    sources = model.position_variances(station.conditions)
    held = {
        name: [float(np.mean(np.abs(off[kept]) < k * np.sqrt(variance[kept]))) for k in (1.96, 1.0)]
        for name, variance in (("all", sum(sources.values())), ("parameters alone", sources["parameters"]))
    }
    words = "; ".join(f"{name} {100 * a:.1f} % (68: {100 * b:.1f} %)" for name, (a, b) in held.items())
    u = float(np.sqrt(np.mean(sum(sources.values())[kept])))
    rms = float(np.sqrt(np.mean(off[kept] ** 2)))
    return f"{found.result.verdict_of().value}; {words}; u {1e3 * u:.3f} mm, error {1e3 * rms:.3f} mm rms a coordinate"


def cases(arguments: argparse.Namespace) -> Iterator[tuple[str, str, int, bool]]:
    """Yield series, way, seed and whether the noise is declared."""
    for series in arguments.series:
        for way in arguments.ways:
            for seed in range(arguments.seeds if way != "stretch" else 1):
                for declared in (True, False):
                    yield series, way, seed, declared


def main() -> None:
    """Print a line for each case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--series", nargs="+", choices=SERIES, default=list(SERIES))
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--rows", type=int, default=300)
    arguments = parser.parse_args()
    if not DATA.exists():
        sys.exit(f"{DATA} is not there: these are real measurements, of which the project holds no copy")
    warnings.simplefilter("ignore", pincal.PincalWarning)
    for series, way, seed, declared in cases(arguments):
        found = covered(split(series, way, arguments.rows, seed), declared=declared)
        noise = "noise declared" if declared else "no noise declared"
        print(f"{series:7s} {way:8s} seed {seed}, {noise}: {found}", flush=True)


if __name__ == "__main__":
    main()
