r"""Resolution and roughness of drive curves.

The roughness maximises the marginal likelihood (empirical Bayes). With G, g the normal equations of
all parameters, the curves as fine as the poses allow, L the information of all priors and
:math:`R_j / w_j^2` that of the roughness of curve j, the coefficients x have the covariance
:math:`C = (G + L + \sum_j R_j / w_j^2)^{-1}`, and the likelihood marginalised over x is largest
where

.. math:: w_j^2 = \frac{x_j^T R_j x_j}{\operatorname{tr} R_j (P_j^{-1} - C_j)} w_j^2, \qquad
    P_j = D_j^{-2} + R_j / w_j^2,

for priors of size D (Wood and Fasiolo 2017, Biometrics 73, 1071-1081, equation 4); the noise
follows from the residuals. One pass over the data serves all iterations.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import eigvalsh, lstsq
from scipy.linalg.lapack import dtrtri

from pincal.discover.curve_numbers import CURVES
from pincal.discover.first_order import ScoreTests
from pincal.discover.levers import situation_of
from pincal.discover.score_tests import GivenNuisances
from pincal.identify.beliefs import priors_of
from pincal.identify.equations import Linearised
from pincal.identify.fit import Ending, ModelFit, Solution, carried
from pincal.identify.posterior import Posterior
from pincal.identify.problem import Problem
from pincal.identify.quadratic import ROUNDING, Factor, Form
from pincal.model.catalogue.transmission import most_pieces
from pincal.model.conditions import distinct_values, moves
from pincal.model.effect import Curve, Effect, Resolvable, Smoothable
from pincal.model.effect_numbers import FIELD
from pincal.robot.robot import Robot


def smoothed(
    fit: ModelFit, curves: Sequence[Curve], finer: float = 1.0
) -> tuple[dict[Curve, tuple[Curve, np.ndarray]], ModelFit]:
    """Return curves, in the fit or new, with the resolution and roughness that the data determine,
    and coefficients.

    Also the fit with its other parameters moved accordingly, to first order. The resolution is
    ``finer`` times that of the shortest wave of which rows have as much information as the prior on
    roughness.
    """
    situation = situation_of(fit)
    sigma = fit.solution.estimated
    fine, smooth = ({curve: curve.smooth(situation, w) for curve in curves} for w in (None, 1.0))
    present = fit.options.effects
    every = [*present, *(curve for curve in curves if curve not in present)]
    problem, problem_smooth = (
        fit.problem.with_effects([by.get(e, e) if isinstance(e, Curve) else e for e in every])
        for by in (fine, smooth)
    )
    start = _with_curves(fit, problem, fine)
    places = [problem.places_at(curve) for curve in fine.values()]
    sizes = priors_of(problem_smooth, fit.options).sizes
    here = Linearised(problem, start.values, start.free, start.weights, sizes)
    found = here.posterior(sigma)
    kept = np.flatnonzero(start.free & problem.is_shared)
    quadratic = _squares(here, found, kept, sigma)
    columns = [np.searchsorted(kept, at) for at in places]
    bends = [np.asarray(curve.smoothness()) for curve in smooth.values()]
    roughness, step, noise = quadratic.likeliest(columns, bends)
    chosen = {}
    for curve, w, at, own in zip(curves, roughness, places, columns, strict=True):
        waves = _pieces(fine[curve], found.form.H[np.ix_(own, own)] / noise, float(w))
        # Beyond many pieces, a finer curve costs time and adds little.
        pieces = max(waves, min(finer * waves, CURVES.enough_pieces))
        resolved = curve.smooth(situation, float(w), int(np.ceil(pieces)))
        heights = _resampled(fine[curve], start.values[at] + step[own], resolved)
        chosen[curve] = (resolved, heights)
    start.values[kept] += step
    others = problem.carried_over(start.values, fit.problem)
    return chosen, replace(fit, solution=replace(fit.solution, values=others))


def _with_curves(fit: ModelFit, problem: Problem, fine: Mapping[Curve, Curve]) -> Solution:
    """Return a fit's solution carried over to a problem with its curves, and new ones, resampled to
    fine ones, which are free.
    """
    start = carried(fit.solution, fit.problem, problem)
    present = fit.options.effects
    for curve, resolved in fine.items():
        heights = (
            fit.values[fit.problem.places_at(curve)]
            if curve in present
            else np.zeros(curve.resolution)
        )
        at = problem.places_at(resolved)
        start.values[at] = _resampled(curve, heights, resolved)
        start.free[at] = True
    return start


def _squares(
    here: Linearised, found: Posterior, kept: np.ndarray, sigma: np.ndarray
) -> CurveSquares:
    """Return the sum of squares as a function of the curves, about the point of linearisation."""
    problem = here.problem
    believed = problem.beliefs.beyond_priors(kept, here.values, here.sizes)
    return CurveSquares(
        rows=Form.of(found.form.H - believed.H, found.form.g - believed.g),
        believed=believed,
        sizes=here.sizes[kept],
        values=here.values[kept],
        squares=here.chi2(sigma),
        readings=int(problem.readings(here.robust).sum()),
    )


def _pieces(curve: Curve, information: np.ndarray, roughness: float) -> float:
    """Return the number of half waves, over the range, of which rows have as much information as
    the prior on roughness.

    Of k radians per unit the prior has k^4 / w^2, and rows of levers l the sum of l^2 over their
    range, for any k; ``information``, shape (K, K), is that of the rows on the curve's
    coefficients, ``roughness`` is w.
    """
    q, span = _along(curve)
    wave = 0.25 * np.pi * curve.resolution / span * q
    heights = _heights(curve, np.stack([np.sin(wave), np.cos(wave)]))
    density = float(np.sum(heights * (heights @ information))) / span
    return float(span / np.pi * (density * roughness**2) ** 0.25)


def _resampled(curve: Curve, heights: np.ndarray, other: Curve) -> np.ndarray:
    """Return the coefficients of a curve in the basis of another resolution."""
    return _heights(other, heights @ curve.basis(_along(other)[0]))


def _heights(curve: Curve, sampled: np.ndarray) -> np.ndarray:
    """Return the coefficients of a curve, shape (..., K), by its values at dense positions, shape
    (..., N).
    """
    return np.asarray(
        lstsq(
            curve.basis(_along(curve)[0]).T, sampled.T, lapack_driver="gelsy", check_finite=False
        )[0].T
    )


def _along(curve: Curve) -> tuple[np.ndarray, float]:
    """Return dense positions along a curve, and the length of its range."""
    lower, upper = curve.locus.span or (-np.pi, np.pi)
    return np.linspace(lower, upper, CURVES.densely * curve.resolution), upper - lower


@dataclass(frozen=True, eq=False)
class CurveSquares:
    """The sum of squares of data and priors about present values of F parameters.

    Attributes:
        rows: information of the data.
        believed: of joint priors, except for the curves' roughness.
        sizes: shape (F,), standard deviations of the priors; inf for none.
        values: shape (F,).
        squares: of the residuals, in units of the noise.
        readings: their number.
    """

    rows: Form
    believed: Form
    sizes: np.ndarray
    values: np.ndarray
    squares: float
    readings: int

    def likeliest(
        self, columns: Sequence[np.ndarray], bends: Sequence[np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Return the roughness of each curve that maximises the likelihood, the step of all
        parameters, and the noise.

        The noise is a variance; the arguments are the columns and R of each curve.
        """
        w = np.full(len(columns), CURVES.roughness)
        noise = 1.0
        alone = [
            eigvalsh(R * np.outer(self.sizes[at], self.sizes[at]))
            for at, R in zip(columns, bends, strict=True)
        ]
        for _ in range(CURVES.moves):
            step, spent, traces = self._posterior(columns, bends, w, noise)
            residual = (
                self.squares - 2.0 * float(self.rows.g @ step) + float(step @ self.rows.H @ step)
            )
            noise = max(residual / max(self.readings - spent, 1.0), CURVES.least_noise)
            before = w.copy()
            for j, (at, R, known, trace) in enumerate(
                zip(columns, bends, alone, traces, strict=True)
            ):
                x = self.values[at] + step[at]
                free = float(np.sum(known / (1.0 + known / w[j] ** 2))) - trace
                factor = np.sqrt(float(x @ R @ x) / max(free, 1e-300))
                w[j] = max(
                    w[j] * np.clip(factor, 1.0 / CURVES.farthest, CURVES.farthest), CURVES.least
                )
            if np.max(np.abs(np.log(w / before))) < CURVES.settled:
                break
        # The other parameters have narrower priors about correspondingly nearer values: the same
        # pull, smaller steps.
        firm = np.full(len(self.sizes), 1.0 + CURVES.firm)
        firm[np.concatenate(columns)] = 1.0
        firmly = replace(self, sizes=self.sizes / np.sqrt(firm), values=self.values / firm)
        return w, firmly._posterior(columns, bends, w, noise)[0], noise

    def _posterior(
        self,
        columns: Sequence[np.ndarray],
        bends: Sequence[np.ndarray],
        w: np.ndarray,
        noise: float,
    ) -> tuple[np.ndarray, float, list[float]]:
        """Return the step to the posterior mode with roughness w, shape (F,), and the effective
        number of parameters.

        Also, for each curve, the trace of R times the covariance of its coefficients.
        """
        precision = self.sizes**-2.0
        H = self.rows.H / noise + self.believed.H
        g = self.rows.g / noise + self.believed.g - precision * self.values
        H.flat[:: len(H) + 1] += precision
        for at, R, each in zip(columns, bends, w, strict=True):
            H[np.ix_(at, at)] += R / each**2
            g[at] -= R @ self.values[at] / each**2
        # Only parts of the covariance are needed, so its root is enough.
        factor = Factor.of(H)
        root, _ = dtrtri(factor.L, lower=1, overwrite_c=1)
        root *= factor.scale
        # The effective number of parameters: all, less the shares of priors, joint priors and
        # roughness.
        beliefs = np.flatnonzero(np.any(self.believed.H, axis=1))
        inner = root[:, beliefs]
        spent = len(H) - float(
            np.einsum("ij,ij->j", root, root) @ (precision + ROUNDING / factor.scale**2)
        )
        spent -= float(np.vdot(inner.T @ inner, self.believed.H[np.ix_(beliefs, beliefs)]))
        traces = []
        for at, R, each in zip(columns, bends, w, strict=True):
            inner = root[:, at]
            traces.append(float(np.vdot(inner.T @ inner, R)))
            spent -= traces[-1] / each**2
        return root.T @ (root @ g), spent, traces


