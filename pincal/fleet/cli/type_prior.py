"""Types of robots as prior knowledge of a further one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from pincal.errors import counted
from pincal.fleet.robot_type import EVERYTHING, RobotType, calibrate_of_type, load_type
from pincal.identify.options import Options
from pincal.measure.measurements import Measurements
from pincal.model.effect import Effect
from pincal.model.effects import ELASTIC
from pincal.parameters import Estimate
from pincal.robot.robot import Robot
from pincal.units import chance_words


@dataclass(frozen=True)
class TypePrior:
    """A type as a :class:`~pincal.cli.robot_priors.RobotPrior`.

    Attributes:
        of: the type.
    """

    of: RobotType

    @classmethod
    def load(cls, path: Path) -> TypePrior:
        """Return the type of a file.

        Raises:
            BadInputError: if it can't be read.
        """
        return cls(load_type(path))

    def prior_of(self, robot: Robot, effects: tuple[Effect, ...]) -> Estimate:
        """Return the prior of a further machine."""
        return self.of.prior_of(robot, effects)

    def compared(
        self, robot: Robot, tables: Mapping[str, Measurements], options: Options
    ) -> tuple[Options, tuple[str, ...]]:
        """Return the options with the prior of the robot's type, and a note on how the robot
        compares with it.

        Where the robot differs from its type, the prior is wider.
        """
        of = self.of
        effects = options.effects
        # A model that lacks effects of the type would make its robots look unusual.
        whole = ELASTIC if any(parameter.is_compliance for parameter in of.parameters) else ()
        judging = replace(
            options, effects=(*effects, *(effect for effect in whole if effect not in effects))
        )
        _, member = calibrate_of_type(robot, tables, of, judging)
        if not member.is_usual:
            options = replace(options, earlier=of.prior_of(robot, effects, member))
        compared = (
            f"compared with {counted(of.machines, 'robot')} of its type, "
            f"{chance_words(member.p_value)}"
        )
        if not member.off:
            return options, (f"the robot agrees with the others ({compared})",)
        where = (
            "in more than one joint"
            if member.off == (EVERYTHING,)
            else f"in {' or '.join(member.off)}"
        )
        note = f"the robot differs from the others {where} ({compared}); its prior is wider there"
        return options, (note,)
