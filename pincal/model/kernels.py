r"""The compiled loops: tip poses, static moments and their exact derivatives, pose by pose in one pass.

A chain is a sequence of elementary transforms, each with one scalar coordinate. With w_k and o_k the axis and a point of
coordinate k in the world, a rotation moves the tip p by w_k x (p - o_k) and turns it by w_k; a translation moves it by w_k.

Moments: for the axis w_l and a point o_l on the joint's axis, with D_l the sum of m_b (c_b - o_l) over the bodies b beyond,
h_l = w_l x D_l and g the gravity, n_l = h_l . g (paper, Eq. (3)). With u_k = g x w_k and M_k the mass beyond k,

    d n_l / d x_k = h_l . u_k           k a rotation before the frame of l
                  = h_k . u_l           k a rotation after it
                  = 0, M_k w_k . u_l    k a translation before, after it.

The Jacobian needs only sum_l a_l d n_l / d x_k, so two running sums serve all k: of a_l h_l over the moments still ahead and
of a_l u_l over those passed. Checked against finite differences and Pinocchio in ``tests/test_model.py``.

Poses are worked on in groups of LANES: the last axis of every working array runs over the poses of a group, so that each
inner loop is one that the compiler turns into vector instructions (measured: 5 times faster than pose by pose).
"""

from __future__ import annotations

import gc
import logging
import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numba.core import event

from pincal.compiled import compiled

log = logging.getLogger(__name__)

# Coordinates a joint, a frame (base or tool).
BLOCK = 10
FRAME = 6
# Poses worked on together: fewer cost more in calls, more outgrow a second-level cache of 512 KiB (6R arm).
LANES = 64


class Layout(NamedTuple):
    """The constant part of a chain as arrays.

    Attributes:
        kind: shape (K,), 0, 1, 2 for rotations about x, y, z and 3, 4, 5 for translations along them.
        less: shape (K,), an earlier coordinate whose translation coordinate k takes back, -1 for none.
        fixed_before: shape (K,), index of the fixed transform that precedes coordinate k, -1 for none.
        fixed: shape (F, 3, 4), the fixed transforms.
        base_rotation: shape (set-ups, 3, 3), reference orientation of the base in each instrument's frame.
        tool_rotation: shape (tools, 3, 3), reference orientation of each tool frame.
        moment_y, moment_z: shape (n,), coordinates whose axes are y and z of the frame that joint i's moment is
            expressed in; it is taken about the origin of the later one.
        moment_cut: shape (n,), the last coordinate that turns or moves this frame.
        masses, centres: shape (n,), (n, 3), the bodies in the link frames.
        gravity: shape (3,), in the robot's base frame.
    """

    kind: np.ndarray
    less: np.ndarray
    fixed_before: np.ndarray
    fixed: np.ndarray
    base_rotation: np.ndarray
    tool_rotation: np.ndarray
    moment_y: np.ndarray
    moment_z: np.ndarray
    moment_cut: np.ndarray
    masses: np.ndarray
    centres: np.ndarray
    gravity: np.ndarray


class Values(NamedTuple):
    """Values of all coordinates at all poses: a constant part and the columns that differ from pose to pose.

    Attributes:
        constant: shape (K,), coordinates [rad or m].
        slot: shape (K,), column of ``varying`` that coordinate k takes its value from, -1 for the constant.
        varying: shape (V, N).
    """

    constant: np.ndarray
    slot: np.ndarray
    varying: np.ndarray


class Terms(NamedTuple):
    """Which parameter moves which coordinate, as a list of terms: d x_k / d parameter = basis.

    Attributes:
        coordinate, parameter: shape (E,).
        slot: shape (E,), column of ``basis``, -1 where the derivative is 1.
        elastic: shape (E,), whether the term depends on the static moments.
        basis: shape (S, N).
    """

    coordinate: np.ndarray
    parameter: np.ndarray
    slot: np.ndarray
    elastic: np.ndarray
    basis: np.ndarray


