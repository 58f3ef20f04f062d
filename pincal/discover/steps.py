"""The state and history of a search, and its forward passes."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np

from pincal.discover.candidate_tests import (
    Search,
    choose,
    has_compliance,
    hidden_wave,
    is_small_table,
    named_tests,
)
from pincal.discover.decisions import Decision, standard_errors
from pincal.discover.drive_curves import resolved
from pincal.discover.elastic import elastic_way, likeliest_fit
from pincal.discover.first_order import ScoreResult, ScoreTests
from pincal.discover.levers import missing_compliances
from pincal.discover.policy import Policy
from pincal.discover.score_numbers import TESTING
from pincal.discover.score_tests import score_test, score_test_given_nuisances
from pincal.identify.arrivals import with_arrivals
from pincal.identify.calibrate import Tolerance, refit
from pincal.identify.choices import deviance, required_features
from pincal.identify.fit import ModelFit
from pincal.identify.selection import Scored, select_stepwise
from pincal.identify.station import Station
from pincal.model.effect import Effect, ExponentialDrift, Family
from pincal.model.effects import Compliance
from pincal.thresholds import Scale
from pincal.validate.gathered import bump_in, gathering_of

# Reduction of the deviance that no test resolves: a fit that others follow needs no further
# expansion of what brought no more.
_HARDLY: Scale = 1.0

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class SearchStep:
    """Effects that entered the model together.

    Attributes:
        effects: the effects; the first gives the step its name.
        score: the test against the model before.
        equivalent: candidates that the data can't distinguish from it.
        before, after: the fits without and with it.
        tested: the effect as tested; a curve may be finer in the end.
        estimate: its parameters by this test, shape (K,).
        together: effects that only together explain the data as well.
    """

    effects: tuple[Effect, ...]
    score: ScoreResult
    equivalent: tuple[Effect, ...]
    before: ModelFit
    after: ModelFit
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
class ModelChange:
    """A change of the model: the fit after it, and the effects that entered and left; none for a
    mere refit.
    """

    fit: ModelFit
    entered: tuple[Effect, ...] = ()
    left: tuple[Effect, ...] = ()


@dataclass(frozen=True)
class SearchState:
    """State of a discovery: the present model, accepted steps in order, and all changes so far."""

    fit: ModelFit
    steps: tuple[SearchStep, ...] = ()
    changes: tuple[ModelChange, ...] = ()

    def changed(
        self,
        fit: ModelFit,
        steps: tuple[SearchStep, ...],
        entered: tuple[Effect, ...],
        left: tuple[Effect, ...],
    ) -> Self:
        """Return the state after a recorded change of the model."""
        return replace(
            self, fit=fit, steps=steps, changes=(*self.changes, ModelChange(fit, entered, left))
        )

    def with_step(self, step: SearchStep) -> SearchState:
        """Return the state with one more step."""
        return self.changed(step.after, (*self.steps, step), step.effects, ())

    def with_replaced(self, step: SearchStep, by: SearchStep) -> SearchState:
        """Return the state with a step replaced by another."""
        return replace(self, steps=tuple(by if other is step else other for other in self.steps))

    def tuned(self, step: SearchStep, by: SearchStep) -> SearchState:
        """Return the state with the wave of one step at another order close by, recorded as if it
        had entered so.
        """
        changes = [
            replace(c, entered=tuple(by.effect if e is step.effect else e for e in c.entered))
            for c in self.changes
        ]
        state = self.with_replaced(step, replace(by, before=step.before, after=step.after))
        return replace(state, changes=tuple(changes)).fitted_again(by.after)

    def fitted_again(self, fit: ModelFit) -> Self:
        """Return the state with another fit of the same model, recorded as if it had been the
        first.
        """
        changes = tuple(
            replace(change, fit=fit) if change.fit is self.fit else change
            for change in self.changes
        )
        steps = tuple(
            replace(step, after=fit) if step.after is self.fit else step for step in self.steps
        )
        return replace(self, fit=fit, steps=steps, changes=changes)

    def without_step(self, step: SearchStep) -> SearchState:
        """Return the state without one of its steps."""
        return replace(self, steps=tuple(other for other in self.steps if other is not step))


@dataclass(frozen=True)
class History(SearchState):
    """The final state of a discovery, with its start.

    Attributes:
        first: the fit that it started from.
        extra: candidate effects of the user.
        policy: thresholds and limits.
    """

    first: ModelFit = field(kw_only=True)
    extra: tuple[Effect, ...] = field(kw_only=True)
    policy: Policy = field(kw_only=True)

    @property
    def final(self) -> ModelFit:
        """The final fit."""
        return self.fit

    @property
    def has_prior_elasticity(self) -> bool:
        """Whether the model has elasticity that entered on priors, without a name."""
        named = [effect for step in self.steps for effect in step.effects]
        return any(
            isinstance(e, Compliance) and e not in named
            for change in self.changes
            for e in change.entered
        )

    @cached_property
    def last(self) -> ScoreTests:
        """The tests of all named candidates against the final fit."""
        return named_tests(self.final, self.extra, self.policy)


def add_effects(state: SearchState, search: Search) -> SearchState:
    """Add the effect that explains most of the residuals, until none is accepted.

    Bearing features that the data require enter once no name explains more, as they would absorb
    effects of drives.
    """

    def offers(state: SearchState) -> Iterator[Scored[SearchStep | tuple[Effect, ...]]]:
        step = _next_step(state.fit, search)
        gain = 0.0 if step is None else step.score.gain
        if step is not None:
            yield Scored(step, -gain)
        called = required_features(state.fit, gain)
        if called.gain > gain and (features := _predicting(state.fit, called.effects, search)):
            yield Scored(features, -called.gain)

    def taken(state: SearchState, found: SearchStep | tuple[Effect, ...]) -> SearchState:
        if isinstance(found, SearchStep):
            residuals = (
                1e3 * float(fit.solution.estimated[0]) for fit in (found.before, found.after)
            )
            log.info("found %s: residual %.4f -> %.4f mm", listed(found.effects), *residuals)
            return settled(state.with_step(found))
        log.info("bearings: %s", listed(found))
        fit = refit(
            state.fit, [*state.fit.options.effects, *found], start={}, until=Tolerance.CLOSE
        )
        return settled(state.changed(fit, state.steps, found, ()))

    return select_stepwise(_trusting_clusters(state), offers, taken, most=search.policy.most_steps)


def settled(state: SearchState) -> SearchState:
    """Return the state after a step, with rows weighted, and outliers trusted, as the new residuals
    show.
    """
    return _trusting_clusters(_weighted_by_stops(state))


def _weighted_by_stops(state: SearchState) -> SearchState:
    """Return the state in which readings of a stop share what the present model leaves of it."""
    found = with_arrivals(state.fit)
    if found is state.fit:
        return state
    return state.fitted_again(refit(found, found.options.effects, start={}, until=Tolerance.CLOSE))


def _trusting_clusters(state: SearchState) -> SearchState:
    """Return the state in which outliers that cluster along a joint count, as they may be an
    effect.
    """
    fit = state.fit
    stations = list[Station]()
    for station, places, _ in fit.stations:
        rows = fit.problem.rows[len(stations)]
        rejected = fit.solution.weights[rows] == 0.0
        for found in (gathering_of(station, rejected), bump_in(station, fit.values[places])):
            if found is None or found.variable == "line":
                continue
            trusted = (
                np.zeros(len(station), bool) if station.trusted is None else station.trusted.copy()
            )
            trusted[found.rows] = True
            if station.trusted is None or (trusted != station.trusted).any():
                log.info(
                    "%d rows cluster at %s and are included from now on",
                    len(found.rows),
                    found.variable,
                )
                station = replace(station, trusted=trusted)
        stations.append(station)
    if all(a is b for a, b in zip(stations, fit.problem.stations, strict=True)):
        return state
    return state.fitted_again(
        refit(fit.over(stations), fit.options.effects, start={}, until=Tolerance.CLOSE)
    )


def reject_outliers_again(state: SearchState, search: Search) -> SearchState:
    """Reject clustered outliers again if the final model does not describe them."""
    fit = state.fit
    if all(station.trusted is None for station in fit.problem.stations):
        return state
    untrusting = fit.over(replace(station, trusted=None) for station in fit.problem.stations)
    until = search.until(Tolerance.SETTLED)
    return state.fitted_again(refit(untrusting, fit.options.effects, start={}, until=until))


def add_prior_elasticity(state: SearchState, search: Search) -> SearchState:
    """Add unnamed elasticity on few rows, unless held-out blocks contradict it.

    Few rows can't show that an arm is compliant, as every arm is: its prior predicts better than a
    rigid model, whose intervals would be too narrow.
    """
    fit = state.fit
    missing = () if has_compliance(search.first.problem.effects) else missing_compliances(fit)
    if not missing or not is_small_table(fit, search.policy):
        return state
    tests = score_test_given_nuisances(fit, missing, search.groups, wider=1.0)
    if standard_errors(tests.gains_by_block(range(len(missing)))) < -TESTING.against:
        return state
    log.info("few rows: held by priors, %s", listed(missing))
    if len(search.frames) > 1:
        after = likeliest_fit(fit, missing, search.frames)
    else:
        after = refit(fit, [*fit.options.effects, *missing], start={}, until=Tolerance.CLOSE)
    return state.changed(after, state.steps, missing, ())


def _predicting(fit: ModelFit, features: Sequence[Effect], search: Search) -> tuple[Effect, ...]:
    """Return the bearing features that improve the prediction of held-out blocks."""
    if not features:
        return ()
    tests = score_test(fit, features, search.groups, wider=1.0)
    found = list[int]()
    gains = 0.0
    for i in range(len(features)):
        gain = float(tests.gains_by_block([*found, i]).sum())
        if gain > gains:
            found = [*found, i]
            gains = gain
    return tuple(features[i] for i in found)


def add_hidden_waves(state: SearchState, search: Search) -> SearchState:
    """Add waves that are significant once curves have their final resolution.

    Not where effects are selected on a sample of the rows, as all rows are fitted only once.
    """
    if len(search.groups) < len(state.fit.problem):
        return state
    until = search.until(Tolerance.SETTLED)

    def offers(state: SearchState) -> Iterator[Scored[SearchStep]]:
        if (found := hidden_wave(state.fit, search)) is not None:
            log.info("found %s as the cause of the curves", listed(found.effects))
            yield Scored(named_step(state.fit, found, search, until=until), found.row.cost)

    return select_stepwise(state, offers, SearchState.with_step, most=search.policy.most_steps)


def _next_step(fit: ModelFit, search: Search) -> SearchStep | None:
    # Elasticity given by the user is not extended.
    is_given = has_compliance(search.first.problem.effects)
    way = None if is_given else elastic_way(fit, search.policy, search.tests_of(fit))
    if way is not None:
        return elastic_step(fit, way)
    decision = choose(fit, search)
    return None if decision is None else named_step(fit, decision, search)


def elastic_step(fit: ModelFit, way: Decision, after: ModelFit | None = None) -> SearchStep:
    """Return the step that adds compliances, with the fit after it if known."""
    after = refit(fit, [*fit.options.effects, *way.effects]) if after is None else after
    return SearchStep(
        way.effects, way.row.score, way.equivalent, fit, after, way.effect, np.zeros(0)
    )


def named_step(
    fit: ModelFit, decision: Decision, search: Search, until: Tolerance = Tolerance.CLOSE
) -> SearchStep:
    """Return the step that adds the effect of a decision, in the resolution that the data
    determine.
    """
    tested = decision.effect
    effect, start, estimate = resolved(search.tests_of(fit), tested, search.groups)
    after = refit(fit, [*fit.options.effects, effect], start={effect: start}, until=until)
    if isinstance(effect, ExponentialDrift):
        # The time constant is refined once nothing else is missing.
        after, effect = linearised_about_itself(after, effect, until)
    return SearchStep(
        (effect,),
        decision.row.score,
        decision.equivalent,
        fit,
        after,
        tested,
        estimate,
        decision.together,
    )


def listed(effects: Sequence[Effect]) -> str:
    """Return the names and joints of effects, as a list in words."""
    return ", ".join(" ".join(filter(None, effect.heading[:2])) for effect in effects)


def linearised_about_itself(
    fit: ModelFit, effect: ExponentialDrift, until: Tolerance = Tolerance.SETTLED
) -> tuple[ModelFit, ExponentialDrift]:
    """Return a fit with an effect linearised about its own parameters, and this effect.

    A fit that others follow needs no expansion that hardly explains more. Where rows tell little of
    a time constant, it may swing about its best value.
    """
    for _ in range(TESTING.expansions):
        values = fit.values[fit.problem.places_at(effect)]
        about = effect.about(values)
        if about == effect:
            break
        start = np.zeros(len(values))
        start[0] = values[0]
        before = fit
        others = [other for other in fit.options.effects if other != effect]
        fit = refit(fit, [*others, about], start={about: start}, until=until)
        # Without a parameter for its time constant it has not moved yet.
        has_moved = len(values) > 1
        effect = about
        if until is Tolerance.CLOSE and has_moved and deviance(before) - deviance(fit) < _HARDLY:
            break
    return fit, effect


def refine_time_constants(state: SearchState, search: Search) -> SearchState:
    """Linearise each effect with a time constant about its final parameters."""
    for step in state.steps:
        for effect in step.effects:
            if isinstance(effect, ExponentialDrift):
                until = search.until(Tolerance.SETTLED)
                fit, about = linearised_about_itself(state.fit, effect, until)
                steps = tuple(replace(s, effects=(about,)) if s is step else s for s in state.steps)
                state = state if about == effect else state.changed(fit, steps, (), ())
    return state
