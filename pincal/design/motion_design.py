r"""Which motion to drive before an IMU: moves from pose to pose, chosen for what they tell in the time that they take.

Between some poses that keep to all constraints lie all moves from one to another; each stops at its ends and is a polynomial
of degree 5 in time, as fast as limits of speed and acceleration allow. A tour that has each of them once is one motion of
the arm, whose rows before an IMU give the information :math:`H_e` of each move e on the parameters. From pose to pose that
move is taken whose decrease of the predicted error a second is largest,

.. math:: \big( \mathrm{tr}(W H^{-1}) - \mathrm{tr}(W (H + H_e)^{-1}) \big) / T_e ,

with W the mean squared error of the tool over random poses, base and tool placed. A controller need not follow the same law
of time: a calibration takes the joints as they were logged.
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

# Poses between which moves are chosen; a prime number, for the tour.
_POSES = 31
# Largest speed and acceleration of a polynomial of degree 5 from rest to rest, for a move of 1 in a time of 1.
_SPEED, _ACCELERATION = 15.0 / 8.0, 10.0 / 3.0**0.5
# Poses of a move that have to keep to the constraints, its ends left out.
_WITHIN = 9
# Positions a second through which the tour's spline goes, and its knots a second.
_RATE, _KNOTS = 100.0, 16.0
# Poses from which a motion may begin.
_STARTS = 8
# Random motions of the same length, whose median the chosen one is compared with.
_RANDOM = 10
# Poses over which errors are averaged; numbers of poses of an instrument, and random sets of each.
_CARED, _NUMBERS, _SETS = 200, (3, 4, 6, 8, 10, 12, 15, 20, 30, 40, 60), 8


@dataclass(frozen=True, eq=False, repr=False)
class MotionDesign:
    """A motion to be driven before an IMU, and what it promises.

    Attributes:
        robot: the arm.
        time: when each of V poses is reached, shape (V,) [s].
        q: the poses, at which the arm stands for a moment, shape (V, n) [rad or m].
        drawn: the poses between which moves were chosen, and what the constraints removed.
        before: predicted error of the tool over random poses, base and tool placed, root mean square, by what an IMU tells
            of the arm, as the priors have it [m].
        error: the same after this motion.
        random: the same after a random motion as long, the median of ten.
        lengths: predicted error by the lengths, which an IMU does not tell [m].
        needed: number of random poses before an instrument that reads positions -> root mean square error predicted by these
            alone, and with the motion [m].
        noise: of a component of the IMU's rows [m/s^2, rad/s], and of a position [m].
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
            "candidates": {"found": len(self.drawn.q), "drawn": self.drawn.drawn, "removed": self.drawn.removed},
            "error_rms_mm": {"nominal": 1e3 * self.before, "designed": 1e3 * self.error, "random_median": 1e3 * self.random},
            "error_by_lengths_rms_mm": 1e3 * self.lengths,
            "needed": [
                {"poses": n, "alone_mm": 1e3 * alone, "with_motion_mm": 1e3 * both}
                for n, (alone, both) in self.needed.items()
            ],
        }


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
    """Choose a motion by which an IMU on the tool tells most of an arm.

    Args:
        robot: the arm.
        duration: of the motion, to the end of the move in which it is over [s].
        options: as for the calibration: effects, and noise of the positions that an instrument would read beside it.
        speed: largest speed of a joint [rad/s], of one that slides half as much [m/s]; the URDF's limit where that is less.
        acceleration: likewise [rad/s^2].
        limits: where the arm may go.
        seed: of all random numbers.

    Raises:
        BadInputError: for a duration, speed or acceleration that can't be, or constraints that leave no motion.

    Example:
        >>> found = design_motion(Robot.from_urdf("ur5"), 20.0)  # doctest: +SKIP
        >>> found.error < found.before, float(found.time[0])  # doctest: +SKIP
        (True, 0.0)
    """
    for name, given, unit in (
        ("duration", duration, "s"),
        ("speed", speed, "rad/s"),
        ("acceleration", acceleration, "rad/s^2"),
    ):
        if not 0.0 < given < np.inf:
            raise BadInputError(f"{name} {given:g} {unit}; expected more than 0")
    rng = np.random.default_rng(seed)
    options = Options() if options is None else options
    reach = Reach(robot, SensorSetup(), limits or Limits())
    drawn = reach.draw(_POSES, rng)
    if len(drawn.q) < _POSES:
        raise BadInputError(f"constraints leave {len(drawn.q)} poses to move between; expected {_POSES}: {drawn.in_words()}")
    moves = _Moves.of(reach, drawn.q, speed, acceleration)
    if not moves.allowed.any():
        raise BadInputError("constraints leave no move between any two poses; expected a wider floor, box or span")
    cared = Conditions.at(robot.random_configurations(_CARED, rng))
    design = DesignModel.of(robot, cared, options, SensorSetup())
    worth = _worth(robot, moves, options, design, cared)
    walk = _best_walk(moves, worth, duration)
    at_random = [_walk(moves, worth, duration, np.flatnonzero(moves.allowed), rng) for _ in range(_RANDOM)]
    known = np.eye(design.n_free)
    at = np.flatnonzero(design.has_prior)[worth.told]
    known[np.ix_(at, at)] = covariance(covariance(worth.known(walk))[np.ix_(worth.columns, worth.columns)])
    needed = {}
    for poses in _NUMBERS:
        sets = [Conditions.at(robot.random_configurations(poses, rng)) for _ in range(_SETS)]
        both = [[one.foreseen(measured, cared) for one in (design, replace(design, known=known))] for measured in sets]
        needed[poses] = tuple(np.median(both, axis=0).tolist())
    times = np.array([0.0, *accumulate(moves.seconds[walk].tolist())])
    if times[-1] < duration:
        warn(
            f"the motion ends after {times[-1]:.0f} s of {duration:.0f} s: no further move is left between these {_POSES} "
            "poses; expected fewer constraints or less time"
        )
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