class Compliances(NamedTuple):
    """How coordinates follow the moments: d x_k / d n_l.

    Attributes:
        coordinate, moment: shape (C,), k and l = 3 i + component of joint i.
        rate: shape (C, N), or (C, 1) where it is the same at all poses [rad/(N m) or m/(N m)].
    """

    coordinate: np.ndarray
    moment: np.ndarray
    rate: np.ndarray


class Bodies(NamedTuple):
    """What parameters add to the masses beyond joints.

    Attributes:
        joint, parameter: shape (E,), the link that an entry belongs to, and the parameter's column.
        mass: shape (E,), by one unit of the parameter [kg].
        moment: shape (E, 3), first moment of mass in the link frame by one unit [kg m].
    """

    joint: np.ndarray
    parameter: np.ndarray
    mass: np.ndarray
    moment: np.ndarray


class Places(NamedTuple):
    """Which reference orientations hold at each pose: of the base, and of the tool; both of shape (N,)."""

    base: np.ndarray
    tool: np.ndarray


class Payload(NamedTuple):
    """Mass [kg], shape (N,), and centre of mass in the tip frame [m], shape (3,), beyond the last link."""

    mass: np.ndarray
    centre: np.ndarray


class _Compiling(event.Listener):
    """Says once that the loops are being compiled, which keeps the first command on a machine waiting.

    What the compiler builds lives until it is done: looking through it for garbage would take a sixth of the time.
    """

    def __init__(self) -> None:
        self._is_due, self._depth, self._collects = True, 0, False

    def on_start(self, event: event.Event) -> None:
        """Say so at the first of the loops, and keep what is built."""
        if not _is_ours(event):
            return
        if self._is_due:
            self._is_due = False
            log.info("compiling once for this machine, about 10 s")
        if not self._depth:
            self._collects = gc.isenabled()
            gc.disable()
        self._depth += 1

    def on_end(self, event: event.Event) -> None:
        """Collect garbage again after the last one."""
        if _is_ours(event):
            self._depth -= 1
            if not self._depth and self._collects:
                gc.enable()


def _is_ours(event: event.Event) -> bool:
    return bool(event.data["dispatcher"].py_func.__module__ == __name__)


event.register("numba:compile", _Compiling())

_COMPILE = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}}
# What C, or Python, never calls needs nothing to be called by.
_WHOLE = _COMPILE | {"no_cfunc_wrapper": True}
_INNER = _WHOLE | {"no_cpython_wrapper": True}
# What is called once, or is short, is cheaper to compile as a part of what calls it: no function of its own is optimised.
_PART = _INNER | {"inline": "always"}


@njit(**_INNER)
def _set(out, value):
    """Out = value, for an array of one axis."""
    for i in range(LANES):
        out[i] = value


@njit(**_INNER)
def _copy(values, out):
    """Out = values, each of one axis. An assignment would bring its check of shapes, which takes seconds to compile."""
    for i in range(LANES):
        out[i] = values[i]


@njit(**_INNER)
def _copy_rows(values, out):
    """Out = values, each of two axes."""
    for r in range(len(out)):
        _copy(values[r], out[r])


@njit(**_INNER)
def _add(values, out):
    """Out += values, each of one axis."""
    for i in range(LANES):
        out[i] += values[i]


@njit(**_INNER)
def _load(kind, values, start, m, x, c, s, whole):
    """Put the coordinates of poses start .. start + m into x, their cosines and sines into c and s.

    Constant coordinates are the same in every group and are loaded only if ``whole``.
    """
    for k in range(len(values.constant)):
        j = values.slot[k]
        if j >= 0:
            for i in range(m):
                x[k, i] = values.varying[j, start + i]
            if kind[k] < 3:
                for i in range(m):
                    c[k, i] = math.cos(x[k, i])
                    s[k, i] = math.sin(x[k, i])
        elif whole:
            _set(x[k], values.constant[k])
            _set(c[k], math.cos(values.constant[k]))
            _set(s[k], math.sin(values.constant[k]))


