"""The certificate as a page that prints on one sheet of A4."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.resources import files

from pincal.certificate.contents import NOT_STATED, Certificate, Figure, Range
from pincal.errors import counted
from pincal.identity import KEYS
from pincal.thresholds import Count
from pincal.units import show_limits, show_size, typeset

# Short names for what identifies robot, instrument and circumstances.
_LABELS = {
    "robot": "robot",
    "controller": "controller",
    "instrument": "instrument",
    "certificate": "its certificate",
    "operator": "measured by",
    "date": "measured on",
    "temperature": "temperature",
    "place": "place",
    "laboratory": "laboratory",
    "customer": "customer",
    "country": "country",
}
# Digits of a checksum that a sheet shows; all of them are in the XML.
_DIGITS: Count = 16


def certificate_page(certificate: Certificate) -> str:
    """Return ``certificate.html``: one page that needs no network and no script."""
    import jinja2

    loader = jinja2.PackageLoader("pincal.certificate", "templates")
    environment = jinja2.Environment(
        loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    style = files("pincal.certificate").joinpath("templates", "certificate.css")
    has_limits = any(
        figure.limits is not None for group in certificate.groups for figure in group.figures
    )
    made = environment.get_template("certificate.html.j2").render(
        of=certificate,
        style=style.read_text(encoding="utf-8"),
        identity=_identity(certificate),
        ranges=list(map(_range, certificate.ranges)),
        has_limits=has_limits,
        cells=_cells,
        counted=counted,
        digits=_DIGITS,
    )
    return typeset(made)


def _identity(certificate: Certificate) -> list[tuple[str, str]]:
    """Return what identifies robot, instrument and circumstances; what was not stated, too."""
    stated = {key: value for key, _, value in certificate.identity.entries()}
    if "temperature" in stated:
        stated["temperature"] += " deg C"
    known = [(_LABELS[key], stated[key]) for key in KEYS if key in stated]
    known += certificate.identity.note.items()
    lacking = [_LABELS[key] for key in KEYS if key not in stated]
    return [*known, (NOT_STATED, ", ".join(lacking))] if lacking else known


def _range(of: Range) -> tuple[str, str]:
    """Return name and range in words."""
    digits = 1 if of.unit in ("deg", "deg C", "mm") else 3
    if of.lower == of.upper:
        return of.name, f"{of.lower:.{digits}f} {of.unit}"
    return of.name, f"{of.lower:.{digits}f} to {of.upper:.{digits}f} {of.unit}"


def _cells(figure: Figure, has_uncertainties: bool, has_limits: bool) -> Iterator[str]:
    """Yield the cells of a figure: its value, and where any figure beside it has them, uncertainty,
    nominal value, limits and decision.
    """
    yield f"{_number(figure.value)} {figure.unit}".rstrip()
    if has_uncertainties:
        yield _uncertainty(figure)
    if has_limits:
        yield "" if figure.nominal is None else _number(figure.nominal)
        yield "" if figure.limits is None else show_limits(*figure.limits, _number)
        yield figure.decision or ""


def _uncertainty(figure: Figure) -> str:
    """Return expanded uncertainty or interval in words; empty without either."""
    if figure.expanded is not None:
        return f"{_size(figure.expanded.value)} (k = {figure.expanded.factor:.3g})"
    if figure.interval is None or figure.interval[0] is None:
        return ""
    lower, upper = figure.interval
    return f"above {lower:.4f}" if upper is None else f"{lower:.4f} to {upper:.4f}"


_size = show_size(4)


def _number(value: float) -> str:
    """Return a number without the sign of a zero."""
    return f"{round(value, 4) + 0.0:.4f}"
