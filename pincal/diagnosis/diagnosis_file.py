"""Results of a diagnosis: the structure behind ``diagnosis.json``, the report and the terminal."""

from __future__ import annotations

from typing import Literal

import msgspec

from pincal.discover.discovery_file import EffectName
from pincal.identity import Identity
from pincal.notes import Note


class ChangedParameter(msgspec.Struct, frozen=True):
    """A parameter that changed.

    Attributes:
        before, after: its calibrated and its current value [``unit``].
        sigma: standard deviation of the change [``unit``].
        unit: the unit.
    """

    before: float
    after: float
    sigma: float
    unit: str


class ChangeEntry(EffectName, frozen=True, kw_only=True, omit_defaults=True):
    """A change that was found, the most significant first.

    Attributes:
        parameters: the changed parameters.
        p_value: probability of such an alarm on an unchanged robot.
        equivalent: other changes that these poses can't distinguish from it.
        tell_apart: poses that would; empty if there are none.
        curve_rms: change of a curve, or of a function of two joints, root mean square over the
            rows, its mean apart [rad or m], if it is one.
        session: the rows that show it.
    """

    parameters: dict[str, ChangedParameter]
    p_value: float
    equivalent: tuple[EffectName, ...]
    tell_apart: str
    curve_rms: float | None = None
    session: str = ""


class ExcludedEntry(EffectName, frozen=True, kw_only=True, omit_defaults=True):
    """A change that would have been detected.

    Attributes:
        parameter: the parameter; empty for an effect of several.
        smallest: size that is detected with a probability of 90 % [``unit``].
        unit: the unit.
        tip_mm: largest displacement of the target by it in these poses.
    """

    parameter: str = ""
    smallest: float
    unit: str
    tip_mm: float


class MovedEntry(msgspec.Struct, frozen=True, omit_defaults=True):
    """Displacement of instrument and target since the calibration, by the new rows; null if these
    do not determine it.

    Attributes:
        moved_mm: distance between the instrument's positions in the robot's base frame [mm].
        turned_mrad: angle between its orientations [mrad].
        target_moved_mm: distance between the target's positions on the tool [mm].
        moved_U_mm, turned_U_mrad, target_moved_U_mm: expanded uncertainties (k = 2) of these.
        is_still: whether the rows are as well explained with both where they were, so that the
            displacements are no more than noise and the calibration's uncertainty allow.
    """

    moved_mm: float | None
    turned_mrad: float | None
    target_moved_mm: float | None
    is_still: bool = False
    moved_U_mm: float = 0.0
    turned_U_mrad: float = 0.0
    target_moved_U_mm: float = 0.0


class CurveEntry(msgspec.Struct, frozen=True, kw_only=True):
    """Contribution of a drive curve to the error of the new rows.

    Attributes:
        joint: the joint.
        error_mm: mean error of the new rows, cross-validated over blocks of poses, if this curve
            alone is re-estimated [mm].
        correlation: of the old curve and the new one over the new rows; null where one is flat.
        rms: their difference, root mean square, its mean apart [``unit``].
        unit: the unit.
        seen: fraction of the new rows at positions where the calibration had determined the curve.
    """

    joint: str
    error_mm: float
    correlation: float | None
    rms: float
    unit: str
    seen: float


class CurvesEntry(msgspec.Struct, frozen=True, kw_only=True):
    """Contribution of the drive curves to the error of the new rows.

    Attributes:
        session: name of the new rows.
        as_it_was_mm: mean error with the calibrated curves, outliers left out [mm].
        all_anew_mm: the same with all of them re-estimated, cross-validated over blocks of poses
            [mm].
        joints: by joint, largest contribution first.
    """

    session: str
    as_it_was_mm: float
    all_anew_mm: float
    joints: tuple[CurveEntry, ...]


class DiagnosisFile(msgspec.Struct, frozen=True, kw_only=True):
    """The whole of ``diagnosis.json``.

    Attributes:
        changed: whether the robot has changed.
        p_value: probability of such an alarm on an unchanged robot.
        alpha: the allowed probability of a false alarm.
        changes: the changes found.
        excluded: changes that would have been detected.
        gap: errors at the new poses of the old model with new base and tool, and of the
            re-identified one [mm].
        station: displacement of instrument and target.
        rows: number of new rows.
        warnings: further messages, doubts first.
        curves: contribution of the drive curves to the error of the new rows, if the model has any.
        is_judged: whether the rows can show a change; if not, none is reported, and doubts give the
            reason.
        id: identity of robot, instrument and circumstances; null where nothing was stated.
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
    id: Identity | None = None
