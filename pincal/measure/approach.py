"""Directions of approach and last moves of joints, by the order in which rows were measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pincal.errors import warn
from pincal.measure.reading_numbers import SAME_POSE
from pincal.thresholds import Scale

# Origin of directions that are given by columns.
BY_COLUMNS = "the columns approach_<joint>"
# A joint that moved by less stood still [rad, m]: rounding of the same position.
_STILL: Scale = 1e-9


def moves_by_order(q: np.ndarray) -> np.ndarray:
    """Return the signed last move of each joint, from the row before, 0 in the first row (unknown),
    shape (N, n).

    A joint that did not move keeps its last move, as where several targets are measured in one
    pose, and so do all joints of a pose that is read again, whatever the scatter of their encoders.
    Via points between rows are unknown here.

    Args:
        q: joint positions in the order of measurement [rad], prismatic [m], shape (N, n).

    Example:
        >>> moves_by_order(np.array([[0.0], [0.5], [0.5], [0.25]])).ravel()
        array([ 0.  ,  0.5 ,  0.5 , -0.25])
    """
    move = np.diff(q, axis=0, prepend=q[:1])
    moved = (np.abs(move) > _STILL) & (np.abs(move).max(axis=1, keepdims=True) > SAME_POSE.same)
    last = np.maximum.accumulate(np.where(moved, np.arange(len(q))[:, None], 0), axis=0)
    return np.take_along_axis(move, last, axis=0)


def sides_of(moves: np.ndarray) -> np.ndarray:
    """Return the signs of last moves, shape (N, n): -1, 0 (unknown, or small enough to be lost in
    backlash) or 1.

    Example:
        >>> sides_of(moves_by_order(np.array([[0.0], [0.5], [0.499995], [0.2], [0.2005]]))).ravel()
        array([ 0.,  1.,  1., -1.,  0.])
    """
    return np.where(np.abs(moves) >= SAME_POSE.play, np.sign(moves), 0.0)


def moves_of_table(
    q: np.ndarray, *, time: np.ndarray | None, station: np.ndarray | None
) -> np.ndarray:
    """Return the signed last move of each joint in the rows of a table, shape (N, n).

    Args:
        q: joint positions [rad], prismatic [m], shape (N, n).
        time: of the rows [s], shape (N,), which gives the order of measurement; None for the order
            of the rows.
        station: of the rows, shape (N,), each with its own order and zero of time; None for a
            single one.
    """
    order = np.arange(len(q)) if time is None else np.argsort(time, kind="stable")
    where = np.zeros(len(q), int) if station is None else np.unique(station, return_inverse=True)[1]
    moves = np.empty_like(q)
    for k in np.unique(where):
        own = order[where[order] == k]
        moves[own] = moves_by_order(q[own])
    return moves


def gives_order(time: np.ndarray | None, q: np.ndarray) -> bool:
    """Return whether times, shape (N,), give the order of the poses: no two different ones have the
    same time.
    """
    if time is None or not np.ptp(time):
        return False
    order = np.argsort(time, kind="stable")
    moved = np.abs(np.diff(q[order], axis=0)).max(axis=1) > _STILL
    return not np.any(moved & (np.diff(time[order]) == 0.0))


def completed(
    given: Mapping[str, np.ndarray],
    joints: Sequence[str],
    moves: np.ndarray,
    *,
    by_time: bool,
    source: str,
) -> tuple[dict[str, np.ndarray], str]:
    """Return the directions of approach by joint, shape (N,) each, and their origin in words.

    They are the given columns by joint, shape (N,) each, else the signs of the last moves, shape
    (N, n), by order or time.
    """
    origin = BY_COLUMNS
    if missing := [joint for joint in joints if joint not in given]:
        origin = (
            f"the sign of the move {'since the time before' if by_time else 'from the row before'}"
        )
        warn(f"{source}: the direction of approach of {', '.join(missing)} is {origin}")
        others = ", ".join(joint for joint in joints if joint in given)
        origin += f"; for {others} its column" if others else ""
    return dict(zip(joints, sides_of(moves).T, strict=True)) | dict(given), origin


def agreeing(
    moves: np.ndarray, sides: Mapping[str, np.ndarray], joints: Sequence[str]
) -> np.ndarray:
    """Return last moves, shape (N, n), set to 0 (unknown) for joints whose column contradicts their
    sign in some row.

    Such a joint passed a via point between rows.
    """
    found = moves.copy()
    for i, joint in enumerate(joints):
        if joint in sides and np.any(sides[joint] * sides_of(moves[:, i]) < 0.0):
            found[:, i] = 0.0
    return found


def note_on_sides(source: str, origin: str) -> str | None:
    """Return the report's note on the origin of directions of approach; None unless they follow
    from the order of rows.
    """
    return (
        f"{source}: the direction of approach is {origin}"
        if origin not in ("", BY_COLUMNS)
        else None
    )
