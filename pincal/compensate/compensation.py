"""Compensation: from wanted poses, or a nominal program, to the joint positions that reach them by
the calibrated model.

The fourth step of the paper (Radkhah, Hemker, Friedmann, von Stryk, Fig. 1): with the identified
model the robot reaches the intended poses.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from pincal.calibration.fitted_robot import FittedRobot
from pincal.compensate.compensate_numbers import COMPENSATION
from pincal.compensate.ik_problem import Bounds, IkProblem
from pincal.compensate.robot_frames import (
    PoseFrame,
    base_in_instrument,
    in_base_frame,
    program_poses,
)
from pincal.compensate.solve_ik import solve_ik
from pincal.errors import BadInputError
from pincal.model.conditions import Conditions
from pincal.robot.robot import Robot
from pincal.robot.se3 import compose
from pincal.thresholds import Count
from pincal.units import real_array

log = logging.getLogger(__name__)

KeptOrientation = Literal["keep", "free"]
# Rows processed at once: some 100 MB, and enough to amortise the few rows that need more steps.
_PIECE: Count = 32768


@dataclass(frozen=True, repr=False)
class Compensation:
    """Joint positions to command, row by row.

    Attributes:
        q: shape (N, n), within the limits [rad or m].
        status: shape (N,), "ok": reached to 1e-9 m and 1e-9 rad; "singular": a small correction
            would need large joint motions, so the joints are kept within 0.1 rad of the seed and
            reach the position, with the orientation as close as possible; "joint_limit": a joint is
            at its limit; "unreachable": no joint positions were found.
        error: shape (N,), predicted distance from the wanted position [m].
        turn: shape (N,), predicted angle from the wanted orientation [rad]; 0 if none is wanted.
        seed_error: shape (N,), predicted distance of the seeds from the wanted position [m]: the
            error of the uncompensated program.
        wanted: shape (N, 3, 4), the wanted poses of the target in ``frame``.
        frame: "instrument" or "base".
    """

    q: np.ndarray
    status: np.ndarray
    error: np.ndarray
    turn: np.ndarray
    seed_error: np.ndarray
    wanted: np.ndarray
    frame: PoseFrame

    def __repr__(self) -> str:
        return (
            f"Compensation({int(self.is_ok.sum())} of {len(self.q)} rows ok, in the "
            f"frame {self.frame!r})"
        )

    @property
    def is_ok(self) -> np.ndarray:
        """Whether each row is reached, shape (N,)."""
        return np.asarray(self.status == "ok")


def _require_one_of(name: str, value: str, known: Sequence[str]) -> None:
    if value not in known:
        raise BadInputError(f"{name} {value!r}; expected one of {', '.join(known)}")


def compensate_poses(
    calibrated: FittedRobot,
    wanted: np.ndarray,
    conditions: Conditions,
    *,
    frame: PoseFrame = "instrument",
    orientation: KeptOrientation = "keep",
    limits: bool = True,
) -> Compensation:
    """Return the joint positions at which the target reaches wanted poses by the calibrated model.

    Of all joint positions that reach a pose, the closest to the seed (sum of squares over joints
    [rad, m]) are returned if the seed is within 5 cm and 0.1 rad of the pose; no joint then moves
    by more than 0.35 rad or m. From a more distant seed, the closest that the search finds are
    returned.

    Args:
        calibrated: the calibrated model.
        wanted: shape (N, 3, 4), poses of the target, or shape (N, 3), positions only [m].
        conditions: the N rows; their joint positions are the seeds.
        frame: frame of the wanted poses: the instrument's or the robot's base.
        orientation: for wanted positions: "keep" the orientation of the nominal robot at the seed,
            as the program intends, or "free". An arm with fewer than six joints keeps it as closely
            as it can.
        limits: whether to respect the joint limits of the URDF.

    Returns:
        The joint positions, independently for each row.

    Raises:
        BadInputError: for wanted poses or seeds that have a wrong shape or are not finite, or an
            unknown frame or orientation; or if the conditions lack a column that an effect of the
            model needs.

    Example:
        >>> from pincal.builtin import kuka_urdf_path
        >>> from pincal.model.chain import Chain
        >>> from pincal.model.effects import JointOffset
        >>> from pincal.model.model import Model
        >>> from pincal.parameters import estimate_of
        >>> from pincal.calibration.covered import Covered
        >>> from pincal.robot.robot import Robot
        >>> model = Model(Chain.of(Robot.from_urdf(kuka_urdf_path())), (JointOffset(),))
        >>> offset = np.array([0.0, 0.0, 2e-3, 0.0, 0.0, 0.0])
        >>> covered = Covered(np.zeros((6, 2)), np.zeros(2))
        >>> estimate = estimate_of(model.parameters, offset, np.zeros((6, 6)))
        >>> known = FittedRobot.given(model, estimate, covered, sensor_kind="pose", sigma=[0.0])
        >>> program = Conditions.at(np.array([[0.3, 1.2, -1.1, 0.4, 0.7, -0.5]]))
        >>> found = compensate_program(known, program)
        >>> found.status.tolist(), float((found.q - program.q)[0, 2].round(9))
        (['ok'], -0.002)
    """
    _require_one_of("frame", frame, get_args(PoseFrame))
    _require_one_of("orientation", orientation, get_args(KeptOrientation))
    _require_seeds(conditions.q, calibrated.model.chain.robot.n_joints)
    conditions = calibrated.of_its_day(conditions)
    poses = _as_poses(wanted, len(conditions))
    if np.ndim(wanted) == 2 and orientation == "keep":
        meant = program_poses(calibrated, conditions)
        if frame == "instrument":
            meant = compose(base_in_instrument(calibrated, conditions), meant)
        poses[:, :, :3] = meant[:, :, :3]
    placed = in_base_frame(calibrated) if frame == "base" else calibrated
    problem = IkProblem.of(
        placed.model,
        placed.model_values,
        conditions=conditions,
        wanted=poses,
        with_orientation=np.ndim(wanted) == 3 or orientation == "keep",
    )
    robot = placed.model.chain.robot
    own = robot.own_joints
    seeds = np.asarray(conditions.q[:, own], float)
    bounds = Bounds(robot.lower[own], robot.upper[own]) if limits else Bounds.none(len(own))
    q, status = _solved(problem, seeds, bounds)
    error, turn = problem.distances(problem.residuals(q))
    seed_error, _ = problem.distances(problem.residuals(seeds))
    return Compensation(
        robot.as_reported(robot.spread(q)), status, error, turn, seed_error, poses, frame
    )


def _require_seeds(q: np.ndarray, n_joints: int) -> None:
    if q.ndim != 2 or q.shape[1] != n_joints or not np.isfinite(q).all():
        raise BadInputError(
            f"seeds have shape {q.shape}; expected (N, {n_joints}), all of them numbers"
        )


def _solved(problem: IkProblem, seeds: np.ndarray, bounds: Bounds) -> tuple[np.ndarray, np.ndarray]:
    """Return the joint positions, shape (N, n), and the status of each row, some rows at a time."""
    q = np.empty_like(seeds)
    status = np.empty(len(seeds), dtype="<U12")
    for start in range(0, len(problem), _PIECE):
        rows = slice(start, start + _PIECE)
        log.info(
            "finding the joints of %d rows", len(problem), extra={"done": start, "of": len(problem)}
        )
        q[rows], status[rows] = solve_ik(problem.select(rows), seeds[rows], limits=bounds)
    return q, status


def compensate_program(
    calibrated: FittedRobot, conditions: Conditions, *, limits: bool = True
) -> Compensation:
    """Return the joint positions at which the real robot reaches the poses of a nominal program.

    The wanted pose is the target's on the nominal robot, with the identified tool, at the program's
    joint positions, which ``conditions`` contains and which are the seeds; it is in the robot's
    base frame. ``limits`` and errors are as for
    :func:`compensate_poses`.
    """
    return compensate_poses(
        calibrated, program_poses(calibrated, conditions), conditions, frame="base", limits=limits
    )


def middle_of_range(robot: Robot) -> np.ndarray:
    """Return a seed for poses without one, shape (n,): the middle of each joint's range, 0 if it is
    unlimited.
    """
    lower, upper = np.where(
        np.isfinite(robot.lower) & np.isfinite(robot.upper), (robot.lower, robot.upper), 0.0
    )
    return np.asarray(robot.following((lower + upper)[None] / 2.0)[0])


def _as_poses(wanted: np.ndarray, count: int) -> np.ndarray:
    """Return a copy of wanted poses as an array of shape (N, 3, 4)."""
    given = real_array(wanted, "desired poses")
    if given.shape not in ((count, 3), (count, 3, 4)):
        raise BadInputError(
            f"desired poses have shape {given.shape}; expected ({count}, 3, 4) or ({count}, 3)"
        )
    if not np.isfinite(given).all():
        row = int(np.flatnonzero(~np.isfinite(given.reshape(count, -1)).all(axis=1))[0])
        raise BadInputError(f"desired pose {row} is not finite; expected numbers")
    if given.ndim == 2:
        return np.concatenate([np.tile(np.eye(3), (count, 1, 1)), given[:, :, None]], axis=2)
    turns = given[:, :, :3]
    off = np.abs(turns @ turns.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2)) + np.abs(
        np.linalg.det(turns) - 1.0
    )
    if off.max(initial=0.0) > COMPENSATION.orthonormal:
        raise BadInputError(
            f"desired pose {int(off.argmax())}: its first three columns are not a rotation matrix"
        )
    return given.copy()
