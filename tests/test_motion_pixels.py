"""Cameras that run along: images of an arm in motion on a clock of their own, from the hand and from the cell."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run

import pincal
from pincal.builtin import kuka_urdf_path
from pincal.errors import Exit, MeasurementError, PincalWarning
from pincal.identify.calibrate import doubts_of_known, fit_tables
from pincal.io.camera_file import read_camera
from pincal.measure.points_table import read_points
from pincal.motion.clocks import Clock
from pincal.motion.joint_path import JointPath
from pincal.motion.reading_starts import start_readings
from pincal.motion.sessions import Session, Stream
from pincal.motion.stamps import in_order
from pincal.motion.stations import MovingArm, session_tables
from pincal.sensors.registry import sensor_class
from pincal.sensors.setup import Setup
from pincal.simulate.moving import ViaPath

URDF = str(kuka_urdf_path())
ROBOT = pincal.Robot.from_urdf(kuka_urdf_path())
NOISE = 0.3


def driven(folder: Path, *, seconds: int = 60, sensor: str = "camera_pixel", given: tuple[str, ...] = ()) -> Session:
    """Return a session before a camera, whose truth, points and parameters stand beside the folder."""
    beside = ["--camera-out", f"{folder}.camera.json", "--truth", f"{folder}.json"]
    beside += ["--object", "grid", "--points-out", f"{folder}.points.csv"] if sensor == "camera_pixel" else []
    wanted = ["--path", f"{seconds}s", "--sensor", sensor, "--noise", f"{NOISE}px", "--log-rates", "100,100,10"]
    wanted += ["--clock-drift", "1000", "--seed", "1", "--elastic", "0", "--quiet", *given]
    assert run("simulate", URDF, *wanted, *beside, "--out", folder) == 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PincalWarning)
        return pincal.read_session(ROBOT, folder)


@pytest.fixture(scope="module")
def hand(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Session]:
    """Return the folder of a session with a camera in the hand, and the session with five of the points."""
    folder = tmp_path_factory.mktemp("pixels") / "hand"
    session = driven(folder)
    assert session.tracker is not None
    kept = np.isin(session.tracker.readings["point"], ["p_1_1", "p_1_9", "p_4_5", "p_7_1", "p_7_9"])
    return folder, replace(session, tracker=session.tracker.select(kept))


@pytest.fixture(scope="module")
def arm(hand: tuple[Path, Session]) -> MovingArm:
    joints = hand[1].joints
    return MovingArm(ROBOT, JointPath.through(joints.time, joints.readings["q"]))


def clock_of(arm: MovingArm, stream: Stream) -> Clock:
    """Return the clock of images."""
    sensor = sensor_class(stream.readings)
    assert sensor is not None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PincalWarning)
        return start_readings(arm, stream, sensor)


def started(arm: MovingArm, stream: Stream) -> tuple[float, float]:
    """Return by how much the clock is off at the middle [s], from the stamp itself, and its drift."""
    clock = clock_of(arm, stream)
    return float(clock.to_joints(np.array(30.0)) - 30.0), clock.drift


def seen_of(session: Session) -> Stream:
    assert session.tracker is not None
    return session.tracker


@pytest.mark.long
def test_a_clock_is_found_by_images(hand: tuple[Path, Session], arm: MovingArm) -> None:
    """To some milliseconds by the nominal arm, though one image in fifty has the name of another point."""
    stream = seen_of(hand[1])
    true = json.loads(Path(f"{hand[0]}.json").read_text())["clocks"]["tracker"]
    names, rng = stream.readings["point"].copy(), np.random.default_rng(0)
    wrong = rng.random(len(names)) < 0.02
    names[wrong] = rng.choice(np.unique(names), wrong.sum())
    offset, drift = started(arm, replace(stream, readings={**stream.readings, "point": names}))

    assert offset == pytest.approx(true["offset"], abs=5e-3) and drift == pytest.approx(1e-3, abs=4e-4)


@pytest.mark.long
def test_a_frame_that_is_not_counted_is_found(hand: tuple[Path, Session], arm: MovingArm) -> None:
    """Before any fit, at the first image after it, as a step of the clock."""
    stream = seen_of(hand[1])
    late = stream.time >= 30.0
    slipped = replace(stream, time=stream.time - 0.1 * late).select(np.abs(stream.time - 30.0) > 0.05)
    ((at, size),) = clock_of(arm, slipped).steps
    assert at == pytest.approx(30.0, abs=1.0) and size == pytest.approx(0.1, abs=5e-3)


Corrupt = Callable[[Stream], dict[str, np.ndarray]]
BAD: dict[str, tuple[Corrupt, str]] = {
    "axes swapped": (
        lambda s: {"pixel": s.readings["pixel"][:, ::-1]},
        "images are mirrored relative to the arm.*swap two of u v",
    ),
    "another motion": (lambda s: {"pixel": s.readings["pixel"][::-1]}, "images do not follow these joints"),
}


@pytest.mark.long
@pytest.mark.parametrize("fault", BAD)
def test_images_that_do_not_fit_the_motion_are_refused(hand: tuple[Path, Session], arm: MovingArm, fault: str) -> None:
    """With what is wrong, and what to do."""
    corrupt, said = BAD[fault]
    stream = seen_of(hand[1])
    with pytest.raises(MeasurementError, match=said):
        started(arm, replace(stream, readings={**stream.readings, **corrupt(stream)}))


@pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
def test_points_of_one_image_share_a_stamp(hand: tuple[Path, Session]) -> None:
    """Several points of one stamp are an image, the same point twice is a packet; an image every half second will do."""
    stream = seen_of(hand[1])
    assert np.mean(np.diff(stream.time) == 0.0) > 0.5 and stream.rate == pytest.approx(10.0, rel=0.01)
    one = stream.select(stream.readings["point"] == "p_4_5")
    slow = one.select(np.arange(0, len(one), 4))
    assert len(in_order(slow)) == len(slow)
    with pytest.raises(MeasurementError, match="stamps are those of packets"):
        in_order(replace(one, time=np.repeat(slow.time, 2)[: len(one)]).select(np.arange(min(len(one), 2 * len(slow)))))
    with pytest.raises(MeasurementError, match=r"a row every 400 s.*looks like .ms."):
        in_order(replace(slow, time=1e3 * slow.time))


def test_what_is_held_is_no_stream(hand: tuple[Path, Session]) -> None:
    """A socket holds the tool point while the arm stands; what to give instead is said."""
    stream = seen_of(hand[1])
    held = Stream("held.csv", stream.time, {"socket": np.full(len(stream), "a")}, {})
    with pytest.raises(MeasurementError, match=r"held.csv: socket in motion; expected .* a separate table"):
        session_tables(ROBOT, [replace(hand[1], tracker=held)])


def test_a_path_through_poses_is_as_fast_as_it_may_be() -> None:
    """The nearest pose comes next; speed and acceleration of the fastest joint are those that are allowed, or less."""
    q = np.array([[0.0, 0.0], [2.0, 0.1], [0.5, 0.0], [0.6, 0.05]])
    path = ViaPath.through(q, 1.0)
    time = np.linspace(0.0, path.time[-1], 20_001)
    np.testing.assert_array_equal(path.q[:, 0], [0.0, 0.5, 0.6, 2.0])
    fastest, hardest = (np.abs(path.at(time, order)).max() for order in (1, 2))
    assert fastest == pytest.approx(1.0, rel=1e-3) and hardest <= 3.0 * 1.001
    assert ViaPath.through(q, 60.0).time[-1] == pytest.approx(60.0)


def calibrated(folder: Path, session: Session) -> pincal.FittedRobot:
    """Check that nothing but the noise is left and that the clock is within its interval; return the fit."""
    points = Path(f"{folder}.points.csv")
    setup = Setup(points=read_points(points) if points.exists() else {}, lens=read_camera(f"{folder}.camera.json").lens())
    (table,) = session_tables(ROBOT, [session]).values()
    fit = pincal.calibrate(ROBOT, table, pincal.Options(effects=pincal.GEOMETRIC, setup=setup))
    true = json.loads(Path(f"{folder}.json").read_text())["clocks"]["tracker"]
    assert table.moving is not None
    known = dict(zip(fit.estimate.names, zip(fit.values, fit.estimate.sigma, strict=True), strict=True))
    (offset, sigma), (drift, of_drift) = known["clock.offset"], known["clock.drift"]
    start, middle = table.moving.clock[0], table.moving.middle
    assert fit.solution.sigma[0] == pytest.approx(NOISE, rel=0.03)
    assert abs(start + offset - true["offset"] - true["drift"] * (middle - true["middle"])) < 4.0 * sigma < 2e-4
    assert abs(table.moving.clock[1] + drift - true["drift"]) < 4.0 * of_drift < 2e-5
    return fit


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
def test_a_camera_in_the_hand_is_read_in_motion(hand: tuple[Path, Session]) -> None:
    """The fit ends at the noise of the images, and the clock, 1000 ppm off, is within its interval."""
    calibrated(*hand)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
def test_errors_of_the_path_are_not_laid_on_the_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Points of an image share them, so that many rows contradict no camera; one that is off by 0.1 % they do."""
    monkeypatch.setattr("test_motion_pixels.NOISE", 0.02)
    folder = tmp_path / "exact"
    (table,) = session_tables(ROBOT, [driven(folder, seconds=30)]).values()
    points, lens = read_points(Path(f"{folder}.points.csv")), read_camera(f"{folder}.camera.json").lens()
    for given, said in ((lens, ()), (replace(lens, fx=1.001 * lens.fx, fy=1.001 * lens.fy), ("the images contradict",))):
        options = pincal.Options(effects=pincal.GEOMETRIC, setup=Setup(points=points, lens=given))
        fit = fit_tables(ROBOT, table, options)
        assert fit.solution.widened > 2.0
        assert tuple(doubt[: len("the images contradict")] for doubt in doubts_of_known(fit)) == said


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
def test_a_camera_in_the_cell_is_read_in_motion(tmp_path: Path) -> None:
    """So it is for two targets on the tool before a fixed camera."""
    folder = tmp_path / "cell"
    calibrated(folder, driven(folder, sensor="fixed_camera_pixel", given=("--targets", "2")))


@pytest.mark.long
@pytest.mark.usefixtures("here")
def test_images_go_through_the_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Beside an IMU and held tracker poses; another session validates the model."""
    folder, held = tmp_path / "monday", tmp_path / "eight.csv"
    driven(folder, seconds=30, given=("--imu",))
    assert run("simulate", URDF, "--poses", "8", "--elastic", "0", "--seed", "1", "--out", held, "--quiet") == 0
    known = ["--points", f"{folder}.points.csv", "--camera", f"{folder}.camera.json", "--model", "geometric", "--quiet"]
    assert run("calibrate", URDF, held, folder, *known, "--out", tmp_path / "out") == 0
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert [station["kind"] for station in result["stations"]] == ["position", "imu", "camera_pixel"]
    driven(tmp_path / "tuesday", seconds=30, given=("--pose-seed", "5"))
    capsys.readouterr()
    assert run("validate", tmp_path / "out" / "model.json", tmp_path / "tuesday", "--quiet") == Exit.DONE
    assert re.search(r"calibrated +held out +px +0\.3[5-9]", capsys.readouterr().out)
