"""Quantities that tables can hold, each in one column or several, and the options for
reading them.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from pincal.errors import MeasurementError
from pincal.recorded import RECORDABLE
from pincal.robot.robot import Robot
from pincal.units import SMALLEST


@dataclass(frozen=True)
class Rule:
    """Which values are valid."""

    expected: str
    """The valid values in words, for messages."""
    is_met: Callable[[np.ndarray], np.ndarray]
    """Returns which values of an array, shape (N,) or (N, k), are valid, in the same
    shape or (N,).
    """


FINITE = Rule("a finite number", np.isfinite)
POSITIVE = Rule(
    f"a number > 0, at least {SMALLEST:g}", lambda value: np.isfinite(value) & (value >= SMALLEST)
)
NOT_NEGATIVE = Rule(
    f"0 or a number > 0, at least {SMALLEST:g}",
    lambda value: np.isfinite(value) & ((value == 0.0) | (value >= SMALLEST)),
)
SIGN = Rule("-1, 0 or 1", lambda value: np.isin(value, (-1, 0, 1)))


@dataclass(frozen=True)
class Field:
    """One quantity of a table, in one column or several.

    Attributes:
        name: of the array that holds it.
        columns: their names without units, in the order of the components.
        quantity: physical quantity, which determines the possible units: "length", "angle",
            "pixel", "noise", "mass", "time", "temperature", "number" or "name".
        rule: which values are valid; names always are.
        is_unit: whether the components form a unit vector, to be normalised.
        mistakes: how its columns get mixed up: in words, and a function that returns the right
            values.
        mirror: returns the values in the frame with y reversed; None where that is undefined.
    """

    name: str
    columns: tuple[str, ...]
    quantity: str
    rule: Rule = FINITE
    is_unit: bool = False
    mistakes: tuple[tuple[str, Callable[[np.ndarray], np.ndarray]], ...] = ()
    mirror: Callable[[np.ndarray], np.ndarray] | None = None

    @property
    def is_name(self) -> bool:
        """Whether the values are names, not numbers."""
        return self.quantity == "name"

    def __str__(self) -> str:
        return " ".join(self.columns)


POINT = Field("point", ("point",), "name")
_RECORDED = {
    name: variable.quantity for name, variable in RECORDABLE.items() if not variable.of_joints
}
CONDITIONS = {"point": POINT} | {
    name: Field(name, (name,), quantity)
    for name, quantity in (
        {"target": "name"} | _RECORDED | {"stop": "name", "station": "name"}
    ).items()
}
CONDITIONS |= {f"{end}_link": Field(f"{end}_link", (end,), "name") for end in ("from", "to")}
"""Conditions of a pose that a table can contain in addition to the readings."""

FIRST, SECOND = (Field(name, (name,), "name") for name in ("first", "second"))
"""The points of a contact, each ``LINK:NAME``."""

SIGMA = Field("sigma", ("sigma",), "noise", POSITIVE)
"""The standard deviation of a row's reading."""
TABLE_ENDINGS = (".csv", ".tsv", ".txt", ".parquet")
"""Endings of the names of tables that can be written."""


def link_of(point: str, *, where: str) -> str:
    """Return the link of a point; refuse a name that is not LINK:NAME."""
    link, _, name = point.rpartition(":")
    if not link.strip() or not name.strip():
        raise MeasurementError(f"{where}: point {point!r}; expected LINK:NAME, such as tool0:ball")
    return link.strip()


@dataclass(frozen=True, kw_only=True)
class TableOptions:
    """Options for reading a table.

    Attributes:
        ignore: columns to leave out; ``"*"`` leaves out all unknown ones.
        columns: meanings of columns by their names in the table, with a unit if the header lacks
            one: ``{"J1": "joint_a1 [deg]"}``.
        orientation: convention of the orientation, one of
            :data:`pincal.measure.orientation.CONVENTIONS`, or "none" to leave it out; default: as
            in the header.
        joints: a separate file with the joint positions, whose rows are matched by a common column,
            by time while the pose is held still, or by order; a `PincalWarning` states which.
        sheet: worksheet of a workbook; default: the first with joint columns.
        rows_in_order: whether rows are in the order of measurement, or of their times, which gives
            the direction of approach of joints without a column for it, see
            :mod:`pincal.measure.approach`.
        shares_log: whether several tables take their joints from the same file, so that its order
            has no meaning.
    """

    ignore: Sequence[str] = ()
    columns: Mapping[str, str] = field(default_factory=dict)
    orientation: str | None = None
    joints: str | os.PathLike[str] | None = None
    sheet: str | None = None
    rows_in_order: bool = False
    shares_log: bool = False


