"""One rule for all verdicts; what is doubtful stands first, in every output."""

import itertools
import json
import math
import re
from pathlib import Path

import msgspec
import numpy as np
import pytest
from command_line import run
from scipy.stats import chi2, f

from pincal import Options, Robot, measurements_from_arrays, run_calibration, run_discovery
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.calibration.calibration import Calibration
from pincal.calibration.result import ResultFile
from pincal.measure.measurements import Measurements
from pincal.model.effects import GEOMETRIC
from pincal.notes import Note, Severity, doubts_first
from pincal.report.html import report_page
from pincal.report.subject import Subject
from pincal.validate.misfit import MISFIT, POWER, TWICE, NoiseTest, Verdict, is_informative, judge

URDF = kuka_urdf_path()
Capture = pytest.CaptureFixture[str]
DOUBT, REMARK = Note(Severity.DOUBT, "something is wrong", (3, 4)), Note(Severity.NOTE, "something is so")


def rows(n: int, seed: int = 0, *, cycles: int = 1, shift_from: int | None = None) -> Measurements:
    """Return a table of a KUKA that errs in its geometry, measured at 0.05 mm; from some row on perhaps 2 mm beside."""
    rng = np.random.default_rng(seed)
    machine = sim.TrueMachine.from_urdf(URDF, tip="tool0").draw_errors(rng, sigma_length=5e-4, sigma_angle=5e-4)
    q = np.tile(sim.plan_poses(machine.nominal, n, rng), (cycles, 1))
    columns = sim.Instrument(targets=(0.1, 0.0, 0.2), sigma=5e-5).measure(machine, q, rng=rng)
    position = np.column_stack([columns[axis] for axis in "xyz"])
    if shift_from is not None:
        position[shift_from:, 0] += 2e-3
    return measurements_from_arrays(machine.names, q, position=position)


def written(path: Path, table: Measurements) -> Path:
    """Write a table as a user has it."""
    assert table.position is not None
    names = [*table.joint_names, "x", "y", "z"]
    np.savetxt(path, np.hstack([table.q, table.position]), delimiter=",", header=",".join(names), comments="", fmt="%.12g")
    return path


def test_the_rule_of_verdicts() -> None:
    """Adequate needs a known noise, residuals within it, enough poses, no reservation and no known model error."""
    fits, misses = NoiseTest("the noise", 1.0, 0.5), NoiseTest("the noise", 1.5, 1e-6)
    cases = itertools.product((None, fits, misses), ((), (DOUBT,)), *[(False, True)] * 3)
    for noise_test, doubts, unusable, incomplete, few in cases:
        verdict = judge(noise_test, doubts, unusable=unusable, incomplete=incomplete, few=few)
        against = unusable or incomplete or noise_test is misses
        assert (verdict is Verdict.ADEQUATE) == (noise_test is fits and not doubts and not against and not few)
        assert not against or verdict is Verdict.NOT_ADEQUATE
        assert not few or against or verdict is Verdict.NOT_JUDGED


@pytest.mark.parametrize("of_noise", [math.inf, 30.0, 200.0])
@pytest.mark.parametrize("degrees", [1e-6, 5.0, 17.0, 18.0, 60.0, 150.0])
def test_few_degrees_of_freedom_tell_nothing(degrees: float, of_noise: float) -> None:
    """As drawn: where they tell, residuals of twice the noise are noticed in nine of ten draws; else in fewer."""
    rng = np.random.default_rng(0)
    squares = TWICE**2 * rng.chisquare(degrees, 20_000) / degrees
    if math.isinf(of_noise):
        p = chi2.sf(degrees * squares, degrees)
    else:
        p = f.sf(squares / (rng.chisquare(of_noise, 20_000) / of_noise), degrees, of_noise)
    noticed = float(np.mean(p < MISFIT))
    assert (noticed >= POWER) == is_informative(degrees, of_noise) or noticed == pytest.approx(POWER, abs=0.015)


def test_notes_stand_in_order_and_once() -> None:
    """Doubts first, else as they came; plain text is a note."""
    assert doubts_first(["so", DOUBT, REMARK, "so"]) == (DOUBT, Note(Severity.NOTE, "so"), REMARK)
    assert msgspec.to_builtins(DOUBT) == {"severity": "doubt", "text": "something is wrong", "rows": (3, 4)}
    assert msgspec.to_builtins(REMARK) == {"severity": "note", "text": "something is so"}


