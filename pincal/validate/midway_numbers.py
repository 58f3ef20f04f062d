"""Numbers of a change between two rows."""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number

_GAIN = "2 log likelihood"
_STEP = "test_midway.py::test_what_changed_midway_is_named_with_its_line"
_NO_STEP = "test_midway.py::test_a_table_in_which_nothing_changed_is_left_alone"


@dataclass(frozen=True, kw_only=True)
class MidwayNumbers:
    """Thresholds of a change between two rows."""

    each: int = number(
        10,
        "rows",
        _STEP,
        "on either side of a step, at least",
        "thirty readings show its size to a fifth",
    )
    clipped: float = number(
        5.0,
        "ratio",
        _NO_STEP,
        "of residuals to the typical one, to which larger ones are clipped",
        "single wrong readings make no step",
    )
    examined: float = number(
        25.0,
        "variances of means of neighbours",
        _NO_STEP,
        "gain above which a step is examined",
        "simulated machines have up to 12, real arms measured along a grid 31",
    )
    chance: float = number(
        1e-4,
        "probability",
        _NO_STEP,
        "of a step by chance, over all rows and fields, if the covariance were known",
        "one sound table in ten thousand",
    )
    distinguished: float = number(
        13.8, _GAIN, _STEP, "within which causes are not distinguished", "a thousand to one"
    )
    least_part: float = number(
        1.2,
        "ratio",
        "test_midway.py::test_drifts_are_no_changes",
        "of a step to the residuals, at least, where noise is correlated along the rows",
        "a model's error reaches 1.06 (a UR10 without its drives' curves), a touched target 2",
    )
    correlated: float = number(
        0.01,
        "ratio",
        "test_midway.py::test_drifts_are_no_changes",
        "of the off-diagonal part of the precision to its diagonal, above which noise is "
        "correlated",
        "chosen",
    )
    in_any_order: float = number(
        1e-3,
        "probability",
        "test_midway.py::test_what_a_model_lacks_is_no_change",
        "of as large a step in random orders of the rows",
        "one false alarm in a thousand calibrations",
    )
    clock: float = number(
        1e-3,
        "s",
        "test_motion_stations.py::test_a_clock_that_slips_has_a_step_with_its_uncertainty",
        "jump of a clock, above which it is estimated by a calibrated arm in motion",
        "neither an error of an arm nor a sound clock makes one",
    )


MIDWAY = MidwayNumbers()
