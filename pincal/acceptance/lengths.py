r"""Acceptance of a calibrated robot by calibrated lengths, after ISO 10360-12 (articulated arms).

The tool point is held in the two ends of a calibrated length, as of a bar with two seats, in
several places of the working volume. With p_a, p_b the positions that the model gives for the
joints of a contact with either end, L the calibrated length,

.. math:: E_{Uni} = |p_a - p_b| - L .

A seat that was contacted with the arm in several articulations has the location error L_Dia: the
diameter of the smallest sphere that holds the positions found. An error conforms if it is below the
maximum permissible error (MPE) by a guard band, and does not if it is above by as much (ISO
14253-1): the guard band is the expanded uncertainty (k = 2) of the test, which is that of the
calibrated length, not of the robot (ISO/TS 23165).

The standard asks for 105 lengths, five of them three times in each of seven places, and for L_Dia
of five articulations with five contacts of a sphere each; a test with fewer says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pincal.acceptance.decided_errors import AcceptanceOutcome, decided, outcome_of_all
from pincal.acceptance.enclosing_sphere import smallest_sphere
from pincal.acceptance.probing import ProbingErrors
from pincal.errors import MeasurementError, few, warn
from pincal.features.decision import DecisionRule
from pincal.sensors.setup import KnownDistance
from pincal.thresholds import Count, Scale

ASKED: Count = 105
"""Lengths that ISO 10360 asks for."""

ARTICULATIONS: Count = 5
"""Articulations that ISO 10360-12 asks for at a seat."""

_COVERAGE: Scale = 2.0
# Ratio of calibrated and measured length, either way, beyond which a unit is wrong: mm and m are
# 1000 apart, and ends that were mistaken for one another rarely 100.
_OTHER_UNIT: Scale = 100.0


class Permitted(NamedTuple):
    """A maximum permissible error that grows with the length.

    Attributes:
        constant: [m].
        per_metre: [m/m].
    """

    constant: float
    per_metre: float

    def at(self, length: float) -> float:
        """Return it for a length [m]."""
        return self.constant + self.per_metre * length


@dataclass(frozen=True, eq=False)
class LengthErrors:
    """The errors of one calibrated length.

    Attributes:
        length: the ends and their calibrated distance.
        errors: shape (n,), of each pair of contacts [m].
        stated: shape (n,), standard uncertainty of the measured length by the model [m].
        permitted: the MPE [m].
    """

    length: KnownDistance
    errors: np.ndarray
    stated: np.ndarray
    permitted: float

    @property
    def worst(self) -> float:
        """The error of the largest size, with its sign [m]."""
        return float(self.errors[np.argmax(np.abs(self.errors))])

    @property
    def outcome(self) -> AcceptanceOutcome:
        """Whether all of them are permitted."""
        return decided(self.worst, self.permitted, self.length.sigma)

    @property
    def within_stated(self) -> int:
        """Number of errors within the expanded uncertainty (k = 2) that the model and the length
        have.
        """
        sigma = np.sqrt(self.stated**2 + self.length.sigma**2)
        return int(np.sum(np.abs(self.errors) <= _COVERAGE * sigma))

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of the result."""
        return {
            "first": self.length.first,
            "second": self.length.second,
            "length_mm": 1e3 * self.length.length,
            "errors_mm": (1e3 * self.errors).tolist(),
            "worst_mm": 1e3 * self.worst,
            "U_mm": 1e3 * _COVERAGE * float(np.sqrt(np.mean(self.stated**2))),
            "within_U": self.within_stated,
            "mpe_mm": 1e3 * self.permitted,
            "outcome": self.outcome,
        }


