"""What a table may hold, and the options for reading it."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pincal.errors import MeasurementError
from pincal.recorded import RECORDABLE
from pincal.robot.robot import Robot
from pincal.sensors.fields import Field

TABLE_ENDINGS = (".csv", ".tsv", ".txt", ".parquet")
"""Endings of the names of tables that can be written."""


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
        is_whole: whether each row counts, so that an empty cell is refused.
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
    is_whole: bool = False
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
    def has_readings(self) -> bool:
        """Whether an instrument wrote the rows, pose by pose. Without joints it is a list of known
        points: 0 0 0 is the origin of the object, not a reading that is missing.
        """
        return bool(self.joint_names) and not self.may_lack_joints and not self.is_stream

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