@njit(**_INNER)
def _identity(R, p):
    for r in range(3):
        _set(p[r], 0.0)
        for j in range(3):
            _set(R[r, j], 1.0 if j == r else 0.0)


@njit(**_INNER)
def _apply(R, p, F):
    """Multiply the frames (R, p) by a fixed transform from the right."""
    for r in range(3):
        for i in range(LANES):
            a, b, d = R[r, 0, i], R[r, 1, i], R[r, 2, i]
            p[r, i] += a * F[0, 3] + b * F[1, 3] + d * F[2, 3]
            R[r, 0, i] = a * F[0, 0] + b * F[1, 0] + d * F[2, 0]
            R[r, 1, i] = a * F[0, 1] + b * F[1, 1] + d * F[2, 1]
            R[r, 2, i] = a * F[0, 2] + b * F[1, 2] + d * F[2, 2]


@njit(**_INNER)
def _turn(rotations, index, start, m, R):
    """Turn each frame by the reference orientation that holds at its pose."""
    if len(rotations) == 1:
        A = rotations[0]
        for r in range(3):
            for i in range(LANES):
                a, b, d = R[r, 0, i], R[r, 1, i], R[r, 2, i]
                R[r, 0, i] = a * A[0, 0] + b * A[1, 0] + d * A[2, 0]
                R[r, 1, i] = a * A[0, 1] + b * A[1, 1] + d * A[2, 1]
                R[r, 2, i] = a * A[0, 2] + b * A[1, 2] + d * A[2, 2]
        return
    for i in range(m):
        A = rotations[index[start + i]]
        for r in range(3):
            a, b, d = R[r, 0, i], R[r, 1, i], R[r, 2, i]
            for j in range(3):
                R[r, j, i] = a * A[0, j] + b * A[1, j] + d * A[2, j]


@njit(**_INNER)
def _walk(layout, first, last, x, c, s, R, p, W, O):
    """Move the frames (R, p) over the coordinates first .. last - 1; note each one's axis and origin in W, O."""
    for k in range(first, last):
        if layout.fixed_before[k] >= 0:
            _apply(R, p, layout.fixed[layout.fixed_before[k]])
        kind = layout.kind[k]
        axis = kind if kind < 3 else kind - 3
        j, l = (axis + 1) % 3, (axis + 2) % 3
        for r in range(3):
            for i in range(LANES):
                W[k, r, i] = R[r, axis, i]
                O[k, r, i] = p[r, i]
            if kind >= 3:
                for i in range(LANES):
                    p[r, i] += R[r, axis, i] * x[k, i]
                if layout.less[k] >= 0:
                    for i in range(LANES):
                        p[r, i] -= R[r, axis, i] * x[layout.less[k], i]
            else:
                for i in range(LANES):
                    a, b = R[r, j, i], R[r, l, i]
                    R[r, j, i] = c[k, i] * a + s[k, i] * b
                    R[r, l, i] = c[k, i] * b - s[k, i] * a


@njit(**_PART)
def _walk_arm(layout, places, start, m, x, c, s, R, p, W, O):
    """Walk the whole chain from instrument to target; reference orientations stand before the angles of base and tool."""
    K = len(x)
    _identity(R, p)
    # One call of _walk, with one type of bounds: each is compiled into what calls it.
    for part in range(3):
        first = 3 * part if part < 2 else K - 3
        last = K - 3 if part == 1 else first + 3
        _walk(layout, first, last, x, c, s, R, p, W, O)
        if part == 0:
            _turn(layout.base_rotation, places.base, start, m, R)
        elif part == 1:
            _turn(layout.tool_rotation, places.tool, start, m, R)


@njit(**_INNER)
def _add_body(R, p, mass, centre, B):
    """Add mass times the place of its centre to B."""
    for r in range(3):
        for i in range(LANES):
            place = p[r, i] + R[r, 0, i] * centre[0] + R[r, 1, i] * centre[1] + R[r, 2, i] * centre[2]
            B[r, i] += mass[i] * place


