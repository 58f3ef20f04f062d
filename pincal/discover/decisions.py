"""Which effect explains what a model leaves, decided from a table of tests: no fit and no data in here."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pincal.discover.policy import Policy
from pincal.discover.score_tests import Score
from pincal.model.effect import Curve, Effect


@dataclass(frozen=True)
class Row:
    """One candidate and its test.

    Attributes:
        effect: the candidate.
        score: its test.
        cost: what it costs to believe it: the extended Bayesian information criterion, and a surcharge without a name;
            negative is better than nothing.
        limit: what the p-value has to stay below.
    """

    effect: Effect
    score: Score
    cost: float
    limit: float


class Evidence(Protocol):
    """What can be asked of the data beyond the table, by the places of rows."""

    def left_given(self, which: int, given: int) -> float:
        """Return the p-value of what one candidate still explains once another is in the model."""

    def cost_together(self, one: int, other: int) -> float:
        """Return the information criterion of two candidates taken as one."""

    def predicts(self, which: int) -> bool:
        """Return whether a candidate improves the prediction of rows left out by more than chance."""


@dataclass(frozen=True)
class CandidateTable:
    """Candidates against one fit.

    Attributes:
        rows: the candidates.
        least: the gain below which an effect matters to nobody.
        evidence: what else the data say of them.
    """

    rows: tuple[Row, ...]
    least: float
    evidence: Evidence

    def cheapest(self) -> list[int]:
        """Return all candidates, the cheapest first."""
        return [int(i) for i in np.argsort([row.cost for row in self.rows])]

    def passed(self) -> list[int]:
        """Return the candidates that chance does not explain, the cheapest first."""
        rows = self.rows
        return [i for i in self.cheapest() if rows[i].score.p_value < rows[i].limit and rows[i].score.gain >= self.least]

    def rivals(self, best: int, policy: Policy) -> list[int]:
        """Return the candidates that explain the data as well: little is left for the best once one of them is in."""
        rows, found = self.rows, []
        for i in self.cheapest():
            worse = rows[i].cost - rows[best].cost
            if i == best or not rows[i].score.rank or worse >= policy.near_tie:
                continue
            if self.evidence.left_given(best, i) > (policy.told_apart if worse < policy.tie else policy.adds_nothing):
                found.append(i)
        return found

    def curves_like(self, effect: Effect) -> list[int]:
        """Return the drive curves of the joint on which an effect acts."""
        return [i for i, row in enumerate(self.rows) if isinstance(row.effect, Curve) and is_beside(row.effect, effect)]


@dataclass(frozen=True)
class Decision:
    """The effect that explains most for what it costs.

    Attributes:
        table: the candidates among which it was found.
        best: its place there.
        equivalent: effects that the data can't tell from it.
    """

    table: CandidateTable
    best: int
    equivalent: tuple[Effect, ...]

    @property
    def effect(self) -> Effect:
        """The effect."""
        return self.table.rows[self.best].effect


def decide(names: CandidateTable, contest: CandidateTable, policy: Policy) -> Decision | None:
    """Return the best explanation of what a fit leaves; None if there is nothing but chance.

    Args:
        names: all candidates with a name.
        contest: the best of them and the dependences without a name; the names are as costly as among all names.
        policy: what to go by.
    """
    best = best_name(names, policy)
    nameless = _better_without_name(contest, None if best is None else names.rows[best].effect)
    if nameless is not None:
        more = _whole_curves(contest.rows[nameless].effect, names)
        more += () if best is None else _larger_curves(names, best, policy)
        return _decision(contest, nameless, more, policy)
    if best is None:
        return None
    curve = _promoted(names, best, policy)
    if curve is not None:
        return _decision(names, curve, (), policy)
    effects = [row.effect for row in contest.rows]
    same = next(i for i, effect in enumerate(effects) if effect is names.rows[best].effect)
    others = tuple(effects[i] for i in contest.rivals(same, policy) if effects[i].is_nameless)
    return _decision(names, best, others + _larger_curves(names, best, policy), policy)


def best_name(names: CandidateTable, policy: Policy) -> int | None:
    """Return the cheapest name that is more than chance and predicts rows left out."""
    return next((i for i in names.passed()[: policy.tried] if names.evidence.predicts(i)), None)


def close_names(names: CandidateTable, best: int | None, policy: Policy) -> list[int]:
    """Return the names that take part in the contest with dependences without a name, the best first."""
    if best is None:
        return []
    return [best, *(i for i in names.cheapest()[: policy.close] if i != best)]


def _better_without_name(contest: CandidateTable, best: Effect | None) -> int | None:
    """Return the dependence without a name that beats the best name, if one does and predicts rows left out."""
    rows = contest.rows
    nameless = next((i for i in contest.passed() if rows[i].effect.is_nameless), None)
    if nameless is None:
        return None
    to_beat = next((row.cost for row in rows if row.effect is best), np.inf)
    return nameless if rows[nameless].cost < to_beat and contest.evidence.predicts(nameless) else None


def _decision(table: CandidateTable, best: int, others: Iterable[Effect], policy: Policy) -> Decision:
    rivals = [table.rows[i].effect for i in table.rivals(best, policy)]
    return Decision(table, best, each_heading_once([*rivals, *others], table.rows[best].effect, policy))


def each_heading_once(effects: Iterable[Effect], best: Effect, policy: Policy) -> tuple[Effect, ...]:
    """Return effects without those that a report would call the same as an earlier one or as the best."""
    found: dict[tuple[str, str | None, str | None], Effect] = {}
    for effect in effects:
        found.setdefault(effect.heading, effect)
    found.pop(best.heading, None)
    return tuple(found.values())[: policy.most_rivals]


def is_own_curve(effect: Effect) -> bool:
    """Return whether an effect is a simple curve of the joint's own position, about its own axis."""
    at = effect.locus
    is_about_axis = at.acts_on in ("drive", "gamma_z")
    return is_about_axis and at.joint is not None and at.follows == at.joint and not isinstance(effect, Curve)


