"""A calibration judged: whether the model explains the data, and what to do next. Decisions first, words at the end."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, StrEnum

from pincal.calibration.result import Result
from pincal.calibration.run import Calibration
from pincal.discover.run import Discovery
from pincal.model.catalogue import untestable
from pincal.report.advice import narrow_joints
from pincal.report.words import effect_words
from pincal.validate.lack_of_fit import MISFIT

# Ratio of held-out to fitted rms error above which the rows were too few. N rows and p parameters make it about
# sqrt((N + p) / (N - p)): 1.3 is reached when a quarter as many readings as there are go into parameters.
_OVERFITTED = 1.3
# What columns are called in a table, where that is not their name.
_COLUMNS = {"approach": "approach_<joint>"}


class Judgement(StrEnum):
    """Whether the model is all that the data show; the values are those of ``discovery.json`` and the report."""

    ADEQUATE = "adequate"
    NOT_ADEQUATE = "not adequate"
    NOT_JUDGED = "not judged"
    NOT_CONVERGED = "not converged"


_LACKS = "the robot does something that this model does not describe."


class Ground(Enum):
    """What a judgement rests on; the values are what is said if the model is not adequate, and if it is."""

    CONVERGENCE = ("The fit did not converge; do not use its numbers.", "")
    SEARCH = (
        "{added}; {unexplained:.3f} mm rms beyond the noise remain unexplained.",
        "{added}; the remaining residuals look like noise.",
    )
    REPLICATES = (
        f"The residuals exceed the scatter between repeated measurements of a pose: {_LACKS}",
        "The residuals are no larger than the scatter between repeated measurements of a pose.",
    )
    DECLARED_NOISE = (
        f"The residuals are {{ratio:.2f}} times the declared noise: {_LACKS}",
        "The residuals are no larger than the declared noise of the instrument.",
    )
    NOTHING = (
        "The noise of the instrument was estimated from the residuals, so they cannot show whether the model is complete: "
        "declare the noise (--noise), or let pincal discover look for missing effects.",
        "",
    )


@dataclass(frozen=True)
class Verdict:
    """Whether the model explains the data down to their noise, and why; ``str()`` gives it in a sentence.

    A search has added ``effects`` effects and left an rms error of ``unexplained_mm`` beyond the noise; ``ratio`` is that of
    the residuals to the declared noise.
    """

    judgement: Judgement
    ground: Ground
    effects: int = 0
    unexplained_mm: float = 0.0
    ratio: float = 1.0

    def __str__(self) -> str:
        n = self.effects
        added = (
            f"{n} effects were found and added" if n > 1 else "One effect was found and added" if n else "Nothing was added"
        )
        words = self.ground.value[self.judgement is Judgement.ADEQUATE]
        return words.format(added=added, unexplained=self.unexplained_mm, ratio=self.ratio)


def verdict_of(result: Result, discovery: Discovery | None = None) -> Verdict:
    """Return whether the model explains the data down to their noise, after a search for what is missing or without."""
    if not result.converged:
        return Verdict(Judgement.NOT_CONVERGED, Ground.CONVERGENCE)
    if discovery is not None:
        found = discovery.findings
        judgement = Judgement(found.verdict)
        return Verdict(judgement, Ground.SEARCH, effects=len(found.effects), unexplained_mm=found.unexplained_mm)
    if result.chi2_p_value is not None:
        judgement = Judgement.NOT_ADEQUATE if result.chi2_p_value < MISFIT else Judgement.ADEQUATE
        return Verdict(judgement, Ground.DECLARED_NOISE, ratio=result.chi2_reduced**0.5)
    if result.lack_of_fit is not None:
        judgement = Judgement.NOT_ADEQUATE if result.lack_of_fit.is_significant else Judgement.ADEQUATE
        return Verdict(judgement, Ground.REPLICATES)
    return Verdict(Judgement.NOT_JUDGED, Ground.NOTHING)


class Action(Enum):
    """What to do next; the values are how it is said, with the step's particulars in braces."""

    CHECK_DATA = "Check units, joint order, and rows that do not belong to this robot; pincal check helps."
    DISCOVER = "Run pincal discover on the same data: it looks for the effects that the model lacks, and names them."
    TELL_APART = "To decide between {0} and its alternatives: {1}."
    RECORD_FOR_SCATTER = "Record {1}: it may explain why {0} scatters."
    RECORD_COLUMNS = "Record {0} with each pose, so that effects that depend on it can be tested."
    CHECK_OUTLIERS = "Look at the {0} rows that were rejected as outliers: a loose target or a slipping joint?"
    HOLD_OUT = "Hold rows out (--test-fraction) or measure more (--holdout): otherwise the accuracy is not validated."
    MEASURE_MORE = "Held-out errors exceed fitted ones: measure more poses, spread over the whole range of use."
    WIDEN_RANGE = "These joints moved through little of their range: {0}. Outside it the model is not validated."
    USE = (
        "Use it: model.json predicts poses (pincal predict), calibrated.urdf carries the geometry to other programs, and "
        "pincal validate checks the model against new measurements in a few months."
    )


@dataclass(frozen=True)
class NextStep:
    """An action with its particulars; ``str()`` gives it in words."""

    action: Action
    particulars: tuple[str, ...] = ()

    def __str__(self) -> str:
        return self.action.value.format(*self.particulars)


def next_steps(calibration: Calibration, discovery: Discovery | None = None) -> list[NextStep]:
    """Return what to do next after a calibration or a discovery, the most pressing first."""
    result, steps = calibration.result, list[NextStep]()
    judgement = verdict_of(result, discovery).judgement
    if judgement is Judgement.NOT_CONVERGED:
        steps.append(NextStep(Action.CHECK_DATA))
    if discovery is None and judgement in (Judgement.NOT_ADEQUATE, Judgement.NOT_JUDGED):
        steps.append(NextStep(Action.DISCOVER))
    if discovery is not None:
        steps += _after_discovery(discovery)
    if result.outliers:
        steps.append(NextStep(Action.CHECK_OUTLIERS, (str(len(result.outliers)),)))
    error = result.error["calibrated"]
    if "test" not in error:
        steps.append(NextStep(Action.HOLD_OUT))
    elif error["test"]["rms_mm"] > _OVERFITTED * error["train"]["rms_mm"]:
        steps.append(NextStep(Action.MEASURE_MORE))
    narrow = narrow_joints(calibration)
    if narrow:
        names = ", ".join(f"{name} ({100 * share:.0f} %)" for name, share in narrow)
        steps.append(NextStep(Action.WIDEN_RANGE, (names,)))
    if judgement in (Judgement.ADEQUATE, Judgement.NOT_JUDGED) or not steps:
        steps.append(NextStep(Action.USE))
    return steps


def _after_discovery(discovery: Discovery) -> list[NextStep]:
    found = discovery.findings
    steps = [NextStep(Action.TELL_APART, (effect_words(e), e.tell_apart)) for e in found.effects if e.tell_apart]
    steps += [NextStep(Action.RECORD_FOR_SCATTER, (entry.joint, entry.missing)) for entry in found.scatter]
    if Judgement(found.verdict) is not Judgement.ADEQUATE:
        problem, table = discovery.calibration.fit.station, discovery.calibration.train
        needed = {column for effect, _ in untestable(problem.model.chain, problem.conditions) for column in effect.needs}
        missing = sorted(_COLUMNS.get(column, column) for column in needed if getattr(table, column) is None)
        steps += [NextStep(Action.RECORD_COLUMNS, (", ".join(missing),))] if missing else []
    return steps
