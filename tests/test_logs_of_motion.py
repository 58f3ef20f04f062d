"""Logs of an arm that moves as loggers write them: names, clocks, targets that are lost, joints that are mistaken."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.errors import MeasurementError, PincalWarning
from pincal.measure.labels import Label, joint_families, vector_columns
from pincal.measure.table import write_table
from pincal.motion.clocks import Clock, aligned
from pincal.motion.joint_path import JointPath
from pincal.motion.moving_arm import MovingArm
from pincal.motion.polling import at_even_samples, at_samples
from pincal.motion.sessions import Session, read_streams
from pincal.motion.stamps import in_order
from pincal.motion.starts import start_imu
from pincal.motion.stations import session_tables
from pincal.motion.stream import Stream, checked_imu, interpolated
from pincal.robot.robot import Robot
from pincal.simulate.moving import draw_path
from pincal.simulate.session import Clock as TrueClock
from pincal.simulate.session import ImuSetup, MovingSession

ROBOT = Robot.from_urdf(kuka_urdf_path())
JOINTS = ROBOT.joint_names
SECONDS = 40.0
OFFSET = -0.9
# Since when the joints count their seconds.
SINCE = 1.6e9
Table = dict[str, np.ndarray]
Tables = dict[str, Table]


@pytest.fixture(scope="module")
def logs() -> Tables:
    """Return what joints, an IMU and a tracker log of a path; the clocks of the last two are off."""
    rng = np.random.default_rng(3)
    machine = sim.TrueMachine.from_urdf(ROBOT.urdf.decode(), tip=ROBOT.tip, base=ROBOT.base)
    tracker = sim.Instrument(reads="pose", pose=np.eye(4), targets=(0.05, 0.1, 0.2), sigma=3e-5, sigma_angle=3e-5)
    session = MovingSession(
        path=draw_path(machine.nominal, SECONDS, rng),
        duration=SECONDS,
        imu=ImuSetup.draw(rng, acc_density=0.01, gyro_density=1.7e-4, vibration=0.05),
        tracker=tracker,
        clocks={"imu": TrueClock(0.4, 2e-5, 20.0), "tracker": TrueClock(OFFSET, 5e-5, 20.0)},
        resolution=2e-5,
        rates={"joints": 100.0, "imu": 100.0, "tracker": 60.0},
    )
    return session.measure(machine, rng)


def copied(tables: Tables) -> Tables:
    return {name: {column: values.copy() for column, values in table.items()} for name, table in tables.items()}


def read(folder: Path, tables: Tables, **options: object) -> tuple[Session, str]:
    """Return the session of tables, and all that is said of them."""
    for name, table in tables.items():
        write_table(folder / f"{name}.csv", table)
    files = {name: folder / f"{name}.csv" for name in tables}
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", PincalWarning)
        session = read_streams(ROBOT, **files, **options)  # type: ignore[arg-type]
    return session, "\n".join(str(each.message) for each in told)


def laid(session: Session) -> tuple[float, int, str]:
    """Return offset of the tracker's clock and rows of it on the motion of the arm, and what is said."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", PincalWarning)
        tables = session_tables(ROBOT, [session])
    table = tables["tracker"] if "tracker" in tables else next(iter(tables.values()))
    assert table.moving is not None
    offset, drift, middle = table.moving.clock
    return offset - drift * (middle - 20.0), len(table), "\n".join(str(each.message) for each in told)


def named(tables: Tables, which: str, names: Callable[[str], str]) -> Tables:
    return tables | {which: {names(column): values for column, values in tables[which].items()}}


def ros(column: str) -> str:
    """Return the name of a column of an IMU or a tracker as in a recording that is written as text."""
    kinds = {"a": "linear_acceleration", "w": "angular_velocity", "q": "pose.orientation"}
    if column == "time":
        return "__time"
    return f"/device/data/{kinds[column[0]]}/{column[1]}" if len(column) == 2 else f"/device/data/pose.position.{column}"


IMUS: dict[str, Callable[[str], str]] = {
    "acc_x, gyro_x": lambda c: {"a": "acc_", "w": "gyro_"}.get(c[0], c[0]) + c[1:],
    "AccX, GyrX": lambda c: {"a": "Acc", "w": "Gyr"}.get(c[0], c[0]) + (c[1:].upper() if len(c) == 2 else c[1:]),
    "a recording of ROS": ros,
    "with units": lambda c: (
        c
        if c == "time"
        else f"{ {'a': 'Acceleration', 'w': 'Gyroscope'}[c[0]] } {c[1]} ({'m/s^2' if c[0] == 'a' else 'rad/s'})"
    ),
}


