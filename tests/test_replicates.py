"""Visits of the same pose: which rows they are, AP and RP by hand, and the level and power of the test for lack of fit."""

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
from command_line import run
from report_cases import page_of
from scipy.stats import kstest

from pincal import ELASTIC, GEOMETRIC, Options, Robot, run_calibration
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.identify.quadratic import Form
from pincal.identify.station import station_of
from pincal.measure.measurements import measurements_from_arrays
from pincal.measure.poses import replicate_groups
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.model import Model
from pincal.report.judgement import judged
from pincal.robot.se3 import quaternions
from pincal.sensors.sensor import Block
from pincal.validate.accuracy import Replicates, angle_accuracy, cycle_words, iso9283, position_accuracy
from pincal.validate.lack_of_fit import evenness, lack_of_fit, replicate_squares, scatter_of
from pincal.validate.misfit import explained_by_uncertainty

URDF = kuka_urdf_path()


def table(q, **columns):
    q = np.array(q, float).reshape(len(q), -1)
    names = [f"j{i}" for i in range(q.shape[1])]
    return measurements_from_arrays(names, q, **({"distance": np.ones(len(q))} | columns))


# Which rows visit the same pose


def test_joints_that_hardly_differ_are_one_pose():
    """To about 1e-5 rad, wherever the border of a grid happens to be."""
    q = [[0.3, 1.0], [0.3 + 9e-6, 1.0 - 9e-6], [0.3, 1.0 + 4e-5], [0.7, 1.0], [0.3 - 9e-6, 1.0]]
    assert replicate_groups([table(q)])[0].tolist() == [0, 0, 1, 2, 0]


def test_a_slow_motion_is_no_visit():
    """Joints that creep on by less than the tolerance from row to row do not make one pose of the whole way."""
    assert replicate_groups([table(np.arange(100)[:, None] * 5e-6)])[0].tolist() == list(range(100))


@pytest.mark.parametrize(
    "columns",
    [
        {"payload": [0.0, 80.0, 0.0]},
        {"target": ["A", "B", "A"]},
        {"anchor": ["a_1", "a_2", "a_1"]},
        {"approach": [[1.0], [-1.0], [1.0]]},
        {"temperature": [20.0, 25.0, 23.9]},
    ],
)
def test_another_condition_is_another_pose(columns):
    """Load, target, anchor and approach have to agree, temperature within 4 K."""
    assert replicate_groups([table([0.1, 0.1, 0.1], **columns)])[0].tolist() == [0, 1, 0]


def test_time_and_small_changes_make_no_difference():
    """Visits take time, and load and temperature are never quite the same."""
    rows = table([0.1, 0.1], time=[0.0, 9e3], temperature=[20.0, 21.0], payload=[80.0, 80.0002])
    assert replicate_groups([rows])[0].tolist() == [0, 0]


def test_tables_share_the_numbers():
    """A pose of one table is found again in another that lacks a column."""
    first, second = table([0.1, 0.2], payload=[0.0, 0.0]), table([0.2, 0.3])
    assert [poses.tolist() for poses in replicate_groups([first, second])] == [[0, 1], [1, 2]]


# Accuracy and repeatability


def test_accuracy_and_repeatability_by_hand():
    """AP is the mean's length; l are 5, 5, 5, 5 or 1, 3 from their means; RP adds three standard deviations."""
    corners = np.array([[4.0, -2.0, -2.0, 4.0], [6.0, 6.0, -2.0, -2.0], [2.0, 2.0, 2.0, 2.0]])
    assert position_accuracy(corners) == pytest.approx((3.0, 5.0))
    line = np.array([[2.0, 2.0, -2.0, -2.0, 5.0, -5.0], np.zeros(6), np.zeros(6)])
    assert position_accuracy(line) == pytest.approx((0.0, 3.0 + 3.0 * np.std([2, 2, 2, 2, 5, 5], ddof=1)))
    accuracy, repeatability = angle_accuracy(np.array([[0.0, 2.0], [1.0, 1.0], [-3.0, -1.0]]))
    np.testing.assert_allclose(accuracy, [1.0, 1.0, 2.0])
    np.testing.assert_allclose(repeatability, [3.0 * np.sqrt(2.0), 0.0, 3.0 * np.sqrt(2.0)])


