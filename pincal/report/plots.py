"""Figures of calibrations, drawn on their own canvas: nothing is shown, no state of matplotlib is touched."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pincal.report.shrink import Trace
from pincal.report.units import told

# Okabe and Ito's colours, told apart by colour-blind readers: vermilion, orange, blue, green, sky blue, purple.
COLOURS = ("#D55E00", "#E69F00", "#0072B2", "#009E73", "#56B4E9", "#CC79A7")
# A logarithmic axis has no place for zero: deviations below rounding stand here [m].
_SMALLEST = 1e-17
_PANEL_WIDTH, _HEIGHT = 3.6, 3.2  # [in]
_GREY = "#9A9A9A"
# Bins of a variable, and rows that a bin needs.
_BINS, _FEWEST = 30, 4
# A variable with no more values than this is a category.
_CATEGORIES = 5
_MOST_POINTS = 3000
# Names of models that stand side by side.
_ABREAST = 4


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
    axes.axhline(max(float(deviations.mean()), _SMALLEST), color="black", linewidth=1.0, linestyle="--")
    axes.set_yscale("log")
    axes.set_title(f"{name}\nmean {_length(deviations.mean())}, max {_length(deviations.max())}", fontsize=10)
    axes.set_xlabel("pose")
    axes.grid(visible=True, which="major", color="#DDDDDD", linewidth=0.6)


def _length(metres: float) -> str:
    """Write a length in the unit that suits it."""
    if metres >= 1e-4:
        return f"{metres * 1e3:.2f} mm"
    return f"{metres * 1e6:.2f} µm" if metres >= 1e-8 else f"{metres:.2e} m"


def shrinking_figure(names: Sequence[str], errors: Mapping[str, Sequence[float]], floor: float) -> Figure:
    """Draw how the error on held-out rows shrinks, model by model, down to the noise.

    Args:
        names: K models, in the order in which they were fitted.
        errors: statistic ("mean", "rms", "max") -> K errors [mm].
        floor: rms of the noise alone [mm].

    Raises:
        ValueError: if there is no model, or a statistic does not have one number a model.

    Example:
        >>> figure = shrinking_figure(["start", "+ backlash"], {"rms": [0.2, 0.1]}, 0.09)
        >>> figure.axes[0].get_ylabel()
        'held-out error [mm]'
        >>> shrinking_figure([], {}, 0.1)
        Traceback (most recent call last):
            ...
        ValueError: no models to draw; expected names and as many errors of each statistic
    """
    if not names or any(len(values) != len(names) for values in errors.values()):
        raise ValueError("no models to draw; expected names and as many errors of each statistic")
    height = _HEIGHT if len(names) <= _ABREAST else 1.4 * _HEIGHT
    figure = Figure(figsize=(2.2 * _PANEL_WIDTH, height), layout="constrained", dpi=150)
    axes = figure.subplots()
    for k, (statistic, values) in enumerate(errors.items()):
        axes.plot(values, "o-", color=COLOURS[2 - k], markersize=5, linewidth=1.4, label=statistic)
        # Labels between the lines would cover each other.
        place = {"mean": (0, -12), "max": (0, 6)}.get(statistic)
        for i, value in enumerate(values if place else ()):
            axes.annotate(f"{value:.3f}", (i, value), xytext=place, textcoords="offset points", ha="center", fontsize=7)
    axes.axhline(floor, color="black", linewidth=1.0, linestyle="--", label="noise alone (rms)")
    axes.set_yscale("log")
    low = min(floor, *(min(values) for values in errors.values()))
    high = max(floor, *(max(values) for values in errors.values()))
    axes.set_ylim(0.6 * low, 1.6 * high)
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_minor_formatter(lambda value, _: f"{value:g}" if high < 10.0 * low else "")
    axes.set_xticks(range(len(names)), [name.replace(", ", ",\n") for name in names], fontsize=8)
    if len(names) > _ABREAST:
        axes.tick_params(axis="x", labelsize=7, rotation=30)
        for label in axes.get_xticklabels():
            label.set_horizontalalignment("right")
            label.set_rotation_mode("anchor")
    axes.set_xlim(-0.4, len(names) - 0.6)
    axes.set_ylabel("held-out error [mm]")
    axes.grid(visible=True, axis="y", which="both", color="#E4E4E4", linewidth=0.6)
    axes.legend(fontsize=8, frameon=False)
    return figure


def effect_figure(trace: Trace, title: str) -> Figure:
    """Draw what an effect explains: errors against the variable that it follows, before and after it entered the model.

    Grey is each row's error at the coordinate on which the effect acts, black the mean in a bin of the variable with its
    standard deviation, blue the fitted effect.

    Args:
        trace: what the effect explains.
        title: its name.

    Raises:
        ValueError: if the trace has no rows.
    """
    if len(trace.x) == 0:
        raise ValueError(f"no rows of {title} to draw; expected at least one")
    figure = Figure(figsize=(2.2 * _PANEL_WIDTH, _HEIGHT), layout="constrained", dpi=150)
    panels = figure.subplots(1, 2, sharey=True)
    factor, unit = (1e6, "µrad") if trace.error_unit == "rad" else (1e6, "µm")
    x, label = _axis(trace)
    reached = [trace.fitted.min() * factor, trace.fitted.max() * factor]
    for axes, errors, name in zip(panels, (trace.before, trace.after), ("without it", "with it"), strict=True):
        reached += _draw_errors(axes, x, errors * factor, trace.weights / factor**2)
        spread = float(np.sqrt(np.average(errors**2, weights=trace.weights)))
        axes.set_title(f"{name}: rms {told(spread, trace.error_unit)}", fontsize=9)
        axes.set_xlabel(label)
    _draw_effect(panels[0], x, trace.fitted * factor)
    panels[1].axhline(0.0, color=COLOURS[2], linewidth=1.4)
    margin = 0.08 * (max(reached) - min(reached)) or 1.0
    panels[0].set_ylim(min(reached) - margin, max(reached) + margin)
    of = f"error of {trace.joint}" if trace.error_unit == "rad" or trace.joint else "error along the effect"
    panels[0].set_ylabel(f"{of} [{unit}]")
    panels[0].legend(fontsize=8, frameon=False, loc="best")
    figure.suptitle(title, fontsize=11)
    return figure


def _axis(trace: Trace) -> tuple[np.ndarray, str]:
    """Return the variable in the unit of its axis, and the axis' label."""
    if trace.unit == "rad":
        return np.degrees(trace.x), f"{trace.variable} [deg]"
    if trace.variable == "time":
        return trace.x / 3600.0, "time [h]"
    if trace.variable == "approach":
        return trace.x, f"direction of approach of {trace.joint}"
    name = f"moment on {trace.joint or 'the base'}" if trace.variable == "moment" else trace.variable
    return trace.x, f"{name} [{trace.unit}]"


