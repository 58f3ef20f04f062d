"""The library as a user meets it in a Python session or a notebook."""

from __future__ import annotations

import importlib
import inspect
import pickle
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import meshcat
import numpy as np
import pinocchio as pin
import pytest
from pinocchio.visualize import MeshcatVisualizer

import pincal
from pincal.export.exported import Exported
from pincal.sensors.registry import known_fields
from pincal.simulate import TrueMachine, plan_poses
from pincal.viewer import deviation_fields


@pytest.fixture(scope="module")
def table() -> pincal.Measurements:
    """Return exact positions of a target on a UR10 whose elbow is off by 2 mrad."""
    robot = pincal.Robot.from_urdf("ur10")
    machine = TrueMachine.from_urdf(Path(robot.source), tip=robot.tip, base="base_link", joint_offsets=[0, 0, 2e-3, 0, 0, 0])
    q = plan_poses(machine.nominal, 60, np.random.default_rng(0), min_height=None)
    tip = machine.tip(q)
    noise = np.random.default_rng(1).normal(0.0, 1e-6, (60, 3))
    return pincal.measurements(robot, q, position=tip[:, :3, :3] @ [0.05, 0.02, 0.1] + tip[:, :3, 3] + noise)


@pytest.fixture(scope="module")
def calibration(table: pincal.Measurements) -> pincal.Calibration:
    """Return the calibration of the UR10."""
    return pincal.run_calibration(
        pincal.Robot.from_urdf("ur10"), table, pincal.Options(effects=pincal.GEOMETRIC, sigma=1e-6)
    )


def test_dir_is_complete() -> None:
    """Every public name is there, can be used, and is listed."""
    assert set(dir(pincal)) == {*pincal.__all__, "__version__"}
    for name in dir(pincal):
        assert getattr(pincal, name) is not None


def test_names_stand_by_topic_and_few_are_enough() -> None:
    """At most fifty; those that moved to their modules work for one release, with a warning that says where they are."""
    assert len(pincal.__all__) <= 50
    moved = pincal._topics()[pincal._MOVED]
    assert moved and not set(moved) & set(pincal.__all__)
    for name, home in moved.items():
        with pytest.warns(DeprecationWarning, match=f"pincal.{name} is now {home}.{name}$"):
            assert getattr(pincal, name) is getattr(importlib.import_module(home), name)


def test_a_moved_name_warns_once_a_line(tmp_path: Path) -> None:
    """Also at its first use, which imports what sets filters of warnings."""
    script = tmp_path / "moved.py"
    script.write_text("from pincal import Chain\n")
    done = subprocess.run([sys.executable, "-W", "default", script], capture_output=True, text=True, check=True)
    assert done.stderr.count("pincal.Chain is now pincal.model.chain.Chain") == 1


def test_every_column_is_a_keyword() -> None:
    """All that a table may hold stands in the signature of ``measurements``, to be completed and looked up."""
    keywords = inspect.signature(pincal.measurements).parameters

    assert {*known_fields(), "approach"} <= set(keywords)
    with pytest.raises(pincal.BadInputError, match="unknown column"):
        pincal.measurements(["a"], [[0.0]], positions=[[0.0, 0.0, 0.0]])


def test_what_is_printed_is_short(calibration: pincal.Calibration, table: pincal.Measurements) -> None:
    """Objects say what they are on a line; notebooks get tables; a copy through pickle is the same."""
    fit = calibration.fit
    shown = {
        "Robot('ur10': 6 joints from world to tool0)": calibration.robot,
        "Measurements('arrays': 60 rows, position, joints shoulder_pan_joint": table,
        "Calibration('ur10': 60 rows fitted, mean error": calibration,
        "FittedRobot('ur10': 60 rows": fit,
        "Chain('ur10': 6 joints": fit.problem.chain,
        "Model('ur10': ": fit.model,
        "Exported(arm.h arm.c: 2 files, ": Exported({"arm.h": b"int n;\n", "arm.c": b"\n" * 100_000}),
    }
    for begins, thing in shown.items():
        assert repr(thing).startswith(begins) and len(repr(thing)) < 200 and "\n" not in repr(thing)
    assert repr(pickle.loads(pickle.dumps(calibration.robot))) == repr(calibration.robot)
    assert repr(fit.parameters) == str(fit.parameters)
    for thing in (calibration, fit, fit.parameters):
        assert "<table" in thing._repr_html_()


