"""The figures of a search, each with a caption that explains how to read it."""

from __future__ import annotations

from collections.abc import Iterator

from pincal.discover.discovery_file import Findings
from pincal.discover.report.found_figures import (
    effect_figure,
    map_figure,
    shrinking_figure,
    stability_figure,
)
from pincal.discover.report.found_words import effect_words
from pincal.discover.run import Discovery
from pincal.discover.shrink import PartialResidual
from pincal.report.illustrations import Drawing
from pincal.validate.misfit import SURE


def stability_drawings(findings: Findings) -> Iterator[Drawing]:
    """Yield in how many subsamples each name is found; nothing without subsamples."""
    pairs = [(effect_words(entry), entry.stability) for entry in findings.effects]
    pairs += [(effect_words(entry), entry.stability) for entry in findings.only_in_halves]
    often = {words: stability for words, stability in pairs if stability is not None}
    if not often:
        return
    counts = {words: stability.named for words, stability in often.items()}
    of = max(s.of for s in often.values())
    caption = (
        f"The search repeated on {of} subsamples of {findings.poses_in_a_half} poses "
        "each, whole regions of joint space "
        "left out. Names to the left of the line are hints: other poses may well give another name."
    )
    yield (
        stability_figure(counts, of, SURE),
        "Number of subsamples in which each name is found",
        caption,
    )


def discovery_drawings(discovery: Discovery) -> Iterator[Drawing]:
    """Yield the error step by step, and the residuals without and with each effect."""
    yield from gap_drawings(discovery)
    yield from effect_drawings(discovery)


def gap_drawings(discovery: Discovery) -> Iterator[Drawing]:
    """Yield the error step by step."""
    gaps = discovery.gaps
    sizes = {name: [getattr(gap, f"{name}_mm") for gap in gaps] for name in ("mean", "rms", "max")}
    caption = (
        "Error on poses used neither by the fit nor by the search, after each step from top to "
        "bottom. The vertical line marks the noise of the instrument."
    )
    figure = shrinking_figure([gap.name for gap in gaps], sizes, discovery.findings.noise_floor_mm)
    yield figure, "Error on held-out rows after each step", caption


def effect_drawings(discovery: Discovery) -> Iterator[Drawing]:
    """Yield the residuals without and with each effect."""
    for trace in discovery.traces:
        yield from _drawings_of(trace)


def _drawings_of(trace: PartialResidual) -> Iterator[Drawing]:
    """Yield the residuals without and with an effect, and its map if it is one of two joints."""
    title = trace.title
    caption = (
        f"{title}: error against {trace.variable} with the effect removed from the final model "
        "(above) and included (below). Small dots are poses, dots with bars the mean of "
        "neighbouring poses, the line the fitted effect. In the lower panel the bars should "
        "include zero."
    )
    yield (
        effect_figure(trace, title),
        f"{title}: error against {trace.variable}, without and with it",
        caption,
    )
    if trace.own is not None:
        caption = (
            f"{title}: error of {trace.joint} over its own position and that of "
            f"{trace.variable}, where poses were measured: without the effect (left), and the "
            "fitted effect (right), on the same scale."
        )
        yield (
            map_figure(trace, title),
            f"{title}: map over the positions of both joints",
            caption,
        )
