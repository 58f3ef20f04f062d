"""``pincal validate``, ``diagnose`` and ``update``: new rows tested against a calibrated robot, or
added to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import MISSING, asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pincal.cli.arguments import Output, argument, group, option, verb
from pincal.cli.common import (
    GeneralOptions,
    TableArguments,
    max_error_option,
    model_argument,
    station_option,
)
from pincal.cli.motion_options import MotionOptions
from pincal.cli.outputs import echo_notes, extrapolation, print_json, provenance, require_accuracy
from pincal.cli.quantities import ANGLE, LENGTH
from pincal.errors import Exit, IdentificationError
from pincal.io.result_folder import output_folder

if TYPE_CHECKING:
    from pincal.calibration.validation import Validation
    from pincal.diagnosis.robot_diagnosis import Diagnosis
    from pincal.measure.measurements import Measurements
    from pincal.notes import Note
    from pincal.robot.robot import Robot


def _noise_angle_option() -> Any:
    """Return the option of the noise of new orientations."""
    return option(
        "Standard deviation of one orientation component of the new measurements.",
        type=ANGLE,
        words="that of the calibration; estimated from the rows if it had no orientations",
    )


_VALIDATE_EXAMPLES = """
Examples:
  pincal validate results/model.json new_measurements.csv --max-error 0.1mm
  pincal validate results/model.json monday.csv tuesday.csv

Instrument and target are assumed to be where they were at calibration unless the rows indicate another placement,
which is then identified from them and reported as a displacement; the errors refer to it. If no placement
explains the rows, they belong to another robot, or it has changed: exit code 6; run pincal diagnose. Of several
tables, those that the model was not fitted to come first, and --max-error applies to them.
"""
_DIAGNOSE_EXAMPLES = """
Example:
  pincal diagnose results/model.json new.csv --out diagnosis

DIR then holds diagnosis.json, report.html and model.json: the model in which only what has changed was
re-identified, or the unchanged model; it predicts at the new station.
"""
_UPDATE_EXAMPLES = """
Examples:
  pincal update results/model.json new.csv --out updated
  pincal update results/model.json new.csv --anew transmission_error:joint_1 --out updated
