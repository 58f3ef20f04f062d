"""Findings of a discovery from its history: significance and equivalents of each effect, and where
the misfit was.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from msgspec.structs import replace as changed
from scipy.special import chdtrc

from pincal.discover.candidate_tests import named_tests
from pincal.discover.decisions import Row, accepted
from pincal.discover.detectability import ABSORBED
from pincal.discover.discovery_file import (
    Bootstrap,
    Disagreement,
    EffectName,
    Findings,
    FoundEffect,
    FoundParameter,
    Gap,
    Stage,
    Untestable,
)
from pincal.discover.elastic import (
    JointCompliance,
    deciding_measurement,
    instead_of,
    significant_compliances,
    without_compliance,
)
from pincal.discover.ending import line_details
from pincal.discover.first_order import ScoreTests, chance_of
from pincal.discover.locate import Located, locate
from pincal.discover.place_numbers import WHERE
from pincal.discover.scatter import Excess, find_excess
from pincal.discover.score_numbers import TESTING
from pincal.discover.shrink import PartialResidual, period_of
from pincal.discover.smooth_rest import SmoothRest
from pincal.discover.steps import History, SearchStep
from pincal.identify.calibrate import refitted_without
from pincal.identify.fit import ModelFit
from pincal.identify.fit_levers import levers
from pincal.model.catalogue import untestable
from pincal.model.effect import Effect, Harmonic
from pincal.parameters import Estimate
from pincal.robot.robot import Robot
from pincal.units import format_small
from pincal.validate.misfit import MISFIT, judge

_FOLLOWED = {
    "approach": "depending on the direction from which it arrives",
    "load": "following the load on its axis",
    "move": "in proportion to its last move",
    "payload": "following the payload",
    "temperature": "following the temperature",
    "time": "drifting with time",
}


def findings_of(
    fit: ModelFit,
    trail: History,
    *,
    gaps: tuple[Stage, ...],
    traces: tuple[PartialResidual, ...],
    rest: SmoothRest | None = None,
    measured: ModelFit | None = None,
    held_out: Mapping[str, dict[Literal["before", "after"], Gap]] | None = None,
    approach_from: str | None = None,
    arrivals: float | None = None,
) -> Findings:
    """Return the findings of a discovery.

    Args:
        fit: the final fit, with a covariance that includes the selection.
        trail: the history, of names.
        gaps: the errors at the start and after each change of the model.
        traces: partial residuals of each effect.
        rest: what entered the fit without a name; None if nothing did.
        measured: the last fit over the means of each stop; default:
            those of the fit.
        held_out: the errors at the start and in the end on rows held out in each way.
        approach_from: origin of the directions of approach, in words; None without any.
        arrivals: from :func:`pincal.discover.scatter.arrivals_within`.
    """
    final = trail.final
    excess = find_excess(final, measured)
    scatter = None if excess is None else excess.scattering
    floor, unexplained = _errors_of(final)
    is_misfit = final.is_declared and chdtrc(final.solution.degrees, final.solution.chi2) < MISFIT
    periods = _periods(traces)
    effects = tuple(
        found
        for step in trail.steps
        for found in _found(fit, trail, step, gaps=gaps, periods=periods)
    )
    return Findings(
        noise_floor_mm=floor,
        gap={"before": gaps[0].gap, "after": gaps[-1].gap},
        chain=gaps,
        where=where_of(trail, excess, is_misfit=is_misfit, arrivals=arrivals),
        effects=effects,
        scatter=() if scatter is None else (scatter,),
        not_testable=tuple(
            Untestable.of(effect, reason=reason) for effect, reason in _not_testable(trail)
        ),
        # Whether residuals exceed a noise is judged with the result, which knows what replicates
        # scatter.
        verdict=judge(None, incomplete=excess is not None),
        unexplained_mm=unexplained,
        approach_from=approach_from,
        held_out=dict(held_out or {}),
        remainder=None if rest is None else rest.found_in(fit),
        delivered=_delivered(trail, rest),
    )


def _delivered(trail: History, rest: SmoothRest | None) -> Literal["calibrated", "named", "smooth"]:
    if rest is not None:
        return "smooth"
    return "named" if any(not step.is_elastic for step in trail.steps) else "calibrated"


def _errors_of(fit: ModelFit) -> tuple[float, float]:
    """Return the rms errors due to noise and those in excess of it, over the rows of all stations
    [mm].
    """
    squares = []
    every = noise_floor(fit)
    rows = []
    for station, places, blocks in fit.stations:
        if not station.sensor.reads_place:
            continue
        rows.append(len(station))
        sigma = every[blocks.start]
        found = fit.solution.estimated[blocks.start]
        to_mm = 1e3 * station.metres_per_reading(fit.values[places])
        of_noise_and_rest = np.array([sigma**2, max(found**2 - sigma**2, 0.0)])
        squares.append(of_noise_and_rest * station.sensor.blocks[0].size * to_mm**2)
    floor, unexplained = np.sqrt(np.average(squares, axis=0, weights=rows))
    return float(floor), float(unexplained)


def _periods(traces: Iterable[PartialResidual]) -> dict[Effect, dict[str, Any]]:
    """Return the periods of effects without a name, with their units."""
    return {
        trace.effect: {"period": period, "period_unit": trace.unit}
        for trace in traces
        if trace.effect.is_nameless and (period := period_of(trace)) is not None
    }


def _found(
    fit: ModelFit,
    trail: History,
    step: SearchStep,
    *,
    gaps: tuple[Stage, ...],
    periods: dict[Effect, dict[str, Any]],
) -> Iterator[FoundEffect]:
    """Yield the effects of one step; elasticity joint by joint."""
    place = next(i for i, change in enumerate(trail.changes) if change.fit is step.after)
    before = gaps[place]
    after = gaps[place + 1]
    score = step.score
    line = line_details(trail, step)
    for known in _known_of(fit, trail, step):
        sure_as = replace(score, p_value=known.p_value)
        if (
            step.is_elastic
            and trail.has_prior_elasticity
            and not accepted(Row(known.effect, sure_as, score.ebic), trail.policy)
        ):
            # Given all other compliances, which on few rows depend on priors, it is not
            # significant.
            continue
        yield FoundEffect.of(
            known.effect,
            parameters=_parameters(known.estimate, known.sigma),
            p_value=known.p_value,
            gap_before_mm=before.mean_mm,
            gap_after_mm=after.mean_mm,
            gap_before_mrad=before.mean_mrad,
            gap_after_mrad=after.mean_mrad,
            equivalent=tuple(EffectName.of(other) for other in known.equivalent),
            tell_apart=known.tell_apart,
            **line,
            **periods.get(known.effect, {}),
        )


@dataclass(frozen=True)
class _KnownEffect:
    """What is known of an effect that was found.

    Attributes:
        effect: the effect.
        estimate: its parameters.
        sigma: their standard deviations as they are stated.
        p_value: of its being there by chance.
        equivalent: effects that it could be instead.
        tell_apart: the measurement that would decide; "" without any.
    """

    effect: Effect
    estimate: Estimate
    sigma: np.ndarray
    p_value: float
    equivalent: tuple[Effect, ...]
    tell_apart: str


def _known_of(fit: ModelFit, trail: History, step: SearchStep) -> list[_KnownEffect]:
    """Return what is known of the effects of a step; elasticity joint by joint."""
    if step.is_elastic:
        return [
            _KnownEffect(
                sure.effect,
                sure.estimate,
                fit.estimate.take(sure.estimate.names).fitted_sigma,
                sure.p_value,
                *_in_its_place(trail, sure),
            )
            for sure in significant_compliances(trail.final, step.effects, step.equivalent)
        ]
    own = step.effects if isinstance(step.effect, Harmonic) else step.effects[:1]
    estimate = fit.estimate.take(trail.final.names_of(own))
    # By rows that are independent or, if it is larger, by blocks of consecutive rows.
    of_blocks = fit.solution.of_blocks
    score = step.score
    correlated = float(chdtrc(score.rank, score.gain / of_blocks)) if of_blocks > 1.0 else 0.0
    p_value = max(score.p_value, correlated)
    return [
        _KnownEffect(
            step.effect, estimate, estimate.sigma, p_value, step.equivalent, _deciding(step)
        )
    ]


def _deciding(step: SearchStep) -> str:
    """Return the measurement that would distinguish an effect from its first equivalent, or from
    several together.
    """
    tested = (step.before, step.tested, step.estimate)
    if not step.together:
        return "".join(deciding_measurement(*tested, rival) for rival in step.equivalent[:1])
    names = [
        f"{effect.name} of order {at.order}" if (at := effect.locus).order else effect.name
        for effect in step.together
    ]
    words = (
        f"{', '.join(names[:-1])} and {names[-1]} of {step.effect.locus.joint} are together "
        "equivalent"
    )
    return f"{words}; {deciding_measurement(*tested, *step.together)}"


def _in_its_place(trail: History, sure: JointCompliance) -> tuple[tuple[Effect, ...], str]:
    """Return the equivalents of one joint's compliance, and the measurement that would decide."""
    compliance = sure.effect
    rivals = tuple(
        dict.fromkeys(
            (*instead_of(trail.last, compliance, sure.estimate, sure.given), *sure.others)
        )
    )
    if not rivals:
        return (), ""
    rest = without_compliance(trail.final, compliance, *(sure.others[:1] if sure.given else ()))
    own = np.array(
        [sure.estimate[parameter.name] for parameter in compliance.parameters(rest.problem.chain)]
    )
    return rivals, deciding_measurement(rest, compliance, own, rivals[0])


