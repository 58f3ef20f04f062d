"""Stepwise search for the changes of a robot that explain new rows, by the reduction of the squares
less its cost.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import chdtrc, fdtrc

from pincal.calibration.change_numbers import CHANGES
from pincal.diagnosis.diagnosis_numbers import DIAGNOSIS
from pincal.diagnosis.lineup import ChangeHypotheses
from pincal.diagnosis.row_evidence import RowEvidence
from pincal.hypotheses.hypothesis import Explanation, likeliest
from pincal.identify.quadratic import ROUNDING, root_of_inverse
from pincal.identify.selection import Scored, select_stepwise
from pincal.thresholds import Count, Scale

# Changes that are fitted, where first-order tests are not accurate enough.
_MOST_TRIED: Count = 16
# Displacement of the target above which first-order tests are not accurate enough [m].
_LINEAR: Scale = 1e-3
# Changes and wrong rows at most, in addition to each curve of a drive.
_MOST: Count = 6


@dataclass(frozen=True)
class ChangeScore:
    """The test of one change.

    Attributes:
        change: its index in the lineup.
        gain: reduction of the squares.
        rank: number of its directions that the rows observe.
        p_value: of the F test, for this change alone.
        cost: penalty of its parameters (Schwarz's criterion) less the gain; negative is better than
            no change.
    """

    change: int
    gain: float
    rank: int
    p_value: float
    cost: float


@dataclass(frozen=True)
class NamedChange:
    """A change that was found.

    Attributes:
        score: of the change.
        p_value: probability of any such alarm on a robot that has not changed further.
        equivalent: scores of changes that these rows can't distinguish from it.
    """

    score: ChangeScore
    p_value: float
    equivalent: tuple[ChangeScore, ...]


def limit_for(alpha: float, n_tested: int) -> float:
    """Return the p-value below which one of ``n_tested`` changes raises an alarm."""
    return alpha * DIAGNOSIS.for_changes / max(n_tested, 1)


def search(
    lineup: ChangeHypotheses, *, alpha: float, degrees: float, apart: np.ndarray | None = None
) -> ChangeVerdict:
    """Find the changes of a robot.

    Args:
        lineup: the rows and the possible changes.
        alpha: probability of an alarm on a robot that has not changed.
        degrees: degrees of freedom of the calibration's noise estimate.
        apart: indices of rows that contradict all others wherever instrument and target are;
            default: none.
    """
    state = _begun(lineup, alpha, degrees)
    if apart is not None and len(apart) > 1:
        # Wrong readings of some rows may explain more at their cost than a change, or than nothing.
        best = state.best()
        rest = state.without(apart)
        readings = lineup.station.reading_size
        cost = len(apart) * readings * state.price - (
            state.evidence.form.square - rest.evidence.form.square
        )
        if cost < (0.0 if best is None else min(best.score.cost, 0.0)):
            if len(apart) >= DIAGNOSIS.too_many * len(state.rows):
                return replace(state, wrong_rows=tuple(apart.tolist()), is_undecided=True)
            state = rest
    most = _MOST + sum(change.belief is not None for change in lineup.changes)
    return select_stepwise(
        state, ChangeVerdict.offers, ChangeVerdict.after, most=most
    ).without_vanished()


def raises_alarm(lineup: ChangeHypotheses, *, alpha: float, degrees: float) -> bool:
    """Return whether rows raise an alarm, without a search for changes; arguments as in
    :func:`search`.
    """
    return _begun(lineup, alpha, degrees).p_value < alpha


def _begun(lineup: ChangeHypotheses, alpha: float, degrees: float) -> ChangeVerdict:
    return ChangeVerdict(
        lineup, lineup.release((), lineup.start), alpha, degrees, np.arange(len(lineup.station))
    )


@dataclass(frozen=True)
class ChangeVerdict:
    """State of a search for changes.

    Attributes:
        lineup: the rows that count.
        values: shape (P,), with all changes found so far released.
        alpha: probability of a false alarm.
        degrees: degrees of freedom of the calibration's noise estimate.
        rows: indices in the table of the rows that count.
        steps: changes of the robot, the most significant first.
        unmodelled: unmodelled effects that were present at the calibration.
        wrong_rows: indices in the table of rows that contradict all others.
        p_first: probability of the first alarm; None before.
        is_undecided: whether the rows can't decide, as where too many contradict the others.
    """

    lineup: ChangeHypotheses
    values: np.ndarray
    alpha: float
    degrees: float
    rows: np.ndarray
    steps: tuple[NamedChange, ...] = ()
    unmodelled: tuple[int, ...] = ()
    wrong_rows: tuple[int, ...] = ()
    p_first: float | None = None
    is_undecided: bool = False

    @property
    def happened(self) -> list[int]:
        """Indices of the changes of the robot."""
        return [step.score.change for step in self.steps]

    @property
    def changed(self) -> bool:
        """Whether the robot has changed."""
        return bool(self.steps) or self.is_unexplained

    @property
    def p_value(self) -> float:
        """Probability of an alarm like the first on a robot that has not changed."""
        return self.p_further if self.p_first is None else self.p_first

    @property
    def is_unexplained(self) -> bool:
        """Whether the remaining residuals exceed the noise."""
        return not self.is_undecided and self.misfit_p_value < self.alpha * DIAGNOSIS.for_misfit

    @property
    def limit(self) -> float:
        """The p-value that a change has to stay below."""
        return limit_for(self.alpha, len(self.scores))

    def none(self) -> ChangeVerdict:
        """Return the verdict that the rows can't decide."""
        start = self.lineup.start
        return replace(
            self, values=start, steps=(), unmodelled=(), p_first=self.p_value, is_undecided=True
        )

    @property
    def _released(self) -> list[int]:
        return [*self.happened, *self.unmodelled]

    @cached_property
    def evidence(self) -> RowEvidence:
        """Evidence of the rows on everything not yet released."""
        return self.lineup.weigh(self.values, self._released)

    def offers(self) -> Iterator[Scored[NamedChange | int]]:
        """Yield the best change, and the row that is most likely wrong, if any."""
        if (best := self.best()) is not None:
            yield Scored(best, best.score.cost)
        rows = self.evidence.rows
        chances = chdtrc(np.maximum(rows[:, 1], 1.0), rows[:, 0])
        worst = int(np.argmin(chances))
        if chances[worst] < DIAGNOSIS.wrong_row / len(rows) and len(rows) > DIAGNOSIS.fewest_rows:
            gain, rank = rows[worst]
            yield Scored(worst, float(rank * self.price - gain))

    @cached_property
    def scores(self) -> list[ChangeScore]:
        """All changes that the rows observe, the best explanation first."""
        released = set(self._released)
        gains = [
            (i, *self.evidence.gain(self.lineup.places[i], change.belief))
            for i, change in enumerate(self.lineup.changes)
            if i not in released
        ]
        return sorted(
            (self._score(i, gain, rank) for i, gain, rank in gains if rank),
            key=lambda score: score.cost,
        )

    def _score(self, i: int, gain: float, rank: int) -> ChangeScore:
        rest = self.evidence.form.square - gain
        degrees = self.degrees + self.evidence.form.degrees - rank
        F = (gain / rank) / ((self.degrees + max(rest, 0.0)) / max(degrees, 1.0))
        p_value = float(fdtrc(rank, max(degrees, 1.0), F)) if gain > 0.0 else 1.0
        change = self.lineup.changes[i]
        if change.belief is not None:
            return ChangeScore(
                i, gain, rank, p_value, self.evidence.odds(self.lineup.places[i], change.belief)
            )
        return ChangeScore(
            i, gain, rank, p_value, rank * self.price - gain - CHANGES.usual * change.is_usual
        )

    @cached_property
    def price(self) -> float:
        """Cost of a parameter (Schwarz's criterion)."""
        return float(np.log(len(self.lineup.station) * self.lineup.station.reading_size))

    @cached_property
    def misfit_p_value(self) -> float:
        """Probability of as large a square on a robot that has not changed further."""
        found = self.evidence.form
        F = (found.square / max(found.degrees, 1)) if found.degrees > 0 else 0.0
        return float(fdtrc(max(found.degrees, 1), self.degrees, F))

    @cached_property
    def p_further(self) -> float:
        """Probability of any alarm as strong on a robot that has not changed further."""
        least = min((score.p_value for score in self.scores), default=1.0) * len(self.scores)
        return min(1.0, least / DIAGNOSIS.for_changes, self.misfit_p_value / DIAGNOSIS.for_misfit)

    def best(self) -> NamedChange | None:
        """Return the change of least cost, if it is significant, with its equivalents."""
        limit = self.limit
        if not any(score.p_value < limit for score in self.scores):
            return None
        found = likeliest(
            [Explanation(score, score.cost, score.p_value < limit) for score in self._ranked()],
            lambda least: least + DIAGNOSIS.equivalent,
        )
        if found is None:
            return None
        p_value = found.best.p_value * len(self.scores) / DIAGNOSIS.for_changes
        return NamedChange(found.best, min(1.0, p_value), found.rivals)

    def _ranked(self) -> list[ChangeScore]:
        """Return the changes, the best explanation first; the best ones are refitted where they are
        too far for first-order tests.
        """
        first = self.scores[0].change
        places = self.lineup.places[first]
        step = self.evidence.estimate(places, self.lineup.changes[first].belief)
        shift = self.lineup.motion(self.values)[:, :, places] @ step
        if np.linalg.norm(shift, axis=1).max() <= _LINEAR:
            return self.scores
        tried = (self._tried(score) for score in self.scores[:_MOST_TRIED])
        return sorted(tried, key=lambda score: score.cost)

    def _tried(self, score: ChangeScore) -> ChangeScore:
        if self.lineup.changes[score.change].belief is not None:
            return score
        released = [*self._released, score.change]
        values = self.lineup.release(released, self.values)
        here = self.evidence.form
        (square, degrees) = self.lineup.square_given(values, released)
        return self._score(score.change, here.square - square, int(here.degrees - degrees))

    def after(self, step: NamedChange | int) -> ChangeVerdict:
        """Return the state with a change, or an unmodelled effect, released; or without a wrong
        row.
        """
        if not isinstance(step, NamedChange):
            return self.without(step)
        k = step.score.change
        values = self.lineup.release([*self._released, k], self.values)
        found = replace(self, values=values, p_first=self.p_value)
        if self.lineup.changes[k].effect is None or not self._was_there_before(step.score):
            return replace(found, steps=(*self.steps, step))
        return replace(found, unmodelled=(*self.unmodelled, k))

    def _was_there_before(self, score: ChangeScore) -> bool:
        """Return whether an effect was rather present at the calibration, but not modelled.

        Then it was part of what the calibration estimated as noise, and the residuals without it
        are smaller than that: the likelihood with the noise reduced by it is compared with the
        likelihood with the noise unchanged.
        """
        n = max(self.evidence.form.degrees - score.rank, 1)
        rest = self.evidence.form.square - score.gain
        part = (score.gain - score.rank) / n
        if not 0.0 < part < DIAGNOSIS.part_of_noise:
            return False
        return bool(rest / (1.0 - part) + n * np.log(1.0 - part) < rest)

    def without_vanished(self) -> ChangeVerdict:
        """Return the state without changes that, given all the others, are within their own
        uncertainty.
        """
        if len(self.steps) < 2:
            return self
        chances = self._chances()
        weakest = int(np.argmax(chances))
        if chances[weakest] <= DIAGNOSIS.vanished:
            return self
        steps = tuple(step for k, step in enumerate(self.steps) if k != weakest)
        state = replace(self, steps=steps)
        values = self.lineup.release(state._released, self.values)
        return replace(state, values=values).without_vanished()

    def _chances(self) -> list[float]:
        """Return the probability of each change as large, given all others, by its own uncertainty
        alone.
        """
        found = self.lineup.reidentify(self.happened, self.values)
        free = self.lineup.free(self.happened)
        chances = []
        for step in self.steps:
            k = step.score.change
            if self.lineup.changes[k].belief is not None:
                # The values of a curve are not compared with their uncertainty one by one.
                chances.append(0.0)
                continue
            at = np.searchsorted(free, self.lineup.places[k])
            covariance = found.of_changes[np.ix_(at, at)]
            root = root_of_inverse(covariance, np.diag(covariance), ROUNDING)
            square = float(np.sum((root.T @ found.changes[at]) ** 2))
            chances.append(float(chdtrc(root.shape[1], square)))
        return chances

    def without(self, row: int | np.ndarray) -> ChangeVerdict:
        """Return the state without one or some rows."""
        lineup = self.lineup.without(row)
        wrong = (*self.wrong_rows, *np.atleast_1d(self.rows[row]).tolist())
        values = lineup.release(self._released, self.values)
        return replace(
            self, lineup=lineup, values=values, rows=np.delete(self.rows, row), wrong_rows=wrong
        )
