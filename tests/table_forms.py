"""Forms in which people store poses of a hand and of what they measured: of one machine, small, and read back.

``python tests/table_forms.py`` reads these and the kinds of ``test_table_kinds.py``, and prints how many need no option, how
many are refused with the line that cures, and how many are read wrongly.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
from scipy.spatial.transform import Rotation
from test_table_kinds import (
    DEG,
    JOINTS,
    KINDS,
    MATRICES,
    MM,
    QUATERNIONS,
    TURNED,
    XYZ,
    K,
    Kind,
    Q,
    cells,
    file,
    hand_poses,
    headed,
    lines,
    read,
    workbook,
)

from pincal.errors import MeasurementError

NAMES = " ".join(JOINTS) + " "
RVEC, RPY = TURNED.as_rotvec(), TURNED.as_euler("xyz")
SCALAR_FIRST = QUATERNIONS[:, [3, 0, 1, 2]]
FLAT, BY_COLUMN = MATRICES.reshape(K, 16), MATRICES.transpose(0, 2, 1).reshape(K, 16)
TRANSFORMS = MATRICES[:, :3].reshape(K, 12)
ROTATIONS = MATRICES[:, :3, :3].reshape(K, 9)


def places(name: str, rows: int, columns: int, start: int = 0) -> str:
    """Return the names of the elements of a matrix."""
    return " ".join(name.format(i, j) for i in range(start, start + rows) for j in range(start, start + columns))


def numbers(name: str, count: int, start: int = 0) -> str:
    return " ".join(name.format(i) for i in range(start, start + count))


def saved(name: str, content: Any) -> Callable[[Path], Path]:
    """Return what writes values as JSON."""
    return file(name, json.dumps(content))


def npz(**arrays: np.ndarray) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        np.savez(folder / "log.npz", **arrays)
        return folder / "log.npz"

    return make


def npy(array: np.ndarray) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        np.save(folder / "log.npy", array)
        return folder / "log.npy"

    return make


def mat(**arrays: np.ndarray) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        scipy.io.savemat(folder / "log.mat", arrays)
        return folder / "log.mat"

    return make


def structured() -> np.ndarray:
    """Return a record of numpy for each pose."""
    found = np.zeros(K, [(name, float) for name in (*JOINTS, *"xyz")])
    for name, column in zip((*JOINTS, *"xyz"), np.column_stack([Q, XYZ]).T, strict=True):
        found[name] = column
    return found


def storage(form: str) -> Callable[[Path], Path]:
    """Return what writes OpenCV's FileStorage as its documentation shows it."""

    def in_yaml(name: str, values: np.ndarray) -> str:
        rows, columns = values.shape
        data = ", ".join(map(repr, values.ravel().tolist()))
        return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {data} ]\n"

    def in_xml(name: str, values: np.ndarray) -> str:
        rows, columns = values.shape
        data = " ".join(map(repr, values.ravel().tolist()))
        size = f"<rows>{rows}</rows><cols>{columns}</cols><dt>d</dt>"
        return f'<{name} type_id="opencv-matrix">{size}\n<data>{data}</data></{name}>\n'

    def in_json(name: str, values: np.ndarray) -> str:
        rows, columns = values.shape
        stated = {"type_id": "opencv-matrix", "rows": rows, "cols": columns, "dt": "d", "data": values.ravel().tolist()}
        return f'"{name}": {json.dumps(stated)}'

    pairs = [pair for k in range(K) for pair in ((f"joints_{k}", Q[k : k + 1]), (f"T_{k}", MATRICES[k]))]
    if form == "yml":
        return file("poses.yml", f"%YAML:1.0\n---\nframes: {K}\n" + "".join(in_yaml(*pair) for pair in pairs))
    if form == "xml":
        body = "".join(in_xml(*pair) for pair in pairs)
        return file("poses.xml", f'<?xml version="1.0"?>\n<opencv_storage>\n<frames>{K}</frames>\n{body}</opencv_storage>\n')
    return file("poses.json", "{" + ",\n".join(in_json(*pair) for pair in pairs) + "}")


def stacked(folder: Path) -> Path:
    """Write one matrix of OpenCV for all joints, and vectors with a row and three channels each."""
    text = "%YAML:1.0\n---\n"
    for name, values, kind in (("joints", Q, "d"), ("tvecs", XYZ, "3d"), ("rvecs", RVEC, "3d")):
        columns = 1 if kind == "3d" else values.shape[1]
        data = ", ".join(map(repr, values.ravel().tolist()))
        text += f"{name}: !!opencv-matrix\n   rows: {K}\n   cols: {columns}\n   dt: {kind}\n   data: [ {data} ]\n"
    return file("poses.yaml", text)(folder)


