"""Name each of several effects beside the others, from one pass over the rows.

What a fit leaves without one of its effects follows from its own Gram matrices: taking the effect out only adds its columns,
times their values, to the residuals. So all are named from the same tests of all that could take the place of any.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from pincal.discover.candidate_tests import Search, addable, explanation, nameless_beside, spare_compliances, table_of
from pincal.discover.decisions import CandidateTable, Decision
from pincal.discover.information import Information
from pincal.discover.nuisance import BesideNuisances
from pincal.discover.score_tests import ScoreTests
from pincal.identify.fit import Fit, without
from pincal.model.effect import Effect, Settling
from pincal.model.evaluated import key_of


def named_beside(fit: Fit, effects: Sequence[Effect], search: Search) -> Iterator[tuple[Fit, Decision | None]]:
    """Yield, for each of some effects of a fit, the fit without it and the best explanation of what this leaves.

    Args:
        fit: the fit.
        effects: those of its effects that are to be named.
        search: what is looked for.
    """
    shared = _Shared(BesideNuisances(fit))
    rests = [without(fit, effect) for effect in effects]
    tests = [partial(shared.without, effect) for effect in effects]
    # Others have the time constants of the catalogue, this one its own.
    own = ([effect] if isinstance(effect, Settling) else [] for effect in effects)
    tried = [[*addable(rest, search), *mine] for rest, mine in zip(rests, own, strict=True)]
    pairs = zip(rests, tried, strict=True)
    spare = [effect for rest, some in pairs for effect in spare_compliances(rest, some, search.policy)]
    shared.test([*(effect for some in tried for effect in some), *spare])
    tables, others = list[CandidateTable](), list[Effect]()
    for effect, rest, test, some in zip(effects, rests, tests, tried, strict=True):
        # Whether an effect predicts is asked before it goes, not when it is named.
        names = table_of(rest, search, test, some, predicting=effect)
        tables.append(names)
        close = [names.rows[i].effect for i in names.cheapest()[: search.policy.close]]
        others += [*close, *nameless_beside(rest, [effect, *close], search)]
    shared.test([*others, *spare])
    for effect, rest, test, names in zip(effects, rests, tests, tables, strict=True):
        yield rest, explanation(rest, search, test, names, predicting=effect)


@dataclass
class _Shared:
    """Tests against a fit, for tests against the fit without one of its effects.

    Attributes:
        beside: tests against the fit.
        passes: what was tested at once, with blocks of rows or without, each candidate with its number.
        known: what the rows say of the model without one of its effects, by what they say of all of it, and by the effect.
    """

    beside: BesideNuisances
    passes: list[tuple[bool, dict[object, int], ScoreTests]] = field(default_factory=list)
    known: dict[tuple[int, int], Information] = field(default_factory=dict)

    def test(self, effects: Iterable[Effect], groups: np.ndarray | None = None) -> None:
        """Test candidates at once, equal ones once."""
        once = {key_of(effect): effect for effect in effects}
        number = {key: i for i, key in enumerate(once)}
        self.passes.append((groups is not None, number, self.beside(tuple(once.values()), groups)))

    def without(self, gone: Effect, effects: Sequence[Effect], groups: np.ndarray | None = None) -> ScoreTests:
        """Return the tests of candidates against the fit without one of its effects."""
        found = self._tested(effects, groups)
        if found is None:
            self.test(effects, groups)
            found = self._tested(effects, groups)
            assert found is not None
        which, tests = found
        key = id(tests.model), id(gone)
        rest = tests.among(which, self.beside.fit.names_of([gone]), self.known.get(key))
        self.known[key] = rest.model
        return rest

    def _tested(self, effects: Sequence[Effect], groups: np.ndarray | None) -> tuple[list[int], ScoreTests] | None:
        """Return a pass in which all of some candidates were tested, and their numbers there."""
        for has_blocks, number, tests in self.passes:
            which = [number.get(key_of(effect), -1) for effect in effects]
            if has_blocks == (groups is not None) and min(which, default=0) >= 0:
                return which, tests
        return None
