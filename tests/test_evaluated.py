"""Terms that are evaluated once are those that effects give, whether kept sparse or not."""

import gc
import weakref
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pincal import ELASTIC, GEOMETRIC, Conditions, Options, calibrate, measurements_from_arrays
from pincal.builtin import kuka_urdf_path
from pincal.discover.first_order import ScoreTests
from pincal.discover.locate import _given
from pincal.discover.products import Information
from pincal.discover.score_tests import score_test
from pincal.identify.believed import Beliefs, Earlier
from pincal.identify.equations import Linearised
from pincal.identify.fit import without
from pincal.identify.jacobian import Jacobian, SharedColumns
from pincal.identify.normal import accumulate, accumulate_at, near
from pincal.identify.posterior import Nonzero, Posterior
from pincal.identify.problem import extended
from pincal.identify.quadratic import Form
from pincal.identify.whitening import Serial
from pincal.model.catalogue.drives import GearEccentricity
from pincal.model.catalogue.transmission import TransmissionError
from pincal.model.catalogue.unnamed import Unnamed
from pincal.model.chain import Chain
from pincal.model.conditions import part_of
from pincal.model.evaluated import plain_terms
from pincal.model.model import Model
from pincal.model.sparse_basis import dense_rows, joined_rows, sparse_across, sparse_rows
from pincal.robot.robot import Robot

ROBOT = Robot.from_urdf(kuka_urdf_path())


def test_a_basis_without_its_zeros_is_the_same() -> None:
    rng = np.random.default_rng(0)
    first, second = (rng.normal(size=(size, 7)) * (rng.random((size, 7)) < 0.3) for size in (5, 3))
    both, heights = joined_rows([sparse_rows(first), sparse_rows(second)]), rng.normal(size=8)
    assert np.array_equal(dense_rows(both), np.vstack([first, second]))
    assert np.allclose(sparse_across(both, heights[:, None])[:, 0], heights @ np.vstack([first, second]), atol=1e-15)


def test_a_curve_moves_and_is_differentiated_as_its_functions_say() -> None:
    chain, rng = Chain.of(ROBOT), np.random.default_rng(1)
    q = ROBOT.random_configurations(60, rng)
    curve = TransmissionError.over("joint_3", q[:, 2], 40)
    model, conditions = Model(chain, (*ELASTIC, curve)), Conditions.at(q)
    assert len(plain_terms([curve], [0], chain, conditions).curves) == 1
    values = np.zeros(model.n_parameters)
    values[-40:] = 1e-3 * rng.normal(size=40)
    # The oracle: a joint that stands where the curve brings it.
    bent = q.copy()
    bent[:, 2] += values[-40:] @ curve.basis(q[:, 2])
    straight = Model(chain, ELASTIC).predict(values[:-40], Conditions.at(bent))
    assert np.allclose(model.predict(values, conditions), straight, atol=1e-14)
    free = np.zeros(len(values), bool)
    free[-40:-10] = True
    _, dense = model.linearise(values, conditions, free=free)
    for chosen in (free, free | (np.arange(len(values)) >= len(values) - 40)):
        _, columns, (shared,) = model.linearise_shared(values, conditions, free=chosen)
        ((places, basis),) = shared.families
        rows = basis if isinstance(basis, np.ndarray) else dense_rows(basis)
        kept = free[places]
        assert np.allclose(rows[kept, :, None] * columns[-1].T, dense.transpose(2, 0, 1), atol=1e-15)


def test_steps_move_readings_along_all_columns() -> None:
    rng = np.random.default_rng(5)
    dense, column = rng.normal(size=(2, 3, 7)), rng.normal(size=(3, 7))
    thin, thick = rng.normal(size=(4, 7)) * (rng.random((4, 7)) < 0.3), rng.normal(size=(2, 7))
    families = SharedColumns(np.arange(1, 5), sparse_rows(thin), column), SharedColumns(np.arange(5, 7), thick, column)
    whole = np.concatenate([dense[:1], thin[:, None] * column, thick[:, None] * column, dense[1:]])
    steps = rng.normal(size=(8, 2))
    found = Jacobian(8, np.array([0, 7]), dense, families).along(steps)
    assert np.allclose(found, np.einsum("fr,fmn->rmn", steps, whole), atol=1e-14)
    few = Jacobian(8, np.array([0, 7]), dense, families).columns(2, slice(1, 3))
    expected = [whole[0], whole[7], whole[1] + whole[2], whole[3] + whole[4], whole[5], whole[6]]
    assert np.allclose(few, np.array(expected)[:, 1:3], atol=1e-14)


