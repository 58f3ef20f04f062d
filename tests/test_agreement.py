"""A table that is not what it seems is refused with what is wrong with it, found by trying; sound tables are not."""

import contextlib
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from command_line import run
from placed_arms import FIRST, NOISE, TOOL, measured, written
from scipy.spatial.transform import Rotation

from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.calibration.calibration import run_calibration
from pincal.errors import MeasurementError
from pincal.identify.calibrate import fit_tables
from pincal.identify.fit import ModelFit
from pincal.identify.options import Options
from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.measure.table import read_measurements
from pincal.model.effects import GEOMETRIC
from pincal.robot.robot import Robot
from pincal.robot.urdf_file import find_file
from pincal.validate import trials
from pincal.validate.agreement import implausible
from pincal.validate.cures import Case
from pincal.validate.gathered import in_common
from pincal.validate.midway import change_in
from pincal.validate.trials import PlausibleResiduals, Trials

SHARED = next((folder / "shared" for folder in Path(__file__).resolve().parents if (folder / "shared/data").is_dir()), None)
Change = Callable[[Measurements], Measurements]


def moved(q: np.ndarray, column: int, rows: int) -> np.ndarray:
    """Return joint positions of which one column is that of some rows before."""
    found = q.copy()
    found[:, column] = np.roll(found[:, column], rows)
    return found


def placed(table: Measurements, change: Callable[[np.ndarray], np.ndarray]) -> Measurements:
    """Return a table with other positions."""
    return table.with_readings(position=change(table.readings["position"]))


def turned(table: Measurements, change: Callable[[np.ndarray], np.ndarray]) -> Measurements:
    """Return a table with other orientations."""
    return table.with_readings(quaternion=change(table.readings["quaternion"]))


WRONG: dict[str, tuple[Change, str]] = {
    "a column late": (lambda t: replace(t, q=moved(t.q, 1, 1)), "'joint_2' appears to be 1 row late"),
    "a column early": (lambda t: replace(t, q=moved(t.q, 3, -1)), "'joint_4' appears to be 1 row early"),
    "all joints late": (lambda t: replace(t, q=np.roll(t.q, 1, axis=0)), "all joint columns appear to be 1 row late"),
    "lengths short": (lambda t: placed(t, lambda p: 0.9 * p), "the measured lengths appear scaled by 0.9"),
    "axes swapped": (
        lambda t: placed(t, lambda p: p[:, [1, 0, 2]]),
        "'x' and 'y' appear to be swapped, or the frame is left-handed",
    ),
    "joints swapped": (lambda t: replace(t, q=t.q[:, [0, 1, 2, 5, 4, 3]]), "'joint_4' and 'joint_6' appear to be swapped"),
}
STOOD = 0.03 * np.random.default_rng(3).normal(size=(160, 6))  # [rad], beside where the table has it
WRONG |= {
    "commanded elsewhere": (
        lambda t: replace(t, q=t.q + STOOD, droop=STOOD),
        "joints stood at their read-back positions, not",
    ),
    "read elsewhere": (lambda t: replace(t, q=t.q + STOOD, droop=-STOOD), "joints stood at their commanded positions, not"),
    "all joints four rows early": (
        lambda t: replace(t, q=np.roll(t.q, -4, axis=0)),
        "all joint columns appear to be 4 rows early",
    ),
}
TURNED: dict[str, tuple[Change, str]] = {
    "axis turned": (lambda t: placed(t, lambda p: p * [1, -1, 1]), "'y' appears to have the wrong sign"),
    "w first": (lambda t: turned(t, lambda v: v[:, [3, 0, 1, 2]]), "written with w first: "),
    "left-handed": (
        lambda t: turned(placed(t, lambda p: p[:, [1, 0, 2]]), lambda v: v[:, [1, 0, 2, 3]] * [-1, -1, -1, 1]),
        "the frame of the readings appears to be left-handed",
    ),
    "inverse": (lambda t: turned(t, lambda v: v * [-1, -1, -1, 1]), "appears to be inverted"),
}


@pytest.fixture(scope="module")
def table(machine: sim.TrueMachine, kuka: Robot) -> Measurements:
    """Return what a tracker reads of it."""
    return measured(machine, kuka, poses=160)


