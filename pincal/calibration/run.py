"""One calibration from table to result: check, hold out, fit, validate."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pincal.calibration.result import Result, result_of
from pincal.errors import MeasurementError, PincalWarning
from pincal.identify.calibrate import calibrate, doubts_lens
from pincal.identify.fit import Fit
from pincal.identify.options import Options
from pincal.identify.split import Split, hold_out
from pincal.identify.station import Station
from pincal.measure.admission import scorable_rows, unobservable_notes, usable_rows
from pincal.measure.checks import TableFindings, check_measurements
from pincal.measure.fields import nearest_first
from pincal.measure.measurements import Measurements
from pincal.measure.setup import Setup, point_names
from pincal.robot.robot import Robot
from pincal.validate.agreement import check_agreement


@dataclass(frozen=True)
class Calibration:
    """A calibration with its validation.

    Attributes:
        robot: the arm.
        train: rows that the fit saw.
        test: rows that it did not see; may be empty.
        fit: the calibrated model.
        result: parameters, errors, warnings.
        notes: the warnings among them that are on robot and table, not on the fit.
    """

    robot: Robot
    train: Measurements
    test: Measurements
    fit: Fit
    result: Result
    notes: tuple[str, ...] = ()

    def n_poses(self, *parts: str) -> int:
        """Return the number of poses, each with one reading or more, of "train", "test", or both."""
        q = np.vstack([getattr(self, part).q for part in parts or ("train", "test")])
        return len(np.unique(q, axis=0))

    def test_problem(self) -> Station | None:
        """Return the held-out rows under the calibrated model, None without any."""
        return self.fit.readings(self.test) if len(self.test) else None


def check_table(robot: Robot, measurements: Measurements, *, minimum: int = 2) -> TableFindings:
    """Refuse what can't be measurements of this robot; warn of what is merely odd."""
    return check_measurements(
        measurements,
        lower=robot.lower,
        upper=robot.upper,
        joint_types=robot.joint_types,
        reach_m=robot.reach,
        minimum=minimum,
    )


def run_calibration(
    robot: Robot,
    measurements: Measurements,
    options: Options | None = None,
    *,
    test_fraction: float = 0.25,
    split: Split = "random",
    seed: int = 0,
    holdout: Measurements | None = None,
) -> Calibration:
    """Check a table, hold rows back, calibrate on the rest and validate on what was held back.

    Args:
        robot: the arm.
        measurements: the table.
        options: how to calibrate.
        test_fraction: part of the rows held out; ignored with ``holdout``.
        split: how rows are chosen.
        seed: of the choice.
        holdout: other measurements to validate on; then all rows of ``measurements`` train.

    Returns:
        The calibration.

    Raises:
        BadInputError: if table and robot don't go together, or rows are too few.
        IdentificationError: if nothing can be identified.
    """
    begun = time.perf_counter()
    options = Options() if options is None else options
    idle = check_gaps(options.setup, [measurements] if holdout is None else [measurements, holdout])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        measurements = usable_rows(measurements, options.setup)
        check_count(robot, measurements, options.setup)
        check_table(robot, measurements)
        if holdout is None:
            train, test = hold_out(measurements, test_fraction, split=split, seed=seed)
            train = usable_rows(train, options.setup)
            test = scorable_rows(test, options.setup.over(train))
        else:
            train, test = measurements, scorable_rows(holdout, options.setup.over(measurements))
            check_table(robot, test, minimum=1)
    fit = calibrate(robot, train, options)
    check_agreement(robot, train, fit)
    notes = tuple(dict.fromkeys(str(w.message) for w in caught if issubclass(w.category, PincalWarning)))
    notes = (*robot.notes, *notes, *idle, *unobservable_notes(train, options.setup), *_few_rows(fit))
    if options.setup.lens is not None and doubts_lens(fit):
        notes = (*notes, "the images call for another camera than the given one: --fit-camera finds its parameters")
    held = fit.readings(test) if len(test) else None
    result = result_of(fit, held, seconds=time.perf_counter() - begun, tables=(train, test), notes=notes)
    return Calibration(robot, train, test, fit, result, notes)


def check_gaps(setup: Setup, tables: Sequence[Measurements]) -> tuple[str, ...]:
    """Refuse a known distance from a point of the tables to one that nobody knows.

    Returns:
        A note on distances between points that are in none of the tables: they may belong to another one.

    Raises:
        MeasurementError: naming the unknown point.
    """
    found = [point_names(table) for table in tables]
    known = {str(name) for names in found if names is not None for name in np.unique(names)} | set(setup.points)
    idle = []
    for gap in setup.distances:
        unknown = [name for name in (gap.first, gap.second) if name not in known]
        if len(unknown) == 1 or not known:
            near = ", ".join(nearest_first(unknown, sorted(known))[:6]) if known else "none"
            raise MeasurementError(
                f"a known distance names {unknown[0]!r}; expected one of the points, nearest first: {near}"
            )
        idle += [f"{gap.first} to {gap.second}"] if unknown else []
    return (f"known distances between points that are in no row are not used: {', '.join(idle)}",) if idle else ()


def check_count(robot: Robot, measurements: Measurements, setup: Setup | None = None) -> None:
    """Refuse a table that could not even tell where instrument and tool stand."""
    kind, names = measurements.kind, point_names(measurements)
    size = {"position": 3, "pose": 6, "distance": 1, "camera_pixel": 2}.get(kind, 3)
    targets = len(np.unique(measurements.target)) if len(measurements) else 1
    tool = 6 if kind in ("pose", "camera_point", "camera_pixel") else 3
    base = {"position": 6, "pose": 6, "distance": 3}.get(kind, 0)
    if names is not None:
        points = (setup or Setup()).named(np.unique(names))
        base = len(points.parameters) + 6 * bool(points.known.any())
    poses = len(np.unique(measurements.q, axis=0))
    fewest = -(-(tool * targets + robot.n_joints) // 6) + 1
    if kind.startswith("camera") and poses < fewest:
        raise MeasurementError(
            f"{measurements.source}: {poses} poses of the camera; however many points are seen in one, it tells six "
            f"coordinates: expected at least {fewest}, and better 30 or more"
        )
    needed = -(-(base + tool * targets + robot.n_joints) // size)
    if len(measurements) < needed:
        raise MeasurementError(
            f"{measurements.source}: {len(measurements)} rows of kind {measurements.kind}; expected at least {needed} "
            f"to tell where instrument and tool stand and {robot.n_joints} joint offsets, and better 50 or more"
        )


def _few_rows(fit: Fit) -> tuple[str, ...]:
    """Say so where there are fewer readings than parameters; however much is read of a pose, it has six coordinates."""
    poses = len(np.unique(fit.station.conditions.q, axis=0))
    own = int(fit.solution.free[fit.model.n_parameters :].sum())
    readings = min(len(fit.station) * sum(block.size for block in fit.station.sensor.blocks), 6 * poses + own)
    released = int(fit.solution.free.sum())
    if readings >= 2 * released:
        return ()
    return (
        f"{len(fit.station)} training rows in {poses} poses give {readings} readings for {released} parameters: "
        "much rests on what is known beforehand; measure more poses",
    )
