"""Which words of a language are understood: those that change neither where a point is reached nor
a frame.

A language lists them in tables, as its manual does. A statement with any other word may displace
every point that it can reach, so that none of these is corrected.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

# A statement of its own; a word behind the target of a motion; what may be assigned to; a function
# that changes none of its arguments; one that may change these, but nothing else.
WordKind = Literal["instruction", "option", "variable", "function", "filler"]


@dataclass(frozen=True)
class Understood:
    """Words of one kind that leave points and frames as they are.

    Attributes:
        kind: what they are.
        source: the manual and its chapter.
        words: the words or phrases, with commas between them.
    """

    kind: WordKind
    source: str
    words: str


_PAIRS = {"(": ")", "[": "]"}


def understood_words(tables: Sequence[Understood], kind: WordKind) -> frozenset[str]:
    """Return the words of a kind in some tables."""
    return frozenset(
        word.strip() for table in tables if table.kind == kind for word in table.words.split(",")
    )


def without_brackets(text: str, *, quotes: bool = True) -> str:
    """Return a text in capitals without what stands in brackets and, if asked for, in single
    quotes.

    Example:
        >>> without_brackets("J P[1:home] 50% CNT0 Offset,PR[R[3]]")
        'J P[] 50% CNT0 OFFSET,PR[]'
    """
    found = ""
    opened = list[str]()
    is_quoted = False
    for letter in text.upper():
        inner = opened[-1] if opened else ""
        if letter == _PAIRS.get(inner, ""):
            opened.pop()
        if quotes and letter == "'" and not opened:
            is_quoted = not is_quoted
        elif not opened and not is_quoted:
            found += letter
        # Round brackets within square ones are text: ``MESSAGE[a (]``.
        if letter == "[" or (letter == "(" and inner != "["):
            opened.append(letter)
    return found


def tokens_of(text: str) -> list[str]:
    """Return the words of a plain text without their numbers and brackets; numbers are "".

    Example:
        >>> tokens_of("500MM/SEC CNT100 ACC R[] OFFSET,PR[]")
        ['MM/SEC', 'CNT', 'ACC', 'R', 'OFFSET', 'PR']
    """
    for sign in ("[]", "()", ",", ";", "="):
        text = text.replace(sign, " ")
    return [token.strip("0123456789.+-#%") for token in text.split()]


def first_phrase(tokens: Sequence[str], known: Mapping[str, object] | frozenset[str]) -> str:
    """Return the longest known phrase with which some words begin, else the first word."""
    for count in (3, 2):
        phrase = " ".join(tokens[:count])
        if len(tokens) >= count and phrase in known:
            return phrase
    return tokens[0] if tokens else ""


def not_understood(text: str) -> str:
    """Return why positions are left behind an instruction that is not understood."""
    return f"{text[:40].strip()!r}, which is not understood and may displace positions"
