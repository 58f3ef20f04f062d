"""A robot calibrated at several stations at once: its own parameters are common, each station is a model to predict with."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pincal.calibration.calibrated import CalibratedModel
from pincal.calibration.covered import Covered
from pincal.errors import BadInputError
from pincal.identify.fit import Fit
from pincal.io.entries import ChainEntry, CoveredEntry, ParameterEntry, RobotEntry, SetupEntry
from pincal.io.model_file import STATIONS_VERSION, sensor_module
from pincal.io.stations_file import (
    CovarianceEntry,
    StationEntry,
    StationsFile,
    read_stations_file,
    write_stations_file,
)
from pincal.measure.setup import Setup
from pincal.model.model import Model
from pincal.parameters import Estimate


@dataclass(frozen=True)
class CalibratedStation:
    """What one of several stations has beside its parameters; see :class:`CalibratedModel`."""

    name: str
    model: Model
    sensor_kind: str
    payload_centre: np.ndarray
    covered: Covered
    sigma: np.ndarray
    setup: Setup


@dataclass(frozen=True)
class CalibratedStations:
    """A robot calibrated at several stations.

    Attributes:
        stations: the stations.
        estimate: the robot's parameters, then those of each station under its name.
        nominal_values: shape (P,), the values with only base and tool fitted.
        provenance: version of pincal, time, input files with their SHA-256, command and seed.
    """

    stations: tuple[CalibratedStation, ...]
    estimate: Estimate
    nominal_values: np.ndarray
    provenance: dict[str, Any]

    @classmethod
    def of(cls, fit: Fit, provenance: dict[str, Any] | None = None) -> CalibratedStations:
        """Return what a fit of several stations found.

        Args:
            fit: the fit.
            provenance: where it came from, in types that JSON knows.
        """
        spans = fit.problem.block_spans
        stations = tuple(
            CalibratedStation(
                name=station.name,
                model=station.model,
                sensor_kind=station.sensor.kind,
                payload_centre=np.array(fit.options.at(station.name).payload_centre, float),
                covered=Covered.of(station.conditions),
                sigma=np.array(fit.solution.sigma[span], float),
                setup=fit.options.at(station.name).setup,
            )
            for station, span in zip(fit.problem.stations, spans, strict=True)
        )
        prior = np.array([parameter.size for parameter in fit.problem.parameters])
        return cls(stations, replace(fit.estimate, prior=prior), fit.nominal.values.copy(), dict(provenance or {}))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the stations."""
        return tuple(station.name for station in self.stations)

    def at(self, name: str) -> CalibratedModel:
        """Return the calibrated model that predicts what one station reads.

        Raises:
            BadInputError: if there is no such station.
        """
        if name not in self.names:
            raise BadInputError(f"station {name!r} is not in the model; expected one of {', '.join(self.names)}")
        station = self.stations[self.names.index(name)]
        of_sensor = [p.name for p in self.estimate.parameters if p.station == name]
        known = {p.name for p in self.estimate.parameters}
        of_model = [f"{name}/{n}" if f"{name}/{n}" in known else n for n in station.model.names]
        names = [*of_model, *(n for n in of_sensor if n not in of_model)]
        found = self.estimate.take(names)
        local = tuple(replace(p, name=p.local_name, station="") for p in found.parameters)
        return CalibratedModel(
            model=station.model,
            estimate=replace(found, parameters=local),
            sensor_kind=station.sensor_kind,
            payload_centre=station.payload_centre,
            covered=station.covered,
            sigma=station.sigma,
            provenance=self.provenance,
            setup=station.setup,
            nominal_values=self.nominal_values[self.estimate.places(names)],
        )


def save_stations(path: str | os.PathLike[str], calibrated: CalibratedStations) -> None:
    """Write ``model.json`` with several stations: the whole file or nothing, its numbers in full precision.

    Raises:
        OutputError: if the place can't be written to, or a number is not finite.
    """
    estimate = calibrated.estimate
    file = StationsFile(
        format_version=STATIONS_VERSION,
        provenance=calibrated.provenance,
        robot=RobotEntry.of(calibrated.stations[0].model.chain.robot),
        parameters=tuple(ParameterEntry.of(parameter) for parameter in estimate.parameters),
        values=estimate.values,
        nominal_values=calibrated.nominal_values,
        fitted=tuple(map(bool, estimate.free)),
        covariance=CovarianceEntry.of(estimate.covariance),
        stations=tuple(_entry(station) for station in calibrated.stations),
    )
    write_stations_file(path, file)


def load_stations(path: str | os.PathLike[str]) -> CalibratedStations:
    """Read ``model.json`` with several stations.

    Raises:
        ModelFileError: if the file can't be read, is cut off or newer than this version, or a value is invalid.
    """
    file = read_stations_file(path)
    robot = file.robot.robot()
    parameters = tuple(entry.parameter() for entry in file.parameters)
    prior = np.array([parameter.size for parameter in parameters])
    estimate = Estimate(parameters, file.values, np.array(file.fitted, bool), file.covariance.covariance(), prior)
    stations = tuple(
        CalibratedStation(
            name=entry.name,
            model=entry.model(robot),
            sensor_kind=entry.sensor_kind,
            payload_centre=entry.payload_centre,
            covered=Covered(entry.covered.q, entry.covered.payload),
            sigma=entry.sigma,
            setup=entry.setup.setup(),
        )
        for entry in file.stations
    )
    return CalibratedStations(stations, estimate, file.nominal_values, file.provenance)


def _entry(station: CalibratedStation) -> StationEntry:
    chain = station.model.chain
    return StationEntry(
        name=station.name,
        sensor_kind=station.sensor_kind,
        sensor_module=sensor_module(station.sensor_kind),
        sigma=station.sigma,
        payload_centre=station.payload_centre,
        covered=CoveredEntry(q=station.covered.q, payload=station.covered.payload),
        chain=ChainEntry.of(chain),
        effects=station.model.effects,
        equilibrium=station.model.equilibrium,
        setup=SetupEntry.of(station.setup),
    )
