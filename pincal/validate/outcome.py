"""The results of a calibration besides its parameters: noise, rows, errors, stations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NotRequired, TypedDict

from msgspec import UNSET, UnsetType

from pincal.identify.fit import FitStage
from pincal.identify.visit_weights import ScatterByLevel
from pincal.identity import Identity
from pincal.notes import Note
from pincal.validate.lack_of_fit import LackOfFit


class NoiseRecord(TypedDict):
    """Standard deviation of one component of each block of readings: what the fit used, and the
    estimate from its residuals.

    Attributes:
        source: whether the noise was declared by the user or estimated from the residuals.
        declared: names of the entries that were declared ("sigma_m"), where the instruments of all
            stations were; not in files of version 0.2.0 and earlier.
        sigma_m, sigma_rad, sigma_px: noise that the fit used, of lengths [m], angles [rad] and
            image coordinates [px].
        sigma_m_s2, sigma_rad_s: of an IMU's specific forces [m/s^2] and angular rates [rad/s].
        residual_sigma_m, residual_sigma_rad, residual_sigma_px: estimates from the residuals of the
            fitted rows, corrected for degrees of freedom.
        residual_sigma_m_s2, residual_sigma_rad_s: the same, of specific forces and angular rates.
        repeated_sigma_m, repeated_sigma_rad, repeated_sigma_px: scatter of single readings about
            the mean of their pose, where poses were repeated.
        repeated_sigma_m_s2, repeated_sigma_rad_s: the same, of specific forces and angular rates.
    """

    source: Literal["declared", "estimated"]
    declared: NotRequired[list[str]]
    sigma_m: NotRequired[float]
    residual_sigma_m: NotRequired[float]
    repeated_sigma_m: NotRequired[float]
    sigma_rad: NotRequired[float]
    residual_sigma_rad: NotRequired[float]
    repeated_sigma_rad: NotRequired[float]
    sigma_px: NotRequired[float]
    residual_sigma_px: NotRequired[float]
    repeated_sigma_px: NotRequired[float]
    sigma_m_s2: NotRequired[float]
    residual_sigma_m_s2: NotRequired[float]
    repeated_sigma_m_s2: NotRequired[float]
    sigma_rad_s: NotRequired[float]
    residual_sigma_rad_s: NotRequired[float]
    repeated_sigma_rad_s: NotRequired[float]


def noise_key(unit: str) -> str:
    """Return the entry of a :class:`NoiseRecord` in a unit.

    Example:
        >>> noise_key("m"), noise_key("m/s^2")
        ('sigma_m', 'sigma_m_s2')
    """
    return f"sigma_{unit.replace('/', '_').replace('^', '')}"


class RowCounts(TypedDict):
    """Numbers of rows.

    Attributes:
        train: fitted.
        test: held out, not used by the fit; or predicted by a fit without their fold, see
            ``validation``.
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


# Model ("nominal", "calibrated") -> part ("train", "test") -> statistic with its unit ("mean_mm",
# "p95_mrad") -> value.
Errors = dict[str, dict[str, dict[str, float]]]


