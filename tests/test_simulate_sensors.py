"""``pincal simulate`` with every sensor: tables, points and cameras against yourdfpy and written-out formulas."""

import json

import numpy as np
import pytest
import yourdfpy
from command_line import run
from machines import kuka
from scipy.spatial.transform import Rotation

from pincal import read_measurements
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.errors import BadInputError
from pincal.robot.urdf_file import find_file
from pincal.simulate.contact import hold
from pincal.simulate.lens import draw_lens
from pincal.simulate.request import SENSORS, SetupOptions, draw_setup

URDF = str(kuka_urdf_path())
JOINTS = tuple(f"joint_{i}" for i in range(1, 7))
EXACT = ("--errors", "0", "--elastic", "0", "--noise", "0")
NAMES = ("point", "socket", "anchor", "target", "from", "to")
# How each kind of measurement is asked for.
ASKED = {
    "socket": ("--sockets", "4"),
    "distance": ("--anchors", "3"),
    "ball bar": ("--ball-bar", "300mm", "--anchors", "2"),
    "camera_point": ("--sensor", "camera_point"),
    "camera_pixel": ("--sensor", "camera_pixel", "--object", "grid"),
}


def columns_of(path):
    """Return the columns of a CSV as text or numbers."""
    lines = [line.split(",") for line in path.read_text().splitlines()]
    cells = dict(zip(lines[0], (np.array(column) for column in zip(*lines[1:], strict=True)), strict=True))
    return {name: c if name in NAMES else c.astype(float) for name, c in cells.items()}


def simulate(folder, *arguments, urdf=URDF, camera=False, name="data"):
    """Run the command; return table, named points, truth and what else it wrote."""
    names = {"out": "csv", "points-out": "csv", "truth": "json"} | ({"camera-out": "json"} if camera else {})
    files = {option: folder / f"{name}-{option}.{ending}" for option, ending in names.items()}
    options = [word for option, path in files.items() for word in (f"--{option}", path)]
    assert run("simulate", urdf, *arguments, *options, "--quiet") == 0
    points = columns_of(files["points-out"])
    places = dict(zip(points["point"], np.column_stack([points[axis] for axis in "xyz"]), strict=True))
    return columns_of(files["out"]), places, json.loads(files["truth"].read_text())


def tips(columns, urdf=URDF, tip="tool0", base="base_link"):
    """Return where yourdfpy has the tip in every row, shape (N, 4, 4)."""
    robot, found = yourdfpy.URDF.load(urdf, load_meshes=False, build_scene_graph=True), []
    names = [name for name in columns if name in robot.actuated_joint_names]
    for row in np.column_stack([columns[name] for name in names]):
        robot.update_cfg(dict(zip(names, row, strict=True)))
        found.append(robot.get_transform(tip, base))
    return np.array(found)


def moved(transform, points):
    return np.einsum("...ab,...b->...a", transform[..., :3, :3], points) + transform[..., :3, 3]


# Contact


@pytest.fixture(scope="module")
def contacts(tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("contacts"), "--sockets", "5", "--poses", "23", *EXACT)


def test_the_tool_point_sits_in_its_socket(contacts):
    """Forward kinematics of every row lead to the socket that it names; the points file has it in the instrument's frame."""
    columns, points, truth = contacts
    held = moved(tips(columns), np.array(truth["tool_m"]))
    sockets = truth["sockets_in_base_m"]
    np.testing.assert_allclose(held, [sockets[name] for name in columns["socket"]], rtol=0, atol=1e-10)
    known = moved(np.array(truth["T_instrument_base"]), np.array([*sockets.values()]))
    np.testing.assert_allclose([points[name] for name in sockets], known, rtol=0, atol=1e-12)


def test_sockets_come_in_pairs_and_share_the_poses(contacts):
    """Two are 50 mm apart, pairs much farther; all are above the floor, and held from many sides."""
    columns, points, truth = contacts
    assert list(points) == [f"socket_{i}" for i in range(1, 6)]
    places = np.array([*points.values()])
    apart = np.linalg.norm(places[:, None] - places, axis=2)
    np.testing.assert_allclose([apart[0, 1], apart[2, 3]], 0.05, atol=1e-12)
    assert apart[0, 2] > 0.3 and min(place[2] for place in truth["sockets_in_base_m"].values()) > 0.0
    assert sorted(np.unique(columns["socket"], return_counts=True)[1]) == [4, 4, 5, 5, 5]
    axes = tips(columns)[columns["socket"] == "socket_1", :3, 2]
    assert np.min(axes @ axes.T) < 0.5


