"""Motions that are chosen for an IMU: what they keep to, what they promise, and what a fit of their logs comes to."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from motion_study import GEOMETRY, Truth, calibrated, via_path, vouched

from pincal import Options, Robot
from pincal.design import motion_design
from pincal.design.motion_design import MotionDesign, design_motion
from pincal.design.reach import Limits, Reach
from pincal.errors import BadInputError, PincalWarning
from pincal.simulate.moving import ViaPath

# Between so many poses a choice takes a second; a prime number.
FEW = 11
KEPT = Limits(floor=0.3, box=(-0.9, -0.9, 0.3, 0.9, 0.9, 1.2))


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_urdf("ur5")


@pytest.fixture(scope="module", autouse=True)
def _quick() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(motion_design, "_POSES", FEW)
        yield


@pytest.fixture(scope="module")
def chosen(robot: Robot) -> MotionDesign:
    return design_motion(robot, 40.0, GEOMETRY, speed=0.8, acceleration=2.0, limits=KEPT)


def test_a_path_goes_from_pose_to_pose_and_rests_there() -> None:
    """By a polynomial of degree 5 with the closed-form peaks 15/8 and 10/sqrt(3); derivatives are those of differences."""
    path = ViaPath(np.array([0.0, 2.0, 5.0]), np.array([[0.0], [1.0], [-1.0]]))
    time, h = np.linspace(-0.5, 5.5, 2401), 1e-5

    np.testing.assert_allclose(path.at(path.time), path.q, atol=1e-15)
    np.testing.assert_allclose(path.at(path.time, 1), 0.0, atol=1e-15)
    inner = np.linspace(0.1, 4.9, 50)
    for order in (1, 2):
        slope = (path.at(inner + h, order - 1) - path.at(inner - h, order - 1)) / (2.0 * h)
        np.testing.assert_allclose(path.at(inner, order), slope, atol=1e-8)
    first = time < 2.0
    assert np.abs(path.at(time[first], 1)).max() == pytest.approx(15.0 / 8.0 / 2.0, rel=1e-4)
    assert np.abs(path.at(time[first], 2)).max() == pytest.approx(10.0 / 3.0**0.5 / 4.0, rel=1e-4)
    np.testing.assert_array_equal(path.at(np.array([-1.0, 9.0]))[:, 0], [0.0, -1.0])


def test_a_motion_keeps_to_limits_of_speed_and_to_constraints(chosen: MotionDesign, robot: Robot) -> None:
    """Some joint of each move is as fast as is allowed and none is faster; the arm stays in the box on the way."""
    path = ViaPath(chosen.time, chosen.q)
    time = np.linspace(0.0, chosen.time[-1], 4000)
    peaks = [np.abs(path.at(time, order)).max() for order in (1, 2)]

    assert peaks[0] == pytest.approx(0.8, rel=1e-3) or peaks[1] == pytest.approx(2.0, rel=1e-3)
    assert peaks[0] <= 0.8 + 1e-9 and peaks[1] <= 2.0 + 1e-9
    assert chosen.time[-2] < 40.0 <= chosen.time[-1]
    within = (chosen.q[:-1, None] + np.arange(1, 10)[:, None] / 10.0 * np.diff(chosen.q, axis=0)[:, None]).reshape(-1, 6)
    reach = Reach(robot, limits=KEPT)
    assert reach.allows_apart(np.vstack([chosen.q, within])).all()
    assert not reach.collides(np.vstack([chosen.q, within])).any()


def test_a_chosen_motion_promises_more_than_a_random_one(chosen: MotionDesign) -> None:
    """Beside the poses of an instrument, too; the more of these, the less it brings."""
    assert chosen.error < chosen.random < chosen.before
    alone, both = np.array(list(chosen.needed.values())).T
    assert np.all(both < alone) and np.all(np.diff(both) < 0.0)
    assert both[-1] / alone[-1] > 0.7 > both[3] / alone[3]


@pytest.mark.long
def test_fits_of_its_log_know_more_than_of_a_path_that_was_not_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on 7 of 8 arms and seeds (``motion_study.py chosen --seeds 4 --duration 60``), and as promised but for the noise.

    The promise is of a noise of force and of one of rates; a fit finds others, vibration included, and what it foresees is
    between the promise times the one ratio of noises and times the other.
    """
    monkeypatch.setattr(motion_design, "_POSES", 31)
    truth = Truth.draw("kuka (6R)", 0, duration=60.0, vibration=0.1)
    found = design_motion(truth.robot, 60.0, GEOMETRY)
    driven = replace(truth, session=replace(truth.session, path=via_path(truth, found), duration=float(found.time[-1])))
    fit = calibrated(driven, driven.tables())
    left = vouched(driven, fit)
    noises = fit.solution.sigma / found.noise[:2]

    assert left < 0.95 * vouched(truth)
    assert noises.min() < 0.95 and noises.max() > 1.05
    assert noises.min() < left / (1e3 * found.error) < noises.max()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"duration": 0.0}, "duration 0"),
        ({"speed": -1.0}, "speed -1"),
        ({"acceleration": np.nan}, "acceleration nan"),
        ({"limits": Limits(floor=5.0)}, f"expected {FEW}"),
    ],
)
def test_what_can_not_be_driven_is_refused(robot: Robot, given: dict[str, object], words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        design_motion(robot, **{"duration": 10.0} | given)  # type: ignore[arg-type]


def chosen_once() -> Callable[..., MotionDesign]:
    """Return what chooses a motion when it is first called, and returns the same ever after."""
    found = list[MotionDesign]()

    def choose(*given: object, **more: object) -> MotionDesign:
        if not found:
            found.append(design_motion(*given, **more))  # type: ignore[arg-type]
        return found[0]

    return choose


@pytest.mark.long
def test_the_command_writes_a_motion_that_simulate_drives(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the choice to a calibrated model, in four words each."""
    # The choice is the same each time, and takes most of it.
    monkeypatch.setattr(motion_design, "design_motion", chosen_once())
    out, day = tmp_path / "motion.csv", tmp_path / "day"
    assert run("design", "ur5", "--motion", "20s", "--model", "geometric", "--out", out) == 0
    assert "random:" in capsys.readouterr().out
    assert run("simulate", "ur5", "--path", out, "--imu", "--elastic", "0", "--out", day, "--quiet") == 0
    assert run("calibrate", "ur5", day, "--model", "geometric", "--out", tmp_path / "results", "--quiet") == 0
    result = json.loads((tmp_path / "results" / "result.json").read_text())
    assert result["verdict"] == "not judged", "poses in which it stops are no replicates"

    capsys.readouterr()
    assert run("design", "ur5", "--motion", "20s", "--model", "geometric", "--out", out, "--json") == 0
    assert json.loads(capsys.readouterr().out)["poses"] == len(out.read_text().splitlines()) - 1
    for other in (
        ("--poses", "5"),
        ("--payload", "3"),
        ("--socket", "0.5", "0", "0.2"),
        ("--candidates", "50"),
        ("--type", out),
    ):
        assert run("design", "ur5", "--motion", "20s", *other, "--out", tmp_path / "other.csv") == 2
        assert f"{other[0]} is for poses at rest" in capsys.readouterr().err


@pytest.mark.long
def test_a_motion_that_ends_too_soon_is_told(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between three poses there are six moves, each driven once."""
    monkeypatch.setattr(motion_design, "_POSES", 3)
    with pytest.warns(PincalWarning, match=r"the motion ends after .* s of 900 s, as all moves between"):
        found = design_motion(robot, 900.0, GEOMETRY)
    assert len(found.time) <= 7


def test_a_table_without_times_is_no_motion(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nor one whose times do not begin at zero."""
    robot = Robot.from_urdf("ur5")
    for k, time in enumerate(("", "1")):
        header = ",".join([*(["time"] if time else []), *robot.joint_names])
        row = ",".join([*([time] if time else []), *["0.1"] * 6])
        path = tmp_path / f"{k}.csv"
        path.write_text(f"{header}\n{row}\n{row}\n")
        assert run("simulate", "ur5", "--path", path, "--imu", "--out", tmp_path / "day") == 3
        assert "column time that increases from 0" in capsys.readouterr().err


@pytest.mark.long
def test_noise_of_an_instrument_beside_it_is_none_of_the_imu(robot: Robot) -> None:
    """Positions ten times as exact change what poses promise, and nothing of the motion."""
    rough, fine = (design_motion(robot, 10.0, Options(effects=GEOMETRY.effects, sigma=s)) for s in (5e-5, 5e-6))
    assert rough.error == pytest.approx(fine.error, rel=1e-9) and fine.needed[30][0] < 0.2 * rough.needed[30][0]
