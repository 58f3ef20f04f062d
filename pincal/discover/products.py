"""Products of columns, taken over the rows: of a model's, and of candidates' with these, each other and the residuals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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
        return Form(*(of[0] if len(of) == 1 else of.sum(axis=0) for of in vars(self.blocks).values()))

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

    def grown(self, gone: np.ndarray, values: np.ndarray) -> float:
        """Return by how much the squares of the residuals grow without columns of these values, shape (G,)."""
        rows = self.rows.part(gone)
        return float(values @ (2.0 * rows.g + rows.H @ values))

    @cached_property
    def without_block(self) -> list[tuple[Factor, np.ndarray]]:
        """Factor of the information without each block, and the step of the parameters."""
        found = []
        for H, g in zip(self.blocks.H, self.blocks.g, strict=True):
            factor = Factor.of(self.rows.H - H + self.prior.H)
            found.append((factor, factor.solve(self.rows.g - g + self.prior.g)))
        return found


class Whitened(NamedTuple):
    """Columns at some rows of a station, and where they stand among all.

    Attributes:
        jacobian: whitened.
        slot: for every column, where it stands in the Jacobian, -1 if nowhere.
    """

    jacobian: Jacobian
    slot: np.ndarray

    @classmethod
    def of(cls, jacobian: Jacobian, places: np.ndarray, n: int) -> Whitened:
        """Return columns that stand at some places among n."""
        slot = np.full(n, -1)
        slot[places] = np.arange(len(places))
        return cls(jacobian, slot)

    def along(self, steps: np.ndarray) -> np.ndarray:
        """Return how R steps of all parameters, shape (n, R), move the rows, whitened, shape (R, m, n)."""
        here, own = self.slot >= 0, np.zeros((self.jacobian.size, steps.shape[1]))
        own[self.slot[here]] = steps[here]
        return self.jacobian.along(own)

    def gram(self, columns: np.ndarray) -> np.ndarray:
        """Return the products of J columns with each other, shape (J, J)."""
        slot, (m, n) = self.slot[columns], self.jacobian.dense.shape[1:]
        here, G = np.flatnonzero(slot >= 0), np.zeros((len(columns), len(columns)))
        own = np.zeros((len(here), len(here)))
        self.jacobian.only(slot[here]).add_gram(np.zeros((m, n)), own, np.zeros(len(here)))
        G[np.ix_(here, here)] = own
        return G


class RowPart(NamedTuple):
    """Some rows of a station.

    Attributes:
        rows: shape (n,), which of all rows of the fit they are.
        residuals: shape (m, n), whitened.
        model: the model's columns.
        candidates: those of all candidates.
    """

    rows: np.ndarray
    residuals: np.ndarray
    model: Whitened
    candidates: Whitened


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows that products are taken over, for what is asked of few candidates only.

    Attributes:
        parts: all rows, with the columns of a model and of candidates as they once were.
        model: shape (N,), which of those of the model are left.
        candidates: for each candidate that is left, which are its own.
        undone: of each parameter of the model as it once was, how far it has gone back since.
    """

    parts: tuple[RowPart, ...]
    model: np.ndarray
    candidates: tuple[np.ndarray, ...]
    undone: np.ndarray

    def gram(self, which: Sequence[int]) -> np.ndarray:
        """Return the Gram matrix of the J columns of some candidates, shape (J, J)."""
        columns = np.concatenate([self.candidates[i] for i in which])
        return np.asarray(sum(part.candidates.gram(columns) for part in self.parts))

    def moved(self, model: np.ndarray, i: int, candidate: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Yield the rows of each part, their residuals, shape (m, n), and how R steps move them, shape (R, m, n).

        Args:
            model: shape (N, R), steps of the model's parameters.
            i: a candidate.
            candidate: shape (g, R), steps of its parameters.
        """
        n_steps = model.shape[1]
        of_model = np.zeros((len(self.undone), n_steps + 1))
        of_model[self.model, :-1], of_model[:, -1] = model, self.undone
        for part in self.parts:
            of_candidate = np.zeros((len(part.candidates.slot), n_steps))
            of_candidate[self.candidates[i]] = candidate
            back = part.model.along(of_model)
            yield part.rows, part.residuals + back[-1], back[:-1] + part.candidates.along(of_candidate)

    def among(self, which: Sequence[int], model: np.ndarray, gone: np.ndarray, values: np.ndarray) -> Rows:
        """Return the same of some candidates and of some of the model's columns, others ``gone`` with their values."""
        undone = self.undone.copy()
        undone[self.model[gone]] += values
        return Rows(self.parts, self.model[model], tuple(self.candidates[i] for i in which), undone)


@dataclass(frozen=True, eq=False)
class Products:
    """Products of the C columns of candidates, by block of rows, with the N of a model and with each other.

    Attributes:
        columns: for each candidate, its columns.
        blocks_cross: shape (B, N, C), with the model's columns.
        blocks_inner: shape (B, C, C), with each other.
        blocks_g: shape (B, C), with the residuals.
        rows: what they are taken over; None if nobody knows.
        is_partial: whether those of one candidate's columns with another's are left out of ``blocks_inner``, to be taken
            from the rows when they are asked for: of many candidates few pairs are.
    """

    columns: tuple[np.ndarray, ...]
    blocks_cross: np.ndarray
    blocks_inner: np.ndarray
    blocks_g: np.ndarray
    rows: Rows | None = None
    is_partial: bool = False
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
    def _inner(self) -> np.ndarray:
        return _sum(self.blocks_inner)

    @cached_property
    def squares(self) -> np.ndarray:
        """Of each column with itself, shape (C,)."""
        return np.diag(self._inner)

    @cached_property
    def inner(self) -> np.ndarray:
        """Of all columns with each other, shape (C, C)."""
        return self.inner_of(range(len(self.columns)))

    def places(self, which: Sequence[int]) -> np.ndarray:
        """Return the columns of some candidates, shape (J,)."""
        return np.concatenate([np.zeros(0, int), *(self.columns[i] for i in which)])

    def inner_of(self, which: Sequence[int]) -> np.ndarray:
        """Return those of some candidates' columns with each other, shape (J, J)."""
        if self.is_partial and self.rows is not None and len(which) > 1:
            key = tuple(which)
            if key not in self._asked:
                self._asked[key] = self.rows.gram(which)
            return self._asked[key]
        j = self.places(which)
        return np.asarray(self._inner[np.ix_(j, j)])

    def each_inner(self, columns: np.ndarray) -> np.ndarray:
        """Return those of g columns of each of some candidates, shape (n, g), with each other, shape (n, g, g)."""
        return np.asarray(self._inner[columns[:, :, None], columns[:, None]])

    def among(self, which: Sequence[int], model: np.ndarray, gone: np.ndarray, values: np.ndarray) -> Products:
        """Return those of some candidates with some of a model's columns, others gone with their values.

        Args:
            which: the candidates.
            model: shape (M,), the columns of the model that stay.
            gone: shape (G,), those that go: the residuals grow by what they did.
            values: shape (G,), of their parameters.
        """
        j, ends = self.places(which), np.cumsum([0, *(len(self.columns[i]) for i in which)])
        cross = self.blocks_cross[:, :, j]
        return replace(
            self,
            columns=tuple(np.arange(a, b) for a, b in pairwise(ends)),
            blocks_cross=cross[:, model],
            blocks_inner=self.blocks_inner[:, j[:, None], j],
            blocks_g=self.blocks_g[:, j] + values @ cross[:, gone],
            rows=None if self.rows is None else self.rows.among(which, model, gone, values),
        )


def _sum(blocks: np.ndarray) -> np.ndarray:
    return blocks[0] if len(blocks) == 1 else np.asarray(blocks.sum(axis=0))
