"""Figures of speed, each beside its target: ``python tests/benchmark.py [PART ...]``.

``--help`` lists the parts; the quick ones are timed if none is named. All on one thread. Nothing here is a test: how
fast it is depends on what else the machine does, so medians of several rounds are printed, and best ones where a user
would call once.
"""

from __future__ import annotations

import os

# Numerical libraries read the number of their threads once, when they are loaded.
if __name__ == "__main__":
    for _name in ("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[_name] = "1"

import argparse
import gc
import json
import subprocess
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import polars as pl
from discovery_cases import draw_case
from fleet_cases import Family

import pincal
from pincal import ELASTIC, GEOMETRIC, Conditions, FittedRobot, Measurements, Options, Robot, read_measurements
from pincal.builtin import kuka_urdf_path
from pincal.calibration.covered import Covered
from pincal.calibration.discrepancy import Discrepancy
from pincal.compensate.ik_problem import Bounds, IkProblem
from pincal.compensate.solve_ik import solve_ik
from pincal.discover.policy import POLICY, Policy
from pincal.discover.run import Discovery, run_discovery
from pincal.fleet.jobs import CalibrateTables, run_job
from pincal.fleet.robot_type import learn_type
from pincal.fleet.store import open_store
from pincal.identify.calibrate import Tables, fit_tables
from pincal.identify.noise import Loss
from pincal.model.augmented import augmented_model
from pincal.model.chain import MOMENT_FRAMES, Chain
from pincal.model.effects import BearingElasticity, JointElasticity
from pincal.model.model import Model
from pincal.parameters import estimate_of
from pincal.robot.urdf_file import arm_text
from pincal.simulate import TrueMachine, paper_positions, plan_poses
from pincal.simulate.paper_machine import PAYLOAD_COM, PAYLOAD_MASS

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared" / "data"
GRID = DATA / "ur5_tracker" / "grid.csv"
ROBOT = Robot.from_urdf(kuka_urdf_path())
TOOL = (0.05, 0.03, 0.12)  # [m]
NOISE = 5e-5  # [m]
POSES, PINOCCHIO_POSES, ROUNDS = 10_000, 2_000, 7
CALLS = 9

Line = tuple[str, str, str, str]


def seconds(call: Callable[[], object], times: int) -> np.ndarray:
    """Return how long each of several calls takes, shape (times,) [s]."""
    taken = np.empty(times)
    for i in range(times):
        begun = time.perf_counter()
        call()
        taken[i] = time.perf_counter() - begun
    return taken


def line(name: str, measured: float, target: float | None, form: str) -> Line:
    """Return one line of the table: what, measured, target and whether it is met; ``form`` writes a number."""
    if target is None:
        return name, form.format(measured), "", ""
    return name, form.format(measured), "<= " + form.format(target), "met" if measured <= target else "MISSED"


def compare_with_pinocchio() -> Iterator[Line]:
    """Time prediction and exact Jacobian against Pinocchio's own functions, pose by pose, in turns."""
    first = ROBOT.joint_names[:3]
    chain = Chain.of(ROBOT)
    model = Model(chain, (*GEOMETRIC, JointElasticity(joints=first), BearingElasticity(joints=first)))
    rng = np.random.default_rng(0)
    values = np.array([p.size for p in model.parameters]) * rng.normal(0.0, 0.3, model.n_parameters)
    values[[p.unit.endswith("/(N m)") for p in model.parameters]] *= 1e-3
    q = ROBOT.random_configurations(POSES, rng)
    conditions = Conditions.at(q, payload=PAYLOAD_MASS, payload_centre=PAYLOAD_COM)

    augmented = augmented_model(chain, payload=PAYLOAD_MASS, payload_centre=np.array(PAYLOAD_COM))
    data, tip = augmented.createData(), augmented.getFrameId("tip")
    joints = slice(chain.joint(0, chain.symbols[6]), chain.tool("x"))
    rows = list(model.coordinates(values, conditions)[:PINOCCHIO_POSES, joints])
    assert len(rows[0]) == augmented.nq

    def by_pinocchio() -> None:
        for row in rows:
            pin.computeFrameJacobian(augmented, data, row, tip)
            pin.computeGeneralizedGravityDerivatives(augmented, data, row)

    def by_pincal() -> None:
        model.linearise(values, conditions)

    by_pincal()
    ours, theirs = np.empty(ROUNDS), np.empty(ROUNDS)
    for k in range(ROUNDS):
        theirs[k] = seconds(by_pinocchio, 1)[0] / PINOCCHIO_POSES * 1e6
        ours[k] = seconds(by_pincal, 1)[0] / POSES * 1e6
    print(f"chain of {augmented.nq} joints, {model.n_parameters} parameters, {POSES} poses ({PINOCCHIO_POSES} by Pinocchio)")
    yield line("Pinocchio in a loop, a pose", float(np.median(theirs)), None, "{:.2f} us")
    yield line("prediction and Jacobian, a pose", float(np.median(ours)), None, "{:.2f} us")
    yield line("ratio (medians)", float(np.median(ours) / np.median(theirs)), 0.25, "{:.3f}")


def time_uncertainty() -> Iterator[Line]:
    """Time the uncertainty of positions with what the model lacks, beside that of the parameters alone, in turns."""
    model = Model(Chain.of(ROBOT), (*ELASTIC, *GEOMETRIC))
    covariance = np.diag([(1e-3 * p.size) ** 2 for p in model.parameters])
    covered = Covered(np.tile([-3.0, 3.0], (ROBOT.n_joints, 1)), np.zeros(2))
    alone = FittedRobot.given(model, estimate_of(model.parameters, np.zeros(len(covariance)), covariance), covered)
    lengths = np.array([0.05, 0.2, 0.8])
    drives = np.full((ROBOT.n_joints, 3), 1e-9)
    lacks = Discrepancy(lengths=lengths, drives=drives, rest=1e-10, factor=1.0, coordinates=300)
    whole = replace(alone, discrepancy=lacks)
    at = Conditions.at(ROBOT.random_configurations(POSES, np.random.default_rng(0)), payload=PAYLOAD_MASS)
    taken = {name: np.empty(ROUNDS) for name in ("parameters", "all")}
    for robot in (alone, whole):
        robot.predict(at, return_sigma=True)
    for k in range(ROUNDS):
        taken["parameters"][k] = seconds(partial(alone.predict, at, return_sigma=True), 1)[0]
        taken["all"][k] = seconds(partial(whole.predict, at, return_sigma=True), 1)[0]
    before, after = (float(np.median(taken[name])) for name in ("parameters", "all"))
    yield line("poses with u of the parameters alone", 1e3 * before, None, "{:.0f} ms")
    yield line("poses with u of all sources", 1e3 * after, None, "{:.0f} ms")
    yield line("ratio (medians)", after / before, 1.5, "{:.2f}")


def table_of(n: int, *, with_elasticity: bool, noise: float = NOISE) -> Measurements:
    """Measure the paper's robot with noise at ``n`` poses from a corner of the hall."""
    rng = np.random.default_rng(n)
    q, position = ROBOT.random_configurations(n, rng), np.empty((n, 3))
    for start in range(0, n, POSES):
        rows = slice(start, start + POSES)
        position[rows] = paper_positions(q[rows], tool_offset=TOOL, with_elasticity=with_elasticity)
    # The tracker stands 3 m away, turned by 90 degrees about the vertical.
    position = position @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) + (3.0, 1.0, 0.5)
    position += rng.normal(0.0, noise, position.shape)
    return pincal.measurements_from_arrays(ROBOT.joint_names, q, position=position, payload=np.full(n, PAYLOAD_MASS))


