"""Blocks of a section of the page: functions that return HTML in which all text is escaped."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from markupsafe import Markup

from pincal.notes import Note, doubts_of


class PageBlock(Protocol):
    """A block of the page: the return value of these functions, or a
    :class:`pincal.result_table.Table`.
    """

    def __html__(self) -> str:
        """Return the block as HTML."""


def merged(blocks: Iterable[PageBlock | str], between: str = "") -> Markup:
    """Return blocks or texts as one, texts escaped."""
    return Markup(between).join(blocks)


def rich(text: str, *values: object) -> Markup:
    """Return text with mark-up of its own and values that are escaped unless they are mark-up
    themselves.

    Example:
        >>> rich("<b>{}</b> of {}", "a < b", code("c"))
        Markup('<b>a &lt; b</b> of <code>c</code>')
    """
    return Markup(text).format(*values)


def code(text: object) -> Markup:
    """Return text as code."""
    return rich("<code>{}</code>", text)


RESULT = "result.json#"
"""The file of a calibration, before JSON pointers into it."""


def in_pointer(key: str) -> str:
    """Return a key as a JSON pointer has it (RFC 6901).

    Example:
        >>> in_pointer("mean_m/s^2")
        'mean_m~1s^2'
    """
    return key.replace("~", "~0").replace("/", "~1")


def sourced(text: str, *pointers: str, times: float = 1.0, over: str = "") -> Markup:
    """Return text whose numbers are entries of a file beside the page, in the order of the pointers
    to these (RFC 6901); perhaps multiplied, or over another entry.

    Example:
        >>> sourced("1.5 mm", "result.json#/error/nominal/test/mean_mm")
        Markup('<span data-from="result.json#/error/nominal/test/mean_mm">1.5 mm</span>')
    """
    factor = rich(' data-times="{:g}"', times) if times != 1.0 else Markup("")
    below = rich(' data-over="{}"', over) if over else ""
    return rich('<span data-from="{}"{}{}>{}</span>', " ".join(pointers), factor, below, text)


def folded(words: str, *blocks: PageBlock) -> Markup:
    """Return blocks that are hidden until the reader opens them, under what they are in words."""
    return rich("<details><summary>{}</summary>\n{}\n</details>", words, merged(blocks, "\n"))


def paragraph(text: str, tone: str = "") -> Markup:
    """Return a paragraph; its tone may be "note", "doubt", "mute" or "care"."""
    return rich(f'<p class="{tone}">{{}}</p>' if tone else "<p>{}</p>", text)


def doubts(notes: Iterable[Note]) -> Iterator[Markup]:
    """Yield the doubts about a result, which come before everything else."""
    for doubt in doubts_of(notes):
        yield paragraph(rich("<b>Doubt:</b> {}", doubt.text), "doubt")


def plain_notes(notes: Iterable[Note]) -> Iterator[Markup]:
    """Yield the notes that are not doubts."""
    for note in notes:
        if not note.is_doubt:
            yield paragraph(note.text, "note")


def heading(text: str, anchor: str = "") -> Markup:
    """Return a heading within a section."""
    return rich(f'<h3 id="{anchor}">{{}}</h3>' if anchor else "<h3>{}</h3>", text)


def bullets(items: Iterable[str]) -> Markup:
    """Return a list."""
    return rich("<ul>{}</ul>", merged(rich("<li>{}</li>", item) for item in items))


def facts(items: Iterable[tuple[str, str]]) -> Markup:
    """Return names with a remark on each."""
    lines = merged((rich("<dt>{}</dt><dd>{}</dd>", name, text) for name, text in items), "\n")
    return rich('<dl class="facts">\n{}\n</dl>', lines)


def card(title: str, *blocks: PageBlock) -> Markup:
    """Return a short box with a title; several are side by side in a group of "cards"."""
    return rich('<div class="card"><h3>{}</h3>{}</div>', title, merged(blocks))


def arranged(kind: str, *blocks: PageBlock) -> Markup:
    """Return blocks that the page arranges together: "cards", "split", "glance" or "figures";
    "plain" in a column.
    """
    return rich(f'<div class="{kind}">\n{{}}\n</div>', merged(blocks, "\n"))


def glance(
    entries: Sequence[tuple[str, tuple[float, float], tuple[str, ...]]],
) -> Iterator[Markup]:
    """Yield statistics before and after as numbers and as bars of one scale.

    Args:
        entries: for each a title, its values before and after in one unit, and these as text.
    """
    largest = max((max(values) for _, values, _ in entries), default=0.0) or 1.0
    row = (
        '<div class="bar"><span>{0}</span><span class="track"><span class="{0}" '
        'style="width:{1:.1f}%"></span></span></div>'
    )
    for title, values, (before, after) in entries:
        both = merged(
            rich(row, name, 100.0 * value / largest)
            for name, value in zip(("before", "after"), values, strict=True)
        )
        numbers = rich(
            '<span class="big">{}</span> <span class="from">was {}</span>', after, before
        )
        yield rich("<div><h3>{}</h3>{}{}</div>", title, numbers, both)


def picture(svg: str, caption: str) -> Markup:
    """Return a figure with what one sees and how to read it, perhaps nothing; all text in the
    drawing is escaped already.
    """
    below = rich("<figcaption>{}</figcaption>", caption) if caption else ""
    return rich("<figure>{}{}</figure>", Markup(svg), below)


@dataclass(frozen=True)
class Section:
    """A part of the page: its identifier, its heading and its contents.

    The list of contents calls it ``label``, or leaves it out; the style "panel" sets it off from
    the rest.
    """

    anchor: str
    title: str
    blocks: tuple[PageBlock, ...]
    label: str = ""
    style: str = ""

    def __html__(self) -> str:
        opening = Markup(f'<section class="{self.style}">' if self.style else "<section>")
        return rich(
            '{}\n<h2 id="{}">{}</h2>\n{}\n</section>',
            opening,
            self.anchor,
            self.title,
            merged(self.blocks, "\n"),
        )
