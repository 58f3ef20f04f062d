"""The schemas that come with the package are those of the structures, and of all files that pincal writes."""

import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import jsonschema
import msgspec
import numpy as np
import pytest

import pincal
from pincal.builtin import kuka_urdf_path
from pincal.calibration.result import ResultFile
from pincal.discover.discovery_file import Findings
from pincal.io.camera_file import CameraFile
from pincal.model.effects import GEOMETRIC
from pincal.schemas import names, schema_of, shipped, text_of
from pincal.simulate import Instrument, TrueMachine, plan_poses

DATA = Path(__file__).parent / "data"


@pytest.mark.parametrize("name", names())
def test_shipped_schemas_are_those_of_the_structures(name: str) -> None:
    """Else write them anew: python -m pincal.schemas."""
    assert shipped(name).read_text() == text_of(name)
    jsonschema.Draft202012Validator.check_schema(schema_of(name))


def valid(name: str, contents: Any) -> None:
    """Refuse contents that the shipped schema of a file refuses."""
    jsonschema.validate(contents, json.loads(shipped(name).read_text()))


@pytest.fixture(scope="module")
def table() -> pincal.Measurements:
    """Return positions of the KUKA in 60 poses, twenty of them measured twice."""
    rng = np.random.default_rng(3)
    machine = TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0").draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3)
    q = plan_poses(machine.nominal, 60, rng)
    q = np.vstack([q, q[:20]])
    columns = Instrument(targets=(0.1, 0.0, 0.2), sigma=5e-5).measure(machine, q, rng=rng)
    position = np.column_stack([columns[axis] for axis in "xyz"])
    robot = pincal.Robot.from_urdf(kuka_urdf_path())
    return pincal.measurements_from_arrays(robot.joint_names, q, position=position)


def test_what_a_calibration_writes_is_valid(table: pincal.Measurements, tmp_path: Path) -> None:
    """Model and result, with the statistics of replicates; the structures read the result, too."""
    robot = pincal.Robot.from_urdf(kuka_urdf_path())
    run = pincal.run_calibration(robot, table, pincal.Options(effects=GEOMETRIC, sigma=5e-5))
    run.fit.save(tmp_path / "model.json")
    contents = json.loads(json.dumps(run.result.to_dict(), allow_nan=False))

    valid("model", json.loads((tmp_path / "model.json").read_text()))
    assert contents["iso9283"] is not None and contents["lack_of_fit"] is not None
    valid("result", contents)
    found = msgspec.convert(contents, ResultFile)
    assert json.loads(msgspec.json.encode(found)) == contents
    with pytest.raises(jsonschema.ValidationError):
        valid("result", contents | {"rank": "many"})


def test_what_a_discovery_writes_is_valid(table: pincal.Measurements) -> None:
    """Of a robot that errs in no other way than its geometry."""
    robot = pincal.Robot.from_urdf(kuka_urdf_path())
    found = pincal.run_discovery(robot, table, pincal.Options(effects=GEOMETRIC, sigma=5e-5))
    contents = json.loads(json.dumps(found.report, allow_nan=False))

    valid("discovery", contents)
    assert json.loads(msgspec.json.encode(msgspec.convert(contents, Findings))) == contents


@pytest.mark.parametrize("name", ["0_1_0_tracker", "0_1_0_contacts", "0_1_0_camera", "0_1_0_discovered", "2_stations"])
def test_files_of_earlier_versions_are_saved_as_of_this_one(name: str, tmp_path: Path) -> None:
    """Read and written again they are valid."""
    pincal.load_model(DATA / f"model_{name}.json").save(tmp_path / "model.json")
    contents = json.loads((tmp_path / "model.json").read_text())

    assert contents["format_version"] == 3
    valid("model", contents)


def test_a_camera_that_was_found_is_valid() -> None:
    """As the model tells it, and as the file reads it."""
    camera = pincal.load_model(DATA / "model_0_1_0_camera.json").camera()

    valid("camera", camera)
    assert {"fx", "T_tip_camera"} <= {field.name for field in fields(CameraFile)} & camera.keys()
    with pytest.raises(jsonschema.ValidationError):
        valid("camera", camera | {"fx": "wide"})
