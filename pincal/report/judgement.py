"""A calibration judged: whether the model explains the data, what it does not identify, and what to
do next.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple, Protocol

import numpy as np

from pincal.calibration.calibration import Calibration
from pincal.calibration.caveats import CaveatKind
from pincal.calibration.result import Result
from pincal.calibration.result_tables import ParameterRow
from pincal.errors import few
from pincal.identify.explain import Cause, Status
from pincal.notes import Note
from pincal.report.blocks import Section
from pincal.report.report_numbers import REPORT
from pincal.report.words import noise_example
from pincal.thresholds import Count
from pincal.validate.accuracy import leading_unit
from pincal.validate.misfit import Verdict, is_informative

# Number of outliers whose lines are listed.
_LISTED: Count = 3


@dataclass(frozen=True)
class Judged:
    """Whether the model explains the data down to their noise, with the reason in a sentence."""

    judgement: Verdict
    reason: str


class Act(StrEnum):
    """What is done next, where a command does it: state the noise of the instrument, search for
    missing effects, or use the model.
    """

    DECLARE = "declare"
    SEARCH = "search"
    USE = "use"


class NextStep(NamedTuple):
    """A thing to do next in words, and the command that does it, if there is one."""

    text: str
    act: Act | None = None


class SearchReport(Protocol):
    """What a search for missing effects says of the calibration in which it ended."""

    def judged(self) -> Judged:
        """Return whether the search has explained the data, and if not, why."""
        ...

    def next_steps(self) -> Iterator[str]:
        """Yield what the search advises."""
        ...

    def section(self) -> Section:
        """Return what the search found, for the page."""
        ...


def judged(result: Result, search: SearchReport | None = None) -> Judged:
    """Return whether the model explains the data down to their noise, with or without a search for
    missing effects.
    """
    verdict = result.verdict_of() if search is None else search.judged().judgement
    if not result.converged:
        return Judged(verdict, "The fit did not converge; do not use its numbers.")
    if result.doubt:
        return Judged(verdict, f"Do not use it. {see_doubts(result.doubts)}.")
    if search is not None:
        return search.judged()
    if result.is_kept:
        words = (
            "The readings can't improve the robot, which stays as in its URDF; instrument and "
            "target are calibrated."
        )
        return Judged(verdict, words)
    return Judged(verdict, _explained(result, verdict))


def _explained(result: Result, verdict: Verdict) -> str:
    """Return what a verdict on a fit without doubt rests on."""
    compared = result.noise_test
    if verdict is Verdict.NOT_ADEQUATE and compared is not None and compared.is_misfit:
        size = relative_to_noise(compared.ratio, compared.noise, is_misfit=True)
        return f"The residuals are {size}: the robot has errors that this model does not describe."
    if verdict is Verdict.NOT_ADEQUATE:
        return f"{see_doubts(result.doubts)}."
    if verdict is Verdict.NOT_JUDGED and result.doubts:
        return (
            "There are too few poses to judge whether it is complete; see the doubt stated first."
        )
    if verdict is Verdict.NOT_JUDGED:
        return f"{unjudged(result)}."
    assert compared is not None
    size = relative_to_noise(compared.ratio, compared.noise, is_misfit=False)
    return f"The residuals are {size}."


def unjudged(result: Result) -> str:
    """Return why a model whose noise was estimated is not judged, and what would judge it."""
    option = noise_option(result)
    if not option and result.noise.get("declared"):
        return (
            "The noise of some readings was estimated from their residuals, which can't show "
            "whether effects are missing: measure more poses with the instrument whose noise is "
            "declared"
        )
    cure = (
        f"state the instrument's own ({option}), or measure ten poses three times"
        if option
        else "measure ten poses with an instrument of known noise as well"
    )
    return f"Noise estimated from the residuals can't show whether effects are missing: {cure}"


def noise_option(result: Result) -> str:
    """Return the option that states the noise of a calibration's instrument, with an example of its
    value; "" where its readings are neither lengths nor pixels.
    """
    return noise_example(result.noise)


def see_doubts(doubts: Sequence[Note]) -> str:
    """Return where to read why a model is in doubt."""
    return "See the doubt stated first" if len(doubts) == 1 else "See the doubts stated first"


def relative_to_noise(ratio: float, noise: str, *, is_misfit: bool) -> str:
    """Return the size of residuals relative to a noise, in words that contradict neither ratio nor
    judgement.

    Example:
        >>> relative_to_noise(1.004, "the noise", is_misfit=True)
        'slightly larger than the noise, but in too many rows to be chance'
        >>> relative_to_noise(1.2, "the noise", is_misfit=False)
        '1.20 times the noise, which may be chance'
        >>> relative_to_noise(1.2, "the noise", is_misfit=True)
        '1.20 times the noise'
    """
    shown = f"{ratio:.2f} times {noise}"
    if float(f"{ratio:.2f}") <= 1.0:
        return (
            f"slightly larger than {noise}, but in too many rows to be chance"
            if is_misfit
            else f"no larger than {noise}"
        )
    return shown if is_misfit else f"{shown}, which may be chance"


def next_steps(calibration: Calibration, search: SearchReport | None = None) -> list[str]:
    """Return what to do next after a calibration, with or without a search for missing effects, the
    most pressing first.
    """
    return [step.text for step in steps_after(calibration, search)]


def steps_after(calibration: Calibration, search: SearchReport | None = None) -> list[NextStep]:
    """Return what to do next, the most pressing first, each with its command where it has one.

    What has to be mended comes first, then what judges or completes the model, then its use; what
    would improve it further comes last.
    """
    result = calibration.result
    if result.doubt:
        return [NextStep("Find out what is wrong, by the doubt stated first, and calibrate again.")]
    steps = [
        *map(NextStep, [*_of_the_fit(result), *_of_no_gain(result), *_of_the_tool(calibration)]),
        *map(NextStep, _of_the_measuring(result)),
        *_of_the_model(calibration, search, judged(result, search).judgement),
    ]
    if not steps:
        is_adequate = judged(result, search).judgement is not Verdict.NOT_ADEQUATE
        within = "" if is_adequate else " where its uncertainty suffices"
        others = _WITHOUT_URDF if calibration.fit.without_urdf else _OTHERS
        steps.append(NextStep(f"Use it{within}: {_USE.format(others)}", Act.USE))
    steps += map(NextStep, _improvements(calibration, search))
    return steps


_USE = (
    "pincal predict, compensate and measure take model.json, {}; in a few months pincal diagnose "
    "tells whether the robot has changed."
)
_OTHERS = "other programs calibrated.urdf"
_WITHOUT_URDF = "which alone holds the calibration"


def _improvements(calibration: Calibration, search: SearchReport | None) -> Iterator[str]:
    """Yield what would improve a model that is in use, or tell more of it."""
    result = calibration.result
    yield from _of_the_rows(result)
    yield from _of_held_out_rows(result)
    if search is not None:
        yield from search.next_steps()
    if narrow := ", ".join(
        f"{name} ({100 * share:.0f} %)" for name, share in narrow_joints(calibration)
    ):
        yield (
            f"These joints moved through little of their range: {narrow}. Outside it the "
            "model is not validated."
        )


def _of_the_fit(result: Result) -> Iterator[str]:
    """Yield what to do about a fit that can't be used yet."""
    if not result.converged:
        yield (
            "Check units, joint order, and rows that do not belong to this robot; pincal "
            "check helps."
        )
    if result.shift:
        yield (
            "Make the rows before and after the shift two stations (column station), and "
            "calibrate again."
        )
    if result.is_kept:
        yield (
            "Measure more poses, or with less noise: pincal design predicts how many "
            "poses reach an accuracy."
        )
    if not is_informative(result.degrees):
        yield "Measure more poses: these are too few to distinguish a good model from a bad one."


