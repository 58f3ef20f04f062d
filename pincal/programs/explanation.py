"""Why a point of a program was corrected: what is known of it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pincal.programs.correct import Change
from pincal.programs.program import Frame, PointKey, Program
from pincal.thresholds import Count

# Lines of motions that are named.
_MOST_LINES: Count = 5


def explanations(program: Program, changes: Mapping[PointKey, Change]) -> dict[PointKey, str]:
    """Return, for each corrected point, why it could be."""
    lines = dict[PointKey, list[int]]()
    for motion, keys in program.motions:
        for key in keys:
            if key is not None:
                lines.setdefault(key, []).append(motion.statement.line)
    return {
        key: "; ".join(
            [
                "in numbers, which nothing else sets",
                *_frames(change, program),
                _motions(lines.get(key, [])),
                f"load {change.payload:g} kg",
            ]
        )
        for key, change in changes.items()
    }


def _frames(change: Change, program: Program) -> list[str]:
    """Return where the tool and the base of a point are from."""
    point = change.point
    if point.kind == "joints":
        return ["in joints, so that it needs no tool and no base"]
    return [
        f"tool {_source(point.tool, program.tools)}",
        f"base {_source(point.base, program.bases)}",
    ]


def _source(frame: Frame | None, declared: Mapping[str, np.ndarray | str]) -> str:
    name = frame.name if frame is not None else ""
    is_stated = frame is not None and (frame.pose is not None or name in declared)
    return f"{name or 'of the flange'} {'as in the program' if is_stated else 'as given'}".strip()


def _motions(lines: list[int]) -> str:
    if not lines:
        return "no motion in these files goes to it, and no statement in them displaces it"
    named = ", ".join(str(line) for line in sorted(set(lines))[:_MOST_LINES])
    more = " and others" if len(set(lines)) > _MOST_LINES else ""
    return f"reached on line {named}{more}, before which all is understood and nothing displaces it"
