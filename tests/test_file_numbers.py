"""Numbers by which files are refused, on both sides of where they decide."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from test_files import read as read_lists

from pincal.errors import MeasurementError, ModelFileError
from pincal.io.arrays import Record, Transform, array_of
from pincal.io.camera_file import read_camera
from pincal.io.strict_json import MODEL_FILE, built


class Placed(Record, frozen=True, kw_only=True):
    """A transform of a robot."""

    place: Transform


def turned(off: float) -> np.ndarray:
    """Return a matrix whose product with its transpose is off the identity by about a number."""
    return np.diag([1.0 + 0.5 * off, 1.0, 1.0])


def test_rotations_of_three_decimals_are_read() -> None:
    """People write them down; what is further off is a stretched frame."""
    text = '{{"names": [], "values": [], "table": [], "turn": {}}}'

    read_lists(text.format(turned(0.9e-3).tolist()))
    with pytest.raises(ModelFileError, match="turn: is not a rotation"):
        read_lists(text.format(turned(1.2e-3).tolist()))


def test_transforms_of_the_robot_are_exact() -> None:
    """They were written by pincal, to all digits."""

    def read(off: float) -> np.ndarray:
        T = np.eye(4)
        T[:3, :3] = turned(off)
        text = json.dumps({"place": T.tolist()}).encode()
        return built(text, Placed, MODEL_FILE, file="robot.json", hook=lambda kind, value: array_of(value)).place

    assert read(0.9e-6)[0, 0] == 1.0 + 0.45e-6
    with pytest.raises(ModelFileError, match="place: is not a rigid transform"):
        read(1.2e-6)


def test_the_mount_of_a_camera_is_exact(tmp_path: Path) -> None:
    """It is used as it is."""
    T = np.eye(4)
    camera = {"fx": 1, "fy": 1, "u0": 0, "v0": 0}
    for off, is_read in ((0.9e-6, True), (1.2e-6, False)):
        T[:3, :3] = turned(off)
        (tmp_path / "camera.json").write_text(json.dumps(camera | {"T_tip_camera": T.tolist()}))
        if is_read:
            np.testing.assert_array_equal(read_camera(tmp_path / "camera.json").T_tip_camera, T)
        else:
            with pytest.raises(MeasurementError, match="T_tip_camera is not a rigid transform"):
                read_camera(tmp_path / "camera.json")
