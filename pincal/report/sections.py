"""The sections of the page on a calibration: each a function from the subject to a section, or to
None.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any
from urllib.parse import quote

import numpy as np
from markupsafe import Markup
from msgspec import UNSET

from pincal.calibration.held_out import StationRows
from pincal.calibration.result import Result
from pincal.calibration.result_tables import (
    ParameterRow,
    clock_table,
    correlation_table,
    error_table,
    improvement_table,
    iso9283_table,
    moved_table,
    repeated_table,
    rounded_table,
    shown_parameters,
    station_table,
)
from pincal.errors import counted, few
from pincal.identify.choices import FoundMoments, found_moments
from pincal.identify.explain import Status
from pincal.notes import Note
from pincal.parameters import FRAME_SYMBOLS, split_name
from pincal.report.blocks import (
    RESULT,
    PageBlock,
    Section,
    arranged,
    bullets,
    code,
    doubts,
    facts,
    folded,
    glance,
    heading,
    merged,
    paragraph,
    plain_notes,
    rich,
    sourced,
)
from pincal.report.illustrations import (
    correction_drawings,
    course_drawings,
    error_drawings,
    figures,
    joint_drawings,
    order_drawings,
    workspace_drawings,
)
from pincal.report.judgement import judged, next_steps, unidentified_groups
from pincal.report.report_numbers import REPORT
from pincal.report.subject import RowErrors, Subject
from pincal.report.words import (
    TERMS,
    effect_meaning,
    elsewhere_words,
    is_noise_declared,
    noise_keys,
    noise_words,
)
from pincal.result_table import Column, Kind, RowTone, Table
from pincal.robot.robot import Robot
from pincal.thresholds import Count, Scale
from pincal.units import fixed, show_chance
from pincal.validate.accuracy import ERROR_UNITS, cycle_words, leading_unit
from pincal.validate.misfit import Verdict
from pincal.validate.outcome import Expanded, StationRecord

REPEATED = Markup(
    "<b>Pose accuracy AP</b> is the distance from the predicted pose to the mean of its "
    "measurements; <b>pose repeatability RP</b> their scatter about this mean, mean distance plus "
    "three standard deviations (ISO 9283). Calibration improves AP; it cannot improve RP, which "
    "includes the noise of the instrument."
)
"""Definition of accuracy and repeatability."""

# Tolerance of the example [mm], and tolerance over U of which a tenth is lost (ISO 14253-2).
EXAMPLE: Scale = 0.5
LOST: Scale = 10.0
_STATISTICS = (("mean", "mean"), ("p95", "95 %"), ("max", "worst"))
# Number of rejected rows whose lines are listed.
_LISTED: Count = 12
# Number of parameters of an instrument that stand among those of the robot.
_FEW_OWN: Count = 6
# Rows of a table of repeated poses before it is folded: those of positions, fitted and held out.
_SHORT: Count = 4
# Rows of which fewer tell no 95 %: one of twenty may lie beyond it.
_FEW: Count = 20
# Joints whose errors are drawn, and identified parameters that are listed, before the rest is
# folded: a page of two robots has twelve and more, and a phone shows one beneath the other.
_DRAWN_JOINTS: Count = 8
_LISTED_PARAMETERS: Count = 24
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
    at = {model: f"{RESULT}/error/{model}/{part}/{_in_pointer(key)}" for model in errors}
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
                        sourced(words, f"{RESULT}/error/{model}/{part}/{_in_pointer(key)}")
                        for model, words in (
                            ("nominal", _size(before[key], "").rstrip()),
                            ("calibrated", _size(after[key], unit)),
                        )
                    ),
                )
                for title, key in keys.items()
            ]
        )


def _in_pointer(key: str) -> str:
    """Return a key as a JSON pointer has it (RFC 6901).

    Example:
        >>> _in_pointer("mean_m/s^2")
        'mean_m~1s^2'
    """
    return key.replace("~", "~0").replace("/", "~1")


def setup(subject: Subject) -> Section:
    """Robot, data, model and fit."""
    calibration = subject.calibration
    result = subject.result
    robot = subject.calibration.robot
    effects = dict.fromkeys(effect.name for effect in calibration.fit.options.effects)
    meanings = (rich("<b>{}</b> ({})", name, effect_meaning(name)) for name in effects)
    items = (
        ("robot", _arm(robot)),
        ("data", _data(subject)),
        ("3D view", _view(subject)),
    )
    more = (
        ("joints", merged(map(code, robot.joint_names), ", ")),
        ("model", merged(meanings, "; ")),
        ("fit", _fit_words(result)),
    )
    blocks = (facts(items), folded("Joints, model and fit", facts(more)))
    return Section("subject", "Robot, data and model", blocks)


def _fit_words(result: Result) -> Markup:
    """Return how the fit went."""
    names = ["iterations", "seconds", "rank", "condition", "chi2_reduced"]
    words = (
        f"{result.iterations} iterations, {result.seconds:.2f} s in all; {result.rank} "
        f"combinations of parameters determined, condition number {result.condition:.2g}; "
        f"reduced chi-square {result.chi2_reduced:.3f}"
    )
    if result.chi2_p_value is not None:
        names.append("chi2_p_value")
        words += f" (p {show_chance(result.chi2_p_value)})"
    return sourced(words, *(f"{RESULT}/{name}" for name in names))


def _arm(robot: Robot) -> Markup:
    ends = (code(robot.base), code(robot.tip))
    return rich("{}: {} from {} to {}", robot.name, counted(robot.n_joints, "joint"), *ends)


def _view(subject: Subject) -> Markup:
    if subject.view:
        return rich(
            '<a href="{}">the robot, its errors and the measured points</a>', quote(subject.view)
        )
    return rich(
        "<code>pincal view model.json {} --html view3d.html</code> shows the robot, "
        "its errors and the measured points",
        subject.calibration.stations[0].train.source,
    )


def _data(subject: Subject) -> Markup:
    stations = subject.calibration.stations
    result = subject.result
    rejected = (
        [result.outliers]
        if result.stations is UNSET
        else [station["outliers"] for station in result.stations]
    )
    return merged(
        (_rows_of(rows, lines) for rows, lines in zip(stations, rejected, strict=True)),
        Markup("<br>"),
    )


def _rows_of(rows: StationRows, outliers: Sequence[int]) -> Markup:
    train = rows.train
    test = rows.test
    other = len(test) and test.source != train.source
    rejected = (
        f", {len(outliers)} rejected as outliers (line {few(outliers, _LISTED)})"
        if outliers
        else ""
    )
    held = rich(" from {}", code(test.source)) if other else ""
    name = rich("<b>{}</b>: ", rows.name) if rows.name else ""
    held = rich(", {} held out{}", len(test), held) if len(test) else Markup("")
    return rich(
        "{}{} in {}: {} fitted{}{}",
        name,
        train.kind,
        code(train.source),
        counted(len(train), "row"),
        held,
        rejected,
    )


_CLOCKS = (
    "Instruments that measured the arm in motion have clocks of their own. Each was aligned with "
    "that of the joints by the speeds that both measure; offset and drift were then fitted "
    "together with all other parameters."
)


def accuracy(subject: Subject) -> Section:
    """Errors before and after, and their distribution."""
    result = subject.result
    leading = (leading_unit(result.error["calibrated"]["train"]),)
    blocks: list[PageBlock] = [paragraph(_meaning_of_errors(result))]
    if not result.rows["test"]:
        text = (
            "No rows were held out: the errors are those of the poses that were fitted. Expect "
            "somewhat larger ones at new poses."
        )
        blocks.append(paragraph(text, "note"))
    clocks: tuple[PageBlock, ...] = ()
    if result.clocks is not UNSET:
        clocks = (heading("Clocks", "clocks"), paragraph(_CLOCKS), clock_table(result.clocks))
    blocks += [
        error_table(result.error, only=leading),
        *_distributions(subject),
        *_other_readings(subject, [unit for unit in ERROR_UNITS if unit not in leading]),
        *_replicates(result),
        *clocks,
    ]
    return Section("accuracy", "Before and after", tuple(blocks), "Accuracy")


def _distributions(subject: Subject) -> Iterator[PageBlock]:
    """Yield how the errors of the first readings are distributed, all but one figure folded."""
    first, *others = error_drawings(subject.readings[:1])
    yield figures("accuracy", [first])
    if others:
        yield folded("Further figures of these errors", figures("distribution", others))


def _meaning_of_errors(result: Result) -> Markup:
    if "mean_mm" not in result.error["calibrated"]["train"]:
        return rich(
            "An IMU measures no positions: an error is a reading, filtered in time, minus "
            "its prediction. "
            "Most of it is vibration of the arm and noise, which no calibration improves."
        )
    return rich(
        "The error at a pose is the distance from the predicted to the measured target: the "
        "<b>accuracy</b> of a single measurement (ISO 9283). It is not the <b>repeatability</b>, "
        "the scatter between repeated measurements of a pose, which no calibration improves. "
        "“Nominal” is the robot of the URDF, with only the placement of instrument and target "
        "fitted."
    )


def _other_readings(subject: Subject, units: Sequence[str]) -> Iterator[PageBlock]:
    """Yield the errors of readings that are not the first ones, folded; their units are given."""
    table = error_table(subject.result.error, only=units)
    if len(table):
        names = dict.fromkeys(evidence.name.replace("_", " ") for evidence in subject.readings[1:])
        drawn = figures("other", error_drawings(subject.readings[1:]))
        yield folded(f"Errors of {' and '.join(names) or 'other readings'}", table, drawn)


def _replicates(result: Result) -> list[PageBlock]:
    """Return accuracy, repeatability and lack of fit from repeated measurements of poses."""
    iso = result.iso9283
    lack = result.lack_of_fit
    blocks: list[PageBlock] = (
        [heading("Repeated measurements of a pose", "repeatability")] if iso or lack else []
    )
    if iso:
        text = rich(
            "{} {}. A pose of which the fit has used any measurement does not count as held out.",
            REPEATED,
            cycle_words(iso),
        )
        table = iso9283_table(iso)
        shown = (paragraph(text), table)
        title = "Pose accuracy and repeatability (ISO 9283)"
        blocks += [folded(title, *shown)] if len(table) > _SHORT else shown
    if lack:
        sentence = (
            "<b>Lack of fit.</b> Repeated measurements of a pose scatter by {}, whatever the "
            "model. {}."
        )
        blocks.append(paragraph(rich(sentence, lack.scatter, lack)))
    if result.repeatability is not UNSET:
        sentence = "<b>Scatter</b>, as a standard deviation of one coordinate: {}."
        blocks.append(paragraph(rich(sentence, str(result.repeatability))))
    return blocks


def stations(subject: Subject) -> Section | None:
    """Errors station by station, before and after; None where there is only one."""
    records = subject.result.stations
    if records is UNSET:
        return None
    text = (
        "Each station, a set-up of instrument and targets, has its own base frame, targets and "
        "noise; the robot is the same at all of them."
    )
    if any("left_out" in record for record in records):
        text += (
            " Left out: errors of the model of the other stations, with only the placement of this "
            "one fitted. This is the accuracy to expect on another day."
        )
    shown = [_mean_error(k, record, subject.part) for k, record in enumerate(records)]
    blocks: list[PageBlock] = [
        paragraph(text),
        arranged("glance", *glance(shown)),
        station_table(records),
        *_moved(records),
    ]
    if (again := repeated_table(records)) is not None:
        blocks += [
            heading("Repeated measurements of poses", "repeatability"),
            paragraph(REPEATED),
            again,
        ]
    return Section("stations", "Stations", tuple(blocks), "Stations")


def _mean_error(
    k: int, record: Mapping[str, Any], part: str
) -> tuple[str, tuple[float, float], tuple[str, str]]:
    """Return what is shown of the k-th station: its name, the errors before and after, and both in
    words.
    """
    part = part if part in record["error"]["calibrated"] else "train"
    nominal, calibrated = (by_part[part] for by_part in record["error"].values())
    # A station that was left out is predicted with the model of the others.
    unit = leading_unit(calibrated)
    before = nominal[f"mean_{unit}"]
    after = record.get("left_out", calibrated)[f"mean_{unit}"]
    key = _in_pointer(f"mean_{unit}")
    at = f"{RESULT}/stations/{k}"
    found = "left_out" if "left_out" in record else f"error/calibrated/{part}"
    words = (
        sourced(f"{before:.3f}", f"{at}/error/nominal/{part}/{key}"),
        sourced(f"{after:.4f} {unit}", f"{at}/{found}/{key}"),
    )
    return f"{record['name']}: mean error", (before, after), words


def elsewhere(subject: Subject) -> Section | None:
    """Predicted errors before and after where nothing was measured; None if an instrument measured
    the robot.
    """
    if subject.result.improvement is UNSET:
        return None
    text = (
        "No instrument measured the robot. The standard deviation of a position follows before the "
        "calibration from priors, afterwards from priors and readings; both are errors that an "
        "instrument would measure once it is placed."
    )
    blocks = (paragraph(text), improvement_table(subject.result.improvement))
    return Section("elsewhere", "Where nothing was measured", blocks, "Elsewhere")


def missing(subject: Subject) -> Section | None:
    """What a search found missing in the model; None without a search."""
    return None if subject.search is None else subject.search.section()


def _moved(records: Sequence[StationRecord]) -> Iterator[PageBlock]:
    """Yield the parameters of the robot that differ between stations."""
    yield heading("Changes between stations", "moved")
    table = moved_table(records)
    if table is None:
        yield paragraph(
            "No difference between stations was detected in any parameter of the robot; if the "
            "robot is the same at all of them, the probability of a false detection is 1 %."
        )
        return
    yield paragraph(
        "One model describes the robot at all stations, except that these parameters have "
        "different values at some of them. If several could have changed, the one that explains "
        "most is named; pincal diagnose lists the alternatives for the rows of a later station.",
        "care",
    )
    yield table
    yield figures("moved", course_drawings(records))


def _by_joint(readings: RowErrors) -> tuple[Markup, ...]:
    """Return the errors by the position of each joint, or that there are too few poses."""
    drawn = [*joint_drawings(readings)]
    if not drawn:
        few_poses = f"{len(readings.line)} poses are too few to draw the error by joint position."
        return (paragraph(few_poses, "mute"),)
    key = Markup(
        '<span class="key"><span style="background:var(--before)"></span>before'
        '<span style="background:var(--after)"></span>after</span>'
    )
    words = (
        "Lines are medians, bands contain 90 % of all poses, fitted and held out. A "
        "calibrated arm has flat bands; a "
        "remaining periodic pattern or slope means that the model lacks an effect of this joint. "
    )
    rest = drawn[_DRAWN_JOINTS:]
    more = [folded(counted(len(rest), "further joint"), figures("further", rest))] if rest else []
    shown = figures("joint", drawn[:_DRAWN_JOINTS])
    return (paragraph(rich("{}{}", words, key)), shown, *more)


def where(subject: Subject) -> Section:
    """Errors by joint position, over the workspace, and in the order of measurement."""
    first = subject.readings[0]
    is_timed = subject.calibration.stations[0].train.time is not None
    line = "" if is_timed else " No times were recorded, so the line of the table is used instead."
    residual = rich("A <b>residual</b> is the measured minus the predicted value.{}", line)
    joints = _by_joint(first)
    # What a search has found says it more briefly.
    is_told = subject.search is not None
    blocks = (
        *((folded("By joint position", *joints),) if is_told else joints),
        folded("Over the workspace", figures("workspace", workspace_drawings(first))),
        folded(
            "In the order of measurement",
            paragraph(residual),
            figures("order", order_drawings(first)),
        ),
    )
    return Section("where", "Where the errors are", blocks, "Where the errors are")


def moments(subject: Subject) -> Section | None:
    """The identified moments at a typical pose; None if the masses are those of the URDF."""
    found = found_moments(subject.calibration.fit.fit)
    if found is None:
        return None
    held = (
        f"The robot description has no usable masses for {counted(len(found.links), 'link')}. "
        "They were "
        "estimated with the compliances, starting from the shape of the arm. Only compliance times "
        "moment deflects the arm, so all moments share a factor with the inverse of the "
        f"compliances: it is known to {100.0 * found.factor_sigma:.2g} %, and predictions do not "
        "depend on it. The robot's mass from its data sheet (--mass) or rows with other payloads "
        "would determine it."
    )
    pose = ", ".join(f"{value:.2f}" for value in found.q)
    return Section(
        "moments",
        "Static moments",
        (paragraph(held), moment_table(found, f"at the pose {pose}")),
        "Moments",
    )


def moment_table(found: FoundMoments, where: str) -> Table:
    """Return the moments at a pose, and their standard deviations if the common factor is held
    fixed.
    """
    columns = (
        Column("joint", kind=Kind.NAME),
        Column("axis", kind=Kind.LABEL),
        Column("moment", "N m", Kind.NUMBER, fixed(1)),
        Column("sigma", "N m", Kind.NUMBER, fixed(1)),
        Column("", kind=Kind.LABEL),
    )
    rows = tuple(
        (
            of.joint,
            of.axis,
            of.moment,
            of.sigma,
            "identified" if of.is_identified else "fixed by the shape",
        )
        for of in found.axes
    )
    note = (
        f"sigma: with the moment about {found.largest.axis} of {found.largest.joint}, and so "
        "the common factor, held fixed."
    )
    return Table(f"Static moments {where}", columns, rows, (note,))


def parameters(subject: Subject) -> Section:
    """Every parameter with its uncertainty, and the strong correlations."""
    result = subject.result
    symbols = rich(
        "Symbols follow Denavit and Hartenberg: theta and d are about and along the joint axis, a "
        "and alpha along and about the link; s_x and s_y tilt the axis; x, y, z and rx, ry, rz are "
        "position and rotation of base and tool. k is a <b>compliance</b>, the rotation of a joint "
        "or bearing per unit of moment. Behind ± is half of the 95 % interval, to which values are "
        "rounded. Status: "
        "<b>identified</b>: determined by the data; <b>prior</b>: dominated by prior knowledge; "
        "<b>unidentifiable</b>: these poses cannot determine it by itself, whatever the noise; "
        "predictions at poses like these do not depend on it."
    )
    blocks: list[PageBlock] = [
        *_corrections(subject),
        folded("What the symbols mean", paragraph(symbols)),
        *_parameter_tables(result.parameters, subject.calibration.fit.fit.problem.is_shared),
    ]
    if result.correlations:
        text = (
            "Each of these pairs is known much better in combination than individually: an error "
            "of one is compensated by the other. Always use both together."
        )
        pairs = counted(len(result.correlations), "strong correlation")
        blocks.append(folded(pairs, paragraph(text), correlation_table(result.correlations)))
    else:
        blocks.append(
            paragraph("Strong correlations: none above 0.9 between identified parameters.", "mute")
        )
    return Section("parameters", "Parameters", tuple(blocks), "Parameters")


def _corrections(subject: Subject) -> Iterator[PageBlock]:
    """Yield the largest corrections as figures, folded where a search has said what was wrong."""
    drawn = figures("correction", correction_drawings(subject.result.parameters))
    is_told = subject.search is not None
    yield folded("The largest corrections", drawn) if is_told and drawn else drawn


def _parameter_tables(
    parameters: Sequence[ParameterRow], is_robots: Sequence[bool] | np.ndarray
) -> Iterator[PageBlock]:
    """Yield the tables of what was determined of the robot, of what was not, of the placement of
    instrument and target, and of what is the instrument's own.

    Args:
        parameters: all parameters.
        is_robots: shape (P,), which are of the robot, not of a set-up.
    """
    shown = {id(row) for row in shown_parameters(parameters)}
    parts: dict[str, list[int]] = {
        name: [] for name in ("identified", "others", "placement", "instrument")
    }
    for k, row in enumerate(parameters):
        if id(row) in shown:
            parts[_part_of(row, is_robots=bool(is_robots[k]))].append(k)
    if len(parts["instrument"]) <= _FEW_OWN:
        parts["identified"] += parts.pop("instrument")
    if found := parts["identified"]:
        table = rounded_table(parameters, found).without("status", "reason")
        is_long = len(found) > _LISTED_PARAMETERS
        words = f"{counted(len(found), 'parameter')} determined"
        yield folded(words, table) if is_long else table
    if parts["others"]:
        words = f"{counted(len(parts['others']), 'parameter')} not determined individually"
        yield folded(words, rounded_table(parameters, parts["others"]))
    if parts["placement"]:
        table = rounded_table(parameters, parts["placement"]).without("nominal")
        yield folded("Base and tool: where instrument and target stand", table)
    if own := parts.get("instrument"):
        words = f"{counted(len(own), 'parameter')} of the instrument: axes, biases, clocks"
        yield folded(words, rounded_table(parameters, own).without("status", "reason"))
    if hidden := len(parameters) - len(shown):
        yield paragraph(
            f"The coordinates of {hidden // 3} named points are omitted here; result.json has them."
        )


def _part_of(row: ParameterRow, *, is_robots: bool) -> str:
    if split_name(row.name)[1] in FRAME_SYMBOLS:
        return "placement"
    if row.status != Status.IDENTIFIED:
        return "others"
    return "identified" if is_robots else "instrument"


def unidentified(subject: Subject) -> Section:
    """Parameters that are not identified, by cause, with what to measure."""
    groups = [
        folded(
            f"{found.advice.title}: {len(found.names)}",
            paragraph(found.advice.text),
            paragraph(merged(map(code, found.names), ", "), "mute"),
        )
        for found in unidentified_groups(shown_parameters(subject.result.parameters))
    ]
    blocks: list[PageBlock] = [*groups] or [paragraph("All parameters are identified.")]
    if subject.notes:
        blocks.append(folded("Not included in the calibrated URDF", bullets(subject.notes)))
    title = "What is not identifiable, and what to measure"
    return Section("unidentified", title, tuple(blocks), "Not identifiable")


def identity(subject: Subject) -> Section | None:
    """What was stated of robot, instrument and circumstances."""
    stated = [(meaning, text) for _, meaning, text in subject.calibration.fit.identity.entries()]
    if not stated:
        return None
    return Section("identity", "Identity", (facts(stated),), "Identity")


def basis(subject: Subject) -> Section:
    """Versions, command and inputs."""
    shown = {name: value for name, value in subject.provenance.items() if name != "inputs"}
    items = [(name, code("-" if value is None else value)) for name, value in shown.items()]
    items += [
        (f"input {name}", rich("SHA-256 {}", code(value)))
        for name, value in subject.provenance["inputs"].items()
    ]
    words = "Versions, command and inputs"
    return Section("basis", "Provenance", (folded(words, facts(items)),), "Provenance")


def glossary(subject: Subject) -> Section:
    """The terms of the page."""
    words = f"{len(TERMS)} terms of this page"
    return Section("glossary", "Glossary", (folded(words, facts(TERMS)),), "Glossary")
