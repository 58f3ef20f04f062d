"""Where a table begins: the row of names among titles, units and second headers."""

from __future__ import annotations

import re
import statistics
import unicodedata
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from pincal.errors import MeasurementError
from pincal.measure.reading_numbers import LAYOUT
from pincal.units import SIZES, plain_numbers

NUMBERED = re.compile(
    r"(j|joint(?:[ _]?angle|[ _]?pos(?:ition)?)?|a|axis(?:[ "
    r"_]?angle)?|achse|gelenk|angle|q|actual_q|actualq|theta|rax)"
    r"[ _.-]?(\d{1,2})",
    re.IGNORECASE,
)
"""How programs name numbered joints, without the blank or sign before the number."""

# Spellings of units.
_WRITTEN = {
    "°": ("degree", "degrees", "º"),
    "mm": ("millimeter", "millimeters", "millimetre", "millimetres"),
}
_WRITTEN |= {
    "in": ("inch", "inches"),
    "rev": ("revs", "revolution", "revolutions", "turn", "turns"),
    "m": ("meter", "meters", "metre", "metres"),
    "rad": ("radian", "radians"),
    "g": (),
    "dps": (),
    "m/s^2": ("m/s2", "m/s/s", "m/s**2", "m/sec^2"),
    "deg/s": ("deg/sec", "degree/s", "degrees/s", "degree/sec", "degrees/sec"),
    "rad/s": ("rad/sec", "radians/s"),
    "s": ("sec", "secs", "second", "seconds"),
}
_WRITTEN |= {
    short: (
        f"{short[0]}sec",
        f"{short[0]}secs",
        f"{long}sec",
        f"{long}secs",
        f"{long}second",
        f"{long}seconds",
    )
    for short, long in (("ms", "milli"), ("us", "micro"), ("ns", "nano"))
}
_SPELLED = {word: unit for unit, words in _WRITTEN.items() for word in (unit, *words)} | {
    "deg": "deg"
}
# Spelled with a capital it is a degree in German; in small letters it may be a gon.
_AS_WRITTEN = {"Grad": "°"}
# Cells of a row of units below columns without a unit, or with a unit that no known column has.
_NO_UNITS = (
    "",
    "-",
    "--",
    "1",
    "n",
    "nm",
    "%",
    "a",
    "v",
    "m/s",
    "deg/s",
    "rad/s",
    "mm/s",
    "string",
    "text",
    "hh:mm:ss",
    "date",
)
# Names by which the row of names is recognised, in addition to those of joints.
_KNOWN = (
    "x",
    "y",
    "z",
    "qx",
    "qy",
    "qz",
    "qw",
    "distance",
    "socket",
    "point",
    "u",
    "v",
    "cx",
    "cy",
    "cz",
    "plane",
    "gauge",
)


def normal_unit(text: str) -> str:
    """Return the listed symbol of a unit, whichever way it is spelled.

    Example:
        >>> normal_unit("Degrees"), normal_unit("MM"), normal_unit("kg")
        ('°', 'mm', 'kg')
    """
    plain = unicodedata.normalize("NFC", text.strip()).replace("μ", "µ")
    if plain in SIZES:
        return plain
    return _AS_WRITTEN.get(plain, _SPELLED.get(plain.casefold(), plain))


@dataclass(frozen=True)
class TableHead:
    """Where the names of the columns stand.

    Attributes:
        header: index of the row of names.
        body: index of the first row below the header.
        labels: names, with the units of a row below them.
        units: index of the row of units, if there is one.
    """

    header: int
    body: int
    labels: tuple[str, ...]
    units: int | None = None

    def described(self, lines: Sequence[int]) -> str:
        """Return how the rows are interpreted, in words; ``lines`` are their numbers in
        the file.
        """
        others = self.body - len({self.header, self.units} - {None})
        texts = [f"the names of the columns are taken from line {lines[self.header]}"]
        texts += [f"units from line {lines[self.units]}"] if self.units is not None else []
        texts += [f"{others} other lines above the numbers are left out"] if others else []
        return ", ".join(texts)


def is_number(cell: str) -> bool:
    """Return whether a cell is a number, with a decimal point or comma."""
    return bool(plain_numbers([cell.strip().replace(",", ".", 1)]))


