"""The calibrated model as formulas of joint positions and conditions, and these as statements of a
programming language.

Common subexpressions are evaluated once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from pincal.calibration.fitted_robot import FittedRobot
from pincal.errors import BadInputError
from pincal.model import walk
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.cubic import Cubic
from pincal.model.effect import Effect
from pincal.model.model import Model
from pincal.model.symbols import Expression, Symbol, either_way, multiply, scalar, symbols
from pincal.parameters import thin_root_of
from pincal.recorded import RECORDABLE
from pincal.robot.robot import Robot
from pincal.thresholds import Count, Scale

# Motions by displacements of parameters, relative to the largest, below which poses tell nothing of
# them.
_SEEN: Scale = 1e-6


@dataclass(frozen=True)
class Spread:
    """How uncertain a calibrated model is.

    Attributes:
        parameters: indices of its F uncertain parameters.
        root: shape (F + n, r), displacements of these and of the n drives by r independent errors
            of unit variance.
        rest: variance of a coordinate beside these [m^2].
    """

    parameters: tuple[int, ...]
    root: np.ndarray
    rest: float

    @property
    def is_known(self) -> bool:
        """Whether there is any."""
        return bool(np.any(self.root)) or self.rest > 0.0

    def of_uncertain(self, motions: Sequence[np.ndarray]) -> tuple[Expression, ...]:
        """Return the entries of the motions of the uncertain parameters and of the drives, of those
        of all parameters and then of the drives.
        """
        n = len(self.root) - len(self.parameters)
        chosen = [*(motions[p] for p in self.parameters), *motions[len(motions) - n :]]
        return tuple(entry for motion in chosen for entry in motion)

    def with_exact_motions(self, formulas: np.ndarray, exact: np.ndarray) -> Spread:
        """Return the spread by which motions by formulas are those by which the exact ones are
        without it, as nearly as constant displacements can.

        Formulas neglect that a load bends an arm otherwise where parameters differ. Parameters of
        parallel axes have opposite errors of a millimetre that nobody sees, and what the load makes
        of these is seen: other parameters take it.

        Args:
            formulas: shape (N, 3, F), motion of the target by a unit of each uncertain parameter,
                by the formulas.
            exact: shape (N, 3, F), by the model.
        """
        n = len(self.parameters)
        root = self.root.copy()
        sizes = np.linalg.norm(root[:n], axis=1)
        lacking = (exact - formulas).reshape(-1, n) @ root[:n]
        by_sizes = (formulas * sizes).reshape(-1, n)
        root[:n] += sizes[:, None] * np.linalg.lstsq(by_sizes, lacking, rcond=_SEEN)[0]
        return replace(self, root=root)

    def rows(self) -> list[list[str]]:
        """Return the rows of the root as numbers in any language."""
        return [[f"{value:.9g}" for value in row] for row in self.root]

    @classmethod
    def of(cls, calibrated: FittedRobot) -> Spread:
        """Return that of a calibrated model."""
        uncertainty = calibrated.uncertainty
        C = uncertainty.covariance
        some = np.flatnonzero(np.diag(C) > 0.0)
        n = calibrated.model.chain.robot.n_joints
        lacks = uncertainty.discrepancy
        drives = np.zeros(n) if lacks is None else lacks.factor**2 * lacks.drives.sum(axis=1)
        root = block_diag(thin_root_of(C[np.ix_(some, some)]), np.diag(np.sqrt(drives)))
        rest = 0.0 if lacks is None else lacks.factor**2 * lacks.rest
        return cls(tuple(map(int, some)), root, rest + uncertainty.arrival)


@dataclass(frozen=True)
class Formulas:
    """A calibrated model in formulas.

    Attributes:
        calibrated: the model.
        moments: the static moments as functions of the inputs and of themselves, if they are taken
            on the deflected arm; else empty.
        pose: the target's rotation and translation in the instrument's frame, row by row, 12
            entries.
        columns: translation (3) and rotation (3) of the target by each of the m independent joints,
            row by row, 6 m entries.
        motions: how the F uncertain parameters, and then the n drives, move the target, three
            entries each.
        spread: how uncertain these are.
    """

    calibrated: FittedRobot
    moments: tuple[Expression, ...]
    pose: tuple[Expression, ...]
    columns: tuple[Expression, ...]
    motions: tuple[Expression, ...]
    spread: Spread

    @property
    def joints(self) -> np.ndarray:
        """Indices of the m joints whose positions are inputs, without mimic joints."""
        return self.calibrated.model.chain.robot.own_joints

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the columns of conditions, and "target", that the pose depends on."""
        found = set()
        seen = set()
        ahead: list[Any] = [*self.moments, *self.pose]
        while ahead:
            node = ahead.pop()
            if isinstance(node, Symbol) and id(node) not in seen:
                seen.add(id(node))
                ahead += node.operands
                found |= {node.about.split("[")[0]} if node.operation == "input" else set()
        return tuple(name for name in (*RECORDABLE, "target") if name in found)


