"""A fit to tables that agrees with them: the check after the fit, for the command and
for Python.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

from pincal.errors import MeasurementError
from pincal.identify.calibrate import fit_tables
from pincal.identify.fit import ModelFit
from pincal.identify.options import Options
from pincal.measure.measurements import Measurements
from pincal.robot.robot import Robot
from pincal.thresholds import Count
from pincal.validate.agreement import check_agreement, refuse_exact, unknown_zeros
from pincal.validate.clock_jumps import check_clocks
from pincal.validate.cures import Correction

log = logging.getLogger(__name__)
# Corrections of a robot's description at most.
_CORRECTIONS: Count = 12


@dataclass(frozen=True)
class AgreedFit:
    """A fit whose tables can be of its robot.

    Attributes:
        robot: the arm, its description perhaps corrected.
        fit: of this robot.
        notes: the corrections, in words.
    """

    robot: Robot
    fit: ModelFit
    notes: tuple[str, ...]


def fit_agreed(
    robot: Robot,
    admitted: Mapping[str, Measurements],
    options: Options,
    *,
    trained: Mapping[str, Measurements] | None = None,
    executor: Executor | None = None,
) -> AgreedFit:
    """Fit tables and refuse them if their residuals can't be this robot's.

    Args:
        robot: the arm.
        admitted: the rows of each station, see :func:`pincal.measure.admit.admit`.
        options: how to fit.
        trained: the rows among them that are fitted; default: all.
        executor: as for :func:`pincal.calibrate`.

    Returns:
        The fit. Where readings show joints with another sign or zero than described, it is of the
        corrected robot.

    Raises:
        SteppingClocksError: if a clock jumps.
        MeasurementError: if one jumps too often, the tables are not of this robot, or a few
            positions of unknown noise are fitted exactly.
    """
    rows = admitted if trained is None else trained
    fit = fit_tables(robot, rows, options, executor=executor)
    check_clocks(admitted, fit)
    corrected = list[Correction]()
    # The description may be wrong in more than one way.
    found = _checked(robot, admitted, fit, ())
    while found is not None and sum(len(one.notes) for one in corrected) < _CORRECTIONS:
        robot = found.of(robot)
        corrected.append(found)
        log.info("repeating, as %s", "; ".join(found.notes))
        fit = fit_tables(robot, rows, options, executor=executor)
        found = _checked(robot, admitted, fit, correction_notes(corrected))
    refuse_exact(fit)
    return AgreedFit(robot, fit, (*correction_notes(corrected), *unknown_zeros(fit)))


def correction_notes(corrections: Iterable[Correction]) -> list[str]:
    """Return the notes on corrections, each of the robot as corrected before: one on each joint and
    length, whose parts add up.
    """
    whole = list[Correction]()
    for one in corrections:
        both = whole[-1].then(one) if whole else None
        whole[-1:] = [both] if both is not None else [*whole[-1:], one]
    return [note for one in whole for note in one.notes]


def _checked(
    robot: Robot, admitted: Mapping[str, Measurements], fit: ModelFit, corrected: Sequence[str]
) -> Correction | None:
    """Return what else is wrong with a description; refuse tables for more than that, and say what
    was corrected before.
    """
    try:
        return check_agreement(robot, admitted.values(), fit)
    except MeasurementError as error:
        if not corrected:
            raise
        raise MeasurementError(f"{error}; besides, {'; '.join(corrected)}") from error
