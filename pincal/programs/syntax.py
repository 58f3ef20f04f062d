"""The text of a program as a tree of tokens that know their places in it, by a grammar of its language.

Bytes are taken one by one as characters, so that a place in the text is a place in the file whatever its encoding. Three of
the languages share a grammar: statements of words, numbers, texts and signs, nested in brackets, whose tokens and ends of
statements each language gives. What is in a statement is for the language's module to say.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

from pincal.errors import ProgramError, needed

if TYPE_CHECKING:
    from lark import Lark, Token

# A program larger than this is none [bytes].
LARGEST_PROGRAM = 50_000_000
# Statements of nested brackets; a language adds its tokens, and ``_END``, which ends a statement.
_NESTED = r"""
start: statement*
statement: _item* _END
_item: WORD | NUMBER | BITS | TEXT | SIGN | group
group: OPEN _inner* CLOSE
_inner: _item
OPEN: "(" | "[" | "{"
CLOSE: ")" | "]" | "}"
NUMBER.2: /(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?/
WORD.1: /[A-Za-z_$#\x80-\xff][A-Za-z0-9_$\x80-\xff]*/
"""
# What stands behind the last statement.
_END_OF_FILE = "\n\x04"
_PAIRS = {"(": ")", "[": "]", "{": "}"}


@dataclass(frozen=True)
class Number:
    """A number in a program: its value, where it stands, and its text."""

    value: float
    start: int
    end: int
    text: str

    @property
    def decimals(self) -> int:
        """Number of digits behind the point."""
        return len(self.text.lower().partition("e")[0].partition(".")[2])


@dataclass(frozen=True)
class Brackets:
    """What stands in a pair of brackets, with the brackets."""

    kind: str
    items: tuple[Any, ...]
    start: int
    end: int

    @cached_property
    def parts(self) -> list[tuple[Any, ...]]:
        """The items between commas."""
        return split(self.items)


@dataclass(frozen=True)
class Statement:
    """One statement: its items, tokens and groups, and where it stands."""

    items: tuple[Any, ...]
    start: int
    end: int
    line: int


@dataclass(frozen=True)
class Source:
    """One file of a program.

    Attributes:
        name: the file, for messages.
        content: its bytes.
    """

    name: str
    content: bytes

    @cached_property
    def text(self) -> str:
        """One character for each byte; a byte order mark is blank."""
        if len(self.content) > LARGEST_PROGRAM:
            raise ProgramError(f"{self.name}: {len(self.content)} bytes; expected a program of at most {LARGEST_PROGRAM}")
        if b"\0" in self.content:
            raise self.error("a zero byte; expected text in ASCII, Latin-1 or UTF-8", self.content.index(b"\0"))
        text = self.content.decode("latin-1")
        return "   " + text[3:] if text.startswith("\xef\xbb\xbf") else text

    def place(self, at: int) -> tuple[int, int]:
        """Return line and column, from 1, of a place in the text."""
        line = bisect.bisect_right(self._lines, at)
        return line, at - self._lines[line - 1] + 1

    @cached_property
    def _lines(self) -> list[int]:
        """Where lines begin."""
        text = self.content.replace(b"\r\n", b" \n").replace(b"\r", b"\n")
        return [0, *(k + 1 for k, byte in enumerate(text) if byte == 10)]

    def error(self, what: str, at: int) -> ProgramError:
        """Return the error that something is wrong at a place."""
        line, column = self.place(at)
        return ProgramError(f"{self.name}, line {line}, column {column}: {what}")

    def parse(self, grammar: str, words: str, *, part: tuple[int, int] | None = None) -> Any:
        """Return lark's tree of the text by a grammar.

        Args:
            grammar: the grammar.
            words: what the file should be, for messages.
            part: start and end of the text to be read; default: all. Lines of tokens are then none.

        Raises:
            ProgramError: if the text is not of the grammar: cut, or of another dialect.
        """
        text = self.text if part is None else " " * part[0] + self.text[part[0] : part[1]]
        with needed("lark", "programs of controllers", error=ProgramError):
            from lark.exceptions import UnexpectedCharacters, UnexpectedInput, UnexpectedToken
        try:
            return parser_of(grammar).parse(text + _END_OF_FILE)
        except UnexpectedInput as error:
            at = min(error.pos_in_stream if error.pos_in_stream is not None else len(text), len(text))
            is_end = isinstance(error, UnexpectedToken) and error.token.type == "$END"
            if is_end or at == len(text):
                raise self.error(f"the end of the file; expected more of {words}: is it cut?", len(text)) from None
            found = text[at] if isinstance(error, UnexpectedCharacters) else str(error.token)  # type: ignore[attr-defined]
            raise self.error(f"{found[:30]!r}; expected {words}", at) from None

    def statements(self, tokens: str, words: str, *, over_lines: bool = False) -> list[Statement]:
        """Return the statements of a language of nested brackets, by its tokens.

        Args:
            tokens: the language's own terminals.
            words: what the file should be, for messages.
            over_lines: whether brackets go on over what ends statements outside.
        """
        found = []
        for tree in self.parse(nested(tokens, over_lines=over_lines), words).children:
            items = tuple(self._items(tree.children, words))
            if items:
                start, end = place_of(items[0])[0], place_of(items[-1])[1]
                line = self.place(start)[0] if isinstance(items[0], Brackets) else items[0].line
                found.append(Statement(items, start, end, line or 0))
        return found

    def _items(self, children: Iterable[Any], words: str) -> Iterator[Any]:
        for child in children:
            if isinstance(child, str):
                yield child
                continue
            first, *inner, last = child.children
            if _PAIRS[first] != last:
                raise self.error(f"{str(last)!r}; expected {_PAIRS[first]!r} in {words}", last.start_pos)
            yield Brackets(str(first), tuple(self._items(inner, words)), first.start_pos, last.end_pos)


def nested(tokens: str, *, over_lines: bool = False) -> str:
    """Return the grammar of a language of nested brackets by its tokens."""
    return _NESTED.replace("_inner: _item", "_inner: _item | _END" if over_lines else "_inner: _item") + tokens


@lru_cache(8)
def parser_of(grammar: str) -> Lark:
    """Return the parser of a grammar."""
    from lark import Lark

    return Lark(grammar, parser="lalr", lexer="contextual", propagate_positions=True)


def place_of(item: Token | Brackets) -> tuple[int, int]:
    """Return start and end of an item in the text."""
    if isinstance(item, Brackets):
        return item.start, item.end
    return item.start_pos or 0, item.end_pos or 0


def split(items: Iterable[Any], sign: str = ",") -> list[tuple[Any, ...]]:
    """Return the items between signs."""
    parts: list[list[Any]] = [[]]
    for item in items:
        if not isinstance(item, Brackets) and item.type == "SIGN" and item == sign:
            parts.append([])
        else:
            parts[-1].append(item)
    return [tuple(part) for part in parts]


def number_of(items: Sequence[Any]) -> Number | None:
    """Return the number that items are, with its sign; None if they are something else."""
    if len(items) == 2 and is_token(items[0], "SIGN", "+", "-") and items[0].end_pos == items[1].start_pos:
        sign, number = str(items[0]), items[1]
    elif len(items) == 1:
        sign, number = "", items[0]
    else:
        return None
    if not is_token(number, "NUMBER"):
        return None
    value = float(sign + str(number))
    start = items[0].start_pos
    return Number(value, start, number.end_pos, sign + str(number)) if math.isfinite(value) else None


def number_at(token: Token) -> Number | None:
    """Return the number that a token of a grammar with signed numbers is; None if it is something else."""
    text = str(token)
    try:
        return Number(float(text), token.start_pos or 0, token.end_pos or 0, text)
    except ValueError:
        return None


def numbers_of(parts: Sequence[Sequence[Any]]) -> tuple[Number, ...] | None:
    """Return the numbers that parts are; None if one of them is something else."""
    found = [number_of(part) for part in parts]
    return tuple(number for number in found if number is not None) if None not in found else None


def aggregate(items: Sequence[Any], kind: str) -> Brackets | None:
    """Return the brackets of a kind that items are, None if they are something else."""
    return items[0] if len(items) == 1 and isinstance(items[0], Brackets) and items[0].kind == kind else None


def call_of(items: Sequence[Any]) -> tuple[str, Brackets] | None:
    """Return name and arguments of the call that items are, None if they are none."""
    if len(items) == 2 and is_token(items[0], "WORD") and isinstance(items[1], Brackets) and items[1].kind == "(":
        return str(items[0]), items[1]
    return None


def is_token(item: Any, kind: str, text: str = "", other: str = "") -> bool:
    """Return whether an item is a token of a kind, and of one of some texts."""
    return not isinstance(item, Brackets) and item.type == kind and (not text or str(item).upper() in (text, other))


def word(item: Any) -> str:
    """Return an item in capitals if it is a word, else an empty text."""
    return str(item).upper() if is_token(item, "WORD") else ""


def text_of_items(items: Iterable[Any], *, case: bool = False) -> str:
    """Return what items spell, without blanks and, unless capitals make a difference, in capitals: ``P [ 3 ]`` is P[3]."""
    found = ""
    for item in items:
        if isinstance(item, Brackets):
            found += item.kind + text_of_items(item.items, case=case) + _PAIRS[item.kind]
        else:
            found += str(item) if case else str(item).upper()
    return found


def element_name(items: Sequence[Any], *, case: bool = False) -> tuple[str, bool]:
    """Return the name that items spell and whether only a part of it is meant; an empty text if they spell none.

    An element of an array is ``P[3]``, and ``P[*]`` if its index is computed.

    Args:
        items: a word, perhaps an index, perhaps a part: ``P[I].X``.
        case: whether capitals make a difference.
    """
    if not items or not is_token(items[0], "WORD"):
        return "", False
    name, rest = str(items[0]) if case else str(items[0]).upper(), items[1:]
    if rest and isinstance(rest[0], Brackets) and rest[0].kind in "[{":
        plain = all(len(part) == 1 and is_token(part[0], "NUMBER") for part in rest[0].parts)
        name, rest = f"{name}[{text_of_items(rest[0].items) if plain else '*'}]", rest[1:]
    is_part = bool(rest) and (is_token(rest[0], "SIGN", ".") or isinstance(rest[0], Brackets))
    return (name, is_part) if not rest or is_part else ("", False)


def calls_in(items: Sequence[Any]) -> Iterator[tuple[str, Brackets]]:
    """Yield the words that stand before round brackets, with these, those within brackets too."""
    for k, item in enumerate(items):
        if isinstance(item, Brackets):
            if item.kind == "(" and k and is_token(items[k - 1], "WORD"):
                yield str(items[k - 1]), item
            yield from calls_in(item.items)


def words_in(items: Sequence[Any], *, case: bool = False) -> Iterator[str]:
    """Yield all words of items, those in brackets too, and the elements of arrays that they name: P and P[3].

    The names of an aggregate's fields are none of them: ``{X A.Z, Y 5}`` has A and Z.
    """
    for k, item in enumerate(items):
        is_index = k > 0 and not isinstance(items[k - 1], Brackets) and items[k - 1].type == "WORD"
        if isinstance(item, Brackets):
            for part in item.parts:
                yield from words_in(part[1:] if item.kind == "{" and not is_index else part, case=case)
        elif item.type == "WORD":
            yield str(item) if case else str(item).upper()
            if k + 1 < len(items) and isinstance(items[k + 1], Brackets) and items[k + 1].kind in "[{":
                yield element_name(items[k : k + 2], case=case)[0]
