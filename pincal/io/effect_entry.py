"""An effect in a file: its name and the fields of its dataclass."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import Field, fields
from typing import Any

import msgspec
import numpy as np

# Imported for its classes, which it registers.
import pincal.model.catalogue  # noqa: F401
from pincal.errors import nearest_first
from pincal.io.arrays import array_of
from pincal.io.strict_json import MISSING, Fault, explained, what_is
from pincal.model.effect import Effect
from pincal.model.registry import EFFECTS

SCHEMA: dict[str, Any] = {"type": "object", "properties": {"name": {"type": "string"}}, "required": ["name"]}


def known_effects() -> Mapping[str, type[Effect]]:
    """Return the registered effects by name, those of plugins among them."""
    return EFFECTS.known()


def effect_to_entry(effect: Effect) -> dict[str, Any]:
    """Return an effect's name and fields in types that JSON knows; an array is ``{"array": ...}``.

    An effect that is not pincal's own comes with the module that defines it. Reading never imports that module: a user has
    to name it, as a plugin.
    """
    module = type(effect).__module__
    origin = {} if module.split(".")[0] == "pincal" else {"module": module}
    values = {field.name: getattr(effect, field.name) for field in _fields(effect)}
    values = {name: effect_to_entry(value) if isinstance(value, Effect) else value for name, value in values.items()}
    return {"name": effect.name, **origin, **msgspec.to_builtins(values, enc_hook=_plain)}


def effect_from_entry(entry: Any) -> Effect:
    """Return the effect of :func:`effect_to_entry`; a field that is not there has its default.

    Raises:
        Fault: if no effect has this name, or not these fields, or of other types.
    """
    if not isinstance(entry, dict):
        raise Fault(what_is(entry, "an object"), "an object")
    name, known = entry.get("name"), known_effects()
    if "name" not in entry:
        raise Fault(MISSING, "this key", key=".name")
    if not isinstance(name, str):
        raise Fault(what_is(name, "a text"), "a text", key=".name")
    if name not in known:
        if isinstance(module := entry.get("module"), str):
            raise Fault(f"effect {name!r} is not pincal's own", f"its module to be loaded: --plugin {module}", key=".name")
        names = ", ".join(nearest_first([name], sorted(known)))
        raise Fault(f"unknown effect {name!r}", f"one of {names} (a newer pincal may know it)", key=".name")
    given = {key: value for key, value in entry.items() if key not in ("name", "module")}
    wanted = [field.name for field in _fields(known[name])]
    for key in given.keys() - set(wanted):
        raise Fault(f"{name} has no such field", f"only {', '.join(wanted) or 'the name'}", key=f".{key}")
    try:
        return msgspec.convert(given, known[name], dec_hook=_restored)
    except msgspec.ValidationError as error:
        place, problem, expected = explained(error, lambda: given, known[name])
        raise Fault(problem, expected, key=f".{place}" if place else "") from None
    except (TypeError, ValueError) as error:
        raise Fault(f"{name} can't be made of these fields ({error})", "fields as pincal writes them") from None


def _fields(effect: Effect | type[Effect]) -> tuple[Field[Any], ...]:
    # Every effect is a dataclass, which the abstract base can't say.
    return tuple(field for field in fields(effect) if field.init)  # type: ignore[arg-type]


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {"array": value.tolist()}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a field of type {type(value).__name__} can't be written to model.json; use numbers, texts and tuples")


def _restored(kind: Any, value: Any) -> Any:
    if kind is Effect:
        return effect_from_entry(value)
    if kind is np.ndarray and isinstance(value, dict) and "array" in value:
        return array_of(value["array"])
    raise Fault(what_is(value, "an array"), 'an array, {"array": ...}')
