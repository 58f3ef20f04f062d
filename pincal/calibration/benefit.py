r"""Whether a calibration makes a robot better than its URDF, expected before anyone measures it
again.

Priors of millimetres and milliradians hold for any robot. Many are better than that, and then
readings of a few poses with much noise put the noise into the geometry: the calibrated robot fits
them, and is worse than its URDF elsewhere. How far this robot is from its URDF shows in the
readings as well. Let s scale all its priors, from zero to one. With the information H of the
readings and their gradient b at the nominal robot, the evidence of s is (MacKay 1992, Bayesian
Interpolation, Neural Computation 4, section 4)

.. math:: 2 \log E(s) = b^T A^{-1} b - \log\det A - \log\det P, \quad
    A = H + P^{-1}, \quad P \propto s^2 ,

and given s the deviations are distributed about :math:`m = A^{-1} b` with covariance
:math:`C = A^{-1}`. A robot that is said to deviate by x is then off by

.. math:: (x - m)^T W (x - m) + \mathrm{tr}(W C)

in the mean square over random poses, whose Jacobians make W, instrument and target placed as well
as possible. The average over s, weighted by the evidence, is the expected error of the calibrated
robot for its x, and of the URDF for x = 0. Where the noise is unknown, it is the most likely one
for each s. Noise alone sometimes looks like a robot that deviates, so that the decision is made by
an average in which the URDF is given odds beforehand.

A robot stays as in its URDF unless it gets better anywhere within the joint limits, or at poses
like the measured ones while the rest gets no worse: a plan with joints at rest tells of the others.
Where the calibrated robot does not pass, another one may, with narrower priors: of the means m of
all s, the one whose expected error is least.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pincal.calibration.caveats import Caveat, CaveatKind
from pincal.calibration.delivery_numbers import DELIVERY
from pincal.calibration.elsewhere import random_conditions
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.improvement import unplaced
from pincal.identify.beliefs import deviations, priors_of
from pincal.identify.calibrate import refit
from pincal.identify.dependence import with_blocks
from pincal.identify.equations import Linearised
from pincal.identify.fit import ModelFit, posterior_of
from pincal.identify.options import Kept, PriorScale
from pincal.identify.prior_scale import observes_places, prior_scale
from pincal.identify.quadratic import Factor
from pincal.model.conditions import Conditions
from pincal.sensors.row_samples import sample_rows
from pincal.thresholds import Count, Scale

# Factors on the priors that are compared: the URDF as it is (for the arithmetic, a thousandth),
# then up to the usual priors.
_NONE: Scale = 1e-3
_LEAST: Scale = 1e-2
_STEP: Scale = 10.0**0.125
# Standard deviation of parameters without a prior [m or rad].
_ANYWHERE: Scale = 10.0
# Measured poses at most at which errors are compared.
_MEASURED: Count = 500
# Ratio of the noise of the nominal robot to that of the fit beyond which the fit is taken to have
# none.
_MOST: Scale = 1e4


class Benefit(NamedTuple):
    """Expected rms position errors within the joint limits, with instrument and target placed: of
    the URDF, and calibrated.

    Attributes:
        nominal_mm: with the robot as in its URDF [mm].
        calibrated_mm: with the robot as calibrated [mm].
        scale: factor on the usual priors by which the robot deviates from its URDF, rms over its
            evidence.
        spread: factor on the usual priors with which the URDF is as uncertain as ``nominal_mm``.
        is_worth_it: whether also those who expect the URDF to be right expect the calibrated robot
            to be better, anywhere or at poses like the measured ones.
        cautious: factor on the usual priors with which another fit is expected to be nearest to
            the true robot; None where that is not worth it either, or not needed.
    """

    nominal_mm: float
    calibrated_mm: float
    scale: float
    spread: float
    is_worth_it: bool
    cautious: float | None


def without_harm(fit: ModelFit) -> ModelFit:
    """Return a fit that is expected to be better than the URDF: itself, one with narrower priors,
    or one with the robot as in its URDF.
    """
    found = benefit_of(fit)
    if found is None or found.is_worth_it:
        return fit
    return at_nominal(fit, found) if found.cautious is None else _cautious(fit, found.cautious)


def _cautious(fit: ModelFit, scale: float) -> ModelFit:
    """Return a fit with priors as wide as the robot deviates by all its parameters together.

    Some kinds of parameters may deviate more, so that the fit is as uncertain as priors allow that
    the readings do not exclude.
    """
    options = replace(fit.options, prior_scale=PriorScale(scale, scale, scale, scale))
    found = refit(replace(fit, options=options), options.effects)
    widths = PriorScale(*(max(scale, of_kind) for of_kind in prior_scale(fit)))
    priors = priors_of(found.problem, replace(options, prior_scale=widths))
    solution = replace(
        found.solution, posterior=posterior_of(found.problem, found.solution, priors)
    )
    return with_blocks(replace(found, solution=solution, priors=priors))


def findings_on_benefit(fit: ModelFit) -> Iterator[Caveat]:
    """Yield that the robot stays as in its URDF because the readings do not improve it, or what
    else its fit was given.
    """
    scale = fit.options.prior_scale
    if scale is not None and observes_places(fit) and not fit.is_kept:
        yield Caveat(CaveatKind.NARROWED, {"scale": max(scale)})
    if fit.is_kept:
        assert fit.options.kept is not None
        figures = {
            "nominal": fit.options.kept.nominal_mm,
            "calibrated": fit.options.kept.calibrated_mm,
        }
        yield Caveat(CaveatKind.NOT_IMPROVED, figures)


def benefit_of(fit: ModelFit) -> Benefit | None:
    """Return what a calibration is expected to improve; None where this is not judged.

    It is not where an earlier fit or the user says how far the robot deviates, where nothing of the
    robot is fitted, and where no instrument observes positions, as priors are then estimated
    anyway.
    """
    problem = fit.problem
    scaled = _deviating(fit) & fit.solution.free
    if not _is_judged(fit) or not scaled.any():
        return None
    shared = fit.solution.free & problem.is_shared
    found = _Evidence.of(fit, shared, scaled).compared
    at = next(station for station in problem.stations if station.sensor.reads_place)
    robot = FittedRobot.of(fit).at(at.name)
    W = _weight(robot, fit, shared, random_conditions(at))
    # A plan may show what matters at its poses, such as those of three joints, and little of the
    # rest.
    measured = at.conditions.select(sample_rows(len(at), _MEASURED))
    averaged = _Averaged(found, W, _weight(robot, fit, shared, measured))
    x = (fit.values - fit.nominal.values)[shared]
    mean_squares = averaged.mean_squares(x)
    nominal, calibrated = 1e3 * np.sqrt(mean_squares)
    # Deviations that are left at zero though readings move their means are off by these means as
    # well.
    spread = next(
        (given.scale for given in found if given.uncertainty(W) >= mean_squares[0]), found[-1].scale
    )
    is_enough = averaged.is_worth_it(x)
    return Benefit(
        nominal_mm=float(nominal),
        calibrated_mm=float(calibrated),
        scale=averaged.scale,
        spread=spread,
        is_worth_it=is_enough,
        cautious=None if is_enough else averaged.cautious,
    )


def _is_judged(fit: ModelFit) -> bool:
    """Return whether only the readings say how far the robot deviates."""
    options = fit.options
    return options.earlier is None and options.prior_scale is None and observes_places(fit)


def _weights(logarithms: np.ndarray) -> np.ndarray:
    """Return weights of sum 1 from their logarithms but for a constant, shape (n,)."""
    weights = np.exp(logarithms - logarithms.max())
    return np.asarray(weights / weights.sum())


def at_nominal(fit: ModelFit, benefit: Benefit) -> ModelFit:
    """Return a fit of base, target and instrument alone, in which the robot's parameters are
    nominal, and uncertain.

    Further fits with its options have priors as wide as the robot deviates.
    """
    scale = benefit.scale
    spread = benefit.spread
    problem = fit.problem
    free = fit.solution.free
    nominal = fit.nominal
    deviating = _deviating(fit)
    sizes = np.where(deviating, spread * fit.priors.sizes, fit.priors.sizes)
    at = Linearised(problem, nominal.values, free, nominal.weights, sizes)
    solution = replace(
        nominal,
        posterior=at.posterior(nominal.sigma),
        free=free,
        at_bound=np.zeros(len(free), bool),
    )
    names = tuple(
        p.name for p, is_kept in zip(problem.parameters, deviating & free, strict=True) if is_kept
    )
    kept = Kept(names, benefit.nominal_mm, benefit.calibrated_mm)
    options = replace(fit.options, prior_scale=PriorScale(scale, scale, scale, scale), kept=kept)
    return replace(fit, solution=solution, priors=replace(fit.priors, sizes=sizes), options=options)


def _deviating(fit: ModelFit) -> np.ndarray:
    """Return the robot's parameters whose usual priors are in force, shape (P,)."""
    problem = fit.problem
    robots = set(fit.names_of(effect for effect in problem.effects if effect.scope == "robot"))
    is_robots = np.array([parameter.name in robots for parameter in problem.parameters], bool)
    return np.asarray(
        np.any(deviations(problem, fit.options), axis=0) & is_robots & problem.is_shared
    )