def _parameters(estimate: Estimate, sigmas: np.ndarray) -> dict[str, FoundParameter]:
    """Return parameters by name, infinite standard deviations as None."""
    return {
        p.name: FoundParameter(
            p.nominal + float(value), float(sigma) if np.isfinite(sigma) else None, p.unit
        )
        for p, value, sigma in zip(estimate.parameters, estimate.values, sigmas, strict=True)
    }


def _not_testable(trail: History) -> Iterator[tuple[Effect, str]]:
    """Yield effects that these data can't test, with the reason."""
    final = trail.final
    is_alone = len(final.problem.stations) == 1
    lost = untestable(final.problem.chain, final.problem.conditions)
    yield from ((effect, reason) for effect, reason in lost if is_alone or effect.scope == "robot")
    for i, effect in enumerate(trail.last.effects):
        if trail.last.gain([i])[1] == 0:
            yield effect, ABSORBED


def noise_floor(fit: ModelFit) -> np.ndarray:
    """Return the declared standard deviations of the blocks, shape (blocks,), or of the residuals
    where none is declared.
    """
    pairs = zip(fit.noise.declared, fit.solution.estimated, strict=True)
    return np.array([estimated if declared is None else declared for declared, estimated in pairs])


def where_of(
    trail: History, excess: Excess | None, *, is_misfit: bool, arrivals: float | None = None
) -> tuple[Disagreement, ...]:
    """Return where model and data disagree, with shares of the excess over the noise.

    The disagreement is located in the first fit with elasticity, if the arm is elastic, else in the
    first of all, regardless of later names; last is the final excess along the lever of one joint,
    or of all, or a misfit that is nowhere located.
    """
    robot = trail.final.problem.chain.robot
    fit = trail.first
    found = list[Disagreement]()
    sigma = noise_floor(trail.final)
    for step in trail.steps:
        if step.is_elastic:
            fit = step.after
            found.append(_elastic(step, sigma))
    places, regions = _located(fit, sigma)
    for name, place in places:
        region = None if place.joint else "whole arm"
        words = _words(place, robot)
        words = f"{name}: {words}" if name else words
        found.append(
            Disagreement(words, place.share, place.joint, region, place.acts_on, place.depends_on)
        )
    found += regions
    if excess:
        found.append(_left_along(trail.final, excess, sigma))
    elif arrivals is not None:
        statement = (
            f"all drives stop alike to {format_small(arrivals, 'rad')} from pose to pose (one "
            "standard deviation)"
        )
        found.append(Disagreement(statement, 1.0, region="whole arm"))
    elif is_misfit and not places:
        statement = "the residuals depend on no joint position, load or recorded column"
        found.append(Disagreement(statement, 1.0, region="whole workspace"))
    return tuple(found)


