"""Unpublished masses, as parameters that are observable through the compliances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pincal.errors import counted
from pincal.model.chain import Chain
from pincal.model.conditions import MOMENT, Conditions
from pincal.model.effect import Body, Effect, Family, Locus, Term
from pincal.parameters import Parameter
from pincal.robot.robot import Robot
from pincal.thresholds import Scale

# Uncertainty of masses and centres of mass guessed from an arm's shape: fractions of the link's own
# mass, and of its size.
_MASS_SIZE: Scale = 0.5
_CENTRE_SIZE: Scale = 0.3
_AXES: tuple[tuple[Scale, Scale, Scale], ...] = (
    (1.0, 0.0, 0.0),
    (0.0, 1.0, 0.0),
    (0.0, 0.0, 1.0),
)
# Least size of a link, as a fraction of the arm's.
_SHORTEST: Scale = 0.1


@dataclass(frozen=True)
class LinkMass(Effect):
    """Mass of each link and first moment of mass about its guessed centre; the static moments are
    linear in both.

    Observable only through the compliances, gamma = k n, they are identified up to a common factor
    of all masses and the inverse of all compliances, unless the payload varies; the priors fix this
    factor, and predictions do not depend on it.

    Distinguished by:
        known payloads: without them only the product of masses and compliances is observable. The
        mass from the data sheet (`--mass`) is equivalent.

    Source:
        Atkeson, An and Hollerbach (1986).

    Attributes:
        joints: the joints whose links have no known mass; default: all.
    """

    joints: tuple[str, ...] | None = None
    name: ClassVar[str] = "link_mass"
    meaning: ClassVar[str] = (
        "masses and centres of mass of links that are missing in the robot description"
    )
    family: ClassVar[Family] = Family.LOAD
    locus: ClassVar[Locus] = Locus(acts_on="gamma", follows=MOMENT)
    is_constant: ClassVar[bool] = True

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Mass [kg], and first moment of mass about the guessed centre [kg m]."""
        found = []
        for i in self._indices(chain):
            joint = chain.robot.joint_names[i]
            mass = float(chain.robot.masses[i])
            found.append(Parameter(f"{joint}.mass", "kg", self.name, mass, _MASS_SIZE * mass))
            size = _CENTRE_SIZE * mass * self._length(chain, i)
            found += [
                Parameter(f"{joint}.mc_{axis}", "kg m", self.name, 0.0, size) for axis in "xyz"
            ]
        return tuple(found)

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        """None: masses act through the moments that load the compliances."""
        return ()

    def bodies(self, chain: Chain) -> tuple[Body, ...]:
        found = []
        for k, i in enumerate(self._indices(chain)):
            x, y, z = chain.robot.centres[i].tolist()
            found.append(Body(4 * k, i, 1.0, (x, y, z)))
            found += [Body(4 * k + 1 + a, i, 0.0, moment) for a, moment in enumerate(_AXES)]
        return tuple(found)

    def _indices(self, chain: Chain) -> list[int]:
        names = chain.robot.joint_names
        return (
            list(range(len(names)))
            if self.joints is None
            else [names.index(name) for name in self.joints]
        )

    @staticmethod
    def _length(chain: Chain, i: int) -> float:
        robot = chain.robot
        return max(float(np.hypot(*robot.frames.parameters[i, 3:5])), _SHORTEST * robot.reach)


def with_masses(robot: Robot, effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """Return effects with the link masses missing in the robot's description if anything is
    elastic, else without masses.
    """
    if not any(effect.uses_moments for effect in effects):
        return tuple(effect for effect in effects if not isinstance(effect, LinkMass))
    if not robot.massless or any(isinstance(effect, LinkMass) for effect in effects):
        return tuple(effects)
    joints = robot.unweighed
    return (*effects, LinkMass(None if len(joints) == robot.n_joints else joints))


def notes_on_masses(robot: Robot, effects: Sequence[Effect]) -> tuple[str, ...]:
    """Return a note that masses are guesses, if they matter."""
    if not robot.massless or not any(effect.uses_moments for effect in effects):
        return ()
    return (
        f"the robot description has no usable masses for {counted(len(robot.massless), 'link')}: "
        f"moments are those of its shape, {robot.masses.sum():.3g} kg in all; a calibration "
        "estimates them with the compliances",
    )
