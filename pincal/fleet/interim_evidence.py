r"""Evidence of interim checks that one robot has changed since its calibration.

In units of the stated noise the readings of check t differ from the calibrated model by

.. math:: r_t = Z_t x + B_t b_t + C_t a \, [t \ge s] + \sigma e_t, \qquad
    x \sim N(0, 1), \quad b_t - b_{t-1} \sim N(0, \tau^2 d_t), \quad e_t \sim N(0, 1),

with what the calibration does not know, x, which all checks share; the base, b, which walks by
tau in a day, or stands anew at each check; a change a between two checks; and noise that is sigma
times as large as stated. Neither sigma nor tau is known. An unchanged robot has any of a range of
both, so that the evidence of a change before check s is compared with the likeliest of these
(universal inference: Wasserman, Ramdas and Balakrishnan 2020, PNAS 117, 16880-16890; for tests
that may stop at any time: Ramdas, Gruenwald, Vovk and Shafer 2023, Stat. Sci. 38, 576-601),

.. math:: E_t = \frac{\sum_s h (1 - h)^{s - 1} \int p_{s,a,\sigma,\tau}(r_1 ... r_t)
    \, d\pi(a, \sigma, \tau) + (1 - h)^t \int p_{\sigma,\tau} \, d\pi}
    {\max_{\sigma, \tau} p_{\sigma,\tau}(r_1 ... r_t)} .

It is at most a likelihood ratio, whose mean is 1, whatever sigma and tau are: on a robot that has
not changed it ever reaches :math:`1 / \alpha` with a probability of at most alpha (Ville 1939).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import logsumexp

from pincal.fleet.fleet_numbers import WATCH
from pincal.thresholds import Count, Scale

# Noise in units of what is stated, and how far the base walks in the square root of a day [m, or
# rad at a metre]. Between the noises likelihoods are interpolated, at so many in all.
_NOISES: tuple[Scale, ...] = (0.25, 0.4, 0.65, 1.05, 1.7, 2.75)
_FINE: Count = 64
_WALKS: tuple[Scale, ...] = (0.0, 1e-6, 2e-6, 4e-6, 8e-6)
# Standard deviations of the changes of a kind [m, rad or 1], beforehand, all as likely.
_SIZES: tuple[Scale, ...] = (3e-5, 1e-4, 3e-4, 1e-3)
# Standard deviation of a base that stands anew [m, rad]: of what its placement may be off by.
_ANEW: Scale = 3e-3
# Checks before each of which a change is considered; earlier ones at growing distances.
_NEAR: Count = 6
# Log likelihood below the largest one from which on a setting is negligible.
_NEGLIGIBLE: Scale = 12.0
_ROUNDING: Scale = 1e-12
# Largest log evidence, so that files have numbers.
_MOST: Scale = 600.0


@dataclass(frozen=True, eq=False)
class CheckRows:
    """The R readings of a check, in units of their stated noise.

    Attributes:
        residuals: shape (R,), reading minus prediction.
        known: shape (R, G), Z: by what the calibration does not know, in standard deviations.
        base: shape (R, 6), B: by the base [per m and rad].
        changes: shape (R, L), C: by what may change [per m, rad or 1].
        days: since the previous check, or the calibration.
        is_anew: whether the base stands anew, as after the instrument was set up again.
    """

    residuals: np.ndarray
    known: np.ndarray
    base: np.ndarray
    changes: np.ndarray
    days: float = 1.0
    is_anew: bool = False


@dataclass(frozen=True, eq=False)
class Suspect:
    """The likeliest change.

    Attributes:
        log_e: share of the log evidence.
        kind: its name.
        since: number of the first check after it, from 0.
        change: shape (k,), of the kind's columns [m, rad or 1].
        covariance: shape (k, k).
        equals: kinds that explain the readings as well, up to the odds of a fleet's.
    """

    log_e: float
    kind: str
    since: int
    change: np.ndarray
    covariance: np.ndarray
    equals: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class InterimEvidence:
    """What the checks so far show.

    Attributes:
        log_e: logarithm of the e-process.
        suspect: the likeliest change.
        chance: probability of any change, by the odds believed beforehand.
        base: shape (6,), where the base is if nothing else has changed [m, rad].
        base_covariance: shape (6, 6).
        noise: of the readings, in units of what is stated, as the checks show it.
    """

    log_e: float
    suspect: Suspect
    chance: float
    base: np.ndarray
    base_covariance: np.ndarray
    noise: float


@dataclass(eq=False)
class _Start:
    """Scores of changes before one check, of all settings of noise and walk.

    Attributes:
        since: number of the check.
        q: shape (g, L).
        Q: shape (g, L, L).
        mean: shape (g, S, L), of the state by a unit of each change.
    """

    since: int
    q: np.ndarray
    Q: np.ndarray
    mean: np.ndarray


@dataclass(eq=False)
class InterimWatch:
    """A robot monitored check by check.

    A Kalman filter for each setting of noise and walk has the likelihood of the readings so far;
    the same filter whitens the columns of changes.

    Attributes:
        kinds: columns of the changes that belong together, by name.
        chances: how likely each kind is beforehand.
        known: number G of what the calibration does not know.
        noises: shape (a,), neighbours among those of a grid, in units of what is stated.
        walks: shape (b,), of the base [m].
    """

    kinds: Mapping[str, np.ndarray]
    chances: Mapping[str, float]
    known: int
    noises: np.ndarray = field(default_factory=lambda: np.array(_NOISES))
    walks: np.ndarray = field(default_factory=lambda: np.array(_WALKS))

    def __post_init__(self) -> None:
        self._noise = np.repeat(self.noises, len(self.walks))
        self._step = np.tile(self.walks, len(self.noises))
        self._fine, self._weights = interpolation(self.noises)
        g = len(self._noise)
        S = self.known + 6
        self._mean = np.zeros((g, S))
        self._covariance = np.zeros((g, S, S))
        at = np.arange(self.known)
        self._covariance[:, at, at] = 1.0
        self._log = np.zeros(g)
        self._starts = list[_Start]()
        self.checks = 0

    @property
    def log_likelihoods(self) -> np.ndarray:
        """Log likelihood of the readings so far on an unchanged robot, shape (a, b)."""
        return self._log.reshape(len(self.noises), len(self.walks))

    def take(self, rows: CheckRows, *, with_changes: bool = True) -> None:
        """Add a check.

        Args:
            rows: its readings.
            with_changes: whether changes are considered; else only the likelihood of an unchanged
                robot is computed.
        """
        self._walk(rows)
        if with_changes:
            self._open(rows.changes.shape[1])
        H = np.hstack([rows.known, rows.base])
        PH = self._covariance @ H.T
        F = H @ PH
        diagonal = np.arange(len(H))
        F[:, diagonal, diagonal] += self._noise[:, None] ** 2
        root = np.linalg.cholesky(F)
        gain = np.linalg.solve(F, PH.swapaxes(1, 2)).swapaxes(1, 2)
        off = rows.residuals - self._mean @ H.T
        whitened = np.linalg.solve(root, off[..., None])[..., 0]
        log_det = np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
        self._log = self._log - 0.5 * np.sum(whitened**2, axis=1) - log_det
        for start in self._starts:
            self._score(start, rows.changes - H @ start.mean, whitened, root, gain)
        self._mean = self._mean + (gain @ off[..., None])[..., 0]
        covariance = self._covariance - gain @ PH.swapaxes(1, 2)
        self._covariance = 0.5 * (covariance + covariance.swapaxes(1, 2))
        self.checks += 1

    def _walk(self, rows: CheckRows) -> None:
        """Let the base walk since the previous check, or place it anew."""
        base = np.arange(self.known, self.known + 6)
        if rows.is_anew:
            self._covariance[:, base] = 0.0
            self._covariance[:, :, base] = 0.0
            self._covariance[:, base, base] = _ANEW**2
            self._mean[:, base] = 0.0
            for start in self._starts:
                start.mean[:, base] = 0.0
            return
        self._covariance[:, base, base] += self._step[:, None] ** 2 * max(rows.days, 0.0)

    def _open(self, n: int) -> None:
        """Consider changes before the next check, and some before earlier ones."""
        g, S = self._mean.shape
        new = _Start(self.checks, np.zeros((g, n)), np.zeros((g, n, n)), np.zeros((g, S, n)))
        self._starts = [s for s in self._starts if is_considered(s.since, self.checks)]
        self._starts.append(new)

    @staticmethod
    def _score(
        start: _Start, off: np.ndarray, whitened: np.ndarray, root: np.ndarray, gain: np.ndarray
    ) -> None:
        """Add a check to the scores of changes; ``off`` are their columns less what is filtered."""
        columns = np.linalg.solve(root, off)
        start.q = start.q + (whitened[:, None] @ columns)[:, 0]
        start.Q = start.Q + columns.swapaxes(1, 2) @ columns
        start.mean = start.mean + gain @ off

    def evidence(self) -> InterimEvidence:
        """Return what the checks so far show; at least one was taken."""
        logs = self._parts()
        unchanged = float(self.checks * np.log1p(-WATCH.hazard) + self._mixed(self._log))
        changed = float(logsumexp(logs))
        fine = self._at_all_noises(self._log)
        likeliest = float(fine.max())
        weights = np.exp(self._log - self._log.max())
        weights /= weights.sum()
        base, covariance = self._base(weights)
        by_noise = np.exp(logsumexp(fine, axis=-1) - logsumexp(fine))
        return InterimEvidence(
            min(float(np.logaddexp(changed, unchanged)) - likeliest, _MOST),
            self._suspect(logs, likeliest),
            float(1.0 / (1.0 + np.exp(np.clip(unchanged - changed, -_MOST, _MOST)))),
            base,
            covariance,
            float(np.exp(by_noise @ np.log(self._fine))),
        )

    def _at_all_noises(self, logs: np.ndarray) -> np.ndarray:
        """Return log likelihoods by setting, shape (..., g), at all noises, shape (..., f, b)."""
        by_noise = logs.reshape(*logs.shape[:-1], len(self.noises), len(self.walks))
        return np.asarray(self._weights @ by_noise)

    def _mixed(self, logs: np.ndarray) -> np.ndarray:
        """Return the logarithm of the mean over noises and walks of log likelihoods, shape
        (..., g); those that were left out count as zero.
        """
        fine = self._at_all_noises(logs)
        largest = fine.max(axis=(-2, -1), keepdims=True)
        found = np.log(np.exp(fine - largest).sum(axis=(-2, -1))) + largest[..., 0, 0]
        return np.asarray(found - np.log(_FINE * len(_WALKS)))

    def _parts(self) -> np.ndarray:
        """Return the weighted log likelihood of the readings by start, kind and size of a change,
        shape (starts, kinds, sizes).
        """
        q = np.array([start.q for start in self._starts])
        Q = np.array([start.Q for start in self._starts])
        since = np.array([start.since for start in self._starts])
        chances = np.array([self.chances[name] for name in self.kinds]) / len(_SIZES)
        ratios = np.stack(
            [_log_ratios(q[..., at], Q[..., at[:, None], at]) for at in self.kinds.values()], axis=1
        )
        mixed = self._mixed(self._log + np.moveaxis(ratios, -1, 2))
        prior = np.log(WATCH.hazard) + since * np.log1p(-WATCH.hazard)
        return np.asarray(mixed + prior[:, None, None] + np.log(chances)[:, None])

    def _base(self, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and covariance of the base over settings of these weights, shape (g,)."""
        mean = self._mean[:, self.known :]
        own = self._covariance[:, self.known :, self.known :]
        middle = weights @ mean
        apart = mean - middle
        return middle, np.tensordot(weights, own + apart[:, :, None] * apart[:, None], axes=1)

    def _suspect(self, logs: np.ndarray, least: float) -> Suspect:
        """Return the likeliest change by its parts of the evidence."""
        names = list(self.kinds)
        by_kind = logsumexp(logs, axis=(0, 2))
        best = int(np.argmax(by_kind))
        i, k = np.unravel_index(int(np.argmax(logs[:, best])), logs[:, best].shape)
        start = self._starts[int(i)]
        at = self.kinds[names[best]]
        g = int(np.argmax(self._log))
        covariance = np.linalg.inv(start.Q[g][np.ix_(at, at)] + np.eye(len(at)) / _SIZES[k] ** 2)
        equals = [
            names[j]
            for j in np.argsort(-by_kind)
            if j != best and by_kind[j] > by_kind[best] - WATCH.equal
        ]
        return Suspect(
            float(by_kind[best]) - least,
            names[best],
            start.since,
            covariance @ start.q[g][at],
            covariance,
            tuple(equals),
        )


