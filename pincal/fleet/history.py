"""What is known of a fleet over time: visits of its machines, what these show to have changed, and many tests at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pincal.fleet.machines import Machine

WHOLE_FLEET, DIAGNOSED = "fleet", "see its diagnosis"
"""The group of all robots, and what has changed where there is nothing but the p-value of a diagnosis."""


@dataclass(frozen=True, eq=False)
class Visit:
    """A robot was calibrated or checked.

    Attributes:
        machine: its name.
        day: ISO date.
        found: information of the readings; None where there is a p-value only.
        is_calibration: whether the machine starts anew: nothing before counts any more.
        p_value: of a diagnosis whose readings are not here.
    """

    machine: str
    day: str
    found: Machine | None = None
    is_calibration: bool = False
    p_value: float | None = None


@dataclass(frozen=True)
class FleetChange:
    """A change of a robot, or of the robots of a group.

    Attributes:
        subject: the robot, or the group as ``label=value``.
        is_group: whether it is a group.
        found: day by which it was found.
        since: day of the first readings after it.
        what: the parameter or element that explains it best, :data:`EVERYTHING` for more than one element, or
            :data:`DIAGNOSED`.
        equals: what explains it as well.
        change: by how much, of a single parameter [``unit``]; None for others.
        sigma: its standard deviation.
        unit: the parameter's.
        log_e: logarithm of the e-value.
    """

    subject: str
    is_group: bool
    found: str
    since: str
    what: str
    equals: tuple[str, ...]
    change: float | None
    sigma: float | None
    unit: str
    log_e: float


@dataclass(frozen=True)
class LastCheck:
    """What the last check of a robot shows.

    Attributes:
        machine: its name.
        day: of the check.
        p_value: chance of such readings on a robot that has not changed since the check before.
        q_value: the same adjusted for all robots of the round (Benjamini and Hochberg 1995).
        log_e: logarithm of the e-value that it has changed at any time since its calibration.
    """

    machine: str
    day: str
    p_value: float
    q_value: float
    log_e: float


@dataclass(frozen=True)
class FleetHistory:
    """What changed in a fleet.

    Attributes:
        changes: in the order in which they were found.
        last: the last check of each robot, those to look at first in front.
        robots: number of robots.
        checks: number of checks.
        open: robots that changed and were not calibrated since.
        drifted: robots of groups that drifted, likewise.
    """

    changes: tuple[FleetChange, ...]
    last: tuple[LastCheck, ...]
    robots: int
    checks: int
    open: frozenset[str]
    drifted: frozenset[str]


def benjamini_hochberg(p: np.ndarray) -> np.ndarray:
    """Return p-values adjusted for the false discovery rate, shape (n,) (Benjamini and Hochberg 1995).

    Example:
        >>> benjamini_hochberg(np.array([0.01, 0.04, 0.03])).round(3).tolist()
        [0.03, 0.04, 0.04]
    """
    n, order = len(p), np.argsort(p)
    found = np.empty(n)
    found[order] = np.minimum.accumulate((p[order] * n / np.arange(1, n + 1))[::-1])[::-1]
    return np.asarray(np.minimum(found, 1.0))


def e_value(p: float) -> float:
    r"""Return an e-value for a p-value, :math:`(1 - p + p \ln p) / (p \ln^2 p)` (Vovk and Wang 2021, Eq. (2)).

    Example:
        >>> round(e_value(1e-6), 1), round(e_value(0.05), 1), round(e_value(1.0), 1)
        (5239.1, 1.8, 0.5)
    """
    p = min(max(p, 1e-300), 1.0 - 1e-5)
    log = float(np.log(p))
    return (1.0 - p + p * log) / (p * log**2)
