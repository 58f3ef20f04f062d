"""The text of a program as a tree of tokens with their positions, by a grammar of its language.

Bytes are decoded one to one as characters, so that a position in the text is a position in the file
whatever its encoding. Three of the languages share a grammar: statements of words, numbers, strings
and symbols, nested in brackets; each language adds its tokens and the ends of its statements. Its
module interprets the statements.
"""

from __future__ import annotations

import bisect
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, ClassVar

from pincal.errors import ProgramError, needed
from pincal.thresholds import Count

if TYPE_CHECKING:
    from lark import Lark, Token

# No program is larger [bytes].
LARGEST_PROGRAM: Count = 50_000_000
# Words, numbers and signs of one program, and brackets within brackets; reading takes 10 us each.
MOST_WORDS: Count = 1_000_000
DEEPEST: Count = 100
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
# Appended to the last statement.
_END_OF_FILE = "\n\x04"
_PAIRS = {"(": ")", "[": "]", "{": "}"}


@dataclass(frozen=True)
class Number:
    """A number in a program: its value, its position, and its text."""

    value: float
    start: int
    end: int
    text: str

    @property
    def decimals(self) -> int:
        """Number of decimal places."""
        return len(self.text.lower().partition("e")[0].partition(".")[2])


@dataclass(frozen=True)
class Brackets:
    """A pair of brackets and its content."""

    kind: str
    items: tuple[Any, ...]
    start_pos: int
    end_pos: int
    type: ClassVar[str] = "BRACKETS"

    @cached_property
    def parts(self) -> list[tuple[Any, ...]]:
        """The items between commas."""
        return split(self.items)


