"""The tables of a discovery, of a precheck and of a design of poses."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from pincal.calibration.result_tables import ParameterRow, parameter_table
from pincal.design.motion_design import MotionDesign
from pincal.design.pose_design import Design
from pincal.discover.precheck import DataReport, Detectable, JointRange
from pincal.io.discovery_file import Disagreement, FoundEffect, Stage
from pincal.report.words import effect_words
from pincal.result_table import Cell, Column, Kind, RowTone, Table
from pincal.thresholds import Count
from pincal.units import Quantity, fixed, format_digits, show_percent, show_plainly, small_unit

# Number of joints side by side in a table of 100 characters.
_JOINTS_ABREAST: Count = 7


def location_table(where: Sequence[Disagreement]) -> Table:
    """Return where model and data disagreed before the search, with shares of the residuals beyond
    the noise.

    If there is elasticity, joints and regions are located in the residuals of the elastic model,
    and shares refer to these.
    """
    columns = (
        Column("where", kind=Kind.NAME),
        Column("share of the residual", kind=Kind.NUMBER, show=show_percent),
        Column("observation", kind=Kind.TEXT),
    )
    rows = tuple((place.joint or place.region, place.share, place.statement) for place in where)
    return Table("Where model and data disagreed before effects were added", columns, rows)


def effect_table(effects: Sequence[FoundEffect], title: str = "Effects found") -> Table:
    """Return effects with their p-values and the mean held-out error before and after.

    If subsamples were searched, the table shows in how many of them each effect is found.
    """
    is_repeated = any(entry.stability for entry in effects)
    units = (
        ("mm", "mrad") if any(entry.gap_before_mrad is not None for entry in effects) else ("mm",)
    )
    columns = (
        Column("effect", kind=Kind.NAME),
        Column("joint", kind=Kind.NAME),
        Column("p", kind=Kind.NUMBER, show=show_chance),
        *([Column("subsamples")] if is_repeated else []),
        *(
            Column(name, unit, Kind.NUMBER, fixed(4))
            for unit in units
            for name in ("mean before", "after")
        ),
        Column("could also be"),
    )
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (
            effect_words(entry, joint=False),
            entry.joint or "whole arm",
            entry.p_value,
            *([str(entry.stability or "")] if is_repeated else []),
            *(
                getattr(entry, f"gap_{when}_{unit}")
                for unit in units
                for when in ("before", "after")
            ),
            "; ".join(effect_words(other) for other in entry.equivalent),
        )
        for entry in effects
    )
    return Table(title, columns, rows)


def show_chance(p_value: float) -> str:
    """Return a p-value as text; one that underflows is given by a bound."""
    return f"{p_value:.0e}" if p_value > 0.0 else "<1e-300"


def stage_table(floor: float, stages: Sequence[Stage]) -> Table:
    """Return the errors on held-out rows after each change of the model.

    Args:
        floor: rms of the noise alone [mm].
        stages: the errors [mm, mrad].
    """
    turned = ("mean", "rms") if stages and stages[0].mean_mrad is not None else ()
    columns = (
        Column("model", kind=Kind.NAME),
        *(Column(name, "mm", Kind.NUMBER, fixed(4)) for name in ("mean", "rms", "max")),
        *(Column(name, "mrad", Kind.NUMBER, fixed(4)) for name in turned),
        Column("share of the reduction", kind=Kind.NUMBER, show=show_percent),
        Column("rms over noise", kind=Kind.NUMBER, show=fixed(2)),
    )
    rows: list[tuple[Cell, ...]] = [
        (
            stage.name,
            *(stage.mean_mm, stage.rms_mm, stage.max_mm),
            *(getattr(stage, f"{name}_mrad") for name in turned),
            stage.share,
            stage.rms_mm / floor if floor > 0.0 else None,
        )
        for stage in stages
    ]
    rows.append(("noise alone", "", floor, "", *("" for _ in turned), None, 1.0))
    tones: list[RowTone] = ["" for _ in stages]
    return Table(
        "Errors on held-out rows after each change", columns, tuple(rows), tones=(*tones, "mute")
    )


def by_reason(entries: Iterable[tuple[str, str | None, str]], n_joints: int) -> dict[str, str]:
    """Return the effects that could not be tested, by reason, with their joints unless these are
    all.

    Args:
        entries: effect, joint and reason; those without a reason are left out.
        n_joints: number of joints of the arm.

    Example:
        >>> idle = [("backlash", "a", "a is idle"), ("backlash", "b", "b is idle")]
        >>> by_reason([*idle, ("drift", None, "no time")], 3)
        {'this joint is idle': 'backlash of a, b', 'no time': 'drift'}
    """
    found: dict[str, dict[str, list[str]]] = {}
    for effect, joint, reason in entries:
        if reason:
            common = re.sub(rf"\b{re.escape(joint)}\b", "this joint", reason) if joint else reason
            joints = found.setdefault(common, {}).setdefault(effect, [])
            joints += [joint] if joint and joint not in joints else []
    return {
        reason: ", ".join(
            f"{name} of {', '.join(j)}" if 0 < len(j) < n_joints else name
            for name, j in effects.items()
        )
        for reason, effects in found.items()
    }


def covered_share(joint: JointRange) -> float | None:
    """Return the fraction of its range that a joint covers; None without limits."""
    if joint.lower_limit is None or joint.upper_limit is None:
        return None
    return (joint.high - joint.low) / (joint.upper_limit - joint.lower_limit)


def coverage_table(report: DataReport) -> Table:
    """Return the covered range of each joint [rad or m]."""
    columns = (
        Column("joint", kind=Kind.NAME),
        Column("from", kind=Kind.NUMBER, show=fixed(3)),
        Column("to", kind=Kind.NUMBER, show=fixed(3)),
        Column("limits", kind=Kind.NUMBER),
        Column("covered", kind=Kind.NUMBER, show=show_percent),
    )
    rows: list[tuple[Cell, ...]] = []
    for joint in report.joints:
        share = covered_share(joint)
        limits = "none" if share is None else f"{joint.lower_limit:.3f} .. {joint.upper_limit:.3f}"
        rows.append((joint.joint, joint.low, joint.high, limits, share))
    return Table("Coverage of the joint ranges", columns, tuple(rows))


def expectation_table(report: DataReport) -> Table:
    """Return the expected uncertainty of each parameter."""
    rows = [
        ParameterRow(p.name, p.unit, 0.0, 0.0, p.sigma, p.status, p.reason, p.effect)
        for p in report.parameters
    ]
    table = parameter_table(rows, "What these poses can identify").without("nominal", "value")
    columns = tuple(
        replace(c, name="expected sigma") if c.name == "sigma" else c for c in table.columns
    )
    return replace(table, columns=columns)


def detectability_tables(report: DataReport) -> Iterator[Table]:
    """Yield the smallest effect of each kind that a discovery would find at each joint, a few
    joints per table.
    """
    joints = [joint.joint for joint in report.joints]
    entries = [entry for entry in report.detectable.effects if entry.effect.locus.joint is not None]
    for i in range(0, len(joints), _JOINTS_ABREAST):
        yield _detectability_table(entries, joints[i : i + _JOINTS_ABREAST])


def _detectability_table(entries: list[Detectable], joints: list[str]) -> Table:
    found: dict[tuple[str, str], dict[str, list[Detectable]]] = {}
    units = {entry.effect.name: entry.unit for entry in entries if entry.unit}
    for entry in entries:
        at = entry.effect.locus
        name = entry.effect.name + (f" order {at.order}" if at.order else "")
        unit = entry.unit or units.get(entry.effect.name, "")
        if unit and at.joint in joints:
            found.setdefault((name, unit), {}).setdefault(at.joint, []).append(entry)
    columns = (
        Column("effect"),
        Column("unit", kind=Kind.LABEL, show=lambda unit: small_unit(unit).name),
        *(Column(joint, kind=Kind.NUMBER, show=_show_size) for joint in joints),
    )
    rows = tuple(
        (name, unit, *(smallest_size(cells[joint]) if joint in cells else "" for joint in joints))
        for (name, unit), cells in found.items()
    )
    return Table("Smallest effects that would be found", columns, rows)


def smallest_size(entries: Sequence[Detectable]) -> Quantity | str | None:
    """Return the detectable size; for several sources the range in the small unit, for several
    frames the larger.
    """
    unit = entries[0].unit
    source = entries[0].effect.heading[2]
    sizes = [entry.size for entry in entries if entry.size is not None]
    if not sizes:
        return None
    if source is None or len(sizes) == 1:
        return Quantity(max(sizes), unit)
    factor = small_unit(unit).factor
    return f"{format_digits(min(sizes) * factor)}-{format_digits(max(sizes) * factor)}"


def _show_size(size: Quantity | str | None) -> str:
    return (
        format_digits(size.value * small_unit(size.unit).factor)
        if isinstance(size, Quantity)
        else show_plainly(size)
    )


def motion_table(found: MotionDesign) -> Table:
    """Return the predicted errors by number of poses with an instrument, alone and together with a
    motion with an IMU.
    """
    columns = [Column("poses", kind=Kind.NUMBER)]
    columns += [
        Column(name, "mm rms", Kind.NUMBER, fixed(4)) for name in ("alone", "with the motion")
    ]
    rows = tuple((poses, 1e3 * alone, 1e3 * both) for poses, (alone, both) in found.needed.items())
    return Table(
        "How many additional poses with an instrument? Predicted error", tuple(columns), rows
    )


def pose_count_table(found: Design) -> Table:
    """Return the predicted errors for several numbers of poses."""
    apart = bool(found.found.designed.apart)
    columns = [Column("poses", kind=Kind.NUMBER)]
    columns += [Column(name, "mm rms", Kind.NUMBER, fixed(4)) for name in ("designed", "random")]
    columns.append(Column("random / designed", kind=Kind.NUMBER, show=fixed(2)))
    names = ("not explained, designed", "not explained, random") if apart else ()
    columns += [Column(name, kind=Kind.NUMBER, show=fixed(1)) for name in names]
    rows = tuple(
        (p.poses, 1e3 * p.designed.error, 1e3 * p.random.error, p.random.error / p.designed.error)
        + (tuple(min(q.apart) for q in (p.designed, p.random)) if apart else ())
        for p in found.curve
    )
    return Table("How many poses? Predicted error", tuple(columns), rows)
