"""Where instrument and tool stand, found without a first guess from any placement."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from _pytest.mark import ParameterSet
from scipy.spatial.transform import Rotation

from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.errors import BadInputError, MeasurementError
from pincal.identify.calibrate import fit_tables
from pincal.identify.fit import ModelFit
from pincal.identify.options import Options
from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.robot.robot import Robot
from pincal.sensors.distance import DistanceSensor
from pincal.sensors.pose import PoseSensor, PositionSensor
from pincal.sensors.sensor import Sensor

POSES = 80
# Errors of a real arm as it comes: some tenths of a mm and mrad at each joint.
LENGTH, ANGLE = 3e-4, 3e-4
NOISE = 5e-5
# What such errors leave of base and tool at most [m or rad]; a wrong start ends decimetres away.
WITHIN = 3e-3
FRAMES_ONLY = Options(effects=())
READ: dict[str, Callable[[np.ndarray], Sensor]] = {
    "position": lambda seen: PositionSensor(seen[:, :3, 3]),
    "pose": lambda seen: PoseSensor(seen[:, :3, 3], seen[:, :3, :3]),
    "distance": lambda seen: DistanceSensor(np.linalg.norm(seen[:, :3, 3], axis=1)),
}
KINDS = tuple(READ)
# A placement in every run, two more before each commit, all of them where rates are counted.
SOME, MORE, ALL = 1, 3, 30


def draws(n: int = ALL) -> list[ParameterSet]:
    """Return seeds of placements and arms, with the marks of when they are drawn."""
    marks = {seed: [pytest.mark.long, *([pytest.mark.rates] if seed >= MORE else [])] for seed in range(SOME, n)}
    return [pytest.param(seed, marks=marks.get(seed, ())) for seed in range(n)]


@cache
def machine(seed: int) -> sim.TrueMachine:
    """Return a KUKA with realistic geometric errors."""
    perfect = sim.TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0")
    return perfect.draw_errors(np.random.default_rng(seed), sigma_length=LENGTH, sigma_angle=ANGLE, sigma_offset=ANGLE)


@dataclass(frozen=True)
class Scene:
    """A base and tools anywhere: the base in the instrument's frame, the targets in the tip frame."""

    base: np.ndarray
    tools: dict[str, np.ndarray]

    @classmethod
    def draw(cls, rng: np.random.Generator, n_targets: int) -> Scene:
        """Draw a base in any orientation up to 6 m away and targets up to 0.5 m from the tip, well apart."""
        base = np.eye(4)
        base[:3, :3] = Rotation.random(random_state=rng).as_matrix()
        direction = rng.standard_normal(3)
        base[:3, 3] = rng.uniform(0.0, 6.0) * direction / np.linalg.norm(direction)
        tools = {}
        for name in "ABC"[:n_targets]:
            tools[name] = np.eye(4)
            tools[name][:3, :3] = Rotation.random(random_state=rng).as_matrix()
            direction = rng.standard_normal(3)
            tools[name][:3, 3] = rng.uniform(0.1, 0.5) * direction / np.linalg.norm(direction)
        return cls(base, tools)


def measure(scene: Scene, kind: str, seed: int, rng: np.random.Generator, *, poses: int = POSES) -> Measurements:
    """Return readings of the targets of a scene by a good instrument, a row for each pose and target."""
    robot = machine(seed)
    q = sim.plan_poses(robot.nominal, poses, rng, min_height=None)
    tracker = sim.Instrument(pose=scene.base, targets=scene.tools, reads=kind, sigma=NOISE, sigma_angle=NOISE)
    columns = tracker.measure(robot, q, rng=rng)
    readings: dict[str, np.ndarray] = {"target": columns.get("target", np.full(poses, "A"))}
    if kind == "distance":
        readings["distance"] = columns["distance"]
    else:
        readings["position"] = np.column_stack([columns[axis] for axis in "xyz"])
    if kind == "pose":
        readings["quaternion"] = np.column_stack([columns[f"q{axis}"] for axis in "xyzw"])
    return measurements_from_arrays(robot.names, np.column_stack([columns[name] for name in robot.names]), **readings)


