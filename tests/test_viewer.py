"""The 3D view: its arrows are true, and whatever is missing or hostile, there is a page."""

import json
import re
import socket
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner

from pincal.builtin import kuka_urdf_path
from pincal.calibration.covered import Covered
from pincal.calibration.fitted_robot import FittedRobot
from pincal.cli import main
from pincal.errors import BadInputError, OutputError
from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.measure.table import write_table
from pincal.model.catalogue import AxisWobble, GearEccentricity, ThermalOffset
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect
from pincal.model.effects import GEOMETRIC, BaseFrame, ToolFrame
from pincal.model.model import Model
from pincal.parameters import estimate_of
from pincal.robot.packages import Meshes
from pincal.robot.robot import Robot
from pincal.viewer import build_scene, deviation_fields, held_out_rows, page, show, write_html
from pincal.viewer.cli.view_verb import view
from pincal.viewer.field import effect_name
from pincal.viewer.scene import axes_of
from pincal.viewer.shapes import shapes_of

LOOK = '<link name="base"/><link name="tool0"/><link name="arm"><visual><geometry>{}</geometry></visual></link>'
HOSTILE = "<script>alert(1)</script>\"'&"
ORTHOGONAL = """<robot name="{name}">
{links}
<joint name="{joint}" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
<joint name="b" type="revolute"><parent link="arm"/><child link="tool0"/><origin xyz="0.4 0 0.3"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
</robot>"""


def machine(
    robot: Robot, rng: np.random.Generator, *effects: Effect, size: float = 1e-3, kind: str = "position"
) -> FittedRobot:
    """Return a robot as a calibration might have left it, somewhere in the instrument's frame."""
    from scipy.spatial.transform import Rotation

    base = Rotation.random(rng=rng).as_matrix()
    chain = Chain.of(robot).with_references(base, np.eye(3)[None])
    frames: tuple[Effect, ...] = (
        (BaseFrame(), ToolFrame()) if kind != "distance" else (BaseFrame(("x", "y", "z")), ToolFrame())
    )
    model = Model(chain, (*frames, *(effects or GEOMETRIC)))
    values = rng.normal(0.0, size, model.n_parameters)
    for name, value in {"base.x": 3.0, "base.y": -1.0, "tool.x": 0.05, "tool.z": 0.1}.items():
        values[model.index(name)] = value
    covered = Covered(np.tile([-1.5, 1.5], (robot.n_joints, 1)), np.array([0.0, 10.0]))
    covariance = 1e-8 * np.eye(len(values))
    estimate = estimate_of(model.parameters, values, covariance)
    return FittedRobot.given(model, estimate, covered, sensor_kind=kind, sigma=[5e-5])


def measured(calibrated: FittedRobot, rng: np.random.Generator, n: int = 40, **columns: np.ndarray) -> Measurements:
    """Return what an instrument without noise reads of this robot."""
    names = calibrated.model.chain.robot.joint_names
    q = rng.uniform(*calibrated.covered.q.T, (n, len(names)))
    position = calibrated.predict(Conditions.at(q))[:, :, 3]
    if calibrated.sensor_kind == "distance":
        return measurements_from_arrays(names, q, distance=np.linalg.norm(position, axis=1), **columns)
    return measurements_from_arrays(names, q, position=position, **columns)


def small_robot(*, name: str = "small", joint: str = "a", links: str | None = None) -> Robot:
    """Return an arm of two joints."""
    bare = '<link name="base"/><link name="arm"/><link name="tool0"/>'
    return Robot.from_urdf(ORTHOGONAL.format(name=name, joint=joint, links=links or bare).encode())


def content(text: str) -> dict:
    """Return what a page holds of its scene."""
    found = re.search(r'<script type="application/json" id="scene">(.*?)</script>', text, re.S)
    assert found is not None
    return json.loads(found[1])


def test_arrows_lead_from_the_prediction_to_the_measurement(kuka: Robot, rng: np.random.Generator) -> None:
    """Before and after have their heads at the measured points; a perfect calibration leaves arrows of no length."""
    calibrated = machine(kuka, rng)
    table = measured(calibrated, rng)
    layers = {layer.name: layer for layer in deviation_fields(calibrated, table, grid=60).layers}
    before, after = layers["deviations/before"], layers["deviations/after"]

    assert np.allclose(before.points + before.vectors, table.position, atol=1e-12)
    assert after.sizes.max() < 1e-12
    assert before.sizes.mean() > 1e-3
    assert layers["workspace/nominal to calibrated"].sizes.mean() == pytest.approx(before.sizes.mean(), rel=0.5)


