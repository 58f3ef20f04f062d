"""The summary of a calibration: fourteen lines, whatever was found; what does not fit is counted,
and stands in the report.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from msgspec import UNSET
from rich.console import Console

from pincal.calibration import result_tables
from pincal.calibration.calibration import Calibration
from pincal.calibration.result import Result
from pincal.cli.screen import arm_words, error_words, held_out_words, noise_line
from pincal.errors import counted
from pincal.notes import Note, doubts_first
from pincal.report.judgement import Act, SearchReport, judged, steps_after
from pincal.report.words import elsewhere_size, elsewhere_words
from pincal.result_table import hanging, one_line
from pincal.thresholds import Count

# Lines of a summary; the last two say where more stands, and what was written.
_LINES: Count = 14
_LAST: Count = 2
# Letters of a doubt where lines are few: two of them.
_DOUBT: Count = 180

# What is shortened where lines are few, in this order.
_ORDER = (
    "note",
    "moved",
    "clock",
    "elsewhere",
    "ways",
    "evidence",
    "arm",
    "doubt",
    "worth",
    "places",
    "hints",
    "noise",
    "kinds",
    "found",
)


@dataclass
class _Part:
    """One part of a summary.

    Attributes:
        head: its name.
        text: what it says; "" leaves it out.
        shorter: what it says instead where lines are few, each behind its name in ``_ORDER``.
        style: its colour on a terminal.
        is_command: whether it is a command, which stays on one line to be copied.
    """

    head: str
    text: str
    shorter: Sequence[tuple[str, str]] = ()
    style: str = ""
    is_command: bool = False

    def lines(self, out: Console) -> int:
        """Return the number of its lines."""
        if self.is_command:
            return 1
        return len(out.render_lines(hanging(self.head, self.text))) if self.text else 0

    def print(self, out: Console) -> None:
        """Print it."""
        text = one_line(self.text)
        if self.is_command:
            out.print(f"{self.head} {text}", markup=False, soft_wrap=True)
        elif text:
            out.print(hanging(self.head, text), style=self.style, markup=False)


def print_brief(
    calibration: Calibration,
    out: Console,
    *,
    more: str,
    search: SearchReport | None = None,
    found: Sequence[str] = (),
    notes: Sequence[str] = (),
    commands: Mapping[Act, str] | None = None,
) -> None:
    """Print the summary of a calibration, and what a search for missing effects found, in at most
    thirteen lines.

    Args:
        calibration: the calibration.
        out: where to print.
        more: names further output.
        search: what the search says of the calibration; default: there was none.
        found: the effects that it found in words, in full and shorter.
        notes: on the files that were written.
        commands: what to type for each act; default: it is said in words.
    """
    told = doubts_first([*calibration.result.warnings, *notes])
    plain = [note.text for note in told if not note.is_doubt]
    note = _Part("note:   ", plain[0] if plain else "", [("note", "")], "yellow")
    parts = [
        *_doubts(told),
        *_errors(calibration),
        *_beside(calibration),
        *_found(found),
        _verdict(calibration, search),
        _next(calibration, search, commands or {}),
        note,
    ]
    _fit(parts, out, _LINES - _LAST)
    for part in parts:
        part.print(out)
    hidden = len(plain) - bool(note.text)
    rest = f"{counted(hidden, 'more note' if note.text else 'note')}, " if hidden else ""
    _Part("more    ", f"{rest}all tables: {more}", is_command=True).print(out)


def _fit(parts: Sequence[_Part], out: Console, most: int) -> None:
    """Shorten parts, one after the other, until there are no more lines than wanted."""
    cuts = [(name, part, text) for part in parts for name, text in part.shorter]
    for _, part, text in sorted(cuts, key=lambda cut: _ORDER.index(cut[0])):
        if sum(each.lines(out) for each in parts) <= most:
            return
        part.text = text


def _doubts(told: Sequence[Note]) -> Iterator[_Part]:
    """Yield the first doubt, with the number of others."""
    doubts = [note.text for note in told if note.is_doubt]
    if not doubts:
        return
    others = f" ({counted(len(doubts) - 1, 'more doubt')} in the report)" if doubts[1:] else ""
    short = doubts[0] if len(doubts[0]) <= _DOUBT else _beginning(doubts[0])
    yield _Part("doubt:", doubts[0] + others, [("doubt", short + others)], "bold red")


def _beginning(doubt: str) -> str:
    """Return the beginning of a long doubt: whole clauses if there are any.

    Example:
        >>> _beginning(f"rows differ; they were weighted; look for {'what changed ' * 20}")
        'rows differ; they were weighted ...'
    """
    head = doubt[:_DOUBT]
    return f"{head.rsplit('; ' if '; ' in head else ' ', 1)[0]} ..."


def _errors(calibration: Calibration) -> Iterator[_Part]:
    """Yield the arm, and its errors before and after."""
    result = calibration.result
    held = held_out_words(result)
    rows = f"{result.rows['train']} rows fitted{held and f', {held}'}"
    arm = arm_words(calibration.robot)
    plain = arm_words(calibration.robot, option="")
    if (means := result.left_out_mm) is not None:
        yield _Part(
            "", f"On a new set-up: mean {means[0]:.4f} mm; geometry alone {means[1]:.4f} mm"
        )
    yield _Part("robot   ", f"{arm}; {rows}", [("arm", f"{plain}; {rows}")])
    size, ways = _sizes(result, "nominal")
    yield _Part("before  ", f"{size}: nominal, base and tool fitted, {ways[0]}")
    size, ways = _sizes(result, "calibrated")
    lead = f"{size}: calibrated, {ways[0]}"
    yield _Part("after   ", "; ".join([lead, *ways[1:]]), [("ways", lead)])


def _sizes(result: Result, model: str) -> tuple[str, list[str]]:
    """Return the errors of a model, and of which rows they are; further ways of leaving rows out
    follow with their mean error.
    """
    by_part = result.error[model]
    ways = {name: by_part[name] for name in by_part if name not in ("train", "test")}
    if "test" not in by_part:
        return error_words(by_part["train"], ways)
    return error_words(by_part["test"], ways, result_tables.PARTS["test"])


def _beside(calibration: Calibration) -> Iterator[_Part]:
    """Yield the error to expect elsewhere, the noise, clocks, and what stations differ by."""
    result = calibration.result
    if result.elsewhere is not UNSET:
        errors = result.error["calibrated"]
        words = elsewhere_words(result.elsewhere, errors.get("test", errors["train"]))
        short = elsewhere_size(result.elsewhere)
        head = "task    " if result.elsewhere.over else "anywhere"
        yield _Part(head, words, [("elsewhere", short)])
    kinds = " and ".join(dict.fromkeys(rows.train.kind for rows in calibration.stations))
    noise = noise_line(result.noise, kinds)
    size, shown, _ = noise.partition("; ")
    yield _Part("noise   ", noise, [("noise", f"{size})")] if shown else ())
    clocks = [] if result.clocks is UNSET else [*map(result_tables.clock_words, result.clocks)]
    if clocks:
        others = f"; {len(clocks) - 1} more" if clocks[1:] else ""
        yield _Part("clock   ", "; ".join(clocks), [("clock", clocks[0] + others)])
    if result.stations is not UNSET and (moved := result_tables.station_changes(result.stations)):
        first, *rest = moved.split("; ")
        yield _Part("moved   ", moved, [("moved", f"{first}; and others" if rest else first)])


def _found(forms: Sequence[str]) -> Iterator[_Part]:
    """Yield the effects that a search found, given in full, without the evidence, by joint alone,
    with hints counted, by kind, and counted.
    """
    if forms:
        names = ("evidence", "places", "hints", "kinds", "found")
        yield _Part("found   ", forms[0], list(zip(names, forms[1:], strict=False)))


def _verdict(calibration: Calibration, search: SearchReport | None) -> _Part:
    """Return the verdict with its reason, and how good predictions are."""
    verdict = judged(calibration.result, search)
    words = f"{verdict.judgement}. {verdict.reason}"
    if not calibration.result.converged:
        return _Part("verdict ", words)
    return _Part("verdict ", words + worth_words(calibration, words), [("worth", words)])


def worth_words(calibration: Calibration, reason: str) -> str:
    """Return how good predictions are, to stand behind the reason of a verdict; "" if unknown."""
    statement = calibration.fit.statement
    worth = "" if statement is None else statement.worth
    end = "" if reason.endswith(".") else "."
    return f"{end} {worth[0].upper()}{worth[1:]}" if worth else ""


def _next(
    calibration: Calibration, search: SearchReport | None, commands: Mapping[Act, str]
) -> _Part:
    """Return the one thing to do next, as a command if there is one."""
    step = steps_after(calibration, search)[0]
    command = "" if step.act is None else commands.get(step.act, "")
    return _Part("next    ", command or step.text, is_command=bool(command))
