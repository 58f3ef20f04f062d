"""The structure of ``model.json``, of one station or several: all that a prediction needs in numbers, without the URDF."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any, Self

import msgspec
import numpy as np

from pincal.identify.fingerprints import are_fingerprints
from pincal.io.arrays import Numbers, Packed, Record, Shape, Vector, shaped
from pincal.io.entries import (
    ChainEntry,
    CoveredEntry,
    Effects,
    ModelEntry,
    ParameterEntry,
    RobotEntry,
    SetupEntry,
    model_of,
    plain,
    restoring,
)
from pincal.io.packed import packed_covariance, packed_matrix
from pincal.io.result_folder import not_written_with
from pincal.io.strict_json import MODEL_FILE, Fault, built, read_bounded, write_json
from pincal.measure.registry import known_kinds
from pincal.model.model import Model
from pincal.parameters import Covariance

# Of files with one station, and with several.
FORMAT_VERSION, STATIONS_VERSION = 1, 2
# Building the model of a station takes a millisecond, and so do ten effects.
MOST_STATIONS = 500


class LeftEntry(Record, frozen=True, kw_only=True):
    """Effects that a model left, which a diagnosis has to know of.

    Attributes:
        effects: the effects.
        parameter_names: names of their E parameters.
        values: shape (E,), what the rows made of them [unit of each].
        covariance: shape (E, E), of the values.
        names: names of the K parameters of the robot.
        taken_up: shape (K, E), what the calibration made of a unit of each.
    """

    effects: Effects
    parameter_names: Annotated[tuple[str, ...], Shape("left")]
    values: Annotated[Numbers, Shape("left")]
    covariance: Annotated[Packed, Shape("left", "left", write=packed_covariance)]
    names: Annotated[tuple[str, ...], Shape("robot")]
    taken_up: Annotated[Packed, Shape("robot", "left", write=packed_matrix)]

    def parts(self) -> tuple[Any, ...]:
        """Return its parts, in the order of :class:`pincal.calibration.left.Left`."""
        return self.effects, self.parameter_names, self.values, self.covariance, self.names, self.taken_up


class MeasuredEntry(Record, frozen=True, kw_only=True):
    """What a station was measured with and what its rows cover.

    Attributes:
        sensor_kind: what was measured: "position", "pose", "distance" and so on.
        sensor_module: the module that defines the sensor, if it is not one of pincal's own. Reading never imports it.
        sigma: shape (blocks,), noise of one component of each block of readings that the fit used [m, rad, px].
        payload_centre: shape (3,), centre of mass of the payload in the tip frame [m].
        covered: the range of the training rows.
        setup: named points and the camera.
        rows: fingerprints of the training rows, by which they are known again; not in files of version 0.1.0.
        is_noise_declared: whether the noise was declared, not estimated.
        left: effects that the rows showed and the model does not have; none where nobody looked.
    """

    sensor_kind: str
    sigma: Annotated[Numbers, Shape("any")]
    payload_centre: Vector
    covered: CoveredEntry
    setup: SetupEntry
    sensor_module: str | None = None
    rows: str = ""
    is_noise_declared: bool = False
    left: LeftEntry | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not are_fingerprints(self.rows):
            raise Fault("holds no fingerprints", "four bytes per training row, as base64", key=".rows")
        kind, module = self.sensor_kind, self.sensor_module
        if kind in known_kinds():
            return
        if module:
            expected = f"its module to be loaded: --plugin {module}"
            raise Fault(f"sensor {kind!r} is not pincal's own", expected, key=".sensor_kind")
        raise Fault(f"unknown sensor {kind!r}", f"one of {', '.join(known_kinds())}", key=".sensor_kind")

    @classmethod
    def of_station(cls, found: Any, **others: Any) -> Self:
        """Return the entry of a calibrated model, see :class:`pincal.CalibratedModel`."""
        module = known_kinds().get(found.sensor_kind, "pincal")
        return cls.of(
            found,
            sensor_module=None if module.split(".")[0] == "pincal" else module,
            covered=CoveredEntry.of(found.covered),
            setup=SetupEntry.of_setup(found.setup),
            left=None if found.left is None else LeftEntry.of(found.left),
            **others,
        )


class ModelFile(MeasuredEntry, frozen=True, kw_only=True):
    """The whole of ``model.json`` of one station.

    Attributes:
        format_version: 1.
        provenance: versions, time, command, seed, input files with their SHA-256.
        parameters: the P parameters of the model, then the sensor's own.
        values: shape (P,), deviations from the nominal.
        covariance: shape (P, P), of the values; zero for those that were not fitted.
        model: robot, chain and effects.
        nominal_values: shape (P,), the values with only base and tool fitted; not in files of version 0.1.0.
        files: the files that were written with it, with their SHA-256; none where it was saved alone.
    """

    format_version: int
    provenance: dict[str, Any]
    parameters: Annotated[tuple[ParameterEntry, ...], Shape("parameters")]
    values: Annotated[Numbers, Shape("parameters")]
    covariance: Annotated[Packed, Shape("parameters", "parameters", write=packed_covariance)]
    model: ModelEntry
    nominal_values: Annotated[Numbers | None, Shape("parameters")] = None
    files: dict[str, str] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        names = self.model.model().names
        if tuple(p.name for p in self.parameters)[: len(names)] != names:
            raise Fault("are not those of the effects", f"{', '.join(names[:3])} and so on", key=".parameters")
        shaped(".covered.q", self.covered.q, Shape(len(self.model.robot.joint_names), 2), {})


class GroupEntry(Record, frozen=True, kw_only=True):
    """A block of the covariance, and which of the fitted parameters it belongs to.

    Attributes:
        parameters: their indices among the fitted ones, from 0.
        block: shape (b, b), what adds to their covariance.
    """

    parameters: Annotated[tuple[int, ...], Shape("block")]
    block: Annotated[Packed, Shape("block", "block", write=packed_covariance)]


class CovarianceEntry(Record, frozen=True, kw_only=True):
    """Covariance of the F fitted parameters: factor times its transpose plus a block per group.

    Attributes:
        factor: shape (F, k); a large matrix is packed into text.
        groups: the blocks, one per station.
    """

    factor: Annotated[Packed, Shape("any", "any", write=packed_matrix)]
    groups: tuple[GroupEntry, ...]

    @classmethod
    def of_covariance(cls, covariance: Covariance) -> CovarianceEntry:
        """Return the entry of a covariance."""
        groups = (GroupEntry(parameters=tuple(map(int, places)), block=block) for places, block in covariance.groups)
        return cls(factor=covariance.factor, groups=tuple(groups))

    def covariance(self) -> Covariance:
        """Return the covariance."""
        return Covariance(self.factor, tuple((np.array(group.parameters, int), group.block) for group in self.groups))


class StationEntry(MeasuredEntry, frozen=True, kw_only=True):
    """What one of several stations has of its own beside its parameters.

    Attributes:
        name: of the station, as in the parameters.
        chain: reference frames of base and targets.
        effects: the effects of this station's model.
        equilibrium: whether moments are those of the bent arm.
    """

    name: str
    chain: ChainEntry
    effects: Effects
    equilibrium: bool


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
        files: the files that were written with it, with their SHA-256; none where it was saved alone.
    """

    format_version: int
    provenance: dict[str, Any]
    robot: RobotEntry
    parameters: Annotated[tuple[ParameterEntry, ...], Shape("parameters")]
    values: Annotated[Numbers, Shape("parameters")]
    nominal_values: Annotated[Numbers, Shape("parameters")]
    fitted: Annotated[tuple[bool, ...], Shape("parameters")]
    covariance: CovarianceEntry
    stations: Annotated[tuple[StationEntry, ...], msgspec.Meta(max_length=MOST_STATIONS)]
    files: dict[str, str] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        n, n_effects = sum(self.fitted), sum(len(station.effects) for station in self.stations)
        if n_effects > MOST_STATIONS * 10:
            raise Fault(f"hold {n_effects} effects", f"at most {MOST_STATIONS * 10}", key=".stations")
        shaped(".covariance.factor", self.covariance.factor, Shape(n, "any"), {})
        for k, group in enumerate(self.covariance.groups):
            if any(not 0 <= i < n for i in group.parameters):
                key = f".covariance.groups[{k}].parameters"
                raise Fault("has an entry that is no fitted parameter", f"numbers from 0 to {n - 1}", key=key)
        known = {parameter.name for parameter in self.parameters}
        for k, station in enumerate(self.stations):
            shaped(f".stations[{k}].covered.q", station.covered.q, Shape(len(self.robot.joint_names), 2), {})
            names = self.model(k).names
            missing = [name for name in names if name not in known and f"{station.name}/{name}" not in known]
            if missing:
                raise Fault(f"do not hold {missing[0]!r}", f"all those of station {station.name!r}", key=".parameters")

    def model(self, k: int) -> Model:
        """Return the model of the k-th station."""
        entry, robot = self.stations[k], self.robot.robot()
        return model_of(robot, entry.chain, entry.effects, equilibrium=entry.equilibrium, key=f".stations[{k}]")


