"""From a robot and a table of measurements to a calibrated model: start, stages, fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.special import chdtri

from pincal.errors import BadInputError, MeasurementError
from pincal.identify.exact import is_exact, rounding
from pincal.identify.normal import accumulate, posterior, posterior_step
from pincal.identify.problem import Problem, conditions_of, problem_of
from pincal.identify.solve import Loss, Noise, Priors, Solution, solve
from pincal.identify.start import placements
from pincal.measure.extrinsics import Extrinsics
from pincal.measure.measurements import Measurements
from pincal.measure.rows import some_rows
from pincal.measure.sensing import sensor_of
from pincal.measure.sensor import KnownParameters
from pincal.measure.setup import Setup
from pincal.model.chain import Chain, MomentFrame
from pincal.model.effects import ELASTIC, GEOMETRIC, BaseFrame, Effect, ToolFrame
from pincal.model.model import Model
from pincal.parameters import FRAME_SYMBOLS, Covariance, Estimate
from pincal.robot.robot import Robot

Stages = Literal["joint", "paper"]

# Largest deviation of a length that a fit may find [m]; the paper (IV.C) gives +-1 cm for real deviations.
LENGTH_BOUND = 0.01
# A point that seems farther away than this [m] was seen from too much the same side.
_FARTHEST = 50.0
# Effects of what stands around the robot; a lens's distortion would only hide the robot's own.
EXTRINSICS = ("base_frame", "tool_frame", "named_point", "lens")
# Chance that sound data call for a parameter that is not there.
_MISSED = 1e-6
# The paper's sequence (IV.D); base and tool, known there, stay free throughout. The last stage releases everything.
PAPER_STAGES: dict[str, tuple[str, ...]] = {
    "1 joint offsets": ("joint_offset",),
    "2 link geometry and axis distortion": ("link_geometry", "axis_distortion"),
    "3 elasticity": ("joint_elasticity", "bearing_elasticity"),
}


@dataclass(frozen=True)
class Options:
    """How to calibrate.

    Attributes:
        effects: what may deviate, beside base and tool.
        sigma: standard deviation of one component of a position, or of a distance [m], of an image [px]; estimated where
            None.
        sigma_orientation: likewise of one component of an orientation [rad].
        moment_frame: where moments are taken and bend the arm.
        equilibrium: moments on the bent arm instead of the straight one.
        gravity: shape (3,), in the robot's base frame [m/s^2]; along -z of the URDF's root unless given.
        payload_centre: centre of mass of the payload in the tip frame [m].
        base: shape (4, 4), robot base in the instrument's frame, where it is known.
        tools: target name -> (x, y, z) in the tip frame [m], or shape (4, 4), target to tip frame, where they are known.
        stages: "joint" fits everything at once, "paper" goes through the paper's sequence.
        loss: what to do with outliers: "screen", "huber" or "none".
        length_bound: largest deviation of a length [m].
        setup: named points and the camera, as far as they are known.
    """

    effects: tuple[Effect, ...] = ELASTIC
    sigma: float | None = None
    sigma_orientation: float | None = None
    moment_frame: MomentFrame = "paper"
    equilibrium: bool = False
    gravity: tuple[float, float, float] | None = None
    payload_centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    base: np.ndarray | None = None
    tools: dict[str, tuple[float, float, float] | np.ndarray] | None = None
    stages: Stages = "joint"
    loss: Loss = "screen"
    length_bound: float = LENGTH_BOUND
    setup: Setup = field(default_factory=Setup)


@dataclass(frozen=True)
class Stage:
    """One stage of an identification: its name and what it came to."""

    name: str
    iterations: int
    rms: float


@dataclass(frozen=True)
class Fit:
    """A calibrated model.

    Attributes:
        problem: model and training rows.
        nominal: the fit of base and tool alone.
        solution: the fit of everything.
        priors: what was believed before.
        noise: what was declared of it.
        stages: the stages it went through.
        options: how it was made.
    """

    problem: Problem
    nominal: Solution
    solution: Solution
    priors: Priors
    noise: Noise
    stages: tuple[Stage, ...]
    options: Options

    @property
    def model(self) -> Model:
        """The model, its chain's reference orientations those of base and tool."""
        return self.problem.model

    @property
    def values(self) -> np.ndarray:
        """Calibrated values, shape (P,)."""
        return self.solution.values

    @cached_property
    def estimate(self) -> Estimate:
        """The calibrated values by name, with what is known of each."""
        covariance = Covariance.of(self.solution.posterior.covariance)
        return Estimate(self.problem.parameters, self.values, self.solution.free, covariance, self.priors.sizes)

    @property
    def iterations(self) -> int:
        """Gauss-Newton steps of all stages together, those for base and tool included."""
        return self.nominal.iterations + sum(stage.iterations for stage in self.stages)

    def readings(self, measurements: Measurements) -> Problem:
        """Return the calibrated model over other measurements."""
        return problem_of(self.model, measurements, np.array(self.options.payload_centre), self.options.setup)


