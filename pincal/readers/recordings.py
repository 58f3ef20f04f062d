"""Recordings of ROS as sheets.

A recording (rosbag2 folders, .mcap, .db3, and .bag of ROS 1) gives one row per pose that was
held still. Joints are from a topic of JointState, readings from one of PoseStamped, PointStamped or
TransformStamped, or else from the one transform of /tf that moves freely, as no joint of a robot
does. Times are the recorder's, so that clocks of several computers don't matter. Joints and
readings are means over the pose.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pincal.errors import MeasurementError, counted, needed, warn
from pincal.measure.joined import HeldPoses, held_poses, mean_turn
from pincal.measure.reading_numbers import LAYOUT
from pincal.measure.sheet import FrameSheet, Sheet
from pincal.measure.sheet_reader import SheetOptions, SheetReader
from pincal.thresholds import Count

_ENDINGS = (".mcap", ".db3", ".bag")
# Topics that a message lists.
_LISTED: Count = 20
_JOINTS = "sensor_msgs/msg/JointState"
_IMU = "sensor_msgs/msg/Imu"
_READINGS = tuple(
    f"geometry_msgs/msg/{kind}Stamped"
    for kind in ("Pose", "Point", "Transform", "PoseWithCovariance")
)
_TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_LABELS = ("x", "y", "z", "qx", "qy", "qz", "qw")
_OF_IMU = ("ax", "ay", "az", "wx", "wy", "wz")


@dataclass(frozen=True)
class _Topic:
    """The messages of one topic.

    Attributes:
        name: of the topic.
        labels: of the values.
        time: by the recorder, shape (T,), strictly increasing [s].
        values: shape (T, k).
        own: stamps of the messages, shape (T,) [s].
        frames: parent and child frame of a transform.
    """

    name: str
    labels: tuple[str, ...]
    time: np.ndarray
    values: np.ndarray
    own: np.ndarray
    frames: tuple[str, ...] = ()

    @property
    def stamps(self) -> np.ndarray:
        """Times by the clock of the node, or by the recorder's where those do not increase [s]."""
        return self.own if len(self.own) > 1 and np.all(np.diff(self.own) > 0.0) else self.time

    @property
    def moves(self) -> bool:
        """Whether its values change."""
        return bool(len(self.time) > 1 and np.ptp(self.values, axis=0).max() > LAYOUT.frame_moves)


def is_bag(path: Path) -> bool:
    """Return whether a path is a recording of ROS, by its name, or by its contents if it is a
    folder.
    """
    return path.suffix.lower() in _ENDINGS or (path / "metadata.yaml").is_file()


def open_bag(
    path: Path,
    *,
    ignore: Collection[str] = (),
    only_joints: bool = False,
    joints: Collection[str] = (),
) -> Sheet:
    """Read the poses that were held still and have readings, or all samples of the joints if there
    are no readings.

    Args:
        path: the recording.
        ignore: topics to leave out.
        only_joints: whether to read only the joints, sample by sample.
        joints: those that have to stand still; default: all of the topic.

    Raises:
        MeasurementError: without the library rosbags, for a recording that can't be read, or one
            with joints or readings in several topics, or without a pose that was held still.
    """
    found, listed = _topics(path, ignore)
    arm = _arm([topic for topic in found if topic.labels[:3] != _LABELS[:3]], path, listed)
    frames = [topic for topic in found if topic.frames]
    readings = [topic for topic in found if topic.labels[:3] == _LABELS[:3] and not topic.frames]
    if not only_joints:
        readings = readings or _free(frames, path)
    if not only_joints and not readings:
        warn(
            f"{path.name}: no topic of readings ({', '.join(_READINGS)}), no freely "
            f"moving frame in /tf; topics: {listed}"
        )
    if only_joints or not readings:
        return _sheet(path, {"time": arm.time} | dict(zip(arm.labels, arm.values.T, strict=True)))
    if len(readings) > 1:
        raise _several("readings", readings, path)
    return _held_readings(path, arm, readings[0], joints)


