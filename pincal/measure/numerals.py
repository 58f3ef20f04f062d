"""Numbers as programs and countries write them: decimal commas, thousands separators, a true minus
sign, the exponents of Fortran. Only what can mean one thing is read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import polars as pl

# What stands between thousands beside a comma or point: an apostrophe, or a blank of any width.
_BETWEEN = "'\u2019\u00a0\u202f "
_POINT_AND_GROUPS = rf"^[-+]?\d{{1,3}}(?:[,{_BETWEEN}]\d{{3}})+\.\d+$"
_COMMA_AND_GROUPS = rf"^[-+]?\d{{1,3}}(?:[.{_BETWEEN}]\d{{3}})+,\d+$"
# A point before three digits, which separates thousands in a column with decimal commas.
_GROUPS = r"^[-+]?\d{1,3}(?:\.\d{3})+$"
_COMMA = r"^[-+]?\d*,\d+(?:[eE][-+]?\d+)?$"
# Three digits after a comma may be thousands.
_THREE = r"^[-+]?\d{1,3},\d{3}$"
_FORTRAN = r"^([-+]?[\d.,]+)[dD]([-+]?\d+)$"


def numerals_read(text: pl.Series, *, decimal_comma: bool) -> pl.Series:
    """Return the numbers that cells hold, null for what is none or may be several.

    Args:
        text: cells without blanks at their ends.
        decimal_comma: whether the table may have decimal commas.

    Example:
        >>> import polars as pl
        >>> numerals_read(pl.Series(["1,234.5", "6.5D-01", "-7"]), decimal_comma=False).to_list()
        [1234.5, 0.65, -7.0]
        >>> numerals_read(pl.Series(["1,234", "5.5"]), decimal_comma=False).to_list()
        [None, 5.5]
    """
    plain = text.str.replace("\u2212", "-", literal=True).str.replace(_FORTRAN, "${1}e${2}")
    found = _cast(plain.str.replace(",", ".", literal=True) if decimal_comma else plain)
    if decimal_comma and plain.str.contains(_COMMA_AND_GROUPS).any():
        found = found.set(plain.str.contains(_GROUPS).fill_null(False), None)
    for pattern, point in ((_POINT_AND_GROUPS, "."), (_COMMA_AND_GROUPS, ",")):
        is_grouped = plain.str.contains(pattern).fill_null(False)
        if is_grouped.any():
            digits = plain.str.replace_all(rf"[^\d{point}+-]", "")
            digits = digits.str.replace(point, ".", literal=True)
            found = _cast(digits).zip_with(is_grouped, found)
    return _with_commas(plain, found) if not decimal_comma else found


def _cast(text: pl.Series) -> pl.Series:
    import polars as pl

    return text.cast(pl.Float64, strict=False)


def _with_commas(text: pl.Series, found: pl.Series) -> pl.Series:
    """Return the numbers of a column all of whose cells have decimal commas, as text of a
    spreadsheet has them, unless these may separate thousands; of another one those that were
    found.
    """
    given = text.drop_nulls()
    is_decimal = len(given) and given.str.contains(_COMMA).all()
    if not is_decimal or given.str.contains(_THREE).all():
        return found
    return _cast(text.str.replace(",", ".", literal=True))
