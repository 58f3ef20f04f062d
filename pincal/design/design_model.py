r"""The predicted information of a measurement at any pose on the parameters.

A design uses the Jacobian of a :class:`~pincal.identify.problem.Problem` for any sensor. It is
taken at the nominal arm, in units of the noise and of the fit's priors (by physical group, see
:func:`pincal.identify.calibrate.priors_of`), so that the priors' information is the identity. Base
and tool, which have no prior in a fit, get an uninformative one, which keeps the covariance finite
for few poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pincal.design.design_numbers import DESIGN_NUMBERS
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
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect
from pincal.model.effects import BaseFrame, ToolFrame
from pincal.model.model import Model
from pincal.model.sizes import largest_basis
from pincal.robot.robot import Robot
from pincal.sensors.point_sensor import PointSensor
from pincal.sensors.registry import simulatable
from pincal.thresholds import Scale

# Width of an uninformative prior, in units of the noise: 1 m for 0.05 mm.
_WIDE: Scale = 2e4
# Width of the prior of an effect that is to be distinguished from another, in typical sizes.
RIVAL: Scale = 10.0


@dataclass(frozen=True)
class DesignModel:
    """The parameters of a fit, and the readings' dependence on them at any pose.

    Attributes:
        model: base, tool and all effects.
        values: shape (P,), the point of linearisation: the nominal arm with its approximate target.
        free: shape (P,), the F parameters that these poses excite.
        sizes: shape (F,), standard deviations of the priors; inf for base and tool.
        sigma: shape (blocks,), noise of one component of each block of readings [m, rad].
        rig: sensor set-up.
        rivals: for each of the effects to be distinguished, its indices among the F parameters.
        core: shape (F,), the parameters of the fitted model, without added rivals.
        known: shape (F, F), prior information, including ``Options.earlier``, in units of the
            priors.
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
            conditions: N poses, which scale the priors as the rows of a fit do.
            options: as for the calibration; default of ``sigma``: a good laser tracker's.
            rig: sensor set-up.
            rivals: effects to be distinguished, in addition to the model.
            targets: names of the targets, all at the rig's target.

        Raises:
            BadInputError: for an unknown sensor, a missing instrument position, unrealistically
                small noise, or a rival without effect in these poses.
        """
        check_rig(rig)
        chain = Chain.of(
            robot, moment_frame=options.first_frame, gravity=options.gravity, targets=targets
        )
        effects = (*frame_effects(chain, rig, conditions), *options.effects)
        fitted = Model(chain, effects, equilibrium=options.equilibrium)
        model = _with_rivals(fitted, rivals)
        values = nominal_values(model, rig, rig.target(robot))
        problem = predicted_station(model, values, rig, conditions)
        free = np.append(largest_basis(model, conditions)[1], ~problem.sensor.fixed)
        whole = Problem(
            (problem,), None if options.earlier is None else Earlier.of(options.earlier)
        )
        whole_sizes = np.where(is_frame(whole), np.inf, priors_of(whole, options).sizes)
        sizes = whole_sizes[free]
        places = _places(model, free, rivals)
        for columns in places:
            sizes[columns] *= RIVAL
        index = np.flatnonzero(free)
        core = (index < fitted.n_parameters) | (index >= model.n_parameters)
        sigma = _sigma(problem, options)
        known = np.eye(len(sizes))
        found = cls(model, values, free, sizes, sigma, rig, places, core, known)
        if options.earlier is None:
            return found
        beyond = whole.beliefs.beyond_priors(index, np.zeros(len(free)), whole_sizes)
        return replace(found, known=known + beyond.H * np.outer(found.units, found.units))

    @cached_property
    def units(self) -> np.ndarray:
        """The unit of each parameter in a design, shape (F,)."""
        return np.where(np.isfinite(self.sizes), self.sizes, _WIDE * self.sigma[0])

    @property
    def n_free(self) -> int:
        """Number F of parameters."""
        return len(self.sizes)

    @property
    def quantity(self) -> str:
        """The quantity of :meth:`errors`: "position" or "distance"."""
        return simulatable()[self.rig.sensor].blocks[0].name

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the model's parameters, which come first among the F parameters."""
        return tuple(np.array(self.model.names)[self.model.own(self.free)])

    @property
    def has_prior(self) -> np.ndarray:
        """Which of the F parameters have a prior, shape (F,): the arm's, but not base and tool."""
        return np.asarray(np.isfinite(self.sizes))

    @property
    def own_names(self) -> tuple[str, ...]:
        """Names of the parameters with a prior."""
        return tuple(np.array(self.names)[self.has_prior[: len(self.names)]])

    def readings(self, conditions: Conditions) -> np.ndarray:
        """Return the Jacobian of the readings in units of noise and priors, shape (N, m, F)."""
        problem = predicted_station(self.model, self.values, self.rig, conditions)
        noise = np.repeat(self.sigma, problem.block_sizes)
        return np.ascontiguousarray(self._jacobian(problem) * (self.units / noise[:, None]))

    def errors(self, conditions: Conditions) -> np.ndarray:
        """Return the Jacobian of the predicted position (or distance) by parameters in units of
        priors, shape (N, k, F) [m].

        The quantity is the one of held-out errors: the first block of readings, in the instrument's
        frame.
        """
        problem = predicted_station(self.model, self.values, self.rig, conditions)
        return np.asarray(self._jacobian(problem)[:, : problem.sensor.blocks[0].size] * self.units)

    def placed_errors(self, conditions: Conditions) -> np.ndarray:
        """Return the Jacobian by the H parameters with a prior, shape (k N, H) [m], with base and
        tool projected out.
        """
        E = self.errors(conditions).reshape(-1, self.n_free)
        frames = E[:, ~self.has_prior]
        own = E[:, self.has_prior]
        return np.asarray(own - frames @ np.linalg.lstsq(frames, own, rcond=None)[0])

    def foreseen(self, measured: Conditions, cared: Conditions) -> float:
        """Return the expected rms error at some poses after measuring others [m]."""
        C = covariance(self.known + total(self.readings(measured)))
        E = self.errors(cared)
        return float(np.sqrt(np.sum(C * total(E)) / len(E)))

    def posterior(self, H: np.ndarray) -> Posterior:
        """Return the posterior of data information H in units of noise and priors, shape (F, F),
        without the priors'.
        """
        return Posterior(
            Form.of(H / np.outer(self.units, self.units)), self.sizes, np.zeros(self.n_free)
        )

    def _jacobian(self, problem: Station) -> np.ndarray:
        parts = [jacobian for _, _, jacobian in problem.linearise(self.values, self.free)]
        return np.concatenate(parts, axis=2).transpose(2, 1, 0)


