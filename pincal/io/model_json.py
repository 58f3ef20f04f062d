"""A model as JSON and back: the robot in numbers, the chain, and the effects by name."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import MISSING, Field, fields
from difflib import get_close_matches
from typing import Any

import numpy as np

# Imported for its classes, which known_effects finds.
import pincal.model.catalogue  # noqa: F401
from pincal.io.json_section import Section
from pincal.model.chain import MOMENT_FRAMES, Chain
from pincal.model.effects import Effect
from pincal.model.model import Model
from pincal.parameters import Parameter
from pincal.robot.dh import DhFrames
from pincal.robot.robot import Robot

_JOINT_TYPES = ("revolute", "prismatic")


def model_to_json(model: Model) -> dict[str, Any]:
    """Return all that a model predicts from, in types that JSON knows."""
    chain = model.chain
    return {
        "robot": _robot_to_json(chain.robot),
        "chain": {
            "moment_frame": chain.moment_frame,
            "gravity": chain.gravity.tolist(),
            "base_rotation": chain.base_rotation.tolist(),
            "targets": list(chain.targets),
            "tool_rotations": chain.tool_rotations.tolist(),
        },
        "effects": [effect_to_json(effect) for effect in model.effects],
        "equilibrium": model.equilibrium,
    }


def model_from_json(section: Section) -> Model:
    """Return the model of :func:`model_to_json`.

    Raises:
        ModelFileError: if a key is missing or its value can't be right.
    """
    chain = _chain_from_json(section.at("chain"), _robot_from_json(section.at("robot")))
    effects = tuple(effect_from_json(entry) for entry in section.at("effects").items())
    model = Model(chain, effects, equilibrium=section.at("equilibrium").flag())
    try:
        model.parameters  # noqa: B018  (an effect of a joint that the robot does not have fails here)
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise section.at("effects").error(f"do not fit the robot ({error})", "joints and symbols of this robot") from None
    return model


def parameters_to_json(parameters: Sequence[Parameter]) -> list[dict[str, Any]]:
    """Return what is known of parameters beforehand; a size of null is that of a frame that may be anywhere."""
    return [
        {
            "name": p.name,
            "unit": p.unit,
            "effect": p.effect,
            "nominal": p.nominal,
            "size": p.size if np.isfinite(p.size) else None,
        }
        for p in parameters
    ]


def parameters_from_json(section: Section) -> tuple[Parameter, ...]:
    """Return the parameters of :func:`parameters_to_json`."""
    return tuple(
        Parameter(
            entry.at("name").text(),
            entry.at("unit").text(),
            entry.at("effect").text(),
            entry.at("nominal").number(),
            entry.at("size").number(null=np.inf),
        )
        for entry in section.items()
    )


def known_effects() -> dict[str, type[Effect]]:
    """Return the effects by name: every one that an imported module defines."""
    return {cls.name: cls for cls in _below(Effect) if "name" in vars(cls)}


def _below(cls: Any) -> Iterator[type[Effect]]:
    for child in cls.__subclasses__():
        yield child
        yield from _below(child)


def effect_to_json(effect: Effect) -> dict[str, Any]:
    """Return an effect's name and the fields of its dataclass."""
    return {"name": effect.name} | {field.name: _plain(getattr(effect, field.name)) for field in _fields(effect)}


def effect_from_json(section: Section) -> Effect:
    """Return the effect of :func:`effect_to_json`; a field that the file does not have keeps its default.

    Raises:
        ModelFileError: if no effect has this name, or not these fields.
    """
    name, known = section.at("name").text(), known_effects()
    if name not in known:
        near = get_close_matches(name, known, n=3, cutoff=0.5)
        names = ", ".join(near + sorted(set(known) - set(near)))
        raise section.at("name").error(f"unknown effect {name!r}", f"one of {names} (a newer pincal may know it)")
    cls = known[name]
    wanted = {field.name: field for field in _fields(cls)}
    for key in section.value:
        if key != "name" and key not in wanted:
            raise section.at(key).error(f"{name} has no such field", f"only {', '.join(wanted) or 'the name'}")
    given = {key: _restored(section.at(key)) for key, field in wanted.items() if key in section.value or _is_needed(field)}
    try:
        return cls(**given)
    except (TypeError, ValueError) as error:
        raise section.error(f"{name} can't be made of these fields ({error})", "fields as pincal writes them") from None