class _Given(NamedTuple):
    """The deviations given a scale of the priors: its log evidence, their mean, shape (F,), and
    covariance, shape (F, F).
    """

    scale: float
    log_evidence: float
    mean: np.ndarray
    covariance: np.ndarray

    def loss(self, W: np.ndarray, x: np.ndarray) -> float:
        """Return the expected mean square error of a robot with deviations ``x``, shape (F,)."""
        away = x - self.mean
        return float(away @ W @ away) + self.uncertainty(W)

    def uncertainty(self, W: np.ndarray) -> float:
        """Return the mean square error of the most probable robot."""
        return float(np.sum(W * self.covariance))


class _Averaged(NamedTuple):
    """Expected errors of a robot, averaged over the scales of the priors.

    Attributes:
        given: the deviations at each scale; the first is the URDF as it is.
        W: shape (F, F), of the errors within the joint limits [m^2].
        W_measured: shape (F, F), of those at measured poses [m^2].
    """

    given: Sequence[_Given]
    W: np.ndarray
    W_measured: np.ndarray

    @property
    def evidences(self) -> np.ndarray:
        """The log evidence of each scale."""
        return np.array([given.log_evidence for given in self.given])

    @property
    def scale(self) -> float:
        """Factor on the usual priors, rms over its evidence."""
        scales = np.array([given.scale for given in self.given])
        return float(np.sqrt(_weights(self.evidences) @ scales**2))

    @property
    def doubted(self) -> np.ndarray:
        """The weights of the scales for those who expect the URDF to be right."""
        # To leave a robot as it is costs a gain; to make it worse costs trust.
        odds = np.zeros(len(self.given))
        odds[0] = np.log(DELIVERY.as_described * (len(self.given) - 1))
        return _weights(self.evidences + odds)

    def mean_squares(self, x: np.ndarray) -> np.ndarray:
        """Return the expected mean squares within the joint limits [m^2] of the URDF and of a robot
        with deviations ``x``, shape (F,).
        """
        losses = [[given.loss(self.W, 0.0 * x), given.loss(self.W, x)] for given in self.given]
        return np.asarray(_weights(self.evidences) @ np.array(losses))

    def expected(self, W: np.ndarray, x: np.ndarray) -> float:
        """Return the rms error of deviations ``x``, shape (F,), that doubters expect."""
        losses = np.array([given.loss(W, x) for given in self.given])
        return float(np.sqrt(self.doubted @ losses))

    def is_worth_it(self, x: np.ndarray) -> bool:
        """Return whether doubters expect a robot with deviations ``x`` to be better."""
        anywhere = self.expected(self.W, x) / self.expected(self.W, 0.0 * x)
        at_measured = self.expected(self.W_measured, x) / self.expected(self.W_measured, 0.0 * x)
        return anywhere < DELIVERY.worth_it or (
            at_measured < DELIVERY.worth_it and anywhere < DELIVERY.no_worse
        )

    @property
    def cautious(self) -> float | None:
        """The scale whose most probable robot doubters expect to be nearest; None where that one is
        not worth it either.
        """
        nearest = min(self.given, key=lambda given: self.expected(self.W, given.mean))
        return nearest.scale if self.is_worth_it(nearest.mean) else None


