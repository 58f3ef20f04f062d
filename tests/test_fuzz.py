"""Mutated files of every kind: refused with a typed error that can be printed, or read as an independent reader does."""

import base64
import csv
import json
import warnings
import xml.etree.ElementTree as ET
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pincal.builtin import kuka_urdf_path
from pincal.calibration.checked_fit import calibrate
from pincal.calibration.fitted_robot import FittedRobot, load_model
from pincal.compensate.targets import read_targets
from pincal.errors import BadInputError, IdentificationError, printable
from pincal.identify.options import Options
from pincal.io.camera_file import read_camera
from pincal.measure.points_table import read_distances, read_points
from pincal.measure.table import read_measurements
from pincal.model.effects import GEOMETRIC
from pincal.robot.robot import Robot
from pincal.simulate.instrument import Instrument
from pincal.simulate.machine import TrueMachine

KUKA = kuka_urdf_path().read_bytes()
# What people and programs write by mistake, and what nobody should.
WORDS = '1e999 nan -inf 1_0 \u0663 0x10 1e200 -0 1,5 [deg] " \' ; # , null {} [] < > & ]]> <axis/> xyz="0 0 0" \t \n \r\n'
TOKENS = [word.encode() for word in WORDS.split(" ")]
TOKENS += [b"\0", b"\xff\xfe", b"\x1b[2J", b"\xc2\x9b", b"[" * 50, b"9" * 2000, b'"\\ud800"', b"\xef\xbb\xbf"]

MUTATIONS = st.lists(
    st.tuples(st.sampled_from(("put", "cut", "twice", "end", "flip", "line")), st.integers(0, 2**31), st.integers(0, 2**31)),
    min_size=1,
    max_size=4,
)


def mutated(content: bytes, changes: list[tuple[str, int, int]]) -> bytes:
    """Return a text with changes: a token put in, a piece cut out or written twice, the end lost, a bit, lines exchanged."""
    for kind, where, what in changes:
        at = where % (len(content) + 1)
        to = min(at + 1 + what % 40, len(content))
        if kind == "put":
            content = content[:at] + TOKENS[what % len(TOKENS)] + content[at:]
        elif kind == "cut":
            content = content[:at] + content[to:]
        elif kind == "twice":
            content = content[:to] + content[at:]
        elif kind == "end":
            content = content[:at]
        elif kind == "flip" and at < len(content):
            content = content[:at] + bytes([content[at] ^ (1 << what % 8)]) + content[at + 1 :]
        else:
            lines = content.split(b"\n")
            i, j = where % len(lines), what % len(lines)
            lines[i], lines[j] = lines[j], lines[i]
            content = b"\n".join(lines)
    return content


