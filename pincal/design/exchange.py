r"""Optimal choice among candidates by a greedy algorithm and Fedorov's exchange, its bound, and the
order of measurement.

A candidate j is a pose with its m readings; A_j, shape (m, F), is their Jacobian in units of the
noise and of the priors, so that a design has the posterior covariance

.. math:: C = (H + \sum_j A_j^T A_j)^{-1}, \qquad K_j = A_j C A_j^T, \qquad L_j = A_j C W C A_j^T

with H the prior information (priors, poses already measured). Adding candidate j changes the
criteria by

.. math:: \mathrm{tr}(W C) - \mathrm{tr}(W C') = \mathrm{tr}((1 + K_j)^{-1} L_j), \qquad
    \log\det C - \log\det C' = \log\det(1 + K_j),

and changes C by rank m, from which K and L of all the candidates follow by two thin products (V. V.
Fedorov, Theory of Optimal Experiments, 1972, ch. 3; Atkinson, Donev and Tobias, Optimum
Experimental Designs, 2007, ch. 12).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from pincal.thresholds import Count, Scale

# Most passes of an exchange over a design.
_PASSES: Count = 10
# Factor by which updates may reduce the covariance before the state is recomputed from scratch: K,
# and L quadratically, would be differences of numbers larger by this factor.
_ALONE: Scale = 1e-5
# Relative gain below which an exchange is rounding.
_WORTH: Scale = 1e-9
# Iterations of the algorithm for the lower bound.
ROUNDS: Count = 100


def covariance(H: np.ndarray) -> np.ndarray:
    """Return the inverse of an information matrix, shape (F, F)."""
    return np.asarray(cho_solve(cho_factor(H), np.eye(len(H))))


def value(C: np.ndarray, W: np.ndarray | None) -> float:
    """Return the criterion of a posterior covariance, to be minimised: tr(W C), or log det C
    without W.
    """
    return float(np.sum(W * C)) if W is not None else float(np.linalg.slogdet(C)[1])


def gains(K: np.ndarray, L: np.ndarray | None) -> np.ndarray:
    """Return the decrease of the criterion by each candidate, shape (M,); K, L: shape (M, m, m), L
    None for det.
    """
    more = np.eye(K.shape[1]) + K
    if L is None:
        return np.asarray(np.linalg.slogdet(more)[1])
    if K.shape[1] == 3:
        return _traces_of_three(more, L)
    return np.asarray(np.trace(np.linalg.solve(more, L), axis1=1, axis2=2))


def _traces_of_three(P: np.ndarray, L: np.ndarray) -> np.ndarray:
    """Return tr(P^-1 L) of symmetric 3 x 3 matrices by cofactors, five times faster
    than solving.
    """
    p, q = (np.ascontiguousarray(matrices.transpose(1, 2, 0)) for matrices in (P, L))
    xx = p[1, 1] * p[2, 2] - p[1, 2] ** 2
    yy = p[0, 0] * p[2, 2] - p[0, 2] ** 2
    zz = p[0, 0] * p[1, 1] - p[0, 1] ** 2
    xy = p[0, 2] * p[1, 2] - p[0, 1] * p[2, 2]
    xz = p[0, 1] * p[1, 2] - p[0, 2] * p[1, 1]
    yz = p[0, 1] * p[0, 2] - p[0, 0] * p[1, 2]
    trace = (
        xx * q[0, 0]
        + yy * q[1, 1]
        + zz * q[2, 2]
        + 2.0 * (xy * q[0, 1] + xz * q[0, 2] + yz * q[1, 2])
    )
    return np.asarray(trace / (p[0, 0] * xx + p[0, 1] * xy + p[0, 2] * xz))


def spread_of(
    A: np.ndarray, C: np.ndarray, W: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return K and L, shape (M, m, m), of candidates A, shape (M, m, F); L is None without W."""
    AC = A @ C
    K = AC @ A.transpose(0, 2, 1)
    return K, None if W is None else AC @ W @ AC.transpose(0, 2, 1)


