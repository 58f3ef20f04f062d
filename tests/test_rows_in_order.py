"""From which side joints arrived, where the user says that rows stand in the order of measurement."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pincal import GEOMETRIC, Options, Robot, calibrate, measurements_from_arrays, run_discovery
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.discover.loop import discover_effects
from pincal.errors import PincalWarning
from pincal.identify.split import row_groups
from pincal.measure.approach import BY_COLUMNS, moves_by_order, note_on_sides, sides_of
from pincal.measure.measurements import Measurements, concatenate
from pincal.measure.poses import by_pose
from pincal.measure.table import read_measurements, write_table
from pincal.model.catalogue import Backlash, ShortOfTarget, ThermalExpansion
from pincal.model.catalogue.candidates import untestable
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.recorded import RECORDABLE

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

PLAY, SIGMA, N = 2e-4, 5e-5, 150
BACKLASH = sim.Backlash(joint="joint_2", size=PLAY)


@pytest.fixture(scope="module")
def machine() -> sim.TrueMachine:
    """Return a stiff KUKA with play in one joint."""
    machine = sim.TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0")
    return machine.draw_errors(np.random.default_rng(1), sigma_length=3e-4, sigma_angle=1e-3).with_effects(BACKLASH)


def table(machine: sim.TrueMachine, path: Path, **others: np.ndarray) -> Path:
    """Write a table of poses that the machine took in their order, dragged from one to the next; return its path."""
    rng = np.random.default_rng(2)
    q = sim.plan_poses(machine.nominal, N, rng)
    tip = machine.tip(q)
    position = tip[:, :3, 3] + tip[:, :3, :3] @ [0.1, 0.05, 0.2] + SIGMA * rng.standard_normal((N, 3))
    write_table(path, dict(zip(machine.names, q.T, strict=True)) | dict(zip("xyz", position.T, strict=True)) | others)
    return path


def read(path: Path, *, in_order: bool = True) -> Measurements:
    """Return the rows of a table."""
    return read_measurements(path, Robot.from_urdf(kuka_urdf_path(), tip="tool0").joint_names, rows_in_order=in_order)


def test_sides_are_those_to_which_play_was_dragged(machine: sim.TrueMachine) -> None:
    """A joint lags half the play behind its last move, wherever the side is told; where it stands still it stays there."""
    rng = np.random.default_rng(3)
    q = np.repeat(sim.plan_poses(machine.nominal, 60, rng), rng.integers(1, 4, 60), axis=0)
    q[20:, 1] = q[20, 1] + np.cumsum(rng.choice([0.0, 3e-5, -3e-5, 0.2, -0.2], len(q) - 20))
    sides = sides_of(moves_by_order(q))
    told = sides[:, 1] != 0.0

    assert 0.5 < told.mean() < 0.95 and not sides[0].any()
    dragged, recorded = machine.tip(q), machine.tip(q, approach=sides)
    np.testing.assert_allclose(recorded[told], dragged[told], atol=1e-12)


def test_a_pose_that_is_read_again_came_from_where_it_came() -> None:
    """Encoders read each pose three times, 2 urad apart: one row for each pose, and no move of some micro-radians."""
    rng = np.random.default_rng(7)
    q = np.repeat(rng.uniform(-1.0, 1.0, (40, 6)), 3, axis=0) + rng.uniform(-2e-6, 2e-6, (120, 6))
    sides = sides_of(moves_by_order(q))

    np.testing.assert_array_equal(sides[3:], np.repeat(sides[3::3], 3, axis=0))
    rows = measurements_from_arrays("abcdef", q, position=np.zeros((120, 3)), approach=sides)
    # Of the first pose nobody knows where it came from.
    assert len(by_pose(rows)) == 40


def test_the_order_tells_only_what_has_no_column(machine: sim.TrueMachine, tmp_path: Path) -> None:
    """A column is read to the letter, the other joints follow the rows, and a warning says so; else nothing is guessed."""
    said = np.where(np.arange(N) % 2, 1.0, 0.0)
    path = table(machine, tmp_path / "rows.csv", approach_joint_3=said)
    with pytest.warns(
        PincalWarning, match="rows.csv: the direction of approach of joint_1, joint_2, joint_4.* the row before"
    ):
        rows = read(path)

    assert rows.approach is not None
    assert rows.approach_from == "the sign of the move from the row before; for joint_3 its column"
    assert "the direction of approach is the sign of" in str(note_on_sides("rows.csv", rows.approach_from))
    assert concatenate([rows, read(path, in_order=False)]).approach_from == f"{rows.approach_from}, {BY_COLUMNS}"
    np.testing.assert_array_equal(rows.approach[:, 2], said)
    np.testing.assert_array_equal(
        np.delete(rows.approach, 2, axis=1), np.delete(sides_of(moves_by_order(rows.q)), 2, axis=1)
    )
    alone = read(path, in_order=False)
    untold = alone.approach
    assert alone.approach_from == BY_COLUMNS and note_on_sides("rows.csv", BY_COLUMNS) is None
    assert untold is not None and not np.delete(untold, 2, axis=1).any()
    plain = read(table(machine, tmp_path / "plain.csv"), in_order=False)
    assert plain.approach is None and plain.move is None and not plain.approach_from


def test_moves_are_those_that_rows_or_times_tell(machine: sim.TrueMachine, tmp_path: Path) -> None:
    """Times tell the order by themselves unless poses share one; a joint that came from another side has no known moves."""
    plain = table(machine, tmp_path / "rows.csv")
    in_order, shuffled = read(plain), np.random.default_rng(5).permutation(N)
    time = np.empty(N)
    time[shuffled] = 20.0 * np.arange(N)
    timed = read(table(machine, tmp_path / "timed.csv", time=time), in_order=False)
    shared = read(table(machine, tmp_path / "shared.csv", time=time // 40.0), in_order=False)
    other = read(table(machine, tmp_path / "other.csv", approach_joint_3=np.resize([1.0, -1.0], N)))

    assert in_order.move is not None and timed.move is not None and other.move is not None
    np.testing.assert_array_equal(in_order.move, np.diff(in_order.q, axis=0, prepend=in_order.q[:1]))
    np.testing.assert_array_equal(timed.move[shuffled], moves_by_order(timed.q[shuffled]))
    assert timed.approach is None and shared.move is None
    assert not other.move[:, 2].any() and np.delete(other.move, 2, axis=1)[1:].all()
    joined = concatenate([timed, shared])
    assert joined.move is not None and not joined.move[N:].any()


@pytest.mark.long
@pytest.mark.parametrize(
    ("hidden", "name"),
    [(sim.ShortOfTarget(joint="joint_3", size=1e-4), "settling"), (sim.Backlash(joint="joint_3", size=2e-4), "backlash")],
)
def test_what_follows_the_last_move_is_told_from_play(
    machine: sim.TrueMachine, tmp_path: Path, hidden: sim.HiddenEffect, name: str
) -> None:
    """A drive that has not come to rest is no play, nor is play a drive that has not come to rest."""
    rows = read(table(replace(machine, effects=(hidden,)), tmp_path / "rows.csv"))
    fit = calibrate(Robot.from_urdf(kuka_urdf_path(), tip="tool0"), rows, Options(effects=GEOMETRIC, sigma=SIGMA))
    (step,) = discover_effects(fit.fit, row_groups(rows, split="blocked", seed=0) % 8).steps

    assert (step.effect.name, step.effect.locus.joint) == (name, "joint_3")


def test_times_say_the_order(machine: sim.TrueMachine, tmp_path: Path) -> None:
    """A pose that was measured again and put back in its place came from where the arm stood then."""
    in_order = read(table(machine, tmp_path / "rows.csv")).approach
    shuffled = np.random.default_rng(5).permutation(N)
    time = np.empty(N)
    time[shuffled] = 20.0 * np.arange(N)
    rows = read(table(machine, tmp_path / "timed.csv", time=time))
    odd = np.arange(N) % 2
    half = read(table(machine, tmp_path / "stations.csv", time=time, station=np.where(odd, "a", "b")))

    assert in_order is not None and rows.approach is not None
    np.testing.assert_array_equal(rows.approach[shuffled], sides_of(moves_by_order(rows.q[shuffled])))
    assert not np.array_equal(rows.approach, in_order)
    own = shuffled[odd[shuffled] == 1]
    assert half.approach is not None
    np.testing.assert_array_equal(half.approach[own], sides_of(moves_by_order(half.q[own])))


def test_the_reason_names_the_option() -> None:
    """Where nothing tells the side, play is not testable for the lack of a column, or of the word that rows are in order."""
    chain = Chain.of(Robot.from_urdf(kuka_urdf_path(), tip="tool0"))
    reasons = dict(untestable(chain, Conditions.at(np.random.default_rng(0).uniform(-1.0, 1.0, (30, 6)))))

    assert reasons[Backlash("joint_2")].startswith("column approach_<joint> is missing (")
    assert reasons[ShortOfTarget("joint_2")] == f"column time is missing ({RECORDABLE['move'].instead})"
    assert "--rows-in-order" in reasons[Backlash("joint_2")]
    assert "--rows-in-order" not in reasons[ThermalExpansion()]


@pytest.mark.long
def test_play_is_found_by_the_order_of_rows(machine: sim.TrueMachine, tmp_path: Path) -> None:
    """It is named at its joint, half of it either way; file and page say where the sides come from."""
    robot, rows = Robot.from_urdf(kuka_urdf_path(), tip="tool0"), read(table(machine, tmp_path / "rows.csv"))
    discovery = run_discovery(robot, rows, Options(effects=GEOMETRIC, sigma=SIGMA))
    (found,) = discovery.findings.effects
    assert discovery.report["approach_from"] == "the sign of the move from the row before"
    assert any("rows.csv: the direction of approach" in note.text for note in discovery.calibration.result.warnings)
    (half,) = found.parameters.values()

    assert (found.effect, found.joint) == ("backlash", "joint_2")
    assert abs(half.value) == pytest.approx(PLAY / 2, abs=3.0 * (half.sigma or 0.0))
