"""Exports of the geometry, each read back by a tool that is not ours: MuJoCo, xacro, yourdfpy, Pinocchio, SciPy."""

from __future__ import annotations

import csv
import io
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from command_line import run
from conftest import SHARED
from linkages import four_bar, palletizer, rod_arm
from scipy.spatial.transform import Rotation
from test_catalogue import chain_of, conditions_of, units_of
from test_export import GANTRY, calibrated_of

from pincal.calibration.fitted_robot import FittedRobot
from pincal.errors import BadInputError
from pincal.export import export_model, geometry_files
from pincal.io.urdf_export import calibrated_urdf, rigid_tips
from pincal.model.catalogue.masses import LinkMass
from pincal.model.chain import Chain, MomentFrame
from pincal.model.conditions import Conditions
from pincal.model.effects import ELASTIC, GEOMETRIC, BaseFrame, ToolFrame
from pincal.model.model import Model
from pincal.parameters import FRAME_SYMBOLS
from pincal.robot.robot import Robot

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
XACRO = SHARED / "robots" / "ur_description" / "urdf" / "ur.urdf.xacro"
GEOMETRY = 1e-9
LINKAGES: dict[str, tuple[Callable[[str], bytes], str]] = {
    "palletizer": (palletizer, "tool0"),
    "palletizer on balls": (partial(palletizer, kind="spherical"), "tool0"),
    "rod arm, no parallelogram": (partial(rod_arm, skew=0.05), "tool0"),
    "four-bar": (four_bar, "tip"),
}
ARMS = ("ur10", "panda", "kuka", "gantry")


def calibrated(robot: Robot, *, moment_frame: MomentFrame = "after", equilibrium: bool = False) -> FittedRobot:
    """Return an arm with errors of millimetres and milliradians, and bent by as much."""
    rng = np.random.default_rng(3)
    effects = (*ELASTIC, BaseFrame(), ToolFrame(FRAME_SYMBOLS))
    model = Model(chain_of(robot, moment_frame), effects, equilibrium=equilibrium)
    units = units_of(model, conditions_of(robot, 50, rng))
    values = 1e-3 * rng.uniform(-1.0, 1.0, model.n_parameters) / units
    compliant = [parameter.unit == "rad/(N m)" for parameter in model.parameters]
    return calibrated_of(model, np.where(compliant, np.abs(values), values))


def tips(found: FittedRobot, q: np.ndarray) -> np.ndarray:
    """Return the calibrated tip in the base frame by Pinocchio, from the calibrated URDF, shape (N, 4, 4)."""
    text = calibrated_urdf(found.model, found.values)
    robot = found.model.chain.robot
    return Robot.from_urdf(text.text, tip=text.tip, base=robot.base).forward_kinematics(q)


@pytest.fixture(params=ARMS)
def arm(request: pytest.FixtureRequest, kuka: Robot) -> Robot:
    """Return arms with parallel axes, with seven joints, an industrial one, and one with a carriage and a coupled joint."""
    arms = {"kuka": lambda: kuka, "gantry": lambda: Robot.from_urdf(GANTRY)}
    return arms.get(request.param, lambda: Robot.from_urdf(request.param))()


def test_yourdfpy_reads_the_calibrated_urdf(arm: Robot, rng: np.random.Generator, tmp_path: Path) -> None:
    """The URDF written through the registry, read by yourdfpy, has its tip where the model has it."""
    import yourdfpy

    found, q = calibrated(arm), arm.random_configurations(20, rng)
    text = calibrated_urdf(found.model, found.values)
    export_model(found, "urdf", tmp_path / "arm.urdf")
    read = yourdfpy.URDF.load(tmp_path / "arm.urdf", load_meshes=False, build_scene_graph=True)
    places = []
    for row in q:
        read.update_cfg({arm.joint_names[i]: row[i] for i in arm.own_joints})
        places.append(read.get_transform(text.tip, arm.base))
    error = np.abs(np.array(places) - tips(found, q)).max()
    print(f"yourdfpy: {error:.1e} m")

    assert error < GEOMETRY


