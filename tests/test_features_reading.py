"""FeatureReadings of a part: where points are, and what their errors share."""

from dataclasses import replace
from pathlib import Path

import feature_cases as cases
import numpy as np
import pytest

from pincal import BadInputError
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.position_covariance import PositionCovariance, SharedErrors
from pincal.errors import MeasurementError
from pincal.features.feature_points import LocatedPoints, points_of_sensor
from pincal.features.feature_set import FeatureSet
from pincal.features.features_numbers import FEATURES
from pincal.features.flange_sensor import FlangeSensor
from pincal.features.mounted_sensor import STATED, MountedSensor, Reservations
from pincal.features.probe import contacts_of_centres
from pincal.features.readings import FeatureReadings, read_readings
from pincal.features.triangulation import mapped_errors, points_of_images
from pincal.sensors.lens import Lens

STEP = 1e-6
SPOTS = np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0], [0.0, 0.04, 0.01]])


def located(robot: FittedRobot, readings: FeatureReadings, declared: FlangeSensor | None = None) -> LocatedPoints:
    """Return the points of readings in the instrument's frame."""
    mounted = MountedSensor.of(robot, readings, declared or FlangeSensor())
    return (points_of_images if readings.kind == "pixel" else points_of_sensor)(mounted)


def _moved(at: list[np.ndarray]) -> np.ndarray:
    return np.asarray((at[1] - at[0]) / (2.0 * STEP))


def by_parameters(robot: FittedRobot, readings: FeatureReadings, declared: FlangeSensor | None = None) -> np.ndarray:
    """Return the motion of located points by each parameter of the model, by differences, shape (3K, P)."""
    ends = [
        [located(cases.changed(robot, k, side), readings, declared).place for side in (-STEP, STEP)]
        for k in range(len(robot.values))
    ]
    return np.stack([_moved(pair) for pair in ends], axis=2).reshape(-1, len(robot.values))


@pytest.fixture(scope="module")
def camera() -> FittedRobot:
    """Return a robot that was calibrated with a 3D camera."""
    return cases.robot_with("camera_point")


def images(robot: FittedRobot, rng: np.random.Generator, n: int = 3) -> tuple[np.ndarray, FeatureReadings]:
    """Return three places and their images without noise in n poses, whose cameras look at them from all round."""
    q = cases.poses_near(rng, n)
    places = cases.ahead(robot, q) + SPOTS
    q = cases.towards(robot, q, places[0])
    rows = np.repeat(np.arange(n), 3)
    point = np.tile(["a", "b", "c"], n)
    seen = cases.seen_by(robot, q[rows], np.tile(places, (n, 1)))
    readings = cases.table(q[rows], np.full(3 * n, "rim"), point=point, pixel=cases.LENS.project(seen))
    return places, readings


def test_points_of_a_3d_sensor_are_where_it_saw_them(camera: FittedRobot, rng: np.random.Generator) -> None:
    """A place that the calibrated camera sees is found there, with the covariance of the parameters' motions."""
    q = cases.poses_near(rng, 4)
    places = cases.ahead(camera, q) + rng.normal(0.0, 0.05, (4, 3))
    readings = cases.table(q, ["a", "a", "b", "b"], camera_point=cases.seen_by(camera, q, places))
    found = located(camera, readings)
    np.testing.assert_allclose(found.place, places, atol=1e-12)
    J = by_parameters(camera, readings)
    expected = J @ camera.covariance @ J.T
    np.testing.assert_allclose(found.covariance.sources["parameters"].matrix, expected, atol=1e-16)
    np.testing.assert_allclose(found.covariance.sources["sensor"].matrix, 25e-10 * np.eye(12), atol=1e-20)


def test_a_declared_mount_says_the_same_and_has_its_own_uncertainty(camera: FittedRobot, rng: np.random.Generator) -> None:
    """The calibrated mount, declared, places points where the calibration does; its errors move all points as one body."""
    q = cases.poses_near(rng, 4)
    seen = np.array([0.0, 0.0, 0.4]) + rng.normal(0.0, 0.05, (4, 3))
    readings = cases.table(q, ["a"] * 4, camera_point=seen)
    sigma = np.array([1e-5, 2e-5, 3e-5, 1e-4, 2e-4, 3e-4])
    mount = cases.mount_of(camera)
    declared = FlangeSensor(mount=mount, mount_sigma=sigma, noise=np.array([1e-5, 1e-5, 4e-5]))
    found = located(camera, readings, declared)
    np.testing.assert_allclose(found.place, located(camera, readings).place, atol=1e-12)
    columns = []
    for k in range(6):
        ends = [located(camera, readings, replace(declared, mount=_shifted(mount, k, s))).place for s in (-STEP, STEP)]
        columns.append(sigma[k] * _moved(ends).ravel())
    expected = np.transpose(columns) @ columns
    np.testing.assert_allclose(found.covariance.sources["mount"].matrix, expected, atol=1e-14)
    blocks = found.covariance.sources["sensor"].blocks
    np.testing.assert_allclose(np.linalg.eigvalsh(blocks), np.tile([1e-10, 1e-10, 16e-10], (4, 1)), rtol=1e-9)


