"""Features through points: closed forms, another solver, and Monte Carlo against the propagated covariance."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from pincal.errors import BadInputError
from pincal.features.feature_fit import FittedFeature, fit_feature
from pincal.features.feature_set import FeatureSet

TURN = Rotation.from_rotvec([0.7, -0.4, 1.1]).as_matrix()
CENTRE = np.array([1.2, -0.4, 0.7])
SIGMA = 5e-5


def placed(points: np.ndarray) -> np.ndarray:
    """Return points of a feature about the z axis at the place of the tests, shape (N, 3) [m]."""
    return CENTRE + points @ TURN.T


def ring(n: int, radius: float, span: float = 2 * np.pi) -> np.ndarray:
    """Return evenly spread points of a circle about the z axis, shape (n, 3)."""
    angle = span * np.arange(n) / n
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(n)])


def true_points(kind: str) -> np.ndarray:
    """Return noise-free points of a feature of each kind."""
    rng = np.random.default_rng(5)
    if kind == "point":
        return placed(np.zeros((5, 3)))
    if kind == "line":
        return placed(np.linspace(-0.1, 0.1, 9)[:, None] * np.array([0.0, 0.0, 1.0]))
    if kind == "plane":
        return placed(np.column_stack([rng.uniform(-0.1, 0.1, (12, 2)), np.zeros(12)]))
    if kind == "circle":
        return placed(ring(8, 0.02))
    if kind == "sphere":
        directions = rng.normal(size=(15, 3))
        return placed(0.03 * directions / np.linalg.norm(directions, axis=1, keepdims=True))
    height = rng.uniform(-0.05, 0.05, (14, 1)) * np.array([0.0, 0.0, 1.0])
    return placed(ring(14, 0.02, 0.7 * 2 * np.pi) + height)


KINDS = ("point", "line", "plane", "circle", "sphere", "cylinder")


def correlated(n: int, seed: int = 2) -> np.ndarray:
    """Return a full covariance of n points: a shift and a turn that all share, and noise of each, unequal by axis."""
    rng = np.random.default_rng(seed)
    common = 2e-5 * rng.normal(size=(3 * n, 6))
    own = rng.uniform(0.3, 2.0, 3 * n) * 2e-5
    return common @ common.T + np.diag(own**2)


def drawn(points: np.ndarray, covariance: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return points with errors of a covariance."""
    root = np.linalg.cholesky(covariance)
    return points + (root @ rng.normal(size=points.size)).reshape(points.shape)


@pytest.mark.parametrize("kind", KINDS)
def test_exact_points_give_the_exact_feature(kind: str) -> None:
    """Position, direction and radius are those of the feature, and its form error is none."""
    points = true_points(kind)
    found = fit_feature(kind, points, SIGMA**2 * np.eye(points.size))
    offset = CENTRE - found.position
    axis = TURN[:, 2]

    if kind in ("line", "cylinder"):
        offset -= axis * (axis @ offset)
    if kind == "plane":
        offset = axis * (axis @ offset)
    assert np.allclose(offset, 0.0, atol=1e-10)
    if "i" in found.names:
        assert abs(found.direction @ axis) == pytest.approx(1.0, abs=1e-12)
    if "radius" in found.names:
        assert found.radius == pytest.approx(0.03 if kind == "sphere" else 0.02, abs=1e-10)
    assert found.form_error < 1e-9
    assert found.form_sigma == 0.0


def test_variances_of_a_circle_are_the_known_ones() -> None:
    """Evenly spread points: sigma^2/N of the radius, 2 sigma^2/N of the centre in the plane, sigma^2/N across it."""
    n = 8
    points = ring(n, 0.02)
    found = fit_feature("circle", points, SIGMA**2 * np.eye(3 * n))

    assert found.sigma("radius") == pytest.approx(SIGMA / np.sqrt(n))
    assert [found.sigma(name) for name in "xy"] == pytest.approx([SIGMA * np.sqrt(2.0 / n)] * 2)
    assert found.sigma("z") == pytest.approx(SIGMA / np.sqrt(n))
    # Of the slopes of a plane through points of a circle: 2 sigma^2 / (N r^2).
    assert [found.sigma(name) for name in "ij"] == pytest.approx([SIGMA * np.sqrt(2.0 / n) / 0.02] * 2)