def accepted(read: Callable[[], object]) -> object:
    """Return what is read, None where it is refused by an error of its own kind, whose message is short and harmless."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            return read()
        except (BadInputError, IdentificationError) as error:
            text = str(error)
            assert text and len(text.encode()) < 2000 and printable(text) == text
            return None
        finally:
            for warning in caught:
                assert printable(str(warning.message)) == str(warning.message)


@pytest.fixture(scope="module")
def columns(kuka: Robot) -> dict[str, np.ndarray]:
    """Return a small table."""
    rng = np.random.default_rng(0)
    q = kuka.random_configurations(30, rng)
    machine = TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0")
    read = Instrument(pose=np.eye(4), targets=(0.1, 0.0, 0.2), sigma=5e-5).measure(machine, q, rng=rng)
    return dict(zip(kuka.joint_names, q.T, strict=True)) | {name: read[name] for name in "xyz"}


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory, kuka: Robot, columns: dict[str, np.ndarray]) -> bytes:
    """Return a small model.json."""
    file = tmp_path_factory.mktemp("fuzz") / "table.csv"
    file.write_bytes(text(columns))
    path = file.with_name("model.json")
    calibrate(kuka, read_measurements(file, kuka.joint_names), Options(effects=GEOMETRIC, sigma=5e-5)).save(path)
    return path.read_bytes()


def text(columns: dict[str, np.ndarray]) -> bytes:
    """Return a table as CSV."""
    rows = [",".join(columns), *(",".join(f"{value:.9g}" for value in row) for row in zip(*columns.values(), strict=True))]
    return ("\n".join(rows) + "\n").encode()


def plain_rows(content: bytes) -> list[dict[str, float]] | None:
    """Return the rows of a plain CSV with the standard library, None where it is not plain: for a comparison only."""
    try:
        lines = [line for line in content.decode("utf-8-sig").splitlines() if line.strip(" ,\t") and line[0] != "#"]
        head, *rows = csv.reader(lines, strict=True)
    except (UnicodeDecodeError, ValueError, csv.Error):
        return None
    names = [name.strip() for name in head]
    if any("[" in name for name in names) or any(len(row) != len(names) for row in rows):
        return None
    try:
        return [dict(zip(names, map(float, row), strict=True)) for row in rows]
    except ValueError:
        return None


# Mutations are drawn in eight parts, one of which is tried before each commit, and the others before a release.
PARTS = 8
in_parts = pytest.mark.parametrize("part", [0, *(pytest.param(k, marks=pytest.mark.rates) for k in range(1, PARTS))])


def tried(test: Callable[[list], None], part: int, *, of: int) -> None:
    """Run a test on a part of so many mutations, always the same ones; the worst is shown without a search for less."""
    chosen = settings(
        max_examples=of // PARTS,
        derandomize=True,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    seed(part)(chosen(given(MUTATIONS)(test)))()


@pytest.mark.long
@in_parts
def test_tables(tmp_path: Path, kuka: Robot, columns: dict[str, np.ndarray], part: int) -> None:
    """A table that is read has the numbers that stand in it, row by row."""
    whole = text(columns)
    tried(lambda changes: holds_its_numbers(mutated(whole, changes), tmp_path / "fuzzed.csv", kuka), part, of=3000)


def holds_its_numbers(content: bytes, file: Path, kuka: Robot) -> None:
    """Hold a table that is read against a plain reading."""
    file.write_bytes(content)
    found = accepted(lambda: read_measurements(file, kuka.joint_names))
    rows = plain_rows(content)
    if found is None or rows is None:
        return
    # Rows without a reading are left out.
    rows = [row for row in rows if not any(np.isnan(row[axis]) for axis in "xyz" if axis in row)]
    assert len(found) == len(rows)
    for i, name in enumerate(kuka.joint_names):
        np.testing.assert_array_equal(found.q[:, i], [row[name] for row in rows])
    for i, name in enumerate("xyz" if {"x", "y", "z"} <= set(rows[0]) else ""):
        np.testing.assert_array_equal(found.readings["position"][:, i], [row[name] for row in rows])


@pytest.mark.long
@in_parts
def test_robots(part: int) -> None:
    """A robot that is read stands where the origins and axes of its file put it."""
    tried(lambda changes: stands_as_written(mutated(KUKA, changes)), part, of=2000)


def stands_as_written(content: bytes) -> None:
    """Hold the tip of a robot that is read against the numbers of its file."""
    robot = accepted(lambda: Robot.from_urdf(content))
    if robot is None:
        return
    q = np.full(robot.n_joints, 0.1)
    assert np.isfinite(robot.forward_kinematics(q[None])).all()
    if (expected := stands(content, robot, q)) is not None:
        np.testing.assert_allclose(robot.forward_kinematics(q[None])[0], expected, atol=1e-9 * max(1.0, robot.reach))


def stands(content: bytes, robot: Robot, q: np.ndarray) -> np.ndarray | None:
    """Return the tip by the standard library and SciPy, None where a joint's numbers are not plain ones."""
    try:
        joints = {
            joint.find("child").get("link"): joint
            for joint in ET.fromstring(content).iter("joint")
            if joint.find("child") is not None
        }
        link, way = robot.tip, np.eye(4)
        while link != robot.base:
            joint = joints[link]
            origin, axis = joint.find("origin"), joint.find("axis")
            step = np.eye(4)
            if origin is not None:
                step[:3, 3] = [float(v) for v in origin.get("xyz", "0 0 0").split()]
                rpy = [float(v) for v in origin.get("rpy", "0 0 0").split()]
                step[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
            if joint.get("name") in robot.joint_names:
                along = np.array([float(v) for v in (axis.get("xyz", "1 0 0") if axis is not None else "1 0 0").split()])
                along = along / np.linalg.norm(along) * q[robot.joint_names.index(joint.get("name"))]
                motion = np.eye(4)
                if joint.get("type") == "prismatic":
                    motion[:3, 3] = along
                else:
                    motion[:3, :3] = Rotation.from_rotvec(along).as_matrix()
                step = step @ motion
            way, link = step @ way, joint.find("parent").get("link")
    except (ET.ParseError, ValueError, KeyError, AttributeError):
        return None
    return way


def _matrix(block: Any, n: int) -> np.ndarray:
    """Return a square matrix of a model file, of numbers or packed into text."""
    if isinstance(block, str):
        words = np.frombuffer(zlib.decompress(base64.b64decode(block.removeprefix("matrix:"))), np.uint8)
        block = np.ascontiguousarray(words.reshape(8, -1).T).view("<f8").ravel()[1:]
    return np.reshape(block, (n, n))


@pytest.mark.long
@in_parts
def test_models(tmp_path: Path, model: bytes, part: int) -> None:
    """A model that is read has the values, the covariance and the limits that stand in it."""
    tried(lambda changes: holds_its_values(mutated(model, changes), tmp_path / "fuzzed.json"), part, of=2000)


def holds_its_values(content: bytes, file: Path) -> None:
    """Hold a model that is read against the JSON of its file."""
    file.write_bytes(content)
    found = accepted(lambda: load_model(file))
    if not isinstance(found, FittedRobot):
        return
    plain = json.loads(content)
    np.testing.assert_array_equal(found.values, plain["values"])
    fitted = np.flatnonzero(plain["fitted"])
    factor = np.array(plain["covariance"].get("factor") or np.zeros((len(fitted), 0)))
    among_fitted = factor @ factor.T
    for group in plain["covariance"]["groups"]:
        places = np.array(group["parameters"], int)
        among_fitted[np.ix_(places, places)] += _matrix(group["block"], len(places))
    covariance = np.zeros((len(plain["values"]),) * 2)
    covariance[np.ix_(fitted, fitted)] = among_fitted
    np.testing.assert_array_equal(found.covariance, covariance)
    assert [p.name for p in found.estimate.parameters] == [p["name"] for p in plain["parameters"]]
    assert np.isfinite(found.predict(np.zeros((1, 6)))).all()


OTHERS: dict[str, tuple[bytes, Callable[[Path, Robot], object]]] = {
    "camera": (
        b'{"fx": 800, "fy": 801.5, "u0": 320, "v0": 240, "k1": -0.1, '
        b'"T_tip_camera": [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0.05], [0, 0, 0, 1]]}',
        lambda file, robot: read_camera(file),
    ),
    "points": (b"point,x [mm],y [mm],z [mm]\na,1,2,3\nb,4,5,6.5\n", lambda file, robot: read_points(file)),
    "distances": (b"first;second;distance\na;b;0,05\nb;c;1,5\n", lambda file, robot: read_distances(file)),
    "targets": (
        b"joint_1,joint_2,joint_3,joint_4,joint_5,joint_6,x,y,z\n0,-1,1,0,0.5,0,1.5,0.1,1.2\n0.1,-1,1,0,0.5,0,1.4,0.2,1.2\n",
        lambda file, robot: read_targets(file, robot),
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("kind", OTHERS)
@in_parts
def test_other_files(tmp_path: Path, kuka: Robot, kind: str, part: int) -> None:
    """Cameras, points, distances and targets: no error but a typed one."""
    content, read = OTHERS[kind]
    file = tmp_path / f"fuzzed{'.json' if kind == 'camera' else '.csv'}"

    def is_read_or_refused(changes: list) -> None:
        file.write_bytes(mutated(content, changes))
        accepted(lambda: read(file, kuka))

    tried(is_read_or_refused, part, of=760)


@pytest.mark.long
def test_hostile_models_cost_little(tmp_path: Path, model: bytes) -> None:
    """Deep, wide and long files are refused in a second and a half, on a machine that does other things as well."""
    import time

    whole = model.decode()
    hostile = {
        "deep": "[" * 10_000_000,
        "digits": '{"format_version": ' + "9" * 40_000_000 + "}",
        "keys": "{" + ",".join(f'"{i}":0' for i in range(2_600_000)) + "}",
        "text": '{"format_version": 1, "name": "' + "\\n" * 20_000_000 + '"}',
        "effects": whole.replace('"effects": [', '"effects": [' + '{"name": "joint_offset"},' * 100_000, 1),
    }
    for name, content in hostile.items():
        file = tmp_path / f"{name}.json"
        file.write_text(content)
        begun = time.process_time()
        assert accepted(lambda file=file: load_model(file)) is None
        assert time.process_time() - begun < 1.5, name


@pytest.mark.parametrize("content", [b"a" * 200_000 + b",x\n1,2\n", b"x,y\n" + b"1" * 200_000 + b',"2\n', b'"x\n' * 50_000])
def test_cells_without_end_are_refused(tmp_path: Path, kuka: Robot, content: bytes) -> None:
    """A cell of a hundred thousand characters is no name and no number."""
    (tmp_path / "long.csv").write_bytes(content)
    assert accepted(lambda: read_measurements(tmp_path / "long.csv", kuka.joint_names)) is None
