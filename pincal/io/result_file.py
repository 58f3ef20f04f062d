"""The structure of ``result.json``."""

from __future__ import annotations

from typing import Any, Literal, NotRequired, TypedDict

import msgspec


class NoiseRecord(TypedDict):
    """Standard deviation of one component of each block of readings: what the fit used, and what its residuals say."""

    source: Literal["declared", "estimated"]
    sigma_m: NotRequired[float]
    residual_sigma_m: NotRequired[float]
    sigma_rad: NotRequired[float]
    residual_sigma_rad: NotRequired[float]
    sigma_px: NotRequired[float]
    residual_sigma_px: NotRequired[float]


class RowCounts(TypedDict):
    """Numbers of rows, fitted and held out."""

    train: int
    test: int


class Correlation(TypedDict):
    """Two parameters that the data hardly tell apart."""

    parameters: list[str]
    correlation: float


class StageRecord(TypedDict):
    """One stage of the fit, and the root mean square of its weighted residuals."""

    name: str
    iterations: int
    rms: float


# Model ("nominal", "calibrated") -> part ("train", "test") -> statistic with its unit ("mean_mm", "p95_mrad") -> value.
Errors = dict[str, dict[str, dict[str, float]]]


class ParameterRecord(msgspec.Struct, frozen=True, kw_only=True):
    """One parameter [SI units]."""

    name: str
    unit: str
    nominal: float
    value: float
    sigma: float | None
    status: Literal["identified", "prior", "fixed", "unidentifiable", "at bound"]
    reason: str


class LackOfFitRecord(msgspec.Struct, frozen=True, kw_only=True):
    """The F test of residuals against the scatter between replicates."""

    F: float
    p_value: float
    degrees: Any
    evenness: float
    poses: int
    pure_error: dict[str, float]


class ResultFile(msgspec.Struct, frozen=True, kw_only=True):
    """The whole of ``result.json``; ``iso9283`` and ``lack_of_fit`` only where poses were measured more than once."""

    noise: NoiseRecord
    rows: RowCounts
    parameters: tuple[ParameterRecord, ...]
    rank: int
    condition: float
    chi2_reduced: float
    chi2_p_value: float | None
    iterations: int
    seconds: float
    converged: bool
    outliers: tuple[int, ...]
    correlations: tuple[Correlation, ...]
    stages: tuple[StageRecord, ...]
    error: Errors
    warnings: tuple[str, ...]
    iso9283: dict[str, Any] | None = None
    lack_of_fit: LackOfFitRecord | None = None
