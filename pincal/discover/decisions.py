"""Which effect explains what a model leaves, and whether a name is accepted: no fit and no data in here.

Every pass of a search asks :func:`accepted`. The numbers stand in ``policy.py``; the tests behind them are those of
``first_order.py``. docs/criteria.md derives them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from pincal.discover.first_order import ScoreResult, ScoreTests
from pincal.discover.policy import TESTING, Policy
from pincal.model.effect import Curve, Effect, Harmonic

Question = Literal["enter", "elastic", "stay", "rest"]
"""What is asked of a name: whether it enters, an arm is compliant, it stays, or is the rest of another where that acts."""


class Unfitted(NamedTuple):
    """What blocks of poses left out say of a candidate.

    Attributes:
        errors: standard errors that they gain by it.
        p_value: of its test whatever the noise is at each visit of a pose; default: not asked.
    """

    errors: float
    p_value: Callable[[], float] | None = None


@dataclass(frozen=True)
class Row:
    """One candidate, its test, and what else it is judged by.

    Attributes:
        effect: the candidate.
        score: its test.
        cost: what it costs to believe it: the extended Bayesian information criterion, and a surcharge without a name;
            negative is better than nothing.
        which: the effects that it is made of, by their places among those that were tested.
        question: what is asked of it.
        among: of how many candidates it was chosen, which share the chance of a false name.
        least: what it has to take off the squares to matter to anybody.
        evidence: log of how much likelier the data are with it, whatever its parameters; inf where rows are many.
        left_out: tells what blocks left out say of it; default: nobody asks them.
        enough: standard errors that they have to gain.
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


def allowed_chance(question: Question, among: float, policy: Policy) -> float:
    """Return what the p-value of one of several candidates has to stay below."""
    chances = {
        "enter": policy.false_name,
        "elastic": policy.elastic,
        "stay": policy.drop * policy.false_name,
        "rest": policy.remainder,
    }
    return chances[question] / among


def is_more_than_chance(row: Row, policy: Policy) -> bool:
    """Return whether neither chance nor priors speak against a candidate, and it matters, on the rows that were fitted."""
    limit = allowed_chance(row.question, row.among, policy)
    return row.score.p_value < limit and row.score.gain >= row.least and row.evidence >= -np.log(limit)


def accepted(row: Row, policy: Policy) -> bool:
    """Return whether a name is accepted.

    It is if it is more than chance (F test) and matters, if what is known of its size beforehand does not speak against it
    (Bayes factor, on few rows), and if by it blocks of poses that are left out are predicted better, by more than chance
    (cross-validation), whatever the noise is at each pose.
    """
    if not is_more_than_chance(row, policy):
        return False
    if row.left_out is None:
        return True
    said, limit = row.left_out(), allowed_chance(row.question, row.among, policy)
    return said.errors > row.enough and (said.p_value is None or said.p_value() < limit)


@dataclass(frozen=True)
class CandidateTable:
    """Candidates against one fit, and their tests."""

    rows: Sequence[Row]
    tests: ScoreTests

    def left(self, rows: Sequence[int], given: Sequence[int]) -> float:
        """Return the p-value of what some candidates taken as one still explain once others are in the model."""
        which, beside = ([k for i in of for k in self.rows[i].which] for of in (rows, given))
        return self.tests.score_given(which, beside).p_value

    def cheapest(self) -> list[int]:
        """Return all candidates, the cheapest first."""
        return [int(i) for i in np.argsort([row.cost for row in self.rows])]

    def passed(self, policy: Policy) -> list[int]:
        """Return the candidates that are more than chance, the cheapest first."""
        return [i for i in self.cheapest() if is_more_than_chance(self.rows[i], policy)]

    def rivals(self, best: int, policy: Policy) -> list[Effect]:
        """Return the candidates that explain the data as well: little is left for the best once one of them is in."""
        found = []
        for i in self.cheapest():
            row, worse = self.rows[i], self.rows[i].cost - self.rows[best].cost
            if i == best or not row.score.rank or worse >= policy.near_tie:
                continue
            if self.left([best], [i]) > (policy.told_apart if worse < policy.tie else policy.adds_nothing):
                found.append(row.effect)
        return found

    def parts(self, whole: int, policy: Policy) -> list[int]:
        """Return the plainer simple curves of the joint's position that together do what a simple curve does; else none.

        A name for what several plainer ones of the same joint do together is none that the data have told.
        """
        effect, rank = self.rows[whole].effect, self.rows[whole].score.rank
        if not is_own_curve(effect):
            return []
        found = [
            i
            for i, row in enumerate(self.rows)
            if is_own_curve(row.effect) and row.effect.locus.joint == effect.locus.joint and 0 < row.score.rank < rank
        ]
        return found if len(found) > 1 and self.left([whole], found) > policy.told_apart else []


