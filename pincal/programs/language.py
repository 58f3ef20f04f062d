"""The interface of a controller's language: suffixes, units, and how a program is read from its
files.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np

from pincal.errors import BadInputError, ProgramError
from pincal.measure.orientation import CONVENTIONS
from pincal.plugins import Registry
from pincal.programs.program import Motion, Point, Posture, Program, Turn, number_text
from pincal.programs.program_numbers import PROGRAM_NUMBERS
from pincal.programs.syntax import Number, Source
from pincal.programs.understood import Understood
from pincal.robot.se3 import exponentials, rotation_matrices, rotation_of_rpy, transform
from pincal.units import plain_numbers


class ControllerLanguage(ABC):
    """A controller's language.

    Attributes:
        name: its name in messages.
        suffixes: of its files; the files of a program are in this order.
        is_pair: whether files of one name and different suffixes are one program.
        reads_others: whether its files use declarations of other files.
        length: its unit of length [m].
        convention: its orientation, see :mod:`pincal.measure.orientation`.
        in_degrees: whether revolute joints are in degrees.
        digits: decimal places of a position, an orientation and a joint, for a tenth of a
            micrometre.
        can_insert: whether statements can be inserted into a program.
        understood: the words that change neither a point nor a frame.
        grammars: of its files; the page of ``export --page`` holds their tables.
    """

    name: ClassVar[str]
    suffixes: ClassVar[tuple[str, ...]]
    is_pair: ClassVar[bool] = False
    reads_others: ClassVar[bool] = False
    length: ClassVar[float] = 1e-3
    convention: ClassVar[str] = "fanuc"
    in_degrees: ClassVar[bool] = True
    digits: ClassVar[tuple[int, int, int]] = (4, 6, 7)
    can_insert: ClassVar[bool] = False
    understood: ClassVar[tuple[Understood, ...]] = ()
    grammars: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def read(self, sources: Sequence[Source]) -> Program:
        """Return the program of some files.

        Raises:
            ProgramError: if one is truncated or in another dialect.
        """

    def statement(
        self, motion: Motion, source: Source, *, values: np.ndarray, posture: Posture
    ) -> str:
        """Return a motion's statement with its target replaced by a pose, shape (6,) or (7,)."""
        raise NotImplementedError

    def pose(self, values: np.ndarray) -> np.ndarray:
        """Return the pose, shape (4, 4) [m], of numbers in the language."""
        kind = CONVENTIONS[self.convention].kind
        rest = np.asarray(values[3:], float)
        if kind == "quaternion":
            R = rotation_matrices(rest[None, [1, 2, 3, 0]])[0]
        elif kind == "vector":
            R = exponentials(rest[None])[0]
        else:
            R = rotation_of_rpy(np.deg2rad(self._by_axis(rest)))
        return transform(R, self.length * np.asarray(values[:3], float))

    def is_pose(self, values: np.ndarray) -> bool:
        """Return whether numbers are a pose: of a length that a robot may have, and a quaternion of
        unit length.
        """
        values = np.asarray(values, float)
        is_near = np.abs(values[:3]).max() * self.length < PROGRAM_NUMBERS.longest
        is_turn = np.abs(values[3:]).max() < PROGRAM_NUMBERS.most_turned
        # The length of a vector of large numbers would not be finite.
        if not (is_near and is_turn):
            return False
        return (
            len(values) != 7 or abs(float(np.linalg.norm(values[3:])) - 1.0) < PROGRAM_NUMBERS.unit
        )

    def numbers(self, pose: np.ndarray, near: np.ndarray) -> np.ndarray:
        """Return the numbers of a pose; of equivalent orientations the one nearest to other
        numbers.
        """
        R = pose[:3, :3]
        near = np.asarray(near, float)
        rest = CONVENTIONS[self.convention].values(R)
        if len(rest) == 4:
            rest = rest * np.sign(rest @ near[3:])
        elif CONVENTIONS[self.convention].kind == "vector":
            turn = float(np.linalg.norm(rest))
            axis = (
                rest / turn
                if turn > 1e-12
                else near[3:] / max(float(np.linalg.norm(near[3:])), 1e-12)
            )
            rest = min(
                (axis * (turn + 2.0 * np.pi * k) for k in (-1, 0, 1)),
                key=lambda v: float(np.linalg.norm(v - near[3:])),
            )
        else:
            rest = self._by_axis(_nearest_angles(self._by_axis(rest), self._by_axis(near[3:]), R))
        return np.concatenate([pose[:3, 3] / self.length, rest])

    def _by_axis(self, angles: np.ndarray) -> np.ndarray:
        """Return angles about x, y and z in the language's order, or the reverse."""
        order = CONVENTIONS[self.convention].order
        return np.asarray(angles[[order.index(axis) for axis in "xyz"]])

    def frame(self, text: str) -> np.ndarray:
        """Return the pose, shape (4, 4), of a tool or a base given as numbers in the language's
        units.

        Raises:
            BadInputError: for any other text.
        """
        values = np.array(plain_numbers(text.replace(";", ",").split(",")))
        columns = CONVENTIONS[self.convention].columns
        if (
            len(values) != 3 + len(columns)
            or not np.isfinite(values).all()
            or not self.is_pose(values)
        ):
            unit = "m" if self.length == 1.0 else "mm"
            raise BadInputError(
                f"{text!r} is not a frame in {self.name}; expected X,Y,Z "
                f"[{unit}],{','.join(columns)}"
            )
        return self.pose(values)

    def key(self, name: str) -> str:
        """Return the name of a tool or a base as a program's reader spells it."""
        return name.upper()

    def with_pulses(self, text: str) -> ControllerLanguage:
        """Return the language with pulses per degree, one number per axis.

        Raises:
            BadInputError: for any other text, or a language without pulses.
        """
        raise BadInputError(
            f"pulses {text!r}: a program in {self.name} has none; leave --pulses out"
        )

    def joint_units(self, turns: np.ndarray) -> np.ndarray:
        """Return the unit of each axis [rad or m], shape (n,), given which are revolute."""
        return np.where(turns, np.pi / 180.0 if self.in_degrees else 1.0, self.length)

    def refusal(self, point: Point) -> str:
        """Return why the values of a point can't be interpreted, or ""."""
        if point.kind == "joints" or self.is_pose(point.values):
            return ""
        return "its numbers are no pose: too large, or a quaternion that is not of unit length"

    def point_numbers(self, point: Point, values: np.ndarray) -> list[str]:
        """Return the texts that replace a point's numbers."""
        length, angle, joint = self.digits
        least = [
            joint if point.kind == "joints" else length if k < 3 else angle
            for k in range(len(point.numbers))
        ]
        return [
            number_text(number, float(values[k]), least[k])
            for k, number in enumerate(point.numbers)
        ]

    def turn_text(self, turns: Sequence[Turn], axes: np.ndarray, before: np.ndarray) -> str:
        """Return the text of the number of some turns, for new and previous axes, shape (n,) each.

        A turn counted from the other side of an edge is kept unless the axis crosses the edge.
        """
        number = turns[0].number
        counts = [turn.counted(float(axes[turn.joint])) for turn in turns]
        were = [turn.counted(float(before[turn.joint])) for turn in turns]
        counts = [
            turn.value if new == old else new
            for turn, new, old in zip(turns, counts, were, strict=True)
        ]
        if all(count == turn.value for count, turn in zip(counts, turns, strict=True)):
            return number.text
        if turns[0].bit is None:
            return str(counts[0])
        value = int(number.value)
        for turn, count in zip(turns, counts, strict=True):
            value = value & ~(1 << (turn.bit or 0)) | (count << (turn.bit or 0))
        return self.bits(number, value)

    def bits(self, number: Number, value: int) -> str:
        """Return the text of bits that replace others."""
        return str(value)


