"""How often intervals of predictions hold the readings of real arms at poses that were never fitted.

``python tests/coverage_study.py`` calibrates on a part of each real series of ``../shared/data`` and predicts the rest:
whole regions of joint space, the last stretch of the rows, or poses at random. A coordinate of a position counts as held if
it is within 1.96 (95 %) or 1.0 (68 %) standard uncertainties of its prediction. Coordinates are not independent: the rate of
one split says no more than those of several beside it.
"""

import argparse
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from discovery_cases import FOREIGN, NAMED, draw_case
from feature_maps import APART, FEATURES, difference, near_rows, pairs_apart
from scipy.cluster.vq import kmeans2

import pincal
from pincal import Measurements, Robot, read_measurements, run_calibration
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.position_covariance import SharedErrors
from pincal.identify.options import Options
from pincal.model.conditions import Conditions

DATA = Path(__file__).parents[2] / "shared" / "data"
# Series -> the robot, the file, every how many-th of its rows, the noise of its instrument [m].
SERIES = {
    "ur10_A": ("ur10", "ur10_tmac/series_A.csv", 4, 5e-5),
    "ur10_B": ("ur10", "ur10_tmac/series_B.csv", 1, 5e-5),
    "ur5": ("ur5", "ur5_tracker/grid.csv", 1, 2e-5),
}
KINDS = ("null", *FOREIGN, *NAMED)
WAYS = ("regions", "stretch", "random")
# Regions of joint space, and how many of them are left out; the part of rows otherwise.
REGIONS, LEFT_OUT, PART = 10, 3, 0.3
# Rows of simulated arms that are fitted, and predicted.
FITTED, FRESH = 150, 300
# A reading farther from its prediction than this multiple of the median is wrong.
WRONG = 6.0
# Pairs and features of each kind that are drawn from the rows, and as few pairs as are worth a rate.
SETS, FEWEST = 150, 30


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


@dataclass(frozen=True)
class Held:
    """How far linear functions of predicted positions are off, and their standard uncertainties, shape (M,) each."""

    off: np.ndarray
    u: np.ndarray

    def __str__(self) -> str:
        ratio = np.abs(self.off) / self.u
        held = [100.0 * float(np.mean(ratio < k)) for k in (1.96, 1.0)]
        width = 1.96 / float(np.quantile(ratio, 0.95))
        return f"{held[0]:.1f} (68: {held[1]:.1f}, width {width:.2f})"


@dataclass(frozen=True)
class Judged:
    """Rows that were not fitted, with their predictions.

    Attributes:
        model: the fitted robot.
        conditions: of N rows.
        off: shape (N, 3), reading minus prediction [m].
        noise: standard uncertainty of a coordinate that was declared of readings [m].
    """

    model: FittedRobot
    conditions: Conditions
    off: np.ndarray
    noise: float

    def of_points(self) -> Held:
        """Return the coordinates of all positions."""
        variance = sum(self.model.position_variances(self.conditions).values()) + self.noise**2
        return Held(self.off.ravel(), np.sqrt(variance).ravel())

    def of_map(self, sets: list[np.ndarray], make: Callable[[np.ndarray], np.ndarray]) -> tuple[Held, float]:
        """Return what maps make of sets of rows, and the mean u as a part of that of independent positions."""
        places = self.model.predict(self.conditions)[:, :, 3]
        off, together, alone = [], [], []
        for rows in sets:
            A = make(places[rows])
            covariance = self.model.covariance_of(self.conditions.select(rows))
            noise = self.noise**2 * A @ A.T
            of_each = SharedErrors.of_each(covariance.blocks)
            off.append(A @ self.off[rows].ravel())
            together.append(np.sqrt(np.diag(covariance.through(A) + noise)))
            alone.append(np.sqrt(np.diag(of_each.through(A) + noise)))
        u = np.concatenate(together)
        return Held(np.concatenate(off), u), float(np.mean(u) / np.mean(np.concatenate(alone)))

    def of_features(self, seed: int) -> Iterator[str]:
        """Yield what intervals of differences and features hold, in words."""
        places = self.model.predict(self.conditions)[:, :, 3]
        rng = np.random.default_rng(seed)
        for apart in APART:
            pairs = pairs_apart(places, apart, SETS, rng)
            if len(pairs) >= FEWEST:
                held, part = self.of_map(pairs, difference)
                yield f"{1e3 * apart:.0f} mm apart {held} u/alone {part:.2f}"
        for name, (n, make) in FEATURES.items():
            if len(places) >= 2 * n:
                held, part = self.of_map([near_rows(places, n, rng) for _ in range(SETS)], make)
                yield f"{name} {held} u/alone {part:.2f}"


def judged(of: Split, *, declared: bool) -> tuple[Judged, str]:
    """Return the predictions of the rows that were left out, by a calibration with the others, and its verdict."""
    options = Options(sigma=of.noise) if declared else Options()
    found = run_calibration(of.robot, of.fitted, options)
    model = found.fit
    station = model.readings(of.predicted)
    off = station.displacements(model.values)
    size = np.linalg.norm(off, axis=1)
    kept = np.flatnonzero(size < WRONG * np.median(size))
    noise = of.noise if declared else 0.0
    return Judged(model, station.conditions.select(kept), off[kept], noise), found.result.verdict_of().value


def simulated(kind: str, seed: int) -> tuple[Judged, str]:
    """Return predictions of a drawn arm at poses that were not fitted, against the truth, and the verdict."""
    case = draw_case(kind, seed, n=FITTED + FRESH)
    order = np.random.default_rng(seed).permutation(len(case.rows))
    fitted, fresh = np.sort(order[:FITTED]), np.sort(order[FITTED:])
    options = replace(case.options, effects=Options().effects)
    found = run_calibration(case.robot, case.rows.select(fitted), options)
    station = found.fit.readings(case.rows.select(fresh))
    off = case.clean[fresh] - found.fit.predict(station.conditions)[:, :, 3]
    return Judged(found.fit, station.conditions, off, 0.0), found.result.verdict_of().value


def covered(of: Split, *, declared: bool, seed: int) -> str:
    """Return how many coordinates, differences and features intervals hold, and how wide they are, in words."""
    return in_words(*judged(of, declared=declared), seed=seed)


def in_words(found: Judged, verdict: str, *, seed: int) -> str:
    """Return how many coordinates, differences and features intervals hold, and how wide they are, in words."""
    points = found.of_points()
    rms = [1e3 * float(np.sqrt(np.mean(size**2))) for size in (points.u, points.off)]
    words = "; ".join([f"points {points}", *found.of_features(seed)])
    return f"{verdict}; {words}; u {rms[0]:.3f} mm, error {rms[1]:.3f} mm rms a coordinate"


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
    parser.add_argument(
        "--kinds", nargs="+", choices=KINDS, default=[], help="simulated arms instead: what is hidden of them"
    )
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", pincal.PincalWarning)
    for kind in arguments.kinds:
        for seed in range(arguments.seeds):
            print(f"{kind:20s} seed {seed}: {in_words(*simulated(kind, seed), seed=seed)}", flush=True)
    if arguments.kinds:
        return
    if not DATA.exists():
        sys.exit(f"{DATA} is not there: these are real measurements, of which the project holds no copy")
    for series, way, seed, declared in cases(arguments):
        found = covered(split(series, way, arguments.rows, seed), declared=declared, seed=seed)
        noise = "noise declared" if declared else "no noise declared"
        print(f"{series:7s} {way:8s} seed {seed}, {noise}: {found}", flush=True)


if __name__ == "__main__":
    main()
