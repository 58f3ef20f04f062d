"""Effects by name: those of pincal, those of plugins, and what a user registers."""

from __future__ import annotations

from pincal.model.at_station import AtStation
from pincal.model.effect import Effect
from pincal.model.effects import ELASTIC, BaseFrame, ToolFrame
from pincal.plugins import Registry


def _check(cls: type[Effect]) -> None:
    for what in ("name", "meaning"):
        text = getattr(cls, what, None)
        if not (isinstance(text, str) and text):
            raise TypeError(
                f"effect {cls.__module__}.{cls.__qualname__} has no {what}; expected {what}: ClassVar[str] = ..."
            )
    if missing := getattr(cls, "__abstractmethods__", None):
        raise TypeError(f"effect {cls.__module__}.{cls.__qualname__} lacks {', '.join(sorted(missing))}")


EFFECTS: Registry[Effect] = Registry("effect", group="pincal.effects", name_of=lambda cls: cls.name, check=_check)


register_effect = EFFECTS.register
"""Make an effect known to model files, discovery and reports, by its name; a class decorator."""


def meaning_of(name: str) -> str:
    """Return what a machine with an effect does, in plain words; empty for a name that nobody knows.

    Example:
        >>> meaning_of("joint_elasticity")
        'the drive twists under the load on its axis'
    """
    known = EFFECTS.known()
    return known[name].meaning if name in known else ""


for _effect in (*map(type, ELASTIC), BaseFrame, ToolFrame, AtStation):
    EFFECTS.register(_effect)
