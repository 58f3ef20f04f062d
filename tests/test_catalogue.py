"""The catalogue: every effect's contract on three arms, and each against the independent machine with that effect."""

from __future__ import annotations

import importlib
import json
import pkgutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, cached_property

import msgspec
import numpy as np
import pytest
from pairs import in_pairs
from scipy.spatial.transform import Rotation

from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.discover.discovery_file import EffectName
from pincal.errors import BadInputError
from pincal.io.entries import EFFECTS as REGISTERED
from pincal.io.entries import ModelEntry, effect_from_entry, effect_to_entry, plain, restoring
from pincal.io.strict_json import MODEL_FILE, built
from pincal.measure.approach import moves_by_order
from pincal.model import catalogue
from pincal.model.catalogue import (
    AxisWobble,
    Backlash,
    BaseDrift,
    BaseElasticity,
    BearingPlace,
    EncoderSubdivision,
    FrictionWindup,
    GearEccentricity,
    GearRatio,
    GearRipple,
    GravityCompensator,
    Hysteresis,
    InstrumentAzimuth,
    InstrumentClock,
    InstrumentElevation,
    InstrumentRange,
    InstrumentStretch,
    InstrumentTilt,
    JointCoupling,
    JointCreep,
    JointLag,
    LinkBending,
    LinkMass,
    LoadBacklash,
    MeasurementScale,
    NonlinearElasticity,
    ObliqueBearing,
    PayloadError,
    ServoDroop,
    ShortOfTarget,
    SmoothRemainder,
    ThermalExpansion,
    ThermalGrowth,
    ThermalOffset,
    TransmissionError,
    candidates,
    untestable,
)
from pincal.model.catalogue.candidates import find_effect
from pincal.model.catalogue.unnamed import Unnamed
from pincal.model.chain import Chain, MomentFrame
from pincal.model.conditions import Conditions, PoseSet
from pincal.model.effect import Discoverable, Effect, Harmonic, Reducible
from pincal.model.effect_registry import meaning_of
from pincal.model.effects import ELASTIC, BaseFrame, JointElasticity, JointOffset, ToolFrame
from pincal.model.model import Model
from pincal.model.sizes import largest_basis
from pincal.parameters import FRAME_SYMBOLS
from pincal.robot.robot import Robot
from pincal.robot.urdf_file import find_file

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

EXACT = 1e-12
# Neither level nor along an axis, so that no moment vanishes by luck [m/s^2].
TILTED = np.array([2.0, -3.0, -9.0])
LEVEL = np.array([0.0, 0.0, -9.81])
ARMS = {"kuka": kuka_urdf_path, "ur10": lambda: find_file("ur10"), "panda": lambda: find_file("panda")}
PARAMS = ["kuka", pytest.param("ur10", marks=pytest.mark.long), "panda"]
# For what an effect says of itself on any arm: names, places, files.
SEVEN_JOINTS = [
    pytest.param("kuka", marks=pytest.mark.long),
    pytest.param("ur10", marks=[pytest.mark.long, pytest.mark.products]),
    "panda",
]
FRAMES: list[tuple[MomentFrame, bool]] = [("paper", False), ("paper", True), ("before", False), ("after", True)]
FRAME_PARAMS = [*FRAMES[::2], *(pytest.param(frame, marks=pytest.mark.long) for frame in FRAMES[1::2])]

# From the names of the joints of an arm.
Make = Callable[[tuple[str, ...]], Effect]
EFFECTS: dict[str, Make] = {
    "nonlinear_elasticity": lambda j: NonlinearElasticity(j[1]),
    "nonlinear_elasticity that stiffens": lambda j: NonlinearElasticity(j[1], stiffening=30.0),
    "oblique_bearing": lambda j: ObliqueBearing(j[2]),
    "bearing_place": lambda j: BearingPlace(j[2]),
    "link_bending": lambda j: LinkBending(j[1]),
    "link_mass": lambda j: LinkMass(),
    "link_mass of some": lambda j: LinkMass((j[1], j[-1])),
    "base_elasticity": lambda j: BaseElasticity(),
    "gravity_compensator": lambda j: GravityCompensator(j[1]),
    "payload_error": lambda j: PayloadError(),
    "payload_error of some": lambda j: PayloadError(j[1:4]),
    "payload_error seen by known compliances": lambda j: PayloadError(compliances=(1e-8, 2e-8, 2e-7) * len(j), shifted=True),
    "gear_eccentricity 1": lambda j: GearEccentricity(j[2], 1),
    "gear_eccentricity 2": lambda j: GearEccentricity(j[0], 2),
    "gear_ripple": lambda j: GearRipple(j[3], 20.5),
    "encoder_subdivision": lambda j: EncoderSubdivision(j[1], 40.0),
    "transmission_error": lambda j: TransmissionError(j[1], -1.0, 1.5, 9),
    "transmission_error periodic": lambda j: TransmissionError(j[3], -3.0, 3.1, 8, periodic=True),
    "gear_ratio": lambda j: GearRatio(j[3]),
    "joint_coupling": lambda j: JointCoupling(j[4], j[3]),
    "axis_wobble 1 before": lambda j: AxisWobble(j[0], 1),
    "axis_wobble 2 before": lambda j: AxisWobble(j[3], 2),
    "axis_wobble 1 after": lambda j: AxisWobble(j[3], 1, "after"),
    "axis_wobble 2 after": lambda j: AxisWobble(j[1], 2, "after"),
    "backlash": lambda j: Backlash(j[1]),
    "settling": lambda j: ShortOfTarget(j[1]),
    "load_backlash": lambda j: LoadBacklash(j[2], 15.0),
    "hysteresis": lambda j: Hysteresis(j[1]),
    "hysteresis with a preload": lambda j: Hysteresis(j[2], preload=10.0),
    "servo_droop": lambda j: ServoDroop(j[1]),
    "thermal_expansion": lambda j: ThermalExpansion(),
    "thermal_expansion of a link": lambda j: ThermalExpansion(j[1]),
    "thermal_expansion of the last": lambda j: ThermalExpansion(j[-1], reference=23.0),
    "thermal_offset": lambda j: ThermalOffset(j[2]),
    "joint_creep": lambda j: JointCreep(j[2], 7e3, 1e3),
    "joint_creep expanded": lambda j: JointCreep(j[2], 7e3, 1e3, expected=2e-4),
    "thermal_growth": lambda j: ThermalGrowth(7e3),
    "thermal_growth of a link, expanded": lambda j: ThermalGrowth(7e3, j[1], expected=1e-4),
    "base_drift": lambda j: BaseDrift(1500.0),
    "base_drift without turning": lambda j: BaseDrift(turns=False),
    "measurement_scale": lambda j: MeasurementScale(),
    "instrument_azimuth": lambda j: InstrumentAzimuth(),
    "instrument_azimuth 2": lambda j: InstrumentAzimuth(2),
    "instrument_elevation": lambda j: InstrumentElevation(),
    "instrument_elevation 2": lambda j: InstrumentElevation(2),
    "instrument_tilt": lambda j: InstrumentTilt(),
    "instrument_tilt with offsets": lambda j: InstrumentTilt(offsets=True),
    "instrument_range": lambda j: InstrumentRange(),
    "instrument_stretch": lambda j: InstrumentStretch(),
    "instrument_clock": lambda j: InstrumentClock(1.5e4),
    "instrument_clock without drift": lambda j: InstrumentClock(drifts=False),
    "joint_lag": lambda j: JointLag(j[2]),
    "friction_windup": lambda j: FrictionWindup(j[1], 0.1),
    "unnamed": lambda j: Unnamed(j[1], "gamma_x", j[2]),
    "unnamed waves": lambda j: Unnamed(j[1], "drive", j[2], "waves", order=3),
    "unnamed product": lambda j: Unnamed(j[1], "drive", j[2], "product"),
    "unnamed wave of two joints": lambda j: Unnamed(j[1], "drive", j[2], "product", order=2.5, own_order=1.4),
    "unnamed map": lambda j: Unnamed(j[1], "drive", j[2], "map", size=4),
    "unnamed field": lambda j: Unnamed(j[1], "drive", j[2], "field", lengths=(2.0, 1.5)),
    "smooth_remainder": lambda j: SmoothRemainder(tuple(j[:3]), 2, 1.0, 1e-4, 3),
    "unnamed step": lambda j: Unnamed(j[2], "drive", j[2], "step", place=0.1),
    "unnamed kink": lambda j: Unnamed(j[2], "drive", j[2], "kink", place=0.1),
    "unnamed of time": lambda j: Unnamed(j[1], "s_y", "time", lower=0.0, upper=3e4),
}


