"""In which way an arm gives way: one drive or bearing alone, where that is all that can be seen, or as a whole."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pincal.discover.candidate_tests import is_small_table
from pincal.discover.decisions import Row, rivals_of
from pincal.discover.nuisance import missing_compliances, score_test_beside_nuisances
from pincal.discover.policy import Policy
from pincal.discover.score_tests import Score, ScoreTests
from pincal.identify.fit import Fit
from pincal.model.catalogue.bearings import bearing_features
from pincal.model.effect import Effect
from pincal.model.effects import Compliance


@dataclass(frozen=True)
class ElasticWay:
    """Compliances that enter a model together.

    Attributes:
        effects: the compliances.
        score: their test.
        equivalent: other single ones that explain as much, where a single one enters.
    """

    effects: tuple[Compliance, ...]
    score: Score
    equivalent: tuple[Effect, ...] = ()

    @property
    def is_single(self) -> bool:
        """Whether one drive or one bearing is all that gives way."""
        return len(self.effects) == 1 and self.effects[0].locus.joint is not None


def elastic_way(fit: Fit, policy: Policy) -> ElasticWay | None:
    """Return how an arm gives way beyond a fit; None if that is no more than chance.

    Where one drive or one bearing leaves nothing but chance to the others, it enters alone: among twenty parameters that
    trade with each other nobody could tell which it is. On a small table what bends least is enough: drives without
    bearings, or one of either, if that is likelier before the data than all.
    """
    chain, block = fit.problem.chain, missing_compliances(fit)
    if not block:
        return None
    parts = [part for effect in block for part in effect.parts(chain)]
    # One bearing alone gives way in directions of its own; where it sits, nothing shows before it gives way.
    forms = [(part, *(e for e in bearing_features(chain, (part,)) if e.uses_moments)) for part in parts]
    starts = np.cumsum([0, *map(len, forms)])
    # All arms give way: what gravity bends is not left to geometry that nobody would have built.
    tests = score_test_beside_nuisances(fit, [effect for form in forms for effect in form], wider=1.0)
    whole = [int(i) for i in starts[:-1]]
    families = [[i for i, part in zip(whole, parts, strict=True) if part.name == effect.name] for effect in block]
    singles = [range(a, b) for a, b in pairwise(starts)]
    if is_small_table(fit, policy):
        ways = [*zip(zip(parts, strict=True), singles, strict=True), *zip(zip(block, strict=True), families, strict=True)]
        return _likeliest(tests, [*ways, (block, whole)], policy)
    chances = _chance(tests, singles), _chance(tests, [whole]), _chance(tests, families)
    if min(chances) > policy.elastic:
        return None
    scores = [tests.score(single, len(singles)) for single in singles]
    best = int(np.argmin([score.ebic for score in scores]))
    beyond = _chance(tests, [whole], singles[best]), _chance(tests, singles, singles[best])
    if chances[0] > policy.elastic or min(beyond) < policy.adds_nothing:
        return ElasticWay(block, tests.score(whole, 1))
    rows = [Row(part, score, score.ebic, policy.elastic) for part, score in zip(parts, scores, strict=True)]

    def left_given(i: int, given: int) -> float:
        return tests.score_given(singles[i], singles[given]).p_value

    return ElasticWay((parts[best],), scores[best], tuple(rivals_of(rows, best, left_given, policy)))


def _likeliest(
    tests: ScoreTests, ways: Sequence[tuple[tuple[Compliance, ...], Sequence[int]]], policy: Policy
) -> ElasticWay | None:
    """Return the way that is likeliest before the data, the choice among as many of its kind paid for; None without any."""
    kinds = [len(effects) == 1 and effects[0].only is not None for effects, _ in ways]
    evidence = [tests.log_evidence(of) - np.log(kinds.count(kind)) for (_, of), kind in zip(ways, kinds, strict=True)]
    effects, of = ways[int(np.argmax(evidence))]
    return ElasticWay(effects, tests.score(of, 1)) if max(evidence) > -np.log(policy.false_name) else None


def with_features(fit: Fit, effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Return effects, and of bearings among them what else a fit knows of each, which goes where they go."""
    found, chain = list(effects), fit.problem.chain
    for effect in effects:
        if isinstance(effect, Compliance):
            joints = [part.only for part in effect.parts(chain)]
            found += [e for e in fit.problem.effects if e.locus.cause == effect.name and e.locus.joint in joints]
    return tuple(found)


def _chance(tests: ScoreTests, ways: Sequence[Sequence[int]], given: Sequence[int] = ()) -> float:
    """Return the p-value of the surest of several ways, the choice among them paid for; beside what is given."""
    scores = (tests.score_given(way, given) if given else tests.score(way, 1) for way in ways)
    return len(ways) * min(score.p_value for score in scores)
