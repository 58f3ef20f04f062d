"""What the lines of FANUC's listings do to positions: which words leave them as they are, and what
displaces them.
"""

from __future__ import annotations

from collections.abc import Iterator

from pincal.programs.line_flow import ANY, POSITIONS, STATED_LOAD, BlockPart, Line
from pincal.programs.understood import (
    Understood,
    first_phrase,
    not_understood,
    tokens_of,
    understood_words,
    without_brackets,
)

_MANUAL = "FANUC R-30iA/R-30iB, operator's manual (basic operation), chapter 4"
_ARC = "FANUC R-30iB, arc welding operator's manual, arc and weave instructions"
_SPOT = "FANUC R-30iB, spot welding operator's manual, program instructions"
_GERMAN = "FANUC R-30iA/R-30iB, the same in German system software"
LISTING_WORDS = (
    Understood(
        "instruction",
        f"{_MANUAL}: branch, program control, wait and condition monitor instructions",
        "LBL, JMP, CALL, RUN, IF, ELSE, ENDIF, SELECT, FOR, ENDFOR, END, WAIT, PAUSE, ABORT, WHEN, "
        "MONITOR, MONITOR END, TIMEOUT, RESUME_PROG, ENABLE RESUME_PROG, CLEAR RESUME_PROG, THEN",
    ),
    Understood(
        "instruction",
        "FANUC, listings of the VASS standard: the condition on which a motion may go on",
        "TC_ONLINE",
    ),
    Understood(
        "instruction",
        f"{_MANUAL}: conditions of skips and offsets, which act on motions with that option only",
        "SKIP CONDITION, OFFSET CONDITION, TOOL_OFFSET CONDITION, VOFFSET CONDITION, LOCK PREG, "
        "UNLOCK PREG",
    ),
    Understood(
        "instruction",
        f"{_MANUAL}: miscellaneous instructions",
        "RSR, UALM, TIMER, OVERRIDE, REMARK, MESSAGE, PAYLOAD, COL DETECT ON, COL DETECT OFF, "
        "COL GUARD ADJUST, JOINT_MAX_SPEED, LINEAR_MAX_SPEED, DIAG_REC, POINT_LOGIC, "
        "STRLEN, SUBSTR, FINDSTR, VISION RUN_FIND, VISION GET_OFFSET, VISION GET_NFOUND, "
        "VISION GET_PASSFAIL, SAVE_LOG",
    ),
    Understood(
        "instruction",
        _ARC,
        "ARC START, ARC END, WEAVE, WEAVE SINE, WEAVE FIGURE, WEAVE CIRCLE, WEAVE L, WEAVE END, "
        "WIRE FORWARD, WIRE BACKWARD",
    ),
    Understood("instruction", _SPOT, "SPOT, BACKUP, STROKE, BU, SS, SE, HAND OPEN, HAND CLOSE"),
    Understood(
        "variable",
        f"{_MANUAL}: registers, inputs and outputs, frame numbers, speeds, parameters",
        "R, PR, SR, AR, PL, DI, DO, RI, RO, GI, GO, AI, AO, SI, SO, UI, UO, WI, WO, WSI, WSO, SDI, "
        "SDO, RDI, RDO, GDI, GDO, M, F, LO, TIMER, OVERRIDE, UFRAME_NUM, UTOOL_NUM, "
        "JOINT_MAX_SPEED, LINEAR_MAX_SPEED, UALM, RSR, $MCR.$GENOVERRIDE, $WAITTMOUT, $SPEED, "
        "$MCR.$PRGOVERRIDE, $MCR_GRP.$PRGOVERRIDE",
    ),
    Understood("variable", _GERMAN, "BENUTZER_NUM, WKZ_NUM"),
    Understood(
        "option",
        f"{_MANUAL}: speed and positioning path of a motion",
        "FINE, CNT, CR, CD, MM/SEC, CM/MIN, INCH/MIN, IN/MIN, DEG/SEC, SEC, MSEC, MM, MAX_SPEED, "
        "WELD_SPEED, R, AR, PSPD",
    ),
    Understood(
        "option",
        f"{_MANUAL}: additional motion instructions without an offset; what they switch or call",
        "ACC, WJNT, MROT, PTH, RT_LD, AP_LD, BREAK, EV, IND.EV, TB, TA, DB, CALL, "
        "P-SPS, DO, RO, GO, AO, F, ON, OFF, PULSE, POINT_LOGIC, ALIM",
    ),
    Understood(
        "option",
        _ARC,
        "ARC START, ARC END, WEAVE, WEAVE SINE, WEAVE FIGURE, WEAVE CIRCLE, WEAVE L, WEAVE END",
    ),
    Understood("option", _SPOT, "SPOT, SS, SE"),
)
_INSTRUCTIONS = understood_words(LISTING_WORDS, "instruction")
_VARIABLES = understood_words(LISTING_WORDS, "variable")
_OPTIONS = understood_words(LISTING_WORDS, "option")
COMPUTED = "moved by an offset"
"""How the reason begins where a motion goes to what is computed from its position."""
# Options that displace the target of their motion.
_MOVED = frozenset(
    ["OFFSET", "TOOL_OFFSET", "VOFFSET", "COORD", "RTCP", "PTH_OFFSET", "WKZ_OFFSET"]
)
# Instructions that displace positions until another one, by their names.
_BEGINS = {"TOUCH OFFSET": "touch offset", "TRACK": "tracking", "SOFTFLOAT": "soft float"}
_ENDS = {
    "TOUCH OFFSET END": "touch offset",
    "TRACK END": "tracking",
    "SOFTFLOAT END": "soft float",
}
SWITCHED = (*_BEGINS.values(), POSITIONS)
_PHRASES = frozenset([*_INSTRUCTIONS, *_BEGINS, *_ENDS])
_FRAMES = {"UTOOL": "tool", "UFRAME": "base"}
_CONDITIONS = ("IF", "WHEN", "ELSE", "SELECT")
_BLOCKS: dict[str, BlockPart] = {
    "FOR": "loop",
    "ENDFOR": "end",
    "ENDIF": "end",
}