def _located(
    fit: ModelFit, sigma: np.ndarray
) -> tuple[list[tuple[str, Located]], list[Disagreement]]:
    """Return where a fit and its data disagree, with the names of several stations, the largest
    first.
    """
    places: list[tuple[str, Located]] = []
    regions: list[Disagreement] = []
    for station, alone, blocks in fit.in_places:
        here, found = locate(alone, sigma[blocks])
        part = (
            1.0
            if not station.name
            else _excess(alone, sigma[blocks]) / max(_excess(fit, sigma), 1e-300)
        )
        part = float(np.clip(part, 0.0, 1.0))
        places += [(station.name, replace(place, share=part * place.share)) for place in here]
        name = f"{station.name}: " if station.name else ""
        regions += [changed(r, statement=name + r.statement, share=part * r.share) for r in found]
    if len(fit.problem.stations) == 1:
        return places, regions
    places.sort(key=lambda pair: -pair[1].share)
    regions.sort(key=lambda region: -region.share)
    return places[: WHERE.places], regions[: WHERE.places]


def _excess(fit: ModelFit, sigma: np.ndarray) -> float:
    """Return the excess of a fit's squared residuals over the noise, in units of its variance."""
    solution = fit.solution
    readings = fit.problem.readings(solution.weights)
    degrees = readings - solution.effective * (readings / readings.sum())
    return float(np.sum(degrees * ((solution.estimated / sigma) ** 2 - 1.0)))


def _elastic(step: SearchStep, sigma: np.ndarray) -> Disagreement:
    """Return how much of the residuals follows the static moments, and where it is strongest."""
    whole = _excess(step.before, sigma)
    share = 1.0 - max(_excess(step.after, sigma), 0.0) / whole if whole > 0.0 else 0.0
    joint = significant_compliances(step.after, step.effects)[0].effect.locus.joint
    statement = (
        "the residuals of the geometric model follow the static moments on the joints, "
        f"mainly on {joint}"
    )
    return Disagreement(statement, float(np.clip(share, 0.0, 1.0)), joint)