def test_contacts_keep_limits_and_floor(contacts):
    """All joints are within their limits, elbow and wrist above the floor."""
    columns, _, _ = contacts
    arm, q = kuka().nominal, np.column_stack([columns[name] for name in JOINTS])
    assert np.all((q > arm.lower) & (q < arm.upper))
    assert sim.planning.is_clear(arm, q, 0.0).all()


def test_contact_is_made_by_the_machine_as_it_is(tmp_path):
    """Elastic, warm, loaded and with play: its true tool point is in the socket, whose scatter is the noise."""
    effects = ("--effect", "thermal_expansion", "--effect", "backlash:joint_2", "--effect", "base_drift")
    columns, points, truth = simulate(
        tmp_path, "--sockets", "2", "--poses", "40", *effects, "--payload", "0,100", "--socket-spacing", "0.1m"
    )
    assert {"temperature", "time", "payload", "approach_joint_2"} <= set(columns)
    assert all(entry["moves_target_rms_mm"] > 0.01 for entry in truth["effects"])
    assert np.linalg.norm(points["socket_1"] - points["socket_2"]) == pytest.approx(0.1)
    machine, setup = typical_setup("socket", SetupOptions(sockets=1, sigma=5e-5))
    machine = machine.with_effects(sim.ThermalExpansion(size=1e-5), sim.Backlash(joint="joint_2", size=2e-4))
    q = setup.plan(machine.nominal, 60, rng=np.random.default_rng(1), min_height=0.0)
    conditions = {"temperature": np.linspace(20, 30, 60), "payload": 50.0, "approach": {"joint_2": np.tile([1, -1], 30)}}
    table = setup.measure(machine, q, rng=np.random.default_rng(2), **conditions)
    held = moved(machine.tip(np.column_stack([table[name] for name in machine.names]), **conditions), np.array(setup.tool))
    off = held - setup.fixed["socket_1"]
    assert off.std() == pytest.approx(5e-5, rel=0.2) and np.abs(off.mean(axis=0)).max() < 3e-5


def typical_setup(kind, options):
    machine = sim.TrueMachine.from_urdf(URDF, tip="tool0", compliance=np.full((6, 3), 1e-7))
    machine = machine.draw_errors(np.random.default_rng(3), sigma_length=5e-4, sigma_angle=1e-3)
    return machine, draw_setup(kind, machine.nominal, rng=np.random.default_rng(0), options=options)


def test_a_place_out_of_reach_is_refused():
    """The true arm can't be held where it doesn't reach, nor by play whose side nobody knows."""
    rng, q = np.random.default_rng(0), np.zeros((1, 6))
    with pytest.raises(BadInputError, match="can't be held at"):
        hold(kuka(), kuka().poses(q), np.array([[9.0, 0.0, 0.0]]), tool=(0.0, 0.0, 0.0))
    with pytest.raises(BadInputError, match="out of reach"):
        sim.Contact(fixed={"A": (9.0, 0.0, 0.0)}).plan(kuka().nominal, 1, rng=rng)


# Distances


def test_distances_are_from_the_anchor_that_is_named(tmp_path):
    """Every pose has a row for each anchor, its distance that of forward kinematics."""
    columns, points, truth = simulate(tmp_path, "--anchors", "3", "--poses", "7", *EXACT)
    assert columns["anchor"].tolist() == ["anchor_1", "anchor_2", "anchor_3"] * 7
    (target,) = truth["targets"].values()
    seen = moved(np.array(truth["T_instrument_base"]) @ tips(columns) @ np.array(target), np.zeros(3))
    expected = np.linalg.norm(seen - [points[name] for name in columns["anchor"]], axis=1)
    np.testing.assert_allclose(columns["distance"], expected, rtol=0, atol=1e-11)


def test_targets_and_anchors_go_together(tmp_path):
    """Two targets and two anchors make four rows a pose."""
    columns, _, _ = simulate(tmp_path, "--anchors", "2", "--targets", "2", "--poses", "2")
    rows = list(zip(columns["target"], columns["anchor"], strict=True))
    assert rows == [(f"target_{i}", f"anchor_{j}") for _ in "ab" for i in (1, 2) for j in (1, 2)]