def why_moved_by_options(options: str, line: int) -> str:
    """Return why a motion with some options does not go to its position, "" if it does."""
    tokens = tokens_of(without_brackets(options))
    k = 0
    while k < len(tokens):
        phrase = first_phrase(tokens[k : k + 3], _OPTIONS)
        if phrase == "INC":
            return f"a relative motion (INC), line {line}"
        if phrase == "SKIP":
            return f"a search (Skip), line {line}"
        if phrase in _MOVED:
            return f"{COMPUTED} ({phrase})"
        if phrase and phrase not in _OPTIONS:
            return f"line {line}: {phrase!r} is not understood and may displace it"
        # A program that is called stands behind the word.
        k += 2 if phrase == "CALL" else len(phrase.split(" "))
    return ""


def effect_of_options(options: str, number: int) -> Line:
    """Return the effect of the options of a motion on what follows: jumps and calls."""
    return Line(number, jumps=_jumps(options), calls=_calls(options))


def effect_in_listing(text: str, number: int) -> Line:
    """Return the effect of an instruction."""
    flat = without_brackets(text)
    tokens = tokens_of(flat)
    first = tokens[0] if tokens else ""
    is_condition = first in _CONDITIONS or flat.startswith("=")
    jumps = _jumps(text)
    calls = _calls(text)
    block = _BLOCKS.get(first, "")
    if is_condition:
        if flat.strip(" ;").endswith("THEN"):
            block = "branch"
        elif first == "ELSE" and "," not in flat:
            block = "else"
        # The action of a condition stands behind its first comma.
        action = flat.partition(",")[2]
        sets = tuple(_sets(action, text, number))
        return Line(number, sets, jumps=jumps, calls=calls, block=block)
    phrase = first_phrase(tokens, _PHRASES)
    return Line(
        number,
        tuple(_sets(flat, text, number)),
        ends=(STATED_LOAD,) if phrase == "PAYLOAD" else (_ENDS[phrase],) if phrase in _ENDS else (),
        label=_label(text),
        jumps=jumps,
        calls=calls,
        is_last=first in ("JMP", "END", "ABORT"),
        block=block,
    )


def _sets(flat: str, text: str, number: int) -> Iterator[tuple[str, str]]:
    """Yield what a plain instruction may displace, with the reason."""
    tokens = tokens_of(flat)
    if not any(tokens):
        return
    left = tokens_of(flat.partition("=")[0])
    phrase = first_phrase(tokens, _PHRASES)
    target = left[0] if left else ""
    if "=" in flat and target in _FRAMES:
        index = number_in_brackets(text.upper().partition(f"{target}[")[2].partition("]")[0])
        name = f"{_FRAMES[target]} {index if index.isdigit() else ANY}"
        yield name, f"line {number} sets it while the program runs"
    elif "=" in flat and phrase not in _INSTRUCTIONS:
        if target not in _VARIABLES:
            yield POSITIONS, f"line {number}: {not_understood(text)}"
    elif phrase in _ENDS:
        return
    elif phrase == "PAYLOAD":
        yield STATED_LOAD, f"{number} {text}"
    elif phrase in _BEGINS or tokens[0] in _BEGINS:
        found = _BEGINS.get(phrase, _BEGINS.get(tokens[0], ""))
        yield found, f"line {number} displaces positions ({text[:40].strip()})"
    elif phrase not in _INSTRUCTIONS:
        yield POSITIONS, f"line {number}: {not_understood(text)}"


def number_in_brackets(text: str) -> str:
    """Return the number in brackets, without its comment and the group before it.

    Example:
        >>> [number_in_brackets(text) for text in ("3:table", "GP1:3", "R[1", " 2,5")]
        ['3', '3', 'R[1', '2']
    """
    first, _, more = text.partition(":")
    return (more if first.strip().startswith("GP") else first).partition(",")[0].strip()


def _label(text: str) -> str:
    """Return the label that a line is, "" if it is none."""
    upper = text.upper().strip()
    return _indices(upper)[0] if upper.startswith("LBL[") else ""


def _jumps(text: str) -> tuple[str, ...]:
    """Return the labels to which a line may jump."""
    upper = text.upper().strip()
    return () if upper.startswith("LBL[") else _indices(upper)


def _indices(text: str) -> tuple[str, ...]:
    """Return the numbers of the labels in a text, ``*`` for a computed one."""
    found = [piece.partition("]")[0].partition(":")[0].strip() for piece in text.split("LBL[")[1:]]
    return tuple(index if index.isdigit() else ANY for index in found)


def _calls(text: str) -> tuple[str, ...]:
    """Return the programs that a line calls or starts; ``*`` for a computed one."""
    found = []
    for word in ("CALL ", "RUN "):
        for piece in text.upper().split(word)[1:]:
            name = piece.strip().partition("(")[0].partition(",")[0].partition(";")[0].split()
            found.append(ANY if not name or "[" in name[0] else name[0])
    return tuple(found)
