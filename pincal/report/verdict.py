"""A calibration judged: whether the model explains the data, and what to do next."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pincal.calibration.result import Result
from pincal.calibration.run import Calibration
from pincal.discover.run import Discovery
from pincal.io.discovery_file import Findings
from pincal.model.catalogue import untestable
from pincal.model.conditions import OF_JOINTS
from pincal.notes import Note, doubts_of
from pincal.report.advice import narrow_joints
from pincal.report.words import effect_words
from pincal.validate.verdict import Verdict, tells

# Ratio of held-out to fitted rms error above which the rows were too few. N rows and p parameters make it about
# sqrt((N + p) / (N - p)): 1.3 is reached when a quarter as many readings as there are go into parameters.
_OVERFITTED = 1.3
# What is left beyond the noise is told from here on [mm]; less is shown as nothing.
_SHOWN_MM = 5e-4


@dataclass(frozen=True)
class Judged:
    """Whether the model explains the data down to their noise, and why, in a sentence."""

    judgement: Verdict
    reason: str


def verdict_of(result: Result, discovery: Discovery | None = None) -> Judged:
    """Return whether the model explains the data down to their noise, after a search for what is missing or without."""
    verdict = result.verdict_of() if discovery is None else discovery.findings.verdict
    if not result.converged:
        return Judged(verdict, "The fit did not converge; do not use its numbers.")
    if result.doubt:
        return Judged(verdict, f"Do not use it: {result.doubt}.")
    if discovery is not None:
        return verdict_of_search(discovery.findings)
    beside = result.beside
    if verdict is Verdict.NOT_ADEQUATE and beside is not None and beside.is_misfit:
        words = f"The residuals are {beside_noise(beside.ratio, beside.noise, is_misfit=True)}"
        return Judged(verdict, f"{words}: the robot does something that this model does not describe.")
    if verdict is Verdict.NOT_ADEQUATE:
        return Judged(verdict, f"{_against(result.doubts)}.")
    if verdict is Verdict.NOT_JUDGED and result.doubts:
        return Judged(verdict, "The poses are too few to tell whether it is complete; see the doubt, said first.")
    if verdict is Verdict.NOT_JUDGED:
        words = (
            "The noise of the instrument was estimated from the residuals, so they cannot show whether the model is "
            "complete: declare the noise (--noise), measure some poses again, or let pincal discover look for what it lacks."
        )
        return Judged(verdict, words)
    assert beside is not None
    return Judged(verdict, f"The residuals are {beside_noise(beside.ratio, beside.noise, is_misfit=False)}.")


def _against(doubts: Sequence[Note]) -> str:
    return "The doubt, said first, speaks against it" if len(doubts) == 1 else "The doubts, said first, speak against it"


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


def verdict_of_search(found: Findings) -> Judged:
    """Return whether a search has explained the data, and if not, what is wrong."""
    n, left, doubts = len(found.effects), found.unexplained_mm, doubts_of(found.warnings)
    added = f"{n} effects were found and added" if n > 1 else "One effect was found and added" if n else "Nothing was added"
    beyond = f"{left:.3f} mm rms beyond the noise" if left >= _SHOWN_MM else ""
    if found.verdict is Verdict.ADEQUATE:
        chance = f": {beyond} may be chance" if beyond else ""
        return Judged(found.verdict, f"{added}; the remaining residuals look like noise{chance}.")
    if found.verdict is Verdict.NOT_JUDGED:
        why = (
            "nothing more is seen, but the noise was estimated from the residuals, so they cannot show whether the model is "
            "complete: declare the noise (--noise), or measure some poses again"
        )
        why = "the poses are too few to tell whether that is all; see the doubt, said first" if doubts else why
        return Judged(found.verdict, f"{added}; {why}.")
    wrong = [f"{scatter.joint} scatters from reading to reading" for scatter in found.scatter]
    if beyond:
        wrong.append(f"{beyond} remain unexplained")
    elif not wrong and doubts:
        wrong.append(_against(doubts).lower())
    elif not wrong:
        wrong.append(
            "some residuals are larger than the declared noise, or what near poses tell of it, allows, though not on "
            "average over all rows"
        )
    return Judged(found.verdict, f"{added}; {', and '.join(wrong)}.")


def next_steps(calibration: Calibration, discovery: Discovery | None = None) -> list[str]:
    """Return what to do next after a calibration or a discovery, the most pressing first."""
    result, steps = calibration.result, list[str]()
    judgement = verdict_of(result, discovery).judgement
    if not result.converged:
        steps.append("Check units, joint order, and rows that do not belong to this robot; pincal check helps.")
    if result.shift:
        steps.append("Make the rows before and after the shift two stations (column station), and calibrate again.")
    if result.doubt:
        return [f"Find out what is wrong before anything else: {result.doubt}."]
    if is_few := not tells(result.degrees):
        steps.append("Measure more poses: these are too few to tell a good model from a bad one.")
    if discovery is not None:
        steps += _after_discovery(discovery)
    elif not is_few and judgement is not Verdict.ADEQUATE and result.converged:
        steps.append("Run pincal discover on the same data: it looks for the effects that the model lacks, and names them.")
    if n := len(result.outliers):
        steps.append(f"Look at the {n} rows that were rejected as outliers: a loose target or a slipping joint?")
    error = result.error["calibrated"]
    if "test" not in error:
        steps.append("Hold rows out (--test-fraction) or measure more (--holdout): otherwise the accuracy is not validated.")
    elif _held_out_rms(error) > _OVERFITTED * error["train"]["rms_mm"]:
        steps.append("Held-out errors exceed fitted ones: measure more poses, spread over the whole range of use.")
    if narrow := ", ".join(f"{name} ({100 * share:.0f} %)" for name, share in narrow_joints(calibration)):
        steps.append(f"These joints moved through little of their range: {narrow}. Outside it the model is not validated.")
    if judgement is not Verdict.NOT_ADEQUATE or not steps:
        steps.append(
            "Use it: model.json predicts poses (pincal predict), calibrated.urdf carries the geometry to other programs, "
            "and pincal validate checks the model against new measurements in a few months."
        )
    return steps


def _held_out_rms(error: Mapping[str, Mapping[str, float]]) -> float:
    """Return the rms error of held-out rows [mm], both ways of holding them out taken together."""
    ways = [error[way]["rms_mm"] for way in ("regions", "stretches") if way in error] or [error["test"]["rms_mm"]]
    return float(np.sqrt(np.mean(np.square(ways))))


def _after_discovery(discovery: Discovery) -> Iterator[str]:
    found = discovery.findings
    for entry in found.effects:
        if entry.tell_apart:
            yield f"To decide between {effect_words(entry)} and its alternatives: {entry.tell_apart}."
    for scatter in found.scatter:
        yield f"Record {scatter.missing}: it may explain why {scatter.joint} scatters."
    if found.verdict is not Verdict.ADEQUATE:
        calibration = discovery.calibration
        stations, tables = calibration.fit.problem.stations, [rows.train for rows in calibration.stations]
        lost = (pair for station in stations for pair in untestable(station.model.chain, station.conditions))
        needed = {column for effect, _ in lost for column in effect.needs}
        absent = (column for column in needed if any(getattr(table, column) is None for table in tables))
        if columns := ", ".join(sorted({OF_JOINTS.get(column, column) for column in absent})):
            yield f"Record {columns} with each pose, so that effects that depend on it can be tested."