def notes_on_repeats(robot: Robot, q: np.ndarray) -> Iterator[str]:
    """Yield notes on joints with few distinct positions, q of shape (N, n)."""
    for joint, kind, x, does in zip(
        robot.joint_names, robot.joint_types, q.T, moves(q), strict=True
    ):
        values = distinct_values(x) if does else 1
        if 1 < values < CURVES.enough and values == most_pieces(x):
            step = 2.0 * float(np.ptp(x)) / (values - 1)
            wave = f"{step:.3g} m" if kind == "prismatic" else f"{np.degrees(step):.3g} deg"
            yield (
                f"{joint} takes {values} distinct positions in {len(x)} rows: its drive error "
                f"between them is not observable, and a period shorter than {wave} is aliased to a "
                "longer one; choose positions that don't repeat, as pincal design does"
            )


def resolved(
    test: GivenNuisances, effect: Effect, groups: np.ndarray
) -> tuple[Effect, np.ndarray, np.ndarray]:
    """Return an effect that a fit, given with its tests, lacks with the resolution that the rows
    determine; itself if it has none.

    A curve's follows from the marginal likelihood, and so do the form of a dependence on two joints
    and its smoothness; that of other effects from the prediction of held-out blocks. Also its
    parameters, and those of the effect as given, to first order.
    """
    fit = test.fit
    estimate = test([effect]).estimate([0])
    if isinstance(effect, Curve) and fit.solution.exit is not Ending.EXACT:
        return *smoothed(fit, [effect])[0][effect], estimate
    situation = situation_of(fit)
    forms = tuple(effect.resolutions(situation)) if isinstance(effect, Resolvable) else ()
    if isinstance(effect, Smoothable) and (fields := effect.fields(situation)):
        return *_likeliest_of_two(test, (effect, *forms), fields), estimate
    if not forms:
        return effect, estimate, estimate
    tests = test(forms, groups)
    best = int(np.argmax([tests.gains_by_block([i]).sum() for i in range(len(forms))]))
    return forms[best], tests.estimate([best]), estimate


def _likeliest_of_two(
    test: GivenNuisances, forms: Sequence[Effect], fields: Sequence[Smoothable]
) -> tuple[Effect, np.ndarray]:
    """Return the likeliest of some functions of two joints and of smooth ones in every height, with
    its parameters.
    """
    tests = test([*forms, *fields])
    found = [_Likely(form, tests, i) for i, form in enumerate(forms)]
    found += [
        _Likely(field.of_height(height), tests.rescaled(i, height / field.height), i)
        for i, field in enumerate(fields, len(forms))
        for height in FIELD.heights
    ]
    best = max(found, key=lambda one: one.evidence)
    return best.effect, best.tests.estimate([best.index])


@dataclass(frozen=True, eq=False)
class _Likely:
    """An effect with its test, one of several."""

    effect: Effect
    tests: ScoreTests
    index: int

    @cached_property
    def evidence(self) -> float:
        """The log Bayes factor in its favour."""
        return self.tests.log_evidence([self.index])
