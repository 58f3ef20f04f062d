r"""The information of a measurement at any pose on the parameters, before it is made.

A design works on the Jacobian of a :class:`~pincal.identify.problem.Problem`, whatever the sensor is. It is taken at the
nominal arm, in units of the noise and of the priors that a fit has (by physical group, see
:func:`pincal.identify.calibrate.priors_of`), so that the information of the priors is the identity. Base and tool, which a
fit leaves without a prior, get one so wide that it carries no information: it keeps the covariance finite for few poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pincal.design.exchange import covariance, total
from pincal.design.reach import SensorSetup
from pincal.errors import BadInputError
from pincal.identify.beliefs import declared_noise, is_frame, priors_of
from pincal.identify.believed import Earlier
from pincal.identify.options import Options
from pincal.identify.posterior import Posterior
from pincal.identify.problem import Problem
from pincal.identify.quadratic import Form
from pincal.identify.station import Station
from pincal.measure.point_sensor import PointSensor
from pincal.measure.registry import simulatable
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect
from pincal.model.effects import BaseFrame, ToolFrame
from pincal.model.model import Model
from pincal.model.sizes import largest_basis
from pincal.robot.robot import Robot

# Noise below which the arithmetic of a design has no digits left [m, rad].
_LEAST_NOISE = 1e-7
# Width of what stands for no prior, in units of the noise: 1 m for 0.05 mm.
_WIDE = 2e4
# Width of the prior of an effect that is to be distinguished from another, in sizes that are typical of it.
RIVAL = 10.0


@dataclass(frozen=True)
class DesignModel:
    """The parameters of a fit, and how readings at any pose depend on them.

    Attributes:
        model: base, tool and all effects.
        values: shape (P,), where it is linearised: the nominal arm, the target about where it sits.
        free: shape (P,), the F parameters that these poses excite at all.
        sizes: shape (F,), standard deviations of the priors; inf for base and tool.
        sigma: shape (blocks,), noise of one component of each block of readings [m, rad].
        rig: with what and from where poses are measured.
        rivals: for each of the effects to be distinguished, its places among the F parameters.
        core: shape (F,), the parameters of the model as it is fitted, without rivals that were added to it.
        known: shape (F, F), information in units of the priors: theirs, and that of ``Options.earlier``.
    """

    model: Model
    values: np.ndarray
    free: np.ndarray
    sizes: np.ndarray
    sigma: np.ndarray
    rig: SensorSetup
    rivals: tuple[np.ndarray, ...]
    core: np.ndarray
    known: np.ndarray

    @classmethod
    def of(
        cls,
        robot: Robot,
        conditions: Conditions,
        options: Options,
        rig: SensorSetup,
        *,
        rivals: Sequence[Effect] = (),
        targets: tuple[str, ...] = ("tool",),
    ) -> DesignModel:
        """Return the model of a design for poses like these.

        Args:
            robot: the arm.
            conditions: N poses, by which priors are scaled as a fit scales them by its rows.
            options: as for the calibration; default of ``sigma``: that of a good laser tracker.
            rig: with what and from where poses are measured.
            rivals: effects in addition to the model that are to be distinguished.
            targets: names of the targets; all sit where the rig has its target.

        Raises:
            BadInputError: for a sensor that is not known or lacks the place of its instrument, noise that no
                instrument has, or a rival that does nothing in these poses.
        """
        check_rig(rig)
        chain = Chain.of(robot, moment_frame=options.first_frame, gravity=options.gravity, targets=targets)
        model = Model(chain, (*frame_effects(chain, rig, conditions), *options.effects), equilibrium=options.equilibrium)
        n_core = model.n_parameters
        for rival in rivals:
            if any(parameter.name not in model.names for parameter in rival.parameters(chain)):
                model = model.with_effects([*model.effects, rival])
        values = nominal_values(model, rig, rig.target(robot))
        problem = predicted_station(model, values, rig, conditions)
        free = np.append(largest_basis(model, conditions)[1], ~problem.sensor.fixed)
        whole = Problem((problem,), None if options.earlier is None else Earlier.of(options.earlier))
        whole_sizes = np.where(is_frame(whole), np.inf, priors_of(whole, options).sizes)
        sizes = whole_sizes[free]
        places = _places(model, free, rivals)
        for columns in places:
            sizes[columns] *= RIVAL
        core = ((place := np.flatnonzero(free)) < n_core) | (place >= model.n_parameters)
        found = cls(model, values, free, sizes, _sigma(problem, options), rig, places, core, np.eye(len(sizes)))
        if options.earlier is None:
            return found
        beyond = whole.beliefs.beyond_priors(np.flatnonzero(free), np.zeros(len(free)), whole_sizes)
        return replace(found, known=found.known + beyond.H * np.outer(found.units, found.units))

    @cached_property
    def units(self) -> np.ndarray:
        """What one unit of each parameter is in a design, shape (F,)."""
        return np.where(np.isfinite(self.sizes), self.sizes, _WIDE * self.sigma[0])

    @property
    def n_free(self) -> int:
        """Number F of parameters."""
        return len(self.sizes)

    @property
    def quantity(self) -> str:
        """What :meth:`errors` are errors of: "position" or "distance"."""
        return simulatable()[self.rig.sensor].blocks[0].name

    @property
    def names(self) -> tuple[str, ...]:
        """Names of those of the F parameters that are the model's, which come first."""
        return tuple(np.array(self.model.names)[self.model.own(self.free)])

    @property
    def has_prior(self) -> np.ndarray:
        """Which of the F parameters have a prior, shape (F,): the arm's, and not base and tool."""
        return np.asarray(np.isfinite(self.sizes))

    @property
    def own_names(self) -> tuple[str, ...]:
        """Names of those that have one."""
        return tuple(np.array(self.names)[self.has_prior[: len(self.names)]])

    def readings(self, conditions: Conditions) -> np.ndarray:
        """Return the derivative of the readings by the parameters in units of noise and priors, shape (N, m, F)."""
        problem = predicted_station(self.model, self.values, self.rig, conditions)
        noise = np.repeat(self.sigma, problem.block_sizes)
        return np.ascontiguousarray(self._jacobian(problem) * (self.units / noise[:, None]))

    def errors(self, conditions: Conditions) -> np.ndarray:
        """Return how the predicted position (or distance) depends on the parameters in units of priors, shape (N, k, F) [m].

        It is what the error on rows held out is taken of: the first readings that are lengths, in the instrument's frame.
        """
        problem = predicted_station(self.model, self.values, self.rig, conditions)
        return np.asarray(self._jacobian(problem)[:, : problem.sensor.blocks[0].size] * self.units)

    def placed_errors(self, conditions: Conditions) -> np.ndarray:
        """Return the same of the H parameters that have a prior, shape (k N, H) [m], once base and tool are placed."""
        E = self.errors(conditions).reshape(-1, self.n_free)
        frames, own = E[:, ~self.has_prior], E[:, self.has_prior]
        return np.asarray(own - frames @ np.linalg.lstsq(frames, own, rcond=None)[0])

    def foreseen(self, measured: Conditions, cared: Conditions) -> float:
        """Return the root mean square of :meth:`errors` that is to be expected at some poses if others are measured [m]."""
        C, E = covariance(self.known + total(self.readings(measured))), self.errors(cared)
        return float(np.sqrt(np.sum(C * total(E)) / len(E)))

    def posterior(self, H: np.ndarray) -> Posterior:
        """Return the posterior of information in units of noise and priors, shape (F, F), with the priors left out of it."""
        return Posterior(Form.of(H / np.outer(self.units, self.units)), self.sizes, np.zeros(self.n_free))

    def _jacobian(self, problem: Station) -> np.ndarray:
        parts = [jacobian for _, _, jacobian in problem.linearise(self.values, self.free)]
        return np.concatenate(parts, axis=2).transpose(2, 1, 0)


