"""What was found out about the latest of some objects, chains or tables for instance, and is asked for again."""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

V = TypeVar("V")


class Latest(Generic[V]):
    """Findings by any key, kept for these very objects, not for equal ones, until others come.

    Example:
        >>> lengths = Latest[int](2)
        >>> table = [1, 2]
        >>> lengths.of(table)["rows"] = 2
        >>> lengths.of(table), lengths.of([1, 2])
        ({'rows': 2}, {})
    """

    def __init__(self, most: int) -> None:
        """Keep those of so many."""
        self._kept: deque[tuple[tuple[object, ...], dict[object, V]]] = deque(maxlen=most)

    def of(self, *objects: object) -> dict[object, V]:
        """Return what is known about objects, to be added to; they are held as well."""
        for held, known in tuple(self._kept):
            if len(held) == len(objects) and all(a is b for a, b in zip(held, objects, strict=True)):
                return known
        found: dict[object, V] = {}
        self._kept.append((objects, found))
        return found
