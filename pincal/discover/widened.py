r"""Standard deviations that pay for the choice of a model: for what a discovery may have missed, and for masses.

A fit's covariance holds if its effects are all there are. After a discovery they are those that were chosen, and three
things are left out that move other poses as well: masses and centres of mass are a few per cent off, which the score tests
grant and the model does not have; among the candidates that were refused some may be there; and each bearing has directions
and a place of its own, which enter only where the data call for them. What each adds to the
variance of a prediction follows, on average over the rows, from the projected products of the score tests,

.. math:: e_m = m^T S' m + \operatorname{tr} S' C, \qquad C = (S' + D^{-2})^{-1}, \quad m = C b' ,

for masses known to D, in units of the noise and summed over the readings, and the mean over candidates,
:math:`e_c = \sum_g w_g T_g`, with weights from the information criterion, :math:`w_g \propto \exp(-\mathrm{EBIC}_g/2)`, 1
for no candidate (Bayesian model averaging: Hoeting et al. 1999, Stat. Sci. 14, 382-417); of bearings the same of each
direction and place by itself, :math:`e_b`. What the fit's own parameters add
is their effective number p. So the covariance is that of noise whose variance is :math:`1 + (e_m + e_c + e_b) / p`
times as large.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import solve_triangular

from pincal.discover.candidate_tests import sampled
from pincal.discover.history import History
from pincal.discover.nuisance import MassError, missing_features, score_test_beside_nuisances
from pincal.discover.score_tests import ScoreTests
from pincal.identify.fit import Fit, equations_of


def widened(trail: History) -> Fit:
    """Return the last fit of a discovery with a covariance that pays for what the model does not have."""
    fit = trail.final
    few, _ = sampled(fit, trail.policy)
    rows = len(fit.problem) / max(len(few.problem), 1)
    noise = float(np.mean((fit.solution.estimated / fit.solution.sigma) ** 2))
    features = score_test_beside_nuisances(few, missing_features(few))
    beyond = (of_masses(few, features) + of_candidates(trail.last) + of_bearings(features)) * rows * noise
    factor = 1.0 + beyond / max(fit.solution.effective, 1.0)
    solution = fit.solution
    wide = equations_of(fit.problem, replace(solution, sigma=solution.sigma * np.sqrt(factor)), fit.priors)
    # What the data identify stays as it is.
    known = solution.posterior
    unseen = known.directions[:, known.information == 0.0]
    posterior = replace(known, covariance=wide.covariance(unseen), own=wide.own)
    return replace(fit, solution=replace(solution, wide=posterior))


def of_masses(fit: Fit, tests: ScoreTests) -> float:
    """Return what masses that are off add to the variance of the rows, summed over readings, in units of the noise.

    Args:
        fit: the fit.
        tests: those of what it does not have of its bearings, beside its masses alone.
    """
    masses = MassError.of(*fit.arm)
    if masses is None:
        return 0.0
    place = {name: i for i, name in enumerate(tests.names)}
    parameters = masses.parameters(fit.problem.chain)
    at, sizes = [place[p.name] for p in parameters], np.array([p.size for p in parameters])
    # Beside the fit's parameters, what rows and priors say of them together.
    scale, L, slope = tests.model.factor
    units = np.zeros((len(L), len(at)))
    units[at, range(len(at))] = scale[at] / sizes
    half = solve_triangular(L, units, lower=True, check_finite=False)
    C, most_probable = half.T @ half, half.T @ slope
    S = np.linalg.inv(C) - np.eye(len(C))
    return float(most_probable @ S @ most_probable + np.sum(S * C))


def of_bearings(tests: ScoreTests) -> float:
    """Return the same of directions and places of bearings that the data did not call for: each may be there by itself."""
    return float(sum(of_candidates(tests, [i]) for i in range(len(tests.effects))))


def of_candidates(tests: ScoreTests, which: Sequence[int] | None = None) -> float:
    """Return the same of the candidates that were refused, each weighed by how likely it is there all the same.

    Args:
        tests: those against the last model.
        which: of which candidates, one of them at most there; default: all.
    """
    which = range(len(tests.effects)) if which is None else which
    groups = len({tests.effects[i].identity for i in which})
    scores = [tests.score([i], groups) for i in which]
    gains, costs = np.array([score.gain for score in scores]), np.array([score.ebic for score in scores])
    # Odds against no candidate, which costs nothing.
    best = min(float(costs.min(initial=0.0)), 0.0)
    odds = np.exp(-0.5 * (costs - best))
    return float(odds @ gains / (odds.sum() + np.exp(0.5 * best)))
