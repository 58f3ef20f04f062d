"""Terms without a physical name: smooth functions of one variable acting in one place."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.interpolate import BSpline

from pincal.model.chain import Chain
from pincal.model.effects import Conditions, Effect, Parameter, Term

# Typical size of what has no name [rad].
_SIZE = 3e-4
_DEGREE = 3


@dataclass(frozen=True)
class Unnamed(Effect):
    """A joint moves by a curve of one variable, for no reason that the catalogue knows.

    Attributes:
        joint: where it acts.
        acts_on: "drive" (about the joint's own axis), "gamma_x" or "gamma_y" (across it).
        depends_on: name of a joint whose position it follows, or "time", "temperature", "payload".
        lower, upper: the range that was seen; outside it the curve keeps its end value.
        size: number of basis functions.
    """

    joint: str
    acts_on: str
    depends_on: str
    lower: float
    upper: float
    size: int = 8
    name: ClassVar[str] = "unnamed"

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Heights of the basis functions [rad]."""
        stem = f"{self.joint}.{self.acts_on}_of_{self.depends_on}"
        return tuple(Parameter(f"{stem}_{i + 1}", "rad", self.name, 0.0, _SIZE) for i in range(self.size))

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add a cubic B-spline of the variable."""
        i = chain.robot.joint_names.index(self.joint)
        k = int(chain.drives[i]) if self.acts_on == "drive" else chain.joint(i, self.acts_on)
        basis = spline_basis(variable(chain, conditions, self.depends_on), self.lower, self.upper, self.size)
        return tuple(Term(p, k, basis[p]) for p in range(self.size))


def variable(chain: Chain, conditions: Conditions, name: str) -> np.ndarray:
    """Return a variable of the conditions by name, shape (N,)."""
    if name in chain.robot.joint_names:
        return np.asarray(conditions.q[:, chain.robot.joint_names.index(name)])
    found = {"time": conditions.time, "temperature": conditions.temperature, "payload": conditions.payload}[name]
    assert found is not None
    return np.asarray(found)


def spline_basis(x: np.ndarray, lower: float, upper: float, size: int) -> np.ndarray:
    """Return uniform cubic B-splines over [lower, upper], constant beyond, shape (size, N)."""
    inner = np.linspace(lower, upper, size - _DEGREE + 1)
    knots = np.concatenate([np.full(_DEGREE, lower), inner, np.full(_DEGREE, upper)])
    clipped = np.clip(x, lower, upper)
    return np.ascontiguousarray(BSpline.design_matrix(clipped, knots, _DEGREE).toarray().T)


def generic_candidates(chain: Chain, conditions: Conditions, *, size: int = 8) -> Iterator[Unnamed]:
    """Return curves of every joint's position at every joint, along and across its axis, and of time and temperature."""
    names = chain.robot.joint_names
    ranges = {name: conditions.q[:, i] for i, name in enumerate(names)}
    for name, column in (("time", conditions.time), ("temperature", conditions.temperature)):
        if column is not None:
            ranges[name] = column
    for source, column in ranges.items():
        lower, upper = float(column.min()), float(column.max())
        if upper - lower < 1e-6:
            continue
        for joint in names:
            for acts_on in ("drive", "gamma_x", "gamma_y"):
                yield Unnamed(joint, acts_on, source, lower, upper, size)