def _shifted(mount: np.ndarray, k: int, step: float) -> np.ndarray:
    """Return a mount moved along, or turned about, an axis of the tip."""
    found = mount.copy()
    if k < 3:
        found[k, 3] += step
        return found
    axis = np.eye(3)[k - 3]
    turned = found[:, :3] + step * np.cross(axis, found[:, :3], axisb=0, axisc=0)
    return np.column_stack([turned, found[:, 3]])


@pytest.mark.long
def test_images_intersect_in_their_points(rng: np.random.Generator) -> None:
    """Images without noise give the places; pixel noise, camera and arm move them as differences of all steps say."""
    robot = cases.robot_with("camera_point")
    places, readings = images(robot, rng)
    declared = FlangeSensor(lens=cases.LENS, pixel_noise=0.2)
    found = located(robot, readings, declared)
    np.testing.assert_allclose(found.place, places, atol=1e-9)
    J = by_parameters(robot, readings, declared)
    expected = J @ robot.covariance @ J.T
    np.testing.assert_allclose(found.covariance.sources["parameters"].matrix, expected, atol=1e-15)
    A = []
    for i in range(readings.seen.size):
        ends = []
        for side in (-1e-3, 1e-3):
            seen = readings.seen.copy()
            seen.ravel()[i] += side
            ends.append(located(robot, replace(readings, seen=seen), declared).place.ravel())
        A.append((ends[1] - ends[0]) / 2e-3)
    expected = 0.04 * np.transpose(A) @ A
    np.testing.assert_allclose(found.covariance.sources["sensor"].matrix, expected, rtol=1e-4, atol=1e-14)
    assert found.readings.tolist() == [3, 3, 3]
    assert found.stops[0] == found.stops[2] == frozenset(range(3))


def test_a_camera_that_was_calibrated_moves_with_the_arm(rng: np.random.Generator) -> None:
    """Errors of its parameters and of the arm's are correlated, and their motions add as differences say."""
    bare = cases.robot_with("camera_pixel", sigma=0.1)
    robot = cases.with_camera(bare)
    places, readings = images(bare, rng)
    found = located(robot, readings)
    np.testing.assert_allclose(found.place, places, atol=1e-9)
    J = np.column_stack([by_parameters(bare, readings, FlangeSensor(lens=cases.LENS, pixel_noise=0.1))])
    of_lens = []
    for i in range(9):
        ends = []
        for side in (-1.0, 1.0):
            values = cases.LENS.values
            values[i] += side * (1e-3 if i < 4 else 1e-6)
            lens = FlangeSensor(lens=Lens(*values), pixel_noise=0.1)
            ends.append(located(bare, readings, lens).place.ravel())
        of_lens.append((ends[1] - ends[0]) / (2e-3 if i < 4 else 2e-6))
    whole = np.column_stack([J, np.transpose(of_lens)])
    expected = whole @ robot.covariance @ whole.T
    np.testing.assert_allclose(found.covariance.sources["parameters"].matrix, expected, rtol=1e-5, atol=1e-13)
    assert found.evidence["sensor"].kind == "A"


def test_what_stops_share_moves_every_point_that_they_see(rng: np.random.Generator) -> None:
    """Errors of all and of groups of readings, through maps that mix rows, are what the maps make of their matrix."""
    errors = SharedErrors(rng.normal(size=(6, 3, 2)), rng.normal(size=(6, 3, 2)), np.array([0, 0, 1, 2, 2, 1]))
    maps = rng.normal(size=(2, 3, 6, 3))
    A = maps.reshape(6, 18)
    np.testing.assert_allclose(mapped_errors(errors, maps).matrix, A @ errors.matrix @ A.T, atol=1e-12)


