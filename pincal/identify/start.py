"""Where instrument and tool stand, in closed form, from any placement and without a first guess.

The formulas are the sensors' own, see :mod:`pincal.measure.sensors`. Each start is a candidate; the fit of base and tool
begins at the best.
"""

from __future__ import annotations

import numpy as np

from pincal.measure.extrinsics import Extrinsics
from pincal.measure.rows import some_rows
from pincal.measure.sensor import Sensor

# More rows than this add nothing to a start.
_ROWS = 2000


def placements(sensor: Sensor, tips: np.ndarray, target: np.ndarray, n_targets: int) -> list[Extrinsics]:
    """Return candidates for the placement of instrument and tools, some perhaps far off.

    Args:
        sensor: readings of N poses.
        tips: shape (N, 3, 4), nominal tips in the base frame.
        target: shape (N,), index of each row's target.
        n_targets: number of targets.
    """
    rows = some_rows(len(sensor), _ROWS, sensor.groups)
    return list(sensor.select(rows).starts(tips[rows], target[rows], n_targets))
