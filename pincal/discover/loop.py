"""Fit, criticise, name, extend, refit, verify: until nothing that the data demand is missing."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pincal.discover.criticism import Criticism, Score, criticise
from pincal.discover.generic import generic_candidates
from pincal.discover.nuisance import MassError
from pincal.discover.shapes import broken_candidates
from pincal.identify.calibrate import Fit, refit, without
from pincal.model.catalogue import TransmissionError
from pincal.model.catalogue import candidates as catalogue_candidates
from pincal.model.effects import BearingElasticity, Effect, JointElasticity

log = logging.getLogger(__name__)

# Chance, per step, that sound data bring in any name at all.
ALPHA = 0.01
# Elasticity is what every arm has, so little evidence brings it in; it is judged again at the end.
_ELASTIC = 1e-4
# Differences of the information criterion below this do not tell effects apart (odds of 20 to 1).
_TIE = 6.0
# A term without a name has to be better than a name by this much to take its place.
_BETTER = 10.0
# Chance above which an effect adds nothing to another.
_ADDS_NOTHING = 1e-3
# Wald statistic a parameter above which an effect need not be judged again.
_SURE = 12.0
_MOST_STEPS = 14
_CURVE_SIZE = 8
_FIRST_SIZES = (8, 12, 18, 26, 44, 80)
_CURVE_SIZES = (8, 10, 12, 15, 18, 22, 26, 32, 38, 44, 52, 60, 70, 80, 100, 120, 150, 180)
# An effect that takes less off the squares than this share, and less than this many, matters to nobody.
_SHARE, _GAIN = 0.01, 100.0


@dataclass(frozen=True)
class Step:
    """One effect that was accepted.

    Attributes:
        effects: what entered the model.
        score: its test against the model before.
        equivalent: candidates that the data can't tell from it.
        before, after: the fits before and after.
        criticism: the tests that it won.
        index: its place (or places) among the candidates of ``criticism``.
    """

    effects: tuple[Effect, ...]
    score: Score
    equivalent: tuple[Effect, ...]
    before: Fit
    after: Fit
    criticism: Criticism
    index: tuple[int, ...]


@dataclass(frozen=True)
class Trail:
    """What a discovery went through.

    Attributes:
        first: the fit that it started from.
        steps: the accepted effects, in order.
        final: the fit of everything that stayed.
        last: the criticism of the final fit, nothing of which passed.
    """

    first: Fit
    steps: tuple[Step, ...]
    final: Fit
    last: Criticism


def discover_effects(
    fit: Fit, groups: np.ndarray, *, extra: Sequence[Effect] = (), alpha: float = ALPHA, elastic: bool = True
) -> Trail:
    """Find the effects that a fit misses.

    Args:
        fit: the model to start from, usually the geometric one.
        groups: shape (N,), blocks of training rows for cross-validation.
        extra: effects of the user's own, which take part like those of the catalogue.
        alpha: chance of a false name a step.
        elastic: whether elasticity may be found; not for an arm without masses.
    """
    first, steps = fit, []
    for _ in range(_MOST_STEPS):
        step = _next_step(fit, groups, extra, alpha, elastic)
        if step is None:
            break
        log.info("found %s: residual %.4f -> %.4f mm", _words(step.effects), *_noise_of(step))
        steps.append(step)
        fit = step.after
    fit, steps = _sharpen(fit, steps, groups)
    fit, steps = _backward(fit, steps, groups, alpha)
    last = _criticise(fit, _candidates(fit, extra, elastic), groups)
    return Trail(first, tuple(steps), fit, last)


def _noise_of(step: Step) -> tuple[float, float]:
    return float(step.before.solution.estimated[0] * 1e3), float(step.after.solution.estimated[0] * 1e3)


def _words(effects: Sequence[Effect]) -> str:
    return ", ".join(" ".join(filter(None, (e.name, place_of(e)[0]))) for e in effects)


def place_of(effect: Effect) -> tuple[str | None, str | None]:
    """Return the joint on which an effect acts, and its source joint; None for the whole arm."""
    fields = vars(effect)
    return fields.get("joint"), fields.get("source")


def _criticise(fit: Fit, effects: Sequence[Effect], groups: np.ndarray) -> Criticism:
    masses = MassError.of(fit.model, fit.values)
    return criticise(fit, effects, [masses] if masses else [], groups)


def _candidates(fit: Fit, extra: Sequence[Effect], elastic: bool) -> list[Effect]:
    """Return what may be added: what the data can test and the model does not have yet, elasticity first."""
    present = fit.model.effects
    found: list[Effect] = []
    if elastic and not any(isinstance(e, JointElasticity) for e in present):
        found += [JointElasticity(), BearingElasticity()]
    needs_moments = any(isinstance(e, JointElasticity) for e in present)
    for effect in [*_catalogue(fit), *extra]:
        if effect in present or _same(effect, present) or (effect.uses_moments and not (elastic and needs_moments)):
            continue
        found.append(effect)
    return found


def _catalogue(fit: Fit) -> Iterator[Effect]:
    """Return the catalogue's candidates, drive curves coarse and fine."""
    for effect in catalogue_candidates(fit.model.chain, fit.problem.conditions):
        if isinstance(effect, TransmissionError):
            yield from _curves(fit, effect.joint, _FIRST_SIZES)
        else:
            yield effect


