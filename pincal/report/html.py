"""The report of a calibration as one page that needs no network."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pincal.report.result import ParameterRow
from pincal.report.run import Calibration

_READABLE = {"m": (1e3, "mm"), "rad": (1e3, "mrad")}


def write_report(path: Path, calibration: Calibration, provenance: dict[str, Any], notes: tuple[str, ...]) -> None:
    """Write ``report.html``: errors before and after, parameters with reasons, notes, and what it all rests on.

    Args:
        path: the file.
        calibration: what to report.
        provenance: versions, command, inputs with hashes.
        notes: what the exported URDF does not carry.
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
    )
    path.write_text(page, encoding="utf-8")


def _readable(row: ParameterRow) -> tuple[str, str, str, str]:
    """Return unit, nominal, value and sigma of a parameter as text."""
    factor, unit = _READABLE.get(row.unit, (1.0, row.unit))
    form = "{:.4f}" if unit in ("mm", "mrad") else "{:.3e}"
    sigma = "-" if row.sigma is None else (f"{row.sigma * factor:#.2g}" if factor != 1.0 else f"{row.sigma:.1e}")
    return unit, form.format(row.nominal * factor), form.format(row.value * factor), sigma
