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


class Found(msgspec.Struct, frozen=True, kw_only=True):
    """A parameter of an effect [SI units]."""

    value: float
    sigma: float
    unit: str


class EffectEntry(EffectName, frozen=True, kw_only=True, omit_defaults=True):
    """An effect that was found, in the order in which they were accepted."""

    parameters: dict[str, Found]
    p_value: float
    gap_before_mm: float
    gap_after_mm: float
    equivalent: tuple[EffectName, ...]
    tell_apart: str
    period: float | None = None


class Place(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Where the readings disagree with the model, and the share of the excess over the noise that stands there."""

    statement: str
    share: float
    joint: str | None = None
    region: str | None = None
    acts_on: str | None = None
    depends_on: str | None = None


class ScatterEntry(msgspec.Struct, frozen=True, kw_only=True):
    """A joint that repeats badly, and the column that could explain it."""

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
    where: tuple[Place, ...]
    effects: tuple[EffectEntry, ...]
    scatter: tuple[ScatterEntry, ...]
    not_testable: tuple[Untestable, ...]
    verdict: Literal["adequate", "not adequate"]
    unexplained_mm: float
