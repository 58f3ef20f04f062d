"""The record of interim checks of a calibrated robot: ``model.checks.json`` beside its model.

Each check has its rows, so that all of them can be judged together later on. The record belongs to
one calibration, by a fingerprint of its content: of a robot that was calibrated again it says
nothing.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec
import numpy as np

from pincal.errors import BadInputError
from pincal.identity import Identity, is_day
from pincal.io.strict_json import FileKind, read_json, write_json
from pincal.measure.measurements import Measurements, validated
from pincal.thresholds import Count
from pincal.units import LARGEST

if TYPE_CHECKING:
    from pincal.calibration.fitted_robot import FittedRobot

CheckVerdict = Literal["checked", "alarm"]
# Numbers of checks that a message lists.
_LISTED: Count = 6
_FINGERPRINT = re.compile("[0-9a-f]{64}")
CHECKED: CheckVerdict = "checked"
ALARM: CheckVerdict = "alarm"
_FILE = FileKind(
    "a record of interim checks (model.checks.json)",
    BadInputError,
    "take the file from a backup, or move it away and begin a new record",
)


class CheckedChange(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What has moved, where a check raised an alarm.

    Attributes:
        what: "base", "tool", "temperature", a joint, "link of JOINT", or "several".
        joint: the joint, if it is of one.
        since: day of the first check after it.
        sizes: by name of what moved, with its unit: [value, standard deviation, unit].
        equals: what explains the readings as well.
    """

    what: str
    since: str
    joint: str | None = None
    sizes: dict[str, tuple[float, float, str]] = {}
    equals: tuple[str, ...] = ()