@cache
def arm(name: str) -> Robot:
    """Return one of the arms, read once."""
    return Robot.from_urdf(ARMS[name]())


@pytest.fixture(scope="module", params=PARAMS)
def robot(request: pytest.FixtureRequest) -> Robot:
    """Return each of the arms: industrial, parallel axes, seven joints."""
    return arm(request.param)


# Where a tracker stands in the robot's base frame [m].
TRACKER = np.array([-3.0, 2.5, 0.4])


def conditions_of(robot: Robot, n: int, rng: np.random.Generator, *, heaviest: float = 12.0) -> Conditions:
    """Return random poses of which everything is recorded and varies."""
    q = robot.random_configurations(n, rng)
    return Conditions(
        q,
        np.zeros(n, int),
        heaviest * rng.integers(0, 2, n),
        np.array([0.1, 0.0, 0.2]),
        temperature=rng.uniform(15.0, 35.0, n),
        time=np.sort(rng.uniform(0.0, 3e4, n)),
        approach=rng.choice([-1.0, 1.0], (n, robot.n_joints)),
        droop=1e-3 * np.random.default_rng(n).standard_normal((n, robot.n_joints)),
        move=moves_by_order(q),
        velocity=np.random.default_rng(n + 1).standard_normal((n, robot.n_joints)),
        sighted=robot.forward_kinematics(q)[:, :3, 3] - TRACKER,
    )


def chain_of(robot: Robot, moment_frame: MomentFrame = "paper") -> Chain:
    """Return a chain about random orientations of base and tool under tilted gravity."""
    turned = Rotation.random(2, random_state=3).as_matrix()
    return Chain.of(robot, moment_frame=moment_frame, gravity=TILTED).with_references(turned[0], turned[1:])


def surrounded(effect: Effect, chain: Chain, *, equilibrium: bool = False) -> Model:
    """Return the model of an effect beside geometry, elasticity, base and tool."""
    return Model(chain, (effect, *ELASTIC, BaseFrame(), ToolFrame(FRAME_SYMBOLS)), equilibrium=equilibrium)


def written_and_read(model: Model) -> Model:
    """Return a model written as JSON and read again."""
    text = json.dumps(plain(ModelEntry.of_model(model)))
    return built(text.encode(), ModelEntry, MODEL_FILE, file="model.json", hook=restoring()).model()


def units_of(model: Model, conditions: Conditions) -> np.ndarray:
    """Return how far a unit of each parameter moves its coordinate at most; moments are those of the nominal arm."""
    moments, start = model.static_moments(np.zeros(model.n_parameters), conditions), 0
    units = np.zeros(model.n_parameters)
    for effect in model.effects:
        for term in effect.terms(model.chain, conditions, moments if effect.uses_moments else None):
            largest = 1.0 if term.basis is None else np.abs(term.basis).max()
            units[start + term.parameter] = max(units[start + term.parameter], largest)
        for body in effect.bodies(model.chain):
            # A tenth of what the prior allows.
            units[start + body.parameter] = 0.03 / model.parameters[start + body.parameter].size
        start += len(effect.parameters(model.chain))
    floor = 0.05 * np.abs(moments).max()
    compliant = np.array([p.unit == "rad/(N m)" for p in model.parameters])
    return np.where(compliant, np.maximum(units, floor), np.where(units > 0.0, units, 1.0))


# --- the contract of every effect ---------------------------------------------------------------------------------


def test_every_effect_of_the_catalogue_is_under_test(kuka: Robot) -> None:
    """An effect that is added without being added here fails this test; all are known by name to model files."""
    classes = set(in_catalogue())

    assert {type(make(kuka.joint_names)) for make in EFFECTS.values()} == classes
    assert classes <= set(REGISTERED.known().values())
    assert {c.__name__ for c in classes} | {"candidates", "untestable"} == set(catalogue.__all__)


