from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pincal.errors import MeasurementError, OutputError
from pincal.measure.table import (
    Measurements,
    concatenate,
    measurements_from_arrays,
    read_measurements,
    write_table,
)

JOINTS = ("joint_1", "joint_2")
FACTORS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "um": 1e-6, "µm": 1e-6, "in": 0.0254}
ANGLES = {"rad": 1.0, "mrad": 1e-3, "deg": np.pi / 180, "°": np.pi / 180}


def _read(folder: Path, text: str | bytes, **options: object) -> Measurements:
    path = folder / "cell[7].csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_measurements(path, options.pop("joint_names", JOINTS), **options)  # type: ignore[arg-type]


def _refusal(folder: Path, text: str | bytes, **options: object) -> str:
    with pytest.raises(MeasurementError) as caught:
        _read(folder, text, **options)
    return str(caught.value)


numbers = st.floats(-1e6, 1e6, allow_subnormal=False)


@given(
    cells=st.lists(st.tuples(numbers, numbers, numbers, numbers, numbers), min_size=1, max_size=8),
    separator=st.sampled_from([",", ";", "\t"]),
    has_decimal_comma=st.booleans(),
    length=st.sampled_from(sorted(FACTORS)),
    angle=st.sampled_from(sorted(ANGLES)),
    ending=st.sampled_from(["\n", "\r\n"]),
    has_mark=st.booleans(),
)
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_is_written_is_read_in_any_dialect(
    tmp_path: Path,
    cells: list[tuple[float, ...]],
    separator: str,
    has_decimal_comma: bool,
    length: str,
    angle: str,
    ending: str,
    has_mark: bool,
) -> None:
    """A written table reads back exactly, whatever its units, separator, decimal sign and line ends."""
    values = np.array(cells)
    header = [f"joint_1 [{angle}]", "joint_2", f"x [{length}]", " y ", "z"]
    path = tmp_path / "written.csv"
    write_table(path, dict(zip(header, values.T, strict=True)))
    text = path.read_text(encoding="utf-8")
    if has_decimal_comma and separator != ",":
        lines = text.split("\n")
        text = "\n".join([lines[0], *(line.replace(",", ";").replace(".", ",") for line in lines[1:])])
        text = text.replace(lines[0], lines[0].replace(",", separator)).replace(";", separator)
    else:
        text = text.replace(",", separator)
    table = _read(tmp_path, ("\ufeff" if has_mark else "") + text.replace("\n", ending))

    expected = values * [ANGLES[angle], 1, FACTORS[length], 1, 1]
    assert table.q.tolist() == expected[:, :2].tolist()
    assert table.position is not None
    assert table.position.tolist() == expected[:, 2:].tolist()
    assert table.rows.tolist() == list(range(2, len(values) + 2))
    assert table.units == {"joint_1": angle, "x": length}


def test_parquet_reads_like_csv(tmp_path: Path) -> None:
    """A table in Parquet has the same units, names and row numbers as the same table in CSV."""
    columns = {
        "joint_1 [deg]": np.array([0, 180]),
        "joint_2": np.array([0.1, 0.2]),
        "socket": np.array(["A", "B"]),
    }
    tables = []
    for name in ("poses[1].csv", "poses[1].parquet"):
        write_table(tmp_path / name, columns)
        tables.append(read_measurements(tmp_path / name, JOINTS))

    for table in tables:
        assert table.kind == "socket"
        assert table.socket is not None
        assert table.socket.tolist() == ["A", "B"]
        assert table.q.tolist() == [[0.0, 0.1], [np.pi, 0.2]]
        assert table.rows.tolist() == [2, 3]


@pytest.mark.parametrize(
    ("header", "cell", "field", "expected"),
    [
        ("payload [g]", "1500", "payload", 1.5),
        ("payload [lb]", "1", "payload", 0.45359237),
        ("temperature [degC]", "20", "temperature", 20),
        ("temperature [°C]", "20", "temperature", 20),
        ("temperature [K]", "293.15", "temperature", 20),
        ("time [min]", "2", "time", 120),
        ("time [ms]", "2", "time", 0.002),
        ("time [h]", "2", "time", 7200),
        ("sigma [um]", "20", "sigma", 20e-6),
        ("sigma [\u03bcm]", "20", "sigma", 20e-6),
        ("sigma [in]", "1", "sigma", 0.0254),
    ],
)
def test_unit_in_brackets_converts(tmp_path: Path, header: str, cell: str, field: str, expected: float) -> None:
    """A unit in the header brings the column to SI."""
    table = _read(tmp_path, f"joint_1,joint_2,distance,{header}\n0,0,1,{cell}\n")

    assert getattr(table, field).tolist() == pytest.approx([expected], abs=1e-12)


