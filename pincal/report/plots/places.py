"""Where and when errors are large: by joint position, over the workspace, in the order of measurement."""

from __future__ import annotations

from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from pincal.report.evidence import Evidence
from pincal.report.plots.style import (
    AFTER,
    BEFORE,
    COLOURS,
    INK,
    MUTED,
    SMALL,
    TEXT,
    WIDTH,
    canvas,
    dress,
    legend,
    log_axis,
    plain,
    span_of,
    thinned,
)

# Bins of a variable, rows that a bin needs on average, and the fewest that it needs by itself.
_BINS, _FEWEST = 18, 12
_SOME = 3
# Pauses longer than this part of the whole time break a line.
_PAUSE = 0.04
# Hexagons across the workspace.
_CELLS = 15
# Viridis: even steps of lightness, distinguishable to the colour-blind and in print without colours.
_MAP = "viridis"


def joint_figure(evidence: Evidence, joint: int) -> Figure:
    """Draw the error against the position of one joint: median and the range of 90 % of the rows, before and after."""
    x = evidence.q[:, joint] if evidence.is_prismatic[joint] else np.degrees(evidence.q[:, joint])
    unit = "m" if evidence.is_prismatic[joint] else "deg"
    low, high = span_of(evidence.sizes("before"), evidence.sizes("after"))
    figure = canvas(3.0)
    axes = figure.subplots()
    for which, colour in (("before", BEFORE), ("after", AFTER)):
        centres, least, middle, most = _band(x, np.maximum(evidence.sizes(which), low))
        axes.fill_between(centres, least, most, color=colour, alpha=0.22, linewidth=0.0)
        axes.plot(centres, middle, ".-", color=colour, linewidth=1.8, markersize=3.5, label=which)
    log_axis(axes, "y", low, high)
    dress(axes, x=f"position [{unit}]", y=f"{evidence.name} error [{evidence.unit}]")
    axes.set_title(plain(evidence.joint_names[joint]), fontsize=TEXT, color=INK, loc="left", fontweight="bold")
    return figure


def median_range(evidence: Evidence, joint: int) -> tuple[float, float]:
    """Return the smallest and the largest median that :func:`joint_figure` draws after calibration."""
    middle = _band(evidence.q[:, joint], evidence.sizes("after"))[2]
    return float(np.nanmin(middle)), float(np.nanmax(middle))


