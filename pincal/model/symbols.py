"""Symbolic numbers, by which the code of an effect yields its formula.

NumPy calculates with arrays of symbols (dtype ``object``) as with numbers, so the code of an
effect, run once on symbols, yields its formula: predictions and exports share one implementation.
Equal expressions are one object; constants are folded. Code that branches on a comparison is run
for both outcomes, see :func:`either_way`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextvars import ContextVar
from typing import Any
from weakref import WeakValueDictionary

import numpy as np

from pincal.model.cubic import Cubic

# Functions of one argument by NumPy's names, for numbers.
FUNCTIONS: dict[str, Callable[[float], float]] = {
    "sin": math.sin, "cos": math.cos, "tan": math.tan,
    "arcsin": math.asin, "arccos": math.acos, "arctan": math.atan,
    "sinh": math.sinh, "cosh": math.cosh, "tanh": math.tanh, "arcsinh": math.asinh,
    "exp": math.exp, "log": math.log, "sqrt": math.sqrt,
    "fabs": math.fabs, "rint": round, "floor": math.floor,
}  # fmt: skip

# The comparisons assumed true or false in this run of an effect's code.
_SETTLED: ContextVar[tuple[tuple[Symbol, bool], ...]] = ContextVar("settled", default=())
_NODES: WeakValueDictionary[tuple[Any, ...], Symbol] = WeakValueDictionary()


class Symbol:
    """A number that depends on the pose: an operation on others, or an input.

    Attributes:
        operation: "input", "add", "multiply", "divide", "less", "equal", "select", "cubic",
            "hypot", "arctan2" or one of ``FUNCTIONS``.
        operands: symbols and numbers.
        about: the name of an input; the curve of a cubic.
    """

    __slots__ = ("__weakref__", "about", "operands", "operation")

    operation: str
    operands: tuple[Expression, ...]
    about: Any

    def __new__(cls, operation: str, *operands: Expression, about: Any = None) -> Symbol:
        """Return the one symbol of an operation on operands."""
        key = (
            operation,
            about,
            *(id(a) if isinstance(a, Symbol) else float(a).hex() for a in operands),
        )
        found = _NODES.get(key)
        if found is None:
            found = object.__new__(cls)
            found.operation = operation
            found.operands = operands
            found.about = about
            _NODES[key] = found
        return found

    def __repr__(self) -> str:
        return f"Symbol({self.about or self.operation})"

    def __getattr__(self, name: str) -> Callable[[], Expression]:
        # NumPy calls a function of an object array as a method of each element.
        if name not in FUNCTIONS:
            raise AttributeError(name)
        return lambda: apply(name, self)

    def __bool__(self) -> bool:
        answer = _outcome(self)
        if answer is None:
            raise _UndecidedError(self)
        return answer

    def __float__(self) -> float:
        raise TypeError("its code needs a numerical value, not a formula")

    def __add__(self, other: Any) -> Any:
        return _with(other, lambda b: add(self, b))

    __radd__ = __add__

    def __sub__(self, other: Any) -> Any:
        return _with(other, lambda b: add(self, multiply(-1.0, b)))

    def __rsub__(self, other: Any) -> Any:
        return _with(other, lambda a: add(a, multiply(-1.0, self)))

    def __mul__(self, other: Any) -> Any:
        return _with(other, lambda b: multiply(self, b))

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Any:
        return _with(other, lambda b: divide(self, b))

    def __rtruediv__(self, other: Any) -> Any:
        return _with(other, lambda a: divide(a, self))

    def __pow__(self, power: Any) -> Any:
        if float(power) == 0.5:
            return apply("sqrt", self)
        if float(power) not in (1.0, 2.0, 3.0, 4.0):
            raise TypeError(f"power {power}; expected 1, 2, 3, 4 or 0.5")
        product: Expression = self
        for _ in range(int(power) - 1):
            product = multiply(product, self)
        return product

    def __neg__(self) -> Any:
        return multiply(-1.0, self)

    def __abs__(self) -> Any:
        return apply("fabs", self)

    def __lt__(self, other: Any) -> Any:
        return _with(other, lambda b: less(self, b))

    def __gt__(self, other: Any) -> Any:
        return _with(other, lambda b: less(b, self))

    def __le__(self, other: Any) -> Any:
        return _with(other, lambda b: not less(b, self))

    def __ge__(self, other: Any) -> Any:
        return _with(other, lambda b: not less(self, b))

    def __eq__(self, other: object) -> Any:
        return _with(other, lambda b: self is b or Symbol("equal", self, b))

    def __ne__(self, other: object) -> Any:
        return _with(other, lambda b: self is not b and not Symbol("equal", self, b))

    __hash__ = object.__hash__

    def hypot(self, other: Any) -> Any:
        """Return the length of the hypotenuse."""
        return Symbol("hypot", self, scalar(other))

    def arctan2(self, other: Any) -> Any:
        """Return the angle of the point (other, self)."""
        return Symbol("arctan2", self, scalar(other))


Expression = float | Symbol


class _UndecidedError(Exception):
    """An effect's code branches on a comparison that depends on the pose."""

    def __init__(self, comparison: Symbol) -> None:
        super().__init__("its code branches on a comparison")
        self.comparison = comparison


