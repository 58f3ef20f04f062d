"""What is wrong with orientations whose positions fit: their unit, the meaning of their columns, or
the frame that they are in.

Orientations alone determine how base and target are turned, as :math:`R_m = B R_n X` for the last
link's orientation R_n. A reading of the columns is tried by that; nothing else of the robot has to
be fitted. What the readings then leave tells whether it is the right one, and B whether positions
are in another frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import permutations, product

import numpy as np
from scipy.spatial.transform import Rotation

from pincal.hypotheses.hypothesis import Explanation, Hypothesis, likeliest
from pincal.measure.measurements import Measurements
from pincal.robot.robot import Robot
from pincal.robot.se3 import rotation_matrices
from pincal.sensors.pose import PoseSensor
from pincal.thresholds import Count, Scale
from pincal.validate.agreement_numbers import AGREEMENT
from pincal.validate.cures import INVERT, NONE, W_FIRST
from pincal.validate.rough_fit import within_a_turn
from pincal.validate.trials import Remainder

# Rows by which readings of the columns are tried, and the unknowns of base and target.
_ROWS: Count = 60
_UNKNOWNS: Count = 6
_Quaternions = np.ndarray


@dataclass(frozen=True)
class Oriented:
    """Orientations under one reading of their columns.

    Attributes:
        base: shape (3, 3), how the robot's base is turned in the frame of the orientations.
        left: typical angle that remains [rad].
    """

    base: np.ndarray
    left: float


@dataclass(frozen=True)
class OrientationSearch:
    """A search for what orientations mean, of a serial arm whose positions fit.

    Attributes:
        robot: the arm.
        table: the poses.
        base: shape (3, 3), how the robot's base is turned by the positions.
        limit: largest plausible error of an orientation of the robot as described [rad].
    """

    robot: Robot
    table: Measurements
    base: np.ndarray
    limit: float

    @cached_property
    def few(self) -> Measurements:
        """Some rows of the most frequent target."""
        names, counts = np.unique(self.table.target, return_counts=True)
        of_one = np.flatnonzero(self.table.target == names[np.argmax(counts)])
        step = max(len(of_one) // _ROWS, 1)
        return self.table.select(of_one[::step][:_ROWS])

    @cached_property
    def _of_links(self) -> np.ndarray:
        """Orientations of the last link, shape (N, 3, 3)."""
        q = self.robot.from_reported(self.few.q)
        return np.ascontiguousarray(self.robot.kinematics.frames(q)[:, -1, :3, :3])

    def under(self, hypothesis: Hypothesis[_Quaternions] | None) -> Oriented:
        """Return what orientations leave as they were read, or under another reading of them."""
        quaternions = self.few.readings["quaternion"]
        if hypothesis is None:
            return self._turned(quaternions)
        undone = hypothesis.undo(quaternions)
        found = self._turned(undone)
        if found.left < self.limit or not isinstance(hypothesis, Reading):
            return found
        return self._with_either(np.stack([undone, hypothesis.undo_other(quaternions)]), found)

    def _turned(self, quaternions: _Quaternions) -> Oriented:
        """Return what orientations leave with base and target turned as they say."""
        return self._left_by(self._placed(quaternions, self._of_links), quaternions[None])

    @staticmethod
    def _placed(quaternions: _Quaternions, of_links: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how base and target are turned by some orientations, shape (3, 3) each."""
        poses = PoseSensor(np.zeros((len(quaternions), 3)), rotation_matrices(quaternions))
        tips = np.pad(of_links, ((0, 0), (0, 0), (0, 1)))
        placed = next(poses.starts(tips, np.zeros(len(tips), int), 1))
        return placed.base[:3, :3], placed.tools[0, :3, :3]

    def _off(self, placed: tuple[np.ndarray, np.ndarray], either: _Quaternions) -> np.ndarray:
        """Return by what angles orientations, shape (k, N, 4), are off, shape (k, N) [rad]."""
        base, target = placed
        expected = Rotation.from_matrix(base @ self._of_links @ target).inv()
        return np.array([(expected * Rotation.from_quat(one)).magnitude() for one in either])

    def _left_by(self, placed: tuple[np.ndarray, np.ndarray], either: _Quaternions) -> Oriented:
        """Return what the better of each row's orientations, shape (k, N, 4), leave."""
        off = self._off(placed, either).min(axis=0)
        return Oriented(placed[0], float(np.quantile(off, _MOST_ROWS)))

    def _with_either(self, either: _Quaternions, found: Oriented) -> Oriented:
        """Return what orientations leave if each row's is one of two, shape (2, N, 4), as angles
        beyond a right angle are read; ``found`` is with the first of all.

        Of a few rows all combinations place base and target, and these choose for the others.
        """
        n = either.shape[1]
        rng = np.random.default_rng(0)
        for _ in range(_DRAWS if n > _DRAWN else 0):
            some = rng.choice(n, _DRAWN, replace=False)
            for ways in product((0, 1), repeat=_DRAWN):
                placed = self._placed(either[list(ways), some], self._of_links[some])
                if self._left_by(placed, either).left > _NEAR:
                    continue
                chosen = self._off(placed, either).argmin(axis=0)
                settled = self._placed(either[chosen, np.arange(n)], self._of_links)
                found = min(found, self._left_by(settled, either), key=lambda one: one.left)
                if found.left < self.limit:
                    return found
        return found

    def cause(self) -> Hypothesis[_Quaternions] | None:
        """Return what is wrong with the orientations; None if nothing that is tried explains
        them.
        """
        as_read = self.under(None)
        if as_read.left < self.limit:
            return _of_frame(as_read.base @ self.base.T, self.limit)
        before = Remainder(as_read.left, 3 * len(self.few), _UNKNOWNS)
        tried = list(readings_of_columns())
        explanations = []
        for one in tried:
            found = self.under(one)
            after = Remainder(found.left, 3 * len(self.few), _UNKNOWNS)
            is_enough = (
                found.left < self.limit and after.chance(before) * len(tried) < AGREEMENT.chance
            )
            explanations.append(Explanation(one, max(found.left, self._apart(found)), is_enough))
        best = likeliest(explanations, lambda least: AGREEMENT.rival * least)
        return None if best is None else best.best

    def _apart(self, found: Oriented) -> float:
        """Return how far the base is turned by orientations from where it is by positions [rad].

        Readings that differ by constant turns on both sides, as an inverse differs from a
        quaternion whose w stands elsewhere, leave the same: positions tell them apart.
        """
        return float(Rotation.from_matrix(found.base @ self.base.T).magnitude())


