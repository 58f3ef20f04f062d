"""A calibrated robot as files hold it, with one station or more."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pincal.calibration.calibrated import Calibrated, CalibratedModel, estimate_at
from pincal.calibration.model_file import MeasuredEntry, ModelFile, StationsFile, read_model, write_model_file
from pincal.calibration.result_tables import estimate_table
from pincal.calibration.unmodelled import Unmodelled
from pincal.errors import ModelFileError
from pincal.identify.fit import ModelFit
from pincal.model.model import Model
from pincal.parameters import Estimate, estimate_of
from pincal.result_table import Table


@dataclass(frozen=True, repr=False)
class CalibratedRobot(Calibrated):
    """A calibrated robot as files hold it, with parameters common to its stations, one or more.

    Attributes:
        stations: the calibrated model of each station, by the station's name; of one alone under "".
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
        """Return what a fit found.

        Args:
            fit: the fit.
            provenance: its origin, in JSON types.
            left_by: returns the effects that it left.
        """
        names = [station.name for station in fit.problem.stations]
        models = {name: CalibratedModel.of(fit, provenance, station=name) for name in names}
        models[names[0]] = replace(models[names[0]], left_by=left_by)
        prior = np.array([parameter.size for parameter in fit.problem.parameters])
        return cls(models, replace(fit.estimate, prior=prior), fit.nominal.values, dict(provenance or {}))

    def __repr__(self) -> str:
        return f"CalibratedRobot({self.robot_model().model.chain.robot.name!r}: stations {' '.join(self.names)})"

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
            OutputError: if the place can't be written to, or a number is not finite.
        """
        if len(self.stations) == 1:
            return self.at().save(path)
        write_model_file(path, lambda: StationsFile.of_stations(self.stations, self.estimate, self.nominal_values))


def load_stations(path: str | os.PathLike[str]) -> CalibratedRobot:
    """Read ``model.json`` with one station, which then has no name, or several.

    Raises:
        ModelFileError: if the file can't be read, is cut off or newer than this version, or a value is invalid.
    """
    file = read_model(path)
    if isinstance(file, ModelFile):
        estimate = estimate_of([entry.parameter() for entry in file.parameters], file.values, file.covariance)
        known, origin = file.nominal_values, file.provenance
        only = _read(file, file.model.model(), estimate, nominal_values=known, provenance=origin)
        nominal = np.full(len(only.values), np.nan) if known is None else known
        return CalibratedRobot({"": only}, estimate, nominal, origin)
    parameters = tuple(entry.parameter() for entry in file.parameters)
    prior = np.array([parameter.size for parameter in parameters])
    estimate = Estimate(parameters, file.values, np.array(file.fitted, bool), file.covariance.covariance(), prior)
    models = {}
    for k, entry in enumerate(file.stations):
        model = file.model(k)
        local, places = estimate_at(estimate, entry.name, model)
        nominal = file.nominal_values[places]
        models[entry.name] = _read(entry, model, local, nominal_values=nominal, provenance=file.provenance)
    return CalibratedRobot(models, estimate, file.nominal_values, file.provenance)


def save_model(path: str | os.PathLike[str], calibrated: CalibratedModel) -> None:
    """Write ``model.json``; see :meth:`CalibratedModel.save`."""
    calibrated.save(path)


def load_model(path: str | os.PathLike[str]) -> CalibratedModel:
    """Read ``model.json`` of one station.

    Raises:
        ModelFileError: if the file can't be read, is cut off or newer than this version, or a value is invalid; or if it
            holds several stations.
    """
    found = load_stations(path)
    if len(found.stations) > 1:
        names = ", ".join(found.names)
        raise ModelFileError(
            f"{os.fspath(path)}: holds several stations: {names}; expected one: choose it by load_stations(path).at(name)"
        )
    return found.at()


def _read(
    entry: MeasuredEntry, model: Model, estimate: Estimate, *, nominal_values: np.ndarray | None, provenance: dict[str, Any]
) -> CalibratedModel:
    """Return the calibrated model of a station of a file; the others as they stand in :class:`CalibratedModel`."""
    measured = {name: getattr(entry, name) for name in MeasuredEntry.__struct_fields__ if name != "sensor_module"}
    found = measured | {"setup": entry.setup.setup(), "nominal_values": nominal_values, "provenance": provenance}
    return CalibratedModel(model=model, estimate=estimate, left_by=found.pop("left"), **found)