def time_calibration() -> Iterator[Line]:
    """Time the library's ``calibrate()``; base and tool unknown, rank and covariance included."""
    for name, effects, n, target in (
        ("geometric", GEOMETRIC, 1_000, 0.018),
        ("geometric", GEOMETRIC, 10_000, 0.25),
        ("elastic", ELASTIC, 1_000, None),
    ):
        table = table_of(n, with_elasticity=name == "elastic")
        options = Options(effects=effects, sigma=NOISE, payload_centre=PAYLOAD_COM)
        found = pincal.calibrate(ROBOT, table, options)
        taken = 1e3 * seconds(partial(pincal.calibrate, ROBOT, table, options), CALLS)
        _check(found)
        what = (
            f"calibrate {name}, N = {n}, 3D, rank {found.solution.posterior.visible_rank}, {found.fit.iterations} iterations"
        )
        yield line(f"{what}: best", float(taken.min()), None if target is None else 1e3 * target, "{:.1f} ms")
        yield line(f"{'':4s}median of {CALLS}", float(np.median(taken)), None, "{:.1f} ms")
    rows = {"": table_of(1_000, with_elasticity=True)}
    options = Options(effects=ELASTIC, payload_centre=PAYLOAD_COM)
    whole, alone = (seconds(partial(of, ROBOT, rows, options), CALLS).min() for of in (pincal.run_calibration, fit_tables))
    yield line("run_calibration elastic, N = 1000, errors and verdict included, over one fit", whole / alone, 3.0, "{:.2f}")