def _of_frame(turn: np.ndarray, limit: float) -> Hypothesis[_Quaternions] | None:
    """Return that orientations are in another frame than positions; None if they are in the same.

    ``turn`` is by how much, a rotation matrix.
    """
    vector = Rotation.from_matrix(turn).as_rotvec()
    angle = float(np.linalg.norm(vector))
    if angle < limit:
        return None
    axis = vector / angle
    about = next(
        (
            f"{'-' if way < 0.0 else ''}{name}"
            for name, way in zip("xyz", axis, strict=True)
            if abs(abs(way) - 1.0) < limit
        ),
        f"({', '.join(f'{part:.3f}' for part in axis)})",
    )
    back = Rotation.from_rotvec(vector).inv()
    return Hypothesis(
        "the orientations appear to be in another frame than the positions, turned by "
        f"{np.degrees(angle):.1f} deg about {about}",
        lambda quaternions: (back * Rotation.from_quat(quaternions)).as_quat(),
        f"give both in one frame, {NONE}",
    )


# Share of the rows that a reading of the columns has to explain.
_MOST_ROWS: Scale = 0.8
# Rows of which all combinations are tried where each row's angles may be either of two, how often
# they are drawn, and the angle [rad] within which a combination is worth a fit to all.
_DRAWN: Count = 4
_DRAWS: Count = 3
_NEAR: Scale = 0.3
# What angles in columns have to be multiplied by, and how that is said.
_UNITS: tuple[tuple[str, Scale], ...] = (
    ("", 1.0),
    ("radians, not degrees", 180.0 / np.pi),
    ("degrees, not radians", np.pi / 180.0),
)
# Three angles about these axes in turn, each about the axes as turned before.
_SEQUENCES = (*map("".join, permutations("XYZ")), "XYX", "XZX", "YXY", "YZY", "ZXZ", "ZYZ")
_ORDINALS = ("first", "second", "third")


@dataclass(frozen=True)
class Meaning:
    """A meaning of three numbers in columns.

    Attributes:
        words: what they are.
        rotations: returns the rotations for numbers of shape (N, 3) [rad].
        option: the value of ``--orientation`` for it, if there is one.
        is_plain: whether columns are in the order of the turns.
    """

    words: str
    rotations: Callable[[np.ndarray], Rotation]
    option: str = ""
    is_plain: bool = True


_RPY = Meaning("angles about fixed x, y and z", lambda v: Rotation.from_euler("xyz", v), "rpy")
_VECTOR = Meaning("a rotation vector", Rotation.from_rotvec, "ur")


