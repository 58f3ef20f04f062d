"""The page of a measured part, and its summary for the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

from pincal.errors import counted, few
from pincal.features.budget import distribution_of
from pincal.features.measured_file import FeatureEntry, MeasuredFile, ValueEntry
from pincal.features.part_feature import DERIVED_KINDS, QUANTITIES
from pincal.report.blocks import (
    PageBlock,
    Section,
    arranged,
    bullets,
    code,
    doubts,
    facts,
    heading,
    paragraph,
    plain_notes,
    rich,
)
from pincal.report.html import render
from pincal.result_table import Cell, Column, Kind, RowTone, Table
from pincal.thresholds import Count
from pincal.units import fixed, show_limits, show_percent, show_size

# Names that a sentence lists.
_NAMED: Count = 4
# Rows of a table on the terminal.
_ROWS: Count = 20
_EXPANDED = (
    "U: expanded uncertainty, k times the standard uncertainty u; measured.json has both, "
    "and the degrees of freedom from which k follows."
)
# Decimal places by unit.
_PLACES = {"mm": 4, "mrad": 3, "deg": 4, "": 6}
_TONES: dict[str, RowTone] = {"conforms": "good", "does not conform": "bad", "undecided": "care"}
_SOURCES = {
    "parameters": "parameters of the calibration",
    "model": "what the calibrated model lacks",
    "arrival": "repeatability of the arm, from stop to stop",
    "conditions": "temperature or time that the rows lack",
    "sensor": "noise of the sensor",
    "mount": "declared mount of the sensor",
    "probe": "radius of the probe's ball",
    "scale": "scale of the instrument of the calibration",
    "drift": "drift since the calibration",
    "expansion": "temperature and expansion of the part",
    "form": "deviations of the surface from its form",
}
_FAILED = "does not conform"
_URGENCY = (_FAILED, "undecided", "conforms", "")


def verdict_words(found: MeasuredFile) -> str:
    """Return the result in a sentence."""
    wrong = [f"{of.name} {name}" for of, name, v in found.decided() if v.decision == _FAILED]
    open_ones = found.count("undecided")
    decided = sum(1 for _ in found.decided())
    if not decided:
        return f"{counted(len(found.features), 'feature')} measured; no tolerances were given."
    if wrong:
        more = f"; {open_ones} undecided" if open_ones else ""
        return (
            f"The part does not conform: {len(wrong)} of {counted(decided, 'value')} "
            f"({few(wrong, _NAMED)}){more}."
        )
    if open_ones:
        near = "too near to a limit for"
        lie = f"lies {near} its" if open_ones == 1 else f"lie {near} their"
        rest = "; the others conform" if open_ones < decided else ""
        return f"Undecided: {open_ones} of {counted(decided, 'value')} {lie} uncertainty{rest}."
    return f"The part conforms: all of {counted(decided, 'value')}."


_FILE = "measured.json#"
_COLUMNS = (
    Column("feature", kind=Kind.NAME),
    Column("quantity", kind=Kind.LABEL),
    Column("nominal", kind=Kind.NUMBER, key="nominal"),
    Column("value", kind=Kind.NUMBER, key="value"),
    Column("deviation", kind=Kind.NUMBER, key="deviation"),
    Column("U", kind=Kind.NUMBER, key="U"),
    Column("unit", kind=Kind.LABEL),
    Column("limits", kind=Kind.LABEL),
    Column("decision", kind=Kind.STATUS),
)
# What a terminal has room for.
_SHORT = ("feature", "quantity", "value", "deviation", "U", "unit", "limits", "decision")


def value_table(found: MeasuredFile) -> Table:
    """Return the quantities of all features; directions are in the file alone."""
    chosen = [
        (feature, name, value)
        for feature in found.features
        for name, value in feature.values.items()
        if name in QUANTITIES[feature.kind]
    ]
    places = {id(feature): i for i, feature in enumerate(found.features)}
    sources = tuple(
        f"{_FILE}/features/{places[id(feature)]}/values/{name}/{{}}" for feature, name, _ in chosen
    )
    table = _values(chosen, _COLUMNS, (_EXPANDED, f"Decision rule: {found.rule}."))
    return replace(table, sources=sources)


def short_table(found: MeasuredFile) -> Table:
    """Return the quantities that a terminal has room for: those with a tolerance, or what is told
    of each kind if there is none; of many, those that do not conform and undecided ones first.
    """
    chosen = [
        (feature, name, value)
        for feature in found.features
        for name, value in feature.values.items()
        if _is_told(found, feature, name, value)
    ]
    notes = [found.rule]
    if len(chosen) > _ROWS:
        notes.append(f"and {len(chosen) - _ROWS} more in report.html")
        chosen = sorted(chosen, key=lambda one: _URGENCY.index(one[2].decision or ""))[:_ROWS]
    columns = tuple(column for column in _COLUMNS if column.name in _SHORT)
    return _values(chosen, columns, notes)


def _values(
    chosen: Sequence[tuple[FeatureEntry, str, ValueEntry]],
    columns: tuple[Column, ...],
    notes: Sequence[str],
) -> Table:
    rows = []
    for feature, name, value in chosen:
        cells = _cells(feature, name, value)
        rows.append(tuple(cells[column.name] for column in columns))
    tones = tuple(_TONES.get(value.decision or "", "") for _, _, value in chosen)
    return Table("Features", columns, tuple(rows), tuple(notes), tones)


def _is_told(found: MeasuredFile, feature: FeatureEntry, name: str, value: ValueEntry) -> bool:
    """Return whether a quantity stands on the terminal."""
    if any(True for _ in found.decided()):
        return value.decision is not None
    return name in QUANTITIES[feature.kind]


def _cells(feature: FeatureEntry, name: str, value: ValueEntry) -> dict[str, Cell]:
    """Return the cells of a quantity by their columns."""
    places = _PLACES.get(value.unit, 6)
    show = fixed(places)
    limits = "" if value.limits is None else limit_words(*value.limits, places)
    return {
        "feature": feature.name,
        "quantity": name,
        "nominal": show(value.nominal),
        "value": show(value.value),
        "deviation": show(value.deviation),
        "U": "by datum" if value.is_held else show_size(places)(value.U),
        "unit": value.unit,
        "limits": limits,
        "decision": value.decision or "",
    }


def limit_words(lower: float | None, upper: float | None, places: int) -> str:
    """Return the limits of a value with as many decimal places as the value has at most, as limits
    that were computed have many.

    Example:
        >>> limit_words(141.3213562373095, 141.5213562373095, 4), limit_words(None, 0.25, 4)
        ('141.3214 to 141.5214', 'at most 0.25')
        >>> limit_words(-0.00002, 0.1 + 0.2, 4)
        '-2e-05 to 0.3'
    """

    def shown(limit: float) -> str:
        rounded = round(limit, places)
        return f"{rounded:.10g}" if rounded or not limit else f"{limit:.2g}"

    least = -math.inf if lower is None else lower
    largest = math.inf if upper is None else upper
    return show_limits(least, largest, shown)


def budget_table(found: MeasuredFile) -> Table:
    """Return the sources of uncertainty."""
    columns = (
        Column("source"),
        Column("type", kind=Kind.LABEL),
        Column("distribution", kind=Kind.LABEL),
        Column("u", "mm", Kind.NUMBER, fixed(4), key="u"),
        Column("degrees of freedom", kind=Kind.NUMBER, show=_degrees, key="dof"),
        Column("share", kind=Kind.NUMBER, show=show_percent, key="share"),
    )
    rows = tuple(
        (
            _SOURCES.get(of.source, of.source),
            of.type,
            of.distribution or distribution_of(of.dof),
            of.u,
            of.dof,
            of.share,
        )
        for of in found.budget
    )
    notes = (
        "Root mean square over all lengths of all features; measured.json has the sources of each "
        "quantity. Type A: by statistics of observations; B: by other means (JCGM 100).",
    )
    sources = tuple(f"{_FILE}/budget/{k}/{{}}" for k in range(len(rows)))
    return Table("Where the uncertainty comes from", columns, rows, notes, sources=sources)


def _degrees(dof: float | None) -> str:
    return "infinite" if dof is None else f"{dof:.0f}"


_REPEAT_COLUMNS = (
    Column("feature", kind=Kind.NAME),
    Column("quantity", kind=Kind.LABEL),
    Column("passes", kind=Kind.NUMBER, key="passes"),
    Column("s of a pass", kind=Kind.NUMBER, show=fixed(4), key="s"),
    Column("95 % interval", kind=Kind.LABEL, key="s_interval/0 s_interval/1"),
    Column("unit", kind=Kind.LABEL),
    Column("Cg", kind=Kind.NUMBER, show=fixed(2), key="cg"),
    Column("Cgk", kind=Kind.NUMBER, show=fixed(2), key="cgk"),
)


def repeat_table(found: MeasuredFile) -> Table | None:
    """Return how well the quantities were repeated; None for a single pass."""
    chosen = [
        (f"{_FILE}/features/{i}/repeatability/{k}/{{}}", feature, of)
        for i, feature in enumerate(found.features)
        for k, of in enumerate(feature.repeatability)
        if of.quantity in QUANTITIES[feature.kind]
    ]
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (
            feature.name,
            of.quantity,
            of.passes,
            of.s,
            f"{of.s_interval[0]:.4f} to {of.s_interval[1]:.4f}",
            of.unit,
            of.cg,
            of.cgk,
        )
        for _, feature, of in chosen
    )
    notes = (
        "Cg and Cgk of type 1 need two limits and ten passes; Cgk takes the nominal for the true "
        "value, as of a calibrated artefact.",
    )
    sources = tuple(source for source, _, _ in chosen)
    return Table("Repeatability", _REPEAT_COLUMNS, rows, notes, sources=sources) if rows else None


_GAUGE_COLUMNS = (
    Column("of", kind=Kind.NAME, key="parts"),
    Column("quantity", kind=Kind.LABEL),
    *(
        Column(name, kind=Kind.NUMBER, show=fixed(4), key=name.lower())
        for name in ("EV", "AV", "GRR")
    ),
    Column("95 % interval", kind=Kind.LABEL, key="grr_interval/0 grr_interval/1"),
    Column("PV", kind=Kind.NUMBER, show=fixed(4), key="pv"),
    Column("unit", kind=Kind.LABEL),
    Column("%GRR", kind=Kind.NUMBER, show=show_percent, key="share"),
    Column("ndc", kind=Kind.NUMBER, key="ndc"),
    Column("P/T", kind=Kind.NUMBER, show=show_percent, key="of_tolerance"),
)


def gauge_table(found: MeasuredFile) -> Table | None:
    """Return repeatability and reproducibility; None where one appraiser measured, or nobody
    twice.
    """
    if not found.gauge:
        return None
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (
            counted(of.parts, of.kind),
            of.quantity,
            of.ev,
            of.av,
            of.grr,
            f"{of.grr_interval[0]:.4f} to {of.grr_interval[1]:.4f}",
            of.pv,
            of.unit,
            of.share,
            of.ndc,
            of.of_tolerance,
        )
        for of in found.gauge
    )
    first = found.gauge[0]
    notes = (
        f"{first.appraisers} appraisers, {first.repeats} passes each. Standard deviations by "
        "analysis of variance (AIAG MSA): EV repeatability, AV reproducibility between appraisers, "
        "PV between features; %GRR: of the total, P/T: six GRR of the tolerance.",
    )
    sources = tuple(f"{_FILE}/gauge/{k}/{{}}" for k in range(len(rows)))
    title = "Gauge repeatability and reproducibility"
    return Table(title, _GAUGE_COLUMNS, rows, notes, sources=sources)


def closing_lines(found: MeasuredFile) -> Iterator[str]:
    """Yield what the terminal says below the table."""
    largest = found.budget[0] if found.budget else None
    if largest is not None:
        name = _SOURCES.get(largest.source, largest.source)
        yield f"most of the uncertainty: {name} ({100 * largest.share:.0f} % of the variance)"
    yield verdict_words(found)


def measured_page(found: MeasuredFile, *, robot: str, version: str) -> str:
    """Return ``report.html`` of a measured part.

    Args:
        found: what was measured.
        robot: name of the robot.
        version: of pincal.
    """
    # A distance has the readings of the features between which it is.
    readings = sum(of.readings for of in found.features if of.kind not in DERIVED_KINDS)
    repeats = repeat_table(found)
    gauge = gauge_table(found)
    repeated = tuple(table for table in (repeats, gauge) if table is not None)
    made: tuple[Section | None, ...] = (
        _answer(found),
        Section("features", "Features", (value_table(found),), label="Features"),
        _form(found),
        Section("budget", "Uncertainty", (budget_table(found),), label="Uncertainty"),
        Section("repeat", "Repeatability", repeated, label="Repeatability") if repeated else None,
        _basis(found),
    )
    return render(
        f"A part measured by {robot}",
        f"{counted(len(found.features), 'feature')}, {counted(readings, 'reading')}",
        [section for section in made if section is not None],
        version=version,
    )


def _answer(found: MeasuredFile) -> Section:
    tag = found.verdict or "no tolerances"
    tone = _TONES.get(tag, "mute")
    answer = rich('<span class="tag {}">{}</span> {}', tone, tag, verdict_words(found))
    left = arranged(
        "plain", *doubts(found.warnings), paragraph(answer), *plain_notes(found.warnings)
    )
    right = arranged("plain", heading("What to do next"), bullets(_next_steps(found)))
    return Section(
        "answer", "Does the part conform?", (arranged("split", left, right),), style="panel"
    )


def _next_steps(found: MeasuredFile) -> Iterator[str]:
    if found.count("undecided") and found.budget:
        source = found.budget[0].source
        cure = {
            "sensor": "measure more points of these features, or use a better sensor",
            "arrival": "measure these features in more stops, or in several passes",
            "mount": "calibrate with the sensor itself, which identifies its mount",
            "scale": "use an instrument with a better certificate",
        }.get(source, "calibrate again with more poses near the part (pincal design)")
        yield f"To decide the undecided ones: {cure}."
    if found.count("does not conform"):
        yield "Look at the deviations below; with another datum they may be the part's placement."
    yield rich(
        "Sign: {} writes a certificate of the FOLDER in which this page is.",
        code("pincal certificate FOLDER --out SHEET"),
    )


def _form(found: MeasuredFile) -> Section | None:
    chosen = [(i, of) for i, of in enumerate(found.features) if of.kind not in DERIVED_KINDS]
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (of.name, of.kind, of.form_mm, of.readings, of.stops) for _, of in chosen
    )
    columns = (
        Column("feature", kind=Kind.NAME),
        Column("kind", kind=Kind.LABEL),
        Column("form", "mm", Kind.NUMBER, fixed(4), key="form_mm"),
        Column("readings", kind=Kind.NUMBER, key="readings"),
        Column("stops", kind=Kind.NUMBER, key="stops"),
    )
    notes = (
        "Form: peak-to-valley deviation of the points from the fitted feature; it contains the "
        "errors of the points.",
    )
    sources = tuple(f"{_FILE}/features/{i}/{{}}" for i, _ in chosen)
    table = Table("Form and readings", columns, rows, notes, sources=sources)
    return Section("form", "Form", (table,), label="Form")


def _basis(found: MeasuredFile) -> Section:
    datum = found.datum
    of = f" of {', '.join(datum.features)}" if datum.features else ""
    items = [
        ("datum", f"{datum.kind}{of}, in the frame of the {datum.frame}"),
        ("decision rule", found.rule),
    ]
    if found.outside:
        items.append(("outside the calibrated range", found.outside))
    if datum.residual_mm is not None:
        items.append(("fit of the datum", f"{datum.residual_mm:.4f} mm rms"))
    if found.id is not None:
        items += [(words, str(value)) for _, words, value in found.id.entries()]
    blocks: list[PageBlock] = [facts(items)]
    inputs = found.provenance.get("inputs", {})
    if inputs:
        listed = ((name, mark[:16]) for name, mark in inputs.items())
        blocks += [heading("Input files, with the start of their SHA-256"), facts(listed)]
    return Section("basis", "What this rests on", tuple(blocks), label="Basis")
