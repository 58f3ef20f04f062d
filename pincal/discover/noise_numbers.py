"""Numbers of noise in joints: the scatter of one, and what all of them share."""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number

_SCATTER = "test_scatter.py::test_scatter_of_a_joint_is_found_with_its_size"
_NEIGHBOURS = "test_scatter.py::test_neighbours_tell_scatter_from_a_function"
_JOINT_NOISE = "test_joint_noise.py::test_noise_of_the_joints_is_found_with_its_size"


@dataclass(frozen=True, kw_only=True)
class NoiseNumbers:
    """Scatter of one joint, and noise of all joints."""

    scatter: float = number(
        25.0,
        "2 log likelihood",
        "test_scatter.py::test_noise_of_several_targets_is_no_scatter",
        "smallest gain by scatter of a joint",
        "5 standard deviations of one parameter, so that no joint exceeds it by chance: neither "
        "noise nor several targets do, 50 urad of scatter do",
    )
    beyond_alike: float = number(
        6.0,
        "2 log likelihood",
        "test_scatter.py::test_drives_alike_are_no_model_error",
        "gain of one joint over all alike, below which an excess that may be scatter is that of "
        "all",
        "the largest of six joints exceeds it by chance in one sound table of twenty-five; 60 "
        "urad of one joint gain 9 to 46 in 24 poses",
    )
    ratios: tuple[float, float, int] = number(
        (-2.0, 3.0, 101),
        "log10, log10, number",
        _SCATTER,
        "candidate variances of the joint, in units of the noise seen at the joint's mean lever",
        "an eighth apart: a likelihood is flatter",
    )
    chance: float = number(
        0.01,
        "probability",
        _NEIGHBOURS,
        "that scatter is mistaken for a function of the pose, and noise of replicates for scatter",
        "one line of a report in a hundred may be chance",
    )
    neighbours: int = number(
        6,
        "poses",
        _NEIGHBOURS,
        "nearest to a pose",
        "chosen: twice as many as joints on which a function depends",
    )
    smooth: float = number(
        0.15,
        "ratio",
        _NEIGHBOURS,
        "fraction of a joint's range over which a smooth function keeps most of its value",
        "one period per range",
    )
    most_joints: int = number(
        3,
        "joints",
        "test_scatter.py::test_a_function_of_two_joints_is_no_scatter",
        "on which a function depends, if not on all",
        "chosen: of more, no table has near poses",
    )
    near_joints: int = number(
        2,
        "joints",
        _NEIGHBOURS,
        "of which neighbours have to be near for a function of them to be excluded",
        "as many as those on which an effect of the catalogue depends",
    )
    apart: float = number(
        1.05,
        "ratio of variances",
        "test_rows.py::test_a_sample_of_rows_far_apart_is_searched_once",
        "factor on the variance of a mean of the rows from which effects are selected, below which "
        "noise correlated along all rows counts as independent in these",
        "standard deviations change by less than 2.5 %, and no name hangs on that",
    )
    beyond: float = number(
        2.0,
        "standard deviations",
        _NEIGHBOURS,
        "beyond the critical value at which a smooth function is expected, for its "
        "absence to exclude it",
        "1 in 40 by chance",
    )
    draws: int = number(
        299,
        "permutations",
        _NEIGHBOURS,
        "of the errors",
        "three of them exceed the limit by chance",
    )
    visits: int = number(1000, "visits", _SCATTER, "beyond which they are thinned", "for time")
    turns: int = number(
        3,
        "rounds",
        "test_common_scatter.py::test_a_joint_that_scatters_more_than_the_others_is_named",
        "in which the scatter of one joint and that of all are estimated in turn",
        "the likelihood then changes by less than 1",
    )
    joints: float = number(
        25.0,
        "2 log likelihood",
        "test_joint_noise.py::test_even_noise_is_left_as_it_is",
        "smallest gain by noise of the joints",
        "without any, 120 tables had up to 13, half of them up to 2",
    )
    readings_each: float = number(
        5.0,
        "readings per parameter",
        _JOINT_NOISE,
        "below which a fit absorbs too much of the residuals",
        "then a fifth of their variance",
    )
    rows: int = number(
        1000, "rows", _JOINT_NOISE, "that determine the variances well enough", "to 5 %"
    )
    start: float = number(
        0.3,
        "noise variance",
        "test_joint_noise.py::test_variances_are_where_residuals_are_likeliest",
        "where the search for the variances begins",
        "chosen: only the time depends on it",
    )
    bounds: tuple[float, float] = number(
        (1e-6, 1e4),
        "noise variance",
        "test_joint_noise.py::test_variances_are_where_residuals_are_likeliest",
        "bounds on these variances",
        "negligible, and dominant",
    )


NOISE = NoiseNumbers()