def in_catalogue() -> Iterator[type[Effect]]:
    """Yield every effect that a module of the catalogue defines, registered or not; private are what several share."""
    for module in pkgutil.iter_modules(catalogue.__path__, catalogue.__name__ + "."):
        for name, found in vars(importlib.import_module(module.name)).items():
            if isinstance(found, type) and issubclass(found, Effect) and found.__module__ == module.name and name[0] != "_":
                yield found


@pytest.mark.parametrize("robot", SEVEN_JOINTS, indirect=True)
@pytest.mark.parametrize("name", REGISTERED.known())
def test_an_effect_says_all_of_itself(robot: Robot, name: str, rng: np.random.Generator) -> None:
    """By being registered a class is under this test: its words, its places on an arm, its variants, its form in files."""
    cls, chain = REGISTERED.known()[name], chain_of(robot, "after")
    assert cls.name == name and cls.meaning and cls.meaning == meaning_of(name)
    if not issubclass(cls, Discoverable):
        return
    situation = PoseSet(chain, conditions_of(robot, 600, rng), (1e-8, 2e-8, 2e-7) * robot.n_joints)
    found = list(cls.candidates(situation))
    effects = [form for candidate in found for form in (candidate.effect, *candidate.forms)]

    assert found and all(type(effect) is cls for effect in effects)
    assert len({candidate.effect.identity for candidate in found}) == len(found)
    for candidate in found:
        assert {form.identity for form in candidate.forms} <= {candidate.effect.identity}
        assert candidate.forms or issubclass(cls, Harmonic), "only a wave has no form before its order is found"
        assert len(set(candidate.forms)) == len(candidate.forms)
        assert candidate.effect.locus.joint in {None, *robot.joint_names}
        name = EffectName.of(candidate.effect)
        assert msgspec.json.decode(msgspec.json.encode(name), type=EffectName) == name
    for effect in effects:
        assert effect_from_entry(json.loads(json.dumps(effect_to_entry(effect)))) == effect
        if isinstance(effect, Reducible):
            assert effect.reduced(situation).identity == effect.identity
            assert len(effect.reduced(situation).parameters(chain)) <= len(effect.parameters(chain))


def test_effects_are_the_same_whatever_their_resolution() -> None:
    """Identity tells places, variables, orders and frames apart, and nothing else."""
    coarse, fine = (TransmissionError("a", -1.0, upper, size) for upper, size in ((1.0, 8), (2.0, 20)))
    wobbles = {AxisWobble("a", order, frame).identity for order in (1, 2) for frame in ("before", "after")}

    assert coarse.identity == fine.identity != TransmissionError("b", -1.0, 1.0).identity
    assert len(wobbles) == 4
    assert JointCoupling("a", "b").identity != JointCoupling("a", "c").identity
    assert Unnamed("a", "drive", "a", "step", place=0.1).identity == Unnamed("a", "drive", "a", "step", place=0.2).identity
    assert JointCoupling("a", "b").heading == ("joint_coupling", "a", "b")
    assert Unnamed("a", "drive", "b").heading == ("unnamed", "a", None)


@pytest.mark.parametrize("robot", SEVEN_JOINTS, indirect=True)
@pytest.mark.parametrize("name", EFFECTS)
def test_parameters_and_terms_fit_each_other(robot: Robot, name: str, rng: np.random.Generator) -> None:
    """Names are unique beside those of the full model; each term belongs to a parameter and has a basis a pose."""
    effect, chain, conditions = EFFECTS[name](robot.joint_names), chain_of(robot), conditions_of(robot, 7, rng)
    model, n = surrounded(effect, chain), 3 * robot.n_joints
    terms = effect.terms(chain, conditions, rng.standard_normal((7, n)) if effect.uses_moments else None)
    parameters = effect.parameters(chain)

    assert len(set(model.names)) == model.n_parameters
    assert effect.name == name.split()[0] and repr(effect).startswith(type(effect).__name__ + "(")
    bodies = effect.bodies(chain)
    assert {of.parameter for of in (*terms, *bodies)} <= set(range(len(parameters))) and parameters
    assert all(0 <= body.joint < robot.n_joints and np.shape(body.moment) == (3,) for body in bodies)
    for parameter in parameters:
        assert parameter.name.rsplit(".", 1)[0] in {*robot.joint_names, "base", "arm", "instrument", "clock"}
        assert parameter.effect == effect.name
        if parameter.unit in ("kg", "kg m"):
            assert 0.0 <= parameter.nominal < 1e3 and 0.0 < parameter.size < 1e3
        else:
            # The place of a bearing is known to a link's length.
            size = 1.0 if parameter.name.endswith(".h") else 1e-2
            # A clock may be off by anything, as what stands anywhere.
            size = np.inf if parameter.is_extrinsic else size
            is_constant = parameter.name.endswith("_tau")
            assert (parameter.nominal == 0.0) == (not is_constant) and 0.0 < parameter.size <= size
    for term in terms:
        assert 0 <= term.coordinate < chain.size and (term.basis is None or term.basis.shape == (7,))
        assert term.moment is None or (0 <= term.moment < n and effect.uses_moments)


def test_effects_of_all_joints_have_names_of_their_own(robot: Robot, rng: np.random.Generator) -> None:
    """A model with all candidates at once has no name twice."""
    chain, conditions = Chain.of(robot), conditions_of(robot, 40, rng)
    model = Model(chain, (*candidates(chain, conditions), *ELASTIC, BaseFrame(), ToolFrame()))

    assert len(set(model.names)) == model.n_parameters


def test_zero_parameters_give_the_nominal_arm(robot: Robot, rng: np.random.Generator) -> None:
    """With all parameters zero the tip stands where Pinocchio has it, whatever the effect and the moment frame."""
    conditions = conditions_of(robot, 5, rng)
    nominal = robot.forward_kinematics(conditions.q)[:, :3]
    for make in EFFECTS.values():
        for frame, equilibrium in FRAMES:
            chain = Chain.of(robot, moment_frame=frame)
            model = Model(chain, (make(robot.joint_names),), equilibrium=equilibrium)
            poses = model.predict(np.zeros(model.n_parameters), conditions)
            np.testing.assert_allclose(poses, nominal, rtol=0.0, atol=EXACT, err_msg=repr(model.effects))