@njit(**_PART)
def _walk_bodies(layout, payload, start, m, x, c, s, R, p, W, O, M, B, mass, F):
    """Walk the arm from its base; M[j] is the mass beyond joint j, B[j] the sum of mass times centre there.

    The link frames are noted in F, the three rows of the rotation and then the origin, where it has room for them.
    """
    n = len(layout.masses)
    _identity(R, p)
    for j in range(n):
        first = FRAME + j * BLOCK
        _walk(layout, first, first + BLOCK, x, c, s, R, p, W, O)
        if len(F) > 0:
            for r in range(3):
                _copy_rows(R[r], F[4 * j + r])
            _copy_rows(p, F[4 * j + 3])
        _set(mass, layout.masses[j])
        _set(M[j], layout.masses[j])
        for r in range(3):
            _set(B[j, r], 0.0)
        _add_body(R, p, mass, layout.centres[j], B[j])
    _apply(R, p, layout.fixed[layout.fixed_before[FRAME + n * BLOCK]])
    _set(mass, 0.0)
    for i in range(m):
        mass[i] = payload.mass[start + i]
    _add(mass, M[n - 1])
    _add_body(R, p, mass, payload.centre, B[n - 1])
    for j in range(n - 2, -1, -1):
        _add(M[j + 1], M[j])
        for r in range(3):
            _add(B[j + 1, r], B[j, r])


@njit(**_INNER)
def _cross(a, b, out):
    """Out = a x b, each of shape (3, lanes)."""
    for i in range(LANES):
        out[0, i] = a[1, i] * b[2, i] - a[2, i] * b[1, i]
        out[1, i] = a[2, i] * b[0, i] - a[0, i] * b[2, i]
        out[2, i] = a[0, i] * b[1, i] - a[1, i] * b[0, i]


@njit(**_INNER)
def _turned_gravity(g, w, out):
    """Out = g x w."""
    for i in range(LANES):
        out[0, i] = g[1] * w[2, i] - g[2] * w[1, i]
        out[1, i] = g[2] * w[0, i] - g[0] * w[2, i]
        out[2, i] = g[0] * w[1, i] - g[1] * w[0, i]


@njit(**_INNER)
def _lever(B, M, o, D):
    """D = B - M o: first moment of mass of what is beyond, about the point o."""
    for r in range(3):
        for i in range(LANES):
            D[r, i] = B[r, i] - M[i] * o[r, i]


@njit(**_PART)
def _moment_point(layout, j, O):
    """Return the point that the moments of joint j are taken about, shape (3, lanes)."""
    return O[max(layout.moment_y[j], layout.moment_z[j])]


@njit(**_PART)
def _moment_levers(layout, W, O, M, B, A, H, D):
    """A[l], H[l]: axis w_l of moment l and h_l = w_l x D_l; the moment itself is h_l . g."""
    for j in range(len(layout.masses)):
        _lever(B[j], M[j], _moment_point(layout, j, O), D)
        _copy_rows(W[layout.moment_y[j]], A[3 * j + 1])
        _copy_rows(W[layout.moment_z[j]], A[3 * j + 2])
        _cross(A[3 * j + 1], A[3 * j + 2], A[3 * j])
        for q in range(3):
            _cross(A[3 * j + q], D, H[3 * j + q])


@njit(**_INNER)
def _add_scaled(a, v, out):
    """Out += a v, with a a number a lane and v of shape (3, lanes)."""
    for r in range(3):
        for i in range(LANES):
            out[r, i] += a[i] * v[r, i]


@njit(**_INNER)
def _take_back(less, k, of_coordinates):
    """Take what coordinate k does off what the one does that it takes back, in an array of all coordinates."""
    earlier = less[k]
    if earlier >= 0:
        for i in range(of_coordinates.shape[1]):
            of_coordinates[earlier, i] -= of_coordinates[k, i]


