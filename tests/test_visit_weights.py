"""Readings scatter within a stop, stops at a pose, poses about the model: each level has its size, and weighs."""

from __future__ import annotations

import numpy as np
import pytest

from pincal import Options, Robot
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.identify.calibrate import fit_tables
from pincal.identify.fit import ModelFit
from pincal.identify.visit_weights import ScatterByLevel, VarianceComponent, scatter_by_level
from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.measure.stops import plan_of
from pincal.model.effects import GEOMETRIC

URDF = kuka_urdf_path()
READING = 2e-5
ARRIVAL = 4e-5


def measured(visits: np.ndarray, dwell: int, *, seed: int = 0, arrival: float = ARRIVAL) -> Measurements:
    """Return a program of poses, each visited as often as told, with so many readings a stop."""
    rng = np.random.default_rng(seed)
    machine = sim.TrueMachine.from_urdf(URDF, tip="tool0").draw_errors(rng, sigma_length=3e-4, sigma_angle=3e-4)
    q = sim.plan_poses(machine.nominal, len(visits), rng)
    order = np.concatenate([np.flatnonzero(visits > cycle) for cycle in range(int(visits.max()))])
    clean = sim.Instrument(targets=(0.1, 0.0, 0.2), sigma=0.0).measure(machine, q[order], rng=rng)
    position = np.column_stack([clean[axis] for axis in "xyz"])
    # Of equal size in all directions, so that the moments are known.
    position = position + arrival * rng.standard_normal(position.shape)
    position = np.repeat(position, dwell, axis=0) + READING * rng.standard_normal((len(order) * dwell, 3))
    return measurements_from_arrays(machine.names, np.repeat(q[order], dwell, axis=0), position=position)


def scatter_of(rows: Measurements, **options: object) -> tuple[ModelFit, ScatterByLevel | None]:
    fit = fit_tables(Robot.from_urdf(URDF), rows, Options(effects=GEOMETRIC, **options))  # type: ignore[arg-type]
    return fit, scatter_by_level(fit, fit.readings(rows), plan_of(rows))


def test_each_level_has_its_scatter() -> None:
    """Instrument, arrival and model come out as simulated, with their degrees of freedom."""
    _, found = scatter_of(measured(np.full(60, 4), 3))

    assert found is not None
    assert found.reading.sigma_m == pytest.approx(READING, rel=0.06)
    assert found.stop.sigma_m == pytest.approx(ARRIVAL, rel=0.1)
    assert found.model.sigma_m < 1e-5
    assert found.reading.degrees == 3 * 60 * 4 * 2
    assert found.stop.degrees == 3 * 60 * 3


def test_without_repeats_in_a_stop_both_are_one() -> None:
    """One reading a stop: what visits scatter by is that of instrument and arrival together."""
    _, found = scatter_of(measured(np.full(60, 5), 1))

    assert found is not None
    assert found.reading.degrees == 0
    assert found.stop.sigma_m == pytest.approx(np.hypot(READING, ARRIVAL), rel=0.08)


def test_the_noise_of_a_fit_is_that_of_one_visit() -> None:
    """However often poses were visited, and however many readings a stop has."""
    for visits, dwell in ((10, 1), (4, 3), (1, 1)):
        fit, _ = scatter_of(measured(np.full(60, visits), dwell))
        assert fit.solution.sigma[0] == pytest.approx(np.hypot(READING, ARRIVAL), rel=0.2)


@pytest.mark.parametrize("declared", [pytest.param(READING, marks=pytest.mark.long), None])
def test_few_poses_that_were_visited_often_have_the_noise_of_their_visits(declared: float | None) -> None:
    """Thirty visits of each of twenty poses show it, whatever the few residuals of their means do."""
    scatter = np.hypot(READING, ARRIVAL)
    for seed in range(4):
        fit, _ = scatter_of(measured(np.full(20, 30), 1, seed=seed), sigma=declared)
        assert fit.solution.sigma[0] > 0.93 * scatter
        assert fit.is_declared is (declared is not None)


def test_dwell_does_not_average_the_arrival() -> None:
    """Twenty readings a stop tell no more of the robot than the stop does."""
    once, often = (scatter_of(measured(np.full(60, 1), dwell, seed=3))[0] for dwell in (1, 20))
    ratio = often.estimate.sigma / once.estimate.sigma

    assert 0.75 < np.median(ratio[once.solution.free]) < 1.1


def test_poses_that_were_visited_often_weigh_more() -> None:
    """Five poses of thirty visits beside sixty single ones, of a robot that the model describes."""
    visits = np.array([30] * 5 + [1] * 60)
    fit, _ = scatter_of(measured(visits, 1))
    weights = fit.problem.stations[0].weights

    np.testing.assert_allclose(weights[visits == 30], np.sqrt(30.0), rtol=0.25)
    np.testing.assert_allclose(weights[visits == 1], 1.0, rtol=0.05)


def test_an_interval_holds_the_true_size() -> None:
    """By chi-square; without degrees of freedom anything is possible."""
    low, high = VarianceComponent(2e-5, 100.0).interval()

    assert low == pytest.approx(2e-5 * np.sqrt(100.0 / 129.56), rel=1e-3)
    assert high == pytest.approx(2e-5 * np.sqrt(100.0 / 74.22), rel=1e-3)
    assert VarianceComponent(0.0, 0.0).interval() == (0.0, np.inf)
