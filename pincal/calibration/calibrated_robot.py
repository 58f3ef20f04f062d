"""A calibrated robot with one station or more, read from a file or fitted to tables."""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from pincal.calibration.agreed import AgreedFit, fit_agreed
from pincal.calibration.calibrated import Calibrated, CalibratedModel, estimate_at
from pincal.calibration.information import RobotInformation
from pincal.calibration.model_file import (
    MeasuredEntry,
    ModelFile,
    StationsFile,
    read_model,
    write_model_file,
)
from pincal.calibration.result_tables import (
    estimate_table,
    parameter_rows,
    parameter_table,
    residual_table,
)
from pincal.calibration.unmodelled import Unmodelled, unmodelled_by
from pincal.errors import BadInputError, ModelFileError, warn
from pincal.identify import calibrate as identify
from pincal.identify import fit as identified
from pincal.identify.calibrate import Tables, tables_of
from pincal.identify.fit import ModelFit
from pincal.identify.options import Options
from pincal.identify.station import Station
from pincal.measure.admit import admit, admit_test, check_table
from pincal.measure.measurements import Measurements
from pincal.measure.table import read_measurements, stations_of
from pincal.model.model import Model
from pincal.motion.sessions import Session, joints_of_session, read_session
from pincal.motion.stations import session_tables
from pincal.parameters import Estimate, estimate_of
from pincal.result_table import Table
from pincal.robot.robot import Robot
from pincal.units import format_readable


