r"""Joints that were written with few digits, as a pendant shows them: noise of a known size.

A position written in steps of h is off by up to h / 2, with the variance :math:`h^2 / 12` (Sheppard
1898). With L the levers of the drives, readings of a row scatter by
:math:`L \, \mathrm{diag}(h^2 / 12) \, L^T` in addition to their own noise.

A robot that was sent to round positions stands there, and is not off by their steps: what rows are
off tells the two apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pincal.errors import counted
from pincal.identify.drive_levers import drive_levers
from pincal.identify.motion_fields import displacements_by_drives
from pincal.identify.station import Station
from pincal.measure.column_numbers import JOINT_COLUMNS
from pincal.measure.joint_columns import steps_of


@dataclass(frozen=True, eq=False)
class RoundedJoints:
    """The joints of a station of which many are written in coarse steps.

    Attributes:
        station: a model over N rows that reads places.
        values: shape (P,), of its parameters.
        steps: shape (n,), the step of each drive [rad], 0 for those with all digits.
    """

    station: Station
    values: np.ndarray
    steps: np.ndarray

    @classmethod
    def of(cls, station: Station, values: np.ndarray) -> RoundedJoints | None:
        """Return those of a station; None if it has none, or its rows are of motion."""
        if not station.sensor.reads_place or station.conditions.are_of_motion:
            return None
        units = station.model.chain.robot.joint_units
        is_turning = np.array([unit == "rad" for unit in units])
        steps = np.where(is_turning, steps_of(station.conditions.q), 0.0)
        return cls(station, values, steps) if steps.any() else None

    @property
    def drives(self) -> np.ndarray:
        """Standard deviation of each drive's position, shape (n,) [rad]."""
        return np.asarray(self.steps / np.sqrt(12.0))

    @cached_property
    def moved(self) -> float:
        """By how much the steps alone move targets, root mean square [m]."""
        by_drive = displacements_by_drives(self.station, self.values)
        moved = by_drive * self.drives[:, None, None]
        return float(np.sqrt(np.sum(moved**2) / len(self.station)))

    @cached_property
    def off(self) -> float:
        """How far the rows are off, root mean square [m]."""
        displaced = self.station.displacements(self.values)
        return float(np.sqrt(np.sum(displaced**2) / len(self.station)))

    @property
    def words(self) -> str:
        """What they are, and what it costs."""
        return (
            f"the positions of {counted(int(np.count_nonzero(self.steps)), 'joint')} are all "
            f"multiples of {np.rad2deg(self.steps.max()):.3g} deg, as a pendant shows them: "
            f"this alone moves targets by {self.moved * 1e3:.2g} mm"
        )

    def explains(self, noise: float = 0.0) -> bool:
        """Return whether rows are off by about as much as the steps explain, with readings of a
        noise [m, three components together].
        """
        least, most = JOINT_COLUMNS.explained
        expected = float(np.hypot(self.moved, noise))
        return least * expected < self.off < most * expected


def found_rounded(
    station: Station, values: np.ndarray, declared: Sequence[float | None]
) -> RoundedJoints | None:
    """Return the rounded joints of a station whose noise is declared, if its rows are off by what
    these explain, and likelier with the noise of the steps than without.

    Args:
        station: of a fit.
        values: shape (P,), its fitted values.
        declared: noise of each block of its readings, None where it is not declared.
    """
    found = None if declared[0] is None else RoundedJoints.of(station, values)
    if found is None:
        return None
    sigma = np.array(declared, float)
    in_metres = np.array([block.unit == "m" for block in station.sensor.blocks])
    noise = float(np.sqrt(np.sum(station.block_sizes * np.where(in_metres, sigma, 0.0) ** 2)))
    return found if found.explains(noise) and _gain(found, sigma) > 0.0 else None


def _gain(rounded: RoundedJoints, sigma: np.ndarray) -> float:
    """Return by how much the noise of the steps increases twice the log-likelihood of the
    residuals, beside readings of standard deviations ``sigma``, shape (blocks,).
    """
    station = rounded.station
    size = np.repeat(sigma, station.block_sizes)[:, None] / station.weights
    r = (station.residuals(rounded.values) / size).T
    moved = drive_levers(station, rounded.values) * rounded.drives[:, None, None] / size
    V = np.eye(r.shape[1]) + np.einsum("dmn,dkn->nmk", moved, moved)
    explained = np.sum(r * (r - np.linalg.solve(V, r[..., None])[..., 0]))
    return float(explained - np.sum(np.linalg.slogdet(V)[1]))
