"""The page of a diagnosis, which is read in a minute, and its summary for the terminal."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from markupsafe import Markup

from pincal.calibration.frame_shift import by_how_much
from pincal.diagnosis.diagnosis_file import (
    ChangedParameter,
    ChangeEntry,
    CurvesEntry,
    DiagnosisFile,
    ExcludedEntry,
)
from pincal.diagnosis.robot_diagnosis import Diagnosis
from pincal.discover.discovery_file import EffectName
from pincal.discover.report.found_words import effect_words
from pincal.parameters import split_name
from pincal.report.blocks import (
    Section,
    arranged,
    bullets,
    code,
    doubts,
    facts,
    glance,
    heading,
    paragraph,
    plain_notes,
    rich,
    sourced,
)
from pincal.report.html import render
from pincal.report.words import effect_meaning
from pincal.result_table import Cell, Column, Kind, Table
from pincal.thresholds import Count, Scale
from pincal.units import (
    chance_words,
    fixed,
    format_readable,
    format_small,
    readable_unit,
    show_chance,
    show_measured,
)

_STATISTICS = {"mean_mm": "mean", "p95_mm": "95 %", "max_mm": "worst"}
_FILE = "diagnosis.json#"
_CHANGED = "changed"
_RIVAL = "alternative"
# Number of parameters that are named in a line.
_SHOWN: Count = 3
_ARCSEC: Scale = 180.0 * 3600.0 / np.pi
# Angle from which on an instrument was set up anew [mrad], and is not just a little off.
_ANOTHER_SET_UP_MRAD: Scale = 100.0


def headline(found: DiagnosisFile) -> str:
    """Return the result in a sentence."""
    if not found.is_judged:
        return f"These {found.rows} rows can't show whether the robot has changed."
    if not found.changed and found.p_value < found.alpha:
        return (
            f"No change was detected in these {found.rows} poses; they differ from the "
            "model beyond chance "
            f"({chance_words(found.p_value)}), in the way in which it was incomplete when the "
            "robot was calibrated."
        )
    if not found.changed:
        return (
            f"No change was detected in these {found.rows} poses ({chance_words(found.p_value)}): "
            "the robot still matches its model."
        )
    changes = "; ".join(
        in_words(change) + (f", {sizes(change)}" if change.parameters else "")
        for change in found.changes
    )
    return f"The robot has changed ({chance_words(found.p_value)}): {changes}."


def in_words(change: EffectName) -> str:
    """Return a change in words, with its joint.

    Example:
        >>> in_words(EffectName(effect="backlash", joint="axis_3"))
        'backlash of axis_3'
        >>> in_words(EffectName(effect="tip_expansion", joint=None))
        'tip_expansion of the whole arm'
    """
    if isinstance(change, ChangeEntry) and not change.parameters:
        return "something that no single cause explains"
    words = effect_words(change) + ("" if change.joint else " of the whole arm")
    session = ""
    if isinstance(change, ChangeEntry) and change.curve_rms is not None:
        session = change.session
    return words + (f" in {session}" if session else "")


def sizes(change: ChangeEntry) -> str:
    """Return the changes of the parameters in words, the most significant first."""
    if change.curve_rms is not None:
        unit = next(iter(change.parameters.values())).unit
        return f"its shape differs by {format_small(change.curve_rms, unit)} rms"
    moved = [(name, p.after - p.before, p.sigma, p.unit) for name, p in change.parameters.items()]
    moved.sort(key=lambda one: -abs(one[1]) / one[2] if one[2] else 0.0)
    shown = ((name, by, sigma, readable_unit(unit)) for name, by, sigma, unit in moved[:_SHOWN])
    return ", ".join(
        f"{name} by {show_measured(by, sigma, unit)} {unit.name} (95 %)"
        for name, by, sigma, unit in shown
    )


def change_table(changes: Iterable[ChangeEntry]) -> Table:
    """Return the changes with their sizes and alternatives."""
    columns = (
        Column("effect"),
        Column("joint", kind=Kind.NAME),
        Column("change"),
        Column("p", kind=Kind.NUMBER, show=show_chance),
        Column("could also be"),
        Column("distinguished by"),
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


def moved_parameters(changes: Iterable[ChangeEntry]) -> Table:
    """Return the parameters of all changes, before and after, rounded to the interval of the
    change.
    """
    columns = (
        Column("parameter", kind=Kind.NAME),
        Column("before", kind=Kind.NUMBER, key="before"),
        Column("after ± 95 %", kind=Kind.NUMBER, key="after sigma"),
        Column("unit", kind=Kind.LABEL),
    )
    moved = [
        (f"{_FILE}/changes/{k}/parameters/{name}", name, p)
        for k, change in enumerate(changes)
        for name, p in change.parameters.items()
    ]
    rows = tuple((name, *_before_and_after(p), readable_unit(p.unit).name) for _, name, p in moved)
    sources = tuple(f"{at}/{{}}" for at, _, _ in moved)
    return Table("Parameters before and after the change", columns, rows, sources=sources)


def _before_and_after(p: ChangedParameter) -> tuple[str, str]:
    """Return both values to the digits that the interval of the change has."""
    before, after = (
        show_measured(value, p.sigma, readable_unit(p.unit)) for value in (p.before, p.after)
    )
    return before.partition(" ±")[0], after


def curve_table(found: CurvesEntry) -> Table:
    """Return the contribution of each drive's curve to the error of the new rows."""
    columns = (
        Column("curve re-estimated", kind=Kind.NAME),
        Column("mean error", "mm", Kind.NUMBER, fixed(3)),
        Column("correlation", kind=Kind.NUMBER, show=fixed(2)),
        Column("difference", "arcsec, mm", Kind.NUMBER, fixed(1)),
        Column("determined before", "%", Kind.NUMBER, fixed(0)),
    )
    rows: list[tuple[Cell, ...]] = [("none", found.as_it_was_mm, None, None, None)]
    for entry in found.joints:
        small = entry.rms * (_ARCSEC if entry.unit == "rad" else 1e3)
        rows.append((entry.joint, entry.error_mm, entry.correlation, small, 100.0 * entry.seen))
    rows.append(("all", found.all_anew_mm, None, None, None))
    notes = (
        "Cross-validated over blocks of poses, without outliers. Correlation and "
        "difference (rms about its mean) of the old "
        "and the new curve at the new poses; determined before: poses at which the "
        "calibration had determined the curve.",
    )
    return Table(f"Curves of the drives in {found.session}", columns, tuple(rows), notes)


