"""``--effect NAME[:JOINT][:KEY=VALUE,...]``: a hidden effect on the command line."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields
from typing import Any

from pincal.errors import BadInputError, nearest_first
from pincal.simulate.effect import HiddenEffect, Scope
from pincal.simulate.elastic import MOMENT_FRAMES
from pincal.simulate.hidden import HIDDEN_EFFECTS

_CHOICES = {"frame": ("before", "after"), "moment_frame": MOMENT_FRAMES}


def parse_effect(text: str, joints: tuple[str, ...]) -> tuple[str, dict[str, Any]]:
    """Return name and given fields of an effect of an arm with these joints.

    ``text`` is as on the command line, e.g. ``gear_eccentricity:joint_3:size=1e-4,order=1``; components of a vector are
    separated by a slash, as commas separate keys.

    Raises:
        BadInputError: For a name, joint, key or value that can't be, with those that can.

    Example:
        >>> parse_effect("axis_wobble:j2:size=1e-4,order=1,frame=after", ("j1", "j2"))
        ('axis_wobble', {'joint': 'j2', 'size': 0.0001, 'order': 1, 'frame': 'after'})
    """
    name, *parts = (part.strip() for part in text.split(":"))
    kind = HIDDEN_EFFECTS.get(name)
    if kind is None:
        near = ", ".join(nearest_first([name], HIDDEN_EFFECTS))
        raise BadInputError(f"effect {name!r}: unknown; expected one of {near}")
    values: dict[str, Any] = {}
    for part in parts:
        pairs = part.split(",") if "=" in part else [f"joint={part}"]
        for pair in pairs:
            key, value = _read(text, kind, pair, keys=_keys(kind) if "=" in part else ["joint"])
            if key in ("joint", "source") and value not in joints:
                near = ", ".join(nearest_first([value], joints))
                raise BadInputError(f"effect {text!r}: no joint {value!r}; expected one of {near}")
            if key in values:
                raise BadInputError(f"effect {text!r}: {key} is given twice")
            values[key] = value
    return name, values


def effect_help() -> str:
    """Return the effects with their keys and units as lines of help."""
    lines = []
    for name, kind in HIDDEN_EFFECTS.items():
        keys = ", ".join([f"size [{kind.unit}]", *_keys(kind)[1:]])
        lines.append(f"  {name}{'' if kind.scope is Scope.ARM else ':JOINT'}: {keys}")
    return "\n".join(lines)


def _keys(kind: type[HiddenEffect]) -> list[str]:
    """Return the keys of an effect, size first."""
    return ["size", *(field.name for field in fields(kind) if field.name not in ("joint", "size"))]


def _read(text: str, kind: type[HiddenEffect], pair: str, *, keys: list[str]) -> tuple[str, Any]:
    """Return key and value of one ``key=value``."""
    key, equals, value = (word.strip() for word in pair.partition("="))
    if not equals or key not in keys:
        raise BadInputError(f"effect {text!r}: no key {key!r}; {kind.effect} has {', '.join(keys)}, as key=value")
    if key in _CHOICES and value not in _CHOICES[key]:
        raise BadInputError(f"effect {text!r}: {key}={value}; expected one of {', '.join(_CHOICES[key])}")
    types = {field.name: str(field.type).removesuffix(" | None") for field in fields(kind)}
    read, words = _READERS[types[key]]
    try:
        return key, read(value)
    except (KeyError, ValueError):
        raise BadInputError(f"effect {text!r}: {key}={value}; expected {words}") from None


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def _vector(text: str) -> tuple[float, ...]:
    x, y, z = map(_number, text.split("/"))
    return x, y, z


# How the value of a field of a type is read, and what is expected.
_READERS: dict[str, tuple[Callable[[str], Any], str]] = {
    "float": (_number, "a number"),
    "int": (int, "a whole number"),
    "str": (str, "a name"),
    "bool": ({"true": True, "false": False}.__getitem__, "true or false"),
    "tuple[float, float, float]": (_vector, "three numbers, as 1/0/0"),
}