@pytest.mark.parametrize("style", IMUS)
def test_an_imu_is_known_by_the_names_of_loggers(logs: Tables, style: str, tmp_path: Path) -> None:
    """Which axes they are is said, and they are what they are under their own names."""
    tables = {name: logs[name] for name in ("joints", "imu")}
    plain = read(tmp_path, tables)[0].imu
    found, told = read(tmp_path, named(tables, "imu", IMUS[style]))
    assert plain is not None and found.imu is not None
    for name, values in plain.readings.items():
        np.testing.assert_array_equal(found.imu.readings[name], values)
    assert "interpreted by their names" in told and "=wz" in told


def test_poses_and_joints_of_a_recording_that_is_text(logs: Tables, tmp_path: Path) -> None:
    """Topics before, fields behind; velocities beside positions are not taken for them, and said not to be read."""
    tables = named({name: logs[name] for name in ("joints", "tracker")}, "tracker", ros)
    joints = logs["joints"]
    tables["joints"] = {"header.stamp.sec": np.floor(joints["time"]), "header.stamp.nanosec": 1e9 * (joints["time"] % 1.0)}
    for name in JOINTS:
        tables["joints"] |= {f"/joint_states/{name}/velocity": np.gradient(joints[name])}
        tables["joints"] |= {f"/joint_states/{name}/position": joints[name]}
    found, told = read(tmp_path, tables)
    assert found.tracker is not None
    np.testing.assert_array_equal(found.joints.readings["q"], np.column_stack([joints[name] for name in JOINTS]))
    np.testing.assert_allclose(found.joints.time, joints["time"], atol=1e-9)
    np.testing.assert_allclose(found.tracker.readings["quaternion"][:, 3], logs["tracker"]["qw"])
    assert 'the time is "header.stamp.sec" and "header.stamp.nanosec"' in told
    assert 'columns that are not read: "/joint_states/joint_1/velocity"' in told


def test_numbered_joints_stand_in_the_order_of_their_names(logs: Tables, tmp_path: Path) -> None:
    """Beside names, as recordings have them sorted by the alphabet; without, from the base to the flange."""
    joints = logs["joints"]
    tables: Tables = {"joints": {"time": joints["time"]}, "imu": logs["imu"]}
    tables["joints"] |= {f"field.position{k}": joints[name] for k, name in enumerate(JOINTS)}
    q = np.column_stack([joints[name] for name in JOINTS])
    np.testing.assert_array_equal(read(tmp_path, tables)[0].joints.readings["q"], q)

    tables["joints"] |= {f"field.name{k}": np.full(len(q), name) for k, name in enumerate(JOINTS[::-1])}
    np.testing.assert_array_equal(read(tmp_path, tables)[0].joints.readings["q"], q[:, ::-1])
    tables["joints"] = {"time": joints["time"]} | {f"q{k}": joints[JOINTS[min(k, 5)]] for k in range(7)}
    with pytest.raises(MeasurementError, match=r'joints.csv: "q0" to "q6" number 7 joints; expected 6.*--ignore q6'):
        read(tmp_path, tables)


def test_columns_that_may_be_two_things_are_refused() -> None:
    """Two IMUs, raw and filtered forces: which one, is for the user to say; two arms likewise."""
    texts = [f"{name}_{axis}" for name in ("acc", "linear_acc", "gyro") for axis in "xyz"]
    labels, known = [Label(i, text, text) for i, text in enumerate(texts)], dict.fromkeys(("ax", "ay", "az"), "acceleration")
    with pytest.raises(MeasurementError, match=r'ax ay az may be the columns of "acc_x" and "linear_acc_x"; .*--columns'):
        vector_columns(labels, known, is_stream=True, source="imu.csv")
    arms = [Label(i, text, text) for i, text in enumerate(("left_elbow_joint", "right_elbow_joint"))]
    assert len(joint_families(arms, ["elbow_joint"])) == 2


@pytest.mark.parametrize("style", ["Acc{0}(G) Gyro{0}(°/s)", "accel_{1}_g gyro_{1}_dps", "A_{0}[mg] G_{0}[mdps]"])
def test_a_unit_is_no_name(style: str) -> None:
    """The g of an acceleration is none of a gyroscope, and each unit is that of its own columns."""
    texts = [part.format(axis.upper(), axis) for part in style.split() for axis in "xyz"]
    labels = [Label(i, text.replace("[", " ["), text) for i, text in enumerate(texts)]
    known = dict.fromkeys(("ax", "ay", "az"), "acceleration") | dict.fromkeys(("wx", "wy", "wz"), "angular rate")
    units = {"Acc": ("g", "°/s"), "acc": ("g", "dps"), "A_{": ("mg", "mdps")}[style[:3]]
    expected = [f"{letter}{axis} [{unit}]" for letter, unit in zip("aw", units, strict=True) for axis in "xyz"]
    assert list(vector_columns(labels, known, is_stream=True).values()) == expected