class CheckedRows(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The rows of a check, from which it can be judged again.

    Attributes:
        day: ISO date.
        table: name of its table.
        mark: SHA-256 of its rows.
        station: of the calibration; "" for the first one with such readings.
        is_new_station: whether the instrument was set up anew.
        joints: names of the joints.
        columns: arrays of the table by name; the means of stops.
        sigma: standard deviation of the readings that was stated, of each block [m, rad, px].
        identity: what was stated of the check: who took it, by which instrument.
    """

    day: str
    table: str
    mark: str
    station: str = ""
    is_new_station: bool = False
    joints: tuple[str, ...]
    columns: dict[str, list[Any]]
    sigma: tuple[float, ...]
    identity: Identity = Identity()

    @classmethod
    def of(
        cls,
        table: Measurements,
        day: str,
        sigma: Iterable[float],
        *,
        station: str = "",
        is_new_station: bool = False,
    ) -> CheckedRows:
        """Return the rows of a table.

        Raises:
            BadInputError: if the day is no ISO date.
        """
        columns = {name: array.tolist() for name, array in table.columns().items()}
        return cls(
            day=required_day(day),
            table=table.source,
            mark=_mark(columns),
            station=station,
            is_new_station=is_new_station,
            joints=table.joint_names,
            columns=columns,
            sigma=tuple(map(float, sigma)),
        )

    def measurements(self) -> Measurements:
        """Return the table.

        Raises:
            BadInputError: if a column is none.
        """
        found = {name: _array(values) for name, values in self.columns.items()}
        n = len(self.columns.get("q", ()))
        arrays = {name: array for name, array in found.items() if array is not None}
        if not n or len(arrays) < len(found) or any(len(one) != n for one in arrays.values()):
            raise BadInputError(
                f"the check of {self.day} in the record has columns that are no rows of one table; "
                "take the file from a backup, or begin a new record"
            )
        if "approach" in arrays:
            arrays["approach"] = arrays["approach"].astype(np.int8)
        if "rows" in arrays:
            arrays["rows"] = arrays["rows"].astype(int)
        return validated(self.joints, arrays, source=self.table, units={})


class Withdrawal(msgspec.Struct, frozen=True, kw_only=True):
    """That a check does not count, though the record keeps it.

    Attributes:
        day: on which it was withdrawn, an ISO date.
        reason: why.
    """

    day: str
    reason: str


class InterimCheck(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One interim check: its rows, and what all checks up to it show.

    Attributes:
        rows: of the check.
        verdict: "checked" where nothing speaks against the model, or "alarm".
        log_e: logarithm of the evidence that the robot has changed.
        limit: evidence from which on there is an alarm, the inverse of the rate of false ones.
        error: root mean square of a coordinate, reading minus prediction [unit].
        expanded: uncertainty that was expected of it, k = 2 [unit].
        largest: largest coordinate [unit].
        unit: of these.
        within: coordinates within their own expanded uncertainty.
        of: number of coordinates.
        noise: of the readings in units of what was stated, as all checks show it.
        drift: standard uncertainty of a coordinate of a position by what has moved since the
            calibration [m].
        change: what has moved, after an alarm.
        withdrawn: that it does not count, and why; what it showed is as of its own day.
    """

    rows: CheckedRows
    verdict: CheckVerdict
    log_e: float
    limit: float
    error: float
    expanded: float
    largest: float
    unit: str
    within: int
    of: int
    noise: float
    drift: float
    change: CheckedChange | None = None
    withdrawn: Withdrawal | None = None

    @property
    def day(self) -> str:
        """ISO date."""
        return self.rows.day

    @property
    def has_failed(self) -> bool:
        """Whether it raised an alarm."""
        return self.verdict == ALARM

    @property
    def words(self) -> str:
        """The check in words, for certificates and messages."""
        found = "no change found"
        if self.change is not None:
            found = f"ALARM, {self.change.what} moved"
        return f"{self.day}{self.by}: {found}"

    @property
    def by(self) -> str:
        """Who took it, after its day; "" if that was not stated."""
        operator = self.rows.identity.operator
        return f" by {operator}" if operator else ""


class CheckRecord(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """All interim checks of one calibration.

    Attributes:
        format: of the file.
        format_version: of the file.
        model: fingerprint of the calibrated model.
        robot: its name.
        checks: those that count in the order of their days, and those that were withdrawn.
    """

    format: Literal["pincal-checks"] = msgspec.field(default="pincal-checks")
    format_version: Literal[1] = 1
    model: str
    robot: str
    checks: tuple[InterimCheck, ...] = ()

    @property
    def last(self) -> InterimCheck | None:
        """The last check that counts; None before the first one."""
        return next((check for check in reversed(self.checks) if not check.withdrawn), None)

    @property
    def counting(self) -> tuple[InterimCheck, ...]:
        """The checks that were not withdrawn."""
        return tuple(check for check in self.checks if check.withdrawn is None)

    @property
    def withdrawn_words(self) -> str:
        """Which checks were withdrawn, and why; "" for none."""
        words = [
            f"number {number} of {check.day} ({check.withdrawn.reason})"
            for number, check in enumerate(self.checks, 1)
            if check.withdrawn is not None
        ]
        return ", ".join(words)

    def number_of(self, which: str) -> int:
        """Return the number of a check that counts, from 1, by its day or its number.

        Raises:
            BadInputError: if there is none, or several on this day.
        """
        numbers = [number for number, check in enumerate(self.checks, 1) if not check.withdrawn]
        found = [n for n in numbers if which in (str(n), self.checks[n - 1].day)]
        if len(found) == 1:
            return found[0]
        if found:
            listed = ", ".join(map(str, found))
            raise BadInputError(f"{which}: several checks, numbers {listed}; expected one of these")
        days = ", ".join(f"{n} ({self.checks[n - 1].day})" for n in numbers[-_LISTED:])
        raise BadInputError(
            f"{which}: no such check; expected the day or the number of one that counts: "
            f"{days or 'there is none'}"
        )

    def with_check(self, check: InterimCheck) -> CheckRecord:
        """Return the record with a further check.

        Raises:
            BadInputError: if it is of a day before the last one.
        """
        if self.last is not None and check.day < self.last.day:
            raise BadInputError(
                f"{check.rows.table}: measured on {check.day}, but the last check of the record is "
                f"of {self.last.day}; expected checks in the order of their days"
            )
        return msgspec.structs.replace(self, checks=(*self.checks, check))

    def with_identity(self, identity: Identity) -> CheckRecord:
        """Return the record with what was stated of its last check."""
        *before, last = self.checks
        rows = msgspec.structs.replace(last.rows, identity=identity)
        return msgspec.structs.replace(
            self, checks=(*before, msgspec.structs.replace(last, rows=rows))
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the record; an existing file is replaced only when the new one is complete.

        Raises:
            OutputError: if the file can't be written.
        """
        head = {"format": self.format, "format_version": self.format_version}
        write_json(path, head | msgspec.to_builtins(self), indent=None)


def required_day(day: str) -> str:
    """Return a day.

    Raises:
        BadInputError: if it is no ISO date.
    """
    if not is_day(day):
        raise BadInputError(f"day {day!r}; expected an ISO date such as 2026-11-03")
    return day


def _mark(columns: dict[str, list[Any]]) -> str:
    """Return the fingerprint of the rows of a check, whatever their file is called and whatever
    noise is stated.
    """
    content = {name: values for name, values in columns.items() if name not in ("rows", "sigma")}
    return hashlib.sha256(msgspec.json.encode(sorted(content.items()))).hexdigest()


def _array(values: list[Any]) -> np.ndarray | None:
    """Return a column as an array of numbers or of names; None if it is none."""
    try:
        found = np.array(values)
        is_text = found.dtype.kind == "U" and found.ndim == 1
        if is_text or found.dtype.kind == "O":
            return found if is_text else None
        found = found.astype(float)
    except (ValueError, TypeError):
        return None
    return found if found.ndim in (1, 2, 3) and (np.abs(found) <= LARGEST).all() else None


def model_mark(fitted: FittedRobot) -> str:
    """Return the fingerprint of a calibrated model, whatever is stated of it besides: SHA-256 of
    its parameters and their values.
    """
    estimate = fitted.estimate
    names = "\n".join(estimate.names)
    content = names.encode() + np.ascontiguousarray(estimate.values, "<f8").tobytes()
    return hashlib.sha256(content).hexdigest()


def record_path(model: str | os.PathLike[str]) -> Path:
    """Return the place of a model's record: beside it.

    Example:
        >>> record_path("results/model.json").as_posix()
        'results/model.checks.json'
    """
    path = Path(model)
    return path.with_name(f"{path.stem}.checks.json")


def load_record(path: str | os.PathLike[str]) -> CheckRecord:
    """Read a record.

    Raises:
        BadInputError: if the file can't be read, or a value is missing or invalid.
    """
    found = read_json(path, CheckRecord, _FILE)
    _require_fingerprint(f"{os.fspath(path)}: model", found.model)
    for number, check in enumerate(found.checks):
        where = f"{os.fspath(path)}: checks[{number}]"
        _require_rows(f"{where}.rows", check.rows)
        if check.withdrawn is not None:
            _require_withdrawal(f"{where}.withdrawn", check.withdrawn)
    return found


def _require_fingerprint(where: str, text: str) -> None:
    """Refuse a fingerprint that is none.

    Raises:
        BadInputError: with the key.
    """
    if not _FINGERPRINT.fullmatch(text):
        raise BadInputError(
            f"{where}: is {text!r}; expected a SHA-256, 64 digits from 0 to f; {_FILE.advice}"
        )


def _require_withdrawal(where: str, found: Withdrawal) -> None:
    """Refuse a withdrawal without a day or a reason.

    Raises:
        BadInputError: with the key.
    """
    if not is_day(found.day):
        raise BadInputError(
            f"{where}.day: is {found.day!r}; expected an ISO date such as 2026-11-03; "
            f"{_FILE.advice}"
        )
    if not found.reason.strip():
        raise BadInputError(f"{where}.reason: is empty; expected why; {_FILE.advice}")


def _require_rows(where: str, rows: CheckedRows) -> None:
    """Refuse rows of a record that was edited by hand, with a day or a noise that is none.

    Raises:
        BadInputError: with the key.
    """
    if not is_day(rows.day):
        raise BadInputError(
            f"{where}.day: is {rows.day!r}; expected an ISO date such as 2026-11-03; {_FILE.advice}"
        )
    _require_fingerprint(f"{where}.mark", rows.mark)
    if not rows.sigma or not all(0.0 < sigma <= LARGEST for sigma in rows.sigma):
        raise BadInputError(
            f"{where}.sigma: is {list(rows.sigma)}; expected positive numbers; {_FILE.advice}"
        )
    if len(set(rows.joints)) < len(rows.joints):
        raise BadInputError(
            f"{where}.joints: {', '.join(rows.joints)}; expected each joint once; {_FILE.advice}"
        )


def record_of(
    fitted: FittedRobot, path: str | os.PathLike[str]
) -> tuple[CheckRecord | None, str | None]:
    """Return the record of a calibrated model, None where there is none; and a note where the file
    belongs to another calibration.

    Args:
        fitted: the model, with all its stations.
        path: of the record.

    Raises:
        BadInputError: if there is a file that is no record.
    """
    if not Path(path).is_file():
        return None, None
    found = load_record(path)
    if found.model == model_mark(fitted):
        return found, None
    days = f", the last one of {found.last.day}," if found.last is not None else ""
    return None, (
        f"{os.fspath(path)} is ignored: its checks{days} are of another calibration than this model"
    )