@njit(**_PART)
def _through_moments(layout, W, O, M, B, H, A, a, ahead, behind, h, u, V):
    """V[r, k] = sum over l of a[r, l] d n_l / d x_k, by two running sums over the chain (module docstring)."""
    rows, n = len(a), len(layout.masses)
    for r in range(rows):
        for q in range(3):
            _set(ahead[r, q], 0.0)
            _set(behind[r, q], 0.0)
        for l in range(3 * n):
            _add_scaled(a[r, l], H[l], ahead[r])
    for j in range(n):
        for k in range(FRAME + j * BLOCK, FRAME + (j + 1) * BLOCK):
            if layout.kind[k] < 3:
                _lever(B[j], M[j], O[k], u)
                _cross(W[k], u, h)
                _turned_gravity(layout.gravity, W[k], u)
                for r in range(rows):
                    for i in range(LANES):
                        before = ahead[r, 0, i] * u[0, i] + ahead[r, 1, i] * u[1, i] + ahead[r, 2, i] * u[2, i]
                        after = behind[r, 0, i] * h[0, i] + behind[r, 1, i] * h[1, i] + behind[r, 2, i] * h[2, i]
                        V[r, k, i] = before + after
            else:
                for r in range(rows):
                    for i in range(LANES):
                        along = behind[r, 0, i] * W[k, 0, i] + behind[r, 1, i] * W[k, 1, i]
                        V[r, k, i] = M[j, i] * (along + behind[r, 2, i] * W[k, 2, i])
                    _take_back(layout.less, k, V[r])
            if k == layout.moment_cut[j]:
                for l in range(3 * j, 3 * j + 3):
                    _turned_gravity(layout.gravity, A[l], u)
                    for r in range(rows):
                        for q in range(3):
                            for i in range(LANES):
                                behind[r, q, i] += a[r, l, i] * u[q, i]
                                ahead[r, q, i] -= a[r, l, i] * H[l, q, i]


@njit(**_PART)
def _pull_back(compliances, start, m, J, a):
    """a[r, l] += sum over the coordinates k that follow moment l of J[r, k] d x_k / d n_l."""
    constant = compliances.rate.shape[1] == 1
    for e in range(len(compliances.coordinate)):
        k, l = compliances.coordinate[e], compliances.moment[e]
        for r in range(len(a)):
            if constant:
                for i in range(LANES):
                    a[r, l, i] += J[r, k, i] * compliances.rate[e, 0]
            else:
                for i in range(m):
                    a[r, l, i] += J[r, k, i] * compliances.rate[e, start + i]


@njit(**_PART)
def _follow_moments(layout, compliances, start, m, sweeps, J, W, O, M, B, H, A, a0, a, ahead, behind, h, u, V):
    """V[:, k]: how the tip moves by what coordinate k does to the moments; a[r, l]: by one unit of moment l."""
    for r in range(len(a)):
        for l in range(a.shape[1]):
            _set(a0[r, l], 0.0)
    moved = J
    for sweep in range(sweeps + 1):
        for r in range(len(a)):
            _copy_rows(a0[r], a[r])
        _pull_back(compliances, start, m, moved, a)
        _through_moments(layout, W, O, M, B, H, A, a, ahead, behind, h, u, V)
        if sweep == 0:
            moved = V
            for r in range(len(a)):
                _copy_rows(a[r], a0[r])


@njit(**_PART)
def _kinematic_columns(layout, W, O, p, J):
    """J[:, k]: the motion of the tip (and its turning, where J has six rows) by coordinate k."""
    rows = len(J)
    for k in range(J.shape[1]):
        if layout.kind[k] >= 3:
            for r in range(3):
                _copy(W[k, r], J[r, k])
            for r in range(3, rows):
                _set(J[r, k], 0.0)
            for r in range(3):
                _take_back(layout.less, k, J[r])
            continue
        for i in range(LANES):
            dx, dy, dz = p[0, i] - O[k, 0, i], p[1, i] - O[k, 1, i], p[2, i] - O[k, 2, i]
            J[0, k, i] = W[k, 1, i] * dz - W[k, 2, i] * dy
            J[1, k, i] = W[k, 2, i] * dx - W[k, 0, i] * dz
            J[2, k, i] = W[k, 0, i] * dy - W[k, 1, i] * dx
        for r in range(3, rows):
            _copy(W[k, r - 3], J[r, k])


