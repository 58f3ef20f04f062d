"""The parts of a ``model.json``: a robot, its chain and effects, parameters, ranges and set-ups in numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np

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
from pincal.io.packed import unpacked
from pincal.io.strict_json import MOST_BYTES, Fault, Hook
from pincal.measure.lens import Lens
from pincal.measure.named_points import KnownDistance
from pincal.measure.setup import Setup
from pincal.model.chain import Chain, MomentFrame
from pincal.model.effects import Effect
from pincal.model.model import Model
from pincal.parameters import Parameter
from pincal.robot.dh import DhFrames
from pincal.robot.robot import Robot
from pincal.robot.tree import Mimic

# A file of more is none that pincal wrote: an arm has some ten effects for each of its joints.
Effects = Annotated[tuple[Effect, ...], msgspec.Meta(max_length=2000)]


class FramesEntry(Record, frozen=True, kw_only=True):
    """The Denavit-Hartenberg frames of a robot, see :class:`pincal.robot.dh.DhFrames`."""

    T_base_first: Transform
    parameters: Annotated[Matrix, Shape("joints", 6)]
    T_base_link: Transforms
    T_last_tip: Transform


class MimicEntry(Record, frozen=True, kw_only=True):
    """A joint that follows another one, see :class:`pincal.robot.tree.Mimic`."""

    joint: str
    source: str
    multiplier: float
    offset: float


class RobotEntry(Record, frozen=True, kw_only=True):
    """A robot in numbers, see :class:`pincal.robot.robot.Robot`; the text of its URDF may be missing.

    Attributes:
        lower, upper: shape (n,), joint limits [rad or m]; null where there is none.
    """

    NULLS: ClassVar[Mapping[str, float]] = {"lower": -np.inf, "upper": np.inf}

    name: str
    joint_names: Annotated[tuple[str, ...], Shape("joints"), msgspec.Meta(max_length=200)]
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
    mimics: tuple[MimicEntry, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.joint_names:
            raise Fault("has no entries", "at least one joint", key=".joint_names")
        driven = {mimic.joint for mimic in self.mimics}
        for k, mimic in enumerate(self.mimics):
            if mimic.joint not in self.joint_names or mimic.source not in set(self.joint_names) - driven:
                raise Fault("names no joints", "one of the arm that follows another one of its own", key=f".mimics[{k}]")
        shaped(".frames.T_base_link", self.frames.T_base_link, Shape(len(self.joint_names), 4, 4), {})
        try:
            self.urdf_bytes()
        except UnicodeEncodeError as error:
            raise Fault(f"is no text ({error.reason})", "the text of a URDF, or null", key=".urdf") from None

    def urdf_bytes(self) -> bytes:
        """Return the URDF as it was read; bytes that are no UTF-8 are in the file as escapes."""
        return (self.urdf or "").encode("utf-8", "surrogateescape")

    @classmethod
    def of_robot(cls, robot: Robot) -> RobotEntry:
        """Return the entry of a robot."""
        mimics = tuple(MimicEntry.of(mimic) for mimic in robot.mimics)
        urdf = robot.urdf.decode("utf-8", "surrogateescape")
        return cls.of(robot, frames=FramesEntry.of(robot.frames), urdf=urdf, mimics=mimics)

    def robot(self) -> Robot:
        """Return the robot."""
        frames = DhFrames(**msgspec.structs.asdict(self.frames))
        mimics = tuple(Mimic(**msgspec.structs.asdict(mimic)) for mimic in self.mimics)
        return Robot(**msgspec.structs.asdict(self) | {"frames": frames, "urdf": self.urdf_bytes(), "mimics": mimics})


class ChainEntry(Record, frozen=True, kw_only=True):
    """What a chain has beside its robot, see :class:`pincal.model.chain.Chain`.

    Files without ``bearing_heights`` are older than these: their bearings stand at the origins of the joint frames.
    """

    moment_frame: MomentFrame
    gravity: Vector
    base_rotation: Rotation
    targets: Annotated[tuple[str, ...], Shape("targets")]
    tool_rotations: Rotations
    bearing_heights: Annotated[Numbers, Shape("joints")] | None = None


class ModelEntry(Record, frozen=True, kw_only=True):
    """A model, see :class:`pincal.model.model.Model`.

    Attributes:
        robot: the arm.
    """

    robot: RobotEntry
    chain: ChainEntry
    effects: Effects
    equilibrium: bool

    def __post_init__(self) -> None:
        super().__post_init__()
        self.model()

    @classmethod
    def of_model(cls, model: Model) -> ModelEntry:
        """Return the entry of a model."""
        return cls.of(model, robot=RobotEntry.of_robot(model.chain.robot), chain=ChainEntry.of(model.chain))

    def model(self) -> Model:
        """Return the model."""
        return model_of(self.robot.robot(), self.chain, self.effects, equilibrium=self.equilibrium)


def model_of(robot: Robot, chain: ChainEntry, effects: tuple[Effect, ...], *, equilibrium: bool, key: str = "") -> Model:
    """Return a robot's model.

    Raises:
        Fault: below ``key``, if an effect is of a joint or symbol that the robot does not have.
    """
    given, n = msgspec.structs.asdict(chain), robot.n_joints
    if chain.bearing_heights is None:
        given["bearing_heights"] = np.zeros(n)
    elif len(chain.bearing_heights) != n:
        raise Fault(f"has {len(chain.bearing_heights)} entries", f"{n}, one per joint", key=f"{key}.chain.bearing_heights")
    model = Model(Chain(robot=robot, **given), effects, equilibrium=equilibrium)
    try:
        model.parameters  # noqa: B018
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        expected = "joints and symbols of this robot"
        raise Fault(f"do not fit the robot ({error})", expected, key=f"{key}.effects") from None
    return model


class ParameterEntry(Record, frozen=True, kw_only=True):
    """A parameter and what is known of it beforehand, see :class:`pincal.Parameter`; a size of null stands for inf."""

    name: str
    unit: str
    effect: str
    nominal: float
    size: float | None
    station: str = ""

    @classmethod
    def of_parameter(cls, parameter: Parameter) -> ParameterEntry:
        """Return the entry of a parameter."""
        return cls.of(parameter, size=parameter.size if np.isfinite(parameter.size) else None)

    def parameter(self) -> Parameter:
        """Return the parameter."""
        return Parameter(**msgspec.structs.asdict(self) | {"size": np.inf if self.size is None else self.size})


class CoveredEntry(Record, frozen=True, kw_only=True):
    """What the training rows cover.

    Attributes:
        q: shape (n, 2), least and largest position of each joint [rad or m].
        payload: shape (2,), least and largest payload [kg].
        days: mean and standard deviation of temperature [deg C] and time [s] over the training rows, where recorded.
    """

    q: Annotated[Matrix, Shape("joints", 2)]
    payload: Annotated[Numbers, Shape(2)]
    days: dict[Literal["temperature", "time"], tuple[float, float]] | None = None


class PointEntry(Record, frozen=True, kw_only=True):
    """A named point: a socket, an anchor or a point of a calibration object.

    Attributes:
        name: its name in the table.
        position: shape (3,), in the instrument's frame [m]; null where it was not known beforehand.
    """

    name: str
    position: tuple[float, float, float] | None


class SetupEntry(Record, frozen=True, kw_only=True):
    """What was known of a measuring setup, see :class:`pincal.measure.setup.Setup`.

    Attributes:
        points: the named points.
        gaps: known distances between them.
        lens: shape (9,), the camera's fx fy u0 v0 [px] and k1 k2 p1 p2 k3, null where it was not known.
    """

    points: tuple[PointEntry, ...]
    gaps: tuple[KnownDistance, ...]
    lens: Annotated[Numbers, Shape(9)] | None
    fit_lens: bool

    @classmethod
    def of_setup(cls, setup: Setup) -> SetupEntry:
        """Return the entry of a setup."""
        points = tuple(PointEntry(name=name, position=position) for name, position in setup.points.items())
        lens = None if setup.lens is None else setup.lens.values
        return cls(points=points, gaps=setup.distances, lens=lens, fit_lens=setup.fit_lens)

    def setup(self) -> Setup:
        """Return the setup."""
        return Setup(
            points={point.name: point.position for point in self.points},
            distances=self.gaps,
            lens=None if self.lens is None else Lens(*self.lens.tolist()),
            fit_lens=self.fit_lens,
        )


def restored(kind: Any, value: Any) -> Any:
    """Return the array or effect that a value of a JSON file stands for."""
    return array_of(value) if kind is np.ndarray else effect_from_entry(value)


def restoring() -> Hook:
    """Return a function like :func:`restored` that also unpacks matrices, all together of no more bytes than a file has."""
    left = MOST_BYTES

    def with_packed(kind: Any, value: Any) -> Any:
        nonlocal left
        if kind is not np.ndarray or not isinstance(value, str):
            return restored(kind, value)
        found = unpacked(value, left)
        left -= found.nbytes
        return found

    return with_packed


def plain(value: Any) -> Any:
    """Return a record, or what stands in one, in types that JSON knows: effects by name, null for a limit that is not there.

    Fields that have their default are left out.
    """
    if isinstance(value, Record):
        fields = {field.name: field.default for field in msgspec.structs.fields(value)}
        found = {name: getattr(value, name) for name in fields}
        contents = {
            name: value.written(name) if isinstance(part, np.ndarray) else plain(part)
            for name, part in found.items()
            if part is not fields[name]
        }
        for name in value.NULLS:
            contents[name] = [number if np.isfinite(number) else None for number in contents[name]]
        return contents
    if isinstance(value, tuple):
        return [plain(part) for part in value]
    if isinstance(value, Effect):
        return effect_to_entry(value)
    return value.tolist() if isinstance(value, np.ndarray) else msgspec.to_builtins(value)
