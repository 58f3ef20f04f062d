"""What score tests are made of: what rows and priors say of a model, and the rows themselves with all columns."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from pincal.identify.jacobian import Jacobian
from pincal.identify.quadratic import Factor, Form


@dataclass(frozen=True, eq=False)
class Information:
    """What rows and priors say of the N parameters of a model, by block of poses; the same for all candidates.

    Attributes:
        blocks: what the rows of each of B blocks say.
        prior: what was known of the parameters before.
        variants: the same with other sizes of what is in doubt, or without some parameters, once it is asked for.
    """

    blocks: Form
    prior: Form
    variants: dict[object, Information] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def rows(self) -> Form:
        """What all rows say."""
        return self.blocks.sum()

    @cached_property
    def factor(self) -> Factor:
        """Of the information of rows and priors."""
        return Factor.of(self.rows.H + self.prior.H)

    @cached_property
    def slope(self) -> np.ndarray:
        """That of rows and priors in units of the factor, shape (N,)."""
        return self.factor.half(self.rows.g + self.prior.g)

    def believing(self, factor: float, H: np.ndarray) -> Information:
        """Return the same where sizes in doubt are multiplied by a factor, which makes H of the priors' information."""
        return self.variants.setdefault(factor, Information(self.blocks, replace(self.prior, H=H)))

    def without(self, model: np.ndarray, gone: np.ndarray, values: np.ndarray) -> Information:
        """Return the same of the parameters that stay, the others at zero; to first order nothing is evaluated again.

        Without columns J of value v the residuals r grow by J v, and g by H v.

        Args:
            model: shape (M,), which stay.
            gone: shape (G,), which go.
            values: shape (G,), of these.
        """
        if (key := gone.tobytes()) not in self.variants:
            left = self.blocks.part(model)
            left = replace(left, g=left.g + self.blocks.H[:, model[:, None], gone] @ values)
            self.variants[key] = Information(left, self.prior.part(model))
        return self.variants[key]

    @cached_property
    def without_block(self) -> list[tuple[Factor, np.ndarray]]:
        """Factor of the information without each block, and the step of the parameters."""
        found = []
        for H, g in zip(self.blocks.H, self.blocks.g, strict=True):
            factor = Factor.of(self.rows.H - H + self.prior.H)
            found.append((factor, factor.solve(self.rows.g - g + self.prior.g)))
        return found


class RowPart(NamedTuple):
    """Some rows of a station, their residuals and columns whitened.

    Attributes:
        rows: shape (n,), which of all rows of the fit they are.
        residuals: shape (m, n).
        model: the station's columns of the model.
        candidates: the station's columns of the candidates.
        at: where these and those stand among the columns of all, the model's first; -1 for nowhere.
    """

    rows: np.ndarray
    residuals: np.ndarray
    model: Jacobian
    candidates: Jacobian
    at: np.ndarray

    def moved(self, steps: np.ndarray) -> np.ndarray:
        """Return how R steps of the parameters of all columns, shape (N + C, R), move the rows, shape (R, m, n)."""
        # What stands nowhere takes no step.
        steps, n = np.vstack([steps, np.zeros(steps.shape[1])]), self.model.size
        some = np.flatnonzero(steps[self.at[n:]].any(axis=1))
        added = self.candidates.only(some).along(steps[self.at[n + some]])
        return np.asarray(self.model.along(steps[self.at[:n]]) + added)

    def products(self, some: np.ndarray, others: np.ndarray) -> np.ndarray:
        """Return the products of J columns of candidates with K, by their places among all, shape (J, K)."""
        pairs = (np.nonzero(of[:, None] == self.at[self.model.size :]) for of in (some, others))
        (here, mine), (there, theirs) = pairs
        own, found = np.zeros((len(here), len(there))), np.zeros((len(some), len(others)))
        self.candidates.only(mine).add_products(self.candidates.only(theirs), own)
        found[np.ix_(here, there)] = own
        return found

    def among(self, slots: np.ndarray, undone: np.ndarray) -> RowPart:
        """Return the same with columns in other places, shape (N + C + 1,), once their parameters have gone back so far."""
        return self._replace(residuals=self.residuals + self.moved(undone[:, None])[0], at=slots[self.at])