@pytest.fixture(scope="module")
def ur10():
    robot = Robot.from_urdf("ur10")
    return Model(Chain.of(robot), ())


def visits_of(model, q, offsets, *, part="test", counted=None, **columns):
    """Return rows that are off the model's own predictions by offsets [m], shape (N, 3)."""
    at = model.predict(np.zeros(0), Conditions.at(np.asarray(q, float)))
    found = {"position": at[:, :, 3] + offsets} | columns
    if "quaternion" in found:
        found["quaternion"] = quaternions(found["quaternion"] @ at[:, :, :3])
    rows = measurements_from_arrays(model.chain.robot.joint_names, q, **found)
    counted = np.ones(len(rows), bool) if counted is None else np.array(counted)
    return Replicates(part, rows, station_of(model, rows, np.zeros(3)), replicate_groups([rows])[0], counted)


def test_poses_are_reported_one_by_one(ur10):
    """Each pose has its line, load, number of cycles, AP and RP; single visits have none; the summary is over poses."""
    q = np.array([[0.1] * 6, [0.4] * 6, [0.1] * 6, [0.8] * 6, [0.1] * 6, [0.4] * 6])
    offsets = 1e-3 * np.array([[1, 1, 0], [0, 0, 2], [1, -1, 0], [9, 9, 9], [1, 0, 0], [0, 0, 4.0]])
    found = iso9283([visits_of(ur10, q, offsets, payload=np.full(6, 5.0))], {"calibrated": np.zeros(0)})
    assert found["poses"] == {"test": 2} and found["cycles"] == {"min": 2, "max": 3, "standard": 30}
    first, second = found["per_pose"]
    assert (first["line"], first["cycles"], first["payload_kg"], second["line"], second["cycles"]) == (2, 3, 5.0, 3, 2)
    assert (first["AP_mm"], second["AP_mm"]) == pytest.approx((1.0, 3.0))
    assert first["RP_mm"] == pytest.approx(2.0 / 3.0 + 3.0 * np.std([1, 1, 0], ddof=1))
    assert second["RP_mm"] == pytest.approx(1.0)
    assert found["calibrated"]["test"]["AP_mm"] == pytest.approx({"mean": 2.0, "max": 3.0})
    assert iso9283([visits_of(ur10, q[[0, 1, 3]], offsets[:3])], {"calibrated": np.zeros(0)}) is None


def test_orientation_is_reported_about_each_axis(ur10):
    """Turns of -1 and 3 mrad about the instrument's y are AP_b 1 mrad and RP_b 3 sqrt(8) mrad."""
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_rotvec([[0.0, -1e-3, 0.0], [0.0, 3e-3, 0.0]]).as_matrix()
    visits = visits_of(ur10, np.full((2, 6), 0.3), np.zeros((2, 3)), quaternion=turned)
    (pose,) = iso9283([visits], {"calibrated": np.zeros(0)})["per_pose"]
    assert pose["AP_b_mrad"] == pytest.approx(1.0, rel=1e-6) and pose["RP_b_mrad"] == pytest.approx(3 * np.sqrt(8), rel=1e-6)
    assert pose["AP_a_mrad"] < 1e-5 and pose["RP_c_mrad"] < 1e-5


def test_a_pose_that_the_fit_has_seen_is_not_held_out(ur10):
    """Its visits in both tables count together, as fitted; outliers count nowhere."""
    q, off = np.array([[0.1] * 6, [0.2] * 6, [0.1] * 6]), 1e-3 * np.array([[1.0, 0, 0], [1, 0, 0], [90, 0, 0]])
    fitted = visits_of(ur10, q, off, part="train", counted=[True, True, False])
    held = visits_of(ur10, q[[0, 0, 2]] + np.array([[0.0], [0.5], [0.5]]), off)
    numbers = replicate_groups([fitted.table, held.table])
    both = [replace(visits, pose=pose) for visits, pose in zip((fitted, held), numbers, strict=True)]
    found = iso9283(both, {"calibrated": np.zeros(0)})
    assert found["poses"] == {"train": 1, "test": 1}
    assert [(p["rows"], p["cycles"]) for p in found["per_pose"]] == [("train", 2), ("test", 2)]
    assert found["per_pose"][0]["AP_mm"] == pytest.approx(1.0)


