"""KUKA's language: a ``.src`` of motions and the ``.dat`` with its points, either alone or both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pincal.programs.draft import Draft
from pincal.programs.flow import OUTSIDE, Code, Step, followed
from pincal.programs.language import LANGUAGES, ControllerLanguage
from pincal.programs.line_flow import POSITIONS, STATED_LOAD
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
from pincal.programs.statement_reader import EXTERNAL, Entries, Reader
from pincal.programs.syntax import (
    Brackets,
    Number,
    Source,
    Statement,
    aggregate,
    call_of,
    calls_in,
    element_name,
    is_token,
    nested,
    number_of,
    place_of,
    split,
    text_of_items,
    word,
)
from pincal.programs.understood import Understood, understood_words

_TOKENS = r"""
TEXT: /"[^"\r\n]*"/
BITS.2: /'[BbHh][0-9A-Fa-f]+'/
SIGN: /[=<>]=|[^\x04\s\w()\[\]{}"';&$#]|'/
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
_MOTIONS: dict[str, Path] = {
    "PTP": "joint",
    "LIN": "line",
    "CIRC": "circle",
    "SPTP": "joint",
    "SLIN": "line",
    "SCIRC": "circle",
    "SPL": "joint",
}
# Motions that obey S and T.
_BY_POSTURE = ("PTP", "SPTP")
_RELATIVE = {f"{name}_REL" for name in _MOTIONS}
_AFTER = {"C_DIS", "C_VEL", "C_ORI", "C_PTP", "C_SPL", "WITH"}
_POSE = ("X", "Y", "Z", "A", "B", "C")
_JOINTS = ("A1", "A2", "A3", "A4", "A5", "A6")
_EXTERNAL = ("E1", "E2", "E3", "E4", "E5", "E6")
_NULL = ("$NULLFRAME", "$WORLD", "TOOL_DATA[0]", "BASE_DATA[0]")
_FRAMES = frozenset({"$TOOL", "$BASE"})
# What BAS sets, by its first argument: both frames from FDAT_ACT, or none; by any other than #TOOL
# and #BASE perhaps both.
_BY_DATA = ("#PTP_PARAMS", "#CP_PARAMS", "#FRAMES", "#PTP_DAT", "#CP_DAT")
_SPEEDS = ("#VEL_PTP", "#VEL_CP", "#ACC_PTP", "#ACC_CP", "#OUT_SYNC")
_MANUAL = "KUKA System Software 8, operating and programming instructions for system integrators"
_KRL_WORDS = (
    Understood(
        "instruction",
        f"{_MANUAL}, chapter 11: program flow, declarations, interrupts, outputs",
        "IF, ELSE, ENDIF, SWITCH, CASE, DEFAULT, ENDSWITCH, LOOP, ENDLOOP, FOR, ENDFOR, WHILE, "
        "ENDWHILE, REPEAT, UNTIL, EXIT, GOTO, HALT, WAIT, RETURN, RESUME, CONTINUE, BRAKE, "
        "DECL, SIGNAL, ENUM, STRUC, EXT, EXTFCT, IMPORT, GLOBAL, CONST, INT, REAL, BOOL, CHAR, "
        "POS, E3POS, E6POS, AXIS, E3AXIS, E6AXIS, FRAME, INTERRUPT, TRIGGER, PULSE, ANOUT, "
        "ANIN, DIGIN, INI, DEF, DEFFCT, DEFDAT, END, ENDFCT, ENDDAT, SPLINE, PTP_SPLINE, "
        "ENDSPLINE, TIME_BLOCK, "
        "CONST_VEL, STOP, CONFIRM, CCLOSE",
    ),
    Understood(
        "function",
        f"{_MANUAL}, chapters 11 and 12: words before brackets, conditions, messages, data; "
        "frames that BAS sets are read from its arguments",
        "IF, WHILE, UNTIL, FOR, WHEN, SWITCH, CASE, AND, OR, NOT, EXOR, B_AND, B_OR, B_NOT, "
        "B_EXOR, RETURN, WAIT, SEC, TO, STEP, DO, DEF, DEFFCT, EXT, EXTFCT, BAS, STOOL, STOOL2, "
        "SBASE, SIPO_MODE, SVEL_JOINT, SVEL_CP, SACC_JOINT, SACC_CP, SAPO, SAPO_PTP, SGEAR_JERK, "
        "SJERK, SORI_TYP, SLOAD, PATH, ABS, SQRT, SIN, COS, TAN, ACOS, ATAN2, "
        "INVERSE, FORWARD, INV_POS, VARSTATE, PULSE, SIGN, ROUND, STRLEN, STRDECLLEN, STRFIND, "
        "STRCOMP, MSGNOTIFY, MSGSTATE, MSGQUIT, MSGACKNOWLEDGE, MSGDIALOG, MSGLOOP, SET_KRLMSG, "
        "EXISTS_KRLMSG, CLEAR_KRLMSG, SET_KRLDLG, EXISTS_KRLDLG, IR_STOPM",
    ),
    Understood(
        "function",
        "KUKA System Software 8.3 and later: collision detection, as their inline forms call it",
        "USE_CM_PRO_VALUES, SET_CD_PARAMS",
    ),
    Understood(
        "filler",
        "KUKA, CREAD/CWRITE for KSS 8: texts and channels, which write to their arguments",
        "CAST_TO, CAST_FROM, SREAD, SWRITE, CREAD, CWRITE, COPEN, CCLOSE, "
        "CIOCTL, STRCLEAR, STRADD, STRCOPY",
    ),
    Understood(
        "variable",
        "KUKA System Software 8, system variables: speeds, approximation, times, signals, start; "
        "$TOOL, $BASE, $ORI_TYPE and $LOAD are read",
        "$TOOL, $BASE, $ORI_TYPE, $LOAD, $IPO_MODE, $ADVANCE, $VEL, $ACC, "
        "$APO, $VEL_AXIS, $ACC_AXIS, $VEL_EXTAX, $ACC_EXTAX, $OV_PRO, $OV_ROB, $OV_APPL, $OUT, "
        "$OUT_C, $COLLMON_TOL_PRO, $ANOUT, $DIGOUT, $TIMER, $TIMER_STOP, $TIMER_FLAG, $FLAG, "
        "$CYCFLAG, $BWDSTART, $H_POS, "
        "$CIRC_TYPE, $GEAR_JERK, $JERK, $RED_VEL, $FILTER, $ERR, $LOOP_MSG, $LOOP_CONT, $MSG_T, "
        "$CP_VEL_TYPE, $SPL_VEL_MODE, $SPL_VEL_RESTR, $DECEL_MB, $ACC_MA, $ACC_CAR_LIMIT, "
        "$ACC_CAR_STOP, $PRO_IP, $TORQUE_DIFF, "
        "$SEN_PREA, $SEN_PINT, $TECHPAR, $LOAD_A1, "
        "$LOAD_A2, $LOAD_A3",
    ),
)
_INSTRUCTIONS = understood_words(_KRL_WORDS, "instruction")
_HARMLESS = understood_words(_KRL_WORDS, "function")
_FILLERS = understood_words(_KRL_WORDS, "filler")
_VARIABLES = understood_words(_KRL_WORDS, "variable")
# Values of $ORI_TYPE with which lines and circles end in the orientation of their targets.
_TURNING = ("#VAR", "#JOINT")
# What displaces poses: another orientation, on lines and circles; and the place of the robot.
_ORIENTATION = "$ORI_TYPE"
_ROBOT = "$ROBROOT"
_PLACES = ("$ROBROOT", "$ERSYSROOT", "$WORLD", "$ERSYS")
_SETTABLE = ("$TOOL", "$BASE", "FDAT_ACT", "$ORI_TYPE", "LDAT_ACT", "$LOAD")


@LANGUAGES.register
class Krl(ControllerLanguage):
    """KUKA's language."""

    name = "KRL"
    suffixes = (".src", ".dat")
    is_pair = True
    reads_others = True
    convention = "kuka"
    can_insert = True
    grammars = (nested(_TOKENS),)
    understood = _KRL_WORDS

    def read(self, sources: Sequence[Source]) -> Program:
        draft = Draft(sources)
        files = []
        for source in sources:
            statements = source.statements(_TOKENS, _WORDS)
            files.append(Code(source, statements, [_step(statement) for statement in statements]))
        files = followed(files, outside=_FRAMES)
        for code in files:
            _check_outside(code)
        harmless = _HARMLESS | {
            step.routine
            for code in files
            for statement, step in zip(code.statements, code.steps, strict=True)
            if _takes_values(statement, step)
        }
        data = _Data()
        entries = Entries(files, lambda statement: data.turns(statement))
        readers = [
            _SourceReader(draft, i, code, harmless, entries, self, data)
            for i, code in enumerate(files)
        ]
        for reader in readers:
            for k in range(len(reader.statements)):
                reader.declare(k)
        for reader in readers:
            for k in range(len(reader.statements)):
                reader.move(k)
        return draft.finish()

    def statement(
        self, motion: Motion, source: Source, *, values: np.ndarray, posture: Posture
    ) -> str:
        """Return the motion with its target replaced by a pose, passed without a stop."""
        start, end = motion.span
        # Angles near those of the end point may exceed half a turn, which no teach pendant
        # displays.
        numbers = [*values[:3], *(angle - 360.0 * round(angle / 360.0) for angle in values[3:])]
        pose = ",".join(
            f"{name} {value:.{4 if name in 'XYZ' else 6}f}"
            for name, value in zip(_POSE, numbers, strict=True)
        )
        after = source.text[end : motion.statement.end]
        approximate = (
            "" if any(word in after.upper() for word in _AFTER) or after.strip() else " C_DIS"
        )
        return source.text[motion.statement.start : start] + "{" + pose + "}" + after + approximate

    def bits(self, number: Number, value: int) -> str:
        """Return bits in the spelling of others: decimal, 'B...' or 'H...'."""
        if not number.text.startswith("'"):
            return str(value)
        text = f"{value:b}" if number.text[1] in "Bb" else f"{value:X}"
        return f"'{number.text[1]}{text.rjust(len(number.text) - 3, '0')}'"


@dataclass
class _Data:
    """What the data of motions are.

    Attributes:
        frames: tools and bases by the names of frame data (FDAT), None if unknown.
        is_fixed: whether the tool is fixed in the cell.
        constant: names of data (LDAT) whose motions do not turn the tool.
    """

    frames: dict[str, tuple[str, str] | None] = field(default_factory=dict)
    is_fixed: bool = False
    constant: set[str] = field(default_factory=set)

    def tool_is_fixed(self) -> None:
        """Note that the tool is fixed in the cell, or may be."""
        self.is_fixed = True

    def turns(self, statement: Statement) -> bool:
        """Return whether lines behind a statement that sets $ORI_TYPE end in the orientation of
        their targets.
        """
        if _by_bas(statement.items):
            return True
        sides = split(statement.items, "=")
        if len(sides) != 2:
            return False
        if text_of_items(sides[0]) == "LDAT_ACT":
            return text_of_items(sides[1]) not in self.constant
        return self.is_turning(sides[1])

    def is_turning(self, value: Sequence[Any]) -> bool:
        """Return whether a value of $ORI_TYPE, or the data that it is from, turns the tool."""
        call = call_of(value)
        text = text_of_items(value if call is None else call[1].items)
        if text.startswith("#"):
            return text in _TURNING
        name, _, part = text.partition(".")
        is_data = call is not None or part == "ORI_TYP"
        return is_data and name not in self.constant


@dataclass(frozen=True)
class _SourceReader(Reader):
    """Reads one file; ``data`` are those of the motions of all files."""

    language: Krl
    data: _Data

    def declare(self, k: int) -> None:
        """Note what a statement sets."""
        statement = self.statements[k]
        items: Sequence[Any] = statement.items
        while items and word(items[0]) in ("GLOBAL", "DECL", "CONST"):
            items = items[1:]
        first = word(items[0]) if items else ""
        if not items or first in _MOTIONS or first in _RELATIVE or first in _ROUTINES:
            return
        if first == "IMPORT":
            reason = f"line {statement.line} shares it with another file"
            for name in sorted(self.words(items[1:])):
                self.draft.write(name, reason)
            return
        action = _action(items)
        if action:
            condition = items[: -len(action)]
            self.pass_arguments(statement.line, condition)
            self.draft.read(self.words(condition))
            items = action
        elif first in ("ANIN", "DIGIN"):
            items = items[2:]
        elif len(items) > 1 and first and word(items[1]):
            items = items[1:]
        self.pass_arguments(statement.line, items)
        for part in split(items):
            sides = split(part, "=")
            name, is_part = element_name(sides[0])
            if len(sides) != 2 or not name:
                self.draft.read(self.words(part))
            elif not self._note_data(name, sides[1]):
                self._set(statement.line, name, is_part, sides[1])

    def _note_data(self, name: str, value: Sequence[Any]) -> bool:
        """Note a value that is data of motions; return whether it is nothing else."""
        group = aggregate(value, "{")
        fields = (_fields(group) if group is not None else None) or {}
        turning = fields.get("ORI_TYP", ())
        if turning and text_of_items(turning) not in _TURNING:
            self.data.constant.add(name)
        # With data of motions the mode is that of their frame data.
        is_mode = name == "$IPO_MODE" and call_of(value) is None
        if is_mode and text_of_items(value) != "#BASE":
            self.data.tool_is_fixed()
        if "TOOL_NO" in fields and "BASE_NO" in fields:
            is_new = name not in self.data.frames
            self.data.frames[name] = _frame_data(fields) if is_new else None
            return True
        if name in self.data.frames:
            self.data.frames[name] = None
        mass = self._mass(value)
        if mass is not None and name.startswith("LOAD_DATA["):
            self.draft.masses[name] = mass
        return False

    def _set(self, line: int, name: str, is_part: bool, value: Sequence[Any]) -> None:
        """Note a value: poses may be tools and bases, and those of the controller are no points."""
        point = None if is_part or "*" in name else self.literal(line, name, value)
        is_frame = name.startswith(("TOOL_DATA[", "BASE_DATA[", "$"))
        if isinstance(point, Point) and point.kind == "pose" and not name.startswith("$"):
            is_pose = self.language.is_pose(point.values)
            pose = self.language.pose(point.values) if is_pose else "its numbers are no pose"
            self.draft.frame(name, pose, ["tool", "base"])
        if not is_frame or point is None:
            self.assign(line, name, is_part, value)
        elif isinstance(point, Skipped):
            self.draft.write(name, point.reason)

    def literal(self, line: int, name: str, items: Sequence[Any]) -> Point | Skipped | None:
        """Return the point of an aggregate; None if there is none."""
        group = aggregate(items, "{")
        fields = _fields(group) if group is not None else None
        keys = next(
            (keys for keys in (_POSE, _JOINTS) if fields is not None and set(keys) & set(fields)),
            None,
        )
        if fields is None or keys is None:
            return None
        numbers = [number_of(fields.get(key, ())) for key in keys]
        found = tuple(number for number in numbers if number is not None)
        if len(found) < len(keys):
            return self.skip(name, line, f"not all of {' '.join(keys)} are given as numbers")
        external = [number_of(fields[key]) for key in _EXTERNAL if key in fields]
        if any(number is None or number.value != 0.0 for number in external):
            return self.skip(name, line, EXTERNAL)
        if keys == _JOINTS:
            return Point(name, self.file, line, "joints", found)
        posture = _posture(fields)
        if posture is None:
            return self.skip(name, line, "S or T is not a number")
        return Point(name, self.file, line, "pose", found, posture)

    def move(self, k: int) -> None:
        """Note a motion."""
        items = self.statements[k].items
        first = word(items[0])
        if first in _RELATIVE:
            self._move_relatively(k)
            return
        if first not in _MOTIONS or len(items) < 2 or is_token(items[1], "SIGN", "="):
            return
        places = _places(items[1:])
        if not places.parts:
            return
        path = places.path(_MOTIONS[first])
        tool = self._frame("$TOOL", k)
        displaced = self.displaced(k, [POSITIONS])
        moved = displaced or self._why_moved(k, is_line=_MOTIONS[first] != "joint")
        self.draft.motions.append(
            Motion(
                path,
                tuple(self.target(k, part) for part in places.parts),
                self.statements[k],
                self.file,
                tool,
                Frame("$BASE", reason=moved) if moved else self._frame("$BASE", k),
                place_of(places.parts[-1]),
                self.flow[k].run,
                can_insert=path == "line" and not self._splines(k),
                takes_posture=first in _BY_POSTURE,
                load=self.load(k) or self._load_of_tool(k, tool),
                displaced=displaced,
            )
        )

    def _move_relatively(self, k: int) -> None:
        """Note a motion by a distance, whose end is not known."""
        statement = self.statements[k]
        self.draft.read(self.words(statement.items[1:]))
        name = text_of_items(statement.items)[:40]
        lost = self.skip(name, statement.line, "a relative motion")
        run = self.flow[k].run
        self.draft.motions.append(Motion("joint", (lost,), statement, self.file, run=run))

    def _splines(self, k: int) -> list[int]:
        """Return the statements that open the splines around a motion."""
        return [j for j in self.flow[k].blocks if self.steps[j].opens.endswith("SPLINE")]

    def _settings(self, k: int) -> list[tuple[Any, ...]]:
        """Return what a motion, or else the spline around it, sets for it behind WITH."""
        found = []
        for j in (k, *self._splines(k)):
            items = self.statements[j].items
            start = next(
                (i + 1 for i, item in enumerate(items) if word(item) == "WITH"), len(items)
            )
            found += split(items[start:])
        return found

    def _load_of_tool(self, k: int, tool: Frame) -> Load | None:
        """Return the load that is set with a tool, if the files contain it in numbers."""
        name = tool.name.replace("TOOL_", "LOAD_")
        line = self.statements[k].line
        return Load(name, line, self.draft.masses[name]) if name in self.draft.masses else None

    def mass(self, statement: Statement) -> float | None:
        sides = split(statement.items, "=")
        if len(sides) == 2:
            mass = self._mass(sides[1])
            return mass if mass is not None else self.draft.masses.get(text_of_items(sides[1]))
        return None

    def _mass(self, items: Sequence[Any]) -> float | None:
        """Return the mass of an aggregate of a load, None if it is none, or not in numbers."""
        group = aggregate(items, "{")
        fields = _fields(group) if group is not None else None
        number = number_of(fields["M"]) if fields is not None and "M" in fields else None
        return number.value if number is not None and number.value >= 0.0 else None

    def _why_moved(self, k: int, *, is_line: bool) -> str:
        """Return why a motion to a pose ends elsewhere, "" if it does not."""
        line = self.statements[k].line
        is_turning = False
        for part in self._settings(k):
            sides = split(part, "=")
            name, is_part = element_name(sides[0])
            name = name.partition("[")[0]
            if len(sides) == 2 and (name not in _VARIABLES or (is_part and name in _FRAMES)):
                return f"line {line} sets {name}"
            if len(sides) == 2 and name == _ORIENTATION:
                is_turning = self.data.is_turning(sides[1])
                if not is_turning:
                    return f"line {line} does not turn the tool ($ORI_TYPE)"
        kinds = [_ROBOT, _ORIENTATION] if is_line and not is_turning else [_ROBOT]
        return self.displaced(k, kinds)

    def _frame(self, variable: str, k: int) -> Frame:
        """Return $TOOL or $BASE before a statement."""
        if self.data.is_fixed:
            return Frame(variable, reason="the tool is fixed in the cell ($IPO_MODE=#TCP)")
        for part in self._settings(k):
            sides = split(part, "=")
            if len(sides) == 2 and text_of_items(sides[0]) == variable:
                return self._frame_of(variable, k, sides[1])
        found = self.flow[k].setters.get(variable)
        if found is None and self.starts_displaced(k, variable):
            found = "a routine that calls this one sets it"
        if isinstance(found, int):
            return self._frame_set_by(variable, found, k)
        hint = f" (--with its file, or --{variable[1:].lower()} '{variable}=X,Y,Z,...')"
        why = f"{variable}: {found}{hint if found is not None and OUTSIDE in found else ''}"
        return Frame(variable, reason=why if found is not None else "")

    def _frame_set_by(self, variable: str, found: int, k: int) -> Frame:
        """Return $TOOL or $BASE as another statement has set it."""
        setter = self.statements[found].items
        sides = split(setter, "=")
        if len(sides) == 2:
            return self._frame_of(variable, k, sides[1])
        call = call_of(setter)
        index = number_of(call[1].parts[1]) if call is not None and len(call[1].parts) > 1 else None
        what = _by_bas(setter)
        if what in ("#TOOL", "#BASE") and index is not None:
            return _frame_named(f"{what[1:]}_DATA[{index.text}]")
        if what not in _BY_DATA:
            return Frame(variable, reason=f"line {self.statements[found].line} may set {variable}")
        source = self.flow[found].setters.get("FDAT_ACT")
        if not isinstance(source, int):
            why = f"FDAT_ACT: {source if source is not None else 'it is set elsewhere'}"
            return Frame(variable, reason=why)
        value = split(self.statements[source].items, "=")[1]
        group = aggregate(value, "{")
        fields = _fields(group) if group is not None else None
        if fields is not None and "TOOL_NO" in fields and "BASE_NO" in fields:
            return _frame_of_pair(variable, _frame_data(fields))
        return _frame_of_data(variable, text_of_items(value), self.data)

    def _frame_of(self, variable: str, k: int, items: Sequence[Any]) -> Frame:
        """Return the frame of an expression."""
        found = self.literal(0, variable, items)
        if isinstance(found, Point) and not self.language.is_pose(found.values):
            return Frame(variable, reason=f"{variable}: its numbers are no pose")
        if isinstance(found, Point) and found.kind == "pose":
            return Frame(variable, self.language.pose(found.values))
        call = call_of(items)
        if call is not None and call[0].upper() in ("STOOL", "STOOL2", "SBASE"):
            name = text_of_items(call[1].items).partition(".")[0]
            return _frame_of_data(variable, name, self.data)
        frame = self.frame(k, items, f"{variable} is computed")
        return frame if frame.reason else _frame_named(frame.name)


@dataclass(frozen=True)
class _Places:
    """The places of a motion, each as its items; whether the angle of an arc is given as well."""

    parts: Sequence[Sequence[Any]]
    is_arc: bool

    def path(self, usual: Path) -> Path:
        """Return the path through the places: another than the usual one is not followed."""
        is_usual = not self.is_arc and len(self.parts) == 1 + (usual == "circle")
        return usual if is_usual else "joint"


def _places(items: Sequence[Any]) -> _Places:
    """Return the places that are named behind the word of a motion."""
    stop = next((j for j, item in enumerate(items) if word(item) in _AFTER), len(items))
    parts = [part for part in split(items[:stop]) if part]
    places = [part for part in parts if word(part[0]) != "CA"]
    return _Places(places, len(places) < len(parts))


def _check_outside(code: Code) -> None:
    """Refuse a file with a statement that is in no routine and no data list."""
    outside = [
        statement
        for statement, step, known in zip(code.statements, code.steps, code.flow, strict=True)
        if not known.depth and not step.opens
    ]
    if outside or not code.statements:
        raise code.source.error(
            "a statement outside DEF or DEFDAT; expected " + _WORDS,
            outside[0].start if outside else 0,
        )


def _takes_values(statement: Statement, step: Step) -> bool:
    """Return whether a statement opens a routine whose parameters are all :IN."""
    parts = [
        part
        for item in statement.items
        if isinstance(item, Brackets)
        for part in item.parts
        if part
    ]
    return bool(step.routine) and all(word(part[-1]) == "IN" for part in parts)


def _frame_named(name: str) -> Frame:
    return Frame(name, np.eye(4) if name in _NULL else None)


def _frame_of_data(variable: str, name: str, data: _Data) -> Frame:
    """Return the tool or the base of a point's frame data."""
    found = data.frames.get(name)
    if found is None:
        return Frame(
            variable, reason=f"the frame data {name} are not in these files, or not as numbers"
        )
    return _frame_of_pair(variable, found)


def _frame_of_pair(variable: str, pair: tuple[str, str] | None) -> Frame:
    """Return the tool or the base of a pair of these, by their names."""
    if pair is None:
        return Frame(variable, reason="the numbers of its tool and its base are not in numbers")
    return _frame_named(pair[0] if variable == "$TOOL" else pair[1])


def _frame_data(fields: Mapping[str, tuple[Any, ...]]) -> tuple[str, str] | None:
    """Return the names of tool and base in frame data; None if they are not known, or the tool is
    fixed in the cell.
    """
    tool = number_of(fields["TOOL_NO"])
    base = number_of(fields["BASE_NO"])
    if (
        tool is None
        or base is None
        or text_of_items(fields.get("IPO_FRAME", ())) not in ("", "#BASE")
    ):
        return None
    return f"TOOL_DATA[{tool.text}]", f"BASE_DATA[{base.text}]"


def _fields(group: Brackets) -> dict[str, tuple[Any, ...]] | None:
    """Return the values of an aggregate by their names; None if it is not one."""
    found = dict[str, tuple[Any, ...]]()
    for k, part in enumerate(group.parts):
        if k == 0 and len(part) > 2 and word(part[0]) and is_token(part[1], "SIGN", ":"):
            part = part[2:]
        if len(part) < 2 or not word(part[0]) or word(part[0]) in found:
            return None
        found[word(part[0])] = part[1:]
    return found


def _bits(items: tuple[Any, ...]) -> Number | None:
    """Return a number that may be written as bits."""
    if len(items) == 1 and is_token(items[0], "BITS"):
        text = str(items[0])
        digits = text[2:-1]
        if text[1] in "Bb" and digits.strip("01"):
            return None
        return Number(int(digits, 2 if text[1] in "Bb" else 16), *place_of(items), text)
    number = number_of(items)
    return number if number is not None and number.text.isdigit() else None


def _posture(fields: Mapping[str, tuple[Any, ...]]) -> Posture | None:
    """Return the posture of S and T: the bits of S are overhead, elbow up, axis 5 below 0; the bits
    of T axes below 0.
    """
    status, number = (_bits(fields[name]) if name in fields else None for name in ("S", "T"))
    if (status is None and "S" in fields) or (number is None and "T" in fields):
        return None
    turns: tuple[Turn, ...] = ()
    if number is not None:
        turns = tuple(Turn(j, "negative", int(number.value) >> j & 1, number, j) for j in range(6))
    if status is None:
        return Posture(turns=turns)
    bits = int(status.value)
    return Posture(not bits & 1, bool(bits & 2), not bits & 4, turns)


def _by_bas(items: Sequence[Any]) -> str:
    """Return the first argument of a call of BAS, "" for other items."""
    call = call_of(items)
    return (
        text_of_items(call[1].parts[0])
        if call is not None and call[0].upper() == "BAS" and call[1].parts
        else ""
    )


def _step(statement: Statement) -> Step:
    """Return the effect of a statement on the control flow and the frames."""
    items = statement.items
    first = word(items[0])
    opens = word(items[1]) if first == "GLOBAL" and len(items) > 1 else first
    if opens in _ROUTINES:
        return Step(opens=opens, routine=[word(item) for item in items if word(item)][-1])
    names = [name.upper() for name, _ in calls_in(items)]
    calls = tuple(name for name in names if name not in _HARMLESS and name not in _FILLERS)
    if any(word(item) == "DO" for item in items):
        return _started(_action(items), calls)
    if first in _LOOPS or first in _BLOCKS:
        return Step(opens=first, is_loop=first in _LOOPS, calls=calls)
    if first in _CLOSES:
        return Step(closes=_CLOSES[first], calls=calls)
    if first in ("ELSE", "CASE", "DEFAULT") or (
        len(items) == 2 and is_token(items[1], "SIGN", ":")
    ):
        return Step(is_jump=True)
    if first == "BAS":
        return Step(sets=_set_by_bas(items))
    return Step(calls=calls) if first in _MOTIONS else _assigned(items, calls)


def _action(items: Sequence[Any]) -> Sequence[Any]:
    """Return what an interrupt or a trigger does, behind its last DO; nothing of other
    statements.
    """
    done = [k for k, item in enumerate(items) if word(item) == "DO"]
    return items[done[-1] + 1 :] if done else ()


def _started(action: Sequence[Any], calls: tuple[str, ...]) -> Step:
    """Return the effect of what an interrupt or a trigger does at any time from here on."""
    name = element_name(split(action, "=")[0])[0]
    changed = _set_by_assignment(action, name) if action else frozenset[str]()
    return Step(starts=calls, clears=changed | ({name} & _FRAMES))


def _assigned(items: Sequence[Any], calls: tuple[str, ...]) -> Step:
    """Return the effect of an assignment, or of an instruction of no kind of its own."""
    sides = split(items, "=")
    name, is_part = element_name(sides[0])
    if len(sides) != 2 or name not in _SETTABLE:
        return Step(calls=calls, clears=_set_by_assignment(items, name))
    what = frozenset({{"LDAT_ACT": _ORIENTATION, "$LOAD": STATED_LOAD}.get(name, name)})
    return Step(calls=calls, clears=what) if is_part else Step(calls=calls, sets=what)


def _set_by_bas(items: Sequence[Any]) -> frozenset[str]:
    """Return which of the frames, and whether the turning of the tool, a call of BAS sets."""
    what = _by_bas(items)
    if what == "#INITMOV":
        return _FRAMES | {_ORIENTATION}
    one = {"#TOOL": frozenset({"$TOOL"}), "#BASE": frozenset({"$BASE"})}
    return one.get(what, frozenset() if what in _SPEEDS else _FRAMES)


def _set_by_assignment(items: Sequence[Any], name: str) -> frozenset[str]:
    """Return what another instruction may displace: by a system variable that is not understood,
    or as an instruction that is not.
    """
    first = word(items[0])
    stem = name.partition("[")[0]
    is_assignment = any(is_token(item, "SIGN", "=") for item in items)
    if is_assignment:
        if not stem.startswith("$") or stem in _VARIABLES:
            return frozenset()
        return frozenset({_ROBOT if stem in _PLACES else POSITIONS})
    # A declaration begins with DECL, or with a type of the controller's own.
    is_call = len(items) > 1 and isinstance(items[1], Brackets) and items[1].kind == "("
    is_known = first in _INSTRUCTIONS or first in _RELATIVE or is_call
    return frozenset() if is_known or not first else frozenset({POSITIONS})
