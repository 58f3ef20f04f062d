"""Decisions: which effect explains the residuals of a model, and whether a name is accepted.
Neither fits nor data here.

Every pass of a search calls :func:`accepted`. The thresholds are in ``policy.py``, the tests in
``first_order.py``; docs/criteria.md derives them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import fdtri

from pincal.discover.first_order import ScoreResult, ScoreTests
from pincal.discover.policy import Policy
from pincal.discover.score_numbers import TESTING
from pincal.model.effect import Curve, Effect, Harmonic

Question = Literal["enter", "elastic", "stay", "rest"]
"""What is tested: whether a name enters, an arm is compliant, a name stays, or is the remainder of
another.
"""


class Unfitted(NamedTuple):
    """Evidence of held-out blocks of poses on a candidate.

    Attributes:
        errors: improvement of their prediction, in standard errors.
        p_value: of the test for noise that differs between visits of poses; default: not tested.
    """

    errors: float
    p_value: Callable[[], float] | None = None


@dataclass(frozen=True)
class Row:
    """One candidate, its test, and further evidence.

    Attributes:
        effect: the candidate.
        score: its test.
        cost: extended Bayesian information criterion, plus a surcharge if unnamed; negative is
            better than nothing.
        which: the effects that it consists of, by index among the tested ones.
        question: what is tested.
        among: number of candidates that share the probability of a false name.
        least: smallest relevant reduction of the squares.
        evidence: log Bayes factor in favour of it; inf where rows are many.
        left_out: returns the evidence of held-out blocks; default: not required.
        enough: required improvement of these, in standard errors.
        chance: p-value that counts, of a test of more than the candidate; default: its score's.
    """

    effect: Effect
    score: ScoreResult
    cost: float
    which: Sequence[int] = ()
    question: Question = "enter"
    among: float = 1.0
    least: float = 0.0
    evidence: float = np.inf
    left_out: Callable[[], Unfitted] | None = None
    enough: float = TESTING.predicts
    chance: float | None = None

    @property
    def p_value(self) -> float:
        """The p-value that counts."""
        return self.score.p_value if self.chance is None else self.chance


def allowed_chance(question: Question, among: float, policy: Policy) -> float:
    """Return the limit on the p-value of one of several candidates."""
    chances = {
        "enter": policy.false_name,
        "elastic": policy.elastic,
        "stay": policy.drop * policy.false_name,
        "rest": policy.remainder,
    }
    return chances[question] / among


def is_more_than_chance(row: Row, policy: Policy) -> bool:
    """Return whether a candidate is significant, relevant, and not contradicted by priors, on the
    fitted rows.
    """
    return row.p_value < allowed_chance(row.question, row.among, policy) and is_supported(
        row, policy
    )


def is_supported(row: Row, policy: Policy) -> bool:
    """Return whether a candidate is relevant and not contradicted by priors; all that is asked
    where evidence, and no p-value, decides.
    """
    limit = allowed_chance(row.question, row.among, policy)
    return row.score.gain >= row.least and row.evidence >= -np.log(limit)


def critical_gain(dof: float, rank: int, among: float, policy: Policy) -> float:
    """Return the smallest reduction of the sum of squares, in units of a declared noise, with which
    a name enters: what :func:`is_more_than_chance` asks of a test with these degrees of freedom.

    Args:
        dof: residual degrees of freedom, by which the noise is estimated.
        rank: number of observable directions of the candidate.
        among: number of candidates that share the probability of a false name.
        policy: with the thresholds.
    """
    rest = max(dof - rank, 1.0)
    limit = allowed_chance("enter", max(among, 1.0), policy)
    ratio = rank * float(fdtri(rank, rest, 1.0 - limit)) / rest
    return max(ratio / (1.0 + ratio) * dof, policy.least_gain(dof, declared=True))


def accepted(row: Row, policy: Policy) -> bool:
    """Return whether a name is accepted.

    It has to be significant (F test) and relevant, not contradicted by the prior on its size (Bayes
    factor, on few rows), and to significantly improve the prediction of held-out blocks
    (cross-validation), also with uneven noise.
    """
    if not is_more_than_chance(row, policy):
        return False
    if row.left_out is None:
        return True
    held_out = row.left_out()
    limit = allowed_chance(row.question, row.among, policy)
    return held_out.errors > row.enough and (held_out.p_value is None or held_out.p_value() < limit)


@dataclass(frozen=True)
class CandidateTable:
    """Candidates tested against one fit."""

    rows: Sequence[Row]
    tests: ScoreTests

    def p_value_given(self, rows: Sequence[int], given: Sequence[int]) -> float:
        """Return the p-value of some candidates together, given others in the model."""
        which, others = ([k for i in of for k in self.rows[i].which] for of in (rows, given))
        return self.tests.score_given(which, others).p_value

    def cheapest(self) -> list[int]:
        """Return the indices of all candidates, the cheapest first."""
        return [int(i) for i in np.argsort([row.cost for row in self.rows])]

    def passed(self, policy: Policy) -> list[int]:
        """Return the indices of significant candidates, the cheapest first."""
        return [i for i in self.cheapest() if is_more_than_chance(self.rows[i], policy)]

    def rivals(self, best: int, policy: Policy) -> list[Effect]:
        """Return the candidates that explain the data as well: the best adds little to
        one of them.
        """
        costs = np.array([row.cost for row in self.rows]) - self.rows[best].cost
        close = [
            i
            for i in self.cheapest()
            if i != best and self.rows[i].score.rank and costs[i] < policy.near_tie
        ]
        chances = self.tests.chances_given_each(
            self.rows[best].which, [self.rows[i].which for i in close]
        )
        limits = np.where(costs[close] < policy.tie, policy.told_apart, policy.adds_nothing)
        return [self.rows[i].effect for i in np.array(close, int)[chances > limits]]

    def parts(self, whole: int, policy: Policy) -> list[int]:
        """Return the lower-rank simple curves of a joint's position that together are equivalent to
        one; else none.

        A name that is equivalent to several simpler ones of the same joint together is not
        determined by the data.
        """
        effect = self.rows[whole].effect
        rank = self.rows[whole].score.rank
        if not is_own_curve(effect):
            return []
        found = [
            i
            for i, row in enumerate(self.rows)
            if is_own_curve(row.effect)
            and row.effect.locus.joint == effect.locus.joint
            and 0 < row.score.rank < rank
        ]
        return (
            found
            if len(found) > 1 and self.p_value_given([whole], found) > policy.told_apart
            else []
        )


@dataclass(frozen=True)
class Decision:
    """The best candidate, and effects that the data can't distinguish from it.

    Attributes:
        row: the candidate; of several effects together, the first of them.
        equivalent: effects that it could also be.
        together: some of these that only together explain the data as well.
        effects: the effects that enter; default: the candidate.
    """

    row: Row
    equivalent: tuple[Effect, ...] = ()
    together: tuple[Effect, ...] = ()
    effects: tuple[Effect, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "effects", self.effects or (self.row.effect,))

    @property
    def effect(self) -> Effect:
        """The candidate."""
        return self.row.effect

    @property
    def is_single(self) -> bool:
        """Whether it is one effect of one joint: of compliances, whether one drive or bearing is
        all that is compliant.
        """
        return len(self.effects) == 1 and self.effect.locus.joint is not None


def decide(
    names: CandidateTable, contest_of: Callable[[Sequence[Row]], CandidateTable], policy: Policy
) -> Decision | None:
    """Return the best explanation of the residuals of a fit, from all named candidates; None if
    nothing is significant.

    ``contest_of`` returns the table of some of them, the best first and at the same costs, and of
    unnamed dependences.
    """
    best = next((i for i in names.cheapest() if accepted(names.rows[i], policy)), None)
    best = best if best is None else _without_equivalents(names, best, policy)
    close = (
        [] if best is None else [best, *(i for i in names.cheapest()[: policy.close] if i != best)]
    )
    contest = contest_of([names.rows[i] for i in close])
    nameless = _better_without_name(
        contest, None if best is None else names.rows[best].effect, policy
    )
    if nameless is not None:
        effect = contest.rows[nameless].effect
        curves = (
            row.effect
            for row in names.rows
            if isinstance(row.effect, Curve) and is_own_curve(effect)
        )
        whole = [curve for curve in curves if curve.locus.joint == effect.locus.joint][:1]
        return _decision(contest, nameless, whole, policy)
    if best is None:
        return None
    same = next(i for i, row in enumerate(contest.rows) if row.effect is names.rows[best].effect)
    others = [effect for effect in contest.rivals(same, policy) if effect.is_nameless]
    together = tuple(names.rows[i].effect for i in names.parts(best, policy))
    return replace(_decision(names, best, [*together, *others], policy), together=together)


def _without_equivalents(names: CandidateTable, best: int, policy: Policy) -> int:
    """Return the best of simpler effects that together explain more than the best candidate; this
    if they don't.
    """
    parts = names.parts(best, policy)
    if not parts or names.p_value_given(parts, [best]) > policy.adds_nothing:
        return best
    return next(
        (i for i in names.cheapest() if i in parts and accepted(names.rows[i], policy)), best
    )


def _better_without_name(
    contest: CandidateTable, best: Effect | None, policy: Policy
) -> int | None:
    """Return the unnamed dependence that is accepted at lower cost than the best name, if any."""
    rows = contest.rows
    nameless = next((i for i in contest.passed(policy) if rows[i].effect.is_nameless), None)
    if nameless is None:
        return None
    to_beat = next((row.cost for row in rows if row.effect is best), np.inf)
    return nameless if rows[nameless].cost < to_beat and accepted(rows[nameless], policy) else None


def _decision(
    table: CandidateTable, best: int, others: Iterable[Effect], policy: Policy
) -> Decision:
    row = table.rows[best]
    same = row.effect.same if isinstance(row.effect, Harmonic) else ()
    return Decision(
        row, each_heading_once([*table.rivals(best, policy), *others, *same], row.effect, policy)
    )


def each_heading_once(
    effects: Iterable[Effect], best: Effect, policy: Policy
) -> tuple[Effect, ...]:
    """Return effects, each heading once and without the best one's; waves of different orders are
    different.
    """
    found: dict[object, Effect] = {}
    for effect in effects:
        found.setdefault(_title(effect), effect)
    found.pop(_title(best), None)
    return tuple(found.values())[: policy.most_rivals]


def _title(effect: Effect) -> object:
    return (effect.heading, effect.locus.order) if isinstance(effect, Harmonic) else effect.heading


def is_near(effect: Effect, other: Effect, near: float) -> bool:
    """Return whether two effects are waves of one name on one joint, of orders less than ``near``
    apart.
    """
    if (
        not (isinstance(effect, Harmonic) and isinstance(other, Harmonic))
        or effect.heading != other.heading
    ):
        return False
    return abs((effect.locus.order or 0.0) - (other.locus.order or 0.0)) < near


def is_own_curve(effect: Effect) -> bool:
    """Return whether an effect is a simple curve of the joint's own position, about its
    own axis.
    """
    at = effect.locus
    is_about_axis = at.acts_on in ("drive", "gamma_z")
    return (
        is_about_axis
        and at.joint is not None
        and at.follows == at.joint
        and not isinstance(effect, Curve | Harmonic)
    )


def standard_errors(gains: np.ndarray) -> float:
    """Return the sum of the gains of held-out blocks over its standard error, from the differences
    between blocks.

    A prediction is called better above 1. A single block, such as a region that the others don't
    reach, can't veto the others: above ``TESTING.veto`` standard errors with the extreme blocks
    replaced by their neighbours (Winsor's mean), the larger value counts.
    """
    if len(gains) < 2:
        return 0.0
    every = _in_errors(gains)
    inner = _in_errors(np.clip(gains, *np.sort(gains)[[1, -2]]))
    return (
        max(every, inner) if len(gains) >= TESTING.fewest_blocks and inner > TESTING.veto else every
    )


def _in_errors(gains: np.ndarray) -> float:
    return float(gains.sum() / max(gains.std(ddof=1) * np.sqrt(len(gains)), 1e-300))


def enough_errors(effect: Effect) -> float:
    """Return the required gain of held-out blocks, in standard errors; more if an effect was
    selected among many on them.
    """
    return TESTING.searched if effect.trials > 1.0 else TESTING.predicts
