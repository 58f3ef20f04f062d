"""What changed midway in a table is found with its line and named; what drifts is no change."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from scipy.stats import beta

from pincal import Options, Robot, calibrate, measurements_from_arrays, run_calibration
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.identify.motion_fields import MotionField
from pincal.measure.measurements import Measurements
from pincal.model.effects import GEOMETRIC
from pincal.robot.urdf_file import find_file
from pincal.simulate.typical import draw_typical_elasticity, draw_typical_errors
from pincal.validate.causes import BETWEEN_ROWS, Event
from pincal.validate.midway import StepChange, change_in

URDF = kuka_urdf_path()
ROBOT = Robot.from_urdf(URDF)
NOISE, TARGET = 5e-5, np.array([0.1, 0.0, 0.2])
OTHER_TOOL = np.array([3e-4, 0.0, 4e-4])


def table(seed: int, *, change: str = "", cut: int = 0, noise: str = "white", n: int = 150) -> Measurements:
    """Return a table of a machine of the KUKA's type on which something changed at a row, in one of several noises."""
    rng = np.random.default_rng(seed)
    machine = sim.TrueMachine.from_urdf(URDF, tip="tool0").draw_errors(rng, sigma_length=5e-4, sigma_angle=5e-4)
    q = sim.plan_poses(machine.nominal, n, rng)
    if noise in ("walk", "heat"):
        q = q[np.argsort(q[:, 0])]
    true = q.copy()
    if change in machine.names:
        true[cut:, machine.names.index(change)] += 1e-3
    if noise == "joint":
        true[:, 1] += 1e-4 * rng.standard_normal(n)
    position = _read(machine, true, TARGET, seed)
    if change == "tool":
        position[cut:] = _read(machine, true, TARGET + OTHER_TOOL, seed)[cut:]
    if change == "instrument":
        position[cut:, 0] += 3e-4
    steps = rng.standard_normal((n, 3))
    if phi := {"ar": 0.9, "slow": 0.98}.get(noise):
        for i in range(1, n):
            steps[i] = phi * steps[i - 1] + np.sqrt(1.0 - phi**2) * steps[i]
        position += (NOISE if noise == "ar" else 2.0 * NOISE) * steps
    if noise == "walk":
        position += np.cumsum(1e-5 * steps, axis=0)
    if noise == "heat":
        # An arm of 12 ppm per kelvin that warms up by 14 K.
        warmed = 15.0 * (1.0 - np.exp(-np.linspace(0.0, 3.0, n)))
        position += 12e-6 * warmed[:, None] * (position - position.mean(axis=0))
    return measurements_from_arrays(machine.names, q, position=position)


WAVELENGTH = Event(
    "wavelength",
    # From the origin of the instrument, where the readings are zero.
    lambda cell: [MotionField("wavelength", cell.station.sensor.position[:, :, None])],
    step="lengths are longer by {size}: was the wavelength set anew?",
    drift="as if the air warmed up",
    visits="in proportion to their lengths",
    column="temperature",
)


def _read(machine: sim.TrueMachine, q: np.ndarray, target: np.ndarray, seed: int) -> np.ndarray:
    x, y, z = map(float, target)
    columns = sim.Instrument(targets=(x, y, z), sigma=NOISE).measure(machine, q, rng=np.random.default_rng(seed))
    return np.column_stack([columns[axis] for axis in "xyz"])


def seen(rows: Measurements) -> StepChange | None:
    """Return what changed midway, as a calibration would ask."""
    fit = calibrate(ROBOT, rows, Options(effects=GEOMETRIC))
    return change_in(fit.fit.station, fit.values, fit.solution.free, rows.rows)


CHANGES = [("tool", 5e-4), ("instrument", 3e-4), *((f"joint_{i}", 1e-3) for i in range(1, 7))]
# A milliradian of joint 6 is a tenth of a millimetre: as much as correlated noise makes anyway.
CASES = [(*change, "white") for change in CHANGES] + [(*change, "ar") for change in CHANGES[:-1]]


def some_first() -> Iterator[Any]:
    """Yield cases: a tool is in the default suite, the instrument and three joints are in long runs."""
    for k, case in enumerate(CASES):
        later = pytest.mark.long if k in (1, 3, 7, 9, 12) else (pytest.mark.long, pytest.mark.rates)
        yield pytest.param(case, marks=() if k == 0 else later)


@pytest.mark.parametrize("case", list(some_first()), ids=str)
def test_what_changed_midway_is_named_with_its_line(case: tuple[str, float, str]) -> None:
    """A milliradian of a joint, half a millimetre of the tool, three tenths of the instrument: the row to within three."""
    change, size, noise = case
    rows = table(3, change=change, cut=60, noise=noise)
    found = seen(rows)

    assert found is not None and abs(found.line - rows.rows[60]) <= 3
    (cause,) = [cause for cause in (found.cause, *found.others) if cause.name == change]
    assert cause.size == pytest.approx(size, rel=0.35 if change == "joint_6" else 0.2)


@pytest.mark.long
def test_a_long_shift_makes_no_other_robot() -> None:
    """A decimetre: it is what is wrong, and not the robot's description."""
    rows = table(3)
    assert rows.position is not None
    position = rows.position + np.where(np.arange(150)[:, None] < 60, 0.0, [0.06, 0.0, 0.08])
    moved = measurements_from_arrays(rows.joint_names, rows.q, position=position)
    result = run_calibration(ROBOT, moved, Options(effects=GEOMETRIC)).result

    assert "shifted by 100 mm" in result.shift and not result.doubt
    assert str(result.warnings[0]) == result.shift


