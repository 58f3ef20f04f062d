"""Trials of mistakes in a table: each is undone on some rows, and what remains is looked at.

All are looked at by the closed-form placement, the likeliest with base and tool fitted, and the
best of these in a calibration of the geometry, so that a strange table costs a fixed number of
fits.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import fdtr

from pincal.identify.calibrate import fit_tables
from pincal.identify.fit import ModelFit
from pincal.identify.initial import starts_of
from pincal.identify.options import Options
from pincal.identify.station import Station
from pincal.measure.measurements import Measurements
from pincal.model.effects import GEOMETRIC
from pincal.sensors.row_samples import sample_rows
from pincal.thresholds import Count, Scale
from pincal.validate.agreement_numbers import AGREEMENT
from pincal.validate.cures import TOPICS, Case, Correction, Mistake, lengths_of, mistakes, scaled
from pincal.validate.descriptions import DescriptionSearch
from pincal.validate.rough_fit import (
    UNFIT,
    least_size,
    roughly_placed,
    typical_residuals,
    zero_shifts,
)

# Rows used for trials, each of which is a fit; and the number of the best that are fitted in full.
_ROWS: Count = 200
_FITTED: Count = 3
# Number of mistakes for which base and tool are fitted, those with the best closed-form placement:
# the true one undone leaves some mm there, others hundreds. A six-axis arm has some 120, and they
# grow with the square of the joints.
_PLACED: Count = 20
# Largest number of rows examined: neighbours matter, and all of a long table would add nothing.
_MOST_ROWS: Count = 20_000
# Range of scales of lengths, as logarithms: larger factors are refused earlier, smaller ones are
# instrument errors.
_SCALED: Scale = 0.5
_SCALE_STEP: Scale = 2e-4
# The hypothesis that nothing is wrong.
_NOTHING = Mistake("nothing is wrong", lambda case: case)
Residuals = tuple[float, float]
"""Typical errors of position [m] and orientation [rad]."""


@dataclass(frozen=True)
class PlausibleResiduals:
    """Largest plausible residuals of a robot: position [m], orientation [rad]."""

    position: float
    orientation: float

    def exceeded(self, left: Residuals) -> float:
        """Return the ratio of residuals to the limits."""
        return max(left[0] / self.position, left[1] / self.orientation)


@dataclass(frozen=True)
class Remainder:
    """What a fit leaves of some readings.

    With as many unknowns as readings any hypothesis leaves nothing, and with a few readings more
    one of many does so by chance: what is left counts by its degrees of freedom.

    Attributes:
        size: of the residuals, in any unit.
        readings: their number, all components.
        unknowns: that were fitted to them.
    """

    size: float
    readings: int
    unknowns: int

    @property
    def counts(self) -> tuple[int, int]:
        """Readings and unknowns."""
        return self.readings, self.unknowns

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the residuals, 0 if there are none."""
        return max(self.readings - self.unknowns, 0)

    def chance(self, before: Remainder) -> float:
        """Return how likely a wrong hypothesis, which makes no error smaller than it was
        ``before``, leaves as little by chance; 1 where nothing could be left.
        """
        if not self.freedom or not before.freedom:
            return 1.0
        variances = [one.size**2 * one.readings / one.freedom for one in (self, before)]
        return float(fdtr(self.freedom, before.freedom, variances[0] / variances[1]))


@dataclass(frozen=True)
class Cure:
    """A mistake, and what remains of the residuals with it undone on some rows.

    Attributes:
        mistake: the hypothesis.
        case: some rows of the table, with the mistake undone.
        left: typical residuals of position [m] and orientation [rad].
        readings: number of readings of these rows, all components.
        unknowns: number of unknowns that were fitted to them, those of base and tool.
    """

    mistake: Mistake
    case: Case
    left: Residuals = (np.inf, np.inf)
    readings: int = 0
    unknowns: int = 0


