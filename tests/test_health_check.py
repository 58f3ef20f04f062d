"""A health check takes the fewest poses that notice a change of a given size, and a diagnosis keeps the promise."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

import pincal
from pincal import ELASTIC, FittedRobot, Measurements, Options, Robot
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.cli import main
from pincal.design import health
from pincal.design.cli.plan_screen import print_check
from pincal.design.detection import DetectionDesign, detectable_changes, detection_design, lineup_over
from pincal.design.health import CheckRequest, HealthCheck, design_check
from pincal.design.reach import Limits, Reach, SensorSetup
from pincal.diagnosis.lineup import ChangeHypotheses
from pincal.errors import BadInputError
from pincal.model.conditions import Conditions
from pincal.model.effects import GEOMETRIC
from pincal.simulate.typical import draw_typical_elasticity

SIGMA = 5e-5
TOOL = (0.12, 0.05, 0.2)
SOCKETS = {"left": (1.6, 0.6, 0.9), "right": (1.4, -0.8, 1.3)}
HELD = SensorSetup(sensor="socket", tool=TOOL, held_at=tuple(SOCKETS.values()))


def machine_and_model(seed: int) -> tuple[sim.TrueMachine, FittedRobot]:
    """Return a machine with errors, and its calibration from 100 random poses."""
    rng = np.random.default_rng(seed)
    robot = Robot.from_urdf(kuka_urdf_path())
    machine = sim.TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0").draw_errors(rng, sigma_length=2e-4, sigma_angle=5e-4)
    q = sim.plan_poses(machine.nominal, 100, rng)
    model = pincal.calibrate(robot, measured(machine, q, rng), Options(effects=GEOMETRIC, sigma=SIGMA)).at()
    return machine, model


def measured(machine: sim.TrueMachine, q: np.ndarray, rng: np.random.Generator) -> Measurements:
    """Return what a tracker that stands anywhere reads of a machine."""
    hall = np.eye(4)
    hall[:3, 3] = rng.uniform(-3.0, 3.0, 3)
    seen = sim.Instrument(pose=hall, targets=np.array(TOOL)).measure(machine, q)
    position = np.column_stack([seen[axis] for axis in "xyz"]) + SIGMA * rng.standard_normal((len(q), 3))
    return pincal.measurements_from_arrays(machine.names, q, position=position)


@pytest.fixture(scope="module")
def watched() -> tuple[ChangeHypotheses, DetectionDesign]:
    """Return 40 candidates with what they tell, and the lineup of a diagnosis over them."""
    robot = Robot.from_urdf(kuka_urdf_path())
    rng = np.random.default_rng(2)
    model = machine_and_model(2)[1]
    reach = Reach(robot, SensorSetup(tool=TOOL), Limits())
    lineup = lineup_over(model, reach.rig, Conditions.at(reach.draw(40, rng).q))
    guarded, _ = detectable_changes(lineup, Conditions.at(reach.draw(30, rng).q), 2e-4, rng=rng)
    return lineup, detection_design(lineup, guarded, alpha=0.01, power=0.95, degrees=200.0)


def test_the_design_works_on_the_statistic_of_the_diagnosis(watched: tuple[ChangeHypotheses, DetectionDesign]) -> None:
    """The non-centrality of a change is what a diagnosis gains if readings hold the change and no noise."""
    lineup, watch = watched
    chosen = np.arange(12)
    few = replace(lineup, station=lineup.station.select(chosen))
    evidence = few.weigh(few.start, ())
    found = watch.noncentralities(chosen.tolist())
    rng = np.random.default_rng(0)
    guarded, _ = detectable_changes(lineup, Conditions.at(lineup.station.conditions.q), 2e-4, rng=rng)
    again = detection_design(lineup, guarded, alpha=0.01, power=0.95, degrees=200.0).noncentralities(chosen.tolist())
    expected = [one.step @ evidence.form.H @ one.step for one in guarded]

    np.testing.assert_allclose(again, expected, rtol=1e-3, atol=1e-3)
    assert found.min() >= 0.0


def test_one_more_pose_costs_what_is_worked_out_from_scratch(watched: tuple[ChangeHypotheses, DetectionDesign]) -> None:
    """The update by one pose is the design with that pose."""
    _, watch = watched
    chosen = [3, 8, 21, 30, 5, 11]
    costs = watch._costs(chosen)
    for j in (0, 17):
        whole = watch.noncentralities([*chosen, j])
        assert costs[j] == pytest.approx(np.sum((watch.needed(7) / (1.0 + whole)) ** 4), rel=1e-9)


def test_more_is_noticed_for_more_poses(watched: tuple[ChangeHypotheses, DetectionDesign]) -> None:
    """The fewest poses notice everything, one pose less of a random choice does not; a smaller change takes more poses."""
    _, watch = watched
    larger, largest = (replace(watch, G=watch.G * times) for times in (2.0, 4.0))
    few, fewer = larger.fewest(40), largest.fewest(40)

    assert larger.certainty(few) >= 1.0 and largest.certainty(fewer) >= 1.0
    assert len(fewer) < len(few) == len(set(few))
    random = [np.random.default_rng(i).permutation(40)[: len(few)].tolist() for i in range(10)]
    assert max(larger.certainty(chosen) for chosen in random) < 1.0


def test_what_new_frames_take_up_is_not_promised() -> None:
    """An offset of the first joint is a turn of the base, of the last one that of the target: no check can see them."""
    request = CheckRequest(notice=1e-3, candidates=60, draws=2)
    found = design_check(Robot.from_urdf(kuka_urdf_path()), request, options=Options(effects=GEOMETRIC))
    names = {name for change in found.absorbed for name in change.parameters}

    assert {"joint_1.theta", "joint_6.theta", "joint_1.d", "joint_6.d"} <= names
    assert "joint_3.theta" not in names
    assert found.is_met and found.columns().keys() == set(found.robot.joint_names)


def test_a_change_of_up_to_ten_typical_sizes_counts(watched: tuple[ChangeHypotheses, DetectionDesign]) -> None:
    """Whatever has to be larger to move the target by the distance is none that a check promises to detect."""
    lineup, _ = watched
    places = Conditions.at(lineup.station.conditions.q)
    (k,) = [k for k, change in enumerate(lineup.changes) if change.parameters == ("joint_3.theta",)]
    ((at,),) = lineup.places[k : k + 1]

    def size(notice: float) -> list[float]:
        found, _ = detectable_changes(lineup, places, notice, rng=np.random.default_rng(0))
        return [abs(one.step[at]) / lineup.sizes[at] for one in found if one.change == k]

    (small,) = size(1e-4)
    assert size(1e-4 * 9.9 / small) == pytest.approx([9.9])
    assert not size(1e-4 * 10.1 / small)


def test_each_test_has_as_many_directions_as_its_change_moves_the_target(
    watched: tuple[ChangeHypotheses, DetectionDesign],
) -> None:
    """A displaced link is a rigid body with six directions; new frames take up two of one next to the base or target."""
    lineup, _ = watched
    places = Conditions.at(lineup.station.conditions.q)
    found, _ = detectable_changes(lineup, places, 2e-4, rng=np.random.default_rng(0))
    links = {
        k: {name.split(".")[0] for name in change.parameters}
        for k, change in enumerate(lineup.changes)
        if len(change.parameters) == 8
    }
    ranks = {tuple(sorted(links[one.change])): one.rank for one in found if one.change in links}

    assert ranks == {
        ("joint_1", "joint_2"): 4,
        ("joint_2", "joint_3"): 6,
        ("joint_3", "joint_4"): 6,
        ("joint_4", "joint_5"): 6,
        ("joint_5", "joint_6"): 4,
    }


def test_a_distance_takes_more_poses_than_a_position() -> None:
    """One number tells less than three."""
    request = CheckRequest(notice=2e-3, candidates=80, draws=2, max_poses=80)
    robot = Robot.from_urdf(kuka_urdf_path())
    position, distance = (
        design_check(robot, request, options=Options(effects=GEOMETRIC), rig=rig)
        for rig in (SensorSetup(), SensorSetup(sensor="distance", instrument=(3.0, 0.5, 1.0)))
    )

    assert position.is_met and distance.is_met
    assert len(position.conditions) < len(distance.conditions)


@pytest.mark.long
def test_a_check_with_sockets_holds_the_tool_point_in_them() -> None:
    """Every pose brings the target to the socket that its row names, and each socket has rows to spare."""
    robot = Robot.from_urdf(kuka_urdf_path())
    request = CheckRequest(notice=5e-3, candidates=60, draws=2, max_poses=60)
    found = design_check(robot, request, options=Options(effects=GEOMETRIC), rig=HELD)
    columns = found.columns()
    q = np.column_stack([columns[name] for name in robot.joint_names])
    tips = robot.forward_kinematics(q)
    places = dict(zip(("socket_1", "socket_2"), SOCKETS.values(), strict=True))

    assert found.is_met
    off = tips[:, :3, :3] @ TOOL + tips[:, :3, 3] - [places[name] for name in columns["socket"]]
    np.testing.assert_allclose(off, 0.0, atol=1e-4)
    assert np.unique(columns["socket"], return_counts=True)[1].min() >= 2
    assert not {"joint_3.theta"} & {name for change in found.absorbed for name in change.parameters}


@pytest.mark.long
def test_sockets_are_asked_for() -> None:
    """A check with sockets needs their places, and one without has none."""
    robot, request = Robot.from_urdf(kuka_urdf_path()), CheckRequest(candidates=60, draws=2)
    for rig in (SensorSetup(sensor="socket"), SensorSetup(held_at=HELD.held_at)):
        with pytest.raises(BadInputError, match=r"position|socket"):
            design_check(robot, request, options=Options(effects=GEOMETRIC), rig=rig)
    far = replace(HELD, held_at=((9.0, 0.0, 1.0), (8.0, 0.0, 1.0)))
    with pytest.raises(BadInputError, match=r"too few poses .* bringing the target there"):
        design_check(robot, request, options=Options(effects=GEOMETRIC), rig=far)


@pytest.mark.parametrize(
    ("wrong", "named"),
    [({"notice": 0.0}, "notice"), ({"power": 1.0}, "power"), ({"alpha": 0.7}, "alpha"), ({"max_poses": 3}, "3 poses")],
)
def test_a_check_that_makes_no_sense_is_refused(wrong: dict[str, float], named: str) -> None:
    """The message names what is wrong."""
    with pytest.raises(BadInputError, match=named):
        CheckRequest(**wrong)  # type: ignore[arg-type]
    assert CheckRequest(max_poses=4).max_poses == 4


def test_what_is_printed_says_what_is_noticed_and_what_is_not() -> None:
    """The sentence holds the size asked for, or the one that is reached."""
    robot, options = Robot.from_urdf(kuka_urdf_path()), Options(effects=GEOMETRIC)
    out = Console(file=StringIO(), width=100)
    for request in (CheckRequest(notice=1e-3, candidates=60, draws=2), CheckRequest(max_poses=6, candidates=60, draws=2)):
        found = design_check(robot, request, options=options)
        print_check(found, out)
    said = " ".join(out.file.getvalue().split())  # type: ignore[attr-defined]

    assert "more than 1 mm is detected with a probability of 95 %, at 1 % false alarms" in said
    assert "6 poses, 2 minutes" in said and "not met: too few poses to detect 0.1 mm" in said
    assert found.noticeable > found.notice and "joint_1.theta" in said


@pytest.mark.long
def test_the_command_writes_the_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a robot and of a model; that a size is not noticed with so few poses is exit 5."""
    # What is simulated of a check takes most of its time, and decides nothing here.
    monkeypatch.setattr(health, "CheckRequest", partial(CheckRequest, draws=20))
    _, model = machine_and_model(3)
    model.save(tmp_path / "model.json")
    out = tmp_path / "check.csv"
    common = ["--check", "--candidates", "60", "--out", str(out), "--json"]
    for robot, more, code in (
        (tmp_path / "model.json", ["--notice", "1mm"], 0),
        (kuka_urdf_path(), ["--max-poses", "6"], 5),
    ):
        with pytest.raises(SystemExit) as ended:
            main(["design", str(robot), *common, *more])
        found = json.loads(capsys.readouterr().out)
        assert ended.value.code == code and found["met"] is (code == 0)
        assert found["poses"] == len(list(csv.DictReader(out.open())))


