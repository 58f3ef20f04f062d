"""Fit, score_test, name, extend, refit, verify: until nothing that the data demand is missing."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pincal.discover.nuisance import score_test_beside_masses, situation_of
from pincal.discover.resolution import curves_over, refined, resolved
from pincal.discover.score_tests import Score, ScoreTests
from pincal.identify.calibrate import refit
from pincal.identify.fit import Fit, without
from pincal.identify.problem import Problem
from pincal.model.catalogue.candidates import elasticity, testable
from pincal.model.catalogue.unnamed import nameless_candidates
from pincal.model.effect import Curve, Effect, Family

log = logging.getLogger(__name__)

# Chance, per step, that sound data bring in any name at all.
ALPHA = 0.005
# Elasticity is what every arm has, so little evidence brings it in; it is judged again at the end.
_ELASTIC = 1e-4
# Differences of the information criterion below this do not tell effects apart (odds of 20 to 1).
_TIE = 6.0
# A term without a name has to be better than a name by this much to take its place.
_BETTER = 6.0
# What acts across a joint's axis has to be better than what acts about one by this much.
_PLAINER = 2.0
# Chance below which a simple curve of a joint's position may well be part of a finer one.
_HINT = 0.3
# Names that take part when the nameless are tried.
_CLOSE = 12
# Chance above which an effect adds nothing to another.
_ADDS_NOTHING = 1e-3
# Chance below which an effect adds something even to another that is as cheap.
_TOLD_APART = 1e-5
# Wald statistic a parameter above which an effect need not be judged again.
_SURE = 12.0
_MOST_STEPS = 14
_MOST_RIVALS = 6
# An effect that takes less off the squares than this share, and less than this many, matters to nobody.
_SHARE, _GAIN = 0.01, 100.0
# Readings from which effects are chosen and fitted; in the end all fit them, and resolve their curves. What takes 100 off
# the squares of more readings than these still takes enough off theirs.
_ENOUGH = 12000


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
    criticism: ScoreTests
    index: tuple[int, ...]


@dataclass(frozen=True)
class History:
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
    last: ScoreTests


def discover_effects(
    fit: Fit, groups: np.ndarray, *, extra: Sequence[Effect] = (), alpha: float = ALPHA, elastic: bool = True
) -> History:
    """Find the effects that a fit misses.

    Args:
        fit: the model to start from, usually the geometric one.
        groups: shape (N,), blocks of training rows for cross-validation.
        extra: effects of the user's own, which take part like those of the catalogue.
        alpha: chance of a false name a step.
        elastic: whether elasticity may be found; not for an arm without masses.
    """
    first, steps, all_groups = fit, list[Step](), groups
    fit, rows = sampled(fit)
    groups = all_groups[rows]
    for _ in range(_MOST_STEPS):
        step = _next_step(fit, groups, extra, alpha, elastic)
        if step is None:
            break
        log.info("found %s: residual %.4f -> %.4f mm", _words(step.effects), *_noise_of(step))
        steps.append(step)
        fit = step.after
    fit, steps = _revised(fit, steps, groups, lambda f: _choose(f, groups, extra, alpha, elastic))
    fit, steps = _backward(fit, steps, groups, alpha)
    fit, steps = _finished(fit, steps, first, all_groups)
    steps = _with_whole_curves(fit, _merged(fit, steps))
    last = score_test_beside_masses(sampled(fit)[0], groups, _candidates(fit, extra, elastic))
    return History(first, tuple(steps), fit, last)


def _noise_of(step: Step) -> tuple[float, float]:
    return float(step.before.solution.estimated[0] * 1e3), float(step.after.solution.estimated[0] * 1e3)


def _words(effects: Sequence[Effect]) -> str:
    return ", ".join(" ".join(filter(None, e.heading[:2])) for e in effects)


def sampled(fit: Fit) -> tuple[Fit, np.ndarray]:
    """Return a fit on as many of its rows, evenly spread, as are enough to choose what comes next, and these rows."""
    n, most = len(fit.station), _ENOUGH // sum(block.size for block in fit.station.sensor.blocks)
    if n <= most:
        return fit, np.arange(n)
    rows = np.linspace(0, n - 1, most).astype(int)
    solution = replace(fit.solution, weights=fit.solution.weights[rows])
    return replace(fit, problem=fit.problem.select(rows), solution=solution), rows


def _candidates(fit: Fit, extra: Sequence[Effect], elastic: bool) -> list[Effect]:
    """Return what may be added: what the data can test and the model does not have yet."""
    present = fit.model.effects
    found: list[Effect] = []
    has_elasticity = has_compliance(present)
    for effect in [*_catalogue(fit), *extra]:
        if effect in present or _same(effect, present) or (effect.is_of_loads and not (elastic and has_elasticity)):
            continue
        found.append(effect)
    return found


def has_compliance(effects: Sequence[Effect]) -> bool:
    """Return whether linear elasticity is among effects."""
    return any(effect.family is Family.ELASTICITY for effect in effects)


def _catalogue(fit: Fit) -> Iterator[Effect]:
    """Return the candidates, each in the variants that are worth telling apart."""
    for candidate in testable(situation_of(fit)):
        yield from candidate.forms


def _same(effect: Effect, present: Sequence[Effect]) -> bool:
    """Return whether the model has this effect already, perhaps of another size."""
    return any(effect.identity == other.identity for other in present)


def _generics(fit: Fit, near: str | None) -> list[Effect]:
    """Return terms without a name that the model does not have; near one joint or everywhere."""
    names = fit.model.chain.robot.joint_names
    at = names.index(near) if near in names else None
    joints = names if at is None else names[max(at - 1, 0) : at + 2]
    present = fit.model.effects
    every = nameless_candidates(fit.model.chain, fit.station.conditions, joints)
    return [e for e in every if not _same(e, present)]


def _next_step(fit: Fit, groups: np.ndarray, extra: Sequence[Effect], alpha: float, elastic: bool) -> Step | None:
    if elastic and not has_compliance(fit.model.effects):
        block = elasticity(situation_of(fit))
        found = score_test_beside_masses(fit, groups, block)
        score = found.score(range(len(block)), 1)
        if score.p_value < _ELASTIC:
            return _accept(fit, block, _Choice(block[0], score, (), found, tuple(range(len(block)))))
    choice = _choose(fit, groups, extra, alpha, elastic)
    if choice is None:
        return None
    effect = choice.effect
    return _accept(fit, [resolved(fit, effect, groups) if isinstance(effect, Curve) else effect], choice)


@dataclass(frozen=True)
class _Choice:
    """The effect that explains most for what it costs, and what can't be told from it; see :class:`Step`."""

    effect: Effect
    score: Score
    equivalent: tuple[Effect, ...]
    criticism: ScoreTests
    index: tuple[int, ...]


