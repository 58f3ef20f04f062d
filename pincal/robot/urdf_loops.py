"""Loop closures in a URDF, itself a tree: constraints, joints of Gazebo, and second joints of one
link.

A constraint is an element proposed for URDF (urdfdom's pull request 264)::

    <constraint name="pin" type="revolute">
      <parent link="rod"/> <parent_origin xyz="0 0 0.9"/> <parent_axis xyz="0 1 0"/>
      <child link="upper_arm"/> <child_origin xyz="-0.4 0 0"/> <child_axis xyz="0 1 0"/>
    </constraint>
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any, Literal

import numpy as np

from pincal.errors import RobotFileError
from pincal.robot.se3 import rotation_of_rpy, transform
from pincal.robot.tree import UrdfClosure, known_links
from pincal.units import plain_numbers

ClosureKind = Literal["point", "axis", "pose"]
KINDS: dict[str, ClosureKind] = {
    "revolute": "axis",
    "continuous": "axis",
    "spherical": "point",
    "ball": "point",
    "fixed": "pose",
}
"""The constraint of each type of closing joint: on the origin of its frame, also on its axis, or on
the whole frame.
"""
_X = "1 0 0"
_NOWHERE = "0 0 0"


def cut_loops(root: Any) -> list[Any]:
    """Remove joints from a URDF's XML until each link is the child of one joint, a fixed one or the
    first; return them.
    """
    kept: dict[str, Any] = {}
    cut = []
    for joint in sorted(root.iterfind("joint"), key=lambda joint: joint.get("type") != "fixed"):
        child = joint.find("child")
        if child is not None and kept.setdefault(child.get("link"), joint) is not joint:
            cut.append(joint)
            root.remove(joint)
    return cut


def take_loops(root: Any, links: Collection[str], source: str) -> Iterator[UrdfClosure]:
    """Yield the loop closures of a URDF, and cut its loops as :func:`cut_loops` does.

    Raises:
        RobotFileError: for a missing or unknown link, or invalid numbers.
    """
    for element in root.iterfind("constraint"):
        origins = [_origin(element.find(f"{role}_origin"), source) for role in ("parent", "child")]
        axes = [
            _vector(element.find(f"{role}_axis"), "xyz", _X, source) for role in ("parent", "child")
        ]
        yield UrdfClosure(*_names(element, links, source), origins[0], origins[1], axes[0], axes[1])
    for element in root.iterfind("gazebo/joint"):
        ends = [
            (element.findtext(role) or "").strip().split("::")[-1] for role in ("parent", "child")
        ]
        # Other joints attach to links outside the URDF, such as the world.
        if all(end in links for end in ends):
            pose = _numbers(element.findtext("pose") or "0 0 0 0 0 0", 6, element, source)
            axis = _numbers(element.findtext("axis/xyz") or _X, 3, element, source)
            T = transform(rotation_of_rpy(pose[3:]), pose[:3])
            name = element.get("name", "?")
            kind = element.get("type", "")
            yield UrdfClosure(name, kind, ends[0], ends[1], None, T, axis, axis)
    for element in cut_loops(root):
        axis = _vector(element.find("axis"), "xyz", _X, source)
        origin = _origin(element.find("origin"), source)
        yield UrdfClosure(*_names(element, links, source), origin, np.eye(4), axis, axis)


def _names(element: Any, links: Collection[str], source: str) -> tuple[str, str, str, str]:
    """Return name, type and both links of a joint or constraint."""
    ends = [
        "" if (end := element.find(role)) is None else end.get("link", "")
        for role in ("parent", "child")
    ]
    if unknown := [end for end in ends if end not in links]:
        raise _fault(
            element,
            source,
            f"names the unknown link {unknown[0]!r}; {known_links(unknown[0], links)}",
        )
    return element.get("name", "?"), element.get("type", ""), ends[0], ends[1]


def _origin(element: Any, source: str) -> np.ndarray:
    xyz, rpy = (_vector(element, key, _NOWHERE, source) for key in ("xyz", "rpy"))
    return transform(rotation_of_rpy(rpy), xyz)


def _vector(element: Any, key: str, default: str, source: str) -> np.ndarray:
    """Return three numbers of an attribute or its default, shape (3,)."""
    return (
        np.array(default.split(), float)
        if element is None
        else _numbers(element.get(key, default), 3, element, source)
    )


def _numbers(text: str, count: int, element: Any, source: str) -> np.ndarray:
    found = np.array(plain_numbers(text.split()))
    if found.shape != (count,) or not np.isfinite(found).all():
        raise _fault(element, source, f"has {text!r}; expected {count} finite numbers")
    return found


def _fault(element: Any, source: str, text: str) -> RobotFileError:
    return RobotFileError(
        f"{source}:{element.sourceline}: <{element.tag}> {element.get('name') or ''} {text}"
    )