def keyed(named: Mapping[str, Any], key: str = "pose_{}") -> dict[str, Any]:
    """Return a mapping from each pose to its values."""
    return {key.format(k): {name: values[k].tolist() for name, values in named.items()} for k in range(K)}


def vectors_of_opencv() -> list[dict[str, Any]]:
    pairs = zip(Q.tolist(), RVEC[:, :, None].tolist(), XYZ[:, :, None].tolist(), strict=True)
    return [{"joint_pose": q, "rvec": rvec, "tvec": tvec} for q, rvec, tvec in pairs]


def lists_in_cells() -> str:
    rows = [f'{k},"{q}","{p}"' for k, (q, p) in enumerate(zip(Q.tolist(), XYZ.tolist(), strict=True))]
    return "\n".join([",joint_angles,position", *rows]) + "\n"


def with_index() -> str:
    rows = [",".join([str(k), *row]) for k, row in enumerate(cells(Q, XYZ))]
    return "\n".join([",".join(["", *JOINTS, *"xyz"]), *rows]) + "\n"


def by_columns() -> dict[str, Any]:
    """Return a data frame of pandas as its to_json writes it."""
    table = zip((*JOINTS, *"xyz"), np.column_stack([Q, XYZ]).T.tolist(), strict=True)
    return {name: dict(zip(map(str, range(K)), column, strict=True)) for name, column in table}


def split_frame() -> dict[str, Any]:
    rows = np.column_stack([Q, XYZ]).tolist()
    return {"columns": [*JOINTS, *"xyz"], "index": [*range(K)], "data": rows}


def messages() -> str:
    """Return what ``rostopic echo`` prints of a message with joints and a pose."""
    rows = zip(Q.tolist(), XYZ.tolist(), QUATERNIONS.tolist(), strict=True)
    texts = []
    for q, p, turn in rows:
        place = "".join(f"    {axis}: {value!r}\n" for axis, value in zip("xyz", p, strict=True))
        turned = "".join(f"    {axis}: {value!r}\n" for axis, value in zip("xyzw", turn, strict=True))
        texts.append(f"joints: {q}\npose:\n  position:\n{place}  orientation:\n{turned}---\n")
    return "".join(texts)


def eye_in_hand() -> tuple[np.ndarray, np.ndarray]:
    """Return poses of the hand and of a fixed object in a camera on the hand, which sees what is stated of the tool."""
    mount, board = np.eye(4), np.eye(4)
    mount[:3, :3], mount[:3, 3] = Rotation.from_rotvec([0.2, 0.1, 1.0]).as_matrix(), [0.05, 0.0, 0.1]
    board[:3, :3], board[:3, 3] = Rotation.from_rotvec([1.0, -0.3, 0.2]).as_matrix(), [0.6, 0.1, 0.0]
    # The camera in the frame of the board is what was measured.
    return board @ MATRICES @ np.linalg.inv(mount), np.linalg.inv(MATRICES)


HAND, SEEN = eye_in_hand()
OPENCV = {"R_gripper2base": HAND[:, :3, :3], "t_gripper2base": HAND[:, :3, 3:]}
OPENCV |= {"R_target2cam": SEEN[:, :3, :3], "t_target2cam": SEEN[:, :3, 3:], "joints": Q}
BOTH = [
    {"q": q, "T_base_ee": a, "T_cam_marker": b}
    for q, a, b in zip(Q.tolist(), hand_poses().tolist(), MATRICES.tolist(), strict=True)
]
ROBOT_TOO = {"joint_angles": Q.tolist(), "T_base_flange": hand_poses().tolist(), "marker_pose": MATRICES.tolist()}
ROSTOPIC = "pose.position.x pose.position.y pose.position.z "
ROSTOPIC += "pose.orientation.x pose.orientation.y pose.orientation.z pose.orientation.w"
COMMAS = "\n".join(";".join(row).replace(".", ",") for row in cells(Q, FLAT))

