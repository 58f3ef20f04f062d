"""What each command makes of a table of ``plan_cases``, and the figures that are required of many of them.

``said_of_plan`` returns one table's figures in types that JSON knows; ``required`` turns those of many into the lines of a
summary, with exact intervals (Clopper and Pearson) of rates, and of means by the scatter from table to table.
"""

from __future__ import annotations

import re
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from msgspec import UNSET, to_builtins
from plan_cases import PlanCase, anywhere, draw_plan_case
from rates import in_words, interval
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import t as student

from pincal import GEOMETRIC, Calibration, Discovery, calibrate, diagnose, run_calibration, run_discovery
from pincal import simulate as sim
from pincal.diagnosis.robot_diagnosis import Diagnosis
from pincal.errors import PincalError, PincalWarning
from pincal.io.urdf_export import calibrated_urdf

# Poses never measured at which a model is held against the truth.
FRESH = 300
# How far from the line of a change a doubt may name it.
_NEAR = 3
_NUMBERS = re.compile(r"lines? ((?:\d+(?:, | and )?)+)")
# Bounds of the figures that are required.
MOST_FALSE, MOST_FALSE_SURELY = 0.01, 0.03
COVER = (0.93, 0.97)
NO_WORSE = 1.02
HEADLINE = (0.9, 1.3)
LEAST_TOLD = 0.95
MOST_ACCUSED = 0.01


def said_of_plan(kind: str, seed: int, verb: str, arrival: float) -> dict[str, Any]:
    """Return what a command says of a table, and how true that is."""
    warnings.simplefilter("ignore", PincalWarning)
    case = draw_plan_case(kind, seed, arrival=arrival)
    known = {
        "arm": case.arm,
        "rows": len(case.rows),
        "declared": case.is_declared,
        "columns": sorted(case.rows.columns()),
        "truth": [list(name) for name in case.trouble.truth],
        "setup": [],
        "changes": case.trouble.changes,
        "line": case.line,
        "wrong": list(case.wrong),
        "size": case.trouble.size,
        "sigmas": case.trouble.sigmas,
    }
    asked = _VERBS[verb]
    begun = time.process_time()
    try:
        found = asked.ask(case)
    except PincalError as error:
        said: dict[str, Any] = {"refused": f"{type(error).__name__}: {error}", "exit": int(error.exit_code)}
    except Exception as error:
        # The command calls it an internal error and ends with 1.
        where = traceback.extract_tb(error.__traceback__)[-1]
        why = f"internal error: {type(error).__name__}: {error} ({where.name}, line {where.lineno})"
        said = {"refused": why, "exit": 1}
    else:
        said = asked.say(case, found)
    return {**known, **said, "seconds": time.process_time() - begun}


def _calibrate(case: PlanCase) -> Calibration:
    return run_calibration(case.scene.robot, case.rows, case.options)


def _said_of_calibration(case: PlanCase, found: Calibration) -> dict[str, Any]:
    said = _said(case, found, str(found.result.verdict_of()))
    everything = calibrate(case.scene.robot, case.rows, case.options)
    for where, poses in _poses(case).items():
        at = case.fresh(poses, case.rng(3))
        conditions = everything.readings(at.table).conditions
        said[f"true_{where}_all_mm"] = _mean_mm(everything.predict(conditions)[:, :, 3] - at.clean)
    if case.plan.is_marker:
        said["kinematic_mm"] = _kinematic(case, found)
    return said


def _discover(case: PlanCase) -> Discovery:
    return run_discovery(case.scene.robot, case.rows, replace(case.options, effects=GEOMETRIC))


def _said_of_discovery(case: PlanCase, found: Discovery) -> dict[str, Any]:
    names = [
        {
            "classes": [[name.effect, name.joint, name.source] for name in (entry, *entry.equivalent)],
            "p": entry.p_value,
        }
        for entry in found.findings.effects
    ]
    return {**_said(case, found.calibration, str(found.findings.verdict)), "names": names}


def _uses_means(case: PlanCase) -> bool:
    """Return whether a robot that is diagnosed was calibrated by the means of its stops and not by its rows, in turn."""
    return case.plan.readings > 1 and case.seed // 2 % 2 == 0


def _diagnose(case: PlanCase) -> Diagnosis:
    """Diagnose the robot, unchanged."""
    rows = case.means() if _uses_means(case) else case.rows
    model = run_calibration(case.scene.robot, rows, case.options).fit
    return diagnose(model, case.measured_again())


def _said_of_diagnosis(case: PlanCase, found: Diagnosis) -> dict[str, Any]:
    return {
        "refused": "",
        "exit": 6 if found.changed else 0,
        "by_means": _uses_means(case),
        "new_rows": found.found.rows,
        "changed": found.changed,
        "names_of_change": [[change.effect, change.joint] for change in found.changes],
        "p": found.found.p_value,
    }


