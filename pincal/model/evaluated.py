"""What effects that use no moments add to the coordinates at some poses, kept for as long as it is asked for again.

A fit asks for the same terms at every step, and a discovery for those of the same candidates after every fit. Curves of many
pieces are kept as what is not zero of them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from functools import lru_cache
from math import copysign
from typing import NamedTuple

import numpy as np

from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect, Term
from pincal.model.latest import Latest
from pincal.model.sparse_basis import SparseBasis, dense_rows, sparse_rows
from pincal.parameters import Parameter

# Parameters that act on one coordinate by a basis function from which their column is shared.
WORTH_SHARING = 6
# Part of a curve's basis functions that is not zero, below which it is kept sparse.
_THIN = 0.25
# Numbers that are kept at most (24 MB), and tables that they are of.
_MOST_NUMBERS, _TABLES = 6_000_000, 16


class Thin(NamedTuple):
    """Parameters of one effect that each are a basis function on the same coordinate, mostly zero.

    Attributes:
        parameters: shape (S,), their places.
        coordinate: index in the chain.
        basis: the functions.
    """

    parameters: np.ndarray
    coordinate: int
    basis: SparseBasis

    def terms(self) -> Iterator[tuple[int, Term]]:
        """Yield them as terms, each with the place of its parameter."""
        for p, row in zip(self.parameters.tolist(), dense_rows(self.basis), strict=True):
            yield p, Term(p, self.coordinate, row)


class Plain(NamedTuple):
    """What effects add to coordinates: terms with the places of their parameters, and curves."""

    terms: list[tuple[int, Term]]
    curves: list[Thin]


class _OfEffect(NamedTuple):
    """Terms, or a curve, of an effect, which is held, too; and how many numbers they have."""

    effect: Effect
    terms: tuple[Term, ...]
    curve: Thin | None
    numbers: int


class _Table(NamedTuple):
    """What was evaluated over some poses; these and the chain are held, too."""

    conditions: Conditions
    chain: Chain
    of_effect: dict[object, _OfEffect]


# The latest is last.
_KEPT: deque[_Table] = deque(maxlen=_TABLES)


# By equal effects, which are held, too.
_PARAMETERS = Latest[tuple[Effect, tuple[Parameter, ...]]](4)


def parameters_of_each(effects: Sequence[Effect], chain: Chain) -> list[tuple[Parameter, ...]]:
    """Return the parameters of effects, equal ones the same objects, so that many stations hold the robot's but once."""
    known, found = _PARAMETERS.of(chain), []
    for effect in effects:
        key = key_of(effect)
        if key not in known:
            known[key] = effect, tuple(_interned(p, copysign(1.0, p.nominal)) for p in effect.parameters(chain))
        found.append(known[key][1])
    return found


@lru_cache(maxsize=4096)
def _interned(parameter: Parameter, sign: float) -> Parameter:
    """Return one object for all equal parameters; 0.0 equals -0.0."""
    return parameter


def plain_terms(effects: Sequence[Effect], starts: Sequence[int], chain: Chain, conditions: Conditions) -> Plain:
    """Return what effects that use no moments add to coordinates.

    Args:
        effects: the effects.
        starts: where the parameters of each begin.
        chain: the chain.
        conditions: the poses.
    """
    found, plain = _evaluated(effects, chain, conditions), Plain([], [])
    for start, (_, terms, curve, _) in zip(starts, found, strict=True):
        plain.terms.extend([(start + term.parameter, term) for term in terms])
        if curve is not None:
            plain.curves.append(curve._replace(parameters=start + curve.parameters))
    return plain


def _evaluated(effects: Sequence[Effect], chain: Chain, conditions: Conditions) -> list[_OfEffect]:
    past = next((table for table in tuple(_KEPT) if table.conditions is conditions and table.chain is chain), None)
    known = {} if past is None else past.of_effect
    keys = [key_of(effect) for effect in effects]
    found = [known.get(key) or _of_effect(effect, chain, conditions) for key, effect in zip(keys, effects, strict=True)]
    asked = dict(zip(keys, found, strict=True))
    # Rows of several set-ups are put together anew each time: to keep what is found there would only keep these.
    if conditions.setup is None and (past is None or not asked.keys() <= known.keys()):
        others = [table for table in tuple(_KEPT) if table is not past]
        # What is asked for now goes before what was asked for once.
        of_effect = next((kept for kept in (known | asked, asked) if _numbers(kept) <= _MOST_NUMBERS), {})
        room = _MOST_NUMBERS - _numbers(of_effect)
        kept = deque([_Table(conditions, chain, of_effect)], maxlen=_TABLES)
        for table in reversed(others):
            room -= _numbers(table.of_effect)
            if room < 0:
                break
            kept.appendleft(table) if len(kept) < _TABLES else None
        _KEPT.clear()
        _KEPT.extend(kept)
    return found


def key_of(effect: Effect) -> object:
    """Return what tells an effect from others: equal ones have the same terms."""
    try:
        hash(effect)
    except TypeError:
        return id(effect)
    return effect


def _numbers(of_effect: dict[object, _OfEffect]) -> int:
    return sum(found.numbers for found in of_effect.values())


def _of_effect(effect: Effect, chain: Chain, conditions: Conditions) -> _OfEffect:
    terms = effect.terms(chain, conditions, None)
    bases, places = [term.basis for term in terms if term.basis is not None], {term.parameter for term in terms}
    dense = _OfEffect(effect, terms, None, sum(map(len, bases)))
    is_curve = len(bases) == len(terms) == len(places) >= WORTH_SHARING and len({term.coordinate for term in terms}) == 1
    if not is_curve or np.count_nonzero(basis := np.array(bases)) >= _THIN * basis.size:
        return dense
    thin = sparse_rows(basis)
    curve = Thin(np.array([term.parameter for term in terms]), terms[0].coordinate, thin)
    return _OfEffect(effect, (), curve, 2 * len(thin.value))