@pytest.mark.parametrize(
    ("name", "frame", "robot"),
    in_pairs(list(EFFECTS), FRAME_PARAMS, PARAMS),
    indirect=["robot"],
)
def test_jacobian_is_exact(robot: Robot, name: str, frame: tuple[MomentFrame, bool], rng: np.random.Generator) -> None:
    """The Jacobian equals central differences to 1e-6: an effect's own columns, and sums of all those beside it."""
    effect = EFFECTS[name](robot.joint_names)
    model = surrounded(effect, chain_of(robot, frame[0]), equilibrium=frame[1])
    # Moments of inertia are those of the nominal arm, whatever the parameters.
    conditions = replace(conditions_of(robot, 3, rng), inertial=rng.normal(0.0, 3.0, (3, robot.n_joints, 6)))
    units = units_of(model, conditions)
    values = 3e-3 * rng.uniform(-1.0, 1.0, model.n_parameters) / units
    own = len(effect.parameters(model.chain))
    # A column that is wrong is wrong in every sum, which the signs are drawn for.
    sums = np.vstack([np.zeros((own, 5)), 0.2 * rng.choice([-1.0, 1.0], (model.n_parameters - own, 5))])
    directions = np.hstack([np.eye(model.n_parameters)[:, :own], sums]) / units[:, None]
    poses, jacobian = model.linearise(values, conditions, rows=6)

    np.testing.assert_array_equal(poses, model.predict(values, conditions))
    assert_slopes(model, values, conditions, directions, jacobian @ directions)


def assert_slopes(
    model: Model, values: np.ndarray, conditions: Conditions, directions: np.ndarray, expected: np.ndarray
) -> None:
    """Compare the motion and turning of the target along directions, shape (P, K), with central differences, (N, 6, K)."""
    R = model.predict(values, conditions)[:, :, :3]
    for direction, slopes in zip(directions.T, expected.transpose(2, 0, 1), strict=True):
        step = 2e-5 * direction
        slope = (model.predict(values + step, conditions) - model.predict(values - step, conditions)) / 4e-5
        W = slope[:, :, :3] @ R.transpose(0, 2, 1)
        numeric = np.column_stack([slope[:, :, 3], W[:, 2, 1], W[:, 0, 2], W[:, 1, 0]])
        assert np.abs(slopes - numeric).max() < 1e-6 * (np.abs(numeric).max() + 1e-3)


@pytest.mark.parametrize("robot", SEVEN_JOINTS, indirect=True)
@pytest.mark.parametrize("name", EFFECTS)
def test_a_saved_model_is_the_same_model(robot: Robot, name: str, rng: np.random.Generator) -> None:
    """Written as JSON and read again, effects are equal and predict the same."""
    model, conditions = surrounded(EFFECTS[name](robot.joint_names), chain_of(robot)), conditions_of(robot, 4, rng)
    values = 1e-3 * rng.uniform(-1.0, 1.0, model.n_parameters) / units_of(model, conditions)
    again = written_and_read(model)

    assert again.effects == model.effects
    np.testing.assert_array_equal(again.predict(values, conditions), model.predict(values, conditions))


# --- against the machines of the simulator, which share no code ---------------------------------------------------

# Compliances of axes x, y, z [rad/(N m)] and the heaviest payload [kg].
SOFTNESS = {"kuka": (2e-8, 2e-8, 1e-7, 100.0), "ur10": (1e-7, 1e-7, 1e-6, 5.0), "panda": (1e-7, 1e-7, 1e-6, 5.0)}


