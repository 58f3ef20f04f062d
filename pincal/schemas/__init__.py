"""JSON Schemas of the files that pincal reads and writes, generated from their structures.

``python -m pincal.schemas`` regenerates them in this folder; a test compares them with the
structures. Structures of files of satellites are handed in.
"""

from __future__ import annotations

import inspect
import json
from pathlib import Path
from typing import Any

import msgspec

from pincal.calibration.check_record import CheckRecord
from pincal.calibration.information import RobotInformation
from pincal.calibration.model_file import ModelFile
from pincal.calibration.result import ResultFile
from pincal.io.camera_file import CameraFile
from pincal.io.entries import EFFECT_SCHEMA
from pincal.model.effect import Effect
from pincal.satellites import Place

_FILES: dict[str, type] = {
    "model": ModelFile,
    "result": ResultFile,
    "checks": CheckRecord,
    "camera": CameraFile,
    "information": RobotInformation,
}
_FURTHER: Place[type] = Place("schemas")
_DRAFT = "https://json-schema.org/draft/2020-12/schema"
# Keywords that not all supported versions of msgspec write; 0.23 is the first with this one.
_OF_SOME_VERSIONS = ("propertyNames",)


def names() -> tuple[str, ...]:
    """Return the names of the files, those of satellites last."""
    return (*_FILES, *_FURTHER.names())


def structure_of(name: str) -> type:
    """Return the structure of a file.

    Args:
        name: one of :func:`names`.

    Raises:
        KeyError: if there is no such file.
    """
    return _FILES[name] if name in _FILES else _FURTHER[name]


def schema_of(name: str) -> dict[str, Any]:
    """Return the JSON Schema of a file.

    Args:
        name: one of :func:`names`, such as "model" or "result".

    Example:
        >>> schema_of("camera")["$defs"]["CameraFile"]["required"]
        ['fx', 'fy', 'u0', 'v0']
    """
    schema = msgspec.json.schema(structure_of(name), schema_hook=_own)
    return {"$schema": _DRAFT, **_as_of_all_versions(schema)}


def shipped(name: str) -> Path:
    """Return where the schema of a file of pincal comes with the package."""
    return Path(__file__).with_name(f"{name}.json")


def text_of(name: str) -> str:
    """Return the schema of a file as text."""
    return json.dumps(schema_of(name), indent=1, sort_keys=True) + "\n"


def _as_of_all_versions(node: Any) -> Any:
    """Return a part of a schema as all supported versions of Python and msgspec write it.

    Some leave the indent of docstrings in descriptions.
    """
    if isinstance(node, list):
        return [_as_of_all_versions(each) for each in node]
    if not isinstance(node, dict):
        return node
    found = {
        key: _as_of_all_versions(value)
        for key, value in node.items()
        if key not in _OF_SOME_VERSIONS
    }
    if isinstance(text := found.get("description"), str):
        found["description"] = inspect.cleandoc(text)
    return found


def _own(kind: type) -> dict[str, Any]:
    """Return the schema of a type unknown to msgspec; arrays have theirs in annotations."""
    return EFFECT_SCHEMA if kind is Effect else {}