@dataclass(frozen=True, repr=False)
class CalibratedRobot(Calibrated):
    """A calibrated robot as stored in files, with one station or more.

    Attributes:
        stations: the calibrated model of each station, by the station's name, of a single one under
            "".
        estimate: the robot's parameters, then those of each station under its name.
        nominal_values: shape (P,), the values with only base and tool fitted.
        provenance: version of pincal, time, input files with their SHA-256, command and seed.
    """

    stations: Mapping[str, CalibratedModel]
    estimate: Estimate
    nominal_values: np.ndarray
    provenance: dict[str, Any]

    @classmethod
    def of(
        cls,
        fit: ModelFit,
        provenance: dict[str, Any] | None = None,
        *,
        left_by: Callable[[], Unmodelled | None] | None = None,
    ) -> CalibratedRobot:
        """Return the calibrated robot of a fit."""
        names = [station.name for station in fit.problem.stations]
        models = {name: CalibratedModel.of(fit, provenance, station=name) for name in names}
        models[names[0]] = replace(
            models[names[0]], left_by=left_by, information_by=partial(RobotInformation.of, fit)
        )
        prior = np.array([parameter.size for parameter in fit.problem.parameters])
        return cls(
            models, replace(fit.estimate, prior=prior), fit.nominal.values, dict(provenance or {})
        )

    def __repr__(self) -> str:
        return (
            f"CalibratedRobot({self.robot_model().model.chain.robot.name!r}: stations "
            f"{' '.join(self.names)})"
        )

    @property
    def models(self) -> Mapping[str, CalibratedModel]:
        """The stations."""
        return self.stations

    @property
    def parameters(self) -> Table:
        """Value and standard deviation of each parameter."""
        return estimate_table(self.estimate)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write ``model.json``: the whole file or nothing, its numbers in full precision.

        Raises:
            OutputError: if the file can't be written, or a number is not finite.
        """
        if len(self.stations) == 1:
            return self.at().save(path)
        write_model_file(
            path,
            lambda: StationsFile.of_stations(self.stations, self.estimate, self.nominal_values),
        )


def load_stations(path: str | os.PathLike[str]) -> CalibratedRobot:
    """Read ``model.json`` with one station, then without a name, or several.

    Raises:
        ModelFileError: if the file can't be read, is cut off or newer than this version, or a value
            is invalid.
    """
    file = read_model(path)
    if isinstance(file, ModelFile):
        estimate = estimate_of(
            [entry.parameter() for entry in file.parameters], file.values, file.covariance
        )
        known = file.nominal_values
        origin = file.provenance
        only = _read(file, file.model.model(), estimate, nominal_values=known, provenance=origin)
        nominal = np.full(len(only.values), np.nan) if known is None else known
        return CalibratedRobot({"": only}, estimate, nominal, origin)
    parameters = tuple(entry.parameter() for entry in file.parameters)
    prior = np.array([parameter.size for parameter in parameters])
    estimate = Estimate(
        parameters, file.values, np.array(file.fitted, bool), file.covariance.covariance(), prior
    )
    models = {}
    for k, entry in enumerate(file.stations):
        model = file.model(k)
        local, places = estimate_at(estimate, entry.name, model, entry.table_names)
        nominal = file.nominal_values[places]
        models[entry.name] = _read(
            entry, model, local, nominal_values=nominal, provenance=file.provenance
        )
    return CalibratedRobot(models, estimate, file.nominal_values, file.provenance)


def save_model(path: str | os.PathLike[str], calibrated: CalibratedModel) -> None:
    """Write ``model.json``; see :meth:`CalibratedModel.save`."""
    calibrated.save(path)


def load_model(path: str | os.PathLike[str]) -> CalibratedModel:
    """Read ``model.json`` of one station.

    Raises:
        ModelFileError: as for :func:`load_stations`, and if it holds several stations.
    """
    found = load_stations(path)
    if len(found.stations) > 1:
        names = ", ".join(found.names)
        raise ModelFileError(
            f"{os.fspath(path)}: holds several stations: {names}; expected one: choose it "
            "by load_stations(path).at(name)"
        )
    return found.at()


def _read(
    entry: MeasuredEntry,
    model: Model,
    estimate: Estimate,
    *,
    nominal_values: np.ndarray | None,
    provenance: dict[str, Any],
) -> CalibratedModel:
    """Return the calibrated model of a station of a file."""
    measured = {
        name: getattr(entry, name)
        for name in MeasuredEntry.__struct_fields__
        if name != "sensor_module"
    }
    found = measured | {
        "setup": entry.setup.setup(),
        "nominal_values": nominal_values,
        "provenance": provenance,
    }
    return CalibratedModel(
        model=model,
        estimate=estimate,
        left_by=found.pop("left"),
        information_by=found.pop("information"),
        **found,
    )


log = logging.getLogger(__name__)

File = str | os.PathLike[str]
Files = File | Sequence[File] | Mapping[str, File]
# Stations whose noise stands in one line.
_NAMED_STATIONS = 3


@dataclass(frozen=True, repr=False)
class Fit(identified.ModelFit, Calibrated):
    """A calibrated robot with its problem and solution; otherwise used like a
    :class:`pincal.CalibratedModel`.
    """

    @classmethod
    def of(cls, found: identified.ModelFit) -> Fit:
        """Return an identified fit with the methods of a calibrated model."""
        return cls(
            **{field.name: getattr(found, field.name) for field in fields(identified.ModelFit)}
        )

    def __repr__(self) -> str:
        robot = self.problem.stations[0].model.chain.robot.name
        noise = list(self._noise())
        if len(noise) > _NAMED_STATIONS:
            noise = [*noise[:_NAMED_STATIONS], f"and {len(noise) - _NAMED_STATIONS} more stations"]
        return f"Fit({robot!r}: {len(self.problem)} rows, noise {'; '.join(noise)})"

    @cached_property
    def left(self) -> Unmodelled | None:
        """Effects present in the rows but not in the model, for a diagnosis."""
        return unmodelled_by(self)

    def _robot(self, provenance: dict[str, Any] | None = None) -> CalibratedRobot:
        return CalibratedRobot.of(self, provenance, left_by=partial(getattr, self, "left"))

    @cached_property
    def models(self) -> Mapping[str, CalibratedModel]:
        """The calibrated model of each station by its name, of a single one under ""."""
        return self._robot().stations

    def save(
        self, path: str | os.PathLike[str], *, provenance: dict[str, Any] | None = None
    ) -> None:
        """Write ``model.json``, with all stations if there are several; see
        :func:`pincal.load_model`.

        Args:
            path: the file; an existing one is replaced only when the new one is complete.
            provenance: its origin, in JSON types.

        Raises:
            OutputError: if the file can't be written, or a number is not finite.
        """
        self._robot(provenance).save(path)

    def information(self) -> RobotInformation:
        """Return the information of the rows on the robot, with base, targets and instrument
        eliminated.
        """
        return RobotInformation.of(self)

    def to_stations(self) -> CalibratedRobot:
        """Return the robot with its stations; deprecated, as a fit has them itself."""
        warnings.warn(
            "fit.to_stations() is the fit itself: fit.models, fit.at(NAME)",
            DeprecationWarning,
            stacklevel=2,
        )
        return self._robot()

    @cached_property
    def log_likelihood(self) -> float:
        """Log-likelihood of the readings, without outliers, given the values and the noise."""
        weights = [self.solution.weights[rows] for rows in self.problem.rows]
        return float(
            sum(map(self._log_density, range(len(weights)), self.problem.stations, weights))
        )

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
        self, measurements: Measurements | str | os.PathLike[str], *, station: str = ""
    ) -> float:
        """Return the mean log-likelihood per reading of other rows, given the values and the noise;
        larger is better.

        Args:
            measurements: the rows, or their file.
            station: their station, with its base, targets and noise, if the fit is of several.
        """
        robot = self.problem.chain.robot
        table = _tables(robot, measurements)
        if not isinstance(table, Measurements):
            raise BadInputError(
                f"{len(table)} tables; expected one, which is scored at one station"
            )
        table = admit_test(robot, table, self.options.at(station).setup)
        rows = self.readings(table, station=station)
        k = self.names.index(station)
        return self._log_density(k, rows, np.ones(len(table))) / (len(table) * rows.reading_size)

    def _log_density(self, k: int, rows: Station, weights: np.ndarray) -> float:
        """Return the log-likelihood of rows at the k-th station, with robust weights of shape (N,),
        0 for outliers.
        """
        sigma = np.repeat(self.solution.sigma[self.problem.block_spans[k]], rows.block_sizes)[
            :, None
        ]
        residuals = rows.whitened(rows.residuals(self.values[self.problem.places[k]])) * (
            scale := rows.weights / sigma
        )
        counted = weights > 0.0
        # The covariance of correlated noise has another determinant than that of white noise.
        constant = float(np.sum(np.log(2.0 * np.pi / scale[:, counted] ** 2)))
        constant += 0.0 if rows.serial is None else rows.serial.log_determinant
        constant += 0.0 if rows.arrival is None else rows.arrival.log_determinant
        return -0.5 * (float(np.sum(residuals[:, counted] ** 2)) + constant)

    @property
    def parameters(self) -> Table:
        """Value and standard deviation of each parameter; of one station also status and reason."""
        return (
            estimate_table(self.estimate)
            if len(self.names) > 1
            else parameter_table(parameter_rows(self))
        )

    @property
    def residuals(self) -> Table:
        """Reading minus prediction at each row of the fit, by the nominal and the calibrated robot.

        Of the nominal robot only base and tool are fitted. A row is a reading, or the mean of those
        of a pose; outliers, which the fit left out, are marked 1. Units stand in the headings.
        """
        return residual_table(self)

    def summary(self) -> str:
        """Return the robot, the convergence of the fit and its residuals, in words."""
        state = "converged" if self.solution.converged else "did not converge"
        rank = self.solution.posterior.identifiable_rank
        return (
            f"{super().summary()}\n{len(self.problem)} rows, {state} after "
            f"{self.iterations} iterations; "
            f"{rank} combinations of {int(self.solution.free.sum())} parameters "
            f"determined; noise {'; '.join(self._noise())}"
        )

    def _noise(self) -> Iterator[str]:
        """Yield the noise of each station's residuals, with its name if there are several."""
        for station, _, blocks in super().stations:
            estimated = self.solution.estimated[blocks]
            blocks_of = zip(estimated.tolist(), station.sensor.blocks, strict=True)
            words = ", ".join(format_readable(size, block.unit) for size, block in blocks_of)
            yield f"{station.name}: {words}" if len(self.names) > 1 else words