# Talos with its arms on a torso of two joints, a head of two, and eight joints of its legs.
HANDS = "wrist_left_ft_tool_link", "wrist_right_ft_tool_link"
LEGS = [f"leg_{side}_{i}_joint" for side, count in (("left", 6), ("right", 2)) for i in range(1, count + 1)]


def time_tree() -> Iterator[Line]:
    """Time the calibration of both hands of a tree of 26 joints, 1000 poses each, beside that of one arm of 9 joints."""
    one = Robot.from_urdf("talos", tip=HANDS[0])
    tree = Robot.from_urdf(
        "talos",
        base="base_link",
        tip=HANDS[0],
        paths=[("base_link", HANDS[1])],
        others=["head_1_joint", "head_2_joint", *LEGS],
    )
    options = Options(sigma=NOISE, moment_frame="paper")

    def seen(robot: Robot, tip: str) -> Measurements:
        rng = np.random.default_rng(2)
        machine = TrueMachine.from_urdf(
            arm_text(robot.urdf, robot.joint_names, robot.source), tip=tip, base=robot.base, joints=robot.joint_names
        ).draw_errors(rng, sigma_length=1e-4, sigma_angle=3e-4, sigma_offset=3e-4)
        q = plan_poses(machine.nominal, 1000, rng, min_height=None)
        links = {"from_link": np.repeat(robot.base, 1000), "to_link": np.repeat(tip, 1000)}
        places = machine.tip(q)[:, :3, 3] + NOISE * rng.standard_normal((1000, 3))
        return pincal.measurements_from_arrays(robot.joint_names, q, position=places, **links)

    hand, hands = seen(one, HANDS[0]), {tip: seen(tree, tip) for tip in HANDS}
    calls = [partial(pincal.calibrate, one, hand, options), partial(pincal.calibrate, tree, hands, options)]
    for call in calls:
        call()
    alone, both = np.array([[seconds(call, 1)[0] for call in calls] for _ in range(CALLS)]).T
    yield line(
        f"both hands of {tree.n_joints} joints / one arm of {one.n_joints}", float(np.median(both / alone)), 3.0, "{:.2f}"
    )


def time_stations() -> Iterator[Line]:
    """Time and weigh many stations of 100 rows against one, and against one table with as many rows."""
    table = table_of(20_000, with_elasticity=False)
    parts = [table.select(np.arange(100 * i, 100 * (i + 1))) for i in range(200)]
    losses: tuple[Loss, ...] = ("none", "screen")
    for loss in losses:
        options = Options(effects=GEOMETRIC, sigma=NOISE, loss=loss)

        def taken(tables: Tables, options: Options = options) -> float:
            few = 1 if len(tables) == 200 else CALLS
            return float(seconds(partial(pincal.calibrate, ROBOT, tables, options), few).min())

        def peak(stations: int, options: Options = options) -> float:
            gc.collect()
            tracemalloc.start()
            _check(pincal.calibrate(ROBOT, parts[:stations], options))
            reached = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            return reached

        taken(parts[:1])
        one, fifty, all_of_them = (taken(parts[:n]) for n in (1, 50, 200))
        whole = taken(table.select(np.arange(5_000)))
        yield line(f"1 station of 100 rows, geometric, loss {loss}: best", 1e3 * one, None, "{:.1f} ms")
        yield line("    200 such stations, a station", 1e3 * all_of_them / 200, 1.2 * 1e3 * one, "{:.1f} ms")
        yield line("    50 stations of 100 rows against one table of 5000: ratio", fifty / whole, 1.5, "{:.1f}")
        yield line("    memory for one more station", (peak(200) - peak(50)) / 150 / 1e3, 10.0, "{:.0f} kB")