class _Head(msgspec.Struct, frozen=True):
    """What is read first: whether the rest can be read at all."""

    format_version: int
    files: dict[str, str] | None = None

    def __post_init__(self) -> None:
        if self.format_version < 1:
            expected = f"a whole number up to {STATIONS_VERSION}"
            raise Fault(f"is {self.format_version}", expected, key=".format_version")


def read_model(path: str | os.PathLike[str]) -> ModelFile | StationsFile:
    """Read ``model.json`` of one station or several.

    Raises:
        ModelFileError: if the file can't be read, is cut off, newer than this version or among the results of another run,
            or a value is invalid.
    """
    file = os.fspath(path)
    content = read_bounded(path, MODEL_FILE)
    head = built(content, _Head, MODEL_FILE, file=file)
    if head.format_version > STATIONS_VERSION:
        raise MODEL_FILE.error(
            f"{file}: format_version is {head.format_version}, written by a newer pincal; "
            f"expected at most {STATIONS_VERSION}: update pincal"
        )
    if mixed := not_written_with(Path(path), head.files or {}):
        raise MODEL_FILE.error(
            f"{file}: {mixed} beside it was not written with it: a run was stopped while it wrote this folder, "
            "or files of two runs were put together; calibrate again, or move the model to a folder of its own"
        )
    if head.format_version == STATIONS_VERSION:
        return built(content, StationsFile, MODEL_FILE, file=file, hook=restoring())
    return built(content, ModelFile, MODEL_FILE, file=file, hook=restoring())


def read_model_file(path: str | os.PathLike[str]) -> ModelFile:
    """Read ``model.json`` of one station.

    Raises:
        ModelFileError: as `read_model`, or if the file holds several stations.
    """
    found = read_model(path)
    if isinstance(found, StationsFile):
        names = ", ".join(entry.name for entry in found.stations)
        raise MODEL_FILE.error(
            f"{os.fspath(path)}: holds several stations: {names}; expected one: choose it by load_stations(path).at(name)"
        )
    return found


def write_model_file(path: str | os.PathLike[str], file: ModelFile | StationsFile) -> None:
    """Write ``model.json``: the whole file or nothing, its numbers in full precision.

    Raises:
        OutputError: if the place can't be written to, or a number is not finite.
    """
    write_json(path, {"format_version": file.format_version, **plain(file)}, indent=None)
