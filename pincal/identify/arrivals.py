r"""Readings of several targets, or points, in one stop of the robot: they share what the robot does
there.

Drives do not arrive twice at the same place, and what a model lacks at a pose displaces all targets
there together. With L the levers of the drives on the readings of a stop, A the variances of their
positions and R the noise of the readings, the covariance of the stop is

.. math:: V = R + L A L^T ,

a part of low rank beside a diagonal one, so that weights cost a time linear in the readings
(Woodbury). Fits, score tests and covariances that use V count a stop as one observation of the
robot, however many targets were read in it.

The variances are those of maximum likelihood of the residuals of a fit, corrected for the
parameters that it has used up. They include errors that the model lacks, as far as drives that do
not repeat could cause them: no more, or what a search is for would pass as noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from pincal.identify.beliefs import declared_noise
from pincal.identify.criteria import CRITERIA, VISITS
from pincal.identify.drive_levers import drive_levers
from pincal.identify.fit import ModelFit
from pincal.identify.noise import Noise
from pincal.identify.station import Station
from pincal.identify.whitening import StopNoise
from pincal.measure.poses import SCATTER, same_joints

# Variances are searched within these factors of that of the readings, as seen at the target.
_BOUNDS = (1e-6, 1e8)


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
    return station.conditions.inertial is None and len(np.unique(poses_of(station))) < len(station)


def with_arrivals(fit: ModelFit) -> ModelFit:
    """Return a fit, not refitted, whose rows of one stop share noise of the drives, as far as its
    residuals show it.
    """
    shared = [
        shares_stops(station) and station.sensor.reads_place for station in fit.problem.stations
    ]
    if not any(shared):
        return fit
    noise = arrival_noise(fit, shared)
    stations = []
    for is_shared, (station, _, blocks), alone in zip(shared, fit.stations, fit.alone, strict=True):
        arrival = None
        if is_shared and noise is not None:
            arrival = _shared_noise(alone, noise.drives, noise.readings[blocks])
        stations.append(replace(station, arrival=arrival))
    if all(a.arrival is b.arrival for a, b in zip(stations, fit.problem.stations, strict=True)):
        return fit
    return replace(
        fit.over(stations), noise=_declared_with(stations, declared_noise(fit.problem, fit.options))
    )


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
    solution = fit.solution
    parts = [
        _Stops.of(alone, blocks)
        for is_shared, alone, (_, _, blocks) in zip(shared, fit.alone, fit.stations, strict=True)
        if is_shared
    ]
    found = _likeliest(parts, len(fit.problem.blocks))
    if found is None:
        return None
    variances, of_blocks, gain = found
    if gain < CRITERIA.arrivals:
        return None
    # The fit has used up a part of what stops can show.
    seen = sum(part.rank for part in parts)
    spent = min(float(solution.effective), 0.9 * seen)
    drives = np.sqrt(variances * seen / (seen - spent))
    return ArrivalNoise(drives, np.sqrt(of_blocks) * solution.estimated, gain)


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


@dataclass(frozen=True)
class _Stops:
    """What the residuals of a station say of its S stops, block by block, in units of the estimated
    noise.

    Attributes:
        blocks: numbers of the blocks among all.
        information: shape (blocks, S, n, n), L^T L of each stop.
        slope: shape (blocks, S, n), L^T r.
        squares: shape (blocks,), r^T r.
        counts: shape (blocks,), numbers of readings.
        rank: number of components of the drives' positions that all stops show.
    """

    blocks: range
    information: np.ndarray
    slope: np.ndarray
    squares: np.ndarray
    counts: np.ndarray
    rank: int

    @classmethod
    def of(cls, alone: ModelFit, blocks: slice) -> _Stops:
        """Return them of the only station of a fit."""
        station = alone.station
        sound = np.flatnonzero(alone.solution.weights > 0.0)
        scale = (
            station.weights[sound]
            / np.repeat(alone.solution.estimated, station.block_sizes)[:, None]
        )
        residuals = station.residuals(alone.values)[:, sound] * scale
        moved = drive_levers(station, alone.values)[:, :, sound] * scale
        pose = np.unique(poses_of(station)[sound], return_inverse=True)[1].ravel()
        n_stops = int(pose.max(initial=-1)) + 1
        n = len(moved)
        information = np.zeros((len(station.block_rows), n_stops, n, n))
        slope = np.zeros((len(station.block_rows), n_stops, n))
        for b, rows in enumerate(station.block_rows):
            np.add.at(
                information[b], pose, np.einsum("imk,jmk->kij", moved[:, rows], moved[:, rows])
            )
            np.add.at(slope[b], pose, np.einsum("imk,mk->ki", moved[:, rows], residuals[rows]))
        squares = np.array([float(np.sum(residuals[rows] ** 2)) for rows in station.block_rows])
        counts = np.array([residuals[rows].size for rows in station.block_rows])
        rank = (
            int(np.sum(np.linalg.matrix_rank(information.sum(axis=0), hermitian=True)))
            if n_stops
            else 0
        )
        return cls(range(blocks.start, blocks.stop), information, slope, squares, counts, rank)


def _likeliest(
    parts: Sequence[_Stops], n_blocks: int
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Return the likeliest variances of drives and blocks, shape (n,) and (blocks,), and the gain
    by the drives.
    """
    squares = np.zeros(n_blocks)
    counts = np.zeros(n_blocks)
    for part in parts:
        squares[list(part.blocks)] += part.squares
        counts[list(part.blocks)] += part.counts
    seen = counts > 0.0
    if not seen.any() or not all(part.rank for part in parts):
        return None
    n = parts[0].slope.shape[2]
    lengths = sum(np.einsum("bsii->i", part.information) for part in parts) / counts.sum()
    scale = np.where(lengths > 0.0, np.sqrt(np.maximum(lengths, 1e-300)), np.inf)
    without = float(np.sum(counts[seen] * (1.0 + np.log(squares[seen] / counts[seen]))))

    def misfit(logs: np.ndarray) -> tuple[float, np.ndarray]:
        """Return -2 log-likelihood, and its slope; the drives' logs are in units in which they move
        readings by 1.
        """
        variances = np.exp(logs[:n])
        noise = np.exp(logs[n:])
        total = float(np.sum(counts[seen] * np.log(noise[seen])))
        slope = np.zeros(len(logs))
        slope[n:][seen] = counts[seen]
        root = np.sqrt(variances) / scale
        for part in parts:
            own = list(part.blocks)
            weight = 1.0 / noise[own]
            G = np.einsum("b,bsij->sij", weight, part.information) * root[:, None] * root
            b = np.einsum("b,bsi->si", weight, part.slope) * root
            values, vectors = np.linalg.eigh(np.eye(n) + G)
            M = (vectors / values[:, None, :]) @ vectors.transpose(0, 2, 1)
            mean = np.einsum("sij,sj->si", M, b)
            total += (
                float(np.sum(np.log(values)))
                + float(weight @ part.squares)
                - float(np.sum(b * mean))
            )
            second = M + mean[:, :, None] * mean[:, None, :]
            slope[:n] += np.sum(1.0 - np.einsum("sii->si", second), axis=0)
            for k, block in enumerate(own):
                at = part.information[k] * root[:, None] * root
                left = (
                    part.squares[k]
                    - 2.0 * float(np.sum(part.slope[k] * root * mean))
                    + float(np.sum(at * second))
                )
                slope[n + block] -= left / noise[block]
        return total, slope

    # More than drives scatter by is an error of the model, which is for an effect to explain.
    most = 2.0 * np.log(np.clip(VISITS.arrival * scale, _BOUNDS[0] ** 0.5, _BOUNDS[1] ** 0.5))
    low, high = np.log(_BOUNDS)
    limits = [(low, float(limit)) for limit in most] + [(low, high)] * n_blocks
    start = np.minimum(np.zeros(n + n_blocks), [limit for _, limit in limits])
    found = minimize(misfit, start, jac=True, method="L-BFGS-B", bounds=limits)
    variances = np.where(np.isfinite(scale), np.exp(found.x[:n]) / scale**2, 0.0)
    # What moves readings by less than a hundredth of their noise is none.
    variances[np.exp(found.x[:n]) < 1e-4] = 0.0
    return variances, np.exp(found.x[n:]), without - float(found.fun)
