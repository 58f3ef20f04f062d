"""The report of a calibration as one page that needs no network."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pincal.calibration.run import Calibration
from pincal.discover.run import Discovery
from pincal.report import search, sections
from pincal.report.blocks import Section
from pincal.report.subject import Subject

log = logging.getLogger(__name__)

SECTIONS: tuple[Callable[[Subject], Section | None], ...] = (
    sections.summary,
    sections.setup,
    sections.accuracy,
    search.missing,
    sections.where,
    sections.parameters,
    sections.unidentified,
    sections.basis,
    sections.glossary,
)
"""The page, in order. A section is a function from what is reported to blocks; None leaves it out."""


def write_report(
    path: Path,
    calibration: Calibration,
    provenance: dict[str, Any],
    notes: tuple[str, ...],
    discovery: Discovery | None = None,
    *,
    view: str | None = None,
) -> None:
    """Write ``report.html``: how good, where the errors are, what was missing, the parameters, and the provenance.

    Args:
        path: the file.
        calibration: what to report.
        provenance: versions, command, inputs with hashes.
        notes: what the exported URDF does not carry.
        discovery: what was found missing, if it was looked for.
        view: name of the file beside the report that holds the view in three dimensions, if there is one.
    """
    path.write_text(report_page(calibration, provenance, notes, discovery, view=view), encoding="utf-8")


def report_page(
    calibration: Calibration,
    provenance: dict[str, Any],
    notes: tuple[str, ...],
    discovery: Discovery | None = None,
    *,
    view: str | None = None,
    layout: tuple[Callable[[Subject], Section | None], ...] = SECTIONS,
) -> str:
    """Return what :func:`write_report` writes.

    Args:
        calibration: what to report.
        provenance: versions, command, inputs with hashes.
        notes: what the exported URDF does not carry.
        discovery: what was found missing, if it was looked for.
        view: name of the file beside the report that holds the view in three dimensions, if there is one.
        layout: the sections, in order.
    """
    import jinja2

    log.info("drawing the report")
    subject = Subject(calibration, provenance, notes, discovery, view)
    loader = jinja2.PackageLoader("pincal.report", "page")
    environment = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    made = [section for make in layout if (section := make(subject)) is not None]
    return environment.get_template("report.html.j2").render(subject=subject, sections=made)
