r"""Design of motions with an IMU: moves from pose to pose with the most information in the time
that they take.

The moves connect all pairs of some admissible poses; each is at rest at both ends and a polynomial
of degree 5 in time, as fast as limits of speed and acceleration allow. A tour that contains each of
them once is one motion of the arm, whose IMU rows give the information :math:`H_e` of each move e
on the parameters. At each pose the next move is the one with the largest decrease of the predicted
error per second,

.. math:: \big( \mathrm{tr}(W H^{-1}) - \mathrm{tr}(W (H + H_e)^{-1}) \big) / T_e ,

with W the mean squared error of the tool over random poses, base and tool refitted. A controller
need not follow the same time law, as a calibration uses the logged joint positions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any

import numpy as np

from pincal.design.design_model import DesignModel
from pincal.design.exchange import covariance, value
from pincal.design.reach import Draw, Limits, Reach, SensorSetup
from pincal.errors import BadInputError, warn
from pincal.identify.beliefs import priors_of, released_of
from pincal.identify.initial import place
from pincal.identify.options import Options
from pincal.identify.problem import Problem
from pincal.model.conditions import Conditions
from pincal.motion.joint_path import JointPath
from pincal.motion.moving_arm import MovingArm
from pincal.motion.stations import ideal_imu_table
from pincal.robot.robot import Robot
from pincal.thresholds import Count, Scale

# Number of poses between which moves are chosen; a prime, for the tour.
_POSES: Count = 31
# Largest speed and acceleration of a polynomial of degree 5 from rest to rest, for unit move and
# duration.
_SPEED: Scale = 15.0 / 8.0
_ACCELERATION: Scale = 10.0 / 3.0**0.5
# Number of intermediate poses of a move at which constraints are checked.
_WITHIN: Count = 9
# Sampling rate of the tour for its spline, and the spline's knots [1/s].
_RATE: Scale = 100.0
_KNOTS: Scale = 16.0
# Number of poses from which a motion may begin.
_STARTS: Count = 8
# Number of random motions of the same length, for comparison by their median.
_RANDOM: Count = 10
# Poses over which errors are averaged; numbers of poses of an instrument, and random sets of each.
_CARED: Count = 200
_NUMBERS: tuple[Count, ...] = (3, 4, 6, 8, 10, 12, 15, 20, 30, 40, 60)
_SETS: Count = 8


@dataclass(frozen=True, eq=False, repr=False)
class MotionDesign:
    """A motion with an IMU on the tool, and the predicted accuracy.

    Attributes:
        robot: the arm.
        time: times at which V poses are reached, shape (V,) [s].
        q: the poses, at which the arm stops, shape (V, n) [rad or m].
        drawn: the poses between which moves were chosen, and the number removed by each constraint.
        before: predicted rms error of the tool over random poses, with base and tool refitted, due
            to the priors of the parameters that an IMU observes [m].
        error: the same after this motion.
        random: the same after a random motion of the same duration, the median of ten.
        lengths: predicted error due to lengths, which an IMU does not observe [m].
        needed: number of random poses measured by an instrument for positions -> rms error
            predicted from these alone, and together with the motion [m].
        noise: noise of a component of the IMU's rows [m/s^2, rad/s], and of a position [m].
    """

    robot: Robot
    time: np.ndarray
    q: np.ndarray
    drawn: Draw
    before: float
    error: float
    random: float
    lengths: float
    needed: dict[int, tuple[float, float]]
    noise: tuple[float, ...]

    def __repr__(self) -> str:
        return f"MotionDesign({self.robot.name!r}: {len(self.time)} poses in {self.time[-1]:.0f} s)"

    def columns(self) -> dict[str, np.ndarray]:
        """Return the table of the poses: time, and position of each joint."""
        own = [self.robot.joint_names[k] for k in self.robot.own_joints]
        return {"time": self.time} | dict(zip(own, self.q[:, self.robot.own_joints].T, strict=True))

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain data, without the poses."""
        return {
            "robot": self.robot.name,
            "base": self.robot.base,
            "tip": self.robot.tip,
            "sensor": "imu",
            "duration_s": float(self.time[-1]),
            "poses": len(self.time),
            "noise": list(self.noise),
            "candidates": {
                "found": len(self.drawn.q),
                "drawn": self.drawn.drawn,
                "removed": self.drawn.removed,
            },
            "error_rms_mm": {
                "nominal": 1e3 * self.before,
                "designed": 1e3 * self.error,
                "random_median": 1e3 * self.random,
            },
            "error_by_lengths_rms_mm": 1e3 * self.lengths,
            "needed": [
                {"poses": n, "alone_mm": 1e3 * alone, "with_motion_mm": 1e3 * both}
                for n, (alone, both) in self.needed.items()
            ],
        }


