r"""The kinematic chain as a sequence of elementary transforms, each with one scalar coordinate.

From the instrument's frame to the target, if the path between them is a serial arm from its base to
its tip:

.. math::

    Tr(x) Tr(y) Tr(z) \bar R_{base} R(x) R(y) R(z) \; T_{base,0} \prod_i A_i \; T_{n,tip} \;
    Tr(x) Tr(y) Tr(z) \bar R_{tool} R(x) R(y) R(z)

    A_i = R(x; s_x) R(y; s_y) R(z; q + \theta) R(z; \gamma_z) Tr(z; h) R(y; \gamma_y) R(x; \gamma_x)
    Tr(z; d - h) Tr(x; a)
          R(x; \alpha)

which with the bearing at the frame's origin (h = 0) is exactly the paper's DH,s,e, between a base
frame and a tool frame. The two reference rotations (bars) absorb any orientation of instrument and
tool, so that the six angles next to them stay small and away from singularities. The joint position
of a prismatic joint is added to d instead of theta. It bears on its carriage, which moves with it:

.. math::

    A_i = R(x; s_x) R(y; s_y) R(z; \theta) Tr(z; d - h) R(z; \gamma_z) R(y; \gamma_y) R(x; \gamma_x)
    Tr(z; h) Tr(x; a)
          R(x; \alpha)

with h the constant distance from the carriage's bearings to the end of d.

A path between any two links of a tree runs up from the first to their common ancestor and down to
the other. On the way up the transforms are inverted and in reverse order; the coordinates are the
same. The first joint of a branch, carried by a link whose frame another joint continues, has Tr(x)
Tr(y) before its A_i: with s_x and s_y they locate its axis. So has a pin that closes a loop, if its
link extends beyond it; at the end of a rod it has none, as a is the rod's length.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from pincal.model.kernel_inputs import BLOCK, FRAME, MOUNT, Layout, Route
from pincal.model.latest import Evaluations
from pincal.parameters import FRAME_SYMBOLS
from pincal.robot.closure import Closure
from pincal.robot.link_path import LinkPath, above
from pincal.robot.robot import Robot
from pincal.thresholds import Count, Scale

MomentFrame = Literal["paper", "before", "after"]
MOMENT_FRAMES: tuple[MomentFrame, ...] = ("paper", "before", "after")

_JOINT_SYMBOLS = ("s_x", "s_y", "theta", "gamma_z", "h", "gamma_y", "gamma_x", "d", "a", "alpha")
# Lateral offset of the first axis of a branch from the frame of the link that carries it.
MOUNT_SYMBOLS = ("x", "y")
# A compliance fixed to the previous link acts before the joint turns.
_JOINT_SYMBOLS_BEFORE = (
    "s_x",
    "s_y",
    "h",
    "gamma_z",
    "gamma_y",
    "gamma_x",
    "theta",
    "d",
    "a",
    "alpha",
)
# A carriage deflects where it is, after its motion d. The rotation theta is constant and about the
# direction of motion, so its place among these is a matter of axes only: those before it with
# "paper" and "before", after it with "after".
_SLIDE_SYMBOLS: dict[MomentFrame, tuple[str, ...]] = {
    "paper": ("s_x", "s_y", "d", "theta", "gamma_z", "gamma_y", "gamma_x", "h", "a", "alpha"),
    "before": ("s_x", "s_y", "d", "gamma_z", "gamma_y", "gamma_x", "h", "theta", "a", "alpha"),
    "after": ("s_x", "s_y", "theta", "d", "gamma_z", "gamma_y", "gamma_x", "h", "a", "alpha"),
}
# Places in a joint's block: of the coordinates whose axes are y and z of the frame of its moment,
# which is about the origin of the later one, and of the last coordinate that turns or moves this
# frame.
_MOMENT_AT: dict[MomentFrame, tuple[int, int, int]] = {
    "paper": (1, 2, 1),
    "before": (1, 3, 2),
    "after": (5, 3, 4),
}
_SLIDE_MOMENT_AT: dict[MomentFrame, tuple[int, int, int]] = {
    "paper": (1, 3, 2),
    "before": (1, 3, 2),
    "after": (5, 4, 4),
}
_KIND = {
    "s_x": 0, "s_y": 1, "theta": 2, "gamma_z": 2, "h": 5,
    "gamma_y": 1, "gamma_x": 0, "d": 5, "a": 3, "alpha": 0,
    "rx": 0, "ry": 1, "rz": 2, "x": 3, "y": 4, "z": 5,
}  # fmt: skip
# Largest number of paths kept of one robot.
_MOST_PATHS: Count = 64
# Chains and their poses of which results are kept.
_MOST_STATIONS: Count = 16
# A joint closer than this to the origin of its frame is taken to be there [m].
_AT_ORIGIN: Scale = 1e-6
# Columns of DhFrames.parameters.
_DH_COLUMN = {"s_x": 0, "s_y": 1, "theta": 2, "d": 3, "a": 4, "alpha": 5}


@dataclass(frozen=True)
class _Walk:
    """A walk along a path in the making, and the transforms of it that are fixed."""

    fixed: list[np.ndarray]
    steps: list[int] = field(default_factory=list)
    along: list[float] = field(default_factory=list)
    fixed_before: list[int] = field(default_factory=list)

    def add(self, coordinates: Sequence[int], sign: float, T: np.ndarray | None) -> None:
        """Walk along some coordinates, or against them, behind a fixed transform if there is
        one.
        """
        self.steps.extend(coordinates)
        self.along.extend([sign] * len(coordinates))
        first = -1 if T is None else len(self.fixed)
        self.fixed_before.extend([first, *[-1] * (len(coordinates) - 1)])
        if T is not None:
            self.fixed.append(T)

    @property
    def route(self) -> Route:
        """The walk as arrays."""
        return Route(np.array(self.steps), np.array(self.along), np.array(self.fixed_before))


@dataclass(frozen=True, repr=False)
class Chain:
    """The coordinates of an arm between an instrument and a target.

    Attributes:
        robot: the arm.
        moment_frame: the frame in which moments are taken and deflect the arm: "paper" takes them
            before q and deflects after it, "before" and "after" do both there. The carriage of a
            prismatic joint bears and deflects where it is; the three differ in the axes.
        gravity: shape (3,), in the robot's base frame [m/s^2].
        base_rotation: shape (3, 3), reference orientation of the robot's base in the instrument's
            frame; of several set-ups shape (S, 3, 3).
        targets: names of the tool frames.
        tool_rotations: shape (targets, 3, 3), reference orientations of the targets in the tip
            frame; of several set-ups one after the other.
        bearing_heights: shape (n,), distance of each joint's bearing along its axis from the
            preceding frame [m]; that of a carriage at joint position 0.
        ends: the links between which readings are taken; default: those of the robot's path.
        kept: results cached for this chain and the chains derived from it.
    """

    robot: Robot
    moment_frame: MomentFrame
    gravity: np.ndarray
    base_rotation: np.ndarray
    targets: tuple[str, ...]
    tool_rotations: np.ndarray
    bearing_heights: np.ndarray
    ends: LinkPath | None = None
    kept: Evaluations = field(default_factory=Evaluations, compare=False)

    def __repr__(self) -> str:
        return (
            f"Chain({self.robot.name!r}: {self.robot.n_joints} joints, targets "
            f"{' '.join(self.targets)})"
        )

    @classmethod
    def of(
        cls,
        robot: Robot,
        *,
        moment_frame: MomentFrame = "paper",
        gravity: ArrayLike | None = None,
        targets: tuple[str, ...] = ("tool",),
        path: LinkPath | None = None,
    ) -> Chain:
        """Return the chain of a robot with its base frame at the instrument and its tool frames at
        the tip.

        In the paper a joint's bearing is at the origin of its frame; with "before" and "after" it
        is at the URDF's joint.
        """
        if moment_frame not in MOMENT_FRAMES:
            raise ValueError(
                f"moment_frame is {moment_frame!r}; expected one of {', '.join(MOMENT_FRAMES)}"
            )
        g = robot.gravity if gravity is None else np.asarray(gravity, float)
        tools = np.tile(np.eye(3), (len(targets), 1, 1))
        heights = _bearing_heights(robot, moment_frame)
        return cls(robot, moment_frame, g, np.eye(3), targets, tools, heights, path)

    def with_moment_frame(self, moment_frame: MomentFrame) -> Chain:
        """Return the same chain with another moment frame: always the same object for each
        convention.
        """
        known = self._in_frames
        if moment_frame not in known:
            heights = self.kept.about("heights", self.robot)
            if moment_frame not in heights:
                heights[moment_frame] = _bearing_heights(self.robot, moment_frame)
            known[moment_frame] = replace(
                self, moment_frame=moment_frame, bearing_heights=heights[moment_frame]
            )
            known[moment_frame].__dict__["_in_frames"] = known
        return known[moment_frame]

    def between(self, start: str, tip: str) -> Chain:
        """Return the same robot's chain between two links, see
        :meth:`pincal.robot.robot.Robot.between`.
        """
        if (start, tip) == (self.path.start, self.path.tip):
            return self
        return replace(self, ends=self.robot.between(start, tip))

    def with_references(self, base_rotation: np.ndarray, tool_rotations: np.ndarray) -> Chain:
        """Return the same chain about other reference orientations of base and tools."""
        return replace(
            self, base_rotation=np.array(base_rotation), tool_rotations=np.array(tool_rotations)
        )

    @property
    def path(self) -> LinkPath:
        """The links between which readings are taken, and their poses on the joints that carry
        them.
        """
        return self.robot.path if self.ends is None else self.ends

    @property
    def size(self) -> int:
        """Number K of coordinates."""
        return int(self._static["starts"][-1]) + MOUNT * len(self.pins) + FRAME

    @property
    def symbols(self) -> tuple[str, ...]:
        """The symbol of each coordinate, e.g. "theta"."""
        return _symbols(self._shape)

    @cached_property
    def _shape(self) -> _Shape:
        slides = tuple(kind == "prismatic" for kind in self.robot.joint_types)
        return _Shape(self.moment_frame, slides, self.robot.frames.branches, len(self.pins))

    @property
    def _static(self) -> dict[str, Any]:
        return _order(self._shape)

    @cached_property
    def pins(self) -> tuple[Closure, ...]:
        """Loop closures with a position of their own on a link, in addition to the
        length of a rod.
        """
        return tuple(
            closure for closure in self.robot.closures if closure.pinned(self.robot.parents)
        )

    @cached_property
    def mounts(self) -> frozenset[str]:
        """Names of the coordinates that locate an arm's mount on a link that carries another arm as
        well.
        """
        names = (self.robot.joint_names[i] for i in self.robot.frames.branches)
        return frozenset(
            f"{name}.{symbol}"
            for name in names
            for symbol in (*MOUNT_SYMBOLS, "d", "theta", "s_x", "s_y")
        )

    @cached_property
    def on_path(self) -> np.ndarray:
        """Which joints are on the path, shape (n,)."""
        found = np.zeros(self.robot.n_joints, bool)
        found[[joint for joint, _ in self.path.steps(self.robot.parents)]] = True
        return found

    @cached_property
    def _in_frames(self) -> dict[MomentFrame, Chain]:
        """This chain in the moment frames requested so far; these chains share this dictionary, so
        that caches persist.
        """
        return {self.moment_frame: self}

    def known(self, what: str, *objects: object) -> dict[Any, Any]:
        """Return the cache of one kind of result for this very chain and some objects, to be added
        to.

        Each of several stations has a chain and poses of its own.
        """
        return self.kept.about(what, self.token, *objects, most=_MOST_STATIONS)

    @cached_property
    def token(self) -> object:
        """An identity of this very chain that does not keep it alive."""
        return object()

    @cached_property
    def nominal(self) -> np.ndarray:
        """Nominal coordinates, shape (K,): the robot's Denavit-Hartenberg parameters and bearings,
        zero elsewhere.
        """
        known = self.kept.about("nominal", self.robot, self.bearing_heights)
        if self.moment_frame not in known:
            known[self.moment_frame] = values = np.zeros(self.size)
            for i, row in enumerate(self.robot.frames.parameters):
                for symbol, column in _DH_COLUMN.items():
                    values[self.joint(i, symbol)] = row[column]
                height = self.bearing_heights[i]
                values[self.joint(i, "h")] = (
                    row[_DH_COLUMN["d"]] - height if self._shape.slides[i] else height
                )
        return np.asarray(known[self.moment_frame])

    @cached_property
    def drives(self) -> np.ndarray:
        """The coordinate that each joint's position adds to, shape (n,): theta, or d of a prismatic
        joint.
        """
        types = self.robot.joint_types
        return np.array(
            [self.joint(i, "d" if kind == "prismatic" else "theta") for i, kind in enumerate(types)]
        )

    def joint(self, i: int, symbol: str) -> int:
        """Return the index of a coordinate of joint ``i`` (from 0)."""
        return self.joint_coordinates(i)[symbol]

    def joint_or_drive(self, i: int, symbol: str) -> int:
        """Return the index of a coordinate of joint ``i``, or, for "drive", of its own motion."""
        return int(self.drives[i]) if symbol == "drive" else self.joint(i, symbol)

    def joint_coordinates(self, i: int) -> dict[str, int]:
        """Return the index of each coordinate of joint ``i`` (from 0) by its symbol."""
        return _places(self._shape)[i]

    def pin(self, i: int, symbol: str) -> int:
        """Return the index of the coordinate "x" or "y" of pin ``i`` of :attr:`pins`."""
        return int(self._static["starts"][-1]) + MOUNT * i + MOUNT_SYMBOLS.index(symbol)

    def base(self, symbol: str) -> int:
        """Return the index of a coordinate of the base frame."""
        return FRAME_SYMBOLS.index(symbol)

    def tool(self, symbol: str) -> int:
        """Return the index of a coordinate of the tool frame."""
        return self.size - FRAME + FRAME_SYMBOLS.index(symbol)

    def height_on_axis(self, i: int) -> float:
        """Return the position of the URDF's joint i along its axis, from the preceding
        frame [m].
        """
        return float(_heights_on_axes(self.robot)[i])

    @cached_property
    def layout(self) -> Layout:
        """The chain's constant part as arrays for the compiled loops."""
        routes = self.kept.about("routes", self.robot, self.path, most=_MOST_PATHS)
        if self.moment_frame not in routes:
            routes[self.moment_frame] = self._routes(self.path)
        return Layout(
            **self._static,
            **routes[self.moment_frame],
            base_rotation=np.ascontiguousarray(self.base_rotation).reshape(-1, 3, 3),
            tool_rotation=np.ascontiguousarray(self.tool_rotations),
            masses=self.robot.masses,
            centres=np.ascontiguousarray(self.robot.centres),
            gravity=self.gravity,
        )

    def loop_layout(self, closure: Closure) -> Layout:
        """Return the layout of the walk from one end of a closure to the other; base and tool
        coordinates must be zero.
        """
        nothing = range(0)
        side = closure.pinned(self.robot.parents)
        at = self.pin(self.pins.index(closure), "x") if side else 0
        pin = range(at, at + MOUNT)
        routes = self._routes(
            closure.path, pin if side < 0 else nothing, pin if side > 0 else nothing
        )
        upright = np.eye(3)[None]
        return self.layout._replace(**routes, base_rotation=upright, tool_rotation=upright)

    def _routes(
        self, path: LinkPath, start: range = range(0), end: range = range(0)
    ) -> dict[str, Any]:
        """Return the walks over the tree and along a path, and the fixed transforms of both.

        ``start`` and ``end`` are further coordinates that move the frame at which the path starts
        or ends.
        """
        starts = self._static["starts"]
        frames = self.robot.frames
        before = {0: 0} | {joint: i for i, joint in enumerate(frames.branches, 1)}
        in_tree = np.full(self.size, -1)
        in_tree[[starts[joint] for joint in before]] = list(before.values())
        walk = self._walk(path, before, start, end)
        return {
            "tree": Route(np.arange(self.size), np.ones(self.size), in_tree),
            "path": walk.route,
            "parents": np.array(self.robot.parents),
            **self._loads(path),
            "fixed": np.ascontiguousarray(np.array(walk.fixed)[:, :3]),
            "tip": 1 + len(frames.branches),
            "tip_joint": path.tip_joint,
        }

    def _walk(self, path: LinkPath, before: Mapping[int, int], start: range, end: range) -> _Walk:
        """Return the walk along a path; ``before`` gives the number of the fixed transform in front
        of each joint that has one.
        """
        starts = self._static["starts"]
        frames = self.robot.frames
        walk = _Walk([frames.T_base_first, *frames.T_branch_first, path.T_joint_tip])
        walk.add(range(FRAME), 1.0, None)
        is_there = np.array_equal(path.T_joint_start, np.eye(4))
        pending = None if is_there else np.linalg.inv(path.T_joint_start)
        if start:
            walk.add(start[::-1], -1.0, None)
        for joint, sign in path.steps(self.robot.parents):
            T = walk.fixed[before[joint]] if joint in before else None
            block = range(starts[joint], starts[joint + 1])
            if sign > 0:
                walk.add(block, 1.0, _product(pending, T))
                pending = None
            else:
                walk.add(block[::-1], -1.0, pending)
                pending = None if T is None else np.linalg.inv(T)
        last = [*end, *range(self.size - FRAME, self.size)]
        walk.add(last, 1.0, _product(pending, path.T_joint_tip))
        return walk

    def _loads(self, path: LinkPath) -> dict[str, np.ndarray]:
        """Return the joints whose loads bend a path, and those that act on these loads; all joints
        if there are loops.
        """
        n = self.robot.n_joints
        parents = self.robot.parents
        bears = np.full(n, bool(self.robot.closures))
        bears[[joint for joint, _ in path.steps(parents)]] = True
        acting = bears.copy()
        for joint, parent in enumerate(parents):
            acting[joint] |= parent >= 0 and acting[parent]
        for joint in (path.start_joint, path.tip_joint):
            acting[above(joint, parents)] = True
        return {"bears": bears, "acting": np.flatnonzero(acting)}


