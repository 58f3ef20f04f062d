"""The rows that a calibration fitted and those that it held out, station by station."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike

from pincal.errors import BadInputError
from pincal.identify.calibrate import Tables, tables_of
from pincal.identify.fit import Fit
from pincal.identify.split import Way, hold_out, ways_held_out
from pincal.identify.station import Station
from pincal.measure.admit import admit_test, scorable_rows, usable_rows
from pincal.measure.measurements import Measurements
from pincal.measure.poses import SCATTER, by_pose, replicate_groups
from pincal.measure.setup import Setup
from pincal.robot.robot import Robot
from pincal.validate.accuracy import error_statistics, pose_error_sizes

Validation = Literal["both", "random", "blocked", "station"]
"""What is held out: regions of joint space and stretches of rows, rows at random, regions alone, or each station in turn."""


class Parts(NamedTuple):
    """The rows of a station: those to fit, those held out, and which lines of the latter are held out in which way."""

    train: Measurements
    test: Measurements
    ways: Mapping[Way, np.ndarray] = {}


@dataclass(frozen=True)
class StationRows:
    """Rows of one station.

    Attributes:
        name: of the station; "" for one that is alone.
        train: poses that the fit saw: the mean of each one's readings.
        test: those that it did not see; may be empty.
        measured: the rows of both, as they were measured.
        ways: of each way of holding rows out, if there are two, the held-out poses, shape (test,).
    """

    name: str
    train: Measurements
    test: Measurements
    measured: tuple[Measurements, Measurements]
    ways: Mapping[Way, np.ndarray] = field(default_factory=dict)

    @classmethod
    def of(cls, name: str, parts: Parts) -> StationRows:
        """Return the rows of a station by their poses."""
        test = by_pose(parts.test)
        ways = {way: np.isin(test.rows, lines) for way, lines in parts.ways.items()}
        return cls(name, by_pose(parts.train), test, (parts.train, parts.test), ways)

    def held(self, fit: Fit) -> Station | None:
        """Return the held-out poses under the calibrated model, None without any."""
        return fit.readings(self.test, station=self.name) if len(self.test) else None

    def by_row(self, weights: np.ndarray) -> np.ndarray:
        """Return what is said of each fitted pose, shape (poses,), for each fitted row as it was measured, shape (N,)."""
        rows, _ = self.measured
        return weights if self.train is rows else weights[replicate_groups([rows], within=SCATTER)[0]]


@dataclass(frozen=True)
class LeftOut:
    """A station predicted by the model of the others.

    Attributes:
        station: its name.
        sizes: model -> unit ("mm", ...) -> shape (N,), size of the error at each row, of the "nominal", "geometric" and
            "calibrated" robot; empty if it can't be predicted.
        obstacle: why not; empty otherwise.
    """

    station: str
    sizes: Mapping[str, Mapping[str, ArrayLike]] = field(default_factory=dict)
    obstacle: str = ""


def split_rows(
    tables: Mapping[str, Measurements], setup_of: Callable[[str], Setup], *, fraction: float, split: Validation, seed: int
) -> dict[str, Parts]:
    """Hold back a part of each station's rows; arguments as of :func:`pincal.calibration.run.run_calibration`.

    Where whole stations are held back in turn, all rows train.
    """
    if split == "station":
        return {name: Parts(table, table.select(slice(0))) for name, table in tables.items()}
    found = {}
    for name, table in tables.items():
        setup = setup_of(name)
        ways: dict[Way, np.ndarray] = {}
        if split == "both":
            held = ways_held_out(table, fraction, seed=seed)
            ways = {way: table.rows[rows] for way, rows in held.items() if rows.any()}
            is_held = np.any(list(held.values()), axis=0)
            train, test = table.select(~is_held), table.select(is_held)
        else:
            train, test = hold_out(table, fraction, split=split, seed=seed)
        train = usable_rows(train, setup)
        found[name] = Parts(train, scorable_rows(test, setup.over(train)), ways)
    return found


def with_holdout(
    robot: Robot, tables: Mapping[str, Measurements], holdout: Tables, setup_of: Callable[[str], Setup]
) -> dict[str, Parts]:
    """Return the rows of each station with those of other tables to judge them by.

    Raises:
        BadInputError: if these are not of a station that is fitted, or can't be of this robot.
    """
    held = tables_of(holdout)
    if len(tables) == len(held) == 1:
        held = dict(zip(tables, held.values(), strict=True))
    for name in held.keys() - tables.keys():
        raise BadInputError(
            f"{held[name].source}: rows to validate on of the station {name!r}; expected one of "
            f"{', '.join(map(repr, tables))}: name it in a column station, or hold rows back by --test-fraction"
        )
    found = {}
    for name, table in tables.items():
        test = held.get(name)
        setup = setup_of(name).over(table)
        found[name] = Parts(table, table.select(slice(0)) if test is None else admit_test(robot, test, setup))
    return found


def as_measured(fit: Fit, rows: Sequence[StationRows]) -> Fit:
    """Return a fit over the fitted rows as they were measured, where it was made of means of poses; else itself."""
    if all(part.train is part.measured[0] for part in rows):
        return fit
    stations = tuple(
        fit.readings(part.measured[0], station=at.name) for part, at in zip(rows, fit.problem.stations, strict=True)
    )
    weights = [part.by_row(fit.solution.weights[of]) for part, of in zip(rows, fit.problem.rows, strict=True)]
    solution = replace(fit.solution, weights=np.concatenate(weights))
    return replace(fit, problem=replace(fit.problem, stations=stations), solution=solution)


def errors_held_out(fit: Fit, values: np.ndarray, rows: Sequence[StationRows]) -> dict[str, dict[str, float]]:
    """Return the statistics of errors of held-out poses, of all stations together.

    Args:
        fit: the model.
        values: shape (P,), its parameters.
        rows: the rows of each station.

    Returns:
        Name and statistics, as those of :func:`pincal.validate.accuracy.error_statistics`: "regions" and "stretches", where
        rows are held out both ways, and "test" for all that are held out.
    """
    sizes: dict[str, list[dict[str, np.ndarray]]] = {}
    for part, places in zip(rows, fit.problem.places, strict=True):
        station = part.held(fit)
        if station is None:
            continue
        found = pose_error_sizes(station, values[places])
        sizes.setdefault("test", []).append(found)
        for way, mask in part.ways.items():
            if mask.any():
                sizes.setdefault(way, []).append({unit: of_unit[mask] for unit, of_unit in found.items()})
    return {name: error_statistics(parts) for name, parts in sizes.items()}


def headline_of(errors: Mapping[str, Mapping[str, float]]) -> str:
    """Return which of the errors of :func:`errors_held_out` leads: the way in which a model predicts worse."""
    ways = [name for name in errors if name in get_args(Way)]
    return max(ways, key=lambda way: next(iter(errors[way].values())), default="test")
