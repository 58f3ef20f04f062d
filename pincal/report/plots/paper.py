"""Fig. 6 of the paper: how far each model is from the truth, pose by pose."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from pincal.report.plots.style import COLOURS, GRID, INK, plain

# A logarithmic axis has no place for zero: deviations below rounding stand here [m].
_SMALLEST = 1e-17
# Size of a panel [in].
_PANEL_WIDTH, _HEIGHT = 3.6, 3.2


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
