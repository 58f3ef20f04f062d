"""Whether names predict any region of joint space worse than geometry and elasticity alone.

Names are accepted by their own tests. Of 25 regions that are left out a true name of modest size
predicts a few worse by chance, so that this says where, and doubts only what is beyond scatter.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import stdtr

from pincal.calibration.held_out import LeftOutErrors, StationRows, Validated, left_out_errors
from pincal.discover.discovery_file import NamedRegion
from pincal.discover.remainder_numbers import REMAINDER
from pincal.discover.smooth_judge import as_calibrated, joined_regions
from pincal.discover.steps import History
from pincal.notes import Note, Severity


def regions_by_names(
    trail: History, validated: Validated | None, rows: Sequence[StationRows]
) -> tuple[NamedRegion, ...]:
    """Return the mean errors of regions that are left out, by geometry and elasticity and with the
    names as well; none without names, or where no error is known.

    Args:
        trail: the history of names.
        validated: the errors of its last fit.
        rows: the rows of each station.
    """
    is_named = any(not step.is_elastic for step in trail.steps)
    if validated is None or not is_named or "regions" not in validated.folds.of_way:
        return ()
    folds = validated.folds.only("regions")
    plain = as_calibrated(trail)
    by_plain = left_out_errors(plain, plain.solution, rows, folds)["regions"]
    by_names = validated.of_model["calibrated"]["regions"]
    problem = trail.final.problem
    errors = list[np.ndarray]()
    region = list[np.ndarray]()
    q = list[np.ndarray]()
    for part, place, *both in zip(rows, problem.rows, by_plain, by_names, strict=True):
        known = _known(*both)
        errors.append(np.array([of.sizes["mm"][known] for of in both if known.any()]))
        region.append(part.by_row(folds.of_way["regions"][place])[known])
        q.append(part.by_row(problem.conditions.q[place].T).T[known])
    if not sum(map(len, region)):
        return ()
    names = problem.chain.robot.joint_names
    of_rows = np.hstack([of for of in errors if of.size])
    return _regions(names, of_rows, np.concatenate(region), np.vstack(q))


def _known(plain: LeftOutErrors, named: LeftOutErrors) -> np.ndarray:
    """Return the readings whose error in millimetres is known by both, shape (N,)."""
    if "mm" not in plain.sizes or "mm" not in named.sizes:
        return np.zeros(len(plain.counted), bool)
    return np.asarray(plain.counted & named.counted)


def _regions(
    names: Sequence[str], errors: np.ndarray, region: np.ndarray, q: np.ndarray
) -> tuple[NamedRegion, ...]:
    region = joined_regions(q, region, REMAINDER.region)
    found = list[NamedRegion]()
    for k in np.unique(region):
        plain, named = errors[:, region == k]
        centre = dict(zip(names, q[region == k].mean(axis=0).tolist(), strict=True))
        found.append(
            NamedRegion(
                rows=len(plain),
                calibrated_mm=float(plain.mean()),
                named_mm=float(named.mean()),
                chance=chance_of_more(named - plain),
                centre=centre,
            )
        )
    return tuple(found)


def chance_of_more(differences: np.ndarray) -> float:
    """Return the p-value of the mean of differences, shape (n,), being as large as it is by their
    scatter alone (Student's t, one-sided); 1 for a single one.

    Example:
        >>> chance_of_more(np.array([1.0, 1.1, 0.9])) < 0.01
        True
        >>> chance_of_more(np.array([1.0, -1.0]))
        0.5
    """
    n = len(differences)
    scatter = float(differences.std(ddof=1)) / np.sqrt(n) if n > 1 else np.inf
    if scatter == 0.0 or not np.isfinite(scatter):
        return 1.0
    return float(stdtr(n - 1.0, -differences.mean() / scatter))


def doubt_of_regions(regions: Sequence[NamedRegion]) -> Note | None:
    """Return the doubt that names predict some regions worse than geometry and elasticity do, by
    more than chance; None if there are none.
    """
    sure = [of for of in regions if of.chance * len(regions) < REMAINDER.worse]
    if not sure:
        return None
    worst = max(sure, key=lambda of: of.named_mm - of.calibrated_mm)
    where = ", ".join(f"{joint} {value:.2f}" for joint, value in worst.centre.items())
    return Note(
        Severity.DOUBT,
        f"with the names {len(sure)} of {len(regions)} regions of joint space that are left out "
        f"are predicted worse than by pincal calibrate, by more than chance; most about {where} "
        f"({worst.named_mm:.3f} mm instead of {worst.calibrated_mm:.3f}): measure more poses "
        "there, or use the model of pincal calibrate",
    )
