"""The structure of ``model.json``: all that a prediction needs in numbers, without the URDF."""

from __future__ import annotations

import os
from typing import Annotated, Any

import msgspec

from pincal.io.arrays import (
    Matrix,
    Numbers,
    Record,
    Shape,
    Vector,
    shaped,
)
from pincal.io.entries import CoveredEntry, ModelEntry, ParameterEntry, SetupEntry, plain, restored
from pincal.io.strict_json import MODEL_FILE, Fault, read_json, write_json
from pincal.measure.registry import known_kinds

# Of files with one station, and with several.
FORMAT_VERSION, STATIONS_VERSION = 1, 2


def sensor_module(kind: str) -> str | None:
    """Return the module that defines a sensor, None for one of pincal's own."""
    module = known_kinds().get(kind, "pincal")
    return None if module.split(".")[0] == "pincal" else module


def check_sensor(kind: str, module: str | None) -> None:
    """Refuse a sensor that is not known.

    Raises:
        Fault: naming the module that has to be loaded, if there is one.
    """
    if kind in known_kinds():
        return
    if module:
        expected = f"its module to be loaded: --plugin {module}"
        raise Fault(f"sensor {kind!r} is not pincal's own", expected, key=".sensor_kind")
    raise Fault(f"unknown sensor {kind!r}", f"one of {', '.join(known_kinds())}", key=".sensor_kind")


class ModelFile(Record, frozen=True, kw_only=True):
    """The whole of ``model.json``.

    Attributes:
        format_version: 1.
        provenance: versions, time, command, seed, input files with their SHA-256.
        sensor_kind: what was measured: "position", "pose", "distance" and so on.
        sensor_module: the module that defines the sensor, if it is not one of pincal's own. Reading never imports it.
        sigma: shape (blocks,), noise of one component of each block of readings that the fit used [m, rad, px].
        payload_centre: shape (3,), centre of mass of the payload in the tip frame [m].
        covered: the range of the training rows.
        parameters: the P parameters of the model, then the sensor's own.
        values: shape (P,), deviations from the nominal.
        covariance: shape (P, P), of the values; zero for those that were not fitted.
        model: robot, chain and effects.
        setup: named points and the camera.
        nominal_values: shape (P,), the values with only base and tool fitted; not in files of version 0.1.0.
    """

    format_version: int
    provenance: dict[str, Any]
    sensor_kind: str
    sigma: Annotated[Numbers, Shape("any")]
    payload_centre: Vector
    covered: CoveredEntry
    parameters: Annotated[tuple[ParameterEntry, ...], Shape("parameters")]
    values: Annotated[Numbers, Shape("parameters")]
    covariance: Annotated[Matrix, Shape("parameters", "parameters")]
    model: ModelEntry
    setup: SetupEntry
    sensor_module: str | None = None
    nominal_values: Annotated[Numbers | None, Shape("parameters")] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_sensor(self.sensor_kind, self.sensor_module)
        names = self.model.model().names
        if tuple(p.name for p in self.parameters)[: len(names)] != names:
            raise Fault("are not those of the effects", f"{', '.join(names[:3])} and so on", key=".parameters")
        shaped(".covered.q", self.covered.q, Shape(len(self.model.robot.joint_names), 2), {})


class _Name(msgspec.Struct, frozen=True):
    name: str


class _Stations(msgspec.Struct, frozen=True):
    stations: tuple[_Name, ...]


class _Head(msgspec.Struct, frozen=True):
    """What is read first: whether the rest can be read at all."""

    format_version: int

    def __post_init__(self) -> None:
        if self.format_version < 1:
            expected = f"a whole number up to {STATIONS_VERSION}"
            raise Fault(f"is {self.format_version}", expected, key=".format_version")


def version_of(path: str | os.PathLike[str]) -> int:
    """Return the format version of a ``model.json``: 1 for one station, 2 for several.

    Raises:
        ModelFileError: if the file can't be read, is cut off or newer than this version.
    """
    version = read_json(path, _Head, MODEL_FILE).format_version
    if version > STATIONS_VERSION:
        raise MODEL_FILE.error(
            f"{os.fspath(path)}: format_version is {version}, written by a newer pincal; "
            f"expected at most {STATIONS_VERSION}: update pincal"
        )
    return version


def read_model_file(path: str | os.PathLike[str]) -> ModelFile:
    """Read ``model.json`` of one station.

    Raises:
        ModelFileError: if the file can't be read, is cut off or newer than this version, or a value is invalid.
    """
    version = version_of(path)
    if version == STATIONS_VERSION:
        names = ", ".join(entry.name for entry in read_json(path, _Stations, MODEL_FILE).stations)
        raise MODEL_FILE.error(
            f"{os.fspath(path)}: holds several stations: {names}; expected one: choose it by load_stations(path).at(name)"
        )
    return read_json(path, ModelFile, MODEL_FILE, hook=restored)


def write_model_file(path: str | os.PathLike[str], file: ModelFile) -> None:
    """Write ``model.json``: the whole file or nothing, its numbers in full precision.

    Raises:
        OutputError: if the place can't be written to, or a number is not finite.
    """
    write_json(path, {**msgspec.to_builtins(file, enc_hook=plain), "model": file.model.contents()}, indent=None)
