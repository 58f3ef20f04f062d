"""The parts of a ``model.json``: chain, effects, parameters and set-ups as records."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import Field, fields
from functools import cache
from typing import Annotated, Any

import msgspec
import numpy as np

# Imported for its classes, which it registers.
import pincal.model.catalogue  # noqa: F401
from pincal.errors import nearest_first, warn
from pincal.io.arrays import (
    ArrayShape,
    Numbers,
    Record,
    Rotation,
    Rotations,
    Vector,
    array_of,
    is_half,
    unpacked,
)
from pincal.io.robot_entry import PathEntry, RobotEntry
from pincal.io.strict_json import MISSING, MOST_BYTES, Fault, Hook, explained, what_is
from pincal.model.chain import Chain, MomentFrame
from pincal.model.effect import Effect
from pincal.model.effect_registry import EFFECTS
from pincal.model.model import Model
from pincal.parameters import Parameter
from pincal.robot.robot import Robot
from pincal.sensors.lens import Lens
from pincal.sensors.setup import KnownDistance, Setup

# JSON Schema common to all effects in a file.
EFFECT_SCHEMA: dict[str, Any] = {
    "type": "object",
    "properties": {"name": {"type": "string"}},
    "required": ["name"],
}
# More than pincal writes: an arm has about ten effects for each of its joints.
Effects = Annotated[tuple[Effect, ...], msgspec.Meta(max_length=2000)]


class ChainEntry(Record, frozen=True, kw_only=True):
    """Data of a chain in addition to its robot, see :class:`pincal.model.chain.Chain`.

    Older files have no ``bearing_heights``: their bearings are at the origins of the joint frames.

    Attributes:
        on_carriages: whether prismatic joints bear and deflect on their carriages, and not where
            their travel starts, as in older files.
    """

    moment_frame: MomentFrame
    gravity: Vector
    base_rotation: Rotation
    targets: Annotated[tuple[str, ...], ArrayShape("targets")]
    tool_rotations: Rotations
    bearing_heights: Annotated[Numbers, ArrayShape("joints")] | None = None
    ends: PathEntry | None = None
    on_carriages: bool = False

    @classmethod
    def of_chain(cls, chain: Chain) -> ChainEntry:
        """Return the entry of a chain."""
        return cls.like(chain, ends=PathEntry.of_path(chain.ends), on_carriages=True)


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
        return cls.like(
            model,
            robot=RobotEntry.of_robot(model.chain.robot),
            chain=ChainEntry.of_chain(model.chain),
        )

    def model(self) -> Model:
        """Return the model."""
        return model_of(self.robot.robot(), self.chain, self.effects, equilibrium=self.equilibrium)


def model_of(
    robot: Robot,
    chain: ChainEntry,
    effects: tuple[Effect, ...],
    *,
    equilibrium: bool,
    key: str = "",
) -> Model:
    """Return a robot's model.

    Raises:
        Fault: below ``key``, if an effect has a joint or symbol that the robot lacks.
    """
    given = msgspec.structs.asdict(chain)
    n = robot.n_joints
    is_of_carriages = given.pop("on_carriages")
    kinds = zip(robot.joint_names, robot.joint_types, strict=True)
    slides = [name for name, kind in kinds if kind == "prismatic"]
    if slides and not is_of_carriages and any(effect.uses_moments for effect in effects):
        warn(
            f"{robot.name}: an earlier version took the moments on {', '.join(slides)} "
            "about the start of the travel, and "
            "this one takes them about the carriage: deflections by the load differ; "
            "calibrate again from the same table"
        )
    given["ends"] = None if chain.ends is None else chain.ends.path(n, f"{key}.chain.ends")
    if chain.bearing_heights is None:
        given["bearing_heights"] = np.zeros(n)
    elif len(chain.bearing_heights) != n:
        raise Fault(
            f"has {len(chain.bearing_heights)} entries",
            f"{n}, one per joint",
            key=f"{key}.chain.bearing_heights",
        )
    model = Model(Chain(robot=robot, **given), effects, equilibrium=equilibrium)
    try:
        model.parameters  # noqa: B018
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        expected = "joints and symbols of this robot"
        raise Fault(f"do not fit the robot ({error})", expected, key=f"{key}.effects") from None
    return model


class ParameterEntry(Record, frozen=True, kw_only=True):
    """A parameter and its prior, see :class:`pincal.parameters.Parameter`; a size of null stands
    for inf.
    """

    name: str
    unit: str
    effect: str
    nominal: float
    size: float | None
    station: str = ""

    @classmethod
    def of_parameter(cls, parameter: Parameter) -> ParameterEntry:
        """Return the entry of a parameter."""
        return cls.like(parameter, size=parameter.size if np.isfinite(parameter.size) else None)

    def parameter(self) -> Parameter:
        """Return the parameter."""
        return Parameter(
            **msgspec.structs.asdict(self) | {"size": np.inf if self.size is None else self.size}
        )


class PointEntry(Record, frozen=True, kw_only=True):
    """A named point: a socket, an anchor or a point of a calibration object.

    Attributes:
        name: its name in the table.
        position: shape (3,), in the instrument's frame [m]; null if unknown.
    """

    name: str
    position: tuple[float, float, float] | None


class SetupEntry(Record, frozen=True, kw_only=True):
    """Known parts of a measurement set-up, see :class:`pincal.sensors.setup.Setup`.

    Attributes:
        points: the named points.
        gaps: known distances between them.
        lens: shape (9,), the camera's fx fy u0 v0 [px] and k1 k2 p1 p2 k3, null if unknown.
    """

    points: tuple[PointEntry, ...]
    gaps: tuple[KnownDistance, ...]
    lens: Annotated[Numbers, ArrayShape(9)] | None
    fit_lens: bool

    @classmethod
    def of_setup(cls, setup: Setup) -> SetupEntry:
        """Return the entry of a setup."""
        points = tuple(
            PointEntry(name=name, position=position) for name, position in setup.points.items()
        )
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


def restoring() -> Hook:
    """Return a function that returns the array or effect represented by a value of a JSON file.

    All matrices that it unpacks hold together at most as many bytes as a file.
    """
    left = MOST_BYTES

    def restored(kind: Any, value: Any) -> Any:
        nonlocal left
        if kind is not np.ndarray:
            return effect_from_entry(value)
        if not isinstance(value, str):
            return array_of(value)
        found = unpacked(value, left)
        left -= found.nbytes // 2 if is_half(value) else found.nbytes
        return found

    return restored


def plain(value: Any) -> Any:
    """Return a record, or a value in one, in JSON types; fields with their default are omitted."""
    if value is None or type(value) in (str, int, float, bool):
        return value
    if isinstance(value, Record):
        found = ((name, getattr(value, name), default) for name, default in _defaults(type(value)))
        return {
            name: value.written(name) if isinstance(part, np.ndarray) else plain(part)
            for name, part, default in found
            if part is not default
        }
    if isinstance(value, tuple):
        return [plain(part) for part in value]
    if isinstance(value, Effect):
        return effect_to_entry(value)
    return value.tolist() if isinstance(value, np.ndarray) else msgspec.to_builtins(value)


@cache
def _defaults(kind: type[Record]) -> list[tuple[str, Any]]:
    """Return the fields of a kind of records and their defaults, cached as they take longer to find
    than to write.
    """
    return [(field.name, field.default) for field in msgspec.structs.fields(kind)]


def effect_to_entry(effect: Effect) -> dict[str, Any]:
    """Return an effect's name and fields in JSON types; an array is ``{"array": ...}``.

    The entry of a custom effect contains its module, which reading never imports: a user has to
    name it, as a plugin.
    """
    module = type(effect).__module__
    origin = {} if module.split(".")[0] == "pincal" else {"module": module}
    values = {field.name: getattr(effect, field.name) for field in _fields(effect)}
    values = {
        name: effect_to_entry(value) if isinstance(value, Effect) else value
        for name, value in values.items()
    }
    return {"name": effect.name, **origin, **msgspec.to_builtins(values, enc_hook=_plain)}


def _known_name(entry: Mapping[str, Any], known: Collection[str]) -> str:
    """Return the name of an effect's entry; refuse one that is missing or unknown."""
    if "name" not in entry:
        raise Fault(MISSING, "this key", key=".name")
    name = entry["name"]
    if not isinstance(name, str):
        raise Fault(what_is(name, "a string"), "a string", key=".name")
    if name in known:
        return name
    if isinstance(module := entry.get("module"), str):
        raise Fault(
            f"effect {name!r} is not pincal's own",
            f"its module to be loaded: --plugin {module}",
            key=".name",
        )
    names = ", ".join(nearest_first([name], sorted(known)))
    raise Fault(
        f"unknown effect {name!r}", f"one of {names} (a newer pincal may know it)", key=".name"
    )


