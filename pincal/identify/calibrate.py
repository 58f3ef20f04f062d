"""From a robot and measured poses to a calibrated model: start, stages, fit."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from enum import Enum
from fnmatch import filter as filter_names
from functools import partial, reduce
from typing import Any

import numpy as np
from scipy.special import chdtri

from pincal.errors import BadInputError, MeasurementError, nearest_first
from pincal.identify.arrivals import with_arrivals
from pincal.identify.beliefs import excited_of, is_frame, of_stations, priors_of, released_of
from pincal.identify.believed import Earlier
from pincal.identify.choices import along_gauge, best_of, required_features, some_rows_of, weight_of
from pincal.identify.criteria import CRITERIA
from pincal.identify.dependence import (
    is_dependent,
    placed_at_mean,
    serial_noise,
    with_blocks,
    with_serial,
)
from pincal.identify.equations import Linearised
from pincal.identify.fit import FitStage, ModelFit, Solution, without
from pincal.identify.initial import begin
from pincal.identify.many_rows import over_all
from pincal.identify.noise import is_exact, rounding, usual_sizes
from pincal.identify.options import Options, PriorScale, StationOptions, Tools
from pincal.identify.prior_scale import observes_places, prior_scale
from pincal.identify.problem import Problem
from pincal.identify.screening import without_wrong, wrong_readings
from pincal.identify.solve import SETTLED, Course, solve, solve_to
from pincal.identify.stop_scatter import (
    ScatterOfStations,
    StopScatter,
    scatter_of_stops,
    shared_in_fit,
)
from pincal.identify.visit_weights import weighs_visits, with_visits
from pincal.measure.measurements import Measurements
from pincal.measure.poses import by_pose
from pincal.measure.stops import Plan, plan_of
from pincal.measure.table import stations_of
from pincal.model.catalogue.bearing_features import without_idle_features
from pincal.model.catalogue.masses import with_masses
from pincal.model.catalogue.motion import with_drives
from pincal.model.chain import MOMENT_FRAMES, MomentFrame
from pincal.model.effect import Effect
from pincal.parameters import is_on_link
from pincal.recorded import RECORDED
from pincal.robot.robot import Robot
from pincal.sensors.sensor import KnownParameters, Sensor
from pincal.thresholds import Count, Scale

Tables = Measurements | Sequence[Measurements] | Mapping[str, Measurements]

log = logging.getLogger(__name__)

# Rounds in which the masses of an earlier fit are rescaled to the present ones, and the negligible
# relative change.
_WEIGHINGS: Count = 10
_SAME_WEIGHT: Scale = 1e-3
# Rounds in which wrong readings are looked for by the fit without those of the round before.
_SCREENINGS: Count = 3
# Rounds in which the factors on priors are estimated.
_SCALINGS: Count = 4
# The paper's sequence (IV.D); base and tool, known there, are free throughout. The last stage
# releases everything.
PAPER_STAGES: dict[str, tuple[str, ...]] = {
    "1 joint offsets": ("joint_offset",),
    "2 link geometry and axis distortion": ("link_geometry", "axis_distortion"),
    "3 elasticity": ("joint_elasticity", "bearing_elasticity", "oblique_bearing", "bearing_place"),
}

# A step that moves predictions by less than this part of the noise changes no test noticeably.
_CLOSE: Scale = 5e-3
# The same of the last fits to correlated rows: among as many rows as tell their noise, no figure.
_TOLD: Scale = 2e-2


class Tolerance(Enum):
    """How closely a fit converges."""

    ROUGH = "close to convergence, outliers only down-weighted"
    CLOSE = "to within the resolution of a test, without further features"
    TOLD = (
        "to within a fiftieth of the noise, with features excited only by deviations if the data "
        "require them"
    )
    NEAR = (
        "to convergence, with features excited only by deviations if the data require them at "
        "its start"
    )
    SETTLED = "to convergence, with features excited only by deviations if the data require them"


# Motion of the predictions below which a step ends a fit, in units of the noise.
_SHORT = {Tolerance.CLOSE: _CLOSE, Tolerance.TOLD: _TOLD}
# The stages after those of a plan; the second one only where the data require it.
_LAST_STAGES = {
    Tolerance.ROUGH: (),
    Tolerance.CLOSE: ("final",),
    Tolerance.TOLD: ("final", "with features excited only by deviations"),
    Tolerance.NEAR: ("final",),
    Tolerance.SETTLED: ("final", "with features excited only by deviations"),
}


def fit_tables(
    robot: Robot,
    measurements: Tables,
    options: Options | None = None,
    *,
    executor: Executor | None = None,
) -> ModelFit:
    """Identify a robot's deviations from measured poses; arguments and errors as for
    :func:`pincal.calibrate`.

    Tables without station names are station_1 and so on. Results do not depend on the executor.
    """
    tables = tables_of(measurements)
    fit = _fit_to_means(robot, tables, options, executor)
    wrong = {name: np.zeros(len(table), bool) for name, table in tables.items()}
    for _ in range(_SCREENINGS if fit.options.loss == "screen" else 0):
        before = wrong
        wrong = wrong_readings(fit, tables)
        if all(np.array_equal(wrong[name], before[name]) for name in tables):
            break
        log.info(
            "without %d readings that do not fit others of their pose",
            sum(int(w.sum()) for w in wrong.values()),
        )
        fit = _fit_to_means(robot, without_wrong(tables, wrong), options, executor)
        fit = replace(fit, wrong=tuple(wrong.values()))
    return fit


def _fit_to_means(
    robot: Robot,
    readings: Mapping[str, Measurements],
    options: Options | None,
    executor: Executor | None,
) -> ModelFit:
    """Return the fit to the means of the readings of each pose; arguments as for
    :func:`fit_tables`.
    """
    tables = {name: by_pose(table) for name, table in readings.items()}
    options = _completed(robot, options, tables)
    some, problem = begin(robot, tables, options, executor)
    fit = with_bearings(_rescaled(_begun(some, executor)))
    _refuse_too_few(tables, fit)
    fit = _by_all(replace(fit, nominal=nominal_without_outliers(fit, executor)), problem, executor)
    fit = _in_best_frame(fit)
    if options.prior_scale is None and options.earlier is None and not observes_places(fit):
        fit = _cautious(fit)
    fit = reweighted_by_stops(reweighted_by_visits(fit, readings))
    if any(station.serial is not None for station in fit.problem.stations):
        fit = placed_at_mean(fit)
    elif options.serial and is_dependent(fit):
        fit = reweighted_by_order(fit)
    fit = with_blocks(fit)
    return replace(fit, scatter=_scatter(fit, readings, tables))


def _scatter(
    fit: ModelFit, readings: Mapping[str, Measurements], tables: Mapping[str, Measurements]
) -> ScatterOfStations:
    """Return the scatter of the readings of each station within and between the stops of its poses,
    by its name; ``tables`` are their means, which were fitted.
    """
    plans = {
        station.name: plan_of(table)
        for station, table in zip(fit.problem.stations, readings.values(), strict=True)
        if not table.is_of_motion
    }
    of_single = frozenset(
        station.name
        for station in fit.problem.stations
        if station.name in plans and weighs_visits(station, plans[station.name])
    )
    return ScatterOfStations(partial(_worked_out, fit, readings, tables, plans), of_single)


def _worked_out(
    fit: ModelFit,
    readings: Mapping[str, Measurements],
    tables: Mapping[str, Measurements],
    plans: Mapping[str, Plan],
) -> dict[str, StopScatter]:
    """Return what :func:`_scatter` promises; ``plans`` are those of the stations, by their names,
    that were not in motion.
    """
    found = dict[str, StopScatter]()
    for table, means, (station, places, blocks), rows in zip(
        readings.values(), tables.values(), fit.stations, fit.problem.rows, strict=True
    ):
        if station.name not in plans:
            continue
        plan = plans[station.name]
        single = station if means is table else fit.readings(table, station=station.name)
        of_table = scatter_of_stops(single, fit.values[places], plan)
        of_table = of_table.with_declared(fit.noise.declared[blocks])
        sound = np.flatnonzero(fit.solution.weights[rows] > 0.0)
        shared, drives = shared_in_fit(
            station.select(sound),
            fit.values[places],
            (plan if means is table else plan_of(means)).select(sound),
            sigma=fit.solution.sigma[blocks],
            free=fit.solution.free[places],
        )
        if station.arrival is not None:
            # Rows of a stop are weighted by what they share.
            shared = 1.0
        of_table = replace(of_table, shared=max(shared / fit.solution.widened, 1.0), drives=drives)
        if weighs_visits(station, plan):
            of_table = replace(of_table, of_single=True)
        elif fit.options.at(station.name).sigma is not None:
            # Declared noise is that of a single reading, and rows are weighted by their number.
            of_table = replace(of_table, readings=1.0, stops=1.0)
        if of_table.is_known:
            found[station.name] = of_table
    return found


def _cautious(fit: ModelFit) -> ModelFit:
    """Return a fit with priors as wide as its readings allow."""
    scale = PriorScale()
    for _ in range(_SCALINGS):
        before = scale
        scale = prior_scale(fit)
        if scale == before:
            break
        fit = with_bearings(
            refit(
                replace(fit, options=replace(fit.options, prior_scale=scale)), fit.options.effects
            )
        )
    return replace(fit, options=replace(fit.options, prior_scale=scale))


def tables_of(measurements: Tables) -> dict[str, Measurements]:
    """Return the rows of each station by its name; a single station needs none.

    Raises:
        BadInputError: without any table, and as :func:`pincal.measure.table.stations_of`.
    """
    if isinstance(measurements, Measurements):
        measurements = {"": measurements}
    if not isinstance(measurements, Mapping):
        measurements = {f"station_{i + 1}": table for i, table in enumerate(measurements)}
    tables = stations_of(measurements.items())
    if not tables:
        raise BadInputError("no tables of measurements; expected one or more")
    for name, variable in RECORDED.items():
        # Approach directions may be recorded on some days only; on the others they are unknown.
        if variable.unknown is not None and any(
            getattr(table, name) is not None for table in tables.values()
        ):
            for key in [key for key, table in tables.items() if getattr(table, name) is None]:
                unknown: dict[str, Any] = {name: np.full(tables[key].q.shape, variable.unknown)}
                tables[key] = replace(tables[key], **unknown)
    return tables


def reads_places(tables: Mapping[str, Measurements]) -> bool:
    """Return whether any table determines target positions; IMUs alone do not."""
    return any(table.sensor is None or table.sensor.reads_place for table in tables.values())


def _completed(robot: Robot, options: Options | None, tables: dict[str, Measurements]) -> Options:
    """Return the options with all named points of the training rows, and with unknown masses among
    the effects.

    Where IMUs are the only instruments, the drives' errors are among the effects, too.
    """
    options = Options() if options is None else options
    if options.earlier is None and not reads_places(tables):
        options = replace(options, effects=with_drives(robot, options.effects))
    options = replace(options, effects=with_masses(robot, options.effects))
    _require_known(robot, options, tables)
    if len(tables) == 1:
        ((name, table),) = tables.items()
        options = options.at(name)
        return replace(options, **_of_table(options, table))
    completed = dict(options.stations)
    for name, table in tables.items():
        at = options.at(name)
        found = _of_table(at, table)
        if any(value is not getattr(at, key) for key, value in found.items()):
            completed[name] = replace(completed.get(name, StationOptions()), **found)
    return replace(options, stations=completed)


def _require_known(robot: Robot, options: Options, tables: Collection[str]) -> None:
    """Raise BadInputError if options are of a station or a joint that there is not."""
    unknown = set(options.stations) - set(tables)
    if unknown:
        raise BadInputError(
            f"options are given for the station {sorted(unknown)[0]!r}; expected one of "
            f"{', '.join(map(repr, tables))}"
        )
    for pattern in options.zeros:
        if not filter_names(robot.joint_names, pattern):
            known = ", ".join(nearest_first([pattern], robot.joint_names))
            raise BadInputError(f"zeros of an unknown joint, {pattern!r}; expected one of {known}")


def _of_table(options: Options, table: Measurements) -> dict[str, Any]:
    """Return the options of a station that are completed by its table."""
    return {
        "setup": options.setup.over(table),
        "tools": _tools(options, table),
        "sigma": _stated_noise(options, table),
    }


def _stated_noise(options: Options, table: Measurements) -> float | None:
    """Return the noise that is declared for a table, else the root mean square of what it states of
    each row; None without either.

    Where poses are repeated the rows are means, and what the readings scatter tells the noise.
    """
    if options.sigma is not None or options.instrument is not None or table.sigma is None:
        return options.sigma
    if table.readings_per_row is not None or table.is_of_motion:
        return None
    return float(np.sqrt(np.mean(table.sigma**2)))


def _tools(options: Options, table: Measurements) -> Tools | None:
    """Return the known positions of a table's targets, including targets that are named points on a
    link.
    """
    on_links = (name for name in map(str, np.unique(table.target)) if is_on_link(name))
    known = {
        name: place for name in on_links if (place := options.setup.points.get(name)) is not None
    }
    return {**known, **(options.tools or {})} if known else options.tools


def _begun(fit: ModelFit, executor: Executor | None = None) -> ModelFit:
    """Return a fit from the start values, with those of an earlier fit where it has any."""
    return _solved(fit, fit.problem.beliefs.with_earlier(fit.values), executor=executor)


def _by_all(fit: ModelFit, problem: Problem, executor: Executor | None) -> ModelFit:
    """Return a fit to some rows of a problem, refitted to all of them; itself if these are all."""
    if len(fit.problem) == len(problem):
        return fit
    log.info(
        "fitting all %d rows, starting from the fit to %d of them", len(problem), len(fit.problem)
    )
    whole = over_all(fit, problem, executor)
    if whole.options.serial and is_dependent(whole):
        # The residuals of all rows under the fit to some show how noise is correlated, which saves
        # one fit.
        whole = with_serial(whole, serial_noise(whole))
    found = with_bearings(_solved(whole, whole.solution, until=Tolerance.NEAR, executor=executor))
    return replace(
        found,
        nominal=nominal_without_outliers(found, executor),
        stages=(*fit.stages, *found.stages),
    )


def _rescaled(fit: ModelFit) -> ModelFit:
    """Return a fit whose prior is an earlier fit with masses, the earlier one rescaled to the
    present masses.
    """
    earlier = fit.options.earlier
    problem = fit.problem
    factor = 1.0
    weight = 0.0 if earlier is None else weight_of(problem, earlier)
    if earlier is None or not weight:
        return fit
    for _ in range(_WEIGHINGS):
        before = factor
        factor = weight_of(problem, fit.estimate) / weight
        if not 0.1 < factor < 10.0 or abs(factor / before - 1.0) < _SAME_WEIGHT:
            break
        problem = replace(problem, earlier=Earlier.of(along_gauge(problem, earlier, factor)))
        fit = _begun(replace(fit, problem=problem, priors=priors_of(problem, fit.options)))
    return fit


def nominal_without_outliers(fit: ModelFit, executor: Executor | None = None) -> Solution:
    """Return the fit of base and tool to the rows that the full fit did not reject, so that
    "before" is judged fairly.
    """
    nominal = fit.nominal
    weights = fit.solution.weights
    sound = weights > 0.0
    if np.array_equal(sound, nominal.weights > 0.0):
        return nominal
    course = Course("none", executor=executor)
    again = solve(
        fit.problem.select(sound), nominal.values, nominal.free, fit.priors, fit.noise, course
    )
    return replace(again, weights=weights, iterations=nominal.iterations)


def expected_fit(robot: Robot, measurements: Tables, options: Options | None = None) -> ModelFit:
    """Return what a calibration with these poses could determine, before it is made.

    The solution is at the nominal geometry, its posterior the one that poses and noise allow. Noise
    that is not declared is estimated by a calibration, since it follows only from residuals.

    Raises:
        BadInputError: as :func:`calibrate`.
    """
    readings = tables_of(measurements)
    tables = {name: by_pose(table) for name, table in readings.items()}
    options = _completed(robot, options, tables)
    some, whole = begin(robot, tables, options, None)
    fit = _begun(some)
    fit = _in_best_frame(
        _by_all(replace(fit, nominal=nominal_without_outliers(fit, None)), whole, None)
    )
    problem = fit.problem
    nominal = fit.nominal
    fitted = fit.solution
    free = released_of(problem, options) & excited_of(problem)
    found = Linearised(problem, nominal.values, free, fitted.weights, fit.priors.sizes).posterior(
        fitted.sigma
    )
    outlook = replace(
        fitted,
        values=nominal.values,
        posterior=found,
        free=free,
        at_bound=np.zeros(len(free), bool),
    )
    return replace(fit, solution=outlook, scatter=_scatter(fit, readings, tables))


def _in_best_frame(fit: ModelFit) -> ModelFit:
    """Return a fit in the moment convention that fits best, if the options leave it open and
    moments matter.
    """
    effects = fit.options.effects
    present = fit.problem.chain.moment_frame
    if fit.options.moment_frame != "auto":
        return fit
    if any(effect.uses_moments for effect in effects):
        few = some_rows_of(fit)
        tried = [few if few is fit else with_bearings(refit(few, effects))]
        for other in (other for other in MOMENT_FRAMES if other != present):
            log.info("assessing --moment-frame %s with %d rows", other, len(few.problem))
            tried.append(with_bearings(refit(few, effects, moment_frame=other)))
        if (best := best_of(tried)) != present:
            return with_bearings(refit(fit, effects, moment_frame=best))
    return replace(fit, options=replace(fit.options, moment_frame=present))


def refit(
    fit: ModelFit,
    effects: Sequence[Effect],
    *,
    moment_frame: MomentFrame | None = None,
    start: Mapping[Effect, np.ndarray] | None = None,
    until: Tolerance = Tolerance.SETTLED,
) -> ModelFit:
    """Fit the same readings with other effects, all parameters jointly, from their present values.

    Args:
        fit: a calibration.
        effects: besides base and tool; parameters that ``fit`` has by name start at its values.
        moment_frame: where moments are taken and deflect the arm; default: as in ``fit``.
        start: values of new effects near the solution, so that the last stage suffices; default:
            zero.
        until: how closely to converge; less is enough if other fits follow.
    """
    frame = moment_frame or fit.problem.chain.moment_frame
    effects = without_idle_features(frame, with_masses(fit.problem.chain.robot, effects))
    begun = fit.with_effects(effects, moment_frame=frame)
    for effect, values in (start or {}).items():
        begun.values[begun.problem.places_at(effect)] = values
    begun = replace(begun, priors=priors_of(begun.problem, begun.options))
    return _solved(begun, begun.values if start is None else begun.solution, until=until)


def told_by(fit: ModelFit) -> Tolerance:
    """Return how closely a last fit has to converge to tell what it shows.

    Where rows are correlated along their order, noise and outliers follow each step, and the fit
    comes to rest late, by steps that no test resolves.
    """
    is_along_rows = any(station.serial is not None for station in fit.problem.stations)
    return Tolerance.TOLD if is_along_rows else Tolerance.SETTLED


def refitted_without(
    fit: ModelFit, effects: Iterable[Effect], until: Tolerance = Tolerance.SETTLED
) -> ModelFit:
    """Fit the same readings without some effects of a fit, all others jointly; to a convergence
    that is only ``until`` close, in the last stage alone.

    A test of what was left out needs it: unless the others are at their best, what they would take
    up counts as noise.
    """
    rest = reduce(without, effects, fit).options.effects
    return refit(fit, rest, start={} if until is Tolerance.CLOSE else None, until=until)


def reweighted_by_visits(fit: ModelFit, tables: Mapping[str, Measurements]) -> ModelFit:
    """Return a fit with means of poses weighted by the visits behind them; perhaps all poses were
    visited alike.
    """
    found = with_visits(fit, tables)
    return fit if found is fit else refit(found, fit.options.effects, start={})


def reweighted_by_stops(fit: ModelFit) -> ModelFit:
    """Return a fit with rows of one stop of the robot weighted by the noise that they share;
    perhaps none do.
    """
    found = with_arrivals(fit)
    return fit if found is fit else refit(found, fit.options.effects, start={})


def reweighted_by_order(fit: ModelFit, until: Tolerance = Tolerance.SETTLED) -> ModelFit:
    """Return a fit with rows weighted by the correlated noise that its residuals show along their
    order; perhaps none. ``until`` is how closely the weighted fit converges.
    """
    found = serial_noise(fit)
    if not any(
        serial is not None
        for serial in (*found, *(station.serial for station in fit.problem.stations))
    ):
        return fit
    return placed_at_mean(
        refit(with_serial(fit, found), fit.options.effects, start={}, until=until)
    )


def with_bearings(fit: ModelFit) -> ModelFit:
    """Return a fit with the bearing features that the data require, which may take further fits."""
    more = required_features(fit).effects
    return with_bearings(refit(fit, (*fit.options.effects, *more), start={})) if more else fit


def _solved(
    fit: ModelFit,
    start: np.ndarray | Solution,
    *,
    until: Tolerance = Tolerance.SETTLED,
    executor: Executor | None = None,
) -> ModelFit:
    """Run the stages, each from the end of the one before; only the last ones from a solution
    nearby.
    """
    problem, options = fit.problem, fit.options
    stages = list[FitStage]()
    released = released_of(problem, options)
    excited = released & excited_of(problem)

    def solved(
        name: str, at: np.ndarray | Linearised, free: np.ndarray, **how: Any
    ) -> tuple[Solution, Linearised]:
        course = Course(options.loss, label=name, executor=executor, **how)
        found, point = solve_to(problem, at, free, fit.priors, fit.noise, course)
        stages.append(FitStage(name, found.iterations, float(found.estimated[0])))
        return found, point

    point = None
    if isinstance(start, Solution):
        fitted = replace(start, free=excited)
    else:
        for name, free, columns in _plan(problem, excited, released, options):
            fitted, point = solved(name, start, free, rough=True, columns=columns)
            start = fitted.values
    for name in _LAST_STAGES[until]:
        missed, begun = _is_missed(replace(fit, solution=fitted), released, point)
        if missed or name == "final":
            short = _SHORT.get(until, SETTLED)
            free = released if missed else fitted.free
            fitted, point = solved(name, begun, free, short=short, ahead=until is Tolerance.NEAR)
        if not missed and fitted.iterations <= 1:
            # The test was made at the solution itself.
            break
    return replace(fit, solution=fitted, stages=tuple(stages))


def _plan(
    problem: Problem, free: np.ndarray, released: np.ndarray, options: Options
) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Return the names of the stages, the parameters that each releases, and those whose columns
    are needed at its end: after the last stage also what :func:`_is_missed` tests.
    """
    tested = free | (released & problem.is_shared)
    if options.stages == "joint":
        return [("all", free, tested)]
    effects = np.array([parameter.effect for parameter in problem.parameters])
    frames = is_frame(problem)
    masks = {
        name: free & (frames | np.isin(effects, group)) for name, group in PAPER_STAGES.items()
    }
    stages = [(name, mask, mask) for name, mask in masks.items() if np.any(mask & ~frames)]
    return [*stages, ("4 all", free, tested)]