def find_heading(rows: Sequence[Sequence[str]], joints: Collection[str] = ()) -> TableHead | None:
    """Return where the column names are among the first rows of a table; None where no row looks
    like names.

    Args:
        rows: cells.
        joints: names of joints, by which the row of names is recognised.

    Example:
        >>> names, units = ["A1", "A2", "x", "y"], ["deg", "deg", "mm", "mm"]
        >>> find_heading([["KR 16, cell 3"], names, units, ["1", "2", "3", "4"]]).labels
        ('A1 [deg]', 'A2 [deg]', 'x [mm]', 'y [mm]')
    """
    widths = [len(row) for row in rows]
    usual = statistics.mode(widths) if rows else 0
    if usual < 2:
        return None
    enough = LAYOUT.filled * usual
    wide = [len(row) >= usual and sum(bool(c.strip()) for c in row) >= enough for row in rows]
    numeric = [any(map(is_number, row)) for row in rows]
    names = [is_wide and not has_any for is_wide, has_any in zip(wide, numeric, strict=True)]
    with_units = [is_unit_row(row, usual) for row in rows]
    below = (i for i in range(1, len(rows)) if wide[i] and numeric[i] and any(names[:i]))
    body = next(below, None)
    if body is None:
        return None
    top = body
    while top and (names[top - 1] or with_units[top - 1]):
        top -= 1
    candidates = [i for i in range(top, body) if names[i] and not with_units[i]]
    # Rows of numbers above the names would be lost.
    if not candidates or any(sum(map(is_number, row)) >= enough for row in rows[:top]):
        return None
    header = max(candidates, key=lambda i: (_known(rows[i], joints), -i))
    units = next((i for i in range(header + 1, body) if with_units[i]), None)
    return _head_of(rows, header, body, units)


def _head_of(rows: Sequence[Sequence[str]], header: int, body: int, units: int | None) -> TableHead:
    """Return the head whose names stand in row ``header``, and their units in a row below or, if
    there is none, in groups above.
    """
    above = rows[header - 1] if header else ()
    labels = _distinct([cell.strip() for cell in rows[header]], above)
    if units is not None:
        return TableHead(header, body, tuple(_with_units(labels, rows[units])), units)
    for row in rows[header + 1 : body]:
        _refuse_half_units(row)
    groups = _group_units(above)
    if groups:
        return TableHead(header, body, tuple(_with_units(labels, groups)), header - 1)
    return TableHead(header, body, tuple(labels), None)


def _with_units(labels: list[str], row: Sequence[str]) -> list[str]:
    """Return the labels with the units of a row below them, unless a label states its own."""
    below = [cell.strip().strip("[]()") for cell in row]
    below += [""] * (len(labels) - len(below))
    return [
        f"{name} [{unit}]" if unit in SIZES and name and not re.search(r"[\[(]", name) else name
        for name, unit in zip(labels, map(normal_unit, below), strict=False)
    ]


def _group_units(row: Sequence[str]) -> list[str]:
    """Return the unit of each cell of a row of groups above the names, each of which may be over
    several columns: ``Joints [deg]``, two blanks, ``Position [mm]``; none where it states no units.
    """
    cells = [cell.strip() for cell in row]
    if sum(map(bool, cells)) < 2:
        return []
    found = list[str]()
    for cell in cells:
        stated = re.search(r"[\[(]([^\])]*)[\])]$", cell)
        unit = normal_unit(stated[1]) if stated else ""
        found.append((unit if unit in SIZES else "") if cell else found[-1] if found else "")
    return found if any(found) else []


def _refuse_half_units(row: Sequence[str]) -> None:
    """Refuse a row below the names of which most cells are units, others unknown ones.

    Raises:
        MeasurementError: for such a row.
    """
    cells = [cell.strip().strip("[]()") for cell in row]
    filled = [cell for cell in cells if cell.casefold() not in _NO_UNITS]
    unknown = [cell for cell in filled if normal_unit(cell) not in SIZES]
    if unknown and len(filled) - len(unknown) >= 2:
        raise MeasurementError(
            f"the row of units has {unknown[0]!r}, which is not a unit; expected one such as deg, "
            "rad, mm or m below each name, or in it: x [mm]"
        )


def is_unit_row(row: Sequence[str], usual: int) -> bool:
    """Return whether a row contains only units, at least two, given the usual number of cells."""
    cells = [normal_unit(cell.strip().strip("[]()")) for cell in row]
    return (
        usual - 1 <= len(row)
        and sum(c in SIZES for c in cells) > 1
        and all(c in SIZES or c.casefold() in _NO_UNITS for c in cells)
    )


def names_joints(cells: Sequence[str], joints: Collection[str]) -> bool:
    """Return whether a row names joints: one by its name, or three by numbers."""
    bare = _bare(cells)
    return (
        bool({*bare} & {joint.casefold() for joint in joints})
        or sum(bool(NUMBERED.match(cell)) for cell in bare) > 2
    )


def _bare(row: Sequence[str]) -> list[str]:
    return [re.split(r"\s*[\[(]", cell)[0].strip().casefold() for cell in row]


def _known(row: Sequence[str], joints: Collection[str]) -> int:
    known = {*_KNOWN, *(joint.casefold() for joint in joints)}
    return sum(cell in known or bool(NUMBERED.fullmatch(cell)) for cell in _bare(row))


def _distinct(labels: list[str], above: Sequence[str]) -> list[str]:
    """Return the labels, repeated ones prefixed with the group name in the row above."""
    twice = {label for label, count in Counter(labels).items() if label and count > 1}
    group = ""
    found = list[str]()
    for label, over in zip(labels, [*above, *[""] * len(labels)], strict=False):
        group = over.strip() or group
        found.append(f"{group} {label}" if label in twice and group else label)
    return found
