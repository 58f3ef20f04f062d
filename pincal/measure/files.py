"""Which format a file has."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator
from pathlib import Path

from pincal.errors import MeasurementError
from pincal.measure import bag_sheet, excel_sheet
from pincal.measure.sheet import Sheet, open_parquet
from pincal.measure.text_sheet import open_text

# Formats that other programs can turn into one that is read.
_OTHERS = (".xls", ".xlsb", ".ods", ".numbers")


def open_sheet(
    path: Path, *, ignore: Collection[str] = (), only_joints: bool = False, joints: Collection[str] = ()
) -> Sheet:
    """Return the sheet of a file, by the ending of its name: Parquet, Excel, a recording of ROS, and text for all others.

    Args:
        path: the file; of a recording perhaps a folder.
        ignore: topics of a recording to leave out.
        only_joints: whether only the joints of a recording are wanted, sample by sample.
        joints: those of a recording that have to stand still.

    Raises:
        MeasurementError: for a file that is empty, binary, or not of this format.
    """
    ending = path.suffix.lower()
    if bag_sheet.is_bag(path):
        return bag_sheet.open_bag(path, ignore=ignore, only_joints=only_joints, joints=joints)
    if ending == ".parquet":
        return open_parquet(path)
    if ending in excel_sheet.ENDINGS:
        return excel_sheet.open_excel(path)
    if ending in _OTHERS:
        raise MeasurementError(f"{path.name}: {ending} is not read; save the table as .xlsx or CSV")
    return open_text(path)


@contextlib.contextmanager
def typed_errors(path: Path) -> Iterator[None]:
    """Raise whatever goes wrong with a file as a `MeasurementError` that names it."""
    import polars as pl

    try:
        yield
    except MeasurementError:
        raise
    except FileNotFoundError as error:
        raise MeasurementError(f"{path}: no such file; check the name and the folder") from error
    except IsADirectoryError as error:
        raise MeasurementError(f"{path}: is a folder; expected a file, .csv or .parquet") from error
    except (OSError, ValueError, pl.exceptions.PolarsError, pl.exceptions.PanicException) as error:
        reason = str(error).strip().split("\n")[0]
        raise MeasurementError(f"{path}: can't be read ({reason}); expected a CSV or .parquet table") from error