class Comparison:
    """An arm and the true machine made of the same URDF, both elastic, in the same poses."""

    def __init__(self, name: str, *, gravity: np.ndarray = LEVEL, softness: tuple[float, ...] | None = None) -> None:
        *compliance, heaviest = SOFTNESS[name] if softness is None else softness
        self.robot = Robot.from_urdf(ARMS[name]())
        self.chain = Chain.of(self.robot, gravity=gravity)
        self.joints, self.compliance, self.heaviest = self.robot.joint_names, compliance, heaviest
        self.conditions = conditions_of(self.robot, 120, np.random.default_rng(1), heaviest=heaviest)
        self.machine = sim.TrueMachine.from_urdf(
            ARMS[name](),
            tip=self.robot.tip,
            base=self.robot.base,
            gravity=tuple(gravity),
            compliance=np.tile(compliance, (self.robot.n_joints, 1)),
        )

    def signal(self, *hidden: sim.HiddenEffect) -> np.ndarray:
        """Return what hidden effects do to the tip, motion [m] and turning [rad], shape (N, 6)."""
        true, plain = self._tip(*hidden), self._plain
        if self._moves(*hidden):
            plain = self._tip(sim.JointLag(joint=self.joints[0], size=0.0))
        turned = Rotation.from_matrix(true[:, :3, :3] @ plain[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
        return np.hstack([true[:, :3, 3] - plain[:, :3, 3], turned])

    @cached_property
    def _plain(self) -> np.ndarray:
        return self._tip()

    def _tip(self, *hidden: sim.HiddenEffect) -> np.ndarray:
        c = self.conditions
        recorded = {"temperature": c.temperature, "time": c.time, "approach": c.approach}
        recorded |= {"velocity": c.velocity} if self._moves(*hidden) else {}
        machine = self.machine.with_effects(*hidden)
        return machine.tip(c.q, payload=c.payload, payload_com=c.payload_centre, **recorded)

    @staticmethod
    def _moves(*hidden: sim.HiddenEffect) -> bool:
        """Return whether effects are of motion; other signals are of poses that are held."""
        return any(isinstance(effect, sim.JointLag | sim.FrictionWindup) for effect in hidden)

    def best(self, effect: Effect, signal: np.ndarray, beside: tuple[str, ...] = ()) -> tuple[np.ndarray, float]:
        """Return the effect's best parameters, and what they leave of a signal, shape (N, 3 or 6), relative to it.

        Args:
            effect: the effect.
            signal: what it has to explain.
            beside: names of parameters of the full model that are fitted with it.
        """
        model = surrounded(effect, self.chain)
        values = np.zeros(model.n_parameters)
        for joint in self.joints:
            for axis, k in zip("xyz", self.compliance, strict=True):
                values[model.index(f"{joint}.k_{axis}")] = k
        n = len(effect.parameters(self.chain))
        free = np.arange(model.n_parameters) < n
        free[[model.index(name) for name in beside]] = True
        jacobian = model.linearise(values, self.conditions, free=free, rows=signal.shape[1])[1]
        A = jacobian.reshape(signal.size, -1)
        scale = np.linalg.norm(A, axis=0)
        A, scale = A[:, scale > 0.0], scale[scale > 0.0]
        found = np.linalg.lstsq(A / scale, signal.ravel(), rcond=1e-10)[0] / scale
        return found[:n], float(np.linalg.norm(signal.ravel() - A @ found) / np.linalg.norm(signal))


@pytest.fixture(scope="module", params=PARAMS)
def comparison(request: pytest.FixtureRequest) -> Comparison:
    """Return each arm and its true machine."""
    return Comparison(request.param)


Pair = tuple[Callable[[tuple[str, ...]], sim.HiddenEffect], Make]
# On joints whose bearing stands at the origin of its frame, where the paper has it; on joint 3 of the Panda the URDF's joint
# is 0.3 m further along the axis.
# Hidden effect, its name in the catalogue, and the best parameters where each is the physical one.
SAME_FORM: dict[str, tuple[*Pair, list[float] | None]] = {
    "base_elasticity": (lambda j: sim.BaseElasticity(size=1e-8), lambda j: BaseElasticity(), [1e-8, 1e-8]),
    "gear_eccentricity 1": (
        lambda j: sim.GearEccentricity(joint=j[0], size=1e-4),
        lambda j: GearEccentricity(j[0], 1),
        [-1e-4 * np.cos(0.6), 1e-4 * np.sin(0.6)],
    ),
    "gear_eccentricity 2": (
        lambda j: sim.GearEccentricity(joint=j[2], size=1e-4, order=2),
        lambda j: GearEccentricity(j[2], 2),
        [1e-4 * np.cos(1.2), -1e-4 * np.sin(1.2)],
    ),
    "gear_ripple": (
        lambda j: sim.GearRipple(joint=j[0], size=1e-7, order=101.5),
        lambda j: GearRipple(j[0], 101.5),
        [-1e-7 * np.cos(0.6), 1e-7 * np.sin(0.6)],
    ),
    "encoder_subdivision": (
        lambda j: sim.EncoderSubdivision(joint=j[1], size=1e-7, order=256.0, offset=0.4),
        lambda j: EncoderSubdivision(j[1], 256.0),
        [0.0, -4e-8, -6e-8, 0.0],
    ),
    "gear_ratio": (lambda j: sim.GearRatio(joint=j[0], size=1e-4), lambda j: GearRatio(j[0]), [1e-4]),
    "joint_coupling": (
        lambda j: sim.JointCoupling(joint=j[4], source=j[3], size=1e-4),
        lambda j: JointCoupling(j[4], j[3]),
        [1e-4],
    ),
    "axis_wobble": (lambda j: sim.AxisWobble(joint=j[3], size=1e-4), lambda j: AxisWobble(j[3]), None),
    "axis_wobble ellipse": (
        lambda j: sim.AxisWobble(joint=j[3], size=1e-4, order=1, roundness=0.3),
        lambda j: AxisWobble(j[3], 1),
        None,
    ),
    "axis_wobble after": (
        lambda j: sim.AxisWobble(joint=j[3], size=1e-4, frame="after", roundness=0.3),
        lambda j: AxisWobble(j[3], 2, "after"),
        None,
    ),
    "axis_wobble as seen from the link": (
        lambda j: sim.AxisWobble(joint=j[3], size=1e-4),
        lambda j: AxisWobble(j[3], 1, "after"),
        None,
    ),
    "backlash": (lambda j: sim.Backlash(joint=j[1], size=2e-4), lambda j: Backlash(j[1]), [-1e-4]),
    "settling": (lambda j: sim.ShortOfTarget(joint=j[1], size=1e-4), lambda j: ShortOfTarget(j[1]), [-1e-4]),
    "hysteresis": (lambda j: sim.Hysteresis(joint=j[1], size=1e-8), lambda j: Hysteresis(j[1]), [-1e-8]),
    "hysteresis with a preload": (
        lambda j: sim.Hysteresis(joint=j[1], size=1e-8, preload=20.0),
        lambda j: Hysteresis(j[1], preload=20.0),
        [-1e-8],
    ),
    "joint_lag": (lambda j: sim.JointLag(joint=j[1], size=1e-4), lambda j: JointLag(j[1]), [1e-4]),
    "thermal_expansion": (lambda j: sim.ThermalExpansion(size=1e-5), lambda j: ThermalExpansion(), [1e-5]),
    "thermal_expansion of a link": (
        lambda j: sim.ThermalExpansion(joint=j[1], size=1e-5),
        lambda j: ThermalExpansion(j[1]),
        [1e-5],
    ),
    "thermal_expansion of the last": (
        lambda j: sim.ThermalExpansion(joint=j[-1], size=1e-5),
        lambda j: ThermalExpansion(j[-1]),
        [1e-5],
    ),
    "thermal_offset": (lambda j: sim.ThermalOffset(joint=j[1], size=1e-5), lambda j: ThermalOffset(j[1]), [1e-5]),
    "joint_creep": (lambda j: sim.JointCreep(joint=j[1], size=1e-4), lambda j: JointCreep(j[1], 3e3), [1e-4]),
    "thermal_growth": (lambda j: sim.ThermalGrowth(size=1e-4), lambda j: ThermalGrowth(3e3), [1e-4]),
    "thermal_growth of a link": (
        lambda j: sim.ThermalGrowth(joint=j[1], size=1e-4),
        lambda j: ThermalGrowth(3e3, j[1]),
        [1e-4],
    ),
    "base_drift": (
        lambda j: sim.BaseDrift(size=1e-8, rotation=(0.1, 0.2, 0.3)),
        lambda j: BaseDrift(),
        [8e-9, 6e-9, 0.0, 1e-9, 2e-9, 3e-9],
    ),
    "nonlinear_elasticity": (
        lambda j: sim.NonlinearElasticity(joint=j[1], size=1e-7, stiffening=50.0),
        lambda j: NonlinearElasticity(j[1], stiffening=50.0),
        [1e-7],
    ),
    "link_bending": (lambda j: sim.LinkBending(joint=j[1], size=1e-9), lambda j: LinkBending(j[1]), [1e-9]),
    "link_bending of the forearm": (
        lambda j: sim.LinkBending(joint=j[2], size=1e-9),
        lambda j: LinkBending(j[2]),
        [1e-9],
    ),
}


@pytest.mark.parametrize("name", SAME_FORM)
def test_the_true_machine_moves_as_predicted(comparison: Comparison, name: str) -> None:
    """The best parameters leave less than 0.1 % of what the hidden effect does, and are those of the mechanism."""
    hidden, make, expected = SAME_FORM[name]
    signal = comparison.signal(hidden(comparison.joints))
    found, left = comparison.best(make(comparison.joints), signal)

    assert left < 1e-3
    if expected is not None:
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=2e-3 * np.abs(expected).max())


def test_a_tilted_base_bends_about_its_origin() -> None:
    """Under tilted gravity the height of joint 1 above the base's origin is a lever of its own."""
    tilted = Comparison("panda", gravity=TILTED)
    found, left = tilted.best(BaseElasticity(), tilted.signal(sim.BaseElasticity(size=1e-7, weights=(1.0, 0.5, 0.0))))

    assert left < 1e-3
    np.testing.assert_allclose(found, [1e-7, 5e-8], rtol=5e-3)


@pytest.mark.parametrize("periodic", [True, False])
def test_random_curves_of_a_gear_are_followed(comparison: Comparison, periodic: bool) -> None:
    """A sum of random bumps is met to 2 % by 24 basis functions on a joint that turns as far as the curve repeats."""
    joint, q = comparison.joints[1], comparison.conditions.q[:, 1]
    once = np.abs(q).max() <= np.pi
    if not periodic and not once:
        effect = TransmissionError.over(joint, q, 60, periodic=False)
    else:
        effect = TransmissionError.over(joint, q, 24)
    hidden = sim.TransmissionError(joint=joint, size=1e-4, seed=4, periodic=periodic)

    assert effect.periodic == (np.ptp(q) > 0.9 * 2 * np.pi and (periodic or once))
    assert comparison.best(effect, comparison.signal(hidden))[1] < 0.02


def test_forms_that_differ_agree_where_they_should() -> None:
    """Mechanisms that no basis function repeats exactly are met to 2 %, beside the geometry that takes part of them."""
    kuka = Comparison("kuka")
    j = kuka.joints
    # The spring's torque has a mean, and harmonics beyond the second.
    spring = kuka.signal(sim.GravityCompensator(joint=j[1], size=2e4))
    assert kuka.best(GravityCompensator(j[1]), spring, beside=(f"{j[1]}.theta",))[1] < 0.02
    # A drive that stiffens as arcsinh against a quadratic one, beside the linear compliance.
    stiffening = kuka.signal(sim.NonlinearElasticity(joint=j[1], size=1e-7))
    found, left = kuka.best(NonlinearElasticity(j[1]), stiffening, beside=(f"{j[1]}.k_z",))
    assert left < 0.02 and found[0] < 0.0
    # v / sqrt(v^2 + u^2) against tanh; most joints are faster than both.
    friction = kuka.signal(sim.FrictionWindup(joint=j[1], size=1e-4, slow=0.01))
    found, left = kuka.best(FrictionWindup(j[1], 0.015), friction)
    assert left < 0.02
    np.testing.assert_allclose(found, [1e-4], rtol=0.01)
    # n / sqrt(n^2 + t^2) against tanh, of about the same width.
    found, left = kuka.best(LoadBacklash(j[2], 25.0), kuka.signal(sim.LoadBacklash(joint=j[2], size=2e-4)))
    assert left < 0.02
    np.testing.assert_allclose(found, [1e-4], rtol=0.01)


@pytest.mark.parametrize("name", ARMS)
def test_a_wrong_payload_bends_the_drives(name: str) -> None:
    """Of compliant drives p_z is compliance times relative error; a compliant bearing is not in the form."""
    stiff = Comparison(name, softness=(0.0, 0.0, *SOFTNESS[name][2:]))
    signal = stiff.signal(sim.PayloadError(size=0.1 * stiff.heaviest))
    effect = PayloadError.over(stiff.chain, stiff.conditions)
    found, left = stiff.best(effect, signal)

    assert effect.joints == stiff.joints[1:], "gravity exerts nothing about the vertical axis of joint 1"
    assert left < 0.02
    np.testing.assert_allclose(found, 0.1 * stiff.compliance[2], rtol=0.05)


def test_the_scale_of_an_instrument_is_that_of_the_links(comparison: Comparison) -> None:
    """With base and tool free, positions seen too long are links that are too long; with free links it adds nothing."""
    effect, constants = MeasurementScale(), [f"{element}.{axis}" for element in ("base", "tool") for axis in "xyz"]
    scaled = 2e-5 * comparison.machine.tip(comparison.conditions.q)[:, :3, 3]
    found, left = comparison.best(effect, scaled, beside=tuple(constants))
    assert left < 2e-3
    np.testing.assert_allclose(found, [2e-5], rtol=1e-3)

    model = surrounded(effect, comparison.chain)
    jacobian = model.linearise(np.zeros(model.n_parameters), comparison.conditions)[1].reshape(-1, model.n_parameters)
    lengths = [i for i, name in enumerate(model.names) if name.rsplit(".", 1)[1] in ("d", "a")]
    rest = np.linalg.lstsq(jacobian[:, lengths], jacobian[:, 0], rcond=1e-12)[0]
    np.testing.assert_allclose(jacobian[:, lengths] @ rest, jacobian[:, 0], rtol=0.0, atol=1e-10)


def test_elasticity_of_the_joints_takes_most_of_a_bent_link() -> None:
    """What a link's bending does to the tip is nearly all taken by compliances and geometry: it is hard to see."""
    kuka = Comparison("kuka")
    signal = kuka.signal(sim.LinkBending(joint=kuka.joints[1], size=1e-8))[:, :3]
    beside = [f"{joint}.k_{axis}" for joint in kuka.joints for axis in "xyz"]
    beside += [f"{joint}.{symbol}" for joint in kuka.joints for symbol in ("d", "a", "alpha", "s_x", "s_y")]

    assert kuka.best(JointOffset(), signal, beside=tuple(beside))[1] < 0.1


# --- single effects -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("effect", [LinkBending, lambda joint: BaseElasticity()])
def test_what_stands_before_q_does_not_depend_on_where_moments_are_taken(
    robot: Robot, effect: Callable[[str], Effect], rng: np.random.Generator
) -> None:
    """Links and base bend the same in all moment frames."""
    conditions, made = conditions_of(robot, 6, rng), effect(robot.joint_names[1])
    paper, *others = [Model(chain_of(robot, frame), (made,)) for frame in ("paper", "before", "after")]
    values = np.array([1e-5, 2e-5])[: paper.n_parameters]
    for other in others:
        np.testing.assert_allclose(
            other.predict(values, conditions), paper.predict(values, conditions), rtol=0.0, atol=EXACT
        )


@pytest.mark.parametrize("effect", [TransmissionError("j", -1.0, 1.5, 9), TransmissionError("j", -3.0, 3.1, 8, True)])
def test_a_curve_does_not_extrapolate(effect: TransmissionError) -> None:
    """Beyond the covered range a curve stays what it is at its end; within it the functions are independent."""
    inside = effect.basis(np.linspace(effect.lower, effect.upper, 200))
    outside = effect.basis(np.array([effect.lower - 2.0, effect.upper + 0.1, effect.upper + 5.0]))

    assert inside.shape == (effect.size, 200) and np.linalg.matrix_rank(inside) == effect.size
    np.testing.assert_array_equal(outside, inside[:, [0, -1, -1]])


def test_a_curve_over_nearly_a_turn_repeats() -> None:
    """The basis follows from the range that is covered, without large gaps; a periodic one has pairs of functions."""
    full, part = (TransmissionError.over("j", np.linspace(lower, 3.0, 50), 9) for lower in (-3.0, -1.0))
    holed = TransmissionError.over("j", np.append(np.linspace(-3.0, 1.0, 50), 3.0), 9)
    assert (full.periodic, full.size) == (True, 10) and (part.periodic, part.size) == (False, 9)
    assert (part.lower, part.upper) == (-1.0, 3.0)
    assert not holed.periodic
    assert not TransmissionError.over("j", np.array([-3.0, 3.0]), 9, periodic=False).periodic
    np.testing.assert_allclose(part.basis(np.linspace(-1.0, 3.0, 50)).sum(axis=0), 1.0, rtol=1e-14)


def test_load_backlash_changes_sides_within_two_percent_of_the_load() -> None:
    """The transition follows the largest moment seen; without any it keeps its default."""
    assert LoadBacklash.over("j", np.array([100.0, -500.0])).transition == pytest.approx(10.0)
    assert LoadBacklash.over("j", np.zeros(3)) == LoadBacklash("j")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: GearEccentricity("joint_1", 3), "order 3; expected 1 or 2"),  # type: ignore[arg-type]
        (lambda: GearRipple("joint_1", 0.0), "order 0; expected cycles per revolution, more than 0"),
        (lambda: AxisWobble("joint_1", 0), "order 0; expected 1 or 2"),  # type: ignore[arg-type]
        (lambda: AxisWobble("joint_1", 1, "middle"), "'middle'; expected before or after"),  # type: ignore[arg-type]
        (lambda: TransmissionError("joint_1", 1.0, 1.0), r"range 1.0 .. 1.0 is empty"),
        (lambda: TransmissionError("joint_1", 0.0, 1.0, 3), "size 3; expected at least 4"),
        (lambda: TransmissionError("joint_1", 0.0, 6.0, 7, periodic=True), "size 7; expected an even number"),
        (lambda: NonlinearElasticity("joint_1", -1.0), "stiffening -1.0 N m; expected more than 0"),
        (lambda: Unnamed("joint_1", "drive", "joint_2", "waves"), "waves need an order"),
        (lambda: Unnamed("joint_1", "drive", "joint_1", "step"), "a step needs a place"),
        (lambda: JointCreep("joint_1", 0.0), "joint_creep of joint_1: time constant 0 s; expected more than 0"),
        (lambda: LoadBacklash("joint_1", 0.0), "transition 0.0 N m; expected more than 0"),
    ],
)
def test_impossible_effects_are_refused(make: Callable[[], Effect], message: str) -> None:
    """A message names the joint, what was found and what is expected."""
    with pytest.raises(BadInputError, match=message):
        make()


