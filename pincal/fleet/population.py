r"""The population from which machines are drawn, by the marginal likelihood of all their readings
(empirical Bayes).

Machines are x ~ N(mu, Sigma); each has a score q with covariance Q (:mod:`pincal.fleet.evidence`).
Sums of q, Q,
:math:`q q^T` and :math:`Q \circ Q` over machines give

- the mean, :math:`\sum q = 0`, with a normal prior about the data sheet;
- the variances of single parameters, by Fisher scoring on their logarithms: gradient
  :math:`(q_k^2 - Q_{kk}) / 2` and information :math:`Q_{kl}^2 / 2` in units of the spread,
  restricted for the jointly estimated mean (Patterson and Thompson 1971);
- all correlations, by the EM algorithm, shrunk towards zero as by an inverse Wishart prior. Its
  degrees of freedom follow from the squared scores of all pairs (method of moments), so that a few
  machines have no correlations.

The priors are hierarchical: log variances of the parameters of a kind are normal about a mean of
that kind, and the means of the kinds about a common one, relative to the priors without a type. The
standard deviations of this hierarchy, and the distance of the mean from the data sheet, are
marginalised over a grid. So the eighteen lengths of three machines are not eighteen spreads with
two degrees of freedom each, and the uncertainty of a spread widens the prior of the next machine.

Some machines were hit, or are of another type: in these an element, or everything, deviates by as
much as the priors without a type allow. A machine is weighted by the probability that it is not one
of them (a mixture; cf. Lange, Little and Taylor 1989).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from pincal.fleet.evidence import Forms, in_prior_units, log_ratios, regular, scores
from pincal.fleet.fleet_numbers import TYPES
from pincal.thresholds import Count, Scale

# Machines in the first rounds, and those with which two starting points are compared.
_FEW: Count = 400
_TRIED: Count = 100
# Largest number of rounds, and largest change of a log variance in one. They end when all changes
# are below _SETTLED plus the fraction _NEGLIGIBLE of their standard deviations.
_ROUNDS: Count = 60
_FARTHEST: Scale = 1.5
_SETTLED: Scale = 0.005
_NEGLIGIBLE: Scale = 0.05
# Standard deviations of log variances: common to all, from the priors without a type; of kinds and
# of single parameters, by grids. A log variance of 2 is a factor of e in the standard deviation.
_LEVEL: Scale = 5.0
_KINDS: tuple[Scale, ...] = (0.05, 0.5, 1.2, 2.5)
_UNLIKE: tuple[Scale, ...] = (0.1, 0.3, 0.6, 1.0, 1.5, 2.2)
# Grid of the distance of the mean from the data sheet, in units of the spread.
_OFF: tuple[Scale, ...] = (0.03, 0.1, 0.3, 0.6, 1.0, 1.8, 3.0, 6.0, 20.0)
# Prior fraction of machines that were hit, and the number of machines that this prior is worth.
_HIT: Scale = 0.02
_HIT_COUNTS: Scale = 20.0
# Largest number of rounds for correlations, and the change that ends them.
_CORRELATING: Count = 12
_CORRELATED: Scale = 0.01


@dataclass(frozen=True, eq=False)
class Population:
    """The distribution of machines, in units of the priors without a type.

    Attributes:
        mean: shape (P,).
        covariance: shape (P, P), of machines about the mean.
        mean_covariance: shape (P, P), of the mean.
        spread_variance: shape (P,), of the logarithms of the variances.
        seen: shape (P, P), projector on the directions that machines determine; along all others
            the priors hold.
        counts: shape (M,), the probability that a machine was not hit.
        hit: fraction of machines that were hit.
    """

    mean: np.ndarray
    covariance: np.ndarray
    mean_covariance: np.ndarray
    spread_variance: np.ndarray
    seen: np.ndarray
    counts: np.ndarray
    hit: float


@dataclass(frozen=True, eq=False)
class _Sums:
    """Weighted sums over machines, of scores in units of the spread.

    Attributes:
        count: sum of weights.
        q, Q, qq, QQ: of scores and covariances, and of their products; ``QQ`` elementwise.
        diagonals: of products of diagonals of Q.
        restricted: of Q C Q, with C the covariance of the mean.
    """

    count: float
    q: np.ndarray
    Q: np.ndarray
    qq: np.ndarray
    QQ: np.ndarray
    diagonals: np.ndarray
    restricted: np.ndarray

    def __add__(self, other: _Sums) -> _Sums:
        return _Sums(**{name: value + getattr(other, name) for name, value in vars(self).items()})

    @property
    def excess(self) -> np.ndarray:
        """Scatter of the scores beyond their covariance, shape (P, P)."""
        return np.asarray(self.qq - self.Q + self.restricted)


@dataclass(frozen=True, eq=False)
class _Uncorrelated:
    """A population without correlations.

    Attributes:
        theta, variance: shape (P,), log variances and their variances.
        mean, mean_covariance: shape (P,) and (P, P), in units of the spread.
        hit: fraction of machines that were hit.
    """

    theta: np.ndarray
    variance: np.ndarray
    mean: np.ndarray
    mean_covariance: np.ndarray
    hit: float = _HIT

    @property
    def spread(self) -> np.ndarray:
        """Standard deviations, shape (P,)."""
        return np.asarray(np.exp(0.5 * self.theta))


def population_of(forms: Forms, kinds: np.ndarray) -> Population:
    """Return the population of machines, whose parameters have kinds by number, shape (P,), such as
    lengths of links.
    """
    few = next(part for _, part in forms.pieces()) if len(forms) > _FEW else forms
    some = replace(forms, H=forms.H[:_TRIED], g=forms.g[:_TRIED])
    # From the mean, one machine that was hit hard becomes a wide spread of all; from the median it
    # does not.
    mean, median = (
        _uncorrelated(some, kinds, _begun(some, kinds, by_median=way))[0] for way in (False, True)
    )
    is_hit = (
        _log_likelihood(some, kinds, median) > _log_likelihood(some, kinds, mean) + TYPES.median
    )
    found, counts = _uncorrelated(few, kinds, median if is_hit else _begun(few, kinds))
    if few is not forms:
        found, counts = _uncorrelated(forms, kinds, found)
    root = _correlated(forms, found, counts)
    scale = np.outer(found.spread, found.spread)
    mean = found.spread * found.mean
    mean_covariance = found.mean_covariance * scale
    return Population(
        mean,
        root @ root.T,
        mean_covariance,
        found.variance,
        _seen(forms, counts),
        counts,
        found.hit,
    )


def _begun(forms: Forms, kinds: np.ndarray, *, by_median: bool = False) -> _Uncorrelated:
    """Return a first estimate, as if the priors without a type were the spread."""
    P = len(kinds)
    q, Q = scores(forms, np.zeros(P), np.eye(P))
    own = np.diagonal(Q, axis1=1, axis2=2)
    seen = np.mean(own, axis=0)
    square = np.mean(q**2, axis=0) + 1e-12
    if by_median:
        typical = np.nanmedian(np.where(own > 0.1, q**2, np.where(seen > 0.1, np.nan, 0.0)), axis=0)
        square = typical / chdtri(1, 0.5) + 1e-12
    for at in (kinds == kind for kind in np.unique(kinds)):
        mean = np.sum(square[at]) / max(np.sum(seen[at] ** 2), 1e-12)
        square[at] = np.where(seen[at] > 0.1, square[at], mean)
    return _Uncorrelated(np.log(square), np.zeros(P), np.zeros(P), np.zeros((P, P)))


def _sums(
    forms: Forms,
    at: _Uncorrelated,
    counts: np.ndarray | None = None,
    root: np.ndarray | None = None,
) -> _Sums:
    """Return sums over machines of a population, with the root of its covariance, shape (P, P), if
    it has correlations.

    ``counts``, shape (M,), are the weights; they are computed where they are nan.
    """
    L = np.diag(at.spread) if root is None else root
    C = at.mean_covariance
    if root is not None:
        turn = np.linalg.solve(root, np.diag(at.spread))
        C = turn @ C @ turn.T
    counts = np.full(len(forms), np.nan) if counts is None else counts
    total = None
    for rows, part in forms.pieces():
        q, Q = scores(part, at.spread * at.mean, L)
        if np.isnan(counts[rows]).any():
            counts[rows] = regular(log_ratios(part, *in_prior_units(q, Q, L)), at.hit)
        p = counts[rows]
        d = np.diagonal(Q, axis1=1, axis2=2)
        pQ = p[:, None, None] * Q
        one = _Sums(
            float(p.sum()),
            p @ q,
            pQ.sum(axis=0),
            (p[:, None] * q).T @ q,
            (pQ * Q).sum(axis=0),
            (p[:, None] * d).T @ d,
            np.tensordot(pQ @ C, Q, axes=([0, 2], [0, 1])),
        )
        total = one if total is None else total + one
    assert total is not None
    return total


def _uncorrelated(
    forms: Forms, kinds: np.ndarray, start: _Uncorrelated
) -> tuple[_Uncorrelated, np.ndarray]:
    """Return the population without correlations, and the weight of each machine, shape (M,)."""
    P = len(kinds)
    M = len(forms)
    at = start
    spreads = _spreads(kinds)
    means = [off**2 * np.eye(P) for off in _OFF]
    step = np.zeros(P)
    reach = np.full(P, _FARTHEST)
    for _ in range(_ROUNDS):
        counts = np.full(M, np.nan)
        sums = _sums(forms, at, counts)
        mean, C = _averaged(sums.Q, sums.q + sums.Q @ at.mean, means)
        information = 0.5 * sums.QQ
        slope = 0.5 * np.diag(sums.excess) + information @ at.theta
        theta, V = _averaged(information, slope, spreads)
        # Where a log variance is hardly determined, full steps would oscillate.
        gap = theta - at.theta
        reach = np.where(step * gap < 0.0, 0.5 * np.abs(step), np.minimum(2.0 * reach, _FARTHEST))
        step = np.clip(gap, -reach, reach)
        back = np.exp(-0.5 * step)
        hit = (M - counts.sum() + _HIT * _HIT_COUNTS) / (M + _HIT_COUNTS)
        at = _Uncorrelated(
            at.theta + step, np.diag(V), mean * back, C * np.outer(back, back), float(hit)
        )
        if np.all(np.abs(gap) < _SETTLED + _NEGLIGIBLE * np.sqrt(at.variance)):
            break
    return at, counts


def _spreads(kinds: np.ndarray) -> list[np.ndarray]:
    """Return the grid of prior covariances of log variances, shape (P, P) each."""
    same = (kinds[:, None] == kinds).astype(float)
    own = np.eye(len(kinds))
    return [_LEVEL**2 + k**2 * same + u**2 * own for k in _KINDS for u in _UNLIKE]


def _log_likelihood(forms: Forms, kinds: np.ndarray, at: _Uncorrelated) -> float:
    """Return the log likelihood of a population, up to a constant: of machines, usual or hit, and
    of the spreads' prior.
    """
    L = np.diag(at.spread)
    mean = at.spread * at.mean
    total = np.logaddexp.reduce(
        [
            -0.5 * at.theta @ np.linalg.solve(S, at.theta) - 0.5 * np.linalg.slogdet(S)[1]
            for S in _spreads(kinds)
        ]
    )
    total += _HIT_COUNTS * (_HIT * np.log(at.hit) + (1.0 - _HIT) * np.log1p(-at.hit))
    for _, part in forms.pieces():
        q, Q = scores(part, mean, L)
        left = np.eye(len(mean)) - Q
        logs = log_ratios(part, *in_prior_units(q, Q, L))
        own = 0.5 * (
            np.sum(q * np.linalg.solve(left, q[..., None])[..., 0], axis=1)
            + np.linalg.slogdet(left)[1]
        )
        own += (part.g - 0.5 * part.H @ mean) @ mean
        hit = np.log(at.hit / len(logs)) + np.logaddexp.reduce(logs)
        total += np.sum(own + np.logaddexp(np.log1p(-at.hit), hit))
    return float(total)


def _averaged(
    information: np.ndarray, slope: np.ndarray, priors: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return posterior mean and covariance of parameters under a mixture of priors, covariances
    about zero.

    ``information``, shape (P, P), and ``slope``, shape (P,), are of the log likelihood of the data,
    at zero.
    """
    found = list[tuple[np.ndarray, np.ndarray]]()
    logs = list[float]()
    for prior in priors:
        root = np.linalg.cholesky(prior)
        factor = np.linalg.cholesky(np.eye(len(slope)) + root.T @ information @ root)
        half = np.linalg.solve(factor, root.T)
        C = half.T @ half
        found.append((C @ slope, C))
        logs.append(0.5 * float(slope @ C @ slope) - float(np.log(np.diag(factor)).sum()))
    weights = np.exp(np.array(logs) - max(logs))
    weights /= weights.sum()
    mean = np.einsum("w,wp->p", weights, np.array([m for m, _ in found]))
    covariance = np.zeros_like(information)
    for w, (m, C) in zip(weights, found, strict=True):
        covariance += w * (C + np.outer(m - mean, m - mean))
    return mean, covariance