FORMS: dict[str, Kind] = {
    "4 x 4 matrix, m_00 to m_33": headed(NAMES + places("m_{}{}", 4, 4), Q, FLAT, is_pose=True, note="as a 4 x 4 matrix"),
    "4 x 4 matrix, T11 to T44": headed(NAMES + places("T{}{}", 4, 4, 1), Q, FLAT, is_pose=True),
    "4 x 4 matrix, T[0][0] to T[3][3]": headed(NAMES + places("T[{}][{}]", 4, 4), Q, FLAT, is_pose=True),
    "4 x 4 matrix, pose_0 to pose_15": headed(NAMES + numbers("pose_{}", 16), Q, FLAT, is_pose=True),
    "4 x 4 matrix, column by column": headed(NAMES + numbers("T_meas_{}", 16), Q, BY_COLUMN, is_pose=True),
    "3 x 4 matrix": headed(NAMES + places("T_{}{}", 3, 4), Q, TRANSFORMS, is_pose=True),
    "3 x 4 matrix by number, from 1": headed(NAMES + numbers("H{}", 12, 1), Q, TRANSFORMS, is_pose=True),
    "matrix, decimal commas, semicolons": Kind(
        file("log.csv", (NAMES + places("T_{}{}", 4, 4)).strip().replace(" ", ";") + "\n" + COMMAS + "\n"), is_pose=True
    ),
    "r11 to r33 and tx ty tz": headed(NAMES + places("r{}{}", 3, 3, 1) + " tx ty tz", Q, ROTATIONS, XYZ, is_pose=True),
    "x y z and R_00 to R_22": headed(NAMES + "x y z " + places("R_{}{}", 3, 3), Q, XYZ, ROTATIONS, is_pose=True),
    "tx ty tz qw qx qy qz": headed(NAMES + "tx ty tz qw qx qy qz", Q, XYZ, SCALAR_FIRST, is_pose=True),
    "pos_x and quat_w first": headed(
        NAMES + "pos_x pos_y pos_z quat_w quat_x quat_y quat_z", Q, XYZ, SCALAR_FIRST, is_pose=True,
        note="position and orientation is taken from the columns",
    ),
    "pose.position.x, pose.orientation.w": headed(NAMES + ROSTOPIC, Q, XYZ, QUATERNIONS, is_pose=True),
    "tvec_x and rvec_x": headed(
        NAMES + "rvec_x rvec_y rvec_z tvec_x tvec_y tvec_z", Q, RVEC, XYZ, is_pose=True, note="rotation vector"
    ),
    "tvec_0 and rvec_0": headed(NAMES + numbers("tvec_{}", 3) + " " + numbers("rvec_{}", 3), Q, XYZ, RVEC, is_pose=True),
    "an index without a name": Kind(file("log.csv", with_index())),
    "lists in cells, as pandas writes them": Kind(file("log.csv", lists_in_cells())),
    "a row of names after #, tabs": Kind(file("log.txt", "#" + lines([*JOINTS, *"xyz"], cells(Q, XYZ), "\t"))),
    "JSON by pose": Kind(saved("poses.json", keyed({"joints": Q, "T": MATRICES})), is_pose=True),
    "JSON by number of the pose, nested": Kind(
        saved("poses.json", {"robot_name": "KR 16", "poses": keyed({"joint_angles_deg": DEG, "position_mm": MM}, "{}")})
    ),
    "JSON, joint_pose and vectors of 3 x 1": Kind(saved("poses.json", vectors_of_opencv()), is_pose=True),
    "JSON, xyzrpy": Kind(
        saved("log.json", {"q": Q.tolist(), "pose_rpy": np.column_stack([XYZ, RPY]).tolist()}), is_pose=True
    ),
    "JSON, quaternion w first": Kind(
        saved("log.json", {"jointAngles": Q.tolist(), "pose_wxyz": np.column_stack([XYZ, SCALAR_FIRST]).tolist()}),
        is_pose=True,
    ),
    "JSON, sixteen numbers by column": Kind(saved("log.json", {"q": Q.tolist(), "T": BY_COLUMN.tolist()}), is_pose=True),
    "JSON of pandas, by columns": Kind(saved("log.json", by_columns())),
    "JSON of pandas, split": Kind(saved("log.json", split_frame())),
    "JSON, the controller's pose beside": Kind(saved("log.json", ROBOT_TOO), is_pose=True),
    "JSON, hand and object": Kind(saved("log.json", BOTH), note="with the camera fixed", is_pose=True),
    "YAML, a document for each pose": Kind(file("echo.yaml", messages()), is_pose=True),
    "OpenCV's YAML": Kind(storage("yml"), is_pose=True),
    "OpenCV's XML": Kind(storage("xml"), is_pose=True),
    "OpenCV's JSON": Kind(storage("json"), is_pose=True),
    "OpenCV's YAML, stacked": Kind(stacked, is_pose=True),
    "npz as for calibrateHandEye": Kind(npz(**OPENCV), note="with the camera on the hand", is_pose=True),
    "npz, a pose in each column": Kind(npz(q=Q.T, p=XYZ.T)),
    "npz, 4 x 4 x N": Kind(npz(joints=Q.T, T=MATRICES.transpose(1, 2, 0)), is_pose=True),
    "npz, an array for each pose": Kind(
        npz(**{f"{name}_{k}": of[k] for k in range(K) for name, of in (("q", Q), ("T", MATRICES))}), is_pose=True
    ),
    "mat, a pose in each column": Kind(mat(Q=Q.T, P=XYZ.T)),
    "npy with names": Kind(npy(structured())),
}  # fmt: skip


