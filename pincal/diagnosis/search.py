"""Which changes explain new rows: one after the other, each by what it takes off the squares for what it costs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import chdtrc, fdtrc

from pincal.diagnosis.evidence import Evidence
from pincal.diagnosis.lineup import Lineup

# Parts of the chance of a false alarm: for any one change, and for a misfit that none explains.
_FOR_CHANGES, _FOR_MISFIT = 0.8, 0.2
# Two changes can't be told apart unless one is this many times as likely: -2 log odds.
EQUIVALENT = 2.0 * np.log(100.0)
# How much likelier the usual is than anything else, before any row is seen: -2 log odds.
_USUAL = 2.0 * np.log(10.0)
# Chance that a sound row is taken for a wrong reading.
_WRONG_ROW = 0.001
# Changes that are tried by a fit, where squares to first order are not enough.
_MOST_TRIED = 16
# Shift of the target from which on a first-order test is not enough [m].
_LINEAR = 1e-3
# Changes and wrong rows that are looked for at most, one after the other; beside them each curve of a drive.
_MOST = 6
# Part of what a calibration took for noise that an effect which it left may have been.
_MOST_OF_NOISE = 0.95
# Part of the rows from which on those that stand apart are no exceptions, as when a robot is calibrated.
_TOO_MANY = 0.25
# Rows of which none is thought wrong: too few to tell.
_FEWEST_ROWS = 8


@dataclass(frozen=True)
class Score:
    """What one change explains.

    Attributes:
        change: its place in the lineup.
        gain: what it takes off the square.
        rank: number of its directions that the rows see.
        p_value: of the F test, for this change alone.
        cost: minus the gain, and what its parameters cost (Schwarz's criterion); negative is better than nothing.
    """

    change: int
    gain: float
    rank: int
    p_value: float
    cost: float


@dataclass(frozen=True)
class Step:
    """A change that was found.

    Attributes:
        score: of the change.
        p_value: chance of any such alarm on a robot that has not changed further.
        equivalent: scores of changes that these rows can't tell from it.
    """

    score: Score
    p_value: float
    equivalent: tuple[Score, ...]


@dataclass(frozen=True)
class Verdict:
    """What a search came to.

    Attributes:
        lineup: the rows that counted in the end.
        steps: changes of the robot, the first one the surest.
        beside: effects that were there before and that the model left.
        values: shape (P,), with all of them released.
        evidence: on everything else.
        first: evidence before any was released.
        p_value: chance of an alarm like the first on a robot that has not changed.
        is_unexplained: whether the rest is more than noise.
        wrong_rows: rows that contradict all others, by their place in the table.
        alpha: chance of a false alarm.
        degrees: degrees of freedom by which the calibration knows its noise.
        n_tested: number of changes that were tested.
        is_undecided: whether so many rows contradict the others that nothing can be said of the robot.
    """

    lineup: Lineup
    steps: tuple[Step, ...]
    beside: tuple[int, ...]
    values: np.ndarray
    evidence: Evidence
    first: Evidence
    p_value: float
    is_unexplained: bool
    wrong_rows: tuple[int, ...]
    alpha: float
    degrees: float
    n_tested: int
    is_undecided: bool = False

    @property
    def happened(self) -> list[int]:
        """Places of the changes of the robot."""
        return [step.score.change for step in self.steps]

    @property
    def changed(self) -> bool:
        """Whether the robot is other than its model says."""
        return bool(self.steps) or self.is_unexplained


def limit_of(verdict: Verdict) -> float:
    """Return the p-value that a change had to stay below."""
    return limit_for(verdict.alpha, verdict.n_tested)


def limit_for(alpha: float, n_tested: int) -> float:
    """Return the p-value below which one of so many changes is an alarm."""
    return alpha * _FOR_CHANGES / max(n_tested, 1)


def search(lineup: Lineup, *, alpha: float, degrees: float, apart: np.ndarray | None = None) -> Verdict:
    """Find what has happened to a robot.

    Args:
        lineup: the rows and what may have happened.
        alpha: chance of an alarm on a robot that has not changed.
        degrees: degrees of freedom by which the calibration knows its noise.
        apart: places of rows that stand apart from all others wherever instrument and target are; default: none do.
    """
    apart = np.zeros(0, int) if apart is None else apart
    rows = np.arange(len(lineup.station))
    state = _State(lineup, lineup.release((), lineup.start), alpha, degrees)
    wrong: list[int] = []
    if len(apart) > 1 and state.are_rather(apart, state.best()):
        if len(apart) >= _TOO_MANY * len(rows):
            return _undecided(state, apart)
        wrong, rows = apart.tolist(), np.delete(rows, apart)
        state = state.without(apart)
    first, p_first = state.evidence, state.p_value
    for _ in range(_MOST + sum(change.belief is not None for change in lineup.changes)):
        row = state.wrong_row()
        best = state.best()
        if row is not None and (best is None or state.is_rather(row, best)):
            wrong.append(int(rows[row]))
            rows = np.delete(rows, row)
            state = state.without(row)
            if not state.steps and not state.beside:
                first, p_first = state.evidence, state.p_value
            continue
        if best is None:
            break
        state = state.after(best)
    is_unexplained = state.misfit_p_value < alpha * _FOR_MISFIT
    return Verdict(
        lineup=state.lineup,
        steps=state.steps,
        beside=state.beside,
        values=state.values,
        evidence=state.evidence,
        first=first,
        p_value=p_first,
        is_unexplained=is_unexplained,
        wrong_rows=tuple(wrong),
        alpha=alpha,
        degrees=degrees,
        n_tested=max(len(state.scores), 1),
    )


def _undecided(state: _State, apart: np.ndarray) -> Verdict:
    """Return a verdict on rows of which too many contradict the others."""
    return Verdict(
        lineup=state.lineup,
        steps=(),
        beside=(),
        values=state.values,
        evidence=state.evidence,
        first=state.evidence,
        p_value=state.p_value,
        is_unexplained=False,
        wrong_rows=tuple(apart.tolist()),
        alpha=state.alpha,
        degrees=state.degrees,
        n_tested=max(len(state.scores), 1),
        is_undecided=True,
    )


def raises_alarm(lineup: Lineup, *, alpha: float, degrees: float) -> bool:
    """Return whether rows raise an alarm, without looking for what happened; arguments as in :func:`search`."""
    return _State(lineup, lineup.release((), lineup.start), alpha, degrees).p_value < alpha


@dataclass(frozen=True)
class _State:
    """The search once some changes have been found."""

    lineup: Lineup
    values: np.ndarray
    alpha: float
    degrees: float
    steps: tuple[Step, ...] = ()
    beside: tuple[int, ...] = ()

    @property
    def happened(self) -> list[int]:
        return [*(step.score.change for step in self.steps), *self.beside]

    @cached_property
    def evidence(self) -> Evidence:
        return self.lineup.weigh(self.values, self.happened)

    @cached_property
    def scores(self) -> list[Score]:
        """All changes that the rows see something of, the best explanation first."""
        happened = set(self.happened)
        gains = [
            (i, *self.evidence.gain(self.lineup.places[i], change.belief))
            for i, change in enumerate(self.lineup.changes)
            if i not in happened
        ]
        return sorted((self._score(i, gain, rank) for i, gain, rank in gains if rank), key=lambda score: score.cost)

    def _score(self, i: int, gain: float, rank: int) -> Score:
        left, degrees = self.evidence.square - gain, self.degrees + self.evidence.degrees - rank
        F = (gain / rank) / ((self.degrees + max(left, 0.0)) / max(degrees, 1.0))
        p_value = float(fdtrc(rank, max(degrees, 1.0), F)) if gain > 0.0 else 1.0
        change = self.lineup.changes[i]
        if change.belief is not None:
            return Score(i, gain, rank, p_value, self.evidence.odds(self.lineup.places[i], change.belief))
        return Score(i, gain, rank, p_value, rank * self._price - gain - _USUAL * change.is_usual)

    @cached_property
    def _price(self) -> float:
        return float(np.log(len(self.lineup.station) * sum(block.size for block in self.lineup.station.sensor.blocks)))

    @cached_property
    def misfit_p_value(self) -> float:
        """Chance of as large a square on a robot that has not changed further."""
        found = self.evidence
        F = (found.square / max(found.degrees, 1)) if found.degrees > 0 else 0.0
        return float(fdtrc(max(found.degrees, 1), self.degrees, F))

    @cached_property
    def p_value(self) -> float:
        """Chance of any alarm as strong on a robot that has not changed further."""
        least = min((score.p_value for score in self.scores), default=1.0) * len(self.scores)
        return min(1.0, least / _FOR_CHANGES, self.misfit_p_value / _FOR_MISFIT)

    def best(self) -> Step | None:
        """Return the change that explains most for what it costs, if it is more than chance; equivalents with it."""
        limit = limit_for(self.alpha, len(self.scores))
        if not any(score.p_value < limit for score in self.scores):
            return None
        near = self.scores
        if self._is_far(near[0]):
            near = sorted((self._tried(score) for score in near[:_MOST_TRIED]), key=lambda score: score.cost)
        chosen = next((score for score in near if score.p_value < limit), None)
        if chosen is None:
            return None
        likes = (score for score in near if score is not chosen and score.cost < chosen.cost + EQUIVALENT)
        return Step(chosen, min(1.0, chosen.p_value * len(self.scores) / _FOR_CHANGES), tuple(likes))

    def _is_far(self, score: Score) -> bool:
        """Return whether a change is so large that squares to first order are not enough."""
        places = self.lineup.places[score.change]
        step, _ = self.evidence.estimate(places, self.lineup.changes[score.change].belief)
        shift = self.lineup.motion(self.values)[:, :, places] @ step
        return bool(np.linalg.norm(shift, axis=1).max() > _LINEAR)

    def _tried(self, score: Score) -> Score:
        if self.lineup.changes[score.change].belief is not None:
            return score
        happened = [*self.happened, score.change]
        values = self.lineup.release(happened, self.values)
        left = self.lineup.weigh(values, happened)
        return self._score(score.change, self.evidence.square - left.square, self.evidence.degrees - left.degrees)

    def after(self, step: Step) -> _State:
        """Return the search with a change released, or with what was there before."""
        change = self.lineup.changes[step.score.change]
        values = self.lineup.release([*self.happened, step.score.change], self.values)
        if change.effect is None or not self._was_there_before(step.score):
            return replace(self, values=values, steps=(*self.steps, step))
        return replace(self, values=values, beside=(*self.beside, step.score.change))

    def _was_there_before(self, score: Score) -> bool:
        """Return whether an effect rather was there when the robot was calibrated, and the model left it.

        Then it was part of the residuals whose size the calibration took for noise, and what is left without it is smaller
        than this noise: the likelihood of noise without it is compared with that of noise as it was.
        """
        n = max(self.evidence.degrees - score.rank, 1)
        left, part = self.evidence.square - score.gain, (score.gain - score.rank) / n
        if not 0.0 < part < _MOST_OF_NOISE:
            return False
        return bool(left / (1.0 - part) + n * np.log(1.0 - part) < left)

    def wrong_row(self) -> int | None:
        """Return the row that contradicts all others, if one does."""
        rows = self.evidence.rows
        chances = chdtrc(np.maximum(rows[:, 1], 1.0), rows[:, 0])
        worst = int(np.argmin(chances))
        return worst if chances[worst] < _WRONG_ROW / len(rows) and len(rows) > _FEWEST_ROWS else None

    def is_rather(self, row: int, step: Step) -> bool:
        """Return whether a wrong row explains more for what it costs than a change."""
        gain, rank = self.evidence.rows[row]
        return bool(rank * self._price - gain < step.score.cost)

    def are_rather(self, rows: np.ndarray, step: Step | None) -> bool:
        """Return whether wrong readings of some rows explain more for what they cost than a change, or than nothing."""
        readings = sum(block.size for block in self.lineup.station.sensor.blocks)
        rest = self.without(rows).evidence
        cost = len(rows) * readings * self._price - (self.evidence.square - rest.square)
        return bool(cost < (0.0 if step is None else min(step.score.cost, 0.0)))

    def without(self, row: int | np.ndarray) -> _State:
        """Return the search without a row, or without some."""
        lineup = self.lineup.without(row)
        return replace(self, lineup=lineup, values=lineup.release(self.happened, self.values))
