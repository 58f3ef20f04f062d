"""Tables as people plan them that once went wrong, each by the command as a user runs it, against its right value.

They are simulated, with noise of 15 um and drives that stop to 10 urad (C and K: as their names say), and stand in
``../shared/cases``, each with a README that says what is right.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from plan_figures import placed_best

from pincal import load_model, read_measurements
from pincal import simulate as sim
from pincal.cli import main

pytestmark = [pytest.mark.long, pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")]

# Names of what every arm has.
_ELASTIC = {"joint_elasticity", "bearing_elasticity", "oblique_bearing", "bearing_place", "link_bending"}


class Run(NamedTuple):
    """What a command did: its exit code, the folder of its results, and what it printed."""

    code: int
    out: Path
    printed: str

    @property
    def result(self) -> dict[str, Any]:
        """The contents of result.json."""
        return dict(json.loads((self.out / "result.json").read_text(encoding="utf-8")))

    @property
    def discovery(self) -> dict[str, Any]:
        """The contents of discovery.json."""
        return dict(json.loads((self.out / "discovery.json").read_text(encoding="utf-8")))

    @property
    def doubts(self) -> list[dict[str, Any]]:
        """Doubts of the result."""
        return [note for note in self.result["warnings"] if note["severity"] == "doubt"]

    @property
    def headline(self) -> float:
        """Mean error on what was held out [mm]."""
        return float(self.result["error"]["calibrated"]["test"]["mean_mm"])

    def lines_of_doubts(self) -> set[int]:
        """Return the lines that doubts name, as rows or in words."""
        words = " ".join(note["text"] for note in self.doubts)
        numbers = re.findall(r"lines? ((?:\d+(?:, | and )?)+)", words)
        in_words = {int(number) for some in numbers for number in re.findall(r"\d+", some)}
        return in_words | {line for note in self.doubts for line in note.get("rows", ())}

    def named(self) -> set[int]:
        """Return the lines that are called wrong: outliers, and rows of doubts."""
        return set(self.result["outliers"]) | {line for note in self.doubts for line in note.get("rows", ())}


@pytest.fixture
def pincal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., Run]:
    """Return a function that runs a command in a folder of results of its own."""

    def run(*arguments: Any) -> Run:
        out = tmp_path / f"out{len(list(tmp_path.iterdir()))}"
        # Subsamples take processes and change no name.
        more = ["--stability", "0"] if arguments[0] == "discover" else []
        where = [] if arguments[0] == "validate" else ["--out", out]
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in (*arguments, *where, *more)])
        captured = capsys.readouterr()
        return Run(int(ended.value.code or 0), out, captured.out + captured.err)

    return run


@pytest.fixture
def plan(shared_cases: Path, request: pytest.FixtureRequest) -> Path:
    """Return the folder of a plan by its number."""
    return next((shared_cases / "plans").glob(f"{request.param}_*"))


def of_plan(*numbers: str) -> pytest.MarkDecorator:
    """Return a mark that gives a test the folders of some plans."""
    return pytest.mark.parametrize("plan", numbers, indirect=True)


def at_fresh(run: Run, fresh: Path) -> tuple[float, float]:
    """Return the mean error [mm] of a calibrated model at poses never measured, and how often its 95 % intervals hold."""
    model = load_model(run.out / "model.json")
    table = read_measurements(fresh, model.model.chain.robot.joint_names)
    targets = np.unique(table.target)
    assert len(targets) == 1 and table.position is not None
    target = str(targets[0]) if str(targets[0]) in model.model.chain.targets else None
    place, sigma = model.predict(table.q, target=target, return_sigma=True)
    error = place[:, :, 3] - table.position
    return 1e3 * float(np.linalg.norm(error, axis=1).mean()), float(np.mean(np.abs(error) < 1.96 * sigma))


@of_plan("01")
@pytest.mark.parametrize("verb", ["calibrate", pytest.param("discover", marks=pytest.mark.rates)])
def test_a_shift_between_two_passes_is_told_with_its_line(plan: Path, pincal: Callable[..., Run], verb: str) -> None:
    """All readings of the second pass are 1 mm off from line 62 on: exit 4, and the line."""
    run = pincal(verb, plan / "robot.urdf", plan / "data.csv")

    assert run.code == 4
    assert run.result["verdict"] != "adequate"
    assert any(abs(line - 62) <= 3 for line in run.lines_of_doubts())
    assert any("shifted by 1" in note["text"] for note in run.doubts)


@of_plan("03")
def test_a_load_that_no_column_tells_is_not_adequate(plan: Path, pincal: Callable[..., Run]) -> None:
    """Each pose was read with 0 kg and then with 100 kg: the order within the visits is named."""
    run = pincal("calibrate", plan / "robot.urdf", plan / "data.csv", "--noise", "0.015mm")

    assert run.result["verdict"] == "not adequate"
    assert any(re.search(r"visit|first|second|order|repeat", note["text"]) for note in run.doubts)


@of_plan("05")
def test_a_joint_at_rest_at_45_degrees_is_as_one_at_0(plan: Path, pincal: Callable[..., Run]) -> None:
    """Both commands end well, and poses are held out by regions of the joints that moved."""
    calibrated, found = (pincal(verb, plan / "robot.urdf", plan / "data.csv") for verb in ("calibrate", "discover"))

    assert (calibrated.code, found.code) == (0, 0)
    assert "regions" in calibrated.result["error"]["calibrated"] or "validation" in calibrated.result
    names = {entry["effect"] for entry in found.discovery["effects"]}
    assert names <= _ELASTIC


@of_plan("07")
def test_five_targets_of_a_pose_are_one_stop(plan: Path, pincal: Callable[..., Run]) -> None:
    """No name, no doubt about the order of the rows, and intervals that cover."""
    run = pincal("discover", plan / "robot.urdf", plan / "data.csv")
    _, covered = at_fresh(run, plan / "fresh_any.csv")

    assert run.code == 0
    assert {entry["effect"] for entry in run.discovery["effects"]} <= _ELASTIC
    assert not any(re.search(r"consecutive|order of the rows", note["text"]) for note in run.doubts)
    assert 0.88 <= covered <= 0.995


@of_plan("09")
@pytest.mark.parametrize("rows", ["chk.csv", "chk_means.csv"])
def test_five_readings_of_a_stop_do_not_make_a_change(plan: Path, pincal: Callable[..., Run], rows: str) -> None:
    """The robot is unchanged, whether its stops come as readings or as means."""
    model = pincal("calibrate", plan / "robot.urdf", plan / "cal.csv")
    run = pincal("diagnose", model.out / "model.json", plan / rows)

    assert model.code == 0
    assert run.code == 0


@of_plan("11")
def test_ten_cycles_leave_poses_to_fit_and_to_hold_out(plan: Path, pincal: Callable[..., Run]) -> None:
    """Poses are held out with all their visits, and the headline is about that of rows held out at random, .0128 mm."""
    run = pincal("calibrate", plan / "robot.urdf", plan / "data.csv")

    assert run.code == 0
    assert 0.010 < run.headline < 0.045


@of_plan("13")
def test_wrong_readings_are_named_and_no_others(plan: Path, pincal: Callable[..., Run]) -> None:
    """Seven readings are millimetres off; other visits of their poses are sound, and the headline is that of sound rows.

    The folder lists line 31, too: it is within 50 um of what the other poses predict, while 91 and 151 are 5.8 mm off.
    """
    run = pincal("calibrate", plan / "robot.urdf", plan / "data.csv")

    assert run.named() == {91, 101, 106, 135, 151, 152, 173}
    assert run.headline < 0.05


@of_plan("15")
def test_a_track_of_3_m_covers_as_one_of_a_foot(plan: Path, pincal: Callable[..., Run]) -> None:
    """The wrist's compliance stays, whatever the moment about the start of the track, and intervals cover."""
    run = pincal("calibrate", plan / "robot.urdf", plan / "data.csv")
    _, covered = at_fresh(run, plan / "fresh_plan.csv")
    wrist = next(row for row in run.result["parameters"] if row["name"] == "wrist_1.k_z")

    assert run.code == 0
    assert "no static moment" not in wrist["reason"]
    assert covered >= 0.88


