"""Names of what a table can hold: columns, their quantities and the fields that they make up."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

# Field of `Measurements` -> the columns that make it up, and their quantity.
_MEASURED = {
    "position": ("length", ("x", "y", "z")),
    "quaternion": ("number", ("qx", "qy", "qz", "qw")),
    "distance": ("length", ("distance",)),
    "anchor": ("name", ("anchor",)),
    "socket": ("name", ("socket",)),
    "camera_point": ("length", ("cx", "cy", "cz")),
    "pixel": ("pixel", ("u", "v")),
    "sigma": ("noise", ("sigma",)),
}
CONDITIONS = {
    "point": ("name", ("point",)),
    "target": ("name", ("target",)),
    "payload": ("mass", ("payload",)),
    "temperature": ("temperature", ("temperature",)),
    "time": ("time", ("time",)),
}
FIELDS = _MEASURED | CONDITIONS
ARRAYS = ("q", "approach", "rows", *FIELDS)
KINDS = {"position": "position", "distance": "distance", "socket": "socket"} | {
    "camera_point": "camera_point",
    "pixel": "camera_pixel",
}


def nearest_first(wrong: Sequence[str], known: Sequence[str]) -> list[str]:
    """Return the known names, those most like one of the wrong ones first."""

    def likeness(name: str) -> float:
        pairs = [(other.casefold(), name.casefold()) for other in wrong]
        return max(difflib.SequenceMatcher(None, *pair).ratio() for pair in pairs)

    return sorted(known, key=likeness, reverse=True)
