"""What was found out about the latest of some objects, and is asked for again; and who keeps that of a chain."""

from __future__ import annotations

from collections import deque
from typing import Any, Generic, TypeVar

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


class Evaluations:
    """What was evaluated with the chains of an arm: they share it, and it goes with them.

    A copy in another process begins anew.

    Attributes:
        tables: what effects add to coordinates over tables, the latest last (see :mod:`pincal.model.evaluated`).
    """

    def __init__(self) -> None:
        """Know nothing yet."""
        self.tables: tuple[Any, ...] = ()
        self._latest: dict[str, Latest[Any]] = {}

    def about(self, what: str, *objects: object, most: int = 4) -> dict[Any, Any]:
        """Return what is known of some kind about objects, the latest of each kind only, to be added to."""
        return self._latest.setdefault(what, Latest(most)).of(*objects)

    def __reduce__(self) -> tuple[type[Evaluations], tuple[()]]:
        return Evaluations, ()
