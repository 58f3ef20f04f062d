"""What a user should know about a fit: the findings as data, and the one place where they become words."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np

from pincal.identify.fit import Fit
from pincal.identify.moments import found_moments
from pincal.identify.station import Station
from pincal.measure.measurements import Measurements
from pincal.validate.accuracy import pose_errors
from pincal.validate.agreement import implausible
from pincal.validate.lack_of_fit import LackOfFit
from pincal.validate.misfit import MISFIT
from pincal.validate.rows_apart import in_common, step_in

# A held-out row is far off if its error is this many times the median: 15 standard deviations of a normal error in 3D.
_FAR = 10.0
# Lines that a note lists.
_LISTED = 8
# Part of the rows from which on outliers are no exceptions; of real tables some percent are left out.
_MANY = 0.25


class Kind(Enum):
    """What is noteworthy; the values are how it is said, with its figures in braces."""

    FEW_READINGS = (
        "{rows} training rows in {poses} poses give {readings} readings for {parameters} parameters: the result is "
        "dominated by the prior; measure more poses"
    )
    NOT_CONVERGED = "the fit did not converge ({how}); check the noise, and look for rows that do not belong to this robot"
    NOISE_EXCEEDED = (
        "the residuals are {ratio:.2f} times the declared noise (p {p_value:.1g}): the model is incomplete or the declared "
        "noise is too small; uncertainties are scaled up accordingly"
    )
    NOISE_OVERSTATED = "the residuals are smaller than the declared noise allows: the declared noise is too large"
    MASSES_FOUND = (
        "the robot's description has no masses that could be trusted of {links} links: they were found with the "
        "compliances, {mass:.3g} kg in all, known to {percent:.0f} %; no prediction depends on the factor that they share"
    )
    IMPLAUSIBLE = (
        "{how}: no calibrated arm leaves so much, so this is not the model of this robot; check table, URDF and tip. "
        "If the instrument is so noisy, declare it (--noise, or a column sigma)"
    )
    MANY_OUTLIERS = (
        "{count} of {rows} rows do not fit the others, which is no calibration: {common}; find out what "
        "they are before using the model. Lines {lines}"
    )
    STEP = (
        "from line {line} on readings are shifted by {size:.3g} mm: was the instrument or the target touched? "
        "If so, make the rows before and after two stations (column station)"
    )
    OUTLIERS = "{count} rows were rejected as outliers and left out of the fit: lines {lines}"
    NOT_HELD_OUT = "no rows were held out, so the errors are those of the fit, not of prediction"
    NOT_LEFT_OUT = "not predicted by the model of the other stations: {why}"
    FAR_OFF = (
        "{count} of {rows} held-out rows are off by up to {largest:.3g} mm, the others by {mean:.4f} mm on average: wrong "
        "readings, or poses outside what the model covers; see lines {lines}"
    )
    LACK_OF_FIT = "lack of fit against replicates: {test}"
    NOISY_REPLICATES = (
        "replicates scatter as much as the residuals do ({test}): the declared noise is too small or the robot repeats "
        "poorly; the model is not at fault"
    )


DOUBTS = (Kind.IMPLAUSIBLE, Kind.MANY_OUTLIERS)
"""What makes a calibration none, though it converged."""


@dataclass(frozen=True)
class Note:
    """One finding; ``str()`` gives it in words.

    Attributes:
        kind: what was found.
        figures: its particulars, by the names in the text of the kind.
        station: name of the station that it is about; "" for all of them.
    """

    kind: Kind
    figures: Mapping[str, Any] = field(default_factory=dict)
    station: str = ""

    def __str__(self) -> str:
        words = self.kind.value.format(**self.figures)
        return f"{self.station}: {words}" if self.station else words


def notes_on_data(fit: Fit) -> list[Note]:
    """Return whether the readings are few for the parameters; however much is read of a pose, it has six coordinates."""
    readings, n_poses = 0, 0
    for station, places, _ in fit.stations:
        poses = len(np.unique(station.conditions.q, axis=0))
        own = int(station.split(fit.solution.free[places])[1].sum())
        readings += min(len(station) * sum(block.size for block in station.sensor.blocks), 6 * poses + own)
        n_poses += poses
    released = int(fit.solution.free.sum())
    if readings >= 2 * released:
        return []
    figures = {"rows": len(fit.problem), "poses": n_poses, "readings": readings, "parameters": released}
    return [Note(Kind.FEW_READINGS, figures)]


def notes_on_fit(fit: Fit, p_value: float | None) -> list[Note]:
    """Return what the fit itself says.

    Args:
        fit: the calibration.
        p_value: of its chi-square against the declared noise; None if none was declared.
    """
    found = [] if fit.solution.converged else [Note(Kind.NOT_CONVERGED, {"how": fit.solution.exit.value})]
    if p_value is not None and p_value < MISFIT:
        found.append(Note(Kind.NOISE_EXCEEDED, {"ratio": float(np.sqrt(fit.solution.cost)), "p_value": p_value}))
    if p_value is not None and p_value > 1.0 - MISFIT:
        found.append(Note(Kind.NOISE_OVERSTATED))
    if (moments := found_moments(fit)) is not None:
        percent = 100.0 * moments.factor_sigma
        found.append(Note(Kind.MASSES_FOUND, {"links": len(moments.links), "mass": moments.mass, "percent": percent}))
    return found


def notes_on_plausibility(fit: Fit, tables: Iterable[Measurements]) -> list[Note]:
    """Return at which stations, with these fitted rows, the fit leaves what no real arm does."""
    return [Note(Kind.IMPLAUSIBLE, {"how": how}, name) for name, how in implausible(fit, tables)]


def notes_on_outliers(
    station: Station, values: np.ndarray, free: np.ndarray, *, table: Measurements, rejected: np.ndarray
) -> list[Note]:
    """Return which rows of a station were rejected, by their lines, and where the instrument was moved between rows.

    Args:
        station: the calibrated model over the fitted rows.
        values: shape (P,), of its parameters.
        free: shape (P,), which of them were fitted.
        table: the fitted rows.
        rejected: shape (N,), which of them were rejected.
    """
    lines = table.rows[rejected].tolist()
    figures = {"count": len(lines), "rows": len(table), "lines": _listed(lines)}
    found = [Note(Kind.OUTLIERS, figures, station.name)] if lines else []
    if rejected.mean() >= _MANY:
        common = in_common(station, values, table, rejected) or "they have nothing in common that could be found"
        found = [Note(Kind.MANY_OUTLIERS, figures | {"common": common}, station.name)]
    if step := step_in(station, values, free, table.rows):
        found.append(Note(Kind.STEP, {"line": step.line, "size": 1e3 * step.size}, station.name))
    return found


def notes_on_held_out(test: Station | None, values: np.ndarray, table: Measurements) -> list[Note]:
    """Return whether some held-out rows of a station are far off all others: a few of them dominate a mean."""
    if test is None:
        return []
    errors = next(iter(pose_errors(test, values).values()))
    far = errors > _FAR * np.median(errors)
    if not far.any():
        return []
    figures = {
        "count": int(far.sum()),
        "rows": len(errors),
        "largest": float(errors.max()),
        "mean": float(errors[~far].mean()),
        "lines": _listed(table.rows[far].tolist()),
    }
    return [Note(Kind.FAR_OFF, figures, test.name)]


def notes_on_replicates(lack: LackOfFit | None, p_value: float | None) -> list[Note]:
    """Return what replicates say of model and noise.

    Args:
        lack: the test of lack of fit, None without replicates.
        p_value: of chi-square against the declared noise; None if none was declared.
    """
    if lack is None:
        return []
    if lack.is_significant:
        return [Note(Kind.LACK_OF_FIT, {"test": lack})]
    if p_value is not None and p_value < MISFIT:
        return [Note(Kind.NOISY_REPLICATES, {"test": lack})]
    return []


def _listed(lines: Sequence[int]) -> str:
    return ", ".join(map(str, lines[:_LISTED])) + " ..." * (len(lines) > _LISTED)
