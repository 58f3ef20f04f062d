"""What is wrong with a table or a description is named, one thing or several; a sound table is never accused by chance."""

import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from mistakes_study import FIRST, NOISE, ORIENTATIONS, PLAIN, Task, draw, is_right, machine_of, poses_of, robot_of, said_of
from placed_arms import measured
from scipy.spatial.transform import Rotation
from scipy.stats import f as f_distribution

from pincal.calibration.agreed import correction_notes
from pincal.calibration.checked_fit import calibrate
from pincal.diagnosis.robot_diagnosis import diagnose
from pincal.errors import BadInputError
from pincal.identify.options import Options
from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.measure.orientation import columns_of_orientations
from pincal.measure.table import read_measurements
from pincal.robot.mastering import resized
from pincal.robot.robot import Robot
from pincal.robot.tree import Coupling
from pincal.validate.cures import Case, Correction, from_hand, misreadings
from pincal.validate.descriptions import DescriptionSearch
from pincal.validate.linear_scan import LinearScan
from pincal.validate.orientations import OrientationSearch
from pincal.validate.trials import Remainder

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
CASES = next(
    (f / "shared/cases/tables" for f in Path(__file__).resolve().parents if (f / "shared/cases/tables").is_dir()), None
)
COMMANDS = {
    "J1": ("drawing.urdf", "table.csv", "--noise", "0.05mm"),
    "M1": ("r.urdf", "s.csv", "--model", "geometric", "--noise", "0.05mm", "--test-fraction", "0", "--type", "type.json"),
}
needs_cases = pytest.mark.skipif(CASES is None, reason="needs the cases that are shared beside the repository")


def test_what_is_left_counts_by_its_degrees_of_freedom() -> None:
    """As many unknowns as readings leave nothing, whatever is wrong; a few more leave little by chance, by Fisher's F."""
    before = Remainder(1.0, 24, 9)
    assert Remainder(0.0, 9, 9).chance(before) == 1.0
    assert Remainder(0.0, 6, 9).chance(before) == 1.0
    found = Remainder(0.1, 12, 9).chance(before)
    assert found == pytest.approx(f_distribution.cdf(0.01 * 4.0 / (24 / 15), 3, 15))
    # With a hundred hypotheses a tenth of the residuals with three degrees of freedom is nothing; a thousandth is.
    assert 100 * found > 1e-2
    assert 100 * Remainder(1e-3, 12, 9).chance(before) < 1e-4


@pytest.mark.long
@pytest.mark.parametrize("kind", ["few", "few typed"])
def test_a_sound_table_of_few_poses_is_not_accused(kind: str) -> None:
    """Of 6 to 12 poses, with and without a type. ``mistakes_study.py`` draws a thousand."""
    said = [said_of(Task(kind, seed)) for seed in range(3)]
    assert all(map(is_right, said)), said


