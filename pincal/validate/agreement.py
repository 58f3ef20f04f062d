"""Whether the residuals of a fit can be this robot's: compared with those of real arms; errors are
identified by trial.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from pincal.errors import MeasurementError
from pincal.identify.calibrate import fit_tables
from pincal.identify.criteria import AGREEMENT
from pincal.identify.fit import ModelFit
from pincal.identify.options import Options
from pincal.identify.station import Station
from pincal.measure.extrinsics import sample_rows
from pincal.measure.measurements import Measurements
from pincal.model.effects import GEOMETRIC, JointOffset
from pincal.robot.robot import Robot
from pincal.validate.cures import (
    UNFIT,
    Correction,
    TableCorrection,
    cures,
    least_size,
    roughly_placed,
    scaled,
    shift_words,
    typical_residuals,
    zero_shifts,
)

# Rows used for trials, each of which is a fit; and the number of the best that are fitted in full.
_ROWS = 200
_FITTED = 3
# Number of corrections for which base and tool are fitted, those with the best closed-form
# placement: a true one leaves some mm there, others hundreds. A six-axis arm has some 120, and they
# grow with the square of the joints.
_PLACED = 20
# Largest number of rows examined: neighbours matter, and all of a long table would add nothing.
_MOST_ROWS = 20_000
# Range of scales of lengths, as logarithms: larger factors are refused earlier, smaller ones are
# instrument errors.
_SCALED = 0.5
_SCALE_STEP = 2e-4


@dataclass(frozen=True)
class _Limits:
    """Largest plausible residuals of a robot: position [m], orientation [rad]."""

    position: float
    orientation: float

    def exceeded(self, left: tuple[float, float]) -> float:
        """Return the ratio of residuals to the limits."""
        return max(left[0] / self.position, left[1] / self.orientation)


def check_agreement(
    robot: Robot, tables: Iterable[Measurements], fit: ModelFit
) -> Correction | None:
    """Refuse a table that is not of this robot, or whose columns are mixed up, if the mistake can
    be identified.

    Args:
        robot: the arm.
        tables: the rows of each station, in the order of measurement.
        fit: their calibration.

    Returns:
        A correction of the robot's description, with which the robot is to be calibrated again;
        None for nearly all robots.

    Raises:
        MeasurementError: naming the mistake, which, undone, makes the table fit, or two that
            explain it equally well.
    """
    pulled = _pulled(fit)
    for k, (station, places, table) in enumerate(
        zip(fit.problem.stations, fit.problem.places, tables, strict=True)
    ):
        # Mistakes in a log of an IMU are found when it is aligned with the motion.
        if not station.sensor.reads_place:
            continue
        error, left = (
            typical_residuals(station, values[places])
            for values in (fit.nominal.values, fit.values)
        )
        limits = _limits(fit, k, table)
        if (
            error[0] < AGREEMENT.suspicious * robot.reach
            and limits.exceeded(left) < 1.0
            and not pulled
        ):
            continue
        options = fit.options.at(station.name)
        got = (
            f"with only base and tool fitted, {error[0] * 1e3:.0f} mm remain at a reach of "
            f"{robot.reach:.1f} m"
        )
        found = [
            (exceeded, cure, after)
            for cure, after in _cured(
                robot, table, error=limits.exceeded(error), limits=limits, options=options
            )
            if (exceeded := limits.exceeded(_calibrated(cure, options)[1]))
            < min(1.0, limits.exceeded(left) / AGREEMENT.cured)
        ]
        shifted, after = _shifted(robot, table, options)
        if shifted is not None and shifted.correction is not None:
            exceeded = limits.exceeded(after)
            before = limits.exceeded(left)
            insisted = pulled & shifted.correction.shifts.keys()
            if exceeded < min(
                1.0,
                max(AGREEMENT.no_worse * before, AGREEMENT.usual)
                if insisted
                else before / AGREEMENT.improved,
            ):
                found.append((exceeded, shifted, after))
        if found:
            return _chosen(found, f"{table.source}: ", got, is_held=fit.options.earlier is not None)
        if error[0] > AGREEMENT.hopeless * robot.reach:
            raise MeasurementError(
                f"{table.source}: {got}; expected a few mm. "
                f"Are units, joint zeros, tip ({robot.tip}) and URDF those of this robot?"
            )
    return None


def _chosen(
    found: Sequence[tuple[float, TableCorrection, tuple[float, float]]],
    source: str,
    got: str,
    *,
    is_held: bool,
) -> Correction | None:
    """Return the correction with the least residuals if no other one has as little."""
    least = min(exceeded for exceeded, *_ in found)
    # Of mistakes that are undone equally well, the first counts.
    (cure, after), *others = [
        (cure, after) for exceeded, cure, after in found if exceeded < AGREEMENT.rival * least
    ]
    rivals = [
        other.words
        for other, _ in others
        if (other.correction is not None or cure.correction is not None)
        and not _is_same(cure, other)
    ]
    if cure.correction is not None and not rivals and not is_held:
        return cure.correction
    words = f"{cure.words}, or {rivals[0]}" if rivals else cure.words
    raise MeasurementError(
        f"{source}{words}: {got}, with this corrected {after[0] * 1e3:.1f} mm; {cure.advice}"
    )


def _is_same(sign: TableCorrection, zero: TableCorrection) -> bool:
    """Return whether two corrections describe one robot: reversing a wrist's last joint is half a
    turn of another joint.
    """
    if sign.correction is None or zero.correction is None or not sign.correction.turned:
        return False
    return any(
        abs(abs(shift) - np.pi) < AGREEMENT.shift for shift in zero.correction.shifts.values()
    )


def _pulled(fit: ModelFit) -> set[str]:
    """Return the joints whose zeros the data have pulled far outside their priors."""
    offsets = [
        (p, fit.values[i])
        for i, p in enumerate(fit.problem.parameters)
        if p.effect == JointOffset.name
    ]
    return {
        p.name.split(".")[0]
        for p, value in offsets
        if p.unit == "rad" and abs(value) > AGREEMENT.pulled * p.size
    }


def unknown_zeros(fit: ModelFit) -> Iterator[str]:
    """Yield the notes on joints with unknown zeros whose rows show that they are shifted."""
    for i, parameter in enumerate(fit.problem.parameters):
        is_unknown = (
            parameter.effect == JointOffset.name
            and parameter.unit == "rad"
            and fit.priors.sizes[i] > AGREEMENT.unknown
        )
        # For the first joint it is a turn of the base, for the last one of the tool: such uncertain
        # ones are not named.
        if (
            is_unknown
            and abs(fit.values[i]) > AGREEMENT.shift
            and fit.estimate.sigma[i] < AGREEMENT.slight
        ):
            yield shift_words(parameter.name.split(".")[0], float(fit.values[i]))


def _shifted(
    robot: Robot, table: Measurements, options: Options
) -> tuple[TableCorrection | None, tuple[float, float]]:
    """Return the correction that shifts the zeros of joints, None if they are about right, and its
    residuals.
    """
    few = table.select(_few(table))
    shifts = {
        name: shift
        for name, shift in zero_shifts(robot, few, options).items()
        if abs(shift) > AGREEMENT.slight
    }
    if max(map(abs, shifts.values()), default=0.0) < AGREEMENT.shift:
        return None, (np.inf, np.inf)
    fit, left = _calibrated(Correction(shifts).cure(robot, few, ""), options)
    if fit is None:
        return None, left
    offsets = {p.name: value for p, value in zip(fit.problem.parameters, fit.values, strict=True)}
    shifts = {name: shift + float(offsets[f"{name}.theta"]) for name, shift in shifts.items()}
    words = " and ".join(
        f"{name!r} by {np.rad2deg(shift):+.1f} deg" for name, shift in shifts.items()
    )
    return Correction(shifts).cure(robot, few, f"joints appear to be shifted: {words}"), left


def implausible(fit: ModelFit, tables: Iterable[Measurements]) -> Iterator[tuple[str, str]]:
    """Yield the stations with calibration residuals that no real arm has, and their size in words.

    ``tables`` are the rows of each station that the fit used.
    """
    for k, (station, places, table) in enumerate(
        zip(fit.problem.stations, fit.problem.places, tables, strict=True)
    ):
        left = typical_residuals(station, fit.values[places])
        limits = _limits(fit, k, table)
        if limits.exceeded(left) >= 1.0:
            found = f"{left[0] * 1e3:.2g} mm" + (
                f" and {left[1] * 1e3:.2g} mrad" if left[1] else ""
            )
            expected = f"{limits.position * 1e3:.2g} mm" + (
                f" and {limits.orientation * 1e3:.2g} mrad" if left[1] else ""
            )
            yield station.name, f"typical rows still have an error of {found}, more than {expected}"


def computed(fit: ModelFit) -> Iterator[tuple[str, bool, str]]:
    """Yield the stations whose positions were computed from the joint positions, since they agree
    too closely with a model.

    Yields:
        Name, whether the model is the nominal one (else the calibrated one), and the residual in
        words.
    """
    for station, places in zip(fit.problem.stations, fit.problem.places, strict=True):
        nominal, left = (
            typical_residuals(station, values[places])[0]
            for values in (fit.nominal.values, fit.values)
        )
        is_spare = len(station) * station.reading_size > 2 * len(fit.values)
        is_place = (station.sensor.blocks[0].unit, station.sensor.blocks[0].size) == ("m", 3)
        if is_place and is_spare and min(nominal, left) < AGREEMENT.computed:
            yield station.name, nominal < AGREEMENT.computed, f"{min(nominal, left) * 1e6:.2g} um"


def mix_up(
    measurements: Measurements, station: Station, values: np.ndarray, *, options: Options
) -> str:
    """Return the mistake that explains a table's residuals, in words; empty if none is found.

    ``station`` is the robot over the table with instrument and targets placed, ``values``, shape
    (P,), are its parameters, and ``options`` place the nominal robot.
    """
    robot = station.model.chain.robot
    left = typical_residuals(station, values)
    if left[0] < AGREEMENT.suspicious * robot.reach:
        return ""
    limits = _Limits(
        max(AGREEMENT.implausible * robot.reach, AGREEMENT.implausible_m), AGREEMENT.implausible_rad
    )
    found = _cured(robot, measurements, error=limits.exceeded(left), limits=limits, options=options)
    return found[0][0].words if found else ""


def _limits(fit: ModelFit, k: int, table: Measurements) -> _Limits:
    """Return the largest plausible residuals of the k-th station; its table may declare the noise
    of lengths row by row.
    """
    station = fit.problem.stations[k]
    places = fit.problem.places[k]
    reach = fit.problem.chain.robot.reach
    declared = fit.noise.declared[fit.problem.block_spans[k]]
    length = max(AGREEMENT.implausible * reach, AGREEMENT.implausible_m)
    angle = AGREEMENT.implausible_rad
    for block, of_block in zip(station.sensor.blocks, declared, strict=True):
        sigma = table.sigma if of_block is None and block.unit == "m" else of_block
        if sigma is None:
            continue
        if block.unit == "rad":
            angle = max(angle, AGREEMENT.noisy * float(np.median(sigma)))
        else:
            length = max(
                length,
                AGREEMENT.noisy
                * float(np.median(sigma))
                * station.metres_per_reading(fit.values[places]),
            )
    return _Limits(length, angle)


def _cured(
    robot: Robot, table: Measurements, *, error: float, limits: _Limits, options: Options
) -> list[tuple[TableCorrection, tuple[float, float]]]:
    """Return the corrections that remove most of an error, the best first, and their residuals with
    base and tool fitted.
    """
    table = table.select(slice(0, _MOST_ROWS))
    rows = _few(table)

    def of_few(cure: TableCorrection) -> TableCorrection:
        return replace(cure, table=cure.table.select(rows[rows < len(cure.table)]))

    def tried(few: TableCorrection) -> tuple[TableCorrection, tuple[float, float]]:
        with suppress(*UNFIT):
            return few, typical_residuals(*roughly_placed(few.robot, few.table, options))
        return few, (np.inf, np.inf)

    possible = list(map(of_few, cures(robot, table)))
    # In their own order: of equivalent corrections, the first counts.
    sizes = [least_size(few.robot, few.table, options, limits.exceeded) for few in possible]
    likely = sorted(np.argsort(sizes, kind="stable")[:_PLACED])
    found = [tried(possible[k]) for k in likely]
    if scaled(robot, table, 1.0) is not None:

        def left_by(scale: float) -> float:
            cure = scaled(robot, table, float(np.exp(scale)))
            assert cure is not None
            return limits.exceeded(tried(of_few(cure))[1])

        best = minimize_scalar(
            left_by, bounds=(-_SCALED, _SCALED), method="bounded", options={"xatol": _SCALE_STEP}
        )
        found += [
            tried(of_few(cure))
            for cure in [scaled(robot, table, float(np.exp(best.x)))]
            if cure is not None
        ]
    # Of equivalent corrections, such as one mirror or another, the first.
    found.sort(key=lambda one: float(f"{limits.exceeded(one[1]):.2g}"))
    return [one for one in found if limits.exceeded(one[1]) * AGREEMENT.cured < error][:_FITTED]


def _few(table: Measurements) -> np.ndarray:
    """Return the rows used for trials."""
    names = table.point_names
    return sample_rows(
        len(table), _ROWS, None if names is None else np.unique(names, return_inverse=True)[1]
    )


def _calibrated(
    cure: TableCorrection, options: Options
) -> tuple[ModelFit | None, tuple[float, float]]:
    """Return a calibration of the geometry with a mistake undone, and its residuals; None if it
    fails.
    """
    with suppress(*UNFIT):
        fit = fit_tables(
            cure.robot,
            cure.table,
            replace(options, effects=GEOMETRIC, earlier=None, moment_frame="paper"),
        )
        return fit, typical_residuals(fit.station, fit.values)
    return None, (np.inf, np.inf)


def belongs_to_other_robot(left: np.ndarray, nominal: np.ndarray, *, allowed: float) -> bool:
    """Return whether rows contradict a calibration as a whole: the nominal robot is no farther from
    them.

    With d the correction that it makes, the rows show (|nominal|^2 - |left|^2 + |d|^2) / 2 |d|^2 of
    it: all of it for the robot that was calibrated, none for another of its type, less than half if
    left is larger than nominal.

    Args:
        left: shape (N, 3), displacement of the rows from the calibrated robot, instrument and
            targets placed [m].
        nominal: shape (N, 3), the same for the nominal robot [m].
        allowed: residuals that noise and the calibration's uncertainty explain, root mean square
            [m].
    """
    rest, before, correction = (
        float(np.sqrt(np.mean(np.sum(way**2, axis=1)))) for way in (left, nominal, nominal - left)
    )
    return rest >= before and correction > AGREEMENT.telling * allowed


def nominal_displacements(robot: Robot, measurements: Measurements, options: Options) -> np.ndarray:
    """Return the displacements of rows from the nominal robot, instrument and targets placed, shape
    (N, 3) [m].
    """
    station, values = roughly_placed(robot, measurements, options)
    return station.displacements(values)
