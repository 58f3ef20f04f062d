"""Robots of one cell, each with its own URDF, as one tree: the other robots' bases are fixed to the
first one's.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lxml import etree

from pincal.errors import RobotFileError
from pincal.robot.packages import find_mesh
from pincal.robot.tree import UrdfTree
from pincal.robot.urdf_file import find_file, parse_urdf, parse_xml, read_urdf
from pincal.thresholds import Scale

# Elements with unique names, and attributes that define or reference a name.
_NAMED = ("link", "joint", "constraint")
_NAMING = ("name", "link", "joint", "reference")
# The placement at the origin.
NOWHERE: tuple[Scale, ...] = (0.0,) * 6
"""Provisional placement of a robot, until readings determine it: at the first robot's."""


@dataclass(frozen=True)
class Beside:
    """A further robot of a cell.

    Attributes:
        source: path of its URDF or xacro file, or its name in example-robot-data.
        name: prefix ``NAME_`` of its links and joints, if some have the same name as another
            robot's.
        place: its root link in the frame of the first robot's root link: x, y, z [m], roll, pitch,
            yaw [rad]; None if unknown.
        is_found: whether the place was determined from readings, not given by the user.
    """

    source: str
    name: str
    place: tuple[float, ...] | None = None
    is_found: bool = False

    def __str__(self) -> str:
        at = "" if self.place is None else "@" + ",".join(f"{number:.6g}" for number in self.place)
        return f"{self.name}={self.source}{at}"

    @property
    def joint(self) -> str:
        """Name of the fixed joint that holds it."""
        return f"{self.name}_placement"


def read_cell(
    source: str | os.PathLike[str],
    others: Sequence[Beside] = (),
    *,
    xacro_args: Mapping[str, str] | None = None,
) -> UrdfTree:
    """Read a robot and further ones as one tree, whose root is the first robot's.

    The placement of each further robot is the origin of the fixed joint ``NAME_placement``. A
    calibration estimates it as for any second arm: the first joint of the arm has the six
    parameters of its mount.

    Args:
        source: path of the first robot's URDF or xacro file, or its name in example-robot-data.
        others: the other robots.
        xacro_args: values of the arguments of the first robot's xacro file.

    Raises:
        RobotFileError: as :func:`pincal.robot.urdf_file.read_urdf`, for two robots of one name, or
            an unknown placement.
    """
    first = read_urdf(find_file(source), xacro_args=xacro_args)
    if not others:
        return first
    root = parse_xml(first.text, first.source)
    notes = first.notes
    for of in others:
        tree = read_urdf(find_file(of.source))
        place, found = _place_of(of, tree, first)
        its = parse_xml(tree.text, tree.source)
        notes += (*found, *tree.notes, *_renamed(of, its, root, source=tree.source))
        for mesh in its.iter("mesh"):
            here, there = (
                find_mesh(mesh.get("filename", ""), source)
                for source in (tree.source, first.source)
            )
            if here is not None and here != there:
                mesh.set("filename", os.path.relpath(here, Path(first.source).resolve().parent))
        root.extend([*its, _placement(of.joint, first.root, _root_of(its, tree), place)])
        root.set("name", f"{root.get('name')}_{of.name}")
    cell = parse_urdf(etree.tostring(root), source=first.source)
    return replace(cell, notes=(*notes, *cell.notes))


def _place_of(
    of: Beside, tree: UrdfTree, first: UrdfTree
) -> tuple[tuple[float, ...], tuple[str, ...]]:
    """Return the place of a further robot beside the first, and a note if it was found; refuse one
    that is unknown.
    """
    if of.place is None:
        raise RobotFileError(
            f"{tree.origin}: its placement relative to {first.name} is unknown; expected contacts "
            "of the two, one station that sees both, or the placement, as in --beside "
            f"{of.name}={of.source}@1.5,0,0,0,0,3.14159"
        )
    place = ", ".join(f"{1e3 * number:z.1f}" for number in of.place[:3])
    turn = ", ".join(f"{math.degrees(number):z.3f}" for number in of.place[3:])
    note = (
        f"{of.name} is at {place} mm (x y z) and {turn} deg (roll pitch yaw) in the frame of "
        f"{first.root}, found from the readings"
    )
    return of.place, (note,) if of.is_found else ()


def _renamed(of: Beside, its: Any, root: Any, *, source: str) -> tuple[str, ...]:
    """Give the names of a further robot a prefix where the others have them, too; return a note if
    some do.
    """
    prefix = f"{of.name}_"
    taken = _names(root)
    notes = tuple[str, ...]()
    if twice := sorted(_names(its) & taken):
        _prefix(its, prefix, _names(its))
        notes += (
            f"two robots have a {twice[0]}: names of {of.source} get a prefix, as in "
            f"{prefix}{twice[0]}",
        )
    _prefix(its, prefix, _names(its, "material") & _names(root, "material"))
    if twice := sorted((_names(its) | {of.joint}) & taken):
        raise RobotFileError(
            f"{source}: {twice[0]!r} is already a name of another robot; "
            f"expected a name other than {of.name}"
        )
    return notes


def robot_files(source: str | os.PathLike[str], others: Sequence[Beside]) -> list[Path]:
    """Return the files of a robot and of the further ones."""
    return [find_file(of) for of in (source, *(one.source for one in others))]


def _names(root: Any, *tags: str) -> set[str]:
    return {element.get("name", "") for tag in tags or _NAMED for element in root.iterfind(tag)}


def _prefix(root: Any, prefix: str, names: set[str]) -> None:
    for element in root.iter(etree.Element):
        for key in _NAMING:
            if element.get(key) in names:
                element.set(key, prefix + element.get(key))
        text = (element.text or "").strip().split("::")[-1]
        if element.tag in ("parent", "child") and text in names:
            element.text = prefix + text


def _root_of(its: Any, tree: UrdfTree) -> str:
    return str(its.findall("link")[tree.links.index(tree.root)].get("name"))


def _placement(name: str, parent: str, child: str, place: Sequence[float]) -> Any:
    joint = etree.Element("joint", name=name, type="fixed")
    xyz, rpy = (
        " ".join(f"{number!r}" for number in map(float, part)) for part in (place[:3], place[3:])
    )
    etree.SubElement(joint, "origin", xyz=xyz, rpy=rpy)
    etree.SubElement(joint, "parent", link=parent)
    etree.SubElement(joint, "child", link=child)
    return joint