def _check(found: FittedRobot) -> None:
    assert found.solution.converged and 0.8 < found.solution.cost < 1.2, (found.solution.converged, found.solution.cost)


def time_design() -> Iterator[Line]:
    """Time the choice of poses: candidates, exchange, and then refining them joint by joint."""
    first = ROBOT.joint_names[:3]
    effects = (*GEOMETRIC, JointElasticity(joints=first), BearingElasticity(joints=first))
    options = Options(effects=effects, sigma=NOISE, payload_centre=PAYLOAD_COM)
    call = partial(
        pincal.design_poses,
        ROBOT,
        pincal.DesignRequest(poses=50, payloads=[PAYLOAD_MASS], candidates=1_000, curve=False),
        options,
    )
    for name, refine in (("exchange alone", False), ("and refined", True)):
        call(refine=refine)
        taken = seconds(partial(call, refine=refine), CALLS)
        what = f"design 50 of 1000 candidates, 45 parameters, {name}"
        yield line(f"{what}: best", float(taken.min()), 1.0, "{:.2f} s")
        yield line(f"{'':4s}median of {CALLS}", float(np.median(taken)), None, "{:.2f} s")


def time_compensation() -> Iterator[Line]:
    """Time the joints to command for whole programs: 6R and 7R, elastic, a payload a row."""
    for name, robot in (("6R", ROBOT), ("7R", Robot.from_urdf("panda", tip="panda_link8"))):
        model = Model(Chain.of(robot), ELASTIC)
        rng = np.random.default_rng(1)
        values = 1e-3 * rng.standard_normal(model.n_parameters)
        compliances = np.array([p.unit.endswith("(N m)") for p in model.parameters])
        values[compliances] = 1e-3 / (robot.masses.sum() * robot.reach * 9.81)
        for (where, target), q in _programs(robot, model, rng):
            rows = Conditions.at(q, payload_centre=(0.0, 0.0, 0.1))
            rows = replace(rows, payload=rng.uniform(0.0, 3.0, POSES))
            wanted = Model(Chain.of(robot), ()).predict(np.zeros(0), rows)
            problem = IkProblem.of(model, values, conditions=rows, wanted=wanted, with_orientation=True)
            solve = partial(solve_ik, problem, q, limits=Bounds(robot.lower, robot.upper))
            _, status = solve()
            taken = 1e6 * seconds(solve, CALLS).min() / POSES
            served = f"{np.sum(status == 'ok')} of {POSES} poses reached"
            yield line(f"compensate {name}, N = {POSES}, {where}: {served}, a pose", float(taken), target, "{:.1f} us")


def _programs(robot: Robot, model: Model, rng: np.random.Generator) -> Iterator[tuple[tuple[str, float | None], np.ndarray]]:
    """Yield joint positions clear of limits and of what is singular, as programs are, and anywhere; each with a target."""
    q = robot.random_configurations(2 * POSES, rng)
    inner = 0.95 * q + 0.025 * (robot.lower + robot.upper)
    offsets = np.isin(np.arange(model.n_parameters), [model.index(f"{joint}.theta") for joint in robot.joint_names])
    _, J = model.linearise(np.zeros(model.n_parameters), Conditions.at(inner), free=offsets, rows=6)
    J[:, :3] /= robot.reach / 3.0
    least = np.linalg.svd(J, compute_uv=False)[:, -1]
    yield ("not singular", 50.0), inner[np.argsort(least)[POSES:]]
    yield ("anywhere", None), q[:POSES]


def time_discovery() -> Iterator[Line]:
    """Time discoveries of two hidden effects with everything recorded, and on the real UR10, with the gap that is left."""
    taken = seconds(_discover_500(), 3).min()
    yield line("discover, N = 500, 3D, whole catalogue, best of 3", taken, 1.5, "{:.1f} s")
    yield from _time_series("B", limit=None, gap=0.085)


def time_stability() -> Iterator[Line]:
    """Time a discovery with its names repeated on halves by two processes, against one without."""
    alone = seconds(_discover_500(), 1)[0]
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        taken = seconds(_discover_500(stability=20, executor=pool), 1)[0]
    yield line("discover, N = 500, with 20 halves on two processes: ratio to without", taken / alone, 5.0, "{:.1f}")


