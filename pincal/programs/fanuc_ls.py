"""FANUC's program listings: motions in ``/MN``, positions in ``/POS``, each with its frames and its
configuration.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from pincal.programs.draft import Draft, joined
from pincal.programs.fanuc_lines import (
    COMPUTED,
    LISTING_WORDS,
    SWITCHED,
    effect_in_listing,
    effect_of_options,
    number_in_brackets,
    why_moved_by_options,
)
from pincal.programs.language import LANGUAGES, ControllerLanguage
from pincal.programs.line_flow import STATED_LOAD, Line, Listing, reasons_before, with_outside
from pincal.programs.program import (
    Frame,
    Load,
    Motion,
    Path,
    Point,
    Posture,
    Program,
    Skipped,
    Turn,
)
from pincal.programs.syntax import Source, Statement, number_at

if TYPE_CHECKING:
    from lark import Token

_LINES = r"""
start: _NL* PROG _NL (HEAD? _NL)* MN _NL (line? _NL)* POS _NL (BODY? _NL)* END (_NL | _EOT)*
line: LINE_NUMBER? KIND PLACE REST? -> motion
    | LINE_NUMBER? PLACE REST?      -> more
    | LINE_NUMBER? OTHER            -> other
    | LINE_NUMBER                   -> other
PROG.5: /\/PROG[^\r\n]*/
MN.5: /\/MN(?![^\s])/
POS.5: /\/POS(?![^\s])/
END.5: /\/END(?![^\s])/
LINE_NUMBER.4: /\d*:/
KIND.3: /[JLCA](?=[ \t]*PR?\[)/
PLACE.2: /PR?\[[^\]\r\n]*\]/
REST: /[^\s\x04][^\r\n\x04]*/
OTHER: /([^\s\/\x04]|\/\/)[^\r\n\x04]*/
HEAD: /[^\s\x04][^\r\n\x04]*/
BODY: /[^\s\x04\/][^\r\n\x04]*/
_NL: /\r\n|\r|\n/
_EOT: "\x04"
%ignore /[ \t\f\xa0]+/
"""
_POSITIONS = r"""
start: block* "\x04"
block: PLACE "{" group+ "}" ";"
group: GROUP "UF" ":" FRAME "," "UT" ":" FRAME "," (configuration ",")? value ("," value)*
configuration: "CONFIG" ":" "'" SIDE+ "," TURN "," TURN "," TURN "'"
value: NAME "=" SIGNED UNIT
PLACE: /P\[[^\]\r\n]*\]/
GROUP: /GP\d+:/
FRAME: /F|\d+/
SIDE: /[NFUDTBLR](?![A-Z])/
TURN: /[+-]?\d+/
NAME: /J\d+|E\d+|[XYZWPR]/
SIGNED: /[+-]?(\d+(\.\d*)?|\.\d+)|\*+/
UNIT: "mm" | "deg"
%ignore /[ \t\f\xa0\r\n]+/
"""
_WORDS = "a FANUC listing: /PROG, /MN with motions, /POS with positions, /END"
_JUMPS = ("LBL", "JMP", "IF", "ELSE", "SELECT", "FOR", "CALL", "END", "SKIP")


_PATHS: dict[str, Path] = {"J": "joint", "L": "line"}


@dataclass
class _Instruction:
    """An instruction with all of its continuation lines.

    Attributes:
        number: its line in the file.
        kind: the kind of motion, "" for none.
        places: its positions.
        texts: what stands behind its first position, or all of an instruction without one, line
            by line.
        is_assignment: whether its position is assigned to.
    """

    number: int
    kind: str
    places: list[Token]
    texts: list[str]
    is_assignment: bool = False

    @cached_property
    def text(self) -> str:
        """The texts of all of its lines."""
        return " ".join(text for text in self.texts if text)

    @property
    def is_half_an_arc(self) -> bool:
        """Whether the end of an arc stands on the next line."""
        return self.kind == "C" and len(self.places) == 1 and not any(self.texts)

    def take(self, more: _Instruction) -> None:
        """Take a line that continues it."""
        if self.kind == "C":
            self.places += more.places
        self.texts += more.texts

    @property
    def effect(self) -> Line:
        """What it does to what follows."""
        if self.is_assignment:
            return Line(self.number)
        if self.places:
            return effect_of_options(self.text, self.number)
        return effect_in_listing(self.text, self.number)


@LANGUAGES.register
class FanucLs(ControllerLanguage):
    """FANUC's listings."""

    name = "FANUC LS"
    suffixes = (".ls",)
    grammars = (_LINES, _POSITIONS)
    understood = LISTING_WORDS

    def read(self, sources: Sequence[Source]) -> Program:
        drafts = []
        parts = []
        for i, source in enumerate(sources):
            draft = Draft(sources, by_itself=True)
            draft.frame("0", np.eye(4), ["tool", "base"])
            lines = source.parse(_LINES, _WORDS).children
            begin = next(token for token in lines if getattr(token, "type", "") == "POS").end_pos
            end = next(token for token in lines if getattr(token, "type", "") == "END").start_pos
            for block in source.parse(_POSITIONS, _WORDS, part=(begin, end)).children:
                place, *groups = block.children
                name = _place(str(place))
                line = source.place(place.start_pos)[0]
                point = self._point(i, name, line, groups[0].children)
                draft.take(Skipped(name, i, line, point) if isinstance(point, str) else point)
            title = str(next(token for token in lines if getattr(token, "type", "") == "PROG"))
            drafts.append(draft)
            parts.append((title.upper().split()[1:], _instructions(lines)))
        listings = [
            Listing(title[0] if title else "", [one.effect for one in instructions])
            for title, instructions in parts
        ]
        displaced = reasons_before(with_outside(listings, SWITCHED))
        for i, (draft, (_, instructions)) in enumerate(zip(drafts, parts, strict=True)):
            self._move(draft, i, instructions, displaced[i])
            draft.leave_unused(listings[i].lines)
        return joined([draft.finish() for draft in drafts])

    def _point(self, i: int, name: str, line: int, group: Sequence[Any]) -> Point | str:
        """Return the point of a group, or why it can't be used."""
        label, user, tool, *rest = group
        if label != "GP1:":
            return "it has no group 1"
        values = {str(tree.children[0]): tree.children[1:] for tree in rest if tree.data == "value"}
        numbers = {key: number_at(number) for key, (number, _) in values.items()}
        if any(number is None for number in numbers.values()):
            return "it is not taught"
        known = {key: number for key, number in numbers.items() if number is not None}
        if any(number.value for key, number in known.items() if key.startswith("E")):
            return "an external axis is not at 0"
        keys = [key for key in known if not key.startswith("E")]
        if keys == list("XYZWPR"):
            sides = [tree for tree in rest if tree.data == "configuration"]
            posture = _posture(sides[0].children) if sides else Posture()
            numbers_in_order = tuple(known[key] for key in keys)
            return Point(
                name, i, line, "pose", numbers_in_order, posture, Frame(str(tool)), Frame(str(user))
            )
        if keys == [f"J{k + 1}" for k in range(len(keys))]:
            return Point(name, i, line, "joints", tuple(known[key] for key in keys))
        return "neither X Y Z W P R nor joints"

    def _move(
        self,
        draft: Draft,
        i: int,
        instructions: Sequence[_Instruction],
        displaced: Sequence[Mapping[str, str]],
    ) -> None:
        """Note the motions."""
        run = 0
        for one, reasons in zip(instructions, displaced, strict=True):
            names = [_place(str(place)) for place in one.places]
            if not names:
                draft.read(_places_in(one.text.upper()))
                run += one.text.upper().startswith(_JUMPS)
                continue
            if one.is_assignment:
                draft.write(names[0], f"line {one.number} sets it while the program runs")
                draft.read(_places_in(one.text))
                continue
            draft.read(set(_places_in(one.text)) - set(names))
            if not one.kind:
                continue
            targets = [self._target(draft, i, name, one, reasons) for name in names]
            path = "circle" if len(names) > 1 else _PATHS.get(one.kind, "joint")
            place = one.places[-1]
            span = (place.start_pos or 0, place.end_pos or 0)
            statement = Statement((), *span, place.line or 0)
            number, _, text = reasons.get(STATED_LOAD, "").partition(" ")
            load = Load(text, int(number)) if number else None
            draft.motions.append(
                Motion(path, tuple(targets), statement, i, span=span, run=run, load=load)
            )

    def _target(
        self,
        draft: Draft,
        i: int,
        name: str,
        one: _Instruction,
        reasons: Mapping[str, str],
    ) -> str | Skipped:
        """Return the target of a motion, and note why its position has to be left."""
        if name.startswith("PR["):
            return Skipped(name, i, one.number, "a position register")
        moved = why_moved_by_options(one.text, one.number)
        if moved.startswith(COMPUTED):
            # The same position may be the target of another motion, without the offset.
            draft.read([name])
            return Skipped(name, i, one.number, moved)
        why = moved or draft.why_displaced(name, reasons)
        if why:
            draft.write(name, why)
        return name


