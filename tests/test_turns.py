"""A joint that turns is at the same place after a turn, whatever its encoder counts."""

from pathlib import Path

import numpy as np
import pytest
from command_line import run

from pincal.calibration.covered import Covered
from pincal.calibration.curve_coverage import outside_curves, turned_curves
from pincal.calibration.fitted_robot import FittedRobot
from pincal.identify.split import Split, row_groups
from pincal.measure.measurements import measurements_from_arrays
from pincal.measure.table import write_table
from pincal.model.catalogue import GearEccentricity, GearRatio, TransmissionError
from pincal.model.catalogue.unnamed import Unnamed
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect
from pincal.model.effects import BaseFrame, ToolFrame
from pincal.model.model import Model
from pincal.parameters import estimate_of
from pincal.robot.robot import Robot

SPAN = (-2.5, 2.5)
TURN = 2.0 * np.pi


def model_with(robot: Robot, effect: Effect) -> FittedRobot:
    """Return a model whose effect was seen from -2.5 to 2.5 rad."""
    model = Model(Chain.of(robot), (BaseFrame(), ToolFrame(), effect))
    rng = np.random.default_rng(0)
    estimate = estimate_of(model.parameters, rng.normal(0.0, 1e-3, model.n_parameters), 1e-12 * np.eye(model.n_parameters))
    covered = Covered(np.tile(SPAN, (robot.n_joints, 1)), np.zeros(2))
    return FittedRobot.given(model, estimate, covered)


def poses(turns: float = 0.0, joint: int = 0) -> Conditions:
    """Return poses with a joint some turns away."""
    q = np.random.default_rng(1).uniform(-2.4, 2.4, (30, 6))
    q[:, joint] += turns * TURN
    return Conditions.at(q)


@pytest.mark.parametrize(
    "effect",
    [
        TransmissionError("joint_1", *SPAN, 12),
        TransmissionError("joint_1", *SPAN, 12, periodic=True),
        Unnamed("joint_1", "gamma_x", "joint_1", lower=SPAN[0], upper=SPAN[1]),
        Unnamed("joint_3", "drive", "joint_1", lower=SPAN[0], upper=SPAN[1]),
        GearEccentricity("joint_1", 2),
    ],
    ids=lambda effect: f"{effect.name} {effect.locus.joint}",
)
def test_a_turn_away_the_arm_is_where_it_was(kuka: Robot, effect: Effect) -> None:
    """A curve is taken at the turn in which it was seen; this is told, unless the effect repeats by its nature."""
    model = model_with(kuka, effect)
    for turns in (-1, 1, 2):
        away = poses(turns)
        np.testing.assert_allclose(model.predict(away), model.predict(poses()), rtol=0, atol=1e-12)
        assert model.outside(away) == [] and outside_curves(model, away) == []
        told = [(curve.effect, curve.joint, curve.variable, curve.rows) for curve in turned_curves(model, away)]
        assert told == ([(effect.name, effect.locus.joint, "joint_1", 30)] if effect.locus.span else [])
    assert turned_curves(model, poses()) == []


def test_what_counts_turns_goes_on_counting(kuka: Robot) -> None:
    """A wrong gear ratio is off by its part of the turn, too."""
    model = model_with(kuka, GearRatio("joint_1"))
    way = model.predict(poses(1))[:, :, 3] - model.predict(poses())[:, :, 3]

    assert np.linalg.norm(way, axis=1).min() > 1e-4


def test_positions_that_no_turn_brings_into_the_range_stay(kuka: Robot) -> None:
    """There the curve keeps its end value, and rows are told as outside."""
    model = model_with(kuka, TransmissionError("joint_1", *SPAN, 12))
    q = np.zeros((2, 6))
    q[:, 0] = 3.0, 3.2
    beyond = Conditions.at(q)

    assert [row.value for row in model.outside(beyond)] == [3.0, 3.2] and turned_curves(model, beyond) == []
    ends = model.model.effects[2].terms(model.model.chain, beyond, None)
    assert all(np.ptp(term.basis) == 0.0 for term in ends)


def test_a_sliding_joint_never_turns(tmp_path: Path) -> None:
    """Six metres on along a rail is another place."""
    link = '<link name="{}"/>'
    joint = '<joint name="rail" type="prismatic"><parent link="a"/><child link="b"/><axis xyz="1 0 0"/>{}</joint>'
    limit = '<limit lower="-9" upper="9" effort="1" velocity="1"/>'
    urdf = tmp_path / "rail.urdf"
    urdf.write_text(f'<robot name="r">{link.format("a")}{link.format("b")}{joint.format(limit)}</robot>')
    robot = Robot.from_urdf(urdf)
    model = Model(Chain.of(robot), (TransmissionError("rail", *SPAN, 8),))
    at = [model.predict(np.linspace(0.0, 1e-3, 8), Conditions.at([[x]]))[0, 0, 3] - x for x in (0.5, 0.5 + TURN, 2.5)]

    assert at[1] == pytest.approx(at[2], abs=1e-12) and abs(at[1] - at[0]) > 1e-5


def test_predict_tells_it(kuka: Robot, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """On stderr, with the number of rows."""
    model_with(kuka, TransmissionError("joint_1", *SPAN, 12)).save(tmp_path / "model.json")
    write_table(tmp_path / "poses.csv", dict(zip(kuka.joint_names, poses(1).q.T, strict=True)))

    assert run("predict", tmp_path / "model.json", tmp_path / "poses.csv", "--out", tmp_path / "out.csv") == 0
    assert "30 rows have joint_1 a revolution away from where the transmission_error of joint_1" in capsys.readouterr().err


@pytest.mark.parametrize("split", ["random", "blocked"])
def test_rows_are_held_out_by_where_the_joint_is(kuka: Robot, split: Split) -> None:
    """Rows whose joint has turned a whole turn more belong to the same block as those that have not."""
    q = poses().q.repeat(2, axis=0)
    turned = q.copy()
    turned[::2, 0] += TURN
    turned[::3, 3] -= 2.0 * TURN
    tables = [measurements_from_arrays(kuka.joint_names, at, distance=np.ones(len(at))) for at in (q, turned)]
    groups = [row_groups(table, split=split, seed=0) for table in tables]

    # The same rows together, whatever the number of their group.
    together = [group[:, None] == group for group in groups]
    assert np.array_equal(*together) and np.array_equal(groups[1][::2], groups[1][1::2])