def test_warnings_of_version_0_1_0_are_read() -> None:
    """They were plain texts."""
    robot = Robot.from_urdf(URDF)
    contents = run_calibration(robot, rows(60), Options(effects=GEOMETRIC)).result.to_dict()
    for name in ("verdict", "degrees"):
        del contents[name]
    old = msgspec.convert(json.loads(json.dumps(contents | {"warnings": ["so it is"]})), ResultFile)
    assert old.warnings == ("so it is",)


@pytest.mark.parametrize(
    ("poses", "cycles", "sigma"),
    [
        (8, 3, 5e-5),
        (7, 1, 2e-6),
        *(pytest.param(poses, 1, 5e-5, marks=pytest.mark.long) for poses in (8, 15)),
    ],
)
def test_few_poses_are_not_judged(poses: int, cycles: int, sigma: float) -> None:
    """Eight poses, however often they are measured, do not make a model of sixty parameters adequate."""
    robot = Robot.from_urdf(URDF)
    result = run_calibration(robot, rows(poses, cycles=cycles), Options(sigma=sigma), test_fraction=0.0).result

    assert result.verdict_of() is Verdict.NOT_JUDGED and result.degrees < 18.0
    assert "dominated by the prior" in result.warnings[0].text and result.warnings[0].is_doubt


@pytest.mark.long
@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(("poses", "noise"), [(["8"], "0.05mm"), (["10", "--cycles", "3"], "0.002mm")])
def test_few_poses_are_searched_and_not_judged(poses: list[str], noise: str, tmp_path: Path, capsys: Capture) -> None:
    """Halves of eight poses tell next to nothing of what a fit does not take; that ended as an internal error."""
    table, out = tmp_path / "few.csv", tmp_path / "out"
    words = ["simulate", URDF, "--poses", *poses, "--noise", noise, "--payload", "100", "--seed", "5", "--out", table]
    assert run(*words) == 0
    assert run("discover", URDF, table, "--noise", noise, "--out", out) == 0
    assert "verdict  not judged." in capsys.readouterr().out


@pytest.mark.long
def test_estimated_noise_is_no_judge_of_a_search_either() -> None:
    """The same table, nothing found: not judged where the noise was estimated, adequate where it was declared."""
    robot = Robot.from_urdf(URDF)
    for sigma, verdict in ((None, Verdict.NOT_JUDGED), (5e-5, Verdict.ADEQUATE)):
        found = run_discovery(robot, rows(80), Options(effects=GEOMETRIC, sigma=sigma))
        assert not found.findings.effects and found.findings.verdict is verdict
        assert found.calibration.result.verdict_of() is verdict


@pytest.fixture(scope="module")
def shifted() -> Calibration:
    """Return the calibration of a table whose second half is shifted by 2 mm."""
    return run_calibration(Robot.from_urdf(URDF), rows(100, shift_from=50), Options(effects=GEOMETRIC))


@pytest.mark.long
def test_a_doubt_stands_first_everywhere(shifted: Calibration) -> None:
    """On the page, in the notebook and in the file the shift comes before any error, and the model is not adequate."""
    words = "readings are shifted by 2"
    contents = shifted.result.to_dict()
    page = re.sub(r"(?s).*?<body", "", report_page(Subject(shifted, {"pincal": "0", "command": "", "inputs": {}})), count=1)
    notebook = shifted._repr_html_()

    assert contents["verdict"] == "not adequate"
    first = contents["warnings"][0]
    assert first["severity"] == "doubt" and words in first["text"] and 50 <= first["rows"][0] <= 54
    assert page.index(words) < page.index("mean error") and page.index(words) < page.index("not adequate")
    assert notebook.index(words) < notebook.index("Calibration(")


@pytest.mark.long
@pytest.mark.parametrize("more", [[], ["--verbose"]])
def test_a_shift_is_for_the_user_to_decide(more: list[str], tmp_path: Path, capsys: Capture) -> None:
    """Exit code 4 with the line, files written, the doubt in the first line; 0 if the user takes it."""
    table = written(tmp_path / "half.csv", rows(100, shift_from=50))
    words = ["calibrate", URDF, table, "--tip", "tool0", "--quiet", "--out", tmp_path / "out", *more]
    for extra, code in ([], 4), (["--accept-shift"], 0):
        assert run(*words, *extra) == code
        told = capsys.readouterr()
        assert told.out.lstrip().startswith("doubt: from line 5") and (tmp_path / "out" / "model.json").exists()
        assert ("--accept-shift" in told.err) == (not extra)
