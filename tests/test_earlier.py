"""What an earlier fit found stands for its rows: fitted beside new ones, it gives what all rows together would."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from machines import kuka as true_kuka
from test_stations import NOISE, tracked

from pincal import ELASTIC, GEOMETRIC, FittedRobot, Options, Robot, calibrate, calibrate_parts, load_model
from pincal import simulate as sim
from pincal.discover.score_tests import score_test
from pincal.errors import BadInputError, MeasurementError
from pincal.identify.believed import Earlier
from pincal.identify.calibrate import fit_tables
from pincal.identify.equations import Linearised
from pincal.identify.posterior import Posterior
from pincal.identify.problem import Problem, extended
from pincal.identify.station import Station
from pincal.measure.table import concatenate, read_measurements, row_parts, write_table
from pincal.model.catalogue import GearEccentricity
from pincal.parameters import Estimate


@pytest.fixture(scope="module")
def machine() -> sim.TrueMachine:
    """Return a machine whose lengths are off by half a millimetre and angles by half a milliradian."""
    return true_kuka().draw_errors(np.random.default_rng(9), sigma_length=5e-4, sigma_angle=5e-4)


@pytest.fixture(scope="module")
def both(machine: sim.TrueMachine, kuka: Robot) -> FittedRobot:
    """Return the joint fit of an old and a new station."""
    tables = {"old": tracked(machine, kuka, 0, poses=80), "new": tracked(machine, kuka, 1, poses=12)}
    return calibrate(kuka, tables, Options(effects=ELASTIC, sigma=NOISE, loss="none"))


def joint_places(both: FittedRobot, station: Station) -> np.ndarray:
    """Return where the parameters of one of the stations stand among those of the joint fit, shape (P,)."""
    named = zip(station.parameters, station.is_own, strict=True)
    return both.estimate.places(p.at(station.name).name if own else p.name for p, own in named)


def posterior_alone(both: FittedRobot, station: Station, earlier: Earlier | None = None) -> Posterior:
    """Return the posterior of one station about the values of the joint fit, under its priors."""
    places = joint_places(both, station)
    at, free, sizes = both.values[places], both.solution.free[places], both.fit.priors.sizes[places]
    problem = Problem((station,), earlier)
    return Linearised(problem, at, free, np.ones(len(station)), sizes).posterior(np.full(1, NOISE))


def old_alone(both: FittedRobot) -> Estimate:
    """Return what the old station by itself says of the robot's parameters, to first order about the joint fit."""
    station = both.problem.stations[0]
    places, posterior = joint_places(both, station), posterior_alone(both, station)
    values, free, sizes = both.values[places], both.solution.free[places], both.fit.priors.sizes[places]
    values[free] += posterior.step_within(np.full(len(posterior.form.g), np.inf))[0]
    found = Estimate(station.parameters, values, free, posterior.joint_covariance, sizes)
    return found.take(p.name for p, own in zip(station.parameters, station.is_own, strict=True) if not own)


def test_of_a_linear_model_it_gives_the_joint_fit(both: FittedRobot) -> None:
    """Step and covariance of the robot's parameters, down to directions that only the priors know."""
    new = both.problem.stations[1]
    ones = np.ones(len(both.problem))
    point = Linearised(both.problem, both.values, both.solution.free, ones, both.fit.priors.sizes)
    joint = point.posterior(np.full(2, NOISE))
    alone = posterior_alone(both, new, Earlier.of(old_alone(both)))
    robots = both.problem.is_shared[both.solution.free]
    mine = ~new.is_own[both.solution.free[joint_places(both, new)]]
    step, expected = (each.step_within(np.full(len(each.is_shared), np.inf))[0] for each in (alone, joint))
    sigma = np.sqrt(np.diag(joint.covariance))
    np.testing.assert_allclose(step[mine] / sigma, expected[robots] / sigma, rtol=0.0, atol=1e-6)
    covariances = alone.covariance[np.ix_(mine, mine)], joint.covariance
    np.testing.assert_allclose(*(C / np.outer(sigma, sigma) for C in covariances), rtol=0.0, atol=1e-6)
    # Parameters that the new rows pay for: the trace of their information times the covariance.
    places = joint_places(both, new)
    ((_, _, J),) = new.linearise(both.values[places], np.ones(len(places), bool))
    whole = replace(both.estimate, covariance=joint.joint_covariance).dense_covariance()[np.ix_(places, places)]
    assert alone.effective == pytest.approx(np.einsum("pmn,pq,qmn->", J, whole, J) / NOISE**2, rel=1e-4)


