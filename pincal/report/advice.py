"""What the data do not identify, by cause, and what to measure so that they would."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pincal.calibration.parameters import ParameterRow
from pincal.calibration.run import Calibration
from pincal.identify.reasons import Cause, Status


class Advice(NamedTuple):
    """What it means that parameters are not identified for some causes, and what to measure if that matters."""

    causes: tuple[Cause, ...]
    title: str
    text: str


# In the order in which they are shown: those that call for action last.
_ADVICE = (
    Advice(
        (Cause.ABSORBS,),
        "Placement of instrument and target",
        "The uncertainty shown only says how the placement and the robot's first or last link share an offset. Predictions "
        "are as sharp as they need to be; nothing has to be measured.",
    ),
    Advice(
        (Cause.BASE, Cause.TOOL, Cause.FRAMES),
        "Absorbed by the unknown placement of instrument or target",
        "Neither the instrument's nor the target's position is known, and moving either looks exactly like a change of "
        "these parameters. Predictions in the instrument's frame do not depend on the choice. To separate them, measure the "
        "robot's foot or the target's offset independently and pass it to the calibration (--tool).",
    ),
    Advice(
        (Cause.PARALLEL_AXES, Cause.COMBINATION, Cause.ALIASED, Cause.HIDDEN),
        "Parameters with the same effect",
        "In every pose these parameters act exactly like others; only the combination moves the target, and the combination "
        "is calibrated. No measurement of this kind can separate them, and none is needed.",
    ),
    Advice(
        (Cause.MASS,),
        "Masses that the robot's description does not tell",
        "What bends the arm is compliance times moment; predictions need no more. The moments that are identified stand "
        "under Static moments. The mass of the robot's data sheet (--mass) or rows with other payloads would tell the "
        "factor that they share.",
    ),
    Advice(
        (Cause.NO_MOMENT,),
        "Never loaded by gravity",
        "No pose has a moment about this axis, so its compliance never shows. It does not matter as long as the robot stays "
        "mounted as it is; only a tilted mounting would reveal it.",
    ),
    Advice(
        (Cause.NOT_EXCITED, Cause.NOT_OBSERVED),
        "Not excited",
        "No pose excites these parameters. Measure poses in which the joint moves through its whole range.",
    ),
    Advice(
        (Cause.UNINFORMED, Cause.WEAK),
        "Too little signal in these poses",
        "The effect of these parameters is small compared with the noise. Measure with the heaviest payload, with the arm "
        "stretched out, and with this joint through its whole range; four times as many poses halve the uncertainty.",
    ),
    Advice(
        (Cause.AT_BOUND,),
        "Stopped at a bound",
        "The data ask for more than the bound allows. Check this length in the URDF and the units of the table, or raise "
        "the bound with --length-bound.",
    ),
    Advice((Cause.GIVEN, Cause.NOT_NEEDED), "Given", "Fixed at your request, or by default."),
)
# Share of its range below which a joint hardly shows what depends on its position: with a turn as the range, a wave of one
# period per turn is there hard to tell from a slope. A judgement, not a measurement; it only words a recommendation.
_NARROW = 0.3


class UnidentifiedGroup(NamedTuple):
    """The names of parameters that are not identified for one and the same cause, with what to do about it."""

    advice: Advice
    names: tuple[str, ...]


def unidentified_groups(parameters: Sequence[ParameterRow]) -> tuple[UnidentifiedGroup, ...]:
    """Return the parameters that are not identified, by cause, the causes that call for action last.

    Example:
        >>> from pincal.identify.reasons import Reason
        >>> reason = Reason(Cause.NO_MOMENT, axis="z")
        >>> row = ParameterRow("a.k_z", "rad/(N m)", 0.0, 0.0, 1e-6, Status.UNIDENTIFIABLE, reason)
        >>> [(group.advice.title, group.names) for group in unidentified_groups([row])]
        [('Never loaded by gravity', ('a.k_z',))]
    """
    open_rows = [row for row in parameters if row.status is not Status.IDENTIFIED]
    groups = (
        UnidentifiedGroup(advice, tuple(row.name for row in open_rows if row.reason.cause in advice.causes))
        for advice in _ADVICE
    )
    return tuple(group for group in groups if group.names)


def narrow_joints(calibration: Calibration) -> tuple[tuple[str, float], ...]:
    """Return joints that moved through little of their range, with the part of it that they did."""
    robot, q = calibration.robot, np.vstack([rows.train.q for rows in calibration.stations])
    found = []
    for i, name in enumerate(robot.joint_names):
        width = float(robot.upper[i] - robot.lower[i])
        # Beyond a turn a joint shows nothing new.
        if robot.joint_types[i] != "prismatic":
            width = min(width, 2.0 * np.pi)
        share = float(np.ptp(q[:, i])) / width if np.isfinite(width) and width > 0.0 else 1.0
        if share < _NARROW:
            found.append((str(name), share))
    return tuple(found)