def _held_readings(path: Path, arm: _Topic, reading: _Topic, joints: Collection[str]) -> Sheet:
    """Return a row for each pose that was held still and read, with the means of joints and
    readings; warn of the others.
    """
    watched = [i for i, name in enumerate(arm.labels) if name in joints]
    watched = watched or [*range(len(arm.labels))]
    poses = held_poses(arm.time, arm.values[:, watched])
    middle = _middle(poses, arm.time, reading.time)
    seen = np.flatnonzero(middle[:, 1] > middle[:, 0])
    if not len(seen):
        raise MeasurementError(
            f"{path.name}: {counted(len(poses), 'pose')} of {arm.name} held still, none with "
            f"readings of {reading.name}; expected "
            "poses held for some tenths of a second while the instrument reads"
        )
    warn(
        f"{path.name}: {counted(len(seen), 'pose')} held still, joints from {arm.name}, readings "
        f"from {reading.name}; poses without a reading: {len(poses) - len(seen)}"
    )
    values = np.array([_mean(reading.values[first:last]) for first, last in middle[seen]])
    held = poses.means(arm.values)[seen]
    columns = {"time": arm.time[poses.begin[seen]]} | dict(zip(arm.labels, held.T, strict=True))
    return _sheet(path, columns | dict(zip(reading.labels, values.T, strict=True)))


def open_streams(path: Path, *, ignore: Collection[str] = ()) -> dict[str, Sheet]:
    """Return the sheets of "joints", "imu" and "tracker" for which a recording has topics.

    Raises:
        MeasurementError: as :func:`open_bag`, and for several IMUs or readings.
    """
    found, listed = _topics(path, ignore, imu=True)
    imus = [topic for topic in found if topic.labels == _OF_IMU]
    readings = [topic for topic in found if topic.labels[:3] == _LABELS[:3] and not topic.frames]
    others = [topic for topic in found if topic.labels[:3] != _LABELS[:3] and topic not in imus]
    chosen = {"joints": [_arm(others, path, listed)], "imu": imus, "tracker": readings}
    for what, topics in chosen.items():
        if len(topics) > 1:
            raise _several(what, topics, path)
    return {
        what: _sheet(
            path,
            {"time": topics[0].stamps}
            | dict(zip(topics[0].labels, topics[0].values.T, strict=True)),
        )
        for what, topics in chosen.items()
        if topics
    }


def _sheet(path: Path, columns: dict[str, np.ndarray]) -> Sheet:
    import polars as pl

    return FrameSheet(path, tuple(columns), False, pl.LazyFrame(columns), takes_unknown=True)


