r"""Noise that comes by way of the joints: how much of it, and rows weighed by where it shows.

What no effect describes is mostly somewhere in the drives: friction, backlash, waves too short for a curve. It moves the
readings of a pose together, the more the longer the levers. With noise :math:`\sigma_b` of the instrument, levers :math:`J`
and variances :math:`\tau_j^2` of the joints, the covariance of a row is

.. math:: V = \operatorname{diag}(\sigma_b^2) + J \operatorname{diag}(\tau_j^2) J^T,

whose variances are those by which the residuals of a fit are likeliest. A fit that weighs its rows by V (generalised least
squares) is the most exact one, and does not take readings of one joint's error for several.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from pincal.discover.candidate_tests import some_rows as some_rows_of
from pincal.discover.levers import levers
from pincal.identify.fit import Fit
from pincal.identify.normal import block_rows
from pincal.identify.solve import Exit
from pincal.measure.rows import some_rows
from pincal.units import format_small

# Twice the log-likelihood that noise of the joints has to gain: without any, 120 tables had up to 13, half of them up to 2.
_ENOUGH = 25.0
# Readings for each parameter that a fit spends, below which it has shaped its residuals too much to tell.
_READINGS_EACH = 5.0
# Rows that tell the variances well enough.
_ROWS = 1000
# Variances, in units of the noise: where the search for them begins, and how small and how large they may be.
_START, _LEAST, _MOST = 0.3, 1e-6, 1e4


@dataclass(frozen=True)
class JointNoise:
    """What moves the readings from row to row.

    Attributes:
        joints: shape (n,), standard deviation of each joint's position [rad or m].
        instrument: shape (blocks,), that of the readings otherwise, by block of readings of all stations.
    """

    joints: np.ndarray
    instrument: np.ndarray


def joint_noise(fit: Fit) -> JointNoise | None:
    """Return the noise that comes by way of the joints; None where noise is declared or the residuals don't call for it."""
    problem, solution = fit.problem, fit.solution
    readings = problem.counted_rows(solution.weights)[problem.station_of_block] @ problem.block_sizes
    is_declared = any(sigma is not None for sigma in fit.noise.declared)
    is_whole = any(station.sensor.is_whole for station in problem.stations)
    if is_declared or is_whole or solution.exit is Exit.EXACT or readings < _READINGS_EACH * solution.effective:
        return None
    parts = list(_readings(fit))
    squares = sum(np.sum(part.levers**2, axis=(0, 1)) for part in parts)
    lengths = np.sqrt(np.where(squares > 0.0, squares, np.inf) / sum(part.residuals.size for part in parts))
    variances, gain = _likeliest([replace(part, levers=part.levers / lengths) for part in parts], len(problem.blocks))
    if gain < _ENOUGH:
        return None
    n = len(lengths)
    joints = np.where(np.isfinite(lengths), np.sqrt(variances[:n]) / lengths, 0.0)
    return JointNoise(joints, np.sqrt(variances[n:]) * solution.estimated)


def weighed(fit: Fit, noise: JointNoise) -> Fit:
    """Return a fit as it is whose readings are to be weighed by this noise.

    The size of the noise of each block of readings keeps its meaning: that of a single reading, all causes together.
    """
    drives, stations = tuple(map(int, fit.problem.chain.drives)), []
    for (station, _, blocks), alone in zip(fit.stations, fit.alone, strict=True):
        moved = levers(alone, drives).transpose(2, 1, 0) * noise.joints
        V = moved @ moved.transpose(0, 2, 1)
        sizes = np.empty(V.shape[1])
        for of, sigma in zip(block_rows(station), noise.instrument[blocks], strict=True):
            at = np.arange(of.start, of.stop)
            V[:, at, at] += sigma**2
            sizes[of] = np.sqrt(np.mean(V[:, at, at]))
        whitening = np.linalg.inv(np.linalg.cholesky(V)) * sizes[:, None]
        stations.append(replace(station, whitening=np.ascontiguousarray(whitening.transpose(1, 2, 0))))
    return replace(fit, problem=replace(fit.problem, stations=tuple(stations)))


