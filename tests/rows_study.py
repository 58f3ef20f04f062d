"""What a discovery makes of rows as they are measured in the world: ``python tests/rows_study.py --out FILE.jsonl``.

Every case is a fresh draw of ``row_cases``, given to a discovery as the command does it, or with ``--kinds plans`` one of
``plan_cases``, given to ``calibrate``, ``discover`` and ``diagnose``. It is one line of the file as soon as it is done: a
run that was stopped goes on where it was. Rates stand with their exact 95 % intervals.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import time
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from discovery_cases import ELASTICITY, NAMED, SOFT
from plan_cases import ARRIVAL, PLAN_KINDS, PLANS
from plan_figures import VERBS, required, said_of_plan
from rates import in_words, noticed, power, tables_for
from row_cases import CORRELATED, KINDS, OF_ROBOT, RowsCase, draw_rows_case
from test_discovery_rates import CI as INDEPENDENT

from pincal.discover.run import Discovery, run_discovery
from pincal.errors import PincalError, PincalWarning
from pincal.model.conditions import Conditions
from pincal.spread import end_with_parent

# Poses never measured at which intervals are held against the truth.
FRESH = 300
# Share of them that the 95 % intervals of an adequate model have to hold.
COVERS = 0.9
# Names that say something of the set-up, the instrument or the session, and nothing of the robot.
OF_SETUP = ("base_drift", "measurement_scale", "shifted", "tool_exchanged")
_OF_SETUP = ("instrument", "session", "setup", "station")
# How a note says that something is other from some line on, and how far from it that line may be.
_SAYS = {"shifted": "readings are shifted", "tool_exchanged": "on the tool", "remastered": "remastered"}
_NEAR = 3
# Part of an effect's lambda that a fit of the arm leaves, from which on rows tell it from elasticity.
_VISIBLE = 0.25
# What CI runs (test_rows_study.py), on two cores in about three minutes: tables of each kind, and what is hidden in others.
CI_TABLES = 2
CI_HIDDEN = ("gear_eccentricity", "joint_coupling", "backlash")
_SOUND = [kind for kind in KINDS if kind not in OF_ROBOT]
# What is claimed, its rate and the tables that CI has for it.
CI = (
    ("a false name where nothing of the robot is hidden", 0.01, CI_TABLES * len(_SOUND)),
    ("no name where an effect of lambda 100 is hidden under correlated noise", 0.05, len(CI_HIDDEN) * len(CORRELATED)),
    ("adequate where intervals cover less than 90 %", 0.01, CI_TABLES * len(KINDS)),
)


class Task(NamedTuple):
    """A case to be drawn, and what is asked of it.

    Attributes:
        kind: of rows or of plans.
        seed: of everything.
        hidden: of rows: what is hidden of the robot besides, "" for nothing.
        strength: of rows: its lambda.
        verb: of plans: the command.
        arrival: of plans: how drives arrive at a stop [rad, prismatic m].
    """

    kind: str
    seed: int
    hidden: str = ""
    strength: float = 0.0
    verb: str = "discover"
    arrival: float = ARRIVAL


def said_of(task: Task) -> dict[str, Any]:
    """Return what a command says of a case, and how true that is, in types that JSON knows."""
    if task.kind in PLANS:
        return {**task._asdict(), **said_of_plan(task.kind, task.seed, task.verb, task.arrival)}
    return {**task._asdict(), **_said_of_rows(task)}


def _said_of_rows(task: Task) -> dict[str, Any]:
    """Return what a discovery says of a table of rows."""
    warnings.simplefilter("ignore", PincalWarning)
    case = draw_rows_case(task.kind, task.seed, hidden=task.hidden or None, strength=task.strength)
    known = {
        "arm": case.arm,
        "rows": len(case.rows),
        "declared": case.is_declared,
        "columns": sorted(case.campaign.columns),
        "seen": case.seen,
        "truth": [list(name) for name in case.truth],
        "setup": [list(name) for name in case.setup],
        "line": case.line,
    }
    begun = time.process_time()
    try:
        found = run_discovery(case.robot, case.rows, case.options)
    except PincalError as error:
        said: dict[str, Any] = {"refused": f"{type(error).__name__}: {error}"}
    else:
        said = _said(case, found)
    return {**known, **said, "seconds": time.process_time() - begun}


def _said(case: RowsCase, found: Discovery) -> dict[str, Any]:
    result, findings = found.calibration.result, found.findings
    names = [
        {
            "classes": [[name.effect, name.joint, name.source] for name in (entry, *entry.equivalent)],
            "p": entry.p_value,
        }
        for entry in findings.effects
    ]
    fit = found.calibration.fit
    table, clean = case.fresh(FRESH)
    at = fit.readings(table).conditions
    error, sigma = fit.predict(at)[:, :, 3] - clean, fit.position_sigma(at)
    return {
        "refused": result.doubt or result.shift or ("" if result.converged else "did not converge"),
        "names": names,
        "verdict": str(findings.verdict),
        "scatter": [entry.joint for entry in findings.scatter],
        "notes": [str(note) for note in result.warnings],
        "noise": [float(sigma) for sigma in fit.solution.sigma],
        "coverage": float(np.mean(np.abs(error) < 1.96 * sigma)),
        "coverage_placed": _coverage_placed(found, at, error),
        "true_mm": 1e3 * float(np.sqrt(np.mean(np.sum(error**2, axis=1)))),
        "stated_mm": 1e3 * float(np.sqrt(np.mean(np.sum(sigma**2, axis=1)))),
        "held_out_mm": result.error["calibrated"].get("test", {}).get("mean_mm"),
    }


def _coverage_placed(found: Discovery, at: Conditions, error: np.ndarray) -> float:
    """Return the share of intervals that hold the truth, of what a motion of the instrument leaves of errors, (N, 3).

    Where noise wanders along the rows it is a convention where the instrument stood; the robot is what it is.
    """
    model = found.calibration.fit.robot_model()
    places, J = model.model.linearise(model.model_values, at)
    J = J.reshape(-1, J.shape[-1])
    turns = np.stack([np.cross(axis, places[:, :, 3] - places[:, :, 3].mean(axis=0)) for axis in np.eye(3)], axis=-1)
    motion = np.concatenate([np.broadcast_to(np.eye(3), turns.shape), turns], axis=2).reshape(-1, 6)
    left = np.column_stack([error.ravel(), J])
    left -= motion @ np.linalg.lstsq(motion, left, rcond=None)[0]
    C = model.covariance[: J.shape[1], : J.shape[1]]
    sigma = np.sqrt(np.maximum(np.sum(left[:, 1:] @ C * left[:, 1:], axis=1), 0.0))
    return float(np.mean(np.abs(left[:, 0]) < 1.96 * sigma))


def version() -> str:
    """Return what ``git describe`` says of the code."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=10"]
    done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=False)
    return done.stdout.strip() or "unknown"