def test_a_plane_is_that_of_the_singular_values() -> None:
    """With equal, independent errors it is the plane of least squares, whose normal is the last principal axis."""
    rng = np.random.default_rng(1)
    points = true_points("plane") + SIGMA * rng.normal(size=(12, 3))
    found = fit_feature("plane", points, SIGMA**2 * np.eye(36))
    normal = np.linalg.svd(points - points.mean(axis=0))[2][2]

    assert abs(normal @ found.direction) == pytest.approx(1.0, abs=1e-12)
    assert found.position == pytest.approx(points.mean(axis=0), abs=1e-12)
    assert found.form_error == pytest.approx(np.ptp((points - points.mean(axis=0)) @ normal))


def test_errors_that_all_points_share_move_the_feature_as_a_whole() -> None:
    """A common shift moves the centre by itself, and neither radius nor normal; the covariance may be singular."""
    points = true_points("circle")
    shift = np.tile(1e-4 * np.eye(3), (8, 1))
    found = fit_feature("circle", points, shift @ shift.T)

    assert [found.sigma(name) for name in "xyz"] == pytest.approx([1e-4] * 3)
    assert max(found.sigma(name) for name in ("i", "j", "k", "radius")) < 1e-12


def by_another_solver(kind: str, points: np.ndarray, covariance: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return the numbers that least_squares finds with the true place of each point as an unknown."""
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    n = len(points)

    def surface(x: np.ndarray) -> np.ndarray:
        position = x[:3]
        direction = x[3:6] / max(np.linalg.norm(x[3:6]), 1e-9)
        radius = x[6]
        if kind == "sphere":
            angles = x[7:].reshape(n, 2)
            level = np.column_stack([np.cos(angles[:, 0]), np.sin(angles[:, 0])]) * np.cos(angles[:, 1:])
            unit = np.column_stack([level, np.sin(angles[:, 1])])
            return np.asarray(position + radius * unit)
        first = np.cross(direction, [0.3, 0.9, -0.2])
        first /= np.linalg.norm(first)
        second = np.cross(direction, first)
        own = x[7:].reshape(n, -1)
        round_ = np.cos(own[:, :1]) * first + np.sin(own[:, :1]) * second
        along = own[:, 1:] * direction if kind == "cylinder" else 0.0
        return np.asarray(position + radius * round_ + along)

    def misfit(x: np.ndarray) -> np.ndarray:
        return np.asarray(whiten @ (surface(x) - points).ravel())

    y = points - start[:3]
    direction = start[3:6]
    first = np.cross(direction, [0.3, 0.9, -0.2])
    if kind == "sphere":
        own = np.column_stack([np.arctan2(y[:, 1], y[:, 0]), np.arcsin(y[:, 2] / np.linalg.norm(y, axis=1))])
    else:
        first /= np.linalg.norm(first)
        own = np.arctan2(y @ np.cross(direction, first), y @ first)[:, None]
        if kind == "cylinder":
            own = np.column_stack([own, y @ direction])
    found = least_squares(misfit, np.concatenate([start, own.ravel()]), x_scale="jac", xtol=1e-15, ftol=1e-15)
    return np.asarray(np.concatenate([found.x[:3], found.x[3:6] / max(np.linalg.norm(found.x[3:6]), 1e-9), found.x[6:7]]))


@pytest.mark.parametrize("kind", ["circle", "sphere", "cylinder"])
def test_another_solver_finds_the_same(kind: str) -> None:
    """The true places of all points as unknowns, by scipy, give the same feature under a full covariance."""
    points = true_points(kind)
    covariance = 25.0 * correlated(len(points))
    noisy = drawn(points, covariance, np.random.default_rng(5))
    found = fit_feature(kind, noisy, covariance)
    start = found.numbers + 1e-5 * np.random.default_rng(3).normal(size=7) * (found.numbers != 0.0)
    other = by_another_solver(kind, noisy, covariance, start)

    assert other[6] == pytest.approx(found.radius, abs=1e-8)
    offset = other[:3] - found.position
    if kind == "cylinder":
        offset -= found.direction * (found.direction @ offset)
    assert np.abs(offset).max() < 1e-8


def tangents(fit: FittedFeature) -> np.ndarray:
    """Return the parameters that a feature has, as linear functions of its numbers, shape (7, p)."""
    U, sizes, _ = np.linalg.svd(fit.sensitivity, full_matrices=False)
    return np.asarray(U[:, sizes > 1e-9 * sizes[0]])


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=pytest.mark.long if kind in ("circle", "cylinder") else ()) for kind in KINDS]
)
def test_the_covariance_is_that_of_many_draws(kind: str) -> None:
    """JCGM 101: squared deviations by the propagated covariance have the mean that their number says, as chi-square."""
    points = true_points(kind)
    covariance = correlated(len(points))
    truth = fit_feature(kind, points, covariance)
    T = tangents(truth)
    inverse = np.linalg.inv(T.T @ truth.covariance @ T)
    rng = np.random.default_rng(8)
    squares = []
    chi_squares = []
    for _ in range(60):
        found = fit_feature(kind, drawn(points, covariance, rng), covariance)
        chi_squares.append(found.chi_square)
        off = found.numbers - truth.numbers
        if found.direction @ truth.direction < 0.0:
            off[3:6] = -found.direction - truth.direction
        squares.append(float(off @ T @ inverse @ T.T @ off))
    p = T.shape[1]

    # Means of 60 draws: four standard deviations of a chi-square's mean. The position moves along a line or a plane
    # with the mean of its points, which T leaves out but for the motion's second order.
    assert np.mean(squares) == pytest.approx(p, abs=4.0 * np.sqrt(2.0 * p / 60))
    assert np.mean(chi_squares) == pytest.approx(truth.dof, abs=4.0 * np.sqrt(2.0 * truth.dof / 60))


def test_the_sensitivity_is_that_of_differences() -> None:
    """Each coordinate of each point, moved by a micrometre, moves the numbers as stated."""
    points = true_points("cylinder")
    covariance = correlated(len(points))
    found = fit_feature("cylinder", points, covariance)
    T = tangents(found)
    step = 1e-6
    for i in range(0, points.size, 5):
        ends = []
        for sign in (1.0, -1.0):
            near = points.ravel().copy()
            near[i] += sign * step
            ends.append(fit_feature("cylinder", near.reshape(-1, 3), covariance).numbers)
            ends[-1][3:6] *= np.sign(ends[-1][3:6] @ found.direction)
        slope = (ends[0] - ends[1]) / (2.0 * step)

        assert T.T @ slope == pytest.approx(T.T @ found.sensitivity[:, i], abs=2e-4)


def test_form_is_counted_where_the_noise_does_not_explain_it() -> None:
    """A plate with waves of 0.1 mm and readings good to 10 um: the waves are the form, and go into the uncertainty."""
    rng = np.random.default_rng(6)
    places = rng.uniform(-0.1, 0.1, (40, 2))
    waves = 1e-4 * rng.normal(size=40)
    flat = fit_feature("plane", placed(np.column_stack([places, np.zeros(40)])), 1e-10 * np.eye(120))
    wavy = fit_feature("plane", placed(np.column_stack([places, waves])), 1e-10 * np.eye(120))

    assert flat.form_sigma == 0.0
    assert wavy.form_sigma == pytest.approx(1e-4, rel=0.3)
    assert wavy.form_error == pytest.approx(np.ptp(waves), rel=0.2)
    assert np.trace(wavy.covariance) > 30.0 * np.trace(flat.covariance)
    assert wavy.chi_square > 1000.0


def test_without_a_covariance_residuals_tell_the_uncertainty() -> None:
    """The mean of points, whose standard uncertainty is s / sqrt(N) of one coordinate."""
    rng = np.random.default_rng(7)
    points = placed(SIGMA * rng.normal(size=(50, 3)))
    found = fit_feature("point", points)

    assert found.position == pytest.approx(points.mean(axis=0))
    spread = np.sqrt(np.mean(points.var(axis=0, ddof=1)))
    assert found.sigma("x") == pytest.approx(spread / np.sqrt(50), rel=1e-3)


DEGENERATE: dict[str, tuple[str, Callable[[], np.ndarray], str]] = {
    "few": ("circle", lambda: ring(2, 0.1), "2 points; expected 3"),
    "circle of a line": ("circle", lambda: np.outer([0.0, 1.0, 2.0], [1.0, 2.0, 0.5]), "one line"),
    "plane of a line": ("plane", lambda: np.outer([0.0, 1.0, 2.0, 3.0], [1.0, 2.0, 0.5]), "one line"),
    "sphere of a ring": ("sphere", lambda: ring(9, 0.1), "one plane"),
    "cylinder of a ring": ("cylinder", lambda: ring(9, 0.1), "one plane"),
    "line of a place": ("line", lambda: np.ones((4, 3)), "one place"),
    "kind": ("torus", lambda: ring(9, 0.1), "expected one of"),
    "shape": ("plane", lambda: np.zeros((4, 2)), "expected finite"),
    "nan": ("plane", lambda: np.full((4, 3), np.nan), "expected finite"),
}


@pytest.mark.parametrize("case", DEGENERATE)
def test_degenerate_points_are_refused(case: str) -> None:
    """By name, with what was found and what is needed."""
    kind, points, words = DEGENERATE[case]

    with pytest.raises(BadInputError, match=words):
        fit_feature(kind, points(), name="F")


def test_points_that_leave_a_feature_open_are_refused() -> None:
    """An arc of some degrees under noise that is as large as its sagitta tells no radius."""
    points = ring(8, 0.1, 0.1)
    with pytest.raises(BadInputError, match=r"'arc' \(circle\).* open "):
        fit_feature("circle", points, (2e-4) ** 2 * np.eye(24), name="arc")
    assert fit_feature("circle", points, (1e-8) ** 2 * np.eye(24)).radius == pytest.approx(0.1, rel=1e-3)


def test_features_share_what_their_points_share() -> None:
    """Two holes of one set: a common shift moves both alike, and leaves their distance."""
    points = np.vstack([ring(6, 0.01), ring(6, 0.01) + np.array([0.2, 0.0, 0.0])])
    names = np.repeat(["left", "right"], 6)
    shift = np.tile(1e-4 * np.eye(3), (12, 1))
    C = shift @ shift.T + 1e-10 * np.eye(36)
    found = FeatureSet.fit({"left": "circle", "right": "circle"}, names, points, C)
    A = found.sensitivity
    total = A @ C @ A.T
    both = [found.at(name).start for name in found.names]
    of_x = total[np.ix_(both, both)]

    assert np.sqrt(of_x[0, 0]) == pytest.approx(found.fits["left"].sigma("x"))
    assert of_x[0, 0] + of_x[1, 1] - 2.0 * of_x[0, 1] == pytest.approx(2.0 * 1e-10 * 2.0 / 6.0)


def test_points_of_no_feature_are_refused() -> None:
    """With the nearest name first."""
    with pytest.raises(BadInputError, match="hole_1"):
        FeatureSet.fit({"rim": "circle", "hole_1": "circle"}, np.array(["hole1"] * 3), ring(3, 0.1))
