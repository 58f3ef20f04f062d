"""Forms in which people store poses: read to the last digit, or refused with the line by which they are."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from scipy.spatial.transform import Rotation
from table_forms import (
    BY_NUMBER,
    FLAT,
    FORMS,
    NAMES,
    OPENCV,
    REFUSED,
    ROTATIONS,
    RVEC,
    cured,
    is_right,
    npy,
    npz,
    numbers,
    places,
    saved,
)
from test_table_kinds import DEG, JOINTS, KINDS, MATRICES, MM, TURNED, XYZ, K, Kind, Q, cells, file, headed, lines, read

from pincal.compensate.returned_table import write_returned
from pincal.errors import MeasurementError, PincalWarning
from pincal.measure.flat_matrices import order_of_matrix, quaternions_of
from pincal.measure.nameless import has_numbers_for_names, with_poses_in_rows
from pincal.measure.nested_labels import vector_labels
from pincal.measure.placeholders import placeholders
from pincal.measure.reader import links_of_rows, read_table
from pincal.measure.reading_numbers import LAYOUT
from pincal.measure.table import read_measurements
from pincal.measure.table_schema import Schema, TableOptions
from pincal.readers.nested_values import by_path
from pincal.readers.opencv_storage import matrix
from pincal.sensors.fields import Field

Z90 = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("name", FORMS)
def test_a_form_is_read_without_an_option(tmp_path: Path, name: str) -> None:
    """Joints and poses are those of the machine, and what was inferred is told."""
    kind = FORMS[name]

    assert is_right(kind, tmp_path) and not kind.options
    assert kind.note in "\n".join(read(kind, tmp_path)[1])


@pytest.mark.parametrize("name", REFUSED)
def test_a_form_is_refused_with_what_cures(tmp_path: Path, name: str) -> None:
    """Numbers without names are never read by a guess; the option that the refusal proposes reads them rightly."""
    assert cured(REFUSED[name], tmp_path)


def test_nine_of_ten_kinds_need_no_option() -> None:
    """Of 60 kinds and more, with those of tables and logs; ``python tests/table_forms.py`` prints the figure."""
    without = [name for name, kind in (KINDS | FORMS).items() if not kind.options]

    assert len(KINDS) + len(FORMS) >= 60 and len(without) >= 0.9 * (len(KINDS) + len(FORMS))
    assert not KINDS.keys() & FORMS.keys() and not FORMS.keys() & REFUSED.keys()


def test_numbers_are_a_matrix_if_they_form_one() -> None:
    """By orthonormal rows and the last row 0 0 0 1, to a hundredth and in most rows; not by their names or number."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Z90, (1.0, 2.0, 3.0)
    rows, columns = [0, 4, 8], [0, 1, 2]
    for values, first, place in (
        (T, columns, [3, 7, 11]),
        (T.T, rows, [12, 13, 14]),
        (T[:3], columns, [3, 7, 11]),
        (T[:3].T, [0, 3, 6], [9, 10, 11]),
    ):
        order = order_of_matrix(values.reshape(1, -1))
        assert order is not None
        assert order[0, :3].tolist() == first and order[:, 3].tolist() == place

    for error, is_one in ((0.9 * LAYOUT.orthonormal, True), (1.1 * LAYOUT.orthonormal, False)):
        for place in (15, 0):
            wrong = T.ravel()[None].copy()
            # A row of length 1 + e / 2 has the square 1 + e.
            wrong[0, place] += error if place == 15 else 0.0
            wrong[0, 4:7] *= 1.0 if place == 15 else np.sqrt(1.0 + error)
            assert (order_of_matrix(wrong) is not None) == is_one
    assert np.isnan(quaternions_of(np.diag([1.0, 1.0, -1.0])[None])).all()
    some = np.tile(T.ravel(), (10, 1))
    some[:3] = 0.5
    assert order_of_matrix(some) is not None
    some[:5] = 0.5
    assert order_of_matrix(some) is None and order_of_matrix(some[:, :11]) is None


def test_numbered_columns_that_are_no_matrix_stay_columns(tmp_path: Path) -> None:
    """Sixteen channels beside a position are left out and listed; without one the table is refused by their names."""
    noise = np.random.default_rng(1).uniform(-1.0, 1.0, (K, 16))
    with_place = headed(NAMES + "x y z " + numbers("channel_{}", 16), Q, XYZ, noise)
    found, notes, _ = read(with_place, tmp_path)
    assert found.kind == "position" and "unknown to pincal are ignored" in "\n".join(notes)
    with pytest.raises(MeasurementError, match='unknown column "channel_0"'):
        read(headed(NAMES + numbers("channel_{}", 16), Q, noise), tmp_path)


