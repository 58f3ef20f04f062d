"""A calibration judged: whether the model explains the data, and what to do next."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

from pincal.calibration.result import Result
from pincal.calibration.run import Calibration
from pincal.discover.run import Discovery
from pincal.io.discovery_file import Findings
from pincal.model.catalogue import untestable
from pincal.model.conditions import OF_JOINTS
from pincal.report.advice import narrow_joints
from pincal.report.words import effect_words
from pincal.validate.misfit import MISFIT

# Ratio of held-out to fitted rms error above which the rows were too few. N rows and p parameters make it about
# sqrt((N + p) / (N - p)): 1.3 is reached when a quarter as many readings as there are go into parameters.
_OVERFITTED = 1.3
# What is left beyond the noise is told from here on [mm]; less is shown as nothing.
_SHOWN_MM = 5e-4


class Judgement(StrEnum):
    """Whether the model is all that the data show; the values are those of ``discovery.json`` and the report."""

    ADEQUATE = "adequate"
    NOT_ADEQUATE = "not adequate"
    NOT_JUDGED = "not judged"
    NOT_CONVERGED = "not converged"


@dataclass(frozen=True)
class Verdict:
    """Whether the model explains the data down to their noise, and why, in a sentence."""

    judgement: Judgement
    reason: str


def verdict_of(result: Result, discovery: Discovery | None = None) -> Verdict:
    """Return whether the model explains the data down to their noise, after a search for what is missing or without."""
    if not result.converged:
        return Verdict(Judgement.NOT_CONVERGED, "The fit did not converge; do not use its numbers.")
    if result.doubt:
        return Verdict(Judgement.NOT_ADEQUATE, f"Do not use it: {result.doubt}.")
    if discovery is not None:
        return verdict_of_search(discovery.findings)
    if result.chi2_p_value is not None:
        is_misfit, square = result.chi2_p_value < MISFIT, result.chi2_reduced
        noise = "the declared noise of the instrument"
    elif result.lack_of_fit is not None:
        is_misfit, square = result.lack_of_fit.is_significant, result.lack_of_fit.F
        noise = "the scatter between repeated measurements of a pose"
    else:
        words = (
            "The noise of the instrument was estimated from the residuals, so they cannot show whether the model is "
            "complete: declare the noise (--noise), or let pincal discover look for missing effects."
        )
        return Verdict(Judgement.NOT_JUDGED, words)
    words = f"The residuals are {beside_noise(square**0.5, noise, is_misfit=is_misfit)}"
    if is_misfit:
        return Verdict(Judgement.NOT_ADEQUATE, f"{words}: the robot does something that this model does not describe.")
    return Verdict(Judgement.ADEQUATE, f"{words}.")


def beside_noise(ratio: float, noise: str, *, is_misfit: bool) -> str:
    """Return how large residuals are beside a noise, in words that neither the ratio as shown nor the judgement contradicts.

    Example:
        >>> beside_noise(1.004, "the noise", is_misfit=True)
        'larger than the noise, by little but in too many rows to be chance'
        >>> beside_noise(1.2, "the noise", is_misfit=False), beside_noise(1.2, "the noise", is_misfit=True)
        ('1.20 times the noise, which may be chance', '1.20 times the noise')
    """
    shown = f"{ratio:.2f} times {noise}"
    if float(f"{ratio:.2f}") <= 1.0:
        return (
            f"larger than {noise}, by little but in too many rows to be chance" if is_misfit else f"no larger than {noise}"
        )
    return shown if is_misfit else f"{shown}, which may be chance"


def verdict_of_search(found: Findings) -> Verdict:
    """Return whether a search has explained the data, and if not, what is wrong."""
    n, left = len(found.effects), found.unexplained_mm
    added = f"{n} effects were found and added" if n > 1 else "One effect was found and added" if n else "Nothing was added"
    beyond = f"{left:.3f} mm rms beyond the noise" if left >= _SHOWN_MM else ""
    if (judgement := Judgement(found.verdict)) is Judgement.ADEQUATE:
        chance = f": {beyond} may be chance" if beyond else ""
        return Verdict(judgement, f"{added}; the remaining residuals look like noise{chance}.")
    wrong = [f"{scatter.joint} scatters from reading to reading" for scatter in found.scatter]
    if beyond:
        wrong.append(f"{beyond} remain unexplained")
    elif not wrong:
        wrong.append(
            "some residuals are larger than the declared noise, or what near poses tell of it, allows, though not on "
            "average over all rows"
        )
    return Verdict(judgement, f"{added}; {', and '.join(wrong)}.")


def next_steps(calibration: Calibration, discovery: Discovery | None = None) -> list[str]:
    """Return what to do next after a calibration or a discovery, the most pressing first."""
    result, steps = calibration.result, list[str]()
    judgement = verdict_of(result, discovery).judgement
    if judgement is Judgement.NOT_CONVERGED:
        steps.append("Check units, joint order, and rows that do not belong to this robot; pincal check helps.")
    if result.doubt:
        return [f"Find out what is wrong before anything else: {result.doubt}."]
    if discovery is not None:
        steps += _after_discovery(discovery)
    elif judgement in (Judgement.NOT_ADEQUATE, Judgement.NOT_JUDGED):
        steps.append("Run pincal discover on the same data: it looks for the effects that the model lacks, and names them.")
    if n := len(result.outliers):
        steps.append(f"Look at the {n} rows that were rejected as outliers: a loose target or a slipping joint?")
    error = result.error["calibrated"]
    if "test" not in error:
        steps.append("Hold rows out (--test-fraction) or measure more (--holdout): otherwise the accuracy is not validated.")
    elif error["test"]["rms_mm"] > _OVERFITTED * error["train"]["rms_mm"]:
        steps.append("Held-out errors exceed fitted ones: measure more poses, spread over the whole range of use.")
    if narrow := ", ".join(f"{name} ({100 * share:.0f} %)" for name, share in narrow_joints(calibration)):
        steps.append(f"These joints moved through little of their range: {narrow}. Outside it the model is not validated.")
    if judgement in (Judgement.ADEQUATE, Judgement.NOT_JUDGED) or not steps:
        steps.append(
            "Use it: model.json predicts poses (pincal predict), calibrated.urdf carries the geometry to other programs, "
            "and pincal validate checks the model against new measurements in a few months."
        )
    return steps


def _after_discovery(discovery: Discovery) -> Iterator[str]:
    found = discovery.findings
    for entry in found.effects:
        if entry.tell_apart:
            yield f"To decide between {effect_words(entry)} and its alternatives: {entry.tell_apart}."
    for scatter in found.scatter:
        yield f"Record {scatter.missing}: it may explain why {scatter.joint} scatters."
    if Judgement(found.verdict) is not Judgement.ADEQUATE:
        calibration = discovery.calibration
        stations, tables = calibration.fit.problem.stations, [rows.train for rows in calibration.stations]
        lost = (pair for station in stations for pair in untestable(station.model.chain, station.conditions))
        needed = {column for effect, _ in lost for column in effect.needs}
        absent = (column for column in needed if any(getattr(table, column) is None for table in tables))
        if columns := ", ".join(sorted({OF_JOINTS.get(column, column) for column in absent})):
            yield f"Record {columns} with each pose, so that effects that depend on it can be tested."