def test_effects_that_do_not_fit_the_arm_are_refused(kuka: Robot) -> None:
    """The last link has no next joint; an unknown joint is answered with those that there are."""
    chain = Chain.of(kuka)
    with pytest.raises(ValueError, match="link_bending of joint_6: no joint follows its link; expected one of joint_1"):
        LinkBending("joint_6").parameters(chain)
    with pytest.raises(BadInputError, match="joint 'jont_2': not on this arm; expected one of joint_2"):
        Backlash("jont_2").parameters(chain)


@pytest.mark.parametrize(
    ("effect", "column"),
    [
        (Backlash("joint_2"), "approach_joint_2"),
        (ThermalOffset("joint_2"), "temperature"),
        (ThermalExpansion(), "temperature"),
        (BaseDrift(), "time"),
        (ServoDroop("joint_2"), "commanded_joint_2"),
        (ShortOfTarget("joint_2"), "time"),
        (JointCreep("joint_2", 1e3), "time"),
    ],
)
def test_a_column_that_is_not_there_is_named(kuka: Robot, effect: Effect, column: str) -> None:
    """Poses without a needed column can't be predicted; the message says which."""
    model, conditions = Model(Chain.of(kuka), (effect,)), Conditions.at(np.zeros((2, 6)))

    assert effect.missing(conditions) == effect.needs
    with pytest.raises(BadInputError, match=f"{effect.name} needs the column {column}"):
        model.predict(np.zeros(model.n_parameters), conditions)