class _Evidence(NamedTuple):
    """What the readings say of F parameters at the nominal robot.

    Attributes:
        H: shape (F, F), information in units of the noise.
        b: shape (F,), gradient.
        sizes: shape (F,), standard deviations of the usual priors.
        scaled: shape (F,), which of them are scaled.
        squares: sum of squared residuals of the nominal robot, in units of the noise.
        readings: their number, beyond the placements; 0 if the noise is known.
        most: factor on the priors, per factor on the noise, up to which they are compared.
    """

    H: np.ndarray
    b: np.ndarray
    sizes: np.ndarray
    scaled: np.ndarray
    squares: float
    readings: float
    most: float

    @classmethod
    def of(cls, fit: ModelFit, shared: np.ndarray, scaled: np.ndarray) -> _Evidence:
        """Return it as linear from the nominal robot to the fitted one, at which it is linearised.

        A fit may be far from nominal, and the decision is about it.
        """
        solution = fit.solution
        at = Linearised(fit.problem, fit.values, solution.free, solution.weights, fit.priors.sizes)
        # A fit of many parameters to few readings may leave next to nothing of one kind of them.
        sigma = solution.sigma if fit.is_declared else fit.nominal.sigma
        form = at.posterior(sigma).form
        x = (fit.values - fit.nominal.values)[shared]
        b = form.g + form.H @ x
        squares = _squares(fit, sigma) + float(x @ (form.g + b))
        sizes = np.minimum(fit.priors.sizes[shared], _ANYWHERE)
        readings = 0.0
        most = 1.0
        if not fit.is_declared:
            readings = float(fit.problem.readings(solution.weights).sum()) - fit.nominal.effective
            # With the usual priors the noise is that of the fit.
            most = float(np.max(sigma / np.maximum(solution.sigma, sigma / _MOST)))
        return cls(form.H, b, sizes, scaled[shared], squares, readings, max(most, 1.0))

    @property
    def compared(self) -> list[_Given]:
        """The deviations for scales from none to the usual priors."""
        ratios = _LEAST * _STEP ** np.arange(1 + round(np.log(self.most / _LEAST) / np.log(_STEP)))
        found = [self.at(ratio) for ratio in (_NONE, *ratios)]
        return [given for given in found if given.scale < _STEP**0.5]

    def at(self, scale: float) -> _Given:
        """Return the deviations with priors scaled; those of an unknown noise relative to it, which
        follows.
        """
        sizes = self.sizes * np.where(self.scaled, scale, 1.0)
        factor = Factor.of(self.H + np.diag(sizes**-2.0))
        half = factor.half(self.b)
        gain = float(half @ half)
        determinants = factor.log_det + 2.0 * float(np.log(sizes).sum())
        covariance = factor.solve(np.eye(len(sizes)))
        if not self.readings:
            return _Given(scale, 0.5 * (gain - determinants), factor.back(half), covariance)
        variance = max(self.squares - gain, 1e-300) / self.readings
        log_evidence = -0.5 * (self.readings * np.log(variance) + determinants)
        return _Given(
            scale * float(np.sqrt(variance)), log_evidence, factor.back(half), variance * covariance
        )