def dotted(cell: str, between: str, point: str = ".") -> str:
    """Return a number with separators between its thousands."""
    return f"{float(cell):,.9f}".replace(".", "_").replace(",", between).replace("_", point)


def with_cells(place: Callable[[str], str], separator: str = ";") -> Kind:
    """Return a table in degrees and millimetres whose lengths are written in some way, with their decimal mark."""
    names = [*(f"{name} [deg]" for name in JOINTS), "x [mm]", "y [mm]", "z [mm]"]
    comma = "," in place("0.5")
    angles = [[cell.replace(".", ",") if comma else cell for cell in row] for row in cells(DEG)]
    rows = [[*q, *(f'"{place(cell)}"' for cell in p)] for q, p in zip(angles, cells(MM), strict=True)]
    return Kind(file("log.csv", lines(names, rows, separator)))


def lost(number: str, *, unit: str = "") -> Kind:
    """Return a table with a number in place of two readings."""
    rows = cells(Q, MM if unit else XYZ)
    for k in (2, 7):
        rows[k][6:] = [number] * 3
    names = [*JOINTS, *(f"{axis}{unit}" for axis in "xyz")]
    return Kind(file("log.csv", lines(names, rows)), note="a number in place of a reading", left=(2, 7))


def text_in_cells(folder: Path) -> Path:
    """Write a workbook whose numbers are text with decimal commas."""
    return workbook({"Tabelle1": [[*JOINTS, *"xyz"], *([c.replace(".", ",") for c in row] for row in cells(Q, XYZ))]})(
        folder
    )


def as_csv(folder: Path) -> Path:
    """Write a workbook under the name of a text."""
    made = workbook({"Sheet1": [[*JOINTS, *"xyz"], *np.column_stack([Q, XYZ]).tolist()]})(folder)
    return made.rename(folder / "log.csv")


PLAIN_LINES = lines([*JOINTS, *"xyz"], cells(Q, XYZ))
UNITS_ROW = [["Grad"] * 6 + ["mm"] * 3]
OF_GROUPS = ["Joints [deg]", *[""] * 5, "Position [mm]", "", ""]
OF_URSCRIPT = [
    [f'"[{", ".join(q)}]"', f'"p[{", ".join(p)}]"'] for q, p in zip(cells(Q), cells(XYZ, RVEC), strict=True)
]  # fmt: skip
FORMS |= {
    "separated by |": Kind(file("log.csv", lines([*JOINTS, *"xyz"], cells(Q, XYZ), "|"))),
    "a comma at the end of each row": Kind(file("log.csv", PLAIN_LINES.replace("\n", ",\n").replace(",\n", "\n", 1))),
    "UTF-32": Kind(file("log.csv", PLAIN_LINES.encode("utf-32"))),
    "a workbook called CSV": Kind(as_csv),
    "text with decimal commas in a workbook": Kind(text_in_cells),
    "German units in a row": Kind(file("log.csv", lines([*JOINTS, *"xyz"], UNITS_ROW + cells(DEG, MM)))),
    "units above groups of columns": Kind(
        file("log.csv", lines(OF_GROUPS, [[*(f"A{i}" for i in range(1, 7)), *"XYZ"], *cells(DEG, MM)])),
        note="units from line 1",
    ),
    "turns": headed(" ".join(f"{name}[rev]" for name in JOINTS) + " x y z", Q / (2.0 * np.pi), XYZ),
    "inches in words": headed(NAMES + "x[inch] y[inch] z[inch]", Q, XYZ / 0.0254),
    "q[0] to q[5]": headed(" ".join(f"q[{i}]" for i in range(6)) + " x y z", Q, XYZ),
    "exponents of Fortran": Kind(
        file("log.csv", lines([*JOINTS, *"xyz"], [[f"{float(c):.12E}".replace("E", "D") for c in r] for r in cells(Q, XYZ)]))
    ),
    "a true minus sign": Kind(file("log.csv", PLAIN_LINES.replace("-", "\N{MINUS SIGN}"))),
    "thousands 1,234.5": with_cells(lambda cell: dotted(cell, ","), ","),
    "thousands 1.234,5": with_cells(lambda cell: dotted(cell, ".", ",")),
    "thousands 1'234.5": with_cells(lambda cell: dotted(cell, "'")),
    "thousands 1 234.5": with_cells(lambda cell: dotted(cell, "\N{NARROW NO-BREAK SPACE}")),
    "-9999 where the beam was broken": lost("-9999"),
    "-9999 mm": lost("-9999", unit=" [mm]"),
    "0 0 0 for a lost target": lost("0"),
    "65535 in all axes": lost("65535"),
    "a pose of URScript in a cell": Kind(file("log.csv", lines(["joints", "pose"], OF_URSCRIPT)), is_pose=True),
    "q0 to q3, the scalar first": headed(
        NAMES + "x y z q0 q1 q2 q3", Q, XYZ, SCALAR_FIRST, is_pose=True, note="a quaternion w x y z"
    ),
}


