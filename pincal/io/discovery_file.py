"""The structure of ``discovery.json``."""

from __future__ import annotations

from typing import Literal

import msgspec


class Gap(msgspec.Struct, frozen=True, kw_only=True):
    """Errors on held-out rows [mm]."""

    mean_mm: float
    rms_mm: float
    max_mm: float


class EffectName(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What tells an effect from its likes; ``joint`` is null for effects of the whole arm."""

    effect: str
    joint: str | None
    source: str | None = None
    order: int | None = None
    depends_on: str | None = None
    acts_on: str | None = None
    shape: str | None = None
    place: float | str | None = None


class FoundParameter(msgspec.Struct, frozen=True):
    """A parameter of an effect.

    Attributes:
        value: its value [``unit``].
        sigma: its standard deviation [``unit``], that of the prior where it was not fitted; None for nothing known.
        unit: the unit.
    """

    value: float
    sigma: float | None
    unit: str


class EffectEntry(EffectName, frozen=True, kw_only=True, omit_defaults=True):
    """An effect that was found, in the order in which they were accepted."""

    parameters: dict[str, FoundParameter]
    p_value: float
    gap_before_mm: float
    gap_after_mm: float
    equivalent: tuple[EffectName, ...]
    tell_apart: str
    period: float | None = None


class Disagreement(msgspec.Struct, frozen=True, omit_defaults=True):
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


class ScatteringJoint(msgspec.Struct, frozen=True):
    """A joint that does not return to the same position.

    Attributes:
        joint: the joint.
        sigma_rad: standard deviation of its position [rad; m of a sliding joint].
        missing: the column that could explain it.
    """

    joint: str
    sigma_rad: float
    missing: str


class Untestable(EffectName, frozen=True, kw_only=True, omit_defaults=True):
    """An effect that these data can't test, and why."""

    reason: str


class DiscoveryFile(msgspec.Struct, frozen=True, kw_only=True):
    """The whole of ``discovery.json``."""

    noise_floor_mm: float
    gap: dict[Literal["before", "after"], Gap]
    where: tuple[Disagreement, ...]
    effects: tuple[EffectEntry, ...]
    scatter: tuple[ScatteringJoint, ...]
    not_testable: tuple[Untestable, ...]
    verdict: Literal["adequate", "not adequate"]
    unexplained_mm: float