@of_plan("17", "18")
def test_what_a_plan_does_not_reach_is_stated(plan: Path, pincal: Callable[..., Run]) -> None:
    """Beside the headline stands what to expect at random poses within the limits, and the truth is within it."""
    run = pincal("calibrate", plan / "robot.urdf", plan / "data.csv")
    true, covered = at_fresh(run, plan / "fresh_any.csv")
    elsewhere = run.result["elsewhere"]

    assert covered >= 0.88
    assert elsewhere["worst_mm"] >= true
    assert elsewhere["mean_mm"] > 2.0 * run.headline


@of_plan("19")
@pytest.mark.parametrize("verb", [pytest.param("calibrate", marks=pytest.mark.rates), "discover"])
def test_a_tracker_displaced_between_two_sessions_is_told(plan: Path, pincal: Callable[..., Run], verb: str) -> None:
    """It stands .11 mm elsewhere from line 63 on, 17 hours later, which is no drift of the base: exit 4 of both."""
    run = pincal(verb, plan / "robot.urdf", plan / "data.csv")

    assert run.code == 4
    assert any(abs(line - 63) <= 3 for line in run.lines_of_doubts())


def test_positions_validate_a_model_of_poses(shared_cases: Path, pincal: Callable[..., Run]) -> None:
    """C1: a report, as for any other table."""
    folder = shared_cases / "tables" / "C1_validate_positions_with_pose_model"
    noise = "--noise", "0.05mm", "--noise-angle", "0.1mrad"
    model = pincal("calibrate", "ur5", folder / "poses.csv", *noise)
    run = pincal("validate", model.out / "model.json", folder / "positions.csv")

    assert model.code == 0
    assert run.code == 0
    assert "mm" in run.printed


