"""The structure of ``model.json``, of one station or several: all numbers that a prediction needs,
without the URDF.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Self

import msgspec
import numpy as np

from pincal.calibration.covered import Covered
from pincal.calibration.information import RobotInformation
from pincal.calibration.repeatability import Repeatability
from pincal.calibration.station_model import StationModel
from pincal.calibration.unmodelled import Unmodelled
from pincal.errors import OutputError
from pincal.identify.station import are_fingerprints
from pincal.io.arrays import (
    ArrayShape,
    Numbers,
    Packed,
    Record,
    Vector,
    packed_covariance,
    packed_matrix,
    shaped,
)
from pincal.io.entries import (
    ChainEntry,
    Effects,
    ModelEntry,
    ParameterEntry,
    SetupEntry,
    model_of,
    plain,
    restoring,
)
from pincal.io.result_folder import not_written_with
from pincal.io.robot_entry import RobotEntry
from pincal.io.strict_json import MODEL_FILE, Fault, built, read_bounded, write_json
from pincal.measure.registry import known_kinds
from pincal.model.model import Model
from pincal.parameters import Covariance, Estimate

# Versions of files with one station and with several.
FORMAT_VERSION = 1
STATIONS_VERSION = 2
# Building the model of a station takes a millisecond, and so do ten effects.
MOST_STATIONS = 500


class MeasuredEntry(Record, frozen=True, kw_only=True):
    """The sensor of a station and the coverage of its rows.

    Attributes:
        sensor_kind: what was measured: "position", "pose", "distance" and so on.
        sensor_module: the module that defines the sensor, if it is not one of pincal's own. Reading
            never imports it.
        sigma: shape (blocks,), noise of one component of each block of readings that the fit used
            [m, rad, px].
        payload_centre: shape (3,), centre of mass of the payload in the tip frame [m].
        covered: the range of the training rows.
        setup: named points and the camera.
        rows: fingerprints of the training rows, by which they are recognised; not in files of
            version 0.1.0.
        is_noise_declared: whether the noise was declared, not estimated.
        left: effects present in the rows but not in the model; none if not tested.
        information: information of the rows on the robot, without any prior, from which types of
            robots are learned; of several stations with the first, and not in files of earlier
            versions.
        repeatability: of the readings within a stop and of stops at a pose; none where nothing was
            repeated, and not in files of earlier versions.
    """

    sensor_kind: str
    sigma: Annotated[Numbers, ArrayShape("any")]
    payload_centre: Vector
    covered: Covered
    setup: SetupEntry
    sensor_module: str | None = None
    rows: str = ""
    is_noise_declared: bool = False
    left: Unmodelled | None = None
    information: RobotInformation | None = None
    repeatability: Repeatability | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not are_fingerprints(self.rows):
            raise Fault(
                "holds no fingerprints", "four bytes per training row, as base64", key=".rows"
            )
        kind = self.sensor_kind
        module = self.sensor_module
        if kind in known_kinds():
            return
        if module:
            expected = f"its module to be loaded: --plugin {module}"
            raise Fault(f"sensor {kind!r} is not pincal's own", expected, key=".sensor_kind")
        raise Fault(
            f"unknown sensor {kind!r}", f"one of {', '.join(known_kinds())}", key=".sensor_kind"
        )

    @classmethod
    def measured(cls, found: StationModel, **others: Any) -> Self:
        """Return the record of a calibrated model, with the other fields of a subclass."""
        module = known_kinds().get(found.sensor_kind, "pincal")
        is_own = module.split(".")[0] == "pincal"
        return cls.like(
            found,
            sensor_module=None if is_own else module,
            setup=SetupEntry.of_setup(found.setup),
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
        nominal_values: shape (P,), the values with only base and tool fitted; not in files of
            version 0.1.0.
        files: the files written with it, with their SHA-256; none where it was saved alone.
    """

    format_version: int
    provenance: dict[str, Any]
    parameters: Annotated[tuple[ParameterEntry, ...], ArrayShape("parameters")]
    values: Annotated[Numbers, ArrayShape("parameters")]
    covariance: Annotated[Packed, ArrayShape("parameters", "parameters", write=packed_covariance)]
    model: ModelEntry
    nominal_values: Annotated[Numbers | None, ArrayShape("parameters")] = None
    files: dict[str, str] | None = None

    @classmethod
    def of_model(cls, found: StationModel) -> ModelFile:
        """Return the file of a calibrated model."""
        parameters = tuple(map(ParameterEntry.of_parameter, found.estimate.parameters))
        model = ModelEntry.of_model(found.model)
        return cls.measured(
            found, format_version=FORMAT_VERSION, parameters=parameters, model=model, files=None
        )

    def __post_init__(self) -> None:
        super().__post_init__()
        names = self.model.model().names
        if tuple(p.name for p in self.parameters)[: len(names)] != names:
            raise Fault(
                "are not those of the effects",
                f"{', '.join(names[:3])} and so on",
                key=".parameters",
            )
        shaped(".covered.q", self.covered.q, ArrayShape(len(self.model.robot.joint_names), 2), {})


