"""What has changed on a robot, as a page that is read in a minute, and as the same in a few lines for a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from markupsafe import Markup

from pincal.diagnosis.run import Diagnosis
from pincal.io.diagnosis_file import ChangedParameter, ChangeEntry, ChangeName, CurvesEntry, DiagnosisFile
from pincal.report.blocks import Section, bars, bullets, code, doubts, facts, group, heading, paragraph, plain_notes, rich
from pincal.report.html import render
from pincal.report.tables import show_chance
from pincal.report.words import effect_meaning
from pincal.tables import Cell, Column, Kind, Table
from pincal.units import fixed, format_small

_STATISTICS = (("mean", "mean"), ("p95", "95 %"), ("max", "worst"))
# Parameters that are named in a line.
_SHOWN = 3
_ARCSEC = 180.0 * 3600.0 / np.pi


def headline(found: DiagnosisFile) -> str:
    """Return the answer in a sentence."""
    if not found.is_judged:
        return f"These {found.rows} rows can't tell whether the robot has changed."
    if not found.changed:
        return (
            f"Nothing has changed that these {found.rows} poses could show (p = {found.p_value:.2g}): "
            "the robot still is what its model says."
        )
    changes = "; ".join(in_words(change) + (f", {sizes(change)}" if change.parameters else "") for change in found.changes)
    return f"The robot has changed ({_chance(found.p_value)}): {changes}."


def _chance(p_value: float) -> str:
    return f"p = {show_chance(p_value)}" if p_value > 0.0 else f"p {show_chance(0.0)}"


def in_words(change: ChangeName) -> str:
    """Return a change in words, with its joint.

    Example:
        >>> in_words(ChangeName(effect="backlash", joint="axis_3"))
        'backlash of axis_3'
    """
    if isinstance(change, ChangeEntry) and not change.parameters:
        return "something that no single cause explains"
    words = f"{change.effect} of {change.joint or 'the whole arm'}" + (f" by {change.source}" if change.source else "")
    session = change.session if isinstance(change, ChangeEntry) and change.curve_rms is not None else ""
    return words + (f" in {session}" if session else "")


def sizes(change: ChangeEntry) -> str:
    """Return how far the parameters of a change moved, those first that moved by most of their standard deviations."""
    if change.curve_rms is not None:
        unit = next(iter(change.parameters.values())).unit
        return f"its curve is another by {format_small(change.curve_rms, unit)} rms"
    surest = sorted(change.parameters.items(), key=lambda item: -_sureness(item[1]))[:_SHOWN]
    return ", ".join(
        f"{name} by {format_small(p.after - p.before, p.unit)} ± {format_small(p.sigma, p.unit)}" for name, p in surest
    )


def _sureness(parameter: ChangedParameter) -> float:
    return abs(parameter.after - parameter.before) / parameter.sigma if parameter.sigma else 0.0


def change_table(changes: Iterable[ChangeEntry]) -> Table:
    """Return what changed, by how much, and what it could be as well."""
    columns = (
        Column("what"),
        Column("joint", kind=Kind.NAME),
        Column("moved"),
        Column("p", kind=Kind.NUMBER, show=show_chance),
        Column("could also be"),
        Column("told apart by"),
    )
    rows = tuple(
        (
            change.effect,
            change.joint or "whole arm",
            sizes(change),
            change.p_value,
            "; ".join(map(in_words, change.equivalent)) or "nothing else",
            change.tell_apart,
        )
        for change in changes
    )
    return Table("What has changed", columns, rows)


def curve_table(found: CurvesEntry) -> Table:
    """Return what each drive's curve contributes to the error of the new rows."""
    columns = (
        Column("curve taken anew", kind=Kind.NAME),
        Column("mean error", "mm", Kind.NUMBER, fixed(3)),
        Column("correlation", kind=Kind.NUMBER, show=fixed(2)),
        Column("difference", "arcsec, mm", Kind.NUMBER, fixed(1)),
        Column("seen before", "%", Kind.NUMBER, fixed(0)),
    )
    rows: list[tuple[Cell, ...]] = [("none", found.as_it_was_mm, None, None, None)]
    for entry in found.joints:
        small = entry.rms * (_ARCSEC if entry.unit == "rad" else 1e3)
        rows.append((entry.joint, entry.error_mm, entry.correlation, small, 100.0 * entry.seen))
    rows.append(("all", found.all_anew_mm, None, None, None))
    notes = (
        "Blocks of poses left out, outliers too. Correlation and difference (rms, its mean apart) of the old curve and the "
        "new one at the new poses; seen: poses at which the calibration knew the curve.",
    )
    return Table(f"Curves of the drives in {found.session}", columns, tuple(rows), notes)


def excluded_table(found: DiagnosisFile, joint_names: Sequence[str]) -> Table:
    """Return how far the target would have moved at most, at the least, for each change to be noticed [mm]."""
    entries = [entry for entry in found.excluded if entry.source is None]
    places = {entry.joint or "whole arm" for entry in entries}
    joints = [joint for joint in (*joint_names, "whole arm") if joint in places]
    smallest: dict[str, dict[str, float]] = {}
    for entry in entries:
        symbol = entry.parameter.rpartition(".")[2]
        several = sum(e.effect == entry.effect and e.joint == entry.joint for e in entries) > 1
        sizes_on = smallest.setdefault(f"{entry.effect} {symbol}" if several and symbol else entry.effect, {})
        # Of the forms of one effect on a joint, such as orders of an eccentricity, the one that is hardest to notice.
        where = entry.joint or "whole arm"
        sizes_on[where] = max(entry.tip_mm, sizes_on.get(where, 0.0))
    columns = (Column("change"), *(Column(joint, "mm", Kind.NUMBER, fixed(2)) for joint in joints))
    rows: tuple[tuple[Cell, ...], ...] = tuple((name, *(on.get(joint) for joint in joints)) for name, on in smallest.items())
    notes = ("A dash: these poses see nothing of it, or not on this joint. Sizes in their own units are in diagnosis.json.",)
    return Table("Smallest change that would have been noticed with 90 %, as motion of the target", columns, rows, notes)