def time_large_series() -> Iterator[Line]:
    """Time the discovery of the largest series of the real UR10."""
    yield from _time_series("A", limit=20.0, gap=0.068)


def time_splits() -> Iterator[Line]:
    """Tell what a discovery leaves on the real UR10, mean over four choices of the regions held out."""
    for name, gap in (("A", 0.068), ("B", 0.085)):
        if table := _series(name):
            left = [_discover_ur10(table, seed).report["gap"]["after"]["mean_mm"] for seed in range(4)]
            yield line(f"discover ur10 series {name}, regions held out, mean of 4 splits", np.mean(left), gap, "{:.4f} mm")
            yield line("    the worst of them", max(left), None, "{:.4f} mm")


def time_sample_sizes() -> Iterator[Line]:
    """Tell what discoveries of the largest series cost and leave by the readings from which effects are chosen."""
    for readings in (6000, 7500, 9000, 12000):
        if table := _series("A"):
            begun = time.process_time()
            found = _discover_ur10(table, 1, replace(POLICY, enough_readings=readings)).report
            name = f"discover ur10 series A, {len(found['effects'])} effects chosen from {readings} readings"
            yield line(name, found["gap"]["after"]["mean_mm"], None, "{:.4f} mm")
            yield line("    processor time", time.process_time() - begun, None, "{:.0f} s")


def _discover_500(**options: Any) -> Callable[[], object]:
    """Return a discovery that ran once."""
    case = draw_case("backlash+thermal_offset", 0, n=500)
    run_discovery(case.robot, case.rows, case.options, moment_frames=MOMENT_FRAMES)
    return partial(run_discovery, case.robot, case.rows, case.options, moment_frames=MOMENT_FRAMES, **options)


def _time_series(name: str, *, limit: float | None, gap: float | None) -> Iterator[Line]:
    if table := _series(name):
        begun = time.perf_counter()
        held = _discover_ur10(table).report["gap"]
        yield line(f"discover ur10 series {name}, {len(table)} poses, 6D", time.perf_counter() - begun, limit, "{:.0f} s")
        was, left = held["before"]["mean_mm"], held["after"]["mean_mm"]
        yield line(f"    regions held out, mean, {was:.3f} mm with the geometry alone", left, gap, "{:.4f} mm")


def _series(name: str) -> Measurements | None:
    path = DATA / "ur10_tmac" / f"series_{name}.csv"
    return read_measurements(path, Robot.from_urdf("ur10").joint_names) if path.is_file() else None


def _discover_ur10(table: Measurements, seed: int = 0, policy: Policy = POLICY) -> Discovery:
    options = Options(effects=GEOMETRIC)
    robot = Robot.from_urdf("ur10")
    return run_discovery(robot, table, options, policy=policy, moment_frames=MOMENT_FRAMES, split="blocked", seed=seed)


def time_million() -> Iterator[Line]:
    """Time a million rows against ten thousand: the fit alone, and whole processes with their largest memory."""
    options = Options(effects=ELASTIC, sigma=NOISE, payload_centre=PAYLOAD_COM)
    taken = {}
    for n in (10_000, 1_000_000):
        table = table_of(n, with_elasticity=True)
        gc.collect()
        before = _reset_peak()
        taken[n] = seconds(lambda of=table: _check(pincal.calibrate(ROBOT, of, options)), 1)[0]
    yield line("calibrate elastic, N = 1000000, 3D, the fit alone", float(taken[1_000_000]), None, "{:.1f} s")
    yield line("    ratio to N = 10000", float(taken[1_000_000] / taken[10_000]), 110.0, "{:.1f}")
    yield line("    memory beyond the table, at most", _status("VmHWM") - before, None, "{:.0f} MB")
    del table
    with tempfile.TemporaryDirectory() as folder:
        urdf, runs = str(kuka_urdf_path()), {}
        for n in (10_000, 1_000_000):
            file = str(Path(folder) / f"{n}.csv")
            made = _measured("simulate", urdf, "--poses", str(n), "--noise", "0.05mm", "--out", file)
            out = str(Path(folder) / f"out{n}")
            runs[n] = _measured("calibrate", urdf, file, "--out", out, "--noise", "0.05mm")
        yield line("pincal simulate, 1000000 poses", made[0], None, "{:.0f} s")
        yield line("    memory, at most", made[1], 2000.0, "{:.0f} MB")
        yield line("pincal calibrate, 1000000 rows, reading and report included", runs[1_000_000][0], None, "{:.0f} s")
        yield line("    ratio to 10000 rows", runs[1_000_000][0] / runs[10_000][0], 40.0, "{:.1f}")
        yield line("    memory, at most", runs[1_000_000][1], 1500.0, "{:.0f} MB")
        series = DATA / "ur10_tmac" / "series_B.csv"
        if series.is_file():
            _, peak = _measured("discover", "ur10", str(series), "--stability", "0", "--out", str(Path(folder) / "ur10"))
            yield line("pincal discover ur10 series B, 1495 poses: memory, at most", peak, 500.0, "{:.0f} MB")