UNNAMED = {
    "curve": lambda j: Unnamed(j[1], "s_x", j[1], lower=-1.0, upper=2.0, size=6),
    "map": lambda j: Unnamed(j[1], "drive", j[2], "map", -1.0, 2.0, 4, own_lower=-2.0, own_upper=1.0),
    "curve of time": lambda j: Unnamed(j[2], "drive", "time", lower=0.0, upper=3e4),
    "waves": lambda j: Unnamed(j[3], "gamma_y", j[0], "waves", order=2),
    "field": lambda j: Unnamed(j[1], "drive", j[2], "field", -1.0, 2.0, own_lower=-2.0, own_upper=1.0, lengths=(1.5, 1.0)),
    "product": lambda j: Unnamed(j[3], "drive", j[2], "product"),
    "wave of two joints": lambda j: Unnamed(j[3], "drive", j[2], "product", order=2.5, own_order=1.4),
    "step": lambda j: Unnamed(j[0], "drive", j[0], "step", place=0.3),
    "kink": lambda j: Unnamed(j[0], "drive", j[0], "kink", place=-0.2),
}


@pytest.mark.parametrize("name", UNNAMED)
def test_terms_without_a_name_are_effects_like_others(robot: Robot, name: str, rng: np.random.Generator) -> None:
    """As many functions as parameters, all independent; exact in the Jacobian; the same again from a model file."""
    effect, chain, conditions = UNNAMED[name](robot.joint_names), chain_of(robot), conditions_of(robot, 40, rng)
    terms = effect.terms(chain, conditions, None)
    model = surrounded(effect, chain)
    values = 1e-3 * rng.uniform(-1.0, 1.0, model.n_parameters) / units_of(model, conditions)
    again = written_and_read(model)
    few = conditions.select(np.arange(3))
    directions = np.diag(1.0 / units_of(model, few))[:, : len(terms)]

    assert [term.parameter for term in terms] == list(range(len(effect.parameters(chain))))
    assert np.linalg.matrix_rank(np.array([term.basis for term in terms])) == len(terms)
    assert again.effects == model.effects
    np.testing.assert_array_equal(again.predict(values, conditions), model.predict(values, conditions))
    assert_slopes(model, values, few, directions, model.linearise(values, few, rows=6)[1] @ directions)