def _with_rivals(model: Model, rivals: Sequence[Effect]) -> Model:
    """Return a model with those of the rivals that it has not yet."""
    for rival in rivals:
        if any(parameter.name not in model.names for parameter in rival.parameters(model.chain)):
            model = model.with_effects([*model.effects, rival])
    return model


def predicted_station(
    model: Model, values: np.ndarray, rig: SensorSetup, conditions: Conditions
) -> Station:
    """Return the station of a model's predicted readings; of the values, shape (P,), the model's
    come first.
    """
    poses = model.predict(model.own(values), conditions)
    return Station(
        model,
        conditions,
        simulatable()[rig.sensor].simulated(poses, rig.places),
        np.ones(len(conditions)),
    )


def held_columns(station: Station) -> dict[str, np.ndarray]:
    """Return the column that names the point at which the target is held, if any, shape (N,)."""
    sensor = station.sensor
    if not isinstance(sensor, PointSensor) or sensor.names_points is None:
        return {}
    return {sensor.names_points: np.array(sensor.points.names)[sensor.index]}


def frame_effects(chain: Chain, rig: SensorSetup, conditions: Conditions) -> tuple[Effect, ...]:
    """Return the effects of the base and tool frames on which a sensor's readings depend."""
    bare = predicted_station(Model(chain, ()), np.zeros(0), rig, conditions).sensor
    return BaseFrame(bare.base_symbols), ToolFrame(bare.tool_symbols)


