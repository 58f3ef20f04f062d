"""A calibration of a robot from a table, as the object that a user works with."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from pincal.calibration.calibrated import Calibrated, CalibratedModel
from pincal.calibration.left import Left, left_by
from pincal.calibration.parameters import parameter_rows
from pincal.calibration.stations import CalibratedStations, save_stations
from pincal.calibration.tables import estimate_table, parameter_table
from pincal.errors import BadInputError
from pincal.identify import calibrate as identify
from pincal.identify import fit as identified
from pincal.identify.calibrate import Tables
from pincal.identify.options import Options
from pincal.measure.measurements import Measurements
from pincal.parameters import Estimate
from pincal.robot.robot import Robot
from pincal.tables import Table

log = logging.getLogger(__name__)


@dataclass(frozen=True, repr=False)
class Fit(identified.Fit, Calibrated):
    """A calibrated robot with all that the identification knows of it.

    It predicts and is saved and exported as a :class:`pincal.CalibratedModel` is; beside that it has problem and solution.
    """

    @classmethod
    def of(cls, found: identified.Fit) -> Fit:
        """Return what an identification found, with the methods of a calibrated model."""
        return cls(**{field.name: getattr(found, field.name) for field in fields(identified.Fit)})

    def __repr__(self) -> str:
        rms = float(np.sqrt(self.solution.cost))
        robot = self.problem.stations[0].model.chain.robot.name
        return f"Fit({robot!r}: {len(self.problem)} rows, residuals {rms:.3g} times the noise)"

    @cached_property
    def _calibrated(self) -> CalibratedModel:
        return CalibratedModel.of(self)

    @cached_property
    def left(self) -> Left | None:
        """Effects that the rows show and the model does not have; a diagnosis has to know of them."""
        return left_by(self)

    def to_model(self) -> CalibratedModel:
        """Return the calibrated model, all that a prediction or a diagnosis needs."""
        return replace(self._calibrated, left=self.left)

    def _predictor(self) -> CalibratedModel:
        return self._calibrated

    def to_stations(self) -> CalibratedStations:
        """Return what was found of all stations."""
        return self._stations.knowing(self.left)

    @property
    def _stations(self) -> CalibratedStations:
        return CalibratedStations.of(self)

    @property
    def robot_estimate(self) -> Estimate:
        """What is known of the robot's own parameters, whatever it was measured with: ``Options.earlier`` of a next fit."""
        return (self._stations if len(self.names) > 1 else self._calibrated).robot_estimate

    def at(self, station: str) -> CalibratedModel:
        """Return the calibrated model of one of several stations.

        Raises:
            BadInputError: if there is no such station.
        """
        return self.to_stations().at(station)

    def save(self, path: str | os.PathLike[str], *, provenance: dict[str, Any] | None = None) -> None:
        """Write ``model.json``, with all stations if there are several; see :func:`pincal.load_model`.

        Args:
            path: the file; an existing one is replaced only when the new one is complete.
            provenance: where it came from, in types that JSON knows.

        Raises:
            OutputError: if the place can't be written to, or a number is not finite.
        """
        if len(self.problem.stations) > 1:
            save_stations(path, replace(self.to_stations(), provenance=provenance or {}))
        else:
            replace(self.to_model(), provenance=provenance or {}).save(path)

    @property
    def models(self) -> Mapping[str, CalibratedModel]:
        """The calibrated model of each station by its name."""
        return self.to_stations().models

    def robot_model(self) -> CalibratedModel:
        """Return the model of the first station with all that the rows of all cover: the robot is the same in each."""
        return replace(self.robot_predictor(), left=self.left)

    def robot_predictor(self) -> CalibratedModel:
        """Return the same as far as it predicts: to find what it left takes about as long as the fit."""
        return self._stations.robot_model() if len(self.names) > 1 else self._calibrated

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the stations."""
        return tuple(station.name for station in self.problem.stations)

    @property
    def parameters(self) -> Table:
        """Value and standard deviation of each parameter; of one station also whether the data identify it, or why not."""
        return estimate_table(self.estimate) if len(self.names) > 1 else parameter_table(parameter_rows(self))

    def summary(self) -> str:
        """Return what was calibrated, whether the fit converged and what is left of the residuals."""
        state = "converged" if self.solution.converged else "did not converge"
        rank = self.solution.posterior.identifiable_rank
        return (
            f"{self.robot_predictor().summary()}\n{len(self.problem)} rows, {state} after {self.iterations} iterations; "
            f"identifiable rank {rank} of {int(self.solution.free.sum())}; noise {'; '.join(self._noise())}"
        )

    def _noise(self) -> Iterator[str]:
        """Yield the noise of each station's readings, with its name if there are several."""
        sigma = iter(self.solution.sigma)
        for station in self.problem.stations:
            sizes = ", ".join(f"{next(sigma):.3g} {block.unit}" for block in station.sensor.blocks)
            yield f"{station.name}: {sizes}" if len(self.names) > 1 else sizes


