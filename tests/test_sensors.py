"""Sensors: every one keeps the same contract."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pincal.errors import MeasurementError
from pincal.measure import sensors
from pincal.measure.measurements import measurements_from_arrays
from pincal.measure.sensors import (
    DistanceSensor,
    PoseSensor,
    PositionSensor,
    Sensor,
    rotation_matrices,
    rotation_vectors,
    sensor_of,
)
from pincal.model.chain import FRAME_SYMBOLS

N = 12
OWN = np.zeros(0)


def random_poses(rng: np.random.Generator, n: int = N) -> np.ndarray:
    """Return poses anywhere within some metres, shape (n, 3, 4)."""
    return np.concatenate([Rotation.random(n, random_state=rng).as_matrix(), rng.uniform(-3.0, 3.0, (n, 3, 1))], axis=2)


def moved(poses: np.ndarray, shift: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Return poses shifted [m] and turned by rotation vectors [rad], both in the instrument's axes."""
    out = poses.copy()
    out[:, :, :3] = Rotation.from_rotvec(turn).as_matrix() @ poses[:, :, :3]
    out[:, :, 3] += shift
    return out


READ: dict[str, Callable[[np.ndarray], Sensor]] = {
    "position": lambda poses: PositionSensor(poses[:, :, 3].copy()),
    "pose": lambda poses: PoseSensor(poses[:, :, 3].copy(), poses[:, :, :3].copy()),
    "distance": lambda poses: DistanceSensor(np.linalg.norm(poses[:, :, 3], axis=1)),
}


@pytest.fixture(params=READ)
def read(request: pytest.FixtureRequest) -> Callable[[np.ndarray], Sensor]:
    """Return what makes each sensor from the poses that it reads without noise."""
    return READ[request.param]


def test_every_sensor_is_under_test(rng: np.random.Generator) -> None:
    """A sensor that is added without being added here fails this test."""
    found = {kind for kind in vars(sensors).values() if isinstance(kind, type) and issubclass(kind, Sensor)}

    assert found - {Sensor} == {type(make(random_poses(rng))) for make in READ.values()}
    assert all(make(random_poses(rng)).kind == kind for kind, make in READ.items())


def test_residuals_are_zero_at_the_truth(read: Callable[[np.ndarray], Sensor], rng: np.random.Generator) -> None:
    """A reading of a pose agrees with the prediction of this pose."""
    poses = random_poses(rng)

    np.testing.assert_allclose(read(poses).residuals(poses, OWN), 0.0, atol=1e-15)


def test_blocks_add_up_to_the_components(read: Callable[[np.ndarray], Sensor], rng: np.random.Generator) -> None:
    """There are as many residuals a row as the blocks say, as many columns in the Jacobian as motions."""
    poses, sensor = random_poses(rng), read(random_poses(rng))
    m = sum(block.size for block in sensor.blocks)
    motion = rng.standard_normal((5, sensor.twist_rows, N))

    assert len(sensor) == N
    assert sensor.residuals(poses, OWN).shape == (m, N)
    assert sensor.jacobian(poses, motion, OWN).shape == (5 + len(sensor.parameters), m, N)
    assert all(block.unit == ("rad" if block.name == "orientation" else "m") for block in sensor.blocks)
    assert set(sensor.base_symbols) <= set(FRAME_SYMBOLS) and set(sensor.tool_symbols) <= set(FRAME_SYMBOLS)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1e-3, 0.1, 1.0, 2.5, 3.0])
def test_jacobian_is_minus_the_slope_of_the_residuals(
    read: Callable[[np.ndarray], Sensor], angle: float, rng: np.random.Generator
) -> None:
    """The Jacobian equals central differences of the residuals, for orientations off by anything up to 3 rad, too."""
    poses = random_poses(rng)
    axis = rng.standard_normal((N, 3))
    off = angle * axis / np.linalg.norm(axis, axis=1, keepdims=True)
    sensor = read(moved(poses, rng.normal(0.0, 0.1, (N, 3)), off))
    rows = sensor.twist_rows
    motion = rng.standard_normal((4, rows, N))
    jacobian = sensor.jacobian(poses, motion, OWN)
    h = 1e-6
    for p in range(4):
        twist = np.zeros((N, 6))
        twist[:, :rows] = motion[p].T
        ahead, behind = (sensor.residuals(moved(poses, s * twist[:, :3], s * twist[:, 3:]), OWN) for s in (h, -h))
        # The slope grows without bound towards half a turn, and so does what differences are off by.
        np.testing.assert_allclose(jacobian[p], (behind - ahead) / (2.0 * h), rtol=1e-7, atol=1e-8 if angle < 3.0 else 1e-6)