def _correlated(forms: Forms, at: _Uncorrelated, counts: np.ndarray) -> np.ndarray:
    """Return the root of the covariance, shape (P, P), with the correlations of the machines."""
    P = len(at.theta)
    root = np.diag(at.spread)
    sums = _sums(forms, at, counts)
    pairs = np.triu_indices(P, 1)
    slope = sums.excess[pairs]
    information = (sums.diagonals + sums.QQ)[pairs]
    total = float(np.sum(information**2))
    square = float(np.sum(slope**2 - information)) - TYPES.by_chance * np.sqrt(2.0 * total)
    if square <= 0.0:
        return root
    degrees = total / square
    for _ in range(_CORRELATING):
        spread = np.linalg.solve(root, np.diag(at.spread))
        S = (degrees * spread @ spread.T + sums.count * np.eye(P) + sums.excess) / (
            degrees + sums.count
        )
        root = root @ np.linalg.cholesky(0.5 * (S + S.T))
        if np.abs(S - np.eye(P)).max() < _CORRELATED:
            break
        sums = _sums(forms, at, counts, root)
    return root


def _seen(forms: Forms, counts: np.ndarray) -> np.ndarray:
    """Return the projector on the directions that machines determine better than the priors do,
    shape (P, P).
    """
    P = forms.g.shape[1]
    total = np.zeros((P, P))
    for rows, part in forms.pieces():
        _, Q = scores(part, np.zeros(P), np.eye(P))
        total += np.tensordot(counts[rows], Q, axes=1)
    values, vectors = np.linalg.eigh(total)
    seen = vectors[:, values > TYPES.determined]
    return np.asarray(seen @ seen.T)