def _of_the_tool(calibration: Calibration) -> Iterator[str]:
    """Yield what to do about a target whose place on the tool the poses do not determine."""
    if calibration.fit.options.unturned:
        yield (
            "Add poses with the wrist turned about two axes, or give the place of the target "
            "(tool in cell.toml), and calibrate again."
        )


# What to do about a doubt of how the rows were measured, which no effect of the arm explains.
_MEASURED = {
    CaveatKind.SORTED: "Measure some of the first poses once more at the end, or all in random "
    "order, and calibrate again: without that, drift may be taken for an effect of a joint.",
    CaveatKind.CONTRADICTED: "Check the given values that the readings contradict (the doubt "
    "names them), and calibrate again.",
    CaveatKind.WRONG_LENGTH: "Measure the distance that the doubt names again, and calibrate "
    "again: the scale of the whole arm follows it.",
    CaveatKind.OWN_POSE: "Supply the readings of an instrument, or name their columns (--columns).",
    CaveatKind.UNSEEN_DIRECTION: "Measure in other directions, too (contacts or anchors "
    "elsewhere), and calibrate again.",
    CaveatKind.BLIND: "Measure in more directions and at more places, or with an instrument.",
    CaveatKind.NOISY_REPEATS: "Find out why readings of one stop differ, or declare the noise that "
    "they show.",
    CaveatKind.VISITS_SCATTER: "Find out why visits of a pose differ, such as a loose target, or "
    "declare the noise that they show.",
}
# The same of doubts that an effect may explain where the residuals exceed the noise, or may do so.
_WITHIN_NOISE = {
    kind: "Find out what changed while the rows were measured (set-up of the instrument, "
    "temperature, clamping), measure again, or give it a column, and calibrate."
    for kind in (CaveatKind.DEPENDENT_ROWS, CaveatKind.BLOCKS, CaveatKind.VISITS_APART)
}


