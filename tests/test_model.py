"""The extended model: every effect's contract, and the compiled loops against Pinocchio and sums written out here."""

from __future__ import annotations

import gc
import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from numba import njit
from numba.core import event
from numba.core.event import EventStatus
from pairs import in_pairs

from pincal import compiled
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.model import effects as catalogue
from pincal.model import kernel_walk, kernels, sizes
from pincal.model.augmented import augmented_model, joint_placements, pinocchio_model
from pincal.model.catalogue.bearing_features import ObliqueBearing
from pincal.model.chain import MOMENT_FRAMES, Chain, MomentFrame
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect
from pincal.model.effects import ELASTIC, GEOMETRIC, BaseFrame, JointOffset, LinkGeometry, ToolFrame
from pincal.model.kernel_inputs import BLOCK, FRAME, MOUNT
from pincal.model.model import Model
from pincal.model.sizes import largest_bases, largest_basis
from pincal.parameters import FRAME_SYMBOLS
from pincal.robot.link_path import above
from pincal.robot.robot import Robot

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

# Rounding of poses [m, 1]; of moments relative to the largest on the arm.
EXACT = 1e-12
G = 9.81
# A base that is not level, so that no moment vanishes by luck [m/s^2].
TILTED = np.array([2.0, -3.0, -9.0])
TARGETS = ("A", "B", "C")
# Joints off a path that change what those of the path bear.
OTHERS = ("torso_lift_joint", "arm_right_1_joint")

ARMS: dict[str, Callable[[], Robot]] = {
    "kuka": lambda: Robot.from_urdf(kuka_urdf_path()),
    "ur10": lambda: Robot.from_urdf("ur10"),
    "panda": lambda: Robot.from_urdf("panda"),
    "tiago": lambda: Robot.from_urdf("tiago", tip="arm_tool_link"),
    "hand to hand": lambda: Robot.from_urdf("baxter", start="left_gripper", tip="right_gripper"),
    "head to hand": lambda: Robot.from_urdf(
        "tiago_pro", start="head_front_camera_link", tip="gripper_left_base_link", others=OTHERS
    ),
}
# Those that are like another one are long.
PARAMS = [pytest.param(name, marks=pytest.mark.long) if name in ("ur10", "head to hand") else name for name in ARMS]
# Moments of two paths up a tree and down are those of one frame as of another.
ARMS_AND_FRAMES = [
    pytest.param(
        name, frame, marks=pytest.mark.long if name in ("ur10", "head to hand") or (frame != "paper" and " " in name) else ()
    )
    for name in ARMS
    for frame in MOMENT_FRAMES
]
EFFECTS: dict[str, tuple[Effect, ...]] = {
    **{effect.name: (effect,) for effect in ELASTIC},
    "base_frame": (BaseFrame(),),
    "base_position": (BaseFrame(FRAME_SYMBOLS[:3]),),
    "tool_frame": (ToolFrame(FRAME_SYMBOLS),),
    "tool_point": (ToolFrame(),),
    "geometric": GEOMETRIC,
    "all": (BaseFrame(), ToolFrame(FRAME_SYMBOLS), *ELASTIC),
}
SOME_JOINTS = catalogue.JointElasticity, catalogue.BearingElasticity
EFFECTS_IN_PAIRS = pytest.mark.parametrize(
    ("name", "robot", "moment_frame", "equilibrium"),
    in_pairs(list(EFFECTS), PARAMS, MOMENT_FRAMES, [False, True]),
    indirect=["robot"],
)


@cache
def arm(name: str) -> Robot:
    """Return one of the robots, read once."""
    return ARMS[name]()


@pytest.fixture(scope="module", params=PARAMS)
def robot(request: pytest.FixtureRequest) -> Robot:
    """Return each of the robots: industrial, parallel axes, seven joints, a sliding torso; paths up a tree and down."""
    return arm(request.param)


def chain_of(robot: Robot, moment_frame: MomentFrame = "paper", gravity: np.ndarray = TILTED) -> Chain:
    """Return a chain with three targets about random orientations of base and tools."""
    from scipy.spatial.transform import Rotation

    chain = Chain.of(robot, moment_frame=moment_frame, gravity=gravity, targets=TARGETS)
    turned = Rotation.random(len(TARGETS) + 1, random_state=3).as_matrix()
    return chain.with_references(turned[0], turned[1:])


def conditions_of(robot: Robot, n: int, rng: np.random.Generator, *, targets: int = len(TARGETS)) -> Conditions:
    """Return random poses with random payloads and targets."""
    q = robot.random_configurations(n, rng)
    payload, target = rng.uniform(0.0, 12.0, n), rng.integers(0, targets, n)
    return Conditions(q, target, payload, np.array([0.08, -0.05, 0.22]))


def unit_of(model: Model, conditions: Conditions) -> np.ndarray:
    """Return how far a unit of each parameter moves its coordinate: 1, or the largest moment that bends it [N m]."""
    moments = np.abs(model.static_moments(np.zeros(model.n_parameters), conditions)).max(axis=0)
    floor = 0.05 * moments.max()
    joints = model.chain.robot.joint_names
    unit = np.ones(model.n_parameters)
    for p, name in enumerate(model.names):
        element, symbol = name.rsplit(".", 1)
        if symbol.startswith("k_"):
            unit[p] = max(moments[3 * joints.index(element) + "xyz".index(symbol[-1])], floor)
    # A bearing beside the origin of its frame turns short links to move them.
    size = largest_basis(model, conditions)[0]
    return np.where(size > 2.0 * unit, size, unit)


def values_of(model: Model, conditions: Conditions, rng: np.random.Generator) -> np.ndarray:
    """Return deviations of up to 10 mm and 10 mrad, compliances that bend each axis by up to that."""
    return 1e-2 * rng.uniform(-1.0, 1.0, model.n_parameters) / unit_of(model, conditions)


# --- the contract of every effect ---------------------------------------------------------------------------------


def test_every_effect_of_the_catalogue_is_under_test() -> None:
    """An effect that is added to the catalogue without being added here fails this test."""
    known = {type(effect) for effects in EFFECTS.values() for effect in effects}
    found = {kind for kind in vars(catalogue).values() if isinstance(kind, type) and issubclass(kind, Effect)}

    assert {kind for kind in found if not kind.__abstractmethods__ and "name" in vars(kind)} == known


