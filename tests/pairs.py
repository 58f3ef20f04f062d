"""Combinations of parameters of a test: few that have every pair in them, and all others under a mark of their own."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, product
from typing import Any

import pytest
from _pytest.mark import ParameterSet

Row = tuple[int, ...]
# The rest of a product is for ``.ci/run --all``.
OTHERS = (pytest.mark.long, pytest.mark.products)


def in_pairs(*factors: Sequence[Any]) -> list[ParameterSet]:
    """Return the product of some parameters, of which those are unmarked that have each pair of two values among them.

    Args:
        factors: the values of each parameter, those of the first two the most; a value may have marks by ``pytest.param``.

    A mistake that depends on one parameter or on two shows in them; the others are marked ``long`` and ``products``.
    """
    values = [[of if isinstance(of, ParameterSet) else ParameterSet((of,), (), None) for of in factor] for factor in factors]
    kept = chosen([[len(of.marks) for of in factor] for factor in values])
    return [_one([factor[k] for factor, k in zip(values, row, strict=True)], row in kept) for row in _rows(values)]


def one_in_three(values: Sequence[Any]) -> list[ParameterSet]:
    """Return values of which every third is in every run, and the others in long ones."""
    return [pytest.param(value, marks=pytest.mark.long if k % 3 else ()) for k, value in enumerate(values)]


def chosen(costs: Sequence[Sequence[int]]) -> set[Row]:
    """Return rows of levels that have each pair of two factors' levels among them, one for each pair of the first two.

    Args:
        costs: of each level of each factor; pairs of cheap levels are had in rows of cheap levels, as far as possible.
    """
    needed = {pair for row in _rows(costs) for pair in _pairs(row)}
    firsts = sorted(product(*(range(len(factor)) for factor in costs[:2])), key=lambda row: _cost(row, costs))
    kept = []
    for first in firsts:
        rows = [(*first, *rest) for rest in _rows(costs[2:])]
        best = max(rows, key=lambda row: (len(needed & _pairs(row)), -_cost(row, costs)))
        kept.append(best)
        needed -= _pairs(best)
    assert not needed, "the first two factors have too few levels"
    return set(kept)


def _rows(factors: Sequence[Sequence[Any]]) -> list[Row]:
    return list(product(*(range(len(factor)) for factor in factors)))


def _pairs(row: Row) -> set[tuple[tuple[int, int], ...]]:
    return set(combinations(enumerate(row), 2))


def _cost(row: Row, costs: Sequence[Sequence[int]]) -> int:
    return sum(factor[level] for factor, level in zip(costs, row, strict=False))


def _one(values: list[ParameterSet], is_kept: bool) -> ParameterSet:
    marks = [mark for value in values for mark in value.marks]
    ids = [_word(value.values[0]) for value in values]
    return pytest.param(
        *(value.values[0] for value in values), marks=marks if is_kept else [*marks, *OTHERS], id="-".join(ids)
    )


def _word(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