def test_before_has_base_and_tool_fitted(kuka: Robot, rng: np.random.Generator) -> None:
    """Of a robot whose only error stands in base and tool nothing is left before."""
    calibrated = machine(kuka, rng)
    frames = np.array([p.effect in ("base_frame", "tool_frame") for p in calibrated.estimate.parameters])
    calibrated.values[~frames] = 0.0
    found = deviation_fields(calibrated, measured(calibrated, rng), grid=60)

    assert max(layer.sizes.max() for layer in found.layers) < 1e-8


def test_what_an_effect_explains_is_what_it_adds(kuka: Robot, rng: np.random.Generator) -> None:
    """The arrows of an effect are the difference of two predictions, under the effect's name and joint."""
    calibrated = machine(kuka, rng, GearEccentricity("joint_3"), size=1e-4)
    table = measured(calibrated, rng)
    layer = next(layer for layer in deviation_fields(calibrated, table, grid=0).layers if "explained" in layer.name)
    without = calibrated.values.copy()
    without[-2:] = 0.0
    conditions = Conditions.at(table.q)

    assert layer.name == "deviations/explained by gear_eccentricity of joint_3"
    difference = calibrated.predict(conditions) - calibrated.model.predict(without, conditions)
    assert np.allclose(layer.vectors, difference[:, :, 3])


def test_effects_of_one_joint_have_names_of_their_own() -> None:
    """Two wobbles that differ in the side from which they are seen, or in their order, are told apart."""
    wobbles = [AxisWobble("joint_3", order, frame) for order in (1, 2) for frame in ("before", "after")]
    names = [effect_name(effect) for effect in wobbles]

    assert names[:2] == ["axis_wobble of joint_3", "axis_wobble of joint_3 in the frame of the moving link"]
    assert len(set(names)) == 4


def test_a_distance_tells_the_part_along_the_line_of_sight(kuka: Robot, rng: np.random.Generator) -> None:
    """Arrows of distances point to or from the instrument."""
    calibrated = machine(kuka, rng, kind="distance")
    before = deviation_fields(calibrated, measured(calibrated, rng), grid=0).layers[0]
    across = np.cross(before.vectors, before.points)

    assert np.abs(across).max() < 1e-10
    assert "line of sight" in before.words


def test_the_workspace_leaves_out_what_needs_a_temperature(kuka: Robot, rng: np.random.Generator) -> None:
    """What nobody can know of the workspace is said; measured poses with the column show it."""
    calibrated = machine(kuka, rng, ThermalOffset("joint_2"))
    found = deviation_fields(calibrated, grid=60)

    assert [layer.name for layer in found.layers] == ["workspace/nominal to calibrated"]
    assert any("thermal_offset of joint_2" in note for note in found.notes)


def test_workspace_poses_spread_over_the_workspace(kuka: Robot, rng: np.random.Generator) -> None:
    """About as many places as asked for, and none beside another."""
    over = deviation_fields(machine(kuka, rng), grid=500).layers[0]
    apart = np.linalg.norm(over.points[:, None] - over.points[None], axis=2) + np.eye(len(over.points))

    assert 350 <= len(over.points) <= 500
    assert np.median(apart.min(axis=1)) > 0.05


def test_link_frames_are_the_robot_s_own(rng: np.random.Generator) -> None:
    """The steps that the page moves the arm by lead to Pinocchio's tip, sliding joints included."""
    for name in ("ur10", "panda", "kinova"):
        robot = Robot.from_urdf(name)
        q = robot.random_configurations(1, rng)
        tip = robot.kinematics.frames(q[:1])[0, -1] @ robot.frames.T_last_tip

        assert np.allclose(tip, robot.forward_kinematics(q)[0], atol=1e-9)


def test_axes_are_drawn_with_their_tilt_times_the_factor(kuka: Robot, rng: np.random.Generator) -> None:
    """The angle between the drawn axes is the tilt times the factor that is shown."""
    axes, factor = axes_of(machine(kuka, rng))

    for axis in axes:
        nominal, actual = (np.diff(pair, axis=0)[0] for pair in (axis.nominal, axis.actual))
        cosine = nominal @ actual / np.linalg.norm(nominal) / np.linalg.norm(actual)
        assert np.arccos(min(cosine, 1.0)) == pytest.approx(factor * axis.tilt, abs=1e-7)
    assert max(axis.tilt for axis in axes) * factor <= 0.25


