"""The subject of a page; and errors row by row, before and after, with the quantities that figures
show them against.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Literal

import numpy as np

from pincal.calibration.calibration import Calibration
from pincal.calibration.held_out import Validated
from pincal.calibration.result import Result
from pincal.identify.station import Station
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.model import Model
from pincal.report.judgement import SearchReport
from pincal.robot.robot import Robot
from pincal.units import readable_unit


@dataclass(frozen=True)
class RowErrors:
    """Errors of one kind of reading in N rows: fitted and held-out ones together, or each by a fit
    without its fold.

    Attributes:
        name: of the reading: "position", "orientation" or "distance".
        unit: of all errors: "mm" or "mrad".
        before: shape (k, N), reading minus prediction with base and tool fitted alone.
        after: shape (k, N), the same for the calibrated model.
        is_held: shape (N,), whether the row was held out of the fit that predicts it.
        is_outlier: shape (N,), whether the row was rejected as an outlier.
        noise: standard deviation of one component.
        joint_names: of the n joints.
        is_prismatic: shape (n,).
        q: shape (N, n), joint positions [rad or m].
        place: shape (N, 3), tip of the nominal arm in the robot's base frame [m].
        up: shape (3,), direction against gravity in this frame.
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
        """Return which rows were held out, or fitted, shape (N,)."""
        return self.is_held if held else ~self.is_held


def evidence_of(calibration: Calibration) -> tuple[RowErrors, ...]:
    """Return the errors of a calibration, one :class:`RowErrors` per kind of reading, positions
    first.
    """
    found: dict[tuple[str, str], list[RowErrors]] = {}
    for k in range(len(calibration.stations)):
        for part in _of_station(calibration, k):
            found.setdefault((part.name, part.unit), []).append(part)
    return tuple(_together(parts) for parts in found.values())


@dataclass(frozen=True)
class _Shown:
    """The rows of a station whose errors are shown: station, line and errors of each, before and
    after.
    """

    problems: list[Station]
    line: np.ndarray
    before: np.ndarray
    after: np.ndarray
    is_held: np.ndarray
    is_outlier: np.ndarray


def _fitted_and_held(calibration: Calibration, k: int) -> _Shown:
    """Return the fitted and the held-out rows of the k-th station."""
    fit = calibration.fit.fit
    rows = calibration.stations[k]
    station, places, _ = list(fit.stations)[k]
    tables = [table for table in (rows.train, rows.test) if len(table)]
    problems = [station, *filter(None, [rows.held(fit)])]
    lengths = [len(problem) for problem in problems]
    is_outlier = np.zeros(sum(lengths), bool)
    is_outlier[: lengths[0]] = fit.solution.weights[fit.problem.rows[k]] == 0.0
    return _Shown(
        problems=problems,
        line=np.concatenate([table.rows for table in tables]),
        before=np.hstack([problem.residuals(fit.nominal.values[places]) for problem in problems]),
        after=np.hstack([problem.residuals(fit.values[places]) for problem in problems]),
        is_held=np.arange(sum(lengths)) >= lengths[0],
        is_outlier=is_outlier,
    )


def _left_out(calibration: Calibration, k: int, validated: Validated) -> _Shown:
    """Return the readings of the k-th station, each predicted by fits without its fold."""
    fit = calibration.fit.fit
    rows = calibration.stations[k]
    before, after = (validated.leading(model)[k] for model in ("nominal", "calibrated"))
    known = np.flatnonzero(
        np.isfinite(before.residuals).all(axis=0) & np.isfinite(after.residuals).all(axis=0)
    )
    station = fit.problem.stations[k]
    table = rows.train
    outlier = fit.solution.weights[fit.problem.rows[k]] == 0.0
    if len(after.counted) != len(station):
        table = rows.measured[0]
        outlier = rows.by_row(outlier)
        station = fit.readings(table, station=station.name)
    return _Shown(
        problems=[station.select(known)],
        line=table.rows[known],
        before=before.residuals[:, known],
        after=after.residuals[:, known],
        is_held=np.ones(len(known), bool),
        is_outlier=outlier[known],
    )


def _of_station(calibration: Calibration, k: int) -> Iterator[RowErrors]:
    """Yield the errors of the k-th station, one kind of reading after the other."""
    fit = calibration.fit.fit
    robot = calibration.robot
    station, _, blocks = list(fit.stations)[k]
    validated = calibration.validated
    shown = (
        _fitted_and_held(calibration, k)
        if validated is None
        else _left_out(calibration, k, validated)
    )
    if not len(shown.line):
        return
    made = _errors_at(shown, robot, station.model.chain.gravity)
    ends = np.cumsum([0, *(block.size for block in station.sensor.blocks)])
    for b, block in enumerate(station.sensor.blocks, blocks.start):
        factor, unit = readable_unit(block.unit)
        declared = fit.noise.declared[b]
        here = slice(*ends[b - blocks.start : b - blocks.start + 2])
        yield made(
            name=block.name,
            unit=unit,
            before=shown.before[here] * factor,
            after=shown.after[here] * factor,
            noise=float(fit.solution.estimated[b] if declared is None else declared) * factor,
        )


def _errors_at(shown: _Shown, robot: Robot, gravity: np.ndarray) -> Callable[..., RowErrors]:
    """Return a function that makes the errors of a kind of reading, at these rows."""
    problems = shown.problems
    q = np.vstack([problem.conditions.q for problem in problems])
    times = [time for problem in problems if (time := problem.conditions.time) is not None]
    return partial(
        RowErrors,
        is_held=shown.is_held,
        is_outlier=shown.is_outlier,
        joint_names=tuple(robot.joint_names),
        is_prismatic=np.array([kind == "prismatic" for kind in robot.joint_types]),
        q=q,
        place=Model(Chain.of(robot), ()).predict(np.zeros(0), Conditions.at(q))[:, :, 3],
        up=-gravity / np.linalg.norm(gravity) if np.any(gravity) else np.array([0.0, 0.0, 1.0]),
        line=shown.line,
        time=np.concatenate(times) if len(times) == len(problems) else None,
    )


def _together(parts: list[RowErrors]) -> RowErrors:
    """Return the errors of all stations, one after the other, without times, and with rows counted
    from 1.
    """
    if len(parts) == 1:
        return parts[0]
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts], axis=-1)
        for name in ("before", "after", "is_held", "is_outlier")
    }
    joined |= {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in ("q", "place")
    }
    noise = float(np.sqrt(np.mean([part.noise**2 for part in parts])))
    line = np.arange(len(joined["q"])) + 1
    return replace(parts[0], **joined, noise=noise, line=line, time=None)


@dataclass(frozen=True)
class Subject:
    """The subject of a page.

    Attributes:
        calibration: the calibration.
        provenance: versions, command, inputs with hashes.
        notes: on effects that the exported URDF does not represent.
        search: what a search for missing effects found, if there was one.
        view: name of the 3D view next to the report, if there is one.
    """

    calibration: Calibration
    provenance: dict[str, Any]
    notes: tuple[str, ...] = ()
    search: SearchReport | None = None
    view: str | None = None

    @property
    def result(self) -> Result:
        """The figures of the calibration."""
        return self.calibration.result

    @cached_property
    def readings(self) -> tuple[RowErrors, ...]:
        """Errors row by row, one for each kind of reading, positions first."""
        return evidence_of(self.calibration)

    @property
    def part(self) -> Literal["test", "train"]:
        """The rows whose errors are quoted first: held-out ones if there are any."""
        return "test" if "test" in self.result.error["calibrated"] else "train"
