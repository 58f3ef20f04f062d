"""The report of a calibration as one page that needs no network."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

from pincal.report import missing, sections
from pincal.report.blocks import Section
from pincal.report.subject import Subject

log = logging.getLogger(__name__)

SECTIONS: tuple[Callable[[Subject], Section | None], ...] = (
    sections.summary,
    sections.setup,
    sections.accuracy,
    sections.stations,
    missing.missing,
    sections.where,
    sections.moments,
    sections.parameters,
    sections.unidentified,
    sections.basis,
    sections.glossary,
)
"""The page, in order; a function that returns None leaves its section out."""


def report_page(subject: Subject, *, layout: tuple[Callable[[Subject], Section | None], ...] = SECTIONS) -> str:
    """Return ``report.html``: how good, where the errors are, what was missing, the parameters, and the provenance."""
    log.info("drawing the report")
    calibration, result = subject.calibration, subject.result
    poses, rows = calibration.n_poses(), result.rows["train"] + result.rows["test"]
    lead = f"{calibration.robot.n_joints} joints, {poses} measured poses" + (f" ({rows} rows)" if poses < rows else "")
    lead += ", with a search for missing effects" if subject.discovery else ""
    made = [section for make in layout if (section := make(subject)) is not None]
    title, version = f"Calibration of {calibration.robot.name}", subject.provenance.get("pincal", "")
    return render(title, lead, made, version=version, view=subject.view)


def render(title: str, lead: str, sections: Sequence[Section], *, version: str, view: str | None = None) -> str:
    """Return a page of sections; ``view`` is a file beside it that shows the robot in 3D."""
    import jinja2

    loader = jinja2.PackageLoader("pincal.report", "page")
    environment = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    page = environment.get_template("report.html.j2")
    return page.render(title=title, lead=lead, sections=sections, version=version, view=view)
