"""What the user says of a table beside its header."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class TableOptions:
    """How a table is to be read.

    Attributes:
        ignore: columns to leave out; ``"*"`` leaves out all that are unknown.
        columns: names of columns in the table and what they hold, with a unit if the header lacks one: ``{"J1":
            "joint_a1 [deg]"}``.
        orientation: convention of the orientation's columns, one of
            :data:`pincal.measure.orientation.CONVENTIONS`; default: as the header says.
        joints: a file of its own with the joint positions, see :mod:`pincal.measure.joined`.
        rows_in_order: whether rows stand in the order in which they were measured, or of their times, which says from
            which side joints arrived that have no column for it, see :mod:`pincal.measure.approach`.
        shares_log: whether other tables have theirs from the same file, so that the order of its rows tells nothing.
    """

    ignore: tuple[str, ...] = ()
    columns: Mapping[str, str] = field(default_factory=dict)
    orientation: str | None = None
    joints: str | os.PathLike[str] | None = None
    rows_in_order: bool = False
    shares_log: bool = False
