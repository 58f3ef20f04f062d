"""``pincal calibrate``: from a URDF and a table to a calibrated model."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from pincal.cli.arguments import verb
from pincal.cli.fitting import EXITS, FILES, FitArguments, Outcome, run_fit
from pincal.errors import Exit

if TYPE_CHECKING:
    from pincal.cli.inputs import Prepared
    from pincal.measure.measurements import Measurements

_EXAMPLES = f"""
Examples:
  pincal calibrate robot.urdf tracker.csv --out results --noise 0.05mm
  pincal calibrate ur10 series.csv --out results --max-error 0.2mm

{FILES}.
"""


@verb(FitArguments, examples=_EXAMPLES, exits=EXITS)
def calibrate(arguments: FitArguments) -> Exit:
    """Calibrate a robot from a table of measured poses and validate it on held-out rows."""

    def pipeline(prepared: Prepared, holdout: Measurements | None) -> Outcome:
        from pincal.calibration.run import run_calibration
        from pincal.cli.tables import print_result

        split = arguments.split
        calibration = run_calibration(
            prepared.robot,
            prepared.table,
            prepared.options,
            test_fraction=split.test_fraction,
            split=split.split,
            seed=split.seed,
            holdout=holdout,
        )
        return Outcome(calibration, calibration.result.to_dict(), partial(print_result, calibration.result))

    return run_fit(arguments, pipeline)
