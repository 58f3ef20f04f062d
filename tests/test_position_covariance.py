"""The covariance of positions with each other: by formulas of its own, and by differences of predictions."""

from dataclasses import replace

import numpy as np
import pytest
from msgspec.structs import replace as changed
from scipy.spatial.transform import Rotation

from pincal import BadInputError, Robot
from pincal.calibration.covered import Covered
from pincal.calibration.discrepancy import Discrepancy
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.position_covariance import PositionCovariance, SharedErrors
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effects import BaseFrame, JointOffset, ToolFrame
from pincal.model.model import Model
from pincal.parameters import estimate_of

LENGTHS = np.array([0.05, 0.8])


@pytest.fixture(scope="module")
def ur10() -> FittedRobot:
    """Return a UR10 with uncertain base, tool and offsets, whose first and third drives err by more than these."""
    model = Model(Chain.of(Robot.from_urdf("ur10")), (BaseFrame(), ToolFrame(), JointOffset()))
    rng = np.random.default_rng(3)
    mixed = rng.normal(0.0, 1e-5, (model.n_parameters, model.n_parameters))
    values = rng.normal(0.0, 1e-2, model.n_parameters)
    covered = Covered(np.tile([-1.0, 1.0], (6, 1)), np.array([0.0, 0.0]))
    given = FittedRobot.given(model, estimate_of(model.parameters, values, mixed @ mixed.T), covered)
    drives = np.zeros((6, 2))
    drives[0] = 1e-9, 2e-9
    drives[2] = 0.0, 3e-9
    lacks = Discrepancy(lengths=LENGTHS, drives=drives, rest=1e-10, factor=1.3, coordinates=300)
    return replace(given, discrepancy=lacks)


def _by_difference(robot: FittedRobot, q: np.ndarray, point: np.ndarray, frame: str, of_drives: bool) -> np.ndarray:
    """Return the motion of points on the tip by each parameter, or each drive, by differences, shape (N, 3, P)."""
    step = 1e-6
    found = []
    for k in range(q.shape[1] if of_drives else len(robot.values)):
        ends = []
        for side in (-step, step):
            values, at = robot.values.copy(), q.copy()
            if of_drives:
                at[:, k] += side
            else:
                values[k] += side
            moved = replace(robot, estimate=estimate_of(robot.model.parameters, values, robot.covariance))
            ends.append(moved.positions_of(at, point, frame=frame))
        found.append((ends[1] - ends[0]) / (2.0 * step))
    return np.stack(found, axis=2)


def _matern(a: np.ndarray, length: float) -> np.ndarray:
    """Return the correlation of positions of a drive, shape (N, N)."""
    apart = np.sqrt(3.0) * np.abs(np.subtract.outer(a, a)) / length
    return np.asarray(np.exp(-apart) + apart * np.exp(-apart))


def _of_drives(lacks: Discrepancy, q: np.ndarray, levers: np.ndarray) -> np.ndarray:
    """Return the dense covariance of what a model lacks, shape (3N, 3N), for levers of shape (N, 3, n)."""
    same = np.all(q[:, None] == q[None], axis=2)
    expected = np.kron(same, lacks.rest * np.eye(3))
    for j, sizes in enumerate(lacks.drives):
        alike = sum(size * _matern(q[:, j], length) for size, length in zip(sizes, LENGTHS, strict=True))
        lever = levers[:, :, j].ravel()
        expected = expected + np.kron(alike, np.ones((3, 3))) * np.outer(lever, lever)
    return np.asarray(lacks.factor**2 * expected)


@pytest.mark.parametrize("frame", ["base", "instrument"])
def test_points_on_the_tip_have_the_covariance_of_their_motions(
    ur10: FittedRobot, frame: str, rng: np.random.Generator
) -> None:
    """Parameters and drives move any point of the tip as differences of its position say; the target has no part in it."""
    q = rng.uniform(-1.5, 1.5, (8, 6))
    q[5] = q[1]
    point = rng.normal(0.0, 0.2, (8, 3))
    found = ur10.covariance_of(q, point=point, frame=frame)
    J = _by_difference(ur10, q, point, frame, of_drives=False)
    flat = J.reshape(24, -1)
    np.testing.assert_allclose(found.sources["parameters"].matrix, flat @ ur10.covariance @ flat.T, atol=1e-16)
    levers = _by_difference(ur10, q, point, frame, of_drives=True)
    np.testing.assert_allclose(found.sources["model"].matrix, _of_drives(ur10.discrepancy, q, levers), atol=1e-14)
    np.testing.assert_allclose(found.matrix, sum(of.matrix for of in found.sources.values()), rtol=1e-12)
    tools = np.array([p.effect == "tool_frame" for p in ur10.model.parameters])
    assert np.abs(J[:, :, tools]).max() == 0.0


def test_the_target_has_its_own_covariance(ur10: FittedRobot, rng: np.random.Generator) -> None:
    """Without a point the positions are those of the calibration's target, as predictions say them."""
    at = ur10.conditions_at(rng.uniform(-1.5, 1.5, (6, 6)))
    found = ur10.covariance_of(at)
    by_source = ur10.position_variances(at)
    for name, errors in found.sources.items():
        np.testing.assert_allclose(np.einsum("naa->na", errors.blocks), by_source[name], rtol=1e-8)
    assert np.abs(found.matrix - found.matrix.T).max() < 1e-20


