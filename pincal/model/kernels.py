r"""The compiled loops: tip poses, static moments and their exact derivatives, pose by pose in one
pass.

A chain is a sequence of elementary transforms, each with one scalar coordinate. With w_k and o_k
the axis and a point of coordinate k in the world, a rotation moves the tip p by w_k x (p - o_k) and
turns it by w_k; a translation moves it by w_k.

Moments: for the axis w_l and a point o_l on the joint's axis, with D_l the sum of m_b (c_b - o_l)
over the bodies b beyond, h_l = w_l x D_l and g the gravity, n_l = h_l . g (paper, Eq. (3)). With
u_k = g x w_k and M_k the mass beyond k,

    d n_l / d x_k = h_l . u_k           k a rotation before the frame of l
                  = h_k . u_l           k a rotation after it
                  = 0, M_k w_k . u_l    k a translation before, after it.

The Jacobian needs only sum_l a_l d n_l / d x_k, so two sums per joint suffice for all its k: of a_l
h_l over the moments of the joints that it carries, and of a_l u_l over those of the joints that
carry it. A moment of another branch does not depend on k. Checked against finite differences and
Pinocchio in ``tests/test_model.py``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from pincal.compiled import announce, compiled
from pincal.model.kernel_inputs import (
    Compliances,
    Layout,
    MassTerms,
    Payload,
    Places,
    Terms,
    Values,
    Wanted,
)
from pincal.model.kernel_walk import (
    INNER,
    LANES,
    PART,
    WHOLE,
    Loads,
    add_lanes,
    copy_lanes,
    copy_rows,
    cross,
    fill,
    is_branched,
    lever,
    load_coordinates,
    moment_levers,
    moment_point,
    room,
    room_for_arms,
    walk_arms,
    walk_bodies,
)

announce(__name__)


class _Motions(NamedTuple):
    """Working arrays for derivatives of the tip, in R rows.

    Attributes:
        J, V: shape (R, K, lanes), by coordinates, directly and through the moments.
        a0, a: shape (R, 3 n, lanes), by each moment, on the undeformed and on the deformed arm.
        ahead, behind: shape (R, 3 n, lanes), the sums of the module's docstring, for each joint.
        h, u: shape (3, lanes), temporary vectors.
        U, S: shape (3 n, lanes), (n, lanes), sums over the joints that carry each joint.
    """

    J: np.ndarray
    V: np.ndarray
    a0: np.ndarray
    a: np.ndarray
    ahead: np.ndarray
    behind: np.ndarray
    h: np.ndarray
    u: np.ndarray
    U: np.ndarray
    S: np.ndarray


@njit(**INNER)
def _turned_gravity(g, w, out):
    """Out = g x w."""
    for i in range(LANES):
        out[0, i] = g[1] * w[2, i] - g[2] * w[1, i]
        out[1, i] = g[2] * w[0, i] - g[0] * w[2, i]
        out[2, i] = g[0] * w[1, i] - g[1] * w[0, i]


@njit(**INNER)
def _add_scaled(a, v, out):
    """Out += a v, with a a number a lane and v of shape (3, lanes)."""
    for r in range(3):
        for i in range(LANES):
            out[r, i] += a[i] * v[r, i]


@njit(**INNER)
def _take_back(less, k, of_coordinates):
    """Subtract coordinate k from the one that it takes back, in an array over all coordinates in
    which both are set.
    """
    other = less[k]
    if other >= 0:
        for i in range(of_coordinates.shape[1]):
            of_coordinates[other, i] -= of_coordinates[k, i]


@njit(**INNER)
def _asked(layout, wanted):
    """Return which coordinates contribute to a column through the moments, shape (K,)."""
    asked = np.full(len(layout.kind), wanted.sweeps > 0)
    for e in range(len(wanted.terms.coordinate)):
        if not wanted.terms.elastic[e]:
            asked[wanted.terms.coordinate[e]] = True
    for k in range(len(asked)):
        if layout.less[k] >= 0 and asked[layout.less[k]]:
            asked[k] = True
    return asked


@njit(**PART)
def _through_moments(layout, acting, bears, asked, arms, loads, motions):
    """V[r, k] = sum over l of a[r, l] d n_l / d x_k, by two sums per joint (module docstring); a is
    0 unless bearing.
    """
    W = arms.W
    O = arms.O
    M = loads.M
    B = loads.B
    H = loads.H
    A = loads.A
    a = motions.a
    aheads = motions.ahead
    behinds = motions.behind
    h = motions.h
    u = motions.u
    V = motions.V
    rows = len(a)
    parents = layout.parents
    for r in range(rows):
        for j in acting:
            for l in range(3 * j, 3 * j + 3):
                fill(aheads[r, l], 0.0)
        for j in acting[::-1]:
            ahead = aheads[r, 3 * j : 3 * j + 3]
            if bears[j]:
                for l in range(3 * j, 3 * j + 3):
                    _add_scaled(a[r, l], H[l], ahead)
            if parents[j] >= 0:
                for q in range(3):
                    add_lanes(ahead[q], aheads[r, 3 * parents[j] + q])
    for j in acting:
        ahead = aheads[:, 3 * j : 3 * j + 3]
        behind = behinds[:, 3 * j : 3 * j + 3]
        for r in range(rows):
            for q in range(3):
                if parents[j] >= 0:
                    copy_lanes(behinds[r, 3 * parents[j] + q], behind[r, q])
                else:
                    fill(behind[r, q], 0.0)
        for k in range(layout.starts[j], layout.starts[j + 1]):
            if not asked[k]:
                pass
            elif layout.kind[k] < 3:
                lever(B[j], M[j], O[k], u)
                cross(W[k], u, h)
                _turned_gravity(layout.gravity, W[k], u)
                for r in range(rows):
                    for i in range(LANES):
                        before = (
                            ahead[r, 0, i] * u[0, i]
                            + ahead[r, 1, i] * u[1, i]
                            + ahead[r, 2, i] * u[2, i]
                        )
                        after = (
                            behind[r, 0, i] * h[0, i]
                            + behind[r, 1, i] * h[1, i]
                            + behind[r, 2, i] * h[2, i]
                        )
                        V[r, k, i] = before + after
            else:
                for r in range(rows):
                    for i in range(LANES):
                        along = behind[r, 0, i] * W[k, 0, i] + behind[r, 1, i] * W[k, 1, i]
                        V[r, k, i] = M[j, i] * (along + behind[r, 2, i] * W[k, 2, i])
            if bears[j] and k == layout.moment_cut[j]:
                for l in range(3 * j, 3 * j + 3):
                    _turned_gravity(layout.gravity, A[l], u)
                    for r in range(rows):
                        for q in range(3):
                            for i in range(LANES):
                                behind[r, q, i] += a[r, l, i] * u[q, i]
                                ahead[r, q, i] -= a[r, l, i] * H[l, q, i]
        for k in range(layout.starts[j], layout.starts[j + 1]):
            if asked[k]:
                for r in range(rows):
                    _take_back(layout.less, k, V[r])


@njit(**PART)
def _pull_back(compliances, span, J, a):
    """a[r, l] += sum over the coordinates k that depend on moment l of J[r, k] d x_k / d n_l."""
    start, m = span
    constant = compliances.rate.shape[1] == 1
    for e in range(len(compliances.coordinate)):
        k = compliances.coordinate[e]
        l = compliances.moment[e]
        for r in range(len(a)):
            if constant:
                for i in range(LANES):
                    a[r, l, i] += J[r, k, i] * compliances.rate[e, 0]
            else:
                for i in range(m):
                    a[r, l, i] += J[r, k, i] * compliances.rate[e, start + i]


@njit(**PART)
def _follow_moments(layout, acting, bears, asked, wanted, span, arms, loads, motions):
    """Set derivatives of the tip: V[:, k] by coordinate k through the moments, a[r, l]
    by moment l.
    """
    a0 = motions.a0
    a = motions.a
    for r in range(len(a)):
        for l in range(a.shape[1]):
            fill(a0[r, l], 0.0)
    moved = motions.J
    for sweep in range(wanted.sweeps + 1):
        for r in range(len(a)):
            copy_rows(a0[r], a[r])
        _pull_back(wanted.compliances, span, moved, a)
        _through_moments(layout, acting, bears, asked, arms, loads, motions)
        if sweep == 0:
            moved = motions.V
            for r in range(len(a)):
                copy_rows(a[r], a0[r])


@njit(**PART)
def _kinematic_columns(layout, arms, J):
    """Set J[:, k], translation (and rotation, with six rows) of the tip by coordinate k of the
    path.
    """
    W = arms.W
    O = arms.O
    p = arms.p
    rows = len(J)
    for k in layout.path.coordinate:
        if layout.kind[k] >= 3:
            for r in range(3):
                copy_lanes(W[k, r], J[r, k])
            for r in range(3, rows):
                fill(J[r, k], 0.0)
            continue
        for i in range(LANES):
            dx = p[0, i] - O[k, 0, i]
            dy = p[1, i] - O[k, 1, i]
            dz = p[2, i] - O[k, 2, i]
            J[0, k, i] = W[k, 1, i] * dz - W[k, 2, i] * dy
            J[1, k, i] = W[k, 2, i] * dx - W[k, 0, i] * dz
            J[2, k, i] = W[k, 0, i] * dy - W[k, 1, i] * dx
        for r in range(3, rows):
            copy_lanes(W[k, r - 3], J[r, k])
    for k in layout.path.coordinate:
        for r in range(3):
            _take_back(layout.less, k, J[r])


@njit(**PART)
def _parameter_columns(wanted, span, motions, out):
    """Add each term's share to its parameter's column; rigid terms also act through the moments."""
    start, m = span
    terms = wanted.terms
    J = motions.J
    V = motions.V
    for e in range(len(terms.coordinate)):
        k = terms.coordinate[e]
        q = terms.parameter[e]
        j = terms.slot[e]
        with_moments = len(wanted.compliances.coordinate) > 0 and (
            wanted.sweeps > 0 or not terms.elastic[e]
        )
        for r in range(len(J)):
            if j < 0:
                for i in range(m):
                    out[q, r, start + i] += J[r, k, i]
            else:
                for i in range(m):
                    out[q, r, start + i] += terms.basis[j, start + i] * J[r, k, i]
            if with_moments and j < 0:
                for i in range(m):
                    out[q, r, start + i] += V[r, k, i]
            elif with_moments:
                for i in range(m):
                    out[q, r, start + i] += terms.basis[j, start + i] * V[r, k, i]


@njit(**PART)
def _mass_columns(layout, acting, bears, masses, span, arms, loads, motions, out):
    """Set the columns of mass parameters, which act through the moments alone.

    A body of mass M and first moment H beyond joint j adds (M (p_j - o_l) + R_j H) . (g x w_l) to
    the moments n_l of joint j and of the joints that carry it; weighted with a_l these are sums
    over l of g x w_l, in U, and of o_l . (g x w_l), in S.
    """
    start, m = span
    F = loads.F
    a = motions.a
    u = motions.u
    for r in range(len(a)):
        for j in acting:
            U = motions.U[3 * j : 3 * j + 3]
            S = motions.S[j]
            parent = layout.parents[j]
            for q in range(3):
                if parent >= 0:
                    copy_lanes(motions.U[3 * parent + q], U[q])
                else:
                    fill(U[q], 0.0)
            if parent >= 0:
                copy_lanes(motions.S[parent], S)
            else:
                fill(S, 0.0)
            o = moment_point(layout, j, arms.O)
            for l in range(3 * j, 3 * j + 3 if bears[j] else 3 * j):
                _turned_gravity(layout.gravity, loads.A[l], u)
                _add_scaled(a[r, l], u, U)
                for i in range(m):
                    S[i] += a[r, l, i] * (o[0, i] * u[0, i] + o[1, i] * u[1, i] + o[2, i] * u[2, i])
            for e in range(len(masses.joint)):
                if masses.joint[e] != j:
                    continue
                column = out[masses.parameter[e], r]
                mass = masses.mass[e]
                H = masses.moment[e]
                for q in range(3):
                    for i in range(m):
                        turned = (
                            F[4 * j + q, 0, i] * H[0]
                            + F[4 * j + q, 1, i] * H[1]
                            + F[4 * j + q, 2, i] * H[2]
                        )
                        column[start + i] += U[q, i] * (mass * F[4 * j + 3, q, i] + turned)
                for i in range(m):
                    column[start + i] -= mass * S[i]


@njit(**PART)
def _note_poses(R, p, span, out):
    """Store the frames of a span of poses in out, shape (3, 4, N)."""
    start, m = span
    for r in range(3):
        for i in range(m):
            out[r, 0, start + i] = R[r, 0, i]
            out[r, 1, start + i] = R[r, 1, i]
            out[r, 2, start + i] = R[r, 2, i]
            out[r, 3, start + i] = p[r, i]


@njit(**PART)
def _note_moments(g, H, span, out):
    """Store the moments of a span of poses in out, shape (3 n, N)."""
    start, m = span
    for l in range(len(out)):
        for i in range(m):
            out[l, start + i] = H[l, 0, i] * g[0] + H[l, 1, i] * g[1] + H[l, 2, i] * g[2]


@compiled(**WHOLE)
def evaluate(layout, values, rigid, places, payload, wanted):
    """Return poses, static moments and columns as requested, in one loop, as each takes seconds to
    compile.

    Args:
        layout: the chain.
        values: coordinates of the deformed arm.
        rigid: coordinates for the moments.
        places: reference orientations; if empty, no poses are computed.
        payload: mass beyond the tip; if empty, no moments are computed.
        wanted: the columns.

    Returns:
        Poses, shape (3, 4, N), moments, shape (3 n, N), and columns, shape (P, rows, N); empty if
        not requested.
    """
    N = values.varying.shape[1]
    K = len(values.constant)
    n = len(layout.masses)
    rows = wanted.rows
    through = len(wanted.compliances.coordinate) > 0
    weighs = len(wanted.masses.joint) > 0
    posed = len(places.tool) > 0
    laden = len(payload.mass) > 0 and (through or rows == 0)
    acting = layout.acting
    bears = layout.bears
    tree = np.empty(K, np.int64)
    if (
        wanted.sweeps > 0
    ):  # On the deformed arm all moments deflect the path, as they affect each other.
        acting = np.arange(n)
        bears = np.ones(n, np.bool_)
    asked = _asked(layout, wanted)
    walked = 0
    for j in acting:
        for k in range(layout.starts[j], layout.starts[j + 1]):
            tree[walked] = k
            walked += 1
    arms = room_for_arms(K if posed else 0)
    bare = room_for_arms(K if laden else 0)
    frames = room(4 * n if weighs or is_branched(layout) else 0, 3)
    loads = Loads(
        room(1, n)[0],
        room(n, 3),
        frames,
        room(3 * n, 3),
        np.zeros((3 * n, 3, LANES)),
        room(1, 1)[0, 0],
    )
    motions = _Motions(
        np.zeros((rows, K, LANES)), np.zeros((rows, K, LANES)),
        room(rows, 3 * n), room(rows, 3 * n), room(rows, 3 * n), room(rows, 3 * n),
        room(1, 3)[0], room(1, 3)[0], room(1, 3 * n)[0], room(1, n)[0],
    )  # fmt: skip
    poses = np.empty((3, 4, N if posed else 0))
    columns = np.zeros((wanted.n_columns, rows, N))
    moments = np.empty((1, 3 * n, N if laden and rows == 0 else 0))[0]
    for start in range(0, N, LANES):
        span = start, min(LANES, N - start)
        if posed:
            load_coordinates(layout.kind, values, layout.path.coordinate, span, start == 0, arms)
            walk_arms(layout, places, span, arms)
            _note_poses(arms.R, arms.p, span, poses)
        if laden:
            load_coordinates(layout.kind, rigid, tree[:walked], span, start == 0, bare)
            walk_bodies(layout, acting, payload, span, bare, loads)
            moment_levers(layout, bears, bare, loads, motions.u)
        if rows == 0:
            if laden:
                _note_moments(layout.gravity, loads.H, span, moments)
            continue
        _kinematic_columns(layout, arms, motions.J)
        if through:
            _follow_moments(layout, acting, bears, asked, wanted, span, bare, loads, motions)
            if weighs:
                _mass_columns(
                    layout, acting, bears, wanted.masses, span, bare, loads, motions, columns
                )
        _parameter_columns(wanted, span, motions, columns)
    return poses, moments, columns


_NONE = np.empty(0, np.int64)
_NOWHERE = Places(_NONE, _NONE)
NO_LOAD = Payload(np.empty(0), np.zeros(3))
NOTHING = Wanted(
    Terms(_NONE, _NONE, _NONE, np.empty(0, bool), np.empty((0, 0))),
    Compliances(_NONE, _NONE, np.empty((0, 1))),
    MassTerms(_NONE, _NONE, np.empty(0), np.empty((0, 3))),
    n_columns=0,
    rows=0,
    sweeps=0,
)


def static_moments(
    layout: Layout, values: Values, payload: Payload, *, bending: bool = False
) -> np.ndarray:
    """Return the static moments, shape (3 n, N), components x, y, z of each joint [N m].

    For speed, with ``bending`` only the moments that deflect the path are valid.
    """
    if not bending:
        layout = layout._replace(
            acting=np.arange(len(layout.masses)), bears=np.ones(len(layout.masses), bool)
        )
    found = evaluate(layout, values, values, _NOWHERE, payload, NOTHING)
    return found[1]  # type: ignore[no-any-return]


def tip_poses(layout: Layout, values: Values, places: Places) -> np.ndarray:
    """Return the target's pose in the instrument's frame, shape (3, 4, N): rotation and
    translation.
    """
    found = evaluate(layout, values, values, places, NO_LOAD, NOTHING)
    return found[0]  # type: ignore[no-any-return]
