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


# The topic of names that have moved to their modules, for one release.
_MOVED = "Moved: for one release, with a warning"


@cache
def _topics() -> dict[str, dict[str, str]]:
    """Return the public names with their modules, topic by topic."""
    stub = Path(__file__).with_name("__init__.pyi").read_text(encoding="utf-8")
    topics = re.findall(r"^# (.+)\n((?:from .+\n)+)", stub, re.MULTILINE)
    return {
        topic: {name: module for module, name in re.findall(r"from (\S+) import (\w+)", lines)}
        for topic, lines in topics
    }


@cache
def _homes() -> dict[str, str]:
    """Return the module of each public name."""
    return {
        name: module
        for topic, names in _topics().items()
        for name, module in names.items()
        if topic != _MOVED
    }


def _moved(name: str) -> str | None:
    """Return the module of a name that is no longer here, if it is one."""
    return _topics()[_MOVED].get(name)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return importlib.import_module("importlib.metadata").version("pincal")
    if name == "__all__":
        return sorted(_homes())
    new, _, part = _RENAMED.get(name, name).partition(".")
    home = _moved(new) or _homes().get(new)
    if home is None:
        raise AttributeError(f"module 'pincal' has no attribute {name!r}")
    found = getattr(importlib.import_module(home), new)
    if name in _RENAMED or _moved(name):
        # After the import: libraries set filters in it, by which Python forgets what it has shown.
        place = f"{home}.{new}" if _moved(new) else f"pincal.{_RENAMED[name]}"
        warnings.warn(f"pincal.{name} is now {place}", DeprecationWarning, stacklevel=2)
    return getattr(found, part) if part else found


def __dir__() -> list[str]:
    return ["__version__", *sorted(_homes())]
