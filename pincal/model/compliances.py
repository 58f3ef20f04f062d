"""Linear compliance, which every arm has: drives that give way about their axes and bearings that give way across them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, Self, final

import numpy as np

from pincal.model.chain import Chain
from pincal.model.conditions import MOMENT, UNFELT, Conditions, Situation
from pincal.model.effect import Candidate, Discoverable, Family, Locus, Term
from pincal.parameters import Parameter

# Size of real elastic rotations [rad], used as prior where the data can't tell.
BENDING_SIZE = 1e-3


@dataclass(frozen=True)
class Compliance(Discoverable):
    """Elastic rotations that follow the static moments of some joints (paper, III.B).

    Attributes:
        joints: the joints; default: all.
    """

    joints: tuple[str, ...] | None = None
    family: ClassVar[Family] = Family.ELASTICITY
    uses_moments: ClassVar[bool] = True

    @property
    def least_moment(self) -> float:
        """None of one joint alone: where it is all that gives way, the data see it."""
        return super().least_moment if self.only is None else 0.0

    @staticmethod
    @abstractmethod
    def _symbols(chain: Chain) -> tuple[str, ...]:
        """Return the symbols of one joint's compliances."""

    @staticmethod
    @abstractmethod
    def _joint_terms(chain: Chain, conditions: Conditions, moments: np.ndarray, i: int) -> Iterator[Term]:
        """Yield the terms of one joint, whose parameters count from 0."""

    @property
    def only(self) -> str | None:
        """The joint, if it is one alone."""
        return self.joints[0] if self.joints is not None and len(self.joints) == 1 else None

    @final
    def parts(self, chain: Chain) -> tuple[Self, ...]:
        """Return the compliance of each joint by itself."""
        return tuple(replace(self, joints=(joint,)) for joint in self.joints or chain.robot.joint_names)

    @final
    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """The compliances of each joint [rad/(N m)]."""
        return tuple(
            Parameter(f"{chain.robot.joint_names[i]}.{symbol}", "rad/(N m)", self.name, 0.0, BENDING_SIZE)
            for i in self._indices(chain)
            for symbol in self._symbols(chain)
        )

    @final
    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add compliance times moment to the elastic rotations."""
        assert moments is not None
        size = len(self._symbols(chain))
        return tuple(
            term._replace(parameter=size * place + term.parameter)
            for place, i in enumerate(self._indices(chain))
            for term in self._joint_terms(chain, conditions, moments, i)
        )

    def _indices(self, chain: Chain) -> list[int]:
        names = chain.robot.joint_names
        return list(range(len(names))) if self.joints is None else [names.index(name) for name in self.joints]


@dataclass(frozen=True)
class JointElasticity(Compliance):
    """Each drive gives way about its own axis: gamma_z = k_z n_z.

    Told apart by:
        two payloads in poses that repeat: what grows with the load gives way. With one load a gravity compensator, a gear
        eccentricity of order 1 or an error of the masses looks similar.

    Source:
        Radkhah et al., Eq. (3); Whitney, Lozinski and Rourke (1986).
    """

    name: ClassVar[str] = "joint_elasticity"
    meaning: ClassVar[str] = "the drive twists under the load on its axis"

    @property
    def locus(self) -> Locus:
        """The elastic rotations of its drives, which follow the moments there."""
        return Locus(self.only, "gamma_z", MOMENT)

    @classmethod
    def candidates(cls, situation: Situation) -> Iterator[Candidate]:
        """Yield the elasticity of all drives that these poses load.

        About a vertical axis gravity has a moment only as far as the base is not level. Any tilt goes, since the base's own
        makes up for it, so that such a compliance could take the place of a true effect of that joint's position.
        """
        heaviest = UNFELT * np.abs(situation.moments).max(initial=0.0)
        joints = situation.joints
        felt = tuple(joint for joint in joints if np.abs(situation.moment(joint)).max(initial=0.0) > heaviest)
        yield Candidate(cls() if len(felt) == len(joints) else cls(felt))

    @staticmethod
    def _symbols(chain: Chain) -> tuple[str, ...]:
        return ("k_z",)

    @staticmethod
    def _joint_terms(chain: Chain, conditions: Conditions, moments: np.ndarray, i: int) -> Iterator[Term]:
        yield Term(0, chain.joint(i, "gamma_z"), moments[:, 3 * i + 2], 3 * i + 2)


@dataclass(frozen=True)
class BearingElasticity(Compliance):
    r"""Each bearing gives way across its axis: gamma_x = k_x n_x, gamma_y = k_y n_y.

    With the paper's moment frame that is to its letter: about the origin of the Denavit-Hartenberg frame, which is a choice
    of whoever lays the frames. With "before" and "after" the moment is taken and the link turns where the bearing sits,
    at the height h on its axis.

    Told apart by:
        payloads, and poses in which the load lies across the axis. Of joint 1 it is like a foundation that gives way.

    Source:
        Radkhah et al., Eq. (3); Nubiola and Bonev (2013) for joints alone.
    """

    name: ClassVar[str] = "bearing_elasticity"
    meaning: ClassVar[str] = "the bearing tilts under load across its axis"

    @property
    def locus(self) -> Locus:
        """The tilts of its bearings, which follow the moments there."""
        return Locus(self.only, "tilt", MOMENT)

    @classmethod
    def candidates(cls, situation: Situation) -> Iterator[Candidate]:
        """Yield the elasticity of all bearings."""
        yield Candidate(cls())

    @staticmethod
    def _symbols(chain: Chain) -> tuple[str, ...]:
        return ("k_x", "k_y")

    @staticmethod
    def _joint_terms(chain: Chain, conditions: Conditions, moments: np.ndarray, i: int) -> Iterator[Term]:
        for axis, coordinate in enumerate(("gamma_x", "gamma_y")):
            yield Term(axis, chain.joint(i, coordinate), moments[:, 3 * i + axis], 3 * i + axis)