def _instructions(lines: Sequence[Any]) -> list[_Instruction]:
    """Return the instructions of a listing, without remarks."""
    found = list[_Instruction]()
    for line in lines:
        if not hasattr(line, "data"):
            continue
        parts = {token.type: token for token in line.children if not hasattr(token, "data")}
        text = str(parts.get("REST", parts.get("OTHER", ""))).lstrip("] ")
        if line.data == "other" and text.startswith(("!", "//", "--")):
            continue
        one = _instruction(line.data, parts, text)
        # A line whose number is left out continues the one before.
        is_more = str(parts.get("LINE_NUMBER", "")) == ":"
        is_arc = line.data == "more" and not one.is_assignment
        if found and (is_more or (is_arc and found[-1].is_half_an_arc)):
            found[-1].take(one)
        else:
            found.append(one)
    return found


def _instruction(data: str, parts: Mapping[str, Any], text: str) -> _Instruction:
    """Return the instruction of one line."""
    place = parts.get("PLACE")
    number = next(token for token in parts.values()).line or 0
    text = (text.partition(" !")[0] if "(" not in text else text).rstrip("; ")
    is_assignment = data == "more" and text.startswith("=")
    places = [place] if place is not None else []
    return _Instruction(number, str(parts.get("KIND", "")), places, [text], is_assignment)


