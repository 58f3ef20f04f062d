"""What a section of the page is made of. Every block turns itself into HTML, and all text in it is escaped."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, Protocol

from markupsafe import Markup

from pincal.tables import Tone


class Block(Protocol):
    """Anything that can stand on the page: a block of this module, or a :class:`pincal.tables.Table`."""

    def __html__(self) -> str:
        """Return the block as HTML."""


def joined(blocks: Iterable[Block | str], between: str = "") -> Markup:
    """Return blocks or texts as one, texts escaped."""
    return Markup(between).join(blocks)


def bold(text: object) -> Markup:
    """Return text in bold."""
    return Markup("<b>{}</b>").format(text)


def code(text: object) -> Markup:
    """Return text as code."""
    return Markup("<code>{}</code>").format(text)


def rich(text: str, *values: object) -> Markup:
    """Return text with mark-up of its own and values that are escaped unless they are mark-up themselves.

    Example:
        >>> rich("<b>{}</b> of {}", "a < b", code("c"))
        Markup('<b>a &lt; b</b> of <code>c</code>')
    """
    return Markup(text).format(*values)


def _element(tag: str, text: object, *, mark: str = "") -> Markup:
    return Markup(f"<{tag}{mark}>{{}}</{tag}>").format(text)


@dataclass(frozen=True)
class Paragraph:
    """A paragraph; a note is set off from the text."""

    text: str
    tone: Literal["", "note", "mute", "care"] = ""

    def __html__(self) -> str:
        return _element("p", self.text, mark=f' class="{self.tone}"' if self.tone else "")


@dataclass(frozen=True)
class Heading:
    """A heading within a section."""

    text: str
    anchor: str = ""

    def __html__(self) -> str:
        return _element("h3", self.text, mark=f' id="{self.anchor}"' if self.anchor else "")


@dataclass(frozen=True)
class Bullets:
    """A list."""

    items: tuple[str, ...]

    def __html__(self) -> str:
        return rich("<ul>{}</ul>", joined(rich("<li>{}</li>", item) for item in self.items))


@dataclass(frozen=True)
class Facts:
    """Names with what is to be said of each."""

    items: tuple[tuple[str, str], ...]

    def __html__(self) -> str:
        items = joined((rich("<dt>{}</dt><dd>{}</dd>", name, text) for name, text in self.items), "\n")
        return rich('<dl class="facts">\n{}\n</dl>', items)


@dataclass(frozen=True)
class Card:
    """A short titled box; several stand side by side."""

    title: str
    blocks: tuple[Block, ...]

    def __html__(self) -> str:
        return rich('<div class="card"><h3>{}</h3>{}</div>', self.title, joined(self.blocks))


@dataclass(frozen=True)
class Group:
    """Blocks that the page arranges together: cards in a grid, columns side by side, or plain."""

    kind: Literal["cards", "split", "glance", "plain"]
    blocks: tuple[Block, ...]

    def __html__(self) -> str:
        return rich('<div class="{}">\n{}\n</div>', self.kind, joined(self.blocks, "\n"))


@dataclass(frozen=True)
class Tag:
    """A verdict in a word, coloured, with a sentence behind it."""

    word: str
    tone: Tone
    text: str

    def __html__(self) -> str:
        return rich('<p><span class="tag {}">{}</span> {}</p>', self.tone, self.word, self.text)


@dataclass(frozen=True)
class Bars:
    """One statistic before and after as numbers and bars.

    Attributes:
        title: of the statistic.
        before: as text, with its unit.
        after: likewise.
        shares: lengths of both bars, in percent.
    """

    title: str
    before: str
    after: str
    shares: tuple[float, float]

    def __html__(self) -> str:
        track = '<span class="track"><span class="{0}" style="width:{1:.1f}%"></span></span>'
        bars = joined(
            rich(f'<div class="bar"><span>{{0}}</span>{track}</div>', name, share)
            for name, share in zip(("before", "after"), self.shares, strict=True)
        )
        numbers = rich('<span class="big">{}</span> <span class="from">was {}</span>', self.after, self.before)
        return rich("<div><h3>{}</h3>{}{}</div>", self.title, numbers, bars)


@dataclass(frozen=True)
class Picture:
    """One figure.

    Attributes:
        svg: the drawing, all text in it escaped.
        caption: what one sees and how to read it.
    """

    svg: str
    caption: str

    def __html__(self) -> str:
        caption = rich("<figcaption>{}</figcaption>", self.caption) if self.caption else ""
        return rich("<figure>{}{}</figure>", Markup(self.svg), caption)


@dataclass(frozen=True)
class Figures:
    """Figures side by side where there is room."""

    pictures: tuple[Picture, ...]

    def __html__(self) -> str:
        return rich('<div class="figures">\n{}\n</div>', joined(self.pictures, "\n")) if self.pictures else ""


@dataclass(frozen=True)
class Section:
    """A part of the page.

    Attributes:
        anchor: its identifier in the page.
        title: its heading.
        label: what the list of contents calls it; empty to leave it out.
        blocks: its contents.
        is_panel: whether it is set off from the rest.
    """

    anchor: str
    title: str
    label: str
    blocks: tuple[Block, ...]
    is_panel: bool = False

    def __html__(self) -> str:
        opening = Markup('<section class="panel">') if self.is_panel else Markup("<section>")
        return rich('{}\n<h2 id="{}">{}</h2>\n{}\n</section>', opening, self.anchor, self.title, joined(self.blocks, "\n"))
