r"""What a model left when it was calibrated: effects of the catalogue that its rows show and that it does not have.

A later diagnosis compares new rows with what these effects were then, not with nothing. They are found to first order: with
R the Jacobian of the fit by all its parameters and G that by an effect,

.. math:: \hat b = P^{-1} b, \quad P = G^T V^{-1} G, \quad b = G^T V^{-1} r, \quad V^{-1} = 1 - R (R^T R + D^{-2})^{-1} R^T,

the surest effect first, the others asked for again beside it, as long as one is beyond doubt. The parameters of the fit have
taken up :math:`K R^T G \hat b` of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from pincal.identify.fit import Fit
from pincal.identify.normal import accumulate
from pincal.identify.posterior import eliminate
from pincal.model.catalogue.candidates import testable
from pincal.model.conditions import Situation, joined
from pincal.model.effect import Curve, Effect

# Chance of one such effect, all candidates counted, beyond which none is taken for real.
_ALPHA = 1e-3
# Effects at most; rows and stations that are looked at, which bound the work on large tables.
_MOST, _ROWS, _STATIONS = 8, 2000, 20
# Part of a parameter's information that must be left for the rows to see it.
_SEEN = 1e-4


@dataclass(frozen=True)
class Left:
    """Effects that a model left, as its rows have them.

    Attributes:
        effects: the effects.
        values: shape (E,), of their parameters.
        parameter_names: of their E parameters.
        covariance: shape (E, E).
        names: the K parameters of the robot.
        taken_up: shape (K, E), what the calibration made of a unit of each.
    """

    effects: tuple[Effect, ...]
    parameter_names: tuple[str, ...]
    values: np.ndarray
    covariance: np.ndarray
    names: tuple[str, ...]
    taken_up: np.ndarray


def left_by(fit: Fit) -> Left | None:
    """Return what a fit left; None where nothing is beyond doubt."""
    rows = _sample(fit)
    effects = _effects(fit, rows)
    said = _said(fit, effects, rows) if effects else None
    if said is None:
        return None
    chosen: list[int] = []
    while len(chosen) < _MOST:
        rest = said.without(chosen)
        free = [i for i in range(len(effects)) if i not in chosen and said.fits(i, chosen)]
        chances = [rest.chance(i) for i in free]
        if not chances or min(chances) >= _ALPHA / len(effects):
            break
        chosen.append(free[int(np.argmin(chances))])
    if not chosen:
        return None
    at = said.places(chosen)
    inverse = np.linalg.pinv(said.P[np.ix_(at, at)], rcond=_SEEN**2, hermitian=True)
    names = tuple(name for i in chosen for name in said.parameters[i])
    return Left(tuple(effects[i] for i in chosen), names, inverse @ said.b[at], inverse, said.robot, said.carried[:, at])


@dataclass(frozen=True)
class _Said:
    """What all rows say of candidates with G parameters beside a fit.

    Attributes:
        parameters: names of the parameters of each candidate.
        robot: names of the K parameters of the robot that were fitted.
        P: shape (G, G).
        b: shape (G,).
        whole: shape (G,), the diagonal of their information with nothing projected out.
        carried: shape (K, G), what the robot's parameters take up of a unit of each.
    """

    parameters: tuple[tuple[str, ...], ...]
    robot: tuple[str, ...]
    P: np.ndarray
    b: np.ndarray
    whole: np.ndarray
    carried: np.ndarray

    def places(self, candidates: list[int]) -> np.ndarray:
        """Return where the parameters of some candidates stand."""
        ends = np.cumsum([0, *map(len, self.parameters)])
        return np.concatenate([np.zeros(0, int), *(np.arange(ends[i], ends[i + 1]) for i in candidates)])

    def without(self, candidates: list[int]) -> _Said:
        """Return what is left once some candidates are released."""
        at = self.places(candidates)
        inverse = np.linalg.pinv(self.P[np.ix_(at, at)], rcond=_SEEN**2, hermitian=True)
        return replace(
            self, P=self.P - self.P[:, at] @ inverse @ self.P[at], b=self.b - self.P[:, at] @ inverse @ self.b[at]
        )

    def fits(self, i: int, chosen: list[int]) -> bool:
        """Return whether a candidate has no parameter that was chosen already with another."""
        return not set(self.parameters[i]) & {name for k in chosen for name in self.parameters[k]}

    def chance(self, i: int) -> float:
        """Return the chance of as large a gain by a candidate that is not there."""
        at = self.places([i])
        scale = np.maximum(self.whole[at], 1e-300) ** -0.5
        values, vectors = np.linalg.eigh(self.P[np.ix_(at, at)] * np.outer(scale, scale))
        seen = values > _SEEN
        along = vectors[:, seen].T @ (scale * self.b[at]) / np.sqrt(values[seen])
        return float(chdtrc(seen.sum(), along @ along)) if seen.any() else 1.0


def _sample(fit: Fit) -> dict[int, np.ndarray]:
    """Return which rows are looked at, by the place of their station: some of some stations, evenly spread."""
    stations = fit.problem.stations
    chosen = np.unique(np.linspace(0, len(stations) - 1, min(len(stations), _STATIONS)).astype(int))
    most = _ROWS // len(chosen)
    return {int(k): np.unique(np.linspace(0, len(stations[k]) - 1, min(len(stations[k]), most)).astype(int)) for k in chosen}


def _effects(fit: Fit, rows: Mapping[int, np.ndarray]) -> list[Effect]:
    """Return the effects of single joints that these rows could show and the model does not have."""
    model, problem = fit.problem.stations[0].model, fit.problem
    present, names = {effect.identity for effect in model.effects}, set(model.names)
    conditions = joined([problem.stations[k].conditions.select(some) for k, some in rows.items()])
    found = (form for candidate in testable(Situation(problem.chain, conditions)) for form in candidate.forms)
    return [
        effect
        for effect in found
        if not isinstance(effect, Curve)
        and effect.scope == "robot"
        and effect.locus.joint is not None
        and effect.identity not in present
        and names.isdisjoint(p.name for p in effect.parameters(problem.chain))
    ]


def _said(fit: Fit, effects: list[Effect], sample: Mapping[int, np.ndarray]) -> _Said:
    """Return what rows of stations say of some effects, the stations' own parameters and the robot's projected out."""
    problem, solution = fit.problem, fit.solution
    robot = np.flatnonzero(solution.free & problem.is_shared) if len(problem.stations) > 1 else _robots(fit)
    names = [tuple(p.name for p in effect.parameters(problem.chain)) for effect in effects]
    n = sum(map(len, names))
    G, g, whole = np.zeros((len(robot) + n,) * 2), np.zeros(len(robot) + n), np.zeros(n)
    for k, rows in sample.items():
        station, places, blocks = problem.stations[k], problem.places[k], problem.block_spans[k]
        model = station.model
        wide = station.select(rows).with_model(model.with_effects([*model.effects, *effects]))
        of_model, of_sensor = station.split(solution.values[places])
        values = np.concatenate([of_model, np.zeros(n), of_sensor])
        model_free, sensor_free = station.split(solution.free[places])
        free = np.concatenate([model_free, np.ones(n, bool), sensor_free])
        normal = accumulate(wide, values, free, solution.weights[problem.rows[k]][rows])
        H, h = normal.at(solution.sigma[blocks])
        index = np.concatenate([places[: len(of_model)], np.full(n, -1), places[len(of_model) :]])[free]
        # Zero and more: places among the robot's parameters; then the candidates; -1: the station's own.
        target = np.where(np.isin(index, robot), np.searchsorted(robot, index), -1)
        target[int(model_free.sum()) : int(model_free.sum()) + n] = len(robot) + np.arange(n)
        sizes = np.concatenate(
            [fit.priors.sizes[places][: len(of_model)], np.full(n, np.inf), fit.priors.sizes[places][len(of_model) :]]
        )
        left = eliminate(H, h, target < 0, sizes[free], values[free])
        at = target[target >= 0]
        G[np.ix_(at, at)] += left.G
        g[at] += left.g
        whole[at[at >= len(robot)] - len(robot)] += np.diag(H)[target >= len(robot)]
    is_robot = np.arange(len(G)) < len(robot)
    sizes = np.append(fit.priors.sizes[robot], np.full(n, np.inf))
    rest = eliminate(G, g, is_robot, sizes, np.append(fit.values[robot], np.zeros(n)))
    found = tuple(problem.parameters[place].name for place in robot)
    return _Said(tuple(names), found, rest.G, rest.g, whole, rest.carried)


def _robots(fit: Fit) -> np.ndarray:
    """Return the places of the robot's own parameters that were fitted, of a fit of one station."""
    return np.flatnonzero(fit.solution.free & ~fit.problem.station.is_own)
