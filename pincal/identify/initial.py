"""Start values of a station: the best of its sensor's closed-form placements of base and tool."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from pincal.errors import BadInputError, MeasurementError
from pincal.identify.beliefs import (
    bounds_of,
    declared_noise,
    excited_of,
    is_frame,
    of_sensors,
    priors_of,
    released_of,
    require_named,
)
from pincal.identify.believed import Earlier
from pincal.identify.fit import ModelFit, Priors, Solution
from pincal.identify.many_rows import some_of
from pincal.identify.noise import Noise
from pincal.identify.options import Options, StationOptions
from pincal.identify.problem import Problem, effects_at
from pincal.identify.solve import Course, likeliest_values, solve
from pincal.identify.station import Station, station_of
from pincal.identify.unturned import unturned
from pincal.measure.measurements import Measurements
from pincal.model.catalogue.motion import InstrumentClock
from pincal.model.chain import Chain
from pincal.model.effect import Effect, Family
from pincal.model.effects import BaseFrame, ToolFrame
from pincal.model.model import Model
from pincal.parameters import FRAME_SYMBOLS, carried_over
from pincal.robot.link_path import LinkPath
from pincal.robot.robot import Robot
from pincal.robot.se3 import placed as placed_frame
from pincal.sensors.extrinsics import Extrinsics
from pincal.thresholds import Count, Scale

# Rows that suffice for a start, and for its short fit; many stations share them, with a minimum for
# each.
_ROWS: Count = 2000
_SETTLED_ROWS: Count = 500
_FEWEST_SETTLED_ROWS: Count = 40
# Starts whose residuals agree to this factor end in the same place; rounding does not choose among
# them.
_ALIKE: Scale = 1.0 + 1e-6


def _weighted_as_means(station: Station, table: Measurements, *, is_declared: bool) -> Station:
    """Return a station with its rows weighted by the readings of which each is the mean, if their
    noise is declared.

    Otherwise the model error of a pose may dominate, and each row counts once.
    """
    if table.readings_per_row is None or not is_declared:
        return station
    return replace(station, weights=station.weights * np.sqrt(table.readings_per_row))


def begin(
    robot: Robot, tables: Mapping[str, Measurements], options: Options, executor: Executor | None
) -> tuple[ModelFit, Problem]:
    """Return the fit of base and tool alone, to a sample if there are very many rows, and the
    problem with all rows.
    """
    if len(tables) == 1:
        tables = {"": next(iter(tables.values()))}
    placed = place(robot, tables, options)
    stations = (
        _weighted_as_means(station, table, is_declared=options.at(name).sigma is not None)
        for (station, _), (name, table) in zip(placed, tables.items(), strict=True)
    )
    earlier = None if options.earlier is None else Earlier.of(options.earlier)
    whole = Problem(tuple(stations), earlier)
    problem = some_of(whole)
    require_named(problem, options)
    values = _joined(problem, placed)
    released = released_of(problem, options)
    options = replace(options, unturned=unturned(problem, released))
    priors = priors_of(problem, options)
    noise = declared_noise(problem, options)
    nominal = _fitted_frames(problem, values, released, (priors, noise), options, executor)
    return ModelFit(problem, nominal, nominal, priors, noise, (), options), whole


def _fitted_frames(
    problem: Problem,
    values: np.ndarray,
    released: np.ndarray,
    known: tuple[Priors, Noise],
    options: Options,
    executor: Executor | None,
) -> Solution:
    """Return the fit of base and tool alone from start values, shape (P,), then with the lens of
    a camera or the errors of an IMU.

    Args:
        problem: the stations.
        values: shape (P,).
        released: shape (P,), parameters that a fit releases.
        known: priors and noise.
        options: of the calibration.
        executor: as for :func:`begin`.
    """
    free = is_frame(problem) & released
    lens = of_sensors(problem) & released & ~free
    course = Course(options.loss, rough=True, executor=executor)
    of_next = None if lens.any() else _columns_of_all(problem, released, options)
    first = replace(course, label="base and tool", columns=of_next)
    found = solve(problem, values, free, *known, first)
    if lens.any():
        seen = replace(course, label="base, tool and instrument")
        found = solve(problem, found.values, free | lens, *known, seen)
    return found


def _columns_of_all(problem: Problem, released: np.ndarray, options: Options) -> np.ndarray | None:
    """Return the parameters that the fit of everything begins with, shape (P,), where it begins at
    the end of the fit of base and tool and remembers what was linearised there; None elsewhere.
    """
    free = released & excited_of(problem)
    is_next = options.stages == "joint" and options.earlier is None
    return free if is_next and problem.work.remembers(int(free.sum())) else None


def _joined(problem: Problem, placed: Sequence[tuple[Station, np.ndarray]]) -> np.ndarray:
    """Return the values of all parameters of a problem, shape (P,), given those of each station."""
    values = np.zeros(len(problem.parameters))
    for (_, local), places in zip(placed, problem.places, strict=True):
        values[places] = local
    return values


def place(
    robot: Robot, tables: Mapping[str, Measurements], options: Options
) -> list[tuple[Station, np.ndarray]]:
    """Return stations with base and tool roughly placed, and the values to start from."""
    found = []
    models = _Models()
    for station, values in place_setups(_arm(robot, options), np.zeros(0), tables, options=options):
        effects = (*station.model.effects, *effects_at(options.effects, station.name))
        model = replace(station.model, effects=effects, equilibrium=options.equilibrium)
        index = {parameter.name: i for i, parameter in enumerate(station.parameters)}
        whole = station.with_model(models.same(model))
        found.append((whole, carried_over(values, index, whole.parameters)))
    return found


def starts_of(
    robot: Robot, table: Measurements, options: Options
) -> list[tuple[Station, np.ndarray]]:
    """Return a station at each of its sensor's closed-form placements, not fitted yet, with its
    values there.
    """
    return _candidates(_arm(robot, options), np.zeros(0), table, "", options, _Models())


def _arm(robot: Robot, options: Options) -> Model:
    """Return the nominal arm alone."""
    return Model(Chain.of(robot, moment_frame=options.first_frame, gravity=options.gravity), ())


class _Models:
    """Models of stations, which share what depends only on the kinds of their frames
    and targets.
    """

    def __init__(self) -> None:
        self._first: dict[tuple[object, ...], Model] = {}
        self._arms: dict[tuple[object, ...], Model] = {}

    def arm(self, arm: Model, targets: tuple[str, ...], links: tuple[str, str]) -> Model:
        """Return the arm between two links with these targets, base and tool at the instrument and
        the tip.
        """
        if (targets, links) not in self._arms:
            tools = np.tile(np.eye(3), (len(targets), 1, 1))
            ends = arm.chain.between(*links).ends
            nowhere = replace(arm.chain, targets=targets, tool_rotations=tools, ends=ends)
            found = arm.with_chain(nowhere.with_references(np.eye(3), nowhere.tool_rotations))
            # Chains about other references share what is cached here.
            assert len(found.chain.nominal) and len(found.chain.drives)
            self._arms[targets, links] = found
        return self._arms[targets, links]

    def same(self, model: Model) -> Model:
        """Return the model, sharing its parts with an earlier one that differs only by base and
        tool placement.
        """
        frames = tuple(e if e.family is Family.EXTRINSICS else id(e) for e in model.effects)
        first = self._first.setdefault((model.chain.targets, model.chain.path, frames), model)
        if first is model:
            assert model.parameters and model.of_station is not None
        return first.with_chain(model.chain)


def links_of(measurements: Measurements, path: LinkPath) -> tuple[str, str]:
    """Return the links between which all rows of a table are; default: the ends of a path."""
    ends = zip((measurements.from_link, measurements.to_link), (path.start, path.tip), strict=True)
    start, tip = (default if column is None else str(column[0]) for column, default in ends)
    return start, tip


def place_setups(
    arm: Model, values: np.ndarray, tables: Mapping[str, Measurements], *, options: Options
) -> list[tuple[Station, np.ndarray]]:
    """Return the result of :func:`place_arm`, with one instrument pose for the stations of a
    set-up.

    It is the pose at the station with the most rows.
    """
    by_rows = sorted(tables, key=lambda name: len(tables[name]))
    largest = {tables[name].setup: name for name in by_rows}
    first = {n: t for n, t in tables.items() if not t.setup or largest[t.setup] == n}
    # What others are placed by is fitted.
    alone = len(first) == len(tables)
    found = place_arm(arm, values, first, options=options, is_start=alone)
    placed = dict(zip(first, found, strict=True))
    for name, table in tables.items():
        if name not in placed:
            station, there = placed[largest[table.setup]]
            own = StationOptions(
                **vars(options.stations.get(name, StationOptions()))
                | {"base": _base_of(station, there)}
            )
            known = replace(options, stations={**options.stations, name: own})
            ((other, at),) = place_arm(arm, values, {name: table}, options=known)
            # Equal values mean an equal pose about an equal reference.
            chain = other.model.chain.with_references(
                station.model.chain.base_rotation, other.model.chain.tool_rotations
            )
            for k, parameter in enumerate(other.parameters):
                if parameter.element == "base":
                    at[k] = there[station.parameters.index(parameter)]
            placed[name] = other.with_model(other.model.with_chain(chain)), at
    return [placed[name] for name in tables]


def base_seen(robot: Robot, tables: Mapping[str, Measurements], options: Options) -> np.ndarray:
    """Return the pose of the nominal arm's first link in the frame of the only station's
    instrument, shape (4, 4).
    """
    ((station, values),) = place_arm(_arm(robot, options), np.zeros(0), tables, options=options)
    return _base_of(station, values)


def _base_of(station: Station, values: np.ndarray) -> np.ndarray:
    """Return the pose of a station's first link in the instrument's frame, shape (4, 4)."""
    index = {parameter.name: i for i, parameter in enumerate(station.parameters)}
    at = [
        values[index[name]] if (name := f"base.{symbol}") in index else 0.0
        for symbol in FRAME_SYMBOLS
    ]
    return placed_frame(station.model.chain.base_rotation, np.array(at))


def place_arm(
    arm: Model,
    values: np.ndarray,
    tables: Mapping[str, Measurements],
    *,
    options: Options,
    is_start: bool = False,
) -> list[tuple[Station, np.ndarray]]:
    """Return the stations of an arm with known deviations, base and tool roughly placed, and their
    values.

    Each station takes the closed-form start with the smallest residuals once base and tool are
    fitted, the last of equals.

    Args:
        arm: the arm's chain and effects, without base and tool; its targets and reference
            orientations are ignored.
        values: shape (P,), of its parameters.
        tables: each station's table by its name, "" for a single one.
        options: prior knowledge of the stations.
        is_start: whether base and tool are fitted afterwards, so that where each station has a
            single closed-form start these are the result.
    """
    models = _Models()
    candidates = [
        _candidates(arm, values, table, name, options.at(name), models)
        for name, table in tables.items()
    ]
    if is_start and all(len(starts) == 1 for starts in candidates):
        return [starts[0] for starts in candidates]
    best: list[tuple[float, Station, np.ndarray]] = [(np.inf, *starts[0]) for starts in candidates]
    every = [(i, start) for i, starts in enumerate(candidates) for start in starts]
    # Stations that share more than the robot are placed one by one.
    is_apart = any(start[0].shares_setup for _, start in every)
    for some in [[one] for one in every] if is_apart else [every]:
        most = max(_FEWEST_SETTLED_ROWS, _ROWS // (1 if is_apart else len(candidates)))
        settled = _settled([start for _, start in some], options, min(_SETTLED_ROWS, most))
        for (i, (station, _)), (rest, found) in zip(some, settled, strict=True):
            if rest < _ALIKE * best[i][0]:
                best[i] = rest, station, found
    return [(station, found) for _, station, found in best]


def _candidates(
    arm: Model,
    values: np.ndarray,
    measurements: Measurements,
    name: str,
    options: Options,
    models: _Models,
) -> list[tuple[Station, np.ndarray]]:
    """Return the possible placements of a station, with their values."""
    if len(measurements) == 0:
        raise MeasurementError(f"{measurements.source}: no rows to calibrate with")
    targets = tuple(str(t) for t in np.unique(measurements.target))
    arm = models.arm(arm, targets, links_of(measurements, arm.chain.path))
    centre = np.array(options.payload_centre)
    instrument = options.instrument
    rows = station_of(arm, measurements, centre, options.setup, name=name, instrument=instrument)
    some = rows.sample(_ROWS)
    tips = np.ascontiguousarray(arm.predict(values, some.conditions.at_moments))
    found = some.sensor.starts(tips, some.conditions.target, len(targets))
    candidates = [_known(placement, arm.chain, options) for placement in found]
    if not rows.sensor.base_symbols:
        candidates = [replace(candidate, base=np.eye(4)) for candidate in candidates]
    frames: tuple[Effect, ...] = (
        BaseFrame(rows.sensor.base_symbols),
        ToolFrame(rows.sensor.tool_symbols),
    )
    if measurements.moving is not None:
        moving = measurements.moving
        stamps = tuple(at for at, _ in moving.steps)
        frames += (InstrumentClock(moving.middle, steps=stamps),)
    whole = rows.with_model(models.same(arm.with_effects([*frames, *arm.effects])))
    deviations = dict(zip(arm.names, values, strict=True))
    return [_at(whole, placement, deviations) for placement in candidates]


def _known(placement: Extrinsics, chain: Chain, options: Options) -> Extrinsics:
    """Return a placement with the base and tools that the user gave."""
    base = placement.base if options.base is None else np.asarray(options.base, float)
    tools = placement.tools.copy()
    for name, given in (options.tools or {}).items():
        if name not in chain.targets:
            raise BadInputError(
                f"tool {name!r} is given but no row has this target; targets: "
                f"{', '.join(chain.targets)}"
            )
        if np.shape(given) == (4, 4):
            tools[chain.targets.index(name)] = given
        else:
            tools[chain.targets.index(name), :3, 3] = given
    return replace(placement, base=base, tools=tools)


def _at(
    station: Station, placement: Extrinsics, deviations: Mapping[str, float]
) -> tuple[Station, np.ndarray]:
    """Return the station about a placement, and its values there, with the arm's deviations by
    name.
    """
    chain = station.model.chain.with_references(placement.base[:3, :3], placement.tools[:, :3, :3])
    station = station.with_model(station.model.with_chain(chain))
    values = np.zeros(len(station.parameters))
    station.split(values)[1][:] = placement.own
    names = {parameter.name: i for i, parameter in enumerate(station.parameters)}
    for name, value in deviations.items():
        values[names[name]] = value
    for element, at in [
        ("base", placement.base),
        *zip(chain.targets, placement.tools, strict=True),
    ]:
        for symbol, value in zip("xyz", at[:3, 3], strict=True):
            if f"{element}.{symbol}" in names:
                values[names[f"{element}.{symbol}"]] = value
    return station, values


def _settled(
    starts: list[tuple[Station, np.ndarray]], options: Options, most: int
) -> list[tuple[float, np.ndarray]]:
    """Return the median row residual and the values after a short fit of base and tool to at most
    ``most`` rows, robust against outliers.

    Starts of one station are stations of their own in one fit, which takes half the time of two.
    """
    names = [station.name for station, _ in starts]
    if len(set(names)) < len(names):
        own = [f"{name} from start {k}" for k, name in enumerate(names)]
        given = {
            new: options.stations[name]
            for new, name in zip(own, names, strict=True)
            if name in options.stations
        }
        options = replace(options, stations=given)
        names = own
    samples = [
        replace(station.sample(most), name=name)
        for name, (station, _) in zip(names, starts, strict=True)
    ]
    problem = Problem(tuple(samples))
    values = _joined(problem, starts)
    free = released_of(problem, options) & is_frame(problem)
    priors = Priors(np.full(len(values), np.inf), bounds_of(problem, options))
    values = likeliest_values(
        problem, values, free, priors, declared_noise(problem, options), Course("huber")
    )
    left = [
        np.linalg.norm(residuals, axis=0)
        for batch in problem.batches
        for residuals in batch.residuals(values)
    ]
    return [
        (float(np.median(size)), values[places])
        for size, places in zip(left, problem.places, strict=True)
    ]
