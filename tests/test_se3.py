"""The algebra of rigid transforms, against SciPy's rotations and 4x4 matrices."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pincal.robot import se3

ANGLES = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3).map(np.array)
SEEDS = st.integers(0, 10_000)


def drawn(seed: int, count: int = 4) -> np.ndarray:
    """Return random transforms, shape (count, 3, 4)."""
    rng = np.random.default_rng(seed)
    return np.concatenate([Rotation.random(count, rng=rng).as_matrix(), rng.normal(size=(count, 3, 1))], axis=2)


def square(T: np.ndarray) -> np.ndarray:
    """Return transforms with their last row, shape (N, 4, 4)."""
    return np.concatenate([T, np.tile([[[0.0, 0.0, 0.0, 1.0]]], (len(T), 1, 1))], axis=1)


@settings(max_examples=50, deadline=None)
@given(SEEDS)
def test_transforms_form_a_group(seed: int) -> None:
    """Products and inverses are those of 4x4 matrices."""
    A, B = drawn(seed), drawn(seed + 1)

    np.testing.assert_allclose(square(se3.compose(A, B)), square(A) @ square(B), atol=1e-14)
    np.testing.assert_allclose(square(se3.inverse(A)), np.linalg.inv(square(A)), atol=1e-13)


@settings(max_examples=50, deadline=None)
@given(ANGLES)
def test_angles_mean_what_scipy_means(angles: np.ndarray) -> None:
    """A URDF's rpy are SciPy's extrinsic "xyz" angles, those of base and tool its intrinsic "XYZ" ones."""
    np.testing.assert_allclose(se3.rotation_of_rpy(angles), Rotation.from_euler("xyz", angles).as_matrix(), atol=1e-15)
    reference = Rotation.from_rotvec([0.3, -1.0, 0.2])
    T = se3.placed(reference.as_matrix(), np.array([1.0, 2.0, 3.0, *angles]))

    np.testing.assert_allclose(T[:3, :3], (reference * Rotation.from_euler("XYZ", angles)).as_matrix(), atol=1e-14)
    assert T[:, 3].tolist() == [1.0, 2.0, 3.0, 1.0]


@settings(max_examples=50, deadline=None)
@given(SEEDS)
def test_rotations_and_their_vectors_are_inverse(seed: int) -> None:
    """Vector, matrix and quaternion describe one rotation; all of them pass the check, a mirror image does not."""
    R = drawn(seed)[:, :, :3]

    np.testing.assert_allclose(se3.exponentials(se3.rotation_vectors(R)), R, atol=1e-12)
    np.testing.assert_allclose(se3.rotation_matrices(se3.quaternions(R)), R, atol=1e-12)
    assert se3.are_rotations(R, tolerance=1e-12)
    assert not se3.are_rotations(-R, tolerance=1e-12)
    assert not se3.are_rotations(1.001 * R, tolerance=1e-6)


@settings(max_examples=50, deadline=None)
@given(SEEDS)
def test_alignment_recovers_a_rigid_motion(seed: int) -> None:
    """Points moved rigidly give the motion back, and a scaled rotation its nearest rotation."""
    T = drawn(seed, 1)[0]
    points = np.random.default_rng(seed).normal(size=(6, 3))
    R, t = se3.align(points, points @ T[:, :3].T + T[:, 3])

    np.testing.assert_allclose(R, T[:, :3], atol=1e-12)
    np.testing.assert_allclose(t, T[:, 3], atol=1e-12)
    np.testing.assert_allclose(se3.nearest_rotation(1.7 * R), R, atol=1e-14)


@pytest.mark.parametrize("start", [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.6, 0.0, 0.8), (0.0, -1.0, 0.0)])
def test_the_shortest_turn_leads_to_the_end(start: tuple[float, float, float]) -> None:
    """One vector turns into the other, even into its opposite; the angle is the one between them."""
    a, b = np.array(start), np.array([0.0, 0.0, 1.0])
    R = se3.shortest_turn(a, b)[:3, :3]

    np.testing.assert_allclose(R @ a, b, atol=1e-15)
    assert np.isclose(np.trace(R), 1.0 + 2.0 * a @ b)
