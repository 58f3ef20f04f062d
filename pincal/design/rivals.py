"""Effects that are to be told apart: found by name, and how well a design does it."""

from __future__ import annotations

import numpy as np

from pincal.design.design_model import RIVAL
from pincal.model.catalogue.candidates import find_effect
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions, Situation
from pincal.model.effect import Effect, Reducible


def find_rival(text: str, chain: Chain, conditions: Conditions) -> Effect:
    """Return the effect of a name, as :func:`find_effect`, in the fewest parameters: a drive curve with few pieces."""
    effect = find_effect(text, chain, conditions)
    return effect.reduced(Situation(chain, conditions)) if isinstance(effect, Reducible) else effect


def weights(rivals: tuple[np.ndarray, ...], n_free: int) -> np.ndarray:
    """Return W of the criterion tr(W C) that tells rivals apart, shape (F, F).

    It is the sum of the variances of both rivals' parameters, in units of their typical sizes, with everything refitted:
    the A-criterion for a subset (A_s; Atkinson, Donev and Tobias 2007, sec. 10.3). Of an effect with one parameter the
    variance is the inverse of the non-centrality that T-optimality maximises (Atkinson and Fedorov 1975); of several it
    makes up for the worst direction first.
    """
    W = np.zeros((n_free, n_free))
    for columns in rivals:
        W[columns, columns] = RIVAL**2
    return W


def noncentrality(C: np.ndarray, rivals: tuple[np.ndarray, ...]) -> tuple[float, ...]:
    """Return, for each rival of typical size, its squared signal in units of the noise that no refit takes up.

    The rest, the other rival among it, is refitted; it is the mean over the directions of its parameters.

    Args:
        C: shape (F, F), posterior covariance in units of the priors.
        rivals: places of their parameters.
    """
    found = []
    for columns in rivals:
        left = np.linalg.inv(C[np.ix_(columns, columns)]) - np.eye(len(columns))
        found.append(max(float(np.trace(left)) / len(columns) / RIVAL**2, 0.0))
    return tuple(found)
