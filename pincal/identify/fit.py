"""What a calibration comes to, and the same fit with other effects."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property

import numpy as np

from pincal.errors import BadInputError
from pincal.identify.equations import Linearised
from pincal.identify.noise import Noise
from pincal.identify.options import Options
from pincal.identify.posterior import Posterior
from pincal.identify.problem import Problem
from pincal.identify.station import Station, station_of
from pincal.measure.measurements import Measurements
from pincal.model.chain import MomentFrame
from pincal.model.effect import Effect
from pincal.model.model import Model
from pincal.parameters import Estimate

# Steps that a fit takes at most.
MOST_STEPS = 40


class Ending(Enum):
    """How a fit ended."""

    SETTLED = "the last step changed predictions by far less than the noise"
    ROUGH = "it came close enough for the next fit"
    EXACT = "the readings are exact, and the model was fitted to rounding"
    STUCK = "no step reduced the residuals although the solution was not yet stationary"
    BUDGET = f"it did not finish within {MOST_STEPS} steps"


@dataclass(frozen=True)
class Priors:
    """What is believed before measuring, and how far lengths may go.

    Attributes:
        sizes: shape (P,), standard deviations about the nominal; inf for none.
        bounds: shape (P,), largest deviations; inf for none.
    """

    sizes: np.ndarray
    bounds: np.ndarray


@dataclass(frozen=True)
class Solution:
    """A fit.

    Attributes:
        values: shape (P,).
        posterior: what data and priors say about the free parameters at ``values``.
        sigma: shape (blocks,), standard deviations that the fit used, one station's blocks after the other's.
        estimated: shape (blocks,), those of its residuals.
        weights: shape (N,), robust weights: 0 for an outlier.
        chi2: weighted sum of squares over the declared variances (the estimated, where none are declared).
        degrees: its degrees of freedom.
        iterations: Gauss-Newton steps taken.
        exit: how it ended.
        at_bound: shape (P,), parameters held at their bound.
        free: shape (P,), parameters that were fitted.
        wide: the same with noise as large as what is in doubt beside it; default: nothing is.
        of_blocks: how many times as large variances are, and stated, as blocks of consecutive rows tell.
        widened: how many times as large they are stated for all that is in doubt, errors of the path of a motion among it.
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
        """What is known of the free parameters; what the data identify stays as it is, however uncertain it is."""
        return self.posterior if self.wide is None else self.wide

    @property
    def effective(self) -> float:
        """Number of parameters that the data spend, priors counted."""
        return self.posterior.effective

    @property
    def converged(self) -> bool:
        """Whether the fit ended well."""
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
        rms: noise of one component of the first block of readings, as the residuals show it [m or px].
    """

    name: str
    iterations: int
    rms: float


@dataclass(frozen=True)
class ModelFit:
    """A calibrated model.

    Attributes:
        problem: model and training rows of all stations.
        nominal: the fit of base and tool alone.
        solution: the fit of everything.
        priors: what was believed before.
        noise: what was declared of it.
        stages: the stages it went through.
        options: how it was made.
    """

    problem: Problem
    nominal: Solution
    solution: Solution
    priors: Priors
    noise: Noise
    stages: tuple[FitStage, ...]
    options: Options

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
                f"this needs a single station, and there are {len(stations)}: {names}; choose one with fit.at(NAME)"
            )
        return stations[0]

    @property
    def model(self) -> Model:
        """The model of the only station, its chain's reference orientations those of base and tool."""
        return self.station.model

    @property
    def values(self) -> np.ndarray:
        """Calibrated values, shape (P,)."""
        return self.solution.values

    @property
    def model_values(self) -> np.ndarray:
        """Those of the model's parameters, in its order; the sensor's own left out."""
        return self.station.split(self.values)[0]

    @cached_property
    def estimate(self) -> Estimate:
        """The calibrated values by name, with what is known of each."""
        covariance = self.solution.known.joint_covariance
        return Estimate(self.problem.parameters, self.values, self.solution.free, covariance, self.priors.sizes)

    @property
    def iterations(self) -> int:
        """Gauss-Newton steps of all stages together, those for base and tool included."""
        return self.nominal.iterations + sum(stage.iterations for stage in self.stages)

    @property
    def stations(self) -> Iterator[tuple[Station, np.ndarray, slice]]:
        """Each station with the places of its parameters among all, and of its blocks of readings among all blocks."""
        return zip(self.problem.stations, self.problem.places, self.problem.block_spans, strict=True)

    def names_of(self, effects: Iterable[Effect]) -> tuple[str, ...]:
        """Return the names of the parameters of some effects of the fit, those of all stations."""
        known = self.problem.effects
        order = {id(effect): i for i, effect in enumerate(known)}
        index = [order.get(id(effect), known.index(effect)) for effect in effects]
        return tuple(self.problem.parameters[i].name for k in index for i in self.problem.places_at(known[k]))

    def select(self, rows: np.ndarray) -> ModelFit:
        """Return the fit as it is, of some of its rows, by their places."""
        return self.over(self.problem.select(rows).stations, self.solution.weights[rows])

    def over(self, stations: Iterable[Station], weights: np.ndarray | None = None) -> ModelFit:
        """Return the fit as it is over stations with other rows, perhaps with other robust weights of these, shape (N,)."""
        solution = self.solution if weights is None else replace(self.solution, weights=weights)
        return replace(self, problem=replace(self.problem, stations=tuple(stations)), solution=solution)

    def with_effects(self, effects: Sequence[Effect], *, moment_frame: MomentFrame | None = None) -> ModelFit:
        """Return the fit as it stands with other effects beside base and tool, nothing fitted again.

        Parameters that it did not have are zero and so are their priors.
        """
        before, after = self.problem, self.problem.with_effects(effects, moment_frame=moment_frame)
        options = replace(self.options, effects=tuple(effects), moment_frame=moment_frame or self.options.moment_frame)
        nominal, solution = (carried(of, before, after) for of in (self.nominal, self.solution))
        priors = Priors(*(before.carried_over(of, after) for of in (self.priors.sizes, self.priors.bounds)))
        return replace(self, problem=after, nominal=nominal, solution=solution, priors=priors, options=options)

    @cached_property
    def alone(self) -> tuple[ModelFit, ...]:
        """Each station as a fit of its own, as it stands: where its rows are looked at one by one."""
        if len(self.problem.stations) == 1:
            return (self,)
        found = []
        for (station, places, blocks), rows in zip(self.stations, self.problem.rows, strict=True):
            # The posterior stays that of all.
            nominal, solution = (
                replace(
                    of,
                    values=of.values[places],
                    free=of.free[places],
                    at_bound=of.at_bound[places],
                    sigma=of.sigma[blocks],
                    estimated=of.estimated[blocks],
                    weights=of.weights[rows],
                )
                for of in (self.nominal, self.solution)
            )
            problem, options = Problem((replace(station, name=""),)), self.options.at(station.name)
            priors = Priors(self.priors.sizes[places], self.priors.bounds[places])
            solution = replace(solution, posterior=posterior_of(problem, solution, priors))
            noise = Noise(self.noise.declared[blocks])
            found.append(ModelFit(problem, nominal, solution, priors, noise, self.stages, options))
        return tuple(found)

    @property
    def in_places(self) -> Iterator[tuple[Station, ModelFit, slice]]:
        """Each station whose readings tell places, with the fit of it alone, and its blocks of readings among all."""
        for (station, _, blocks), alone in zip(self.stations, self.alone, strict=True):
            if station.sensor.reads_place:
                yield station, alone, blocks

    @property
    def arm(self) -> tuple[Model, np.ndarray]:
        """The model of the first station and its values: what they say of the robot holds at all stations."""
        station = self.problem.stations[0]
        return station.model, station.split(self.values[self.problem.places[0]])[0]

    @property
    def is_declared(self) -> bool:
        """Whether the noise of all stations was declared."""
        return all(self.noise.declared[blocks.start] is not None for _, _, blocks in self.stations)

    def readings(self, measurements: Measurements, *, station: str = "") -> Station:
        """Return the calibrated model of a station, by its name if there are several, over other measurements."""
        options = self.options.at(station)
        model = next(of.model for of in self.problem.stations if of.name == station)
        centre, instrument = np.array(options.payload_centre), options.instrument
        return station_of(model, measurements, centre, options.setup, name=station, instrument=instrument)


def posterior_of(problem: Problem, part: Solution, priors: Priors) -> Posterior:
    """Return the posterior of a problem with the values, the rows' weights and the noise of a solution."""
    return Linearised(problem, part.values, part.free, part.weights, priors.sizes).posterior(part.sigma)


def carried(solution: Solution, before: Problem, after: Problem) -> Solution:
    """Return a solution's values by name over another problem's parameters; its posterior stays that of before."""
    return replace(
        solution,
        values=before.carried_over(solution.values, after),
        free=before.carried_over(solution.free, after),
        at_bound=before.carried_over(solution.at_bound, after),
    )


def without(fit: ModelFit, effect: Effect) -> ModelFit:
    """Return a fit as it stands with one effect taken out, nothing fitted again: the place to test the effect from."""
    options = replace(fit.options, effects=tuple(e for e in fit.options.effects if e is not effect))
    return replace(fit.with_effects([e for e in fit.problem.effects if e is not effect]), options=options)
