"""Numbers of the searches for waves, maps of two joints, and periods."""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number

_REPORT = "test_discovery_report.py::"
_PERIOD = _REPORT + "test_period_is_that_of_a_tone_and_none_of_anything_else"
_STAGE = "test_tones.py::test_a_stage_is_found_at_its_order"
_QUIET = "test_tones.py::test_sound_residuals_show_no_wave"
_LINE = "test_tones.py::test_what_the_span_does_not_tell_apart_is_one_line"
_PEAK = "test_joint_pairs.py::test_what_is_not_refined_would_not_be_found"
_OF_TWO = "test_joint_pairs.py::test_a_wave_of_two_joints_is_found_with_its_orders"
_SCAN = "test_tones.py::test_the_scan_is_least_squares_of_a_sine_and_a_cosine"


@dataclass(frozen=True, kw_only=True)
class WaveNumbers:
    """Search for waves of high order, maps of two joints, and periods."""

    step: float = number(
        0.25,
        "periods over the whole range",
        _SCAN,
        "steps of a periodogram",
        "the highest is then seen at 95 % of its square or more",
    )
    fine: int = number(
        48,
        "steps",
        _SCAN,
        "of one of the two small matrices; the other has the rest",
        "chosen for time: about the root of all steps",
    )
    closer: int = number(
        16,
        "steps",
        _STAGE,
        "on either side of the highest gain, to refine its order",
        "a sixtieth of a resolution",
    )
    piece: int = number(
        4096,
        "rows",
        _STAGE,
        "whose exponentials are held in memory at once",
        "chosen for memory: some megabytes",
    )
    worth: float = number(
        0.05,
        "probability",
        _QUIET,
        "p-value of the highest wave, and of the best map, below which it becomes a candidate",
        "the subsequent test is exact and stricter",
    )
    aliases: int = number(
        3,
        "waves",
        "test_tones.py::test_a_grid_of_positions_does_not_tell_orders_apart",
        "other orders that explain as much, at most",
        "what a reader can act on",
    )
    phases: float = number(
        1e-3,
        "ratio",
        "test_tones.py::test_a_grid_of_positions_does_not_tell_orders_apart",
        "fraction of V^2 by which two phases of a wave have to differ to be distinguished",
        "less is rounding of positions on a grid",
    )
    digits: int = number(
        2, "digits", _STAGE, "after the decimal point of an order", "finer than any span resolves"
    )
    close: float = number(
        1.0,
        "cycles per revolution",
        "test_tones.py::test_a_wave_found_again_close_by_came_in_so",
        "orders closer than this are the same wave",
        "stages of a drive differ by more",
    )
    line: float = number(
        2.0,
        "resolutions",
        _LINE,
        "up to which two waves may be one line",
        "each is within one resolution of their mean",
    )
    map_forms: int = number(
        3,
        "resolutions",
        "test_maps.py::test_a_map_is_as_fine_as_rows_and_positions_allow",
        "of the likeliest map, of which the coarsest and the finest are tested",
        "chosen: its other resolutions are tried once it has entered",
    )
    map_seen: float = number(
        1e-6,
        "ratio",
        "test_maps.py::test_a_function_of_two_joints_is_found_with_both",
        "fraction of the largest diagonal below which a cell of a map has no pose",
        "a thousandth of the largest lever",
    )
    smooth: float = number(
        6.0,
        "cycles per revolution",
        _OF_TWO,
        "of each of two joints, up to which their waves count as smooth",
        "a period is 60 degrees; a table of some hundreds of poses has several in it",
    )
    pair_step: float = number(
        0.5,
        "periods over the whole range",
        _OF_TWO,
        "steps of the search for waves of two joints",
        "the highest is then seen at three quarters of its square or more, and refined",
    )
    pair_closer: int = number(
        4,
        "steps",
        _PEAK,
        "on either side of the highest gain of two joints, to bound what refining it finds",
        "an eighth of a period each, so the highest is seen at 97 % of its square or more",
    )
    pair_seen: float = number(
        0.9,
        "ratio",
        _PEAK,
        "fraction of the refined gain of two joints that these steps see at least",
        "97 %, with a margin",
    )
    periods: float = number(
        1.8,
        "periods",
        _PERIOD,
        "that have to be observed for a curve to be called periodic",
        "nearly two",
    )
    tone: float = number(
        0.7,
        "ratio",
        _PERIOD,
        "fraction of the excess that one tone has to explain for that",
        "chosen: most of it",
    )
    period: float = number(
        1e-3,
        "probability",
        _PERIOD,
        "p-value of the strongest tone for that",
        "chosen: it only affects the wording of a report",
    )
    fewest: int = number(
        20, "rows", _PERIOD, "below which no period is searched for", "chosen: ten per period"
    )
    finest: float = number(
        0.25,
        "periods per row",
        _PERIOD,
        "that are searched for at most",
        "half of what evenly spaced rows resolve",
    )
    oversampled: int = number(
        8,
        "steps per period",
        _REPORT + "test_gains_of_tones_are_those_of_least_squares",
        "over the whole range, of the search for periods",
        "a tone between two steps is seen at 98 % of its square",
    )


WAVES = WaveNumbers()