def test_score_tests_beside_it_are_those_of_all_rows(both: FittedRobot) -> None:
    """To first order, if the old rows have nothing to say of the candidate: what they know of the robot is projected out."""
    candidates = [GearEccentricity(joint) for joint in both.problem.stations[0].model.chain.robot.joint_names]
    new = both.problem.stations[1]
    places = joint_places(both, new)
    problem = Problem((new,), Earlier.of(old_alone(both)))
    solution = replace(
        both.solution,
        values=both.values[places],
        free=both.solution.free[places],
        sigma=np.full(1, NOISE),
        estimated=np.full(1, NOISE),
        weights=np.ones(len(new)),
    )
    priors = replace(both.fit.priors, sizes=both.fit.priors.sizes[places], bounds=both.fit.priors.bounds[places])
    found = score_test(
        replace(both.fit, problem=problem, solution=solution, priors=priors), candidates, np.arange(len(new)) % 4
    )
    # The same by dense matrices: what was known before stands below the rows of the new station.
    wide, known = extended(problem, candidates)
    values = np.zeros(len(wide.parameters))
    values[known] = solution.values
    ((_, r, J),) = wide.stations[0].linearise(values, np.ones(len(values), bool))
    (old,) = wide.beliefs.terms
    places = old.places
    root = np.linalg.cholesky(old.information).T
    further = np.zeros((len(places), len(values)))
    further[:, places] = root
    A = np.vstack([J.reshape(len(values), -1).T / NOISE, further])
    b = np.concatenate([r.ravel() / NOISE, root @ (old.mean - values[places])])

    def left(columns: np.ndarray) -> float:
        scaled = A[:, columns] / np.linalg.norm(A[:, columns], axis=0)
        return float(np.sum((b - scaled @ np.linalg.lstsq(scaled, b, rcond=None)[0]) ** 2))

    free = known[solution.free]
    for k in range(len(candidates)):
        with_it = np.append(free, wide.places_at(wide.effects[len(problem.effects) + k]))
        assert found.gain([k])[0] == pytest.approx(left(free) - left(with_it), rel=1e-6)


@pytest.mark.parametrize(
    ("poses", "count"), [(5, 2), (60, 1), *(pytest.param(*case, marks=pytest.mark.long) for case in ((5, 1), (60, 2)))]
)
def test_a_model_file_and_new_rows_equal_all_rows(
    count: int, poses: int, machine: sim.TrueMachine, kuka: Robot, tmp_path: Path
) -> None:
    """Well below a tenth of the standard deviation, also of noise that is estimated; one old station or several."""
    tables = {f"old_{s}": tracked(machine, kuka, s, poses=60) for s in range(count)}
    new = tracked(machine, kuka, 1, poses=max(poses, 8), seed=5, outlier=5e-3).select(np.arange(poses))
    options = Options(effects=GEOMETRIC, sigma=NOISE if poses == 5 else None)
    calibrate(kuka, tables, options).save(tmp_path / "model.json")
    old = load_model(tmp_path / "model.json").robot_estimate
    fit = calibrate(kuka, new, replace(options, earlier=old))
    joint = calibrate(kuka, tables | {"new": new}, options)
    found, expected = (each.estimate.take(old.names) for each in (fit, joint))
    free = expected.free
    assert fit.solution.converged
    np.testing.assert_array_equal(found.free, free)
    np.testing.assert_array_less(np.abs(found.values - expected.values)[free], 0.05 * expected.sigma[free])
    np.testing.assert_allclose(found.sigma[free], expected.sigma[free], rtol=0.02)
    np.testing.assert_allclose(fit.solution.sigma, joint.solution.sigma[-1:], rtol=0.03)
    if poses > 5:
        assert np.flatnonzero(fit.solution.weights == 0.0).tolist() == [7]
        assert np.any(np.abs(old.values - expected.values)[free] > expected.sigma[free])


