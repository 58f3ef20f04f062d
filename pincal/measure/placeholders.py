"""Numbers that instruments write in place of a reading: all digits 9, such as -9999, or the same
number in all components, such as 0 0 0.

A column with a few of these would be refused or rejected later, by causes that it does not have.
"""

from __future__ import annotations

import numpy as np

from pincal.measure.reading_numbers import LAYOUT
from pincal.thresholds import Count, Scale

# A number of nines that is no length of a robot cell has so many digits at least.
_DIGITS: Count = 3
# Numbers that stand in all components of a position in place of one.
_IN_ALL: tuple[Scale, ...] = (0.0, -1.0)


def placeholders(values: np.ndarray) -> np.ndarray:
    """Return which rows have no reading but a number in its place, shape (N,): one of nines, or one
    beyond all other readings in all components, or 0 or -1 in all three components of a position.

    Args:
        values: readings of lengths, shape (N, m), NaN where a cell holds no number.

    Example:
        >>> place = np.random.default_rng(0).normal(size=(20, 3))
        >>> place[7] = -9999.0
        >>> np.flatnonzero(placeholders(place)).tolist()
        [7]
    """
    same = (values == values[:, :1]).all(axis=1)
    first = np.where(same, values[:, 0], np.nan)
    is_nine = np.isin(first, [one for one in np.unique(first[same]) if _nines(abs(one))])
    suspect = same & (is_nine if values.shape[1] == 1 else True)
    others = values[~suspect & np.isfinite(values).all(axis=1)]
    if len(np.unique(others, axis=0)) < LAYOUT.fewest_readings:
        return np.zeros(len(values), bool)
    found = suspect & (np.abs(first) > LAYOUT.beyond * np.abs(others).max())
    if values.shape[1] > 1:
        # In half of the rows they are what was measured.
        found |= np.isin(first, _IN_ALL) & (np.isin(first, _IN_ALL).mean() < LAYOUT.seldom)
    return np.asarray(found)


def _nines(value: float) -> bool:
    """Return whether all digits of a number are 9, such as 9999 or 99999.99."""
    digits = f"{value:.10g}"
    return set(digits) <= {"9", "."} and len(digits) >= _DIGITS
