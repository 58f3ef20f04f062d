r"""The information form: rows, priors and earlier fits as one sum of squares over named parameters
about a point.

With r the residuals at that point in units of their noise and J the columns with which parameters x
reduce them,

.. math:: |r - J x|^2 = s - 2 g^T x + x^T H x, \qquad H = J^T J, \quad g = J^T r, \quad s = r^T r .

Sums of such squares over rows, stations, robots and priors have the same form, also after some
parameters are marginalised: the information filter of Bierman (Factorization Methods for Discrete
Sequential Estimation, 1977), the Hessian factor of factor graphs (Dellaert and Kaess 2017). For a
model linear in x the form of a joint fit is the sum of its parts'.

An unobservable direction contains only rounding: it is recognised by comparison with the
information that its parameters had before any elimination.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.linalg import LinAlgError, cho_solve, cholesky, solve_triangular
from scipy.special import chdtrc

from pincal.thresholds import Scale

# Fraction of the parameters' information before any elimination below which a direction counts as
# unobserved. Two columns that agree to one part in 300 are one then: linearisation errors of a
# sound model are as large.
SEEN: Scale = 1e-5
# The same where only rounding, some 1e-16 of the largest entry, is to be excluded.
ROUNDING: Scale = 1e-12
# Factors by which more is added, and up to which, where rounding leaves less than no information.
_MORE: Scale = 30.0
_UNTOLD: Scale = 1e-8
# The same for finding directions that are unobservable altogether, where weakly observed ones still
# count: a hundred to a thousand times the rounding of a sum over the rows.
NULL: Scale = 1e-13


def taken(H: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the rows and columns of matrices, shape (..., F, F), at some indices, shape (n,)."""
    # By rows and then by columns, which takes a fraction of the time of both at once.
    return np.asarray(np.take(np.take(H, at, axis=-2), at, axis=-1))


@dataclass(frozen=True, eq=False)
class Form:
    """Information on F parameters, by index; of several forms, as of stations, with a leading axis.

    Attributes:
        H: shape (F, F), their information.
        g: shape (F,), half of the negative gradient of the sum of squares.
        whole: shape (F,), the diagonal of H before any elimination.
    """

    H: np.ndarray
    g: np.ndarray
    whole: np.ndarray

    @classmethod
    def of(cls, H: np.ndarray, g: np.ndarray | None = None) -> Form:
        """Return a form from information without elimination; default: at its minimum."""
        whole = np.diagonal(H, axis1=-2, axis2=-1)
        return Form(H, np.zeros(whole.shape) if g is None else g, whole)

    def part(self, at: np.ndarray) -> Form:
        """Return the form of the parameters at some indices, shape (n,), conditional on
        the others.
        """
        return Form(taken(self.H, at), self.g[..., at], self.whole[..., at])

    def sum(self) -> Form:
        """Return the sum over leading axes; of a single form its own arrays."""
        *several, _ = self.g.shape
        parts = (self.H, self.g, self.whole)
        if all(n == 1 for n in several):
            return Form(*(of[(0,) * len(several)] for of in parts))
        return Form(*(np.sum(of, axis=tuple(range(len(several)))) for of in parts))

    def gain(self, at: np.ndarray, tolerance: float = SEEN) -> tuple[float, int]:
        """Return how much some parameters, the others held, reduce the sum of squares, and their
        observed rank.

        If they are zero the gain is chi-square with as many degrees of freedom.
        """
        # As :meth:`root`, which would be two more matrices of many parameters.
        values, vectors, scale = _scaled_axes(self.H[np.ix_(at, at)], self.whole[at])
        seen = values > tolerance
        along = ((self.g[at] * scale) @ vectors)[seen] ** 2 / values[seen]
        return float(along.sum()), len(along)

    def chance(self, at: np.ndarray, tolerance: float = SEEN) -> float:
        """Return the p-value of the gain, for the hypothesis that these parameters are zero."""
        gain, rank = self.gain(at, tolerance)
        return float(chdtrc(rank, gain)) if rank else 1.0

    def estimate(self, at: np.ndarray, tolerance: float = SEEN) -> tuple[np.ndarray, np.ndarray]:
        """Return the estimates of some parameters, the others held, and their covariance; zero
        where unobserved.
        """
        root = self.root(at, tolerance)
        return root @ (root.T @ self.g[at]), root @ root.T

    def root(self, at: np.ndarray, tolerance: float = SEEN) -> np.ndarray:
        """Return the root of the covariance of some parameters, the others held, over what is
        observed, (n, rank).
        """
        return root_of_inverse(self.H[np.ix_(at, at)], self.whole[at], tolerance)


