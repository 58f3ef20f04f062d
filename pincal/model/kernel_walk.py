"""Parts of the compiled loops: forward kinematics and carried masses of a group of poses.

Poses are processed in groups of LANES: the last axis of every working array runs over the poses of
a group, so that the compiler vectorises each inner loop (measured: 5 times faster than pose by
pose).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from pincal.thresholds import Count

# Poses processed together: fewer cost more in calls, more exceed a second-level cache of 512 KiB
# (6R arm).
LANES: Count = 64

# A quarter turn in three parts: its products with up to 2^24 quarter turns by the first two have no
# rounding, and the third is what no float of its size holds.
_QUARTER = float(np.float32(0.5 * math.pi))
_QUARTER_MORE = 0.5 * math.pi - _QUARTER
_QUARTER_REST = math.cos(0.5 * math.pi)

COMPILE = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}}
# Functions that are never called from C, or from Python, need no wrappers.
WHOLE = COMPILE | {"no_cfunc_wrapper": True}
INNER = WHOLE | {"no_cpython_wrapper": True}
# Functions called once, and short ones, compile faster inlined, without optimisation of their own.
PART = INNER | {"inline": "always"}


class Arms(NamedTuple):
    """Working arrays for the arms of a group of poses.

    Attributes:
        moves: shape (K,), whether a coordinate is other than zero at all poses.
        x, c, s: shape (K, lanes), coordinates, their cosines and sines.
        R, p: shape (3, 3, lanes), (3, lanes), the current frames.
        W, O: shape (K, 3, lanes), axis and origin of each coordinate.
    """

    moves: np.ndarray
    x: np.ndarray
    c: np.ndarray
    s: np.ndarray
    R: np.ndarray
    p: np.ndarray
    W: np.ndarray
    O: np.ndarray


class Loads(NamedTuple):
    """Working arrays for the loads of a group of poses.

    Attributes:
        M: shape (n, lanes), the mass beyond each joint.
        B: shape (n, 3, lanes), its sum of mass times centre.
        F: shape (4 n, 3, lanes), the link frames: the three rows of the rotation, then the origin;
            or empty.
        A, H: shape (3 n, 3, lanes), axis w_l of moment l and h_l = w_l x D_l.
        mass: shape (lanes,), of one body.
    """

    M: np.ndarray
    B: np.ndarray
    F: np.ndarray
    A: np.ndarray
    H: np.ndarray
    mass: np.ndarray


@njit(**INNER)
def room(a, b):
    """Allocate a x b rows of lanes. Each number of axes that is allocated takes half a second to
    compile.
    """
    return np.empty((a, b, LANES))


@njit(**INNER)
def room_for_arms(K):
    """Allocate the arrays for arms of K coordinates."""
    coordinates = np.zeros((3, K, LANES))
    return Arms(
        np.ones(K, np.bool_),
        coordinates[0],
        coordinates[1],
        coordinates[2],
        room(3, 3),
        room(1, 3)[0],
        room(K, 3),
        room(K, 3),
    )


@njit(**INNER)
def fill(out, value):
    """Out = value, for an array of one axis."""
    for i in range(LANES):
        out[i] = value


@njit(**INNER)
def copy_lanes(values, out):
    """Out = values, each of one axis. An assignment would check shapes, which takes seconds to
    compile.
    """
    for i in range(LANES):
        out[i] = values[i]


@njit(**INNER)
def copy_rows(values, out):
    """Out = values, each of two axes."""
    for r in range(len(out)):
        copy_lanes(values[r], out[r])


@njit(**INNER)
def add_lanes(values, out):
    """Out += values, each of one axis."""
    for i in range(LANES):
        out[i] += values[i]


@njit(**INNER)
def cosines_and_sines(x, c, s):
    """C = cos x, s = sin x, for angles x, shape (lanes,) [rad], to a unit in the last place of 1.

    The C library's functions take most of a walk, as the compiler cannot vectorise their calls.
    Within an eighth of a turn about the nearest quarter turn, Taylor series to x^15 and x^16 are as
    exact as numbers are.
    """
    for i in range(LANES):
        quarters = math.floor(x[i] * (2.0 / math.pi) + 0.5)
        beyond = x[i] - quarters * _QUARTER - quarters * _QUARTER_MORE - quarters * _QUARTER_REST
        z = beyond * beyond
        sine = -1 / 1307674368000 * z + 1 / 6227020800
        sine = sine * z - 1 / 39916800
        sine = sine * z + 1 / 362880
        sine = sine * z - 1 / 5040
        sine = sine * z + 1 / 120
        sine = sine * z - 1 / 6
        sine = sine * z * beyond + beyond
        cosine = 1 / 20922789888000 * z - 1 / 87178291200
        cosine = cosine * z + 1 / 479001600
        cosine = cosine * z - 1 / 3628800
        cosine = cosine * z + 1 / 40320
        cosine = cosine * z - 1 / 720
        cosine = cosine * z + 1 / 24
        cosine = cosine * z - 1 / 2
        cosine = cosine * z + 1
        quarter = quarters - 4.0 * math.floor(0.25 * quarters)
        is_across = quarter == 1.0 or quarter == 3.0
        along_x = sine if is_across else cosine
        along_y = cosine if is_across else sine
        c[i] = -along_x if quarter == 1.0 or quarter == 2.0 else along_x
        s[i] = -along_y if quarter >= 2.0 else along_y


@njit(**INNER)
def load_coordinates(kind, values, walked, span, whole, arms):
    """Load coordinates of a span of poses (start, number) into x, their cosines and sines into c
    and s.

    Constant coordinates, the same in every group, are loaded only if ``whole``.
    """
    start, m = span
    x = arms.x
    c = arms.c
    s = arms.s
    for k in walked:
        j = values.slot[k]
        if j >= 0:
            for i in range(m):
                x[k, i] = values.varying[j, start + i]
            if kind[k] < 3:
                cosines_and_sines(x[k], c[k], s[k])
        elif whole:
            arms.moves[k] = values.constant[k] != 0.0
            fill(x[k], values.constant[k])
            fill(c[k], math.cos(values.constant[k]))
            fill(s[k], math.sin(values.constant[k]))


@njit(**INNER)
def _identity(R, p):
    for r in range(3):
        fill(p[r], 0.0)
        for j in range(3):
            fill(R[r, j], 1.0 if j == r else 0.0)


@njit(**INNER)
def _apply(R, p, F):
    """Multiply the frames (R, p) by a fixed transform from the right."""
    for r in range(3):
        for i in range(LANES):
            a = R[r, 0, i]
            b = R[r, 1, i]
            d = R[r, 2, i]
            p[r, i] += a * F[0, 3] + b * F[1, 3] + d * F[2, 3]
            R[r, 0, i] = a * F[0, 0] + b * F[1, 0] + d * F[2, 0]
            R[r, 1, i] = a * F[0, 1] + b * F[1, 1] + d * F[2, 1]
            R[r, 2, i] = a * F[0, 2] + b * F[1, 2] + d * F[2, 2]


@njit(**INNER)
def _turn(rotations, index, span, R):
    """Rotate each frame by the reference orientation of its pose."""
    start, m = span
    if len(rotations) == 1:
        A = rotations[0]
        for r in range(3):
            for i in range(LANES):
                a = R[r, 0, i]
                b = R[r, 1, i]
                d = R[r, 2, i]
                R[r, 0, i] = a * A[0, 0] + b * A[1, 0] + d * A[2, 0]
                R[r, 1, i] = a * A[0, 1] + b * A[1, 1] + d * A[2, 1]
                R[r, 2, i] = a * A[0, 2] + b * A[1, 2] + d * A[2, 2]
        return
    for i in range(m):
        A = rotations[index[start + i]]
        for r in range(3):
            a = R[r, 0, i]
            b = R[r, 1, i]
            d = R[r, 2, i]
            for j in range(3):
                R[r, j, i] = a * A[0, j] + b * A[1, j] + d * A[2, j]


@njit(**INNER)
def _walk(layout, route, first, last, arms):
    """Move the frames (R, p) over the steps first .. last - 1 of a route; store each coordinate's
    axis and origin in W, O. Most coordinates of an arm are zero and move nothing.

    The axis of a coordinate traversed backwards is stored reversed.
    """
    moves, x, c, s, R, p, W, O = arms
    for t in range(first, last):
        k = route.coordinate[t]
        sign = route.sign[t]
        if route.fixed_before[t] >= 0:
            _apply(R, p, layout.fixed[route.fixed_before[t]])
        kind = layout.kind[k]
        axis = kind if kind < 3 else kind - 3
        j = (axis + 1) % 3
        l = (axis + 2) % 3
        for r in range(3):
            for i in range(LANES):
                W[k, r, i] = sign * R[r, axis, i]
                O[k, r, i] = p[r, i]
            if kind >= 3:
                if moves[k]:
                    for i in range(LANES):
                        p[r, i] += W[k, r, i] * x[k, i]
                if layout.less[k] >= 0:
                    for i in range(LANES):
                        p[r, i] -= W[k, r, i] * x[layout.less[k], i]
            elif moves[k]:
                for i in range(LANES):
                    a = R[r, j, i]
                    b = R[r, l, i]
                    sine = sign * s[k, i]
                    R[r, j, i] = c[k, i] * a + sine * b
                    R[r, l, i] = c[k, i] * b - sine * a


@njit(**PART)
def walk_arms(layout, places, span, arms):
    """Walk the path from instrument to target, with reference orientations before the angles of
    base and tool.
    """
    S = len(layout.path.coordinate)
    _identity(arms.R, arms.p)
    # A single call of _walk, with one type of bounds, as each call is inlined.
    for part in range(3):
        first = 3 * part if part < 2 else S - 3
        last = S - 3 if part == 1 else first + 3
        _walk(layout, layout.path, first, last, arms)
        if part == 0:
            _turn(layout.base_rotation, places.base, span, arms.R)
        elif part == 1:
            _turn(layout.tool_rotation, places.tool, span, arms.R)


@njit(**INNER)
def _add_body(R, p, mass, centre, B):
    """Add mass times the position of its centre to B."""
    for r in range(3):
        for i in range(LANES):
            place = (
                p[r, i] + R[r, 0, i] * centre[0] + R[r, 1, i] * centre[1] + R[r, 2, i] * centre[2]
            )
            B[r, i] += mass[i] * place


@njit(**INNER)
def is_branched(layout):
    """Return whether some joint does not carry the next, or the last one not the tip."""
    n = len(layout.parents)
    for j in range(n):
        if layout.parents[j] != j - 1:
            return True
    return layout.tip_joint != n - 1


@njit(**INNER)
def _return_to(F, j, R, p):
    """Set the frames (R, p) to the link frames of joint j, or to the base for -1."""
    if j < 0:
        _identity(R, p)
    else:
        for r in range(3):
            copy_rows(F[4 * j + r], R[r])
        copy_rows(F[4 * j + 3], p)


@njit(**PART)
def walk_bodies(layout, acting, payload, span, arms, loads):
    """Walk the tree from its base and sum the masses that each joint carries: M, B and, unless
    empty, F.
    """
    start, m = span
    R = arms.R
    p = arms.p
    M = loads.M
    B = loads.B
    F = loads.F
    mass = loads.mass
    here = -2
    for j in acting:
        if layout.parents[j] != here:
            _return_to(F, layout.parents[j], R, p)
        here = j
        _walk(layout, layout.tree, layout.starts[j], layout.starts[j + 1], arms)
        if len(F) > 0:
            for r in range(3):
                copy_rows(R[r], F[4 * j + r])
            copy_rows(p, F[4 * j + 3])
        fill(mass, layout.masses[j])
        fill(M[j], layout.masses[j])
        for r in range(3):
            fill(B[j, r], 0.0)
        _add_body(R, p, mass, layout.centres[j], B[j])
    tip = layout.tip_joint
    if tip >= 0:
        if tip != here:
            _return_to(F, tip, R, p)
        _apply(R, p, layout.fixed[layout.tip])
        fill(mass, 0.0)
        for i in range(m):
            mass[i] = payload.mass[start + i]
        add_lanes(mass, M[tip])
        _add_body(R, p, mass, payload.centre, B[tip])
    for j in acting[::-1]:
        parent = layout.parents[j]
        if parent >= 0:
            add_lanes(M[j], M[parent])
            for r in range(3):
                add_lanes(B[j, r], B[parent, r])


@njit(**INNER)
def cross(a, b, out):
    """Out = a x b, each of shape (3, lanes)."""
    for i in range(LANES):
        out[0, i] = a[1, i] * b[2, i] - a[2, i] * b[1, i]
        out[1, i] = a[2, i] * b[0, i] - a[0, i] * b[2, i]
        out[2, i] = a[0, i] * b[1, i] - a[1, i] * b[0, i]


@njit(**INNER)
def lever(B, M, o, D):
    """D = B - M o: first moment of the mass beyond, about the point o."""
    for r in range(3):
        for i in range(LANES):
            D[r, i] = B[r, i] - M[i] * o[r, i]


@njit(**PART)
def moment_point(layout, j, O):
    """Return the point about which the moments of joint j are taken, shape (3, lanes)."""
    return O[max(layout.moment_y[j], layout.moment_z[j])]


@njit(**PART)
def moment_levers(layout, bears, arms, loads, D):
    """Set A[l], H[l] of bearing joints: axis w_l of moment l and h_l = w_l x D_l; the moment itself
    is h_l . g.
    """
    W = arms.W
    A = loads.A
    H = loads.H
    for j in np.flatnonzero(bears):
        lever(loads.B[j], loads.M[j], moment_point(layout, j, arms.O), D)
        copy_rows(W[layout.moment_y[j]], A[3 * j + 1])
        copy_rows(W[layout.moment_z[j]], A[3 * j + 2])
        cross(A[3 * j + 1], A[3 * j + 2], A[3 * j])
        for q in range(3):
            cross(A[3 * j + q], D, H[3 * j + q])
