"""A station at which a robot was fitted: its model, set-up and noise, and what its rows covered."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pincal.calibration.covered import Covered
from pincal.calibration.repeatability import Repeatability
from pincal.identify.fit import ModelFit
from pincal.identify.station import fingerprints
from pincal.model.model import Model
from pincal.sensors.setup import Setup


@dataclass(frozen=True)
class FittedStation:
    """One set-up of instrument and targets at which a fitted robot was measured.

    Attributes:
        name: of the station; "" for a single one without a name.
        model: the robot's chain and effects, and those of this station.
        parameter_names: the model's parameters and then the sensor's own, by their names among all
            of the robot.
        sensor_kind: what was measured: "position", "pose", "distance" and so on.
        payload_centre: shape (3,), centre of mass of the payload in the tip frame [m].
        covered: the range of the fitted rows.
        sigma: shape (blocks,), noise of one component of each block of readings that the fit used
            [m, rad, px]; where rows are weighted by the visits behind them, at least that of their
            residuals.
        setup: named points and the camera.
        rows: fingerprints of the fitted rows; empty where unknown.
        is_noise_declared: whether the noise was declared, not estimated.
        repeatability: of the readings within a stop and of stops at a pose; None where nothing was
            repeated, or unknown.
    """

    name: str
    model: Model
    parameter_names: tuple[str, ...]
    sensor_kind: str
    payload_centre: np.ndarray
    covered: Covered
    sigma: np.ndarray
    setup: Setup = field(default_factory=Setup)
    rows: str = ""
    is_noise_declared: bool = False
    repeatability: Repeatability | None = None

    @classmethod
    def of(cls, fit: ModelFit, k: int) -> FittedStation:
        """Return the k-th station of a fit."""
        problem = fit.problem
        at = problem.stations[k]
        options = fit.options.at(at.name)
        scatter = fit.scatter.get(at.name)
        blocks = problem.block_spans[k]
        sigma = np.array(fit.solution.sigma[blocks], float)
        if scatter is not None and scatter.of_single:
            # The noise of a visit: a declared one is that of the instrument alone, and the arrival
            # of the drives shows in the residuals, also where they do not exceed it significantly.
            sigma = np.maximum(sigma, fit.solution.estimated[blocks])
        return cls(
            name=at.name,
            model=at.model,
            parameter_names=tuple(problem.parameters[i].name for i in problem.places[k]),
            sensor_kind=at.sensor.kind,
            payload_centre=np.array(options.payload_centre, float),
            covered=Covered.of(at.conditions),
            sigma=sigma,
            setup=options.setup,
            rows=fingerprints(at),
            is_noise_declared=options.sigma is not None,
            repeatability=None if scatter is None else Repeatability.of(scatter),
        )