def test_what_a_name_means_is_said_once_for_all_files(logs: Tables, tmp_path: Path) -> None:
    """Of a column that only one of them has; one that none has is refused."""
    order = dict(zip(("qx", "qy", "qz", "qw"), ("q0", "q1", "q2", "q3"), strict=True))
    tables = named({name: logs[name] for name in ("joints", "tracker")}, "tracker", lambda column: order.get(column, column))
    found, told = read(tmp_path, tables)
    assert found.tracker is not None and list(found.tracker.readings) == ["position"]
    assert "q0 q1 q2 q3 may be a quaternion in either order, and are left out" in told
    found, _ = read(tmp_path, tables, columns={name: column for column, name in order.items()})
    assert found.tracker is not None and list(found.tracker.readings) == ["position", "quaternion"]
    with pytest.raises(MeasurementError, match='no column "nothing"'):
        read(tmp_path, tables, columns={"nothing": "qx"})


def test_a_time_since_1970_is_read_in_its_unit(logs: Tables, tmp_path: Path) -> None:
    """Nanoseconds of a stamp, milliseconds; the stamp of a device goes before that of who recorded it."""
    joints = logs["joints"]
    q = {name: joints[name] for name in JOINTS}
    for unit, size in (("ns", 1e9), ("ms", 1e3)):
        table = {"%time": joints["time"] + 7.0, "field.header.stamp": size * (SINCE + joints["time"])} | q
        found, told = read(tmp_path, {"joints": table, "imu": logs["imu"]})
        np.testing.assert_allclose(found.joints.time, SINCE + joints["time"], atol=1e-6)
        assert f'"field.header.stamp" is read as time [{unit}]' in told


def hold(values: np.ndarray, rows: np.ndarray) -> None:
    """Let values stand still in some rows."""
    for k in np.flatnonzero(rows):
        values[k] = values[k - 1]


def lost_rows(count: int) -> np.ndarray:
    """Return rows of several stretches, from two to a hundred long, a sixth of all."""
    rows = np.zeros(count, bool)
    for k, begin in enumerate(np.linspace(0.1, 0.9, 8) * count):
        rows[int(begin) : int(begin) + (2, 5, 30, 100)[k % 4]] = True
    return rows


@pytest.mark.parametrize("lost", ["zeros", "held", "-1"])
def test_a_target_that_is_lost_is_left_out(logs: Tables, lost: str, tmp_path: Path) -> None:
    """Zeros, the last reading or another value in its place are counted, and the clock is that of the other rows."""
    tables = copied({name: logs[name] for name in ("joints", "tracker")})
    rows = lost_rows(len(tables["tracker"]["x"]))
    for column in ("x", "y", "z", "qx", "qy", "qz", "qw"):
        if lost == "held":
            hold(tables["tracker"][column], rows)
        else:
            tables["tracker"][column][rows] = 0.0 if lost == "zeros" else -1.0
    if lost == "-1":
        tables["tracker"] = {column: tables["tracker"][column] for column in ("time", "x", "y", "z")}
    session, told = read(tmp_path, tables)
    offset, count, said = laid(session)
    assert offset == pytest.approx(OFFSET, abs=2e-3)
    first = int(np.flatnonzero(rows)[0]) + 2
    match = re.search(r"tracker\.csv: (\d+) of \d+ rows, the first in line (\d+),", told + said)
    assert match is not None and int(match[1]) == pytest.approx(rows.sum(), abs=4) and int(match[2]) - first in (0, 1)
    assert count == pytest.approx(len(rows) - rows.sum() - 60, abs=60)

    tables["tracker"]["x"][: int(0.7 * len(rows))] = tables["tracker"]["y"][: int(0.7 * len(rows))] = 0.0
    tables["tracker"]["z"][: int(0.7 * len(rows))] = 0.0
    with pytest.raises(MeasurementError, match=r"tracker.csv: \d+ of \d+ rows.* 0 in x y z: the target was lost; expected"):
        read(tmp_path, tables)


def test_readings_of_something_else_are_left_out(logs: Tables, tmp_path: Path) -> None:
    """Single ones that jump off those beside them; the clock is that of the others, of which none is missed."""
    tables, rng = copied({name: logs[name] for name in ("joints", "tracker")}), np.random.default_rng(0)
    rows = np.sort(rng.choice(np.arange(600, 1800, 6), 40, replace=False))
    tables["tracker"]["z"][rows] += rng.choice([-0.8, 0.8], 40)
    clean, jumps = (laid(read(tmp_path, each)[0]) for each in (logs, tables))
    assert "tracker.csv: 40 of 2400 rows" in jumps[2] and "are outliers" in jumps[2]
    assert "tracker.csv" not in clean[2] and jumps[1] == clean[1] - 40
    assert jumps[0] == pytest.approx(clean[0], abs=1e-4)


