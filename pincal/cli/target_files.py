"""Targets in files that are no tables, such as programs of controllers, on the command line.

A satellite that corrects them hands in a subclass of :class:`TargetFiles`, with the options that
it needs.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pincal.errors import Exit

if TYPE_CHECKING:
    from pincal.calibration.fitted_robot import FittedRobot

PROGRAMS = "Programs of controllers"
"""The heading of their options."""


@dataclass(frozen=True, kw_only=True)
class FileCorrection:
    """How a file of targets is to be corrected.

    Attributes:
        path: the file.
        out: the file to write.
        seed: shape (n,), reported joint positions to start from; None for the middle of the ranges.
        keeps_limits: whether joints stay within their limits.
        max_change: motion of a joint from its start above which a point is left [rad or m].
        is_strict: whether to fail if any point is left.
        as_json: whether the result is printed for programs.
        quiet: whether notes are not printed.
    """

    path: Path
    out: Path
    seed: np.ndarray | None
    keeps_limits: bool
    max_change: float
    is_strict: bool
    as_json: bool
    quiet: bool


@dataclass(frozen=True, kw_only=True)
class TargetFiles:
    """Files of targets that are no tables; here there are none."""

    def reads(self, path: Path) -> bool:
        """Return whether a file is one of these."""
        return False

    def correct(self, calibrated: FittedRobot, wanted: FileCorrection) -> Exit:
        """Correct a file for the calibrated robot, and print what was done."""
        raise NotImplementedError
