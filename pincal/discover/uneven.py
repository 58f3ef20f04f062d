r"""Score tests where the noise is not the same at every pose, as where a joint scatters or readings jump.

A score test takes the noise to be one number. Where a joint does not repeat, readings are noisier along its lever than
across it, and chance alone explains more by effects on this joint than the test says. What the noise is along an effect is
seen in the scores of single visits, :math:`s_v = W^T \sum_{n \in v} X'_n{}^T r_n` (X' the effect's columns with the model's
tangent space projected out, whitened by W, r what the effect leaves): even noise makes the mean square of their components
1 in all. Divided by a mean square that is more, and more than by chance, the test is right whatever the noise (Rao and
Scott 1981, first order).
"""

from __future__ import annotations

import numpy as np
from scipy.special import chdtrc, fdtrc

from pincal.discover.nuisance import nuisances
from pincal.discover.scatter import visits
from pincal.discover.score_tests import ScoreTests
from pincal.identify.fit import Fit
from pincal.identify.normal import block_rows

# Part of a visit's own reading that an effect takes up, at most.
_MOST_TAKEN = 0.9
# Chance that even noise is taken for uneven.
_CHANCE = 0.05


def p_value_of_uneven_noise(fit: Fit, tests: ScoreTests) -> float:
    """Return the p-value of one candidate's score test beside masses, whatever the noise is at each visit of a pose.

    Args:
        fit: the fit.
        tests: those of one candidate against it, masses among what is projected out.
    """
    (effect,) = tests.effects
    _, whitening = tests.whitening([0])
    if not whitening.shape[1]:
        return 1.0
    scores, taken = _scores_by_visit(fit, tests, whitening)
    # What a visit takes up itself it does not show.
    scores /= (1.0 - np.minimum(taken, _MOST_TAKEN))[:, None]
    gain, rank = tests.gain([0])
    uneven = float(np.sum(scores**2)) / rank
    # As many visits as share what is seen of the effect, about.
    many = float(np.sum(taken) ** 2 / np.sum(taken**2))
    if chdtrc(many, uneven * many) > _CHANCE:
        return tests.score([0], 1).p_value
    return min(effect.looks * float(fdtrc(rank, max(many - rank, 1.0), gain / uneven / rank)), 1.0)


def _scores_by_visit(fit: Fit, tests: ScoreTests, whitening: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the scores of what the effect leaves, shape (V, rank), and the part of it that each visit takes up, (V,)."""
    (effect,) = tests.effects
    problem, known = fit.problem.extended([*nuisances(fit, [effect]), effect])
    values, free = np.zeros(len(problem.parameters)), np.ones(len(problem.parameters), bool)
    values[known], free[known] = fit.values, fit.solution.free
    place = {parameter.name: i for i, parameter in enumerate(problem.parameters)}
    model, own = [place[name] for name in tests.names], problem.places_at(effect)
    N, C = slice(0, tests.n_model), slice(tests.n_model, None)
    # What a whitened unit of the effect moves beside what the model then takes up of it, and the step of both.
    along, step = np.zeros((len(values), whitening.shape[1])), np.zeros(len(values))
    information = tests.S[N, N] + tests.known
    along[own], along[model] = whitening, -np.linalg.solve(information, tests.S[N, C] @ whitening)
    step[model] = np.linalg.solve(information, tests.b[N] - tests.pull)
    step += along @ (whitening.T @ tests.projected[1])
    scores, taken = [], []
    for places, rows, blocks, station in zip(
        problem.places, problem.rows, problem.block_spans, problem.stations, strict=True
    ):
        visit, here = visits(station), places[free[places]]
        sums, shares = np.zeros((2, int(visit.max()) + 1, whitening.shape[1]))
        for piece, residuals, jacobian in station.linearise_shared(values[places], free[places]):
            scale = np.empty_like(residuals)
            for at, sigma in zip(block_rows(station), fit.solution.estimated[blocks], strict=True):
                scale[at] = station.weights[piece] * fit.solution.weights[rows][piece] / sigma
            moved = jacobian.along(along[here]) * scale
            left = (residuals - jacobian.along(step[here, None])[0]) * scale
            np.add.at(sums, visit[piece], np.einsum("rmn,mn->nr", moved, left))
            np.add.at(shares, visit[piece], np.einsum("rmn,rmn->nr", moved, moved))
        scores.append(sums)
        taken.append(shares.sum(axis=1))
    return np.concatenate(scores), np.concatenate(taken)
