"""Several stations in one fit: the sum of their normal equations, whatever is eliminated, in whatever order, wherever."""

import pickle
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from placed_arms import transform

from pincal import simulate as sim
from pincal.calibration.fitted_robot import FittedRobot, load_model
from pincal.calibration.result_tables import parameter_rows
from pincal.discover.score_tests import ScoreTests, score_test
from pincal.errors import BadInputError
from pincal.identify import equations
from pincal.identify.calibrate import fit_tables
from pincal.identify.equations import Linearised
from pincal.identify.explain import Status, explain
from pincal.identify.fit import ModelFit
from pincal.identify.initial import place
from pincal.identify.jacobian import Jacobian
from pincal.identify.normal import Batch
from pincal.identify.options import Options, StationOptions
from pincal.identify.posterior import Posterior, eliminate
from pincal.identify.problem import Problem
from pincal.identify.quadratic import Form
from pincal.identify.solve import Course, solve
from pincal.identify.split import bootstrap, bootstrap_stations
from pincal.measure.measurements import Measurements, concatenate, measurements_from_arrays
from pincal.measure.table import stations_of
from pincal.model.at_station import AtStation
from pincal.model.catalogue import Backlash, BaseDrift, GearEccentricity, ThermalExpansion
from pincal.model.effect import Effect
from pincal.model.effects import GEOMETRIC, JointElasticity
from pincal.robot.robot import Robot
from pincal.sensors.lens import Lens
from pincal.sensors.setup import Setup

