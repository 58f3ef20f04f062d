"""ABB's language: modules with targets, declared or within the motions, tools, and work objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pincal.programs.draft import Draft
from pincal.programs.flow import Code, Step, followed
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
    are_at_rest,
    check_blocks,
    code_of,
    ends_displacement,
    is_assignment,
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

_SEARCHES = ("SEARCHL", "SEARCHJ", "SEARCHC")
_STORAGE = ("CONST", "PERS", "VAR")
_TARGETS = ("ROBTARGET", "JOINTTARGET")
_DATA = (*_TARGETS, "TOOLDATA", "WOBJDATA")
# What a routine may do with a parameter: only that of an input is a copy.
_CHANGEABLE = ("INOUT", "PERS", "VAR", "REF")


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
        files = [code_of(source) for source in sources]
        switched = frozenset(name for code in files for step in code.steps for name in step.sets)
        # An error may leave a routine anywhere for the handler of another one.
        has_handlers = any(
            word(statement.items[0]) == "ERROR" for code in files for statement in code.statements
        )
        ends = None if has_handlers else ends_displacement
        files = followed(files, outside=switched & set(DISPLACES), ends=ends)
        for code in files:
            check_blocks(code)
        harmless = RAPID_FUNCTIONS | set(READING) | _that_keep_parameters(files)
        entries = Entries(files, ends_displacement, DISPLACES)
        for i, code in enumerate(files):
            reader = _ModuleReader(draft, i, code, harmless, entries, self, switched)
            for k in range(len(code.statements)):
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
class _ModuleReader(Reader):
    """Reads one file; ``switched`` are the values of ``SWITCHES`` that any of the files sets."""

    language: Rapid
    switched: frozenset[str]

    def literal(self, line: int, name: str, items: Sequence[Any]) -> Point | Skipped | None:
        """Return the target of an aggregate."""
        group = aggregate(items, "[")
        if group is None:
            return None
        lists = _lists(group)
        sizes = [len(each) for each in lists] if lists is not None else []
        if lists is None or sizes not in ([3, 4, 4, 6], [6, 6]):
            return self.skip(name, line, "not all of its values are numbers")
        if sizes == [6, 6] and not are_at_rest(lists[1]):
            return self.skip(name, line, EXTERNAL)
        if sizes == [6, 6]:
            return Point(name, self.file, line, "joints", lists[0])
        if not are_at_rest(lists[3]):
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
        first = word(items[0])
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
        if storage:
            is_constant = word(items[storage[0]]) == "CONST"
            self._declare(line, items[storage[0] + 1 :], is_constant=is_constant)
        elif len(sides) == 2 and is_assignment(items):
            self.assign(line, *element_name(sides[0]), sides[1])
        elif first in _SEARCHES:
            self._search(statement)
        else:
            self._instruct(statement)

    def _search(self, statement: Statement) -> None:
        """Note a search, which sets the position at which it stops."""
        line = statement.line
        reason = "it ends when a signal arrives"
        self.draft.skipped.append(self.skip(f"search of line {line}", line, reason))
        plain = [split(part, "\\")[0] for part in split(statement.items[1:])]
        stops = [part for part in plain if part][1:2]
        first = word(statement.items[0])
        self.draft.pass_to(first, [element_name(part)[0] for part in stops], line)
        self.draft.read(self.words(statement.items))
        self.draft.motions.append(Motion("joint", (), statement, self.file, run=-1))

    def _instruct(self, statement: Statement) -> None:
        """Note what another instruction, or a routine of this name, may change."""
        line = statement.line
        first = word(statement.items[0])
        if first in BY_NAME:
            self.draft.write_any(f"line {line} sets data by their names ({first})")
        if first in SWITCHES and first != "MOVEEXTJ":
            self.draft.derive("displacement", self.words(statement.items[1:]))
        elif first not in self.harmless and first not in SWITCHES:
            self.draft.pass_to(first or "a routine", self.words(statement.items[1:]), line)
        self.draft.read(self.words(statement.items))

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
        first = word(statement.items[0])
        path = MOTIONS[first]
        given = _arguments(statement.items[1:])
        count = 2 if path == "circle" else 1
        places = given.plain[:count]
        if len(places) < count:
            self.not_understood(first, statement.line)
            return
        displaced = self._displaced(k, given.options)
        targets = tuple(self.target(k, part) for part in places)
        # After speed and zone; the last argument of motions of options.
        tools = given.plain[-1:] if first in OF_OPTIONS else given.plain[count + 2 : count + 3]
        tool = self.frame(k, tools[0] if tools else (), "its tool is computed")
        self.draft.motions.append(
            Motion(
                path,
                self._understood(targets, given.options, statement.line),
                statement,
                self.file,
                tool,
                self._base(k, given.options, displaced),
                place_of(places[-1]),
                self.flow[k].run,
                can_insert=first == "MOVEL" and self.steps[k - 1].opens != ONCE,
                takes_posture=self._takes_posture(k, "CONFJ" if path == "joint" else "CONFL"),
                load=self._load_of(given.options, k),
                displaced=displaced if first == "MOVEABSJ" else "",
            )
        )

    def _base(self, k: int, options: Mapping[str, Sequence[Any]], displaced: str) -> Frame:
        """Return the work object of a motion, or why it is displaced."""
        if displaced:
            return Frame("displacement", reason=displaced)
        if "WOBJ" not in options:
            return Frame("WOBJ0")
        return self.frame(k, options["WOBJ"], "its work object is computed")

    def _understood(
        self,
        targets: tuple[str | Point | Skipped, ...],
        options: Mapping[str, Sequence[Any]],
        line: int,
    ) -> tuple[str | Point | Skipped, ...]:
        """Return targets, left if an option of their motion may displace them."""
        unknown = next((name for name in options if name not in MOTION_OPTIONS), "")
        if not unknown:
            return targets
        why = f"line {line}: \\{unknown} is not understood and may displace it"
        return tuple(self.left(target, why) for target in targets)

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

    def _takes_posture(self, k: int, switch: str) -> bool:
        """Return whether configurations are monitored: not where that is, or may be,
        switched off.
        """
        found = self.flow[k].setters.get(switch)
        if isinstance(found, int):
            return "OFF" not in self.words(self.statements[found].items)
        return found is None and switch not in self.switched


@dataclass(frozen=True)
class _MoveArguments:
    """The arguments of a motion.

    Attributes:
        plain: those without names, in their order.
        options: the optional ones by their names; empty for switches.
    """

    plain: Sequence[Sequence[Any]]
    options: Mapping[str, Sequence[Any]]


def _arguments(items: Sequence[Any]) -> _MoveArguments:
    r"""Return the arguments that items spell: ``p1,v100\V:=50,z10,tool``."""
    plain = []
    options = dict[str, Sequence[Any]]()
    for part in split(items):
        pieces = split(part, "\\")
        plain += [pieces[0]] if pieces[0] else []
        for piece in pieces[1:]:
            sides = split(piece, ":=")
            if sides[0]:
                options[word(sides[0][0])] = sides[1] if len(sides) == 2 else ()
    return _MoveArguments(plain, options)


def _that_keep_parameters(files: Sequence[Code]) -> set[str]:
    """Return the names of routines that change none of their arguments."""
    found = {step.routine for code in files for step in code.steps if step.routine}
    for code in files:
        changeable = {
            k: set(formal_names(code.statements[k], _CHANGEABLE))
            for k, step in enumerate(code.steps)
            if step.routine
        }
        for k, statement in enumerate(code.statements):
            names = changeable.get(code.flow[k].routine, set())
            if names and not code.steps[k].routine and _touched(statement, code.steps[k]) & names:
                found -= {code.routine(k)}
    return found


def _touched(statement: Statement, step: Step) -> set[str]:
    """Return the names that a statement may change."""
    first = word(statement.items[0])
    found = set[str]()
    sides = split(statement.items, ":=")
    if len(sides) == 2 and first not in MOTIONS and is_assignment(statement.items):
        found.add(element_name(sides[0])[0])
    elif not (step.opens or step.closes or step.is_jump or first in MOTIONS):
        found |= set(words_in(statement.items[1:]))
    for name, group in calls_in(statement.items):
        if name.upper() not in RAPID_FUNCTIONS:
            found |= {element_name(part)[0] for part in group.parts}
    return found


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