def calibrate(robot: Robot, measurements: Measurements, options: Options | None = None) -> Fit:
    """Identify a robot's deviations from measured poses.

    Args:
        robot: the arm.
        measurements: training rows; hold rows back before the call to validate on them.
        options: how to calibrate; defaults as documented there.

    Returns:
        The fit; look at ``solution.converged``.

    Raises:
        BadInputError: if an elastic effect is asked of an arm without masses.
        MeasurementError: if the rows are too few to tell the parameters and the noise.

    Example:
        >>> from pincal.simulate import Instrument, TrueMachine
        >>> from pincal.measure.table import measurements_from_arrays
        >>> from pincal.builtin import kuka_urdf_path
        >>> robot = Robot.from_urdf(kuka_urdf_path())
        >>> rng = np.random.default_rng(1)
        >>> machine = TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0")
        >>> machine = machine.draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3)
        >>> q = robot.random_configurations(60, rng)
        >>> columns = Instrument(targets=(0.1, 0.0, 0.2)).measure(machine, q)
        >>> position = np.column_stack([columns[c] for c in "xyz"])
        >>> table = measurements_from_arrays(robot.joint_names, q, position=position)
        >>> fit = calibrate(robot, table, Options(effects=GEOMETRIC))
        >>> bool(np.abs(fit.problem.residuals(fit.values)).max() < 1e-9)
        True
    """
    options = _completed(options, measurements)
    problem, nominal, priors, noise = _begin(robot, measurements, options)
    fitted, stages = _fit(problem, nominal.values, priors, noise, options)
    _refuse_too_few(measurements, problem, fitted, noise)
    return Fit(problem, _without_outliers(problem, nominal, fitted, priors, noise), fitted, priors, noise, stages, options)


def _completed(options: Options | None, measurements: Measurements) -> Options:
    """Return the options with all points that the training rows name."""
    options = Options() if options is None else options
    return replace(options, setup=options.setup.over(measurements))


def _without_outliers(problem: Problem, nominal: Solution, fitted: Solution, priors: Priors, noise: Noise) -> Solution:
    """Return the fit of base and tool on the rows that the full fit found sound, so that "before" is judged fairly."""
    sound = fitted.weights > 0.0
    if sound.all():
        return nominal
    again = solve(problem.select(sound), nominal.values, nominal.free, priors, noise, loss="none")
    return replace(again, weights=fitted.weights, iterations=nominal.iterations)


def expected_fit(robot: Robot, measurements: Measurements, options: Options | None = None) -> Fit:
    """Return what a calibration could tell from these poses, before one is made.

    The solution stands at the nominal geometry; its posterior is what the poses and the noise allow. Noise that is not
    declared is taken from a calibration, since only the residuals know it.

    Raises:
        BadInputError: as :func:`calibrate`.
    """
    options = _completed(options, measurements)
    problem, nominal, priors, noise = _begin(robot, measurements, options)
    fitted, stages = _fit(problem, nominal.values, priors, noise, options)
    free = released_of(problem, options) & _excited(problem)
    G, g = accumulate(problem, nominal.values, free, fitted.weights).at(fitted.sigma)
    expected = posterior(G, 0.0 * g, priors.sizes[free], np.zeros(int(free.sum())))
    nothing = np.zeros(len(free), bool)
    outlook = replace(fitted, values=nominal.values, posterior=expected, free=free, at_bound=nothing)
    return Fit(problem, nominal, outlook, priors, noise, stages, options)


def without(fit: Fit, effect: Effect) -> Fit:
    """Return a fit as it stands with one effect taken out, nothing fitted again: the place to test the effect from."""
    gone = {parameter.name for parameter in effect.parameters(fit.model.chain)}
    kept = np.array([parameter.name not in gone for parameter in fit.problem.parameters])
    model = fit.model.with_effects([e for e in fit.model.effects if e is not effect])
    options = replace(fit.options, effects=tuple(e for e in fit.options.effects if e is not effect))

    def rest(solution: Solution) -> Solution:
        return replace(solution, values=solution.values[kept], free=solution.free[kept], at_bound=solution.at_bound[kept])

    priors = Priors(fit.priors.sizes[kept], fit.priors.bounds[kept])
    problem = fit.problem.with_model(model)
    return Fit(problem, rest(fit.nominal), rest(fit.solution), priors, fit.noise, fit.stages, options)


