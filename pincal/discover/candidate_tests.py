"""From a fit to a table of candidates: what may be added, tested against what the model leaves."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pincal.discover.decisions import CandidateTable, Decision, Row, best_name, close_names, decide
from pincal.discover.nuisance import score_test_beside_masses, situation_of
from pincal.discover.policy import Policy
from pincal.discover.score_tests import ScoreTests
from pincal.identify.fit import Fit
from pincal.model.catalogue.candidates import testable
from pincal.model.catalogue.unnamed import nameless_candidates
from pincal.model.effect import Effect, Family


@dataclass(frozen=True)
class Search:
    """What a discovery looks for, the same from its beginning to its end.

    Attributes:
        policy: what to go by.
        extra: effects of the user's own, which take part like those of the catalogue.
        elastic: whether elasticity may be found; not for an arm without masses.
        first: the fit to start from, all rows of it.
        all_groups: shape (all rows,), blocks of its rows for cross-validation.
        groups: shape (N,), those of the rows from which effects are chosen.
    """

    policy: Policy
    extra: tuple[Effect, ...]
    elastic: bool
    first: Fit
    all_groups: np.ndarray
    groups: np.ndarray


@dataclass(frozen=True)
class ScoreEvidence:
    """Evidence from score tests.

    Attributes:
        fit: the fit that they are against.
        tests: the tests, with the blocks of rows for cross-validation or without.
        groups: shape (N,), these blocks.
        has_blocks: whether ``tests`` has them.
    """

    fit: Fit
    tests: ScoreTests
    groups: np.ndarray
    has_blocks: bool

    def left_given(self, which: int, given: int) -> float:
        """Return the p-value of what one candidate still explains once another is in the model."""
        return self.tests.gain_given(which, given).p_value

    def cost_together(self, one: int, other: int) -> float:
        """Return the information criterion of two candidates taken as one."""
        return self.tests.judge(*self.tests.gain([one, other]), len(self.tests.effects)).ebic

    def predicts(self, which: int) -> bool:
        """Return whether a candidate improves the prediction of blocks left out by more than chance."""
        if self.has_blocks:
            gain, error = self.tests.cross_validated_gain([which])
        else:
            alone = score_test_beside_masses(self.fit, self.groups, [self.tests.effects[which]])
            gain, error = alone.cross_validated_gain([0])
        return gain > error


def tests_of(decision: Decision) -> ScoreTests:
    """Return the tests that a decision rests on."""
    evidence = decision.table.evidence
    assert isinstance(evidence, ScoreEvidence)
    return evidence.tests


def choose(fit: Fit, search: Search) -> Decision | None:
    """Return the best explanation of what a fit leaves, if it is more than chance."""
    policy = search.policy
    names = _table(fit, addable(fit, search), search, has_blocks=True)
    best = best_name(names, policy)
    near = None if best is None else names.rows[best].effect.locus.joint
    close = [names.rows[i] for i in close_names(names, best, policy)]
    together = [*(row.effect for row in close), *_nameless(fit, near)]
    # Names are as costly as among all names.
    costs = {id(row.effect): row.cost for row in close}
    return decide(names, _table(fit, together, search, has_blocks=False, costs=costs), policy)


def _table(
    fit: Fit, effects: Sequence[Effect], search: Search, *, has_blocks: bool, costs: Mapping[int, float] | None = None
) -> CandidateTable:
    """Test candidates, named and nameless ones; each kind shares the chance of a false name.

    Args:
        fit: the fit.
        effects: the candidates.
        search: what is looked for.
        has_blocks: whether rows left out can be predicted without further tests; it costs memory for many candidates.
        costs: of candidates, by their identity, that are known already.
    """
    policy = search.policy
    groups = search.groups if has_blocks else np.zeros_like(search.groups)
    tests = score_test_beside_masses(fit, groups, effects)
    count = {kind: len({e.identity for e in effects if e.is_nameless == kind}) for kind in (False, True)}
    rows = []
    for i, effect in enumerate(effects):
        n = count[effect.is_nameless]
        score = tests.score([i], n)
        cost = (costs or {}).get(id(effect), float(score.ebic + _surcharge(effect, policy)))
        rows.append(Row(effect, score, cost, policy.false_name / n))
    least = policy.least_gain(tests.squares, declared=fit.noise.declared[0] is not None)
    return CandidateTable(tuple(rows), least, ScoreEvidence(fit, tests, search.groups, has_blocks))


def _surcharge(effect: Effect, policy: Policy) -> float:
    """Return by how much an effect has to be better than a name of the catalogue."""
    if not effect.is_nameless:
        return 0.0
    return policy.without_name if effect.locus.acts_on == "drive" else policy.without_name + policy.across


def addable(fit: Fit, search: Search) -> list[Effect]:
    """Return what may be added by name: what the data can test and the model does not have yet."""
    present = {effect.identity for effect in fit.model.effects}
    has_loads = search.elastic and has_compliance(fit.model.effects)
    every = [*variants(fit), *search.extra]
    return [e for e in every if e.identity not in present and (has_loads or not e.is_of_loads)]


def has_compliance(effects: Sequence[Effect]) -> bool:
    """Return whether linear elasticity is among effects."""
    return any(effect.family is Family.ELASTICITY for effect in effects)


def variants(fit: Fit) -> Iterator[Effect]:
    """Yield what the data can test, each in the forms that are worth telling apart."""
    for candidate in testable(situation_of(fit)):
        yield from candidate.forms


def _nameless(fit: Fit, near: str | None) -> list[Effect]:
    """Return dependences without a name that the model does not have; near one joint or everywhere."""
    names = fit.model.chain.robot.joint_names
    at = names.index(near) if near in names else None
    joints = names if at is None else names[max(at - 1, 0) : at + 2]
    present = {effect.identity for effect in fit.model.effects}
    every = nameless_candidates(fit.model.chain, fit.station.conditions, joints)
    return [effect for effect in every if effect.identity not in present]


def sampled(fit: Fit, policy: Policy) -> tuple[Fit, np.ndarray]:
    """Return a fit on as many of its rows, evenly spread, as are enough to choose what comes next, and these rows."""
    n, most = len(fit.station), policy.enough_readings // sum(block.size for block in fit.station.sensor.blocks)
    if n <= most:
        return fit, np.arange(n)
    rows = np.linspace(0, n - 1, most).astype(int)
    solution = replace(fit.solution, weights=fit.solution.weights[rows])
    return replace(fit, problem=fit.problem.select(rows), solution=solution), rows
