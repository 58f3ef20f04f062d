"""The section on static moments, of an arm whose masses were found with its compliances."""

from __future__ import annotations

from pincal.identify.moments import FoundMoments, found_moments
from pincal.report.blocks import Section, paragraph
from pincal.report.subject import Subject
from pincal.tables import Column, Kind, Table
from pincal.units import fixed


def moments(subject: Subject) -> Section | None:
    """Which moments are identified, at a typical pose; None where the masses are those of the URDF."""
    found = found_moments(subject.calibration.fit)
    if found is None:
        return None
    held = (
        f"The robot's description has no masses that could be trusted of {len(found.links)} links. They were found with "
        "the compliances, starting from the shape of the arm. What bends the arm is compliance times moment, so that all "
        f"moments share a factor with the inverse of the compliances: it is known to {100.0 * found.factor_sigma:.2g} %, "
        "and no prediction depends on it. The mass of the robot's data sheet (--mass) or rows with other payloads would "
        "tell it."
    )
    pose = ", ".join(f"{value:.2f}" for value in found.q)
    return Section("moments", "Static moments", (paragraph(held), moment_table(found, f"at the pose {pose}")), "Moments")


def moment_table(found: FoundMoments, where: str) -> Table:
    """Return the moments that are felt at a pose, and how well they are known if the common factor is held."""
    columns = (
        Column("joint", kind=Kind.NAME),
        Column("axis", kind=Kind.LABEL),
        Column("moment", "N m", Kind.NUMBER, fixed(1)),
        Column("sigma", "N m", Kind.NUMBER, fixed(1)),
        Column("", kind=Kind.LABEL),
    )
    rows = tuple(
        (of.joint, of.axis, of.moment, of.sigma, "identified" if of.is_identified else "held by the shape")
        for of in found.axes
    )
    note = f"sigma: with the moment about {found.largest.axis} of {found.largest.joint} held, and so the common factor."
    return Table(f"Static moments {where}", columns, rows, (note,))
