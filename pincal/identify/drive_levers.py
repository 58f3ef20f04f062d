"""Levers: derivatives of the readings by coordinates of the chain, such as the positions of its drives."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pincal.identify.fit import ModelFit
from pincal.identify.problem import Problem, extended
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect, Locus, Term
from pincal.parameters import Parameter


@dataclass(frozen=True)
class Motions(Effect):
    """Unit motions of some coordinates of the chain, to compute their levers."""

    coordinates: tuple[int, ...]
    name: ClassVar[str] = "motions"
    meaning: ClassVar[str] = "coordinates of the chain move independently"
    locus: ClassVar[Locus] = Locus()

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """One per coordinate."""
        return tuple(Parameter(f"chain.{k}", "rad", self.name, 0.0, 1.0) for k in self.coordinates)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add constants."""
        return tuple(Term(p, k) for p, k in enumerate(self.coordinates))


def with_motions(fit: ModelFit, coordinates: Iterable[int]) -> tuple[Problem, np.ndarray, np.ndarray]:
    """Return a fit's problem with motions of coordinates, its values, and a mask of the motions."""
    problem, known = extended(fit.problem, [Motions(tuple(map(int, coordinates)))])
    values, free = np.zeros(len(problem.parameters)), np.ones(len(problem.parameters), bool)
    values[known], free[known] = fit.values, False
    return problem, values, free


def levers(fit: ModelFit, coordinates: Sequence[int]) -> np.ndarray:
    """Return the derivatives of the readings of the only station by K coordinates, shape (K, m, N), per rad or m."""
    problem, values, free = with_motions(fit, coordinates)
    return np.concatenate([J for _, _, J in problem.stations[0].linearise(values, free)], axis=2)
