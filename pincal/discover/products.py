"""Products of columns, taken over the rows: of a model's, and of candidates' with these, each other and the residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
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
        beliefs: the same by the factor of sizes in doubt.
    """

    blocks: Form
    prior: Form
    beliefs: dict[float, Information] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def rows(self) -> Form:
        """What all rows say."""
        return Form(*map(_sum, vars(self.blocks).values()))

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
        return self.beliefs.setdefault(factor, Information(self.blocks, replace(self.prior, H=H)))

    def without(self, model: np.ndarray, gone: np.ndarray, values: np.ndarray) -> Information:
        """Return the same of the parameters that stay, the others at zero; to first order nothing is evaluated again.

        Without columns J of value v the residuals r grow by J v, and g by H v.

        Args:
            model: shape (M,), which stay.
            gone: shape (G,), which go.
            values: shape (G,), of these.
        """
        left = self.blocks.part(model)
        left = replace(left, g=left.g + self.blocks.H[:, model[:, None], gone] @ values)
        return Information(left, self.prior.part(model))

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
        at: where these stand among those of the model, -1 for nowhere.
        candidates: the station's columns of the candidates.
        own: where these stand among those of the candidates, -1 for nowhere.
        taken: where these stand among those of the model, -1 for nowhere.
    """

    rows: np.ndarray
    residuals: np.ndarray
    model: Jacobian
    at: np.ndarray
    candidates: Jacobian
    own: np.ndarray
    taken: np.ndarray

    def moved(self, model: np.ndarray, candidates: np.ndarray) -> np.ndarray:
        """Return how R steps of the N parameters of the model and the C of candidates move the rows, shape (R, m, n)."""
        # What stands nowhere takes no step.
        of_model, of_candidates = (np.vstack([steps, np.zeros(steps.shape[1])]) for steps in (model, candidates))
        added = of_candidates[self.own] + of_model[self.taken]
        return np.asarray(self.model.along(of_model[self.at]) + self.candidates.along(added))

    def gram(self, columns: np.ndarray) -> np.ndarray:
        """Return the products of J columns of candidates with each other, shape (J, J)."""
        here, mine = np.nonzero(columns[:, None] == self.own)
        own, G = np.zeros((len(here), len(here))), np.zeros((len(columns), len(columns)))
        self.candidates.only(mine).add_gram(np.zeros_like(self.residuals), own, np.zeros(len(here)))
        G[np.ix_(here, here)] = own
        return G

    def across(self, columns: np.ndarray, n: int) -> np.ndarray:
        """Return the products of J columns of candidates with all n, shape (J, n)."""
        here, mine = np.nonzero(columns[:, None] == self.own)
        own, all_of_them, placed = np.zeros((len(here), len(self.own))), np.zeros((len(columns), n)), self.own >= 0
        self.candidates.only(mine).add_products(self.candidates, own)
        all_of_them[np.ix_(here, self.own[placed])] = own[:, placed]
        return all_of_them

    def among(self, model: np.ndarray, candidates: np.ndarray, undone: np.ndarray) -> RowPart:
        """Return the same of some columns, by the places that they get, once those of the model have gone back so far."""
        some = np.flatnonzero(self.taken >= 0)
        back = self.model.along(undone[self.at, None]) + self.candidates.only(some).along(undone[self.taken[some], None])
        at, taken, own = model[self.at], model[self.taken], candidates[self.own]
        return self._replace(residuals=self.residuals + back[0], at=at, own=own, taken=taken)


@dataclass(frozen=True, eq=False)
class Products:
    """Products of the C columns of candidates, by block of rows, with the N of a model and with each other.

    Attributes:
        columns: for each candidate, its columns.
        blocks_cross: shape (B, N, C), with the model's columns.
        blocks_inner: shape (B, C, C), with each other.
        blocks_g: shape (B, C), with the residuals.
        is_partial: whether those of one candidate's columns with another's are left out of ``blocks_inner``, to be taken
            from the rows when they are asked for: of many candidates few pairs are.
        parts: the rows that they are taken over; none if nobody asks for them.
    """

    columns: tuple[np.ndarray, ...]
    blocks_cross: np.ndarray
    blocks_inner: np.ndarray
    blocks_g: np.ndarray
    is_partial: bool = False
    parts: tuple[RowPart, ...] = ()
    _asked: dict[tuple[int, ...], np.ndarray] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def cross(self) -> np.ndarray:
        """Of all blocks, shape (N, C)."""
        return _sum(self.blocks_cross)

    @cached_property
    def g(self) -> np.ndarray:
        """Of all blocks, shape (C,)."""
        return _sum(self.blocks_g)

    @cached_property
    def each_inner(self) -> np.ndarray:
        """Those of each candidate's columns with each other, of all blocks, shape (C, C); of others' perhaps not."""
        return _sum(self.blocks_inner)

    @cached_property
    def squares(self) -> np.ndarray:
        """Of each column with itself, shape (C,)."""
        return np.diag(self.each_inner)

    @cached_property
    def inner(self) -> np.ndarray:
        """Of all columns with each other, shape (C, C)."""
        return self.inner_of(range(len(self.columns)))

    def places(self, which: Sequence[int]) -> np.ndarray:
        """Return the columns of some candidates, shape (J,)."""
        return np.concatenate([np.zeros(0, int), *(self.columns[i] for i in which)])

    def inner_of(self, which: Sequence[int]) -> np.ndarray:
        """Return those of some candidates' columns with each other, shape (J, J)."""
        j = self.places(which)
        if not self.is_partial or len(which) < 2:
            return np.asarray(self.each_inner[np.ix_(j, j)])
        if (key := tuple(which)) not in self._asked:
            self._asked[key] = np.asarray(sum(part.gram(j) for part in self.parts))
        return self._asked[key]

    def among(self, which: Sequence[int], model: np.ndarray, gone: np.ndarray, values: np.ndarray) -> Products:
        """Return those of some candidates with some of a model's columns, others gone with their values.

        Args:
            which: the candidates.
            model: shape (M,), the columns of the model that stay.
            gone: shape (G,), those that go: the residuals grow by what they did.
            values: shape (G,), of their parameters.
        """
        j, ends = self.places(which), np.cumsum([0, *(len(self.columns[i]) for i in which)])
        cross, undone = self.blocks_cross[:, :, j], np.zeros(self.blocks_cross.shape[1] + 1)
        undone[gone] = values
        of_model, of_candidates = (_slots(at, n) for at, n in zip((model, j), self.blocks_cross.shape[1:], strict=True))
        return replace(
            self,
            columns=tuple(np.arange(a, b) for a, b in pairwise(ends)),
            blocks_cross=cross[:, model],
            blocks_inner=self.blocks_inner[:, j[:, None], j],
            blocks_g=self.blocks_g[:, j] + values @ cross[:, gone],
            parts=tuple(part.among(of_model, of_candidates, undone) for part in self.parts),
        )

    def taking(self, which: int) -> Products:
        """Return those of the other candidates with a model to which one's columns are appended; all columns stay."""
        j, (n_model, n) = self.columns[which], self.blocks_cross.shape[1:]
        across = self.blocks_inner[:, j]
        if self.is_partial:
            across = np.sum([part.across(j, n) for part in self.parts], axis=0)[None]
        at = _slots(j, n)
        at[at >= 0] += n_model
        return replace(
            self,
            columns=(*self.columns[:which], *self.columns[which + 1 :]),
            blocks_cross=np.concatenate([self.blocks_cross, across], axis=1),
            parts=tuple(part._replace(taken=np.maximum(part.taken, at[part.own])) for part in self.parts),
        )


def _slots(places: np.ndarray, n: int) -> np.ndarray:
    """Return where each of n things stands among those at some places, -1 for nowhere, also behind the last."""
    slots = np.full(n + 1, -1)
    slots[places] = np.arange(len(places))
    return slots


def _sum(blocks: np.ndarray) -> np.ndarray:
    return blocks[0] if len(blocks) == 1 else np.asarray(blocks.sum(axis=0))
