"""What names leave over: whether a name is all that happens where it acts, or only the nearest that the catalogue has."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pincal.discover.candidate_tests import Search
from pincal.discover.decisions import Decision, Row, each_heading_once, is_own_curve, rivals_of
from pincal.discover.forward import decided, listed
from pincal.discover.history import State
from pincal.discover.nuisance import score_test_beside_nuisances, situation_of
from pincal.discover.resolution import curves_over
from pincal.discover.score_tests import standard_errors
from pincal.identify.fit import Fit, without
from pincal.model.catalogue.unnamed import nameless_candidates
from pincal.model.effect import Curve, Effect, Family, Resolvable, Tone

log = logging.getLogger(__name__)

# Pieces of a whole curve over those of the coarsest.
_FINER = (1.0, 1.5, 2.25)


def add_remainders(state: State, search: Search) -> State:
    """Add, beside each name that follows a joint's position, the wave or curve of this position that it leaves there.

    What a name leaves of its own variable in its own place is one of a few smooth functions, so that far less of it is more
    than chance than in a search among all dependences. It has to predict blocks left out, too. Where there is but a hint of
    it, it is told as what the name may be part of.
    """
    for step in state.steps:
        smooth = _smooth_beside(step.effect, state.fit, search) if len(step.effects) == 1 else ()
        rest = _most_left(smooth, state.fit, search)
        if rest is None:
            continue
        if _is_sure(rest, state.fit, search):
            log.info("%s leaves %s", listed(step.effects), listed([rest.effect]))
            state = state.with_step(decided(state.fit, rest, search))
        elif rest.row.score.p_value * len(smooth) < search.policy.hint:
            others = each_heading_once([*step.equivalent, rest.effect, *rest.equivalent], step.effect, search.policy)
            state = state.with_replaced(step, replace(step, equivalent=others))
    return state


def take_whole_curves(state: State, search: Search) -> State:
    """Take the whole curve of a joint's drive in the place of a simple one that leaves some of it.

    Where both explain the data the simple one was chosen, and the curve stands beside it as equivalent.
    """
    for step in state.steps:
        curve = next((effect for effect in step.equivalent if isinstance(effect, Curve)), None)
        if curve is None or len(step.effects) > 1 or not is_own_curve(step.effect):
            continue
        sizes = [round(curve.resolution * finer) for finer in _FINER]
        decision = _most_left(curves_over(state.fit, curve, sizes), state.fit, search)
        if decision is None or not _is_sure(decision, state.fit, search):
            continue
        rest = without(state.fit, step.effect)
        score = score_test_beside_nuisances(rest, [decision.effect]).score([0], len(sizes))
        new = decided(rest, replace(decision, row=replace(decision.row, score=score)), search)
        log.info("%s is part of %s", listed(step.effects), listed(new.effects))
        others = each_heading_once([step.effect, *step.equivalent], new.effect, search.policy)
        whole = replace(new, equivalent=others, before=step.before, after=step.after)
        state = state.changed(new.after, state.with_replaced(step, whole).steps, new.effects, step.effects)
    return state


def _most_left(smooth: Sequence[Effect], fit: Fit, search: Search) -> Decision | None:
    """Return what explains most of what a fit leaves, chance or not, and what explains as much; None of nothing."""
    if not smooth:
        return None
    tests, limit = score_test_beside_nuisances(fit, smooth), search.policy.remainder / len(smooth)
    scores = [tests.score([i], len(smooth)) for i in range(len(smooth))]
    rows = [Row(effect, score, score.ebic, limit) for effect, score in zip(smooth, scores, strict=True)]
    best = int(np.argmin([score.p_value for score in scores]))

    def left_given(i: int, given: int) -> float:
        return tests.score_given([i], [given]).p_value

    others = rivals_of(rows, best, left_given, search.policy)
    return Decision(rows[best], each_heading_once(others, smooth[best], search.policy))


def _is_sure(decision: Decision, fit: Fit, search: Search) -> bool:
    """Return whether what a fit leaves is more than chance, and helps to predict blocks left out."""
    if decision.row.score.p_value > decision.row.limit:
        return False
    return standard_errors(score_test_beside_nuisances(fit, [decision.effect], search.groups).gains_by_block([0])) > 0.0


def _smooth_beside(effect: Effect, fit: Fit, search: Search) -> Sequence[Effect]:
    """Return waves and curves without a name of the position that an effect follows, on its joint or on that joint."""
    at, chain = effect.locus, fit.problem.chain
    if not _follows_a_position(effect, fit) or isinstance(effect, Tone):
        return ()
    joints = [name for name in chain.robot.joint_names if name in (at.joint, at.follows)]
    present = {other.identity for other in fit.problem.effects}
    return [
        other
        for other in nameless_candidates(chain, fit.problem.conditions, joints)
        if (other.locus.order or other.locus.span)
        and other.locus.follows == at.follows
        and other.identity not in present
        and (search.nameless is None or other.identity in search.nameless)
    ]


def _follows_a_position(effect: Effect, fit: Fit) -> bool:
    """Return whether an effect with a name acts on one joint by the position of a joint."""
    at = effect.locus
    return effect.family is Family.CAUSE and at.joint is not None and at.follows in fit.problem.chain.robot.joint_names


def merge_parts(state: State, search: Search) -> State:
    """Take a name and a term without one that follow the same variable in the same place as one effect without a name.

    A name that leaves something of its own variable unexplained where it acts is only the nearest that the catalogue has.
    """
    for rest in [step for step in state.steps if step.effect.is_nameless]:
        part = next((s for s in state.steps if s is not rest and _is_part(s.effect, rest.effect, state.fit)), None)
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


def _is_part(effect: Effect, nameless: Effect, fit: Fit) -> bool:
    """Return whether a name follows the same variable, on the same joint or a neighbour, as a term without a name."""
    at, term, names = effect.locus, nameless.locus, fit.problem.chain.robot.joint_names
    if not _follows_a_position(effect, fit) or isinstance(effect, Tone) or at.joint is None or term.joint is None:
        return False  # Waves many a turn are no part of a smooth function.
    if isinstance(nameless, Resolvable) and nameless.resolutions(situation_of(fit)):
        # A map is a function of its own joint's position as well.
        return {term.joint, term.follows} >= {at.joint, at.follows}
    apart = abs(names.index(term.joint) - names.index(at.joint))
    return apart <= 1 and term.follows == at.follows
