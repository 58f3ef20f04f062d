"""Steps and kinks: curves of one variable that no smooth curve describes as briefly."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pincal.discover.generic import variable
from pincal.model.chain import Chain
from pincal.model.effects import Conditions, Effect, Parameter, Term

_SIZE = 3e-4
# Places that are tried, as fractions of the rows below them.
_PLACES = np.linspace(0.08, 0.92, 29)


@dataclass(frozen=True)
class Broken(Effect):
    """A joint's drive jumps ("step") or turns ("kink") at one value of a variable.

    Attributes:
        joint: where it acts, about the joint's own axis.
        depends_on: name of a joint whose position it follows.
        shape: "step" or "kink".
        place: where it breaks [rad or m].
    """

    joint: str
    depends_on: str
    shape: str
    place: float
    name: ClassVar[str] = "unnamed"

    @property
    def acts_on(self) -> str:
        """Where in the joint."""
        return "drive"

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Height [rad] of the step, or change of slope."""
        return (Parameter(f"{self.joint}.{self.shape}_of_{self.depends_on}", "rad", self.name, 0.0, _SIZE),)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add a Heaviside function, or half an absolute value."""
        x = variable(chain, conditions, self.depends_on) - self.place
        basis = (x > 0).astype(float) if self.shape == "step" else np.maximum(x, 0.0)
        return (Term(0, int(chain.drives[chain.robot.joint_names.index(self.joint)]), basis),)


def broken_candidates(chain: Chain, conditions: Conditions, joint: str) -> Iterator[Broken]:
    """Return steps and kinks of every joint's position at one joint, at many places."""
    for i, source in enumerate(chain.robot.joint_names):
        for place in np.quantile(conditions.q[:, i], _PLACES):
            for shape in ("step", "kink"):
                yield Broken(joint, source, shape, float(place))
