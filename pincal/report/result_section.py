"""The first section of the page on a calibration: its result, and what that means."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from markupsafe import Markup
from msgspec import UNSET

from pincal.calibration.result import Result
from pincal.errors import counted
from pincal.notes import Note
from pincal.report.blocks import (
    RESULT,
    PageBlock,
    Section,
    arranged,
    bullets,
    doubts,
    folded,
    glance,
    heading,
    in_pointer,
    merged,
    paragraph,
    plain_notes,
    rich,
    sourced,
)
from pincal.report.judgement import judged, next_steps
from pincal.report.report_numbers import REPORT
from pincal.report.subject import Subject
from pincal.report.words import (
    elsewhere_words,
    is_noise_declared,
    noise_keys,
    noise_words,
)
from pincal.result_table import RowTone
from pincal.thresholds import Count, Scale
from pincal.validate.accuracy import leading_unit
from pincal.validate.misfit import Verdict
from pincal.validate.outcome import Expanded

# Tolerance of the example [mm], and tolerance over U of which a tenth is lost (ISO 14253-2).
EXAMPLE: Scale = 0.5
LOST: Scale = 10.0
_STATISTICS = (("mean", "mean"), ("p95", "95 %"), ("max", "worst"))
# Rows of which fewer tell no 95 %: one of twenty may lie beyond it.
_FEW: Count = 20
_TONES: dict[str, RowTone] = {Verdict.ADEQUATE: "good", Verdict.NOT_JUDGED: "care"}


def summary(subject: Subject) -> Section:
    """The result in a sentence, what it means for a tolerance, the verdict, and what to do next."""
    result = subject.result
    verdict = judged(subject.result, subject.search)
    tone = _TONES.get(verdict.judgement, "bad")
    tag = rich('<span class="tag {}">{}</span> {}', tone, verdict.judgement, verdict.reason)
    steps = bullets(next_steps(subject.calibration, subject.search))
    following = arranged("plain", heading("What to do next"), steps)
    tolerance = tuple(_worth(subject))
    columns = (
        arranged("split", arranged("plain", *tolerance), following) if tolerance else following
    )
    blocks = (
        *doubts(result.warnings),
        *(paragraph(words, "headline") for words in _headlines(subject)),
        paragraph(tag),
        arranged("glance", *_glance(subject)),
        columns,
        paragraph(_stated_by(subject)),
        *_elsewhere(subject),
        *_notes(result.warnings),
    )
    return Section("summary", "Result", blocks, style="panel")


def _notes(found: Sequence[Note]) -> Iterator[PageBlock]:
    """Yield the notes that are no doubts, folded where there are several."""
    notes = [*plain_notes(found)]
    if len(notes) > 1:
        yield folded(counted(len(notes), "note"), *notes)
    else:
        yield from notes


def _headlines(subject: Subject) -> Iterator[Markup]:
    """Yield what the calibration gained, the more telling first: of an IMU alone that is of the
    angles, as most of its readings' errors are vibration and noise.
    """
    gained = [*_gain_of_angles(subject.result)]
    is_placed = leading_unit(subject.result.error["calibrated"][subject.part]) == "mm"
    yield from [_headline(subject), *gained] if is_placed else [*gained, _headline(subject)]


def _gain_of_angles(result: Result) -> Iterator[Markup]:
    """Yield how well an IMU lets the angles of the arm be known."""
    gain = result.angle_gain
    if gain is UNSET:
        return
    at = f"{RESULT}/angle_gain"
    yield rich(
        "{} combinations of the {} angles of joints and links are known to <b>{}</b> (standard "
        "deviation); before calibration, to <b>{}</b>.",
        sourced(str(gain.gained), f"{at}/gained"),
        sourced(str(gain.angles), f"{at}/angles"),
        sourced(_size(gain.after_mrad, "mrad"), f"{at}/after_mrad"),
        sourced(_size(gain.before_mrad, "mrad"), f"{at}/before_mrad"),
    )


def _headline(subject: Subject) -> Markup:
    """Return the mean error now and before."""
    errors = subject.result.error
    part = subject.part
    unit = leading_unit(errors["calibrated"][part])
    key = f"mean_{unit}"
    before, after = (errors[model][part][key] for model in ("nominal", "calibrated"))
    ratio = before / after if after > 0.0 else 1.0
    at = {model: f"{RESULT}/error/{model}/{part}/{in_pointer(key)}" for model in errors}
    shown = (
        sourced(_size(size, unit), at[model])
        for model, size in (("calibrated", after), ("nominal", before))
    )
    number = sourced(f"{ratio:.1f}", at["nominal"], over=at["calibrated"])
    times = rich(" ({} times as large)", number) if ratio >= REPORT.improved else ""
    return rich(
        "The mean error of the model is <b>{}</b>; before calibration it was <b>{}</b>{}.",
        *shown,
        times,
    )


def _stated_by(subject: Subject) -> Markup:
    """Return at what poses the first errors of the page are, and the noise."""
    result = subject.result
    noise = (
        "The declared noise of the instrument is"
        if is_noise_declared(result.noise)
        else "The residuals, which contain the noise and all errors that the model omits, have "
        "a standard deviation of"
    )
    pointers = (f"{RESULT}/noise/{key}" for key in noise_keys(result.noise))
    shown = sourced(noise_words(result.noise), *pointers)
    return rich("{}. {} {}.", _predicted(subject), noise, shown)


_APART = {
    "regions": "its region of joint space",
    "stretches": "its stretch of consecutive rows",
    "sessions": "its session",
    "random": "its random part of the rows",
}


def _predicted(subject: Subject) -> Markup:
    """Return at what poses the first errors of the page are."""
    result = subject.result
    if result.left_out_mm is not None:
        return rich(
            "These are errors on set-ups not used by the calibration, each predicted with the "
            "model of the others"
        )
    if subject.part == "train":
        return rich(
            "No poses were held out, so these are the errors of the fit itself, not of new poses"
        )
    rows = _rows_held_out(result)
    validation = result.validation
    if validation is UNSET or validation.way not in _APART:
        return rich("These are errors in {} rows that the calibration has not used", rows)
    others = len(result.error["calibrated"]) > len(("train", "test", validation.way))
    worse = ", the way of holding out in which predictions are worse" if others else ""
    words = "Each of {} rows is predicted by a fit without {}{}"
    return rich(words, rows, _APART[validation.way], worse)


def _rows_held_out(result: Result) -> Markup:
    """Return the number of rows that the first errors of the page are of: of stations whose
    instruments differ, those that read positions.
    """
    counts = {f"{RESULT}/rows/test": result.rows["test"]}
    if result.stations is not UNSET:
        key = f"mean_{leading_unit(result.error['calibrated']['test'])}"
        of = {
            f"{RESULT}/stations/{k}/rows/test": int(station["rows"]["test"])
            for k, station in enumerate(result.stations)
            if key in station["error"]["calibrated"].get("test", ())
        }
        counts = of if len(of) < len(result.stations) else counts
    return merged([sourced(str(count), at) for at, count in counts.items()], " + ")


def _elsewhere(subject: Subject) -> Iterator[Markup]:
    """Yield the error that the model expects away from the measured poses."""
    found = subject.result.elsewhere
    if found is not UNSET:
        words = elsewhere_words(found, subject.result.error["calibrated"][subject.part])
        pointers = (f"{RESULT}/elsewhere/{name}_mm" for name in ("mean", "worst"))
        meaning = (
            "The model expects this by the uncertainty of its parameters, what it lacks and how "
            "the robot arrives."
        )
        yield paragraph(rich("Elsewhere: {}. {}", sourced(words, *pointers), meaning))


def _worth(subject: Subject) -> Iterator[Markup]:
    """Yield what the uncertainty means for a tolerance, unless the result is in doubt."""
    found = subject.result.uncertainty
    if found is UNSET or subject.result.doubt:
        return
    yield heading("What this means for a tolerance")
    errors = subject.result.error["calibrated"][subject.part]
    items = [_worth_to_measure(found)]
    if "p95_mm" in errors:
        is_few = subject.readings[0].part(held=subject.part == "test").sum() < _FEW
        key = "max_mm" if is_few else "p95_mm"
        to_place = rich(
            "<b>To drill or place</b>: {} readings lay within {} of where the model "
            "predicts, the noise of the instrument included.",
            "all" if is_few else "95 of 100",
            sourced(_size(errors[key], "mm"), f"{RESULT}/error/calibrated/{subject.part}/{key}"),
        )
        items.insert(0, to_place)
    yield bullets(items)
    yield paragraph(rich("This rests on {}.", found.rests_on), "mute")


def _worth_to_measure(found: Expanded) -> Markup:
    here, anywhere = (f"{RESULT}/uncertainty/{name}_mm" for name in ("here", "anywhere"))
    words = (
        "<b>To measure</b>: U (k = {:.0f}) of a coordinate is {} at these poses, {} anywhere. A "
        "hole with a tolerance of ± {:g} mm is {} (ISO 14253-1). Only a tenth of the tolerance is "
        "lost to U from ± {} on."
    )
    return rich(
        words,
        found.k,
        sourced(_size(found.here_mm, "mm"), here),
        sourced(_size(found.anywhere_mm, "mm"), anywhere),
        EXAMPLE,
        decided_words(found.here_mm, EXAMPLE),
        sourced(f"{LOST * found.here_mm:.2g} mm", here, times=LOST),
    )


def decided_words(uncertainty: float, tolerance: float) -> str:
    """Return whether readings of an expanded uncertainty decide on a symmetric tolerance, both in
    one unit.

    Example:
        >>> decided_words(0.03, 0.5)
        'verified, or rejected, unless the reading is nearer than U to a limit'
        >>> decided_words(0.6, 0.5)
        'never verified: U is larger'
    """
    if uncertainty >= tolerance:
        return "never verified: U is larger"
    return "verified, or rejected, unless the reading is nearer than U to a limit"


def _size(value: float, unit: str) -> str:
    return f"{value:.4f} {unit}" if value < 0.1 else f"{value:.3f} {unit}"


def _glance(subject: Subject) -> Iterator[Markup]:
    """Yield mean, 95 % and worst error, before and after."""
    part = subject.part
    before, after = (subject.result.error[model][part] for model in ("nominal", "calibrated"))
    lead = leading_unit(after)
    in_motion = (("m/s^2", " of acceleration"), ("mrad/s", " of angular rate"))
    others = (("mrad", " of orientation"),) if lead == "mm" else in_motion[1:]
    for unit, suffix in ((lead, dict(in_motion).get(lead, "")), *others):
        keys = {
            f"{words} error{suffix}": f"{name}_{unit}"
            for name, words in _STATISTICS
            if f"{name}_{unit}" in after
        }
        yield from glance(
            [
                (
                    title,
                    (before[key], after[key]),
                    tuple(
                        sourced(words, f"{RESULT}/error/{model}/{part}/{in_pointer(key)}")
                        for model, words in (
                            ("nominal", _size(before[key], "").rstrip()),
                            ("calibrated", _size(after[key], unit)),
                        )
                    ),
                )
                for title, key in keys.items()
            ]
        )
