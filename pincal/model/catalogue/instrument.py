r"""Effects of an instrument that reads positions: encoders, axes and distance meter of a tracker;
stretched coordinates.

A tracker reads azimuth A, elevation E and range r of its target; the table contains

.. math:: x = r \cos E \cos A, \quad y = r \cos E \sin A, \quad z = r \sin E .

An error of a reading moves the target across or along the line of sight, as a function of the
target's position: as read, or as predicted by the model before it is read. All these effects belong
to the station. They need positions in the tracker's own frame, with its origin at the intersection
of the tracker's axes and z along the standing axis. In a transformed frame (the robot's, or the
hall's) they are other functions; if its origin is where no tracker can stand, they are not tested.
Stretched coordinates are the same effect in any frame.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple, get_args

import numpy as np

from pincal.errors import BadInputError
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions, PoseSet
from pincal.model.effect import Candidate, Discoverable, Locus, Term
from pincal.model.effect_bases import RATIO, TILT, parameters_of, waves
from pincal.model.model import Model
from pincal.parameters import Parameter, Scope
from pincal.thresholds import Scale

Orders = Literal[1, 2]
_ORDERS: tuple[Orders, ...] = get_args(Orders)
_STRETCHED = ("x", "y", "xy", "xz", "yz")
# Distance to the standing axis, or to the tracker, below which directions across it are undefined
# [m].
_AT_AXIS: Scale = 1e-9


class Sight(NamedTuple):
    """Targets in the tracker's spherical coordinates.

    Attributes:
        range: from the tracker, shape (N,) [m].
        azimuth: about its standing axis, shape (N,) [rad].
        elevation: above the horizon, shape (N,) [rad].
        along: unit vector of the line of sight, shape (3, N).
        level: unit vector to the left of it, along growing azimuth.
        up: unit vector along growing elevation.
    """

    range: np.ndarray
    azimuth: np.ndarray
    elevation: np.ndarray
    along: np.ndarray
    level: np.ndarray
    up: np.ndarray

    @classmethod
    def of(cls, sighted: np.ndarray) -> Sight:
        """Return the sight of targets at positions of shape (N, 3) [m]."""
        x, y, z = np.asarray(sighted, float).T
        across = np.maximum(np.hypot(x, y), _AT_AXIS)
        r = np.maximum(np.sqrt(x**2 + y**2 + z**2), _AT_AXIS)
        cos = x / across
        sin = y / across
        zero = np.zeros_like(x)
        return cls(
            r,
            np.arctan2(y, x),
            np.arctan2(z, across),
            np.array([x, y, z]) / r,
            np.array([-sin, cos, zero]),
            np.array([-z * cos, -z * sin, across]) / r,
        )


class _Reading(Discoverable):
    """An error of an instrument's reading."""

    scope: ClassVar[Scope] = "station"
    is_sighted: ClassVar[bool] = True

    @abstractmethod
    def _moves(self, sight: Sight) -> Sequence[np.ndarray]:
        """Return the displacement of the reading per unit of each parameter, shape (3,
        N) each [m].
        """

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        if conditions.sighted is None:
            raise BadInputError(
                f"{self.name} needs the target's position in the instrument's frame; "
                "expected positions"
            )
        moves = enumerate(self._moves(Sight.of(conditions.sighted)))
        return tuple(
            Term(p, chain.base(axis), way[k])
            for p, way in moves
            for k, axis in enumerate("xyz")
            if way[k].any()
        )