def _draw_errors(axes: Axes, x: np.ndarray, errors: np.ndarray, weights: np.ndarray) -> list[float]:
    """Draw rows and their means in bins; return what the axis should reach, whatever rows with short levers say."""
    shown = np.unique(np.linspace(0, len(x) - 1, _MOST_POINTS).astype(int))
    jitter = np.zeros(len(x))
    values = np.unique(x)
    if len(values) <= _CATEGORIES:
        jitter = np.random.default_rng(0).uniform(-0.12, 0.12, len(x)) * (np.diff(values).min() if len(values) > 1 else 1.0)
        axes.set_xticks(values)
    # Rows with a short lever say little: they are drawn faintly.
    strength = np.clip(weights / np.quantile(weights, 0.9), 0.05, 1.0)
    axes.scatter((x + jitter)[shown], errors[shown], s=7, c=_GREY, alpha=0.55 * strength[shown], linewidths=0, label="a row")
    centres, means, spreads = _binned(x, errors, weights)
    style = {"color": "black", "markersize": 3.5, "linewidth": 0.9, "elinewidth": 0.9}
    axes.errorbar(centres, means, spreads, fmt="o", label="mean in a bin", zorder=3, **style)  # type: ignore[arg-type]
    axes.axhline(0.0, color="#BBBBBB", linewidth=0.7, zorder=0)
    strong = errors[strength > 0.3] if np.any(strength > 0.3) else errors
    ends = np.concatenate([np.quantile(strong, [0.01, 0.99]), means - spreads, means + spreads])
    return [float(ends.min()), float(ends.max())]


def _binned(x: np.ndarray, errors: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return centres, weighted means and their standard deviations in bins of x; each value of few is a bin."""
    values = np.unique(x)
    if len(values) <= _CATEGORIES:
        edges = np.concatenate([[values[0] - 1.0], (values[1:] + values[:-1]) / 2.0, [values[-1] + 1.0]])
    else:
        edges = np.linspace(x.min(), x.max(), min(_BINS, max(len(x) // 8, 1)) + 1)
    place = np.clip(np.digitize(x, edges) - 1, 0, len(edges) - 2)
    count = np.bincount(place, minlength=len(edges) - 1)
    total = np.bincount(place, weights, len(edges) - 1)
    full = (count >= _FEWEST) & (total > 0.0)
    centres = np.bincount(place, weights * x, len(edges) - 1)[full] / total[full]
    means = np.bincount(place, weights * errors, len(edges) - 1)[full] / total[full]
    return centres, means, 1.0 / np.sqrt(total[full])


def _draw_effect(axes: Axes, x: np.ndarray, fitted: np.ndarray) -> None:
    """Draw the fitted effect: a line where it is a function of x, else points."""
    order = np.argsort(x, kind="stable")
    x, y = x[order], fitted[order]
    size = np.ptp(y) or 1.0
    near = np.diff(x) < 2e-3 * (np.ptp(x) or 1.0)
    is_function = np.quantile(np.abs(np.diff(y))[near], 0.9) < 0.1 * size if near.any() else True
    axes.plot(x, y, "-" if is_function else ".", color=COLOURS[2], linewidth=1.6, markersize=2.5, label="fitted", zorder=4)
