"""Sensors: every one keeps the same contract."""

from __future__ import annotations

import ast
import inspect
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from trees import parsed

import pincal
from pincal import plugins
from pincal.errors import MeasurementError
from pincal.measure.measurements import measurements_from_arrays, sensor_of
from pincal.parameters import FRAME_SYMBOLS
from pincal.plugins import load_plugin
from pincal.robot.se3 import rotation_matrices, rotation_vectors
from pincal.sensors.camera import CameraPixelSensor, CameraPointSensor, FixedCameraSensor
from pincal.sensors.distance import AnchoredDistanceSensor, DistanceSensor, PointDistances
from pincal.sensors.imu import ImuSensor
from pincal.sensors.lens import Lens
from pincal.sensors.plane import GaugeSensor, PlaneContactSensor
from pincal.sensors.pose import PoseSensor, PositionSensor
from pincal.sensors.registry import SENSORS
from pincal.sensors.sensor import Sensor
from pincal.sensors.setup import NamedPoints, Setup
from pincal.sensors.socket import Coincidences, ContactSensor, LinkContactSensor, LinkDistanceSensor

N = 12
OWN = np.zeros(0)


def random_poses(rng: np.random.Generator, n: int = N) -> np.ndarray:
    """Return poses anywhere within some metres, shape (n, 3, 4)."""
    return np.concatenate([Rotation.random(n, random_state=rng).as_matrix(), rng.uniform(-3.0, 3.0, (n, 3, 1))], axis=2)


