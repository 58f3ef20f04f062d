"""What a header means: the columns that are needed, with their units; what is guessed or left out is told."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from pincal.errors import MeasurementError, nearest_first, warn
from pincal.measure.fields import CONDITIONS, SIGMA, Field, Schema
from pincal.measure.heading import NUMBERED, normal_unit
from pincal.measure.orientation import CONVENTIONS, Convention, find_orientation, looks_like_orientation, looks_like_place
from pincal.measure.sheet import Sheet, SheetColumn
from pincal.units import UNITS

# `x [mm]` is how pincal writes a unit; these are the other spellings: `x (mm)`, `x_mm`, `x mm`, `x/mm`.
_OTHER_SPELLINGS = (r"(.*?)\s*\(\s*([^()]*?)\s*\)", r"(.*)_([^_]*)", r"(.*?)\s+(\S*)", r"(.*?)\s*/\s*(\S*)")
# An ending that is a unit and a word of its own.
_WORDS = ("in",)


@dataclass(frozen=True)
class Label:
    """A label of a header.

    Attributes:
        index: of the column.
        text: what the header says.
        meant: the same after the user's word on it.
    """

    index: int
    text: str
    meant: str

    @property
    def name(self) -> str:
        """What it is called, a unit in brackets left out."""
        return name_of(self.meant)


def name_of(label: str) -> str:
    """Return a label without its unit in brackets."""
    return label.split("[")[0].strip()


def renamed(labels: Sequence[str], columns: Mapping[str, str], *, source: str, others: Sequence[str] = ()) -> list[Label]:
    """Return the labels with what the user says of some; a unit of the header stays unless the user names one.

    Args:
        labels: the header.
        columns: names and what they hold.
        source: the file, for messages.
        others: labels of a file that is joined with it, which the user may mean, too.

    Raises:
        MeasurementError: for a name that no column or more than one has.
    """
    found = [Label(i, text, text) for i, text in enumerate(labels)]
    for name, meaning in columns.items():
        hits = [i for i, text in enumerate(labels) if is_named(text, name)]
        if not hits and any(is_named(text, name) for text in others):
            continue
        if len(hits) != 1:
            column, bracket, unit = meaning.partition("[")
            swapped = not hits and any(is_named(text, column.strip()) for text in labels)
            hint = f'; is "{column.strip()}={name}{bracket and f" [{unit}"}" meant?' if swapped else ""
            count = "no column" if not hits else f"{len(hits)} columns"
            raise MeasurementError(
                f'{source}: {count} "{name}" for --columns {name}={meaning}{hint}; {columns_listed(labels)}'
            )
        text = labels[hits[0]]
        unit = _unit_in(text)
        found[hits[0]] = Label(hits[0], text, meaning if "[" in meaning or not unit else f"{meaning} [{unit}]")
    return found


def is_named(text: str, name: str) -> bool:
    """Return whether the user may call a column so: by its label, with or without a unit."""
    return name in (text, name_of(text), _bare(text))


def unignored(labels: Sequence[Label], ignored: Sequence[str]) -> list[Label]:
    """Return the labels without those that the user wants to be ignored, by whatever name."""
    return [label for label in labels if not {label.name, label.meant, label.text} & set(ignored)]


def columns_listed(labels: Sequence[str], most: int = 20) -> str:
    """Return what a table has, for messages."""
    shown = ", ".join(f'"{text[:30]}"' for text in labels[:most])
    return f"the table has {shown}{', ...' if len(labels) > most else ''}"


def _bare(text: str) -> str:
    """Return a label without a unit in parentheses."""
    match = re.fullmatch(_OTHER_SPELLINGS[0], text)
    return match[1] if match else text


def _unit_in(text: str) -> str:
    match = re.fullmatch(r"[^\[(]*[\[(]([^\])]*)[\])]\s*", text)
    return match[1].strip() if match else ""


def spelled(label: Label, quantities: Mapping[str, str]) -> tuple[str, str] | None:
    """Return the known name and the unit of a label in another spelling than ``name [unit]``; None if there is none.

    Example:
        >>> known = {"x": "length", "joint_1": "angle"}
        >>> [spelled(Label(0, text, text), known) for text in ("X", "x (mm)", "Joint_1_deg", "x_kg")]
        [('x', ''), ('x', 'mm'), ('joint_1', 'deg'), None]
    """
    folded: dict[str, list[str]] = {}
    for each in quantities:
        folded.setdefault(each.casefold(), []).append(each)

    def known(text: str) -> str | None:
        same = folded.get(text.strip().casefold(), [])
        return text.strip() if text.strip() in quantities else same[0] if len(same) == 1 else None

    if (plain := known(label.name)) is not None:
        return plain, label.meant[len(label.meant.split("[")[0]) :]
    for place, pattern in enumerate(_OTHER_SPELLINGS):
        match = re.fullmatch(pattern, label.meant)
        name = known(match[1]) if match else None
        if match and name:
            unit = normal_unit(match[2])
            if unit in UNITS[quantities[name]] and (place == 0 or unit not in _WORDS):
                return name, unit
    return None


def unit_of(label: str, quantity: str, *, where: str) -> str:
    """Return the unit that a label has in brackets; empty without any.

    Raises:
        MeasurementError: for a unit that is not closed or not of this quantity.
    """
    match = re.fullmatch(r"[^\[\]]*(?:\[([^\[\]]*)\])?", label)
    unit = normal_unit(match[1] or "") if match else ""
    accepted = ", ".join(f"[{unit}]" for unit in UNITS[quantity]) or "no unit"
    if match is None:
        raise MeasurementError(f"{where}: unclosed unit; expected at its end one of {accepted}")
    if "[" in label and unit not in UNITS[quantity]:
        raise MeasurementError(f"{where}: [{unit}] is no unit of this column; expected one of {accepted}")
    return unit


def numbered_joints(labels: Sequence[Label], joints: Sequence[str]) -> dict[str, str]:
    """Return the labels, as they are meant, that number all the joints of an arm; empty if none do or several.

    Joints stand in their order from the base to the flange, counted from 1 or from 0. Labels with a further number, such as
    that of an external axis, are not taken for those of an arm; nor are q1 q2 q3 q4, which may be a quaternion.

    Example:
        >>> labels = [Label(i, f"J{i + 1} (deg)", f"J{i + 1} (deg)") for i in range(2)]
        >>> numbered_joints(labels, ["shoulder", "elbow"])
        {'J1 (deg)': 'shoulder [deg]', 'J2 (deg)': 'elbow [deg]'}
    """
    families: dict[str, dict[int, tuple[Label, str]]] = {}
    for label in labels:
        for base, unit in _splits(label.meant):
            if match := NUMBERED.fullmatch(base):
                prefix = base[: match.start(2)].casefold()
                families.setdefault(prefix, {})[int(match[2])] = label, unit
                break
    n = len(joints)
    whole = [
        [family[i] for i in sorted(family)]
        for prefix, family in families.items()
        if sorted(family) in ([*range(n)], [*range(1, n + 1)]) and not (prefix == "q" and n == 4)
    ]
    if len(whole) != 1:
        return {}
    pairs = zip(whole[0], joints, strict=True)
    return {label.meant: f"{joint} [{unit}]" if unit else joint for (label, unit), joint in pairs}


def without_unit(text: str) -> str:
    """Return a label without the unit of an angle or a length, in whatever spelling.

    Example:
        >>> without_unit("Roll (deg)"), without_unit("rx_deg"), without_unit("q_1")
        ('Roll', 'rx', 'q_1')
    """
    return next((base for base, unit in _splits(text) if unit), name_of(text))


def _splits(text: str) -> Iterator[tuple[str, str]]:
    """Yield a label as name and unit, in all spellings."""
    yield name_of(text), _unit_in(text) if "[" in text else ""
    known: Collection[str] = {*UNITS["angle"], *UNITS["length"]}
    for pattern in _OTHER_SPELLINGS:
        match = re.fullmatch(pattern, text)
        if match and normal_unit(match[2]) in known:
            yield match[1], normal_unit(match[2])


# Unknown columns that are looked at, and those that a message lists.
_LOOKED_AT, _LISTED = 500, 20


@dataclass(frozen=True)
class Header:
    """What a header means.

    Attributes:
        columns: those that are needed.
        joints: the joints among them.
        orientation: how they tell an orientation, if not by a quaternion.
        readings: those of them that hold what was measured: rows where one is empty are left out.
        flag: a column that says of each row whether its reading is valid, if there is one.
    """

    columns: tuple[SheetColumn, ...]
    joints: tuple[str, ...]
    orientation: Convention | None
    readings: tuple[str, ...] = ()
    flag: SheetColumn | None = None


def rotations(fields: Iterable[Field]) -> Field:
    """Return the field that holds a unit quaternion."""
    return next(part for part in fields if part.is_unit)


def understood(sheet: Sheet, schema: Schema) -> Header:
    """Return what a header means; raise for what is not understood, warn of what is guessed or left out."""
    source, options = sheet.path.name, schema.options
    labels = unignored(renamed(sheet.labels, options.columns, source=source), options.ignore)
    quantities = schema.quantities(source=source)
    labels = _timed(with_joints(labels, schema, quantities, source=source), sheet, quantities)
    orientation = None
    if any(part.is_unit for part in schema.fields):
        orientation = _orientation(labels, schema, quantities, source=source)
    units = {}
    if orientation is not None:
        hidden = {*rotations(schema.fields).columns} - {*orientation.columns} if options.orientation else set()
        quantities = {name: quantity for name, quantity in quantities.items() if name not in hidden}
        quantities |= dict.fromkeys(orientation.columns, orientation.quantity)
        units = dict.fromkeys(orientation.columns, orientation.unit)
    columns, unknown = matched(labels, quantities, units, source=source)
    joints = schema.joint_names
    if schema.may_lack_joints and not columns.keys() & set(joints):
        joints = ()
    check_joints([name for name in schema.own_joints if joints and name not in columns], unknown, sheet)
    readings = [part for part in schema.fields if part.name not in CONDITIONS and part != SIGMA]
    told = {*columns, *(rotations(schema.fields).columns if orientation else ())}
    flag = next((label for label in unknown if label.name.casefold() in FLAGS), None)
    if "*" not in options.ignore and not sheet.takes_unknown:
        free = {name: quantity for name, quantity in quantities.items() if name not in columns}
        found = [told.intersection(part.columns) for part in readings if told.intersection(part.columns)]
        is_whole = bool(found) and all(
            len(some) == len(part.columns) for part in readings if (some := told & {*part.columns})
        )
        others = [label for label in unknown if label is not flag]
        # A program is complete without a pose, unless other columns may be one.
        names = [without_unit(label.name) for label in others]
        is_whole |= schema.may_lack_joints and bool(joints) and not found and not looks_like_place(names)
        is_turned = orientation is None and looks_like_orientation([label.name for label in others])
        _check_unknown(sheet, others, free, is_complete=is_whole and not is_turned)
    measured = {name for part in readings for name in part.columns} | {*(orientation.columns if orientation else ())}
    return Header(
        tuple(columns.values()),
        joints,
        orientation,
        tuple(name for name in columns if name in measured),
        None if flag is None or not readings else SheetColumn(flag.index, "\0flag", flag.text, "", "name"),
    )


# Columns that say whether a row's reading is valid.
FLAGS = ("valid", "is_valid", "isvalid", "ok", "visible", "tracked", "status", "state", "quality", "flag", "flags")


def _timed(labels: list[Label], sheet: Sheet, quantities: Mapping[str, str]) -> list[Label]:
    """Return the labels with a column timestamp of numbers taken for the time, if nothing else is."""
    stamps = [label for label in labels if without_unit(label.name).casefold() in ("timestamp", "time_stamp", "time stamp")]
    named = any((spelled(label, quantities) or ("",))[0] == "time" for label in labels)
    if len(stamps) != 1 or named or "time" not in quantities or sheet.has_words(stamps[0].index):
        return labels
    unit = _unit_in(stamps[0].meant) or "s"
    warn(f'{sheet.path.name}: "{stamps[0].text[:30]}" is read as time [{unit}]; if that is wrong, --ignore it')
    return [replace(label, meant=f"time [{unit}]") if label in stamps else label for label in labels]


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
    warn(f"{source}: joints are taken from the columns {pairs}; if that is wrong, map them with --columns")
    return [replace(label, meant=guessed.get(label.meant, label.meant)) for label in labels]


def _orientation(labels: list[Label], schema: Schema, quantities: Mapping[str, str], *, source: str) -> Convention | None:
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
    warn(
        f"{source}: {' '.join(found.columns)} are read as {found.words}; if that is wrong, use "
        f"--orientation {'|'.join(CONVENTIONS)}"
    )
    return found


def matched(
    labels: Sequence[Label], quantities: Mapping[str, str], units: Mapping[str, str], *, source: str
) -> tuple[dict[str, SheetColumn], list[Label]]:
    """Return the columns that are known, and the labels that are not; a name as it is known goes before other spellings.

    Args:
        labels: the header.
        quantities: what is known.
        units: of columns whose label has none, where that is not SI.
        source: the file, for messages.
    """
    exact = {label.name for label in labels} & quantities.keys()
    columns, unknown = dict[str, SheetColumn](), list[Label]()
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
        columns[name] = SheetColumn(label.index, name, label.text, unit or units.get(name, ""), quantities[name])
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
        f"--columns 'NAME={missing[0]},...', or a log of the joints (--joints LOG); {columns_listed(sheet.labels)}"
    )


def _check_unknown(sheet: Sheet, unknown: Sequence[Label], free: Mapping[str, str], *, is_complete: bool) -> None:
    """Leave out unknown columns with a `PincalWarning`; refuse those that may be meant.

    Args:
        sheet: the table.
        unknown: columns that nobody knows.
        free: what is known and not in the table.
        is_complete: whether nothing that is needed is missing, so that only a slip of the pen can be meant.
    """
    wrong, words, others = list[str](), list[str](), list[str]()
    for label in unknown[:_LOOKED_AT]:
        if sheet.is_blank(label.index):
            continue
        is_word = sheet.has_words(label.index)
        names = [name for name, quantity in free.items() if not is_word or quantity == "name"]
        close = difflib.get_close_matches(label.name.casefold(), names, n=1, cutoff=0.75)
        is_longer = bool(close) and re.match(rf"{close[0]}..|.*[ _.-]{close[0]}$", label.name.casefold()) is not None
        is_slip = bool(close) and not is_longer
        (wrong if is_slip else words if is_word else others if is_complete else wrong).append(label.text)
    if wrong or len(unknown) > _LOOKED_AT:
        few = wrong[:_LISTED] or [unknown[-1].text]
        known = ", ".join(nearest_first(few, free)[:_LISTED])
        hint = f"; an orientation? --orientation {'|'.join(CONVENTIONS)}" if looks_like_orientation(wrong) else ""
        raise MeasurementError(
            f"{sheet.path.name}: unknown column {', '.join(map(_short, few))}; known and not in the table, nearest first: "
            f"{known or 'none'}{hint}; leave it out (--ignore '{few[0][:30]}'), or say what it holds "
            f"(--columns '{few[0][:30]}=NAME'; a unit is written as x [mm]); {columns_listed(sheet.labels)}"
        )
    for texts, what in ((words, "columns of text"), (others, "columns unknown to pincal")):
        if texts:
            more = f" and {len(texts) - _LISTED} more" if len(texts) > _LISTED else ""
            warn(f"{sheet.path.name}: {what} are ignored: {', '.join(map(_short, texts[:_LISTED]))}{more}")


def _short(text: str) -> str:
    return f'"{text[:30]}"'
