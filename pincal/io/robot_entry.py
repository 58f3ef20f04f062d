"""The robot in a ``model.json``: joints, frames, limits, masses, paths and loops as records."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
import numpy as np

from pincal.io.arrays import (
    ArrayShape,
    BranchTransforms,
    LimitNumbers,
    Matrix,
    Numbers,
    Record,
    Transform,
    Transforms,
    Vector,
    shaped,
)
from pincal.io.strict_json import Fault
from pincal.robot.closure import Closure
from pincal.robot.dh import DhFrames
from pincal.robot.link_path import LinkPath
from pincal.robot.robot import Robot
from pincal.robot.tree import Coupling, Mimic


class FramesEntry(Record, frozen=True, kw_only=True):
    """The Denavit-Hartenberg frames of a robot, see :class:`pincal.robot.dh.DhFrames`."""

    T_base_first: Transform
    parameters: Annotated[Matrix, ArrayShape("joints", 6)]
    T_base_link: Transforms
    T_last_tip: Transform
    branches: Annotated[tuple[int, ...], ArrayShape("branches")] = ()
    T_branch_first: Annotated[BranchTransforms | None, ArrayShape("branches", 4, 4)] = None

    @classmethod
    def of_frames(cls, frames: DhFrames) -> FramesEntry:
        """Return the entry of frames."""
        return cls.like(frames, T_branch_first=frames.T_branch_first if frames.branches else None)

    def frames(self) -> DhFrames:
        """Return the frames."""
        found = msgspec.structs.asdict(self)
        return DhFrames(
            **found | ({} if self.branches else {"T_branch_first": np.zeros((0, 4, 4))})
        )


class PathEntry(Record, frozen=True, kw_only=True):
    """The path between the two links of readings, see :class:`pincal.robot.link_path.LinkPath`."""

    start: str
    tip: str
    start_joint: int
    tip_joint: int
    T_joint_start: Transform
    T_joint_tip: Transform

    @classmethod
    def of_path(cls, path: LinkPath | None) -> PathEntry | None:
        """Return the entry of a path."""
        return None if path is None else cls.like(path)

    def path(self, n_joints: int, key: str) -> LinkPath:
        """Return the path in a robot of n joints; raise a Fault at ``key`` for other joints."""
        if not all(-1 <= joint < n_joints for joint in (self.start_joint, self.tip_joint)):
            raise Fault(
                "refers to joints that do not exist", f"numbers from -1 to {n_joints - 1}", key=key
            )
        return LinkPath(**msgspec.structs.asdict(self))


class ClosureEntry(Record, frozen=True, kw_only=True):
    """The closure of a loop, see :class:`pincal.robot.closure.Closure`."""

    name: str
    kind: Literal["point", "axis", "pose"]
    path: PathEntry
    rows: tuple[int, ...]

    def closure(self, n_joints: int, key: str) -> Closure:
        """Return the closure in a robot of n joints; raise a Fault below ``key`` for other joints
        or equations.
        """
        found = Closure(self.name, self.kind, self.path.path(n_joints, f"{key}.path"), self.rows)
        if not self.rows or not set(self.rows) <= set(range(found.size)):
            raise Fault(
                "are not equations", f"numbers from 0 to {found.size - 1}", key=f"{key}.rows"
            )
        return found


class RobotEntry(Record, frozen=True, kw_only=True):
    """A robot, see :class:`pincal.robot.robot.Robot`; the text of its URDF may be missing.

    Attributes:
        lower, upper: shape (n,), joint limits [rad or m]; null for none.
    """

    name: str
    joint_names: Annotated[tuple[str, ...], ArrayShape("joints"), msgspec.Meta(max_length=200)]
    joint_types: Annotated[tuple[Literal["revolute", "prismatic"], ...], ArrayShape("joints")]
    lower: Annotated[LimitNumbers, ArrayShape("joints", null=-np.inf)]
    upper: Annotated[LimitNumbers, ArrayShape("joints", null=np.inf)]
    base: str
    tip: str
    frames: FramesEntry
    T_link_joint: Transforms
    masses: Annotated[Numbers, ArrayShape("joints")]
    centres: Annotated[Matrix, ArrayShape("joints", 3)]
    massless: tuple[str, ...]
    gravity: Vector
    notes: tuple[str, ...]
    source: str
    urdf: str | None = None
    mimics: tuple[Mimic, ...] = ()
    couplings: tuple[Coupling, ...] = ()
    parents: tuple[int, ...] = ()
    ends: PathEntry | None = None
    unmeasured: tuple[str, ...] = ()
    links: tuple[tuple[str, str], ...] = ()
    closures: tuple[ClosureEntry, ...] = ()
    passive: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.joint_names:
            raise Fault("has no entries", "at least one joint", key=".joint_names")
        self._check_tree()
        self._check_dependent()
        shaped(
            ".frames.T_base_link",
            self.frames.T_base_link,
            ArrayShape(len(self.joint_names), 4, 4),
            {},
        )
        try:
            self.urdf_bytes()
        except UnicodeEncodeError as error:
            raise Fault(
                f"is not text ({error.reason})", "the text of a URDF, or null", key=".urdf"
            ) from None

    def _check_dependent(self) -> None:
        """Refuse mimic, coupled and passive joints that the arm does not have."""
        own = set(self.joint_names)
        free = own - {mimic.joint for mimic in self.mimics}
        for k, mimic in enumerate(self.mimics):
            if mimic.joint not in own or mimic.source not in free:
                raise Fault(
                    "names other joints",
                    "a joint of the arm that follows another of its own",
                    key=f".mimics[{k}]",
                )
        for k, one in enumerate(self.couplings):
            if {one.joint, one.source} - own or one.joint == one.source:
                raise Fault("names other joints", "two of the arm's", key=f".couplings[{k}]")
        rows = sum(len(closure.rows) for closure in self.closures)
        if len(set(self.passive) & free) != rows or len(self.passive) != rows:
            raise Fault(
                "do not fit the loops",
                f"{rows} joints, one for each equation of the closures",
                key=".passive",
            )

    def _check_tree(self) -> None:
        """Refuse joints that are not carried by the base or an earlier joint, and wrong
        branches.
        """
        n = len(self.joint_names)
        branches = self.frames.branches
        parents = self.parents or tuple(range(-1, n - 1))
        if len(parents) != n or any(not -1 <= parent < i for i, parent in enumerate(parents)):
            raise Fault(
                "form no tree of the joints",
                "for each joint an earlier one, or -1 for the base",
                key=".parents",
            )
        following = dict(zip(reversed(parents), reversed(range(n)), strict=True))
        if list(branches) != [i for i, parent in enumerate(parents) if following[parent] != i]:
            raise Fault(
                "do not fit the tree",
                "the joints that are not the first on their link",
                key=".frames.branches",
            )
        if (self.frames.T_branch_first is None) != (not branches):
            raise Fault(
                "do not fit the branches",
                "a transform for each branch",
                key=".frames.T_branch_first",
            )

    def urdf_bytes(self) -> bytes:
        """Return the original bytes of the URDF; those that are not UTF-8 are escaped
        in the file.
        """
        return (self.urdf or "").encode("utf-8", "surrogateescape")

    @classmethod
    def of_robot(cls, robot: Robot) -> RobotEntry:
        """Return the entry of a robot."""
        urdf = robot.urdf.decode("utf-8", "surrogateescape")
        parents = () if robot.is_serial else robot.parents
        ends = PathEntry.of_path(robot.ends)
        frames = FramesEntry.of_frames(robot.frames)
        closures = tuple(
            ClosureEntry.like(one, path=PathEntry.like(one.path)) for one in robot.closures
        )
        return cls.like(
            robot, frames=frames, urdf=urdf, parents=parents, ends=ends, closures=closures
        )

    def robot(self) -> Robot:
        """Return the robot."""
        n = len(self.joint_names)
        ends = None if self.ends is None else self.ends.path(n, ".ends")
        closures = tuple(one.closure(n, f".closures[{k}]") for k, one in enumerate(self.closures))
        made = {
            "frames": self.frames.frames(),
            "urdf": self.urdf_bytes(),
            "ends": ends,
            "closures": closures,
        }
        return Robot(**msgspec.structs.asdict(self) | made)
