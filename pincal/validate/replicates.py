r"""Replicates, repeated measurements of the same pose: accuracy and repeatability by ISO 9283.

Rows are replicates of one pose if they have the same joint positions (to 1e-5 rad), target, named point, payload and
direction of approach, and temperatures within 4 K: the standard allows :math:`\pm 2` K. Time may differ, as cycles take
time: a robot that drifts repeats badly. With l_j the distance of replicate j from the mean of n replicates,

.. math:: AP = |\bar x - x_c|, \quad RP = \bar l + 3 S_l, \quad AP_a = |\bar a - a_c|, \quad RP_a = 3 S_a

(ISO 9283:1998, 7.2; S with n - 1; a, b, c turn about x, y, z). The standard's commanded pose is here the one that the model
predicts for the joints that were read: AP is the accuracy of a controller that uses this model. Both come from residuals,
so that joints that come to rest a little differently do not count as the arm's own error.

A pose with any replicate among the fitted rows does not count as held out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pincal.identify.station import Station
from pincal.measure.measurements import Measurements

CYCLES = 30
"""Cycles, measurements of each pose, that ISO 9283 asks for."""

# Joint positions that count as the same pose [rad or m]: coarser than encoders resolve, finer than robots repeat (1e-5 rad
# move the tip of an arm of 2 m by 0.02 mm).
_SAME = 1e-5
# Payloads that count as the same [kg]: a gram bends no arm. Temperatures within the ±2 K of ISO 9283 [K].
_SAME_LOAD, _SAME_CLIMATE = 1e-3, 4.0
_ANGLES = "abc"

ANGLE_WORDS = {"AP_mm": "mm"} | {f"AP_{a}_mrad": f"mrad about {axis}" for a, axis in zip(_ANGLES, "xyz", strict=True)}
"""What each kind of accuracy is given in."""


@dataclass(frozen=True)
class Replicates:
    """Rows of one table under a model.

    Attributes:
        part: "train" or "test".
        table: the rows.
        station: model and readings.
        pose: shape (N,), number of each row's pose; the tables of one calibration share the numbers.
        counted: shape (N,), rows that are not outliers.
    """

    part: str
    table: Measurements
    station: Station
    pose: np.ndarray
    counted: np.ndarray


def replicate_groups(tables: Sequence[Measurements]) -> list[np.ndarray]:
    """Return the number of the pose of each row of some tables.

    Args:
        tables: tables of the same joints.

    Returns:
        For each table shape (N,), whole numbers from 0.

    Example:
        >>> from pincal.measure.measurements import measurements_from_arrays
        >>> q, load = [[0.1], [0.5], [0.100001], [0.1]], [0.0, 0.0, 0.0, 80.0]
        >>> replicate_groups([measurements_from_arrays(["a"], q, distance=[1.0] * 4, payload=load)])[0].tolist()
        [0, 1, 0, 2]
    """
    keys = [same_joints(np.vstack([table.q for table in tables]))]
    named = [table.names() for table in tables]
    for name in dict.fromkeys(name for columns in named for name in columns):
        names = [columns.get(name, np.full(len(t), "")) for t, columns in zip(tables, named, strict=True)]
        keys.append(np.unique(np.concatenate(names), return_inverse=True)[1])
    keys.append(np.round(_stacked(tables, "payload") / _SAME_LOAD).astype(int))
    if any(table.approach is not None for table in tables):
        sides = [np.zeros(t.q.shape, int) if t.approach is None else t.approach for t in tables]
        keys.append(np.unique(np.vstack(sides), axis=0, return_inverse=True)[1].ravel())
    poses = _numbered(np.column_stack(keys))
    climate = _same_climate(_stacked(tables, "temperature"), poses)
    poses = _numbered(np.column_stack([poses, climate]))
    return np.split(poses, np.cumsum([len(table) for table in tables])[:-1])


def _stacked(tables: Sequence[Measurements], name: str) -> np.ndarray:
    """Return a column of numbers, 0 where a table has none."""
    columns = [getattr(table, name) for table in tables]
    return np.concatenate([np.zeros(len(t)) if c is None else c for t, c in zip(tables, columns, strict=True)])


def _numbered(keys: np.ndarray) -> np.ndarray:
    """Return a number for each distinct row, in the order of their first appearance."""
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    rank = np.empty(len(first), int)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.asarray(rank[inverse.ravel()])


def same_joints(q: np.ndarray) -> np.ndarray:
    """Return a number for rows with the same joint positions: cells of a grid, those that touch joined."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    cells, inverse = np.unique(np.floor(q / _SAME), axis=0, return_inverse=True)
    pairs = cKDTree(cells).query_pairs(1.5, p=np.inf, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    count, label = connected_components(links, directed=False)
    low, high = np.full((count, q.shape[1]), np.inf), np.full((count, q.shape[1]), -np.inf)
    np.minimum.at(low, label, cells)
    np.maximum.at(high, label, cells)
    # A slow motion links cell to cell over a long way: its rows are not replicates.
    label = label[inverse.ravel()]
    is_motion = np.any(high - low > 1.5, axis=1)[label]
    return np.asarray(np.where(is_motion, count + np.arange(len(q)), label))


def _same_climate(temperature: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Return, within each pose, the number of the window of temperature that a row falls into."""
    window = np.zeros(len(poses), int)
    pose, lowest, number = -1, 0.0, 0
    for row in np.lexsort((temperature, poses)):
        if poses[row] != pose:
            pose, lowest, number = poses[row], temperature[row], 0
        elif temperature[row] - lowest > _SAME_CLIMATE:
            lowest, number = temperature[row], number + 1
        window[row] = number
    return window


def position_accuracy(residuals: np.ndarray) -> tuple[float, float]:
    """Return AP and RP of one pose.

    Args:
        residuals: attained minus predicted position in n >= 2 replicates, shape (3, n) [m].

    Returns:
        Pose accuracy AP and pose repeatability RP [m].

    Example:
        >>> position_accuracy(np.array([[1.0, 3.0], [0.0, 0.0], [0.0, 0.0]]))
        (2.0, 1.0)
    """
    mean = residuals.mean(axis=1)
    distance = np.linalg.norm(residuals - mean[:, None], axis=0)
    return float(np.linalg.norm(mean)), float(distance.mean() + 3.0 * distance.std(ddof=1))


def angle_accuracy(residuals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return AP and RP of one pose's orientation about each axis, shape (3,) [rad], for residuals as above [rad]."""
    return np.abs(residuals.mean(axis=1)), 3.0 * residuals.std(axis=1, ddof=1)


def iso9283(parts: Sequence[Replicates], models: Mapping[str, np.ndarray]) -> dict[str, Any] | None:
    """Return accuracy and repeatability of all poses with replicates.

    Args:
        parts: fitted and held-out rows; outliers count in neither.
        models: name of a model -> shape (P,), its values; the last one's figures stand pose by pose.

    Returns:
        What ``result.json`` has under this key: number of poses and cycles, mean and largest AP and RP by model and part
        [mm, mrad], and the poses one by one. None without any such pose, or where no position is measured.
    """
    if not parts[0].station.sensor.reads_pose:
        return None
    by_model = {model: _all_poses(parts, values) for model, values in models.items()}
    poses = by_model[list(models)[-1]]
    if not poses:
        return None
    cycles, rows = [pose["cycles"] for pose in poses], [pose["rows"] for pose in poses]
    counts = {part: rows.count(part) for part in dict.fromkeys(rows)}
    return {
        "poses": counts,
        "cycles": {"min": min(cycles), "max": max(cycles), "standard": CYCLES},
        **{m: {part: _summary([e for e in found if e["rows"] == part]) for part in counts} for m, found in by_model.items()},
        "per_pose": poses,
    }


def _all_poses(parts: Sequence[Replicates], values: np.ndarray) -> list[dict[str, Any]]:
    """Return AP and RP of each pose with replicates, in the order of the tables."""
    residuals = np.hstack([v.station.residuals(values) for v in parts])
    pose = np.concatenate([np.where(v.counted, v.pose, -1) for v in parts])
    rows = [(v, i) for v in parts for i in range(len(v.table))]
    found = []
    for members in groups(pose):
        part, i = rows[members[0]]
        table, is_fitted = part.table, any(rows[member][0].part == "train" for member in members)
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
    """Return the rows of each pose with replicates.

    Args:
        pose: shape (N,), the number of each row's pose; -1 for none.

    Returns:
        Indices of rows, one array per pose.
    """
    order = np.argsort(pose, kind="stable")
    cuts = np.flatnonzero(np.diff(pose[order])) + 1
    return [rows for rows in np.split(order, cuts) if len(rows) > 1 and pose[rows[0]] >= 0]


def _figures(residuals: np.ndarray) -> dict[str, float]:
    """Return AP and RP by name [mm, mrad], of residuals of a position, shape (3, n), or a pose, shape (6, n)."""
    accuracy, repeatability = position_accuracy(residuals[:3])
    found = {"AP_mm": 1e3 * accuracy, "RP_mm": 1e3 * repeatability}
    if len(residuals) == 6:
        for axis, a, r in zip(_ANGLES, *angle_accuracy(residuals[3:]), strict=True):
            found |= {f"AP_{axis}_mrad": 1e3 * float(a), f"RP_{axis}_mrad": 1e3 * float(r)}
    return found


def _summary(poses: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    names = [name for name in poses[0] if name.startswith(("AP", "RP"))]
    values = {name: [pose[name] for pose in poses] for name in names}
    return {name: {"mean": float(np.mean(found)), "max": float(np.max(found))} for name, found in values.items()}


def cycle_words(iso: Mapping[str, Any]) -> str:
    """Return how many cycles there were, and whether the standard asks for more.

    Example:
        >>> cycle_words({"poses": {"train": 4, "test": 1}, "cycles": {"min": 3, "max": 5, "standard": 30}})
        '5 poses, 3 to 5 cycles each; ISO 9283 asks for 30, so AP and especially RP are rough estimates'
    """
    poses, least, most = sum(iso["poses"].values()), iso["cycles"]["min"], iso["cycles"]["max"]
    words = f"{poses} pose{'s' * (poses > 1)}, {least if least == most else f'{least} to {most}'} cycles each"
    return words if least >= CYCLES else f"{words}; ISO 9283 asks for {CYCLES}, so AP and especially RP are rough estimates"