def test_an_instrument_on_the_hand_reads_what_stands_beside_the_robot(tmp_path, capsys):
    """From the hand to the base, --to being the same as --tip: inverted poses, with the links of each row."""
    wanted = ["simulate", URDF, "--from", "tool0", "--to", "base_link", "--out", tmp_path / "x.csv", "--poses", "9"]
    exact = ("--sensor", "pose", "--noise-angle", "0", *EXACT, "--truth", tmp_path / "x.json", "--quiet")
    assert run(*wanted, *exact) == 0
    columns, truth = columns_of(tmp_path / "x.csv"), json.loads((tmp_path / "x.json").read_text())
    assert (truth["base"], truth["tip"]) == ("tool0", "base_link")
    (target,) = truth["targets"].values()
    expected = np.array(truth["T_instrument_base"]) @ np.linalg.inv(tips(columns)) @ np.array(target)
    np.testing.assert_allclose(np.column_stack([columns[axis] for axis in "xyz"]), expected[:, :3, 3], rtol=0, atol=1e-11)
    turned = Rotation.from_quat(np.column_stack([columns[name] for name in ("qx", "qy", "qz", "qw")])).as_matrix()
    np.testing.assert_allclose(turned, expected[:, :3, :3], rtol=0, atol=1e-11)
    assert set(columns["from"]) == {"tool0"} and set(columns["to"]) == {"base_link"}
    for more, said in (
        (("--targets", "2"), "expected one object"),
        (("--sensor", "camera_point"), "expected one of position, pose, distance"),
        (("--tip", "flange"), "leave one of them out"),
    ):
        assert run(*wanted, *more) in (2, 3)
        assert said in capsys.readouterr().err


def test_a_bar_keeps_the_tool_point_on_a_sphere(tmp_path):
    """Its true length is constant; what is read of it has the noise, and the sphere is seen from many sides."""
    columns, _, truth = simulate(tmp_path, "--ball-bar", "300mm", "--anchors", "2", "--poses", "80", *EXACT[:4])
    anchors = np.array([truth["anchors_in_base_m"][name] for name in columns["anchor"]])
    ways = moved(tips(columns), np.array(truth["tool_m"])) - anchors
    np.testing.assert_allclose(np.linalg.norm(ways, axis=1), 0.3, rtol=0, atol=1e-10)
    assert np.std(columns["distance"] - 0.3) == pytest.approx(5e-5, rel=0.3) and truth["ball_bar_m"] == 0.3
    assert np.linalg.svd(ways, compute_uv=False)[2] > 0.5 and ways[:, 2].min() > 0.0


def test_a_scale_error_is_read_off_a_bar():
    """The instrument's scale changes what is read, not where the tool point is."""
    machine, setup = typical_setup("distance", SetupOptions(ball_bar=0.3, at_base=True))
    scaled, rng = machine.with_effects(sim.MeasurementScale(size=1e-3)), np.random.default_rng
    q = setup.plan(machine.nominal, 5, rng=rng(1), min_height=0.0)
    tables = [setup.measure(m, q, rng=rng(2)) for m in (machine, scaled)]
    np.testing.assert_allclose(tables[1]["distance"], 1.001 * tables[0]["distance"], rtol=1e-12)
    np.testing.assert_array_equal(tables[0]["joint_1"], tables[1]["joint_1"])


# Cameras


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("seen"), "--sensor", "camera_point", *EXACT)


def in_camera(columns, points, truth, **arm):
    """Return each row's point in the camera's frame, by yourdfpy."""
    camera = tips(columns, **arm) @ np.array(truth["T_tip_camera"])
    places = moved(np.array(truth["T_base_object"]), np.array([points[name] for name in columns["point"]]))
    return np.einsum("nab,na->nb", camera[:, :3, :3], places - camera[:, :3, 3])


def test_camera_points_are_those_of_the_object(seen):
    """Forward kinematics, the mounted camera and the object's own frame lead to what the camera reads."""
    columns, points, truth = seen
    read = np.column_stack([columns[name] for name in ("cx", "cy", "cz")])
    np.testing.assert_allclose(read, in_camera(columns, points, truth), rtol=0, atol=1e-11)
    assert read[:, 2].min() > 0.05


