"""Figures of the errors of a calibration: distribution, by joint position, over the workspace, and
in time.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from scipy.special import chdtr

from pincal.report.plots import style
from pincal.report.plots.style import (
    AFTER,
    BEFORE,
    FIGURE_WIDTH,
    INK,
    MUTED,
    SMALL,
    dress,
    legend,
    log_axis,
    panel,
    thinned,
)
from pincal.report.subject import RowErrors
from pincal.thresholds import Count, Scale

_MODELS = (("before", BEFORE), ("after", AFTER))
# Bins of a histogram over the whole logarithmic axis.
_BARS: Count = 36
# Points of a curve; more would be indistinguishable.
_POINTS: Count = 400
# Most bins of a variable, rows per bin on average, and fewest rows of a bin.
_BINS: Count = 18
_FEWEST: Count = 12
_SOME: Count = 3
# Pauses longer than this fraction of the whole time break a line.
_PAUSE: Scale = 0.04
# Hexagons across the workspace.
_CELLS: Count = 15
# Viridis: even steps of lightness, distinguishable to the colour-blind and in print without
# colours.
_MAP = "viridis"


def _error_axis(axes: Axes, which: Literal["x", "y"], evidence: RowErrors) -> tuple[float, float]:
    """Scale an axis such that nearly all errors before and after are visible; return its ends."""
    low, high = style.span_of(evidence.sizes("before"), evidence.sizes("after"))
    log_axis(axes, which, low, high)
    return low, high


def _error_label(evidence: RowErrors) -> str:
    # The readings of an IMU are told by their unit: their names are longer than a small figure is
    # high.
    is_of_imu = "/s" in evidence.unit
    return f"{'' if is_of_imu else f'{evidence.name} '}error [{evidence.unit}]"


def histogram_figure(evidence: RowErrors, *, held: bool = True) -> Figure:
    """Draw a histogram of errors, before and after calibration, on a logarithmic axis.

    Raises:
        ValueError: if there are no held-out or, with ``held=False``, no fitted rows.
    """
    rows = evidence.part(held=held)
    part = "held-out" if held else "fitted"
    if not rows.any():
        raise ValueError(f"no {part} rows to draw; expected at least one")
    figure, axes = panel()
    low, high = _error_axis(axes, "x", evidence)
    edges = np.geomspace(low, high, _BARS + 1)
    for which, colour in _MODELS:
        sizes = evidence.sizes(which)[rows]
        share = 100.0 * np.histogram(np.clip(sizes, low, high), edges)[0] / len(sizes)
        axes.stairs(share, edges, fill=True, color=colour, alpha=0.35)
        axes.stairs(share, edges, color=colour, linewidth=1.3, label=which)
    axes.set_ylim(0.0, 1.25 * axes.get_ylim()[1])
    dress(
        axes,
        x=_error_label(evidence),
        y="share of rows [%]",
        title=f"{int(rows.sum())} {part} rows",
    )
    legend(axes, loc="upper left")
    return figure


def cumulative_figure(evidence: RowErrors) -> Figure:
    """Draw the cumulative distribution of errors, compared with noise alone."""
    figure, axes = panel()
    low, high = _error_axis(axes, "x", evidence)
    for which, colour in _MODELS:
        for held in (False, True):
            sizes = np.sort(evidence.sizes(which)[evidence.part(held=held)])
            if len(sizes):
                at = thinned(len(sizes), _POINTS)
                is_main = held or not evidence.is_held.any()
                line, label = ("-", which) if is_main else (":", None)
                axes.plot(
                    sizes[at],
                    100.0 * (at + 1) / len(sizes),
                    line,
                    color=colour,
                    linewidth=1.8,
                    label=label,
                )
    if low < 5.0 * evidence.noise:
        x = np.geomspace(low, high, 200)
        share = 100.0 * chdtr(len(evidence.after), (x / evidence.noise) ** 2)
        axes.plot(x, share, "--", color=MUTED, linewidth=1.1, label="noise alone")
    _mark_most(axes, low)
    axes.set_ylim(0.0, 101.0)
    dress(axes, x=_error_label(evidence), y="rows with less error [%]")
    legend(axes, loc="lower left", bbox_to_anchor=(-0.02, 0.98), ncols=3)
    return figure


def _mark_most(axes: Axes, low: float) -> None:
    """Draw the level of 95 % of the rows; low is the left end of the axis."""
    axes.axhline(95.0, color=MUTED, linewidth=0.7)
    axes.annotate(
        "95 %",
        (low * 1.03, 95.0),
        xytext=(0, -12),
        textcoords="offset points",
        fontsize=SMALL,
        color=INK,
    )


def joint_figure(evidence: RowErrors, joint: int) -> Figure:
    """Draw the error against the position of one joint: median and the range of 90 % of the rows,
    before and after.
    """
    x = evidence.q[:, joint]
    unit = "m"
    if not evidence.is_prismatic[joint]:
        x = np.degrees(x)
        unit = "deg"
    figure, axes = panel(2.4)
    low, _ = _error_axis(axes, "y", evidence)
    for which, colour in _MODELS:
        centres, least, middle, most = _band(x, np.maximum(evidence.sizes(which), low))
        axes.fill_between(centres, least, most, color=colour, alpha=0.22, linewidth=0.0)
        axes.plot(centres, middle, ".-", color=colour, linewidth=1.8, markersize=3.5, label=which)
    dress(
        axes,
        x=f"position [{unit}]",
        y=_error_label(evidence),
        title=style.drawable(evidence.joint_names[joint]),
    )
    return figure


def has_curve(evidence: RowErrors) -> bool:
    """Return whether there are rows enough for more than one point of a curve."""
    return _bins_of(len(evidence.line)) > 1


def _bins_of(rows: int) -> int:
    return int(np.clip(rows // _FEWEST, 1, _BINS))


def _band(x: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return centres, 5 %, median and 95 % in bins of equal width; NaN where there are too few
    rows.
    """
    count = _bins_of(len(x))
    edges = np.linspace(x.min(), x.max(), count + 1)
    place = np.clip(np.digitize(x, edges) - 1, 0, count - 1)
    found = np.full((3, count), np.nan)
    for i in range(count):
        rows = place == i
        if rows.sum() >= min(_SOME, len(x)):
            found[:, i] = np.quantile(sizes[rows], [0.05, 0.5, 0.95])
    if count == 1:
        return edges, *np.repeat(found, 2, axis=1)
    return (edges[1:] + edges[:-1]) / 2.0, *found


