"""What the data do not identify, by cause, and what to measure so that they would."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pincal.calibration.result import ParameterRow
from pincal.calibration.run import Calibration
from pincal.identify.reasons import Cause, Status


class Advice(NamedTuple):
    """What it means that parameters are not identified, and what to measure if that matters."""

    title: str
    text: str


_PLACEMENT = Advice(
    "Placement of instrument and target",
    "The uncertainty shown only says how the placement and the robot's first or last link share an offset. Predictions are "
    "as sharp as they need to be; nothing has to be measured.",
)
_UNKNOWN_FRAMES = Advice(
    "Absorbed by the unknown placement of instrument or target",
    "Neither the instrument's nor the target's position is known, and moving either looks exactly like a change of these "
    "parameters. Predictions in the instrument's frame do not depend on the choice. To separate them, measure the robot's "
    "foot or the target's offset independently and pass it to the calibration (--tool).",
)
_SAME_EFFECT = Advice(
    "Parameters with the same effect",
    "In every pose these parameters act exactly like others; only the combination moves the target, and the combination is "
    "calibrated. No measurement of this kind can separate them, and none is needed.",
)
_NO_MOMENT = Advice(
    "Never loaded by gravity",
    "No pose has a moment about this axis, so its compliance never shows. It does not matter as long as the robot stays "
    "mounted as it is; only a tilted mounting would reveal it.",
)
_NOT_EXCITED = Advice(
    "Not excited",
    "No pose excites these parameters. Measure poses in which the joint moves through its whole range.",
)
_WEAK = Advice(
    "Too little signal in these poses",
    "The effect of these parameters is small compared with the noise. Measure with the heaviest payload, with the arm "
    "stretched out, and with this joint through its whole range; four times as many poses halve the uncertainty.",
)
_AT_BOUND = Advice(
    "Stopped at a bound",
    "The data ask for more than the bound allows. Check this length in the URDF and the units of the table, or raise the "
    "bound with --length-bound.",
)
_GIVEN = Advice("Given", "Fixed at your request, or by default.")
# In the order in which they are shown: those that call for action last.
_BY_CAUSE = {
    Cause.ABSORBS: _PLACEMENT,
    Cause.BASE: _UNKNOWN_FRAMES,
    Cause.TOOL: _UNKNOWN_FRAMES,
    Cause.FRAMES: _UNKNOWN_FRAMES,
    Cause.PARALLEL_AXES: _SAME_EFFECT,
    Cause.COMBINATION: _SAME_EFFECT,
    Cause.ALIASED: _SAME_EFFECT,
    Cause.HIDDEN: _SAME_EFFECT,
    Cause.NO_MOMENT: _NO_MOMENT,
    Cause.NOT_EXCITED: _NOT_EXCITED,
    Cause.NOT_OBSERVED: _NOT_EXCITED,
    Cause.UNINFORMED: _WEAK,
    Cause.WEAK: _WEAK,
    Cause.AT_BOUND: _AT_BOUND,
    Cause.GIVEN: _GIVEN,
    Cause.NOT_NEEDED: _GIVEN,
}
# Share of its range below which a joint hardly shows what depends on its position: with a turn as the range, a wave of one
# period per turn is there hard to tell from a slope. A judgement, not a measurement; it only words a recommendation.
_NARROW = 0.3


@dataclass(frozen=True)
class UnidentifiedGroup:
    """Parameters that are not identified for one and the same cause.

    Attributes:
        advice: what it means, and what to measure.
        names: the parameters.
    """

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
    found: dict[Advice, list[str]] = {advice: [] for advice in _BY_CAUSE.values()}
    for row in parameters:
        if row.status is not Status.IDENTIFIED:
            found[_BY_CAUSE[row.reason.cause]].append(row.name)
    return tuple(UnidentifiedGroup(advice, tuple(names)) for advice, names in found.items() if names)


def narrow_joints(calibration: Calibration) -> tuple[tuple[str, float], ...]:
    """Return joints that moved through little of their range, with the part of it that they did."""
    robot, q = calibration.robot, calibration.train.q
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
