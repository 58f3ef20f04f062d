"""Streams of an arm that moves: read from tables and recordings, laid onto the motion, refused if they can't be right."""

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
from pincal.measure.log_reader import joints_of_log, reader_of
from pincal.measure.table import write_table
from pincal.motion.joint_path import JointPath
from pincal.motion.moving_arm import MovingArm
from pincal.motion.sessions import Session, Stream, joints_of_session, read_session, read_streams
from pincal.motion.starts import aligned_forces, start_imu, start_positions
from pincal.robot.robot import Robot
from pincal.simulate.moving import FourierPath, ViaPath, draw_path
from pincal.simulate.session import Clock, ImuSetup, MovingSession

ROBOT = Robot.from_urdf(kuka_urdf_path())
JOINTS = ROBOT.joint_names
SECONDS = 35.0
CLOCKS = {"imu": Clock(0.4, 2e-5, 17.5), "tracker": Clock(-0.9, 5e-5, 17.5)}
Table = dict[str, np.ndarray]


def driven(seed: int, *, rests: bool = False) -> tuple[dict[str, Table], ImuSetup]:
    """Return what is logged of a path, each of its own, with long rests at its beginning and amid it or without."""
    rng = np.random.default_rng(seed)
    machine = sim.TrueMachine.from_urdf(ROBOT.urdf.decode(), tip=ROBOT.tip, base=ROBOT.base)
    imu = ImuSetup.draw(rng, acc_density=0.01, gyro_density=1.7e-4, vibration=0.05)
    path: FourierPath | ViaPath = draw_path(machine.nominal, SECONDS, rng)
    if rests:
        begins = np.array([0.0, *np.linspace(5.0, SECONDS, 13)])
        q = path.at(begins)
        q[1], q[4] = q[0], q[3]
        path = ViaPath(begins, q)
    session = MovingSession(
        path=path,
        duration=SECONDS,
        imu=imu,
        tracker=sim.Instrument(pose=np.eye(4), targets=(0.05, 0.1, 0.2), sigma=3e-5),
        clocks=CLOCKS,
        resolution=2e-5,
        rates={"joints": 100.0, "imu": 100.0, "tracker": 100.0},
    )
    return session.measure(machine, rng), imu


@pytest.fixture(scope="module")
def logs() -> tuple[dict[str, Table], ImuSetup]:
    """Return the tables of one session, and the IMU that is in them."""
    return driven(1)


def written(folder: Path, tables: dict[str, Table], **headers: str) -> Path:
    """Write tables, columns under other headers where that is asked for."""
    folder.mkdir(exist_ok=True)
    for name, table in tables.items():
        write_table(folder / f"{name}.csv", {headers.get(column, column): values for column, values in table.items()})
    return folder


def arm_of(session: Session) -> MovingArm:
    return MovingArm(ROBOT, JointPath.through(session.joints.time, session.joints.readings["q"]))


def position(stream: Stream) -> np.ndarray:
    return np.asarray(stream.readings["position"])


def test_a_folder_is_a_session(logs: tuple[dict[str, Table], ImuSetup], tmp_path: Path) -> None:
    """Tables by their names, units by their headers; clocks and mount are found to some milliseconds and milliradians."""
    tables, imu = logs
    scaled = {"imu": dict(tables["imu"]), "joints": dict(tables["joints"]), "tracker": dict(tables["tracker"])}
    for axis in "xyz":
        scaled["imu"][f"a{axis}"] = tables["imu"][f"a{axis}"] / 9.80665
        scaled["imu"][f"w{axis}"] = np.rad2deg(tables["imu"][f"w{axis}"])
        scaled["tracker"][axis] = 1e3 * tables["tracker"][axis]
    headers = (
        {f"a{x}": f"a{x} [g]" for x in "xyz"} | {f"w{x}": f"w{x} [deg/s]" for x in "xyz"} | {x: f"{x} [mm]" for x in "xyz"}
    )
    folder = written(tmp_path / "monday", scaled, **headers)
    session = read_session(ROBOT, folder)
    arm = arm_of(session)
    assert joints_of_session(folder) == folder / "joints.csv" and joints_of_session(tmp_path) is None
    assert session.imu is not None and session.tracker is not None and session.name == "monday"

    found, seen = start_imu(arm, session.imu), start_positions(arm, session.tracker, position(session.tracker))
    stamps = np.array([4.0, 31.0])
    # The gyroscope's own delay is in the clock that its rates tell.
    late = CLOCKS["imu"].to_joints(stamps) + imu.delay
    np.testing.assert_allclose(found.clock.to_joints(stamps), late, rtol=0.0, atol=2e-3)
    np.testing.assert_allclose(seen.to_joints(stamps), CLOCKS["tracker"].to_joints(stamps), rtol=0.0, atol=2e-3)
    assert aligned_forces(arm, found) == pytest.approx(imu.delay, abs=1e-3)
    turned = Rotation.from_matrix(found.mount.T @ imu.mount[:3, :3]).magnitude()
    assert turned < 0.02 and len(found.rows) > 350


