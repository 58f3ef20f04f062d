"""The rows that a calibration fitted and those that it held out, station by station."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from pincal.errors import BadInputError
from pincal.identify.calibrate import Tables, tables_of
from pincal.identify.fit import Fit
from pincal.identify.split import hold_out
from pincal.identify.station import Station
from pincal.measure.admit import admit_test, scorable_rows, usable_rows
from pincal.measure.measurements import Measurements
from pincal.measure.poses import SCATTER, by_pose, replicate_groups
from pincal.measure.setup import Setup
from pincal.robot.robot import Robot

Validation = Literal["random", "blocked", "station"]
"""What is held out: rows at random, whole regions of joint space, or each station in turn."""


@dataclass(frozen=True)
class StationRows:
    """Rows of one station.

    Attributes:
        name: of the station; "" for one that is alone.
        train: poses that the fit saw: the mean of each one's readings.
        test: those that it did not see; may be empty.
        measured: the rows of both, as they were measured.
    """

    name: str
    train: Measurements
    test: Measurements
    measured: tuple[Measurements, Measurements]

    @classmethod
    def of(cls, name: str, train: Measurements, test: Measurements) -> StationRows:
        """Return the rows of a station by their poses."""
        return cls(name, by_pose(train), by_pose(test), (train, test))

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
) -> dict[str, tuple[Measurements, Measurements]]:
    """Hold back a part of each station's rows; arguments as of :func:`pincal.calibration.run.run_calibration`.

    Where whole stations are held back in turn, all rows train.
    """
    if split == "station":
        return {name: (table, table.select(slice(0))) for name, table in tables.items()}
    found = {}
    for name, table in tables.items():
        setup = setup_of(name)
        train, test = hold_out(table, fraction, split=split, seed=seed)
        train = usable_rows(train, setup)
        found[name] = train, scorable_rows(test, setup.over(train))
    return found


def with_holdout(
    robot: Robot, tables: Mapping[str, Measurements], holdout: Tables, setup_of: Callable[[str], Setup]
) -> dict[str, tuple[Measurements, Measurements]]:
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
        found[name] = table, table.select(slice(0)) if test is None else admit_test(robot, test, setup)
    return found