# --- MuJoCo -------------------------------------------------------------------------------------------------------


def test_mujoco_has_the_calibrated_geometry(arm: Robot, rng: np.random.Generator) -> None:
    """With its springs at rest the MuJoCo model's tip is the calibrated tip."""
    mujoco = pytest.importorskip("mujoco")
    found, q = calibrated(arm), arm.random_configurations(50, rng)
    exported = export_model(found, "mjcf")
    model = mujoco.MjModel.from_xml_string(exported.text)
    data = mujoco.MjData(model)
    places = []
    for row in q:
        for name, position in zip(arm.joint_names, row, strict=True):
            data.qpos[model.joint(name).qposadr] = position
        mujoco.mj_kinematics(model, data)
        site = data.site(arm.tip)
        places.append(np.column_stack([site.xmat.reshape(3, 3), site.xpos]))
    error = np.abs(np.array(places) - tips(found, q)[:, :3]).max()
    print(f"mujoco: {error:.1e} m")

    assert error < GEOMETRY and exported.max_error_m < GEOMETRY
    assert model.njnt == 4 * arm.n_joints


@pytest.mark.parametrize(
    ("arm", "moment_frame"),
    [
        ("kuka", "paper"),
        ("panda", "before"),
        ("gantry", "after"),
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in (("kuka", "after"), ("kuka", "before"), ("panda", "after"))
        ),
    ],
    indirect=["arm"],
)
def test_mujoco_bends_as_the_model_does(arm: Robot, moment_frame: MomentFrame, rng: np.random.Generator) -> None:
    """At rest under gravity the springs' deflection is that of the compliances; what is no spring is said.

    The Panda and the gantry have bearings beside the origins of their frames, the gantry a carriage on springs. Where the
    bearings stand the model knows to first order in turns of some 1e-4.
    """
    mujoco = pytest.importorskip("mujoco")
    found, q = calibrated(arm, moment_frame=moment_frame, equilibrium=True), arm.random_configurations(20, rng)
    exported = export_model(found, "mjcf")
    model = mujoco.MjModel.from_xml_string(exported.text)
    data = mujoco.MjData(model)
    springs = [i for i in range(model.njnt) if model.jnt_stiffness[i] > 0.0]
    dofs, stiffness = model.jnt_dofadr[springs], model.jnt_stiffness[springs]
    own = found.with_effects(lambda effect: effect.scope == "robot" and (moment_frame != "paper" or effect.name[0] != "b"))
    bare = own.model.with_chain(own.model.chain.with_references(np.eye(3), np.eye(3)[None]))
    true = bare.predict(own.model_values, Conditions.at(q))[:, :, 3]
    straight = tips(found, q)[:, :3, 3]
    places = []
    for row in q:
        mujoco.mj_resetData(model, data)
        for name, position in zip(arm.joint_names, row, strict=True):
            data.qpos[model.joint(name).qposadr] = position
        for _ in range(8):
            mujoco.mj_forward(model, data)
            data.qpos[model.jnt_qposadr[springs]] = -data.qfrc_bias[dofs] / stiffness
        mujoco.mj_kinematics(model, data)
        places.append(data.site(arm.tip).xpos.copy())
    error, bent = (np.linalg.norm(at - true, axis=1).max() for at in (np.array(places), straight))
    print(f"mujoco, {moment_frame}: bent by {1e3 * bent:.3f} mm, {1e6 * error:.3f} um apart")

    travel = np.sum((arm.upper - arm.lower)[[kind == "prismatic" for kind in arm.joint_types]])
    assert bent > 4e-4 * (arm.reach - travel) and error < 1e-3 * bent
    assert ("bearing_elasticity" in " ".join(exported.notes)) == (moment_frame == "paper")


