"""Variables recorded with each pose in addition to joints and readings: tables, models and reports
use these entries.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, Protocol, get_type_hints

import numpy as np
from numpy.typing import ArrayLike

from pincal.errors import BadInputError
from pincal.units import real_array

_IN_ORDER = "if rows are in the order of measurement, give --rows-in-order"
_IN_MOTION = "a session in motion has its joints as a stream"


@dataclass(frozen=True)
class Variable:
    """A variable that can be recorded with each pose.

    Attributes:
        quantity: physical quantity, see :data:`pincal.units.UNITS`.
        unit: in the library; empty for a plain number.
        column: its column in a table: its name, or ``name_<joint>``, unless the reader derives it
            from other columns.
        of_joints: whether each joint has one.
        instead: another source of it, in words.
        unknown: the value for poses where it is unknown; None if there is no such value.
        has_own_zero: whether each set-up of instrument and target has its own zero.
        label: description in words, with the joint as ``{}``; default: its name.
        shown: unit in plots, if different.
        typical: value at poses that are not measured yet, as of a plan.
        is_of_pose: whether it belongs to each pose; otherwise it describes the day, and rows that
            lack it may be taken at its mean over other rows.
        least, most: the range of what it can be of any robot.
    """

    quantity: str
    unit: str
    column: str
    of_joints: bool = False
    instead: str = ""
    unknown: float | None = None
    has_own_zero: bool = False
    label: str = ""
    shown: str = ""
    typical: float = 0.0
    is_of_pose: bool = False
    least: float = -np.inf
    most: float = np.inf

    def is_possible(self, values: np.ndarray) -> np.ndarray:
        """Return which values are finite and those of a robot."""
        return np.asarray(np.isfinite(values) & (self.least <= values) & (values <= self.most))

    @property
    def expected(self) -> str:
        """Which values these are, in words."""
        if np.isinf(self.least):
            return "a finite number"
        return f"{self.least:g} to {self.most:g} {self.unit}"

    def checked(self, value: ArrayLike) -> np.ndarray:
        """Return values of a caller as an array of floats.

        Raises:
            BadInputError: if they are no numbers, not finite, or none of a robot.
        """
        try:
            found = real_array(value, self.column)
        except (TypeError, ValueError):
            found = np.array(np.nan)
        if not self.is_possible(found).all():
            raise BadInputError(f"{self.column}: {value!s} {self.unit}; expected {self.expected}")
        return found


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """Recorded variables of N poses; None if not recorded."""

    approach: Annotated[
        np.ndarray | None,
        Variable(
            "number",
            "",
            "approach_<joint>",
            True,
            _IN_ORDER,
            unknown=0.0,
            label="direction of approach of {}",
            is_of_pose=True,
        ),
    ] = None
    """Direction from which each joint arrived: -1, 0 (unknown) or 1, shape (N, n)."""
    temperature: Annotated[
        np.ndarray | None,
        # A motor may be at 120 deg C; room temperature in K without a unit is not.
        Variable("temperature", "deg C", "temperature", typical=20.0, least=-100.0, most=200.0),
    ] = None
    """Temperature [deg C], shape (N,)."""
    time: Annotated[
        np.ndarray | None, Variable("time", "s", "time", has_own_zero=True, shown="h")
    ] = None
    """Time [s], shape (N,)."""
    droop: Annotated[
        np.ndarray | None,
        Variable(
            "angle",
            "rad",
            "commanded_<joint>",
            True,
            label="commanded minus read back of {}",
            shown="mrad",
            is_of_pose=True,
        ),
    ] = None
    """Commanded minus read-back position of each joint [rad], prismatic [m], shape (N, n)."""
    move: Annotated[
        np.ndarray | None,
        Variable(
            "number",
            "rad",
            "time",
            True,
            _IN_ORDER,
            unknown=0.0,
            label="last move of {}",
            shown="deg",
        ),
    ] = None
    """Last move of each joint with its sign [rad], prismatic [m], 0 where it is not known, shape
    (N, n).
    """
    velocity: Annotated[
        np.ndarray | None,
        Variable(
            "angular rate",
            "rad/s",
            "time",
            True,
            _IN_MOTION,
            unknown=0.0,
            label="speed of {}",
            shown="deg/s",
            is_of_pose=True,
        ),
    ] = None
    """Velocity of each joint [rad/s], prismatic [m/s], shape (N, n); None where poses were held."""

    def recorded(self) -> dict[str, np.ndarray | None]:
        """Return all variables by name."""
        return {name: getattr(self, name) for name in RECORDED}


class ArmCourse(Protocol):
    """The course of an arm in motion from which rows of a table were taken."""

    def with_clock(
        self, table: Any, clock: tuple[float, float, float], steps: Sequence[tuple[float, float]]
    ) -> Any:
        """Return a table of its rows, with the joints where they were by another clock of the
        instrument: ``clock`` and ``steps`` are those of :class:`Moving`.

        Rows too near a step to be of either side are left out.
        """
        ...


@dataclass(frozen=True, eq=False)
class Moving:
    """Motion of an arm about the times of N poses, as far as readings depend on it.

    Attributes:
        inertial: shape (N, n, 6), inertial loads on the joints, as in ``pincal.Conditions``; None
            for none.
        q: shape (N, K, n), joint positions at K moments about each time [rad or m]; None where
            readings are instantaneous.
        velocity: shape (N, K, n), velocities there.
        loads: shape (N, K, n, 6), inertial loads there; None for none.
        clock: offset added to the instrument's stamps [s], their drift [1], and the stamp about
            which they drift [s].
        delay: time by which an IMU's stamps of rates were assumed to be too early [s].
        scatter: noise of an IMU's forces [m/s^2] and rates [rad/s] by their scatter within the
            windows of rows.
        steps: of the instrument's clock, the stamp of the first reading after each and the time
            added to the stamps from there on [s].
        course: from which the rows were taken; None where it is not known.
    """

    inertial: np.ndarray | None = None
    q: np.ndarray | None = None
    velocity: np.ndarray | None = None
    loads: np.ndarray | None = None
    clock: tuple[float, float, float] = (0.0, 0.0, 0.0)
    delay: float = 0.0
    scatter: tuple[float, ...] = ()
    steps: tuple[tuple[float, float], ...] = ()
    course: ArmCourse | None = None

    @property
    def middle(self) -> float:
        """Stamp about which the clock drifts [s]."""
        return self.clock[2]

    @property
    def _arrays(self) -> tuple[np.ndarray | None, ...]:
        return self.inertial, self.q, self.velocity, self.loads

    def __getitem__(self, rows: slice | np.ndarray) -> Moving:
        inertial, q, velocity, loads = (
            None if array is None else array[rows] for array in self._arrays
        )
        return replace(self, inertial=inertial, q=q, velocity=velocity, loads=loads)

    def of_joints(self, order: Sequence[int]) -> Moving:
        """Return the motion with its joints in another order, given by their indices."""
        return replace(
            self,
            course=None,
            inertial=None if self.inertial is None else self.inertial[:, order],
            q=None if self.q is None else self.q[:, :, order],
            velocity=None if self.velocity is None else self.velocity[:, :, order],
            loads=None if self.loads is None else self.loads[:, :, order],
        )

    def joined(self, others: Sequence[Moving]) -> Moving:
        """Return this motion concatenated with others of the same session."""
        parts = zip(*(each._arrays for each in (self, *others)), strict=True)
        course = self.course if all(other.course is self.course for other in others) else None
        inertial, q, velocity, loads = (
            None if part[0] is None else np.concatenate(part) for part in parts
        )
        return replace(self, inertial=inertial, q=q, velocity=velocity, loads=loads, course=course)


_HINTS = get_type_hints(Recorded, include_extras=True)
RECORDED: Mapping[str, Variable] = {
    each.name: _HINTS[each.name].__metadata__[0] for each in fields(Recorded)
}
"""All variables of a table by name."""
RECORDABLE = {
    "approach": RECORDED["approach"],
    # The largest robots carry 2300 kg.
    "payload": Variable("mass", "kg", "payload", least=0.0, most=1e4),
    **RECORDED,
}
"""All variables on which an effect may depend in addition to joint positions and moments, including
a payload of 0.
"""
OF_THE_DAY = tuple(name for name, variable in RECORDED.items() if not variable.is_of_pose)
"""Names of those that describe the day, not the pose."""
SURROUNDINGS = tuple(name for name in OF_THE_DAY if not RECORDED[name].of_joints)
"""Names of those on which the whole arm may depend without any change of it."""


def typical_columns(names: Iterable[str], q: np.ndarray) -> dict[str, np.ndarray]:
    """Return columns of recorded variables at N poses that are not measured yet.

    Args:
        names: of variables among ``RECORDED``.
        q: joint positions of the poses, shape (N, n) [rad or m].

    Returns:
        By name, shape (N, n) of variables of joints and (N,) of others.
    """
    return {
        name: np.full(q.shape if RECORDED[name].of_joints else len(q), RECORDED[name].typical)
        for name in names
    }