def test_matrices_that_are_no_rotations_are_refused(tmp_path: Path) -> None:
    """A wrong row by its number; of two matrices none is chosen, unless one is of the hand."""
    wrong = ROTATIONS.copy()
    wrong[4] = 0.3
    names = NAMES + "x y z " + places("r{}{}", 3, 3, 1)
    with pytest.raises(MeasurementError, match=r"1 of 12 rows are no rotations, first in row 5"):
        read(headed(names, Q, XYZ, wrong), tmp_path)
    other = np.roll(FLAT, 1, axis=0)
    two = NAMES + places("a_{}{}", 4, 4) + " " + places("b_{}{}", 4, 4)
    with pytest.raises(MeasurementError, match=r"the matrix of .a_00. and .b_00.; .*--ignore 'b\*'"):
        read(headed(two, Q, FLAT, other), tmp_path)
    assert is_right(headed(two, Q, FLAT, other, is_pose=True, options={"ignore": ["b*"]}), tmp_path)
    of_hand = NAMES + places("T_base_ee_{}{}", 4, 4) + " " + places("T_cam_marker_{}{}", 4, 4)
    assert is_right(headed(of_hand, Q, other, FLAT, is_pose=True), tmp_path)


def test_keys_are_of_poses_or_of_columns() -> None:
    """Three keys or more with the same values are poses; numbered lists are where there are more of them than numbers."""
    pose = {"joints": [0.0] * 6, "T": np.eye(4).tolist()}
    for count in (LAYOUT.fewest_keys - 1, LAYOUT.fewest_keys):
        data = {f"pose_{k}": pose for k in range(count)}
        found = by_path(data, "poses.json")
        assert ("joints" in found) == (count == LAYOUT.fewest_keys)
    size = LAYOUT.of_pose
    for count in (size, size + 1):
        data = {f"{name}_{k}": [0.1] * size for k in range(count) for name in ("q", "p")}
        assert ("q" in by_path(data, "poses.json")) == (count > size)
    long = {f"{name}_{k}": [0.1] * (size + 1) for k in range(size + 2) for name in ("q", "p")}
    assert "q" not in by_path(long, "poses.json")
    # The columns of an RTDE log are lists of all its samples.
    logged = {f"actual_{name}_{k}": [0.1] * 50 for name in ("q", "qd") for k in range(6)}
    assert by_path(logged, "log.json").keys() == logged.keys()


def test_named_transforms_are_no_poses_of_a_table() -> None:
    """Mounts beside the poses have keys of the same values, and words for names."""
    mounts = {name: {"x": 0.1, "y": 0.2, "z": 0.3} for name in ("base", "tool", "camera")}
    data = {"mounts": mounts, "q": Q.tolist(), "p": XYZ.tolist()}

    assert by_path(data, "log.json").keys() == {"q", "p"}


@pytest.mark.parametrize("key", ["torque", "current", "data", "temperatures", "effort"])
def test_six_numbers_are_a_pose_only_by_name(key: str) -> None:
    """The letter t in a word makes no transform; a capital T alone, or a word for it, does."""
    six = np.zeros((3, 6))
    assert vector_labels(key, six)[0][0] == f"{key}.0"
    for name in ("T", "T_base_tool", "base_T_tool", "pose", "toolPose", "T1"):
        assert vector_labels(name, six)[0][:4] == ("x", "y", "z", "rx"), name
    assert vector_labels("joint_pose", six)[0][0] == "joint_1"
    assert vector_labels("rvec", RVEC[:, None, :])[0] == ("rx", "ry", "rz")


def test_a_pose_of_the_hand_alone_is_read(tmp_path: Path) -> None:
    """What is called a pose of the hand is the controller's if there is another; alone it may be what a tracker measured."""
    alone = saved("log.json", {"q": Q.tolist(), "T_base_tool": MATRICES.tolist()})
    assert is_right(Kind(alone, is_pose=True), tmp_path)


def test_a_camera_on_the_hand_is_found_from_names_of_opencv(tmp_path: Path) -> None:
    """Its poses are those in the frame of the object, the inverse of what the camera read; vectors say the same."""
    vectors = {
        name.replace("R_", "rvec_"): Rotation.from_matrix(of).as_rotvec() for name, of in OPENCV.items() if name[0] == "R"
    }
    others = {name: of for name, of in OPENCV.items() if name[0] != "R"}
    found, notes, _ = read(Kind(npz(**vectors, **others)), tmp_path)

    assert "with the camera on the hand and the object fixed, as the samples show" in "\n".join(notes)
    np.testing.assert_allclose(found.position, XYZ, rtol=0, atol=1e-9)
    assert (Rotation.from_quat(found.quaternion) * TURNED.inv()).magnitude().max() < 1e-9