@pytest.fixture(scope="module")
def poses(machine: sim.TrueMachine, kuka: Robot) -> Measurements:
    """Return what a tracker with orientations reads of it."""
    rng = np.random.default_rng(2)
    instrument = sim.Instrument(reads="pose", pose=FIRST, targets=TOOL, sigma=NOISE, sigma_angle=1e-4)
    q = kuka.random_configurations(120, rng)
    read = instrument.measure(machine, q, rng=rng)
    position, quaternion = (np.column_stack([read[c] for c in names.split()]) for names in ("x y z", "qx qy qz qw"))
    return measurements_from_arrays(kuka.joint_names, q, position=position, quaternion=quaternion)


def fitted(robot: Robot, table: Measurements) -> ModelFit:
    """Return a fit of the geometry, without the checks."""
    return fit_tables(robot, {"": table.in_order_of(robot)}, Options(effects=GEOMETRIC))


# One mistake of each kind is told from all others before each commit; the others there from those of a table alone, as
# other descriptions of the robot take more than half of the time to try. Of late rows and of axes that are wrong one each.
OF_EACH_KIND = ("a column late", "lengths short", "commanded elsewhere")


def among_what() -> Iterator[Any]:
    """Yield mistakes, and whether each is told from other descriptions of the robot as well."""
    for what in WRONG:
        if what not in OF_EACH_KIND:
            later = pytest.mark.rates if what in ("all joints four rows early", "axes swapped") else ()
            yield pytest.param(what, False, id=f"{what}, of those of a table", marks=later)
        yield pytest.param(what, True, id=what, marks=() if what in OF_EACH_KIND else pytest.mark.rates)