@dataclass(frozen=True)
class LocationError:
    """The location error of one seat.

    Attributes:
        seat: its name.
        contacts: number of articulations.
        diameter: L_Dia [m].
        permitted: the MPE [m].
    """

    seat: str
    contacts: int
    diameter: float
    permitted: float

    @property
    def outcome(self) -> AcceptanceOutcome:
        """Whether it is permitted; nothing but the robot's errors enters it."""
        return decided(self.diameter, self.permitted, 0.0)

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of the result."""
        return {
            "seat": self.seat,
            "contacts": self.contacts,
            "L_Dia_mm": 1e3 * self.diameter,
            "mpe_mm": 1e3 * self.permitted,
            "outcome": self.outcome,
        }


@dataclass(frozen=True)
class Acceptance:
    """The outcome of an acceptance test.

    Attributes:
        lengths: errors of each length.
        locations: of each seat with several contacts; empty without a limit for them.
        probing: of a sphere; None if none was touched.
    """

    lengths: tuple[LengthErrors, ...]
    locations: tuple[LocationError, ...] = ()
    probing: ProbingErrors | None = None

    @property
    def outcome(self) -> AcceptanceOutcome:
        """Whether everything is permitted."""
        found = [each.outcome for each in self.lengths]
        found += [each.outcome for each in self.locations]
        found += [] if self.probing is None else [self.probing.outcome]
        return outcome_of_all(found)

    @property
    def measured(self) -> int:
        """Number of lengths measured."""
        return sum(len(each.errors) for each in self.lengths)

    @property
    def scope(self) -> str:
        """What the standard asks for beyond this test; empty if nothing."""
        missing = []
        if self.measured < ASKED:
            missing.append(f"{self.measured} lengths where ISO 10360 asks for {ASKED}")
        if not self.locations:
            missing.append("no location error (--mpe-location)")
        elif min(each.contacts for each in self.locations) < ARTICULATIONS:
            missing.append(f"fewer than {ARTICULATIONS} articulations at some seat")
        if self.probing is None:
            missing.append("no probing of a sphere (--sphere)")
        elif self.probing.scope:
            missing.append(self.probing.scope)
        return "; ".join(missing)

    def to_dict(self) -> dict[str, Any]:
        """Return the result."""
        return {
            "standard": "ISO 10360-12",
            "rule": DecisionRule().words,
            "outcome": self.outcome,
            "measured": self.measured,
            "within_U": sum(each.within_stated for each in self.lengths),
            "lengths": [each.to_dict() for each in self.lengths],
            "locations": [each.to_dict() for each in self.locations],
            "probing": None if self.probing is None else self.probing.to_dict(),
            "scope": self.scope,
        }


@dataclass(frozen=True, eq=False)
class Contacts:
    """Contacts of the tool point with seats, in the order of measurement.

    Attributes:
        seat: shape (N,), names of the seats.
        position: shape (N, 3), positions of the tool point by the model [m].
        covariance: shape (N, 3, N, 3), of these [m^2].
        source: name of the file, for messages.
        noise: of one coordinate of a contact, as far as it is known [m].
    """

    seat: np.ndarray
    position: np.ndarray
    covariance: np.ndarray
    source: str = "the table"
    noise: float = 0.0

    def of(self, seat: str) -> np.ndarray:
        """Return the rows of a seat.

        Raises:
            MeasurementError: if it has none.
        """
        rows = np.flatnonzero(self.seat == seat)
        if not len(rows):
            known = few(np.unique(self.seat).tolist(), 8)
            raise MeasurementError(
                f"{self.source}: no row of socket {seat!r}, an end of a calibrated length; the "
                f"table has {known}: name the ends as in the column socket"
            )
        return rows

    def stated(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return the standard uncertainties of the distances between rows, shape (n,) [m]."""
        C = self.covariance
        way = self.position[a] - self.position[b]
        way = way / np.linalg.norm(way, axis=1)[:, None]
        spread = C[a, :, a] + C[b, :, b] - C[a, :, b] - C[b, :, a]
        variance = np.einsum("na,nab,nb->n", way, spread, way) + 2.0 * self.noise**2
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def acceptance(
    contacts: Contacts,
    lengths: Sequence[KnownDistance],
    permitted: Permitted,
    *,
    permitted_location: float | None = None,
) -> Acceptance:
    """Return the outcome of a test.

    Args:
        contacts: with the ends of the lengths; the k-th contact with one end and the k-th with the
            other are one measured length.
        lengths: calibrated.
        permitted: MPE of a length.
        permitted_location: MPE of L_Dia [m]; None if it is not tested.

    Raises:
        MeasurementError: if there is no length, one without contacts, one that occurs twice, or one
            in another unit.
    """
    _check_lengths(lengths)
    found = []
    for length in lengths:
        a = contacts.of(length.first)
        b = contacts.of(length.second)
        n = min(len(a), len(b))
        if len(a) != len(b):
            warn(
                f"{contacts.source}: {len(a)} contacts with {length.first}, {len(b)} with "
                f"{length.second}; the first {n} of each are paired in the order of the rows"
            )
        a = a[:n]
        b = b[:n]
        measured = np.linalg.norm(contacts.position[a] - contacts.position[b], axis=1)
        _check_unit(length, float(np.median(measured)))
        found.append(
            LengthErrors(
                length=length,
                errors=measured - length.length,
                stated=contacts.stated(a, b),
                permitted=permitted.at(length.length),
            )
        )
    return Acceptance(tuple(found), _locations(contacts, permitted_location))


def _check_lengths(lengths: Sequence[KnownDistance]) -> None:
    """Refuse no length at all, and two of the same ends, whose contacts would count twice."""
    if not lengths:
        raise MeasurementError("no calibrated length; expected at least one")
    seen = set[frozenset[str]]()
    for length in lengths:
        ends = frozenset((length.first, length.second))
        if ends in seen:
            raise MeasurementError(
                f"the length of {length.first} and {length.second} occurs twice; expected each "
                "pair of ends once"
            )
        seen.add(ends)


def _check_unit(length: KnownDistance, measured: float) -> None:
    """Refuse a calibrated length that is larger or smaller than its contacts by a unit."""
    if not measured / _OTHER_UNIT < length.length < measured * _OTHER_UNIT:
        raise MeasurementError(
            f"the length of {length.first} and {length.second} is {length.length:g} m, and the "
            f"contacts are {measured:g} m apart; expected lengths in m, or their unit in the "
            "header: distance [mm]"
        )


def _locations(contacts: Contacts, permitted: float | None) -> tuple[LocationError, ...]:
    if permitted is None:
        return ()
    found = []
    for seat in dict.fromkeys(contacts.seat.tolist()):
        rows = contacts.of(seat)
        if len(rows) > 1:
            diameter = 2.0 * smallest_sphere(contacts.position[rows]).radius
            found.append(LocationError(seat, len(rows), diameter, permitted))
    return tuple(found)