def _band(x: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return centres, 5 %, median and 95 % in bins of equal width; not a number where there are too few rows to say."""
    count = int(np.clip(len(x) // _FEWEST, 1, _BINS))
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


def workspace_figure(evidence: Evidence, view: Literal["top", "side"]) -> Figure:
    """Draw the mean error over the workspace, before and after calibration on one scale of colours.

    Args:
        evidence: errors row by row.
        view: "top" looks down on the robot, "side" shows distance from the vertical through its base against height.
    """
    across, along, labels = _seen_from(evidence, view)
    figure = canvas(2.75)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    figure.subplots_adjust(right=1.0 - 0.75 / WIDTH, wspace=0.08)
    means = np.concatenate([evidence.sizes("before"), evidence.sizes("after")])
    low, high = np.quantile(means[means > 0.0], [0.1, 0.98]) if np.any(means > 0.0) else (1e-3, 1.0)
    scale = LogNorm(float(low), float(max(high, 1.01 * low)))
    extent = _extent(across, along)
    for axes, which in zip(panels, ("before", "after"), strict=True):
        cells = axes.hexbin(
            across, along, evidence.sizes(which), gridsize=_CELLS, extent=extent, cmap=_MAP, norm=scale, linewidths=0.1
        )
        axes.set_aspect("equal", adjustable="box")
        dress(axes, x=labels[0], title=which)
    panels[0].set_ylabel(labels[1], fontsize=TEXT, color=INK)
    bar = figure.colorbar(cells, cax=figure.add_axes((1.0 - 0.66 / WIDTH, 0.2, 0.02, 0.66)))
    bar.outline.set_visible(False)
    log_axis(bar.ax, "y", float(scale.vmin or 1.0), float(scale.vmax or 2.0))
    bar.ax.tick_params(labelsize=SMALL, color=MUTED, labelcolor=INK, which="both")
    bar.ax.set_title(evidence.unit, fontsize=SMALL, color=INK)
    return figure


def _seen_from(evidence: Evidence, view: str) -> tuple[np.ndarray, np.ndarray, tuple[str, str]]:
    """Return two coordinates of each row's tip [m] and their names."""
    up = evidence.up
    first = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    first = first - (first @ up) * up
    first /= np.linalg.norm(first)
    x, y, height = evidence.place @ first, evidence.place @ np.cross(up, first), evidence.place @ up
    if view == "top":
        return x, y, ("forward [m]", "left [m]")
    return np.hypot(x, y), height, ("distance [m]", "height [m]")


def _extent(x: np.ndarray, y: np.ndarray) -> tuple[float, float, float, float]:
    """Return what a square map has to show, of the same length both ways."""
    half = 0.52 * max(float(np.ptp(x)), float(np.ptp(y)), 1e-3)
    a, b = (float(v.min() + v.max()) / 2.0 for v in (x, y))
    return a - half, a + half, b - half, b + half


def order_figure(evidence: Evidence) -> Figure:
    """Draw the error in the order of measurement: one dot per pose, and the running median."""
    x, label = _order(evidence)
    figure = canvas(3.3)
    axes = figure.subplots()
    order = np.argsort(x, kind="stable")
    shown = order[thinned(len(order))]
    low, high = span_of(evidence.sizes("before"), evidence.sizes("after"))
    for which, colour in (("before", BEFORE), ("after", AFTER)):
        sizes = np.maximum(evidence.sizes(which), low)
        axes.plot(x[shown], sizes[shown], ".", color=colour, markersize=3.4, alpha=0.55, markeredgewidth=0.0)
        _draw_median(axes, x[order], sizes[order], colour, which)
    log_axis(axes, "y", low, high)
    dress(axes, x=label, y=f"{evidence.name} error [{evidence.unit}]", title="Size of the error")
    legend(axes, loc="lower right", ncols=2)
    return figure


def _draw_median(axes: Axes, x: np.ndarray, sizes: np.ndarray, colour: str, label: str) -> None:
    for i, parts in enumerate(_sessions(x, 2 * _BINS, _FEWEST)):
        middle = [float(np.median(sizes[part])) for part in parts]
        centres = [float(np.mean(x[part])) for part in parts]
        axes.plot(centres, middle, ".-", color=colour, linewidth=1.8, markersize=3.5, label=None if i else label)


def _sessions(x: np.ndarray, most: int, fewest: int) -> list[list[np.ndarray]]:
    """Return the rows between two long pauses in bins of equally many, x in ascending order."""
    pauses = np.flatnonzero(np.diff(x) > _PAUSE * np.ptp(x)) + 1 if len(x) > most else np.zeros(0, int)
    size = max(len(x) / most, fewest)
    sessions = np.split(np.arange(len(x)), pauses)
    return [np.array_split(rows, max(round(len(rows) / size), 1)) for rows in sessions]


def drift_figure(evidence: Evidence) -> Figure:
    """Draw the mean of what calibration leaves, component by component, in the order of measurement.

    Bars are two standard deviations of a mean: where most of them reach zero nothing has moved.
    """
    x, label = _order(evidence)
    rows = np.flatnonzero(~evidence.is_outlier)
    order = rows[np.argsort(x[rows], kind="stable")]
    parts = [order[rows] for session in _sessions(x[order], _BINS, 2 * _FEWEST) for rows in session]
    names = "xyz" if len(evidence.after) == 3 else ("",)
    figure = canvas(3.3)
    axes = figure.subplots()
    axes.axhline(0.0, color=MUTED, linewidth=0.8)
    width = float(np.ptp(x)) / len(parts) or 1.0
    factor, unit = (1e3, evidence.unit.replace("m", "µ", 1)) if evidence.unit in ("mm", "mrad") else (1.0, evidence.unit)
    for k, (name, left) in enumerate(zip(names, evidence.after, strict=False)):
        centres = np.array([np.mean(x[part]) for part in parts]) + 0.16 * width * (k - 0.5 * (len(names) - 1))
        means = factor * np.array([np.mean(left[part]) for part in parts])
        errors = factor * np.array([2.0 * np.std(left[part]) / np.sqrt(len(part)) for part in parts])
        colour = (COLOURS[0], COLOURS[2], COLOURS[3])[k]
        axes.errorbar(centres, means, errors, fmt="osD"[k], color=colour, markersize=3.5, elinewidth=1.1, label=name or None)
    dress(axes, x=label, y=f"mean residual [{unit}]", title="Drift of what is left")
    if len(names) > 1:
        axes.set_ylim(axes.get_ylim()[0], axes.get_ylim()[1] + 0.18 * float(np.ptp(axes.get_ylim())))
        legend(axes, loc="upper right", ncols=3)
    return figure


def _order(evidence: Evidence) -> tuple[np.ndarray, str]:
    if evidence.time is not None:
        return (evidence.time - evidence.time.min()) / 3600.0, "time since the first pose [h]"
    return evidence.line.astype(float), "line of the table"