@pytest.mark.long
@pytest.mark.parametrize(("what", "is_of_all"), list(among_what()))
def test_what_is_wrong_with_a_table_is_named(
    kuka: Robot, table: Measurements, what: str, is_of_all: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The one thing that, undone, makes the table fit: each of the mistakes that people make."""
    change, words = WRONG[what]
    if not is_of_all:
        monkeypatch.setattr(trials.Trials, "described", lambda *_, **__: None)
    with pytest.raises(MeasurementError, match=words):
        run_calibration(kuka, change(table), Options(effects=GEOMETRIC))


@pytest.mark.long
@pytest.mark.parametrize(
    "what", [pytest.param(what, marks=pytest.mark.rates) if what == "axis turned" else what for what in TURNED]
)
def test_wrong_orientations_are_named(kuka: Robot, poses: Measurements, what: str) -> None:
    """With orientations it is told which axis is wrong; the positions alone would fit."""
    change, words = TURNED[what]
    assert not list(implausible(fitted(kuka, poses), [poses]))
    with pytest.raises(MeasurementError, match=words):
        run_calibration(kuka, change(poses), Options(effects=GEOMETRIC))


@pytest.mark.long
@pytest.mark.parametrize(("turned", "times"), [(False, 1), (True, 2)])
def test_positions_are_searched_alone_where_orientations_may_hide_something(
    kuka: Robot, poses: Measurements, turned: bool, times: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Positions that no arm explains, beside orientations that it does, were searched for mistakes twice."""
    monkeypatch.setattr(trials.Trials, "described", lambda *_, **__: None)
    searched, cures = list[bool](), trials.Trials.cures
    monkeypatch.setattr(
        trials.Trials, "cures", lambda self, error: searched.append(self.case.table.has_orientations) or cures(self, error)
    )
    wave = 0.03 * np.sin(poses.q @ np.array([[0.0, 5.0, 3.0, 0.0, 0.0, 0.0]] * 3).T + np.arange(3.0))
    wavy = poses.with_readings(position=poses.position + wave)
    if turned:
        wavy = wavy.with_readings(quaternion=Rotation.random(len(wavy), rng=np.random.default_rng(3)).as_quat())
    with contextlib.suppress(MeasurementError):
        run_calibration(kuka, wavy, Options(effects=GEOMETRIC))
    assert searched == [True, False][:times]


# Real tables are told either way below.
@pytest.mark.long
@pytest.mark.rates
@pytest.mark.parametrize(("mine", "true"), [("ur5", "ur10"), ("ur10", "ur5")])
def test_the_table_of_another_robot_is_told(mine: str, true: str) -> None:
    """A UR10 is told from a UR5 whose joints have the same names."""
    robot = Robot.from_urdf(mine, tip="tool0")
    machine = sim.TrueMachine.from_urdf(find_file(true), tip="tool0")
    with pytest.raises(MeasurementError, match=f"appears to be of a {true}: .*give the URDF of that robot"):
        run_calibration(robot, measured(machine, robot, poses=120), Options(effects=GEOMETRIC))


@pytest.mark.long
def test_what_nothing_cures_is_not_to_be_used(
    tmp_path: Path, table: Measurements, capsys: pytest.CaptureFixture[str]
) -> None:
    """Readings that scatter by a centimetre: exit 4, the reason in words; declared as noise they are what they are."""
    rough = placed(table, lambda p: p + np.random.default_rng(0).normal(size=p.shape) * 0.01)
    file = written(tmp_path / "rough.csv", rough)
    command = ("calibrate", kuka_urdf_path(), file, "--model", "geometric", "--quiet", "--out", tmp_path / "out")
    assert run(*command) == 4
    told = capsys.readouterr().err
    assert "do not use" in told and "too large for any calibrated arm" in told and "--noise" in told
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Use it" not in page and "too large for any calibrated arm" in page
    assert run(*command, "--noise", "10mm") == 0


@pytest.mark.long
def test_a_strange_table_costs_a_fixed_number_of_fits(
    kuka: Robot, table: Measurements, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All cures are looked at where they would stand, the likeliest are fitted: as many for any number of joints."""
    monkeypatch.setattr(trials.Trials, "described", lambda *_, **__: None)
    looked, fits = list[int](), list[int]()
    left, placed = trials.least_size, trials.roughly_placed
    monkeypatch.setattr(trials, "least_size", lambda *given: looked.append(1) or left(*given))
    monkeypatch.setattr(trials, "roughly_placed", lambda *given: fits.append(1) or placed(*given))
    monkeypatch.setattr(trials, "minimize_scalar", lambda *_, **__: SimpleNamespace(x=0.1))
    order = np.random.default_rng(0).permutation(len(table))
    with pytest.raises(MeasurementError, match="with only base and tool fitted"):
        run_calibration(kuka, replace(table, q=table.q[order]), Options(effects=GEOMETRIC))
    assert len(looked) > 80
    # Beside the likeliest, the rows as they are, once to be refused and once to tell what a cure removes.
    assert len(fits) == trials._PLACED + 2


def test_a_noisy_instrument_may_be_declared_in_the_table(kuka: Robot, table: Measurements) -> None:
    """Readings that scatter by a centimetre are doubted, unless a column says so."""
    rough = placed(table, lambda p: p + np.random.default_rng(0).normal(size=p.shape) * 0.01)
    declared = replace(rough, sigma=np.full(len(rough), 0.01))
    assert [len(list(implausible(fitted(kuka, t), [t]))) for t in (rough, declared)] == [1, 0]


@pytest.mark.parametrize("size", [3e-4, pytest.param(2e-3, marks=pytest.mark.long)])
def test_a_touched_instrument_is_noticed(kuka: Robot, table: Measurements, size: float) -> None:
    """From the hundredth row on all readings are shifted: the row and the size are told."""
    shift = np.where(np.arange(len(table))[:, None] < 100, 0.0, np.array([0.6, -0.8, 0.0]) * size)
    fit = fitted(kuka, placed(table, lambda p: p + shift))
    found = change_in(fit.station, fit.values, fit.solution.free, table.rows)

    assert found is not None and found.cause.name == "instrument"
    assert abs(found.line - table.rows[100]) <= (3 if size < 1e-3 else 0)
    assert found.cause.size == pytest.approx(size, rel=0.25)


def test_an_untouched_instrument_is_not_suspected(machine: sim.TrueMachine, kuka: Robot) -> None:
    """In eight tables, in random order and along the joints, no step is seen."""
    for seed in range(8):
        table = measured(machine, kuka, poses=100, seed=seed)
        if seed % 2:
            table = table.select(np.lexsort(np.round(table.q[:, :2], 0).T))
            table = replace(table, rows=np.sort(table.rows))
        fit = fitted(kuka, table)
        assert change_in(fit.station, fit.values, fit.solution.free, table.rows) is None


def test_what_outliers_have_in_common_is_told(kuka: Robot, table: Measurements) -> None:
    """A part of the rows, a region, a joint that was read wrong; nothing where they are any."""
    fit, rng, n = fitted(kuka, table), np.random.default_rng(0), len(table)
    first, some = np.arange(n) < 50, rng.permutation(n) < 50
    region = table.q[:, 1] > np.quantile(table.q[:, 1], 0.7)
    q = table.q.copy()
    q[some, 2] += 5e-3
    station = replace(fit.station, conditions=replace(fit.station.conditions, q=q))

    assert in_common(fit.station, fit.values, table, first) == f"nearly all of them have line at most {table.rows[49]}"
    assert "joint_2 at least" in in_common(fit.station, fit.values, table, region)
    assert in_common(station, fit.values, table, some) == "joint_3 appears to be misread by 5 mrad in them"
    assert in_common(fit.station, fit.values, table, some) == ""


def test_a_third_of_the_rows_is_no_exception(kuka: Robot, table: Measurements) -> None:
    """Rows that were left out say where they are, and the result that it is no calibration."""
    wrong = np.arange(len(table)) % 3 == 0
    off = np.random.default_rng(1).normal(size=(len(table), 3)) * 0.02 * wrong[:, None]
    result = run_calibration(kuka, placed(table, lambda p: p + off), Options(effects=GEOMETRIC), split="random").result

    assert len(result.outliers) > 30
    assert "rows do not fit the others, so the calibration is rejected" in result.doubt
    assert result.doubt == result.warnings[0].text and result.warnings[0].is_doubt


def causes_found(robot: Robot, table: Measurements) -> list[str]:
    """Return the causes that are found where a fit left fifty times what is plausible, as from a bad start."""
    limits = PlausibleResiduals(0.002 * robot.reach, 0.02)
    return [cure.mistake.words for cure in Trials(Case(robot, table), limits, Options(effects=GEOMETRIC)).cures(50.0)]


@pytest.mark.long
@pytest.mark.parametrize("rows", [24, pytest.param(160, marks=pytest.mark.rates)])
def test_what_the_errors_of_an_arm_explain_has_no_cause(kuka: Robot, table: Measurements, rows: int) -> None:
    """Placed once more the same rows fit: neither a scale that rounds to 1 nor anything else did that."""
    assert causes_found(kuka, table.select(slice(0, rows))) == []
    short = placed(table, lambda p: 0.9 * p).select(slice(0, rows))
    assert causes_found(kuka, short) == ["the measured lengths appear scaled by 0.9"]


@pytest.mark.long
@pytest.mark.skipif(SHARED is None, reason="needs the data sets that are shared beside the repository")
@pytest.mark.parametrize("rows", [40, pytest.param(200, marks=pytest.mark.rates)])
@pytest.mark.parametrize(
    ("mine", "file"),
    [("ur5", "ur5_tracker/grid.csv"), pytest.param("ur10", "ur10_tmac/series_B.csv", marks=pytest.mark.rates)],
)
def test_some_rows_of_a_real_table_have_no_cause(mine: str, file: str, rows: int) -> None:
    """As measured, and with the errors that arms of one type differ by on top."""
    assert SHARED is not None
    robot = Robot.from_urdf(mine)
    table = read_measurements(os.fspath(SHARED / "data" / file), robot.joint_names)
    rng = np.random.default_rng(rows)
    some = table.select(np.sort(rng.permutation(len(table))[:rows]))
    assert causes_found(robot, some) == []
    off = replace(some, q=some.q + 2e-3 * rng.standard_normal(robot.n_joints))
    assert causes_found(robot, off) == []


@pytest.mark.long
@pytest.mark.skipif(SHARED is None, reason="needs the data sets that are shared beside the repository")
@pytest.mark.parametrize(
    ("mine", "file", "words"),
    [
        ("ur10", "ur5_tracker/grid.csv", "appears to be of a ur5: .*give the URDF of that robot"),
        ("ur5", "ur10_tmac/series_B.csv", "appears to be of a ur10: .*give the URDF of that robot"),
        ("ur5", "ur5_tracker/grid.csv", ""),
        ("ur10", "ur10_tmac/series_B.csv", ""),
        ("panda", "panda_sockets/panda_3.csv", ""),
    ],
)
def test_real_tables(mine: str, file: str, words: str) -> None:
    """Real arms pass, and are told from each other."""
    assert SHARED is not None
    robot = Robot.from_urdf(mine)
    table = read_measurements(os.fspath(SHARED / "data" / file), robot.joint_names)
    if words:
        with pytest.raises(MeasurementError, match=words):
            run_calibration(robot, table, Options(effects=GEOMETRIC))
        return
    found = run_calibration(robot, table, Options(effects=GEOMETRIC)).result
    assert found.doubt == "" and found.shift == ""