def read(path: Path) -> list[dict[str, Any]]:
    """Return the cases of a file; a line that a killed run left unfinished is none."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return [case for line in lines if (case := _parsed(line)) is not None]


def _parsed(line: str) -> dict[str, Any] | None:
    try:
        case = json.loads(line)
    except json.JSONDecodeError:
        return None
    return case if isinstance(case, dict) else None


def append(path: Path, case: dict[str, Any]) -> None:
    """Write one case behind the others, whole and to the disk."""
    with path.open("a+b") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - 1, 0))
        # What a killed run left unfinished ends here.
        end = b"" if size == 0 or file.read(1) == b"\n" else b"\n"
        file.write(end + json.dumps(case).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


def study(
    tasks: Iterable[Task], path: Path | None = None, *, workers: int = 2, any_version: bool = False
) -> list[dict[str, Any]]:
    """Return what a discovery says of some cases, those among them that a file has not already; it gets the others.

    Args:
        tasks: the cases.
        path: the file, one line of JSON for each case; None for none.
        workers: processes; 1 for this one alone.
        any_version: whether cases of other versions of the code count, too.
    """
    # That of the code which is loaded now, whatever is edited while it runs.
    of = version()
    before = [] if path is None else read(path)
    done = {_task(case): case for case in before if any_version or case["version"] == of}
    wanted = list(dict.fromkeys(tasks))
    for case in _said_of_all([task for task in wanted if task not in done], workers):
        case = {"version": of, **case}
        done[_task(case)] = case
        if path is not None:
            append(path, case)
    return [done[task] for task in wanted]


def _said_of_all(tasks: Sequence[Task], workers: int) -> Iterator[dict[str, Any]]:
    """Yield what is said of each case, in any order."""
    if workers == 1:
        yield from map(said_of, tasks)
    elif tasks:
        # Workers end with this process, however that ends.
        with ProcessPoolExecutor(workers, mp_context=get_context("forkserver"), initializer=end_with_parent) as pool:
            yield from (future.result() for future in as_completed([pool.submit(said_of, task) for task in tasks]))


def _task(case: dict[str, Any]) -> Task:
    # Lines of earlier versions have no field that came later.
    return Task(**{name: case[name] for name in Task._fields if name in case})


def is_adequate(case: dict[str, Any]) -> bool:
    """Return whether a discovery says that its model explains the data."""
    return not case["refused"] and case["verdict"] == "adequate"


def stands(case: dict[str, Any]) -> bool:
    """Return whether a result is neither refused nor called not adequate."""
    return not case["refused"] and case["verdict"] != "not adequate"


def covers_too_little(case: dict[str, Any]) -> bool:
    """Return whether a model is called adequate and its intervals don't cover."""
    return is_adequate(case) and case["coverage"] < COVERS


