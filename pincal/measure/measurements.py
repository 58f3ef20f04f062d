"""Measured poses of one robot as arrays in SI units, checked when they are built."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pincal.errors import MeasurementError
from pincal.measure.fields import ARRAYS, FIELDS, KINDS, nearest_first

# A quaternion written with four decimals is off by less; a wrong column is off by more.
_QUATERNION_TOLERANCE = 0.01


@dataclass(frozen=True, eq=False, repr=False)
class Measurements:
    """Measured poses of one robot, one row each; absent columns are None and all arrays are read-only.

    Example:
        >>> poses = measurements_from_arrays(["a", "b"], [[0.0, 1.0], [0.5, 1.0]], distance=[1.2, 1.3])
        >>> poses, poses.kind, poses.select(poses.q[:, 0] > 0.1).distance
        (Measurements('arrays': 2 rows, distance, joints a b), 'distance', array([1.3]))
    """

    joint_names: tuple[str, ...]
    q: np.ndarray
    """Joint positions [rad], prismatic [m], shape (N, n)."""
    target: np.ndarray
    """Name of the measured target on the tool, shape (N,)."""
    rows: np.ndarray
    """Line of each row in its file, the header being line 1, shape (N,)."""
    source: str
    """Name of the file, for messages."""
    position: np.ndarray | None = None
    """Target in the instrument's frame [m], shape (N, 3)."""
    quaternion: np.ndarray | None = None
    """Orientation of the tool in the instrument's frame, x y z w, normalised, shape (N, 4)."""
    distance: np.ndarray | None = None
    """From the instrument's point to the target [m], shape (N,)."""
    anchor: np.ndarray | None = None
    """Name of the fixed point that each distance is measured from, where there are several, shape (N,)."""
    socket: np.ndarray | None = None
    """Name of the fixed point that held the tool point, shape (N,)."""
    camera_point: np.ndarray | None = None
    """Point of the calibration object in the camera's frame [m], shape (N, 3)."""
    pixel: np.ndarray | None = None
    """The same point in the image [px], shape (N, 2)."""
    point: np.ndarray | None = None
    """Name of the point of the calibration object, shape (N,)."""
    payload: np.ndarray | None = None
    """Payload [kg], shape (N,)."""
    temperature: np.ndarray | None = None
    """Temperature [deg C], shape (N,)."""
    time: np.ndarray | None = None
    """Time [s], shape (N,)."""
    approach: np.ndarray | None = None
    """Direction from which each joint arrived: -1, 0 (unknown) or 1, shape (N, n)."""
    sigma: np.ndarray | None = None
    """Standard deviation of the row [m], shape (N,)."""
    units: Mapping[str, str] = field(default_factory=dict)
    """The units that the header gave, by column; what is not in it was taken as SI."""

    def __post_init__(self) -> None:
        for name, array in self._present().items():
            view = array.view()
            view.flags.writeable = False
            object.__setattr__(self, name, view)

    def __len__(self) -> int:
        return len(self.q)

    def __repr__(self) -> str:
        joints = " ".join(self.joint_names)
        return f"Measurements({self.source!r}: {len(self)} rows, {self.kind}, joints {joints})"

    @property
    def kind(self) -> str:
        """What was measured: position, pose, distance, socket, camera_point, camera_pixel or none."""
        if self.quaternion is not None:
            return "pose"
        return next((kind for name, kind in KINDS.items() if getattr(self, name) is not None), "none")

    def select(self, index_or_mask: Any) -> Measurements:
        """Return the rows that an index, a slice or a boolean mask of shape (N,) selects, in that order."""
        take = np.atleast_1d(np.arange(len(self))[index_or_mask])
        chosen: dict[str, Any] = {name: array[take] for name, array in self._present().items()}
        return replace(self, **chosen)

    def _present(self) -> dict[str, np.ndarray]:
        return {name: getattr(self, name) for name in ARRAYS if getattr(self, name) is not None}


def measurements_from_arrays(
    joint_names: Sequence[str],
    q: ArrayLike,
    *,
    rows: ArrayLike | None = None,
    source: str = "arrays",
    units: Mapping[str, str] | None = None,
    **columns: ArrayLike | None,
) -> Measurements:
    """Build measurements from arrays in SI units, which are checked and copied.

    Args:
        joint_names: Names of the n joints, in the order of the columns of q.
        q: Joint positions [rad], prismatic [m], shape (N, n).
        rows: Line numbers for messages, shape (N,); by default 2, 3, ... as if read from a file.
        source: Name of the data for messages.
        units: Units that were stated explicitly, by column name; an entry marks a column as intended.
        **columns: position, quaternion, distance, anchor, socket, camera_point, pixel, point, target, payload,
            temperature, time, approach, sigma, shaped as in `Measurements`; None is absent.

    Returns:
        The measurements; target is "tool" (of a camera's readings "camera") in each row unless given, quaternions are
        normalised.

    Raises:
        MeasurementError: Unknown column, wrong shape, value that can't be, or two kinds of measurement.
    """
    unknown = [name for name in columns if name not in ARRAYS]
    if unknown:
        known = ", ".join(nearest_first(unknown, [name for name in ARRAYS if name not in ("q", "rows")]))
        raise MeasurementError(f'{source}: unknown column "{unknown[0]}"; known columns: {known}')
    names, arrays = tuple(joint_names), {}
    for name, value in {"q": q, "rows": rows, **columns}.items():
        if value is not None:
            arrays[name] = _as_array(name, value, source=source)
    _check_shapes(names, arrays, source=source)
    return validated(names, arrays, source=source, units=dict(units or {}))