def refit(fit: Fit, effects: Sequence[Effect], *, moment_frame: MomentFrame | None = None, rough: bool = False) -> Fit:
    """Fit the same readings with other effects, everything jointly again, from where the parameters stand.

    Args:
        fit: a calibration.
        effects: what may deviate, beside base and tool; parameters known to ``fit`` by name start at its values.
        moment_frame: where moments are taken and bend the arm; as in ``fit`` unless given.
        rough: whether to stop before the last stage, close to the end, outliers only weighed down.
    """
    frames = [effect for effect in fit.model.effects if isinstance(effect, BaseFrame | ToolFrame)]
    frame = moment_frame or fit.options.moment_frame
    model = fit.model.with_effects([*frames, *effects]).with_chain(replace(fit.model.chain, moment_frame=frame))
    problem = fit.problem.with_model(model)
    options = replace(fit.options, effects=tuple(effects), moment_frame=frame)
    before = {p.name: i for i, p in enumerate(fit.problem.parameters)}
    places = [before.get(p.name) for p in problem.parameters]

    def carried(values: np.ndarray) -> np.ndarray:
        return np.array([0 if i is None else values[i] for i in places], values.dtype)

    nominal = replace(
        fit.nominal,
        values=carried(fit.nominal.values),
        free=carried(fit.nominal.free),
        at_bound=carried(fit.nominal.at_bound),
    )
    priors = priors_of(problem, options)
    fitted, stages = _fit(problem, carried(fit.values), priors, fit.noise, options, rough=rough)
    return Fit(problem, nominal, fitted, priors, fit.noise, stages, options)


def _begin(robot: Robot, measurements: Measurements, options: Options) -> tuple[Problem, Solution, Priors, Noise]:
    """Return the problem, its fit of base and tool alone, the priors and the noise."""
    _refuse_massless(robot, options.effects)
    problem, values = place(robot, measurements, options)
    priors = priors_of(problem, options)
    noise = noise_of(problem, options)
    frames = frames_of(problem) & released_of(problem, options)
    nominal = solve(problem, values, frames, priors, noise, loss=options.loss, rough=True, label="base and tool")
    bent = frames | np.array([p.effect == "lens_distortion" for p in problem.parameters]) & released_of(problem, options)
    if np.any(bent & ~frames):
        nominal = solve(problem, nominal.values, bent, priors, noise, loss=options.loss, rough=True, label="camera")
    return problem, nominal, priors, noise


def frames_of(problem: Problem) -> np.ndarray:
    """Return which parameters say where things are: base and tool, named points, a camera's pinhole."""
    return np.array([p.effect in EXTRINSICS for p in problem.parameters], bool)


def place(robot: Robot, measurements: Measurements, options: Options) -> tuple[Problem, np.ndarray]:
    """Return the problem with base and tool about where they are, and the values to start from.

    Of the closed-form candidates the one whose fit of base and tool leaves least is taken.
    """
    chain = Chain.of(
        robot,
        moment_frame=options.moment_frame,
        gravity=None if options.gravity is None else np.array(options.gravity),
        targets=tuple(str(t) for t in np.unique(measurements.target)),
    )
    sensor = sensor_of(measurements, options.setup)
    frames: tuple[Effect, ...] = (BaseFrame(sensor.base_symbols), ToolFrame(sensor.tool_symbols))
    bare = Model(chain, frames)
    centre = np.array(options.payload_centre)
    if len(measurements) == 0:
        raise MeasurementError(f"{measurements.source}: no rows to calibrate with")
    conditions = conditions_of(bare, measurements, centre)
    sample = some_rows(len(conditions), 2000, sensor.groups)
    tips = bare.predict(np.zeros(bare.n_parameters), conditions.select(sample))
    found = placements(sensor.select(sample), tips, conditions.target[sample], len(chain.targets))
    candidates = [_known(placement, chain, options) for placement in found]
    if not sensor.base_symbols:
        candidates = [replace(candidate, base=np.eye(4)) for candidate in candidates]
    starts = [_at(bare, measurements, placement, options) for placement in candidates]
    settled = [_settled(problem, values, options) for problem, values in starts]
    best = int(np.argmin([rest for _, rest in settled]))
    model = Model(chain, (*frames, *options.effects), equilibrium=options.equilibrium)
    problem, _ = _at(model, measurements, candidates[best], options)
    start = dict(zip((p.name for p in starts[best][0].parameters), settled[best][0], strict=True))
    return problem, np.array([start.get(p.name, 0.0) for p in problem.parameters])