@dataclass(frozen=True)
class Refused:
    """A form that is refused with the words that cure.

    Attributes:
        make: writes it into a folder and returns its path.
        says: what the refusal has to propose.
        options: the same as options, by which it is read.
        is_pose: whether it has orientations.
    """

    make: Callable[[Path], Path]
    says: str
    options: Mapping[str, Any] = field(default_factory=dict)
    is_pose: bool = False


TABLE = np.column_stack([Q, XYZ])
BY_NUMBER = {str(i + 1): name for i, name in enumerate((*JOINTS, *"xyz"))}
IN_DEGREES = {str(i + 1): f"{name} [deg]" for i, name in enumerate(JOINTS)}
IN_DEGREES |= {"7": "x [mm]", "8": "y [mm]", "9": "z [mm]"}
MATRIX_NAMES = [f"r{i + 1}{j + 1}" if j < 3 else "xyz"[i] for i in range(3) for j in range(4)]


def said(columns: Mapping[str, str]) -> str:
    """Return the option that names columns."""
    return "--columns '" + ",".join(f"{name}={meaning}" for name, meaning in columns.items()) + "'"


def options(columns: Mapping[str, str]) -> dict[str, Any]:
    return {"columns": dict(columns)}


HEADER = ",".join((*JOINTS, *"xyz"))
FROM_ZERO = {str(int(name) - 1): meaning for name, meaning in BY_NUMBER.items()}
COUNTED = {str(i + 1): name for i, name in enumerate(("", *"xyz", *JOINTS)) if name}
RENAMED = dict(zip(("basis", "schulter", "ellbogen", "hand1", "hand2", "hand3"), JOINTS, strict=True))
BY_INDEX = {f"/joint_states/position[{i}]": name for i, name in enumerate(JOINTS)}
QUAT, OF_QUAT = [f"quat_{i}" for i in range(4)], ["qw", "qx", "qy", "qz"]
AS_MATRIX = {str(i + 1): name for i, name in enumerate((*JOINTS, *MATRIX_NAMES))}
WITH_TURN = {str(i + 1): name for i, name in enumerate((*JOINTS, *"xyz", "qx", "qy", "qz", "qw"))}

