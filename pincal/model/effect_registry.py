"""Effects by name: pincal's own, those of plugins, and those that a user registers."""

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
                f"effect {cls.__module__}.{cls.__qualname__} has no {what}; expected "
                f"{what}: ClassVar[str] = ..."
            )
    if missing := getattr(cls, "__abstractmethods__", None):
        raise TypeError(
            f"effect {cls.__module__}.{cls.__qualname__} lacks {', '.join(sorted(missing))}"
        )


EFFECTS: Registry[Effect] = Registry(
    "effect", group="pincal.effects", name_of=lambda cls: cls.name, check=_check
)


register_effect = EFFECTS.register
"""Class decorator that registers an effect by name for model files, discovery and reports."""


def meaning_of(name: str) -> str:
    """Return how a machine with an effect behaves, in plain words; empty for an unknown name.

    Example:
        >>> meaning_of("joint_elasticity")
        'the drive twists under the load on its axis'
    """
    known = EFFECTS.known()
    return known[name].meaning if name in known else ""


for _effect in (*map(type, ELASTIC), BaseFrame, ToolFrame, AtStation):
    EFFECTS.register(_effect)
