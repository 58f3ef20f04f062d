"""What a discovery comes to, typed; ``discovery.json`` is a view of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import msgspec

from pincal.discover.shrink import StageError
from pincal.io.discovery_file import Disagreement, FoundParameter, ScatteringJoint
from pincal.model.effect import Effect


class Verdict(StrEnum):
    """Whether the model, with all that was found, explains the data."""

    ADEQUATE = "adequate"
    NOT_ADEQUATE = "not adequate"


@dataclass(frozen=True)
class FoundEffect:
    """An effect that was found.

    Attributes:
        effect: the effect; of elasticity that of one joint.
        parameters: its parameters by name.
        p_value: chance that sound data look like this.
        gap_before_mm: mean error on held-out rows before it entered the model [mm].
        gap_after_mm: the same with it [mm].
        equivalent: effects that the data can't tell from it.
        tell_apart: the cheapest measurement that would tell it from the first of them; empty without one.
        period: of a periodic dependence without a name, in units of its variable; None of any other.
    """

    effect: Effect
    parameters: Mapping[str, FoundParameter]
    p_value: float
    gap_before_mm: float
    gap_after_mm: float
    equivalent: tuple[Effect, ...] = ()
    tell_apart: str = ""
    period: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of ``discovery.json``."""
        return {
            **self.effect.describe(),
            **({} if self.period is None else {"period": self.period}),
            "parameters": msgspec.to_builtins(self.parameters),
            "p_value": self.p_value,
            "gap_before_mm": self.gap_before_mm,
            "gap_after_mm": self.gap_after_mm,
            "equivalent": [effect.describe() for effect in self.equivalent],
            "tell_apart": self.tell_apart,
        }


@dataclass(frozen=True)
class Untestable:
    """An effect that these data can't show.

    Attributes:
        effect: the effect.
        reason: why.
    """

    effect: Effect
    reason: str

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of ``discovery.json``."""
        return {**self.effect.describe(), "reason": self.reason}


@dataclass(frozen=True)
class Findings:
    """What a discovery found.

    Attributes:
        noise_floor_mm: what the noise alone makes of the error [mm].
        before: errors on held-out rows at the start.
        after: errors on them in the end.
        where: where model and data disagree, before anything is named.
        effects: what was found, in the order in which it entered the model.
        scatter: the joint that scatters in the end, if one does.
        not_testable: what these data can't show.
        verdict: whether the model explains the data in the end.
        unexplained_mm: what is left beyond the noise [mm].
    """

    noise_floor_mm: float
    before: StageError
    after: StageError
    where: tuple[Disagreement, ...]
    effects: tuple[FoundEffect, ...]
    scatter: tuple[ScatteringJoint, ...]
    not_testable: tuple[Untestable, ...]
    verdict: Verdict
    unexplained_mm: float

    def to_dict(self) -> dict[str, Any]:
        """Return the contents of ``discovery.json``."""
        return {
            "noise_floor_mm": self.noise_floor_mm,
            "gap": {"before": self.before.to_dict(), "after": self.after.to_dict()},
            "where": msgspec.to_builtins(self.where),
            "effects": [entry.to_dict() for entry in self.effects],
            "scatter": msgspec.to_builtins(self.scatter),
            "not_testable": [entry.to_dict() for entry in self.not_testable],
            "verdict": str(self.verdict),
            "unexplained_mm": self.unexplained_mm,
        }
