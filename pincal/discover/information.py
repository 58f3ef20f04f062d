"""What rows and priors say of a model's parameters, with all rows and without each block of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular

# Keeps a scaled matrix of information definite where rounding would not.
_ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class Information:
    """What rows and priors say of the N parameters of a model, by block of poses; the same for all candidates.

    Attributes:
        blocks_S, blocks_b: shape (B, N, N), (B, N), products of its columns with each other and with the residuals.
        known: shape (N, N), inverse covariance of what was known of the parameters before.
        pull: shape (N,), slope of the sum of squares by it at the present values.
        beliefs: the same by the factor of sizes in doubt.
    """

    blocks_S: np.ndarray
    blocks_b: np.ndarray
    known: np.ndarray
    pull: np.ndarray
    beliefs: dict[float, Information] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def S(self) -> np.ndarray:
        """Of all blocks, shape (N, N)."""
        return self.blocks_S[0] if len(self.blocks_S) == 1 else np.asarray(self.blocks_S.sum(axis=0))

    @cached_property
    def b(self) -> np.ndarray:
        """Of all blocks, shape (N,)."""
        return np.asarray(self.blocks_b.sum(axis=0))

    @cached_property
    def factor(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Scale and Cholesky factor of the information of rows and priors, and its slope in units of it."""
        scale, L = scaled_factor(self.S + self.known)
        return scale, L, solve_triangular(L, scale * (self.b - self.pull), lower=True, check_finite=False)

    def believing(self, factor: float, known: np.ndarray) -> Information:
        """Return the same where sizes in doubt are multiplied by a factor, which makes ``known`` of what was known."""
        return self.beliefs.setdefault(factor, Information(self.blocks_S, self.blocks_b, known, self.pull))

    def without(self, model: np.ndarray, gone: np.ndarray, values: np.ndarray) -> Information:
        """Return the same of the parameters that stay, the others at zero; to first order nothing is evaluated again.

        Without columns J of value v the residuals r grow by J v, and b by S v.

        Args:
            model: shape (M,), which stay.
            gone: shape (G,), which go.
            values: shape (G,), of these.
        """
        kept = np.ix_(model, model)
        b = self.blocks_b[:, model] + self.blocks_S[:, model[:, None], gone] @ values
        return Information(self.blocks_S[:, model[:, None], model], b, self.known[kept], self.pull[model])

    def grown(self, gone: np.ndarray, values: np.ndarray) -> float:
        """Return by how much the squares of the residuals grow without columns of these values, shape (G,)."""
        return float(values @ (2.0 * self.b[gone] + self.S[np.ix_(gone, gone)] @ values))

    @cached_property
    def without_block(self) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Scale and factor of the information without each block, and the step of the parameters."""
        found = []
        for S, b in zip(self.blocks_S, self.blocks_b, strict=True):
            scale, factor = scaled_factor(self.S - S + self.known)
            slope = scale * (self.b - b - self.pull)
            found.append((scale, factor, scale * cho_solve((factor, True), slope, check_finite=False)))
        return found


def scaled_factor(H: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return s and the lower Cholesky factor of diag(s) H diag(s), whose diagonal is 1; H, symmetric, is overwritten."""
    scale = np.asarray(1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300)))
    H *= scale
    H *= scale[:, None]
    H[np.diag_indices_from(H)] += _ROUNDING
    # Column-major, which spares LAPACK a copy.
    return scale, cholesky(H.T, lower=True, overwrite_a=True, check_finite=False)