class Looped:
    """A MuJoCo model of a robot with loops, whose passive joints are put where the gaps of its constraints are least."""

    def __init__(self, robot: Robot, text: str) -> None:
        mujoco = pytest.importorskip("mujoco")
        self.mujoco, self.robot, self.model = mujoco, robot, mujoco.MjModel.from_xml_string(text)
        self.data = mujoco.MjData(self.model)
        self.pairs = [(e.get("site1"), e.get("site2")) for e in ET.fromstring(text).find("equality")]
        self.passive = [int(self.model.joint(joint).dofadr[0]) for joint in robot.passive]
        self.springs = np.flatnonzero(self.model.jnt_stiffness > 0.0)

    def start(self, q: np.ndarray) -> None:
        """Put all joints where the nominal robot has them, shape (n,), springs at rest."""
        self.mujoco.mj_resetData(self.model, self.data)
        for joint, position in zip(self.robot.joint_names, q, strict=True):
            self.data.qpos[self.model.joint(joint).qposadr] = position

    def close(self) -> np.ndarray:
        """Close the loops by the passive joints; return how gaps move by all joints, shape (3 pairs, dofs)."""
        for _ in range(20):
            self.mujoco.mj_forward(self.model, self.data)
            gaps, J = [], []
            for pair in self.pairs:
                sides = [np.zeros((3, self.model.nv)) for _ in pair]
                for end, side in zip(pair, sides, strict=True):
                    self.mujoco.mj_jacSite(self.model, self.data, side, None, self.model.site(end).id)
                gaps.append(self.data.site(pair[0]).xpos - self.data.site(pair[1]).xpos)
                J.append(sides[0] - sides[1])
            whole = np.vstack(J)
            # All joints are hinges or slides: a joint is one position, and one dof.
            self.data.qpos[self.passive] -= np.linalg.lstsq(whole[:, self.passive], np.concatenate(gaps))[0]
        self.mujoco.mj_forward(self.model, self.data)
        return whole

    def bend(self) -> None:
        """Let springs give way to what they bear: by virtual work that of the passive joints too, as they follow."""
        for _ in range(8):
            J, bias = self.close(), self.data.qfrc_bias
            followed = -np.linalg.lstsq(J[:, self.passive], J[:, self.springs])[0]
            borne = bias[self.springs] + followed.T @ bias[self.passive]
            self.data.qpos[self.springs] = -borne / self.model.jnt_stiffness[self.springs]
        self.close()

    @property
    def tip(self) -> np.ndarray:
        """Where the tip is, shape (3,) [m]."""
        return np.array(self.data.site(self.robot.tip).xpos)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == "four-bar" else pytest.mark.long) for name in LINKAGES]
)
def test_mujoco_closes_loops_as_the_model_does(name: str, rng: np.random.Generator) -> None:
    """But for what is out of a loop's plane, to second order in the errors of the geometry, which are millimetres."""
    text, tip = LINKAGES[name]
    robot = Robot.from_urdf(text("constraint"), tip=tip)
    whole, q = calibrated(robot), robot.random_configurations(10, rng)
    apart = []
    for share in (1.0, 0.1):
        found = calibrated_of(whole.model, share * whole.values)
        exported = export_model(found, "mjcf")
        looped = Looped(robot, exported.text)
        tips = []
        for row in q:
            looped.start(row)
            looped.close()
            tips.append(looped.tip)
        apart.append(np.abs(np.array(tips) - rigid_tips(found.model, found.values, q)[:, :, 3]).max())
        assert exported.max_error_m < GEOMETRY
    print(f"mujoco, {name}: {1e6 * apart[0]:.2f} um apart, {1e6 * apart[1]:.3f} um at a tenth of the errors")

    assert apart[0] < 2e-5 and apart[1] < 0.02 * apart[0]