def formulas_of(calibrated: FittedRobot) -> Formulas:
    """Return the formulas of a calibrated model, traced through the code of its effects.

    Raises:
        BadInputError: naming what can't be expressed as a formula: an effect, or closed loops.
    """
    model = calibrated.model
    values = calibrated.model_values
    chain = model.chain
    n = model.chain.robot.n_joints
    layout = model.layout(values)
    at = _symbolic_conditions(chain, calibrated.payload_centre)
    bends = any(effect.uses_moments for effect in model.effects)
    rigid = _coordinates(model, values, conditions=at, moments=None)
    moments: tuple[Expression, ...] = ()
    x = rigid
    taken: np.ndarray | None = None
    if bends:
        known = symbols(*(f"moments[{i}]" for i in range(3 * n)))
        on_straight = walk.symbolic_moments(layout, rigid, at.payload[0], at.payload_centre)
        taken = (known if model.equilibrium else np.array(on_straight, object))[None]
        x = _coordinates(model, values, conditions=at, moments=taken)
        if model.equilibrium:
            moments = tuple(walk.symbolic_moments(layout, x, at.payload[0], at.payload_centre))
    tool = _by_target(chain.tool_rotations, at.target[0])
    pose, by_coordinates = walk.tip_pose(layout, x, tool, list(range(len(x))))
    spread = Spread.of(calibrated)
    motions = _motions(model, at, taken, by_coordinates[:3])
    return Formulas(
        calibrated,
        moments,
        tuple(pose.ravel()),
        tuple(_by_joints(chain, by_coordinates).ravel()),
        spread.of_uncertain(motions),
        spread,
    )


def _by_joints(chain: Chain, by_coordinates: np.ndarray) -> np.ndarray:
    """Return the motion by the m independent joints, shape (6, m), of that by the K coordinates,
    shape (6, K).
    """
    robot = chain.robot
    columns = robot.gathered(by_coordinates[:, chain.drives])
    own = robot.own_joints
    if robot.couplings:
        columns = columns @ robot.combination[np.ix_(own, own)]
    return columns


def _motions(
    model: Model, conditions: Conditions, moments: np.ndarray | None, levers: np.ndarray
) -> list[np.ndarray]:
    """Return how each parameter, and then each drive, moves the target, shape (3,) each, for the
    motions by the K coordinates, shape (3, K).

    That a load bends an arm otherwise where a parameter differs is neglected.
    """
    found: list[np.ndarray] = []
    for effect in model.effects:
        of_effect = [np.zeros(3, object) for _ in effect.parameters(model.chain)]
        for at, basis in _bases(effect, model.chain, conditions, moments).items():
            parameter, k = divmod(at, model.chain.size)
            of_effect[parameter] = of_effect[parameter] + np.array(
                [multiply(entry, basis) for entry in levers[:, k]], object
            )
        found += of_effect
    return [*found, *(levers[:, k] for k in model.chain.drives)]