def predicted_station(model: Model, values: np.ndarray, rig: SensorSetup, conditions: Conditions) -> Station:
    """Return the station that reads what a model predicts; of the values, shape (P,), the model's come first."""
    poses = model.predict(model.own(values), conditions)
    return Station(model, conditions, simulatable()[rig.sensor].simulated(poses, rig.places), np.ones(len(conditions)))


def held_columns(station: Station) -> dict[str, np.ndarray]:
    """Return the column that names where the target is held, if it is held, shape (N,)."""
    sensor = station.sensor
    if not isinstance(sensor, PointSensor) or sensor.names_points is None:
        return {}
    return {sensor.names_points: np.array(sensor.points.names)[sensor.index]}


def frame_effects(chain: Chain, rig: SensorSetup, conditions: Conditions) -> tuple[Effect, ...]:
    """Return the frames of base and tool that readings of a kind depend on."""
    bare = predicted_station(Model(chain, ()), np.zeros(0), rig, conditions).sensor
    return BaseFrame(bare.base_symbols), ToolFrame(bare.tool_symbols)


def nominal_values(model: Model, rig: SensorSetup, target: np.ndarray) -> np.ndarray:
    """Return the values of the nominal arm, shape (P,), its targets in place and the instrument's axes those of the base.

    What the sensor has of its own stands at the end: the places where the target is held.
    """
    values = np.zeros(model.n_parameters)
    instrument = np.zeros(3) if rig.instrument is None else np.array(rig.instrument)
    for element, place in [("base", -instrument), *((name, target) for name in model.chain.targets)]:
        for symbol, coordinate in zip("xyz", place, strict=True):
            if f"{element}.{symbol}" in model.names:
                values[model.index(f"{element}.{symbol}")] = coordinate
    return np.concatenate([values, rig.places.ravel()])