def test_meshes_are_where_the_robot_is(rng: np.random.Generator) -> None:
    """The meshes of a robot of example-robot-data are found, and are as large as the robot."""
    robot = Robot.from_urdf("ur10")
    shapes, notes = shapes_of(robot)
    frames = [np.eye(4), *robot.frames.T_base_link]
    everywhere = np.vstack([s.vertices @ frames[s.body][:3, :3].T + frames[s.body][:3, 3] for s in shapes])

    assert notes == ()
    assert 0.5 * robot.reach < np.ptp(everywhere, axis=0).max() < 1.5 * robot.reach
    assert sum(len(shape.faces) for shape in shapes) < 80_000


def test_a_missing_mesh_is_named_and_replaced(tmp_path: Path) -> None:
    """A link whose mesh is not here is drawn as a simple shape, with a word about it."""
    links = (
        '<link name="base"/><link name="arm"><visual><geometry><mesh filename="package://gone/arm.stl"/></geometry></visual>'
        '</link><link name="tool0"><visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual></link>'
    )
    shapes, notes = shapes_of(small_robot(links=links))

    assert {shape.body for shape in shapes} == {1, 2}
    assert any("package://gone/arm.stl" in note for note in notes)
    assert any("simple shapes: links that move with a" in note for note in notes)


@pytest.mark.parametrize("name", ["http://host/arm.stl", "package://p/../../../etc/passwd", "arm.stl", ""])
def test_no_mesh_is_fetched_or_read_from_elsewhere(name: str) -> None:
    """A name that is no mesh file here leads to simple shapes, whatever it says."""
    _, notes = shapes_of(small_robot(links=LOOK.format(f'<mesh filename="{name}"/>')))

    assert "was not found" in notes[0]


def test_one_missing_mesh_stands_for_all() -> None:
    """Where none can be shown, as of a URDF without its package, two lines say so, whatever the number of links."""
    look = LOOK.format('<mesh filename="package://gone/arm.stl"/>')
    _, notes = shapes_of(small_robot(links=look))
    visual = look[look.index("<visual>") : look.index("</link>", look.index("<visual>"))]
    _, more = shapes_of(small_robot(links=look.replace(visual, visual + visual.replace("arm.stl", "hand.stl"))))

    assert len(notes) == len(more) == 2
    assert ", nor" not in notes[0] and more[0].endswith(", nor 1 other visual")


def test_a_mesh_beyond_what_can_be_worked_on_is_not_read(tmp_path: Path) -> None:
    """A file that is too large, files that are so together, and a scene that shows one mesh too often: each is told."""
    with (tmp_path / "arm.stl").open("wb") as file:
        file.truncate(195_000_000)
    assert "mesh arm.stl has 195 MB, more than the 40 MB that are read" in _why(tmp_path, "arm.stl")
    with (tmp_path / "arm.stl").open("wb") as file:
        file.truncate(39_000_000)
    found = Meshes(str(tmp_path / "arm.urdf"))
    assert [found.find("arm.stl")[0] is not None for _ in range(7)] == [True] * 5 + [False] * 2
    assert "robot's meshes exceed 200 MB" in found.find("arm.stl")[1]

    scene, ball = trimesh.Scene(), trimesh.creation.icosphere(subdivisions=4)
    for k in range(200):
        scene.add_geometry(ball, geom_name="ball", node_name=f"n{k}", transform=np.eye(4))
    scene.export(tmp_path / "arm.glb")
    assert (tmp_path / "arm.glb").stat().st_size < 500_000
    assert re.search(r"\d+ triangles, more than 800000", _why(tmp_path, "arm.glb"))


def _why(folder: Path, name: str) -> str:
    """Return why a mesh is not shown."""
    _, notes = shapes_of(small_robot(links=LOOK.format(f'<mesh filename="{name}"/>')), [folder])
    return notes[0]


def test_a_broken_mesh_is_no_reason_to_fail(tmp_path: Path) -> None:
    """A file that is no mesh is said to be none."""
    (tmp_path / "arm.stl").write_bytes(b"no mesh")
    shapes, notes = shapes_of(small_robot(links=LOOK.format('<mesh filename="arm.stl"/>')), [tmp_path])

    assert shapes
    assert "arm.stl" in notes[0]