def test_the_object_of_the_paper_has_two_sides_of_three_blocks(seen):
    """Points are 25 mm apart on two planes; each block is whole in two joint configurations at least."""
    columns, points, _ = seen
    assert len(np.unique(columns["joint_1"])) == 12 and len(points) == 150
    for side in "ab":
        places = np.array([place for name, place in points.items() if name.startswith(side)])
        near = np.sort(np.linalg.norm(places[:, None] - places, axis=2), axis=1)
        np.testing.assert_allclose(near[:, 1:3], 0.025, atol=1e-12)
        assert np.linalg.matrix_rank(places - places.mean(axis=0), tol=1e-9) == 2
    for block in ("a1", "a2", "a3", "b1", "b2", "b3"):
        rows = np.char.startswith(columns["point"], f"{block}_")
        assert np.sum(np.unique(columns["joint_1"][rows], return_counts=True)[1] == 25) >= 2


def test_the_camera_is_in_front_of_what_it_sees(seen):
    """It looks at the outer face of each side; points of a side that is turned away are not there."""
    columns, points, truth = seen
    read = np.column_stack([columns[name] for name in ("cx", "cy", "cz")])
    lean = {"a": np.array([0.0, -1.0, 1.0]) / np.sqrt(2.0), "b": np.array([0.0, 1.0, 1.0]) / np.sqrt(2.0)}
    normals = np.array([lean[name[0]] for name in columns["point"]]) @ np.array(truth["T_base_object"])[:3, :3].T
    camera = tips(columns) @ np.array(truth["T_tip_camera"])
    facing = -np.einsum("nab,na,nb->n", camera[:, :3, :3], normals, read) / np.linalg.norm(read, axis=1)
    assert facing.min() > 0.2
    assert set(points) > set(columns["point"]) or set(points) == set(columns["point"])


def written_out(camera, x, y):
    """Return u and v of one slope, as the manual of OpenCV has it."""
    r2 = x * x + y * y
    radial = 1 + camera["k1"] * r2 + camera["k2"] * r2 * r2 + camera["k3"] * r2 * r2 * r2
    bent_x = x * radial + 2 * camera["p1"] * x * y + camera["p2"] * (r2 + 2 * x * x)
    bent_y = y * radial + camera["p1"] * (r2 + 2 * y * y) + 2 * camera["p2"] * x * y
    return camera["fx"] * bent_x + camera["u0"], camera["fy"] * bent_y + camera["v0"]


@pytest.mark.parametrize(
    ("arm", "tip", "base"),
    [("kuka", "tool0", "base_link"), pytest.param("z1", "gripperMover", "world", marks=pytest.mark.long)],
)
def test_images_are_those_of_the_written_camera(tmp_path, arm, tip, base):
    """Pixels follow from forward kinematics, the object and the camera's file by the formula; all are in the image."""
    urdf = URDF if arm == "kuka" else str(find_file(arm))
    wanted = [
        "--sensor",
        "camera_pixel",
        "--object",
        "grid",
        "--poses",
        "6",
        "--lens",
        "fx=1500,k3=0.02,width=1600",
        "--tip",
        tip,
    ]
    columns, points, truth = simulate(tmp_path, *wanted, *EXACT, urdf=urdf, camera=True)
    camera = json.loads((tmp_path / "data-camera-out.json").read_text())
    seen = in_camera(columns, points, truth, urdf=urdf, tip=tip, base=base)
    image = np.array([written_out(camera, x / z, y / z) for x, y, z in seen])
    np.testing.assert_allclose(np.column_stack([columns["u"], columns["v"]]), image, rtol=0, atol=1e-7)
    assert set(camera) == {"fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2", "k3", "width", "height"}
    assert (camera["fx"], camera["k3"], camera["width"]) == (1500.0, 0.02, 1600) and camera["fx"] != camera["fy"]
    assert np.all((image >= 0.0) & (image <= [1599.0, 1535.0]))
    assert len(columns["u"]) == 6 * 63


def test_distortion_is_as_written_out():
    """Every coefficient acts by the formula, each for itself and all together."""
    coefficients = {"k1": -0.2, "k2": 0.1, "k3": -0.03, "p1": 2e-3, "p2": -1e-3}
    points = np.array([[0.1, -0.2, 1.0], [-0.3, 0.05, 0.7], [0.0, 0.0, 2.0]])
    for names in (*((name,) for name in coefficients), tuple(coefficients)):
        lens = sim.Lens(focal=(900.0, 950.0), centre=(330.0, 230.0), **{name: coefficients[name] for name in names})
        expected = [written_out(lens.intrinsics, x / z, y / z) for x, y, z in points]
        np.testing.assert_allclose(lens.project(points), expected, rtol=0, atol=1e-10)