@dataclass(frozen=True)
class DesignState:
    """A design, and the matrices for the gain of each candidate; see the module's docstring.

    Attributes:
        A: shape (M, m, F), the candidates.
        W: shape (F, F), weights of the criterion tr(W C); None for the determinant.
        C, K, L: shapes (F, F), (M, m, m) and (M, m, m); L is None without W.
    """

    A: np.ndarray
    W: np.ndarray | None
    C: np.ndarray
    K: np.ndarray
    L: np.ndarray | None

    @classmethod
    def of(cls, A: np.ndarray, W: np.ndarray | None, H: np.ndarray) -> DesignState:
        """Return the state at information H, shape (F, F)."""
        C = covariance(H)
        return cls(A, W, C, *spread_of(A, C, W))

    def gains(self) -> np.ndarray:
        """Return the decrease of the criterion by each candidate, shape (M,)."""
        return gains(self.K, self.L)

    def spare(self, j: int) -> float:
        """Return the least fraction of information, over all directions, that remains without
        candidate j.
        """
        return float(np.linalg.eigvalsh(np.eye(self.K.shape[1]) - self.K[j])[0])

    def moved(self, j: int, sign: float) -> DesignState:
        """Return the state with candidate j added (sign 1) or removed (sign -1), by updates of rank
        m.
        """
        inner = np.linalg.cholesky(np.linalg.inv(np.eye(self.K.shape[1]) + sign * self.K[j]))
        B = self.C @ self.A[j].T @ inner
        C = self.C - sign * (B @ B.T)
        if self.W is None or self.L is None:
            P = self._times(B)
            return replace(self, C=C, K=self.K - sign * (P @ P.transpose(0, 2, 1)))
        CWB = self.C @ (self.W @ B)
        Z = CWB - 0.5 * sign * (B @ (B.T @ (self.W @ B)))
        m = B.shape[1]
        both = self._times(np.hstack([B, Z]))
        P = both[:, :, :m]
        S = both[:, :, m:]
        cross = P @ S.transpose(0, 2, 1)
        K = self.K - sign * (P @ P.transpose(0, 2, 1))
        return replace(self, C=C, K=K, L=self.L - sign * (cross + cross.transpose(0, 2, 1)))

    def _times(self, B: np.ndarray) -> np.ndarray:
        M, m, F = self.A.shape
        return np.asarray((self.A.reshape(M * m, F) @ B).reshape(M, m, -1))


def information(A: np.ndarray, chosen: Sequence[int] | np.ndarray) -> np.ndarray:
    """Return the sum of A_j^T A_j over the chosen candidates, shape (F, F)."""
    rows = A[np.asarray(chosen, int)].reshape(-1, A.shape[2])
    return np.asarray(rows.T @ rows)


def total(A: np.ndarray) -> np.ndarray:
    """Return the sum of A_j^T A_j over all of A, shape (N, m, F); shape (F, F)."""
    return information(A, np.arange(len(A)))


def choose_greedily(
    A: np.ndarray, W: np.ndarray | None, H: np.ndarray, n: int, start: Sequence[int] = ()
) -> tuple[list[int], list[float]]:
    """Add, one after the other, the candidate that decreases the criterion most.

    ``A``, shape (M, m, F), are the candidates in units of noise and priors, ``W``, shape (F, F),
    the weights or None for the determinant, and ``H``, shape (F, F), the prior information. Returns
    n candidates, with ``start`` first, and the criterion after each addition.
    """
    chosen = list(start)
    course = []
    state = DesignState.of(A, W, H + information(A, chosen))
    left = 1.0
    free = np.ones(len(A), bool)
    free[chosen] = False
    while len(chosen) < n:
        j = int(np.argmax(np.where(free, state.gains(), -np.inf)))
        free[j] = False
        chosen.append(j)
        left /= 1.0 + float(np.linalg.eigvalsh(state.K[j])[-1])
        if left > _ALONE:
            state = state.moved(j, 1.0)
        else:
            state = DesignState.of(A, W, H + information(A, chosen))
            left = 1.0
        course.append(value(state.C, W))
    return chosen, course


