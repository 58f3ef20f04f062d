"""What moved on a robot from station to station, told from a fit in which it is the same at all of them.

The parameter that explains most is released first, the others are asked for again beside it, until none is more than chance.
The curve of a drive is one of them. Where the model has no curves and they would explain more than log n for each of their
values, n readings, or some of them changed, everything is told beside curves that all stations share.
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

from pincal.calibration.station_information import (
    Apart,
    SharedInformation,
    StationsInformation,
    Together,
    difference,
    fit_with,
)
from pincal.identify.criteria import CHANGES
from pincal.identify.fit import ModelFit
from pincal.measure.extrinsics import sample_rows
from pincal.model.catalogue.candidates import testable
from pincal.model.conditions import PoseSet, joined_conditions, recorded_variable
from pincal.model.effect import Curve
from pincal.parameters import Parameter
from pincal.validate.outcome import MovedParameter

# Stations beyond which nothing is looked for: work and memory grow with their square.
_MOST_STATIONS = 100
# Rows and stations at most by which curves are looked for.
_ROWS, _STATIONS = 2000, 20
# Parts of a station's rows by which it is told how much a parameter differs by chance, at most, with so many rows each, and
# how much a curve does.
_MOST_PARTS, _ROWS_EACH, _PARTS = 8, 12, 2
# How far what is meant to be a constant may be off it.
_CONSTANT = 1e-6


def moves_of(fit: ModelFit) -> tuple[tuple[MovedParameter, ...], ...]:
    """Return, for each of several stations, those parameters of the robot that are not the same at all of them.

    The curve of a drive that the model does not have is one of them, named JOINT.curve: by how much it is another one, its
    mean apart, in the mean square over the rows of the station.
    """
    n = len(fit.problem.stations)
    own = [list(_of_station(fit, k)) for k in range(n)]
    if n > _MOST_STATIONS:
        return tuple(map(tuple, own))
    shared = SharedInformation.of(fit)
    if (curves := _with_curves(fit)) is not None:
        told, apart, chosen = curves.told, curves.apart, curves.moved
    else:
        same, singles = np.eye(len(shared.parameters)), [(p,) for p in range(len(shared.parameters))]
        told, apart = shared.together(same), None
        chosen = told.moved(singles)
        parts = min(_MOST_PARTS, min(map(len, fit.problem.stations)) // _ROWS_EACH)
        if chosen and parts > 1 and not any(station.sensor.is_whole for station in fit.problem.stations):
            apart = Apart.of(SharedInformation.of(fit, parts, in_order=True), same, parts)
            chosen = told.moved(singles, apart=apart)
    for group in chosen:
        shape = None if curves is None else curves.shapes.get(group)
        parameter = shared.parameters[group[0]] if shape is None else shape.parameter
        noise = 1.0 if apart is None else apart.noise([other for other in chosen if other != group], group)[0]
        for k, change, sigma, moved in _course(told, chosen, group, noise, shape):
            own[k].append(_entry(parameter, change, sigma, moved))
    return tuple(map(tuple, own))


@dataclass(frozen=True)
class _Shape:
    """The curve of a drive, its mean apart.

    Attributes:
        parameter: what it is called.
        T: shape (size, n), orthonormal; T times n values are the coefficients of the curve.
        at: shape (n, N_k) for each station, what these values make at its rows.
    """

    parameter: Parameter
    T: np.ndarray
    at: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, curve: Curve, fit: ModelFit) -> Self:
        """Return that of a curve at the rows of a fit."""
        chain, joint, span = fit.problem.chain, str(curve.locus.joint), curve.locus.span
        positions = [recorded_variable(chain, station.conditions, joint, span=span) for station in fit.problem.stations]
        bases = [curve.basis(x) for x in positions]
        basis = np.concatenate(bases, axis=1)
        constant, *_ = np.linalg.lstsq(basis.T, np.ones(basis.shape[1]))
        is_one = np.allclose(constant @ basis, 1.0, atol=_CONSTANT)
        T = null_space(constant[None]) if is_one else np.eye(len(basis))
        parameter = replace(curve.parameters(chain)[0], name=f"{joint}.curve")
        return cls(parameter, T, tuple(T.T @ basis for basis in bases))

    def size(self, k: int, values: np.ndarray, covariance: np.ndarray) -> tuple[float, float]:
        """Return a curve at a station, in the mean square over the rows that tell of it, and its standard deviation."""
        at = self.at[k]
        variance = np.einsum("in,ij,jn->n", at, covariance, at)
        told = variance < (CHANGES.curve_seen * self.parameter.size) ** 2
        at, variance = (at[:, told], variance[told]) if told.any() else (at, variance)
        height = values @ at
        size = np.sqrt(max(float(np.mean(height**2 - variance)), 1e-300))
        slope = at @ height / len(height) / size
        return float(size), float(np.sqrt(slope @ covariance @ slope))


@dataclass(frozen=True)
class _WithCurves:
    """What stations say of the parameters of a model and of curves of drives, which stand behind.

    Attributes:
        told: what they say.
        apart: what parts of each of them say.
        without: what they say if there are no curves.
        shapes: the curves, by the places of their values.
        price: log of the number of readings: what a parameter has to explain.
    """

    told: StationsInformation
    apart: Apart
    without: StationsInformation
    shapes: dict[Together, _Shape]
    price: float

    @classmethod
    def of(cls, fit: ModelFit, curves: Sequence[Curve], rows: dict[int, np.ndarray], parts: int = 1) -> Self:
        """Return what some rows, in so many parts of each station, say of some curves."""
        wide, _ = fit_with(fit, curves, rows)
        shared, shapes = SharedInformation.of(wide, parts), [_Shape.of(curve, wide) for curve in curves]
        place = {parameter.name: i for i, parameter in enumerate(shared.parameters)}
        spans = [[place[p.name] for p in curve.parameters(fit.problem.chain)] for curve in curves]
        base = np.delete(np.arange(len(place)), np.concatenate(spans))
        T = block_diag(np.eye(len(base)), *(shape.T for shape in shapes))[np.argsort(np.concatenate([base, *spans]))]
        ends = np.cumsum([len(base), *(shape.T.shape[1] for shape in shapes)]).tolist()
        groups = [tuple(range(*span)) for span in pairwise(ends)]
        readings = sum(len(station) * station.reading_size for station in wide.problem.stations)
        whole = shared.joined(parts)
        apart, without = Apart.of(shared, T, parts), whole.together(T[:, : len(base)])
        return cls(apart.joined, apart, without, dict(zip(groups, shapes, strict=True)), float(np.log(readings)))

    @cached_property
    def singles(self) -> list[Together]:
        """The parameters that are of no curve."""
        return [(p,) for p in range(self.told.G.shape[1] - sum(map(len, self.shapes)))]

    @cached_property
    def moved(self) -> tuple[Together, ...]:
        """What is not the same at all stations, beside curves that are."""
        return self.told.moved([*self.singles, *self.shapes], price=self.price, apart=self.apart)

    @property
    def cost(self) -> float:
        """What curves cost beyond what they explain: those of all stations, if that is less than nothing, and changes."""
        changed = [group for group in self.moved if group in self.shapes]
        others = [group for group in self.moved if group not in self.shapes]
        without = self.without.explained + self.without.gain(self.without.moved(self.singles))
        shared = self.price * sum(map(len, self.shapes)) - self.told.explained - self.told.gain(others) + without
        gain = self.told.gain(self.moved) - self.told.gain(others)
        return min(shared, 0.0) + self.price * sum(map(self.told.degrees, changed)) - gain


def _with_curves(fit: ModelFit) -> _WithCurves | None:
    """Return what stations say of a model and those curves of drives that it lacks, in the resolution that explains most.

    None if it lacks none, and where nobody looks: at IMUs, arms in motion, and many stations.
    """
    problem, stations = fit.problem, fit.problem.stations
    if not 1 < len(stations) <= _STATIONS or any(
        not station.sensor.reads_place or station.conditions.are_in_motion for station in stations
    ):
        return None
    rows = {k: sample_rows(len(station), _ROWS // len(stations)) for k, station in enumerate(stations)}
    some = [stations[k].conditions.select(kept) for k, kept in rows.items()]
    names, of_size = {p.name for p in problem.parameters}, dict[int, list[Curve]]()
    for candidate in testable(PoseSet(problem.chain, joined_conditions(some)), {"drive"}):
        for curve in candidate.forms:
            if not isinstance(curve, Curve) or curve.locus.joint != curve.locus.follows:
                continue
            is_new = names.isdisjoint(p.name for p in curve.parameters(problem.chain))
            if is_new and CHANGES.rows_each * curve.resolution <= min(map(len, some)):
                of_size.setdefault(curve.resolution, []).append(curve)
    # From coarse to fine, every other one.
    sizes = sorted(of_size)[::2]
    costs = [_WithCurves.of(fit, of_size[size], rows).cost for size in sizes]
    if not costs or min(costs) >= 0.0:
        return None
    found = _WithCurves.of(fit, of_size[sizes[int(np.argmin(costs))]], rows, _PARTS)
    return found if found.cost < 0.0 else None


def _course(
    told: StationsInformation, chosen: Sequence[Together], group: Together, noise: float, shape: _Shape | None
) -> Iterator[tuple[int, float, float, bool]]:
    """Yield station, change since the first, its standard deviation, and whether it came since the station before."""
    station, values, covariance = told.own_values(chosen, group)
    covariance = noise * covariance
    for k in station[:1]:
        yield int(k), 0.0, 0.0, False
    for i in range(1, len(station)):
        change, of_change = values[i] - values[0], difference(covariance, i, 0)
        step, of_step = values[i] - values[i - 1], difference(covariance, i, i - 1)
        moved = chdtrc(len(group), step @ np.linalg.solve(of_step, step)) < CHANGES.moved / (len(station) - 1)
        size, sigma = (change[0], np.sqrt(of_change[0, 0])) if shape is None else shape.size(station[i], change, of_change)
        yield int(station[i]), float(size), float(sigma), bool(moved)


def _of_station(fit: ModelFit, k: int) -> Iterator[MovedParameter]:
    """Yield what the model itself has of a joint at a station alone."""
    station, places = fit.problem.stations[k], fit.problem.places[k]
    model, sigma = station.model, fit.estimate.fitted_sigma
    for effect, span in zip(model.effects, model.spans, strict=True):
        if effect.locus.station is not None and effect.locus.joint is not None:
            for local in range(span.start, span.stop):
                place = places[local]
                yield _entry(model.parameters[local], float(fit.values[place]), float(sigma[place]), True)


def _entry(parameter: Parameter, change: float, sigma: float, moved: bool) -> MovedParameter:
    return {"name": parameter.name, "unit": parameter.unit, "change": change, "sigma": sigma, "moved": moved}