def test_hostile_names_stay_text(rng: np.random.Generator) -> None:
    """Names of robot and joints can't leave the places that they stand in."""
    escaped = HOSTILE.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
    robot = small_robot(name=escaped, joint=escaped)
    calibrated = machine(robot, rng)
    text = page(build_scene(calibrated, measured(calibrated, rng), grid=30).opening(notes=["</script>\n<b>"]))

    assert robot.name == HOSTILE
    assert "<script>alert" not in text
    assert content(text)["joints"][0] == HOSTILE
    assert content(text)["notes"][0] == "</script>\n<b>"


def test_a_page_asks_for_nothing_from_outside(rng: np.random.Generator) -> None:
    """No element of the page refers to another file, and its policy forbids it."""
    text = page(build_scene(machine(small_robot(), rng), grid=30))
    shell = re.sub(r"<script.*?</script>", "", text, flags=re.S)

    assert "default-src &#x27;none&#x27;" in text
    assert "http" not in shell.replace("http-equiv", "")
    assert " src=" not in shell


@pytest.mark.parametrize("source", ["bare", pytest.param("panda", marks=pytest.mark.long)])
def test_other_arms_make_a_page(source: str, rng: np.random.Generator) -> None:
    """Seven joints with meshes, or two without any: a page, and a word about what is not there."""
    robot = small_robot() if source == "bare" else Robot.from_urdf(source)
    calibrated = machine(robot, rng)
    scene = build_scene(calibrated, measured(calibrated, rng), held_out=np.zeros(40, bool), grid=50)

    assert {shape.body for shape in scene.shapes} >= set(range(1, robot.n_joints + 1))
    assert "the held-out set is empty" in scene.notes
    assert (source == "panda") or any("simple shapes" in note for note in scene.notes)
    assert len(content(page(scene))["joints"]) == robot.n_joints


def test_a_robot_that_hangs_is_drawn_hanging(kuka: Robot, rng: np.random.Generator) -> None:
    """Gravity points down in the scene, however the base is turned."""
    calibrated = machine(kuka, rng)
    gravity = np.array([0.0, 5.0, 8.0])
    object.__setattr__(calibrated.model.chain, "gravity", gravity)
    scene = build_scene(calibrated, grid=30)

    assert np.allclose(scene.T_scene_base[:3, :3] @ gravity, [0.0, 0.0, -np.linalg.norm(gravity)])


@pytest.mark.parametrize(("options", "word"), [({"scale": 0.0}, "scale"), ({"grid": 0}, "nothing")])
def test_what_can_not_be_drawn_is_refused(kuka: Robot, rng: np.random.Generator, options: dict, word: str) -> None:
    """Factors, poses and fields that make no sense are named."""
    with pytest.raises(BadInputError, match=word):
        build_scene(machine(kuka, rng), **{"grid": 30, **options})
    with pytest.raises(BadInputError, match="pose"):
        build_scene(machine(kuka, rng), grid=30).opening(np.zeros(3))


def test_held_out_rows_are_those_that_the_calibration_names(tmp_path: Path, kuka: Robot, rng: np.random.Generator) -> None:
    """By the hash of the table and the lines of residuals.csv; another table was never seen."""
    import hashlib

    table = measured(machine(kuka, rng), rng, 4)
    data, residuals = tmp_path / "data.csv", tmp_path / "residuals.csv"
    data.write_text("anything")
    write_table(residuals, {"line": table.rows, "rows": np.array(["fitted", "held out", "fitted", "fitted"])})
    inputs = {
        "inputs": {"data.csv": hashlib.sha256(b"anything").hexdigest(), "other.csv": hashlib.sha256(b"more").hexdigest()}
    }

    assert held_out_rows(inputs, residuals, data, table)[0].tolist() == [False, True, False, False]
    assert held_out_rows(inputs, tmp_path / "gone.csv", data, table)[0] is None
    assert held_out_rows({}, residuals, data, table)[0] is None
    data.write_text("more")
    assert held_out_rows(inputs, residuals, data, table)[0].all()
    data.write_text("new")
    assert held_out_rows(inputs, residuals, data, table)[0].all()


