"""The same measurements in the formats, spellings and conventions that people and controllers use."""

from __future__ import annotations

import codecs
import datetime
import json
import re
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import click
import numpy as np
import polars as pl
import pytest
from command_line import run
from scipy.spatial.transform import Rotation

import pincal
from pincal.builtin import kuka_urdf_path
from pincal.cli import pincal as verbs
from pincal.cli.quantities import LENGTH
from pincal.errors import MeasurementError, PincalWarning, RobotFileError
from pincal.measure.heading import find_heading
from pincal.measure.measurements import Measurements
from pincal.measure.orientation import CONVENTIONS as KNOWN
from pincal.measure.table import read_measurements, write_table
from pincal.robot.robot import Robot

JOINTS = ("joint_a1", "joint_a2", "joint_a3")
RNG = np.random.default_rng(3)
ORIENTATIONS = ("kuka", "fanuc", "abb", "ur", "rpy", "xyzw", "wxyz")
N = 7
Q = RNG.uniform(-2.0, 2.0, (N, 3))
POSITION = RNG.uniform(-1.5, 1.5, (N, 3))
# Angles about x, y and z, nowhere near the singularity of Euler angles.
ANGLES = RNG.uniform(-1.2, 1.2, (N, 3))


def about(axis: int, angle: float) -> np.ndarray:
    """Return the elementary rotation about x, y or z as it stands in textbooks."""
    c, s = np.cos(angle), np.sin(angle)
    return {
        0: np.array([[1, 0, 0], [0, c, -s], [0, s, c]]),
        1: np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
        2: np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]),
    }[axis]


ROTATIONS = np.array([about(2, z) @ about(1, y) @ about(0, x) for x, y, z in ANGLES])


def matrices(quaternions: np.ndarray) -> np.ndarray:
    """Return the rotations of unit quaternions x y z w by the formula of Hamilton, shape (N, 3, 3)."""
    x, y, z, w = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def scalar_first() -> np.ndarray:
    """Return the quaternions w x y z of the rotations, by their trace, shape (N, 4)."""
    w = 0.5 * np.sqrt(1.0 + np.trace(ROTATIONS, axis1=1, axis2=2))
    skew = [ROTATIONS[:, 2, 1] - ROTATIONS[:, 1, 2], ROTATIONS[:, 0, 2] - ROTATIONS[:, 2, 0],
            ROTATIONS[:, 1, 0] - ROTATIONS[:, 0, 1]]  # fmt: skip
    return np.column_stack([w, *(part / (4.0 * w) for part in skew)])


def vectors() -> np.ndarray:
    """Return axis times angle of the rotations, shape (N, 3) [rad]."""
    quaternion = scalar_first()
    size = np.linalg.norm(quaternion[:, 1:], axis=1)
    return quaternion[:, 1:] * (2.0 * np.arctan2(size, quaternion[:, 0]) / size)[:, None]


def columns(joints: str = "joint_a{}", places: str = "x y z") -> dict[str, np.ndarray]:
    """Return joints [rad] and positions [m] under such names."""
    return {joints.format(i + 1): Q[:, i] for i in range(3)} | dict(zip(places.split(), POSITION.T, strict=True))


