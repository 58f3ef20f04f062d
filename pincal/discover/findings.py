"""What a discovery comes to, typed; ``discovery.json`` is a view of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

from pincal.discover.shrink import StageError
from pincal.model.effect import Effect


class Verdict(StrEnum):
    """Whether the model, with all that was found, explains the data."""

    ADEQUATE = "adequate"
    NOT_ADEQUATE = "not adequate"


@dataclass(frozen=True)
class FoundParameter:
    """A parameter of an effect.

    Attributes:
        value: its value [``unit``].
        sigma: its standard deviation [``unit``], that of the prior where it was not fitted; None for nothing known.
        unit: the unit.
    """

    value: float
    sigma: float | None
    unit: str


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
            "parameters": {name: asdict(parameter) for name, parameter in self.parameters.items()},
            "p_value": self.p_value,
            "gap_before_mm": self.gap_before_mm,
            "gap_after_mm": self.gap_after_mm,
            "equivalent": [effect.describe() for effect in self.equivalent],
            "tell_apart": self.tell_apart,
        }


@dataclass(frozen=True)
class Disagreement:
    """Where model and data disagree.

    Attributes:
        statement: what is to be said of it.
        share: part of the excess over the noise, 0 to 1.
        joint: the joint; None for a region.
        region: the region, where it is not one joint: "whole arm", "reach 0.80 to 1.10 m", ...
        acts_on: what moves there, where that is known: "drive", "gamma_x", "base", ...
        depends_on: the variable that it follows, where that is known.
    """

    statement: str
    share: float
    joint: str | None = None
    region: str | None = None
    acts_on: str | None = None
    depends_on: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of ``discovery.json``."""
        place = {"joint": self.joint} if self.joint is not None else {"region": self.region}
        follows = {} if self.acts_on is None else {"acts_on": self.acts_on, "depends_on": self.depends_on}
        return place | {"statement": self.statement, "share": self.share} | follows


@dataclass(frozen=True)
class ScatteringJoint:
    """A joint that is somewhere else each time.

    Attributes:
        joint: the joint.
        sigma_rad: standard deviation of its position [rad; m of a sliding joint].
        missing: the column that could explain it.
    """

    joint: str
    sigma_rad: float
    missing: str


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
            "where": [entry.to_dict() for entry in self.where],
            "effects": [entry.to_dict() for entry in self.effects],
            "scatter": [asdict(entry) for entry in self.scatter],
            "not_testable": [entry.to_dict() for entry in self.not_testable],
            "verdict": str(self.verdict),
            "unexplained_mm": self.unexplained_mm,
        }
