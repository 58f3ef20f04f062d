"""What a discovery went through: its steps, where it stands, and its end."""

from __future__ import annotations

from dataclasses import dataclass, replace

from pincal.discover.score_tests import Score, ScoreTests
from pincal.identify.fit import Fit
from pincal.model.effect import Effect, Family


@dataclass(frozen=True)
class Step:
    """What entered the model at once.

    Attributes:
        effects: the effects; the first gives the step its name.
        score: its test against the model before.
        equivalent: candidates that the data can't tell from it.
        before: the fit before it entered.
        after: the fit with it.
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

    @property
    def effect(self) -> Effect:
        """The effect that gives it its name."""
        return self.effects[0]

    @property
    def is_elastic(self) -> bool:
        """Whether it is linear elasticity, which every arm has."""
        return self.effect.family is Family.ELASTICITY


@dataclass(frozen=True)
class State:
    """Where a discovery stands.

    Attributes:
        fit: the model so far.
        steps: what was accepted, in order.
    """

    fit: Fit
    steps: tuple[Step, ...] = ()

    def with_step(self, step: Step) -> State:
        """Return the state after a further step."""
        return State(step.after, (*self.steps, step))

    def with_replaced(self, step: Step, by: Step) -> State:
        """Return the state with another step in the place of one."""
        return replace(self, steps=tuple(by if other is step else other for other in self.steps))

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
        last: the criticism of the final fit, nothing of which passed.
    """

    first: Fit
    steps: tuple[Step, ...]
    final: Fit
    last: ScoreTests