def test_a_row_of_numbers_is_a_header_if_they_count() -> None:
    """0 1 2 as pandas writes them, with a blank for the index; positions in order do not occur."""
    assert has_numbers_for_names(["", *map(str, range(9))]) and has_numbers_for_names(["1", "2", "3"])
    assert not has_numbers_for_names(["1", "3", "2"]) and not has_numbers_for_names(["x", "y", "1"])
    assert not has_numbers_for_names([*JOINTS])


def test_poses_stand_where_the_numbers_show_it() -> None:
    """In columns if those fit the arm and rows do not; matrices and quaternions show it, else the longer side does."""
    table = np.column_stack([Q, XYZ])
    assert with_poses_in_rows(table, 6) is table
    np.testing.assert_array_equal(with_poses_in_rows(table.T, 6), table)
    # Fewer poses than numbers of each.
    few = np.column_stack([Q, FLAT])
    assert with_poses_in_rows(few, 6) is few
    np.testing.assert_array_equal(with_poses_in_rows(few.T, 6), few)
    more = np.column_stack([table, np.zeros(K)])
    assert with_poses_in_rows(more, 6) is more
    size = int(LAYOUT.poses_to_numbers * 4)
    for columns, along in ((size, (4, size)), (size + 1, (size + 1, 4))):
        assert with_poses_in_rows(np.zeros((4, columns)), 0).shape == along


def test_some_columns_by_number_leave_the_others_out(tmp_path: Path) -> None:
    """They are listed like other unknown ones; a number too many is refused."""
    table = np.column_stack([Q, XYZ, np.full(K, 0.013)])
    path = npy(table)(tmp_path)
    with pytest.warns(PincalWarning, match='unknown to pincal are ignored: "10"'):
        found = read_measurements(path, JOINTS, columns=BY_NUMBER)
    np.testing.assert_allclose(found.position, XYZ)
    with pytest.raises(MeasurementError, match='no column "11" for --columns 11=x'):
        read_measurements(path, JOINTS, columns=BY_NUMBER | {"11": "x"})
    with pytest.raises(MeasurementError, match=r"10 columns of numbers and no names; expected .* the arm has 6 joints"):
        read_measurements(path, JOINTS)


def test_a_table_without_names_is_returned_without(tmp_path: Path) -> None:
    """Numbers change in their cells, also below a comment; no line of names is added."""
    (tmp_path / "in.csv").write_text("# by hand\n0.1;0.2;1.5\n0.3;0.4;2.5\n")
    schema = Schema((Field("distance", ("distance",), "length"),), joint_names=("a", "b"))
    named = replace(schema, options=TableOptions(columns={"1": "a", "2": "b", "3": "distance"}))
    found = read_table(tmp_path / "in.csv", named)
    new = {"a": np.array([0.7, 0.8]), "b": np.array([0.9, 1.0]), "distance": np.array([1.5, 2.5])}
    write_returned(tmp_path / "out.csv", found, new, ("a", "b"))

    lines = (tmp_path / "out.csv").read_text().splitlines()
    assert lines[0] == "# by hand"
    assert [[float(cell) for cell in line.split(";")] for line in lines[1:]] == [[0.7, 0.9, 1.5], [0.8, 1.0, 2.5]]


def test_pickled_arrays_are_not_read(tmp_path: Path) -> None:
    """Objects may hold programs; the refusal says what is read."""
    np.save(tmp_path / "poses.npy", np.array([{"q": 1.0}], object), allow_pickle=True)
    with pytest.raises(MeasurementError, match="can't be read as npy"):
        read_measurements(tmp_path / "poses.npy", JOINTS)
    (tmp_path / "poses.pkl").write_bytes(b"\x80\x04\x95")
    with pytest.raises(MeasurementError, match=r"\.pkl is not read; save the table as \.xlsx or CSV"):
        read_measurements(tmp_path / "poses.pkl", JOINTS)


def test_matrices_of_opencv_that_contradict_themselves_are_refused(tmp_path: Path) -> None:
    """By rows, columns and channels, which are as many numbers as there are."""
    assert matrix({"rows": 2, "cols": 1, "dt": "3d", "data": [*range(6)]}).shape == (2, 1, 3)
    text = "%YAML:1.0\n---\nq_0: !!opencv-matrix\n   rows: 2\n   cols: 2\n   dt: d\n   data: [ 1., 2. ]\n"
    (tmp_path / "poses.yml").write_text(text)
    with pytest.raises(MeasurementError, match="has 2 rows and 2 columns, and other data"):
        read_measurements(tmp_path / "poses.yml", JOINTS)
    (tmp_path / "poses.xml").write_text('<?xml version="1.0"?>\n<opencv_storage><q')
    with pytest.raises(MeasurementError, match=r"poses\.xml: not XML"):
        read_measurements(tmp_path / "poses.xml", JOINTS)


