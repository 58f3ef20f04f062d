"""Fig. 6 of the paper: how far each model is from the truth, pose by pose."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
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
        One panel a model, side by side on one logarithmic axis [m], titled with name, mean and maximum.

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
    for k, (name, deviations) in enumerate(series.items()):
        _draw_panel(panels[k], name, np.asarray(deviations, float), COLOURS[k % len(COLOURS)])
    panels[0].set_ylabel("deviation [m]")
    return figure


def _draw_panel(axes: Axes, name: str, deviations: np.ndarray, colour: str) -> None:
    poses = np.arange(1, len(deviations) + 1)
    axes.plot(poses, np.maximum(deviations, _SMALLEST), ".", color=colour, markersize=4, label=name)
    axes.axhline(max(float(deviations.mean()), _SMALLEST), color=INK, linewidth=1.0, linestyle="--")
    axes.set_yscale("log")
    axes.set_title(f"{plain(name)}\nmean {_length(deviations.mean())}, max {_length(deviations.max())}", fontsize=10)
    axes.set_xlabel("pose")
    axes.grid(visible=True, which="major", color=GRID, linewidth=0.6)


def _length(metres: float) -> str:
    """Write a length in the unit that suits it."""
    if metres >= 1e-4:
        return f"{metres * 1e3:.2f} mm"
    return f"{metres * 1e6:.2f} µm" if metres >= 1e-8 else f"{metres:.2e} m"
