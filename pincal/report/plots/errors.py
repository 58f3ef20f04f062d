"""How large errors are: before and after calibration, on fitted and on held-out rows, and pose by pose as in the paper."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from scipy.special import chdtr

from pincal.report.evidence import Evidence
from pincal.report.plots.style import (
    AFTER,
    BEFORE,
    COLOURS,
    GRID,
    INK,
    MUTED,
    SMALL,
    canvas,
    dress,
    legend,
    log_axis,
    plain,
    span_of,
    thinned,
)

# A logarithmic axis has no place for zero: deviations below rounding stand here [m].
_SMALLEST = 1e-17
# Size of a panel [in].
_PANEL_WIDTH, _HEIGHT = 3.6, 3.2
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


def deviation_figure(series: Mapping[str, np.ndarray]) -> Figure:
    r"""Draw how far each model is from the truth, pose by pose: Fig. 6 of the paper.

    Args:
        series: name of a model -> shape (N,), distance between its prediction and the truth at each pose [m].

    Returns:
        One panel per model, side by side on one logarithmic axis [m], titled with name, mean and maximum.

    Raises:
        ValueError: if there is no series, or one has no poses.

    Example:
        >>> figure = deviation_figure({"standard DH": np.array([1e-3, 3e-3]), "DH,s,e": np.array([1e-9, 2e-9])})
        >>> [axes.get_title() for axes in figure.axes]
        ['standard DH\nmean 2.00 mm, max 3.00 mm', 'DH,s,e\nmean 1.50e-09 m, max 2.00e-09 m']
        >>> deviation_figure({})
        Traceback (most recent call last):
            ...
        ValueError: no deviations to draw; expected at least one series of at least one pose
    """
    if not series or any(len(deviations) == 0 for deviations in series.values()):
        raise ValueError("no deviations to draw; expected at least one series of at least one pose")
    figure = Figure(figsize=(_PANEL_WIDTH * len(series), _HEIGHT), layout="constrained", dpi=150)
    panels = figure.subplots(1, len(series), sharey=True, squeeze=False)[0]
    for k, (axes, (name, deviations)) in enumerate(zip(panels, series.items(), strict=True)):
        sizes = np.asarray(deviations, float)
        shown, mean = np.maximum(sizes, _SMALLEST), max(float(sizes.mean()), _SMALLEST)
        axes.plot(range(1, len(sizes) + 1), shown, ".", color=COLOURS[k % len(COLOURS)], markersize=4, label=name)
        axes.axhline(mean, color=INK, linewidth=1.0, linestyle="--")
        axes.set_yscale("log")
        axes.set_title(f"{plain(name)}\nmean {_length(sizes.mean())}, max {_length(sizes.max())}", fontsize=10)
        axes.set_xlabel("pose")
        axes.grid(visible=True, which="major", color=GRID, linewidth=0.6)
    panels[0].set_ylabel("deviation [m]")
    return figure


def _length(metres: float) -> str:
    """Write a length in the unit that suits it."""
    if metres >= 1e-4:
        return f"{metres * 1e3:.2f} mm"
    return f"{metres * 1e6:.2f} µm" if metres >= 1e-8 else f"{metres:.2e} m"
