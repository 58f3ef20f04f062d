"""Whether readings contradict a distance between two points that was given, such as of sockets.

A given distance is held to some micrometres and sets the scale of the whole arm, so a wrong one
leaves residuals everywhere, or none that stand out and an arm that is too long. With a distance of
length l and standard deviation s left out, the readings and what is known of the arm's lengths say
another one, l', with a standard deviation s': both agree within the root of s^2 + s'^2. The fit
with it tells to first order whether that is worth another fit: of its residual r and the variance v
of the length, T = (r / s)^2 / (1 - v / s^2) is chi-square with one degree of freedom.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from pincal.identify.calibrate import fit_tables
from pincal.identify.fit import ModelFit
from pincal.identify.options import Options
from pincal.identify.station import Station
from pincal.measure.measurements import Measurements
from pincal.sensors.point_sensor import PointSensor
from pincal.sensors.setup import KnownDistance, Setup
from pincal.thresholds import Scale
from pincal.units import readable_unit, show_measured
from pincal.validate.agreement_numbers import AGREEMENT
from pincal.validate.rough_fit import UNFIT

# Least share of a distance's variance that is not known beside it: below, rounding.
_LEAST: Scale = 1e-9


@dataclass(frozen=True)
class Contradiction:
    """A given distance that readings contradict.

    Attributes:
        given: the distance as it was given.
        found: what the readings and the arm's lengths say without it [m].
        sigma: its standard deviation [m].
    """

    given: KnownDistance
    found: float
    sigma: float

    @property
    def chance(self) -> float:
        """How likely a right distance is so far off."""
        square = (self.given.length - self.found) ** 2
        return float(chdtrc(1.0, square / (self.sigma**2 + self.given.sigma**2)))

    @property
    def figures(self) -> dict[str, str]:
        """What was given and what was found, in words."""
        unit = readable_unit("m")
        return {
            "points": f"{self.given.first} and {self.given.second}",
            "given": f"{self.given.length * unit.factor:.7g} {unit.name}",
            "found": f"{show_measured(self.found, self.sigma, unit)} {unit.name} (95 %)",
        }


def contradicted_lengths(
    fit: ModelFit, tables: Mapping[str, Measurements]
) -> Iterator[Contradiction]:
    """Yield, for each station, the given distance that its readings contradict most, if any.

    Args:
        fit: of all stations.
        tables: the fitted rows of each station.
    """
    for k, (station, places, _) in enumerate(fit.stations):
        suspect = _suspect(fit, station, places)
        if suspect is None:
            continue
        found = _without(fit, k, suspect, tables)
        if found is not None and found.chance < AGREEMENT.given_length:
            yield found


def _suspect(fit: ModelFit, station: Station, places: np.ndarray) -> KnownDistance | None:
    """Return the given distance that the readings of a station contradict most to first order; None
    if there is none.

    Args:
        fit: of all stations.
        station: one of them.
        places: indices of its parameters in those of the fit.
    """
    sensor = station.sensor
    if not isinstance(sensor, PointSensor):
        return None
    facts = sensor.facts(station.split(fit.values[places])[1])
    if facts is None:
        return None
    own = station.split(places)[1]
    covariance = fit.estimate.dense_covariance()[np.ix_(own, own)]
    variance = np.sum(facts.jacobian * (covariance @ facts.jacobian), axis=0)
    rest = np.maximum(1.0 - variance / facts.sigma**2, _LEAST)
    chance = chdtrc(1.0, (facts.residuals / facts.sigma) ** 2 / rest)
    worst = int(np.argmin(chance))
    return sensor.points.distances[worst] if chance[worst] < AGREEMENT.given_length else None


def _without(
    fit: ModelFit, k: int, given: KnownDistance, tables: Mapping[str, Measurements]
) -> Contradiction | None:
    """Return what a fit without a given distance says of it; None if that fit fails.

    Args:
        fit: with the distance.
        k: index of the station whose points they are.
        given: the distance.
        tables: the fitted rows of each station.
    """
    robot = fit.problem.chain.robot
    with suppress(*UNFIT):
        free = fit_tables(robot, tables, _options_without(fit.options, given))
        station = free.problem.stations[k]
        places = free.problem.places[k]
        assert isinstance(station.sensor, PointSensor)
        points = replace(station.sensor.points, distances=(given,))
        facts = replace(station.sensor, points=points).facts(station.split(free.values[places])[1])
        assert facts is not None
        own = station.split(places)[1]
        along = facts.jacobian[:, 0]
        variance = along @ free.estimate.dense_covariance()[np.ix_(own, own)] @ along
        return Contradiction(given, given.length - facts.residuals[0], float(np.sqrt(variance)))
    return None


def _options_without(options: Options, given: KnownDistance) -> Options:
    """Return options without a given distance."""

    def left(setup: Setup) -> Setup:
        return replace(setup, distances=tuple(d for d in setup.distances if d != given))

    stations = {
        name: own if own.setup is None else replace(own, setup=left(own.setup))
        for name, own in options.stations.items()
    }
    return replace(options, setup=left(options.setup), stations=stations)