def excluded_table(found: DiagnosisFile, joint_names: Sequence[str]) -> Table:
    """Return the smallest detectable size of each change, as the largest motion of the target in
    these poses [mm].
    """
    entries = [entry for entry in found.excluded if entry.source is None]
    places = {entry.joint or "whole arm" for entry in entries}
    joints = [joint for joint in (*joint_names, "whole arm") if joint in places]
    smallest = _smallest(entries)
    happened = _named_above(found.changes)
    heads = short_names([joint for joint in joints if joint in joint_names])
    columns = (
        Column("change"),
        *(Column(heads.get(joint, joint), "", Kind.NUMBER, fixed(2)) for joint in joints),
    )
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (
            name,
            *(happened.get((name.partition(" ")[0], joint), on.get(joint)) for joint in joints),
        )
        for name, on in smallest.items()
    )
    words = {_CHANGED: "found, see above", _RIVAL: "could be the cause instead, see above"}
    said = "".join(f"{word}: {what}. " for word, what in words.items() if word in happened.values())
    notes = (
        f"In mm. {said}Dash: not observable in these poses, or not on this joint. Sizes in SI "
        "units are in diagnosis.json.",
    )
    return Table(
        "Smallest change detected with a probability of 90 %, as motion of the target",
        columns,
        rows,
        notes,
    )


def short_names(names: Sequence[str]) -> dict[str, str]:
    """Return the names of joints for the heads of narrow columns: without what all begin or end
    with, if words are left.

    Example:
        >>> list(short_names(["panda_joint1", "panda_joint2"]).values())
        ['joint1', 'joint2']
        >>> list(short_names(["shoulder_pan_joint", "elbow_joint"]).values())
        ['shoulder_pan', 'elbow']
        >>> list(short_names(["joint_1", "joint_2"]).values())
        ['joint_1', 'joint_2']
    """
    words = [name.split("_") for name in names]
    while _has_common(words, 0):
        words = [of[1:] for of in words]
    while _has_common(words, -1):
        words = [of[:-1] for of in words]
    are_words = all(of[0][:1].isalpha() for of in words)
    return {
        name: "_".join(of) if are_words else name for name, of in zip(names, words, strict=True)
    }


