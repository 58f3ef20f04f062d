"""The rows of a calibration, station by station, and its errors at rows that a fit has not seen.

All rows are fitted, and their errors stated by cross-validation (:mod:`pincal.identify.folds`),
unless rows are held out for good or whole stations in turn. An error is that of a reading: the
means of poses are fitted, but one visit of a pose has more noise than their mean. Each pose counts
once in the statistics, however often it was visited.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Literal, cast, get_args

import numpy as np
from numpy.typing import ArrayLike

from pincal.calibration.checked_fit import fitted
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.placing import place_station
from pincal.errors import BadInputError
from pincal.identify.calibrate import Tables, tables_of
from pincal.identify.fit import ModelFit, Solution
from pincal.identify.folds import Folds, Way, left_out_residuals
from pincal.identify.options import Options
from pincal.identify.problem import Problem
from pincal.identify.split import hold_out, ways_held_out
from pincal.identify.station import Station
from pincal.measure.admit import admit_test, scorable_rows, usable_rows
from pincal.measure.measurements import Measurements
from pincal.measure.poses import SCATTER, by_pose, replicate_groups
from pincal.measure.stops import StopRows
from pincal.model.effects import GEOMETRIC
from pincal.robot.robot import Robot
from pincal.sensors.setup import Setup
from pincal.spread import spread
from pincal.thresholds import Scale
from pincal.validate.accuracy import error_statistics, pose_error_sizes

SplitBy = Literal["both", "random", "blocked", "station"]
"""Folds, or held-out rows: regions of joint space and stretches of rows (and sessions), rows at
random, regions alone, or each station in turn."""

WAYS: Mapping[SplitBy, tuple[Way, ...]] = {
    "both": ("regions", "stretches", "sessions"),
    "random": ("random",),
    "blocked": ("regions",),
    "station": (),
}
"""The ways in which rows are divided into folds."""

# Relative difference of two errors that is rounding.
_ROUNDING: Scale = 1e-6


@dataclass(frozen=True)
class StationRows:
    """Rows of one station.

    Attributes:
        name: of the station; "" for a single one.
        train: fitted poses, the mean of the readings of each.
        test: held-out poses; may be empty.
        measured: the rows of both as measured.
        ways: for each of two ways of holding rows out its held-out poses, shape (test,); empty for
            one way.
        wrong: lines of readings that others of their pose show to be wrong, which are in none of
            these tables.
        screened_from: the rows of both with these readings; default: there are none.
    """

    name: str
    train: Measurements
    test: Measurements
    measured: tuple[Measurements, Measurements]
    ways: Mapping[Way, np.ndarray] = field(default_factory=dict)
    wrong: tuple[int, ...] = ()
    screened_from: tuple[Measurements, Measurements] | None = None

    @property
    def as_read(self) -> tuple[Measurements, Measurements]:
        """The rows of both with wrong readings among them."""
        return self.measured if self.screened_from is None else self.screened_from

    @classmethod
    def of(
        cls,
        name: str,
        train: Measurements,
        test: Measurements | None = None,
        ways: Mapping[Way, np.ndarray] | None = None,
    ) -> StationRows:
        """Return the rows of a station by pose, from rows to fit, held-out rows, and lines held out
        in each way.
        """
        test = train.select(slice(0)) if test is None else test
        poses = by_pose(test)
        of_ways = {way: np.isin(poses.rows, lines) for way, lines in (ways or {}).items()}
        return cls(name, by_pose(train), poses, (train, test), of_ways)

    def held(self, fit: ModelFit) -> Station | None:
        """Return the held-out poses under the calibrated model; None without any."""
        return fit.readings(self.test, station=self.name) if len(self.test) else None

    def by_row(self, values: np.ndarray) -> np.ndarray:
        """Return values of the fitted poses, shape (..., poses), for each fitted row as measured,
        shape (..., N).
        """
        rows, _ = self.measured
        return values if self.train is rows else values[..., self.pose]

    @cached_property
    def pose(self) -> np.ndarray:
        """The fitted pose of each fitted row as measured, shape (N,)."""
        return replicate_groups([self.measured[0]], within=SCATTER)[0]

    @cached_property
    def share(self) -> np.ndarray:
        """The weight of each fitted row in statistics, shape (N,): those of a pose's readings add
        up to 1.
        """
        if self.train is self.measured[0]:
            return np.ones(len(self.train))
        return np.asarray(1.0 / np.bincount(self.pose)[self.pose])


@dataclass(frozen=True)
class LeftOut:
    """A station predicted by the model of the others.

    Attributes:
        station: its name.
        sizes: model -> unit ("mm", ...) -> shape (N,), error magnitude at each row, of the
            "nominal", "geometric" and "calibrated" robot; empty if it can't be predicted.
        obstacle: why not; empty otherwise.
    """

    station: str
    sizes: Mapping[str, Mapping[str, ArrayLike]] = field(default_factory=dict)
    obstacle: str = ""


@dataclass(frozen=True, kw_only=True)
class HeldBack:
    """How rows are divided into those that a fit sees and others.

    Attributes:
        test_fraction: part of each station's poses that is held out for good; ignored with
            ``holdout``.
        split: how folds, or the poses held out, are chosen.
        seed: of this choice.
        holdout: other measurements in place of held-out rows.
    """

    test_fraction: float = 0.0
    split: SplitBy = "both"
    seed: int = 0
    holdout: Tables | None = None

    @property
    def others(self) -> tuple[Measurements, ...]:
        """The other measurements."""
        return () if self.holdout is None else tuple(tables_of(self.holdout).values())

    def divided(
        self, robot: Robot, tables: Mapping[str, Measurements], setup_of: Callable[[str], Setup]
    ) -> tuple[StationRows, ...]:
        """Return the rows of each station, none of them held out with the split "station".

        Raises:
            BadInputError: if other measurements are not of a fitted station, or can't be of this
                robot.
        """
        if self.holdout is not None:
            return _with_holdout(robot, tables, self.holdout, setup_of)
        return tuple(self._rows(name, table, setup_of(name)) for name, table in tables.items())

    def folds(self, problem: Problem) -> Folds | None:
        """Return the division of the fitted poses by which errors are stated; None where rows are
        held out for good.
        """
        if self.holdout is not None or self.test_fraction:
            return None
        return Folds.of(problem, WAYS[self.split], seed=self.seed)

    def _rows(self, name: str, table: Measurements, setup: Setup) -> StationRows:
        """Return the rows of a station."""
        if self.split == "station":
            return StationRows.of(name, table)
        if not self.test_fraction:
            return StationRows.of(name, usable_rows(table, setup))
        ways: dict[Way, np.ndarray] = {}
        if self.split == "both":
            held = ways_held_out(table, self.test_fraction, seed=self.seed)
            ways = {way: table.rows[rows] for way, rows in held.items() if rows.any()}
            is_held = np.any(list(held.values()), axis=0)
            train = table.select(~is_held)
            test = table.select(is_held)
        else:
            train, test = hold_out(table, self.test_fraction, split=self.split, seed=self.seed)
        train = usable_rows(train, setup)
        return StationRows.of(name, train, scorable_rows(test, setup.over(train)), ways)


def _with_holdout(
    robot: Robot,
    tables: Mapping[str, Measurements],
    holdout: Tables,
    setup_of: Callable[[str], Setup],
) -> tuple[StationRows, ...]:
    """Return the rows of each station with the held-out rows of other tables."""
    held = tables_of(holdout)
    if len(tables) == len(held) == 1:
        held = dict(zip(tables, held.values(), strict=True))
    for name in held.keys() - tables.keys():
        raise BadInputError(
            f"{held[name].source}: validation rows of an unknown station, {name!r}; expected one "
            f"of {', '.join(map(repr, tables))}: name it in a column station, or hold rows out by "
            "--test-fraction"
        )
    tests = {
        name: admit_test(robot, held[name], setup_of(name).over(tables[name]))
        for name in tables
        if name in held
    }
    return tuple(StationRows.of(name, table, tests.get(name)) for name, table in tables.items())


def by_stops(fit: ModelFit, rows: Sequence[StationRows]) -> ModelFit:
    """Return a fit over the means of the sound readings of each stop, where means of poses were
    fitted; else itself.

    Readings of a stop share where the drives arrived, so that they are no replicates of each other.
    """
    if all(part.train is part.measured[0] for part in rows):
        return fit
    problem = fit.problem
    tables = list[Measurements]()
    for part, of in zip(rows, problem.rows, strict=True):
        as_read = part.measured[0]
        sound = part.by_row(fit.solution.weights[of]) > 0.0
        sound &= ~np.isin(as_read.rows, part.wrong)
        tables.append(StopRows.of(as_read.select(sound)).table)
    stations = tuple(
        fit.readings(table, station=at.name)
        for table, at in zip(tables, problem.stations, strict=True)
    )
    return fit.over(stations, np.ones(sum(map(len, stations))))


@dataclass(frozen=True)
class LeftOutErrors:
    """Errors of the fitted readings of one station, each predicted by a fit without its fold.

    Attributes:
        residuals: shape (m, N), reading minus prediction; nan where nothing else determines its
            target or point.
        sizes: unit ("mm", ...) -> shape (N,), magnitude of the error.
        counted: shape (N,), readings that are neither outliers nor undetermined.
        share: shape (N,), weight of each reading in statistics.
    """

    residuals: np.ndarray
    sizes: Mapping[str, np.ndarray]
    counted: np.ndarray
    share: np.ndarray

    @property
    def counted_sizes(self) -> dict[str, np.ndarray]:
        """The magnitudes of those that count."""
        return {unit: of[self.counted] for unit, of in self.sizes.items()}


def left_out_errors(
    fit: ModelFit, solution: Solution, rows: Sequence[StationRows], folds: Folds
) -> dict[Way, list[LeftOutErrors]]:
    """Return the errors of all fitted readings by fits without their folds, way by way, station by
    station.

    Args:
        fit: the fit of all rows.
        solution: its full solution, or that of base and tool alone.
        rows: the rows of each station.
        folds: the division of the fitted poses.
    """
    found: dict[Way, list[LeftOutErrors]] = {way: [] for way in folds.of_way}
    by_way = left_out_residuals(fit, solution, list(folds.of_way.values()))
    for k, part in enumerate(rows):
        fitted = fit.problem.stations[k]
        values = solution.values[fit.problem.places[k]]
        station, pose, share = _as_read(fit, k, part)
        by_all = fitted.residuals(values)
        of_readings = by_all if station is fitted else station.residuals(values)
        is_kept = fit.solution.weights[fit.problem.rows[k]][pose] > 0.0
        for way, by_station in zip(found, by_way, strict=True):
            # Without the fold all readings of a pose are predicted elsewhere by the same vector.
            residuals = of_readings + (by_station[k] - by_all)[:, pose]
            sizes = pose_error_sizes(station, values, residuals=residuals)
            counted = np.isfinite(residuals).all(axis=0) & is_kept
            found[way].append(LeftOutErrors(residuals, sizes, counted, share))
    return found


def _as_read(fit: ModelFit, k: int, part: StationRows) -> tuple[Station, np.ndarray, np.ndarray]:
    """Return a station of a fit over its readings, the fitted row of each, shape (N,), and its
    share in statistics.
    """
    station = fit.problem.stations[k]
    table = part.measured[0]
    n = len(station)
    if part.train is table or n != len(part.train):
        # Each row is a reading, or some of the means were fitted.
        return station, np.arange(n), np.ones(n)
    return fit.readings(table, station=station.name), part.pose, part.share


def statistics_of(parts: Sequence[LeftOutErrors]) -> dict[str, float]:
    """Return the error statistics of several stations together; empty where nothing counts."""
    parts = [part for part in parts if part.counted.any()]
    return error_statistics(
        [part.counted_sizes for part in parts], shares=[part.share[part.counted] for part in parts]
    )


def errors_held_out(
    fit: ModelFit, solution: Solution, rows: Sequence[StationRows], folds: Folds | None = None
) -> dict[str, dict[str, float]]:
    """Return the error statistics of rows that a fit has not seen, of all stations together.

    See :func:`pincal.validate.accuracy.error_statistics`. They are of each way of the folds
    ("regions", "stretches", ...); of rows that were held out for good also of all of them, "test".
    Arguments as for :func:`left_out_errors`.
    """
    if folds is not None:
        of_way = {
            way: statistics_of(parts)
            for way, parts in left_out_errors(fit, solution, rows, folds).items()
        }
        return {way: found for way, found in of_way.items() if found}
    sizes: dict[str, list[dict[str, np.ndarray]]] = {}
    for part, places in zip(rows, fit.problem.places, strict=True):
        station = part.held(fit)
        if station is None:
            continue
        found = pose_error_sizes(station, solution.values[places])
        sizes.setdefault("test", []).append(found)
        for way, mask in part.ways.items():
            if mask.any():
                sizes.setdefault(way, []).append(
                    {unit: of_unit[mask] for unit, of_unit in found.items()}
                )
    return {name: error_statistics(parts) for name, parts in sizes.items()}


def nominal_errors(
    fit: ModelFit, rows: Sequence[StationRows], folds: Folds
) -> dict[str, dict[str, float]]:
    """Return the error statistics with only base and tool fitted, by each way of the folds; see
    :func:`errors_held_out`.

    They are the same for a table whatever the noise of a fit to it is found to be.
    """
    return errors_held_out(_by_independent_rows(fit), fit.nominal, rows, folds)


def _by_independent_rows(fit: ModelFit) -> ModelFit:
    """Return a fit whose rows have independent noise of the same size in all directions."""
    plain = (
        replace(station, whitening=None, serial=None, arrival=None)
        for station in fit.problem.stations
    )
    return fit.over(plain)


def headline_of(errors: Mapping[str, Mapping[str, float]]) -> str:
    """Return which of the errors of :func:`errors_held_out` is the headline: those of all rows that
    were held out for good, "test", or the way of the folds in which predictions are worse, of equal
    ones the first.
    """
    ways = [] if "test" in errors else [name for name in errors if name in get_args(Way)]
    first = {way: next(iter(errors[way].values())) for way in ways}
    # Ways that leave out the same rows differ by rounding, which decides nothing.
    least = (1.0 - _ROUNDING) * max(first.values(), default=0.0)
    return next((way for way, error in first.items() if error >= least), "test")


@dataclass(frozen=True)
class Validated:
    """Errors of the fitted readings by fits without their folds.

    Attributes:
        folds: the division of the rows.
        of_model: "nominal" or "calibrated" -> way -> the errors of each station.
    """

    folds: Folds
    of_model: dict[str, dict[Way, list[LeftOutErrors]]]

    @classmethod
    def of(
        cls, fit: ModelFit, rows: Sequence[StationRows], folds: Folds | None
    ) -> Validated | None:
        """Return the errors by some folds; None if no reading can be predicted by others."""
        if folds is None or not len(folds):
            return None
        by_model = {
            "nominal": left_out_errors(_by_independent_rows(fit), fit.nominal, rows, folds),
            "calibrated": left_out_errors(fit, fit.solution, rows, folds),
        }
        found = cls(folds, by_model)
        return found if found.errors("calibrated") else None

    @property
    def headline(self) -> Way:
        """The way in which predictions of the calibrated model are worse; the errors of all models
        are stated by it.
        """
        return cast(Way, headline_of(self.errors("calibrated")))

    @property
    def lead(self) -> list[LeftOutErrors]:
        """The errors of the calibrated model in this way, station by station."""
        return self.leading("calibrated")

    def leading(self, model: str) -> list[LeftOutErrors]:
        """Return the errors of a model in the way of the headline, station by station."""
        return self.of_model[model][self.headline]

    def errors(self, model: str) -> dict[str, dict[str, float]]:
        """Return the statistics of a model, way by way."""
        return {way: dict(of) for way, of in self._statistics[model].items() if of}

    @cached_property
    def _statistics(self) -> dict[str, dict[Way, dict[str, float]]]:
        return {
            model: {way: statistics_of(parts) for way, parts in ways.items()}
            for model, ways in self.of_model.items()
        }

    @property
    def rows(self) -> int:
        """Number of readings that were predicted."""
        parts = next(iter(self.of_model["calibrated"].values()))
        return sum(int(np.isfinite(part.residuals).all(axis=0).sum()) for part in parts)

    def at_station(self, k: int, model: str) -> dict[str, float]:
        """Return the statistics of the headline at one station; empty where nothing counts."""
        return statistics_of(self.leading(model)[k : k + 1])


FitOthers = Callable[[Robot, dict[str, Measurements], Options], FittedRobot]
"""Calibrates a robot from the tables of some stations and options; picklable if an executor needs
that.
"""


def leave_out_stations(
    robot: Robot,
    tables: dict[str, Measurements],
    options: Options,
    *,
    fit_others: FitOthers = fitted,
    executor: Executor | None = None,
) -> Iterator[LeftOut]:
    """Predict each station by the model of the others, only its own frames fitted.

    This is the accuracy to expect at a new set-up: held-out rows of a station share its frames, day
    and temperature with the fitted ones.

    The model is fitted by ``fit_others``, for each station in parallel if there is an executor.

    Raises:
        BadInputError: if there is only one station.
    """
    require_several(tables)
    run = partial(_left_out, robot, tables, options, fit_others)
    return spread(run, tables, label="left-out station", executor=executor)


def require_several(tables: Mapping[str, Measurements]) -> None:
    """Raise BadInputError if there is only one station, which can't be left out."""
    if len(tables) < 2:
        source = ", ".join(table.source for table in tables.values())
        raise BadInputError(
            f"{source}: only one station, so none can be left out; expected two tables or "
            "more, or a column station"
        )


def _left_out(
    robot: Robot,
    tables: dict[str, Measurements],
    options: Options,
    fit_others: FitOthers,
    name: str,
) -> LeftOut:
    others = {other: table for other, table in tables.items() if other != name}
    options = replace(
        options, stations={other: own for other, own in options.stations.items() if other in others}
    )
    geometric = replace(options, effects=GEOMETRIC)
    sizes: dict[str, Mapping[str, list[float]]] = {}
    try:
        found: dict[str, FittedRobot] = {"calibrated": fit_others(robot, others, options)}
        is_same = set(found["calibrated"].options.effects) == set(GEOMETRIC)
        found["geometric"] = found["calibrated"] if is_same else fitted(robot, others, geometric)
        found["nominal"] = fitted(robot, others, replace(options, effects=()))
        for model, fit in found.items():
            placed = place_station(fit, tables[name])
            sizes[model] = {
                unit: list(s) for unit, s in pose_error_sizes(placed.station, placed.values).items()
            }
    except BadInputError as error:
        return LeftOut(name, obstacle=str(error))
    return LeftOut(name, sizes)
