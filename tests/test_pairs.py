"""Combinations in pairs: each pair of two values is tried in every run, and the whole product before a release."""

from __future__ import annotations

from itertools import combinations, product

import pytest
from pairs import chosen, in_pairs

SIZES = [(11, 6, 3, 2), (60, 4, 3), (5, 3), (4, 4, 4)]


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_every_pair_is_in_few_rows(sizes: tuple[int, ...]) -> None:
    """In no more rows than the two largest factors have pairs, and whatever marks some values have."""
    costs = [[k % 2 for k in range(size)] for size in sizes]
    rows = chosen(costs)

    assert len(rows) == sizes[0] * sizes[1]
    for (i, n), (k, m) in combinations(enumerate(sizes), 2):
        assert {(row[i], row[k]) for row in rows} == set(product(range(n), range(m)))


def test_what_is_left_out_is_marked_and_marks_of_values_stay() -> None:
    """The parameters are the whole product in its order; a value's own mark is on each of its rows."""
    rows = in_pairs("abc", [1, pytest.param(2, marks=pytest.mark.rates)], [False, True])
    marks = [[mark.name for mark in row.marks] for row in rows]

    assert [row.values for row in rows] == list(product("abc", [1, 2], [False, True]))
    assert sum("products" not in names for names in marks) == 6
    assert all(("rates" in names) == (row.values[1] == 2) for row, names in zip(rows, marks, strict=True))
    assert all(("long" in names) == ("products" in names) for names in marks)


def test_values_that_no_row_can_pair_are_an_error() -> None:
    """Where the first two factors have too few levels the pairs of the others would be left out in silence."""
    with pytest.raises(AssertionError, match="too few levels"):
        chosen([[0], [0], [0, 0], [0, 0]])