@dataclass(frozen=True)
class Statement:
    """One statement: its items (tokens and brackets) and its position."""

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
            raise ProgramError(
                f"{self.name}: {len(self.content)} bytes; expected a program of at most "
                f"{LARGEST_PROGRAM}"
            )
        if b"\0" in self.content:
            raise self.error(
                "a zero byte; expected text in ASCII, Latin-1 or UTF-8", self.content.index(b"\0")
            )
        text = self.content.decode("latin-1")
        # No token is shorter than a byte.
        count = sum(1 for _ in re.finditer(r"\w+|[^\w\s]", text)) if len(text) > MOST_WORDS else 0
        if count > MOST_WORDS:
            raise ProgramError(
                f"{self.name}: {count} words, numbers and signs; expected a program of at most "
                f"{MOST_WORDS}: divide it"
            )
        return "   " + text[3:] if text.startswith("\xef\xbb\xbf") else text

    def place(self, at: int) -> tuple[int, int]:
        """Return line and column, from 1, of a position in the text."""
        line = bisect.bisect_right(self._lines, at)
        return line, at - self._lines[line - 1] + 1

    @cached_property
    def _lines(self) -> list[int]:
        """Positions at which lines begin."""
        text = self.content.replace(b"\r\n", b" \n").replace(b"\r", b"\n")
        return [0, *(k + 1 for k, byte in enumerate(text) if byte == 10)]

    def error(self, what: str, at: int) -> ProgramError:
        """Return an error that names line and column of a position in the text."""
        line, column = self.place(at)
        return ProgramError(f"{self.name}, line {line}, column {column}: {what}")

    def parse(self, grammar: str, words: str, *, part: tuple[int, int] | None = None) -> Any:
        """Return lark's tree of the text by a grammar.

        Args:
            grammar: the grammar.
            words: what is expected of the file, for messages.
            part: start and end of the text to be read; default: all. Tokens of a part have no valid
                line numbers.

        Raises:
            ProgramError: if the text does not match the grammar: truncated, or another dialect.
        """
        text = self.text if part is None else " " * part[0] + self.text[part[0] : part[1]]
        with needed("lark", "programs of controllers", error=ProgramError):
            from lark.exceptions import UnexpectedCharacters, UnexpectedInput, UnexpectedToken
        try:
            return parser_of(grammar).parse(text + _END_OF_FILE)
        except UnexpectedInput as error:
            at = min(
                error.pos_in_stream if error.pos_in_stream is not None else len(text), len(text)
            )
            is_end = isinstance(error, UnexpectedToken) and error.token.type == "$END"
            if is_end or at == len(text):
                raise self.error(
                    f"the end of the file; expected more of {words}: is it truncated?", len(text)
                ) from None
            is_character = isinstance(error, UnexpectedCharacters)
            found = text[at] if is_character else str(error.token)  # type: ignore[attr-defined]
            raise self.error(f"{found[:30]!r}; expected {words}", at) from None

    def statements(self, tokens: str, words: str, *, over_lines: bool = False) -> list[Statement]:
        """Return the statements of a language of nested brackets.

        Args:
            tokens: the language's own terminals.
            words: what is expected of the file, for messages.
            over_lines: whether brackets may contain what ends statements outside them.
        """
        # Read in one pass; the parser, some ten times slower, says what is not as expected.
        fast = self._fast_statements(nested(tokens, over_lines=over_lines), over_lines=over_lines)
        if fast is not None:
            return fast
        found = []
        for tree in self.parse(nested(tokens, over_lines=over_lines), words).children:
            items = tuple(self._items(tree.children, words))
            if items:
                start, end = place_of(items)
                line = self.place(start)[0] if isinstance(items[0], Brackets) else items[0].line
                found.append(Statement(items, start, end, line or 0))
        return found

    def _tokens(self, grammar: str) -> Iterator[Token | None]:
        """Yield the tokens of the text by the terminals of a grammar, None for anything else."""
        with needed("lark", "programs of controllers", error=ProgramError):
            from lark import Token
        lexer: Any = parser_of(grammar).parser.lexer
        terminals = [(one.name, one.pattern.to_regexp()) for one in lexer.root_lexer.terminals]
        pattern = re.compile("|".join(f"(?P<{name}>{pattern})" for name, pattern in terminals))
        text = self.text + _END_OF_FILE
        lines = [match.start() for match in re.finditer("\n", text)]
        at = 0
        while at < len(text):
            match = pattern.match(text, at)
            if match is None or match.end() == at:
                yield None
                return
            kind = match.lastgroup or ""
            if kind not in lexer.root_lexer.ignore_types:
                line = bisect.bisect_left(lines, at) + 1
                yield Token(kind, match.group(), at, line, end_pos=match.end())
            at = match.end()

    def _fast_statements(self, grammar: str, *, over_lines: bool) -> list[Statement] | None:
        """Return the statements of a text; None if it is not one of the grammar throughout."""
        statements = list[Statement]()
        items = list[Any]()
        outer: list[tuple[list[Any], Token]] = []
        for token in self._tokens(grammar):
            if token is None or (token.type == "_END" and outer and not over_lines):
                return None
            if token.type == "_END":
                if items and not outer:
                    start, end = place_of(items)
                    line = self.place(start)[0] if isinstance(items[0], Brackets) else items[0].line
                    statements.append(Statement(tuple(items), start, end, line))
                    items = []
            elif token.type == "OPEN" and len(outer) < DEEPEST:
                outer.append((items, token))
                items = []
            elif token.type == "CLOSE" and outer and _PAIRS[outer[-1][1]] == token:
                before, first = outer.pop()
                end = token.end_pos or 0
                before.append(Brackets(str(first), tuple(items), first.start_pos or 0, end))
                items = before
            elif token.type in ("OPEN", "CLOSE"):
                return None
            else:
                items.append(token)
        return None if outer or items else statements

    def _items(self, children: Iterable[Any], words: str, depth: int = 0) -> Iterator[Any]:
        for child in children:
            if isinstance(child, str):
                yield child
                continue
            first, *inner, last = child.children
            if depth == DEEPEST:
                raise self.error(
                    f"brackets within {DEEPEST} others; expected fewer in {words}", first.start_pos
                )
            if _PAIRS[first] != last:
                raise self.error(
                    f"{str(last)!r}; expected {_PAIRS[first]!r} in {words}", last.start_pos
                )
            yield Brackets(
                str(first),
                tuple(self._items(inner, words, depth + 1)),
                first.start_pos,
                last.end_pos,
            )


def nested(tokens: str, *, over_lines: bool = False) -> str:
    """Return the grammar of a language of nested brackets with these tokens."""
    return (
        _NESTED.replace("_inner: _item", "_inner: _item | _END" if over_lines else "_inner: _item")
        + tokens
    )


@lru_cache(8)
def parser_of(grammar: str) -> Lark:
    """Return the parser of a grammar."""
    from lark import Lark

    return Lark(grammar, parser="lalr", lexer="contextual", propagate_positions=True)


def place_of(items: Sequence[Any]) -> tuple[int, int]:
    """Return start and end of items, at least one, in the text."""
    return items[0].start_pos, items[-1].end_pos


def split(items: Iterable[Any], sign: str = ",") -> list[tuple[Any, ...]]:
    """Return the items between occurrences of a sign."""
    parts: list[list[Any]] = [[]]
    for item in items:
        if item.type == "SIGN" and item == sign:
            parts.append([])
        else:
            parts[-1].append(item)
    return [tuple(part) for part in parts]


