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
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, ClassVar

from pincal.errors import ProgramError, needed
from pincal.thresholds import Count

if TYPE_CHECKING:
    from lark import Lark
    from lark import Token as ParsedToken

# No program is larger [bytes].
LARGEST_PROGRAM: Count = 50_000_000
# Words, numbers and signs of one program, which take some 10 us each: 50 000 points have two to
# five million. Brackets within brackets.
MOST_WORDS: Count = 10_000_000
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


class Token(str):
    """A word, a number, a text or a sign of a program, its line, and its position.

    Attributes:
        type: its terminal in the grammar.
        start_pos: where it begins in the text.
        line: its line, from 1.
    """

    __slots__ = ("line", "start_pos", "type")

    type: str
    start_pos: int
    line: int

    @classmethod
    def at(cls, kind: str, text: str, start: int, line: int) -> Token:
        """Return the token of a text at a position."""
        token = cls(text)
        token.type = kind
        token.start_pos = start
        token.line = line
        return token

    @property
    def end_pos(self) -> int:
        """Where it ends in the text."""
        return self.start_pos + len(self)


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

    def truncated(self, words: str) -> ProgramError:
        """Return the error of a text that ends before what is expected of it."""
        what = f"the end of the file; expected more of {words}: is it truncated?"
        return self.error(what, len(self.text))

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
                raise self.truncated(words) from None
            is_character = isinstance(error, UnexpectedCharacters)
            found = text[at] if is_character else str(error.token)  # type: ignore[attr-defined]
            raise self.error(f"{found[:30]!r}; expected {words}", at) from None

    def statements(self, tokens: str, words: str, *, over_lines: bool = False) -> list[Statement]:
        """Return the statements of a language of nested brackets.

        They are read in one pass: the parser of :meth:`parse` would take ten times as long.

        Args:
            tokens: the language's own terminals.
            words: what is expected of the file, for messages.
            over_lines: whether brackets may contain what ends statements outside them.

        Raises:
            ProgramError: if the text does not match the grammar.
        """
        reader = _Nesting(self, words, over_lines)
        for token in self._tokens(nested(tokens, over_lines=over_lines), words):
            reader.take(token)
        return reader.finish()

    def _tokens(self, grammar: str, words: str) -> Iterator[Token]:
        """Yield the tokens of the text by the terminals of a grammar."""
        with needed("lark", "programs of controllers", error=ProgramError):
            lexer: Any = parser_of(grammar).parser.lexer.root_lexer
        terminals = [(one.name, one.pattern.to_regexp()) for one in lexer.terminals]
        pattern = re.compile("|".join(f"(?P<{name}>{pattern})" for name, pattern in terminals))
        text = self.text + _END_OF_FILE
        ends = [match.start() for match in re.finditer("\n", text)]
        at = 0
        line = 0
        for match in pattern.finditer(text):
            if match.start() != at:
                break
            kind = match.lastgroup or ""
            if kind not in lexer.ignore_types:
                while line < len(ends) and ends[line] < at:
                    line += 1
                yield Token.at(kind, match.group(), at, line + 1)
            at = match.end()
        if at < len(text):
            raise self.error(f"{text[at]!r}; expected {words}", at)


@dataclass
class _Nesting:
    """The statements of a text, and the brackets that are open, while its tokens are read.

    Attributes:
        source: the text.
        words: what is expected of it, for messages.
        over_lines: whether brackets may contain what ends statements outside them.
        statements: those that are complete.
        items: of the innermost open bracket, or of the statement.
        outer: for each open bracket the items before it, and the bracket.
    """

    source: Source
    words: str
    over_lines: bool
    statements: list[Statement] = field(default_factory=list)
    items: list[Any] = field(default_factory=list)
    outer: list[tuple[list[Any], Token]] = field(default_factory=list)

    def take(self, token: Token) -> None:
        """Take the next token."""
        if token.type == "_END":
            self._end(token)
        elif token.type == "OPEN":
            self._open(token)
        elif token.type == "CLOSE":
            self._close(token)
        else:
            self.items.append(token)

    def finish(self) -> list[Statement]:
        """Return the statements."""
        if self.outer or self.items:
            raise self.source.truncated(self.words)
        return self.statements

    def _end(self, token: Token) -> None:
        if self.outer:
            if not self.over_lines:
                raise self._unexpected(token)
            return
        if self.items:
            first = self.items[0]
            start, end = place_of(self.items)
            line = self.source.place(start)[0] if isinstance(first, Brackets) else first.line
            self.statements.append(Statement(tuple(self.items), start, end, line))
            self.items = []

    def _open(self, token: Token) -> None:
        if len(self.outer) == DEEPEST:
            raise self.source.error(
                f"brackets within {DEEPEST} others; expected fewer in {self.words}", token.start_pos
            )
        self.outer.append((self.items, token))
        self.items = []

    def _close(self, token: Token) -> None:
        if not self.outer:
            raise self._unexpected(token)
        before, first = self.outer.pop()
        if _PAIRS[first] != token:
            raise self.source.error(
                f"{str(token)!r}; expected {_PAIRS[first]!r} in {self.words}", token.start_pos
            )
        before.append(Brackets(str(first), tuple(self.items), first.start_pos, token.end_pos))
        self.items = before

    def _unexpected(self, token: Token) -> ProgramError:
        if token.start_pos >= len(self.source.text):
            return self.source.truncated(self.words)
        return self.source.error(f"{str(token)[:30]!r}; expected {self.words}", token.start_pos)


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

    return Lark(grammar, parser="lalr", lexer="contextual")


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


def number_at(token: ParsedToken) -> Number | None:
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