def calibrate(
    robot: Robot, measurements: Tables, options: Options | None = None, *, executor: Executor | None = None
) -> Fit:
    """Calibrate a robot from measured poses.

    Several tables are several stations: set-ups of an instrument and its targets, of the same kind or not. Each has base,
    targets and noise of its own, and all have the robot in common.

    Args:
        robot: the arm.
        measurements: training rows, one table or several, perhaps by the names of their stations; hold rows back before the
            call to validate on them.
        options: how to calibrate; defaults as documented there.
        executor: evaluates the stations side by side; default: one after the other.

    Returns:
        The fit, ready to predict; look at ``solution.converged``.

    Raises:
        MeasurementError: if the rows are too few to tell the parameters and the noise.

    Example:
        >>> from pincal.builtin import kuka_urdf_path
        >>> from pincal.measure.measurements import measurements_from_arrays
        >>> from pincal.model.effects import GEOMETRIC
        >>> from pincal.simulate import Instrument, TrueMachine
        >>> robot = Robot.from_urdf(kuka_urdf_path())
        >>> rng = np.random.default_rng(1)
        >>> machine = TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0")
        >>> machine = machine.draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3)
        >>> q = robot.random_configurations(60, rng)
        >>> columns = Instrument(targets=(0.1, 0.0, 0.2)).measure(machine, q)
        >>> position = np.column_stack([columns[c] for c in "xyz"])
        >>> table = measurements_from_arrays(robot.joint_names, q, position=position)
        >>> fit = calibrate(robot, table, Options(effects=GEOMETRIC))
        >>> bool(np.abs(fit.predict(q)[:, :, 3] - position).max() < 1e-9)
        True
    """
    return Fit.of(identify.calibrate(robot, measurements, options, executor=executor))


def calibrate_parts(robot: Robot, parts: Iterable[Measurements], options: Options | None = None) -> Fit:
    """Calibrate a robot from more rows than memory holds, one part of them at a time.

    Each part is fitted beside what those before it tell of the robot, see ``Options.earlier``, with base, targets and noise
    of its own, as if it were a station. Where parts are alike, as those of a table in random order, nothing is lost by that.

    Args:
        robot: the arm.
        parts: the rows, each part with enough of them to place instrument and targets.
        options: how to calibrate; what they leave open is decided by the first part.

    Returns:
        The fit of the last part, whose robot is that of all.

    Raises:
        BadInputError: without any part.
        MeasurementError: as :func:`calibrate`.

    Example::

        rows = (pincal.read_measurements(path, robot.joint_names, part=part) for part in pincal.row_parts(path))
        fit = pincal.calibrate_parts(robot, rows)
    """
    fit, rows = None, 0
    for k, part in enumerate(parts, 1):
        fit, rows = calibrate(robot, part, options), rows + len(part)
        options = replace(fit.options, earlier=fit.robot_estimate)
        log.info("part %d taken in, %d rows so far", k, rows)
    if fit is None:
        raise BadInputError("no rows to calibrate with; expected at least one part")
    return fit