def effect_from_entry(entry: Any) -> Effect:
    """Return the effect of :func:`effect_to_entry`; missing fields have their defaults.

    Raises:
        Fault: for an unknown name, or unknown or invalid fields.
    """
    if not isinstance(entry, dict):
        raise Fault(what_is(entry, "an object"), "an object")
    known = EFFECTS.known()
    name = _known_name(entry, known)
    given = {key: value for key, value in entry.items() if key not in ("name", "module")}
    wanted = [field.name for field in _fields(known[name])]
    for key in given.keys() - set(wanted):
        raise Fault(
            f"{name} has no such field", f"only {', '.join(wanted) or 'the name'}", key=f".{key}"
        )
    try:
        return msgspec.convert(given, known[name], dec_hook=_restored)
    except msgspec.ValidationError as error:
        place, problem, expected = explained(error, lambda: given, known[name])
        raise Fault(problem, expected, key=f".{place}" if place else "") from None
    except (TypeError, ValueError) as error:
        raise Fault(
            f"{name} can't be built from these fields ({error})", "fields as pincal writes them"
        ) from None


def _fields(effect: Effect | type[Effect]) -> tuple[Field[Any], ...]:
    # Every effect is a dataclass, which the abstract base can't declare.
    return tuple(field for field in fields(effect) if field.init)  # type: ignore[arg-type]


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {"array": value.tolist()}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(
        f"a field of type {type(value).__name__} can't be written to model.json; use "
        "numbers, strings, tuples"
    )


def _restored(kind: Any, value: Any) -> Any:
    if kind is Effect:
        return effect_from_entry(value)
    if kind is np.ndarray and isinstance(value, dict) and "array" in value:
        return array_of(value["array"])
    raise Fault(what_is(value, "an array"), 'an array, {"array": ...}')
