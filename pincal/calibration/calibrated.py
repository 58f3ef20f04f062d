"""The calibrated model, which predicts, and its file ``model.json``."""

from __future__ import annotations

import html
import os
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike

from pincal.atomic import write_atomic
from pincal.calibration.covered import Covered
from pincal.calibration.model_file import ModelFile, write_model_file
from pincal.calibration.repeatability import Repeatability
from pincal.calibration.result_tables import estimate_table
from pincal.calibration.station_model import StationModel
from pincal.errors import BadInputError
from pincal.identify.fit import ModelFit
from pincal.identify.station import conditions_of, fingerprints, together
from pincal.io.urdf_export import UrdfExport, calibrated_urdf
from pincal.measure.admit import check_joints_of
from pincal.measure.measurements import Measurements
from pincal.model.augmented import pinocchio_model
from pincal.model.conditions import Conditions
from pincal.model.model import Model
from pincal.parameters import Estimate
from pincal.result_table import Table

if TYPE_CHECKING:
    import pinocchio as pin

# Rows per piece: with 60 parameters a piece is about 6 MB.
_PIECE = 4096


class Calibrated(ABC):
    """What can be done with a calibrated robot of one station or more, fitted or read
    from a file.
    """

    @property
    @abstractmethod
    def models(self) -> Mapping[str, CalibratedModel]:
        """The calibrated model of each station by its name, of a single one under ""."""

    @abstractmethod
    def save(self, path: str | os.PathLike[str]) -> None:
        """Write ``model.json``, from which :func:`pincal.load_model` returns the
        calibrated model.
        """

    @property
    @abstractmethod
    def parameters(self) -> Table:
        """The parameters with their standard deviations, as a table."""

    def summary(self) -> str:
        """Return the robot, its measurements and the number of fitted parameters, in words."""
        return self.robot_model().summary()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the stations."""
        return tuple(self.models)

    def at(self, station: str | None = None) -> CalibratedModel:
        """Return the calibrated model of a station; default: the only one.

        Raises:
            BadInputError: if there is no such station, or none is named and there are several.
        """
        names = self.names
        if station is None:
            if len(names) > 1:
                several = (
                    f"there are {len(names)}: {', '.join(names)}; choose one with fit.at(NAME)"
                )
                raise BadInputError(f"this needs a single station, and {several}")
            station = names[0]
        elif station not in names and names == ("",):
            raise BadInputError(
                f"station {station!r} is not in the model, which was calibrated at a "
                "single one; omit the name"
            )
        elif station not in names:
            raise BadInputError(
                f"station {station!r} is not in the model; expected one of {', '.join(names)}"
            )
        return self.models[station]

    def to_model(self) -> CalibratedModel:
        """Return the calibrated model of the only station."""
        return self.at()

    def robot_model(self, kind: str | None = None) -> CalibratedModel:
        """Return the model of the first station, with the coverage of all stations, which share the
        robot.

        Args:
            kind: kind of sensor; the first station with such a sensor is taken, if there is any.
        """
        models = self.models.values()
        first = next((model for model in models if model.sensor_kind == kind), next(iter(models)))
        others = [model for model in models if model is not first]
        covered = first.covered
        for other in others:
            covered = covered.over(other.covered)
        rows = together(first.rows, *(other.rows for other in others))
        return replace(first, covered=covered, rows=rows) if others else first

    @property
    def robot_estimate(self) -> Estimate:
        """The estimate of the robot's own parameters: ``Options.earlier`` of a further fit."""
        first = next(iter(self.models.values()))
        effects = (effect for effect in first.model.effects if effect.scope == "robot")
        return first.estimate.take(
            p.name for effect in effects for p in effect.parameters(first.model.chain)
        )

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
        found = self.at()
        if isinstance(at, Measurements):
            robot = found.model.chain.robot
            table = at.in_order_of(robot)
            check_joints_of(robot, table)
            conditions = conditions_of(found.model, table, found.payload_centre)
        elif isinstance(at, Conditions):
            conditions = at
        else:
            conditions = found.conditions_at(at, payload=payload, target=target)
        poses = found.model.predict(found.model_values, found.of_its_day(conditions))
        return (poses, self.position_sigma(conditions)) if return_sigma else poses

    def position_sigma(self, conditions: Conditions) -> np.ndarray:
        r"""Return the standard deviation of the predicted position, shape (N, 3) [m], in the
        instrument's axes.

        :math:`\sqrt{\mathrm{diag}(J C J^T)}`, the uncertainty of the calibration, without
          measurement noise; plus, where an
        effect depends on a temperature or time that the conditions lack, its variation over the
        calibration's rows.
        """
        found = self.at()
        lacking = found.unrecorded(conditions)
        conditions = found.of_its_day(conditions)
        n = found.model.n_parameters
        out = np.empty((len(conditions), 3))
        for start in range(0, len(conditions), _PIECE):
            rows = slice(start, start + _PIECE)
            _, J = found.model.linearise(found.model_values, conditions.select(rows))
            out[rows] = np.einsum("nip,nip->ni", J @ found.covariance[:n, :n], J)
        unknown = [found.varied_by(effect, conditions) ** 2 for effect in lacking]
        return np.asarray(np.sqrt(np.maximum(out, 0.0) + sum(unknown)))

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the values, shape (P, P); zero rows and columns for parameters that were
        not fitted.
        """
        return self.at().dense_covariance

    def export_urdf(self, path: str | os.PathLike[str] | None = None) -> UrdfExport:
        """Return the robot's URDF with the calibrated geometry, and write it to a file if one is
        named.

        Raises:
            RobotFileError: if the model has no URDF.
            OutputError: if the file can't be written.
        """
        found = self.robot_model()
        export = calibrated_urdf(found.model, found.values)
        if path is not None:
            write_atomic(path, export.text)
        return export

    def to_pinocchio(self) -> pin.Model:
        """Return the robot's Pinocchio model with the calibrated geometry, without
        elastic effects.
        """
        found = self.robot_model()
        return pinocchio_model(found.model, found.model_values)

    def _repr_html_(self) -> str:
        lines = "<br>".join(html.escape(line) for line in self.summary().splitlines())
        return f"<p>{lines}</p>{self.parameters._repr_html_()}"


@dataclass(frozen=True, repr=False)
class CalibratedModel(StationModel, Calibrated):
    """A calibrated robot, ready to predict; its attributes are those of :class:`StationModel`.

    Example:
        >>> from pincal import Chain, Robot
        >>> from pincal.parameters import estimate_of
        >>> model = Model(Chain.of(Robot.from_urdf("ur10")), ())
        >>> covered = Covered(np.tile([-1.0, 1.0], (6, 1)), np.array([0.0, 5.0]))
        >>> nothing = estimate_of((), np.zeros(0), np.zeros((0, 0)))
        >>> ur10 = CalibratedModel(model, nothing, "position", np.zeros(3), covered, np.array([1e-4]), {})
        >>> ur10.outside(Conditions.at(np.zeros((1, 6)), payload=8.0))
        [Outside(row=0, name='payload', value=8.0, lower=0.0, upper=5.0)]
        >>> ur10.predict(np.zeros(6)).shape, ur10
        ((1, 3, 4), CalibratedModel('ur10': 0 parameters, position))
    """

    @classmethod
    def of(
        cls, fit: ModelFit, provenance: dict[str, Any] | None = None, *, station: str | None = None
    ) -> CalibratedModel:
        """Return the calibrated model of a fit.

        Args:
            fit: the fit.
            provenance: its origin, in JSON types.
            station: name of the station; default: the only one.

        Raises:
            BadInputError: if no station is named and there are several.
        """
        name = fit.station.name if station is None else station
        k = [found.name for found in fit.problem.stations].index(name)
        at = fit.problem.stations[k]
        options = fit.options.at(name)
        own = tuple(fit.problem.parameters[i].name for i in fit.problem.places[k])
        # Stations that share only the robot need no list of names.
        table_names = own if at.shares_setup else ()
        scatter = fit.scatter.get(name)
        estimate, places = estimate_at(fit.estimate, name, at.model, own)
        return cls(
            model=at.model,
            estimate=replace(
                estimate, prior=np.array([parameter.size for parameter in estimate.parameters])
            ),
            sensor_kind=at.sensor.kind,
            payload_centre=np.array(options.payload_centre, float),
            covered=Covered.of(at.conditions),
            sigma=np.array(fit.solution.sigma[fit.problem.block_spans[k]], float),
            provenance=dict(provenance or {}),
            setup=options.setup,
            nominal_values=fit.nominal.values[places],
            rows=fingerprints(at),
            is_noise_declared=options.sigma is not None,
            table_names=table_names,
            repeatability=None if scatter is None else Repeatability.of(scatter),
        )

    def __repr__(self) -> str:
        robot = self.model.chain.robot.name
        return f"CalibratedModel({robot!r}: {len(self.estimate)} parameters, {self.sensor_kind})"

    @property
    def models(self) -> Mapping[str, CalibratedModel]:
        """The model itself."""
        return {"": self}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write ``model.json``: the whole file or nothing, its numbers in full precision.

        Args:
            path: the file; an existing one is replaced only when the new one is complete.

        Raises:
            OutputError: if the file can't be written, or a number is not finite.
        """
        write_model_file(path, lambda: ModelFile.of_model(self))

    @property
    def parameters(self) -> Table:
        """Value and standard deviation of each parameter."""
        return estimate_table(self.estimate)

    def summary(self) -> str:
        """Return the robot, its measurements and the number of fitted parameters, in words."""
        robot = self.model.chain.robot
        effects = ", ".join(dict.fromkeys(effect.name for effect in self.model.effects))
        return (
            f"{robot.name}, {robot.n_joints} joints from {robot.base} to {robot.tip}, "
            f"calibrated with {self.sensor_kind} "
            f"measurements\n{int(self.estimate.free.sum())} of {len(self.estimate)} "
            f"parameters fitted: {effects}"
        )


def estimate_at(
    estimate: Estimate, station: str, model: Model, names: Sequence[str] = ()
) -> tuple[Estimate, np.ndarray]:
    """Return the estimate of one station's parameters by their names within it, and their indices
    among all, shape (P,).

    Args:
        estimate: of all parameters.
        station: name of the station.
        model: its model.
        names: of its parameters among all; default: the robot's, and ``STATION/NAME``.
    """
    if not names:
        of_sensor = [p.name for p in estimate.parameters if p.station == station]
        of_model = [
            f"{station}/{n}" if f"{station}/{n}" in estimate.names else n for n in model.names
        ]
        names = [*of_model, *(n for n in of_sensor if n not in of_model)]
    found = estimate.take(names)
    local = tuple(replace(p, name=p.local_name, station="") for p in found.parameters)
    return replace(found, parameters=local), estimate.places(names)
