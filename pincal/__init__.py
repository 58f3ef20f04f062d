"""Calibrate a serial robot into a measuring instrument: from a URDF and measured poses to a true
robot model.

Names are imported when they are first used, from where ``__init__.pyi`` says: Pinocchio, Numba and
SciPy take longer to load than most commands to run.

Example:
    >>> import pincal
    >>> robot = pincal.Robot.from_urdf("ur10")
    >>> robot.n_joints
    6
"""

from __future__ import annotations

import importlib
import re
import warnings
from functools import cache
from pathlib import Path
from typing import Any

# Names of earlier versions, for one release.
_RENAMED = {
    "CalibratedModel": "FittedRobot",
    "CalibratedRobot": "FittedRobot",
    "CalibratedStations": "FittedRobot",
    "Fit": "FittedRobot",
    "Gap": "KnownDistance",
    "Rig": "SensorSetup",
    "Situation": "PoseSet",
    "calibrated_model": "pinocchio_model",
    "calibrated_model_of": "FittedRobot.of",
}


@cache
def _homes() -> dict[str, str]:
    """Return the module of each public name."""
    stub = Path(__file__).with_name("__init__.pyi").read_text(encoding="utf-8")
    return {
        name: module for module, name in re.findall(r"^from (\S+) import (\w+)", stub, re.MULTILINE)
    }


def __getattr__(name: str) -> Any:
    if name in _RENAMED:
        warnings.warn(
            f"pincal.{name} is now pincal.{_RENAMED[name]}", DeprecationWarning, stacklevel=2
        )
        name = _RENAMED[name]
    if name == "__version__":
        return importlib.import_module("importlib.metadata").version("pincal")
    if name == "__all__":
        return sorted(_homes())
    name, _, part = name.partition(".")
    if name not in _homes():
        raise AttributeError(f"module 'pincal' has no attribute {name!r}")
    found = getattr(importlib.import_module(_homes()[name]), name)
    return getattr(found, part) if part else found


def __dir__() -> list[str]:
    return ["__version__", *sorted(_homes())]
