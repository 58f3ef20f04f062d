"""Whether rows that were rejected as outliers gather somewhere: readings go wrong anywhere, a robot in one place.

Rejected rows that lie next to each other in the positions of a joint, or in the order of the rows, are counted in windows
from one of them to another. The chance that as many of all rejected rows fall into a window of so many rows is at
most binomial; all windows are paid for (Bonferroni). It is a scan statistic: Kulldorff 1997, Commun. Stat. 26, 1481-1496.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import bdtrc

from pincal.identify.station import Station

# Chance that outliers anywhere are taken to gather.
_CHANCE = 1e-4
# Fewest outliers that can gather, and the most of which all windows are looked at.
_FEWEST, _MOST = 3, 200


@dataclass(frozen=True)
class Gathering:
    """Outliers that lie together.

    Attributes:
        rows: which rows of the station they are, all of them rejected.
        among: number of rows there, rejected or not.
        variable: name of the joint along whose positions they gather, "line" for the order of the rows.
        low, high: from where to where [rad or m; line].
        p_value: chance of as many outliers in any such place.
    """

    rows: np.ndarray
    among: int
    variable: str
    low: float
    high: float
    p_value: float


def gathering_of(station: Station, rejected: np.ndarray) -> Gathering | None:
    """Return where rejected rows gather most surely; None if they may lie anywhere.

    Args:
        station: all rows.
        rejected: shape (N,), which of them were rejected.
    """
    if not _FEWEST <= np.count_nonzero(rejected) <= min(_MOST, len(rejected) // 2):
        return None
    names = (*station.model.chain.robot.joint_names, "line")
    order = np.arange(len(rejected), dtype=float) if station.position is None else station.position
    features = [*station.conditions.q.T, order]
    found = [
        (p_value, k, low, high) for k, x in enumerate(features) if np.ptp(x) for p_value, low, high in _thickest(x, rejected)
    ]
    if not found:
        return None
    p_value, k, low, high = min(found)
    p_value = min(p_value * len(features), 1.0)
    if p_value > _CHANCE:
        return None
    inside = (features[k] >= low) & (features[k] <= high)
    return Gathering(np.flatnonzero(inside & rejected), int(inside.sum()), names[k], low, high, p_value)


def _thickest(x: np.ndarray, rejected: np.ndarray) -> Iterator[tuple[float, float, float]]:
    """Yield the chance of the window of x with the most surprising number of rejected rows, and its ends."""
    order = np.sort(x)
    ends = np.sort(x[rejected])
    first, last = np.searchsorted(order, ends, "left"), np.searchsorted(order, ends, "right")
    i, j = np.triu_indices(len(ends), _FEWEST - 1)
    if len(i):
        chances = bdtrc(j - i, len(ends), (last[j] - first[i]) / len(x))
        best = int(np.argmin(chances))
        yield float(chances[best]) * len(i), float(ends[i[best]]), float(ends[j[best]])
