"""Progress of a long run on stderr: one line that is overwritten on a terminal, a few plain lines
elsewhere.

The library only logs. Iterations of a fit are transient, findings of a discovery stay on the
screen. A record with ``extra={"done": 2, "of": 5}`` states how far the run has come, from which the
remaining time follows.
"""

from __future__ import annotations

import io
import logging
import re
import sys
import time
from typing import Any, TextIO

import click
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from pincal.thresholds import Count, Scale

# Loggers of steps whose messages do not stay on the screen.
_FITS = "pincal.identify"
# Logger of work done item by item: without a terminal, a line for every tenth of the items.
_COUNTED = "pincal.spread"
_TRANSIENT = (
    _FITS,
    _COUNTED,
    "pincal.report.html",
    "pincal.calibration",
    "pincal.compensate",
    "pincal.cli",
)
# Commands that consist of fits; in others a fit is one step of many.
_OF_FITS = ("calibrate",)
_LONG: Scale = 1.0  # [s]
# Columns of results that are not printed on a terminal.
_WIDTH: Count = 100
# Columns of spinner, elapsed time and blanks, and the fewest of what is done.
_BESIDE: Count = 13
_NARROW: Count = 20

log = logging.getLogger(__name__)
_handler: logging.Handler | None = None


def begin_progress(quiet: bool) -> None:
    """Show the library's log on stderr, unless it is to be quiet."""
    global _handler
    end_progress()
    if quiet:
        return
    context = click.get_current_context(silent=True)
    for_programs = bool(context and context.params.get("as_json"))
    if sys.stderr.isatty() and not for_programs:
        _handler = _Overwritten()
    else:
        _handler = _Plain(fits=context is None or context.info_name in _OF_FITS)
    logger = logging.getLogger("pincal")
    logger.handlers = [_handler]
    logger.setLevel(logging.INFO)


def log_step(step: str) -> None:
    """Show the current step of a command on the line that is overwritten; nothing without a
    terminal.
    """
    log.info(step)


def end_progress() -> None:
    """Remove the progress line before the result is printed."""
    global _handler
    if _handler is not None:
        _handler.close()
    _handler = None
    logging.getLogger("pincal").handlers = []


class _Redirected(io.TextIOBase):
    """Text for a file or another program: without the blanks that fill the lines of a screen."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return self._file.encoding

    def write(self, text: str) -> int:
        """Write whole lines without the blanks at their ends."""
        self._file.write(re.sub(r"[ \t]+(?=\n)", "", text))
        return len(text)

    def flush(self) -> None:
        """Hand on what has been written."""
        self._file.flush()


def console() -> Console:
    """Return the console for results: stdout, with boxes and colours on a terminal, otherwise plain
    text.
    """
    end_progress()
    if sys.stdout.isatty():
        return Console(highlight=False)
    plain: Any = _Redirected(sys.stdout)
    return Console(width=_WIDTH, highlight=False, file=plain)


def _left(seconds: float, done: float, of: float) -> str:
    """Return the remaining time in words if all steps take equally long; nothing before the first
    is done.

    Example:
        >>> _left(10.0, 2, 5), _left(10.0, 0, 5)
        ('about 15 s left', '')
    """
    return f"about {_clock(seconds * (of - done) / done)} left" if done > 0 and of > 0 else ""


class _Pace:
    """How long counted items take, and from that the time that is left.

    They are counted from the event before the first of them: what came before, such as a fit whose
    subsamples follow, took its own time.
    """

    def __init__(self) -> None:
        self._start = self._event = time.monotonic()
        self._counted: tuple[str, float] | None = None
        self._done = 0.0

    def left(self, record: logging.LogRecord) -> str:
        """Return the remaining time in words at an event; nothing where it is unknown or over."""
        now = time.monotonic()
        done = getattr(record, "done", 0)
        of = getattr(record, "of", 0)
        before = self._event
        self._event = now
        if not of:
            return ""
        counted = (record.name, of)
        if counted != self._counted or done < self._done:
            self._start = before
        self._counted = counted
        self._done = done
        return _left(now - self._start, done, of) if done < of else ""


def _shortened(text: str, width: int) -> str:
    """Return a text of at most this width, cut between words.

    Example:
        >>> _shortened("found gear_ripple of joint_2: residual 0.1 -> 0.05 mm", 30)
        'found gear_ripple of …'
    """
    if len(text) <= width:
        return text
    return f"{text[: width - 1].rsplit(' ', 1)[0]} …"


def _clock(seconds: float) -> str:
    """Write a duration.

    Example:
        >>> _clock(7.2), _clock(75.0), _clock(3700.0)
        ('7 s', '1 min 15 s', '1 h 01 min')
    """
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    return (
        f"{whole // 60} min {whole % 60:02d} s"
        if whole < 3600
        else f"{whole // 3600} h {whole % 3600 // 60:02d} min"
    )


class _Plain(logging.Handler):
    """One line per event; of a fit only the last step of each stage, and only in commands that
    consist of fits.
    """

    def __init__(self, *, fits: bool) -> None:
        super().__init__(logging.INFO)
        self._fits = fits
        self._begun = time.monotonic()
        self._pace = _Pace()
        self._last: logging.LogRecord | None = None

    def emit(self, record: logging.LogRecord) -> None:
        """Write an event, but keep a step of a fit until its stage, the first logged
        value, ends.
        """
        record.left = self._pace.left(record)
        if (
            _is_another_tenth(record)
            if record.name == _COUNTED
            else not record.name.startswith(_TRANSIENT)
        ):
            self._write(self._last, record)
        elif self._fits and record.name.startswith(_FITS):
            if self._last is not None and _stage(record) != _stage(self._last):
                self._write(self._last)
            self._last = record

    def close(self) -> None:
        """Write the last stage."""
        self._write(self._last)
        super().close()

    def _write(self, *records: logging.LogRecord | None) -> None:
        self._last = None
        seconds = time.monotonic() - self._begun
        for record in filter(None, records):
            left = getattr(record, "left", "")
            times = f" [{_clock(seconds)}{left and ', '}{left}]" if seconds > _LONG else ""
            click.echo(f"pincal: {record.getMessage()}{times}", err=True)


def _is_another_tenth(record: logging.LogRecord) -> bool:
    """Return whether another tenth of the items is done."""
    done = getattr(record, "done", 0)
    of = getattr(record, "of", 0)
    return 10 * done // of > 10 * (done - 1) // of


def _stage(record: logging.LogRecord) -> object:
    return record.args[0] if isinstance(record.args, tuple) and record.args else record.msg


class _Overwritten(logging.Handler):
    """One line with the current step, elapsed and remaining time; events stay above it."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        screen = Console(stderr=True, highlight=False)
        columns = (
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}", markup=False),
        )
        self._pace = _Pace()
        self._progress = Progress(
            *columns, console=screen, transient=True, redirect_stdout=False, redirect_stderr=False
        )
        self._task = self._progress.add_task("", total=None, left="")

    def emit(self, record: logging.LogRecord) -> None:
        """Show a step, or write an event above the line."""
        self._progress.start()
        screen = self._progress.console
        text = record.getMessage()
        left = self._pace.left(record)
        if record.name.startswith(_TRANSIENT):
            room = screen.width - _BESIDE - len(left)
            text = _shortened(text, max(room, _NARROW))
            self._progress.update(self._task, description=text, left=left)
        else:
            screen.print(f"pincal: {text}", markup=False, soft_wrap=True)
            self._progress.update(self._task, left=left)

    def close(self) -> None:
        """Remove the line."""
        if self._progress.live.is_started:
            self._progress.stop()
        super().close()