class _Verb(NamedTuple):
    """What the library is asked of a table, and what is to be said of its answer."""

    ask: Callable[[PlanCase], Any]
    say: Callable[[PlanCase, Any], dict[str, Any]]


_VERBS = {
    "calibrate": _Verb(_calibrate, _said_of_calibration),
    "discover": _Verb(_discover, _said_of_discovery),
    "diagnose": _Verb(_diagnose, _said_of_diagnosis),
}
VERBS = tuple(_VERBS)


def _poses(case: PlanCase) -> dict[str, np.ndarray]:
    """Return fresh poses of the plan, and anywhere within the limits, shape (FRESH, n) each."""
    rng = case.rng(1)
    return {"plan": case.region.fresh(FRESH, rng), "any": anywhere(case.scene, FRESH, rng)}


def _said(case: PlanCase, found: Calibration, verdict: str) -> dict[str, Any]:
    result, fit = found.result, found.fit
    is_refused = bool(result.doubt) or not result.converged
    said: dict[str, Any] = {
        "refused": result.doubt or ("" if result.converged else "did not converge"),
        "shift": result.shift,
        "exit": 4 if is_refused or result.shift else 0,
        "verdict": verdict,
        "doubts": [[str(note), list(note.rows)] for note in result.warnings if note.is_doubt],
        "notes": [[str(note), list(note.rows)] for note in result.warnings if not note.is_doubt],
        "outliers": list(result.outliers),
        "noise": [float(sigma) for sigma in fit.solution.sigma],
    }
    for where, poses in _poses(case).items():
        at = case.fresh(poses, case.rng(3))
        conditions = fit.readings(at.table).conditions
        place, sigma = fit.predict(conditions)[:, :, 3], fit.position_sigma(conditions)
        said |= {
            f"coverage_{where}": _covered(place - at.clean, sigma),
            f"coverage_{where}_arrived": _covered(place - at.arrived, sigma),
            f"true_{where}_mm": _mean_mm(place - at.clean),
            f"stated_{where}_mm": 1e3 * float(np.sqrt(np.mean(np.sum(sigma**2, axis=1)))),
        }
        if where == "plan" and "position" in case.scene.sigma:
            said |= {"expected_mm": _mean_mm(place - at.read), "expected_of_means_mm": _mean_mm(place - at.mean)}
    held_out = result.error["calibrated"].get("test", {})
    said["headline_mm"] = held_out.get("mean_mm")
    elsewhere = getattr(result, "elsewhere", None)
    if elsewhere is not None and elsewhere is not UNSET:
        said["elsewhere"] = to_builtins(elsewhere)
    return said


def _covered(error: np.ndarray, sigma: np.ndarray) -> float:
    return float(np.mean(np.abs(error) < 1.96 * sigma))


def _mean_mm(error: np.ndarray) -> float:
    return 1e3 * float(np.mean(np.linalg.norm(error, axis=1)))


def _kinematic(case: PlanCase, found: Calibration) -> dict[str, float]:
    """Return the error of the URDF's geometry and of the calibrated one, base and tool fitted to exact rows [mm]."""
    at = case.fresh(_poses(case)["any"], case.rng(3))
    model = found.fit.robot_model()
    delivered = calibrated_urdf(model.model, model.values)
    arm = sim.read_arm(delivered.text.decode("utf-8"), delivered.tip)
    arms = {"nominal": case.scene.nominal, "calibrated": arm}
    tips = {name: sim.TrueMachine.of_arm(arm).tip(at.table.q) for name, arm in arms.items()}
    return {name: _mean_mm(placed_best(tip, at.clean)) for name, tip in tips.items()}


