"""Whether lengths that were measured are in metres, as far as the size of the arm tells."""

from __future__ import annotations

import numpy as np

from pincal.errors import MeasurementError
from pincal.measure.fields import Table

# Share of the rows beyond the limits from which on the column, not the row, is at fault.
_MANY = 0.2
# Farthest distance of a target from the flange [m].
_TOOL_REACH_M = 2.0


def span_m(reach_m: float) -> float:
    """Return how far apart two targets can be at most [m], for a flange that reaches so far from the base."""
    return 2 * (reach_m + _TOOL_REACH_M)


def check_spread(table: Table, points: np.ndarray, *, label: str, reach_m: float) -> float:
    """Return the distance between (nearly) the farthest points [m]; refuse more than the arm can span.

    Args:
        table: the table, for messages.
        points: shape (N, k) [m].
        label: the column that a message names.
        reach_m: farthest distance of the flange from the base [m].

    Raises:
        MeasurementError: naming the unit that seems to be meant.
    """
    most = span_m(reach_m)
    from_centre = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    worst = int(from_centre.argmax())
    # From the farthest point on, the diameter is at most twice what this finds, and never less.
    spread = float(np.linalg.norm(points - points[worst], axis=1).max())
    if spread <= most:
        return spread
    text = f"{table.source}: values of {label} lie {spread:.4g} m apart; expected at most {most:.3g} m"
    is_unit = np.mean(from_centre > most) > _MANY and spread / 1000 <= most
    if is_unit and label not in table.units:
        raise MeasurementError(f"{text}; looks like millimetres: write `{label} [mm]` in the header, or their unit")
    raise MeasurementError(f"{text}; look at line {table.rows[worst]}, at the unit and at the robot's size")
