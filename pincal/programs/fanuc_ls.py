"""FANUC's program listings: motions in ``/MN``, positions in ``/POS``, each with its frames and its
configuration.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pincal.programs.draft import Draft
from pincal.programs.language import LANGUAGES, ControllerLanguage
from pincal.programs.program import Frame, Motion, Point, Posture, Program, Skipped, Turn
from pincal.programs.syntax import Source, Statement, number_at

if TYPE_CHECKING:
    from lark import Token, Tree

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
# Options by which the target of a motion is not its position.
_MOVED = ("OFFSET", "TOOL_OFFSET", "VOFFSET", "COORD", "RTCP", "PTH_OFFSET")


@LANGUAGES.register
class FanucLs(ControllerLanguage):
    """FANUC's listings."""

    name = "FANUC LS"
    suffixes = (".ls",)
    grammars = (_LINES, _POSITIONS)

    def read(self, sources: Sequence[Source]) -> Program:
        draft = Draft(sources, by_itself=True)
        draft.frame("0", np.eye(4), ["tool", "base"])
        for i, source in enumerate(sources):
            lines = source.parse(_LINES, _WORDS).children
            begin = next(token for token in lines if getattr(token, "type", "") == "POS").end_pos
            end = next(token for token in lines if getattr(token, "type", "") == "END").start_pos
            for block in source.parse(_POSITIONS, _WORDS, part=(begin, end)).children:
                place, *groups = block.children
                name = _place(str(place))
                line = source.place(place.start_pos)[0]
                point = self._point(i, name, line, groups[0].children)
                draft.take(Skipped(name, i, line, point) if isinstance(point, str) else point)
            self._move(draft, i, [line for line in lines if hasattr(line, "data")])
        return draft.finish()

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

    def _move(self, draft: Draft, i: int, lines: Sequence[Tree[Token]]) -> None:
        """Note the motions."""
        run = 0
        via = ""
        for line in lines:
            parts = {token.type: token for token in line.children if not hasattr(token, "data")}
            rest = str(parts.get("REST", parts.get("OTHER", "")))
            if line.data == "other":
                via = ""
                if rest.lstrip().startswith(("!", "//", "--")):
                    continue
                text = rest.partition("!")[0].upper()
                draft.read(_places_in(text))
                for name, kind in (("UTOOL[", "tool"), ("UFRAME[", "base")):
                    if text.startswith(name):
                        number = text[len(name) :].partition("]")[0].partition(":")[0].strip()
                        draft.frame(
                            number,
                            f"line {parts['OTHER'].line} sets it while the program runs",
                            [kind],  # type: ignore[list-item]
                        )
                run += text.startswith(_JUMPS)
                continue
            place = parts["PLACE"]
            kind = str(parts.get("KIND", ""))
            name = _place(str(place))
            at = place.line or 0
            if line.data == "more" and rest.lstrip().startswith("="):
                draft.write(name, f"line {at} sets it while the program runs")
                draft.read(_places_in(rest))
                continue
            words = [
                word.partition("[")[0]
                for word in rest.replace(",", " ").replace(";", " ").upper().split()
            ]
            moved = next((word for word in words if word in _MOVED), "")
            target: str | Skipped = name
            if name.startswith("PR["):
                target = Skipped(name, i, at, "a position register")
            elif "INC" in words:
                target = Skipped(name, i, at, f"a relative motion (INC), line {at}")
                draft.write(name, target.reason)
            elif moved:
                target = Skipped(name, i, at, f"moved by an offset ({moved})")
                draft.read([name])
            draft.read(set(_places_in(rest)) - {name})
            if kind == "C" and not words:
                via = name
                continue
            if line.data == "more" and not via:
                continue
            path = "circle" if via else {"J": "joint", "L": "line"}.get(kind, "joint")
            span = (place.start_pos or 0, place.end_pos or 0)
            stops = (via, target) if via else (target,)
            statement = Statement((), *span, at)
            draft.motions.append(Motion(path, stops, statement, i, span=span, run=run))  # type: ignore[arg-type]
            via = ""


def _place(text: str) -> str:
    """Return a position's name without its comment: ``P[1:"App"]`` is P[1]; ``P[R[1]]``, any
    position, is P[*].
    """
    kind, _, index = text.partition("[")
    first, _, more = index.removesuffix("]").partition(":")
    number = (more if first.strip().startswith("GP") else first).partition(",")[0].strip()
    return f"{kind}[{number if number.isdigit() else '*'}]"


def _places_in(text: str) -> Iterator[str]:
    """Yield the positions named in a text."""
    for k, piece in enumerate(text.split("P[")[1:], 1):
        if not text.split("P[")[k - 1][-1:].isalpha():
            yield _place("P[" + piece.split("]")[0] + "]")


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