@dataclass(frozen=True)
class _CandidateTable:
    """Candidates against one fit, each with its test and what it costs to believe it.

    Attributes:
        found: tests of all candidates.
        scores: of each.
        costs: of each; the information criterion, more for what has no name.
        limits: the p-value that each has to stay below.
        least: the gain below which an effect matters to nobody.
    """

    found: ScoreTests
    scores: list[Score]
    costs: np.ndarray
    limits: np.ndarray
    least: float

    @classmethod
    def of(cls, fit: Fit, effects: Sequence[Effect], groups: np.ndarray, alpha: float) -> _CandidateTable:
        """Test candidates, named and nameless ones; each kind shares the chance of a false name."""
        found = score_test_beside_masses(fit, groups, effects)
        nameless = np.array([e.is_nameless for e in effects], bool)
        n = {kind: len({e.identity for e in effects if e.is_nameless == kind}) for kind in (False, True)}
        scores = [found.score([i], n[bool(no)]) for i, no in enumerate(nameless)]
        return cls(
            found,
            scores,
            np.array([score.ebic + _surcharge(e) for score, e in zip(scores, effects, strict=True)]),
            np.array([alpha / n[bool(no)] for no in nameless]),
            least_gain(found.squares, declared=fit.noise.declared[0] is not None),
        )

    def passed(self) -> list[int]:
        """Return the candidates that chance does not explain, the cheapest first."""
        order = np.argsort(self.costs)
        scores = self.scores
        return [int(i) for i in order if scores[i].p_value < self.limits[i] and scores[i].gain >= self.least]

    def rivals(self, best: int) -> list[int]:
        """Return the candidates that explain the data as well: little is left for the best once one of them is in."""
        worse = self.costs - self.costs[best]
        close = [int(i) for i in np.argsort(worse) if i != best and self.scores[i].rank and worse[i] < 2.5 * _TIE]
        return [
            i for i in close if self.found.gain_given(best, i).p_value > (_TOLD_APART if worse[i] < _TIE else _ADDS_NOTHING)
        ]


