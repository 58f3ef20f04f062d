"""Figures of results: errors of models, corrections of parameters, and their course."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import wrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pincal.calibration.result_tables import ParameterRow
from pincal.parameters import FRAME_SYMBOLS, split_name
from pincal.report.plots import style
from pincal.report.plots.style import (
    AFTER,
    INK,
    LETTER,
    MUTED,
    ROW,
    SMALL,
    drawable,
    drawable_parameter,
    dress,
    panel,
)
from pincal.thresholds import Count, Scale
from pincal.units import INTERVAL, readable_unit
from pincal.validate.outcome import MovedParameter

# Most parameters that are drawn, the largest corrections first.
_MOST: Count = 24
# Most names of stations under an axis, and most letters of each.
_MOST_NAMES: Count = 8
_LETTERS: Count = 12
# Smallest deviation that is drawn, since a logarithmic axis has no zero [mm].
_SMALLEST: Scale = 1e-6
# Width of a panel of deviations [in].
_PANEL: Scale = 3.6
# Letters of a remark per inch of a figure.
_LETTERS_PER_INCH: Count = 15


def deviation_figure(series: Mapping[str, np.ndarray], *, remark: str = "") -> Figure:
    r"""Draw the error of each model, pose by pose: Fig. 6 of the paper.

    Args:
        series: name of a model -> shape (N,), distance between its prediction and the truth at each
            pose [m].
        remark: a sentence below, on what the figure shows.

    Returns:
        One panel per model, side by side on one logarithmic axis [mm], titled with name, mean and
        maximum.

    Raises:
        ValueError: if there is no series, or one has no poses.

    Example:
        >>> sizes = {"standard DH": np.array([1e-3, 3e-3]), "DH,s,e": np.array([8e-5, 9e-5])}
        >>> figure = deviation_figure(sizes)
        >>> [axes.get_title() for axes in figure.axes]
        ['standard DH\nmean 2.00 mm, max 3.00 mm', 'DH,s,e\nmean 0.0850 mm, max 0.0900 mm']
        >>> deviation_figure({})
        Traceback (most recent call last):
            ...
        ValueError: no deviations to draw; expected at least one series of at least one pose
    """
    if not series or any(len(deviations) == 0 for deviations in series.values()):
        raise ValueError("no deviations to draw; expected at least one series of at least one pose")
    lines = wrap(remark, int(_LETTERS_PER_INCH * _PANEL * len(series)))
    figure = Figure(
        figsize=(_PANEL * len(series), 3.5 + ROW * len(lines)), layout="constrained", dpi=150
    )
    panels = figure.subplots(1, len(series), sharey=True, squeeze=False)[0]
    for k, (axes, (name, deviations)) in enumerate(zip(panels, series.items(), strict=True)):
        colour = style.COLOURS[k % len(style.COLOURS)]
        _draw_deviations(axes, drawable(name), 1e3 * np.asarray(deviations, float), colour)
    panels[0].set_ylabel("deviation [mm]")
    handles, labels = panels[0].get_legend_handles_labels()
    # The dots of each panel have a colour of their own.
    figure.legend(handles, labels, loc="outside upper center", ncols=2, frameon=False, fontsize=10)
    if lines:
        figure.supxlabel("\n".join(lines), fontsize=9, x=0.01, ha="left")
    return figure


def _draw_deviations(axes: Axes, name: str, sizes_mm: np.ndarray, colour: str) -> None:
    """Draw the deviations of one model, shape (N,) [mm], pose by pose, with their mean."""
    shown = np.maximum(sizes_mm, _SMALLEST)
    axes.plot(range(1, len(shown) + 1), shown, ".", color=colour, markersize=4, label="one pose")
    mean = max(float(sizes_mm.mean()), _SMALLEST)
    axes.axhline(mean, color=INK, linewidth=1.0, linestyle="--", label="mean of all poses")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_title(
        f"{name}\nmean {_length(sizes_mm.mean())}, max {_length(sizes_mm.max())}", fontsize=10
    )
    axes.set_xlabel("pose")
    axes.grid(visible=True, which="major", color=style.GRID, linewidth=0.6)


def _length(millimetres: float) -> str:
    """Return a length with three digits at least."""
    return f"{millimetres:.2f} mm" if millimetres >= 1.0 else f"{millimetres:.4f} mm"


def correction_figure(parameters: Sequence[ParameterRow], unit: str) -> Figure:
    """Draw identified minus nominal values of the parameters in "m" or "rad", with 95 % intervals.

    The poses of instrument and target have no nominal values and are left out.

    Raises:
        ValueError: if none is identified.
    """
    known = [p for p in parameters if p.unit == unit and p.status == "identified" and p.sigma]
    drawn = [p for p in known if split_name(p.name)[1] not in FRAME_SYMBOLS]
    if not drawn:
        raise ValueError(f"no identified parameter in {unit} to draw")
    factor, name = readable_unit(unit)
    drawn = sorted(drawn, key=lambda p: -abs(p.value - p.nominal))[:_MOST][::-1]
    names = [drawable_parameter(p.name, 26) for p in drawn]
    figure, axes = panel(1.1 + ROW * len(drawn), left=0.3 + LETTER * max(map(len, names)))
    axes.axvline(0.0, color=MUTED, linewidth=0.9)
    for i, p in enumerate(drawn):
        change = (p.value - p.nominal) * factor
        half = INTERVAL * (p.sigma or 0.0) * factor
        colour, face = (AFTER, AFTER) if abs(change) > half else (MUTED, "none")
        axes.errorbar(
            change, i, xerr=half, fmt="o", color=colour, mfc=face, markersize=4.5, elinewidth=1.4
        )
    axes.set_ylim(-0.7, len(drawn) - 0.3)
    dress(
        axes, x=f"calibrated minus nominal [{name}]", title={"m": "Lengths", "rad": "Angles"}[unit]
    )
    axes.set_yticks(range(len(drawn)), names, fontsize=SMALL, color=INK)
    return figure


def course_figure(
    name: str, stations: Sequence[str], course: Sequence[tuple[int, MovedParameter]]
) -> Figure:
    """Draw a parameter of the robot from station to station, with 95 % intervals.

    Args:
        name: name of the parameter.
        stations: names of all stations, in their order.
        course: index of a station, and the parameter at this station.
    """
    factor, unit = readable_unit(course[0][1]["unit"])
    at = np.array([k for k, _ in course])
    change, half = (factor * np.array([of[key] for _, of in course]) for key in ("change", "sigma"))
    figure, axes = panel(3.0)
    axes.axhline(0.0, color=MUTED, linewidth=0.8)
    axes.errorbar(
        at, change, INTERVAL * half, fmt="none", ecolor=AFTER, elinewidth=1.3, capsize=3.0
    )
    for moved, fill in ((True, AFTER), (False, "none")):
        rows = np.array([of["moved"] is moved for _, of in course])
        axes.plot(at[rows], change[rows], "o", color=AFTER, markerfacecolor=fill, markersize=5.5)
    axes.set_xlim(-0.5, len(stations) - 0.5)
    shown = np.unique(
        np.linspace(0, len(stations) - 1, min(len(stations), _MOST_NAMES)).round().astype(int)
    )
    axes.set_xticks(shown, [drawable(stations[k], _LETTERS) for k in shown])
    dress(axes, y=f"change [{unit}]", title=drawable(name))
    return figure