def test_prismatic_joint_has_a_length(tmp_path: Path) -> None:
    """A prismatic joint takes units of length and no units of angle."""
    types = ("prismatic", "revolute")

    assert _read(tmp_path, "joint_1 [mm],joint_2,distance\n250,0,1\n", joint_types=types).q.tolist() == [[0.25, 0.0]]
    text = _refusal(tmp_path, "joint_1 [deg],joint_2,distance\n250,0,1\n", joint_types=types)
    assert "[deg] is not a unit of this column" in text
    assert "[mm]" in text


@pytest.mark.parametrize(
    ("columns", "cells", "kind"),
    [
        ("x,y,z", "1,2,3", "position"),
        ("x,y,z,qx,qy,qz,qw", "1,2,3,0,0,0,1.002", "pose"),
        ("distance", "1", "distance"),
        ("socket", "1", "socket"),
        ("cx,cy,cz,point", "1,2,3,P", "camera_point"),
        ("u [px],v,point", "1,2,P", "camera_pixel"),
    ],
)
def test_columns_decide_the_kind(tmp_path: Path, columns: str, cells: str, kind: str) -> None:
    """The measured columns say what kind of measurement the table holds."""
    table = _read(tmp_path, f"joint_1,joint_2,{columns}\n0.1,0.2,{cells}\n")

    assert table.kind == kind
    assert table.target.tolist() == ["camera" if kind.startswith("camera") else "tool"]
    assert table.approach is None


def test_quaternion_is_normalised(tmp_path: Path) -> None:
    """A quaternion of norm 1 within rounding comes out with norm 1."""
    table = _read(tmp_path, "joint_1,joint_2,x,y,z,qx,qy,qz,qw\n0,0,1,2,3,0.7071,0,0,0.7071\n")

    assert table.quaternion is not None
    assert np.linalg.norm(table.quaternion) == pytest.approx(1.0, abs=1e-15)


def test_approach_not_given_is_zero(tmp_path: Path) -> None:
    """A joint without an approach column has direction 0."""
    table = _read(tmp_path, "joint_1,joint_2,distance,approach_joint_2\n0,0,1,-1\n0,0,1,1\n")

    assert table.approach is not None
    assert table.approach.tolist() == [[0, -1], [0, 1]]


@pytest.mark.parametrize(
    ("text", "rows"),
    [
        ("joint_1,joint_2,distance\n1,2,3\n4,5,6\n\n \n,,\n", [2, 3]),
        ("# by hand\n# at noon\njoint_1,joint_2,distance\n1,2,3\n4,5,6", [4, 5]),
        ("joint_1,joint_2,distance\r\n\r\n1,2,3\r\n# slipped\r\n4,5,6\r\n", [3, 5]),
        ("\n joint_1 ; joint_2 ;distance\n 1 ; 2 ; 3 \n4;5;6\n", [3, 4]),
        ('"joint_1","joint_2","distance"\r"1","2","3"\r4,5,6\r', [2, 3]),
    ],
)
def test_rows_keep_their_line_in_the_file(tmp_path: Path, text: str, rows: list[int]) -> None:
    """Comments, blank lines, spaces and quotes are tolerated, and line numbers stay those of the file."""
    table = _read(tmp_path, text)

    assert table.q.tolist() == [[1.0, 2.0], [4.0, 5.0]]
    assert table.distance is not None
    assert table.distance.tolist() == [3.0, 6.0]
    assert table.rows.tolist() == rows


