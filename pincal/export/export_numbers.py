"""The thresholds by which an export is refused, or says what it leaves out, each with its unit and
origin.
"""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number


@dataclass(frozen=True, kw_only=True)
class ExportNumbers:
    """Thresholds of exports."""

    formulas: float = number(
        1e-12,
        "m, elements of the rotation matrix",
        "test_export.py::test_formulas_that_differ_from_the_model_are_refused",
        "difference between poses of the formulas and of the model, above which they are not "
        "exported",
        "a thousand times the rounding of a metre",
    )
    geometry: float = number(
        1e-9,
        "m, elements of the rotation matrix",
        "test_export_formats.py::test_a_table_that_is_not_the_arm_is_refused",
        "difference between poses of a table of parameters and of the model, above which it is not "
        "exported",
        "rounding of nine decimal places",
    )
    moved: float = number(
        1e-9,
        "m or rad",
        "test_export_formats.py::test_the_xacro_of_ur_description_makes_the_calibrated_arm",
        "motion of the tip that a format can't have, above which a note says so",
        "what the format resolves",
    )
    uncertainty: float = number(
        0.05,
        "ratio",
        "test_export.py::test_source_code_gives_the_uncertainty_of_predictions",
        "by which the uncertainty by formulas may differ from that of the model, above which it is "
        "not exported",
        "a load bends an arm otherwise where parameters differ, and u itself is known no better",
    )
    still: float = number(
        1e-12,
        "m, elements of the rotation matrix",
        "test_corrector.py::test_the_page_predicts_and_compensates_as_the_model_does",
        "by which the base varies over times and temperatures, up to which it is fixed",
        "a thousand times the rounding of a metre",
    )


EXPORT = ExportNumbers()