def least_gain(squares: float, *, declared: bool) -> float:
    """Return what an effect has to take off a sum of squares to matter, both in units of the noise.

    Where the noise is not declared, what is left may be other than noise, and anything takes a little off it.
    """
    return min(_GAIN, (1.0 if declared else 2.0) * _SHARE * squares)


def _surcharge(effect: Effect) -> float:
    """Return by how much an effect has to be better than a name of the catalogue."""
    if not effect.is_nameless:
        return 0.0
    # What turns a joint across its axis often turns a neighbour about its own, which is the plainer of the two.
    return _BETTER if effect.locus.acts_on == "drive" else _BETTER + _PLAINER


def _choose(fit: Fit, groups: np.ndarray, extra: Sequence[Effect], alpha: float, elastic: bool) -> _Choice | None:
    """Return the best explanation of what a fit leaves, if it is more than chance."""
    names = _CandidateTable.of(fit, _candidates(fit, extra, elastic), groups, alpha)
    best = next((i for i in names.passed()[:5] if _predicts(names.found, i)), None)
    curve = None if best is None else _promoted(names, best)
    near = None if best is None else names.found.effects[best].locus.joint
    close = [] if best is None else [best, *(i for i in np.argsort(names.costs)[:_CLOSE] if i != best)]
    together = [*(names.found.effects[i] for i in close), *_generics(fit, near)]
    both = _CandidateTable.of(fit, together, np.zeros_like(groups), alpha)
    # Names are as costly as among all names.
    both.costs[: len(close)] = names.costs[close]
    nameless = next((i for i in both.passed() if i >= len(close)), None)
    better = nameless is not None and (best is None or both.costs[nameless] < both.costs[0])
    if nameless is not None and better and _predicts(score_test_beside_masses(fit, groups, [together[nameless]]), 0):
        whole = _also_curve(together[nameless], names)
        return _chosen(both, nameless, whole if best is None else (*whole, *_also_curve(together[0], names, best)))
    if best is None:
        return None
    if curve is not None:
        return _chosen(names, curve, ())
    others = [together[i] for i in both.rivals(0) if i >= len(close)]
    return _chosen(names, best, (*others, *_also_curve(names.found.effects[best], names, best)))


def _finished(fit: Fit, steps: list[Step], first: Fit, groups: np.ndarray) -> tuple[Fit, list[Step]]:
    """Fit all rows of the first fit, and every curve that was found as fine as they and all the others let it be."""
    thinned = len(fit.station) < len(first.station)
    if thinned:
        solution = replace(fit.solution, weights=first.solution.weights)
        whole = replace(fit, problem=Problem((first.station.with_model(fit.model),)), solution=solution)
        wider = {curve: curves_over(whole, curve, [curve.resolution])[0] for curve in _curves_of(steps)}
        fit, steps = refit(whole, _exchanged(fit.options.effects, wider), rough=True), _with_curves(steps, wider)
    chosen = {curve: refined(without(fit, curve), curve, groups) for curve in _curves_of(steps)}
    finer = {curve: other for curve, other in chosen.items() if other != curve}
    if finer:
        pairs = (f"{c.locus.joint} {c.resolution} to {other.resolution}" for c, other in finer.items())
        log.info("resolved again: %s", ", ".join(pairs))
    elif not thinned:
        return fit, steps
    bare = fit
    for curve in finer:
        # The heights of other splines are no start for these.
        bare = without(bare, curve)
    return refit(bare, _exchanged(fit.options.effects, finer)), _with_curves(steps, finer)


def _curves_of(steps: Sequence[Step]) -> list[Curve]:
    """Return the curves that were found; those that the user gave stay as they are."""
    return [e for step in steps for e in step.effects if isinstance(e, Curve)]