def test_a_calibration_reads_sessions_beside_tables(logs: tuple[dict[str, Table], ImuSetup], tmp_path: Path) -> None:
    """By the reader that motion hands in: a folder is a log, and its stations have the name that it is given."""
    folder = written(tmp_path / "monday", logs[0])
    reader = reader_of(folder)

    assert reader is not None and reader_of(folder / "joints.csv") is None
    assert joints_of_log(folder) == folder / "joints.csv" and joints_of_log(folder / "joints.csv") is None
    assert [reader.read(ROBOT, folder, name).name for name in ("", "other")] == ["monday", "other"]
    assert list(reader.tables(ROBOT, [reader.read(ROBOT, folder, "other")])) == ["other/imu", "other/tracker"]


def test_a_recording_is_a_session(logs: tuple[dict[str, Table], ImuSetup], tmp_path: Path) -> None:
    """Topics of JointState, Imu and PoseStamped, by the stamps of their messages."""
    rosbag2, typesys = pytest.importorskip("rosbags.rosbag2"), pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    types, tables = store.types, logs[0]
    vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)

    def header(t: float) -> object:
        stamp = types["builtin_interfaces/msg/Time"](int(t) + 100, round(1e9 * (t % 1.0)))
        return types["std_msgs/msg/Header"](stamp, "")

    with rosbag2.Writer(tmp_path / "bag", version=9) as writer:
        state, imu, pose = (
            (writer.add_connection(topic, kind, typestore=store), kind)
            for topic, kind in (
                ("/joint_states", "sensor_msgs/msg/JointState"),
                ("/imu", "sensor_msgs/msg/Imu"),
                ("/tracker", "geometry_msgs/msg/PointStamped"),
            )
        )
        for k in range(500):
            q, t = [tables["joints"][name][k] for name in JOINTS], float(tables["joints"]["time"][k])
            read = {c: float(v[k]) for c, v in (tables["imu"] | tables["tracker"]).items()}
            empty, spread = np.zeros(0), np.zeros(9)
            messages = (
                (state, types[state[1]](header(t), list(JOINTS), np.array(q), empty, empty)),
                (imu, types[imu[1]](header(t), quaternion, spread, vector(read["wx"], read["wy"], read["wz"]), spread,
                                    vector(read["ax"], read["ay"], read["az"]), spread)),
                (pose, types[pose[1]](header(t), types["geometry_msgs/msg/Point"](read["x"], read["y"], read["z"]))),
            )  # fmt: skip
            for (connection, kind), message in messages:
                # The recorder gets them late and unevenly.
                writer.write(connection, int(1e18 + 1e9 * t + 3e6 * (k % 3)), store.serialize_cdr(message, kind))
    session = read_session(ROBOT, tmp_path / "bag")

    assert session.imu is not None and session.tracker is not None
    np.testing.assert_allclose(session.imu.time, tables["joints"]["time"][:500] + 100.0, atol=1e-6)
    np.testing.assert_allclose(session.imu.readings["angular_rate"][:, 1], tables["imu"]["wy"][:500])
    np.testing.assert_allclose(position(session.tracker)[:, 2], tables["tracker"]["z"][:500])


