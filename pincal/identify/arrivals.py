r"""Readings of several targets, or points, in one stop of the robot: they share what the robot does
there.

Drives do not arrive twice at the same place, and what a model lacks at a pose displaces all targets
there together. With L the levers of the drives on the readings of a stop, A the variances of their
positions and R the noise of the readings, the covariance of the stop is

.. math:: V = R + L A L^T ,

a part of low rank beside a diagonal one, so that weights cost a time linear in the readings
(Woodbury). Fits, score tests and covariances that use V count a stop as one observation of the
robot, however many targets were read in it.

The variances are those of restricted maximum likelihood
(:mod:`pincal.identify.arrival_likelihood`). They include errors that the model lacks, as far as
drives that do not repeat could cause them: no more, or what a search is for would pass as noise.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pincal.identify.arrival_likelihood import (
    StopSums,
    information_of_stations,
    likeliest_arrivals,
)
from pincal.identify.beliefs import declared_noise
from pincal.identify.drive_levers import drive_levers
from pincal.identify.fit import ModelFit
from pincal.identify.noise import Noise
from pincal.identify.rounded_joints import found_rounded
from pincal.identify.station import Station
from pincal.identify.whitening import StopNoise
from pincal.measure.poses import SCATTER, are_distinct, same_joints

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ArrivalNoise:
    """Variances of what the readings of a stop share, and of what they do not.

    Attributes:
        drives: shape (n,), standard deviation of the position of each drive from stop to stop [rad
            or m].
        readings: shape (blocks,), standard deviation of the readings apart from it, by block of all
            stations.
        gain: of the first over readings that share nothing, in 2 log-likelihood.
    """

    drives: np.ndarray
    readings: np.ndarray
    gain: float


def shares_stops(station: Station) -> bool:
    """Return whether several rows of a station are of one pose, as of several targets or points."""
    joints = same_joints(station.conditions.q, SCATTER)
    if station.conditions.are_of_motion or are_distinct(joints):
        return False
    return not are_distinct(poses_of(station))


def with_arrivals(fit: ModelFit) -> ModelFit:
    """Return a fit, not refitted, whose rows of one stop share noise of the drives, as far as its
    residuals show it, or as joints are written in coarse steps.
    """
    shared = [
        shares_stops(station) and station.sensor.reads_place for station in fit.problem.stations
    ]
    noise = arrival_noise(fit, shared) if any(shared) else None
    stations = []
    for k, (is_shared, (station, _, blocks)) in enumerate(zip(shared, fit.stations, strict=True)):
        arrival = None
        if not is_shared:
            # What the steps explain was settled when it was found; a search goes on with it.
            arrival = station.arrival or _rounded_noise(fit, k)
        elif noise is not None:
            arrival = _shared_noise(fit.alone[k], noise.drives, noise.readings[blocks])
        stations.append(replace(station, arrival=arrival))
    if all(a.arrival is b.arrival for a, b in zip(stations, fit.problem.stations, strict=True)):
        return fit
    return replace(
        fit.over(stations), noise=_declared_with(stations, declared_noise(fit.problem, fit.options))
    )


def _rounded_noise(fit: ModelFit, k: int) -> StopNoise | None:
    """Return the noise of rounded joints on the rows of the k-th station, each in a stop of its
    own; None where joints are not rounded, or rows do not show it.
    """
    problem = fit.problem
    declared = fit.noise.declared[problem.block_spans[k]]
    rounded = found_rounded(problem.stations[k], fit.values[problem.places[k]], declared)
    if rounded is None:
        return None
    log.info("%s; this counts as noise of the rows", rounded.words)
    return _shared_noise(fit.alone[k], rounded.drives, np.array(declared, float))


def _declared_with(stations: Sequence[Station], declared: Noise) -> Noise:
    """Return the declared noise of single readings, with what readings of a stop share
    in addition.
    """
    factors = [
        1.0 if station.arrival is None else float(station.arrival.size[rows.start])
        for station in stations
        for rows in station.block_rows
    ]
    pairs = zip(declared.declared, factors, strict=True)
    return Noise(tuple(None if sigma is None else sigma * factor for sigma, factor in pairs))


def arrival_noise(fit: ModelFit, shared: Sequence[bool]) -> ArrivalNoise | None:
    """Return the variances of the drives and of the readings; None where readings of a stop share
    nothing significant.

    ``shared`` are the stations whose rows share stops.
    """
    every = information_of_stations(fit) if len(fit.alone) > 1 else []
    parts = []
    for k, (alone, (_, places, blocks)) in enumerate(zip(fit.alone, fit.stations, strict=True)):
        if not shared[k]:
            continue
        others = None
        if every:
            at = np.arange(len(fit.values))[places][alone.solution.free]
            rest = np.sum([of for j, of in enumerate(every) if j != k], axis=0)
            others = rest[np.ix_(at, at)]
        parts.append(StopSums.of(alone, blocks, poses_of(alone.station), others))
    found = likeliest_arrivals(parts, len(fit.problem.blocks))
    if found is None:
        return None
    readings = np.sqrt(found.blocks) * fit.solution.estimated
    return ArrivalNoise(np.sqrt(found.drives), readings, found.gain)


def poses_of(station: Station) -> np.ndarray:
    """Return the number of the pose of each row, whatever was read there, shape (N,), from 0."""
    keys = np.column_stack(
        [same_joints(station.conditions.q, SCATTER), np.round(station.conditions.payload, 3)]
    )
    return np.unique(keys, axis=0, return_inverse=True)[1].ravel()


def _shared_noise(alone: ModelFit, drives: np.ndarray, readings: np.ndarray) -> StopNoise:
    """Return what rows of the only station share, in units of the noise of their blocks."""
    station = alone.station
    size = np.repeat(readings, station.block_sizes)[:, None]
    moved = drive_levers(station, alone.values) * drives[:, None, None] / size * station.weights
    counted = alone.solution.weights > 0.0
    moved = moved * counted
    square = 1.0 + np.sum(moved**2, axis=(0, 2)) / max(np.count_nonzero(counted), 1)
    of_blocks = np.sqrt([np.mean(square[rows]) for rows in station.block_rows])
    return StopNoise.of(
        moved[drives > 0.0], poses_of(station), np.repeat(of_blocks, station.block_sizes)
    )