def _require_moves(moves: _Moves) -> None:
    if not moves.allowed.any():
        raise BadInputError(
            "constraints leave no move between any two poses; expected a lower floor or a "
            "wider box or span"
        )


def design_motion(
    robot: Robot,
    duration: float,
    options: Options | None = None,
    *,
    speed: float = 1.0,
    acceleration: float = 3.0,
    limits: Limits | None = None,
    seed: int = 0,
) -> MotionDesign:
    """Choose the motion with which an IMU on the tool yields most information on an arm.

    Args:
        robot: the arm.
        duration: duration of the motion, up to the end of its last move [s].
        options: as for the calibration: effects, and noise of an additional instrument's positions.
        speed: largest speed of a joint [rad/s], half of it for a prismatic one [m/s]; at most the
            URDF's limit.
        acceleration: likewise [rad/s^2].
        limits: limits of the workspace.
        seed: seed of all random numbers.

    Raises:
        BadInputError: for an invalid duration, speed or acceleration, or constraints that leave no
            motion.

    Example:
        >>> found = design_motion(Robot.from_urdf("ur5"), 20.0)  # doctest: +SKIP
        >>> found.error < found.before, float(found.time[0])  # doctest: +SKIP
        (True, 0.0)
    """
    _refuse_impossible(duration, speed, acceleration)
    rng = np.random.default_rng(seed)
    options = Options() if options is None else options
    reach = Reach(robot, SensorSetup(), limits or Limits())
    drawn = _poses_to_move_between(reach, rng)
    moves = _Moves.of(reach, drawn.q, speed, acceleration)
    _require_moves(moves)
    cared = Conditions.at(robot.random_configurations(_CARED, rng))
    design = DesignModel.of(robot, cared, options, SensorSetup())
    worth = _worth(robot, moves, options, design, cared)
    walk = _best_walk(moves, worth, duration)
    at_random = [
        _walk(moves, worth, duration, np.flatnonzero(moves.allowed), rng) for _ in range(_RANDOM)
    ]
    needed = _errors_with_instrument(robot, design, worth.information_on(design, walk), cared, rng)
    times = _times(moves, walk, duration)
    return MotionDesign(
        robot,
        times,
        drawn.q[[moves.first[walk[0]], *moves.last[walk]]],
        drawn,
        worth.error([]),
        worth.error(walk),
        float(np.median([worth.error(each) for each in at_random])),
        float(np.sqrt(worth.lengths)),
        needed,
        (*worth.noise, float(design.sigma[0])),
    )


def _refuse_impossible(duration: float, speed: float, acceleration: float) -> None:
    for name, given, unit in (
        ("duration", duration, "s"),
        ("speed", speed, "rad/s"),
        ("acceleration", acceleration, "rad/s^2"),
    ):
        if not 0.0 < given < np.inf:
            raise BadInputError(f"{name} {given:g} {unit}; expected more than 0")


def _poses_to_move_between(reach: Reach, rng: np.random.Generator) -> Draw:
    drawn = reach.draw(_POSES, rng)
    if len(drawn.q) < _POSES:
        raise BadInputError(
            f"constraints leave {len(drawn.q)} poses to move between; expected {_POSES}: "
            f"{drawn.in_words()}"
        )
    return drawn


def _errors_with_instrument(
    robot: Robot,
    design: DesignModel,
    known: np.ndarray,
    cared: Conditions,
    rng: np.random.Generator,
) -> dict[int, tuple[float, float]]:
    """Return number of random poses measured by an instrument -> rms error predicted from these
    alone, and together with the information ``known`` of a motion, shape (F, F) [m].
    """
    with_motion = replace(design, known=known)
    found = {}
    for poses in _NUMBERS:
        sets = [Conditions.at(robot.random_configurations(poses, rng)) for _ in range(_SETS)]
        alone = [design.foreseen(measured, cared) for measured in sets]
        both = [with_motion.foreseen(measured, cared) for measured in sets]
        found[poses] = (float(np.median(alone)), float(np.median(both)))
    return found


