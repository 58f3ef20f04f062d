"""The report of a calibration as one page that needs no network."""

from __future__ import annotations

import logging
from collections.abc import Callable

from pincal.report import search, sections, stations
from pincal.report.blocks import Section
from pincal.report.subject import Subject

log = logging.getLogger(__name__)

SECTIONS: tuple[Callable[[Subject], Section | None], ...] = (
    sections.summary,
    sections.setup,
    sections.accuracy,
    stations.stations,
    search.missing,
    sections.where,
    sections.parameters,
    sections.unidentified,
    sections.basis,
    sections.glossary,
)
"""The page, in order; a function that returns None leaves its section out."""


def report_page(subject: Subject, *, layout: tuple[Callable[[Subject], Section | None], ...] = SECTIONS) -> str:
    """Return ``report.html``: how good, where the errors are, what was missing, the parameters, and the provenance."""
    import jinja2

    log.info("drawing the report")
    loader = jinja2.PackageLoader("pincal.report", "page")
    environment = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    made = [section for make in layout if (section := make(subject)) is not None]
    return environment.get_template("report.html.j2").render(subject=subject, sections=made)
