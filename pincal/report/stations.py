"""The section on several stations: how good the model is at each, and at those that it never saw."""

from __future__ import annotations

from msgspec import UNSET

from pincal.calibration.tables import station_table
from pincal.report.blocks import Section, bars, group, paragraph
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
    drawn = []
    largest = max(record["error"]["nominal"][subject.part]["mean_mm"] for record in records) or 1.0
    for record in records:
        error = {model: by_part.get(subject.part, by_part["train"]) for model, by_part in record["error"].items()}
        before, after = error["nominal"]["mean_mm"], record.get("left_out", error["calibrated"])["mean_mm"]
        shares = (min(100.0 * before / largest, 100.0), min(100.0 * after / largest, 100.0))
        drawn.append(bars(f"{record['name']}: mean error", f"{before:.3f}", f"{after:.4f} mm", shares))
    blocks = (paragraph(text), group("glance", *drawn), station_table(records))
    return Section("stations", "Stations", blocks, "Stations")
