"""Thirty kinds of tables as people have them: read with no option, or one, to the same poses and readings."""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
import polars as pl
import pytest
import scipy.io
import yaml
from rosbags import rosbag2, typesys
from scipy.spatial.transform import Rotation

from pincal.builtin import kuka_urdf_path
from pincal.calibration.calibration import run_calibration
from pincal.errors import MeasurementError, PincalWarning
from pincal.identify.options import Options
from pincal.measure.measurements import measurements_from_arrays
from pincal.measure.table import read_measurements
from pincal.model.effects import GEOMETRIC
from pincal.readers.nested_sheet import open_nested
from pincal.robot.robot import Robot
from pincal.simulate.machine import TrueMachine

JOINTS = tuple(f"joint_a{i}" for i in range(1, 7))
SHORT = [f"A{i}" for i in range(1, 7)]
K = 12
RNG = np.random.default_rng(7)
Q = RNG.uniform(-2.0, 2.0, (K, 6))
XYZ = RNG.uniform(-1.5, 1.5, (K, 3))
TURNED = Rotation.from_euler("xyz", RNG.uniform(-1.2, 1.2, (K, 3)))
QUATERNIONS = TURNED.as_quat()
MATRICES = np.tile(np.eye(4), (K, 1, 1))
MATRICES[:, :3, :3], MATRICES[:, :3, 3] = TURNED.as_matrix(), XYZ
DEG, MM = np.degrees(Q), 1e3 * XYZ
# A log: poses are held for two seconds and the next one is reached in one.
HOLD, MOVE = 2.0, 1.0


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Attributes:
        make: writes it into a folder and returns its path, or that and a log of the joints.
        options: what the user has to say.
        note: what has to be told.
        is_pose: whether it has orientations.
        left: rows that have no valid reading.
        noise: what means over a log may be off by [rad, m].
    """

    make: Callable[[Path], Path]
    options: Mapping[str, Any] = field(default_factory=dict)
    note: str = ""
    is_pose: bool = False
    left: tuple[int, ...] = ()
    noise: float = 1e-9


def cells(*arrays: np.ndarray, places: int = 12) -> list[list[str]]:
    """Return numbers as text, row by row."""
    return [[f"{cell:.{places}f}" for cell in row] for row in np.column_stack(arrays)]


def lines(header: list[str], rows: list[list[str]], separator: str = ",") -> str:
    return "\n".join(separator.join(row) for row in [header, *rows]) + "\n"


def file(name: str, content: str | bytes) -> Callable[[Path], Path]:
    """Return what writes a file as it is."""

    def make(folder: Path) -> Path:
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        return folder / name

    return make


def headed(header: str, *arrays: np.ndarray, **said: Any) -> Kind:
    """Return a table in CSV."""
    return Kind(file("log.csv", lines(header.split(), cells(*arrays))), **said)


PLAIN = lines([*JOINTS, *"xyz"], cells(Q, XYZ))


def marked(word: str, row: list[str], column: int) -> list[str]:
    return [word if i == column else cell for i, cell in enumerate(row)]


def with_gaps() -> Kind:
    """Readings that were lost, each written otherwise."""
    words = {1: "n/a", 3: "", 4: "-", 6: "NaN", 8: "****", 9: "#N/A"}
    rows = [marked(words[i], row, 7) if i in words else row for i, row in enumerate(cells(Q, XYZ))]
    note = f"6 of {K} rows have an empty reading and are left out: line 3, 5, 6, 8, 10, ..."
    return Kind(file("log.csv", lines([*JOINTS, *"xyz"], rows)), note=note, left=(*words,))


def flagged() -> Kind:
    """A tracker that says where the beam was broken."""
    rows = [[*row, "beam broken" if i in (2, 5) else "OK"] for i, row in enumerate(cells(Q, XYZ))]
    text = lines([*JOINTS, *"xyz", "Status"], rows)
    return Kind(file("log.csv", text), note='2 of 12 rows are flagged in the column "Status"', left=(2, 5))


def workbook(sheets: Mapping[str, list[list[Any]]]) -> Callable[[Path], Path]:
    """Return what writes an Excel file."""

    def make(folder: Path) -> Path:
        book = openpyxl.Workbook()
        book.remove(book.active)
        for name, rows in sheets.items():
            sheet = book.create_sheet(name)
            for row in rows:
                sheet.append(row)
        book.save(folder / "log.xlsx")
        return folder / "log.xlsx"

    return make


BOOK = [[*SHORT, *"XYZ"], ["deg"] * 6 + ["mm"] * 3, *np.column_stack([DEG, MM]).tolist()]


def parquet(folder: Path) -> Path:
    pl.DataFrame(np.column_stack([Q, XYZ]), schema=[*JOINTS, *"xyz"]).write_parquet(folder / "log.parquet")
    return folder / "log.parquet"


def records() -> list[dict[str, Any]]:
    """Return poses as programs nest them."""
    named = [dict(zip("xyzw", q, strict=True)) for q in QUATERNIONS.tolist()]
    places = [dict(zip("xyz", p, strict=True)) for p in XYZ.tolist()]
    joints = [dict(zip(JOINTS, q, strict=True)) for q in Q.tolist()]
    poses = [{"position": p, "orientation": q} for p, q in zip(places, named, strict=True)]
    return [{"id": i, "joints": j, "pose": pose} for i, (j, pose) in enumerate(zip(joints, poses, strict=True))]


COLUMNS = {"robot_name": "KR 16", "joint_positions": Q.tolist(), "position": XYZ.tolist()}
LIST = {"samples": [{"joints": q, "T": T} for q, T in zip(Q.tolist(), MATRICES.tolist(), strict=True)]}


def npz(folder: Path) -> Path:
    np.savez(folder / "log.npz", q=Q, pose=MATRICES, counter=np.arange(K))
    return folder / "log.npz"


def mat(folder: Path) -> Path:
    scipy.io.savemat(folder / "log.mat", {"data": {"joints_deg": DEG, "position_mm": MM, "rms": np.ones(K)}})
    return folder / "log.mat"


def hand_poses() -> np.ndarray:
    """Return poses of the hand for a camera that stands still and an object on the hand."""
    camera, held = np.eye(4), np.eye(4)
    camera[:3, :3], camera[:3, 3] = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix(), [1.0, 0.2, 0.5]
    held[:3, :3], held[:3, 3] = Rotation.from_rotvec([1.0, 0.1, 0.0]).as_matrix(), [0.0, 0.1, 0.05]
    return np.asarray(camera @ MATRICES @ np.linalg.inv(held))


def moveit(seen: np.ndarray) -> Callable[[Path], Path]:
    """Return what writes the two files of MoveIt's hand-eye calibration."""

    def make(folder: Path) -> Path:
        hand = hand_poses().reshape(K, 16).tolist()
        pairs = zip(hand, seen.reshape(K, 16).tolist(), strict=True)
        samples = [{"effector_wrt_world": a, "object_wrt_sensor": b} for a, b in pairs]
        (folder / "samples.yaml").write_text(yaml.safe_dump(samples))
        (folder / "joints.yaml").write_text(yaml.safe_dump({"joint_names": [*JOINTS], "joint_values": Q.tolist()}))
        return folder / "samples.yaml"

    return make


