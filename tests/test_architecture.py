"""Habits of the code that nothing else would notice."""

import re
from pathlib import Path

import pytest

import pincal

PACKAGE = Path(pincal.__file__).resolve().parent
# Where a vector is divided among a model and a sensor.
DIVIDES = ("model/model.py", "identify/station.py", "parameters.py")


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_parameters_are_found_by_name(path: Path) -> None:
    """Not by counting how many stand before them: nobody else needs to know in which order they stand."""
    text = path.read_text(encoding="utf-8")
    found = re.findall(r"\[[^\]]*n_parameters\s*:|\[\s*:[^\]]*n_parameters[^\]]*\]", text)
    assert not found or path.relative_to(PACKAGE).as_posix() in DIVIDES
