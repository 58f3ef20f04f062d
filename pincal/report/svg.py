"""Figures as SVG that belongs into a page: its colours are the page's, its text is text."""

from __future__ import annotations

import html
import io
import re
import warnings

import matplotlib
from matplotlib.figure import Figure

from pincal.report.plots import style


def inline_svg(figure: Figure, *, key: str, title: str) -> str:
    """Return a figure as an SVG element for an HTML page.

    Colours of :mod:`pincal.report.plots.style` become the variables ``--ink``, ``--muted``, ``--grid``, ``--before``,
    ``--after``, ``--third``, which the page sets for light and for dark.

    Args:
        figure: what to draw.
        key: prefix of the identifiers of this figure; each figure of a page has its own.
        title: what the figure shows, for those who can't see it.
    """
    drawn = io.StringIO()
    # The SVG's text is set in the page's own fonts, so it matters to nobody which characters matplotlib's have.
    with warnings.catch_warnings(), matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": key}):
        warnings.filterwarnings("ignore", message=".*[Gg]lyph.*")
        figure.savefig(drawn, format="svg", transparent=True, metadata={"Date": None})
    svg = drawn.getvalue()[drawn.getvalue().index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->\s*", "", svg, flags=re.DOTALL).replace("xlink:href", "href")
    svg = _with_own_identifiers(svg, key)
    for colour, name in style.VARIABLES.items():
        svg = svg.replace(colour.lower(), f"var(--{name})")
    box = re.search(r'viewBox="[^"]*"', svg)
    label = html.escape(" ".join(title.split()), quote=True)
    opening = f'<svg {box.group() if box else ""} role="img" aria-label="{label}">'
    return opening + re.sub(r"\n\s*", "\n", svg[svg.index(">") + 1 :]).strip()


def _with_own_identifiers(svg: str, key: str) -> str:
    """Drop identifiers that nothing refers to, and give the others the figure's key: a page holds many figures."""
    used = set(re.findall(r'(?:url\(#|href="#)([^)"]+)', svg))
    svg = re.sub(r' id="([^"]+)"', lambda m: f' id="{key}-{m.group(1)}"' if m.group(1) in used else "", svg)
    return re.sub(r'(url\(#|href="#)', rf"\g<1>{key}-", svg)
