r"""Errors of a model at measured poses in practical units, and accuracy and repeatability by ISO
9283.

The error at a pose is the distance between the predicted and the measured target: the position
accuracy of ISO 9283 for a single measurement. The orientation error is one angle.

Replicates, repeated measurements of one pose, are found by :mod:`pincal.measure.poses`. With l_j
the distance of replicate j from the mean of n replicates,

.. math:: AP = |\bar x - x_c|, \quad RP = \bar l + 3 S_l, \quad AP_a = |\bar a - a_c|,
          \quad RP_a = 3 S_a

(ISO 9283:1998, 7.2; S with n - 1; a, b, c turn about x, y, z). The commanded pose of the standard
is here the prediction for the joint positions that were read: AP is the accuracy of a controller
that uses this model. Both follow from residuals, so that small differences in the final joint
positions do not count as the arm's error.

A pose with any replicate among the fitted rows does not count as held out.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import repeat
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pincal.errors import counted
from pincal.identify.station import Station
from pincal.measure.measurements import Measurements
from pincal.thresholds import Count
from pincal.units import Unit, readable_unit

CYCLES: Count = 30
"""Cycles, measurements of each pose, that ISO 9283 requires."""

_ANGLES = "abc"

ERROR_UNITS = ("mm", "mrad", "px", "m/s^2", "mrad/s")
"""Units of errors."""

ANGLE_WORDS = {"AP_mm": "mm"} | {
    f"AP_{a}_mrad": f"mrad about {axis}" for a, axis in zip(_ANGLES, "xyz", strict=True)
}
"""Unit of each kind of accuracy."""


def pose_error_sizes(
    station: Station, values: np.ndarray, *, residuals: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Return the size of the error at each row by its unit, one of ``ERROR_UNITS``, shape (N,)
    each; empty without rows.

    Errors of images are also given in mm, across the view at the distance of the point.
    ``residuals``, shape (m, N), are of predictions by nearby values; default: by these.
    """
    if not len(station):
        return {}
    known = residuals
    residuals = station.residuals(values) if known is None else known
    found = dict[str, np.ndarray]()
    if station.sensor.blocks[0].unit != "m" and station.sensor.reads_place:
        found["mm"] = 1e3 * np.linalg.norm(station.displacements(values, residuals=known), axis=1)
    for block, rows in zip(station.sensor.blocks, station.block_rows, strict=True):
        unit = Unit(1e3, "mrad/s") if block.unit == "rad/s" else readable_unit(block.unit)
        found[unit.name] = np.linalg.norm(residuals[rows], axis=0) * unit.factor
    return found


def error_summary(station: Station, values: np.ndarray) -> dict[str, float]:
    """Return the statistics of the errors by name and unit; empty without rows.

    They are ``mean_mm``, ``median_mm``, ``rms_mm``, ``p95_mm`` (95th percentile) and ``max_mm``;
    for orientations ``mean_mrad`` and so on, for images ``mean_px`` and so on.
    """
    return error_statistics([pose_error_sizes(station, values)])


def error_statistics(
    parts: Iterable[Mapping[str, ArrayLike]], *, shares: Iterable[np.ndarray] | None = None
) -> dict[str, float]:
    """Return the statistics of errors by unit, as from :func:`pose_error_sizes`, of several
    stations together.

    Args:
        parts: the errors of each station.
        shares: weight of each error of each station; default: 1.
    """
    errors: dict[str, list[ArrayLike]] = {}
    weights: dict[str, list[np.ndarray]] = {}
    given: Iterator[np.ndarray | None] = repeat(None) if shares is None else iter(shares)
    for part, share in zip(parts, given, strict=False):
        for unit, sizes in part.items():
            errors.setdefault(unit, []).append(sizes)
            weights.setdefault(unit, []).append(
                np.ones(np.shape(sizes)) if share is None else share
            )
    return {
        name: value
        for unit, of_unit in errors.items()
        for name, value in _statistics(np.concatenate(of_unit), np.concatenate(weights[unit]), unit)
    }


def leading_unit(statistics: Mapping[str, float]) -> str:
    """Return the unit of the leading errors: of positions or, if no reading determines any, images
    or accelerations.
    """
    return next(unit for unit in ("mm", "px", "m/s^2") if f"mean_{unit}" in statistics)


def _statistics(errors: np.ndarray, weights: np.ndarray, unit: str) -> Iterator[tuple[str, float]]:
    if np.all(weights == weights[0]):
        middle = np.median(errors)
        most = np.percentile(errors, 95)
    else:
        middle, most = (weighted_quantile(errors, weights, part) for part in (0.5, 0.95))
    yield f"mean_{unit}", float(np.average(errors, weights=weights))
    yield f"median_{unit}", float(middle)
    yield f"rms_{unit}", float(np.sqrt(np.average(errors**2, weights=weights)))
    yield f"p95_{unit}", float(most)
    yield f"max_{unit}", float(np.max(errors))


def weighted_quantile(values: np.ndarray, weights: np.ndarray, part: float) -> float:
    """Return the value below which a part of the weight lies, halfway between the middles of two
    weights.

    Example:
        >>> weighted_quantile(np.array([3.0, 1.0, 2.0]), np.array([1.0, 1.0, 2.0]), 0.5)
        2.0
    """
    order = np.argsort(values)
    mass = np.cumsum(weights[order]) - 0.5 * weights[order]
    return float(np.interp(part * np.sum(weights), mass, values[order]))


@dataclass(frozen=True)
class Replicates:
    """Rows of one table under a model.

    Attributes:
        part: "train" or "test".
        table: the rows.
        station: model and readings.
        pose: shape (N,), number of each row's pose; the tables of one calibration share the
            numbers.
        counted: shape (N,), rows that are no outliers.
    """

    part: str
    table: Measurements
    station: Station
    pose: np.ndarray
    counted: np.ndarray