def test_images_that_cannot_tell_the_depth_are_refused(rng: np.random.Generator) -> None:
    """One stop, parallel lines of sight, an unknown camera or noise: each is told with what to do."""
    robot = cases.robot_with("camera_point")
    _, readings = images(robot, rng)
    known = FlangeSensor(lens=cases.LENS, pixel_noise=0.1)
    with pytest.raises(BadInputError, match=r"one stop.*two or more"):
        located(robot, readings.select(np.arange(3)), known)
    with pytest.raises(BadInputError, match=r"\[camera\] fx fy"):
        located(robot, readings, FlangeSensor(pixel_noise=0.1))
    with pytest.raises(BadInputError, match="--sensor-noise"):
        located(robot, readings, FlangeSensor(lens=cases.LENS))
    q = np.repeat(readings.rows.q[:1], 2, axis=0)
    q[1, 0] += 0.3 * FEATURES.parallax
    place = cases.ahead(robot, q, 0.5)
    seen = cases.LENS.project(cases.seen_by(robot, q, np.tile(place, (2, 1))))
    with pytest.raises(BadInputError, match="lines of sight are within"):
        located(robot, cases.table(q, ["a", "a"], pixel=seen), known)


def test_a_sensor_that_the_model_has_not_is_refused(camera: FittedRobot, rng: np.random.Generator) -> None:
    """A tracker's calibration knows no camera, and a camera's no probe, unless a mount is declared."""
    q = cases.poses_near(rng, 3)
    seen = cases.table(q, ["a"] * 3, camera_point=np.tile([0.0, 0.0, 0.4], (3, 1)))
    with pytest.raises(BadInputError, match=r"calibrated with position.*\[mount\]"):
        located(cases.robot_with("position"), seen)
    with pytest.raises(BadInputError, match=r"contacts.*camera_point.*\[mount\]"):
        located(camera, cases.table(q, ["a"] * 3))


def test_contacts_are_the_target_and_ranges_lie_on_its_axis(rng: np.random.Generator) -> None:
    """A probe's tip is the calibrated target itself; a range is a place on the z axis of what reads it."""
    robot = cases.robot_with("position")
    q = cases.poses_near(rng, 3)
    found = located(robot, cases.table(q, ["a"] * 3))
    np.testing.assert_allclose(found.place, robot.predict(q)[:, :, 3], atol=1e-12)
    assert set(found.covariance.sources) == {"parameters"}
    along = FlangeSensor(mount=np.eye(3, 4), noise=np.full(3, 1e-5))
    ranges = located(robot, cases.table(q, ["a"] * 3, distance=np.array([0.1, 0.2, 0.3])), along)
    tips = robot.between().predict(q)
    apart = np.linalg.norm(ranges.place - ranges.sensor, axis=1)
    np.testing.assert_allclose(apart, [0.1, 0.2, 0.3], rtol=1e-12)
    blocks = ranges.covariance.sources["sensor"].blocks
    np.testing.assert_allclose(np.linalg.eigvalsh(blocks), np.tile([0.0, 0.0, 1e-10], (3, 1)), atol=1e-20)
    assert tips.shape == (3, 3, 4)


def test_rows_of_a_stop_share_the_arrival(rng: np.random.Generator) -> None:
    """Equal poses one after the other are one stop, unless the column stop divides them; returns are passes."""
    q = np.repeat(cases.poses_near(rng, 2), 2, axis=0)
    assert cases.table(q, ["a"] * 4).stop.tolist() == [0, 0, 1, 1]
    assert cases.table(q, ["a"] * 4, stop=np.array(list("1234"))).stop.tolist() == [0, 1, 2, 3]
    twice = cases.table(np.vstack([q, q]), ["a", "a", "b", "b"] * 2)
    assert twice.passes.tolist() == [0] * 4 + [1] * 4
    other = cases.table(np.vstack([q, q]), ["a", "a", "b", "b", "c", "c", "d", "d"])
    assert other.passes.tolist() == [0] * 8
    named = cases.table(np.vstack([q, q]), ["a"] * 8, pass_name=np.array(["mo"] * 4 + ["tu"] * 4))
    assert named.passes.tolist() == [0] * 4 + [1] * 4


def test_tables_are_read_with_their_units(tmp_path: Path) -> None:
    """Joints in degrees and points in millimetres, with the feature of each row."""
    head = ",".join(f"{name} [deg]" for name in cases.ROBOT.joint_names)
    row = "10,-60,80,-40,-70,20"
    path = tmp_path / "readings.csv"
    path.write_text(f"{head},feature,cx [mm],cy [mm],cz [mm]\n{row},hole,1,2,300\n{row},hole,1,3,300\n")
    found = read_readings(path, cases.ROBOT)
    assert found.kind == "camera_point" and found.feature.tolist() == ["hole", "hole"]
    np.testing.assert_allclose(found.seen[0], [1e-3, 2e-3, 0.3], rtol=1e-12)
    np.testing.assert_allclose(found.rows.q[0, 0], np.deg2rad(10.0), rtol=1e-12)


