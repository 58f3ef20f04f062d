"""The command ``pincal``: one verb per task, results on stdout, progress on stderr.

No control character from a file is printed, and a full disk does not end a run.
"""

from __future__ import annotations

import ctypes
import gc
import importlib
import io
import os
import re
import signal
import sys
import threading
import warnings
from types import FrameType
from typing import Any, cast

import click

from pincal.errors import LONGEST, BadInputError, Exit, PincalError, printable
from pincal.satellites import Place
from pincal.thresholds import Count, Scale

# New objects after which garbage is collected.
_GARBAGE: Count = 200_000
# Size from which arrays return to the system when they are freed [bytes]. By default those of up to
# 32 MB are kept for later ones, and what a search leaves between them is never used again.
_LARGE: Count = 4_000_000
# Free room above all arrays that is kept for the next ones, twice that size as by default: else
# every step of a fit asks the system for its pages again.
_ROOM: Count = 8_000_000
# The numbers of these options of the C library, their values, and the variables by which workers
# are told them.
_OPTIONS: tuple[tuple[int, int, str], ...] = (
    (-3, _LARGE, "MALLOC_MMAP_THRESHOLD_"),
    (-1, _ROOM, "MALLOC_TRIM_THRESHOLD_"),
)

# The interruptions of this process, and the time that one may take [s].
_INTERRUPTS: list[int] = []
_PATIENCE: Scale = 0.8

# Colours, and on a terminal the moves of the cursor that a progress line needs: up, down, start,
# and clearing.
_ALLOWED = re.compile(r"(\x1b\[[0-9;]*[mABGKlh]|\x1b\[\?25[lh]|\r)")

# An option that takes two names and a number, any number of times.
_MANY = "--socket-distance"

_COMMANDS = {
    "check": "pincal.cli.check:check",
    "calibrate": "pincal.cli.fitting:calibrate_verb",
    "validate": "pincal.cli.validating:validate",
    "predict": "pincal.cli.compensate:predict",
    "compensate": "pincal.cli.compensate:compensate",
    "export": "pincal.cli.export:export",
}
_FURTHER: Place[click.Command] = Place("verbs")
# Verbs in the order in which a robot needs them; those that are not named here come last.
_ORDER = (
    "demo",
    "check",
    "calibrate",
    "discover",
    "design",
    "validate",
    "predict",
    "compensate",
    "interim",
    "diagnose",
    "update",
    "fleet",
    "simulate",
    "export",
    "view",
)


class _Verbs(click.Group):
    """Commands that are imported only when they are called, so that ``pincal --help`` is fast."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        known = (*_COMMANDS, *_FURTHER.names())
        ordered = [name for name in _ORDER if name in known]
        return [*ordered, *(name for name in known if name not in ordered)]

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name in _COMMANDS:
            module, _, attribute = _COMMANDS[name].partition(":")
            return cast(click.Command, getattr(importlib.import_module(module), attribute))
        return _FURTHER.get(name)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the first steps, of the verbs that there are."""
        there = self.list_commands(ctx)
        lines = (line for line in _STEPS.splitlines() if _verb_of(line) in there)
        self.epilog = "\b\n" + "\n".join(lines)
        super().format_epilog(ctx, formatter)


def _verb_of(line: str) -> str:
    """Return the verb of a line of the first steps.

    Example:
        >>> _verb_of("First steps:    pincal demo")
        'demo'
    """
    return line.partition("pincal ")[2].split()[0]


_STEPS = """First steps:    pincal demo
Your robot:     pincal check      ROBOT.urdf DATA.csv
                pincal calibrate  DATA.csv
Still errors?   pincal discover   DATA.csv
Use the model:  pincal compensate results/model.json PROGRAM.csv --out corrected.csv
Later:          pincal diagnose   results/model.json NEW.csv
"""