def test_few_cycles_are_said_to_be_few():
    """The standard asks for 30; with those nothing more is said."""
    enough = {"poses": {"test": 1}, "cycles": {"min": 30, "max": 30, "standard": 30}}
    assert cycle_words(enough) == "1 pose, 30 cycles each"
    assert "specifies 30" in cycle_words(enough | {"cycles": {"min": 29, "max": 40, "standard": 30}})


# Lack of fit


def test_squares_by_hand(ur10):
    """Total, pure error with its degrees of freedom, and F, of two poses off by different amounts."""
    q = np.array([[0.1] * 6, [0.1] * 6, [0.4] * 6, [0.4] * 6, [0.4] * 6])
    offsets = 1e-3 * np.array([[1, 0, 0], [3, 0, 0], [0, 1, 0], [0, 2, 0], [0, 3, 0.0]])
    visits = visits_of(ur10, q, offsets)
    found = replicate_squares(visits, np.zeros(0), np.array([1e-3]))
    assert (found.total, found.pure) == pytest.approx((1 + 9 + 1 + 4 + 9, 2 + 2))
    assert (found.readings, found.degrees, found.poses) == (15, 9, 2)
    test = lack_of_fit([visits], np.zeros(0), np.array([1e-3]), spent=0.0)
    assert pytest.approx((24 - 4) / 6 / (4 / 9)) == test.F
    assert test.pure_error["sigma_m"] == pytest.approx(1e-3 * np.sqrt(4 / 9))
    single = visits_of(ur10, q[[0, 2]], offsets[:2])
    assert lack_of_fit([single], np.zeros(0), np.array([1e-3]), spent=0.0) is None
    exact = visits_of(ur10, q, np.ones((5, 3)))
    assert lack_of_fit([exact], np.zeros(0), np.array([1e-3]), spent=0.0) is None


def test_uncertainty_explains_what_woodbury_says(rng):
    """Find r' r - r' (1 + J C J')^-1 r without the large matrix, for a covariance of deficient rank."""
    J, root, r = rng.standard_normal((9, 4)), rng.standard_normal((4, 2)), rng.standard_normal(9)
    C = root @ root.T
    expected = r @ r - r @ np.linalg.solve(np.eye(9) + J @ C @ J.T, r)
    assert explained_by_uncertainty(Form.of(J.T @ J, J.T @ r), C) == pytest.approx(expected)


@dataclass(frozen=True)
class _Sensor:
    blocks: tuple[Block, ...] = (Block("position", "m", 3),)
    kind: str = "position"


@dataclass(frozen=True)
class _Linear:
    """Residuals of a linear model that has been fitted."""

    left: np.ndarray
    weights: np.ndarray
    sensor: _Sensor = _Sensor()
    block_rows: tuple[slice, ...] = (slice(0, 3),)

    def residuals(self, values):
        return self.left


def linear_p_values(scatter, runs, *, missing=0.0):
    """Return p values of linear fits of 3 x 4 parameters to 20 poses in 4 visits; ``scatter`` of each pose, (20, 3, 3)."""
    rng, found = np.random.default_rng(1), []
    pose = np.tile(np.arange(20), 4)
    for _ in range(runs):
        x = rng.uniform(-1.0, 1.0, 20)
        design = np.vander(x, 4)[pose]
        noise = np.einsum("nab,nb->na", scatter[pose], rng.standard_normal((80, 3)))
        y = noise + missing * np.sin(6.0 * x[pose])[:, None]
        left = y - design @ np.linalg.lstsq(design, y, rcond=None)[0]
        visits = Replicates("train", None, _Linear(left.T, np.ones(80)), pose, np.ones(80, bool))
        found.append(lack_of_fit([visits], np.zeros(0), np.ones(1), spent=12.0).p_value)
    return np.array(found)