def is_beside(one: Effect, other: Effect) -> bool:
    """Return whether two effects act on the same joint."""
    return one.locus.joint == other.locus.joint


def _beyond(names: CandidateTable, best: int, policy: Policy) -> tuple[float, int]:
    """Return the chance that some simple curve of the joint's position is all of the curve, and the drive curve."""
    effect = names.rows[best].effect
    if not is_own_curve(effect):
        return 1.0, -1
    dearest = names.rows[best].cost + policy.near_tie
    simple = [best] + [
        i for i, r in enumerate(names.rows) if is_own_curve(r.effect) and is_beside(r.effect, effect) and r.cost < dearest
    ]
    curves = names.curves_like(effect)
    left = names.evidence.left_given
    return min(((max(left(i, j) for j in simple) * len(curves), i) for i in curves), default=(1.0, -1))


def _promoted(names: CandidateTable, best: int, policy: Policy) -> int | None:
    """Return the drive curve of which the simple names are only a part, unless a second name explains the rest as well."""
    chance, curve = _beyond(names, best, policy)
    if chance > policy.adds_nothing:
        return None
    others = [i for i, row in enumerate(names.rows) if i != best and not isinstance(row.effect, Curve)]
    pairs = [names.evidence.cost_together(best, i) for i in others]
    return curve if names.rows[curve].cost < min(pairs, default=np.inf) else None


def _larger_curves(names: CandidateTable, best: int, policy: Policy) -> tuple[Effect, ...]:
    """Return the drive curve that leaves something to a simple curve of the joint's position, if there is a hint of one."""
    chance, curve = _beyond(names, best, policy)
    return (names.rows[curve].effect,) if chance < policy.hint else ()


def _whole_curves(effect: Effect, names: CandidateTable) -> tuple[Effect, ...]:
    """Return the drive curve that a simple curve of the joint's position may be a part of."""
    curves = names.curves_like(effect) if is_own_curve(effect) else []
    return tuple(names.rows[i].effect for i in curves[:1])