@pytest.mark.long
@pytest.mark.rates
def test_a_diagnosis_of_the_table_keeps_what_the_check_promises() -> None:
    """Simulated apart from the model: no alarm where nothing changed, and an offset of the promised size is noticed."""
    rng = np.random.default_rng(8)
    alarms, noticed, draws = 0, 0, 20
    for seed in range(draws):
        machine, model = machine_and_model(100 + seed)
        check = design_check(model, CheckRequest(notice=3e-4, candidates=150, draws=2, seed=seed))
        assert check.is_met
        q = check.conditions.q
        later = replace(machine, joint_offsets=machine.joint_offsets + offset_of(check, "joint_3") * np.eye(6)[2])
        alarms += pincal.diagnose(model, measured(machine, q, rng)).changed
        noticed += pincal.diagnose(model, measured(later, q, rng)).changed

    assert alarms <= 2
    assert noticed >= 18


@pytest.mark.long
@pytest.mark.rates
def test_contacts_keep_what_a_check_with_sockets_promises() -> None:
    """The true machine is held in two sockets: no alarm where nothing changed, an offset of the promised size is noticed."""
    rng = np.random.default_rng(8)
    alarms, noticed, draws = 0, 0, 6
    for seed in range(draws):
        machine, model = machine_and_model(100 + seed)
        check = design_check(model, CheckRequest(notice=3e-3, candidates=150, draws=100, seed=seed), rig=HELD)
        assert check.is_met and check.alarms <= 0.05 and check.noticed >= 0.85
        q = check.conditions.q
        later = replace(machine, joint_offsets=machine.joint_offsets + offset_of(check, "joint_3") * np.eye(6)[2])
        alarms += pincal.diagnose(model, touched(machine, q, rng)).changed
        noticed += pincal.diagnose(model, touched(later, q, rng)).changed

    assert alarms <= 1
    assert noticed >= 5