def _middle(poses: HeldPoses, time: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """Return the index range of the times ``asked`` in the middle half of each pose,
    shape (K, 2).
    """
    begin = time[poses.begin]
    end = time[poses.end]
    quarter = 0.25 * (end - begin)
    return np.column_stack(
        [
            np.searchsorted(asked, begin + quarter),
            np.searchsorted(asked, end - quarter, side="right"),
        ]
    )


def _mean(values: np.ndarray) -> np.ndarray:
    """Return the mean of positions, or of poses with quaternions, shape (k,)."""
    position = values[:, :3].mean(axis=0)
    quaternions = values[:, 3:]
    return np.append(position, mean_turn(quaternions)) if quaternions.size else np.asarray(position)


def _free(frames: list[_Topic], path: Path) -> list[_Topic]:
    """Return the transforms that move freely, inverted if the parent frame is on the hand, as a
    camera may be.

    Joints of a robot rotate about a fixed point, or slide along a line.
    """
    found = list[_Topic]()
    by_child = {topic.frames[1]: topic for topic in frames}
    for topic in frames:
        spread = np.linalg.svd(
            topic.values[:, :3] - topic.values[:, :3].mean(axis=0), compute_uv=False
        )
        if len(topic.time) < 3 or spread[1] < LAYOUT.frame_moves * np.sqrt(len(topic.time)):
            continue
        above = by_child.get(topic.frames[0])
        steps = 0
        while above is not None and not above.moves and steps < len(frames):
            above = by_child.get(above.frames[0])
            steps = steps + 1
        if above is not None and above.moves:
            parent, child = topic.frames
            warn(
                f"{path.name}: {parent} is on the moving {above.frames[1]}: its pose in "
                f"{child} is the reading"
            )
            back = Rotation.from_quat(topic.values[:, 3:]).inv()
            topic = replace(
                topic, values=np.column_stack([-back.apply(topic.values[:, :3]), back.as_quat()])
            )
        found.append(topic)
    return found


def _arm(topics: list[_Topic], path: Path, listed: str) -> _Topic:
    """Return the topic with the most joints; refuse joints in two topics."""
    if not topics:
        raise MeasurementError(
            f"{path.name}: no joints; expected a topic of {_JOINTS}; topics: {listed}"
        )
    arm = max(topics, key=lambda topic: len(topic.labels))
    rivals = [topic for topic in topics if topic is not arm and set(topic.labels) & set(arm.labels)]
    if rivals:
        raise _several("joints", [arm, *rivals], path)
    return arm


def _several(what: str, topics: list[_Topic], path: Path) -> MeasurementError:
    names = ", ".join(topic.name for topic in topics)
    return MeasurementError(
        f"{path.name}: {what} in several topics: {names}; expected one: --ignore the others"
    )


def _topics(path: Path, ignore: Collection[str], *, imu: bool = False) -> tuple[list[_Topic], str]:
    """Return all topics of joints, of readings and of IMUs or transforms, and a list of all topics
    in words.

    Messages with different joints count as separate topics, and so does each frame of /tf.
    """
    with needed(
        "rosbags",
        f"{path.name}: recordings of ROS",
        install="'pincal[ros]'",
        error=MeasurementError,
    ):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    found: dict[tuple[str, tuple[str, ...], tuple[str, ...]], list[tuple[float, float, Any]]] = {}
    kinds = (_JOINTS, *_READINGS, *((_IMU,) if imu else _TRANSFORMS))
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            known = (each for each in reader.connections if each.msgtype in kinds)
            wanted = [each for each in known if each.topic not in ignore]
            listed = ", ".join(
                f"{each.topic} ({each.msgtype.split('/')[-1]})"
                for each in reader.connections[:_LISTED]
            )
            for connection, stamp, raw in reader.messages(connections=wanted) if wanted else ():
                message = reader.deserialize(raw, connection.msgtype)
                for frames, labels, values in _values(message, connection.msgtype):
                    if not {*frames[1:], " > ".join(frames)} & {*ignore}:
                        sample = (1e-9 * stamp, _stamp(message), values)
                        found.setdefault((connection.topic, frames, labels), []).append(sample)
    except Exception as error:  # Broken recordings raise all kinds of errors in these libraries.
        raise MeasurementError(
            f"{path.name}: can't be read ({error}); expected a recording of ROS"
        ) from error
    return [_topic(*place, samples) for place, samples in found.items()], listed


def _stamp(message: Any) -> float:
    """Return the stamp of a message [s], 0 without one."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return 0.0 if stamp is None else stamp.sec + 1e-9 * stamp.nanosec


def _values(message: Any, kind: str) -> Iterator[tuple[tuple[str, ...], tuple[str, ...], Any]]:
    """Yield frames, labels and values of a message."""
    if kind in _TRANSFORMS:
        for each in message.transforms:
            (_, labels, values), *_ = _values(each, "")
            yield (each.header.frame_id.strip("/"), each.child_frame_id.strip("/")), labels, values
        return
    if kind == _IMU:
        force = message.linear_acceleration
        rate = message.angular_velocity
        yield (), _OF_IMU, (force.x, force.y, force.z, rate.x, rate.y, rate.z)
        return
    if kind == _JOINTS:
        if len(message.position) == len(message.name) > 0:
            yield (), tuple(message.name), message.position
        return
    if (transform := getattr(message, "transform", None)) is not None:
        at = transform.translation
        turn = transform.rotation
        yield (), _LABELS, (at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w)
        return
    pose = getattr(message, "pose", None)
    pose = getattr(pose, "pose", pose)
    at = message.point if pose is None else pose.position
    turned = (
        ()
        if pose is None
        else (pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w)
    )
    values = (at.x, at.y, at.z, *turned)
    yield (), _LABELS[: len(values)], values


def _topic(
    name: str,
    frames: tuple[str, ...],
    labels: tuple[str, ...],
    samples: list[tuple[float, float, Any]],
) -> _Topic:
    time, first = np.unique(np.array([stamp for stamp, *_ in samples]), return_index=True)
    own, values = (np.array([sample[k] for sample in samples], float)[first] for k in (1, 2))
    name += " " * bool(frames) + " > ".join(frames)
    return _Topic(name, labels, time, values, own, frames)


class _Recordings:
    """Reads recordings of ROS."""

    def reads(self, path: Path) -> bool:
        return is_bag(path)

    def open(self, path: Path, options: SheetOptions) -> Sheet:
        return open_bag(
            path,
            ignore=options.ignore,
            only_joints=options.only_joints,
            joints=options.joints,
        )


RECORDINGS: SheetReader = _Recordings()
