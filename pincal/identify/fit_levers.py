"""Levers of a fit: derivatives of its readings by coordinates of the chain."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from pincal.identify.fit import ModelFit
from pincal.identify.problem import Problem, extended
from pincal.model.motions import Motions


def with_motions(
    fit: ModelFit, coordinates: Iterable[int]
) -> tuple[Problem, np.ndarray, np.ndarray]:
    """Return a fit's problem with motions of coordinates, its values, and a mask of the motions."""
    problem, known = extended(fit.problem, [Motions(tuple(map(int, coordinates)))])
    values = np.zeros(len(problem.parameters))
    free = np.ones(len(problem.parameters), bool)
    values[known] = fit.values
    free[known] = False
    return problem, values, free


def levers(fit: ModelFit, coordinates: Sequence[int]) -> np.ndarray:
    """Return the derivatives of the readings of the only station by K coordinates, shape (K, m, N),
    per rad or m.
    """
    problem, values, free = with_motions(fit, coordinates)
    return np.concatenate([J for _, _, J in problem.stations[0].linearise(values, free)], axis=2)
