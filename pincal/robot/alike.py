"""Robots of example-robot-data that a table could be of as well."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

from pincal.errors import BadInputError, PincalWarning
from pincal.robot.robot import Robot
from pincal.robot.urdf_file import find_file

# Frames that are closer than this [m, rad] make no other robot.
_SAME = 1e-5


def robots_alike(robot: Robot) -> Iterator[tuple[str, Robot]]:
    """Yield the names of robots whose joints have the same names but stand elsewhere, and the robots, each size once.

    None without example-robot-data.
    """
    try:
        from example_robot_data import robots_loader
    except ImportError:
        return
    marks = [f'"{name}"'.encode() for name in robot.joint_names]
    middle = np.clip(0.3, robot.lower, robot.upper)[None]
    seen = [robot.forward_kinematics(middle)]
    for name, path in _files(robots_loader.ROBOTS):
        try:
            text = path.read_bytes()
            if not all(mark in text for mark in marks):
                continue
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", PincalWarning)
                other = Robot.from_urdf(path, joints=robot.joint_names)
        except (BadInputError, OSError):
            continue
        found = other.forward_kinematics(middle) if other.joint_names == robot.joint_names else seen[0]
        if not any(np.allclose(found, one, atol=_SAME) for one in seen):
            seen.append(found)
            yield name, other


def _files(names: Iterable[str]) -> list[tuple[str, Path]]:
    """Return the files of robots, those first whose own name the file bears: some loaders share one."""
    found = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PincalWarning)
        for name in names:
            with suppress(BadInputError):
                found.append((name, find_file(name)))
    return sorted(found, key=lambda one: (not one[1].name.startswith(one[0]), len(one[0]), one[0]))