def _sigma(problem: Station, options: Options) -> np.ndarray:
    declared = declared_noise(Problem((problem,)), options).declared
    blocks = problem.sensor.blocks
    sigma = np.array([block.noise if s is None else s for block, s in zip(blocks, declared, strict=True)])
    if np.any(sigma < _LEAST_NOISE):
        raise BadInputError(f"noise {sigma.min():g} m (or rad); expected {_LEAST_NOISE:g} or more, as instruments have")
    return sigma


def _places(model: Model, free: np.ndarray, rivals: Sequence[Effect]) -> tuple[np.ndarray, ...]:
    """Return where the parameters of each rival stand among the free ones."""
    place = np.cumsum(free) - 1
    found = []
    for rival in rivals:
        columns = [model.index(parameter.name) for parameter in rival.parameters(model.chain)]
        if not free[columns].any():
            raise BadInputError(f"effect {rival.name}: it has no effect in such poses; choose another one")
        found.append(place[[column for column in columns if free[column]]])
    return tuple(found)


def check_rig(rig: SensorSetup) -> None:
    """Refuse a sensor that a design can't be made for.

    Raises:
        BadInputError: for a sensor that is not known or lacks the place of its instrument, or where the target is held.
    """
    known = simulatable()
    if rig.sensor not in known:
        raise BadInputError(f"sensor {rig.sensor!r}: no design is available for it; expected one of {', '.join(known)}")
    if known[rig.sensor].needs_instrument and rig.instrument is None:
        raise BadInputError(f"the information of a {rig.sensor} depends on the position of the instrument; give it")
    if known[rig.sensor].needs_places and not rig.held_at:
        raise BadInputError(
            f"sensor {rig.sensor}: no socket for the target; expected one or, better, two within reach: "
            f"--{rig.sensor} X Y Z for each"
        )
    if rig.held_at and not known[rig.sensor].needs_places:
        raise BadInputError(f"sensor {rig.sensor}: it does not hold the target in sockets, but {len(rig.held_at)} are given")


def weights(rivals: tuple[np.ndarray, ...], n_free: int) -> np.ndarray:
    """Return W of the criterion tr(W C) that distinguishes rivals, shape (F, F).

    It is the sum of the variances of both rivals' parameters, in units of their typical sizes, with everything refitted:
    the A-criterion for a subset (A_s; Atkinson, Donev and Tobias 2007, sec. 10.3). Of an effect with one parameter the
    variance is the inverse of the non-centrality that T-optimality maximises (Atkinson and Fedorov 1975); of several it
    makes up for the worst direction first.
    """
    W = np.zeros((n_free, n_free))
    for columns in rivals:
        W[columns, columns] = RIVAL**2
    return W


def noncentrality(C: np.ndarray, rivals: tuple[np.ndarray, ...]) -> tuple[float, ...]:
    """Return, for each rival of typical size, its squared signal in units of the noise that no refit takes up.

    The rest, the other rival among it, is refitted; it is the mean over the directions of its parameters.

    Args:
        C: shape (F, F), posterior covariance in units of the priors.
        rivals: places of their parameters.
    """
    found = []
    for columns in rivals:
        left = np.linalg.inv(C[np.ix_(columns, columns)]) - np.eye(len(columns))
        found.append(max(float(np.trace(left)) / len(columns) / RIVAL**2, 0.0))
    return tuple(found)
