"""The tree of links and joints of a URDF, and the selection of the arm among its chains."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import PurePath

import numpy as np

from pincal.errors import BadInputError, RobotFileError, nearest_first

# The folder in which a library installs descriptions that are asked for by name.
_LIBRARY = "example-robot-data"
MOVING_TYPES = ("revolute", "continuous", "prismatic")
# Names of the link that a tool is mounted on, in URDFs of ROS-Industrial and makers, most specific
# first.
_TIP_NAMES = ("tool0", "tcp", "flange", "ee_link", "eef", "end_effector")
# Names of fingers and their joints. The last joint of many arms turns the body of a gripper, so
# "gripper" is only for joints.
_FINGER = re.compile(
    r"finger|thumb|jaw|knuckle|hand[a-z_]*_(index|middle|ring|little|pinky)", re.IGNORECASE
)
_FINGER_JOINT = re.compile(_FINGER.pattern + "|gripper", re.IGNORECASE)
# Names of links on an arm to which no tool is mounted.
_NO_TIP = re.compile(
    _FINGER_JOINT.pattern + "|camera|optical|imu|accelerometer|range|laser|light", re.IGNORECASE
)


@dataclass(frozen=True)
class Mimic:
    """A mimic joint: its position is ``multiplier`` times the position of ``source`` plus
    ``offset``.

    Attributes:
        joint: name of the mimic joint.
        source: name of the joint that it follows.
        multiplier: factor [rad or m per rad or m].
        offset: its position with the source at zero [rad or m].
    """

    joint: str
    source: str
    multiplier: float
    offset: float


def mimicked(q: np.ndarray, names: Sequence[str], mimics: Iterable[Mimic]) -> np.ndarray:
    """Return the positions of named joints, shape (N, n), with mimic joints set from
    their sources.
    """
    out = np.array(q, np.result_type(q, float))
    for mimic in mimics:
        out[:, names.index(mimic.joint)] = (
            mimic.multiplier * out[:, names.index(mimic.source)] + mimic.offset
        )
    return out


def numbered(names: Sequence[str]) -> Sequence[str]:
    """Return names sorted by the last number in each, or unchanged if these numbers are not
    distinct.

    Example:
        >>> numbered(["joint_1", "joint_4", "joint_3"])
        ['joint_1', 'joint_3', 'joint_4']
    """
    numbers = {name: int(found[-1]) for name in names if (found := re.findall(r"\d+", name))}
    return (
        sorted(names, key=numbers.__getitem__)
        if len(set(numbers.values())) == len(names)
        else names
    )


@dataclass(frozen=True)
class Coupling:
    """A coupled joint: its position is its reported position plus ``factor`` times the reported
    position of ``source``.

    Attributes:
        joint: name of the joint.
        source: name of the joint whose reported position is added.
        factor: factor [rad or m per rad or m].

    Example:
        >>> Coupling.of("joint_5 = -1/3 * joint_4")
        Coupling(joint='joint_5', source='joint_4', factor=-0.3333333333333333)
    """

    joint: str
    source: str
    factor: float

    @classmethod
    def of(cls, text: str) -> Coupling:
        """Parse a text such as ``joint_3=+joint_2`` or ``joint_5=-1/3*joint_4``.

        Raises:
            BadInputError: if it is malformed.
        """
        joint, _, term = text.replace(" ", "").partition("=")
        found = re.fullmatch(r"([+-]?)(?:([0-9.]+)(?:/([0-9.]+))?\*)?([^*]+)", term)
        try:
            assert found is not None and joint and joint != found[4]
            factor = (
                float(found[2] or 1.0) / float(found[3] or 1.0) * (-1.0 if found[1] == "-" else 1.0)
            )
        except (AssertionError, ValueError, ZeroDivisionError):
            raise BadInputError(
                f"coupling {text!r}; expected one such as joint_3=+joint_2 or joint_5=-1/3*joint_4"
            ) from None
        return cls(joint, found[4].removeprefix("+"), factor)


@dataclass(frozen=True)
class UrdfJoint:
    """One ``<joint>`` of a URDF, as far as the topology of the tree requires."""

    name: str
    kind: str
    parent: str
    child: str
    mimic: Mimic | None


@dataclass(frozen=True, eq=False)
class UrdfClosure:
    """A loop closure: a joint between two links of the tree.

    Attributes:
        name: name of the joint or constraint.
        kind: its type in the URDF.
        parent, child: the links that it joins.
        T_parent: shape (4, 4), its frame on the parent link; None if it coincides with the child's
            at zero positions.
        T_child: shape (4, 4), its frame on the child link.
        axis_parent, axis_child: shape (3,), its axis in each of these frames.
    """

    name: str
    kind: str
    parent: str
    child: str
    T_parent: np.ndarray | None
    T_child: np.ndarray
    axis_parent: np.ndarray
    axis_child: np.ndarray


@dataclass(frozen=True)
class UrdfTree:
    """The validated text of a URDF and its tree of links and joints.

    Attributes:
        text: the URDF.
        name: name of the robot.
        source: the file of the text, or what else it came from.
        links: names of the links.
        joints: the joints of the tree.
        root: the link that carries all others.
        closures: the loop closures.
        notes: the interpretation of ambiguous parts, in words.
    """

    text: bytes
    name: str
    source: str
    links: tuple[str, ...]
    joints: tuple[UrdfJoint, ...]
    root: str
    closures: tuple[UrdfClosure, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def origin(self) -> str:
        """What messages call the description: where it was read, and of a file that comes with a
        library, and was asked for by the robot's name, only the file's own name.
        """
        path = PurePath(self.source)
        return path.name if _LIBRARY in path.parts else self.source

    def path(self, base: str, tip: str) -> tuple[UrdfJoint, ...]:
        """Return the joints from link ``base`` to link ``tip``, in this order.

        Raises:
            RobotFileError: if a link is unknown or ``base`` does not lie between the root and
                ``tip``.
        """
        for role, link in (("base link", base), ("link", tip)):
            if link not in self.links:
                raise RobotFileError(
                    f"{self.origin}: unknown {role} {link!r}; {known_links(link, self.links)}"
                )
        joints = self.above(tip)
        links = [joint.parent for joint in joints]
        if base != tip and base not in links:
            raise RobotFileError(
                f"{self.origin}: {base!r} is not an ancestor of {tip!r}; expected a base "
                "link between the root "
                f"{self.root!r} and the tip: choose one of {', '.join(reversed(links))}"
            )
        return joints[links.index(base) :] if base != tip else ()

    def above(self, link: str) -> tuple[UrdfJoint, ...]:
        """Return the joints from the root to a link."""
        joints: list[UrdfJoint] = []
        while (joint := self._by_child.get(link)) is not None:
            joints.append(joint)
            link = joint.parent
        return tuple(reversed(joints))

    @cached_property
    def _by_child(self) -> dict[str, UrdfJoint]:
        return {joint.child: joint for joint in self.joints}

    def carrier(self, joints: Sequence[UrdfJoint], link: str) -> int:
        """Return the index of the joint that carries a link, -1 for none of them."""
        place = {joint.name: i for i, joint in enumerate(joints)}
        return next(
            (place[joint.name] for joint in reversed(self.above(link)) if joint.name in place), -1
        )

    def default_tip(self, joint_names: Iterable[str] | None = None) -> str:
        """Return the link at the end of the arm.

        The arm is the chain of the joints ``joint_names`` if given, else the longest moving chain
        without the fingers of a gripper. Of several links fixed to its last joint, one named like a
        tool or a flange in industrial URDFs is preferred, else the last along the chain that is not
        part of a gripper.

        Raises:
            RobotFileError: if no chain of this URDF consists of the joints ``joint_names``.
        """
        chains = self._moving_chains()
        if joint_names is None:
            end = max(
                chains,
                key=lambda link: (
                    len(self._own(chains[link])),
                    len(chains[link]),
                    -self.links.index(link),
                ),
            )
            wanted = self._without_gripper(chains, chains[end])
        else:
            wanted = self._chain_of(chains, set(joint_names))
        ends = [link for link in chains if chains[link] == wanted]
        named = (
            link
            for name in _TIP_NAMES
            for link in ends
            if link == name or link.endswith("_" + name)
        )
        return next(
            named, next((link for link in reversed(ends) if not _NO_TIP.search(link)), ends[-1])
        )

    def mimics(self, path: Sequence[UrdfJoint]) -> tuple[Mimic, ...]:
        """Return each mimic joint on a path as a function of an independent joint on the path.

        Raises:
            RobotFileError: for a joint that mimics one off the path, or itself through others.
        """
        by_name = {joint.name: joint for joint in path}
        found = []
        for name, joint in by_name.items():
            if joint.mimic is None:
                continue
            total = joint.mimic
            seen = {name}
            while (
                total.source not in seen
                and total.source in by_name
                and (further := by_name[total.source].mimic)
            ):
                seen.add(total.source)
                offset = total.multiplier * further.offset + total.offset
                total = Mimic(name, further.source, total.multiplier * further.multiplier, offset)
            if total.source not in by_name or total.source in seen:
                ends = f"between {path[0].parent!r} and {path[-1].child!r}"
                raise RobotFileError(
                    f"{self.origin}: joint {name!r} {ends} mimics {total.source!r}, which is not "
                    "an independent joint between base and tip: choose another base or tip, or let "
                    "it mimic a joint of the arm"
                )
            found.append(total)
        return tuple(found)

    @cached_property
    def looped(self) -> frozenset[str]:
        """The moving joints of all loops."""
        return frozenset[str]().union(*map(self.loop, self.loops))

    @cached_property
    def loops(self) -> tuple[UrdfClosure, ...]:
        """Closures of loops with moving joints, except loops with a mimic joint, which describes
        their motion.
        """
        driven = {joint.name for joint in self.joints if joint.mimic is not None}
        return tuple(
            closure
            for closure in self.closures
            if (loop := self.loop(closure)) and not loop & driven
        )

    def loop(self, closure: UrdfClosure) -> frozenset[str]:
        """Return the names of the moving joints of a closure's loop."""
        one, other = (
            {j.name for j in self.above(end) if j.kind in MOVING_TYPES}
            for end in (closure.parent, closure.child)
        )
        return frozenset(one ^ other)

    def with_loops(self, names: Iterable[str]) -> set[str]:
        """Return names of joints together with all joints that are in a loop with some of them."""
        found = set(names)
        loops = [self.loop(closure) for closure in self.loops]
        while more := [loop for loop in loops if loop & found and loop - found]:
            found.update(*more)
        return found

    def _own(self, chain: tuple[str, ...]) -> tuple[str, ...]:
        driven = {joint.name for joint in self.joints if joint.mimic is not None}
        return tuple(name for name in chain if name not in driven)

    def _moving_chains(self) -> dict[str, tuple[str, ...]]:
        """Return the moving joints from the root to each link, if the sources of their mimic joints
        are among them.
        """
        mimics = {
            joint.name: joint.mimic.source for joint in self.joints if joint.mimic is not None
        }
        chains: dict[str, tuple[str, ...]] = {self.root: ()}
        for joint in in_tree_order(self.root, self.joints):
            moves = (joint.name,) if joint.kind in MOVING_TYPES else ()
            chains[joint.child] = chains[joint.parent] + moves
        return {
            link: chain
            for link, chain in chains.items()
            if all(mimics[name] in chain for name in mimics.keys() & set(chain))
        }

    def _without_gripper(
        self, chains: dict[str, tuple[str, ...]], chain: tuple[str, ...]
    ) -> tuple[str, ...]:
        """Cut off the fingers: joints named so, and at most two last ones that share a link with
        other moving joints.
        """
        by_name = {joint.name: joint for joint in self.joints}
        cuts = [
            i
            for i, name in enumerate(chain)
            if _FINGER_JOINT.search(name) or _FINGER.search(by_name[name].child)
        ]
        # A robot whose first joint is named so is a hand, or all its names contain the word.
        if cuts and cuts[0] > 0:
            return chain[: cuts[0]]
        # The joints above each moving joint, without the rods of loops.
        rods = self.looped - set(chain)
        above = [
            chains.get(joint.parent)
            for joint in self.joints
            if joint.kind in MOVING_TYPES and joint.name not in rods
        ]
        for cut in range(max(len(chain) - 2, 1), len(chain)):
            if above.count(chains.get(by_name[chain[cut]].parent, ())) > 1:
                return chain[:cut]
        return chain

    def _chain_of(self, chains: dict[str, tuple[str, ...]], names: set[str]) -> tuple[str, ...]:
        fitting = []
        for chain in chains.values():
            own = self._own(chain)
            reached = self.with_loops(chain)
            needed = set(own) - self.looped
            is_all = needed <= names <= reached
            if own and (is_all or (own[-1] in names and names <= reached)):
                fitting.append((is_all, len(needed), chain))
        if fitting:
            # A complete chain is preferred to a part of one, and the longest with these joints.
            best = max(fitting, key=lambda found: (found[0], -found[1], len(found[2])))
            return best[2]
        unknown = sorted(names - {joint.name for joint in self.joints})
        problem = (
            f"no joint {unknown[0]!r}"
            if unknown
            else f"no serial chain of the joints {', '.join(sorted(names))}"
        )
        raise RobotFileError(
            f"{self.origin}: {problem}; its joints: {', '.join(j.name for j in self.joints)}"
        )


def in_tree_order(root: str, joints: tuple[UrdfJoint, ...]) -> list[UrdfJoint]:
    """Return the joints below a link, each after those that carry it."""
    by_parent: dict[str, list[UrdfJoint]] = {}
    for joint in joints:
        by_parent.setdefault(joint.parent, []).append(joint)
    order: list[UrdfJoint] = []
    open_links = [root]
    while open_links:
        below = by_parent.pop(open_links.pop(), [])
        order += below
        open_links += [joint.child for joint in below]
    return order


def known_links(name: str, known: Iterable[str]) -> str:
    """Return known names for a message, the nearest first."""
    return f"known ones: {', '.join(nearest_first([name], known)[:12])}"
