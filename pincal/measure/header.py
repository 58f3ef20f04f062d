"""Interpretation of a header: the needed columns with their units; guesses and omissions are
reported.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from pincal.errors import MeasurementError, nearest_first, warn
from pincal.measure.labels import (
    Label,
    check_one,
    columns_listed,
    joint_families,
    name_of,
    numbered_families,
    numbered_joints,
    numbers_all,
    renamed,
    spelled,
    splits,
    unignored,
    unit_in,
    unit_of,
    vector_columns,
    without_unit,
    words_of,
)
from pincal.measure.matrix_columns import with_matrix
from pincal.measure.nameless import check_named, is_counter, unit_of_joints
from pincal.measure.numbered_quaternion import with_quaternion
from pincal.measure.orientation import (
    CONVENTIONS,
    MATRIX,
    NO_ORIENTATION,
    Convention,
    columns_of_orientations,
    find_orientation,
    looks_like_orientation,
    looks_like_place,
)
from pincal.measure.reading_numbers import LAYOUT
from pincal.measure.sheet import Sheet, SheetColumn
from pincal.measure.table_schema import Schema
from pincal.sensors.fields import CONDITIONS, SIGMA, Field
from pincal.thresholds import Count
from pincal.units import SIZES, plain_numbers

# Unknown columns that are examined, and those that a message lists.
_EXAMINED: Count = 500
_LISTED: Count = 20
# Columns by which a table has an orientation under names of its own.
_ORIENTED = frozenset(("qx", "rx", "roll", "A", "W", "q1", "r11"))
# Unread columns of a stream that a note lists.
_UNREAD: Count = 8


@dataclass(frozen=True)
class Header:
    """An interpreted header.

    Attributes:
        columns: the needed ones.
        joints: the joints among them.
        orientation: how they give an orientation, if not by a quaternion.
        readings: those that contain measured values: rows with an empty one are left out.
        flag: a column that states whether the reading of each row is valid, if there is one.
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
    """Return the interpretation of a header; raise for what is ambiguous, warn of guesses and
    omissions.
    """
    source = sheet.path.name
    check_named(sheet, schema)
    quantities = schema.quantities(source=source)
    labels = _labels(sheet, schema, quantities)
    meanings = _meanings(labels, schema, quantities, source=source)
    columns, unknown = matched(labels, meanings.quantities, meanings.units, source=source)
    joints = schema.joint_names
    if schema.may_lack_joints and not columns.keys() & set(joints):
        joints = ()
    missing = [name for name in schema.needed_joints if joints and name not in columns]
    check_joints(missing, unknown, sheet)
    readings = [part for part in schema.fields if part.name not in CONDITIONS and part != SIGMA]
    flag = next((label for label in unknown if label.name.casefold() in FLAGS), None)
    if schema.is_stream:
        _warn_of_unread(sheet, unknown)
    elif "*" not in schema.options.ignore and not sheet.takes_unknown:
        others = [label for label in unknown if label is not flag]
        free = {name: of for name, of in meanings.quantities.items() if name not in columns}
        whole = _is_complete(others, {*columns}, readings, meanings.orientation, schema)
        _check_unknown(sheet, others, free, is_complete=whole)
    return Header(
        tuple(columns.values()),
        joints,
        meanings.orientation,
        tuple(_measured(columns, readings, meanings.orientation, schema)),
        SheetColumn(flag.index, "\0flag", flag.text, "", "name") if flag and readings else None,
    )


def _measured(
    columns: Iterable[str],
    readings: Sequence[Field],
    orientation: Convention | None,
    schema: Schema,
) -> Iterator[str]:
    """Yield the columns without which a row is left out: those of readings, and all of a stream;
    none where each row counts, as an empty cell is refused there.
    """
    if schema.is_whole:
        return
    measured = {name for part in readings for name in part.columns}
    measured |= {*(orientation.columns if orientation else ())}
    yield from (name for name in columns if schema.is_stream or name in measured)