def test_only_what_is_in_the_image_is_seen():
    """Behind the camera, beside the image, and where the polynomial folds back into it, there is nothing to see."""
    lens = sim.Lens(focal=500.0, centre=(320.0, 240.0), size=(640, 480), k1=-0.5)
    points = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.7, 0.0, 1.0], [0.0, 0.7, 1.0], [1.4, 0.0, 1.0]])
    assert lens.sees(points).tolist() == [True, False, True, False, False]
    # The last one would be at 320 + 500 * 1.4 * (1 - 0.5 * 1.96) = 334 px, well within the image.
    assert lens.project(points)[4, 0] == pytest.approx(334.0)
    assert not lens.sees(points[2:3], margin=0.1)[0]


def test_drawn_lenses_take_what_is_given():
    """What is given stays; what is not differs from a data sheet by a little."""
    lens = draw_lens(np.random.default_rng(0), k1=0.0, u0=1000.0)
    assert (lens.k1, lens.centre[0]) == (0.0, 1000.0)
    assert abs(lens.focals[0] / 2000.0 - 1.0) < 0.03 and lens.k2 != 0.0


def test_points_at_the_back_are_left_out_and_their_scale_can_be_off():
    """A plate is seen from its front; an instrument's scale acts on points in metres."""
    machine, rng = kuka(), np.random.default_rng(4)
    camera, points = np.eye(4), {"P": (1.6, 0.0, 0.4), "Q": (1.625, 0.0, 0.4)}
    q = sim.plan_views(machine.nominal, 3, rng=rng, view=sim.View(camera_pose=camera, look_at=points["P"]))
    normals = {"P": (0.0, 0.0, 1.0), "Q": (0.0, 0.0, -1.0)}
    target = sim.CalibrationObject.of_points(points, normals)
    setup = sim.EyeInHand(camera_pose=camera, target=target, in_metres=True)
    table = setup.measure(machine, q)
    assert set(table["point"]) == {"P"}
    scaled = machine.with_effects(sim.MeasurementScale(size=1e-3))
    longer = setup.measure(scaled, q)
    np.testing.assert_allclose(longer["cz"], 1.001 * table["cz"], rtol=1e-12)
    with pytest.raises(BadInputError, match="sees no point"):
        away = sim.CalibrationObject.of_points({"P": points["P"]}, {"P": (0.0, 0.0, -1.0)})
        sim.EyeInHand(camera_pose=camera, target=away, in_metres=True).measure(machine, q)


# All of them


@pytest.mark.long
@pytest.mark.parametrize("kind", ASKED)
def test_every_kind_is_read_again_and_repeats(tmp_path, kind):
    """The reader knows the table by its kind; the same seed makes the same files; conditions go through."""
    asked = [*ASKED[kind], "--poses", "6", "--payload", "0,50", "--with", "time", "--effect", "joint_scatter:joint_2"]
    for name in "ab":
        columns, _, truth = simulate(tmp_path, *asked, name=name)
    rows = read_measurements(tmp_path / "a-out.csv", JOINTS)
    assert rows.kind == truth["sensor"] == kind.replace("ball bar", "distance")
    assert {"payload", "time"} <= set(columns) and set(columns["payload"]) == {0.0, 50.0}
    for option in ("out.csv", "points-out.csv", "truth.json"):
        if option != "truth.json":
            assert (tmp_path / f"a-{option}").read_bytes() == (tmp_path / f"b-{option}").read_bytes()


@pytest.mark.parametrize("kind", ["socket", "ball bar", "camera_pixel"])
def test_given_poses_are_measured_again(tmp_path, kind):
    """The poses of an earlier table serve once more, every pose once."""
    first, _, truth = simulate(tmp_path, *ASKED[kind], "--poses", "6", name="first")
    again, _, other = simulate(tmp_path, *ASKED[kind], "--at", tmp_path / "first-out.csv", name="again")
    assert truth["poses"] == other["poses"] == 6 and len(again["joint_1"]) == len(first["joint_1"])
    assert np.abs(again["joint_1"] - first["joint_1"]).max() < 2e-3