def exchange(
    A: np.ndarray,
    W: np.ndarray | None,
    H: np.ndarray,
    chosen: Sequence[int],
    *,
    passes: int = _PASSES,
) -> list[int]:
    """Exchange candidates of a design for better ones, one at a time, until no exchange improves
    it.

    Starts from the design ``chosen`` and keeps its order, without repeated candidates; at most
    ``passes`` over the design. The other arguments are as in :func:`choose_greedily`.
    """
    design = list(chosen)
    for _ in range(passes):
        state = DesignState.of(A, W, H + information(A, design))
        n_swaps = 0
        for place, old in enumerate(design):
            rest = design[:place] + design[place + 1 :]
            without = (
                state.moved(old, -1.0)
                if state.spare(old) > _ALONE
                else DesignState.of(A, W, H + information(A, rest))
            )
            gain = without.gains()
            gain[rest] = -np.inf
            new = int(np.argmax(gain))
            if gain[new] - gain[old] <= _WORTH * abs(gain[old]):
                continue
            design[place] = new
            n_swaps = n_swaps + 1
            state = without.moved(new, 1.0)
        if not n_swaps:
            break
    return design


def lower_bound(
    A: np.ndarray, W: np.ndarray | None, H: np.ndarray, n: int, *, rounds: int = ROUNDS
) -> float:
    r"""Return a lower bound of the criterion over all designs of n candidates, with repetition.

    A design of n candidates is a point w in the simplex, with candidate j taken n w_j times. The
    criteria are convex over the simplex, so that at any w, with d_j minus the derivative by n w_j,

    .. math:: f(w^*) \ge f(w) - n \, (\max_j d_j - \sum_j w_j d_j),

    with equality at the optimum (the equivalence theorem; Kiefer and Wolfowitz 1960, Fedorov 1972).
    The weights are from the multiplicative algorithm of Silvey, Titterington and Torsney (1978);
    more rounds tighten the bound. Arguments are as in
    :func:`choose_greedily`.
    """
    M, m, F = A.shape
    rows = A.reshape(M * m, F)
    weights = np.full(M, 1.0 / M)
    best = -np.inf
    for _ in range(rounds):
        C = covariance(H + n * (rows * np.repeat(weights, m)[:, None]).T @ rows)
        inner = C if W is None else C @ W @ C
        descent = np.einsum("rf,rf->r", rows @ inner, rows).reshape(M, m).sum(axis=1)
        best = max(best, value(C, W) - n * float(descent.max() - weights @ descent))
        weights = weights * np.sqrt(descent)
        weights /= weights.sum()
    return best


# Most rounds of improvement of an order, each of which removes every crossing that it finds.
_ROUNDS: Count = 50


def travel(q: np.ndarray, spans: np.ndarray) -> np.ndarray:
    """Return distances of poses q, shape (N, n): the largest joint step relative to the ranges
    ``spans``, shape (N, N).
    """
    scaled = q / spans
    return np.asarray(np.abs(scaled[:, None] - scaled[None]).max(axis=2))


def short_route(distances: np.ndarray, first: int = 0) -> np.ndarray:
    """Return an order of N places with a short open path: nearest neighbour, then 2-opt (Croes
    1958).

    ``distances`` is symmetric, shape (N, N); the order, shape (N,), begins with ``first``.
    """
    places = [first]
    left = np.ones(len(distances), bool)
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
    """Return an order of poses q, shape (N, n), with a short path, load by load, and the path's
    length before and after.

    ``payload`` has shape (N,); the ends of the joints' ranges have shape (n,) each.
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
    """Return the length of the path through places in an order."""
    return float(distances[order[:-1], order[1:]].sum())


def _reverse_stretches(order: np.ndarray, d: np.ndarray) -> bool:
    """Reverse each segment of the order, in place, that shortens the path; return whether there was
    one.
    """
    n = len(order)
    found = False
    for i in range(1, n - 1):
        # Segment i..k: the edges into and out of it change; there is none after the last place.
        before = order[i - 1]
        inside = order[i]
        ends = order[i + 1 :]
        after = np.append(order[i + 2 :], -1)
        out_now = np.where(after < 0, 0.0, d[ends, after])
        out_then = np.where(after < 0, 0.0, d[inside, after])
        gain = d[before, inside] + out_now - d[before, ends] - out_then
        k = int(np.argmax(gain))
        if gain[k] > 1e-12:
            order[i : i + 2 + k] = order[i : i + 2 + k][::-1].copy()
            found = True
    return found
