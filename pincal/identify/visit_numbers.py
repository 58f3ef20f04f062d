"""Numbers of poses that were visited, or read, more than once."""

from __future__ import annotations

from dataclasses import dataclass
from math import log

from pincal.thresholds import number

_GAIN = "2 log likelihood"
_WRONG = "test_screening.py::test_wrong_readings_are_named_by_their_lines"
_SHIFTED = "test_visits.py::test_a_change_between_passes_is_found_with_its_line"
_SOUND_VISITS = "test_visits.py::test_sound_visits_raise_no_doubt"
_SCATTER = "test_visits.py::test_visits_that_scatter_more_than_drives_do_are_a_doubt"


@dataclass(frozen=True, kw_only=True)
class VisitNumbers:
    """Thresholds of decisions on the readings of poses that were visited, or read, more
    than once.
    """

    wrong: float = number(
        0.001,
        "probability",
        _WRONG,
        "that a reading of a sound table deviates as much from the others of its pose",
        "one sound table in a thousand",
    )
    fewest: int = number(
        6,
        "readings",
        "test_screening.py::test_few_visits_do_not_judge_each_other",
        "beyond one for each pose, below which readings do not show how they scatter",
        "a limit at one in a thousand is then twice that of a known scatter",
    )
    decided: float = number(
        2.0 * log(1000.0),
        _GAIN,
        _WRONG,
        "by which one of two readings has to agree better with the model for the other to be wrong",
        "odds of 1000 to 1",
    )
    too_many: float = number(
        0.25,
        "ratio",
        _SHIFTED,
        "of wrong to all readings, from which on they are not exceptions",
        "as for rows of a robot that may have changed",
    )
    chance: float = number(
        0.0005,
        "probability",
        _SOUND_VISITS,
        "that a table of sound visits shows a step, a steady or another drift, or a dependence on "
        "the number of the visit, each",
        "with these four tests, one sound table in 500 at most",
    )
    touched: float = number(
        0.008,
        "probability",
        _SOUND_VISITS,
        "that a table of a few sound passes shows a displacement of the instrument "
        "between two of them",
        "five standard deviations of the difference of two means are then seen in 19 of 20 tables",
    )
    as_likely: float = number(
        2.0 * log(1000.0),
        _GAIN,
        _SHIFTED,
        "within which another cause explains a change between visits as well",
        "odds of 1000 to 1",
    )
    as_good: float = number(
        3.84,
        _GAIN,
        _SHIFTED,
        "within which the simpler of two patterns of visits is taken",
        "95 % for one parameter",
    )
    same_line: float = number(
        3.84,
        _GAIN,
        _SHIFTED,
        "within which a step may begin at another line as well",
        "95 % for one parameter",
    )
    both_sides: int = number(
        3,
        "poses",
        _SHIFTED,
        "with visits before and after a step, at least",
        "nine coordinates for the three of a displacement",
    )
    few_passes: int = number(
        5,
        "passes",
        _SOUND_VISITS,
        "up to which a displacement of the instrument between two of them is tested by itself",
        "with more the test of any step, which looks at their seams, too, tells of it",
    )
    clipped: float = number(
        1e-4,
        "probability",
        "test_visits.py::test_wrong_readings_make_no_change_between_visits",
        "of a sound deviation to whose size larger ones are clipped",
        "single wrong readings make no pattern",
    )
    permuted: float = number(
        0.01,
        "probability",
        _SOUND_VISITS,
        "of a pattern without multiplicity, above which it is none and nothing is permuted",
        "twenty times the limit of any pattern",
    )
    arrival: float = number(
        1.5e-4,
        "rad or m",
        _SCATTER,
        "standard deviation of the arrival of a drive, above which visits scatter by more "
        "than drives do",
        "drives repeat to 1e-5 to 9e-5 rad (Slamani 2012)",
    )


VISITS = VisitNumbers()
