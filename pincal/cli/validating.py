"""``pincal validate``: how accurate a calibrated robot is on new rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pincal.cli.arguments import argument, group, verb
from pincal.cli.common import (
    GeneralOptions,
    TableArguments,
    max_error_option,
    model_argument,
    noise_angle_option,
    station_option,
)
from pincal.cli.identity_options import HEADING, IdentityOptions
from pincal.cli.outputs import echo_notes, extrapolation, print_json, require_accuracy
from pincal.cli.streams import MOTION, Streams
from pincal.cli.tested_rows import ACCEPTANCE, TestedRows
from pincal.errors import Exit

if TYPE_CHECKING:
    from rich.console import Console

    from pincal.calibration.fitted_robot import FittedRobot
    from pincal.calibration.validation import Validation
    from pincal.notes import Note


_VALIDATE_EXAMPLES = """
Examples:
  pincal validate results/model.json new_measurements.csv --max-error 0.1mm
  pincal validate results/model.json monday.csv tuesday.csv

Instrument and target are assumed to be where they were at calibration unless the rows indicate
another placement, which is then identified from them and reported as a displacement; the errors
refer to it. If no placement explains the rows, they belong to another robot, or it has changed:
exit code 6; run pincal diagnose. Of several tables, those that the model was not fitted to come
first, and --max-error applies to them.
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
    noise_angle: float | None = noise_angle_option()
    table: TableArguments = group("Tables")
    motion: Streams = group(MOTION, is_handed_in=True)
    identity: IdentityOptions = group(HEADING)
    acceptance: TestedRows = group(ACCEPTANCE, is_handed_in=True)
    general: GeneralOptions = group("General")


@verb(
    ValidateArguments,
    examples=_VALIDATE_EXAMPLES,
    exits=(Exit.INACCURATE, Exit.CHANGED),
    shown=(
        "station",
        "max_error",
        "noise_angle",
        "orientation",
        "acceptance",
        "mpe",
        "mpe_location",
        "as_json",
        "quiet",
    ),
)
def validate(arguments: ValidateArguments) -> Exit:
    """Report how accurate a model is on new readings.

    The instrument may be anywhere: its placement is identified from the rows.
    """
    from pincal.calibration.fitted_robot import load_model

    calibrated = load_model(arguments.model)
    unchecked = tuple(arguments.identity.of_model(calibrated.identity, arguments.model))
    # That rows bear out what a model states does not say that the model is complete.
    stated = () if calibrated.statement is None else tuple(calibrated.statement.notes())
    found = _validated(calibrated, arguments)
    if arguments.acceptance.is_wanted:
        general = arguments.general
        code = arguments.acceptance.judge(found, as_json=general.as_json, quiet=general.quiet)
        _refuse_others(found, arguments.model)
        return code
    result, notes = _result(found)
    if arguments.general.as_json:
        print_json(result)
    else:
        _print(found, result, notes)
    echo_notes([*notes, *unchecked, *stated], quiet=arguments.general.quiet)
    _refuse_others(found, arguments.model)
    require_accuracy(result.get("mean_mm"), arguments.max_error, rows="new")
    return Exit.DONE


def _validated(calibrated: FittedRobot, arguments: ValidateArguments) -> list[Validation]:
    """Return the validation of a model by the rows of each station."""
    from pincal.calibration.validation import validate_rows
    from pincal.cli.inputs import load_tables
    from pincal.measure.admit import check_table

    chosen = arguments.station
    models = calibrated.each if chosen is None else (calibrated.at(chosen),)
    robot = models[0].model.chain.robot
    tables = load_tables(
        robot, arguments.data, options=arguments.table.options, motion=arguments.motion
    )
    for table in tables.values():
        check_table(robot, table, minimum=1)
    return [
        validate_rows(
            models, table, name=name, refit=chosen is None, sigma_orientation=arguments.noise_angle
        )
        for name, table in tables.items()
    ]


def _refuse_others(found: Sequence[Validation], model: Path) -> None:
    """Refuse rows that are not of the robot as it was calibrated."""
    from pincal.cli.inputs import other_robot

    if doubts := [each.doubt for each in found if each.doubt]:
        raise other_robot("; ".join(doubts), model)


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
    beyond, beyond_notes = _extrapolated(found)
    # Entries of a single station are repeated at top level.
    alone = {
        key: stations[0][key]
        for key in ("iso9283", "characteristics", "path", "lack_of_fit")
        if len(found) == 1 and key in stations[0]
    }
    notes = doubts_first([*(note for each in found for note in each.notes), *beyond_notes])
    contents = {
        "verdict": worst(each.verdict for each in found),
        "warnings": to_builtins(notes),
        "rows": {"test": sum(len(each.table) for each in unseen)},
        **{name: value for name, value in error.items() if name == "mean_mm"},
        "stations": stations,
        "error": {"calibrated": {"test": error}},
    }
    return contents | alone | beyond, notes


