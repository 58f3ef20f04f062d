r"""Levers: derivatives of readings by the coordinates of an arm; search for waves and maps of joint
positions along them.

With w = L . r and v = L . L at each pose (L the lever of a joint's position on its whitened
readings, r their residuals, orthogonal to the columns of a fit), and
:math:`F_u(k) = \sum_n u_n e^{i k q_n}`, a wave of k cycles per revolution reduces the squares by

.. math:: T(k) = 2 \,
    \frac{V |F_w(k)|^2 - \Re (\overline{F_v(2k)} F_w(k)^2)}{V^2 - |F_v(2k)|^2},
    \qquad V = \sum_n v_n ,

if the model absorbs none of it. On even steps of k the exponential of a sum is a product, so that
all k follow from one product of two small matrices. The result is tested like any other candidate,
corrected for the number of orders searched.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from pincal.discover.wave_numbers import WAVES
from pincal.identify.fit import ModelFit
from pincal.identify.fit_levers import with_motions
from pincal.model.basis import FEWEST_SPLINES, spline_basis
from pincal.model.catalogue.bearing_features import bearing_features
from pincal.model.catalogue.candidates import elasticity
from pincal.model.catalogue.ripple import resolution_of
from pincal.model.catalogue.unnamed import maps_of
from pincal.model.conditions import PoseSet
from pincal.model.effect import Candidate, Effect, Harmonic
from pincal.model.effects import Compliance
from pincal.model.model import Model


def compliances_of(model: Model, values: np.ndarray) -> np.ndarray:
    """Return the linear compliances of a model, k about each joint's x, y, z in turn, shape (3 n,)
    [rad/(N m)].
    """
    joints = model.chain.robot.joint_names
    k = np.zeros(3 * len(joints))
    for effect in model.effects:
        if not isinstance(effect, Compliance):
            continue
        for parameter in effect.parameters(model.chain):
            axis = "xyz".index(parameter.symbol[-1])
            k[3 * joints.index(parameter.element) + axis] = values[model.index(parameter.name)]
    return k


def situation_of(fit: ModelFit) -> PoseSet:
    """Return the poses of a fit, with its compliances, for which candidates are generated."""
    compliances = tuple(compliances_of(*fit.arm).tolist())
    return PoseSet(fit.problem.chain, fit.problem.conditions, compliances)


def missing_compliances(fit: ModelFit) -> tuple[Compliance, ...]:
    """Return the linear compliances that the poses excite and a fit lacks."""
    chain = fit.problem.chain
    present = {
        p.name
        for e in fit.problem.effects
        if isinstance(e, Compliance)
        for p in e.parameters(chain)
    }
    found = []
    for effect in elasticity(situation_of(fit)):
        assert isinstance(effect, Compliance)
        parts = effect.parts(chain)
        joints = tuple(
            str(part.only) for part in parts if part.parameters(chain)[0].name not in present
        )
        if joints:
            found.append(effect if len(joints) == len(parts) else replace(effect, joints=joints))
    return tuple(found)


def missing_features(fit: ModelFit) -> list[Effect]:
    """Return the places and directions of bearings that are nominal in a fit."""
    return missing_from(fit, bearing_features(fit.problem.chain, fit.problem.effects))


def missing_from(fit: ModelFit, effects: Iterable[Effect]) -> list[Effect]:
    """Return the effects that a fit lacks."""
    present = {effect.identity for effect in fit.problem.effects}
    return [effect for effect in effects if effect.identity not in present]


def strongest_tones(fit: ModelFit, candidates: Sequence[Candidate], near: float) -> list[Harmonic]:
    """Return, for each joint whose residuals show one, the wave that explains most, and others up
    to ``near`` below.
    """
    every = (candidate.effect for candidate in candidates)
    tones = [tone for tone in every if isinstance(tone, Harmonic) and tone.band is not None]
    if not tones:
        return []
    joints = [fit.problem.chain.robot.joint_names.index(str(tone.locus.joint)) for tone in tones]
    along, lever = seen_along(fit, np.asarray(fit.problem.chain.drives)[joints])
    q = fit.problem.conditions.q.T[joints]
    return [
        tone
        for parts in zip(tones, q, along, lever, strict=True)
        for tone in _strongest(fit, *parts, near)
    ]


def seen_along(fit: ModelFit, coordinates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return L . r and L . L of some coordinates on the whitened readings, shape (K, N) each."""
    problem, values, free = with_motions(fit, coordinates)
    n = len(fit.problem)
    along, lever = np.zeros((2, len(coordinates), n))
    for station, places, blocks, rows in zip(
        problem.stations, problem.places, problem.block_spans, problem.rows, strict=True
    ):
        sigma = np.repeat(fit.solution.estimated[blocks], station.block_sizes)
        weights = station.weights * fit.solution.weights[rows]
        for piece, residuals, jacobian in station.linearise(values[places], free[places]):
            scale = weights[piece] / sigma[:, None]
            here = np.arange(n)[rows][piece]
            moved = jacobian * scale
            along[:, here] = np.einsum("kmn,mn->kn", moved, residuals * scale)
            lever[:, here] = np.einsum("kmn,kmn->kn", moved, moved)
    return along, lever