@dataclass(frozen=True)
class _Circle(_Reading):
    """An error of one of a tracker's angle encoders.

    Attributes:
        orders: 1 for an eccentric encoder, 2 for one that is also elliptical.
    """

    orders: Orders = 1

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        yield Candidate(cls(), variants=tuple(map(cls, _ORDERS)), obstacle=_obstacle(situation))

    def __post_init__(self) -> None:
        if self.orders not in _ORDERS:
            raise BadInputError(f"{self.name}: orders {self.orders}; expected 1 or 2")

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Amplitudes s and c of each order [rad]."""
        symbols = [
            f"{self.locus.acts_on}_{wave}{k}"
            for k in _ORDERS[: self.orders]
            for wave in ("sin", "cos")
        ]
        return parameters_of(self, "instrument", symbols, unit="rad", size=TILT)

    @abstractmethod
    def _read(self, sight: Sight) -> tuple[np.ndarray, np.ndarray]:
        """Return the encoder's angle [rad], shape (N,), and the target's motion per unit of it,
        shape (3, N) [m].
        """

    def _moves(self, sight: Sight) -> Sequence[np.ndarray]:
        angle, lever = self._read(sight)
        return [wave * lever for k in _ORDERS[: self.orders] for wave in waves(k * angle)]


@dataclass(frozen=True)
class InstrumentAzimuth(_Circle):
    r"""Azimuth encoder of a tracker, eccentric (k = 1) and elliptical (k = 2): reads
    :math:`s \sin kA + c \cos kA` more.

    Distinguished by:
        the same poses with the tracker at another position: its error depends on its own azimuth,
        the robot's errors on the robot's pose. From one position, the first joint's drive has a
        similar effect on a target that rotates with it.

    Source:
        Muralikrishnan et al. (2009), x6 and x9, the geometric error model of laser trackers.

    Attributes:
        orders: 1 for an eccentric encoder, 2 for one that is also elliptical.
    """

    name: ClassVar[str] = "instrument_azimuth"
    meaning: ClassVar[str] = (
        "the tracker's azimuth encoder is eccentric or elliptical: a sinusoidal error, "
        "once or twice per revolution"
    )
    locus: ClassVar[Locus] = Locus(acts_on="azimuth")

    def _read(self, sight: Sight) -> tuple[np.ndarray, np.ndarray]:
        return sight.azimuth, sight.range * np.cos(sight.elevation) * sight.level


@dataclass(frozen=True)
class InstrumentElevation(_Circle):
    r"""Elevation encoder of a tracker, eccentric (k = 1) and elliptical (k = 2): reads
    :math:`s \sin kE + c \cos kE` more.

    Distinguished by:
        the same poses with the tracker at another position, nearer or farther, higher or lower: its
        error depends on its own elevation, the robot's errors on the robot's pose.

    Source:
        Muralikrishnan et al. (2009), x7 and x9, the geometric error model of laser trackers.

    Attributes:
        orders: 1 for an eccentric encoder, 2 for one that is also elliptical.
    """

    name: ClassVar[str] = "instrument_elevation"
    meaning: ClassVar[str] = (
        "the tracker's elevation encoder is eccentric or elliptical: a sinusoidal error, "
        "once or twice per revolution"
    )
    locus: ClassVar[Locus] = Locus(acts_on="elevation")

    def _read(self, sight: Sight) -> tuple[np.ndarray, np.ndarray]:
        return sight.elevation, sight.range * sight.up


@dataclass(frozen=True)
class InstrumentTilt(_Reading):
    r"""Axes of a tracker that are not perpendicular or do not intersect.

    The transit axis deviates from perpendicular to the standing axis by t, the beam from
    perpendicular to the transit axis by c, and the zero of the elevation is off by i:
    :math:`\Delta A = t \tan E + c / \cos E`, :math:`\Delta E = i`. With offsets, the transit axis
    misses the standing axis by f, and the beam misses their intersection by l (to the left) and u
    (upwards). The standing axis's own orientation is absorbed by the base frame. Two-face readings
    are free of t, c, i, l, u.

    Distinguished by:
        two-face measurements of the same target. From another position of the tracker the robot's
        poses have other elevations, while the robot's errors are the same.

    Source:
        Muralikrishnan et al. (2009), x1, x2, x4, x5, the geometric error model of laser trackers.

    Attributes:
        offsets: whether the axes also fail to intersect.
    """

    offsets: bool = False
    name: ClassVar[str] = "instrument_tilt"
    meaning: ClassVar[str] = "the tracker's axes are not perpendicular or do not intersect"
    locus: ClassVar[Locus] = Locus(acts_on="axes")

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        """Yield it once: angles alone, and angles with offsets."""
        yield Candidate(cls(), variants=(cls(), cls(offsets=True)), obstacle=_obstacle(situation))

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Angles t, c, i [rad], and offsets f, l, u [m]."""
        angles = parameters_of(
            self, "instrument", ("transit_tilt", "beam_tilt", "index"), unit="rad", size=TILT
        )
        ways = ("transit_offset", "beam_left", "beam_up") if self.offsets else ()
        return angles + parameters_of(self, "instrument", ways, unit="m", size=TILT)

    def _moves(self, sight: Sight) -> Sequence[np.ndarray]:
        r = sight.range
        sine = np.sin(sight.elevation)
        cosine = np.cos(sight.elevation)
        moves = [r * sine * sight.level, r * sight.level, r * sight.up]
        # Horizontally outwards, at any elevation.
        return (
            [*moves, cosine * sight.along - sine * sight.up, sight.level, sight.up]
            if self.offsets
            else moves
        )


