"""A fitted robot: effects, estimate, stations and provenance, from a fit or from its file."""

from __future__ import annotations

import html
import os
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, TypeVar, overload

import numpy as np
from numpy.typing import ArrayLike

from pincal.atomic import write_atomic
from pincal.calibration.another_day import of_its_day
from pincal.calibration.covered import Covered, Outside
from pincal.calibration.discrepancy import Discrepancy
from pincal.calibration.earlier_files import read_model
from pincal.calibration.fit_evidence import Evidence, FitEvidence, KeptEvidence
from pincal.calibration.fitted_station import FittedStation
from pincal.calibration.information import RobotInformation
from pincal.calibration.likelihood import log_likelihood, score
from pincal.calibration.model_file import ModelFile, write_model_file
from pincal.calibration.model_statement import ModelStatement
from pincal.calibration.position_covariance import PositionCovariance
from pincal.calibration.prediction_uncertainty import PointOnTip, PredictionUncertainty
from pincal.calibration.repeatability import Repeatability
from pincal.calibration.result_tables import (
    estimate_table,
    parameter_rows,
    parameter_table,
    residual_table,
)
from pincal.calibration.robot_words import in_few_lines, in_one_line
from pincal.calibration.unmodelled import Unmodelled
from pincal.errors import BadInputError, MeasurementError, RobotFileError
from pincal.identify import split
from pincal.identify.explain import ParameterFinding, explain
from pincal.identify.fit import ModelFit, Solution
from pincal.identify.options import Options
from pincal.identify.problem import Problem
from pincal.identify.station import Station, station_of, together
from pincal.identity import Identity
from pincal.io.camera_file import camera_entries
from pincal.io.urdf_export import UrdfExport, calibrated_urdf
from pincal.measure.measurements import Measurements
from pincal.measure.table import read_measurements
from pincal.model.augmented import pinocchio_model
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect, Family
from pincal.model.model import Model
from pincal.parameters import Estimate
from pincal.result_table import Table
from pincal.sensors.setup import Setup

if TYPE_CHECKING:
    import pinocchio as pin

_Rows = TypeVar("_Rows", Measurements, Conditions)