def _strongest(
    fit: ModelFit, tone: Harmonic, q: np.ndarray, along: np.ndarray, lever: np.ndarray, near: float
) -> Iterator[Harmonic]:
    """Yield the wave that explains most of a joint's residuals, if it is worth a test, and its
    aliases.
    """
    assert tone.band is not None
    resolution = resolution_of(q)
    step = WAVES.step * resolution
    orders, gains = on_steps(q, along, lever, start=tone.band[0], step=step, end=tone.band[1])
    for known in fit.problem.effects:
        if isinstance(known, Harmonic) and known.locus.joint == tone.locus.joint:
            gains[np.abs(orders - (known.locus.order or 0.0)) < resolution] = 0.0
    least = 2.0 * np.log(tone.trials / WAVES.worth)
    for _ in range(1 + WAVES.aliases):
        highest = int(np.argmax(gains))
        if gains[highest] < least:
            return
        close = orders[highest] + step * np.linspace(-1.0, 1.0, 2 * WAVES.closer + 1)
        sums = np.stack([_sums(q, along, close), _sums(q, lever, 2.0 * close)])
        finer = _gains(sums, float(lever.sum()))
        best = int(np.argmax(finer))
        least = max(least, float(finer[best]) - near)
        yield tone.tuned(round(float(close[best]), WAVES.digits), tone.trials)
        gains[np.abs(orders - orders[highest]) < resolution] = 0.0


def on_steps(
    q: np.ndarray,
    along: np.ndarray,
    lever: np.ndarray,
    *,
    start: float,
    step: float,
    end: float,
    is_beside_constant: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Return even steps of orders, shape (K,), and the gain of each, shape (K,), perhaps given a
    constant.
    """
    coarse = start + WAVES.fine * step * np.arange(
        int(np.ceil((end - start) / (WAVES.fine * step)))
    )
    fine = step * np.arange(WAVES.fine)
    columns = [(along, 1), (lever, 2), (lever, 1)][: 2 + is_beside_constant]
    sums = np.zeros((len(columns), len(coarse), WAVES.fine), complex)
    for at in range(0, len(q), WAVES.piece):
        piece = slice(at, at + WAVES.piece)
        a, b = (_waves(k, q[piece]) for k in (coarse, fine))
        for total, (u, times) in zip(sums, columns, strict=True):
            total += (a**times * u[piece]) @ (b**times).T
    F, twice, *mean = sums.reshape(len(columns), -1)
    whole = np.array(lever.sum())
    for m in mean:
        # The constant absorbs its part of each wave.
        F = F - m * along.sum() / whole
        twice = twice - m**2 / whole
        whole = whole - np.abs(m) ** 2 / whole
    orders = np.add.outer(coarse, fine).ravel()
    return orders[orders <= end], _gains(np.stack([F, twice]), whole)[orders <= end]


def _waves(orders: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return exp(i k q) of even steps of orders k, shape (K, N), by repeated multiplication."""
    factors = np.empty((len(orders), len(q)), complex)
    factors[:1] = np.exp(1j * orders[0] * q)
    factors[1:] = np.exp(1j * (orders[-1] - orders[0]) / max(len(orders) - 1, 1) * q)
    return np.cumprod(factors, axis=0)


def _sums(q: np.ndarray, u: np.ndarray, orders: np.ndarray) -> np.ndarray:
    """Return F_u at even steps of orders, shape (K,)."""
    return np.asarray(_waves(orders, q) @ u)


def _gains(sums: np.ndarray, whole: np.ndarray | float) -> np.ndarray:
    """Return T from F_w(k) and F_v(2k), shape (2, K); zero where the positions sample a single
    phase of a wave.
    """
    F, twice = sums
    rest = whole**2 - np.abs(twice) ** 2
    gains = (
        2.0
        * (whole * np.abs(F) ** 2 - (np.conj(twice) * F**2).real)
        / np.maximum(rest, WAVES.phases * whole**2)
    )
    return np.where(rest > WAVES.phases * whole**2, gains, 0.0)


def likely_maps(fit: ModelFit, joints: Sequence[str]) -> list[Effect]:
    """Return the map of largest gain at some joints, in its coarsest and a finer resolution, if it
    is worth a test.

    The gain is without a refit; the map is then tested like any other candidate, corrected for the
    pairs of joints searched.
    """
    situation = situation_of(fit)
    chain = fit.problem.chain
    drives = [int(chain.drives[situation.index(joint)]) for joint in joints]
    along, lever = seen_along(fit, np.array(drives))
    columns = {joint: situation.positions(joint) for joint in situation.joints}
    splines = {
        name: spline_basis(q, q.min(), q.max(), FEWEST_SPLINES)
        for name, q in columns.items()
        if name in situation.moving
    }
    found: list[tuple[float, Sequence[Effect]]] = []
    for joint, b, v in zip(joints, along, lever, strict=True):
        for effect in maps_of(situation, joint):
            forms = effect.resolutions(situation)
            if forms and missing_from(fit, [effect]):
                basis = np.einsum("an,bn->abn", splines[joint], splines[effect.depends_on]).reshape(
                    -1, len(b)
                )
                S = (basis * v) @ basis.T
                g = basis @ b
                ridge = WAVES.map_seen * float(np.diag(S).max(initial=0.0))
                gain = float(g @ np.linalg.solve(S + ridge * np.eye(len(S)), g)) if ridge else 0.0
                found.append((gain, forms))
    gain, likeliest = max(found, key=lambda one: one[0], default=(0.0, ()))
    worth = float(chdtri(FEWEST_SPLINES**2, WAVES.worth / max(len(found), 1)))
    tried = likeliest[: WAVES.map_forms]
    return list(dict.fromkeys([tried[0], tried[-1]])) if gain > worth else []
