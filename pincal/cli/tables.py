"""Results as text that fits 100 columns: with colours on a terminal, plain elsewhere."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from msgspec import UNSET
from rich.console import Console

from pincal.calibration.result import Result
from pincal.calibration.tables import error_table, iso9283_table, moved_table, parameter_table, repeated_table, station_table
from pincal.design.design import Design
from pincal.design.health import HealthCheck
from pincal.design.observability import SOURCES
from pincal.design.study import RANDOM_DESIGNS
from pincal.discover.power import TOLD_APART
from pincal.discover.precheck import DataReport, DetectabilityTable
from pincal.discover.run import Discovery
from pincal.notes import Note, doubts_first, doubts_of
from pincal.report.tables import (
    by_reason,
    coverage_table,
    detectability_tables,
    effect_table,
    expectation_table,
    location_table,
    pose_count_table,
    smallest_size,
    stage_table,
)
from pincal.report.verdict import verdict_of
from pincal.report.words import (
    HINTS,
    bootstrap_words,
    effect_words,
    line_words,
    noise_words,
    only_in_halves_words,
    rank_words,
)
from pincal.tables import hanging, one_line
from pincal.units import Quantity, format_small
from pincal.validate.lack_of_fit import LackOfFit
from pincal.validate.replicates import cycle_words

# Observability indices that are worth a line; the others are in --json.
_SHOWN = ("O1", "O2")


def print_result(result: Result, out: Console) -> None:
    """Print errors before and after, the parameters, and what the user should know, doubts first."""
    print_doubts(result.warnings, out)
    print_left_out(result, out)
    out.print(_summary(result))
    if result.stations is not UNSET:
        out.print(station_table(result.stations))
        for table in (moved_table(result.stations), repeated_table(result.stations)):
            if table is not None:
                out.print(table)
    out.print(error_table(result.error))
    print_replicates(result.iso9283, result.lack_of_fit, out)
    out.print(parameter_table(result.parameters))
    print_notes(result.warnings, out)


def print_left_out(result: Result, out: Console) -> None:
    """Print how well stations are predicted by the model of the others, if they were left out in turn."""
    if (means := result.left_out_mm) is not None:
        out.print(f"On a set-up that it never saw: mean {means[0]:.4f} mm; geometry alone {means[1]:.4f} mm")


def print_doubts(notes: Iterable[Note], out: Console) -> None:
    """Print what makes a result doubtful: before all else of it, in every mode, in full."""
    for doubt in doubts_of(notes):
        out.print(hanging("doubt:", doubt.text), style="bold red")


def print_notes(notes: Iterable[Note | str], out: Console) -> None:
    """Print what is good to know; doubts stand before the result."""
    for note in doubts_first(notes):
        if not note.is_doubt:
            out.print(hanging("note:", note.text), style="yellow")


def _summary(result: Result) -> str:
    p_value = result.chi2_p_value
    chi2 = "" if p_value is None else f", reduced chi-square {result.chi2_reduced:.3f} (p {p_value:.2g})"
    rank = rank_words((row.status for row in result.parameters), rank=result.rank, condition=result.condition)
    return (
        f"{result.rows['train']} rows fitted, {held_out_words(result)}; {result.iterations} iterations, "
        f"{result.seconds:.2f} s\nnoise {noise_words(result.noise)} ({result.noise['source']}){chi2}\n{rank}"
    )


def held_out_words(result: Result) -> str:
    """Return in words which rows judge the model."""
    turns = 0 if result.stations is UNSET else sum("left_out" in station for station in result.stations)
    return f"{turns} stations held out in turn" if turns else f"{result.rows['test']} held out"


def print_replicates(iso: Mapping[str, Any] | None, lack: LackOfFit | None, out: Console) -> None:
    """Print what replicated poses show: ``iso9283`` of ``result.json``, and the test of lack of fit."""
    if iso is not None:
        out.print(iso9283_table(iso))
        out.print(hanging("cycles:", cycle_words(iso)))
    if lack is not None:
        out.print(hanging("lack of fit:", f"{lack} (by {lack.scatter})"))


def print_precheck(precheck: DataReport, out: Console) -> None:
    """Print what can be identified from a table."""
    print_doubts(precheck.warnings, out)
    out.print(f"{precheck.rows} rows of kind {precheck.kind}; nominal robot, base and tool fitted: mean "
              f"{precheck.nominal['mean_mm']:.3f} mm, max {precheck.nominal['max_mm']:.3f} mm")  # fmt: skip
    out.print(f"noise {noise_words(precheck.noise)} ({precheck.noise['source']})")
    statuses = (parameter.status for parameter in precheck.parameters)
    out.print(rank_words(statuses, rank=precheck.rank, condition=precheck.condition))
    out.print(coverage_table(precheck))
    out.print(expectation_table(precheck))
    _print_detectability(precheck, precheck.detectable, out)
    print_notes(precheck.warnings, out)


def _print_detectability(precheck: DataReport, found: DetectabilityTable, out: Console) -> None:
    source = {"assumed": "assumed: it is not declared, and so few rows do not give an estimate"}
    out.print(
        f"\nSmallest effects that pincal discover would find beside the {found.model} model with a probability of "
        f"{100 * found.power:.0f} %, at a probability of {100 * found.alpha:g} % of any false name and a noise of "
        f"{found.sigma_m * 1e3:.4g} mm per coordinate ({source.get(found.source, found.source)}). An effect with several "
        "parameters is given by its amplitude, transmission_error by the rms of its curve, elastic effects by their largest "
        "rotation in these poses, joint_coupling by the range over the joints that may drive it. -: see below."
    )
    for table in detectability_tables(precheck):
        out.print(table)
    whole = [(e.effect.name, smallest_size([e])) for e in found.effects if e.effect.locus.joint is None]
    sizes = [f"{name} {format_small(*size)}" for name, size in whole if isinstance(size, Quantity)]
    if sizes:
        out.print("Whole arm: " + ", ".join(sizes), markup=False)
    _print_untestable(((e.effect.name, e.effect.locus.joint, e.reason) for e in found.effects), len(precheck.joints), out)


def _print_untestable(entries: Iterable[tuple[str, str | None, str]], n_joints: int, out: Console) -> None:
    for reason, names in by_reason(entries, n_joints).items():
        out.print(hanging("not testable:", f"{names}: {reason}"))


def print_discovery(found: Discovery, out: Console) -> None:
    """Print where model and data disagreed, what made them, and how the error fell to the noise."""
    findings = found.findings
    print_doubts(found.calibration.result.warnings, out)
    print_left_out(found.calibration.result, out)
    out.print(hanging("Verdict:", f"{findings.verdict}. {verdict_of(found.calibration.result, found).reason}"))
    if findings.where:
        out.print(location_table(findings.where))
    named, hints = ([e for e in findings.effects if e.is_hint == is_hint] for is_hint in (False, True))
    if named or not hints:
        out.print(effect_table(named) if named else "These data show no missing effect.")
    if hints:
        out.print(effect_table(hints, HINTS))
    if findings.bootstrap:
        out.print(one_line(bootstrap_words(findings.bootstrap)), markup=False)
    if findings.only_in_halves:
        out.print(one_line(only_in_halves_words(findings)), markup=False)
    out.print(stage_table(findings.noise_floor_mm, found.gaps))
    for entry in findings.effects:
        if words := line_words(entry):
            out.print(hanging(effect_words(entry), words))
        if entry.tell_apart:
            out.print(hanging("to decide", f"between {effect_words(entry)} and its alternatives: {entry.tell_apart}"))
        if entry.period is not None:
            unit = {"time": "s", "temperature": "K", "payload": "kg"}.get(entry.depends_on or "", "rad")
            out.print(one_line(f"{effect_words(entry)} repeats every {entry.period:.4g} {unit}"), markup=False)
    for scatter in findings.scatter:
        text = f"{scatter.joint} scatters by {scatter.sigma_rad * 1e3:.3f} mrad; record {scatter.missing}"
        out.print(one_line(text), markup=False)
    joints = found.calibration.fit.problem.chain.robot.joint_names
    _print_untestable(((e.effect, e.joint, e.reason) for e in findings.not_testable), len(joints), out)


def print_design(found: Design, out: Console) -> None:
    """Print what was asked, what the constraints removed, and what these and other numbers of poses promise."""
    n, robot = found.found.poses, found.robot
    noise = ", ".join(f"{1e3 * s:.3g} {'mm' if i == 0 else 'mrad'}" for i, s in enumerate(found.design_model.sigma))
    rig = f"{robot.base} to {robot.tip}: {found.rig.sensor}, noise {noise}; {found.design_model.n_free} parameters"
    out.print(hanging(f"{n} poses", f"of {robot.name}, {rig}"))
    for mark, text in _design_facts(found):
        out.print(hanging(f"{mark + ':':13s}", text))
    if found.curve:
        out.print(pose_count_table(found))
    print_notes(found.notes, out)


def print_check(found: HealthCheck, out: Console) -> None:
    """Print what a health check takes, what it notices and what not, and what simulation says of that."""
    out.print(one_line(found.summary()), markup=False)
    if not found.is_met:
        text = f"so many poses do not notice {1e3 * found.notice:.3g} mm; a calibration from more poses, or less noise, does"
        out.print(hanging("not met:", text))
    hardest = found.changes[0]
    where = f"{hardest.change.name} {hardest.change.joint or ''}".strip()
    parameters = ", ".join(hardest.change.parameters)
    signal = f"signal {hardest.noncentrality:.1f} of the {hardest.needed:.1f} needed"
    out.print(hanging("hardest:", f"{where} ({parameters}): {signal}"))
    rates = f"alarms in {100 * found.alarms:.1f} % of {found.draws} checks of an unchanged robot, in "
    rates += f"{100 * found.noticed:.1f} % of {found.draws} if the hardest change by {1e3 * found.notice:.3g} mm has come"
    out.print(hanging("simulated:", rates))
    if found.absorbed:
        known, new = ([c for c in found.absorbed if (c.effect is None) is is_known] for is_known in (True, False))
        parts = [*dict.fromkeys(name for change in known for name in change.parameters)]
        names = ", ".join([*parts, *([f"{len(new)} new effects"] if new else [])])
        why = "new places of instrument and target take them up, or they never move anything by so much"
        out.print(hanging("not seen:", f"{names}: {why}"))
    curves = "free curves of a drive, and what follows temperature, time or the direction of approach, are not promised"
    out.print(hanging("beyond:", curves))
    out.print(hanging("candidates:", found.drawn.in_words()))
    print_notes(found.notes, out)


def _design_facts(found: Design) -> Iterator[tuple[str, str]]:
    """Yield how the poses were chosen, and what they promise beside random ones."""
    designed, random = found.found.designed, found.found.random
    yield "candidates", found.drawn.in_words()
    path = f"{found.path_length:.1f} joint ranges from first to last pose, {found.path_length_unordered:.1f} before ordering"
    yield "path length", path
    if found.needed is not None:
        yield "accuracy", f"{found.needed} of the candidates are the fewest that reach it"
    what = found.design_model.quantity
    yield "predicted", f"{what} error over the task {1e3 * designed.error:.4f} mm rms, if the model has the right form"
    if found.before is not None:
        yield "before", f"{1e3 * found.before.error:.4f} mm with the poses already measured"
    ratio = f"{random.error / designed.error:.2f} times as much, " if found.criterion != "tell apart" else ""
    yield "random", f"{1e3 * random.error:.4f} mm ({ratio}median of {RANDOM_DESIGNS} draws)"
    if found.bound is not None:
        beyond = "; refining the poses went beyond them" if designed.error < found.bound else ""
        yield "lower bound", f"no choice of the candidates comes below {1e3 * found.bound:.4f} mm{beyond}"
    for mine, other, left, chance in zip(found.rivals, found.rivals[::-1], designed.apart, random.apart, strict=False):
        verdict = "distinguishable" if left >= TOLD_APART else f"not distinguishable, {TOLD_APART:g} are needed"
        verdict += f" (random {chance:.3g})"
        yield "rivals", f"{mine} of typical size leaves {left:.3g} that {other} can't explain: {verdict}"
    yield "rank", f"{found.rank} identifiable directions of the parameters"
    for name in _SHOWN:
        if name in found.observability:
            numbers = f"{found.observability[name]:.3g}, random {found.observability_random[name]:.3g}"
            yield f"index {name}", f"{numbers} (observability, {SOURCES[name]})"