def moved(poses: np.ndarray, shift: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Return poses shifted [m] and turned by rotation vectors [rad], both in the instrument's axes."""
    out = poses.copy()
    out[:, :, :3] = Rotation.from_rotvec(turn).as_matrix() @ poses[:, :, :3]
    out[:, :, 3] += shift
    return out


class Case:
    """A sensor that reads poses without noise, and the values of its own parameters at which it does."""

    def __init__(self, kind: str, read: Callable[[np.ndarray], Sensor], own: np.ndarray = np.zeros(0)) -> None:  # noqa: B008
        self.kind, self.read, self.own = kind, read, own


# A camera looks along the target's z axis; points lie anywhere in front of it, so each row has one of its own.
AHEAD = np.random.default_rng(5).uniform([-0.1, -0.1, 0.3], [0.1, 0.1, 0.8], (N, 3))
NAMES = [f"p{i}" for i in range(N)]
PLANES = np.array([[0.1, 0.2, 0.9, 0.4], [0.8, -0.5, 0.1, -0.3]])
UP = np.random.default_rng(6).normal(0.0, 1.0, (N, 3))
LENS = Lens(1000.0, 1010.0, 320.0, 240.0, -0.1, 0.05, 1e-3, -2e-3, 0.01)
FAR = np.array([[4.0, 1.0, 0.5], [-3.0, 2.0, 1.0]])


def ahead(poses: np.ndarray) -> np.ndarray:
    """Return the points that each row's camera has in front of it, in the instrument's frame, shape (N, 3)."""
    return np.einsum("nij,nj->ni", poses[:, :, :3], AHEAD[: len(poses)]) + poses[:, :, 3]


def held(poses: np.ndarray, sensor: type[Coincidences] = ContactSensor) -> Sensor:
    """Return contacts whose sockets are wherever the tool point is: one known, the others to be found."""
    places = dict.fromkeys(NAMES) | {"p0": tuple(poses[0, :, 3])}
    return sensor(NamedPoints(places), np.arange(len(poses)))


def anchored(poses: np.ndarray, sensor: type[PointDistances] = AnchoredDistanceSensor) -> Sensor:
    """Return distances in turn from a known anchor and from one to be found."""
    index = np.arange(len(poses)) % 2
    points = NamedPoints({"a": tuple(FAR[0]), "b": None})
    return sensor(points, index, np.linalg.norm(poses[:, :, 3] - FAR[index], axis=1))


def cases() -> list[Case]:
    """Return a case of every sensor; those of named points read the poses of a fixed seed."""
    places = SEEN[:, :, 3]
    return [
        Case("position", lambda poses: PositionSensor(poses[:, :, 3].copy())),
        Case("pose", lambda poses: PoseSensor(poses[:, :, 3].copy(), poses[:, :, :3].copy())),
        Case("distance", lambda poses: DistanceSensor(np.linalg.norm(poses[:, :, 3], axis=1))),
        Case("socket", lambda _: held(SEEN), places[1:].ravel()),
        Case("distance", anchored, FAR[1]),
        Case("contact", lambda _: held(SEEN, LinkContactSensor), places[1:].ravel()),
        Case("contact distance", lambda poses: anchored(poses, LinkDistanceSensor), FAR[1]),
        Case(
            "camera_point",
            lambda _: CameraPointSensor(NamedPoints(dict.fromkeys(NAMES)), np.arange(N), AHEAD.copy()),
            ahead(SEEN).ravel(),
        ),
        Case(
            "camera_pixel",
            lambda _: CameraPixelSensor(
                points=NamedPoints(dict.fromkeys(NAMES)),
                index=np.arange(N),
                pixel=LENS.project(AHEAD),
                setup=Setup(lens=LENS, fit_lens=True),
            ),
            np.concatenate([ahead(SEEN).ravel(), np.zeros(9)]),
        ),
        Case("fixed_camera_pixel", fixed, np.zeros(9)),
        Case(
            "plane",
            lambda _: PlaneContactSensor(tuple(NAMES), np.arange(N), np.zeros(N)),
            np.column_stack([UP, np.einsum("ni,ni->n", UP, places)]).ravel(),
        ),
        Case("gauge", gauged, PLANES.ravel()),
    ]


def fixed(poses: np.ndarray) -> Sensor:
    """Return images of a fixed camera that has the target before it."""
    lens = Lens(1000.0, 1010.0, 320.0, 240.0)
    return FixedCameraSensor(lens.project(poses[:, :, 3]), Setup(lens=lens, fit_lens=True))


def gauged(poses: np.ndarray) -> Sensor:
    """Return what a dial reads before two planes in turn."""
    index = np.arange(len(poses)) % 2
    planes = PLANES[index]
    height = np.einsum("ni,ni->n", planes[:, :3], poses[:, :, 3]) - planes[:, 3]
    return GaugeSensor(("f", "g"), index, height / np.linalg.norm(planes[:, :3], axis=1))


def laser_case() -> Case:
    """Return a case of the example's laser, whose beam meets a plane in every pose, if behind it in some."""
    laser = load_plugin(str(EXAMPLE)).LineLaser
    plane = np.array([-9.0, 0.1, -0.2])

    def read(poses: np.ndarray) -> Sensor:
        start, beam = poses[:, :, 3], poses[:, :, 2]
        height = start[:, 2] - plane[0] - start[:, :2] @ plane[1:]
        found: Sensor = laser(height / (beam[:, :2] @ plane[1:] - beam[:, 2]))
        return found

    return Case("range", read, plane)


EXAMPLE = Path(__file__).parents[1] / "examples" / "line_laser.py"
SEEN = random_poses(np.random.default_rng(7))
SEEN[:, 2, 3] = np.abs(SEEN[:, 2, 3]) + 2.0  # Before a camera that stands at the origin.
READING = {case.kind: case.read for case in reversed(cases())}


KNOWN_BEFORE, LOADED_BEFORE = dict(SENSORS._classes), dict(plugins._loaded)
CASES = [*cases(), laser_case()]
# The example's sensor is under test here; no other test, and no worker of one, shall know it.
SENSORS._classes.clear()
SENSORS._classes.update(KNOWN_BEFORE)
plugins._loaded.clear()
plugins._loaded.update(LOADED_BEFORE)
sys.modules.pop("line_laser", None)


@pytest.fixture(params=CASES, ids=lambda case: type(case.read(SEEN)).__name__)
def case(request: pytest.FixtureRequest) -> Case:
    """Return a case of each sensor."""
    found: Case = request.param
    return found


def test_every_sensor_is_under_test() -> None:
    """A sensor that is added without being added here fails this test."""

    def below(kind: type) -> set[type]:
        return {kind} | {leaf for child in kind.__subclasses__() for leaf in below(child)}

    found = {kind for kind in below(Sensor) if not inspect.isabstract(kind) and kind.__module__.startswith("pincal.")}

    # An IMU reads several moments a row: test_motion.py and test_motion_stations.py.
    assert found == {ImuSensor, *(type(case.read(SEEN)) for case in cases())} == set(KNOWN_BEFORE.values())
    assert all(case.read(SEEN).kind == case.kind for case in CASES)


@pytest.mark.parametrize("kind", [type(case.read(SEEN)) for case in CASES], ids=lambda kind: kind.__name__)
def test_no_concrete_method_is_overridden(kind: type) -> None:
    """A sensor states what is abstract above it and replaces nothing that works."""
    above = [cls for cls in kind.__mro__ if cls.__module__.startswith(("pincal.", "line_laser"))]
    for i, cls in enumerate(above):
        for name in vars(cls):
            for base in above[i + 1 :]:
                there = vars(base).get(name)
                is_code = isinstance(there, property | classmethod | staticmethod) or inspect.isfunction(there)
                if is_code and not name.startswith("__"):
                    assert getattr(there, "__isabstractmethod__", False), f"{cls.__name__}.{name} of {base.__name__}"


# Where the names of sensors may stand: their own files, the registry, and what makes a table's arrays into one of them. The
# simulator is an independent oracle; what its commands offer is what it can do.
ALLOWED = (
    *sorted({f"sensors/{kind.__module__.rpartition('.')[2]}.py" for kind in KNOWN_BEFORE.values()}),
    "sensors/registry.py",
    "measure/measurements.py",
    "simulate/",
)


@pytest.mark.long
def test_no_sensor_is_recognised_outside_its_own_file() -> None:
    """No other module names the class of a sensor, or compares with what one of them measures."""
    classes = {kind.__name__ for kind in KNOWN_BEFORE.values()}
    kinds = {kind.kind for kind in KNOWN_BEFORE.values()}
    package = Path(inspect.getfile(pincal)).parent
    found = []
    for path in sorted(package.rglob("*.py")):
        place = path.relative_to(package).as_posix()
        if place.startswith(ALLOWED):
            continue
        for node in ast.walk(parsed(path.read_text(encoding="utf-8"))):
            names = {node.id} if isinstance(node, ast.Name) else {a.name for a in getattr(node, "names", [])
                                                                  if isinstance(a, ast.alias)}  # fmt: skip
            compared = [*([node.left, *node.comparators] if isinstance(node, ast.Compare) else []),
                        *(node.keys if isinstance(node, ast.Dict) else [])]  # fmt: skip
            strings = {leaf.value for part in compared if part is not None for leaf in ast.walk(part)
                       if isinstance(leaf, ast.Constant) and isinstance(leaf.value, str)}  # fmt: skip
            found += [f"{place}:{node.lineno} {name}" for name in (names & classes) | (strings & kinds)]

    # Names of arrays and columns, not kinds: of a table of targets, of a list of known distances, of records in files, the
    # displacement that stands for the error of an image, and the points of programs, which are poses or joint positions.
    others = ("compensate/targets.py", "measure/points_table.py", "validate/accuracy.py")
    # And what a pin of a loop holds.
    others += ("readers/nested_sheet.py", "programs/", "model/loops.py", "robot/", "export/mjcf.py")
    # Files of a session, and topics of a recording.
    others += ("motion/sessions.py", "motion/stations.py", "readers/recordings.py", "motion/cli/")
    # Names of columns and keys in files.
    others += ("measure/header.py", "measure/nested_labels.py", "readers/nested_values.py")
    # Features of a part, and their quantities; the column of a plan of contacts.
    names = ("best_fit", "datum", "feature_fit", "flange_sensor", "part_feature", "part_file", "part_values", "probe")
    others += (*(f"features/{name}.py" for name in names), "design/cli/acceptance_planning.py")
    # Orientations alone, which the closed form of poses places.
    others += ("validate/orientations.py",)
    assert [entry for entry in found if not entry.startswith(others)] == []


def test_residuals_are_zero_at_the_truth(case: Case) -> None:
    """A reading of a pose agrees with the prediction of this pose."""
    sensor = case.read(SEEN)
    rounding = np.concatenate([np.full(block.size, block.rounding) for block in sensor.blocks])

    assert np.all(np.abs(sensor.residuals(SEEN, case.own)).max(axis=1) < rounding)


def test_blocks_add_up_to_the_components(case: Case, rng: np.random.Generator) -> None:
    """There are as many residuals a row as the blocks say, as many columns in the Jacobian as motions and parameters."""
    sensor = case.read(SEEN)
    m = sum(block.size for block in sensor.blocks)
    motion = rng.standard_normal((5, sensor.twist_rows, N))

    assert len(sensor) == N and len(sensor.parameters) == len(case.own) == len(sensor.fixed)
    assert sensor.residuals(SEEN, case.own).shape == (m, N)
    assert sensor.jacobian(SEEN, motion, case.own).shape == (5 + len(case.own), m, N)
    assert all(block.unit == {"orientation": "rad", "image": "px"}.get(block.name, "m") for block in sensor.blocks)
    assert set(sensor.base_symbols) <= set(FRAME_SYMBOLS) and set(sensor.tool_symbols) <= set(FRAME_SYMBOLS)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1e-3, 0.1, 1.0, 2.5, 3.0])