def _labels(sheet: Sheet, schema: Schema, quantities: dict[str, str]) -> list[Label]:
    """Return the labels that are not ignored, with their meanings; a stream may add a column of
    nanoseconds to the quantities.
    """
    options = schema.options
    named = renamed(sheet.labels, options.columns, source=sheet.path.name)
    labels = with_joints(unignored(named, options.ignore), schema, quantities, sheet=sheet)
    if schema.is_stream:
        labels = _timed_stream(labels, sheet, quantities)
    else:
        labels = _timed(labels, sheet, quantities)
        if any(part.is_unit for part in schema.fields):
            labels = with_matrix(labels, sheet, quantities, source=sheet.path.name)
            if not options.orientation:
                labels = with_quaternion(labels, sheet, quantities, source=sheet.path.name)
    if options.orientation == NO_ORIENTATION:
        labels = _unturned(labels, taken=schema.joint_names)
    return _with_vectors(labels, sheet, quantities, schema)


def _unturned(labels: Sequence[Label], *, taken: Collection[str]) -> list[Label]:
    """Return labels without those of an orientation in any convention; ``taken`` are joints."""
    names = {without_unit(label.meant) for label in labels} - {*taken}
    turned = columns_of_orientations(names)
    return [label for label in labels if without_unit(label.meant) not in turned]


@dataclass(frozen=True)
class _Meanings:
    """What columns may mean.

    Attributes:
        quantities: of the known columns.
        units: of columns without one in the label, where it is not SI.
        orientation: how they give an orientation, if not by a quaternion.
    """

    quantities: Mapping[str, str]
    units: Mapping[str, str]
    orientation: Convention | None


def _meanings(
    labels: list[Label], schema: Schema, quantities: Mapping[str, str], *, source: str
) -> _Meanings:
    """Return what columns mean by the convention of the table's orientation, if it has one."""
    orientation = None
    if any(part.is_unit for part in schema.fields):
        orientation = _orientation(labels, schema, quantities, source=source)
    if orientation is None:
        return _Meanings(quantities, {}, None)
    # A declared convention takes the place of the usual columns.
    hidden = set[str]()
    if schema.options.orientation:
        hidden = {*rotations(schema.fields).columns} - {*orientation.columns}
    shown = {name: quantity for name, quantity in quantities.items() if name not in hidden}
    return _Meanings(
        shown | dict.fromkeys(orientation.columns, orientation.quantity),
        dict.fromkeys(orientation.columns, orientation.unit),
        orientation,
    )


def _is_complete(
    others: Sequence[Label],
    known: set[str],
    readings: Sequence[Field],
    orientation: Convention | None,
    schema: Schema,
) -> bool:
    """Return whether a table with the ``known`` columns lacks none, so that ``others`` may mean
    anything.
    """
    given = known | {*(rotations(schema.fields).columns if orientation else ())}
    found = [part for part in readings if given & {*part.columns}]
    is_whole = bool(found) and all(given >= {*part.columns} for part in found)
    if schema.may_lack_joints and known & {*schema.joint_names} and not found:
        # A robot program is complete without a measured pose, unless other columns may be one.
        is_whole |= not looks_like_place([without_unit(label.name) for label in others])
    is_turned = orientation is None and looks_like_orientation([label.name for label in others])
    return is_whole and not is_turned


# Columns that state whether a row's reading is valid.
FLAGS = (
    "valid",
    "is_valid",
    "isvalid",
    "ok",
    "visible",
    "tracked",
    "status",
    "state",
    "quality",
    "flag",
    "flags",
)


# Names of a time in a stream: the stamp of a reading takes precedence over the recorder's.
_STAMPS = (
    ("header", "stamp"),
    ("stamp",),
    ("timestamp",),
    ("time", "stamp"),
    ("time",),
    ("t",),
    ("elapsed",),
    ("clock",),
)
# Names of the columns of a stamp that is split into seconds and nanoseconds.
_SECONDS = (("sec",), ("secs",), ("seconds",))
_NANOSECONDS = (("nanosec",), ("nanosecs",), ("nsec",), ("nsecs",), ("nanoseconds",))
NANOSECONDS = "\0nanoseconds"
"""Column of nanoseconds to be added to the time."""


