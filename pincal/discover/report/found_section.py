"""The section of a report on what a search found missing."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from markupsafe import Markup

from pincal.discover.discovery_file import Findings, FoundEffect, FoundParameter, ScatteringJoint
from pincal.discover.report.found_drawings import discovery_drawings, stability_drawings
from pincal.discover.report.found_tables import by_reason, location_table, stage_table
from pincal.discover.report.found_words import (
    HINTS,
    bootstrap_words,
    effect_words,
    gain_words,
    line_words,
    subsample_only_words,
)
from pincal.discover.run import Discovery
from pincal.report.blocks import (
    PageBlock,
    Section,
    arranged,
    bullets,
    card,
    code,
    heading,
    merged,
    paragraph,
    rich,
)
from pincal.report.illustrations import figures
from pincal.report.words import effect_meaning
from pincal.thresholds import Count
from pincal.units import format_digits, show_chance, small_unit

# An effect with more parameters than this is a curve; its numbers are in discovery.json.
_FEW: Count = 4


def found_section(discovery: Discovery) -> Section:
    """Return where model and data disagreed, which effects were found, and how the error fell."""
    found = discovery.findings
    blocks: list[PageBlock] = [
        paragraph(_of_the_search(discovery)),
        *_located(found),
        heading("Effects found"),
        *_named(found),
        *(paragraph(_scattering(entry), "note") for entry in found.scatter),
        heading("How the error decreased"),
        figures("search", discovery_drawings(discovery)),
    ]
    text = (
        "Each row starts from the one above; removed effects have their own rows. The shares are "
        "parts of the total reduction of the mean square error, in this order, and add up to 100 "
        "%; where the error grew they are negative."
    )
    blocks += [stage_table(found.noise_floor_mm, discovery.gaps), paragraph(text, "mute")]
    n_joints = len(discovery.calibration.fit.problem.chain.robot.joint_names)
    untestable = by_reason(((e.effect, e.joint, e.reason) for e in found.not_testable), n_joints)
    if untestable:
        items = (rich("<b>{}</b>: {}", names, reason) for reason, names in untestable.items())
        blocks += [heading("What could not be tested"), bullets(items)]
    return Section("missing", "What was missing", tuple(blocks), "What was missing")


def _of_the_search(discovery: Discovery) -> str:
    """Return how a search works, and the noise at which it stopped."""
    found = discovery.findings
    is_declared = discovery.calibration.fit.fit.is_declared
    noise = (
        "The noise alone"
        if is_declared
        else "The noise, estimated from the residuals of the fitted poses,"
    )
    beyond = f"; {found.unexplained_mm:.4f} mm rms remain beyond it" if is_declared else ""
    return (
        "The search starts from a simple model, locates where model and data disagree, names the "
        "effect that explains most, adds it, refits the whole model, and stops when only noise is "
        f"left. {noise} amounts to {found.noise_floor_mm:.4f} mm rms{beyond}. A named effect fits "
        "the data; this does not prove it to be the cause."
    )


def _located(found: Findings) -> list[PageBlock]:
    """Return where model and data disagreed, if anywhere."""
    if not found.where:
        return []
    text = (
        "Shares of the residuals in excess of the noise. The share of elasticity is of the "
        "residuals of the geometric model, those of joints are of the residuals of the elastic "
        "one, in sequence, so that nothing is counted twice. Regions show the same error by "
        "location."
    )
    return [
        heading("Where model and data disagreed"),
        location_table(found.where),
        paragraph(text, "mute"),
    ]


def _scattering(entry: ScatteringJoint) -> str:
    return (
        f"{entry.joint} scatters by {1e3 * entry.sigma_rad:.3f} mrad from pose to "
        "pose, independently of "
        f"all recorded quantities. Record {entry.missing}: it may explain the scatter."
    )


def _named(found: Findings) -> Iterator[PageBlock]:
    """Yield the effects, hints separately, and in how many subsamples each is found."""
    sure, hints = (
        tuple(_card(entry) for entry in found.effects if entry.is_hint == is_hint)
        for is_hint in (False, True)
    )
    if sure or not hints:
        yield arranged("cards", *sure) if sure else paragraph("These data show no missing effect.")
    if hints:
        yield paragraph(
            f"{HINTS}. They are in the model, but do not order spare parts because of them.", "care"
        )
        yield arranged("cards", *hints)
    if found.only_in_halves:
        yield paragraph(f"{subsample_only_words(found)}.", "note")
    if found.bootstrap:
        yield paragraph(bootstrap_words(found.bootstrap), "mute")
    if drawings := [*stability_drawings(found)]:
        yield figures("stability", drawings)


def _card(entry: FoundEffect) -> Markup:
    """Return a card of an effect with its parameters, the change of the error, and the
    alternatives.
    """
    values = entry.parameters
    shown = merged(
        (
            rich('{} = <span class="nw">{}</span>', code(name), _measured(p))
            for name, p in values.items()
        ),
        "<br>",
    )
    explained = rich(
        'mean held-out error {}; p-value: <span class="nw">{}</span>',
        *(gain_words(entry), show_chance(entry.p_value)),
    )
    often = f" The search names it {entry.stability} subsamples." if entry.stability else ""
    blocks = [
        paragraph(effect_meaning(entry.effect), "mute"),
        paragraph(
            shown
            if len(values) <= _FEW
            else f"a curve with {len(values)} parameters, see the figure"
        ),
        paragraph(merged((explained, rich("{}", often)), "")),
    ]
    if words := line_words(entry):
        blocks.append(paragraph(f"{words[0].upper()}{words[1:]}."))
    if entry.equivalent:
        others = "; ".join(effect_words(other) for other in entry.equivalent)
        decide = f" To distinguish them: {entry.tell_apart}." if entry.tell_apart else ""
        blocks.append(paragraph(f"Could also be: {others}.{decide}", "care"))
    return card(effect_words(entry), *blocks)


def _measured(p: FoundParameter) -> str:
    """Return a value with its standard deviation to two digits, in a readable unit."""
    factor, name = small_unit(p.unit)
    if not p.sigma:
        return f"{format_digits(p.value * factor)} {name}"
    places = max(0, 1 - int(np.floor(np.log10(p.sigma * factor))))
    return f"{p.value * factor:z.{places}f} ± {p.sigma * factor:.{places}f} {name}"
