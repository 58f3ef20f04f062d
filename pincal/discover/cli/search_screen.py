"""What a search found, as text that fits 100 columns."""

from __future__ import annotations

from rich.console import Console

from pincal.cli.screen import print_doubts, print_elsewhere, print_left_out
from pincal.discover.discovery_file import Findings, FoundEffect
from pincal.discover.report import found_tables
from pincal.discover.report.detectability_tables import not_testable
from pincal.discover.report.found_words import (
    HINTS,
    bootstrap_words,
    effect_words,
    line_words,
    subsample_only_words,
)
from pincal.discover.report.search_answer import SearchAnswer
from pincal.discover.run import Discovery
from pincal.model.effect import Family
from pincal.model.effect_registry import EFFECTS
from pincal.report.judgement import judged
from pincal.result_table import hanging, one_line
from pincal.thresholds import Count
from pincal.units import show_chance

# Number of effects that are listed individually.
_EFFECTS: Count = 3


def summary_of_search(discovery: Discovery) -> str:
    """Return the first effects that were found, in words."""
    effects = discovery.findings.effects
    if not effects:
        return "these data show no missing effect"
    # Elasticity, which every arm has, comes after other effects, and hints come last.
    elastic = [name for name, cls in EFFECTS.known().items() if cls.family is Family.ELASTICITY]
    named = [
        _named(entry)
        for entry in sorted(effects, key=lambda e: (e.is_hint, e.effect in elastic))[:_EFFECTS]
    ]
    more = len(effects) - _EFFECTS
    return ", ".join([*named, *([f"{more} more"] if more > 0 else [])])


def _named(entry: FoundEffect) -> str:
    chance = f"p {show_chance(entry.p_value)}"
    words = chance if entry.stability is None else f"{entry.stability} subsamples, {chance}"
    return f"{'perhaps ' if entry.is_hint else ''}{effect_words(entry)} ({words})"


def print_discovery(found: Discovery, out: Console) -> None:
    """Print where model and data disagreed, the effects found, and the errors after each step."""
    findings = found.findings
    print_doubts(found.calibration.result.warnings, out)
    print_left_out(found.calibration.result, out)
    out.print(
        hanging(
            "Verdict:",
            f"{findings.verdict}. {judged(found.calibration.result, SearchAnswer(found)).reason}",
        )
    )
    if findings.where:
        out.print(found_tables.location_table(findings.where))
    _print_effects(findings, out)
    if findings.bootstrap:
        out.print(one_line(bootstrap_words(findings.bootstrap)), markup=False)
    if findings.only_in_halves:
        out.print(one_line(subsample_only_words(findings)), markup=False)
    out.print(found_tables.stage_table(findings.noise_floor_mm, found.gaps))
    print_elsewhere(found.calibration.result, out)
    for entry in findings.effects:
        _print_effect(entry, out)
    for scatter in findings.scatter:
        text = (
            f"{scatter.joint} scatters by {scatter.sigma_rad * 1e3:.3f} mrad; record "
            f"{scatter.missing}"
        )
        out.print(one_line(text), markup=False)
    joints = found.calibration.fit.problem.chain.robot.joint_names
    lost = ((e.effect, e.joint, e.reason) for e in findings.not_testable)
    for line in not_testable(lost, len(joints)):
        out.print(line)


def _print_effects(findings: Findings, out: Console) -> None:
    """Print the tables of the effects found and of the hints."""
    named = [entry for entry in findings.effects if not entry.is_hint]
    hints = [entry for entry in findings.effects if entry.is_hint]
    if named or not hints:
        out.print(
            found_tables.effect_table(named) if named else "These data show no missing effect."
        )
    if hints:
        out.print(found_tables.effect_table(hints, HINTS))


def _print_effect(entry: FoundEffect, out: Console) -> None:
    """Print what no table holds of an effect: its words, its alternatives and its period."""
    if words := line_words(entry):
        out.print(hanging(effect_words(entry), words))
    if entry.tell_apart:
        out.print(
            hanging(
                "to distinguish",
                f"{effect_words(entry)} from its alternatives: {entry.tell_apart}",
            )
        )
    if entry.period is not None:
        unit = {"time": "s", "temperature": "K", "payload": "kg"}.get(entry.depends_on or "", "rad")
        out.print(
            one_line(f"{effect_words(entry)} repeats every {entry.period:.4g} {unit}"),
            markup=False,
        )
