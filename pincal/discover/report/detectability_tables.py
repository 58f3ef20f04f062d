"""What a search would find in tables, as text and tables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from rich.text import Text

from pincal.calibration.precheck import DataReport
from pincal.discover.detectability import DetectabilityTable, Detectable, detectable_effects
from pincal.discover.drive_curves import notes_on_repeats
from pincal.discover.report.found_tables import by_reason
from pincal.identify.fit import ModelFit
from pincal.report.words import noise_words
from pincal.result_table import Column, Kind, Table, hanging
from pincal.robot.robot import Robot
from pincal.thresholds import Count
from pincal.units import (
    Quantity,
    format_digits,
    format_small,
    show_plainly,
    small_unit,
)

# Number of joints side by side in a table of 100 characters.
_JOINTS_ABREAST: Count = 7


@dataclass(frozen=True)
class Outlook:
    """What a search could find in tables: the part of discovery in a precheck.

    Attributes:
        found: the smallest detectable size of each effect beyond the elastic model.
        notes: on what is not observable in the curves of drives.
    """

    found: DetectabilityTable
    notes: tuple[str, ...]

    @classmethod
    def of(cls, robot: Robot, fit: ModelFit) -> Outlook:
        """Return what a search could find in the rows of a fit of base and tool."""
        return cls(
            detectable_effects(fit), tuple(notes_on_repeats(robot, fit.problem.conditions.q))
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain data, without the notes, which are among those of the precheck."""
        return self.found.to_dict()

    def blocks(self, report: DataReport) -> Iterator[object]:
        """Yield what a terminal shows of it."""
        return _blocks(report, self.found)


def _blocks(report: DataReport, found: DetectabilityTable) -> Iterator[object]:
    """Yield the smallest effect of each kind that a discovery would find: how it was judged, a
    table for a few joints each, the effects of the whole arm, and those that are not testable.
    """
    yield _how_judged(report, found)
    yield from _by_joint(report, found)
    whole = [
        (e.effect.name, smallest_size([e])) for e in found.effects if e.effect.locus.joint is None
    ]
    sizes = [
        f"{name} {format_small(size.value, size.unit)}"
        for name, size in whole
        if isinstance(size, Quantity)
    ]
    if sizes:
        yield Text("Whole arm: " + ", ".join(sizes))
    lost = ((e.effect.name, e.effect.locus.joint, e.reason) for e in found.effects)
    yield from not_testable(lost, len(report.joints))


def not_testable(entries: Iterable[tuple[str, str | None, str]], n_joints: int) -> Iterator[object]:
    """Yield why effects, given by name, joint and reason, can't be tested; a line a reason."""
    for reason, names in by_reason(entries, n_joints).items():
        yield hanging("not testable:", f"{names}: {reason}")


def _how_judged(report: DataReport, found: DetectabilityTable) -> str:
    noise = (
        noise_words(report.noise)
        if found.sigma_m is None
        else f"{found.sigma_m * 1e3:.4g} mm per coordinate"
    )
    source = {"assumed": "assumed: not declared, and too few rows to estimate it"}
    return (
        f"\nSmallest effects that pincal discover would find in addition to the {found.model} "
        f"model with a probability of {100 * found.power:.0f} %, at a probability of "
        f"{100 * found.alpha:g} % of any false name and a noise of {noise} "
        f"({source.get(found.source, found.source)}). An effect with several parameters is given "
        "by its amplitude, transmission_error by the rms of its curve, elastic effects by their "
        "largest rotation in these poses, joint_coupling by the range over the joints that may "
        "drive it. -: see below."
    )


def _by_joint(report: DataReport, found: DetectabilityTable) -> Iterator[Table]:
    joints = [joint.joint for joint in report.joints]
    entries = [entry for entry in found.effects if entry.effect.locus.joint is not None]
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
