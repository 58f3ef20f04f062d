r"""Unmodelled effects: effects of the catalogue that a calibration's rows show and its model lacks.

A later diagnosis compares new rows with the size of these effects then, not with zero. They are
estimated to first order: with R the Jacobian of the fit by all its parameters and G the Jacobian by
an effect,

.. math:: \hat b = P^{-1} b, \quad P = G^T V^{-1} G, \quad b = G^T V^{-1} r, \quad
    V^{-1} = 1 - R (R^T R + D^{-2})^{-1} R^T,

the most significant effect first, then the others given it, as long as one is significant. The
parameters of the fit have absorbed :math:`K R^T G \hat b` of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import compress
from typing import Annotated

import numpy as np

from pincal.calibration.change_numbers import CHANGES
from pincal.calibration.station_information import fit_with, information_at, shared_places
from pincal.identify.fit import ModelFit
from pincal.identify.normal import accumulate
from pincal.identify.posterior import eliminate
from pincal.identify.quadratic import Form, Quadratic
from pincal.identify.selection import Scored, select_stepwise
from pincal.identify.station import Station
from pincal.io.arrays import ArrayShape, Numbers, Packed, Record, packed_covariance, packed_matrix
from pincal.io.entries import Effects
from pincal.model.catalogue.candidates import testable
from pincal.model.chain import Chain
from pincal.model.conditions import PoseSet, joined_conditions
from pincal.model.effect import Curve, Effect
from pincal.sensors.row_samples import evenly
from pincal.thresholds import Count, Scale

# Effects, rows and stations at most, which bound the work on large tables.
_MOST: Count = 8
_ROWS: Count = 2000
_STATIONS: Count = 20
# Fraction of a parameter's information that has to remain for it to be observable, and to exceed
# rounding.
_SEEN: Scale = 1e-4
_ROUNDING: Scale = 1e-8


class Unmodelled(Record, frozen=True):
    """Effects present in a calibration's rows but not in its model, for a diagnosis.

    Attributes:
        effects: the effects.
        parameter_names: names of their E parameters.
        values: shape (E,), their estimates from the rows [unit of each].
        covariance: shape (E, E), of the values.
        names: names of the K parameters of the robot.
        taken_up: shape (K, E), how much of a unit of each the calibration's parameters absorb.
    """

    effects: Effects
    parameter_names: Annotated[tuple[str, ...], ArrayShape("left")]
    values: Annotated[Numbers, ArrayShape("left")]
    covariance: Annotated[Packed, ArrayShape("left", "left", write=packed_covariance)]
    names: Annotated[tuple[str, ...], ArrayShape("robot")]
    taken_up: Annotated[Packed, ArrayShape("robot", "left", write=packed_matrix)]


def unmodelled_by(fit: ModelFit) -> Unmodelled | None:
    """Return the unmodelled effects of a fit; None where none is significant."""
    rows = _sample(fit)
    effects = _effects(fit, rows)
    if not effects:
        return None
    names = [tuple(p.name for p in effect.parameters(fit.problem.chain)) for effect in effects]
    ends = np.cumsum([0, *map(len, names)])
    places = [np.arange(*ends[i : i + 2]) for i in range(len(effects))]
    information, robot, carried = _information(fit, effects, rows)

    def chances(chosen: tuple[int, ...]) -> Iterator[Scored[int]]:
        # Other forms of a released effect have the same parameters.
        known = {name for i in chosen for name in names[i]}
        rest = information.released(_joined(places, chosen), _ROUNDING)
        for i in range(len(effects)):
            if known.isdisjoint(names[i]):
                chance = rest.chance(places[i], _SEEN)
                yield Scored(i, chance, chance < CHANGES.unmodelled / len(effects))

    chosen = select_stepwise(tuple[int, ...](), chances, lambda before, i: (*before, i), most=_MOST)
    if not chosen:
        return None
    at = _joined(places, chosen)
    values, covariance = information.estimate(at, _ROUNDING)
    found = tuple(information.names[i] for i in at)
    return Unmodelled(
        tuple(effects[i] for i in chosen), found, values, covariance, robot, carried[:, at]
    )


def instruments_error(fit: ModelFit) -> tuple[str, str, float] | None:
    """Return station, effect and p-value of the most significant systematic error of an instrument;
    None without any.

    It has to be relevant, too. Each effect is tested alone; of a bent circle or a tilt the robot
    may be the cause as well.
    """
    rows = _sample(fit)
    chain = fit.problem.chain
    of_each = [list(_misreadings(fit.problem.stations[k], chain, kept)) for k, kept in rows.items()]
    forms = [form for form in of_each[0] if all(form in others for others in of_each)]
    if not forms:
        return None
    found = []
    wide, known = fit_with(fit, forms, rows)
    for (station, places, blocks), of_rows in zip(wide.stations, wide.problem.rows, strict=True):
        free = wide.solution.free[places]
        values = wide.solution.values[places]
        solution = wide.solution
        form = accumulate(station, values, free, solution.weights[of_rows]).at(
            solution.sigma[blocks]
        )
        rest, _ = eliminate(
            form, known[places][free], wide.priors.sizes[places][free], values[free]
        )
        names = [
            wide.problem.parameters[place].local_name for place in places[free & ~known[places]]
        ]
        for effect in forms:
            at = np.array([names.index(p.local_name) for p in effect.parameters(chain)])
            if rest.gain(at, _SEEN)[0] > CHANGES.matters * len(station) * station.reading_size:
                found.append(
                    (station.name, effect.name, rest.chance(at, _SEEN) * len(forms) * len(rows))
                )
    surest = min(found, key=lambda one: one[2], default=None)
    return surest if surest is not None and surest[2] < CHANGES.unmodelled else None


def _misreadings(station: Station, chain: Chain, rows: np.ndarray) -> Iterator[Effect]:
    """Yield systematic errors of an instrument that some rows can show and the model lacks."""
    names = set(station.model.names)
    for candidate in testable(PoseSet(chain, station.conditions.select(rows))):
        for form in candidate.forms:
            own = {p.name for p in form.parameters(chain)}
            if form.is_sighted and form.scope == "station" and names.isdisjoint(own):
                names |= own
                yield form


def _joined(places: Sequence[np.ndarray], chosen: Iterable[int]) -> np.ndarray:
    return np.concatenate([np.zeros(0, int), *(places[i] for i in chosen)])


def _sample(fit: ModelFit) -> dict[int, np.ndarray]:
    """Return a sample of rows by the index of their station: some of some stations,
    evenly spread.
    """
    stations = fit.problem.stations
    chosen = evenly(len(stations), _STATIONS)
    most = _ROWS // len(chosen)
    return {int(k): evenly(len(stations[k]), most) for k in chosen}


def _effects(fit: ModelFit, rows: Mapping[int, np.ndarray]) -> list[Effect]:
    """Return the effects of single joints that these rows could show and the model does
    not have.
    """
    model = fit.problem.stations[0].model
    problem = fit.problem
    present = {effect.identity for effect in model.effects}
    names = set(model.names)
    conditions = joined_conditions(
        [problem.stations[k].conditions.select(some) for k, some in rows.items()]
    )
    found = (
        form
        for candidate in testable(PoseSet(problem.chain, conditions))
        for form in candidate.forms
    )
    return [
        effect
        for effect in found
        if not isinstance(effect, Curve)
        and effect.scope == "robot"
        and effect.locus.joint is not None
        and effect.identity not in present
        and names.isdisjoint(p.name for p in effect.parameters(problem.chain))
    ]


def _information(
    fit: ModelFit, effects: list[Effect], sample: Mapping[int, np.ndarray]
) -> tuple[Quadratic, tuple[str, ...], np.ndarray]:
    """Return the information of rows on the E parameters of effects, the parameters of stations and
    robot eliminated.

    Also the names of the K fitted parameters of the robot, and what they absorb of a unit of each
    effect's, shape (K, E).
    """
    wide, known = fit_with(fit, effects, sample)
    shared = shared_places(wide)
    n = len(shared)
    H = np.zeros((n, n))
    g = np.zeros(n)
    whole = np.zeros(n)
    for k in range(len(sample)):
        here = information_at(wide, k)
        H[np.ix_(here.places, here.places)] += here.form.H
        g[here.places] += here.form.g
        whole[here.places] += here.form.whole
    robot = known[shared]
    rest, taken = eliminate(
        Form(H, g, whole), robot, wide.priors.sizes[shared], wide.values[shared]
    )
    names = tuple(wide.problem.parameters[place].name for place in shared)
    return (
        Quadratic(**vars(rest), names=tuple(compress(names, ~robot)), square=0.0, degrees=0.0),
        tuple(compress(names, robot)),
        taken.carried,
    )
