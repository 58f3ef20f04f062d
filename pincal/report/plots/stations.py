"""What changes from station to station."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from pincal.calibration.tables import INTERVAL
from pincal.io.result_file import MovedParameter
from pincal.report.plots.style import AFTER, MUTED, dress, panel, plain
from pincal.units import readable_unit

# Names of stations that fit under an axis, and their letters.
_MOST_NAMES, _LETTERS = 8, 12


def course_figure(name: str, stations: Sequence[str], course: Sequence[tuple[int, MovedParameter]]) -> Figure:
    """Draw a parameter of the robot from station to station, with intervals of 95 %.

    Args:
        name: of the parameter.
        stations: names of all stations, in their order.
        course: station, by its place, and what the parameter is there.
    """
    factor, unit = readable_unit(course[0][1]["unit"])
    at = np.array([k for k, _ in course])
    change, half = (factor * np.array([of[key] for _, of in course]) for key in ("change", "sigma"))
    figure, axes = panel(3.0)
    axes.axhline(0.0, color=MUTED, linewidth=0.8)
    axes.errorbar(at, change, INTERVAL * half, fmt="none", ecolor=AFTER, elinewidth=1.3, capsize=3.0)
    for moved, fill in ((True, AFTER), (False, "none")):
        rows = np.array([of["moved"] is moved for _, of in course])
        axes.plot(at[rows], change[rows], "o", color=AFTER, markerfacecolor=fill, markersize=5.5)
    axes.set_xlim(-0.5, len(stations) - 0.5)
    shown = np.unique(np.linspace(0, len(stations) - 1, min(len(stations), _MOST_NAMES)).round().astype(int))
    axes.set_xticks(shown, [plain(stations[k], _LETTERS) for k in shown])
    dress(axes, y=f"change [{unit}]", title=plain(name))
    return figure