def test_an_instrument_of_few_digits_keeps_its_rows(logs: Tables, tmp_path: Path) -> None:
    """Steps of 10 mm repeat where the arm is slow; nothing of that is lost, and a log that is too fast is told."""
    tracker, joints = logs["tracker"], logs["joints"]
    time = np.arange(tracker["time"][0], tracker["time"][-1], 1.0 / 240.0)
    coarse = {"time": time} | {axis: np.round(np.interp(time, tracker["time"], tracker[axis]), 2) for axis in "xyz"}
    again = np.all(np.diff(np.column_stack([coarse[axis] for axis in "xyz"]), axis=0) == 0.0, axis=1)
    offset, _, said = laid(read(tmp_path, {"joints": joints, "tracker": coarse})[0])
    assert again.mean() > 0.3 and not said
    assert offset == pytest.approx(OFFSET, abs=3e-3)

    fast = np.searchsorted(tracker["time"], time, side="right") - 1
    twice = {"time": time} | {axis: tracker[axis][fast] for axis in "xyz"}
    offset, count, said = laid(read(tmp_path, {"joints": joints, "tracker": twice})[0])
    assert re.search(r"tracker\.csv: 7\d\d\d of 9\d\d\d rows, .* the log is too fast; they are left out", said)
    assert count == pytest.approx(2300, abs=100) and offset == pytest.approx(OFFSET - 0.5 / 240.0, abs=1e-3)


def test_sensors_of_an_imu_that_are_read_no_more_are_left_out(logs: Tables, tmp_path: Path) -> None:
    """Rates that are zeros or stay the same while forces go on, of which no axis stands still for long."""
    tables = copied({name: logs[name] for name in ("joints", "imu")})
    rows = lost_rows(len(tables["imu"]["wx"])) & np.append(True, ~np.isin(np.arange(1, 4000), np.array([400, 401])))
    for name in ("wx", "wy", "wz"):
        tables["imu"][name][rows] = 0.0
    session, told = read(tmp_path, tables)
    assert session.imu is not None
    match = re.search(r"imu\.csv: (\d+) of 4\d\d\d rows, the first in line \d+, have constant forces or rates", told)
    assert match is not None and int(match[1]) == pytest.approx(rows.sum(), abs=6)
    assert np.abs(session.imu.readings["angular_rate"]).min(axis=1).max() > 0.0


def test_joints_that_are_interrupted_go_on_behind_the_gap(logs: Tables, tmp_path: Path) -> None:
    """Positions that stay the same and jump, zeros for a moment, a turn that begins anew at half of it."""
    tables = copied({name: logs[name] for name in ("joints", "tracker")})
    rows = np.zeros(len(tables["joints"]["time"]), bool)
    rows[1000:1120], rows[2500:2503], rows[3000] = True, True, True
    true = np.column_stack([tables["joints"][name] for name in JOINTS])
    for name in JOINTS:
        hold(tables["joints"][name], rows & (np.arange(len(rows)) < 2000))
        tables["joints"][name][2500:2503] = tables["joints"][name][3000] = 0.0
    session, told = read(tmp_path, tables)
    kept = session.joints.lines - 2
    assert not rows[kept].any() and len(kept) > len(rows) - rows.sum() - 3
    np.testing.assert_allclose(session.joints.readings["q"], true[kept], atol=1e-9)
    assert "joints.csv: 124 of 4000 rows, the first in line 1002, repeat the previous one, or are off the motion" in told
    assert laid(session)[0] == pytest.approx(OFFSET, abs=2e-3)

    tables["joints"] = {"time": tables["joints"]["time"]} | dict(zip(JOINTS, true.T.copy(), strict=True))
    turning = JOINTS[5]
    tables["joints"][turning] = np.mod(true[:, 5] - true[2000, 5], 2.0 * np.pi) - np.pi
    session, told = read(tmp_path, tables)
    assert f"{turning} jumps by a revolution; it is assumed to continue" in told
    assert np.abs(np.diff(session.joints.readings["q"][:, 5])).max() < 0.1


def reversed_sign(table: Table) -> None:
    table[JOINTS[4]] *= -1.0


def exchanged(table: Table) -> None:
    table[JOINTS[1]], table[JOINTS[2]] = table[JOINTS[2]], table[JOINTS[1]]


def in_degrees(table: Table) -> None:
    for name in JOINTS:
        table[name] = np.degrees(table[name])


def appended(table: Table) -> None:
    table[JOINTS[1]][2000:] += 0.5


MISTAKEN: dict[str, tuple[Callable[[Table], None], str]] = {
    "sign": (reversed_sign, r"follow these joints with the sign of joint_5 changed \(--sign joint_5\)"),
    "order": (exchanged, "none does with the columns joint_2 and joint_3 swapped; exchange their names"),
    "degrees": (in_degrees, r'"joint_\d": .* rad looks like degrees; write `joint_\d \[deg\]`'),
    "another zero from midway on": (
        appended,
        r"line 2002: joint_2 jumps by (0\.49\d|0\.5\d*) within 0.01 s and stays there",
    ),
}