# What is done to the tables, and what is said of it: when they are read, and when they are laid onto the motion.
Corrupt = Callable[[dict[str, Table]], None]


def scale(stream: str, letter: str, factor: float) -> Corrupt:
    """Return what multiplies columns."""
    names = list("xyz") if not letter else [letter + axis for axis in "xyz"]

    def corrupt(tables: dict[str, Table]) -> None:
        for name in names:
            tables[stream][name] = factor * tables[stream][name]

    return corrupt


def change(stream: str, column: str, by: Callable[[np.ndarray], np.ndarray]) -> Corrupt:
    """Return what changes one column."""

    def corrupt(tables: dict[str, Table]) -> None:
        tables[stream][column] = by(tables[stream][column].copy())

    return corrupt


def run_back(time: np.ndarray) -> np.ndarray:
    time[2000:] -= 30.0
    return time


def lost_packet(tables: dict[str, Table]) -> None:
    """Give samples the stamps of packets, and leave one of these out."""
    kept = np.append(np.arange(2000), np.arange(2005, 3490))
    tables["imu"] = {name: values[kept] for name, values in tables["imu"].items()}
    tables["imu"]["time"] = tables["imu"]["time"] // 0.05 * 0.05


def freeze(values: np.ndarray) -> np.ndarray:
    values[1000:1400] = values[1000]
    return values


AT_THE_DOOR: dict[str, tuple[Corrupt, str]] = {
    "time that runs back": (change("imu", "time", run_back), "imu.csv, line 2002: time runs backwards from 19.99 s"),
    "frames for time": (
        change("tracker", "time", lambda t: np.arange(len(t), dtype=float)),
        "counts 1, 2, 3.*divide by the rate",
    ),
    "milliseconds": (change("joints", "time", lambda t: 1e3 * t), r"joints.csv: a row every 10 s.*write `time \[ms\]`"),
    "packets of which one is lost": (lost_packet, r"those of packets, .* about line \d+ .* as when some are lost"),
    "g": (scale("imu", "a", 1.0 / 9.80665), r"0.9\d* m/s\^2.*looks like \[g\]: write `ax \[g\]`"),
    "gravity taken out": (scale("imu", "a", 0.2), "gravity was removed; log raw accelerations"),
    "a frozen axis": (change("imu", "wy", freeze), "column 'wy' is constant for 3.99 s while others change"),
    "a range that is too small": (
        change("imu", "wx", lambda w: np.clip(w, -0.25, 0.25)),
        "column 'wx' is clipped at 0.25 in .. % of the rows; choose a larger range",
    ),
}


def slip(tables: dict[str, Table]) -> None:
    """Turn the IMU by 40 mrad from half on."""
    R = Rotation.from_rotvec([0.03, -0.02, 0.02]).as_matrix()
    for letter in "aw":
        values = np.column_stack([tables["imu"][letter + axis] for axis in "xyz"])
        values[1750:] = values[1750:] @ R.T
        for k, axis in enumerate("xyz"):
            tables["imu"][letter + axis] = values[:, k]


def mirror(tables: dict[str, Table]) -> None:
    """Turn the sign of y of both sensors."""
    for name in ("ay", "wy"):
        tables["imu"][name] = -tables["imu"][name]


def swap(tables: dict[str, Table]) -> None:
    """Exchange x and y of the accelerometer, and one sign, so that the frame is right-handed."""
    tables["imu"]["ax"], tables["imu"]["ay"] = tables["imu"]["ay"], -tables["imu"]["ax"]