@pytest.mark.parametrize(
    ("columns", "cells", "words"),
    [
        ("cx,cy,cz", "0,0,0.3", "no column feature"),
        ("feature,cx,cy,cz,u,v", "a,0,0,0.3,10,10", "several kinds"),
        ("feature,pass,run", "a,1,1", "columns pass and run"),
        ("feature,cx,cy,cz", "a,0,0,-0.3", "behind the sensor"),
        ("feature,cx,cy", "a,0,0", "without cz"),
        ("feature,range", "a,-0.1", "a range of 0 or less"),
        ("feature,range", "a,350", r"looks like millimetres; expected at most 20 m: write `range \[mm\]`"),
        ("feature,cx,cy,cz", "a,10,-20,380", r"cz has a median of 380 m.*write `cz \[mm\]`"),
    ],
)
def test_tables_that_cannot_be_right_are_refused(tmp_path: Path, columns: str, cells: str, words: str) -> None:
    """Each names what is wrong with the table."""
    path = tmp_path / "readings.csv"
    names = ",".join(cases.ROBOT.joint_names)
    rows = f"0.1,-1,1.4,-0.8,-1.3,0.4,{cells}\n" * 2
    path.write_text(f"{names},{columns}\n{rows}")
    with pytest.raises(MeasurementError, match=words):
        read_readings(path, cases.ROBOT)


SENSOR = """
[mount]
position_mm = [10, 20, 150]
rotation_deg = [0, 0, 90]
u_position_mm = 0.02
u_rotation_mrad = [0.1, 0.1, 0.2]
[camera]
fx = 1500
fy = 1480
u0 = 640
v0 = 512
k1 = -0.05
[noise]
position_mm = [0.02, 0.02, 0.05]
pixel_px = 0.1
[probe]
radius_mm = 1.5
"""


def test_a_sensor_file_is_read(tmp_path: Path) -> None:
    """Every key, in its unit."""
    path = tmp_path / "sensor.toml"
    path.write_text(SENSOR)
    found = FlangeSensor.from_toml(path)
    np.testing.assert_allclose(found.mount, [[0, -1, 0, 0.01], [1, 0, 0, 0.02], [0, 0, 1, 0.15]], atol=1e-15)
    np.testing.assert_allclose(found.mount_sigma, [2e-5, 2e-5, 2e-5, 1e-4, 1e-4, 2e-4])
    assert (found.lens.fx, found.lens.k1, found.pixel_noise, found.radius) == (1500.0, -0.05, 0.1, 1.5e-3)
    np.testing.assert_allclose(found.noise, [2e-5, 2e-5, 5e-5])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[probe]", "[prob]", r"unknown table \[prob\].*probe"),
        ("position_mm = [10, 20, 150]", "place = [10, 20, 150]", r"\[mount\]: unknown key 'place'"),
        ("position_mm = [10, 20, 150]", "position_mm = [10, 20]", "expected 3 numbers"),
        ("rotation_deg = [0, 0, 90]", "", "no rotation_deg.*three numbers"),
        ("radius_mm = 1.5", "radius_mm = -1.5", "a number of 0 or more"),
        ("u_position_mm = 0.02", "u_position_mm = -0.02", "numbers of 0 or more"),
        (SENSOR, "probe = 3", r"probe = 3; expected a table \[probe\]"),
        ("radius_mm = 1.5", "radius_mm = 1.5\nradius_um = 1500", "twice"),
        ("fx = 1500", "", "no fx; expected fx fy u0 v0"),
        ("fx = 1500", "fx = -1500", "a focal length of more than 0"),
        ("k1 = -0.05", "k9 = 1", "unknown key 'k9'"),
        ("[mount]", "[mount", "can't be read"),
    ],
)
def test_a_sensor_file_that_makes_no_sense_is_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    """Each fault is named with its key and what was expected."""
    path = tmp_path / "sensor.toml"
    path.write_text(SENSOR.replace(old, new, 1))
    with pytest.raises(BadInputError, match=words):
        FlangeSensor.from_toml(path)


