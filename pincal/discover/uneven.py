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
from scipy.linalg import cho_solve
from scipy.special import chdtrc, fdtrc

from pincal.discover.scatter import visits
from pincal.discover.score_tests import ScoreTests
from pincal.identify.fit import Fit

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
    products, (scale, factor, _) = tests.products, tests.model.factor
    rows = products.rows
    assert rows is not None
    # What a whitened unit of the effect moves beside what the model then takes up of it, and the step of both.
    right = np.column_stack([products.cross @ whitening, tests.model.b - tests.model.pull])
    taken = scale[:, None] * cho_solve((factor, True), scale[:, None] * right, check_finite=False)
    step = whitening.T @ tests.projected[1]
    of_model = np.column_stack([-taken[:, :-1], taken[:, -1] - taken[:, :-1] @ step])
    visit = _visits(fit)
    sums, shares = np.zeros((2, int(visit.max()) + 1, len(step)))
    for here, residuals, moved in rows.moved(of_model, 0, np.column_stack([whitening, whitening @ step])):
        moved, left = moved[:-1], residuals - moved[-1]
        np.add.at(sums, visit[here], np.einsum("rmn,mn->nr", moved, left))
        np.add.at(shares, visit[here], np.einsum("rmn,rmn->nr", moved, moved))
    return sums, shares.sum(axis=1)


def _visits(fit: Fit) -> np.ndarray:
    """Return the visit that each row belongs to, shape (N,), each of one station."""
    each = [visits(station) for station in fit.problem.stations]
    starts = np.cumsum([0, *(int(of.max()) + 1 for of in each)])
    return np.concatenate([start + of for start, of in zip(starts, each, strict=False)])