def test_lists_in_cells_are_equally_long(tmp_path: Path) -> None:
    """A shorter one is refused by its line."""
    rows = [json.dumps(q)[:-1] + "]" for q in Q.tolist()]
    rows[3] = "[0.1, 0.2]"
    pairs = zip(rows, XYZ.tolist(), strict=True)
    (tmp_path / "log.csv").write_text("joints,position\n" + "".join(f'"{q}","{p}"\n' for q, p in pairs))
    with pytest.raises(MeasurementError, match='column "joints", line 5: a list of 2 numbers; expected 6'):
        read_measurements(tmp_path / "log.csv", JOINTS)


def test_columns_are_named_in_the_table_and_in_the_log(tmp_path: Path) -> None:
    """One option names columns of both files, whoever asks first; a name of neither is refused."""
    pl.DataFrame({"id": [*range(K)], **dict(zip("uvw", XYZ.T, strict=True))}).write_csv(tmp_path / "tracker.csv")
    robot = {"id": [*range(K)]} | dict(zip("abcdef", Q.T, strict=True))
    pl.DataFrame(robot).write_csv(tmp_path / "robot.csv")
    meanings = dict(zip("abcdefuvw", (*JOINTS, *"xyz"), strict=True))
    log = tmp_path / "robot.csv"
    assert links_of_rows(tmp_path / "tracker.csv", TableOptions(columns=meanings, joints=log)) == [(None, None)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PincalWarning)
        found = read_measurements(tmp_path / "tracker.csv", JOINTS, columns=meanings, joints=log)
        np.testing.assert_allclose(found.q, Q)
        np.testing.assert_allclose(found.position, XYZ)
        with pytest.raises(MeasurementError, match='no column "g" for --columns g=x'):
            read_measurements(tmp_path / "tracker.csv", JOINTS, columns=meanings | {"g": "x"}, joints=log)
        said = r"in the order of the arm: --columns 'a=joint_a1,b=joint_a2,.*,f=joint_a6'"
        with pytest.raises(MeasurementError, match=said):
            read_measurements(tmp_path / "tracker.csv", JOINTS, joints=log)


def test_numbers_in_place_of_readings_by_hand() -> None:
    """In all axes: any beyond twice all others, 0 and -1 in less than half of the rows; beside eight other rows or more."""
    rng = np.random.default_rng(3)
    fewest = LAYOUT.fewest_readings
    place = rng.uniform(-0.7, 0.7, (2 * fewest, 3))
    largest = np.abs(place).max()

    def found(number: float, count: int = 1, others: int = 2 * fewest) -> bool:
        told = placeholders(np.vstack([place[:others], np.full((count, 3), number)]))
        assert not told[:others].any() and len({*told[others:].tolist()}) == 1
        return bool(told[-1])

    for number in (-9999.0, 99999.99, 65535.0, 0.0, -1.0):
        assert found(number) and found(number, others=fewest) and not found(number, others=fewest - 1)
    for factor, is_one in ((0.9 * LAYOUT.beyond, False), (1.1 * LAYOUT.beyond, True)):
        assert found(factor * largest) == is_one
    half = int(2 * fewest * LAYOUT.seldom / (1.0 - LAYOUT.seldom))
    assert found(0.0, half - 1) and not found(0.0, half) and found(-9999.0, half)
    # A distance of 0 is one; nines are not.
    distance = np.abs(place[:, :1])
    assert placeholders(np.vstack([distance, [[0.0], [-9999.0], [7.5]]]))[-3:].tolist() == [False, True, False]


def test_what_may_be_thousands_or_decimals_is_refused(tmp_path: Path) -> None:
    """1,234 alone is either; the words say how to write it. So is a row of units of which some are unknown."""
    rows = [[*row[:8], f'"1,{k + 100}"'] for k, row in enumerate(cells(Q, XYZ))]
    with pytest.raises(MeasurementError, match=r'"1,100"; .*without separators between thousands'):
        read(Kind(file("log.csv", lines([*JOINTS, *"xyz"], rows))), tmp_path)
    rows = [[f"{cell} deg" for cell in row] for row in cells(DEG, MM)]
    with pytest.raises(MeasurementError, match=r"their unit in the name, x \[mm\]"):
        read(Kind(file("log.csv", lines([*JOINTS, *"xyz"], rows))), tmp_path)
    rows = [["furlong"] * 6 + ["mm"] * 3, *cells(DEG, MM)]
    with pytest.raises(MeasurementError, match="the row of units has 'furlong', which is not a unit"):
        read(Kind(file("log.csv", lines([*JOINTS, *"xyz"], rows))), tmp_path)
