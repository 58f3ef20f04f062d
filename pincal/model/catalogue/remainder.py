"""What is smooth in the joints and has no name: errors of the drives that depend on all joints."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import ClassVar

import numpy as np
from scipy.special import ndtri

from pincal.errors import BadInputError
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect, Family, Locus, Term
from pincal.model.effect_bases import joint_index, waves
from pincal.parameters import Parameter
from pincal.thresholds import Count

# Steps by which the roots of a polynomial are refined.
_ROOT_STEPS: Count = 60


@dataclass(frozen=True)
class SmoothRemainder(Effect):
    r"""Errors of some drives that are smooth functions of all joints' positions, without a cause.

    Drive j errs by a Gaussian process of the positions q, the sum of one for each set of
    ``together`` joints, all alike, with the covariance :math:`s^2 \exp(-|q - q'|^2 / 2 l^2)` of
    their positions on average, in waves of fixed directions and lengths,

    .. math:: e_j(q) = \sum_k a_{jk} \sin(w_k \cdot q) + b_{jk} \cos(w_k \cdot q) ,

    with priors of standard deviation :math:`s / \sqrt{K}`: fitted, they are the mean of the process
    given the residuals (kriging), with its uncertainty. The components of :math:`w_k l` in one of
    the sets are normal variables of a sequence that fills their space evenly; the others are zero.

    Distinguished by:
        nothing; it predicts, and says nothing of causes. A cause that is found later replaces it.

    Source:
        Rahimi and Recht (2007), random Fourier features; sums over sets of variables after
        Duvenaud, Nickisch and Rasmussen (2011); the sequence after Roberts (2018), from the
        generalised golden ratio.

    Attributes:
        joints: the revolute joints whose drives err, and on whose positions that depends.
        together: number of joints on which each part of an error depends.
        length: l [rad], over which errors are alike.
        size: s [rad], standard deviation of the error of a drive.
        count: K, number of waves.
    """

    joints: tuple[str, ...]
    together: int
    length: float
    size: float
    count: int
    name: ClassVar[str] = "smooth_remainder"
    meaning: ClassVar[str] = "drives err by smooth functions of all joints, without a known cause"
    family: ClassVar[Family] = Family.NAMELESS
    shares_scale: ClassVar[bool] = True
    locus: ClassVar[Locus] = Locus(None, "drive", None, shape="smooth")

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

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Amplitudes of the sines and cosines of each drive in turn [rad]."""
        size = self.size / float(np.sqrt(self.count))
        return tuple(
            Parameter(f"{joint}.smooth_{wave}_{k + 1}", "rad", self.name, 0.0, size)
            for joint in self.joints
            for wave in ("sin", "cos")
            for k in range(self.count)
        )

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        at = [joint_index(chain, joint) for joint in self.joints]
        q = np.asarray(conditions.q[:, at])
        basis = np.concatenate(waves(self.directions @ q.T))
        return tuple(
            Term(j * len(basis) + p, int(chain.drives[i]), row)
            for j, i in enumerate(at)
            for p, row in enumerate(basis)
        )

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