@pytest.mark.long
@needs_cases
@pytest.mark.parametrize(
    ("case", "words", "exit_code"),
    [
        ("A1", "orientations appear to be in radians, not degrees", 3),
        ("A2", "angles about x, the new y and the new z, not angles about fixed x, y and z", 3),
        ("A4", "in another frame than the positions, turned by 90.0 deg about z", 3),
        ("D1", "seen from 'tool0'", 3),
        ("E1", "counts in the opposite sense", 0),
        # Two arms of the tests of zeros have such shifts.
        pytest.param("E3", "is shifted by -90", 0, marks=pytest.mark.rates),
        ("J1", "the length a of j2 (to the next axis) is 24.9 mm longer", 0),
        ("M1", "robot agrees with the others", 0),
    ],
)
def test_cases_get_their_right_words(
    case: str,
    words: str,
    exit_code: int,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each of the shared cases; orientations can be left out, and signs are those that the case was made with."""
    assert CASES is not None
    shutil.copytree(next(CASES.glob(f"{case}_*")), tmp_path / case)
    monkeypatch.chdir(tmp_path / case)
    command = COMMANDS.get(case, ("ur5", "table.csv"))
    assert run("calibrate", *command, "--verbose", "--out", "out") == exit_code
    said = capsys.readouterr()
    assert words in " ".join((said.out + said.err).split())
    if case == "E1":
        assert (said.out + said.err).count("counts in the opposite sense") == 3
    if case.startswith("A"):
        assert "--orientation none" in said.err


@pytest.mark.long
@pytest.mark.parametrize("kind", ["signs and length", pytest.param("orientation and zero", marks=pytest.mark.rates)])
def test_two_mistakes_at_once_are_both_named(kind: str) -> None:
    """The study draws all pairs."""
    found = said_of(Task(kind, 1))
    assert is_right(found), found


@pytest.fixture(scope="module")
def sound() -> OrientationSearch:
    """Return a search in sound poses of an arm whose errors are those of real ones."""
    robot, _ = robot_of("kr125")
    rng = np.random.default_rng(3)
    q = 0.9 * robot.random_configurations(30, rng)
    position, rotation = poses_of(machine_of(robot, rng), q)
    quaternion = Rotation.from_matrix(rotation).as_quat()
    table = measurements_from_arrays(robot.joint_names, q, position=position, quaternion=quaternion)
    return OrientationSearch(robot, table, FIRST[:3, :3], 0.06)


@pytest.mark.long
# Units, a sequence and a frame are among the cases, an inverse in the tests of agreement; all of them before a release.
@pytest.mark.parametrize("k", [2, *(pytest.param(k, marks=pytest.mark.products) for k in (0, 3, 5, 7, 9))])
def test_a_reading_of_orientations_is_told_from_all_others(sound: OrientationSearch, k: int) -> None:
    """Unit, sequence, kind, inverse and frame."""
    change, words = ORIENTATIONS[k]
    quaternion = sound.table.readings["quaternion"]
    search = replace(sound, table=sound.table.with_readings(quaternion=change(quaternion)))
    cause = search.cause()
    assert cause is not None and words in cause.words
    # Undone, the columns hold what was measured.
    assert search.under(cause).left == pytest.approx(sound.under(None).left, abs=1e-3)


def test_sound_orientations_have_no_cause(sound: OrientationSearch) -> None:
    assert sound.cause() is None


@pytest.mark.long
def test_orientations_of_nothing_are_refused() -> None:
    """Random ones are explained by none of the readings that are tried."""
    robot, _ = robot_of("kr125")
    rng = np.random.default_rng(3)
    q = 0.9 * robot.random_configurations(30, rng)
    random = Rotation.random(30, random_state=4).as_quat()
    table = measurements_from_arrays(robot.joint_names, q, position=np.zeros((30, 3)), quaternion=random)
    search = OrientationSearch(robot, table, FIRST[:3, :3], 0.06)
    assert search.cause() is None
    assert search.under(None).left > 0.3


def test_a_longer_link_moves_what_follows_it() -> None:
    """Along its x axis or its joint's; the frames, and nothing else of the parameters, say so."""
    robot, _ = robot_of("kr125")
    q = robot.random_configurations(5, np.random.default_rng(0))
    longer = resized(robot, {"joint_2.a": 0.03})
    change = longer.frames.parameters - robot.frames.parameters
    assert change[1, 4] == pytest.approx(0.03)
    change[1, 4] = 0.0
    np.testing.assert_allclose(change, 0.0, atol=1e-9)
    moved = longer.forward_kinematics(q)[:, :3, 3] - robot.forward_kinematics(q)[:, :3, 3]
    along = robot.kinematics.frames(q)[:, 2, :3, 0]
    np.testing.assert_allclose(moved, 0.03 * along, atol=1e-9)
    with pytest.raises(BadInputError, match="no length between two joints"):
        resized(robot, {"joint_6.a": 0.03})


@pytest.mark.long
def test_signs_zeros_couplings_and_lengths_are_searched_together() -> None:
    """Among all combinations the true one leaves least of a linear fit, but for other words for the same arm."""
    robot, _ = robot_of("ur5")
    rng = np.random.default_rng(1)
    table = measured(machine_of(robot, rng), robot, poses=60, turn=0.9)
    true = Correction({"elbow_joint": np.pi / 2}, ("shoulder_lift_joint", "wrist_1_joint"))
    signs = np.where(np.isin(robot.joint_names, true.turned), -1.0, 1.0)
    shifts = np.array([true.shifts.get(name, 0.0) for name in robot.joint_names])
    reported = measurements_from_arrays(robot.joint_names, (table.q - shifts) * signs, position=table.position)
    search = DescriptionSearch.of(Case(robot, reported), Options(), 2e-3)
    assert search is not None
    left = search._left_of_linear(search.combinations)
    assert np.sort(left)[0] == pytest.approx(left[search.combinations.index(true)], rel=0.5)
    np.testing.assert_allclose(true.of_urdf(robot, reported.q), table.q, atol=1e-12)


def test_a_scan_of_corrections_is_a_linear_fit_of_each() -> None:
    """Of positions and orientations of the last link, by least squares; joints that rest make no exception."""
    robot, _ = robot_of("kr125")
    rng = np.random.default_rng(3)
    q = 0.9 * robot.random_configurations(40, rng)
    q[:, 4] = 0.3
    position = rng.normal(size=(40, 3))
    coupling = Coupling("joint_3", "joint_2", -1.0)
    corrections = [
        Correction(),
        Correction({"joint_2": np.pi / 2, "joint_5": np.pi}, ("joint_1", "joint_6")),
        Correction({"joint_4": -np.pi / 4}, ("joint_2",), (coupling,)),
    ]
    found = LinearScan(robot, q, position).left(corrections)
    for one, left in zip(corrections, found, strict=True):
        frames = robot.kinematics.frames(one.of_urdf(robot, q))[:, -1]
        columns = np.column_stack([frames[:, :3].reshape(-1, 12), np.ones(len(q))])
        expected = position - columns @ np.linalg.lstsq(columns, position, rcond=1e-9)[0]
        assert left == pytest.approx(np.sum(expected**2), rel=1e-6)


def test_corrections_one_after_the_other_are_one() -> None:
    """Of a joint that was turned a further zero counts the other way; lengths add up, and each joint is noted once."""
    robot, _ = robot_of("kr125")
    q = robot.random_configurations(5, np.random.default_rng(1))
    first = Correction({"joint_2": 0.5, "joint_3": -0.25}, ("joint_2", "joint_4"), lengths={"joint_2.a": 0.02})
    second = Correction({"joint_2": 0.1, "joint_5": 0.3}, ("joint_4",), lengths={"joint_2.a": 0.01})
    both = first.then(second)
    assert both is not None and both.turned == ("joint_2",)
    assert both.shifts == pytest.approx({"joint_2": 0.4, "joint_3": -0.25, "joint_5": 0.3})
    poses = [one.forward_kinematics(q) for one in (both.of(robot), second.of(first.of(robot)))]
    np.testing.assert_allclose(*poses, rtol=0, atol=1e-9)
    assert len(correction_notes([first, second])) == 5
    coupled = Correction(couplings=(Coupling("joint_3", "joint_2", 1.0),))
    assert first.then(coupled) is None and len(correction_notes([coupled, first, second])) == 6


def test_what_a_camera_on_the_hand_sees_is_a_hypothesis() -> None:
    """Rows become those of the path from the hand to the base; where links are stated there is none."""
    case = draw(Task("sound", 1))
    (mistake,) = from_hand(case.robot, case.table)
    undone = mistake.undo(Case(case.robot, case.table)).table
    assert {*undone.from_link.tolist()} == {"tool0"} and {*undone.to_link.tolist()} == {case.robot.base}
    assert f"--from tool0 --to {case.robot.base}" in mistake.advice
    assert not list(from_hand(case.robot, undone))


def test_orientations_can_be_left_out(tmp_path: Path) -> None:
    """In any convention; joints of such names stay."""
    file = tmp_path / "table.csv"
    file.write_text("a1,x,y,z,rx [deg],ry [deg],rz [deg]\n" + "0.1,1,2,3,4,5,6\n0.2,1,2,3.1,4,5,6\n")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read_measurements(file, ("a1",), orientation="none").kind == "position"
    assert columns_of_orientations(["QX", "QY", "QZ", "QW", "A"]) == {"QX", "QY", "QZ", "QW"}


def test_an_arm_of_seven_joints_is_searched_by_fewer_combinations() -> None:
    """All signs, and as many right angles at once as fit into the budget."""
    robot = Robot.from_urdf("panda", tip="panda_link8")
    table = measurements_from_arrays(robot.joint_names, np.zeros((40, robot.n_joints)), position=np.zeros((40, 3)))
    search = DescriptionSearch.of(Case(robot, table), Options(), 2e-3)
    assert search is not None
    combined = search.combinations
    assert max(len(one.turned) for one in combined) == 7
    assert 2 <= max(len(one.shifts) for one in combined) < 5
    assert combined[0] == Correction()


@pytest.mark.long
def test_rounded_joints_do_not_make_a_changed_robot() -> None:
    """As a pendant shows them: nothing is decided. Where the robot was sent to round positions, or is far off, it is."""
    robot, _ = robot_of("ur5")
    rng = np.random.default_rng(2)
    machine = machine_of(robot, rng)

    def new(q: np.ndarray, written: np.ndarray) -> Measurements:
        position = poses_of(machine, q)[0] + NOISE * rng.normal(size=(len(q), 3))
        return measurements_from_arrays(robot.joint_names, written, position=position)

    q = 0.9 * robot.random_configurations(100, rng)
    fit = calibrate(robot, new(q, q), PLAIN)
    q = 0.9 * robot.random_configurations(40, rng)
    shown = np.deg2rad(np.round(np.rad2deg(q), 1))
    rounded, sent, changed = (
        diagnose(fit, table).found for table in (new(q, shown), new(shown, shown), new(shown + 0.05 * np.eye(6)[2], shown))
    )
    assert not rounded.is_judged and not rounded.changed
    assert "multiples of 0.1 deg, as a pendant shows them" in rounded.warnings[0].text
    assert sent.is_judged and not sent.changed
    assert changed.is_judged and changed.changed


W_FIRST = "--columns 'qx=qw,qy=qx,qz=qy,qw=qz'"
INVERTED = "invert them, or leave the orientations out: --orientation none"


def test_mixed_up_quaternions_come_with_what_cures_them() -> None:
    """By an option where there is one; an exchange of positions needs another header."""
    table = measurements_from_arrays(
        ["a"], np.zeros((9, 1)), position=np.zeros((9, 3)), quaternion=np.tile([0, 0, 0, 1.0], (9, 1))
    )
    advice = {one.words: one.advice for one in misreadings(robot_of("ur5")[0], table)}
    assert W_FIRST in advice["the quaternion appears to be written with w first"]
    assert advice["the quaternion appears to be inverted"] == INVERTED
    assert all("header" in of for words, of in advice.items() if "quaternion" not in words and "left-handed" not in words)


@pytest.mark.long
def test_wrong_orientations_are_told_by_their_angles() -> None:
    """Positions fit: what remains is said of the orientations, with the option that reads them."""
    robot, _ = robot_of("ur5")
    machine = machine_of(robot, np.random.default_rng(1))
    q = 0.9 * robot.random_configurations(40, np.random.default_rng(2))
    position, rotation = poses_of(machine, q)
    turned = Rotation.from_matrix(rotation).as_quat()[:, [3, 0, 1, 2]]
    table = measurements_from_arrays(robot.joint_names, q, position=position, quaternion=turned)
    with pytest.raises(BadInputError, match=r"orientations are off by \d+ mrad, with this corrected \d\.\d mrad") as error:
        calibrate(robot, table, PLAIN)
    assert W_FIRST in str(error.value)