@pytest.mark.long
def test_the_line_is_found_among_many_rows() -> None:
    """A tenth of 1500 rows tell that something changed; all of those near it tell where."""
    rows = table(5, change="joint_3", cut=900, n=1500)
    found = seen(rows)
    assert found is not None and found.cause.name == "joint_3" and abs(found.line - rows.rows[900]) <= 1


@pytest.mark.parametrize(
    "noise", ["white", *(pytest.param(noise, marks=pytest.mark.long) for noise in ("ar", "heat", "walk", "joint"))]
)
def test_a_table_in_which_nothing_changed_is_left_alone(noise: str) -> None:
    """Whatever its noise."""
    assert [seen(table(100 + seed, noise=noise)) for seed in range(3)] == [None] * 3


def elastic(seed: int, n: int, *, moved: float = 0.0) -> StepChange | None:
    """Return what changed midway in a table of a soft UR5 under a rigid model; readings are ``moved`` from row 20 on [m]."""
    rng = np.random.default_rng(seed)
    urdf = find_file("ur5")
    machine = draw_typical_errors(sim.TrueMachine.from_urdf(urdf, tip="tool0"), rng)
    machine = draw_typical_elasticity(machine, rng, scale=5.0)
    q = sim.plan_poses(machine.nominal, n, rng)
    columns = sim.Instrument(targets=(0.1, 0.05, 0.15), sigma=NOISE).measure(machine, q, rng=rng)
    position = np.column_stack([columns[axis] for axis in "xyz"])
    position[20:, 0] += moved
    robot = Robot.from_urdf(urdf, tip="tool0")
    rows = measurements_from_arrays(robot.joint_names, q, position=position)
    fit = calibrate(robot, rows, Options(effects=GEOMETRIC))
    return change_in(fit.fit.station, fit.values, fit.solution.free, rows.rows)


@pytest.mark.parametrize("seed", [104, pytest.param(122, marks=pytest.mark.long)])
def test_what_a_model_lacks_is_no_change(seed: int) -> None:
    """Of fifty poses some step explains much of what a rigid model lacks of a soft arm, in any order of the rows."""
    assert elastic(seed, 50) is None


def test_a_change_is_told_beside_what_a_model_lacks() -> None:
    """Of three millimetres, where a soft arm leaves 0.6 mm to a rigid model."""
    found = elastic(104, 50, moved=3e-3)
    assert found is not None and "instrument" in {cause.name for cause in (found.cause, *found.others)}


def test_a_joint_that_arrives_unevenly_was_not_remastered() -> None:
    """Rows scatter along its lever most; as if they did so in all directions, this was 0.11 mrad from a line on."""
    assert seen(table(9055, noise="joint")) is None


@pytest.mark.long
@pytest.mark.parametrize("joint", ["joint_2", "joint_3"])
def test_the_remastered_joint_is_told_from_one_that_arrives_unevenly(joint: str) -> None:
    """Joint 2 scatters by 0.1 mrad; of it and joint 3, whose levers are alike, the one a milliradian off is named."""
    found = seen(table(40, change=joint, cut=60, noise="joint"))
    assert found is not None and found.cause.name == joint and not found.others
    assert found.cause.size == pytest.approx(1e-3, rel=0.1)


@pytest.mark.long
def test_rows_that_are_held_out_are_no_step() -> None:
    """Noise that persists over some fifty rows goes on where forty of them are missing."""
    rows = [table(100 + seed, noise="slow").select(np.r_[:60, 100:150]) for seed in range(8)]
    assert [seen(part) for part in rows] == [None] * 8


@pytest.mark.long
@pytest.mark.rates
@pytest.mark.parametrize("noise", ["white", "ar", "walk", "heat", "joint"])
def test_drifts_are_no_changes(noise: str) -> None:
    """In sixty tables of each noise none is seen: at most 4.9 % by the exact 95 % interval, one-sided."""
    alarms = sum(seen(table(9000 + seed, noise=noise)) is not None for seed in range(60))
    assert alarms == 0 and beta.ppf(0.95, 1, 60) < 0.049


@pytest.mark.long
def test_an_event_that_is_added_is_named_with_its_words(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tracker that was set to another wavelength: of what is known nothing explains it; the new event does, alone."""
    every = (*BETWEEN_ROWS, WAVELENGTH)
    rows = table(3)
    position = rows.array("position").copy()
    position[80:] *= 1.0 + 3e-4
    changed = rows.with_readings(position=position)
    before = seen(changed)
    for module in ("causes", "midway"):
        monkeypatch.setattr(f"pincal.validate.{module}.BETWEEN_ROWS", every)
    found = seen(changed)

    assert before is None
    assert found is not None and found.cause.name == "wavelength" and found.others == ()
    assert abs(found.line - rows.rows[80]) <= 1
    longer = 3e-4 * float(np.sqrt(np.mean(np.sum(position[80:] ** 2, axis=1))))
    assert found.cause.size == pytest.approx(longer, rel=0.25)
    assert str(found) == f"lengths are longer by {1e3 * found.cause.size:.3g} mm: was the wavelength set anew?"
    assert seen(rows) is None