class MovedParameter(TypedDict):
    """Value at one station of a robot parameter that differs between stations [SI units].

    Attributes:
        name: of the parameter; JOINT.curve for the curve of a drive that the model does not have.
        unit: its unit.
        change: difference from the first station that determines it; for an effect of this station
            alone: its value; for a curve: root mean square of the difference over the station's
            rows, its mean apart.
        sigma: standard deviation of the change.
        moved: whether it changed significantly since the previous station.
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
        kind: of its measurements.
        rows: numbers of rows.
        moved_mm: displacement of the instrument relative to the robot since the first station, if
            both determine the whole base frame.
        noise: as for the whole.
        outliers: lines of rejected rows.
        error: of the station's rows.
        left_out: errors of the model of the other stations, only the station's own frames fitted to
            it.
        left_out_geometric: the same for their geometric model.
        parameters: of the robot, those that changed at any of the stations.
        iso9283: as for the whole, where the station measured poses more than once.
        lack_of_fit: likewise.
        repeatability: likewise.
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
    repeatability: NotRequired[ScatterByLevel]


@dataclass(frozen=True)
class ValidationWay:
    """How the errors at rows that were not fitted were found.

    Attributes:
        way: "regions" of joint space, "stretches" of consecutive rows, "sessions" or "random": each
            pose was predicted by a fit without its fold of this kind, the way in which predictions
            are worse; "held out": by rows that no fit has used; or "station": each station by the
            others.
        folds: number of folds; 0 for rows that were held out.
    """

    way: Literal["regions", "stretches", "sessions", "random", "held out", "station"]
    folds: int


@dataclass(frozen=True)
class ClockStep:
    """A step of a clock.

    Attributes:
        at_s: stamp of the first reading after it [s].
        size_s, size_sigma_s: what it adds to stamps from there on, and its standard deviation [s].
    """

    at_s: float
    size_s: float
    size_sigma_s: float


@dataclass(frozen=True)
class ClockRecord:
    """Clock of an instrument that reads an arm in motion: its stamp t is the joints' time t +
    offset + drift (t - middle), and the steps before t more.

    Attributes:
        station: name of the station, "" for a single one.
        offset_s, offset_sigma_s: offset and its standard deviation [s].
        drift_ppm, drift_sigma_ppm: drift and its standard deviation [1e-6].
        middle_s: stamp at which the offset holds [s].
        gyro_early_s, gyro_early_sigma_s: lead of an IMU's rate stamps over acceleration stamps of
            the same moment [s]; else null.
        steps: where it or the joints' clock steps.
    """

    station: str
    offset_s: float
    offset_sigma_s: float
    drift_ppm: float
    drift_sigma_ppm: float
    middle_s: float
    gyro_early_s: float | None = None
    gyro_early_sigma_s: float | None = None
    steps: tuple[ClockStep, ...] = ()


@dataclass(frozen=True)
class Improvement:
    """Standard deviation of the predicted position of a link in a region.

    Attributes:
        link: whose origin is predicted, relative to the robot's base link.
        region: "measured poses", or which part of those within the joints' limits.
        poses: number of poses.
        before_mm: before the calibration [mm], root mean square over the poses.
        after_mm: afterwards [mm].
    """

    link: str
    region: str
    poses: int
    before_mm: float
    after_mm: float


@dataclass(frozen=True)
class AngleGain:
    """What readings without places, of an IMU, told of the angles of joints and links.

    Attributes:
        angles: number of these angles that were fitted.
        gained: number of independent combinations of them whose standard deviation was halved at
            least.
        before_mrad: standard deviation of these before the calibration [mrad], root mean square.
        after_mrad: afterwards [mrad].
    """

    angles: int
    gained: int
    before_mrad: float
    after_mrad: float


@dataclass(frozen=True)
class Elsewhere:
    """Position error that the calibrated model itself expects away from the measured poses.

    It follows from the covariance of the parameters, which is as wide as their priors in what the
    poses leave open, what the model lacks and how the robot arrives.

    Attributes:
        mean_mm: expected distance from the predicted to the true position, mean over the poses
            [mm].
        worst_mm: at the worst of the poses [mm].
        where: in which range of which joint it is largest, and whether that was measured; "" if in
            no range of one joint.
        poses: number of poses.
        over: their file; "" for random poses within the joint limits.
    """

    mean_mm: float
    worst_mm: float
    where: str
    poses: int
    over: str = ""


@dataclass(frozen=True)
class Expanded:
    """Expanded uncertainty of a coordinate of predicted positions: parameters, what the model
    lacks, arrival.

    Attributes:
        here_mm: at the poses of the calibration, k times the root mean square standard uncertainty
            [mm].
        anywhere_mm: at random poses within the joint limits [mm].
        k: coverage factor.
        rests_on: by what errors were told from noise: declared noise, repeated poses, or the
            residuals alone.
    """

    here_mm: float
    anywhere_mm: float
    k: float
    rests_on: Literal["declared noise", "repeated poses", "residuals"]


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """All of ``result.json`` besides the parameters.

    ``iso9283`` and ``lack_of_fit`` are None where no pose was measured more than once, and then not
    in the file; nor is ``stations`` where there is only one. Several stations have their own each.

    Attributes:
        noise: of the readings.
        rows: numbers of rows.
        rank: number of parameters, or combinations of them, that the data identify.
        condition: condition number of the identifiable part, each parameter in units of its typical
            size.
        chi2_reduced: sum of squared residuals over the noise, per degree of freedom; about 1 for a
            complete model.
        chi2_p_value: probability of a value as large if the model is complete; null where the noise
            was estimated.
        iterations: steps of the solver in all.
        seconds: time that the fit took [s].
        converged: whether the last step was negligible.
        outliers: lines of the rejected rows.
        correlations: pairs of parameters with strongly correlated estimates.
        stages: the stages of the fit.
        error: by model ("nominal": base and tool fitted alone; "calibrated") and rows ("train",
            "test"): statistics with their units, such as ``mean_mm``, ``rms_mm``, ``p95_mm``,
            ``max_mm``, ``mean_mrad``.
        warnings: further messages, doubts first; plain texts in files of version 0.1.0.
        degrees: readings of distinct poses beyond the parameters that they determine; not in files
            of version 0.1.0.
        iso9283: pose accuracy AP and pose repeatability RP (ISO 9283) by model and rows, and pose
            by pose [mm, mrad].
        lack_of_fit: test of the residuals against the scatter between repeated measurements.
        repeatability: scatter of one coordinate of a position between readings within a stop of the
            robot (the instrument), between stops at a pose (the arrival of the drives), and of the
            poses about the model; of a single station.
        stations: results of each station.
        validation: how the errors of "test" were found; not in files of version 0.1.0.
        improvement: how far predictions are improved, by link and region, where no instrument
            observed the robot.
        angle_gain: what an IMU told of the angles of joints and links.
        clocks: of the instruments that read an arm in motion.
        elsewhere: position error to expect away from the measured poses; not where no instrument
            observed positions.
        intervals: 95 % intervals of the mean and of the 95th percentile of the calibrated model's
            errors at "test" rows, such as ``mean_mm``; all readings of a pose count as one, and an
            end that so few poses do not show is null.
        id: identity of robot, instrument and circumstances; not where nothing was stated.
        uncertainty: of predicted positions, at these poses and anywhere; not where no instrument
            gave positions.
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
    stages: tuple[FitStage, ...]
    error: Errors
    warnings: tuple[Note, ...]
    degrees: float = 0.0
    iso9283: dict[str, Any] | None = None
    lack_of_fit: LackOfFit | None = None
    repeatability: ScatterByLevel | UnsetType = UNSET
    validation: ValidationWay | UnsetType = UNSET
    stations: tuple[StationRecord, ...] | UnsetType = UNSET
    improvement: tuple[Improvement, ...] | UnsetType = UNSET
    angle_gain: AngleGain | UnsetType = UNSET
    clocks: tuple[ClockRecord, ...] | UnsetType = UNSET
    elsewhere: Elsewhere | UnsetType = UNSET
    intervals: dict[str, tuple[float | None, float | None]] | UnsetType = UNSET
    id: Identity | UnsetType = UNSET
    uncertainty: Expanded | UnsetType = UNSET
