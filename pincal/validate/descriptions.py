"""The search for a robot's description where it differs from the URDF in several ways at once:
signs of joints, their zeros, reports of coupled drives, and lengths.

How joints count is a matter of a few bits and right angles. All combinations of these are looked at
by one linear fit each (:mod:`pincal.validate.linear_scan`). What the best ones leave is then fitted
with base, tool and zeros free, and with lengths if that is not enough.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, product
from math import comb

import numpy as np

from pincal.identify.options import Options
from pincal.model.effects import JointOffset, LinkGeometry
from pincal.robot.mastering import free_joints
from pincal.sensors.row_samples import sample_rows
from pincal.thresholds import Count, Scale
from pincal.validate.agreement_numbers import AGREEMENT
from pincal.validate.cures import Case, Correction, couplings_of
from pincal.validate.linear_scan import UNKNOWNS, LinearScan
from pincal.validate.rough_fit import UNFIT, revolute_joints, roughly_placed, typical_residuals

# Rows by which combinations are looked at.
_ROWS: Count = 60
# Combinations at most: with more joints fewer of them differ by a right angle at once.
_MOST: Count = 20_000
# Combinations of signs at most: all of them with up to eight joints.
_SIGNS: Count = 256
# The best of them that are fitted with the zeros of joints, and those that are fitted with lengths.
_FITTED: Count = 24
_RESIZED: Count = 3
# Lengths that may be wrong at once.
_LENGTHS: Count = 2
# Angles between these, from which a zero of any angle converges; they are tried of single joints.
_BETWEEN: tuple[Scale, ...] = (np.pi / 4, -np.pi / 4, 3 * np.pi / 4, -3 * np.pi / 4)
_RIGHT_ANGLES: tuple[Scale, ...] = (np.pi / 2, -np.pi / 2, np.pi)


@dataclass(frozen=True)
class Described:
    """A correction of a robot's description, and what it leaves.

    Attributes:
        correction: the correction.
        left: typical residual of positions, base, tool, zeros and lengths fitted [m].
        readings: the number of components that were fitted.
        unknowns: that were fitted to them.
    """

    correction: Correction
    left: float
    readings: int
    unknowns: int


@dataclass(frozen=True)
class DescriptionSearch:
    """A search for the description of a serial arm by positions of its target.

    Attributes:
        case: the robot as described, and some rows.
        options: of the fits.
        enough: typical residual below which nothing more has to be wrong [m].
        resizes: whether a length is suspected even below it.
    """

    case: Case
    options: Options
    enough: float
    resizes: bool = False

    @classmethod
    def of(
        cls, case: Case, options: Options, enough: float, *, resizes: bool = False
    ) -> DescriptionSearch | None:
        """Return the search for a case; None if its robot or readings allow none."""
        table = case.table
        is_plain = case.robot.is_serial and table.from_link is None and table.to_link is None
        if not table.is_of_positions or not is_plain or table.is_of_motion:
            return None
        found = cls(case, options, enough, resizes)
        return found if len(found.rows) > UNKNOWNS + case.robot.n_joints else None

    @cached_property
    def rows(self) -> np.ndarray:
        """The rows of the most frequent target that are looked at."""
        targets = self.case.table.target
        names, counts = np.unique(targets, return_counts=True)
        of_one = np.flatnonzero(targets == names[np.argmax(counts)])
        return np.asarray(of_one[sample_rows(len(of_one), _ROWS)])

    @cached_property
    def combinations(self) -> list[Correction]:
        """Everything that is tried: signs with right angles, and each coupling with signs and one
        right angle, the simplest first.
        """
        robot = self.case.robot
        turning = revolute_joints(robot)
        signs = list(_signs(free_joints(robot)))
        # The zero of the first joint is a turn of the base, that of the last one of the tool.
        inner = [name for name in turning if 0 < robot.joint_names.index(name) < robot.n_joints - 1]
        shifts = list(_right_angles(inner, _MOST // len(signs)))
        found = [Correction(shift, names) for shift in shifts for names in signs]
        between = [{name: angle} for name in inner for angle in _BETWEEN]
        found += [Correction(shift, names) for shift in between for names in signs]
        single = [shift for shift in shifts if len(shift) == 1] + between
        couplings = list(couplings_of(robot))
        found += [Correction({}, names, (coupling,)) for coupling in couplings for names in signs]
        few = [names for names in signs if len(names) <= 1]
        if len(couplings) * len(single) * len(few) <= _MOST:
            found += [
                Correction(shift, names, (coupling,))
                for coupling in couplings
                for shift in single
                for names in few
            ]
        return sorted(found, key=lambda one: one.size)

    def found(self) -> Described | None:
        """Return the simplest correction of those that leave least; None if no fit succeeds."""
        tried = self.combinations
        order = np.argsort(self._left_of_linear(tried), kind="stable")[:_FITTED]
        # Ties, such as a mirrored arm, are fitted in the order of their simplicity.
        fitted = [one for k in sorted(order) if (one := self._fitted(tried[k])) is not None]
        for count in range(_LENGTHS):
            is_suspected = self.resizes and count == 0
            least = min((one.left for one in fitted), default=0.0)
            if least < self.enough and not is_suspected:
                break
            fitted += list(self._resized(sorted(fitted, key=_preference)[:_RESIZED]))
        if not fitted:
            return None
        least = min(one.left for one in fitted)
        alike = [one for one in fitted if one.left <= AGREEMENT.alike * least]
        return min(alike, key=lambda one: one.correction.size)

    def _left_of_linear(self, tried: Sequence[Correction]) -> np.ndarray:
        """Return the sum of squares that the linear fit leaves of each correction."""
        table = self.case.table
        position = table.readings["position"][self.rows]
        return LinearScan(self.case.robot, table.q[self.rows], position).left(tried)

    def _fitted(self, correction: Correction, lengths: tuple[str, ...] = ()) -> Described | None:
        """Return a correction with its zeros, and lengths by their parameters, fitted."""
        robot = self.case.robot
        case = replace(correction, lengths={}).undone(self.case)
        # Its own lengths start from the description.
        options = self._releasing(lengths)
        with suppress(*UNFIT):
            station, values = roughly_placed(
                robot, case.table, options, offsets=True, lengths=lengths
            )
            found = {p.name: float(v) for p, v in zip(station.parameters, values, strict=True)}
            shifts = {
                name: float(correction.shifts.get(name, 0.0) + found.get(f"{name}.theta", 0.0))
                for name in revolute_joints(robot)
            }
            return Described(
                replace(
                    correction,
                    shifts={k: v for k, v in shifts.items() if abs(v) > AGREEMENT.slight},
                    lengths={name: found[name] for name in lengths},
                ),
                typical_residuals(station, values)[0],
                len(station) * station.reading_size,
                int(station.is_own.sum()) + len(revolute_joints(robot)) + len(lengths),
            )
        return None

    def _resized(self, fitted: Iterable[Described]) -> Iterator[Described]:
        """Yield what one more length explains of each of some corrections."""
        for one in fitted:
            for name in self._lengths:
                if name in one.correction.lengths:
                    continue
                lengths = (*one.correction.lengths, name)
                longer = self._fitted(one.correction, lengths)
                if longer is not None:
                    yield longer

    @cached_property
    def _lengths(self) -> tuple[str, ...]:
        """The lengths between two joints by the names of their parameters."""
        robot = self.case.robot
        station, _ = roughly_placed(robot, self.case.table, self._releasing(()), offsets=True)
        return tuple(
            p.name
            for p in station.parameters
            if p.effect == LinkGeometry.name
            and p.unit == "m"
            and p.symbol in ("d", "a")
            and robot.next_joint(robot.joint_names.index(p.element)) is not None
        )

    def _releasing(self, lengths: tuple[str, ...]) -> Options:
        """Return options that release the zeros of all joints and some lengths."""
        return replace(
            self.options,
            effects=(JointOffset(), LinkGeometry()),
            zeros=("*",),
            earlier=None,
            moment_frame="paper",
            priors=dict.fromkeys(lengths, np.inf),
            length_bound=max(self.case.robot.reach, self.options.length_bound),
        )


def _preference(described: Described) -> tuple[int, int]:
    """Return a key that sorts corrections by what they leave, those that leave as much by their
    size: a wrist that turns over is the same arm.
    """
    steps = np.log(max(described.left, 1e-12)) / np.log(AGREEMENT.alike)
    return round(float(steps)), described.correction.size


def _signs(names: Sequence[str]) -> Iterator[tuple[str, ...]]:
    """Yield joints that count in the opposite sense, none first, then one, two and so on, as far as
    all of so many joints are few.
    """
    total = 0
    for count in range(len(names) + 1):
        total += comb(len(names), count)
        if total > _SIGNS and count > 1:
            return
        yield from combinations(names, count)


def _right_angles(names: Sequence[str], most: int) -> Iterator[Mapping[str, float]]:
    """Yield shifts of joints by right angles, none first, then of one joint, two and so on, as far
    as all of so many joints are no more than ``most``.
    """
    total = 0
    for count in range(len(names) + 1):
        here = [
            dict(zip(some, angles, strict=True))
            for some in combinations(names, count)
            for angles in product(_RIGHT_ANGLES, repeat=count)
        ]
        total += len(here)
        if total > most and count > 1:
            return
        yield from here
