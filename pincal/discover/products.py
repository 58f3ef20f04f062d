"""Components of score tests: the information of rows and priors on a model, and the rows with all
columns.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from pincal.identify.jacobian import Jacobian
from pincal.identify.quadratic import Factor, Form, taken
from pincal.identify.station import Station
from pincal.thresholds import Count

# Numbers that are kept of models without some parameters, and of one of these, as a multiple of
# its blocks' information: with its factors, for each choice of uncertain sizes.
_MOST_NUMBERS: Count = 16_000_000
_COPIES: Count = 12


@dataclass(frozen=True, eq=False)
class Doubted:
    """Information on parameters with priors of uncertain sizes, all others of a model fitted to
    them: what remains to be done for each choice of these sizes.

    Attributes:
        known: shape (K,), indices of the others.
        unsure: shape (U,), indices of these.
        factor: of the information on the others, K by K.
        slope: shape (K,), their gradient in its units.
        across: shape (K, U), its half of what both share.
        rest: what remains for these, U by U.
    """

    known: np.ndarray
    unsure: np.ndarray
    factor: Factor
    slope: np.ndarray
    across: np.ndarray
    rest: Form

    @classmethod
    def of(cls, H: np.ndarray, g: np.ndarray, is_unsure: np.ndarray) -> Doubted:
        """Return it of the information, shape (N, N), and gradient of rows and priors."""
        known = np.flatnonzero(~is_unsure)
        unsure = np.flatnonzero(is_unsure)
        factor = Factor.of(taken(H, known))
        slope = factor.half(g[known])
        across = factor.half(H[known[:, None], unsure])
        left = H[unsure[:, None], unsure] - across.T @ across
        rest = Form.of(left, g[unsure] - across.T @ slope)
        return cls(known, unsure, factor, slope, across, rest)

    def with_sizes(self, more: np.ndarray) -> tuple[Factor, np.ndarray]:
        """Return factor and gradient in its units of what remains, with the information, shape
        (U,), that a choice of sizes adds.
        """
        factor = Factor.of(self.rest.H + np.diag(more))
        return factor, factor.half(self.rest.g)


@dataclass(frozen=True, eq=False)
class Information:
    """Information of rows and priors on the N parameters of a model, by block of poses; the same
    for all candidates.

    Attributes:
        blocks: of the rows of each of B blocks.
        prior: of the priors.
        more: shape (N,), information by uncertain sizes beyond these priors; None for none.
        slot: the latest of :attr:`without_block`, of this or of one in the caches, and whose it is:
            each is as large as the blocks.
        variants: cache of the same with other uncertain sizes.
        doubts: cache of the same with uncertain sizes still to be chosen.
        parts: cache of the same without some parameters, the oldest first.
    """

    blocks: Form
    prior: Form
    more: np.ndarray | None = None
    slot: list[Any] = field(default_factory=list, repr=False)
    variants: dict[float, Information] = field(default_factory=dict, init=False, repr=False)
    doubts: dict[bytes, Doubted] = field(default_factory=dict, init=False, repr=False)
    parts: dict[bytes, Information] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def rows(self) -> Form:
        """Information of all rows."""
        blocks = self.blocks
        if len(blocks.g) == 1:
            return Form(blocks.H[0], blocks.g[0], blocks.whole[0])
        return blocks.sum()

    @cached_property
    def factor(self) -> Factor:
        """Factor of the information of rows and priors."""
        return Factor.of(self._with_priors(self.rows.H.copy()))

    def _with_priors(self, H: np.ndarray) -> np.ndarray:
        """Return information of rows, shape (N, N), with that of the priors, in place."""
        H += self.prior.H
        if self.more is not None:
            H.flat[:: len(H) + 1] += self.more
        return H

    @property
    def of_priors(self) -> np.ndarray:
        """Information of the priors with their present sizes, shape (N, N)."""
        return self._with_priors(np.zeros(self.prior.H.shape))

    @cached_property
    def slope(self) -> np.ndarray:
        """Gradient of rows and priors in units of the factor, shape (N,)."""
        return self.factor.half(self.rows.g + self.prior.g)

    def believing(self, factor: float, more: np.ndarray) -> Information:
        """Return the same with uncertain sizes multiplied by a factor, with the information that
        this adds, shape (N,).
        """
        if factor not in self.variants:
            self.variants[factor] = replace(self, more=more)
            # The same array, not its like.
            vars(self.variants[factor])["rows"] = self.rows
        return self.variants[factor]

    def doubted(self, is_unsure: np.ndarray) -> Doubted:
        """Return the same with the sizes of some parameters' priors, a mask of shape (N,), still to
        be chosen.
        """
        if (key := is_unsure.tobytes()) not in self.doubts:
            H = self._with_priors(self.rows.H.copy())
            self.doubts[key] = Doubted.of(H, self.rows.g + self.prior.g, is_unsure)
        return self.doubts[key]

    def without(self, model: np.ndarray, gone: np.ndarray, values: np.ndarray) -> Information:
        """Return the same of some parameters, ``model``, with the others, ``gone``, set from
        ``values`` to zero.

        To first order the residuals r grow by J v for columns J of value v, and g by H v.
        """
        if (key := gone.tobytes()) not in self.parts:
            most = _MOST_NUMBERS // (_COPIES * max(self.blocks.H.size, 1))
            while len(self.parts) >= max(most, 1):
                del self.parts[next(iter(self.parts))]
            kept = self.blocks.part(model)
            kept = replace(kept, g=kept.g + self.blocks.H[:, model[:, None], gone] @ values)
            more = None if self.more is None else self.more[model]
            self.parts[key] = Information(kept, self.prior.part(model), more, self.slot)
        return self.parts[key]

    @property
    def without_block(self) -> list[tuple[Factor, np.ndarray]]:
        """Factor of the information and step of the parameters, without each block."""
        if not self.slot or self.slot[0] is not self._token:
            # What was there is freed first.
            self.slot.clear()
            self.slot.extend([self._token, list(self._each_without_block())])
        found: list[tuple[Factor, np.ndarray]] = self.slot[1]
        return found

    @cached_property
    def _token(self) -> object:
        """What the slot knows this by: a reference to this itself would be a cycle."""
        return object()

    def _each_without_block(self) -> Iterator[tuple[Factor, np.ndarray]]:
        for H, g in zip(self.blocks.H, self.blocks.g, strict=True):
            factor = Factor.of(self._with_priors(self.rows.H - H))
            yield factor, factor.solve(self.rows.g - g + self.prior.g)


class Whitening(NamedTuple):
    """How residuals and columns of some rows of a station become white, in units of the noise.

    Attributes:
        station: the station.
        piece: its rows.
        scale: shape (m, n), factors on the readings, independent between rows.
    """

    station: Station
    piece: slice
    scale: np.ndarray

    def whitened(self, columns: np.ndarray) -> np.ndarray:
        """Return columns, shape (D, m, n), whitened."""
        return np.asarray(self.station.uncorrelated(columns, self.piece) * self.scale)

    def jacobians(self, jacobian: Jacobian) -> Iterator[tuple[slice, Jacobian]]:
        """Yield readings and a Jacobian at these, whitened; if their rows are correlated, with a
        column for each parameter.
        """
        for readings in self.station.readings_apart:
            found = self.station.uncorrelated_jacobian(jacobian, self.piece, readings)
            yield readings, found.weighted(self.scale[readings])

    def add_grams(
        self, jacobian: Jacobian, residuals: np.ndarray, H: np.ndarray, g: np.ndarray
    ) -> None:
        """Add the products of a Jacobian, once it is whitened, with itself to H, shape (1, F, F),
        and with whitened residuals to g, shape (1, F), for all rows together.
        """
        ends = np.array([0, self.piece.stop - self.piece.start])
        for readings, part in self.station.by_block(jacobian, self.piece):
            scale = self.scale[readings]
            r = np.divide(residuals[readings], scale, where=scale > 0.0, out=np.zeros(scale.shape))
            part.add_grams(r, ends, H, g, weights=scale)

    def add_products(
        self, columns: Jacobian, whitened: Jacobian, S: np.ndarray, readings: slice, rows: slice
    ) -> None:
        """Add to S the products of columns, once they are whitened, with whitened ones at some
        readings, of some of the rows.

        Where rows are correlated, the others are multiplied by the transpose of what whitens, so
        that curves of these columns stay a basis times a column.
        """
        scale = self.scale[readings, rows]
        factor = self.station.factor_alone(readings)
        if factor is not None:
            others = whitened.poses(rows).weighted(scale * factor)
            columns.part(readings, rows).add_products(others, S)
            return
        every = slice(0, self.piece.stop - self.piece.start)
        part = columns.part(readings, every)
        change = self.station.along_rows(self.piece, readings)
        if change is not None:
            by_row = np.zeros(whitened.dense.shape[::-1])
            by_row[rows] = (whitened.dense[..., rows] * scale).transpose(2, 1, 0)
            change(by_row, transposed=True)
            part.add_products_of_rows(by_row, whitened.places, S)
            return
        dense = np.zeros(whitened.dense.shape)
        dense[..., rows] = whitened.dense[..., rows] * scale
        self.station.uncorrelate(dense, self.piece, readings, transposed=True)
        part.add_products(replace(whitened, dense=dense), S)


class RowPart(NamedTuple):
    """Some rows of a station, with whitened residuals, and columns that are whitened when they are
    used.

    Attributes:
        rows: shape (n,), their indices among all rows of the fit.
        residuals: shape (m, n).
        model: the station's columns of the model.
        candidates: the station's columns of the candidates.
        at: indices of the model's and then the candidates' columns among all columns; -1 for
            removed ones.
        whitening: of the columns.
    """

    rows: np.ndarray
    residuals: np.ndarray
    model: Jacobian
    candidates: Jacobian
    at: np.ndarray
    whitening: Whitening

    def moved(self, steps: np.ndarray) -> np.ndarray:
        """Return how R steps of the parameters of all columns, shape (N + C, R), move the rows,
        shape (R, m, n).
        """
        # Removed columns take no step.
        steps = np.vstack([steps, np.zeros(steps.shape[1])])
        n = self.model.size
        some = np.flatnonzero(steps[self.at[n:]].any(axis=1))
        added = self.candidates.only(some).along(steps[self.at[n + some]])
        return self.whitening.whitened(self.model.along(steps[self.at[:n]]) + added)

    def products(self, some: np.ndarray, others: np.ndarray) -> np.ndarray:
        """Return the products of J columns of candidates with K others, by index among all, shape
        (J, K).
        """
        pairs = (np.nonzero(of[:, None] == self.at[self.model.size :]) for of in (some, others))
        (here, mine), (there, theirs) = pairs
        own = np.zeros((len(here), len(there)))
        found = np.zeros((len(some), len(others)))
        whitening = self.whitening
        rows = slice(0, len(self.rows))
        columns = self.candidates.only(mine)
        for readings, whitened in whitening.jacobians(self.candidates.only(theirs)):
            whitening.add_products(columns, whitened, own, readings, rows)
        found[np.ix_(here, there)] = own
        return found

    def among(self, slots: np.ndarray, undone: np.ndarray) -> RowPart:
        """Return the rows with columns at other indices, shape (N + C + 1,), and values ``undone``
        set to zero.
        """
        return self._replace(
            residuals=self.residuals + self.moved(undone[:, None])[0], at=slots[self.at]
        )