def _times(moves: _Moves, walk: Sequence[int], duration: float) -> np.ndarray:
    """Return the times at which the poses of a walk are reached, the first at 0, shape (V,) [s];
    warn if it ends too soon.
    """
    times = np.array([0.0, *accumulate(moves.seconds[walk].tolist())])
    if times[-1] < duration:
        warn(
            f"the motion ends after {times[-1]:.0f} s of {duration:.0f} s, as all moves between "
            f"its {_POSES} poses are used; expected fewer constraints or a shorter duration"
        )
    return times


@dataclass(frozen=True, eq=False)
class _Moves:
    """The moves of a tour through all pairs of poses, in its order.

    Attributes:
        q: poses, shape (M, n).
        first, last: shape (E,), the first and last pose of each move.
        seconds: shape (E,), the duration of each.
        allowed: shape (E,), whether the constraints are satisfied along the move.
    """

    q: np.ndarray
    first: np.ndarray
    last: np.ndarray
    seconds: np.ndarray
    allowed: np.ndarray

    @classmethod
    def of(cls, reach: Reach, q: np.ndarray, speed: float, acceleration: float) -> _Moves:
        """Return the tour: steps of 1, 2, ... through a prime number of poses each return to the
        first.
        """
        M = len(q)
        first = np.array([step * k % M for step in range(1, M) for k in range(M)])
        last = np.roll(first, -1)
        size = np.where([kind == "prismatic" for kind in reach.robot.joint_types], 0.5, 1.0)
        fastest = np.minimum(size * speed, _speed_limits(reach.robot))
        way = np.abs(q[last] - q[first])
        seconds = np.maximum(
            _SPEED * way / fastest, np.sqrt(_ACCELERATION * way / (size * acceleration))
        ).max(axis=1)
        parts = np.arange(1, _WITHIN + 1) / (_WITHIN + 1)
        within = (q[first][:, None] + parts[:, None] * (q[last] - q[first])[:, None]).reshape(
            len(first) * _WITHIN, -1
        )
        within = reach.robot.following(within)
        allowed = reach.allows_apart(within)
        allowed[allowed] = ~reach.collides(within[allowed])
        return cls(
            q, first, last, seconds, np.asarray(np.all(allowed.reshape(-1, _WITHIN), axis=1))
        )

    def path(self) -> JointPath:
        """Return the whole tour as a path in time."""
        ends = np.cumsum(self.seconds)
        time = np.arange(0.0, ends[-1], 1.0 / _RATE)
        move = np.minimum(np.searchsorted(ends, time, side="right"), len(ends) - 1)
        part = np.clip((time - ends[move] + self.seconds[move]) / self.seconds[move], 0.0, 1.0)
        share = (part**3 * (10.0 - 15.0 * part + 6.0 * part**2))[:, None]
        begins = self.q[self.first[move]]
        finishes = self.q[self.last[move]]
        return JointPath.through(
            time, begins + share * (finishes - begins), knots_per_second=_KNOTS
        )


def _speed_limits(robot: Robot) -> np.ndarray:
    """Return the largest speeds of the joints by the URDF, shape (n,) [rad/s or m/s]; inf where it
    has none.
    """
    model = robot.pinocchio_model()
    found = np.array(
        [
            model.velocityLimit[model.joints[model.getJointId(name)].idx_v]
            for name in robot.joint_names
        ]
    )
    return np.where(found > 0.0, found, np.inf)


@dataclass(frozen=True, eq=False)
class _Worth:
    """Information of moves on the F parameters of arm and IMU that an IMU-only fit releases, in
    units of priors.

    Attributes:
        W: shape (F, F) [m^2], squared error of the tool by these parameters, with base and tool
            refitted.
        H: shape (E, F, F), information of each move.
        columns: indices among the F parameters of those on which positions depend as well.
        observed: which parameters with a prior of a model of positions these are.
        lengths: squared error due to the priors of the others, which an IMU does not observe [m^2].
        noise: noise of a component of the IMU's rows [m/s^2, rad/s].
    """

    W: np.ndarray
    H: np.ndarray
    columns: np.ndarray
    observed: np.ndarray
    lengths: float
    noise: tuple[float, ...]

    def known(self, walk: Sequence[int]) -> np.ndarray:
        """Return the information after some moves, including the priors', shape (F, F)."""
        return np.asarray(np.eye(len(self.W)) + self.H[list(walk)].sum(axis=0))

    def error(self, walk: Sequence[int]) -> float:
        """Return the predicted error of the tool after some moves due to the F parameters [m]."""
        return float(np.sqrt(value(covariance(self.known(walk)), self.W)))

    def information_on(self, design: DesignModel, walk: Sequence[int]) -> np.ndarray:
        """Return what is known of a design's parameters after some moves, shape of its ``known``
        and in its units.
        """
        known = np.eye(design.n_free)
        at = np.flatnonzero(design.has_prior)[self.observed]
        C = covariance(self.known(walk))
        known[np.ix_(at, at)] = covariance(C[np.ix_(self.columns, self.columns)])
        return known


