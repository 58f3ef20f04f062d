"""A robot calibrated at several stations at once: its own parameters are common, each station is a model to predict with."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pincal.calibration.calibrated import CalibratedModel, estimate_at, model_of_file
from pincal.calibration.left import Left
from pincal.errors import BadInputError
from pincal.identify.fingerprints import together
from pincal.identify.fit import Fit
from pincal.io.entries import ChainEntry, ParameterEntry, RobotEntry
from pincal.io.model_file import (
    STATIONS_VERSION,
    CovarianceEntry,
    ModelFile,
    StationEntry,
    StationsFile,
    read_model,
    write_model_file,
)
from pincal.parameters import Estimate


@dataclass(frozen=True, repr=False)
class CalibratedStations:
    """A robot calibrated at several stations.

    Attributes:
        models: the calibrated model of each station, by the station's name.
        estimate: the robot's parameters, then those of each station under its name.
        nominal_values: shape (P,), the values with only base and tool fitted.
        provenance: version of pincal, time, input files with their SHA-256, command and seed.
    """

    models: Mapping[str, CalibratedModel]
    estimate: Estimate
    nominal_values: np.ndarray
    provenance: dict[str, Any]

    def __repr__(self) -> str:
        return f"CalibratedStations({self.robot_model().model.chain.robot.name!r}: stations {' '.join(self.names)})"

    @classmethod
    def of(cls, fit: Fit, provenance: dict[str, Any] | None = None) -> CalibratedStations:
        """Return what a fit of several stations found.

        Args:
            fit: the fit.
            provenance: where it came from, in types that JSON knows.
        """
        prior = np.array([parameter.size for parameter in fit.problem.parameters])
        models = {found.name: CalibratedModel.of(fit, provenance, station=found.name) for found in fit.problem.stations}
        return cls(models, replace(fit.estimate, prior=prior), fit.nominal.values, dict(provenance or {}))

    @property
    def left(self) -> Left | None:
        """Effects that the rows showed and the model does not have."""
        return next(iter(self.models.values())).left

    def knowing(self, left: Left | None) -> CalibratedStations:
        """Return the same with what the model left of the robot, which the first station keeps."""
        (name, first), *others = self.models.items()
        return replace(self, models={name: replace(first, left=left), **dict(others)})

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the stations."""
        return tuple(self.models)

    @property
    def robot_estimate(self) -> Estimate:
        """What is known of the robot's own parameters, whatever it was measured with: ``Options.earlier`` of a next fit."""
        return self.estimate.take(parameter.name for parameter in self.estimate.parameters if not parameter.station)

    def robot_model(self) -> CalibratedModel:
        """Return the model of the first station with all that the rows of all cover: the robot is the same in each."""
        first, *others = self.models.values()
        covered = first.covered
        for other in others:
            covered = covered.over(other.covered)
        return replace(first, covered=covered, rows=together(first.rows, *(other.rows for other in others)))

    def at(self, name: str) -> CalibratedModel:
        """Return the calibrated model that predicts what one station reads.

        Raises:
            BadInputError: if there is no such station.
        """
        if name not in self.models and self.names == ("",):
            raise BadInputError(f"station {name!r} is not in the model, which was calibrated at a single one; name none")
        if name not in self.models:
            raise BadInputError(f"station {name!r} is not in the model; expected one of {', '.join(self.names)}")
        return self.models[name]


def save_stations(path: str | os.PathLike[str], calibrated: CalibratedStations) -> None:
    """Write ``model.json`` with several stations: the whole file or nothing, its numbers in full precision.

    Raises:
        OutputError: if the place can't be written to, or a number is not finite.
    """
    estimate, models = calibrated.estimate, calibrated.models
    stations = (
        StationEntry.of_station(
            found,
            name=name,
            chain=ChainEntry.of(found.model.chain),
            effects=found.model.effects,
            equilibrium=found.model.equilibrium,
        )
        for name, found in models.items()
    )
    file = StationsFile(
        format_version=STATIONS_VERSION,
        provenance=calibrated.provenance,
        robot=RobotEntry.of_robot(next(iter(models.values())).model.chain.robot),
        parameters=tuple(map(ParameterEntry.of_parameter, estimate.parameters)),
        values=estimate.values,
        nominal_values=calibrated.nominal_values,
        fitted=tuple(map(bool, estimate.free)),
        covariance=CovarianceEntry.of_covariance(estimate.covariance),
        stations=tuple(stations),
    )
    write_model_file(path, file)


def load_stations(path: str | os.PathLike[str]) -> CalibratedStations:
    """Read ``model.json`` with one station, which then has no name, or several.

    Raises:
        ModelFileError: if the file can't be read, is cut off or newer than this version, or a value is invalid.
    """
    file = read_model(path)
    if isinstance(file, ModelFile):
        only = model_of_file(file)
        nominal = np.full(len(only.values), np.nan) if only.nominal_values is None else only.nominal_values
        return CalibratedStations({"": only}, only.estimate, nominal, only.provenance)
    parameters = tuple(entry.parameter() for entry in file.parameters)
    prior = np.array([parameter.size for parameter in parameters])
    estimate = Estimate(parameters, file.values, np.array(file.fitted, bool), file.covariance.covariance(), prior)
    models = {}
    for k, entry in enumerate(file.stations):
        model = file.model(k)
        local, places = estimate_at(estimate, entry.name, model)
        nominal = file.nominal_values[places]
        models[entry.name] = CalibratedModel.of_entry(
            entry, model, estimate=local, nominal_values=nominal, provenance=file.provenance
        )
    return CalibratedStations(models, estimate, file.nominal_values, file.provenance)
