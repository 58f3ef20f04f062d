"""A sensor on the flange that a calibration does not know, or knows less of: mount, camera, noise
and ball of a probe, from a file ``sensor.toml``.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pincal.errors import BadInputError, nearest_first
from pincal.robot.se3 import rotation_of_rpy, transform
from pincal.sensors.lens import DISTORTION, PINHOLE, Lens
from pincal.units import SIZES

_LENGTHS = ("m", "mm", "um")
_ANGLES = ("rad", "mrad", "deg")
_KEYS: dict[str, dict[str, tuple[str, ...]]] = {
    "mount": {
        "position": _LENGTHS,
        "rotation": _ANGLES,
        "u_position": _LENGTHS,
        "u_rotation": _ANGLES,
    },
    "noise": {"position": _LENGTHS, "pixel": ("px",)},
    "probe": {"radius": _LENGTHS, "u_radius": _LENGTHS},
}
# How many numbers a value may have.
_COUNTS: dict[tuple[str, str], tuple[int, ...]] = {
    ("mount", "position"): (3,),
    ("mount", "rotation"): (3,),
    ("mount", "u_position"): (1, 3),
    ("mount", "u_rotation"): (1, 3),
    ("noise", "position"): (1, 3),
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
        try:
            tables = tomllib.loads(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise BadInputError(
                f"{path}: can't be read ({error}); expected TOML with tables mount, camera, noise "
                "or probe"
            ) from None
        for name, table in tables.items():
            if name not in (*_KEYS, "camera") or not isinstance(table, dict):
                known = nearest_first([name], (*_KEYS, "camera"))
                raise BadInputError(
                    f"{path}: unknown table [{name}]; expected one of {', '.join(known)}"
                )
        found = {name: _numbers(path, name, tables.get(name, {})) for name in _KEYS}
        return cls(
            mount=_mount(path, found["mount"]),
            mount_sigma=_spread(found["mount"]),
            lens=_lens(path, tables["camera"]) if "camera" in tables else None,
            noise=_each(found["noise"], "position"),
            pixel_noise=_one(found["noise"], "pixel"),
            radius=_one(found["probe"], "radius") or 0.0,
            radius_sigma=_one(found["probe"], "u_radius") or 0.0,
        )


def _numbers(path: Path, table: str, entries: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the numbers of a table in SI units by their names without units."""
    known = {
        f"{name}_{unit}": (name, unit) for name, units in _KEYS[table].items() for unit in units
    }
    found = dict[str, np.ndarray]()
    for key, value in entries.items():
        where = f"{path}, {table}.{key}"
        if key not in known:
            raise BadInputError(
                f"{where}: unknown key; expected one of {', '.join(nearest_first([key], known))}"
            )
        name, unit = known[key]
        if name in found:
            raise BadInputError(f"{where}: {name} is given twice; expected it in one unit")
        numbers = _array(where, value, _COUNTS.get((table, name), (1,)))
        is_signed = table == "mount" and name in ("position", "rotation")
        if not is_signed and np.any(numbers < 0.0):
            raise BadInputError(f"{where} is {value!r}; expected 0 or more")
        found[name] = numbers * SIZES[unit]
    return found


def _array(where: str, value: Any, counts: tuple[int, ...]) -> np.ndarray:
    """Return a number, or a list of them, of one of these counts."""
    values = value if isinstance(value, list) else [value]
    are_numbers = all(
        isinstance(each, int | float) and not isinstance(each, bool) for each in values
    )
    numbers = np.array(values, float) if are_numbers else np.zeros(0)
    if len(numbers) not in counts or not np.isfinite(numbers).all():
        words = "three numbers" if counts == (3,) else "a number"
        words += ", or three" if counts == (1, 3) else ""
        raise BadInputError(f"{where} is {value!r}; expected {words}")
    return numbers


def _mount(path: Path, found: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Return the pose of the sensor in the tip's frame, shape (3, 4)."""
    if not found:
        return None
    if "position" not in found or "rotation" not in found:
        missing = "position_mm" if "position" not in found else "rotation_deg"
        raise BadInputError(
            f"{path}: mount without {missing}; expected position_mm = [x, y, z] and rotation_deg = "
            "[roll, pitch, yaw] of the sensor's frame in the tip's"
        )
    return transform(rotation_of_rpy(found["rotation"]), found["position"])[:3]


def _spread(found: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the standard uncertainties of a mount, shape (6,)."""
    parts = [_each(found, name) for name in ("u_position", "u_rotation")]
    return np.concatenate([np.zeros(3) if part is None else part for part in parts])


def _each(found: Mapping[str, np.ndarray], name: str) -> np.ndarray | None:
    """Return a value along each of three axes, shape (3,)."""
    return np.broadcast_to(found[name], 3).copy() if name in found else None


def _one(found: Mapping[str, np.ndarray], name: str) -> float | None:
    return float(found[name][0]) if name in found else None


def _lens(path: Path, entries: Mapping[str, Any]) -> Lens:
    """Return the camera of a table."""
    known = (*PINHOLE, *DISTORTION)
    for key, value in entries.items():
        if key not in known:
            near = ", ".join(nearest_first([key], known))
            raise BadInputError(f"{path}, camera.{key}: unknown key; expected one of {near}")
        _array(f"{path}, camera.{key}", value, (1,))
    missing = [name for name in PINHOLE if name not in entries]
    if missing or entries["fx"] <= 0.0 or entries["fy"] <= 0.0:
        raise BadInputError(
            f"{path}: camera {f'without {missing[0]}' if missing else 'with a focal length <= 0'}; "
            "expected fx fy (more than 0) and u0 v0 in pixels"
        )
    return Lens(**{name: float(value) for name, value in entries.items()})