def _worth(
    robot: Robot, moves: _Moves, options: Options, design: DesignModel, cared: Conditions
) -> _Worth:
    table = ideal_imu_table(MovingArm(robot, moves.path()))
    # The noise in the options is another instrument's, not the IMU's.
    ((station, values),) = place(
        robot, {"": table}, replace(options, sigma=None, sigma_orientation=None)
    )
    problem = Problem((station,))
    # As in an IMU-only fit, lengths are held fixed.
    free = released_of(problem, options)
    sizes = priors_of(problem, options).sizes[free]
    names = [p.name for p, is_free in zip(station.parameters, free, strict=True) if is_free]
    observed = np.array([name in names for name in design.own_names])
    columns = np.array([names.index(name) for name in np.array(design.own_names)[observed]])
    units = np.where(np.isfinite(sizes), sizes, 1.0)
    units[columns] = design.units[design.has_prior][observed]
    noise = tuple(block.noise for block in station.sensor.blocks)
    assert table.time is not None
    ends = np.cumsum(moves.seconds)
    move = np.minimum(np.searchsorted(ends, table.time), len(ends) - 1)
    H = np.zeros((len(ends), len(units), len(units)))
    for rows, _, jacobian in station.linearise(values, free):
        A = jacobian.transpose(2, 1, 0) * (units / np.repeat(noise, station.block_sizes)[:, None])
        for e in np.unique(move[rows]):
            part = A[move[rows] == e].reshape(-1, len(units))
            H[e] += part.T @ part
    J = design.placed_errors(cared)
    W = np.zeros_like(H[0])
    W[np.ix_(columns, columns)] = J[:, observed].T @ J[:, observed] / len(cared.q)
    lengths = float(np.sum(J[:, ~observed] ** 2)) / len(cared.q)
    return _Worth(W, H, columns, observed, lengths, noise)


def _best_walk(moves: _Moves, worth: _Worth, duration: float) -> list[int]:
    """Return the best of some walks, each from another pose and by the moves with the most
    information per second.
    """
    begins = np.flatnonzero(moves.allowed)
    begins = begins[np.argsort(-_rates(moves, worth, begins, worth.known([])))]
    _, at = np.unique(moves.first[begins], return_index=True)
    walks = [_walk(moves, worth, duration, begins[[k]]) for k in np.sort(at)[:_STARTS]]
    return min(walks, key=worth.error)


def _rates(moves: _Moves, worth: _Worth, which: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the decrease of the squared error per second by each move, shape (n,), given
    information ``known``.
    """
    after = np.array([value(C, worth.W) for C in np.linalg.inv(known + worth.H[which])])
    return np.asarray((value(covariance(known), worth.W) - after) / moves.seconds[which])


def _walk(
    moves: _Moves,
    worth: _Worth,
    duration: float,
    begins: np.ndarray,
    rng: np.random.Generator | None = None,
) -> list[int]:
    """Return consecutive moves without repetition: those with the most information per second, or
    random ones.
    """
    left = moves.allowed.copy()
    spent = 0.0
    walk = list[int]()
    known = worth.known([])
    here = begins
    while spent < duration and len(here):
        if rng is not None:
            e = int(rng.choice(here))
        else:
            e = int(
                here[0] if len(here) == 1 else here[np.argmax(_rates(moves, worth, here, known))]
            )
        left[e] = False
        spent = spent + moves.seconds[e]
        known = known + worth.H[e]
        walk.append(e)
        here = np.flatnonzero(left & (moves.first == moves.last[e]))
    return walk
