"""ABB's language: modules with targets declared or standing in the motions, tools, and work objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pincal.programs.language import LANGUAGES, ControllerLanguage
from pincal.programs.program import Draft, Frame, Left, Motion, Path, Point, Posture, Program, Turn
from pincal.programs.syntax import (
    Brackets,
    Number,
    Source,
    Statement,
    is_token,
    numbers_of,
    place_of,
    split,
    text_of_items,
    word,
    words_in,
)

_TOKENS = r"""
TEXT: /"([^"\r\n]|"")*"/
BITS.3: /\x05/
SIGN: /[^\x04\s\w()\[\]{}"!;$#]/
_END: ";" | "\x04"
COMMENT.5: /![^\r\n]*/
%ignore COMMENT
%ignore /[ \t\f\r\n\xa0]+/
"""
_WORDS = "RAPID: MODULE ... ENDMODULE with statements that end in ';'"
_BLOCKS = {"MODULE": "ENDMODULE", "PROC": "ENDPROC", "FUNC": "ENDFUNC", "TRAP": "ENDTRAP", "WHILE": "ENDWHILE",
           "FOR": "ENDFOR", "TEST": "ENDTEST", "RECORD": "ENDRECORD"}  # fmt: skip
_JUMPS = {*_BLOCKS, *_BLOCKS.values(), "IF", "ELSE", "ELSEIF", "ENDIF", "CASE", "DEFAULT", "GOTO", "RETURN", "ERROR"}
_MOTIONS: dict[str, Path] = {"MOVEL": "line", "MOVEJ": "joint", "MOVEC": "circle", "MOVEABSJ": "joint"}
_MOTIONS |= {f"{name}{more}": path for name, path in _MOTIONS.items() for more in ("DO", "AO", "GO", "SYNC")
             if name != "MOVEABSJ"}  # fmt: skip
_OTHER: dict[str, Path] = {"TRIGGL": "line", "TRIGGJ": "joint", "TRIGGC": "circle"}
_SEARCHES = ("SEARCHL", "SEARCHJ", "SEARCHC")
_STORAGE = ("CONST", "PERS", "VAR")
_DATA = ("ROBTARGET", "JOINTTARGET", "TOOLDATA", "WOBJDATA")
_BEFORE = ("THEN", "ELSE", "DO", "ENDIF", "ENDWHILE", "ENDFOR", "ENDTEST", "ENDPROC", "DEFAULT")
# No external axis: 9E9 stands for none.
_NONE = 8.9e9


@LANGUAGES.register
class Rapid(ControllerLanguage):
    """ABB's language."""

    name = "RAPID"
    suffixes = (".mod", ".prg", ".sys", ".modx", ".sysx")
    convention = "abb"
    digits = (4, 9, 7)
    can_insert = True

    def read(self, sources: Sequence[Source]) -> Program:
        """Return the program of a module."""
        draft = Draft(sources)
        draft.tools["TOOL0"] = draft.bases["WOBJ0"] = np.eye(4)
        for i, source in enumerate(sources):
            statements = source.statements(_TOKENS, _WORDS)
            _check_blocks(source, statements)
            run = 0
            for statement in statements:
                run = self._statement(draft, i, statement, run)
        return draft.finish()

    def statement(self, motion: Motion, source: Source, *, values: np.ndarray, posture: Posture) -> str:
        """Return the motion with a target in the place of its own, passed in zone z0."""
        start, end = motion.span
        position = ",".join(f"{value:.4f}" for value in values[:3])
        turn = ",".join(f"{value:.9f}" for value in values[3:])
        conf = ",".join(_configuration(posture))
        target = f"[[{position}],[{turn}],[{conf}],[9E9,9E9,9E9,9E9,9E9,9E9]]"
        text = source.text[motion.statement.start : motion.statement.end]
        at = motion.statement.start
        text = text[: start - at] + target + text[end - at :]
        return _in_zone(text) + ";"

    def _statement(self, draft: Draft, i: int, statement: Statement, run: int) -> int:
        """Take note of a statement; return the number of the run after it."""
        items = statement.items
        k = next((k for k in reversed(range(len(items))) if word(items[k]) in (*_MOTIONS, *_OTHER)), None)
        storage = next((k for k in reversed(range(len(items))) if word(items[k]) in _STORAGE), None)
        jumps = any(word(item) in _JUMPS for item in items)
        if k is not None and len(items) > k + 1 and not is_token(items[k + 1], "SIGN", ":"):
            is_lone = self._move(draft, i, statement, k, run + (k > 0))
            return run + (k > 0) + (not is_lone)
        if storage is not None:
            self._declare(draft, i, replace(statement, line=items[storage].line), items[storage + 1 :])
            if word(items[storage]) == "CONST" and len(items) > storage + 2:
                draft.fixed.add(word(items[storage + 2]))
            return run + (storage > 0)
        sides = _assigned(items)
        if sides is not None:
            name = _name(sides[0])
            draft.changed[name] = f"line {statement.line} sets it while the program runs"
            draft.tools[name] = draft.bases[name] = None
        elif items and word(items[0]) not in ("", *_JUMPS):
            for name in set(words_in(items[1:])) & draft.declared.keys() - draft.fixed:
                draft.changed.setdefault(name, f"line {statement.line} hands it to {word(items[0])}, which may change it")
        draft.computed |= set(words_in(items))
        if any(word(item) in _SEARCHES for item in items):
            draft.left.append(Left(f"search of line {statement.line}", i, statement.line, "it ends where a signal comes"))
            return run + 1
        return run + jumps

    def _declare(self, draft: Draft, i: int, statement: Statement, items: tuple[Any, ...]) -> None:
        kind, rest = word(items[0]) if items else "", items[1:]
        sides = _assigned(rest)
        if kind not in _DATA or not rest or not word(rest[0]):
            draft.computed |= set(words_in(items))
            return
        name = word(rest[0])
        value = sides[1] if sides is not None else ()
        whole = value[0] if len(value) == 1 and isinstance(value[0], Brackets) and value[0].kind == "[" else None
        if sides is not None and len(sides[0]) > 1:
            lost = Left(name, i, statement.line, "an array of targets")
            draft.left += [lost] if kind in _DATA[:2] else []
            draft.changed[name] = lost.reason
        elif kind in _DATA[:2]:
            target = self._target_of(i, statement, name, whole) if whole else None
            if isinstance(target, Point) and (target.kind == "joints") == (kind == "JOINTTARGET"):
                draft.declare(target)
            elif value:
                reason = target.reason if isinstance(target, Left) else "a computed value"
                draft.left.append(Left(name, i, statement.line, reason))
                draft.changed[name] = reason
            else:
                draft.changed[name] = "it is set while the program runs"
        else:
            frames = draft.tools if kind == "TOOLDATA" else draft.bases
            draft.keep(frames, name, self._tool(whole) if kind == "TOOLDATA" else self._work_object(whole))

    def _target_of(self, i: int, statement: Statement, name: str, group: Brackets) -> Point | Left:
        """Return the target that an aggregate is."""
        lists = [_numbers(part) for part in group.parts]
        lost = Left(name, i, statement.line, "not all of its values are numbers")
        if None in lists:
            return lost
        match [found for found in lists if found is not None]:
            case [position, turn, conf, external] if [len(position), len(turn), len(conf), len(external)] == [3, 4, 4, 6]:
                if any(number.value and number.value < _NONE for number in external):
                    return Left(name, i, statement.line, "an external axis is not at 0")
                posture = _posture(conf)
                if posture is None:
                    return Left(name, i, statement.line, "its configuration is none")
                return Point(name, i, statement.line, "pose", (*position, *turn), posture)
            case [axes, external] if len(axes) == len(external) == 6:
                return Point(name, i, statement.line, "joints", axes)
        return lost

    def _frame_of(self, group: Any) -> np.ndarray | None:
        """Return the pose that an aggregate of position and quaternion is."""
        if not isinstance(group, tuple) or len(group) != 1 or not isinstance(group[0], Brackets):
            return None
        lists = [_numbers(part) for part in group[0].parts]
        if len(lists) != 2 or lists[0] is None or lists[1] is None or [len(part) for part in lists if part] != [3, 4]:
            return None
        values = np.array([number.value for number in (*lists[0], *lists[1])])
        return self.pose(values) if self.is_pose(values) else None

    def _tool(self, group: Brackets | None) -> np.ndarray | None:
        """Return the pose of a tool that the robot holds."""
        parts = group.parts if group is not None else []
        return self._frame_of(parts[1]) if len(parts) == 3 and text_of_items(parts[0]) == "TRUE" else None

    def _work_object(self, group: Brackets | None) -> np.ndarray | None:
        """Return the pose of a work object that stands still and that the robot does not hold."""
        parts = group.parts if group is not None else []
        if len(parts) != 5 or [text_of_items(part) for part in parts[:2]] != ["FALSE", "TRUE"]:
            return None
        user, own = self._frame_of(parts[3]), self._frame_of(parts[4])
        return user @ own if user is not None and own is not None else None

    def _move(self, draft: Draft, i: int, statement: Statement, k: int, run: int) -> bool:
        """Take note of a motion: its targets, tool and work object; return whether it is a statement by itself."""
        items = statement.items[k:]
        first, parts = word(items[0]), split(items[1:])
        options = [_option(part) for part in parts]
        plain = [part for part, option in options if part]
        more = {name: value for _, option in options for name, value in option.items()}
        circle = first.startswith("MOVEC") or first == "TRIGGC"
        places = plain[: 1 + circle]
        statement = replace(statement, line=items[0].line)
        targets = tuple(self._target(i, statement, part) for part in places)
        before = word(statement.items[k - 1]) if k else ""
        header = text_of_items(statement.items[max(k - 3, 0) : k])
        lone = k == 0 or before in _BEFORE or header.startswith("PROC") or header.endswith(("TRAP", "()"))
        if len(targets) <= circle:
            return lone
        draft.computed |= {name for part, target in zip(places, targets, strict=True) if isinstance(target, Left)
                           for name in words_in(part)}  # fmt: skip
        # Behind speed and zone; of Trigg, whose events stand between, the last.
        tools = plain[-1:] if first in _OTHER else plain[3 + circle : 4 + circle]
        tools = [part for part in tools if len(part) == 1 and word(part[0])]
        reason = "" if tools else "its tool is computed"
        base = word(more["WOBJ"][0]) if len(more.get("WOBJ", ())) == 1 else ""
        base_frame = Frame(base or "WOBJ0", None, "" if base or "WOBJ" not in more else "its work object is computed")
        if "CORR" in more:
            base_frame = Frame("", None, "the motion is corrected by a sensor (\\Corr)")
        tool = Frame(word(tools[0][0]), None, reason) if tools else Frame("", None, reason)
        begin, end = place_of(places[-1][0])[0], place_of(places[-1][-1])[1]
        start = place_of(items[0])[0]
        own = Statement(items, start, statement.end, statement.items[k].line)
        path = (_MOTIONS | _OTHER)[first]
        can_insert = first == "MOVEL" and lone
        draft.motions.append(Motion(path, targets, own, i, tool, base_frame, (begin, end), run, can_insert))
        return lone

    def _target(self, i: int, statement: Statement, part: tuple[Any, ...]) -> str | Point | Left:
        match part:
            case [name] if word(name):
                return word(name)
            case [Brackets(kind="[") as group]:
                return self._target_of(i, statement, f"target of line {statement.line}", group)
        return Left(text_of_items(part)[:40], i, statement.line, "a computed position")


def _check_blocks(source: Source, statements: Sequence[Statement]) -> None:
    """Refuse a file whose blocks are not closed, or that has no module."""
    stack: list[tuple[str, Any]] = []
    seen = False
    for statement in statements:
        for item, before in zip(statement.items, (None, *statement.items), strict=False):
            name = word(item)
            if name in _BLOCKS and not (before is not None and is_token(before, "SIGN", "\\")):
                if not stack and name != "MODULE":
                    raise source.error(f"{str(item)!r} outside of a module; expected {_WORDS}", place_of(item)[0])
                stack.append((name, item))
                seen = True
            elif name in _BLOCKS.values():
                if not stack or _BLOCKS[stack[-1][0]] != name:
                    inside = f"within {stack[-1][0]} of line {stack[-1][1].line}" if stack else "closes nothing"
                    raise source.error(f"{str(item)!r} {inside}; expected {_WORDS}", place_of(item)[0])
                stack.pop()
    if stack or not seen:
        inside = f"within {stack[-1][0]} of line {stack[-1][1].line}: is it cut?" if stack else f"expected {_WORDS}"
        raise source.error(f"the end of the file, {inside}", len(source.content))


def _assigned(items: Sequence[Any]) -> tuple[tuple[Any, ...], tuple[Any, ...]] | None:
    """Return what stands before and behind ``:=``."""
    for k in range(len(items) - 1):
        if is_token(items[k], "SIGN", ":") and is_token(items[k + 1], "SIGN", "="):
            return tuple(items[:k]), tuple(items[k + 2 :])
    return None


def _name(items: Sequence[Any]) -> str:
    """Return the variable that the left side of an assignment sets a part of, behind THEN and the like."""
    first = max((k + 1 for k, item in enumerate(items) if word(item) in _BEFORE), default=0)
    names = [word(item) for item in items[first:] if word(item)]
    return names[0] if names else ""


def _numbers(part: Sequence[Any]) -> tuple[Number, ...] | None:
    match list(part):
        case [Brackets(kind="[") as group]:
            return numbers_of(group.parts)
    return None


def _option(part: tuple[Any, ...]) -> tuple[tuple[Any, ...], dict[str, tuple[Any, ...]]]:
    r"""Return an argument and the options behind it, ``\Name:=value`` or ``\Name``."""
    pieces = split(part, "\\")
    found = {}
    for piece in pieces[1:]:
        sides = _assigned(piece) or (piece, ())
        if sides[0]:
            found[word(sides[0][0])] = sides[1]
    return pieces[0], found


def _posture(conf: Sequence[Number]) -> Posture | None:
    """Return what confdata say: quarters of axes 1, 4 and 6, and the number of one of eight postures."""
    if any(number.value != round(number.value) for number in conf) or not 0 <= conf[3].value <= 7:
        return None
    shape = int(conf[3].value)
    turns = tuple(Turn(joint, "quarter", int(number.value), number) for joint, number in zip((0, 3, 5), conf, strict=False))
    return Posture(front=not shape & 4, up=not shape & 2, down=not shape & 1, turns=turns)


def _configuration(posture: Posture) -> list[str]:
    shape = 4 * (not posture.front) + 2 * (not posture.up) + (not posture.down)
    return [*(str(turn.value) for turn in posture.turns), str(shape)]


def _in_zone(text: str) -> str:
    """Return a motion that passes its target: ``fine`` and wider zones become z0."""
    depth, commas, start = 0, [], 0
    for k, letter in enumerate(text):
        depth += (letter in "([{") - (letter in ")]}")
        if letter == "," and not depth:
            commas.append(k)
    if len(commas) < 3:
        return text
    start, end = commas[1] + 1, commas[2]
    return text[:start] + " z0" + text[end:]