def test_jacobian_is_minus_the_slope_of_the_residuals(case: Case, angle: float, rng: np.random.Generator) -> None:
    """The Jacobian equals central differences of the residuals, for orientations off by anything up to 3 rad, too."""
    axis = rng.standard_normal((N, 3))
    # What is behind a camera has no image.
    angle = min(angle, 0.1) if case.kind in ("camera_pixel", "range") else angle
    off = angle * axis / np.linalg.norm(axis, axis=1, keepdims=True)
    sensor = case.read(SEEN)
    poses = moved(SEEN, rng.normal(0.0, 0.01, (N, 3)), off)
    rows = sensor.twist_rows
    motion = rng.standard_normal((4, rows, N))
    jacobian = sensor.jacobian(poses, motion, case.own)
    h = 1e-6
    # The slope grows without bound towards half a turn, and so does what differences are off by.
    loose = 1e-6 if angle >= 3.0 else 1e-3 if case.kind.endswith("camera_pixel") else 1e-8
    for p in range(4):
        twist = np.zeros((N, 6))
        twist[:, :rows] = motion[p].T
        ahead, behind = (sensor.residuals(moved(poses, s * twist[:, :3], s * twist[:, 3:]), case.own) for s in (h, -h))
        np.testing.assert_allclose(jacobian[p], (behind - ahead) / (2.0 * h), rtol=1e-7, atol=loose)
    for p in range(len(case.own)):
        step = h * np.eye(len(case.own))[p]
        ahead, behind = (sensor.residuals(poses, case.own + s * step) for s in (1.0, -1.0))
        np.testing.assert_allclose(jacobian[4 + p], (behind - ahead) / (2.0 * h), rtol=1e-7, atol=loose)


