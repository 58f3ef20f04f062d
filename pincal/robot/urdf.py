"""Reading a URDF with care: what is not a tree of links and joints is refused with the place and the reason."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree

from pincal.errors import RobotFileError, nearest_first
from pincal.robot.xacro_file import expand_xacro, is_xacro

MOVING_TYPES = ("revolute", "continuous", "prismatic")
_UNSUPPORTED_TYPES = ("planar", "floating")
# Lengths of an axis that can be meant; others lose all digits when they are normalised.
_AXIS_LENGTHS = (1e-6, 1e6)
# What Pinocchio calls the world.
_RESERVED = "universe"
# How ROS-Industrial and makers' URDFs name the link that a tool is mounted on, most specific first.
_TIP_NAMES = ("tool0", "tcp", "flange", "ee_link", "eef", "end_effector")


@dataclass(frozen=True)
class UrdfJoint:
    """One ``<joint>`` of a URDF, as far as the topology of the tree needs it."""

    name: str
    kind: str
    parent: str
    child: str
    mimic: str | None


@dataclass(frozen=True)
class UrdfTree:
    """The checked text of a URDF and the tree of links and joints it describes."""

    text: bytes
    name: str
    source: str
    links: tuple[str, ...]
    joints: tuple[UrdfJoint, ...]
    root: str

    def path(self, base: str, tip: str) -> tuple[UrdfJoint, ...]:
        """Return the joints from link ``base`` to link ``tip``, in this order.

        Raises:
            RobotFileError: if a link is unknown or ``base`` does not lie between the root and ``tip``.
        """
        for role, link in (("base", base), ("tip", tip)):
            if link not in self.links:
                raise RobotFileError(f"{self.source}: unknown {role} link {link!r}; {_known(link, self.links)}")
        by_child = {joint.child: joint for joint in self.joints}
        joints: list[UrdfJoint] = []
        link = tip
        while link != base:
            joint = by_child.get(link)
            if joint is None:
                raise RobotFileError(
                    f"{self.source}: {base!r} is not an ancestor of {tip!r}; expected a base link on the way from "
                    f"the root {self.root!r} to the tip: choose one of {', '.join([j.parent for j in joints])}"
                )
            joints.append(joint)
            link = joint.parent
        return tuple(reversed(joints))

    def default_tip(self, joint_names: Iterable[str] | None = None) -> str:
        """Return the link at the end of the arm.

        The arm is the chain of the joints named in ``joint_names`` where they are given, else the longest moving chain
        without the fingers of a gripper. Of several links rigidly behind its last joint, one named like a tool or a
        flange is preferred, as industrial URDFs name it, else the last along the chain.

        Raises:
            RobotFileError: if no chain of this URDF has just the joints ``joint_names``.
        """
        chains = self._moving_chains()
        if joint_names is None:
            end = max(chains, key=lambda link: (len(chains[link]), -self.links.index(link)))
            wanted = self._without_gripper(chains, chains[end])
        else:
            wanted = self._chain_of(chains, set(joint_names))
        ends = [link for link in chains if chains[link] == wanted]
        named = (link for name in _TIP_NAMES for link in ends if link == name or link.endswith("_" + name))
        return next(named, ends[-1])

    def _moving_chains(self) -> dict[str, tuple[str, ...]]:
        """Return, for each link that no mimic joint moves, the moving joints from the root to it."""
        chains: dict[str, tuple[str, ...]] = {self.root: ()}
        for joint in _in_tree_order(self.root, self.joints):
            if joint.parent in chains and joint.mimic is None:
                moves = (joint.name,) if joint.kind in MOVING_TYPES else ()
                chains[joint.child] = chains[joint.parent] + moves
        return chains

    def _without_gripper(self, chains: dict[str, tuple[str, ...]], chain: tuple[str, ...]) -> tuple[str, ...]:
        """Cut the fingers off: at most two joints that hang on a link beside other moving joints."""
        by_name = {joint.name: joint for joint in self.joints}
        # Behind which joints each moving joint hangs.
        hangs = [chains.get(joint.parent) for joint in self.joints if joint.kind in MOVING_TYPES]
        for cut in range(max(len(chain) - 2, 1), len(chain)):
            if hangs.count(chains[by_name[chain[cut]].parent]) > 1:
                return chain[:cut]
        return chain

    def _chain_of(self, chains: dict[str, tuple[str, ...]], names: set[str]) -> tuple[str, ...]:
        for chain in chains.values():
            if set(chain) == names or (chain and chain[-1] in names and names <= set(chain)):
                return chain
        unknown = sorted(names - {joint.name for joint in self.joints})
        problem = f"no joint {unknown[0]!r}" if unknown else f"no serial chain of the joints {', '.join(sorted(names))}"
        raise RobotFileError(f"{self.source}: {problem}; its joints: {', '.join(j.name for j in self.joints)}")


def parse_xml(text: bytes, source: str) -> Any:
    """Parse XML with entities, network and external files shut off.

    Raises:
        RobotFileError: if the text is not XML, declares entities, or its root is not ``<robot>``.
    """
    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False, remove_comments=False)
    try:
        root = etree.fromstring(text, parser)
    except etree.XMLSyntaxError as error:
        raise RobotFileError(f"{source}: not XML ({error}); expected a URDF file") from None
    dtd = root.getroottree().docinfo.internalDTD
    if dtd is not None and any(True for _ in dtd.iterentities()):
        raise RobotFileError(f"{source}: declares XML entities, which are refused; expand them in the file first")
    if root.tag != "robot":
        raise RobotFileError(f"{source}: root element is <{root.tag}>, expected <robot>")
    return root


def plain_text(text: bytes, source: str) -> str:
    """Return the XML as text without a declaration of its encoding, for readers that know only one."""
    return str(etree.tostring(parse_xml(text, source), encoding="unicode"))


def read_urdf(path: str | os.PathLike[str], *, xacro_args: Mapping[str, str] | None = None) -> UrdfTree:
    """Read and check a URDF file, which may be written as xacro.

    Args:
        path: the file.
        xacro_args: values of the arguments of a xacro file.

    Raises:
        RobotFileError: if the file can't be read or expanded, is not XML, or is not a tree of links with finite numbers; or
            if arguments are given for a file that is no xacro.
    """
    source = os.fspath(path)
    try:
        text = Path(path).read_bytes()
    except OSError as error:
        raise RobotFileError(f"{source}: can't be read ({error.strerror}); expected a URDF file") from None
    if is_xacro(text):
        text = expand_xacro(Path(path), text, xacro_args or {})
    elif xacro_args:
        raise RobotFileError(f"{source}: is no xacro file, so it takes no xacro arguments; leave them out")
    return parse_urdf(text, source=source)


def parse_urdf(text: bytes, *, source: str = "URDF") -> UrdfTree:
    """Check the text of a URDF; see :func:`read_urdf`."""
    root = parse_xml(text, source)
    links = tuple(_attribute(link, "name", source) for link in root.iterfind("link"))
    joints = tuple(_read_joint(element, source) for element in root.iterfind("joint"))
    for what, names in (("link", links), ("joint", tuple(joint.name for joint in joints))):
        twice = [name for name, count in Counter(names).items() if count > 1]
        if twice:
            raise RobotFileError(f"{source}: {what} {twice[0]!r} is defined more than once; rename or remove one")
        if _RESERVED in names:
            raise RobotFileError(f"{source}: {_RESERVED!r} names a {what}, but means the world to Pinocchio; rename it")
    if not root.get("name"):
        raise _fault(root, source, '<robot> has no name; expected <robot name="...">')
    for element in [*root.iterfind("joint/origin"), *root.iterfind("link/inertial/origin")]:
        _numbers(element, "xyz", source)
        _numbers(element, "rpy", source)
    _check_masses(root, source)
    return UrdfTree(text, root.get("name", "robot"), source, links, joints, _find_root(links, joints, source))


def _fault(element: Any, source: str, text: str) -> RobotFileError:
    return RobotFileError(f"{source}:{element.sourceline}: {text}")


def _read_joint(element: Any, source: str) -> UrdfJoint:
    name, kind = _attribute(element, "name", source), _attribute(element, "type", source)
    if kind not in (*MOVING_TYPES, *_UNSUPPORTED_TYPES, "fixed"):
        expected = ", ".join((*MOVING_TYPES, "fixed"))
        raise _fault(element, source, f"joint {name!r} has type {kind!r}; expected {expected}")
    ends = []
    for role in ("parent", "child"):
        end = element.find(role)
        if end is None or not end.get("link"):
            raise _fault(element, source, f"joint {name!r} names no {role} link")
        ends.append(end.get("link"))
    axis, mimic = element.find("axis"), element.find("mimic")
    if kind in MOVING_TYPES and axis is not None:
        with np.errstate(over="ignore"):
            length = float(np.linalg.norm(_numbers(axis, "xyz", source)))
        if not _AXIS_LENGTHS[0] < length < _AXIS_LENGTHS[1]:
            what = "a zero axis" if length == 0.0 else f"an axis of length {length:.1e}"
            raise _fault(axis, source, f"joint {name!r} has {what}; expected a direction of length 1")
    _check_limit(element, name, kind, source)
    return UrdfJoint(name, kind, ends[0], ends[1], None if mimic is None else mimic.get("joint", ""))


def _check_limit(element: Any, name: str, kind: str, source: str) -> None:
    """URDF asks for limits of revolute and prismatic joints, and readers refuse a file without."""
    limit = element.find("limit")
    if limit is None and kind in ("revolute", "prismatic"):
        hint = "add <limit lower upper effort velocity>, or make it continuous"
        raise _fault(element, source, f"joint {name!r} is {kind} and has no <limit>; {hint}")
    for key, text in () if limit is None else limit.items():
        if _number(text) is None:
            raise _fault(limit, source, f"joint {name!r} has <limit {key}={text!r}>; expected a number")


def _attribute(element: Any, key: str, source: str) -> str:
    value = element.get(key)
    if not value:
        raise _fault(element, source, f"<{element.tag}> without {key!r}; expected a text")
    return str(value)


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _numbers(element: Any, key: str, source: str) -> np.ndarray:
    text = element.get(key)
    if text is None:
        return np.array([1.0, 0.0, 0.0]) if element.tag == "axis" else np.zeros(3)
    values = np.array([_number(word) for word in text.split()], float)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise _fault(element, source, f"<{element.tag} {key}={text!r}>; expected three finite numbers")
    return values


def _check_masses(root: Any, source: str) -> None:
    for element in root.iterfind("link/inertial/mass"):
        link, text = element.getparent().getparent().get("name"), element.get("value")
        mass = _number(text or "")
        if mass is None or not 0.0 <= mass < np.inf:
            raise _fault(element, source, f"link {link!r} has mass {text!r}; expected a number of kg that is not negative")
        if element.getparent().find("inertia") is None:
            hint = "so URDF readers drop the mass; add one, of zeros if it is not known"
            raise _fault(element, source, f"link {link!r} has a mass but no <inertia>, {hint}")


def _find_root(links: tuple[str, ...], joints: tuple[UrdfJoint, ...], source: str) -> str:
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in links:
                text = f"joint {joint.name!r} names the unknown link {link!r}; {_known(link, links)}"
                raise RobotFileError(f"{source}: {text}")
    children = Counter(joint.child for joint in joints)
    closed = [link for link, count in children.items() if count > 1]
    if closed:
        names = ", ".join(joint.name for joint in joints if joint.child == closed[0])
        raise RobotFileError(
            f"{source}: link {closed[0]!r} is the child of several joints ({names}), a closed loop; "
            "expected a tree: cut the loop at one joint"
        )
    roots = [link for link in links if link not in children]
    if len(roots) != 1 or len(_in_tree_order(roots[0], joints)) != len(joints):
        raise RobotFileError(
            f"{source}: the links form no single tree (roots: {', '.join(roots) or 'none, the joints run in a circle'});"
            " expected every link to hang on one root link"
        )
    return roots[0]


def _in_tree_order(root: str, joints: tuple[UrdfJoint, ...]) -> list[UrdfJoint]:
    order: list[UrdfJoint] = []
    open_links = [root]
    while open_links:
        link = open_links.pop()
        below = [joint for joint in joints if joint.parent == link]
        order += below
        open_links += [joint.child for joint in below]
    return order


def _known(name: str, known: Iterable[str]) -> str:
    return f"known ones: {', '.join(nearest_first([name], known)[:12])}"
