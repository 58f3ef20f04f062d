"""Habits of the code that nothing else would notice."""

import re
from pathlib import Path

import pincal

PACKAGE = Path(pincal.__file__).resolve().parent
# Where a vector is divided among a model and a sensor.
DIVIDES = ("model/model.py", "identify/station.py", "parameters.py")


def test_parameters_are_found_by_name() -> None:
    """Not by counting how many stand before them: nobody else needs to know in which order they stand."""
    counted = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        place = path.relative_to(PACKAGE).as_posix()
        text = path.read_text(encoding="utf-8")
        found = re.findall(r"\[[^\]]*n_parameters\s*:|\[\s*:[^\]]*n_parameters[^\]]*\]", text)
        if found and place not in DIVIDES:
            counted[place] = found

    assert counted == {}
