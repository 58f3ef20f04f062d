"""A serial arm as Pinocchio reads it from a URDF, with its Denavit-Hartenberg frames and the masses it carries."""

from __future__ import annotations

import os
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pincal.errors import BadInputError, PincalWarning, RobotFileError, nearest_first
from pincal.robot.dh import DhFrames, dh_frames
from pincal.robot.inertia import are_placeholders, guessed_masses
from pincal.robot.tree import MOVING_TYPES, Mimic, UrdfJoint, UrdfTree
from pincal.robot.urdf import arm_text, parse_urdf, read_urdf, robot_name
from pincal.units import LARGEST

if TYPE_CHECKING:
    import pinocchio as pin

# A limit beyond this [rad or m] is how URDFs write "none".
_NO_LIMIT = 1e3
# Mass of a robot [kg] below which grams were not meant, but nothing at all.
_LIGHTEST = 1e-3
# No serial arm has more joints that move; memory and time grow with their cube.
_MOST_JOINTS = 50


@dataclass(frozen=True, repr=False)
class Robot:
    """A serial arm from a base link to a tip link; everything else of the URDF is locked in place.

    Attributes:
        name: name of the robot in the URDF.
        joint_names: the n moving joints from base to tip.
        joint_types: "revolute" (continuous ones too) or "prismatic", one a joint.
        lower: shape (n,), joint limits [rad or m], -inf where there is none.
        upper: shape (n,), likewise, +inf.
        base: name of the base link.
        tip: name of the tip link.
        frames: Denavit-Hartenberg frames at q = 0 in the base frame.
        T_link_joint: shape (n, 4, 4), the URDF's joint frame i in the link frame S_i; both move with joint i.
        masses: shape (n,), mass of link i [kg]: all that moves with joint i but not with joint i+1; guessed from the shape
            of the arm where the URDF does not tell.
        centres: shape (n, 3), its centre of mass in the link frame S_i [m]; likewise.
        massless: names of the links on the arm for which the URDF has no mass, or only a placeholder, as one that all have.
        gravity: shape (3,), gravity in the base frame [m/s^2]: along -z of the URDF's root link.
        notes: what was locked, and what of the URDF was read in one of two ways, in words.
        urdf: the URDF's text as it was read.
        source: where the URDF came from.
        mimics: the joints that follow another one of the arm; that one's limits keep theirs.
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

    def __repr__(self) -> str:
        return f"Robot({self.name!r}: {self.n_joints} joints from {self.base} to {self.tip})"

    @classmethod
    def from_urdf(
        cls,
        source: str | os.PathLike[str] | bytes,
        *,
        tip: str | None = None,
        base: str | None = None,
        joints: Sequence[str] | None = None,
        xacro_args: Mapping[str, str] | None = None,
        mass: float | None = None,
    ) -> Robot:
        """Load an arm from a URDF.

        Joints off the path from base to tip are locked at their neutral position.

        Args:
            source: path of a URDF or xacro file, the name of a robot of example-robot-data ("ur10"), or the URDF's text as
                bytes.
            tip: link at the end of the arm; default: the end of the chain of ``joints``, or of the longest moving chain
                without its gripper.
            base: link at its start; default: the root of the URDF, or the parent of the first of ``joints`` where other
                moving joints stand before it.
            joints: names of the joints that the arm consists of (the columns of a table of measurements).
            xacro_args: values of the arguments of a xacro file, such as ``{"ur_type": "ur5e"}``.
            mass: of the whole robot with its base, as on its data sheet [kg]; masses of the links are then guessed from the
                shape of the arm, and found by a calibration, whatever the URDF says. Default: those of the URDF; where it
                has none, masses as industrial arms of this size have them.

        Raises:
            BadInputError: if the mass is no mass.
            RobotFileError: if the URDF can't be read, is no tree, lacks a link or has no moving joint on the path.

        Example:
            >>> robot = Robot.from_urdf("ur10", tip="tool0")
            >>> robot.joint_names[:2]
            ('shoulder_pan_joint', 'shoulder_lift_joint')
        """
        tree = parse_urdf(source) if isinstance(source, bytes) else read_urdf(find_file(source), xacro_args=xacro_args)
        return cls.from_tree(tree, tip=tip, base=base, joints=joints, mass=mass)

    @classmethod
    def from_tree(
        cls,
        tree: UrdfTree,
        *,
        tip: str | None = None,
        base: str | None = None,
        joints: Sequence[str] | None = None,
        mass: float | None = None,
    ) -> Robot:
        """Take an arm from a URDF that has been read; see :meth:`from_urdf`."""
        tip = tree.default_tip(joints) if tip is None else tip
        base = _default_base(tree, tip, joints) if base is None else base
        path = _checked_path(tree, base, tip)
        if mass is not None and not _LIGHTEST <= mass <= LARGEST:
            raise BadInputError(f"mass of the robot is {mass} kg; expected {_LIGHTEST:g} to {LARGEST:g} kg")
        return _build(cls, tree, path, base, tip, mass=mass)

    @property
    def n_joints(self) -> int:
        """Number of moving joints."""
        return len(self.joint_names)

    @property
    def own_joints(self) -> np.ndarray:
        """Indices of the m joints that mimic none."""
        driven = {mimic.joint for mimic in self.mimics}
        return np.array([i for i, name in enumerate(self.joint_names) if name not in driven])

    def following(self, q: np.ndarray) -> np.ndarray:
        """Return joint positions, shape (N, n), with each joint that mimics another where that one puts it."""
        if not self.mimics:
            return q
        out, index = np.array(q, np.result_type(q, float)), self.joint_names.index
        for mimic in self.mimics:
            out[:, index(mimic.joint)] = mimic.multiplier * out[:, index(mimic.source)] + mimic.offset
        return out

    def spread(self, own: np.ndarray) -> np.ndarray:
        """Return the positions of all joints, shape (N, n), from those of the joints that mimic none, shape (N, m)."""
        if not self.mimics:
            return own
        q = np.zeros((len(own), self.n_joints))
        q[:, self.own_joints] = own
        return self.following(q)

    def gathered(self, J: np.ndarray) -> np.ndarray:
        """Return derivatives by the joints that mimic none, shape (..., m), from those by all joints, shape (..., n)."""
        if not self.mimics:
            return J
        moves = np.eye(self.n_joints)[:, self.own_joints]
        return np.asarray(J @ (self.following(moves.T) - self.following(0.0 * moves.T)).T)

    @property
    def joint_units(self) -> tuple[str, ...]:
        """Units of the joint positions: "rad", or "m" for a prismatic joint."""
        return tuple("m" if kind == "prismatic" else "rad" for kind in self.joint_types)

    @property
    def unweighed(self) -> tuple[str, ...]:
        """Names of the joints that move the links without a mass that is known."""
        if not self.massless:
            return ()
        path = parse_urdf(self.urdf).path(self.base, self.tip)
        return tuple(joint.name for joint in path if joint.child in self.massless and joint.name in self.joint_names)

    @property
    def reach(self) -> float:
        """Length of the arm stretched out [m]: an upper bound on the distance from S_0 to the tip."""
        s = self.frames.parameters
        farthest = np.maximum(np.abs(self.lower), np.abs(self.upper))
        travel = [far for far, kind in zip(farthest, self.joint_types, strict=True) if kind == "prismatic" and far < np.inf]
        return float(np.hypot(s[:, 3], s[:, 4]).sum() + np.linalg.norm(self.frames.T_last_tip[:3, 3]) + sum(travel))

    def forward_kinematics(self, q: np.ndarray) -> np.ndarray:
        """Return the nominal tip in the base frame by Pinocchio, shape (N, 4, 4), for ``q`` [rad or m], shape (N, n)."""
        import pinocchio as pin

        model = self.pinocchio_model()
        data = model.createData()
        frame = model.getFrameId(self.tip, pin.BODY)
        base = model.getFrameId(self.base, pin.BODY)
        out = np.empty((len(q), 4, 4))
        for i, row in enumerate(np.asarray(q, float)):
            pin.framesForwardKinematics(model, data, self.configuration(model, row))
            out[i] = (data.oMf[base].inverse() * data.oMf[frame]).homogeneous
        return out

    def pinocchio_model(self) -> pin.Model:
        """Return the nominal ``pin.Model`` of the arm, everything off the path locked."""
        return _arm_model(self.urdf, self.joint_names, self.source)

    def configuration(self, model: pin.Model, q: np.ndarray) -> np.ndarray:
        """Return Pinocchio's configuration vector of ``model`` for joint positions ``q``, shape (n,).

        A continuous joint stands in Pinocchio's vector as (cos q, sin q).
        """
        out = np.empty(model.nq)
        for name, value in zip(self.joint_names, q, strict=True):
            joint = model.joints[model.getJointId(name)]
            out[joint.idx_q : joint.idx_q + joint.nq] = value if joint.nq == 1 else (np.cos(value), np.sin(value))
        return out

    def joint_range(self, span: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Return the ends of a part ``span`` of the joints' ranges, about their middles; +-pi where there are no limits.

        Returns:
            Least and largest positions, shape (n_joints,) each [rad or m].
        """
        lower = np.where(np.isfinite(self.lower), self.lower, -np.pi)
        upper = np.where(np.isfinite(self.upper), self.upper, np.pi)
        if span == 1.0:
            return lower, upper
        middle, half = 0.5 * (lower + upper), 0.5 * span * (upper - lower)
        return middle - half, middle + half

    def random_configurations(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw joint positions, shape (n, n_joints), uniform within the limits (within +-pi where there are none)."""
        return self.following(np.asarray(rng.uniform(*self.joint_range(), (n, self.n_joints))))


def find_file(source: str | os.PathLike[str]) -> Path:
    """Return the path of a URDF given by path or by its name in example-robot-data.

    Raises:
        RobotFileError: for a name that is neither.
    """
    path = Path(source)
    # A folder of a robot's name, such as that of its results, is no URDF.
    if path.is_file() or path.suffix or os.sep in os.fspath(source):
        return path
    from example_robot_data import robots_loader

    loaders = robots_loader.ROBOTS
    if path.name not in loaders:
        raise RobotFileError(
            f"{path.name!r} is neither a file nor a robot of example-robot-data; "
            f"expected a path to a URDF or a name like {', '.join(nearest_first([path.name], sorted(loaders))[:12])}"
        )
    loader: Any = loaders[path.name]
    if not loader.urdf_filename:
        raise RobotFileError(f"example-robot-data has no URDF for {path.name!r}; give the path of one")
    inside = Path(str(loader.path), str(loader.urdf_subpath), str(loader.urdf_filename))
    folder: str = robots_loader.getModelPath(inside.as_posix())
    return _of_this_name(path.name, Path(folder, inside), known=loaders)


def _of_this_name(name: str, file: Path, known: Collection[str]) -> Path:
    """Return the file of a robot, another one beside it where this one calls itself by the name of another known robot.

    The table of example-robot-data mixes some up: its "ur3" is the file of a UR5.

    Raises:
        RobotFileError: if there is no other.
    """
    found = robot_name(file)
    # A variant, such as "panda_collision", has the name of its robot.
    if found is None or found not in known or name.startswith(found):
        return file
    told = f"example-robot-data has {file.name} under the name {name!r}, whose robot is called {found!r}"
    other = file.with_name(file.name.replace(found, name))
    if robot_name(other) != name:
        near = ", ".join(nearest_first([name], sorted(one for one in known if one != name))[:12])
        raise RobotFileError(f"{told}; expected {name!r}: give the path of its URDF, or another name, such as {near}")
    warnings.warn(f"{told}; {other.name} beside it is read instead", PincalWarning, stacklevel=4)
    return other


def _default_base(tree: UrdfTree, tip: str, joints: Sequence[str] | None) -> str:
    """Return the root, or the link behind the moving joints that stand before the first of ``joints``."""
    moving = [joint for joint in tree.path(tree.root, tip) if joint.kind in MOVING_TYPES]
    if joints is None or not moving or moving[0].name in joints:
        return tree.root
    return next((joint.parent for joint in moving if joint.name in joints), tree.root)


def _checked_path(tree: UrdfTree, base: str, tip: str) -> tuple[UrdfJoint, ...]:
    """Return all joints from base to tip, fixed ones too."""
    path = tree.path(base, tip)
    moving = [joint for joint in path if joint.kind in MOVING_TYPES]
    for joint in path:
        if joint.kind not in (*MOVING_TYPES, "fixed"):
            where = f"{tree.source}: joint {joint.name!r} between {base!r} and {tip!r}"
            expected = "expected revolute, continuous, prismatic or fixed joints: choose another base or tip"
            raise RobotFileError(f"{where} is {joint.kind}; {expected}")
    if not moving:
        raise RobotFileError(f"{tree.source}: no moving joint between {base!r} and {tip!r}; choose another tip")
    if len(moving) > _MOST_JOINTS:
        raise RobotFileError(
            f"{tree.source}: {len(moving)} moving joints between {base!r} and {tip!r}; expected at most {_MOST_JOINTS}: "
            "choose another base or tip"
        )
    tree.refuse_loops(path)
    return path


def _arm_model(urdf: bytes, joint_names: tuple[str, ...], source: str) -> pin.Model:
    """Build the model from text of any encoding; what Pinocchio can't do with it is passed on in words."""
    import pinocchio as pin

    try:
        return pin.buildModelFromXML(arm_text(urdf, joint_names, source))
    except (ValueError, RuntimeError) as error:
        raise RobotFileError(f"{source}: Pinocchio can't read this URDF: {error}") from None


def _build(
    cls: type[Robot], tree: UrdfTree, path: tuple[UrdfJoint, ...], base: str, tip: str, *, mass: float | None
) -> Robot:
    import pinocchio as pin

    mimics = tree.mimics(path)
    path = tuple(joint for joint in path if joint.kind in MOVING_TYPES)
    names = tuple(joint.name for joint in path)
    model = _arm_model(tree.text, names, tree.source)
    data = model.createData()
    ids = [model.getJointId(name) for name in names]
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    T_base_world = data.oMf[model.getFrameId(base, pin.BODY)].inverse()
    joints = np.array([(T_base_world * data.oMi[i]).homogeneous for i in ids])
    axes = np.einsum("nij,nj->ni", joints[:, :3, :3], _local_axes(model, data, ids))
    frames = dh_frames(joints[:, :3, 3], axes, (T_base_world * data.oMf[model.getFrameId(tip, pin.BODY)]).homogeneous)
    T_link_joint = np.linalg.inv(frames.T_base_link) @ joints
    levers = np.array([model.inertias[i].lever for i in ids])
    centres = np.einsum("nij,nj->ni", T_link_joint[:, :3, :3], levers) + T_link_joint[:, :3, 3]
    masses = np.array([model.inertias[i].mass for i in ids])
    unknown = (masses <= 0.0) | are_placeholders(masses.tolist()) | (mass is not None)
    if unknown.any():
        tip_at = (frames.T_base_link[-1] @ frames.T_last_tip)[:3, 3]
        masses, middles = guessed_masses(masses, np.vstack([joints[:, :3, 3], tip_at]), unknown, total=mass)
        middles = np.einsum("nji,nj->ni", frames.T_base_link[:, :3, :3], middles - frames.T_base_link[:, :3, 3])
        centres = np.where(unknown[:, None], middles, centres)
    places = [model.joints[i].idx_q for i in ids]
    lower, upper = model.lowerPositionLimit[places], model.upperPositionLimit[places]
    turns = np.array([joint.kind == "continuous" for joint in path])
    bounded = ~turns & (upper > lower) & (upper - lower < _NO_LIMIT)
    limits = np.where(bounded, lower, -np.inf), np.where(bounded, upper, np.inf)
    limits = _with_mimics(*limits, names=names, mimics=mimics)
    return cls(
        name=tree.name,
        joint_names=names,
        joint_types=tuple("prismatic" if joint.kind == "prismatic" else "revolute" for joint in path),
        lower=limits[0],
        upper=limits[1],
        base=base,
        tip=tip,
        frames=frames,
        T_link_joint=T_link_joint,
        masses=masses,
        centres=centres,
        massless=tuple(joint.child for joint, is_unknown in zip(path, unknown, strict=True) if is_unknown),
        gravity=T_base_world.rotation @ model.gravity.linear,
        notes=_notes(tree, names, base, tip),
        urdf=tree.text,
        source=tree.source,
        mimics=mimics,
    )


def _local_axes(model: pin.Model, data: pin.Data, ids: list[int]) -> np.ndarray:
    """Return the unit axes of the joints in their own frames, shape (n, 3), whatever Pinocchio's type of joint."""
    import pinocchio as pin

    pin.computeJointJacobians(model, data, pin.neutral(model))
    axes = []
    for i in ids:
        column = np.reshape(pin.getJointJacobian(model, data, i, pin.LOCAL), (6, -1))[:, model.joints[i].idx_v]
        axes.append(column[3:] if np.any(column[3:]) else column[:3])
    return np.array(axes)


def _with_mimics(
    lower: np.ndarray, upper: np.ndarray, *, names: tuple[str, ...], mimics: tuple[Mimic, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return limits, shape (n,) each, within which the joints that follow others keep their own limits, too."""
    low, high = lower.copy(), upper.copy()
    for mimic in mimics:
        i, k = names.index(mimic.joint), names.index(mimic.source)
        if mimic.multiplier:
            ends = np.sort((np.array([lower[i], upper[i]]) - mimic.offset) / mimic.multiplier)
            if max(low[k], ends[0]) < min(high[k], ends[1]):
                low[k], high[k] = max(low[k], ends[0]), min(high[k], ends[1])
    for mimic in mimics:
        i, k = names.index(mimic.joint), names.index(mimic.source)
        if mimic.multiplier:
            low[i], high[i] = np.sort(mimic.multiplier * np.array([low[k], high[k]]) + mimic.offset)
    return low, high


def _notes(tree: UrdfTree, names: tuple[str, ...], base: str, tip: str) -> tuple[str, ...]:
    """Return what the user should know of how the arm was read; it is also warned of."""
    locked = [joint for joint in tree.joints if joint.kind != "fixed" and joint.name not in names]
    notes = tree.notes
    if locked:
        more = f" and {len(locked) - 6} more" if len(locked) > 6 else ""
        shown = ", ".join(joint.name for joint in locked[:6]) + more
        notes += (f"{len(locked)} joints off the path from {base} to {tip} are locked at their neutral position: {shown}",)
    for note in notes:
        warnings.warn(f"{tree.source}: {note}", PincalWarning, stacklevel=5)
    return notes
