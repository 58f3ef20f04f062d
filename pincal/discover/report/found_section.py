"""The section of a report on what a search found missing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from markupsafe import Markup

from pincal.discover.discovery_file import Findings, FoundEffect, FoundParameter, ScatteringJoint
from pincal.discover.report.found_drawings import (
    effect_drawings,
    gap_drawings,
    stability_drawings,
)
from pincal.discover.report.found_tables import by_reason, stage_table
from pincal.discover.report.found_words import (
    HINTS,
    SMOOTH_PARTS,
    bootstrap_words,
    effect_words,
    gain_words,
    line_words,
    no_effect_words,
    region_words,
    smooth_trust,
    subsample_only_words,
)
from pincal.discover.run import Discovery
from pincal.errors import counted, few
from pincal.report.blocks import (
    PageBlock,
    Section,
    arranged,
    bullets,
    card,
    code,
    folded,
    heading,
    merged,
    paragraph,
    rich,
    sourced,
)
from pincal.report.illustrations import figures
from pincal.report.words import effect_meaning
from pincal.thresholds import Count
from pincal.units import (
    format_digits,
    format_small,
    show_chance,
    show_measured,
    show_percent,
    unit_of_size,
)

# An effect with more parameters than this is a curve; its numbers are in discovery.json.
_FEW: Count = 4
# Effects that entered a model in one step, of which a card names so many others.
_TOGETHER: Count = 1
# Effects of which a page shows a card each; of more, a figure has the names, and cards are folded.
_CARDS: Count = 6


FOUND = "discovery.json#"
"""The file of a search, before JSON pointers into it."""


def found_section(discovery: Discovery) -> Section:
    """Return where model and data disagreed, which effects were found, and how the error fell."""
    found = discovery.findings
    blocks: list[PageBlock] = [
        paragraph(_noise_of_the_search(discovery)),
        folded("How effects were searched for", paragraph(_SEARCH)),
        *_located(found),
        heading("Effects found"),
        *_named(found),
        *(paragraph(_scattering(entry), "note") for entry in found.scatter),
        *_smooth(found),
        heading("How the error decreased"),
        figures("search", gap_drawings(discovery)),
        *_pose_by_pose(discovery),
    ]
    text = (
        "Each row starts from the one above; removed effects have their own rows. The shares are "
        "parts of the total reduction of the mean square error, in this order, and add up to 100 "
        "%; where the error grew they are negative."
    )
    table = stage_table(found.noise_floor_mm, discovery.gaps).without("rms over noise")
    if found.regions:
        text = f"{text} {region_words(found.regions)}."
    blocks.append(folded("Errors after each change of the model", table, paragraph(text, "mute")))
    n_joints = len(discovery.calibration.fit.problem.chain.robot.joint_names)
    untestable = by_reason(((e.effect, e.joint, e.reason) for e in found.not_testable), n_joints)
    if untestable:
        items = (rich("<b>{}</b>: {}", names, reason) for reason, names in untestable.items())
        blocks.append(folded("What could not be tested", bullets(items)))
    return Section("missing", "What was missing", tuple(blocks), "What was missing")


_SEARCH = (
    "The search starts from a simple model, locates where model and data disagree, names the "
    "effect that explains most, adds it, refits the whole model, and stops when only noise is "
    "left. A named effect fits the data; this does not prove it to be the cause."
)


def _noise_of_the_search(discovery: Discovery) -> Markup:
    """Return the noise at which a search stopped."""
    found = discovery.findings
    is_declared = discovery.calibration.fit.fit.is_declared
    noise = (
        "The noise alone"
        if is_declared
        else "The noise, estimated from the residuals of the fitted poses,"
    )
    floor = sourced(f"{found.noise_floor_mm:.4f} mm", f"{FOUND}/noise_floor_mm")
    left = f"{found.unexplained_mm:.4f} mm"
    beyond = rich("; {} rms remain beyond it", sourced(left, f"{FOUND}/unexplained_mm"))
    if not float(left.split()[0]):
        beyond = rich("; no more than it remains")
    return rich("{} amounts to {} rms{}.", noise, floor, beyond if is_declared else "")


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
    places = (
        rich(
            "<b>{}</b>, {}: {}",
            place.joint or place.region,
            sourced(show_percent(place.share), f"{FOUND}/where/{k}/share"),
            place.statement,
        )
        for k, place in enumerate(found.where)
    )
    return [folded("Where model and data disagreed", bullets(places), paragraph(text, "mute"))]


def _pose_by_pose(discovery: Discovery) -> Iterator[Markup]:
    """Yield the figures of the effects, if there are any."""
    if drawings := [*effect_drawings(discovery)]:
        words = "Each effect, pose by pose: without it and with it"
        yield folded(words, figures("effect", drawings))


def _scattering(entry: ScatteringJoint) -> str:
    return (
        f"{entry.joint} scatters by {1e3 * entry.sigma_rad:.3f} mrad from pose to "
        "pose, independently of "
        f"all recorded quantities. Record {entry.missing}: it may explain the scatter."
    )


def _smooth(found: Findings) -> Iterator[PageBlock]:
    """Yield what is smooth in the joints and has no name, if it entered the model."""
    if (smooth := found.remainder) is None:
        return
    at = f"{FOUND}/remainder"
    yield heading("Unnamed, smooth")
    parts = (
        rich(
            "<b>{}</b>, {} rms over the fitted rows, alike over {}",
            SMOOTH_PARTS[part.errs],
            sourced(format_small(part.size, part.unit), f"{at}/parts/{k}/size"),
            sourced(f"{part.length_rad:g} rad", f"{at}/parts/{k}/length_rad"),
        )
        for k, part in enumerate(smooth.parts)
    )
    yield bullets(parts)
    yield paragraph(
        rich(
            "Each region of joint space was predicted by fits of the others: {} on average with "
            "this, {} without. It is in all predictions and corrections of this model, with its "
            "uncertainty, and says nothing of causes. Its parts are smooth functions of pairs of "
            "joints; a cause that is found later takes its place.",
            sourced(f"{smooth.smooth_mm:.4f} mm", f"{at}/smooth_mm"),
            sourced(f"{smooth.named_mm:.4f} mm", f"{at}/named_mm"),
        )
    )
    yield paragraph(smooth_trust(smooth), "care" if smooth.doubtful else "mute")


def _named(found: Findings) -> Iterator[PageBlock]:
    """Yield the effects, hints separately, and in how many subsamples each is found."""
    explained = set[str]()
    sure, hints = (
        tuple(
            _card(k, entry, _step(found, entry), explained)
            for k, entry in enumerate(found.effects)
            if entry.is_hint == is_hint
        )
        for is_hint in (False, True)
    )
    counts = figures("stability", stability_drawings(found))
    is_long = len(found.effects) > _CARDS and bool(counts)
    if is_long:
        yield counts
    if sure or not hints:
        yield from _cards(sure, "effect", is_long) if sure else (paragraph(no_effect_words(found)),)
    if hints:
        yield paragraph(
            f"{HINTS}. They are in the model, but do not order spare parts because of them.", "care"
        )
        yield from _cards(hints, "hint", is_long)
    if found.only_in_halves:
        yield paragraph(f"{subsample_only_words(found)}.", "note")
    if found.bootstrap:
        yield paragraph(bootstrap_words(found.bootstrap), "mute")
    if counts and not is_long:
        yield counts


def _cards(cards: Sequence[Markup], kind: str, is_long: bool) -> Iterator[PageBlock]:
    """Yield cards side by side, folded where the page has many."""
    shown = arranged("cards", *cards)
    yield folded(f"{counted(len(cards), kind)}, one by one", shown) if is_long else shown


def _step(found: Findings, entry: FoundEffect) -> tuple[FoundEffect, ...]:
    """Return the effects that entered the model in one step with another, which is not among them:
    they share the change of the error.
    """
    gap = (entry.gap_before_mm, entry.gap_after_mm)
    return tuple(
        other
        for other in found.effects
        if other is not entry and (other.gap_before_mm, other.gap_after_mm) == gap
    )


def _card(k: int, entry: FoundEffect, others: Sequence[FoundEffect], explained: set[str]) -> Markup:
    """Return a card of the k-th effect with its parameters, the change of the error, and the
    alternatives.

    Args:
        k: its place among the effects.
        entry: the effect.
        others: what entered the model together with it.
        explained: effects whose meaning another card gives already; this one's is added.
    """
    at = f"{FOUND}/effects/{k}"
    often = f" The search names it {entry.stability.words}." if entry.stability else ""
    is_new = entry.effect not in explained
    explained.add(entry.effect)
    blocks = [
        *([paragraph(effect_meaning(entry.effect), "mute")] if is_new else []),
        paragraph(merged((_gain(at, entry, others), rich("{}", often)), "")),
    ]
    if entry.equivalent:
        alternatives = "; ".join(effect_words(other) for other in entry.equivalent)
        blocks.append(paragraph(f"Could also be: {alternatives}.", "care"))
    return card(effect_words(entry), *blocks, folded("Values", *_values(at, entry)))


def _values(at: str, entry: FoundEffect) -> Iterator[Markup]:
    """Yield the values of the parameters of an effect, what its order suggests, and what would
    distinguish it from its alternatives.
    """
    values = entry.parameters
    if len(values) <= _FEW:
        lines = (
            rich(
                '{} = <span class="nw">{}</span>',
                code(name),
                _measured(p, f"{at}/parameters/{name}"),
            )
            for name, p in values.items()
        )
        yield paragraph(merged(lines, "<br>"))
    else:
        kind = "smooth function" if entry.shape == "field" else "curve"
        yield paragraph(f"a {kind} with {len(values)} parameters, see the figure")
    if words := line_words(entry):
        yield paragraph(f"{words[0].upper()}{words[1:]}.")
    if entry.equivalent and entry.tell_apart:
        yield paragraph(f"To distinguish it from its alternatives: {entry.tell_apart}.")


def _gain(at: str, entry: FoundEffect, others: Sequence[FoundEffect]) -> Markup:
    """Return by how much an effect, with what entered the model together with it, reduced the
    error, and its p-value.
    """
    names = [effect_words(other) for other in others]
    together = f", together with {few(names, _TOGETHER)}" if names else ""
    return rich(
        'mean held-out error {}{}; p-value: <span class="nw">{}</span>.',
        sourced(gain_words(entry), *_gain_pointers(at, entry)),
        together,
        sourced(show_chance(entry.p_value), f"{at}/p_value"),
    )


def _gain_pointers(at: str, entry: FoundEffect) -> list[str]:
    """Return the pointers to the numbers of :func:`gain_words`."""
    units = ("mm",) if entry.gap_before_mrad is None else ("mm", "mrad")
    return [f"{at}/gap_{when}_{unit}" for unit in units for when in ("before", "after")]


def _measured(p: FoundParameter, at: str) -> Markup:
    """Return a value with half of its 95 % interval to two digits, in a readable unit."""
    unit = unit_of_size(max(abs(p.value), p.sigma or 0.0), p.unit)
    if not p.sigma:
        return sourced(f"{format_digits(p.value * unit.factor)} {unit.name}", f"{at}/value")
    words = show_measured(p.value, p.sigma, unit)
    return sourced(f"{words} {unit.name} (95 %)", f"{at}/value", f"{at}/sigma")