@pytest.mark.parametrize("name", EFFECTS)
def test_parameters_are_named_by_element_and_symbol(robot: Robot, name: str) -> None:
    """Names are unique and read <element>.<symbol>; units and sizes fit; elements are joints, base and targets."""
    model = Model(chain_of(robot), EFFECTS[name])
    elements = {*robot.joint_names, "base", *TARGETS}

    assert len(set(model.names)) == model.n_parameters > 0
    for parameter in model.parameters:
        element, symbol = parameter.name.rsplit(".", 1)
        assert element in elements and re.fullmatch(r"[a-z]+(_[xyz])?", symbol)
        assert parameter.unit == ("rad/(N m)" if symbol.startswith("k_") else "m" if symbol in "xyzda" else "rad")
        assert parameter.size > 0.0 and np.isfinite(parameter.nominal)
        assert parameter.effect in {effect.name for effect in EFFECTS[name]}
        assert model.names[model.index(parameter.name)] == parameter.name


@njit
def turned(angles: np.ndarray, cosines: np.ndarray, sines: np.ndarray) -> None:
    for i in range(len(angles)):
        kernel_walk.cosines_and_sines(angles[i], cosines[i], sines[i])


@pytest.mark.parametrize("reach", [0.8, 7.0, 1e4, 1e6])
def test_cosines_and_sines_are_exact(reach: float, rng: np.random.Generator) -> None:
    angles = rng.uniform(-reach, reach, (200, kernel_walk.LANES))
    # At all eighths of a turn near zero, where quarters change.
    angles[0] = 0.25 * np.pi * (np.arange(kernel_walk.LANES) - 32)
    found = np.empty((2, *angles.shape))
    turned(angles, *found)
    np.testing.assert_allclose(found, [np.cos(angles), np.sin(angles)], rtol=0.0, atol=2.3e-16)
    np.testing.assert_allclose(found[:, 0], [np.cos(angles[0]), np.sin(angles[0])], rtol=1e-15)
    turned(np.full((1, kernel_walk.LANES), np.nan), *found[:, :1])
    assert np.isnan(found[:, 0]).all()


@pytest.mark.parametrize("name", EFFECTS)
def test_terms_fit_poses_and_parameters(robot: Robot, name: str, rng: np.random.Generator) -> None:
    """Each term has a basis for every pose, acts on a coordinate of the chain and belongs to one parameter."""
    chain, conditions = chain_of(robot), conditions_of(robot, 7, rng)
    moments = rng.standard_normal((7, 3 * robot.n_joints))
    for effect in EFFECTS[name]:
        terms = effect.terms(chain, conditions, moments if effect.uses_moments else None)
        assert {term.parameter for term in terms} == set(range(len(effect.parameters(chain))))
        for term in terms:
            assert 0 <= term.coordinate < chain.size
            assert term.basis is None or term.basis.shape == (7,)
            assert (term.moment is not None) == effect.uses_moments


@pytest.mark.parametrize("name", EFFECTS)
def test_effects_have_a_readable_repr(name: str) -> None:
    """The representation of an effect names its class."""
    for effect in EFFECTS[name]:
        assert repr(effect).startswith(type(effect).__name__ + "(")


@EFFECTS_IN_PAIRS
def test_zero_parameters_give_the_nominal_arm(
    robot: Robot, name: str, moment_frame: MomentFrame, equilibrium: bool, rng: np.random.Generator
) -> None:
    """With all parameters zero the tip stands where Pinocchio has it, whatever the effect."""
    model = Model(Chain.of(robot, moment_frame=moment_frame), EFFECTS[name], equilibrium=equilibrium)
    conditions = conditions_of(robot, 9, rng, targets=1)
    poses = model.predict(np.zeros(model.n_parameters), conditions)

    np.testing.assert_allclose(poses, robot.forward_kinematics(conditions.q)[:, :3], rtol=0.0, atol=EXACT)


def central_differences(model: Model, values: np.ndarray, conditions: Conditions, steps: np.ndarray) -> np.ndarray:
    """Return the motion and turning of the target by each parameter, shape (N, 6, P)."""
    R = model.predict(values, conditions)[:, :, :3]
    columns = []
    for p, h in enumerate(steps):
        step = np.zeros(len(values))
        step[p] = h
        slope = (model.predict(values + step, conditions) - model.predict(values - step, conditions)) / (2.0 * h)
        W = slope[:, :, :3] @ R.transpose(0, 2, 1)
        turning = np.stack([W[:, 2, 1] - W[:, 1, 2], W[:, 0, 2] - W[:, 2, 0], W[:, 1, 0] - W[:, 0, 1]], axis=1) / 2.0
        columns.append(np.concatenate([slope[:, :, 3], turning], axis=1))
    return np.stack(columns, axis=2)


