"""A part as a calibrated robot measured it: from readings to deviations, their uncertainty and
decisions.

The points of all features have one covariance, by its sources. Features are linear in the errors of
their points, quantities in the datum in the features: with the derivatives G of the whole, each
source s has the covariance G C_s G^T of all quantities. The budget of a quantity is their roots.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from pincal.calibration.fitted_robot import FittedRobot
from pincal.compensate.robot_frames import PoseFrame
from pincal.errors import BadInputError, counted, few, nearest_first
from pincal.features.decision import DecisionRule
from pincal.features.feature_points import LocatedPoints, points_of_sensor
from pincal.features.fitted_part import FittedPart
from pincal.features.flange_sensor import FlangeSensor
from pincal.features.gauge_entries import PassOf, gauge_entries
from pincal.features.measured_entries import PartResult
from pincal.features.measured_file import MeasuredFile
from pincal.features.mounted_sensor import PARAMETERS, MountedSensor, Reservations
from pincal.features.part import Part
from pincal.features.part_values import PartValues
from pincal.features.readings import CONTACT, IMAGE, RANGE, FeatureReadings
from pincal.features.triangulation import points_of_images
from pincal.identity import Identity
from pincal.io.strict_json import write_json
from pincal.measure.table import write_table
from pincal.notes import Note, Severity, doubts_first
from pincal.thresholds import Count
from pincal.units import format_small
from pincal.validate.misfit import Verdict

# Names that a message lists.
_LISTED: Count = 5


@dataclass(frozen=True, eq=False)
class MeasuredPart:
    """What a robot measured of a part.

    Attributes:
        found: the result, as files have it.
        features: fitted to the points of all passes.
        values: the quantities of these in the datum.
    """

    found: MeasuredFile
    features: FittedPart
    values: PartValues

    def completed(
        self, provenance: dict[str, Any], notes: Sequence[Note | str], *, outside: str = ""
    ) -> MeasuredPart:
        """Return the result with its origin, with further notes, and with the rows outside the
        range of the calibration, in words.
        """
        warnings = doubts_first([*self.found.warnings, *notes])
        found = msgspec.structs.replace(
            self.found, provenance=provenance, warnings=warnings, outside=outside
        )
        return replace(self, found=found)

    def write(self, folder: Path) -> None:
        """Write ``measured.json`` and ``measured.csv`` into a folder."""
        write_json(folder / "measured.json", self.found.report)
        write_table(folder / "measured.csv", measured_columns(self.found))


def measure_part(
    robot: FittedRobot,
    readings: FeatureReadings,
    part: Part,
    *,
    sensor: FlangeSensor | None = None,
    frame: PoseFrame = "instrument",
    reservations: Reservations | None = None,
    rule: DecisionRule | None = None,
    stated: Identity | None = None,
) -> MeasuredPart:
    """Measure the features of a part.

    Args:
        robot: the calibrated robot with one station, see :meth:`pincal.FittedRobot.at`.
        readings: what its sensor read, see :func:`pincal.read_readings`.
        part: nominals, tolerances and datum, see :meth:`pincal.Part.from_toml`.
        sensor: what is declared of the sensor; default: all is as calibrated.
        frame: of a datum as calibrated: that of the calibration's instrument or the robot's base.
        reservations: what the calibration itself does not know of its errors.
        rule: by which tolerances are decided; default: guard bands of ISO 14253-1.
        stated: of this measurement, such as its date and operator. Those of the calibration are not
            kept; its robot and instrument are, unless stated here.

    Returns:
        Quantities with their standard and expanded uncertainty [mm, mrad, deg], their covariance,
        the budget of its sources, decisions, and repeatability over passes.

    Raises:
        BadInputError: for readings of features that the part does not have, too few of them, a
            sensor that the calibration does not know, or features that leave the datum open.
        IdentificationError: if a fit does not converge.
    """
    declared = sensor or FlangeSensor()
    _check_names(readings, part)
    _check_sensor(readings, declared)
    mounted = MountedSensor.of(robot, readings, declared, frame, reservations)
    points = located_points(mounted)
    if part.expansion is not None:
        points = part.expansion.at_reference(points)
    features = _fitted(mounted, part, points)
    values = features.evaluated()
    passes = _Passes.of(part, points, declared, readings)
    result = PartResult(
        features=features,
        values=values,
        passes=passes.values,
        frame=frame,
        rule=rule or DecisionRule(),
    )
    notes: list[Note | str] = [
        *_said_by_calibration(robot),
        *_notes(mounted),
        *_lacking(part, features),
        *passes.notes,
        *([] if part.expansion is None else [part.expansion.words]),
    ]
    kinds = {name: of.kind for name, of in part.features.items()}
    identity = (stated or Identity()).over(robot.identity.lasting)
    found = msgspec.structs.replace(
        result.file(),
        gauge=tuple(gauge_entries(passes.of_appraisers, kinds)),
        warnings=doubts_first(notes),
        id=identity,
    )
    return MeasuredPart(found, features, values)


def located_points(mounted: MountedSensor) -> LocatedPoints:
    """Return the points of all readings of a sensor."""
    is_image = mounted.readings.kind == IMAGE
    return points_of_images(mounted) if is_image else points_of_sensor(mounted)


def _fitted(mounted: MountedSensor, part: Part, points: LocatedPoints) -> FittedPart:
    """Return the features through points.

    Raises:
        BadInputError: for points that do not determine their feature. If they would with a model
            whose parameters were known, it is the calibration that has to be completed.
    """
    try:
        return FittedPart.of(part, points, mounted.declared)
    except BadInputError as error:
        if not _are_determined(part, points.without_source(PARAMETERS), mounted.declared):
            raise
        which = str(error).partition(":")[0]
        raise BadInputError(f"{which}: {_open_words(mounted)}") from error


def _are_determined(part: Part, points: LocatedPoints, declared: FlangeSensor) -> bool:
    """Return whether points determine their features."""
    try:
        FittedPart.of(part, points, declared)
    except BadInputError:
        return False
    return True


def _open_words(mounted: MountedSensor) -> str:
    """Return what a calibration leaves open where it, not the points, is why a feature can't be
    fitted, and the cure.
    """
    return (
        "its readings would do, but the calibration of this model leaves open where they are: the "
        "place of the target on the tool has a standard deviation of "
        f"{format_small(mounted.place_sigma, 'm')}. Calibrate with poses that turn the wrist as "
        "these do, about two axes, or give the place (tool in cell.toml)"
    )


def _check_names(readings: FeatureReadings, part: Part) -> None:
    """Refuse readings of features that the part does not have, and images of a feature whose points
    have no names.
    """
    source = readings.rows.source
    known = part.kinds
    named = list(dict.fromkeys(readings.feature.tolist()))
    strange = [name for name in named if name not in known]
    if strange:
        near = few(nearest_first(strange, known), _LISTED)
        lines = readings.rows.rows[readings.of(strange[0])]
        raise BadInputError(
            f"{source}, line {few(lines, _LISTED)}: feature {strange[0]!r} is not in the part's "
            f"file, or not measured itself; expected one of {near}"
        )
    for name in named:
        points = set(readings.point[readings.of(name)].tolist())
        if readings.kind == IMAGE and known[name] != "point" and points == {""}:
            raise BadInputError(
                f"{source}: images of {name!r}, a {known[name]}, without a column point; expected "
                "the name of each of its points, by which images in several stops are of the same"
            )


def _check_sensor(readings: FeatureReadings, declared: FlangeSensor) -> None:
    """Refuse what is declared of another kind of sensor than that of the readings."""
    source = readings.rows.source
    is_image = readings.kind == IMAGE
    if is_image and declared.noise is not None:
        raise BadInputError(
            f"{source}: the noise of the sensor is declared as a length, but it reads images; "
            "expected pixels, such as 0.1px"
        )
    if not is_image and declared.pixel_noise is not None:
        raise BadInputError(
            f"{source}: the noise of the sensor is declared in pixels, but it reads no images; "
            "expected a length, such as 0.05mm"
        )
    if declared.radius and readings.kind != CONTACT:
        raise BadInputError(
            f"{source}: a probe with a ball is declared, but the sensor reads {readings.kind}; "
            "expected contacts, rows of joints and feature alone"
        )


@dataclass(frozen=True)
class _Passes:
    """The quantities of each pass, and notes on passes that can't stand alone."""

    of_appraisers: tuple[PassOf, ...]
    notes: tuple[str, ...]

    @property
    def values(self) -> tuple[PartValues, ...]:
        """The quantities of each pass."""
        return tuple(one.values for one in self.of_appraisers)

    @classmethod
    def of(
        cls,
        part: Part,
        points: LocatedPoints,
        declared: FlangeSensor,
        readings: FeatureReadings,
    ) -> _Passes:
        """Return those of points; nothing for a single pass."""
        values = list[PassOf]()
        notes = list[str]()
        numbers = np.unique(points.passes)
        for number in numbers if len(numbers) > 1 else ():
            some = points.select(points.passes == number)
            try:
                found = FittedPart.of(part, some, declared).evaluated()
                values.append(PassOf(_appraiser_of(readings, int(number)), found))
            except BadInputError as error:
                notes.append(f"pass {number + 1} is no repetition of its own: {error}")
        return cls(tuple(values), tuple(notes))