def test_chances_are_true_where_nothing_is_missing():
    """Over 400 fits of a model that is right, p is even between 0 and 1."""
    p = linear_p_values(np.tile(np.eye(3), (20, 1, 1)), 400)
    assert kstest(p, "uniform").pvalue > 0.01
    assert 0.02 <= np.mean(p < 0.05) <= 0.08


def test_uneven_scatter_raises_no_alarm():
    """A robot that scatters in one direction, five times as much at some poses, is not taken for a wrong model."""
    scatter = np.tile(np.diag([1.0, 0.1, 0.1]), (20, 1, 1)) * np.where(np.arange(20) % 4, 1.0, 5.0)[:, None, None]
    p = linear_p_values(scatter, 400)
    assert np.mean(p < 0.05) <= 0.08 and np.mean(p < 0.01) <= 0.03


def test_what_is_missing_is_seen():
    """A wave of twice the noise that the model lacks is seen nearly always."""
    p = linear_p_values(np.tile(np.eye(3), (20, 1, 1)), 50, missing=2.0)
    assert np.mean(p < 1e-3) > 0.9


def test_evenness_is_that_of_the_covariances():
    """1 for independent readings of one size, 1 / m where all move together."""
    rng = np.random.default_rng(2)
    pose, x = np.repeat(np.arange(400), 6), rng.standard_normal((3, 2400))

    def even(y):
        means = np.stack([np.bincount(pose, row) / 6.0 for row in y])
        return evenness(scatter_of(y - means[:, pose], pose))

    assert even(x) == pytest.approx(1.0, abs=0.02)
    assert even(np.tile(x[:1], (3, 1))) == pytest.approx(1.0 / 3.0, abs=0.03)
    assert evenness(np.zeros(4)) == 1.0


# Real calibrations


def visited(n, cycles, seed, *, compliance=0.0, scatter=0.0, machine_seed=0):
    """Return visits of a simulated KUKA's poses."""
    rng = np.random.default_rng(machine_seed)
    machine = sim.TrueMachine.from_urdf(URDF, tip="tool0", compliance=np.full((6, 3), compliance))
    machine = machine.draw_errors(rng, sigma_length=5e-4, sigma_angle=5e-4)
    machine = machine.with_effects(*(sim.JointScatter(joint=f"joint_{i}", size=scatter) for i in range(1, 7) if scatter))
    rng = np.random.default_rng(100 + seed)
    q = np.tile(sim.plan_poses(machine.nominal, n, rng), (cycles, 1))
    columns = sim.Instrument(targets=(0.1, 0.0, 0.2), sigma=5e-5).measure(machine, q, rng=rng)
    return measurements_from_arrays(machine.names, q, position=np.column_stack([columns[axis] for axis in "xyz"]))


@pytest.fixture(scope="module")
def soft(kuka):
    """A robot that bends, calibrated with geometry alone."""
    rows = visited(50, 3, 0, compliance=3e-7)
    return run_calibration(kuka, rows, Options(effects=GEOMETRIC))


@pytest.mark.long
def test_a_missing_effect_is_told_without_any_declared_noise(kuka, soft):
    """Geometry alone does not fit a robot that bends; with elasticity it does, and RP is the same."""
    lacking = soft.result
    assert lacking.lack_of_fit.p_value < 1e-6 and judged(lacking).judgement == "not adequate"
    assert any("lack of fit" in words.text for words in lacking.warnings)
    whole = run_calibration(kuka, visited(50, 3, 0, compliance=3e-7), Options(effects=ELASTIC)).result
    assert whole.lack_of_fit.p_value > 1e-3 and judged(whole).judgement == "adequate"
    assert whole.lack_of_fit.pure_error["sigma_m"] == pytest.approx(5e-5, rel=0.15)
    before, after = (result.iso9283["calibrated"]["test"] for result in (lacking, whole))
    assert after["AP_mm"]["mean"] < 0.6 * before["AP_mm"]["mean"]
    assert after["RP_mm"]["mean"] == pytest.approx(before["RP_mm"]["mean"], rel=1e-3)