def _timed(labels: list[Label], sheet: Sheet, quantities: Mapping[str, str]) -> list[Label]:
    """Return the labels with a numeric column timestamp as the time, unless another column is the
    time.
    """
    stamps = [
        label
        for label in labels
        if without_unit(label.name).casefold() in ("timestamp", "time_stamp", "time stamp")
    ]
    named = any((spelled(label, quantities) or ("",))[0] == "time" for label in labels)
    if len(stamps) != 1 or named or "time" not in quantities or sheet.has_words(stamps[0].index):
        return labels
    unit = unit_in(stamps[0].meant) or "s"
    warn(
        f'{sheet.path.name}: "{stamps[0].text[:30]}" is read as time [{unit}]; if that is '
        "wrong, --ignore it"
    )
    return [
        replace(label, meant=f"time [{unit}]") if label in stamps else label for label in labels
    ]


def _timed_stream(labels: list[Label], sheet: Sheet, quantities: dict[str, str]) -> list[Label]:
    """Return the labels of a stream with its time, whose unit follows from values since 1970;
    refuse several candidates.
    """
    source = sheet.path.name
    exact = [label for label in labels if (spelled(label, quantities) or ("",))[0] == "time"]
    whole, rest = (
        [label for label in labels if words_of(label.meant)[-1:] in ends]
        for ends in (_SECONDS, _NANOSECONDS)
    )
    if not exact and len(whole) == len(rest) == 1:
        quantities[NANOSECONDS] = "time"
        warn(
            f'{source}: the time is "{whole[0].text}" and "{rest[0].text}"; if that is '
            "wrong, --ignore both"
        )
        meant = {whole[0]: "time [s]", rest[0]: f"{NANOSECONDS} [ns]"}
        return [replace(label, meant=meant.get(label, label.meant)) for label in labels]
    units = {
        label: next((pair for pair in splits(label.meant, "time") if pair[1]), (label.name, ""))
        for label in labels
    }
    found = exact or _stamps({label: name for label, (name, _) in units.items()}) or whole
    if not found:
        return labels
    check_one([[label] for label in found], "time", source=source)
    (stamp,) = found
    stated = units[stamp][1]
    unit = stated or (
        "s" if stamp in whole else _unit_since_1970(sheet.first_cells(stamp.index, 1))
    )
    if stamp in exact and (stated or not unit):
        return labels
    return _with_time(labels, stamp, unit, source=source)


def _stamps(names: Mapping[Label, str]) -> list[Label]:
    """Return the labels with the most telling name of a stamp, by their names without units."""
    ranks = dict[Label, int]()
    for label, name in names.items():
        words = words_of(name)
        if places := [k for k, end in enumerate(_STAMPS) if words[-len(end) :] == end]:
            ranks[label] = places[0]
    return [label for label in ranks if ranks[label] == min(ranks.values())]


def _with_time(labels: list[Label], stamp: Label, unit: str, *, source: str) -> list[Label]:
    """Return the labels with one of them read as the time; warn of it."""
    meaning = f"time [{unit}]" if unit else "time"
    warn(
        f'{source}: "{stamp.text[:40]}" is read as time [{unit or "s"}]; if that is '
        "wrong, --ignore it"
    )
    return [replace(label, meant=meaning) if label is stamp else label for label in labels]


def _unit_since_1970(cells: Sequence[str]) -> str:
    """Return the unit below a second in which a number is a time in this century; empty if there is
    none.
    """
    first, last = LAYOUT.since_1970
    pairs = ((unit, size) for size in plain_numbers(cells[:1]) for unit in ("ms", "us", "ns"))
    return next((unit for unit, size in pairs if first < size * SIZES[unit] < last), "")


