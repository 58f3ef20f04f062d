"""Measurements from arrays, with all that a table may hold in the signature."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.robot.robot import Robot


def measurements(
    joints: Robot | Sequence[str],
    q: ArrayLike,
    *,
    position: ArrayLike | None = None,
    quaternion: ArrayLike | None = None,
    distance: ArrayLike | None = None,
    anchor: ArrayLike | None = None,
    socket: ArrayLike | None = None,
    camera_point: ArrayLike | None = None,
    pixel: ArrayLike | None = None,
    point: ArrayLike | None = None,
    plane: ArrayLike | None = None,
    gauge: ArrayLike | None = None,
    target: ArrayLike | None = None,
    payload: ArrayLike | None = None,
    temperature: ArrayLike | None = None,
    time: ArrayLike | None = None,
    station: ArrayLike | None = None,
    approach: ArrayLike | None = None,
    droop: ArrayLike | None = None,
    move: ArrayLike | None = None,
    sigma: ArrayLike | None = None,
    source: str = "arrays",
    **columns: ArrayLike | None,
) -> Measurements:
    """Build measurements from arrays in SI units, which are checked and copied.

    Args:
        joints: the robot, or the names of its n joints.
        q: joint positions [rad], prismatic [m], shape (N, n); of a robot, joints that mimic another may be left out.
        position: of the target in the instrument's frame [m], shape (N, 3).
        quaternion: orientation of the tool in the instrument's frame, x y z w, shape (N, 4); with ``position``.
        distance: from the instrument's point, or the row's anchor, to the target [m], shape (N,).
        anchor: name of the point that a distance is measured from, shape (N,).
        socket: name of the fixed point that held the tool point, shape (N,).
        camera_point: point of the calibration object in the camera's frame [m], shape (N, 3); with ``point``.
        pixel: the same point in the image [px], shape (N, 2); with ``point``.
        point: name of the point of the calibration object, shape (N,).
        plane: name of the plane that the probe touched, shape (N,).
        gauge: reading of a dial gauge against this plane [m], shape (N,); with ``plane``.
        target: name of the target on the tool, shape (N,); default: one.
        payload: mass at the tip [kg], shape (N,).
        temperature: in deg C, shape (N,).
        time: in s, shape (N,).
        station: name of the set-up that a row belongs to, shape (N,).
        approach: direction from which each joint arrived, -1, 0 (unknown) or 1, shape (N, n).
        droop: commanded minus read-back position of each joint [rad], prismatic [m], shape (N, n).
        move: last move of each joint with its sign [rad], prismatic [m], 0 where it is not known, shape (N, n).
        sigma: standard deviation of the row [m], shape (N,).
        source: name of the data for messages.
        columns: fields of sensors of your own.

    Raises:
        MeasurementError: for an unknown column, a wrong shape, an invalid value, or two kinds of measurement.

    Example:
        >>> measurements(["shoulder", "elbow"], [[0.1, 0.2], [0.3, 0.4]], position=[[1, 0, 0], [0, 1, 0]])
        Measurements('arrays': 2 rows, position, joints shoulder elbow)
    """
    given = {name: value for name, value in locals().items() if name not in ("joints", "q", "source", "columns")} | columns
    if isinstance(joints, Robot):
        rows = np.asarray(q, float)
        if joints.mimics and rows.ndim == 2 and rows.shape[1] == len(joints.own_joints):
            rows = joints.spread(rows)
        return measurements_from_arrays(joints.joint_names, rows, source=source, **given)
    return measurements_from_arrays(joints, q, source=source, **given)
