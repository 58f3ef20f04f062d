"""Whether the residuals of a fit can be this robot's: compared with those of real arms; errors are
identified by trial.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pincal.errors import MeasurementError, counted
from pincal.hypotheses.hypothesis import Explanation, Likeliest, likeliest
from pincal.identify.fit import ModelFit
from pincal.identify.initial import base_seen
from pincal.identify.options import Options
from pincal.identify.problem import Problem
from pincal.identify.station import Station
from pincal.measure.measurements import Measurements
from pincal.model.effects import JointOffset, LinkGeometry
from pincal.robot.robot import Robot
from pincal.validate.agreement_numbers import AGREEMENT
from pincal.validate.cures import NONE, Case, Correction, Mistake, shift_words
from pincal.validate.orientations import OrientationSearch
from pincal.validate.rough_fit import roughly_placed, typical_residuals
from pincal.validate.trials import Cure, PlausibleResiduals, Residuals, Trials


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
    bounded = _bounded(fit)
    # First at the values of which the predictions are known.
    left_of, error_of = (_typical(fit.problem, of) for of in (fit.values, fit.nominal.values))
    for k, (station, table, left, error) in enumerate(
        zip(fit.problem.stations, tables, left_of, error_of, strict=True)
    ):
        # Mistakes in a log of an IMU are found when it is aligned with the motion.
        if not station.sensor.reads_place:
            continue
        trials = Trials(Case(robot, table), _limits(fit, k, table), fit.options.at(station.name))
        suspect = _Suspect(trials, error, left, pulled, bounded)
        if suspect.is_sound:
            continue
        correction = suspect.correction(is_held=fit.options.earlier is not None)
        if correction is not None:
            return correction
    return None


def _typical(problem: Problem, values: np.ndarray) -> list[Residuals]:
    """Return the typical residuals of each station at values of all parameters."""
    for batch in problem.batches:
        batch.note_poses(values)
    pairs = zip(problem.stations, problem.places, strict=True)
    return [typical_residuals(station, values[places]) for station, places in pairs]


@dataclass(frozen=True)
class _Suspect:
    """A table whose residuals are to be explained.

    Attributes:
        trials: of mistakes in it.
        error: residuals with only base and tool fitted: position [m], orientation [rad].
        left: residuals of the calibration.
        pulled: joints whose zeros the data have pulled far from their priors.
        bounded: lengths that a bound stopped, by their parameters.
    """

    trials: Trials
    error: Residuals
    left: Residuals
    pulled: frozenset[str]
    bounded: frozenset[str]

    @cached_property
    def exceeded(self) -> float:
        """The residuals of the calibration relative to plausible ones."""
        return self.trials.limits.exceeded(self.left)

    @cached_property
    def unexplained(self) -> float:
        """The residuals that errors of the arm do not explain, relative to plausible ones: those of
        the calibration, or of one by some of the rows, in which less may have gone wrong.
        """
        return min(self.exceeded, self.trials.unchanged)

    @property
    def reach(self) -> float:
        """Of the robot [m]."""
        return self.trials.case.robot.reach

    @property
    def is_plausible(self) -> bool:
        """Whether such residuals are those of real arms."""
        return self.error[0] < AGREEMENT.suspicious * self.reach and self.exceeded < 1.0

    @property
    def is_sound(self) -> bool:
        """Whether nothing is to be explained."""
        return self.is_plausible and not self.pulled and not self.bounded

    @property
    def found(self) -> str:
        """What was found, in words."""
        return (
            f"with only base and tool fitted, {self.error[0] * 1e3:.0f} mm remain at a reach of "
            f"{self.reach:.1f} m"
        )

    def explanations(self) -> Iterator[Explanation[Cure]]:
        """Yield the mistakes that explain the residuals, shifted zeros last."""
        limits = self.trials.limits
        for cure in self.trials.cures(limits.exceeded(self.error)):
            exceeded = limits.exceeded(self.trials.calibrated(cure.case)[1])
            if exceeded < min(1.0, self.unexplained / AGREEMENT.cured):
                yield Explanation(cure, exceeded)
        cure_of_zeros = self.trials.shifted()
        if cure_of_zeros is not None:
            exceeded = limits.exceeded(cure_of_zeros.left)
            if exceeded < min(1.0, self._enough(cure_of_zeros.mistake)):
                yield Explanation(cure_of_zeros, exceeded)

    def likeliest(self) -> Likeliest[Cure] | None:
        """Return the mistake that explains the residuals best, or else the description that differs
        most ways at once; None if nothing does.
        """
        explanations = list(self.explanations())
        found = self._of(explanations)
        if found is not None and found.best.mistake.correction is not None:
            return found
        if self.is_plausible and not self.bounded:
            # Zeros that the data pull are those of single joints.
            return found
        # A frame that is left-handed and three signs of joints may be the same.
        described = self.trials.described(self.error[0], resizes=bool(self.bounded))
        if described is None:
            return found
        exceeded = self.trials.limits.exceeded(described.left)
        is_enough = exceeded < min(1.0, self.unexplained / AGREEMENT.improved)
        return self._of([*explanations, Explanation(described, exceeded, is_enough)])

    @staticmethod
    def _of(explanations: list[Explanation[Cure]]) -> Likeliest[Cure] | None:
        return likeliest(explanations, lambda least: AGREEMENT.rival * least)

    def correction(self, *, is_held: bool) -> Correction | None:
        """Return the correction of the robot's description that explains the residuals; None if
        nothing does and they may be a robot's.

        ``is_held`` says that the description is that of an earlier calibration.

        Raises:
            MeasurementError: naming another mistake, or that the table is of another robot.
        """
        found = self.likeliest()
        if found is not None:
            return self.believed(found, is_held=is_held)
        by_positions = self.by_positions()
        if by_positions is not None:
            if by_positions.is_plausible:
                self.refuse_orientations(by_positions)
            # Where orientations hide nothing, positions alone were searched with them.
            if self.may_hide(by_positions) and (found := by_positions.likeliest()) is not None:
                return by_positions.believed(found, is_held=is_held)
        self.refuse_another_robot()
        return None

    def by_positions(self) -> _Suspect | None:
        """Return the same table without its orientations; None if it has none, or no fit."""
        table = self.trials.case.table
        if not table.has_orientations:
            return None
        trials = self.trials.of_positions()
        fit, left = trials.calibrated(trials.case)
        if fit is None:
            return None
        error = typical_residuals(fit.station, fit.nominal.values)
        return _Suspect(trials, error, left, _pulled(fit), _bounded(fit))

    def may_hide(self, by_positions: _Suspect) -> bool:
        """Return whether orientations may hide a mistake that the positions of the same table,
        which are not sound either, show: they are implausible, or positions fit better alone.
        """
        if by_positions.is_sound:
            return False
        is_turned = self.left[1] >= self.trials.limits.orientation
        return is_turned or by_positions.exceeded < self.exceeded / AGREEMENT.improved

    def _enough(self, shifts: Mistake) -> float:
        """Return the residuals, relative to plausible ones, below which shifts of zeros explain
        them.
        """
        assert shifts.correction is not None
        if self.pulled & shifts.correction.shifts.keys():
            return max(AGREEMENT.no_worse * self.exceeded, AGREEMENT.usual)
        return self.unexplained / AGREEMENT.improved

    def believed(self, found: Likeliest[Cure], *, is_held: bool) -> Correction:
        """Return the correction of the robot's description that explains the residuals alone.

        ``is_held`` says that the description is that of an earlier calibration.

        Raises:
            MeasurementError: naming the mistake, if it is another one, or one of two.
        """
        mistake = found.best.mistake
        rivals = [
            other.mistake
            for other in found.rivals
            if (other.mistake.correction is not None or mistake.correction is not None)
            and not _is_same(mistake, other.mistake)
        ]
        if mistake.correction is not None and not rivals and not is_held:
            return mistake.correction
        words = f"{mistake.words}, or {rivals[0].words}" if rivals else mistake.words
        advice = "; ".join(dict.fromkeys([mistake.advice, *(one.advice for one in rivals[:1])]))
        raise MeasurementError(
            f"{self.trials.case.table.source}: {words}: {self._corrected(found.best)}; {advice}"
        )

    def _corrected(self, cure: Cure) -> str:
        """Return what remains without and with a cure, in words: of orientations where these show
        that something is wrong.
        """
        limits = self.trials.limits
        before = self.error
        after = cure.left
        if before[1] / limits.orientation <= before[0] / limits.position:
            return f"{self.found}, with this corrected {after[0] * 1e3:.1f} mm"
        return (
            f"with only base and tool fitted, orientations are off by {before[1] * 1e3:.0f} mrad, "
            f"with this corrected {after[1] * 1e3:.1f} mrad"
        )

    def refuse_orientations(self, by_positions: _Suspect) -> None:
        """Refuse orientations that do not belong to positions which fit alone.

        Raises:
            MeasurementError: naming what is wrong with them, if it is found, or if they have
                nothing to do with the robot.
        """
        case = self.trials.case
        placed = by_positions.trials.case.table
        if not case.robot.is_serial or case.table.from_link is not None:
            return
        base = base_seen(case.robot, {"": placed}, by_positions.trials.options)[:3, :3]
        limit = max(AGREEMENT.turned, self.trials.limits.orientation)
        search = OrientationSearch(case.robot, case.table, base, limit)
        cause = search.cause()
        left = search.under(None).left
        found = (
            f"positions alone fit to {by_positions.left[0] * 1e3:.2g} mm, the orientations alone "
            f"to {left * 1e3:.2g} mrad"
        )
        if cause is not None:
            corrected = search.under(cause).left * 1e3
            raise MeasurementError(
                f"{case.table.source}: {cause.words}: {found}, with this corrected "
                f"{corrected:.2g} mrad; {cause.advice}"
            )
        if left > AGREEMENT.senseless:
            raise MeasurementError(
                f"{case.table.source}: the orientations are not those of this robot: {found}; "
                f"check their convention (--orientation), {NONE}"
            )

    def refuse_another_robot(self) -> None:
        """Refuse residuals that no geometric error explains."""
        if self.error[0] > AGREEMENT.hopeless * self.reach:
            raise MeasurementError(
                f"{self.trials.case.table.source}: {self.found}; expected a few mm. Are units, "
                f"joint zeros, tip ({self.trials.case.robot.tip}) and URDF those of this robot?"
            )


def _is_same(sign: Mistake, zero: Mistake) -> bool:
    """Return whether two corrections describe one robot: reversing a wrist's last joint is half a
    turn of another joint.
    """
    if sign.correction is None or zero.correction is None or not sign.correction.turned:
        return False
    return any(
        abs(abs(shift) - np.pi) < AGREEMENT.shift for shift in zero.correction.shifts.values()
    )


def _pulled(fit: ModelFit) -> frozenset[str]:
    """Return the joints whose zeros the data have pulled far outside their priors, or outside what
    an earlier fit, or the robot's type, says of them.
    """
    expected = fit.problem.beliefs.with_earlier(np.zeros(len(fit.values)))
    sizes = np.array([p.size for p in fit.problem.parameters])
    for term in fit.problem.beliefs.terms:
        if term.sigma is not None:
            sizes[term.places] = np.maximum(sizes[term.places], term.sigma)
    is_far = np.abs(fit.values - expected) > AGREEMENT.pulled * sizes
    return frozenset(
        p.name.split(".")[0]
        for p, is_pulled in zip(fit.problem.parameters, is_far, strict=True)
        if is_pulled and p.effect == JointOffset.name and p.unit == "rad"
    )


def _bounded(fit: ModelFit) -> frozenset[str]:
    """Return the parameters of lengths that data would have changed by more than the bound."""
    pairs = zip(fit.problem.parameters, fit.solution.at_bound.tolist(), strict=True)
    return frozenset(
        p.name
        for p, is_held in pairs
        if is_held and p.effect == LinkGeometry.name and p.unit == "m"
    )


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


def refuse_exact(fit: ModelFit) -> None:
    """Refuse positions of unknown noise that the parameters fit exactly, beside an IMU that leaves
    these parameters open: what is left of them is neither their noise nor an accuracy.

    Raises:
        MeasurementError: with the station, and what would tell its noise.
    """
    stations = fit.problem.stations
    if all(station.sensor.reads_place for station in stations):
        return
    for station, places, blocks in fit.stations:
        free = int(fit.solution.free[places].sum())
        is_open = fit.noise.declared[blocks.start] is None and station.sensor.reads_place
        if not is_open or len(station) * station.reading_size > free:
            continue
        if fit.solution.estimated[blocks.start] < AGREEMENT.computed:
            raise MeasurementError(
                f"{station.name}: {counted(len(station), 'row')} of positions, and parameters free "
                "for each of their coordinates: the fit passes through them exactly, so that they "
                "show neither their noise nor how accurate the model is; declare the noise "
                "(--noise), or measure more poses"
            )


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
    limits = PlausibleResiduals(
        max(AGREEMENT.implausible * robot.reach, AGREEMENT.implausible_m), AGREEMENT.implausible_rad
    )
    found = Trials(Case(robot, measurements), limits, options).cures(limits.exceeded(left))
    return found[0].mistake.words if found else ""


def _limits(fit: ModelFit, k: int, table: Measurements) -> PlausibleResiduals:
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
    return PlausibleResiduals(length, angle)


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