def _is_missed(
    fit: ModelFit, released: np.ndarray, point: Linearised | None = None
) -> tuple[bool, Linearised]:
    """Return whether the data require parameters that the nominal geometry never excites (a score
    test).

    Such a parameter times a deviation makes a ridge along which a fit wanders, so it is released
    only if required. The problem linearised at the fit is returned as well: ``point``, where that
    has all columns.
    """
    problem = fit.problem
    fitted = fit.solution
    sizes = fit.priors.sizes
    # A parameter that only one of several stations has concerns that station alone.
    held = released & ~fitted.free & problem.is_shared
    free = fitted.free | held
    if point is not None and np.array_equal(point.free, free):
        found = point.reweighted(fitted.weights)
    else:
        found = Linearised(problem, fitted.values, free, fitted.weights, sizes)
    if not held.any():
        return False, found
    wide = found.posterior(np.maximum(fitted.sigma, rounding(problem)))
    if is_exact(wide.whole, usual_sizes(problem, sizes)[found.free]):
        # The smallest deviation counts, and is lost in the rounding of H.
        return bool(np.any(fitted.estimated > rounding(problem))), found
    kept = fitted.free[found.free]
    gain = wide.gains_beyond(kept)(~kept)
    # Rows that are correlated hold as much information as blocks of them do.
    return bool(gain / fitted.widened > chdtri(int(held.sum()), CRITERIA.unexcited)), found


