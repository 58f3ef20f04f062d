"""Tables of results as data, for terminals, web pages, notebooks and other programs."""

from __future__ import annotations

import csv
import html
import io
import re
import unicodedata
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING, Any, Literal

from pincal.errors import BadInputError, nearest_first
from pincal.thresholds import Count
from pincal.units import Quantity, show_plainly

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.table import Table as RichTable


Cell = str | float | int | Quantity | None
RowTone = Literal["", "good", "care", "bad", "mute"]


class Kind(Enum):
    """Contents of a column, which determine alignment and wrapping."""

    TEXT = "text"
    LABEL = "label"
    """Short text, never wrapped."""
    NAME = "name"
    """Names from files, of any length, wrapped anywhere."""
    NUMBER = "number"
    STATUS = "status"
    """Short text in the colour of its row."""
    REMARK = "remark"
    """Long text, often the same in several rows: numbered footnotes on a terminal, a column
    elsewhere.
    """


@dataclass(frozen=True)
class Column:
    """One column of a table.

    Attributes:
        name: the heading.
        unit: of all its numbers, shown in the heading; empty where rows differ or have none.
        kind: determines alignment and wrapping.
        show: formats a cell as text.
        key: entry of the result's file that its cells show, within that of the row; empty for none.
    """

    name: str
    unit: str = ""
    kind: Kind = Kind.TEXT
    show: Callable[[Any], str] = show_plainly
    key: str = ""

    @property
    def heading(self) -> str:
        """Name and unit."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


# Width of plain text.
_WIDTH: Count = 100
# Names are not broken up to this fraction of the width.
_NARROWEST: Count = 4
# Letters that fit beside each other on a phone, those between columns, and the most that a name or
# words in lines take.
_PHONE: Count = 54
_BETWEEN: Count = 2
_IN_LINES: Count = 16
_STYLES: dict[str, str] = {"": "", "good": "", "care": "yellow", "bad": "red", "mute": "dim"}
_CLASSES = {
    Kind.LABEL: "nw",
    Kind.NAME: "name",
    Kind.NUMBER: "n",
    Kind.STATUS: "nw status",
    Kind.REMARK: "wide mute",
}


@dataclass(frozen=True, repr=False)
class Table:
    """A table of results.

    Attributes:
        title: its title.
        columns: its columns.
        rows: cells as data, one tuple per row, as long as ``columns``.
        notes: remarks on the whole table, one paragraph each.
        tones: emphasis of each row; empty for none.
        sources: where a page finds the numbers of each row: the JSON pointer (RFC 6901) of its
            entry in a file, with {} for the key of the column; empty for none.

    Example:
        >>> from pincal.units import fixed
        >>> columns = (Column("model"), Column("mean", "mm", Kind.NUMBER, fixed(3)))
        >>> print(Table("Errors", columns, (("nominal", 1.25),)))
        Errors
        model     mean [mm]
        -------------------
        nominal       1.250
    """

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    notes: tuple[str, ...] = ()
    tones: tuple[RowTone, ...] = ()
    sources: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.rows)

    def __repr__(self) -> str:
        return str(self)

    def without(self, *names: str) -> Table:
        """Return the table without some columns."""
        kept = [i for i, column in enumerate(self.columns) if column.name not in names]
        rows = tuple(tuple(row[i] for i in kept) for row in self.rows)
        return replace(self, columns=tuple(self.columns[i] for i in kept), rows=rows)

    def texts(self) -> list[list[str]]:
        """Return all cells as formatted text."""
        return [
            [column.show(cell) for column, cell in zip(self.columns, row, strict=True)]
            for row in self.rows
        ]

    def records(self) -> list[dict[str, Any]]:
        """Return the rows as dictionaries by heading, quantities as numbers in SI units."""
        return [
            {
                c.heading: x.value if isinstance(x, Quantity) else x
                for c, x in zip(self.columns, row, strict=True)
            }
            for row in self.rows
        ]

    def row(self, name: str) -> dict[str, Any]:
        """Return the row with this name in its first column, as :meth:`records` returns it.

        Raises:
            BadInputError: if there is none.
        """
        names = [str(row[0]) for row in self.rows]
        if name not in names:
            near = ", ".join(nearest_first([name], names)[:6])
            raise BadInputError(f"no row {name!r} in {self.title!r}; nearest first: {near}")
        k = names.index(name)
        return replace(self, rows=self.rows[k : k + 1]).records()[0]

    def to_csv(self) -> str:
        """Return the data as comma-separated values with a line of headings; quantities in SI
        units, full precision.
        """
        written = io.StringIO()
        writer = csv.writer(written, lineterminator="\n")
        writer.writerow(column.heading for column in self.columns)
        writer.writerows(
            ["" if x is None else x for x in record.values()] for record in self.records()
        )
        return written.getvalue()

    def to_pandas(self) -> pd.DataFrame:
        """Return the data as a pandas frame; needs pandas."""
        import pandas

        return pandas.DataFrame(self.records(), columns=[column.heading for column in self.columns])

    def to_polars(self) -> pl.DataFrame:
        """Return the data as a polars frame."""
        import polars

        columns = {
            column.heading: [record[column.heading] for record in self.records()]
            for column in self.columns
        }
        return polars.DataFrame(columns, strict=False)

    def to_html(self, *, caption: bool = True) -> str:
        """Return the table as an HTML element with all text escaped.

        Args:
            caption: whether to show the title above the table.
        """
        title = html.escape(one_line(self.title))
        texts_of_rows = self.texts()
        is_wide = self._is_wide(texts_of_rows)
        many = ' class="many"' if is_wide else ""
        out = [f'<div class="scroll" tabindex="0" role="region" aria-label="{title}"><table{many}>']
        out += [f"<caption>{title}</caption>"] if caption else []
        out.append(_html_row("th", "", self.columns, [column.heading for column in self.columns]))
        blank = [""] * len(self)
        for texts, tone, source in zip(
            texts_of_rows, self.tones or blank, self.sources or blank, strict=True
        ):
            out.append(_html_row("td", tone, self.columns, texts, source, labelled=is_wide))
        out.append("</table></div>")
        out += [f'<p class="mute">{html.escape(note)}</p>' for note in self.notes]
        return "\n".join(out)

    def _is_wide(self, rows: Sequence[Sequence[str]]) -> bool:
        """Whether it is wider than a phone, which shows each row as lines, its cells behind their
        headings.
        """
        letters = 0
        for column, *texts in zip(self.columns, *rows, strict=True):
            longest = max(map(len, [column.heading, *texts]))
            in_lines = column.kind in (Kind.NAME, Kind.TEXT, Kind.REMARK)
            letters += _BETWEEN + (min(longest, _IN_LINES) if in_lines else longest)
        return letters > _PHONE

    def __html__(self) -> str:
        """Return the table without a caption, for a template with its own heading."""
        return self.to_html(caption=False)

    def _repr_html_(self) -> str:
        return self.to_html()

    def __str__(self) -> str:
        from rich.console import Console

        console = Console(width=_WIDTH, file=io.StringIO(), force_terminal=False)
        with console.capture() as written:
            console.print(self)
        return "\n".join(line.rstrip() for line in written.get().splitlines()).strip("\n")

    def __rich_console__(
        self, console: Console, options: ConsoleOptions
    ) -> Iterator[RenderableType]:
        """Yield the table with remarks as footnotes: with lines and colours on a terminal, as plain
        text elsewhere.
        """
        yield from _rendered(self, width=options.max_width, is_terminal=console.is_terminal)


def one_line(text: str) -> str:
    r"""Return text without line breaks and control characters.

    Example:
        >>> one_line("[red]a\nb")
        '[red]a b'
    """
    return "".join(" " if unicodedata.category(c) in ("Cc", "Cf", "Zl", "Zp") else c for c in text)


def _html_row(
    tag: str,
    tone: str,
    columns: Sequence[Column],
    texts: Sequence[str],
    source: str = "",
    *,
    labelled: bool = False,
) -> str:
    classes = [_CLASSES.get(column.kind, "") for column in columns]
    if tag == "th":
        classes = ["n" if name == "n" else "" for name in classes]
    marks = [f' class="{name}"' if name else "" for name in classes]
    if labelled:
        marks = [
            mark + f' data-label="{html.escape(column.heading)}"' * bool(text.strip("- "))
            for mark, column, text in zip(marks, columns, texts, strict=True)
        ]
    if source:
        marks = [
            mark + (f' data-from="{html.escape(_pointers(source, column.key))}"' * bool(column.key))
            for mark, column in zip(marks, columns, strict=True)
        ]
    shown = [
        _breakable(text) if column.kind is Kind.NAME and tag == "td" else html.escape(text)
        for column, text in zip(columns, texts, strict=True)
    ]
    cells = "".join(f"<{tag}{mark}>{text}</{tag}>" for mark, text in zip(marks, shown, strict=True))
    return f'<tr class="{tone}">{cells}</tr>' if tone else f"<tr>{cells}</tr>"


def _breakable(name: str) -> str:
    """Return a name for a page, which may be broken behind its dots, slashes and underscores.

    Example:
        >>> _breakable("tool.x"), _breakable("a<b/imu.gyro_xx")
        ('tool.<wbr>x', 'a&lt;b/<wbr>imu.<wbr>gyro_<wbr>xx')
    """
    return re.sub(r"([./_])(?=[^./_])", r"\1<wbr>", html.escape(name))


def _pointers(source: str, keys: str) -> str:
    """Return the pointers of the keys of a cell, one for each of its numbers, with spaces between.

    Example:
        >>> _pointers("result.json#/parameters/3/{}", "value sigma")
        'result.json#/parameters/3/value result.json#/parameters/3/sigma'
    """
    return " ".join(source.replace("{}", key) for key in keys.split())


def _broken_headings(
    columns: Sequence[Column], cells: Sequence[Sequence[str]], width: int
) -> list[str]:
    """Return the headings of columns with the texts of their cells, perhaps of several lines.

    Headings of many columns, such as one per joint, are broken at underscores rather than
    truncated, and before units where the cells need the space.
    """
    headings = [column.heading for column in columns]
    is_wide = sum(len(heading) + 2 for heading in headings) > width
    needed = [max(map(len, [of, *own])) + 3 for of, own in zip(headings, cells, strict=True)]
    is_full = sum(needed) > width
    if is_wide:
        headings = [heading.replace("_", "_\n") for heading in headings]
    return [heading.replace(" [", "\n[") for heading in headings] if is_full else headings


def _footnotes(remarks: Sequence[str]) -> dict[str, str]:
    """Return the mark of each remark, numbered in the order of first occurrence."""
    different = dict.fromkeys(filter(None, remarks))
    return {remark: f"({i})" for i, remark in enumerate(different, 1)}


def _frame(title: str, *, is_terminal: bool) -> RichTable:
    """Return a table for a terminal or for plain text, still without columns."""
    from rich.box import HEAVY_HEAD, Box
    from rich.table import Table as RichTable
    from rich.text import Text

    # Head and body separated by hyphens only, so that other programs can read the text.
    plain = Box("    \n    \n -- \n    \n    \n -- \n    \n    \n", ascii=True)
    return RichTable(
        title=Text("\n" + one_line(title)),
        title_justify="left",
        box=HEAVY_HEAD if is_terminal else plain,
        show_edge=is_terminal,
        pad_edge=is_terminal,
    )


def _rendered(table: Table, *, width: int, is_terminal: bool) -> Iterator[RenderableType]:
    from rich.text import Text

    drawn = _frame(table.title, is_terminal=is_terminal)
    shown = [i for i, column in enumerate(table.columns) if column.kind is not Kind.REMARK]
    texts = table.texts()
    columns = [table.columns[i] for i in shown]
    cells_of = [[row[i] for row in texts] for i in shown]
    headings = _broken_headings(columns, cells_of, width)
    for column, heading, cells in zip(columns, headings, cells_of, strict=True):
        words = (len(word) for cell in cells for word in cell.split())
        narrowest = min(max(words, default=0), width // _NARROWEST)
        drawn.add_column(
            Text(heading),
            justify="right" if column.kind is Kind.NUMBER else "left",
            no_wrap=column.kind in (Kind.LABEL, Kind.NUMBER, Kind.STATUS),
            min_width=narrowest if column.kind is Kind.NAME else None,
            overflow="fold",
        )
    remarks = [
        " ".join(row[i] for i in range(len(row)) if i not in shown and row[i]) for row in texts
    ]
    footnotes = _footnotes(remarks)
    for row, remark, tone in zip(texts, remarks, table.tones or [""] * len(table), strict=True):
        line = [Text(one_line(row[i])) for i in shown]
        line[-1].append(f" {footnotes[remark]}" if remark else "")
        drawn.add_row(*line, style=_STYLES[tone])
    yield drawn
    yield from (hanging(f"{mark:>5s}", text) for text, mark in footnotes.items())
    yield from (hanging("", note) for note in table.notes)


def hanging(mark: str, text: str) -> RenderableType:
    """Return a paragraph for a terminal with a hanging indent behind its mark."""
    from rich.table import Table as RichTable
    from rich.text import Text

    if not mark:
        return Text(one_line(text))
    grid = RichTable.grid(padding=(0, 1))
    grid.add_column(no_wrap=True, vertical="top")
    grid.add_column(overflow="fold")
    grid.add_row(Text(one_line(mark)), Text(one_line(text)))
    return grid