def time_ten_million() -> Iterator[Line]:
    """Time ten million rows of a Parquet file against one million, fitted part by part in processes of their own."""
    with tempfile.TemporaryDirectory() as folder:
        measured = {}
        for millions in (1, 10):
            file = Path(folder) / f"{millions}.parquet"
            _write_millions(file, millions)
            measured[millions] = _run("-c", _PART_BY_PART, str(kuka_urdf_path()), str(file))
            yield line(
                f"{millions} million rows, elastic, part by part, reading included", measured[millions][0], None, "{:.0f} s"
            )
            yield line("    memory, at most", measured[millions][1], 1500.0, "{:.0f} MB")
        yield line("    ratio of the memories", measured[10][1] / measured[1][1], 1.1, "{:.2f}")


_PART_BY_PART = f"""
import sys
import pincal
from pincal import ELASTIC, Options, Robot
robot = Robot.from_urdf(sys.argv[1])
parts = pincal.row_parts(sys.argv[2])
tables = (pincal.read_measurements(sys.argv[2], robot.joint_names, part=part) for part in parts)
fit = pincal.calibrate_parts(robot, tables, Options(effects=ELASTIC, sigma={NOISE}, payload_centre={PAYLOAD_COM}))
assert 0.9 < fit.solution.cost < 1.1, fit.solution.cost
"""


def _write_millions(file: Path, millions: int) -> None:
    """Write so many million rows, of poses that are measured again and again, without holding them all."""
    rng, table = np.random.default_rng(0), table_of(200_000, with_elasticity=True, noise=0.0)
    held = dict(zip(ROBOT.joint_names, table.q.T, strict=True)) | {"payload": table.array("payload")}
    parts = [file.with_name(f"part_{k}.parquet") for k in range(5 * millions)]
    for part in parts:
        position = table.readings["position"] + rng.normal(0.0, NOISE, (len(table), 3))
        pl.DataFrame(held | dict(zip("xyz", position.T, strict=True))).write_parquet(part)
    pl.scan_parquet(parts).sink_parquet(file)
    for part in parts:
        part.unlink()


def _measured(*words: str) -> tuple[float, float]:
    """Run a verb as a process and return how long it took [s] and its largest memory [MB]."""
    return _run("-m", "pincal", *words, "--quiet")


def _run(*words: str) -> tuple[float, float]:
    """Run Python and return how long it took [s] and its largest memory [MB]."""
    taken, _, peak = _used(*words)
    return taken, peak


def _used(*words: str) -> tuple[float, float, float]:
    """Run Python and return how long it took [s], its processor time, workers included [s], and its largest memory [MB]."""
    begun = time.perf_counter()
    process = subprocess.Popen([sys.executable, *words], cwd=ROOT, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(words[:3])} ended with {os.waitstatus_to_exitcode(status)}")
    return time.perf_counter() - begun, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024.0


@dataclass(frozen=True)
class RealTable:
    """A discovery on tables of a real arm.

    Attributes:
        robot: its name.
        words: tables and options, after those that are made of a whole series.
        limits: how long it may take [s], and its largest memory [MB]; None for no limit.
        part: every how many-th row of series A, or, if negative, into how many stations it is divided; 0 for none of it.
    """

    robot: str
    words: tuple[str, ...]
    limits: tuple[float | None, float | None]
    part: int = 0


