"""Unnamed terms: joint errors without a known physical cause."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import ClassVar, Literal

import numpy as np

from pincal.errors import BadInputError
from pincal.model.basis import FEWEST_SPLINES, spline_basis
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions, PoseSet, distinct_values, moves, recorded_variable
from pincal.model.effect import Family, Locus, Smoothable, Term
from pincal.model.effect_bases import drive_unit, joint_index, tilt_terms, waves
from pincal.model.effect_numbers import FIELD, ORIGIN, SHOWN
from pincal.model.smooth_field import SmoothField
from pincal.parameters import Parameter
from pincal.thresholds import Count, Scale

FormName = Literal["curve", "waves", "product", "map", "field", "step", "kink"]
ActsOn = Literal["drive", "gamma_x", "gamma_y", "gamma_z", "s_x", "s_y", "a"]

# Typical size of an unnamed term [rad or m].
_SIZE: Scale = 3e-4
# Pieces of a curve; of a map, along each joint, from coarse to fine.
_PIECES: Count = 8
_MAP_PIECES: tuple[Count, ...] = (4, 5, 6, 8, 10, 12)
# Orders (cycles per revolution) that are tried.
_ORDERS: tuple[Count, ...] = (1, 2, 3)
# Breakpoints that are tried, as quantiles of the rows.
_PLACES = np.linspace(0.08, 0.92, 22)
_ACROSS: tuple[ActsOn, ...] = ("gamma_x", "gamma_y")
_BEFORE: tuple[ActsOn, ...] = ("s_x", "s_y")
_DRIVE: tuple[ActsOn, ...] = ("drive",)
# How a guide is crooked in addition to tilts: by its roll, and by its straightness along x.
_OF_GUIDE: tuple[ActsOn, ...] = ("gamma_z", "a")
# Shapes that are functions over the ranges of two joints.
_OVER_BOTH: tuple[FormName, ...] = ("map", "field")


@dataclass(frozen=True)
class Unnamed(Smoothable):
    """A joint error that depends on one variable, or on two joints' positions, without a cause in
    the catalogue.

    Distinguished by:
        measurements that vary its variable and hold the others fixed: see the sections of the named
        effects. An effect that the catalogue lacks can be added as one class.

    Source:
        splines after de Boor (1978); a field after Solin and Särkkä (2020),
        :mod:`pincal.model.smooth_field`.

    Attributes:
        joint: where it acts.
        acts_on: "drive" (about the joint's own axis), "gamma_x" or "gamma_y" (across it, after the
            joint), "s_x" or "s_y" (across it, before the joint); of a prismatic joint also
            "gamma_z" (roll of the carriage about its motion) or "a" (displacement across it).
        depends_on: name of a joint, for its position, or "time", "temperature", "payload", or
            "move", the joint's last move.
        shape: "curve" (a cubic spline), "waves" (sine and cosine of ``order``), "product" (of sine
            or cosine of the joint's own angle and of the other's, times ``own_order`` and
            ``order``), "map" (products of cubic splines of both), "field" (a smooth function of
            both, alike over ``lengths``, of a standard deviation ``height``), "step" (at
            ``place``), or "kink" (a change of slope there).
        lower, upper: the measured range; outside it a curve keeps its end value.
        size: number of basis functions of a curve, and of a map along each joint.
        order: cycles per revolution; of a product default 1. Along a prismatic joint waves repeat
            every 2 pi / ``order`` metres.
        place: breakpoint [rad or m].
        own_lower, own_upper: the range of the joint's own position, of a map or a field.
        own_order: cycles per revolution of the joint itself, of a product; default: 1.
        lengths: of a field, along the joint's own position and the other's [rad or m].
        height: of a field, standard deviation of the error [rad or m].
        chosen_among: number of independent orders and joints among which these were selected.
        on_rail: whether ``depends_on`` is a prismatic joint.
    """

    joint: str
    acts_on: ActsOn
    depends_on: str
    shape: FormName = "curve"
    lower: float = -np.pi
    upper: float = np.pi
    size: int = 8
    order: float | None = None
    place: float | None = None
    own_lower: float = -np.pi
    own_upper: float = np.pi
    own_order: float | None = None
    lengths: tuple[float, float] | None = None
    height: float = _SIZE
    chosen_among: float = 1.0
    on_rail: bool = False
    name: ClassVar[str] = "unnamed"
    meaning: ClassVar[str] = "a significant effect that is not in the catalogue"
    family: ClassVar[Family] = Family.NAMELESS
    shares_scale: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self.shape == "waves" and self.order is None:
            raise BadInputError(f"{self.name} of {self.joint}: waves need an order")
        if self.shape in ("step", "kink") and self.place is None:
            raise BadInputError(f"{self.name} of {self.joint}: a {self.shape} needs a place")
        if self.shape == "field":
            self._check_field()

    def _check_field(self) -> None:
        """Refuse a field of no size, or finer than a computer holds."""
        if self.lengths is None or min(*self.lengths, self.height) <= 0:
            raise BadInputError(
                f"{self.name} of {self.joint}: lengths {self.lengths} and height {self.height:g} "
                "of a field; expected numbers above 0"
            )
        ranges = (self.own_upper - self.own_lower, self.upper - self.lower)
        least = [FIELD.shortest * span for span in ranges]
        if min(ranges) <= 0 or any(np.less(self.lengths, least)):
            raise BadInputError(
                f"{self.name} of {self.joint}: a field over ranges of {ranges[0]:g} and "
                f"{ranges[1]:g} with lengths {self.lengths[0]:g} and {self.lengths[1]:g}; expected "
                f"ranges above 0, and lengths of at least {FIELD.shortest:g} of them"
            )

    @property
    def locus(self) -> Locus:
        span = (self.lower, self.upper) if self.shape in ("curve", *_OVER_BOTH) else None
        return Locus(
            self.joint,
            self.acts_on,
            self.depends_on,
            self.order,
            shape=self.shape,
            place=self.place,
            span=span,
            own_order=self.own_order,
            own_span=self._own_span,
            on_rail=self.on_rail,
        )

    @property
    def _own_span(self) -> tuple[float, float] | None:
        """The range of the joint's own position, of a function over both."""
        return (self.own_lower, self.own_upper) if self.shape in _OVER_BOTH else None

    @property
    def trials(self) -> float:
        """Number of maps or fields, or of waves of two joints, among which it was selected."""
        if self.shape == "field":
            return ORIGIN.pairs * len(FIELD.lengths) ** 2 * len(FIELD.heights)
        return ORIGIN.pairs if self.shape == "map" else self.chosen_among

    @property
    def n_functions(self) -> int:
        """Number of basis functions."""
        return {
            "curve": self.size,
            "waves": 2,
            "product": 4,
            "map": self.size**2,
            "field": 0 if self.field is None else len(self.field.orders),
            "step": 1,
            "kink": 2,
        }[self.shape]

    def resolutions(self, situation: PoseSet) -> tuple[Unnamed, ...]:
        """Return a map from coarse to fine, as far as poses and positions support it; other shapes
        have no resolution.
        """
        if self.shape != "map":
            return ()
        pairs = (situation.positions(joint) for joint in (self.joint, self.depends_on))
        most = min(
            int((len(situation.conditions) // SHOWN.poses_per_piece) ** 0.5),
            *map(distinct_values, pairs),
        )
        return tuple(replace(self, size=size) for size in _MAP_PIECES if size <= most)

    @cached_property
    def field(self) -> SmoothField | None:
        """The smooth function of a field, by the joint's own position and the other's."""
        if self.lengths is None:
            return None
        ranges = (self.own_lower, self.own_upper), (self.lower, self.upper)
        return SmoothField(*ranges, self.lengths)

    def fields(self, situation: PoseSet) -> tuple[Unnamed, ...]:
        """Return the smooth functions of both positions of which an error of a drive that depends
        on another joint may be a part; none of others.
        """
        other = self.depends_on
        pair = self.joint in situation.moving and other in situation.moving
        if self.acts_on != "drive" or other == self.joint or not pair:
            return ()
        columns = situation.positions(self.joint), situation.positions(other)
        (first, last), (lower, upper) = ((float(at.min()), float(at.max())) for at in columns)
        over = Unnamed(
            self.joint,
            "drive",
            other,
            "field",
            lower,
            upper,
            own_lower=first,
            own_upper=last,
            lengths=(last - first, upper - lower),
        )
        return tuple(
            replace(over, lengths=(own * (last - first), of_other * (upper - lower)))
            for own, of_other in product(FIELD.lengths, repeat=2)
        )

    def of_height(self, height: float) -> Unnamed:
        """Return a field of another height."""
        return replace(self, height=height)

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Coefficients of the basis functions [rad; m along a prismatic one; slopes of a kink]."""
        orders = "x".join(f"{k:g}" for k in (self.own_order, self.order) if k is not None)
        shape = "" if self.shape == "curve" else f"_{self.shape}{orders}".replace(".", "_")
        stem = f"{self.joint}.{self.acts_on}_of_{self.depends_on}{shape}"
        unit = {"drive": drive_unit(chain, self.joint), "a": "m"}.get(self.acts_on, "rad")
        if self.shape == "kink" and self.depends_on == self.joint:
            unit = "1"
        return tuple(
            Parameter(f"{stem}_{i + 1}", unit, self.name, 0.0, size)
            for i, size in enumerate(self._sizes)
        )

    @property
    def _sizes(self) -> list[float]:
        """Typical sizes of the coefficients [rad or m]."""
        if self.field is None:
            return [_SIZE] * self.n_functions
        return [self.height * size for size in self.field.sizes.tolist()]

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        i = joint_index(chain, self.joint)
        x = recorded_variable(
            chain, conditions, self.depends_on, joint=self.joint, span=self.locus.span
        )
        own = recorded_variable(chain, conditions, self.joint, span=self._own_span)
        bases = enumerate(self._basis(x, own))
        if self.acts_on in _BEFORE:
            tilts = [(p, _BEFORE.index(self.acts_on), basis) for p, basis in bases]
            return tilt_terms(chain, conditions, self.joint, seen_from="before", tilts=tilts)
        k = chain.joint_or_drive(i, self.acts_on)
        return tuple(Term(p, k, basis) for p, basis in bases)

    def _basis(self, x: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the basis functions, shape (n_functions, N)."""
        if self.field is not None:
            return self.field.basis(own, x)
        if self.shape == "curve":
            return spline_basis(x, self.lower, self.upper, self.size)
        if self.shape == "product":
            of_own, of_other = (1.0 if k is None else k for k in (self.own_order, self.order))
            return np.stack([f * g for f in waves(of_own * own) for g in waves(of_other * x)])
        if self.order is not None:
            return np.stack(waves(self.order * x))
        if self.shape == "map":
            along = spline_basis(own, self.own_lower, self.own_upper, self.size)
            return np.stack(
                [f * g for f in along for g in spline_basis(x, self.lower, self.upper, self.size)]
            )
        beyond = x - (self.place or 0.0)
        return (
            (beyond > 0.0)[None].astype(float)
            if self.shape == "step"
            else np.stack([-np.minimum(beyond, 0.0), np.maximum(beyond, 0.0)])
        )


def nameless_candidates(
    chain: Chain, conditions: Conditions, joints: Sequence[str]
) -> Iterator[Unnamed]:
    """Return the unnamed terms of some joints, for each variable that changes.

    A smooth curve of the joint's own position is the catalogue's transmission error, and waves of
    order 1 and 2 are in the catalogue, too. Waves and products need fewer parameters than a curve.
    """
    names = chain.robot.joint_names
    kinds = zip(names, chain.robot.joint_types, strict=True)
    rails = {name for name, kind in kinds if kind == "prismatic"}
    does = moves(conditions.q)
    columns = {name: conditions.q[:, i] for i, name in enumerate(names) if does[i]}
    columns |= {
        n: c
        for n, c in (("time", conditions.time), ("temperature", conditions.temperature))
        if c is not None
    }
    for joint in joints:
        own_move = (
            {} if conditions.move is None else {"move": conditions.move[:, names.index(joint)]}
        )
        for source, column in (columns | own_move).items():
            if np.ptp(column) <= SHOWN.constant_column:
                continue
            lower = float(column.min())
            upper = float(column.max())
            own = source == joint
            of_guide = _OF_GUIDE if joint in rails else ()
            for acts_on in (*_ACROSS, *_BEFORE, *of_guide) if own else _DRIVE:
                yield Unnamed(joint, acts_on, source, lower=lower, upper=upper, size=_PIECES)
            if source in names:
                on_rail = source in rails
                yield from (
                    _of_one_joint(joint, column, on_rail=on_rail)
                    if own
                    else _of_two_joints(joint, source, on_rail=on_rail)
                )


def maps_of(situation: PoseSet, joint: str) -> Iterator[Unnamed]:
    """Yield the coarsest map of a joint's position and each other joint's."""
    if joint not in situation.moving:
        return
    own = situation.positions(joint)
    for other in situation.moving:
        x = situation.positions(other)
        if other == joint:
            continue
        (lower, upper), (first, last) = ((float(at.min()), float(at.max())) for at in (x, own))
        yield Unnamed(
            joint,
            "drive",
            other,
            "map",
            lower,
            upper,
            FEWEST_SPLINES,
            own_lower=first,
            own_upper=last,
        )


def wave_of_two(
    joint: str, other: str, orders: tuple[float, float], chosen_among: float
) -> Unnamed:
    """Return a wave of a joint's own position and another joint's, of orders selected among some;
    of the other's alone if the own order is 0.
    """
    own, order = orders
    if not own:
        return Unnamed(joint, "drive", other, "waves", order=order, chosen_among=chosen_among)
    return Unnamed(
        joint, "drive", other, "product", order=order, own_order=own, chosen_among=chosen_among
    )


def _of_two_joints(joint: str, source: str, *, on_rail: bool) -> Iterator[Unnamed]:
    for acts_on in (*_DRIVE, *_ACROSS):
        for order in _ORDERS:
            yield Unnamed(joint, acts_on, source, "waves", order=order, on_rail=on_rail)
    yield Unnamed(joint, "drive", source, "product", on_rail=on_rail)


def _of_one_joint(joint: str, column: np.ndarray, *, on_rail: bool) -> Iterator[Unnamed]:
    for acts_on in (*_DRIVE, *_ACROSS, *_BEFORE):
        yield Unnamed(joint, acts_on, joint, "waves", order=3, on_rail=on_rail)
    for place in np.quantile(column, _PLACES):
        yield Unnamed(joint, "drive", joint, "step", place=float(place))
        yield Unnamed(joint, "drive", joint, "kink", place=float(place))
