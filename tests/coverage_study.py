"""How often intervals of predictions hold the readings of arms at poses that were never fitted.

``python tests/coverage_study.py real`` calibrates on a part of each real series of ``../shared/data`` and predicts the rest:
whole regions of joint space, the last stretch of the rows, or all but a few poses. ``other`` predicts the other series of
the same UR10, placed by some of its rows; ``sockets`` the arms whose ball was held in sockets, each place and regions of
joint space left out; ``elastic`` the simulated elastic arms; ``fleet`` arms with the geometry of its machines;
``simulated`` arms with something hidden that the model may not describe; ``rows`` the kinds of tables of ``rows_study.py``.

A coordinate counts as held if it is within 1.96 (95 %) or 1.0 (68 %) standard uncertainties of its prediction. Rates of one
calibration have the exact interval (Clopper and Pearson) for as many independent coordinates as blocks of rows show (Korn
and Graubard 1998); in those of several each calibration is one block.
"""

import argparse
import sys
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from coverage_figures import BLOCKS, Judged, Totals
from discovery_cases import FOREIGN, NAMED, draw_case
from fleet_cases import NOISE, nominal_arm, real_machines, table_of
from row_cases import KINDS as ROW_KINDS
from row_cases import draw_rows_case
from scipy.cluster.vq import kmeans2

import pincal
from pincal import Measurements, Robot, read_measurements, run_calibration
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.placing import place_station
from pincal.errors import PincalError
from pincal.identify.options import Options
from pincal.measure.measurements import concatenate
from pincal.model.chain import MomentFrame

DATA = Path(__file__).parents[2] / "shared" / "data"
# Series -> the robot, the file, every how many-th of its rows, the noise of its instrument [m].
SERIES = {
    "ur10_A": ("ur10", "ur10_tmac/series_A.csv", 4, 5e-5),
    "ur10_B": ("ur10", "ur10_tmac/series_B.csv", 1, 5e-5),
    "ur5": ("ur5", "ur5_tracker/grid.csv", 1, 2e-5),
}
# Arms held in sockets: the robot, or its file, and the tables.
SOCKETS = {
    "panda": ("panda", ("panda_sockets/panda_3.csv",)),
    "holiday_panda": ("holiday_sockets/panda.urdf", tuple(f"holiday_sockets/panda_{k}.csv" for k in "ABC")),
    "holiday_xarm6": ("holiday_sockets/xarm6.urdf", tuple(f"holiday_sockets/xarm6_{k}.csv" for k in "AB")),
}
KINDS = ("null", *FOREIGN, *NAMED)
WAYS = ("regions", "stretch", "subset")
GROUPS = ("real", "other", "sockets", "elastic", "fleet", "simulated", "rows")
# Regions of joint space, and how many of them are left out; the part of rows otherwise.
REGIONS, LEFT_OUT, PART = 10, 3, 0.3
# Rows of simulated arms that are predicted, of real ones at most, and those that place another series.
FRESH, MOST, PLACING = 300, 1000, 30
# A reading farther from its prediction than this multiple of the median is wrong.
WRONG = 6.0

Case = tuple[str, Judged, str]


def table_of_series(series: str) -> tuple[Robot, Measurements, float]:
    """Return robot, rows and noise of a series."""
    name, path, every, noise = SERIES[series]
    robot = Robot.from_urdf(name)
    table = read_measurements(DATA / path, robot)
    return robot, table.select(np.arange(0, len(table), every)), noise