def test_predictions_and_parameters_go_to_other_tools(calibration: pincal.Calibration, table: pincal.Measurements) -> None:
    """A fit predicts from joint positions, with its uncertainty, and hands its parameters over as a frame."""
    poses, sigma = calibration.fit.predict(table.q, return_sigma=True)
    frame = calibration.fit.parameters.to_polars()
    offset = frame.filter(frame["parameter"] == "elbow_joint.theta")

    assert np.abs(poses[:, :, 3] - table.position).max() < 1e-5 and sigma.shape == (60, 3) and np.all(sigma < 1e-5)
    assert len(offset) == 1


def test_a_field_is_drawn_beside_the_robot(calibration: pincal.Calibration) -> None:
    """In the world of MeshcatVisualizer, arrows lead from the nominal target, scaled, to the calibrated one."""
    fit, robot = calibration.fit, calibration.robot
    viewer = _Recorder()
    viz = MeshcatVisualizer(robot.pinocchio_model(), pin.GeometryModel(), pin.GeometryModel())
    viz.viewer = viewer
    layer = pincal.draw_field(viz, fit, scale=100.0, grid=50)
    [(path, lines)] = viewer.drawn.items()
    ends = lines.geometry.position.T.reshape(-1, 6, 3)
    plain = deviation_fields(fit.at(), grid=50).layers[0]

    assert path == ("pincal", layer.name) == ("pincal", plain.name)
    np.testing.assert_allclose(ends[:, 1] - ends[:, 0], 100.0 * layer.vectors, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(layer.vectors, axis=1), plain.sizes, atol=1e-12)
    # The instrument stood at base_link, of which only the target's own place is not the nominal tip's.
    off = np.linalg.norm(ends[:, 0] - plain.points, axis=1)
    assert off.max() < 5e-3
    other = pincal.draw_field(viewer, fit, layer="workspace/explained by joint_offset", grid=50)
    assert other.name.endswith("joint_offset") and len(viewer.drawn) == 2
    with pytest.raises(pincal.BadInputError, match="no field 'before'; expected one of "):
        pincal.draw_field(viewer, fit, layer="before", grid=50)
    with pytest.raises(pincal.BadInputError, match="scale is -1"):
        pincal.draw_field(viewer, fit, scale=-1, grid=50)


def test_a_field_is_drawn_in_viser_as_in_meshcat(calibration: pincal.Calibration) -> None:
    """The same strokes and colours, into a server of viser or a viewer that has one; other viewers are refused."""
    fit, meshcats, visers = calibration.fit, _Recorder(), _Scene()
    server = SimpleNamespace(scene=visers)
    layer = pincal.draw_field(meshcats, fit, scale=100.0, grid=20)
    for viz in (server, SimpleNamespace(viewer=server)):
        visers.drawn.clear()
        assert pincal.draw_field(viz, fit, scale=100.0, grid=20).name == layer.name  # type: ignore[arg-type]
        [(name, (points, colours))] = visers.drawn.items()
        [lines] = meshcats.drawn.values()
        assert name == f"/pincal/{layer.name}" and (points.dtype, colours.dtype) == (np.float32, np.uint8)
        np.testing.assert_allclose(points.reshape(-1, 3), lines.geometry.position.T, atol=1e-6)
        np.testing.assert_allclose(colours.reshape(-1, 3) / 255.0, lines.geometry.color.T, atol=0.5 / 255.0 + 1e-6)
    with pytest.raises(pincal.BadInputError, match="no viewer of meshcat or viser; expected one after"):
        pincal.draw_field(SimpleNamespace(viewer=None), fit)  # type: ignore[arg-type]


class _Scene:
    """The scene of a server of viser, as far as lines are drawn into it."""

    def __init__(self) -> None:
        self.drawn = dict[str, tuple[np.ndarray, np.ndarray]]()

    def add_line_segments(self, name: str, points: np.ndarray, colors: np.ndarray) -> None:
        """Keep what is drawn: two ends and two colours of each line."""
        assert points.shape == colors.shape and points.shape[1:] == (2, 3)
        self.drawn[name] = points, colors


class _Recorder(meshcat.Visualizer):
    """A meshcat viewer without a server, that keeps what is drawn into it."""

    __slots__ = ("drawn", "here")

    def __init__(self, drawn=None, here=()):
        self.drawn, self.here = {} if drawn is None else drawn, here

    def __getitem__(self, path):
        return _Recorder(self.drawn, (*self.here, path))

    def set_object(self, thing, material=None):
        self.drawn[self.here] = thing
