"""The statements of ABB's language: the text up to each semicolon, and the effect of each statement
on the control flow.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from pincal.programs.flow import Code, Step
from pincal.programs.line_flow import STATED_LOAD
from pincal.programs.program import Path
from pincal.programs.syntax import (
    Brackets,
    Number,
    Source,
    Statement,
    aggregate,
    calls_in,
    is_token,
    nested,
    numbers_of,
    place_of,
    split,
    text_of_items,
    word,
    words_in,
)
from pincal.programs.understood import Understood, understood_words
from pincal.thresholds import Scale

_TOKENS = r"""
TEXT: /"([^"\r\n]|"")*"/
BITS.3: /\x05/
SIGN: /:=|[<>]=|[^\x04\s\w()\[\]{}"!;$#]/
_END: ";" | "\x04"
COMMENT.5: /![^\r\n]*/
%ignore COMMENT
%ignore /[ \t\f\r\n\xa0]+/
"""
GRAMMAR = nested(_TOKENS)
_WORDS = "RAPID: MODULE ... ENDMODULE with statements that end in ';'"
_ROUTINES = {"PROC": "ENDPROC", "FUNC": "ENDFUNC", "TRAP": "ENDTRAP"}
_LOOPS = {"WHILE": "ENDWHILE", "FOR": "ENDFOR"}
_BLOCKS = {
    "MODULE": "ENDMODULE",
    "RECORD": "ENDRECORD",
    "IF": "ENDIF",
    "TEST": "ENDTEST",
    **_ROUTINES,
    **_LOOPS,
}
_CLOSES = {end: (opens,) for opens, end in _BLOCKS.items()}
# Words after which a statement may follow without a semicolon, with the ends of these heads, and
# words that stand alone.
_HEADS = {"IF": "THEN", "ELSEIF": "THEN", "FOR": "DO", "WHILE": "DO", "CASE": ":", "DEFAULT": ":"}
_JUMPS = ("ELSE", "ELSEIF", "CASE", "DEFAULT", "ERROR", "UNDO", "BACKWARD")
_ALONE = (*_CLOSES, "ELSE", "ERROR", "UNDO", "BACKWARD")
_CONDITIONS = ("IF", "TEST", *_LOOPS)
_LEAVING = ("RETURN", "EXITCYCLE", "EXIT", "GOTO", "RAISE", "RETRY", "TRYNEXT", "STOP", "BREAK")
_HANDLERS = ("ERROR", "UNDO", "BACKWARD")
# From here on a number stands for no external axis: it is written 9E9.
_NONE: Scale = 8.9e9
ONCE = "IF without THEN"
_STORAGE = ("CONST", "PERS", "VAR", "LOCAL", "TASK", "ALIAS")
_PLAIN = {"MOVEL": "line", "MOVEJ": "joint", "MOVEC": "circle", "MOVEABSJ": "joint"}
_PLAIN |= {
    f"{name}{more}": path
    for name, path in _PLAIN.items()
    for more in ("DO", "AO", "GO", "SYNC")
    if name != "MOVEABSJ"
}
# Motions of options, such as arc welding, whose tool is their last argument.
OF_OPTIONS = {
    f"{name}{kind}{more}": {"L": "line", "J": "joint", "C": "circle"}[kind]
    for name, kinds, ends in (
        ("TRIGG", "LJC", ("",)),
        ("TRIGG", "LJ", ("IOS",)),
        ("ARC", "LC", ("", "START", "END", "1", "2")),
        ("SPOT", "LJ", ("",)),
        ("CAP", "LC", ("",)),
        ("DISP", "LC", ("",)),
        ("PAINT", "LC", ("",)),
    )
    for kind in kinds
    for more in ends
}
MOTIONS: dict[str, Path] = {**_PLAIN, **OF_OPTIONS}  # type: ignore[dict-item]
_MANUAL = "ABB, technical reference manual: RAPID instructions, functions and data types"
RAPID_WORDS = (
    Understood(
        "instruction",
        f"{_MANUAL}: program flow, waiting, errors, interrupts",
        "IF, ELSEIF, ELSE, ENDIF, FOR, ENDFOR, WHILE, ENDWHILE, TEST, CASE, DEFAULT, ENDTEST, "
        "GOTO, RETURN, EXIT, EXITCYCLE, STOP, BREAK, RAISE, RETRY, TRYNEXT, RESETRETRYCOUNT, "
        "WAITTIME, WAITUNTIL, WAITDI, WAITDO, WAITGI, WAITGO, WAITAI, WAITAO, WAITROB, "
        "WAITSYNCTASK, CONNECT, IDELETE, IDISABLE, IENABLE, ISLEEP, IWATCH, ISIGNALDI, ISIGNALDO, "
        "ISIGNALGI, ISIGNALGO, ISIGNALAI, ISIGNALAO, ITIMER, IPERS, IERROR, ERRLOG, ERRRAISE, "
        "ERRWRITE, BOOKERRNO, SYSTEMSTOPACTION, STOPMOVE, STOPMOVERESET, STARTMOVE, CLEARPATH, "
        "STOREPATH, RESTOPATH, TRIGGIO, TRIGGEQUIP, TRIGGINT, TRIGGCHECKIO, TRIGGRAMPAO, "
        "TRIGGSPEED, TRIGGSTOPPROC, AND, OR, NOT, XOR, TRUE, FALSE, ACTEVENTBUFFER, "
        "DEACTEVENTBUFFER, CHECKPROGREF, GETTRAPDATA, IRMQMESSAGE, IVARVALUE, PATHRECSTART, "
        "PATHRECSTOP, PATHLENGTHSTART, PATHLENGTHSTOP, PATHLENGTHRESET, RAISETOUSER, SKIPWARN, "
        "STARTMOVERETRY, TRIGGDATACOPY, TRIGGDATARESET, WAITTESTANDSET",
    ),
    Understood(
        "instruction",
        f"{_MANUAL}: motion settings that keep target and tool",
        "ACCSET, VELSET, SPEEDREFRESH, CONFL, CONFJ, PATHACCLIM, PATHRESOL, WORLDACCLIM, "
        "CIRPATHMODE, MOTIONSUP, GRIPLOAD, MECHUNITLOAD, SETSYSDATA, TUNESERVO, TUNERESET, "
        "WZBOXDEF, WZSPHDEF, WZCYLDEF, WZLIMJOINTDEF, WZHOMEJOINTDEF, WZLIMSUP, WZDOSET, "
        "WZENABLE, WZDISABLE, WZFREE, ARCREFRESH, CORNERPATHWARNING, MOTIONPROCESSMODESET, "
        "SPEEDLIMAXIS, SPEEDLIMCHECKPOINT",
    ),
    Understood(
        "instruction",
        f"{_MANUAL}: inputs, outputs, operator, files, clocks, numbers",
        "SETDO, SETGO, SETAO, SET, RESET, INVERTDO, PULSEDO, IOENABLE, IODISABLE, ALIASIO, "
        "TPWRITE, TPERASE, TPREADNUM, TPREADDNUM, TPREADFK, TPSHOW, UIMSGBOX, UIMSGWRITE, "
        "UISHOW, OPEN, CLOSE, WRITE, WRITEBIN, WRITEANYBIN, WRITESTRBIN, WRITERAWBYTES, "
        "READRAWBYTES, PACKRAWBYTES, UNPACKRAWBYTES, CLEARRAWBYTES, COPYRAWBYTES, CLEARIOBUFF, "
        "REWIND, SOCKETCREATE, SOCKETCONNECT, SOCKETSEND, SOCKETRECEIVE, SOCKETCLOSE, SOCKETBIND, "
        "SOCKETLISTEN, SOCKETACCEPT, CLKSTART, CLKSTOP, CLKRESET, INCR, DECR, ADD, CLEAR, "
        "BITSET, BITCLEAR, GETSYSDATA, MAKEDIR, REMOVEDIR, REMOVEFILE, RENAMEFILE, COPYFILE, "
        "SPYSTART, SPYSTOP, PROCERRRECOVERY, WARMSTART, ACTUNIT, DEACTUNIT, CAMFLUSH, "
        "CAMGETRESULT, CAMLOADJOB, CAMREQIMAGE, CAMSETPROGRAMMODE, CAMSETRUNMODE, CLOSEDIR, "
        "IOBUSSTART, IOBUSSTATE, OPENDIR, RMQSENDMESSAGE, SOCKETRECEIVEFROM, SOCKETSENDTO, "
        "TESTSIGNDEFINE, TESTSIGNRESET, UIMSGWRITEABORT",
    ),
    Understood(
        "function",
        f"{_MANUAL}: functions, none of which changes an argument",
        "OFFS, RELTOOL, POSEMULT, POSEINV, POSEVECT, DEFFRAME, DEFACCFRAME, CROBT, CJOINTT, CPOS, "
        "CTOOL, CWOBJ, CALCJOINTT, CALCROBT, ORIENTZYX, EULERZYX, DISTANCE, VECTMAGN, DOTPROD, "
        "CROSSPROD, NORIENT, MIRPOS, ROBOS, ABS, SQRT, SIN, COS, TAN, ACOS, ASIN, ATAN, ATAN2, "
        "ROUND, TRUNC, POW, EXP, NUMTOSTR, DNUMTONUM, NUMTODNUM, VALTOSTR, DIM, AND, OR, NOT, "
        "XOR, DIV, MOD, RETURN, IF, WHILE, ELSEIF, TEST, UNTIL, DOUTPUT, DINPUT, GOUTPUT, AINPUT, "
        "AOUTPUT, TESTDI, CLKREAD, CDATE, CTIME, GETTIME, STRLEN, STRPART, STRFIND, STRMATCH, "
        "PRESENT, ISPERS, ISVAR, BITAND, BITOR, BITXOR, BITNEG, BITLSH, BITRSH, "
        "BITCHECK, OPMODE, RUNMODE, ROBNAME, TASKRUNROB, UIMESSAGEBOX, UINUMENTRY, UILISTVIEW, "
        "READNUM, READSTR, READBIN, ARGNAME, CSPEEDOVERRIDE",
    ),
    Understood(
        "filler",
        f"{_MANUAL}: StrToVal, which writes to its second argument",
        "STRTOVAL",
    ),
    Understood(
        "option",
        f"{_MANUAL}: optional arguments of MoveAbsJ, MoveC, MoveJ, MoveL, TriggL, ArcL, SpotL",
        "CONC, ID, V, T, Z, INPOS, WOBJ, NOEOFFS, TLOAD, CORR, START, TIME, DO, SDO, END, "
        "SEAMNAME, SEAM, WELD, WEAVE, T1, T2, T3, T4, T5, T6, T7, T8, CONFL, QUICKREL, "
        "OPENHLIFT, CLOSEHLIFT, NEXT, SYNC, RETRACT, TRIGGDATA1, TRIGGDATA2, TRIGGDATA3",
    ),
)
_INSTRUCTIONS = understood_words(RAPID_WORDS, "instruction")
RAPID_FUNCTIONS = understood_words(RAPID_WORDS, "function")
_FILLERS = understood_words(RAPID_WORDS, "filler")
MOTION_OPTIONS = understood_words(RAPID_WORDS, "option")
# Instructions by what they switch: displacements of positions, and whether configurations are
# monitored.
SWITCHES = {
    "PDISPON": "PDISP",
    "PDISPSET": "PDISP",
    "PDISPOFF": "PDISP",
    "EOFFSON": "EOFFS",
    "EOFFSSET": "EOFFS",
    "EOFFSOFF": "EOFFS",
    "CORRCON": "CORR",
    "CORRWRITE": "CORR",
    "CORRDISCON": "CORR",
    "CORRCLEAR": "CORR",
    "SINGAREA": "SINGAREA",
    "SOFTACT": "SOFT",
    "SOFTDEACT": "SOFT",
    "DITHERACT": "SOFT",
    "CSSACT": "CSS",
    "CSSDEACTMOVEL": "CSS",
    "CSSOFFSETTUNE": "CSS",
    "CSSFORCEOFFSETACT": "CSS",
    "CSSDEACT": "CSS",
    "SYNCMOVEON": "SYNCMOVE",
    "SYNCMOVERESUME": "SYNCMOVE",
    "SYNCMOVEOFF": "SYNCMOVE",
    "SYNCMOVESUSPEND": "SYNCMOVE",
    "WAITWOBJ": "CONVEYOR",
    "DROPWOBJ": "CONVEYOR",
    "SYNCWWOBJ": "CONVEYOR",
    "CNVGENINSTR": "CONVEYOR",
    "CNVSYNC": "CONVEYOR",
    "INDCNVINIT": "CONVEYOR",
    "INDCNVENABLE": "CONVEYOR",
    "INDCNVADDOBJECT": "CONVEYOR",
    "PRXSETPOSOFFSET": "SENSOR",
    "PRXACTIVRECORD": "SENSOR",
    "PRXACTIVANDSTORERECORD": "SENSOR",
    "PRXUSEFILERECORD": "SENSOR",
    "INDAMOVE": "INDEPENDENT",
    "INDCMOVE": "INDEPENDENT",
    "INDDMOVE": "INDEPENDENT",
    "INDRMOVE": "INDEPENDENT",
    "INDRESET": "INDEPENDENT",
    # A track carries the robot away from where its targets were reached; those of other axes than a
    # track are not told from it.
    "MOVEEXTJ": "EXTERNAL",
    "SETLEADTHROUGH": "LEADTHROUGH",
    "WAITSENSOR": "SENSOR",
    "SYNCTOSENSOR": "SENSOR",
    "DROPSENSOR": "SENSOR",
    "FCACT": "FORCE",
    "FCPRESSLSTART": "FORCE",
    "FCPRESS1LSTART": "FORCE",
    "FCPRESSL": "FORCE",
    "FCPRESSC": "FORCE",
    "FCREFSTART": "FORCE",
    "FCREFSTOP": "FORCE",
    "FCPRESSEND": "FORCE",
    "FCDEACT": "FORCE",
    "EGMACTMOVE": "EGM",
    "EGMMOVEL": "EGM",
    "EGMMOVEC": "EGM",
    "EGMRUNJOINT": "EGM",
    "EGMRUNPOSE": "EGM",
    "EGMSTOP": "EGM",
    "EGMRESET": "EGM",
    "CONFL": "CONFL",
    "CONFJ": "CONFJ",
    "GRIPLOAD": STATED_LOAD,
}
DISPLACES = sorted({*SWITCHES.values()} - {"CONFL", "CONFJ", STATED_LOAD})
# Those of positions in joints as well.
JOINTS_TOO = ("CORR", "CSS", "EGM", "FORCE", "INDEPENDENT", "LEADTHROUGH", "SENSOR", "SOFT")
_ENDS_IT = (
    "PDISPOFF",
    "EOFFSOFF",
    "CORRCLEAR",
    "SOFTDEACT",
    "CSSDEACT",
    "SYNCMOVEOFF",
    "DROPWOBJ",
    "DROPSENSOR",
    "FCDEACT",
    "EGMRESET",
    "INDRESET",
)
# Instructions that only read their arguments.
READING = (
    "TPWRITE",
    "WRITE",
    "ERRWRITE",
    "ERRLOG",
    "UIMSGBOX",
    "SETSYSDATA",
    "GRIPLOAD",
)
# Instructions that set data by their names, which are texts.
BY_NAME = ("SETDATAVAL", "SETALLDATAVAL")


def ends_displacement(statement: Statement) -> bool:
    """Return whether a statement of ``SWITCHES`` ends what it switches."""
    first = word(statement.items[0])
    if first == "MOVEEXTJ":
        return _moves_back(statement)
    has_off = first in ("SINGAREA", "SETLEADTHROUGH")
    return first in _ENDS_IT or (has_off and "OFF" in words_in(statement.items))


def _moves_back(statement: Statement) -> bool:
    """Return whether a motion of external axes ends where all that are in use are at 0, which only
    a target in numbers says.
    """
    group = aggregate(split(statement.items[1:])[0], "[")
    lists = None if group is None else [aggregate(part, "[") for part in group.parts]
    external = None if not lists or lists[-1] is None else numbers_of(lists[-1].parts)
    return external is not None and are_at_rest(external)


def are_at_rest(external: Sequence[Number]) -> bool:
    """Return whether external axes are at 0 or not in use."""
    return all(number.value == 0.0 or number.value >= _NONE for number in external)


def code_of(source: Source) -> Code:
    """Return the statements of a file with their effects on the control flow.

    Raises:
        ProgramError: for text in another language.
    """
    parts = [part for whole in source.statements(_TOKENS, _WORDS) for part in _divided(whole)]
    return Code(source, [statement for statement, _ in parts], [step for _, step in parts])


def _divided(whole: Statement) -> Iterator[tuple[Statement, Step]]:
    """Yield the statements before one semicolon, with their effects on the control flow."""
    items = whole.items
    k = 0
    while k < len(items):
        first = word(items[k])
        size = _size_of_head(items, k)
        if first == "IF" and not size:
            yield from _once(whole, items[k:])
            return
        end = min(k + size, len(items)) if size else len(items)
        statement = _part(whole, items[k:end])
        is_label = _is_label(items, k) and first not in _HEADS
        yield statement, _step(statement, _opening(items, k), is_label=is_label)
        k = end


def _opening(items: Sequence[Any], k: int) -> str:
    """Return the word that may open a block, behind LOCAL."""
    first = word(items[k])
    return word(items[k + 1]) if first == "LOCAL" and k + 1 < len(items) else first


def _is_label(items: Sequence[Any], k: int) -> bool:
    return k + 1 < len(items) and is_token(items[k + 1], "SIGN", ":")


def _size_of_head(items: Sequence[Any], k: int) -> int:
    """Return the number of items of a statement behind which another one may follow without a
    semicolon, 0 for other statements.
    """
    first = word(items[k])
    opening = _opening(items, k)
    size = 0
    if first in _ALONE:
        size = 1
    elif opening in _ROUTINES or opening in ("MODULE", "RECORD"):
        size = (1 if first == "LOCAL" else 0) + (3 if opening == "FUNC" else 2)
    elif first in _HEADS:
        size = _distance(items, k, (_HEADS[first],)) + 1
    elif first and _is_label(items, k):
        size = 2
    elif first == "TEST":
        size = max(_distance(items, k, ("CASE", "DEFAULT")), 0)
    elif not first:
        size = max(_distance(items, k + 1, ("MODULE",)) + 1, 0)
    has_brackets = size and k + size < len(items) and isinstance(items[k + size], Brackets)
    return size + 1 if has_brackets and (opening in _BLOCKS or first == "ERROR") else size


def _distance(items: Sequence[Any], k: int, words: Sequence[str]) -> int:
    """Return how far the first of some words or signs is behind an item, -1 if there is none."""
    for j in range(k, len(items)):
        if word(items[j]) in words or (is_token(items[j], "SIGN") and str(items[j]) in words):
            return j - k
    return -1


def _once(whole: Statement, items: Sequence[Any]) -> Iterator[tuple[Statement, Step]]:
    """Yield a condition and its only statement: a motion, an assignment, or all that follows."""
    own = (MOTIONS, SWITCHES, BY_NAME, _LEAVING)
    motions = [k for k in range(1, len(items)) if any(word(items[k]) in words for words in own)]
    k = motions[-1] if motions else 1
    sides = split(items, ":=")
    if not motions and len(sides) == 2 and is_assignment(items):
        k = len(sides[0]) - 1
        while k > 1 and (
            isinstance(items[k], Brackets)
            or is_token(items[k], "SIGN", ".")
            or is_token(items[k - 1], "SIGN", ".")
        ):
            k -= 1
    condition = _part(whole, items[:1])
    yield condition, Step(opens=ONCE, calls=_routines(name for name, _ in calls_in(items[:k])))
    if k < len(items):
        statement = _part(whole, items[k:])
        yield statement, _step(statement, word(statement.items[0]), is_label=False)
    yield condition, Step(closes=(ONCE,))


def _part(whole: Statement, items: Sequence[Any]) -> Statement:
    line = whole.line if isinstance(items[0], Brackets) else items[0].line
    return Statement(tuple(items), *place_of(items), line)


def _step(statement: Statement, opening: str, *, is_label: bool) -> Step:
    """Return the effect of a statement on the control flow and on switches."""
    items = statement.items
    first = word(statement.items[0])
    if opening in _BLOCKS:
        names = [word(item) for item in items if word(item)]
        return Step(
            opens=opening,
            routine=names[-1] if opening in _ROUTINES else "",
            is_loop=opening in _LOOPS,
            calls=_routines(name for name, _ in calls_in(items)) if first in _CONDITIONS else (),
        )
    if first in _CLOSES:
        return Step(closes=_CLOSES[first])
    if first in _JUMPS or is_label:
        calls = _routines(name for name, _ in calls_in(items))
        return Step(is_jump=True, is_label=is_label or first in _HANDLERS, calls=calls)
    if first == "CONNECT":
        return Step(starts=tuple(words_in(items[1:])))
    is_own = not (is_assignment(items) or first in MOTIONS or first in _STORAGE)
    names = [name for name, _ in calls_in(items) if is_own or name.upper() != first]
    calls = _routines([*([first] if is_own else []), *names, *_called_by_text(items)])
    return Step(
        sets=frozenset({SWITCHES[first]}) if first in SWITCHES else frozenset(), calls=calls
    )


def _routines(names: Iterable[str]) -> tuple[str, ...]:
    """Return those of some names before brackets, or of statements, that are not RAPID's own."""
    return tuple(
        name.upper()
        for name in names
        if name
        and name.upper() not in _INSTRUCTIONS
        and name.upper() not in RAPID_FUNCTIONS
        and name.upper() not in _FILLERS
        and name.upper() not in SWITCHES
    )


def _called_by_text(items: Sequence[Any]) -> list[str]:
    """Return the names of routines that a statement calls by a text: ``%"name"%``, or the last
    argument of MoveLSync; a computed one has no routine's name.
    """
    texts = split(items, "%")[1:2]
    if word(items[0]) in MOTIONS and word(items[0]).endswith("SYNC"):
        texts.append(split(items)[-1])
    return [
        str(text[0]).strip('"').upper() if len(text) == 1 and is_token(text[0], "TEXT") else "%"
        for text in texts
    ]


def is_assignment(items: Sequence[Any]) -> bool:
    r"""Return whether items assign a value: not where an optional argument is given one, as in
    ``up\x:=1``.
    """
    signs = [str(item) for item in items if is_token(item, "SIGN", ":=", "\\")]
    return signs[:1] == [":="]


def check_blocks(code: Code) -> None:
    """Refuse a file that does not consist of modules, or has nested routines."""
    source = code.source
    if not any(step.opens == "MODULE" for step in code.steps):
        raise source.error("the end of the file, expected " + _WORDS, len(source.content))
    for statement, step, known in zip(code.statements, code.steps, code.flow, strict=True):
        found = text_of_items(statement.items[:1])
        is_outside = known.depth == 0
        if (step.opens == "MODULE") != is_outside and not (is_outside and found == "%"):
            where = "outside of" if is_outside else "within"
            raise source.error(f"{found!r} {where} a module; expected {_WORDS}", statement.start)
        if step.routine and known.depth != 1:
            raise source.error(
                f"{found!r} within another routine; expected {_WORDS}", statement.start
            )
