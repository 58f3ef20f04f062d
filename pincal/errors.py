"""Errors and warnings that pincal raises, each for a reader who has to act on it.

A message says what is wrong, where (file, row, column, joint), what was found, what was expected and what to do next.
The exit code of the command follows from the class.
"""

from __future__ import annotations

import difflib
import unicodedata
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from enum import IntEnum
from itertools import islice
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

# The longest message [bytes]: names in it come from files and may have any length.
LONGEST = 1900
# Likeness of two names, 0 to 1, below which they have nothing to do with each other.
_ALIKE = 0.5
# Names that are compared at most, and characters of each: beyond, it is no slip of the pen.
_COMPARED = 50


def printable(text: str, most: int | None = None) -> str:
    r"""Return a text as a terminal may show it: what would control the terminal is escaped, line ends stay.

    Args:
        text: any text; names in it may come from files.
        most: size [bytes] beyond which the middle is left out; default: any size.

    Example:
        >>> printable("joint \x1b[2J"), printable("a" * 50, 20)
        ('joint \\x1b[2J', 'aaaaaaaa ... aaaaaaa')
    """
    if not text.isprintable():
        text = "".join(c if c in "\n\t" or unicodedata.category(c)[0] != "C" else ascii(c)[1:-1] for c in text)
    content = text.encode("utf-8")
    if most is None or len(content) <= most:
        return text
    after = (most - 5) // 2
    ends = content[: most - 5 - after], content[len(content) - after :]
    return " ... ".join(end.decode("utf-8", "ignore") for end in ends)


class Exit(IntEnum):
    """How the command ended: its exit code.

    Attributes:
        meaning: the code in words, for help texts.
    """

    meaning: str

    DONE = 0, "done"
    INTERNAL_ERROR = 1, "internal error"
    USAGE = 2, "usage error"
    BAD_INPUT = 3, "invalid input"
    UNDECIDED = 4, "no convergence, or a decision is needed"
    INACCURATE = 5, "required accuracy not reached"
    CHANGED = 6, "the robot no longer matches the model"
    INTERRUPTED = 130, "interrupted"

    def __new__(cls, code: int, meaning: str) -> Exit:
        """Return a member that is its code and knows its meaning."""
        self = int.__new__(cls, code)
        self._value_ = code
        self.meaning = meaning
        return self


class PincalError(Exception):
    """Base of all errors raised by pincal; its message can be printed as it is, whatever the files held."""

    exit_code = Exit.INTERNAL_ERROR

    def __init__(self, message: object = "") -> None:
        super().__init__(printable(str(message), LONGEST))


class BadInputError(PincalError, ValueError):
    """Invalid input, rejected before any work is done."""

    exit_code = Exit.BAD_INPUT


class RobotFileError(BadInputError):
    """A URDF that can't be read or does not describe one serial arm from base to tip."""


class MeasurementError(BadInputError):
    """A table of measurements with an invalid column, unit or value."""


class ModelFileError(BadInputError):
    """A ``model.json`` that is truncated, inconsistent or written by a newer version."""


class ProgramError(BadInputError):
    """A robot's program that is cut, of another dialect, or can't be read."""


class OutputError(BadInputError):
    """An output file or folder that can't be written."""


class IdentificationError(PincalError, RuntimeError):
    """A fit that did not converge, or a rank deficiency that the user has to resolve."""

    exit_code = Exit.UNDECIDED


class AccuracyGateError(PincalError):
    """The held-out error exceeds the limit that the user set."""

    exit_code = Exit.INACCURATE


class ChangedRobotError(PincalError):
    """Measurements that a calibrated robot can't have given wherever the instrument stood: it has changed, or is another."""

    exit_code = Exit.CHANGED


class WorkersLostError(PincalError, RuntimeError):
    """Processes or machines that did a part of the work died, and nobody could go on with it."""


class PincalWarning(UserWarning):
    """A message to the user that does not stop the run; can be printed as it is."""

    def __init__(self, message: object = "") -> None:
        super().__init__(printable(str(message), LONGEST))


@contextmanager
def needed(package: str, what: str, *, install: str = "", error: type[BadInputError] = BadInputError) -> Iterator[None]:
    """Import a package that some features alone need: where it is not installed they are refused, and nothing else is.

    Args:
        package: its name.
        what: needs it, in words.
        install: what pip is to install; default: the package.
        error: class of the error.

    Raises:
        BadInputError: of the class, saying how to install it.

    Example:
        >>> with needed("example-robot-data", "robots by name", install="example-robot-data-loaders"):
        ...     import no_such_module
        Traceback (most recent call last):
        pincal.errors.BadInputError: robots by name need example-robot-data: run pip install example-robot-data-loaders
    """
    try:
        yield
    except ImportError as missing:
        raise error(f"{what} need {package}: run pip install {install or package}") from missing


def nearest_first(wrong: Iterable[str], known: Iterable[str]) -> list[str]:
    """Return the known names, those most like one of the wrong ones first, the others as they stand.

    Example:
        >>> nearest_first(["jont_2"], ["base", "joint_1", "joint_2"])
        ['joint_2', 'joint_1', 'base']
    """
    folded = [name.casefold()[:_COMPARED] for name in islice(wrong, _COMPARED)]

    def likeness(name: str) -> float:
        name = name.casefold()[:_COMPARED]
        best = max((difflib.SequenceMatcher(None, other, name).ratio() for other in folded), default=0.0)
        return best if best >= _ALIKE else 0.0

    return sorted(dict.fromkeys(known), key=likeness, reverse=True)


def counted(count: int, word: str) -> str:
    """Return a number of things in words.

    Example:
        >>> counted(1, "check"), counted(0, "check"), counted(2, "diagnosis")
        ('1 check', '0 checks', '2 diagnoses')
    """
    return f"{count} {word if count == 1 else f'{word}s'.replace('siss', 'ses')}"


def few(items: Sequence[object] | np.ndarray, most: int) -> str:
    """Return some items as a list in a sentence, the first ones of many.

    Example:
        >>> few([3, 5], 2), few([3, 5, 8], 2)
        ('3, 5', '3, 5, ...')
    """
    return ", ".join(map(str, items[:most])) + (", ..." if len(items) > most else "")


def warn(text: str) -> None:
    """Warn of what is odd, but possible."""
    warnings.warn(text, PincalWarning, stacklevel=3)