def note_on_joints(fit: Fit) -> str | None:
    """Return what to say of a fit whose readings are weighed by this noise; None of any other."""
    if fit.is_declared or all(station.whitening is None for station in fit.problem.stations):
        return None
    noise, robot = joint_noise(fit), fit.problem.chain.robot
    joints = np.zeros(robot.n_joints) if noise is None else noise.joints
    triples = zip(robot.joint_names, joints.tolist(), robot.joint_units, strict=True)
    sizes = ", ".join(f"{joint} {format_small(sigma, unit)}" for joint, sigma, unit in triples if sigma > 0.0)
    return (
        f"what the model leaves moves the readings as unsteady joints would ({sizes or 'hardly'} from row to row), and the "
        "last fit weighs the readings of each row by that"
    )


@dataclass(frozen=True)
class _Readings:
    """Rows of a station, in units of the noise.

    Attributes:
        residuals: shape (N, m).
        levers: shape (N, m, n), how they move with each joint.
        block: shape (m,), the block of each reading.
    """

    residuals: np.ndarray
    levers: np.ndarray
    block: np.ndarray


def _readings(fit: Fit) -> Iterator[_Readings]:
    """Yield rows of each station that count, as many as tell the variances."""
    drives = tuple(map(int, fit.problem.chain.drives))
    for (station, _, blocks), alone in zip(fit.stations, fit.alone, strict=True):
        sound = np.flatnonzero(alone.solution.weights > 0.0)
        rows = sound[some_rows(len(sound), _ROWS)]
        if not len(rows):
            continue
        few = some_rows_of(alone, rows)
        block = np.repeat(np.arange(blocks.start, blocks.stop), [of.size for of in station.sensor.blocks])
        scale = station.weights[rows] / fit.solution.estimated[block][:, None]
        residuals = few.station.residuals(alone.values) * scale
        yield _Readings(residuals.T, (levers(few, drives) * scale).transpose(2, 1, 0), block)


def _likeliest(parts: Sequence[_Readings], n_blocks: int) -> tuple[np.ndarray, float]:
    """Return the likeliest variances of joints and blocks, shape (n + blocks,), and what those of joints gain."""
    n = parts[0].levers.shape[2]
    squares, counts = np.zeros(n_blocks), np.zeros(n_blocks)
    for part in parts:
        np.add.at(squares, part.block, np.sum(part.residuals**2, axis=0))
        np.add.at(counts, part.block, len(part.residuals))
    seen = counts > 0.0
    without = float(np.sum(counts[seen] * (1.0 + np.log(squares[seen] / counts[seen]))))

    def misfit(logs: np.ndarray) -> tuple[float, np.ndarray]:
        variances, total, slope = np.exp(logs), 0.0, np.zeros(len(logs))
        for part in parts:
            V = (part.levers * variances[:n]) @ part.levers.transpose(0, 2, 1)
            at = np.arange(len(part.block))
            V[:, at, at] += variances[n + part.block]
            inverse = np.linalg.inv(V)
            z = np.einsum("nij,nj->ni", inverse, part.residuals)
            total += float(np.sum(np.linalg.slogdet(V)[1]) + np.sum(z * part.residuals))
            # Of -2 log L by V.
            D = inverse - z[:, :, None] * z[:, None, :]
            slope[:n] += np.einsum("nik,nik->k", D @ part.levers, part.levers)
            np.add.at(slope, n + part.block, D[:, at, at].sum(axis=0))
        return total, slope * variances

    start = np.full(n + n_blocks, np.log(_START))
    found = minimize(misfit, start, jac=True, method="L-BFGS-B", bounds=[(np.log(_LEAST), np.log(_MOST))] * len(start))
    return np.exp(found.x), without - float(found.fun)
