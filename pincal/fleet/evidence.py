r"""How far machines are from a population, and how likely each of their elements was hit.

With machines :math:`x \sim N(\mu, \Sigma)` and readings with information H and g on one of them
(:mod:`pincal.identify.quadratic`), its distance from the population enters the likelihood by a
score and its covariance,

.. math:: q = \Sigma^{-1} C (g - H \mu), \qquad Q = \Sigma^{-1} - \Sigma^{-1} C \Sigma^{-1}, \qquad
    C = (\Sigma^{-1} + H)^{-1},

the gradient of the log likelihood along the machine's deviation, and its covariance if the machine
belongs to the population. They are computed in units of the spread, :math:`L^T q` and
:math:`L^T Q L = 1 - (1 + L^T H L)^{-1}` with
:math:`L L^T = \Sigma`, which is exact however little or much is known of a direction.
If some parameters deviate with covariance :math:`T^2`, the readings are more likely by the factor

.. math:: |1 + T Q T|^{-1/2} \exp(\tfrac12 q^T (T^{-2} + Q)^{-1} q),

a ratio of two marginal likelihoods, hence an e-value: its mean is 1 if nothing deviates (Vovk and
Wang 2021).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc

from pincal.thresholds import Count, Scale

# Machines processed at a time: with 40 parameters their matrices take 6 MB.
_PIECE: Count = 500
# Upper bound on log odds, so that exponentials are finite.
_SURE: Scale = 500.0
# Degrees of freedom of machines about their mean, and the grid of logarithms of factors on
# variances.
_TAIL: Scale = 4.0
_FACTORS: tuple[Scale, Scale, Count] = (-3.0, 6.0, 181)


@dataclass(frozen=True, eq=False)
class Forms:
    """Information of M machines on P parameters, each in units of its prior without a type.

    Attributes:
        H: shape (M, P, P), information on deviations from the nominal robot.
        g: shape (M, P).
        elements: shape (P,), numbers of the elements (joints) of the parameters: a collision
            changes all of one.
    """

    H: np.ndarray
    g: np.ndarray
    elements: np.ndarray

    def __len__(self) -> int:
        return len(self.g)

    def pieces(self) -> Iterator[tuple[slice, Forms]]:
        """Yield some machines at a time, with their rows."""
        for start in range(0, len(self), _PIECE):
            rows = slice(start, start + _PIECE)
            yield rows, replace(self, H=self.H[rows], g=self.g[rows])

    @property
    def ways(self) -> list[np.ndarray]:
        """Indices of the parameters that may deviate together: those of each element, and all."""
        found = [np.flatnonzero(self.elements == element) for element in np.unique(self.elements)]
        return [*found, np.arange(len(self.elements))] if len(found) > 1 else found


def scores(forms: Forms, mean: np.ndarray, root: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return L^T q, shape (M, P), and L^T Q L, (M, P, P), of machines in a population with mean mu
    and root L, (P, P).
    """
    is_diagonal = np.count_nonzero(root) <= len(mean)
    spread = np.diag(root)
    A = forms.H * np.outer(spread, spread) if is_diagonal else root.T @ forms.H @ root
    A += np.eye(len(mean))
    inverse = np.linalg.inv(A)
    b = (forms.g - forms.H @ mean) @ root
    q = (inverse @ b[..., None])[..., 0]
    np.subtract(np.eye(len(mean)), inverse, out=inverse)
    return q, inverse


