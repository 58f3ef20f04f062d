"""Figures of results, drawn on canvases of their own: nothing is shown, no state of matplotlib is touched.

Each function takes a result and returns a :class:`matplotlib.figure.Figure`; save it with ``figure.savefig``. Those of a
calibration take :class:`~pincal.report.evidence.Evidence`:

    evidence = pincal.report.evidence.evidence_of(run)[0]
    pincal.report.plots.cumulative_figure(evidence).savefig("errors.png")
"""

from pincal.report.plots.errors import cumulative_figure, deviation_figure, histogram_figure
from pincal.report.plots.found import correction_figure, effect_figure, shrinking_figure
from pincal.report.plots.places import drift_figure, joint_figure, median_range, order_figure, workspace_figure
from pincal.report.plots.style import COLOURS

__all__ = [
    "COLOURS",
    "correction_figure",
    "cumulative_figure",
    "deviation_figure",
    "drift_figure",
    "effect_figure",
    "histogram_figure",
    "joint_figure",
    "median_range",
    "order_figure",
    "shrinking_figure",
    "workspace_figure",
]