def test_poses_of_an_unchanged_robot_agree_with_a_model_of_positions(shared_cases: Path, pincal: Callable[..., Run]) -> None:
    """C2: the noise of orientations, which the model does not know, is no change of the robot."""
    folder = shared_cases / "tables" / "C2_diagnose_poses_with_position_model"
    model = pincal("calibrate", "ur5", folder / "positions.csv", "--noise", "0.05mm")
    run = pincal("diagnose", model.out / "model.json", folder / "poses.csv")

    assert model.code == 0
    assert run.code == 0


def test_markers_that_cannot_improve_a_robot_leave_its_geometry(shared_cases: Path, pincal: Callable[..., Run]) -> None:
    """K1: on exact rows, base and tool fitted, the calibrated URDF is no worse than the nominal one, and is not praised."""
    folder = shared_cases / "tables" / "K1_marker_poses_adequate_but_worse"
    run = pincal("calibrate", "ur5", folder / "markers.csv", "--noise", "3mm", "--noise-angle", "10mrad")
    model = load_model(run.out / "model.json")
    robot = model.model.chain.robot
    exact = read_measurements(folder / "truth.csv", robot.joint_names)
    nominal = robot.forward_kinematics(exact.q)
    text = (run.out / "calibrated.urdf").read_text(encoding="utf-8")
    calibrated = sim.TrueMachine.from_urdf(text, tip=robot.tip, base=robot.base).tip(exact.q)
    left = [np.linalg.norm(placed_best(tip, exact.position), axis=1).mean() for tip in (nominal, calibrated)]

    assert run.code in (0, 4)
    assert left[1] <= 1.02 * left[0]
    assert "Use it" not in run.printed
