"""The report of a calibration as one page that needs no network."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

from pincal.calibration.calibration import Calibration
from pincal.errors import counted
from pincal.report import parameter_sections, result_section, sections
from pincal.report.blocks import Section
from pincal.report.subject import Subject
from pincal.units import typeset

log = logging.getLogger(__name__)

SECTIONS: tuple[Callable[[Subject], Section | None], ...] = (
    result_section.summary,
    sections.accuracy,
    sections.stations,
    sections.elsewhere,
    sections.missing,
    sections.where,
    parameter_sections.parameters,
    parameter_sections.unidentified,
    parameter_sections.moments,
    sections.setup,
    sections.identity,
    sections.basis,
    sections.glossary,
)
"""The page, in order; a function that returns None leaves its section out."""


def report_page(
    subject: Subject, *, layout: tuple[Callable[[Subject], Section | None], ...] = SECTIONS
) -> str:
    """Return ``report.html``: accuracy, where the errors are, what was missing, the parameters, and
    the provenance.
    """
    log.info("drawing the report")
    calibration = subject.calibration
    lead = f"{counted(calibration.robot.n_joints, 'joint')}, {_measured(calibration)}"
    lead += ", with a search for missing effects" if subject.search else ""
    machine = calibration.fit.identity.machine
    lead += f"; {machine}" if machine else ""
    made = [section for make in layout if (section := make(subject)) is not None]
    title = f"Calibration of {calibration.robot.name}"
    version = subject.provenance.get("pincal", "")
    return render(title, lead, made, version=version, view=subject.view)


def _measured(calibration: Calibration) -> str:
    """Return how many poses and rows were measured; an arm in motion holds no poses."""
    of = calibration.result.rows
    # By cross-validation the rows that are predicted are those that were fitted.
    rows = of["train"] + (of["test"] if calibration.validated is None else 0)
    in_motion = [s.conditions.are_in_motion for s in calibration.fit.problem.stations]
    if any(in_motion):
        share = " of" if all(in_motion) else ", partly of"
        return f"{counted(rows, 'row')}{share} an arm in motion"
    poses = calibration.n_poses()
    return counted(poses, "measured pose") + (f" ({rows} rows)" if poses < rows else "")


def render(
    title: str, lead: str, sections: Sequence[Section], *, version: str, view: str | None = None
) -> str:
    """Return a page of sections; ``view`` is a file next to it that shows the robot in 3D."""
    import jinja2

    loader = jinja2.PackageLoader("pincal.report", "page")
    environment = jinja2.Environment(
        loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    page = environment.get_template("report.html.j2")
    made = page.render(title=title, lead=lead, sections=sections, version=version, view=view)
    return typeset(made)