def left_out_of(table: Measurements, way: str, rows: int, seed: int) -> np.ndarray:
    """Return which rows may not be fitted, shape (N,)."""
    rng = np.random.default_rng(seed)
    if way == "regions":
        spread = (table.q - table.q.mean(axis=0)) / np.maximum(table.q.std(axis=0), 1e-9)
        region = kmeans2(spread, REGIONS, rng=np.random.default_rng(seed), minit="++")[1]
        return np.isin(region, rng.choice(REGIONS, LEFT_OUT, replace=False))
    if way == "stretch":
        return np.arange(len(table)) >= int((1.0 - PART) * len(table))
    return ~np.isin(np.arange(len(table)), rng.choice(len(table), min(rows, len(table) // 2), replace=False))


def divided(table: Measurements, way: str, rows: int, seed: int) -> tuple[Measurements, Measurements]:
    """Return rows to fit, as many at most, and rows to predict."""
    out = left_out_of(table, way, rows, seed)
    rng = np.random.default_rng(seed)
    some = np.sort(rng.choice(np.flatnonzero(~out), min(rows, int(np.sum(~out))), replace=False))
    others = np.sort(rng.permutation(np.flatnonzero(out))[:MOST])
    return table.select(some), table.select(others)


def judged(model: FittedRobot, rows: Measurements, noise: float, *, in_order: bool = False) -> Judged:
    """Return the predictions of rows that were not fitted."""
    station = model.readings(rows)
    off = station.displacements(model.values)
    size = np.linalg.norm(off, axis=1)
    kept = np.flatnonzero(size < WRONG * np.median(size))
    block = np.arange(len(kept)) * BLOCKS // len(kept) if in_order else None
    return Judged(model, station.conditions.select(kept), off[kept], noise, block)


def real(arguments: argparse.Namespace) -> Iterator[Case]:
    """Yield predictions of what was left out of real series."""
    for series in arguments.series:
        robot, table, noise = table_of_series(series)
        for way in arguments.ways:
            for seed in range(arguments.seeds if way != "stretch" else 1):
                fitted, others = divided(table, way, arguments.rows, seed)
                for declared in (True, False):
                    options = Options(sigma=noise) if declared else Options()
                    found = run_calibration(robot, fitted, options)
                    name = f"{series} {way} {seed}, {'' if declared else 'no '}noise declared"
                    of = judged(found.fit, others, noise if declared else 0.0, in_order=way == "stretch")
                    yield name, of, found.result.verdict_of().value


def other(arguments: argparse.Namespace) -> Iterator[Case]:
    """Yield predictions of the other series of an arm, placed by some of its rows."""
    for first, second in (("ur10_A", "ur10_B"), ("ur10_B", "ur10_A")):
        robot, table, noise = table_of_series(first)
        fitted, _ = divided(table, "subset", arguments.rows, 0)
        found = run_calibration(robot, fitted, Options(sigma=noise))
        for seed in range(arguments.seeds):
            placing, others = divided(table_of_series(second)[1], "subset", PLACING, seed)
            placed = place_station(found.fit, placing).model
            yield (
                f"{first} at {second} {seed}",
                judged(placed, others, noise),
                found.result.verdict_of().value,
            )


def sockets(arguments: argparse.Namespace) -> Iterator[Case]:
    """Yield predictions of left-out rows in sockets: in one socket the ball was always in one place."""
    for name, (robot_of, paths) in SOCKETS.items():
        is_file = robot_of.endswith(".urdf")
        robot = Robot.from_urdf(DATA / robot_of if is_file else robot_of)
        tables = [read_measurements(DATA / path, robot) for path in paths]
        table = tables[0] if len(tables) == 1 else concatenate(tables)
        assert table.socket is not None
        place = np.array([str(socket).rstrip("/0123456789") for socket in table.socket])
        divisions = {f"place {of}": place == of for of in np.unique(place)}
        for seed in range(arguments.seeds):
            divisions[f"regions {seed}"] = left_out_of(table, "regions", arguments.rows, seed)
        for division, out in divisions.items():
            found = run_calibration(robot, table.select(~out), Options())
            yield f"{name} {division}", in_sockets(found.fit, table.select(out)), found.result.verdict_of().value


def in_sockets(model: FittedRobot, rows: Measurements) -> Judged:
    """Return the predictions of contacts that were not fitted, relative to each other."""
    assert rows.socket is not None
    socket = np.unique(rows.socket, return_inverse=True)[1]
    conditions = model.readings(rows).conditions
    places = model.predict(conditions)[:, :, 3]
    middle = np.array([np.median(places[socket == of], axis=0) for of in range(int(socket.max()) + 1)])
    size = np.linalg.norm(places - middle[socket], axis=1)
    kept = np.flatnonzero(size < WRONG * np.median(size))
    return Judged(model, conditions.select(kept), -places[kept], 0.0, socket=socket[kept])


def elastic(arguments: argparse.Namespace) -> Iterator[Case]:
    """Yield predictions of the simulated elastic arms, of which the readings to predict have no noise."""
    frames: dict[str, MomentFrame] = {"elastic_after": "after", "elastic_paper": "paper"}
    for folder, frame in frames.items():
        robot = Robot.from_urdf(DATA / folder / "robot.urdf")
        train = read_measurements(DATA / folder / "train.csv", robot)
        held = read_measurements(DATA / folder / "heldout.csv", robot)
        for seed in range(arguments.seeds):
            fitted, _ = divided(train, "subset", arguments.rows, seed)
            found = run_calibration(robot, fitted, Options(moment_frame=frame, sigma=5e-5))
            yield f"{folder} {seed}", judged(found.fit, held, 0.0), found.result.verdict_of().value


def fleet(arguments: argparse.Namespace) -> Iterator[Case]:
    """Yield predictions of arms with the geometry of real ones, and no other errors."""
    for kind, name, machine in real_machines():
        robot = nominal_arm(kind)
        found = run_calibration(robot, table_of(robot, machine, arguments.rows, 0), Options(sigma=NOISE))
        truth = table_of(robot, machine, FRESH, 1, noise=0.0)
        yield name, judged(found.fit, truth, 0.0), found.result.verdict_of().value


def simulated(arguments: argparse.Namespace) -> Iterator[Case]:
    """Yield predictions of drawn arms at poses that were not fitted, against the truth."""
    for kind in arguments.kinds:
        for seed in range(arguments.seeds):
            case = draw_case(kind, seed, n=arguments.rows + FRESH)
            order = np.random.default_rng(seed).permutation(len(case.rows))
            fitted, fresh = np.sort(order[: arguments.rows]), np.sort(order[arguments.rows :])
            options = replace(case.options, effects=Options().effects)
            found = run_calibration(case.robot, case.rows.select(fitted), options)
            conditions = found.fit.readings(case.rows.select(fresh)).conditions
            off = case.clean[fresh] - found.fit.predict(conditions)[:, :, 3]
            yield f"{kind} {seed}", Judged(found.fit, conditions, off, 0.0), found.result.verdict_of().value


def rows(arguments: argparse.Namespace) -> Iterator[Case]:
    """Yield predictions after tables as they are measured in the world, against the truth."""
    for kind in ROW_KINDS:
        for seed in range(arguments.seeds):
            case = draw_rows_case(kind, seed)
            try:
                found = run_calibration(case.robot, case.rows, replace(case.options, effects=Options().effects))
            except PincalError as error:
                print(f"{kind} {seed}: refused: {error}", flush=True)
                continue
            table, clean = case.fresh(FRESH)
            conditions = found.fit.readings(table).conditions
            off = clean - found.fit.predict(conditions)[:, :, 3]
            of = Judged(found.fit, conditions, off, 0.0, apart=("arrival",))
            yield f"{kind} {seed}", of, found.result.verdict_of().value


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("group", choices=GROUPS)
    parser.add_argument("--series", nargs="+", choices=SERIES, default=list(SERIES))
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--rows", type=int, default=300, help="that are fitted (300)")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS), help="what is hidden of simulated arms")
    parser.add_argument("--only-points", action="store_true", help="no differences and features")
    return parser.parse_args()


def main() -> None:
    """Print a line for each calibration and figure, and the totals."""
    arguments = _arguments()
    warnings.simplefilter("ignore", pincal.PincalWarning)
    if arguments.group not in ("simulated", "rows") and not DATA.exists():
        sys.exit(f"{DATA} is not there: these are real measurements, of which the project holds no copy")
    totals = Totals()
    for name, of, verdict in globals()[arguments.group](arguments):
        for figure, held in of.figures(0):
            totals.add(figure, held)
            print(f"{name}, {verdict}: {figure} {held}", flush=True)
            if arguments.only_points:
                break
    for line in totals.words():
        print(line, flush=True)


if __name__ == "__main__":
    main()
