r"""Features through measured points, by generalised least squares with their full covariance.

With the signed distances g(x; theta) of the points, whose derivatives are N by the points and J by
the parameters, the most probable errors of the points and the best parameters make

.. math:: \min_{\delta, \theta} \delta^T C^{-1} \delta
    \quad\text{with}\quad g(x - \delta; \theta) = 0,

which is solved by Gauss and Helmert's linearisation at the adjusted points. With
W = (N C N^T)^{-1}, errors of points move the parameters by

.. math:: \delta\theta = -(J^T W J)^{-1} J^T W N \, \delta x = A \, \delta x .

A C_s A^T is hence the covariance of the parameters by any source s of errors. A covariance C may be
singular, as where all points share their errors. Where the residuals are larger than C explains,
the surface is not of its form: independent deviations along the normal, of the size that makes
chi-square equal to the degrees of freedom (Mandel and Paule 1982), are added to C.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pincal.errors import BadInputError, IdentificationError, counted, nearest_first
from pincal.features.feature_kinds import (
    FITTED_KINDS,
    NUMBERS,
    OF_DIRECTION,
    OF_POSITION,
    Equations,
    FeatureKind,
    stepped,
)
from pincal.features.fit_numbers import FIT
from pincal.thresholds import Count, Scale

# Steps of a fit; from a start within its basin it takes five.
_STEPS: Count = 50
# Step, relative to the size of the feature, below which a fit has converged.
_CONVERGED: Scale = 1e-10
# Step that rounding and a second-order coupling leave at points that fit badly.
_STALLED: Scale = 1e-6
# Least standard deviation of a point along the normal [m], and relative to the largest one: what
# makes a singular covariance invertible without a weight that counts.
_EXACT: Scale = 1e-9
_RELATIVE: Scale = 1e-3
# Damping of the first step of a search, and its factor after each step.
_DAMPED: Scale = 1e-3
_DAMPING_FACTOR: Scale = 10.0


@dataclass(frozen=True, eq=False)
class FittedFeature:
    """A feature through N points.

    Attributes:
        kind: of the feature, of ``FITTED_KINDS``.
        numbers: shape (7,), x y z [m], i j k, radius [m] in the frame of the points; zero where the
            kind has none. The position is that point of a line, a plane or an axis which is nearest
            to the mean of the points.
        sensitivity: shape (7, 3N), motion of these by errors of the points. A position moves across
            a line or an axis, and along the normal of a plane; a direction across itself.
        covariance: shape (7, 7), by the covariance of the points and by the deviations from form.
        deviations: shape (N, m), signed distances of the points from the feature [m].
        normals: shape (N, m, 3), their directions.
        form_error: peak to valley from the least-squares feature [m]: as in ISO 12780, 12781, 12181
            and 12180; of a line the diameter of a cylinder about it; 0 for a point.
        form_sigma: standard deviation of the surface along its normal that the errors of the
            points do not explain [m]; 0 if they do.
        chi_square: of the residuals by the covariance of the points alone.
        dof: degrees of freedom of the residuals.
    """

    kind: str
    numbers: np.ndarray
    sensitivity: np.ndarray
    covariance: np.ndarray
    deviations: np.ndarray
    normals: np.ndarray
    form_error: float
    form_sigma: float
    chi_square: float
    dof: int

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.deviations)

    @property
    def names(self) -> tuple[str, ...]:
        """Those of the seven numbers that the kind has."""
        return FITTED_KINDS[self.kind].has

    @property
    def position(self) -> np.ndarray:
        """The position, shape (3,) [m]."""
        return self.numbers[OF_POSITION]

    @property
    def direction(self) -> np.ndarray:
        """The unit direction of line or axis, or the normal, shape (3,); its sign is arbitrary."""
        return self.numbers[OF_DIRECTION]

    @property
    def radius(self) -> float:
        """The radius [m]."""
        return float(self.numbers[6])

    @property
    def form_covariance(self) -> np.ndarray:
        """What deviations from form add to the covariance of each point, shape (N, 3, 3) [m^2]."""
        outer = np.einsum("nma,nmb->nab", self.normals, self.normals)
        return np.asarray(self.form_sigma**2 * outer)

    def sigma(self, name: str) -> float:
        """Return the standard uncertainty of one of the seven numbers, by its name."""
        i = NUMBERS.index(name)
        return float(np.sqrt(max(self.covariance[i, i], 0.0)))


def fit_feature(
    kind: str,
    points: np.ndarray,
    covariance: np.ndarray | None = None,
    *,
    name: str = "",
) -> FittedFeature:
    """Fit a feature to points.

    Args:
        kind: "point", "line", "plane", "circle", "sphere" or "cylinder".
        points: shape (N, 3), in any one frame [m].
        covariance: shape (3N, 3N), of their errors, x y z of the first before those of the second
            [m^2]; it may be singular. None: unknown, so that all have one weight and the
            uncertainty follows from the residuals alone.
        name: of the feature, for messages.

    Raises:
        BadInputError: for an unknown kind, arrays of other shapes or not finite, too few points, or
            such as do not determine the feature.
        IdentificationError: if the fit does not converge.

    Example:
        >>> corners = np.array([[0.1, 0, 0], [0, 0.1, 0], [-0.1, 0, 0], [0, -0.1, 0.0]])
        >>> hole = fit_feature("circle", corners, 1e-10 * np.eye(12))
        >>> round(hole.radius, 9), round(1e6 * hole.sigma("radius"), 3), hole.dof
        (0.1, 5.0, 2)
    """
    of = _kind(kind, name)
    points = _points(points, of, name)
    C = _covariance(covariance, len(points), of.name, name)
    adjustment = _Adjustment(of, points, C, name)
    fitted = adjustment.fit(adjustment.start(), form_sigma=0.0)
    weighted = fitted
    form_sigma = fitted.unexplained()
    if form_sigma > 0.0:
        weighted = adjustment.fit(fitted.numbers, form_sigma=form_sigma)
    found = weighted.result(fitted.chi_square)
    _check_sure(found, name)
    return found


def _said(kind: str, name: str) -> str:
    return f"feature {name!r} ({kind})" if name else f"a {kind}"


def _kind(kind: str, name: str) -> FeatureKind:
    found = FITTED_KINDS.get(kind)
    if found is None:
        known = ", ".join(nearest_first([kind], FITTED_KINDS))
        of_name = f" of feature {name!r}" if name else ""
        raise BadInputError(f"kind{of_name} {kind!r}; expected one of {known}")
    return found


def _points(points: np.ndarray, kind: FeatureKind, name: str) -> np.ndarray:
    """Return points that may determine a feature; refuse others."""
    said = _said(kind.name, name)
    found = np.array(points, float)
    if found.ndim != 2 or found.shape[1] != 3 or not np.isfinite(found).all():
        raise BadInputError(f"{said}: points of shape {found.shape}; expected finite (N, 3)")
    if len(found) < kind.least:
        raise BadInputError(
            f"{said}: {counted(len(found), 'point')}; expected {kind.least} or more, in other "
            "places"
        )
    extents = np.zeros(3)
    sizes = np.linalg.svd(found - found.mean(axis=0), compute_uv=False)
    extents[: len(sizes)] = sizes
    needed = extents[kind.extent - 1] if kind.extent else np.inf
    if needed <= FIT.flat * extents[0] or extents[0] < _EXACT * bool(kind.extent):
        shape = ("one place", "one line", "one plane")[kind.extent - 1]
        raise BadInputError(
            f"{said}: its {counted(len(found), 'point')} are in {shape}; expected points that "
            f"leave it by {FIT.flat:g} of their extent or more"
        )
    return found


def _covariance(given: np.ndarray | None, n: int, kind: str, name: str) -> np.ndarray:
    """Return the covariance of n points, shape (3n, 3n); zero if it is unknown."""
    if given is None:
        return np.zeros((3 * n, 3 * n))
    found = np.array(given, float)
    if found.shape != (3 * n, 3 * n) or not np.isfinite(found).all():
        raise BadInputError(
            f"{_said(kind, name)}: covariance of shape {found.shape}; expected finite "
            f"({3 * n}, {3 * n}), that of {n} points"
        )
    return np.asarray((found + found.T) / 2.0)


@dataclass(frozen=True, eq=False)
class _Adjustment:
    """Points and their covariance, to which a feature is fitted."""

    kind: FeatureKind
    points: np.ndarray
    covariance: np.ndarray
    name: str

    @cached_property
    def size(self) -> float:
        """Extent of the points [m], by which steps of directions count as lengths."""
        return max(float(np.ptp(self.points, axis=0).max()), _EXACT)

    def start(self) -> np.ndarray:
        """Return the numbers of the best fit with equal weights."""
        found = [self._descend(numbers) for numbers in self.kind.starts(self.points)]
        costs = [float(np.sum(self._equations(numbers).values ** 2)) for numbers in found]
        return found[int(np.argmin(costs))]

    def _equations(self, numbers: np.ndarray) -> Equations:
        return self.kind.equations(numbers, self.points)

    def _scaled(self, numbers: np.ndarray) -> np.ndarray:
        """Return the free directions, in which a step of 1 m moves points by about that."""
        basis = self.kind.free(numbers)
        basis[OF_DIRECTION] /= self.size
        return basis

    def _descend(self, numbers: np.ndarray) -> np.ndarray:
        """Return the nearest least-squares feature with equal weights (Levenberg, Marquardt)."""
        damping = _DAMPED
        equations = self._equations(numbers)
        cost = float(np.sum(equations.values**2))
        for _ in range(_STEPS):
            basis = self._scaled(numbers)
            J = equations.by_steps(basis).reshape(-1, basis.shape[1])
            H = J.T @ J
            slope = J.T @ equations.values.ravel()
            damped = H + damping * np.diag(np.diag(H) + _EXACT)
            step = -np.linalg.solve(damped, slope)
            tried = stepped(numbers, basis @ step)
            there = self._equations(tried)
            cost_there = float(np.sum(there.values**2))
            if cost_there <= cost:
                numbers = tried
                equations = there
                cost = cost_there
                damping /= _DAMPING_FACTOR
            else:
                damping *= _DAMPING_FACTOR
            if np.linalg.norm(step) < _CONVERGED * self.size:
                break
        return numbers

    def fit(self, numbers: np.ndarray, *, form_sigma: float) -> _Weighted:
        """Return the generalised least-squares fit from a start near it.

        Raises:
            IdentificationError: if it does not converge.
        """
        adjusted = self.points
        step = np.full(1, np.inf)
        for _ in range(_STEPS):
            weighted = _Weighted(self, numbers, adjusted, form_sigma)
            step, errors = weighted.step()
            numbers = stepped(numbers, weighted.basis @ step)
            adjusted = self.points - errors
            if np.linalg.norm(step) < _CONVERGED * self.size:
                break
        if not np.linalg.norm(step) < _STALLED * self.size:
            raise IdentificationError(
                f"{_said(self.kind.name, self.name)}: the fit to {len(self.points)} points did not "
                f"converge in {_STEPS} steps; look for points of another feature among them, check "
                "mount and noise of the sensor, or measure it with more points that are further "
                "apart"
            )
        return _Weighted(self, self._at_mean(numbers), adjusted, form_sigma)

    def _at_mean(self, numbers: np.ndarray) -> np.ndarray:
        """Return the same feature with its position nearest to the mean of the points, where it
        may be shifted along itself.
        """
        found = numbers.copy()
        offset = self.points.mean(axis=0) - numbers[OF_POSITION]
        direction = numbers[OF_DIRECTION]
        along = direction * (direction @ offset)
        if self.kind.name in ("line", "cylinder"):
            found[OF_POSITION] += along
        elif self.kind.name == "plane":
            found[OF_POSITION] += offset - along
        return found


@dataclass(frozen=True, eq=False)
class _Weighted:
    """The equations at a feature's numbers and adjusted points, with their weights."""

    of: _Adjustment
    numbers: np.ndarray
    adjusted: np.ndarray
    form_sigma: float

    @cached_property
    def equations(self) -> Equations:
        return self.of.kind.equations(self.numbers, self.adjusted)

    @cached_property
    def basis(self) -> np.ndarray:
        """Directions of the free parameters, shape (7, p)."""
        return self.of._scaled(self.numbers)

    @cached_property
    def J(self) -> np.ndarray:
        """Derivatives of the equations by the free parameters, shape (Nm, p)."""
        return self.equations.by_steps(self.basis).reshape(-1, self.basis.shape[1])

    @cached_property
    def misclosures(self) -> np.ndarray:
        """The equations at the measured points, linearised at the adjusted ones, shape (Nm,)."""
        errors = self.of.points - self.adjusted
        moved_by = np.einsum("nma,na->nm", self.equations.by_point, errors)
        return np.asarray((self.equations.values + moved_by).ravel())

    @cached_property
    def covariance_by_normals(self) -> np.ndarray:
        """C N^T, shape (3N, Nm)."""
        N = self.equations.by_point
        n, m, _ = N.shape
        C = self.of.covariance.reshape(3 * n, n, 3)
        found = np.einsum("cna,nma->cnm", C, N)
        return np.asarray(found.reshape(3 * n, n * m))

    @cached_property
    def of_points(self) -> np.ndarray:
        """N C N^T, the covariance of the equations by the errors of the points, shape (Nm, Nm)."""
        N = self.equations.by_point
        n, m, _ = N.shape
        by_normals = self.covariance_by_normals.reshape(n, 3, n * m)
        found = np.einsum("nma,nac->nmc", N, by_normals)
        return np.asarray(found.reshape(n * m, n * m))

    @cached_property
    def own(self) -> float:
        """Variance that each equation has of its own: of form, and what keeps a singular
        covariance invertible [m^2].
        """
        largest = float(np.diag(self.of_points).max(initial=0.0))
        return max(_EXACT**2, _RELATIVE**2 * largest) + self.form_sigma**2

    @cached_property
    def root(self) -> np.ndarray:
        """Cholesky factor of the covariance of the equations, shape (Nm, Nm)."""
        size = len(self.of_points)
        return np.linalg.cholesky(self.of_points + self.own * np.eye(size))

    def whiten(self, array: np.ndarray) -> np.ndarray:
        """Return equations, or their derivatives, in units of their errors."""
        from scipy.linalg import solve_triangular

        return np.asarray(solve_triangular(self.root, array, lower=True))

    @cached_property
    def to_steps(self) -> np.ndarray:
        """Minus the step of the parameters by the equations, shape (p, Nm)."""
        whitened = self.whiten(self.J)
        return np.asarray(np.linalg.pinv(whitened) @ self.whiten(np.eye(len(self.J))))

    def residuals(self) -> np.ndarray:
        """Return the misclosures that no parameters remove, shape (Nm,) [m]."""
        return np.asarray(self.misclosures - self.J @ (self.to_steps @ self.misclosures))

    def step(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the step of the parameters, shape (p,), and the errors of the points that go with
        it, shape (N, 3) [m].
        """
        white = self.whiten(self.residuals())
        multipliers = np.linalg.solve(self.root.T, white)
        n, m, _ = self.equations.by_point.shape
        by_form = np.einsum(
            "nma,nm->na", self.equations.by_point, self.own * multipliers.reshape(n, m)
        )
        errors = (self.covariance_by_normals @ multipliers).reshape(n, 3) + by_form
        return -self.to_steps @ self.misclosures, errors

    @property
    def chi_square(self) -> float:
        return float(np.sum(self.whiten(self.residuals()) ** 2))

    @property
    def dof(self) -> int:
        return int(self.J.shape[0] - self.J.shape[1])

    def unexplained(self) -> float:
        """Return the standard deviation along the normal that makes chi-square equal to the degrees
        of freedom [m], 0 if the errors of the points explain it.
        """
        from scipy.optimize import brentq
        from scipy.stats import chi2

        if self.dof == 0 or self.chi_square <= chi2.isf(FIT.form, self.dof):
            return 0.0
        # In the space that no parameters reach, with axes in which the errors are independent.
        free = np.linalg.qr(self.J, mode="complete")[0][:, self.J.shape[1] :]
        variances, axes = np.linalg.eigh(free.T @ self.of_points @ free)
        squares = ((free @ axes).T @ self.misclosures) ** 2
        known = np.maximum(variances, 0.0) + self.own

        def excess(log_variance: float) -> float:
            return float(np.sum(squares / (known + np.exp(log_variance))) - self.dof)

        lowest = np.log(_EXACT**2)
        highest = np.log(squares.sum() + _EXACT**2)
        if excess(lowest) <= 0.0:
            return 0.0
        return float(np.exp(brentq(excess, lowest, highest) / 2.0))

    def result(self, chi_square: float) -> FittedFeature:
        """Return the feature, with the chi-square by the errors of the points alone."""
        N = self.equations.by_point
        n, m, _ = N.shape
        by_equations = -(self.basis @ self.to_steps)
        sensitivity = np.einsum("pnm,nma->pna", by_equations.reshape(7, n, m), N)
        sensitivity = sensitivity.reshape(7, 3 * n)
        by_form = self.form_sigma**2 * by_equations @ by_equations.T
        deviations = self.of.kind.equations(self.numbers, self.of.points).values
        return FittedFeature(
            kind=self.of.kind.name,
            numbers=self.numbers,
            sensitivity=sensitivity,
            covariance=sensitivity @ self.of.covariance @ sensitivity.T + by_form,
            deviations=deviations,
            normals=N,
            form_error=self.of.kind.form_error(deviations),
            form_sigma=self.form_sigma,
            chi_square=chi_square,
            dof=self.dof,
        )


def _check_sure(found: FittedFeature, name: str) -> None:
    """Refuse a feature that its points leave open."""
    for what, sigma in _open(found):
        if not sigma <= FIT.unsure:
            raise BadInputError(
                f"{_said(found.kind, name)}: {counted(len(found), 'point')} with the errors that "
                f"they have leave its {what} open (standard uncertainty {sigma:.2g}); expected "
                f"{FIT.unsure:g} or less: measure points that are further apart, all around it"
            )


def _open(found: FittedFeature) -> Iterator[tuple[str, float]]:
    """Yield the standard uncertainties of direction [rad] and radius, relative to the radius."""
    variances = np.diag(found.covariance)
    if "i" in found.names:
        yield "direction", float(np.sqrt(variances[OF_DIRECTION].max()))
    if "radius" in found.names:
        yield "radius relative to its size", found.sigma("radius") / max(found.radius, _EXACT)