@pytest.mark.parametrize("name", ["palletizer", pytest.param("rod arm, no parallelogram", marks=pytest.mark.long)])
def test_mujoco_bends_drives_of_loops_as_the_model_does(name: str, rng: np.random.Generator) -> None:
    """Drives bear what rods transmit; the bearings of loops, which would share it, are rigid, and that is said."""
    text, tip = LINKAGES[name]
    robot = Robot.from_urdf(text("constraint"), tip=tip)
    model = Model(chain_of(robot, "after"), ELASTIC, equilibrium=True)
    loops = {robot.joint_names[i] for closure in robot.closures for i, _ in closure.path.steps(robot.parents)}
    soft = [p.is_compliance and (p.symbol == "k_z" or p.element not in loops) for p in model.parameters]
    found = calibrated_of(model, np.where(soft, 2e-7, 0.0))
    exported, q = export_model(found, "mjcf"), robot.random_configurations(10, rng)
    looped, tips = Looped(robot, exported.text), []
    for row in q:
        looped.start(row)
        looped.bend()
        tips.append(looped.tip)
    bare = model.with_chain(model.chain.with_references(np.eye(3), np.eye(3)[None]))
    true = bare.predict(found.model_values, Conditions.at(q))[:, :, 3]
    bent, error = (np.abs(at - true).max() for at in (rigid_tips(model, found.values, q)[:, :, 3], np.array(tips)))
    print(f"mujoco, {name}: bent by {1e3 * bent:.3f} mm, {1e6 * error:.3f} um apart")

    assert bent > 2e-4 and error < 1e-3 * bent
    stiff = export_model(calibrated_of(model, np.where([p.is_compliance for p in model.parameters], 2e-7, 0.0)), "mjcf")
    assert any("rigid here" in note for note in stiff.notes)


def test_mujoco_has_the_masses(kuka: Robot) -> None:
    """Mass and gravity are the robot's; a link without mass has next to none."""
    mujoco = pytest.importorskip("mujoco")
    found = calibrated(kuka)
    model = mujoco.MjModel.from_xml_string(export_model(found, "mjcf").text)
    light = replace(kuka, masses=np.zeros(6), massless=("link_1",))
    other = mujoco.MjModel.from_xml_string(
        export_model(calibrated_of(Model(Chain.of(light), GEOMETRIC), np.zeros(36)), "mjcf").text
    )

    np.testing.assert_allclose(model.body_mass.sum(), kuka.masses.sum(), rtol=1e-12)
    np.testing.assert_allclose(model.opt.gravity, found.model.chain.gravity, rtol=0.0, atol=1e-12)
    assert other.body_mass.sum() < 1e-5


def test_mujoco_has_the_masses_that_were_found(kuka: Robot) -> None:
    """They are carried, and not said to be missing; one that came out negative is."""
    mujoco = pytest.importorskip("mujoco")
    model = Model(Chain.of(kuka, moment_frame="after"), (*ELASTIC, LinkMass()))
    values = np.array([{"rad/(N m)": 1e-7, "kg": 2.0}.get(parameter.unit, 0.0) for parameter in model.parameters])
    exported = export_model(calibrated_of(model, values), "mjcf")
    read = mujoco.MjModel.from_xml_string(exported.text)

    np.testing.assert_allclose(read.body_mass.sum(), kuka.masses.sum() + 12.0, rtol=1e-12)
    assert "link_mass" not in exported.text and "negative" not in exported.text
    values[model.index("joint_6.mass")] = -100.0
    assert any("masses after joint_6" in note for note in export_model(calibrated_of(model, values), "mjcf").notes)


def test_names_with_dashes_stay_within_the_comment_of_a_mujoco_model() -> None:
    """A tip named a---b is in the notes, which XML allows no two dashes in a row."""
    robot = Robot.from_urdf(GANTRY.replace(b'"tip"', b'"a---b"'))
    text = export_model(calibrated(robot), "mjcf").text

    assert "on a- - -b is in model.json only" in text and ET.fromstring(text).find(".//site").get("name") == "a---b"


# --- UR -----------------------------------------------------------------------------------------------------------