@dataclass(frozen=True)
class Decision:
    """What explains most for what it costs, and effects that the data can't distinguish from it.

    Attributes:
        row: the candidate; of several effects as one, the first of them.
        equivalent: the effects, one of which it could also be.
        together: effects that together explain the data as well, and are among them.
        effects: what enters; default: the candidate.
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
        """Whether it is one effect of one joint: of compliances, whether one drive or bearing is all that is compliant."""
        return len(self.effects) == 1 and self.effect.locus.joint is not None


def decide(names: CandidateTable, contest_of: Callable[[Sequence[Row]], CandidateTable], policy: Policy) -> Decision | None:
    """Return the best explanation of what a fit leaves; None if there is nothing but chance.

    Args:
        names: all candidates with a name.
        contest_of: the table of some of them, the best first and as costly as among all, and of the dependences without a
            name.
        policy: what to go by.
    """
    best = next((i for i in names.cheapest() if accepted(names.rows[i], policy)), None)
    best = best if best is None else _without_equivalents(names, best, policy)
    close = [] if best is None else [best, *(i for i in names.cheapest()[: policy.close] if i != best)]
    contest = contest_of([names.rows[i] for i in close])
    nameless = _better_without_name(contest, None if best is None else names.rows[best].effect, policy)
    if nameless is not None:
        effect = contest.rows[nameless].effect
        curves = (row.effect for row in names.rows if isinstance(row.effect, Curve) and is_own_curve(effect))
        whole = [curve for curve in curves if curve.locus.joint == effect.locus.joint][:1]
        return _decision(contest, nameless, whole, policy)
    if best is None:
        return None
    same = next(i for i, row in enumerate(contest.rows) if row.effect is names.rows[best].effect)
    others = [effect for effect in contest.rivals(same, policy) if effect.is_nameless]
    together = tuple(names.rows[i].effect for i in names.parts(best, policy))
    return replace(_decision(names, best, [*together, *others], policy), together=together)


def _without_equivalents(names: CandidateTable, best: int, policy: Policy) -> int:
    """Return the likeliest of plainer effects that together explain more than the best does; the best if they don't."""
    parts = names.parts(best, policy)
    if not parts or names.left(parts, [best]) > policy.adds_nothing:
        return best
    return next((i for i in names.cheapest() if i in parts and accepted(names.rows[i], policy)), best)


def _better_without_name(contest: CandidateTable, best: Effect | None, policy: Policy) -> int | None:
    """Return the dependence without a name that beats the best name, if one does and predicts rows left out."""
    rows = contest.rows
    nameless = next((i for i in contest.passed(policy) if rows[i].effect.is_nameless), None)
    if nameless is None:
        return None
    to_beat = next((row.cost for row in rows if row.effect is best), np.inf)
    return nameless if rows[nameless].cost < to_beat and accepted(rows[nameless], policy) else None


def _decision(table: CandidateTable, best: int, others: Iterable[Effect], policy: Policy) -> Decision:
    row = table.rows[best]
    same = row.effect.same if isinstance(row.effect, Harmonic) else ()
    return Decision(row, each_heading_once([*table.rivals(best, policy), *others, *same], row.effect, policy))


def each_heading_once(effects: Iterable[Effect], best: Effect, policy: Policy) -> tuple[Effect, ...]:
    """Return effects without those that a report would call the same as an earlier one or as the best.

    Waves of different orders are different ones: they are what positions on a grid can't tell apart.
    """
    found: dict[object, Effect] = {}
    for effect in effects:
        found.setdefault(_title(effect), effect)
    found.pop(_title(best), None)
    return tuple(found.values())[: policy.most_rivals]


def _title(effect: Effect) -> object:
    return (effect.heading, effect.locus.order) if isinstance(effect, Harmonic) else effect.heading


def is_own_curve(effect: Effect) -> bool:
    """Return whether an effect is a simple curve of the joint's own position, about its own axis."""
    at = effect.locus
    is_about_axis = at.acts_on in ("drive", "gamma_z")
    return is_about_axis and at.joint is not None and at.follows == at.joint and not isinstance(effect, Curve | Harmonic)


def standard_errors(gains: np.ndarray) -> float:
    """Return the sum of what blocks of poses left out gain, in its standard errors as the blocks differ.

    More than one is what it takes, here and everywhere in a discovery, to call a prediction better. One block alone, such as
    a region that the others don't reach, can't veto what they agree in: if they do by ``TESTING.veto`` standard errors, the
    blocks that gain least and most count as those next to them (Winsor's mean).
    """
    if len(gains) < 2:
        return 0.0
    every, inner = _in_errors(gains), _in_errors(np.clip(gains, *np.sort(gains)[[1, -2]]))
    return max(every, inner) if len(gains) >= TESTING.fewest_blocks and inner > TESTING.veto else every


def _in_errors(gains: np.ndarray) -> float:
    return float(gains.sum() / max(gains.std(ddof=1) * np.sqrt(len(gains)), 1e-300))


def enough_errors(effect: Effect) -> float:
    """Return how many standard errors blocks left out have to gain by an effect.

    More by an effect that is the best of many that were looked at on all blocks.
    """
    return TESTING.searched if effect.looks > 1.0 else TESTING.predicts
