"""ABB's language: modules with targets, declared or within the motions, tools, and work objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pincal.programs.draft import Draft
from pincal.programs.flow import InForce, Step, followed
from pincal.programs.language import LANGUAGES, ControllerLanguage
from pincal.programs.program import Frame, Load, Motion, Point, Posture, Program, Skipped, Turn
from pincal.programs.rapid_blocks import (
    BY_NAME,
    DISPLACES,
    GRAMMAR,
    JOINTS_TOO,
    MOTION_OPTIONS,
    MOTIONS,
    OF_OPTIONS,
    ONCE,
    RAPID_FUNCTIONS,
    RAPID_WORDS,
    READING,
    SWITCHES,
    check_blocks,
    ends_displacement,
    statements_of,
)
from pincal.programs.statement_reader import EXTERNAL, Entries, Reader, formal_names
from pincal.programs.syntax import (
    Brackets,
    Number,
    Source,
    Statement,
    aggregate,
    calls_in,
    element_name,
    number_of,
    numbers_of,
    place_of,
    split,
    text_of_items,
    word,
    words_in,
)
from pincal.thresholds import Scale

_SEARCHES = ("SEARCHL", "SEARCHJ", "SEARCHC")
_STORAGE = ("CONST", "PERS", "VAR")
_TARGETS = ("ROBTARGET", "JOINTTARGET")
_DATA = (*_TARGETS, "TOOLDATA", "WOBJDATA")
# What a routine may do with a parameter: only that of an input is a copy.
_CHANGEABLE = ("INOUT", "PERS", "VAR", "REF")
# From here on a number stands for no external axis: it is written 9E9.
_NONE: Scale = 8.9e9


@LANGUAGES.register
class Rapid(ControllerLanguage):
    """ABB's language."""

    name = "RAPID"
    suffixes = (".mod", ".prg", ".sys", ".modx", ".sysx")
    reads_others = True
    convention = "abb"
    digits = (4, 9, 7)
    can_insert = True
    grammars = (GRAMMAR,)
    understood = RAPID_WORDS

    def read(self, sources: Sequence[Source]) -> Program:
        draft = Draft(sources)
        draft.frame("TOOL0", np.eye(4), ["tool"])
        draft.frame("WOBJ0", np.eye(4), ["base"])
        draft.constants.update(["TOOL0", "WOBJ0"])
        files = []
        for source in sources:
            parts = statements_of(source)
            files.append(
                (source, [statement for statement, _ in parts], [step for _, step in parts])
            )
        switched = set[str]().union(*(step.sets for _, _, steps in files for step in steps))
        flows = followed(files, outside=frozenset(switched) & set(DISPLACES))
        changing = set[str]()
        routines = set[str]()
        for (source, statements, steps), flow in zip(files, flows, strict=True):
            check_blocks(source, statements, steps, flow)
            changing |= set(_that_change_parameters(statements, steps, flow))
            routines |= {step.routine for step in steps if step.routine}
        entries = Entries(
            [
                (statements, steps, flow)
                for (_, statements, steps), flow in zip(files, flows, strict=True)
            ],
            ends_displacement,
            DISPLACES,
        )
        for i, (_, statements, steps) in enumerate(files):
            reader = _Reader(
                draft,
                i,
                statements,
                steps,
                flows[i],
                RAPID_FUNCTIONS | (routines - changing) | set(READING),
                entries,
                self,
                switched,
            )
            for k in range(len(statements)):
                reader.statement(k)
        return draft.finish()

    def statement(
        self, motion: Motion, source: Source, *, values: np.ndarray, posture: Posture
    ) -> str:
        """Return the motion with its target replaced by another, passed in zone z0."""
        start, end = motion.span
        position = ",".join(f"{value:.4f}" for value in values[:3])
        turn = ",".join(f"{value:.9f}" for value in values[3:])
        shape = 4 * (not posture.front) + 2 * (not posture.up) + (not posture.down)
        conf = ",".join([*(str(turn.value) for turn in posture.turns), str(shape)])
        target = f"[[{position}],[{turn}],[{conf}],[9E9,9E9,9E9,9E9,9E9,9E9]]"
        text = (
            source.text[motion.statement.start : start]
            + target
            + source.text[end : motion.statement.end]
        )
        return _in_zone(text) + ";"

    def tool(self, group: Brackets | None) -> np.ndarray | str:
        """Return the pose of a tool held by the robot, or why it is not known."""
        parts = group.parts if group is not None else []
        if len(parts) != 3 or text_of_items(parts[0]) != "TRUE":
            return "the robot does not hold it, or its values are computed"
        pose = self._frame(parts[1])
        return pose if pose is not None else "its values are computed"

    def work_object(self, group: Brackets | None) -> np.ndarray | str:
        """Return the pose of a stationary work object that the robot does not hold, or why it is
        not known.
        """
        parts = group.parts if group is not None else []
        if (
            len(parts) != 5
            or text_of_items(parts[0]) != "FALSE"
            or text_of_items(parts[1]) != "TRUE"
        ):
            return "the robot holds it, it moves, or its values are computed"
        user = self._frame(parts[3])
        own = self._frame(parts[4])
        return user @ own if user is not None and own is not None else "its values are computed"

    def _frame(self, part: Sequence[Any]) -> np.ndarray | None:
        """Return the pose of an aggregate of position and quaternion."""
        group = aggregate(part, "[")
        lists = _lists(group) if group is not None else None
        if lists is None or [len(each) for each in lists] != [3, 4]:
            return None
        values = np.array([number.value for each in lists for number in each])
        return self.pose(values) if self.is_pose(values) else None


