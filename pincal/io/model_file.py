"""The structure of ``model.json``: all that a prediction needs in numbers, without the URDF."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np

from pincal.errors import MeasurementError
from pincal.io.arrays import (
    Limits,
    Matrix,
    Numbers,
    Record,
    Rotation,
    Rotations,
    Shape,
    Transform,
    Transforms,
    Vector,
    array_of,
    shaped,
)
from pincal.io.effect_entry import effect_from_entry, effect_to_entry
from pincal.io.strict_json import MODEL_FILE, Fault, read_json, write_json
from pincal.measure.lens import Lens
from pincal.measure.named_points import KnownDistance
from pincal.measure.registry import known_kinds
from pincal.measure.setup import Setup
from pincal.model.chain import Chain, MomentFrame
from pincal.model.effects import Effect
from pincal.model.model import Model
from pincal.parameters import Parameter
from pincal.robot.dh import DhFrames
from pincal.robot.robot import Robot

# Of files with one station, and with several.
FORMAT_VERSION, STATIONS_VERSION = 1, 2


class FramesEntry(Record, frozen=True, kw_only=True):
    """The Denavit-Hartenberg frames of a robot, see :class:`pincal.robot.dh.DhFrames`."""

    T_base_first: Transform
    parameters: Annotated[Matrix, Shape("joints", 6)]
    T_base_link: Transforms
    T_last_tip: Transform


class RobotEntry(Record, frozen=True, kw_only=True):
    """A robot in numbers, see :class:`pincal.robot.robot.Robot`; the text of its URDF may be missing."""

    NULLS: ClassVar[Mapping[str, float]] = {"lower": -np.inf, "upper": np.inf}

    name: str
    joint_names: Annotated[tuple[str, ...], Shape("joints")]
    joint_types: Annotated[tuple[Literal["revolute", "prismatic"], ...], Shape("joints")]
    lower: Annotated[Limits, Shape("joints")]
    upper: Annotated[Limits, Shape("joints")]
    base: str
    tip: str
    frames: FramesEntry
    T_link_joint: Transforms
    masses: Annotated[Numbers, Shape("joints")]
    centres: Annotated[Matrix, Shape("joints", 3)]
    massless: tuple[str, ...]
    gravity: Vector
    notes: tuple[str, ...]
    source: str
    urdf: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.joint_names:
            raise Fault("has no entries", "at least one joint", key=".joint_names")
        shaped(".frames.T_base_link", self.frames.T_base_link, Shape(len(self.joint_names), 4, 4), {})
        try:
            self.urdf_bytes()
        except UnicodeEncodeError as error:
            raise Fault(f"is no text ({error.reason})", "the text of a URDF, or null", key=".urdf") from None

    def urdf_bytes(self) -> bytes:
        """Return the URDF as it was read; bytes that are no UTF-8 are in the file as escapes."""
        return (self.urdf or "").encode("utf-8", "surrogateescape")

    @classmethod
    def of(cls, robot: Robot) -> RobotEntry:
        """Return the entry of a robot."""
        frames = {name: getattr(robot.frames, name) for name in FramesEntry.__struct_fields__}
        same = {name: getattr(robot, name) for name in cls.__struct_fields__ if name not in ("frames", "urdf")}
        return cls(**same, frames=FramesEntry(**frames), urdf=robot.urdf.decode("utf-8", "surrogateescape"))

    def contents(self) -> dict[str, Any]:
        """Return the entry in types that JSON knows, null for limits that are not there."""
        found: dict[str, Any] = msgspec.to_builtins(self, enc_hook=plain)
        limits = {name: [v if np.isfinite(v) else None for v in found[name]] for name in self.NULLS}
        return found | limits

    def robot(self) -> Robot:
        """Return the robot."""
        frames = DhFrames(**msgspec.structs.asdict(self.frames))
        return Robot(**msgspec.structs.asdict(self) | {"frames": frames, "urdf": self.urdf_bytes()})


class ChainEntry(Record, frozen=True, kw_only=True):
    """What a chain has beside its robot, see :class:`pincal.model.chain.Chain`."""

    moment_frame: MomentFrame
    gravity: Vector
    base_rotation: Rotation
    targets: Annotated[tuple[str, ...], Shape("targets")]
    tool_rotations: Rotations

    @classmethod
    def of(cls, chain: Chain) -> ChainEntry:
        """Return the entry of a chain."""
        return cls(**{name: getattr(chain, name) for name in cls.__struct_fields__})


class ModelEntry(Record, frozen=True, kw_only=True):
    """A model, see :class:`pincal.model.model.Model`."""

    robot: RobotEntry
    chain: ChainEntry
    effects: tuple[Effect, ...]
    equilibrium: bool

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            self.model().parameters  # noqa: B018  (an effect of a joint that the robot does not have fails here)
        except (ValueError, LookupError, TypeError, AttributeError) as error:
            expected = "joints and symbols of this robot"
            raise Fault(f"do not fit the robot ({error})", expected, key=".effects") from None

    @classmethod
    def of(cls, model: Model) -> ModelEntry:
        """Return the entry of a model."""
        robot, chain = RobotEntry.of(model.chain.robot), ChainEntry.of(model.chain)
        return cls(robot=robot, chain=chain, effects=model.effects, equilibrium=model.equilibrium)

    def model(self) -> Model:
        """Return the model."""
        chain = Chain(robot=self.robot.robot(), **msgspec.structs.asdict(self.chain))
        return Model(chain, self.effects, equilibrium=self.equilibrium)

    def contents(self) -> dict[str, Any]:
        """Return the entry in types that JSON knows, effects by name."""
        found: dict[str, Any] = msgspec.to_builtins(self, enc_hook=plain)
        return found | {"robot": self.robot.contents(), "effects": [effect_to_entry(effect) for effect in self.effects]}


class ParameterEntry(Record, frozen=True, kw_only=True):
    """A parameter and what is known of it beforehand; a size of null is that of a frame that may be anywhere.

    ``station`` names the one of several stations that it belongs to; it is empty for the robot's own.
    """

    name: str
    unit: str
    effect: str
    nominal: float
    size: float | None
    station: str = ""

    @classmethod
    def of(cls, parameter: Parameter) -> ParameterEntry:
        """Return the entry of a parameter."""
        same = {name: getattr(parameter, name) for name in cls.__struct_fields__ if name != "size"}
        return cls(**same, size=parameter.size if np.isfinite(parameter.size) else None)

    def parameter(self) -> Parameter:
        """Return the parameter."""
        return Parameter(**msgspec.structs.asdict(self) | {"size": np.inf if self.size is None else self.size})


class CoveredEntry(Record, frozen=True, kw_only=True):
    """What the training rows cover, the least and the largest of each: joint positions [rad or m], payload [kg]."""

    q: Annotated[Matrix, Shape("joints", 2)]
    payload: Annotated[Numbers, Shape(2)]


class PointEntry(Record, frozen=True, kw_only=True):
    """A named point, its position [m] null where it was not known beforehand."""

    name: str
    position: tuple[float, float, float] | None


class DistanceEntry(Record, frozen=True, kw_only=True):
    """A known distance between two named points and its standard deviation [m]."""

    first: str
    second: str
    length: float
    sigma: float


class SetupEntry(Record, frozen=True, kw_only=True):
    """What was known of a measuring setup, see :class:`pincal.measure.setup.Setup`; ``gaps`` are the known distances."""

    points: tuple[PointEntry, ...]
    gaps: tuple[DistanceEntry, ...]
    lens: Annotated[Numbers, Shape(9)] | None
    fit_lens: bool

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            self.setup()
        except MeasurementError as error:
            raise Fault(str(error), "distances of two points", key=".gaps") from None

    @classmethod
    def of(cls, setup: Setup) -> SetupEntry:
        """Return the entry of a setup."""
        return cls(
            points=tuple(PointEntry(name=name, position=position) for name, position in setup.points.items()),
            gaps=tuple(
                DistanceEntry(first=gap.first, second=gap.second, length=gap.length, sigma=gap.sigma)
                for gap in setup.distances
            ),
            lens=None if setup.lens is None else setup.lens.values,
            fit_lens=setup.fit_lens,
        )

    def setup(self) -> Setup:
        """Return the setup."""
        return Setup(
            points={point.name: point.position for point in self.points},
            distances=tuple(KnownDistance(gap.first, gap.second, gap.length, gap.sigma) for gap in self.gaps),
            lens=None if self.lens is None else Lens(*self.lens.tolist()),
            fit_lens=self.fit_lens,
        )


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


def restored(kind: Any, value: Any) -> Any:
    """Build what only pincal knows from what a JSON file has."""
    return array_of(value) if kind is np.ndarray else effect_from_entry(value)


def write_model_file(path: str | os.PathLike[str], file: ModelFile) -> None:
    """Write ``model.json``: the whole file or nothing, its numbers in full precision.

    Raises:
        OutputError: if the place can't be written to, or a number is not finite.
    """
    write_json(path, {**msgspec.to_builtins(file, enc_hook=plain), "model": file.model.contents()}, indent=None)


def plain(value: Any) -> Any:
    """Return what only pincal knows in types that JSON knows."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise TypeError(f"a {type(value).__name__} can't be written to a file")