def _place(text: str) -> str:
    """Return a position's name without its comment: ``P[1:"App"]`` is P[1]; ``P[R[1]]``, any
    position, is P[*].
    """
    kind, _, index = text.partition("[")
    number = number_in_brackets(index.removesuffix("]"))
    return f"{kind}[{number if number.isdigit() else '*'}]"


def _places_in(text: str) -> Iterator[str]:
    """Yield the positions named in a text."""
    pieces = text.split("P[")
    for k in range(1, len(pieces)):
        if not pieces[k - 1][-1:].isalpha():
            yield _place("P[" + pieces[k].split("]")[0] + "]")


def _posture(configuration: Sequence[Token]) -> Posture:
    """Return the posture of a configuration: flip or not, up or down, front (T) or back, and turns
    of axes 1, 4 and 6.
    """
    sides = {str(token) for token in configuration if token.type == "SIDE"}
    turns = [
        number
        for token in configuration
        if token.type == "TURN" and (number := number_at(token)) is not None
    ]
    counted = tuple(
        Turn(j, "whole", int(number.value), number)
        for j, number in zip((0, 3, 5), turns, strict=True)
    )
    return Posture(
        front=_side(sides, "T", "B"),
        up=_side(sides, "U", "D"),
        down=_side(sides, "N", "F"),
        turns=counted,
    )


def _side(sides: set[str], yes: str, no: str) -> bool | None:
    return None if (yes in sides) == (no in sides) else yes in sides
