"""Numbers of rows that do not fit: whether they gather, or have something in common."""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number

_CLUSTER = "test_rows.py::test_outliers_gather_or_do_not"
_BUMP = "test_rows.py::test_a_bump_of_a_drive_is_told_by_its_joint_and_place"
_IN_COMMON = "test_agreement.py::test_what_outliers_have_in_common_is_told"


@dataclass(frozen=True, kw_only=True)
class GatheringNumbers:
    """Thresholds by which rows that do not fit are said to lie in one place, or to have something
    in common.
    """

    chance: float = number(
        1e-4,
        "probability",
        _CLUSTER,
        "of a cluster of outliers anywhere in a sound table",
        "one table in ten thousand",
    )
    fewest: int = number(
        3, "outliers", _CLUSTER, "that make a cluster", "two are neighbours too often"
    )
    bump_chance: float = number(
        0.005,
        "probability",
        _BUMP,
        "of a bump anywhere on the drives of a sound arm",
        "one arm in two hundred",
    )
    in_bump: int = number(
        5, "rows", _BUMP, "in a window in which a joint may have a bump, at least", "chosen"
    )
    part: float = number(
        1 / 8,
        "ratio",
        _BUMP,
        "of the rows in a window to all, at most",
        "others have to show what windows are like",
    )
    clipped: float = number(
        4.0,
        "ratio",
        _BUMP,
        "of errors to the typical one, to which larger ones are clipped",
        "a few wrong rows make no bump",
    )
    outlier: float = number(
        8.0,
        "ratio",
        _BUMP,
        "of errors to the typical one, beyond which they are left out",
        "a few wrong rows make no bump",
    )
    permuted: float = number(
        0.25,
        "probability",
        _BUMP,
        "of a bump by disjoint windows, above which it is none and nothing is permuted",
        "it is 5 to 50 times as large as that by permutations",
    )
    explained: float = number(
        0.8,
        "ratio",
        _IN_COMMON,
        "of the squares that a misread joint has to explain to be named",
        "chosen",
    )
    mistold: float = number(
        0.3,
        "ratio",
        _IN_COMMON,
        "of the rows of a region that are classified wrongly to those that do not fit, at most",
        "chosen",
    )


GATHERED = GatheringNumbers()