def _said_by_calibration(robot: FittedRobot) -> Iterator[Note]:
    """Yield what a calibration states of its model; its doubt is one of what is measured."""
    statement = robot.statement
    if statement is None:
        return
    is_doubted = bool(statement.doubts) or statement.verdict is Verdict.NOT_ADEQUATE
    for i, text in enumerate(statement.notes()):
        severity = Severity.DOUBT if is_doubted and i == 0 else Severity.NOTE
        yield Note(severity, text)


def _notes(mounted: MountedSensor) -> Iterator[str]:
    """Yield what is not known of the sensor."""
    sigma, _ = mounted.noise
    if mounted.readings.kind != IMAGE and not np.any(sigma):
        of = "a contact" if mounted.readings.kind == CONTACT else "the sensor"
        yield (
            f"no noise of {of} is declared: the budget has none; state it with --sensor-noise, "
            "as the repetition of a reading shows it"
        )
    if mounted.readings.kind == RANGE and mounted.is_own:
        yield "ranges lie on the z axis of the calibrated target"


def _appraiser_of(readings: FeatureReadings, number: int) -> str:
    """Return who measured a pass; empty where no column tells."""
    if readings.appraiser is None:
        return ""
    return str(readings.appraiser[readings.passes == number][0])


def _lacking(part: Part, features: FittedPart) -> Iterator[str]:
    """Yield which features of the part have no readings."""
    missing = [name for name in part.kinds if name not in features.fitted.fits]
    if missing:
        yield (
            f"left out, without readings: {len(missing)} of {counted(len(part.kinds), 'feature')}: "
            f"{few(missing, _LISTED)}"
        )


def measured_columns(found: MeasuredFile) -> dict[str, np.ndarray]:
    """Return the columns of ``measured.csv``: one row per quantity, numbers in its unit, NaN for
    what there is not.
    """
    rows = [(of, name, value) for of in found.features for name, value in of.values.items()]
    values = [value for _, _, value in rows]
    ends = [(None, None) if value.limits is None else value.limits for value in values]
    numbers: dict[str, list[float | None]] = {
        name: [getattr(value, name) for value in values]
        for name in ("value", "u", "U", "k", "nominal", "deviation", "risk")
    }
    numbers["dof"] = [np.inf if value.dof is None else value.dof for value in values]
    numbers["lower"] = [lower for lower, _ in ends]
    numbers["upper"] = [upper for _, upper in ends]
    texts = {
        "feature": [of.name for of, _, _ in rows],
        "kind": [of.kind for of, _, _ in rows],
        "quantity": [name for _, name, _ in rows],
        "unit": [value.unit for value in values],
        "decision": [value.decision or "" for value in values],
    }
    columns = {name: np.array(column) for name, column in texts.items()}
    return columns | {name: np.array(column, float) for name, column in numbers.items()}
