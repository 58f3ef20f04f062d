"""The structure of ``result.json``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NotRequired, TypedDict

from msgspec import UNSET, UnsetType

from pincal.identify.fit import Stage
from pincal.identify.reasons import Status
from pincal.notes import Note
from pincal.validate.lack_of_fit import LackOfFit
from pincal.validate.verdict import Verdict


class NoiseRecord(TypedDict):
    """Standard deviation of one component of each block of readings: what the fit used, and what its residuals say.

    Attributes:
        source: whether the noise was declared by the user or estimated from the residuals.
        sigma_m, sigma_rad, sigma_px: noise that the fit used, of lengths [m], angles [rad] and image coordinates [px].
        residual_sigma_m, residual_sigma_rad, residual_sigma_px: what the residuals of the fitted rows say of it, degrees of
            freedom allowed for.
    """

    source: Literal["declared", "estimated"]
    sigma_m: NotRequired[float]
    residual_sigma_m: NotRequired[float]
    sigma_rad: NotRequired[float]
    residual_sigma_rad: NotRequired[float]
    sigma_px: NotRequired[float]
    residual_sigma_px: NotRequired[float]


class RowCounts(TypedDict):
    """Numbers of rows.

    Attributes:
        train: fitted.
        test: held out: they never touch the fit.
    """

    train: int
    test: int


class Correlation(TypedDict):
    """Two parameters whose estimates are strongly correlated.

    Attributes:
        parameters: their names.
        correlation: correlation of their estimates, -1 to 1.
    """

    parameters: list[str]
    correlation: float


# Model ("nominal", "calibrated") -> part ("train", "test") -> statistic with its unit ("mean_mm", "p95_mrad") -> value.
Errors = dict[str, dict[str, dict[str, float]]]


class MovedParameter(TypedDict):
    """What a parameter of the robot that is not the same at all stations is at one of them [SI units].

    Attributes:
        name: of the parameter.
        unit: its unit.
        change: by how much it is other than at the first station that tells; of an effect that the model has at this station
            alone: its value.
        sigma: standard deviation of the change.
        moved: whether it moved since the station before, more surely than by chance.
    """

    name: str
    unit: str
    change: float
    sigma: float
    moved: bool


class StationRecord(TypedDict):
    """One of several stations.

    Attributes:
        name: of the station.
        kind: what was measured.
        rows: numbers of rows.
        moved_mm: how far the instrument stands from where it stood at the first station, seen from the robot, where both
            tell all of the base frame.
        noise: as that of the whole.
        outliers: lines of rejected rows.
        error: of the station's rows.
        left_out: errors of the model of the other stations, only the station's own frames fitted to it.
        left_out_geometric: the same of their geometric model.
        parameters: of the robot, those that moved at any of the stations.
        iso9283: as that of the whole, where the station measured poses more than once.
        lack_of_fit: likewise.
    """

    name: str
    kind: str
    rows: RowCounts
    moved_mm: NotRequired[float]
    noise: NoiseRecord
    outliers: list[int]
    error: Errors
    left_out: NotRequired[dict[str, float]]
    left_out_geometric: NotRequired[dict[str, float]]
    parameters: NotRequired[list[MovedParameter]]
    iso9283: NotRequired[dict[str, Any]]
    lack_of_fit: NotRequired[LackOfFit]


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """All that ``result.json`` says beside the parameters.

    ``iso9283`` and ``lack_of_fit`` are None where no pose was measured more than once, and then not in the file; nor is
    ``stations`` where there is only one. Of several stations each has its own.

    Attributes:
        noise: of the readings.
        rows: numbers of rows.
        rank: number of parameters, or combinations of them, that the data identify.
        condition: condition number of the identifiable part, each parameter in units of its typical size.
        chi2_reduced: sum of squared residuals over the noise, per degree of freedom; about 1 for a complete model.
        chi2_p_value: probability of one as large if the model is complete; null where the noise was estimated.
        iterations: steps of the solver in all.
        seconds: time that the fit took [s].
        converged: whether the last step was negligible.
        outliers: lines of the rows that were rejected.
        correlations: pairs of parameters with strongly correlated estimates.
        stages: what was fitted one after the other.
        error: by model ("nominal": base and tool fitted alone; "calibrated") and rows ("train", "test"): statistics
            with their units, such as ``mean_mm``, ``rms_mm``, ``p95_mm``, ``max_mm``, ``mean_mrad``.
        warnings: what else is to be said, doubts first; texts alone in files of version 0.1.0.
        degrees: readings of distinct poses beyond the parameters that they determine; not in files of version 0.1.0.
        iso9283: pose accuracy AP and pose repeatability RP (ISO 9283) by model and rows, and pose by pose [mm, mrad].
        lack_of_fit: test of the residuals against the scatter between repeated measurements.
        stations: what is to be said of each station.
    """

    noise: NoiseRecord
    rows: RowCounts
    rank: int
    condition: float
    chi2_reduced: float
    chi2_p_value: float | None
    iterations: int
    seconds: float
    converged: bool
    outliers: tuple[int, ...]
    correlations: tuple[Correlation, ...]
    stages: tuple[Stage, ...]
    error: Errors
    warnings: tuple[Note, ...]
    degrees: float = 0.0
    iso9283: dict[str, Any] | None = None
    lack_of_fit: LackOfFit | None = None
    stations: tuple[StationRecord, ...] | UnsetType = UNSET


@dataclass(frozen=True, kw_only=True)
class ParameterRecord:
    """One parameter [SI units].

    Attributes:
        name: ``<element>.<symbol>``, such as ``joint_2.s_x``.
        unit: its unit.
        nominal: what the URDF says.
        value: what was found, in place of the nominal.
        sigma: its standard deviation; that of the prior where the data say nothing, null for a value that was given.
        status: "identified"; "prior" (what was known beforehand dominates); "fixed"; "unidentifiable"; "at bound".
        reason: why it is not identified; empty where it is.
    """

    name: str
    unit: str
    nominal: float
    value: float
    sigma: float | None
    status: Status
    reason: str


@dataclass(frozen=True, kw_only=True)
class ResultFile(Outcome):
    """The whole of ``result.json``.

    Attributes:
        parameters: every parameter, those that were not identified with the reason.
        verdict: whether the model explains the data down to their noise; not in files of version 0.1.0.
    """

    parameters: tuple[ParameterRecord, ...]
    warnings: tuple[Note | str, ...]  # type: ignore[assignment]
    verdict: Verdict = Verdict.NOT_JUDGED
