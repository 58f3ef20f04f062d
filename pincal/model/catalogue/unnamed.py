"""Terms without a physical name: what a joint does for no reason that the catalogue knows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from pincal.errors import BadInputError
from pincal.model.catalogue.places import joint_index, positions, waves
from pincal.model.chain import Chain
from pincal.model.effects import Conditions, Effect, Term
from pincal.parameters import Parameter

Shape = Literal["curve", "waves", "product", "step", "kink"]
ActsOn = Literal["drive", "gamma_x", "gamma_y", "s_x", "s_y"]

# Typical size of what has no name [rad].
_SIZE = 3e-4
_DEGREE = 3
_COLUMNS = ("time", "temperature", "payload")


@dataclass(frozen=True)
class Unnamed(Effect):
    """A joint moves with one variable, for no reason that the catalogue knows.

    Attributes:
        joint: where it acts.
        acts_on: "drive" (about the joint's own axis), "gamma_x" or "gamma_y" (across it, behind the joint), "s_x" or "s_y"
            (across it, before the joint).
        depends_on: name of a joint whose position it follows, or "time", "temperature", "payload".
        shape: "curve" (a cubic spline), "waves" (sine and cosine, ``order`` a turn), "product" (of sine or cosine of the
            joint's own angle and of the other's), "step" (at ``place``), or "kink" (another slope from there on).
        lower, upper: the range that was seen; outside it a curve keeps its end value.
        size: number of basis functions of a curve.
        order: waves a turn.
        place: where it breaks [rad or m].
    """

    joint: str
    acts_on: ActsOn
    depends_on: str
    shape: Shape = "curve"
    lower: float = -np.pi
    upper: float = np.pi
    size: int = 8
    order: int | None = None
    place: float | None = None
    name: ClassVar[str] = "unnamed"
    alike: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Refuse waves without an order and a break without a place."""
        if self.shape == "waves" and self.order is None:
            raise BadInputError(f"{self.name} of {self.joint}: waves need an order")
        if self.shape in ("step", "kink") and self.place is None:
            raise BadInputError(f"{self.name} of {self.joint}: a {self.shape} needs a place")

    @property
    def needs(self) -> tuple[str, ...]:  # type: ignore[override]
        """The column that it follows, where that is not a joint's position."""
        return (self.depends_on,) if self.depends_on in _COLUMNS else ()

    @property
    def n_functions(self) -> int:
        """Number of basis functions."""
        return {"curve": self.size, "waves": 2, "product": 4, "step": 1, "kink": 2}[self.shape]

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Heights of the basis functions [rad]."""
        shape = "" if self.shape == "curve" else f"_{self.shape}{self.order or ''}"
        stem = f"{self.joint}.{self.acts_on}_of_{self.depends_on}{shape}"
        return tuple(Parameter(f"{stem}_{i + 1}", "rad", self.name, 0.0, _SIZE) for i in range(self.n_functions))

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add the basis functions to the joint's drive, or tilt it."""
        i = joint_index(chain, self.joint)
        k = int(chain.drives[i]) if self.acts_on == "drive" else chain.joint(i, self.acts_on)
        x = variable(chain, conditions, self.depends_on)
        own = positions(chain, conditions, self.joint)
        return tuple(Term(p, k, basis) for p, basis in enumerate(self._basis(x, own)))

    def _basis(self, x: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the basis functions, shape (n_functions, N)."""
        if self.shape == "curve":
            return spline_basis(x, self.lower, self.upper, self.size)
        if self.order is not None:
            return np.stack(waves(self.order * x))
        if self.shape == "product":
            return np.stack([f * g for f in waves(own) for g in waves(x)])
        beyond = x - (self.place or 0.0)
        return (
            (beyond > 0.0)[None].astype(float)
            if self.shape == "step"
            else np.stack([-np.minimum(beyond, 0.0), np.maximum(beyond, 0.0)])
        )


def variable(chain: Chain, conditions: Conditions, name: str) -> np.ndarray:
    """Return a variable of the conditions by name, shape (N,)."""
    if name in chain.robot.joint_names:
        return positions(chain, conditions, name)
    column = getattr(conditions, name) if name in _COLUMNS else None
    if column is None:
        raise BadInputError(f"a term without a name follows {name}, which these poses do not have; add the column")
    return np.asarray(column)


def spline_basis(x: np.ndarray, lower: float, upper: float, size: int) -> np.ndarray:
    """Return uniform cubic B-splines over [lower, upper], constant beyond, shape (size, N)."""
    from scipy.interpolate import BSpline

    inner = np.linspace(lower, upper, size - _DEGREE + 1)
    knots = np.concatenate([np.full(_DEGREE, lower), inner, np.full(_DEGREE, upper)])
    clipped = np.clip(x, lower, upper)
    return np.asarray(BSpline.design_matrix(clipped, knots, _DEGREE).T.toarray(order="C"))