def in_prior_units(q: np.ndarray, Q: np.ndarray, root: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Convert q and Q from units of the spread to units of the priors without a type."""
    if np.count_nonzero(root) <= len(root):
        spread = np.diag(root)
        return q / spread, Q / np.outer(spread, spread)
    inverse = np.linalg.inv(root)
    return q @ inverse, inverse.T @ Q @ inverse


def log_evidence(q: np.ndarray, Q: np.ndarray, sizes: np.ndarray | float = 1.0) -> np.ndarray:
    """Return the logarithm of the e-value of a deviation of parameters, shape (...,).

    Args:
        q: shape (..., n), scores of these parameters.
        Q: shape (..., n, n), their covariances.
        sizes: shape (n,), standard deviations of the deviations; default: those of the priors
            without a type.
    """
    T = np.broadcast_to(np.asarray(sizes, float), Q.shape[-1:])
    A = Q * np.outer(T, T) + np.eye(len(T))
    b = q * T
    quadratic = np.sum(b * np.linalg.solve(A, b[..., None])[..., 0], axis=-1)
    log_det = np.log(np.diagonal(np.linalg.cholesky(A), axis1=-2, axis2=-1)).sum(axis=-1)
    return np.asarray(0.5 * quadratic - log_det)


def log_ratios(forms: Forms, q: np.ndarray, Q: np.ndarray) -> np.ndarray:
    """Return the log evidence of each kind of deviation, shape (kinds, M), from scores in units of
    the priors.
    """
    return np.array([log_evidence(q[:, at], Q[:, at[:, None], at]) for at in forms.ways])


def regular(logs: np.ndarray, hit: float) -> np.ndarray:
    """Return the probability that a machine was not hit, shape (M,).

    Args:
        logs: shape (kinds, M), log evidence of each kind of deviation.
        hit: fraction of the machines that were hit, in any way.
    """
    odds = hit / (1.0 - hit) * np.mean(np.exp(np.minimum(logs, _SURE)), axis=0)
    return np.asarray(1.0 / (1.0 + odds))


def chance(q: np.ndarray, Q: np.ndarray, degrees: float = np.inf) -> np.ndarray:
    r"""Return the p-value of scores, shape (...,), under the hypothesis that nothing deviates.

    The statistic is :math:`q^T q`, in units of the spread: directions count as far as readings
    determine them. It is a weighted sum of chi-squares, approximated by a multiple of one with the
    same mean and variance (Satterthwaite 1946).

    Args:
        q: shape (..., n), in units of the spread.
        Q: shape (..., n, n).
        degrees: degrees of freedom of the estimated spread of one parameter; several are
            independent.
    """
    mean = np.trace(Q, axis1=-2, axis2=-1)
    square = np.sum(Q * Q, axis=(-2, -1))
    free = np.where(square > 0.0, mean**2 / np.maximum(square, 1e-300), 1.0)
    ratio = np.sum(q * q, axis=-1) / np.maximum(mean, 1e-300)
    # With a million degrees of freedom F is chi-square.
    found = fdtrc(np.maximum(free, 1e-3), np.minimum(degrees * np.maximum(free, 1.0), 1e6), ratio)
    return np.where(mean > 1e-9, found, 1.0)


def least_chance(
    q: np.ndarray,
    Q: np.ndarray,
    root: np.ndarray,
    elements: Sequence[np.ndarray],
    degrees: float = np.inf,
) -> np.ndarray:
    """Return the p-value of the largest deviation of any element, or of all parameters together,
    shape (M,).

    Args:
        q: shape (M, P), in units of the priors.
        Q: shape (M, P, P).
        root: L with L L^T the covariance of the population, shape (P, P).
        elements: the parameters of each element.
        degrees: degrees of freedom of the estimated spread of one parameter.
    """
    spread = np.sqrt(np.sum(root**2, axis=-1))
    own = q * spread
    Own = Q * np.outer(spread, spread)
    whole = chance(q @ root, root.T @ Q @ root, degrees)
    single = [chance(own[:, at], Own[:, at[:, None], at], degrees) for at in elements]
    # Two tests, one of them of as many elements (Bonferroni).
    return np.asarray(
        np.minimum(1.0, 2.0 * np.minimum(whole, len(single) * np.min(single, axis=0)))
    )


def times_farther(q: np.ndarray, Q: np.ndarray) -> float:
    r"""Return the factor on the variances of its population by which a machine is farther from the
    mean than others.

    With variances s times as large the log likelihood of the readings is

    .. math:: \tfrac12 \sum_i \Big( \frac{s\, b_i^2}{1 + s a_i} - \ln(1 + s a_i) \Big)

    along the axes of their information a in units of the spread, b its gradient at the mean. The
    inverse of s has a chi-square prior with few degrees of freedom, so that machines follow
    Student's t (Lange, Little and Taylor 1989). The result is the exponential of the posterior mean
    of ln s.

    Args:
        q: shape (P,), score of one machine in units of the spread.
        Q: shape (P, P), its covariance.
    """
    left, axes = np.linalg.eigh(np.eye(len(q)) - Q)
    left = np.clip(left, 1e-12, 1.0)
    a = 1.0 / left - 1.0
    b = axes.T @ q / left
    logs = np.linspace(*_FACTORS)
    s = np.exp(logs)[:, None]
    found = 0.5 * np.sum(s * b**2 / (1.0 + s * a) - np.log1p(s * a), axis=1) - 0.5 * _TAIL * (
        logs + np.exp(-logs)
    )
    weights = np.exp(found - found.max())
    return float(np.exp(weights @ logs / weights.sum()))