def test_jacobian_leaves_the_motion_as_it_is(read: Callable[[np.ndarray], Sensor], rng: np.random.Generator) -> None:
    """The motion that is handed in may be used again."""
    poses = random_poses(rng)
    sensor = read(moved(poses, np.zeros(3), np.full((N, 3), 0.3)))
    motion = rng.standard_normal((2, sensor.twist_rows, N))
    before = motion.copy()
    sensor.jacobian(poses, motion, OWN)

    np.testing.assert_array_equal(motion, before)


@pytest.mark.parametrize(
    "rows",
    [slice(2, 7), np.array([5, 0, 5]), np.arange(N) % 3 == 0, np.zeros(N, bool)],
    ids=["slice", "index", "mask", "none"],
)
def test_selected_rows_are_those_of_the_table(
    read: Callable[[np.ndarray], Sensor], rows: slice | np.ndarray, rng: np.random.Generator
) -> None:
    """Selecting readings and selecting residuals is the same thing."""
    poses, sensor = random_poses(rng), read(random_poses(rng))
    part = sensor.select(rows)

    assert type(part) is type(sensor) and len(part) == len(np.arange(N)[rows])
    np.testing.assert_array_equal(part.residuals(poses[rows], OWN), sensor.residuals(poses, OWN)[:, rows])


def test_orientation_residual_is_the_turn_in_the_instruments_axes(rng: np.random.Generator) -> None:
    """A tool measured turned by phi from its prediction, in the instrument's axes, has the residual phi."""
    poses, phi = random_poses(rng), rng.normal(0.0, 0.5, (N, 3))
    sensor = READ["pose"](moved(poses, np.full(3, 0.01), phi))

    np.testing.assert_allclose(sensor.residuals(poses, OWN)[3:].T, phi, atol=1e-14)
    np.testing.assert_allclose(sensor.residuals(poses, OWN)[:3], 0.01, atol=1e-15)


def test_distance_sees_no_orientation(rng: np.random.Generator) -> None:
    """A distance is the same from any direction; base and tool have no angles for it."""
    poses = random_poses(rng)
    turned = Rotation.random(random_state=1).as_matrix() @ poses

    np.testing.assert_allclose(READ["distance"](turned).residuals(poses, OWN), 0.0, atol=1e-14)
    assert DistanceSensor.base_symbols == DistanceSensor.tool_symbols == FRAME_SYMBOLS[:3]


def test_the_table_chooses_the_sensor(rng: np.random.Generator) -> None:
    """A table's columns say which sensor reads it; quaternions x y z w become matrices."""
    poses, q = random_poses(rng), np.zeros((N, 2))
    position, quaternion = poses[:, :, 3], Rotation.from_matrix(poses[:, :, :3]).as_quat()
    tables = {
        "position": measurements_from_arrays("ab", q, position=position),
        "pose": measurements_from_arrays("ab", q, position=position, quaternion=-quaternion),
        "distance": measurements_from_arrays("ab", q, distance=np.linalg.norm(position, axis=1)),
    }
    for kind, table in tables.items():
        sensor = sensor_of(table)
        assert sensor.kind == kind and len(sensor) == N
        np.testing.assert_allclose(sensor.residuals(poses, OWN), 0.0, atol=1e-14)


def test_a_table_that_no_sensor_reads_is_refused() -> None:
    """A table without readings of a target says what is expected."""
    table = measurements_from_arrays("ab", np.zeros((3, 2)), source="poses.csv")
    with pytest.raises(MeasurementError, match=r"poses\.csv: no sensor .*'none'; expected columns x y z"):
        sensor_of(table)


def test_rotation_vectors_undo_rotation_matrices(rng: np.random.Generator) -> None:
    """Quaternions, matrices and vectors of the same rotations agree."""
    turns = Rotation.random(20, random_state=rng)

    np.testing.assert_allclose(rotation_matrices(turns.as_quat()), turns.as_matrix(), atol=1e-15)
    np.testing.assert_allclose(rotation_vectors(turns.as_matrix()), turns.as_rotvec(), atol=1e-12)
