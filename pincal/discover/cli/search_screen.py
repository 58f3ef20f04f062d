"""What a search found, as text that fits 100 columns."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

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
    no_effect_words,
    region_words,
    smooth_words,
    subsample_only_words,
)
from pincal.discover.report.search_answer import SearchAnswer
from pincal.discover.run import Discovery
from pincal.errors import counted
from pincal.model.effect import Family
from pincal.model.effect_registry import EFFECTS
from pincal.report.judgement import judged
from pincal.result_table import hanging, one_line
from pincal.units import format_joint, show_chance

# Of a model that has more than names, which its errors are with.
_REST = "; and a smooth remainder without a name"


def summary_of_search(discovery: Discovery) -> tuple[str, ...]:
    """Return all effects that were found in words: with their evidence, without, by joint alone,
    with the hints counted, by kind, and all counted; and that there is a remainder without a name,
    if the model has one.
    """
    rest = discovery.findings.remainder is not None
    effects = discovery.findings.effects
    if not effects:
        none = no_effect_words(discovery.findings)
        return (f"t{none[1:-1]}{_REST if rest else ''}",)
    return tuple(f"{of}{_REST}" if rest else of for of in _forms(effects))


def _forms(effects: Sequence[FoundEffect]) -> tuple[str, ...]:
    """Return effects in words, in full and ever shorter."""
    # Elasticity, which every arm has, comes after other effects, and hints come last.
    elastic = [name for name, cls in EFFECTS.known().items() if cls.family is Family.ELASTICITY]
    named = sorted(effects, key=lambda e: (e.is_hint, e.effect in elastic))
    return (
        _listed(named, _evidence(named)),
        _listed(named, [""] * len(named)),
        _by_joint(named),
        _by_joint([entry for entry in named if not entry.is_hint], _hints(named)),
        _by_kind(named),
        f"{counted(len(named), 'effect')}, listed in the report",
    )


def _listed(named: Sequence[FoundEffect], evidence: Sequence[str]) -> str:
    """Return effects in words, those of one kind together."""
    groups: dict[str, list[str]] = {}
    for entry, known in zip(named, evidence, strict=True):
        doubtful = "perhaps " if entry.is_hint else ""
        is_plain = bool(entry.joint) and effect_words(entry) == f"{entry.effect} of {entry.joint}"
        group = f"{doubtful}{entry.effect} of " if is_plain else f"{doubtful}{effect_words(entry)}"
        groups.setdefault(group, []).append(f"{entry.joint if is_plain else ''}{known}")
    return "; ".join(
        f"{group}{', '.join(filter(None, places))}" for group, places in groups.items()
    )


def _hints(named: Sequence[FoundEffect]) -> str:
    """Return how many effects are hints alone, and where they are listed; "" for none."""
    hints = sum(entry.is_hint for entry in named)
    return f"{counted(hints, 'hint')} in the report" if hints else ""


def _by_joint(named: Sequence[FoundEffect], rest: str = "") -> str:
    """Return effects by their names in the catalogue and their joints alone, and what else there is
    behind them.
    """
    groups = dict[str, Counter[str]]()
    for entry in named:
        doubtful = "perhaps " if entry.is_hint else ""
        groups.setdefault(f"{doubtful}{entry.effect}", Counter())[entry.joint or ""] += 1
    words = [
        f"{name} of {', '.join(_times(joint, n) for joint, n in joints.items())}"
        if all(joints)
        else name
        for name, joints in groups.items()
    ]
    return "; ".join([*words, rest] if rest else words)


def _by_kind(named: Sequence[FoundEffect]) -> str:
    """Return on how many joints each kind of effect is, and how many are hints alone."""
    sure = Counter(entry.effect for entry in named if not entry.is_hint)
    kinds = [f"{name} ({n} times)" if n > 1 else name for name, n in sure.items()]
    return "; ".join(filter(None, [*kinds, _hints(named)]))


def _times(joint: str, n: int) -> str:
    """Return a joint, and how often it has an effect if more than once."""
    return joint if n == 1 else f"{joint} ({n} times)"


def _evidence(named: Sequence[FoundEffect]) -> list[str]:
    """Return by what each effect is known, shortly: in how many subsamples it was found, or else
    its chance.
    """
    words: list[str] = []
    for entry in named:
        found = entry.stability
        if found is None:
            words.append(f" (p {show_chance(entry.p_value)})")
            continue
        rest = f", an alternative in {found.alternatives}" if found.alternatives else ""
        whole = f"{found.named}" if words else f"in {found.named} of {found.of} subsamples"
        words.append(f" ({whole}{rest})")
    return words


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
    _print_nameless(findings, out)
    joints = found.calibration.fit.problem.chain.robot.joint_names
    lost = ((e.effect, e.joint, e.reason) for e in findings.not_testable)
    for line in not_testable(lost, len(joints)):
        out.print(line)


def _print_nameless(findings: Findings, out: Console) -> None:
    """Print what scatters, and what is smooth and has no name."""
    for scatter in findings.scatter:
        text = (
            f"{scatter.joint} scatters by {scatter.sigma_rad * 1e3:.3f} mrad; record "
            f"{scatter.missing}"
        )
        out.print(one_line(text), markup=False)
    if findings.remainder is not None:
        out.print(hanging("unnamed, smooth", smooth_words(findings.remainder)))
    if findings.regions:
        out.print(hanging("regions", region_words(findings.regions)))


def _print_effects(findings: Findings, out: Console) -> None:
    """Print the tables of the effects found and of the hints."""
    named = [entry for entry in findings.effects if not entry.is_hint]
    hints = [entry for entry in findings.effects if entry.is_hint]
    if named or not hints:
        out.print(found_tables.effect_table(named) if named else no_effect_words(findings))
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
        how_far = format_joint(entry.period, entry.period_unit or "rad")
        out.print(one_line(f"{effect_words(entry)} repeats every {how_far}"), markup=False)