def _outcome(comparison: Symbol) -> bool | None:
    """Return whether a comparison holds, if the settled ones imply it; what equals one number
    equals no other.
    """
    for settled, holds in _SETTLED.get():
        if settled is comparison:
            return holds
        if holds and settled.operation == comparison.operation == "equal":
            x, a = settled.operands
            y, b = comparison.operands
            if x is y and not isinstance(a, Symbol) and not isinstance(b, Symbol):
                return a == b
    return None


def scalar(value: Any) -> Expression:
    """Return a symbol unchanged, anything else as a float."""
    return value if isinstance(value, Symbol) else float(value)


def _with(other: Any, operation: Callable[[Expression], Any]) -> Any:
    return NotImplemented if isinstance(other, np.ndarray) else operation(scalar(other))


def apply(function: str, x: Expression) -> Expression:
    """Return one of ``FUNCTIONS`` of a number or symbol."""
    return Symbol(function, x) if isinstance(x, Symbol) else float(FUNCTIONS[function](x))


def add(a: Expression, b: Expression) -> Expression:
    """Return the sum."""
    if not isinstance(a, Symbol):
        if not isinstance(b, Symbol):
            return a + b
        a, b = b, a
    if not isinstance(b, Symbol):
        return a if b == 0.0 else Symbol("add", a, b)
    if (
        a.operation == b.operation == "cubic"
        and a.operands[0] is b.operands[0]
        and a.about.fits(b.about)
    ):
        return Symbol("cubic", a.operands[0], about=a.about.plus(b.about))
    return Symbol("add", a, b)


def multiply(a: Expression, b: Expression) -> Expression:
    """Return the product, which is 0.0 if a factor is zero."""
    if not isinstance(a, Symbol):
        if not isinstance(b, Symbol):
            return a * b
        a, b = b, a
    if isinstance(b, Symbol):
        return Symbol("multiply", a, b)
    if b in (0.0, 1.0):
        return a if b else 0.0
    if a.operation == "cubic":
        return Symbol("cubic", a.operands[0], about=a.about.scaled(b))
    return Symbol("multiply", a, b)


def divide(a: Expression, b: Expression) -> Expression:
    """Return the quotient."""
    if not isinstance(a, Symbol) and not isinstance(b, Symbol):
        return a / b
    return 0.0 if not isinstance(a, Symbol) and a == 0.0 else Symbol("divide", a, b)


def less(a: Expression, b: Expression) -> bool | Symbol:
    """Return whether a < b."""
    return Symbol("less", a, b) if isinstance(a, Symbol) or isinstance(b, Symbol) else a < b


def select(comparison: bool | Symbol, yes: Expression, no: Expression) -> Expression:
    """Return one of two values by a comparison."""
    if not isinstance(comparison, Symbol):
        return yes if comparison else no
    same = yes is no or (not isinstance(yes, Symbol) and not isinstance(no, Symbol) and yes == no)
    return yes if same else Symbol("select", comparison, yes, no)


def cubic(curve: Cubic, x: Expression) -> Expression:
    """Return the value of a curve."""
    return Symbol("cubic", x, about=curve) if isinstance(x, Symbol) else curve(x)


def held(x: np.ndarray, lower: float, upper: float) -> np.ndarray:
    """Return numbers or symbols clipped to a range."""
    if not are_symbols(x):
        return np.asarray(np.clip(x, lower, upper))
    out = np.empty_like(x)
    for place, value in np.ndenumerate(x):
        out[place] = select(less(value, lower), lower, select(less(upper, value), upper, value))
    return out


def symbols(*names: str) -> np.ndarray:
    """Return inputs as an array, shape (number of names,)."""
    out = np.empty(len(names), object)
    out[:] = [Symbol("input", about=name) for name in names]
    return out


def are_symbols(values: np.ndarray) -> bool:
    """Return whether an array may hold symbols."""
    return values.dtype == object


def either_way(code: Callable[[], dict[int, Any]]) -> dict[int, Any]:
    """Return the results by index of code, run for both outcomes of each comparison that it
    branches on.

    An index that is missing stands for zero.
    """
    try:
        return code()
    except _UndecidedError as error:
        asked = error.comparison
    yes, no = (_with_outcome(code, asked, answer) for answer in (True, False))
    places = dict.fromkeys((*yes, *no))
    return {place: select(asked, yes.get(place, 0.0), no.get(place, 0.0)) for place in places}


def _with_outcome(
    code: Callable[[], dict[int, Any]], comparison: Symbol, answer: bool
) -> dict[int, Any]:
    token = _SETTLED.set((*_SETTLED.get(), (comparison, answer)))
    try:
        return either_way(code)
    finally:
        _SETTLED.reset(token)
