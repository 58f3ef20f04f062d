"""What the rows of a fit say of what its model lacks: their residuals, as displacements of the
target, and how the drives move it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pincal.calibration.wandering import wandered
from pincal.identify.fit import ModelFit
from pincal.identify.motion_fields import displacements_by_drives
from pincal.identify.station import Station
from pincal.model.motions import with_moving_drives
from pincal.thresholds import Scale

# A prior of what has none [m or rad].
_WIDE: Scale = 1e3


def gives_positions(station: Station) -> bool:
    """Return whether each reading of a station that stands still gives a position in 3D."""
    block = station.sensor.blocks[0]
    is_still = not station.conditions.are_of_motion and station.conditions.around is None
    return is_still and block.unit == "m" and block.size == 3


def _gives_turns(station: Station) -> bool:
    """Return whether each reading of a station gives a position, and then an orientation."""
    blocks = station.sensor.blocks
    return len(blocks) > 1 and blocks[1].unit == "rad" and blocks[1].size == 3


@dataclass(frozen=True, eq=False)
class PositionRows:
    """What the rows of a station say of a discrepancy.

    Attributes:
        at: the station.
        number: of the station in the fit.
        values: shape (P,), its parameters.
        q: shape (N, n), joint positions.
        levers: shape (n, N, 3), motion of the target by each drive.
        noise: shape (N,), variance of a coordinate that is known to be of the readings [m^2].
        fitted_noise: shape (N,), variance of a coordinate of the readings by the fit [m^2].
        is_kept: shape (N,), rows that are no outliers.
        turn_noise: as ``noise``, of a component of orientations [rad^2]; None where none are read.
    """

    at: Station
    number: int
    values: np.ndarray
    q: np.ndarray
    levers: np.ndarray
    noise: np.ndarray
    fitted_noise: np.ndarray
    is_kept: np.ndarray
    turn_noise: np.ndarray | None

    @classmethod
    def of(cls, fit: ModelFit, k: int) -> PositionRows:
        """Return those of the k-th station of a fit."""
        at = fit.problem.stations[k]
        values = fit.solution.values[fit.problem.places[k]]
        return cls(
            at,
            k,
            values,
            at.conditions.q,
            displacements_by_drives(at, values),
            _known_noise(fit, k),
            _fitted_noise(fit, k),
            fit.solution.weights[fit.problem.rows[k]] > 0.0,
            _known_noise(fit, k, 1) if _gives_turns(at) else None,
        )

    def select(self, rows: np.ndarray) -> PositionRows:
        """Return what some rows say (mask or indices)."""
        return replace(
            self,
            at=self.at.select(rows),
            q=self.q[rows],
            levers=self.levers[:, rows],
            noise=self.noise[rows],
            fitted_noise=self.fitted_noise[rows],
            is_kept=self.is_kept[rows],
            turn_noise=None if self.turn_noise is None else self.turn_noise[rows],
        )

    @property
    def fitted(self) -> np.ndarray:
        """Residuals of the fit, shape (N, 3) [m]."""
        return self.at.displacements(self.values)

    @property
    def expected_noise(self) -> np.ndarray:
        """Variance of a coordinate of the readings, shape (N,) [m^2]: known, or else by the fit."""
        return np.where(self.noise > 0.0, self.noise, self.fitted_noise)

    def with_noise(self, part: float) -> PositionRows:
        """Return the rows with a part of the variance of the fit known to be of the readings."""
        return replace(self, noise=np.maximum(self.noise, part * self.fitted_noise))

    def motions_by(self, fit: ModelFit) -> np.ndarray:
        """Return the displacement of each row's target by one prior of each free parameter of the
        fit, shape (F, N, 3) [m].
        """
        places = fit.problem.places[self.number]
        own = fit.solution.free[places]
        number = np.cumsum(fit.solution.free) - 1
        found = np.zeros((int(fit.solution.free.sum()), len(self.q), 3))
        sizes = np.minimum(fit.priors.sizes[places[own]], _WIDE)
        moved = self.at.displacements_by(self.values, own)
        found[number[places[own]]] = moved * sizes[:, None, None]
        return found


@dataclass(frozen=True, eq=False)
class LeftOutRows:
    """Rows of a station with their residuals by fits without them.

    Attributes:
        rows: the N rows that are no outliers and have such residuals.
        displacements: shape (N, 3), of the target's position [m].
        turns: shape (N, 3), rotation from predicted to read orientations [rad]; None where none are
            read.
        some: shape (N,), their places among all of the station.
    """

    rows: PositionRows
    displacements: np.ndarray
    turns: np.ndarray | None
    some: np.ndarray

    @classmethod
    def of(cls, rows: PositionRows, residuals: np.ndarray) -> LeftOutRows:
        """Return the rows of residuals, shape (m, N), that are finite."""
        displacements = rows.at.displacements(rows.values, residuals)
        some = np.flatnonzero(rows.is_kept & np.isfinite(displacements).all(axis=1))
        turns = residuals[3:6, some].T if rows.turn_noise is not None else None
        return cls(rows.select(some), displacements[some], turns, some)

    @property
    def turn_noise(self) -> np.ndarray:
        """Variance of a component that is known to be of the readings, shape (N,) [rad^2]."""
        noise = self.rows.turn_noise
        return np.zeros(len(self.displacements)) if noise is None else noise

    @property
    def turn_levers(self) -> np.ndarray:
        """Rotation of the target by each drive, shape (n, N, 3) [rad/rad or rad/m]."""
        station = self.rows.at
        model = with_moving_drives(station.model)
        of_model, _ = station.split(self.rows.values)
        values = np.concatenate([of_model, np.zeros(model.n_parameters - len(of_model))])
        is_drive = np.arange(len(values)) >= len(of_model)
        _, J = model.linearise(values, station.conditions, free=is_drive, rows=6)
        return np.moveaxis(J[:, 3:], 2, 0)


def _known_noise(fit: ModelFit, k: int, block: int = 0) -> np.ndarray:
    """Return the variance of a component of a block of each row that is known to be of the
    readings, shape (N,) [m^2 or rad^2]: the declared noise, what the stops of its pose or the
    targets of a stop show, or what persists along the rows, whichever is most.
    """
    at = fit.problem.stations[k]
    scatter = fit.scatter.get(at.name)
    declared = fit.noise.declared[fit.problem.block_spans[k].start + block]
    size = 0.0 if declared is None else declared**2
    if scatter is not None:
        of_row = (1.0, 1.0) if scatter.of_single else (scatter.readings, scatter.stops)
        shown = scatter.of_row(*of_row)
        size = max(size, float(shown[block]))
    if at.arrival is not None and at.arrival.rows.max(initial=0) > 1:
        # Readings of a stop differ by their own noise, whatever a model lacks there.
        sigma = fit.solution.sigma[fit.problem.block_spans[k].start + block]
        component = at.block_rows[block].start
        size = max(size, float(sigma / at.arrival.size[component]) ** 2)
    size = max(size, wandered(fit, k, block))
    return np.asarray(size / np.maximum(at.weights, 1e-300) ** 2)


def _fitted_noise(fit: ModelFit, k: int) -> np.ndarray:
    """Return the variance of a coordinate of each row by the fit, shape (N,) [m^2]."""
    sigma = fit.solution.sigma[fit.problem.block_spans[k].start]
    return np.asarray((sigma / np.maximum(fit.problem.stations[k].weights, 1e-300)) ** 2)