@dataclass(frozen=True)
class _Reader(Reader):
    """Reads one file; ``switched`` are the values of ``SWITCHES`` that any of the files sets."""

    language: Rapid
    switched: set[str]

    def literal(self, line: int, name: str, items: Sequence[Any]) -> Point | Skipped | None:
        """Return the target of an aggregate."""
        group = aggregate(items, "[")
        if group is None:
            return None
        lists = _lists(group)
        sizes = [len(each) for each in lists] if lists is not None else []
        if lists is None or sizes not in ([3, 4, 4, 6], [6, 6]):
            return self.skip(name, line, "not all of its values are numbers")
        if sizes == [6, 6] and not _at_rest(lists[1]):
            return self.skip(name, line, EXTERNAL)
        if sizes == [6, 6]:
            return Point(name, self.file, line, "joints", lists[0])
        if not _at_rest(lists[3]):
            return self.skip(name, line, EXTERNAL)
        posture = _posture(lists[2])
        if posture is None:
            return self.skip(name, line, "its configuration is invalid")
        return Point(name, self.file, line, "pose", (*lists[0], *lists[1]), posture)

    def statement(self, k: int) -> None:
        """Note what a statement declares, moves or changes."""
        statement = self.statements[k]
        step = self.steps[k]
        items = statement.items
        line = statement.line
        first = word(statement.items[0])
        if step.opens or step.closes or step.is_jump:
            if not step.routine:
                self.pass_arguments(line, items)
                self.draft.read(self.words(items))
            return
        if first in MOTIONS:
            self._move(k)
            return
        self.pass_arguments(line, items)
        storage = [j for j, item in enumerate(items[:2]) if word(item) in _STORAGE]
        sides = split(items, ":=")
        name, is_part = element_name(sides[0])
        if storage:
            self._declare(
                line, items[storage[0] + 1 :], is_constant=word(items[storage[0]]) == "CONST"
            )
        elif len(sides) == 2:
            self.assign(line, name, is_part, sides[1])
        elif first in _SEARCHES:
            self.draft.skipped.append(
                self.skip(f"search of line {line}", line, "it ends when a signal arrives")
            )
            stops = [part for part in (split(part, "\\")[0] for part in split(items[1:])) if part]
            self.draft.pass_to(first, [element_name(part)[0] for part in stops[1:2]], line)
            self.draft.read(self.words(items))
            self.draft.motions.append(Motion("joint", (), statement, self.file, run=-1))
        else:
            if first in BY_NAME:
                self.draft.write_any(f"line {line} sets data by their names ({first})")
            if first in SWITCHES:
                self.draft.derive("displacement", self.words(items[1:]))
            elif first not in self.harmless:
                self.draft.pass_to(first or "a routine", self.words(items[1:]), line)
            self.draft.read(self.words(items))

    def _declare(self, line: int, items: Sequence[Any], *, is_constant: bool) -> None:
        kind = word(items[0]) if items else ""
        sides = split(items[1:], ":=")
        name = element_name(sides[0])[0]
        value = sides[1] if len(sides) == 2 else ()
        group = aggregate(value, "[")
        if kind == "LOADDATA" and group is not None and len(group.parts) == 6:
            mass = number_of(group.parts[0])
            if mass is not None:
                self.draft.masses[name] = mass.value
        if kind not in _DATA or not name:
            self.draft.read(self.words(items))
            return
        if is_constant:
            self.draft.constants.add(name)
        if kind == "TOOLDATA":
            self.draft.frame(name, self.language.tool(group), ["tool"])
            return
        if kind == "WOBJDATA":
            self.draft.frame(name, self.language.work_object(group), ["base"])
            return
        stem, bracket, size = name.partition("[")
        if not bracket:
            self._value(line, name, kind, value)
        elif group is not None and size == f"{len(group.parts)}]":
            for index, part in enumerate(group.parts):
                self._value(line, f"{stem}[{index + 1}]", kind, part)
        else:
            self.draft.write(stem, "an array of targets whose values are incomplete")

    def _value(self, line: int, name: str, kind: str, value: Sequence[Any]) -> None:
        """Note the value with which a target is declared."""
        target = self.literal(line, name, value)
        if isinstance(target, Point) and (target.kind == "joints") != (kind == "JOINTTARGET"):
            target = self.skip(name, line, "it is another kind of target")
        if target is not None:
            self.draft.take(target)
        else:
            self.draft.write(
                name, "a computed value" if value else "it is set while the program runs"
            )

    def _move(self, k: int) -> None:
        """Note a motion: its targets, tool and work object."""
        statement = self.statements[k]
        known = self.flow[k]
        first = word(statement.items[0])
        path = MOTIONS[first]
        plain = []
        options = {}
        for part in split(statement.items[1:]):
            pieces = split(part, "\\")
            plain += [pieces[0]] if pieces[0] else []
            for piece in pieces[1:]:
                sides = split(piece, ":=")
                if sides[0]:
                    options[word(sides[0][0])] = sides[1] if len(sides) == 2 else ()
        count = 2 if path == "circle" else 1
        places = plain[:count]
        if len(places) < count:
            name = f"{first} of line {statement.line}"
            self.draft.skipped.append(self.skip(name, statement.line, "not understood"))
            return
        targets = tuple(self.target(k, part) for part in places)
        # After speed and zone; the last argument of motions of options.
        tools = plain[-1:] if first in OF_OPTIONS else plain[count + 2 : count + 3]
        tool = self.frame(k, tools[0] if tools else (), "its tool is computed")
        base = (
            self.frame(k, options["WOBJ"], "its work object is computed")
            if "WOBJ" in options
            else Frame("WOBJ0")
        )
        displaced = self._displaced(k, options)
        if displaced:
            base = Frame("displacement", reason=displaced)
        unknown = next((name for name in options if name not in MOTION_OPTIONS), "")
        if unknown:
            why = f"line {statement.line}: \\{unknown} is not understood and may displace it"
            targets = tuple(self.left(target, why) for target in targets)
        can_insert = first == "MOVEL" and self.steps[k - 1].opens != ONCE
        span = place_of(places[-1])
        takes_posture = self._takes_posture(known, "CONFJ" if path == "joint" else "CONFL")
        self.draft.motions.append(
            Motion(
                path,
                targets,
                statement,
                self.file,
                tool,
                base,
                span,
                known.run,
                can_insert,
                takes_posture,
                self._load_of(options, k),
                displaced if first == "MOVEABSJ" else "",
            )
        )

    def _displaced(self, k: int, options: Mapping[str, Sequence[Any]]) -> str:
        """Return why positions are displaced at a motion, "" if they are not."""
        if "CORR" in options:
            return "the motion is corrected by a sensor (Corr)"
        is_joint = word(self.statements[k].items[0]) == "MOVEABSJ"
        kinds = JOINTS_TOO if is_joint else DISPLACES
        return self.displaced(k, [name for name in kinds if name in self.switched])

    def _load_of(self, options: Mapping[str, Sequence[Any]], k: int) -> Load | None:
        """Return the load of a motion: its own (TLoad), or the one in force."""
        if "TLOAD" not in options:
            return self.load(k)
        name = text_of_items(options["TLOAD"])
        return Load(name, self.statements[k].line, self.draft.masses.get(name))

    def mass(self, statement: Statement) -> float | None:
        name = text_of_items(statement.items[1:])
        return 0.0 if name == "LOAD0" else self.draft.masses.get(name)

    def _takes_posture(self, known: InForce, switch: str) -> bool:
        """Return whether configurations are monitored: not where that is, or may be,
        switched off.
        """
        found = known.setters.get(switch)
        if isinstance(found, int):
            return "OFF" not in self.words(self.statements[found].items)
        return found is None and switch not in self.switched