@dataclass(frozen=True, eq=False)
class _Moves:
    """The moves of a tour through all pairs of poses, in its order.

    Attributes:
        q: poses, shape (M, n).
        first, last: shape (E,), the poses where each move begins and ends.
        seconds: shape (E,), the time that each takes.
        allowed: shape (E,), whether the constraints are kept on the way.
    """

    q: np.ndarray
    first: np.ndarray
    last: np.ndarray
    seconds: np.ndarray
    allowed: np.ndarray

    @classmethod
    def of(cls, reach: Reach, q: np.ndarray, speed: float, acceleration: float) -> _Moves:
        """Return the tour: of a prime number of poses, steps of 1, 2, ... from pose to pose each come back to the first."""
        M = len(q)
        first = np.array([step * k % M for step in range(1, M) for k in range(M)])
        last = np.roll(first, -1)
        size = np.where([kind == "prismatic" for kind in reach.robot.joint_types], 0.5, 1.0)
        fastest = np.minimum(size * speed, _speed_limits(reach.robot))
        way = np.abs(q[last] - q[first])
        seconds = np.maximum(_SPEED * way / fastest, np.sqrt(_ACCELERATION * way / (size * acceleration))).max(axis=1)
        parts = np.arange(1, _WITHIN + 1) / (_WITHIN + 1)
        within = (q[first][:, None] + parts[:, None] * (q[last] - q[first])[:, None]).reshape(len(first) * _WITHIN, -1)
        within = reach.robot.following(within)
        allowed = reach.allows_apart(within)
        allowed[allowed] = ~reach.collides(within[allowed])
        return cls(q, first, last, seconds, np.asarray(np.all(allowed.reshape(-1, _WITHIN), axis=1)))

    def path(self) -> JointPath:
        """Return the whole tour in time."""
        ends = np.cumsum(self.seconds)
        time = np.arange(0.0, ends[-1], 1.0 / _RATE)
        move = np.minimum(np.searchsorted(ends, time, side="right"), len(ends) - 1)
        part = np.clip((time - ends[move] + self.seconds[move]) / self.seconds[move], 0.0, 1.0)
        share = (part**3 * (10.0 - 15.0 * part + 6.0 * part**2))[:, None]
        begins, finishes = self.q[self.first[move]], self.q[self.last[move]]
        return JointPath.through(time, begins + share * (finishes - begins), knots_per_second=_KNOTS)


def _speed_limits(robot: Robot) -> np.ndarray:
    """Return the largest speeds of the joints by the URDF, shape (n,) [rad/s or m/s]; inf where it has none."""
    model = robot.pinocchio_model()
    found = np.array([model.velocityLimit[model.joints[model.getJointId(name)].idx_v] for name in robot.joint_names])
    return np.where(found > 0.0, found, np.inf)