@click.group(
    cls=_Verbs,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(package_name="pincal")
def pincal() -> None:
    """Calibrate a serial robot into a measuring instrument."""


class _GuardedStream(io.FileIO):
    """A stream of the process whose writes never fail.

    Attributes:
        lost: why something could not be written; empty if nothing was lost, or the reader has
            closed its end.
    """

    lost = ""

    def write(self, content: object) -> int:
        """Write bytes; those that can't be written are dropped, since the files of a run matter
        more than its messages.
        """
        view = memoryview(content)  # type: ignore[arg-type]
        try:
            return super().write(view) or 0
        except BrokenPipeError:
            return view.nbytes
        except OSError as error:
            self.lost = error.strerror or str(error)
            return view.nbytes


class _Printable(io.TextIOWrapper):
    """Text whose control characters are escaped, except those that draw on a terminal."""

    def write(self, text: str) -> int:
        """Write a text."""
        if text.replace("\n", "").isprintable():
            return super().write(text)
        parts = _ALLOWED.split(text) if self.isatty() else [text]
        super().write("".join(part if k % 2 else printable(part) for k, part in enumerate(parts)))
        return len(text)


def guard_streams() -> _GuardedStream:
    """Replace stdout and stderr by streams that never fail; return the one for results.

    Closed streams are opened on the null device: otherwise a file opened later would take their
    number, and get the prints.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    found = []
    for name, number in (("stdout", 1), ("stderr", 2)):
        if (stream := getattr(sys, name)) is not None:
            stream.flush()
        raw = _GuardedStream(number, "w", closefd=False)
        encoding = getattr(stream, "encoding", None) or "utf-8"
        text = _Printable(
            io.BufferedWriter(raw),
            encoding=encoding,
            errors="backslashreplace",
            line_buffering=True,
        )
        setattr(sys, name, text)
        found.append(raw)
    return found[0]


def entry() -> None:
    """Run the command as its own process.

    It ends without the interpreter's clean-up, which takes half a second with all the libraries
    that a calibration loads and frees nothing that the system does not; files are closed by then.
    Small matrices gain nothing from several threads.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    results = guard_streams()
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
    try:
        main()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.stdout.flush()
    if results.lost:
        click.echo(
            f"pincal: can't write to stdout ({results.lost}); the requested files are complete",
            err=True,
        )
        code = code or Exit.BAD_INPUT
    sys.stderr.flush()
    os._exit(code)


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Interrupt the command, and again if the exception gets lost, as it does while an object is
    being deleted.
    """
    _INTERRUPTS.append(number)
    sys.unraisablehook = lambda _: None
    again = threading.Timer(_PATIENCE, os.kill, (os.getpid(), number))
    again.daemon = True
    again.start()
    raise KeyboardInterrupt


def main(arguments: list[str] | None = None) -> None:
    """Run the command; an error is printed on stderr and sets the exit code."""
    # A command creates many objects that it keeps: searching them for garbage would take a quarter
    # of its time.
    gc.set_threshold(_GARBAGE)
    _return_large_arrays()
    warnings.showwarning = _show_warning
    try:
        code = _run_verb(arguments)
    except click.exceptions.Abort:
        click.echo("pincal: interrupted; nothing was written", err=True)
        sys.exit(Exit.INTERRUPTED)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except PincalError as error:
        click.echo(f"pincal: {error}", err=True)
        sys.exit(error.exit_code)
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("pincal") or os.environ.get("PINCAL_TRACEBACK"):
            raise
        click.echo(_missing_words(error), err=True)
        sys.exit(Exit.BAD_INPUT)
    except Exception as error:
        if os.environ.get("PINCAL_TRACEBACK"):
            raise
        click.echo(_bug_words(error), err=True)
        sys.exit(Exit.INTERNAL_ERROR)
    sys.exit(code if isinstance(code, int) else Exit.DONE)


def _return_large_arrays() -> None:
    """Let the C library return large arrays to the system when they are freed and keep the room of
    small ones, here and in workers, unless the user has told it otherwise; does nothing where it
    has no such option.
    """
    if sys.platform != "linux" or any(variable in os.environ for *_, variable in _OPTIONS):
        return
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    for number, size, variable in _OPTIONS:
        os.environ[variable] = str(size)
        if set_option is not None:
            set_option(number, size)


def _run_verb(arguments: list[str] | None) -> object:
    """Return what the verb of a command line returns, by default of this process's."""
    try:
        return pincal.main(
            args=_spread(sys.argv[1:] if arguments is None else arguments),
            prog_name="pincal",
            standalone_mode=False,
        )
    except SystemExit as error:
        # Nothing of pincal ends a command this way; 0 would mean that it was done.
        raise BadInputError(
            f"a plug-in, or another module that pincal calls, ended the program (SystemExit: "
            f"{error}); correct it"
        ) from error
    except Exception:
        # An interrupted import may fail as if the library were missing.
        if _INTERRUPTS:
            raise click.exceptions.Abort from None
        raise
    finally:
        # The line of progress, if a command has shown one.
        if progress := sys.modules.get("pincal.cli.progress"):
            progress.end_progress()


def _missing_words(error: ModuleNotFoundError) -> str:
    return (
        f"pincal: {error.name} is not installed; docs/install.md lists what each part of "
        "pincal needs, and what to do where it can't be installed"
    )


def _bug_words(error: Exception) -> str:
    return (
        f"pincal: internal error: {printable(f'{type(error).__name__}: {error}', LONGEST)}\n"
        "pincal: this is a bug in pincal; please report the output of a run with "
        "PINCAL_TRACEBACK=1"
    )


def _spread(arguments: list[str]) -> list[str]:
    """Return the command line with ``--socket-distance`` repeated before each further set of its
    three values.

    ``--socket-distance A B 0.05 C D 0.05`` then means the option given twice, as Click expects it.
    Sockets may have numbers for names, so that a further option is none of the three.
    """
    from pincal.units import plain_numbers

    out: list[str] = []
    words = [str(word) for word in arguments]
    while words:
        word, *words = words
        if word != _MANY:
            out.append(word)
            continue
        while (
            len(words) >= 3
            and not words[0].startswith("--")
            and plain_numbers([words[2].rstrip("ucm")])
        ):
            out += [_MANY, *words[:3]]
            words = words[3:]
            word = ""
        out += [word] if word else []
    return out


def _show_warning(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    if category.__module__.startswith("pincal"):
        click.echo(f"pincal: note: {message}", err=True)


def show_progress(quiet: bool) -> None:
    """Show the progress of a long run on stderr, unless it is to be quiet."""
    from pincal.cli import progress

    if quiet:
        warnings.showwarning = lambda *_, **__: None
    progress.begin_progress(quiet)
