"""The numbers of a page, and the entries of the files beside it that they show.

An element with ``data-from`` holds numbers, and for each the JSON pointer (RFC 6901) of the entry that it shows.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from html.parser import HTMLParser
from typing import Any

# Elements without an end.
VOID = ("meta", "br", "link", "img", "hr", "wbr")
NUMBER = re.compile(r"(?<![\w.^])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w])")
# What stands behind ± is half of a 95 % interval, in standard deviations.
INTERVAL = 1.96
# What a unit on a page is in SI units: these are few, and no business of the library's own tables.
IN_SI = {
    "mm": 1e-3, "mrad": 1e-3, "mrad/s": 1e-3, "µrad": 1e-6, "µm": 1e-6, "px": 1.0, "ppm": 1e-6, "%": 1e-2, "µrad/(N m)": 1e-6
}  # fmt: skip
# How names of entries end that are in SI units.
IN_NAMES = {"_m": "m", "_rad": "rad", "_rad_s": "rad/s"}
UNIT = "|".join(sorted(map(re.escape, IN_SI), key=len, reverse=True))


@dataclass
class Shown:
    """Text of an element, and the pointers of its numbers."""

    pointers: list[str]
    times: float
    over: str
    row: list[str]
    parts: list[str] = field(default_factory=list)
    column: str = ""

    @property
    def text(self) -> str:
        """The whole text."""
        return "".join(self.parts)

    def unit_of(self, number: str) -> str:
        """Return the unit of a number: behind it, or in the head of its column, or in a cell of its row."""
        behind = re.search(rf"{re.escape(number)}(?: ± [\d.e+-]+)? ?({UNIT})(?![a-z])", self.text)
        if behind:
            return behind[1]
        return self.column or next((text for text in self.row if text in IN_SI), "")


class PageNumbers(HTMLParser):
    """The elements of a page that show entries, and all text outside of these and of drawings."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.shown: list[Shown] = []
        self.rest: list[str] = []
        self._open: list[tuple[str, Shown | None, bool]] = []
        self._heads: list[str] = []
        self._row: list[str] = []
        self._column = 0
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Begin an element; a cell of a table has the unit of its column."""
        if tag in VOID:
            return
        found = dict(attrs)
        if tag == "table":
            self._heads = []
        elif tag == "tr":
            self._column = 0
            self._row = []
        elif tag in ("td", "th"):
            self._column += 1
        of = None
        if "data-from" in found:
            of = Shown(
                (found["data-from"] or "").split(),
                float(found.get("data-times") or 1.0),
                found.get("data-over") or "",
                self._row,
            )
            if tag == "td" and (unit := re.search(r"\[(.*)\]", self._heads[self._column - 1])):
                of.column = unit[1]
            self.shown.append(of)
        self._open.append((tag, of, tag in ("svg", "style", "script", "title")))

    def handle_endtag(self, tag: str) -> None:
        """End an element."""
        while self._open and self._open.pop()[0] != tag:
            pass

    def handle_data(self, data: str) -> None:
        """Add text to where it belongs."""
        if any(hidden for *_, hidden in self._open):
            return
        if self._open and self._open[-1][0] == "th":
            self._heads.append(data)
        if self._open and self._open[-1][0] == "td":
            self._row.append(data)
        owner = next((of for _, of, _ in reversed(self._open) if of is not None), None)
        (self.rest if owner is None else owner.parts).append(data)


def entry(pointer: str, files: Mapping[str, Any]) -> tuple[Any, str]:
    """Return an entry of a file, and its SI unit if the record that it is in has one, or its name."""
    name, _, path = pointer.partition("#/")
    at, inside = files[name], {}
    for part in path.split("/"):
        inside, key = at, part.replace("~1", "/").replace("~0", "~")
        at = at[int(key)] if isinstance(at, list) else at[key]
    unit = inside.get("unit", "") if isinstance(inside, dict) else ""
    return at, unit or next((si for end, si in IN_NAMES.items() if key.endswith(end)), "")


def disagreements(page: PageNumbers, files: Mapping[str, Any]) -> Iterator[str]:
    """Yield each number of a page that is not its entry to the digits that are shown."""
    for of in page.shown:
        numbers = NUMBER.findall(of.text)
        if len(numbers) < len(of.pointers) and of.text.strip() not in ("-", "", "infinite"):
            yield f"{of.text!r} has fewer numbers than {of.pointers}"
        for text, pointer in zip(numbers, of.pointers, strict=False):
            value, unit = entry(pointer, files)
            word = of.unit_of(text)
            # Some files have lengths in the unit of the page.
            factor = IN_SI.get(word, 1.0) if (unit and unit != word) or word == "%" else 1.0
            mantissa, _, power = text.partition("e")
            last = 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2]))
            expected = float(value) * of.times / factor
            if pointer.endswith("/sigma") and f"± {text}" in of.text:
                expected *= INTERVAL
                # It has two digits, also of 100 and more.
                last = max(last, 10.0 ** (len(mantissa) - 2)) if "." not in mantissa else last
            if of.over:
                expected /= entry(of.over, files)[0]
            if f"<{text}" in of.text:
                assert expected < float(text)
                continue
            if abs(float(f"{mantissa}e{power or 0}") - expected) > 0.5001 * last:
                yield f"{of.text!r}: {text} {word} is not {pointer}, {expected!r}"


def numbers_without_source(page: PageNumbers, said: str) -> list[str]:
    """Return the numbers with decimals that show no entry, and do not stand in texts of the files."""
    text = " ".join(page.rest)
    found = [number for number in NUMBER.findall(text) if "." in number]
    return [number for number in found if number not in said]
