"""Detect swapped or sign-flipped joint columns, and tables of another robot, from the fit of base and tool alone."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import combinations

import numpy as np

from pincal.errors import MeasurementError
from pincal.identify.beliefs import bounds_of, frames_of, released_of
from pincal.identify.fit import Fit
from pincal.identify.initial import place
from pincal.identify.noise import Noise
from pincal.identify.options import Options
from pincal.identify.problem import Problem
from pincal.identify.solve import Priors, most_probable
from pincal.identify.station import Station
from pincal.measure.measurements import Measurements
from pincal.measure.rows import some_rows
from pincal.robot.robot import Robot

# Nominal error, relative to the reach, from which a mix-up is looked for; errors of real robots are a fifth of it and less.
_SUSPICIOUS = 0.01
# Nominal error, relative to the reach, beyond which no geometric error explains the table.
_HOPELESS = 0.2
# Factor by which undoing a mix-up has to reduce the error before it is named.
_CURED = 4.0
# A correction by the calibration that is smaller than so many times what is left of it anyway tells no robots apart.
_TELLING = 2.0
# Rows that are looked at; every trial of a mix-up is a fit.
_ROWS = 300


def check_agreement(robot: Robot, tables: Iterable[Measurements], fit: Fit) -> None:
    """Refuse a table whose joint columns are mixed up, or that is not of this robot.

    Args:
        robot: the arm.
        tables: the training rows of each station.
        fit: their calibration.

    Raises:
        MeasurementError: naming the columns that seem swapped or turned round.
    """
    for station, places, table in zip(fit.problem.stations, fit.problem.places, tables, strict=True):
        error = _typical(station, fit.nominal.values[places])
        if error >= _SUSPICIOUS * robot.reach:
            _refuse(robot, table, station, error, options=fit.options.at(station.name))


def _refuse(robot: Robot, measurements: Measurements, station: Station, error: float, *, options: Options) -> None:
    """Refuse a table that base and tool alone leave with a suspicious error [m], if it can't be this robot's."""
    best, words = _best_exchange(robot, measurements, station, options)
    got = f"base and tool alone leave {error * 1e3:.0f} mm on an arm of {robot.reach:.1f} m"
    if best * _CURED < error:
        raise MeasurementError(
            f"{measurements.source}: {words}: {got}, with this undone {best * 1e3:.1f} mm; "
            "correct the header of the table and run again"
        )
    if error > _HOPELESS * robot.reach:
        raise MeasurementError(
            f"{measurements.source}: {got}; expected some mm. "
            f"Are units, joint zeros, tip ({robot.tip}) and URDF those of this robot?"
        )


def mix_up(measurements: Measurements, station: Station, values: np.ndarray, *, options: Options) -> str:
    """Return which joint columns of a table seem swapped or turned round, in words; empty if none do.

    Args:
        measurements: the table.
        station: the robot over it, its instrument and targets placed.
        values: shape (P,), of the station's parameters.
        options: how the nominal robot is placed.
    """
    robot, error = station.model.chain.robot, _typical(station, values)
    if error < _SUSPICIOUS * robot.reach:
        return ""
    best, words = _best_exchange(robot, measurements, station, options)
    return words if best * _CURED < error else ""


def _best_exchange(robot: Robot, measurements: Measurements, station: Station, options: Options) -> tuple[float, str]:
    """Return what base and tool alone leave [m] with the two columns swapped, or the one turned round, that do best."""
    rows = some_rows(len(measurements), _ROWS, station.sensor.groups)
    sample = measurements.select(rows)
    n = robot.n_joints
    names = robot.joint_names
    trials = []
    for i, j in combinations(range(n), 2):
        q = sample.q.copy()
        q[:, [i, j]] = q[:, [j, i]]
        trials.append((f"the columns {names[i]!r} and {names[j]!r} look swapped", q))
    for i in range(n):
        q = sample.q.copy()
        q[:, i] *= -1.0
        trials.append((f"the column {names[i]!r} looks turned round in sign", q))
    found = [(_nominal_error(robot, replace(sample, q=q), options), words) for words, q in trials]
    return min(found, default=(np.inf, ""))


def _typical(station: Station, values: np.ndarray) -> float:
    """Return the robust size of the errors of position [m]: outliers have no say."""
    return float(np.median(np.linalg.norm(station.displacements(values), axis=1)))


def is_anothers(left: np.ndarray, nominal: np.ndarray, *, allowed: float) -> bool:
    """Return whether rows speak against a calibration as such: the nominal robot is no farther from them.

    With d the correction that it makes, the rows show (|nominal|^2 - |left|^2 + |d|^2) / 2 |d|^2 of it: all of it for
    the robot that was calibrated, none for any other of its type, less than a half if left is larger than nominal.

    Args:
        left: shape (N, 3), how far the rows are off the calibrated robot, instrument and targets placed [m].
        nominal: shape (N, 3), the same of the nominal robot [m].
        allowed: what noise and the calibration's uncertainty leave, root mean square [m].
    """
    rest, before, correction = (float(np.sqrt(np.mean(np.sum(way**2, axis=1)))) for way in (left, nominal, nominal - left))
    return rest >= before and correction > _TELLING * allowed


def nominal_displacements(robot: Robot, measurements: Measurements, options: Options) -> np.ndarray:
    """Return which way and how far rows are off the nominal robot, instrument and targets placed, shape (N, 3) [m]."""
    station, values = _nominal_placement(robot, measurements, options)
    return station.displacements(values)


def _nominal_error(robot: Robot, measurements: Measurements, options: Options) -> float:
    return _typical(*_nominal_placement(robot, measurements, options))


def _nominal_placement(robot: Robot, measurements: Measurements, options: Options) -> tuple[Station, np.ndarray]:
    ((station, values),) = place(robot, {"": measurements}, options)
    problem = Problem((station,))
    frames = frames_of(problem) & released_of(problem, options)
    priors = Priors(np.full(len(values), np.inf), bounds_of(problem, options))
    noise = Noise((None,) * len(problem.blocks))
    return station, most_probable(problem, values, frames, priors, noise, loss="huber", rough=True)
