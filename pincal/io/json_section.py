"""Reading JSON with care: what is missing, of the wrong kind or shape, or no number is refused by its key."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pincal.errors import ModelFileError

_LARGEST = float(np.finfo(float).max)
ADVICE = "take the file from a backup or run pincal calibrate again"


@dataclass(frozen=True)
class Section:
    """A value in a JSON file, with the way to it for whoever has to mend it.

    Attributes:
        file: the file's name.
        key: the way to the value, e.g. ``robot.masses``; empty for the whole.
        value: what stands there.

    Example:
        >>> Section("model.json", "", {"robot": {"masses": [1.0]}}).at("robot").at("masses").numbers(2)
        Traceback (most recent call last):
        pincal.errors.ModelFileError: model.json: robot.masses: has shape (1,); expected numbers of shape (2,); take the \
file from a backup or run pincal calibrate again
    """

    file: str
    key: str
    value: Any

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Section:
        """Return the whole of a JSON file.

        Raises:
            ModelFileError: if it can't be read or is not JSON, as when it is cut off.
        """
        file = os.fspath(path)
        try:
            return cls(file, "", json.loads(Path(path).read_bytes()))
        except OSError as error:
            raise ModelFileError(f"{file}: can't be read ({error.strerror}); expected a model.json") from None
        except (ValueError, RecursionError) as error:
            reason = str(error) or type(error).__name__
            raise ModelFileError(f"{file}: cut off or no JSON ({reason}); expected a model.json; {ADVICE}") from None

    def error(self, problem: str, expected: str) -> ModelFileError:
        """Return the error that something is wrong here."""
        place = f"{self.key}: " if self.key else ""
        return ModelFileError(f"{self.file}: {place}{problem}; expected {expected}; {ADVICE}")

    def at(self, key: str) -> Section:
        """Return what stands under a key."""
        if not isinstance(self.value, dict):
            raise self.error(f"is {_kind(self.value)}", f"an object with {key!r}")
        there = Section(self.file, f"{self.key}.{key}" if self.key else key, self.value.get(key))
        if key not in self.value:
            raise there.error("is missing", "this key")
        return there

    def items(self) -> list[Section]:
        """Return the entries of a list."""
        if not isinstance(self.value, list):
            raise self.error(f"is {_kind(self.value)}", "a list")
        return [Section(self.file, f"{self.key}[{i}]", entry) for i, entry in enumerate(self.value)]

    def text(self) -> str:
        """Return a text."""
        if not isinstance(self.value, str):
            raise self.error(f"is {_kind(self.value)}", "a text")
        return self.value

    def texts(self) -> tuple[str, ...]:
        """Return a list of texts."""
        return tuple(entry.text() for entry in self.items())

    def flag(self) -> bool:
        """Return true or false."""
        if not isinstance(self.value, bool):
            raise self.error(f"is {_kind(self.value)}", "true or false")
        return self.value

    def choice(self, *known: str) -> str:
        """Return a text that is one of those known."""
        if self.text() not in known:
            raise self.error(f"is {self.value!r}", f"one of {', '.join(known)}")
        return self.text()

    def number(self, *, null: float | None = None) -> float:
        """Return a finite number."""
        return float(self.numbers(null=null))

    def numbers(self, *shape: int, null: float | None = None) -> np.ndarray:
        """Return finite numbers.

        Args:
            shape: their shape; -1 where any length will do.
            null: what null stands for, which is refused unless given.

        Returns:
            A new array of this shape.
        """
        expected = f"numbers of shape {shape}".replace("-1", "any") if shape else "a number"
        found = self.array(null=null, expected=expected)
        if found.size == 0 and 0 in shape:
            return np.zeros(shape)
        if found.ndim != len(shape) or any(n not in (-1, m) for n, m in zip(shape, found.shape, strict=True)):
            raise self.error(f"has shape {found.shape}", expected)
        return found

    def array(self, *, null: float | None = None, expected: str = "an array of numbers") -> np.ndarray:
        """Return finite numbers of whatever shape; see :meth:`numbers`."""
        if not _is_numeric(self.value, null is not None):
            raise self.error("has entries that are no finite numbers", expected)
        try:
            return np.array(_filled(self.value, null), float)
        except ValueError:
            raise self.error("has rows of unequal length", expected) from None


def _kind(value: Any) -> str:
    names = {dict: "an object", list: "a list", str: "a text", type(None): "null", bool: "true or false"}
    return names.get(type(value), "a number")


def _is_numeric(value: Any, allow_null: bool) -> bool:
    if isinstance(value, list):
        return all(_is_numeric(entry, allow_null) for entry in value)
    if value is None:
        return allow_null
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return bool(abs(value) <= _LARGEST)


def _filled(value: Any, null: float | None) -> Any:
    if isinstance(value, list):
        return [_filled(entry, null) for entry in value]
    return null if value is None else value