@pytest.mark.skipif(not XACRO.is_file(), reason="no folder shared/robots next to the project")
@pytest.mark.parametrize("kind", ["ur10e", "ur5"])
def test_the_xacro_of_ur_description_makes_the_calibrated_arm(kind: str, tmp_path: Path, rng: np.random.Generator) -> None:
    """Expanded with the exported kinematics, the flange's axes are the calibrated ones; the tip's own part is said."""
    pytest.importorskip("xacrodoc")
    arguments = {"ur_type": kind, "name": "ur"}
    robot = Robot.from_urdf(XACRO, tip="tool0", base="base_link", xacro_args=arguments)
    model = Model(chain_of(robot), (*GEOMETRIC, BaseFrame(), ToolFrame()))
    values = 1e-3 * rng.uniform(-1.0, 1.0, model.n_parameters)
    behind_last = [f"wrist_3_joint.{symbol}" for symbol in ("d", "a", "alpha")]
    values[[model.index(name) for name in behind_last]] = 0.0
    found = calibrated_of(model, values)
    exported = export_model(found, "ur-kinematics", tmp_path / "arm.yaml")
    again = Robot.from_urdf(
        XACRO, tip="tool0", base="base_link", xacro_args={**arguments, "kinematics_params": str(tmp_path / "arm.yaml")}
    )
    q = robot.random_configurations(50, rng)
    error = np.abs(again.forward_kinematics(q) - tips(found, q)).max()
    print(f"{kind}, xacro: {error:.1e} m")

    assert error < GEOMETRY and not any("the tip has moved" in note for note in exported.notes)
    values[model.index("wrist_3_joint.a")] = 2e-3
    moved = export_model(calibrated_of(model, values), "ur-kinematics")
    assert any("the tip has moved by" in note and "2.000000" in note for note in moved.notes)


def test_what_is_no_ur_is_refused(kuka: Robot) -> None:
    """Other arms by their joints; older descriptions of a UR by their frames."""
    with pytest.raises(BadInputError, match=r"joints joint_1, .* are not the joints of a UR"):
        export_model(calibrated(kuka), "ur-kinematics")
    with pytest.raises(BadInputError, match="an older description with other frames"):
        export_model(calibrated(Robot.from_urdf("ur10")), "ur-kinematics")


# --- DH -----------------------------------------------------------------------------------------------------------


def by_table(text: str, convention: str, q: np.ndarray) -> np.ndarray:
    """Return tips, shape (N, 4, 4), by a DH table and SciPy's rotations."""
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    rows = [{k.split()[0]: v for k, v in row.items()} for row in csv.DictReader(io.StringIO("\n".join(lines)))]
    base, *joints, tool = [row for row in rows if row["convention"] == convention]

    def frame(row: dict[str, str]) -> np.ndarray:
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("xyz", [float(row[a]) for a in ("roll", "pitch", "yaw")]).as_matrix()
        T[:3, 3] = [float(row[a]) for a in "xyz"]
        return T

    def screw(axis: int, angle: float, way: float) -> np.ndarray:
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec(angle * np.eye(3)[axis]).as_matrix()
        T[axis, 3] = way
        return T

    out = []
    for at in q:
        T = frame(base)
        for row, position in zip(joints, at, strict=True):
            theta, d, a, alpha, beta = (float(row[key]) for key in ("theta", "d", "a", "alpha", "beta"))
            theta, d = (theta, d + position) if row["type"] == "prismatic" else (theta + position, d)
            joint, link = screw(2, theta, d), screw(0, alpha, a) @ screw(1, beta, 0.0)
            T = T @ (joint @ link if convention == "standard" else link @ joint)
        out.append(T @ frame(tool))
    return np.array(out)


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_dh_tables_are_the_calibrated_arm(arm: Robot, convention: str, rng: np.random.Generator) -> None:
    """Both conventions, multiplied out, are the tip that Pinocchio finds; parallel axes need beta, which is said."""
    found, q = calibrated(arm), arm.random_configurations(30, rng)
    exported = export_model(found, "dh")
    error = np.abs(by_table(exported.text, convention, q) - tips(found, q)).max()
    print(f"DH, {convention}: {error:.1e} m")

    assert error < GEOMETRY and exported.max_error_m < GEOMETRY
    assert any(note.startswith("beta (Hayati)") for note in exported.notes) == (arm.name in ("ur10", "kuka_kr125_2"))
    assert any("j3 follows j2: -0.5 times" in note for note in exported.notes) == (arm.name == "gantry 2/b")