def rolled(table: Table) -> None:
    table["qx"], table["qy"], table["qz"], table["qw"] = table["qw"], table["qx"], table["qy"], table["qz"]


def inverted(table: Table) -> None:
    turned = Rotation.from_quat(np.column_stack([table[name] for name in ("qx", "qy", "qz", "qw")])).inv()
    place = -turned.apply(np.column_stack([table[axis] for axis in "xyz"]))
    table |= dict(zip("xyz", place.T, strict=True)) | dict(zip(("qx", "qy", "qz", "qw"), turned.as_quat().T, strict=True))


def unset(table: Table) -> None:
    table["time"][50:] += SINCE


def in_bursts(table: Table, within: float = 1e-4, lost: int = 5) -> None:
    """Give five samples at once the stamps of their arrival, and lose some, all but the first time 5 ms late or less."""
    for name, values in table.items():
        table[name] = np.delete(values, range(1200, 1200 + lost))
    rows = np.arange(len(table["time"]))
    late = np.random.default_rng(0).uniform(0.0, 5e-3, len(rows))[rows // 5 * 5]
    table["time"] = table["time"][np.minimum(rows // 5 * 5 + 4, len(rows) - 1)] + late + within * (rows % 5)


WRONG: dict[str, tuple[Callable[[Table], None], str]] = {
    "components of another order": (rolled, "orientations do not follow the arm.* they would in the order w x y z"),
    "poses the other way round": (inverted, "poses are of the instrument in the target's frame; .*: invert them"),
    "a clock that was set late": (unset, r"line 52: time jumps from -?\d.* to 1600000000\.\d* s"),
    "stamps of arrival": (in_bursts, "rows are in bursts, mostly 0.0001 s apart, on average 0.01. s.* some are lost"),
}


@pytest.mark.parametrize(("at", "fault"), [*(("joints", m) for m in MISTAKEN), *(("tracker", w) for w in WRONG)])
def test_the_stream_at_fault_is_refused(logs: Tables, at: str, fault: str, tmp_path: Path) -> None:
    """Of joints that are mistaken not the instrument, which does not follow them; by the arm, or by its stamps."""
    change, said = (MISTAKEN if at == "joints" else WRONG)[fault]
    tables = copied({name: logs[name] for name in ("joints", "tracker")})
    change(tables[at])
    with pytest.raises(MeasurementError, match=f"^{at}.csv.*{said}"):
        laid(read(tmp_path, tables)[0])


def test_a_clock_that_was_set_on_by_little_has_a_step(logs: Tables, tmp_path: Path) -> None:
    """Of 80 ms, which no error of the arm looks like; rows around it are left out, all others have their places."""
    tables = copied({name: logs[name] for name in ("joints", "tracker")})
    tables["tracker"]["time"][1300:] += 0.08
    untouched = {name: logs[name] for name in tables}
    (whole,), (parted,) = (session_tables(ROBOT, [read(tmp_path, of)[0]]).values() for of in (untouched, tables))
    assert whole.moving is not None and parted.moving is not None and not whole.moving.steps
    ((at, size),) = parted.moving.steps

    assert at == pytest.approx(tables["tracker"]["time"][1300], abs=0.1) and size == pytest.approx(-0.08, abs=1e-3)
    kept = np.isin(whole.rows, parted.rows)
    assert 0.9 < kept.mean() < 1.0
    np.testing.assert_allclose(parted.q, whole.q[kept], rtol=0.0, atol=2e-3)


@pytest.mark.parametrize(
    ("which", "by"),
    [
        ("joints", 0.04),
        ("tracker", 0.04),
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in (("joints", 1.0), ("imu", 0.04), ("imu", 1.0), ("tracker", 1.0))
        ),
    ],
)
def test_a_clock_that_was_set_back_by_little_goes_on(logs: Tables, which: str, by: float, tmp_path: Path) -> None:
    """Some stamps then belong to two samples each: from there on they are those of the samples; rows have their places."""
    tables = copied({name: logs[name] for name in ("joints", which if which != "joints" else "tracker")})
    tables[which]["time"][len(tables[which]["time"]) // 2 :] -= by
    untouched = {name: logs[name] for name in tables}
    (whole,) = session_tables(ROBOT, [read(tmp_path, untouched)[0]]).values()
    session, told = read(tmp_path, tables)
    (parted,) = session_tables(ROBOT, [session]).values()

    middle = len(logs[which]["time"]) // 2 + 2
    assert re.search(rf"{which}.csv, line {middle}: time runs backwards from .* 1 time in all: .* assumed to go on", told)
    kept, again = np.isin(whole.rows, parted.rows), np.isin(parted.rows, whole.rows)
    assert kept.mean() > 0.95 and again.mean() > 0.95
    np.testing.assert_allclose(parted.q[again], whole.q[kept], rtol=0.0, atol=1e-3)


@pytest.mark.parametrize("steps", [pytest.param([(20.0, 0.016)], marks=pytest.mark.long), [(12.0, 0.02), (27.0, 0.012)]])
def test_steps_of_a_clock_are_no_drift(logs: Tables, steps: list[tuple[float, float]], tmp_path: Path) -> None:
    """Though a nominal arm does not tell small ones: no rate is said that the frames of a camera have; a true one is."""
    tables = copied({name: logs[name] for name in ("joints", "tracker")})
    time = logs["tracker"]["time"]
    tables["tracker"]["time"] = time + sum((size * (time - OFFSET >= at) for at, size in steps), np.zeros(len(time)))
    assert "ppm" not in laid(read(tmp_path, tables)[0])[2]
    tables["tracker"]["time"] *= 1.001
    assert "ppm too fast" in laid(read(tmp_path, tables)[0])[2]


@pytest.mark.parametrize("within", [0.0, 1e-4])
@pytest.mark.parametrize("which", ["joints", "tracker"])
def test_stamps_of_packets_are_those_of_their_samples_again(logs: Tables, which: str, within: float, tmp_path: Path) -> None:
    """Whether a packet has one stamp or several: the samples are counted, which is said; a delay is left to the clock."""
    tables = copied({name: logs[name] for name in ("joints", "tracker")})
    in_bursts(tables[which], within, 0)
    session, told = read(tmp_path, tables)
    found = session.joints if which == "joints" else session.tracker
    assert found is not None and f"{which}.csv: " in told and "those of their arrival; samples are assumed to be" in told
    late = found.time - logs[which]["time"]
    assert np.ptp(late) < 4e-4 and late.mean() == pytest.approx(4.0 * within, abs=4e-4)
    assert len(found) == len(logs[which]["time"])


def test_stamps_of_arrival_are_told_from_those_of_two_devices(logs: Tables, tmp_path: Path) -> None:
    """Whose samples come in pairs, and are smooth by their stamps; by those of arrival time runs back again and again."""
    tables = copied({name: logs[name] for name in ("joints", "tracker")})
    true = tables["joints"]["time"]
    pairs = np.sort(np.append(true[::2], true[:-1:2] + 0.003))
    tables["joints"] = {name: np.interp(pairs, true, values) for name, values in tables["joints"].items()}
    tables["tracker"]["time"] += np.random.default_rng(0).exponential(0.01, len(tables["tracker"]["time"]))
    session, told = read(tmp_path, tables)
    assert session.tracker is not None and "joints.csv" not in told
    assert re.search(r"tracker.csv: time runs backwards \d+ times, by 0.0\d+ s or less: .* assumed to be 16.66", told)
    np.testing.assert_array_equal(session.joints.time, pairs)
    assert np.ptp(session.tracker.time - logs["tracker"]["time"]) < 5e-4


def test_rows_that_are_written_late_or_twice_are_put_in_order(logs: Tables, tmp_path: Path) -> None:
    """By several threads of a logger; what is then read is what was logged."""
    tables, rng = copied(logs), np.random.default_rng(0)
    for name, table in tables.items():
        rows = np.sort(np.append(np.arange(len(table["time"])), rng.choice(len(table["time"]), 300, replace=False)))
        rows = rows[np.argsort(np.arange(len(rows)) + rng.uniform(0.0, 6.0, len(rows)))]
        tables[name] = {column: values[rows] for column, values in table.items()}
    session, told = read(tmp_path, tables)
    for name in tables:
        stream = getattr(session, name)
        np.testing.assert_array_equal(stream.time, logs[name]["time"])
        assert f"{name}.csv: 300 rows occur twice" in told and re.search(
            rf"{name}.csv: \d+ rows are late, .* and sorted by time", told
        )


def test_an_imu_that_is_polled_at_nearly_its_own_rate_is_told(logs: Tables, tmp_path: Path) -> None:
    """Whose samples are read a little too late, ever less so, until one is read twice, or missed."""
    tables, rng = copied({name: logs[name] for name in ("joints", "imu")}), np.random.default_rng(0)
    imu = tables["imu"]
    polls = 0.5 + np.arange(3800) / 99.9 + rng.uniform(0.0, 5e-4, 3800)
    rows = np.searchsorted(imu["time"], polls + imu["time"][0]) - 1
    tables["imu"] = {name: values[rows] for name, values in imu.items()} | {"time": polls}
    session, told = read(tmp_path, tables)
    assert session.imu is not None and session.imu.rate == pytest.approx(99.9, abs=0.5)
    assert re.search(r"imu.csv: \d+ rows repeat the previous one, .* was it polled at nearly its own rate", told)


@pytest.mark.parametrize("rate", [82.0, *(pytest.param(rate, marks=pytest.mark.long) for rate in (97.0, 100.4, 130.0))])
def test_an_imu_that_is_polled_has_the_times_of_its_samples(logs: Tables, rate: float, tmp_path: Path) -> None:
    """Whose delays, up to a sample, follow the rates of an arm; stamps of samples, or that step, are left as they are."""
    tables, rng = copied({name: logs[name] for name in ("joints", "imu")}), np.random.default_rng(0)
    imu, true = tables["imu"], logs["imu"]["time"]
    polls = np.arange(true[0] + 0.5, true[-1], 1.0 / rate)
    polls += rng.uniform(0.0, 1e-3, len(polls))
    rows = np.searchsorted(true, polls) - 1
    stamps = {"samples": true + rng.uniform(0.0, 1e-3, len(true)), "polls": polls + rng.uniform(0.0, 2e-4, len(polls))}
    stamps["stepping"] = stamps["polls"] + 5e-3 * (polls > 20.0)
    found = dict[str, Stream | None]()
    for name, time in stamps.items():
        read_at = np.arange(len(true)) if name == "samples" else rows
        # The number of a row in the log tells which sample it has.
        tables["imu"] = {column: values[read_at] for column, values in imu.items()} | {"time": time}
        session, _ = read(tmp_path, tables)
        assert session.imu is not None
        arm = MovingArm.of(ROBOT, JointPath.through(session.joints.time, session.joints.readings["q"]))
        start = start_imu(arm, session.imu)
        found[name] = at_samples(arm, session.imu, start.clock, start.mount)
    assert found["samples"] is None and found["stepping"] is None and found["polls"] is not None

    late = found["polls"].time - true[rows[found["polls"].lines - 2]]
    assert np.ptp(polls - true[rows]) > 8e-3
    assert np.quantile(np.abs(late - np.median(late)), 0.99) < 5e-4 and len(late) > 0.85 * len(np.unique(rows))


@pytest.mark.parametrize("rate", [90.0, 110.0, 150.0])
def test_an_instrument_that_is_polled_too_fast_has_the_times_of_its_samples(
    logs: Tables, rate: float, tmp_path: Path
) -> None:
    """Though some were lost; polls that come whenever they like, or repeat where digits are few, are left as they are."""
    tables = copied({name: logs[name] for name in ("joints", "tracker")})
    true, rng = logs["tracker"]["time"], np.random.default_rng(0)
    polls = np.arange(true[0] + 0.5, true[-1], 1.0 / rate)
    polls += rng.uniform(0.0, 5e-4, len(polls))
    polls = polls[(polls < 10.0) | (polls > 10.5)]
    rows = np.searchsorted(true, polls) - 1
    tables["tracker"] = {name: values[rows] for name, values in logs["tracker"].items()} | {"time": polls}
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", PincalWarning)
        (table,) = session_tables(ROBOT, [read(tmp_path, tables)[0]]).values()
    assert "of an instrument that reads every 16.66" in "\n".join(str(each.message) for each in told)
    assert table.time is not None and len(np.unique(rows)) - 80 < len(table) <= len(np.unique(rows))
    late = table.time - true[rows[table.rows - 2]]
    assert np.ptp(polls - true[rows]) > 0.8 / rate and np.ptp(late) < 2e-4

    read_at = polls[0] + np.cumsum(rng.uniform(0.0, 3.0 / rate, len(polls) // 2))
    for name, time in (("uneven", read_at[read_at < true[-1]]), ("coarse", true)):
        kept = np.searchsorted(true, time + 1e-9) - 1
        digits = 2 if name == "coarse" else 9
        readings = {axis: np.round(logs["tracker"][axis][kept], digits) for axis in "xyz"}
        stream = Stream(name, time, {"position": np.column_stack(list(readings.values()))}, {})
        assert stream.repeats.any() and at_even_samples(stream) is stream


@pytest.mark.parametrize("size", [-8.3e-3, 8.3e-3])
def test_one_step_of_nearly_a_sample_is_none_of_polls(logs: Tables, size: float, tmp_path: Path) -> None:
    """Which with the drift in its place looks like polls that pass one sample from beginning to end."""
    tables = copied({name: logs[name] for name in ("joints", "imu")})
    tables["imu"]["time"][1300:] += size
    session, _ = read(tmp_path, tables)
    assert session.imu is not None
    arm = MovingArm.of(ROBOT, JointPath.through(session.joints.time, session.joints.readings["q"]))
    start = start_imu(arm, session.imu)
    assert at_samples(arm, session.imu, start.clock, start.mount) is None


@pytest.mark.parametrize("digits", [6, 15])
def test_what_was_interpolated_is_no_reading(logs: Tables, digits: int, tmp_path: Path) -> None:
    """Straight lines across the time in which a target was lost, of any digits; an arm that moves straight on is read."""
    tables = copied({name: logs[name] for name in ("joints", "tracker")})
    clean, tracker = read(tmp_path, tables), tables["tracker"]
    for axis in "xyz":
        tracker[axis][600:780] = np.interp(np.arange(600, 780), [599, 780], tracker[axis][[599, 780]])
        tracker[axis] = np.round(tracker[axis], digits)
    session, told = read(tmp_path, tables)
    assert "180 of 2400 rows, the first in line 602, are evenly spaced on straight" in told and "straight" not in clean[1]
    assert session.tracker is not None and len(session.tracker) == len(tracker["time"]) - 180
    straight = np.outer(np.arange(500) * 5e-3, [1.0, 0.3, 0.0]) + 3e-5 * np.random.default_rng(0).standard_normal((500, 3))
    assert not interpolated(np.vstack([np.cumsum(straight, axis=0), straight])).any()


def test_a_range_that_is_too_small_is_no_broken_axis(logs: Tables) -> None:
    """Where it is reached for a second once; nor are stamps that are seconds apart milliseconds."""
    imu = logs["imu"]
    rate = np.column_stack([imu[f"w{axis}"] for axis in "xyz"])
    rate[1000:1120, 1] = rate[:, 1].max() + 0.1
    force = np.column_stack([imu[f"a{axis}"] for axis in "xyz"])
    with pytest.warns(PincalWarning, match="120 rows are clipped at the limit of the IMU's range"):
        checked_imu(Stream("imu.csv", imu["time"], {"specific_force": force, "angular_rate": rate}, {}))
    slow = Stream("tracker.csv", np.arange(80) + 0.25, {"position": force[:80]}, {})
    with pytest.raises(MeasurementError, match=r"a row every 1 s; .* log faster"):
        in_order(slow)


def test_gaps_do_no_harm(logs: Tables, tmp_path: Path) -> None:
    """Of the joints and of an IMU, of which windows amid a gap hold nothing."""
    tables = copied({name: logs[name] for name in ("joints", "imu")})
    for name, begin in (("joints", 12.0), ("imu", 25.0)):
        time = tables[name]["time"]
        tables[name] = {column: values[(time < begin) | (time > begin + 2.0)] for column, values in tables[name].items()}
    session, told = read(tmp_path, tables)
    assert "joints.csv: 1 gap of more" in told and "imu.csv: 1 gap of more" in told
    assert laid(session)[0] == pytest.approx(0.4, abs=0.02)


@pytest.mark.parametrize(
    ("seconds", "moves", "said"),
    [
        (0.2, True, r"the log of the joints has no 1\.5 s without a gap"),
        (0.5, True, "no reading lies where the joints were logged"),
        (2.0, True, "no reading lies where the joints were logged"),
        (20.0, False, "expected readings at 50 Hz or more over some minutes"),
    ],
)
def test_logs_shorter_than_a_filter_are_refused(
    logs: Tables, seconds: float, moves: bool, said: str, tmp_path: Path
) -> None:
    """Of an IMU whose windows, or the second over which its noise is averaged, are longer; or that always reads the same."""
    tables = copied({name: logs[name] for name in ("joints", "imu")})
    for name, table in tables.items():
        rows = np.arange(500, 500 + int(100 * seconds))
        still = [column for column in table if column != "time" and not moves]
        tables[name] = {column: values[rows] for column, values in table.items()}
        tables[name] |= {column: np.full(len(rows), tables[name][column][0]) for column in still}
    with pytest.raises(MeasurementError, match=said):
        laid(read(tmp_path, tables)[0])


def test_readings_too_few_for_their_clock_are_refused() -> None:
    """Three of them fit three features of any motion: a log of seconds ended in a singular matrix."""
    time = np.linspace(0.0, 0.1, 3)

    def features(at: np.ndarray, rows: np.ndarray) -> np.ndarray:
        return np.column_stack([np.sin(at), np.cos(at)])

    with pytest.raises(MeasurementError, match=r"imu\.csv: but for 3 readings, over 0\.1 s, no reading lies where"):
        aligned(time, features(time, time), features, lambda at: at < 9.0, Clock(), source="imu.csv")


def test_rows_that_lack_a_cell_are_left_out(logs: Tables, tmp_path: Path) -> None:
    """Of joints and times as of readings: one table of all streams, each row of one, is a session."""
    import polars as pl

    parts = {
        name: {column if column == "time" else f"{name}/{column}": v for column, v in logs[name].items()} for name in logs
    }
    frame = pl.concat([pl.DataFrame(part) for part in parts.values()], how="diagonal").sort("time")
    frame.write_csv(tmp_path / "all.csv")
    with pytest.warns(PincalWarning, match="rows have an empty reading and are left out"):
        session = read_streams(ROBOT, **dict.fromkeys(logs, tmp_path / "all.csv"))
    assert session.imu is not None and session.tracker is not None
    assert [len(part) for part in (session.joints, session.imu, session.tracker)] == [
        len(logs[n]["time"]) for n in ("joints", "imu", "tracker")
    ]
    np.testing.assert_array_equal(session.tracker.readings["position"][:, 0], logs["tracker"]["x"])
