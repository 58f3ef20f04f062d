"""The chance that data without the effect that was accepted last look as if they had it: a parametric bootstrap.

Data drawn from the model without it, with the noise as found, are tested against all candidates, and the best score is
compared with that of the real data. That asks about the choice as a whole, which no p-value of a single candidate does. To
first order nothing has to be fitted: of normal noise the projected products b' of :mod:`pincal.discover.score_tests` are
normal, with covariance S'.
"""

from __future__ import annotations

import numpy as np
from scipy.special import fdtrc

from pincal.discover.candidate_tests import named_tests
from pincal.discover.history import History
from pincal.discover.score_tests import ScoreTests
from pincal.identify.fit import without
from pincal.io.discovery_file import Bootstrap

# Tables that are drawn: the least chance that they can show is one in 201.
DRAWS = 200
# Part of the largest eigenvalue below which one of S', scaled to a diagonal of 1, is rounding.
_ROUNDING = 1e-10


def bootstrap_last(trail: History) -> Bootstrap | None:
    """Return the chance of the effect that was accepted last; None if nothing was accepted but elasticity."""
    steps = [step for step in trail.steps if not step.is_elastic]
    if not steps:
        return None
    rest = trail.final
    for effect in steps[-1].effects:
        rest = without(rest, effect)
    tests = named_tests(rest, trail.extra, trail.policy, steps[-1].effects)
    return Bootstrap.of(steps[-1].effect, p_value=chance_of_best(tests, DRAWS), draws=DRAWS)


def chance_of_best(tests: ScoreTests, draws: int, seed: int = 0) -> float:
    """Return the chance that noise alone gives some candidate as small a p-value as the best one has.

    Args:
        tests: all candidates against a model.
        draws: tables to draw.
        seed: of the draws.
    """
    S, _ = tests.projected
    rng = np.random.default_rng(seed)
    scale = np.sqrt(np.maximum(np.diag(S), 1e-300))
    sizes, axes = np.linalg.eigh(S / np.outer(scale, scale))
    seen = sizes > _ROUNDING * sizes[-1]
    noise = rng.standard_normal((draws, np.count_nonzero(seen)))
    b = noise * np.sqrt(sizes[seen]) @ axes[:, seen].T * scale
    # What the candidates don't see of the noise is left whatever they explain.
    unseen = max(tests.dof - noise.shape[1], 1.0)
    squares = np.sum(noise**2, axis=1) + rng.chisquare(unseen, draws)
    observed, drawn = 1.0, np.ones(draws)
    for i, effect in enumerate(tests.effects):
        observed = min(observed, tests.score([i], 1).p_value)
        places, whitening = tests.whitening([i])
        rank = whitening.shape[1]
        if rank:
            gains = np.minimum(np.sum((b[:, places] @ whitening) ** 2, axis=1), 0.999999 * squares)
            rest = max(tests.dof - rank, 1.0)
            found = fdtrc(rank, rest, gains / rank / ((squares - gains) / rest))
            drawn = np.minimum(drawn, effect.looks * found)
    return float(1.0 + np.count_nonzero(drawn <= observed)) / (draws + 1.0)
