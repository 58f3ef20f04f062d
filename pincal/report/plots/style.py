"""One look for all figures: colours that colour-blind readers can distinguish, sizes that stay
readable on a phone.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator

from pincal.result_table import one_line
from pincal.thresholds import Count, Scale

# Okabe and Ito's colours, distinguishable to colour-blind readers: vermilion, orange, blue, green,
# sky blue, purple.
COLOURS = ("#D55E00", "#E69F00", "#0072B2", "#009E73", "#56B4E9", "#CC79A7")
BEFORE = COLOURS[0]
AFTER = COLOURS[2]
THIRD = COLOURS[3]
INK = "#1B1F24"
MUTED = "#5B6571"
GRID = "#D8DDE3"
VARIABLES = {
    INK: "ink",
    MUTED: "muted",
    GRID: "grid",
    BEFORE: "before",
    AFTER: "after",
    THIRD: "third",
}
"""Colour of a figure -> the page's variable for it."""
# As wide as a phone, so that a page shows figures at their own size, side by side where there is
# room [in].
FIGURE_WIDTH: Scale = 5.2
HEIGHT: Scale = 3.5
# Sizes of letters [pt].
TEXT: Scale = 11.5
SMALL: Scale = 10.5
# Room about the axes [in]; fixed, as fitting it takes longer than drawing.
_LEFT: Scale = 0.86
_RIGHT: Scale = 0.16
_BOTTOM: Scale = 0.58
_TOP: Scale = 0.36
# Height of a row of a figure with a name per row, and width of a letter of a name [in].
ROW: Scale = 0.22
LETTER: Scale = 0.082
# Height that a tick of an upright axis needs [in]; ratio of the ends of an axis beyond which its
# ticks are powers of ten.
_PER_TICK: Scale = 0.21
_MOST_DECADES: Scale = 1500.0
# Letters of a name that fit a figure.
_LONGEST: Count = 34
# Last letters of a name that is cut within.
_LAST: Count = 4


def canvas(
    height: float = HEIGHT, *, rows: int = 1, left: float = _LEFT, top: float = _TOP
) -> Figure:
    """Return an empty figure of the usual width with room for ``rows`` panels, one above the other
    [in].
    """
    figure = Figure(figsize=(FIGURE_WIDTH, height), dpi=150)
    figure.subplots_adjust(
        left=left / FIGURE_WIDTH,
        right=1.0 - _RIGHT / FIGURE_WIDTH,
        bottom=_BOTTOM / height,
        top=1.0 - top / height,
        hspace=0.0 if rows == 1 else 0.28,
    )
    return figure


def panel(height: float = HEIGHT, *, left: float = _LEFT, top: float = _TOP) -> tuple[Figure, Axes]:
    """Return a :func:`canvas` with axes over all of it."""
    figure = canvas(height, left=left, top=top)
    return figure, figure.subplots()


def dress(axes: Axes, *, x: str = "", y: str = "", title: str = "") -> None:
    """Give axes their labels and the common look: no box, a faint grid."""
    axes.set_xlabel(x, fontsize=TEXT, color=INK)
    axes.set_ylabel(y, fontsize=TEXT, color=INK)
    if title:
        axes.set_title(title, fontsize=TEXT, color=INK, loc="left", fontweight="bold")
    axes.tick_params(labelsize=SMALL, color=MUTED, labelcolor=INK, which="both")
    axes.grid(visible=True, which="major", color=GRID, linewidth=0.7)
    axes.set_axisbelow(True)
    for name, spine in axes.spines.items():
        spine.set_color(MUTED)
        spine.set_visible(name in ("left", "bottom"))
    axes.patch.set_alpha(0.0)


def thinned(count: int, most: int = 700) -> np.ndarray:
    """Return at most so many rows of all, evenly spread: more dots only cover each other and make
    the file large.
    """
    return np.unique(np.linspace(0, count - 1, most).astype(int))


def legend(axes: Axes, **where: Any) -> None:
    """Draw the legend without a box."""
    axes.legend(fontsize=SMALL, frameon=False, labelcolor=INK, **where)


def drawable(text: str, longest: int = _LONGEST) -> str:
    r"""Return a name from a file as text to draw: one line, no mathematics, not too long.

    Example:
        >>> print(drawable("a$b$\nc"), len(drawable("long " * 30)))
        a\$b\$ c 34
    """
    clean = one_line(text)
    short = clean if len(clean) <= longest else clean[: longest - 1] + "…"
    return short.replace("$", r"\$")


def drawable_parameter(name: str, longest: int = _LONGEST) -> str:
    """Return the name of a parameter as text to draw. Of a long one the element is cut within, as
    those of one joint differ by their symbol, and joints by their first or last letters.

    Example:
        >>> drawable_parameter("right_shoulder_pan_joint.theta", 26)
        'right_shoulder_pan.theta'
        >>> drawable_parameter("shoulder_lift_joint.friction_windup", 26)
        'shoul…lift.friction_windup'
    """
    element, dot, symbol = one_line(name).rpartition(".")
    room = longest - len(symbol) - len(dot)
    if len(name) <= longest or not dot or room < 1:
        return drawable(name, longest)
    element = element.removesuffix("_joint")
    if len(element) > room > _LAST + 1:
        element = f"{element[: room - _LAST - 1]}…{element[-_LAST:]}"
    return f"{drawable(element, room)}.{drawable(symbol)}"


def log_axis(axes: Axes, which: Literal["x", "y"], low: float, high: float) -> None:
    """Make an axis logarithmic from ``low`` to ``high`` with ticks at 1, 2, 5, or at powers of ten
    where that is too many, written as plain numbers.
    """
    decades = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    tall = axes.bbox.height / axes.figure.dpi
    room = tall / _PER_TICK if which == "y" else np.inf
    for steps in ((1.0, 2.0, 5.0), (1.0,)):
        ticks = np.array([step * decade for decade in decades for step in steps])
        ticks = ticks[(ticks >= low * 0.999) & (ticks <= high * 1.001)]
        if len(ticks) <= room and high < _MOST_DECADES * low:
            break
    axes.set(**{f"{which}scale": "log", f"{which}lim": (low, high)})
    axis: Axis = axes.xaxis if which == "x" else axes.yaxis
    axis.set_major_locator(FixedLocator(ticks.tolist()))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(lambda value, _: f"{value:g}")


def span_of(*sizes: np.ndarray) -> tuple[float, float]:
    """Return the ends of a logarithmic axis that shows nearly all of these errors; what is smaller
    is not missed.
    """
    both = np.concatenate(sizes)
    both = both[np.isfinite(both) & (both > 0.0)]
    if not len(both):
        return 1e-3, 1.0
    low = float(np.quantile(both, 0.01))
    high = float(both.max())
    return max(low, high * 1e-5) / 1.2, high * 1.15
