"""A calibration in a few plain sentences: how good, whether anything is missing, what to do next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pincal.calibration.result import Result
from pincal.calibration.run import Calibration
from pincal.discover.run import Discovery
from pincal.report.advice import narrow_joints
from pincal.report.words import effect_words
from pincal.validate.lack_of_fit import MISFIT

# Chance below which residuals count as larger than the declared noise allows.
_MISFIT = 1e-3
# Held-out errors larger than fitted ones by this much say that the rows were too few.
_OVERFITTED = 1.3


@dataclass(frozen=True)
class Verdict:
    """Whether the model is all that the data show.

    Attributes:
        word: "adequate", "not adequate", "not judged" or "not converged".
        words: the same in a sentence.
    """

    word: str
    words: str


def verdict_of(result: Result, discovery: Discovery | None = None) -> Verdict:
    """Return whether the model explains the data down to their noise.

    Args:
        result: the calibration.
        discovery: the search for what is missing, if there was one.
    """
    if not result.converged:
        return Verdict("not converged", "The fit did not settle; its numbers are not to be used.")
    if discovery is not None:
        return _of_discovery(discovery.report)
    if result.chi2_p_value is None and result.lack_of_fit is not None:
        return _of_lack(result.lack_of_fit)
    if result.chi2_p_value is None:
        return Verdict(
            "not judged",
            "The noise of the instrument was estimated from what is left, so whether something is missing can't be judged "
            "by it: declare the noise (--noise), or let pincal discover look for what is missing.",
        )
    if result.chi2_p_value < _MISFIT:
        ratio = result.chi2_reduced**0.5
        words = f"What is left is {ratio:.2f} times the declared noise: the robot does something that this model lacks."
        return Verdict("not adequate", words)
    return Verdict("adequate", "What is left is no more than the declared noise of the instrument.")


def _of_lack(lack: dict[str, Any]) -> Verdict:
    """Return the verdict that visits of the same pose give, whatever the instrument's noise."""
    if lack["p_value"] < MISFIT:
        return Verdict(
            "not adequate",
            "Poses are off their predictions by more than visits of the same pose differ by: the robot does something that "
            "this model lacks.",
        )
    return Verdict("adequate", "What is left is no more than visits of the same pose differ by.")


def _of_discovery(report: dict[str, Any]) -> Verdict:
    n = len(report["effects"])
    found = f"{n} effects were found and added" if n > 1 else "one effect was found and added" if n else "nothing was added"
    if report["verdict"] == "adequate":
        return Verdict("adequate", f"{found.capitalize()}; what is left now looks like noise.")
    left = f"{report['unexplained_mm']:.3f} mm rms beyond the noise stay unexplained"
    return Verdict("not adequate", f"{found.capitalize()}; {left}.")


def next_steps(calibration: Calibration, discovery: Discovery | None = None) -> list[str]:
    """Return what to do next, the most pressing first.

    Args:
        calibration: the calibration.
        discovery: the search for what is missing, if there was one.
    """
    result, steps = calibration.result, list[str]()
    verdict = verdict_of(result, discovery).word
    if verdict == "not converged":
        steps.append("Look at units, joint order and rows that do not belong to this robot; pincal check helps.")
    if discovery is None and verdict in ("not adequate", "not judged"):
        steps.append("Run pincal discover on the same table: it looks for what the model lacks and names it.")
    if discovery is not None:
        steps += _after_discovery(discovery.report)
    if result.outliers:
        steps.append(f"Look at the {len(result.outliers)} rows that were left out: a loose target or a slipped joint?")
    error = result.error["calibrated"]
    if "test" not in error:
        steps.append("Hold rows back (--test-fraction) or measure more (--holdout): without, the accuracy is not proven.")
    elif error["test"]["rms_mm"] > _OVERFITTED * error["train"]["rms_mm"]:
        steps.append("Held-out errors are larger than fitted ones: measure more poses, spread over all you will use.")
    narrow = narrow_joints(calibration)
    if narrow:
        names = ", ".join(f"{name} ({100 * share:.0f} %)" for name, share in narrow)
        steps.append(f"These joints moved through little of their range: {names}. Elsewhere the model is not tested.")
    if verdict in ("adequate", "not judged") or not steps:
        steps.append(
            "Use it: model.json predicts poses (pincal predict), calibrated.urdf carries the geometry to other "
            "programs, and pincal validate checks it against a new table in some months."
        )
    return steps


def _after_discovery(report: dict[str, Any]) -> list[str]:
    steps = [
        f"To tell {effect_words(entry)} from what it could also be: {entry['tell_apart']}."
        for entry in report["effects"]
        if entry["tell_apart"]
    ]
    steps += [f"Record {entry['missing']}: it may explain why {entry['joint']} scatters." for entry in report["scatter"]]
    missing = {e["reason"] for e in report["not_testable"] if "column" in e["reason"] and "missing" in e["reason"]}
    if report["verdict"] != "adequate" and missing:
        steps.append(f"Record what was not recorded ({'; '.join(sorted(missing))}) to test what depends on it.")
    return steps
