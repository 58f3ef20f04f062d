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
        curve_rms: by how much a curve is another one, root mean square over the rows [rad or m], where it is one.
        session: the rows that show it.
    """

    parameters: dict[str, ChangedParameter]
    p_value: float
    equivalent: tuple[ChangeName, ...]
    tell_apart: str
    curve_rms: float | None = None
    session: str = ""


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


class CurveEntry(msgspec.Struct, frozen=True, kw_only=True):
    """What the curve of a drive contributes to the error of the new rows.

    Attributes:
        joint: the joint.
        error_mm: mean error of the new rows, blocks of poses left out, if this curve alone is taken anew [mm].
        correlation: of the old curve and the new one over the new rows; null where one is flat.
        rms: their difference, root mean square, its mean apart [``unit``].
        unit: the unit.
        seen: part of the new rows at positions where the calibration had seen the curve; elsewhere nobody knew it.
    """

    joint: str
    error_mm: float
    correlation: float | None
    rms: float
    unit: str
    seen: float


class CurvesEntry(msgspec.Struct, frozen=True, kw_only=True):
    """What the curves of the drives contribute to the error of the new rows.

    Attributes:
        session: what the new rows are called.
        as_it_was_mm: mean error with the curves as they were, outliers left out [mm].
        all_anew_mm: the same with all of them taken anew, blocks of poses left out [mm].
        joints: joint by joint, the one that brings most first.
    """

    session: str
    as_it_was_mm: float
    all_anew_mm: float
    joints: tuple[CurveEntry, ...]


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
        curves: what the curves of the drives contribute to the error of the new rows, where the model has any.
        is_judged: whether the rows can tell if the robot has changed; if not, nothing is said to have, and doubts say why.
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
    curves: CurvesEntry | None = None
    is_judged: bool = True
