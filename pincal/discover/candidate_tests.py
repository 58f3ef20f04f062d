"""Tables of candidates: effects that may be added to a fit, tested against its residuals."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
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
from pincal.discover.joint_pairs import likely_waves_of_two
from pincal.discover.levers import (
    likely_maps,
    missing_compliances,
    missing_from,
    situation_of,
    strongest_tones,
)
from pincal.discover.policy import Policy
from pincal.discover.scatter import p_value_of_uneven_noise
from pincal.discover.score_numbers import TESTING
from pincal.discover.score_tests import GivenNuisances, score_test_given_nuisances
from pincal.identify.calibrate import Tolerance
from pincal.identify.fit import ModelFit
from pincal.identify.station import Station
from pincal.model.at_station import changed_effects, own_effects
from pincal.model.catalogue.bearing_features import bearing_features
from pincal.model.catalogue.candidates import testable
from pincal.model.catalogue.unnamed import nameless_candidates
from pincal.model.chain import MomentFrame
from pincal.model.conditions import PoseSet, part_of
from pincal.model.effect import Candidate, Effect, ExponentialDrift, Family, Harmonic, Locus
from pincal.model.effects import Compliance
from pincal.model.latest import Latest
from pincal.sensors.row_samples import spread_rows
from pincal.thresholds import Count

# Latest fits whose functions of two joints are kept, at least as many as are named again together.
_FITS: Count = 8

NamelessKind = tuple[str, Locus]
"""Name and locus of an unnamed dependence, without what differs from table to table."""

Tester = Callable[..., ScoreTests]
"""Tests candidates against a fit with nuisances projected out, from effects and, optionally, the
block of each row.
"""


@dataclass(frozen=True)
class Search:
    """Settings of a search.

    Attributes:
        policy: thresholds and limits.
        extra: effects of the user, candidates like those of the catalogue.
        first: the fit to start from, with all rows.
        groups: shape (N,), blocks of the rows from which effects are selected.
        frames: moment frames to choose from.
        nameless: kinds of the unnamed dependences that are candidates, see :func:`nameless_kind`;
            default: all.
        expected: of a part of the rows, the effects that all of them showed: these enter together
            where each is beyond doubt given all the others.
    """

    policy: Policy
    extra: tuple[Effect, ...]
    first: ModelFit
    groups: np.ndarray
    frames: tuple[MomentFrame, ...] = ()
    nameless: Collection[NamelessKind] | None = None
    expected: tuple[Effect, ...] | None = None
    _latest: list[GivenNuisances] = field(default_factory=list, init=False, repr=False)
    _of_two: Latest[list[Effect]] = field(
        default_factory=partial(Latest, _FITS), init=False, repr=False
    )

    def tests_of(self, fit: ModelFit) -> GivenNuisances:
        """Return the tests against a fit; of the latest one, common parts are kept."""
        if not self._latest or self._latest[0].fit is not fit:
            self._latest[:] = [GivenNuisances(fit, self.groups)]
        return self._latest[0]

    def of_two_joints(self, fit: ModelFit, joints: tuple[str, ...]) -> list[Effect]:
        """Return the likeliest functions of some joints' positions and another's; of the latest
        fits they are kept.
        """
        known = self._of_two.of(fit)
        if joints not in known:
            wanted = self._moved_by_two(fit.problem.chain.robot.joint_names)
            known[joints] = [*likely_maps(fit, joints), *likely_waves_of_two(fit, joints, wanted)]
        return known[joints]

    def _moved_by_two(self, joints: Sequence[str]) -> Collection[str]:
        """Return the joints of which unnamed functions of their own and another position are
        candidates, among all joints.
        """
        if self.nameless is None:
            return joints
        kinds = [locus for _, locus in self.nameless]
        return {str(at.joint) for at in kinds if at.acts_on == "drive" and at.follows in joints}

    def until(self, usual: Tolerance) -> Tolerance:
        """Return how closely last fits converge: of a part of the rows only names are asked for,
        and no test of these resolves more.
        """
        return usual if self.expected is None else Tolerance.CLOSE

    def taking_part(self, nameless: Iterable[Effect]) -> list[Effect]:
        """Return the unnamed dependences that are candidates."""
        return [
            effect
            for effect in nameless
            if self.nameless is None
            or not {nameless_kind(effect), _kind_of_field(effect)}.isdisjoint(self.nameless)
        ]


def nameless_kind(effect: Effect) -> NamelessKind:
    """Return the identity of an unnamed dependence without its orders, which differ a little from
    table to table where they were selected among many.

    A field is of no shape: every function of its two joints may become it.
    """
    name, locus = effect.identity
    if locus.shape == "field":
        return _kind_of_field(effect)
    if effect.trials > 1.0:
        return name, replace(locus, order=None, own_order=None)
    return name, locus


def _kind_of_field(effect: Effect) -> NamelessKind:
    """Return the kind of the field that a function of two joints may become."""
    at = effect.locus
    return effect.name, Locus(at.joint, at.acts_on, at.follows)


def choose(fit: ModelFit, search: Search) -> Decision | None:
    """Return the best explanation of the residuals of a fit, if it is accepted."""
    test = search.tests_of(fit)
    every = addable(fit, search)
    names = table_of(fit, search, test, every)
    best = next((names.rows[i].effect for i in names.passed(search.policy)), None)
    if isinstance(best, ExponentialDrift) and (about := _about_itself(best, test)) != best:
        names = table_of(fit, search, test, [*every, about])
    return explanation(fit, search, test, names)


def _about_itself(effect: ExponentialDrift, test: Tester) -> ExponentialDrift:
    """Return an effect with a time constant linearised about its estimate.

    Linearised about another constant it leaves a remainder that a curve of time describes better,
    on many rows.
    """
    for _ in range(TESTING.expansions):
        about = effect.about(test([effect]).estimate([0]))
        if about == effect:
            break
        effect = about
    return effect


def explanation(
    fit: ModelFit,
    search: Search,
    test: Tester,
    names: CandidateTable,
    *,
    predicting: Effect | None = None,
) -> Decision | None:
    """Return the best explanation, given the table of named candidates, and an effect taken to
    predict held-out rows.
    """

    def contest_of(close: Sequence[Row]) -> CandidateTable:
        nameless = unnamed_given(fit, [row.effect for row in close], search)
        together = [*(row.effect for row in close), *nameless]
        costs = {id(row.effect): row.cost for row in close}
        return (
            table_of(fit, search, test, together, costs, predicting=predicting)
            if nameless
            else names
        )

    decision = decide(names, contest_of, search.policy)
    if decision is None or not decision.effect.is_nameless:
        return decision
    return _with_neighbours(decision, fit, search, test)


def hidden_wave(fit: ModelFit, search: Search) -> Decision | None:
    """Return the wave that is accepted among all names, as in any other step.

    Before, residuals of coarser curves may have hidden it.
    """
    every = addable(fit, search)
    waves = [effect for effect in every if isinstance(effect, Harmonic)]
    among = len({effect.identity for effect in every})
    if not waves:
        return None
    table = table_of(fit, search, search.tests_of(fit), waves, among=among)
    return decide(table, lambda _: table, search.policy)


def _with_neighbours(decision: Decision, fit: ModelFit, search: Search, test: Tester) -> Decision:
    """Return a decision for an unnamed term with equivalents on neighbouring joints, perhaps no
    candidates before.

    A rotation of a joint resembles a tilt of its neighbour that depends on the same variable.
    """
    effect = decision.effect
    chain = fit.problem.chain
    at = effect.locus
    names = list(chain.robot.joint_names)
    if at.joint not in names:
        return decision
    i = names.index(at.joint)
    near = nameless_candidates(
        chain, fit.problem.conditions, names[max(i - 1, 0) : i] + names[i + 1 : i + 2]
    )
    similar = [
        e
        for e in near
        if (e.locus.follows, e.locus.shape, e.locus.order) == (at.follows, at.shape, at.order)
    ]
    every = [effect, *missing_from(fit, similar)]
    rivals = table_of(fit, search, test, every, {id(effect): decision.row.cost}).rivals(
        0, search.policy
    )
    return replace(
        decision,
        equivalent=each_heading_once([*decision.equivalent, *rivals], effect, search.policy),
    )


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
    """Return the table of named and unnamed candidates; each kind shares the probability of a false
    name.

    Costs that are known are given by ``id``; ``predicting`` is taken to predict held-out rows,
    untested; ``among`` is the number of candidates that share the probability, by default those of
    the kind.
    """
    policy = search.policy
    costs = costs or {}
    is_small = is_small_table(fit, policy)
    spare = spare_compliances(fit, effects, policy)
    tests = test([*effects, *spare])
    known = {predicting.identity} if predicting else set()
    least = policy.least_gain(tests.squares, declared=fit.is_declared)
    count = {kind: _different(effects, nameless=kind) for kind in (False, True)}
    left_out = partial(_left_out, fit, test, search.groups)
    compliances = range(len(effects), len(effects) + len(spare))
    groups = [among or count[effect.is_nameless] for effect in effects]
    loads = [i for i, effect in enumerate(effects) if compliances and effect.is_of_loads]
    beside = tests.scores_given([[i] for i in loads], compliances, [groups[i] for i in loads])
    given_compliances = dict(zip(loads, beside, strict=True))
    rows = []
    for i, (effect, n) in enumerate(zip(effects, groups, strict=True)):
        given = compliances if effect.is_of_loads else range(0)
        score = given_compliances.get(i) or tests.score([i], n)
        row = Row(
            effect,
            score,
            costs.get(id(effect), score.ebic + _surcharge(effect, policy)),
            (i,),
            among=n,
            least=least,
            left_out=None if effect.identity in known else partial(left_out, effect),
            enough=enough_errors(effect),
        )
        # Only needed for significant candidates.
        if is_small and is_more_than_chance(row, policy):
            row = replace(row, evidence=_evidence(tests, i, given))
        rows.append(row)
    return CandidateTable(rows, tests)


def _left_out(fit: ModelFit, test: Tester, groups: np.ndarray, effect: Effect) -> Unfitted:
    """Return what an effect gains on held-out blocks of rows.

    Blocks of rows take a multiple of the memory, so only the few candidates that need them are
    tested by blocks.
    """
    tests = test([effect], groups)
    return Unfitted(
        standard_errors(tests.gains_by_block([0])), partial(p_value_of_uneven_noise, fit, tests)
    )


def _different(effects: Sequence[Effect], *, nameless: bool) -> int:
    """Return the number of different candidates with or without a name."""
    return len({effect.identity for effect in effects if effect.is_nameless == nameless})


def _surcharge(effect: Effect, policy: Policy) -> float:
    """Return what a candidate without a name costs beyond its parameters."""
    across = 0.0 if effect.locus.acts_on == "drive" else policy.across
    return policy.without_name + across if effect.is_nameless else 0.0


def _evidence(tests: ScoreTests, candidate: int, given: range) -> float:
    """Return the log evidence of a candidate, given others."""
    if not given:
        return tests.log_evidence([candidate])
    return tests.log_evidence([candidate, *given]) - tests.log_evidence(given)


def spare_compliances(fit: ModelFit, effects: Sequence[Effect], policy: Policy) -> list[Effect]:
    """Return further compliances, of drives and bearings in all directions, given which candidates
    are tested.

    On few rows the model may lack compliances, for which other effects of loads would substitute.
    """
    if not is_small_table(fit, policy) or not any(effect.is_of_loads for effect in effects):
        return []
    missing = missing_compliances(fit)
    chain = fit.problem.chain
    bearings = [
        effect for effect in (*fit.problem.effects, *missing) if isinstance(effect, Compliance)
    ]
    return [
        *missing,
        *missing_from(fit, (e for e in bearing_features(chain, bearings) if e.uses_moments)),
    ]


def is_small_table(fit: ModelFit, policy: Policy) -> bool:
    """Return whether a table has so few rows per parameter that priors decide."""
    return len(fit.problem) < policy.rows_each * fit.solution.effective


def addable(fit: ModelFit, search: Search) -> list[Effect]:
    """Return the named effects that the data can test and the model lacks."""
    return _addable(fit, search.extra, search.policy)


def named_tests(
    fit: ModelFit, extra: Sequence[Effect], policy: Policy, others: Sequence[Effect] = ()
) -> ScoreTests:
    """Test all addable named effects, and others, on the rows from which effects are selected."""
    few, _ = sampled(fit, policy)
    every = _addable(fit, extra, policy)
    return score_test_given_nuisances(
        few, [*every, *(effect for effect in others if effect not in every)]
    )


def _addable(fit: ModelFit, extra: Sequence[Effect], policy: Policy) -> list[Effect]:
    has_loads = has_compliance(fit.problem.effects)
    tested = testable(situation_of(fit))
    tones = strongest_tones(sampled(fit, policy)[0], tested, policy.near_tie)
    every = [*_forms(fit, tested), *_of_stations(fit), *tones, *extra]
    return [effect for effect in missing_from(fit, every) if has_loads or not effect.is_of_loads]


def _of_stations(fit: ModelFit) -> Iterator[Effect]:
    """Yield effects of single stations, if there are several; from the second on also changes since
    the first.
    """
    stations = fit.problem.stations
    if len(stations) == 1:
        return
    situations = [PoseSet(station.model.chain, station.conditions) for station in stations]
    tested = [testable(situation) for situation in situations]
    # The instrument may be the same at all stations, or each have its own errors.
    of_each = [
        [form for of in candidates for form in of.forms if form.is_sighted] for candidates in tested
    ]
    everywhere = [form for form in of_each[0] if all(form in forms for forms in of_each[1:])]
    yield from everywhere
    for k, station in enumerate(stations):
        yield from (
            own for own in own_effects(tested[k], station.name) if own.effect not in everywhere
        )
        yield from (
            changed_effects(fit.problem.effects, situations[k], tested[k], station.name)
            if k
            else ()
        )


def has_compliance(effects: Sequence[Effect]) -> bool:
    """Return whether linear elasticity is among effects."""
    return any(effect.family is Family.ELASTICITY for effect in effects)


def variants(fit: ModelFit, acts_on: Collection[str] | None = None) -> Iterator[Effect]:
    """Yield the effects that the data can test, perhaps only those acting in some places, each in
    its distinct forms.
    """
    return _forms(fit, testable(situation_of(fit), acts_on))


def _forms(fit: ModelFit, tested: Sequence[Candidate]) -> Iterator[Effect]:
    is_alone = len(fit.problem.stations) == 1
    for candidate in tested:
        # Effects of stations are tested at each separately.
        yield from (form for form in candidate.forms if is_alone or form.scope == "robot")


def unnamed_given(fit: ModelFit, names: Sequence[Effect], search: Search) -> list[Effect]:
    """Return the unnamed candidates that compete with some names, the best first; all without any.

    These are all on the best name's joint and its neighbours, and those of the same variable in the
    place of any other name.
    """
    if search.nameless is not None and not search.nameless:
        return []
    chain = fit.problem.chain
    conditions = fit.problem.conditions
    joints = chain.robot.measured_joints
    likeliest = names[0].locus.joint if names else None
    near = (
        tuple(j for j in joints if chain.robot.are_neighbours(j, likeliest))
        if likeliest in joints
        else joints
    )
    likes = {
        _place(effect)
        for effect in names
        if effect.locus.joint in joints and effect.locus.joint not in near
    }
    beyond = nameless_candidates(
        chain, conditions, [joint for joint in joints if joint in {of for of, *_ in likes}]
    )
    further = (effect for effect in beyond if _place(effect) in likes)
    both = search.of_two_joints(fit, near)
    every = [*nameless_candidates(chain, conditions, near), *further, *both]
    return search.taking_part(missing_from(fit, every))


def _place(effect: Effect) -> tuple[str | None, str | None, bool]:
    """Return joint, variable, and whether an effect acts about the joint's axis."""
    at = effect.locus
    return at.joint, at.follows, at.acts_on in ("drive", "gamma_z")


