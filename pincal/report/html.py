"""The report of a calibration as one page that needs no network."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pincal.report.discovery import Discovery
from pincal.report.result import ParameterRow
from pincal.report.run import Calibration
from pincal.report.shrink import gap_names, trace_title
from pincal.report.words import effect_words

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Sharp at the width of the page, and a file that can be sent by mail.
_DPI = 110
_READABLE = {"m": (1e3, "mm"), "rad": (1e3, "mrad")}


def write_report(
    path: Path,
    calibration: Calibration,
    provenance: dict[str, Any],
    notes: tuple[str, ...],
    discovery: Discovery | None = None,
) -> None:
    """Write ``report.html``: errors before and after, parameters with reasons, notes, and what it all rests on.

    Args:
        path: the file.
        calibration: what to report.
        provenance: versions, command, inputs with hashes.
        notes: what the exported URDF does not carry.
        discovery: what was found missing, if it was looked for.
    """
    import jinja2

    environment = jinja2.Environment(loader=jinja2.PackageLoader("pincal.report", "."), autoescape=True)
    result = calibration.result
    page = environment.get_template("report.html.j2").render(
        robot=calibration.robot,
        kind=calibration.train.kind,
        source=calibration.train.source,
        result=result,
        errors=[(model, rows, values) for model, by_rows in result.error.items() for rows, values in by_rows.items()],
        parameters=[(row, *_readable(row)) for row in result.parameters],
        notes=notes,
        provenance=provenance,
        discovery=discovery,
        steps=[] if discovery is None else list(zip(gap_names(discovery.gaps), discovery.gaps, strict=True)),
        figures=[] if discovery is None else _figures(discovery),
        words=effect_words,
    )
    path.write_text(page, encoding="utf-8")


def _figures(discovery: Discovery) -> list[tuple[str, str]]:
    """Return the figures of a discovery: PNG in base 64, and what they show in words."""
    from pincal.report.plots import effect_figure, shrinking_figure

    gaps = discovery.gaps
    errors = {name: [getattr(gap, f"{name}_mm") for gap in gaps] for name in ("mean", "rms", "max")}
    floor = discovery.report["noise_floor_mm"]
    found = [(shrinking_figure(gap_names(gaps), errors, floor), "Error on held-out rows after each step")]
    for trace in discovery.traces:
        title = trace_title(trace)
        found.append((effect_figure(trace, title), f"{title}: error against {trace.variable}, without and with the effect"))
    return [(_png(figure), words) for figure, words in found]


def _png(figure: Figure) -> str:
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=_DPI)
    return base64.b64encode(drawn.getvalue()).decode("ascii")


def _readable(row: ParameterRow) -> tuple[str, str, str, str]:
    """Return unit, nominal, value and sigma of a parameter as text."""
    factor, unit = _READABLE.get(row.unit, (1.0, row.unit))
    form = "{:.4f}" if unit in ("mm", "mrad") else "{:.3e}"
    sigma = "-" if row.sigma is None else (f"{row.sigma * factor:#.2g}" if factor != 1.0 else f"{row.sigma:.1e}")
    return unit, form.format(row.nominal * factor), form.format(row.value * factor), sigma
