"""Likelihood of readings under a fit."""

from __future__ import annotations

import numpy as np

from pincal.identify.fit import ModelFit
from pincal.identify.station import Station
from pincal.measure.admit import admit_test
from pincal.measure.measurements import Measurements


def log_likelihood(fit: ModelFit) -> float:
    """Return the log-likelihood of the fitted readings without outliers, given the values and the
    noise.
    """
    problem = fit.problem
    return sum(
        _log_density(fit, k, station, fit.solution.weights[rows])
        for k, (station, rows) in enumerate(zip(problem.stations, problem.rows, strict=True))
    )


def score(fit: ModelFit, measurements: Measurements, k: int) -> float:
    """Return the mean log-likelihood per reading of other rows at the k-th station, given the
    values and the noise.

    Raises:
        MeasurementError: if the table can't be of this robot.
    """
    problem = fit.problem
    name = problem.stations[k].name
    robot = problem.chain.robot
    table = admit_test(robot, measurements, fit.options.at(name).setup)
    rows = fit.readings(table, station=name)
    return _log_density(fit, k, rows, np.ones(len(table))) / (len(table) * rows.reading_size)


def _log_density(fit: ModelFit, k: int, rows: Station, weights: np.ndarray) -> float:
    """Return the log-likelihood of rows at the k-th station, with robust weights of shape (N,), 0
    for outliers.
    """
    sigma = np.repeat(fit.solution.sigma[fit.problem.block_spans[k]], rows.block_sizes)[:, None]
    scale = rows.weights / sigma
    residuals = rows.whitened(rows.residuals(fit.values[fit.problem.places[k]])) * scale
    counted = weights > 0.0
    # The covariance of correlated noise has another determinant than that of white noise.
    constant = float(np.sum(np.log(2.0 * np.pi / scale[:, counted] ** 2)))
    constant += 0.0 if rows.serial is None else rows.serial.log_determinant
    constant += 0.0 if rows.arrival is None else rows.arrival.log_determinant
    return -0.5 * (float(np.sum(residuals[:, counted] ** 2)) + constant)