def _with_vectors(
    labels: list[Label], sheet: Sheet, quantities: Mapping[str, str], schema: Schema
) -> list[Label]:
    """Return the labels with vectors by other names, such as ``TCP_X``, identified where none has
    its own name.
    """
    named = {(spelled(label, quantities) or ("",))[0] for label in labels}
    free = [
        label
        for label in labels
        if not spelled(label, quantities) and not sheet.has_words(label.index)
    ]
    wanted = {name: quantity for name, quantity in quantities.items() if name not in named}
    taken = named | {label.name for label in labels}
    if any(part.is_unit for part in schema.fields) and not taken & _ORIENTED:
        wanted |= dict.fromkeys(CONVENTIONS["ur"].columns, "angle")
    guessed = vector_columns(free, wanted, is_stream=schema.is_stream, source=sheet.path.name)
    if not guessed:
        return labels
    pairs = ", ".join(f"{label}={axis}" for label, axis in guessed.items())
    what = (
        "interpreted by their names:"
        if schema.is_stream
        else f"the {_read_so(guessed.values())} is taken from the columns"
    )
    warn(f"{sheet.path.name}: {what} {pairs}; if that is wrong, map them with --columns")
    return [replace(label, meant=guessed.get(label.meant, label.meant)) for label in labels]


def _read_so(meanings: Iterable[str]) -> str:
    """Return which readings columns have, in words."""
    names = {name_of(meaning) for meaning in meanings}
    kinds = {"position": {"x"}, "orientation": {"qx", "rx"}}
    return " and ".join(kind for kind, firsts in kinds.items() if names & firsts)


def with_joints(
    labels: list[Label], schema: Schema, quantities: Mapping[str, str], *, sheet: Sheet
) -> list[Label]:
    """Return the labels with numbered joints identified, if no joint has a column under its name.

    Raises:
        MeasurementError: for a stream in which several sets of columns may be the joints.
    """
    names = set(schema.joint_names)
    source = sheet.path.name
    if not names or any(
        label.name in names or (spelled(label, quantities) or ("", ""))[0] in names
        for label in labels
    ):
        return labels
    free = [label for label in labels if label.name not in quantities]
    guessed = (
        _joints_of_stream(free, schema, sheet)
        if schema.is_stream
        else numbered_joints(free, schema.own_joints)
    )
    if not guessed:
        return labels
    pairs = ", ".join(f"{label}={joint}" for label, joint in guessed.items())
    warn(
        f"{source}: joints are taken from the columns {pairs}; if that is wrong, map them "
        "with --columns"
    )
    return [replace(label, meant=guessed.get(label.meant, label.meant)) for label in labels]


def _joints_of_stream(free: Sequence[Label], schema: Schema, sheet: Sheet) -> dict[str, str]:
    """Return the meanings of a stream's joint columns, by names among other words or by numbers."""
    numeric = [label for label in free if not sheet.has_words(label.index)]
    needed = schema.needed_joints
    whole = [
        family
        for family in joint_families(numeric, schema.joint_names)
        if family.keys() >= {*needed}
    ]
    whole = whole or _numbered_joints(free, numeric, schema, sheet)
    columns = [[label for label, _ in family.values()] for family in whole]
    check_one(
        columns,
        "joints",
        source=sheet.path.name,
        example=next(iter(whole[-1]), "") if whole else "",
    )
    if not whole:
        return {}
    return {
        label.meant: f"{joint} [{unit}]" if unit else joint
        for joint, (label, unit) in whole[0].items()
    }


def _numbered_joints(
    free: Sequence[Label], numeric: Sequence[Label], schema: Schema, sheet: Sheet
) -> list[dict[str, tuple[Label, str]]]:
    """Return the families of columns that number the arm's joints, by joint, with their units;
    refuse those that only number more.
    """
    n = len(schema.own_joints)
    whole = list[dict[str, tuple[Label, str]]]()
    more = list[dict[int, tuple[Label, str]]]()
    for _, numbered in numbered_families(numeric, is_stream=True):
        if not numbers_all(numbered, n):
            more += [numbered] if len(numbered) > n else []
            continue
        order = _recorded_order(free, numeric, numbered, schema, sheet)
        whole.append(dict(zip(order, (numbered[k] for k in sorted(numbered)), strict=True)))
    if more and not whole:
        first, last = (more[0][end(more[0])][0].text for end in (min, max))
        raise MeasurementError(
            f'{sheet.path.name}: "{first}" to "{last}" number {len(more[0])} joints; '
            f"expected {n} for this arm: leave out others, such as a gripper (--ignore {last})"
        )
    return whole


