"""``pincal measure``: features of a part from what a calibrated robot read, with their uncertainty
and decisions on their tolerances.
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from pincal.cli.arguments import argument, group, option, verb
from pincal.cli.common import GeneralOptions, TableArguments, model_argument, station_option
from pincal.cli.identity_options import HEADING, IdentityOptions
from pincal.cli.outputs import echo_notes, extrapolation, print_json, provenance
from pincal.cli.quantities import LENGTH, NoiseType
from pincal.cli.result_place import results_option
from pincal.errors import BadInputError, Exit, few
from pincal.features.decision_numbers import DECISION
from pincal.io.result_folder import output_folder
from pincal.thresholds import Count

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pincal.calibration.check_record import InterimCheck
    from pincal.calibration.covered import Outside
    from pincal.calibration.fitted_robot import FittedRobot
    from pincal.features.decision import DecisionRule
    from pincal.features.flange_sensor import FlangeSensor
    from pincal.features.measured_file import MeasuredFile
    from pincal.features.measured_part import MeasuredPart
    from pincal.features.mounted_sensor import Reservations
    from pincal.features.readings import FeatureReadings
    from pincal.notes import Note

# Joints that a sentence lists.
_NAMED: Count = 3
_EXAMPLES = """
Examples:
  pincal measure results/model.json readings.csv --features part.toml --out measured
  pincal measure results/model.json images.csv --features part.toml --sensor-noise 0.1px --out out
  pincal measure results/model.json touched.csv --features part.toml --sensor probe.toml --out out

READINGS.csv has the joints, the feature of each row (column feature), and what a sensor on the
flange read: cx cy cz of a 3D sensor, u v of a camera in two or more stops (column point, where a
feature has several), range along the sensor's z axis, or nothing else where the calibrated target
touched the part. Rows of one stop share the arrival of the drives: a column stop, or equal joints,
tell it. Repeated passes (column pass, or a program that is run again) give the repeatability; a
column operator, day or robot beside them gives GR&R by analysis of variance.

