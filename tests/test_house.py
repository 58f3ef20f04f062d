"""How the rooms of the library are kept; ``python tests/house.py`` prints all of it."""

from __future__ import annotations

import ast
import importlib
import re
from dataclasses import fields
from functools import cache
from pathlib import Path

import pytest
from house import House
from trees import parsed

import pincal
from pincal.identify.problem import Problem

TESTS = Path(__file__).parent
HOUSE = House.at(Path(pincal.__file__).parent)
# Files that hold numbers which decide, each with its unit, meaning, origin and test.
POLICIES = [
    importlib.import_module(f"pincal.{of.name}")
    for of in HOUSE.files
    if of.name in ("discover.policy", "identify.criteria") or of.name.endswith("_numbers")
]
NUMBERS = [
    thing
    for module in POLICIES
    for thing in vars(module).values()
    if hasattr(thing, "__dataclass_fields__") and not isinstance(thing, type)
]


@cache
def files_and_tests() -> set[str]:
    """Return the files of this folder, and their functions as pytest names them."""
    known = set[str]()
    for path in TESTS.glob("*.py"):
        names = (node.name for node in parsed(path.read_text("utf-8")).body if isinstance(node, ast.FunctionDef))
        known |= {path.name, *(f"{path.name}::{name}" for name in names)}
    return known


@pytest.mark.parametrize("numbers", NUMBERS, ids=lambda numbers: type(numbers).__name__)
def test_numbers_that_decide_stand_in_a_policy(numbers: object) -> None:
    """Each with its unit, its meaning, why it has this value, and a test that is there."""
    known = files_and_tests()

    for entry in fields(numbers):  # type: ignore[arg-type]
        assert all(entry.metadata[key].strip() for key in ("unit", "meaning", "origin", "pinned_by")), entry.name
        assert entry.metadata["pinned_by"] in known, entry.name


def test_no_other_number_decides() -> None:
    """All others are said to bound a computation or a page (Count), or to be of nature, a prior or a format (Scale).

    The simulator's are properties of simulated machines.
    """
    found = {of.name: of.numbers for of in HOUSE.files if of.numbers and of.room != "simulate"}

    assert not found


def test_no_name_stands_in_two_places() -> None:
    """No public name is defined in two files, and no file of one room has the name of one in another."""
    assert not HOUSE.twice_defined
    assert not HOUSE.twice_named


def test_few_functions_take_many_arguments() -> None:
    """Eight arguments or more are the exception."""
    assert len(HOUSE.crowded) <= 8


def test_few_bodies_are_long() -> None:
    """A body of more than thirty lines is the exception: a kernel in a loop, or a record of many fields."""
    assert len(HOUSE.long_bodies) <= 20


def test_a_statement_assigns_one_thing() -> None:
    """Several expressions at once are the exception: a pair that one condition chooses."""
    assert len(HOUSE.parallel) <= 25


def test_a_problem_can_be_known_by_heart() -> None:
    """At most twenty public attributes and methods."""
    fields_and_methods = {name for name in (*Problem.__annotations__, *vars(Problem)) if not name.startswith("_")}

    assert len(fields_and_methods) <= 20


def test_chances_are_written_by_one_rule() -> None:
    """No file but that of units gives a p-value a format of its own, by which 1e-130 and no number at all were shown."""
    written = [file.name for file in HOUSE.files if re.search(r"p_value\)?:[.0-9]*[efg]\b", file.text)]
    assert set(written) <= {"units"}, written
