"""``pincal calibrate``: from a URDF and a table to a calibrated model."""

from __future__ import annotations

from functools import partial

from pincal.cli.arguments import verb
from pincal.cli.fitting import EXITS, FILES, FitArguments, run_fit
from pincal.cli.workers import workers
from pincal.errors import Exit

_EXAMPLES = f"""
Examples:
  pincal calibrate robot.urdf tracker.csv --out results --noise 0.05mm
  pincal calibrate ur10 series.csv --out results --max-error 0.2mm
  pincal calibrate robot.urdf monday.csv tuesday.csv --split station --out results

{FILES}.
"""


@verb(FitArguments, examples=_EXAMPLES, exits=EXITS)
def calibrate(arguments: FitArguments) -> Exit:
    """Calibrate a robot from a table of measured poses.

    The calibrated model is validated on held-out rows.
    """
    from pincal.calibration.run import run_calibration

    with workers(arguments.dask, repeats=arguments.split.split == "station", processes=False) as executor:
        return run_fit(arguments, partial(run_calibration, executor=executor))