def _meanings() -> Iterator[Meaning]:
    """Yield all meanings of three numbers, those of controllers first."""
    yield _RPY
    yield _VECTOR
    # The same angles as of fixed axes, in the columns of the opposite order.
    yield Meaning(_turns_in_words("ZYX", (0, 1, 2)), partial(_turned, "ZYX", (0, 1, 2)), "kuka")
    for axes in _SEQUENCES:
        for order in permutations(range(3)):
            if (axes, order) not in (("ZYX", (0, 1, 2)), ("ZYX", (2, 1, 0))):
                words = _turns_in_words(axes, order)
                turn = partial(_turned, axes, order)
                yield Meaning(words, turn, is_plain=order == (0, 1, 2))


def _turned(axes: str, order: tuple[int, ...], v: np.ndarray) -> Rotation:
    return Rotation.from_euler(axes, v[:, list(order)])


def _turns_in_words(axes: str, order: tuple[int, ...]) -> str:
    """Return a sequence of turns in words: the columns by their places, axes as turned before."""
    first, then, last = list(axes.lower())
    turns = f"angles about {first}, the new {then} and the new {last}"
    if order == (0, 1, 2):
        return turns
    return f"{turns} in the {', '.join(_ORDINALS[k] for k in order)} column"


def readings_of_columns() -> Iterator[Hypothesis[_Quaternions]]:
    """Yield what the columns of orientations may mean instead, the likeliest first."""
    meanings = tuple(_meanings())
    for inverted in (False, True):
        yield from _of_quaternions(inverted=inverted)
        for read in (_RPY, _VECTOR):
            for unit, factor in _UNITS:
                for meant in meanings:
                    if meant is not read or factor != 1.0:
                        yield _of_triples(read, meant, unit, factor, inverted=inverted)


def _of_quaternions(*, inverted: bool) -> Iterator[Hypothesis[_Quaternions]]:
    """Yield mistakes in quaternions as they were read."""
    if inverted:
        yield Hypothesis(
            "the orientations appear to be inverted: those of the instrument in the target's frame",
            _conjugate,
            INVERT,
        )
    yield Hypothesis(
        f"the quaternion appears to be written with w first{' and inverted' if inverted else ''}",
        lambda q: _conjugate(_w_last(q)) if inverted else _w_last(q),
        f"{W_FIRST}, {NONE}",
    )
    yield Hypothesis(
        f"the quaternion appears to be written with w last{' and inverted' if inverted else ''}",
        lambda q: _conjugate(_w_first(q)) if inverted else _w_first(q),
        f"give it as --orientation xyzw, {NONE}",
    )


def _w_last(q: _Quaternions) -> _Quaternions:
    return q[:, [1, 2, 3, 0]]


def _w_first(q: _Quaternions) -> _Quaternions:
    return q[:, [3, 0, 1, 2]]


def _conjugate(q: _Quaternions) -> _Quaternions:
    return np.asarray(q * [-1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Reading(Hypothesis[_Quaternions]):
    """That three numbers have another meaning, where those that were read may stand for others.

    Attributes:
        undo_other: the same as ``undo``, with the other three numbers that were read as the same
            orientation.
    """

    undo_other: Callable[[_Quaternions], _Quaternions] = np.copy


def _of_triples(
    read: Meaning, meant: Meaning, unit: str, factor: float, *, inverted: bool
) -> Hypothesis[_Quaternions]:
    """Return that three numbers, read with one meaning, have another one or another unit."""

    def undo(quaternions: _Quaternions, *, other: bool = False) -> _Quaternions:
        found = meant.rotations(factor * _numbers(read, quaternions, other=other))
        return np.asarray((found.inv() if inverted else found).as_quat())

    parts = [f"in {unit}"] if unit else []
    parts += [f"{meant.words}, not {read.words}"] if meant is not read else []
    parts += ["inverted"] if inverted else []
    advice = ["write their unit in the header"] if unit else []
    if meant is not read:
        advice.append(f"--orientation {meant.option}" if meant.option else "convert them")
    words = f"the orientations appear to be {' and '.join(parts)}"
    last = f"{' and '.join(advice) or 'invert them'}, {NONE}"
    if meant.is_plain and not unit:
        return Reading(words, undo, last, partial(undo, other=True))
    return Hypothesis(words, undo, last)


def _numbers(read: Meaning, quaternions: _Quaternions, *, other: bool) -> np.ndarray:
    """Return the three numbers that were read, shape (N, 3) [rad], or the other three that are read
    as the same orientation.
    """
    rotations = Rotation.from_quat(quaternions)
    if read is _RPY:
        v = np.asarray(rotations.as_euler("xyz"))
        return within_a_turn(v * [1.0, -1.0, 1.0] + np.pi) if other else v
    v = np.asarray(rotations.as_rotvec())
    angle = np.linalg.norm(v, axis=1, keepdims=True)
    return np.asarray(v * (1.0 - 2.0 * np.pi / np.maximum(angle, 1e-12))) if other else v
