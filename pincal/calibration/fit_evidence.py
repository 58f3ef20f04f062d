"""What the rows of a calibration show besides its estimate: of a fit, or as kept in a file."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

from pincal.calibration.information import RobotInformation
from pincal.calibration.unmodelled import Unmodelled, unmodelled_by
from pincal.identify.fit import ModelFit


class Evidence(Protocol):
    """What rows show of a robot besides its parameters."""

    @property
    def unmodelled(self) -> Unmodelled | None:
        """Effects present in the rows but not in the model; None without any, or where they were
        not searched for.
        """

    @property
    def information(self) -> RobotInformation | None:
        """Information of the rows of all stations on the robot, without priors; None where it is
        not known.
        """


@dataclass(frozen=True)
class KeptEvidence:
    """Evidence as it is kept with a model, without the rows.

    Attributes:
        unmodelled: see :class:`Evidence`.
        information: likewise.
    """

    unmodelled: Unmodelled | None = None
    information: RobotInformation | None = None


@dataclass(frozen=True)
class FitEvidence:
    """Evidence of a fit, worked out when it is asked for: the search for unmodelled effects takes
    as long as a fit.

    Attributes:
        fit: the problem, its rows and its solution.
    """

    fit: ModelFit

    @cached_property
    def unmodelled(self) -> Unmodelled | None:
        """Effects present in the rows but not in the model; None without any."""
        return unmodelled_by(self.fit)

    @cached_property
    def information(self) -> RobotInformation:
        """Information of the rows of all stations on the robot, with base, targets and instrument
        eliminated.
        """
        return RobotInformation.of(self.fit)
