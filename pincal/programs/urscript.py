"""The language of Universal Robots: poses in metres with rotation vectors, joints in radians."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from pincal.programs.flow import InForce, Step, followed
from pincal.programs.language import LANGUAGES, ControllerLanguage
from pincal.programs.program import Draft, Frame, Left, Motion, Path, Point, Posture, Program
from pincal.programs.syntax import (
    Brackets,
    Source,
    Statement,
    is_token,
    numbers_of,
    place_of,
    split,
    text_of_items,
)

_TOKENS = r"""
TEXT: /"[^"\r\n]*"/ | /'[^'\r\n]*'/
BITS.3: /0[xXbB][0-9a-fA-F]+/
SIGN: /[^\x04\s\w()\[\]{}"'#$]/
_END: /\r\n|\r|\n|\x04/
COMMENT.5: /#[^\r\n]*/
%ignore COMMENT
%ignore /[ \t\f\xa0]+/
"""
_WORDS = "URScript: def, thread, if, while and for, each with its end"
_MOTIONS: dict[str, Path] = {"movej": "joint", "movel": "line", "movep": "line", "movec": "circle"}
_OPENS = {"def": "routine", "thread": "routine", "sec": "routine", "while": "loop", "for": "loop", "if": "branch"}


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

    def read(self, sources: Sequence[Source]) -> Program:
        """Return the program of a script."""
        draft = Draft(sources)
        for i, source in enumerate(sources):
            statements = source.statements(_TOKENS, _WORDS, over_lines=True)
            setting = _routines_that_set_the_tool(statements)
            steps = [_step(statement, setting) for statement in statements]
            flow = followed(source, statements, steps)
            if not any(step.opens or _call(statement) for statement, step in zip(statements, steps, strict=True)):
                raise source.error(f"nothing that is called or defined; expected {_WORDS}", 0)
            for k in range(len(statements)):
                self._statement(draft, i, statements, k, flow)
        return draft.finish()

    def key(self, name: str) -> str:
        """Return a name as it is."""
        return name

    def statement(self, motion: Motion, source: Source, *, values: np.ndarray, posture: Posture) -> str:
        """Return the motion with a pose in the place of its target."""
        start, end = motion.span
        pose = ",".join(f"{value:.{7 if k < 3 else 8}f}" for k, value in enumerate(values))
        return source.text[motion.statement.start : start] + f"p[{pose}]" + source.text[end : motion.statement.end]

    def _statement(self, draft: Draft, i: int, statements: Sequence[Statement], k: int, flow: Sequence[InForce]) -> None:
        """Take note of a statement."""
        statement = statements[k]
        items = statement.items
        call = _call(statement)
        if call and call[0] in _MOTIONS:
            self._move(draft, i, statement, call, _tool(self, statements, k, flow), flow[k])
            return
        if call and call[0] in ("servoj", "servoc", "servol", "speedj", "speedl"):
            lost = Left(f"{call[0]} of line {statement.line}", i, statement.line, "a motion without an end of its own")
            draft.motions.append(Motion("joint", (lost,), statement, i, Frame(""), Frame(""), (0, 0), flow[k].run))
        rest = items[1:] if is_token(items[0], "WORD", "GLOBAL", "LOCAL") else items
        sides = split(rest, "=")
        if len(sides) == 2 and len(sides[0]) == 1 and is_token(sides[0][0], "WORD") and not _opens(statement):
            name = str(sides[0][0])
            point = self._literal(i, statement, name, sides[1])
            if point is not None:
                draft.declare(point)
                return
            draft.changed[name] = f"line {statement.line} sets it to a computed value"
            draft.computed |= set(_names(sides[1]))
            return
        if len(sides) == 2 and sides[0] and is_token(sides[0][0], "WORD"):
            draft.changed[str(sides[0][0])] = f"line {statement.line} sets a part of it"
        draft.computed |= set(_names(items))

    def _literal(self, i: int, statement: Statement, name: str, items: Sequence[Any]) -> Point | None:
        """Return the pose or the joints that stand there in numbers."""
        match list(items):
            case [p, Brackets(kind="[") as group] if is_token(p, "WORD", "P") and str(p) == "p":
                kind = "pose"
            case [Brackets(kind="[") as group]:
                kind = "joints"
            case _:
                return None
        numbers = numbers_of(group.parts)
        if numbers is None or len(numbers) != 6:
            return None
        base = Frame("base", np.eye(4))
        return Point(name, i, statement.line, "pose" if kind == "pose" else "joints", numbers, base=base)

    def _move(
        self, draft: Draft, i: int, statement: Statement, call: tuple[str, Brackets], tool: Frame, known: InForce
    ) -> None:
        """Take note of a motion."""
        name, group = call
        named = {str(part[0]): part[2:] for part in group.parts
                 if len(part) > 2 and is_token(part[0], "WORD") and is_token(part[1], "SIGN", "=")}  # fmt: skip
        plain = [part for part in group.parts if not (len(part) > 2 and is_token(part[1], "SIGN", "="))]
        count = 1 + (name == "movec")
        places = plain[:count]
        if len(places) < count:
            places = [named[key] for key in ("pose_via", "pose_to", "pose", "q") if key in named]
        places = [part for part in places if part]
        if len(places) < count:
            draft.left.append(Left(f"{name} of line {statement.line}", i, statement.line, "not understood"))
            return
        targets = tuple(self._target(draft, i, statement, part) for part in places)
        span = (place_of(places[-1][0])[0], place_of(places[-1][-1])[1])
        base = Frame("base", np.eye(4))
        can_insert = name in ("movel", "movep") and len(statement.items) == 2
        draft.motions.append(Motion(_MOTIONS[name], targets, statement, i, tool, base, span, known.run, can_insert))

    def _target(self, draft: Draft, i: int, statement: Statement, part: tuple[Any, ...]) -> str | Point | Left:
        if len(part) == 1 and is_token(part[0], "WORD"):
            return str(part[0])
        name = f"target of line {statement.line}"
        if point := self._literal(i, statement, name, part):
            return point
        match part:
            case [call, Brackets(kind="(") as group] if str(call) == "get_inverse_kin" and group.parts:
                target = self._target(draft, i, statement, group.parts[0])
                near = [n for other in group.parts[1:] for n in _names(other)]
                draft.computed |= set(near)
                if near and isinstance(target, str):
                    draft.near[target] = near[-1]
                return target
        draft.computed |= set(_names(part))
        return Left(text_of_items(part)[:40].lower(), i, statement.line, "a computed position")


def _tool(language: UrScript, statements: Sequence[Statement], k: int, flow: Sequence[InForce]) -> Frame:
    """Return the tool in force at a statement."""
    found = flow[k].setters.get("tcp")
    if not isinstance(found, int):
        return Frame("tcp", reason=f"set_tcp: {found}" if found else "")
    call = _call(statements[found])
    match call[1].parts[0] if call and call[1].parts else ():
        case [p, Brackets(kind="[") as group] if (
            str(p) == "p" and (numbers := numbers_of(group.parts)) and len(numbers) == 6
        ):
            return Frame("tcp", language.pose(np.array([number.value for number in numbers])))
    return Frame("tcp", reason=f"line {statements[found].line} sets a computed tool")


def _call(statement: Statement) -> tuple[str, Brackets] | None:
    """Return name and arguments of a call that a statement is."""
    match statement.items:
        case [name, Brackets(kind="(") as group] if is_token(name, "WORD"):
            return str(name), group
    return None


def _opens(statement: Statement) -> str:
    first = statement.items[0]
    return _OPENS.get(str(first), "") if is_token(first, "WORD") else ""


def _names(items: Sequence[Any]) -> list[str]:
    """Return the names in items as they are text_of_items."""
    found = []
    for item in items:
        found += _names(item.items) if isinstance(item, Brackets) else [str(item)] if item.type == "WORD" else []
    return found


def _called(items: Sequence[Any]) -> list[str]:
    """Return the names that are called in items, in brackets too."""
    found = [str(name) for name, group in pairwise(items) if isinstance(group, Brackets) and is_token(name, "WORD")]
    return found + [name for item in items if isinstance(item, Brackets) for name in _called(item.items)]


def _step(statement: Statement, setting: set[str]) -> Step:
    """Return what a statement does to the order of others and to the tool."""
    first = str(statement.items[0]) if is_token(statement.items[0], "WORD") else ""
    kind = _OPENS.get(first, "")
    if kind:
        return Step(opens=first, is_routine=kind == "routine", is_loop=kind == "loop")
    if first == "end" and len(statement.items) == 1:
        return Step(closes=tuple(_OPENS))
    if first in ("elif", "else"):
        return Step(is_jump=True)
    if first == "set_tcp":
        return Step(sets=frozenset({"tcp"}))
    return Step(clears=frozenset({"tcp"}) if setting & set(_called(statement.items)) else frozenset())


def _routines_that_set_the_tool(statements: Sequence[Statement]) -> set[str]:
    """Return the names of routines that set the tool."""
    found, routine = set[str](), ""
    for statement in statements:
        names = _names(statement.items)
        if _opens(statement) == "routine" and len(names) > 1:
            routine = names[1]
        elif "set_tcp" in names and routine:
            found.add(routine)
    return found
