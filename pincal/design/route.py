"""In which order to measure poses: short ways from one to the next."""

from __future__ import annotations

import numpy as np

# Rounds of improvement after which an order is good enough; each mends every crossing that it finds.
_ROUNDS = 50


def travel(q: np.ndarray, spans: np.ndarray) -> np.ndarray:
    """Return how far apart poses q, shape (N, n), are: the largest joint step relative to the joint's range, shape (N, N).

    The slowest joint decides; ``spans``, shape (n,), are the ranges of the joints.
    """
    scaled = q / spans
    return np.asarray(np.abs(scaled[:, None] - scaled[None]).max(axis=2))


def short_route(distances: np.ndarray, first: int = 0) -> np.ndarray:
    """Return an order of N places with a short open way: nearest neighbour, then reversals of stretches (2-opt; Croes 1958).

    ``distances`` is symmetric, shape (N, N); the order, shape (N,), begins with ``first``.
    """
    places, left = [first], np.ones(len(distances), bool)
    left[first] = False
    while left.any():
        places.append(int(np.argmin(np.where(left, distances[places[-1]], np.inf))))
        left[places[-1]] = False
    order = np.array(places)
    for _ in range(_ROUNDS):
        if not _reverse_stretches(order, distances):
            break
    return order


def order_by_load(
    q: np.ndarray, payload: np.ndarray, joint_range: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, float, float]:
    """Return an order of short ways through poses, load by load, and the length of the way before and after.

    ``q`` has shape (N, n), ``payload`` (N,); the least and largest joint positions have shape (n,) each.
    """
    lower, upper = joint_range
    distances = travel(q, upper - lower)
    from_middle = np.abs((q - 0.5 * (lower + upper)) / (upper - lower)).max(axis=1)
    order: list[int] = []
    for load in np.unique(payload):
        rows = np.flatnonzero(payload == load)
        start = distances[order[-1], rows] if order else from_middle[rows]
        order += rows[short_route(distances[np.ix_(rows, rows)], int(np.argmin(start)))].tolist()
    found = np.array(order)
    return found, length(distances, np.arange(len(found))), length(distances, found)


def length(distances: np.ndarray, order: np.ndarray) -> float:
    """Return the length of the way through places in an order."""
    return float(distances[order[:-1], order[1:]].sum())


def _reverse_stretches(order: np.ndarray, d: np.ndarray) -> bool:
    """Reverse each stretch of the order, in place, that makes the way shorter; return whether there was one."""
    n, found = len(order), False
    for i in range(1, n - 1):
        # Stretch i..k: the edge into it and the edge out of it change; after the last place there is none.
        before, inside, ends = order[i - 1], order[i], order[i + 1 :]
        after = np.append(order[i + 2 :], -1)
        out_now = np.where(after < 0, 0.0, d[ends, after])
        out_then = np.where(after < 0, 0.0, d[inside, after])
        gain = d[before, inside] + out_now - d[before, ends] - out_then
        k = int(np.argmax(gain))
        if gain[k] > 1e-12:
            order[i : i + 2 + k] = order[i : i + 2 + k][::-1].copy()
            found = True
    return found