@dataclass(frozen=True, eq=False)
class _Worth:
    """What moves are worth, for the F parameters of arm and IMU that a fit by the IMU alone releases, in units of priors.

    Attributes:
        W: shape (F, F) [m^2], squared error of the tool by these, base and tool placed.
        H: shape (E, F, F), information of each move.
        columns: where the arm's parameters on which a position depends, too, stand among the F.
        told: which of the own parameters of a model of positions these are.
        lengths: squared error by the priors of the others, which an IMU does not tell [m^2].
        noise: of a component of the IMU's rows [m/s^2, rad/s].
    """

    W: np.ndarray
    H: np.ndarray
    columns: np.ndarray
    told: np.ndarray
    lengths: float
    noise: tuple[float, ...]

    def known(self, walk: Sequence[int]) -> np.ndarray:
        """Return the information after some moves, that of the priors among it, shape (F, F)."""
        return np.asarray(np.eye(len(self.W)) + self.H[list(walk)].sum(axis=0))

    def error(self, walk: Sequence[int]) -> float:
        """Return the predicted error of the tool after some moves by what an IMU tells [m]."""
        return float(np.sqrt(value(covariance(self.known(walk)), self.W)))


def _worth(robot: Robot, moves: _Moves, options: Options, design: DesignModel, cared: Conditions) -> _Worth:
    """Return what moves are worth to a fit."""
    ends = np.cumsum(moves.seconds)
    table = ideal_imu_table(MovingArm(robot, moves.path()))
    # Noise of an instrument beside it is none of the IMU's.
    ((station, values),) = place(robot, {"": table}, replace(options, sigma=None, sigma_orientation=None))
    problem = Problem((station,))
    # As in a fit by an IMU alone, lengths stay.
    free = released_of(problem, options)
    sizes = priors_of(problem, options).sizes[free]
    names = [p.name for p, is_free in zip(station.parameters, free, strict=True) if is_free]
    told = np.array([name in names for name in design.own_names])
    columns = np.array([names.index(name) for name in np.array(design.own_names)[told]])
    units = np.where(np.isfinite(sizes), sizes, 1.0)
    units[columns] = design.units[design.has_prior][told]
    noise = np.repeat([block.noise for block in station.sensor.blocks], station.block_sizes)
    assert table.time is not None
    move = np.minimum(np.searchsorted(ends, table.time), len(ends) - 1)
    H = np.zeros((len(ends), len(units), len(units)))
    for rows, _, jacobian in station.linearise(values, free):
        A = jacobian.transpose(2, 1, 0) * (units / noise[:, None])
        for e in np.unique(move[rows]):
            part = A[move[rows] == e].reshape(-1, len(units))
            H[e] += part.T @ part
    J, W = design.placed_errors(cared), np.zeros_like(H[0])
    W[np.ix_(columns, columns)] = J[:, told].T @ J[:, told] / len(cared.q)
    lengths = float(np.sum(J[:, ~told] ** 2)) / len(cared.q)
    return _Worth(W, H, columns, told, lengths, tuple(block.noise for block in station.sensor.blocks))


def _best_walk(moves: _Moves, worth: _Worth, duration: float) -> list[int]:
    """Return the best of some walks, each from another pose and by the moves that tell most a second."""
    begins = np.flatnonzero(moves.allowed)
    begins = begins[np.argsort(-_rates(moves, worth, begins, worth.known([])))]
    _, at = np.unique(moves.first[begins], return_index=True)
    walks = [_walk(moves, worth, duration, begins[[k]]) for k in np.sort(at)[:_STARTS]]
    return min(walks, key=worth.error)


def _rates(moves: _Moves, worth: _Worth, which: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return by how much moves lower the squared error a second, shape (n,), where there is information known."""
    after = np.array([value(C, worth.W) for C in np.linalg.inv(known + worth.H[which])])
    return np.asarray((value(covariance(known), worth.W) - after) / moves.seconds[which])


def _walk(
    moves: _Moves, worth: _Worth, duration: float, begins: np.ndarray, rng: np.random.Generator | None = None
) -> list[int]:
    """Return moves that follow each other, none twice: those that tell most a second, or random ones."""
    left, spent, walk, known, here = moves.allowed.copy(), 0.0, list[int](), worth.known([]), begins
    while spent < duration and len(here):
        if rng is not None:
            e = int(rng.choice(here))
        else:
            e = int(here[0] if len(here) == 1 else here[np.argmax(_rates(moves, worth, here, known))])
        left[e], spent, known = False, spent + moves.seconds[e], known + worth.H[e]
        walk.append(e)
        here = np.flatnonzero(left & (moves.first == moves.last[e]))
    return walk
