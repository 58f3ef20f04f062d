"""Errors and warnings.

A message states what is wrong, where (file, row, column, joint), what was found, what was expected
and what to do next. The exit code of the command follows from the class.
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

from pincal.thresholds import Count, Scale

if TYPE_CHECKING:
    import numpy as np

# Longest message [bytes], as names from files may have any length.
LONGEST: Count = 1900
# Similarity of two names, 0 to 1, below which they are unrelated.
_SIMILAR: Scale = 0.5
# Most names that are compared, and characters of each.
_COMPARED: Count = 50


def printable(text: str, most: int | None = None) -> str:
    r"""Return text with control characters escaped, except line breaks and tabs.

    Args:
        text: any text; names in it may be from files.
        most: size beyond which the middle is omitted [bytes]; default: unlimited.

    Example:
        >>> printable("joint \x1b[2J"), printable("a" * 50, 20)
        ('joint \\x1b[2J', 'aaaaaaaa ... aaaaaaa')
    """
    if not text.isprintable():
        text = "".join(
            c if c in "\n\t" or unicodedata.category(c)[0] != "C" else ascii(c)[1:-1] for c in text
        )
    content = text.encode("utf-8")
    if most is None or len(content) <= most:
        return text
    after = (most - 5) // 2
    ends = content[: most - 5 - after], content[len(content) - after :]
    return " ... ".join(end.decode("utf-8", "ignore") for end in ends)


class Exit(IntEnum):
    """Exit codes of the command.

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
        """Return a member with code and meaning."""
        self = int.__new__(cls, code)
        self._value_ = code
        self.meaning = meaning
        return self


class PincalError(Exception):
    """Base of all errors raised by pincal, with a printable message."""

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
    """A robot program that is truncated, in another dialect, or can't be read."""


class OutputError(BadInputError):
    """An output file or folder that can't be written."""


class IdentificationError(PincalError, RuntimeError):
    """A fit that did not converge, or a rank deficiency that the user has to resolve."""

    exit_code = Exit.UNDECIDED


class AccuracyGateError(PincalError):
    """The held-out error exceeds the limit set by the user."""

    exit_code = Exit.INACCURATE


class ChangedRobotError(PincalError):
    """Measurements that contradict a calibrated robot for any pose of the instrument: it has
    changed, or is another one.
    """

    exit_code = Exit.CHANGED


class WorkersLostError(PincalError, RuntimeError):
    """Worker processes or machines died, and no others could continue."""


class PincalWarning(UserWarning):
    """A printable message to the user that does not stop the run."""

    def __init__(self, message: object = "") -> None:
        super().__init__(printable(str(message), LONGEST))


class RobotWarning(PincalWarning):
    """What was noticed of a robot's description; its notes, and so results, have it, too."""


@contextmanager
def needed(
    package: str, what: str, *, install: str = "", error: type[BadInputError] = BadInputError
) -> Iterator[None]:
    """Import an optional package, without which only the feature that needs it is refused.

    Args:
        package: its name.
        what: the feature, in words.
        install: what pip has to install; default: the package.
        error: class of the error.

    Raises:
        BadInputError: of the class, with the command to install it.

    Example:
        >>> with needed("trimesh", "meshes", install="trimesh[easy]"):
        ...     import no_such_module
        Traceback (most recent call last):
        pincal.errors.BadInputError: meshes need trimesh: run pip install trimesh[easy]
    """
    try:
        yield
    except ImportError as missing:
        raise error(f"{what} need {package}: run pip install {install or package}") from missing


def nearest_first(wrong: Iterable[str], known: Iterable[str]) -> list[str]:
    """Return the known names, those most similar to a wrong one first, the others in their order.

    Example:
        >>> nearest_first(["jont_2"], ["base", "joint_1", "joint_2"])
        ['joint_2', 'joint_1', 'base']
    """
    folded = [name.casefold()[:_COMPARED] for name in islice(wrong, _COMPARED)]

    def likeness(name: str) -> float:
        name = name.casefold()[:_COMPARED]
        best = max(
            (difflib.SequenceMatcher(None, other, name).ratio() for other in folded), default=0.0
        )
        return best if best >= _SIMILAR else 0.0

    return sorted(dict.fromkeys(known), key=likeness, reverse=True)


# Verbs of one thing that are not those of several with an s.
_OF_ONE = {"are": "is", "have": "has", "do": "does"}


def counted(count: int, word: str, verb: str = "") -> str:
    """Return a count with its noun, and with its verb as of several.

    Example:
        >>> counted(1, "check"), counted(0, "check"), counted(2, "diagnosis")
        ('1 check', '0 checks', '2 diagnoses')
        >>> counted(1, "row", "are"), counted(1, "row", "repeat"), counted(2, "row", "repeat")
        ('1 row is', '1 row repeats', '2 rows repeat')
    """
    noun = word if count == 1 else f"{word}s".replace("siss", "ses")
    of_one = _OF_ONE.get(verb, f"{verb}s") if verb else ""
    return f"{count} {noun} {of_one if count == 1 else verb}".rstrip()


def few(items: Sequence[object] | np.ndarray, most: int) -> str:
    """Return the first items as a list in a sentence.

    Example:
        >>> few([3, 5], 2), few([3, 5, 8], 2)
        ('3, 5', '3, 5, ...')
    """
    return ", ".join(map(str, items[:most])) + (", ..." if len(items) > most else "")


def warn(text: str, kind: type[PincalWarning] = PincalWarning) -> None:
    """Issue a `PincalWarning`."""
    warnings.warn(text, kind, stacklevel=3)
