"""Formulas as the statements of a programming language: what is used twice is calculated once, in order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from pincal.model.cubic import Cubic
from pincal.model.symbols import Expression, Symbol

# How tightly an operation binds: what stands in another one that binds more tightly gets brackets.
_SELECT, _COMPARISON, _SUM, _PRODUCT, _SIGN, _ATOM = range(6)
_INFIX = {
    "add": ("{} + {}", _SUM, (_SUM, _SUM)),
    "subtract": ("{} - {}", _SUM, (_SUM, _PRODUCT)),
    "multiply": ("{} * {}", _PRODUCT, (_PRODUCT, _PRODUCT)),
    "divide": ("{} / {}", _PRODUCT, (_PRODUCT, _SIGN)),
    "negate": ("-{}", _SIGN, (_ATOM,)),
    "less": ("{} < {}", _COMPARISON, (_SUM, _SUM)),
    "equal": ("{} == {}", _COMPARISON, (_SUM, _SUM)),
}
# An expression longer than this gets a statement of its own.
_LONG = 90


@dataclass(frozen=True)
class Language:
    """How a language writes what it does not write as all do.

    Attributes:
        statement: a named value, of the name and its expression.
        functions: the language's names of operations, where they differ.
        select: the choice of one of two values, of comparison, value if it holds, value if not.
        is_select_atom: whether a choice needs no brackets in other expressions.
        input: an input of the formulas, of its name.
        curve: the value of a piecewise cubic, of its number, the curve and where.
    """

    statement: str
    functions: dict[str, str]
    select: str
    is_select_atom: bool
    input: Callable[[str], str]
    curve: Callable[[int, Cubic, str], str]


@dataclass
class Writer:
    """Writes formulas that share their parts.

    Attributes:
        language: the language.
        curves: the piecewise cubics that were written, by their numbers.
    """

    language: Language
    uses: Counter[int]
    curves: list[Cubic] = field(default_factory=list)
    _texts: dict[int, tuple[str, int]] = field(default_factory=dict)
    _named: int = 0

    @classmethod
    def of(cls, language: Language, formulas: Sequence[Expression]) -> Writer:
        """Return the writer of formulas, which are then written part by part."""
        uses = Counter(id(root) for root in formulas)
        for node in _in_order(formulas):
            uses.update(id(operand) for operand in _seen(node)[1])
        return cls(language, uses)

    def statements(self, formulas: Sequence[Expression]) -> tuple[list[str], list[str]]:
        """Return the statements that are still needed for some of the formulas, and an expression for each of these."""
        lines = []
        for node in _in_order(formulas):
            if id(node) in self._texts:
                continue
            text, level = self._expression(node)
            if node.operation != "input" and (self.uses[id(node)] > 1 or len(text) > _LONG):
                name = f"v{self._named}"
                self._named += 1
                lines.append(self.language.statement.format(name, text))
                text, level = name, _ATOM
            self._texts[id(node)] = text, level
        return lines, [self._text(formula, _SELECT) for formula in formulas]

    def _expression(self, node: Symbol) -> tuple[str, int]:
        operation, operands = _seen(node)
        language = self.language
        if operation == "input":
            return language.input(node.about), _ATOM
        if operation in _INFIX:
            text, level, levels = _INFIX[operation]
            return text.format(*(self._text(o, at) for o, at in zip(operands, levels, strict=True))), level
        if operation == "select":
            text = language.select.format(*(self._text(o, _COMPARISON) for o in operands))
            return text, _ATOM if language.is_select_atom else _SELECT
        if operation == "cubic":
            if node.about not in self.curves:
                self.curves.append(node.about)
            where = self._text(operands[0], _SELECT)
            return language.curve(self.curves.index(node.about), node.about, where), _ATOM
        name = language.functions.get(operation, operation)
        return f"{name}({', '.join(self._text(o, _SELECT) for o in operands)})", _ATOM

    def _text(self, value: Expression, level: int) -> str:
        text, own = self._texts[id(value)] if isinstance(value, Symbol) else (repr(float(value)), _ATOM)
        return f"({text})" if own < level or (level == _ATOM and text.startswith("-")) else text


WrittenPart = tuple[list[str], list[str]]
"""Statements, and an expression for each formula."""


def written(
    language: Language, moments: Sequence[Expression], pose: Sequence[Expression], columns: Sequence[Expression]
) -> tuple[WrittenPart, WrittenPart, WrittenPart, list[Cubic]]:
    """Return moments, pose and columns in a language, and the curves that they need; what pose and columns share is once."""
    first, last = Writer.of(language, moments), Writer.of(language, (*pose, *columns))
    last.curves = first.curves
    return first.statements(moments), last.statements(pose), last.statements(columns), last.curves


def _seen(node: Symbol) -> tuple[str, tuple[Any, ...]]:
    """Return operation and operands as they are written: a sum with a negative part as a difference."""
    if node.operation == "multiply" and _is_minus_one(node.operands[1]):
        return "negate", node.operands[:1]
    if node.operation == "add":
        a, b = node.operands
        for first, second in ((a, b), (b, a)):
            if not isinstance(second, Symbol):
                return ("subtract", (first, -second)) if second < 0.0 else ("add", (first, second))
            if second.operation == "multiply" and _is_minus_one(second.operands[1]):
                return "subtract", (first, second.operands[0])
    return node.operation, node.operands


def _is_minus_one(value: Expression) -> bool:
    return not isinstance(value, Symbol) and value == -1.0


def _in_order(formulas: Sequence[Expression]) -> Iterator[Symbol]:
    """Yield the symbols of formulas, each once and after its operands."""
    done: set[int] = set()
    ahead: list[tuple[Expression, bool]] = [(formula, False) for formula in reversed(formulas)]
    while ahead:
        node, is_ready = ahead.pop()
        if not isinstance(node, Symbol) or id(node) in done:
            continue
        if is_ready:
            done.add(id(node))
            yield node
        else:
            ahead.append((node, True))
            ahead += [(operand, False) for operand in reversed(_seen(node)[1])]
