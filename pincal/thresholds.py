"""How a number that decides is written, and how one that does not is told from it.

A number by which something is named, kept, refused or doubted is a field of a policy, made by
:func:`number`, so that its unit, its meaning, the origin of its value and the test that pins it
stand beside it. Any other number at the top of a file is annotated as a :data:`Count` or a
:data:`Scale`.
"""

from __future__ import annotations

from dataclasses import field
from typing import Any, TypeAlias

Count: TypeAlias = int
"""Bounds a computation, a file or a page: rows, steps, bytes, names shown. Nothing is decided by
it.
"""

Scale: TypeAlias = float
"""A tolerance or grid of a computation, the size of a prior, a constant of nature or of a format.
Nothing is decided by it."""


def number(default: object, unit: str, pinned_by: str, meaning: str, origin: str) -> Any:
    """Return a field for a threshold: its value, unit, the test that pins it, its meaning, and the
    origin of the value.
    """
    return field(
        default=default,
        metadata={"unit": unit, "meaning": meaning, "origin": origin, "pinned_by": pinned_by},
    )