ON_THE_MOTION: dict[str, tuple[Corrupt, str]] = {
    "rates of a thousandth": (scale("imu", "w", 180e3 / np.pi), r"looks like .mdeg/s.: write `wx \[mdeg/s\]`"),
    "counts": (scale("imu", "w", 16.4 * 180.0 / np.pi), "rates are 9.*, 9.*, 9.* times those of the arm along three axes"),
    "degrees": (scale("imu", "w", 180.0 / np.pi), r"57.* times those of the arm; looks like .deg.s.: write `wx \[deg/s\]`"),
    "a mirrored IMU": (mirror, "mirrored relative to the arm, in a left-handed frame.*change the sign of one axis"),
    "axes of the accelerometer": (swap, "frames of ax ay az and wx wy wz are 90 deg apart"),
    "the other sign of gravity": (scale("imu", "a", -1.0), r"the wrong sign: an IMU at rest reads \+9.8 upwards"),
    "a mirrored accelerometer": (change("imu", "az", lambda a: -a), "specific forces are mirrored"),
    "an IMU that slipped": (slip, "turned on its mount by [34]. mrad at about 1[5-9].* s of its clock; fasten it"),
    "millimetres": (scale("tracker", "", 1e3), r"1e\+03 times as far as the arm; looks like \[mm\]"),
    "a mirrored tracker": (change("tracker", "y", lambda y: -y), "positions are mirrored relative to the arm"),
}


def copied(tables: dict[str, Table]) -> dict[str, Table]:
    return {name: dict(table) for name, table in tables.items()}


def read(folder: Path, tables: dict[str, Table]) -> Session:
    written(folder, tables)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PincalWarning)
        return read_session(ROBOT, folder)


@pytest.mark.long
def test_an_arm_that_rests_tells_nothing_of_the_mount(tmp_path: Path) -> None:
    """Rates of an arm at rest are noise, by which a mount seems to be anyhow; the motion's are those of one mount."""
    tables, imu = driven(1, rests=True)
    session = read(tmp_path / "day", tables)
    assert session.imu is not None
    start = start_imu(arm_of(session), session.imu)

    assert Rotation.from_matrix(start.mount.T @ imu.mount[:3, :3]).magnitude() < 0.01
    slip(tables)
    session = read(tmp_path / "day", tables)
    assert session.imu is not None
    with pytest.raises(MeasurementError, match=r"turned on its mount by [34]\d mrad"):
        start_imu(arm_of(session), session.imu)


@pytest.mark.parametrize("fault", AT_THE_DOOR)
def test_streams_that_cannot_be_right_are_refused(
    logs: tuple[dict[str, Table], ImuSetup], fault: str, tmp_path: Path
) -> None:
    """When they are read, with the file and its session, what was found and the cure."""
    corrupt, said = AT_THE_DOOR[fault]
    tables = copied(logs[0])
    corrupt(tables)

    with pytest.raises(MeasurementError, match=f"day.*{said}"):
        read(tmp_path / "day", tables)


@pytest.mark.parametrize("fault", ON_THE_MOTION)
def test_streams_that_do_not_fit_the_motion_are_refused(
    logs: tuple[dict[str, Table], ImuSetup], fault: str, tmp_path: Path
) -> None:
    """When they are laid onto the nominal arm, with what it tells of them."""
    corrupt, said = ON_THE_MOTION[fault]
    tables = copied(logs[0])
    corrupt(tables)
    session = read(tmp_path / "day", tables)
    assert session.imu is not None and session.tracker is not None
    arm = arm_of(session)

    with pytest.raises(MeasurementError, match=said):
        start_imu(arm, session.imu)
        start_positions(arm, session.tracker, position(session.tracker))


@pytest.mark.long
def test_swapped_imus_are_told_by_name(logs: tuple[dict[str, Table], ImuSetup], tmp_path: Path) -> None:
    """An IMU of another session is refused with the session that it is of; an arm that it is not of, without."""
    one, two = logs[0], driven(2)[0]
    monday, tuesday = read(tmp_path / "a", one | {"imu": two["imu"]}), read(tmp_path / "b", two | {"imu": one["imu"]})
    assert monday.imu is not None
    arms = [("a", arm_of(monday)), ("b", arm_of(tuesday))]

    with pytest.raises(
        MeasurementError, match=r"do not follow these joints.*it is of b: were two IMUs, or two files, swapped"
    ):
        start_imu(arms[0][1], monday.imu, others=arms[1:])
    with pytest.raises(MeasurementError, match="is it of another arm or session"):
        start_imu(arms[0][1], monday.imu)