def _bases(
    effect: Effect, chain: Chain, conditions: Conditions, moments: np.ndarray | None
) -> dict[int, Any]:
    """Return by how much one unit of parameter p of an effect changes coordinate k of K, as entry p
    K + k.
    """

    def added() -> dict[int, Any]:
        found: dict[int, Any] = {}
        for term in effect.terms(chain, conditions, moments if effect.uses_moments else None):
            at = term.parameter * chain.size + term.coordinate
            basis = 1.0 if term.basis is None else scalar(np.asarray(term.basis)[0])
            found[at] = found.get(at, 0.0) + basis
        return found

    return either_way(added)


def _refuse_loops(robot: Robot) -> None:
    """Refuse an arm with closed loops.

    Raises:
        BadInputError: with their names, and what represents them.
    """
    if robot.closures:
        raise BadInputError(
            f"{robot.name}: positions in its closed loops "
            f"({', '.join(loop.name for loop in robot.closures)}) are found by iteration, not by "
            "formulas; --urdf and --mjcf have the loops, and pincal compensate corrects its "
            "programs"
        )


def _symbolic_conditions(chain: Chain, payload_centre: np.ndarray) -> Conditions:
    robot = chain.robot
    _refuse_loops(robot)
    own = chain.robot.own_joints
    q, approach = np.zeros((2, 1, robot.n_joints), object)
    q[0, own], approach[0, own] = (
        symbols(*(f"{name}[{i}]" for i in range(len(own)))) for name in ("q", "approach")
    )
    columns = {
        "q": robot.from_reported(robot.following(q)),
        "approach": sides_following(robot, approach),
    }
    columns |= {name: symbols(name) for name in ("payload", "temperature", "time")}
    target = symbols("target") if len(chain.targets) > 1 else np.zeros(1, int)
    return Conditions(**columns, target=target, payload_centre=np.asarray(payload_centre, float))


def sides_following(robot: Robot, sides: np.ndarray) -> np.ndarray:
    """Return directions of approach, shape (N, n), in which mimic joints follow their sources."""
    out = sides.copy()
    index = robot.joint_names.index
    for mimic in robot.mimics:
        out[:, index(mimic.joint)] = out[:, index(mimic.source)] * np.sign(mimic.multiplier)
    return out


def _coordinates(
    model: Model, values: np.ndarray, *, conditions: Conditions, moments: np.ndarray | None
) -> list[Expression]:
    """Return the K coordinates, of the rigid arm if moments are None."""
    x: list[Any] = [float(value) for value in model.chain.nominal]
    for span, effect in zip(model.spans, model.effects, strict=True):
        if moments is not None or not effect.uses_moments:
            for k, change in _changes(
                effect, model.chain, values[span], conditions=conditions, moments=moments
            ).items():
                x[k] = x[k] + change
    for i, k in enumerate(model.chain.drives):
        x[k] = x[k] + conditions.q[0, i]
    return x


def _changes(
    effect: Effect,
    chain: Chain,
    values: np.ndarray,
    *,
    conditions: Conditions,
    moments: np.ndarray | None,
) -> dict[int, Any]:

    def added() -> dict[int, Any]:
        found: dict[int, Any] = {}
        for term in effect.terms(chain, conditions, moments if effect.uses_moments else None):
            change = float(values[term.parameter])
            basis = 1.0 if term.basis is None else np.asarray(term.basis)[0]
            found[term.coordinate] = found.get(term.coordinate, 0.0) + multiply(
                change, scalar(basis)
            )
        return found

    try:
        return either_way(added)
    except Exception as error:  # Effects may be third-party code.
        raise BadInputError(
            f"{effect.name}: can't be exported as a formula ({error}); export without it "
            "or take its value from predict"
        ) from error


