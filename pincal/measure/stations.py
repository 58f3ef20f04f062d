"""Tables divided into stations: the set-ups of an instrument and its targets, each with frames of its own."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from pincal.errors import BadInputError
from pincal.measure.measurements import Measurements, concatenate


def stations_of(tables: Iterable[tuple[str, Measurements]]) -> dict[str, Measurements]:
    """Return the rows of each station, in the order in which stations appear.

    A table is a station unless it has a column ``station``; rows of one name may then come from several tables.

    Args:
        tables: tables with the names that they have as stations if they have no such column.

    Raises:
        BadInputError: if two stations have the same name, or rows of one station were read by different sensors.

    Example:
        >>> from pincal.measure.measurements import measurements_from_arrays
        >>> days = measurements_from_arrays(["a"], [[0.0], [1.0], [2.0]], distance=[1.0] * 3, station=["mo", "tu", "mo"])
        >>> {name: len(rows) for name, rows in stations_of([("days", days), ("later", days.select([0]))]).items()}
        {'mo': 3, 'tu': 1}
    """
    whole: dict[str, Measurements] = {}
    parts: dict[str, list[Measurements]] = {}
    for name, table in tables:
        if table.station is None:
            if name in whole:
                raise _same_name(name, whole[name], table)
            whole[name] = table
            parts.setdefault(name, [])
            continue
        for station in dict.fromkeys(table.station.tolist()):
            parts.setdefault(station, []).append(_rows_of(table, station))
    for name in whole.keys() & {name for name, found in parts.items() if found}:
        raise _same_name(name, whole[name], parts[name][0])
    return {name: whole[name] if name in whole else _joined(name, found) for name, found in parts.items()}


def _rows_of(table: Measurements, station: str) -> Measurements:
    assert table.station is not None
    mine = table.station == station
    if not station.strip():
        raise BadInputError(f'{table.source}, line {table.rows[mine][0]}, "station": no name; expected one in each row')
    return replace(table if mine.all() else table.select(mine), station=None)


def _joined(name: str, parts: list[Measurements]) -> Measurements:
    if len(parts) == 1:
        return parts[0]
    kinds = {part.kind: part.source for part in parts}
    if len(kinds) > 1:
        (kind, source), (other, second) = list(kinds.items())[:2]
        raise BadInputError(
            f"station {name!r} is read as {kind} in {source} and as {other} in {second}; expected one sensor at a station: "
            "give each its own name in the column station"
        )
    return concatenate(parts)


def _same_name(name: str, one: Measurements, other: Measurements) -> BadInputError:
    kinds = f" of different kinds ({one.kind} and {other.kind})" if one.kind != other.kind else ""
    return BadInputError(
        f"two stations{kinds} are called {name!r}, from {one.source} and {other.source}; expected a name of its own for "
        "each: rename a file, or name the stations in a column station"
    )