def moved_words(found: DiagnosisFile) -> str:
    """Return how far instrument and target moved."""
    at = found.station
    parts = [] if at.moved_mm is None else [f"the instrument moved by {at.moved_mm:.4g} mm"]
    parts += [] if at.turned_mrad is None else [f"turned by {at.turned_mrad:.4g} mrad"]
    parts += [] if at.target_moved_mm is None else [f"the target sits {at.target_moved_mm:.2f} mm from where it was"]
    return ", ".join(parts) or "these readings don't tell where the instrument stands"


def lines(found: DiagnosisFile) -> Iterator[str]:
    """Yield a diagnosis for a terminal."""
    yield headline(found)
    for change in found.changes:
        if change.equivalent:
            yield f"  {in_words(change)} could also be {'; '.join(map(in_words, change.equivalent))}"
            yield f"  to tell: {change.tell_apart}"
    before, after = (found.gap[key]["mean_mm"] for key in ("before", "after"))
    if found.changed:
        yield f"mean error {before:.4f} mm by the model as it was, {after:.4f} mm by the mended one"
    else:
        yield f"mean error {before:.4f} mm"
    yield f"{moved_words(found)}; that is no change of the robot"
    if worst := _least_offsets(found):
        yield worst


def _least_offsets(found: DiagnosisFile) -> str:
    """Return what is excluded of the kind of change that is listed first, in a line."""
    if not found.excluded:
        return ""
    first = [entry for entry in found.excluded if entry.effect == found.excluded[0].effect]
    largest = max(first, key=lambda entry: entry.smallest)
    return (
        f"excluded with 90 %: any other {first[0].effect} from {format_small(largest.smallest, largest.unit)} "
        f"({largest.tip_mm:.2f} mm at the target) on; {len(found.excluded)} more in diagnosis.json"
    )


def diagnosis_page(diagnosis: Diagnosis, *, version: str) -> str:
    """Return ``report.html`` of a diagnosis."""
    found, robot = diagnosis.found, diagnosis.model.model.chain.robot
    made = (_answer(found), _changes(found), _curves(found), _noticed(found, robot.joint_names), _station(found))
    return render(
        f"Diagnosis of {robot.name}",
        f"{found.rows} new poses against the robot as it was calibrated",
        [section for section in made if section is not None],
        version=version,
    )


def _answer(found: DiagnosisFile) -> Section:
    tone, tag = ("bad", "changed") if found.changed else ("good", "not changed")
    tone, tag = (tone, tag) if found.is_judged else ("bad", "not judged")
    answer = rich('<span class="tag {}">{}</span> {}', tone, tag, headline(found))
    left = group("plain", *doubts(found.warnings), paragraph(answer), *plain_notes(found.warnings))
    columns = group("split", left, group("plain", heading("What to do next"), bullets(_next_steps(found))))
    before, after = found.gap["before"], found.gap["after"]
    largest = max(before["max_mm"], after["max_mm"]) or 1.0
    glance = (
        bars(
            f"{words} error",
            f"{before[f'{name}_mm']:.4f}",
            f"{after[f'{name}_mm']:.4f} mm",
            (100.0 * before[f"{name}_mm"] / largest, 100.0 * after[f"{name}_mm"] / largest),
        )
        for name, words in _STATISTICS
    )
    return Section("answer", "Has it changed?", (columns, group("glance", *glance)), style="panel")


def _next_steps(found: DiagnosisFile) -> Iterator[str | Markup]:
    if not found.is_judged:
        yield "Find out what these rows are, and measure again."
        return
    if not found.changed:
        yield rich("Go on with the model; {} takes these poses in for good.", code("pincal update"))
        return
    for change in found.changes:
        if not change.parameters:
            continue
        meaning = f" ({effect_meaning(change.effect)})"
        yield f"Look at {change.joint or 'the whole arm'}: {change.effect}{meaning}."
        if change.equivalent:
            yield f"It could also be {'; '.join(map(in_words, change.equivalent))}. To tell: {change.tell_apart}."
    named = any(change.parameters for change in found.changes)
    if named:
        yield rich("Until then {} is the mended model: only what changed was found anew.", code("model.json"))
    else:
        yield rich("Measure more poses and calibrate again: {}.", code("pincal discover"))


def _changes(found: DiagnosisFile) -> Section | None:
    if not found.changes:
        return None
    return Section("changes", "What has changed", (change_table(found.changes),), label="What has changed")


def _curves(found: DiagnosisFile) -> Section | None:
    if found.curves is None:
        return None
    return Section("curves", "Curves of the drives", (curve_table(found.curves),), label="Curves")


def _noticed(found: DiagnosisFile, joint_names: Sequence[str]) -> Section | None:
    if not found.excluded:
        return None
    words = (
        "Each of these changes would have been noticed, with a chance of 90 %, from the size on at which it moves the "
        "target by so many millimetres at the most in these poses."
    )
    return Section(
        "noticed",
        "What has not changed",
        (paragraph(words), excluded_table(found, joint_names)),
        label="What has not changed",
    )


def _station(found: DiagnosisFile) -> Section:
    items = (
        ("instrument and target", f"{moved_words(found)}; that is no change of the robot"),
        ("false alarms", f"one in {1.0 / found.alpha:.0f} diagnoses of a robot that has not changed"),
    )
    return Section("station", "Set-up", (facts(items),))
