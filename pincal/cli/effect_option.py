"""``--effect NAME[:JOINT][:KEY=VALUE,...]``: a hidden effect on the command line."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable
from dataclasses import fields
from typing import Any

from pincal.errors import BadInputError
from pincal.simulate.effect import HiddenEffect, Scope
from pincal.simulate.elastic import MOMENT_FRAMES
from pincal.simulate.hidden import HIDDEN_EFFECTS

_CHOICES = {"frame": ("before", "after"), "moment_frame": MOMENT_FRAMES}
# Between the components of a vector, as commas separate keys.
_VECTOR = "/"


def parse_effect(text: str, joints: tuple[str, ...]) -> tuple[str, dict[str, Any]]:
    """Return name and given fields of an effect.

    Args:
        text: As on the command line, e.g. ``gear_eccentricity:joint_3:size=1e-4,order=1``; components of a vector
            are separated by a slash.
        joints: Names of the arm's joints.

    Returns:
        Name, and values by field.

    Raises:
        BadInputError: For a name, joint, key or value that can't be, with those that can.

    Example:
        >>> parse_effect("axis_wobble:j2:size=1e-4,order=1,frame=after", ("j1", "j2"))
        ('axis_wobble', {'joint': 'j2', 'size': 0.0001, 'order': 1, 'frame': 'after'})
    """
    name, *parts = (part.strip() for part in text.split(":"))
    kind = HIDDEN_EFFECTS.get(name)
    if kind is None:
        raise BadInputError(f"effect {name!r}: unknown; expected one of {', '.join(_nearest(name, HIDDEN_EFFECTS))}")
    values: dict[str, Any] = {}
    for part in parts:
        found = _keys(text, kind, part) if "=" in part else {"joint": _joint(text, part, joints)}
        if twice := sorted(values.keys() & found.keys()):
            raise BadInputError(f"effect {text!r}: {twice[0]} is given twice")
        values |= found
    if "source" in values:
        values["source"] = _joint(text, values["source"], joints)
    return name, values


def effect_help() -> str:
    """Return the effects with their keys and units as lines of help."""
    lines = []
    for name, kind in HIDDEN_EFFECTS.items():
        keys = ", ".join([f"size [{kind.unit}]", *_known(kind)[1:]])
        lines.append(f"  {name}{'' if kind.scope is Scope.ARM else ':JOINT'}: {keys}")
    return "\n".join(lines)


def _known(kind: type[HiddenEffect]) -> list[str]:
    """Return the keys of an effect, size first."""
    return ["size", *(field.name for field in fields(kind) if field.name not in ("joint", "size"))]


def _nearest(wrong: str, known: Any) -> list[str]:
    return sorted(known, key=lambda name: -difflib.SequenceMatcher(None, name, wrong).ratio())


def _joint(text: str, name: str, joints: tuple[str, ...]) -> str:
    if name not in joints:
        raise BadInputError(f"effect {text!r}: no joint {name!r}; expected one of {', '.join(_nearest(name, joints))}")
    return name


def _keys(text: str, kind: type[HiddenEffect], part: str) -> dict[str, Any]:
    types = {field.name: str(field.type) for field in fields(kind)}
    values: dict[str, Any] = {}
    for pair in part.split(","):
        key, equals, value = (word.strip() for word in pair.partition("="))
        if not equals or key not in _known(kind):
            raise BadInputError(
                f"effect {text!r}: no key {key!r}; {kind.effect} has {', '.join(_known(kind))}, as key=value"
            )
        if key in values:
            raise BadInputError(f"effect {text!r}: {key} is given twice")
        if key in _CHOICES and value not in _CHOICES[key]:
            raise BadInputError(f"effect {text!r}: {key}={value}; expected one of {', '.join(_CHOICES[key])}")
        try:
            values[key] = _READERS[types[key].removesuffix(" | None")](value)
        except (KeyError, ValueError):
            raise BadInputError(f"effect {text!r}: {key}={value}; expected {_words(types[key])}") from None
    return values


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def _vector(text: str) -> tuple[float, ...]:
    x, y, z = map(_number, text.split(_VECTOR))
    return x, y, z


_READERS: dict[str, Callable[[str], Any]] = {
    "float": _number,
    "int": int,
    "str": str,
    "bool": {"true": True, "false": False}.__getitem__,
    "tuple[float, float, float]": _vector,
}


def _words(kind: str) -> str:
    words = {"int": "a whole number", "bool": "true or false", "tuple[float, float, float]": "three numbers, as 1/0/0"}
    return words.get(kind.removesuffix(" | None"), "a number")