def false_names(case: dict[str, Any]) -> list[list[str | None]]:
    """Return names of the robot that were given where no name among their equals is true."""
    return [
        classes[0]
        for classes in _classes(case)
        if _is_of_robot(classes[0]) and not any(_is_true(name, case) for name in classes)
    ]


def names_of_setup(case: dict[str, Any]) -> list[list[str | None]]:
    """Return names of set-up, instrument or session."""
    return [classes[0] for classes in _classes(case) if _is_of_setup(classes[0])]


def alarms(case: dict[str, Any]) -> list[list[str | None]]:
    """Return dependences without a name."""
    return [classes[0] for classes in _classes(case) if classes[0][0] == "unnamed"]


def is_right(case: dict[str, Any]) -> bool:
    """Return whether what is hidden of the robot is named, alone or among its equals; of a bump its joint."""
    found = ((name, classes[0]) for classes in _classes(case) for name in classes)
    return is_told(case) or any(
        _is_true(name, case) and (name in case["truth"] or first[0] not in ELASTICITY) for name, first in found
    )


def is_named_of_setup(case: dict[str, Any]) -> bool:
    """Return whether what is wrong with set-up or instrument is named."""
    return is_told(case) or any(name in case["setup"] for classes in _classes(case) for name in classes)


def is_told(case: dict[str, Any]) -> bool:
    """Return whether a note tells what is other from which row on, joint, tool or instrument, or which joint has a bump."""
    joint = next((true[1] for true in case["truth"] if true[0] in ("remastered", "unnamed")), None)
    if case["kind"] == "bump":
        return any(f"where {joint} is" in note for note in case.get("notes", ()))
    words = [_SAYS.get(case["kind"], "\0"), joint or ""]
    lines = (re.findall(r"line (\d+)", note) for note in case.get("notes", ()) if all(word in note for word in words))
    return any(abs(int(line) - case["line"]) <= _NEAR for found in lines for line in found)


def _classes(case: dict[str, Any]) -> Iterator[list[list[str | None]]]:
    yield from (entry["classes"] for entry in case.get("names", ()))


def _is_true(name: list[str | None], case: dict[str, Any]) -> bool:
    # What has no name is known by its joint, whatever it is called, unless it is called the joint's elasticity.
    at = {true[1] for true in case["truth"] if true[0] == "unnamed"}
    return name in case["truth"] or (name[1] in at and name[0] not in ELASTICITY)


def _is_of_setup(name: list[str | None]) -> bool:
    return str(name[0]) in OF_SETUP or str(name[0]).startswith(_OF_SETUP)


def _is_of_robot(name: list[str | None]) -> bool:
    return name[0] != "unnamed" and name[0] not in ELASTICITY and not _is_of_setup(name)


