"""What is smooth in the joints and has no name, as a remainder that predicts.

After the last name errors may remain that are smooth functions of all joints: of the drives, seen
through the arm's Jacobian, or of the target along the base's axes, or both
(:class:`pincal.model.catalogue.SmoothRemainder`). Lengths and sizes of these errors are those of
largest evidence (:mod:`pincal.discover.smooth_likelihood`).

The remainder enters only if regions of joint space that are left out are predicted better with it,
all parameters fitted again, by more than their scatter, and none of them worse than by its own
scatter than by geometry and elasticity alone. It is no name: it says nothing of causes, and neither
names nor verdict depend on it.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import chdtrc, stdtr

from pincal.discover.decisions import standard_errors
from pincal.discover.discovery_file import Region, Smooth, SmoothPart
from pincal.discover.ending import joint_noise, weighed
from pincal.discover.policy import REMAINDER, TESTING
from pincal.discover.smooth_likelihood import likely_remainders
from pincal.discover.steps import History
from pincal.identify.calibrate import Tolerance, refit
from pincal.identify.dependence import placed_at_mean
from pincal.identify.fit import ModelFit
from pincal.identify.folds import Folds, left_out_residuals
from pincal.model.catalogue.remainder import SmoothRemainder
from pincal.validate.accuracy import pose_error_sizes
from pincal.validate.misfit import MISFIT

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LeftOutRegions:
    """Mean errors of regions of joint space, each predicted by fits of the others [mm].

    Attributes:
        rows: shape (R,), number of rows of each region.
        plain: shape (R,), by geometry and elasticity.
        before: shape (R,), by these and the names that were found.
        after: shape (R,), with the remainder as well.
        spread: shape (R,), standard error of ``after`` less the larger of the others.
    """

    rows: np.ndarray
    plain: np.ndarray
    before: np.ndarray
    after: np.ndarray
    spread: np.ndarray

    @property
    def is_better(self) -> bool:
        """Whether all regions together are predicted better with the remainder, and none worse than
        its own scatter allows.
        """
        gains = self.rows * (self.before - self.after)
        worse = self.after - np.maximum(self.plain, self.before)
        chance = stdtr(self.rows - 1.0, -worse / self.spread)
        return bool(
            standard_errors(gains) > TESTING.predicts
            and not np.any((worse > 0.0) & (chance < REMAINDER.worse))
        )


@dataclass(frozen=True)
class SmoothRest:
    """What entered without a name, and what it gains.

    Attributes:
        effects: the parts of the remainder.
        regions: the errors of regions that were left out.
        centres: shape (R, n), mean joint positions of these.
    """

    effects: tuple[SmoothRemainder, ...]
    regions: LeftOutRegions
    centres: np.ndarray

    def found_in(self, fit: ModelFit) -> Smooth:
        """Return it as findings say it, with its amplitudes by the last fit."""
        of = self.regions
        names = fit.problem.chain.robot.joint_names
        columns = (of.rows, of.plain, of.before, of.after, self.centres)
        regions = tuple(
            Region(
                rows=int(rows),
                calibrated_mm=float(plain),
                named_mm=float(before),
                smooth_mm=float(after),
                centre=dict(zip(names, centre.tolist(), strict=True)),
            )
            for rows, plain, before, after, centre in zip(*columns, strict=True)
        )
        return Smooth(
            parts=tuple(_part(fit, effect) for effect in self.effects),
            named_mm=float(np.average(of.before, weights=of.rows)),
            smooth_mm=float(np.average(of.after, weights=of.rows)),
            regions=regions,
        )


def with_remainder(trail: History) -> tuple[History, SmoothRest | None]:
    """Return a search with what is smooth in the joints and has no name, if regions that are left
    out say that it predicts; else as it was.
    """
    fit = _alike(trail.final)
    if _is_explained(fit):
        return trail, None
    folds = Folds.of(fit.problem, ("regions",)).of_way
    if "regions" not in folds:
        return trail, None
    judge = _Judge(trail, folds["regions"])
    for effects in likely_remainders(fit)[: REMAINDER.tried]:
        after = _fitted(fit, effects)
        regions = judge.regions(after)
        if regions is not None and regions.is_better:
            for effect in effects:
                log.info("unnamed, smooth: %s over %.2f rad", effect.moves, effect.length)
            changed = trail.changed(after, trail.steps, effects, ())
            return changed, SmoothRest(effects, regions, judge.centres)
    return trail, None


def _alike(fit: ModelFit) -> ModelFit:
    """Return a fit in which all readings of a row count alike, where they were weighted by joint
    noise.

    What drives lack in common looks like noise of the joints, row by row.
    """
    stations = fit.problem.stations
    if fit.is_declared or all(of.whitening is None or of.arrival is not None for of in stations):
        return fit
    plain = fit.over(replace(station, whitening=None) for station in stations)
    return refit(plain, fit.options.effects, start={}, until=Tolerance.CLOSE)


def _fitted(fit: ModelFit, effects: Sequence[SmoothRemainder]) -> ModelFit:
    """Return a fit with a remainder, weighted by what is then left of the noise of the joints."""
    after = refit(fit, [*fit.options.effects, *effects], start={}, until=Tolerance.CLOSE)
    noise = joint_noise(after)
    if noise is not None:
        after = refit(weighed(after, noise), after.options.effects, start={}, until=Tolerance.CLOSE)
    return placed_at_mean(after)


def _is_explained(fit: ModelFit) -> bool:
    """Return whether the residuals are no larger than a declared noise."""
    solution = fit.solution
    return fit.is_declared and bool(chdtrc(solution.degrees, solution.chi2) >= MISFIT)


@dataclass(frozen=True, eq=False)
class _Judge:
    """Errors of regions, shape (N,), that are left out, by fits of the others."""

    trail: History
    fold: np.ndarray

    @cached_property
    def without(self) -> np.ndarray:
        """Errors without a remainder by geometry and elasticity, and by the names as well, shape
        (2, N) [mm].
        """
        before = self.trail.final
        steps = [step for step in self.trail.steps if not step.is_elastic]
        named = {effect.identity for step in steps for effect in step.effects}
        bare = [effect for effect in before.options.effects if effect.identity not in named]
        plain = refit(before, bare, start={}, until=Tolerance.CLOSE) if named else before
        return np.array([_left_out(fit, self.fold) for fit in (plain, before)])

    @cached_property
    def rows(self) -> list[np.ndarray]:
        """The rows of each region that count, shape (N,) each; empty where no error is known."""
        known = np.isfinite(self.without).all(axis=0)
        known &= self.trail.final.solution.weights > 0.0
        return [known & (self.fold == k) for k in np.unique(self.fold[known])]

    @property
    def centres(self) -> np.ndarray:
        """Mean joint positions of each region, shape (R, n)."""
        q = self.trail.final.problem.conditions.q
        return np.array([q[rows].mean(axis=0) for rows in self.rows])

    def regions(self, after: ModelFit) -> LeftOutRegions | None:
        """Return the errors with the remainder of a fit; None where no error is known."""
        errors = np.vstack([self.without, _left_out(after, self.fold)])
        if not self.rows or not np.isfinite(errors[:, np.any(self.rows, axis=0)]).all():
            return None
        plain, before, last = np.array([errors[:, rows].mean(axis=1) for rows in self.rows]).T
        spread = np.array([_spread(errors[:, rows]) for rows in self.rows])
        counts = np.array([np.count_nonzero(rows) for rows in self.rows])
        return LeftOutRegions(counts, plain, before, last, spread)


def _spread(errors: np.ndarray) -> float:
    """Return the standard error of the mean of the last errors less the larger of the others, shape
    (3, n); infinite for a single row.
    """
    if errors.shape[1] < 2:
        return np.inf
    largest = int(np.argmax(errors[:2].mean(axis=1)))
    differences = errors[2] - errors[largest]
    return float(differences.std(ddof=1) / np.sqrt(len(differences)))


def _left_out(fit: ModelFit, fold: np.ndarray) -> np.ndarray:
    """Return the error of each row by the fit without its fold, shape (N,) [mm]; nan of readings
    that have none.
    """
    fit = placed_at_mean(fit)
    (by_station,) = left_out_residuals(fit, fit.solution, [fold])
    found = np.full(len(fold), np.nan)
    for (station, places, _), rows, residuals in zip(
        fit.stations, fit.problem.rows, by_station, strict=True
    ):
        sizes = pose_error_sizes(station, fit.values[places], residuals=residuals)
        if "mm" in sizes:
            found[rows] = sizes["mm"]
    return found


def _part(fit: ModelFit, effect: SmoothRemainder) -> SmoothPart:
    """Return a part of a remainder, with the size that it has over the fitted rows."""
    values = fit.estimate.take(fit.names_of([effect])).values
    counts = [len(sums) for sums in effect.sums]
    of_place = np.split(values, np.cumsum(counts)[:-1])
    errors = [
        own @ basis
        for own, basis in zip(
            of_place, effect.errors(fit.problem.chain, fit.problem.conditions), strict=True
        )
    ]
    norms = np.concatenate([np.linalg.norm(sums, axis=1) for sums in effect.sums])
    prior = fit.priors.sizes[fit.problem.places_at(effect)] * norms
    return SmoothPart(
        errs=effect.moves,
        depends_on=effect.joints,
        length_rad=effect.length,
        size=float(np.sqrt(np.mean(np.square(errors)))),
        sigma=float(np.sqrt(effect.count) * prior.max()),
        unit="rad" if effect.moves == "drive" else "m",
        parameters=len(values),
    )


def note_on_remainder(rest: SmoothRest) -> str:
    """Return in words what entered without a name."""
    before, after = (
        float(np.average(of, weights=rest.regions.rows))
        for of in (rest.regions.before, rest.regions.after)
    )
    kinds = {"drive": "the drives err", "base": "the target is displaced"}
    what = " and ".join(
        f"{kinds[effect.moves]} alike over {effect.length:g} rad" for effect in rest.effects
    )
    return (
        f"unnamed, smooth: {what}, as smooth functions of pairs of joints; regions that are left "
        f"out are predicted to {after:.3f} mm on average instead of {before:.3f}; this says "
        "nothing of causes"
    )