def _of_the_measuring(result: Result) -> Iterator[str]:
    """Yield what to do about the first doubt of how the rows were measured, unless residuals
    beyond the noise call for a search first.
    """
    compared = result.noise_test
    if compared is not None and compared.is_misfit:
        return
    cures = _MEASURED if compared is None else _MEASURED | _WITHIN_NOISE
    yield from [cures[kind] for kind in result.doubted if kind in cures][:1]


def _of_the_model(
    calibration: Calibration, search: SearchReport | None, judgement: Verdict
) -> Iterator[NextStep]:
    """Yield what would judge a model, and what to do about effects that it lacks."""
    result = calibration.result
    is_open = result.converged and not result.is_kept and is_informative(result.degrees)
    if not any(station.sensor.reads_place for station in calibration.fit.problem.stations):
        yield NextStep(
            "Measure six to ten poses with an instrument, or in sockets, and calibrate "
            "with both: an IMU gives no lengths."
        )
    elif search is not None or not is_open or judgement is Verdict.ADEQUATE:
        return
    elif result.noise_test is not None and any(_of_the_measuring(result)):
        # Residuals within the noise hold nothing for a search to find.
        return
    elif judgement is Verdict.NOT_JUDGED and (option := noise_option(result)):
        yield NextStep(
            f"Calibrate again with the noise of the instrument ({option}, the standard deviation "
            "of one coordinate by its data sheet): it decides whether effects are missing.",
            Act.DECLARE,
        )
    else:
        yield NextStep(
            "Run pincal discover on the same data: it identifies the effects that the model lacks.",
            Act.SEARCH,
        )


def _of_the_rows(result: Result) -> Iterator[str]:
    """Yield what to do about rows that were rejected, and where no instrument measured."""
    if lines := result.outliers:
        yield (
            f"Inspect the rejected outliers, line {few(lines, _LISTED)}: a loose target, "
            "or a slipping joint?"
        )
    if improved := result.improvement or ():
        worst = max(improved, key=lambda region: region.after_mm)
        yield (
            f"No instrument measured the robot: {worst.link} is known to "
            f"{worst.after_mm:.2g} mm at worst ({worst.region}). "
            "If that is not enough, measure a few poses with one as well."
        )


def _of_no_gain(result: Result) -> Iterator[str]:
    """Yield what to do where poses that were held out are not predicted better than before."""
    after = result.error["calibrated"].get("test")
    if after is None:
        return
    rms = f"rms_{leading_unit(after)}"
    if after[rms] > result.error["nominal"]["test"][rms]:
        yield (
            "Held-out poses are predicted no better than by the URDF: measure more "
            "poses, or with less noise."
        )


def _of_held_out_rows(result: Result) -> Iterator[str]:
    """Yield what to do by the errors at rows that were held out, if any were."""
    error = result.error["calibrated"]
    if "test" not in error:
        yield (
            "Hold rows out (--test-fraction) or measure more (--holdout): otherwise the "
            "accuracy is not validated."
        )
        return
    # Both kinds of held-out rows together.
    rms = f"rms_{leading_unit(error['test'])}"
    ways = [error[way][rms] for way in error if way not in ("train", "test")] or [
        error["test"][rms]
    ]
    if (
        not any(_of_no_gain(result))
        and np.sqrt(np.mean(np.square(ways))) > REPORT.overfitted * error["train"][rms]
    ):
        yield (
            "Held-out errors exceed fitted ones: measure more poses, spread over the "
            "whole range of use."
        )


class Advice(NamedTuple):
    """The meaning of some causes for which parameters are not identified, and what to measure if
    that matters.
    """

    causes: tuple[Cause, ...]
    title: str
    text: str