def _product(A: np.ndarray | None, B: np.ndarray | None) -> np.ndarray | None:
    """Return the product of two transforms, shape (4, 4), of which either may be missing."""
    if A is None or B is None:
        return B if A is None else A
    return np.asarray(A @ B)


def _heights_on_axes(robot: Robot) -> np.ndarray:
    """Return the position of each URDF joint along its axis, from the preceding frame, shape (n,)
    [m].
    """
    d, alpha = robot.frames.parameters[:, [_DH_COLUMN["d"], _DH_COLUMN["alpha"]]].T
    y, z = robot.T_link_joint[:, 1:3, 3].T
    return np.asarray(d + np.sin(alpha) * y + np.cos(alpha) * z)


def _bearing_heights(robot: Robot, moment_frame: MomentFrame) -> np.ndarray:
    heights = _heights_on_axes(robot)
    return np.where((moment_frame != "paper") & (np.abs(heights) > _AT_ORIGIN), heights, 0.0)


class _Shape(NamedTuple):
    """What the order of a chain's coordinates depends on.

    Attributes:
        moment_frame: of the chain.
        slides: whether each joint is prismatic.
        branches: the joints that begin a branch.
        n_pins: number of pins with a position of their own.
    """

    moment_frame: MomentFrame
    slides: tuple[bool, ...]
    branches: tuple[int, ...]
    n_pins: int


