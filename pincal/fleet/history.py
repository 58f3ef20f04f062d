"""The history of a fleet: visits of its machines, the changes that they reveal, and multiple
testing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pincal.fleet.machines import Machine

WHOLE_FLEET = "fleet"
DIAGNOSED = "see its diagnosis"
"""Name of the group of all robots; description of a change known only by the p-value of a
diagnosis.
"""


@dataclass(frozen=True, eq=False)
class Visit:
    """A calibration or a check of a robot.

    Attributes:
        machine: its name.
        day: ISO date.
        found: information of the readings; None if there is only a p-value.
        is_calibration: whether the robot was recalibrated, so that earlier visits no longer count.
        p_value: of a diagnosis without its readings.
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
        found: day on which it was found.
        since: day of the first readings after it.
        what: the parameter or element that explains it best, :data:`EVERYTHING` for more than one
            element, or
            :data:`DIAGNOSED`.
        equals: parameters or elements that explain it equally well.
        change: size of the change of a single parameter [``unit``]; None for others.
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
    """Result of the last check of a robot.

    Attributes:
        machine: its name.
        day: of the check.
        p_value: of the readings on a robot that has not changed since the previous check.
        q_value: the p-value adjusted for all robots of the round (Benjamini and Hochberg 1995).
        log_e: logarithm of the e-value of a change at any time since its calibration.
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
        last: the last check of each robot, by decreasing evidence of a change.
        robots: number of robots.
        checks: number of checks.
        open: robots that changed and were not recalibrated since.
        drifted: robots of groups that drifted, not recalibrated since.
    """

    changes: tuple[FleetChange, ...]
    last: tuple[LastCheck, ...]
    robots: int
    checks: int
    open: frozenset[str]
    drifted: frozenset[str]


def benjamini_hochberg(p: np.ndarray) -> np.ndarray:
    """Return p-values adjusted for the false discovery rate, shape (n,) (Benjamini and Hochberg
    1995).

    Example:
        >>> benjamini_hochberg(np.array([0.01, 0.04, 0.03])).round(3).tolist()
        [0.03, 0.04, 0.04]
    """
    n = len(p)
    order = np.argsort(p)
    found = np.empty(n)
    found[order] = np.minimum.accumulate((p[order] * n / np.arange(1, n + 1))[::-1])[::-1]
    return np.asarray(np.minimum(found, 1.0))


def e_value(p: float) -> float:
    r"""Return an e-value for a p-value, :math:`(1 - p + p \ln p) / (p \ln^2 p)` (Vovk and Wang
    2021, Eq. (2)).

    Example:
        >>> round(e_value(1e-6), 1), round(e_value(0.05), 1), round(e_value(1.0), 1)
        (5239.1, 1.8, 0.5)
    """
    p = min(max(p, 1e-300), 1.0 - 1e-5)
    log = float(np.log(p))
    return (1.0 - p + p * log) / (p * log**2)