# In the order in which they are shown: those that call for action last.
_ADVICE = (
    Advice(
        (Cause.ABSORBS,),
        "Placement of instrument and target",
        "The stated uncertainty only reflects that the placement and the robot's first or last "
        "link share an offset. Predictions are not affected; nothing has to be measured.",
    ),
    Advice(
        (Cause.BASE, Cause.TOOL, Cause.FRAMES),
        "Absorbed by the unknown placement of instrument or target",
        "Neither the instrument's nor the target's position is known, and moving either is "
        "indistinguishable from a change of these parameters. Predictions in the instrument's "
        "frame do not depend on the choice. To separate them, measure the robot's foot or the "
        "target's offset independently and pass it to the calibration (--tool).",
    ),
    Advice(
        (Cause.PARALLEL_AXES, Cause.COMBINATION, Cause.ALIASED, Cause.HIDDEN),
        "Parameters with the same effect",
        "In all of these poses these parameters have the same effect as others; only the "
        "combination moves the target, and the combination is calibrated. Predictions at such "
        "poses need no more. Where axes are parallel, no poses separate them; otherwise poses that "
        "differ more from each other may, which matters only if the robot is used there: the "
        "summary states the error to expect elsewhere.",
    ),
    Advice(
        (Cause.MASS,),
        "Masses missing in the robot description",
        "Only compliance times moment deflects the arm; predictions need nothing else. The "
        "identified moments are listed under Static moments. The robot's mass from its data sheet "
        "(--mass) or rows with other payloads would determine their common factor.",
    ),
    Advice(
        (Cause.NO_MOMENT,),
        "Never loaded by gravity",
        "No pose has a moment about this axis, so its compliance is not observable. It does not "
        "matter as long as the mounting does not change; only a tilted mounting would reveal it.",
    ),
    Advice(
        (Cause.NOT_EXCITED, Cause.NOT_OBSERVED),
        "Not excited",
        "No pose excites these parameters. Measure poses in which the joint moves through "
        "its whole range.",
    ),
    Advice(
        (Cause.UNINFORMED, Cause.WEAK),
        "Too little signal in these poses",
        "The effect of these parameters is small compared with the noise. Measure with the "
        "heaviest payload, with the arm stretched out, and with this joint through its whole "
        "range; four times as many poses halve the uncertainty.",
    ),
    Advice(
        (Cause.NOT_IMPROVED,),
        "Not improved by these readings",
        "The robot is expected to be closer to its description than these readings can tell, so "
        "that their noise would make it worse. Measure more poses, or with less noise.",
    ),
    Advice(
        (Cause.AT_BOUND,),
        "Stopped at a bound",
        "The estimate exceeds what the bound allows. Check this length in the URDF and the units "
        "of the table, or raise the bound with --length-bound.",
    ),
    Advice((Cause.GIVEN, Cause.NOT_NEEDED), "Given", "Fixed at your request, or by default."),
)


class UnidentifiedGroup(NamedTuple):
    """The names of parameters that are not identified for the same cause, with advice."""

    advice: Advice
    names: tuple[str, ...]


def unidentified_groups(parameters: Sequence[ParameterRow]) -> tuple[UnidentifiedGroup, ...]:
    """Return the parameters that are not identified, by cause, the causes that call for action
    last.

    Example:
        >>> from pincal.identify.explain import Reason
        >>> reason = Reason(Cause.NO_MOMENT, axis="z")
        >>> row = ParameterRow("a.k_z", "rad/(N m)", 0.0, 0.0, 1e-6, Status.UNIDENTIFIABLE, reason)
        >>> [(group.advice.title, group.names) for group in unidentified_groups([row])]
        [('Never loaded by gravity', ('a.k_z',))]
    """
    open_rows = [row for row in parameters if row.status is not Status.IDENTIFIED]
    groups = (
        UnidentifiedGroup(
            advice, tuple(row.name for row in open_rows if row.reason.cause in advice.causes)
        )
        for advice in _ADVICE
    )
    return tuple(group for group in groups if group.names)


def narrow_joints(calibration: Calibration) -> tuple[tuple[str, float], ...]:
    """Return joints that moved through little of their range, with the fraction that
    they covered, of those that do not follow from others.
    """
    robot = calibration.robot
    q = np.vstack([rows.train.of_joints(calibration.robot).q for rows in calibration.stations])
    found = []
    for i in robot.own_joints:
        name = robot.joint_names[i]
        width = float(robot.upper[i] - robot.lower[i])
        # Beyond one revolution a joint adds nothing new.
        if robot.joint_types[i] != "prismatic":
            width = min(width, 2.0 * np.pi)
        share = float(np.ptp(q[:, i])) / width if np.isfinite(width) and width > 0.0 else 1.0
        if share < REPORT.narrow:
            found.append((str(name), share))
    return tuple(found)
