"""The same machine in other words: a URDF whose joint frames are turned about their axes and slid along them."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation


def rewritten(text: str, seed: int, *, slide: float) -> str:
    """Return a URDF with each joint's frame turned about its axis at random, and slid along it by up to some way [m].

    A frame D_i further on, the joint stands at D_parent^-1 T_i D_i in the frame of its parent; what hangs on a link is moved
    back likewise. Axis, position and limits of a joint stay what they are.
    """
    root, rng = ElementTree.fromstring(text), np.random.default_rng(seed)
    own = {}
    for joint in root.iter("joint"):
        if joint.get("type") in ("revolute", "continuous", "prismatic"):
            axis = np.array([float(x) for x in joint.find("axis").get("xyz").split()])
            axis /= np.linalg.norm(axis)
            own[joint.find("child").get("link")] = _transform(
                axis * rng.uniform(-3.0, 3.0), axis * rng.uniform(-slide, slide)
            )
    for joint in root.iter("joint"):
        if joint.find("child") is not None:
            parent, child = (joint.find(end).get("link") for end in ("parent", "child"))
            _move(joint, np.linalg.inv(own.get(parent, np.eye(4))), own.get(child, np.eye(4)))
    for link in root.iter("link"):
        for part in link:
            if part.tag in ("inertial", "visual", "collision"):
                _move(part, np.linalg.inv(own.get(link.get("name"), np.eye(4))), np.eye(4))
    return ElementTree.tostring(root, encoding="unicode")


def _transform(turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
    return T


def _move(element: ElementTree.Element, before: np.ndarray, after: np.ndarray) -> None:
    """Put a transform before and one after the origin of an element."""
    origin = element.find("origin")
    if origin is None:
        origin = ElementTree.SubElement(element, "origin")
    xyz, rpy = (np.array([float(x) for x in origin.get(key, "0 0 0").split()]) for key in ("xyz", "rpy"))
    T = before @ _transform(Rotation.from_euler("xyz", rpy).as_rotvec(), xyz) @ after
    turn = Rotation.from_matrix(T[:3, :3]).as_euler("xyz")
    for key, numbers in (("xyz", T[:3, 3]), ("rpy", turn)):
        origin.set(key, " ".join(repr(float(x)) for x in numbers))
