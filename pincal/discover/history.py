"""What a discovery went through: its steps, where it stands, and its end."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pincal.discover.score_tests import Score, ScoreTests
from pincal.identify.fit import Fit
from pincal.model.effect import Effect, Family


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
    """

    effects: tuple[Effect, ...]
    score: Score
    equivalent: tuple[Effect, ...]
    before: Fit
    after: Fit
    tested: Effect
    estimate: np.ndarray

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
    """Where a discovery stands: the model so far, and what was accepted, in order."""

    fit: Fit
    steps: tuple[Step, ...] = ()

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
        last: the tests against the final fit, none of which passed.
    """

    first: Fit
    steps: tuple[Step, ...]
    final: Fit
    last: ScoreTests
