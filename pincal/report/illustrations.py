"""The figures of a report, each with a caption that explains how to read it."""

from __future__ import annotations

import contextlib
import html
import io
import re
import warnings
from collections.abc import Iterable, Iterator, Sequence

import matplotlib
from markupsafe import Markup
from matplotlib.figure import Figure

from pincal.calibration.result_tables import ParameterRow
from pincal.report.blocks import arranged, picture
from pincal.report.plots import found, row_figures, style
from pincal.report.subject import RowErrors
from pincal.thresholds import Count
from pincal.validate.outcome import MovedParameter, StationRecord

# Number of parameters whose course is drawn.
_MOST_COURSES: Count = 4

Drawing = tuple[Figure, str, str]
"""A figure, its title and its caption."""


def figures(key: str, drawings: Iterable[Drawing]) -> Markup:
    """Return figures as a block of the page; ``key`` begins their identifiers, so that those of
    other blocks differ.
    """
    shown = [
        picture(inline_svg(figure, key=f"{key}{i}", title=title), caption)
        for i, (figure, title, caption) in enumerate(drawings)
    ]
    return arranged("figures", *shown) if shown else Markup("")


def inline_svg(figure: Figure, *, key: str, title: str) -> str:
    """Return a figure as an SVG element for an HTML page.

    Colours of :mod:`pincal.report.plots.style` become the variables ``--ink``, ``--muted``,
    ``--grid``, ``--before``, ``--after``, ``--third``, which the page sets for light and for dark.

    Args:
        figure: what to draw.
        key: prefix of the identifiers of this figure; each figure of a page has its own.
        title: description of the figure, for screen readers.
    """
    drawn = io.StringIO()
    # Text is set in the page's own fonts, so characters that are missing in matplotlib's do not
    # matter.
    with (
        warnings.catch_warnings(),
        matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": key}),
    ):
        warnings.filterwarnings("ignore", message=".*[Gg]lyph.*")
        figure.savefig(drawn, format="svg", transparent=True, metadata={"Date": None})
    svg = drawn.getvalue()[drawn.getvalue().index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->\s*", "", svg, flags=re.DOTALL).replace(
        "xlink:href", "href"
    )
    # Identifiers that nothing refers to are dropped, the others get the figure's key: a page holds
    # many figures.
    used = set(re.findall(r'(?:url\(#|href="#)([^)"]+)', svg))
    svg = re.sub(
        r' id="([^"]+)"', lambda m: f' id="{key}-{m.group(1)}"' if m.group(1) in used else "", svg
    )
    svg = re.sub(r'(url\(#|href="#)', rf"\g<1>{key}-", svg)
    for colour, name in style.VARIABLES.items():
        svg = svg.replace(colour.lower(), f"var(--{name})")
    box = re.search(r'viewBox="[^"]*"', svg)
    label = html.escape(" ".join(title.split()), quote=True)
    opening = f'<svg {box.group() if box else ""} role="img" aria-label="{label}">'
    return opening + re.sub(r"\n\s*", "\n", svg[svg.index(">") + 1 :]).strip()


def error_drawings(readings: Iterable[RowErrors]) -> Iterator[Drawing]:
    """Yield the distribution of errors, held-out and fitted, of each kind of reading."""
    for evidence in readings:
        for held, rows, use in ((True, "held-out", "not used"), (False, "fitted", "used")):
            if evidence.part(held=held).any():
                title = (
                    f"Histogram of {evidence.name.replace('_', ' ')} errors of {rows} rows before "
                    "and after calibration"
                )
                caption = (
                    "Share of rows by size of error, on a logarithmic scale: the further left, "
                    f"the better. These rows were {use} by the fit that predicts them."
                )
                yield row_figures.histogram_figure(evidence, held=held), title, caption
        caption = (
            "Share of rows with a smaller error"
            + (
                ", each predicted by a fit without it. "
                if evidence.is_held.all()
                else ": solid lines held-out, dotted lines fitted rows. Where both coincide, "
                "expect the same accuracy at new poses. "
            )
            + "The dashed curve is the noise of the instrument alone."
        )
        yield (
            row_figures.cumulative_figure(evidence),
            f"Cumulative curves of {evidence.name.replace('_', ' ')} errors",
            caption,
        )


def course_drawings(records: Sequence[StationRecord]) -> Iterator[Drawing]:
    """Yield the course of each parameter that moved, from station to station."""
    entries: dict[str, list[tuple[int, MovedParameter]]] = {}
    for k, record in enumerate(records):
        for entry in record.get("parameters", ()):
            entries.setdefault(entry["name"], []).append((k, entry))
    for name, course in list(entries.items())[:_MOST_COURSES]:
        drawn = found.course_figure(name, [record["name"] for record in records], course)
        caption = (
            f"{name} at each station; bars are 95 % intervals. Filled: it changed since the "
            "station before."
        )
        yield drawn, f"{name} from station to station", caption


def joint_drawings(evidence: RowErrors) -> Iterator[Drawing]:
    """Yield the error against the position of each joint; nothing where a curve would have one
    point.
    """
    if not row_figures.has_curve(evidence):
        return
    for i, name in enumerate(evidence.joint_names):
        title = f"Error against the position of {name}, before and after calibration"
        yield row_figures.joint_figure(evidence, i), title, ""


def workspace_drawings(evidence: RowErrors) -> Iterator[Drawing]:
    """Yield the mean error over the workspace, from above and from the side."""
    caption = (
        "The workspace from above, the robot at the origin; each cell shows the mean error of its "
        "poses, brighter is worse, on the same scale before and after."
    )
    yield (
        row_figures.workspace_figure(evidence, "top"),
        "Mean error over the workspace, seen from above",
        caption,
    )
    caption = "The same from the side: distance from the robot's vertical axis, and height."
    yield (
        row_figures.workspace_figure(evidence, "side"),
        "Mean error over the workspace, seen from the side",
        caption,
    )


def order_drawings(evidence: RowErrors) -> Iterator[Drawing]:
    """Yield the error and the mean residual in the order of measurement."""
    caption = (
        "Each pose in the order of measurement, with the running median. A step or a slope "
        "indicates a change or drift."
    )
    yield row_figures.order_figure(evidence), "Error in the order of measurement", caption
    caption = (
        "Residuals after calibration, x, y, z in the instrument's frame, averaged over "
        "neighbouring poses; bars are two "
        "standard deviations. If the bars include zero, there is no drift."
    )
    yield row_figures.drift_figure(evidence), "Mean residual in the order of measurement", caption


def correction_drawings(parameters: Sequence[ParameterRow]) -> Iterator[Drawing]:
    """Yield the identified corrections, lengths and angles apart."""
    caption = (
        "Calibrated minus nominal, largest first, with 95 % intervals. Filled: significantly "
        "different from nominal; open: no significant correction."
    )
    for unit, what in (("m", "lengths"), ("rad", "angles")):
        with contextlib.suppress(ValueError):
            yield (
                found.correction_figure(parameters, unit),
                f"Corrections of {what} with their uncertainty",
                caption,
            )
            caption = ""
