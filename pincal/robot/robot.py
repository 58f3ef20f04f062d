"""A serial arm, or a tree of arms, read by Pinocchio from a URDF, with Denavit-Hartenberg frames
and masses.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pincal.errors import BadInputError, nearest_first
from pincal.robot.arm_of_tree import TreeRequest, arm_model, arm_of_tree, path_between
from pincal.robot.closure import Closure, Linkage
from pincal.robot.dh import DhFrames
from pincal.robot.kinematics import Kinematics
from pincal.robot.link_path import LinkPath, above
from pincal.robot.robot_numbers import OF_ROBOT
from pincal.robot.tree import Coupling, Mimic, UrdfTree, mimicked, numbered
from pincal.robot.urdf_file import find_file, parse_urdf, read_urdf, written_by_yourdfpy
from pincal.units import real_array

if TYPE_CHECKING:
    import pinocchio as pin
    import yourdfpy


@dataclass(frozen=True, repr=False)
class Robot:
    """The moving joints between links of a URDF, a serial arm or a tree of arms; everything else is
    locked.

    Attributes:
        name: name of the robot in the URDF.
        joint_names: the n moving joints, each after the one that carries it; of a serial arm from
            base to tip.
        joint_types: "revolute" (including continuous) or "prismatic", one per joint.
        lower: shape (n,), joint limits [rad or m], -inf where there is none.
        upper: shape (n,), likewise, +inf.
        base: name of the base link, on which the tree stands.
        tip: name of the tip link, at the end of the path.
        frames: Denavit-Hartenberg frames at q = 0 in the base frame.
        T_link_joint: shape (n, 4, 4), the URDF's joint frame i in the link frame S_i; both move
            with joint i.
        masses: shape (n,), mass of link i [kg]: all that moves with joint i but not with a joint
            that it carries; guessed from the shape of the arm if the URDF has none.
        centres: shape (n, 3), its centre of mass in the link frame S_i [m]; likewise.
        massless: names of the links of the arm without a mass in the URDF, or with a placeholder,
            such as one mass for all links.
        gravity: shape (3,), gravity in the base frame [m/s^2]: along -z of the URDF's root link.
        notes: locked joints, and the interpretation of ambiguous parts of the URDF.
        urdf: the URDF's text.
        source: the origin of the URDF, for messages.
        mimics: the mimic joints of the arm, whose limits are imposed on their sources.
        couplings: the joints whose controller reports a combination of positions. Tables, arrays
            and commands contain the reported positions, all other parts of the library the URDF's.
        parents: the joint that carries each joint, -1 for the base; default: each carries the next.
        ends: the links between which readings are taken by default; default: base and tip.
        unmeasured: names of joints off all paths, whose motion only changes the loads of the
            others.
        links: the pairs of links of further paths, by name.
        closures: the loop closures.
        passive: names of the joints whose positions follow from the loops.
    """

    name: str
    joint_names: tuple[str, ...]
    joint_types: tuple[str, ...]
    lower: np.ndarray
    upper: np.ndarray
    base: str
    tip: str
    frames: DhFrames
    T_link_joint: np.ndarray
    masses: np.ndarray
    centres: np.ndarray
    massless: tuple[str, ...]
    gravity: np.ndarray
    notes: tuple[str, ...]
    urdf: bytes
    source: str
    mimics: tuple[Mimic, ...] = ()
    couplings: tuple[Coupling, ...] = ()
    parents: tuple[int, ...] = ()
    ends: LinkPath | None = None
    unmeasured: tuple[str, ...] = ()
    links: tuple[tuple[str, str], ...] = ()
    closures: tuple[Closure, ...] = ()
    passive: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.parents:
            object.__setattr__(self, "parents", tuple(range(-1, len(self.joint_names) - 1)))

    @cached_property
    def path(self) -> LinkPath:
        """The path between the links of readings by default."""
        whole = LinkPath(
            self.base, self.tip, -1, self.n_joints - 1, np.eye(4), self.frames.T_last_tip
        )
        return whole if self.ends is None else self.ends

    def __repr__(self) -> str:
        return f"Robot({self.name!r}: {self.n_joints} joints from {self.path.start} to {self.tip})"

    @classmethod
    def from_urdf(
        cls,
        source: str | os.PathLike[str] | bytes | yourdfpy.URDF,
        *,
        tip: str | None = None,
        base: str | None = None,
        start: str | None = None,
        paths: Sequence[tuple[str, str]] = (),
        joints: Sequence[str] | None = None,
        others: Sequence[str] = (),
        xacro_args: Mapping[str, str] | None = None,
        mass: float | None = None,
    ) -> Robot:
        """Load an arm, or a tree of arms, from a URDF.

        Joints off all paths are locked at their neutral position.

        Args:
            source: path of a URDF or xacro file, the name of a robot of example-robot-data
                ("ur10"), the URDF's text as bytes, or a ``yourdfpy.URDF``, as the text that
                yourdfpy writes of it (without comments and tags that it does not know).
            tip: link at the end of the arm; default: the end of the chain of ``joints``, or of the
                longest moving chain without its gripper.
            base: link on which the robot stands; default: the root of the URDF, or the parent of
                the first of ``joints`` if other moving joints precede it.
            start: link relative to which readings are taken, such as a camera's; default: the base.
            paths: further pairs of links between which readings are taken, by name.
            joints: names of the joints of the arm (the columns of a table of measurements).
            others: names of further moving joints that change the loads on the joints of the paths.
            xacro_args: values of the arguments of a xacro file, such as ``{"ur_type": "ur5e"}``.
            mass: mass of the whole robot with its base, as on its data sheet [kg]; the masses of
                the links are then guessed from the shape of the arm and estimated by a calibration,
                and the URDF's are ignored. Default: the URDF's masses, or if it has none, typical
                ones of industrial arms of this size.

        Raises:
            BadInputError: for an invalid mass.
            RobotFileError: if the URDF can't be read, is not a tree, lacks a link or has no moving
                joint on the path.

        Example:
            >>> robot = Robot.from_urdf("ur10", tip="tool0")
            >>> robot.joint_names[:2]
            ('shoulder_pan_joint', 'shoulder_lift_joint')
        """
        if isinstance(text := written_by_yourdfpy(source), bytes):
            tree = parse_urdf(text)
        else:
            tree = read_urdf(find_file(text), xacro_args=xacro_args)
        return cls.from_tree(
            tree, TreeRequest(tip, start, base, joints, tuple(paths), tuple(others)), mass=mass
        )

    @classmethod
    def from_tree(cls, tree: UrdfTree, wanted: TreeRequest, *, mass: float | None = None) -> Robot:
        """Take a robot from a URDF that has been read; see :meth:`from_urdf`."""
        return cls(**arm_of_tree(tree, wanted, mass=mass))

    @property
    def request(self) -> TreeRequest:
        """The part of the URDF that it is."""
        own = [self.joint_names[i] for i in self.own_joints] if self.passive else None
        return TreeRequest(
            self.tip, self.path.start, self.base, own, paths=self.links, others=self.joint_names
        )

    def between(
        self, start: str | None = None, tip: str | None = None, *, at_rest: bool = False
    ) -> LinkPath:
        """Return the path between two links of the robot.

        Args:
            start: the link relative to which a reading is taken; default: the start of the robot's
                own path.
            tip: the measured link; default: the end of the robot's own path.
            at_rest: whether locked joints may be on the path.

        Raises:
            RobotFileError: for an unknown link, or a locked joint on the path that is not allowed.
        """
        key = start or self.path.start, tip or self.path.tip, at_rest
        if key not in self._ways:
            tree = parse_urdf(self.urdf, source=self.source)
            way = path_between(tree, self.joint_names, self.base, *key[:2], at_rest=at_rest)
            self._ways[key] = way.on_links(self.T_link_joint)
        return self._ways[key]

    @cached_property
    def _ways(self) -> dict[tuple[str, str, bool], LinkPath]:
        """Cached paths between its links, as each but its own requires reading the URDF."""
        return {(self.path.start, self.path.tip, at_rest): self.path for at_rest in (False, True)}

    @property
    def n_joints(self) -> int:
        """Number of moving joints."""
        return len(self.joint_names)

    @property
    def measured_joints(self) -> tuple[str, ...]:
        """Names of the joints on any path, on which readings can depend."""
        return tuple(name for name in self.joint_names if name not in self.unmeasured)

    @property
    def is_serial(self) -> bool:
        """Whether each joint carries the next."""
        return self.parents == tuple(range(-1, self.n_joints - 1))

    def joints_between(self, start: str | None = None, tip: str | None = None) -> tuple[str, ...]:
        """Return the names of the joints on the path between two links, with dependent joints
        replaced by their sources.
        """
        names = [
            self.joint_names[joint] for joint, _ in self.between(start, tip).steps(self.parents)
        ]
        source = {mimic.joint: [mimic.source] for mimic in self.mimics}
        if self.linkage is not None:
            source |= {
                name: [self.joint_names[i] for i in self.linkage.drivers] for name in self.passive
            }
        return tuple(dict.fromkeys(own for name in names for own in source.get(name, [name])))

    def next_joint(self, i: int) -> int | None:
        """Return the joint at the end of link i (from 0); None if it carries no joint,
        or several.
        """
        carried = [k for k, parent in enumerate(self.parents) if parent == i]
        return carried[0] if len(carried) == 1 else None

    def are_neighbours(self, joint: str, other: str) -> bool:
        """Return whether two joints are the same, or one carries the other directly."""
        i = self.joint_names.index(joint)
        k = self.joint_names.index(other)
        return i == k or self.parents[i] == k or self.parents[k] == i

    def carries(self, i: int, k: int) -> bool:
        """Return whether joint i carries joint k, directly or not."""
        return i in above(self.parents[k], self.parents)

    @cached_property
    def dependent(self) -> frozenset[str]:
        """Names of the joints without an independent position: mimic joints, and the passive ones
        of loops.
        """
        return frozenset(mimic.joint for mimic in self.mimics).union(self.passive)

    @cached_property
    def own_joints(self) -> np.ndarray:
        """Indices of the m independent joints, from the base; with loops in the order of the
        numbers in their names.
        """
        own = [name for name in self.joint_names if name not in self.dependent]
        return np.array(
            [self.joint_names.index(name) for name in (numbered(own) if self.passive else own)]
        )

    @cached_property
    def kinematics(self) -> Kinematics:
        """Its nominal kinematics."""
        return Kinematics.of(self.frames, self.joint_types, self.parents)

    @cached_property
    def linkage(self) -> Linkage | None:
        """Its loops; None if it has none."""
        if not self.closures:
            return None
        passive = np.array([self.joint_names.index(name) for name in self.passive])
        return Linkage(self.kinematics, self.closures, passive, self.lower, self.upper)

    def following(self, q: np.ndarray) -> np.ndarray:
        """Return joint positions, shape (N, n), with each dependent joint set from the independent
        ones.

        Loops are closed as nearly as possible, see :meth:`pincal.robot.closure.Linkage.can_take`.
        """
        if not self.dependent:
            return q
        out = mimicked(q, self.joint_names, self.mimics)
        return out if self.linkage is None else self.linkage.closed(out)[0]

    def spread(self, own: np.ndarray) -> np.ndarray:
        """Return the positions of all joints, shape (N, n), from the independent ones, shape (N,
        m).
        """
        if not self.dependent:
            return own
        q = np.zeros((len(own), self.n_joints))
        q[:, self.own_joints] = own
        return self.following(q)

    def gathered(self, J: np.ndarray, q: np.ndarray | None = None) -> np.ndarray:
        """Return derivatives by the independent joints, shape (..., m), from those by all joints,
        shape (..., n).

        Joint positions q, shape (N, n), are needed for J of shape (N, ..., n) without the motion of
        passive joints of loops.
        """
        if not self.dependent:
            return J
        moves = np.eye(self.n_joints)
        index = self.joint_names.index
        for mimic in self.mimics:
            moves[index(mimic.joint)] = mimic.multiplier * moves[index(mimic.source)]
        if q is None or self.linkage is None:
            return np.asarray(J @ moves[:, self.own_joints])
        linkage = self.linkage
        whole = np.tile(moves, (len(q), 1, 1))
        whole[:, linkage.passive] = linkage.rates(q) @ moves[linkage.drivers]
        return np.asarray(J @ whole[..., self.own_joints])

    def with_couplings(self, *couplings: Coupling | str) -> Robot:
        """Return the robot with joints whose controller reports a combination of positions.

        Args:
            couplings: objects or text: ``joint_3=+joint_2`` if the position of joint 3 is the sum
                of the reported positions of joints 3 and 2, ``joint_5=-1/3*joint_4``.

        Raises:
            BadInputError: for an unknown joint or a mimic joint, or couplings that do not determine
                all positions.

        Example:
            >>> robot = Robot.from_urdf("ur10").with_couplings("elbow_joint=-shoulder_lift_joint")
            >>> robot.from_reported(np.ones((1, 6)))[0, :3].tolist()
            [1.0, 1.0, 0.0]
        """
        given = [Coupling.of(one) if isinstance(one, str) else one for one in couplings]
        own = [self.joint_names[i] for i in self.own_joints]
        for name in (name for one in given for name in (one.joint, one.source) if name not in own):
            raise BadInputError(
                f"no joint {name!r} to couple; expected one of "
                f"{', '.join(nearest_first([name], own))}"
            )
        found = replace(self, couplings=(*self.couplings, *given))
        if abs(np.linalg.det(found.combination)) < OF_ROBOT.coupled:
            raise BadInputError(
                "the couplings do not determine the positions of the joints; expected "
                "other couplings"
            )
        return found

    @property
    def combination(self) -> np.ndarray:
        """Matrix from reported to joint positions, shape (n, n)."""
        out = np.eye(self.n_joints)
        index = self.joint_names.index
        for one in self.couplings:
            out[index(one.joint), index(one.source)] += one.factor
        return out

    def from_reported(self, q: np.ndarray) -> np.ndarray:
        """Return the positions of the URDF's joints, shape (N, n), from those reported by the
        controller.
        """
        return (
            self.following(np.asarray(q @ self.combination.T))
            if self.couplings or self.passive
            else q
        )

    def as_reported(self, q: np.ndarray) -> np.ndarray:
        """Return the positions reported by and commanded to the controller at the URDF's joint
        positions, shape (N, n).
        """
        own = np.asarray(q, float) @ np.linalg.inv(self.combination).T if self.couplings else q
        return self.following(own) if self.couplings else own

    @property
    def joint_units(self) -> tuple[str, ...]:
        """Units of the joint positions: "rad", or "m" for a prismatic joint."""
        return tuple("m" if kind == "prismatic" else "rad" for kind in self.joint_types)

    @property
    def unweighed(self) -> tuple[str, ...]:
        """Names of the joints that move the links without a known mass."""
        if not self.massless:
            return ()
        moves = {
            joint.name for joint in parse_urdf(self.urdf).joints if joint.child in self.massless
        }
        return tuple(name for name in self.joint_names if name in moves)

    @cached_property
    def reach(self) -> float:
        """Length of its path stretched out [m]: an upper bound on the distance from S_0
        to the tip.
        """
        on_path = [joint for joint, _ in self.path.steps(self.parents)]
        s = self.frames.parameters[on_path]
        farthest = np.maximum(np.abs(self.lower), np.abs(self.upper))
        travel = [
            farthest[i]
            for i in on_path
            if self.joint_types[i] == "prismatic" and farthest[i] < np.inf
        ]
        return float(
            np.hypot(s[:, 3], s[:, 4]).sum()
            + np.linalg.norm(self.frames.T_last_tip[:3, 3])
            + sum(travel)
        )

    def forward_kinematics(self, q: np.ndarray, path: LinkPath | None = None) -> np.ndarray:
        """Return the nominal tip by Pinocchio, shape (N, 4, 4), in the frame of the path's first
        link.

        Joint positions q have shape (N, n) [rad or m]; the default path is the robot's.
        """
        import pinocchio as pin

        model = self.pinocchio_model()
        path = path or self.path
        data = model.createData()
        base, frame = (model.getFrameId(link, pin.BODY) for link in (path.start, path.tip))
        out = np.empty((len(q), 4, 4))
        for i, row in enumerate(self.configurations(model, real_array(q, "joint positions"))):
            pin.framesForwardKinematics(model, data, row)
            out[i] = (data.oMf[base].inverse() * data.oMf[frame]).homogeneous
        return out

    def pinocchio_model(self) -> pin.Model:
        """Return the nominal ``pin.Model`` of the arm, with all other joints locked."""
        return arm_model(self.urdf, self.joint_names, self.source)

    def configuration(self, model: pin.Model, q: np.ndarray) -> np.ndarray:
        """Return Pinocchio's configuration vector of ``model`` for joint positions ``q``, shape
        (n,).

        Pinocchio's vector contains (cos q, sin q) for a continuous joint.
        """
        return np.asarray(self.configurations(model, np.asarray(q)[None])[0])

    def configurations(self, model: pin.Model, q: np.ndarray) -> np.ndarray:
        """Return :meth:`configuration` of each of N poses: joint positions of shape (N, n),
        vectors of shape (N, nq).
        """
        out = np.empty((len(q), model.nq))
        for name, values in zip(self.joint_names, q.T, strict=True):
            joint = model.joints[model.getJointId(name)]
            if joint.nq == 1:
                out[:, joint.idx_q] = values
            else:
                out[:, joint.idx_q] = np.cos(values)
                out[:, joint.idx_q + 1] = np.sin(values)
        return out

    def joint_range(self, span: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Return lower and upper ends of a fraction ``span`` of the joints' ranges, shape (n,) each
        [rad or m].

        The ranges are centred; joints without limits have +-pi.
        """
        lower = np.where(np.isfinite(self.lower), self.lower, -np.pi)
        upper = np.where(np.isfinite(self.upper), self.upper, np.pi)
        if span == 1.0:
            return lower, upper
        middle = 0.5 * (lower + upper)
        half = 0.5 * span * (upper - lower)
        return middle - half, middle + half

    def random_configurations(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw joint positions, shape (n, n_joints), uniform within the limits (+-pi without
        limits).

        Loops are closed, with the passive joints within their limits.
        """
        found = self.following(np.asarray(rng.uniform(*self.joint_range(), (n, self.n_joints))))
        while self.linkage is not None and not (is_there := self.linkage.can_take(found)).all():
            found[~is_there] = self.following(
                rng.uniform(*self.joint_range(), (int(np.sum(~is_there)), self.n_joints))
            )
        return found