def _recorded_order(
    free: Sequence[Label],
    numeric: Sequence[Label],
    numbered: Collection[int],
    schema: Schema,
    sheet: Sheet,
) -> list[str]:
    """Return the joints in the order of their numbers: that of the arm, or that of the names which
    a recording of ROS has in addition to positions.
    """
    names = [
        label
        for label in free
        if words_of(label.meant)[-2:-1] == ("name",) and label not in numeric
    ]
    texts = {
        int(words_of(label.meant)[-1]): (sheet.first_cells(label.index, 1) or [""])[0].strip()
        for label in names
    }
    if {texts.get(k) for k in numbered} == {*schema.own_joints}:
        return [texts[k] for k in sorted(numbered)]
    return [*schema.own_joints]


def _orientation(
    labels: list[Label], schema: Schema, quantities: Mapping[str, str], *, source: str
) -> Convention | None:
    """Return the convention of the table's orientation, None if it is qx qy qz qw or
    there is none.
    """
    names = [without_unit(label.meant) for label in labels]
    if schema.options.orientation == NO_ORIENTATION:
        return None
    declared = schema.options.orientation
    usual = rotations(schema.fields).columns
    found = find_orientation(
        names, declared, taken=[n for n in quantities if n not in usual], source=source
    )
    if found is None or declared is not None:
        return found
    if set(usual) & set(names):
        raise MeasurementError(
            f"{source}: orientations in {' '.join(found.columns)} and in "
            f"{' '.join(usual)}; expected one: ignore the others"
        )
    if found.kind == MATRIX.kind:
        return found
    warn(
        f"{source}: {' '.join(found.columns)} are read as {found.words}; if that is wrong, use "
        f"--orientation {'|'.join(CONVENTIONS)}"
    )
    return found


def matched(
    labels: Sequence[Label], quantities: Mapping[str, str], units: Mapping[str, str], *, source: str
) -> tuple[dict[str, SheetColumn], list[Label]]:
    """Return the known columns and the unknown labels; exact names take precedence over other
    spellings.

    ``units`` are those of columns without one in the label, where it is not SI.
    """
    exact = {label.name for label in labels} & quantities.keys()
    columns = dict[str, SheetColumn]()
    unknown = list[Label]()
    for label in labels:
        found = spelled(label, quantities)
        if found is None or (found[0] in exact and found[0] != label.name):
            unknown.append(label)
            continue
        name, unit = found
        if "[" in unit:
            unit = unit_of(
                unit, quantities[name], where=f'{source}, column {label.index + 1} ("{label.text}")'
            )
        if name in columns:
            raise MeasurementError(
                f'{source}: two columns "{name}"; expected one, delete or rename the other'
            )
        columns[name] = SheetColumn(
            label.index, name, label.text, unit or units.get(name, ""), quantities[name]
        )
    return columns, unknown


def check_joints(missing: Sequence[str], unknown: Sequence[Label], sheet: Sheet) -> None:
    """Refuse a table that lacks joints, naming the columns that may be meant."""
    if not missing:
        return
    texts = []
    labels = [label.text for label in unknown]
    for name in missing:
        close = difflib.get_close_matches(name, labels, n=1, cutoff=0.6)
        texts.append(f'"{name}"' + (f' (is it "{close[0]}"?)' if close else ""))
    raise MeasurementError(
        f"{sheet.path.name}: no column for joint {', '.join(texts)}; expected a column named as in "
        f"the URDF, or --columns 'NAME={missing[0]},...'{_columns_for(missing, unknown, sheet)}, "
        f"or a log of the joints (--joints LOG); {columns_listed(sheet.labels)}"
    )


def _columns_for(missing: Sequence[str], unknown: Sequence[Label], sheet: Sheet) -> str:
    """Return what to give for missing joints, if there are as many columns of numbers that they may
    be, in the order of the arm; else nothing.
    """
    numbers = {label: sheet.first_numbers(label.index) for label in unknown}
    free = [label for label, values in numbers.items() if not is_counter(values)]
    units = {label: unit_of_joints(numbers[label][:, None]) for label in free}
    if len(free) != len(missing) or None in units.values():
        return ""
    unit = max(map(str, units.values()))
    pairs = zip(free, missing, strict=True)
    named = ",".join(f"{label.name}={joint} {unit}".strip() for label, joint in pairs)
    return f" (if they are in the order of the arm: --columns '{named}')"


