"""Figures of a search: the error after each step, each effect, and how often names are found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from pincal.discover.shrink import PartialResidual
from pincal.recorded import RECORDABLE
from pincal.report.plots import style
from pincal.report.plots.style import (
    AFTER,
    BEFORE,
    INK,
    LETTER,
    MUTED,
    ROW,
    SMALL,
    TEXT,
    drawable,
    dress,
    legend,
    log_axis,
    panel,
    thinned,
)
from pincal.thresholds import Count, Scale
from pincal.units import SIZES, format_small, small_unit

# Cells of a map along one joint.
_CELLS: Count = 14
# Number of bins of a variable, and fewest rows of a bin.
_BINS: Count = 30
_FEWEST: Count = 4
# A variable with at most this many values is categorical.
_CATEGORIES: Count = 5
# Letters of a name, of which a line has fewer.
_LETTERS: Count = 90
_LETTERS_A_LINE: Count = 34
# Height of one step [in].
_PER_STEP: Scale = 0.5


def stability_figure(counts: Mapping[str, int], of: int, sure: float) -> Figure:
    """Draw in how many subsamples each name is found.

    Args:
        counts: name -> number of subsamples.
        of: number of subsamples in all.
        sure: fraction of them from which on a name is more than a hint.
    """
    names = [fill(drawable(name, _LETTERS), _LETTERS_A_LINE) for name in counts][::-1]
    lines = max(name.count("\n") for name in names) + 1
    letters = max(len(line) for name in names for line in name.split("\n"))
    figure, axes = panel(1.1 + ROW * lines * len(names), left=0.3 + LETTER * letters)
    numbers = list(counts.values())[::-1]
    colours = [AFTER if n >= sure * of else MUTED for n in numbers]
    axes.barh(range(len(names)), numbers, height=0.6, color=colours)
    axes.axvline(sure * of, color=INK, linewidth=1.0, linestyle="--")
    axes.set(xlim=(0, of), ylim=(-0.7, len(names) - 0.3))
    dress(axes, x=f"named in how many of {of}")
    axes.set_yticks(range(len(names)), names, fontsize=SMALL, color=INK)
    return figure


def shrinking_figure(
    names: Sequence[str], errors: Mapping[str, Sequence[float]], floor: float
) -> Figure:
    """Draw how the error on held-out rows shrinks, model by model, down to the noise.

    Args:
        names: K models, in the order in which they were fitted.
        errors: statistic ("mean", "rms", "max") -> K errors [mm].
        floor: rms of the noise alone [mm].

    Raises:
        ValueError: if there is no model, or a statistic does not have one number per model.

    Example:
        >>> figure = shrinking_figure(["start", "+ backlash"], {"rms": [0.2, 0.1]}, 0.09)
        >>> figure.axes[0].get_xlabel()
        'held-out error [mm]'
        >>> shrinking_figure([], {}, 0.1)
        Traceback (most recent call last):
            ...
        ValueError: no models to draw; expected names and as many errors of each statistic
    """
    if not names or any(len(values) != len(names) for values in errors.values()):
        raise ValueError("no models to draw; expected names and as many errors of each statistic")
    sizes = np.array(list(errors.values()))
    steps = np.arange(len(names))[::-1]
    figure, axes = panel(1.5 + _PER_STEP * len(names), left=0.25, top=0.7)
    axes.hlines(steps, sizes.min(axis=0), sizes.max(axis=0), color=MUTED, linewidth=1.0)
    _draw_statistics(axes, steps, errors)
    _draw_floor(axes, steps, floor)
    log_axis(axes, "x", 0.6 * min(floor, sizes.min()), 1.6 * max(floor, sizes.max()))
    _write_names(axes, steps, names)
    axes.set_ylim(-0.5, len(names) - 0.25)
    dress(axes, x="held-out error [mm]")
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    legend(
        axes,
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=len(errors) + 1,
        columnspacing=1.0,
        handlelength=1.6,
    )
    return figure


def _draw_statistics(axes: Axes, steps: np.ndarray, errors: Mapping[str, Sequence[float]]) -> None:
    """Draw each statistic with a mark of its own, one mark per model."""
    for k, (statistic, values) in enumerate(errors.items()):
        axes.plot(
            values,
            steps,
            "osD"[k % 3],
            color=(AFTER, style.THIRD, BEFORE)[k % 3],
            markersize=6,
            label=statistic,
        )


def _draw_floor(axes: Axes, steps: np.ndarray, floor: float) -> None:
    """Draw the rms of the noise alone at each model."""
    # These lines do not cross the names above.
    axes.vlines(
        np.full(len(steps), floor),
        steps - 0.24,
        steps + 0.14,
        color=INK,
        linewidth=1.6,
        label="noise (rms)",
    )


def _write_names(axes: Axes, steps: np.ndarray, names: Sequence[str]) -> None:
    """Write the name of each model."""
    # Names are above their lines, where a phone has room for them.
    for step, name in zip(steps, names, strict=True):
        where = (0.01, step + 0.26)
        axes.annotate(
            drawable(name, 58), where, xycoords=("axes fraction", "data"), fontsize=SMALL, color=INK
        )


def effect_figure(trace: PartialResidual, title: str) -> Figure:
    """Draw errors against the variable of an effect, before and after it entered the model.

    Grey dots are errors of rows at the coordinate on which the effect acts, black dots means in
    bins of the variable with their standard deviations; the blue line is the fitted effect.

    Raises:
        ValueError: if the trace has no rows.
    """
    if len(trace.x) == 0:
        raise ValueError(f"no rows of {title} to draw; expected at least one")
    figure = style.canvas(5.4, rows=2, left=0.84, top=0.92)
    panels = figure.subplots(2, 1, sharex=True, sharey=True)
    factor, unit = small_unit(trace.error_unit)
    x, label = _axis(trace)
    reached = [trace.fitted.min() * factor, trace.fitted.max() * factor]
    for axes, errors, name in zip(
        panels, (trace.before, trace.after), ("without it", "with it"), strict=True
    ):
        reached += _draw_errors(axes, x, errors * factor, trace.weights / factor**2)
        spread = float(np.sqrt(np.average(errors**2, weights=trace.weights)))
        dress(axes, title=f"{name}: rms {format_small(spread, trace.error_unit)}")
    _draw_effect(panels[0], x, trace.fitted * factor)
    panels[1].axhline(0.0, color=AFTER, linewidth=1.4)
    margin = 0.08 * (max(reached) - min(reached)) or 1.0
    panels[0].set_ylim(min(reached) - margin, max(reached) + margin)
    panels[1].set_xlabel(label, fontsize=TEXT, color=INK)
    of = f"error of {drawable(trace.joint)}" if trace.joint else "error along the effect"
    figure.supylabel(f"{of} [{unit}]", fontsize=TEXT, color=INK, x=0.015)
    _entitle(figure, title)
    _explain_marks(figure, panels[0])
    return figure


def _entitle(figure: Figure, title: str) -> None:
    """Write the title at the left of the top."""
    figure.suptitle(
        drawable(title), fontsize=TEXT, color=INK, x=0.02, y=0.985, ha="left", fontweight="bold"
    )


def _explain_marks(figure: Figure, axes: Axes) -> None:
    """Write the legend of a panel below the title of its figure."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        fontsize=SMALL,
        frameon=False,
        labelcolor=INK,
        ncols=3,
        loc="upper left",
        bbox_to_anchor=(0.0, 0.955),
        columnspacing=1.0,
        handletextpad=0.3,
    )