def table(cases: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield what is to be said of each kind, in lines."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for case in cases:
        hidden = f" with {case['hidden']} at lambda {case['strength']:g}" if case["hidden"] else ""
        groups.setdefault(case["kind"] + hidden, []).append(case)
    for title, own in groups.items():
        yield from (title, *("  " + line for line in _lines(own)))
    if len(groups) > 1:
        sound = [case for case in cases if case["kind"] not in OF_ROBOT and not case["hidden"]]
        if sound:
            yield f"nothing of the robot hidden: a false name in {_share([bool(false_names(case)) for case in sound])}"
        if hidden := [case for case in cases if case["hidden"] and case["kind"] in CORRELATED]:
            yield f"hidden under correlated noise: named in {_share([is_right(case) for case in hidden])}"
            # What masses known to some per cent, and half of the rows, leave of it; the rest may be elasticity.
            seen = [is_right(case) for case in hidden if case["seen"] >= _VISIBLE * case["strength"]]
            yield f"  where a fit of the arm leaves a quarter of its lambda: {_share(seen)}"
        yield f"adequate where intervals cover less than {COVERS:.0%}: {_share([covers_too_little(case) for case in cases])}"


def table_of_plans(cases: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield the verdicts on each kind of plan, and the figures that are required of all, in lines."""
    for kind, verb in dict.fromkeys((case["kind"], case["verb"]) for case in cases):
        own = [case for case in cases if (case["kind"], case["verb"]) == (kind, verb)]
        verdicts = Counter(_verdict(case) for case in own)
        words = ", ".join(f"{verdict} {count}" for verdict, count in verdicts.most_common())
        seconds = np.median([case["seconds"] for case in own])
        yield f"{kind:22} {verb:10} {words}; {seconds:.1f} s each in the median"
    yield from required(cases, false_names)


def _verdict(case: dict[str, Any]) -> str:
    if case["refused"]:
        return f"refused (exit {case['exit']})"
    if "changed" in case:
        return "changed" if case["changed"] else "unchanged"
    return case["verdict"] + (" (shift, exit 4)" if case["shift"] else "")


def _lines(cases: Sequence[dict[str, Any]]) -> Iterator[str]:
    yield f"a false name in {_share([bool(false_names(case)) for case in cases])}{_counted(map(false_names, cases))}"
    if any(case["truth"] for case in cases):
        yield f"what is hidden is named in {_share([is_right(case) for case in cases])}"
    if any(case["setup"] for case in cases):
        yield f"what is wrong with the set-up is named in {_share([is_named_of_setup(case) for case in cases])}"
    for what, names in (("a name of the set-up", names_of_setup), ("a dependence without a name", alarms)):
        if some := [bool(names(case)) for case in cases if names(case)]:
            yield f"{what} in {len(some)}{_counted(map(names, cases))}"
    verdicts = Counter("refused" if case["refused"] else case["verdict"] for case in cases)
    yield ", ".join(f"{verdict} {count}" for verdict, count in verdicts.most_common())
    for what, own in (("all", cases), ("neither refused nor not adequate", [case for case in cases if stands(case)])):
        covered = np.array([case["coverage"] for case in own if "coverage" in case])
        if len(covered):
            error = f" +- {100 * covered.std(ddof=1) / np.sqrt(len(covered)):.1f}" if len(covered) > 1 else ""
            ratio = [case["true_mm"] / case["stated_mm"] for case in own if "coverage" in case]
            placed = 100 * np.mean([case["coverage_placed"] for case in own if "coverage" in case])
            yield (
                f"{what} ({len(covered)}): intervals cover {100 * covered.mean():.1f}{error} %, {placed:.1f} % apart from "
                f"where the instrument stands; true over stated error {np.median(ratio):.2f}, at most {max(ratio):.2f}"
            )
    if adequate := [covers_too_little(case) for case in cases if is_adequate(case)]:
        yield f"adequate where intervals cover less than {COVERS:.0%}: {_share(adequate)} of the adequate"
    yield f"{np.median([case['seconds'] for case in cases]):.1f} s each in the median"


def _share(hits: Sequence[bool]) -> str:
    return in_words(sum(hits), len(hits))


def _counted(names: Iterable[list[list[str | None]]]) -> str:
    counts = Counter(str(name[0]) for own in names for name in own)
    return f" ({', '.join(f'{count} {name}' for name, count in counts.most_common())})" if counts else ""


def rates() -> Iterator[str]:
    """Yield what CI's tables of this study, and those of independent rows, let it notice, in lines."""
    independent = ((f"{claim}, independent rows", rate, n) for claim, rate, n, _ in INDEPENDENT)
    for claim, rate, n in (*CI, *independent):
        yield (
            f"{claim}: at most {rate:.0%}; CI's {n} tables notice twice that with {power(rate, n):.0%} power and "
            f"{noticed(rate, n):.0%} with 90 %; to notice twice that with 90 % takes {tables_for(rate)}"
        )


# Kinds by the names of their groups.
_GROUPS = {"rows": KINDS, "plans": PLAN_KINDS}
_ALL_KINDS = (*KINDS, *PLAN_KINDS)


def main() -> None:
    """Run what is left of a study and print what it found."""
    parser = argparse.ArgumentParser(description="Print what the commands make of rows as they are measured in the world.")
    kinds_help = f"rows: {', '.join(KINDS)}; or plans: {', '.join(PLAN_KINDS)}; default: rows"
    choices = (*_GROUPS, *_ALL_KINDS)
    parser.add_argument("--kinds", nargs="+", choices=choices, default=["rows"], metavar="KIND", help=kinds_help)
    parser.add_argument("--count", type=int, default=100, help="tables of each kind; default: 100")
    parser.add_argument("--seed", type=int, default=27000, help="of the first table; default: 27000")
    parser.add_argument("--hidden", nargs="+", default=[""], choices=(*NAMED, *SOFT), metavar="EFFECT", help="hide these")
    parser.add_argument("--strength", type=float, default=100.0, help="their lambda by the true covariance; default: 100")
    parser.add_argument(
        "--verb", nargs="+", choices=VERBS, help="commands asked of plans; default: all that are meant for a kind"
    )
    parser.add_argument(
        "--arrival",
        type=float,
        default=1e6 * ARRIVAL,
        metavar="URAD",
        help=f"of plans, how drives arrive at a stop, 0 for exactly; default: {1e6 * ARRIVAL:g}",
    )
    parser.add_argument("--workers", type=int, default=2, help="processes; default: 2")
    parser.add_argument("--out", type=Path, default=Path("rows_study.jsonl"), help="file to go on with")
    parser.add_argument("--any-version", action="store_true", help="also count cases that another version of the code did")
    parser.add_argument("--rates", action="store_true", help="only print what CI's part of this would notice")
    chosen = parser.parse_args()
    if chosen.rates:
        print("\n".join(rates()))
        return
    kinds = dict.fromkeys(kind for name in chosen.kinds for kind in _GROUPS.get(name, (name,)))
    tasks = [task for seed in range(chosen.seed, chosen.seed + chosen.count) for task in _tasks(kinds, seed, chosen)]
    found = study(tasks, chosen.out, workers=chosen.workers, any_version=chosen.any_version)
    found = sorted(found, key=lambda case: (_ALL_KINDS.index(case["kind"]), case["hidden"]))
    if rows := [case for case in found if case["kind"] in KINDS]:
        print("\n".join(table(rows)))
    if plans := [case for case in found if case["kind"] in PLANS]:
        print("\n".join(table_of_plans(plans)))


def _tasks(kinds: Iterable[str], seed: int, chosen: argparse.Namespace) -> Iterator[Task]:
    """Yield the tasks of one seed."""
    kinds = list(kinds)
    for hidden in chosen.hidden:
        yield from (Task(kind, seed, hidden, chosen.strength if hidden else 0.0) for kind in kinds if kind in KINDS)
    for kind in (kind for kind in kinds if kind in PLANS):
        wanted = [verb for verb in PLANS[kind].verbs if chosen.verb is None or verb in chosen.verb]
        yield from (Task(kind, seed, verb=verb, arrival=1e-6 * chosen.arrival) for verb in wanted)


if __name__ == "__main__":
    for _name in ("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[_name] = "1"  # for the processes that are started
    main()
