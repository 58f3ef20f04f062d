"""What is smooth in the joints and has no name: errors that depend on all joints."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import ClassVar, Literal

import numpy as np
from scipy.special import ndtri

from pincal.errors import BadInputError
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect, Family, Locus, Term
from pincal.model.effect_bases import joint_index, waves
from pincal.parameters import FRAME_SYMBOLS, Parameter
from pincal.thresholds import Count, Scale

Erring = Literal["drive", "base"]
"""What errs: drives, or the target along axes of the base."""

# Steps by which the roots of a polynomial are refined.
_ROOT_STEPS: Count = 60
# Direction cosine below which an axis of the base does not move a coordinate: rounding.
_ACROSS: Scale = 1e-12


@dataclass(frozen=True)
class SmoothRemainder(Effect):
    r"""Errors that are smooth functions of all joints' positions, without a cause.

    Either drives err, seen through the arm's Jacobian, or the target is displaced along the axes of
    the base, alike in each, by independent Gaussian processes of the positions q. Each is the sum
    of one for each set of ``together`` joints, all alike, with the covariance
    :math:`s^2 \exp(-|q - q'|^2 / 2 l^2)` of their positions on average, in waves of fixed
    directions and lengths,

    .. math:: e(q) = \sum_k a_k \sin(w_k \cdot q) + b_k \cos(w_k \cdot q) ,

    with priors of standard deviation :math:`s / \sqrt{K}`: fitted, they are the mean of the process
    given the residuals (kriging), with its uncertainty. The components of :math:`w_k l` in one of
    the sets are normal variables of a sequence that fills their space evenly; the others are zero.
    With ``modes`` only some orthogonal sums of these waves are left, those that readings can tell.

    Distinguished by:
        nothing; it predicts, and says nothing of causes. A cause that is found later replaces it.

    Source:
        Rahimi and Recht (2007), random Fourier features; sums over sets of variables after
        Duvenaud, Nickisch and Rasmussen (2011); the sequence after Roberts (2018), from the
        generalised golden ratio.

    Attributes:
        joints: the revolute joints on whose positions the errors depend.
        together: number of joints on which each part of an error depends.
        length: l [rad], over which errors are alike.
        size: s [rad, or m along the base's axes], standard deviation of an error.
        count: K, number of waves.
        moves: "drive" for errors of drives, "base" for displacements along the base's axes.
        places: what errs: joints, default those on which it depends; or of "x", "y" and "z",
            default all three.
        modes: for each of these its sums of the K sines and K cosines, in orthogonal rows of any
            norm; default: each wave by itself.
    """

    joints: tuple[str, ...]
    together: int
    length: float
    size: float
    count: int
    moves: Erring = "drive"
    places: tuple[str, ...] = ()
    modes: tuple[tuple[tuple[float, ...], ...], ...] = ()
    name: ClassVar[str] = "smooth_remainder"
    meaning: ClassVar[str] = "errors are smooth functions of all joints, without a known cause"
    family: ClassVar[Family] = Family.NAMELESS
    shares_scale: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not (self.length > 0.0 and self.size > 0.0 and self.count > 0):
            raise BadInputError(
                f"{self.name}: length {self.length:g}, size {self.size:g} and count {self.count}; "
                "expected more than 0"
            )
        if not 1 <= self.together <= len(self.joints):
            raise BadInputError(
                f"{self.name}: {self.together} joints together; expected 1 to {len(self.joints)}"
            )
        axes = FRAME_SYMBOLS[:3]
        if self.moves == "base" and not set(self.places) <= set(axes):
            raise BadInputError(
                f"{self.name}: places {', '.join(self.places)}; expected of {', '.join(axes)}"
            )
        sizes = {len(mode) for of_place in self.modes for mode in of_place}
        if self.modes and (len(self.modes) != len(self.erring) or sizes - {2 * self.count}):
            raise BadInputError(
                f"{self.name}: modes of {len(self.modes)} places, of {sorted(sizes)} waves; "
                f"expected {len(self.erring)} places and {2 * self.count} waves"
            )

    @property
    def locus(self) -> Locus:
        """Its place; it follows no single variable."""
        return Locus(None, self.moves, None, shape="smooth")

    @property
    def erring(self) -> tuple[str, ...]:
        """What errs: joints, or axes of the base."""
        if self.places:
            return self.places
        return self.joints if self.moves == "drive" else FRAME_SYMBOLS[:3]

    @property
    def sums(self) -> tuple[np.ndarray, ...]:
        """The sums of waves of each place, shape (modes, 2 K) each."""
        if not self.modes:
            return (np.eye(2 * self.count),) * len(self.erring)
        return tuple(np.array(of, float).reshape(-1, 2 * self.count) for of in self.modes)

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Amplitudes of the sums of waves of each place in turn [rad or m]."""
        size = self.size / float(np.sqrt(self.count))
        is_of_drives = self.moves == "drive"
        label = "{}.smooth_{}" if is_of_drives else "arm.smooth_{}_{}"
        unit = "rad" if is_of_drives else "m"
        return tuple(
            Parameter(label.format(place, k + 1), unit, self.name, 0.0, size / norm)
            for place, sums in zip(self.erring, self.sums, strict=True)
            for k, norm in enumerate(np.linalg.norm(sums, axis=1).tolist())
        )

    def errors(self, chain: Chain, conditions: Conditions) -> list[np.ndarray]:
        """Return the basis functions of the errors of each place, shape (modes, N) each."""
        basis = self.waves(chain, conditions)
        if not self.modes:
            return [basis] * len(self.erring)
        return [np.asarray(sums @ basis) for sums in self.sums]

    def waves(self, chain: Chain, conditions: Conditions) -> np.ndarray:
        """Return the sines and cosines, shape (2 K, N)."""
        q = np.asarray(conditions.q[:, [joint_index(chain, joint) for joint in self.joints]])
        return np.concatenate(waves(self.directions @ q.T))

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        if self.moves == "base" and chain.path.start != chain.robot.base:
            return ()
        errors = self.errors(chain, conditions)
        of_place = np.repeat(np.arange(len(errors)), [len(of) for of in errors])
        each = (error for of in errors for error in of)
        moved = self._moved(chain, conditions)
        return tuple(
            Term(p, k, error if factor is None else factor * error)
            for p, (place, error) in enumerate(zip(of_place.tolist(), each, strict=True))
            for k, factor in moved[place]
        )

    def _moved(
        self, chain: Chain, conditions: Conditions
    ) -> list[list[tuple[int, np.ndarray | None]]]:
        """Return the coordinates that each place moves, and factors, shape (N,) or (1,); None for
        1.
        """
        if self.moves == "drive":
            drives = (int(chain.drives[joint_index(chain, joint)]) for joint in self.erring)
            return [[(k, None)] for k in drives]
        # Of several set-ups together each row has the axes of its own.
        axes = np.asarray(chain.base_rotation).reshape(-1, 3, 3)
        axes = axes if len(axes) == 1 else axes[conditions.setup]
        return [
            [
                (chain.base(symbol), axes[:, k, place])
                for k, symbol in enumerate(FRAME_SYMBOLS[:3])
                if np.abs(axes[:, k, place]).max() > _ACROSS
            ]
            for place in (FRAME_SYMBOLS.index(axis) for axis in self.erring)
        ]

    @property
    def directions(self) -> np.ndarray:
        """w, the orders of each wave in each joint's position, shape (K, n) [1/rad]."""
        n = len(self.joints)
        steps = golden_ratio(n) ** -np.arange(1.0, n + 1.0)
        spread = np.outer(np.arange(1.0, self.count + 1.0), steps) + 0.5
        sets = list(combinations(range(n), self.together))
        is_own = np.zeros((len(sets), n))
        for row, of in zip(is_own, sets, strict=True):
            row[list(of)] = 1.0
        mine = is_own[np.arange(self.count) % len(sets)]
        return np.asarray(mine * ndtri(spread % 1.0) / self.length)


def golden_ratio(n: int) -> float:
    """Return the generalised golden ratio of n dimensions, the root above 1 of x^(n+1) = x + 1.

    Example:
        >>> round(golden_ratio(1), 6)
        1.618034
    """
    ratio = 2.0
    for _ in range(_ROOT_STEPS):
        ratio = (1.0 + ratio) ** (1.0 / (n + 1.0))
    return ratio
