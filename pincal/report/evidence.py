"""Errors of a calibration row by row, before and after, with all that they may depend on: what figures are drawn from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pincal.calibration.run import Calibration
from pincal.units import readable_unit


@dataclass(frozen=True)
class Evidence:
    """Errors of one kind of reading at N rows, fitted and held-out ones together.

    Attributes:
        name: of the reading: "position", "orientation" or "distance".
        unit: of all errors: "mm" or "mrad".
        before: shape (k, N), reading minus prediction with base and tool fitted alone.
        after: shape (k, N), the same of the calibrated model.
        is_held: shape (N,), whether the fit never saw the row.
        is_outlier: shape (N,), whether it was left out of the fit.
        noise: standard deviation of one component.
        joint_names: of the n joints.
        is_prismatic: shape (n,).
        q: shape (N, n), joint positions [rad or m].
        place: shape (N, 3), tip of the nominal arm in the robot's base frame [m].
        up: shape (3,), against gravity in this frame.
        line: shape (N,), line of each row in its file.
        time: shape (N,) [s], None where it was not recorded.

    Raises:
        ValueError: without rows.
    """

    name: str
    unit: str
    before: np.ndarray
    after: np.ndarray
    is_held: np.ndarray
    is_outlier: np.ndarray
    noise: float
    joint_names: tuple[str, ...]
    is_prismatic: np.ndarray
    q: np.ndarray
    place: np.ndarray
    up: np.ndarray
    line: np.ndarray
    time: np.ndarray | None

    def __post_init__(self) -> None:
        if not len(self.line):
            raise ValueError("no rows to draw; expected at least one")

    def sizes(self, which: str) -> np.ndarray:
        """Return the size of the error at each row, shape (N,), "before" or "after" calibration."""
        return np.asarray(np.linalg.norm(self.before if which == "before" else self.after, axis=0))

    def part(self, *, held: bool) -> np.ndarray:
        """Return which rows were held out, or were fitted, shape (N,)."""
        return self.is_held if held else ~self.is_held


def evidence_of(calibration: Calibration) -> tuple[Evidence, ...]:
    """Return the errors of a calibration, one :class:`Evidence` per kind of reading, that of places first."""
    fit, robot = calibration.fit, calibration.robot
    tables = [table for table in (calibration.train, calibration.test) if len(table)]
    problems = [fit.station, *filter(None, [calibration.test_problem()])]
    before = np.hstack([problem.residuals(fit.nominal.values) for problem in problems])
    after = np.hstack([problem.residuals(fit.values) for problem in problems])
    lengths = [len(problem) for problem in problems]
    q = np.vstack([problem.conditions.q for problem in problems])
    outlier = np.zeros(sum(lengths), bool)
    outlier[: lengths[0]] = fit.solution.weights == 0.0
    gravity = fit.model.chain.gravity
    up = np.array([0.0, 0.0, 1.0]) if not np.any(gravity) else -gravity / np.linalg.norm(gravity)
    place = robot.forward_kinematics(q)[:, :3, 3]
    ends = np.cumsum([0, *(block.size for block in fit.station.sensor.blocks)])
    times = [time for problem in problems if (time := problem.conditions.time) is not None]
    found = []
    for k, block in enumerate(fit.station.sensor.blocks):
        factor, unit = readable_unit(block.unit)
        declared = fit.noise.declared[k]
        found.append(
            Evidence(
                name=block.name,
                unit=unit,
                before=before[ends[k] : ends[k + 1]] * factor,
                after=after[ends[k] : ends[k + 1]] * factor,
                is_held=np.arange(sum(lengths)) >= lengths[0],
                is_outlier=outlier,
                noise=float(fit.solution.estimated[k] if declared is None else declared) * factor,
                joint_names=tuple(robot.joint_names),
                is_prismatic=np.array([kind == "prismatic" for kind in robot.joint_types]),
                q=q,
                place=place,
                up=up,
                line=np.concatenate([table.rows for table in tables]),
                time=np.concatenate(times) if len(times) == len(problems) else None,
            )
        )
    return tuple(found)