def _known(placement: Extrinsics, chain: Chain, options: Options) -> Extrinsics:
    """Put in what the user knows of base and tools."""
    base = placement.base if options.base is None else np.asarray(options.base, float)
    tools = placement.tools.copy()
    for name, given in (options.tools or {}).items():
        if name not in chain.targets:
            raise BadInputError(f"tool {name!r} is given but no row has this target; targets: {', '.join(chain.targets)}")
        if np.shape(given) == (4, 4):
            tools[chain.targets.index(name)] = given
        else:
            tools[chain.targets.index(name), :3, 3] = given
    return replace(placement, base=base, tools=tools)


def _at(model: Model, measurements: Measurements, placement: Extrinsics, options: Options) -> tuple[Problem, np.ndarray]:
    """Return the problem and values that stand at a placement."""
    chain = model.chain.with_references(placement.base[:3, :3], placement.tools[:, :3, :3])
    problem = problem_of(model.with_chain(chain), measurements, np.array(options.payload_centre), options.setup)
    values = np.zeros(len(problem.parameters))
    values[problem.model.n_parameters :] = placement.own
    names = [parameter.name for parameter in problem.parameters]
    for element, place in [("base", placement.base), *zip(chain.targets, placement.tools, strict=True)]:
        for symbol, value in zip("xyz", place[:3, 3], strict=True):
            if f"{element}.{symbol}" in names:
                values[names.index(f"{element}.{symbol}")] = value
    return problem, values


def _settled(problem: Problem, values: np.ndarray, options: Options) -> tuple[np.ndarray, float]:
    """Return the values after a short fit of base and tool, and the median row residual; outliers don't vote."""
    sample = problem.select(some_rows(len(problem), 500, problem.sensor.groups))
    priors = Priors(np.full(len(values), np.inf), priors_of(problem, options).bounds)
    free = released_of(sample, options) & frames_of(sample)
    fit = solve(sample, values, free, priors, noise_of(sample, options), loss="huber")
    return fit.values, float(np.median(np.linalg.norm(sample.residuals(fit.values), axis=0)))


def released_of(problem: Problem, options: Options) -> np.ndarray:
    """Return which parameters a fit may move: all but a known base, known tools and what the sensor knows of itself."""
    known = known_frames(options)
    free = np.array([p.name not in known for p in problem.parameters], bool)
    free[problem.model.n_parameters :] = ~problem.sensor.fixed
    return free


def known_frames(options: Options) -> set[str]:
    """Return the names of the coordinates of base and tools that the user gave."""
    given: dict[str, tuple[str, ...]] = {} if options.base is None else {"base": FRAME_SYMBOLS}
    given |= {n: FRAME_SYMBOLS[: 6 if np.shape(at) == (4, 4) else 3] for n, at in (options.tools or {}).items()}
    return {f"{element}.{symbol}" for element, symbols in given.items() for symbol in symbols}


def _excited(problem: Problem) -> np.ndarray:
    """Return which parameters act at all at the nominal geometry: not the compliance about a vertical axis."""
    n = problem.model.n_parameters
    excited = np.ones(len(problem.parameters), bool)
    excited[:n] = problem.model.largest_basis(problem.conditions.select(_sample(problem)))[1]
    return excited


def _sample(problem: Problem) -> np.ndarray:
    """Return rows spread over the table, enough to judge sizes by."""
    return some_rows(len(problem), 1000)


def priors_of(problem: Problem, options: Options) -> Priors:
    """Return priors by physical group: so many mm, mrad, or mrad at the largest moment that these poses bring."""
    typical = np.array([parameter.size for parameter in problem.parameters])
    n = problem.model.n_parameters
    typical[:n] /= problem.model.largest_basis(problem.conditions.select(_sample(problem)))[0]
    lengths = np.array([p.unit == "m" and np.isfinite(p.size) for p in problem.parameters])
    bounds = np.where(lengths, options.length_bound, np.inf)
    bounds[[p.effect == "named_point" for p in problem.parameters]] = _FARTHEST
    return Priors(typical, bounds)


def noise_of(problem: Problem, options: Options) -> Noise:
    """Return the declared noise of each block of readings."""
    return Noise(tuple(options.sigma_orientation if b.unit == "rad" else options.sigma for b in problem.sensor.blocks))