def _squares(fit: ModelFit, sigma: np.ndarray) -> float:
    """Return the sum of squared residuals of a fit, in units of a noise, shape (blocks,)."""
    found = 0.0
    for (station, places, blocks), rows in zip(fit.stations, fit.problem.rows, strict=True):
        scale = station.weights / np.repeat(sigma[blocks], station.block_sizes)[:, None]
        residuals = station.whitened(station.residuals(fit.values[places])) * scale
        found += float(np.sum(residuals**2 * fit.solution.weights[rows]))
    return found


def _weight(
    robot: FittedRobot, fit: ModelFit, shared: np.ndarray, conditions: Conditions
) -> np.ndarray:
    """Return the matrix of the mean square position error over poses of the robot of a fit at one
    of its stations, shape (F, F) [m^2].
    """
    on_its_day = robot.of_its_day(conditions)
    poses, J = robot.model.linearise(robot.model_values, on_its_day)
    along = unplaced(J[:, :3], poses)
    places = {name: k for k, name in enumerate(robot.model.names)}
    names = [
        p.name for p, is_shared in zip(fit.problem.parameters, shared, strict=True) if is_shared
    ]
    columns = np.zeros((*along.shape[:2], len(names)))
    known = [k for k, name in enumerate(names) if name in places]
    columns[:, :, known] = along[:, :, [places[names[k]] for k in known]]
    return np.asarray(np.einsum("nip,niq->pq", columns, columns, optimize=True) / len(columns))
