"""A drive error that is any curve of the joint's own position."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from pincal.errors import BadInputError
from pincal.model.basis import FEWEST_SPLINES, spline_basis, spline_roughness
from pincal.model.chain import Chain
from pincal.model.conditions import TURN, Conditions, PoseSet, distinct_values, recorded_variable
from pincal.model.effect import Candidate, Curve, Locus
from pincal.model.effect_bases import WAVE, DriveEffect, drive_unit, parameters_of
from pincal.model.symbols import held
from pincal.parameters import Parameter

# Part of a turn from which on the curve is taken as periodic: what is left is too small a gap for a Fourier series to swing.
_NEARLY_A_TURN = 0.9
# Number of basis functions unless another is asked for; the numbers that a discovery tries first, from coarse to fine.
_SIZE = 24
_SIZES = (8, 12, 18, 26, 44, 80)
# Width of the pieces of a curve that is believed to be smooth [rad]: the teeth of a strain wave gear of 100 : 1 are 1.8 deg
# wide. Along a rail, so many pieces. How many times finer they may become if the rows tell as much.
_PIECE, _MOST_PIECES, _FINEST = np.radians(1.0), 180, 1.5
# Typical size of the curve as a whole [rad or m], where its pieces are held together by its smoothness.
_HEIGHT = 1e-3
# Poses that each basis function needs to be fitted at all: six of position show the size of a bump and its scatter.
POSES_PER_PIECE = 6


def most_pieces(x: np.ndarray) -> int:
    """Return how many basis functions of a variable, shape (N,), as many poses and distinct values carry.

    With more functions than values of the variable those between the values are anybody's guess: they alias.
    """
    return min(len(x) // POSES_PER_PIECE, distinct_values(x))


@dataclass(frozen=True)
class TransmissionError(DriveEffect, Curve):
    r"""An irregular gear: a curve g(q) of its own position adds to the joint position.

    .. math:: g(q) = \sum_p c_p B_p(\min(\max(q, q_{lower}), q_{upper}))

    with :math:`B_p` the sines and cosines of q, 2q, ... if periodic, else cubic B-splines on uniform knots. Outside the
    measured positions g keeps its end value: a curve identified in one range gives no information on another. Positions a
    revolution away are mapped to the measured revolution, as if the curve were periodic. The splines add up to 1, which is
    equivalent to the joint offset; the prior resolves that.

    Its smoothness may be known: the second derivative is modelled as white noise of intensity w, so that

    .. math:: \int g''(q)^2 dq / w^2

    is added to the squares, and the most probable curve is a smoothing spline. Without w the pieces are independent.

    Distinguished by:
        two payloads: a curve of the drive follows the position and not the load. What it is made of (eccentricity, ratio,
        teeth) shows in its shape, over a full turn.

    Source:
        Tuttle (1992); splines after de Boor (1978), smooth ones as a prior after Wahba (1978).

    Attributes:
        joint: the joint.
        lower, upper: the positions covered by measurements [rad or m].
        size: number of basis functions, at least 4; even if periodic.
        periodic: whether the curve repeats after a revolution.
        roughness: w, [rad^-0.5] or [m^-0.5]; default: unknown.
    """

    lower: float
    upper: float
    size: int = _SIZE
    periodic: bool = False
    roughness: float | None = None
    name: ClassVar[str] = "transmission_error"
    meaning: ClassVar[str] = "the joint error is a curve of its own angle: gear teeth, encoder scale, wave generator"

    def __post_init__(self) -> None:
        """Refuse an empty range and a number of basis functions that does not fit."""
        if not self.lower < self.upper:
            raise BadInputError(f"{self.name} of {self.joint}: range {self.lower} .. {self.upper} is empty; move the joint")
        if self.size < FEWEST_SPLINES or (self.periodic and self.size % 2):
            kind = "an even number of at least 4" if self.periodic else "at least 4"
            raise BadInputError(f"{self.name} of {self.joint}: size {self.size}; expected {kind}")
        if self.roughness is not None and not 0.0 < self.roughness < np.inf:
            raise BadInputError(f"{self.name} of {self.joint}: roughness {self.roughness}; expected a number above 0")

    @classmethod
    def over(cls, joint: str, q_column: np.ndarray, size: int = _SIZE, *, periodic: bool | None = None) -> TransmissionError:
        """Return the curve over the positions that a joint takes, shape (N,) [rad or m].

        The number of basis functions is one more where a periodic curve needs an even number; unless told, a curve is taken
        as periodic if the positions cover nearly a turn without a large gap.
        """
        lower, upper = float(np.min(q_column)), float(np.max(q_column))
        repeats = _covers_a_turn(q_column) if periodic is None else periodic
        return cls(joint, lower, upper, size + size % 2 if repeats else size, repeats)

    @property
    def locus(self) -> Locus:
        """The drive, by its own position."""
        return Locus(self.joint, "drive", self.joint, span=(self.lower, self.upper))

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        """Yield it on every joint, over the positions that it takes, from a few pieces to many."""
        for joint in situation.joints:
            q = situation.positions(joint)
            # A joint that stands still is reported as such; its curve only has to have some range.
            moving = q if np.ptp(q) else np.array([q[0] - 1.0, q[0] + 1.0])
            most = most_pieces(moving if np.ptp(q) else np.arange(len(q)))
            curves = tuple(cls.over(joint, moving, size) for size in _SIZES if size <= most)
            values = distinct_values(q)
            is_few = 1 < values < min(_SIZES[0], len(q) // POSES_PER_PIECE)
            few = f"{joint} takes {values} distinct positions, and the coarsest curve that is tried has {_SIZES[0]} pieces"
            yield Candidate(cls.over(joint, moving, _SIZE), variants=curves, obstacle=few if is_few else "")

    @property
    def resolution(self) -> int:
        """Number of basis functions."""
        return self.size

    def resized(self, situation: PoseSet, resolution: int) -> TransmissionError:
        """Return the curve with another number of basis functions, over the positions that the poses cover."""
        return TransmissionError.over(self.joint, situation.positions(self.joint), resolution)

    def reduced(self, situation: PoseSet) -> TransmissionError:
        """Return the curve in the fewest pieces that a discovery tries."""
        return self.resized(situation, _SIZES[0])

    def smooth(self, situation: PoseSet, roughness: float | None, resolution: int | None = None) -> TransmissionError:
        """Return the curve in so many pieces, as far as the poses carry them, or as gear teeth call for."""
        q = situation.positions(self.joint)
        fine = int(np.ceil(np.ptp(q) / _PIECE)) if self.joint in situation.revolute else _MOST_PIECES
        # Neighbours hold a smooth curve up where it has few poses of its own.
        most = most_pieces(q) if resolution is None else min(len(q) // 3, distinct_values(q))
        most = min(most, int(_FINEST * fine))
        # Fewer pieces than usual would bend a smooth curve and save no time worth having.
        size = fine if resolution is None else max(resolution, min(fine, _SIZE))
        size = max(min(size, most), _SIZES[0])
        return replace(self.resized(situation, size), roughness=roughness)

    def smoothness(self) -> np.ndarray | None:
        """Return the information of the roughness about the coefficients, shape (size, size); None if it isn't known."""
        if self.roughness is None:
            return None
        if not self.periodic:
            return spline_roughness(self.lower, self.upper, self.size) / self.roughness**2
        orders = np.repeat(np.arange(1.0, self.size // 2 + 1), 2)
        return np.diag(np.pi * orders**4) / self.roughness**2

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Coefficients of the basis functions [rad or m]."""
        symbols = [f"curve_{p + 1}" for p in range(self.size)]
        size = WAVE if self.roughness is None else _HEIGHT
        return parameters_of(self, self.joint, symbols, unit=drive_unit(chain, self.joint), size=size)

    def bases(self, chain: Chain, conditions: Conditions) -> np.ndarray:
        """Return the basis functions at the recorded positions."""
        return self.basis(recorded_variable(chain, conditions, self.joint, span=(self.lower, self.upper)))

    def basis(self, q: np.ndarray) -> np.ndarray:
        """Return the basis functions at positions of shape (N,), shape (size, N)."""
        inside = held(q, self.lower, self.upper)
        if self.periodic:
            angles = np.arange(1, self.size // 2 + 1)[:, None] * inside
            return np.stack((np.sin(angles), np.cos(angles)), axis=1).reshape(self.size, -1)
        return spline_basis(inside, self.lower, self.upper, self.size)


def _covers_a_turn(q: np.ndarray) -> bool:
    """Return whether the largest gap between angles [rad] is small, also where the turn closes."""
    seen = np.unique(np.mod(q, TURN))
    return bool(np.max(np.diff(seen, append=seen[0] + TURN)) <= (1.0 - _NEARLY_A_TURN) * TURN)
