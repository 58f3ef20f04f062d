"""Exports: each is read back by a tool that is not ours and compared with what the model predicts."""

from __future__ import annotations

import ctypes
import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import pytest
from _pytest.mark import ParameterSet
from command_line import run
from linkages import palletizer
from pairs import one_in_three
from scipy.spatial.transform import Rotation
from test_catalogue import ARMS, chain_of, conditions_of, surrounded, units_of
from test_catalogue import EFFECTS as ALL_EFFECTS

import pincal
from pincal.builtin import kuka_urdf_path
from pincal.calibration.covered import Covered
from pincal.calibration.discrepancy import Discrepancy
from pincal.calibration.fitted_robot import FittedRobot
from pincal.compensate.robot_frames import in_base_frame
from pincal.errors import BadInputError
from pincal.export import FORMATS, Exported, Format, c_source, export_model, numpy_source
from pincal.export.numpy_source import checked_formulas
from pincal.model.at_station import AtStation
from pincal.model.catalogue.bearing_features import ObliqueBearing
from pincal.model.catalogue.drives import AxisWobble
from pincal.model.chain import Chain, MomentFrame
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect, Locus, Term
from pincal.model.effect_registry import EFFECTS as KNOWN
from pincal.model.effects import ELASTIC, GEOMETRIC, BaseFrame, ToolFrame
from pincal.model.model import Model
from pincal.parameters import FRAME_SYMBOLS, Parameter, estimate_of
from pincal.robot.robot import Robot

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

# What a formula may differ by [m, elements of the rotation matrix].
EXACT = 1e-12
# For a controller's cycle [s].
FORWARD_TIME, COMPENSATION_TIME, UNCERTAINTY_TIME = 3e-6, 40e-6, 60e-6

DRIVER = """
#define _POSIX_C_SOURCE 199309L
#include "{name}.h"
#include <time.h>
static double now(void)
{{
  struct timespec t;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
  return t.tv_sec + 1e-9 * t.tv_nsec;
}}
double forward_all(int n, const {name}_state *states, double *poses)
{{
    double start = now();
    for (int i = 0; i < n; ++i)
        {name}_forward(states + i, poses + 12 * i);
    return (now() - start) / n;
}}
double compensate_all(int n, const double *wanted, int orientation, {name}_state *states, int *status)
{{
    double start = now();
    for (int i = 0; i < n; ++i)
        status[i] = {name}_compensate(wanted + 12 * i, orientation, states + i);
    return (now() - start) / n;
}}
"""
UNCERTAIN = """
double uncertainty_all(int n, const {name}_state *states, double *sigma)
{{
    double start = now();
    for (int i = 0; i < n; ++i)
        {name}_uncertainty(states + i, sigma + 3 * i);
    return (now() - start) / n;
}}
"""


@dataclass(frozen=True)
class Compiled:
    """An exported C source, compiled as a controller's would be."""

    library: ctypes.CDLL

    @classmethod
    def of(cls, calibrated: FittedRobot, folder: Path, frame: str = "instrument", *, optimised: bool = True) -> Compiled:
        """Export, compile without a warning, load; to optimise long sums takes a compiler ten times as long."""
        exported = export_model(calibrated, "c", folder, frame=frame)
        name = next(file for file in exported.files if file.endswith(".c")).removesuffix(".c")
        has_uncertainty = f"{name}_uncertainty" in exported.text
        driver = DRIVER + (UNCERTAIN if has_uncertainty else "")
        (folder / "driver.c").write_text(driver.format(name=name))
        flags = ["-std=c99", "-O2" if optimised else "-O0", "-Wall", "-Wextra", "-pedantic", "-Werror", "-fPIC", "-shared"]
        files = [folder / f"{name}.c", folder / "driver.c"]
        library = folder / f"{name}.so"
        subprocess.run(["cc", *flags, *files, "-o", library, "-lm"], check=True)
        found = ctypes.CDLL(str(library))
        found.forward_all.restype = found.compensate_all.restype = ctypes.c_double
        return cls(found)

    def forward(self, at: Conditions) -> tuple[np.ndarray, float]:
        """Return poses, shape (N, 3, 4), and seconds a pose."""
        states, poses = states_of(at), np.empty((len(at), 3, 4))
        return poses, self.library.forward_all(len(at), address(states), address(poses))

    def uncertainty(self, at: Conditions) -> tuple[np.ndarray, float]:
        """Return standard uncertainties, shape (N, 3), and seconds a pose."""
        states, sigma = states_of(at), np.empty((len(at), 3))
        self.library.uncertainty_all.restype = ctypes.c_double
        return sigma, self.library.uncertainty_all(len(at), address(states), address(sigma))

    def compensate(self, wanted: np.ndarray, at: Conditions, *, turn: bool = True) -> tuple[np.ndarray, np.ndarray, float]:
        """Return joint positions, shape (N, n), statuses, shape (N,), and seconds a pose."""
        states, status, poses = states_of(at), np.empty(len(at), np.int32), np.ascontiguousarray(wanted)
        seconds = self.library.compensate_all(len(at), address(poses), int(turn), address(states), address(status))
        return states["q"], status, seconds


