"""What the instructions of Yaskawa's jobs do to positions: which words leave them as they are, and
what displaces them.
"""

from __future__ import annotations

from collections.abc import Sequence

from pincal.programs.line_flow import ANY, POSITIONS, BlockPart, Line
from pincal.programs.understood import (
    Understood,
    not_understood,
    understood_words,
    without_brackets,
)

_MANUAL = "Yaskawa DX200, INFORM language manual, chapter 2"
JOB_WORDS = (
    Understood(
        "instruction",
        f"{_MANUAL}: control instructions",
        "NOP, END, JUMP, CALL, RET, TIMER, WAIT, LABEL, COMM, IF, IFTHEN, IFTHENEXP, ELSEIF, "
        "ELSEIFEXP, ELSE, ENDIF, UNTIL, PAUSE, ABORT, CWAIT, ADVINIT, ADVSTOP, MSG, CLS, DIALOG, "
        "WHILE, WHILEEXP, ENDWHILE, FOR, NEXT, SWITCH, CASE, DEFAULT, ENDSWITCH, PSTART, PWAIT, "
        "TSYNC, SETUALM, SHCKSET, SHCKRST, NWAIT, SPEED, RETURN",
    ),
    Understood(
        "instruction",
        f"{_MANUAL}: input and output instructions",
        "DOUT, DIN, AOUT, ARATION, ARATIOF, PULSE, SETOUT",
    ),
    Understood(
        "instruction",
        f"{_MANUAL}: operating instructions; a position variable that they set is left",
        "SET, SETE, GETE, GETS, GETPOS, GETARG, INC, DEC, ADD, SUB, MUL, DIV, CNVRT, CLEAR, SIN, "
        "COS, ATAN, SQRT, AND, OR, NOT, XOR, MULMAT, INVMAT, GETFILE, SETREG, GETREG, "
        "MSHIFT, CNVR, VAL, ASC, CHR$, MID$, LEN, CAT$, VAL2STR, PRINT, SWAP",
    ),
    Understood(
        "instruction",
        f"{_MANUAL}: work instructions (arc and spot welding, handling)",
        "ARCON, ARCOF, ARCSET, ARCCTS, ARCCTE, AWELD, VWELD, WVON, WVOF, REFP, ANTSTICK, "
        "SPOT, SVSPOT, SVSPOTMOV, SVGUNCL, GUNCL, STROKE, HAND, TOOLON, TOOLOF, "
        "CUTON, CUTOF",
    ),
    Understood(
        "option",
        f"{_MANUAL}: move instructions (speed, position level, acceleration, no wait)",
        "VJ, V, VR, VE, PL, CR, ACC, DEC, NWAIT, FPT, EC, EX",
    ),
)
_INSTRUCTIONS = understood_words(JOB_WORDS, "instruction")
_OPTIONS = understood_words(JOB_WORDS, "option")
SHIFT = "shift"
# Variables that SET may set; of indexed ones the index is left out.
_VARIABLES = ("B", "I", "D", "R", "S", "P", "PX", "B[]", "I[]", "D[]", "R[]", "S[]", "P[]", "PX[]")
_BEGINS = ("SFTON", "MFRAME", "PMTON", "SYSTART")
_ENDS = ("SFTOF", "PMTOF", "SYEND")
_BLOCKS: dict[str, BlockPart] = {
    "WHILE": "loop",
    "WHILEEXP": "loop",
    "FOR": "loop",
    "IFTHEN": "branch",
    "IFTHENEXP": "branch",
    "SWITCH": "branch",
    "ELSEIF": "else",
    "ELSEIFEXP": "else",
    "ELSE": "else",
    "CASE": "else",
    "DEFAULT": "else",
    "ENDIF": "end",
    "ENDSWITCH": "end",
    "ENDWHILE": "end",
    "NEXT": "end",
}


def effect_in_job(text: str, number: int) -> Line:
    """Return the effect of an instruction."""
    words = without_brackets(text, quotes=False).replace("=", " = ").split()
    first = words[0] if words else ""
    if first.startswith("*"):
        return Line(number, label=first)
    rest = words[1:]
    labels = tuple(word for word in rest if word.startswith("*"))
    is_call = first in ("CALL", "PSTART")
    jobs = [word.removeprefix("JOB:") for word in rest if word.startswith("JOB:")]
    is_always = "IF" not in rest
    return Line(
        number,
        _sets("SET of no variable" if _sets_no_variable(words) else first, text, number),
        ends=(SHIFT,) if first in _ENDS and is_always else (),
        jumps=labels,
        calls=tuple(jobs) or ((ANY,) if is_call else ()),
        is_last=first in ("JUMP", "RET", "END") and is_always,
        block=_BLOCKS.get(first, ""),
    )


def _sets_no_variable(words: Sequence[str]) -> bool:
    """Return whether an instruction sets something else than a variable: ``SET USERFRAME 2``."""
    name = words[1].lstrip("L").rstrip("0123456789") if len(words) > 1 else ""
    return words[:1] == ["SET"] and name not in _VARIABLES


def _sets(first: str, text: str, number: int) -> tuple[tuple[str, str], ...]:
    """Return what an instruction may displace, with the reason."""
    if first in _BEGINS:
        return ((SHIFT, f"line {number} shifts positions, or computes a frame from them"),)
    # Lines of the head, such as the groups of axes, begin with slashes.
    if not first or first.startswith("/") or first in _INSTRUCTIONS or first in _ENDS:
        return ()
    return ((POSITIONS, f"line {number}: {not_understood(text)}"),)


def why_not_reached(options: str, number: int) -> str:
    """Return why a motion may not go to its position, "" if it does."""
    for word in (
        without_brackets(options.partition("+")[0], quotes=False).replace("=", " = ").split()
    ):
        name = word.strip("0123456789.#")
        if name == "UNTIL":
            return f"a search (UNTIL), line {number}"
        if name in ("=", "", "I", "B", "D", "R", "LI", "LB", "LD", "LR", "BC", "BP"):
            continue
        if name not in _OPTIONS:
            return f"line {number}: {name!r} is not understood and may displace it"
    return ""


def named_in(text: str) -> list[str]:
    """Return the positions that a text names."""
    found = []
    for sign in (",", "(", ")", "="):
        text = text.replace(sign, " ")
    for word in text.upper().split():
        kind = word.rstrip("0123456789")
        if kind in ("C", "P", "PX", "BC", "BP", "EC", "EX") and kind != word:
            found.append(f"{'P' if kind == 'PX' else kind}{word.removeprefix(kind)}")
    return found