@dataclass(frozen=True, repr=False)
class FittedRobot:
    """A robot as it was fitted, ready to predict.

    What is of one station (a prediction in the frame of its instrument, its model, its covered
    range) is asked of a robot with one station; of several, :meth:`at` chooses.

    Attributes:
        stations: where it was measured, one or more.
        estimate: the robot's parameters, then those of each station; of several stations under the
            station's name.
        nominal_values: shape (P,), the values with only base and tool fitted; None where unknown.
        provenance: version of pincal, time, input files with their SHA-256, command and seed.
        evidence: what the rows show besides.
        discrepancy: what the model lacks; None where its residuals are noise, or it is not known.
        identity: of robot, instrument and circumstances, as far as stated.
        statement: what the calibration states of the model; None where it is not known.

    Example:
        >>> from pincal import Robot
        >>> from pincal.model.chain import Chain
        >>> from pincal.parameters import estimate_of
        >>> model = Model(Chain.of(Robot.from_urdf("ur10")), ())
        >>> covered = Covered(np.tile([-1.0, 1.0], (6, 1)), np.array([0.0, 5.0]))
        >>> ur10 = FittedRobot.given(model, estimate_of((), np.zeros(0), np.zeros((0, 0))), covered)
        >>> ur10.outside(Conditions.at(np.zeros((1, 6)), payload=8.0))
        [Outside(row=0, name='payload', value=8.0, lower=0.0, upper=5.0)]
        >>> ur10.predict(np.zeros(6)).shape, ur10
        ((1, 3, 4), FittedRobot('ur10': 0 parameters, position))
    """

    stations: tuple[FittedStation, ...]
    estimate: Estimate
    nominal_values: np.ndarray | None = None
    provenance: dict[str, Any] = field(default_factory=dict)
    evidence: Evidence = field(default_factory=KeptEvidence)
    discrepancy: Discrepancy | None = None
    identity: Identity = field(default_factory=Identity)
    statement: ModelStatement | None = None

    @classmethod
    def of(cls, fit: ModelFit, provenance: dict[str, Any] | None = None) -> FittedRobot:
        """Return the robot of a fit, with its origin in JSON types."""
        prior = np.array([parameter.size for parameter in fit.problem.parameters])
        return cls(
            tuple(FittedStation.of(fit, k) for k in range(len(fit.problem.stations))),
            replace(fit.estimate, prior=prior),
            fit.nominal.values,
            dict(provenance or {}),
            FitEvidence(fit),
        )

    @classmethod
    def given(
        cls,
        model: Model,
        estimate: Estimate,
        covered: Covered,
        *,
        sensor_kind: str = "position",
        payload_centre: ArrayLike = (0.0, 0.0, 0.0),
        sigma: ArrayLike = (1e-4,),
    ) -> FittedRobot:
        """Return a robot as if it had been fitted at one station.

        Args:
            model: chain and effects.
            estimate: of its parameters.
            covered: the range of the rows.
            sensor_kind: what was measured.
            payload_centre: shape (3,), centre of mass of the payload in the tip frame [m].
            sigma: shape (blocks,), noise of one component of each block of readings [m, rad, px].
        """
        station = FittedStation(
            name="",
            model=model,
            parameter_names=estimate.names,
            sensor_kind=sensor_kind,
            payload_centre=np.array(payload_centre, float),
            covered=covered,
            sigma=np.array(sigma, float),
        )
        return cls((station,), estimate)

    def __repr__(self) -> str:
        robot = self.stations[0].model.chain.robot.name
        return f"FittedRobot({robot!r}: {in_one_line(self.stations, self.estimate, self.evidence)})"

    def _repr_html_(self) -> str:
        lines = "<br>".join(html.escape(line) for line in self.summary().splitlines())
        return f"<p>{lines}</p>{self.parameters._repr_html_()}"

    # Stations

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the stations."""
        return tuple(station.name for station in self.stations)

    def at(self, station: str | None = None) -> FittedRobot:
        """Return the robot with one station alone; default: the only one.

        Raises:
            BadInputError: if there is no such station, or none is named and there are several.
        """
        names = self.names
        if station is None:
            if len(names) > 1:
                raise BadInputError(
                    f"this needs a single station, and there are {len(names)}: "
                    f"{', '.join(names)}; choose one: --station NAME, or fit.at(NAME) in Python"
                )
            return self
        if station not in names and names == ("",):
            raise BadInputError(
                f"station {station!r} is not in the model, which was calibrated at a "
                "single one; omit the name"
            )
        if station not in names:
            raise BadInputError(
                f"station {station!r} is not in the model; expected one of {', '.join(names)}"
            )
        return self._alone(names.index(station))

    def _alone(self, k: int) -> FittedRobot:
        """Return the robot with its k-th station alone, whose parameters then have their local
        names.
        """
        if len(self.stations) == 1:
            return self
        station = self.stations[k]
        estimate = self.estimate.take(station.parameter_names)
        local = tuple(replace(p, name=p.local_name, station="") for p in estimate.parameters)
        nominal = self.nominal_values
        if nominal is not None:
            nominal = nominal[self.estimate.places(station.parameter_names)]
        return FittedRobot(
            (replace(station, parameter_names=tuple(p.name for p in local)),),
            replace(estimate, parameters=local),
            nominal,
            self.provenance,
            # The information of all stations counts once.
            self.evidence if k == 0 else KeptEvidence(),
            self.discrepancy,
            self.identity,
            self.statement,
        )

    @cached_property
    def each(self) -> tuple[FittedRobot, ...]:
        """The robot with each station alone."""
        return tuple(map(self._alone, range(len(self.stations))))

    def robot_model(self, kind: str | None = None) -> FittedRobot:
        """Return the robot with its first station alone, with the coverage of all stations, which
        share the robot.

        Args:
            kind: kind of sensor; the first station with such a sensor is taken, if there is any.
        """
        kinds = [station.sensor_kind for station in self.stations]
        k = kinds.index(kind) if kind in kinds else 0
        one = self._alone(k)
        others = [station for i, station in enumerate(self.stations) if i != k]
        covered = one.covered
        for station in others:
            covered = covered.over(station.covered)
        rows = together(one.rows, *(station.rows for station in others))
        return one.with_station(replace(one.station, covered=covered, rows=rows))

    def with_station(self, station: FittedStation) -> FittedRobot:
        """Return the robot with another record of its only station."""
        return replace(self, stations=(station,))

    @property
    def station(self) -> FittedStation:
        """The only station.

        Raises:
            BadInputError: if there are several.
        """
        return self.at().stations[0]

    @property
    def model(self) -> Model:
        """The model of the only station."""
        return self.station.model

    @property
    def sensor_kind(self) -> str:
        """What was measured at the only station."""
        return self.station.sensor_kind

    @property
    def payload_centre(self) -> np.ndarray:
        """Centre of mass of the payload in the tip frame, shape (3,) [m]."""
        return self.station.payload_centre

    @property
    def covered(self) -> Covered:
        """The range of the rows of the only station."""
        return self.station.covered

    @property
    def sigma(self) -> np.ndarray:
        """Noise of one component of each block of readings of the only station, shape (blocks,) [m,
        rad, px].
        """
        return self.station.sigma

    @property
    def setup(self) -> Setup:
        """Named points and the camera of the only station."""
        return self.station.setup

    @property
    def rows(self) -> str:
        """Fingerprints of the rows of the only station."""
        return self.station.rows

    @property
    def is_noise_declared(self) -> bool:
        """Whether the noise of the only station was declared, not estimated."""
        return self.station.is_noise_declared

    @property
    def repeatability(self) -> Repeatability | None:
        """Scatter of the readings of the only station; None where nothing was repeated."""
        return self.station.repeatability

    # Parameters

    @property
    def values(self) -> np.ndarray:
        """Values of all parameters, shape (P,), as deviations from the nominal."""
        return self.estimate.values

    @property
    def model_values(self) -> np.ndarray:
        """Values of the parameters of the only station's model, without the sensor's own."""
        return self.model.own(self.values)

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance of the values, shape (P, P); zero rows and columns for parameters that were
        not fitted.
        """
        return self.estimate.dense_covariance()

    @property
    def robot_estimate(self) -> Estimate:
        """The estimate of the robot's own parameters: ``Options.earlier`` of a further fit."""
        model = self.stations[0].model
        effects = (effect for effect in model.effects if effect.scope == "robot")
        return self.estimate.take(
            p.name for effect in effects for p in effect.parameters(model.chain)
        )

    @property
    def holds_lengths(self) -> bool:
        """Whether no length of its links was fitted, as an IMU tells none: they are those of its
        description, and no uncertainty of positions includes them.
        """
        model = self.stations[0].model
        lengths = {
            parameter.name
            for effect in model.effects
            if effect.family is Family.GEOMETRY
            for parameter in effect.parameters(model.chain)
            if parameter.unit == "m"
        }
        are_free = (
            free
            for parameter, free in zip(self.estimate.parameters, self.estimate.free, strict=True)
            if parameter.name in lengths
        )
        return bool(lengths) and not any(are_free)

    @property
    def parameters(self) -> Table:
        """Value and standard deviation of each parameter; of a fit also status and reason."""
        if isinstance(self.evidence, FitEvidence):
            return parameter_table(parameter_rows(self.fit))
        return estimate_table(self.estimate)

    def summary(self) -> str:
        """Return the robot, its measurements, the number of fitted parameters and, of a fit, how it
        ended, in words.
        """
        return in_few_lines(self.stations, self.estimate, self.evidence)

    # Evidence

    @property
    def unmodelled(self) -> Unmodelled | None:
        """Effects present in the rows but not in the model; None without any, or where they were
        not searched for.
        """
        return self.evidence.unmodelled

    @property
    def information(self) -> RobotInformation | None:
        """Information of the rows of all stations on the robot, without priors; None where it is
        not known.
        """
        return self.evidence.information

    @property
    def fit(self) -> ModelFit:
        """The fit: its problem, rows and solution.

        Raises:
            BadInputError: for a robot without them: from a file, of an update, or with one of
                several stations other than the first.
        """
        if not isinstance(self.evidence, FitEvidence):
            raise BadInputError(
                "this robot holds no fit, as one from a file, of an update, or at one of several "
                "stations; ask the robot that calibrate() returned, or calibrate again from the "
                "table"
            )
        return self.evidence.fit

    @property
    def problem(self) -> Problem:
        """Model and rows of all stations of the fit."""
        return self.fit.problem

    @property
    def solution(self) -> Solution:
        """Values, noise and weights of the fit, and how it ended."""
        return self.fit.solution

    @property
    def options(self) -> Options:
        """How the fit was made."""
        return self.fit.options

    @property
    def residuals(self) -> Table:
        """Reading minus prediction at each row of the fit, by the nominal and the calibrated robot.

        Of the nominal robot only base and tool are fitted. A row is a reading, or the mean of those
        of a pose; outliers, which the fit left out, are marked 1. Units stand in the headings.
        """
        return residual_table(self.fit)

    def explain(self) -> tuple[ParameterFinding, ...]:
        """Return for each parameter of the fit whether the readings identify it, and why not."""
        return explain(self.fit)

    def bootstrap(
        self, *, draws: int, seed: int = 0, executor: Executor | None = None
    ) -> np.ndarray:
        """Refit poses drawn with replacement, see :func:`pincal.identify.split.bootstrap`; return
        shape (draws, P).
        """
        return split.bootstrap(self.fit, draws=draws, seed=seed, executor=executor)

    def bootstrap_stations(
        self, *, draws: int, seed: int = 0, executor: Executor | None = None
    ) -> np.ndarray:
        """Refit stations drawn with replacement, see
        :func:`pincal.identify.split.bootstrap_stations`; return shape (draws, P).
        """
        return split.bootstrap_stations(self.fit, draws=draws, seed=seed, executor=executor)

    def monte_carlo(
        self, *, draws: int, seed: int = 0, executor: Executor | None = None
    ) -> np.ndarray:
        """Refit simulated readings, see :func:`pincal.identify.split.monte_carlo`; return shape
        (draws, P).
        """
        return split.monte_carlo(self.fit, draws=draws, seed=seed, executor=executor)

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood of the fitted readings without outliers, given the values and the
        noise.
        """
        return log_likelihood(self.fit)

    @property
    def aic(self) -> float:
        """Akaike's information criterion; a parameter counts as far as readings, not its prior,
        determine it.
        """
        return 2.0 * self.solution.effective - 2.0 * self.log_likelihood

    @property
    def bic(self) -> float:
        """Bayesian information criterion; parameters count as for :attr:`aic`."""
        n = int(self.problem.readings(self.solution.weights).sum())
        return float(self.solution.effective * np.log(n)) - 2.0 * self.log_likelihood

    def score(
        self, measurements: Measurements | str | os.PathLike[str], *, station: str | None = None
    ) -> float:
        """Return the mean log-likelihood per reading of other rows, given the values and the noise;
        larger is better.

        Args:
            measurements: the rows, or their file.
            station: their station, with its base, targets and noise; default: the only one.

        Raises:
            BadInputError: if there is no such station.
            MeasurementError: if the table can't be of this robot.
        """
        one = self.at(station)
        if not isinstance(measurements, Measurements):
            measurements = read_measurements(measurements, one.model.chain.robot)
        return score(self.fit, measurements, self.names.index(one.names[0]))

    # Rows

    def readings(self, measurements: Measurements) -> Station:
        """Return the model over measurements.

        Raises:
            MeasurementError: if they are of another kind than those of the calibration, or of
                unknown points.
        """
        if not self.reads(measurements):
            raise MeasurementError(
                f"{measurements.source}: measurements of kind {measurements.kind}; expected "
                f"{self.sensor_kind}, as this model was calibrated with"
            )
        rows = self.of_its_day(measurements)
        return station_of(self.model, rows, self.payload_centre, self.setup)

    def of_its_day(self, rows: _Rows) -> _Rows:
        """Return rows with the calibration's means of temperature, time and moves that effects need
        and they lack.
        """
        return of_its_day(self.station, rows)

    def reads(self, measurements: Measurements) -> bool:
        """Return whether it predicts measurements of this kind: its own, or any if it has no
        parameters of a sensor.
        """
        return self.station.reads(measurements)

    def conditions(self, measurements: Measurements) -> Conditions:
        """Return the conditions of a table's rows, with the payload's centre of mass that the
        calibration assumed.

        Raises:
            BadInputError: for a target that the model does not have.
        """
        return self.station.conditions(measurements)

    def conditions_at(
        self, q: ArrayLike, *, payload: float = 0.0, target: str | None = None
    ) -> Conditions:
        """Return the conditions of reported joint positions with a common payload [kg] and target.

        Joints that follow from others may be left out of ``q``.

        Raises:
            BadInputError: if the joint positions have another shape, or there is no such target.
        """
        return self.station.conditions_at(q, payload=payload, target=target)

    def outside(self, conditions: Conditions) -> list[Outside]:
        """Return, row by row, values beyond the range of the fitted rows, where the model is not
        validated.
        """
        return self.covered.outside(self.model.chain.robot, conditions)

    def fitting_options(self, **others: Any) -> Options:
        """Return the options of the calibration's station for another fit, with others."""
        x, y, z = map(float, self.payload_centre)
        return Options(payload_centre=(x, y, z), **{"setup": self.setup} | others)

    # Predictions

    @overload
    def predict(
        self,
        at: Conditions | Measurements | ArrayLike,
        *,
        payload: float = 0.0,
        target: str | None = None,
        return_sigma: Literal[False] = False,
    ) -> np.ndarray: ...

    @overload
    def predict(
        self,
        at: Conditions | Measurements | ArrayLike,
        *,
        payload: float = 0.0,
        target: str | None = None,
        return_sigma: Literal[True],
    ) -> tuple[np.ndarray, np.ndarray]: ...

    def predict(
        self,
        at: Conditions | Measurements | ArrayLike,
        *,
        payload: float = 0.0,
        target: str | None = None,
        return_sigma: bool = False,
    ) -> np.ndarray | tuple[np.ndarray, np.ndarray]:
        """Return the target's poses in the instrument's frame (of contacts: in the robot's base
        frame).

        Args:
            at: joint positions, shape (N, n) or (n,) [rad, prismatic m], or the conditions of N
                poses, for models that need temperature, time or the direction of approach. Missing
                temperatures and times are taken to be the means of the calibration's rows. Or a
                table, whose joints are matched by name, with its payloads and targets.
            payload: mass at the tip [kg]; only with joint positions.
            target: name of the target; default: the first one; only with joint positions.
            return_sigma: whether to also return the standard deviation of the position.

        Returns:
            Rotation and translation [m], shape (N, 3, 4), and with ``return_sigma`` the standard
            deviation of the position, shape (N, 3) [m], see :meth:`position_sigma`.

        Raises:
            BadInputError: if the joint positions have another shape, or there is no such target.
            MeasurementError: if the joints of a table are not the robot's, or their positions
                are impossible.
        """
        conditions = self.station.as_conditions(at, payload=payload, target=target)
        poses = self.model.predict(self.model_values, self.of_its_day(conditions))
        return (poses, self.position_sigma(conditions)) if return_sigma else poses

    def position_sigma(self, conditions: Conditions) -> np.ndarray:
        """Return the standard uncertainty of the predicted position, shape (N, 3) [m], in the
        instrument's axes, without measurement noise: the root of the sum of
        :meth:`position_variances`.
        """
        return np.asarray(np.sqrt(sum(self.position_variances(conditions).values())))

    def position_variances(self, conditions: Conditions) -> dict[str, np.ndarray]:
        """Return the variance of the predicted position by its sources, shape (N, 3) each [m^2], in
        the instrument's axes, without measurement noise.

        The sources are those of
        :class:`pincal.calibration.prediction_uncertainty.PredictionUncertainty`.
        """
        return self.uncertainty.variances(conditions)

    def turn_sigma(self, conditions: Conditions) -> np.ndarray:
        """Return the standard uncertainty of the predicted orientation, shape (N, 3) [rad], as a
        rotation vector in the instrument's axes, without measurement noise: the root of the sum of
        :meth:`turn_variances`.
        """
        return np.asarray(np.sqrt(sum(self.turn_variances(conditions).values())))

    def turn_variances(self, conditions: Conditions) -> dict[str, np.ndarray]:
        """Return the variance of the predicted orientation by its sources, shape (N, 3) each
        [rad^2], see :meth:`position_variances`.

        That of conditions is not known of orientations, and 0. Where the calibration read none,
        what the model lacks is that of its drives alone.
        """
        by_source = self.uncertainty.variances(conditions, turns=True)
        return {name: variance[:, 3:] for name, variance in by_source.items()}

    @property
    def uncertainty(self) -> PredictionUncertainty:
        """What is not known of the positions of the only station."""
        n = self.model.n_parameters
        return PredictionUncertainty(
            self.station, self.model_values, self.covariance[:n, :n], self.discrepancy
        )

    def positions_of(
        self,
        at: Conditions | Measurements | ArrayLike,
        point: ArrayLike,
        *,
        frame: Literal["base", "instrument"] = "base",
    ) -> np.ndarray:
        """Return positions of points fixed to the tip, such as what a sensor on the flange reads,
        shape (N, 3) [m].

        Args:
            at: N poses, as for :meth:`predict`.
            point: shape (3,) or (N, 3), in the tip's frame [m].
            frame: that of the robot's base, or of the instrument of the calibration.

        Raises:
            BadInputError: for joint positions or points of another shape.
        """
        carrier = self._carrier(frame)
        conditions = self.station.as_conditions(at)
        place = PointOnTip.given(point, None, len(conditions)).place
        poses = carrier.model.predict(carrier.model_values, carrier.of_its_day(conditions))
        return np.asarray(np.einsum("nij,nj->ni", poses[:, :, :3], place) + poses[:, :, 3])

    def covariance_of(
        self,
        at: Conditions | Measurements | ArrayLike,
        *,
        point: ArrayLike | None = None,
        point_covariance: ArrayLike | None = None,
        frame: Literal["base", "instrument"] = "instrument",
        stop: ArrayLike | None = None,
    ) -> PositionCovariance:
        """Return the covariance of predicted positions with each other, by its sources, without
        measurement noise.

        Near poses err alike: their difference is known better than each of them. What depends on
        conditions that are not recorded is taken to be common to all.

        Args:
            at: N poses, as for :meth:`predict`.
            point: shape (3,) or (N, 3), points fixed to the tip, in its frame [m], see
                :meth:`positions_of`; default: the target of the calibration, in the instrument's
                frame, or the tip, in that of the base.
            point_covariance: of a point common to all, shape (3, 3), or of one of each pose, shape
                (N, 3, 3), in the tip's frame [m^2]; default: the points are known.
            frame: whose axes the covariance has, and relative to which positions are: the robot's
                base, or the instrument of the calibration with the uncertainty of its place.
            stop: shape (N,), number of the stop of each row, in which the drives arrived once;
                default: equal joint positions are one stop.

        Raises:
            BadInputError: for joint positions, points, covariances or stops of another shape.
        """
        conditions = self.station.as_conditions(at)
        n = len(conditions)
        stops = None if stop is None else np.asarray(stop)
        if stops is not None and stops.shape != (n,):
            raise BadInputError(f"stops have shape {stops.shape}; expected ({n},), one per pose")
        if point is None and point_covariance is None and frame == "instrument":
            return self.uncertainty.covariance_of(conditions, stop=stops)
        on_tip = PointOnTip.given(np.zeros(3) if point is None else point, point_covariance, n)
        return self._carrier(frame).uncertainty.covariance_of(conditions, on_tip, stops)

    def _carrier(self, frame: Literal["base", "instrument"]) -> FittedRobot:
        """Return the robot with the pose of its tip as its prediction."""
        if frame == "base":
            return self.between()
        bare = self.with_effects(lambda effect: effect.locus.acts_on != "tool")
        chain = bare.model.chain
        tools = np.tile(np.eye(3), (len(chain.targets), 1, 1))
        chain = chain.with_references(chain.base_rotation, tools)
        return bare.with_model(
            bare.model.with_chain(chain), bare.estimate, nominal_values=bare.nominal_values
        )

    # The same robot otherwise

    def with_effects(self, is_kept: Callable[[Effect], bool]) -> FittedRobot:
        """Return the robot of one station without some effects, not refitted."""
        model = self.model
        gone = [effect for effect in model.effects if not is_kept(effect)]
        names = {p.name for effect in gone for p in effect.parameters(model.chain)}
        kept = np.array([name not in names for name in self.estimate.names], bool)
        effects = [effect for effect in model.effects if is_kept(effect)]
        nominal = None if self.nominal_values is None else self.nominal_values[kept]
        return self.with_model(
            model.with_effects(effects), self.estimate.drop(names), nominal_values=nominal
        )

    def with_model(
        self, model: Model, estimate: Estimate, *, nominal_values: np.ndarray | None = None
    ) -> FittedRobot:
        """Return the robot of one station with another model and the estimate of its parameters."""
        station = replace(self.station, model=model, parameter_names=estimate.names)
        return replace(self, stations=(station,), estimate=estimate, nominal_values=nominal_values)

    def between(self, start: str | None = None, tip: str | None = None) -> FittedRobot:
        """Return the robot with the pose of one of its links relative to another as its prediction,
        without any instrument or target.

        Args:
            start: the reference link; default: the robot's base.
            tip: the link; default: that of the calibration.

        Raises:
            RobotFileError: for an unknown link, or if a joint on the way is locked in this robot.
        """
        own = self.with_effects(lambda effect: effect.scope == "robot")
        chain = own.model.chain.between(
            start or own.model.chain.robot.base, tip or own.model.chain.path.tip
        )
        chain = chain.with_references(np.eye(3), np.tile(np.eye(3), (len(chain.targets), 1, 1)))
        return own.with_model(
            own.model.with_chain(chain), own.estimate, nominal_values=own.nominal_values
        )

    # Files

    def save(
        self, path: str | os.PathLike[str], *, provenance: dict[str, Any] | None = None
    ) -> None:
        """Write ``model.json``, from which :func:`pincal.load_model` returns the robot.

        Args:
            path: the file; an existing one is replaced only when the new one is complete.
            provenance: its origin, in JSON types; default: that of the robot.

        Raises:
            OutputError: if the file can't be written, or a number is not finite.
        """

        def made() -> ModelFile:
            return ModelFile.of_robot(
                self.stations,
                self.estimate,
                self.nominal_values,
                self.evidence,
                self.provenance if provenance is None else provenance,
                self.discrepancy,
                self.identity,
                self.statement,
            )

        write_model_file(path, made)

    @cached_property
    def without_urdf(self) -> str:
        """Why no URDF holds the calibrated arm: its loops do not close as one has them; empty where
        one does.

        The model predicts nevertheless.
        """
        if self.robot_model().model.chain.robot.linkage is None:
            return ""
        try:
            self.export_urdf()
        except RobotFileError as error:
            return str(error)
        return ""

    def export_urdf(self, path: str | os.PathLike[str] | None = None) -> UrdfExport:
        """Return the robot's URDF with the calibrated geometry, and write it to a file if one is
        named.

        Raises:
            RobotFileError: if the model has no URDF.
            OutputError: if the file can't be written.
        """
        found = self.robot_model()
        export = calibrated_urdf(found.model, found.values, comment=self.identity.machine)
        if path is not None:
            write_atomic(path, export.text)
        return export

    def to_pinocchio(self) -> pin.Model:
        """Return the robot's Pinocchio model with the calibrated geometry, without
        elastic effects.
        """
        found = self.robot_model()
        return pinocchio_model(found.model, found.model_values)

    def camera(self) -> dict[str, Any]:
        """Return the camera, as :func:`pincal.io.camera_file.read_camera` reads it from JSON.

        Raises:
            BadInputError: if the model was not calibrated with images.
        """
        found = camera_entries(self.estimate, self.model.chain.tool_rotations[0])
        if not found:
            raise BadInputError(
                f"this model was calibrated with {self.sensor_kind}, not with images: it "
                "has no camera"
            )
        return found


def load_model(path: str | os.PathLike[str]) -> FittedRobot:
    """Read ``model.json``.

    Raises:
        ModelFileError: if the file can't be read, is cut off or newer than this version, or a value
            is invalid.
    """
    file = read_model(path)
    return FittedRobot(
        file.fitted_stations(),
        file.estimate(),
        file.nominal_values,
        file.provenance,
        KeptEvidence(file.unmodelled, file.information),
        file.discrepancy,
        file.id or Identity(),
        file.statement,
    )
