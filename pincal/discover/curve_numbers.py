"""Numbers of drive curves: how finely and how smoothly they are resolved."""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number

_RATES = "test_discovery_rates.py::"
_SMOOTH = "test_smooth_curves.py::test_a_smooth_curve_is_closer_to_the_true_one"
_LIKELIEST = "test_smooth_curves.py::test_roughness_is_where_the_readings_are_likeliest"
_REPEATS = "test_repeats.py::"


@dataclass(frozen=True, kw_only=True)
class CurveNumbers:
    """Resolution and roughness of drive curves."""

    enough: int = number(
        44,
        "positions",
        _REPEATS + "test_what_repeated_positions_can_not_tell_is_said",
        "distinct positions of a joint that are enough for most gears",
        "fewer are worth a note if there are more poses",
    )
    forms: int = number(
        3,
        "resolutions",
        _RATES + "test_a_whole_curve_takes_the_place_of_its_part",
        "of a whole curve, the coarsest ones, that are tested in addition to a simple one",
        "chosen: three are enough to detect a remainder, and p-values are corrected for "
        "their number",
    )
    roughness: float = number(
        0.1,
        "rad^-0.5",
        _LIKELIEST,
        "where the search for the roughness begins",
        "chosen: only the time depends on it",
    )
    moves: int = number(
        15,
        "times",
        _LIKELIEST,
        "that the roughness is updated at most",
        "chosen: a bound on the time",
    )
    settled: float = number(
        0.05,
        "ratio",
        _LIKELIEST,
        "relative change below which the updates end",
        "a curve hardly depends on that",
    )
    farthest: float = number(
        10.0,
        "ratio",
        _LIKELIEST,
        "of an update at most",
        "chosen: a step that is too long is reversed by the next",
    )
    least: float = number(
        1e-5,
        "rad^-0.5",
        _SMOOTH,
        "least roughness",
        "below it a curve strays from a straight line by less than 0.01 mrad in a radian",
    )
    least_noise: float = number(
        1e-3,
        "ratio",
        _SMOOTH,
        "lower bound on the estimated noise, as a fraction of its variance",
        "curves through all readings leave no noise",
    )
    firm: float = number(
        30.0,
        "ratio",
        _SMOOTH,
        "additional prior information of other parameters in the step with the curves, in "
        "units of their priors'",
        "a full step diverges where compliances multiply positions of bearings",
    )
    enough_pieces: int = number(
        180,
        "pieces",
        "test_smooth_curves.py::test_a_curve_ends_finer_up_to_enough_pieces",
        "up to which a curve ends finer than the shortest resolved wave",
        "for time: 12000 poses resolve more",
    )
    densely: int = number(
        8,
        "positions per piece",
        _SMOOTH,
        "at which a curve is resampled when its resolution changes",
        "chosen: a spline is smooth between them",
    )


CURVES = CurveNumbers()
