"""The tables of a discovery."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from pincal.discover.discovery_file import Disagreement, FoundEffect, Stage
from pincal.discover.report.found_words import effect_words
from pincal.result_table import Cell, Column, Kind, RowTone, Table
from pincal.units import fixed, show_chance, show_percent


def location_table(where: Sequence[Disagreement]) -> Table:
    """Return where model and data disagreed before the search, with shares of the residuals beyond
    the noise.

    If there is elasticity, joints and regions are located in the residuals of the elastic model,
    and shares refer to these.
    """
    columns = (
        Column("where", kind=Kind.NAME),
        Column("share of the residual", kind=Kind.NUMBER, show=show_percent, key="share"),
        Column("observation", kind=Kind.TEXT),
    )
    rows = tuple((place.joint or place.region, place.share, place.statement) for place in where)
    return Table(
        "Where model and data disagreed before effects were added",
        columns,
        rows,
        sources=tuple(f"discovery.json#/where/{k}/{{}}" for k in range(len(rows))),
    )


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
    rows = tuple(_effect_row(entry, units, is_repeated=is_repeated) for entry in effects)
    return Table(title, columns, rows)


def _effect_row(entry: FoundEffect, units: Sequence[str], *, is_repeated: bool) -> tuple[Cell, ...]:
    """Return the cells of an effect, with its errors in each unit."""
    errors = (
        getattr(entry, f"gap_{when}_{unit}") for unit in units for when in ("before", "after")
    )
    return (
        effect_words(entry, joint=False),
        entry.joint or "whole arm",
        entry.p_value,
        *([str(entry.stability or "")] if is_repeated else []),
        *errors,
        "; ".join(effect_words(other) for other in entry.equivalent),
    )


def stage_table(floor: float, stages: Sequence[Stage]) -> Table:
    """Return the errors on held-out rows after each change of the model.

    Args:
        floor: rms of the noise alone [mm].
        stages: the errors [mm, mrad].
    """
    turned = ("mean", "rms") if stages and stages[0].mean_mrad is not None else ()
    columns = (
        Column("model", kind=Kind.NAME),
        *(
            Column(name, unit, Kind.NUMBER, fixed(4), f"{name}_{unit}")
            for unit, names in (("mm", ("mean", "rms", "max")), ("mrad", turned))
            for name in names
        ),
        Column("share of the reduction", kind=Kind.NUMBER, show=show_percent, key="share"),
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
        "Errors on held-out rows after each change",
        columns,
        tuple(rows),
        tones=(*tones, "mute"),
        sources=(*(f"discovery.json#/chain/{k}/{{}}" for k in range(len(stages))), ""),
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