def map_figure(trace: PartialResidual, title: str) -> Figure:
    """Draw an effect of two joints over the positions of both: the errors of the rows, and the
    fitted effect.

    Raises:
        ValueError: if the trace has no rows, or only one variable.
    """
    if len(trace.x) == 0 or trace.own is None:
        raise ValueError(f"no rows of {title} to draw over two joints; expected at least one")
    figure = style.canvas(3.1, top=0.72)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    figure.subplots_adjust(right=1.0 - 0.82 / style.FIGURE_WIDTH, wspace=0.08)
    factor, unit = small_unit(trace.error_unit)
    x, label = _axis(trace)
    turns = trace.error_unit == "rad"
    own = np.degrees(trace.own) if turns else trace.own
    most = float(np.abs(trace.fitted).max()) * factor or 1.0
    # Rows with a short lever carry little information on the joint.
    informative = trace.weights > 0.05 * np.quantile(trace.weights, 0.9)
    cells = _hexagons(x, own, most)
    for axes, errors, rows, name in zip(
        panels,
        (trace.before, trace.fitted),
        (informative, np.ones(len(x), bool)),
        ("measured", "fitted"),
        strict=True,
    ):
        drawn = axes.hexbin(x[rows], own[rows], C=errors[rows] * factor, **cells)
        dress(axes, x=label, title=name)
    panels[0].set_ylabel(
        f"{drawable(trace.joint or '')} [{'deg' if turns else 'm'}]", fontsize=TEXT, color=INK
    )
    _add_colour_bar(figure, drawn, unit)
    _entitle(figure, title)
    return figure


def _hexagons(x: np.ndarray, own: np.ndarray, most: float) -> dict[str, Any]:
    """Return how both maps are divided and coloured, such that they can be compared."""
    extent = (float(x.min()), float(x.max()), float(own.min()), float(own.max()))
    return {
        "gridsize": _CELLS,
        "extent": extent,
        "cmap": "PuOr",
        "vmin": -most,
        "vmax": most,
        "linewidths": 0.1,
    }