def test_a_term_without_a_name_knows_its_column(kuka: Robot) -> None:
    """What follows time can't be predicted without it."""
    effect = Unnamed("joint_2", "drive", "time", lower=0.0, upper=10.0)
    model, conditions = Model(Chain.of(kuka), (effect,)), Conditions.at(np.zeros((2, 6)))

    assert effect.missing(conditions) == ("time",)
    with pytest.raises(BadInputError, match="depends on time, which these poses lack; add the column"):
        model.predict(np.zeros(model.n_parameters), conditions)


# --- what can be tried --------------------------------------------------------------------------------------------


def test_with_everything_recorded_nearly_everything_can_be_tried(robot: Robot, rng: np.random.Generator) -> None:
    """All effects are candidates, for all joints and sources, but those that gravity does not reach."""
    chain, conditions = Chain.of(robot), conditions_of(robot, 60, rng)
    found, n = candidates(chain, conditions), robot.n_joints
    counts = {name: sum(effect.name == name for effect in found) for name in {effect.name for effect in found}}

    # What else there is to know of bearings goes with their elasticity; lines of encoders are unknown.
    # What is smooth and has no name is no candidate, but what is left after them.
    others = {"unnamed", "smooth_remainder", "link_mass", "oblique_bearing", "bearing_place"}
    others |= {"encoder_subdivision", "instrument_clock"}
    assert set(counts) == {name.split()[0] for name in EFFECTS} - others
    assert counts["joint_coupling"] == n * (n - 1) and counts["gear_eccentricity"] == 2 * n
    assert counts["axis_wobble"] == 4 * n and counts["backlash"] == counts["thermal_offset"] == n
    first = robot.joint_names[0]
    reasons = {effect: reason for effect, reason in untestable(chain, conditions)}
    assert "gravity exerts no moment" in reasons[NonlinearElasticity(first)]
    assert "lines per revolution are unknown" in next(r for e, r in reasons.items() if isinstance(e, EncoderSubdivision))
    assert "could be compensated" in reasons[GravityCompensator(first)]
    assert not set(found) & set(reasons)
    excited = largest_basis(Model(chain, found), conditions)[1]
    owners = {p.name for p, moved in zip(Model(chain, found).parameters, excited, strict=True) if moved}
    assert all(any(p.name in owners for p in effect.parameters(chain)) for effect in found)


def test_what_can_not_be_tried_has_a_reason(kuka: Robot, rng: np.random.Generator) -> None:
    """Missing and constant columns, and joints that stand still, are told apart in words."""
    chain, full = Chain.of(kuka), conditions_of(kuka, 40, rng)
    q, approach = full.q.copy(), np.zeros_like(full.q)
    q[:, 3], approach[:, 0] = 0.3, rng.choice([-1.0, 1.0], 40)
    poor = replace(full, q=q, approach=approach, move=moves_by_order(q))
    poor = replace(poor, temperature=np.full(40, 21.0), time=None, payload=np.full(40, 8.0))
    reasons = dict(untestable(chain, poor))

    assert reasons[ThermalExpansion()] == "column temperature is constant"
    assert reasons[BaseDrift()] == "column time is missing"
    assert reasons[PayloadError.over(chain, poor)] == "column payload is constant"
    assert reasons[Backlash("joint_2")] == "column approach_joint_2 is missing or constant"
    assert reasons[ShortOfTarget("joint_4")].startswith("joint_4 does not move, or its direction of approach does not")
    assert "joint_4 does not move" in reasons[GearEccentricity("joint_4", 1)]
    assert "joint_4 does not move" in reasons[JointCoupling("joint_5", "joint_4")]
    found = candidates(chain, poor)
    assert Backlash("joint_1") in found and JointCoupling("joint_4", "joint_5") in found
    assert not any(isinstance(effect, TransmissionError) and effect.joint == "joint_4" for effect in found)


def test_an_effect_without_needs_misses_nothing(kuka: Robot) -> None:
    """The base class reports columns only for effects that need them."""
    bare = Conditions.at(np.zeros((3, 6)))

    assert JointElasticity().missing(bare) == () and GearRatio("joint_1").missing(bare) == ()
    assert PayloadError().missing(bare) == ("payload",)


@pytest.mark.parametrize("order", ["1e9", "nan", "inf", "0", "-3", "1_0", "many"])
def test_an_order_is_one_that_a_joint_can_have(kuka: Robot, rng: np.random.Generator, order: str) -> None:
    """More than nothing, and no more than any encoder has lines."""
    conditions = Conditions.at(kuka.random_configurations(30, rng))
    with pytest.raises(BadInputError, match=f"order={order}; expected a number of cycles .* at most 1e.06"):
        find_effect(f"gear_ripple:joint_a3:order={order}", Chain.of(kuka), conditions)