SERIES_A, SERIES_B = (DATA / "ur10_tmac" / f"series_{name}.csv" for name in "AB")
REAL = {
    "ur5 grid, 20 subsamples": RealTable("ur5", (str(GRID),), (45.0, None)),
    "ur10 B, 20 subsamples": RealTable("ur10", (str(SERIES_B),), (90.0, None)),
    "ur10, every fourth row of A, 20 subsamples": RealTable("ur10", (), (90.0, None), part=4),
    "ur10 A, regions of seed 1, 20 subsamples": RealTable(
        "ur10", (str(SERIES_A), "--split", "blocked", "--seed", "1"), (120.0, None)
    ),
    "ur10 A in two stations and B": RealTable("ur10", (str(SERIES_B),), (240.0, 1500.0), part=-2),
}


def time_real_tables() -> Iterator[Line]:
    """Time discoveries of the command on tables of real arms; say names and errors, by which two versions are compared.

    PINCAL_TABLES, words that are part of a table's name, divided by commas, chooses some.
    """
    chosen = os.environ.get("PINCAL_TABLES", "").split(",")
    for name, table in REAL.items():
        if GRID.is_file() and any(word in name for word in chosen):
            yield from _time_real(name, table)
    if any(word in _DAYS for word in chosen):
        yield from _time_days_of_imu()


def _time_real(name: str, table: RealTable) -> Iterator[Line]:
    with tempfile.TemporaryDirectory() as folder:
        parts = [str(path) for path in _parts_of_a(Path(folder), table.part)]
        yield from _time_found(name, folder, (table.robot, *parts, *table.words), table.limits)


