"""What may happen in a cell while rows are measured, as hypotheses with their words and motions.

Each :class:`Event` moves the targets in directions of its own, so that rows tell it from others:
uniformly for an instrument that was touched, along its lever for a joint with another zero. A new
one is an entry in :data:`BETWEEN_ROWS` or :data:`BETWEEN_VISITS`, with which
:mod:`pincal.validate.midway` and :mod:`pincal.validate.visits` look for it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pincal.identify.motion_fields import (
    MotionField,
    field_of_load,
    fields_of_joints,
    fields_of_setup,
)
from pincal.identify.station import Station


@dataclass(frozen=True, eq=False)
class CellMotions:
    """The motions of the targets by each thing in a cell, computed once.

    Attributes:
        station: the calibrated model over n rows.
        values: shape (P,), of its parameters.
    """

    station: Station
    values: np.ndarray

    @cached_property
    def _setup(self) -> tuple[MotionField, ...]:
        return tuple(fields_of_setup(self.station, self.values))

    @cached_property
    def joints(self) -> tuple[MotionField, ...]:
        """By each joint that moves them."""
        return tuple(fields_of_joints(self.station, self.values))

    def of_setup(self, name: str) -> Iterator[MotionField]:
        """Yield those by the instrument, the tool, or growth."""
        return (field for field in self._setup if field.name == name)

    def of_load(self) -> Iterator[MotionField]:
        """Yield that by another payload."""
        yield field_of_load(self.station, self.values)


@dataclass(frozen=True)
class Event:
    """Something that may happen to a cell between two rows, or in the course of them.

    In its words, ``{name}`` is the name of the cause, and ``{size}`` how far it displaces the
    targets, or the joint, with its unit.

    Attributes:
        name: of its motion fields; empty for a joint, whose fields have the joint's name.
        fields: yields how it moves the targets, with more freedom in each further field.
        step: what it is like if it happens at once; empty if it can't.
        drift: what it is like if it goes on and on.
        visits: how visits of a pose differ by it.
        column: a column of the table that would tell why.
        like: name of an event that does nearly the same, beside which this one is not named.
    """

    name: str
    fields: Callable[[CellMotions], Iterable[MotionField]]
    step: str
    drift: str
    visits: str
    column: str
    like: str = ""


INSTRUMENT = Event(
    "instrument",
    lambda cell: cell.of_setup("instrument"),
    step="readings are shifted by {size}: was the instrument or the robot's base touched?",
    drift="as if the instrument or the robot's base moved",
    visits="all in one direction",
    column="station",
)
TOOL = Event(
    "tool",
    lambda cell: cell.of_setup("tool"),
    step="the target is displaced by {size} on the tool: was it touched, or the tool exchanged?",
    drift="as if the target moved on the tool",
    visits="all in one direction of the tool",
    column="target",
)
JOINT = Event(
    "",
    lambda cell: cell.joints,
    step="{name} is off by {size}: was it remastered?",
    drift="{name} drifts",
    visits="along {name}",
    column="approach_{name}",
)
LOAD = Event(
    "load",
    CellMotions.of_load,
    step="the arm is bent by {size} as by another load: was a payload changed?",
    drift="as if the arm sagged more and more",
    visits="as a load bends the arm",
    column="payload",
)
# Growth about a point that is far away is a motion of the instrument.
THERMAL_GROWTH = Event(
    "growth",
    lambda cell: cell.of_setup("growth"),
    step="",
    drift="as of an arm or an instrument that warms up",
    visits="growing from a point, as with temperature",
    column="temperature",
    like="instrument",
)
BETWEEN_ROWS: tuple[Event, ...] = (INSTRUMENT, TOOL, JOINT)
"""What may happen at once between two rows of a table in which poses differ from row to row."""

BETWEEN_VISITS: tuple[Event, ...] = (INSTRUMENT, TOOL, JOINT, LOAD, THERMAL_GROWTH)
"""What may happen between visits of the same poses, whose difference needs no model."""


def event_of(name: str) -> Event:
    """Return the event of a motion field, by its name."""
    every = dict.fromkeys((*BETWEEN_ROWS, *BETWEEN_VISITS))
    return next((event for event in every if event.name == name), JOINT)


@dataclass(frozen=True)
class StepCause:
    """A possible event between two rows.

    Attributes:
        name: "instrument", "tool", "load", or the joint's.
        size: displacement of readings or target [m], or of the joint [rad, or m if prismatic].
        unit: of the size: "m" or "rad".
    """

    name: str
    size: float
    unit: str

    def __str__(self) -> str:
        shown = f"{1e3 * self.size:.3g} m{self.unit}"
        return event_of(self.name).step.format(name=self.name, size=shown)


def without_like(causes: dict[str, StepCause]) -> tuple[StepCause, ...]:
    """Return causes, by name, without those that do nearly the same as another one of them."""
    return tuple(cause for name, cause in causes.items() if event_of(name).like not in causes)
