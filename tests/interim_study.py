"""What interim checks find, and how often they are wrong: ``python tests/interim_study.py [CASE ...] --out FILE.jsonl``.

A KUKA is calibrated with 60 poses of a tracker and checked every day in the same five poses. ``sound``, ``noisy`` (1.5 times
the stated noise), ``quiet`` (half of it), ``walking`` (the base walks by 3 um a day) and ``creeping`` (3 um a day in one
direction) have not changed: any alarm within 60 days is false. ``tool`` (0.2 mm), ``base`` (0.3 mm), ``warm`` (10 K) and
``elbow`` (100 urad) change after ten days: found by the tenth check after it, in how many checks, and rightly named?
``anew`` and ``anew_tool`` have an instrument that is set up anew every day. Each robot is one line of the file as soon as it
is done: a run that was stopped goes on where it was. Rates stand with their exact 95 % intervals (Clopper and Pearson).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from interim_cases import TOOL, CheckedArm, checked_arm, day_of
from rates import in_words
from rows_study import append
from scipy.spatial.transform import Rotation

from pincal import Measurements
from pincal.calibration.check_record import CheckedRows
from pincal.fleet.checked_motion import chances_of, kinds_of_changes
from pincal.fleet.checked_robot import CheckSeries
from pincal.fleet.interim_evidence import CheckRows, InterimWatch

SOUND = ("sound", "noisy", "quiet", "walking", "creeping", "anew")
CHANGED = {"tool": "tool", "base": "base", "warm": "temperature", "elbow": "joint_3", "anew_tool": "tool"}
DAYS, BEFORE, AFTER = 60, 10, 10
LIMIT = np.log(20.0)
TIMES = {"noisy": 1.5, "quiet": 0.5}
STEP = 3e-6  # [m]


def tables(case: str, arm: CheckedArm, rng: np.random.Generator) -> Iterator[Measurements]:
    """Yield what is read of an arm day by day."""
    walk, way = np.zeros(3), rng.standard_normal(3)
    for day in range(DAYS if case in SOUND else BEFORE + AFTER):
        walk = walk + STEP * (rng.standard_normal(3) if case == "walking" else way / np.linalg.norm(way))
        facts: dict[str, Any] = {"times": TIMES.get(case, 1.0)}
        if case in ("walking", "creeping"):
            facts["base"] = walk
        if case.startswith("anew"):
            facts["turned"] = Rotation.random(rng=rng).as_matrix()
        if day >= BEFORE:
            facts |= changed(case, arm, way / np.linalg.norm(way))
        yield arm.table(**facts)


def changed(case: str, arm: CheckedArm, way: np.ndarray) -> dict[str, Any]:
    """Return what a check sees of a change in some direction."""
    if case in ("tool", "anew_tool"):
        return {"tool": TOOL + 2e-4 * way}
    if case == "base":
        return {"base": 3e-4 * way}
    if case == "warm":
        return {"warm": 10.0}
    return {"machine": arm.bent(1e-4)} if case == "elbow" else {}


def checks_of(case: str, arm: CheckedArm, measured: list[Measurements]) -> list[CheckRows]:
    """Return the checks as evidence takes them; in the same poses before the same instrument only residuals differ."""
    is_anew = case.startswith("anew")
    rows = [
        CheckedRows.of(table, day_of(day), arm.fitted.sigma, is_new_station=is_anew)
        for day, table in enumerate(measured if is_anew else measured[:1])
    ]
    found = list(CheckSeries(arm.fitted, tuple(rows)).rows)
    for table in measured[len(found) :]:
        assert table.position is not None
        assert measured[0].position is not None
        further = (table.position - measured[0].position).ravel() / arm.fitted.sigma[0]
        found.append(replace(found[0], residuals=found[0].residuals + further))
    return found


def one_robot(case: str, seed: int) -> dict[str, Any]:
    """Return when a robot raised an alarm first, and what was named then."""
    arm = checked_arm(seed)
    rng = np.random.default_rng([seed, 5])
    series = checks_of(case, arm, list(tables(case, arm, rng)))
    watch = InterimWatch(kinds_of_changes(arm.joints), chances_of(arm.joints), series[0].known.shape[1])
    largest, found = -np.inf, dict[str, Any]()
    for day, check in enumerate(series):
        watch.take(check)
        evidence = watch.evidence()
        largest = max(largest, evidence.log_e)
        if evidence.log_e >= LIMIT and not found:
            found = {"alarm": day, "what": evidence.suspect.kind, "equals": evidence.suspect.equals}
            if case in SOUND:
                break
    last = watch.evidence().suspect
    return {"case": case, "seed": seed, "largest": largest, **found, "last": last.kind, "last_equals": last.equals}


def told(case: str, found: list[dict[str, Any]]) -> str:
    """Return the figures of a case in words."""
    if case in SOUND:
        return f"{case}: false alarms {in_words(sum('alarm' in one for one in found), len(found))}"
    late = [one for one in found if one.get("alarm", -1) >= BEFORE]
    right = [one for one in late if CHANGED[case] in (one["last"], *one["last_equals"])]
    only = [one for one in right if one["last"] == CHANGED[case] and not one["last_equals"]]
    checks = [one["alarm"] - BEFORE + 1 for one in late]
    median = f"{np.median(checks):g}" if checks else "-"
    return (
        f"{case}: found {in_words(len(late), len(found))}; in {median} checks (median), {max(checks, default=0)} at most; "
        f"named among others {in_words(len(right), len(found))}, alone {in_words(len(only), len(found))}"
    )


def main() -> None:
    """Draw what is missing of each case, and print all figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=[*SOUND, *CHANGED])
    parser.add_argument("--count", type=int, default=0, help="robots of each case; default: 100 sound ones, 20 of a change")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    for case in arguments.cases:
        lines = arguments.out.read_text().splitlines() if arguments.out.exists() else []
        known = [one for one in map(json.loads, lines) if one["case"] == case]
        seeds = set(range(arguments.count or (100 if case in SOUND else 20))) - {one["seed"] for one in known}
        for seed in sorted(seeds):
            known.append(one_robot(case, seed))
            append(arguments.out, known[-1])
        print(told(case, known), flush=True)


if __name__ == "__main__":
    main()