HEADER = "joint_1,joint_2,distance"


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        (f"{HEADER}\n1,2,3\n1,abc,4\n,2,4\n1,2,nan\n", ["line 3", '"joint_2"', '"abc"', "cells affected: 2"]),
        (f"{HEADER}\n1,2,3\n1,,3\n", ["line 3", '"joint_2"', "an empty cell", "a finite number"]),
        (f"{HEADER}\n1,2,NaN\n", ["line 2", "none of 1 rows", "distance", "a finite number"]),
        (f"{HEADER}\n1,inf,1\n", ["line 2", '"joint_2"', "inf"]),
        (f"{HEADER}\n1,2,0\n1,2,-1\n", ["line 2", '"distance"', "> 0", "rows affected: 2"]),
        (f"{HEADER},sigma\n1,2,1,1\n1,2,1,0\n", ["line 3", '"sigma"', "> 0"]),
        (f"{HEADER},approach_joint_1\n1,2,1,2\n", ["line 2", "-1, 0 or 1"]),
        (f"{HEADER},payload\n1,2,1,5\n1,2,1,\n", ["line 3", '"payload"', "an empty cell"]),
        (f"{HEADER},target\n1,2,1,\n", ["line 2", '"target"', "a name"]),
        ("joint_1,joint_2,x,y,z,qx,qy,qz,qw\n1,2,1,1,1,0,0,0,0\n", ["line 2", "quaternion", "norm 1"]),
        ("joint_1,joint_2,x,y,z,qx,qy,qz,qw\n1,2,1,1,1,0,0,0,1.02\n", ["line 2", "quaternion", "norm 1"]),
        (f"{HEADER}\n1,2,3\n1,2\n", ["line 3", "2 cells", "expected 3"]),
        (f"{HEADER}\n1,2,3\n1,2,3,4\n", ["line 3", "4 cells", "expected 3"]),
        (f"{HEADER}\n1,5,2,0,3,0\n", ["line 2", "6 cells", "decimal commas"]),
        ('joint_1,joint_2,socket\n1,2,"A\n1,2,B"\n', ["2 lines", "1 rows", "quotation mark"]),
        (b"joint_1,joint_2,socket\n1,2,A\n1,2,\x81\n", ["line 3", "UTF-8"]),
        (b"joint_1,joint_2 [\x81],socket\n1,2,A\n", ["line 1", "UTF-8"]),
        (b"\x89\x00\x01", ["binary"]),
        (HEADER.encode("utf-16-le"), ["binary"]),
        ("", ["is empty"]),
        ("\n\n# nothing\n", ["is empty"]),
        (f"{HEADER}\n", ["no rows"]),
        (HEADER, ["no rows"]),
        (
            "1,2,3\n4,5,6\n",
            [
                "3 columns of numbers and no names",
                "the first line: joint_1,joint_2,distance  or",
                "1=joint_1,2=joint_2,3=distance",
            ],
        ),
    ],
)
def test_unusable_cell_is_located(tmp_path: Path, text: str | bytes, parts: list[str]) -> None:
    """A cell, line or file that can't be used is refused with its place, its value and what was expected."""
    message = _refusal(tmp_path, text)

    assert message.startswith("cell[7].csv")
    for part in parts:
        assert part in message


@pytest.mark.parametrize(
    ("header", "parts"),
    [
        ("joint-1,joint_2,distance", ['joint "joint_1" (is it "joint-1"?)']),
        ("joint1,J2,distance", ['"joint_1" (is it "joint1"?)', '"joint_2"']),
        ("joint_1,joint_2,distance,paylod", ['"paylod"', "nearest first: payload, "]),
        ("joint_1,joint_2,distance,joint_1 [deg]", ['two columns "joint_1"']),
        ("joint_1,joint_2,distance [mm", ['column 3 ("distance [mm")', "unclosed unit", "[m], [mm]"]),
        ("joint_1,joint_2,distance [kg]", ["[kg] is not a unit", "[m], [mm]"]),
        ("joint_1,joint_2 [],distance", ["[] is not a unit", "[rad]"]),
        ("joint_1,joint_2,socket [mm]", ["[mm] is not a unit", "no unit"]),
        ("joint_1,joint_2,x,y", ["x y without z"]),
        ("joint_1,joint_2,u,v", ["u v without point"]),
        ("joint_1,joint_2,qx,qy,qz,qw", ["qx qy qz qw without x y z"]),
        ("joint_1,joint_2,x,y,z,distance", ["two kinds", "x y z and distance"]),
        ("joint_1,joint_2,payload", ["no measurement", "cx cy cz with point"]),
    ],
)
def test_header_that_is_not_understood_is_refused(tmp_path: Path, header: str, parts: list[str]) -> None:
    """A header with a missing, unknown, doubled or contradictory column is refused with advice."""
    message = _refusal(tmp_path, f"{header}\n{','.join('1' for _ in header.split(','))}\n")

    for part in parts:
        assert part in message


def test_ignored_columns_are_left_out(tmp_path: Path) -> None:
    """A column is left out if it is named, or unknown while all unknown ones are ignored."""
    text = "joint_1,joint_2,distance,note,x,y,z\n1,2,3,hot,1,2,3\n"

    assert _read(tmp_path, text, ignore=("note", "distance")).kind == "position"
    assert _read(tmp_path, text, ignore=("*", "x", "y", "z")).kind == "distance"
    assert "two kinds" in _refusal(tmp_path, text, ignore=("*",))


