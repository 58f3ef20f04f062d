"""A station at which a robot was fitted: its model, set-up and noise, what its rows covered, and
the conditions of other rows there.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from pincal.calibration.covered import Covered
from pincal.calibration.repeatability import Repeatability
from pincal.errors import BadInputError
from pincal.identify.fit import ModelFit
from pincal.identify.station import conditions_of, fingerprints
from pincal.identify.stop_scatter import ScatterOfStations
from pincal.measure.admit import check_joints_of
from pincal.measure.measurements import Measurements
from pincal.model.conditions import Conditions
from pincal.model.model import Model
from pincal.parameters import FRAME_SYMBOLS
from pincal.sensors.setup import Setup
from pincal.units import real_array


@dataclass(frozen=True, eq=False)
class RepeatabilityInFit:
    """Repeatability of the readings of a station of a fit, worked out when it is asked for.

    Attributes:
        scatter: of the stations of the fit.
        name: of the station.
    """

    scatter: ScatterOfStations
    name: str

    @cached_property
    def found(self) -> Repeatability | None:
        """The repeatability; None where nothing was repeated."""
        scatter = self.scatter.get(self.name)
        return None if scatter is None else Repeatability.of(scatter)


@dataclass(frozen=True)
class FittedStation:
    """One set-up of instrument and targets at which a fitted robot was measured.

    Attributes:
        name: of the station; "" for a single one without a name.
        model: the robot's chain and effects, and those of this station.
        parameter_names: the model's parameters and then the sensor's own, by their names among all
            of the robot.
        sensor_kind: what was measured: "position", "pose", "distance" and so on.
        payload_centre: shape (3,), centre of mass of the payload in the tip frame [m].
        covered: the range of the fitted rows.
        sigma: shape (blocks,), noise of one component of each block of readings that the fit used
            [m, rad, px]; where rows are weighted by the visits behind them, at least that of their
            residuals.
        setup: named points and the camera.
        rows: fingerprints of the fitted rows; empty where unknown.
        is_noise_declared: whether the noise was declared, not estimated.
        repeated: repeatability of the readings within a stop and of stops at a pose, or how to find
            it; None where nothing was repeated, or unknown.
    """

    name: str
    model: Model
    parameter_names: tuple[str, ...]
    sensor_kind: str
    payload_centre: np.ndarray
    covered: Covered
    sigma: np.ndarray
    setup: Setup = field(default_factory=Setup)
    rows: str = ""
    is_noise_declared: bool = False
    repeated: Repeatability | RepeatabilityInFit | None = None

    @classmethod
    def of(cls, fit: ModelFit, k: int) -> FittedStation:
        """Return the k-th station of a fit."""
        problem = fit.problem
        at = problem.stations[k]
        options = fit.options.at(at.name)
        blocks = problem.block_spans[k]
        sigma = np.array(fit.solution.sigma[blocks], float)
        if at.name in fit.scatter.of_single:
            # The noise of a visit: a declared one is that of the instrument alone, and the arrival
            # of the drives shows in the residuals, also where they do not exceed it significantly.
            sigma = np.maximum(sigma, fit.solution.estimated[blocks])
        return cls(
            name=at.name,
            model=at.model,
            parameter_names=tuple(problem.parameters[i].name for i in problem.places[k]),
            sensor_kind=at.sensor.kind,
            payload_centre=np.array(options.payload_centre, float),
            covered=Covered.of(at.conditions),
            sigma=sigma,
            setup=options.setup,
            rows=fingerprints(at),
            is_noise_declared=options.sigma is not None,
            repeated=RepeatabilityInFit(fit.scatter, at.name),
        )

    @property
    def repeatability(self) -> Repeatability | None:
        """Of the readings within a stop and of stops at a pose; None where nothing was repeated, or
        unknown.
        """
        of = self.repeated
        return of.found if isinstance(of, RepeatabilityInFit) else of

    @property
    def is_placed(self) -> bool:
        """Whether readings tell where the base stands in the instrument's frame, and how it is
        turned; if not, as of contacts, distances or an IMU, positions are known relative to each
        other only.
        """
        chain = self.model.chain
        bases = (effect for effect in self.model.effects if effect.locus.acts_on == "base")
        return all(len(base.parameters(chain)) == len(FRAME_SYMBOLS) for base in bases)

    def reads(self, measurements: Measurements) -> bool:
        """Return whether measurements of this kind are predicted: the station's own, or any if it
        has no parameters of a sensor.
        """
        has_own = bool(self.setup.points) or len(self.parameter_names) > self.model.n_parameters
        return not has_own or self.sensor_kind == measurements.kind

    def as_conditions(
        self,
        at: Conditions | Measurements | ArrayLike,
        *,
        payload: float = 0.0,
        target: str | None = None,
    ) -> Conditions:
        """Return the conditions of N poses: as they are given, of a table of this robot, whose
        joints are matched by name, or of joint positions.

        Args:
            at: the poses; joint positions as for :meth:`conditions_at`.
            payload: mass at the tip [kg]; only with joint positions.
            target: name of the target; likewise.

        Raises:
            BadInputError: if the joint positions have another shape, or there is no such target.
            MeasurementError: if the joints of a table are not the robot's, or their positions
                are impossible.
        """
        if isinstance(at, Measurements):
            robot = self.model.chain.robot
            table = at.in_order_of(robot)
            check_joints_of(robot, table)
            return self.conditions(table)
        if isinstance(at, Conditions):
            return at
        return self.conditions_at(at, payload=payload, target=target)

    def conditions(self, table: Measurements) -> Conditions:
        """Return the conditions of a table's rows, with the station's centre of mass of the
        payload.

        Raises:
            BadInputError: for a target that the model does not have.
        """
        return conditions_of(self.model, table, np.array(self.payload_centre))

    def conditions_at(
        self, q: ArrayLike, *, payload: float = 0.0, target: str | None = None
    ) -> Conditions:
        """Return the conditions of reported joint positions, shape (N, n) or (n,) [rad, prismatic
        m], with a common payload [kg] and target; without one the first.

        Raises:
            BadInputError: if the joint positions have another shape, or there is no such target.
        """
        positions = np.atleast_2d(real_array(q, "joint positions"))
        robot = self.model.chain.robot
        n = robot.n_joints
        if robot.dependent and positions.ndim == 2 and positions.shape[1] == len(robot.own_joints):
            positions = robot.spread(positions)
        if positions.ndim != 2 or positions.shape[1] != n:
            raise BadInputError(
                f"joint positions have shape {np.shape(q)}; expected (N, {n}), one row per pose"
            )
        targets = self.model.chain.targets
        if target is not None and target not in targets:
            raise BadInputError(
                f"target {target!r} is not in the model; expected one of {', '.join(targets)}"
            )
        found = Conditions.at(
            robot.from_reported(positions), payload=payload, payload_centre=self.payload_centre
        )
        number = 0 if target is None else targets.index(target)
        return replace(found, target=np.full(len(positions), number))
