"""``pincal interim``: a few points measured again, and whether the robot is as it was."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from datetime import date, timedelta
from math import exp, log
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pincal.atomic import one_at_a_time
from pincal.cli.arguments import Output, argument, group, option, verb
from pincal.cli.common import GeneralOptions, TableArguments, model_argument
from pincal.cli.identity_options import HEADING, IdentityOptions
from pincal.cli.outputs import echo_notes, print_json
from pincal.cli.quantities import LENGTH
from pincal.errors import BadInputError, Exit
from pincal.thresholds import Count

if TYPE_CHECKING:
    from pincal.calibration.check_record import CheckedChange, CheckRecord, InterimCheck
    from pincal.calibration.fitted_robot import FittedRobot
    from pincal.measure.measurements import Measurements

# Characters of a calibration's fingerprint in the name of its record.
_MARK: Count = 8
# Other explanations that are named.
_NAMED: Count = 4
_EXAMPLES = """
Examples:
  pincal interim results/model.json today.csv
  pincal interim results/model.json today.csv --new-station --set id.operator="A. Smith"
  pincal interim results/model.json bar.csv --record checks/R17.json --false-alarms 0.01
  pincal interim results/model.json --withdraw 2026-11-29 --reason "nest of the target was loose"

TODAY.csv is a table like that of the calibration: the same targets, or the same sockets or
artefact, in three poses or more, such as the same few every day. Each check is added to
model.checks.json beside the model, with who took it if that is stated (--set id.operator=NAME), and
judged together with all before: measure refuses a model whose last check failed, and its
uncertainties include the drift since the calibration. A check that was wrong for a reason of its
own can be withdrawn: the record keeps it with the reason, and what was checked later is judged
again without it.
"""


_SHOWN = (
    "station",
    "new_station",
    "record",
    "day",
    "withdraw",
    "reason",
    "false_alarms",
    "noise",
    "as_json",
    "quiet",
)


@dataclass(frozen=True, kw_only=True)
class InterimArguments:
    """Arguments of interim."""

    model: Path = model_argument()
    data: Path | None = argument(
        "[TODAY.csv]", "Measurements of a few poses, as those of the calibration.", required=False
    )
    station: str | None = option(
        "Station of the calibration, with whose instrument and target the rows were measured.",
        metavar="NAME",
        words="the first one with such readings",
    )
    new_station: bool = option(
        "The instrument was set up anew: its place is taken from the rows, so that a moved base "
        "does not show.",
        False,
    )
    record: Path | None = option(
        "Record of all checks.",
        metavar="FILE.json",
        type=Output(".json"),
        words="model.checks.json beside the model",
    )
    day: str | None = option("Day of the check.", metavar="YYYY-MM-DD", words="today")
    withdraw: str | None = option(
        "In place of a check: withdraw an earlier one, by its day or its number.",
        metavar="DAY|NUMBER",
    )
    reason: str | None = option("Why it is withdrawn.", metavar="TEXT")
    false_alarms: float = option(
        "Probability of any false alarm over the whole life of the calibration, however often it "
        "is checked.",
        0.05,
    )
    noise: float | None = option(
        "Noise of one coordinate of the new measurements.",
        type=LENGTH,
        words="that of the calibration",
    )
    identity: IdentityOptions = group(HEADING)
    table: TableArguments = group("Tables")
    general: GeneralOptions = group("General")


@verb(InterimArguments, examples=_EXAMPLES, exits=(Exit.CHANGED,), shown=_SHOWN)
def interim_verb(arguments: InterimArguments) -> Exit:
    """Check a calibrated robot at intervals, by a few points.

    Tells whether anything has moved since the calibration, and what: the base, the tool, a joint,
    or all lengths, as by temperature. The noise need not be known, and a base that walks by
    micrometres a day is drift, which adds to uncertainties, and no alarm. The exit code is 6 after
    an alarm.
    """
    from pincal.calibration.check_record import record_path
    from pincal.calibration.fitted_robot import load_model
    from pincal.cli.inputs import load_table
    from pincal.cli.progress import console
    from pincal.cli.screen import print_lines

    _require_one_task(arguments)
    fitted = load_model(arguments.model)
    notes = list(arguments.identity.of_model(fitted.identity, arguments.model))
    path = arguments.record or record_path(arguments.model)
    robot = fitted.robot_model().model.chain.robot
    table = None
    if arguments.data is not None:
        table = load_table(robot, arguments.data, options=arguments.table.options)
    # Of two runs at once, the later one would replace the check of the other.
    with one_at_a_time(path.parent) if path.parent.is_dir() else nullcontext():
        if table is None:
            record = _withdrawn(arguments, fitted, path)
            note = None
        else:
            record, note = _recorded(arguments, fitted, table, path)
    notes += [note] if note is not None else []
    if arguments.general.as_json:
        print_json(as_plain(record))
    else:
        print_lines(lines_of(record), console())
        click.echo(f"written to {path}")
    echo_notes(notes, quiet=arguments.general.quiet)
    last = record.last
    return Exit.CHANGED if last is not None and last.has_failed else Exit.DONE


def _require_one_task(arguments: InterimArguments) -> None:
    """Refuse a command that neither checks nor withdraws, or both.

    Raises:
        click.UsageError: with what is expected.
    """
    if arguments.withdraw is None:
        if arguments.data is None:
            raise click.UsageError("Missing argument 'TODAY.csv'")
        if arguments.reason is not None:
            raise click.UsageError("--reason: of what? Expected --withdraw DAY with it")
    elif arguments.data is not None:
        raise click.UsageError("--withdraw: takes no table; expected two commands, one for each")
    elif not (arguments.reason or "").strip():
        raise click.UsageError("--withdraw: why? Expected --reason TEXT, which the record keeps")


def _withdrawn(arguments: InterimArguments, fitted: FittedRobot, path: Path) -> CheckRecord:
    """Withdraw a check, write the record, and return it.

    Raises:
        BadInputError: if there is no such check of this calibration.
    """
    from pincal.calibration.check_record import record_of
    from pincal.fleet.checked_robot import CheckedRobot

    record, other = record_of(fitted, path)
    if record is None:
        why = "no record there" if other is None else "its checks are of another calibration"
        raise BadInputError(f"{path}: {why}; expected that of {arguments.model}: --record FILE")
    robot = CheckedRobot.of(fitted, record)
    try:
        number = record.number_of(str(arguments.withdraw))
    except BadInputError as error:
        raise BadInputError(f"{path}: --withdraw {error}") from None
    found = robot.withdrawn(str(number), str(arguments.reason), _day(arguments)).record
    found.save(path)
    return found


def _recorded(
    arguments: InterimArguments, fitted: FittedRobot, table: Measurements, path: Path
) -> tuple[CheckRecord, str | None]:
    """Judge a table together with all before, and write the record; return it, and a note where
    the file was of another calibration.
    """
    from pincal.calibration.check_record import record_of
    from pincal.fleet.checked_robot import CheckedRobot

    record, other = record_of(fitted, path)
    day = _day(arguments)
    _require_later(record, day, path)
    checked = CheckedRobot.of(fitted, record).checked(
        table,
        day,
        station=arguments.station,
        is_new_station=arguments.new_station,
        sigma=arguments.noise,
        false_alarms=arguments.false_alarms,
    )
    note = None if other is None else f"{other}; kept as {kept_aside(path)}"
    found = checked.record
    # What the cell file states is of the calibration.
    if stated := arguments.identity.without_cell:
        found = found.with_identity(stated)
    found.save(path)
    return found, note


def _day(arguments: InterimArguments) -> str:
    """Return the day of a check.

    Raises:
        BadInputError: for none, and for one to come: checks of today would then be refused as
            earlier.
    """
    from pincal.calibration.check_record import required_day

    today = date.today()
    try:
        required_day(arguments.day or today.isoformat())
    except BadInputError as error:
        raise BadInputError(f"--day: {error}") from None
    # Where it is tomorrow already.
    latest = (today + timedelta(days=1)).isoformat()
    if arguments.day is not None and arguments.day > latest:
        raise BadInputError(
            f"--day {arguments.day}: is to come; expected the day of the readings, {today} at the "
            "latest"
        )
    return arguments.day or today.isoformat()


def _require_later(record: CheckRecord | None, day: str, path: Path) -> None:
    """Refuse a day before the last check of a record.

    Raises:
        BadInputError: with both, and the record.
    """
    last = None if record is None else record.last
    if last is not None and day < last.day:
        raise BadInputError(
            f"--day {day}: the last check in {path} is of {last.day}; expected this day or a later "
            "one; if that check has a wrong day, withdraw it (--withdraw) and check its table again"
        )


def kept_aside(path: Path) -> Path:
    """Copy the record of another calibration to a name of its own, and return it."""
    from pincal.calibration.check_record import load_record

    found = load_record(path)
    place = path.with_name(f"{path.stem}.{found.model[:_MARK]}.json")
    found.save(place)
    return place


def as_plain(record: CheckRecord) -> dict[str, Any]:
    """Return the last check that counts in JSON types, without its rows, and which do not."""
    import msgspec

    withdrawn = [
        {"check": number, "day": check.day, **msgspec.to_builtins({"withdrawn": check.withdrawn})}
        for number, check in enumerate(record.checks, 1)
        if check.withdrawn is not None
    ]
    others = {"withdrawn": withdrawn} if withdrawn else {}
    check = record.last
    if check is None:
        return {"check": None, **others}
    found: dict[str, Any] = msgspec.to_builtins(check)
    rows = found.pop("rows")
    kept = ("day", "table", "station", "is_new_station", "identity")
    of_rows = {name: rows[name] for name in kept if name in rows}
    return {"check": _number(record), **of_rows, **found, **others}


def _number(record: CheckRecord) -> int:
    """Return the number of the last check that counts."""
    return max(n for n, check in enumerate(record.checks, 1) if check.withdrawn is None)


def lines_of(record: CheckRecord) -> Iterator[tuple[str, str]]:
    """Yield what the last check of a record that counts shows, and which do not count: headings and
    lines.
    """
    check = record.last
    if check is not None:
        yield from _lines_of_check(record, check)
    if record.withdrawn_words:
        yield "withdrawn", record.withdrawn_words
    yield "next", _next(check)


def _lines_of_check(record: CheckRecord, check: InterimCheck) -> Iterator[tuple[str, str]]:
    rows = check.rows
    placed = "instrument set up anew" if rows.is_new_station else "as calibrated"
    poses = len(rows.columns["q"])
    yield "checked", f"{poses} poses of {record.robot} on {check.day}{check.by}, {placed}"
    yield "check", f"number {_number(record)} since the calibration"
    scale, unit = (1e3, "mm") if check.unit == "m" else (1.0, check.unit)
    yield (
        "error",
        f"{check.error * scale:.3g} {unit} rms a coordinate, {check.largest * scale:.3g} {unit} at "
        "most",
    )
    yield (
        "expected",
        f"U = {check.expanded * scale:.3g} {unit} (k = 2) a coordinate; {check.within} of "
        f"{check.of} within theirs; noise {check.noise:.2g} times what is stated",
    )
    yield (
        "evidence",
        f"readings {odds(check.log_e)} times as likely if something has changed; an alarm from "
        f"{check.limit:.3g} on",
    )
    yield "verdict", "ALARM: not as calibrated" if check.has_failed else "no change found"
    yield "drift", f"u = {check.drift * 1e3:.2g} mm of a coordinate since the calibration"
    if check.change is not None:
        yield "moved", moved_words(check.change)


def odds(log_e: float) -> str:
    """Return evidence as a number.

    Example:
        >>> odds(-2.0), odds(log(250.0)), odds(60.0)
        ('0.14', '250', '10^26')
    """
    if log_e >= log(1e6):
        return f"10^{log_e / log(10.0):.0f}"
    rounded = f"{exp(log_e):.2g}"
    return f"{float(rounded):.0f}" if float(rounded) >= 10.0 else rounded


def moved_words(change: CheckedChange) -> str:
    """Return what has moved in words, with sizes and standard deviations.

    Example:
        >>> from pincal.calibration.check_record import CheckedChange
        >>> size = {"offset": (1e-4, 1e-5, "rad")}
        >>> moved_words(CheckedChange(what="joint_3", since="2026-11-13", sizes=size))
        'joint_3: offset 0.1 mrad (u 0.01) since 2026-11-13'
    """
    sizes = [
        f"{name} {_readable(value, unit)} (u {_readable(sigma, unit).split()[0]})"
        for name, (value, sigma, unit) in change.sizes.items()
    ]
    about = f": {', '.join(sizes)}" if sizes else ""
    others = f"; or {', '.join(change.equals[:_NAMED])}" if change.equals else ""
    return f"{change.what}{about} since {change.since}{others}"


def _readable(value: float, unit: str) -> str:
    if unit == "1":
        return f"{value * 1e6:.3g} um/m"
    return f"{value:.3g} K" if unit == "K" else f"{value * 1e3:.3g} m{unit}"


def _next(check: InterimCheck | None) -> str:
    """Return what to do after a check, or after all of them were withdrawn."""
    if check is None:
        return "check the robot: none of its checks counts"
    if not check.has_failed:
        return "measure on; its uncertainties include the drift"
    return (
        "repeat the check to exclude a wrong reading; pincal diagnose with ten or more poses tells "
        "more; then pincal calibrate"
    )