def test_poses_need_only_joints(tmp_path: Path) -> None:
    """Where only joints are required, measured and unknown columns are not looked at."""
    table = _read(tmp_path, "joint_1,joint_2,x,note,payload\n1,2,,,3\n", require="joints")

    assert table.kind == "none"
    assert table.payload is not None
    assert table.payload.tolist() == [3.0]


def test_joint_named_like_a_column_is_refused(tmp_path: Path) -> None:
    """A joint that is called x can't be told from the position and is refused."""
    assert 'joint "x" has the name of a column' in _refusal(tmp_path, "x,y,z\n1,2,3\n", joint_names=("x",))


@pytest.mark.parametrize("content", [b"", b"PAR1" + b"junk" * 50 + b"PAR1"])
def test_broken_parquet_is_a_typed_error(tmp_path: Path, content: bytes) -> None:
    """A Parquet file that is cut off is refused as a measurement error."""
    path = tmp_path / "broken.parquet"
    path.write_bytes(content)
    with pytest.raises(MeasurementError, match="can't be read"):
        read_measurements(path, JOINTS)


def test_missing_file_and_folder_are_typed_errors(tmp_path: Path) -> None:
    """A path without a file is refused as a measurement error."""
    with pytest.raises(MeasurementError, match="no such file"):
        read_measurements(tmp_path / "absent.csv", JOINTS)
    with pytest.raises(MeasurementError, match="is a folder"):
        read_measurements(tmp_path, JOINTS)


def test_parquet_values_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    """Booleans, texts and NaN in a Parquet column of numbers are refused with their row."""
    path = tmp_path / "poses.parquet"
    columns = {"joint_1": np.array([0.0, np.nan]), "joint_2": np.ones(2), "distance": np.array([True, False])}
    write_table(path, columns)
    with pytest.raises(MeasurementError, match=r'line 2, column "distance": "True".*cells affected: 3'):
        read_measurements(path, JOINTS)


def test_arrays_are_copied_and_read_only() -> None:
    """Measurements neither follow later changes of the arrays they were built from nor can be changed."""
    q = np.zeros((2, 2))
    table = measurements_from_arrays(JOINTS, q, distance=[1, 2])
    q[:] = 9

    assert table.q.tolist() == [[0, 0], [0, 0]]
    for array in (table.q, table.distance, table.target, table.rows):
        assert array is not None
        with pytest.raises(ValueError, match="read-only"):
            array[0] = array[1]


@pytest.mark.parametrize(
    ("arrays", "text"),
    [
        ({"q": np.zeros(3)}, r"q has shape \(3,\); expected \(N, 2\)"),
        ({"position": np.zeros((2, 3))}, r"shape \(2, 3\); expected \(3, 3\)"),
        ({"sigma": np.ones((3, 1))}, r"expected \(3,\)"),
        ({"distance": [1, 2, np.nan]}, r'line 4, "distance"'),
        ({"q": [[0, 1], [2, np.inf], [0, 0]]}, r'line 3, "q"'),
        ({"approach": np.full((3, 2), 0.5)}, "-1, 0 or 1"),
        ({"payload": ["a", "b", "c"]}, "not an array of numbers"),
        ({"quaternion": np.ones((3, 4)) / 2}, "without x y z"),
        ({"distance": np.ones(3), "socket": ["A"] * 3}, "two kinds"),
        (
            {"distance": np.ma.masked_array([1.0, 2.0, 3.0], [False, True, False])},
            '"distance": has masked values; .*leave the',
        ),
        ({"q": [np.ma.masked_array([0.0, 1.0], [True, False])] * 3}, '"q": has masked values'),
        ({"distance": np.ones(3), "target": np.ma.masked_array(["a", "b", "c"], [0, 0, 1])}, '"target": has masked values'),
        ({"position": np.ones((3, 3)) * 1j}, '"position": has complex numbers; expected real'),
        ({"q": np.zeros((3, 2), complex)}, '"q": has complex numbers'),
        ({"paylod": np.ones(3)}, 'unknown column "paylod"; known columns: payload'),
    ],
)
def test_arrays_that_do_not_fit_are_refused(arrays: dict[str, object], text: str) -> None:
    """Arrays of a wrong shape or with an impossible value are refused by name."""
    with pytest.raises(MeasurementError, match=text):
        measurements_from_arrays(JOINTS, **{"q": np.zeros((3, 2)), **arrays})  # type: ignore[arg-type]


def test_a_mask_that_masks_nothing_is_no_mask() -> None:
    """Such an array is its numbers."""
    whole = np.ma.masked_array([1.0, 2.0, 3.0], False)
    table = measurements_from_arrays(JOINTS, np.zeros((3, 2)), distance=whole)
    assert type(table.distance) is np.ndarray and table.distance.tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("chosen", [[2, 0], np.array([True, False, True]), slice(None, None, 2), 1])
