"""What a diagnosis found: the one structure behind ``diagnosis.json``, the report and the terminal."""

from __future__ import annotations

from typing import Literal

import msgspec

from pincal.notes import Note


class ChangeName(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What changed.

    Attributes:
        effect: its name in the catalogue; "unnamed" where nothing explains it.
        joint: the joint on which it acts; null for the whole arm.
        source: the joint whose position it follows, where that is another one.
    """

    effect: str
    joint: str | None
    source: str | None = None


class ChangedParameter(msgspec.Struct, frozen=True):
    """A parameter that changed.

    Attributes:
        before, after: its value as calibrated and now [``unit``].
        sigma: standard deviation of the change [``unit``].
        unit: the unit.
    """

    before: float
    after: float
    sigma: float
    unit: str


class ChangeEntry(ChangeName, frozen=True, kw_only=True, omit_defaults=True):
    """A change that was found, the surest first.

    Attributes:
        parameters: what moved.
        p_value: chance of such an alarm on a robot that has not changed.
        equivalent: other changes that these poses can't tell from it.
        tell_apart: which poses would; empty where there are none.
    """

    parameters: dict[str, ChangedParameter]
    p_value: float
    equivalent: tuple[ChangeName, ...]
    tell_apart: str


class ExcludedEntry(ChangeName, frozen=True, kw_only=True, omit_defaults=True):
    """A change that would have been noticed.

    Attributes:
        parameter: what would have moved; empty for an effect of several parameters.
        smallest: size from which it is noticed with 90 % [``unit``].
        unit: the unit.
        tip_mm: how far that moves the target in these poses, at most.
    """

    parameter: str = ""
    smallest: float
    unit: str
    tip_mm: float


class MovedEntry(msgspec.Struct, frozen=True):
    """How far instrument and target moved since the calibration; null where these data don't tell.

    Attributes:
        moved_mm: distance between the instrument's places in the robot's base frame [mm].
        turned_mrad: angle between its orientations [mrad].
        target_moved_mm: distance between the target's places on the tool [mm].
    """

    moved_mm: float | None
    turned_mrad: float | None
    target_moved_mm: float | None


class DiagnosisFile(msgspec.Struct, frozen=True, kw_only=True):
    """The whole of ``diagnosis.json``.

    Attributes:
        changed: whether the robot is other than its model says.
        p_value: chance of such an alarm on a robot that has not changed.
        alpha: the chance of a false alarm that was allowed.
        changes: what changed.
        excluded: what would have been noticed.
        gap: errors at the new poses by the model as it was, only placed again, and by the mended one [mm].
        station: how far instrument and target moved.
        rows: number of new rows.
        warnings: what else is to be said, doubts first.
    """

    changed: bool
    p_value: float
    alpha: float
    changes: tuple[ChangeEntry, ...]
    excluded: tuple[ExcludedEntry, ...]
    gap: dict[Literal["before", "after"], dict[str, float]]
    station: MovedEntry
    rows: int
    warnings: tuple[Note, ...] = ()