def _fields(effect: Effect | type[Effect]) -> tuple[Field[Any], ...]:
    # Every effect is a dataclass, which the abstract base can't say.
    return tuple(field for field in fields(effect) if field.init)  # type: ignore[arg-type]


def _is_needed(field: Field[Any]) -> bool:
    return field.default is MISSING and field.default_factory is MISSING


def _plain(value: Any) -> Any:
    """Return a field in types that JSON knows: a list is a tuple, {"array": ...} an array."""
    if value is None or isinstance(value, (str, bool, int, float)):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return {"array": value.tolist()}
    if isinstance(value, (tuple, list)):
        return [_plain(entry) for entry in value]
    raise TypeError(f"a field of type {type(value).__name__} can't be written to model.json; use numbers, texts and tuples")


def _restored(section: Section) -> Any:
    value = section.value
    if isinstance(value, list):
        return tuple(_restored(entry) for entry in section.items())
    if isinstance(value, dict):
        return section.at("array").array()
    if isinstance(value, float):
        return section.number()
    return value


def _robot_to_json(robot: Robot) -> dict[str, Any]:
    frames = robot.frames
    return {
        "name": robot.name,
        "joint_names": list(robot.joint_names),
        "joint_types": list(robot.joint_types),
        "lower": [value if np.isfinite(value) else None for value in robot.lower.tolist()],
        "upper": [value if np.isfinite(value) else None for value in robot.upper.tolist()],
        "base": robot.base,
        "tip": robot.tip,
        "frames": {
            "T_base_first": frames.T_base_first.tolist(),
            "parameters": frames.parameters.tolist(),
            "T_base_link": frames.T_base_link.tolist(),
            "T_last_tip": frames.T_last_tip.tolist(),
        },
        "T_link_joint": robot.T_link_joint.tolist(),
        "masses": robot.masses.tolist(),
        "centres": robot.centres.tolist(),
        "massless": list(robot.massless),
        "gravity": robot.gravity.tolist(),
        "notes": list(robot.notes),
        "source": robot.source,
        # Bytes that are no UTF-8 survive as escapes.
        "urdf": robot.urdf.decode("utf-8", "surrogateescape"),
    }


def _robot_from_json(section: Section) -> Robot:
    names = section.at("joint_names").texts()
    n, frames = len(names), section.at("frames")
    types = tuple(entry.choice(*_JOINT_TYPES) for entry in section.at("joint_types").items())
    if n == 0 or len(types) != n:
        raise section.at("joint_types").error(f"has {len(types)} entries", f"one for each of {n} joints, and at least one")
    return Robot(
        name=section.at("name").text(),
        joint_names=names,
        joint_types=types,
        lower=section.at("lower").numbers(n, null=-np.inf),
        upper=section.at("upper").numbers(n, null=np.inf),
        base=section.at("base").text(),
        tip=section.at("tip").text(),
        frames=DhFrames(
            T_base_first=frames.at("T_base_first").numbers(4, 4),
            parameters=frames.at("parameters").numbers(n, 6),
            T_base_link=frames.at("T_base_link").numbers(n, 4, 4),
            T_last_tip=frames.at("T_last_tip").numbers(4, 4),
        ),
        T_link_joint=section.at("T_link_joint").numbers(n, 4, 4),
        masses=section.at("masses").numbers(n),
        centres=section.at("centres").numbers(n, 3),
        massless=section.at("massless").texts(),
        gravity=section.at("gravity").numbers(3),
        notes=section.at("notes").texts(),
        urdf=_bytes(section.at("urdf")) if section.value.get("urdf") is not None else b"",
        source=section.at("source").text(),
    )


def _bytes(section: Section) -> bytes:
    try:
        return section.text().encode("utf-8", "surrogateescape")
    except UnicodeEncodeError as error:
        raise section.error(f"is no text ({error.reason})", "the text of a URDF, or null") from None


def _chain_from_json(section: Section, robot: Robot) -> Chain:
    targets = section.at("targets").texts()
    section.at("moment_frame").choice(*MOMENT_FRAMES)
    return Chain(
        robot,
        moment_frame=section.at("moment_frame").value,
        gravity=section.at("gravity").numbers(3),
        base_rotation=section.at("base_rotation").numbers(3, 3),
        targets=targets,
        tool_rotations=section.at("tool_rotations").numbers(len(targets), 3, 3),
    )