def _has_common(words: Sequence[Sequence[str]], at: int) -> bool:
    """Return whether names, as words, all have the same first or last one, and others besides."""
    return len({of[at] for of in words}) == 1 and all(len(of) > 1 for of in words)


def _smallest(entries: Sequence[ExcludedEntry]) -> dict[str, dict[str, float]]:
    """Return the sizes by change and joint: of the forms of one effect on a joint, such as orders
    of an eccentricity, of the one that is hardest to detect.
    """
    found: dict[str, dict[str, float]] = {}
    for entry in entries:
        symbol = split_name(entry.parameter)[1]
        several = sum(e.effect == entry.effect and e.joint == entry.joint for e in entries) > 1
        on = found.setdefault(
            f"{entry.effect} {symbol}" if several and symbol else entry.effect, {}
        )
        where = entry.joint or "whole arm"
        on[where] = max(entry.tip_mm, on.get(where, 0.0))
    return found


def _named_above(changes: Iterable[ChangeEntry]) -> dict[tuple[str, str], str]:
    """Return what has changed, and what could have instead, by effect and joint."""
    named: dict[tuple[str, str], str] = {}
    for change in changes:
        rivals = ((rival, _RIVAL) for rival in change.equivalent)
        for one, word in (*rivals, (change, _CHANGED)):
            named[one.effect, one.joint or "whole arm"] = word
    return named


def set_up_words(found: DiagnosisFile) -> str:
    """Return how instrument and target were displaced, in words, with what that is not."""
    at = found.station
    if at.is_still:
        return "instrument and target are where they were at calibration"
    shifts = (
        ("the instrument moved", at.moved_mm, at.moved_U_mm, _length, ""),
        ("turned", at.turned_mrad, at.turned_U_mrad, _turn, ""),
        ("the target moved", at.target_moved_mm, at.target_moved_U_mm, _length, " on the tool"),
    )
    parts = [
        f"{words} {by_how_much(shift, U, show)}{where}"
        for words, shift, U, show, where in shifts
        if shift is not None
    ]
    words = ", ".join(parts) or "these readings do not determine the placement of the instrument"
    return f"{words}; this is not a change of the robot"


def _length(moved_mm: float) -> str:
    """Return a displacement between two set-ups."""
    return f"{moved_mm:.2f} mm"


def _turn(turned_mrad: float) -> str:
    """Return an angle between two set-ups: how far one is off in mrad, another one in degrees."""
    if turned_mrad < _ANOTHER_SET_UP_MRAD:
        return f"{turned_mrad:.2f} mrad"
    return f"{np.degrees(turned_mrad * 1e-3):.2f} deg"


def lines(found: DiagnosisFile) -> Iterator[tuple[str, str]]:
    """Yield the summary of a diagnosis for the terminal: headings and lines."""
    yield "verdict", headline(found)
    for change in found.changes:
        if change.equivalent:
            yield (
                "or",
                f"{'; '.join(map(in_words, change.equivalent))}, instead of {in_words(change)}; to "
                f"distinguish: {change.tell_apart}",
            )
    before, after = (found.gap[key]["mean_mm"] for key in ("before", "after"))
    mended = f" with the old model, {after:.4f} mm with the re-identified one"
    yield "error", f"mean {before:.4f} mm{mended if found.changed else ''}"
    yield "set-up", set_up_words(found)
    if found.excluded:
        yield "excluded", _excluded_words(found)


def _excluded_words(found: DiagnosisFile) -> str:
    """Return what the first kind of change that the poses exclude can be at most."""
    kind = found.excluded[0].effect
    of_kind = (entry for entry in found.excluded if entry.effect == kind)
    largest = max(of_kind, key=lambda entry: entry.smallest)
    return (
        f"with 90 % probability: any {'other ' if found.changes else ''}{kind} of at least "
        f"{format_readable(largest.smallest, largest.unit)} ({largest.tip_mm:.2f} mm at the "
        f"target); all {len(found.excluded)} in diagnosis.json"
    )