# All but what is known only once a joint has been read back.
# Nor are errors of the instrument: a controller has none.
EFFECTS = {
    name: make
    for name, make in ALL_EFFECTS.items()
    if (effect := make(("j",) * 9)).locus.follows not in ("droop", "move") and not effect.is_sighted
}


def effects_in_frames() -> list[ParameterSet]:
    """Return effects in the frames in which moments are taken; of effects without moments two in three are products."""
    found = []
    for k, (name, make) in enumerate(EFFECTS.items()):
        effect = make(("j",) * 9)
        has_moments = effect.uses_moments or type(effect).bodies is not Effect.bodies
        for i, (frame, equilibrium) in enumerate([("paper", False), ("after", True), ("before", True)]):
            marks = () if has_moments or i == k % 3 else pytest.mark.products
            found.append(pytest.param(name, frame, equilibrium, marks=marks))
    return found


def states_of(at: Conditions) -> np.ndarray:
    """Return poses as the C struct has them."""
    n = at.q.shape[1]
    fields = [("q", "f8", n), ("payload", "f8"), ("temperature", "f8"), ("time", "f8"), ("approach", "f8", n)]
    out = np.zeros(len(at), np.dtype([*fields, ("target", "i4")], align=True))
    for name in out.dtype.names:
        column = getattr(at, name)
        out[name] = 0 if column is None else column
    return out


def address(array: np.ndarray) -> ctypes.c_void_p:
    """Return where an array stands."""
    return ctypes.c_void_p(array.ctypes.data)


def loaded(text: str) -> Callable[..., np.ndarray]:
    """Return the functions of an exported Python file, whose code has no pincal."""
    assert "pincal." not in text.split('"""', 2)[2] and "import pincal" not in text
    names: dict[str, Callable[..., np.ndarray]] = {}
    exec(text, names)
    return names


def columns_of(at: Conditions) -> dict[str, np.ndarray]:
    """Return what else a pose depends on, as the Python file takes it."""
    return {name: getattr(at, name) for name in ("payload", "temperature", "time", "approach", "target")}


def calibrated_of(model: Model, values: np.ndarray, payload_centre: tuple[float, ...] = (0.1, 0.0, 0.2)) -> FittedRobot:
    """Return a calibrated model with given values."""
    n = model.chain.robot.n_joints
    estimate = estimate_of(model.parameters, values, np.zeros((len(values), len(values))))
    covered = Covered(np.tile([-4.0, 4.0], (n, 1)), np.array([0.0, 12.0]))
    return FittedRobot.given(model, estimate, covered, sensor_kind="pose", payload_centre=payload_centre, sigma=(1.0, 1.0))


def drawn(effect: Effect | None, robot: Robot, *, frame: MomentFrame = "paper", equilibrium: bool = False) -> FittedRobot:
    """Return a calibrated model with an effect of about a milliradian beside the full elastic one."""
    rng = np.random.default_rng(5)
    model = surrounded(effect, chain_of(robot, frame), equilibrium=equilibrium)  # type: ignore[arg-type]
    units = units_of(model, conditions_of(robot, 50, rng))
    return calibrated_of(model, 1e-3 * rng.uniform(-1.0, 1.0, model.n_parameters) / units)


def everything(robot: Robot, *, equilibrium: bool = False) -> FittedRobot:
    """Return a calibrated model with all effects that the catalogue knows at once, seen by two targets."""
    rng, chain = np.random.default_rng(7), Chain.of(robot, moment_frame="after", targets=("ball", "prism"))
    made: list[Effect] = [*ELASTIC, BaseFrame(), ToolFrame(FRAME_SYMBOLS)]
    for effect in (make(robot.joint_names) for make in EFFECTS.values()):
        if not {p.name for p in effect.parameters(chain)} & set(Model(chain, tuple(made)).names):
            made.append(effect)
    model = Model(chain, tuple(made), equilibrium=equilibrium)
    units = units_of(model, conditions_of(robot, 50, rng))
    return calibrated_of(model, 2e-4 * rng.uniform(-1.0, 1.0, model.n_parameters) / units)