NOISE = 5e-5
LENS = Lens(2000.0, 2010.0, 1024.0, 768.0, -0.1, 0.05, 1e-3, -5e-4)
GRID = {f"p{i}": (0.04 * (i % 4), 0.05 * (i // 4), 0.0) for i in range(12)}


BASES = (transform((0.1, -0.2, 1.0), (2.0, 0.5, -0.3)), transform((0.0, 0.1, -2.0), (-1.0, 3.0, 0.2)))
TOOLS = ((0.05, 0.03, 0.12), (-0.08, 0.02, 0.2))


def tracked(
    machine: sim.TrueMachine,
    robot: Robot,
    station: int,
    *,
    poses: int = 80,
    noise: float = NOISE,
    seed: int = 0,
    outlier: float = 0.0,
) -> Measurements:
    """Return positions of a reflector, read by a tracker that stands somewhere else at each station; row 7 is off."""
    rng = np.random.default_rng([seed, station])
    q = robot.random_configurations(poses, rng)
    tip = BASES[station] @ machine.equilibrium(machine.poses(q)).tip
    position = tip[:, :3, :3] @ TOOLS[station] + tip[:, :3, 3] + rng.normal(size=(poses, 3)) * noise
    position[7] += outlier
    return measurements_from_arrays(robot.joint_names, q, position=position, time=np.linspace(0.0, 3600.0, poses))


def seen(machine: sim.TrueMachine, robot: Robot, *, poses: int = 25, pixels: bool, noise: float) -> Measurements:
    """Return what a camera at the flange reads of a grid of points."""
    rng = np.random.default_rng(13)
    mount, place = transform((0.3, -0.4, 2.0), (0.05, 0.1, 0.15)), transform((0.1, 0.2, 0.3), (1.5, 0.3, 0.5))
    points = np.array([*GRID.values()]) @ place[:3, :3].T + place[:3, 3]
    view = sim.View(camera_pose=mount, look_at=points.mean(axis=0), facing=place[:3, 2], distance=(0.3, 0.7))
    q = sim.plan_views(machine.nominal, poses, rng=rng, view=view)
    camera = machine.equilibrium(machine.poses(q)).tip @ mount
    found = np.einsum("nab,nka->nkb", camera[:, :3, :3], points - camera[:, None, :3, 3]).reshape(-1, 3)
    reading = LENS.project(found) if pixels else found
    reading = reading + rng.normal(0.0, noise, reading.shape)
    columns = {"pixel" if pixels else "camera_point": reading, "point": np.tile(list(GRID), poses)}
    return measurements_from_arrays(robot.joint_names, np.repeat(q, len(GRID), axis=0), **columns)


@pytest.fixture(scope="module")
def two(machine: sim.TrueMachine, kuka: Robot) -> ModelFit:
    """Return a fit of two stations; each base drifts by itself, which has a prior."""
    tables = {"east": tracked(machine, kuka, 0, poses=50), "west": tracked(machine, kuka, 1, poses=70)}
    options = Options(effects=(*GEOMETRIC, JointElasticity(), BaseDrift(1800.0)), sigma=NOISE, loss="none")
    return fit_tables(kuka, tables, options)


@dataclass(frozen=True)
class Stacked:
    """All readings of a fit in one dense Jacobian, whitened, priors as further rows: the oracle."""

    J: np.ndarray
    r: np.ndarray
    readings: int

    @classmethod
    def at(cls, fit: ModelFit, values: np.ndarray) -> "Stacked":
        """Linearise at some values; each station's parameters are found by their names."""
        free, names = fit.solution.free, [p.name for p in fit.problem.parameters]
        rows, residuals = [], []
        for station in fit.problem.stations:
            full = [f"{station.name}/{p.name}" for p in station.parameters]
            places = [names.index(a if a in names else p.name) for a, p in zip(full, station.parameters, strict=True)]
            (_, r, J), *more = station.linearise(values[places], np.ones(len(places), bool))
            assert not more
            wide = np.zeros((r.size, len(names)))
            wide[:, places] = J.reshape(len(places), -1).T
            rows.append(wide / NOISE)
            residuals.append(r.ravel() / NOISE)
        readings = sum(len(r) for r in residuals)
        rows.append(np.diag(1.0 / fit.priors.sizes))
        residuals.append(-values / fit.priors.sizes)
        return cls(np.vstack(rows)[:, free], np.concatenate(residuals), readings)

    @property
    def step(self) -> np.ndarray:
        """The step that least squares wants."""
        scale = np.linalg.norm(self.J, axis=0)
        return np.linalg.lstsq(self.J / scale, self.r, rcond=None)[0] / scale

    @property
    def covariance(self) -> np.ndarray:
        """The inverse of the whole information."""
        scale = np.linalg.norm(self.J, axis=0)
        _, R = np.linalg.qr(self.J / scale)
        inverse = np.linalg.inv(R)
        return inverse @ inverse.T / np.outer(scale, scale)


def converged(fit: ModelFit) -> np.ndarray:
    """Return the values of a fit after some more steps: one ends where steps are below a thousandth of the noise."""
    values = fit.values
    for _ in range(4):
        values = solve(fit.problem, values, fit.solution.free, fit.priors, fit.noise, Course("none")).values
    return values


def robots_own(fit: ModelFit) -> np.ndarray:
    """Return which parameters are the robot's."""
    return np.array([not p.station for p in fit.problem.parameters])


def test_a_problem_finds_its_effects_where_it_is_sent(two: ModelFit) -> None:
    """Also one that was asked before: what it knew by the identity of its effects stays behind."""
    places = [two.problem.places_at(effect) for effect in two.problem.effects]
    there = pickle.loads(pickle.dumps(two.problem))

    assert any(len(at) for at in places)
    for effect, at in zip(there.effects, places, strict=True):
        np.testing.assert_array_equal(there.places_at(effect), at)


def test_two_stations_equal_one_dense_least_squares_fit(two: ModelFit) -> None:
    """The robot's parameters, and the stations' own, come out as if all readings stood in one large matrix."""
    values = np.zeros(len(two.values))
    values[~robots_own(two)] = two.nominal.values[~robots_own(two)]
    for _ in range(12):
        values[two.solution.free] += Stacked.at(two, values).step
    assert two.solution.converged
    np.testing.assert_allclose(converged(two) / two.estimate.sigma, values / two.estimate.sigma, rtol=0.0, atol=1e-9)


def test_steps_and_covariance_equal_those_of_the_dense_matrix(two: ModelFit) -> None:
    """Elimination is exact: at any point, for parameters with and without priors."""
    free = two.solution.free
    there = two.values + np.where(free, two.estimate.sigma, 0.0)
    dense = Stacked.at(two, there)
    point = Linearised(two.problem, there, free, np.ones(len(two.problem)), two.priors.sizes)
    found = point.posterior(np.full(2, NOISE))
    step, held = found.step_within(np.full(int(free.sum()), np.inf))
    sigma = np.sqrt(np.diag(dense.covariance))
    assert not held.any()
    # Normal equations square the condition number of the dense matrix.
    np.testing.assert_allclose(step / sigma, dense.step / sigma, rtol=0.0, atol=1e-8)
    covariance = found.joint_covariance.dense()
    np.testing.assert_allclose(covariance / np.outer(sigma, sigma), dense.covariance / np.outer(sigma, sigma), atol=1e-6)


def test_other_weights_of_one_station_give_the_sum_of_all(two: ModelFit) -> None:
    """Reweighted equations are those computed afresh, also where a row is left out altogether and let in again."""
    free, sigma = two.solution.free, np.full(2, NOISE)
    ones = np.ones(len(two.problem))
    point = Linearised(two.problem, two.values, free, ones, two.priors.sizes)
    point.posterior(sigma)
    fewer = ones.copy()
    fewer[[3, 17]] = 0.0, 0.5
    for robust in (fewer, ones):
        point = point.reweighted(robust)
        found = point.posterior(sigma)
        fresh_point = Linearised(two.problem, two.values, free, robust, two.priors.sizes)
        fresh = fresh_point.posterior(sigma)
        # What the stations' own parameters take up altogether is left to rounding, which scales with what it was before.
        reduced, before = np.diag(fresh.form.H), fresh.whole[two.problem.is_shared[free]]
        scale = np.sqrt(np.where(reduced > 0.0, reduced, before))
        np.testing.assert_allclose(found.form.H / np.outer(scale, scale), fresh.form.H / np.outer(scale, scale), atol=1e-12)
        np.testing.assert_allclose(found.form.g / scale, fresh.form.g / scale, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found.whole, fresh.whole, rtol=1e-12)
        np.testing.assert_allclose(point.squares, fresh_point.squares, rtol=1e-12)
        for part, other in zip(found.own, fresh.own, strict=True):
            np.testing.assert_allclose(part.alone.form.H, other.alone.form.H, rtol=1e-12)


def test_length_and_objective_are_those_of_all_readings(two: ModelFit) -> None:
    """A step's length is measured by the readings alone, the objective by priors, too."""
    free = two.solution.free
    dense = Stacked.at(two, two.values)
    point = Linearised(two.problem, two.values, free, np.ones(len(two.problem)), two.priors.sizes)
    sigma = np.full(2, NOISE)
    step = np.random.default_rng(2).normal(size=int(free.sum())) * 1e-5
    along = dense.J[: dense.readings] @ step
    assert point.posterior(sigma).square(step) == pytest.approx(along @ along, rel=1e-6)
    assert point.objective(sigma) == pytest.approx(dense.r @ dense.r, rel=1e-12)
    assert point.chi2(sigma) == pytest.approx(dense.r[: dense.readings] @ dense.r[: dense.readings], rel=1e-12)


def random_equations(rng: np.random.Generator) -> tuple[Form, np.ndarray, np.ndarray]:
    """Return H and g, prior sizes and offsets of 9 parameters, of which 3 have no prior."""
    J = rng.normal(size=(40, 9))
    sizes = rng.uniform(0.2, 2.0, 9)
    sizes[[1, 4, 7]] = np.inf
    return Form.of(J.T @ J, J.T @ rng.normal(size=40)), sizes, np.where(np.isfinite(sizes), rng.normal(size=9), 0.0)


@pytest.mark.parametrize("own", [[1, 4, 7], [0, 1, 2], [8], [3, 4, 5, 6]])
def test_elimination_leaves_the_posterior_as_it_is(own: list[int], rng: np.random.Generator) -> None:
    """Step, covariance, rank and parameters spent are the same whatever is eliminated first, to rounding."""
    form, sizes, offsets = random_equations(rng)
    is_own = np.isin(np.arange(9), own)
    whole: Posterior = Posterior(form, sizes, offsets)
    left, part = eliminate(form, is_own, sizes, offsets)
    rest = replace(
        Posterior(left, sizes[~is_own], offsets[~is_own]),
        own=(part,),
    )
    np.testing.assert_allclose(rest.joint_covariance.dense(), whole.covariance, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(rest.step, whole.step[~is_own], rtol=1e-9)
    np.testing.assert_allclose(rest.own[0].step(rest.step), whole.step[is_own], rtol=1e-9)
    assert (rest.visible_rank, rest.effective) == (whole.visible_rank, pytest.approx(whole.effective, rel=1e-10))
    # Parameters spent need no eigenvectors where all without a prior are eliminated; these are not kept then.
    again = replace(rest)
    assert again.spent == (pytest.approx(rest.spent[0], rel=1e-10), pytest.approx(rest.spent[1], rel=1e-10))
    assert ("_solved" in vars(again)) == (own != [1, 4, 7])


def test_what_nothing_determines_stays_loose_when_it_is_eliminated(rng: np.random.Generator) -> None:
    """A station's frame that no reading sees has a wide variance, and pulls at nothing else."""
    form, sizes, offsets = random_equations(rng)
    form.H[4], form.H[:, 4], form.g[4] = 0.0, 0.0, 0.0
    is_own = np.isin(np.arange(9), [1, 4])
    whole, (left, part) = Posterior(form, sizes, offsets), eliminate(form, is_own, sizes, offsets)
    np.testing.assert_allclose(part.alone.covariance[1, 1], 1.0, rtol=1e-12)
    np.testing.assert_allclose(
        Posterior(left, sizes[~is_own], offsets[~is_own]).covariance,
        whole.covariance[np.ix_(~is_own, ~is_own)],
        rtol=1e-9,
    )
    assert part.alone.visible_rank == 1


def test_names_tell_stations_apart(two: ModelFit) -> None:
    """The robot's parameters have plain names; each station's have its name before them."""
    names = two.estimate.names
    assert names[0] == "joint_1.theta" and len(set(names)) == len(names)
    assert [n for n in names if n.endswith("base.x")] == ["east/base.x", "west/base.x"]
    assert [n for n in names if n.endswith("base.x_t")] == ["east/base.x_t", "west/base.x_t"]
    east = two.estimate.take(n for n in names if not n.startswith("west"))
    whole = two.estimate.dense_covariance()
    kept = [i for i, n in enumerate(names) if not n.startswith("west")]
    scale = np.where(two.estimate.free, two.estimate.sigma, 1.0)[kept]
    expected = whole[np.ix_(kept, kept)] / np.outer(scale, scale)
    np.testing.assert_allclose(east.dense_covariance() / np.outer(scale, scale), expected, atol=1e-12)


def test_the_order_of_stations_means_nothing(machine: sim.TrueMachine, kuka: Robot) -> None:
    """To rounding: sums are added in another order."""
    tables = {"a": tracked(machine, kuka, 0, poses=40), "b": tracked(machine, kuka, 1, poses=50)}
    options = Options(effects=GEOMETRIC, sigma=NOISE)
    first, second = (fit_tables(kuka, dict(order), options) for order in (tables.items(), reversed(tables.items())))
    other = second.estimate.take(first.estimate.names)
    np.testing.assert_allclose(first.values, other.values, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(first.estimate.sigma, other.sigma, rtol=1e-8)


def halves(machine: sim.TrueMachine, robot: Robot) -> tuple[Measurements, list[Measurements], Options]:
    """Return a table, the same in two parts, and options with frames and noise known, so that both mean the same."""
    table = tracked(machine, robot, 0, poses=90)
    first = np.arange(90) < 30
    options = Options(
        effects=(*GEOMETRIC, JointElasticity()), base=BASES[0], tools={"tool": TOOLS[0]}, sigma=1e-3, loss="none"
    )
    return table, [table.select(first), table.select(~first)], options


def test_a_table_in_two_parts_is_the_same_table(machine: sim.TrueMachine, kuka: Robot) -> None:
    """With base and tool given, two stations with half the rows each are one station with all of them."""
    table, parts, options = halves(machine, kuka)
    whole, split = fit_tables(kuka, table, options), fit_tables(kuka, parts, options)
    same = split.estimate.take(p.name for p in whole.problem.parameters if p.effect not in ("base_frame", "tool_frame"))
    expected = whole.estimate.take(same.names)
    np.testing.assert_allclose(same.values, expected.values, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(same.sigma, expected.sigma, rtol=1e-9)


def _score_tests(fit: ModelFit, candidates: list[Effect], groups: np.ndarray) -> ScoreTests:
    """Test candidates by one noise for all stations."""
    estimated = np.full(len(fit.problem.stations), 3e-4)
    return score_test(replace(fit, solution=replace(fit.solution, estimated=estimated)), candidates, groups)


def test_score_tests_of_a_table_in_two_parts_are_the_same(machine: sim.TrueMachine, kuka: Robot) -> None:
    """Gram matrices are sums over stations; an effect of the robot has one column for all of them."""
    table, parts, options = halves(machine, kuka)
    candidates = [GearEccentricity(name) for name in kuka.joint_names]
    groups = np.arange(90) % 4
    one, two = (_score_tests(fit_tables(kuka, tables, options), candidates, groups) for tables in (table, parts))
    for k in range(len(candidates)):
        assert one.gain([k]) == pytest.approx(two.gain([k]), rel=1e-9)
        assert one.gains_by_block([k]) == pytest.approx(two.gains_by_block([k]), rel=1e-8)


def test_one_table_by_a_name_needs_no_name(machine: sim.TrueMachine, kuka: Robot) -> None:
    """A mapping, or a list, of one table is that table, its station's options included."""
    table = tracked(machine, kuka, 0, poses=40)
    plain = fit_tables(kuka, table, Options(effects=GEOMETRIC, sigma=NOISE))
    named = fit_tables(kuka, {"x": table}, Options(effects=GEOMETRIC, stations={"x": StationOptions(sigma=NOISE)}))
    listed = fit_tables(kuka, [table], Options(effects=GEOMETRIC, sigma=NOISE))
    for other in (named, listed):
        assert other.estimate.names == plain.estimate.names
        np.testing.assert_array_equal(other.values, plain.values)


@pytest.mark.long
@pytest.mark.parametrize("pixels", [False, True])
def test_tracker_and_camera_know_more_together(pixels: bool, machine: sim.TrueMachine, kuka: Robot) -> None:
    """A tracker table and a camera table of one arm in one fit predict better than either, and know how well."""
    noise = 0.1 if pixels else 5e-5
    tables = {
        "tracker": tracked(machine, kuka, 0, poses=30),
        "camera": seen(machine, kuka, pixels=pixels, noise=noise),
    }
    own = StationOptions(sigma=noise, setup=Setup(points=GRID, lens=LENS if pixels else None))
    options = Options(effects=GEOMETRIC, sigma=NOISE, stations={"camera": own})
    both = fit_tables(kuka, tables, options)
    alone = {name: fit_tables(kuka, table, replace(options.at(name), stations={})) for name, table in tables.items()}
    assert both.solution.converged and 0.8 < both.solution.cost < 1.2
    shared = [p.name for p in both.problem.parameters if not p.station]
    for fit in alone.values():
        told = fit.estimate.take(shared)
        assert np.all(both.estimate.take(shared).sigma <= told.sigma * (1.0 + 1e-4))
    # The tracker's poses, many more of them and without noise, in the frames that each fit found for the tracker.
    far = tracked(machine, kuka, 0, poses=400, noise=0.0, seed=5)
    station = both.problem.stations[0]
    names = [p.at("tracker").name if own else p.name for p, own in zip(station.parameters, station.is_own, strict=True)]
    local = both.estimate.take(names)
    there = alone["tracker"].readings(far)
    merged = replace(there, model=station.model)
    error = merged.residuals(local.values)
    before = there.residuals(alone["tracker"].values)
    assert np.sqrt(np.mean(error**2)) < 0.8 * np.sqrt(np.mean(before**2))
    _, J = station.model.linearise(local.values, merged.conditions)
    expected = np.einsum("nip,pq,niq->", J, local.dense_covariance(), J)
    assert 0.5 < np.sum(error**2) / expected < 2.0


def test_each_station_has_its_own_noise_and_outliers(machine: sim.TrueMachine, kuka: Robot) -> None:
    """Noise is estimated station by station, and a row is judged by that of its own station."""
    fine, coarse = tracked(machine, kuka, 0, noise=2e-5, outlier=3e-4), tracked(machine, kuka, 1, noise=4e-4)
    fit = fit_tables(kuka, [fine, coarse], Options(effects=GEOMETRIC))
    np.testing.assert_allclose(fit.solution.sigma, [2e-5, 4e-4], rtol=0.2)
    assert np.flatnonzero(fit.solution.weights == 0.0).tolist() == [7]
    assert fit.solution.converged and fit.solution.cost == pytest.approx(1.0)


def test_exact_readings_of_several_stations_are_fitted_to_rounding(machine: sim.TrueMachine, kuka: Robot) -> None:
    """Without noise nothing is left."""
    fit = fit_tables(kuka, [tracked(machine, kuka, s, poses=40, noise=0.0) for s in (0, 1)], Options(effects=GEOMETRIC))
    for station, places in zip(fit.problem.stations, fit.problem.places, strict=True):
        assert np.abs(station.residuals(fit.values[places])).max() < 1e-10


@pytest.fixture
def executors() -> Iterator[list[Executor]]:
    """Return a pool of threads and a pool of processes."""
    with ThreadPoolExecutor(2) as threads, ProcessPoolExecutor(2) as processes:
        yield [threads, processes]


def test_results_do_not_depend_on_the_executor(machine: sim.TrueMachine, kuka: Robot, executors: list[Executor]) -> None:
    """To the last bit: contributions are added in the order of the stations."""
    tables = [tracked(machine, kuka, s, poses=40) for s in (0, 1)] + [tracked(machine, kuka, 0, poses=30, seed=3)]
    options = Options(effects=GEOMETRIC)
    here = fit_tables(kuka, tables, options)
    for executor in executors:
        there = fit_tables(kuka, tables, options, executor=executor)
        np.testing.assert_array_equal(there.values, here.values)
        np.testing.assert_array_equal(there.estimate.sigma, here.estimate.sigma)


class Scale(Executor):
    """Weighs what it is given, and does it here."""

    def __init__(self) -> None:
        self.heaviest, self.tasks = 0, 0

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Weigh a call and make it."""
        self.heaviest, self.tasks = max(self.heaviest, len(pickle.dumps((function, args, kwargs)))), self.tasks + 1
        done: Future[Any] = Future()
        done.set_result(function(*args, **kwargs))
        return done


def test_workers_are_sent_the_rows_once(two: ModelFit, kuka: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not with each of the sums over them: a task is smaller than they are, and the stations are read once a problem."""
    loaded: list[int] = []
    loads = pickle.loads
    monkeypatch.setattr(pickle, "loads", lambda content: loaded.append(len(content)) or loads(content))
    scale = Scale()
    problem, solution = two.problem, two.solution
    for _ in range(3):
        point = Linearised(problem, two.values, solution.free, solution.weights, two.priors.sizes, scale)
        point.posterior(solution.sigma)
    assert scale.tasks == 3 and len(loaded) == 1
    assert scale.heaviest < 0.1 * loaded[0]


def test_what_needs_one_station_names_those_that_there_are(two: ModelFit) -> None:
    """Not the first one, silently."""
    with pytest.raises(BadInputError, match="there are 2: east, west"):
        _ = two.station


def test_names_and_options_of_stations_are_checked(machine: sim.TrueMachine, kuka: Robot, two: ModelFit) -> None:
    """Each has a different name, and options are for one of them."""
    table = tracked(machine, kuka, 0, poses=20)
    with pytest.raises(BadInputError, match="options are given for the station 'tracker'; expected one of 'a', 'b'"):
        fit_tables(kuka, {"a": table, "b": table}, Options(stations={"tracker": StationOptions(sigma=NOISE)}))
    east = two.problem.stations[0]
    with pytest.raises(BadInputError, match="a different name"):
        Problem((east, east))
    with pytest.raises(BadInputError, match="no tables"):
        fit_tables(kuka, [])


def test_a_column_names_the_stations(machine: sim.TrueMachine, kuka: Robot) -> None:
    """Rows of one table, or of several, that name their stations are fitted as those stations given apart."""
    east, west = (tracked(machine, kuka, k, poses=40) for k in (0, 1))
    named = [replace(t, station=np.full(len(t), name)) for t, name in ((east, "east"), (west, "west"))]
    options = Options(effects=GEOMETRIC, sigma=NOISE)
    apart = fit_tables(kuka, {"east": east, "west": west}, options)
    for tables in (
        concatenate(named),
        [concatenate(named)],
        [named[0], named[1].select(slice(9)), named[1].select(slice(9, 40))],
    ):
        found = fit_tables(kuka, tables, options)
        assert [station.name for station in found.problem.stations] == ["east", "west"]
        np.testing.assert_array_equal(found.values, apart.values)


def test_stations_of_one_name_are_refused(machine: sim.TrueMachine, kuka: Robot) -> None:
    """Neither two tables nor two sensors are one station; each error says what to do."""
    table, camera = tracked(machine, kuka, 0, poses=20), seen(machine, kuka, poses=4, pixels=True, noise=0.1)
    for pairs, said in (
        ([("day", table), ("day", table)], "two stations are called 'day'.*rename a file"),
        ([("day", table), ("day", camera)], "different kinds .position and camera_pixel. are called 'day'"),
        ([("day", table), ("x", replace(table, station=np.full(20, "day")))], "two stations are called 'day'"),
        ([(n, replace(t, station=np.full(len(t), "day"))) for n, t in (("a", table), ("b", camera))], "one sensor at a"),
        ([("day", replace(table, station=np.full(20, " ")))], 'line 2, "station": no name'),
    ):
        with pytest.raises(BadInputError, match=said):
            stations_of(pairs)


def test_products_of_parts_are_those_of_each_part() -> None:
    """Parts of one length or of several, padded or one by one, weighed or not: each product is that of its own columns."""
    rng = np.random.default_rng(4)
    for counts in ([7, 7, 7], [300, 300, 300], [5, 6, 0, 7], [2, 90, 3, 3], [11]):
        n = sum(counts)
        dense, r, weights = rng.normal(size=(4, 2, n)), rng.normal(size=(2, n)), rng.uniform(0.0, 2.0, n)
        ends = np.cumsum([0, *counts])
        G, g = np.zeros((len(ends) - 1, 4, 4)), np.zeros((len(ends) - 1, 4))
        Jacobian(4, np.arange(4), dense).add_grams(r, ends, G, g, weights=weights)
        for s, (start, stop) in enumerate(pairwise(ends)):
            A = (dense * weights)[..., start:stop].reshape(4, -1)
            np.testing.assert_allclose(G[s], A @ A.T, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(g[s], A @ (r * weights)[:, start:stop].ravel(), rtol=1e-12, atol=1e-12)


def test_many_stations_need_not_be_kept(two: ModelFit, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sums are the same up to rounding whether normal equations are kept station by station, given up, or never kept."""
    free, sigma = two.solution.free, np.full(2, NOISE)

    def at_hand() -> Linearised:
        return Linearised(two.problem, two.values, free, np.ones(len(two.problem)), two.priors.sizes)

    point = at_hand()
    kept = point.posterior(sigma)
    point.release()
    assert point.posterior(sigma) is kept, "what is small is not computed again"
    for most in ("_MOST_KEPT", "_MOST_OF_FEW"):
        monkeypatch.setattr(equations, most, 0)
    passed = at_hand()
    never = passed.posterior(sigma)
    passed.release()
    unit = 1.0 / np.sqrt(kept.form.whole)
    for other in (never, passed.posterior(sigma)):
        assert other is not kept
        np.testing.assert_allclose(unit * (other.form.H - kept.form.H) * unit[:, None], 0.0, atol=1e-13)
        np.testing.assert_allclose(unit * other.form.g, unit * kept.form.g, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(other.whole, kept.whole, rtol=1e-12)
    np.testing.assert_allclose(passed.squares, point.squares, rtol=1e-12)


def test_small_stations_are_evaluated_together(machine: sim.TrueMachine, kuka: Robot) -> None:
    """One pass over the rows of several, of different lengths and of whatever stands between them, is a pass over each."""
    tables = {name: tracked(machine, kuka, i % 2, poses=30 + 5 * i, seed=i) for i, name in enumerate("abcd")}
    camera = seen(machine, kuka, pixels=False, noise=5e-5)
    tables = {"a": tables["a"], "b": tables["b"], "c": tables["c"], "camera": camera, "d": tables["d"]}
    tables["camera"] = replace(camera, time=np.linspace(0.0, 3600.0, len(camera)))
    known = {"b": StationOptions(base=BASES[1])}
    fit = fit_tables(kuka, tables, Options(effects=(*GEOMETRIC, BaseDrift(1800.0)), sigma=NOISE, stations=known))
    problem, free, sizes = fit.problem, fit.solution.free, fit.priors.sizes
    assert [len(batch.stations) for batch in problem.batches] == [3, 1, 1]
    apart = Problem(problem.stations)
    apart.__dict__["batches"] = tuple(
        Batch((station,), rows, blocks, places[None], station.is_own, k)
        for k, (station, rows, blocks, places) in enumerate(
            zip(problem.stations, problem.rows, problem.block_spans, problem.places, strict=True)
        )
    )
    there = fit.values + np.where(free, fit.estimate.sigma, 0.0)
    problem.batches[0].note_poses(there)
    for station, places in list(zip(problem.stations, problem.places, strict=True))[:3]:
        of_model = station.split(there[places])[0]
        assert station.knows_poses(of_model)
        alone = station.model.predict(of_model, station.conditions)
        np.testing.assert_allclose(station.poses_read(of_model), alone, rtol=0.0, atol=1e-14)
    robust = np.where(np.arange(len(problem)) % 7 == 3, 0.25, 1.0)
    points = [Linearised(each, there, free, robust, sizes) for each in (problem, apart)]
    for one, other in zip(*(point.row_squares for point in points), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9)
    found, expected = (point.posterior(np.full(5, NOISE)) for point in points)
    scale = expected.metric[expected.is_shared]
    np.testing.assert_allclose(found.form.H / np.outer(scale, scale), expected.form.H / np.outer(scale, scale), atol=1e-12)
    np.testing.assert_allclose(found.form.g / scale, expected.form.g / scale, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.whole, expected.whole, rtol=1e-12)
    steps = [each.step_within(np.full(int(free.sum()), np.inf))[0] * each.metric for each in (found, expected)]
    np.testing.assert_allclose(*steps, rtol=0.0, atol=1e-8)
    assert found.visible_rank == expected.visible_rank
    np.testing.assert_allclose(*(each.spent[1] for each in (found, expected)), rtol=1e-9)


def test_stations_are_evaluated_apart_where_an_effect_follows_how_they_stand(machine: sim.TrueMachine, kuka: Robot) -> None:
    """The way from the base to the first joint grows with temperature along the axes of the instrument."""
    tables = [tracked(machine, kuka, s, poses=30) for s in (0, 1)]
    tables = [replace(table, temperature=np.linspace(18.0, 26.0, 30)) for table in tables]
    problem = fit_tables(kuka, tables, Options(effects=GEOMETRIC, sigma=NOISE)).problem
    assert len(problem.batches) == 1
    grown = problem.with_effects([*problem.effects, ThermalExpansion(None, 20.0)])
    assert len(grown.batches) == 2


def test_stations_are_placed_side_by_side_as_each_by_itself(machine: sim.TrueMachine, kuka: Robot) -> None:
    """Fits that share nothing don't hold each other up, not even one whose table is nonsense."""
    tables = {"a": tracked(machine, kuka, 0, poses=30), "b": tracked(machine, kuka, 1, poses=40)}
    rng = np.random.default_rng(3)
    q = kuka.random_configurations(30, rng)
    nonsense = measurements_from_arrays(kuka.joint_names, q, position=rng.normal(size=(30, 3)))
    options = Options(effects=GEOMETRIC, sigma=NOISE)
    placed = place(kuka, {"c": nonsense, **tables}, options)[1:]
    for (station, values), table in zip(placed, tables.values(), strict=True):
        ((alone, expected),) = place(kuka, {"": table}, options)
        np.testing.assert_allclose(values, expected, rtol=0.0, atol=1e-5)
        np.testing.assert_array_equal(station.model.chain.base_rotation, alone.model.chain.base_rotation)


def test_reasons_are_those_of_one_table(machine: sim.TrueMachine, kuka: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows divided among stations identify what they do as one table, for the same reasons, in whatever groups."""
    table = tracked(machine, kuka, 0, poses=160)
    parts = {f"s{k}": table.select(slice(40 * k, 40 * k + 40)) for k in range(4)}
    options = Options(effects=(*GEOMETRIC, JointElasticity()), sigma=NOISE)
    whole = {f.name: (f.status, f.reason.cause) for f in explain(fit_tables(kuka, table, options))}
    fit = fit_tables(kuka, parts, options)
    found = explain(fit)
    monkeypatch.setattr("pincal.identify.explain._TOGETHER", 2)
    assert [(f.name, f.status, f.reason.cause) for f in explain(fit)] == [(f.name, f.status, f.reason.cause) for f in found]
    robots = {f.name: (f.status, f.reason.cause) for f in found if "/" not in f.name}
    same = sum(robots[name] == whole[name] for name in robots)
    # Four bases instead of one leave a little less for what is barely identified.
    assert len(robots) > 30 and same >= len(robots) - 1
    assert {f.status for f in found if "/" in f.name} <= {Status.IDENTIFIED, Status.PRIOR}
    assert [row.name for row in parameter_rows(fit)] == [f.name for f in found]


def test_what_one_station_has_by_itself_is_fitted_there_alone(machine: sim.TrueMachine, kuka: Robot, tmp_path: Path) -> None:
    """Drift at one station, a joint's zero at the other: own parameters, exact columns, and the file has them again."""
    tables = {"east": tracked(machine, kuka, 0, poses=50), "west": replace(tracked(machine, kuka, 1, poses=50), time=None)}
    (offset,) = [effect for effect in GEOMETRIC if effect.name == "joint_offset"]
    own = (AtStation(BaseDrift(1800.0), "east"), AtStation(offset, "west", "joint_3"))
    fit = fit_tables(kuka, tables, Options(effects=(*GEOMETRIC, *own), sigma=NOISE, loss="none"))
    names = [p.name for p in fit.problem.parameters if p.effect == AtStation.name]
    assert names == [*(f"east/base.{s}_t" for s in ("x", "y", "z", "rx", "ry", "rz")), "west/joint_3.theta_here"]
    assert fit.names_of([own[1]]) == (names[-1],) and [effect in fit.problem.effects for effect in own] == [True, True]
    station, places = fit.problem.stations[1], fit.problem.places[1]
    at, i = fit.values[places], station.model.index("joint_3.theta_here")
    (_, _, J), *_ = station.linearise(at, np.ones(len(at), bool))
    step = 1e-6 * (np.arange(len(at)) == i)
    slope = (station.residuals(at - step) - station.residuals(at + step)) / 2e-6
    np.testing.assert_allclose(J[i], slope, atol=1e-8)
    np.testing.assert_allclose(J[i], J[station.model.index("joint_3.theta")], atol=1e-15)
    robot = FittedRobot.of(fit)
    robot.save(tmp_path / "model.json")
    again = load_model(tmp_path / "model.json")
    assert again.at("west").model.effects == robot.at("west").model.effects
    np.testing.assert_array_equal(again.at("west").predict(tables["west"].q), robot.at("west").predict(tables["west"].q))


def wandering(machine: sim.TrueMachine, robot: Robot, days: int, size: float) -> dict[str, Measurements]:
    """Return what a tracker reads on days on each of which joint 2 stands elsewhere, by so much [rad]."""
    tables = {}
    for k, off in enumerate(np.random.default_rng(5).normal(0.0, size, days)):
        table = tracked(machine, robot, k % 2, poses=30, seed=k)
        tables[f"day {k}"] = replace(table, q=table.q - off * (np.arange(robot.n_joints) == 1))
    return tables


@pytest.mark.long
def test_days_drawn_again_show_what_differs_between_them(machine: sim.TrueMachine, kuka: Robot) -> None:
    """The bootstrap over stations spreads an offset that differs by day as widely as its mean over days is known."""
    (offset,) = [effect for effect in GEOMETRIC if effect.name == "joint_offset"]
    fit = fit_tables(kuka, wandering(machine, kuka, 12, 5e-4), Options(effects=(offset,), sigma=NOISE, loss="none"))
    i = fit.estimate.names.index("joint_2.theta")
    spread = bootstrap_stations(fit, draws=40, seed=1)[:, i].std()
    offsets = np.random.default_rng(5).normal(0.0, 5e-4, 12)
    assert spread == pytest.approx(offsets.std() / np.sqrt(12), rel=0.5)
    # Poses are drawn with all their targets, which share the day.
    assert spread > 1.25 * bootstrap(fit, draws=40, seed=1)[:, i].std()


def test_the_only_station_is_not_drawn_again(machine: sim.TrueMachine, kuka: Robot) -> None:
    """The error names the bootstrap over rows."""
    fit = fit_tables(kuka, tracked(machine, kuka, 0, poses=40), Options(effects=GEOMETRIC, sigma=NOISE))
    with pytest.raises(BadInputError, match="or bootstrap"):
        bootstrap_stations(fit, draws=2)


def test_times_of_different_days_do_not_mix(two: ModelFit) -> None:
    """All poses of both stations are there, their times are not; one station keeps its own."""
    both = two.problem.conditions
    assert len(both) == 120 and both.time is None and both.temperature is None and both.approach is None
    np.testing.assert_array_equal(both.q[:50], two.problem.stations[0].conditions.q)
    assert Problem(two.problem.stations[:1]).conditions is two.problem.stations[0].conditions


def test_candidates_of_one_station_are_told_from_those_of_all(two: ModelFit) -> None:
    """Whatever the order in which they are asked for, each has its own columns and its own test."""
    (offset,) = [effect for effect in GEOMETRIC if effect.name == "joint_offset"]
    asked = [AtStation(offset, "west", "joint_3"), GearEccentricity("joint_2"), AtStation(offset, "east", "joint_4")]
    groups = np.zeros(len(two.problem), int)
    found = score_test(two, asked, groups)
    assert [found.gain([k])[1] for k in range(3)] == [1, 2, 1]
    for k, effect in enumerate(asked):
        alone = score_test(two, [effect], groups)
        assert found.gain([k])[0] == pytest.approx(alone.gain([0])[0], rel=1e-6)


def test_directions_that_one_station_records_are_unknown_at_the_other(kuka: Robot) -> None:
    """An effect that follows them is fitted with those of the one, instead of refused for want of the other's."""
    rng = np.random.default_rng(0)
    with_them, without = (
        measurements_from_arrays(kuka.joint_names, q, position=kuka.forward_kinematics(q)[:, :3, 3])
        for q in (kuka.random_configurations(40, rng) for _ in range(2))
    )
    with_them = replace(with_them, approach=rng.choice([-1.0, 1.0], with_them.q.shape))
    fit = fit_tables(kuka, {"a": with_them, "b": without}, Options(effects=(*GEOMETRIC, Backlash("joint_2")), sigma=1e-5))

    assert fit.solution.free[[parameter.name for parameter in fit.problem.parameters].index("joint_2.backlash")]
