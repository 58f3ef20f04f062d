"""Parameters of a robot that moved between stations, found from a fit in which all stations share
them.

The parameter that explains most is released first, then the others are tested given it, until none
is significant. The curve of a drive counts as one. Where the model lacks curves, and these would
explain more than log n per coefficient, n readings, or some of them changed, everything is tested
given curves shared by all stations.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Self

import numpy as np
from scipy.linalg import block_diag, null_space
from scipy.special import chdtrc

from pincal.calibration.change_numbers import CHANGES
from pincal.calibration.station_information import (
    Apart,
    SharedInformation,
    StationsInformation,
    Together,
    difference,
    fit_with,
)
from pincal.identify.fit import ModelFit
from pincal.model.catalogue.candidates import testable
from pincal.model.conditions import PoseSet, joined_conditions, recorded_variable
from pincal.model.effect import Curve
from pincal.parameters import Parameter
from pincal.sensors.row_samples import sample_rows
from pincal.thresholds import Count, Scale
from pincal.validate.outcome import MovedParameter

# Stations at most: work and memory grow with their square.
_MOST_STATIONS: Count = 100
# Rows and stations at most in a search for curves.
_ROWS: Count = 2000
_STATIONS: Count = 20
# Parts of a station's rows between which a parameter differs by chance, at most, with the fewest
# rows of each; for curves.
_MOST_PARTS: Count = 8
_ROWS_EACH: Count = 12
_PARTS: Count = 2
# Numbers of the information of all parts at most (0.4 GB), if two parts do.
_MOST_NUMBERS: Count = 50_000_000
# Tolerance on a constant function.
_CONSTANT: Scale = 1e-6


def moves_of(fit: ModelFit) -> tuple[tuple[MovedParameter, ...], ...]:
    """Return, for each of several stations, the parameters of the robot that differ between
    stations.

    The curve of a drive that the model lacks is one of them, named JOINT.curve; its change is the
    rms over the station's rows, without its mean.
    """
    n = len(fit.problem.stations)
    own = [list(_of_station(fit, k)) for k in range(n)]
    if n > _MOST_STATIONS:
        return tuple(map(tuple, own))
    shared = SharedInformation.of(fit)
    curves = _with_curves(fit)
    found = _moved_alone(fit, shared) if curves is None else curves.found
    for group in found.chosen:
        shape = found.shapes.get(group)
        parameter = shared.parameters[group[0]] if shape is None else shape.parameter
        for k, change, sigma, moved in _course(found, group):
            own[k].append(_entry(parameter, change, sigma, moved))
    return tuple(map(tuple, own))


@dataclass(frozen=True)
class _Moved:
    """Groups of parameters that differ between stations.

    Attributes:
        information: of the stations.
        chosen: the groups, by the indices of their parameters.
        apart: the information of parts of each station; None where they do not differ by chance.
        shapes: of groups that are the curve of a drive.
    """

    information: StationsInformation
    chosen: tuple[Together, ...]
    apart: Apart | None
    shapes: dict[Together, _Shape]

    def noise(self, group: Together) -> float:
        """Return the factor on the variance of a group by differences between parts of stations."""
        if self.apart is None:
            return 1.0
        return self.apart.noise([other for other in self.chosen if other != group], group)[0]


def _moved_alone(fit: ModelFit, shared: SharedInformation) -> _Moved:
    """Return the single parameters that differ between stations, without any curve that the model
    lacks.
    """
    singles = [(p,) for p in range(len(shared.parameters))]
    information = shared.together
    chosen = information.moved(singles)
    stations = fit.problem.stations
    parts = min(_MOST_PARTS, min(map(len, stations)) // _ROWS_EACH)
    parts = min(parts, max(_MOST_NUMBERS // shared.G.size, _PARTS))
    is_whole = any(station.sensor.is_whole for station in stations)
    if not chosen or parts <= 1 or is_whole:
        return _Moved(information, chosen, None, {})
    apart = Apart.of(SharedInformation.of(fit, parts, in_order=True), parts)
    return _Moved(information, information.moved(singles, apart=apart), apart, {})


@dataclass(frozen=True)
class _Shape:
    """The curve of a drive without its mean.

    Attributes:
        parameter: its name and unit.
        T: shape (size, n), orthonormal; T times n values are the coefficients of the curve.
        at: shape (n, N_k) for each station, the curves of unit values at its rows.
    """

    parameter: Parameter
    T: np.ndarray
    at: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, curve: Curve, fit: ModelFit) -> Self:
        """Return the shape of a curve at the rows of a fit."""
        chain = fit.problem.chain
        joint = str(curve.locus.joint)
        span = curve.locus.span
        positions = [
            recorded_variable(chain, station.conditions, joint, span=span)
            for station in fit.problem.stations
        ]
        bases = [curve.basis(x) for x in positions]
        basis = np.concatenate(bases, axis=1)
        constant, *_ = np.linalg.lstsq(basis.T, np.ones(basis.shape[1]))
        is_one = np.allclose(constant @ basis, 1.0, atol=_CONSTANT)
        T = null_space(constant[None]) if is_one else np.eye(len(basis))
        parameter = replace(curve.parameters(chain)[0], name=f"{joint}.curve")
        return cls(parameter, T, tuple(T.T @ basis for basis in bases))

    def size(self, k: int, values: np.ndarray, covariance: np.ndarray) -> tuple[float, float]:
        """Return the rms of a curve over the rows of a station that determine it, and its standard
        deviation.
        """
        at = self.at[k]
        variance = np.einsum("in,ij,jn->n", at, covariance, at)
        seen = variance < (CHANGES.curve_seen * self.parameter.size) ** 2
        if seen.any():
            at = at[:, seen]
            variance = variance[seen]
        height = values @ at
        size = np.sqrt(max(float(np.mean(height**2 - variance)), 1e-300))
        slope = at @ height / len(height) / size
        return float(size), float(np.sqrt(slope @ covariance @ slope))


@dataclass(frozen=True)
class _WithCurves:
    """Information of stations on the parameters of a model, followed by curves of drives.

    Attributes:
        information: of the stations.
        apart: the same, and of parts of each of them.
        without: the same without curves.
        shapes: the curves, by the indices of their values.
        price: log of the number of readings, which a parameter has to explain.
    """

    information: StationsInformation
    apart: Apart
    without: StationsInformation
    shapes: dict[Together, _Shape]
    price: float

    @classmethod
    def of(
        cls, fit: ModelFit, curves: Sequence[Curve], rows: dict[int, np.ndarray], parts: int = 1
    ) -> Self:
        """Return the information of some rows, in so many parts of each station, with
        some curves.
        """
        wide, _ = fit_with(fit, curves, rows)
        shared = SharedInformation.of(wide, parts)
        shapes = [_Shape.of(curve, wide) for curve in curves]
        place = {parameter.name: i for i, parameter in enumerate(shared.parameters)}
        spans = [[place[p.name] for p in curve.parameters(fit.problem.chain)] for curve in curves]
        base = np.delete(np.arange(len(place)), np.concatenate(spans))
        T = block_diag(np.eye(len(base)), *(shape.T for shape in shapes))[
            np.argsort(np.concatenate([base, *spans]))
        ]
        ends = np.cumsum([len(base), *(shape.T.shape[1] for shape in shapes)]).tolist()
        groups = [tuple(range(*span)) for span in pairwise(ends)]
        readings = sum(len(station) * station.reading_size for station in wide.problem.stations)
        apart = Apart.of(shared.in_shapes(T), parts)
        without = shared.joined(parts).in_shapes(T[:, : len(base)]).together
        return cls(
            apart.joined,
            apart,
            without,
            dict(zip(groups, shapes, strict=True)),
            float(np.log(readings)),
        )

    @cached_property
    def singles(self) -> list[Together]:
        """The parameters that belong to no curve."""
        return [(p,) for p in range(self.information.G.shape[1] - sum(map(len, self.shapes)))]

    @cached_property
    def moved(self) -> tuple[Together, ...]:
        """The groups that differ between stations, given shared curves."""
        return self.information.moved(
            [*self.singles, *self.shapes], price=self.price, apart=self.apart
        )

    @property
    def found(self) -> _Moved:
        """What differs between stations, given these curves."""
        return _Moved(self.information, self.moved, self.apart, self.shapes)

    @property
    def cost(self) -> float:
        """Cost of curves less what they explain: of the shared ones, if negative, and
        of changes.
        """
        found = self.information
        changed = [group for group in self.moved if group in self.shapes]
        others = [group for group in self.moved if group not in self.shapes]
        without = self.without.explained + self.without.gain(self.without.moved(self.singles))
        shared = (
            self.price * sum(map(len, self.shapes)) - found.explained - found.gain(others) + without
        )
        gain = found.gain(self.moved) - found.gain(others)
        return min(shared, 0.0) + self.price * sum(map(found.degrees, changed)) - gain


def _with_curves(fit: ModelFit) -> _WithCurves | None:
    """Return the information of stations with the drive curves that a model lacks, in the
    resolution that explains most.

    None if it lacks none, and of IMUs, arms in motion, and many stations.
    """
    problem = fit.problem
    stations = fit.problem.stations
    if not 1 < len(stations) <= _STATIONS or any(
        not station.sensor.reads_place or station.conditions.are_in_motion for station in stations
    ):
        return None
    rows = {
        k: sample_rows(len(station), _ROWS // len(stations)) for k, station in enumerate(stations)
    }
    some = [stations[k].conditions.select(kept) for k, kept in rows.items()]
    names = {p.name for p in problem.parameters}
    of_size = dict[int, list[Curve]]()
    for candidate in testable(PoseSet(problem.chain, joined_conditions(some)), {"drive"}):
        for curve in candidate.forms:
            if not isinstance(curve, Curve) or curve.locus.joint != curve.locus.follows:
                continue
            is_new = names.isdisjoint(p.name for p in curve.parameters(problem.chain))
            if is_new and CHANGES.rows_each * curve.resolution <= min(map(len, some)):
                of_size.setdefault(curve.resolution, []).append(curve)
    # Every other resolution, from coarse to fine.
    sizes = sorted(of_size)[::2]
    costs = [_WithCurves.of(fit, of_size[size], rows).cost for size in sizes]
    if not costs or min(costs) >= 0.0:
        return None
    found = _WithCurves.of(fit, of_size[sizes[int(np.argmin(costs))]], rows, _PARTS)
    return found if found.cost < 0.0 else None


def _course(found: _Moved, group: Together) -> Iterator[tuple[int, float, float, bool]]:
    """Yield station, change since the first, its standard deviation, and whether it moved since the
    previous station.
    """
    station, values, covariance = found.information.own_values(found.chosen, group)
    covariance = found.noise(group) * covariance
    shape = found.shapes.get(group)
    for k in station[:1]:
        yield int(k), 0.0, 0.0, False
    for i in range(1, len(station)):
        change = values[i] - values[0]
        of_change = difference(covariance, i, 0)
        step = values[i] - values[i - 1]
        of_step = difference(covariance, i, i - 1)
        moved = chdtrc(len(group), step @ np.linalg.solve(of_step, step)) < CHANGES.moved / (
            len(station) - 1
        )
        size, sigma = (
            (change[0], np.sqrt(of_change[0, 0]))
            if shape is None
            else shape.size(station[i], change, of_change)
        )
        yield int(station[i]), float(size), float(sigma), bool(moved)


def _of_station(fit: ModelFit, k: int) -> Iterator[MovedParameter]:
    """Yield the model's own effects of joints at a single station."""
    station = fit.problem.stations[k]
    places = fit.problem.places[k]
    model = station.model
    sigma = fit.estimate.fitted_sigma
    for effect, span in zip(model.effects, model.spans, strict=True):
        if effect.locus.station is not None and effect.locus.joint is not None:
            for local in range(span.start, span.stop):
                place = places[local]
                yield _entry(
                    model.parameters[local], float(fit.values[place]), float(sigma[place]), True
                )


def _entry(parameter: Parameter, change: float, sigma: float, moved: bool) -> MovedParameter:
    return {
        "name": parameter.name,
        "unit": parameter.unit,
        "change": change,
        "sigma": sigma,
        "moved": moved,
    }