def test_jacobian_leaves_the_motion_as_it_is(case: Case, rng: np.random.Generator) -> None:
    """The motion that is handed in may be used again."""
    sensor = case.read(SEEN)
    motion = rng.standard_normal((2, sensor.twist_rows, N))
    before = motion.copy()
    sensor.jacobian(moved(SEEN, np.zeros(3), np.full((N, 3), 0.03)), motion, case.own)

    np.testing.assert_array_equal(motion, before)


@pytest.mark.parametrize(
    "rows",
    [slice(2, 7), np.array([5, 0, 5]), np.arange(N) % 3 == 0, np.zeros(N, bool)],
    ids=["slice", "index", "mask", "none"],
)
def test_selected_rows_are_those_of_the_table(case: Case, rows: slice | np.ndarray, rng: np.random.Generator) -> None:
    """Selecting readings and selecting residuals is the same thing."""
    sensor, poses = case.read(SEEN), moved(SEEN, rng.normal(0.0, 0.01, (N, 3)), np.zeros((N, 3)))
    part = sensor.select(rows)

    assert type(part) is type(sensor) and len(part) == len(np.arange(N)[rows])
    np.testing.assert_array_equal(part.residuals(poses[rows], case.own), sensor.residuals(poses, case.own)[:, rows])


def test_shifted_readings_shift_the_residuals(case: Case, rng: np.random.Generator) -> None:
    """Readings that differ by some change give residuals that differ by it (to first order for orientations)."""
    sensor = case.read(SEEN)
    change = 1e-7 * rng.standard_normal((sum(block.size for block in sensor.blocks), N))

    np.testing.assert_allclose(sensor.shifted(change).residuals(SEEN, case.own), change, atol=1e-11)
    twice = sensor.shifted(change).shifted(change).residuals(SEEN, case.own)
    np.testing.assert_allclose(twice, 2.0 * change, atol=1e-11)


