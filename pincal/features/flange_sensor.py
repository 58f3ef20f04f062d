"""A sensor on the flange that a calibration does not know, or knows less of: mount, camera, noise
and ball of a probe, from a file ``sensor.toml``.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pincal.errors import BadInputError, nearest_first
from pincal.io.keyed_table import DefaultUnits, KeyedTable, read_toml
from pincal.robot.se3 import rotation_of_rpy, transform
from pincal.sensors.lens import DISTORTION, PINHOLE, Lens

# Dimensions of what each table may have.
_KNOWN: dict[str, dict[str, str]] = {
    "mount": {
        "position": "length",
        "rotation": "angle",
        "u_position": "length",
        "u_rotation": "angle",
    },
    "noise": {"position": "length", "pixel_px": "number"},
    "probe": {"radius": "length", "u_radius": "length"},
    "camera": dict.fromkeys((*PINHOLE, *DISTORTION), "number"),
}


@dataclass(frozen=True, eq=False)
class FlangeSensor:
    """A sensor on the flange, as far as it is declared.

    Attributes:
        mount: shape (3, 4), the sensor's frame in the tip's frame [m]; None: as calibrated.
        mount_sigma: shape (6,), standard uncertainties of its position along the axes of the tip
            [m], and of its orientation about these [rad].
        lens: the camera; None: as calibrated.
        noise: shape (3,), standard deviations of the coordinates of a point in the sensor's frame,
            the last of which is that of a distance [m]; None: as calibrated.
        pixel_noise: of one coordinate of an image [px]; None: as calibrated.
        radius: of the ball of a probe [m]; 0 where rows are of the contact itself.
        radius_sigma: its standard uncertainty [m].
    """

    mount: np.ndarray | None = None
    mount_sigma: np.ndarray = field(default_factory=lambda: np.zeros(6))
    lens: Lens | None = None
    noise: np.ndarray | None = None
    pixel_noise: float | None = None
    radius: float = 0.0
    radius_sigma: float = 0.0

    def with_noise(self, size: float, unit: str) -> FlangeSensor:
        """Return the sensor with another noise: of a coordinate of a point [m] or, with the unit
        "px", of an image.
        """
        if unit == "px":
            return replace(self, pixel_noise=size)
        return replace(self, noise=np.full(3, size))

    @classmethod
    def from_toml(cls, path: str | os.PathLike[str]) -> FlangeSensor:
        """Read a sensor.

        The file has the tables ``mount`` (``position_mm = [x, y, z]``, ``rotation_deg = [roll,
        pitch, yaw]`` as in URDF, ``u_position_mm`` and ``u_rotation_mrad``, one number or three),
        ``camera`` (``fx fy u0 v0`` in px and ``k1 k2 p1 p2 k3``), ``noise`` (``position_mm``,
        ``pixel_px``) and ``probe`` (``radius_mm``, ``u_radius_mm``), each of which may be absent;
        other units are m, um, rad, mrad.

        Raises:
            BadInputError: for a file that can't be read, an unknown key or unit, or a value that is
                none.
        """
        path = Path(path)
        tables = read_toml(path, "TOML with tables mount, camera, noise or probe")
        for name, table in tables.items():
            if name not in _KNOWN:
                known = ", ".join(nearest_first([name], _KNOWN))
                raise BadInputError(f"{path}: unknown table [{name}]; expected one of {known}")
            if not isinstance(table, dict):
                raise BadInputError(f"{path}: {name} = {table!r}; expected a table [{name}]")
        of = {name: _table(path, name, tables.get(name, {})) for name in _KNOWN}
        return cls(
            mount=_mount(of["mount"]),
            mount_sigma=_spread(of["mount"]),
            lens=_lens(of["camera"]) if "camera" in tables else None,
            noise=_each(of["noise"], "position"),
            pixel_noise=_one(of["noise"], "pixel_px"),
            radius=_one(of["probe"], "radius") or 0.0,
            radius_sigma=_one(of["probe"], "u_radius") or 0.0,
        )


def _table(path: Path, name: str, entries: Mapping[str, Any]) -> KeyedTable:
    return KeyedTable(f"{path}, [{name}]", entries, DefaultUnits(), _KNOWN[name])


def _mount(table: KeyedTable) -> np.ndarray | None:
    """Return the pose of the sensor in the tip's frame, shape (3, 4)."""
    if not table.entries:
        return None
    for name, key in (("position", "position_mm"), ("rotation", "rotation_deg")):
        if name not in table:
            raise table.error(key, f"{key} of the sensor's frame in the tip's, three numbers")
    position = table.numbers("position", (3,))
    return transform(rotation_of_rpy(table.numbers("rotation", (3,))), position)[:3]


def _spread(table: KeyedTable) -> np.ndarray:
    """Return the standard uncertainties of a mount, shape (6,)."""
    parts = [_each(table, name) for name in ("u_position", "u_rotation")]
    return np.concatenate([np.zeros(3) if part is None else part for part in parts])


def _each(table: KeyedTable, name: str) -> np.ndarray | None:
    """Return a size along each of three axes, shape (3,), from one number or three; None if it is
    absent.
    """
    if name not in table:
        return None
    numbers = table.numbers(name, (1, 3))
    if np.any(numbers < 0.0):
        raise table.error(name, "numbers of 0 or more")
    return np.broadcast_to(numbers, 3).copy()


def _one(table: KeyedTable, name: str) -> float | None:
    """Return a size, None if it is absent."""
    if name not in table:
        return None
    number = table.number(name)
    if number < 0.0:
        raise table.error(name, "a number of 0 or more")
    return number


def _lens(table: KeyedTable) -> Lens:
    """Return the camera of a table."""
    for name in PINHOLE:
        if name not in table:
            raise table.error(name, "fx fy u0 v0 in pixels")
    numbers = {name: table.number(name) for name in table.entries}
    for name in ("fx", "fy"):
        if numbers[name] <= 0.0:
            raise table.error(name, "a focal length of more than 0 pixels")
    return Lens(**numbers)