@njit(**_PART)
def _parameter_columns(terms, start, m, J, V, through, loop, out):
    """Add each term's share to its parameter's column; rigid terms also act through the moments."""
    for e in range(len(terms.coordinate)):
        k, q, j = terms.coordinate[e], terms.parameter[e], terms.slot[e]
        with_moments = through and (loop or not terms.elastic[e])
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


@njit(**_PART)
def _body_columns(layout, bodies, start, m, O, F, A, a, u, U, S, out):
    """Set the columns of what masses depend on: they act through the moments alone.

    A body of mass M and first moment H beyond joint j adds (M (p_j - o_l) + R_j H) . (g x w_l) to the moment n_l of each
    joint up to j; weighed with a_l these are sums over l of g x w_l, in U, and of o_l . (g x w_l), in S.
    """
    for r in range(len(a)):
        for q in range(3):
            _set(U[q], 0.0)
        _set(S, 0.0)
        for j in range(len(layout.masses)):
            o = _moment_point(layout, j, O)
            for l in range(3 * j, 3 * j + 3):
                _turned_gravity(layout.gravity, A[l], u)
                _add_scaled(a[r, l], u, U)
                for i in range(m):
                    S[i] += a[r, l, i] * (o[0, i] * u[0, i] + o[1, i] * u[1, i] + o[2, i] * u[2, i])
            for e in range(len(bodies.joint)):
                if bodies.joint[e] != j:
                    continue
                column, mass, H = out[bodies.parameter[e], r], bodies.mass[e], bodies.moment[e]
                for q in range(3):
                    for i in range(m):
                        turned = F[4 * j + q, 0, i] * H[0] + F[4 * j + q, 1, i] * H[1] + F[4 * j + q, 2, i] * H[2]
                        column[start + i] += U[q, i] * (mass * F[4 * j + 3, q, i] + turned)
                for i in range(m):
                    column[start + i] -= mass * S[i]


@njit(**_INNER)
def _room(a, b):
    """Return room for a x b rows of lanes. Each number of axes that is allocated takes half a second to compile."""
    return np.empty((a, b, LANES))


@njit(**_INNER)
def _buffers(K):
    """Return room for x, c, s (see _load) and R, p, W, O (see _walk) of one group of poses."""
    coordinates = np.zeros((3, K, LANES))
    return coordinates[0], coordinates[1], coordinates[2], _room(3, 3), _room(1, 3)[0], _room(K, 3), _room(K, 3)


@njit(**_PART)
def _note_poses(R, p, start, m, out):
    """Put the frames of poses start .. start + m into out, shape (3, 4, N)."""
    for r in range(3):
        for i in range(m):
            out[r, 0, start + i], out[r, 1, start + i], out[r, 2, start + i] = R[r, 0, i], R[r, 1, i], R[r, 2, i]
            out[r, 3, start + i] = p[r, i]


@njit(**_PART)
def _note_moments(g, H, start, m, out):
    """Put the moments of poses start .. start + m into out, shape (3 n, N)."""
    for l in range(len(out)):
        for i in range(m):
            out[l, start + i] = H[l, 0, i] * g[0] + H[l, 1, i] * g[1] + H[l, 2, i] * g[2]


