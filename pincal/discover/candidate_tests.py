"""From a fit to a table of candidates: what may be added, tested against what the model leaves."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from pincal.discover.decisions import CandidateTable, Decision, Row, decide, each_heading_once
from pincal.discover.maps import likely_maps
from pincal.discover.nuisance import BesideNuisances, missing_compliances, score_test_beside_nuisances, situation_of
from pincal.discover.policy import Policy
from pincal.discover.score_tests import ScoreTests, enough_errors, standard_errors
from pincal.discover.tones import strongest_tones
from pincal.discover.uneven import p_value_of_uneven_noise
from pincal.identify.fit import Fit
from pincal.identify.station import Station
from pincal.model.at_station import changed_effects, own_effects
from pincal.model.catalogue.bearings import bearing_features
from pincal.model.catalogue.candidates import testable
from pincal.model.catalogue.unnamed import nameless_candidates
from pincal.model.chain import MomentFrame
from pincal.model.conditions import Conditions, Situation
from pincal.model.effect import Candidate, Effect, Family, Settling, Tone
from pincal.model.effects import Compliance
from pincal.model.latest import Latest

# Times that an effect with a time constant is linearised anew to be tested.
_MOST_EXPANSIONS = 4
# Some of the rows of tables: their conditions by the table's.
_SAMPLES = Latest[Conditions](16)


@dataclass(frozen=True)
class Search:
    """What a discovery looks for, the same from its beginning to its end.

    Attributes:
        policy: what to go by.
        extra: effects of the user's own, which take part like those of the catalogue.
        first: the fit to start from, all rows of it.
        groups: shape (N,), those of the rows from which effects are chosen.
        frames: conventions of where moments bend the arm to choose from.
        nameless: identities of the dependences without a name that take part; default: all.
    """

    policy: Policy
    extra: tuple[Effect, ...]
    first: Fit
    groups: np.ndarray
    frames: tuple[MomentFrame, ...] = ()
    nameless: Collection[object] | None = None


class Test(Protocol):
    """Tests candidates against a fit, masses projected out, perhaps block of rows by block."""

    def __call__(self, effects: Sequence[Effect], groups: np.ndarray | None = None, /) -> ScoreTests:
        """Return the tests of candidates; ``groups``, shape (N,), the block of each row."""


def choose(fit: Fit, search: Search) -> Decision | None:
    """Return the best explanation of what a fit leaves, if it is more than chance."""
    test, every = BesideNuisances(fit), addable(fit, search)
    names = table_of(fit, search, test, every)
    best = next((names.rows[i].effect for i in names.passed()), None)
    if isinstance(best, Settling) and (about := _about_itself(best, test)) != best:
        names = table_of(fit, search, test, [*every, about])
    return explanation(fit, search, test, names)


def _about_itself(effect: Settling, test: Test) -> Settling:
    """Return an effect with a time constant linearised about what it is estimated to be.

    About another constant it leaves what a curve of the time describes, which would pass for better where many rows tell.
    """
    for _ in range(_MOST_EXPANSIONS):
        about = effect.about(test([effect]).estimate([0]))
        if about == effect:
            break
        effect = about
    return effect


def explanation(
    fit: Fit, search: Search, test: Test, names: CandidateTable, *, predicting: Effect | None = None
) -> Decision | None:
    """Return the same, given the table of all that may be added by name, and what is known to predict."""

    def contest_of(close: Sequence[Row]) -> CandidateTable:
        nameless = nameless_beside(fit, [row.effect for row in close], search)
        together = [*(row.effect for row in close), *nameless]
        costs = {id(row.effect): row.cost for row in close}
        return table_of(fit, search, test, together, costs, predicting=predicting) if nameless else names

    decision = decide(names, contest_of, search.policy)
    if decision is None or not decision.effect.is_nameless:
        return decision
    return _with_neighbours(decision, fit, search, test)


def hidden_wave(fit: Fit, search: Search) -> tuple[Decision, np.ndarray] | None:
    """Return the wave that chance does not explain among all names, judged as in any other step, and its estimate.

    Coarser curves leave more than noise, which hides waves that blocks left out tell only by little.
    """
    test, every = BesideNuisances(fit), addable(fit, search)
    waves: list[Effect] = [effect for effect in every if isinstance(effect, Tone)]
    if not waves:
        return None
    tests, names = test(waves), len({effect.identity for effect in every})
    least, scores = _least(fit, tests, search.policy), [tests.score([i], names) for i in range(len(waves))]
    pairs = zip(waves, scores, strict=True)
    sure = [wave for wave, s in pairs if s.p_value < search.policy.false_name / names and s.gain >= least]
    table = table_of(fit, search, test, sure) if sure else None
    found = None if table is None else decide(table, lambda _: table, search.policy)
    return None if found is None else (found, tests.estimate([waves.index(found.effect)]))


def _with_neighbours(decision: Decision, fit: Fit, search: Search, test: Test) -> Decision:
    """Return a decision for what has no name with its likes on the joints beside it, which may not have taken part.

    A joint that turns is nearly one whose neighbour tilts, if that follows the same variable.
    """
    effect, chain = decision.effect, fit.problem.chain
    at, names = effect.locus, list(chain.robot.joint_names)
    if at.joint not in names:
        return decision
    i = names.index(at.joint)
    beside = nameless_candidates(chain, fit.problem.conditions, names[max(i - 1, 0) : i] + names[i + 1 : i + 2])
    alike = [e for e in beside if (e.locus.follows, e.locus.shape, e.locus.order) == (at.follows, at.shape, at.order)]
    present = {other.identity for other in fit.problem.effects}
    every = [effect, *(e for e in alike if e.identity not in present)]
    rivals = table_of(fit, search, test, every, {id(effect): decision.row.cost}).rivals(0, search.policy)
    return replace(decision, equivalent=each_heading_once([*decision.equivalent, *rivals], effect, search.policy))


def table_of(
    fit: Fit,
    search: Search,
    test: Test,
    effects: Sequence[Effect],
    costs: Mapping[int, float] | None = None,
    *,
    predicting: Effect | None = None,
) -> CandidateTable:
    """Return the table of candidates, named and nameless ones; each kind shares the chance of a false name.

    Args:
        fit: the fit.
        search: what is looked for.
        test: tests candidates against the fit.
        effects: the candidates.
        costs: of candidates, by their identity, that are known already.
        predicting: what is taken to predict rows left out, without being asked.
    """
    policy, costs = search.policy, costs or {}
    # Blocks of rows would take as many times the memory, so they wait for the few of which it is asked what they predict.
    is_small = is_small_table(fit, policy)
    spare = spare_compliances(fit, effects, policy)
    tests = test([*effects, *spare])
    count = {kind: len({e.identity for e in effects if e.is_nameless == kind}) for kind in (False, True)}
    rows = []
    for i, effect in enumerate(effects):
        n = count[effect.is_nameless]
        given = range(len(effects), len(effects) + len(spare)) if effect.is_of_loads else range(0)
        score, limit = tests.score_given([i], given, n) if given else tests.score([i], n), policy.false_name / n
        # Asked only where chance does not explain the candidate anyway.
        if is_small and score.p_value < limit:
            evidence = tests.log_evidence([i, *given]) - tests.log_evidence(given) if given else tests.log_evidence([i])
            limit = 0.0 if evidence < -np.log(limit) else limit
        rows.append(Row(effect, score, costs.get(id(effect), score.ebic + _surcharge(effect, policy)), limit))

    def predicts(i: int) -> bool:
        if predicting is not None and effects[i].identity == predicting.identity:
            return True
        left_out = test([effects[i]], search.groups)
        if standard_errors(left_out.gains_by_block([0])) <= enough_errors(effects[i]):
            return False
        return p_value_of_uneven_noise(fit, left_out) < rows[i].limit

    return CandidateTable(
        rows,
        _least(fit, tests, policy),
        left_given=lambda i, given: tests.score_given([i], [given]).p_value,
        cost_together=lambda i, other: tests.score([i, other], len(effects)).ebic,
        predicts=predicts,
        left_beside=lambda which, given: tests.score_given(which, given).p_value,
    )


def _least(fit: Fit, tests: ScoreTests, policy: Policy) -> float:
    return policy.least_gain(tests.squares, declared=fit.is_declared)


def spare_compliances(fit: Fit, effects: Sequence[Effect], policy: Policy) -> list[Effect]:
    """Return what else may give way, drives and bearings in all directions, beside which candidates are tested.

    Few rows do not bring in all that gives way, and what loads do beside it would stand for the rest.
    """
    if not is_small_table(fit, policy) or not any(effect.is_of_loads for effect in effects):
        return []
    missing, chain = missing_compliances(fit), fit.problem.chain
    present = {effect.identity for effect in fit.problem.effects}
    bearings = [effect for effect in (*fit.problem.effects, *missing) if isinstance(effect, Compliance)]
    features = [e for e in bearing_features(chain, bearings) if e.uses_moments and e.identity not in present]
    return [*missing, *features]


def is_small_table(fit: Fit, policy: Policy) -> bool:
    """Return whether a table has so few rows for the parameters that they determine that priors decide."""
    return len(fit.problem) < policy.rows_each * fit.solution.effective


def _surcharge(effect: Effect, policy: Policy) -> float:
    """Return by how much an effect has to be better than a name of the catalogue."""
    if not effect.is_nameless:
        return 0.0
    return policy.without_name if effect.locus.acts_on == "drive" else policy.without_name + policy.across


def addable(fit: Fit, search: Search) -> list[Effect]:
    """Return what may be added by name: what the data can test and the model does not have yet."""
    return _addable(fit, search.extra, search.policy)


def named_tests(fit: Fit, extra: Sequence[Effect], policy: Policy, others: Sequence[Effect] = ()) -> ScoreTests:
    """Test all that may be added by name, and others if they are not among them, on the rows that effects are chosen by."""
    few, _ = sampled(fit, policy)
    every = _addable(fit, extra, policy)
    return score_test_beside_nuisances(few, [*every, *(effect for effect in others if effect not in every)])


def _addable(fit: Fit, extra: Sequence[Effect], policy: Policy) -> list[Effect]:
    present = {effect.identity for effect in fit.problem.effects}
    has_loads = has_compliance(fit.problem.effects)
    tested = testable(situation_of(fit))
    tones = strongest_tones(sampled(fit, policy)[0], tested, policy.near_tie)
    every = [*_forms(fit, tested), *_of_stations(fit), *tones, *extra]
    return [e for e in every if e.identity not in present and (has_loads or not e.is_of_loads)]


def _of_stations(fit: Fit) -> Iterator[Effect]:
    """Yield what single stations of several may have by themselves; what changed, from the second one on."""
    stations = fit.problem.stations
    if len(stations) == 1:
        return
    situations = [Situation(station.model.chain, station.conditions) for station in stations]
    tested = [testable(situation) for situation in situations]
    # The instrument may be one and the same at all of them, and errs at each by itself where it is not.
    of_each = [[form for of in candidates for form in of.forms if form.is_sighted] for candidates in tested]
    everywhere = [form for form in of_each[0] if all(form in forms for forms in of_each[1:])]
    yield from everywhere
    for k, station in enumerate(stations):
        yield from (own for own in own_effects(tested[k], station.name) if own.effect not in everywhere)
        yield from changed_effects(fit.problem.effects, situations[k], station.name) if k else ()


def has_compliance(effects: Sequence[Effect]) -> bool:
    """Return whether linear elasticity is among effects."""
    return any(effect.family is Family.ELASTICITY for effect in effects)


def variants(fit: Fit, acts_on: Collection[str] | None = None) -> Iterator[Effect]:
    """Yield what the data can test, or what of it acts in some places, each in the forms that are worth telling apart."""
    return _forms(fit, testable(situation_of(fit), acts_on))


def _forms(fit: Fit, tested: Sequence[Candidate]) -> Iterator[Effect]:
    is_alone = len(fit.problem.stations) == 1
    for candidate in tested:
        # What belongs to a station is looked for at each by itself.
        yield from (form for form in candidate.forms if is_alone or form.scope == "robot")


def nameless_beside(fit: Fit, names: Sequence[Effect], search: Search) -> list[Effect]:
    """Return dependences without a name that take part beside some names, the likeliest first; everywhere beside none.

    On the joint of the likeliest and its neighbours all do; beside any other name what follows the same variable there.
    """
    if search.nameless is not None and not search.nameless:
        return []
    chain, conditions = fit.problem.chain, fit.problem.conditions
    joints = chain.robot.joint_names
    likeliest = names[0].locus.joint if names else None
    at = joints.index(likeliest) if likeliest in joints else None
    near = joints if at is None else joints[max(at - 1, 0) : at + 2]
    likes = {_place(effect) for effect in names if effect.locus.joint in joints and effect.locus.joint not in near}
    beyond = nameless_candidates(chain, conditions, [joint for joint in joints if joint in {of for of, *_ in likes}])
    further = (effect for effect in beyond if _place(effect) in likes)
    every = [*nameless_candidates(chain, conditions, near), *further, *likely_maps(fit, near)]
    present = {effect.identity for effect in fit.problem.effects}
    found = [effect for effect in every if effect.identity not in present]
    return [effect for effect in found if search.nameless is None or effect.identity in search.nameless]


def _place(effect: Effect) -> tuple[str | None, str | None, bool]:
    """Return the joint, the variable, and whether an effect acts about the axis."""
    at = effect.locus
    return at.joint, at.follows, at.acts_on in ("drive", "gamma_z")


def sampled(fit: Fit, policy: Policy) -> tuple[Fit, np.ndarray]:
    """Return a fit on as many of its rows, evenly spread, as are enough to choose what comes next, and these rows."""
    sizes = [sum(block.size for block in station.sensor.blocks) for station in fit.problem.stations]
    n, most = len(fit.problem), policy.enough_readings // max(sizes)
    if n <= most:
        return fit, np.arange(n)
    rows = np.linspace(0, n - 1, most).astype(int)
    few = some_rows(fit, rows)
    triples = zip(fit.problem.stations, few.problem.stations, fit.problem.rows, strict=True)
    # The same objects whenever they are asked for again: what was evaluated at these poses is then known.
    stations = tuple(
        replace(part, conditions=_SAMPLES.of(whole.conditions).setdefault((n, most, span.start), part.conditions))
        for whole, part, span in triples
    )
    return replace(few, problem=replace(few.problem, stations=stations)), rows


def some_rows(fit: Fit, rows: np.ndarray) -> Fit:
    """Return a fit as it is, of some of its rows."""
    solution = replace(fit.solution, weights=fit.solution.weights[rows])
    return replace(fit, problem=fit.problem.select(rows), solution=solution)


def over_rows_of(fit: Fit, whole: Fit) -> Fit:
    """Return a fit of some rows as it is, over all the rows of another one, with their weights."""
    solution = replace(fit.solution, weights=whole.solution.weights)
    pairs = zip(whole.problem.stations, fit.problem.stations, strict=True)
    rows = replace(whole.problem, stations=tuple(_with_noise(of, part) for of, part in pairs))
    return replace(fit, problem=rows, solution=solution)


def _with_noise(station: Station, part: Station) -> Station:
    """Return a station under the model of a part of its rows, with what is known there of noise along them."""
    serial = station.serial
    if serial is not None:
        serial = None if part.serial is None else replace(serial, phi=part.serial.phi, share=part.serial.share)
    return replace(station, model=part.model, serial=serial)
