"""Tables of numbers without names of columns: they are refused with the names to write, as far as
the numbers show them.

Columns without names have their numbers for labels, counted from 1, so that the user can name them:
``--columns '1=joint_1 [deg],7=x [mm]'``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from pincal.errors import MeasurementError
from pincal.measure.column_numbers import JOINT_COLUMNS
from pincal.measure.flat_matrices import order_of_matrix
from pincal.measure.reading_numbers import LAYOUT
from pincal.measure.sheet import Sheet
from pincal.measure.table_schema import Schema
from pincal.sensors.sensor_numbers import PLAUSIBLE
from pincal.units import plain_numbers

# What follows or precedes the joints, by the number of columns, and in words.
_READINGS: dict[int, tuple[tuple[str, ...], str]] = {
    1: (("distance",), "a distance"),
    3: (("x", "y", "z"), "a position"),
    6: (("x", "y", "z", "rx", "ry", "rz"), "a position and a rotation vector"),
    7: (("x", "y", "z", "qx", "qy", "qz", "qw"), "a position and a quaternion"),
}
_OTHER_ANGLES = (
    "; if they are angles, write roll,pitch,yaw or A,B,C (KUKA) or W,P,R (FANUC) for rx,ry,rz"
)
_OTHER_ORDER = "; if its scalar is first, write qw,qx,qy,qz"


def numbers_as_names(cells: Sequence[str], *, decimal_comma: bool) -> tuple[str, ...] | None:
    """Return the labels of a first line that has no names, and is one of the table; None if it has
    names.

    Consecutive numbers, as pandas writes them, are labels themselves.
    """
    texts = [cell.strip() for cell in cells]
    numeric = [
        bool(plain_numbers([text.replace(",", ".") if decimal_comma else text])) for text in texts
    ]
    if len(texts) < 2 or sum(numeric) <= LAYOUT.filled * len(texts) or has_numbers_for_names(texts):
        return None
    return tuple(str(i + 1) for i in range(len(texts)))


def has_numbers_for_names(labels: Sequence[str]) -> bool:
    """Return whether labels are numbers in order, but for blank ones and few words.

    Example:
        >>> has_numbers_for_names(["", "0", "1", "2"]), has_numbers_for_names(["1", "x", "y", "z"])
        (True, False)
    """
    numbers = [int(label) for label in labels if label.isdecimal() and len(label) < 4]
    is_whole = len(numbers) > LAYOUT.filled * len(labels) and len(numbers) > 1
    return is_whole and numbers == [*range(numbers[0], numbers[0] + len(numbers))]


def with_poses_in_rows(values: np.ndarray, joints: int) -> np.ndarray:
    """Return numbers without names with a row for each pose, which may be that of a column in them.

    What the numbers show of either decides; where they show the same, that there are more poses
    than numbers of each, and where they show nothing, far more.

    Args:
        values: shape (N, k) or (k, N).
        joints: of the arm.
    """
    rows, columns = values.shape
    in_rows = _shown(values, joints)
    in_columns = _shown(values.T, joints)
    if in_rows == in_columns:
        are_columns = columns > (1.0 if in_rows else LAYOUT.poses_to_numbers) * rows
    else:
        # Numbers of columns alone fit by chance: only with more poses than numbers of each.
        are_columns = in_columns > in_rows and (in_columns > 1 or columns > rows)
    return values.T if are_columns else values


def _shown(values: np.ndarray, joints: int) -> int:
    """Return how well numbers, shape (N, k), are joints and a reading: 2 if they show it, 1 if
    there are as many, 0 otherwise.
    """
    size = values.shape[1] - joints
    if size < 1 or not joints:
        return 0
    found = [_of_reading(of) for of in (values[:, joints:], values[:, :size])]
    if not any(found):
        return 0
    return 2 if size in (7, 12, 16) else 1


def check_named(sheet: Sheet, schema: Schema) -> None:
    """Refuse a table whose columns have numbers for names, unless the user names them.

    Raises:
        MeasurementError: with the names to write, if the numbers show these.
    """
    labels = [label for label in sheet.labels if label]
    if schema.options.columns or not has_numbers_for_names(sheet.labels):
        return
    raise MeasurementError(
        f"{sheet.path.name}: {len(labels)} columns of numbers and no names; "
        f"{_advice(sheet, labels, schema)}"
    )


def _advice(sheet: Sheet, labels: list[str], schema: Schema) -> str:
    joints = schema.own_joints
    found = _Layout.of(sheet, schema) if joints else None
    if found is None:
        names = joints or tuple(name for field in schema.fields for name in field.columns)[:3]
        start = ",".join(f"{label}={name}" for label, name in zip(labels, names, strict=False))
        of_arm = f"; the arm has {len(joints)} joints" if joints else ""
        return (
            f"expected the names of the columns in the first line{of_arm}. Write them there, or "
            f"give them by number: --columns '{start},...' (a unit is written as x [mm])"
        )
    pairs = zip(found.labels, found.names, strict=True)
    columns = ",".join(f"{label}={name}" for label, name in pairs if name)
    # In a file of cells between separators the names may be written; blank ones are left out.
    line = f"make this the first line: {found.header}  or " if found.header else ""
    return f"if they are {found.words}, {line}give --columns '{columns}'{found.other}"


@dataclass(frozen=True)
class _Layout:
    """What columns without names may be.

    Attributes:
        labels: their numbers.
        names: with units; empty for a column that is none.
        words: the same in words.
        other: what else they may be, in words.
        header: the line to write; empty where a file has no lines.
    """

    labels: tuple[str, ...]
    names: tuple[str, ...]
    words: str
    other: str = ""
    header: str = ""

    @classmethod
    def of(cls, sheet: Sheet, schema: Schema) -> _Layout | None:
        """Return the first layout that fits the numbers of a table; None if none does."""
        index = [i for i, label in enumerate(sheet.labels) if label]
        values = np.column_stack([sheet.first_numbers(i) for i in index])
        for places, layout in _layouts(values, schema):
            named = dict(zip((index[i] for i in places), layout.names, strict=True))
            every = [named.get(i, "") or f"column {i + 1}" for i in range(len(sheet.labels))]
            return replace(
                layout,
                labels=tuple(sheet.labels[i] for i in index),
                names=tuple(named.get(i, "") for i in index),
                header=sheet.separator.join(every) if sheet.separator else "",
            )
        return None


def _layouts(values: np.ndarray, schema: Schema) -> Iterator[tuple[list[int], _Layout]]:
    """Yield the layouts that fit columns, shape (M, k), and their places: the joints before the
    reading or behind it, with a counter before them or without.
    """
    for first, is_before in product((0, 1), (True, False)):
        rest = values[:, first:]
        n = len(schema.own_joints)
        size = rest.shape[1] - n
        if size < 1 or (first and not is_counter(values[:, 0])):
            continue
        unit = unit_of_joints(rest[:, :n] if is_before else rest[:, size:])
        found = _of_reading(rest[:, n:] if is_before else rest[:, :size])
        if unit is None or found is None:
            continue
        joints = tuple(f"{name} {unit}".strip() for name in schema.own_joints)
        words = f"the {n} joints in the order of the URDF{_in_words(unit)}"
        names = (*joints, *found.names) if is_before else (*found.names, *joints)
        both = f"{words} and {found.words}" if is_before else f"{found.words} and {words}"
        yield [*range(first, values.shape[1])], replace(found, names=names, words=both)


def _of_reading(values: np.ndarray) -> _Layout | None:
    """Return the names and words of the columns of a reading, shape (M, m); None if it is none."""
    count = values.shape[1]
    if count in (12, 16):
        order = order_of_matrix(values)
        if order is None:
            return None
        names = [""] * count
        for i, row in enumerate(order):
            for j, place in enumerate(row):
                names[place] = f"{'xyz'[i]}{_unit_of_place(values[:, order[:, 3]])}"
                if j < 3:
                    names[place] = f"r{i + 1}{j + 1}"
        return _Layout((), tuple(names), "the numbers of a 4 x 4 matrix")
    if count not in _READINGS:
        return None
    columns, words = _READINGS[count]
    if count == 7:
        norms = np.linalg.norm(values[:, 3:], axis=1)
        if not np.all(np.abs(norms[np.isfinite(norms)] - 1.0) < PLAUSIBLE.norm):
            return None
    size = min(count, 3)
    unit = _unit_of_place(values[:, :size])
    of_place = [f"{name}{unit}" for name in columns[:size]]
    turned = columns[size:]
    if count == 6 and np.nanmax(np.abs(values[:, 3:])) > PLAUSIBLE.longest_turn:
        turned = tuple(f"{name} [deg]" for name in turned)
    other = {6: _OTHER_ANGLES, 7: _OTHER_ORDER}.get(count, "")
    return _Layout((), (*of_place, *turned), f"{words}{_in_words(unit.strip())}", other)


def is_counter(values: np.ndarray) -> bool:
    """Return whether a column counts the rows, or has no numbers, such as names of poses."""
    return bool(np.isnan(values).all() or (np.diff(values) == 1.0).all())


def unit_of_joints(values: np.ndarray) -> str | None:
    """Return the unit in brackets of joint positions, empty for rad; None if they can't be any."""
    largest = np.nanmax(np.abs(values), initial=0.0)
    if not values.size or np.isnan(values).any():
        return None
    if largest <= JOINT_COLUMNS.most_rad:
        return ""
    return "[deg]" if largest <= np.degrees(JOINT_COLUMNS.most_rad) else None


def _unit_of_place(values: np.ndarray) -> str:
    """Return the unit of positions, with a blank before it; empty for m."""
    return " [mm]" if np.nanmax(np.abs(values), initial=0.0) > PLAUSIBLE.farthest else ""


def _in_words(unit: str) -> str:
    words = {"[deg]": "degrees", "[mm]": "mm", "": ""}[unit]
    return f" ({words})" if words else ""