def _left_along(fit: ModelFit, excess: Excess, sigma: np.ndarray) -> Disagreement:
    """Return how much of the final residuals is along the lever of one joint."""
    chain = fit.problem.chain
    made = 0.0
    drive = int(chain.drives[chain.robot.joint_names.index(excess.joint)])
    for _, alone, blocks in fit.in_places:
        lever = levers(alone, (drive,))[0]
        rows = alone.solution.weights > 0.0
        squares = float(np.sum(lever[: alone.station.sensor.blocks[0].size, rows] ** 2))
        made += excess.sigma**2 * squares / float(sigma[blocks.start]) ** 2
    share = made / max(_excess(fit, sigma), made)
    return Disagreement(excess.statement, share, excess.joint)


def _words(place: Located, robot: Robot) -> str:
    """Return a disagreement in words: where it acts, on what it depends, and the range that
    contains most of it.
    """
    units = dict(zip(robot.joint_names, robot.joint_units, strict=True))
    if place.acts_on == "base":
        moves = "the whole arm moves on its base"
    elif place.acts_on == "lengths":
        moves = f"all lengths are scaled by {format_small(place.size, '1')} rms"
    elif place.acts_on != "drive":
        moves = f"the axis of {place.joint} tilts by {format_small(place.size, 'rad')} rms"
    elif units[place.joint or ""] == "m":
        moves = f"{place.joint} has an error along its axis of {format_small(place.size, 'm')} rms"
    else:
        moves = (
            f"{place.joint} has an error about its own axis of "
            f"{format_small(place.size, 'rad')} rms"
        )
    whose = (
        "its own position"
        if place.depends_on == place.joint
        else f"the position of {place.depends_on}"
    )
    text = f"{moves}, {_FOLLOWED.get(place.depends_on, f'following {whose}')}"
    if place.window is None:
        return text
    form, unit, factor = (
        (".3f", "m", 1.0) if units[place.depends_on] == "m" else (".0f", "deg", np.degrees(1.0))
    )
    low, high = (f"{x * factor:{form}}" for x in place.window)
    return f"{text}; {100 * place.inside:.0f} % of it between {low} and {high} {unit}"


def bootstrap_last(trail: History) -> Bootstrap | None:
    """Return the p-value of the effect accepted last by a parametric bootstrap; None if only
    elasticity was accepted.

    Data drawn from the model without it, with the estimated noise, are tested against all
    candidates, and the best score is compared with that of the real data. That tests the selection
    as a whole, unlike the p-value of a single candidate. To first order no draw is fitted: with
    normal noise the projected products b' of the score tests are normal, with covariance S'.
    """
    steps = [step for step in trail.steps if not step.is_elastic]
    if not steps:
        return None
    rest = refitted_without(trail.final, steps[-1].effects)
    tests = named_tests(rest, trail.extra, trail.policy, steps[-1].effects)
    return Bootstrap.of(
        steps[-1].effect, p_value=chance_of_best(tests, TESTING.drawn), draws=TESTING.drawn
    )


def chance_of_best(tests: ScoreTests, draws: int, seed: int = 0) -> float:
    """Return the probability that noise alone gives some candidate as small a p-value as the best,
    from so many draws.
    """
    _, S, _ = tests.within(range(len(tests.effects)))
    rng = np.random.default_rng(seed)
    scale = np.sqrt(np.maximum(np.diag(S), 1e-300))
    sizes, axes = np.linalg.eigh(S / np.outer(scale, scale))
    seen = sizes > TESTING.drawn_from * sizes[-1]
    noise = rng.standard_normal((draws, np.count_nonzero(seen)))
    b = noise * np.sqrt(sizes[seen]) @ axes[:, seen].T * scale
    # Noise outside the span of the candidates is never explained.
    unseen = max(tests.dof - noise.shape[1], 1.0)
    squares = np.sum(noise**2, axis=1) + rng.chisquare(unseen, draws)
    observed = 1.0
    drawn = np.ones(draws)
    for i, effect in enumerate(tests.effects):
        observed = min(observed, tests.score([i], 1).p_value)
        places, whitening = tests.whitening([i])
        if rank := whitening.shape[1]:
            gains = np.sum((b[:, places] @ whitening) ** 2, axis=1)
            drawn = np.minimum(drawn, effect.trials * chance_of(gains, rank, squares, tests.dof))
    return float(1.0 + np.count_nonzero(drawn <= observed)) / (draws + 1.0)
