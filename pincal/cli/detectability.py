"""How large effects have to be to be found, as a table of effects by joints that fits 100 columns."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from rich.console import Console
from rich.table import Table

from pincal.cli.screen import new_table
from pincal.discover.precheck import Detectability, DetectabilityTable
from pincal.units import format_digits, small_unit

_JOINTS_ABREAST = 7


def print_detectability(outlook: DetectabilityTable, joints: list[str], out: Console) -> None:
    """Print how large each effect has to be to be found, and which can't be."""
    source = {"assumed": "assumed, as it is neither declared nor to be estimated from so few rows"}
    noise = f"noise of {outlook.sigma_m * 1e3:.4g} mm per coordinate ({source.get(outlook.source, outlook.source)})"
    chances = f"{100 * outlook.power:.0f} times of 100 with a chance of {100 * outlook.alpha:g} % of any false name"
    out.print(
        f"\nSmallest effects that a discovery would find beside the {outlook.model} model, {chances}, at {noise}. "
        "Of an effect of several parameters: its amplitude, of a "
        "transmission error the rms of its curve, of elastic ones the largest rotation in these poses, of joint_coupling "
        "the range over the joints that may drive it. -: see below."
    )
    some = [sight for sight in outlook.effects if sight.joint is not None]
    for part in _batched(joints, _JOINTS_ABREAST):
        out.print(_table(some, part))
    whole = [s for s in outlook.effects if s.joint is None and s.size is not None]
    if whole:
        out.print("Whole arm: " + ", ".join(f"{s.effect} {_size([s])} {small_unit(s.unit)[1]}" for s in whole), markup=False)
    for reason, names in _reasons(outlook.effects, len(joints)).items():
        out.print(f"can't be tested: {', '.join(names)}: {reason}", markup=False)


def _batched(joints: list[str], size: int) -> Iterator[list[str]]:
    yield from (joints[i : i + size] for i in range(0, len(joints), size))


def _table(sights: list[Detectability], joints: list[str]) -> Table:
    table = new_table("Smallest effects that would be found")
    table.add_column("effect")
    table.add_column("unit", no_wrap=True)
    for joint in joints:
        table.add_column(joint.replace("_", "_\n"), justify="right", overflow="fold")
    rows: dict[tuple[str, str], dict[str, list[Detectability]]] = {}
    units = {sight.effect: sight.unit for sight in sights if sight.unit}
    for sight in sights:
        name = sight.effect + (f" order {sight.order}" if sight.order else "")
        unit = sight.unit or units.get(sight.effect, "")
        if unit and sight.joint in joints:
            rows.setdefault((name, unit), {}).setdefault(sight.joint, []).append(sight)
    for (name, unit), cells in rows.items():
        table.add_row(name, small_unit(unit)[1], *(_size(cells[joint]) if joint in cells else "" for joint in joints))
    return table


def _size(sights: list[Detectability]) -> str:
    """Return the size in its small unit; of several sources the range, of several frames the larger."""
    factor = small_unit(sights[0].unit)[0]
    sizes = np.array([s.size for s in sights if s.size is not None]) * factor
    if not len(sizes):
        return "-"
    if sights[0].source is None or len(sizes) == 1:
        return format_digits(float(sizes.max()))
    return f"{format_digits(float(sizes.min()))}-{format_digits(float(sizes.max()))}"


def _reasons(sights: tuple[Detectability, ...], n_joints: int) -> dict[str, list[str]]:
    """Return reason -> effects that it keeps from being tested; the joints where they are not all."""
    found: dict[str, dict[str, list[str]]] = {}
    for sight in sights:
        if sight.reason:
            reason = sight.reason.replace(sight.joint, "this joint") if sight.joint else sight.reason
            joints = found.setdefault(reason, {}).setdefault(sight.effect, [])
            if sight.joint and sight.joint not in joints:
                joints.append(sight.joint)
    return {
        reason: [f"{name} of {', '.join(j)}" if 0 < len(j) < n_joints else name for name, j in effects.items()]
        for reason, effects in found.items()
    }