# Second positions of joints, and the factor on these minus the fitted ones that gives commanded
# minus read back.
OTHERS = {"commanded": 1.0, "read": -1.0}
# Variables with a column for each joint.
OF_EACH_JOINT = tuple(
    name for name, variable in RECORDABLE.items() if variable.column == f"{name}_<joint>"
)


@dataclass(frozen=True)
class Schema:
    """The possible contents of a table.

    Attributes:
        fields: the known quantities.
        joint_names: the joints, each with its column and optionally columns for the direction of
            approach and for the commanded or read-back position.
        joint_types: "revolute" or "prismatic" for each joint, which determines its possible units;
            all revolute if empty.
        own_joints: the independent joints; all if empty. The others may be absent.
        following: returns positions, shape (N, n), with the dependent joints set by the independent
            ones.
        resting: joints that may be absent, with their rest positions [rad or m].
        may_lack_joints: whether a table without any joint is allowed.
        is_stream: whether it is a log of a moving arm: columns may have the names that loggers use,
            unneeded ones and rows with an empty cell are left out.
        options: how to read it.
    """

    fields: tuple[Field, ...]
    joint_names: tuple[str, ...] = ()
    joint_types: tuple[str, ...] = ()
    own_joints: tuple[str, ...] = ()
    following: Callable[[np.ndarray], np.ndarray] = np.copy
    resting: Mapping[str, float] = field(default_factory=dict)
    may_lack_joints: bool = False
    is_stream: bool = False
    options: TableOptions = field(default_factory=TableOptions)

    def __post_init__(self) -> None:
        if not self.own_joints:
            object.__setattr__(self, "own_joints", self.joint_names)

    def of_robot(self, robot: Robot) -> Schema:
        """Return the schema with the joints of a robot."""
        return replace(
            self,
            joint_names=robot.joint_names,
            joint_types=robot.joint_types,
            own_joints=tuple(robot.joint_names[i] for i in robot.own_joints),
            following=robot.following,
        )

    @property
    def needed_joints(self) -> tuple[str, ...]:
        """The joints whose columns are needed."""
        return tuple(name for name in self.own_joints if name not in self.resting)

    def quantities(self, *, source: str) -> dict[str, str]:
        """Return the physical quantity of each possible column; refuse joints that have the name of
        a field.
        """
        known = {column: field.quantity for field in self.fields for column in field.columns}
        if clash := [name for name in self.joint_names if name in known]:
            raise MeasurementError(
                f'{source}: joint "{clash[0]}" has the name of a column; rename it in the URDF'
            )
        types = self.joint_types or ("revolute",) * len(self.joint_names)
        pairs = zip(self.joint_names, types, strict=True)
        joints = {name: "length" if kind == "prismatic" else "angle" for name, kind in pairs}
        # In addition to the fitted positions: commanded ones where these were read back, or vice
        # versa.
        own = {
            f"{what}_{name}": RECORDABLE[what].quantity for what in OF_EACH_JOINT for name in joints
        }
        others = {
            f"{kind}_{name}": quantity for kind in OTHERS for name, quantity in joints.items()
        }
        return joints | known | own | others


class TableRows(Protocol):
    """The interface of a table of N rows for sensors;
    :class:`pincal.measure.measurements.Measurements` implements it.
    """

    @property
    def source(self) -> str:
        """Name of the file, for messages."""

    @property
    def q(self) -> np.ndarray:
        """Joint positions [rad], prismatic [m], shape (N, n)."""

    @property
    def rows(self) -> np.ndarray:
        """Line of each row in its file, shape (N,)."""

    @property
    def units(self) -> Mapping[str, str]:
        """The units in the header, by column."""

    @property
    def point_names(self) -> np.ndarray | None:
        """Name of each row's fixed point, shape (N,); None where rows involve none."""

    def array(self, name: str) -> np.ndarray:
        """Return the values of a field of the table, shape (N,) or (N, k)."""


def __getattr__(name: str) -> Any:
    if name == "Table":
        warnings.warn(
            "pincal.measure.fields.Table is now TableRows", DeprecationWarning, stacklevel=2
        )
        return TableRows
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