def _nearest_angles(angles: np.ndarray, near: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return the angles about x, y, z [deg] of a rotation; of equivalent ones the nearest to
    others.

    Where the angle about y is 90 deg, the other two are not unique: the one about x is kept.
    """
    if np.hypot(R[2, 1], R[2, 2]) < 1e-9:
        x = near[0]
        y = np.sign(-R[2, 0]) * 90.0
        # R = R_z(z) R_y(+-90) R_x(x): its second column is (-sin(z -+ x), cos(z -+ x), 0).
        z = np.rad2deg(np.arctan2(-R[0, 1], R[1, 1])) + np.sign(y) * x
        candidates = [np.array([x, y, z])]
    else:
        x, y, z = angles
        candidates = [np.array([x, y, z]), np.array([x + 180.0, 180.0 - y, z + 180.0])]
    moved = [angles - 360.0 * np.round((angles - near) / 360.0) for angles in candidates]
    return min(moved, key=lambda angles: float(np.abs(angles - near).max()))


LANGUAGES: Registry[ControllerLanguage] = Registry(
    "language", group="pincal.languages", name_of=lambda cls: cls.name
)


def language_of(path: str | os.PathLike[str]) -> ControllerLanguage | None:
    """Return the language of a file by its suffix, or None if it is no program."""
    suffix = Path(path).suffix.lower()
    for language in LANGUAGES.known().values():
        if suffix in language.suffixes:
            return language()
    return None


def files_of(path: Path, language: ControllerLanguage) -> list[Path]:
    """Return the files of a program: for one of a pair, the other as well."""
    if not language.is_pair:
        return [path]
    found = {
        other.suffix.lower(): other
        for other in sorted(path.parent.glob("*"))
        if other.stem == path.stem
    }
    found[path.suffix.lower()] = path
    return [found[suffix] for suffix in language.suffixes if suffix in found]


def read_sources(paths: Sequence[Path]) -> list[Source]:
    """Return the files of a program.

    Raises:
        ProgramError: if one can't be read.
    """
    found = []
    for path in paths:
        try:
            found.append(Source(path.name, path.read_bytes()))
        except OSError as error:
            raise ProgramError(
                f"{path}: can't be read ({error.strerror}); expected a program"
            ) from None
    return found
