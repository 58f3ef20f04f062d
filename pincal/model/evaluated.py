"""Cached contributions of effects that use no moments, and the coordinates and masses at values of
the parameters.

A fit needs the same terms at every step, and a discovery the terms of the same candidates after
every fit. Curves of many pieces are kept sparse.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from math import copysign
from typing import Any, NamedTuple

import numpy as np

from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import Body, Effect, Term
from pincal.model.kernel_inputs import Layout, Values
from pincal.model.sparse_basis import SparseBasis, dense_rows, sparse_across, sparse_rows
from pincal.parameters import Parameter
from pincal.thresholds import Count, Scale

# Least number of parameters with basis functions on one coordinate for which sharing a column pays.
WORTH_SHARING: Count = 6
# Non-zero fraction of a curve's basis functions below which it is kept sparse.
_THIN: Scale = 0.25
# Most numbers that are kept (48 MB), and tables that they belong to.
_MOST_NUMBERS: Count = 6_000_000
_TABLES: Count = 16
# Least mass of a link [kg], as its centre is its first moment over its mass.
_LIGHTEST: Scale = 1e-9


class Thin(NamedTuple):
    """Parameters of one effect with sparse basis functions on the same coordinate.

    Attributes:
        parameters: shape (S,), their indices.
        coordinate: index in the chain.
        basis: the functions.
    """

    parameters: np.ndarray
    coordinate: int
    basis: SparseBasis

    def terms(self) -> Iterator[tuple[int, Term]]:
        """Yield them as terms, each with the index of its parameter."""
        for p, row in zip(self.parameters.tolist(), dense_rows(self.basis), strict=True):
            yield p, Term(p, self.coordinate, row)


class Plain(NamedTuple):
    """Contributions of effects to coordinates: terms with the indices of their parameters, and
    curves.
    """

    terms: list[tuple[int, Term]]
    curves: list[Thin]


class _OfEffect(NamedTuple):
    """An effect with its terms, or its curve, and their size in numbers."""

    effect: Effect
    terms: tuple[Term, ...]
    curve: Thin | None
    numbers: int


class _Table(NamedTuple):
    """Results for some poses and a chain, identified by its token."""

    conditions: Conditions
    chain: object
    of_effect: dict[object, _OfEffect]


def parameters_of_each(effects: Sequence[Effect], chain: Chain) -> list[tuple[Parameter, ...]]:
    """Return the parameters of effects; equal ones are one object, so that many stations share the
    robot's.
    """
    # The pose of base and tool does not matter: the chains of many stations share these.
    known = chain.kept.about("parameters", chain.robot, chain.gravity, chain.bearing_heights)
    found = []
    for effect in effects:
        key = chain.moment_frame, chain.targets, key_of(effect)
        if key not in known:
            known[key] = (
                effect,
                tuple(_interned(p, copysign(1.0, p.nominal)) for p in effect.parameters(chain)),
            )
        found.append(known[key][1])
    return found


@lru_cache(maxsize=4096)
def _interned(parameter: Parameter, sign: float) -> Parameter:
    """Return one object for all equal parameters; 0.0 equals -0.0."""
    return parameter


def plain_terms(
    effects: Sequence[Effect], starts: Sequence[int], chain: Chain, conditions: Conditions
) -> Plain:
    """Return the contributions of effects that use no moments, the parameters of each from
    ``starts`` on.
    """
    found = _evaluated(effects, chain, conditions)
    plain = Plain([], [])
    for start, (_, terms, curve, _) in zip(starts, found, strict=True):
        plain.terms.extend([(start + term.parameter, term) for term in terms])
        if curve is not None:
            plain.curves.append(curve._replace(parameters=start + curve.parameters))
    return plain


def _evaluated(effects: Sequence[Effect], chain: Chain, conditions: Conditions) -> list[_OfEffect]:
    tables: tuple[_Table, ...] = chain.kept.tables
    here = (table for table in tables if table.conditions is conditions)
    past = next((table for table in here if table.chain is chain.token), None)
    known = {} if past is None else past.of_effect
    keys = [key_of(effect) for effect in effects]
    found = [known.get(key) for key in keys]
    complete = [each for each in found if each is not None]
    if len(complete) == len(found):
        return complete
    asked = {
        key: _of_effect(effect, chain, conditions) if each is None else each
        for key, effect, each in zip(keys, effects, found, strict=True)
    }
    # Rows of several set-ups are joined afresh each time, so a cache of them would never be used.
    if conditions.setup is None:
        # Current requests take precedence over earlier ones.
        of_effect = next(
            (kept for kept in (known | asked, asked) if _numbers(kept) <= _MOST_NUMBERS), {}
        )
        newest = _Table(conditions, chain.token, of_effect)
        chain.kept.tables = _kept(newest, [table for table in tables if table is not past])
    return [asked[key] for key in keys]


def _kept(newest: _Table, earlier: Sequence[_Table]) -> tuple[_Table, ...]:
    """Return the tables for which there is room, the newest of them last."""
    kept = [newest]
    room = _MOST_NUMBERS - _numbers(newest.of_effect)
    for table in reversed(earlier):
        room -= _numbers(table.of_effect)
        if room < 0 or len(kept) == _TABLES:
            break
        kept.append(table)
    return tuple(reversed(kept))


def key_of(effect: Effect) -> object:
    """Return a key by which equal effects, which have the same terms, are equal."""
    try:
        hash(effect)
    except TypeError:
        return id(effect)
    return effect


def _numbers(of_effect: dict[object, _OfEffect]) -> int:
    return sum(found.numbers for found in of_effect.values())


def _of_effect(effect: Effect, chain: Chain, conditions: Conditions) -> _OfEffect:
    terms = effect.terms(chain, conditions, None)
    bases = [term.basis for term in terms if term.basis is not None]
    places = {term.parameter for term in terms}
    dense = _OfEffect(effect, terms, None, sum(map(len, bases)))
    is_curve = (
        len(bases) == len(terms) == len(places) >= WORTH_SHARING
        and len({term.coordinate for term in terms}) == 1
    )
    if not is_curve or np.count_nonzero(basis := np.array(bases)) >= _THIN * basis.size:
        return dense
    thin = sparse_rows(basis)
    curve = Thin(np.array([term.parameter for term in terms]), terms[0].coordinate, thin)
    return _OfEffect(effect, (), curve, 2 * len(thin.value))


class RowValues(NamedTuple):
    """Values of the parameters, of which some may differ from row to row.

    Attributes:
        of_parameter: for each parameter its value, or its values in all rows, shape (N,).
        varied: the parameters with several values.
    """

    of_parameter: Sequence[float | np.ndarray] | np.ndarray
    varied: frozenset[int] = frozenset()

    @classmethod
    def of(cls, values: np.ndarray, setup: np.ndarray) -> RowValues:
        """Return the values in all rows from those of each set-up, shape (P,) or (P, S), and the
        set-up of each row.
        """
        if values.ndim == 1:
            return cls(values.tolist())
        varied = np.any(values != values[:, :1], axis=1)
        by_row = [
            value[setup] if varies else value[0]
            for value, varies in zip(values, varied, strict=True)
        ]
        return cls(by_row, frozenset(np.flatnonzero(varied).tolist()))


def coordinates_of(
    chain: Chain,
    by_row: RowValues,
    conditions: Conditions,
    terms: list[tuple[int, Term]],
    curves: list[Thin],
) -> Values:
    """Return the coordinates at some poses; terms come with the indices of their parameters among
    all.
    """
    slot = np.full(chain.size, -1)
    slot[chain.drives] = np.arange(len(chain.drives))
    return moved_by(
        Values(np.zeros(chain.size), slot, conditions.q.T), by_row, terms, curves, by=chain.nominal
    )


def moved_by(
    at: Values,
    by_row: RowValues,
    terms: list[tuple[int, Term]],
    curves: Sequence[Thin] = (),
    by: np.ndarray | None = None,
) -> Values:
    """Return coordinates changed by terms, with the indices of their parameters among all, by
    curves and by constants.
    """
    values, varied = by_row
    # Python adds its own floats faster than elements of an array; hundreds of candidates of a
    # discovery are at zero.
    added: list[Any] = [0.0] * len(at.constant) if by is None else by.tolist()
    by_pose = list[tuple[int, float | np.ndarray]]()
    for p, term in terms:
        if term.basis is None and p not in varied:
            added[term.coordinate] += values[p]
        elif p in varied or values[p]:
            by_pose.append(
                (term.coordinate, values[p] if term.basis is None else values[p] * term.basis)
            )
    for places, k, basis in curves:
        heights = np.array([values[p] for p in places.tolist()])
        if heights.any():
            by_pose.append((k, sparse_across(basis, heights[:, None])[:, 0]))
    return _shifted(at, np.array(added), by_pose)


def _shifted(
    at: Values, shift: np.ndarray, by_pose: Sequence[tuple[int, float | np.ndarray]]
) -> Values:
    """Return coordinates changed by constants, shape (K,), and some of them by values in each
    pose.
    """
    slot = at.slot.copy()
    (before, n) = at.varying.shape
    constant = at.constant + shift
    in_row = np.empty((before, 1))
    (those,) = np.nonzero(slot >= 0)
    in_row[slot[those], 0] = shift[those]
    new = list(dict.fromkeys(k for k, _ in by_pose if slot[k] < 0))
    varying = np.empty((before + len(new), n))
    np.add(at.varying, in_row, out=varying[:before])
    if new:
        slot[new] = np.arange(before, before + len(new))
        varying[before:] = constant[new, None]
    for k, change in by_pose:
        varying[slot[k]] += change
    return Values(constant, slot, varying)


def laden(chain: Chain, bodies: Sequence[Body], by_row: RowValues) -> Layout:
    """Return the chain's layout with the link masses at these values; bodies refer to parameters by
    index among all.
    """
    layout = chain.layout
    if not bodies:
        return layout
    masses = layout.masses.copy()
    moments = layout.masses[:, None] * layout.centres
    for body in bodies:
        value = by_row.of_parameter[body.parameter]
        assert body.parameter not in by_row.varied, "masses are the robot's, not a station's"
        masses[body.joint] += value * body.mass
        moments[body.joint] += value * np.array(body.moment)
    masses = np.where(np.abs(masses) < _LIGHTEST, _LIGHTEST, masses)
    return layout._replace(masses=masses, centres=moments / masses[:, None])


def stacked(rows: list[np.ndarray], n: int) -> np.ndarray:
    """Return rows as one writeable, row-major array, shape (number of rows, n)."""
    out = np.empty((len(rows), n))
    for j, row in enumerate(rows):
        out[j] = row
    return out