def _fit(
    problem: Problem, start: np.ndarray, priors: Priors, noise: Noise, options: Options, *, rough: bool = False
) -> tuple[Solution, tuple[Stage, ...]]:
    """Go through the stages; each begins where the one before ended."""
    released = released_of(problem, options)
    excited = released & _excited(problem)
    stages: list[Stage] = []
    values = start
    for name, free in _plan(problem, excited, options):
        fitted = solve(problem, values, free, priors, noise, loss=options.loss, rough=True, label=name)
        values = fitted.values
        stages.append(Stage(name, fitted.iterations, float(fitted.estimated[0])))
    for name in () if rough else ("final", "with what only the deviations excite"):
        missed = _is_missed(problem, fitted, released, priors)
        if missed or name == "final":
            free = released if missed else fitted.free
            fitted = solve(problem, fitted.values, free, priors, noise, loss=options.loss, robust=fitted.weights, label=name)
            stages.append(Stage(name, fitted.iterations, float(fitted.estimated[0])))
    return fitted, tuple(stages)


def _plan(problem: Problem, free: np.ndarray, options: Options) -> list[tuple[str, np.ndarray]]:
    """Return the names of the stages and the parameters that each releases."""
    if options.stages == "joint":
        return [("all", free)]
    effects = np.array([parameter.effect for parameter in problem.parameters])
    frames = frames_of(problem)
    masks = {name: free & (frames | np.isin(effects, group)) for name, group in PAPER_STAGES.items()}
    return [(name, mask) for name, mask in masks.items() if np.any(mask & ~frames)] + [("4 all", free)]


def _is_missed(problem: Problem, fitted: Solution, released: np.ndarray, priors: Priors) -> bool:
    """Return whether the data call for the parameters that the nominal geometry never excites (a score test).

    Such a parameter times a deviation makes a ridge along which a fit wanders, so it is let in only on request.
    """
    held = released & ~fitted.free
    if not held.any():
        return False
    normal = accumulate(problem, fitted.values, released, fitted.weights)
    G, g = normal.at(np.maximum(fitted.sigma, rounding(problem)))
    if is_exact(np.diag(G), priors.sizes[released]):
        # The least deviation counts, and is lost in the rounding of G.
        return bool(np.any(fitted.estimated > rounding(problem)))
    wide = posterior_step(G, g, priors.sizes[released], fitted.values[released])
    narrow = fitted.free[released]
    near = posterior_step(G[np.ix_(narrow, narrow)], g[narrow], priors.sizes[fitted.free], fitted.values[fitted.free])
    slope = g - fitted.values[released] / priors.sizes[released] ** 2
    gain = slope @ wide - slope[narrow] @ near
    return bool(gain > chdtri(int(held.sum()), _MISSED))


def doubts_of_known(fit: Fit) -> tuple[str, ...]:
    """Return what to say if the readings contradict what was given of the sensor, which the fit held (a score test)."""
    problem = fit.problem
    if not (isinstance(problem.sensor, KnownParameters) and problem.sensor.is_given):
        return ()
    held = np.zeros(len(problem.parameters), bool)
    held[problem.model.n_parameters :] = problem.sensor.fixed
    is_doubted = held.any() and _is_missed(problem, fit.solution, fit.solution.free | held, fit.priors)
    return (problem.sensor.doubt,) if is_doubted else ()


def _refuse_too_few(measurements: Measurements, problem: Problem, fitted: Solution, noise: Noise) -> None:
    """Refuse a fit through all readings: it leaves nothing to estimate the noise from."""
    counted = int(np.sum(fitted.weights > 0.0))
    readings = counted * sum(block.size for block in problem.sensor.blocks)
    if noise.declared[0] is None and fitted.posterior.visible_rank >= readings:
        raise MeasurementError(
            f"{measurements.source}: {counted} training rows give {readings} readings, no more than the parameters that "
            "they would fit, so nothing is left to tell the noise from; measure more poses, declare the noise (--noise) "
            "or take the geometric model"
        )


def _refuse_massless(robot: Robot, effects: Sequence[Effect]) -> None:
    if robot.massless and any(effect.uses_moments for effect in effects):
        raise BadInputError(
            f"{robot.source}: no mass for the links {', '.join(robot.massless)}, so static moments are unknown and "
            "elasticity can't be fitted; add <inertial> to these links or calibrate with the geometric model"
        )


def geometric(options: Options) -> Options:
    """Return the same options for the geometric model alone."""
    return replace(options, effects=GEOMETRIC)
