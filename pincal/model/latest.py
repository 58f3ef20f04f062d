"""Caches of results about the latest of some objects, and the cache of a chain."""

from __future__ import annotations

from collections import deque
from typing import Any, Generic, TypeVar

V = TypeVar("V")


class Latest(Generic[V]):
    """Results by any key for the latest objects, compared by identity.

    Example:
        >>> lengths = Latest[int](2)
        >>> table = [1, 2]
        >>> lengths.of(table)["rows"] = 2
        >>> lengths.of(table), lengths.of([1, 2])
        ({'rows': 2}, {})
    """

    def __init__(self, most: int) -> None:
        """Keep the results of at most so many objects."""
        self._kept: deque[tuple[tuple[object, ...], dict[object, V]]] = deque(maxlen=most)

    def of(self, *objects: object) -> dict[object, V]:
        """Return the results about objects, to be added to; the objects are kept alive."""
        for held, known in tuple(self._kept):
            if len(held) == len(objects) and all(
                a is b for a, b in zip(held, objects, strict=True)
            ):
                return known
        found: dict[object, V] = {}
        self._kept.append((objects, found))
        return found


class Evaluations:
    """Results shared by the chains of an arm; a copy in another process begins empty.

    Attributes:
        tables: contributions of effects over tables, the latest last (see
            :mod:`pincal.model.evaluated`).
    """

    def __init__(self) -> None:
        self.tables: tuple[Any, ...] = ()
        self._latest: dict[str, Latest[Any]] = {}

    def about(self, what: str, *objects: object, most: int = 4) -> dict[Any, Any]:
        """Return the results of one kind about objects, to be added to; only the latest of each
        kind are kept.
        """
        return self._latest.setdefault(what, Latest(most)).of(*objects)

    def __reduce__(self) -> tuple[type[Evaluations], tuple[()]]:
        return Evaluations, ()