PART.toml has the features with nominals and tolerances, and the datum. DIR then holds
measured.json, measured.csv and report.html. The exit code is 5 if a tolerance is not met.
"""


@dataclass(frozen=True, kw_only=True)
class MeasureArguments:
    """Arguments of measure."""

    model: Path = model_argument()
    readings: Path = argument("READINGS.csv", "Joints, features, and readings of the sensor.")
    features: Path = option(
        "Features of the part, their nominals and tolerances, and the datum.",
        MISSING,
        metavar="PART.toml",
    )
    out: Path = results_option("measured")
    station: str | None = station_option(words="the only one")
    frame: Literal["instrument", "base"] = option(
        "Frame of the datum as calibrated: the instrument's or the robot's base.", "instrument"
    )
    sensor: Path | None = option(
        "Mount, camera, noise and probe of a sensor on the flange.",
        metavar="SENSOR.toml",
        words="as calibrated",
    )
    sensor_noise: tuple[float, str] | None = option(
        "Standard deviation of one coordinate of a reading.",
        type=NoiseType(zero=True),
        metavar="0.05mm|0.1px",
        words="that of the calibration, or of --sensor",
    )
    instrument: str | None = option(
        "Instrument of the calibration (leica_at500, leica_at960), or its maximum permissible "
        "errors (10um+0.3um/m), whose part per metre is the uncertainty of its scale.",
        metavar="NAME|MPE",
        words="its scale is exact",
        in_cell=True,
    )
    drift: float | None = option(
        "Standard uncertainty of a position by drift since the calibration; at least that of the "
        "interim checks.",
        type=LENGTH,
        words="that of the interim checks",
    )
    checks: Path | None = option(
        "Record of the interim checks of the model.",
        metavar="FILE.json",
        words="model.checks.json beside the model",
    )
    despite_check: bool = option(
        "Measure although the last interim check of the model raised an alarm; a doubt says so.",
        False,
    )
    decision: Literal["guarded", "simple"] = option(
        "Rule: with U as guard band at both sides of a limit (ISO 14253-1), or simple acceptance.",
        "guarded",
    )
    coverage: float = option("Probability that U covers.", DECISION.coverage)
    identity: IdentityOptions = group(HEADING)
    table: TableArguments = group("Tables")
    general: GeneralOptions = group("General")


@verb(
    MeasureArguments,
    examples=_EXAMPLES,
    exits=(Exit.INACCURATE,),
    shown=(
        "features",
        "out",
        "station",
        "frame",
        "sensor",
        "sensor_noise",
        "instrument",
        "drift",
        "decision",
        "coverage",
        "as_json",
    ),
)
def measure_verb(arguments: MeasureArguments) -> Exit:
    """Measure features of a part with a calibrated robot.

    Deviations from nominal have their uncertainty by all its sources, and tolerances are decided
    with it: conforms, does not conform, undecided.
    """
    from pincal.cli.progress import console
    from pincal.cli.screen import print_doubts
    from pincal.features.measured_page import closing_lines, gauge_table, short_table

    with output_folder(arguments.out) as draft:
        found = _measured(arguments, draft)
    if arguments.general.as_json:
        print_json(found.report)
    else:
        print_doubts(found.warnings, console())
        console().print(short_table(found))
        gauge = gauge_table(found)
        if gauge is not None:
            console().print(gauge)
        for line in closing_lines(found):
            click.echo(line)
        click.echo(f"written to {arguments.out}: measured.json measured.csv report.html")
    echo_notes(found.warnings, quiet=arguments.general.quiet)
    return Exit.INACCURATE if found.count("does not conform") else Exit.DONE


def _measured(arguments: MeasureArguments, folder: Path) -> MeasuredFile:
    """Measure the part, write the results into a folder, and return them."""
    from pincal.calibration.fitted_robot import load_model
    from pincal.calibration.placing import without_absent
    from pincal.features.measured_part import measure_part
    from pincal.features.part import Part
    from pincal.features.readings import read_readings

    whole = load_model(arguments.model)
    check, of_record = _checked(arguments, whole)
    fitted = whole.at(arguments.station)
    identity = arguments.identity
    said = tuple(identity.of_model(fitted.identity, arguments.model))
    part = Part.from_toml(arguments.features)
    robot = fitted.model.chain.robot
    readings = read_readings(arguments.readings, robot, options=arguments.table.options)
    fitted, absent = without_absent(fitted, readings.rows)
    outside, beyond = _extrapolated(arguments, fitted, readings)
    measured = measure_part(
        fitted,
        readings,
        part,
        sensor=_sensor(arguments),
        frame=arguments.frame,
        reservations=_reservations(arguments, check),
        rule=_rule(arguments),
        stated=identity.given,
    )
    notes = (*of_record, *said, *absent, *beyond)
    measured = measured.completed(_origin(arguments), notes, outside=outside)
    _write(measured, folder, robot.name)
    return measured.found


def _extrapolated(
    arguments: MeasureArguments, fitted: FittedRobot, readings: FeatureReadings
) -> tuple[str, list[str]]:
    """Return which rows lie outside the range of the calibration, and notes on them; single rows
    are printed.
    """
    conditions = fitted.conditions(readings.rows)
    _, beyond = extrapolation(fitted, conditions, readings.rows.rows)
    # Single rows are for the terminal; what they amount to belongs to the result.
    lines = [note for note in beyond if note.startswith("line ")]
    echo_notes(lines, quiet=arguments.general.quiet)
    others = [note for note in beyond if note not in lines]
    return _outside(fitted.outside(conditions), len(readings)), others


def _origin(arguments: MeasureArguments) -> dict[str, Any]:
    """Return the files on which the result rests, and the version."""
    from pincal.calibration.check_record import record_path

    inputs = (
        arguments.model,
        arguments.readings,
        arguments.features,
        arguments.sensor,
        arguments.checks or record_path(arguments.model),
    )
    return provenance([path for path in inputs if path is not None])


def _write(measured: MeasuredPart, folder: Path, robot: str) -> None:
    """Write the results and the page of a measured part into a folder."""
    from pincal.features.measured_page import measured_page

    measured.write(folder)
    page = measured_page(measured.found, robot=robot, version=measured.found.provenance["pincal"])
    (folder / "report.html").write_text(page, encoding="utf-8")


def _outside(values: Sequence[Outside], n: int) -> str:
    """Return which of n rows lie outside the range of the calibration, in words."""
    if not values:
        return ""
    rows = len({value.row for value in values})
    names = dict.fromkeys(value.name for value in values)
    return f"{rows} of {n} rows ({few(list(names), _NAMED)}), where the model was not validated"


def _sensor(arguments: MeasureArguments) -> FlangeSensor:
    """Return what is declared of the sensor."""
    from pincal.features.flange_sensor import FlangeSensor

    declared = FlangeSensor()
    if arguments.sensor is not None:
        declared = FlangeSensor.from_toml(arguments.sensor)
    if arguments.sensor_noise is None:
        return declared
    size, unit = arguments.sensor_noise
    return declared.with_noise(size, unit)


def _checked(
    arguments: MeasureArguments, fitted: FittedRobot
) -> tuple[InterimCheck | None, tuple[Note | str, ...]]:
    """Return the last interim check of the model, and what it says.

    Raises:
        BadInputError: if it raised an alarm, unless the user wants to measure nevertheless.
    """
    from pincal.cli.checked import failed_words, last_check
    from pincal.notes import Note, Severity

    check, notes = last_check(arguments.model, arguments.checks, fitted)
    if check is None:
        return None, notes
    if not check.has_failed:
        return check, (*notes, f"interim check of {check.words}; its drift is in the budget")
    if not arguments.despite_check:
        raise BadInputError(
            f"{arguments.model}: {failed_words(check)}; --despite-check measures nevertheless"
        )
    return check, (*notes, Note(Severity.DOUBT, failed_words(check)))


def _reservations(arguments: MeasureArguments, check: InterimCheck | None) -> Reservations:
    """Return what the calibration itself does not know of its errors."""
    from pincal.features.mounted_sensor import Reservations
    from pincal.measure.instruments import InstrumentNoise

    scale = 0.0
    if arguments.instrument is not None:
        scale = InstrumentNoise.of(arguments.instrument).along_per_m
    seen = 0.0 if check is None else check.drift
    return Reservations(scale=scale, drift=max(arguments.drift or 0.0, seen))


def _rule(arguments: MeasureArguments) -> DecisionRule:
    """Return the decision rule."""
    from pincal.features.decision import DecisionRule

    if not 0.5 <= arguments.coverage < 1.0:
        raise click.UsageError(
            f"--coverage {arguments.coverage:g}; expected a probability from 0.5 to below 1"
        )
    return DecisionRule(arguments.decision, arguments.coverage)
