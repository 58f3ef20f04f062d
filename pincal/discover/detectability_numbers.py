"""Numbers of what a table can show: detectable sizes, and poses that would decide."""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number

_REPORT = "test_discovery_report.py::"
_POWER = _REPORT + "test_effects_of_detectable_size_are_found_nine_times_of_ten"
_APART = _REPORT + "test_tell_apart_stands_exactly_where_there_are_equivalents"


@dataclass(frozen=True, kw_only=True)
class SightNumbers:
    """Detectability of effects, and measurements that would distinguish them."""

    power: float = number(
        0.9, "probability", _POWER, "probability of finding an effect of detectable size", "usual"
    )
    fewest: float = number(
        10.0,
        "degrees of freedom",
        _REPORT + "test_survey_assumes_noise_where_rows_are_too_few_to_tell",
        "below which an effect can't be tested",
        "the noise is known to 22 % then",
    )
    hopeless: float = number(
        1e7,
        "noise variance",
        _REPORT + "test_survey_assumes_noise_where_rows_are_too_few_to_tell",
        "non-centrality beyond which no size is detectable",
        "the readings are too few for it",
    )
    shapes: int = number(
        400,
        "shapes",
        _POWER,
        "of an effect of several parameters over which its power is averaged",
        "to 1.5 % at a power of 0.9",
    )
    told_apart: float = number(
        30.0,
        "noise variance",
        _APART,
        "non-centrality above which two effects count as distinguished",
        "5.5 standard deviations of one parameter",
    )
    telling: float = number(
        1.5,
        "ratio",
        _APART,
        "by which a further run has to be better than repeating the same poses",
        "chosen: repeating the poses is the simpler advice",
    )
    repetitions: float = number(
        50.0,
        "ratio",
        _APART,
        "times the poses of a table above which no further run of its kind is advised",
        "too many to be measured",
    )
    warmer: float = number(
        10.0,
        "K",
        _APART,
        "change of temperature that another run could make",
        "an arm between a cold start and an hour of work",
    )
    moves: tuple[float, ...] = number(
        (-1.5, -0.1, 0.1, 1.5),
        "rad, m",
        _APART,
        "moves by which another run could reach its poses",
        "a large motion, and one as short as in a program",
    )


SIGHT = SightNumbers()
