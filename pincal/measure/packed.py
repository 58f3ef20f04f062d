"""How much a packed file may hold: measured numbers can't be squeezed together, what is made to fill the memory can."""

from __future__ import annotations

from pathlib import Path

from pincal.errors import MeasurementError

# How many times its own size a file may hold. Excel's text of measured numbers packs to a fifth, with one number in all
# cells to an eighth; in Parquet, 60 poses that were read 1000 times each pack to a ninth.
_MOST_TIMES = 50
# What any file may hold [bytes]: small ones have little but headers.
_ALWAYS = 1_000_000


def check_unpacked(path: Path, held: int) -> None:
    """Refuse a file whose contents take far more room than it does itself, before they are unpacked.

    Args:
        path: the file.
        held: the size of its contents [bytes].

    Raises:
        MeasurementError: saying how much it holds.
    """
    size = path.stat().st_size
    if held > max(_ALWAYS, _MOST_TIMES * size):
        raise MeasurementError(
            f"{path.name}: holds {held / 1e6:.0f} MB in {size / 1e6:.2g} MB, more than {_MOST_TIMES} times its size; "
            "measured numbers can't be packed like that: look for blank or copied rows and columns, or save the table as CSV"
        )
