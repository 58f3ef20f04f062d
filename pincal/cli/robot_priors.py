"""Prior knowledge of a robot from a file, such as that of its type: satellites hand in what reads
it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from pincal.satellites import Place

if TYPE_CHECKING:
    from pincal.identify.options import Options
    from pincal.measure.measurements import Measurements
    from pincal.model.effect import Effect
    from pincal.parameters import Estimate
    from pincal.robot.robot import Robot


class RobotPrior(Protocol):
    """Prior knowledge of a robot."""

    def prior_of(self, robot: Robot, effects: tuple[Effect, ...]) -> Estimate:
        """Return the prior of the parameters of a model with these effects.

        Raises:
            BadInputError: if it is of another robot.
        """
        ...

    def compared(
        self, robot: Robot, tables: Mapping[str, Measurements], options: Options
    ) -> tuple[Options, tuple[str, ...]]:
        """Return options whose prior is wider where the tables contradict it, and notes on how the
        robot compares with it.
        """
        ...


_READERS: Place[Callable[[Path], RobotPrior]] = Place("priors")


def load_prior(path: Path) -> RobotPrior:
    """Return the prior knowledge of a file.

    Raises:
        BadInputError: if it can't be read, or nothing that reads it is installed.
    """
    return _READERS.only("--type", "pincal.fleet")(path)