def touched(machine: sim.TrueMachine, q: np.ndarray, rng: np.random.Generator) -> Measurements:
    """Return the joints of a machine whose tool point is held in sockets near some poses."""
    seen = sim.Contact(fixed=SOCKETS, tool=TOOL, sigma=SIGMA).measure(machine, q, rng=rng)
    joints = np.column_stack([seen[name] for name in machine.names])
    return pincal.measurements_from_arrays(machine.names, joints, socket=seen["socket"])


def offset_of(check: HealthCheck, joint: str) -> float:
    """Return the change of a joint offset that the check promises to notice [rad]."""
    change = next(c for c in check.changes if c.change.parameters == (f"{joint}.theta",))
    return float(change.step[np.argmax(np.abs(change.step))])


@pytest.mark.long
@pytest.mark.rates
def test_the_simulated_rates_are_those_asked_for() -> None:
    """An alarm in at most 2 % of checks of an unchanged robot; the hardest change is noticed in 92 % or more."""
    request = CheckRequest(notice=2e-4, draws=600)
    found = design_check(Robot.from_urdf(kuka_urdf_path()), request, options=Options(effects=ELASTIC))

    assert found.is_met and found.alarms <= 0.02 and found.noticed >= 0.92


@pytest.mark.long
def test_an_unchanged_arm_without_masses_raises_no_alarm(monkeypatch: pytest.MonkeyPatch) -> None:
    """Masses known to a third, which compliances make up for: an alarm in at most 5 of 100 simulated checks (p = 5e-4)."""
    urdf = Path(kuka_urdf_path()).read_text(encoding="utf-8")
    robot = Robot.from_urdf(re.sub("<inertial>.*?</inertial>", "", urdf, flags=re.DOTALL).encode())
    rng = np.random.default_rng(3)
    machine = draw_typical_elasticity(sim.TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0"), rng)
    q = sim.plan_poses(machine.nominal, 60, rng)
    model = pincal.calibrate(robot, measured(machine, q, rng), Options(effects=ELASTIC, sigma=SIGMA)).at()
    simulated = health._Planning.alarms

    def unchanged(self: Any, choice: Any, step: np.ndarray) -> float:
        # Checks of a robot that has changed take as long, and decide nothing here.
        return np.nan if step.any() else simulated(self, choice, step)

    monkeypatch.setattr(health._Planning, "alarms", unchanged)
    found = design_check(model, CheckRequest(notice=5e-4, draws=100))

    assert robot.massless
    assert found.alarms <= 0.05