def _extrapolated(found: list[Validation]) -> tuple[dict[str, Any], list[str]]:
    """Return where the rows of all stations are outside the range of the calibration, for
    ``--json`` and in words.
    """
    ranges = [extrapolation(each.model, each.station.conditions, each.table.rows) for each in found]
    contents = {"outside": sum(part["outside"] for part, _ in ranges)} | {
        name: [curve for part, _ in ranges for curve in part[name]] for name in ("curves", "gaps")
    }
    return contents, [note for _, notes in ranges for note in notes]


def _station(found: Validation) -> dict[str, Any]:
    iso, lack = found.replicate_statistics()
    contents = {
        "name": found.name,
        "kind": found.table.kind,
        "rows": len(found.table),
        "placed": found.placed,
    }
    contents |= found.moved.to_dict() | {"error": found.error, "intervals": found.intervals}
    contents |= {"fitted_rows": found.fitted_rows}
    contents |= {
        "misfit": {"ratio": found.misfit.ratio, "p_value": found.misfit.p_value},
        "doubt": found.doubt or None,
    }
    contents |= {"verdict": found.verdict}
    more = {"by_coverage": found.by_coverage, "iso9283": iso, "path": found.path_accuracy}
    more |= {"lack_of_fit": None if lack is None else asdict(lack)}
    more |= {"characteristics": found.characteristics or None}
    return contents | {name: value for name, value in more.items() if value is not None}


def _print(found: list[Validation], result: dict[str, Any], notes: Sequence[Note]) -> None:
    """Print the doubts, the placement of each station, and its errors."""
    from pincal.calibration.result_tables import error_table
    from pincal.cli.progress import console
    from pincal.cli.screen import print_doubts
    from pincal.result_table import hanging
    from pincal.validate.path_accuracy import path_words
    from pincal.validate.pose_characteristics import interval_words

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
        out.print(hanging(f"{each.name}:", f"{_place_words(each)}; {_JUDGED[each.verdict]}"))
    out.print(error_table(_errors(found, result)))
    for each in found:
        if each.by_coverage is not None:
            out.print(hanging(f"{each.name}:", _coverage_words(each.by_coverage)))
        out.print(hanging(f"{each.name}:", interval_words(each.intervals)))
        _print_repeated(each, out)
        if (path := each.path_accuracy) is not None:
            out.print(hanging("path:", path_words(path)))


def _print_repeated(found: Validation, out: Console) -> None:
    """Print what visits of the same poses tell."""
    from pincal.calibration.result_tables import characteristics_table
    from pincal.cli.screen import print_replicates
    from pincal.result_table import hanging
    from pincal.validate.accuracy import cycle_words

    iso, lack = found.replicate_statistics()
    has_angles = iso is not None and "AP_a_mrad" in iso["per_pose"][0]
    if found.characteristics:
        out.print(characteristics_table(found.characteristics))
    if iso is not None and found.characteristics and not has_angles:
        out.print(hanging("cycles:", cycle_words(iso)))
        iso = None
    print_replicates(iso, lack, out)


# What a verdict says of rows, by its value.
_JUDGED = {
    "adequate": "errors are no larger than the model states: adequate",
    "not adequate": "errors are larger than the model states: not adequate",
    "not judged": "not judged",
}


def _place_words(found: Validation) -> str:
    if found.placed == "as calibrated":
        return "instrument and target are where they were at calibration"
    return f"instrument and target were located again from these rows: {found.moved}"


def _errors(found: list[Validation], result: dict[str, Any]) -> dict[str, Any]:
    """Return the errors for the table: of each station, or of the only one by what its rows were
    for the calibration.
    """
    if len(found) > 1:
        return {"calibrated": {part["name"]: part["error"] for part in result["stations"]}}
    (alone,) = found
    if not alone.fitted_rows:
        return dict(result["error"])
    name = "train" if alone.fitted_rows == len(alone.table) else "new and fitted"
    return {"calibrated": {name: alone.error}}


def _coverage_words(split: dict[str, Any]) -> str:
    inside = split["determined"]
    elsewhere = split["elsewhere"]
    return (
        f"mean {inside['mean']:.4f} {split['unit']} at the {inside['rows']} "
        "poses where the calibration had "
        f"determined the curve of every drive, {elsewhere['mean']:.4f} "
        f"{split['unit']} at the others"
    )
