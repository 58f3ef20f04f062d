"""Levers: how the readings move with the coordinates in which an arm could move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pincal.identify.fit import Fit
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect, Locus, Term
from pincal.parameters import Parameter


@dataclass(frozen=True)
class Motions(Effect):
    """Unit motions of some coordinates of the chain, for their levers."""

    coordinates: tuple[int, ...]
    name: ClassVar[str] = "motions"
    meaning: ClassVar[str] = "coordinates of the chain move by themselves"
    locus: ClassVar[Locus] = Locus()

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """One a coordinate."""
        return tuple(Parameter(f"chain.{k}", "rad", self.name, 0.0, 1.0) for k in self.coordinates)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add constants."""
        return tuple(Term(p, k) for p, k in enumerate(self.coordinates))


def levers(fit: Fit, coordinates: tuple[int, ...]) -> np.ndarray:
    """Return how the readings move with K coordinates of the chain, shape (K, m, N), per rad or m."""
    return linearised(fit, [Motions(coordinates)], np.zeros(len(fit.values), bool))[1]


def linearised(fit: Fit, extra: Sequence[Effect], free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals, shape (m, N), and the Jacobian by free parameters, then all of the extra effects."""
    problem, known = fit.problem.extended(extra)
    values, mask = np.zeros(len(problem.parameters)), np.ones(len(problem.parameters), bool)
    values[known], mask[known] = fit.values, free
    pieces = list(problem.station.linearise(values, mask))
    residuals = np.concatenate([r for _, r, _ in pieces], axis=1)
    jacobian = np.concatenate([J for _, _, J in pieces], axis=2)
    present = (np.cumsum(mask) - 1)[known[free]]
    return residuals, jacobian[np.concatenate([present, np.setdiff1d(np.arange(len(jacobian)), present)])]