@pytest.mark.parametrize(("off", "is_refused"), [(0.9e-9, False), (1.1e-9, True)])
def test_a_table_that_is_not_the_arm_is_refused(off: float, is_refused: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A nanometre, as its decimal places resolve."""
    robot, tips_of = Robot.from_urdf("ur10"), geometry_files._tips
    monkeypatch.setattr(geometry_files, "_tips", lambda *given, **more: np.add(tips_of(*given, **more), [off, 0.0, 0.0]))
    found = calibrated_of(Model(Chain.of(robot), ()), np.zeros(0))
    if not is_refused:
        assert export_model(found, "dh").max_error_m == pytest.approx(off, rel=0.01)
        return
    with pytest.raises(BadInputError, match=r"its parameters would be off by up to 1\.1e-09 m"):
        export_model(found, "dh")


def test_a_dh_table_of_a_drawing_has_no_beta() -> None:
    """The nominal UR10 is in plain parameters; its lengths are those that its maker publishes."""
    robot = Robot.from_urdf("ur10")
    exported = export_model(calibrated_of(Model(Chain.of(robot), ()), np.zeros(0)), "dh")
    rows = [line.split(",") for line in exported.text.splitlines() if line.startswith("standard,") and "revolute" in line]

    assert not exported.notes
    assert [abs(float(row[5])) for row in rows][1:3] == pytest.approx([0.612, 0.5723])


# --- frames -------------------------------------------------------------------------------------------------------

READ = {
    "kuka": lambda v: Rotation.from_euler("ZYX", v, degrees=True),
    "fanuc": lambda v: Rotation.from_euler("xyz", v, degrees=True),
    "abb": lambda v: Rotation.from_quat(v, scalar_first=True),
    "ur": lambda v: Rotation.from_rotvec(v),
}


@pytest.mark.parametrize("controller", READ)
def test_frames_are_in_the_convention_of_the_controller(kuka: Robot, controller: str, rng: np.random.Generator) -> None:
    """Read by SciPy: what the instrument sees of the target is base, arm and tool one after the other."""
    found, q = calibrated(kuka), kuka.random_configurations(10, rng)
    rigid = found.with_effects(lambda effect: not effect.uses_moments)
    exported = export_model(found, "frames", controller=controller)
    lines = [line for line in exported.text.splitlines() if not line.startswith("#")]
    frames = {}
    for name, *cells in (line.split(",") for line in lines[1:]):
        numbers = np.array(cells, float)
        frames[name] = np.eye(4)
        frames[name][:3, :3] = READ[controller](numbers[3:]).as_matrix()
        frames[name][:3, 3] = numbers[:3] * (1.0 if controller == "ur" else 1e-3)
    seen = np.linalg.inv(frames["base"]) @ tips(found, q) @ frames["tool"]
    error = np.abs(seen[:, :3] - rigid.predict(q)).max()
    print(f"frames, {controller}: {error:.1e} m")

    assert error < 1e-8 and exported.max_error_m < 1e-9
    assert ("[deg]" in lines[0]) == (controller in ("kuka", "fanuc")) and ("[mm]" in lines[0]) == (controller != "ur")
    with pytest.raises(BadInputError, match="controller 'siemens'; expected one of kuka, fanuc, abb, ur"):
        export_model(found, "frames", controller="siemens")


def test_the_command_has_all_formats(kuka: Robot, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Files are written, frames are printed, notes are told; a format that does not fit is bad input."""
    model = tmp_path / "model.json"
    calibrated(kuka).save(model)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert run("export", model, "--mjcf", tmp_path / "a.xml", "--dh", tmp_path / "a.csv", "--frames", "abb") == 0
    told = capsys.readouterr().out

    assert "frame,x [mm],y [mm],z [mm],q1,q2,q3,q4" in told and "note: beta (Hayati)" in told
    assert (tmp_path / "a.xml").read_text().startswith("<!--") and (tmp_path / "a.csv").read_text().startswith("# ")
    assert run("export", model, "--ur-kinematics", tmp_path / "a.yaml") == 3
    assert not (tmp_path / "a.yaml").exists()