def test_given_poses_that_touch_nothing_are_refused(tmp_path, capsys):
    """A tool point far from every socket can't be held there."""
    assert run("simulate", URDF, "--poses", "5", "--out", tmp_path / "any.csv", "--quiet") == 0
    assert run("simulate", URDF, *ASKED["socket"], "--at", tmp_path / "any.csv", "--out", tmp_path / "no.csv") == 3
    assert "m from where it can be held" in capsys.readouterr().err


def test_cycles_visit_every_pose_again(tmp_path):
    """Round by round at the same joints, from the same side, with the same load, at other times."""
    simulated = [
        "--anchors",
        "1",
        "--poses",
        "3",
        "--cycles",
        "4",
        "--payload",
        "0,50",
        "--with",
        "approach",
        "--with",
        "time",
    ]
    columns, _, truth = simulate(tmp_path, *simulated)
    for name in ("joint_1", "payload", "approach_joint_1"):
        rounds = columns[name].reshape(4, 3)
        assert np.all(rounds == rounds[0])
    assert len(set(columns["time"])) == 12 and truth["poses"] == 12
    assert np.all(np.ptp(columns["distance"].reshape(4, 3), axis=0) > 0.0)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--sensor", "position", "--sockets", "3"], "--sockets is for --sensor socket"),
        (["--sensor", "camera_pixel", "--noise", "0.1mm"], "0.1px"),
        (["--noise", "0.1px"], "0.05mm"),
        (["--noise", "-1px"], "number of pixels"),
        (["--points-out", "p.csv"], "no named points"),
        (["--camera-out", "c.json", "--sensor", "camera_point"], "is for --sensor camera_pixel"),
        (["--ball-bar", "0.3m", "--targets", "2"], "one tool point"),
        (["--object", "grid"], "camera_point or camera_pixel"),
    ],
)
def test_options_that_do_not_go_together_are_refused(tmp_path, capsys, arguments, words):
    """Exit 2 with the option or the sensor that fits."""
    assert run("simulate", URDF, "--poses", "5", "--out", tmp_path / "data.csv", *arguments) == 2
    assert words in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--sockets", "2", "--effect", "measurement_scale"], "a socket reads none"),
        (["--sensor", "camera_pixel", "--object", "grid", "--effect", "measurement_scale"], "an image has none"),
        (["--ball-bar", "9m"], "hardly be held"),
        (["--sensor", "camera_pixel", "--lens", "f=3"], "no key 'f'"),
        (["--sensor", "camera_pixel", "--lens", "fx=wide"], "expected a number"),
        (["--sensor", "camera_pixel", "--lens", "fx=0"], "at least 1"),
        (["--sensor", "socket", "--points-out", "data.csv"], "two files"),
        (["--sockets", "2", "--points-out", "nowhere/p.csv"], "can't be written"),
    ],
)
def test_what_no_sensor_can_do_is_refused(tmp_path, monkeypatch, capsys, arguments, words):
    """Exit 3, a message that helps, and no file."""
    monkeypatch.chdir(tmp_path)
    assert run("simulate", URDF, "--poses", "3", "--out", "data.csv", *arguments) == 3
    assert words in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_sensor_is_refused_with_those_there_are():
    """The message lists all kinds."""
    with pytest.raises(BadInputError, match=", ".join(SENSORS)):
        draw_setup("sonar", kuka().nominal, rng=np.random.default_rng(0), options=SetupOptions())
    with pytest.raises(BadInputError, match="expected targets 1"):
        options = SetupOptions(targets=2, tool=(0.0, 0.0, 0.1))
        draw_setup("position", kuka().nominal, rng=np.random.default_rng(0), options=options)


def test_what_to_do_next_names_what_was_written(tmp_path, monkeypatch, capsys):
    """The next command gets points, camera and noise; contact without points gets the distance of a pair."""
    monkeypatch.chdir(tmp_path)
    wanted = [
        "--sensor",
        "camera_pixel",
        "--object",
        "grid",
        "--poses",
        "3",
        "--points-out",
        "p.csv",
        "--camera-out",
        "c.json",
    ]
    assert run("simulate", URDF, *wanted, "--out", "d.csv") == 0
    assert "--noise 0.1px --points p.csv --camera c.json" in capsys.readouterr().out
    assert run("simulate", URDF, "--sockets", "2", "--poses", "4", "--out", "d.csv") == 0
    assert "--socket-distance socket_1 socket_2 0.05" in capsys.readouterr().out
