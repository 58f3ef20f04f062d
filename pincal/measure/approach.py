"""From which side joints arrived, where rows stand in the order in which they were measured."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence

import numpy as np

from pincal.errors import PincalWarning

# A joint that moved by less may still be on the side from which it came before [rad, m]: no robot's gear has as much play.
_LEAST = 1e-3
# How tables say where sides come from, if their own columns tell them.
BY_COLUMNS = "what the columns approach_<joint> say"
# One that moved by less stood still [rad, m].
_STILL = 1e-9


def sides_by_order(q: np.ndarray) -> np.ndarray:
    """Return the sign of each joint's last move, as the row before tells it, -1, 0 (unknown) or 1, shape (N, n).

    A joint that stands where it stood keeps its side, as where several targets are measured in one pose. The side of the
    first row is unknown, and so is that after a move that play may have swallowed. An arm that went by another pose on its
    way came from another side: the sign is a proxy, which no play is seen with if it tells nothing.

    Args:
        q: joint positions in the order of measurement [rad], prismatic [m], shape (N, n).

    Example:
        >>> sides_by_order(np.array([[0.0], [0.5], [0.5], [0.2], [0.2001]])).ravel()
        array([ 0.,  1.,  1., -1.,  0.])
    """
    move = np.diff(q, axis=0, prepend=q[:1])
    sides = np.where(np.abs(move) >= _LEAST, np.sign(move), 0.0)
    moved = np.abs(move) > _STILL
    last = np.maximum.accumulate(np.where(moved, np.arange(len(q))[:, None], 0), axis=0)
    return np.take_along_axis(sides, last, axis=0)


def completed(
    given: Mapping[str, np.ndarray],
    joints: Sequence[str],
    q: np.ndarray,
    *,
    time: np.ndarray | None,
    station: np.ndarray | None,
    source: str,
) -> tuple[dict[str, np.ndarray], str]:
    """Return the sides of all joints: those of their columns, and of the others by the order of the rows.

    Args:
        given: the columns that there are, shape (N,) each, by joint.
        joints: the n joints.
        q: their positions, shape (N, n).
        time: of the rows [s], shape (N,), which then says the order, as of poses that were measured again and put back in
            their place; None if unknown.
        station: of the rows, shape (N,), each with an order and a zero of time of its own; None for one.
        source: the table's name.

    Returns:
        Sides by joint, shape (N,) each, and where they come from, in words.
    """
    order = np.arange(len(q)) if time is None else np.argsort(time, kind="stable")
    where = np.zeros(len(q), int) if station is None else np.unique(station, return_inverse=True)[1]
    sides = np.empty_like(q)
    for k in np.unique(where):
        own = order[where[order] == k]
        sides[own] = sides_by_order(q[own])
    origin = BY_COLUMNS
    if missing := [joint for joint in joints if joint not in given]:
        origin = f"the sign of the move {'from the row before' if time is None else 'since the time before'}"
        text = f"{source}: the side from which {', '.join(missing)} arrived is {origin}"
        warnings.warn(text, PincalWarning, stacklevel=2)
        others = ", ".join(joint for joint in joints if joint in given)
        origin += f"; of {others} what columns say" if others else ""
    return dict(zip(joints, sides.T, strict=True)) | dict(given), origin


def note_on_sides(source: str, origin: str) -> str | None:
    """Return what a report says of where sides come from, given that in words; None where there are no guesses."""
    guessed = origin and origin != BY_COLUMNS
    return f"{source}: the side from which joints arrived is {origin}" if guessed else None