def test_what_the_new_model_leaves_out_is_zero(both: FittedRobot) -> None:
    """As in a joint fit without these parameters; the distribution of the others is that given them."""
    old = Earlier.of(old_alone(both))
    gone = np.array([name.endswith((".k_x", ".k_y", ".k_z")) for name in old.names])
    C = np.linalg.inv(old.information)
    gain = C[np.ix_(~gone, gone)] @ np.linalg.inv(C[np.ix_(gone, gone)])
    given = old.given_zero(gone)
    np.testing.assert_allclose(given.mean / given.sigma, (old.mean[~gone] - gain @ old.mean[gone]) / given.sigma, atol=1e-6)
    covariance = C[np.ix_(~gone, ~gone)] - gain @ C[np.ix_(gone, ~gone)]
    np.testing.assert_allclose(given.sigma, np.sqrt(np.diag(covariance)), rtol=1e-6)
    assert old.given_zero(np.zeros(len(old.names), bool)) is old


def test_it_is_of_the_robot_alone(both: FittedRobot) -> None:
    """Where an instrument stood says nothing of where it stands."""
    with pytest.raises(BadInputError, match=r"old/base\.x belongs to a station"):
        Earlier.of(both.estimate)
    assert not any(p.station or p.is_extrinsic for p in both.robot_estimate.parameters)


def test_too_few_rows_are_refused(machine: sim.TrueMachine, kuka: Robot, both: FittedRobot) -> None:
    """Four poses place the instrument and the target and tell next to nothing of the noise."""
    few = tracked(machine, kuka, 1, poses=8).select(np.arange(4))
    with pytest.raises(MeasurementError, match="the noise can't be estimated"):
        fit_tables(kuka, few, Options(effects=ELASTIC, earlier=both.robot_estimate))


@pytest.mark.long
def test_parts_give_what_all_rows_do(tmp_path: Path, machine: sim.TrueMachine, kuka: Robot) -> None:
    """A Parquet file read and fitted in three parts: the rows are those of the file, the robot that of a joint fit."""
    table = tracked(machine, kuka, 0, poses=400)
    columns = dict(zip((*kuka.joint_names, *"xyz"), (*table.q.T, *table.readings["position"].T), strict=True))
    write_table(tmp_path / "rows.parquet", columns)
    parts = [
        read_measurements(tmp_path / "rows.parquet", kuka.joint_names, part=part)
        for part in row_parts(tmp_path / "rows.parquet", 150)
    ]
    joined, options = concatenate(parts), Options(effects=GEOMETRIC, sigma=NOISE)
    alone, whole = (
        of.robot_estimate for of in (calibrate_parts(kuka, iter(parts), options), calibrate(kuka, joined, options))
    )

    assert [len(part) for part in parts] == [133, 134, 133]
    np.testing.assert_array_equal(joined.rows, np.arange(2, 402))
    np.testing.assert_array_equal(joined.q, table.q)
    assert alone.names == whole.names
    assert np.abs((alone.values - whole.values) / whole.sigma).max() < 0.2
    np.testing.assert_allclose(alone.sigma, whole.sigma, rtol=0.05)


def test_no_parts_are_refused(tmp_path: Path, kuka: Robot) -> None:
    """Nor can a text be read in parts."""
    (tmp_path / "rows.csv").write_text("x,y,z\n1,2,3\n")
    with pytest.raises(BadInputError, match="no rows to calibrate with"):
        calibrate_parts(kuka, ())
    with pytest.raises(MeasurementError, match=r"rows.csv: only a Parquet file is read in parts"):
        read_measurements(tmp_path / "rows.csv", kuka.joint_names, part=range(1))