def test_what_is_odd_is_told(logs: tuple[dict[str, Table], ImuSetup], tmp_path: Path) -> None:
    """Gaps, doubled stamps, rows that a fast logger repeats and some that are cut off are left out, and counted."""
    tables = copied(logs[0])
    hole = (tables["imu"]["time"] < 20.0) | (tables["imu"]["time"] > 21.5)
    tables["imu"] = {name: values[hole] for name, values in tables["imu"].items()}
    tables["tracker"]["time"][700] = tables["tracker"]["time"][699]
    tables["imu"]["wx"] = np.maximum(tables["imu"]["wx"], np.quantile(tables["imu"]["wx"], 0.04))
    again = np.sort(np.append(np.arange(len(tables["imu"]["time"])), np.arange(0, 2800, 8)))
    tables["imu"] = {name: values[again] for name, values in tables["imu"].items()}
    tables["imu"]["time"][1:][np.diff(again) == 0] += 0.005
    with pytest.warns(PincalWarning) as told:
        session = read_streams(
            ROBOT, **{name: written(tmp_path / "day", tables) / f"{name}.csv" for name in ("joints", "imu", "tracker")}
        )
    text = "\n".join(str(each.message) for each in told)

    assert "imu.csv: 1 gap of more than 0.2 s, up to 1.52 s from 19.99 s on" in text
    assert "imu.csv: 9 % of the rows repeat the previous one" in text
    assert re.search(r"imu\.csv: \d+ rows are clipped at the limit of the IMU's range", text)
    assert "tracker.csv: left out: 1 row with the previous stamp" in text
    assert session.tracker is not None and len(session.tracker) == len(tables["tracker"]["time"]) - 1


def test_a_clock_of_frames_is_told(logs: tuple[dict[str, Table], ImuSetup], tmp_path: Path) -> None:
    """Stamps that count frames of a rate 0.1 % off are taken into account, and it is said."""
    tables = copied(logs[0])
    tables["tracker"]["time"] = tables["tracker"]["time"] * (1.0 - 1062e-6)
    session = read(tmp_path / "day", tables)
    assert session.tracker is not None
    with pytest.warns(PincalWarning, match=r"its clock runs 1\d\d\d ppm too slowly .* do its stamps count frames"):
        found = start_positions(arm_of(session), session.tracker, position(session.tracker))

    assert found.drift == pytest.approx(1062e-6 + 5e-5, abs=6e-5)


@pytest.mark.parametrize(
    ("files", "said"),
    [
        (["imu"], "has imu.csv; expected joints.csv, and imu.csv"),
        (["joints"], "has joints.csv; expected joints.csv, and imu.csv"),
        ([], "has no stream"),
    ],
)
def test_a_folder_that_lacks_a_stream_is_refused(
    logs: tuple[dict[str, Table], ImuSetup], files: list[str], said: str, tmp_path: Path
) -> None:
    """With what is there and what is needed."""
    folder = written(tmp_path / "day", {name: logs[0][name] for name in files})
    with pytest.raises(MeasurementError, match=said):
        read_session(ROBOT, folder)


def test_missing_columns_are_named(logs: tuple[dict[str, Table], ImuSetup], tmp_path: Path) -> None:
    """An IMU without rates, a tracker without readings, joints without time; two files of one stream."""
    cases = {
        "imu": ({"time", "ax", "ay", "az"}, "no columns wx wy wz"),
        "tracker": ({"time"}, "no readings; expected columns such as x y z"),
        "joints": (set(JOINTS), "no column time"),
    }
    for k, (name, (kept, said)) in enumerate(cases.items()):
        tables = copied(logs[0])
        tables[name] = {column: values for column, values in tables[name].items() if column in kept}
        with pytest.raises(MeasurementError, match=said):
            read(tmp_path / str(k), tables)
    folder = written(tmp_path / "twice", logs[0])
    write_table(folder / "imu.parquet", logs[0]["imu"])
    with pytest.raises(MeasurementError, match=r"imu\.csv, imu\.parquet; expected one file of imu"):
        read_session(ROBOT, folder)
