"""What a discovery went through: its steps, where it stands, and its end."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pincal.discover.candidate_tests import named_tests
from pincal.discover.policy import Policy
from pincal.discover.score_tests import Score, ScoreTests
from pincal.identify.fit import Fit
from pincal.model.effect import Effect, Family
from pincal.model.effects import Compliance


@dataclass(frozen=True, eq=False)
class Step:
    """What entered the model at once.

    Attributes:
        effects: the effects; the first gives the step its name.
        score: its test against the model before.
        equivalent: candidates that the data can't tell from it.
        before, after: the fit before it entered, and with it.
        tested: the effect in the form in which it was tested; a curve may be finer in the end.
        estimate: what its parameters were by this test, shape (K,).
        together: effects that together explain the data as well.
    """

    effects: tuple[Effect, ...]
    score: Score
    equivalent: tuple[Effect, ...]
    before: Fit
    after: Fit
    tested: Effect
    estimate: np.ndarray
    together: tuple[Effect, ...] = ()

    @property
    def effect(self) -> Effect:
        """The effect that gives it its name."""
        return self.effects[0]

    @property
    def is_elastic(self) -> bool:
        """Whether it is linear elasticity, which every arm has."""
        return self.effect.family is Family.ELASTICITY


@dataclass(frozen=True, eq=False)
class Change:
    """A change of the model on the way from the first fit to the last.

    Attributes:
        fit: the fit after it.
        entered, left: the effects that came in and went out; neither where all was only fitted again.
    """

    fit: Fit
    entered: tuple[Effect, ...] = ()
    left: tuple[Effect, ...] = ()


@dataclass(frozen=True)
class State:
    """Where a discovery stands: the model so far, what was accepted, in order, and every change on the way."""

    fit: Fit
    steps: tuple[Step, ...] = ()
    changes: tuple[Change, ...] = ()

    def changed(self, fit: Fit, steps: tuple[Step, ...], entered: tuple[Effect, ...], left: tuple[Effect, ...]) -> State:
        """Return the state after a change of the model, which is told."""
        return State(fit, steps, (*self.changes, Change(fit, entered, left)))

    def with_step(self, step: Step) -> State:
        """Return the state with one more step."""
        return self.changed(step.after, (*self.steps, step), step.effects, ())

    def with_replaced(self, step: Step, by: Step) -> State:
        """Return the state with another step in the place of one."""
        return replace(self, steps=tuple(by if other is step else other for other in self.steps))

    def tuned(self, step: Step, by: Step) -> State:
        """Return the state with the wave of one step in another order, close by: told as if it had come in so."""
        told = (replace(c, entered=tuple(by.effect if e is step.effect else e for e in c.entered)) for c in self.changes)
        found = (replace(by, before=step.before, after=step.after) if other is step else other for other in self.steps)
        return State(self.fit, tuple(found), tuple(told)).fitted_again(by.after)

    def fitted_again(self, fit: Fit) -> State:
        """Return the state with another fit of the same model: told as if it had been the first."""
        changes = tuple(replace(change, fit=fit) if change.fit is self.fit else change for change in self.changes)
        steps = tuple(replace(step, after=fit) if step.after is self.fit else step for step in self.steps)
        return State(fit, steps, changes)

    def without_step(self, step: Step) -> State:
        """Return the state without one of its steps."""
        return replace(self, steps=tuple(other for other in self.steps if other is not step))


@dataclass(frozen=True)
class History:
    """What a discovery went through.

    Attributes:
        first: the fit that it started from.
        steps: the accepted effects, in order.
        final: the fit of everything that stayed.
        changes: every change of the model between the two, also what was taken out again.
        extra: effects of the user's own that took part.
        policy: thresholds and limits.
    """

    first: Fit
    steps: tuple[Step, ...]
    final: Fit
    changes: tuple[Change, ...]
    extra: tuple[Effect, ...]
    policy: Policy

    @property
    def is_held_up(self) -> bool:
        """Whether elasticity is in the model by what is known beforehand, too, and not by its name alone."""
        named = [effect for step in self.steps for effect in step.effects]
        return any(isinstance(e, Compliance) and e not in named for change in self.changes for e in change.entered)

    @cached_property
    def last(self) -> ScoreTests:
        """The tests against the final fit, none of which passed."""
        return named_tests(self.final, self.extra, self.policy)