@compiled(**_WHOLE)
def evaluate(layout, values, rigid, places, payload, terms, compliances, bodies, n_parameters, rows, sweeps):
    """Return poses, static moments and columns, as far as they are asked for: one loop, as each takes seconds to compile.

    Args:
        layout: the chain.
        values: coordinates of the deformed arm.
        rigid: coordinates that the moments are computed on.
        places: which reference orientations hold; without any no poses are computed.
        payload: mass beyond the tip; without any no moments are computed.
        terms: the parameters.
        compliances: how coordinates follow the moments; may be empty.
        bodies: the parameters that masses depend on; may be empty.
        n_parameters: number P of columns.
        rows: 3 for the velocity of the target, 6 for velocity and angular velocity, in the instrument's axes; 0 for the
            moments themselves instead of columns.
        sweeps: 0 for moments on the undeformed arm; else how often the effect of deformation on the moments is
            followed round.

    Returns:
        Poses, shape (3, 4, N), moments, shape (3 n, N), and columns, shape (P, rows, N); what is not asked for is empty.
    """
    N, K, n = values.varying.shape[1], len(values.constant), len(layout.masses)
    posed, through, weighs = len(places.tool) > 0, len(compliances.coordinate) > 0, len(bodies.joint) > 0
    laden = len(payload.mass) > 0 and (through or rows == 0)
    x, c, s, R, p, W, O = _buffers(K if posed else 0)
    y, cy, sy, Rb, q, Wb, Ob = _buffers(K if laden else 0)
    M, B, mass, S = _room(1, n)[0], _room(n, 3), _room(1, 1)[0, 0], _room(1, 1)[0, 0]
    h, u, U = _room(1, 3)[0], _room(1, 3)[0], _room(1, 3)[0]
    A, H = _room(3 * n, 3), _room(3 * n, 3)
    a0, a = _room(rows, 3 * n), _room(rows, 3 * n)
    ahead, behind = _room(rows, 3), _room(rows, 3)
    J, V, F = _room(rows, K), np.zeros((rows, K, LANES)), _room(4 * n if weighs else 0, 3)
    poses, columns = np.empty((3, 4, N if posed else 0)), np.zeros((n_parameters, rows, N))
    moments = np.empty((1, 3 * n, N if laden and rows == 0 else 0))[0]
    for start in range(0, N, LANES):
        m = min(LANES, N - start)
        if posed:
            _load(layout.kind, values, start, m, x, c, s, start == 0)
            _walk_arm(layout, places, start, m, x, c, s, R, p, W, O)
            _note_poses(R, p, start, m, poses)
        if laden:
            _load(layout.kind, rigid, start, m, y, cy, sy, start == 0)
            _walk_bodies(layout, payload, start, m, y, cy, sy, Rb, q, Wb, Ob, M, B, mass, F)
            _moment_levers(layout, Wb, Ob, M, B, A, H, u)
        if rows == 0:
            if laden:
                _note_moments(layout.gravity, H, start, m, moments)
            continue
        _kinematic_columns(layout, W, O, p, J)
        if through:
            _follow_moments(layout, compliances, start, m, sweeps, J, Wb, Ob, M, B, H, A, a0, a, ahead, behind, h, u, V)
            if weighs:
                _body_columns(layout, bodies, start, m, Ob, F, A, a, u, U, S, columns)
        _parameter_columns(terms, start, m, J, V, through, sweeps > 0, columns)
    return poses, moments, columns


_NONE = np.empty(0, np.int64)
_NOWHERE, _NO_LOAD = Places(_NONE, _NONE), Payload(np.empty(0), np.zeros(3))
_NO_TERMS = Terms(_NONE, _NONE, _NONE, np.empty(0, bool), np.empty((0, 0)))
_STIFF = Compliances(_NONE, _NONE, np.empty((0, 1)))
_NO_BODIES = Bodies(_NONE, _NONE, np.empty(0), np.empty((0, 3)))


def static_moments(layout: Layout, values: Values, payload: Payload) -> np.ndarray:
    """Return the static moments, shape (3 n, N), components x, y, z of each joint [N m]."""
    return evaluate(layout, values, values, _NOWHERE, payload, _NO_TERMS, _STIFF, _NO_BODIES, 0, 0, 0)[1]  # type: ignore[no-any-return]


def tip_poses(layout: Layout, values: Values, places: Places) -> np.ndarray:
    """Return the target's pose in the instrument's frame, shape (3, 4, N): rotation and translation."""
    return evaluate(layout, values, values, places, _NO_LOAD, _NO_TERMS, _STIFF, _NO_BODIES, 0, 0, 0)[0]  # type: ignore[no-any-return]