def poses_of(calibrated: FittedRobot, n: int, rng: np.random.Generator) -> Conditions:
    """Return poses of which everything is recorded and varies; they are held, as exported formulas have it."""
    at = conditions_of(calibrated.model.chain.robot, n, rng)
    return replace(at, velocity=None, inertial=None, target=rng.integers(0, len(calibrated.model.chain.targets), n))


# --- every effect of the catalogue --------------------------------------------------------------------------------


def check_python(calibrated: FittedRobot, rng: np.random.Generator) -> None:
    """Compare the exported Python file with the model."""
    at = poses_of(calibrated, 300, rng)
    forward = loaded(export_model(calibrated, "python").text)["forward"]
    np.testing.assert_allclose(forward(at.q, **columns_of(at)), calibrated.predict(at), rtol=0.0, atol=EXACT)


# All at once they are exported in every run.
@pytest.mark.parametrize("name", one_in_three(list(EFFECTS)))
def test_the_formula_of_every_effect_is_what_it_predicts(kuka: Robot, name: str, rng: np.random.Generator) -> None:
    """Of each effect alone, from its own code; one that can't be carried would be refused here."""
    full = drawn(EFFECTS[name](kuka.joint_names), kuka, frame="after")
    check_python(full.with_effects(lambda effect: effect is full.model.effects[0]), rng)


@pytest.mark.long
@pytest.mark.parametrize(("name", "frame", "equilibrium"), effects_in_frames())
def test_effects_work_together_in_formulas(
    kuka: Robot, name: str, frame: MomentFrame, equilibrium: bool, rng: np.random.Generator
) -> None:
    """Of each effect beside the elastic model, on straight and bent arm; of those with moments, in all moment frames."""
    check_python(drawn(EFFECTS[name](kuka.joint_names), kuka, frame=frame, equilibrium=equilibrium), rng)


def test_every_registered_effect_is_among_them(kuka: Robot) -> None:
    """What is registered is exported in these tests: by itself, in the full model, or at one station."""
    tried = {type(make(kuka.joint_names)).name for make in ALL_EFFECTS.values()}
    beside = {effect.name for effect in (*ELASTIC, BaseFrame(), ToolFrame())}
    ours = {name for name, cls in KNOWN.known().items() if cls.__module__.startswith("pincal.")}

    assert ours - tried - beside == {"at_station"}