def diagnosis_page(diagnosis: Diagnosis, *, version: str) -> str:
    """Return ``report.html`` of a diagnosis."""
    found = diagnosis.found
    robot = diagnosis.model.model.chain.robot
    drives = None if found.curves is None else (curve_table(found.curves),)
    curves = (
        None
        if drives is None
        else Section("curves", "Curves of the drives", drives, label="Curves")
    )
    made = (
        _answer(found),
        _changes(found),
        curves,
        _unchanged(found, robot.joint_names),
        _station(found),
    )
    lead = f"{found.rows} new poses compared with the calibrated robot"
    machine = "" if found.id is None else found.id.machine
    lead += f"; {machine}" if machine else ""
    return render(
        f"Diagnosis of {robot.name}",
        lead,
        [section for section in made if section is not None],
        version=version,
    )


def _answer(found: DiagnosisFile) -> Section:
    judged = "changed" if found.changed else "not changed"
    tag = judged if found.is_judged else "not judged"
    tone = "good" if tag == "not changed" else "bad"
    answer = rich('<span class="tag {}">{}</span> {}', tone, tag, headline(found))
    first = (*doubts(found.warnings), paragraph(answer, "headline"))
    then = (
        heading("What to do next"),
        bullets(_next_steps(found)),
        *plain_notes(found.warnings),
    )
    errors = _errors_before_and_after(found) if found.changed else _errors_now(found)
    return Section("answer", "Has it changed?", (*first, errors, *then), style="panel")


def _errors_now(found: DiagnosisFile) -> Markup:
    before = found.gap["before"]
    return facts(
        (f"{words} error", sourced(f"{before[key]:.4f} mm", f"{_FILE}/gap/before/{key}"))
        for key, words in _STATISTICS.items()
    )


def _errors_before_and_after(found: DiagnosisFile) -> Markup:
    before = found.gap["before"]
    after = found.gap["after"]
    shown = glance(
        [
            (
                f"{words} error",
                (before[key], after[key]),
                (
                    sourced(f"{before[key]:.4f}", f"{_FILE}/gap/before/{key}"),
                    sourced(f"{after[key]:.4f} mm", f"{_FILE}/gap/after/{key}"),
                ),
            )
            for key, words in _STATISTICS.items()
        ]
    )
    return arranged("glance", *shown)


def _next_steps(found: DiagnosisFile) -> Iterator[str | Markup]:
    if not found.is_judged:
        yield "Find out where these rows come from, and measure again."
        return
    if not found.changed:
        yield rich(
            "Keep using the model; {} adds these poses to it permanently.", code("pincal update")
        )
        return
    for change in found.changes:
        if not change.parameters:
            continue
        meaning = f" ({effect_meaning(change.effect)})"
        yield f"Inspect {change.joint or 'the whole arm'}: {change.effect}{meaning}."
        if change.equivalent:
            yield (
                f"It could also be {'; '.join(map(in_words, change.equivalent))}. To "
                f"distinguish: {change.tell_apart}."
            )
    named = any(change.parameters for change in found.changes)
    if named:
        yield rich(
            "Until it is repaired, use {}: in this model only what changed was estimated again.",
            code("model.json"),
        )
    else:
        yield rich("Measure more poses and calibrate again: {}.", code("pincal discover"))


def _changes(found: DiagnosisFile) -> Section | None:
    if found.changes:
        # How to distinguish them is said first.
        table = change_table(found.changes).without("distinguished by")
        blocks = (table, moved_parameters(found.changes))
        return Section("changes", "What has changed", blocks, label="What has changed")
    if not found.is_judged:
        return None
    text = (
        f"Nothing: the calibrated model predicts these {found.rows} poses as well as its "
        "noise allows "
        f"({chance_words(found.p_value)}; below {found.alpha:g} the robot would count as changed)."
    )
    return Section("changes", "What has changed", (paragraph(text),), label="What has changed")


def _unchanged(found: DiagnosisFile, joint_names: Sequence[str]) -> Section | None:
    if not found.excluded:
        return None
    words = (
        "Smallest size of each change that would have been detected with a probability of "
        "90 %, as the largest motion of "
        "the target in these poses."
    )
    blocks = (paragraph(words), excluded_table(found, joint_names))
    return Section("noticed", "What has not changed", blocks, label="What has not changed")


def _station(found: DiagnosisFile) -> Section:
    items = (
        ("instrument and target", set_up_words(found)),
        ("false alarms", f"one in {1.0 / found.alpha:.0f} diagnoses of an unchanged robot"),
    )
    return Section("station", "Set-up", (facts(items),))