def _curves(fit: Fit, joint: str, sizes: Sequence[int]) -> list[TransmissionError]:
    """Return drive curves of one joint, as fine as the number of poses allows."""
    conditions = fit.problem.conditions
    q = conditions.q[:, fit.model.chain.robot.joint_names.index(joint)]
    return [TransmissionError.over(joint, q, size) for size in sizes if size <= len(conditions) // 6]


def _same(effect: Effect, present: Sequence[Effect]) -> bool:
    """Return whether the model has this effect already, perhaps of another size."""
    return any(_key(effect) == _key(other) for other in present)


def _key(effect: Effect) -> tuple[object, ...]:
    return effect.name, *place_of(effect), vars(effect).get("order")


def _generics(fit: Fit, near: str | None) -> list[Effect]:
    """Return terms without a name, those that a name of the catalogue covers left out; near one joint or everywhere."""
    chain, conditions = fit.model.chain, fit.problem.conditions
    names = chain.robot.joint_names
    at = names.index(near) if near in names else None
    places = names if at is None else names[max(at - 1, 0) : at + 2]
    curves = [
        e
        for e in generic_candidates(chain, conditions, size=_CURVE_SIZE)
        if e.joint in places and not (e.acts_on == "drive" and e.depends_on == e.joint)
    ]
    breaks = [b for joint in places for b in broken_candidates(chain, conditions, joint)]
    return [*curves, *(b for b in breaks if b.depends_on == b.joint)]


def _next_step(fit: Fit, groups: np.ndarray, extra: Sequence[Effect], alpha: float, elastic: bool) -> Step | None:
    effects = _candidates(fit, extra, elastic)
    found = _criticise(fit, effects, groups)
    block = [i for i, e in enumerate(effects) if isinstance(e, JointElasticity | BearingElasticity)]
    if block:
        score = found.score(block, 1)
        if score.p_value < _ELASTIC:
            return _accept(fit, [effects[i] for i in block], score, (), found, tuple(block))
    singles = [i for i in range(len(effects)) if i not in block]
    scores = {i: found.score([i], len(singles)) for i in singles}
    n_groups = len({_key(effects[i]) for i in singles})
    best = _best(found, scores, alpha / max(n_groups, 1))
    generic = _generic_step(fit, groups, alpha, None if best is None else (effects[best], scores[best]))
    if generic is not None:
        return generic
    if best is None:
        return None
    equivalent = _equivalents(found, scores, best)
    chosen = effects[best]
    if isinstance(chosen, TransmissionError):
        chosen = _resolved(fit, chosen, groups)
    return _accept(fit, [chosen], scores[best], equivalent, found, (best,))


def _resolved(fit: Fit, curve: TransmissionError, groups: np.ndarray) -> TransmissionError:
    """Return the curve of this joint in the resolution that predicts blocks of poses left out best.

    A resolution that the curve has already stays unless another is better by more than chance.
    """
    curves = _curves(fit, curve.joint, _CURVE_SIZES)
    found = _criticise(fit, curves, groups)
    gains = [found.gains_by_block([i]) for i in range(len(curves))]
    best = int(np.argmax([gain.sum() for gain in gains]))
    if curve in curves:
        more = gains[best] - gains[curves.index(curve)]
        return curves[best] if more.sum() > more.std() * np.sqrt(len(more)) else curve
    return curves[best]


def _sharpen(fit: Fit, steps: list[Step], groups: np.ndarray) -> tuple[Fit, list[Step]]:
    """Choose the resolution of every curve again, once all the others are in: what hid its detail is gone."""
    for curve in [e for e in fit.options.effects if isinstance(e, TransmissionError)]:
        finer = _resolved(without(fit, curve), curve, groups)
        if finer == curve:
            continue
        fit = refit(fit, [finer if e == curve else e for e in fit.options.effects])
        steps = [replace(s, effects=tuple(finer if e == curve else e for e in s.effects)) for s in steps]
        log.info("curve of %s resolved again, %d to %d", curve.joint, curve.size, finer.size)
    return fit, steps


def _best(found: Criticism, scores: dict[int, Score], alpha: float) -> int | None:
    """Return the best candidate that passes both gates; of near equals the one with fewest parameters."""
    passed = [i for i, s in scores.items() if s.p_value < alpha and s.ebic < 0.0]
    passed.sort(key=lambda i: scores[i].ebic)
    for i in passed[:5]:
        if scores[i].gain < min(_GAIN, _SHARE * found.squares):
            continue
        gain, error = found.cross_validated_gain([i])
        if gain <= error:
            continue
        smaller = [
            j
            for j in passed
            if scores[j].rank < scores[i].rank
            and scores[j].ebic - scores[i].ebic < _TIE
            and found.gain_given(i, j).p_value > _ADDS_NOTHING
        ]
        return min(smaller, key=lambda j: (scores[j].rank, scores[j].ebic), default=i)
    return None


def _equivalents(found: Criticism, scores: dict[int, Score], best: int) -> tuple[Effect, ...]:
    """Return the candidates that explain the data as well: nothing is left for the best once one of them is in."""
    rivals = []
    for i, score in scores.items():
        if i == best or score.rank == 0 or _key(found.effects[i]) == _key(found.effects[best]):
            continue
        worse = score.ebic - scores[best].ebic
        if worse < _TIE or (worse < 2.5 * _TIE and found.gain_given(best, i).p_value > _ADDS_NOTHING):
            rivals.append((worse, i))
    unique: dict[tuple[object, ...], Effect] = {}
    for _, i in sorted(rivals):
        unique.setdefault(_key(found.effects[i]), found.effects[i])
    return tuple(unique.values())[:6]


def _generic_step(fit: Fit, groups: np.ndarray, alpha: float, named: tuple[Effect, Score] | None) -> Step | None:
    """Return a step by a term without a name where no name does as well."""
    generics = _generics(fit, None if named is None else place_of(named[0])[0])
    together = [*generics, *([named[0]] if named else [])]
    found = _criticise(fit, together, groups)
    scores = {i: found.score([i], len(generics)) for i in range(len(generics))}
    best = min(scores, key=lambda i: scores[i].ebic)
    if scores[best].p_value > alpha / len(generics) or scores[best].ebic > 0.0:
        return None
    gain, error = found.cross_validated_gain([best])
    if gain <= error:
        return None
    if named is not None:
        last = len(generics)
        if scores[best].ebic > named[1].ebic - _BETTER or found.gain_given(last, best).p_value < _ADDS_NOTHING:
            return None
    return _accept(fit, [generics[best]], scores[best], (), found, (best,))


def _accept(
    fit: Fit,
    effects: Sequence[Effect],
    score: Score,
    equivalent: tuple[Effect, ...],
    found: Criticism,
    index: tuple[int, ...],
) -> Step:
    after = refit(fit, [*fit.options.effects, *effects])
    return Step(tuple(effects), score, equivalent, fit, after, found, index)


def _backward(fit: Fit, steps: list[Step], groups: np.ndarray, alpha: float) -> tuple[Fit, list[Step]]:
    """Take out again what later effects have made needless: suspected by Wald's test, judged by the score test."""
    for step in list(steps):
        if len(steps) == 1 or _is_sure(fit, step):
            continue
        smaller = fit
        for effect in step.effects:
            smaller = without(smaller, effect)
        tested = _criticise(smaller, list(step.effects), groups)
        limit = _ELASTIC if isinstance(step.effects[0], JointElasticity) else alpha / 10.0
        if tested.score(range(len(step.effects)), 1).p_value > limit:
            log.info("dropped %s: what was found later explains it", _words(step.effects))
            fit = refit(fit, smaller.options.effects)
            steps = [s for s in steps if s is not step]
    return fit, steps


def _is_sure(fit: Fit, step: Step) -> bool:
    """Return whether the parameters of a step are far from zero together."""
    names = {p.name for e in step.effects for p in e.parameters(fit.model.chain)}
    place = np.flatnonzero(fit.solution.free)
    among = [j for j, i in enumerate(place) if fit.problem.parameters[i].name in names]
    values = fit.values[place[among]]
    wald = values @ np.linalg.pinv(fit.solution.posterior.covariance[np.ix_(among, among)], hermitian=True) @ values
    return bool(wald > _SURE * len(among))