def test_orientations_turn_as_differences_say(ur10: FittedRobot, rng: np.random.Generator) -> None:
    """The variance of predicted orientations is that of their rotation by parameters, and by drives that err."""
    at = ur10.conditions_at(rng.uniform(-1.5, 1.5, (3, 6)))
    step = 1e-6
    J = np.zeros((3, 3, len(ur10.values)))
    for k in range(len(ur10.values)):
        moved = [ur10.values + side * np.eye(len(ur10.values))[k] for side in (-step, step)]
        before, after = (ur10.model.predict(values, at)[:, :, :3] for values in moved)
        J[:, :, k] = Rotation.from_matrix(after @ before.swapaxes(1, 2)).as_rotvec() / (2.0 * step)
    found = ur10.turn_variances(at)
    np.testing.assert_allclose(found["parameters"], np.einsum("nap,pq,naq->na", J, ur10.covariance, J), rtol=1e-5)
    np.testing.assert_allclose(ur10.turn_sigma(at) ** 2, sum(found.values()), rtol=1e-12)


def test_linear_functions_need_no_matrix_of_all_positions(ur10: FittedRobot, rng: np.random.Generator) -> None:
    """What a linear map makes of the sources is what it makes of their matrix, also where rows share a stop."""
    q = np.repeat(rng.uniform(-1.5, 1.5, (5, 6)), 2, axis=0)
    sensor = SharedErrors.of_each(np.tile(np.diag([1e-10, 4e-10, 0.0]), (10, 1, 1)))
    found = ur10.covariance_of(q, point=rng.normal(0.0, 0.2, (10, 3)), frame="base").with_source("sensor", sensor)
    A = rng.normal(size=(4, 30))
    np.testing.assert_allclose(found.through(A), A @ found.matrix @ A.T, rtol=1e-9)
    assert dict(found.contributions(A)).keys() == {"parameters", "model", "sensor"}
    np.testing.assert_allclose(found.select(np.array([1, 7])).matrix[:3, 3:], found.matrix[3:6, 21:24], rtol=1e-12)
    np.testing.assert_allclose(found.blocks[4], found.matrix[12:15, 12:15], rtol=1e-9)


def test_near_readings_differ_by_less_than_independent_ones(ur10: FittedRobot, rng: np.random.Generator) -> None:
    """Where errors are of drives, differences of readings 20 mm apart have less than 0.6 of the u of independent ones."""
    smooth = changed(ur10.discrepancy, drives=np.tile([0.0, 3e-9], (6, 1)), rest=0.0)
    robot = replace(ur10, discrepancy=smooth)
    q = np.repeat(rng.uniform(-1.5, 1.5, (30, 6)), 2, axis=0)
    q[1::2] += 0.01 * rng.standard_normal((30, 6))
    places = robot.predict(q)[:, :, 3]
    q[1::2] = q[::2] + (q[1::2] - q[::2]) * (0.02 / np.linalg.norm(places[1::2] - places[::2], axis=1))[:, None]
    found = robot.covariance_of(q)
    A = np.kron(np.eye(30), np.hstack([-np.eye(3), np.eye(3)]))
    together = np.sqrt(np.diag(found.through(A)))
    alone = np.sqrt(np.diag(SharedErrors.of_each(found.blocks).through(A)))
    assert np.mean(together) < 0.6 * np.mean(alone)


def test_uncertain_points_turn_with_the_tip(ur10: FittedRobot, rng: np.random.Generator) -> None:
    """A point of the tip that all poses share errs alike in its axes; points of each pose err on their own."""
    q = rng.uniform(-1.5, 1.5, (3, 6))
    C = np.diag([1e-8, 4e-8, 0.0])
    rotations = ur10.between().predict(q)[:, :, :3]
    shared = ur10.covariance_of(q, point=np.ones(3), point_covariance=C, frame="base").sources["point"]
    flat = rotations.reshape(9, 3)
    np.testing.assert_allclose(shared.matrix, flat @ C @ flat.T, atol=1e-20)
    each = ur10.covariance_of(q, point=np.ones(3), point_covariance=np.tile(C, (3, 1, 1)), frame="base").sources["point"]
    np.testing.assert_allclose(each.blocks, rotations @ C @ rotations.swapaxes(1, 2), atol=1e-20)
    assert not each.matrix[:3, 3:].any()


def test_many_angles_of_a_drive_are_interpolated(ur10: FittedRobot, rng: np.random.Generator) -> None:
    """With more angles than are kept apart, variances stay exact and covariances are within a hundredth of them."""
    q = np.zeros((400, 6))
    q[:, 0] = rng.uniform(-1.5, 1.5, 400)
    levers = np.zeros((6, 400, 3))
    levers[0, :, 1] = 1.0
    found = ur10.discrepancy.errors(q, levers)
    expected = _of_drives(ur10.discrepancy, q, np.moveaxis(levers, 0, 2))
    size = expected[1, 1]
    assert found.common.shape[2] < 400
    np.testing.assert_allclose(np.diag(found.matrix), np.diag(expected), rtol=1e-9)
    assert np.abs(found.matrix - expected).max() < 0.01 * size


def test_what_does_not_fit_is_refused(ur10: FittedRobot) -> None:
    """Points, covariances, stops and sources of another number than the poses are named."""
    q = np.zeros((4, 6))
    with pytest.raises(BadInputError, match=r"points on the tip have shape \(2, 3\); expected \(3,\), or \(4, 3\)"):
        ur10.covariance_of(q, point=np.zeros((2, 3)))
    with pytest.raises(BadInputError, match=r"covariances of points on the tip have shape \(3,\)"):
        ur10.covariance_of(q, point=np.zeros(3), point_covariance=np.zeros(3))
    with pytest.raises(BadInputError, match=r"stops have shape \(3,\)"):
        ur10.covariance_of(q, stop=np.zeros(3))
    with pytest.raises(BadInputError, match="different numbers of positions"):
        PositionCovariance({"a": SharedErrors.of_each(np.zeros((2, 3, 3))), "b": SharedErrors.of_each(np.zeros((3, 3, 3)))})
    assert len(ur10.covariance_of(Conditions.at(q))) == 4
