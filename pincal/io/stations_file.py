"""The structure of ``model.json`` with several stations: one robot, its parameters, and what each station has of its own."""

from __future__ import annotations

import os
from typing import Annotated, Any

import msgspec
import numpy as np

from pincal.io.arrays import Matrix, Numbers, Record, Shape, Vector, shaped
from pincal.io.effect_entry import effect_to_entry
from pincal.io.entries import ChainEntry, CoveredEntry, ParameterEntry, RobotEntry, SetupEntry, plain, restored
from pincal.io.model_file import check_sensor, version_of
from pincal.io.strict_json import MODEL_FILE, Fault, read_json, write_json
from pincal.model.chain import Chain
from pincal.model.effects import Effect
from pincal.model.model import Model
from pincal.parameters import Covariance
from pincal.robot.robot import Robot


class GroupEntry(Record, frozen=True, kw_only=True):
    """A block of the covariance, and which of the fitted parameters it belongs to."""

    parameters: Annotated[tuple[int, ...], Shape("block")]
    block: Annotated[Matrix, Shape("block", "block")]


class CovarianceEntry(Record, frozen=True, kw_only=True):
    """Covariance of the fitted parameters: factor times its transpose plus a block per group."""

    factor: Annotated[Matrix, Shape("any", "any")]
    groups: tuple[GroupEntry, ...]

    @classmethod
    def of(cls, covariance: Covariance) -> CovarianceEntry:
        """Return the entry of a covariance."""
        groups = (GroupEntry(parameters=tuple(map(int, places)), block=block) for places, block in covariance.groups)
        return cls(factor=covariance.factor, groups=tuple(groups))

    def covariance(self) -> Covariance:
        """Return the covariance."""
        return Covariance(self.factor, tuple((np.array(group.parameters, int), group.block) for group in self.groups))


class StationEntry(Record, frozen=True, kw_only=True):
    """What one station has of its own beside its parameters."""

    name: str
    sensor_kind: str
    sigma: Annotated[Numbers, Shape("any")]
    payload_centre: Vector
    covered: CoveredEntry
    chain: ChainEntry
    effects: tuple[Effect, ...]
    equilibrium: bool
    setup: SetupEntry
    sensor_module: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_sensor(self.sensor_kind, self.sensor_module)

    def model(self, robot: Robot) -> Model:
        """Return the station's model of the robot."""
        chain = Chain(robot=robot, **msgspec.structs.asdict(self.chain))
        return Model(chain, self.effects, equilibrium=self.equilibrium)


class StationsFile(Record, frozen=True, kw_only=True):
    """The whole of ``model.json`` for several stations.

    Attributes:
        format_version: 2.
        provenance: versions, time, command, seed, input files with their SHA-256.
        robot: the arm.
        parameters: the P parameters: the robot's, then those of each station.
        values: shape (P,), deviations from the nominal.
        nominal_values: shape (P,), the values with only base and tool fitted.
        fitted: shape (P,), which parameters were fitted.
        covariance: of the fitted ones.
        stations: the stations.
    """

    format_version: int
    provenance: dict[str, Any]
    robot: RobotEntry
    parameters: Annotated[tuple[ParameterEntry, ...], Shape("parameters")]
    values: Annotated[Numbers, Shape("parameters")]
    nominal_values: Annotated[Numbers, Shape("parameters")]
    fitted: Annotated[tuple[bool, ...], Shape("parameters")]
    covariance: CovarianceEntry
    stations: tuple[StationEntry, ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        n = sum(self.fitted)
        shaped(".covariance.factor", self.covariance.factor, Shape(n, "any"), {})
        for k, group in enumerate(self.covariance.groups):
            if any(not 0 <= i < n for i in group.parameters):
                key = f".covariance.groups[{k}].parameters"
                raise Fault("has an entry that is no fitted parameter", f"numbers from 0 to {n - 1}", key=key)
        known, robot = {parameter.name for parameter in self.parameters}, self.robot.robot()
        for k, station in enumerate(self.stations):
            shaped(f".stations[{k}].covered.q", station.covered.q, Shape(robot.n_joints, 2), {})
            try:
                names = station.model(robot).names
            except (ValueError, LookupError, TypeError, AttributeError) as error:
                expected = "joints and symbols of this robot"
                raise Fault(f"do not fit the robot ({error})", expected, key=f".stations[{k}].effects") from None
            missing = [name for name in names if name not in known and f"{station.name}/{name}" not in known]
            if missing:
                raise Fault(f"do not hold {missing[0]!r}", f"all those of station {station.name!r}", key=".parameters")


def read_stations_file(path: str | os.PathLike[str]) -> StationsFile:
    """Read ``model.json`` with several stations.

    Raises:
        ModelFileError: if the file can't be read, is cut off or newer than this version, or a value is invalid.
    """
    version_of(path)
    return read_json(path, StationsFile, MODEL_FILE, hook=restored)


def write_stations_file(path: str | os.PathLike[str], file: StationsFile) -> None:
    """Write ``model.json`` with several stations: the whole file or nothing.

    Raises:
        OutputError: if the place can't be written to, or a number is not finite.
    """
    contents = msgspec.to_builtins(file, enc_hook=plain)
    contents["robot"] = file.robot.contents()
    for entry, station in zip(contents["stations"], file.stations, strict=True):
        entry["effects"] = [effect_to_entry(effect) for effect in station.effects]
    write_json(path, contents, indent=None)
