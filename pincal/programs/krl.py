"""KUKA's language: a ``.src`` of motions and the ``.dat`` with its points, either alone or both."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pincal.programs.flow import InForce, Step, followed
from pincal.programs.language import LANGUAGES, ControllerLanguage
from pincal.programs.program import Draft, Frame, Left, Motion, Path, Point, Posture, Program, Turn
from pincal.programs.syntax import (
    Brackets,
    Number,
    Source,
    Statement,
    is_token,
    number_of,
    split,
    text_of_items,
    word,
    words_in,
)

_TOKENS = r"""
TEXT: /"[^"\r\n]*"/
BITS.2: /'[BbHh][0-9A-Fa-f]+'/
SIGN: /[^\x04\s\w()\[\]{}"';&$#]|'/
_END: /\r\n|\r|\n|\x04/
COMMENT.5: /;[^\r\n]*/
HEADER.5: /&[^\r\n]*/
%ignore COMMENT
%ignore HEADER
%ignore /[ \t\f\xa0]+/
"""
_WORDS = "KRL: statements within DEF ... END or DEFDAT ... ENDDAT, brackets closed on their line"
_ROUTINES = {"DEF": "END", "DEFFCT": "ENDFCT", "DEFDAT": "ENDDAT"}
_LOOPS = {"LOOP": "ENDLOOP", "WHILE": "ENDWHILE", "FOR": "ENDFOR", "REPEAT": "UNTIL"}
_BLOCKS = {"IF": "ENDIF", "SWITCH": "ENDSWITCH", "SPLINE": "ENDSPLINE", "PTP_SPLINE": "ENDSPLINE"}
_CLOSES = {end: tuple(k for k, v in {**_ROUTINES, **_LOOPS, **_BLOCKS}.items() if v == end)
           for end in {*_ROUTINES.values(), *_LOOPS.values(), *_BLOCKS.values()}}  # fmt: skip
_MOTIONS: dict[str, Path] = {"PTP": "joint", "LIN": "line", "CIRC": "circle", "SPTP": "joint", "SLIN": "line",
                             "SCIRC": "circle", "SPL": "joint"}  # fmt: skip
_RELATIVE = {f"{name}_REL" for name in _MOTIONS}
_AFTER = {"C_DIS", "C_VEL", "C_ORI", "C_PTP", "C_SPL", "WITH"}
_POSE, _JOINTS = tuple("XYZABC"), tuple(f"A{i}" for i in range(1, 7))
_EXTERNAL = tuple(f"E{i}" for i in range(1, 7))
_NULL = ("$NULLFRAME", "$WORLD", "TOOL_DATA[0]", "BASE_DATA[0]")
_FRAMES = frozenset({"$TOOL", "$BASE"})


@LANGUAGES.register
class Krl(ControllerLanguage):
    """KUKA's language."""

    name = "KRL"
    suffixes = (".src", ".dat")
    is_pair = True
    convention = "kuka"
    can_insert = True

    def read(self, sources: Sequence[Source]) -> Program:
        """Return the program of a ``.src`` and its ``.dat``."""
        return _Reader(self, Draft(sources)).read()

    def statement(self, motion: Motion, source: Source, *, values: np.ndarray, posture: Posture) -> str:
        """Return the motion with a pose in the place of its target, passed without a stop."""
        start, end = motion.span
        pose = ",".join(f"{name} {value:.{4 if name in 'XYZ' else 6}f}" for name, value in zip(_POSE, values, strict=True))
        after = source.text[end : motion.statement.end]
        approximate = "" if any(word in after.upper() for word in _AFTER) or after.strip() else " C_DIS"
        return source.text[motion.statement.start : start] + "{" + pose + "}" + after + approximate

    def bits(self, number: Number, value: int) -> str:
        """Return bits in the spelling of others: decimal, 'B...' or 'H...'."""
        if not number.text.startswith("'"):
            return str(value)
        width = len(number.text) - 3
        return f"'{number.text[1]}{value:0{width}{'b' if number.text[1] in 'Bb' else 'X'}}'"


@dataclass
class _Reader:
    """What has been found in the files so far."""

    language: ControllerLanguage
    draft: Draft
    data: dict[str, tuple[str, str] | None] = field(default_factory=dict)
    frames_used: set[str] = field(default_factory=set)
    is_held: bool = False
    is_spline: bool = False

    def read(self) -> Program:
        files = [(i, source, source.statements(_TOKENS, _WORDS)) for i, source in enumerate(self.draft.sources)]
        setting = {name for *_, statements in files for name in _routines_that_set_frames(statements)}
        flows = []
        for _, source, statements in files:
            flow = followed(source, statements, [_step(statement, setting) for statement in statements])
            pairs = zip(statements, flow, strict=True)
            outside = [statement for statement, known in pairs if not known.depth and not _step(statement, setting).opens]
            if outside or not statements:
                at = outside[0].start if outside else 0
                raise source.error("a statement outside of DEF or DEFDAT; expected " + _WORDS, at)
            flows.append(flow)
        for i, _, statements in files:
            for statement in statements:
                self._declare(i, statement)
        for (i, _, statements), flow in zip(files, flows, strict=True):
            for k in range(len(statements)):
                self._move(i, statements, k, flow)
        targets = {target for motion in self.draft.motions for target in motion.targets if isinstance(target, str)}
        for name in self.frames_used & self.draft.declared.keys():
            if name in targets:
                self.draft.changed[name] = "it is a tool or a base, too"
            else:
                del self.draft.declared[name]
        return self.draft.finish()

    def _declare(self, i: int, statement: Statement) -> None:
        """Take note of what a statement sets."""
        items = statement.items
        while items and word(items[0]) in ("GLOBAL", "DECL", "CONST"):
            items = items[1:]
        first = word(items[0]) if items else ""
        if first in (*_MOTIONS, *_RELATIVE, *_ROUTINES) or not items:
            return
        if len(items) > 1 and first and word(items[1]):
            items = items[1:]
        sides = split(items, "=")
        name = text_of_items(sides[0])
        if len(sides) != 2 or not word(sides[0][0]):
            self._mentions(statement, items)
            return
        if name == "$IPO_MODE" and text_of_items(sides[1]) == "#TCP":
            self.is_held = True
        match sides[1]:
            case [Brackets(kind="{") as group] if (fields := _fields(group)) is not None:
                if "TOOL_NO" in fields and "BASE_NO" in fields:
                    numbers = [number_of(fields[key]) for key in ("TOOL_NO", "BASE_NO")]
                    known = all(numbers) and text_of_items(fields.get("IPO_FRAME", ())) in ("", "#BASE")
                    names = (f"TOOL_DATA[{numbers[0].text}]", f"BASE_DATA[{numbers[1].text}]") if known else None  # type: ignore[union-attr]
                    self.data[name] = None if name in self.data else names
                elif point := self._point(i, statement, name, fields):
                    is_frame = name.startswith(("TOOL_DATA[", "BASE_DATA[", "$"))
                    if isinstance(point, Point) and point.kind == "pose" and not name.startswith("$"):
                        self.draft.keep(self.draft.tools, name, self.language.pose(point.values))
                    if isinstance(point, Left) and not is_frame:
                        self.draft.left.append(point)
                    elif isinstance(point, Point) and not is_frame:
                        self.draft.declare(point)
                return
        whole, dot, _ = name.partition(".")
        what = "a part of it" if dot else "it"
        for other in self._meant(whole):
            self.draft.changed[other] = f"line {statement.line} sets {what} while the program runs"
        self._mentions(statement, sides[1])

    def _mentions(self, statement: Statement, items: Sequence[Any]) -> None:
        """Take note of the names in an expression or a call."""
        is_call = len(items) == 2 and isinstance(items[1], Brackets) and items[1].kind == "("
        for name in words_in(items):
            self.draft.computed.add(name)
            if is_call and name != word(items[0]):
                self.draft.changed[name] = f"line {statement.line} hands it to {word(items[0])}, which may change it"

    def _meant(self, name: str) -> Iterator[str]:
        """Yield the names that an assignment may change: of an array with an index that is computed, all of it."""
        yield name
        array, bracket, index = name.partition("[")
        if bracket and not index.rstrip("]").isdigit():
            yield from (f"{array}[{k}]" for k in range(1, 1000))

    def _point(self, i: int, statement: Statement, name: str, fields: Mapping[str, tuple[Any, ...]]) -> Point | Left | None:
        """Return the point of an aggregate; None if it is none."""
        keys = next((keys for keys in (_POSE, _JOINTS) if set(keys) & fields.keys()), None)
        if keys is None:
            return None
        numbers = [number_of(fields.get(key, ())) for key in keys]
        found = tuple(number for number in numbers if number is not None)
        if len(found) < len(keys):
            return Left(name, i, statement.line, f"not all of {' '.join(keys)} are there as numbers")
        external = [number_of(fields[key]) for key in _EXTERNAL if key in fields]
        if keys is _JOINTS:
            return Point(name, i, statement.line, "joints", found)
        if any(number is None or number.value for number in external):
            return Left(name, i, statement.line, "an external axis is not at 0")
        if (posture := _posture(fields)) is None:
            return Left(name, i, statement.line, "S or T is no number")
        return Point(name, i, statement.line, "pose", found, posture)

    def _move(self, i: int, statements: Sequence[Statement], k: int, flow: Sequence[InForce]) -> None:
        """Take note of a motion."""
        statement, items = statements[k], statements[k].items
        first = word(items[0])
        if first.endswith("SPLINE"):
            self.is_spline = not first.startswith("END")
        if first in _RELATIVE:
            self.draft.computed |= set(words_in(items[1:]))
            lost = Left(text_of_items(items)[:40], i, statement.line, "a relative motion")
            self.draft.motions.append(Motion("joint", (lost,), statement, i, Frame(""), Frame(""), (0, 0), flow[k].run))
            return
        if first not in _MOTIONS or len(items) < 2 or is_token(items[1], "SIGN", "="):
            return
        stop = next((j for j, item in enumerate(items) if word(item) in _AFTER), len(items))
        parts = split(items[1:stop])
        arcs = [part for part in parts if part and word(part[0]) == "CA"]
        parts = [part for part in parts if part and part not in arcs]
        tool, base = (self._frame(name, statements, k, flow) for name in ("$TOOL", "$BASE"))
        targets = tuple(self._target(i, statement, part) for part in parts)
        if not parts:
            return
        last = parts[-1]
        span = (_start(last[0]), _end(last[-1]))
        path = "joint" if arcs or len(parts) != 1 + (_MOTIONS[first] == "circle") else _MOTIONS[first]
        can_insert = path == "line" and not self.is_spline
        self.draft.motions.append(Motion(path, targets, statement, i, tool, base, span, flow[k].run, can_insert))

    def _target(self, i: int, statement: Statement, part: tuple[Any, ...]) -> str | Point | Left:
        match part:
            case [Brackets(kind="{") as group]:
                name = f"{word(statement.items[0])} of line {statement.line}"
                fields = _fields(group)
                return (self._point(i, statement, name, fields) if fields is not None else None) or Left(
                    name, i, statement.line, "not understood"
                )
            case [name] if word(name) and not word(name).startswith("$"):
                return word(name)
            case [name, Brackets(kind="[", items=[index])] if word(name) and is_token(index, "NUMBER"):
                return text_of_items(part)
        self.draft.computed |= set(words_in(part))
        return Left(text_of_items(part)[:40], i, statement.line, "a computed position")

    def _frame(self, name: str, statements: Sequence[Statement], k: int, flow: Sequence[InForce]) -> Frame:
        """Return $TOOL or $BASE before a statement."""
        if self.is_held:
            return Frame(name, reason="the tool is fixed in the cell ($IPO_MODE=#TCP)")
        for part in split(_after_with(statements[k].items)):
            sides = split(part, "=")
            if len(sides) == 2 and text_of_items(sides[0]) == name:
                return self._frame_of(name, sides[1])
        found = flow[k].setters.get(name)
        if not isinstance(found, int):
            return Frame(name, reason=f"{name}: {found}" if found else "")
        setter = statements[found].items
        if word(setter[0]) != "BAS":
            return self._frame_of(name, split(setter, "=")[1])
        match setter[1].parts if isinstance(setter[1], Brackets) else ():
            case [(what,), index] if word(what) in ("#TOOL", "#BASE") and (number := number_of(index)):
                return self._frame_of(name, setter[1].items, f"{word(what)[1:]}_DATA[{number.text}]")
            case [(what,), *_] if word(what) in ("#PTP_PARAMS", "#CP_PARAMS", "#FRAMES", "#PTP_DAT", "#CP_DAT"):
                source = flow[found].setters.get("FDAT_ACT")
                if not isinstance(source, int):
                    return Frame(name, reason=f"FDAT_ACT: {source or 'it is set elsewhere'}")
                return self._frame_of_data(name, text_of_items(split(statements[source].items, "=")[1]))
        return Frame(name, reason=f"line {statements[found].line} may set {name}")

    def _frame_of(self, name: str, items: Sequence[Any], text: str = "") -> Frame:
        """Return the frame that an expression is."""
        match list(items):
            case [Brackets(kind="{") as group] if (fields := _fields(group)) is not None:
                numbers = [number_of(fields.get(key, ())) for key in _POSE]
                if None not in numbers:
                    return Frame(name, self.language.pose(np.array([number.value for number in numbers if number])))
            case [call, Brackets(kind="(") as group] if word(call) in ("STOOL", "STOOL2", "SBASE"):
                return self._frame_of_data(name, text_of_items(group.items).partition(".")[0])
        text = text or text_of_items(items)
        self.frames_used.add(text)
        if text in _NULL:
            return Frame(text, np.eye(4))
        if any(sign in text for sign in ":+-*/(.{") or not text:
            return Frame(name, reason=f"{name} is computed")
        return Frame(text)

    def _frame_of_data(self, name: str, data: str) -> Frame:
        """Return the tool or the base of a point's frame data."""
        found = self.data.get(data)
        if found is None:
            return Frame(name, reason=f"the frame data {data} are not in these files, or not as numbers")
        return self._frame_of(name, (), found[name == "$BASE"])


def _start(item: Any) -> int:
    return item.start if isinstance(item, Brackets) else int(item.start_pos)


def _end(item: Any) -> int:
    return item.end if isinstance(item, Brackets) else int(item.end_pos)


def _after_with(items: Sequence[Any]) -> Sequence[Any]:
    return next((items[j + 1 :] for j, item in enumerate(items) if word(item) == "WITH"), ())


def _fields(group: Brackets) -> dict[str, tuple[Any, ...]] | None:
    """Return the values of an aggregate by their names; None if it is none."""
    found = dict[str, tuple[Any, ...]]()
    for k, part in enumerate(group.parts):
        if k == 0 and len(part) > 2 and word(part[0]) and is_token(part[1], "SIGN", ":"):
            part = part[2:]
        if len(part) < 2 or not word(part[0]) or word(part[0]) in found:
            return None
        found[word(part[0])] = part[1:]
    return found


def _bits(items: tuple[Any, ...]) -> Number | None:
    """Return a number that may be written in bits."""
    if len(items) == 1 and is_token(items[0], "BITS"):
        text = str(items[0])
        try:
            return Number(int(text[2:-1], 2 if text[1] in "Bb" else 16), items[0].start_pos, items[0].end_pos, text)
        except ValueError:
            return None
    number = number_of(items)
    return number if number is not None and number.text.isdigit() else None


def _posture(fields: Mapping[str, tuple[Any, ...]]) -> Posture | None:
    """Return what S and T say: bits of S are overhead, elbow up, axis 5 below 0; those of T axes below 0."""
    posture, turns = Posture(), tuple[Turn, ...]()
    if "S" in fields:
        status = _bits(fields["S"])
        if status is None:
            return None
        bits = int(status.value)
        posture = Posture(front=not bits & 1, up=bool(bits & 2), down=not bits & 4)
    if "T" in fields:
        number = _bits(fields["T"])
        if number is None:
            return None
        turns = tuple(Turn(j, "negative", int(number.value) >> j & 1, number, j) for j in range(6))
    return Posture(*posture.sides, turns)


def _opening(statement: Statement) -> str:
    """Return the word that opens a block, that of a routine behind GLOBAL."""
    first = word(statement.items[0])
    return word(statement.items[1]) if first == "GLOBAL" and len(statement.items) > 1 else first


def _step(statement: Statement, setting: set[str]) -> Step:
    """Return what a statement does to the order of others and to the frames."""
    items, opens = statement.items, _opening(statement)
    if opens in _ROUTINES:
        return Step(opens=opens, is_routine=True)
    first = word(items[0])
    if first in _LOOPS or first in _BLOCKS:
        return Step(opens=first, is_loop=first in _LOOPS)
    if first in _CLOSES:
        return Step(closes=_CLOSES[first])
    if first in ("ELSE", "CASE", "DEFAULT") or (len(items) == 2 and is_token(items[1], "SIGN", ":")):
        return Step(is_jump=True)
    if first == "BAS" and len(items) == 2 and isinstance(items[1], Brackets):
        what = text_of_items(items[1].parts[0]) if items[1].parts else ""
        one = {"#TOOL": {"$TOOL"}, "#BASE": {"$BASE"}}.get(what)
        return Step(sets=frozenset(one or _FRAMES))
    sides = split(items, "=")
    if len(sides) == 2 and first not in _MOTIONS:
        name = text_of_items(sides[0])
        clears = {name.partition(".")[0]} if "." in name else set()
        return Step(sets=frozenset({name} - clears), clears=frozenset(clears))
    return Step(clears=_FRAMES if first in setting else frozenset())


def _routines_that_set_frames(statements: Sequence[Statement]) -> Iterator[str]:
    """Yield the names of routines in which a tool or a base is set."""
    routine = ""
    for statement in statements:
        opens = _opening(statement)
        if opens in ("DEF", "DEFFCT"):
            names = [word(item) for item in statement.items if word(item)]
            routine = names[-1]
        elif _step(statement, set()).sets & _FRAMES and routine:
            yield routine