def _log_ratios(q: np.ndarray, Q: np.ndarray) -> np.ndarray:
    r"""Return the logarithm of the likelihood ratio of changes of each size, shape (..., sizes).

    With the axes of the information and the score along them it is
    :math:`\tfrac12 \sum_i z_i^2 / (T^{-2} + \lambda_i) - \ln(1 + T^2 \lambda_i)`.

    Args:
        q: shape (..., n), scores.
        Q: shape (..., n, n), their covariances.
    """
    if q.shape[-1] == 1:
        information = Q[..., 0]
        along = q
    else:
        information, axes = np.linalg.eigh(Q)
        along = (q[..., None, :] @ axes)[..., 0, :]
    variance = np.array(_SIZES)[:, None] ** 2
    seen = variance * np.maximum(information, 0.0)[..., None, :]
    gain = variance * along[..., None, :] ** 2 / (1.0 + seen) - np.log1p(seen)
    return np.asarray(0.5 * gain.sum(axis=-1))


def is_considered(since: int, now: int) -> bool:
    """Return whether a change before check ``since`` is still considered at check ``now``: each of
    the last ones, the first one, and others at distances that grow with their age.

    Example:
        >>> [s for s in range(40) if is_considered(s, 40)]
        [0, 8, 16, 20, 24, 28, 30, 32, 34, 35, 36, 37, 38, 39]
    """
    age = now - since
    if age <= _NEAR or since == 0:
        return True
    apart = 1 << max(int(np.log2(age / _NEAR)) + 1, 0)
    return since % apart == 0


