"""The language of Universal Robots: poses in metres with rotation vectors, joints in radians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pincal.programs.draft import Draft
from pincal.programs.flow import InForce, Step, followed
from pincal.programs.language import LANGUAGES, ControllerLanguage
from pincal.programs.program import Frame, Motion, Path, Point, Posture, Program, Skipped
from pincal.programs.statement_reader import Reader
from pincal.programs.syntax import (
    Brackets,
    Source,
    Statement,
    aggregate,
    call_of,
    calls_in,
    element_name,
    is_token,
    nested,
    numbers_of,
    place_of,
    split,
)

_TOKENS = r"""
TEXT: /"[^"\r\n]*"/ | /'[^'\r\n]*'/
BITS.3: /0[xXbB][0-9a-fA-F]+/
SIGN: /[=<>!]=|[^\x04\s\w()\[\]{}"'#$]/
_END: /\r\n|\r|\n|\x04/
COMMENT.5: /#[^\r\n]*/
%ignore COMMENT
%ignore /[ \t\f\xa0]+/
"""
_WORDS = "URScript: def, thread, if, while and for, each with its end"
_MOTIONS: dict[str, Path] = {"movej": "joint", "movel": "line", "movep": "line", "movec": "circle"}
_ENDLESS = ("servoj", "servoc", "servol", "speedj", "speedl")
# What is set by a call: the tool, or a displacement of all positions.
_SWITCHES = {
    "set_tcp": "tcp",
    "path_offset_enable": "path_offset",
    "path_offset_disable": "path_offset",
    "track_conveyor_linear": "conveyor",
    "track_conveyor_circular": "conveyor",
    "stop_conveyor_tracking": "conveyor",
}
_ENDS_IT = ("path_offset_disable", "stop_conveyor_tracking")
_OPENS = {
    "def": "routine",
    "thread": "routine",
    "sec": "routine",
    "while": "loop",
    "for": "loop",
    "if": "branch",
}


@LANGUAGES.register
class UrScript(ControllerLanguage):
    """The language of Universal Robots."""

    name = "URScript"
    suffixes = (".script", ".urscript", ".ur")
    length = 1.0
    convention = "ur"
    in_degrees = False
    digits = (7, 8, 9)
    can_insert = True
    grammars = (nested(_TOKENS, over_lines=True),)

    def read(self, sources: Sequence[Source]) -> Program:
        draft = Draft(sources)
        files = []
        for source in sources:
            statements = source.statements(_TOKENS, _WORDS, over_lines=True)
            steps = [_step(statement) for statement in statements]
            if not any(
                step.opens or call_of(statements[k].items) is not None
                for k, step in enumerate(steps)
            ):
                raise source.error(
                    f"no statement that calls or defines anything; expected {_WORDS}", 0
                )
            files.append((source, statements, steps))
        flows = followed(files)
        displaced = {
            name for _, _, steps in files for step in steps for name in step.sets if name != "tcp"
        }
        for i, (_, statements, steps) in enumerate(files):
            # Arguments are passed by value.
            harmless = frozenset(
                name for statement in statements for name, _ in calls_in(statement.items)
            )
            reader = _Reader(
                draft, i, statements, steps, flows[i], harmless, self, sorted(displaced)
            )
            for k in range(len(statements)):
                reader.statement(k)
        return draft.finish()

    def key(self, name: str) -> str:
        return name

    def statement(
        self, motion: Motion, source: Source, *, values: np.ndarray, posture: Posture
    ) -> str:
        start, end = motion.span
        pose = ",".join(f"{value:.{7 if k < 3 else 8}f}" for k, value in enumerate(values))
        return (
            source.text[motion.statement.start : start]
            + f"p[{pose}]"
            + source.text[end : motion.statement.end]
        )


@dataclass(frozen=True)
class _Reader(Reader):
    """Reads one file; ``displacements`` are the kinds that any of the files uses."""

    language: UrScript
    displacements: Sequence[str]
    case = True

    def literal(self, line: int, name: str, items: Sequence[Any]) -> Point | Skipped | None:
        """Return the pose or the joint positions that items state in numbers."""
        is_pose = len(items) == 2 and is_token(items[0], "WORD") and str(items[0]) == "p"
        group = aggregate(items[1:] if is_pose else items, "[")
        numbers = numbers_of(group.parts) if group is not None else None
        if numbers is None or len(numbers) != 6:
            return None
        return Point(name, self.file, line, "pose" if is_pose else "joints", numbers)

    def statement(self, k: int) -> None:
        """Note what a statement sets or moves."""
        statement = self.statements[k]
        known = self.flow[k]
        items = statement.items
        line = statement.line
        call = call_of(statement.items)
        if call is not None and call[0] in _MOTIONS:
            self._move(k, *call)
            return
        if call is not None and call[0] in _ENDLESS:
            lost = self.skip(
                f"{call[0]} of line {line}", line, "a motion without an end point of its own"
            )
            self.draft.motions.append(Motion("joint", (lost,), statement, self.file, run=known.run))
        rest = items[1:] if is_token(items[0], "WORD", "GLOBAL", "LOCAL") else items
        sides = split(rest, "=")
        name, is_part = element_name(sides[0], case=True)
        if len(sides) == 2 and name and not self.steps[k].opens:
            self.assign(line, name, is_part, sides[1])
        elif not self.steps[k].routine:
            self.draft.read(self.words(items))

    def assign(self, line: int, name: str, is_part: bool, value: Sequence[Any]) -> None:
        """Note the value that a name is set to, perhaps a list of poses."""
        group = aggregate(value, "[")
        if (
            group is not None
            and not is_part
            and "[" not in name
            and self.literal(line, name, value) is None
        ):
            points = [
                self.literal(line, f"{name}[{k}]", part) for k, part in enumerate(group.parts)
            ]
            if all(isinstance(point, Point) for point in points):
                for point in points:
                    self.draft.declare(point)  # type: ignore[arg-type]
                return
        if "[" in name:
            # An element of a pose is a part of it, an element of a list is a pose.
            self.draft.write(name.partition("[")[0], f"line {line} sets a part of it")
        super().assign(line, name, is_part or "[" in name, value)

    def target(self, k: int, part: Sequence[Any]) -> str | Point | Skipped:
        """Return the target of a motion, perhaps by inverse kinematics near joint positions."""
        call = call_of(part)
        if call is None or call[0] != "get_inverse_kin" or not call[1].items:
            return super().target(k, part)
        target, *others = call[1].parts
        near = [name for other in others for name in sorted(self.words(other)) if name != "qnear"]
        self.draft.read(near)
        found = super().target(k, target)
        if near and isinstance(found, str):
            self.draft.near[found] = near[-1]
        return found

    def _move(self, k: int, called: str, arguments: Brackets) -> None:
        """Note a motion."""
        statement = self.statements[k]
        known = self.flow[k]
        named = dict[str, tuple[Any, ...]]()
        plain = []
        for part in arguments.parts:
            if len(part) > 2 and is_token(part[1], "SIGN", "="):
                named[str(part[0])] = part[2:]
            elif part:
                plain.append(part)
        path = _MOTIONS[called]
        count = 2 if path == "circle" else 1
        places = plain[:count]
        if len(places) < count:
            places = [named[key] for key in ("pose_via", "pose_to", "pose", "q") if key in named]
        if len(places) < count:
            self.draft.skipped.append(
                self.skip(f"{called} of line {statement.line}", statement.line, "not understood")
            )
            return
        targets = tuple(self.target(k, part) for part in places)
        displaced = self.displaced(k, self.displacements, _ENDS_IT)
        base = Frame("", reason=displaced) if displaced else Frame("base", np.eye(4))
        span = place_of(places[-1])
        self.draft.motions.append(
            Motion(
                path,
                targets,
                statement,
                self.file,
                self._tool(known),
                base,
                span,
                known.run,
                path == "line",
            )
        )

    def _tool(self, known: InForce) -> Frame:
        """Return the tool in force before a statement."""
        found = known.setters.get("tcp")
        if not isinstance(found, int):
            return Frame("tcp", reason=f"set_tcp: {found}" if found is not None else "")
        call = call_of(self.statements[found].items)
        point = (
            self.literal(0, "tcp", call[1].parts[0]) if call is not None and call[1].parts else None
        )
        if isinstance(point, Point) and point.kind == "pose":
            return Frame("tcp", self.language.pose(point.values))
        return Frame("tcp", reason=f"line {self.statements[found].line} sets a computed tool")


def _step(statement: Statement) -> Step:
    """Return the effect of a statement on the control flow and the tool."""
    items = statement.items
    first = str(items[0]) if is_token(items[0], "WORD") else ""
    kind = _OPENS.get(first, "")
    calls = tuple(name for name, _ in calls_in(items))
    if kind == "routine":
        name = next((str(item) for item in items[1:] if is_token(item, "WORD")), first)
        # A thread runs in parallel with all that follows.
        return Step(opens=first, routine=name, starts=(name,) if first == "thread" else ())
    if kind:
        return Step(opens=first, is_loop=kind == "loop", calls=calls)
    if first == "end" and len(items) == 1:
        return Step(closes=tuple(_OPENS))
    if first in ("elif", "else"):
        return Step(is_jump=True, calls=calls)
    return Step(
        sets=frozenset({_SWITCHES[first]}) if first in _SWITCHES else frozenset(), calls=calls
    )