def test_products_of_thin_and_dense_columns_are_those_of_the_whole_jacobian() -> None:
    """With several readings, more poses than are worked on at once, and families whose places lie between each other's."""
    rng = np.random.default_rng(6)
    n, dense, columns = 150, rng.normal(size=(3, 4, 150)), rng.normal(size=(3, 4, 150))
    thin, other = (rng.normal(size=(size, n)) * (rng.random((size, n)) < 0.3) for size in (4, 3))
    thick = rng.normal(size=(2, n))
    places = [np.array([1, 5, 3, 10]), np.array([0, 2, 8]), np.array([6, 11])]
    bases = [sparse_rows(thin), sparse_rows(other), thick]
    families = tuple(SharedColumns(at, of, column) for at, of, column in zip(places, bases, columns, strict=True))
    whole = np.empty((12, 4, n))
    whole[[4, 7, 9]] = dense
    for at, rows, column in zip(places, (thin, other, thick), columns, strict=True):
        whole[at] = rows[:, None] * column
    r, weights = rng.normal(size=(4, n)), rng.uniform(0.0, 2.0, n)
    jacobian = Jacobian(12, np.array([4, 7, 9]), dense, families)
    G, g = np.zeros((2, 12, 12)), np.zeros((2, 12))
    some = jacobian.part(slice(1, 4), slice(10, n))
    some.add_grams(r[1:, 10:], np.array([0, 60, 140]), G, g, weights=weights[10:])
    for s, here in enumerate((slice(10, 70), slice(70, n))):
        A, b = ((of[..., 1:, here] * weights[here]).reshape(*of.shape[:-2], -1) for of in (whole, r))
        np.testing.assert_allclose(G[s], A @ A.T, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(g[s], A @ b, rtol=1e-12, atol=1e-12)


def test_products_of_two_sets_of_columns_are_those_of_the_whole_jacobian() -> None:
    """Of a model's columns with candidates', and of candidates' with each other as far as they are asked for."""
    rng = np.random.default_rng(5)

    def drawn(places: list[int], curve: int, *, thin: bool = True) -> Jacobian:
        basis = rng.normal(size=(curve, 40)) * (rng.random((curve, 40)) < 0.3)
        at = np.setdiff1d(np.arange(len(places) + curve), places)
        family = SharedColumns(at, sparse_rows(basis) if thin else basis, rng.normal(size=(3, 40)))
        return Jacobian(len(places) + curve, np.array(places), rng.normal(size=(len(places), 3, 40)), (family,))

    def whole(jacobian: Jacobian) -> np.ndarray:
        return jacobian.along(np.eye(jacobian.size)).reshape(jacobian.size, -1)

    residuals = rng.normal(size=(3, 40))
    for model in (drawn([0, 1, 5], 4), drawn([0, 1, 2], 4, thin=False)):
        for candidates in (drawn([0, 1, 7], 5), drawn([0, 1, 7], 5, thin=False)):
            S = np.ones((7, 8))
            model.add_products(candidates, S)
            np.testing.assert_allclose(S, 1.0 + whole(model) @ whole(candidates).T, rtol=1e-12, atol=1e-12)
            dense, G, g = whole(candidates), np.zeros((8, 8)), np.zeros(8)
            candidates.add_gram(residuals, G, g, np.repeat([0, 1, 2], [2, 4, 2]))
            for own in (slice(0, 2), slice(2, 6), slice(6, 8)):
                np.testing.assert_allclose(G[own, own], dense[own] @ dense[own].T, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(g, dense @ residuals.ravel(), rtol=1e-12, atol=1e-12)


def test_a_part_of_a_table_is_the_same_object_as_long_as_it_is_asked_for() -> None:
    whole = Conditions.at(ROBOT.random_configurations(10, np.random.default_rng(2)))
    rows = slice(2, 5)
    assert part_of(whole, rows, (2, 5)) is part_of(whole, rows, (2, 5))
    assert np.array_equal(part_of(whole, rows, (2, 5)).q, whole.q[rows])
    assert part_of(replace(whole), rows, (2, 5)) is not part_of(whole, rows, (2, 5))


def test_parameters_spent_are_found_without_the_posterior() -> None:
    """Priors counted, and without what is believed beyond them."""
    rng = np.random.default_rng(4)
    J, sizes = rng.normal(size=(9, 30)) * 10.0 ** rng.uniform(-3.0, 2.0, (9, 1)), np.r_[np.inf, np.inf, np.ones(7)]
    known = np.zeros((9, 9))
    known[4:6, 4:6] = [[2.0, -1.0], [-1.0, 1.0]]
    H = J @ J.T + known
    found = Posterior(Form.of(H), sizes, np.zeros(9))
    spent = float(found.frame_rank + np.sum(found.information / (1.0 + found.information)))
    of_data = spent - float(np.sum(found.covariance * known))
    assert found.effective == pytest.approx(spent, rel=1e-9)
    believed = Nonzero.of(known)
    assert Posterior(Form.of(H), sizes, np.zeros(9), believed=believed).effective == pytest.approx(of_data, rel=1e-9)


@pytest.mark.parametrize("is_exact", [False, True])
def test_what_further_parameters_gain_is_the_difference_to_those_before(is_exact: bool) -> None:
    """Of frames without a prior, which are kept, and of others; also where only eigenvectors are free of rounding."""
    rng = np.random.default_rng(7)
    J, r = rng.normal(size=(9, 40)) * 10.0 ** rng.uniform(-2.0, 2.0, (9, 1)), rng.normal(size=40)
    J *= 1e6 if is_exact else 1.0
    sizes = np.r_[np.inf, np.inf, rng.uniform(0.1, 3.0, 7)]
    whole = Posterior(Form.of(J @ J.T, J @ r), sizes, np.r_[0.0, 0.0, rng.normal(size=7)])
    kept = np.arange(9) < 6
    beyond = whole.gains_beyond(kept)

    for more in (~kept, np.arange(9) == 7, np.zeros(9, bool)):
        expected = whole.gain(kept | more) - whole.gain(kept)
        assert beyond(more) == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_what_is_believed_beyond_priors_is_kept_by_its_entries() -> None:
    """The same as of whole matrices, of some parameters or of all, when it is asked for first and again."""
    rng = np.random.default_rng(5)
    spline, root = np.diag([2.0, 4.0, 2.0]), rng.normal(size=(2, 2))
    spline[[0, 1, 1, 2], [1, 0, 2, 1]] = -1.0
    of_fit, sigma = root @ root.T, np.array([0.3, 0.2])
    terms = (
        Earlier(("a", "b"), np.ones(2), of_fit, sigma, np.array([4, 1])),
        Earlier((), np.zeros(3), spline, None, np.array([2, 5, 6])),
    )
    values, sizes = rng.normal(size=8), rng.uniform(1.0, 2.0, 8)
    H, g = np.zeros((8, 8)), np.zeros(8)
    for term, gone in zip(terms, (sizes[[4, 1]] ** -2.0, np.zeros(3)), strict=True):
        H[np.ix_(term.places, term.places)] += term.information - np.diag(gone)
        g[term.places] += term.information @ (term.mean - values[term.places]) + gone * values[term.places]
    beliefs = Beliefs(terms, np.zeros(8, bool), False)

    for kept in ([0, 1, 2, 3, 4, 5, 6, 7], [0, 2, 4, 6], [1, 5, 7], [0, 2, 4, 6]):
        at = np.array(kept)
        found = beliefs.beyond_priors(at, values, sizes)
        np.testing.assert_array_equal(found.H, H[np.ix_(at, at)])
        np.testing.assert_allclose(found.g, g[at], rtol=1e-12, atol=1e-12)
        for entries, expected in zip(beliefs.entries(at, sizes), Nonzero.of(found.H), strict=True):
            np.testing.assert_array_equal(entries, expected)


@pytest.mark.parametrize("blocks", [1, 4])
def test_tests_without_an_effect_follow_from_those_with_it(blocks: int) -> None:
    rng = np.random.default_rng(3)
    q = ROBOT.random_configurations(90, rng)
    bent = q + 1e-3 * np.sin(q) * (np.arange(6) == 3)
    tips = ROBOT.forward_kinematics(bent)
    position = tips[:, :3, 3] + tips[:, :3, :3] @ [0.1, 0.0, 0.2] + 5e-5 * rng.standard_normal((90, 3))
    table = measurements_from_arrays(ROBOT.joint_names, q, position=position)
    gone = GearEccentricity("joint_4")
    fit = calibrate(ROBOT, table, Options(effects=(*GEOMETRIC, gone), sigma=5e-5))
    of, few = fit.solution, fit.solution.free & (np.arange(len(fit.values)) % 5 > 0)
    point, alone = (Linearised(fit.problem, of.values, free, of.weights, fit.fit.priors.sizes) for free in (of.free, few))
    narrow, expected = point.narrowed(few).posterior(of.sigma), alone.posterior(of.sigma)
    scale = expected.metric
    assert np.allclose(narrow.form.H / np.outer(scale, scale), expected.form.H / np.outer(scale, scale), atol=1e-12)
    assert np.allclose(narrow.form.g / scale, expected.form.g / scale, atol=1e-9)
    candidates = [GearEccentricity("joint_3"), GearEccentricity("joint_4", order=2), GearEccentricity("joint_5")]
    groups = np.arange(90) % blocks
    found = score_test(fit.fit, candidates, groups=groups).among([1, 2], fit.fit.names_of([gone]))
    # Evaluated where the effect is zero; a mrad turns what the columns are by as much.
    direct = score_test(without(fit.fit, gone), candidates[1:], groups=groups)
    assert found.names == direct.names and found.effects == direct.effects
    assert found.squares == pytest.approx(direct.squares, rel=3e-3)
    assert found.gains_by_block([0]) == pytest.approx(direct.gains_by_block([0]), rel=0.01, abs=0.5)
    assert found.score([0], 1).gain == pytest.approx(direct.score([0], 1).gain, rel=0.01)


def test_what_a_refit_leaves_of_a_sample_is_never_negative() -> None:
    """Twelve rows, of which the priors of eight parameters pull the values of a fit to many more rows far away."""
    rng = np.random.default_rng(0)
    J = rng.standard_normal((12, 8))
    values = 9.0 * rng.standard_normal(8)
    r = J @ rng.standard_normal(8) + 0.1 * rng.standard_normal(12)
    precision = np.diag(rng.uniform(1.0, 30.0, 8))
    rows = Form.of((J.T @ J)[None], (J.T @ r)[None])
    information = Information(rows, Form.of(precision, -precision @ values))
    tests = SimpleNamespace(model=information, squares=float(r @ r))

    left = ScoreTests.squares_left.fget(tests)

    step = np.linalg.solve(J.T @ J + precision, J.T @ r - precision @ values)
    assert left == pytest.approx(float(np.sum((r - J @ step) ** 2)), rel=1e-10)
    assert tests.squares - information.slope @ information.slope < 0.0 < left


@pytest.mark.parametrize("phi", [None, 0.9], ids=["independent rows", "correlated rows, some columns at once"])
def test_products_of_candidates_with_each_other_are_taken_when_they_are_asked_for(
    phi: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of dense columns, of curves in the model and beside it, of effects that share a coordinate, and of others.

    A candidate that the model takes in keeps them, and moves the rows as before.
    """
    monkeypatch.setattr("pincal.discover.score_tests._MOST_NUMBERS", 30 * 270)
    monkeypatch.setattr("pincal.identify.station._MOST_NUMBERS", 7 * 270)
    monkeypatch.setattr("pincal.discover.score_tests._MOST_COLUMNS", 40)
    monkeypatch.setattr("pincal.discover.score_tests._FEW_COLUMNS", 40)
    rng = np.random.default_rng(6)
    q = ROBOT.random_configurations(90, rng)
    tips = ROBOT.forward_kinematics(q + 1e-3 * np.sin(q))
    position = tips[:, :3, 3] + tips[:, :3, :3] @ [0.1, 0.0, 0.2] + 5e-5 * rng.standard_normal((90, 3))
    own = (TransmissionError.over("joint_3", q[:, 2], 20), GearEccentricity("joint_1"))
    table = measurements_from_arrays(ROBOT.joint_names, q, position=position)
    fit = calibrate(ROBOT, table, Options(effects=(*GEOMETRIC, *own), sigma=5e-5, length_bound=1.0))
    waves = [Unnamed(f"joint_{1 + i}", "drive", "joint_2", "waves", order=order) for order in (1, 2, 3) for i in (0, 2)]
    tilted = Unnamed("joint_4", "s_x", "joint_4", "waves", order=3)
    candidates = [*waves, *(TransmissionError.over(f"joint_{i}", q[:, i - 1], 24) for i in (3, 5)), tilted]
    serial = None if phi is None else Serial(np.full(3, phi), np.full(3, 0.8), np.arange(90.0), np.ones(90, bool))
    weighed = fit.fit.over([replace(fit.fit.station, serial=serial)])
    tests = score_test(weighed, candidates)
    problem, known = extended(weighed.problem, candidates)
    values, free = np.zeros(len(problem.parameters)), np.ones(len(problem.parameters), bool)
    values[known], free[known] = fit.values, fit.solution.free
    ((_, residuals, jacobian),) = problem.stations[0].linearise(values, free)
    if serial is not None:
        residuals, jacobian = serial.innovations(residuals[None])[0], serial.innovations(jacobian)
    A, r = (of.reshape(*of.shape[:-2], -1) / fit.solution.estimated[0] for of in (jacobian, residuals))
    scale = np.sqrt(np.diag(A @ A.T))
    cross = tests.cross
    S = np.block([[tests.model.rows.H, cross], [cross.T, tests.inner]])
    np.testing.assert_allclose(S / np.outer(scale, scale), A @ A.T / np.outer(scale, scale), atol=1e-12)
    np.testing.assert_allclose(np.append(tests.model.rows.g, tests.g) / scale, A @ r / scale, rtol=1e-9, atol=1e-9)
    whole = replace(tests, blocks_inner=tests.inner[None])
    assert sum(of.size for of in tests.blocks_inner) < tests.inner.size
    for which in ([7], [0, 6], [1, 5, 7]):
        assert tests.gain(which) == pytest.approx(whole.gain(which), rel=1e-8)
        np.testing.assert_allclose(
            tests.within(which)[1], tests.within(range(len(candidates)))[1][np.ix_(*[tests.places(which)] * 2)], rtol=1e-6
        )
    others = [[1], [5], [3, 5]]
    for at_once in (tests, whole, replace(tests, unsure=np.arange(len(tests.unsure)) % 5 == 0)):
        each = [at_once.score_given([0, 6], given).p_value for given in others]
        np.testing.assert_allclose(at_once.chances_given_each([0, 6], others), each, rtol=1e-6)
        groups = [2, 3, 4]
        for score, of, n in zip(at_once.scores_given(others, [0, 6], groups), others, groups, strict=True):
            expected = at_once.score_given(of, [0, 6], n)
            assert vars(score) == pytest.approx(vars(expected), rel=1e-6)
    fewer = tests.among([5, 1, 7], weighed.names_of([own[0]]))
    told = whole.among([5, 1, 7], weighed.names_of([own[0]]))
    np.testing.assert_allclose(fewer.inner, told.inner, rtol=1e-9, atol=1e-9)
    n, m = cross.shape
    for i in (1, 6):
        j, others = tests.columns[i], [k for k in range(len(candidates)) if k != i]
        taking, left = _given(tests, i), tests.places(others)
        expected, size = np.vstack([cross, tests.inner[j]])[:, left], np.append(scale[:n], scale[n + j])
        np.testing.assert_allclose(
            taking.cross / np.outer(size, scale[n + left]), expected / np.outer(size, scale[n + left]), atol=1e-12
        )
        steps, own_steps = np.zeros(n + m), np.zeros(n + m)
        steps[n : n + len(j)] = own_steps[n + j] = rng.normal(size=len(j))
        for part, before in zip(taking.parts, tests.parts, strict=True):
            moved = before.moved(own_steps[:, None])
            np.testing.assert_allclose(part.moved(steps[:, None]), moved, rtol=1e-12)
            back = part.among(np.arange(n + m + 1), steps)
            np.testing.assert_allclose(back.residuals, before.residuals + moved[0], rtol=1e-12)


def test_readings_whose_rows_are_independent_are_weighed_beside_correlated_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Positions are independent, orientations drift: products by readings and by rows are those of dense columns.

    So is the slope beside products of other values.
    """
    monkeypatch.setattr("pincal.identify.jacobian._COLUMNS", 7)
    rng = np.random.default_rng(9)
    q = ROBOT.random_configurations(90, rng)
    tips = ROBOT.forward_kinematics(q + 1e-3 * np.sin(q))
    tips[:, :3, 3] += 5e-5 * rng.standard_normal((90, 3))
    turned = Rotation.from_matrix(tips[:, :3, :3]).as_quat()
    own = TransmissionError.over("joint_3", q[:, 2], 20)
    table = measurements_from_arrays(ROBOT.joint_names, q, position=tips[:, :3, 3], quaternion=turned)
    fit = calibrate(
        ROBOT, table, Options(effects=(*GEOMETRIC, own), sigma=5e-5, sigma_orientation=1e-4, length_bound=1.0)
    ).fit
    drift = Serial(np.full(6, 0.99), np.repeat([0.0, 0.8], 3), np.arange(90.0), rng.random(90) < 0.9)
    weighed = fit.over([replace(fit.station, serial=drift)])
    free, sigma = fit.solution.free, np.repeat(fit.solution.estimated, 3)[:, None]
    robust = rng.uniform(0.5, 1.0, 90)
    found = accumulate(weighed.station, fit.values, free, robust)
    ((_, residuals, jacobian),) = weighed.station.linearise(fit.values, free)
    J, r = drift.innovations(jacobian) * robust, drift.innovations(residuals[None])[0] * robust
    for b, rows in enumerate((slice(3), slice(3, 6))):
        scale = np.sqrt(np.maximum(np.diag(found.H[b]), 1e-300))
        expected = np.tensordot(J[:, rows], J[:, rows], axes=((1, 2), (1, 2)))
        np.testing.assert_allclose(found.H[b] / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-12)
        np.testing.assert_allclose(found.g[b] / scale, np.tensordot(J[:, rows], r[rows]) / scale, rtol=1e-9, atol=1e-15)

    there = accumulate(weighed.station, 1.1 * fit.values, free, np.ones(90))
    known = near(weighed.station, np.array([0, 90]), fit.values, free, robust, there)
    np.testing.assert_array_equal(known.H, there.H)
    np.testing.assert_allclose(known.g, found.g, rtol=1e-9, atol=1e-9 * np.abs(found.g).max())
    np.testing.assert_allclose(known.squares.blocks, found.squares.blocks, rtol=1e-12)

    order, ends = np.argsort(np.arange(90) % 3, kind="stable"), np.array([0, 30, 60, 90])
    noise, parts = fit.solution.estimated, weighed.station.select(order)
    form, _ = accumulate_at(parts, ends, fit.values, free, robust[order], np.tile(noise, (3, 1)))
    expected = found.at(noise)
    scale = np.sqrt(np.diag(expected.H))
    np.testing.assert_allclose(form.H.sum(axis=0) / np.outer(scale, scale), expected.H / np.outer(scale, scale), atol=1e-12)
    np.testing.assert_allclose(form.g.sum(axis=0) / scale, expected.g / scale, rtol=1e-9, atol=1e-9)
    whole, _ = accumulate_at(weighed.station, np.array([0, 90]), fit.values, free, robust, noise[None])
    np.testing.assert_allclose(whole.H[0] / np.outer(scale, scale), expected.H / np.outer(scale, scale), atol=1e-12)
    np.testing.assert_allclose(whole.g[0] / scale, expected.g / scale, rtol=1e-9, atol=1e-9)

    candidates = [TransmissionError.over("joint_5", q[:, 4], 24), GearEccentricity("joint_1")]
    tests = score_test(weighed, candidates, groups=np.arange(90) % 4)
    problem, known = extended(weighed.problem, candidates)
    values, every = np.zeros(len(problem.parameters)), np.ones(len(problem.parameters), bool)
    values[known], every[known] = fit.values, free
    ((_, _, jacobian),) = problem.stations[0].linearise(values, every)
    A = drift.innovations(jacobian) / sigma
    for k in range(4):
        part = A[:, :, np.arange(90) % 4 == k].reshape(len(A), -1)
        scale = np.linalg.norm(A, axis=(1, 2))
        n = len(tests.names)
        got = np.block(
            [[tests.model.blocks.H[k], tests.blocks_cross[k]], [tests.blocks_cross[k].T, np.asarray(tests.blocks_inner[k])]]
        )
        assert n + len(tests.g) == len(A)
        np.testing.assert_allclose(got / np.outer(scale, scale), part @ part.T / np.outer(scale, scale), atol=1e-12)


def test_what_a_search_no_longer_needs_is_freed_at_once() -> None:
    """Tests and fits hold the columns of all rows: none refers to itself, or a search would keep those of its past steps."""
    q = ROBOT.random_configurations(60, np.random.default_rng(7))
    position = ROBOT.forward_kinematics(q)[:, :3, 3] + 5e-5 * np.random.default_rng(8).standard_normal((60, 3))
    table = measurements_from_arrays(ROBOT.joint_names, q, position=position)
    fit = replace(calibrate(ROBOT, table, Options(effects=GEOMETRIC, sigma=5e-5)).fit)
    tests = score_test(fit, [GearEccentricity("joint_1"), GearEccentricity("joint_2")], groups=np.arange(60) % 4)
    assert fit.alone == (fit,) and len(tests.gains_by_block([0])) == 4 and tests.score([0, 1], 1).gain >= 0.0
    kept = [weakref.ref(of) for of in (tests, fit)]
    gc.disable()
    try:
        del tests, fit
        assert [ref() for ref in kept] == [None, None]
    finally:
        gc.enable()


def test_little_is_kept_of_models_without_an_effect(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of many such models, and of their fits without each block, the latest are kept: what follows stays the same."""
    monkeypatch.setattr("pincal.discover.products._MOST_NUMBERS", 0)
    rng = np.random.default_rng(1)
    q = ROBOT.random_configurations(90, rng)
    tips = ROBOT.forward_kinematics(q + 1e-4 * np.sin(q))
    position = tips[:, :3, 3] + tips[:, :3, :3] @ [0.1, 0.0, 0.2] + 5e-5 * rng.standard_normal((90, 3))
    own = GearEccentricity("joint_1"), GearEccentricity("joint_2")
    table = measurements_from_arrays(ROBOT.joint_names, q, position=position)
    fit = calibrate(ROBOT, table, Options(effects=(*GEOMETRIC, *own), sigma=5e-5)).fit
    tests = score_test(fit, [GearEccentricity("joint_3")], np.arange(90) % 5)
    gains = [[tests.among([0], fit.names_of([of])).gains_by_block([0]) for of in own] for _ in range(2)]

    np.testing.assert_array_equal(*gains)
    assert len(tests.model.parts) == 1
    assert np.any(gains[0][0] != gains[0][1])


def test_poses_that_nothing_uses_leave_the_memory_at_once():
    """They do not wait for the collector of cycles: a fit makes them for every pass over its rows."""
    at = Conditions.at(np.zeros((5, 6)))
    assert at.at_moments is at
    known = weakref.ref(at)
    gc.disable()
    try:
        del at
        assert known() is None
    finally:
        gc.enable()