def workspace_figure(evidence: RowErrors, view: Literal["top", "side"]) -> Figure:
    """Draw the mean error over the workspace, before and after calibration, with the same colour
    scale.

    Args:
        evidence: errors row by row.
        view: "top" looks down on the robot, "side" shows distance from the vertical through its
            base against height.
    """
    across, along, labels = _seen_from(evidence, view)
    figure = style.canvas(2.75)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    figure.subplots_adjust(right=1.0 - 0.75 / FIGURE_WIDTH, wspace=0.08)
    means = np.concatenate([evidence.sizes("before"), evidence.sizes("after")])
    ends = np.quantile(means[means > 0.0], [0.1, 0.98]) if np.any(means > 0.0) else (1e-3, 1.0)
    low = float(ends[0])
    high = max(float(ends[1]), 1.01 * low)
    # A square map.
    half = 0.52 * max(float(np.ptp(across)), float(np.ptp(along)), 1e-3)
    a, b = (float(v.min() + v.max()) / 2.0 for v in (across, along))
    cells = dict(
        gridsize=_CELLS,
        extent=(a - half, a + half, b - half, b + half),
        cmap=_MAP,
        norm=LogNorm(low, high),
    )
    for axes, (which, _) in zip(panels, _MODELS, strict=True):
        drawn = axes.hexbin(across, along, evidence.sizes(which), linewidths=0.1, **cells)
        axes.set_aspect("equal", adjustable="box")
        dress(axes, x=labels[0], title=which)
    panels[0].set_ylabel(labels[1], fontsize=style.TEXT, color=INK)
    bar = figure.colorbar(drawn, cax=figure.add_axes((1.0 - 0.66 / FIGURE_WIDTH, 0.2, 0.02, 0.66)))
    bar.outline.set_visible(False)
    log_axis(bar.ax, "y", low, high)
    bar.ax.tick_params(labelsize=SMALL, color=MUTED, labelcolor=INK, which="both")
    bar.ax.set_title(evidence.unit, fontsize=SMALL, color=INK)
    return figure


def _seen_from(evidence: RowErrors, view: str) -> tuple[np.ndarray, np.ndarray, tuple[str, str]]:
    """Return two coordinates of each row's tip [m] and their names."""
    up = evidence.up
    first = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    first = first - (first @ up) * up
    first /= np.linalg.norm(first)
    x = evidence.place @ first
    y = evidence.place @ np.cross(up, first)
    height = evidence.place @ up
    if view == "top":
        return x, y, ("forward [m]", "left [m]")
    return np.hypot(x, y), height, ("distance [m]", "height [m]")


