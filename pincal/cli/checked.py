"""What interim checks say of a model that a command takes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pincal.errors import BadInputError

if TYPE_CHECKING:
    from pincal.calibration.check_record import InterimCheck
    from pincal.calibration.fitted_robot import FittedRobot


def last_check(
    model: Path, record: Path | None = None, fitted: FittedRobot | None = None
) -> tuple[InterimCheck | None, tuple[str, ...]]:
    """Return the last interim check of a model, None if there is none, and notes on its record.

    Args:
        model: its file.
        record: of its checks; default: beside it.
        fitted: the model, if it is loaded already, with all its stations.

    Raises:
        BadInputError: if a record is named that is not there, or can't be read.
    """
    from pincal.calibration.check_record import record_of, record_path
    from pincal.calibration.fitted_robot import load_model

    path = record or record_path(model)
    if not path.is_file():
        if record is not None:
            raise BadInputError(
                f"{record}: not there; expected the record that pincal interim --record wrote"
            )
        return None, ()
    found, note = record_of(fitted or load_model(model), path)
    notes: tuple[str, ...] = () if note is None else (note,)
    if found is None:
        return None, notes
    if found.withdrawn_words:
        notes += (f"interim checks that were withdrawn: {found.withdrawn_words}",)
    return found.last, notes


def said_by_checks(model: Path) -> tuple[str, ...]:
    """Return what the interim checks of a model say, for commands that go on whatever it is."""
    last, notes = last_check(model)
    if last is None:
        return notes
    if last.has_failed:
        return (*notes, failed_words(last))
    return (
        *notes,
        f"interim check of {last.words}; what has moved since the calibration adds "
        f"{last.drift * 1e3:.2g} mm (standard uncertainty of a coordinate) to what is stated here",
    )


def failed_words(check: InterimCheck) -> str:
    """Return that a check has failed."""
    moved = "" if check.change is None else f" ({check.change.what} moved)"
    return (
        f"the last interim check, of {check.day}, raised an alarm{moved}: the robot is no longer "
        "as calibrated; repeat the check, see pincal diagnose, or calibrate again"
    )