@EFFECTS_IN_PAIRS
def test_jacobian_is_exact(
    robot: Robot, name: str, moment_frame: MomentFrame, equilibrium: bool, rng: np.random.Generator
) -> None:
    """The analytic Jacobian, six rows, equals central differences; with three rows it is its upper half."""
    model = Model(chain_of(robot, moment_frame), EFFECTS[name], equilibrium=equilibrium)
    conditions = conditions_of(robot, 6, rng)
    values = values_of(model, conditions, rng)
    poses, jacobian = model.linearise(values, conditions, rows=6)
    # Steps that move a coordinate by 1e-5: truncation and rounding are both some 1e-10 of the motion.
    unit = unit_of(model, conditions)
    numeric = central_differences(model, values, conditions, 1e-5 / unit)

    np.testing.assert_array_equal(poses, model.predict(values, conditions))
    np.testing.assert_allclose(jacobian / unit, numeric / unit, rtol=0.0, atol=3e-9 * max(1.0, robot.reach))
    np.testing.assert_allclose(model.linearise(values, conditions)[1], jacobian[:, :3], rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("moment_frame", MOMENT_FRAMES)
def test_columns_of_free_parameters_only(robot: Robot, moment_frame: MomentFrame, rng: np.random.Generator) -> None:
    """With a mask of free parameters the Jacobian has their columns, in order, and no others."""
    model = Model(chain_of(robot, moment_frame), EFFECTS["all"])
    conditions = conditions_of(robot, 5, rng)
    values, free = values_of(model, conditions, rng), rng.random(model.n_parameters) < 0.4
    _, whole = model.linearise(values, conditions, rows=6)
    _, part = model.linearise(values, conditions, free=free, rows=6)

    np.testing.assert_allclose(part, whole[:, :, free], rtol=1e-13, atol=1e-13)
    assert model.linearise(values, conditions, free=np.zeros_like(free))[1].shape == (5, 3, 0)


@pytest.mark.parametrize("equilibrium", [False, True])
@pytest.mark.parametrize("moment_frame", MOMENT_FRAMES)
def test_effects_commute(robot: Robot, moment_frame: MomentFrame, equilibrium: bool, rng: np.random.Generator) -> None:
    """Predictions and Jacobians are the same in any order of the effects."""
    model = Model(chain_of(robot, moment_frame), EFFECTS["all"], equilibrium=equilibrium)
    conditions = conditions_of(robot, 5, rng)
    values = values_of(model, conditions, rng)
    poses, jacobian = model.linearise(values, conditions, rows=6)
    for _ in range(3):
        other = model.with_effects([model.effects[i] for i in rng.permutation(len(model.effects))])
        picked = [model.index(name) for name in other.names]
        again, columns = other.linearise(values[picked], conditions, rows=6)
        np.testing.assert_allclose(again, poses, rtol=0.0, atol=EXACT)
        np.testing.assert_allclose(columns, jacobian[:, :, picked], rtol=1e-11, atol=1e-11)


def test_chosen_joints_give_way_alone(robot: Robot, rng: np.random.Generator) -> None:
    """An elasticity of some joints is that of all joints with the others' compliance zero."""
    chosen, conditions = robot.joint_names[1:4:2], conditions_of(robot, 5, rng)
    part = Model(chain_of(robot), tuple(kind(chosen) for kind in SOME_JOINTS))
    whole = Model(chain_of(robot), tuple(kind() for kind in SOME_JOINTS))
    values = values_of(part, conditions, rng)
    spread = np.zeros(whole.n_parameters)
    spread[[whole.index(name) for name in part.names]] = values

    assert {name.rsplit(".", 1)[0] for name in part.names} == set(chosen)
    np.testing.assert_allclose(part.predict(values, conditions), whole.predict(spread, conditions), rtol=0.0, atol=EXACT)


def test_targets_move_on_their_own(robot: Robot, rng: np.random.Generator) -> None:
    """The tool parameters of one target move the rows of this target alone, in its own orientation."""
    model, conditions = Model(chain_of(robot), (ToolFrame(FRAME_SYMBOLS),)), conditions_of(robot, 30, rng)
    _, jacobian = model.linearise(np.zeros(model.n_parameters), conditions, rows=6)
    for t, name in enumerate(TARGETS):
        columns = jacobian[:, :, [model.index(f"{name}.{symbol}") for symbol in FRAME_SYMBOLS]]
        assert np.all(columns[conditions.target != t] == 0.0)
        assert np.all(np.abs(columns[conditions.target == t]).max(axis=(1, 2)) > 0.5)
    offset = np.array([0.1, -0.2, 0.3])
    values = np.tile([*offset, 0.0, 0.0, 0.0], len(TARGETS))
    bare = model.predict(np.zeros(model.n_parameters), conditions)
    base = np.array([model.chain.base_rotation @ T[:3, :3] for T in robot.forward_kinematics(conditions.q)])
    moved = bare[:, :, 3] + base @ offset
    np.testing.assert_allclose(model.predict(values, conditions)[:, :, 3], moved, rtol=0.0, atol=EXACT)


@pytest.mark.parametrize("equilibrium", [False, True])
@pytest.mark.parametrize("n", [1, 2, 63, 64, 65, 128, 129])
def test_rows_do_not_depend_on_their_company(n: int, equilibrium: bool, rng: np.random.Generator) -> None:
    """A pose gives the same numbers alone, in a full group of the compiled loops and in one just begun."""
    robot = ARMS["ur10"]()
    model = Model(chain_of(robot), EFFECTS["all"], equilibrium=equilibrium)
    conditions = conditions_of(robot, 129, rng)
    values = values_of(model, conditions, rng)
    poses, jacobian = model.linearise(values, conditions, rows=6)
    moments = model.static_moments(values, conditions)
    rows = np.arange(129)[::-1][:n]
    some = conditions.select(rows)
    again, columns = model.linearise(values, some, rows=6)

    np.testing.assert_allclose(again, poses[rows], rtol=0.0, atol=EXACT)
    np.testing.assert_allclose(columns, jacobian[rows], rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(model.predict(values, some), poses[rows], rtol=0.0, atol=EXACT)
    np.testing.assert_allclose(
        model.static_moments(values, some), moments[rows], rtol=0.0, atol=EXACT * np.abs(moments).max()
    )


def test_no_poses_give_no_rows(robot: Robot, rng: np.random.Generator) -> None:
    """An empty table is evaluated like any other."""
    model, conditions = Model(chain_of(robot), EFFECTS["all"]), conditions_of(robot, 0, rng)
    poses, jacobian = model.linearise(np.zeros(model.n_parameters), conditions)

    assert poses.shape == (0, 3, 4) and jacobian.shape == (0, 3, model.n_parameters)


def test_inputs_are_left_alone(rng: np.random.Generator) -> None:
    """Evaluation changes neither the values nor the poses that it is given, and takes read-only arrays."""
    robot = ARMS["kuka"]()
    model, conditions = Model(chain_of(robot), EFFECTS["all"], equilibrium=True), conditions_of(robot, 5, rng)
    values = values_of(model, conditions, rng)
    for array in (values, conditions.q, conditions.target, conditions.payload, conditions.payload_centre):
        array.flags.writeable = False

    np.testing.assert_array_equal(model.linearise(values, conditions)[0], model.predict(values, conditions))


# --- the same model by Pinocchio ----------------------------------------------------------------------------------


class Augmented:
    """The chain as Pinocchio has it, with a joint for every coordinate, pose by pose."""

    def __init__(self, chain: Chain, *, payload: float, centre: np.ndarray) -> None:
        self.chain = chain
        self.model = augmented_model(chain, payload=payload, payload_centre=centre)
        self.data = self.model.createData()
        self.start, self.tip = self.model.getFrameId("start"), self.model.getFrameId("tip")

    def joints(self, coordinates: np.ndarray) -> np.ndarray:
        """Return the joints' part of a row of coordinates, the way back from the bearing in d."""
        x = coordinates.copy()
        for i in range(self.chain.robot.n_joints):
            x[self.chain.joint(i, "d")] -= x[self.chain.joint(i, "h")]
        return x[FRAME : self.chain.layout.starts[-1]]

    def pose(self, coordinates: np.ndarray) -> np.ndarray:
        """Return the tip in the frame where the path starts, shape (3, 4)."""
        pin.framesForwardKinematics(self.model, self.data, self.joints(coordinates))
        return np.asarray((self.data.oMf[self.start].inverse() * self.data.oMf[self.tip]).homogeneous[:3])

    def jacobian(self, coordinates: np.ndarray) -> np.ndarray:
        """Return the motion and turning of the tip by all coordinates of the joints, seen from where the path starts."""
        x = self.joints(coordinates)
        start, tip = (
            np.array(pin.computeFrameJacobian(self.model, self.data, x, frame, pin.LOCAL_WORLD_ALIGNED))
            for frame in (self.start, self.tip)
        )
        pin.framesForwardKinematics(self.model, self.data, x)
        away = self.data.oMf[self.tip].translation - self.data.oMf[self.start].translation
        tip[:3] -= start[:3] + np.cross(start[3:].T, away).T
        tip[3:] -= start[3:]
        R = self.data.oMf[self.start].rotation.T
        return np.vstack([R @ tip[:3], R @ tip[3:]])

    def moments(self, coordinates: np.ndarray) -> np.ndarray:
        """Return the static moment about (or force along) each coordinate: minus the generalised gravity."""
        return -np.asarray(pin.computeGeneralizedGravity(self.model, self.data, self.joints(coordinates)))

    def moment_slopes(self, coordinates: np.ndarray) -> np.ndarray:
        """Return d moment / d coordinate, shape (10 n, 10 n)."""
        return -np.array(pin.computeGeneralizedGravityDerivatives(self.model, self.data, self.joints(coordinates)))


def bare_chain(robot: Robot, moment_frame: MomentFrame, gravity: np.ndarray = TILTED) -> Chain:
    """Return a chain whose base and tool frames are the robot's own."""
    return Chain.of(robot, moment_frame=moment_frame, gravity=gravity)


def one_payload(robot: Robot, n: int, rng: np.random.Generator) -> tuple[Conditions, Callable[[Chain], Augmented]]:
    """Return poses that all carry the same payload, and what builds Pinocchio's model with it."""
    mass, centre = 7.5, np.array([0.08, -0.05, 0.22])
    conditions = Conditions.at(robot.random_configurations(n, rng), payload=mass, payload_centre=centre)
    return conditions, lambda chain: Augmented(chain, payload=mass, centre=centre)


@pytest.mark.parametrize("equilibrium", [False, True])
@pytest.mark.parametrize(("robot", "moment_frame"), ARMS_AND_FRAMES, indirect=["robot"])
def test_augmented_model_has_the_same_tip(
    robot: Robot, moment_frame: MomentFrame, equilibrium: bool, rng: np.random.Generator
) -> None:
    """Pinocchio with a joint for each coordinate puts the tip of the bent arm where the compiled loops do."""
    chain = bare_chain(robot, moment_frame)
    model = Model(chain, ELASTIC, equilibrium=equilibrium)
    conditions, build = one_payload(robot, 8, rng)
    values, augmented = values_of(model, conditions, rng), build(chain)
    coordinates = model.coordinates(values, conditions)

    assert augmented.model.nq == chain.size - 2 * FRAME == BLOCK * robot.n_joints + MOUNT * len(robot.frames.branches)
    np.testing.assert_allclose(
        model.predict(values, conditions), [augmented.pose(x) for x in coordinates], rtol=0.0, atol=EXACT
    )


@pytest.mark.parametrize(("robot", "moment_frame"), ARMS_AND_FRAMES, indirect=["robot"])
def test_augmented_jacobian_is_the_kinematic_one(robot: Robot, moment_frame: MomentFrame, rng: np.random.Generator) -> None:
    """Columns of parameters that move one coordinate by themselves are columns of Pinocchio's frame Jacobian."""
    chain = bare_chain(robot, moment_frame)
    model = Model(chain, GEOMETRIC)
    conditions, build = one_payload(robot, 8, rng)
    values, augmented = values_of(model, conditions, rng), build(chain)
    _, jacobian = model.linearise(values, conditions, rows=6)
    places = [k - FRAME for k in geometric_coordinates(model)]
    expected = [augmented.jacobian(x)[:, places] for x in model.coordinates(values, conditions)]

    np.testing.assert_allclose(jacobian, expected, rtol=0.0, atol=EXACT)


def geometric_coordinates(model: Model) -> list[int]:
    """Return the coordinate that each geometric parameter moves, found by its name."""
    chain, found = model.chain, []
    for name in model.names:
        element, symbol = name.rsplit(".", 1)
        if not symbol.startswith("k_"):
            found.append(chain.joint(chain.robot.joint_names.index(element), symbol))
    return found


@pytest.mark.parametrize(("robot", "moment_frame"), ARMS_AND_FRAMES, indirect=["robot"])
def test_moments_about_the_drives_are_generalised_gravity(
    robot: Robot, moment_frame: MomentFrame, rng: np.random.Generator
) -> None:
    """The moment about each joint's axis is minus the generalised gravity of its theta, payload included."""
    chain = bare_chain(robot, moment_frame)
    model = Model(chain, GEOMETRIC)
    conditions, build = one_payload(robot, 8, rng)
    values, augmented = values_of(model, conditions, rng), build(chain)
    moments = model.static_moments(values, conditions)
    thetas = [chain.joint(i, "theta") - FRAME for i in range(robot.n_joints)]
    expected = np.array([augmented.moments(x)[thetas] for x in model.coordinates(values, conditions)])

    np.testing.assert_allclose(moments[:, 2::3], expected, rtol=0.0, atol=EXACT * np.abs(moments).max())


@pytest.mark.parametrize(("robot", "moment_frame"), ARMS_AND_FRAMES, indirect=["robot"])
def test_slopes_of_the_moments_are_pinocchios(robot: Robot, moment_frame: MomentFrame, rng: np.random.Generator) -> None:
    """Pinocchio's gravity derivatives are the central differences of the moments by the geometric parameters."""
    chain = bare_chain(robot, moment_frame)
    model = Model(chain, GEOMETRIC)
    conditions, build = one_payload(robot, 4, rng)
    values, augmented = values_of(model, conditions, rng), build(chain)
    thetas = [chain.joint(i, "theta") - FRAME for i in range(robot.n_joints)]
    places = [k - FRAME for k in geometric_coordinates(model)]
    slopes = np.array([augmented.moment_slopes(x)[np.ix_(thetas, places)] for x in model.coordinates(values, conditions)])
    h = 1e-4
    for p in range(model.n_parameters):
        step = np.zeros(model.n_parameters)
        step[p] = h
        ahead, behind = (model.static_moments(values + s, conditions) for s in (step, -step))
        numeric = (ahead - behind)[:, 2::3] / (2.0 * h)
        np.testing.assert_allclose(slopes[:, :, p], numeric, rtol=0.0, atol=1e-8 * np.abs(slopes).max())


@pytest.mark.parametrize(("robot", "moment_frame"), ARMS_AND_FRAMES, indirect=["robot"])
def test_jacobian_through_the_moments_is_pinocchios(
    robot: Robot, moment_frame: MomentFrame, rng: np.random.Generator
) -> None:
    """A geometric parameter also moves the tip by changing the moments: J_k + sum of J_gamma k dn/dx_k."""
    chain = bare_chain(robot, moment_frame)
    model = Model(chain, (*GEOMETRIC, catalogue.JointElasticity()))
    conditions, build = one_payload(robot, 6, rng)
    values, augmented = values_of(model, conditions, rng), build(chain)
    stiff = np.where([parameter.unit == "rad/(N m)" for parameter in model.parameters], 0.0, values)
    bent, straight = model.coordinates(values, conditions), model.coordinates(stiff, conditions)
    _, jacobian = model.linearise(values, conditions, rows=6)
    thetas, gammas, k = [], [], []
    for name in robot.measured_joints:
        i = robot.joint_names.index(name)
        thetas.append(chain.joint(i, "theta") - FRAME)
        gammas.append(chain.joint(i, "gamma_z") - FRAME)
        k.append(values[model.index(f"{name}.k_z")])
    places = [place - FRAME for place in geometric_coordinates(model)]
    for row in range(len(conditions)):
        J = augmented.jacobian(bent[row])
        slopes = augmented.moment_slopes(straight[row])[np.ix_(thetas, places)]
        expected = np.hstack(
            [J[:, places] + (J[:, gammas] * k) @ slopes, J[:, gammas] * augmented.moments(straight[row])[thetas]]
        )
        np.testing.assert_allclose(jacobian[row], expected, rtol=0.0, atol=EXACT * np.abs(expected).max())


# --- moments as sums written out ----------------------------------------------------------------------------------


def turn(axis: str, angle: float) -> np.ndarray:
    """Return a rotation about x, y or z, shape (4, 4)."""
    c, s = np.cos(angle), np.sin(angle)
    R = {
        "x": [[1, 0, 0], [0, c, -s], [0, s, c]],
        "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
        "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
    }
    T = np.eye(4)
    T[:3, :3] = R[axis]
    return T


def shift(x: float, z: float) -> np.ndarray:
    """Return a translation in the plane of x and z, shape (4, 4)."""
    T = np.eye(4)
    T[0, 3], T[2, 3] = x, z
    return T


def summed_moments(chain: Chain, x: np.ndarray, mass: float, centre: np.ndarray) -> np.ndarray:
    """Return the moments of one row of coordinates as sums of (c - o) x m g, shape (n, 3) (paper, Eq. (3)).

    "before" and "paper" express them in the frame before q, "after" in the one after q and the drive's own wind-up; the
    paper takes them about the frame's origin, the others about the bearing, and those of a carriage about where it is.
    """
    robot, links = chain.robot, {-1: np.eye(4)}
    origins, axes, places = [], [], []
    for i in range(robot.n_joints):
        at = {symbol: x[k] for symbol, k in chain.joint_coordinates(i).items()}
        T = links[robot.parents[i]] @ robot.frames.before(i)
        T = T @ np.block([[np.eye(3), np.array([[at.get("x", 0.0)], [at.get("y", 0.0)], [0.0]])], [np.eye(4)[3:]]])
        T = T @ turn("x", at["s_x"]) @ turn("y", at["s_y"])
        before, origin = T[:3, :3], T[:3, 3]
        # A carriage bears where it is, at a fixed distance from the end of d.
        height = at["d"] - at["h"] if robot.joint_types[i] == "prismatic" else at["h"]
        bend = shift(0.0, height) @ turn("y", at["gamma_y"]) @ turn("x", at["gamma_x"]) @ shift(0.0, -height)
        if chain.moment_frame == "before":
            T = T @ turn("z", at["gamma_z"]) @ bend @ turn("z", at["theta"])
        else:
            T = T @ turn("z", at["theta"] + at["gamma_z"])
        after = T[:3, :3]
        axes.append(after if chain.moment_frame == "after" else before)
        origins.append(origin + height * axes[-1][:, 2])
        T = T if chain.moment_frame == "before" else T @ bend
        T = T @ shift(at["a"], at["d"]) @ turn("x", at["alpha"])
        places.append(T[:3, :3] @ robot.centres[i] + T[:3, 3])
        links[i] = T
    T = links[chain.path.tip_joint] @ chain.path.T_joint_tip
    masses = [*robot.masses, mass]
    places.append(T[:3, :3] @ centre + T[:3, 3])
    out = np.zeros((robot.n_joints, 3))
    for i in range(robot.n_joints):
        carried = [b for b in range(robot.n_joints) if i in above(b, robot.parents)]
        carried += [robot.n_joints] if i in above(chain.path.tip_joint, robot.parents) else []
        total = sum(np.cross(places[b] - origins[i], masses[b] * chain.gravity) for b in carried)
        out[i] = axes[i].T @ total
    return out


@pytest.mark.parametrize("moment_frame", MOMENT_FRAMES)
def test_moments_are_sums_over_the_bodies_beyond(robot: Robot, moment_frame: MomentFrame, rng: np.random.Generator) -> None:
    """All three components of each moment are the sum of lever x weight, in the frame that the option says."""
    chain = bare_chain(robot, moment_frame)
    model, conditions = Model(chain, ELASTIC), conditions_of(robot, 8, rng, targets=1)
    values = values_of(model, conditions, rng)
    moments = model.static_moments(values, conditions)
    stiff = np.where([parameter.unit == "rad/(N m)" for parameter in model.parameters], 0.0, values)
    straight = model.coordinates(stiff, conditions)
    expected = [
        summed_moments(chain, x, mass, conditions.payload_centre).ravel()
        for x, mass in zip(straight, conditions.payload, strict=True)
    ]

    np.testing.assert_allclose(moments, expected, rtol=0.0, atol=EXACT * np.abs(moments).max())


@pytest.mark.parametrize("moment_frame", MOMENT_FRAMES)
def test_a_bearing_sits_where_the_urdf_has_the_joint(robot: Robot, moment_frame: MomentFrame) -> None:
    """Its height on the axis leads from the frame's origin to the joint; the paper has it at the origin."""
    chain, links = bare_chain(robot, moment_frame), {-1: np.eye(4)}
    for i, T_base_link in enumerate(robot.frames.T_base_link):
        T = links[robot.parents[i]] @ robot.frames.before(i)
        joint = (T_base_link @ robot.T_link_joint[i])[:3, 3]
        away = joint - T[:3, 3] - chain.bearing_heights[i] * T[:3, 2]
        if moment_frame == "paper":
            assert chain.bearing_heights[i] == 0.0
        else:
            np.testing.assert_allclose(away, 0.0, atol=2e-6)
        links[i] = T_base_link


@pytest.mark.parametrize("moment_frame", MOMENT_FRAMES)
def test_equilibrium_balances_on_the_bent_arm(robot: Robot, moment_frame: MomentFrame, rng: np.random.Generator) -> None:
    """Bent by tens of mrad, each elastic angle is its compliance times the moment on the arm as it is bent."""
    chain = bare_chain(robot, moment_frame)
    oblique = () if moment_frame == "paper" else tuple(ObliqueBearing(joint) for joint in robot.measured_joints)
    model, conditions = Model(chain, (*ELASTIC, *oblique), equilibrium=True), conditions_of(robot, 6, rng, targets=1)
    values = np.abs(values_of(model, conditions, rng))
    coordinates = model.coordinates(values, conditions)
    bending = np.zeros((len(conditions), robot.n_joints, 3))
    softness = np.zeros((robot.n_joints, 3, 3))
    for name in robot.measured_joints:
        i = robot.joint_names.index(name)
        for j, axis in enumerate("xyz"):
            bending[:, i, j] = coordinates[:, chain.joint(i, f"gamma_{axis}")]
            softness[i, j, j] = values[model.index(f"{name}.k_{axis}")]
        softness[i, 0, 1] = softness[i, 1, 0] = values[model.index(f"{name}.k_xy")] if oblique else 0.0
    moments = [
        summed_moments(chain, x, mass, conditions.payload_centre)
        for x, mass in zip(coordinates, conditions.payload, strict=True)
    ]
    wanted = np.einsum("iab,nib->nia", softness, np.array(moments))

    assert 5e-3 < np.abs(bending).max() < 0.1
    np.testing.assert_allclose(bending, wanted, rtol=0.0, atol=EXACT)
    straight = replace(model, equilibrium=False)
    assert np.abs(model.predict(values, conditions) - straight.predict(values, conditions)).max() > 1e-6


ONE_JOINT = (
    '<robot name="one"><link name="base"/><link name="lever"/><link name="tip"/>'
    '<joint name="lift" type="revolute"><parent link="base"/><child link="lever"/><origin xyz="0 0 0.4"/>'
    '<axis xyz="0 -1 0"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
    '<joint name="end" type="fixed"><parent link="lever"/><child link="tip"/><origin xyz="0.7 0 0"/></joint></robot>'
)


def one_joint(gravity: tuple[float, float, float]) -> tuple[Model, Conditions]:
    """Return a massless lever 0.7 m long that carries 10 kg, its centre 0.1 m beyond the tip and 0.2 m above it."""
    robot = replace(Robot.from_urdf(ONE_JOINT.encode()), masses=np.zeros(1))
    model = Model(Chain.of(robot, gravity=np.array(gravity)), (catalogue.JointElasticity(),))
    q = np.linspace(-1.5, 1.5, 13)[:, None]
    return model, Conditions.at(q, payload=10.0, payload_centre=(0.1, 0.0, 0.2))


def test_a_payload_pulls_the_lever_down() -> None:
    """The moment of a payload on a lever that a positive angle lifts is -m g (l cos q - h sin q)."""
    model, conditions = one_joint((0.0, 0.0, -G))
    q = conditions.q[:, 0]
    expected = -10.0 * G * (0.8 * np.cos(q) - 0.2 * np.sin(q))

    np.testing.assert_allclose(model.static_moments(np.zeros(1), conditions)[:, 2], expected, rtol=1e-13)
    bare = Conditions.at(conditions.q)
    np.testing.assert_array_equal(model.static_moments(np.zeros(1), bare), 0.0)


def test_a_compliant_lever_hangs_lower() -> None:
    """A compliance k turns the lever by k n: the tip stands at the angle q + k n(q)."""
    model, conditions = one_joint((0.0, 0.0, -G))
    k = 1e-4
    angle = conditions.q[:, 0] + k * model.static_moments(np.zeros(1), conditions)[:, 2]
    poses = model.predict(np.array([k]), conditions)

    np.testing.assert_allclose(poses[:, 0, 3], 0.7 * np.cos(angle), rtol=0.0, atol=EXACT)
    np.testing.assert_allclose(poses[:, 2, 3], 0.4 + 0.7 * np.sin(angle), rtol=0.0, atol=EXACT)


def test_gravity_turned_by_90_degrees_pulls_sideways() -> None:
    """On a wall, gravity along the base's x, the moment is -m g (l sin q + h cos q)."""
    model, conditions = one_joint((G, 0.0, 0.0))
    q = conditions.q[:, 0]
    expected = -10.0 * G * (0.8 * np.sin(q) + 0.2 * np.cos(q))

    np.testing.assert_allclose(model.static_moments(np.zeros(1), conditions)[:, 2], expected, rtol=0.0, atol=1e-12)


def test_gravity_along_the_axis_makes_no_moment_about_it() -> None:
    """With gravity along the joint's axis the drive feels nothing, the bearing all."""
    model, conditions = one_joint((0.0, G, 0.0))
    moments = model.static_moments(np.zeros(1), conditions)

    np.testing.assert_allclose(moments[:, 2], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.hypot(moments[:, 0], moments[:, 1]), 10.0 * G * np.hypot(0.8, 0.2), rtol=1e-13)


def test_a_tilted_mount_in_the_urdf_is_gravity_turned() -> None:
    """A robot mounted on a wall by its URDF bends as the upright one under gravity turned the other way."""
    wall = ONE_JOINT.replace("base", "plate").replace(
        '<link name="plate"/>',
        '<link name="floor"/><link name="plate"/><joint name="mount" type="fixed"><parent link="floor"/>'
        '<child link="plate"/><origin rpy="0 1.5707963267948966 0"/></joint>',
    )
    mounted = replace(Robot.from_urdf(wall.encode(), base="plate"), masses=np.zeros(1))
    model, conditions = one_joint((G, 0.0, 0.0))

    np.testing.assert_allclose(mounted.gravity, [G, 0.0, 0.0], atol=1e-14)
    on_the_wall = model.with_chain(Chain.of(mounted))
    values = np.array([1e-4])
    np.testing.assert_allclose(
        on_the_wall.predict(values, conditions), model.predict(values, conditions), rtol=0.0, atol=EXACT
    )


def test_moments_scale_with_gravity(robot: Robot, rng: np.random.Generator) -> None:
    """Without gravity nothing bends; with twice the gravity the moments double."""
    conditions = conditions_of(robot, 4, rng)
    moments = {
        factor: Model(chain_of(robot, gravity=factor * TILTED), ()).static_moments(np.zeros(0), conditions)
        for factor in (0.0, 1.0, 2.0)
    }

    assert np.all(moments[0.0] == 0.0) and np.abs(moments[1.0]).max() > 1.0
    np.testing.assert_allclose(moments[2.0], 2.0 * moments[1.0], rtol=1e-12, atol=1e-12)


# --- against the machines of the simulator, which share no code ---------------------------------------------------


@pytest.mark.parametrize("with_elasticity", [False, True])
def test_the_papers_machine_is_predicted(kuka: Robot, with_elasticity: bool, rng: np.random.Generator) -> None:
    """With the real values of Table I the model puts the flange where the paper's equations do, bending included."""
    model = Model(Chain.of(kuka, gravity=np.array([0.0, 0.0, -sim.paper_machine.GRAVITY])), ELASTIC)
    values = np.zeros(model.n_parameters)
    for i, joint in enumerate(kuka.joint_names):
        for letter, symbol in {"o": "theta", "a": "a", "d": "d", "alpha": "alpha", "s_x": "s_x", "s_y": "s_y"}.items():
            change = sim.paper_machine.REAL[letter][i] - sim.paper_machine.NOMINAL[letter][i]
            values[model.index(f"{joint}.{symbol}")] = change
        for symbol, compliances in sim.paper_machine.ELASTICITY.items():
            values[model.index(f"{joint}.{symbol}")] = compliances[i] * with_elasticity
    q = kuka.random_configurations(20, rng)
    payload, centre = sim.paper_machine.PAYLOAD_MASS, sim.paper_machine.PAYLOAD_COM
    conditions = Conditions.at(q, payload=payload, payload_centre=centre)

    moments = sim.paper_moments(q).reshape(len(q), -1)
    np.testing.assert_allclose(model.static_moments(values, conditions), moments, rtol=0.0, atol=1e-9)
    expected = sim.paper_transform(q, with_elasticity=with_elasticity)[:, :3]
    np.testing.assert_allclose(model.predict(values, conditions), expected, rtol=0.0, atol=EXACT)


@pytest.mark.parametrize("moment_frame", ["before", "after"])
def test_bearings_that_give_way_all_round_bend_as_the_true_machine(
    kuka: Robot, moment_frame: MomentFrame, rng: np.random.Generator
) -> None:
    """Bearings as soft about x as about y, and soft drives, move the tip as the simulator's equilibrium does."""
    k = np.array([[3e-8, 3e-8, 5e-8], [2e-8, 2e-8, 4e-8], [1e-8, 1e-8, 6e-8], *[[4e-8, 4e-8, 2e-8]] * 3])
    machine = sim.TrueMachine.from_urdf(kuka_urdf_path(), tip=kuka.tip, compliance=k, moment_frame=moment_frame)
    model = Model(Chain.of(kuka, moment_frame=moment_frame), ELASTIC, equilibrium=True)
    values = np.zeros(model.n_parameters)
    for joint, row in zip(kuka.joint_names, k, strict=True):
        for axis, compliance in zip("xyz", row, strict=True):
            values[model.index(f"{joint}.k_{axis}")] = compliance
    q = kuka.random_configurations(20, rng)
    poses = model.predict(values, Conditions.at(q, payload=100.0, payload_centre=(0.1, 0.0, 0.2)))
    truth = machine.tip(q, payload=100.0, payload_com=(0.1, 0.0, 0.2))
    nominal = kuka.forward_kinematics(q)

    # Bending is some 0.5 mm; the order in which a joint's three angles follow each other is of second order in it.
    bending = np.abs(truth[:, :3, 3] - nominal[:, :3, 3]).max()
    assert bending > 2e-4
    np.testing.assert_allclose(poses[:, :, 3], truth[:, :3, 3], rtol=0.0, atol=2e-3 * bending)


# --- the calibrated robot as a pin.Model --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "tip", "base"),
    [
        ("ur10", None, None),
        ("panda", None, None),
        ("double_pendulum_continuous", None, None),
        ("tiago", "arm_tool_link", None),
        ("talos", "arm_right_7_link", "torso_2_link"),
        ("kinova", "j2s6s200_end_effector", "j2s6s200_link_base"),
    ],
)
def test_calibrated_pinocchio_model_has_the_same_tip(
    name: str, tip: str | None, base: str | None, rng: np.random.Generator
) -> None:
    """The robot's own pin.Model with calibrated placements puts the tip where the rigid model has it."""
    robot = Robot.from_urdf(name, tip=tip, base=base)
    model = Model(Chain.of(robot), ELASTIC)
    conditions = Conditions.at(robot.random_configurations(8, rng), payload=2.0)
    values = values_of(model, conditions, rng)
    rigid = model.with_effects(GEOMETRIC)
    expected = rigid.predict(values[: rigid.n_parameters], conditions)
    calibrated = pinocchio_model(model, values)
    data = calibrated.createData()
    found = []
    for q in conditions.q:
        pin.framesForwardKinematics(calibrated, data, robot.configuration(calibrated, q))
        base_frame = data.oMf[calibrated.getFrameId(robot.base, pin.BODY)]
        found.append((base_frame.inverse() * data.oMf[calibrated.getFrameId(robot.tip, pin.BODY)]).homogeneous[:3])

    assert list(calibrated.names) == list(robot.pinocchio_model().names)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=EXACT)
    nominal = robot.forward_kinematics(conditions.q)[:, :3]
    assert np.abs(nominal - expected).max() > 1e-3