def sampled(fit: ModelFit, policy: Policy) -> tuple[ModelFit, np.ndarray]:
    """Return a fit on a sample of its rows, spread over each station, that is enough to select
    effects, and their indices.
    """
    sizes = [station.reading_size for station in fit.problem.stations]
    n = len(fit.problem)
    most = policy.enough_readings // max(sizes)
    if n <= most:
        return fit, np.arange(n)
    rows = spread_rows(list(map(len, fit.problem.stations)), most)
    few = list[Station]()
    for whole, span in zip(fit.problem.stations, fit.problem.rows, strict=True):
        own = rows[(rows >= span.start) & (rows < span.stop)] - span.start
        # The same objects on each call, so that evaluations at these poses are cached.
        few.append(
            replace(
                whole.select(own), conditions=part_of(whole.conditions, own, (n, most, span.start))
            )
        )
    return fit.over(few, fit.solution.weights[rows]), rows


def over_rows_of(fit: ModelFit, whole: ModelFit) -> ModelFit:
    """Return a fit of some rows, not refitted, over all rows of another fit, with their weights."""
    stations = []
    for of, part in zip(whole.problem.stations, fit.problem.stations, strict=True):
        # The parameters of correlated noise are those of the part.
        serial = of.serial
        known = part.serial
        serial = (
            None
            if serial is None or known is None
            else replace(serial, phi=known.phi, share=known.share)
        )
        stations.append(replace(of, model=part.model, serial=serial))
    return fit.over(stations, whole.solution.weights)
