"""The tables of a precheck: what poses can identify, and what a search would find in them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from pincal.calibration.result_tables import ParameterRow, parameter_table
from pincal.discover.precheck import DataReport, Detectable, JointRange
from pincal.result_table import Cell, Column, Kind, Table
from pincal.thresholds import Count
from pincal.units import Quantity, fixed, format_digits, show_percent, show_plainly, small_unit

# Number of joints side by side in a table of 100 characters.
_JOINTS_ABREAST: Count = 7


def covered_share(joint: JointRange) -> float | None:
    """Return the fraction of its range that a joint covers; None without limits."""
    if joint.lower_limit is None or joint.upper_limit is None:
        return None
    return (joint.high - joint.low) / (joint.upper_limit - joint.lower_limit)


def coverage_table(report: DataReport) -> Table:
    """Return the covered range of each joint [rad or m]."""
    columns = (
        Column("joint", kind=Kind.NAME),
        Column("from", kind=Kind.NUMBER, show=fixed(3)),
        Column("to", kind=Kind.NUMBER, show=fixed(3)),
        Column("limits", kind=Kind.NUMBER),
        Column("covered", kind=Kind.NUMBER, show=show_percent),
    )
    rows: list[tuple[Cell, ...]] = []
    for joint in report.joints:
        share = covered_share(joint)
        limits = "none" if share is None else f"{joint.lower_limit:.3f} .. {joint.upper_limit:.3f}"
        rows.append((joint.joint, joint.low, joint.high, limits, share))
    return Table("Coverage of the joint ranges", columns, tuple(rows))


def expectation_table(report: DataReport) -> Table:
    """Return the expected uncertainty of each parameter."""
    rows = [
        ParameterRow(p.name, p.unit, 0.0, 0.0, p.sigma, p.status, p.reason, p.effect)
        for p in report.parameters
    ]
    table = parameter_table(rows, "What these poses can identify").without("nominal", "value")
    columns = tuple(
        replace(c, name="expected sigma") if c.name == "sigma" else c for c in table.columns
    )
    return replace(table, columns=columns)


def detectability_tables(report: DataReport) -> Iterator[Table]:
    """Yield the smallest effect of each kind that a discovery would find at each joint, a few
    joints per table.
    """
    joints = [joint.joint for joint in report.joints]
    entries = [entry for entry in report.detectable.effects if entry.effect.locus.joint is not None]
    for i in range(0, len(joints), _JOINTS_ABREAST):
        yield _detectability_table(entries, joints[i : i + _JOINTS_ABREAST])


def _detectability_table(entries: list[Detectable], joints: list[str]) -> Table:
    found: dict[tuple[str, str], dict[str, list[Detectable]]] = {}
    units = {entry.effect.name: entry.unit for entry in entries if entry.unit}
    for entry in entries:
        at = entry.effect.locus
        name = entry.effect.name + (f" order {at.order}" if at.order else "")
        unit = entry.unit or units.get(entry.effect.name, "")
        if unit and at.joint in joints:
            found.setdefault((name, unit), {}).setdefault(at.joint, []).append(entry)
    columns = (
        Column("effect"),
        Column("unit", kind=Kind.LABEL, show=lambda unit: small_unit(unit).name),
        *(Column(joint, kind=Kind.NUMBER, show=_show_size) for joint in joints),
    )
    rows = tuple(
        (name, unit, *(smallest_size(cells[joint]) if joint in cells else "" for joint in joints))
        for (name, unit), cells in found.items()
    )
    return Table("Smallest effects that would be found", columns, rows)


def smallest_size(entries: Sequence[Detectable]) -> Quantity | str | None:
    """Return the detectable size; for several sources the range in the small unit, for several
    frames the larger.
    """
    unit = entries[0].unit
    source = entries[0].effect.heading[2]
    sizes = [entry.size for entry in entries if entry.size is not None]
    if not sizes:
        return None
    if source is None or len(sizes) == 1:
        return Quantity(max(sizes), unit)
    factor = small_unit(unit).factor
    return f"{format_digits(min(sizes) * factor)}-{format_digits(max(sizes) * factor)}"


def _show_size(size: Quantity | str | None) -> str:
    return (
        format_digits(size.value * small_unit(size.unit).factor)
        if isinstance(size, Quantity)
        else show_plainly(size)
    )
