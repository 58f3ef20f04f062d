"""What a type brings and what a fleet's checks find: ``python tests/fleet_study.py [PART ...] --out FILE.jsonl``.

Parts: ``learn`` (5000 machines of 40 parameters: seconds, memory, error, coverage), ``few`` (3, 5 and 10 machines of
families of every kind, with and without a type), ``real`` (machines as their makers measured them, one left out), ``year``
(of weekly checks), ``store`` (tables calibrated from a store), ``flips`` (stored files with one bit changed: how many are
refused, and how many read as other content). Each case is one line of the file as soon as it is done: a
run that was stopped goes on where it was. Rates stand with their exact 95 % intervals (Clopper and Pearson).
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from fleet_cases import (
    OPTIONS,
    PRIOR,
    Family,
    Year,
    bit_flips,
    error_of,
    nominal_arm,
    real_machines,
    sibling_of,
    table_of,
)
from rates import in_words
from rows_study import append, read, version

from pincal import Robot, calibrate
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.fleet.jobs import CalibrateTables, run_job
from pincal.fleet.machines import Machine
from pincal.fleet.robot_type import RobotType, calibrate_of_type, learn_type
from pincal.fleet.store import INFORMATION, MODELS, TABLES, open_store
from pincal.simulate.urdf_arm import read_arm
from pincal.spread import end_with_parent

PARTS = ("learn", "few", "real", "year", "store", "flips")
# How machines of a family differ: alike in all, each number by its own, as the priors without a type have it, off the data
# sheet by much more than they differ, in two numbers only, and one in ten of them eight times as much.
KINDS = ("alike", "unlike", "priors", "shifted", "two", "hit")
FLIPS = 600
FEW, POSES, MANY = (3, 5, 10), (8, 12, 25), 60
LAMBDA, WEEKS, ROBOTS = 80.0, 52, 500


def tasks(parts: Sequence[str], count: int, seed: int) -> Iterator[tuple[Any, ...]]:
    """Yield the cases of parts; of most so many."""
    for k in range(seed, seed + count):
        if "learn" in parts and k < seed + max(1, count // 5):
            yield from (("learn", k, way) for way in ("plain", "correlated", "hit"))
        if "few" in parts:
            yield from (("few", k, kind, arm, m) for kind in KINDS for arm in ("kuka", "ur3e") for m in FEW)
        if "year" in parts and k < seed + max(1, count // 5):
            yield from (("year", k, way) for way in ("robots", "checks", "drift"))
    if "real" in parts:
        yield from (
            ("real", k, name)
            for k in range(seed, seed + min(count, 5))
            for kind, name, _ in real_machines()
            if sum(other == kind for other, *_ in real_machines()) > 1
        )
    if "store" in parts:
        yield ("store", seed, 10_000 if count >= 20 else 1000)
    if "flips" in parts:
        yield from (("flips", kind, FLIPS) for kind in (TABLES, INFORMATION, MODELS))


def case(task: tuple[Any, ...]) -> dict[str, Any]:
    """Return what a case shows, in types that JSON knows."""
    begun = time.process_time()
    found = {"learn": _learn, "few": _few, "real": _real, "year": _year, "store": _store, "flips": _flips}[task[0]](
        *task[1:]
    )
    return {"task": list(task), **found, "cpu_seconds": time.process_time() - begun}


def _learn(seed: int, way: str) -> dict[str, Any]:
    """Learn a type of 5000 machines in a process of its own, whose memory is measured."""
    code = f"import fleet_study, json; print(json.dumps(fleet_study.learned({seed}, {way!r})))"
    found = subprocess.run(
        [sys.executable, "-c", code], cwd=Path(__file__).parent, capture_output=True, text=True, check=True
    )
    return dict(json.loads(found.stdout))


def learned(seed: int, way: str, *, machines: int = 5000) -> dict[str, Any]:
    """Return how well a type of many machines is learned."""
    rng = np.random.default_rng(seed)
    family = Family.drawn(rng, unseen=15 if way != "plain" else 0, correlated=way == "correlated")
    x = family.draw(machines, rng)
    is_hit = rng.uniform(size=machines) < (0.05 if way == "hit" else 0.0)
    for k in np.flatnonzero(is_hit):
        joint = np.arange(40) // 6 == rng.integers(6)
        x[k, joint] += 0.3 * rng.normal(size=int(joint.sum()))
    made = [family.measured(one, rng) for one in x]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    wall, cpu = time.perf_counter(), time.process_time()
    of = learn_type(made).type
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    K, C = family.seen, family.covariance
    # In standard errors, along what is seen.
    mean = K.T @ (of.mean / PRIOR - family.mean) / np.sqrt(np.diag(K.T @ of.mean_covariance @ K) / PRIOR**2)
    variance = np.diag(of.covariance) / PRIOR**2 / np.diag(C) if way == "plain" else None
    ratio = np.diag(K.T @ of.covariance @ K) / PRIOR**2 / np.diag(K.T @ C @ K) if variance is None else variance
    # Single variances are known less well than those of exactly known machines; for directions this is the least error.
    error = np.sqrt(of.spread_variance if way == "plain" else 2.0 / machines)
    prior = of.prior()
    new = family.draw(20_000, rng)
    off = (new - prior.values / PRIOR) @ K / np.sqrt(np.diag(K.T @ prior.dense_covariance() @ K) / PRIOR**2)
    fits = [of.judge(family.measured(one, rng)).p_value for one in new[:500]]
    return {
        "seconds": wall,
        "cpu": cpu,
        "megabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
        "before_megabytes": before / 1e3,
        "mean_rms": float(np.sqrt(np.mean(mean**2))),
        "mean_most": float(np.abs(mean).max()),
        "spread_rms": float(np.sqrt(np.mean((np.log(ratio) / error) ** 2))),
        "spread_most": float(np.abs(np.log(ratio) / error).max()),
        "coverage": float(np.mean(np.abs(off) < 1.96)),
        "strange": float(np.mean(np.array(fits) < 0.05)),
    }


def _arm(name: str) -> tuple[Robot, sim.TrueMachine]:
    if name == "kuka":
        return Robot.from_urdf(kuka_urdf_path(), tip="tool0"), sim.TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0")
    machine = next(machine for kind, _, machine in real_machines() if kind == name)
    robot = nominal_arm(name)
    return robot, sim.TrueMachine.of_arm(read_arm(robot.urdf.decode(), "wrist_3", None), gravity=machine.gravity)


class Siblings:
    """Machines of an arm that differ in the placements of their joints."""

    def __init__(self, nominal: sim.TrueMachine, kind: str, rng: np.random.Generator) -> None:
        """Draw by how much they differ [m and rad], and how far they are off the data sheet."""
        n = len(nominal.names)
        size = np.tile(np.repeat([1.5e-4, 5e-4], 3), (n + 1, 1))
        if kind == "unlike":
            size *= np.exp(rng.normal(0.0, 0.8, size.shape))
        if kind == "priors":
            size[:] = PRIOR
        if kind == "two":
            size *= 0.3
            size.flat[rng.choice(size.size, 2, replace=False)] = PRIOR
        self.offset = 4.0 * size * rng.normal(size=size.shape) * (kind == "shifted")
        self.nominal, self.size, self.kind, self.rng = nominal, size, kind, rng

    def draw(self) -> sim.TrueMachine:
        """Return a machine."""
        far = 8.0 if self.kind == "hit" and self.rng.uniform() < 0.1 else 1.0
        errors = self.offset + far * self.size * self.rng.normal(size=self.size.shape)
        return replace(self.nominal, placement_errors=errors)


def _few(seed: int, kind: str, arm: str, machines: int) -> dict[str, Any]:
    """Return errors of a further machine by few poses, with the priors alone and with a type of few machines."""
    rng = np.random.default_rng([seed, KINDS.index(kind), len(arm), machines])
    robot, nominal = _arm(arm)
    family = Siblings(nominal, kind, rng)
    of = learn_type(
        sibling_of(robot, family.draw(), str(k), poses=MANY, seed=int(rng.integers(1 << 30))) for k in range(machines)
    ).type
    return {"errors": _errors(robot, family.draw(), of, rng)}


def _errors(robot: Robot, machine: sim.TrueMachine, of: RobotType, rng: np.random.Generator) -> list[dict[str, Any]]:
    truth, found = table_of(robot, machine, 200, int(rng.integers(1 << 30)), noise=0.0), []
    for poses in POSES:
        table = table_of(robot, machine, poses, int(rng.integers(1 << 30)))
        alone, (fit, member) = calibrate(robot, table, OPTIONS), calibrate_of_type(robot, table, of, OPTIONS)
        assert truth.position is not None
        off = np.abs(fit.predict(truth.q)[:, :, 3] - truth.position) / fit.position_sigma(fit.readings(truth).conditions)
        found.append(
            {
                "poses": poses,
                "alone_mm": error_of(alone, truth),
                "type_mm": error_of(fit, truth),
                "coverage": float(np.mean(off < 1.96)),
                "off": list(member.off),
            }
        )
    return found


def _real(seed: int, name: str) -> dict[str, Any]:
    """Return errors of a real machine, with the priors alone, with a type of the others, and of all types pooled."""
    machines = {other: (kind, machine) for kind, other, machine in real_machines()}
    kind, machine = machines[name]
    robot = nominal_arm(kind)
    others = [(other, m) for other, (of, m) in machines.items() if of == kind and other != name]
    known = [sibling_of(robot, m, n, poses=MANY, seed=1000 * seed + k) for k, (n, m) in enumerate(others)]
    errors = _errors(robot, machine, learn_type(known).type, np.random.default_rng(seed))
    for k, (other, (of, m)) in enumerate(machines.items()):
        if of != kind:
            # As if theirs were this one's nominal geometry.
            own = sibling_of(nominal_arm(of), m, other, poses=MANY, seed=1000 * seed + 50 + k).information
            known.append(Machine(other, msgspec.structs.replace(own, geometry=known[0].information.geometry)))
    pooled = _errors(robot, machine, learn_type(known).type, np.random.default_rng(seed))
    found = [one | {"pooled_mm": other["type_mm"]} for one, other in zip(errors, pooled, strict=True)]
    return {"type": kind, "siblings": len(others), "errors": found}


def _year(seed: int, way: str) -> dict[str, Any]:
    """Return what a year of weekly checks finds: one robot in a hundred changes, or one in a hundred each week."""
    rng = np.random.default_rng([seed, 7])
    family = Family.drawn(rng, parameters=36, unseen=18)
    of = learn_type(family.measured(x, rng) for x in family.draw(40, rng)).type
    year = Year(family, of, robots=ROBOTS, seed=seed, labels=lambda k: {"supplier": "abcde"[k % 5], "hall": str(k % 3)})
    when = {int(k): int(rng.integers(1, WEEKS - 1)) for k in rng.choice(ROBOTS, ROBOTS // 100, replace=False)}
    open_since, late, false, drifts, named = dict[int, int](), list[int](), 0, list[list[Any]](), 0
    place = int(np.argmax(np.sum(family.seen**2, axis=1)))
    for week in range(1, WEEKS + 1):
        begins = [k for k, of_robot in when.items() if of_robot == week]
        if way == "checks" and week < WEEKS - 1:
            begins = np.flatnonzero(rng.uniform(size=ROBOTS) < 0.01).tolist()
        for robot in begins:
            if robot not in open_since:
                year.change(robot, LAMBDA)
                open_since[robot] = week
        if way == "drift" and week == WEEKS // 2:
            year.drift("supplier", "c", place=place, by=1e-4 / PRIOR)
        for change in year.check(week):
            if change.is_group:
                drifts.append([week, change.subject, of.names[place] in (change.what, *change.equals), change.change])
                continue
            robot = int(change.subject[1:])
            if robot not in open_since:
                false += 1
                year.calibrate(robot, week)
                continue
            name = year.what[robot]
            named += name in (change.what, *change.equals) or change.what == name.split(".")[0]
            late.append(week - open_since.pop(robot) + 1)
            year.calibrate(robot, week)
    return {"late": late, "false": false, "missed": len(open_since), "named": named, "drifts": drifts}


def _store(seed: int, tables: int) -> dict[str, Any]:
    """Return how fast tables of a store are calibrated on two workers, and how much memory that takes."""
    robot, nominal = _arm("kuka")
    family = Siblings(nominal, "alike", np.random.default_rng(seed))
    machines = [family.draw() for _ in range(20)]
    with tempfile.TemporaryDirectory() as folder:
        store, begun = open_store(folder, create=True), time.perf_counter()
        for k in range(tables):
            day = str(np.datetime64("2026-01-01") + k // 500)
            store.add_table(f"R{k % 500}", day, table_of(robot, machines[k % 20], 30, k))
        added = time.perf_counter() - begun
        job, begun = CalibrateTables(robot, OPTIONS), time.perf_counter()
        with ProcessPoolExecutor(2, mp_context=get_context("spawn"), initializer=end_with_parent) as executor:
            done = run_job(store, job, executor=executor)
            taken = time.perf_counter() - begun
            memory = [*executor.map(_memory, range(8))]
        begun = time.perf_counter()
        rest = run_job(store, job)
        again, begun = time.perf_counter() - begun, time.perf_counter()
        count = sum(1 for _ in store.machines())
        listed = time.perf_counter() - begun
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "tables": tables,
        "done": done.done,
        "failed": len(done.failed),
        "left": rest.done,
        "tables_per_second": tables / taken,
        "cpu_ms_a_table": 1e3 * (children.ru_utime + children.ru_stime) / tables,
        "added_per_second": tables / added,
        "again_seconds": again,
        "read_per_second": count / listed,
        "worker_megabytes": max(memory),
    }


def _flips(kind: str, count: int) -> dict[str, Any]:
    """Return what becomes of files of a kind with one bit changed."""
    robot, nominal = _arm("kuka")
    machine = Siblings(nominal, "alike", np.random.default_rng(1)).draw()
    with tempfile.TemporaryDirectory() as folder:
        store, table = open_store(folder, create=True), table_of(robot, machine, 30, 1)
        if kind == TABLES:
            key = store.add_table("R1", "2026-01-01", table)
        elif kind == INFORMATION:
            key = store.add_information("2026-01-01", Machine.of(calibrate(robot, table, OPTIONS).fit, "R1"))
        else:
            calibrate(robot, table, OPTIONS).save(Path(folder) / "model.json")
            key = store.add_model("R1", "2026-01-01", (Path(folder) / "model.json").read_text(encoding="utf-8"))
        return {name: 0 for name in ("refused", "was", "other")} | bit_flips(store, key, count)


def _memory(_: int) -> float:
    """Return the largest memory of this process [MB]; that of ``getrusage`` begins with its parent's."""
    return float(Path("/proc/self/status").read_text().partition("VmHWM:")[2].split()[0]) / 1e3