@dataclass(frozen=True)
class InstrumentRange(_Reading):
    """Zero offset of a tracker's distance meter, added to every range; its scale error is
    ``measurement_scale``.

    Distinguished by:
        measuring the same target from both ends of a line and from between them; or poses near the
        tracker and far from it, as from a second position.

    Source:
        Muralikrishnan et al. (2009), x8 ("bird bath"); R0 of ISO 10360-10.
    """

    name: ClassVar[str] = "instrument_range"
    meaning: ClassVar[str] = "the tracker's distance meter has a zero offset"
    locus: ClassVar[Locus] = Locus(acts_on="range")

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        yield Candidate(cls(), obstacle=_obstacle(situation))

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """The zero [m]."""
        return parameters_of(self, "instrument", ("range_zero",), unit="m", size=TILT)

    def _moves(self, sight: Sight) -> Sequence[np.ndarray]:
        return (sight.along,)


@dataclass(frozen=True)
class InstrumentStretch(_Reading):
    r"""Instrument whose coordinates are stretched: it reads lengths in one direction longer than in
    another.

    :math:`\Delta p = E p`, with E symmetric: the stretches of lengths along x and y relative to z,
      and the shears xy, xz and
    yz. An equal stretch in all directions is ``measurement_scale``.

    Distinguished by:
        a length standard in several directions, or the same poses with the instrument rotated: the
        directions rotate with the instrument, but not the robot's errors.

    Source:
        affine distortion of reconstructions by cameras with wrong parameters (Hartley and
        Zisserman, 2004); 1 to 3 in a thousand on a real camera tracker.
    """

    name: ClassVar[str] = "instrument_stretch"
    meaning: ClassVar[str] = "the instrument's scale differs between directions"
    locus: ClassVar[Locus] = Locus(acts_on="directions")
    # It is constant: as a new effect, it would hide a change of the robot.
    is_constant: ClassVar[bool] = True

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        unread = (
            "no positions in an instrument frame" if situation.conditions.sighted is None else ""
        )
        yield Candidate(cls(), obstacle=unread)

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Stretches of x and y beyond that of z, and shears [1]."""
        return parameters_of(
            self, "instrument", [f"stretch_{axes}" for axes in _STRETCHED], unit="1", size=RATIO
        )

    def _moves(self, sight: Sight) -> Sequence[np.ndarray]:
        p = sight.range * sight.along
        unit = np.eye(3)
        pairs = (["xyz".index(axis) for axis in (axes[0], axes[-1])] for axes in _STRETCHED)
        return [np.outer(unit[i], p[j]) + (i != j) * np.outer(unit[j], p[i]) for i, j in pairs]


def _obstacle(situation: PoseSet) -> str:
    """Return why readings can't be tested for a tracker's errors, empty if they can."""
    chain = situation.chain
    conditions = situation.conditions
    if conditions.sighted is None:
        return "no positions in an instrument frame"
    tips = Model(chain, ()).predict(np.zeros(0), conditions)[:, :, 3]
    base = np.median(conditions.sighted - tips, axis=0)
    away = np.linalg.norm(base)
    reach = np.median(np.linalg.norm(conditions.sighted - base, axis=1))
    # No tracker can stand amid the poses: the frame of the readings is the robot's or the cell's.
    if away >= reach:
        return ""
    return (
        f"the frame of the readings has its origin {away:.2g} m from the robot's base, where no "
        "tracker can be: give them in the tracker's own frame"
    )
