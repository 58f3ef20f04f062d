"""Every number of a report is an entry of the files beside it, and the words around it are true of that entry."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from page_numbers import PageNumbers, disagreements, numbers_without_source
from report_cases import NOISE, ORIGIN, discovered, drifted, kuka_run, measured

from pincal import ELASTIC, GEOMETRIC, Options, Robot, run_calibration
from pincal.builtin import kuka_urdf_path
from pincal.calibration.calibration import Calibration
from pincal.cli import main
from pincal.diagnosis.diagnosis_page import diagnosis_page, excluded_table
from pincal.discover.report.search_answer import SearchAnswer
from pincal.motion.sessions import read_session
from pincal.motion.stations import session_tables
from pincal.report.html import report_page
from pincal.report.judgement import judged
from pincal.report.subject import Subject, evidence_of

# Constants of the page: the tolerance of the example, the norms, limits that a text names.
CONSTANTS = "ISO 9283, ISO 14253-1, tolerance of ± 0.5 mm, above 0.9"


@pytest.fixture(scope="module")
def runs(kuka: Robot) -> dict[str, Calibration]:
    """Return calibrations whose errors are stated in different ways."""
    table = measured(kuka, kuka_urdf_path(), 110)
    options = Options(effects=GEOMETRIC, sigma=NOISE)
    return {
        "folds": run_calibration(kuka, table, options),
        "held out": run_calibration(kuka, table, options, test_fraction=0.3),
        "fitted": run_calibration(kuka, table.select(np.arange(60)), options, split="random"),
        "elastic": run_calibration(kuka, table, Options(effects=ELASTIC)),
        "poses": kuka_run(kuka, 90, kind="pose"),
        "stations": run_calibration(
            kuka, {"a": table.select(np.arange(55)), "b": table.select(np.arange(55, 110))}, options
        ),
    }


@pytest.fixture(scope="module")
def texts(runs: dict[str, Calibration]) -> dict[str, str]:
    """Return the pages of these calibrations."""
    return {name: report_page(Subject(run, ORIGIN)) for name, run in runs.items()}


def checked(page: PageNumbers, subject: Subject, files: dict[str, Any]) -> PageNumbers:
    """Return the numbers of the page of a subject, all of which are entries of its files."""
    files = json.loads(json.dumps(files))
    said = json.dumps(files, ensure_ascii=False) + str(judged(subject.result, subject.search).reason) + CONSTANTS
    assert [*disagreements(page, files)] == []
    assert numbers_without_source(page, said) == []
    return page


@pytest.mark.parametrize("name", ["folds", "held out", "fitted", "elastic", "poses", "stations"])
def test_every_number_of_a_calibration_is_in_its_result(
    runs: dict[str, Calibration], texts: dict[str, str], name: str
) -> None:
    """To the digits that are shown, in the unit that is shown; at least as many as there are parameters."""
    run = runs[name]
    page = checked(PageNumbers(texts[name]), Subject(run, ORIGIN), {"result.json": run.result.to_dict()})

    assert len(page.shown) > len(run.result.parameters)


@pytest.mark.long
def test_every_number_of_a_search_is_in_its_result() -> None:
    """Those of the calibration in result.json, those of what was found in discovery.json."""
    found = discovered()
    files = {"result.json": found.calibration.result.to_dict(), "discovery.json": found.report}
    subject = Subject(found.calibration, ORIGIN, search=SearchAnswer(found))
    page = checked(PageNumbers(report_page(subject)), subject, files)

    assert any(pointer.startswith("discovery.json#/effects/0/") for of in page.shown for pointer in of.pointers)


def test_a_wrong_number_is_noticed(runs: dict[str, Calibration], texts: dict[str, str]) -> None:
    """One more in the last digit that is shown."""
    run, text = runs["folds"], texts["folds"]
    mean = f"{run.result.error['calibrated']['test']['mean_mm']:.4f}"
    wrong = f"{float(mean) + 1e-4:.4f}"
    page = PageNumbers(text.replace(f">{mean} mm<", f">{wrong} mm<", 1))

    assert len([*disagreements(page, {"result.json": run.result.to_dict()})]) == 1


def test_before_and_after_are_stated_at_the_same_rows(runs: dict[str, Calibration]) -> None:
    """The way in which the calibrated model predicts worse is that of the nominal one, too."""
    for name in ("folds", "stations", "elastic"):
        result = runs[name].result
        way = result.validation.way  # type: ignore[union-attr]
        for model, by_part in result.error.items():
            assert by_part["test"] == by_part[way], (name, model)
        calibrated = result.error["calibrated"]
        assert calibrated["test"]["mean_mm"] == max(calibrated[part]["mean_mm"] for part in ("regions", "stretches"))


@pytest.mark.parametrize("name", ["folds", "held out"])
def test_the_first_sentence_is_of_the_rows_that_are_drawn(runs: dict[str, Calibration], name: str) -> None:
    """The mean of the sizes of the errors that the histogram beside it shows; counted one by one."""
    run = runs[name]
    (evidence,) = evidence_of(run)
    rows = evidence.part(held=True) & ~evidence.is_outlier
    for which, model in (("before", "nominal"), ("after", "calibrated")):
        error = run.result.error[model]["test"]["mean_mm"]
        assert evidence.sizes(which)[rows].mean() == pytest.approx(error, rel=1e-9)  # type: ignore[arg-type]
    assert rows.sum() == run.result.rows["test"]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("folds", "is predicted by a fit without its (region of joint space|stretch of consecutive rows)"),
        ("held out", "errors in [0-9]+ rows that the calibration has not used"),
    ],
)
def test_the_way_of_holding_out_is_named(runs: dict[str, Calibration], texts: dict[str, str], name: str, words: str) -> None:
    """By the way that result.json has."""
    run = runs[name]
    page = " ".join(re.sub("<[^>]*>", "", texts[name].partition("</style>")[2]).split())

    assert re.search(words, page)
    if name == "folds":
        (way,) = (way for way in ("regions", "stretches") if way == run.result.validation.way)  # type: ignore[union-attr]
        assert f"a fit without its {way[:-1] if way == 'regions' else 'stretch'}" in page


@pytest.mark.long
def test_an_imu_says_what_the_angles_gained(tmp_path: Path) -> None:
    """By the eigenvalues of their covariance, as all have one prior; every number of the page is an entry, here too."""
    with pytest.raises(SystemExit):
        main(["simulate", "ur5", "--path", "40s", "--imu", "--elastic", "0", "--seed", "3", "--out", str(tmp_path / "day")])
    robot = Robot.from_urdf("ur5")
    tables = session_tables(robot, [read_session(robot, tmp_path / "day")])
    run = run_calibration(robot, tables, Options(effects=GEOMETRIC))
    page = PageNumbers(report_page(Subject(run, ORIGIN)))
    assert [*disagreements(page, {"result.json": json.loads(json.dumps(run.result.to_dict()))})] == []

    gain = run.result.angle_gain
    fit = run.fit.fit
    angles = [k for k, p in enumerate(fit.problem.parameters) if p.name.endswith((".theta", ".alpha", ".s_x", ".s_y"))]
    C = fit.estimate.dense_covariance()[np.ix_(angles, angles)]
    (size,) = set(fit.priors.sizes[angles])
    left = np.sqrt(np.linalg.eigvalsh(C))
    assert (gain.angles, gain.gained) == (24, sum(left <= 0.5 * size))
    assert gain.before_mrad == pytest.approx(1e3 * size)
    assert gain.after_mrad == pytest.approx(1e3 * np.sqrt(np.mean(left[left <= 0.5 * size] ** 2)))
    assert f"{gain.after_mrad:.4f} mrad" in "".join(of.text for of in page.shown)


@pytest.mark.long
@pytest.mark.rooms("pincal/diagnosis", "pincal/report")
def test_what_has_changed_is_not_said_to_be_unobservable(kuka: Robot) -> None:
    """The page names the change, its alternatives and what would have been noticed; its numbers are those of the file."""
    found = drifted(kuka)
    page = PageNumbers(diagnosis_page(found, version="0"))
    files = {"diagnosis.json": json.loads(json.dumps(found.report))}
    assert [*disagreements(page, files)] == []

    (change,) = found.found.changes
    table = excluded_table(found.found, kuka.joint_names)
    cells = {str(row[0]): dict(zip((c.name for c in table.columns), row, strict=True)) for row in table.rows}
    assert cells[change.effect][change.joint or ""] == "changed"
    for rival in change.equivalent:
        rows = [row for name, row in cells.items() if name.partition(" ")[0] == rival.effect]
        assert all(row.get(rival.joint or "whole arm", "alternative") == "alternative" for row in rows)
    largest = max(
        entry.tip_mm for entry in found.found.excluded if entry.effect == "gear_ratio" and entry.joint == "joint_2"
    )
    assert cells["gear_ratio"]["joint_2"] == largest
