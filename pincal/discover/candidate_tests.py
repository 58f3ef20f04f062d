"""From a fit to a table of candidates: what may be added, tested against what the model leaves."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pincal.discover.decisions import (
    CandidateTable,
    Decision,
    Row,
    Unfitted,
    decide,
    each_heading_once,
    enough_errors,
    is_more_than_chance,
    standard_errors,
)
from pincal.discover.first_order import ScoreTests
from pincal.discover.levers import likely_maps, missing_compliances, missing_from, situation_of, strongest_tones
from pincal.discover.policy import TESTING, Policy
from pincal.discover.scatter import p_value_of_uneven_noise
from pincal.discover.score_tests import BesideNuisances, score_test_given_nuisances
from pincal.identify.fit import ModelFit
from pincal.identify.station import Station
from pincal.model.at_station import changed_effects, own_effects
from pincal.model.catalogue.bearing_features import bearing_features
from pincal.model.catalogue.candidates import testable
from pincal.model.catalogue.unnamed import nameless_candidates
from pincal.model.chain import MomentFrame
from pincal.model.conditions import PoseSet, part_of
from pincal.model.effect import Candidate, Effect, ExponentialDrift, Family, Harmonic
from pincal.model.effects import Compliance

Tester = Callable[..., ScoreTests]
"""Tests candidates against a fit, masses projected out, perhaps by blocks: takes effects, and the block of each row."""


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
    first: ModelFit
    groups: np.ndarray
    frames: tuple[MomentFrame, ...] = ()
    nameless: Collection[object] | None = None

    def taking_part(self, nameless: Iterable[Effect]) -> list[Effect]:
        """Return those of some dependences without a name that take part."""
        return [effect for effect in nameless if self.nameless is None or effect.identity in self.nameless]


def choose(fit: ModelFit, search: Search) -> Decision | None:
    """Return the best explanation of what a fit leaves, if it is more than chance."""
    test, every = BesideNuisances(fit), addable(fit, search)
    names = table_of(fit, search, test, every)
    best = next((names.rows[i].effect for i in names.passed(search.policy)), None)
    if isinstance(best, ExponentialDrift) and (about := _about_itself(best, test)) != best:
        names = table_of(fit, search, test, [*every, about])
    return explanation(fit, search, test, names)


def _about_itself(effect: ExponentialDrift, test: Tester) -> ExponentialDrift:
    """Return an effect with a time constant linearised about what it is estimated to be.

    About another constant it leaves what a curve of the time describes, which would pass for better where many rows tell.
    """
    for _ in range(TESTING.expansions):
        about = effect.about(test([effect]).estimate([0]))
        if about == effect:
            break
        effect = about
    return effect


def explanation(
    fit: ModelFit, search: Search, test: Tester, names: CandidateTable, *, predicting: Effect | None = None
) -> Decision | None:
    """Return the same, given the table of all that may be added by name, and what is known to predict."""

    def contest_of(close: Sequence[Row]) -> CandidateTable:
        nameless = unnamed_given(fit, [row.effect for row in close], search)
        together = [*(row.effect for row in close), *nameless]
        costs = {id(row.effect): row.cost for row in close}
        return table_of(fit, search, test, together, costs, predicting=predicting) if nameless else names

    decision = decide(names, contest_of, search.policy)
    if decision is None or not decision.effect.is_nameless:
        return decision
    return _with_neighbours(decision, fit, search, test)


def hidden_wave(fit: ModelFit, search: Search) -> Decision | None:
    """Return the wave that chance does not explain among all names, judged as in any other step.

    Coarser curves leave more than noise, which hides waves that blocks left out tell only by little.
    """
    every = addable(fit, search)
    waves, among = [effect for effect in every if isinstance(effect, Harmonic)], len({effect.identity for effect in every})
    if not waves:
        return None
    table = table_of(fit, search, BesideNuisances(fit), waves, among=among)
    return decide(table, lambda _: table, search.policy)


def _with_neighbours(decision: Decision, fit: ModelFit, search: Search, test: Tester) -> Decision:
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
    every = [effect, *missing_from(fit, alike)]
    rivals = table_of(fit, search, test, every, {id(effect): decision.row.cost}).rivals(0, search.policy)
    return replace(decision, equivalent=each_heading_once([*decision.equivalent, *rivals], effect, search.policy))


def table_of(
    fit: ModelFit,
    search: Search,
    test: Tester,
    effects: Sequence[Effect],
    costs: Mapping[int, float] | None = None,
    *,
    predicting: Effect | None = None,
    among: int | None = None,
) -> CandidateTable:
    """Return the table of candidates, named and nameless ones; each kind shares the chance of a false name.

    Args:
        fit: the fit.
        search: what is looked for.
        test: tests candidates against the fit.
        effects: the candidates.
        costs: of candidates, by their identity, that are known already.
        predicting: what is taken to predict rows left out, without being asked.
        among: of how many they were chosen; default: as many as there are of a kind.
    """
    policy, costs = search.policy, costs or {}

    def left_out(effect: Effect) -> Unfitted:
        # Blocks of rows would take as many times the memory, so they wait for the few of which it is asked.
        tests = test([effect], search.groups)
        return Unfitted(standard_errors(tests.gains_by_block([0])), partial(p_value_of_uneven_noise, fit, tests))

    is_small, spare = is_small_table(fit, policy), spare_compliances(fit, effects, policy)
    tests, known = test([*effects, *spare]), {predicting.identity} if predicting else set()
    least = policy.least_gain(tests.squares, declared=fit.is_declared)
    count = {kind: len({e.identity for e in effects if e.is_nameless == kind}) for kind in (False, True)}
    rows = []
    for i, effect in enumerate(effects):
        n = among or count[effect.is_nameless]
        given = range(len(effects), len(effects) + len(spare)) if effect.is_of_loads else range(0)
        score = tests.score_given([i], given, n) if given else tests.score([i], n)
        # By how much an effect without a name has to be better than one of the catalogue.
        across = 0.0 if effect.locus.acts_on == "drive" else policy.across
        surcharge = policy.without_name + across if effect.is_nameless else 0.0
        row = Row(
            effect,
            score,
            costs.get(id(effect), score.ebic + surcharge),
            (i,),
            among=n,
            least=least,
            left_out=None if effect.identity in known else partial(left_out, effect),
            enough=enough_errors(effect),
        )
        # Asked only where chance does not explain the candidate anyway.
        if is_small and is_more_than_chance(row, policy):
            evidence = tests.log_evidence([i, *given]) - tests.log_evidence(given) if given else tests.log_evidence([i])
            row = replace(row, evidence=evidence)
        rows.append(row)
    return CandidateTable(rows, tests)


def spare_compliances(fit: ModelFit, effects: Sequence[Effect], policy: Policy) -> list[Effect]:
    """Return what else may be compliant, drives and bearings in all directions, beside which candidates are tested.

    Few rows do not bring in all that is compliant, and what loads do beside it would stand for the rest.
    """
    if not is_small_table(fit, policy) or not any(effect.is_of_loads for effect in effects):
        return []
    missing, chain = missing_compliances(fit), fit.problem.chain
    bearings = [effect for effect in (*fit.problem.effects, *missing) if isinstance(effect, Compliance)]
    return [*missing, *missing_from(fit, (e for e in bearing_features(chain, bearings) if e.uses_moments))]


def is_small_table(fit: ModelFit, policy: Policy) -> bool:
    """Return whether a table has so few rows for the parameters that they determine that priors decide."""
    return len(fit.problem) < policy.rows_each * fit.solution.effective


def addable(fit: ModelFit, search: Search) -> list[Effect]:
    """Return what may be added by name: what the data can test and the model does not have yet."""
    return _addable(fit, search.extra, search.policy)


def named_tests(fit: ModelFit, extra: Sequence[Effect], policy: Policy, others: Sequence[Effect] = ()) -> ScoreTests:
    """Test all that may be added by name, and others if they are not among them, on the rows that effects are chosen by."""
    few, _ = sampled(fit, policy)
    every = _addable(fit, extra, policy)
    return score_test_given_nuisances(few, [*every, *(effect for effect in others if effect not in every)])


def _addable(fit: ModelFit, extra: Sequence[Effect], policy: Policy) -> list[Effect]:
    has_loads = has_compliance(fit.problem.effects)
    tested = testable(situation_of(fit))
    tones = strongest_tones(sampled(fit, policy)[0], tested, policy.near_tie)
    every = [*_forms(fit, tested), *_of_stations(fit), *tones, *extra]
    return [effect for effect in missing_from(fit, every) if has_loads or not effect.is_of_loads]


def _of_stations(fit: ModelFit) -> Iterator[Effect]:
    """Yield what single stations of several may have by themselves; what changed, from the second one on."""
    stations = fit.problem.stations
    if len(stations) == 1:
        return
    situations = [PoseSet(station.model.chain, station.conditions) for station in stations]
    tested = [testable(situation) for situation in situations]
    # The instrument may be one and the same at all of them, and errs at each by itself where it is not.
    of_each = [[form for of in candidates for form in of.forms if form.is_sighted] for candidates in tested]
    everywhere = [form for form in of_each[0] if all(form in forms for forms in of_each[1:])]
    yield from everywhere
    for k, station in enumerate(stations):
        yield from (own for own in own_effects(tested[k], station.name) if own.effect not in everywhere)
        yield from changed_effects(fit.problem.effects, situations[k], tested[k], station.name) if k else ()


def has_compliance(effects: Sequence[Effect]) -> bool:
    """Return whether linear elasticity is among effects."""
    return any(effect.family is Family.ELASTICITY for effect in effects)


def variants(fit: ModelFit, acts_on: Collection[str] | None = None) -> Iterator[Effect]:
    """Yield what the data can test, or what of it acts in some places, each in the forms that are worth telling apart."""
    return _forms(fit, testable(situation_of(fit), acts_on))


def _forms(fit: ModelFit, tested: Sequence[Candidate]) -> Iterator[Effect]:
    is_alone = len(fit.problem.stations) == 1
    for candidate in tested:
        # What belongs to a station is looked for at each by itself.
        yield from (form for form in candidate.forms if is_alone or form.scope == "robot")


def unnamed_given(fit: ModelFit, names: Sequence[Effect], search: Search) -> list[Effect]:
    """Return dependences without a name that take part beside some names, the likeliest first; everywhere beside none.

    On the joint of the likeliest and its neighbours all do; beside any other name what follows the same variable there.
    """
    if search.nameless is not None and not search.nameless:
        return []
    chain, conditions = fit.problem.chain, fit.problem.conditions
    joints = chain.robot.measured_joints
    likeliest = names[0].locus.joint if names else None
    near = tuple(j for j in joints if chain.robot.are_neighbours(j, likeliest)) if likeliest in joints else joints
    likes = {_place(effect) for effect in names if effect.locus.joint in joints and effect.locus.joint not in near}
    beyond = nameless_candidates(chain, conditions, [joint for joint in joints if joint in {of for of, *_ in likes}])
    further = (effect for effect in beyond if _place(effect) in likes)
    every = [*nameless_candidates(chain, conditions, near), *further, *likely_maps(fit, near)]
    return search.taking_part(missing_from(fit, every))


def _place(effect: Effect) -> tuple[str | None, str | None, bool]:
    """Return the joint, the variable, and whether an effect acts about the axis."""
    at = effect.locus
    return at.joint, at.follows, at.acts_on in ("drive", "gamma_z")


def sampled(fit: ModelFit, policy: Policy) -> tuple[ModelFit, np.ndarray]:
    """Return a fit on as many of its rows, evenly spread, as are enough to choose what comes next, and these rows."""
    sizes = [station.reading_size for station in fit.problem.stations]
    n, most = len(fit.problem), policy.enough_readings // max(sizes)
    if n <= most:
        return fit, np.arange(n)
    rows, few = np.linspace(0, n - 1, most).astype(int), list[Station]()
    for whole, span in zip(fit.problem.stations, fit.problem.rows, strict=True):
        own = rows[(rows >= span.start) & (rows < span.stop)] - span.start
        # The same objects whenever they are asked for again: what was evaluated at these poses is then known.
        few.append(replace(whole.select(own), conditions=part_of(whole.conditions, own, (n, most, span.start))))
    return fit.over(few, fit.solution.weights[rows]), rows


def over_rows_of(fit: ModelFit, whole: ModelFit) -> ModelFit:
    """Return a fit of some rows as it is, over all the rows of another one, with their weights."""
    stations = []
    for of, part in zip(whole.problem.stations, fit.problem.stations, strict=True):
        # What is known of noise along the rows is that of the part.
        serial, known = of.serial, part.serial
        serial = None if serial is None or known is None else replace(serial, phi=known.phi, share=known.share)
        stations.append(replace(of, model=part.model, serial=serial))
    return fit.over(stations, whole.solution.weights)
