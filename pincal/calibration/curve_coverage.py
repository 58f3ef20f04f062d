"""Which curves of a calibrated robot some rows need beyond, or between, what it was fitted to."""

from __future__ import annotations

import numpy as np

from pincal.calibration.covered import CurveGap, OutsideCurve, Turned, curves_at
from pincal.calibration.fitted_robot import FittedRobot
from pincal.model.conditions import Conditions


def outside_curves(robot: FittedRobot, conditions: Conditions) -> list[OutsideCurve]:
    """Return the curves that some rows need beyond their range; there they keep their end values,
    not extrapolated.
    """
    return [
        OutsideCurve(
            curve.effect.name,
            curve.joint,
            curve.variable,
            int(curve.beyond.sum()),
            float(curve.x.min()),
            float(curve.x.max()),
            *curve.span,
        )
        for curve in curves_at(robot.model, robot.of_its_day(conditions))
        if curve.beyond.any()
    ]


def gaps_in_curves(robot: FittedRobot, conditions: Conditions) -> list[CurveGap]:
    """Return the gaps in the curves of the model, where they are interpolated, in which some rows
    lie.
    """
    found = list[CurveGap]()
    for curve in curves_at(robot.model, robot.of_its_day(conditions)):
        of_curve = curve.gaps(robot.model.chain, robot.estimate)
        for (lower, upper), inside in zip(of_curve, curve.rows_in(of_curve), strict=True):
            if inside.any():
                what = (curve.effect.name, curve.joint, curve.variable)
                found.append(CurveGap(*what, int(inside.sum()), float(lower), float(upper)))
    return found


def knows(robot: FittedRobot, conditions: Conditions) -> np.ndarray:
    """Return the rows at which the fitted rows determine every curve of the model, shape (N,)."""
    known = np.ones(len(conditions), bool)
    for curve in curves_at(robot.model, robot.of_its_day(conditions)):
        known &= curve.determined(robot.model.chain, robot.estimate)
    return known


def turned_curves(robot: FittedRobot, conditions: Conditions) -> list[Turned]:
    """Return the curves that some rows need a revolution away from their range, taken to be
    periodic.
    """
    found = list[Turned]()
    for curve in curves_at(robot.model, robot.of_its_day(conditions)):
        rows = int(np.sum((curve.x != curve.recorded) & ~curve.beyond))
        if rows:
            found.append(Turned(curve.effect.name, curve.joint, curve.variable, rows))
    return found
