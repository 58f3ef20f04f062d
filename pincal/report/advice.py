"""What the data could not tell, by cause, and what to measure so that they could."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pincal.calibration.result import ParameterRow
from pincal.calibration.run import Calibration

# Words of a reason (see pincal.identify.explain) -> cause, and what to do about it; the first that fits.
_CAUSES = (
    (
        ("parameters that it absorbs",),
        "Placement of instrument and target",
        "These are as sharp as they need to be: what looks uncertain is only how much of them belongs to the robot's first "
        "or last link. Nothing to measure.",
    ),
    (
        ("unknown base", "unknown tool"),
        "Hidden behind the placement of instrument or target",
        "Where the instrument stands and where the target sits is unknown, and moving either looks just like these "
        "parameters. Predictions in the instrument's frame do not depend on it. If you need them apart, measure the robot's "
        "foot or the target's offset by itself and give it to the calibration (--tool).",
    ),
    (
        ("is determined", "does the same", "do the same", "hides behind"),
        "Two or more parameters with one and the same action",
        "In every pose these do what others do; only the combination moves the target, and it is calibrated. No measurement "
        "of this kind tells them apart, and none is needed.",
    ),
    (
        ("no moment about",),
        "Gravity never loads it",
        "No pose twists the arm about this axis, so its elasticity shows nowhere. It does not matter as long as the robot "
        "stays mounted as it is; only a tilted mounting would tell.",
    ),
    (
        ("nothing in these poses", "does not move"),
        "Never moved",
        "Nothing in these poses acts on it. Measure poses in which this joint moves through its whole range.",
    ),
    (
        ("says nothing", "say nothing", "narrow this"),
        "Too little signal in these poses",
        "What it does is small beside the noise. Measure with the heaviest payload, with the arm stretched out, and with "
        "this joint through its whole range; four times the poses halve the uncertainty.",
    ),
    (
        ("held at its bound",),
        "At its bound",
        "The data asked for more than was allowed. Check this length in the URDF and the units of the table, or allow more "
        "with --length-bound.",
    ),
    (("given by the user",), "Given", "Fixed on your request."),
)
_OTHER = ("Other", "See the reason in the table.")
# A joint that covers less of its range than this hardly shows what depends on its position.
_NARROW = 0.3


@dataclass(frozen=True)
class UnidentifiedGroup:
    """Parameters that the data do not tell, for one and the same cause.

    Attributes:
        title: the cause.
        advice: what it means, and what to measure.
        rows: the parameters.
    """

    title: str
    advice: str
    rows: tuple[ParameterRow, ...]


def not_told(parameters: Sequence[ParameterRow]) -> tuple[UnidentifiedGroup, ...]:
    """Return the parameters that are not identified, by cause, the causes that call for action last.

    Example:
        >>> row = ParameterRow("a.k_z", "rad/(N m)", 0.0, 0.0, 1e-6, "unidentifiable", "no moment about this axis")
        >>> [(gap.title, [row.name for row in gap.rows]) for gap in not_told([row])]
        [('Gravity never loads it', ['a.k_z'])]
    """
    found: dict[tuple[str, str], list[ParameterRow]] = {(title, advice): [] for _, title, advice in _CAUSES}
    found[_OTHER] = []
    for row in parameters:
        if row.status != "identified":
            cause = next(((t, a) for words, t, a in _CAUSES if any(w in row.reason for w in words)), _OTHER)
            found[cause].append(row)
    return tuple(UnidentifiedGroup(title, advice, tuple(rows)) for (title, advice), rows in found.items() if rows)


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
