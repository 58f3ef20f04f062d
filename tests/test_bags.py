"""Recordings of ROS become tables: one row per pose that was held still."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pincal.errors import MeasurementError, PincalWarning
from pincal.measure.measurements import Measurements
from pincal.measure.table import read_measurements, write_table

rosbag2 = pytest.importorskip("rosbags.rosbag2")
typesys = pytest.importorskip("rosbags.typesys")

JOINTS = ("a", "b")
K = 5
RNG = np.random.default_rng(2)
Q = np.cumsum(RNG.uniform(0.2, 0.6, (K, 2)), axis=0)
XYZ = RNG.uniform(-1.0, 1.0, (K, 3))
QUATERNIONS = Rotation.random(K, random_state=3).as_quat()
# Each pose is held for two seconds, the next one reached in one; joints at 50 Hz, the instrument at 10 Hz.
END, NOISE_Q, NOISE_M = 3.0 * K, 2e-5, 1e-5


def moving(values: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return what is held and moved through at each time [s], shape (T, k)."""
    step = np.minimum((time / 3.0).astype(int), K - 1)
    share = np.clip(time - 3.0 * step - 2.0, 0.0, 1.0)[:, None]
    return np.asarray(values[step] + share * (values[np.minimum(step + 1, K - 1)] - values[step]))


def record(
    path: Path,
    *,
    plugin: str = "MCAP",
    kind: str = "PoseStamped",
    joints: int = 1,
    readings: int = 1,
    until: float = 3.0 * K,
) -> Path:
    """Write a recording with the library's own writer; the joints are followed by a finger's, as grippers do."""
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](0, 0)
    header = types["std_msgs/msg/Header"](stamp, "tracker")
    point, quaternion = types["geometry_msgs/msg/Point"], types["geometry_msgs/msg/Quaternion"]
    empty = np.zeros(0)
    messages = []
    for i in range(joints):
        time = np.arange(0.0, until, 0.02)
        for t, q in zip(time, moving(Q, time) + RNG.normal(0.0, NOISE_Q, (len(time), 2)), strict=True):
            state = types["sensor_msgs/msg/JointState"](header, [*JOINTS, "finger"], np.array([*q, t]), empty, empty)
            messages.append((t, f"/joint_states{i or ''}", state))
    for i in range(readings):
        time = np.arange(0.05, until, 0.1)
        places = moving(XYZ, time) + RNG.normal(0.0, NOISE_M, (len(time), 3))
        signs = RNG.choice([-1.0, 1.0], len(time))
        for t, place, turned in zip(time, places, moving(QUATERNIONS, time) * signs[:, None], strict=True):
            at = point(*place)
            if kind == "PoseStamped":
                pose = types["geometry_msgs/msg/Pose"](at, quaternion(*turned))
                messages.append((t, f"/tracker{i or ''}", types["geometry_msgs/msg/PoseStamped"](header, pose)))
            else:
                messages.append((t, f"/tracker{i or ''}", types["geometry_msgs/msg/PointStamped"](header, at)))
    storage = getattr(rosbag2.StoragePlugin, plugin)
    with rosbag2.Writer(path, version=9, storage_plugin=storage) as writer:
        connections = {}
        for t, topic, message in sorted(messages, key=lambda each: each[0]):
            name = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            writer.write(connections[topic], int(1.8e18) + int(1e9 * t), store.serialize_cdr(message, name))
    return path


def read(path: Path, **said: object) -> Measurements:
    with pytest.warns(PincalWarning):
        return read_measurements(path, JOINTS, **said)  # type: ignore[arg-type]


