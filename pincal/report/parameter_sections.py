"""The sections of the page on a calibration on its parameters: moments, values, and what no reading
tells.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from pincal.calibration.result_tables import (
    ParameterRow,
    correlation_table,
    rounded_table,
    shown_parameters,
)
from pincal.errors import counted
from pincal.identify.choices import FoundMoments, found_moments
from pincal.identify.explain import Status
from pincal.parameters import FRAME_SYMBOLS, split_name
from pincal.report.blocks import (
    PageBlock,
    Section,
    bullets,
    code,
    folded,
    merged,
    paragraph,
    rich,
)
from pincal.report.illustrations import (
    correction_drawings,
    figures,
)
from pincal.report.judgement import unidentified_groups
from pincal.report.subject import Subject
from pincal.result_table import Column, Kind, Table
from pincal.thresholds import Count
from pincal.units import fixed

# Number of parameters of an instrument that stand among those of the robot.
_FEW_OWN: Count = 6
# Identified parameters that are listed before they are folded.
_LISTED_PARAMETERS: Count = 24


def moments(subject: Subject) -> Section | None:
    """The identified moments at a typical pose; None if the masses are those of the URDF."""
    found = found_moments(subject.calibration.fit.fit)
    if found is None:
        return None
    held = (
        f"The robot description has no usable masses for {counted(len(found.links), 'link')}. "
        "They were "
        "estimated with the compliances, starting from the shape of the arm. Only compliance times "
        "moment deflects the arm, so all moments share a factor with the inverse of the "
        f"compliances: it is known to {100.0 * found.factor_sigma:.2g} %, and predictions do not "
        "depend on it. The robot's mass from its data sheet (--mass) or rows with other payloads "
        "would determine it."
    )
    pose = ", ".join(f"{value:.2f}" for value in found.q)
    return Section(
        "moments",
        "Static moments",
        (paragraph(held), moment_table(found, f"at the pose {pose}")),
        "Moments",
    )


def moment_table(found: FoundMoments, where: str) -> Table:
    """Return the moments at a pose, and their standard deviations if the common factor is held
    fixed.
    """
    columns = (
        Column("joint", kind=Kind.NAME),
        Column("axis", kind=Kind.LABEL),
        Column("moment", "N m", Kind.NUMBER, fixed(1)),
        Column("sigma", "N m", Kind.NUMBER, fixed(1)),
        Column("", kind=Kind.LABEL),
    )
    rows = tuple(
        (
            of.joint,
            of.axis,
            of.moment,
            of.sigma,
            "identified" if of.is_identified else "fixed by the shape",
        )
        for of in found.axes
    )
    note = (
        f"sigma: with the moment about {found.largest.axis} of {found.largest.joint}, and so "
        "the common factor, held fixed."
    )
    return Table(f"Static moments {where}", columns, rows, (note,))


def parameters(subject: Subject) -> Section:
    """Every parameter with its uncertainty, and the strong correlations."""
    result = subject.result
    symbols = rich(
        "Symbols follow Denavit and Hartenberg: theta and d are about and along the joint axis, a "
        "and alpha along and about the link; s_x and s_y tilt the axis; x, y, z and rx, ry, rz are "
        "position and rotation of base and tool. k is a <b>compliance</b>, the rotation of a joint "
        "or bearing per unit of moment. Behind ± is half of the 95 % interval, to which values are "
        "rounded. Status: "
        "<b>identified</b>: determined by the data; <b>prior</b>: dominated by prior knowledge; "
        "<b>unidentifiable</b>: these poses cannot determine it by itself, whatever the noise; "
        "predictions at poses like these do not depend on it."
    )
    blocks: list[PageBlock] = [
        *_corrections(subject),
        folded("What the symbols mean", paragraph(symbols)),
        *_parameter_tables(result.parameters, subject.calibration.fit.fit.problem.is_shared),
    ]
    if result.correlations:
        text = (
            "Each of these pairs is known much better in combination than individually: an error "
            "of one is compensated by the other. Always use both together."
        )
        pairs = counted(len(result.correlations), "strong correlation")
        blocks.append(folded(pairs, paragraph(text), correlation_table(result.correlations)))
    else:
        blocks.append(
            paragraph("Strong correlations: none above 0.9 between identified parameters.", "mute")
        )
    return Section("parameters", "Parameters", tuple(blocks), "Parameters")


def _corrections(subject: Subject) -> Iterator[PageBlock]:
    """Yield the largest corrections as figures, folded where a search has said what was wrong."""
    drawn = figures("correction", correction_drawings(subject.result.parameters))
    is_told = subject.search is not None
    yield folded("The largest corrections", drawn) if is_told and drawn else drawn


def _parameter_tables(
    parameters: Sequence[ParameterRow], is_robots: Sequence[bool] | np.ndarray
) -> Iterator[PageBlock]:
    """Yield the tables of what was determined of the robot, of what was not, of the placement of
    instrument and target, and of what is the instrument's own.

    Args:
        parameters: all parameters.
        is_robots: shape (P,), which are of the robot, not of a set-up.
    """
    shown = {id(row) for row in shown_parameters(parameters)}
    parts: dict[str, list[int]] = {
        name: [] for name in ("identified", "others", "placement", "instrument")
    }
    for k, row in enumerate(parameters):
        if id(row) in shown:
            parts[_part_of(row, is_robots=bool(is_robots[k]))].append(k)
    if len(parts["instrument"]) <= _FEW_OWN:
        parts["identified"] += parts.pop("instrument")
    if found := parts["identified"]:
        table = rounded_table(parameters, found).without("status", "reason")
        is_long = len(found) > _LISTED_PARAMETERS
        words = f"{counted(len(found), 'parameter')} determined"
        yield folded(words, table) if is_long else table
    if parts["others"]:
        words = f"{counted(len(parts['others']), 'parameter')} not determined individually"
        yield folded(words, rounded_table(parameters, parts["others"]))
    if parts["placement"]:
        table = rounded_table(parameters, parts["placement"]).without("nominal")
        yield folded("Base and tool: where instrument and target stand", table)
    if own := parts.get("instrument"):
        words = f"{counted(len(own), 'parameter')} of the instrument: axes, biases, clocks"
        yield folded(words, rounded_table(parameters, own).without("status", "reason"))
    if hidden := len(parameters) - len(shown):
        yield paragraph(
            f"The coordinates of {hidden // 3} named points are omitted here; result.json has them."
        )


def _part_of(row: ParameterRow, *, is_robots: bool) -> str:
    if split_name(row.name)[1] in FRAME_SYMBOLS:
        return "placement"
    if row.status != Status.IDENTIFIED:
        return "others"
    return "identified" if is_robots else "instrument"


def unidentified(subject: Subject) -> Section:
    """Parameters that are not identified, by cause, with what to measure."""
    groups = [
        folded(
            f"{found.advice.title}: {len(found.names)}",
            paragraph(found.advice.text),
            paragraph(merged(map(code, found.names), ", "), "mute"),
        )
        for found in unidentified_groups(shown_parameters(subject.result.parameters))
    ]
    blocks: list[PageBlock] = [*groups] or [paragraph("All parameters are identified.")]
    if subject.notes:
        blocks.append(folded("Not included in the calibrated URDF", bullets(subject.notes)))
    title = "What is not identifiable, and what to measure"
    return Section("unidentified", title, tuple(blocks), "Not identifiable")