def touched(places: np.ndarray, feature: str = "a") -> LocatedPoints:
    """Return centres of a ball, touched by an arm 1 m above them, whose readings have noise alone."""
    n = len(places)
    noise = SharedErrors.of_each(np.tile(1e-10 * np.eye(3), (n, 1, 1)))
    return LocatedPoints(
        feature=np.full(n, feature),
        place=places,
        covariance=PositionCovariance({"sensor": noise}),
        evidence={"sensor": STATED},
        passes=np.zeros(n, int),
        sensor=places + np.array([0.0, 0.0, 1.0]),
        readings=np.ones(n, int),
        stops=tuple(frozenset({i}) for i in range(n)),
    )


CIRCLE = np.array([[np.cos(a), np.sin(a), 0.0] for a in np.linspace(0.0, 5.5, 8)])
BALL = FlangeSensor(radius=2e-3, radius_sigma=1e-6)


@pytest.mark.parametrize(("nominal", "expected"), [(0.0105, 0.012), (0.0075, 0.008)])
def test_a_ball_in_a_bore_and_around_a_boss(nominal: float, expected: float) -> None:
    """Centres on a circle of 10 mm are of a bore of 12 or of a boss of 8, and the ball's radius goes into it whole."""
    centres = touched(0.01 * CIRCLE)
    fitted = FeatureSet.fit({"a": "circle"}, centres.feature, centres.place, centres.covariance.matrix)
    found = contacts_of_centres(centres, fitted, {"a": nominal}, BALL)
    np.testing.assert_allclose(np.linalg.norm(found.place, axis=1), expected, rtol=1e-9)
    again = FeatureSet.fit({"a": "circle"}, found.feature, found.place, found.covariance.matrix)
    by_ball = found.covariance.sources["probe"].through(again.sensitivity)
    np.testing.assert_allclose(np.sqrt(by_ball[6, 6]), 1e-6, rtol=1e-6)
    np.testing.assert_allclose(by_ball[0, 0], 0.0, atol=1e-18)


def test_a_ball_on_a_plane_is_above_it() -> None:
    """The side of the arm is outside; without a ball nothing moves, and points and lines have no side."""
    places = 0.1 * CIRCLE[:, [1, 0, 2]] + np.array([0.0, 0.0, 0.002])
    centres = touched(places)
    fitted = FeatureSet.fit({"a": "plane"}, centres.feature, centres.place, centres.covariance.matrix)
    found = contacts_of_centres(centres, fitted, {}, BALL)
    np.testing.assert_allclose(found.place[:, 2], 0.0, atol=1e-12)
    assert contacts_of_centres(centres, fitted, {}, FlangeSensor()) is centres
    round_one = FeatureSet.fit({"a": "circle"}, centres.feature, centres.place, centres.covariance.matrix)
    with pytest.raises(BadInputError, match="tells a bore from a boss"):
        contacts_of_centres(centres, round_one, {}, BALL)
    straight = touched(np.linspace([0.0, 0.0, 0.0], [0.1, 0.0, 0.0], 4))
    line = FeatureSet.fit({"a": "line"}, straight.feature, straight.place, straight.covariance.matrix)
    with pytest.raises(BadInputError, match=r"\(line\).*no normal"):
        contacts_of_centres(straight, line, {}, BALL)


def test_scale_and_drift_move_all_readings_together(camera: FittedRobot, rng: np.random.Generator) -> None:
    """A scale stretches distances as it says; a drift has the stated size, and near readings share it."""
    q = cases.poses_near(rng, 6)
    q[1] = q[0] + 1e-3
    readings = cases.table(q, ["a"] * 6, camera_point=np.tile([0.0, 0.0, 0.4], (6, 1)))
    since = Reservations(scale=1e-5, drift=5e-5)
    found = points_of_sensor(MountedSensor.of(camera, readings, FlangeSensor(), "base", since))
    apart = found.place[3] - found.place[5]
    A = np.zeros((1, 18))
    A[0, 9:12] = apart / np.linalg.norm(apart)
    A[0, 15:18] = -A[0, 9:12]
    by_scale = found.covariance.sources["scale"].through(A)
    np.testing.assert_allclose(np.sqrt(by_scale[0, 0]), 1e-5 * np.linalg.norm(apart), rtol=1e-9)
    drift = found.covariance.sources["drift"]
    np.testing.assert_allclose(np.mean(np.einsum("naa->na", drift.blocks)), 25e-10, rtol=1e-9)
    A = np.zeros((3, 18))
    A[:, :3] = np.eye(3)
    A[:, 3:6] = -np.eye(3)
    assert np.trace(drift.through(A)) < 1e-4 * np.trace(drift.blocks[0])