def test_nominal_values_leave_the_pinocchio_model_as_it_is(robot: Robot) -> None:
    """With no deviations every joint of the calibrated model stands where the URDF has it."""
    model = Model(Chain.of(robot), GEOMETRIC)
    calibrated, nominal = pinocchio_model(model, np.zeros(model.n_parameters)), robot.pinocchio_model()
    for joint in robot.joint_names:
        i = nominal.getJointId(joint)
        np.testing.assert_allclose(
            calibrated.jointPlacements[i].homogeneous, nominal.jointPlacements[i].homogeneous, rtol=0.0, atol=EXACT
        )
    placed, tip = joint_placements(model, np.zeros(model.n_parameters))
    assert placed.shape == (robot.n_joints, 4, 4) and tip.shape == (4, 4)


def test_an_unknown_moment_frame_is_refused() -> None:
    """A moment frame that does not exist is answered with those that do."""
    with pytest.raises(ValueError, match="'middle'; expected one of paper, before, after"):
        Chain.of(ARMS["kuka"](), moment_frame="middle")  # type: ignore[arg-type]


def test_compiling_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    """Whoever waits for the loops to be compiled reads why, and only once; what others compile is not our business."""
    told, compiling = compiled._Compiling(kernels.__name__), []
    ours, other = ({"dispatcher": function} for function in (kernels.evaluate, njit(lambda: 0)))
    with caplog.at_level("INFO"):
        for data, status in (
            (other, "START"),
            (ours, "START"),
            (ours, "START"),
            (ours, "END"),
            (other, "END"),
            (ours, "END"),
        ):
            told.notify(event.Event("numba:compile", EventStatus[status], data))
            compiling.append(not gc.isenabled())
    assert [record.getMessage()[:14] for record in caplog.records] == ["compiling once"]
    assert compiling == [False, True, True, True, True, False]