def concatenate(tables: Sequence[Measurements]) -> Measurements:
    """Join tables of the same joints and columns, one below the other.

    Args:
        tables: At least one table; each keeps its own line numbers.

    Returns:
        All rows; the source names all files, units are those that all tables stated.

    Raises:
        MeasurementError: No table at all, other joints, or a column that only some tables have.
    """
    if not tables:
        raise MeasurementError("no table to join; expected at least one")
    first = tables[0]
    for other in tables[1:]:
        if other.joint_names != first.joint_names:
            expected, got = ", ".join(first.joint_names), ", ".join(other.joint_names)
            raise MeasurementError(f"{other.source}: joints {got}; {first.source} has {expected}")
        odd = sorted(set(first._present()) ^ set(other._present()))
        if odd:
            raise MeasurementError(f'"{odd[0]}" is in only one of {first.source} and {other.source}; add or drop it')
    parts = [table._present() for table in tables]
    joined: dict[str, Any] = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    units = {k: v for k, v in first.units.items() if all(table.units.get(k) == v for table in tables)}
    source = ", ".join(dict.fromkeys(table.source for table in tables))
    return replace(first, **joined, units=units, source=source)


def validated(
    names: tuple[str, ...], arrays: dict[str, np.ndarray], *, source: str, units: Mapping[str, str]
) -> Measurements:
    """Return the measurements of these arrays, which are checked but not copied."""
    count = len(arrays["q"])
    arrays.setdefault("rows", np.arange(2, count + 2))
    is_camera = "camera_point" in arrays or "pixel" in arrays
    arrays.setdefault("target", np.broadcast_to(np.array("camera" if is_camera else "tool"), count))
    kinds = [name for name in KINDS if name in arrays]
    if len(kinds) > 1:
        found = " and ".join(" ".join(FIELDS[name][1]) for name in kinds)
        raise MeasurementError(f"{source}: two kinds of measurement ({found}); expected one, ignore the others")
    pairs = (("quaternion", "position"), ("anchor", "distance"), ("camera_point", "point"), ("pixel", "point"))
    for needs, needed in pairs:
        if needs in arrays and needed not in arrays:
            got, missing = (" ".join(FIELDS[name][1]) for name in (needs, needed))
            raise MeasurementError(f"{source}: {got} without {missing}; add what is missing, or ignore {got}")
    _check_values(arrays, source=source)
    if "quaternion" in arrays:
        arrays["quaternion"] /= np.linalg.norm(arrays["quaternion"], axis=1, keepdims=True)
    if "approach" in arrays:
        arrays["approach"] = arrays["approach"].astype(np.int8)
    rest: dict[str, Any] = {name: array for name, array in arrays.items() if name in ARRAYS}
    return Measurements(joint_names=names, source=source, units=units, **rest)


def _as_array(name: str, value: ArrayLike, *, source: str) -> np.ndarray:
    is_name = name in FIELDS and FIELDS[name][0] == "name"
    try:
        return np.array(value, dtype=str if is_name else int if name == "rows" else float)
    except (TypeError, ValueError) as error:
        raise MeasurementError(f'{source}: "{name}" is not an array of {"names" if is_name else "numbers"}') from error


def _check_shapes(names: tuple[str, ...], arrays: Mapping[str, np.ndarray], *, source: str) -> None:
    if arrays["q"].ndim != 2 or arrays["q"].shape[1] != len(names):
        raise MeasurementError(f"{source}: q has shape {arrays['q'].shape}; expected (N, {len(names)}), a column a joint")
    for name, array in arrays.items():
        width = len(FIELDS[name][1]) if name in FIELDS else 1
        is_joint = name in ("q", "approach")
        expected = (len(arrays["q"]), *([len(names)] if is_joint else [width] if width > 1 else []))
        if array.shape != expected:
            raise MeasurementError(f'{source}: "{name}" has shape {array.shape}; expected {expected}, as for q')


def _check_values(arrays: Mapping[str, np.ndarray], *, source: str) -> None:
    rules: dict[str, tuple[str, Any]] = {
        name: ("a finite number", np.isfinite) for name, array in arrays.items() if array.dtype.kind in "fi"
    }
    for name in ("sigma", "distance"):
        rules[name] = ("a number > 0", lambda value: np.isfinite(value) & (value > 0))
    rules["approach"] = ("-1, 0 or 1", lambda value: np.isin(value, (-1, 0, 1)))
    rules["quaternion"] = (
        f"norm 1 within {_QUATERNION_TOLERANCE:.0%}",
        lambda value: np.abs(np.linalg.norm(value, axis=1) - 1) <= _QUATERNION_TOLERANCE,
    )
    for name, (expected, is_right) in rules.items():
        right = is_right(arrays[name]) if name in arrays else np.ones(1, dtype=bool)
        if not right.all():
            wrong = np.flatnonzero(~right.reshape(len(right), -1).all(axis=1))
            raise MeasurementError(
                f'{source}, line {arrays["rows"][wrong[0]]}, "{name}": {arrays[name][wrong[0]].tolist()}; '
                f"expected {expected}; rows like this: {wrong.size}; correct or delete them"
            )
