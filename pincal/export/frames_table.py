"""Base and tool frames in the numbers that a controller's pendant asks for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import numpy as np

from pincal.calibration.calibrated import CalibratedModel
from pincal.errors import BadInputError
from pincal.export.exported import FORMATS, Exported, Format
from pincal.export.source import as_comment
from pincal.measure.orientation import CONVENTIONS
from pincal.parameters import FRAME_SYMBOLS
from pincal.robot.se3 import placed

Controller = Literal["kuka", "fanuc", "abb", "ur"]
# Digits behind the point: a hundredth of what any controller keeps, and of what is ever measured.
_DIGITS = 9


@FORMATS.register
@dataclass(frozen=True)
class ControllerFrames(Format):
    """The instrument's frame seen from the robot's base, and the targets on the tip, in a controller's convention.

    Attributes:
        controller: "kuka" (X Y Z A B C), "fanuc" (X Y Z W P R), "abb" (x y z q1 q2 q3 q4) or "ur" (x y z rx ry rz).
    """

    controller: str = "kuka"
    name: ClassVar[str] = "frames"
    meaning: ClassVar[str] = "base and tool frames for a controller"

    def export(self, calibrated: CalibratedModel) -> Exported:
        """Return the frames as a table."""
        if self.controller not in get_args(Controller):
            raise BadInputError(f"controller {self.controller!r}; expected one of {', '.join(get_args(Controller))}")
        convention, frames = CONVENTIONS[self.controller], _frames(calibrated)
        unit = "m" if self.controller == "ur" else "mm"
        rows = [(name, T, np.concatenate([T[:3, 3] * (1.0 if unit == "m" else 1e3), convention.values(T[:3, :3])])) for
                name, T in frames.items()]  # fmt: skip
        numbers = [(name, [f"{value:.{_DIGITS}f}" for value in values]) for name, _, values in rows]
        angles = f" [{convention.unit}]" if convention.unit else ""
        notes = _notes(calibrated, convention.words)
        head = ",".join(["frame", *(f"{axis} [{unit}]" for axis in "xyz"), *(f"{c}{angles}" for c in convention.columns)])
        lines = [
            *(f"# {note}" for note in notes),
            head,
            *(f"{as_comment(name)},{','.join(cells)}" for name, cells in numbers),
        ]
        scale = 1.0 if unit == "m" else 1e-3
        lost = [np.linalg.norm(T[:3, 3] - scale * np.array(cells[:3], float))
                for (_, T, _), (_, cells) in zip(rows, numbers, strict=True)]  # fmt: skip
        return Exported({"": ("\n".join(lines) + "\n").encode()}, notes, float(max(lost)))


def _frames(calibrated: CalibratedModel) -> dict[str, np.ndarray]:
    """Return the frames by name, shape (4, 4) each: the base if the instrument has one, then the targets."""
    model, estimate = calibrated.model, calibrated.estimate
    chain = model.chain

    def coordinates(element: str) -> np.ndarray:
        names = [f"{element}.{symbol}" for symbol in FRAME_SYMBOLS]
        return np.array([estimate[name] if name in estimate.names else 0.0 for name in names])

    found = {}
    if "base.x" in estimate.names:
        found["base"] = np.linalg.inv(placed(chain.base_rotation, coordinates("base")))
    return found | {t: placed(R, coordinates(t)) for t, R in zip(chain.targets, chain.tool_rotations, strict=True)}


def _notes(calibrated: CalibratedModel, words: str) -> tuple[str, ...]:
    model, robot = calibrated.model, calibrated.model.chain.robot
    base, tip = as_comment(robot.base), as_comment(robot.tip)
    turned = "" if model.has_tool_orientation else "; only their positions were measured, their axes are those of the tip"
    moving = [e.name for e in model.effects if e.scope == "station" and e.needs]
    lacking = (f"{', '.join(moving)}: the frames are those at its reference",) if moving else ()
    return (
        f"orientation as {words}",
        f"base: the instrument's frame seen from {base}; the others: targets seen from {tip}{turned}",
        f"a controller whose own base or flange is not {base} or {tip} needs them transformed by the difference",
        "frames hold no geometry, elasticity or other effects: they are valid with the calibrated robot only",
        *lacking,
    )