@dataclass(frozen=True, eq=False, kw_only=True)
class Quadratic(Form):
    """Squares about a point, square - 2 g x + x H x, over F named parameters x, in units of the
    noise.

    Attributes:
        names: the parameters.
        square: the squares at x = 0.
        degrees: number of readings and priors minus that of eliminated directions.
    """

    names: tuple[str, ...]
    square: float
    degrees: float

    @classmethod
    def of_rows(cls, names: Sequence[str], J: np.ndarray, r: np.ndarray) -> Self:
        """Return the form of R rows: J of shape (R, F) and r of shape (R,), both in units of the
        noise.
        """
        H = J.T @ J
        return cls(
            H, J.T @ r, np.diag(H), names=tuple(names), square=float(r @ r), degrees=float(len(r))
        )

    @classmethod
    def of_prior(
        cls, names: Sequence[str], sizes: np.ndarray, offsets: np.ndarray | None = None
    ) -> Self:
        """Return the form of independent priors.

        Args:
            names: F parameters.
            sizes: shape (F,), standard deviations; inf for none.
            offsets: shape (F,), the point minus the priors' centres; default: zero.
        """
        precision = np.asarray(sizes, float) ** -2.0
        at = np.zeros(len(precision)) if offsets is None else offsets
        square = float(precision @ at**2)
        known = float(np.count_nonzero(precision))
        return cls(
            np.diag(precision),
            -precision * at,
            precision,
            names=tuple(names),
            square=square,
            degrees=known,
        )

    def __add__(self, other: Quadratic) -> Quadratic:
        """Return the sum of both, by parameter name; a form holds no information on parameters that
        it does not have.
        """
        names = tuple(dict.fromkeys((*self.names, *other.names)))
        place = {name: i for i, name in enumerate(names)}
        H = np.zeros((len(names),) * 2)
        g = np.zeros(len(names))
        whole = np.zeros(len(names))
        for form in (self, other):
            at = np.array([place[name] for name in form.names], int)
            H[np.ix_(at, at)] += form.H
            g[at] += form.g
            whole[at] += form.whole
        square = self.square + other.square
        degrees = self.degrees + other.degrees
        return Quadratic(H, g, whole, names=names, square=square, degrees=degrees)

    def at(self, values: np.ndarray) -> Quadratic:
        """Return the same squares about another point, ``values`` of shape (F,) away."""
        square = self.square - 2.0 * float(self.g @ values) + float(values @ self.H @ values)
        return replace(self, g=self.g - self.H @ values, square=square)

    def taking(self, at: np.ndarray) -> Quadratic:
        """Return the form of the parameters at some indices, the others held."""
        return replace(self, **vars(self.part(at)), names=tuple(self.names[i] for i in at))

    def held(self, at: np.ndarray) -> Quadratic:
        """Return the form of the other parameters if those at some indices are held."""
        return self.taking(np.setdiff1d(np.arange(len(self.names)), at))

    def released(self, at: np.ndarray, tolerance: float = SEEN) -> Quadratic:
        """Return the form with the parameters at some indices marginalised.

        They keep their indices, without any information on them; :meth:`held` removes them.
        """
        root = self.root(at, tolerance)
        across = self.H[:, at] @ root
        along = root.T @ self.g[at]
        return replace(
            self,
            H=self.H - across @ across.T,
            g=self.g - across @ along,
            square=self.square - float(along @ along),
            degrees=self.degrees - len(along),
        )


@dataclass(frozen=True, eq=False)
class Factor:
    """Cholesky factor of information H that priors make definite: H = L L^T / (scale scale^T).

    Attributes:
        scale: shape (F,).
        L: shape (F, F), lower; of H scaled to a diagonal of 1, plus a little for rounding.
    """

    scale: np.ndarray
    L: np.ndarray

    @classmethod
    def of(cls, H: np.ndarray) -> Factor:
        """Return the factor of H, shape (F, F), symmetric, which is overwritten.

        A direction that nothing tells, such as frames of an instrument without the rows that it
        saw, may have a little less than no information by rounding: it is then given a little.

        Raises:
            LinAlgError: if H is far from what information may be.
        """
        scale = np.asarray(1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300)))
        H *= scale
        H *= scale[:, None]
        more = ROUNDING
        while True:
            H.flat[:: len(H) + 1] += more
            try:
                return cls(scale, cholesky(H.T, lower=True, check_finite=False))
            except LinAlgError:
                if more > _UNTOLD:
                    raise
                more *= _MORE

    @property
    def log_det(self) -> float:
        """Log of the determinant of H."""
        return 2.0 * float(np.sum(np.log(np.diag(self.L) / self.scale)))

    def half(self, right: np.ndarray) -> np.ndarray:
        """Return X, shape (F,) or (F, n), with X^T X = right^T H^-1 right."""
        scaled = (right.T * self.scale).T
        return np.asarray(solve_triangular(self.L, scaled, lower=True, check_finite=False))

    def back(self, half: np.ndarray) -> np.ndarray:
        """Return H^-1 right for :meth:`half` of it."""
        return np.asarray(
            (
                solve_triangular(self.L, half, lower=True, trans="T", check_finite=False).T
                * self.scale
            ).T
        )

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return H^-1 right, shape (F,) or (F, n)."""
        return np.asarray(
            (
                cho_solve((self.L, True), (right.T * self.scale).T, check_finite=False).T
                * self.scale
            ).T
        )


def root_of_inverse(H: np.ndarray, whole: np.ndarray, tolerance: float) -> np.ndarray:
    """Return R, shape (n, k), with R R^T the inverse of information H over the k observed
    directions.

    Args:
        H: shape (n, n).
        whole: shape (n,), the diagonal by which information is scaled.
        tolerance: scaled information below which a direction is unobserved.
    """
    values, vectors, scale = _scaled_axes(H.copy(), whole)
    seen = values > tolerance
    return np.asarray((scale[:, None] * vectors[:, seen]) / np.sqrt(values[seen]))


def _scaled_axes(H: np.ndarray, whole: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the eigenvalues and eigenvectors of information scaled by a diagonal ``whole``, and
    the factors by which it is; ``H`` is overwritten.
    """
    scale = 1.0 / np.sqrt(np.maximum(whole, 1e-300))
    H *= scale
    H *= scale[:, None]
    values, vectors = np.linalg.eigh(H)
    return values, vectors, scale