def test_the_server_is_for_this_machine_alone(rng: np.random.Generator) -> None:
    """It listens on the loopback address only, and serves no page that calls it by another name."""
    scene = build_scene(machine(small_robot(), rng), grid=30)
    with show(scene) as live:
        port = live._server.server_address[1]
        assert live._server.socket.getsockname()[0] == "127.0.0.1"
        with urllib.request.urlopen(live.url) as answer:
            assert content(answer.read().decode())["live"] is True
        foreign = urllib.request.Request(live.url, headers={"Host": "evil.example"})
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(foreign)
        with pytest.raises(OutputError, match="another port"):
            show(scene, port=port)
        with pytest.raises(BadInputError):
            live.pose(np.zeros(9))
    with pytest.raises(OSError), socket.create_connection(("127.0.0.1", port), timeout=1):
        pass


def test_open_pages_hear_of_a_new_pose(rng: np.random.Generator) -> None:
    """What the program says reaches the pages that listen."""
    with (
        show(build_scene(machine(small_robot(), rng), grid=30)) as live,
        urllib.request.urlopen(live.url + "events") as events,
    ):
        assert events.readline() == b": here\n"
        live.pose(np.array([0.5, -0.25]))
        assert events.readline() == b"\n"
        assert events.readline() == b'data: {"q": [0.5, -0.25]}\n'


def test_a_page_that_can_not_be_written_leaves_what_was_there(tmp_path: Path, rng: np.random.Generator) -> None:
    """The whole file or nothing."""
    scene = build_scene(machine(small_robot(), rng), grid=30)
    with pytest.raises(OutputError, match="gone"):
        write_html(tmp_path / "gone" / "view.html", scene)
    write_html(tmp_path / "view.html", scene)

    assert [file.name for file in tmp_path.iterdir()] == ["view.html"]


@pytest.fixture
def files(tmp_path: Path, rng: np.random.Generator) -> tuple[Path, Path]:
    """Return a model and a table as files."""
    calibrated = machine(Robot.from_urdf(kuka_urdf_path()), rng)
    table = measured(calibrated, rng)
    calibrated.save(tmp_path / "model.json")
    columns = {name: table.q[:, i] for i, name in enumerate(table.joint_names)}
    assert table.position is not None
    write_table(tmp_path / "data.csv", columns | {axis: table.position[:, i] for i, axis in enumerate("xyz")})
    return tmp_path / "model.json", tmp_path / "data.csv"


def test_the_command_writes_a_page(files: tuple[Path, Path], tmp_path: Path) -> None:
    """It says what it wrote, which layers, and by which factor the arrows are longer than true."""
    model, data = map(str, files)
    out = tmp_path / "view.html"
    run = CliRunner().invoke(view, [model, data, "--html", str(out), "--grid", "60", "--pose", "3", "--json", "--quiet"])

    assert run.exit_code == 0, run.output
    said = json.loads(run.stdout)
    assert said["html"] == str(out) and said["bytes"] == out.stat().st_size
    assert {"deviations/before", "deviations/after", "workspace/nominal to calibrated"} <= {
        e["name"] for e in said["layers"]
    }
    shown = content(out.read_text())
    assert shown["scale"] == said["scale"]
    assert any("it is unknown" in note for note in said["notes"])


@pytest.mark.parametrize(
    "wrong", [["--pose", "99"], ["--pose", "1,2"], ["--pose", "x"], ["--scale", "-1"], ["--holdout", "gone.csv"]]
)
def test_the_command_refuses_what_can_not_be(files: tuple[Path, Path], tmp_path: Path, wrong: list[str]) -> None:
    """Exit 3, and nothing written."""
    out = tmp_path / "view.html"
    with pytest.raises(SystemExit) as stop:
        main(["view", str(files[0]), str(files[1]), "--html", str(out), "--grid", "30", "--quiet", *wrong])

    assert stop.value.code == 3
    assert not out.exists()


def test_the_command_marks_a_second_table_as_held_out(files: tuple[Path, Path], tmp_path: Path) -> None:
    """With --holdout all rows of DATA count as fitted."""
    model, data = map(str, files)
    out = tmp_path / "view.html"
    arguments = [model, data, "--holdout", data, "--html", str(out), "--grid", "0", "--quiet"]
    assert CliRunner().invoke(view, arguments).exit_code == 0

    import base64

    held = np.frombuffer(base64.b64decode(content(out.read_text())["fields"]["poses"][0]["held_out"]), "<u4")
    assert held.tolist() == [0] * 40 + [1] * 40
