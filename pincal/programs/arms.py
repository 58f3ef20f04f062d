"""The arm configuration in which a controller reaches a pose: the posture that the program
specifies, else the nearest one.

The flags of a program describe the shape of the arm, whatever each manufacturer calls them: on
which side of axis 1 the wrist is, whether the elbow is up or down, to which side the wrist is bent.
They change only at singularities.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from pincal.compensate.ik_problem import IkProblem
from pincal.compensate.iterations import newton
from pincal.errors import BadInputError
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.model import Model
from pincal.programs.program import Posture, Turn
from pincal.programs.program_numbers import PROGRAM_NUMBERS
from pincal.robot.robot import Robot
from pincal.thresholds import Count, Scale
from pincal.units import plain_number

# Random configurations among which starts of the search are chosen; starts where the posture is
# known, and where it is not.
_POOL: Count = 30_000
_STARTS: Count = 12
_MORE_STARTS: Count = 64
# Configurations at which it is tried whether axes meet, and the distance at which they do [m].
_TRIED: Count = 8
_MEETING: Scale = 1e-6
# A solution in the posture that the arm has, nearer than this, is the nearest one [rad].
_CLOSE: Scale = 0.5
# Solutions that differ by less are the same [rad or m].
_SAME: Scale = 1e-5
# Poses searched for at once.
_PIECE: Count = 64
_TURN: Scale = 2.0 * np.pi


@dataclass(frozen=True)
class ProgramAxes:
    """The axes of a program as functions of the joints of the URDF: axes = matrix joints + zeros.

    Attributes:
        matrix: shape (n, n).
        zeros: shape (n,), axes with all joints at zero [rad or m].
    """

    matrix: np.ndarray
    zeros: np.ndarray

    @classmethod
    def parse(cls, text: str | None, robot: Robot) -> ProgramAxes:
        """Return the axes of a text, each a sum of joints and degrees, such as ``q1, -q2+90,
        q3-q2``.

        The joints of the text are those reported by the controller; without a text they are the
        axes.

        Raises:
            BadInputError: for any other text, or axes that do not determine the joints.

        Example:
            >>> robot = Robot.from_urdf("ur10")
            >>> ProgramAxes.parse("q1, 90-q2, q3-q2, q4, q5, q6", robot).matrix[2].tolist()
            [0.0, -1.0, 1.0, 0.0, 0.0, 0.0]
        """
        n = robot.n_joints
        reported = robot.as_reported(np.eye(n)).T
        if text is None:
            return cls(reported, np.zeros(n))
        matrix = np.zeros((n, n))
        zeros = np.zeros(n)
        sums = [part.replace(" ", "").replace("-", "+-").split("+") for part in text.split(",")]
        try:
            for k, (row, terms) in enumerate(zip(matrix, sums, strict=True)):
                for term in filter(None, terms):
                    if "q" in term:
                        sign, _, joint = term.partition("q")
                        row[range(n)[int(joint) - 1]] += {"": 1.0, "-": -1.0}[sign]
                    else:
                        zeros[k] += np.deg2rad(plain_number(term))
            if abs(np.linalg.det(matrix)) < 0.5:
                raise ValueError
        except (ValueError, KeyError, IndexError):
            raise BadInputError(
                f"axes {text!r}; expected {n} sums such as q1, 90-q2, q3-q2, of joints 1 to {n}"
            ) from None
        return cls(matrix @ reported, zeros)

    def to_program(self, q: np.ndarray) -> np.ndarray:
        """Return the axes at joint positions, shape (N, n)."""
        return np.asarray(q @ self.matrix.T + self.zeros)

    def to_robot(self, axes: np.ndarray) -> np.ndarray:
        """Return the joint positions at axes, shape (N, n)."""
        return np.asarray((axes - self.zeros) @ np.linalg.inv(self.matrix).T)


@dataclass(frozen=True)
class ArmSearch:
    """Inverse kinematics of the nominal arm, given the axes of the programs."""

    robot: Robot
    axes: ProgramAxes

    @cached_property
    def model(self) -> Model:
        """The nominal arm with the tip as its target."""
        return Model(Chain.of(self.robot), ())

    @cached_property
    def _pool(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        q = self.robot.random_configurations(_POOL, np.random.default_rng(0))
        return q, self.tips(q), self.sides(q)

    @cached_property
    def _zero(self) -> np.ndarray:
        return self.axes.to_robot(np.zeros((1, self.robot.n_joints)))

    @property
    def has_sides(self) -> bool:
        """Whether flags apply to the arm: it has six revolute joints."""
        return self.robot.joint_types == ("revolute",) * 6

    def tips(self, q: np.ndarray) -> np.ndarray:
        """Return poses of the tip in the base frame, shape (N, 3, 4) [m]."""
        return np.asarray(self.model.predict(np.zeros(0), Conditions.at(q)))

    def sides(self, q: np.ndarray) -> np.ndarray:
        """Return front, up and down of joint positions, shape (N, 6), as 1 or -1, shape (N, 3)."""
        if not self.has_sides:
            return np.zeros((len(q), 3))
        axes = self._axes(q)
        faces, wrist, elbow = self._shape(q, axes)
        p1, p2, p3 = (axes[:, i, :3, 3] for i in range(3))
        across = axes[:, 1, :3, 2] * self._signs[0]
        front = _dot(wrist - p1, faces)
        up = _dot(np.cross(p3 - p2, wrist - p2), across)
        forearm = axes[:, 3, :3, 2] * np.sign(_dot(wrist - elbow, axes[:, 3, :3, 2]))[:, None]
        bent = np.cross(forearm, axes[:, 5, :3, 2] * self._signs[2])
        down = _dot(bent, axes[:, 4, :3, 2] * self._signs[1])
        return np.asarray(np.sign(np.column_stack([front, up, down])))

    def _axes(self, q: np.ndarray) -> np.ndarray:
        """Return the frames whose z axes are those of the joints, shape (N, 6, 4, 4)."""
        frames = self.robot.kinematics.frames(q)
        frames[:, 0] = self.robot.kinematics.first
        return np.asarray(frames[:, :-1] @ self.robot.kinematics.before)

    def _shape(self, q: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the direction that the arm faces, and its wrist and its elbow, shape
        (N, 3) each.
        """
        z = axes[:, 0, :3, 2]
        turn = (q[:, 0] - self._zero[0, 0])[:, None]
        x = np.array([1.0, 0.0, 0.0])
        faces = x * np.cos(turn) + np.cross(z, x) * np.sin(turn)
        return faces, _nearest(axes[:, 4], axes[:, 3]), axes[:, 2, :3, 3]

    @cached_property
    def _signs(self) -> np.ndarray:
        """Signs that direct axes 2 and 5 to up x front where axis 4 is at zero, and axis 6
        outwards.
        """
        q = self._zero
        axes = self._axes(q)
        faces, wrist, _ = self._shape(q, axes)
        across = np.cross([0.0, 0.0, 1.0], faces[0])
        tip = self.robot.forward_kinematics(q)[0, :3, 3] - wrist[0]
        signs = np.array(
            [axes[0, 1, :3, 2] @ across, axes[0, 4, :3, 2] @ across, axes[0, 5, :3, 2] @ tip]
        )
        return np.where(signs < 0.0, -1.0, 1.0)

    def find(
        self, tips: np.ndarray, postures: list[Posture], near: np.ndarray | None
    ) -> list[np.ndarray]:
        """Return the joint positions, up to whole turns, that reach poses of the tip in given
        postures.

        Args:
            tips: shape (N, 3, 4), in the base frame.
            postures: of each.
            near: shape (n,), joint positions from which to start as well.

        Returns:
            For each pose, shape (k, n).
        """
        found: list[np.ndarray] = []
        for start in range(0, len(tips), _PIECE):
            rows = range(start, min(start + _PIECE, len(tips)))
            starts = [self._starts(tips[i], postures[i], near) for i in rows]
            owner = np.repeat(np.arange(len(rows)), [len(part) for part in starts])
            q = np.concatenate(starts)
            q, reached = self.reach(q, tips[start : start + len(rows)][owner])
            sides = self.sides(q)
            for k, i in enumerate(rows):
                mine = np.flatnonzero(reached & (owner == k))
                allowed = [not self.has_sides or postures[i].allows(sides[row]) for row in mine]
                found.append(self._distinct(q[mine[allowed]]))
        return found

    @cached_property
    def has_one_per_posture(self) -> bool:
        """Whether a posture leaves one choice up to whole turns: the axes of the wrist meet."""
        if not self.has_sides:
            return False
        q = self.robot.random_configurations(_TRIED, np.random.default_rng(0))
        axes = self._axes(q)
        wrist = _nearest(axes[:, 4], axes[:, 3])
        apart = [
            np.linalg.norm(np.cross(wrist - axes[:, i, :3, 3], axes[:, i, :3, 2]), axis=1).max()
            for i in (3, 4, 5)
        ]
        return bool(max(apart) < _MEETING)

    def reach(self, q: np.ndarray, tips: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the joint positions closest to q, shape (N, n), at poses of the tip, (N, 3, 4),
        and which are reached.
        """
        problem = IkProblem.of(
            self.model, np.zeros(0), conditions=Conditions.at(q), wanted=tips, with_orientation=True
        )
        own = q[:, self.robot.own_joints]
        found, reached = newton(problem, own, seed=own)
        return self.robot.spread(found), reached

    def _starts(self, tip: np.ndarray, posture: Posture, near: np.ndarray | None) -> np.ndarray:
        q, tips, sides = self._pool
        distance = np.linalg.norm(tips[:, :, 3] - tip[:, 3], axis=1) / self.robot.reach
        distance += 0.5 * np.arccos(
            np.clip(0.5 * (np.einsum("nij,ij->n", tips[:, :, :3], tip[:, :3]) - 1.0), -1.0, 1.0)
        )
        for side, wanted in enumerate(posture.sides if self.has_sides else ()):
            if wanted is not None:
                distance = np.where((sides[:, side] > 0.0) == wanted, distance, np.inf)
        count = _STARTS if self.has_sides and posture.is_whole else _MORE_STARTS
        best = np.argpartition(distance, count)[:count]
        return np.concatenate([q[best], near[None]]) if near is not None else q[best]

    def _distinct(self, q: np.ndarray) -> np.ndarray:
        """Return joint positions without duplicates, which may differ by whole turns."""
        turns = np.array([kind != "prismatic" for kind in self.robot.joint_types])
        kept: list[np.ndarray] = []
        for row in q:
            change = [row - other for other in kept]
            moved = [np.where(turns, d - _TURN * np.round(d / _TURN), d) for d in change]
            if not any(np.abs(d).max() < _SAME for d in moved):
                kept.append(row)
        return np.array(kept).reshape(-1, self.robot.n_joints)

    def turned(self, q: np.ndarray, posture: Posture, near: np.ndarray) -> np.ndarray | None:
        """Return joint positions moved by whole turns to within the limits, by the turn numbers and
        otherwise near others.

        Args:
            q: shape (n,).
            posture: has the turn numbers.
            near: shape (n,).

        Returns:
            Shape (n,), or None if no turns lead there.
        """
        turns = np.array([kind != "prismatic" for kind in self.robot.joint_types])
        out = q + np.where(turns, _TURN * np.round((near - q) / _TURN), 0.0)
        is_inside = np.all((out >= self.robot.lower - 1e-9) & (out <= self.robot.upper + 1e-9))
        # No other turns are nearer.
        if is_inside and self._has_turns(out, posture):
            return out
        out = q.copy()
        for joint, kind in enumerate(self.robot.joint_types):
            wanted = [turn for turn in posture.turns if turn.joint == joint]
            choices = q[joint] + _TURN * np.arange(-4, 5) * (kind != "prismatic")
            inside = (choices >= self.robot.lower[joint] - 1e-9) & (
                choices <= self.robot.upper[joint] + 1e-9
            )
            for turn in wanted:
                tried = np.tile(q, (len(choices), 1))
                tried[:, joint] = choices
                inside &= self._counts(tried, turn)
            if not inside.any():
                return None
            out[joint] = min(choices[inside], key=lambda value: abs(value - near[joint]))
        return out

    def has_turns(self, q: np.ndarray, posture: Posture) -> bool:
        """Return whether joint positions, shape (n,), have the turn numbers of a posture."""
        if self._has_turns(q, posture):
            return True
        return all(self._counts(q[None], turn)[0] for turn in posture.turns)

    def _has_turns(self, q: np.ndarray, posture: Posture) -> bool:
        """Return whether joint positions, shape (n,), have the turn numbers, not only next to
        them.
        """
        if not posture.turns:
            return True
        axes = self.axes.to_program(q).tolist()
        return all(turn.counted(axes[turn.joint]) == turn.value for turn in posture.turns)

    def _counts(self, q: np.ndarray, turn: Turn) -> np.ndarray:
        """Return whether a turn number holds at, or next to, joint positions, shape (N, n); shape
        (N,).
        """
        edge = PROGRAM_NUMBERS.on_edge
        asides = np.array([[-edge], [0.0], [edge]]) * (np.arange(q.shape[1]) == turn.joint)
        angles = [self.axes.to_program(q + aside)[:, turn.joint] for aside in asides]
        return np.array(
            [
                any(turn.counted(angle) == turn.value for angle in row)
                for row in np.transpose(angles).tolist()
            ]
        )


@dataclass
class PoseSearch:
    """The joint positions that reach the poses of a program, searched for as they are asked for.

    Most points are near the one before: from there a single search finds them. Only where its
    result is not clearly the one that the controller chooses, all others are searched for.

    Attributes:
        arms: the inverse kinematics.
        tips: shape (N, 3, 4), poses of the tip.
        postures: of each, as far as the controller obeys them.
        seed: shape (n,), joint positions from which to start as well.
    """

    arms: ArmSearch
    tips: np.ndarray
    postures: list[Posture]
    seed: np.ndarray | None
    _guesses: dict[int, tuple[np.ndarray, np.ndarray, bool]] = field(default_factory=dict)
    _found: dict[int, np.ndarray] = field(default_factory=dict)
    _sides: dict[bytes, np.ndarray] = field(default_factory=dict)

    def clear_choice(
        self, i: int, posture: Posture, near: np.ndarray, *, known: np.ndarray | None
    ) -> np.ndarray | None:
        """Return the joint positions of a pose if they are clear, else None.

        Args:
            i: the pose.
            posture: the wanted one.
            near: shape (n,), joint positions from which the search starts.
            known: shape (n,), joint positions that the arm comes from, if they are known.
        """
        if not self.arms.has_sides:
            return None
        q, sides, is_reached = self._guess(i, near)
        wanted = posture
        if not posture.is_whole:
            if known is None:
                return None
            front, up, down = (bool(side > 0.0) for side in self.sides_of(known))
            wanted = Posture(front, up, down)
        is_same = bool(np.all(sides != 0.0)) and wanted.allows(sides) and posture.allows(sides)
        turned = self.arms.turned(q, posture, near) if is_reached and is_same else None
        if turned is None:
            return None
        is_only = posture.is_whole and self.arms.has_one_per_posture
        if not is_only and float(np.abs(turned - near).max()) >= _CLOSE:
            return None
        self._sides[turned.tobytes()] = sides
        return turned

    def sides_of(self, q: np.ndarray) -> np.ndarray:
        """Return the sides of joint positions, shape (n,), mostly those of an earlier pose."""
        key = q.tobytes()
        if key not in self._sides:
            self._sides[key] = self.arms.sides(q[None])[0]
        return self._sides[key]

    def _guess(self, i: int, near: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
        """Return the joint positions found from others, their sides, and whether they reach the
        pose in its posture.
        """
        if i not in self._guesses:
            rows = range(i, min(i + _PIECE, len(self.tips)))
            q, reached = self.arms.reach(np.tile(near, (len(rows), 1)), self.tips[rows])
            sides = self.arms.sides(q)
            self._guesses |= {
                row: (q[k], sides[k], bool(reached[k]) and self.postures[row].allows(sides[k]))
                for k, row in enumerate(rows)
            }
        return self._guesses[i]

    def all_of(self, i: int) -> np.ndarray:
        """Return all joint positions that reach a pose, shape (solutions, n)."""
        if i not in self._found:
            # Those behind it whose guess is of no use will be asked for as well.
            behind = range(i + 1, min(i + _PIECE, len(self.tips)))
            rows = [i, *(k for k in behind if k in self._guesses and not self._guesses[k][2])]
            found = self.arms.find(self.tips[rows], [self.postures[k] for k in rows], self.seed)
            self._found |= dict(zip(rows, found, strict=True))
        return self._found[i]


def rigid_pose(robot: Robot, link: str, seen_from: str) -> np.ndarray | None:
    """Return the pose of a link, shape (4, 4), in the frame of another that is rigidly connected;
    None if it is not.
    """
    import pinocchio as pin

    model = robot.pinocchio_model()
    if not (model.existFrame(link, pin.BODY) and model.existFrame(seen_from, pin.BODY)):
        return None
    frames = [model.frames[model.getFrameId(name, pin.BODY)] for name in (seen_from, link)]
    if frames[0].parentJoint != frames[1].parentJoint:
        return None
    return np.asarray((frames[0].placement.inverse() * frames[1].placement).homogeneous)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(np.einsum("ni,ni->n", a[:, :3], b[:, :3]))


def _nearest(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the points of lines, along z of frames of shape (N, 4, 4), nearest to other lines,
    shape (N, 3).
    """
    p = first[:, :3, 3]
    u = first[:, :3, 2]
    r = second[:, :3, 3]
    v = second[:, :3, 2]
    cosine = _dot(u, v)
    apart = 1.0 - cosine**2
    along = (_dot(r - p, u) - cosine * _dot(r - p, v)) / np.where(apart < 1e-9, 1.0, apart)
    return np.asarray(p + np.where(apart < 1e-9, 0.0, along)[:, None] * u)
