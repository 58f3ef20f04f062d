"""The section on several stations: how good the model is at each, and at those that it never saw."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from msgspec import UNSET

from pincal.calibration.tables import moved_table, repeated_table, station_table
from pincal.io.result_file import StationRecord
from pincal.report.blocks import Block, Section, bars, group, heading, paragraph
from pincal.report.illustrations import course_drawings, figures
from pincal.report.sections import REPEATED
from pincal.report.subject import Subject


def stations(subject: Subject) -> Section | None:
    """Errors station by station, before and after; None where there is only one."""
    records = subject.result.stations
    if records is UNSET:
        return None
    text = (
        "Each station, a set-up of instrument and targets, has base frame, targets and noise of its own; the robot is the "
        "same at all of them."
    )
    if any("left_out" in record for record in records):
        text += (
            " Left out: the model of the other stations, with only the placement of this one fitted to it. That is what to "
            "expect on a day that the calibration never saw."
        )
    pairs = [_before_and_after(record, subject.part) for record in records]
    largest = max(max(pair) for pair in pairs) or 1.0
    drawn = (
        bars(
            f"{record['name']}: mean error",
            f"{before:.3f}",
            f"{after:.4f} mm",
            (100.0 * before / largest, 100.0 * after / largest),
        )
        for record, (before, after) in zip(records, pairs, strict=True)
    )
    blocks: list[Block] = [paragraph(text), group("glance", *drawn), station_table(records), *_moved(records)]
    if (again := repeated_table(records)) is not None:
        blocks += [heading("Repeated measurements of poses", "repeatability"), paragraph(REPEATED), again]
    return Section("stations", "Stations", tuple(blocks), "Stations")


def _moved(records: Sequence[StationRecord]) -> Iterator[Block]:
    """Yield which parameters of the robot are not the same at all stations."""
    yield heading("What moved from station to station", "moved")
    table = moved_table(records)
    if table is None:
        yield paragraph(
            "No parameter of the robot is other at one station than at the others, as far as these rows tell; if the robot "
            "is the same at all of them, one is said to have moved with a chance of 1 %."
        )
        return
    yield paragraph(
        "One model describes the robot at all stations, but these parameters have another value at some of them. Where "
        "several could have moved, the one that explains most is named; pincal diagnose says, of the rows of a later "
        "station, what else it could be.",
        "care",
    )
    yield table
    yield figures("moved", course_drawings(records))


def _before_and_after(record: StationRecord, part: str) -> tuple[float, float]:
    """Return the mean error of the nominal robot and of the model [mm], of the model of the others if it is known."""
    nominal, calibrated = (by_part.get(part, by_part["train"]) for by_part in record["error"].values())
    return nominal["mean_mm"], record.get("left_out", calibrated)["mean_mm"]