def test_select_takes_rows_of_every_column(chosen: object) -> None:
    """Selecting rows selects them in all columns, line numbers included."""
    q = np.arange(6.0).reshape(3, 2)
    table = measurements_from_arrays(JOINTS, q, distance=[1, 2, 3], approach=np.ones((3, 2)))
    part = table.select(chosen)
    expected = np.atleast_1d(np.arange(3)[chosen])  # type: ignore[call-overload]

    assert len(part) == len(expected)
    assert part.q.tolist() == q[expected].tolist()
    assert part.distance is not None
    assert part.distance.tolist() == (expected + 1.0).tolist()
    assert part.rows.tolist() == (expected + 2).tolist()


def test_concatenate_joins_rows_and_sources() -> None:
    """Joined tables keep their rows, lines and file names, and the units that all of them stated."""
    units = {"joint_1": "deg", "x": "mm"}
    first = measurements_from_arrays(JOINTS, [[0, 1]], distance=[1], source="a.csv", units=units)
    second = measurements_from_arrays(JOINTS, [[2, 3]], distance=[2], source="b.csv", units={"x": "mm"})
    joined = concatenate([first, second])

    assert joined.q.tolist() == [[0, 1], [2, 3]]
    assert joined.rows.tolist() == [2, 2]
    assert joined.source == "a.csv, b.csv"
    assert joined.units == {"x": "mm"}


def test_concatenate_refuses_unlike_tables() -> None:
    """Tables of other joints or other columns, and no table at all, can't be joined."""
    table = measurements_from_arrays(JOINTS, [[0, 1]], distance=[1])
    with pytest.raises(MeasurementError, match="no table"):
        concatenate([])
    with pytest.raises(MeasurementError, match="joints a, b"):
        concatenate([table, measurements_from_arrays(("a", "b"), [[0, 1]], distance=[1])])
    with pytest.raises(MeasurementError, match='"payload" is in only one'):
        concatenate([table, measurements_from_arrays(JOINTS, [[0, 1]], distance=[1], payload=[1])])


@pytest.mark.parametrize("place", ["absent/out.csv", "folder", "file/out.csv"])
def test_unwritable_place_is_a_typed_error(tmp_path: Path, place: str) -> None:
    """A place that can't be written to is an output error and leaves nothing behind."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="can't be written"):
        write_table(tmp_path / place, {"x": np.ones(2)})

    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]


def test_failed_write_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A write that fails at the last moment leaves the old file as it was, and no other."""
    path = tmp_path / "out.csv"
    write_table(path, {"x": np.ones(1)})

    def refuse(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(OutputError, match="disk full"):
        write_table(path, {"x": np.zeros(1)})

    assert path.read_text() == "x\n1.0\n"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("columns", [{}, {"x": np.ones(2), "y": np.ones(1)}, {"x": np.ones((2, 2))}, {"x": np.float64(1)}])
def test_columns_of_unequal_length_are_not_written(tmp_path: Path, columns: dict[str, np.ndarray]) -> None:
    """Columns that are no table are an output error."""
    with pytest.raises(OutputError, match=r"expected all of one shape \(N,\)"):
        write_table(tmp_path / "out.csv", columns)


def test_import_does_not_load_polars() -> None:
    """Importing the module is cheap: polars is loaded by the first table that is read or written."""
    code = "import sys, pincal.measure.table; sys.exit('polars' in sys.modules)"
    root = Path(__file__).parents[1]

    assert subprocess.run([sys.executable, "-c", code], cwd=root, check=False).returncode == 0


@pytest.mark.long
def test_a_million_rows_read_as_fast_as_numpy_parses_them(tmp_path: Path) -> None:
    """A million rows of nine columns read within twice the processor time that `numpy.loadtxt` takes for their numbers.

    A ratio in one run: seconds say how busy the machine is (2.6 s of processor time against 2.5 s when this was written).
    """
    path, rng = tmp_path / "big.csv", np.random.default_rng(0)
    names = tuple(f"joint_{i}" for i in range(1, 7))
    write_table(path, {name: rng.normal(size=10**6) for name in (*names, "x [mm]", "y [mm]", "z [mm]")})
    begun = time.process_time()
    table = read_measurements(path, names)
    ours = time.process_time() - begun
    begun = time.process_time()
    numbers = np.loadtxt(path, delimiter=",", skiprows=1)

    assert len(table) == len(numbers) == 10**6
    assert ours < 2.0 * (time.process_time() - begun)
