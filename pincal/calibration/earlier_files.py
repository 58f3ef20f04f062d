"""Reading ``model.json``: files of this version, and those of earlier ones as if of this version.

Version 1 was of one station, with a dense covariance, version 2 of several.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from pincal.calibration.information import RobotInformation
from pincal.calibration.model_file import (
    FORMAT_VERSION,
    MOST_STATIONS,
    CovarianceEntry,
    MeasuredEntry,
    ModelFile,
    StationEntry,
    check_of,
)
from pincal.calibration.unmodelled import Unmodelled
from pincal.io.arrays import ArrayShape, Numbers, Packed, Record, packed_covariance
from pincal.io.entries import ChainEntry, Effects, ModelEntry, ParameterEntry, model_of, restoring
from pincal.io.result_folder import not_written_with
from pincal.io.robot_entry import RobotEntry
from pincal.io.strict_json import MODEL_FILE, Fault, built, read_bounded
from pincal.parameters import Covariance


class _Measured(MeasuredEntry, frozen=True, kw_only=True):
    """The record of a station, which held what is now of the whole robot.

    Attributes:
        left: effects present in the rows but not in the model; none if not tested.
        information: of the rows of all stations on the robot; with the first station.
    """

    left: Unmodelled | None = None
    information: RobotInformation | None = None

    def measured(self) -> dict[str, Any]:
        """Return the fields of a station that are as in this version."""
        return {name: getattr(self, name) for name in MeasuredEntry.__struct_fields__}


class FileOfOne(_Measured, frozen=True, kw_only=True):
    """A file of version 1, of one station.

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

    def upgraded(self) -> ModelFile:
        """Return the file of this version."""
        fitted = np.diag(self.covariance) > 0.0
        covariance = Covariance.of(self.covariance[np.ix_(fitted, fitted)])
        station = StationEntry(
            name="",
            chain=self.model.chain,
            effects=self.model.effects,
            equilibrium=self.model.equilibrium,
            parameters=tuple(range(len(self.parameters))),
            **self.measured(),
        )
        return ModelFile(
            format_version=FORMAT_VERSION,
            provenance=self.provenance,
            robot=self.model.robot,
            parameters=self.parameters,
            values=self.values,
            fitted=tuple(fitted.tolist()),
            covariance=CovarianceEntry.of_covariance(covariance),
            stations=(station,),
            nominal_values=self.nominal_values,
            unmodelled=self.left,
            information=self.information,
            files=self.files,
        )


class _StationOfSeveral(_Measured, frozen=True, kw_only=True):
    """A station of a file of version 2.

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

    def parameter_names(self, table: FileOfSeveral, key: str) -> tuple[str, ...]:
        """Return the names of its parameters in the table of all."""
        known = {parameter.name for parameter in table.parameters}
        found = self.table_names
        if not found:
            robot = table.robot.robot()
            model = model_of(robot, self.chain, self.effects, equilibrium=self.equilibrium, key=key)
            own = [f"{self.name}/{name}" for name in model.names]
            pairs = zip(own, model.names, strict=True)
            of_model = [name if name in known else plain for name, plain in pairs]
            of_sensor = [p.name for p in table.parameters if p.station == self.name]
            found = tuple(dict.fromkeys((*of_model, *of_sensor)))
        missing = [name for name in found if name not in known]
        if missing:
            raise Fault(
                f"lack {missing[0]!r}", f"all those of station {self.name!r}", key=".parameters"
            )
        return found


class FileOfSeveral(Record, frozen=True, kw_only=True):
    """A file of version 2, of several stations.

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
    stations: Annotated[
        tuple[_StationOfSeveral, ...], msgspec.Meta(min_length=1, max_length=MOST_STATIONS)
    ]
    files: dict[str, str] | None = None

    def upgraded(self) -> ModelFile:
        """Return the file of this version."""
        places = {parameter.name: i for i, parameter in enumerate(self.parameters)}
        stations = tuple(
            StationEntry(
                name=old.name,
                chain=old.chain,
                effects=old.effects,
                equilibrium=old.equilibrium,
                parameters=tuple(
                    places[name] for name in old.parameter_names(self, f".stations[{k}]")
                ),
                **old.measured(),
            )
            for k, old in enumerate(self.stations)
        )
        return ModelFile(
            format_version=FORMAT_VERSION,
            provenance=self.provenance,
            robot=self.robot,
            parameters=self.parameters,
            values=self.values,
            fitted=self.fitted,
            covariance=self.covariance,
            stations=stations,
            nominal_values=self.nominal_values,
            unmodelled=self.stations[0].left,
            information=self.stations[0].information,
            files=self.files,
        )


class _Head(msgspec.Struct, frozen=True):
    """The part that is read first, to decide whether the rest can be read."""

    format_version: int
    files: dict[str, str] | None = None

    def __post_init__(self) -> None:
        if self.format_version < 1:
            expected = f"a whole number up to {FORMAT_VERSION}"
            raise Fault(f"is {self.format_version}", expected, key=".format_version")


def _require_unchanged(content: bytes, found: ModelFile, file: str) -> None:
    """Refuse a file with other values than those that were written together.

    Each may be valid: a length of a smooth function that does not belong to its coefficients would
    give wrong positions.
    """
    if found.check is None or found.check == check_of(json.loads(content)):
        return
    raise MODEL_FILE.error(
        f"{file}: a value was changed after the file was written (check does not match), and its "
        "values may no longer belong together; expected the file as it was written: calibrate "
        "again, or remove the key check to use the file as it is"
    )


def read_model(path: str | os.PathLike[str]) -> ModelFile:
    """Read ``model.json`` of any version.

    Raises:
        ModelFileError: if the file can't be read, is cut off, newer than this version or among the
            results of another run, or a value is invalid.
    """
    file = os.fspath(path)
    content = read_bounded(path, MODEL_FILE)
    head = built(content, _Head, MODEL_FILE, file=file)
    if head.format_version > FORMAT_VERSION:
        raise MODEL_FILE.error(
            f"{file}: format_version is {head.format_version}, written by a newer pincal; "
            f"expected at most {FORMAT_VERSION}: update pincal"
        )
    if mixed := not_written_with(Path(path), head.files or {}):
        raise MODEL_FILE.error(
            f"{file}: {mixed} in the same folder was not written by the same run: a run was "
            "stopped while it wrote this folder, or files of two runs were mixed; calibrate again, "
            "or move the model to a separate folder"
        )
    if head.format_version == FORMAT_VERSION:
        found = built(content, ModelFile, MODEL_FILE, file=file, hook=restoring())
        _require_unchanged(content, found, file)
        return found
    earlier: type[FileOfOne] | type[FileOfSeveral] = (
        FileOfOne if head.format_version == 1 else FileOfSeveral
    )
    old = built(content, earlier, MODEL_FILE, file=file, hook=restoring())
    try:
        return old.upgraded()
    except Fault as fault:
        place = fault.key.removeprefix(".")
        raise MODEL_FILE.fault(file, place, fault.problem, fault.expected) from None
