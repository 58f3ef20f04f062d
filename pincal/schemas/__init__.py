"""JSON Schemas of the files that pincal reads and writes, generated from their structures.

``python -m pincal.io.schemas`` regenerates them in this folder; a test compares them with the
structures.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec

from pincal.calibration.information import RobotInformation
from pincal.calibration.model_file import ModelFile
from pincal.calibration.result import ResultFile
from pincal.fleet.robot_type import RobotType
from pincal.io.camera_file import CameraFile
from pincal.io.diagnosis_file import DiagnosisFile
from pincal.io.discovery_file import Findings
from pincal.io.entries import EFFECT_SCHEMA
from pincal.model.effect import Effect

FILES: dict[str, type] = {
    "model": ModelFile,
    "result": ResultFile,
    "discovery": Findings,
    "diagnosis": DiagnosisFile,
    "camera": CameraFile,
    "information": RobotInformation,
    "type": RobotType,
}
_DRAFT = "https://json-schema.org/draft/2020-12/schema"


def schema_of(name: str) -> dict[str, Any]:
    """Return the JSON Schema of a file.

    Args:
        name: "model", "result", "discovery", "diagnosis",
            "camera", "information" or "type".

    Example:
        >>> schema_of("camera")["$defs"]["CameraFile"]["required"]
        ['fx', 'fy', 'u0', 'v0']
    """
    return {"$schema": _DRAFT, **msgspec.json.schema(FILES[name], schema_hook=_own)}


def shipped(name: str) -> Path:
    """Return where the schema of a file comes with the package."""
    return Path(__file__).with_name(f"{name}.json")


def text_of(name: str) -> str:
    """Return the schema of a file as text."""
    return json.dumps(schema_of(name), indent=1, sort_keys=True) + "\n"


def _own(kind: type) -> dict[str, Any]:
    """Return the schema of a type unknown to msgspec; arrays have theirs in annotations."""
    return EFFECT_SCHEMA if kind is Effect else {}