class GroupEntry(Record, frozen=True, kw_only=True):
    """A block of the covariance of some of the fitted parameters.

    Attributes:
        parameters: their indices among the fitted ones, from 0.
        block: shape (b, b), added to their covariance.
    """

    parameters: Annotated[tuple[int, ...], ArrayShape("block")]
    block: Annotated[Packed, ArrayShape("block", "block", write=packed_covariance)]


class CovarianceEntry(Record, frozen=True, kw_only=True):
    """Covariance of the F fitted parameters: factor times its transpose plus a block per group.

    Attributes:
        factor: shape (F, k); a large matrix is packed into text.
        groups: the blocks, one per station.
    """

    factor: Annotated[Packed, ArrayShape("any", "any", write=packed_matrix)]
    groups: tuple[GroupEntry, ...]

    @classmethod
    def of_covariance(cls, covariance: Covariance) -> CovarianceEntry:
        """Return the entry of a covariance."""
        groups = (
            GroupEntry(parameters=tuple(map(int, places)), block=block)
            for places, block in covariance.groups
        )
        return cls(factor=covariance.factor, groups=tuple(groups))

    def covariance(self) -> Covariance:
        """Return the covariance."""
        return Covariance(
            self.factor,
            tuple((np.array(group.parameters, int), group.block) for group in self.groups),
        )


