"""Messages about a result: notes, and doubts, with which it is not called adequate."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum

import msgspec


class Severity(StrEnum):
    """Whether a message is a reservation about the result, or information."""

    DOUBT = "doubt"
    NOTE = "note"


class Note(msgspec.Struct, frozen=True, omit_defaults=True):
    """A message to the user; ``str()`` gives the text.

    Attributes:
        severity: "doubt", which comes first in all output and prevents the verdict "adequate", or
            "note".
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
        """Whether it is a reservation about the result."""
        return self.severity is Severity.DOUBT


def doubts_first(notes: Iterable[Note | str]) -> tuple[Note, ...]:
    """Return notes, each once, doubts before the others; plain text is a note.

    Example:
        >>> doubt = Note(Severity.DOUBT, "the target was touched")
        >>> notes = doubts_first(["three rows are left out", doubt])
        >>> [(note.severity.value, note.text) for note in notes]
        [('doubt', 'the target was touched'), ('note', 'three rows are left out')]
    """
    unique = dict.fromkeys(
        Note(Severity.NOTE, note) if isinstance(note, str) else note for note in notes
    )
    return tuple(sorted(unique, key=lambda note: not note.is_doubt))


def doubts_of(notes: Iterable[Note]) -> tuple[Note, ...]:
    """Return the doubts among notes."""
    return tuple(note for note in notes if note.is_doubt)
