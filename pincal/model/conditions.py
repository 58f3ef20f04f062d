"""Conditions of poses, known before anything is measured, and the variables that
effects depend on.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pincal.errors import BadInputError
from pincal.model import kernels, walk
from pincal.model.chain import Chain
from pincal.model.effect_numbers import SHOWN
from pincal.model.kernel_inputs import Payload, Values
from pincal.model.latest import Latest
from pincal.model.loops import borne_moments
from pincal.model.symbols import are_symbols
from pincal.recorded import RECORDABLE, RECORDED, Recorded
from pincal.units import expected_number, is_possible, real_array

TURN = 2.0 * np.pi
# The variable of effects that depend on the static moment on a joint.
MOMENT = "moment"
# A moment below this fraction of the largest on the arm is there only because the base is not quite
# level.
UNFELT = SHOWN.unfelt


@dataclass(frozen=True)
class Conditions(Recorded):
    """Conditions of each of N poses, known before the measurement.

    Attributes:
        q: shape (N, n), joint positions [rad or m].
        target: shape (N,), index into the chain's targets.
        payload: shape (N,), mass at the tip [kg].
        payload_centre: shape (3,), its centre of mass in the tip frame [m].
        setup: shape (N,), index of the set-up of instrument and targets if there are several, else
            None.
        sighted: shape (N, 3), position of the target in the instrument's frame [m]; None before it
            was read.
        inertial: shape (N, n, 6), inertial force [N] and moment [N m] of everything that a moving
            joint carries on this joint, in the axes after its motion and about the origin of the
            preceding frame; None at rest.
        around: the K instants about each pose on which a sensor's reading depends; None for sensors
            that read single poses.
    """

    q: np.ndarray
    target: np.ndarray
    payload: np.ndarray
    payload_centre: np.ndarray
    setup: np.ndarray | None = None
    sighted: np.ndarray | None = None
    inertial: np.ndarray | None = None
    # A Moving, or None; Any, as dictionaries of columns hold it together with arrays.
    around: Any = None

    @classmethod
    def at(
        cls,
        q: np.ndarray,
        *,
        payload: float = 0.0,
        payload_centre: Iterable[float] = (0.0, 0.0, 0.0),
    ) -> Conditions:
        """Return the conditions of bare joint positions, shape (N, n), with one payload [kg] and
        the first target.

        Raises:
            BadInputError: if a joint position, the payload or its centre is not finite, or is
                none of a robot.
        """
        q = np.atleast_2d(real_array(q, "joint positions"))
        if not is_possible(q, "angle").all():
            raise BadInputError(f"joint positions: expected {expected_number('angle')} each")
        n = len(q)
        loads = RECORDABLE["payload"].checked(payload)
        centre = real_array(list(payload_centre), "centre of mass of the payload")
        if centre.shape != (3,) or not is_possible(centre, "length").all():
            raise BadInputError(
                f"centre of mass of the payload {centre.tolist()}; "
                f"expected three numbers, each {expected_number('length')}"
            )
        return cls(q, np.zeros(n, int), np.full(n, loads), centre)

    @classmethod
    def of_everything(cls, n_joints: int) -> Conditions:
        """Return the conditions of one pose in which every recordable column is zero."""
        recorded = {
            name: np.zeros((1, n_joints) if of.of_joints else 1) for name, of in RECORDED.items()
        }
        return replace(cls.at(np.zeros((1, n_joints))), **recorded, sighted=np.ones((1, 3)))

    def __len__(self) -> int:
        return len(self.q)

    def select(self, rows: slice | np.ndarray) -> Conditions:
        """Return the conditions of some rows."""
        columns = {
            each.name: getattr(self, each.name)
            for each in fields(self)
            if each.name != "payload_centre"
        }
        chosen: dict[str, Any] = {
            name: column[rows] for name, column in columns.items() if column is not None
        }
        return replace(self, **chosen)

    @property
    def are_of_motion(self) -> bool:
        """Whether they are of an arm that moved along a path, whose links bear inertial loads."""
        return self.inertial is not None

    @cached_property
    def are_in_motion(self) -> bool:
        """Whether the arm moves in any of the poses."""
        return self.velocity is not None and bool(np.any(self.velocity))

    @property
    def at_moments(self) -> Conditions:
        """The poses that readings depend on: these, or the N K poses at the instants about them,
        row by row.
        """
        # Poses that kept themselves would keep their memory, too.
        return self if self.around is None or self.around.q is None else self._about_them

    @cached_property
    def _about_them(self) -> Conditions:
        """The poses at the instants about these."""
        moving = self.around
        assert moving is not None and moving.q is not None
        n, K, joints = moving.q.shape
        rows = np.repeat(np.arange(n), K)
        return replace(
            replace(self, around=None).select(rows),
            q=np.ascontiguousarray(moving.q.reshape(-1, joints)),
            velocity=None if moving.velocity is None else moving.velocity.reshape(-1, joints),
            inertial=None if moving.loads is None else moving.loads.reshape(-1, joints, 6),
        )

    def column(self, name: str) -> np.ndarray | None:
        """Return a recorded column of ``RECORDABLE``, shape (N, n) or (N,), or None."""
        found: np.ndarray | None = getattr(self, name)
        return found


_PARTS = Latest["Conditions"](16)
_JOINED = Latest["Conditions"](4)


def part_of(whole: Conditions, rows: slice | np.ndarray, key: Hashable) -> Conditions:
    """Return the conditions of some rows, identified by a key: the same object each time, so that
    caches of it apply.
    """
    known = _PARTS.of(whole)
    if key not in known:
        known[key] = whole.select(rows)
    return known[key]


def joined_conditions(parts: Sequence[Conditions]) -> Conditions:
    """Return the poses of several set-ups, one after the other.

    Every target becomes the first one, as each set-up has its own. Times, whose origin differs
    between set-ups, are left out; so are temperatures, droops and sighted positions if some set-up
    lacks them. Directions of approach and moves are unknown where they were not recorded, and poses
    without a velocity were held. The same parts give the same object, so that caches of it apply.
    """
    if len(parts) == 1:
        return parts[0]
    known = _JOINED.of(*parts)
    if not known:
        known["all"] = _joined(parts)
    return known["all"]


def _joined(parts: Sequence[Conditions]) -> Conditions:
    q, payload = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("q", "payload")
    )
    kept = {
        name: variable.unknown for name, variable in RECORDED.items() if not variable.has_own_zero
    }
    kept |= {"sighted": None, "inertial": 0.0}
    columns = {
        name: _one_column([getattr(part, name) for part in parts], parts, unknown)
        for name, unknown in kept.items()
    }
    return Conditions(q, np.zeros(len(q), int), payload, parts[0].payload_centre, **columns)


def _one_column(
    columns: Sequence[np.ndarray | None], parts: Sequence[Conditions], unknown: float | None
) -> np.ndarray | None:
    """Return a column of several set-ups, filled with ``unknown`` where some lack it; None if there
    is no such value.
    """
    known = [column for column in columns if column is not None]
    if len(known) == len(parts):
        return np.concatenate(known)
    if not known or unknown is None:
        return None
    shapes = [(len(part), *known[0].shape[1:]) for part in parts]
    pairs = zip(columns, shapes, strict=True)
    return np.concatenate(
        [np.full(shape, unknown, known[0].dtype) if c is None else c for c, shape in pairs]
    )


def varies(column: np.ndarray | None) -> bool:
    """Return whether a column is present and its rows are not all equal."""
    return column is not None and bool(np.any(column != column[:1]))


def moves(q: np.ndarray) -> np.ndarray:
    """Return which joints move, shape (n,), at positions of shape (N, n) [rad or m].

    Positions of a joint that stands still differ by what its encoder reads, which is not where the
    arm is.

    Example:
        >>> moves(np.array([[0.0, 0.5], [1.0, 0.5], [2.0, 0.5 + 2e-5]])).tolist()
        [True, False]
    """
    if not len(q):
        return np.zeros(q.shape[1], bool)
    ranges = np.ptp(q, axis=0)
    return np.asarray(
        ranges > max(SHOWN.still, SHOWN.still_beside * float(ranges.max(initial=0.0)))
    )


def spread_of_moving(q: np.ndarray) -> np.ndarray:
    """Return the positions of the joints that move about their means and in units of their spread,
    shape (N, moving).
    """
    moving = q[:, moves(q)]
    if not moving.size:
        return moving
    centred = moving - moving.mean(axis=0)
    return np.asarray(centred / np.sqrt(np.mean(centred**2, axis=0)))


def distinct_values(x: np.ndarray) -> int:
    """Return the number of distinct values of a variable, shape (N,), to a thousandth of its range.

    Example:
        >>> distinct_values(np.array([0.0, 1.0, 1.0, 2.0, 1.0 + 1e-4]))
        3
    """
    values = np.sort(x)
    width = SHOWN.close * float(values[-1] - values[0])
    if not width:
        return 1
    # Closely spaced values form an interval, which counts once for each width.
    last = np.append(np.flatnonzero(np.diff(values) > width), len(values) - 1)
    first = np.append(0, last[:-1] + 1)
    return len(last) + int(np.sum((values[last] - values[first]) // width))


def into_range(angles: np.ndarray, lower: ArrayLike, upper: ArrayLike) -> np.ndarray:
    """Return angles shifted by whole turns into a range [rad], to be broadcast with them, where
    that is possible.

    Example:
        >>> into_range(np.array([0.5, 7.0, -6.0, 4.0]), -1.0, 1.0).round(2).tolist()
        [0.5, 0.72, 0.28, 4.0]
    """
    low = np.asarray(lower, float)
    high = np.asarray(upper, float)
    if not np.any((angles < low) | (angles > high)):
        return angles
    turned = angles - TURN * np.round((angles - 0.5 * (low + high)) / TURN)
    is_better = ((angles < low) | (angles > high)) & (turned >= low) & (turned <= high)
    return np.asarray(np.where(is_better, turned, angles))


def recorded_variable(
    chain: Chain,
    conditions: Conditions,
    name: str,
    *,
    joint: str | None = None,
    span: tuple[float, float] | None = None,
) -> np.ndarray:
    """Return a variable that an effect may depend on, shape (N,).

    Args:
        chain: the chain.
        conditions: the N poses.
        name: a joint, for its position [rad or m], or a column of the conditions.
        joint: the joint to select from a column of joints, such as the directions of approach.
        span: range of the variable, into which positions of revolute joints are shifted by whole
            turns.

    Raises:
        BadInputError: if these poses lack the column.
    """
    names = chain.robot.joint_names
    if name in names:
        i = names.index(name)
        q = np.asarray(conditions.q[:, i])
        return (
            q if span is None or chain.robot.joint_types[i] == "prismatic" else into_range(q, *span)
        )
    column = conditions.column(name) if name in RECORDABLE else None
    if column is None:
        missing = RECORDABLE[name].column if name in RECORDABLE else name
        raise BadInputError(
            f"an effect depends on {name}, which these poses lack; add the column {missing}"
        )
    return np.asarray(column if joint is None or column.ndim < 2 else column[:, names.index(joint)])


def nominal_moments(
    chain: Chain, conditions: Conditions, *, payload_only: bool = False
) -> np.ndarray:
    """Return the moments on the nominal arm, shape (N, 3 n) [N m], of all bodies or of the
    payload's weight alone.
    """
    constant = chain.nominal
    n = chain.robot.n_joints
    layout = chain.layout._replace(masses=np.zeros(n)) if payload_only else chain.layout
    if are_symbols(conditions.q):
        at = list(constant)
        for i, k in enumerate(chain.drives):
            at[k] = at[k] + conditions.q[0, i]
        return np.array(
            [walk.symbolic_moments(layout, at, conditions.payload[0], conditions.payload_centre)],
            object,
        )
    slot = np.full(chain.size, -1)
    slot[chain.drives] = np.arange(n)
    varying = np.array(constant[chain.drives, None] + conditions.q.T, order="C")
    mass = np.require(conditions.payload, np.float64, ["C", "W"])
    payload = Payload(mass, np.array(conditions.payload_centre, float))
    values = Values(constant.copy(), slot, varying)
    static = kernels.static_moments(layout, values, payload)
    inertial = 0.0 if payload_only else np.transpose(inertial_moments(chain, conditions))
    return borne_moments(chain, values, static + inertial).T


def inertial_moments(chain: Chain, conditions: Conditions) -> np.ndarray | float:
    """Return the moments of inertia forces on the nominal arm, shape (N, 3 n) [N m]; zero at rest.

    They are about the bearings, in the axes of the chain's moment frame.
    """
    if conditions.inertial is None:
        return 0.0
    force = conditions.inertial[..., :3]
    moment = conditions.inertial[..., 3:]
    slides = np.array([kind == "prismatic" for kind in chain.robot.joint_types])
    # About a point at height h, to which a carriage has moved: M - h z x F.
    height = chain.bearing_heights + np.where(slides, conditions.q, 0.0)
    x = moment[..., 0] + height * force[..., 1]
    y = moment[..., 1] - height * force[..., 0]
    if chain.moment_frame != "after":
        theta = chain.nominal[[chain.joint(i, "theta") for i in range(chain.robot.n_joints)]]
        angle = theta + np.where(slides, 0.0, conditions.q)
        sine = np.sin(angle)
        cosine = np.cos(angle)
        turned = cosine * x - sine * y
        y = sine * x + cosine * y
        x = turned
    return np.stack([x, y, moment[..., 2]], axis=2).reshape(len(x), -1)


@dataclass(frozen=True)
class PoseSet:
    """An arm in the poses that were or will be measured, for which effects propose candidates.

    Attributes:
        chain: the chain.
        conditions: the N poses.
        compliances: shape (3 n,), known compliances of each joint about x, y, z [rad/(N m)];
            default: zero.
    """

    chain: Chain
    conditions: Conditions
    compliances: tuple[float, ...] = ()

    @cached_property
    def moments(self) -> np.ndarray:
        """Static and inertial moments on the nominal arm, shape (N, 3 n) [N m]."""
        return nominal_moments(self.chain, self.conditions)

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints that readings depend on, from the base, without the passive ones of
        loops.
        """
        robot = self.chain.robot
        return tuple(name for name in robot.measured_joints if name not in robot.passive)

    @property
    def revolute(self) -> tuple[str, ...]:
        """Names of the revolute joints."""
        types = dict(zip(self.chain.robot.joint_names, self.chain.robot.joint_types, strict=True))
        return tuple(name for name in self.joints if types[name] != "prismatic")

    def index(self, joint: str) -> int:
        """Return the column of a joint in the poses."""
        return self.chain.robot.joint_names.index(joint)

    def positions(self, joint: str) -> np.ndarray:
        """Return the positions of a joint, shape (N,) [rad or m]."""
        return np.asarray(self.conditions.q[:, self.index(joint)])

    @cached_property
    def moving(self) -> tuple[str, ...]:
        """Names of the joints that move in these poses."""
        does = moves(self.conditions.q)
        return tuple(joint for joint in self.joints if does[self.index(joint)])

    def moment(self, joint: str) -> np.ndarray:
        """Return the moment about the axis of a joint on the nominal arm, shape (N,) [N m]."""
        return np.asarray(self.moments[:, 3 * self.index(joint) + 2])