def base_and_tools(fit: ModelFit, values: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the base and the tools, shape (4, 4) each, of a fit's values."""
    model, chain = fit.station.model, fit.station.model.chain
    found = dict(zip(model.names, values, strict=True))

    def frame(element: str, reference: np.ndarray) -> np.ndarray:
        T, angles = np.eye(4), [found.get(f"{element}.{symbol}", 0.0) for symbol in ("rx", "ry", "rz")]
        T[:3, :3] = reference @ Rotation.from_euler("XYZ", angles).as_matrix()
        T[:3, 3] = [found[f"{element}.{symbol}"] for symbol in "xyz"]
        return T

    tools = zip(chain.targets, chain.tool_rotations, strict=True)
    return frame("base", chain.base_rotation), {name: frame(name, rotation) for name, rotation in tools}


def expected_base(scene: Scene, kind: str) -> np.ndarray:
    """Return the true base; for distances, which see no orientation, in a frame parallel to the base itself."""
    expected = scene.base.copy()
    if kind == "distance":
        expected[:3, :3], expected[:3, 3] = np.eye(3), scene.base[:3, :3].T @ scene.base[:3, 3]
    return expected


def assert_found(fit: ModelFit, scene: Scene, kind: str, *, values: np.ndarray | None = None) -> None:
    """Check base and tools against the truth, and that nothing but the errors of the arm is left."""
    values = fit.nominal.values if values is None else values
    base, tools = base_and_tools(fit, values)
    expected = expected_base(scene, kind)
    # A distance takes the tilt of the arm's first axis for a place: 1 mrad at 6 m is 6 mm.
    assert np.linalg.norm(base[:3, 3] - expected[:3, 3]) < (12e-3 if kind == "distance" else WITHIN)
    assert Rotation.from_matrix(base[:3, :3].T @ expected[:3, :3]).magnitude() < WITHIN
    assert set(tools) == set(scene.tools)
    for name, tool in tools.items():
        assert np.linalg.norm(tool[:3, 3] - scene.tools[name][:3, 3]) < WITHIN
        if kind == "pose":
            assert Rotation.from_matrix(tool[:3, :3].T @ scene.tools[name][:3, :3]).magnitude() < WITHIN
    residuals = np.linalg.norm(fit.station.residuals(values), axis=0)
    assert np.median(residuals) < WITHIN


@pytest.mark.parametrize("seed", draws())
@pytest.mark.parametrize("n_targets", [1, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_any_placement_is_found(kuka: Robot, kind: str, n_targets: int, seed: int) -> None:
    """From anywhere and however turned, the fit of base and tools ends within mm of the truth."""
    rng = np.random.default_rng(seed)
    scene = Scene.draw(rng, n_targets)

    assert_found(fit_tables(kuka, measure(scene, kind, seed, rng), FRAMES_ONLY), scene, kind)


@pytest.mark.parametrize("seed", draws(5))
@pytest.mark.parametrize("kind", KINDS)
def test_a_tracker_upside_down_five_metres_away_is_found(kuka: Robot, kind: str, seed: int) -> None:
    """A tracker 5 m away that hangs from the ceiling, and a target half a metre off the flange, are nothing special."""
    rng = np.random.default_rng(100 + seed)
    scene = Scene.draw(rng, 1)
    scene.base[:3, :3] = np.diag([1.0, -1.0, -1.0])
    scene.base[:3, 3] = 5.0, 0.0, 1.0
    scene.tools["A"][:3, 3] = 0.0, 0.3, 0.4

    assert_found(fit_tables(kuka, measure(scene, kind, seed, rng), FRAMES_ONLY), scene, kind)


@pytest.mark.parametrize("seed", draws(5))
@pytest.mark.parametrize("kind", KINDS)
def test_instrument_and_tool_at_the_robots_own_frames_are_found(kuka: Robot, kind: str, seed: int) -> None:
    """Base and tool where the URDF has them are no exception, though nothing has to be found."""
    rng = np.random.default_rng(200 + seed)
    scene = Scene(np.eye(4), {"A": np.eye(4)})
    scene.base[2, 3] = 0.5

    assert_found(fit_tables(kuka, measure(scene, kind, seed, rng), FRAMES_ONLY), scene, kind)


@pytest.mark.parametrize("seed", draws(8))
@pytest.mark.parametrize("kind", KINDS)
def test_a_dozen_poses_are_enough(kuka: Robot, kind: str, seed: int) -> None:
    """Where the rows are too few for the linear equations, the fit finds base and tool all the same."""
    rng = np.random.default_rng(300 + seed)
    scene = Scene.draw(rng, 1)

    assert_found(fit_tables(kuka, measure(scene, kind, seed, rng, poses=12), FRAMES_ONLY), scene, kind)


@pytest.mark.parametrize("seed", draws(8))
@pytest.mark.parametrize("kind", KINDS)
def test_outliers_do_not_pull_base_and_tool(kuka: Robot, kind: str, seed: int) -> None:
    """One reading in twenty that is half a metre off leaves base and tool where they are at the end of the fit."""
    rng = np.random.default_rng(400 + seed)
    scene = Scene.draw(rng, 1)
    table = measure(scene, kind, seed, rng)
    bad = np.arange(len(table)) % 20 == 7
    if table.distance is not None:
        spoilt = table.with_readings(distance=np.where(bad, table.distance + 0.5, table.distance))
    else:
        spoilt = table.with_readings(position=table.position + np.outer(bad, [0.3, -0.4, 0.0]))
    fit = fit_tables(kuka, spoilt, FRAMES_ONLY)

    assert np.all(fit.solution.weights[bad] == 0.0) and np.all(fit.solution.weights[~bad] > 0.0)
    assert_found(fit, scene, kind, values=fit.values)


@pytest.mark.parametrize("n_targets", [1, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_one_candidate_is_exact_for_a_perfect_arm(kind: str, n_targets: int, kuka: Robot, rng: np.random.Generator) -> None:
    """Without errors and noise the closed form itself is the truth to rounding."""
    scene = Scene.draw(rng, n_targets)
    tips = np.repeat(kuka.forward_kinematics(kuka.random_configurations(POSES, rng)), n_targets, axis=0)
    target = np.tile(np.arange(n_targets), POSES)
    seen = scene.base @ tips @ np.array(list(scene.tools.values()))[target]
    sensor = READ[kind](seen)
    found = list(sensor.starts(tips[:, :3], target, n_targets))
    errors = []
    for candidate in found:
        offsets = candidate.tools[:, :3, 3] - [tool[:3, 3] for tool in scene.tools.values()]
        base = candidate.base - expected_base(scene, kind)
        errors.append(max(np.abs(offsets).max(), np.abs(base).max()))

    assert min(errors) < 1e-9


def test_a_start_that_no_other_can_beat_is_the_only_one(kuka: Robot, rng: np.random.Generator) -> None:
    """No placement leaves less than the linear system does; a mirrored table solves that too, and all starts are tried."""
    scene = Scene.draw(rng, 2)
    table = measure(scene, "position", 1, rng)
    tips, target = kuka.forward_kinematics(table.q)[:, :3], (table.target == "B").astype(int)

    def tried(position: np.ndarray) -> int:
        return len(list(PositionSensor(position).starts(tips, target, 2)))

    assert tried(table.position) == 1
    assert tried(table.position * [1.0, -1.0, 1.0]) == 2


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_known_of_base_and_tool_stays(kind: str, kuka: Robot, rng: np.random.Generator) -> None:
    """A known base and known tools are taken as they are; only the rest is found."""
    scene = Scene.draw(rng, 2)
    table, known = measure(scene, kind, 1, rng), expected_base(scene, kind)
    with_base = fit_tables(kuka, table, Options(effects=(), base=known))
    with_tool = fit_tables(kuka, table, Options(effects=(), tools={"B": tuple(scene.tools["B"][:3, 3])}))

    np.testing.assert_allclose(base_and_tools(with_base, with_base.values)[0], known, rtol=0.0, atol=1e-12)
    assert_found(with_base, scene, kind)
    tool = base_and_tools(with_tool, with_tool.values)[1]["B"]
    np.testing.assert_allclose(tool[:3, 3], scene.tools["B"][:3, 3], rtol=0.0, atol=1e-12)
    assert_found(with_tool, scene, kind)


def test_a_tool_that_no_row_has_is_refused(kuka: Robot, rng: np.random.Generator) -> None:
    """A known tool whose name is not among the targets is answered with the targets there are."""
    table = measure(Scene.draw(rng, 2), "position", 1, rng)
    with pytest.raises(BadInputError, match=r"tool 'C' is given but no row has this target; targets: A, B"):
        fit_tables(kuka, table, Options(effects=(), tools={"C": (0.0, 0.0, 0.1)}))


def test_a_table_without_rows_is_refused(kuka: Robot, rng: np.random.Generator) -> None:
    """There is nothing to start from without a row."""
    table = measure(Scene.draw(rng, 1), "position", 1, rng)
    with pytest.raises(MeasurementError, match="no rows to calibrate with"):
        fit_tables(kuka, table.select(np.zeros(len(table), bool)), FRAMES_ONLY)
