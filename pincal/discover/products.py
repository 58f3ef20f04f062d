"""Products of the whitened columns of a model and of all candidates with each other, and with the residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pincal.identify.jacobian import Jacobian
from pincal.identify.problem import Problem


@dataclass(frozen=True, eq=False)
class Between:
    """The columns of candidates, for products of one's with another's: of many candidates few pairs are asked for.

    Attributes:
        columns: for each candidate, its columns among all.
        parts: whitened Jacobians of parts of the rows, each with where every column stands in it, shape (P,), -1 if nowhere.
    """

    columns: tuple[np.ndarray, ...]
    parts: tuple[tuple[np.ndarray, Jacobian], ...]

    def gram(self, which: Sequence[int]) -> np.ndarray:
        """Return the Gram matrix of the J columns of some candidates, shape (J, J)."""
        columns = np.concatenate([self.columns[i] for i in which])
        G = np.zeros((len(columns), len(columns)))
        for slot, jacobian in self.parts:
            here = np.flatnonzero(slot[columns] >= 0)
            own, (m, n) = np.zeros((len(here), len(here))), jacobian.dense.shape[1:]
            jacobian.only(slot[columns[here]]).add_gram(np.zeros((m, n)), own, np.zeros(len(here)))
            G[np.ix_(here, here)] += own
        return G

    def among(self, which: Sequence[int]) -> Between:
        """Return the same of some candidates."""
        return replace(self, columns=tuple(self.columns[i] for i in which))


@dataclass(frozen=True, eq=False)
class Products:
    """Products of P columns, those of the model before those of the candidates, by block of rows.

    Attributes:
        problem: the model with all candidates.
        known: where the parameters of the fit stand in it.
        places: shape (P,), where those of the columns do.
        columns: for each candidate, its columns, counted from the first of all candidates.
        S: shape (B, P, P), of columns; those of one candidate's columns with another's may be left out where there is one
            block of rows.
        b: shape (B, P), of columns and residuals.
        between: has what is left out; None if nothing is.
    """

    problem: Problem
    known: np.ndarray
    places: np.ndarray
    columns: tuple[np.ndarray, ...]
    S: np.ndarray
    b: np.ndarray
    between: Between | None