def number_of(items: Sequence[Any]) -> Number | None:
    """Return the number that items form, with its sign; None if they form something else."""
    if (
        len(items) == 2
        and is_token(items[0], "SIGN", "+", "-")
        and items[0].end_pos == items[1].start_pos
    ):
        sign = str(items[0])
        number = items[1]
    elif len(items) == 1:
        sign = ""
        number = items[0]
    else:
        return None
    if not is_token(number, "NUMBER"):
        return None
    value = float(sign + str(number))
    start = items[0].start_pos
    return (
        Number(value, start, number.end_pos, sign + str(number)) if math.isfinite(value) else None
    )


def number_at(token: Token) -> Number | None:
    """Return the number of a token in a grammar with signed numbers; None if it is
    something else.
    """
    text = str(token)
    try:
        return Number(float(text), token.start_pos or 0, token.end_pos or 0, text)
    except ValueError:
        return None


def numbers_of(parts: Sequence[Sequence[Any]]) -> tuple[Number, ...] | None:
    """Return the numbers that parts form; None if one of them is something else."""
    found = [number_of(part) for part in parts]
    return tuple(number for number in found if number is not None) if None not in found else None


def aggregate(items: Sequence[Any], kind: str) -> Brackets | None:
    """Return the only item if it is a pair of brackets of a kind, else None."""
    return (
        items[0]
        if len(items) == 1 and isinstance(items[0], Brackets) and items[0].kind == kind
        else None
    )


def call_of(items: Sequence[Any]) -> tuple[str, Brackets] | None:
    """Return name and arguments of the call that items form, None if they form none."""
    if (
        len(items) == 2
        and is_token(items[0], "WORD")
        and isinstance(items[1], Brackets)
        and items[1].kind == "("
    ):
        return str(items[0]), items[1]
    return None


def is_token(item: Any, kind: str, text: str = "", other: str = "") -> bool:
    """Return whether an item is a token of a kind and, if texts are given, spells one of them in
    any case.
    """
    return bool(item.type == kind) and (not text or str(item).upper() in (text, other))


def word(item: Any) -> str:
    """Return an item in capitals if it is a word, else ""."""
    return str(item).upper() if is_token(item, "WORD") else ""


def text_of_items(items: Iterable[Any], *, case: bool = False) -> str:
    """Return the text of items without blanks and, unless case is significant, in capitals: ``P [ 3
    ]`` is P[3].
    """
    found = ""
    for item in items:
        if isinstance(item, Brackets):
            found += item.kind + text_of_items(item.items, case=case) + _PAIRS[item.kind]
        else:
            found += str(item) if case else str(item).upper()
    return found


def element_name(items: Sequence[Any], *, case: bool = False) -> tuple[str, bool]:
    """Return the name that items spell, "" if they spell none, and whether they refer to a
    component of it only.

    An element of an array is ``P[3]``, or ``P[*]`` if its index is computed.

    Args:
        items: a word, optionally an index, optionally a component: ``P[I].X``.
        case: whether names are case-sensitive.
    """
    if not items or not is_token(items[0], "WORD"):
        return "", False
    name = str(items[0]) if case else str(items[0]).upper()
    rest = items[1:]
    if rest and isinstance(rest[0], Brackets) and rest[0].kind in "[{":
        plain = all(len(part) == 1 and is_token(part[0], "NUMBER") for part in rest[0].parts)
        name = f"{name}[{text_of_items(rest[0].items) if plain else '*'}]"
        rest = rest[1:]
    is_part = bool(rest) and (is_token(rest[0], "SIGN", ".") or isinstance(rest[0], Brackets))
    return (name, is_part) if not rest or is_part else ("", False)


def calls_in(items: Sequence[Any]) -> Iterator[tuple[str, Brackets]]:
    """Yield each word before round brackets with these brackets, at any depth."""
    for k, item in enumerate(items):
        if isinstance(item, Brackets):
            if item.kind == "(" and k and is_token(items[k - 1], "WORD"):
                yield str(items[k - 1]), item
            yield from calls_in(item.items)


def words_in(items: Sequence[Any], *, case: bool = False) -> Iterator[str]:
    """Yield all words of items at any depth, and the array elements that they name: both P and
    P[3].

    The field names of an aggregate are left out: ``{X A.Z, Y 5}`` yields A and Z.
    """
    for k, item in enumerate(items):
        is_index = k > 0 and items[k - 1].type == "WORD"
        if isinstance(item, Brackets):
            for part in item.parts:
                yield from words_in(
                    part[1:] if item.kind == "{" and not is_index else part, case=case
                )
        elif item.type == "WORD":
            yield str(item) if case else str(item).upper()
            if (
                k + 1 < len(items)
                and isinstance(items[k + 1], Brackets)
                and items[k + 1].kind in "[{"
            ):
                yield element_name(items[k : k + 2], case=case)[0]