def placed_best(tip: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return what a base frame and a target leave of readings, shape (N, 3) [m], for tips of shape (N, 4, 4)."""

    def left(p: np.ndarray) -> np.ndarray:
        at_base = tip[:, :3, :3] @ p[6:] + tip[:, :3, 3]
        return np.asarray(Rotation.from_rotvec(p[:3]).apply(at_base) + p[3:6] - seen)

    # Where the tip stands for the target, closed form gives the base to start from.
    a, b = tip[:, :3, 3], seen
    turn, _ = Rotation.align_vectors(b - b.mean(axis=0), a - a.mean(axis=0))
    start = np.concatenate([turn.as_rotvec(), b.mean(axis=0) - turn.apply(a.mean(axis=0)), np.zeros(3)])
    found = least_squares(lambda p: left(p).ravel(), start, x_scale="jac")
    return left(found.x)


# What is required -------------------------------------------------------------------------------------------------------


def stands(case: dict[str, Any]) -> bool:
    """Return whether a result is neither refused nor called not adequate."""
    return not case["refused"] and not case["exit"] and case["verdict"] != "not adequate"


def named_lines(case: dict[str, Any]) -> set[int]:
    """Return the lines of rows that a result calls wrong."""
    return set(case.get("outliers", ())) | {line for _, rows in case.get("doubts", ()) for line in rows}


def is_told(case: dict[str, Any]) -> bool:
    """Return whether a change between passes is told: exit 4, or a doubt with its line.

    Where something alternates it has no line, and any doubt tells it.
    """
    if case["exit"] == 4:
        return True
    doubts = case.get("doubts", ())
    if case["line"] is None:
        return bool(doubts)
    lines = [int(n) for text, _ in doubts for some in _NUMBERS.findall(text) for n in re.findall(r"\d+", some)]
    lines += [line for _, rows in doubts for line in rows]
    return any(abs(line - case["line"]) <= _NEAR for line in lines)


class Figure(NamedTuple):
    """A figure that is required.

    Attributes:
        title: what it is, and what it must be.
        of: the cases that it concerns.
        line: what is to be said of some of them, and whether that is what it must be, None where nothing is required;
            None where there is nothing to say.
    """

    title: str
    of: Callable[[dict[str, Any]], bool]
    line: Callable[[Sequence[dict[str, Any]]], tuple[str, bool | None] | None]


def required(cases: Sequence[dict[str, Any]], false_names: Callable[[dict[str, Any]], list[Any]]) -> Iterator[str]:
    """Yield each figure that is required, over all tables that it concerns and kind by kind, in lines."""
    for figure in (*_figures(false_names), *_OTHERS):
        own = [case for case in cases if figure.of(case)]
        whole = figure.line(own) if own else None
        if whole is None:
            continue
        yield figure.title
        yield f"  {'all':30} {_marked(whole)}"
        has_verbs = len({case["verb"] for case in own}) > 1
        for kind, verb in dict.fromkeys((case["kind"], case["verb"]) for case in own):
            part = figure.line([case for case in own if (case["kind"], case["verb"]) == (kind, verb)])
            title = f"{kind} {verb}" if has_verbs else kind
            if part is not None:
                yield f"  {title:30} {_marked(part)}"


def _marked(line: tuple[str, bool | None]) -> str:
    words, is_met = line
    mark = {None: "", True: "met", False: "MISS"}[is_met]
    return f"{mark:5} {words}"


def _seldom(hits: Sequence[bool]) -> tuple[str, bool]:
    """Say how often something happened that may happen in 1 % of the tables."""
    rate, (_, high) = np.mean(hits), interval(sum(hits), len(hits))
    is_met = bool(rate <= MOST_FALSE)
    open_ = "" if high <= MOST_FALSE_SURELY or not is_met else "; too few tables to be sure"
    return in_words(sum(hits), len(hits)) + open_, is_met


def _mean(values: Sequence[float]) -> tuple[float, str]:
    """Return a mean, and it in words with its 95 % interval by the scatter of the values."""
    of = np.asarray(values, float)
    mean = float(of.mean())
    if len(of) < 2:
        return mean, f"{mean:.3f} (1 table)"
    half = float(student.ppf(0.975, len(of) - 1) * of.std(ddof=1) / np.sqrt(len(of)))
    return mean, f"{mean:.3f} +- {half:.3f} ({len(of)} tables, {of.min():.3f} to {of.max():.3f})"


def _figures(false_names: Callable[[dict[str, Any]], list[Any]]) -> Iterator[Figure]:
    """Yield the figures of names, which the study of rows counts."""
    yield Figure(
        "false names in <= 1 % of the tables (upper limit <= 3 %)",
        lambda case: "names" in case,
        lambda cases: _seldom([bool(false_names(case)) for case in cases]),
    )


def _coverage(where: str) -> Figure:
    def line(cases: Sequence[dict[str, Any]]) -> tuple[str, bool] | None:
        standing = [case for case in cases if stands(case)]
        if not standing:
            return None
        mean, words = _mean([case[f"coverage_{where}"] for case in standing])
        arrived = np.mean([case[f"coverage_{where}_arrived"] for case in standing])
        ratio = np.median([case[f"true_{where}_mm"] / case[f"stated_{where}_mm"] for case in standing])
        more = f"; as drives arrive {arrived:.3f}; true over stated {ratio:.2f}"
        return words + more, COVER[0] <= mean <= COVER[1]

    names = {"plan": "fresh poses of the plan", "any": "poses anywhere within the limits"}
    return Figure(
        f"intervals at {names[where]} cover 93 to 97 %, neither refused nor not adequate",
        lambda case: f"coverage_{where}" in case and not case["changes"],
        line,
    )


def _against_all(cases: Sequence[dict[str, Any]]) -> tuple[str, bool]:
    ratios = [case["true_plan_mm"] / case["true_plan_all_mm"] for case in cases]
    mean, words = _mean(ratios)
    anywhere = np.mean([case["true_any_mm"] / case["true_any_all_mm"] for case in cases])
    return f"{words}; anywhere {anywhere:.3f}", mean <= NO_WORSE


def _headline(cases: Sequence[dict[str, Any]]) -> tuple[str, bool]:
    ratios = [case["headline_mm"] / case["expected_mm"] for case in cases]
    mean, words = _mean(ratios)
    within = [HEADLINE[0] <= ratio <= HEADLINE[1] for ratio in ratios]
    of_means = np.mean([case["headline_mm"] / case["expected_of_means_mm"] for case in cases])
    more = f"; within in {in_words(sum(within), len(within))}; of a pose's mean {of_means:.3f}"
    return words + more, HEADLINE[0] <= mean <= HEADLINE[1]


def _elsewhere(cases: Sequence[dict[str, Any]]) -> tuple[str, bool]:
    covers = [case["true_any_mm"] <= case["elsewhere"]["worst_mm"] for case in cases]
    ratio = np.median([case["elsewhere"]["mean_mm"] / case["true_any_mm"] for case in cases])
    words = f"the worst covers the true mean in {in_words(sum(covers), len(covers))}"
    return f"{words}; stated over true mean {ratio:.2f}", np.mean(covers) >= LEAST_TOLD


def _refused(cases: Sequence[dict[str, Any]]) -> tuple[str, None] | None:
    refused = sum(bool(case["refused"]) for case in cases)
    return (in_words(refused, len(cases)), None) if refused else None


def _told(cases: Sequence[dict[str, Any]]) -> tuple[str, bool]:
    told = [is_told(case) for case in cases]
    adequate = [not case["refused"] and case.get("verdict") == "adequate" for case in cases]
    missed = [case["sigmas"] for case, is_known in zip(cases, told, strict=True) if not is_known and case["sigmas"]]
    sizes = f"; not told: up to {max(missed):.1f} sigma" if missed else ""
    words = f"{in_words(sum(told), len(told))}; adequate in {sum(adequate)}{sizes}"
    return words, bool(np.mean(told) >= LEAST_TOLD and not any(adequate))


def _wrong(cases: Sequence[dict[str, Any]]) -> tuple[str, bool]:
    hits = sum(len(named_lines(case) & set(case["wrong"])) for case in cases)
    every = sum(len(case["wrong"]) for case in cases)
    accused = sum(len(named_lines(case) - set(case["wrong"])) for case in cases)
    words = f"named {in_words(hits, every)} of the lines; {accused} sound lines accused in {len(cases)} tables"
    return words, hits >= LEAST_TOLD * every and accused <= MOST_ACCUSED * len(cases)


def _markers(cases: Sequence[dict[str, Any]]) -> tuple[str, bool]:
    nominal, calibrated = (np.array([case["kinematic_mm"][of] for case in cases]) for of in ("nominal", "calibrated"))
    _, words = _mean(calibrated / nominal)
    means = calibrated.mean() / nominal.mean()
    worse = int(np.sum(calibrated > nominal * NO_WORSE))
    return f"{words}; of the means {means:.3f}; worse by over 2 % in {worse}", bool(means <= NO_WORSE)


_OTHERS = (
    Figure(
        "false 'has changed' in <= 1 % (upper limit <= 3 %)",
        lambda case: "changed" in case,
        lambda cases: _seldom([case["changed"] for case in cases]),
    ),
    Figure(
        "refused, or an internal error, though nothing changes",
        lambda case: not case["changes"],
        _refused,
    ),
    _coverage("plan"),
    _coverage("any"),
    Figure(
        "true error of the delivered model <= 1.02 of that of a fit of all rows",
        lambda case: "true_plan_all_mm" in case and not case["changes"],
        _against_all,
    ),
    Figure(
        "headline .9 to 1.3 of what a fresh reading of the plan shows",
        lambda case: case.get("headline_mm") is not None and "expected_mm" in case and not case["changes"],
        _headline,
    ),
    Figure("the line of the workspace against the truth there", lambda case: "elsewhere" in case, _elsewhere),
    Figure(
        "a change between passes: exit 4 or a doubt with its line in >= 95 %, adequate in none",
        lambda case: case["changes"] and case["verb"] != "diagnose",
        _told,
    ),
    Figure(
        "wrong readings: >= 95 % named by their line, at most 1 sound line accused in 100 tables",
        lambda case: bool(case["wrong"]) and "outliers" in case,
        _wrong,
    ),
    Figure(
        "markers: the geometry is no worse than the URDF's by over 2 % in the mean",
        lambda case: "kinematic_mm" in case,
        _markers,
    ),
)