def _by_target(rotations: np.ndarray, target: Any) -> np.ndarray:
    """Return the reference orientation of a target, shape (3, 3)."""

    def chosen() -> dict[int, Any]:
        found = next((R for t, R in enumerate(rotations[:-1]) if target == t), rotations[-1])
        return dict(enumerate(found.ravel().tolist()))

    entries = either_way(chosen)
    return np.array([entries[i] for i in range(9)], object).reshape(3, 3)


# Operator precedence: an operand of lower precedence than its place gets brackets.
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
# Longest expression without a statement of its own [characters].
_LONG: Count = 90


@dataclass(frozen=True)
class Language:
    """Syntax in which programming languages differ.

    Attributes:
        statement: template of a named value: name, expression.
        functions: the language's names of operations, where they differ.
        select: template of a conditional expression: comparison, value if true, value if false.
        is_select_atom: whether a conditional expression needs no brackets.
        input: writes an input of the formulas, given its name.
        curve: writes the value of a piecewise cubic, given its number, the curve and its argument.
    """

    statement: str
    functions: dict[str, str]
    select: str
    is_select_atom: bool
    input: Callable[[str], str]
    curve: Callable[[int, Cubic, str], str]


@dataclass
class Writer:
    """Writes formulas with common subexpressions; ``curves`` are the piecewise cubics written so
    far, by number.
    """

    language: Language
    uses: Counter[int]
    curves: list[Cubic] = field(default_factory=list)
    _texts: dict[int, tuple[str, int]] = field(default_factory=dict)
    _named: int = 0

    @classmethod
    def of(cls, language: Language, formulas: Sequence[Expression]) -> Writer:
        """Return a writer of formulas, which are then written part by part."""
        uses = Counter(id(root) for root in formulas)
        for node in _in_order(formulas):
            uses.update(id(operand) for operand in _seen(node)[1])
        return cls(language, uses)

    def statements(self, formulas: Sequence[Expression]) -> tuple[list[str], list[str]]:
        """Return the statements still needed for some of the formulas, and an expression for each
        formula.
        """
        lines = []
        for node in _in_order(formulas):
            if id(node) in self._texts:
                continue
            text, level = self._expression(node)
            if node.operation != "input" and (self.uses[id(node)] > 1 or len(text) > _LONG):
                name = f"v{self._named}"
                self._named += 1
                lines.append(self.language.statement.format(name, text))
                text = name
                level = _ATOM
            self._texts[id(node)] = text, level
        return lines, [self._text(formula, _SELECT) for formula in formulas]

    def _expression(self, node: Symbol) -> tuple[str, int]:
        operation, operands = _seen(node)
        language = self.language
        if operation == "input":
            return language.input(node.about), _ATOM
        if operation in _INFIX:
            text, level, levels = _INFIX[operation]
            return text.format(
                *(self._text(o, at) for o, at in zip(operands, levels, strict=True))
            ), level
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
        text, own = (
            self._texts[id(value)] if isinstance(value, Symbol) else (repr(float(value)), _ATOM)
        )
        return f"({text})" if own < level or (level == _ATOM and text.startswith("-")) else text


WrittenPart = tuple[list[str], list[str]]
"""Statements, and an expression for each formula."""


@dataclass(frozen=True)
class Written:
    """The parts of a calibrated model in a language, and the curves on which they depend."""

    moments: WrittenPart
    pose: WrittenPart
    columns: WrittenPart
    motions: WrittenPart
    curves: list[Cubic]


def written(language: Language, formulas: Formulas) -> Written:
    """Return a calibrated model in a language; pose and columns share subexpressions."""
    first = Writer.of(language, formulas.moments)
    middle = Writer.of(language, (*formulas.pose, *formulas.columns))
    last = Writer.of(language, formulas.motions)
    middle.curves = first.curves
    last.curves = first.curves
    return Written(
        first.statements(formulas.moments),
        middle.statements(formulas.pose),
        middle.statements(formulas.columns),
        last.statements(formulas.motions),
        first.curves,
    )


def _seen(node: Symbol) -> tuple[str, tuple[Any, ...]]:
    """Return operation and operands as written: a sum with a negative term as a difference."""
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
