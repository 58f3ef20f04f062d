"""Numbers of the places and regions where a misfit is said to be."""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number

_REPORT = "test_discovery_report.py::"
_LOCATED = _REPORT + "test_the_hidden_effect_is_named_and_was_located_before"
_NOWHERE = _REPORT + "test_nothing_is_located_where_there_is_only_noise"


@dataclass(frozen=True, kw_only=True)
class PlaceNumbers:
    """Places and regions of misfit that are reported."""

    chance: float = number(
        0.01,
        "probability",
        _NOWHERE,
        "that data without an effect show a place, or a range of the workspace",
        "one line of a report in a hundred may be chance",
    )
    share: float = number(
        0.05,
        "ratio",
        _LOCATED,
        "fraction of the excess below which a further place is not reported",
        "chosen: too small to be relevant",
    )
    places: int = number(
        3,
        "places",
        _LOCATED,
        "and regions, of one station and of all together, that are reported",
        "what a reader can act on",
    )
    pieces: int = number(
        8, "functions", _LOCATED, "of a smooth curve of a position", "two periods over the range"
    )
    own_pieces: tuple[int, ...] = number(
        (24, 60),
        "functions",
        _LOCATED,
        "of a curve of the joint's own position, in addition",
        "as fine as the harmonics of a gear",
    )
    slow_pieces: int = number(
        5, "functions", _LOCATED, "of a curve of payload, temperature and time", "they vary slowly"
    )
    distinct: int = number(
        10,
        "values",
        _REPORT + "test_a_range_is_named_only_if_most_sits_in_it",
        "of a variable below which it has no narrow range",
        "chosen: a range of four of them, at most",
    )
    most: float = number(
        0.6,
        "ratio",
        _REPORT + "test_a_range_is_named_only_if_most_sits_in_it",
        "fraction of the misfit that one range has to contain",
        "chosen: most of it",
    )
    narrow: float = number(
        0.4,
        "ratio",
        _REPORT + "test_a_range_is_named_only_if_most_sits_in_it",
        "fraction of the whole range and of the rows that this range contains at most",
        "chosen: evenly spread, two fifths would contain two fifths",
    )
    rows: int = number(
        1000,
        "rows",
        _LOCATED,
        "beyond which they are thinned",
        "for time: a place worth reporting shows in fewer",
    )
    shuffles: int = number(
        300,
        "permutations",
        _NOWHERE,
        "of the rows in the test of a range of the workspace",
        "three of them exceed the limit by chance",
    )
    pointed: float = number(
        0.55,
        "ratio",
        _LOCATED,
        "fraction of the excess that a direction has to contain",
        "more than half; a third would be isotropic",
    )
    above: float = number(
        4.0,
        "standard deviations",
        _NOWHERE,
        "by which it has to exceed the noise",
        "1 in 30000 by chance",
    )


WHERE = PlaceNumbers()