def test_a_robot_that_repeats_badly_is_not_a_wrong_model(kuka):
    """The declared noise of the instrument is too small for the robot's scatter; visits say that it is not the model."""
    rows = visited(40, 4, 1, scatter=1e-4)
    result = run_calibration(kuka, rows, Options(effects=GEOMETRIC, sigma=5e-5)).result
    assert result.chi2_p_value < 1e-3 < result.lack_of_fit.p_value
    assert any("repeats poorly" in words.text for words in result.warnings)


def test_the_report_has_a_section_on_visits(soft):
    """AP, RP, the number of cycles and the test stand there; not where no pose was visited twice."""
    page = page_of(soft)
    assert 'id="repeatability"' in page and "3 cycles each; ISO 9283 specifies 30" in page and "Lack of fit" in page
    bare = replace(soft, result=replace(soft.result, iso9283=None, lack_of_fit=None))
    assert 'id="repeatability"' not in page_of(bare)
    assert not {"iso9283", "lack_of_fit"} & set(bare.result.to_dict())


@pytest.mark.long
def test_the_commands_tell_accuracy_and_repeatability(tmp_path, capsys):
    """Calibrate and validate print them and have them in their JSON, in the words of the standard."""
    simulated = ["simulate", URDF, "--elastic", "0", "--cycles", "4", "--quiet", "--out"]
    assert run(*simulated, tmp_path / "data.csv", "--poses", "30", "--sensor", "pose") == 0
    assert run(*simulated, tmp_path / "new.csv", "--poses", "12", "--sensor", "pose", "--pose-seed", "1") == 0
    chosen = ["--model", "geometric", "--quiet", "--verbose", "--out", tmp_path / "out"]
    capsys.readouterr()
    assert run("calibrate", URDF, tmp_path / "data.csv", *chosen) == 0
    text = capsys.readouterr().out
    assert "Pose accuracy AP and pose repeatability RP (ISO 9283)" in text and "4 cycles each" in text
    assert "lack of fit: F(" in text and "mrad about z" in text
    assert max(len(line) for line in text.splitlines() if not line.startswith(("note: ", "written to "))) <= 100
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert (
        result["iso9283"]["calibrated"]["test"]["AP_mm"]["mean"]
        < 0.1
        < result["iso9283"]["nominal"]["test"]["AP_mm"]["mean"]
    )
    assert len(result["iso9283"]["per_pose"]) == 30 and result["lack_of_fit"]["p_value"] > 1e-3
    model = tmp_path / "out" / "model.json"
    assert run("validate", model, tmp_path / "new.csv", "--quiet") == 0
    text = capsys.readouterr().out
    assert "pose repeatability RP" in text and "distance accuracy" in text and "95 % intervals: mean" in text
    assert run("validate", model, tmp_path / "new.csv", "--quiet", "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["iso9283"]["poses"] == {"test": 12} and printed["lack_of_fit"]["p_value"] > 1e-3


@pytest.mark.long
@pytest.mark.rates
@pytest.mark.parametrize("scatter", [0.0, 1e-4])
def test_chances_are_true_of_calibrations(kuka, scatter):
    """Over 120 calibrations, and as many validations on new poses, false alarms are as rare as they say."""
    from pincal.calibration.fitted_robot import FittedRobot
    from pincal.validate.lack_of_fit import replicate_statistics

    found = []
    for seed in range(120):
        calibration = run_calibration(
            kuka, visited(40, 4, seed, scatter=scatter, machine_seed=seed), Options(effects=GEOMETRIC)
        )
        calibrated = FittedRobot.of(calibration.fit.fit, {})
        new = visited(20, 4, 1000 + seed, scatter=scatter, machine_seed=seed)
        _, tested = replicate_statistics(
            calibrated.readings(new),
            calibrated.values,
            new,
            sigma=calibrated.sigma,
            covariance=calibrated.covariance,
        )
        found.append((calibration.result.lack_of_fit.p_value, tested.p_value))
    for p in np.array(found).T:
        assert np.mean(p < 0.05) < 0.11 and np.mean(p < 0.01) < 0.05 and 0.4 < p.mean() < 0.6
