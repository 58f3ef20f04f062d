r"""Probing errors of size and form by a calibrated sphere, after ISO 10360-12.

The tool point, the centre of a ball of radius r, touches a sphere of the calibrated diameter D in
25 points of a hemisphere. Of the least-squares sphere through the positions that the model gives,
with its radius R and the distances :math:`d_i` of the points from its centre,

.. math:: P_{Size} = 2 (R - r) - D, \qquad P_{Form} = \max_i d_i - \min_i d_i .

Both are decided by the rule of lengths: the uncertainty of the test is that of the sphere's
diameter, and of its form, not of the robot (ISO/TS 23165).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pincal.acceptance.decided_errors import AcceptanceOutcome, decided, outcome_of_all
from pincal.errors import MeasurementError
from pincal.thresholds import Count, Scale

POINTS: Count = 25
"""Points that ISO 10360 asks for."""

# Points from which on a sphere has deviations from its form.
_FEWEST: Count = 5
_COVERAGE: Scale = 2.0
# Factor of the fitted to the calibrated radius, either way, beyond which something else was touched
# or a unit is wrong.
_OTHER: Scale = 2.0
_CLOSE: Scale = 1e-12
# Extent across a plane, relative to that in it, below which points lie in it.
_FLAT: Scale = 1e-3
_ROUNDS: Count = 50


@dataclass(frozen=True)
class KnownSphere:
    """A calibrated sphere, and what touches it.

    Attributes:
        diameter: by its certificate [m].
        sigma: standard uncertainty of diameter and form [m].
        probe: radius of the ball whose centre is the tool point [m]; 0 for a tip.
    """

    diameter: float
    sigma: float = 0.0
    probe: float = 0.0

    @property
    def reach(self) -> float:
        """Distance of the tool point from the centre in a contact [m]."""
        return 0.5 * self.diameter + self.probe


@dataclass(frozen=True, eq=False)
class ProbingErrors:
    """The errors of probing a sphere.

    Attributes:
        sphere: the sphere.
        size: P_Size [m].
        form: P_Form [m].
        stated: standard uncertainty of the size by the model [m].
        points: number of contacts.
        permitted_size: its MPE [m]; None if it is not tested.
        permitted_form: likewise.
    """

    sphere: KnownSphere
    size: float
    form: float
    stated: float
    points: int
    permitted_size: float | None
    permitted_form: float | None

    @property
    def outcome_of_size(self) -> AcceptanceOutcome | None:
        """Whether the size is permitted; None if it is not tested."""
        if self.permitted_size is None:
            return None
        return decided(self.size, self.permitted_size, self.sphere.sigma)

    @property
    def outcome_of_form(self) -> AcceptanceOutcome | None:
        """Whether the form is permitted; None if it is not tested."""
        if self.permitted_form is None:
            return None
        return decided(self.form, self.permitted_form, self.sphere.sigma)

    @property
    def outcome(self) -> AcceptanceOutcome:
        """Whether everything tested is permitted."""
        found = (self.outcome_of_size, self.outcome_of_form)
        return outcome_of_all([one for one in found if one is not None])

    @property
    def scope(self) -> str:
        """What the standard asks for beyond this test; empty if nothing."""
        if self.points >= POINTS:
            return ""
        return f"{self.points} contacts with the sphere where ISO 10360 asks for {POINTS}"

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of the result."""
        limits = {"size": self.permitted_size, "form": self.permitted_form}
        return {
            "diameter_mm": 1e3 * self.sphere.diameter,
            "points": self.points,
            "P_Size_mm": 1e3 * self.size,
            "P_Form_mm": 1e3 * self.form,
            "U_of_test_mm": 1e3 * _COVERAGE * self.sphere.sigma,
            "U_mm": 1e3 * _COVERAGE * self.stated,
            **{f"mpe_{k}_mm": 1e3 * mpe for k, mpe in limits.items() if mpe is not None},
            "outcome_of_size": self.outcome_of_size,
            "outcome_of_form": self.outcome_of_form,
        }


