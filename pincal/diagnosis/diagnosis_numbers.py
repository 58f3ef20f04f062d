"""Numbers of what changed since a calibration."""

from __future__ import annotations

from dataclasses import dataclass
from math import log

from pincal.thresholds import number

_ODDS = "-2 log odds"
_SAME = "test_diagnosis.py::test_a_robot_that_has_not_changed_is_left_alone"
_GROSS = "test_other_session.py::test_rows_of_which_many_are_gross_tell_nothing"
_REFUSED = "test_diagnosis.py::test_what_can_not_be_told_is_refused"
_CURVE = "test_other_session.py::test_the_drive_whose_curve_is_another_is_named"
_EXCLUDED = "test_diagnosis.py::test_what_is_excluded_would_have_been_noticed"
_APART = "test_diagnosis.py::test_poses_that_tell_two_changes_apart_are_named"


@dataclass(frozen=True, kw_only=True)
class DiagnosisNumbers:
    """Thresholds of decisions on what changed since a calibration."""

    false_alarm: float = number(
        0.01,
        "probability",
        _SAME,
        "of an alarm for a robot that has not changed",
        "one check in a hundred",
    )
    for_changes: float = number(
        0.8, "ratio", _SAME, "of it allotted to single changes", "chosen: most changes have a name"
    )
    for_misfit: float = number(
        0.2, "ratio", _SAME, "of it allotted to a misfit that no change explains", "the rest"
    )
    equivalent: float = number(
        2.0 * log(100.0),
        _ODDS,
        _APART,
        "below which two changes are indistinguishable",
        "unless one is 100 times as likely",
    )
    wrong_row: float = number(
        0.001,
        "probability",
        "test_diagnosis.py::test_one_wrong_reading_is_no_change",
        "that a row of a sound table is mistaken for a wrong reading",
        "one sound table in a thousand",
    )
    fewest_rows: int = number(
        8,
        "rows",
        "test_diagnosis.py::test_one_wrong_reading_is_no_change",
        "up to which none is considered a wrong reading",
        "too few to decide",
    )
    too_many: float = number(
        0.25,
        "ratio",
        _GROSS,
        "of outlying to all rows, from which on they are not exceptions",
        "in real tables some per cent are",
    )
    part_of_noise: float = number(
        0.95,
        "ratio",
        "test_diagnosis.py::test_what_a_model_left_is_no_change",
        "of the estimated noise of a calibration that an unmodelled effect may have caused",
        "nearly all of it",
    )
    hopeless: float = number(
        0.01,
        "ratio",
        _REFUSED,
        "of the residuals after all changes to the reach, above which the rows belong to "
        "another robot",
        "a centimetre on a metre",
    )
    strange: float = number(
        0.1,
        "ratio",
        _REFUSED,
        "of the residuals before any change to the reach, above which no change is searched for",
        "a drive with an error of 0.2 rad leaves half as much",
    )
    vanished: float = number(
        0.0455,
        "probability",
        "test_stop_noise.py::test_what_is_announced_exceeds_its_uncertainty",
        "of a change as large given all others, above which it is not announced",
        "two of its standard deviations",
    )
    many: int = number(
        4,
        "changes",
        _REFUSED,
        "from which on another robot of the same type is more likely",
        "chosen: a bound on what is believable",
    )
    worth_a_note: float = number(
        0.9,
        "ratio",
        _CURVE,
        "of errors, and of rows, below which another curve of a drive is worth a note",
        "a tenth better",
    )
    curve_rows: int = number(
        24, "rows", _CURVE, "that allow cross-validation", "three for each block"
    )
    curve_blocks: int = number(
        8,
        "blocks",
        _CURVE,
        "of cross-validation, each of a few regions of joint space",
        "as in a discovery",
    )
    detected: float = number(
        0.9,
        "probability",
        _EXCLUDED,
        "that a change of the stated size would have been detected",
        "usual: a power of 0.9",
    )
    resolvable: float = number(
        1e-6,
        "m",
        _APART,
        "displacement up to which no instrument tells two changes apart",
        "the best laser trackers resolve a tenth of it, and repeat no better on a target at rest",
    )
    told_apart: float = number(
        30.0,
        "noise variance",
        _APART,
        "non-centrality at which two changes are distinguishable",
        "5.5 standard deviations of one parameter",
    )
    same_by_chance: int = number(
        1,
        "rows",
        "test_diagnosis.py::test_rows_that_the_model_was_fitted_to_tell_nothing",
        "that share the fingerprint of a row of the calibration by chance",
        "hardly one in some thousands of rows",
    )


DIAGNOSIS = DiagnosisNumbers()
