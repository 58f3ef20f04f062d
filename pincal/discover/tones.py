r"""Which waves of a joint's position, many a turn, a fit leaves: a periodogram of its residuals along the joint's lever.

With w = L . r and v = L . L at each pose (L the lever of a joint's position on its whitened readings, r their residuals,
which a fit has made orthogonal to its own columns), and :math:`F_u(k) = \sum_n u_n e^{i k q_n}`, a wave of k periods a turn
takes off the squares

.. math:: T(k) = 2 \, \frac{V |F_w(k)|^2 - \Re (\overline{F_v(2k)} F_w(k)^2)}{V^2 - |F_v(2k)|^2}, \qquad V = \sum_n v_n ,

if the model takes up none of it. On even steps of k the exponential of a sum is a product, so that all k are one product
of two small matrices. What is found is tested like any other candidate, and pays for all orders among which it was chosen.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from pincal.discover.levers import Motions
from pincal.identify.fit import Fit
from pincal.identify.normal import block_rows
from pincal.model.catalogue.tones import resolution_of
from pincal.model.effect import Candidate, Tone

# Steps of a periodogram in periods over the whole range: the highest is then seen at 95 % of its square or more.
_STEP = 0.25
# Steps of the one small matrix; the other has as many as it takes.
_FINE = 48
# Steps about the highest to find its place, each way.
_CLOSER = 16
# Rows whose exponentials are held at once.
_PIECE = 4096
# Chance of the highest below which it becomes a candidate; the test that follows is exact and asks for more.
_WORTH_A_TEST = 0.05
# Other orders that explain as much, at most.
_MOST_ALIASES = 3
# Part of V^2 by which two phases of a wave have to differ to be told apart.
_SEEN = 1e-3
# Digits of an order that are kept.
_DIGITS = 2


def strongest_tones(fit: Fit, candidates: Sequence[Candidate], near: float) -> list[Tone]:
    """Return, for each joint whose residuals show one, the wave that explains most, and others that explain as much.

    Args:
        fit: the fit.
        candidates: effects that its poses could show.
        near: squares by which the others may explain less.
    """
    tones = [candidate.effect for candidate in candidates if isinstance(candidate.effect, Tone)]
    tones = [tone for tone in tones if tone.band is not None]
    if not tones:
        return []
    joints = [fit.problem.chain.robot.joint_names.index(str(tone.locus.joint)) for tone in tones]
    along, lever = seen_along(fit, np.asarray(fit.problem.chain.drives)[joints])
    q = fit.problem.conditions.q.T[joints]
    return [tone for parts in zip(tones, q, along, lever, strict=True) for tone in _strongest(fit, *parts, near)]


def seen_along(fit: Fit, coordinates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return L . r and L . L of some coordinates on the whitened readings, shape (K, N) each."""
    motions = Motions(tuple(map(int, coordinates)))
    along, lever = np.zeros((2, len(coordinates), len(fit.problem)))
    for (station, places, blocks), rows in zip(fit.stations, fit.problem.rows, strict=True):
        of_model, of_sensor = station.split(fit.values[places])
        wide = station.with_model(station.model.with_effects([*station.model.effects, motions]))
        values = np.concatenate([of_model, np.zeros(len(coordinates)), of_sensor])
        free = np.zeros(len(values), bool)
        free[len(of_model) : len(of_model) + len(coordinates)] = True
        weights = station.weights * fit.solution.weights[rows]
        sigma = np.concatenate(
            [
                np.full(at.stop - at.start, s)
                for at, s in zip(block_rows(station), fit.solution.estimated[blocks], strict=True)
            ]
        )
        for piece, residuals, jacobian in wide.linearise(values, free):
            scale = weights[piece] / sigma[:, None]
            here = np.arange(len(fit.problem))[rows][piece]
            moved = jacobian * scale
            along[:, here] = np.einsum("kmn,mn->kn", moved, residuals * scale)
            lever[:, here] = np.einsum("kmn,kmn->kn", moved, moved)
    return along, lever


def _strongest(fit: Fit, tone: Tone, q: np.ndarray, along: np.ndarray, lever: np.ndarray, near: float) -> Iterator[Tone]:
    """Yield the wave that explains most of what a joint leaves, if it is worth a test, and its like."""
    assert tone.band is not None
    resolution = resolution_of(q)
    step = _STEP * resolution
    orders, gains = _on_steps(q, along, lever, start=tone.band[0], step=step, end=tone.band[1])
    for known in fit.problem.effects:
        if isinstance(known, Tone) and known.locus.joint == tone.locus.joint:
            gains[np.abs(orders - (known.locus.order or 0.0)) < resolution] = 0.0
    least = 2.0 * np.log(tone.looks / _WORTH_A_TEST)
    for _ in range(1 + _MOST_ALIASES):
        highest = int(np.argmax(gains))
        if gains[highest] < least:
            return
        close = orders[highest] + step * np.linspace(-1.0, 1.0, 2 * _CLOSER + 1)
        sums = np.stack([_sums(q, along, close), _sums(q, lever, 2.0 * close)])
        finer = _gains(sums, float(lever.sum()))
        best = int(np.argmax(finer))
        least = max(least, float(finer[best]) - near)
        yield tone.tuned(round(float(close[best]), _DIGITS), tone.looks)
        gains[np.abs(orders - orders[highest]) < resolution] = 0.0


def _on_steps(
    q: np.ndarray, along: np.ndarray, lever: np.ndarray, *, start: float, step: float, end: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return even steps of orders, shape (K,), and what each takes off the squares, shape (K,)."""
    coarse = start + _FINE * step * np.arange(int(np.ceil((end - start) / (_FINE * step))))
    fine = step * np.arange(_FINE)
    sums = np.zeros((2, len(coarse), _FINE), complex)
    for at in range(0, len(q), _PIECE):
        piece = slice(at, at + _PIECE)
        a, b = (_waves(k, q[piece]) for k in (coarse, fine))
        sums[0] += (a * along[piece]) @ b.T
        sums[1] += (a**2 * lever[piece]) @ (b**2).T
    orders = np.add.outer(coarse, fine).ravel()
    gains = _gains(sums.reshape(2, -1), float(lever.sum()))
    return orders[orders <= end], gains[orders <= end]


def _waves(orders: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return exp(i k q) of even steps of orders, shape (K, N): each step is one more factor."""
    factors = np.empty((len(orders), len(q)), complex)
    factors[:1] = np.exp(1j * orders[0] * q)
    factors[1:] = np.exp(1j * (orders[-1] - orders[0]) / max(len(orders) - 1, 1) * q)
    return np.cumprod(factors, axis=0)


def _sums(q: np.ndarray, u: np.ndarray, orders: np.ndarray) -> np.ndarray:
    """Return F_u at even steps of orders, shape (K,)."""
    return np.asarray(_waves(orders, q) @ u)


def _gains(sums: np.ndarray, whole: float) -> np.ndarray:
    """Return T from F_w(k) and F_v(2k), shape (2, K); zero where the positions show one phase of a wave only."""
    F, twice = sums
    rest = whole**2 - np.abs(twice) ** 2
    gains = 2.0 * (whole * np.abs(F) ** 2 - (np.conj(twice) * F**2).real) / np.maximum(rest, _SEEN * whole**2)
    return np.where(rest > _SEEN * whole**2, gains, 0.0)