def _exchanged(effects: Sequence[Effect], by: dict[Curve, Curve]) -> tuple[Effect, ...]:
    return tuple(by.get(e, e) if isinstance(e, Curve) else e for e in effects)


def _with_curves(steps: Sequence[Step], by: dict[Curve, Curve]) -> list[Step]:
    return [replace(step, effects=_exchanged(step.effects, by)) for step in steps]


def _predicts(found: ScoreTests, i: int) -> bool:
    """Return whether a candidate improves the prediction of blocks left out by more than chance."""
    gain, error = found.cross_validated_gain([i])
    return gain > error


def _chosen(contest: _CandidateTable, best: int, others: Sequence[Effect]) -> _Choice:
    """Return a choice with its rivals, each name once."""
    effects = contest.found.effects
    rivals = _each_name_once([*(effects[i] for i in contest.rivals(best)), *others], effects[best])
    return _Choice(effects[best], contest.scores[best], rivals, contest.found, (best,))


def _each_name_once(effects: Sequence[Effect], best: Effect) -> tuple[Effect, ...]:
    """Return effects without those that a report would call the same as an earlier one or as the best."""
    names: dict[tuple[object, ...], Effect] = {}
    for effect in effects:
        names.setdefault(effect.heading, effect)
    names.pop(best.heading, None)
    return tuple(names.values())[:_MOST_RIVALS]


def _is_own_curve(effect: Effect) -> bool:
    """Return whether an effect is a simple curve of the joint's own position, about its own axis."""
    at = effect.locus
    is_about_axis = at.acts_on in ("drive", "gamma_z")
    return is_about_axis and at.joint is not None and at.follows == at.joint and not isinstance(effect, Curve)


def _curves_like(effect: Effect, names: _CandidateTable) -> list[int]:
    """Return the drive curves of the same joint as a simple one."""
    return [i for i, e in enumerate(names.found.effects) if isinstance(e, Curve) and e.locus.joint == effect.locus.joint]


def _beyond(names: _CandidateTable, best: int) -> tuple[float, int]:
    """Return the chance that some simple curve of the joint's position is all of the curve, and the drive curve."""
    effect = names.found.effects[best]
    if not _is_own_curve(effect):
        return 1.0, -1
    simple = [best] + [
        i
        for i, e in enumerate(names.found.effects)
        if _is_own_curve(e) and e.locus.joint == effect.locus.joint and names.costs[i] < names.costs[best] + 2.5 * _TIE
    ]
    curves = _curves_like(effect, names)
    chances = [(max(names.found.gain_given(i, j).p_value for j in simple) * len(curves), i) for i in curves]
    return min(chances, default=(1.0, -1))


def _promoted(names: _CandidateTable, best: int) -> int | None:
    """Return the drive curve of which the simple names are only a part, unless a second name explains the rest as well."""
    chance, curve = _beyond(names, best)
    if chance > _ADDS_NOTHING:
        return None
    n = len(names.scores)
    pairs = [
        names.found.judge(*names.found.gain([best, i]), n).ebic
        for i in range(n)
        if i != best and not isinstance(names.found.effects[i], Curve)
    ]
    return curve if names.costs[curve] < min(pairs, default=np.inf) else None


def _also_curve(effect: Effect, names: _CandidateTable, best: int | None = None) -> tuple[Effect, ...]:
    """Return the drive curve that a simple curve of the joint's position may be a part of."""
    if best is not None:
        chance, curve = _beyond(names, best)
        return (names.found.effects[curve],) if chance < _HINT else ()
    curves = _curves_like(effect, names) if _is_own_curve(effect) else []
    return (names.found.effects[curves[0]],) if curves else ()


def _accept(fit: Fit, effects: Sequence[Effect], choice: _Choice) -> Step:
    after = refit(fit, [*fit.options.effects, *effects])
    return Step(tuple(effects), choice.score, choice.equivalent, fit, after, choice.criticism, choice.index)


