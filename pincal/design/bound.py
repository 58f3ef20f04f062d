r"""What no choice among the candidates can beat: a lower bound of the criterion by its relaxation to weights.

A design of n candidates is a point w in the simplex, n w_j saying how often candidate j is taken. Over the whole simplex the
criteria are convex, so that at any w, with d_j minus the derivative by n w_j,

.. math:: f(w^*) \ge f(w) - n \, (\max_j d_j - \sum_j w_j d_j),

which closes at the optimum (the equivalence theorem; Kiefer and Wolfowitz 1960, Fedorov 1972). The weights come from the
multiplicative algorithm of Silvey, Titterington and Torsney (1978).
"""

from __future__ import annotations

import numpy as np

from pincal.design.exchange import covariance, value

ROUNDS = 100


def lower_bound(A: np.ndarray, W: np.ndarray | None, H: np.ndarray, n: int, *, rounds: int = ROUNDS) -> float:
    """Return a value that the criterion of no n candidates, repeated ones among them, falls below.

    Args:
        A: shape (M, m, F), candidates in units of noise and priors.
        W: shape (F, F), of the criterion tr(W C); None for the determinant.
        H: shape (F, F), information that is there before.
        n: number of candidates in a design.
        rounds: of the algorithm; more make the bound tighter.
    """
    M, m, F = A.shape
    rows, weights, best = A.reshape(M * m, F), np.full(M, 1.0 / M), -np.inf
    for _ in range(rounds):
        C = covariance(H + n * (rows * np.repeat(weights, m)[:, None]).T @ rows)
        inner = C if W is None else C @ W @ C
        descent = np.einsum("rf,rf->r", rows @ inner, rows).reshape(M, m).sum(axis=1)
        best = max(best, value(C, W) - n * float(descent.max() - weights @ descent))
        weights = weights * np.sqrt(descent)
        weights /= weights.sum()
    return best
