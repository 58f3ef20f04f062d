"""Changes in a fleet: few false alarms however long it is watched, found at once, and a population drift called that."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from fleet_cases import PRIOR, Family, Year

from pincal import BadInputError
from pincal.fleet.checks import FleetWatch, _Step, fleet_changes
from pincal.fleet.cli.fleet import print_history
from pincal.fleet.history import DIAGNOSED, FleetChange, FleetHistory, LastCheck, Visit, benjamini_hochberg, e_value
from pincal.fleet.robot_type import RobotType, learn_type
from pincal.fleet.summary import look_first, next_step, robot_lines

LAMBDA = 80.0


@pytest.fixture(scope="module")
def family() -> Family:
    """Return a family of which a third of the directions is never seen."""
    return Family.drawn(np.random.default_rng(1), parameters=24, unseen=8)


@pytest.fixture(scope="module")
def of(family: Family) -> RobotType:
    """Return the type of thirty of them."""
    rng = np.random.default_rng(2)
    return learn_type(family.measured(x, rng) for x in family.draw(30, rng)).type


@pytest.mark.long
def test_half_a_year_of_robots(family: Family, of: RobotType) -> None:
    """Five changes of lambda 80 are found within two checks and named, and nothing else is; e-values of others average 1."""
    year = Year(family, of, robots=40, seed=3)
    changed = {k: 2 + 3 * k for k in range(5)}
    for week in range(1, 18):
        for robot, when in changed.items():
            if when == week:
                year.change(robot, LAMBDA)
        year.check(week)
    found = {change.subject: change for change in year.changes}

    assert set(found) == {f"r{robot}" for robot in changed}
    late = [year.week_of(found[f"r{robot}"].found) - when for robot, when in changed.items()]
    assert max(late) <= 1
    for robot in changed:
        change, name = found[f"r{robot}"], year.what[robot]
        assert name in (change.what, *change.equals) or change.what == name.split(".")[0]
        assert abs(year.week_of(change.since) - changed[robot]) <= 1
    history = year.watch.history()
    assert history.open == set(found)
    # The first calibration of a robot has a weight of 6 / pi^2.
    e = np.exp([one.log_e for one in history.last if one.machine not in found])
    assert np.mean(e) < 1.0 and np.mean(e > 20.0) < 0.05


@pytest.mark.long
def test_a_batch_that_drifts_is_no_robot_that_changed(family: Family, of: RobotType) -> None:
    """A tenth of a millimetre on all robots of one supplier from one week on: named as that, with size, and no robot is."""
    year = Year(family, of, robots=30, seed=4, labels=lambda k: {"supplier": "abc"[k % 3], "hall": str(k % 2)})
    for week in range(1, 9):
        if week == 6:
            year.drift("supplier", "b", place=12, by=1e-4 / PRIOR)
        year.check(week)
    (change,) = year.changes
    history = year.watch.history()

    # Its robots are off, and nothing but the drift is strange about them.
    assert history.drifted == {f"r{k}" for k in range(1, 30, 3)} and not history.open
    assert min(one.q_value for one in history.last) > 0.05
    assert {row[1] for row in look_first(history).rows} == {"drifted"}
    assert change.is_group and change.subject == "supplier=b"
    assert year.week_of(change.since) == 6
    assert of.names[12] in (change.what, *change.equals)
    if change.what == of.names[12]:
        assert change.change is not None and change.sigma is not None
        assert abs(change.change - 1e-4) < 4.0 * change.sigma


def test_one_robot_that_changed_is_no_drift_of_its_group(family: Family, of: RobotType) -> None:
    """However far it is off."""
    year = Year(family, of, robots=20, seed=5, labels=lambda k: {"hall": "north"})
    for week in range(1, 8):
        if week == 3:
            year.change(7, 2000.0)
        year.check(week)

    assert [(change.subject, change.is_group) for change in year.changes] == [("r7", False)]


def test_a_calibration_begins_anew(family: Family, of: RobotType) -> None:
    """A robot that changed is out until it is calibrated, and then as good as any."""
    year = Year(family, of, robots=10, seed=7)
    year.check(1)
    year.change(4, 300.0)
    for week in (2, 3, 4):
        year.check(week)
    assert [change.subject for change in year.changes] == ["r4"]
    year.calibrate(4, 5)
    for week in range(6, 12):
        year.check(week)

    assert len(year.changes) == 1


def test_diagnoses_count_by_their_p_values(family: Family, of: RobotType) -> None:
    """Where the readings are not at hand; a strange one alone is not enough among many robots, a very strange one is."""
    rng = np.random.default_rng(8)
    begin = [
        Visit(f"r{k}", "2026-01-01", family.measured(x, rng, name=f"r{k}"), is_calibration=True)
        for k, x in enumerate(family.draw(40, rng))
    ]
    usual = [Visit(f"r{k}", "2026-01-12", p_value=float(rng.uniform())) for k in range(40)]
    usual[3], usual[5] = replace(usual[3], p_value=1e-3), replace(usual[5], p_value=1e-12)
    found = fleet_changes(of, [*usual, *begin])

    assert [(change.subject, change.what) for change in found.changes] == [("r5", DIAGNOSED)]
    assert found.robots == 40 and found.checks == 40
    assert {one.machine: one.p_value for one in found.last} == {visit.machine: visit.p_value for visit in usual}


def calibrated(family: Family, of: RobotType, count: int) -> FleetWatch:
    """Return the watch of some robots that were calibrated."""
    rng, watch = np.random.default_rng(12), FleetWatch(of)
    for k, x in enumerate(family.draw(count, rng)):
        watch.take(0, [Visit(f"r{k}", "2026-01-01", family.measured(x, rng, name=f"r{k}"), is_calibration=True)])
    return watch


def diagnosed(watch: FleetWatch, p_value: float) -> None:
    """Add a round in which one robot is diagnosed, with a p-value."""
    watch.take(1, [Visit("r0", "2026-01-12", p_value=p_value)])


def test_one_diagnosis_weighs_as_its_e_value(family: Family, of: RobotType) -> None:
    """A change before the only round has a probability of 0.005, and the first calibration a weight of 6 / pi^2."""
    watch = calibrated(family, of, 50)
    diagnosed(watch, 1e-6)

    expected = 6.0 / np.pi**2 * (0.005 * e_value(1e-6) + 0.995)
    assert watch.history().last[0].log_e == pytest.approx(np.log(expected))


def test_one_alarm_needs_as_much_evidence_as_there_are_robots(family: Family, of: RobotType) -> None:
    """The first of 50 robots an e-value of 50 / 0.05: by a p-value of 8.5e-9 it has 1036, by one of 9e-9 only 985."""
    for p_value, alarms in ((8.5e-9, 1), (9e-9, 0)):
        watch = calibrated(family, of, 50)
        diagnosed(watch, p_value)
        assert (6.0 / np.pi**2 * (0.005 * e_value(p_value) + 0.995) > 1000.0) == bool(alarms)
        assert len(watch.history().changes) == alarms


def test_what_is_believed_of_a_change_beforehand(of: RobotType) -> None:
    """Six of ten changes are of one parameter, three of one joint, one of everything; each kind is as likely as its like."""
    watch = FleetWatch(of)
    chances = dict(zip(watch._names, np.exp(watch._log_chances), strict=True))
    joints = {name.split(".")[0] for name in of.names}

    assert [chances[name] for name in of.names] == pytest.approx([0.6 / len(of.names)] * len(of.names))
    assert [chances[joint] for joint in joints] == pytest.approx([0.3 / len(joints)] * len(joints))
    assert chances["all"] == pytest.approx(0.1) and sum(chances.values()) == pytest.approx(1.0)


@pytest.mark.parametrize("count", [4, 5])
def test_five_robots_are_a_group_that_drifts(family: Family, of: RobotType, count: int) -> None:
    """Four of a supplier that are off by the same are four robots that changed."""
    labels = {True: "b", False: "a"}
    year = Year(family, of, robots=20, seed=4, labels=lambda k: {"supplier": labels[k < count]})
    for week in range(1, 5):
        if week == 2:
            year.drift("supplier", "b", place=12, by=5e-4 / PRIOR)
        year.check(week)

    found = [change.subject for change in year.changes]
    assert found == ["supplier=b"] if count == 5 else sorted(found) == [f"r{k}" for k in range(count)]


def test_explanations_within_odds_of_a_hundred_are_named(of: RobotType) -> None:
    """Beside the likeliest, those that are less than a hundred times less likely, the likeliest first."""
    watch, P = FleetWatch(of), len(of.names)
    logs = np.full(len(watch._names), -50.0)
    logs[[3, 1, 5, 2]] = 0.0, -np.log(50.0), -np.log(99.0), -np.log(101.0)
    step = _Step(1, "2026-01-08", np.eye(P), np.zeros(P), q=np.zeros(P), Q=np.eye(P), logs=logs, total=0.1)
    found = watch._described("r1", step, "2026-01-08", 9.0, is_group=False)

    assert (found.what, found.equals) == (of.names[3], (of.names[1], of.names[5]))


def test_adjusted_p_values_below_a_twentieth_are_to_be_watched() -> None:
    """Robots that are not reported; those on which nothing was found are not to be inspected, and are counted."""
    last = tuple(LastCheck(f"r{k}", "2026-01-08", q, q, 0.0) for k, q in enumerate((0.051, 0.049)))
    table = look_first(FleetHistory((), last, 2, 2, frozenset(), frozenset()))

    assert [row[:2] for row in table.rows] == [("r1", "watch")]
    assert table.notes[-1] == "nothing was found on 1 other robot"


def test_what_is_printed_of_a_fleet_is_brief_and_ends_in_a_step() -> None:
    """Nine changed robots fit in as few lines as one; the step is about the first, or that there is nothing to inspect."""
    last = [LastCheck(f"r{k}", "2026-01-08", 1e-12, 1e-12, 99.0 - k) for k in range(9)]
    last += [LastCheck("r9", "2026-01-08", 0.8, 0.8, 0.0), LastCheck("r10", "2026-01-08", 0.001, 0.01, 0.0)]
    names = ("joint_3.theta", ("joint_4.s_y", "joint_4", "joint_2"))
    at = ("2026-01-08", "2026-01-01")
    changes = [FleetChange(one.machine, False, *at, *names, 4e-4, 1e-5, "rad", one.log_e) for one in last[:9]]
    found = FleetHistory(tuple(changes), tuple(last), 11, 11, frozenset(one.subject for one in changes), frozenset())
    watched, calm = (replace(found, changes=(), open=frozenset(), last=tuple(last[k:])) for k in (9, 11))

    lines = dict(robot_lines(found))
    assert list(lines) == ["r0", "r1", "r2", "r3", "others"]
    assert lines["r0"].startswith(
        "changed since 2026-01-01 (found 2026-01-08): joint_3.theta or joint_4.s_y or joint_4 +0.4"
    )
    assert lines["others"] == "6 more to look at; nothing was found on 1 other robot"
    assert next_step(found, "store").startswith("Inspect r0; ") and "--machine r0, then" in next_step(found, "store")
    assert dict(robot_lines(watched))["r10"] == "watch: unusual on 2026-01-08 (p 0.001), but no alarm"
    assert next_step(watched, "store") == "Check r10 again soon: pincal fleet add store CHECK.csv --check --machine r10"
    assert list(robot_lines(calm)) == [("all", "no robot has been checked since its calibration")]
    assert look_first(calm).notes == ("no robot has been checked since its calibration",)
    assert next_step(calm, "store").startswith("Add the next round of checks: ")
    assert next_step(calm, "store").endswith(" CHECK.csv --check --machine NAME")
    one = replace(calm, last=watched.last[:1])
    assert list(robot_lines(one)) == [("all", "nothing was found on 1 robot")]
    assert next_step(one, "store").startswith("Nothing to inspect. ")


@pytest.mark.parametrize("groups", [0, 1, 2, 5])
@pytest.mark.parametrize("robots", [0, 1, 9])
@pytest.mark.parametrize("ending", [0, 3])
def test_a_fleet_is_printed_within_fourteen_lines(
    groups: int, robots: int, ending: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """However many groups drift and robots change, with long names; those that are not listed are counted, and none is 0."""
    day, what = "2026-01-08", ("joint_3.theta", ("joint_4.s_y", "joint_4.harmonic_2_cos", "joint_2"))
    at = (day, "2026-01-01")
    hall = "supplier=Northern Gears "
    drifts = [FleetChange(f"{hall}{k}", True, *at, *what, 4e-4, 1e-5, "rad", 50.0 + k) for k in range(groups)]
    names = [f"welding-cell-0{k}" for k in range(robots)]
    changes = [FleetChange(name, False, *at, *what, 4e-4, 1e-5, "rad", 99.0) for name in names]
    last = tuple(LastCheck(name, day, 1e-12, 1e-12, 99.0) for name in names)
    found = FleetHistory((*drifts, *changes), last, len(last), len(last), frozenset(names), frozenset())
    following = next_step(found, "s3://factory/welding/north/fleet-store")
    print_history(found, following, ["note: more"] * ending, page=Path("p.html"))
    lines = capsys.readouterr().out.splitlines()

    assert len(lines) <= 14 and max(map(len, lines)) <= 100
    assert sum(line.startswith(hall) for line in lines) >= min(groups, 1)
    assert sum(line.startswith("welding") for line in lines) >= min(robots, 1)
    assert "other robots" not in " ".join(lines)
    assert any("3 more drifted" in line or "4 more drifted" in line for line in lines) == (groups == 5)
    assert any(line.startswith("next ") for line in lines) and lines[len(lines) - ending :] == ["note: more"] * ending


def test_the_latest_round_has_adjusted_p_values(family: Family, of: RobotType) -> None:
    """Benjamini and Hochberg within a round; the robot to look at first stands in front."""
    year = Year(family, of, robots=40, seed=9)
    year.check(1)
    year.change(11, 45.0)
    year.check(2)
    last = year.watch.history().last

    assert last[0].machine == "r11" and last[0].q_value < 0.05
    p, q = np.array([one.p_value for one in last]), np.array([one.q_value for one in last])
    np.testing.assert_allclose(benjamini_hochberg(p), q)
    assert np.mean(p[1:] < 0.05) < 0.2


def test_what_can_not_be_meant_is_refused(family: Family, of: RobotType) -> None:
    """A check before any calibration, a day that is none, and a share of alarms that is none."""
    rng = np.random.default_rng(10)
    machine = family.measured(family.draw(1, rng)[0], rng, name="r1")
    with pytest.raises(BadInputError, match="not calibrated before"):
        fleet_changes(of, [Visit("r1", "2026-01-01", machine)])
    with pytest.raises(BadInputError, match="ISO date"):
        fleet_changes(of, [Visit("r1", "yesterday", machine, is_calibration=True)])
    with pytest.raises(BadInputError, match="alpha"):
        fleet_changes(of, [], alpha=2.0)
    other = replace(machine, information=msgspec.structs.replace(machine.information, geometry=5))
    with pytest.raises(BadInputError, match="a different nominal geometry"):
        FleetWatch(of).take(0, [Visit("r1", "2026-01-01", other, is_calibration=True)])
