"""The figures of a report, each with a caption that says what one sees and how to read it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pincal.calibration.run import Calibration
from pincal.discover.run import Discovery
from pincal.discover.shrink import gap_names, partial_residual_title
from pincal.report.evidence import Evidence, evidence_of
from pincal.report.svg import inline_svg

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_HISTOGRAM = (
    "How many poses have which error. The scale is logarithmic: the further left, the better, each labelled step about a "
    "doubling."
)
_CUMULATIVE = (
    "Which share of the poses has less error than this: solid held-out, dotted fitted poses. Where both lie together, new "
    "poses will do as well as these. The dashed curve is what the instrument's noise alone would leave."
)
_TOP = (
    "The workspace from above, the robot at 0, 0; each cell the mean error of its poses. Brighter is worse, on the same "
    "scale before and after."
)
_SIDE = "The same from the side: distance from the robot's vertical axis, and height."
_ORDER = "Each pose in the order of measurement, with the running median. A step or a slope says that something moved."
_DRIFT = (
    "What calibration leaves, x, y, z in the instrument's frame, averaged over neighbouring poses; bars are two standard "
    "deviations. Bars that reach zero: nothing drifted."
)
_CORRECTION = (
    "What was corrected, largest first, with 95 % intervals. Filled: surely different from nominal; open: no correction "
    "needed."
)
_SHRINKING = (
    "Error on poses that neither fit nor search saw, step by step from top to bottom. At the upright mark there is only the "
    "noise of the instrument left."
)


@dataclass(frozen=True)
class Picture:
    """One figure of the report.

    Attributes:
        section: where it belongs: "size", "joint", "workspace", "order", "gap", "effect" or "correction".
        svg: the drawing.
        caption: what one sees and how to read it.
    """

    section: str
    svg: str
    caption: str


def illustrations(calibration: Calibration, discovery: Discovery | None = None) -> list[Picture]:
    """Return all figures of a report, in order.

    Args:
        calibration: what to report.
        discovery: what was found missing, if it was looked for.
    """
    drawn: list[Picture] = []
    everything = [*_of_errors(calibration), *_of_corrections(calibration), *(_of_discovery(discovery) if discovery else ())]
    for section, figure, title, caption in everything:
        drawn.append(Picture(section, inline_svg(figure, key=f"f{len(drawn)}", title=title), caption))
    return drawn


def _of_errors(calibration: Calibration) -> Iterator[tuple[str, Figure, str, str]]:
    from pincal.report.plots import cumulative_figure, histogram_figure

    readings = evidence_of(calibration)
    for evidence in readings:
        for held in (True, False):
            if evidence.part(held=held).any():
                rows = "held-out" if held else "fitted"
                title = f"Histogram of {evidence.name} errors of {rows} poses before and after calibration"
                caption = f"{_HISTOGRAM} These poses were {'never seen by the fit' if held else 'used by the fit'}."
                yield "size", histogram_figure(evidence, held=held), title, caption
        yield "size", cumulative_figure(evidence), f"Cumulative curves of {evidence.name} errors", _CUMULATIVE
    yield from _of_places(readings[0])


def _of_places(evidence: Evidence) -> Iterator[tuple[str, Figure, str, str]]:
    from pincal.report.plots import drift_figure, joint_figure, median_range, order_figure, workspace_figure

    for i, name in enumerate(evidence.joint_names):
        title = f"Error against the position of {name}, before and after calibration"
        low, high = median_range(evidence, i)
        caption = f"{name}: after calibration the median goes from {low:.3g} to {high:.3g} {evidence.unit} over its range."
        yield "joint", joint_figure(evidence, i), title, caption
    yield "workspace", workspace_figure(evidence, "top"), "Mean error over the workspace, seen from above", _TOP
    yield "workspace", workspace_figure(evidence, "side"), "Mean error over the workspace, seen from the side", _SIDE
    yield "order", order_figure(evidence), "Error in the order of measurement", _ORDER
    yield "order", drift_figure(evidence), "Mean residual in the order of measurement", _DRIFT


def _of_corrections(calibration: Calibration) -> Iterator[tuple[str, Figure, str, str]]:
    from pincal.report.plots import correction_figure

    parameters = calibration.result.parameters
    for unit, what in (("m", "lengths"), ("rad", "angles")):
        try:
            figure = correction_figure(parameters, unit)
        except ValueError:
            continue
        yield "correction", figure, f"Corrections of {what} with their uncertainty", _CORRECTION


def _of_discovery(discovery: Discovery) -> Iterator[tuple[str, Figure, str, str]]:
    from pincal.report.plots import effect_figure, shrinking_figure

    gaps = discovery.gaps
    errors = {name: [getattr(gap, f"{name}_mm") for gap in gaps] for name in ("mean", "rms", "max")}
    figure = shrinking_figure(gap_names(gaps), errors, discovery.report["noise_floor_mm"])
    yield "gap", figure, "Error on held-out rows after each step", _SHRINKING
    for trace in discovery.traces:
        title = partial_residual_title(trace)
        caption = (
            f"{title}: what is off against {trace.variable}, the effect left out of the final model (above) and in it "
            "(below). Small dots are poses, those with bars their mean among neighbours, the line what was fitted. Below, "
            "the bars have to reach zero."
        )
        yield "effect", effect_figure(trace, title), f"{title}: error against {trace.variable}, without and with it", caption
