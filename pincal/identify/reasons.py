"""Why a parameter is not identified: the cause with its figures, and the one place where they become words."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, StrEnum

from pincal.units import format_readable


class Status(StrEnum):
    """What became of a parameter; the values are those of ``result.json``."""

    IDENTIFIED = "identified"
    PRIOR = "prior"
    FIXED = "fixed"
    UNIDENTIFIABLE = "unidentifiable"
    AT_BOUND = "at bound"


class Cause(Enum):
    """Why a parameter is not identified; the values are how it is said, with the figures of a reason in braces."""

    NONE = ""
    GIVEN = "given by the user"
    NOT_NEEDED = "fixed at zero: most lenses need no higher terms"
    AT_BOUND = "stopped at its bound of {size}"
    ABSORBS = "±{size} if the parameters it absorbs are held at their estimates"
    NO_MOMENT = "no static moment about this axis in any pose (axis {axis} parallel to gravity, or no mass beyond it)"
    NOT_EXCITED = "not excited by any of these poses"
    NOT_OBSERVED = "has no influence on the measured target"
    BASE = "the unknown base frame absorbs it"
    TOOL = "the unknown tool frame{beside} absorb{s} it"
    FRAMES = "the unknown base and tool frames{beside} absorb it"
    PARALLEL_AXES = "only {combination} is identifiable (the axes are parallel)"
    COMBINATION = "only {combination} is identifiable"
    ALIASED = "indistinguishable from {aliases}{together}"
    HIDDEN = "indistinguishable from a combination of many other parameters"
    MASS = "only its product with the compliances is identifiable; the shape of the arm sets the factor"
    WEAK = "the data narrow the prior of ±{size} only to ±{narrowed}"
    UNINFORMED = "the data add nothing to the prior of ±{size}"


@dataclass(frozen=True)
class Combination:
    """A sum ``other + factor * own`` that the data identify where they do not identify its members."""

    other: str
    factor: float
    own: str

    def __str__(self) -> str:
        size = abs(self.factor)
        times = "" if abs(size - 1.0) < _ONE else f"{size:.3g} x "
        return f"{self.other} {'+' if self.factor > 0 else '-'} {times}{self.own}"


# Relative difference from 1 that three digits of a factor do not show.
_ONE = 1e-3


@dataclass(frozen=True)
class Reason:
    """Why a parameter is not identified, as data; ``str()`` gives it in words.

    Attributes:
        cause: the kind of reason.
        parameters: the others that have the same effect, largest part of it first or as they stand in the model.
        combination: the sum that is identifiable instead.
        size: bound, prior standard deviation, or conditional standard deviation of a frame's coordinate [``unit``].
        narrowed: posterior standard deviation [``unit``].
        unit: SI unit of the parameter.
        axis: letter of the axis that a compliance is about; empty for anything else.
        moment: largest static moment about that axis in these poses [N m].
        beside: what else is unknown along with the tool frame, such as "the unknown points".
    """

    cause: Cause
    parameters: tuple[str, ...] = ()
    combination: Combination | None = None
    size: float | None = None
    narrowed: float | None = None
    unit: str = ""
    axis: str = ""
    moment: float | None = None
    beside: str = ""

    def __str__(self) -> str:
        words = self.cause.value.format(
            aliases=_listed(self.parameters),
            combination=self.combination,
            size="" if self.size is None else format_readable(self.size, self.unit),
            narrowed="" if self.narrowed is None else format_readable(self.narrowed, self.unit),
            axis=self.axis,
            together=" together" if len(self.parameters) > 1 else "",
            beside=f" and {self.beside}" if self.beside else "",
            s="" if self.beside else "s",
        )
        return words if self.moment is None else f"{words} (static moment about this axis: at most {self.moment:.2g} N m)"


def _listed(names: tuple[str, ...]) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}" if len(names) > 1 else "".join(names)


IDENTIFIED = Reason(Cause.NONE)
"""The reason of a parameter that needs none."""