def _parts_of_a(folder: Path, part: int) -> Iterator[Path]:
    """Write parts of series A, see :class:`RealTable`."""
    if not part:
        return
    rows = pl.read_csv(SERIES_A)
    size = -(-len(rows) // -part) if part < 0 else len(rows)
    for k, start in enumerate(range(0, len(rows), size)):
        path = folder / f"part_{k}.csv"
        some = rows.slice(start, size) if part < 0 else rows.gather_every(part)
        some.write_csv(path)
        yield path


_DAYS = "ur5, three days of an IMU and eight positions"


def _time_days_of_imu() -> Iterator[Line]:
    """Time a discovery from an arm's motion on three simulated days, each with another path, and a few positions."""
    machine = ("--elastic", "0", "--seed", "3")
    with tempfile.TemporaryDirectory() as folder:
        days = [str(Path(folder) / day) for day in ("monday", "tuesday", "wednesday")]
        for k, day in enumerate(days):
            _measured("simulate", "ur5", "--path", "300s", "--imu", *machine, "--pose-seed", str(k), "--out", day)
        eight = str(Path(folder) / "eight.csv")
        _measured("simulate", "ur5", "--poses", "8", "--noise", "0.05mm", *machine, "--out", eight)
        yield from _time_found(_DAYS, folder, ("ur5", *days, eight), (180.0, None))


def _time_found(name: str, folder: str, words: tuple[str, ...], limits: tuple[float | None, float | None]) -> Iterator[Line]:
    out = Path(folder) / "found"
    taken, processor, peak = _used("-m", "pincal", "discover", *words, "--out", str(out), "--quiet")
    found = json.loads((out / "discovery.json").read_text())
    yield line(f"discover {name}", taken, limits[0], "{:.0f} s")
    yield line("    processor time", processor, None, "{:.0f} s")
    yield line("    memory, at most", peak, limits[1], "{:.0f} MB")
    errors = found["gap"]["after"] or {}
    yield line("    mean error", errors.get("mean_mm", np.nan), None, "{:.4f} mm")
    for entry in found["effects"]:
        stability = entry["stability"] or {"named": 0, "of": 0}
        yield f"    {entry['effect']} {entry['joint'] or ''}", f"{stability['named']} of {stability['of']}", "", ""


def _reset_peak() -> float:
    """Let Linux forget the largest memory that this process had, and return what it has now [MB]."""
    Path("/proc/self/clear_refs").write_text("5")
    return _status("VmRSS")


def _status(name: str) -> float:
    text = Path("/proc/self/status").read_text()
    return float(next(row.split()[1] for row in text.splitlines() if row.startswith(name))) / 1024.0


def time_fleet() -> Iterator[Line]:
    """Time tables calibrated from a store beside calibrations alone, and a type of many machines beside one of few."""
    rng, options = np.random.default_rng(0), Options(effects=GEOMETRIC, sigma=NOISE)
    table = table_of(30, with_elasticity=False)
    with tempfile.TemporaryDirectory() as folder:
        store = open_store(folder, create=True)
        for k in range(31):
            store.add_table(f"R{k}", "2026-01-05", replace(table, temperature=np.full(30, float(k))))
        keys, job = store.keys("tables"), CalibrateTables(ROBOT, options)
        run_job(store, job, tables=keys[:1])
        whole = seconds(lambda: run_job(store, job), 1)[0] / (len(keys) - 1)
    alone = float(np.median(seconds(partial(pincal.calibrate, ROBOT, table, options), 30)))
    yield line("a table of 30 poses, calibrated from a store", 1e3 * whole, None, "{:.1f} ms")
    yield line("  over a calibration alone", whole / alone, 2.5, "{:.2f}")
    family = Family.drawn(rng, unseen=15)
    many = [family.measured(x, rng) for x in family.draw(1200, rng)]
    taken = [seconds(partial(learn_type, many[:count]), 1)[0] / count for count in (400, 1200)]
    yield line("a type of 1200 machines of 40 parameters", 1200 * taken[1], None, "{:.2f} s")
    yield line("  a machine, over that of a type of 400", taken[1] / taken[0], 1.5, "{:.2f}")


def time_processes() -> Iterator[Line]:
    """Time whole processes, started warm: the import, and a calibration from the command line."""
    yield line("python -c 'import pincal', best of 5", _process("-c", "import pincal"), 0.6, "{:.2f} s")
    yield line("    python alone", _process("-c", "pass"), None, "{:.2f} s")
    if not GRID.is_file():
        print("measurements on real machines are not here: no folder shared/data next to the project")
        return
    with tempfile.TemporaryDirectory() as folder:
        command = ("-m", "pincal", "calibrate", "ur5", str(GRID), "--out", str(Path(folder) / "ur5"), "--quiet")
        warm = _process(*command)
        yield line("pincal calibrate ur5 (1000 rows), best of 5", warm, 3.0, "{:.2f} s")
        cold = _cold(*command)
        yield line("    the first on a machine, which compiles", cold, None, "{:.2f} s")
        # A third of what it was once.
        yield line("    to compile", cold - warm, 10.7, "{:.2f} s")


def _process(*arguments: str, times: int = 5) -> float:
    """Return the shortest time of several runs of Python, after one to warm up [s]."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")} | {"PYTHONPATH": path}

    def run() -> None:
        subprocess.run([sys.executable, *arguments], env=environment, check=True, capture_output=True)

    return float(seconds(run, times + 1)[1:].min())


def _cold(*arguments: str) -> float:
    """Return how long Python runs with nothing compiled [s]."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"PYTHONPATH": path, "NUMBA_CACHE_DIR": cache}
        run = partial(subprocess.run, [sys.executable, *arguments], env=environment, check=True, capture_output=True)
        return float(seconds(run, 1)[0])


# Parts that take minutes, and for a million rows 2 GB, are timed where they are named.
QUICK: dict[str, Callable[[], Iterator[Line]]] = {
    "linearise": compare_with_pinocchio,
    "uncertainty": time_uncertainty,
    "calibrate": time_calibration,
    "tree": time_tree,
    "stations": time_stations,
    "design": time_design,
    "compensate": time_compensation,
    "discover": time_discovery,
    "fleet": time_fleet,
    "process": time_processes,
}
SLOW: dict[str, Callable[[], Iterator[Line]]] = {
    "stability": time_stability,
    "large-series": time_large_series,
    "splits": time_splits,
    "sample-sizes": time_sample_sizes,
    "million": time_million,
    "ten-million": time_ten_million,
    "real-tables": time_real_tables,
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Print figures of speed, each beside its target.")
    parts = QUICK | SLOW
    parser.add_argument(
        "parts", nargs="*", metavar="PART", help=f"of {', '.join(parts)}; default: all but {', '.join(SLOW)}"
    )
    for name in parser.parse_args().parts or QUICK:
        if name not in parts:
            parser.error(f"{name} is no part of {', '.join(parts)}")
        for what, measured, target, verdict in parts[name]():
            print(f"  {what:74s} {measured:>10s}  {target:>12s} {verdict}".rstrip(), flush=True)


if __name__ == "__main__":
    main()