@dataclass(frozen=True)
class Trials:
    """Trials of mistakes on some rows of a table.

    Attributes:
        case: the table and its robot.
        limits: the largest plausible residuals.
        options: of the fits.
    """

    case: Case
    limits: PlausibleResiduals
    options: Options

    @cached_property
    def _few(self) -> Case:
        """The robot and the rows used for trials."""
        return replace(self.case, table=self.case.table.select(_few(self.case.table)))

    def cures(self, error: float) -> list[Cure]:
        """Return the mistakes that undone remove most of an error, relative to the limits, with
        base and tool fitted; the best first.

        What the same rows leave with nothing undone, placed in the same way, is no larger an error:
        a mistake explains only what is left of it.
        """
        case = replace(self.case, table=self.case.table.select(slice(0, _MOST_ROWS)))
        rows = _few(case.table)
        error = min(error, self.limits.exceeded(self._fitted(_undone(_NOTHING, case, rows)).left))
        possible = list(mistakes(case.robot, case.table, TOPICS))
        found = self._placed([_undone(one, case, rows) for one in possible])
        if lengths := lengths_of(case.table):
            found += self._best_scale(lengths, case, rows)
        # Of equivalent mistakes, such as one mirror or another, the first.
        found.sort(key=lambda cure: float(f"{self.limits.exceeded(cure.left):.2g}"))
        before = self._as_is(error, case.table.select(rows))
        return [
            cure
            for cure in found
            if self.limits.exceeded(cure.left) * AGREEMENT.cured < error
            and self._left_by(cure).chance(before) * len(possible) < AGREEMENT.chance
        ][:_FITTED]

    def _left_by(self, cure: Cure) -> Remainder:
        """Return what a cure leaves, relative to the limits."""
        return Remainder(self.limits.exceeded(cure.left), cure.readings, cure.unknowns)

    def _as_is(self, error: float, few: Measurements) -> Remainder:
        """Return an error, relative to the limits, as what base and tool leave of some rows."""
        with suppress(*UNFIT):
            station, _ = starts_of(self.case.robot, few, self.options)[0]
            return Remainder(error, *_counts(station))
        return Remainder(error, 0, 0)

    def _placed(self, undone: list[Cure]) -> list[Cure]:
        """Return the likeliest of some mistakes with base and tool fitted, in their own order: of
        equivalent ones, the first counts.
        """
        sizes = [
            least_size(cure.case.robot, cure.case.table, self.options, self.limits.exceeded)
            for cure in undone
        ]
        likely = sorted(np.argsort(sizes, kind="stable")[:_PLACED])
        return [self._fitted(undone[k]) for k in likely]

    def _fitted(self, cure: Cure) -> Cure:
        """Return a cure with base and tool fitted."""
        with suppress(*UNFIT):
            station, values = roughly_placed(cure.case.robot, cure.case.table, self.options)
            readings, unknowns = _counts(station)
            left = typical_residuals(station, values)
            return replace(cure, left=left, readings=readings, unknowns=unknowns)
        return cure

    def _best_scale(self, lengths: tuple[str, ...], case: Case, rows: np.ndarray) -> Iterator[Cure]:
        """Yield the scale of the measured lengths, by name, with the least residuals, unless it is
        no more than errors of an arm look like.
        """

        def tried(scale: float) -> Cure:
            return self._fitted(_undone(scaled(lengths, float(np.exp(scale))), case, rows))

        best = minimize_scalar(
            lambda scale: self.limits.exceeded(tried(scale).left),
            bounds=(-_SCALED, _SCALED),
            method="bounded",
            options={"xatol": _SCALE_STEP},
        )
        if abs(best.x) > AGREEMENT.suspicious:
            yield tried(best.x)

    def of_positions(self) -> Trials:
        """Return the trials of the positions of poses alone."""
        alone = self.case.table.of_positions()
        options = replace(self.options, sigma_orientation=None)
        return replace(self, case=replace(self.case, table=alone), options=options)

    @cached_property
    def unchanged(self) -> float:
        """What a calibration of the geometry by some rows leaves with nothing undone, relative to
        the limits: what errors of the arm explain needs no other cause.
        """
        return self.limits.exceeded(self.calibrated(self._few)[1])

    def calibrated(self, case: Case) -> tuple[ModelFit | None, Residuals]:
        """Return a calibration of the geometry by some rows, and its residuals; None if it
        fails.
        """
        options = replace(self.options, effects=GEOMETRIC, earlier=None, moment_frame="paper")
        with suppress(*UNFIT):
            fit = fit_tables(case.robot, case.table, options)
            return fit, typical_residuals(fit.station, fit.values)
        return None, (np.inf, np.inf)

    def shifted(self) -> Cure | None:
        """Return the shifts of the zeros of joints, with the residuals of a calibration; None if
        they are about right.
        """
        few = self._few
        shifts = {
            name: shift
            for name, shift in zero_shifts(few.robot, few.table, self.options).items()
            if abs(shift) > AGREEMENT.slight
        }
        if max(map(abs, shifts.values()), default=0.0) < AGREEMENT.shift:
            return None
        refined = self._refined(Correction(shifts), few)
        if refined is None:
            return None
        correction, left = refined
        words = " and ".join(
            f"{name!r} by {np.rad2deg(shift):+.1f} deg" for name, shift in correction.shifts.items()
        )
        mistake = correction.mistake(f"joints appear to be shifted: {words}")
        return Cure(mistake, mistake.undo(few), left)

    def described(self, error: float, *, resizes: bool) -> Cure | None:
        """Return the description in which most differs at once, with the residuals of a
        calibration; None if none leaves less of an error [m] than chance does.

        ``resizes`` says that lengths are suspected though what is left without them is plausible.
        """
        few = self._few
        search = DescriptionSearch.of(few, self.options, self.limits.position, resizes=resizes)
        found = None if search is None else search.found()
        if search is None or found is None or not found.correction.size:
            return None
        before = Remainder(error, *self._as_is(error, few.table).counts)
        after = Remainder(found.left, found.readings, found.unknowns)
        if after.chance(before) * len(search.combinations) >= AGREEMENT.chance:
            return None
        refined = self._refined(found.correction, few)
        if refined is None:
            return None
        correction, left = refined
        mistake = correction.mistake(f"the description appears to differ: {correction.words}")
        return Cure(mistake, mistake.undo(few), left)

    def _refined(self, correction: Correction, few: Case) -> tuple[Correction, Residuals] | None:
        """Return a correction with the zeros of its shifted joints as a calibration has them, and
        the residuals of that; None if it fails.
        """
        fit, left = self.calibrated(correction.undone(few))
        if fit is None:
            return None
        pairs = zip(fit.problem.parameters, fit.values, strict=True)
        offsets = {p.name: value for p, value in pairs}
        shifts = {
            name: shift + float(offsets.get(f"{name}.theta", 0.0))
            for name, shift in correction.shifts.items()
        }
        return replace(correction, shifts=shifts), left


def _counts(station: Station) -> tuple[int, int]:
    """Return the number of readings of a station, and of the unknowns of its base and tool."""
    return len(station) * station.reading_size, int(station.is_own.sum())


def _undone(mistake: Mistake, case: Case, rows: np.ndarray) -> Cure:
    """Return a mistake undone on some rows of a table; neighbours of these may matter."""
    undone = mistake.undo(case)
    few = undone.table.select(rows[rows < len(undone.table)])
    return Cure(mistake, replace(undone, table=few))


def _few(table: Measurements) -> np.ndarray:
    """Return the rows used for trials."""
    names = table.point_names
    return sample_rows(
        len(table), _ROWS, None if names is None else np.unique(names, return_inverse=True)[1]
    )
