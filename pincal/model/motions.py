"""Unit motions of coordinates of a chain, whose Jacobian columns are the levers of these
coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect, Locus, Term
from pincal.model.model import Model
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

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        """Add constants."""
        return tuple(Term(p, k) for p, k in enumerate(self.coordinates))


def with_moving_drives(model: Model) -> Model:
    """Return a model with the positions of its drives as further parameters, the last n."""
    drives = Motions(tuple(map(int, model.chain.drives)))
    return model.with_effects((*model.effects, drives))
