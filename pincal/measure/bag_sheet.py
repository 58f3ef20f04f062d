"""Recordings of ROS (rosbag2 folders, .mcap, .db3, and .bag of ROS 1) as sheets: one row per pose that was held still.

Joints come from a topic of JointState, readings from one of PoseStamped or PointStamped; times are those of the recorder, so
that clocks of several computers don't matter. Joints and readings are means over the pose.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pincal.errors import MeasurementError, PincalWarning
from pincal.measure.sheet import FrameSheet, Sheet
from pincal.measure.still import Poses, held_poses

ENDINGS = (".mcap", ".db3", ".bag")
_JOINTS = "sensor_msgs/msg/JointState"
_READINGS = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PointStamped")
_LABELS = ("x", "y", "z", "qx", "qy", "qz", "qw")


@dataclass(frozen=True)
class _Topic:
    """What one topic holds.

    Attributes:
        name: of the topic.
        labels: of the values.
        time: shape (T,), strictly increasing [s].
        values: shape (T, k).
    """

    name: str
    labels: tuple[str, ...]
    time: np.ndarray
    values: np.ndarray


def is_bag(path: Path) -> bool:
    """Return whether a path is a recording of ROS, by its name or, of a folder, its contents."""
    return path.suffix.lower() in ENDINGS or (path / "metadata.yaml").is_file()


def open_bag(path: Path, *, ignore: Collection[str] = (), only_joints: bool = False, joints: Collection[str] = ()) -> Sheet:
    """Read the poses that were held still and have readings; without any topic of readings all samples of the joints.

    Args:
        path: the recording.
        ignore: topics to leave out.
        only_joints: whether to read the joints alone, sample by sample.
        joints: those that have to stand still; default: all of the topic.

    Raises:
        MeasurementError: without the library rosbags, for a recording that can't be read, or one in which joints or readings
            come from several topics, or no pose was held still.
    """
    found = _topics(path, ignore)
    arm = _arm([topic for topic in found if topic.labels[:3] != _LABELS[:3]], path)
    readings = [topic for topic in found if topic.labels[:3] == _LABELS[:3]]
    if only_joints or not readings:
        return _sheet(path, {"time": arm.time} | dict(zip(arm.labels, arm.values.T, strict=True)))
    if len(readings) > 1:
        raise _several("readings", readings, path)
    (reading,) = readings
    watched = [i for i, name in enumerate(arm.labels) if name in joints] or [*range(len(arm.labels))]
    poses = held_poses(arm.time, arm.values[:, watched])
    middle = _middle(poses, arm.time, reading.time)
    seen = np.flatnonzero(middle[:, 1] > middle[:, 0])
    if not len(seen):
        raise MeasurementError(
            f"{path.name}: {len(poses)} poses of {arm.name} are held still, none with readings of {reading.name}; expected "
            "poses that are held for some tenths of a second while the instrument reads"
        )
    warnings.warn(
        f"{path.name}: {len(seen)} poses held still, joints from {arm.name}, readings from {reading.name}; poses without a "
        f"reading: {len(poses) - len(seen)}",
        PincalWarning,
        stacklevel=2,
    )
    values = np.array([_mean(reading.values[first:last]) for first, last in middle[seen]])
    joints = poses.means(arm.values)[seen]
    columns = {"time": arm.time[poses.begin[seen]]} | dict(zip(arm.labels, joints.T, strict=True))
    return _sheet(path, columns | dict(zip(reading.labels, values.T, strict=True)))


def _sheet(path: Path, columns: dict[str, np.ndarray]) -> Sheet:
    import polars as pl

    frame = pl.DataFrame(columns)
    return FrameSheet(path, tuple(columns), False, frame, np.arange(2, frame.height + 2), holds_more=True)


def _middle(poses: Poses, time: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """Return the first and past the last of the times asked for in the middle half of each pose, shape (K, 2)."""
    begin, end = time[poses.begin], time[poses.end]
    quarter = 0.25 * (end - begin)
    return np.column_stack([np.searchsorted(asked, begin + quarter), np.searchsorted(asked, end - quarter, side="right")])


def _mean(values: np.ndarray) -> np.ndarray:
    """Return the mean of positions, or of poses with quaternions, shape (k,)."""
    turned = values[:, 3:]
    same = np.where((turned @ turned[0] < 0.0)[:, None], -turned, turned)
    mean = np.concatenate([values[:, :3].mean(axis=0), same.mean(axis=0)])
    mean[3:] /= np.linalg.norm(mean[3:]) if len(mean) > 3 else 1.0
    return np.asarray(mean)


def _arm(topics: list[_Topic], path: Path) -> _Topic:
    """Return the topic with the most joints; joints in two topics are refused."""
    if not topics:
        raise MeasurementError(f"{path.name}: no joints; expected a topic of {_JOINTS}")
    arm = max(topics, key=lambda topic: len(topic.labels))
    rivals = [topic for topic in topics if topic is not arm and set(topic.labels) & set(arm.labels)]
    if rivals:
        raise _several("joints", [arm, *rivals], path)
    return arm


def _several(what: str, topics: list[_Topic], path: Path) -> MeasurementError:
    names = ", ".join(topic.name for topic in topics)
    return MeasurementError(f"{path.name}: {what} in several topics: {names}; expected one: --ignore the others")


def _topics(path: Path, ignore: Collection[str]) -> list[_Topic]:
    """Return all topics of joints and of readings; messages with other joints are topics of their own."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise MeasurementError(f"{path.name}: recordings of ROS need rosbags; run pip install 'pincal[ros]'") from error
    found: dict[tuple[str, tuple[str, ...]], list[tuple[float, Any]]] = {}
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            wanted = [
                each for each in reader.connections if each.msgtype in (_JOINTS, *_READINGS) and each.topic not in ignore
            ]
            for connection, stamp, raw in reader.messages(connections=wanted) if wanted else ():
                message = reader.deserialize(raw, connection.msgtype)
                for labels, values in _values(message, connection.msgtype):
                    found.setdefault((connection.topic, labels), []).append((1e-9 * stamp, values))
    except Exception as error:  # Whatever a broken recording does to the libraries below.
        raise MeasurementError(f"{path.name}: can't be read ({error}); expected a recording of ROS") from error
    return [_topic(name, labels, samples) for (name, labels), samples in found.items()]


def _values(message: Any, kind: str) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield labels and values of a message that has some."""
    if kind == _JOINTS:
        if len(message.position) == len(message.name) > 0:
            yield tuple(message.name), message.position
        return
    pose = getattr(message, "pose", None)
    at = message.point if pose is None else pose.position
    turned = () if pose is None else (pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w)
    values = (at.x, at.y, at.z, *turned)
    yield _LABELS[: len(values)], values


def _topic(name: str, labels: tuple[str, ...], samples: list[tuple[float, Any]]) -> _Topic:
    time, first = np.unique(np.array([stamp for stamp, _ in samples]), return_index=True)
    return _Topic(name, labels, time, np.array([values for _, values in samples], float)[first])