def _that_change_parameters(
    statements: Sequence[Statement], steps: Sequence[Step], flow: Sequence[InForce]
) -> list[str]:
    """Return the names of routines that may change their arguments."""
    found = []
    for k, statement in enumerate(statements):
        step = steps[k]
        routine = flow[k].routine
        first = word(statement.items[0])
        if routine < 0 or step.routine:
            continue
        sides = split(statement.items, ":=")
        touched = set[str]()
        if len(sides) == 2 and first not in MOTIONS:
            touched.add(element_name(sides[0])[0])
        elif not (step.opens or step.closes or step.is_jump or first in MOTIONS):
            touched |= set(words_in(statement.items[1:]))
        for name, group in calls_in(statement.items):
            if name.upper() not in RAPID_FUNCTIONS:
                touched |= {element_name(part)[0] for part in group.parts}
        if touched & set(formal_names(statements[routine], _CHANGEABLE)):
            found.append(steps[routine].routine)
    return found


def _at_rest(external: Sequence[Number]) -> bool:
    """Return whether external axes are at 0 or not in use."""
    return all(number.value == 0.0 or number.value >= _NONE for number in external)


def _lists(group: Brackets) -> list[tuple[Number, ...]] | None:
    """Return the lists of numbers in an aggregate, None if it contains anything else."""
    inner = [aggregate(part, "[") for part in group.parts]
    lists = [numbers_of(each.parts) if each is not None else None for each in inner]
    return [each for each in lists if each is not None] if None not in lists else None


def _posture(conf: Sequence[Number]) -> Posture | None:
    """Return the posture of confdata: quarters of axes 1, 4 and 6, and the number of one of eight
    arm configurations.
    """
    if any(number.value != round(number.value) for number in conf) or not 0 <= conf[3].value <= 7:
        return None
    shape = int(conf[3].value)
    turns = tuple(
        Turn(joint, "quarter", int(conf[k].value), conf[k]) for k, joint in enumerate((0, 3, 5))
    )
    return Posture(not shape & 4, not shape & 2, not shape & 1, turns)


def _in_zone(text: str) -> str:
    """Return a motion that passes its target: ``fine`` and wider zones become z0."""
    depth = 0
    commas = []
    start = 0
    for k, letter in enumerate(text):
        depth += (letter in "([{") - (letter in ")]}")
        if letter == "," and not depth:
            commas.append(k)
    if len(commas) < 3:
        return text
    start = commas[1] + 1
    end = commas[2]
    return text[:start] + " z0" + text[end:]
