"""What is smooth in the joints and has no name, as a remainder that predicts.

After the last name errors may remain that are smooth functions of all joints: of the drives, seen
through the arm's Jacobian, or of the target along the base's axes, or both
(:class:`pincal.model.catalogue.SmoothRemainder`). Lengths and sizes of these errors are those of
largest evidence (:mod:`pincal.discover.smooth_likelihood`).

The remainder enters only if regions of joint space that are left out are predicted better with it,
all parameters fitted again, by more than their scatter, and none of them worse than by geometry and
elasticity alone. Where one is, it is tried with less freedom. It is no name: it says nothing of
causes, and neither names nor verdict depend on it.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from pincal.discover.discovery_file import Region, Smooth, SmoothPart
from pincal.discover.ending import joint_noise, weighed
from pincal.discover.remainder_numbers import REMAINDER
from pincal.discover.smooth_judge import LeftOutRegions, RegionJudge
from pincal.discover.smooth_likelihood import likely_remainders
from pincal.discover.steps import History
from pincal.identify.calibrate import Tolerance, refit
from pincal.identify.dependence import placed_at_mean
from pincal.identify.fit import ModelFit
from pincal.identify.folds import Folds
from pincal.model.catalogue.remainder import SmoothRemainder
from pincal.model.effect import Effect
from pincal.sensors.row_samples import sample_rows
from pincal.validate.misfit import MISFIT

log = logging.getLogger(__name__)


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
    if _is_explained(trail.final) or not _reads_enough(trail.final):
        return trail, None
    folds = Folds.of(trail.final.problem, ("regions",)).of_way
    if "regions" not in folds:
        return trail, None
    found = _found(trail.final, RegionJudge(trail, folds["regions"]))
    if found is None:
        return trail, None
    for effect in found.rest.effects:
        log.info("unnamed, smooth: %s over %.2f rad", effect.moves, effect.length)
    changed = trail.changed(found.after, trail.steps, found.rest.effects, ())
    return changed, found.rest


@dataclass(frozen=True)
class _Tried:
    """A remainder, the fit with it, and what regions that are left out say of it."""

    after: ModelFit
    rest: SmoothRest

    @property
    def regions(self) -> LeftOutRegions:
        return self.rest.regions


def _found(fit: ModelFit, judge: RegionJudge) -> _Tried | None:
    """Return the first remainder that predicts and makes no region worse; None if none does.

    Of many rows some are judged first, and all only with what has passed.
    """
    rows = np.arange(len(fit.problem))
    some = rows[sample_rows(len(rows), REMAINDER.judged)]
    is_part = len(some) < len(rows)
    few = _alike(fit.select(some) if is_part else fit)
    for one in _tried(few, judge.select(some) if is_part else judge):
        if one.regions.is_nowhere_worse:
            whole = _by_all(fit, one, judge) if is_part else one
            if whole is not None and whole.regions.is_nowhere_worse:
                return whole
    return None


def _tried(fit: ModelFit, judge: RegionJudge) -> Iterator[_Tried]:
    """Yield remainders that predict: the likeliest ones, and then that of these which predicts best
    with less freedom.

    The less its amplitudes may be, the more must be known of them, so that less is predicted where
    little was measured.
    """
    found = list[_Tried]()
    for effects in likely_remainders(fit)[: REMAINDER.tried]:
        if (one := _judged(fit, effects, judge)) is not None:
            found.append(one)
            yield one
    if not found:
        return
    best = min(found, key=lambda one: one.regions.mean)
    for factor in REMAINDER.narrower:
        narrower = tuple(
            replace(effect, size=float(f"{effect.size * factor:.3g}"))
            for effect in best.rest.effects
        )
        if (one := _judged(fit, narrower, judge)) is not None:
            yield one


def _judged(
    fit: ModelFit, effects: tuple[SmoothRemainder, ...], judge: RegionJudge
) -> _Tried | None:
    """Return a remainder with its fit, if all regions that are left out are predicted better with
    it.
    """
    return _predicting(_fitted(fit, effects), effects, judge)


def _by_all(fit: ModelFit, one: _Tried, judge: RegionJudge) -> _Tried | None:
    """Return a remainder that some rows tell, fitted to all, as :func:`_judged` does; by these rows
    it is known near enough, and so is what is then left of the noise of the joints.
    """
    few = one.after
    effects = one.rest.effects
    noise = joint_noise(few)
    start: dict[Effect, np.ndarray] = {
        effect: few.values[few.problem.places_at(effect)] for effect in effects
    }
    plain = _unweighed(fit)
    begun = plain if noise is None else weighed(plain, noise)
    after = refit(begun, [*fit.options.effects, *effects], start=start, until=Tolerance.CLOSE)
    return _predicting(placed_at_mean(after), effects, judge)


def _predicting(
    after: ModelFit, effects: tuple[SmoothRemainder, ...], judge: RegionJudge
) -> _Tried | None:
    """Return a remainder with its fit, if it predicts."""
    regions = judge.regions(after)
    if regions is None or not regions.predicts:
        return None
    return _Tried(after, SmoothRest(effects, regions, judge.centres))


def _alike(fit: ModelFit) -> ModelFit:
    """Return a fit in which all readings of a row count alike, where they were weighted by joint
    noise.

    What drives lack in common looks like noise of the joints, row by row.
    """
    plain = _unweighed(fit)
    if plain is fit:
        return fit
    return refit(plain, fit.options.effects, start={}, until=Tolerance.CLOSE)


def _unweighed(fit: ModelFit) -> ModelFit:
    """Return a fit, not refitted, whose rows are not weighted by joint noise."""
    stations = fit.problem.stations
    if fit.is_declared or all(of.whitening is None or of.arrival is not None for of in stations):
        return fit
    return fit.over(replace(station, whitening=None) for station in stations)


def _fitted(fit: ModelFit, effects: Sequence[SmoothRemainder]) -> ModelFit:
    """Return a fit with a remainder, weighted by what is then left of the noise of the joints."""
    after = refit(fit, [*fit.options.effects, *effects], start={}, until=Tolerance.CLOSE)
    noise = joint_noise(after)
    if noise is not None:
        after = refit(weighed(after, noise), after.options.effects, start={}, until=Tolerance.CLOSE)
    return placed_at_mean(after)


def _reads_enough(fit: ModelFit) -> bool:
    """Return whether places were read at enough poses to tell regions apart; not of logs of motion,
    which are read as a whole.
    """
    stations = fit.problem.stations
    is_log = any(station.sensor.is_whole for station in stations)
    poses = sum(len(station) for station in stations if station.sensor.reads_place)
    return not is_log and poses >= REMAINDER.regions * REMAINDER.region


def _is_explained(fit: ModelFit) -> bool:
    """Return whether the residuals are no larger than a declared noise."""
    solution = fit.solution
    return fit.is_declared and bool(chdtrc(solution.degrees, solution.chi2) >= MISFIT)


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
