"""Quaternions whose components are numbered: q0 to q3, quat_0 to quat_3."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pincal.errors import MeasurementError, warn
from pincal.measure.labels import Label, spelled
from pincal.measure.reading_numbers import LAYOUT
from pincal.measure.sheet import Sheet

_NAMED = re.compile(r"(.*?)[ _.\[]*([0-4])\]?")
# Names that components of a quaternion have; the scalar of q0 q1 q2 q3 is q0 wherever it is written
# so, as q1 is of ABB's q1 q2 q3 q4.
_SCALAR_FIRST = "q"
_NAMES = (_SCALAR_FIRST, "quat", "quaternion", "orientation", "rotation", "rot", "ori")
_FIRST = ("qw", "qx", "qy", "qz")
_LAST = ("qx", "qy", "qz", "qw")


def with_quaternion(
    labels: list[Label], sheet: Sheet, quantities: Mapping[str, str], *, source: str
) -> list[Label]:
    """Return the labels with the components of a quaternion named, if four are numbered from 0, or
    from 1, and their squares add up to 1; warn of it.

    Raises:
        MeasurementError: where nothing says which of them is the scalar.
    """
    named = {(spelled(label, quantities) or ("",))[0] for label in labels}
    if "qx" in named or not {*_FIRST} <= quantities.keys():
        return labels
    for name, family in _families(labels, quantities).items():
        if not _is_unit(family, sheet):
            continue
        is_told = name == _SCALAR_FIRST
        if not is_told:
            first, last = (
                ",".join(f"{one.text}={m}" for one, m in zip(family, meant, strict=True))
                for meant in (_FIRST, _LAST)
            )
            raise MeasurementError(
                f'{source}: "{family[0].text}" to "{family[-1].text}" are a quaternion, and '
                f"nothing says which is its scalar; give --columns '{first}' if it is the first, "
                f"--columns '{last}' if it is the last, or --ignore them"
            )
        warn(
            f'{source}: "{family[0].text}" to "{family[-1].text}" are read as a quaternion w x y '
            "z; if that is wrong, name them with --columns"
        )
        meanings = dict(zip(family, _FIRST, strict=True))
        return [replace(label, meant=meanings.get(label, label.meant)) for label in labels]
    return labels


def _families(
    labels: Sequence[Label], quantities: Mapping[str, str]
) -> dict[str, tuple[Label, ...]]:
    """Return sets of four labels that differ by a number, from 0 to 3 or from 1 to 4, by their
    names; q1 to q4 are a convention of their own.
    """
    found = dict[str, dict[int, Label]]()
    for label in labels:
        match = _NAMED.fullmatch(label.name.casefold())
        if match and match[1] in _NAMES and not spelled(label, quantities):
            found.setdefault(match[1], {})[int(match[2])] = label
    return {
        name: tuple(own[k] for k in sorted(own))
        for name, own in found.items()
        if sorted(own) == [0, 1, 2, 3] or (sorted(own) == [1, 2, 3, 4] and name != _SCALAR_FIRST)
    }


def _is_unit(family: Sequence[Label], sheet: Sheet) -> bool:
    """Return whether the first rows are unit quaternions."""
    values = np.column_stack([sheet.first_numbers(label.index) for label in family])
    squares = np.sum(values[np.isfinite(values).all(axis=1)] ** 2, axis=1)
    return bool(len(squares) and (np.abs(squares - 1.0) < LAYOUT.orthonormal).all())
