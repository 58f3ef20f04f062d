"""A sensor from outside the package goes through every verb by the command line, and gives what was simulated."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.cli import pincal as pincal_command
from pincal.errors import MeasurementError, ModelFileError
from pincal.measure.table import write_table
from pincal.plugins import load_plugin
from pincal.sensors.fields import TableRows
from pincal.sensors.registry import SENSORS

PLUGIN = Path(__file__).parents[1] / "examples" / "line_laser.py"
# Where the laser sits on the tool [m], and the plane z = offset + slope_x x + slope_y y in the robot's base frame.
LASER = np.array([0.08, -0.05, 0.12])
PLANE = np.array([-0.4, 0.07, -0.04])
NOISE = 2e-5
POSES = 200


@dataclass(frozen=True)
class Scene:
    """Files of a simulated robot with small geometric errors and a laser, and the true tips of some further poses."""

    folder: Path
    tips: np.ndarray

    def run(self, *arguments: str) -> None:
        """Run a command in this folder with the plugin; raises as the command does."""
        code = pincal_command.main(args=[*arguments, "--plugin", str(PLUGIN)], standalone_mode=False)
        assert not code, arguments

    def read(self, name: str) -> dict[str, object]:
        """Return a JSON file of this folder."""
        return dict(json.loads((self.folder / name).read_text()))


def ranges(tips: np.ndarray) -> np.ndarray:
    """Return the distances from the laser to the plane along the beam by elementary geometry, shape (N,) [m]."""
    start = np.array([tip[:3, 3] + tip[:3, :3] @ LASER for tip in tips])
    beam = np.array([tip[:3, 2] for tip in tips])
    normal = np.array([-PLANE[1], -PLANE[2], 1.0])
    foot = np.array([0.0, 0.0, PLANE[0]])
    return np.array([normal @ (foot - p) / (normal @ d) for p, d in zip(start, beam, strict=True)])


@pytest.fixture
def known_sensors() -> Iterator[None]:
    """Forget the plugin again afterwards."""
    before = dict(SENSORS._classes)
    yield
    SENSORS._classes.clear()
    SENSORS._classes.update(before)
    sys.modules.pop("line_laser", None)


@pytest.fixture
def scene(tmp_path: Path, known_sensors: None, monkeypatch: pytest.MonkeyPatch) -> Scene:
    """Write a robot, a table to fit, one to validate, and poses to predict."""
    monkeypatch.chdir(tmp_path)
    perfect = sim.TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0")
    machine = perfect.draw_errors(np.random.default_rng(3), sigma_length=3e-4, sigma_angle=3e-4, sigma_offset=3e-4)
    rng = np.random.default_rng(4)
    q = sim.plan_poses(machine.arm, 40 * POSES, rng)
    tips = machine.tip(q)
    read = ranges(tips)
    # The beam has to hit the plane not too far away and not too flat.
    seen = (read > 0.05) & (read < 1.5) & (tips[:, 2, 2] < -0.5)
    q, tips, read = q[seen][: 2 * POSES], tips[seen][: 2 * POSES], read[seen][: 2 * POSES]
    assert len(q) == 2 * POSES
    (tmp_path / "robot.urdf").write_bytes(kuka_urdf_path().read_bytes())
    noisy = read + NOISE * rng.standard_normal(len(read))
    for name, rows in (("fit.csv", slice(0, POSES)), ("new.csv", slice(POSES, None))):
        joints = dict(zip(machine.names, q[rows].T, strict=True))
        write_table(tmp_path / name, joints | {"range [mm]": 1e3 * noisy[rows]})
    return Scene(tmp_path, tips[POSES:])


@pytest.mark.long
def test_a_laser_goes_through_every_verb(scene: Scene, capsys: pytest.CaptureFixture[str]) -> None:
    """Checked, calibrated, validated, predicted with, discovered with, drawn and reported; the truth comes out."""
    scene.run("check", "robot.urdf", "fit.csv", "--model", "geometric")
    said = capsys.readouterr().out
    assert "range" in said and "do not determine the position of the base" in said
    scene.run("calibrate", "robot.urdf", "fit.csv", "--out", "out", "--model", "geometric", "--split", "random", "--view")
    result = scene.read("out/result.json")
    found = {entry["name"]: entry for entry in result["parameters"]}  # type: ignore[attr-defined]
    for name, truth in zip(("plane.offset", "plane.slope_x", "plane.slope_y"), PLANE, strict=True):
        assert abs(found[name]["value"] - truth) < 2e-3
    assert found["tool.z"]["status"] != "unidentifiable"
    assert result["error"]["calibrated"]["test"]["rms_mm"] < 1.3e3 * NOISE  # type: ignore[index]
    assert result["error"]["nominal"]["test"]["rms_mm"] > 5e3 * NOISE  # type: ignore[index]
    assert "range" in (scene.folder / "out" / "report.html").read_text()
    scene.run("validate", "out/model.json", "new.csv", "--max-error", "0.05mm")
    scene.run("predict", "out/model.json", "new.csv", "--out", "predicted.csv")
    header = (scene.folder / "predicted.csv").read_text().splitlines()[0].split(",")
    assert {"x", "qx", "sigma_x"} <= set(header)
    scene.run("view", "out/model.json", "new.csv", "--html", "view.html")
    assert (scene.folder / "view.html").stat().st_size > 10_000


@pytest.mark.long
def test_predicted_tips_read_as_the_laser_does(scene: Scene) -> None:
    """The calibrated model, its laser and its plane give the ranges that the true robot would read, to the noise."""
    scene.run("calibrate", "robot.urdf", "fit.csv", "--out", "out", "--model", "geometric")
    scene.run("validate", "out/model.json", "new.csv", "--max-error", "0.03mm")


@pytest.mark.long
def test_a_laser_is_good_for_discovery(scene: Scene) -> None:
    """Discovery names nothing in sound data, whatever the sensor."""
    scene.run("discover", "robot.urdf", "fit.csv", "--stability", "0", "--out", "found", "--noise", "0.02mm")
    assert scene.read("found/discovery.json")["effects"] == []


@pytest.mark.long
def test_without_the_plugin_the_message_names_it(scene: Scene) -> None:
    """A table and a model of an unknown sensor are refused; the model says which module to name."""
    scene.run("calibrate", "robot.urdf", "fit.csv", "--out", "out", "--model", "geometric")
    SENSORS._classes.pop("range")
    for arguments, error, message in (
        (["check", "robot.urdf", "fit.csv"], MeasurementError, 'unknown column "range \\[mm\\]"'),
        (["validate", "out/model.json", "new.csv"], ModelFileError, "sensor 'range'.*--plugin line_laser"),
    ):
        with pytest.raises(error, match=message):
            pincal_command.main(args=arguments, standalone_mode=False)


def test_a_sensor_does_not_take_the_columns_of_another(known_sensors: None) -> None:
    """A plugin whose column means something else already is refused when it registers."""
    laser = load_plugin(str(PLUGIN)).LineLaser
    clash = type("Clash", (laser,), {"fields": (type(laser.fields[0])("height", ("z",), "length"),)})
    with pytest.raises(TypeError, match="the columns z are known as 'position'"):
        SENSORS.register(clash)


def test_the_old_name_of_what_a_sensor_reads() -> None:
    """Sensors from outside that were written for 0.1.0 still find the type of a table, with a warning."""
    with pytest.warns(DeprecationWarning, match="TableRows"):
        from pincal.sensors.fields import Table

    assert Table is TableRows


def test_modules_that_moved_work_where_they_were() -> None:
    """A plugin written before the sensors got a room of their own still loads, with a warning."""
    for name, there in (("sensor.Sensor", "sensors.sensor"), ("fields.Schema", "measure.table_schema")):
        module, _, attribute = name.partition(".")
        with pytest.warns(DeprecationWarning, match=f"is now pincal.{there}"):
            found = getattr(importlib.import_module(f"pincal.measure.{module}"), attribute)
        assert found is getattr(importlib.import_module(f"pincal.{there}"), attribute)