def _revised(
    fit: Fit, steps: list[Step], groups: np.ndarray, choose: Callable[[Fit], _Choice | None]
) -> tuple[Fit, list[Step]]:
    """Name each effect once more beside all the others, which were not there when it was named."""
    named = [s for s in steps if s.effects[0].family is not Family.ELASTICITY]
    for step in named if len(named) > 1 else []:
        (effect,) = step.effects
        rest = without(fit, effect)
        choice = choose(rest)
        if choice is None:
            continue
        if choice.effect.identity == effect.identity:
            new = replace(step, equivalent=choice.equivalent)
        else:
            log.info("%s is %s beside what was found later", _words([effect]), _words([choice.effect]))
            other = choice.effect
            other = resolved(rest, other, groups) if isinstance(other, Curve) else other
            new = replace(_accept(rest, [other], choice), before=step.before)
            fit = new.after
        steps = [new if s is step else s for s in steps]
    return fit, steps


def _merged(fit: Fit, steps: list[Step]) -> list[Step]:
    """Take a name and a term without one that follow the same variable in the same place as one effect without a name.

    A name that leaves something of its own variable unexplained where it acts is only the nearest that the catalogue has.
    """
    for rest in [s for s in steps if s.effects[0].is_nameless]:
        part = next((s for s in steps if s is not rest and _is_part(s.effects[0], rest, fit)), None)
        if part is None:
            continue
        before, after = sorted((part, rest), key=steps.index)
        whole = replace(
            before,
            effects=(rest.effects[0], *part.effects),
            equivalent=_each_name_once([*rest.equivalent, part.effects[0], *part.equivalent], rest.effects[0]),
            after=after.after,
        )
        steps = [whole if s is before else s for s in steps if s is not after]
    return steps


def _with_whole_curves(fit: Fit, steps: list[Step]) -> list[Step]:
    """Add, to two simple curves of one joint's position, that together they may be one irregular one."""
    simple = [s.effects[0].locus.joint for s in steps if _is_own_curve(s.effects[0])]
    curves = {e.locus.joint: e for e in reversed(list(_catalogue(fit))) if isinstance(e, Curve)}
    out = []
    for step in steps:
        effect = step.effects[0]
        joint = effect.locus.joint
        if _is_own_curve(effect) and simple.count(joint) > 1 and joint in curves:
            step = replace(step, equivalent=_each_name_once([curves[joint], *step.equivalent], effect))
        out.append(step)
    return out


def _is_part(effect: Effect, rest: Step, fit: Fit) -> bool:
    """Return whether an effect follows the same variable, on the same joint or a neighbour, as a term without a name."""
    term, names = rest.effects[0].locus, fit.model.chain.robot.joint_names
    at = effect.locus
    if effect.family is not Family.CAUSE or at.joint is None or term.joint is None or at.follows not in names:
        return False
    apart = abs(names.index(term.joint) - names.index(at.joint))
    return bool(apart <= 1 and term.follows == at.follows)


def _backward(fit: Fit, steps: list[Step], groups: np.ndarray, alpha: float) -> tuple[Fit, list[Step]]:
    """Take out again what later effects have made needless: suspected by Wald's test, judged by the score test."""
    for step in list(steps):
        if len(steps) == 1 or _is_sure(fit, step):
            continue
        smaller = fit
        for effect in step.effects:
            smaller = without(smaller, effect)
        tested = score_test_beside_masses(smaller, groups, list(step.effects))
        limit = _ELASTIC if step.effects[0].family is Family.ELASTICITY else alpha / 10.0
        if tested.score(range(len(step.effects)), 1).p_value > limit:
            log.info("dropped %s: what was found later explains it", _words(step.effects))
            fit = refit(fit, smaller.options.effects)
            steps = [s for s in steps if s is not step]
    return fit, steps


def _is_sure(fit: Fit, step: Step) -> bool:
    """Return whether the parameters of a step are far from zero together."""
    names = {p.name for e in step.effects for p in e.parameters(fit.model.chain)}
    place = np.flatnonzero(fit.solution.free)
    among = [j for j, i in enumerate(place) if fit.station.parameters[i].name in names]
    values = fit.values[place[among]]
    wald = values @ np.linalg.pinv(fit.solution.posterior.covariance[np.ix_(among, among)], hermitian=True) @ values
    return bool(wald > _SURE * len(among))
