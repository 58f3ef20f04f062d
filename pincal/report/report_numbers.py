"""The thresholds by which a report says or advises something, each with its unit and origin."""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number


@dataclass(frozen=True, kw_only=True)
class ReportNumbers:
    """Thresholds of what a report says."""

    overfitted: float = number(
        1.3,
        "ratio",
        "test_report_html.py::test_more_poses_are_advised_where_held_out_errors_are_larger",
        "of held-out to fitted rms errors, above which more poses are advised",
        "N rows and p parameters make it sqrt((N + p) / (N - p)): a quarter of the readings has "
        "gone into parameters",
    )
    much: float = number(
        1.5,
        "ratio",
        "test_report_html.py::test_more_poses_are_advised_where_the_model_expects_larger_errors",
        "of the error that the model expects elsewhere to that at poses like the measured ones, "
        "above which more poses are advised",
        "chosen: the latter includes the noise of the instrument",
    )
    narrow: float = number(
        0.3,
        "ratio",
        "test_report_html.py::test_a_joint_that_hardly_moved_is_named",
        "of a joint's range that the poses cover, below which it is named as one that hardly moved",
        "chosen: with a turn as the range, a wave of one period is hard to tell from a slope there",
    )
    improved: float = number(
        1.05,
        "ratio",
        "test_report_html.py::test_a_ratio_that_rounds_to_one_is_left_out",
        "of errors before and after, below which it is not mentioned",
        "it rounds to 1.0",
    )
    beyond_noise: float = number(
        5e-4,
        "mm",
        "test_discovery_report.py::test_errors_below_what_is_printed_are_not_mentioned",
        "of errors beyond the noise, below which a verdict does not mention them",
        "it is printed as 0.000",
    )


REPORT = ReportNumbers()