def test_displacement_is_how_far_the_target_is_off(case: Case, rng: np.random.Generator) -> None:
    """A target that is a little off its prediction is found off, by as much of it as the readings see."""
    sensor, off = case.read(SEEN), rng.normal(0.0, 1e-6, (N, 3))
    predicted = moved(SEEN, -off, np.zeros((N, 3)))
    found = sensor.displacement(sensor.residuals(predicted, case.own), predicted, case.own)
    if case.kind in ("position", "pose", "socket", "camera_point"):
        np.testing.assert_allclose(found, off, atol=1e-11)
    else:
        # Along the line of sight, or across it: what is found is the part of it that is seen, but for the distortion.
        rest = np.sum(found * (off - found), axis=1) / np.linalg.norm(off, axis=1) ** 2
        np.testing.assert_allclose(rest, 0.0, atol=0.3 if case.kind == "camera_pixel" else 1e-5)
        assert np.all(np.linalg.norm(found, axis=1) > 0.01 * np.linalg.norm(off, axis=1))


def test_orientation_residual_is_the_turn_in_the_instruments_axes(rng: np.random.Generator) -> None:
    """A tool measured turned by phi from its prediction, in the instrument's axes, has the residual phi."""
    poses, phi = random_poses(rng), rng.normal(0.0, 0.5, (N, 3))
    sensor = READING["pose"](moved(poses, np.full(3, 0.01), phi))

    np.testing.assert_allclose(sensor.residuals(poses, OWN)[3:].T, phi, atol=1e-14)
    np.testing.assert_allclose(sensor.residuals(poses, OWN)[:3], 0.01, atol=1e-15)


def test_distance_sees_no_orientation(rng: np.random.Generator) -> None:
    """A distance is the same from any direction; base and tool have no angles for it."""
    poses = random_poses(rng)
    turned = Rotation.random(random_state=1).as_matrix() @ poses

    np.testing.assert_allclose(READING["distance"](turned).residuals(poses, OWN), 0.0, atol=1e-14)
    assert READING["distance"](poses).base_symbols == DistanceSensor.tool_symbols == FRAME_SYMBOLS[:3]


def test_the_table_chooses_the_sensor(rng: np.random.Generator) -> None:
    """A table's columns say which sensor reads it; quaternions x y z w become matrices."""
    poses, q = random_poses(rng), np.zeros((N, 2))
    position, quaternion = poses[:, :, 3], Rotation.from_matrix(poses[:, :, :3]).as_quat()
    tables = {
        "position": measurements_from_arrays("ab", q, position=position),
        "pose": measurements_from_arrays("ab", q, position=position, quaternion=-quaternion),
        "distance": measurements_from_arrays("ab", q, distance=np.linalg.norm(position, axis=1)),
    }
    for kind, table in tables.items():
        sensor = sensor_of(table)
        assert sensor.kind == kind and len(sensor) == N
        np.testing.assert_allclose(sensor.residuals(poses, OWN), 0.0, atol=1e-14)


def test_a_table_that_no_sensor_reads_is_refused() -> None:
    """A table without readings of a target says what is expected."""
    table = measurements_from_arrays("ab", np.zeros((3, 2)), source="poses.csv")
    with pytest.raises(MeasurementError, match=r"poses\.csv: no sensor .*'none'; expected columns x y z"):
        sensor_of(table)


def test_rotation_vectors_undo_rotation_matrices(rng: np.random.Generator) -> None:
    """Quaternions, matrices and vectors of the same rotations agree."""
    turns = Rotation.random(20, random_state=rng)

    np.testing.assert_allclose(rotation_matrices(turns.as_quat()), turns.as_matrix(), atol=1e-15)
    np.testing.assert_allclose(rotation_vectors(turns.as_matrix()), turns.as_rotvec(), atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 9e-4, 1.1e-3, 1.0, 3.14])
def test_turns_from_predicted_to_measured_orientations_are_those_of_scipy(angle: float, rng: np.random.Generator) -> None:
    """Next to none, on both sides of where series begin, and next to half a turn, about any axis."""
    measured, axis = Rotation.random(200, random_state=rng), rng.normal(size=(200, 3))
    turn = angle * axis / np.linalg.norm(axis, axis=1, keepdims=True)
    predicted = (Rotation.from_rotvec(-turn) * measured).as_matrix()
    poses = np.concatenate([predicted, np.zeros((200, 3, 1))], axis=2)
    found = PoseSensor(np.zeros((200, 3)), measured.as_matrix()).residuals(poses, np.zeros(0))
    np.testing.assert_allclose(found[3:].T, turn, atol=1e-14)
