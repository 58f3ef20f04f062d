"""From a robot and measured poses to a calibrated model: start, stages, fit."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from enum import Enum

import numpy as np
from scipy.special import chdtri

from pincal.errors import BadInputError, MeasurementError
from pincal.identify.bearings import called_for
from pincal.identify.beliefs import excited_of, frames_of, noise_of, priors_of, released_of, sensors_own
from pincal.identify.dependence import is_dependent, serial_noise, with_serial
from pincal.identify.earlier import Earlier
from pincal.identify.equations import Linearised
from pincal.identify.exact import is_exact, rounding
from pincal.identify.fit import Fit, Stage, carried
from pincal.identify.gauge import along_gauge, weight_of
from pincal.identify.initial import place
from pincal.identify.moment_frames import best_of, some_rows_of
from pincal.identify.noise import Noise
from pincal.identify.options import Options, StationOptions
from pincal.identify.problem import Problem
from pincal.identify.solve import SETTLED, Priors, Solution, solve
from pincal.identify.station import Station
from pincal.measure.measurements import Measurements
from pincal.measure.poses import by_pose
from pincal.measure.sensor import KnownParameters
from pincal.measure.stations import stations_of
from pincal.model.catalogue.bearings import without_idle_features
from pincal.model.catalogue.masses import with_masses
from pincal.model.chain import MOMENT_FRAMES, MomentFrame
from pincal.model.effects import Effect
from pincal.robot.robot import Robot

Tables = Measurements | Sequence[Measurements] | Mapping[str, Measurements]

log = logging.getLogger(__name__)

# Chance that sound data call for a parameter that is not there.
_MISSED = 1e-6
# Readings beyond the unknowns from which the noise is known to 30 %. Beside an earlier fit fewer won't do: the parameters
# that it knows give way as far as the noise seems small, and the noise seems small as far as they give way.
_FEWEST_LEFT = 6
# How often the masses of an earlier fit are taken to what they weigh now, and the change that is none.
_WEIGHINGS, _SAME_WEIGHT = 10, 1e-3
# The paper's sequence (IV.D); base and tool, known there, stay free throughout. The last stage releases everything.
PAPER_STAGES: dict[str, tuple[str, ...]] = {
    "1 joint offsets": ("joint_offset",),
    "2 link geometry and axis distortion": ("link_geometry", "axis_distortion"),
    "3 elasticity": ("joint_elasticity", "bearing_elasticity", "oblique_bearing", "bearing_place"),
}

# A step that moves predictions by less than this part of the noise changes nothing that a test notices.
_CLOSE = 5e-3


class Until(Enum):
    """How far a fit goes."""

    ROUGH = "close to the end, outliers only weighed down"
    CLOSE = "to within what a test notices, nothing else asked for"
    SETTLED = "to the end, with what only the deviations excite if the data call for it"


# The stages after those of a plan; the second one only where it is called for.
_LAST_STAGES = {
    Until.ROUGH: (),
    Until.CLOSE: ("final",),
    Until.SETTLED: ("final", "with what only the deviations excite"),
}


def calibrate(
    robot: Robot, measurements: Tables, options: Options | None = None, *, executor: Executor | None = None
) -> Fit:
    """Identify a robot's deviations from measured poses.

    Several tables are several stations: set-ups of an instrument and its targets, of the same kind or not. Each has base,
    targets and noise of its own, and all have the robot in common.

    Args:
        robot: the arm.
        measurements: training rows, one table or several, perhaps by the names of their stations (default: station_1 and
            so on); hold rows back before the call to validate on them.
        options: how to calibrate; defaults as documented there.
        executor: computes what each of several stations contributes (default: one after the other, here). Results do not
            depend on it.

    Returns:
        The fit; look at ``solution.exit``. See :func:`pincal.calibrate` for an example.

    Raises:
        MeasurementError: if the rows are too few to tell the parameters and the noise.
    """
    tables = _by_pose(measurements)
    options = _completed(robot, options, tables)
    fit = with_bearings(_weighed_anew(_fitted(robot, tables, options, executor)))
    _refuse_too_few(tables, fit.problem, fit.solution, fit.noise)
    fit = _in_best_frame(replace(fit, nominal=_without_outliers(fit, executor)))
    return weighed_by_order(fit) if options.serial and is_dependent(fit) else fit


def tables_of(measurements: Tables) -> dict[str, Measurements]:
    """Return the rows of each station by its name; one that is alone needs none.

    Raises:
        BadInputError: without any table, and as :func:`pincal.measure.stations.stations_of`.
    """
    if isinstance(measurements, Measurements):
        measurements = {"": measurements}
    if not isinstance(measurements, Mapping):
        measurements = {f"station_{i + 1}": table for i, table in enumerate(measurements)}
    tables = stations_of(measurements.items())
    if not tables:
        raise BadInputError("no tables of measurements; expected one or more")
    return tables


def _by_pose(measurements: Tables) -> dict[str, Measurements]:
    """Return the poses of each station by its name, as :func:`tables_of`."""
    return {name: by_pose(table) for name, table in tables_of(measurements).items()}


def _completed(robot: Robot, options: Options | None, tables: dict[str, Measurements]) -> Options:
    """Return the options with all points that the training rows name, and the masses that nobody knows as effects."""
    options = Options() if options is None else options
    options = replace(options, effects=with_masses(robot, options.effects))
    unknown = set(options.stations) - set(tables)
    if unknown:
        raise BadInputError(
            f"options are given for the station {sorted(unknown)[0]!r}; expected one of {', '.join(map(repr, tables))}"
        )
    if len(tables) == 1:
        ((name, table),) = tables.items()
        options = options.at(name)
        return replace(options, setup=options.setup.over(table))
    completed = dict(options.stations)
    for name, table in tables.items():
        setup = options.at(name).setup
        if setup.over(table) is not setup:
            completed[name] = replace(completed.get(name, StationOptions()), setup=setup.over(table))
    return replace(options, stations=completed)


def _fitted(robot: Robot, tables: dict[str, Measurements], options: Options, executor: Executor | None) -> Fit:
    problem, nominal, priors, noise = _begin(robot, tables, options, executor)
    fitted, stages = _fit(problem, problem.recalled(nominal.values), priors, noise, options, executor=executor)
    return Fit(problem, nominal, fitted, priors, noise, stages, options)


def _weighed_anew(fit: Fit) -> Fit:
    """Return a fit beside an earlier one that found masses, the earlier one moved to what they weigh now."""
    earlier, problem, factor = fit.options.earlier, fit.problem, 1.0
    weight = 0.0 if earlier is None else weight_of(problem, earlier)
    if earlier is None or not weight:
        return fit
    for _ in range(_WEIGHINGS):
        before, factor = factor, weight_of(problem, fit.estimate) / weight
        if not 0.1 < factor < 10.0 or abs(factor / before - 1.0) < _SAME_WEIGHT:
            break
        problem = replace(problem, earlier=Earlier.of(along_gauge(problem, earlier, factor)))
        priors = priors_of(problem, fit.options)
        fitted, stages = _fit(problem, problem.recalled(fit.values), priors, fit.noise, fit.options)
        fit = replace(fit, problem=problem, solution=fitted, priors=priors, stages=stages)
    return fit


def _without_outliers(fit: Fit, executor: Executor | None) -> Solution:
    """Return the fit of base and tool on the rows that the full fit found sound, so that "before" is judged fairly."""
    nominal, weights = fit.nominal, fit.solution.weights
    sound = weights > 0.0
    if sound.all():
        return nominal
    rows = fit.problem.select(sound)
    again = solve(rows, nominal.values, nominal.free, fit.priors, fit.noise, loss="none", executor=executor)
    return replace(again, weights=weights, iterations=nominal.iterations)


def expected_fit(robot: Robot, measurements: Tables, options: Options | None = None) -> Fit:
    """Return what a calibration could tell from these poses, before one is made.

    The solution stands at the nominal geometry; its posterior is what the poses and the noise allow. Noise that is not
    declared is taken from a calibration, since only the residuals know it.

    Raises:
        BadInputError: as :func:`calibrate`.
    """
    tables = _by_pose(measurements)
    options = _completed(robot, options, tables)
    fit = _in_best_frame(_fitted(robot, tables, options, None))
    problem, nominal, fitted = fit.problem, fit.nominal, fit.solution
    free = released_of(problem, options) & excited_of(problem)
    found = Linearised(problem, nominal.values, free, fitted.weights, fit.priors.sizes).equations(fitted.sigma)
    # The expected data agree with the nominal geometry: nothing pulls away from it.
    expected = replace(found, g=np.zeros_like(found.g), values=np.zeros_like(found.values))
    nothing = np.zeros(len(free), bool)
    outlook = replace(fitted, values=nominal.values, equations=expected, free=free, at_bound=nothing)
    return replace(fit, solution=outlook)


def _in_best_frame(fit: Fit) -> Fit:
    """Return a fit in the convention of moments that fits best, if the options leave it open and moments matter."""
    effects, frame = fit.options.effects, fit.problem.chain.moment_frame
    if fit.options.moment_frame != "auto":
        return fit
    if any(effect.uses_moments for effect in effects):
        few = some_rows_of(fit)
        tried = [few if few is fit else with_bearings(refit(few, effects))]
        for other in (other for other in MOMENT_FRAMES if other != frame):
            log.info("how well --moment-frame %s fits, by %d rows", other, len(few.problem))
            tried.append(with_bearings(refit(few, effects, moment_frame=other)))
        frame = best_of(tried)
    if frame != fit.problem.chain.moment_frame:
        return with_bearings(refit(fit, effects, moment_frame=frame))
    return replace(fit, options=replace(fit.options, moment_frame=frame))


def refit(
    fit: Fit,
    effects: Sequence[Effect],
    *,
    moment_frame: MomentFrame | None = None,
    start: Mapping[Effect, np.ndarray] | None = None,
    until: Until = Until.SETTLED,
) -> Fit:
    """Fit the same readings with other effects, everything jointly again, from where the parameters stand.

    Args:
        fit: a calibration.
        effects: what may deviate, beside base and tool; parameters known to ``fit`` by name start at its values.
        moment_frame: where moments are taken and bend the arm; default: as in ``fit``.
        start: values of new effects close to the end, so that the last stage is all that is needed; default: zero.
        until: how far to go; a fit that others follow need not be settled.
    """
    frame = moment_frame or fit.problem.chain.moment_frame
    effects = without_idle_features(frame, with_masses(fit.problem.chain.robot, effects))
    problem = fit.problem.with_effects(effects, moment_frame=frame)
    options = replace(fit.options, effects=tuple(effects), moment_frame=frame)
    priors = priors_of(problem, options)
    near = carried(fit.solution, fit.problem, problem)
    for effect, values in (start or {}).items():
        near.values[problem.places_at(effect)] = values
    known = None if start is None else near
    fitted, stages = _fit(problem, near.values, priors, fit.noise, options, near=known, until=until)
    return Fit(problem, carried(fit.nominal, fit.problem, problem), fitted, priors, fit.noise, stages, options)


def weighed_by_order(fit: Fit, until: Until = Until.SETTLED) -> Fit:
    """Return a fit whose rows are weighed by the noise along their order that the fit leaves; perhaps by none."""
    found = serial_noise(fit)
    if not any(serial is not None for serial in (*found, *(station.serial for station in fit.problem.stations))):
        return fit
    return refit(with_serial(fit, found), fit.options.effects, start={}, until=until)


def with_bearings(fit: Fit) -> Fit:
    """Return a fit with what the data call for of the features of its bearings, which may take further fits."""
    more = called_for(fit).effects
    return with_bearings(refit(fit, (*fit.options.effects, *more), start={})) if more else fit


def _begin(
    robot: Robot, tables: dict[str, Measurements], options: Options, executor: Executor | None
) -> tuple[Problem, Solution, Priors, Noise]:
    """Return the problem, its fit of base and tool alone, the priors and the noise."""
    if len(tables) == 1:
        tables = {"": next(iter(tables.values()))}
    placed = [
        (_averaged(station, table, options.at(name)), local)
        for (station, local), (name, table) in zip(place(robot, tables, options), tables.items(), strict=True)
    ]
    earlier = None if options.earlier is None else Earlier.of(options.earlier)
    problem = Problem(tuple(station for station, _ in placed), earlier)
    values = np.zeros(problem.size)
    for (_, local), places in zip(placed, problem.places, strict=True):
        values[places] = local
    priors, noise = priors_of(problem, options), noise_of(problem, options)
    released, frames = released_of(problem, options), frames_of(problem)
    bent = frames | sensors_own(problem)
    for free, label in ((frames & released, "base and tool"), (bent & released, "camera")):
        if label == "base and tool" or np.any(free & ~frames):
            nominal = solve(
                problem, values, free, priors, noise, loss=options.loss, rough=True, label=label, executor=executor
            )
            values = nominal.values
    return problem, nominal, priors, noise


def _averaged(station: Station, table: Measurements, options: Options) -> Station:
    """Return a station whose rows weigh as the means that they are, where the noise of a single reading is declared.

    Where it is not, what poses differ by from the model may be as much their own, and each counts once.
    """
    if table.readings_per_row is None or options.sigma is None:
        return station
    return replace(station, weights=station.weights * np.sqrt(table.readings_per_row))


def _fit(
    problem: Problem,
    start: np.ndarray,
    priors: Priors,
    noise: Noise,
    options: Options,
    *,
    near: Solution | None = None,
    until: Until = Until.SETTLED,
    executor: Executor | None = None,
) -> tuple[Solution, tuple[Stage, ...]]:
    """Go through the stages; each begins where the one before ended. The last are enough after a solution that is near."""
    released = released_of(problem, options)
    excited = released & excited_of(problem)
    stages: list[Stage] = []
    values, loss = start, options.loss
    if near is not None:
        fitted = replace(near, free=excited)
    for name, free in _plan(problem, excited, options) if near is None else ():
        fitted = solve(problem, values, free, priors, noise, loss=loss, rough=True, label=name, executor=executor)
        values = fitted.values
        stages.append(Stage(name, fitted.iterations, float(fitted.estimated[0])))
    for name in _LAST_STAGES[until]:
        missed, begun = _is_missed(problem, fitted, released, priors)
        if missed or name == "final":
            free, robust = released if missed else fitted.free, fitted.weights
            fitted = solve(
                problem,
                fitted.values,
                free,
                priors,
                noise,
                loss=loss,
                robust=robust,
                label=name,
                begun=begun,
                short=_CLOSE if until is Until.CLOSE else SETTLED,
                executor=executor,
            )
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


def _is_missed(problem: Problem, fitted: Solution, released: np.ndarray, priors: Priors) -> tuple[bool, Linearised | None]:
    """Return whether the data call for the parameters that the nominal geometry never excites (a score test).

    Such a parameter times a deviation makes a ridge along which a fit wanders, so it is let in only on request. The problem
    at the fit is returned as well, where it had to be linearised.
    """
    # What only one of several stations has would be a matter of this station alone.
    held = released & ~fitted.free & problem.is_shared
    if not held.any():
        return False, None
    found = Linearised(problem, fitted.values, fitted.free | held, fitted.weights, priors.sizes)
    wide = found.equations(np.maximum(fitted.sigma, rounding(problem)))
    if is_exact(wide.diagonal, priors.sizes[found.free]):
        # The least deviation counts, and is lost in the rounding of G.
        return bool(np.any(fitted.estimated > rounding(problem))), found
    near = wide.of(fitted.free[found.free])
    gain = wide.gain - near.gain
    return bool(gain > chdtri(int(held.sum()), _MISSED)), found


def doubts_of_known(fit: Fit) -> tuple[str, ...]:
    """Return what to say if the readings contradict what was given of the sensor, which the fit held (a score test)."""
    problem = fit.problem
    held = np.zeros(problem.size, bool)
    doubts: list[str] = []
    for station, places in zip(problem.stations, problem.places, strict=True):
        if isinstance(station.sensor, KnownParameters) and station.sensor.is_given:
            local = np.zeros(len(places), bool)
            station.split(local)[1][:] = station.sensor.fixed
            held[places] = local
            doubts.append(station.sensor.doubt)
    is_doubted = held.any() and _is_missed(problem, fit.solution, fit.solution.free | held, fit.priors)[0]
    return tuple(dict.fromkeys(doubts)) if is_doubted else ()


def _refuse_too_few(tables: dict[str, Measurements], problem: Problem, fitted: Solution, noise: Noise) -> None:
    """Refuse a fit through all readings: it leaves nothing to estimate the noise from."""
    counts = problem.counted_rows(fitted.weights)
    readings = int(counts[problem.station_of_block] @ problem.block_sizes)
    spent = fitted.posterior.visible_rank
    if problem.earlier is not None:
        spent = _FEWEST_LEFT + int(np.sum(fitted.free & ~problem.is_remembered))
    if noise.declared[0] is None and spent >= readings:
        raise MeasurementError(
            f"{', '.join(table.source for table in tables.values())}: {counts.sum()} training rows give {readings} "
            "readings, no more than the parameters that they would fit, so nothing is left to tell the noise from; measure "
            "more poses, declare the noise (--noise) or take the geometric model"
        )