@pytest.mark.parametrize("plugin", ["MCAP", "SQLITE3"])
@pytest.mark.parametrize("kind", ["PoseStamped", "PointStamped"])
def test_poses_held_still_are_the_rows(tmp_path: Path, plugin: str, kind: str) -> None:
    """Each pose has the mean of its joints and readings, within their noise; all else is left out."""
    folder = record(tmp_path / "bag", plugin=plugin, kind=kind)
    with pytest.warns(PincalWarning, match="5 poses held still, joints from /joint_states, readings from /tracker"):
        found = read_measurements(folder, JOINTS)

    assert found.kind == ("pose" if kind == "PoseStamped" else "position")
    np.testing.assert_allclose(found.q, Q, rtol=0, atol=NOISE_Q)
    np.testing.assert_allclose(found.position, XYZ, rtol=0, atol=2 * NOISE_M)
    if kind == "PoseStamped":
        assert found.quaternion is not None
        turn = Rotation.from_quat(found.quaternion) * Rotation.from_quat(QUATERNIONS).inv()
        assert turn.magnitude().max() < 1e-9
    assert found.time is not None
    np.testing.assert_allclose(np.diff(found.time), 3.0, atol=0.05)


def test_a_single_file_is_read_like_its_folder(tmp_path: Path) -> None:
    """An .mcap without its folder is a recording, too."""
    folder = record(tmp_path / "bag")
    (file,) = folder.glob("*.mcap")

    np.testing.assert_array_equal(read(file).q, read(folder).q)


def test_a_recording_is_a_log_of_joints(tmp_path: Path) -> None:
    """Joints from a recording, readings from a table: joined by time."""
    folder = record(tmp_path / "bag", readings=0)
    times = 1.8e9 + 3.0 * np.arange(K) + 1.0
    write_table(tmp_path / "tracker.csv", dict(zip("xyz", XYZ.T, strict=True)) | {"time": times})
    found = read(tmp_path / "tracker.csv", joints=folder)

    np.testing.assert_allclose(found.q, Q, rtol=0, atol=NOISE_Q)
    np.testing.assert_array_equal(found.position, XYZ)


def test_what_a_recording_leaves_open_is_refused(tmp_path: Path) -> None:
    """Two topics of joints or readings, none, or no pose that is held end with the next step, and the step helps."""
    both = record(tmp_path / "both", joints=2, readings=2)
    with pytest.raises(MeasurementError, match=r"joints in several topics: /joint_states, /joint_states1; .*--ignore"):
        read_measurements(both, JOINTS)
    with pytest.raises(MeasurementError, match=r"readings in several topics: /tracker, /tracker1; .*--ignore"):
        read_measurements(both, JOINTS, ignore=["/joint_states1"])
    assert len(read(both, ignore=["/joint_states1", "/tracker1"])) == K
    with pytest.raises(MeasurementError, match="no joints; expected a topic of sensor_msgs/msg/JointState"):
        read_measurements(record(tmp_path / "none", joints=0), JOINTS)
    with pytest.raises(MeasurementError, match="0 poses of /joint_states held still"):
        read_measurements(record(tmp_path / "short", until=0.2), JOINTS)
    with pytest.raises(MeasurementError, match='no column for joint "elbow"'):
        read_measurements(record(tmp_path / "other"), ("a", "elbow"))
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"\x89MCAP0\r\n cut")
    with pytest.raises(MeasurementError, match=r"broken\.mcap: can't be read"):
        read_measurements(broken, JOINTS)
    # The length of a record, after the file's magic number, that no memory holds.
    whole = next((tmp_path / "short").glob("*.mcap")).read_bytes()
    broken.write_bytes(whole[:9] + b"\xff" * 8 + whole[17:])
    with pytest.raises(MeasurementError, match=r"broken\.mcap: can't be read"):
        read_measurements(broken, JOINTS)


def test_recordings_say_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without rosbags the error names the extra."""
    monkeypatch.setitem(__import__("sys").modules, "rosbags.highlevel", None)
    with pytest.raises(MeasurementError, match=r"pip install 'pincal\[ros\]'"):
        read_measurements(record(tmp_path / "bag"), JOINTS)