def doubts_of_known(fit: ModelFit) -> tuple[str, ...]:
    """Return warnings if the readings contradict given sensor parameters, which the fit held (a
    score test).
    """

    def given(sensor: Sensor) -> bool:
        return isinstance(sensor, KnownParameters) and sensor.is_given

    held = of_stations(
        fit.problem, lambda s: s.sensors(s.sensor.fixed if given(s.sensor) else False)
    )
    doubts = [
        s.sensor.doubt
        for s in fit.problem.stations
        if isinstance(s.sensor, KnownParameters) and given(s.sensor)
    ]
    is_doubted = held.any() and _is_missed(fit, fit.solution.free | held)[0]
    return tuple(dict.fromkeys(doubts)) if is_doubted else ()


def _refuse_too_few(tables: dict[str, Measurements], fit: ModelFit) -> None:
    """Refuse a fit with as many parameters as readings, which leaves nothing to estimate the noise
    from.
    """
    if fit.noise.declared[0] is not None:
        return
    problem = fit.problem
    fitted = fit.solution
    readings = int(problem.readings(fitted.weights).sum())
    rows = np.count_nonzero(fitted.weights)
    if problem.earlier is None:
        spent = fitted.posterior.visible_rank
    else:
        spent = CRITERIA.readings_left + int(np.sum(fitted.free & ~problem.beliefs.is_earlier))
    if spent >= readings:
        raise MeasurementError(
            f"{', '.join(table.source for table in tables.values())}: {rows} training poses give "
            f"{readings} readings, no more than the parameters to be fitted, so the noise can't be "
            "estimated; measure more poses, declare the noise (--noise) or fit less (--model "
            "geometric, --fix)"
        )
