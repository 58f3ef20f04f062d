"""Numbers of the scatter of readings within a stop and of stops at a pose."""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number

_GAIN = "2 log likelihood"
_STOPS = "test_stop_noise.py::test_the_scatter_within_and_between_stops_is_found"
_SHARED = "test_stop_noise.py::test_rows_that_share_an_arrival_count_as_one_stop"


@dataclass(frozen=True, kw_only=True)
class StopNumbers:
    """Thresholds of the scatter of readings within a stop and of stops at a pose."""

    fewest: float = number(
        12.0,
        "degrees of freedom",
        _STOPS,
        "from which on a table's own scatter is used",
        "a standard deviation to 20 %, as of four differences of positions",
    )
    chance: float = number(
        1e-3,
        "probability",
        _STOPS,
        "that repeats of a sound table are left out as gross",
        "one sound table in a thousand",
    )
    gross: float = number(
        4.0,
        "ratio",
        _STOPS,
        "by which repeats scatter more at some poses than usually",
        "an arm stretched out has twice the usual lever",
    )
    sure: float = number(
        2.0,
        "standard deviations",
        "test_stop_noise.py::test_a_check_of_ten_cycles_raises_no_alarm",
        "by which what a model lacks at a pose may exceed its estimate",
        "one-sided limit at 2.5 %",
    )
    shared: float = number(
        4.0,
        _GAIN,
        _SHARED,
        "above which targets of a stop share its arrival",
        "cautious: one table of fifty that share nothing",
    )
    agrees: float = number(
        0.99,
        "probability",
        "test_visit_weights.py"
        "::test_few_poses_that_were_visited_often_have_the_noise_of_their_visits",
        "of the interval of an estimated noise within which a declared one agrees with it",
        "one sound table in a hundred",
    )


STOPS = StopNumbers()
