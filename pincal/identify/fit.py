"""The result of a calibration, and the same fit with other effects."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from pincal.errors import BadInputError
from pincal.identify.equations import Linearised
from pincal.identify.noise import Noise
from pincal.identify.options import Options
from pincal.identify.posterior import Posterior
from pincal.identify.problem import Problem
from pincal.identify.station import Station, station_of
from pincal.identify.stop_scatter import ScatterOfStations
from pincal.measure.measurements import Measurements
from pincal.model.chain import MomentFrame
from pincal.model.effect import Effect
from pincal.model.model import Model
from pincal.parameters import Estimate
from pincal.thresholds import Count

# Largest number of steps of a fit.
MOST_STEPS: Count = 40


class Ending(Enum):
    """How a fit ended."""

    SETTLED = "the last step changed predictions by far less than the noise"
    ROUGH = "it came close enough for the next fit"
    EXACT = "the readings are exact, and the model was fitted to rounding"
    STUCK = "no step reduced the residuals although the solution was not yet stationary"
    BUDGET = f"it did not finish within {MOST_STEPS} steps"


@dataclass(frozen=True)
class Priors:
    """Prior standard deviations about the nominal, and largest deviations, shape (P,) each; inf for
    none.
    """

    sizes: np.ndarray
    bounds: np.ndarray


@dataclass(frozen=True)
class Solution:
    """A fit.

    Attributes:
        values: shape (P,).
        posterior: of the free parameters at ``values``.
        sigma: shape (blocks,), standard deviations that the fit used, station by station.
        estimated: shape (blocks,), standard deviations of its residuals.
        weights: shape (N,), robust weights: 0 for an outlier.
        chi2: weighted sum of squares over the declared variances (the estimated, where none are
            declared).
        degrees: its degrees of freedom.
        iterations: Gauss-Newton steps taken.
        exit: how it ended.
        at_bound: shape (P,), parameters held at their bound.
        free: shape (P,), parameters that were fitted.
        wide: posterior with the noise widened for all reservations; default: there are none.
        of_blocks: factor on variances that blocks of consecutive rows show, and that is reported.
        widened: factor on variances for all reservations, errors of the path of a motion among
            them.
    """

    values: np.ndarray
    posterior: Posterior
    sigma: np.ndarray
    estimated: np.ndarray
    weights: np.ndarray
    chi2: float
    degrees: float
    iterations: int
    exit: Ending
    at_bound: np.ndarray
    free: np.ndarray
    wide: Posterior | None = None
    of_blocks: float = 1.0
    widened: float = 1.0

    @property
    def known(self) -> Posterior:
        """The posterior to report; what the data identify does not depend on the widening."""
        return self.posterior if self.wide is None else self.wide

    @property
    def effective(self) -> float:
        """Effective number of parameters, priors accounted for."""
        return self.posterior.effective

    @property
    def converged(self) -> bool:
        """Whether the fit converged."""
        return self.exit in (Ending.SETTLED, Ending.ROUGH, Ending.EXACT)

    @property
    def cost(self) -> float:
        """Mean square of the residuals in units of the noise."""
        return float(self.chi2 / max(self.degrees, 1.0))


@dataclass(frozen=True)
class FitStage:
    """One stage of an identification.

    Attributes:
        name: what was fitted.
        iterations: number of steps of the solver.
        rms: noise of one component of the first block of readings, estimated from the residuals [m
            or px].
    """

    name: str
    iterations: int
    rms: float


AnyFit = TypeVar("AnyFit", bound="ModelFit")


@dataclass(frozen=True)
class ModelFit:
    """A calibrated model.

    Attributes:
        problem: model and training rows of all stations.
        nominal: the fit of base and tool alone.
        solution: the fit of everything.
        priors: of the parameters.
        noise: declared noise.
        stages: the stages of the fit.
        options: how it was made.
        wrong: for each station, shape (N,), which rows as measured were left out before means of
            poses were taken, as others of their pose show them to be wrong
            (:mod:`pincal.identify.screening`); empty if none were.
        scatter: of the readings of each station, by its name, where any was repeated or a stop has
            several targets; worked out when it is asked for.
    """

    problem: Problem
    nominal: Solution
    solution: Solution
    priors: Priors
    noise: Noise
    stages: tuple[FitStage, ...]
    options: Options
    wrong: tuple[np.ndarray, ...] = ()
    scatter: ScatterOfStations = field(default_factory=ScatterOfStations)

    @property
    def station(self) -> Station:
        """The only station, model and training rows.

        Raises:
            BadInputError: if there are several.
        """
        stations = self.problem.stations
        if len(stations) > 1:
            names = ", ".join(station.name for station in stations)
            raise BadInputError(
                f"this needs a single station, and there are {len(stations)}: {names}; "
                "choose one: --station NAME, or fit.at(NAME) in Python"
            )
        return stations[0]

    @property
    def model(self) -> Model:
        """The model of the only station, its chain's reference orientations being those of base and
        tool.
        """
        return self.station.model

    @property
    def values(self) -> np.ndarray:
        """Calibrated values, shape (P,)."""
        return self.solution.values

    @property
    def model_values(self) -> np.ndarray:
        """Values of the model's parameters, without the sensor's own."""
        return self.station.split(self.values)[0]

    @cached_property
    def estimate(self) -> Estimate:
        """The calibrated values by name, with their covariance."""
        covariance = self.solution.known.joint_covariance
        return Estimate(
            self.problem.parameters, self.values, self.solution.free, covariance, self.priors.sizes
        )

    @property
    def iterations(self) -> int:
        """Gauss-Newton steps of all stages together, including the fit of base and tool."""
        return self.nominal.iterations + sum(stage.iterations for stage in self.stages)

    @property
    def stations(self) -> Iterator[tuple[Station, np.ndarray, slice]]:
        """Each station with the indices of its parameters and the slice of its blocks
        of readings.
        """
        return zip(
            self.problem.stations, self.problem.places, self.problem.block_spans, strict=True
        )

    def names_of(self, effects: Iterable[Effect]) -> tuple[str, ...]:
        """Return the names of the parameters of some effects of the fit, at all stations."""
        known = self.problem.effects
        order = {id(effect): i for i, effect in enumerate(known)}
        index = [order.get(id(effect), known.index(effect)) for effect in effects]
        return tuple(
            self.problem.parameters[i].name for k in index for i in self.problem.places_at(known[k])
        )

    def select(self, rows: np.ndarray) -> ModelFit:
        """Return the fit, unchanged, with some of its rows, by index."""
        return self.over(self.problem.select(rows).stations, self.solution.weights[rows])

    def over(self, stations: Iterable[Station], weights: np.ndarray | None = None) -> ModelFit:
        """Return the fit, unchanged, over stations with other rows, perhaps with robust weights of
        these, shape (N,).
        """
        solution = self.solution if weights is None else replace(self.solution, weights=weights)
        return replace(
            self, problem=replace(self.problem, stations=tuple(stations)), solution=solution
        )

    def with_effects(
        self, effects: Sequence[Effect], *, moment_frame: MomentFrame | None = None
    ) -> ModelFit:
        """Return the fit, unchanged, with other effects besides base and tool; nothing is fitted
        again.

        Parameters that it did not have are zero and so are their priors.
        """
        before = self.problem
        after = self.problem.with_effects(effects, moment_frame=moment_frame)
        options = replace(
            self.options,
            effects=tuple(effects),
            moment_frame=moment_frame or self.options.moment_frame,
        )
        nominal, solution = (carried(of, before, after) for of in (self.nominal, self.solution))
        priors = Priors(
            *(before.carried_over(of, after) for of in (self.priors.sizes, self.priors.bounds))
        )
        return replace(
            self, problem=after, nominal=nominal, solution=solution, priors=priors, options=options
        )

    @property
    def alone(self) -> tuple[ModelFit, ...]:
        """Each station as a fit of its own, unchanged, for tests of its rows."""
        # A fit that kept itself would keep its memory, too.
        return (self,) if len(self.problem.stations) == 1 else self._each_alone

    @cached_property
    def _each_alone(self) -> tuple[ModelFit, ...]:
        found = []
        for (station, places, blocks), rows in zip(self.stations, self.problem.rows, strict=True):
            parts: dict[str, np.ndarray | slice] = {
                "values": places,
                "free": places,
                "at_bound": places,
            }
            parts |= {"sigma": blocks, "estimated": blocks, "weights": rows}
            # The nominal posterior remains the joint one.
            nominal, solution = (
                replace(of, **{name: getattr(of, name)[at] for name, at in parts.items()})
                for of in (self.nominal, self.solution)
            )
            problem = Problem((replace(station, name=""),))
            options = self.options.at(station.name)
            priors = Priors(self.priors.sizes[places], self.priors.bounds[places])
            solution = replace(solution, posterior=posterior_of(problem, solution, priors))
            noise = self.noise.select(range(blocks.start, blocks.stop))
            found.append(ModelFit(problem, nominal, solution, priors, noise, self.stages, options))
        return tuple(found)

    @property
    def in_places(self) -> Iterator[tuple[Station, ModelFit, slice]]:
        """Each station whose readings determine positions, the fit of it alone, and the slice of
        its blocks of readings.
        """
        for (station, _, blocks), alone in zip(self.stations, self.alone, strict=True):
            if station.sensor.reads_place:
                yield station, alone, blocks

    @property
    def arm(self) -> tuple[Model, np.ndarray]:
        """The model of the first station and its values; the robot's part holds at all stations."""
        station = self.problem.stations[0]
        return station.model, station.split(self.values[self.problem.places[0]])[0]

    @property
    def is_declared(self) -> bool:
        """Whether the noise of all stations was declared."""
        return all(self.noise.declared[blocks.start] is not None for _, _, blocks in self.stations)

    @cached_property
    def is_kept(self) -> bool:
        """Whether the robot is as in its URDF because the readings do not improve it; a further fit
        may have changed it.
        """
        if self.options.kept is None:
            return False
        at = [
            k
            for k, parameter in enumerate(self.problem.parameters)
            if parameter.name in self.options.kept.names
        ]
        return bool(np.array_equal(self.values[at], self.nominal.values[at]))

    def readings(self, measurements: Measurements, *, station: str = "") -> Station:
        """Return the calibrated model of a station, by name if there are several, over other
        measurements.
        """
        options = self.options.at(station)
        model = next(of.model for of in self.problem.stations if of.name == station)
        centre = np.array(options.payload_centre)
        instrument = options.instrument
        return station_of(
            model, measurements, centre, options.setup, name=station, instrument=instrument
        )


def posterior_of(problem: Problem, part: Solution, priors: Priors) -> Posterior:
    """Return the posterior of a problem for the values, row weights and noise of a solution."""
    return Linearised(problem, part.values, part.free, part.weights, priors.sizes).posterior(
        part.sigma
    )


def carried(solution: Solution, before: Problem, after: Problem) -> Solution:
    """Return a solution with its values by name over another problem's parameters; its posterior is
    unchanged.
    """
    vectors: dict[str, Any] = {
        name: before.carried_over(getattr(solution, name), after)
        for name in ("values", "free", "at_bound")
    }
    return replace(solution, **vectors)


def without(fit: ModelFit, effect: Effect) -> ModelFit:
    """Return a fit, unchanged, with one effect removed, nothing fitted again: where the effect is
    tested.
    """
    options = replace(fit.options, effects=tuple(e for e in fit.options.effects if e is not effect))
    return replace(
        fit.with_effects([e for e in fit.problem.effects if e is not effect]), options=options
    )
