"""Backward passes: accepted names are tested again given all others, and for what they leave
unexplained.

The residuals of a fit without one of its effects follow from its own Gram matrices: removing the
effect adds its columns, times their values, to them. So the same tests of all candidates serve
every effect.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial

import numpy as np

from pincal.discover.candidate_tests import (
    Search,
    Tester,
    addable,
    explanation,
    spare_compliances,
    table_of,
    unnamed_given,
    variants,
)
from pincal.discover.curve_numbers import CURVES
from pincal.discover.decisions import (
    CandidateTable,
    Decision,
    Question,
    Row,
    Unfitted,
    accepted,
    each_heading_once,
    enough_errors,
    is_near,
    is_own_curve,
    standard_errors,
)
from pincal.discover.elastic import with_features
from pincal.discover.first_order import ScoreTests
from pincal.discover.levers import missing_from, situation_of
from pincal.discover.policy import Policy
from pincal.discover.score_numbers import TESTING
from pincal.discover.score_tests import GivenNuisances, score_test_given_nuisances
from pincal.discover.steps import SearchState, SearchStep, listed, named_step
from pincal.discover.wave_numbers import WAVES
from pincal.identify.calibrate import Tolerance, refitted_without
from pincal.identify.fit import ModelFit, without
from pincal.model.catalogue.unnamed import nameless_candidates
from pincal.model.effect import Curve, Effect, ExponentialDrift, Family, Harmonic, Resolvable
from pincal.model.evaluated import key_of
from pincal.thresholds import Count

log = logging.getLogger(__name__)

# Effects that are named again together, at most and of a model of how many parameters altogether:
# each has a table with the products of all candidates.
_AT_ONCE: Count = 6
_PARAMETERS: Count = 4000

_Pass = tuple[bool, dict[object, int], ScoreTests]
# An effect, the fit without it, tests against this, and named candidates.
_Without = tuple[Effect, ModelFit, Tester, list[Effect]]


def name_again(state: SearchState, search: Search) -> SearchState:
    """Name each effect again given all others, some of which were not in the model when it was
    named.
    """
    places = [k for k, step in enumerate(state.steps) if not step.is_elastic]
    decisions: Iterator[tuple[ModelFit, Decision | None]] | None = None
    for i, k in enumerate(places if len(places) > 1 else []):
        step = state.steps[k]
        (effect,) = step.effects
        if decisions is None:
            decisions = named_given(
                state.fit, [state.steps[later].effect for later in places[i:]], search
            )
        rest, decision = next(decisions)
        if decision is None:
            continue
        if decision.effect.identity == effect.identity:
            state = _with_rivals(state, step, decision, search)
            continue
        new = named_step(rest, decision, search)
        if _predicts_better(effect, new.effect, rest, search):
            continue
        decisions = None
        if is_near(effect, new.effect, WAVES.close):
            state = state.tuned(step, new)
            continue
        log.info("%s is %s given what was found later", listed([effect]), listed([decision.effect]))
        steps = state.with_replaced(step, replace(new, before=step.before, after=step.after)).steps
        state = state.changed(new.after, steps, (decision.effect,), (effect,))
    return state


def _with_rivals(
    state: SearchState, step: SearchStep, decision: Decision, search: Search
) -> SearchState:
    """Return the search with the rivals of a step that keeps its name."""
    # A rival that has entered since may be removed again.
    rivals = [
        *decision.equivalent,
        *(other for other in step.equivalent if not missing_from(state.fit, [other])),
    ]
    equivalent = each_heading_once(rivals, step.effect, search.policy)
    named = replace(step, equivalent=equivalent, together=decision.together)
    return state.with_replaced(step, named)


def _predicts_better(effect: Effect, other: Effect, rest: ModelFit, search: Search) -> bool:
    """Return whether held-out blocks are predicted better with an effect than with another, given
    the rest.
    """
    tests = score_test_given_nuisances(rest, [effect, other], search.groups)
    gained = tests.gains_by_block([0]) - tests.gains_by_block([1])
    return standard_errors(gained) > TESTING.predicts


def drop_unneeded(state: SearchState, search: Search) -> SearchState:
    """Remove, one by one, steps that do not improve the prediction of held-out blocks given all
    others.

    The loss of the whole model without a step has to exceed its standard error over the blocks, as
    when the step entered, and has to be significant. Elasticity, which every arm has, only needs a
    positive loss; of several steps that fail it is removed last, the others by increasing loss. A
    step that is needed only after another was removed may be that other.
    """
    removed = tuple[Effect, ...]()
    failed = list[SearchStep]()
    while state.steps:
        worth = _worths(state, search)
        for step in [step for step in failed if worth[step] > TESTING.predicts]:
            rivals = [*removed[:1], *step.equivalent]
            equivalent = each_heading_once(rivals, step.effect, search.policy)
            by = replace(step, equivalent=equivalent)
            state = state.with_replaced(step, by)
            worth[by] = worth[step]
        without_it = cache(partial(_refitted_without, state.fit, search))
        failed = [
            step for step in state.steps if _fails(state, step, worth[step], search, without_it)
        ]
        if not failed:
            break
        least = min(failed, key=lambda step: (step.is_elastic, worth[step]))
        log.info(
            "dropped %s: the others predict held-out blocks as well without it",
            listed(least.effects),
        )
        state = state.changed(without_it(least), state.without_step(least).steps, (), least.effects)
        removed = least.effects
        failed = [step for step in failed if step is not least]
    steps = (
        replace(step, equivalent=tuple(missing_from(state.fit, step.equivalent)))
        for step in state.steps
    )
    return replace(state, steps=tuple(steps))


def _refitted_without(fit: ModelFit, search: Search, step: SearchStep) -> ModelFit:
    own = with_features(fit, step.effects)
    # Without compliances other features of bearings may be required.
    until = Tolerance.SETTLED if step.is_elastic else search.until(Tolerance.SETTLED)
    return refitted_without(fit, own, until)


def _fails(
    state: SearchState,
    step: SearchStep,
    worth: float,
    search: Search,
    without_it: Callable[[SearchStep], ModelFit],
) -> bool:
    """Return whether a step would not enter again: judged on a refit of the others if first-order
    tests suspect it.

    First-order tests may be wrong where the others depend on the step, or where products of theirs
    resemble it, such as a compliance times the place of its bearing.
    """
    fit = state.fit
    policy = search.policy
    own = with_features(state.fit, step.effects)
    least = 0.0 if step.is_elastic else max(map(enough_errors, step.effects))
    is_one_of_many = len(state.steps) > 1
    is_rest = _may_be_remainder(state, step)
    # A step that predicts and is far from zero is not tested further.
    predicts = worth > least and not is_rest
    if predicts and (not is_one_of_many or _is_far_from_zero(fit, step, policy)):
        return False
    rest = without_it(step)
    question: Question = "elastic" if step.is_elastic else "stay"
    wider = 1.0 if step.is_elastic else TESTING.wider
    tests = score_test_given_nuisances(rest, own, search.groups, wider=wider)
    every = range(len(own))
    held_out = _held_out(step, tests, worth)
    score = tests.score(every, 1)
    chance = tests.p_value_of_any(every) if is_one_of_many else 0.0
    trials = len({effect.identity for effect in addable(fit, search)}) if is_rest else 1
    row = Row(
        step.effect,
        replace(score, p_value=chance),
        score.ebic,
        every,
        question,
        trials,
        left_out=lambda: held_out,
        enough=least,
    )
    return not accepted(row, policy)


def _held_out(step: SearchStep, tests: ScoreTests, worth: float) -> Unfitted:
    """Return what a step gains on held-out blocks, by first-order tests against a refit of the
    others.

    Elasticity has a loss without it as well, its worth. It is far from zero in some of its many
    parameters only, and others that were fitted without it may extrapolate to blocks by chance.
    """
    gained = standard_errors(tests.gains_by_block(range(len(tests.effects))))
    return Unfitted(max(gained, worth) if step.is_elastic else gained)


def _is_far_from_zero(fit: ModelFit, step: SearchStep, policy: Policy) -> bool:
    """Return whether the parameters of a step differ from zero beyond doubt (Wald's test)."""
    found = fit.estimate.take(fit.names_of(step.effects))
    values = found.values[found.free]
    wald = values @ np.linalg.pinv(found.covariance.dense(), hermitian=True) @ values
    return bool(wald > policy.sure * len(values))


def _may_be_remainder(state: SearchState, step: SearchStep) -> bool:
    """Return whether a name may be the remainder of a stronger unnamed term, whose form is only
    approximate.
    """
    if step.is_elastic or step.effect.is_nameless:
        return False
    others = (
        other
        for other in state.steps
        if other.score.gain > step.score.gain and not other.is_elastic
    )
    return any(
        effect.is_nameless for other in others for effect in (*other.effects, *other.equivalent)
    )


def _worths(state: SearchState, search: Search) -> dict[SearchStep, float]:
    """Return the loss of the model on held-out blocks without each step, in its standard errors."""
    # The priors are those of the fit, as the model itself is judged.
    tests = search.tests_of(state.fit)((), search.groups, wider=1.0)
    found = {}
    # Masses bend the arm only through its compliances, and can't replace them.
    heavy = [
        effect for effect in state.fit.problem.effects if effect.bodies(state.fit.problem.chain)
    ]
    for step in state.steps:
        own = with_features(state.fit, step.effects)
        # The place of a bearing without compliance has no effect either.
        places = [e for e in own if e.locus.acts_on == "place"]
        still = state.fit.names_of([*heavy, *places]) if step.is_elastic else ()
        losses = losses_by_block(tests, set(state.fit.names_of(own)) - set(still), still)
        found[step] = standard_errors(losses)
    return found


def losses_by_block(
    tests: ScoreTests, names: Collection[str], still: Collection[str] = ()
) -> np.ndarray:
    """Return the increase of the squared error on each held-out block without some parameters of a
    model, shape (B,).

    They are set to zero and all others refitted, to first order, without each block, except for
    ``still``, which act only through them and are held fixed.
    """
    j = np.array([i for i, name in enumerate(tests.names) if name in names or name in still], int)
    is_removed = np.array([tests.names[i] in names for i in j], bool)
    units = np.eye(tests.n_model)[:, j]
    losses = np.zeros(len(tests.model.blocks.H))
    for k, (factor, step) in enumerate(tests.model.without_block if len(j) else ()):
        columns = factor.solve(units)
        held = step - columns @ np.linalg.solve(columns[j], step[j] + is_removed * tests.values[j])
        H = tests.model.blocks.H[k]
        g = tests.model.blocks.g[k]
        losses[k] = held @ H @ held - step @ H @ step - 2.0 * g @ (held - step)
    return losses


def named_given(
    fit: ModelFit, effects: Sequence[Effect], search: Search
) -> Iterator[tuple[ModelFit, Decision | None]]:
    """Yield, for each of some effects of a fit, the fit without it and the best explanation of its
    residuals.
    """
    shared = _Shared(search.tests_of(fit))
    rests = [without(fit, effect) for effect in effects]
    tests = [partial(shared.without, effect) for effect in effects]
    # The effect keeps its own time constant; others have those of the catalogue.
    own = ([effect] if isinstance(effect, ExponentialDrift) else [] for effect in effects)
    tried = [[*addable(rest, search), *mine] for rest, mine in zip(rests, own, strict=True)]
    pairs = zip(rests, tried, strict=True)
    spare = [
        effect for rest, some in pairs for effect in spare_compliances(rest, some, search.policy)
    ]
    shared.test([*(effect for some in tried for effect in some), *spare])
    every = list(zip(effects, rests, tests, tried, strict=True))
    at_once = int(np.clip(_PARAMETERS // max(len(fit.values), 1), 1, _AT_ONCE))
    for start in range(0, len(every), at_once):
        del shared.passes[1:]
        yield from _explained(every[start : start + at_once], spare, shared, search)


def _explained(
    some: Sequence[_Without], spare: Sequence[Effect], shared: _Shared, search: Search
) -> Iterator[tuple[ModelFit, Decision | None]]:
    """Yield what :func:`named_given` does of some of its effects; all named candidates are tested
    already.
    """
    tables = list[CandidateTable]()
    others = list[Effect]()
    for effect, rest, test, tried in some:
        # Prediction of held-out blocks is tested when an effect may be removed, not when it is
        # named.
        names = table_of(rest, search, test, tried, predicting=effect)
        tables.append(names)
        close = [names.rows[i].effect for i in names.cheapest()[: search.policy.close]]
        others += [*close, *unnamed_given(rest, [effect, *close], search)]
    shared.test([*others, *spare])
    for (effect, rest, test, _), names in zip(some, tables, strict=True):
        yield rest, explanation(rest, search, test, names, predicting=effect)


@dataclass
class _Shared:
    """Tests against a fit, from which tests against the fit without one of its effects follow."""

    tests: GivenNuisances
    # Candidates tested together: whether by blocks, the index of each candidate, and the tests.
    passes: list[_Pass] = field(default_factory=list)

    def test(self, effects: Iterable[Effect], groups: np.ndarray | None = None) -> _Pass:
        """Test candidates together, equal ones once."""
        once = {key_of(effect): effect for effect in effects}
        number = {key: i for i, key in enumerate(once)}
        self.passes.append((groups is not None, number, self.tests(tuple(once.values()), groups)))
        return self.passes[-1]

    def without(
        self, gone: Effect, effects: Sequence[Effect], groups: np.ndarray | None = None
    ) -> ScoreTests:
        """Return the tests of candidates against the fit without one of its effects."""
        keys = [key_of(effect) for effect in effects]
        has_blocks = groups is not None
        tested = (of for of in self.passes if of[0] == has_blocks and of[1].keys() >= set(keys))
        _, number, tests = next(tested, None) or self.test(effects, groups)
        return tests.among([number[k] for k in keys], self.tests.fit.names_of([gone]))


def judge_remainders(state: SearchState, search: Search) -> SearchState:
    """Test each name that depends on a joint's position for a remaining dependence on it where it
    acts.

    The remainder is one of a few smooth functions, so less of it is significant than in a search
    among all dependences; it has to predict held-out blocks, too. A whole drive curve replaces a
    simple curve that leaves part of it; other remainders are added. A mere hint of either, or a
    curve of which two simple ones of a joint may be parts, is listed as equivalent.
    """
    simple = [step.effect.locus.joint for step in state.steps if is_own_curve(step.effect)]
    for step in [step for step in state.steps if len(step.effects) == 1]:
        curves = _whole_curves(step.effect, state.fit)
        hinted = list[Effect]()
        coarse = curves[: CURVES.forms]
        finer = curves[CURVES.forms :]
        for smooth in (coarse, finer, _smooth_beside(step.effect, state.fit, search)):
            rest = _most_left(smooth, state.fit, search)
            if rest is None:
                continue
            if smooth is finer or not accepted(rest.row, search.policy):
                is_hint = rest.row.score.p_value * len(smooth) < search.policy.hint
                hinted += [rest.effect, *rest.equivalent] if is_hint else []
            elif smooth is coarse:
                state = _with_whole(state, step, rest, search)
                break
            else:
                log.info("%s leaves %s", listed(step.effects), listed([rest.effect]))
                state = state.with_step(named_step(state.fit, rest, search))
        else:
            several = curves[:1] if simple.count(step.effect.locus.joint) > 1 else []
            equivalent = each_heading_once(
                [*several, *step.equivalent, *hinted], step.effect, search.policy
            )
            state = state.with_replaced(step, replace(step, equivalent=equivalent))
    return state


def _with_whole(
    state: SearchState, step: SearchStep, whole: Decision, search: Search
) -> SearchState:
    """Return the state with a simple curve replaced by the whole curve of the drive."""
    rest = refitted_without(state.fit, [step.effect])
    score = score_test_given_nuisances(rest, [whole.effect]).score([0], int(whole.row.among))
    new = named_step(rest, replace(whole, row=replace(whole.row, score=score)), search)
    log.info("%s is part of %s", listed(step.effects), listed(new.effects))
    others = each_heading_once([step.effect, *step.equivalent], new.effect, search.policy)
    by = replace(new, equivalent=others, before=step.before, after=step.after)
    return state.changed(new.after, state.with_replaced(step, by).steps, new.effects, step.effects)


def _whole_curves(effect: Effect, fit: ModelFit) -> list[Effect]:
    """Return the curves of a joint's drive, the coarsest first, of which a simple curve may be
    part.
    """
    own = variants(fit, ("drive",)) if is_own_curve(effect) else ()
    return missing_from(
        fit, (e for e in own if isinstance(e, Curve) and e.locus.joint == effect.locus.joint)
    )


def _most_left(smooth: Sequence[Effect], fit: ModelFit, search: Search) -> Decision | None:
    """Return the function of smallest p-value, significant or not, and its equivalents; None of
    none.
    """
    if not smooth:
        return None

    def left_out(effect: Effect) -> Unfitted:
        return Unfitted(standard_errors(test([effect], search.groups).gains_by_block([0])))

    test = search.tests_of(fit)
    tests = test(smooth)
    count = len(smooth)
    scores = [tests.score([i], count) for i in range(count)]
    rows = [
        Row(
            effect,
            score,
            score.ebic,
            (i,),
            "rest",
            count,
            left_out=partial(left_out, effect),
            enough=0.0,
        )
        for i, (effect, score) in enumerate(zip(smooth, scores, strict=True))
    ]
    best = int(np.argmin([score.p_value for score in scores]))
    others = CandidateTable(rows, tests).rivals(best, search.policy)
    return Decision(rows[best], each_heading_once(others, smooth[best], search.policy))


def _smooth_beside(effect: Effect, fit: ModelFit, search: Search) -> Sequence[Effect]:
    """Return unnamed waves and curves of the position on which an effect depends, on its joint or
    that position's joint.
    """
    at = effect.locus
    chain = fit.problem.chain
    if not _follows_a_position(effect, fit) or isinstance(effect, Harmonic):
        return ()
    joints = [name for name in chain.robot.joint_names if name in (at.joint, at.follows)]
    every = search.taking_part(
        missing_from(fit, nameless_candidates(chain, fit.problem.conditions, joints))
    )
    return [e for e in every if (e.locus.order or e.locus.span) and e.locus.follows == at.follows]


def _follows_a_position(effect: Effect, fit: ModelFit) -> bool:
    """Return whether a named effect acts on one joint and depends on a joint's position."""
    at = effect.locus
    return (
        effect.family is Family.CAUSE
        and at.joint is not None
        and at.follows in fit.problem.chain.robot.joint_names
    )


def merge_parts(state: SearchState, search: Search) -> SearchState:
    """Merge a name and an unnamed term of the same variable in the same place into one unnamed
    effect.

    A name that leaves part of its own variable unexplained where it acts is only the nearest one in
    the catalogue.
    """
    for rest in [step for step in state.steps if step.effect.is_nameless]:
        part = next(
            (
                s
                for s in state.steps
                if s is not rest and _is_part(s.effect, rest.effect, state.fit)
            ),
            None,
        )
        if part is None:
            continue
        before, after = sorted((part, rest), key=state.steps.index)
        equivalent = [*rest.equivalent, part.effect, *part.equivalent]
        whole = replace(
            before,
            effects=(rest.effect, *part.effects),
            equivalent=each_heading_once(equivalent, rest.effect, search.policy),
            after=before.after,
        )
        state = state.with_replaced(before, whole).without_step(after)
    return state


def _is_part(effect: Effect, nameless: Effect, fit: ModelFit) -> bool:
    """Return whether a name depends on the same variable, on the same or a neighbouring joint, as
    an unnamed term.
    """
    at = effect.locus
    term = nameless.locus
    names = fit.problem.chain.robot.joint_names
    if (
        not _follows_a_position(effect, fit)
        or isinstance(effect, Harmonic)
        or at.joint is None
        or term.joint is None
    ):
        return False  # Waves of high order are not part of a smooth function.
    if isinstance(nameless, Resolvable) and nameless.resolutions(situation_of(fit)):
        # A map is also a function of its own joint's position.
        return {term.joint, term.follows} >= {at.joint, at.follows}
    apart = abs(names.index(term.joint) - names.index(at.joint))
    return apart <= 1 and term.follows == at.follows