def _warn_of_unread(sheet: Sheet, unknown: Sequence[Label]) -> None:
    """Warn of the columns of a stream that are not read, and of a quaternion in an
    unknown order.
    """
    texts = [label.text for label in unknown if not sheet.is_blank(label.index)]
    by_name = {label.name.casefold(): label.text for label in unknown}
    if {"q0", "q1", "q2", "q3"} <= by_name.keys() and "q4" not in by_name:
        warn(
            f"{sheet.path.name}: q0 q1 q2 q3 may be a quaternion in either order, and are "
            "left out; "
            "give --columns q0=qw,q1=qx,q2=qy,q3=qz or q0=qx,q1=qy,q2=qz,q3=qw, or --ignore them"
        )
    if texts:
        named = ", ".join(f'"{text[:60]}"' for text in texts[:_UNREAD])
        more = f" and {len(texts) - _UNREAD} more" if len(texts) > _UNREAD else ""
        warn(f"{sheet.path.name}: columns that are not read: {named}{more}")


def _check_unknown(
    sheet: Sheet, unknown: Sequence[Label], free: Mapping[str, str], *, is_complete: bool
) -> None:
    """Leave out unknown columns with a `PincalWarning`; refuse those that may be misspelled names
    of ``free`` ones.

    If the table is complete, only obvious misspellings are refused.
    """
    wrong = list[str]()
    words = list[str]()
    others = list[str]()
    for label in unknown[:_EXAMINED]:
        if sheet.is_blank(label.index):
            continue
        is_word = sheet.has_words(label.index)
        names = [name for name, quantity in free.items() if not is_word or quantity == "name"]
        kind = words if is_word else others if is_complete else wrong
        (wrong if _is_slip(label.name, names) else kind).append(label.text)
    if wrong or len(unknown) > _EXAMINED:
        raise _unknown(wrong, unknown[-1].text, free, sheet)
    for texts, what in ((words, "columns of text"), (others, "columns unknown to pincal")):
        if texts:
            more = f" and {len(texts) - _LISTED} more" if len(texts) > _LISTED else ""
            warn(
                f"{sheet.path.name}: {what} are ignored: "
                f"{', '.join(map(_short, texts[:_LISTED]))}{more}"
                f"{_WHOEVER if _OPERATOR in (text.casefold() for text in texts) else ''}"
            )


# The column that tells who measured a row, and what is done with it.
_OPERATOR = "operator"
_WHOEVER = "; rows count alike, whoever measured them: pincal measure compares operators (GR&R)"


def _is_slip(name: str, names: Sequence[str]) -> bool:
    """Return whether a name is nearly one of ``names``, and not one of them with a word more."""
    folded = name.casefold()
    close = difflib.get_close_matches(folded, names, n=1, cutoff=0.75)
    return bool(close) and re.match(rf"{close[0]}..|.*[ _.-]{close[0]}$", folded) is None


def _unknown(
    wrong: Sequence[str], last: str, free: Mapping[str, str], sheet: Sheet
) -> MeasurementError:
    """Return the error for columns that may be misspelled, or for too many of which the ``last``
    one is named.
    """
    few = wrong[:_LISTED] or [last]
    known = ", ".join(nearest_first(few, free)[:_LISTED])
    hint = (
        f"; an orientation? --orientation {'|'.join(CONVENTIONS)}"
        if looks_like_orientation(wrong)
        else ""
    )
    return MeasurementError(
        f"{sheet.path.name}: unknown column {', '.join(map(_short, few))}; known and not in the "
        f"table, nearest first: {known or 'none'}{hint}; leave it out (--ignore '{few[0][:30]}'), "
        f"or state what it holds (--columns '{few[0][:30]}=NAME'; a unit is written as x [mm]); "
        f"{columns_listed(sheet.labels)}"
    )


def _short(text: str) -> str:
    return f'"{text[:30]}"'
