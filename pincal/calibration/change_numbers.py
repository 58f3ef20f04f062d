"""Numbers of what changed between stations, and of what the model of a calibration lacks."""

from __future__ import annotations

from dataclasses import dataclass
from math import log

from pincal.thresholds import number

_ODDS = "-2 log odds"
_CHANGED = "test_diagnosis.py::test_a_change_of_a_drawn_robot_is_named"
_INTERVALS = "test_moves.py::test_intervals_are_those_of_a_fit_in_which_each_day_has_its_own"
_SEEN_CURVE = "test_other_session.py::test_a_curve_that_was_not_seen_everywhere_is_said_to_be_so"
_JUMP = "test_moves.py::test_a_jump_between_two_days_is_named_with_its_interval"
_STATIONS = "test_moves.py::test_a_robot_that_stays_the_same_moves_in_one_of_a_hundred"


@dataclass(frozen=True, kw_only=True)
class ChangeNumbers:
    """Thresholds of decisions on what changed between stations, and on what a model lacks."""

    moved: float = number(
        0.01,
        "probability",
        _STATIONS,
        "that any change is reported for a robot that is the same at all stations",
        "one robot in a hundred",
    )
    usual: float = number(
        2.0 * log(10.0),
        _ODDS,
        "test_diagnosis.py::test_changes_are_named_in_97_of_100",
        "prior odds of a lost zero of a drive against any other change",
        "odds of 10 to 1",
    )
    wide: float = number(
        30.0,
        "prior sizes",
        _INTERVALS,
        "by which values of stations may differ",
        "chosen: not critical",
    )
    wrong_rows: float = number(
        0.05,
        "ratio",
        _JUMP,
        "of rejected to all rows of a station, up to which they are considered wrong readings",
        "more are unlikely to be wrong readings",
    )
    too_quiet: float = number(
        1e-3,
        "probability",
        "test_moves.py::test_each_station_has_its_repeatability",
        "of noise as low as at one station, below which the fit has mistaken something "
        "else for noise",
        "one sound station in a thousand",
    )
    uneven: float = number(
        0.05,
        "probability",
        "test_moves.py::test_what_no_model_knows_moves_nothing",
        "of differences as large between parts of a station, below which stations may "
        "differ as much",
        "usual",
    )
    matters: float = number(
        0.01,
        "ratio",
        _STATIONS,
        "of a station's squares that a changed parameter explains, above which the model "
        "is wrong there",
        "as for an effect that is named",
    )
    unmodelled: float = number(
        1e-3,
        "probability",
        "test_diagnosis.py::test_an_adequate_model_left_nothing",
        "of an unmodelled effect by chance, given all candidates, above which none is accepted",
        "a new diagnosis is compared with it, so it has to be real",
    )
    degrees: float = number(
        200.0,
        "degrees of freedom",
        "test_diagnosis.py::test_an_instrument_with_more_noise_tells_less",
        "of a calibration's noise estimate, where its number of rows is unknown",
        "chosen: as for a typical table",
    )
    rows_each: int = number(
        4, "rows per parameter", _CHANGED, "below which a curve is not tried", "chosen: for time"
    )
    curve_seen: float = number(
        0.5,
        "ratio",
        _SEEN_CURVE,
        "of posterior to prior standard deviation of a curve about its mean, below which "
        "it was observed",
        "a quarter of the variance; in gaps of 25 degrees of a UR10's table it is .6 and "
        "more, near its rows .1",
    )


CHANGES = ChangeNumbers()
