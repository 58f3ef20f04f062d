"""``pincal validate``: the accuracy of a calibrated model on new measurements."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pincal.cli.arguments import argument, group, verb
from pincal.cli.common import GeneralOptions, TableArguments, max_error_option, model_argument, station_option
from pincal.cli.outputs import extrapolation, print_doubts, print_json, print_notes, require_accuracy
from pincal.errors import Exit

if TYPE_CHECKING:
    from pincal.calibration.validation import Validation
    from pincal.notes import Note

_EXAMPLES = """
Examples:
  pincal validate results/model.json new_measurements.csv --max-error 0.1mm
  pincal validate results/model.json monday.csv tuesday.csv

Instrument and target stand as they were calibrated unless the rows call for another place; then it is
found from them, and how far they moved is told. The errors are those at this place. If no place
explains the rows, they are of another robot, or it has changed: exit code 6; ask pincal diagnose.
Of several tables those that the model never saw come first, and --max-error is about these.
"""


@dataclass(frozen=True, kw_only=True)
class ValidateArguments:
    """Arguments of validate."""

    model: Path = model_argument()
    data: tuple[Path, ...] = argument(
        "DATA.csv...", "Measurements that the calibration did not use. Several tables are a station each."
    )
    station: str | None = station_option(words="the nearest, or a new place if the rows call for it")
    max_error: float | None = max_error_option()
    table: TableArguments = group("Tables")
    general: GeneralOptions = group("General")


@verb(ValidateArguments, examples=_EXAMPLES, exits=(Exit.INACCURATE, Exit.CHANGED))
def validate(arguments: ValidateArguments) -> Exit:
    """Report how accurate a calibrated model is on new measurements.

    The instrument may stand anywhere: its place is found from the rows.
    """
    from pincal.calibration.stations import load_stations
    from pincal.calibration.validation import validate_rows
    from pincal.cli.inputs import load_stations as load_tables
    from pincal.cli.places import tell_doubt
    from pincal.measure.checks import check_table

    calibrated = load_stations(arguments.model)
    chosen = arguments.station
    models = list(calibrated.models.values()) if chosen is None else [calibrated.at(chosen)]
    robot = models[0].model.chain.robot
    tables = load_tables(robot, arguments.data, options=arguments.table.options)
    for table in tables.values():
        check_table(robot, table, minimum=1)
    found = [validate_rows(models, table, name=name, refit=chosen is None) for name, table in tables.items()]
    result, notes = _result(found)
    if arguments.general.as_json:
        print_json(result)
    else:
        print_doubts(notes)
        _print(found, result)
    print_notes(notes, quiet=arguments.general.quiet)
    doubts = [each.doubt for each in found if each.doubt]
    if doubts:
        tell_doubt("; ".join(doubts), arguments.model)
        return Exit.CHANGED
    require_accuracy(result["mean_mm"], arguments.max_error, rows="new")
    return Exit.DONE


def _result(found: list[Validation]) -> tuple[dict[str, Any], tuple[Note, ...]]:
    """Return the outcome for programs, and what the user should know: of the rows, and of those beyond the range."""
    from msgspec import to_builtins

    from pincal.notes import doubts_first
    from pincal.validate.accuracy import error_statistics, pose_error_sizes
    from pincal.validate.verdict import worst

    # Rows that the model was fitted to say nothing of a day that it never saw: where there are others, these count.
    unseen = [each for each in found if not each.fitted_rows] or found
    error = error_statistics(pose_error_sizes(each.station, each.values) for each in unseen)
    stations = list(map(_station, found))
    ranges = [extrapolation(each.model, each.station.conditions, each.table.rows) for each in found]
    beyond = {
        "outside": sum(part["outside"] for part, _ in ranges),
        "curves": [curve for part, _ in ranges for curve in part["curves"]],
    }
    # Of a single station what it says stands at the top as well.
    alone = {key: stations[0][key] for key in ("iso9283", "lack_of_fit") if len(found) == 1 and key in stations[0]}
    notes = doubts_first([*(note for each in found for note in each.notes), *(n for _, part in ranges for n in part)])
    contents = {
        "verdict": worst(each.verdict for each in found),
        "warnings": to_builtins(notes),
        "rows": {"test": sum(len(each.table) for each in unseen)},
        "mean_mm": error["mean_mm"],
        "stations": stations,
        "error": {"calibrated": {"test": error}},
    }
    return contents | alone | beyond, notes


def _station(found: Validation) -> dict[str, Any]:
    """Return what is said of one station."""
    iso, lack = found.replicate_statistics()
    contents = {"name": found.name, "kind": found.table.kind, "rows": len(found.table), "placed": found.placed}
    contents |= found.moved.to_dict() | {"error": found.error}
    contents |= {"fitted_rows": found.fitted_rows}
    contents |= {"misfit": {"ratio": found.misfit.ratio, "p_value": found.misfit.p_value}, "doubt": found.doubt or None}
    contents |= {"verdict": found.verdict}
    contents |= {} if iso is None else {"iso9283": iso}
    return contents | ({} if lack is None else {"lack_of_fit": asdict(lack)})


def _print(found: list[Validation], result: dict[str, Any]) -> None:
    """Print where the stations are, and the errors there."""
    from pincal.calibration.tables import error_table
    from pincal.cli.progress import console
    from pincal.cli.tables import print_replicates
    from pincal.tables import hanging

    out = console()
    unseen = [each.name for each in found if not each.fitted_rows]
    if len(found) > 1 and unseen:
        out.print(hanging("never seen", f"by the model: {', '.join(unseen)}: mean {result['mean_mm']:.4f} mm"))
    for each in found:
        out.print(hanging(f"{each.name}:", f"{_place_words(each)}; {each.verdict}"))
    parts = {part["name"]: part["error"] for part in result["stations"]}
    if len(found) == 1 and found[0].fitted_rows:
        parts = {"train" if found[0].fitted_rows == len(found[0].table) else "new and fitted": found[0].error}
        out.print(error_table({"calibrated": parts}))
    else:
        out.print(error_table({"calibrated": parts} if len(found) > 1 else result["error"]))
    for each in found:
        print_replicates(*each.replicate_statistics(), out)


def _place_words(found: Validation) -> str:
    if found.placed == "as calibrated":
        return "instrument and target stand as calibrated"
    return f"instrument and target were placed again from these rows: {found.moved}"
