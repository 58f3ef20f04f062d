"""Orientations in the conventions of controllers, converted to unit quaternions x y z w.

=========  =================  =======  =============================================================
name       columns            unit     rotation
=========  =================  =======  =============================================================
``kuka``   A B C              deg      R_z(A) R_y(B) R_x(C): about z, the new y, the new x [KUKA]_
``fanuc``  W P R              deg      R_z(R) R_y(P) R_x(W): about the fixed x, y and z [FANUC]_
``rpy``    roll pitch yaw     rad      R_z(yaw) R_y(pitch) R_x(roll): about the fixed x, y and z
                                       [URDF]_
``ur``     rx ry rz           rad      by the length of the vector about its direction [UR]_
``abb``    q1 q2 q3 q4        1        quaternion w x y z [ABB]_; so is ``wxyz``
``xyzw``   qx qy qz qw        1        quaternion x y z w [ROS]_
=========  =================  =======  =============================================================

A unit in the header overrides the one in this table. Columns named after their axes (rx ry rz, roll
pitch yaw) may also hold the angles of another convention, and q1 q2 q3 q4 a quaternion in the order
x y z w, if the user declares it.

.. [KUKA] KUKA System Software 8.3, Operating and Programming Instructions for System Integrators:
  A, B, C as rotations about the Z, Y and X axis, each about the axes as turned before.
.. [FANUC] FANUC R-30iA, KAREL Reference Manual, POSITION data type: W, P, R as rotations about the
  fixed X, Y and Z axes.
.. [URDF] https://wiki.ros.org/urdf/XML/joint, element origin, attribute rpy.
.. [UR] Universal Robots, The URScript Programming Language: a pose is p[x, y, z, ax, ay, az] with a
  rotation vector.
.. [ABB] ABB, Technical reference manual, RAPID instructions, functions and data types: orient, q1
  being the scalar part.
.. [ROS] REP 103 and geometry_msgs/Quaternion.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from pincal.errors import MeasurementError
from pincal.measure.flat_matrices import quaternions_of
from pincal.sensors.sensor_numbers import PLAUSIBLE


@dataclass(frozen=True)
class Convention:
    """A convention for orientations in columns.

    Attributes:
        name: value of the option ``--orientation``.
        words: description for messages.
        columns: their names in the table; by default the usual ones.
        order: component in each column: angles about x, y, z or components x, y, z, w.
        unit: of columns without a unit in the header.
        kind: "angles" R_z R_y R_x, "vector", "quaternion" or "matrix".
        known_by: unambiguous spellings of the first column.
    """

    name: str
    words: str
    columns: tuple[str, ...]
    order: str
    unit: str
    kind: str
    known_by: tuple[str, ...] = ()

    @property
    def quantity(self) -> str:
        """Physical quantity of the columns."""
        return "number" if self.kind in ("quaternion", "matrix") else "angle"

    def quaternions(self, columns: Mapping[str, np.ndarray], *, where: str) -> np.ndarray:
        """Return quaternions x y z w, shape (N, 4), of values by column, shape (N,) each, angles in
        rad.

        Raises:
            MeasurementError: for angles that can't be in this unit.
        """
        if self.kind == "matrix":
            return _of_matrices(np.column_stack([columns[name] for name in self.columns]), where)
        by_axis = dict(zip(self.order, self.columns, strict=True))
        values = np.column_stack([columns[by_axis[axis]] for axis in "xyzw" if axis in by_axis])
        if self.kind == "quaternion":
            return values
        size = (
            np.linalg.norm(values, axis=1) if self.kind == "vector" else np.abs(values).max(axis=1)
        )
        if self.unit == "rad" and len(size) and size.max() > PLAUSIBLE.longest_turn:
            name = CONVENTIONS[self.name].columns[0]
            raise MeasurementError(
                f"{where}: an orientation of {size.max():.4g} rad as {self.words}, more than a "
                f"revolution; in degrees? Then write `{name} [deg]` in the header; or choose "
                f"another convention: --orientation {'|'.join(CONVENTIONS)}"
            )
        if self.kind == "vector":
            return np.asarray(Rotation.from_rotvec(values).as_quat())
        return np.asarray(Rotation.from_euler("xyz", values).as_quat())

    def values(self, rotation: np.ndarray) -> np.ndarray:
        """Return the values of the columns, in their order and unit, for a rotation matrix, shape
        (3, 3).
        """
        if self.kind == "matrix":
            return np.asarray(rotation, float).ravel()
        turned = Rotation.from_matrix(rotation)
        if self.kind == "quaternion":
            found = turned.as_quat(canonical=True)
        else:
            found = turned.as_rotvec() if self.kind == "vector" else turned.as_euler("xyz")
        values = found[["xyzw".index(axis) for axis in self.order]]
        return np.asarray(np.degrees(values) if self.unit == "deg" else values)


_ALL = (
    Convention(
        "kuka", "KUKA's A B C about z, y, x", ("A", "B", "C"), "zyx", "deg", "angles", ("A",)
    ),
    Convention(
        "fanuc",
        "FANUC's W P R about fixed x, y, z",
        ("W", "P", "R"),
        "xyz",
        "deg",
        "angles",
        ("W",),
    ),
    Convention(
        "abb",
        "ABB's quaternion w x y z",
        ("q1", "q2", "q3", "q4"),
        "wxyz",
        "",
        "quaternion",
        ("q1", "Q1"),
    ),
    Convention(
        "ur",
        "the rotation vector of Universal Robots",
        ("rx", "ry", "rz"),
        "xyz",
        "rad",
        "vector",
        ("rx",),
    ),
    Convention(
        "rpy",
        "roll, pitch, yaw",
        ("roll", "pitch", "yaw"),
        "xyz",
        "rad",
        "angles",
        ("roll", "Roll", "ROLL"),
    ),
    Convention("xyzw", "a quaternion x y z w", ("qx", "qy", "qz", "qw"), "xyzw", "", "quaternion"),
    Convention("wxyz", "a quaternion w x y z", ("qw", "qx", "qy", "qz"), "wxyz", "", "quaternion"),
)
CONVENTIONS: Mapping[str, Convention] = {convention.name: convention for convention in _ALL}
"""The conventions by the values of the option ``--orientation``."""
NO_ORIENTATION = "none"
"""Its value for leaving orientations out."""

MATRIX = Convention(
    "matrix",
    "a rotation matrix row by row",
    tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)),
    "",
    "",
    "matrix",
    ("r11", "R11"),
)
"""A rotation matrix in columns, which is recognised by its numbers and needs no option."""

# Columns numbered without a defined order.
_BY_NUMBER = ("q1", "q2", "q3", "q4")


def _of_matrices(values: np.ndarray, where: str) -> np.ndarray:
    """Return quaternions x y z w, shape (N, 4), of the elements of rotation matrices, (N, 9);
    refuse others.
    """
    found = quaternions_of(values.reshape(-1, 3, 3))
    wrong = np.flatnonzero(np.isnan(found).any(axis=1))
    if len(wrong):
        raise MeasurementError(
            f"{where}: the matrices of {len(wrong)} of {len(found)} rows are no rotations, first "
            f"in row {wrong[0] + 1} of the table; expected orthonormal columns: correct or delete "
            "the rows, or leave the matrix out"
        )
    return found


def find_orientation(
    names: Collection[str], declared: str | None, *, taken: Collection[str], source: str
) -> Convention | None:
    """Return the convention of columns that give an orientation other than by a quaternion qx qy qz
    qw; None without any.

    Columns have no units here; ``taken`` ones have another meaning, such as joints.

    Raises:
        MeasurementError: for an unknown convention, one whose columns are missing, or columns of
            two conventions.
    """
    free = [name for name in names if name not in taken]
    if declared is not None:
        return _as_declared(free, declared, source=source)
    found = [
        replace(each, columns=columns)
        for each in (*_ALL, MATRIX)
        if (columns := _known(free, each)) is not None
    ]
    if len(found) > 1:
        listed = " and ".join(" ".join(each.columns) for each in found)
        raise MeasurementError(
            f"{source}: orientations in {listed}; expected one: ignore the others"
        )
    return found[0] if found else None


def looks_like_orientation(names: Collection[str]) -> bool:
    """Return whether columns include those of an orientation, in upper or lower case."""
    folded = {name.casefold() for name in names}
    return any({name.casefold() for name in convention.columns} <= folded for convention in _ALL)


def columns_of_orientations(names: Collection[str]) -> set[str]:
    """Return those columns among some, without units, that are of a whole orientation, in any
    convention and in upper or lower case.

    Example:
        >>> sorted(columns_of_orientations(["x", "Roll", "Pitch", "Yaw", "A"]))
        ['Pitch', 'Roll', 'Yaw']
    """
    folded = {name.casefold() for name in names}
    whole = [{name.casefold() for name in of.columns} for of in (*_ALL, MATRIX)]
    found = {name for columns in whole if columns <= folded for name in columns}
    return {name for name in names if name.casefold() in found}


def _known(free: Collection[str], convention: Convention) -> tuple[str, ...] | None:
    """Return the columns of a convention in an unambiguous spelling, if they are complete."""
    for first in convention.known_by:
        spell = str.upper if first.isupper() else str.title if first.istitle() else str.lower
        columns = tuple(spell(name) for name in convention.columns)
        if set(columns) <= set(free) and not (
            convention.columns == _BY_NUMBER and spell("q5") in free
        ):
            return columns
    return None


def _as_declared(free: Collection[str], name: str, *, source: str) -> Convention:
    if name not in CONVENTIONS:
        raise MeasurementError(
            f"{source}: orientation {name!r} is unknown; expected one of {', '.join(CONVENTIONS)}"
        )
    convention = CONVENTIONS[name]
    folded = {name.casefold(): name for name in free}
    others = [
        other
        for other in _ALL
        if len(other.order) == len(convention.order) and convention.kind != "vector"
    ]
    for other in (convention, *others):
        if all(column.casefold() in folded for column in other.columns):
            columns = tuple(folded[column.casefold()] for column in other.columns)
            order = convention.order if other.columns == _BY_NUMBER else other.order
            return replace(convention, columns=columns, order=order)
    raise MeasurementError(
        f"{source}: no columns {' '.join(convention.columns)} for the orientation "
        f"{name!r} ({convention.words}); the table "
        f"has {', '.join(free)}; name them with --columns 'NAME={convention.columns[0]},...'"
    )


def looks_like_place(names: Collection[str]) -> bool:
    """Return whether columns may be a position: three that differ by x, y and z at an end, or a
    short one with x, y or z.
    """
    small = {name.casefold() for name in names}
    ends = ([f"{name[:-1]}{axis}" for axis in "xyz"] for name in small if name.endswith("x"))
    starts = ([f"{axis}{name[1:]}" for axis in "xyz"] for name in small if name.startswith("x"))
    return any(len(name) < 3 and set(name) & set("xyz") for name in small) or any(
        small.issuperset(three) for three in (*ends, *starts)
    )
