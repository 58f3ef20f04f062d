"""How the rooms of the library are kept; ``python tests/house.py`` prints all of it."""

from __future__ import annotations

import ast
import importlib
from dataclasses import fields
from functools import cache
from pathlib import Path

import pytest
from house import House

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
# Numbers at the top of other files of rooms in which something is decided: they bound a computation (rows looked at, steps,
# memory, rounding) or a prior, and nothing is named, kept or refused by them.
BOUNDS = {
    "calibration.station_information": "_SEEN _ROUNDING _BEYOND_ROUNDING _MOST",
    "identify.arrival_likelihood": "_BOUNDS _QUIETEST _LOUDEST _ANYWHERE _MOST_STOPS _ROUNDING _NOTHING",
    "identify.beliefs": "_FARTHEST _FREE _LEAST _MOST",
    "identify.believed": "_LEAST",
    "identify.calibrate": "_WEIGHINGS _SAME_WEIGHT _SCREENINGS _SCALINGS _CLOSE",
    "identify.choices": "_ROWS",
    "identify.dependence": (
        "_BANDS _NEAR _NEAREST _READINGS _ROWS _STARTS _LONGEST _MEMORIES _LENGTHS _BLOCK_READINGS _MOST_STATIONS "
        "_MOST_AT_ONCE"
    ),
    "identify.equations": "_MOST_KEPT _MOST_AT_ONCE",
    "identify.explain": "_ONE _SAME _RANK _ROWS _TOGETHER",
    "identify.fit": "MOST_STEPS",
    "identify.folds": "_FOLDS _MANY _LARGEST _STEPS _SHORT _LINEAR",
    "identify.initial": "_ROWS _SETTLED_ROWS _FEWEST_SETTLED_ROWS _ALIKE",
    "identify.jacobian": "_PADDING _AT_ONCE",
    "identify.many_rows": "MANY EACH",
    "identify.motion_fields": "_MOVED _NOTHING",
    "identify.noise": "_POLISHING MOST_EXACT _PARTS _STRONG _CORRECTIONS _COARSE _EXACT",
    "identify.normal": "_MOST_CHANGED",
    "identify.options": "LENGTH_BOUND",
    "identify.posterior": "_ROUNDING",
    "identify.problem": "_ROWS",
    "identify.quadratic": "SEEN ROUNDING NULL",
    "identify.prior_scale": "_SCALES _ROUNDS _ANYWHERE",
    "identify.screening": "_ROUNDS",
    "identify.solve": (
        "SETTLED _ROUGH _NEAR _TRIALS _ROUNDED _STEADY _SETTLED _MEMORY _SLOW _FIRST _MORE _LESS _MOST _REPAIR _HALVINGS"
    ),
    "identify.split": "_BLOCKS",
    "identify.station": "PIECE",
    "identify.visit_scatter": "_ROUNDS _BEYOND _LEAST _RANK _FEW",
    "identify.stop_scatter": "_LOGITS _MOST_ROWS _RANK",
    "identify.visit_weights": "_SAME _AGREES",
    "identify.whitening": "_TILE",
}
# Rooms, and files of other rooms, in which no number at the top decides anything.
GUARDED = {
    *("compensate", "design", "discover", "diagnosis", "export", "fleet", "hypotheses", "identify", "io", "measure"),
    *("model", "motion", "programs", "report", "robot", "viewer"),
    *("calibration.agreed", "calibration.moves", "calibration.unmodelled"),
    *("validate.agreement", "validate.causes", "validate.clock_jumps", "validate.cures", "validate.gathered"),
    *("validate.midway", "validate.rough_fit", "validate.trials", "validate.visit_scan", "validate.visits"),
}


@cache
def files_and_tests() -> set[str]:
    """Return the files of this folder, and their functions as pytest names them."""
    known = set[str]()
    for path in TESTS.glob("*.py"):
        names = (node.name for node in ast.parse(path.read_text("utf-8")).body if isinstance(node, ast.FunctionDef))
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
    """None at the top of discover's other files, and elsewhere only those that bound a computation."""
    guarded = GUARDED | BOUNDS.keys()
    found = {of.name: " ".join(of.numbers) for of in HOUSE.files if of.numbers and {of.room, of.name} & guarded}

    assert found == BOUNDS


def test_no_name_stands_in_two_places() -> None:
    """No public name is defined in two files, and no file of one room has the name of one in another."""
    assert not HOUSE.twice_defined
    assert not HOUSE.twice_named


def test_few_functions_take_many_arguments() -> None:
    """Eight arguments or more are the exception."""
    assert len(HOUSE.crowded) <= 8


def test_a_problem_can_be_known_by_heart() -> None:
    """At most twenty public attributes and methods."""
    fields_and_methods = {name for name in (*Problem.__annotations__, *vars(Problem)) if not name.startswith("_")}

    assert len(fields_and_methods) <= 20