def position_accuracy(residuals: np.ndarray) -> tuple[float, float]:
    """Return pose accuracy AP and pose repeatability RP of one pose [m].

    Args:
        residuals: attained minus predicted position in n >= 2 replicates, shape (3, n) [m].

    Example:
        >>> position_accuracy(np.array([[1.0, 3.0], [0.0, 0.0], [0.0, 0.0]]))
        (2.0, 1.0)
    """
    mean = residuals.mean(axis=1)
    distance = np.linalg.norm(residuals - mean[:, None], axis=0)
    return float(np.linalg.norm(mean)), float(distance.mean() + 3.0 * distance.std(ddof=1))


def angle_accuracy(residuals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return AP and RP of one pose's orientation about each axis, shape (3,) [rad], for residuals
    as above [rad].
    """
    return np.abs(residuals.mean(axis=1)), 3.0 * residuals.std(axis=1, ddof=1)


def iso9283(
    parts: Sequence[Replicates],
    models: Mapping[str, np.ndarray],
    *,
    residuals: Mapping[str, np.ndarray] | None = None,
) -> dict[str, Any] | None:
    """Return accuracy and repeatability of all poses with replicates.

    Args:
        parts: fitted and held-out rows, of which outliers are excluded.
        models: name of a model -> shape (P,), its values; the last one's figures are given pose by
            pose.
        residuals: name of a model -> shape (m, N), attained minus predicted readings of all rows,
            where these are of other predictions than by ``models``, such as of fits without the
            pose.

    Returns:
        This entry of ``result.json``: number of poses and cycles, mean and largest AP and RP by
        model and part [mm, mrad],
            and the poses one by one. None without any such pose, or where no position is measured.
    """
    if not parts[0].station.sensor.reads_pose:
        return None
    if residuals is None:
        residuals = {
            model: np.hstack([part.station.residuals(values) for part in parts])
            for model, values in models.items()
        }
    by_model = {model: _all_poses(parts, of_model) for model, of_model in residuals.items()}
    poses = by_model[list(models)[-1]]
    if not poses:
        return None
    cycles = [pose["cycles"] for pose in poses]
    rows = [pose["rows"] for pose in poses]
    counts = {part: rows.count(part) for part in dict.fromkeys(rows)}
    return {
        "poses": counts,
        "cycles": {"min": min(cycles), "max": max(cycles), "standard": CYCLES},
        **{
            m: {part: _summary([e for e in found if e["rows"] == part]) for part in counts}
            for m, found in by_model.items()
        },
        "per_pose": poses,
    }


def _all_poses(parts: Sequence[Replicates], residuals: np.ndarray) -> list[dict[str, Any]]:
    """Return AP and RP of each pose with replicates, in the order of the tables, of residuals of
    shape (m, N).
    """
    pose = np.concatenate([np.where(v.counted, v.pose, -1) for v in parts])
    rows = [(v, i) for v in parts for i in range(len(v.table))]
    found = []
    for members in groups(pose):
        part, i = rows[members[0]]
        table = part.table
        is_fitted = any(rows[member][0].part == "train" for member in members)
        entry: dict[str, Any] = {
            "file": table.source,
            "line": int(table.rows[i]),
            "rows": "train" if is_fitted else "test",
            "target": str(table.target[i]),
            "payload_kg": None if table.payload is None else float(table.payload[i]),
            "cycles": len(members),
        }
        found.append(entry | _figures(residuals[:, members]))
    return found


def groups(pose: np.ndarray) -> list[np.ndarray]:
    """Return the row indices of each pose with replicates, given the number of each row's pose,
    shape (N,), -1 for none.
    """
    order = np.argsort(pose, kind="stable")
    cuts = np.flatnonzero(np.diff(pose[order])) + 1
    return [rows for rows in np.split(order, cuts) if len(rows) > 1 and pose[rows[0]] >= 0]


def _figures(residuals: np.ndarray) -> dict[str, float]:
    """Return AP and RP by name [mm, mrad], of residuals of a position, shape (3, n), or a pose,
    shape (6, n).
    """
    accuracy, repeatability = position_accuracy(residuals[:3])
    found = {"AP_mm": 1e3 * accuracy, "RP_mm": 1e3 * repeatability}
    if len(residuals) == 6:
        for axis, a, r in zip(_ANGLES, *angle_accuracy(residuals[3:]), strict=True):
            found |= {f"AP_{axis}_mrad": 1e3 * float(a), f"RP_{axis}_mrad": 1e3 * float(r)}
    return found


def _summary(poses: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    names = [name for name in poses[0] if name.startswith(("AP", "RP"))]
    values = {name: [pose[name] for pose in poses] for name in names}
    return {
        name: {"mean": float(np.mean(found)), "max": float(np.max(found))}
        for name, found in values.items()
    }


def cycle_words(iso: Mapping[str, Any]) -> str:
    """Return the number of cycles in words, and whether the standard requires more.

    Example:
        >>> cycles = {"min": 3, "max": 5, "standard": 30}
        >>> several, few = cycle_words({"poses": {"test": 5}, "cycles": cycles}).split("; ")
        >>> several
        '5 poses, 3 to 5 cycles each'
        >>> few
        'ISO 9283 specifies 30, so AP and especially RP are rough estimates'
    """
    poses = sum(iso["poses"].values())
    least = iso["cycles"]["min"]
    most = iso["cycles"]["max"]
    words = (
        f"{counted(poses, 'pose')}, {least if least == most else f'{least} to {most}'} cycles each"
    )
    return (
        words
        if least >= CYCLES
        else f"{words}; ISO 9283 specifies {CYCLES}, so AP and especially RP are rough estimates"
    )