def _add_colour_bar(figure: Figure, drawn: PolyCollection, unit: str) -> None:
    """Show at the right which error a colour stands for."""
    bar = figure.colorbar(
        drawn, cax=figure.add_axes((1.0 - 0.7 / style.FIGURE_WIDTH, 0.2, 0.02, 0.56))
    )
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=SMALL, color=MUTED, labelcolor=INK)
    bar.ax.set_title(unit, fontsize=SMALL, color=INK)


def _axis(trace: PartialResidual) -> tuple[np.ndarray, str]:
    """Return the variable in the unit of its axis, and the axis' label."""
    recorded = RECORDABLE.get(trace.variable)
    if recorded is not None:
        name = recorded.label.format(drawable(trace.joint or "")) or drawable(trace.variable)
        unit = recorded.shown or recorded.unit
        return trace.x / SIZES.get(recorded.shown, 1.0), f"{name} [{unit}]" if unit else name
    if trace.unit == "rad":
        return np.degrees(trace.x), f"{drawable(trace.variable)} [deg]"
    name = (
        f"moment on {drawable(trace.joint or 'the base')}"
        if trace.variable == "moment"
        else drawable(trace.variable)
    )
    return trace.x, f"{name} [{trace.unit}]"


def _draw_errors(axes: Axes, x: np.ndarray, errors: np.ndarray, weights: np.ndarray) -> list[float]:
    """Draw rows and their means in bins; return the ends of the axis, regardless of rows with short
    levers.
    """
    jitter = np.zeros(len(x))
    values = np.unique(x)
    if len(values) <= _CATEGORIES:
        jitter = np.random.default_rng(0).uniform(-0.12, 0.12, len(x)) * (
            np.diff(values).min() if len(values) > 1 else 1.0
        )
        axes.set_xticks(values)
    strength = np.clip(weights / np.quantile(weights, 0.9), 0.05, 1.0)
    _draw_rows(axes, x + jitter, errors, strength)
    centres, means, spreads = _binned(x, errors, weights)
    look: dict[str, Any] = {"color": INK, "markersize": 3.5, "linewidth": 0.9, "elinewidth": 0.9}
    axes.errorbar(
        centres, means, spreads, fmt="o", label="mean of neighbouring rows", zorder=3, **look
    )
    axes.axhline(0.0, color=MUTED, linewidth=0.6, zorder=0)
    strong = errors[strength > 0.3] if np.any(strength > 0.3) else errors
    ends = np.concatenate([np.quantile(strong, [0.01, 0.99]), means - spreads, means + spreads])
    return [float(ends.min()), float(ends.max())]


def _draw_rows(axes: Axes, x: np.ndarray, errors: np.ndarray, strength: np.ndarray) -> None:
    """Draw one dot per row, the fainter the less its information (strength from 0 to 1)."""
    shown = thinned(len(x))
    # Three strengths keep files small.
    for k, (low, high) in enumerate(((0.0, 0.2), (0.2, 0.6), (0.6, 1.1))):
        rows = shown[(strength[shown] >= low) & (strength[shown] < high)]
        look: dict[str, Any] = {
            "color": MUTED,
            "markersize": 3.6,
            "markeredgewidth": 0.0,
            "alpha": 0.25 + 0.25 * k,
        }
        axes.plot(x[rows], errors[rows], ".", label="one row" if k == 2 else None, **look)


def _binned(
    x: np.ndarray, errors: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return centres, weighted means and their standard deviations in bins of x; a category is a
    bin.
    """
    values = np.unique(x)
    if len(values) <= _CATEGORIES:
        edges = np.concatenate(
            [[values[0] - 1.0], (values[1:] + values[:-1]) / 2.0, [values[-1] + 1.0]]
        )
    else:
        edges = np.linspace(x.min(), x.max(), min(_BINS, max(len(x) // 8, 1)) + 1)
    place = np.clip(np.digitize(x, edges) - 1, 0, len(edges) - 2)
    total, along, across = (
        np.bincount(place, sums) for sums in (weights, weights * x, weights * errors)
    )
    full = (np.bincount(place) >= _FEWEST) & (total > 0.0)
    return along[full] / total[full], across[full] / total[full], 1.0 / np.sqrt(total[full])


def _draw_effect(axes: Axes, x: np.ndarray, fitted: np.ndarray) -> None:
    """Draw the fitted effect: a line if it is a function of x, otherwise points."""
    order = np.argsort(x, kind="stable")
    x = x[order]
    y = fitted[order]
    size = np.ptp(y) or 1.0
    near = np.diff(x) < 2e-3 * (np.ptp(x) or 1.0)
    is_function = np.quantile(np.abs(np.diff(y))[near], 0.9) < 0.1 * size if near.any() else True
    shown = thinned(len(x))
    line = "-" if is_function else "."
    axes.plot(
        x[shown],
        y[shown],
        line,
        color=AFTER,
        linewidth=1.8,
        markersize=2.5,
        label="fitted",
        zorder=4,
    )