REFUSED: dict[str, Refused] = {
    "CSV without names": Refused(
        file("log.csv", lines([], cells(Q, XYZ))[1:]), f"first line: {HEADER}  or give {said(BY_NUMBER)}", options(BY_NUMBER)
    ),
    "text of savetxt, degrees and mm": Refused(
        file("log.txt", lines([], cells(DEG, MM), " ")[1:]), said(IN_DEGREES), options(IN_DEGREES)
    ),
    "decimal commas without names": Refused(
        file("log.csv", lines([], cells(Q, XYZ), ";")[1:].replace(".", ",")), said(BY_NUMBER), options(BY_NUMBER)
    ),
    "a counter and the position first": Refused(
        file("log.csv", lines([], [[str(k), *row] for k, row in enumerate(cells(MM, DEG), 1)])[1:]),
        "2=x [mm],3=y [mm],4=z [mm],5=joint_a1 [deg]",
        options({n: f"{m} [deg]" if int(n) > 4 else f"{m} [mm]" for n, m in COUNTED.items()}),
    ),
    "numbers for names, as pandas writes them": Refused(
        file("log.csv", lines([*map(str, range(9))], cells(Q, XYZ))), said(FROM_ZERO), options(FROM_ZERO)
    ),
    "npy": Refused(npy(TABLE), said(BY_NUMBER), options(BY_NUMBER)),
    "npy, a pose in each column": Refused(npy(TABLE.T), said(BY_NUMBER), options(BY_NUMBER)),
    "npz of one array": Refused(npz(arr_0=TABLE), said(BY_NUMBER), options(BY_NUMBER)),
    "mat of one matrix": Refused(mat(data=TABLE), said(BY_NUMBER), options(BY_NUMBER)),
    "JSON, lists of numbers": Refused(saved("log.json", TABLE.tolist()), said(BY_NUMBER), options(BY_NUMBER)),
    "a matrix without names": Refused(
        npy(np.column_stack([Q, TRANSFORMS])), said(AS_MATRIX), options(AS_MATRIX), is_pose=True
    ),
    "a quaternion without names": Refused(
        npy(np.column_stack([TABLE, QUATERNIONS])), said(WITH_TURN) + "; if its scalar is first", options(WITH_TURN), True
    ),
    "quat_0 to quat_3": Refused(
        file("log.csv", lines([*JOINTS, *"xyz", *QUAT], cells(Q, XYZ, SCALAR_FIRST))),
        said(dict(zip(QUAT, OF_QUAT, strict=True))), options(dict(zip(QUAT, OF_QUAT, strict=True))), True,
    ),
    "position[0] to position[5], as of a message": Refused(
        file("log.csv", lines([*BY_INDEX, *"xyz"], cells(Q, XYZ))), said(BY_INDEX), options(BY_INDEX)
    ),
    "joints by names of their own": Refused(
        file("log.csv", lines([*RENAMED, *"xyz"], cells(Q, XYZ))), said(RENAMED), options(RENAMED)
    ),
    "two poses of which either may be measured": Refused(
        saved("log.json", {"q": Q.tolist(), "first_pose": MATRICES.tolist(), "second_pose": MATRICES[::-1].tolist()}),
        "--ignore 'second_pose'", {"ignore": ["second_pose"]}, True,
    ),
}  # fmt: skip


def is_right(kind: Kind, folder: Path) -> bool:
    """Return whether joints and readings are those of the machine."""
    found, _, _ = read(kind, folder)
    kept = np.delete(np.arange(K), kind.left)
    atol = max(kind.noise, 1e-9)
    right = found.kind == ("pose" if kind.is_pose else "position") and len(found) == len(kept)
    right = right and np.allclose(found.q, Q[kept], rtol=0, atol=atol)
    right = right and np.allclose(found.position, XYZ[kept], rtol=0, atol=atol)
    if right and kind.is_pose:
        turn = Rotation.from_quat(found.quaternion) * TURNED[kept].inv()
        right = bool(turn.magnitude().max() < 1e-7)
    return bool(right)


def outcomes() -> Iterator[tuple[str, str]]:
    """Yield each kind of table and what becomes of it: read, read with an option, refused with the cure, or wrong."""
    for name, kind in {**KINDS, **FORMS}.items():
        with tempfile.TemporaryDirectory() as folder:
            try:
                right = is_right(kind, Path(folder))
            except MeasurementError:
                right = False
        yield name, "wrong" if not right else "read with an option" if kind.options else "read"
    for name, refused in REFUSED.items():
        with tempfile.TemporaryDirectory() as folder:
            yield name, "refused with the cure" if cured(refused, Path(folder)) else "wrong"


def cured(refused: Refused, folder: Path) -> bool:
    """Return whether a form is refused with the words that cure, and read rightly as these say."""
    try:
        read(Kind(refused.make), folder)
    except MeasurementError as error:
        is_said = refused.says in str(error)
    else:
        return False
    return is_said and is_right(Kind(refused.make, refused.options, is_pose=refused.is_pose), folder)


if __name__ == "__main__":
    found = dict(outcomes())
    for outcome in ("read", "read with an option", "refused with the cure", "wrong"):
        names = [name for name, what in found.items() if what == outcome]
        print(f"{len(names):3d} of {len(found)} {outcome}" + (f": {', '.join(names)}" if outcome != "read" else ""))
    sys.exit(any(what == "wrong" for what in found.values()))
