"""Poses whose matrices are written number by number into columns: ``T_00`` to ``T_33``, ``r11`` to
``r33`` with a position, ``pose_0`` to ``pose_15``.

The names say which numbers belong together; that they are a matrix, and in which order they stand,
is decided by the numbers.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pincal.errors import MeasurementError, warn
from pincal.measure.flat_matrices import order_of_matrix, quaternions_of
from pincal.measure.hand_eye import grouped, is_of_hand
from pincal.measure.labels import Label, spelled, splits
from pincal.measure.orientation import MATRIX
from pincal.measure.reading_numbers import LAYOUT
from pincal.measure.sheet import Sheet

# Row and column of an element, and the number of one, at the end of a name.
_BY_PLACE = re.compile(r"(.*?)[ _.\-\[({]*([0-4])[\])}]*[ _.,\[(]*([0-4])[\])}]*")
_BY_NUMBER = re.compile(r"(.*?)[ _.\-\[({]*(\d{1,2})[\])}]*")


@dataclass(frozen=True)
class _Family:
    """Labels that may be the elements of a matrix.

    Attributes:
        name: what their names have in common.
        rows: the labels row by row: three of three or four, or four of four.
        units: of the elements, in the same order; empty where a label has none.
    """

    name: str
    rows: tuple[tuple[Label, ...], ...]
    units: Mapping[Label, str]

    @property
    def labels(self) -> list[Label]:
        """All labels, row by row."""
        return [label for row in self.rows for label in row]

    @property
    def is_rotation(self) -> bool:
        """Whether it is a rotation alone."""
        return len(self.labels) == len(MATRIX.columns)

    def judged(self, sheet: Sheet) -> np.ndarray | None:
        """Return the places of the elements among the labels, shape (3, 3) or (3, 4), if the
        numbers of a table are such matrices; else None.
        """
        values = np.column_stack([sheet.first_numbers(label.index) for label in self.labels])
        if not self.is_rotation:
            return order_of_matrix(values)
        whole = values[np.isfinite(values).all(axis=1)].reshape(-1, 3, 3)
        if not len(whole):
            return None
        is_turn = np.isfinite(quaternions_of(whole)).all(axis=1)
        return np.arange(9).reshape(3, 3) if np.mean(is_turn) > LAYOUT.filled else None


def with_matrix(
    labels: list[Label], sheet: Sheet, quantities: Mapping[str, str], *, source: str
) -> list[Label]:
    """Return the labels with the elements of a matrix named, if some are one: positions ``x y z``
    and :data:`pincal.measure.orientation.MATRIX`; warn of it.

    A position under its own name takes precedence over that of the matrix.

    Raises:
        MeasurementError: for several matrices, of which none is known to be the controller's.
    """
    free = [label for label in labels if not spelled(label, quantities)]
    found = [
        (family, order) for family in _families(free) if (order := family.judged(sheet)) is not None
    ]
    measured = [pair for pair in found if not is_of_hand(_what(pair[0].name))]
    found = measured or found
    if not found:
        return labels
    if len(found) > 1:
        firsts = " and ".join(f'"{family.labels[0].text}"' for family, _ in found)
        other = found[-1][0].labels[0].text.rstrip("0123456789_[](){}., ")
        raise MeasurementError(
            f"{source}: the pose may be the matrix of {firsts}; expected one: leave the others out "
            f"(--ignore '{other}*')"
        )
    ((family, order),) = found
    named = {(spelled(label, quantities) or ("",))[0] for label in labels}
    meant = _meanings(family, order, has_place="x" in named)
    first, *_, last = family.labels
    what = "a rotation matrix" if family.is_rotation else "a 4 x 4 matrix"
    warn(
        f'{source}: "{first.text}" to "{last.text}" are read as {what}; if that is wrong, '
        "--ignore them"
    )
    return [
        replace(label, meant=meant.get(label, label.meant))
        for label in labels
        if label not in family.labels or label in meant
    ]


def _meanings(family: _Family, order: np.ndarray, *, has_place: bool) -> dict[Label, str]:
    """Return the meanings of the labels of a matrix; its last row, and a position that has its own
    columns, have none.
    """
    labels = family.labels
    turned = zip(order[:, :3].ravel(), MATRIX.columns, strict=True)
    found = {labels[place]: column for place, column in turned}
    if order.shape[1] > 3 and not has_place:
        for place, axis in zip(order[:, 3], "xyz", strict=True):
            unit = family.units[labels[place]]
            found[labels[place]] = f"{axis} [{unit}]" if unit else axis
    return found


def _what(name: str) -> str:
    """Return what a matrix is of, by the name of its elements without their numbers."""
    return grouped(name.strip("_ .")).split(".")[0]


def _families(labels: Sequence[Label]) -> Iterator[_Family]:
    """Yield sets of labels that differ by the place of an element in a matrix, or by its number."""
    by_place = dict[str, dict[tuple[int, int], tuple[Label, str]]]()
    by_number = dict[str, dict[int, tuple[Label, str]]]()
    for label in labels:
        base, unit = _without_unit(label)
        if match := _BY_PLACE.fullmatch(base):
            place = int(match[2]), int(match[3])
            by_place.setdefault(match[1].casefold(), {}).setdefault(place, (label, unit))
        if match := _BY_NUMBER.fullmatch(base):
            by_number.setdefault(match[1].casefold(), {}).setdefault(int(match[2]), (label, unit))
    for name, elements in by_place.items():
        rows = sorted({i for i, _ in elements})
        columns = sorted({j for _, j in elements})
        size = len(rows), len(columns)
        is_whole = len(elements) == size[0] * size[1] and rows[0] == columns[0] < 2
        if is_whole and size in ((3, 3), (3, 4), (4, 3), (4, 4)):
            yield _family(name, [[elements[i, j] for j in columns] for i in rows])
    for name, numbered in by_number.items():
        keys = sorted(numbered)
        is_whole = keys[0] < 2 and keys == [*range(keys[0], keys[0] + len(keys))]
        if is_whole and len(keys) in (9, 12, 16):
            width = 3 if len(keys) == 9 else 4
            rest = [numbered[k] for k in keys]
            yield _family(name, [rest[i : i + width] for i in range(0, len(rest), width)])


def _without_unit(label: Label) -> tuple[str, str]:
    """Return a label without its unit, and the unit; ``T[0][3]`` has none."""
    if re.search(r"\[\d", label.meant):
        return label.meant, ""
    return next((pair for pair in splits(label.meant) if pair[1]), (label.name, ""))


def _family(name: str, rows: Sequence[Sequence[tuple[Label, str]]]) -> _Family:
    units = {label: unit for row in rows for label, unit in row}
    return _Family(name, tuple(tuple(label for label, _ in row) for row in rows), units)
