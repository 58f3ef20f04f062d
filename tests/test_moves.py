"""What moved on a robot between stations is named with its interval, and nothing is where it is the same at all of them."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
import pytest
from msgspec import UnsetType

import pincal
from pincal import ELASTIC, Measurements, Options, Robot
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.calibration.moves import moves_of
from pincal.calibration.result_tables import moved_table, repeated_table, station_changes
from pincal.calibration.station_information import StationsInformation, information_at, spent_at
from pincal.identify.calibrate import fit_tables
from pincal.identify.fit import ModelFit
from pincal.model.at_station import AtStation
from pincal.model.effects import GEOMETRIC

SIGMA, TOOL = 5e-5, (0.12, 0.05, 0.2)
DAYS = ("monday", "tuesday", "wednesday", "thursday")


def measured_over(seed: int, offsets: Mapping[str, float], *, poses: int = 40, again: int = 0) -> dict[str, Measurements]:
    """Return what a tracker, set up anew each day, reads of a machine whose third drive is off by so much that day [rad]."""
    rng = np.random.default_rng([seed, 2])
    machine = sim.TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0").draw_errors(rng, sigma_length=2e-4, sigma_angle=5e-4)
    found = {}
    for day, offset in offsets.items():
        q = sim.plan_poses(machine.nominal, poses, rng)
        q = np.vstack([q, np.repeat(q[:again], 2, axis=0)])
        hall = np.eye(4)
        hall[:3, 3] = rng.uniform(-3.0, 3.0, 3)
        there = sim.TrueMachine(**{**vars(machine), "joint_offsets": machine.joint_offsets + offset * np.eye(6)[2]})
        seen = sim.Instrument(pose=hall, targets=np.array(TOOL)).measure(there, q)
        position = np.column_stack([seen[axis] for axis in "xyz"]) + SIGMA * rng.standard_normal((len(q), 3))
        found[day] = pincal.measurements_from_arrays(machine.names, q, position=position, source=day)
    return found


@pytest.fixture(scope="module")
def robot() -> Robot:
    """Return the KUKA."""
    return Robot.from_urdf(kuka_urdf_path())


def fitted(robot: Robot, tables: Mapping[str, Measurements]) -> ModelFit:
    """Return the geometric fit of all stations, their noise declared."""
    return fit_tables(robot, tables, Options(effects=GEOMETRIC, sigma=SIGMA))


@pytest.mark.parametrize("sigma", [1.7e-5, 3.4e-4, 2.2e-3])
def test_a_change_has_the_digits_of_its_interval(sigma: float) -> None:
    """Two digits of the interval, and as many decimals of the change, in words and in the table."""
    entry = {"name": "joint_3.theta", "unit": "rad", "change": 0.01234567, "sigma": sigma, "moved": True}
    records = [{"name": "monday", "parameters": []}, {"name": "tuesday", "parameters": [entry]}]
    told = re.match(r"joint_3.theta at tuesday by (\S+) ± (\S+) mrad", station_changes(records))
    table = moved_table(records)

    assert told is not None and table is not None
    by, half = told.groups()
    assert float(half) == pytest.approx(1.96e3 * sigma, rel=0.05) and len(half.strip("0.").replace(".", "")) <= 2
    assert len(by.partition(".")[2]) == len(half.partition(".")[2])
    assert table.texts()[0][3] == by and {len(text.partition(".")[2]) for text in table.texts()[0][3:6]} == {
        len(by.partition(".")[2])
    }


@pytest.mark.long
def test_a_jump_between_two_days_is_named_with_its_interval(robot: Robot) -> None:
    """An offset that came between Tuesday and Wednesday: which one, when, and the truth within three sigma."""
    jump = 4e-4
    run = pincal.run_calibration(
        robot,
        measured_over(4, dict(zip(DAYS, (0.0, 0.0, jump, jump), strict=True))),
        Options(effects=GEOMETRIC),
        test_fraction=0.0,
    )
    records = run.result.to_dict()["stations"]

    assert [[entry["name"] for entry in record["parameters"]] for record in records] == [["joint_3.theta"]] * 4
    assert [record["parameters"][0]["moved"] for record in records] == [False, False, True, False]
    for record, truth in zip(records[1:], (0.0, jump, jump), strict=True):
        entry = record["parameters"][0]
        assert abs(entry["change"] - truth) < 3.0 * entry["sigma"] < 1e-3
    words = station_changes(records)
    doubts = [str(note) for note in run.result.warnings if "moved by" in str(note)]
    assert [doubt.startswith("wednesday: joint_3.theta moved by 0.") for doubt in doubts] == [True]
    assert words.startswith("joint_3.theta at wednesday by 0.") and " ± 0.0" in words and "thursday" not in words
    table = moved_table(records)
    assert table is not None and [row[2] for row in table.rows] == list(DAYS[1:])


def test_intervals_are_those_of_a_fit_in_which_each_day_has_its_own(robot: Robot) -> None:
    """Change and sigma equal those of a fit with an offset of its own at the other station."""
    offsets = next(effect for effect in GEOMETRIC if effect.locus.acts_on == "drive")
    tables = measured_over(5, {"a": 0.0, "b": 2e-4})
    found = {move["name"]: move for move in moves_of(fitted(robot, tables))[1]}["joint_3.theta"]
    effects = (*GEOMETRIC, AtStation(offsets, "b", "joint_3"))
    apart = fit_tables(robot, tables, Options(effects=effects, sigma=SIGMA))
    place = next(i for i, p in enumerate(apart.problem.parameters) if p.name.endswith("theta_here"))

    assert found["change"] == pytest.approx(apart.values[place], rel=0.05)
    assert found["sigma"] == pytest.approx(apart.estimate.fitted_sigma[place], rel=0.05)
    fit_has_it = [move for move in moves_of(apart)[1] if move["moved"]]
    assert [move["name"] for move in fit_has_it] == ["joint_3.theta_here"]


def rippled(seed: int, *, change: float = 0.0, ripple: float = 3e-4, split: bool = True) -> dict[str, Measurements]:
    """Return two days of an arm whose drives have ripples that no model knows; if split, each on one side of joint 2.

    On the second day the third drive has a wave more, of three cycles per revolution [rad].
    """
    rng = np.random.default_rng(seed)
    machine = sim.TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0").draw_errors(rng, sigma_length=2e-4, sigma_angle=5e-4)
    sizes, phases = ripple * rng.standard_normal((3, 6)), rng.uniform(0.0, 6.3, (3, 6))
    orders, found = rng.integers(1, 15, (3, 6)), {}
    for day in range(2):
        q = sim.plan_poses(machine.nominal, 360, rng)
        q = np.array_split(q[np.argsort(q[:, 1])] if split else q, 3)[2 * day]
        drives = q + np.sum(sizes[:, None] * np.sin(orders[:, None] * q + phases[:, None]), axis=0)
        drives[:, 2] += day * change * np.sin(3.0 * q[:, 2] + 1.0)
        hall = np.eye(4)
        hall[:3, 3] = rng.uniform(-3.0, 3.0, 3)
        seen = sim.Instrument(pose=hall, targets=np.array(TOOL)).measure(machine, drives)
        position = np.column_stack([seen[axis] for axis in "xyz"]) + SIGMA * rng.standard_normal((len(q), 3))
        found[DAYS[day]] = pincal.measurements_from_arrays(machine.names, q, position=position, source=DAYS[day])
    return found


@pytest.mark.long
@pytest.mark.rates
def test_what_no_model_knows_moves_nothing(robot: Robot) -> None:
    """Ripples of all drives, seen from one side one day and from the other the next: at most 2 of 10 (5 before)."""
    alarms = [seed for seed in range(10) if any(moves_of(fit_tables(robot, rippled(seed), Options(effects=ELASTIC))))]
    print(f"something moved on {len(alarms)} of 10 arms on which nothing did")
    assert len(alarms) <= 2, alarms


@pytest.mark.long
@pytest.mark.parametrize("change", [0.0, 5e-4])
def test_a_calibration_names_the_drive_whose_curve_changed(robot: Robot, change: float) -> None:
    """With the day, and by how much in the mean square, to a tenth, as pieces are coarse, beside ripples of all drives."""
    tables = rippled(7, change=change, ripple=5e-5, split=False)
    run = pincal.run_calibration(robot, tables, Options(effects=ELASTIC), test_fraction=0.0)
    every = run.result.to_dict()["stations"][1].get("parameters", [])
    moved = [move for move in every if move["name"].endswith(".curve")]
    doubts = [str(note) for note in run.result.warnings if "moved by" in str(note)]
    if not change:
        assert not moved and not doubts
        return
    assert [(move["name"], move["moved"]) for move in moved] == [("joint_3.curve", True)]
    assert [doubt.startswith("tuesday: ") and "joint_3.curve moved by 0.3" in doubt for doubt in doubts] == [True]
    wave = change * np.sin(3.0 * tables["tuesday"].q[:, 2] + 1.0)
    assert abs(moved[0]["change"] - np.std(wave)) < max(3.0 * moved[0]["sigma"], 0.1 * np.std(wave))
    assert "joint_3.curve at tuesday by 0.3" in station_changes(run.result.to_dict()["stations"])


@pytest.mark.long
def test_nothing_moves_on_a_robot_that_stays_the_same(robot: Robot) -> None:
    """Eight robots measured on three days: not one parameter."""
    for seed in range(8):
        fit = fitted(robot, measured_over(seed, dict.fromkeys(DAYS[:3], 0.0), poses=25))
        assert not any(moves_of(fit)), seed


@pytest.mark.parametrize("rounding", [0.0, 1e-12, 1e-7])
@pytest.mark.parametrize("apart", [0.5, 1e-6, 1e-10])
def test_changes_survive_a_badly_conditioned_fit(apart: float, rounding: float) -> None:
    """Two stations that say the same of the robot and are pulled apart by b: parameters changed by -2 G^-1 b, with 2 G^-1.

    Two parameters are hardly told apart, so that the covariance of the fit is huge and off by rounding, which turns what is
    common to the stations, and of which nothing is left, into a matrix that is not positive.
    """
    scale, b = np.array([1e3, 1e5, 1.0]), np.array([3e3, -2e5, 1.0])
    G = np.outer(scale, scale) * [[1.0, 1.0 - apart, 0.3], [1.0 - apart, 1.0, 0.3], [0.3, 0.3, 1.0]]
    C = np.linalg.inv(2.0 * G) * (1.0 + rounding)
    told = StationsInformation(
        np.stack([G, G]), np.stack([b, -b]), np.ones((2, 3), bool), C, np.full(3, 1e6), np.zeros(3, bool)
    )
    for places in ([0], [1], [2], [0, 2]):
        station, _, values, covariance = told.released([(p,) for p in places])
        difference = np.where(station == 1, 1.0, -1.0) * np.repeat(np.eye(len(places)), 2, axis=1)
        inverse = np.linalg.inv(G[np.ix_(places, places)])

        np.testing.assert_allclose(difference @ values, -2.0 * inverse @ b[places], rtol=1e-5)
        np.testing.assert_allclose(difference @ covariance @ difference.T, 2.0 * inverse, rtol=1e-5)
        assert told.gain([(p,) for p in places]) == pytest.approx(2.0 * b[places] @ inverse @ b[places], rel=1e-5)
        assert np.all(np.diag(covariance) > 0.0)


def test_what_no_station_observes_has_not_moved() -> None:
    """Joints at rest in every station gain nothing by values of their own, alone or beside one that is observed."""
    G, b = np.diag([4.0, 9.0]), np.array([2.0, 3.0])
    seen = np.array([[True, False], [True, False]])
    told = StationsInformation(
        np.stack([G, G]), np.stack([b, -b]), seen, np.linalg.inv(2.0 * G), np.full(2, 1e6), np.zeros(2, bool)
    )

    assert told.gain([(1,)]) == 0.0 and told.degrees((1,)) == 0
    assert told.gain([(0,), (1,)]) == pytest.approx(told.gain([(0,)])) == pytest.approx(2.0 * b[0] ** 2 / G[0, 0])
    stations, values, covariance = told.own_values([(1,)], (1,))
    assert len(stations) == 0 and values.shape == (0, 1) and covariance.shape == (0, 1, 0, 1)
    assert told.moved([(1,)]) == ()


def test_gains_of_many_are_those_of_each() -> None:
    """Beside nothing and beside what moved already, of single parameters and of curves, seen everywhere or not."""
    rng = np.random.default_rng(3)
    A = rng.normal(size=(3, 5, 9))
    G, seen = A @ A.swapaxes(1, 2), np.ones((3, 5), bool)
    seen[1, 2] = False
    C, b = np.linalg.inv(G.sum(axis=0) + np.eye(5)), rng.normal(size=(3, 5))
    told = StationsInformation(G, b, seen, C, np.full(5, 10.0), np.zeros(5, bool))
    tried = [(0,), (2,), (3, 4)]

    for chosen in ([], [(1,)]):
        each = [told.gain([*chosen, group]) - told.gain(chosen) for group in tried]
        np.testing.assert_allclose(list(told.gains(chosen, tried)), each, rtol=1e-9, atol=1e-12)


@pytest.mark.long
@pytest.mark.rates
def test_a_robot_that_stays_the_same_moves_in_one_of_a_hundred(robot: Robot) -> None:
    """At most 3 % of 300 robots, noise estimated."""
    alarms = 0
    for seed in range(300):
        tables = measured_over(100 + seed, dict.fromkeys(DAYS[: 2 + seed % 3], 0.0), poses=30)
        alarms += any(map(len, moves_of(fit_tables(robot, tables, Options(effects=GEOMETRIC)))))
    assert alarms <= 9


def test_stations_pay_for_all_parameters_together(robot: Robot) -> None:
    """What the rows of the stations spend adds up to what the fit spends, and what they say to what it knows."""
    fit = fitted(robot, measured_over(6, dict.fromkeys(DAYS[:2], 0.0)))
    said = [information_at(fit, k).form.H for k in range(2)]
    sizes = fit.priors.sizes[fit.solution.free & fit.problem.is_shared]

    assert sum(spent_at(fit, k) for k in range(2)) == pytest.approx(fit.solution.posterior.effective, rel=1e-6)
    covariance = np.linalg.inv(sum(said) + np.diag(sizes**-2.0))
    np.testing.assert_allclose(covariance, fit.solution.known.covariance, rtol=1e-4, atol=1e-12)


@pytest.mark.long
def test_each_station_has_its_repeatability(robot: Robot) -> None:
    """Lack of fit is tested where poses were measured again, station by station."""
    tables = measured_over(7, {"monday": 0.0, "tuesday": 0.0}, again=6)
    tables["once"] = measured_over(7, {"once": 0.0})["once"]
    result = pincal.run_calibration(robot, tables, Options(effects=GEOMETRIC), test_fraction=0.0).result
    contents = result.to_dict()
    monday, tuesday, once = contents["stations"]

    assert result.iso9283 is None and result.lack_of_fit is None and "lack_of_fit" not in once
    for record in (monday, tuesday):
        assert record["iso9283"]["poses"] == {"test": 6} and record["lack_of_fit"]["p_value"] > 1e-3
        assert record["lack_of_fit"]["pure_error"]["sigma_m"] == pytest.approx(SIGMA, rel=0.3)
    assert not isinstance(result.stations, UnsetType)
    table = repeated_table(result.stations)
    assert table is not None and [row[0] for row in table.rows] == ["monday", "tuesday"]
