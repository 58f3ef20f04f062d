"""What a calibration changed: the identified corrections, with their uncertainty."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from pincal.calibration.result import ParameterRow
from pincal.parameters import FRAME_SYMBOLS
from pincal.report.plots.style import AFTER, INK, MUTED, SMALL, canvas, dress, plain
from pincal.units import readable_unit

# Height of a row and width of a letter [in].
_PER_ROW, _LETTER = 0.22, 0.082
# Parameters that are drawn at most, the largest corrections first, and letters of a name that are.
_MOST, _LONGEST = 24, 26
_TITLES = {"m": "Lengths", "rad": "Angles"}


def correction_figure(parameters: Sequence[ParameterRow], unit: str) -> Figure:
    """Draw how far the identified parameters in "m" or "rad" are from the nominal robot, with 95 % intervals.

    Where instrument and target are was never known, so they are left out.

    Raises:
        ValueError: if none is identified.
    """
    known = [p for p in parameters if p.unit == unit and p.status == "identified" and p.sigma]
    drawn = [p for p in known if p.name.rsplit(".", 1)[1] not in FRAME_SYMBOLS]
    if not drawn:
        raise ValueError(f"no identified parameter in {unit} to draw")
    (factor, name), title = readable_unit(unit), _TITLES[unit]
    drawn.sort(key=lambda p: -abs(p.value - p.nominal))
    drawn = drawn[:_MOST]
    names = [plain(p.name, _LONGEST) for p in reversed(drawn)]
    figure = canvas(1.1 + _PER_ROW * len(drawn), left=0.3 + _LETTER * max(map(len, names)))
    axes = figure.subplots()
    axes.axvline(0.0, color=MUTED, linewidth=0.9)
    for i, p in enumerate(reversed(drawn)):
        change, half = (p.value - p.nominal) * factor, 1.96 * (p.sigma or 0.0) * factor
        sure = abs(change) > half
        axes.errorbar(change, i, xerr=half, fmt="o", color=AFTER if sure else MUTED, mfc=AFTER if sure else "none",
                      markersize=4.5, elinewidth=1.4)  # fmt: skip
    axes.set_ylim(-0.7, len(drawn) - 0.3)
    dress(axes, x=f"calibrated minus nominal [{name}]", title=title)
    axes.set_yticks(range(len(drawn)), names, fontsize=SMALL, color=INK)
    return figure
