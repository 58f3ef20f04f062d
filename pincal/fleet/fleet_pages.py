"""The pages of a fleet: a type of robot with its machines, and the robots to look at first."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from pincal.errors import counted
from pincal.fleet import summary
from pincal.fleet.fleet_numbers import TYPES
from pincal.fleet.history import FleetHistory
from pincal.fleet.robot_type import Learned, RobotType
from pincal.report.blocks import PageBlock, Section, bullets, code, folded, heading, paragraph, rich
from pincal.report.html import render
from pincal.report.illustrations import Drawing, figures
from pincal.report.plots.style import (
    AFTER,
    BEFORE,
    INK,
    MUTED,
    SMALL,
    THIRD,
    drawable,
    dress,
    legend,
    log_axis,
    panel,
)
from pincal.thresholds import Count, Scale
from pincal.units import readable_unit

# Most parameters and robots drawn, height of a row and width of a letter [in].
_MOST: Count = 14
_PER_ROW: Scale = 0.27
_LETTER: Scale = 0.085
# Most machines drawn as points, and evidence at which the axis ends [log10].
_POINTS: Count = 300
_SURE: Scale = 10.0
# Odds at the ticks, by their power of ten.
_ODDS: dict[float, str] = {0.0: "even", 3.0: "1000 to 1", 6.0: "million to 1", 9.0: "billion to 1"}


def type_page(learned: Learned, at: summary.AtTool | None, *, version: str) -> str:
    """Return the page of a type: its population, machines that do not belong, and the number of
    poses one needs.
    """
    of = learned.type
    lines = list(summary.type_lines(learned, at))
    made = [
        Section("answer", "What the machines have in common", (bullets(lines[1:]),), style="panel")
    ]
    every = folded("Every parameter", summary.parameter_summary(of, at))
    tables = (*((summary.effect_summary(at),) if at else ()), every)
    made.append(
        Section(
            "parameters",
            "The population by parameter",
            (figures("type", _populations(learned, at)), *tables),
            "Parameters",
        )
    )
    who = summary.member_summary(learned)
    nobody = paragraph(
        "None: no machine differs from the others by more than chance, given their number."
    )
    made.append(
        Section("members", "Machines unlike the others", (who if len(who) else nobody,), "Machines")
    )
    if at is not None:
        poses = (figures("poses", [_poses(at)]), summary.poses_summary(at))
        made.append(Section("poses", "How many poses a further machine needs", poses, "Poses"))
    made.append(Section("use", "How to use the type", (_use(),), "Use"))
    return render(f"Type of {of.robot}", lines[0].partition(": ")[2], made, version=version)


def _use() -> Markup:
    return bullets(
        (
            rich(
                "Calibrate another machine from a few poses: {}",
                code("pincal calibrate ROBOT.urdf FEW.csv --type TYPE.json"),
            ),
            rich(
                "Choose its poses: {}",
                code("pincal design ROBOT.urdf --type TYPE.json --accuracy 0.1mm --out poses.csv"),
            ),
            rich(
                "Monitor all machines: {}",
                code("pincal fleet check TYPE.json STORE --report fleet.html"),
            ),
        )
    )


def _populations(learned: Learned, at: summary.AtTool | None) -> Iterator[Drawing]:
    for unit, name in (("m", "Lengths"), ("rad", "Angles")):
        drawn = _order(learned, at, unit)
        if len(drawn):
            caption = (
                f"{name} of the machines (dots) minus the data sheet; the bar holds 95 % "
                "of the machines of the type, the "
                "blue dot is their mean with its 95 % interval. Where this interval "
                "excludes zero, the data sheet is off."
            )
            yield population_figure(learned, drawn, unit), name, caption


def _order(learned: Learned, at: summary.AtTool | None, unit: str) -> np.ndarray:
    """Return the indices of the parameters of a unit that matter most, the most important last."""
    of = learned.type
    share = np.diag(of.seen)
    size = (
        np.sqrt(np.diag(of.covariance)) / of.priors
        if at is None
        else np.nan_to_num(at.by_parameter)
    )
    places = [k for k, p in enumerate(of.parameters) if p.unit == unit and share[k] > TYPES.drawn]
    return np.array(sorted(places, key=lambda k: -size[k])[:_MOST][::-1], int)


def population_figure(learned: Learned, places: np.ndarray, unit: str) -> Figure:
    """Draw a population: by parameter the machines, the range of further ones, and the mean with
    its interval.

    Args:
        learned: a type and its machines.
        places: indices of the parameters, all of one unit.
        unit: "m" or "rad".
    """
    of = learned.type
    factor, word = readable_unit(unit)
    names = [drawable(of.names[k], 26) for k in places]
    figure, axes = panel(1.1 + _PER_ROW * len(places), left=0.3 + _LETTER * max(map(len, names)))
    centre, *spreads = of.determined
    sigmas, sizes = (np.sqrt(np.diag(C)) for C in spreads)
    axes.axvline(0.0, color=MUTED, linewidth=0.9)
    is_off = np.array([bool(member.off) for member in learned.members])
    shown = _drawn_members(is_off)
    jitter = np.random.default_rng(0).uniform(-0.22, 0.22, len(is_off))
    for i, k in enumerate(places):
        mean, spread, sigma = (factor * float(x[k]) for x in (centre, sizes, sigmas))
        left = mean - 1.96 * spread
        axes.barh(i, 3.92 * spread, left=left, height=0.62, color=AFTER, alpha=0.16, linewidth=0.0)
        values = factor * learned.values[shown, k]
        for mask, colour in ((~is_off[shown], MUTED), (is_off[shown], BEFORE)):
            axes.plot(values[mask], i + jitter[shown][mask], ".", color=colour, markersize=4.0)
        axes.errorbar(
            mean, i, xerr=1.96 * sigma, fmt="o", color=AFTER, markersize=5.0, elinewidth=1.6
        )
    axes.set_ylim(-0.7, len(places) - 0.3)
    dress(axes, x=f"minus the data sheet [{word}]", title={"m": "Lengths", "rad": "Angles"}[unit])
    axes.set_yticks(range(len(places)), names, fontsize=SMALL, color=INK)
    return figure


def _drawn_members(is_off: np.ndarray) -> np.ndarray:
    """Return the indices of the machines that are drawn: all that do not belong, and some others,
    evenly chosen.
    """
    some = np.linspace(0, len(is_off) - 1, _POINTS).astype(int)
    return np.unique(np.concatenate([some, np.flatnonzero(is_off)]))


def _poses(at: summary.AtTool) -> Drawing:
    """Draw the predicted error of a further machine by the number of its poses."""
    figure, axes = panel()
    poses = np.array(list(at.needed))
    for k, (name, colour, mark) in enumerate(
        (("with the type", AFTER, "o-"), ("without", BEFORE, "s--"))
    ):
        axes.plot(
            poses,
            [1e3 * both[k] for both in at.needed.values()],
            mark,
            color=colour,
            markersize=4.5,
            label=name,
        )
    errors = 1e3 * np.array(list(at.needed.values()))
    log_axis(axes, "x", float(poses[0]) / 1.1, float(poses[-1]) * 1.1)
    log_axis(axes, "y", errors.min() / 1.3, errors.max() * 1.3)
    dress(axes, x="poses", y="error [mm rms]", title="Error of a further machine")
    legend(axes)
    caption = (
        "Predicted error over random poses after a further machine was measured in this "
        "many (medians of several sets); "
        "designed poses do better."
    )
    return figure, "Error of a further machine by number of poses", caption


def fleet_page(of: RobotType, found: FleetHistory, *, alpha: float, version: str) -> str:
    """Return the page of a fleet: robots to look at first, drifts of groups, and all changes.

    Args:
        of: the type.
        found: the changes found.
        alpha: fraction of the alarms that may be false.
        version: version of pincal.
    """
    counts = {"to inspect": len(found.open), "drifted": len(found.drifted)}
    words = ", ".join(f"{count} {word}" for word, count in counts.items() if count)
    answer = rich(
        '<p class="headline"><span class="tag {}">{}</span> {}</p>',
        "bad" if words else "good",
        words or "nothing to inspect",
        summary.history_line(found),
    )
    drifts = summary.group_lines(found)
    blocks = [answer, *(paragraph(f"{group}: {words}", "care") for group, words in drifts)]
    listed = summary.look_first(found)
    first: tuple[PageBlock, ...] = (
        *blocks,
        listed if len(listed) else paragraph("No robot calls for an inspection."),
        heading("How to read this"),
        _reading(alpha),
    )
    made = [Section("first", "Inspect these first", first, style="panel")]
    made.append(
        Section("evidence", "Evidence", (figures("fleet", [_evidence(found, alpha)]),), "Evidence")
    )
    for is_group, title in ((True, "Drifts of groups"), (False, "Changes of robots")):
        table = summary.change_summary(found, groups=is_group)
        made.append(
            Section(
                f"changes-{is_group}", title, (table if len(table) else paragraph("None."),), title
            )
        )
    subtitle = f"{counted(found.robots, 'robot')}, {counted(found.checks, 'check')}"
    return render(f"Fleet of {of.robot}", subtitle, made, version=version)


def _reading(alpha: float) -> Markup:
    return bullets(
        (
            f"In the long run at most {100 * alpha:g} % of all alarms are false, however many "
            "robots there are and however long "
            "they are monitored.",
            rich(
                "A robot that changed stays on the list until it is calibrated again; see {}.",
                code("pincal diagnose"),
            ),
            "A change that robots of one supplier, batch or hall share is reported as a drift "
            "of that group, not as an alarm.",
            "watch: no alarm yet, but unusual among the checks of its round; check it again soon.",
        )
    )


def _evidence(found: FleetHistory, alpha: float) -> Drawing:
    """Draw the evidence against each robot, the strongest at the top."""
    ranked = sorted(found.last, key=lambda one: -one.log_e)[:_MOST][::-1]
    names = [drawable(one.machine, 26) for one in ranked]
    figure, axes = panel(
        1.1 + _PER_ROW * max(len(ranked), 1), left=0.3 + _LETTER * max(map(len, names), default=1)
    )
    for i, one in enumerate(ranked):
        colour = BEFORE if one.machine in found.open else THIRD
        size = min(one.log_e / np.log(10.0), _SURE)
        axes.plot([0.0, size], [i, i], "-", color=colour, linewidth=2.2)
        axes.plot(size, i, "o", color=colour, markersize=5.0)
    axes.axvline(0.0, color=MUTED, linewidth=0.9)
    axes.axvline(np.log10(max(found.robots, 1) / alpha), color=MUTED, linewidth=0.9, linestyle="--")
    axes.set_ylim(-0.7, max(len(ranked), 1) - 0.3)
    dress(axes, x="odds of a change", title="Evidence by robot")
    axes.set_xlim(right=_SURE + 1.0)
    axes.set_xticks(list(_ODDS), list(_ODDS.values()))
    axes.set_yticks(range(len(ranked)), names, fontsize=SMALL, color=INK)
    caption = (
        "How much more probable the readings since calibration are if the robot has changed "
        "(e-value), up to 10 billion to 1. The dashed line is "
        "the evidence that a single alarm needs among this many robots; of several "
        "alarms, each needs less."
    )
    return figure, "Evidence by robot", caption