def easy_handeye(folder: Path) -> Path:
    """Write the samples of easy_handeye and the joints that somebody wrote down."""

    def transform(T: np.ndarray) -> dict[str, dict[str, float]]:
        turn = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
        return {
            "translation": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
            "rotation": dict(zip("xyzw", turn, strict=True)),
        }

    samples = [{"robot": transform(a), "tracking": transform(b)} for a, b in zip(hand_poses(), MATRICES, strict=True)]
    (folder / "arm.samples").write_text(yaml.safe_dump({"samples": samples}))
    (folder / "joints.csv").write_text(lines([*JOINTS], cells(Q)))
    return folder / "arm.samples"


def moving(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return what is held and moved through at each time [s]."""
    step = np.minimum((at / (HOLD + MOVE)).astype(int), len(values) - 1)
    share = np.clip((at - (HOLD + MOVE) * step - HOLD) / MOVE, 0.0, 1.0)[:, None]
    return np.asarray(values[step] + share * (values[np.minimum(step + 1, len(values) - 1)] - values[step]))


def times(rate: float) -> np.ndarray:
    return np.arange(0.0, K * (HOLD + MOVE) - MOVE, 1.0 / rate)


def rtde(folder: Path) -> Path:
    """Write a log of a UR at 125 Hz with the tracker's readings beside the controller's own pose."""
    at = times(125.0)
    own = moving(RNG.uniform(-1.0, 1.0, (K, 6)), at)
    header = ["timestamp", *(f"actual_q_{i}" for i in range(6)), *(f"actual_TCP_pose_{i}" for i in range(6)), *"xyz"]
    rows = cells(at + 4711.0, moving(Q, at), own, moving(XYZ, at) + RNG.normal(0.0, 1e-5, (len(at), 3)), places=9)
    (folder / "rtde.csv").write_text(lines(header, rows, " "))
    return folder / "rtde.csv"


def two_logs(folder: Path) -> Path:
    """Write a log of joints at 500 Hz and one of a tracker at 50 Hz."""
    at, seen = times(500.0), times(50.0)
    (folder / "joints.csv").write_text(lines(["time", *JOINTS], cells(at, moving(Q, at), places=9)))
    (folder / "tracker.csv").write_text(lines(["time", *"xyz"], cells(seen, moving(XYZ, seen), places=9)))
    return folder / "tracker.csv"


def lerobot(folder: Path) -> Path:
    """Write a data set of LeRobot with two episodes and a tracker."""
    at = times(30.0)
    features = {"observation.state": {"names": [*JOINTS]}, "observation.tracker": {"names": [*"xyz"]}}
    (folder / "set" / "meta").mkdir(parents=True)
    (folder / "set" / "meta" / "info.json").write_text(json.dumps({"fps": 30, "features": features}))
    values = {"observation.state": moving(Q, at).tolist(), "observation.tracker": moving(XYZ, at).tolist()}
    half = int((HOLD + MOVE) * (K // 2) * 30)
    for i, part in enumerate((slice(0, half), slice(half, None))):
        frame = pl.DataFrame({name: value[part] for name, value in values.items()} | {"timestamp": at[part] - at[part][0]})
        place = folder / "set" / "data" / "chunk-000" / f"episode_{i:06d}.parquet"
        place.parent.mkdir(parents=True, exist_ok=True)
        frame.with_columns(pl.lit(i).alias("episode_index")).write_parquet(place)
    return folder / "set"


def recording(storage: str, *, frames: bool, in_hand: bool = False) -> Callable[[Path], Path]:
    """Return what writes a recording of ROS with a topic of poses, or with /tf and /tf_static alone."""

    def make(folder: Path) -> Path:
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        t = store.types
        stamp = t["builtin_interfaces/msg/Time"](0, 0)

        def transform(parent: str, child: str, place: np.ndarray, turn: np.ndarray) -> Any:
            where = t["geometry_msgs/msg/Transform"](
                t["geometry_msgs/msg/Vector3"](*place), t["geometry_msgs/msg/Quaternion"](*turn)
            )
            return t["geometry_msgs/msg/TransformStamped"](t["std_msgs/msg/Header"](stamp, parent), child, where)

        messages = list[tuple[float, str, Any]]()
        for at, q in zip(times(50.0), moving(Q, times(50.0)), strict=True):
            state = t["sensor_msgs/msg/JointState"](
                t["std_msgs/msg/Header"](stamp, ""), [*JOINTS], q, np.zeros(0), np.zeros(0)
            )
            messages.append((at, "/joint_states", state))
        seen = times(10.0)
        for at, place, turn, q in zip(seen, moving(XYZ, seen), moving(QUATERNIONS, seen), moving(Q, seen), strict=True):
            link = transform("base", "link_1", np.array([0, 0, 0.4]), Rotation.from_rotvec([0, 0, q[0]]).as_quat())
            turned = Rotation.from_quat(turn)
            if in_hand:
                place, turned = -turned.inv().apply(place), turned.inv()
            read = transform("camera", "marker", place, turned.as_quat())
            if frames:
                messages.append((at + 0.003, "/tf", t["tf2_msgs/msg/TFMessage"]([link, read])))
            else:
                message = t["geometry_msgs/msg/TransformStamped"](read.header, "marker", read.transform)
                messages.append((at + 0.003, "/vicon/marker", message))
        parent = "link_1" if in_hand else "base"
        fixed = transform(parent, "camera", np.array([0.1, 0, 0]), np.array([0, 0, 0, 1.0]))
        messages.append((0.0, "/tf_static", t["tf2_msgs/msg/TFMessage"]([fixed])))
        plugin = getattr(rosbag2.StoragePlugin, storage)
        with rosbag2.Writer(folder / "bag", version=9, storage_plugin=plugin) as writer:
            topics: dict[str, Any] = {}
            for at, topic, message in sorted(messages, key=lambda each: each[0]):
                name = message.__msgtype__
                topics.setdefault(topic, None)
                topics[topic] = topics[topic] or writer.add_connection(topic, name, typestore=store)
                writer.write(topics[topic], int(1e18 + 1e9 * at), store.serialize_cdr(message, name))
        return folder / "bag"

    return make


def with_joints(name: str) -> dict[str, str]:
    return {"joints": name}


KUKA = np.degrees(TURNED.as_euler("ZYX"))
FANUC = np.degrees(TURNED.as_euler("xyz"))
ABB = QUATERNIONS[:, [3, 0, 1, 2]]
UR = TURNED.as_rotvec()
IN_MM = " ".join(f"A{i}[deg]" for i in range(1, 7)) + " X[mm] Y[mm] Z[mm] "
SA = [["SpatialAnalyzer 2024.1"], ["Collection: Robot cell", "Instrument: AT960"], []]
SA += [["Group", "Point Name", "X [mm]", "Y [mm]", "Z [mm]", "Total RMS", "Std X", *(f"{a} [deg]" for a in SHORT)]]
SA += [["Main", f"P{i}", *row[:3], "0.012", "0.004", *row[3:]] for i, row in enumerate(cells(MM, DEG))]
LEICA = [["PointID", "X", "Y", "Z", "StdX", "StdY", "StdZ", "Date", "Time", *SHORT]]
LEICA += [["", "mm", "mm", "mm", "mm", "mm", "mm", "", "", *["°"] * 6]]
LEICA += [
    [f"P{i}", *r[:3], "0,01", "0,01", "0,02", "11.02.2026", f"10:{i:02}:30", *r[3:]] for i, r in enumerate(cells(MM, DEG))
]
COMMAS = "\n".join(";".join(row).replace(".", ",") for row in LEICA[2:]).replace("11,02,2026", "11.02.2026")
VICON = "Trajectories\n100\n,,Robot:Flange,,\nFrame,Sub Frame,X,Y,Z\n,,mm,mm,mm\n"
VICON += "\n".join(f"{10 * i},0,{','.join(row)}" for i, row in enumerate(cells(MM))) + "\n"


def vicon(folder: Path) -> Path:
    rows = [[f"{10 * i}", *row] for i, row in enumerate(cells(Q))]
    (folder / "joints.csv").write_text(lines(["Frame", *JOINTS], rows))
    return file("marker.csv", VICON)(folder)


TITLES = "Report of cell 3\nRobot,KR 16\nSerial number,12345\nDate,2026-11-02,by Ann\n\n"
GROUPS = ",".join(["Robot", *[""] * 5, "Tracker", "", ""]) + "\n"
EXTRA = [[str(i), *row, "0.013", "97", "warm"] for i, row in enumerate(cells(Q, XYZ))]

KINDS: dict[str, Kind] = {
    "comma": Kind(file("log.csv", PLAIN)),
    "semicolon, decimal comma": Kind(file("log.csv", PLAIN.replace(",", ";").replace(".", ","))),
    "tab": Kind(file("log.tsv", PLAIN.replace(",", "\t"))),
    "blanks": Kind(file("log.txt", PLAIN.replace(",", "   "))),
    "UTF-8 with a mark, CRLF": Kind(file("log.csv", "\ufeff" + PLAIN.replace("\n", "\r\n"))),
    "UTF-16": Kind(file("log.txt", PLAIN.replace(",", "\t").encode("utf-16"))),
    "Latin-1, degree signs": Kind(
        file("log.csv", lines([f"{a} [°]" for a in SHORT] + list("xyz"), cells(DEG, XYZ)).encode("latin-1"))
    ),
    "units in the header": headed(IN_MM, DEG, MM),
    "a position by other names": headed(
        "Achse_1 Achse_2 Achse_3 Achse_4 Achse_5 Achse_6 TCP_X/mm TCP_Y/mm TCP_Z/mm Fx Fy Fz", Q, MM, np.ones((K, 3)),
        note="the position is taken from the columns TCP_X/mm=x [mm]",
    ),
    "a unit in each name": headed(
        " ".join(f"JointAngle{i}_deg" for i in range(1, 7)) + " pos_x_mm pos_y_mm pos_z_mm", DEG, MM,
    ),
    "a first column called #": Kind(
        file("log.csv", lines(["#", *JOINTS, *(f"P{axis}" for axis in "xyz"), "RMS", "Temp IR", "remark"], EXTRA))
    ),
    "a row of units": Kind(
        file("log.csv", lines([*SHORT, *"XYZ"], [["degrees"] * 6 + ["MM"] * 3, *cells(DEG, MM)])),
        note="the names of the columns are taken from line 1, units from line 2",
    ),
    "titles above": Kind(file("log.csv", TITLES + PLAIN), note="4 other lines above the numbers are left out"),
    "a second header": Kind(file("log.csv", GROUPS + PLAIN), note="the names of the columns are taken from line 2"),
    "readings lost": with_gaps(),
    "readings flagged": flagged(),
    "comments, names in the last": Kind(file("log.txt", "# by hand\n# " + PLAIN.replace(",", " "))),
    "counters, RMS, comments": Kind(
        file("log.csv", lines(["No.", *JOINTS, *"xyz", "RMS", "Temp IR", "remark"], EXTRA)),
        note='columns unknown to pincal are ignored: "No.", "RMS", "Temp IR"',
    ),
    "Excel with title and units": Kind(workbook({"log": [["Cell 3"], *BOOK]}), note="units from line 3"),
    "Excel with two worksheets": Kind(
        workbook({"parts": [["part", "mass"], ["gripper", 3.5]], "poses": BOOK}),
        note="worksheet poses is read; worksheets parts are not read (--sheet NAME",
    ),
    "Excel, a worksheet by name": Kind(
        workbook({"monday": [BOOK[0], BOOK[1], *(2 * np.array(BOOK[2:])).tolist()], "tuesday": BOOK}), {"sheet": "tuesday"}
    ),
    "Parquet": Kind(parquet),
    "JSON, nested records": Kind(file("log.json", json.dumps(records())), is_pose=True),
    "JSON, columns of lists": Kind(file("log.json", json.dumps(COLUMNS))),
    "JSON lines": Kind(file("log.jsonl", "\n".join(map(json.dumps, records()))), is_pose=True),
    "YAML, matrices": Kind(file("log.yaml", yaml.safe_dump(LIST)), is_pose=True),
    "npz": Kind(npz, is_pose=True),
    "mat": Kind(mat),
    "MoveIt": Kind(moveit(MATRICES), with_joints("joints.yaml"), "camera fixed", is_pose=True),
    "easy_handeye": Kind(easy_handeye, with_joints("joints.csv"), "camera fixed", is_pose=True),
    "LeRobot": Kind(lerobot, note=f"at 30 Hz is cut into the {K} poses that are held still", noise=1e-7),
    "rosbag2": Kind(recording("SQLITE3", frames=False), note=f"{K} poses held still", is_pose=True),
    "MCAP with /tf": Kind(recording("MCAP", frames=True), note="readings from /tf camera > marker", is_pose=True),
    "MCAP with /tf, camera in the hand": Kind(
        recording("MCAP", frames=True, in_hand=True), note="camera is on the moving link_1", is_pose=True
    ),
    "RTDE log": Kind(rtde, note=f"at 125 Hz is cut into the {K} poses that are held still", noise=1e-5),
    "joints and tracker logged": Kind(two_logs, with_joints("joints.csv"), f"cut into the {K} poses", noise=1e-8),
    "KUKA A B C": headed(IN_MM + "A B C", DEG, MM, KUKA, note="read as KUKA", is_pose=True),
    "ABB q1 q2 q3 q4": headed("rax_1 rax_2 rax_3 rax_4 rax_5 rax_6 x y z q1 q2 q3 q4", Q, XYZ, ABB, is_pose=True),
    "FANUC W P R": headed(IN_MM.replace("A", "J") + "W P R", DEG, MM, FANUC, is_pose=True),
    "UR rx ry rz": headed("q1 q2 q3 q4 q5 q6 x y z rx ry rz", Q, XYZ, UR, is_pose=True),
    "like SpatialAnalyzer": Kind(file("sa.csv", "\n".join(map(",".join, SA)) + "\n"), note='"Total RMS", "Std X"'),
    "like Leica": Kind(file("leica.txt", ";".join(LEICA[0]) + "\n" + ";".join(LEICA[1]) + "\n" + COMMAS + "\n")),
    "like Vicon": Kind(vicon, with_joints("joints.csv"), "units from line 5"),
}  # fmt: skip


def read(kind: Kind, folder: Path) -> tuple[Any, list[str], float]:
    """Return what is read, the notes, and the seconds."""
    path = kind.make(folder)
    options = {name: folder / value if name == "joints" else value for name, value in kind.options.items()}
    start = time.perf_counter()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", PincalWarning)
        found = read_measurements(path, JOINTS, **options)
    return found, [str(each.message) for each in caught], time.perf_counter() - start


@pytest.mark.parametrize("name", KINDS)
def test_a_kind_of_file_is_read_within_seconds(tmp_path: Path, name: str) -> None:
    """Joints and readings are those that were measured, and what was left out or inferred is told."""
    kind = KINDS[name]
    found, notes, seconds = read(kind, tmp_path)
    kept = np.delete(np.arange(K), kind.left)

    assert found.kind == ("pose" if kind.is_pose else "position")
    np.testing.assert_allclose(found.q, Q[kept], rtol=0, atol=max(kind.noise, 1e-9))
    np.testing.assert_allclose(found.position, XYZ[kept], rtol=0, atol=max(kind.noise, 1e-9))
    if kind.is_pose:
        turn = Rotation.from_quat(found.quaternion) * TURNED[kept].inv()
        assert turn.magnitude().max() < 1e-7
    assert kind.note in "\n".join(notes)
    assert seconds < 5.0
    print(f"{name}: {' '.join(kind.options) or 'no option'}, {seconds:.2f} s")


def test_most_kinds_need_no_option() -> None:
    """Of thirty kinds and more nine in ten are read without a word of help, all with one option."""
    without = [name for name, kind in KINDS.items() if not kind.options]

    assert len(KINDS) >= 30 and len(without) >= 0.87 * len(KINDS)
    assert all(len(kind.options) <= 1 for kind in KINDS.values())


@pytest.mark.parametrize("is_exact", [True, False])
def test_poses_that_the_controller_computed_are_called_that(is_exact: bool) -> None:
    """Rounded poses of the nominal model are a doubt; those of a controller with parameters of its own are a note."""
    robot = Robot.from_urdf(kuka_urdf_path())
    offsets = np.zeros(6) if is_exact else np.array([0.0, 2e-3, -1e-3, 0.0, 1e-3, 0.0])
    machine = TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0", joint_offsets=offsets)
    q = robot.random_configurations(80, np.random.default_rng(1)).round(6)
    tips = machine.tip(q)[:, :3, 3].round(6)
    table = measurements_from_arrays(robot.joint_names, q, position=tips)
    notes = run_calibration(robot, table, Options(effects=GEOMETRIC)).result.warnings
    told = [note for note in notes if "computed" in note.text]

    assert [note.is_doubt for note in told] == [is_exact]


def test_samples_that_show_no_camera_on_the_hand_are_refused(tmp_path: Path) -> None:
    """Rotations about one axis are those of a camera on the hand and of a fixed one; about several, of one of the two."""
    with pytest.warns(PincalWarning, match="camera fixed and the object on the hand"):
        open_nested(moveit(MATRICES)(tmp_path), "yaml")
    alike = np.tile(np.eye(4), (K, 1, 1))
    noise = np.random.default_rng(3).normal(0.0, 1e-3, (K, 3))
    alike[:, :3, :3] = Rotation.from_rotvec(noise + np.linspace(0.0, 2.0, K)[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    pairs = zip(alike.reshape(K, 16).tolist(), np.roll(alike, 1, axis=0).reshape(K, 16).tolist(), strict=True)
    samples = [{"effector_wrt_world": a, "object_wrt_sensor": b} for a, b in pairs]
    (tmp_path / "samples.yaml").write_text(yaml.safe_dump(samples))
    with pytest.raises(MeasurementError, match="do not show whether the camera is on the hand"):
        open_nested(tmp_path / "samples.yaml", "yaml")
