"""The tables of a precheck: what poses can identify."""

from __future__ import annotations

from dataclasses import replace

from pincal.calibration.precheck import DataReport, JointRange
from pincal.calibration.result_tables import ParameterRow, parameter_table
from pincal.result_table import Cell, Column, Kind, Table
from pincal.units import fixed, joint_unit, show_percent


def covered_share(joint: JointRange) -> float | None:
    """Return the fraction of its range that a joint covers; None without limits."""
    if joint.lower_limit is None or joint.upper_limit is None:
        return None
    return (joint.high - joint.low) / (joint.upper_limit - joint.lower_limit)


def coverage_table(report: DataReport) -> Table:
    """Return the covered range of each joint, as a pendant shows it."""
    columns = (
        Column("joint", kind=Kind.NAME),
        Column("from", kind=Kind.NUMBER, show=fixed(1)),
        Column("to", kind=Kind.NUMBER, show=fixed(1)),
        Column("limits", kind=Kind.NUMBER),
        Column("unit", kind=Kind.LABEL),
        Column("covered", kind=Kind.NUMBER, show=show_percent),
    )
    rows: list[tuple[Cell, ...]] = []
    for joint in report.joints:
        factor, unit = joint_unit(joint.unit)
        limits = "none"
        if joint.lower_limit is not None and joint.upper_limit is not None:
            limits = f"{joint.lower_limit * factor:.1f} to {joint.upper_limit * factor:.1f}"
        covered = (joint.low * factor, joint.high * factor)
        rows.append((joint.joint, *covered, limits, unit, covered_share(joint)))
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