class StationEntry(MeasuredEntry, frozen=True, kw_only=True):
    """Data of one of several stations in addition to its parameters.

    Attributes:
        name: of the station, as in the parameters.
        chain: reference frames of base and targets.
        effects: the effects of this station's model.
        equilibrium: whether moments are those of the deflected arm.
        table_names: names of its parameters in the table, where it shares some besides the robot's
            with other stations.
    """

    name: str
    chain: ChainEntry
    effects: Effects
    equilibrium: bool
    table_names: tuple[str, ...] = ()


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
        files: the files written with it, with their SHA-256; none where it was saved alone.
    """

    format_version: int
    provenance: dict[str, Any]
    robot: RobotEntry
    parameters: Annotated[tuple[ParameterEntry, ...], ArrayShape("parameters")]
    values: Annotated[Numbers, ArrayShape("parameters")]
    nominal_values: Annotated[Numbers, ArrayShape("parameters")]
    fitted: Annotated[tuple[bool, ...], ArrayShape("parameters")]
    covariance: CovarianceEntry
    stations: Annotated[tuple[StationEntry, ...], msgspec.Meta(max_length=MOST_STATIONS)]
    files: dict[str, str] | None = None

    @classmethod
    def of_stations(
        cls, found: Mapping[str, StationModel], estimate: Estimate, nominal_values: np.ndarray
    ) -> StationsFile:
        """Return the file of calibrated models by the names of their stations, with the estimate
        that is common to them.
        """
        first = next(iter(found.values()))
        stations = (
            StationEntry.measured(
                of,
                name=name,
                chain=ChainEntry.of_chain(of.model.chain),
                effects=of.model.effects,
                equilibrium=of.model.equilibrium,
            )
            for name, of in found.items()
        )
        return cls(
            format_version=STATIONS_VERSION,
            provenance=first.provenance,
            robot=RobotEntry.of_robot(first.model.chain.robot),
            parameters=tuple(map(ParameterEntry.of_parameter, estimate.parameters)),
            values=estimate.values,
            nominal_values=nominal_values,
            fitted=tuple(map(bool, estimate.free)),
            covariance=CovarianceEntry.of_covariance(estimate.covariance),
            stations=tuple(stations),
        )

    def __post_init__(self) -> None:
        super().__post_init__()
        n = sum(self.fitted)
        n_effects = sum(len(station.effects) for station in self.stations)
        if n_effects > MOST_STATIONS * 10:
            raise Fault(
                f"hold {n_effects} effects", f"at most {MOST_STATIONS * 10}", key=".stations"
            )
        shaped(".covariance.factor", self.covariance.factor, ArrayShape(n, "any"), {})
        for k, group in enumerate(self.covariance.groups):
            if any(not 0 <= i < n for i in group.parameters):
                key = f".covariance.groups[{k}].parameters"
                raise Fault(
                    "has an entry that is not a fitted parameter",
                    f"numbers from 0 to {n - 1}",
                    key=key,
                )
        known = {parameter.name for parameter in self.parameters}
        for k, station in enumerate(self.stations):
            shaped(
                f".stations[{k}].covered.q",
                station.covered.q,
                ArrayShape(len(self.robot.joint_names), 2),
                {},
            )
            names = self.model(k).names
            here = dict(zip(names, station.table_names, strict=False))
            missing = [
                name
                for name in names
                if not known & {name, f"{station.name}/{name}", here.get(name, name)}
            ]
            missing += [name for name in station.table_names if name not in known]
            if missing:
                raise Fault(
                    f"lack {missing[0]!r}",
                    f"all those of station {station.name!r}",
                    key=".parameters",
                )

    def model(self, k: int) -> Model:
        """Return the model of the k-th station."""
        entry = self.stations[k]
        robot = self.robot.robot()
        return model_of(
            robot, entry.chain, entry.effects, equilibrium=entry.equilibrium, key=f".stations[{k}]"
        )


class _Head(msgspec.Struct, frozen=True):
    """The part that is read first, to decide whether the rest can be read."""

    format_version: int
    files: dict[str, str] | None = None

    def __post_init__(self) -> None:
        if self.format_version < 1:
            expected = f"a whole number up to {STATIONS_VERSION}"
            raise Fault(f"is {self.format_version}", expected, key=".format_version")


def read_model(path: str | os.PathLike[str]) -> ModelFile | StationsFile:
    """Read ``model.json`` of one station or several.

    Raises:
        ModelFileError: if the file can't be read, is cut off, newer than this version or among the
            results of another run, or a value is invalid.
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
            f"{file}: {mixed} in the same folder was not written by the same run: a run "
            "was stopped while it wrote this "
            "folder, or files of two runs were mixed; calibrate again, or move the model "
            "to a separate folder"
        )
    if head.format_version == STATIONS_VERSION:
        return built(content, StationsFile, MODEL_FILE, file=file, hook=restoring())
    return built(content, ModelFile, MODEL_FILE, file=file, hook=restoring())


def write_model_file(
    path: str | os.PathLike[str], made: Callable[[], ModelFile | StationsFile]
) -> None:
    """Write the ``model.json`` that a function makes: the whole file or nothing, its numbers in
    full precision.

    Raises:
        OutputError: if the place can't be written to, or a number is not finite.
    """
    try:
        file = made()
    except Fault as fault:
        place = fault.key.removeprefix(".")
        raise OutputError(
            f"{os.fspath(path)}: not finite or not whole: {place} {fault}; calibrate again"
        ) from None
    write_json(path, {"format_version": file.format_version, **plain(file)}, indent=None)
