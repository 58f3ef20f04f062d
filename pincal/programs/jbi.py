"""Yaskawa's jobs: positions in the head, Cartesian or in pulses, and motions after ``//INST``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.programs.draft import Draft, joined
from pincal.programs.jbi_lines import JOB_WORDS, SHIFT, effect_in_job, named_in, why_not_reached
from pincal.programs.language import LANGUAGES, ControllerLanguage
from pincal.programs.line_flow import Line, Listing, reasons_before, with_outside
from pincal.programs.program import (
    Frame,
    Motion,
    Path,
    Point,
    Posture,
    Program,
    Skipped,
    Turn,
    counted_axes,
)
from pincal.programs.syntax import Number, Source, Statement, number_at

_GRAMMAR = r"""
start: (COMMENT? _NL)* JOB _NL (_head? _NL)* INST _NL (_line? _NL)* (_line? _EOT)
_head: tag | configuration | position | COMMENT
tag: TAG REST?
configuration: RCONF SIGNED ("," SIGNED)*
position: PLACE "=" SIGNED ("," SIGNED)*
_line: motion | other | COMMENT
motion: MOVE PLACE REST?
other: OTHER
JOB.5: /\/JOB(?![^\s])/
INST.5: /\/\/INST(?![^\s])/
RCONF.4: /\/\/\/RCONF/
TAG.3: /\/{2,3}[A-Z][A-Z0-9]*/
MOVE.3: /(MOV[JLCS]|IMOV)(?![A-Z0-9])/
PLACE.3: /(BC|EC|BP|EX|C|P)\d+|P\[[^\]\r\n]*\]/
SIGNED: /[+-]?(\d+(\.\d*)?|\.\d+)/
REST: /[^\s\x04'][^\r\n\x04]*/
OTHER: /[^\s\x04'][^\r\n\x04]*/
COMMENT.4: /'[^\r\n]*/
_NL: /\r\n|\r|\n/
_EOT: "\x04"
%ignore /[ \t\f\xa0]+/
"""
_WORDS = "a job: /JOB, //POS with positions, //INST with motions, END"
_PATHS: dict[str, Path] = {"MOVL": "line", "MOVJ": "joint", "MOVS": "joint", "MOVC": "joint"}
_ANY_POSTURE = Posture()


_JUMPS = (
    "*",
    "JUMP",
    "CALL",
    "IF",
    "ELSE",
    "ENDIF",
    "FOR",
    "NEXT",
    "WHILE",
    "ENDWHILE",
    "RET",
    "PSTART",
)


@LANGUAGES.register
@dataclass(frozen=True)
class Jbi(ControllerLanguage):
    """Yaskawa's jobs.

    Attributes:
        pulses: pulses per degree of each axis; None if they are not known.
    """

    pulses: tuple[float, ...] | None = None
    name = "JBI"
    suffixes = (".jbi",)
    grammars = (_GRAMMAR,)
    digits = (4, 6, 0)
    understood = JOB_WORDS

    def with_pulses(self, text: str) -> Jbi:
        try:
            found = tuple(float(word) for word in text.replace(",", " ").split())
        except ValueError:
            found = ()
        if not found or not all(math.isfinite(number) and number != 0.0 for number in found):
            raise BadInputError(
                f"pulses {text!r}; expected pulses per degree, one number per axis, none of them 0"
            )
        return Jbi(found)

    def joint_units(self, turns: np.ndarray) -> np.ndarray:
        return np.deg2rad(1.0 / np.array(self.pulses or (1.0,) * len(turns)))

    def refusal(self, point: Point) -> str:
        if point.kind == "joints" and self.pulses is None:
            return "it is in pulses: give the pulses per degree (--pulses)"
        if point.kind == "joints" and len(self.pulses or ()) != len(point.numbers):
            return f"{counted_axes(len(point.numbers))}, but --pulses has {len(self.pulses or ())}"
        return ""

    def read(self, sources: Sequence[Source]) -> Program:
        drafts = []
        trees = []
        for i, source in enumerate(sources):
            draft = Draft(sources, by_itself=True)
            tree = source.parse(_GRAMMAR, _WORDS)
            parts = [part for part in tree.children if hasattr(part, "data")]
            others = [str(part.children[0]).split() for part in parts if part.data == "other"]
            if not others or others[-1][:1] != ["END"]:
                raise source.error(
                    "the end of the file without END: is it truncated?", len(source.content)
                )
            self._positions(draft, i, source, parts)
            drafts.append(draft)
            trees.append(parts)
        jobs = [_listing(parts) for parts in trees]
        displaced = reasons_before(with_outside(jobs, [SHIFT]), lasting=[SHIFT])
        for i, (draft, parts) in enumerate(zip(drafts, trees, strict=True)):
            self._motions(draft, i, parts, displaced[i])
            for other in trees:
                _note_changes(draft, other, only_variables=other is not parts)
            draft.leave_unused(jobs[i].lines)
        return joined([draft.finish() for draft in drafts])

    def _positions(self, draft: Draft, i: int, source: Source, parts: Sequence[Any]) -> None:
        """Note the positions, each with the tags before it."""
        head = _Head()
        seen = 0
        for part in parts:
            head.take(part)
            if part.data == "position":
                seen += 1
                _note_position(draft, i, part, head)
        counts = [text.strip() for text in head.tags.get("NPOS", str(seen)).split(",")]
        expected = sum(int(text) for text in counts if text.isdigit())
        if seen != expected:
            raise source.error(
                f"{seen} position{'' if seen == 1 else 's'}; expected the {expected} of ///NPOS", 0
            )

    def _motions(
        self,
        draft: Draft,
        i: int,
        parts: Sequence[Any],
        displaced: Sequence[Mapping[str, str]],
    ) -> None:
        """Note the motions."""
        run = 0
        # The targets of MOVC one after the other: the first is reached on a line, the third on a
        # circle through the second.
        arc = 0
        via = ""
        for part, reasons in zip(_instructions(parts), displaced, strict=True):
            if part.data != "motion":
                run += str(part.children[0]).upper().startswith(_JUMPS)
                continue
            kind = str(part.children[0])
            name = _name(str(part.children[1]))
            target = _target(draft, i, part, reasons)
            arc = arc + 1 if kind == "MOVC" else 0
            if arc == 2:
                via = name
                continue
            path = _PATHS.get(kind, "joint")
            targets: tuple[str | Skipped, ...] = (target,)
            if arc == 1:
                path = "line"
            elif arc == 3:
                path = "circle"
                targets = (via, target)
            place = part.children[1]
            span = place.start_pos, place.end_pos
            draft.motions.append(
                Motion(path, targets, Statement((), *span, place.line), i, span=span, run=run)
            )


def _target(draft: Draft, i: int, part: Any, reasons: Mapping[str, str]) -> str | Skipped:
    """Return the target of a motion, and note why its position has to be left."""
    kind = str(part.children[0])
    line = part.children[1].line
    name = _name(str(part.children[1]))
    if kind == "IMOV":
        draft.write(name, f"line {line} moves by it (IMOV)")
        return Skipped(name, i, line, "a relative motion")
    if "[" in name:
        return Skipped(name, i, line, "a computed position")
    why = _why_left(draft, name, part, reasons)
    if why:
        draft.write(name, why)
    return name


@dataclass
class _Head:
    """What the lines before a position say of it.

    Attributes:
        tags: by their names.
        posture: the arm configuration.
    """

    tags: dict[str, str] = field(default_factory=lambda: {"TOOL": "", "USER": "", "POSTYPE": ""})
    posture: Posture = _ANY_POSTURE

    def take(self, part: Any) -> None:
        """Take a tag or a configuration."""
        if part.data == "tag":
            name, *rest = (str(child) for child in part.children)
            self.tags[name.lstrip("/")] = rest[0].strip() if rest else ""
        elif part.data == "configuration":
            self.posture = _posture([number_at(token) for token in part.children[1:]])

    def point(self, i: int, place: Any, numbers: tuple[Number, ...]) -> Point | str:
        """Return the point of a position, or why it can't be used."""
        name = _name(str(place))
        kind = self.tags["POSTYPE"]
        if kind == "PULSE":
            return Point(name, i, place.line, "joints", numbers)
        if kind not in ("BASE", "ROBOT", "USER") or len(numbers) not in (6, 7):
            return f"positions of the type {kind} are not supported"
        if len(numbers) == 7 and numbers[6].value:
            return "its elbow angle is not 0"
        user = Frame(self.tags["USER"] or "USER")
        base = user if kind == "USER" else Frame(kind, np.eye(4))
        tool = Frame(self.tags["TOOL"] or "TOOL")
        return Point(name, i, place.line, "pose", numbers[:6], self.posture, tool, base)


def _note_position(draft: Draft, i: int, part: Any, head: _Head) -> None:
    """Note a position; of one of an external axis only whether that is at 0."""
    place, *values = part.children
    name = _name(str(place))
    found = [number_at(token) for token in values]
    numbers = tuple(number for number in found if number is not None)
    if name.startswith(("BC", "EC", "BP", "EX")):
        draft.at_rest[name] = all(number.value == 0.0 for number in numbers)
        return
    point = head.point(i, place, numbers)
    draft.take(Skipped(name, i, place.line, point) if isinstance(point, str) else point)


def _instructions(parts: Sequence[Any]) -> list[Any]:
    """Return the motions and other instructions of a job."""
    return [part for part in parts if part.data in ("motion", "other")]


def _listing(parts: Sequence[Any]) -> Listing:
    """Return a job as what its instructions do to those behind them."""
    names = [
        str(part.children[1]).strip().upper()
        for part in parts
        if part.data == "tag" and str(part.children[0]) == "//NAME" and len(part.children) > 1
    ]
    lines = [
        effect_in_job(str(part.children[0]), part.children[0].line)
        if part.data == "other"
        else Line(part.children[0].line)
        for part in _instructions(parts)
    ]
    return Listing(names[0] if names else "", lines)


def _why_left(draft: Draft, name: str, part: Any, reasons: Mapping[str, str]) -> str:
    """Return why a motion may not go to its position, "" if it does."""
    options = str(part.children[2]) if len(part.children) > 2 else ""
    line = part.children[0].line
    for axis in named_in(options.partition("+")[0]):
        if axis.startswith("B"):
            rest = draft.at_rest.get(_name(axis), False)
            if not rest:
                return f"its base axis is not at 0 ({axis}, line {line})"
    return why_not_reached(options, line) or draft.why_displaced(name, reasons)


def _note_changes(draft: Draft, parts: Sequence[Any], *, only_variables: bool) -> None:
    """Note the positions that instructions may change, of another job position variables only."""
    for part in _instructions(parts):
        token = part.children[-1]
        text = str(token)
        if part.data == "motion":
            # Behind the sign are the positions of another robot.
            names = named_in(text.partition("+")[2]) if len(part.children) > 2 else []
        else:
            names = named_in(text)
        for name in names:
            is_variable = name.startswith("P")
            is_read = part.data == "other" and text.upper().startswith("REFP")
            if (is_variable or not only_variables) and not is_read:
                draft.write(_name(name), f"line {token.line} may set it")


def _name(text: str) -> str:
    """Return the name of a position with five digits, as in the heads of jobs: P001 is P00001."""
    number = text.lstrip("BCEPX")
    return f"{text.removesuffix(number)}{number.rjust(5, '0')}" if number.isdigit() else text


def _posture(values: Sequence[Number | None]) -> Posture:
    """Return the posture of a configuration: not flipped, lower arm, rear, and axes R, T and S
    beyond 180 deg.
    """
    numbers = [number for number in values if number is not None]
    if len(numbers) < 6 or any(number.value not in (0.0, 1.0) for number in numbers[:6]):
        return Posture()
    flags = [bool(number.value) for number in numbers]
    turns = tuple(Turn(j, "half", int(flags[k]), numbers[k]) for k, j in ((3, 3), (4, 5), (5, 0)))
    return Posture(front=not flags[2], up=not flags[1], down=flags[0], turns=turns)
