"""What the user should know of a result: notes, and doubts, which keep it from being called adequate."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum

import msgspec


class Severity(StrEnum):
    """Whether something makes a result doubtful, or is good to know."""

    DOUBT = "doubt"
    NOTE = "note"


class Note(msgspec.Struct, frozen=True, omit_defaults=True):
    """A message to the user; ``str()`` gives the text.

    Attributes:
        severity: "doubt", which stands first in every output and keeps the verdict from being "adequate", or "note".
        text: in words.
        rows: lines of the rows concerned, if any.
    """

    severity: Severity
    text: str
    rows: tuple[int, ...] = ()

    def __str__(self) -> str:
        return self.text

    @property
    def is_doubt(self) -> bool:
        """Whether it makes the result doubtful."""
        return self.severity is Severity.DOUBT


def doubts_first(notes: Iterable[Note | str]) -> tuple[Note, ...]:
    """Return notes, each once, doubts before the others; plain text is good to know.

    Example:
        >>> told = doubts_first(["three rows are left out", Note(Severity.DOUBT, "the target was touched")])
        >>> [(note.severity.value, note.text) for note in told]
        [('doubt', 'the target was touched'), ('note', 'three rows are left out')]
    """
    told = dict.fromkeys(Note(Severity.NOTE, note) if isinstance(note, str) else note for note in notes)
    return tuple(sorted(told, key=lambda note: not note.is_doubt))


def doubts_of(notes: Iterable[Note]) -> tuple[Note, ...]:
    """Return the doubts among notes."""
    return tuple(note for note in notes if note.is_doubt)