def calibrate(
    robot: Robot,
    measurements: Tables | Files,
    options: Options | None = None,
    *,
    executor: Executor | None = None,
) -> Fit:
    """Calibrate a robot from measured poses.

    The rows are checked as ``pincal calibrate`` checks them: tables in another unit, with mixed-up
    columns or of another robot are refused. Joints are matched by name. Where the readings show
    that a joint has another sign or zero than described, the fit is of the robot so corrected
    (``fit.problem.chain.robot``), and a warning says so.

    Several tables are several stations: set-ups of an instrument and its targets, of the same kind
    or not. Each has its own base, targets and noise, and all share the robot.

    Args:
        robot: the arm.
        measurements: training rows, one table or several, optionally by the names of their
            stations, or their files; hold rows out before the call to validate on them.
        options: how to calibrate; defaults as documented there.
        executor: evaluates the stations in parallel; default: sequentially.

    Returns:
        The fit, ready to predict; check ``solution.converged``.

    Raises:
        MeasurementError: if the rows are too few to determine the parameters and the noise, their
            joints are not the robot's, or they can't be of this robot.

    Warns:
        PincalWarning: of rows left out, unlikely values and corrections of the robot's description.

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
    return Fit.of(_checked(robot, measurements, options, executor=executor).fit)


def _checked(
    robot: Robot,
    measurements: Tables | Files,
    options: Options | None,
    *,
    executor: Executor | None = None,
) -> AgreedFit:
    """Return the fit of a robot with the checks of :func:`calibrate`."""
    options = Options() if options is None else options
    tables = tables_of(_tables(robot, measurements))
    admitted = admit(robot, tables, lambda name: options.at(name).setup)
    agreed = fit_agreed(robot, admitted.tables, options, executor=executor)
    for text in (*admitted.notes, *admitted.idle, *agreed.notes):
        warn(text)
    return agreed


def fitted(robot: Robot, measurements: Tables | Files, options: Options | None = None) -> Fit:
    """Return the fit of rows that were checked before, without the checks of :func:`calibrate`."""
    rows = tables_of(_tables(robot, measurements))
    in_order = {name: table.in_order_of(robot) for name, table in rows.items()}
    return Fit.of(identify.fit_tables(robot, in_order, options))


def _tables(robot: Robot, measurements: Tables | Files) -> Tables:
    """Return the tables of this robot, reading files; several files are stations named
    after them.
    """
    several = (
        [measurements]
        if isinstance(measurements, Measurements | str | os.PathLike)
        else measurements
    )
    named = isinstance(several, Mapping)
    tables = list[tuple[str, Measurements]]()
    sessions = list[Session]()
    for name, of in (
        several.items() if isinstance(several, Mapping) else (("", of) for of in several)
    ):
        if isinstance(of, Measurements):
            tables.append((name or f"station_{len(tables) + 1}", of))
        elif joints_of_session(of) is not None:
            session = read_session(robot, of)
            sessions.append(replace(session, name=name or session.name))
        else:
            tables.append((name or Path(of).stem, read_measurements(of, robot)))
    tables += session_tables(robot, sessions).items()
    return stations_of(tables) if named or len(tables) > 1 else tables[0][1]


def calibrate_parts(
    robot: Robot, parts: Iterable[Measurements], options: Options | None = None
) -> Fit:
    """Calibrate a robot from more rows than memory holds, one part of them at a time.

    Each part is fitted with the information of the previous ones, see ``Options.earlier``, with its
    own base, targets and noise, as a station. Where parts are similar, as parts of a table in
    random order are, no accuracy is lost.

    Args:
        robot: the arm.
        parts: the rows, each part with enough of them to place instrument and targets.
        options: how to calibrate; automatic choices are made with the first part.

    Returns:
        The fit of the last part, with the robot identified from all.

    Raises:
        BadInputError: without any part.
        MeasurementError: as :func:`calibrate`.

    Example::

        rows = (pincal.read_measurements(path, robot.joint_names, part=part) for part in
        pincal.row_parts(path)) fit = pincal.calibrate_parts(robot, rows)
    """
    fit = None
    rows = 0
    for k, part in enumerate(parts, 1):
        if fit is None:
            agreed = _checked(robot, part, options)
            robot = agreed.robot
            fit = Fit.of(agreed.fit)
        else:
            # What the first part shows of the robot's description holds for all.
            check_table(robot, part.in_order_of(robot))
            fit = fitted(robot, part, options)
        rows += len(part)
        options = replace(fit.options, earlier=fit.robot_estimate)
        log.info("part %d fitted, %d rows so far", k, rows)
    if fit is None:
        raise BadInputError("no rows to calibrate with; expected at least one part")
    return fit