@cache
def _symbols(shape: _Shape) -> tuple[str, ...]:
    turning = _JOINT_SYMBOLS_BEFORE if shape.moment_frame == "before" else _JOINT_SYMBOLS
    sliding = _SLIDE_SYMBOLS[shape.moment_frame]
    symbols: tuple[str, ...] = FRAME_SYMBOLS
    for i, slides in enumerate(shape.slides):
        symbols += MOUNT_SYMBOLS if i in shape.branches else ()
        symbols += sliding if slides else turning
    return symbols + shape.n_pins * MOUNT_SYMBOLS + FRAME_SYMBOLS


@cache
def _places(shape: _Shape) -> list[dict[str, int]]:
    """Return the index of each coordinate of each joint by its symbol."""
    symbols = _symbols(shape)
    starts = _order(shape)["starts"].tolist()
    return [{symbols[k]: k for k in range(a, b)} for a, b in pairwise(starts)]


@cache
def _order(shape: _Shape) -> dict[str, Any]:
    """Return the part of a layout that depends on the order of the coordinates alone, shared by all
    chains.
    """
    symbols = _symbols(shape)
    joints = np.arange(len(shape.slides) + 1)
    starts = FRAME + BLOCK * joints + MOUNT * np.searchsorted(sorted(shape.branches), joints)
    less = np.full(len(symbols), -1)
    less[[k for k, symbol in enumerate(symbols) if symbol == "d"]] = [
        k for k, symbol in enumerate(symbols) if symbol == "h"
    ]
    turning = _MOMENT_AT[shape.moment_frame]
    sliding = _SLIDE_MOMENT_AT[shape.moment_frame]
    at = [sliding if slides else turning for slides in shape.slides]
    y, z, cut = np.array(at, int).reshape(-1, 3).T
    # A joint's own coordinates are the last of its block.
    own = starts[1:] - BLOCK
    return {
        "kind": np.array([_KIND[symbol] for symbol in symbols]),
        "less": less,
        "starts": starts,
        "moment_y": own + y,
        "moment_z": own + z,
        "moment_cut": own + cut,
    }
