"""How large errors are: their distribution before and after calibration, on fitted and on held-out rows."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from scipy.special import chdtr

from pincal.report.evidence import Evidence
from pincal.report.plots.style import AFTER, BEFORE, INK, MUTED, SMALL, canvas, dress, legend, log_axis, span_of, thinned

# Bins of a histogram over the whole logarithmic axis.
_BINS = 36
# Points of a curve; more are indistinguishable at its size.
_POINTS = 400


def histogram_figure(evidence: Evidence, *, held: bool = True) -> Figure:
    """Draw how many poses have which error, before and after calibration, on a logarithmic axis.

    Raises:
        ValueError: if there are no held-out or, with ``held=False``, no fitted rows.
    """
    rows = evidence.part(held=held)
    if not rows.any():
        raise ValueError(f"no {'held-out' if held else 'fitted'} rows to draw; expected at least one")
    low, high = span_of(evidence.sizes("before"), evidence.sizes("after"))
    edges = np.geomspace(low, high, _BINS + 1)
    figure = canvas()
    axes = figure.subplots()
    for which, colour in (("before", BEFORE), ("after", AFTER)):
        sizes = np.clip(evidence.sizes(which)[rows], low, high)
        share = 100.0 * np.histogram(sizes, edges)[0] / len(sizes)
        axes.stairs(share, edges, fill=True, color=colour, alpha=0.35)
        label = f"{which}: mean {evidence.sizes(which)[rows].mean():.3g} {evidence.unit}"
        axes.stairs(share, edges, color=colour, linewidth=1.3, label=label)
    axes.set_ylim(0.0, 1.25 * axes.get_ylim()[1])
    log_axis(axes, "x", low, high)
    title = f"{int(rows.sum())} {'held-out' if held else 'fitted'} poses"
    dress(axes, x=f"{evidence.name} error [{evidence.unit}]", y="share of poses [%]", title=title)
    legend(axes, loc="upper left")
    return figure


def cumulative_figure(evidence: Evidence) -> Figure:
    """Draw which share of poses has an error below each size, beside what noise alone would leave."""
    low, high = span_of(evidence.sizes("before"), evidence.sizes("after"))
    figure = canvas()
    axes = figure.subplots()
    for which, colour in (("before", BEFORE), ("after", AFTER)):
        for held in (False, True):
            rows = evidence.part(held=held)
            if rows.any():
                sizes = np.sort(evidence.sizes(which)[rows])
                at = thinned(len(sizes), _POINTS)
                style = "-" if held or not evidence.is_held.any() else ":"
                label = which if held or not evidence.is_held.any() else None
                axes.plot(sizes[at], 100.0 * (at + 1) / len(sizes), style, color=colour, linewidth=1.8, label=label)
    if low < 5.0 * evidence.noise:
        x = np.geomspace(low, high, 200)
        share = 100.0 * chdtr(len(evidence.after), (x / evidence.noise) ** 2)
        axes.plot(x, share, "--", color=MUTED, linewidth=1.1, label="noise alone")
    axes.axhline(95.0, color=MUTED, linewidth=0.7)
    axes.annotate("95 %", (low * 1.03, 95.0), xytext=(0, -12), textcoords="offset points", fontsize=SMALL, color=INK)
    axes.set_ylim(0.0, 101.0)
    log_axis(axes, "x", low, high)
    dress(axes, x=f"{evidence.name} error [{evidence.unit}]", y="poses with less error [%]")
    legend(axes, loc="lower left", bbox_to_anchor=(-0.02, 0.98), ncols=3)
    return figure