def order_figure(evidence: RowErrors) -> Figure:
    """Draw the error in the order of measurement: one dot per pose, and the running median."""
    x, label = _order(evidence)
    figure, axes = panel(3.3)
    low, _ = _error_axis(axes, "y", evidence)
    order = np.argsort(x, kind="stable")
    shown = order[thinned(len(order))]
    for which, colour in _MODELS:
        sizes = np.maximum(evidence.sizes(which), low)
        axes.plot(
            x[shown],
            sizes[shown],
            ".",
            color=colour,
            markersize=3.4,
            alpha=0.55,
            markeredgewidth=0.0,
        )
        _draw_running_median(axes, x[order], sizes[order], colour, which)
    dress(axes, x=label, y=_error_label(evidence), title="Size of the error")
    legend(axes, loc="lower right", ncols=2)
    return figure


def _draw_running_median(
    axes: Axes, x: np.ndarray, sizes: np.ndarray, colour: str, label: str
) -> None:
    """Draw medians of neighbouring rows, interrupted at long pauses; x is in ascending order."""
    for i, parts in enumerate(_sessions(x, 2 * _BINS, _FEWEST)):
        axes.plot(
            [float(np.mean(x[part])) for part in parts],
            [float(np.median(sizes[part])) for part in parts],
            ".-",
            color=colour,
            linewidth=1.8,
            markersize=3.5,
            label=None if i else label,
        )


def _order(evidence: RowErrors) -> tuple[np.ndarray, str]:
    if evidence.time is not None:
        return (evidence.time - evidence.time.min()) / 3600.0, "time since the first pose [h]"
    return evidence.line.astype(float), "line of the table"


def _sessions(x: np.ndarray, most: int, fewest: int) -> list[list[np.ndarray]]:
    """Return the rows between two long pauses, in bins of equal size; x is in ascending order."""
    pauses = (
        np.flatnonzero(np.diff(x) > _PAUSE * np.ptp(x)) + 1 if len(x) > most else np.zeros(0, int)
    )
    size = max(len(x) / most, fewest)
    sessions = np.split(np.arange(len(x)), pauses)
    return [np.array_split(rows, max(round(len(rows) / size), 1)) for rows in sessions]


def drift_figure(evidence: RowErrors) -> Figure:
    """Draw the mean residual of each component in the order of measurement.

    Bars are two standard deviations of a mean: if most of them include zero, nothing has moved.
    """
    x, label = _order(evidence)
    rows = np.flatnonzero(~evidence.is_outlier)
    order = rows[np.argsort(x[rows], kind="stable")]
    parts = [order[rows] for session in _sessions(x[order], _BINS, 2 * _FEWEST) for rows in session]
    names = "xyz" if len(evidence.after) == 3 else ("",)
    figure, axes = panel(3.3)
    axes.axhline(0.0, color=MUTED, linewidth=0.8)
    width = float(np.ptp(x)) / len(parts) or 1.0
    factor, unit = _finer(evidence.unit)
    middles = np.array([np.mean(x[part]) for part in parts])
    for k, (name, left) in enumerate(zip(names, evidence.after, strict=False)):
        centres = middles + 0.16 * width * (k - 0.5 * (len(names) - 1))
        means = factor * np.array([np.mean(left[part]) for part in parts])
        errors = factor * np.array([_uncertainty_of_mean(left[part]) for part in parts])
        colour = (BEFORE, AFTER, style.THIRD)[k]
        axes.errorbar(
            centres,
            means,
            errors,
            fmt="osD"[k],
            color=colour,
            markersize=3.5,
            elinewidth=1.1,
            label=name or None,
        )
    dress(axes, x=label, y=f"mean residual [{unit}]", title="Drift of the residuals")
    if len(names) > 1:
        axes.set_ylim(top=axes.get_ylim()[1] + 0.18 * float(np.ptp(axes.get_ylim())))
        legend(axes, loc="upper right", ncols=3)
    return figure


def _finer(unit: str) -> tuple[float, str]:
    """Return a factor and the unit for means, which are smaller than errors."""
    if unit in ("mm", "mrad"):
        return 1e3, unit.replace("m", "µ", 1)
    return 1.0, unit


def _uncertainty_of_mean(values: np.ndarray) -> float:
    """Return two standard deviations of the mean of independent values."""
    return float(2.0 * np.std(values) / np.sqrt(len(values)))