def test_a_session_of_python_is_told_that_loops_are_compiled(caplog: pytest.LogCaptureFixture) -> None:
    """Where nobody reads the log a warning says it, and it stops nothing where warnings are errors."""
    words = {"dispatcher": kernels.evaluate}
    caplog.set_level("WARNING", logger="pincal")
    for is_error in (False, True):
        told = compiled._Compiling(kernels.__name__)
        with warnings.catch_warnings(record=True) as seen:
            warnings.simplefilter("error" if is_error else "always")
            for status in ("START", "END"):
                told.notify(event.Event("numba:compile", EventStatus[status], words))
        assert [f"{each.category.__name__}: {each.message}"[:38] for each in seen] == [
            "PincalWarning: pincal is compiling once"[:38]
        ] * (not is_error)


def test_an_effect_is_asked_once_for_its_terms_over_the_same_poses(kuka: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """By all models that have it, whatever their values; over other poses, or in another convention, it is asked again."""
    asked = []
    terms = JointOffset.terms

    def count(self, chain, conditions, moments):
        asked.append(len(conditions))
        return terms(self, chain, conditions, moments)

    monkeypatch.setattr(JointOffset, "terms", count)
    chain, offset = Chain.of(kuka), JointOffset()
    model, other = Model(chain, (offset,)), Model(chain, (offset, LinkGeometry()))
    q = kuka.random_configurations(7, np.random.default_rng(0))
    conditions = Conditions.at(q)
    zero, moved = np.zeros(model.n_parameters), np.full(model.n_parameters, 1e-3)
    first, second = model.predict(zero, conditions), model.predict(moved, conditions)
    other.predict(np.zeros(other.n_parameters), conditions)
    assert asked == [7]
    assert not np.allclose(first, second)
    np.testing.assert_array_equal(model.predict(zero, Conditions.at(q[:3])), first[:3])
    assert asked == [7, 3]
    for _ in range(2):
        across = model.with_chain(chain.with_moment_frame("before"))
        across.predict(zero, conditions)
        across.with_chain(across.chain.with_moment_frame("paper")).predict(zero, conditions)
    assert asked == [7, 3, 7]


def test_how_far_effects_move_coordinates_is_asked_once(kuka: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same whether together or each by itself, and over parts of the rows that of the parts."""
    chain, conditions = Chain.of(kuka), Conditions.at(kuka.random_configurations(12, np.random.default_rng(0)))
    model = Model(chain, ELASTIC)
    parts, acts = largest_bases(model, conditions, np.array([0, 5]))
    whole, acted = largest_basis(model, conditions)
    np.testing.assert_array_equal(parts.max(axis=0), whole)
    np.testing.assert_array_equal(acts.any(axis=0), acted)
    monkeypatch.setattr(sizes, "_largest_bases", None)
    each = [largest_basis(Model(chain, (effect,)), conditions) for effect in reversed(ELASTIC)]
    np.testing.assert_array_equal(np.concatenate([size for size, _ in reversed(each)]), whole)
    np.testing.assert_array_equal(np.concatenate([acts for _, acts in reversed(each)]), acted)


def test_a_bearing_that_feels_a_moment_of_rounding_is_not_made_of_rubber() -> None:
    """About a vertical axis a UR's second bearing feels 1e-14 N m: its compliance is small, not 1e11 rad/(N m)."""
    robot = Robot.from_urdf("ur5")
    poses = Conditions.at(robot.random_configurations(40, np.random.default_rng(0)))
    model = Model(Chain.of(robot).with_moment_frame("before"), (catalogue.BearingElasticity(("shoulder_lift_joint",)),))
    largest, excited = largest_basis(model, poses)

    assert excited.tolist() == [True, False]
    assert 1e-3 < largest[1] < largest[0]


def test_moments_of_rounding_size_no_prior(tmp_path: Path, rng: np.random.Generator) -> None:
    """Where no centre of mass is beside the axis of its joint, moments of 1e-31 N m gave compliances of 1e28 rad/(N m)."""
    link = (
        '<link name="l{0}"><inertial><mass value="9"/><origin xyz="0 0 {1}"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )
    joint = (
        '<joint name="j{1}" type="continuous"><parent link="l{0}"/><child link="l{1}"/><axis xyz="{2}"/>'
        '<origin xyz="0 0 {3}"/></joint>'
    )
    parts = [link.format(i, at) for i, at in enumerate((0, 0.45, 0))]
    parts += [joint.format(0, 1, "0 0 1", 0.2), joint.format(1, 2, "0 1 0", 0.9)]
    urdf = tmp_path / "balanced.urdf"
    urdf.write_text(f'<robot name="balanced">{"".join(parts)}</robot>')
    model = Model(Chain.of(Robot.from_urdf(urdf)), ELASTIC)
    poses = Conditions.at(rng.uniform(-3.0, 3.0, (40, 2)))
    assert np.abs(model.static_moments(np.zeros(model.n_parameters), poses)).max() < 1e-13

    largest, excited = largest_basis(model, poses)

    np.testing.assert_array_equal(largest, 1.0)
    assert not excited[[i for i, name in enumerate(model.names) if ".k_" in name]].any()
