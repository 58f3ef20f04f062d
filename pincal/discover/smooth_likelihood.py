r"""Likelihood of errors that are smooth in the joints: how long, how large, and which of them
readings can tell.

With b and S the gradient and information of the amplitudes of waves given a refit of the model
(:mod:`pincal.discover.first_order`), in units of their priors, :math:`\lambda_i` the eigenvalues of
S and :math:`c_i` the components of b along its eigenvectors, the log evidence of errors with a
variance t times that of the priors, beside a noise v times that of the fit, is

.. math:: -\tfrac12 \Big[ \nu \log v + \frac{R}{v} - \sum_i \frac{t c_i^2}{v (v + t \lambda_i)}
    + \sum_i \log(1 + t \lambda_i / v) \Big] ,

with R the squares that the model leaves, of :math:`\nu` degrees of freedom. It is computed on a
sample of the rows. Of the directions of each place's amplitudes only those are fitted of which the
readings of all rows tell most, ``REMAINDER.most`` of them and none of which they tell less than
``REMAINDER.told`` of the prior: it would keep its prior. Which they are depends on where the poses
are, and not on what was read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import comb

import numpy as np

from pincal.discover.first_order import ScoreTests
from pincal.discover.remainder_numbers import REMAINDER
from pincal.discover.score_tests import Tangent
from pincal.identify.fit import ModelFit
from pincal.model.catalogue.remainder import Erring, SmoothRemainder
from pincal.model.conditions import moves
from pincal.sensors.row_samples import evenly


@dataclass(frozen=True)
class SizedRemainders:
    """Remainders of the likeliest sizes.

    Attributes:
        effects: the remainders.
        evidence: log evidence in their favour.
        noise: variance of the noise beside them, in units of the fit's.
    """

    effects: tuple[SmoothRemainder, ...]
    evidence: float
    noise: float


def likely_remainders(fit: ModelFit) -> list[tuple[SmoothRemainder, ...]]:
    """Return remainders that have more evidence than none, the likeliest first: errors of drives,
    displacements along the base's axes, and both, of the likeliest lengths and sizes.
    """
    few = _sample(fit)
    tangent = Tangent.at(few, (), None)
    rows = len(fit.problem) / max(len(few.problem), 1)
    by_kind = [_of_lengths(tangent, raw, rows) for raw in _kinds(few)]
    alone = [one for of_kind in by_kind for one in of_kind[:1]]
    both = [
        _likeliest(tangent, [_shortened(effect) for one in pair for effect in one.effects])
        for pair in product(*(of_kind[: REMAINDER.tried_together] for of_kind in by_kind))
        if len(pair) > 1 and max(one.evidence for one in pair) > 0.0
    ]
    found = sorted((*alone, *both), key=lambda one: -one.evidence)
    return [one.effects for one in found if one.evidence > REMAINDER.evidence]


def _sample(fit: ModelFit) -> ModelFit:
    """Return a fit on some of its sound rows, evenly spread, not fitted again."""
    sound = np.flatnonzero(fit.solution.weights > 0.0)
    if len(sound) <= REMAINDER.rows and len(sound) == len(fit.problem):
        return fit
    return fit.select(sound[evenly(len(sound), REMAINDER.rows)])


def _kinds(fit: ModelFit) -> list[SmoothRemainder]:
    """Return the remainders that an arm may have, of any length and size."""
    chain = fit.problem.chain
    robot = chain.robot
    does = moves(fit.problem.conditions.q)
    kinds = zip(robot.joint_names, robot.joint_types, does, strict=True)
    joints = tuple(joint for joint, kind, is_moved in kinds if kind != "prismatic" and is_moved)
    together = REMAINDER.together
    if len(joints) < together:
        return []
    count = REMAINDER.waves * comb(len(joints), together)
    places: list[Erring] = ["drive", "base"] if chain.path.start == robot.base else ["drive"]
    size = REMAINDER.sizes[0]
    return [
        SmoothRemainder(joints, together, REMAINDER.lengths[0], size, count, of) for of in places
    ]


def _of_lengths(tangent: Tangent, raw: SmoothRemainder, rows: float) -> list[SizedRemainders]:
    """Return a remainder of each length with the likeliest size, the likeliest first, in the sums
    of waves of which ``rows`` times as many rows tell most; without those of which none does.
    """
    found = list[SizedRemainders]()
    for length in REMAINDER.lengths:
        modes = Modes.of(tangent, replace(raw, length=length))
        largest = modes.told(rows * (REMAINDER.sizes[-1] / raw.size) ** 2)
        if largest is not None:
            one = _likeliest(tangent, [largest])
            told = modes.told(rows * (one.effects[0].size / raw.size) ** 2 / one.noise)
            if told is not None:
                effect = replace(told, size=one.effects[0].size)
                found.append(replace(one, effects=(effect,)))
    return sorted(found, key=lambda one: -one.evidence)


@dataclass(frozen=True, eq=False)
class Modes:
    """Orthonormal sums of waves of each place, and what readings tell of them.

    Attributes:
        effect: the remainder in single waves.
        sums: of each place that errs, shape (2 K, 2 K), in rows.
        information: shape (places, 2 K), of their amplitudes, to that of the priors.
        waves: shape (2 K, n), at the rows.
    """

    effect: SmoothRemainder
    sums: np.ndarray
    information: np.ndarray
    waves: np.ndarray

    @classmethod
    def of(cls, tangent: Tangent, effect: SmoothRemainder) -> Modes:
        """Return those of a remainder given a refit of the model."""
        sums = list[np.ndarray]()
        told = list[np.ndarray]()
        for place in effect.erring:
            tests = tangent.tests([replace(effect, places=(place,))], wider=1.0)
            j, S, _ = tests.within([0])
            sizes = tests.sizes[tests.n_model + j]
            values, axes = np.linalg.eigh(np.outer(sizes, sizes) * S)
            sums.append(axes.T)
            told.append(values)
        problem = tangent.fit.problem
        waves = effect.waves(problem.chain, problem.conditions)
        return cls(effect, np.array(sums), np.array(told), waves)

    def told(self, variance: float) -> SmoothRemainder | None:
        """Return the remainder in the sums of which readings tell most, if errors, or the readings'
        number, are so many times as large; None if they tell enough of none.
        """
        known = variance * self.information
        every = np.sort(known.ravel())
        least = max(REMAINDER.told, float(every[-min(REMAINDER.most, len(every))]))
        kept = [sums[of >= least][::-1] for sums, of in zip(self.sums, known, strict=True)]
        if not any(map(len, kept)):
            return None
        # A unit of an amplitude is about the largest error that it causes.
        largest = max(np.abs(sums @ self.waves).max() for sums in kept if len(sums))
        modes = (
            tuple(tuple(mode) for mode in np.round(sums / largest, REMAINDER.digits).tolist())
            for sums in kept
        )
        pairs = [(of, own) for of, own in zip(self.effect.erring, modes, strict=True) if own]
        places, own = zip(*pairs, strict=True)
        return replace(self.effect, places=places, modes=own)


def _shortened(effect: SmoothRemainder) -> SmoothRemainder:
    """Return a remainder in a part of its sums, those of which readings tell most, so that two have
    as many as one.
    """
    most = max(REMAINDER.most // 2 // len(effect.modes), 1)
    return replace(effect, modes=tuple(of[:most] for of in effect.modes))


def _likeliest(tangent: Tangent, effects: Sequence[SmoothRemainder]) -> SizedRemainders:
    """Return remainders together with the likeliest sizes."""
    return _likeliest_of(tangent.tests(effects, wider=1.0), effects)


def _likeliest_of(tests: ScoreTests, effects: Sequence[SmoothRemainder]) -> SizedRemainders:
    """Return tested remainders with the likeliest sizes of the policy."""
    which = range(len(effects))
    j, S, b = tests.within(which)
    prior = tests.sizes[tests.n_model + j]
    own = np.concatenate([np.full(len(tests.columns[i]), i) for i in which])
    left = tests.squares_left
    none = -0.5 * tests.dof * (np.log(left / tests.dof) + 1.0)
    best: tuple[float, float, tuple[float, ...]] = (-np.inf, 1.0, ())
    # Sizes of one remainder need one decomposition, those of several one for each ratio.
    first, *others = (np.array(REMAINDER.sizes) / effect.size for effect in effects)
    for ratio in product(*(np.unique(np.round(np.outer(of, 1.0 / first), 9)) for of in others)):
        scale = prior * np.array([1.0, *ratio])[own]
        values, axes = np.linalg.eigh(scale[:, None] * S * scale)
        squares = (axes.T @ (scale * b)) ** 2
        for size in first:
            evidence, noise = _evidence(np.maximum(values, 0.0), squares, size**2, left, tests.dof)
            if evidence > best[0]:
                best = evidence, noise, (size, *(size * of for of in ratio))
    evidence, noise, factors = best
    sized = (
        replace(effect, size=float(f"{effect.size * factor:.3g}"))
        for effect, factor in zip(effects, factors, strict=True)
    )
    return SizedRemainders(tuple(sized), evidence - none, noise)


def _evidence(
    values: np.ndarray, squares: np.ndarray, t: float, left: float, dof: float
) -> tuple[float, float]:
    """Return the log evidence and the likeliest variance of the noise; see the module."""
    v = np.geomspace(*REMAINDER.noise, REMAINDER.noises)[:, None] * left / dof
    gain = np.sum(t * squares / (v * (v + t * values)) - np.log1p(t * values / v), axis=1)
    found = 0.5 * (gain - dof * np.log(v[:, 0]) - left / v[:, 0])
    best = int(np.argmax(found))
    return float(found[best]), float(v[best, 0])
