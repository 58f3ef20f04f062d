r"""Search for errors of one joint that depend on its own position and on another joint's.

Along the lever of joint i the residuals are scanned for waves of both positions,

.. math:: \{\sin, \cos\}(m q_i) \, \{\sin, \cos\}(n q_j) ,

of any orders m and n up to the finest that counts as smooth. With w and v as for waves of one joint
(``levers.py``) and :math:`F_u(a, b) = \sum_p u_p e^{i (a q_i + b q_j)}`, products and squares of
the four functions are sums of F at sums and differences of the orders, so that all orders of a pair
follow from products of small matrices. What is found is tested like any other candidate, corrected
for the number of orders and pairs searched.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import chdtri

from pincal.discover.levers import seen_along, situation_of
from pincal.discover.wave_numbers import WAVES
from pincal.identify.fit import ModelFit
from pincal.model.catalogue.ripple import independent_orders, resolution_of
from pincal.model.catalogue.unnamed import wave_of_two
from pincal.model.effect import Effect
from pincal.thresholds import Count

# Parameters of a wave of two joints.
_FUNCTIONS: Count = 4


class _Peak(NamedTuple):
    """Orders at which a wave of two joints explains most.

    Attributes:
        start: shape (2,), m and n on a grid.
        steps: shape (2,), of the grid; 0 for an order that stays.
        shift: shape (2,), in steps, to the largest gain within a step on a finer grid.
        gain: there.
    """

    start: np.ndarray
    steps: np.ndarray
    shift: np.ndarray
    gain: float


@dataclass(frozen=True, eq=False)
class PairOfJoints:
    """Residuals along the lever of a joint, to be explained by its position and another's.

    Attributes:
        own, others: shape (N,), positions of the joint and of the other [rad].
        along, lever: shape (N,), w and v.
    """

    own: np.ndarray
    others: np.ndarray
    along: np.ndarray
    lever: np.ndarray

    @property
    def count(self) -> float:
        """Number of independent orders."""
        band = (0.0, WAVES.smooth)
        return independent_orders(self.own, band) * independent_orders(self.others, band)

    @cached_property
    def peak(self) -> _Peak:
        """The orders on a grid that explain most, and the largest gain close to them."""
        steps = np.array([WAVES.pair_step * resolution_of(q) for q in (self.own, self.others)])
        m, n = (np.arange(0.0, WAVES.smooth, step) for step in steps)
        gains = self.gains(m, n[1:])
        i, j = np.unravel_index(int(np.argmax(gains)), gains.shape)
        start = np.array([m[i], n[1 + j]])
        # A wave of the other joint alone remains one.
        steps *= start > 0.0
        close = np.linspace(-1.0, 1.0, 2 * WAVES.pair_closer + 1)
        finer = self.gains(*(at + step * close for at, step in zip(start, steps, strict=True)))
        i, j = np.unravel_index(int(np.argmax(finer)), finer.shape)
        return _Peak(start, steps, close[[i, j]], float(finer[i, j]))

    def strongest(self) -> tuple[float, tuple[float, float]]:
        """Return the gain of the wave that explains most, and its orders m and n."""
        peak = self.peak

        def loss(shift: np.ndarray) -> tuple[float, np.ndarray]:
            gain, slope = self.gain(*(peak.start + peak.steps * shift).tolist())
            return -gain, -peak.steps * slope

        limits = [(-1.0, 1.0)] * 2
        found = minimize(loss, peak.shift, jac=True, method="L-BFGS-B", bounds=limits)
        own, other = (round(float(k), WAVES.digits) for k in peak.start + peak.steps * found.x)
        return -float(found.fun), (own, other)

    def gain(self, m: float, n: float) -> tuple[float, np.ndarray]:
        """Return the gain of the wave of one pair of orders, by its four functions themselves, and
        its derivatives by these, shape (2,).

        The gain is largest at the wave that fits best, so that it changes with the orders as it
        would with this wave's parameters held.
        """
        own = m * self.own
        other = n * self.others
        of_own = np.stack([np.cos(own), np.sin(own)])
        of_other = np.stack([np.cos(other), np.sin(other)])
        basis = (of_own[:, None] * of_other).reshape(_FUNCTIONS, -1)
        S = (basis * self.lever) @ basis.T
        # As of the exponentials in `gains`, of which each function is a quarter of four.
        S.flat[:: _FUNCTIONS + 1] += WAVES.map_seen * self.lever.sum() / _FUNCTIONS
        b = basis @ self.along
        fitted = np.linalg.solve(S, b)
        left = self.along - self.lever * (fitted @ basis)
        # Of cosine and sine, minus the sine and the cosine.
        cosine, sine = fitted.reshape(2, 2) @ of_other
        by_own = (sine * of_own[0] - cosine * of_own[1]) * self.own
        cosine, sine = fitted.reshape(2, 2).T @ of_own
        by_other = (sine * of_other[0] - cosine * of_other[1]) * self.others
        return float(b @ fitted), 2.0 * np.array([by_own @ left, by_other @ left])

    def gains(self, m: np.ndarray, n: np.ndarray) -> np.ndarray:
        """Return the gains of waves of orders m of the joint, shape (M,), and n of the other, shape
        (K,), each 0 or more, shape (M, K).

        The four functions are combined to exp i(mq + nq'), exp i(mq - nq') and their conjugates.
        """
        own = np.exp(1j * np.outer(m, self.own))
        other = np.exp(1j * np.outer(n, self.others))
        twice = own**2 * self.lever
        sums = twice @ (other**2).T
        differences = twice @ (other.conj() ** 2).T
        of_own = np.broadcast_to(twice.sum(axis=1)[:, None], sums.shape)
        of_other = np.broadcast_to(other**2 @ self.lever, sums.shape)
        whole = np.full(sums.shape, (1.0 + WAVES.map_seen) * self.lever.sum(), complex)
        first = (own * self.along) @ other.conj().T
        second = (own * self.along) @ other.T
        b = np.stack([second.conj(), first.conj(), second, first], axis=-1)
        upper = [
            [whole, of_other.conj(), sums.conj(), of_own.conj()],
            [of_other, whole, of_own.conj(), differences.conj()],
            [sums, of_own, whole, of_other],
            [of_own, differences, of_other.conj(), whole],
        ]
        S = np.moveaxis(np.array(upper), (0, 1), (-2, -1))
        return np.asarray(np.sum(b.conj() * np.linalg.solve(S, b[..., None])[..., 0], axis=-1).real)


def _tells_orders(q: np.ndarray) -> bool:
    """Return whether positions of a joint, shape (N,), reach far enough to tell any order searched
    from none.
    """
    return bool(WAVES.pair_step * resolution_of(q) < WAVES.smooth)


def likely_waves_of_two(
    fit: ModelFit, joints: Sequence[str], wanted: Collection[str] | None = None
) -> list[Effect]:
    """Return for each of some joints the wave of its own and another's position that explains most,
    if it is worth a test.

    The gain is without a refit; each is then tested like any other candidate, corrected for the
    orders and pairs searched. Only those of ``wanted`` joints are
    returned, default: of all.
    """
    situation = situation_of(fit)
    turning = [joint for joint in joints if joint in situation.revolute]
    others = [joint for joint in situation.revolute if joint in situation.moving]
    if not turning or len(others) < 2:
        return []
    drives = np.array([int(fit.problem.chain.drives[situation.index(joint)]) for joint in turning])
    along, lever = seen_along(fit, drives)
    found = list[Effect]()
    for joint, b, v in zip(turning, along, lever, strict=True):
        is_wanted = wanted is None or joint in wanted
        if not is_wanted or joint not in others or not v.any():
            continue
        wide = [k for k in others if k != joint and _tells_orders(situation.positions(k))]
        own = situation.positions(joint)
        pairs = {k: PairOfJoints(own, situation.positions(k), b, v) for k in wide}
        if not pairs:
            continue
        among = len(turning) * sum(pair.count for pair in pairs.values())
        worth = float(chdtri(_FUNCTIONS, WAVES.worth / among))
        # Orders are refined only where the gain may then be the largest one, and worth a test.
        least = WAVES.pair_seen * max(worth, *(pair.peak.gain for pair in pairs.values()))
        waves = {other: pair.strongest() for other, pair in pairs.items() if pair.peak.gain > least}
        if not waves:
            continue
        likeliest = max(waves, key=lambda other: waves[other][0])
        gain, orders = waves[likeliest]
        if orders[1] and gain > worth:
            found.append(wave_of_two(joint, likeliest, orders, among))
    return found
