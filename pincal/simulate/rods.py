"""Loops of the true machine: positions of the passive joints, which their pins move.

Passive joints are where the two halves of each pin meet as closely as possible (least squares): as
balls or hinges with the play that geometric errors require.
"""

from __future__ import annotations

import numpy as np

from pincal.simulate.arm import Arm, frames

# Weight of a tilt of a hinge against a gap [m].
_TILT = 0.1
# Fraction of the largest motion below which joints can't close a gap.
_USELESS = 1e-4
# Steps to close a loop, the change at which it is closed [rad or m], that after all steps above
# which it stays open, and the largest remaining gap [m].
_STEPS = 20
_CLOSED = 1e-13
_SETTLED = 1e-6
_GAP = 0.02
# Largest continuation step of the drives [rad or m].
_LED = 0.2


def following(arm: Arm, q: np.ndarray, *, near: np.ndarray | None = None) -> np.ndarray:
    """Return joint positions, shape (N, n), with mimic and passive joints set; NaN where loops stay
    open.

    Loops are closed from where they are closed at ``near``, shape (N, n); None: at position 0.
    """
    out = arm.mimicking(q)
    return closed(arm, out, near) if arm.pins else out


def driving(arm: Arm, joint_frames: np.ndarray) -> np.ndarray:
    """Return the derivatives of all joints by the driven ones, shape (n, m) or (N, n, m), at frames
    of the arm.
    """
    if not arm.pins:
        return arm.mimicry
    moves = np.tile(arm.mimicry, (len(joint_frames), 1, 1))
    moves[:, arm.passive] = rates(arm, joint_frames[:, 1:-1], joint_frames[:, :-1]) @ arm.mimicry
    own = [
        k for k in range(moves.shape[2]) if np.flatnonzero(arm.mimicry[:, k])[0] not in arm.passive
    ]
    return moves[..., own]


def closed(arm: Arm, q: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
    """Return joint positions, shape (N, n), with the passive joints where the loops of an
    undeformed arm close.

    They are continued from positions ``near`` where loops are closed, by default 0 of all drives,
    so that the loops keep their assembly mode. They are NaN where loops stay open, and where a
    drive has no position.
    """
    begin = np.zeros_like(q) if near is None else near
    drives = [i for i in range(len(arm.names)) if i not in arm.passive]
    is_placed = np.isfinite(q[:, drives]).all(axis=1)
    found = np.full_like(q, np.nan)
    found[is_placed] = _continued(arm, begin[is_placed], q[is_placed], drives)
    return found


def _continued(arm: Arm, begin: np.ndarray, q: np.ndarray, drives: list[int]) -> np.ndarray:
    """Return :func:`closed` of positions q from positions ``begin``, of which all drives have
    one.
    """
    found = begin.copy()
    way = q[:, drives] - begin[:, drives]
    steps = max(int(np.ceil(np.abs(way).max(initial=0.0) / _LED)), 1)
    for part in np.arange(0, steps + 1) / steps:
        found[:, drives] = begin[:, drives] + part * way
        _close(arm, found)
    found[np.isnan(found).any(axis=1)] = np.nan
    return found


def _close(arm: Arm, q: np.ndarray) -> None:
    """Move the passive joints of positions q, shape (N, n), to where the loops close, or to NaN
    where they stay open; leave out rows that are NaN.
    """
    left = np.flatnonzero(np.isfinite(q).all(axis=1))
    is_open = np.zeros(len(q), bool)
    passive = np.array(arm.passive)
    for _ in range(_STEPS):
        if len(left) == 0:
            break
        places = frames(arm, q[left])[:, :-1]
        step, gap = closing_step(arm, places[:, 1:], places)
        q[np.ix_(left, passive)] += step
        moved = np.abs(step).max(axis=1, initial=0.0)
        is_open[left] = (gap > _GAP) | (moved > _SETTLED)
        left = left[moved >= _CLOSED]
    q[np.ix_(is_open, passive)] = np.nan


def closing_step(arm: Arm, axes: np.ndarray, links: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the step of the passive joints that closes the loops, shape (N, p), and the largest
    gap, shape (N,) [m].

    ``axes`` are frames with z along the joint axes, shape (N, n, 4, 4), ``links`` the frames of
    base and links, shape (N, n + 1, 4, 4).
    """
    missing, J = _gaps(arm, axes, links)
    step = -(np.linalg.pinv(J[..., arm.passive], rcond=_USELESS) @ missing[..., None])[..., 0]
    return step, np.abs(missing).max(axis=1, initial=0.0)


def rates(arm: Arm, axes: np.ndarray, links: np.ndarray) -> np.ndarray:
    """Return derivatives of the passive joints by all others, shape (N, p, n); frames as in
    :func:`closing_step`.
    """
    _, J = _gaps(arm, axes, links)
    followed = -np.linalg.pinv(J[..., arm.passive], rcond=_USELESS) @ J
    followed[..., arm.passive] = 0.0
    return np.asarray(followed)


def _gaps(arm: Arm, axes: np.ndarray, links: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return gaps and tilts of all pins, shape (N, m), and their derivatives by the joints, shape
    (N, m, n).
    """
    w = axes[..., :3, 2]
    o = axes[..., :3, 3]
    missing = []
    derivatives = []
    for pin in arm.pins:
        halves = [
            links[:, joint + 1] @ place for joint, place in zip(pin.joints, pin.places, strict=True)
        ]
        moves = []
        turns = []
        for half, joint in zip(halves, pin.joints, strict=True):
            carried = arm.carried[:, joint] if joint >= 0 else np.zeros(len(arm.names), bool)
            turning = np.where(arm.prismatic[:, None], 0.0, np.cross(w, half[:, None, :3, 2]))
            moving = np.where(arm.prismatic[:, None], w, np.cross(w, half[:, None, :3, 3] - o))
            moves.append(carried[:, None] * moving)
            turns.append(carried[:, None] * turning)
        missing.append(halves[1][:, :3, 3] - halves[0][:, :3, 3])
        derivatives.append(moves[1] - moves[0])
        if pin.has_axis:
            a, b = (half[:, :3, 2] for half in halves)
            missing.append(_TILT * np.cross(a, b))
            derivatives.append(
                _TILT * (np.cross(a[:, None], turns[1]) + np.cross(turns[0], b[:, None]))
            )
    return np.concatenate(missing, axis=1), np.concatenate(derivatives, axis=2).swapaxes(1, 2)
