"""What a header means: the columns that are needed, with their units; what is guessed or left out is told."""

from __future__ import annotations

import difflib
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from pincal.errors import MeasurementError, PincalWarning, nearest_first
from pincal.measure.fields import Field
from pincal.measure.labels import Label, listed, numbered_joints, renamed, spelled, unit_of, without, without_unit
from pincal.measure.orientation import CONVENTIONS, Orientation, find_orientation, looks_like_orientation
from pincal.measure.schema import Schema
from pincal.measure.sheet import Column, Sheet

# Unknown columns that are looked at, and those that a message lists.
_LOOKED_AT, _LISTED = 500, 20


@dataclass(frozen=True)
class Header:
    """What a header means: the columns that are needed, the joints among them, and those that tell an orientation."""

    columns: tuple[Column, ...]
    joints: tuple[str, ...]
    orientation: Orientation | None


def rotations(fields: Iterable[Field]) -> Field:
    """Return the field that holds a unit quaternion."""
    return next(part for part in fields if part.is_unit)


def understood(sheet: Sheet, schema: Schema) -> Header:
    """Return what a header means; raise for what is not understood, warn of what is guessed or left out."""
    source, options = sheet.path.name, schema.options
    labels = without(renamed(sheet.labels, options.columns, source=source), options.ignore)
    quantities = schema.quantities(source=source)
    labels = with_joints(labels, schema, quantities, source=source)
    orientation = None
    if any(part.is_unit for part in schema.fields):
        orientation = _orientation(labels, schema, quantities, source=source)
    units = {}
    if orientation is not None:
        hidden = {*rotations(schema.fields).columns} - {*orientation.columns} if options.orientation else set()
        quantities = {name: quantity for name, quantity in quantities.items() if name not in hidden}
        quantities |= dict.fromkeys(orientation.columns, orientation.quantity)
        units = dict.fromkeys(orientation.columns, orientation.convention.unit)
    columns, unknown = matched(labels, quantities, units, source=source)
    joints = schema.joint_names
    if schema.may_lack_joints and not columns.keys() & set(joints):
        joints = ()
    check_joints([name for name in schema.own_joints if joints and name not in columns], unknown, sheet)
    if "*" not in options.ignore and not sheet.takes_unknown:
        free = {name: quantity for name, quantity in quantities.items() if name not in columns}
        _check_unknown(sheet, unknown, free)
    return Header(tuple(columns.values()), joints, orientation)


def with_joints(labels: list[Label], schema: Schema, quantities: Mapping[str, str], *, source: str) -> list[Label]:
    """Return the labels with those replaced that number the joints, if no joint has a column under its name."""
    names = set(schema.joint_names)
    if not names or any(label.name in names or (spelled(label, quantities) or ("", ""))[0] in names for label in labels):
        return labels
    free = [label for label in labels if label.name not in quantities]
    guessed = numbered_joints(free, schema.own_joints)
    if not guessed:
        return labels
    pairs = ", ".join(f"{label}={joint}" for label, joint in guessed.items())
    warnings.warn(
        f"{source}: joints are taken from the columns {pairs}; if that is wrong, say which with --columns",
        PincalWarning,
        stacklevel=2,
    )
    return [replace(label, meant=guessed.get(label.meant, label.meant)) for label in labels]


def _orientation(labels: list[Label], schema: Schema, quantities: Mapping[str, str], *, source: str) -> Orientation | None:
    """Return how the table tells an orientation, None if it does so by qx qy qz qw or not at all."""
    names, said = [without_unit(label.meant) for label in labels], schema.options.orientation
    usual = rotations(schema.fields).columns
    found = find_orientation(names, said, taken=[n for n in quantities if n not in usual], source=source)
    if found is None or said is not None:
        return found
    if set(usual) & set(names):
        raise MeasurementError(
            f"{source}: orientations in {' '.join(found.columns)} and in {' '.join(usual)}; expected one: ignore the others"
        )
    warnings.warn(
        f"{source}: {' '.join(found.columns)} are read as {found.convention.words}; if that is wrong, say how with "
        f"--orientation {'|'.join(CONVENTIONS)}",
        PincalWarning,
        stacklevel=2,
    )
    return found


def matched(
    labels: Sequence[Label], quantities: Mapping[str, str], units: Mapping[str, str], *, source: str
) -> tuple[dict[str, Column], list[Label]]:
    """Return the columns that are known, and the labels that are not; a name as it is known goes before other spellings.

    Args:
        labels: the header.
        quantities: what is known.
        units: of columns whose label has none, where that is not SI.
        source: the file, for messages.
    """
    exact = {label.name for label in labels} & quantities.keys()
    columns, unknown = dict[str, Column](), list[Label]()
    for label in labels:
        found = spelled(label, quantities)
        if found is None or (found[0] in exact and found[0] != label.name):
            unknown.append(label)
            continue
        name, unit = found
        if "[" in unit:
            unit = unit_of(unit, quantities[name], where=f'{source}, column {label.index + 1} ("{label.text}")')
        if name in columns:
            raise MeasurementError(f'{source}: two columns "{name}"; expected one, delete or rename the other')
        columns[name] = Column(label.index, name, label.text, unit or units.get(name, ""), quantities[name])
    return columns, unknown


def check_joints(missing: Sequence[str], unknown: Sequence[Label], sheet: Sheet) -> None:
    """Refuse a table that lacks joints, with the columns that may be meant."""
    if not missing:
        return
    texts, labels = [], [label.text for label in unknown]
    for name in missing:
        close = difflib.get_close_matches(name, labels, n=1, cutoff=0.6)
        texts.append(f'"{name}"' + (f' (is it "{close[0]}"?)' if close else ""))
    raise MeasurementError(
        f"{sheet.path.name}: no column for joint {', '.join(texts)}; expected a column named as in the URDF, or "
        f"--columns 'NAME={missing[0]},...'; {listed(sheet.labels)}"
    )


def _check_unknown(sheet: Sheet, unknown: Sequence[Label], free: Mapping[str, str]) -> None:
    """Refuse unknown columns, but for words that nobody needs, which are left out with a `PincalWarning`."""
    names = [name for name, quantity in free.items() if quantity == "name"]
    wrong, words = list[str](), list[str]()
    for label in unknown[:_LOOKED_AT]:
        is_close = difflib.get_close_matches(label.name.casefold(), names, n=1, cutoff=0.75)
        if sheet.is_blank(label.index):
            continue
        (words if sheet.has_words(label.index) and not is_close else wrong).append(label.text)
    if wrong or len(unknown) > _LOOKED_AT:
        few = wrong[:_LISTED] or [unknown[-1].text]
        known = ", ".join(nearest_first(few, free)[:_LISTED])
        hint = f"; an orientation? --orientation {'|'.join(CONVENTIONS)}" if looks_like_orientation(wrong) else ""
        raise MeasurementError(
            f"{sheet.path.name}: unknown column {', '.join(map(_short, few))}; known and not in the table, nearest first: "
            f"{known or 'none'}{hint}; leave it out (--ignore '{few[0][:30]}'), or say what it holds "
            f"(--columns '{few[0][:30]}=NAME'; a unit is written as x [mm]); {listed(sheet.labels)}"
        )
    if words:
        texts = ", ".join(map(_short, words[:_LISTED]))
        warnings.warn(f"{sheet.path.name}: columns of text are left out: {texts}", PincalWarning, stacklevel=2)


def _short(text: str) -> str:
    return f'"{text[:30]}"'