def probing(
    position: np.ndarray,
    covariance: np.ndarray,
    sphere: KnownSphere,
    *,
    size: float | None = None,
    form: float | None = None,
    source: str = "the contacts",
) -> ProbingErrors:
    """Return the errors of probing a sphere.

    Args:
        position: shape (N, 3), of the tool point in each contact by the model [m].
        covariance: shape (3N, 3N), of these [m^2].
        sphere: what was touched.
        size: MPE of P_Size [m]; None if it is not tested.
        form: MPE of P_Form [m]; likewise.
        source: name of the file, for messages.

    Raises:
        MeasurementError: for fewer than five contacts, or contacts that are not of such a sphere.

    Example:
        >>> n = np.vstack([np.eye(3), -np.eye(3)])
        >>> found = probing(0.0125 * n, np.zeros((18, 18)), KnownSphere(0.0249), size=2e-4)
        >>> round(1e3 * found.size, 6), round(1e3 * found.form, 6), found.outcome
        (0.1, 0.0, 'pass')
    """
    if len(position) < _FEWEST:
        raise MeasurementError(
            f"{source}: {len(position)} contacts with the sphere; expected {POINTS} over half of "
            f"it, or at least {_FEWEST}"
        )
    radius, distance, by_points = _least_squares(position, source)
    if not sphere.reach / _OTHER < radius < sphere.reach * _OTHER:
        raise MeasurementError(
            f"{source}: the contacts lie on a sphere of radius {1e3 * radius:.4g} mm; expected "
            f"{1e3 * sphere.reach:.4g} mm, half of --sphere-diameter plus --probe-radius: check "
            "their units, and that the rows are contacts with this sphere"
        )
    return ProbingErrors(
        sphere=sphere,
        size=2.0 * (radius - sphere.probe) - sphere.diameter,
        form=float(np.ptp(distance)),
        stated=2.0 * float(np.sqrt(max(by_points @ covariance @ by_points, 0.0))),
        points=len(position),
        permitted_size=size,
        permitted_form=form,
    )


def _least_squares(position: np.ndarray, source: str) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the radius of the least-squares sphere, the distances of the points from its centre,
    shape (N,), and the derivatives of the radius by the points, (3N,).
    """
    centre = _begun(position, source)
    for _ in range(_ROUNDS):
        away = position - centre
        distance = np.linalg.norm(away, axis=1)
        A = np.column_stack([away / distance[:, None], np.ones(len(away))])
        # A point's distance is the radius, to first order in the centre.
        step = np.linalg.lstsq(A, distance, rcond=None)[0]
        centre = centre + step[:3]
        if np.linalg.norm(step[:3]) < _CLOSE:
            break
    away = position - centre
    distance = np.linalg.norm(away, axis=1)
    normal = away / distance[:, None]
    A = np.column_stack([normal, np.ones(len(away))])
    weights = np.linalg.pinv(A)[3]
    return float(distance.mean()), distance, (weights[:, None] * normal).ravel()


def _begun(position: np.ndarray, source: str) -> np.ndarray:
    """Return the centre by the linear equations of a sphere, shape (3,) [m].

    Raises:
        MeasurementError: for points in a plane.
    """
    middle = position.mean(axis=0)
    about = position - middle
    A = np.column_stack([2.0 * about, np.ones(len(about))])
    scale = np.abs(about).max(initial=0.0)
    singular = np.linalg.svd(about, compute_uv=False)
    if not singular[2] > _FLAT * scale:
        raise MeasurementError(
            f"{source}: the contacts lie in a plane, through which many spheres go; expected "
            "points over half of the sphere"
        )
    return np.asarray(middle + np.linalg.lstsq(A, np.sum(about**2, axis=1), rcond=None)[0][:3])
