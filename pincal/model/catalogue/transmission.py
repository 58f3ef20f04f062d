"""A drive error that is a free curve of the joint's own position."""

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
from pincal.model.effect_numbers import SHOWN
from pincal.model.symbols import held
from pincal.parameters import Parameter
from pincal.thresholds import Count, Scale

# Default number of basis functions; the numbers that a discovery tries first, from coarse to fine.
_SIZE: Count = 24
_SIZES: tuple[Count, ...] = (8, 12, 18, 26, 44, 80)
# Width of the pieces of a curve with a smoothness prior [rad]: the teeth of a strain wave gear of
# 100 : 1 are 1.8 deg wide. Number of pieces along a rail. Factor by which they may become finer if
# the data require it.
_PIECE = np.radians(1.0)
_MOST_PIECES: Count = 180
_FINEST: Scale = 1.5
# Typical size of the curve as a whole [rad or m], if a smoothness prior couples its pieces.
_HEIGHT: Scale = 1e-3


def most_pieces(x: np.ndarray) -> int:
    """Return the largest number of basis functions of a variable that its values, shape (N,),
    support.

    With more functions than distinct values the curve between the values is undetermined: it
    aliases.
    """
    return min(len(x) // SHOWN.poses_per_piece, distinct_values(x))


@dataclass(frozen=True)
class TransmissionError(DriveEffect, Curve):
    r"""An irregular gear: a curve g(q) of the joint's own position is added to it.

    .. math:: g(q) = \sum_p c_p B_p(\min(\max(q, q_{lower}), q_{upper}))

    with :math:`B_p` the sines and cosines of q, 2q, ... if periodic, else cubic B-splines on
    uniform knots. Outside the measured positions g keeps its end value: a curve identified in one
    range gives no information on another. Positions a revolution away are mapped to the measured
    revolution, as if the curve were periodic. The splines add up to 1, which is equivalent to the
    joint offset; the prior resolves this ambiguity.

    With a smoothness prior the second derivative is modelled as white noise of intensity w, so that

    .. math:: \int g''(q)^2 dq / w^2

    is added to the sum of squares, and the most probable curve is a smoothing spline. Without w the
    pieces are independent.

    Distinguished by:
        two payloads: a curve of the drive depends on the position and not on the load. Its
        components (eccentricity, ratio, teeth) show in its shape over a full revolution.

    Source:
        Tuttle (1992); splines after de Boor (1978), smooth ones as a prior after Wahba (1978).

    Attributes:
        joint: the joint.
        lower, upper: the positions covered by measurements [rad or m].
        size: number of basis functions, at least 4; even if periodic.
        periodic: whether the curve repeats after a revolution.
        roughness: w, [rad^-0.5] or [m^-0.5]; None for no smoothness prior.
    """

    lower: float
    upper: float
    size: int = _SIZE
    periodic: bool = False
    roughness: float | None = None
    name: ClassVar[str] = "transmission_error"
    meaning: ClassVar[str] = (
        "the joint error is a curve of its own angle: gear teeth, encoder scale, wave generator"
    )

    def __post_init__(self) -> None:
        if not self.lower < self.upper:
            raise BadInputError(
                f"{self.name} of {self.joint}: range {self.lower} .. {self.upper} is "
                "empty; move the joint"
            )
        if self.size < FEWEST_SPLINES or (self.periodic and self.size % 2):
            kind = "an even number of at least 4" if self.periodic else "at least 4"
            raise BadInputError(f"{self.name} of {self.joint}: size {self.size}; expected {kind}")
        if self.roughness is not None and not 0.0 < self.roughness < np.inf:
            raise BadInputError(
                f"{self.name} of {self.joint}: roughness {self.roughness}; expected a "
                "number above 0"
            )

    @classmethod
    def over(
        cls, joint: str, q_column: np.ndarray, size: int = _SIZE, *, periodic: bool | None = None
    ) -> TransmissionError:
        """Return the curve over the positions that a joint takes, shape (N,) [rad or m].

        The number of basis functions is one more if a periodic curve needs an even number; by
        default a curve is periodic if the positions cover nearly a turn without a large gap.
        """
        lower = float(np.min(q_column))
        upper = float(np.max(q_column))
        repeats = _covers_a_turn(q_column) if periodic is None else periodic
        return cls(joint, lower, upper, size + size % 2 if repeats else size, repeats)

    @property
    def locus(self) -> Locus:
        return Locus(self.joint, "drive", self.joint, span=(self.lower, self.upper))

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        """Yield it on every joint, over the measured positions, from few pieces to many."""
        for joint in situation.joints:
            q = situation.positions(joint)
            # A joint that does not move is reported as such; its curve only needs some range.
            does = joint in situation.moving
            moving = q if does else np.array([q[0] - 1.0, q[0] + 1.0])
            most = most_pieces(q if does else np.arange(len(q)))
            curves = tuple(cls.over(joint, moving, size) for size in _SIZES if size <= most)
            values = distinct_values(q) if does else 1
            is_few = 1 < values < min(_SIZES[0], len(q) // SHOWN.poses_per_piece)
            few = (
                f"{joint} takes {values} distinct positions, and the coarsest curve that is "
                f"tried has {_SIZES[0]} pieces"
            )
            yield Candidate(
                cls.over(joint, moving, _SIZE), variants=curves, obstacle=few if is_few else ""
            )

    @property
    def resolution(self) -> int:
        return self.size

    def resized(self, situation: PoseSet, resolution: int) -> TransmissionError:
        return TransmissionError.over(self.joint, situation.positions(self.joint), resolution)

    def reduced(self, situation: PoseSet) -> TransmissionError:
        return self.resized(situation, _SIZES[0])

    def smooth(
        self, situation: PoseSet, roughness: float | None, resolution: int | None = None
    ) -> TransmissionError:
        """Return the curve with so many pieces, as far as the poses support them, or with pieces as
        fine as gear teeth.
        """
        q = situation.positions(self.joint)
        fine = (
            int(np.ceil(np.ptp(q) / _PIECE)) if self.joint in situation.revolute else _MOST_PIECES
        )
        # Neighbouring pieces constrain a smooth curve where it has few poses.
        most = most_pieces(q) if resolution is None else min(len(q) // 3, distinct_values(q))
        most = min(most, int(_FINEST * fine))
        # Fewer pieces than the default would distort a smooth curve and save little time.
        size = fine if resolution is None else max(resolution, min(fine, _SIZE))
        size = max(min(size, most), _SIZES[0])
        return replace(self.resized(situation, size), roughness=roughness)

    def smoothness(self) -> np.ndarray | None:
        """Return the prior information of the roughness on the coefficients, shape (size, size);
        None without roughness.
        """
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
        return parameters_of(
            self, self.joint, symbols, unit=drive_unit(chain, self.joint), size=size
        )

    def bases(self, chain: Chain, conditions: Conditions) -> np.ndarray:
        return self.basis(
            recorded_variable(chain, conditions, self.joint, span=(self.lower, self.upper))
        )

    def basis(self, q: np.ndarray) -> np.ndarray:
        inside = held(q, self.lower, self.upper)
        if self.periodic:
            angles = np.arange(1, self.size // 2 + 1)[:, None] * inside
            return np.stack((np.sin(angles), np.cos(angles)), axis=1).reshape(self.size, -1)
        return spline_basis(inside, self.lower, self.upper, self.size)


def _covers_a_turn(q: np.ndarray) -> bool:
    """Return whether the largest gap between angles [rad] is small, including the gap across the
    end of the turn.
    """
    seen = np.unique(np.mod(q, TURN))
    return bool(np.max(np.diff(seen, append=seen[0] + TURN)) <= (1.0 - SHOWN.nearly_a_turn) * TURN)
