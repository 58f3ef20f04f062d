r"""How surely a diagnosis at some poses notices what may happen to a robot, and the fewest poses that do.

The test of :mod:`pincal.diagnosis.evidence` at poses j with rows N_j of what is uncertain or free (the posterior of the
calibration, masses, the new station's frames) and columns g_j of a change, in units of the noise, has the non-centrality

.. math:: \lambda = \sum_j g_j^T g_j - z^T K z, \qquad K = H + \sum_j N_j^T N_j, \qquad z = K^{-1} \sum_j N_j^T g_j,

with H what is known before. With :math:`u = g_j - N_j z`, one more pose adds :math:`u^T (1 + N_j K^{-1} N_j^T)^{-1} u`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pincal.design.exchange import covariance
from pincal.diagnosis.excluded import noticed_noncentrality

# Passes over a design in which poses are exchanged.
_PASSES = 3
# The larger, the more the change that is hardest to notice decides which pose is best.
_SHARPNESS = 4.0


@dataclass(frozen=True)
class Watch:
    """Candidate poses, and what each would tell of the changes that are to be noticed.

    Attributes:
        N: shape (M, m, K), rows of what is uncertain or free.
        G: shape (M, m, Q), columns of the changes, each as large as it is to be noticed.
        H: shape (K, K), what is known before any row.
        ranks: shape (Q,), number of directions that the test of each change counts.
        limit: p-value below which one change is an alarm.
        degrees: of freedom by which the noise is known beside the rows; less those that the rows spend on frames.
        power: chance with which a change is to be noticed.
    """

    N: np.ndarray
    G: np.ndarray
    H: np.ndarray
    ranks: np.ndarray
    limit: float
    degrees: float
    power: float

    def needed(self, n: int) -> np.ndarray:
        """Return the non-centrality that each change must have with n poses, shape (Q,)."""
        degrees = max(self.degrees + n * self.N.shape[1], 1.0)
        return np.array([noticed_noncentrality(int(rank), degrees, self.limit, self.power) for rank in self.ranks])

    def noncentralities(self, chosen: Sequence[int]) -> np.ndarray:
        """Return those of all changes at some of the candidates, shape (Q,)."""
        return self._seen(chosen)[0]

    def certainty(self, chosen: Sequence[int]) -> float:
        """Return the non-centrality over the one needed, of the change that is hardest to notice."""
        return float((self.noncentralities(chosen) / self.needed(len(chosen))).min())

    def fewest(self, most: int, start: Sequence[int] = ()) -> list[int]:
        """Return the fewest candidates found that notice every change; ``most`` of them if those don't suffice.

        Args:
            most: number of candidates.
            start: candidates to begin with.
        """
        chosen = list(start)
        while len(chosen) < most and (not chosen or self.certainty(chosen) < 1.0):
            chosen.append(self._best(chosen, self._costs(chosen)))
        if self.certainty(chosen) < 1.0:
            return self._exchanged(chosen)
        while len(chosen) > 1:
            fewer = self._exchanged(self._without_one(chosen))
            if self.certainty(fewer) < 1.0:
                break
            chosen = fewer
        return chosen

    def fewest_of(self, most: int, groups: np.ndarray) -> list[int]:
        """Return the best found from nothing and from two candidates of each group, shape (M,).

        A first pose in a place that is not known tells nothing, so that one by one no place but the first would be taken.
        """
        pairs = [int(j) for group in np.unique(groups) for j in np.flatnonzero(groups == group)[:2]]
        found = [self.fewest(most), self.fewest(most, pairs)] if len(pairs) > 2 else [self.fewest(most)]
        return min(found, key=lambda chosen: (self.certainty(chosen) < 1.0, len(chosen), -self.certainty(chosen)))

    def _seen(self, chosen: Sequence[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the non-centralities, shape (Q,), all z, shape (K, Q), and the inverse of K, shape (K, K)."""
        N, G = (part[list(chosen)].reshape(-1, part.shape[2]) for part in (self.N, self.G))
        inverse = covariance(self.H + N.T @ N)
        z = inverse @ (N.T @ G)
        return np.maximum(np.sum(G * (G - N @ z), axis=0), 0.0), z, inverse

    def _costs(self, chosen: Sequence[int]) -> np.ndarray:
        """Return what is missing with each candidate added, shape (M,)."""
        found, z, inverse = self._seen(chosen)
        U = self.G - self.N @ z
        inner = np.eye(U.shape[1]) + self.N @ inverse @ self.N.transpose(0, 2, 1)
        more = np.sum(np.linalg.solve(np.linalg.cholesky(inner), U) ** 2, axis=1)
        # A change that no pose has shown yet is missing all that is needed, not infinitely much.
        return np.asarray(np.sum((self.needed(len(chosen) + 1) / (1.0 + found + more)) ** _SHARPNESS, axis=1))

    def _exchanged(self, chosen: list[int]) -> list[int]:
        """Return a design in which poses were swapped for better ones, until it notices everything."""
        design = list(chosen)
        for _ in range(_PASSES):
            before = list(design)
            for place in range(len(design)):
                if self.certainty(design) >= 1.0:
                    return design
                rest = design[:place] + design[place + 1 :]
                design[place] = self._best(rest, self._costs(rest))
            if design == before:
                break
        return design

    def _without_one(self, chosen: list[int]) -> list[int]:
        """Return a design without the pose that is missed least."""
        places = range(len(chosen))
        rests = [chosen[:place] + chosen[place + 1 :] for place in places]
        missed = [float(np.sum((1.0 / (1.0 + self.noncentralities(rest))) ** _SHARPNESS)) for rest in rests]
        return rests[int(np.argmin(missed))]

    @staticmethod
    def _best(chosen: Sequence[int], costs: np.ndarray) -> int:
        costs = costs.copy()
        costs[list(chosen)] = np.inf
        return int(np.argmin(costs))