def nominal_values(model: Model, rig: SensorSetup, target: np.ndarray) -> np.ndarray:
    """Return the values of the nominal arm with its targets, and instrument axes parallel to the
    base's, shape (P,).

    The sensor's own parameters come last: the points at which the target is held.
    """
    values = np.zeros(model.n_parameters)
    instrument = np.zeros(3) if rig.instrument is None else np.array(rig.instrument)
    for element, place in [
        ("base", -instrument),
        *((name, target) for name in model.chain.targets),
    ]:
        for symbol, coordinate in zip("xyz", place, strict=True):
            if f"{element}.{symbol}" in model.names:
                values[model.index(f"{element}.{symbol}")] = coordinate
    return np.concatenate([values, rig.places.ravel()])


def _sigma(problem: Station, options: Options) -> np.ndarray:
    declared = declared_noise(Problem((problem,)), options).declared
    blocks = problem.sensor.blocks
    sigma = np.array(
        [block.noise if s is None else s for block, s in zip(blocks, declared, strict=True)]
    )
    least = DESIGN_NUMBERS.least_noise
    if np.any(sigma < least):
        raise BadInputError(
            f"noise {sigma.min():g} m (or rad); expected {least:g} or more, as instruments have"
        )
    return sigma


def _places(model: Model, free: np.ndarray, rivals: Sequence[Effect]) -> tuple[np.ndarray, ...]:
    """Return the indices of each rival's parameters among the free ones."""
    place = np.cumsum(free) - 1
    found = []
    for rival in rivals:
        columns = [model.index(parameter.name) for parameter in rival.parameters(model.chain)]
        if not free[columns].any():
            raise BadInputError(
                f"effect {rival.name}: it has no effect in such poses; choose another one"
            )
        found.append(place[[column for column in columns if free[column]]])
    return tuple(found)


def check_rig(rig: SensorSetup) -> None:
    """Refuse an unknown sensor, or one whose instrument position or held target points
    are missing.
    """
    known = simulatable()
    if rig.sensor not in known:
        raise BadInputError(
            f"sensor {rig.sensor!r}: no design is available for it; expected one of "
            f"{', '.join(known)}"
        )
    if known[rig.sensor].needs_instrument and rig.instrument is None:
        raise BadInputError(
            f"the information of a {rig.sensor} depends on the position of the instrument; give it"
        )
    if known[rig.sensor].needs_places and not rig.held_at:
        raise BadInputError(
            f"sensor {rig.sensor}: no socket for the target; expected one or, better, two within "
            f"reach: --{rig.sensor} X Y Z for each"
        )
    if rig.held_at and not known[rig.sensor].needs_places:
        raise BadInputError(
            f"sensor {rig.sensor}: it does not hold the target in sockets, but "
            f"{len(rig.held_at)} are given"
        )


def weights(rivals: tuple[np.ndarray, ...], n_free: int) -> np.ndarray:
    """Return W of the criterion tr(W C) that distinguishes rivals, shape (F, F).

    The criterion is the sum of the variances of both rivals' parameters, in units of their typical
    sizes, with everything refitted: the A-criterion for a subset (A_s; Atkinson, Donev and Tobias
    2007, sec. 10.3). For an effect with one parameter the variance is the inverse of the
    non-centrality maximised by T-optimality (Atkinson and Fedorov 1975); for several it is
    dominated by the worst direction.
    """
    W = np.zeros((n_free, n_free))
    for columns in rivals:
        W[columns, columns] = RIVAL**2
    return W


def noncentrality(C: np.ndarray, rivals: tuple[np.ndarray, ...]) -> tuple[float, ...]:
    """Return the non-centrality of each rival of typical size: its squared signal, in units of
    noise, after a refit.

    All other parameters, including the other rival's, are refitted; the signal is the mean over the
    directions of its parameters. C, shape (F, F), is the posterior covariance in units of the
    priors.
    """
    found = []
    for columns in rivals:
        left = np.linalg.inv(C[np.ix_(columns, columns)]) - np.eye(len(columns))
        found.append(max(float(np.trace(left)) / len(columns) / RIVAL**2, 0.0))
    return tuple(found)