def study(
    wanted: Sequence[tuple[Any, ...]], path: Path | None, *, workers: int, any_version: bool = False
) -> list[dict[str, Any]]:
    """Return what cases show, those that a file has not already; it gets the others."""
    of, before = version(), [] if path is None else read(path)
    done = {tuple(one["task"]): one for one in before if any_version or one["version"] == of}
    left = [task for task in wanted if task not in done]

    def keep(found: dict[str, Any]) -> None:
        done[tuple(found["task"])] = found = {"version": of, **found}
        if path is not None:
            append(path, found)

    if workers == 1:
        for task in left:
            keep(case(task))
    elif left:
        with ProcessPoolExecutor(workers, mp_context=get_context("forkserver"), initializer=end_with_parent) as pool:
            for future in as_completed([pool.submit(case, task) for task in left]):
                keep(future.result())
    return [done[task] for task in wanted]


def lines(found: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield what is to be said of all cases."""
    for way in ("plain", "correlated", "hit"):
        if own := [one for one in found if one["task"][0] == "learn" and one["task"][2] == way]:
            most = {
                name: max(one[name] for one in own) for name in ("seconds", "cpu", "megabytes", "mean_rms", "spread_most")
            }
            cover = np.mean([one["coverage"] for one in own])
            yield (
                f"learn {way} ({len(own)} families of 5000): at most {most['seconds']:.1f} s, {most['cpu']:.1f} s of one "
                f"core, {most['megabytes']:.0f} MB; mean off by {most['mean_rms']:.2f} standard errors rms, spread at most "
                f"{most['spread_most']:.1f}; 95 % intervals of further machines hold {100 * cover:.1f} %, "
                f"{100 * np.mean([one['strange'] for one in own]):.1f} % have p < .05"
            )
    yield from _lines_of_errors("few", found)
    yield from _lines_of_errors("real", found)
    for way in ("robots", "checks", "drift"):
        if own := [one for one in found if one["task"][0] == "year" and one["task"][2] == way]:
            late = np.concatenate([one["late"] for one in own])
            false, missed = sum(one["false"] for one in own), sum(one["missed"] for one in own)
            alarms = len(late) + false
            named = in_words(sum(one["named"] for one in own), len(late))
            soon = in_words(int(np.sum(late <= 2)), len(late) + missed)
            yield f"year, {way} ({len(own)} of {ROBOTS} robots): false among alarms {in_words(false, alarms)}"
            yield f"  found within two checks {soon}; named {named}"
            if way == "drift":
                yield f"  drifts: {[one['drifts'] for one in own]}"
    yield from _lines_of_flips(found)
    for one in found:
        if one["task"][0] == "store":
            yield "store: " + ", ".join(
                f"{name} {value:.4g}" for name, value in one.items() if isinstance(value, float | int)
            )


def _lines_of_flips(found: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield how many files with one bit changed are read as other content."""
    for one in found:
        if one["task"][0] == "flips":
            _, kind, count = one["task"]
            yield f"flips {kind}: refused {one['refused']} of {count}, read as other content {in_words(one['other'], count)}"


def _lines_of_errors(part: str, found: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield errors with a type over those without, each with the standard error of the ratio of the means."""
    groups = dict[str, list[dict[str, Any]]]()
    for one in found:
        if one["task"][0] == part:
            title = (
                f"{one['task'][2]} {one['task'][4]} machines"
                if part == "few"
                else f"{one['type']} {one['siblings']} siblings"
            )
            groups.setdefault(title, []).append(one)
            if part == "few":
                groups.setdefault(f"all {one['task'][4]} machines", []).append(one)
    for title, own in groups.items():
        words = []
        for k, poses in enumerate(POSES):
            a, b = (np.array([one["errors"][k][name] for one in own]) for name in ("alone_mm", "type_mm"))
            ratio = b.mean() / a.mean()
            error = float(np.std(b - ratio * a) / np.sqrt(len(a)) / a.mean())
            cover = np.mean([one["errors"][k]["coverage"] for one in own])
            words.append(
                f"{poses}: {a.mean():.3f} -> {b.mean():.3f} mm ({ratio:.3f} +- {error:.3f}, covers {100 * cover:.0f} %)"
            )
            if "pooled_mm" in own[0]["errors"][k]:
                words[-1] += f", types pooled {np.mean([one['errors'][k]['pooled_mm'] for one in own]) / a.mean():.3f}"
        yield f"{part} {title} ({len(own)}): " + "; ".join(words)


def main() -> None:
    """Run what is left of a study and print what it found."""
    parser = argparse.ArgumentParser(description="Print what a type of robot brings and what checks of a fleet find.")
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; default: all")
    parser.add_argument("--count", type=int, default=5, help="cases of each kind; default: 5")
    parser.add_argument("--seed", type=int, default=32000, help="of the first; default: 32000")
    parser.add_argument("--workers", type=int, default=2, help="processes; default: 2")
    parser.add_argument("--out", type=Path, default=Path("fleet_study.jsonl"), help="file to go on with")
    parser.add_argument("--any-version", action="store_true", help="also count cases that another version of the code did")
    chosen = parser.parse_args()
    if unknown := set(chosen.parts) - set(PARTS):
        parser.error(f"{sorted(unknown)[0]} is no part of {', '.join(PARTS)}")
    wanted = list(tasks(chosen.parts or PARTS, chosen.count, chosen.seed))
    # The store has workers of its own.
    apart = [task for task in wanted if task[0] != "store"]
    found = study(apart, chosen.out, workers=chosen.workers, any_version=chosen.any_version)
    found += study([task for task in wanted if task[0] == "store"], chosen.out, workers=1, any_version=chosen.any_version)
    print("\n".join(lines(found)))


if __name__ == "__main__":
    for _name in ("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[_name] = "1"  # for the processes that are started
    main()
