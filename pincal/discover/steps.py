"""The steps of a search: where it stands, what it went through, and forward: what explains most of what is left enters."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np

from pincal.discover.candidate_tests import Search, choose, has_compliance, hidden_wave, is_small_table, named_tests
from pincal.discover.decisions import Decision, standard_errors
from pincal.discover.drive_curves import resolved
from pincal.discover.elastic import elastic_way, likeliest_fit
from pincal.discover.first_order import ScoreResult, ScoreTests
from pincal.discover.levers import missing_compliances
from pincal.discover.policy import TESTING, Policy
from pincal.discover.score_tests import score_test, score_test_given_nuisances
from pincal.identify.calibrate import Tolerance, refit
from pincal.identify.choices import required_features
from pincal.identify.fit import ModelFit
from pincal.identify.selection import Scored, select_stepwise
from pincal.identify.station import Station
from pincal.model.effect import Effect, ExponentialDrift, Family
from pincal.model.effects import Compliance
from pincal.validate.gathered import bump_in, gathering_of

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class SearchStep:
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
    """A change of the model on the way from the first fit to the last.

    Attributes:
        fit: the fit after it.
        entered, left: the effects that came in and went out; neither where all was only fitted again.
    """

    fit: ModelFit
    entered: tuple[Effect, ...] = ()
    left: tuple[Effect, ...] = ()


@dataclass(frozen=True)
class SearchState:
    """Where a discovery stands: the model so far, what was accepted, in order, and every change on the way."""

    fit: ModelFit
    steps: tuple[SearchStep, ...] = ()
    changes: tuple[ModelChange, ...] = ()

    def changed(
        self, fit: ModelFit, steps: tuple[SearchStep, ...], entered: tuple[Effect, ...], left: tuple[Effect, ...]
    ) -> Self:
        """Return the state after a change of the model, which is told."""
        return replace(self, fit=fit, steps=steps, changes=(*self.changes, ModelChange(fit, entered, left)))

    def with_step(self, step: SearchStep) -> SearchState:
        """Return the state with one more step."""
        return self.changed(step.after, (*self.steps, step), step.effects, ())

    def with_replaced(self, step: SearchStep, by: SearchStep) -> SearchState:
        """Return the state with another step in the place of one."""
        return replace(self, steps=tuple(by if other is step else other for other in self.steps))

    def tuned(self, step: SearchStep, by: SearchStep) -> SearchState:
        """Return the state with the wave of one step in another order, close by: told as if it had come in so."""
        told = (replace(c, entered=tuple(by.effect if e is step.effect else e for e in c.entered)) for c in self.changes)
        found = (replace(by, before=step.before, after=step.after) if other is step else other for other in self.steps)
        return replace(self, steps=tuple(found), changes=tuple(told)).fitted_again(by.after)

    def fitted_again(self, fit: ModelFit) -> Self:
        """Return the state with another fit of the same model: told as if it had been the first."""
        changes = tuple(replace(change, fit=fit) if change.fit is self.fit else change for change in self.changes)
        steps = tuple(replace(step, after=fit) if step.after is self.fit else step for step in self.steps)
        return replace(self, fit=fit, steps=steps, changes=changes)

    def without_step(self, step: SearchStep) -> SearchState:
        """Return the state without one of its steps."""
        return replace(self, steps=tuple(other for other in self.steps if other is not step))


@dataclass(frozen=True)
class History(SearchState):
    """What a discovery went through: the state at its end, and where it began.

    Attributes:
        first: the fit that it started from.
        extra: effects of the user's own that took part.
        policy: thresholds and limits.
    """

    first: ModelFit = field(kw_only=True)
    extra: tuple[Effect, ...] = field(kw_only=True)
    policy: Policy = field(kw_only=True)

    @property
    def final(self) -> ModelFit:
        """The fit of everything that stayed."""
        return self.fit

    @property
    def is_held_up(self) -> bool:
        """Whether elasticity is in the model by what is known beforehand, too, and not by its name alone."""
        named = [effect for step in self.steps for effect in step.effects]
        return any(isinstance(e, Compliance) and e not in named for change in self.changes for e in change.entered)

    @cached_property
    def last(self) -> ScoreTests:
        """The tests against the final fit, none of which passed."""
        return named_tests(self.final, self.extra, self.policy)


def add_effects(state: SearchState, search: Search) -> SearchState:
    """Add what explains most of what is left, until that is no more than chance.

    What the data call for of the bearings enters once no name explains more: before, it would take up what drives do.
    """

    def offers(state: SearchState) -> Iterator[Scored[SearchStep | tuple[Effect, ...]]]:
        step = _next_step(state.fit, search)
        gain = 0.0 if step is None else step.score.gain
        if step is not None:
            yield Scored(step, -gain)
        called = required_features(state.fit, gain)
        if called.gain > gain and (features := _that_predict(state.fit, called.effects, search)):
            yield Scored(features, -called.gain)

    def taken(state: SearchState, found: SearchStep | tuple[Effect, ...]) -> SearchState:
        if isinstance(found, SearchStep):
            residuals = (1e3 * float(fit.solution.estimated[0]) for fit in (found.before, found.after))
            log.info("found %s: residual %.4f -> %.4f mm", worded(found.effects), *residuals)
            return _trusting_what_gathers(state.with_step(found))
        log.info("bearings: %s", worded(found))
        fit = refit(state.fit, [*state.fit.options.effects, *found], start={}, until=Tolerance.CLOSE)
        return _trusting_what_gathers(state.changed(fit, state.steps, found, ()))

    return select_stepwise(_trusting_what_gathers(state), offers, taken, most=search.policy.most_steps)


def _trusting_what_gathers(state: SearchState) -> SearchState:
    """Return the state in which what is off in one place of a joint counts: it may be what is looked for."""
    fit, stations = state.fit, list[Station]()
    for station, places, _ in fit.stations:
        rows = fit.problem.rows[len(stations)]
        rejected = fit.solution.weights[rows] == 0.0
        for found in (gathering_of(station, rejected), bump_in(station, fit.values[places])):
            if found is None or found.variable == "line":
                continue
            trusted = np.zeros(len(station), bool) if station.trusted is None else station.trusted.copy()
            trusted[found.rows] = True
            if station.trusted is None or (trusted != station.trusted).any():
                log.info("%d rows gather at %s and count from now on", len(found.rows), found.variable)
                station = replace(station, trusted=trusted)
        stations.append(station)
    if all(a is b for a, b in zip(stations, fit.problem.stations, strict=True)):
        return state
    return state.fitted_again(refit(fit.over(stations), fit.options.effects, start={}, until=Tolerance.CLOSE))


def judge_outliers_again(state: SearchState, search: Search) -> SearchState:
    """Leave out again what counted because it gathered, if the model does not describe it in the end."""
    fit = state.fit
    if all(station.trusted is None for station in fit.problem.stations):
        return state
    untrusting = fit.over(replace(station, trusted=None) for station in fit.problem.stations)
    return state.fitted_again(refit(untrusting, fit.options.effects, start={}))


def hold_up_elasticity(state: SearchState, search: Search) -> SearchState:
    """Let in, on few rows, the elasticity that has no name, unless blocks of poses left out speak against it.

    Few rows can't show that an arm bends, and every arm does: what is known beforehand of how much predicts better than that
    it does not, and intervals without it would be those of a rigid arm.
    """
    fit = state.fit
    missing = () if has_compliance(search.first.problem.effects) else missing_compliances(fit)
    if not missing or not is_small_table(fit, search.policy):
        return state
    tests = score_test_given_nuisances(fit, missing, search.groups, wider=1.0)
    if standard_errors(tests.gains_by_block(range(len(missing)))) < -TESTING.against:
        return state
    log.info("few rows: held by priors, %s", worded(missing))
    if len(search.frames) > 1:
        after = likeliest_fit(fit, missing, search.frames)
    else:
        after = refit(fit, [*fit.options.effects, *missing], start={}, until=Tolerance.CLOSE)
    return state.changed(after, state.steps, missing, ())


def _that_predict(fit: ModelFit, features: Sequence[Effect], search: Search) -> tuple[Effect, ...]:
    """Return those of some features of bearings without which blocks of poses left out are predicted worse."""
    if not features:
        return ()
    tests, found, gains = score_test(fit, features, search.groups, wider=1.0), list[int](), 0.0
    for i in range(len(features)):
        beside = float(tests.gains_by_block([*found, i]).sum())
        if beside > gains:
            found, gains = [*found, i], beside
    return tuple(features[i] for i in found)


def add_hidden_waves(state: SearchState, search: Search) -> SearchState:
    """Add the waves that show once curves are as fine as the rows tell.

    Of more rows than effects are chosen by, all are fitted once and nothing is added after it.
    """
    if len(search.groups) < len(state.fit.problem):
        return state

    def offers(state: SearchState) -> Iterator[Scored[SearchStep]]:
        if (found := hidden_wave(state.fit, search)) is not None:
            log.info("found %s behind the curves", worded(found.effects))
            yield Scored(decided(state.fit, found, search, until=Tolerance.SETTLED), found.row.cost)

    return select_stepwise(state, offers, SearchState.with_step, most=search.policy.most_steps)


def _next_step(fit: ModelFit, search: Search) -> SearchStep | None:
    # Elasticity that the user gave is not for a discovery to complete.
    way = None if has_compliance(search.first.problem.effects) else elastic_way(fit, search.policy)
    if way is not None:
        return bent(fit, way)
    decision = choose(fit, search)
    return None if decision is None else decided(fit, decision, search)


def bent(fit: ModelFit, way: Decision, after: ModelFit | None = None) -> SearchStep:
    """Return the step that adds compliances, to the fit with them if it is known."""
    after = refit(fit, [*fit.options.effects, *way.effects]) if after is None else after
    return SearchStep(way.effects, way.row.score, way.equivalent, fit, after, way.effect, np.zeros(0))


def decided(fit: ModelFit, decision: Decision, search: Search, until: Tolerance = Tolerance.CLOSE) -> SearchStep:
    """Return the step that adds what was decided, a curve as fine as the data can tell."""
    tested = decision.effect
    effect, start, estimate = resolved(fit, tested, search.groups)
    after = refit(fit, [*fit.options.effects, effect], start={effect: start}, until=until)
    if isinstance(effect, ExponentialDrift):
        # What is left of its time constant is found once nothing else is missing.
        after, effect = linearised_about_itself(after, effect, until)
    return SearchStep((effect,), decision.row.score, decision.equivalent, fit, after, tested, estimate, decision.together)


def worded(effects: Sequence[Effect]) -> str:
    """Return effects in words, for the log."""
    return ", ".join(" ".join(filter(None, effect.heading[:2])) for effect in effects)


def linearised_about_itself(
    fit: ModelFit, effect: ExponentialDrift, until: Tolerance = Tolerance.SETTLED
) -> tuple[ModelFit, ExponentialDrift]:
    """Return a fit in which an effect stands linearised about its own parameters, and the effect."""
    for _ in range(TESTING.expansions):
        values = fit.values[fit.problem.places_at(effect)]
        about = effect.about(values)
        if about == effect:
            break
        start = np.zeros(len(values))
        start[0] = values[0]
        others = [other for other in fit.options.effects if other != effect]
        fit, effect = refit(fit, [*others, about], start={about: start}, until=until), about
    return fit, effect


def settle(state: SearchState, search: Search) -> SearchState:
    """Linearise each effect with a time constant about its parameters as they are beside all others."""
    for step in state.steps:
        for effect in step.effects:
            if isinstance(effect, ExponentialDrift):
                fit, about = linearised_about_itself(state.fit, effect)
                steps = tuple(replace(s, effects=(about,)) if s is step else s for s in state.steps)
                state = state if about == effect else state.changed(fit, steps, (), ())
    return state