"""


@dataclass(frozen=True, kw_only=True)
class ValidateArguments:
    """Arguments of validate."""

    model: Path = model_argument()
    data: tuple[Path, ...] = argument(
        "DATA.csv...",
        "Measurements that the calibration did not use, or folders of sessions in motion. "
        "Each is a station.",
        required=False,
    )
    station: str | None = station_option(
        words="the nearest, or a new placement if the rows indicate one"
    )
    max_error: float | None = max_error_option()
    noise_angle: float | None = _noise_angle_option()
    table: TableArguments = group("Tables")
    motion: MotionOptions = group("Motion")
    general: GeneralOptions = group("General")


@verb(ValidateArguments, examples=_VALIDATE_EXAMPLES, exits=(Exit.INACCURATE, Exit.CHANGED))
def validate(arguments: ValidateArguments) -> Exit:
    """Report how accurate a calibrated model is on new measurements.

    The instrument may be anywhere: its placement is identified from the rows.
    """
    from pincal.calibration.fitted_robot import load_model
    from pincal.calibration.validation import validate_rows
    from pincal.cli.inputs import load_tables, other_robot
    from pincal.measure.admit import check_table

    calibrated = load_model(arguments.model)
    chosen = arguments.station
    models = calibrated.each if chosen is None else (calibrated.at(chosen),)
    robot = models[0].model.chain.robot
    tables = load_tables(
        robot, arguments.data, options=arguments.table.options, motion=arguments.motion
    )
    for table in tables.values():
        check_table(robot, table, minimum=1)
    found = [
        validate_rows(
            models, table, name=name, refit=chosen is None, sigma_orientation=arguments.noise_angle
        )
        for name, table in tables.items()
    ]
    result, notes = _result(found)
    if arguments.general.as_json:
        print_json(result)
    else:
        _print(found, result, notes)
    echo_notes(notes, quiet=arguments.general.quiet)
    if doubts := [each.doubt for each in found if each.doubt]:
        raise other_robot("; ".join(doubts), arguments.model)
    require_accuracy(result.get("mean_mm"), arguments.max_error, rows="new")
    return Exit.DONE


def _result(found: list[Validation]) -> tuple[dict[str, Any], tuple[Note, ...]]:
    """Return the result for ``--json``, and notes for the user, on all rows and on those outside
    the calibrated range.
    """
    from msgspec import to_builtins

    from pincal.notes import doubts_first
    from pincal.validate.accuracy import error_statistics, pose_error_sizes
    from pincal.validate.misfit import worst

    # Fitted rows are no evidence of accuracy on a new day: if there are others, only these count.
    unseen = [each for each in found if not each.fitted_rows] or found
    error = error_statistics(pose_error_sizes(each.station, each.values) for each in unseen)
    stations = list(map(_station, found))
    ranges = [extrapolation(each.model, each.station.conditions, each.table.rows) for each in found]
    beyond = {
        "outside": sum(part["outside"] for part, _ in ranges),
        **{
            name: [curve for part, _ in ranges for curve in part[name]]
            for name in ("curves", "gaps")
        },
    }
    # Entries of a single station are repeated at top level.
    alone = {
        key: stations[0][key]
        for key in ("iso9283", "path", "lack_of_fit")
        if len(found) == 1 and key in stations[0]
    }
    notes = doubts_first(
        [*(note for each in found for note in each.notes), *(n for _, part in ranges for n in part)]
    )
    contents = {
        "verdict": worst(each.verdict for each in found),
        "warnings": to_builtins(notes),
        "rows": {"test": sum(len(each.table) for each in unseen)},
        **{name: value for name, value in error.items() if name == "mean_mm"},
        "stations": stations,
        "error": {"calibrated": {"test": error}},
    }
    return contents | alone | beyond, notes


def _station(found: Validation) -> dict[str, Any]:
    iso, lack = found.replicate_statistics()
    contents = {
        "name": found.name,
        "kind": found.table.kind,
        "rows": len(found.table),
        "placed": found.placed,
    }
    contents |= found.moved.to_dict() | {"error": found.error}
    contents |= {"fitted_rows": found.fitted_rows}
    contents |= {
        "misfit": {"ratio": found.misfit.ratio, "p_value": found.misfit.p_value},
        "doubt": found.doubt or None,
    }
    contents |= {"verdict": found.verdict}
    more = {"by_coverage": found.by_coverage, "iso9283": iso, "path": found.path_accuracy}
    more |= {"lack_of_fit": None if lack is None else asdict(lack)}
    return contents | {name: value for name, value in more.items() if value is not None}


def _print(found: list[Validation], result: dict[str, Any], notes: Sequence[Note]) -> None:
    """Print the doubts, the placement of each station, and its errors."""
    from pincal.calibration.result_tables import error_table
    from pincal.cli.progress import console
    from pincal.cli.screen import print_doubts, print_replicates
    from pincal.result_table import hanging
    from pincal.validate.path_accuracy import path_words

    out = console()
    print_doubts(notes, out)
    unseen = [each.name for each in found if not each.fitted_rows]
    if len(found) > 1 and unseen and "mean_mm" in result:
        out.print(
            hanging(
                "never seen", f"by the model: {', '.join(unseen)}: mean {result['mean_mm']:.4f} mm"
            )
        )
    for each in found:
        is_there = each.placed == "as calibrated"
        place = (
            "are where they were at calibration"
            if is_there
            else f"were located again from these rows: {each.moved}"
        )
        out.print(hanging(f"{each.name}:", f"instrument and target {place}; {each.verdict}"))
    parts = {part["name"]: part["error"] for part in result["stations"]}
    if len(found) == 1 and found[0].fitted_rows:
        parts = {
            "train" if found[0].fitted_rows == len(found[0].table) else "new and fitted": found[
                0
            ].error
        }
        out.print(error_table({"calibrated": parts}))
    else:
        out.print(error_table({"calibrated": parts} if len(found) > 1 else result["error"]))
    for each in found:
        if (split := each.by_coverage) is not None:
            inside = split["determined"]
            elsewhere = split["elsewhere"]
            out.print(
                hanging(
                    f"{each.name}:",
                    f"mean {inside['mean']:.4f} {split['unit']} at the {inside['rows']} "
                    "poses where the calibration had "
                    f"determined the curve of every drive, {elsewhere['mean']:.4f} "
                    f"{split['unit']} at the others",
                )
            )
        print_replicates(*each.replicate_statistics(), out)
        if (path := each.path_accuracy) is not None:
            out.print(hanging("path:", path_words(path)))


@dataclass(frozen=True, kw_only=True)
class _NewRows:
    """Arguments of both commands."""

    model: Path = model_argument()
    data: Path = argument(
        "NEW.csv",
        "New measurements, or the folder of a session with a tracker; instrument and "
        "target may have moved.",
    )
    out: Path = option("Folder for the results.", MISSING, metavar="DIR", type=Output())
    table: TableArguments = group("Tables")
    general: GeneralOptions = group("General")

    def read(self, robot: Robot) -> Measurements:
        """Return the new measurements; of a session, the readings of positions if there are any."""
        from pincal.cli.inputs import load_table, load_tables
        from pincal.motion.sessions import joints_of_session

        if joints_of_session(self.data) is None:
            return load_table(robot, self.data, options=self.table.options)
        tables = load_tables(robot, [self.data], options=self.table.options)
        return next(
            (table for table in tables.values() if table.sensor and table.sensor.reads_place),
            next(iter(tables.values())),
        )

    @property
    def files(self) -> tuple[Path, ...]:
        """The input files of the result."""
        from pincal.cli.motion_options import input_files

        return (self.model, *input_files([self.data]))


@dataclass(frozen=True, kw_only=True)
class DiagnoseArguments(_NewRows):
    """Arguments of diagnose."""

    alpha: float = option("Probability of a false alarm.", 0.01)
    noise: float | None = option(
        "Noise of one coordinate of the new measurements, if larger than that of the calibration.",
        type=LENGTH,
        words="that of the calibration",
    )
    noise_angle: float | None = _noise_angle_option()


@verb(DiagnoseArguments, examples=_DIAGNOSE_EXAMPLES, exits=(Exit.UNDECIDED, Exit.CHANGED))
def diagnose_verb(arguments: DiagnoseArguments) -> Exit:
    """Find out whether a calibrated robot has changed, and what.

    Ten to sixty poses are enough: the calibration, with its uncertainty, serves as prior knowledge.
    """
    from pincal.calibration.fitted_robot import load_model
    from pincal.cli.progress import console
    from pincal.cli.screen import print_doubts
    from pincal.diagnosis.diagnosis_page import curve_table, lines
    from pincal.diagnosis.robot_diagnosis import diagnose
    from pincal.notes import doubts_of

    calibrated = load_model(arguments.model)
    table = arguments.read(calibrated.robot_model().model.chain.robot)
    with output_folder(arguments.out) as draft:
        found = diagnose(
            calibrated,
            table,
            alpha=arguments.alpha,
            sigma=arguments.noise,
            sigma_orientation=arguments.noise_angle,
        )
        write_diagnosis(draft, found, provenance(arguments.files))
    if arguments.general.as_json:
        print_json(found.report)
    else:
        print_doubts(found.found.warnings, console())
        for line in lines(found.found):
            click.echo(line)
        if found.found.curves is not None:
            console().print(curve_table(found.found.curves))
        click.echo(f"written to {arguments.out}: diagnosis.json model.json report.html")
    echo_notes(found.found.warnings, quiet=arguments.general.quiet)
    if not found.found.is_judged:
        raise IdentificationError(
            f"not judged: {'; '.join(map(str, doubts_of(found.found.warnings)))}"
        )
    return Exit.CHANGED if found.changed else Exit.DONE


def write_diagnosis(folder: Path, diagnosis: Diagnosis, origin: dict[str, Any]) -> None:
    """Write ``diagnosis.json``, the page and the re-identified model with its origin."""
    from pincal.diagnosis.diagnosis_page import diagnosis_page
    from pincal.io.strict_json import write_json

    replace(diagnosis.model, provenance=origin).save(folder / "model.json")
    write_json(folder / "diagnosis.json", diagnosis.report)
    (folder / "report.html").write_text(
        diagnosis_page(diagnosis, version=origin["pincal"]), encoding="utf-8"
    )


@dataclass(frozen=True, kw_only=True)
class UpdateArguments(_NewRows):
    """Arguments of update."""

    noise: float | None = option(
        "Noise of one coordinate of the new measurements.",
        type=LENGTH,
        words="as declared for the calibration, else estimated",
    )
    noise_angle: float | None = _noise_angle_option()
    anew: tuple[str, ...] = option(
        "Re-estimate this effect of the model, named as by diagnose; no test for changes is made.",
        (),
        metavar="EFFECT[:JOINT]",
    )


@verb(UpdateArguments, examples=_UPDATE_EXAMPLES, exits=(Exit.UNDECIDED, Exit.CHANGED))
def update_verb(arguments: UpdateArguments) -> Exit:
    """Add new measurements to a calibrated model permanently.

    The result equals a calibration from old and new rows together, but does not need the old ones.
    Rows of a robot that has changed are refused (exit code 6): see diagnose. With --anew, the named
    effect is re-estimated from its prior.
    """
    from pincal.calibration.day_notes import notes_on_day
    from pincal.calibration.fitted_robot import load_model
    from pincal.diagnosis.model_update import update
    from pincal.validate.accuracy import error_summary

    stations = load_model(arguments.model)
    table = arguments.read(stations.robot_model().model.chain.robot)
    calibrated = stations.robot_model(table.kind)
    with output_folder(arguments.out) as draft:
        found = update(
            calibrated,
            table,
            sigma=arguments.noise,
            sigma_orientation=arguments.noise_angle,
            anew=arguments.anew,
        )
        replace(found, provenance=provenance(arguments.files)).save(draft / "model.json")
    error = error_summary(found.readings(table), found.values)
    if arguments.general.as_json:
        print_json({"rows": len(table), "error": error, "out": str(arguments.out)})
    else:
        anew = f", {', '.join(arguments.anew)} re-estimated" if arguments.anew else ""
        click.echo(f"{len(table)} rows added{anew}; mean error {error['mean_mm']:.4f} mm")
        click.echo(f"written to {arguments.out}: model.json")
    echo_notes(notes_on_day(calibrated, table), quiet=arguments.general.quiet)
    return Exit.DONE
