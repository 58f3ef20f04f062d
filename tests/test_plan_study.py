"""Draws of planned tables are what they are said to be, and the study of them runs, resumes and counts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import plan_figures
import pytest
import rows_study
from plan_cases import ARRIVAL, PLAN_KINDS, PLANS, SIGMA, PlanCase, draw_plan_case
from plan_figures import is_told, named_lines, required
from rows_study import Task, read, study

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")


def position(case: PlanCase) -> np.ndarray:
    found = case.rows.position
    assert found is not None
    return found


@pytest.mark.parametrize(
    # Of ISO 9283's plan a table has thirty cycles, which take as long as those of the others together.
    "kind",
    [pytest.param(kind, marks=pytest.mark.long if k % 3 or kind == "iso9283" else ()) for k, kind in enumerate(PLAN_KINDS)],
)
def test_a_table_of_each_plan_is_the_same_again_and_has_few_rows(kind: str) -> None:
    """At most some 600 rows, and two draws of a seed differ nowhere."""
    one, other = (draw_plan_case(kind, 4) for _ in range(2))

    assert 10 < len(one.rows) < 650
    for name, values in one.rows.columns().items():
        assert np.array_equal(values, other.rows.columns()[name])
    # A change has a line unless it comes again and again.
    assert (one.line is not None) == (one.trouble.changes and kind != "load_alternates")


def test_readings_of_a_stop_share_how_the_drives_arrived() -> None:
    """Within a stop readings scatter by the noise of the instrument, between stops of a pose by the drives besides."""
    dwell = draw_plan_case("dwell20", 1, arm="light", poses=30)
    cycles = draw_plan_case("cycles30", 1, arm="light", poses=20)
    exact = draw_plan_case("cycles30", 1, arm="light", poses=20, arrival=0.0)
    within = position(dwell).reshape(30, 20, 3).std(axis=1, ddof=1)
    between, still = (position(case).reshape(30, 20, 3).std(axis=0, ddof=1) for case in (cycles, exact))

    # Four standard errors of a root of a mean of 19 x 90 and of 29 x 60 squares.
    assert np.sqrt(np.mean(within**2)) == pytest.approx(SIGMA, rel=0.07)
    assert np.sqrt(np.mean(still**2)) == pytest.approx(SIGMA, rel=0.07)
    # The drives of a light arm, a metre from the tool.
    assert 0.2 * ARRIVAL < np.sqrt(np.mean(between**2) - SIGMA**2) < 2.0 * ARRIVAL


def test_targets_of_a_stop_share_how_the_drives_arrived() -> None:
    """The misses of five targets, base and tool known, are nearly the same motion of the flange."""
    case = draw_plan_case("five_targets", 2, arm="heavy", arrival=1e-3)
    exact = draw_plan_case("five_targets", 2, arm="heavy", arrival=0.0)
    missed = position(case) - position(exact)
    pairs = np.flatnonzero(np.diff(case.stop) == 0)

    assert set(np.unique(case.rows.target)) == {f"smr{k}" for k in range(5)}
    assert 0.85 < len(case.rows) / (5 * (case.stop[-1] + 1)) < 0.99
    apart = np.linalg.norm(missed[pairs + 1] - missed[pairs], axis=1)
    assert np.median(apart) < 0.3 * np.median(np.linalg.norm(missed, axis=1))


@pytest.mark.parametrize("kind", ["passes2_shift_1mm", "passes2_shift", "passes3_shift"])
def test_a_shift_begins_at_its_line(kind: str) -> None:
    """Visits of a pose on the two sides of the line differ by it on average."""
    case = draw_plan_case(kind, 3)
    after = case.rows.rows >= case.line
    stops = case.trouble.stops
    poses = len(stops.q) // (stops.turn.max() + 1)
    passes = position(case).reshape(-1, poses, 3).mean(axis=1)
    moved = passes[after[::poses]].mean(axis=0) - passes[~after[::poses]].mean(axis=0)

    assert not after[0] and after[-1]
    assert np.linalg.norm(moved) == pytest.approx(case.trouble.size, rel=0.5)


def test_wrong_readings_are_at_the_lines_that_are_said() -> None:
    """One in 25, each 3 mm from the other visits of its pose."""
    case = draw_plan_case("wrong_in_cycles5", 1)
    visits = position(case).reshape(5, -1, 3)
    off = np.linalg.norm(visits - np.median(visits, axis=0), axis=2).ravel()

    assert tuple(case.rows.rows[off > 2e-3].tolist()) == case.wrong
    assert len(case.wrong) == round(0.04 * len(case.rows))


@pytest.mark.parametrize("kind", ["joint6_at_45deg", "joints_1_to_3_rest", "three_joints_moved"])
def test_joints_at_rest_do_not_move_in_fresh_poses_of_the_plan_either(kind: str) -> None:
    """As many joints stand still, at the same place, and anywhere else they move."""
    case = draw_plan_case(kind, 1, poses=20)
    fresh = case.region.fresh(10, case.rng(1))
    still = np.ptp(case.rows.q, axis=0) == 0.0

    assert still.sum() == {"joint6_at_45deg": 1}.get(kind, 3)
    assert np.array_equal(np.ptp(fresh, axis=0) == 0.0, still)
    assert np.array_equal(fresh[0, still], case.rows.q[0, still])


@pytest.mark.parametrize("kind", ["once", "board_points", "track_3m", "five_targets"])
def test_truth_at_fresh_poses_is_that_of_the_table(kind: str) -> None:
    """Without noise and with exact drives the truth at a pose of the table is what the sensor reads there."""
    case = draw_plan_case(kind, 5, arrival=0.0)
    first = np.unique(case.stop, return_index=True)[1][:10]
    at = case.fresh(case.rows.q[first], np.random.default_rng(0))

    assert at.arrived == pytest.approx(at.clean, abs=1e-12)
    if kind == "board_points":
        # Seen from the camera, a point of the board is as far as it is.
        place = np.array([case.scene.setup.points[name] for name in case.rows.point[first]])
        seen = np.linalg.norm(case.rows.camera_point[first], axis=1)
        assert np.linalg.norm(place - at.clean, axis=1) == pytest.approx(seen, abs=6.0 * 5e-5)
    else:
        same = at.table.target == case.rows.target[first]
        assert position(case)[first][same] == pytest.approx(at.clean[same], abs=6.0 * SIGMA)


def test_lines_are_those_that_a_result_names() -> None:
    """Outliers, and rows of doubts; a change is told within three rows, in words or as a row, or by exit 4."""
    case: dict[str, Any] = {"exit": 0, "line": 62, "doubts": [["look at lines 11, 64 and 90", []]]}

    assert named_lines({"outliers": [3], "doubts": [["wrong", [5, 7]]]}) == {3, 5, 7}
    assert is_told(case) and is_told({**case, "doubts": [["a shift", [60]]]})
    assert not is_told({**case, "doubts": [["from line 66 on", []]]})
    assert not is_told({**case, "doubts": [["62 rows are noisy", []]]})
    assert is_told({**case, "doubts": [], "exit": 4})
    assert is_told({**case, "line": None}) and not is_told({**case, "line": None, "doubts": []})


def test_figures_are_met_or_missed() -> None:
    """A figure stands over all tables and kind by kind, each with whether it is what it must be."""
    plain = {"changes": False, "refused": "", "exit": 0, "verdict": "adequate", "verb": "calibrate", "wrong": []}
    covered = {"coverage_plan": 0.95, "coverage_plan_arrived": 0.8, "true_plan_mm": 1.0, "stated_plan_mm": 1.0}
    good = {**plain, **covered, "kind": "once"}
    bad = {**good, "kind": "cycles2", "coverage_plan": 0.6}
    refused = {**bad, "verdict": "not adequate"}
    lines = [" ".join(line.split()) for line in required([good, bad, refused], lambda case: [])]

    assert any(line.startswith("once met 0.950 (1 table)") for line in lines)
    assert any(line.startswith("cycles2 MISS 0.600 (1 table)") for line in lines)
    assert any(line.startswith("all MISS 0.775") for line in lines)


@pytest.mark.long
@pytest.mark.first
def test_a_study_of_plans_runs_and_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every command says what is counted of it, and a second run asks nothing again."""
    monkeypatch.setattr(rows_study, "version", lambda: "v1")
    tasks = [Task("once", 1, verb=verb) for verb in PLANS["once"].verbs if verb != "calibrate"]
    tasks += [Task(kind, 1, verb="calibrate") for kind in ("passes2_shift", "dwell3", "markers14")]
    # One whose model is adequate, so that its intervals count.
    tasks += [Task("once", 1, verb="calibrate", arrival=0.0)]
    path = tmp_path / "plans.jsonl"
    found = study(tasks, path, workers=1)
    monkeypatch.setattr(rows_study, "said_of", lambda task: pytest.fail(f"asked again: {task}"))
    again = study(tasks, path, workers=1)
    summary = "\n".join(rows_study.table_of_plans(found))

    assert again == found == read(path)
    assert not any(case["refused"] for case in found)
    for title in ("false names", "has changed", "intervals at fresh poses", "true error", "headline", "between passes"):
        assert title in summary
    assert "markers: the geometry" in summary
    assert {case["verb"] for case in found} == set(plan_figures.VERBS)