def named(names: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of an array, shape (N, k), under k names."""
    return dict(zip(names.split(), values.T, strict=True))


def text(table: dict[str, np.ndarray], separator: str = ",", comma: bool = False) -> str:
    """Return a table as text, in full precision."""
    rows = [separator.join(repr(float(cell)) for cell in row) for row in zip(*table.values(), strict=True)]
    body = "\n".join(rows) + "\n"
    return separator.join(table) + "\n" + (body.replace(".", ",") if comma else body)


def plain(name: str, content: str | bytes) -> Callable[[Path], Path]:
    """Return what writes a file as it is."""

    def write(folder: Path) -> Path:
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        return folder / name

    return write


def excel(table: dict[str, object], *, above: tuple[object, ...] = ()) -> Callable[[Path], Path]:
    """Return what writes a workbook, with an empty sheet before and another one after."""

    def write(folder: Path) -> Path:
        openpyxl = pytest.importorskip("openpyxl")
        book = openpyxl.Workbook()
        sheet = book.create_sheet("measured")
        for row in (*((cell,) for cell in above), tuple(table), *zip(*table.values(), strict=True)):  # type: ignore[call-overload]
            sheet.append([cell.item() if isinstance(cell, np.generic) else cell for cell in row])
        book.create_sheet("notes").append(["by hand"])
        book.save(folder / "log.xlsx")
        return folder / "log.xlsx"

    return write


def parquet(table: dict[str, np.ndarray]) -> Callable[[Path], Path]:
    """Return what writes a Parquet file."""

    def write(folder: Path) -> Path:
        write_table(folder / "log.parquet", table)
        return folder / "log.parquet"

    return write


IN_MM = {name: value * (1e3 if name in "xyz" else 180 / np.pi) for name, value in columns().items()}
MIXED = {"joint_a1 [deg]": np.degrees(Q[:, 0]), "joint_a2": Q[:, 1], "joint_a3 [mrad]": 1e3 * Q[:, 2]}
PLACES = dict(zip("xyz", POSITION.T, strict=True))
IN_DEGREES = [*np.degrees(Q.T), *POSITION.T]
NUMBERS = {"J1": "joint_a1 [deg]", "J2": "joint_a2 [deg]", "J3": "joint_a3 [deg]"}


def headed(form: str, angle: str = "deg", length: str = "mm") -> dict[str, np.ndarray]:
    """Return the table in degrees and millimetres with units in such a form, as ``{} ({})``."""
    return {form.format(name, length if name in "xyz" else angle): value for name, value in IN_MM.items()}


def in_words(table: dict[str, np.ndarray]) -> dict[str, object]:
    """Return a table with columns of text and an empty one."""
    notes = {"operator": ["Ann"] * N, "measured at": ["2026-11-02 10:00"] * N, "": [None] * N}
    return {**{name: list(value) for name, value in table.items()}, **notes}


def aligned(table: dict[str, np.ndarray]) -> str:
    """Return a table with columns padded by blanks."""
    rows = [[repr(float(cell)).rjust(26) for cell in row] for row in zip(*table.values(), strict=True)]
    return "\n".join(["  ".join(name.rjust(24) for name in table), *("".join(row) for row in rows), ""])


# Each way: what writes the file, and what the user says of it.
WAYS: dict[str, tuple[Callable[[Path], Path], dict[str, object]]] = {
    "CSV": (plain("log.csv", text(columns())), {}),
    "semicolons, decimal comma": (plain("log.csv", text(columns(), ";", True)), {}),
    "tabs": (plain("log.tsv", text(columns(), "\t")), {}),
    "blanks": (plain("log.txt", aligned(columns())), {}),
    "blanks and units": (plain("log.txt", aligned(headed("{} [{}]"))), {}),
    "Parquet": (parquet(columns()), {}),
    "Excel": (excel(columns()), {}),
    "Excel under a comment": (excel(headed("{} ({})"), above=("# tracker 7",)), {}),
    "Excel with text": (excel(in_words(columns())), {}),
    "UTF-16": (plain("log.csv", text(headed("{} [{}]"), "\t").encode("utf-16")), {}),
    "UTF-16, big end first": (plain("log.csv", codecs.BOM_UTF16_BE + text(columns()).encode("utf-16-be")), {}),
    "Latin-1": (plain("log.csv", text(headed("{} [{}]", "°"), ";", True).encode("latin-1")), {}),
    "UTF-8 with a mark, CRLF": (plain("log.csv", "\ufeff" + text(columns()).replace("\n", "\r\n")), {}),
    "x [mm]": (plain("log.csv", text(headed("{} [{}]"))), {}),
    "x (mm)": (plain("log.csv", text(headed("{} ({})"))), {}),
    "x_mm": (plain("log.csv", text(headed("{}_{}"))), {}),
    "x/mm": (plain("log.csv", text(headed("{} / {}", "°"))), {}),
    "capital letters": (plain("log.csv", text({name.upper(): value for name, value in columns().items()})), {}),
    "units that differ": (plain("log.csv", text(MIXED | PLACES).replace("joint_a", "Joint_A")), {}),
    "joints numbered": (plain("log.csv", text(columns("J{}"))), {}),
    "joints numbered, with units": (plain("log.csv", text(headed("{} [{}]")).replace("joint_a", "A")), {}),
    "q1 q2 q3": (plain("log.csv", text(columns("q{}"))), {}),
    "actual_q_0": (plain("log.csv", text({f"actual_q_{i}": Q[:, i] for i in range(3)} | PLACES)), {}),
    "names of the user": (
        plain("log.csv", text(dict(zip(("J1", "J2", "J3", "east", "north", "up"), IN_DEGREES, strict=True)))),
        {"columns": {**NUMBERS, "east": "x", "north": "y", "up": "z"}},
    ),
    "columns out of order": (plain("log.csv", text(dict(reversed(columns().items())))), {}),
}  # fmt: skip


def read(path: Path, said: dict[str, object] | None = None, joints: tuple[str, ...] = JOINTS) -> Measurements:
    """Read a file without looking at the notes."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PincalWarning)
        return read_measurements(path, joints, **(said or {}))  # type: ignore[arg-type]


def write(folder: Path, table: dict[str, np.ndarray]) -> Path:
    return plain("log.csv", text(table))(folder)


def test_there_are_twenty_ways() -> None:
    """The table of formats is as long as promised."""
    assert len(WAYS) >= 20


@pytest.mark.parametrize("way", WAYS)
def test_a_measurement_is_the_same_however_it_is_written(tmp_path: Path, way: str) -> None:
    """Formats, encodings, units, spellings and names change neither joints nor positions."""
    make, said = WAYS[way]
    found = read(make(tmp_path), said)

    np.testing.assert_allclose(found.q, Q, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.position, POSITION, rtol=0, atol=1e-9)
    assert found.kind == "position" and len(found.rows) == N


DEG = 180.0 / np.pi
CONVENTIONS: dict[str, tuple[dict[str, np.ndarray], str | None]] = {
    "kuka": (named("C B A", DEG * ANGLES), None),
    "kuka in rad": (dict(zip(("C [rad]", "B [rad]", "A [rad]"), ANGLES.T, strict=True)), None),
    "fanuc": (named("W P R", DEG * ANGLES), None),
    "rpy": (named("roll pitch yaw", ANGLES), None),
    "rpy in degrees": (dict(zip(("Roll (deg)", "Pitch (deg)", "Yaw (deg)"), DEG * ANGLES.T, strict=True)), None),
    "abb": (named("q1 q2 q3 q4", scalar_first()), None),
    "ur": (named("rx ry rz", vectors()), None),
    "kuka in lower case": (named("c b a", DEG * ANGLES), "kuka"),
    "kuka by axes": (named("RX RY RZ", DEG * ANGLES), "kuka"),
    "fanuc by axes": (named("rx ry rz", DEG * ANGLES), "fanuc"),
    "ur in degrees": (named("rx_deg ry_deg rz_deg", DEG * vectors()), "ur"),
    "wxyz": (named("q1 q2 q3 q4", scalar_first()), "wxyz"),
    "xyzw": (named("q4 q1 q2 q3", scalar_first()), "xyzw"),
    "xyzw by name": (named("qw qx qy qz", scalar_first()), "wxyz"),
    "quaternion": (named("qw qx qy qz", scalar_first()), None),
}


@pytest.mark.parametrize("name", CONVENTIONS)
def test_orientations_of_controllers_are_products_of_elementary_rotations(tmp_path: Path, name: str) -> None:
    """Each convention gives the rotation that its maker's manual writes as a product about x, y and z."""
    turned, said = CONVENTIONS[name]
    found = read(write(tmp_path, columns() | turned), {"orientation": said})

    assert found.quaternion is not None and found.kind == "pose"
    np.testing.assert_allclose(matrices(found.quaternion), ROTATIONS, rtol=0, atol=1e-12)


def test_rotation_vectors_are_those_of_rodrigues() -> None:
    """The vectors of this file's oracle turn by their length about their direction."""
    for vector, rotation in zip(vectors(), ROTATIONS, strict=True):
        angle = np.linalg.norm(vector)
        x, y, z = vector / angle
        K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        np.testing.assert_allclose(np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K, rotation, atol=1e-14)


@pytest.mark.parametrize(
    ("turned", "said", "parts"),
    [
        (named("rx ry rz", 90 * np.sign(ANGLES)), None, ["more than a revolution", "rx [deg]", "--orientation"]),
        (named("RX RY RZ", ANGLES), None, ['unknown column "RX"', "an orientation? --orientation kuka"]),
        (named("A B C", ANGLES), "euler", ["'euler' is unknown", "kuka, fanuc"]),
        (dict(zip("AB", ANGLES.T[:2], strict=True)), "kuka", ["no columns A B C", "the table has", "--columns"]),
        (named("A B C", ANGLES) | named("W P R", ANGLES), None, ["A B C and W P R", "expected one"]),
        (
            named("A B C", ANGLES) | named("qw qx qy qz", scalar_first()),
            None,
            ["A B C and in qx qy qz qw"],
        ),
        (named("q1 q2 q3 q4", 1.1 * scalar_first()), None, ["quaternion", "norm 1"]),
    ],
)  # fmt: skip
def test_an_orientation_that_is_not_clear_is_refused(
    tmp_path: Path, turned: dict[str, np.ndarray], said: str | None, parts: list[str]
) -> None:
    """Angles in the wrong unit, two conventions at once, or names with several meanings end with the next step."""
    with pytest.raises(MeasurementError) as caught:
        read(write(tmp_path, columns() | turned), {"orientation": said})
    for part in parts:
        assert part in str(caught.value)


def test_a_row_is_of_the_table_if_most_of_it_is_filled() -> None:
    """Three cells of five are a row of numbers below names; two are a remark, which has no names above it."""
    names = ["A1", "A2", "x", "y", "z"]
    whole = ["1", "2", "3", "4", "5"]
    found = find_heading([names, ["1", "2", "3", "", ""], whole])

    assert found is not None and found.labels == tuple(names)
    assert find_heading([names, ["1", "2", "", "", ""], whole]) is None


def test_joints_called_q_are_no_quaternion(tmp_path: Path) -> None:
    """q1 ... q6 are joints; of q1 ... q4 nobody knows, so joints of that name have to be named."""
    joints = tuple(f"axis_{i}" for i in range(1, 7))
    q = RNG.uniform(-1, 1, (N, 6))
    place = dict(zip("xyz", POSITION.T, strict=True))
    six = read(write(tmp_path, {f"q{i + 1}": q[:, i] for i in range(6)} | place), joints=joints)
    assert six.kind == "position"
    np.testing.assert_allclose(six.q, q, rtol=0, atol=1e-12)

    path = write(tmp_path, {f"q{i + 1}": q[:, i] for i in range(4)} | place)
    with pytest.raises(MeasurementError, match="no column for joint"):
        read(path, joints=joints[:4])
    named = read(path, {"columns": {f"q{i}": f"axis_{i}" for i in range(1, 5)}}, joints=joints[:4])
    np.testing.assert_allclose(named.q, q[:, :4], rtol=0, atol=1e-12)


def test_what_is_guessed_is_told(tmp_path: Path) -> None:
    """Joints by number, conventions by header and columns of text each cause one note, which says how to object."""
    table = columns("J{}") | dict(zip("ABC", DEG * ANGLES.T[::-1], strict=True))
    lines = text(table).splitlines()
    noted = "\n".join([lines[0] + ",operator", *(line + ",Ann" for line in lines[1:]), ""])
    with pytest.warns(PincalWarning) as caught:
        read_measurements(plain("log.csv", noted)(tmp_path), JOINTS)

    notes = sorted(str(warning.message) for warning in caught)
    assert notes == [
        "log.csv: A B C are read as KUKA's A B C about z, y, x; if that is wrong, use --orientation "
        "kuka|fanuc|abb|ur|rpy|xyzw|wxyz",
        'log.csv: columns of text are ignored: "operator"; rows count alike, whoever measured them: pincal measure compares '
        "operators (GR&R)",
        "log.csv: joints are taken from the columns J1=joint_a1, J2=joint_a2, J3=joint_a3; if that is wrong, map them with "
        "--columns",
    ]


@pytest.mark.parametrize(
    ("names", "parts"),
    [
        (("J1", "J2", "J3", "J4"), ['no column for joint "joint_a1"', 'the table has "J1", "J2"']),
        (("J1", "J2", "A3"), ["no column for joint", "--columns 'NAME=joint_a1,...'"]),
        (("joint_a1", "J2", "J3"), ['no column for joint "joint_a2"']),
        (("joint_a1", "joint_a2", "joint_a3", "paylod"), ['"paylod"', "nearest first: payload", "--columns 'paylod=NAME'"]),
    ],
)
def test_what_may_be_mistaken_is_not_guessed(tmp_path: Path, names: tuple[str, ...], parts: list[str]) -> None:
    """Too many numbers, two families, or a mix of names is refused with what the table has."""
    table = {name: Q[:, i % 3] for i, name in enumerate(names)} | dict(zip("xyz", POSITION.T, strict=True))
    with pytest.raises(MeasurementError) as caught:
        read(write(tmp_path, table))
    for part in parts:
        assert part in str(caught.value)


@pytest.mark.long
@pytest.mark.parametrize("cell", ["1", "hot"])
def test_a_header_without_end_has_a_short_answer(tmp_path: Path, cell: str) -> None:
    """Five thousand columns that nobody knows are refused in less than two thousand letters, and can be ignored."""
    names = [*JOINTS, "x", "y", "z", *(f"a column with a name of its own and number {i}" for i in range(5000))]
    path = plain("log.csv", ",".join(names) + "\n" + ",".join([*"000111", *([cell] * 5000)]) + "\n")(tmp_path)
    with pytest.raises(MeasurementError, match="unknown column") as caught:
        read(path)
    assert len(str(caught.value)) < 2000
    assert len(read(path, {"ignore": ("*",)})) == 1


def test_text_that_may_be_meant_is_not_left_out(tmp_path: Path) -> None:
    """A column of names whose own name is nearly a known one is a mistake, not a comment."""
    path = plain("log.csv", "joint_a1,joint_a2,joint_a3,x,y,z,tagret\n0,0,0,1,1,1,left\n")(tmp_path)
    with pytest.raises(MeasurementError, match=r'unknown column "tagret".*nearest first: target'):
        read(path)


@pytest.mark.parametrize(
    ("said", "parts"),
    [
        ({"J7": "joint_a1"}, ['no column "J7" for --columns J7=joint_a1', "the table has"]),
        ({"joint_a1": "J1"}, ['is "J1=joint_a1" meant?']),
        ({"joint_a1": "J1 [deg]"}, ['is "J1=joint_a1 [deg]" meant?']),
        ({"J1": "joint_a1 [mm]"}, ["[mm] is not a unit", "[rad]"]),
        ({"J1": "y"}, ['two columns "y"']),
    ],
)
def test_columns_that_the_user_names_wrongly_are_refused(tmp_path: Path, said: dict[str, str], parts: list[str]) -> None:
    """A name that is not in the table, the wrong way round, or taken already is named in the error."""
    with pytest.raises(MeasurementError) as caught:
        read(write(tmp_path, columns("J{}")), {"columns": said})
    for part in parts:
        assert part in str(caught.value)


@pytest.mark.parametrize("cell", ["1_0", "٣", "0x10", "1e", "1 0", "1,0", "--1", "½"])
def test_numbers_that_only_some_programs_read_are_refused(tmp_path: Path, cell: str) -> None:
    """A cell is a number in plain decimal digits or the table is refused, in text and in Excel."""
    lines = f'joint_a1,joint_a2,joint_a3,x,y,z\n0,0,0,1,1,1\n0,0,"{cell}",1,1,1\n'
    table = {name: [0, 0] for name in JOINTS[:2]} | {"joint_a3": [0, cell], "x": [1, 1], "y": [1, 1], "z": [1, 1]}
    for make in (plain("log.csv", lines), excel(table)):
        with pytest.raises(MeasurementError, match=r'line 3, column "joint_a3": .*expected a finite number'):
            read(make(tmp_path))


@pytest.mark.parametrize("quoted", [False, True])
@pytest.mark.parametrize("bad", ["-0,248,0,0,1,2,3,hot", "0,0,0,1,2", "0,0,0,1,2,3,hot,7"])
def test_rows_of_another_length_are_refused_where_columns_are_left_out(tmp_path: Path, bad: str, quoted: bool) -> None:
    """A decimal comma between commas shifts the joints; the row is refused with its line even if only joints are read."""
    good = '0,0,0,1,2,3,"hot, humid"' if quoted else "0,0,0,1,2,3,hot"
    rows = [bad if i == 700 else good for i in range(1500)]
    path = plain("log.csv", "\n".join(["joint_a1,joint_a2,joint_a3,x,y,z,note", *rows, ""]))(tmp_path)
    for require in ("joints", "measurement"):
        with pytest.raises(MeasurementError, match=r"line 702: \d cells; expected 7 as in the header; decimal commas"):
            read(path, {"require": require, "ignore": ("note",)})


def test_times_of_a_spreadsheet_are_seconds(tmp_path: Path) -> None:
    """Cells with date and time are read as seconds, of which only differences matter."""
    start = datetime.datetime(2026, 11, 2, 10, 0)
    times = [start + datetime.timedelta(seconds=1.5 * i) for i in range(N)]
    found = read(excel({**columns(), "time": times})(tmp_path))

    assert found.time is not None
    np.testing.assert_allclose(np.diff(found.time), 1.5, atol=1e-6)


def test_dates_are_seconds(tmp_path: Path) -> None:
    """Times as ISO 8601 are seconds since 1970; what only looks like a date is refused with its line."""
    cells = ["2026-11-02T10:00:00Z", "2026-11-02 10:00:01.250", "2026-11-02T10:01:00"]
    lines = [f"0,0,0,1,1,{i},{cell}" for i, cell in enumerate(cells)]
    path = plain("log.csv", "\n".join(["joint_a1,joint_a2,joint_a3,x,y,z,Time", *lines, ""]))(tmp_path)
    found = read(path)
    start = datetime.datetime(2026, 11, 2, 10, tzinfo=datetime.UTC).timestamp()

    assert found.time is not None
    np.testing.assert_allclose(found.time, start + np.array([0.0, 1.25, 60.0]), rtol=0, atol=1e-6)
    path.write_text(path.read_text().replace("11-02 10", "11-32 10"))
    with pytest.raises(MeasurementError, match=r'line 3, column "Time"'):
        read(path)


def test_excel_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without openpyxl the error names the extra; old formats are named, too."""
    path = excel(columns())(tmp_path)
    monkeypatch.setitem(__import__("sys").modules, "openpyxl", None)
    with pytest.raises(MeasurementError, match=r"pip install 'pincal\[excel\]'"):
        read(path)
    with pytest.raises(MeasurementError, match=r"\.xls is not read; save the table as \.xlsx"):
        read(plain("log.xls", b"\xd0\xcf")(tmp_path))


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut", b"joint_a1,joint_a2"])
def test_broken_workbooks_are_refused(tmp_path: Path, content: bytes) -> None:
    """A file that only its name makes a workbook is refused as a measurement error."""
    with pytest.raises(MeasurementError, match=r"log\.xlsx: can't be read"):
        read(plain("log.xlsx", content)(tmp_path))


def test_a_workbook_that_breaks_off_is_refused(tmp_path: Path) -> None:
    """A worksheet that is found to be broken only while its rows are read is refused likewise."""
    whole = excel({name: list(value) for name, value in columns().items()})(tmp_path)
    with zipfile.ZipFile(whole) as book:
        parts = {name: book.read(name) for name in book.namelist()}
    with zipfile.ZipFile(whole, "w") as book:
        for name, part in parts.items():
            book.writestr(name, part[: len(part) * 2 // 3] if "sheet2" in name else part)
    with pytest.raises(MeasurementError, match=r"log\.xlsx: can't be read"):
        read(whole)


def test_excel_names_the_line_of_a_fault(tmp_path: Path) -> None:
    """Lines are those of the worksheet; a formula that failed is refused, in the first column too, where comments begin."""
    table = {name: list(value) for name, value in columns().items()}
    table["joint_a2"][2] = "=1/0"
    with pytest.raises(MeasurementError, match=r'log\.xlsx, line 6, column "joint_a2"'):
        read(excel(table, above=("# a", "# b"))(tmp_path))
    first = next(iter(table))
    table[first][1] = "#N/A"
    with pytest.raises(MeasurementError, match=rf'log\.xlsx, line 5, column "{first}": "#N/A"'):
        read(excel(table, above=("# a", "# b"))(tmp_path))


def rewritten(path: Path, part: str, change: Callable[[bytes], bytes]) -> Path:
    """Rewrite the parts of a workbook whose names hold a text, and return its path."""
    with zipfile.ZipFile(path) as book:
        parts = {name: book.read(name) for name in book.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as book:
        for name, text in parts.items():
            book.writestr(name, change(text) if part in name else text)
    return path


def test_excel_is_read_beyond_the_size_that_it_claims(tmp_path: Path) -> None:
    """A worksheet that says of itself to end before its last rows and columns loses none."""
    path = excel({name: list(value) for name, value in columns().items()})(tmp_path)
    whole = read(path)
    rewritten(path, "sheet2", lambda text: re.sub(rb'<dimension ref="[^"]*"', b'<dimension ref="B2:C4"', text))
    with zipfile.ZipFile(path) as book:
        assert b'ref="B2:C4"' in book.read("xl/worksheets/sheet2.xml")
    found = read(path)
    assert len(found) == len(whole) == N
    np.testing.assert_array_equal(found.position, whole.position)


def test_a_hidden_worksheet_gives_way_to_a_visible_one(tmp_path: Path) -> None:
    """It is named as not read; where nothing else has cells it is read, and said so."""
    openpyxl = pytest.importorskip("openpyxl")
    path = excel({name: list(value) for name, value in columns().items()})(tmp_path)
    book = openpyxl.load_workbook(path)
    book.create_sheet("last year", 0).append(["joint_a1", "by", "mistake"])
    book["last year"].sheet_state = "hidden"
    book.save(path)
    with pytest.warns(PincalWarning, match=r"worksheets notes, last year \(hidden\) are not read"):
        assert len(read_measurements(path, JOINTS)) == N
    del book["last year"], book["notes"]
    book["measured"].sheet_state = "veryHidden"
    book.save(path)
    with pytest.warns(PincalWarning, match="no visible worksheet has columns of joints; the hidden one measured is read"):
        assert len(read_measurements(path, JOINTS)) == N
    with warnings.catch_warnings():
        warnings.simplefilter("error", PincalWarning)
        assert len(read_measurements(path, JOINTS, sheet="measured")) == N


def test_hidden_rows_of_a_worksheet_are_told_of(tmp_path: Path) -> None:
    """Rows that a filter hides are read, with a note of their number and lines; blank ones that are hidden are none."""
    openpyxl = pytest.importorskip("openpyxl")
    path = excel({name: list(value) for name, value in columns().items()})(tmp_path)
    book = openpyxl.load_workbook(path)
    for row in (3, 6, 200):
        book["measured"].row_dimensions[row].hidden = True
    book.save(path)
    with pytest.warns(
        PincalWarning, match=r"2 rows are hidden in worksheet measured, .*\(line 3, 6\), and read like the others"
    ):
        assert len(read_measurements(path, JOINTS)) == N


BLANKS = {
    "empty rows": lambda text: text.replace(b"</sheetData>", b"<row/>" * 500_000 + b"</sheetData>"),
    "a line far below": lambda text: text.replace(
        b"</sheetData>", b'<row r="900000000"><c r="A900000000"/></row></sheetData>'
    ),
    "a comment": lambda text: text.replace(b"</sheetData>", b"</sheetData><!--" + b" " * 3_000_000 + b"-->"),
}


@pytest.mark.parametrize("case", BLANKS)
def test_a_workbook_that_only_looks_small_is_refused(tmp_path: Path, case: str) -> None:
    """What holds much more than measured numbers can is not unpacked, and lines that Excel lacks are not counted."""
    path = excel({name: list(value) for name, value in columns().items()})(tmp_path)
    rewritten(path, "sheet2", BLANKS[case])
    assert path.stat().st_size < 50_000
    with pytest.raises(MeasurementError, match=r"holds 3 MB in 0\.0|more than the 1048576 lines of Excel"):
        read(path)


def test_columns_of_a_workbook_are_counted_blank_or_not(tmp_path: Path) -> None:
    """A header in the last column of Excel makes no table of sixteen thousand columns of every row."""
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    names = list(columns())
    book.active.append([*names, *[None] * (16384 - len(names) - 1), "last"])
    for row in range(2, 40):
        book.active.cell(row, 1, 0.0)
        book.active.cell(row, 16384, 0.0)
    book.save(tmp_path / "log.xlsx")
    with pytest.raises(MeasurementError, match="times its size"):
        read(tmp_path / "log.xlsx")


def test_a_parquet_file_that_only_looks_small_is_refused(tmp_path: Path) -> None:
    """Its rows are counted before they are read; tables with as many repeats as people measure are taken."""
    table = {name: np.asarray(value) for name, value in columns().items()}
    bomb = pl.DataFrame({name: np.repeat(value, 100_000) for name, value in table.items()})
    bomb.write_parquet(tmp_path / "log.parquet", compression="zstd", row_group_size=10**7)
    with pytest.raises(MeasurementError, match=r"log\.parquet: holds .* MB in .* times its size"):
        read(tmp_path / "log.parquet")
    often = pl.DataFrame({name: np.repeat(value, 1000) for name, value in table.items()})
    often.write_parquet(tmp_path / "log.parquet")
    assert len(read(tmp_path / "log.parquet")) == 1000 * N


def test_cells_that_are_lists_are_refused(tmp_path: Path) -> None:
    """They may be of any length, and are not looked into; a column of them that nobody needs can be ignored."""
    table = {name: np.asarray(value) for name, value in columns().items()}
    pl.DataFrame(table).with_columns(odd=pl.lit([1.0, 2.0])).write_parquet(tmp_path / "log.parquet")
    assert len(read(tmp_path / "log.parquet", {"ignore": ("odd",)})) == N
    first = next(iter(table))
    pl.DataFrame(table).with_columns(pl.lit([1.0, 2.0]).alias(first)).write_parquet(tmp_path / "log.parquet")
    with pytest.raises(MeasurementError, match=f'column "{first}": lists; expected one number or name per cell'):
        read(tmp_path / "log.parquet")


def test_a_name_of_any_length_is_none(tmp_path: Path) -> None:
    """One long name would take its room in every row: 4 GB here, of a file of 400 kB; it is refused with its line."""
    table = {name: np.asarray(value) for name, value in columns().items()}
    lines = [",".join([*table, "target"])]
    lines += [",".join([*map(str, row), "t"]) for row in zip(*table.values(), strict=True)] * 1000
    lines[3] += "a" * 100_000
    with pytest.raises(
        MeasurementError, match=r'line 4, column "target": a cell of 100001 bytes; expected a name of at most 255'
    ):
        read(plain("log.csv", "\n".join(lines))(tmp_path))


def test_polars_counts_like_the_reader(tmp_path: Path) -> None:
    """A table whose columns are left out is read as by another reader, also with lines longer than a piece of the file."""
    n = 40000
    wide = {name: RNG.standard_normal(n) for name in (*JOINTS, "x", "y", "z", "a", "b")}
    write_table(tmp_path / "wide.csv", wide)
    found = read(tmp_path / "wide.csv", {"require": "joints"})
    other = pl.read_csv(tmp_path / "wide.csv")

    np.testing.assert_array_equal(found.q, other.select(JOINTS).to_numpy())
    assert (tmp_path / "wide.csv").stat().st_size > 1 << 22


def test_the_same_words_from_python(tmp_path: Path) -> None:
    """`pincal.read_measurements` takes the options of the command under the same names."""
    turned = named("rx ry rz", DEG * ANGLES)
    found = pincal.read_measurements(
        write(tmp_path, columns("a_{}") | turned | {"junk": Q[:, 0]}),
        JOINTS,
        columns={f"a_{i}": f"joint_a{i}" for i in (1, 2, 3)},
        orientation="fanuc",
        ignore=["junk"],
    )
    assert found.quaternion is not None
    np.testing.assert_allclose(matrices(found.quaternion), ROTATIONS, atol=1e-12)


def test_every_verb_reads_tables_in_the_same_way() -> None:
    """Each verb that reads measurements has the options that say how to."""
    context = click.Context(verbs)
    for verb in ("calibrate", "discover", "check", "validate", "predict", "compensate", "diagnose", "update", "view"):
        found = verbs.get_command(context, verb)
        assert found is not None
        named = {parameter.name: parameter for parameter in found.params}
        assert {"columns", "orientation", "ignore"} <= set(named), verb
        assert named["orientation"].type.choices == (*ORIENTATIONS, "none")  # type: ignore[attr-defined]
    assert tuple(KNOWN) == ORIENTATIONS


@pytest.mark.long
def test_a_controllers_log_calibrates_like_a_plain_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A workbook with numbered joints in degrees and KUKA's angles fits the same; what is guessed is told."""
    urdf, said = kuka_urdf_path(), ("--model", "geometric", "--json")
    assert run("simulate", urdf, "--poses", 40, "--sensor", "pose", "--seed", 4, "--out", tmp_path / "plain.csv") == 0
    found = pl.read_csv(tmp_path / "plain.csv")
    turned = Rotation.from_quat(found.select("qx", "qy", "qz", "qw").to_numpy()).as_euler("ZYX", degrees=True)
    joints = {f"A{i}": np.degrees(found[f"joint_{i}"].to_numpy()) for i in range(1, 7)}
    places = {f"{axis.upper()} [mm]": 1e3 * found[axis].to_numpy() for axis in "xyz"}
    excel(joints | places | named("A B C", turned))(tmp_path)
    capsys.readouterr()
    results = []
    for data, more in (("plain.csv", ()), ("log.xlsx", ("--columns", "A1=joint_1 [deg]"))):
        more = tuple(",".join(f"A{i}=joint_{i} [deg]" for i in range(1, 7)) if "A1" in word else word for word in more)
        assert run("calibrate", urdf, tmp_path / data, "--out", tmp_path / data[:3], *said, *more) == 0
        out, err = capsys.readouterr()
        results.append(json.loads(out))
    assert "A B C are read as KUKA's" in err
    first, second = ([part["value"] for part in result["parameters"]] for result in results)
    np.testing.assert_allclose(first, second, rtol=1e-6, atol=1e-9)
    # Degrees are told from radians by the values, not guessed.
    assert run("calibrate", urdf, tmp_path / "log.xlsx", "--out", tmp_path / "no", *said) == 3
    assert "looks like degrees" in capsys.readouterr().err


@pytest.mark.parametrize("number", ["1_0", "٣"])
def test_the_same_numbers_are_refused_in_a_urdf_and_on_the_command_line(number: str, tmp_path: Path) -> None:
    """What is no number in a table is none elsewhere."""
    text = Path(kuka_urdf_path()).read_text(encoding="utf-8")
    place = text.index('xyz="') + len('xyz="')
    (tmp_path / "arm.urdf").write_text(text[:place] + number + text[text.index(" ", place) :], encoding="utf-8")
    with pytest.raises(RobotFileError, match="expected three finite numbers"):
        Robot.from_urdf(tmp_path / "arm.urdf")
    with pytest.raises(click.BadParameter, match="expected a number with a unit"):
        LENGTH.convert(f"{number}mm", None, None)