def interpolation(noises: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    r"""Return all noises within a range of a grid, shape (f,), and the weights by which log
    likelihoods at the grid's, shape (a,), are interpolated to these, shape (f, a).

    Of n readings of white noise a log likelihood is :math:`c - n \ln \sigma - S / (2 \sigma^2)`:
    such a curve goes through the three nearest.

    Args:
        noises: neighbours in the grid, three or more.

    Example:
        >>> nodes = np.array([0.65, 1.05, 1.7])
        >>> at = lambda noise: 3.0 - 50.0 * np.log(noise) - 40.0 / noise**2
        >>> fine, weights = interpolation(nodes)
        >>> bool(np.allclose(weights @ at(nodes), at(fine))), round(float(fine[0]), 2)
        (True, 0.67)
    """
    whole = np.exp(np.linspace(np.log(_NOISES[0]), np.log(_NOISES[-1]), _FINE))
    fine = whole[(whole >= noises[0] - _ROUNDING) & (whole <= noises[-1] + _ROUNDING)]
    weights = np.zeros((len(fine), len(noises)))
    for row, noise in zip(weights, fine, strict=True):
        middle = int(np.argmin(np.abs(np.log(noises / noise))))
        middle = min(max(middle, 1), len(noises) - 2)
        near = slice(middle - 1, middle + 2)
        row[near] = np.linalg.solve(_curve(noises[near]).T, _curve(np.array([noise]))[0])
    return fine, weights


def _curve(noises: np.ndarray) -> np.ndarray:
    """Return the terms of a log likelihood of white noise at some noises, shape (n, 3)."""
    return np.column_stack([np.ones(len(noises)), np.log(noises), noises**-2.0])


def interim_evidence(
    checks: Sequence[CheckRows], kinds: Mapping[str, np.ndarray], chances: Mapping[str, float]
) -> InterimEvidence:
    """Return what a series of checks shows; noises and walks that none of them supports are left
    out, which makes the evidence smaller.
    """
    known = checks[0].known.shape[1]
    whole = InterimWatch(kinds, chances, known)
    for rows in checks:
        whole.take(rows, with_changes=False)
    logs = whole.log_likelihoods
    kept = logs > logs.max() - _NEGLIGIBLE
    used = np.flatnonzero(kept.any(axis=1))
    # Interpolation needs neighbours.
    first = min(max(used[0] - 2, 0), len(_NOISES) - 3)
    noises = whole.noises[first : max(used[-1] + 3, first + 3)]
    watch = InterimWatch(kinds, chances, known, noises, whole.walks[kept.any(axis=0)])
    for rows in checks:
        watch.take(rows)
    return watch.evidence()
