"""Scatter of a joint: found where it is, told from functions of the pose, and once a visit, however much is read in one."""

from typing import Any

import numpy as np
import pytest
from machines import kuka as true_kuka

from pincal import simulate as sim
from pincal.calibration.held_out import StationRows, by_stops
from pincal.discover.scatter import Excess, find_excess, related, visits
from pincal.identify.calibrate import fit_tables
from pincal.identify.options import Options
from pincal.identify.station import station_of
from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.model.chain import Chain
from pincal.model.effects import GEOMETRIC
from pincal.model.model import Model
from pincal.robot.robot import Robot

TARGETS = {"a": (0.1, 0.0, 0.1), "b": (-0.05, 0.08, 0.12), "c": (-0.05, -0.08, 0.15)}
NOISE = 5e-5


def measured(
    robot: Robot, scatter: float, *, seed: int, poses: int = 70, cycles: int = 1, product: float = 0.0
) -> Measurements:
    """Return three targets in each of 70 poses, in one cycle or several, of a machine whose third joint scatters [rad].

    The machine's third joint is also off by ``product`` times the sines of its own and of the fifth joint's position.
    """
    rng = np.random.default_rng(seed)
    effects = [sim.hidden_effect("joint_scatter", joint="joint_3", size=scatter)] if scatter else []
    machine = true_kuka().draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3).with_effects(*effects)
    q = np.tile(sim.plan_poses(machine.nominal, poses, rng), (cycles, 1))
    there = q.copy()
    there[:, 2] += product * np.sin(q[:, 2]) * np.sin(q[:, 4])
    table = sim.Instrument(targets=TARGETS, sigma=NOISE).measure(machine, there, rng=rng)
    return measurements_from_arrays(
        robot.joint_names,
        np.repeat(q, len(table["x"]) // len(q), axis=0),
        position=np.column_stack([table[axis] for axis in "xyz"]),
        target=table["target"],
    )


@pytest.mark.parametrize("size", [1e-4, 5e-5])
def test_scatter_of_a_joint_is_found_with_its_size(size: float, kuka: Robot) -> None:
    """It is the same for all targets of a visit: 70 draws of it tell its size to about a tenth."""
    excess = find_excess(fit_tables(kuka, measured(kuka, size, seed=3), Options(effects=GEOMETRIC, sigma=NOISE)))
    found = None if excess is None else excess.scattering

    assert found is not None and found.joint == "joint_3"
    assert found.sigma_rad == pytest.approx(size, rel=0.3)


@pytest.mark.parametrize("seed", range(4))
def test_noise_of_several_targets_is_no_scatter(seed: int, kuka: Robot) -> None:
    """Sound readings raise no alarm."""
    excess = find_excess(fit_tables(kuka, measured(kuka, 0.0, seed=seed), Options(effects=GEOMETRIC, sigma=NOISE)))
    assert excess is None or excess.scattering is None


def _excess_of_rows(kuka: Robot, table: Measurements, options: Options) -> Excess | None:
    """Return the excess of a calibration, whose poses are means, as the rows of the table tell it."""
    fit = fit_tables(kuka, table, options)
    return find_excess(fit, by_stops(fit, [StationRows.of("", table)]))


@pytest.mark.long
def test_replicates_show_that_a_joint_scatters(kuka: Robot) -> None:
    """They differ by its scatter, and not by what is a function of the pose, whatever its size."""
    options = Options(effects=GEOMETRIC, sigma=NOISE)
    scatters, follows = (
        _excess_of_rows(kuka, measured(kuka, size, seed=1, poses=25, cycles=4, product=product), options)
        for size, product in ((5e-5, 0.0), (0.0, 3e-4))
    )

    assert scatters is not None and scatters.scattering is not None
    assert scatters.scattering.shown_by == "replicates" and scatters.sigma == pytest.approx(5e-5, rel=0.3)
    assert follows is not None and follows.scattering is None
    assert "measured twice" not in follows.statement


@pytest.mark.parametrize("readings", [1, 5])
def test_drives_alike_are_no_model_error(kuka: Robot, readings: int) -> None:
    """All stop to 40 urad, 24 poses: neither scatter of one joint nor, as readings of a stop agree, an error of it."""
    rng = np.random.default_rng(4)
    machine = true_kuka().draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3)
    q = sim.plan_poses(machine.nominal, 24, rng)
    arrived = np.repeat(q + 4e-5 * rng.standard_normal(q.shape), readings, axis=0)
    table = sim.Instrument(targets=TARGETS, sigma=5e-6).measure(machine, arrived, rng=rng)
    rows = measurements_from_arrays(
        kuka.joint_names,
        np.repeat(q, readings * len(TARGETS), axis=0),
        position=np.column_stack([table[axis] for axis in "xyz"]),
        target=table["target"],
    )

    assert _excess_of_rows(kuka, rows, Options(effects=GEOMETRIC, sigma=5e-6)) is None


def test_a_function_of_two_joints_is_no_scatter(kuka: Robot) -> None:
    """Without replicates poses that are neighbours in both joints tell; where they are too few, that is said."""
    options = Options(effects=GEOMETRIC, sigma=NOISE)
    follows = find_excess(fit_tables(kuka, measured(kuka, 0.0, seed=2, poses=100, product=2e-4), options))
    few = find_excess(fit_tables(kuka, measured(kuka, 6e-5, seed=2, poses=24), options))

    assert follows is not None and follows.joint == "joint_3" and follows.scattering is None
    assert {"joint_3", "joint_5"} <= set(follows.follows) and "it does not scatter" in follows.statement
    assert few is not None and few.scattering is None and "measure ten poses three times each" in few.statement


@pytest.mark.parametrize(
    ("shape", "poses", "told"),
    [
        (lambda q: np.sin(q[1]) * np.sin(q[3]), 200, ("b", "d")),
        pytest.param(lambda q: q[1] * q[2], 200, ("b", "c"), marks=pytest.mark.long),
        pytest.param(lambda q: np.sin(3.0 * q[2]), 200, ("c",), marks=pytest.mark.long),
        (lambda q: np.sin(q[0] + q[1] + q[2]), 200, ("a", "b", "c")),
        (None, 200, ()),
        (None, 20, None),
    ],
)
def test_neighbours_tell_scatter_from_a_function(shape: Any, poses: int, told: tuple[str, ...] | None) -> None:
    """In at least 7 of 8 tables whose errors are half noise; of 20 poses none is near enough to another."""
    found = []
    for seed in range(8):
        rng = np.random.default_rng([11, seed])
        q = rng.uniform(-2.5, 2.5, (6, poses))
        signal = rng.standard_normal(poses) if shape is None else shape(q) / np.std(shape(q))
        errors = (signal + rng.standard_normal(poses)) / np.sqrt(2.0)
        found.append(related(dict(zip("abcdef", q, strict=True)), errors, np.full(poses, np.sqrt(0.5))))

    assert sum(one == told for one in found) >= 7


def test_rows_of_one_pose_are_one_visit_unless_they_read_the_same_again(kuka: Robot) -> None:
    """Two targets of a pose belong together; the second round of the same poses does not."""
    q = np.tile([[0.0], [0.0], [1.0]], (2, 6))
    table = measurements_from_arrays(kuka.joint_names, q, position=np.zeros((6, 3)), target=[*"aba"] * 2)
    found = visits(station_of(Model(Chain.of(kuka, targets=("a", "b")), ()), table, np.zeros(3)))

    assert found[0] == found[1] and found[3] == found[4]
    assert len(set(found)) == 4 and found[0] != found[3] and found[2] != found[5]
