"""The numbers by which a fitted model, or new rows, are judged."""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number

_ANOTHER_MONTH = "test_validation.py::test_a_real_robot_of_another_month_is_the_same"
_MOVED = "test_validation.py::test_a_moved_instrument_is_told"
_CYCLES = "test_path_accuracy.py::test_cycles_are_those_of_the_joints"
_VERDICTS = "test_verdicts.py::test_few_degrees_of_freedom_tell_nothing"


@dataclass(frozen=True, kw_only=True)
class JudgementNumbers:
    """When residuals exceed the noise, and whose they are."""

    misfit: float = number(
        1e-3,
        "probability",
        "test_replicates.py::test_chances_are_true_where_nothing_is_missing",
        "at which residuals count as too large for the noise, in every test of this kind",
        "one false alarm in a thousand calibrations",
    )
    far: float = number(
        5.0,
        "ratio",
        "test_validation.py::test_another_robot_of_the_type_is_doubted",
        "of residuals on another day to noise and uncertainty, above which there is another cause",
        "a UR10 discovered in one month has 1.7 in the next",
    )
    matters: float = number(
        0.2,
        "ratio",
        _MOVED,
        "of the squares that a displacement of the station has to explain to matter",
        "a tenth of the error",
    )
    local: float = number(
        3.0,
        "ratio",
        _ANOTHER_MONTH,
        "by which a few rows in a corner of the workspace may fit better with another placement",
        "in blocks of 12 to 400 rows of a UR10 under its geometry up to 2.2: the model error of "
        "an arm is a field over the poses",
    )
    sure: float = number(
        0.6,
        "ratio",
        "test_stability.py::test_hints_stand_apart_and_all_are_drawn",
        "of the subsamples of a search in which a name has to occur to be more than a hint",
        "tests/stability_study.py measures how many of such names are right",
    )
    twice: float = number(
        2.0,
        "ratio",
        _VERDICTS,
        "residuals of which multiple of the noise have to be detectable for a verdict",
        "the model error is then 1.7 times the noise, which any plot of the residuals shows",
    )
    power: float = number(
        0.9,
        "probability",
        _VERDICTS,
        "with which they have to be detected",
        "18 degrees of freedom with declared noise, and 30 of pure error with a hundred of the "
        "misfit",
    )
    rounding: float = number(
        10.0,
        "ratio",
        "test_replicates.py::test_squares_by_hand",
        "of the differences of replicates to a reading's rounding, below which they carry no "
        "information on the noise",
        "chosen",
    )


@dataclass(frozen=True, kw_only=True)
class CycleNumbers:
    """How cycles of a path are found in a session in motion."""

    same: float = number(
        0.01,
        "ratio",
        _CYCLES,
        "of the motion of the joints, root mean square, within which their positions coincide",
        "chosen",
    )
    short: float = number(0.02, "ratio", _CYCLES, "of a cycle that the last one may lack", "chosen")
    slow: float = number(
        0.01,
        "ratio",
        "test_path_accuracy.py::test_an_arm_that_stands_still_is_off_in_any_direction",
        "of the median speed below which an arm stands still",
        "chosen",
    )
    often: float = number(
        0.5,
        "ratio",
        _CYCLES,
        "of how often a lag occurs to the most frequent one, from which the shortest is the period",
        "chosen",
    )


JUDGEMENT = JudgementNumbers()
PATHS = CycleNumbers()