def test_formulas_that_differ_from_the_model_are_refused(kuka: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """By more than a thousand times the rounding of a metre."""
    found = drawn(ALL_EFFECTS["gear_ratio"](kuka.joint_names), kuka)
    monkeypatch.setattr(numpy_source, "_error", lambda *_: 0.9e-12)
    assert numpy_source.refuse_wrong(found, text="") == 0.9e-12
    monkeypatch.setattr(numpy_source, "_error", lambda *_: 1.1e-12)
    with pytest.raises(BadInputError, match="expected at most 1e-12 m"):
        numpy_source.refuse_wrong(found, text="")


def test_what_is_known_only_afterwards_is_not_exported(kuka: Robot) -> None:
    """A controller that asks where a joint will stand has not read it back yet; the effect is named."""
    with pytest.raises(BadInputError, match="servo_droop needs the column commanded_"):
        export_model(drawn(ALL_EFFECTS["servo_droop"](kuka.joint_names), kuka), "python")
    with pytest.raises(BadInputError, match="settling needs the column time"):
        export_model(drawn(ALL_EFFECTS["settling"](kuka.joint_names), kuka), "python")


@pytest.mark.parametrize("frame", ["before", "after"])
def test_bearings_beside_the_origins_of_their_frames_are_exported(frame: MomentFrame, rng: np.random.Generator) -> None:
    """Two joints of the Panda sit a third of a metre along their axes, where their moments are taken."""
    for effect in (ObliqueBearing("panda_joint3"), AxisWobble("panda_joint3")):
        check_python(drawn(effect, Robot.from_urdf("panda"), frame=frame), rng)


def test_the_whole_catalogue_at_once_is_exported(kuka: Robot, rng: np.random.Generator) -> None:
    """One model with all effects, two targets."""
    check_python(everything(kuka), rng)


def share_formulas(calibrated: FittedRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let C and NumPy be written from the same formulas, whose making takes most of an export."""
    shared = cache(lambda frame: checked_formulas(calibrated, frame))
    for of in (numpy_source, c_source):
        monkeypatch.setattr(of, "checked_formulas", lambda _, frame: shared(frame))


@pytest.mark.long
# Each arm and each way before each commit, both ways of every arm before a release.
@pytest.mark.parametrize(
    ("arm", "equilibrium"),
    [
        pytest.param(arm, bent, marks=() if bent == (arm != "ur10") else pytest.mark.products)
        for bent in (False, True)
        for arm in ARMS
    ],
)
def test_compiled_c_is_the_model_with_all_effects(
    arm: str, equilibrium: bool, tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One model with the whole catalogue, two targets: C and NumPy agree with it, forward and back."""
    calibrated = everything(Robot.from_urdf(ARMS[arm]()), equilibrium=equilibrium)
    share_formulas(calibrated, monkeypatch)
    # Of one arm by all that a compiler does; the sums of the others are no longer.
    compiled = Compiled.of(calibrated, tmp_path, optimised=arm == "ur10")
    at = poses_of(calibrated, 1000, rng)
    source = loaded(export_model(calibrated, "python").text)
    true = calibrated.predict(at)
    seed = replace(at, q=at.q + rng.normal(0.0, 2e-3, at.q.shape))
    q, status, _ = compiled.compensate(true, seed)
    same, reached = source["compensate"](true, seed.q, **columns_of(at))
    there = status == 0
    arrived = calibrated.predict(replace(at, q=q))
    print(f"{arm}: C {np.abs(compiled.forward(at)[0] - true).max():.1e} m")

    np.testing.assert_allclose(compiled.forward(at)[0], true, rtol=0.0, atol=EXACT)
    np.testing.assert_allclose(source["forward"](at.q, **columns_of(at)), true, rtol=0.0, atol=EXACT)
    assert there.mean() > 0.97, "the others are singular or at a limit"
    np.testing.assert_allclose(arrived[there], true[there], rtol=0.0, atol=2e-10)
    np.testing.assert_array_equal(reached, there)
    np.testing.assert_allclose(same[there], q[there], rtol=0.0, atol=1e-7)
    np.testing.assert_array_equal(q[~there], seed.q[~there])


def test_c_is_exact_and_fast_enough_for_a_cycle(kuka: Robot, tmp_path: Path, rng: np.random.Generator) -> None:
    """The KUKA of the paper with all its elasticity at 10^4 poses: to 1e-12 m, in microseconds, nothing allocated."""
    calibrated = drawn(EFFECTS["transmission_error"](kuka.joint_names), kuka)
    compiled, at = Compiled.of(calibrated, tmp_path), poses_of(calibrated, 10_000, rng)
    true = calibrated.predict(at)
    seed = replace(at, q=at.q + rng.normal(0.0, 2e-3, at.q.shape))
    few = np.arange(1000)
    forward = min(compiled.forward(at.select(few))[1] for _ in range(20))
    compensation = min(compiled.compensate(true[few], seed.select(few))[2] for _ in range(5))
    error = np.abs(compiled.forward(at)[0] - true).max()
    print(f"C: {error:.1e} m at {len(at)} poses, {1e6 * forward:.2f} us forward, {1e6 * compensation:.1f} us compensation")

    assert error < EXACT and forward < FORWARD_TIME and compensation < COMPENSATION_TIME
    table = subprocess.run(["nm", tmp_path / f"{kuka.name}.so"], capture_output=True, text=True, check=True).stdout
    called = [line.split()[-1].split("@")[0] for line in table.splitlines() if " U " in line]
    assert set(called) <= {"sin", "cos", "sincos", "sqrt", "atan2", "fmax", "fmin", "clock_gettime", "__stack_chk_fail"}


@pytest.mark.parametrize("frame", ["instrument", pytest.param("base", marks=pytest.mark.long)])
def test_source_code_gives_the_uncertainty_of_predictions(
    kuka: Robot, frame: str, tmp_path: Path, rng: np.random.Generator
) -> None:
    """C and NumPy state the u that the model states, of parameters, drives that err, and arrival, in both frames."""
    bare = drawn(EFFECTS["transmission_error"](kuka.joint_names), kuka)
    mixed = 1e-5 * rng.standard_normal((len(bare.values), len(bare.values)))
    estimate = estimate_of(bare.model.parameters, bare.values, mixed @ mixed.T)
    drives = rng.uniform(0.0, 1e-8, (kuka.n_joints, 1))
    lacks = Discrepancy(lengths=np.array([0.2]), drives=drives, rest=1e-9, factor=1.2, coordinates=300)
    uncertain = replace(bare, estimate=estimate, discrepancy=lacks)
    at = poses_of(uncertain, 1000, rng)
    placed = in_base_frame(uncertain) if frame == "base" else uncertain
    expected = placed.position_sigma(at)
    source = loaded(export_model(uncertain, "python", frame=frame).text)
    np.testing.assert_allclose(source["uncertainty"](at.q, **columns_of(at)), expected, rtol=0.01)
    compiled = Compiled.of(uncertain, tmp_path, frame)
    sigma, _ = compiled.uncertainty(at)
    seconds = min(compiled.uncertainty(at)[1] for _ in range(20))
    np.testing.assert_allclose(sigma, expected, rtol=0.01)
    print(f"C: {1e6 * seconds:.2f} us a pose with {len(bare.values)} parameters")
    assert seconds < UNCERTAINTY_TIME


# --- frames, targets, refusals ------------------------------------------------------------------------------------


def test_poses_in_the_base_frame_need_no_instrument(kuka: Robot, rng: np.random.Generator) -> None:
    """With frame="base" poses are those of the robot alone: the instrument's pose times them is what it sees."""
    calibrated = drawn(EFFECTS["gear_ratio"](kuka.joint_names), kuka)
    at = poses_of(calibrated, 40, rng)
    seen, own = (loaded(export_model(calibrated, "python", frame=f).text)["forward"](at.q, **columns_of(at))
                 for f in ("instrument", "base"))  # fmt: skip
    square = [np.concatenate([poses, np.tile([[[0.0, 0.0, 0.0, 1.0]]], (40, 1, 1))], axis=1) for poses in (seen, own)]
    placed = square[0] @ np.linalg.inv(square[1])

    np.testing.assert_allclose(placed, np.broadcast_to(placed[0], placed.shape), rtol=0.0, atol=1e-12)
    with pytest.raises(BadInputError, match="frame 'flange'; expected instrument or base"):
        export_model(calibrated, "c", frame="flange")


def test_many_targets_are_exported(kuka: Robot, rng: np.random.Generator) -> None:
    """Which of 24 targets a pose is of is asked of one after the other, not of every combination of answers."""
    chain = Chain.of(kuka, targets=tuple(f"ball_{i}" for i in range(24)))
    model = Model(chain, (BaseFrame(), ToolFrame(FRAME_SYMBOLS)))
    check_python(calibrated_of(model, 1e-2 * rng.uniform(-1.0, 1.0, model.n_parameters)), rng)


def test_an_arm_of_few_joints_reaches_positions(rng: np.random.Generator, tmp_path: Path) -> None:
    """Position alone, in C and in NumPy; an orientation is refused where there are fewer than six joints."""
    robot = Robot.from_urdf("ur10", tip="wrist_1_link")
    calibrated = drawn(EFFECTS["gear_ratio"](robot.joint_names), robot)
    at = poses_of(calibrated, 200, rng)
    true, seed = calibrated.predict(at), replace(at, q=at.q + rng.normal(0.0, 1e-3, at.q.shape))
    compiled = Compiled.of(calibrated, tmp_path)
    q, status, _ = compiled.compensate(true, seed, turn=False)
    source = loaded(export_model(calibrated, "python").text)

    assert robot.n_joints == 4 and (status == 0).mean() > 0.97
    reached = calibrated.predict(replace(at, q=q))[status == 0, :, 3]
    np.testing.assert_allclose(reached, true[status == 0, :, 3], rtol=0.0, atol=2e-10)
    assert set(compiled.compensate(true, seed)[1]) == {3}
    with pytest.raises(ValueError, match="4 joints can't reach a position and an orientation"):
        source["compensate"](true, seed.q, **columns_of(at))


def test_what_is_out_of_reach_leaves_the_joints_alone(kuka: Robot, tmp_path: Path, rng: np.random.Generator) -> None:
    """A pose 10 m away is not reached, one beyond a limit is told from it; the state stays."""
    calibrated = drawn(EFFECTS["gear_ratio"](kuka.joint_names), kuka)
    compiled, at = Compiled.of(calibrated, tmp_path), poses_of(calibrated, 5, rng)
    away, edge = calibrated.predict(at), replace(at, q=np.tile(kuka.upper - 1e-4, (5, 1)))
    away[:, 0, 3] += 10.0
    beyond = calibrated.predict(replace(edge, q=edge.q + 2e-4))

    q, status, _ = compiled.compensate(away, at)
    assert set(status) == {3}
    np.testing.assert_array_equal(q, at.q)
    assert set(compiled.compensate(beyond, edge)[1]) == {1}


@pytest.mark.parametrize("nominal", [pytest.param(False, marks=pytest.mark.long), True])
def test_reached_is_what_the_model_confirms(kuka: Robot, nominal: bool, tmp_path: Path, rng: np.random.Generator) -> None:
    """Of 2000 orientations half a turn off, nearly so or by any turn, C and NumPy claim what the model confirms."""
    bare = calibrated_of(Model(Chain.of(kuka), ()), np.zeros(0))
    calibrated = bare if nominal else drawn(EFFECTS["gear_ratio"](kuka.joint_names), kuka)
    compiled, at = Compiled.of(calibrated, tmp_path), poses_of(calibrated, 2000, rng)
    source = loaded(export_model(calibrated, "python").text)
    axis = rng.normal(size=(2000, 3))
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    kind = np.arange(2000) % 8
    angle = np.array([np.pi, np.pi, np.pi, np.pi - 1e-9, np.pi - 1e-5, 2.0, 1e-3, 0.0])[kind]
    wanted = calibrated.predict(at)
    turned = Rotation.from_rotvec(angle[:, None] * axis).as_matrix() @ wanted[:, :, :3]
    # About an axis of the target: the product with the transposed pose is then symmetric to the last bit.
    turned[kind == 0] = wanted[kind == 0, :, :3] * [-1.0, -1.0, 1.0]
    turned[kind == 1] = wanted[kind == 1, :, :3] @ (2.0 * axis[:, :, None] * axis[:, None] - np.eye(3))[kind == 1]
    wanted[:, :, :3] = turned
    q, status, _ = compiled.compensate(wanted, at)
    for found, reached in ((q, status == 0), source["compensate"](wanted, at.q, **columns_of(at))):
        off = np.abs(calibrated.predict(replace(at, q=found)) - wanted).max(axis=(1, 2))

        assert off[reached].max() < 2e-10
        assert reached[angle < 1e-2].mean() > 0.9 and reached[angle > 3.0].any()


@pytest.mark.long
def test_a_wanted_pose_is_a_rotation(kuka: Robot, tmp_path: Path, rng: np.random.Generator) -> None:
    """Mirrored, stretched, empty and undefined orientations are refused, unless the orientation does not count."""
    calibrated = drawn(EFFECTS["gear_ratio"](kuka.joint_names), kuka)
    compiled, at = Compiled.of(calibrated, tmp_path), poses_of(calibrated, 5, rng)
    source = loaded(export_model(calibrated, "python").text)
    true = calibrated.predict(at)
    wanted = true.copy()
    wanted[0, :, 0] *= -1.0
    wanted[1, :, :3] *= 1.001
    wanted[2, :, :3] = 0.0
    wanted[3, 0, 0] = np.nan
    wanted[4, 0, 3] = np.inf
    q, status, _ = compiled.compensate(wanted, at)

    assert status.tolist() == [4] * 5
    np.testing.assert_array_equal(q, at.q)
    assert compiled.compensate(wanted, at, turn=False)[1].tolist() == [0] * 4 + [4]
    assert source["compensate"](wanted[:4], at.q[:4], **columns_of(at.select(slice(4))), orientation=False)[1].all()
    for i in range(5):
        mixed = true.copy()
        mixed[i] = wanted[i]
        with pytest.raises(
            ValueError, match=f"desired pose {i}: expected a rotation and a translation, all of them numbers"
        ):
            source["compensate"](mixed, at.q, **columns_of(at))
    with pytest.raises(ValueError, match=r"shape \(4, 3, 4\); expected \(5, 3, 4\)"):
        source["compensate"](wanted[:4], at.q, **columns_of(at))


def test_names_of_a_robot_are_no_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Names that end comments and texts stay names, in the file that is compiled and run to be compared, too."""
    monkeypatch.chdir(tmp_path)
    attack = '*/ """ \'\'\'\n__import__("os").mkdir("ran")\n#error ran \\'
    urdf = kuka_urdf_path().read_text(encoding="utf-8")
    for name in ("kuka_kr125_2", "joint_1"):
        urdf = urdf.replace(f'name="{name}"', f"name={quoteattr(name + attack)}")
    robot = Robot.from_urdf(urdf.encode())
    calibrated = drawn(EFFECTS["transmission_error"](robot.joint_names), robot)
    assert attack in robot.joint_names[0]
    source = export_model(calibrated, "python").text
    assert loaded(source)["JOINTS"][0] == "joint_1" + attack
    Compiled.of(calibrated, tmp_path)

    assert not (tmp_path / "ran").exists()


@pytest.mark.long
def test_a_python_file_says_what_it_needs(kuka: Robot) -> None:
    """Missing columns, wrong shapes and targets are named."""
    source = loaded(export_model(everything(kuka), "python").text)
    for given, message in (
        ({}, "this model needs approach, temperature, time"),
        ({"temperature": 20.0, "time": 0.0, "approach": 0.0, "target": 2}, "target 2; expected an index into TARGETS"),
    ):
        with pytest.raises(ValueError, match=message):
            source["forward"](np.zeros(6), **given)
    with pytest.raises(ValueError, match=r"shape \(1, 5\); expected \(N, 6\)"):
        source["forward"](np.zeros(5))


@dataclass(frozen=True)
class Tabulated(Effect):
    """An effect whose code needs the numbers themselves."""

    joint: str
    name = "tabulated"
    meaning = "reads a table"
    locus = property(lambda self: Locus(self.joint, "drive", self.joint))

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """One parameter."""
        return (Parameter(f"{self.joint}.table", "rad", self.name, 0.0, 1e-3),)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Look the position up."""
        q = conditions.q[:, chain.robot.joint_names.index(self.joint)]
        return (Term(0, int(chain.drives[0]), np.interp(q.astype(float), [-3.0, 3.0], [0.0, 1.0])),)


@dataclass(frozen=True)
class Counting(Tabulated):
    """An effect whose formula would be wrong: it depends on how many poses there are."""

    name = "counting"

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add the number of poses."""
        return (Term(0, int(chain.drives[0]), np.full(len(conditions), float(len(conditions)))),)


@pytest.mark.parametrize(("cls", "why"), [(Tabulated, "can't be exported as a formula"), (Counting, "formula differs")])
@pytest.mark.parametrize("format", ["c", "python"])
def test_an_effect_that_can_not_be_carried_is_refused_by_name(
    kuka: Robot, cls: type[Tabulated], why: str, format: str
) -> None:
    """It is never left out in silence, and never written wrongly."""
    model = Model(Chain.of(kuka), (EFFECTS["gear_ratio"](kuka.joint_names), cls("joint_1")))
    with pytest.raises(BadInputError, match=f"^{cls.name}: .*{why}"):
        export_model(calibrated_of(model, np.full(2, 1e-3)), format)


@cache
def of_loops() -> Model:
    """Return the geometry of an arm with closed loops."""
    return Model(Chain.of(Robot.from_urdf(palletizer(), tip="tool0")), GEOMETRIC)


@pytest.mark.parametrize("format", ["c", "python", "page"])
def test_loops_are_refused_as_formulas_in_words(format: str) -> None:
    """Their positions are found by iteration; the message says what carries them."""
    model = of_loops()
    with pytest.raises(BadInputError, match=r"closed loops \(rod_head, .* --urdf and --mjcf"):
        export_model(calibrated_of(model, np.zeros(model.n_parameters)), format)


def test_an_effect_from_outside_is_exported_too(kuka: Robot, rng: np.random.Generator) -> None:
    """A plugin says nothing of exports: its code is its formula."""
    path = Path(__file__).parents[1] / "examples" / "hose_pull.py"
    pincal.load_plugin(path)
    effect = KNOWN.known()["hose_pull"](kuka.joint_names[3], kuka.joint_names[2])
    calibrated = drawn(effect, kuka)
    at = poses_of(calibrated, 100, rng)
    forward = loaded(export_model(calibrated, "python").text)["forward"]

    np.testing.assert_allclose(forward(at.q, **columns_of(at)), calibrated.predict(at), rtol=0.0, atol=EXACT)


# --- the command --------------------------------------------------------------------------------------------------


def test_the_command_writes_all_that_is_asked_for(kuka: Robot, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Several formats at once; each says how far it is off and what it can't carry."""
    calibrated, model = drawn(EFFECTS["gear_ratio"](kuka.joint_names), kuka), tmp_path / "model.json"
    calibrated.save(model)
    wanted = ["--c", tmp_path / "arm", "--python", tmp_path / "arm.py", "--urdf", tmp_path / "arm.urdf"]
    assert run("export", model, *wanted, "--json", "--quiet") == 0
    told = json.loads(capsys.readouterr().out)

    assert sorted(file.name for file in (tmp_path / "arm").iterdir()) == ["kuka_kr125_2.c", "kuka_kr125_2.h"]
    assert told["c"] == str(tmp_path / "arm") and told["max_error_m"] < 1e-9 and told["notes"]
    done = subprocess.run(
        [sys.executable, "-I", "-c", f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import arm; "
         "print(arm.forward([0.0] * 6).shape, 'pincal' in sys.modules)"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.strip() == "(1, 3, 4) False"
    assert run("export", model) == 2
    assert "give at least one of" in capsys.readouterr().err


def test_files_are_written_in_the_order_of_the_help(
    kuka: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whatever the order of the options, and that in which the formats were registered."""
    calibrated, model = drawn(EFFECTS["gear_ratio"](kuka.joint_names), kuka), tmp_path / "model.json"
    calibrated.save(model)
    monkeypatch.setattr(FORMATS, "_classes", dict(reversed(FORMATS.registered().items())))
    assert run("export", model, "--dh", tmp_path / "a.csv", "--mjcf", tmp_path / "a.xml", "--urdf", tmp_path / "a.urdf") == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("written to")]

    assert [line.split(";")[0] for line in lines] == [
        f"written to {tmp_path / name}" for name in ("a.urdf", "a.xml", "a.csv")
    ]


def test_a_format_of_a_plugin_leaves_the_command_alone(
    kuka: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is written from Python; the command has its own."""

    class Own(Format):
        name, meaning = "own", "what somebody needs"

        def export(self, calibrated: FittedRobot) -> Exported:
            return Exported({"": calibrated.model.chain.robot.name.encode()})

    monkeypatch.setitem(FORMATS._classes, "own", Own)
    calibrated, model = drawn(EFFECTS["gear_ratio"](kuka.joint_names), kuka), tmp_path / "model.json"
    calibrated.save(model)

    assert export_model(calibrated, "own").text == kuka.name
    assert run("export", model, "--frames", "kuka") == 0 and run("export", model) == 2
    assert "--own" not in capsys.readouterr().err


def test_formats_and_options_are_checked(kuka: Robot) -> None:
    """An unknown name is answered with those that there are."""
    calibrated = drawn(EFFECTS["gear_ratio"](kuka.joint_names), kuka)
    with pytest.raises(BadInputError, match="format 'pyhton': unknown; expected one of python, "):
        export_model(calibrated, "pyhton")
    with pytest.raises(BadInputError, match=r"format 'urdf'.*colour"):
        export_model(calibrated, "urdf", colour="red")
    assert all(cls.name == name and cls.meaning for name, cls in FORMATS.known().items())


# --- arms of other kinds ------------------------------------------------------------------------------------------

# A carriage, a wrist whose third joint is driven by the second, and three more joints.
GANTRY = b"""<robot name="gantry 2/b">
  <link name="rail"/>
  <joint name="carriage" type="prismatic"><parent link="rail"/><child link="l1"/><origin xyz="0 0 1" rpy="0.1 0 0"/>
    <axis xyz="1 0 0"/><limit lower="-1" upper="2" effort="1" velocity="1"/></joint>
  %s
  <link name="tip"/>
  <joint name="mount" type="fixed"><parent link="l7"/><child link="tip"/><origin xyz="0.1 0 0.1" rpy="0 0.3 0"/></joint>
</robot>""" % b"".join(
    b"""<link name="l%d"><inertial><mass value="%d"/><origin xyz="0.1 0.02 0"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
    % (i, 9 - i)
    + (
        b"""<joint name="j%d" type="revolute"><parent link="l%d"/><child link="l%d"/><origin xyz="0.3 0 0.1"/>
    <axis xyz="%s"/><limit lower="-2" upper="2" effort="1" velocity="1"/>%s</joint>"""
        % (i + 1, i, i + 1, axis, b'<mimic joint="j2" multiplier="-0.5" offset="0.1"/>' if i == 2 else b"")
        if axis
        else b""
    )
    for i, axis in zip(range(1, 8), (b"0 0 1", b"0 1 0", b"0 1 0.1", b"1 0 0", b"0 0 1", b"0 1 0", b""), strict=True)
)


@pytest.mark.long
def test_carriages_and_joints_that_follow_others_are_exported(tmp_path: Path, rng: np.random.Generator) -> None:
    """A prismatic joint, and one that mimics another: inputs are the joints of their own, in C and in NumPy."""
    robot = Robot.from_urdf(GANTRY)
    calibrated = drawn(EFFECTS["backlash"](robot.joint_names), robot, frame="after")
    own, at = robot.own_joints, poses_of(calibrated, 200, rng)
    at = replace(at, approach=np.where(np.arange(7) == 2, -at.approach[:, [1]], at.approach))
    inputs = replace(at, q=at.q[:, own], approach=at.approach[:, own])
    true, seed = calibrated.predict(at), replace(inputs, q=inputs.q + rng.normal(0.0, 1e-3, inputs.q.shape))
    compiled = Compiled.of(calibrated, tmp_path)
    q, status, _ = compiled.compensate(true, seed)
    source = loaded(export_model(calibrated, "python").text)

    assert robot.joint_types[0] == "prismatic" and list(own) == [0, 1, 3, 4, 5, 6]
    np.testing.assert_allclose(compiled.forward(inputs)[0], true, rtol=0.0, atol=EXACT)
    np.testing.assert_allclose(source["forward"](inputs.q, **columns_of(inputs)), true, rtol=0.0, atol=EXACT)
    assert (status == 0).mean() > 0.95
    arrived = calibrated.predict(replace(at, q=robot.spread(q)))
    np.testing.assert_allclose(arrived[status == 0], true[status == 0], rtol=0.0, atol=2e-10)


def test_what_one_station_has_of_its_own_is_exported(kuka: Robot, rng: np.random.Generator) -> None:
    """An effect of a single station is in the formulas of that station's model."""
    effect = AtStation(EFFECTS["gear_ratio"](kuka.joint_names), "monday")
    check_python(drawn(effect, kuka), rng)
