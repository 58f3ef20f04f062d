"""The sections of the page on a calibration: each a function from the subject to a section, or to
None.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any
from urllib.parse import quote

from markupsafe import Markup
from msgspec import UNSET

from pincal.calibration.held_out import StationRows
from pincal.calibration.result import Result
from pincal.calibration.result_tables import (
    clock_table,
    correlation_table,
    error_table,
    improvement_table,
    iso9283_table,
    moved_table,
    parameter_table,
    repeated_table,
    shown_parameters,
    station_table,
)
from pincal.errors import few
from pincal.identify.choices import FoundMoments, found_moments
from pincal.report.blocks import (
    PageBlock,
    Section,
    arranged,
    bullets,
    card,
    code,
    doubts,
    facts,
    glance,
    heading,
    merged,
    paragraph,
    plain_notes,
    rich,
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
from pincal.report.subject import Subject
from pincal.report.words import TERMS, effect_meaning, elsewhere_words, noise_words
from pincal.result_table import Column, Kind, RowTone, Table
from pincal.robot.robot import Robot
from pincal.thresholds import Count
from pincal.units import fixed
from pincal.validate.accuracy import cycle_words, leading_unit
from pincal.validate.misfit import Verdict
from pincal.validate.outcome import StationRecord

REPEATED = Markup(
    "<b>Pose accuracy AP</b> is the distance from the predicted pose to the mean of its "
    "measurements; <b>pose repeatability RP</b> their scatter about this mean, mean distance plus "
    "three standard deviations (ISO 9283). Calibration improves AP; it cannot improve RP, which "
    "includes the noise of the instrument."
)
"""Definition of accuracy and repeatability."""

_STATISTICS = (("mean", "mean"), ("p95", "95 %"), ("max", "worst"))
# Number of rejected rows whose lines are listed.
_LISTED: Count = 12
_TONES: dict[str, RowTone] = {Verdict.ADEQUATE: "good", Verdict.NOT_JUDGED: "care"}


def summary(subject: Subject) -> Section:
    """Whether the model is good, what to do next, and the errors at a glance."""
    result = subject.result
    verdict = judged(subject.result, subject.search)
    tone = _TONES.get(verdict.judgement, "bad")
    tag = rich('<span class="tag {}">{}</span> {}', tone, verdict.judgement, verdict.reason)
    steps = bullets(next_steps(subject.calibration, subject.search))
    left = arranged(
        "plain",
        *doubts(result.warnings),
        paragraph(_headline(subject)),
        *_elsewhere(subject),
        paragraph(tag),
        *_worth(subject),
        *plain_notes(result.warnings),
    )
    columns = arranged("split", left, arranged("plain", heading("What to do next"), steps))
    return Section(
        "summary", "Summary", (columns, arranged("glance", *_glance(subject))), style="panel"
    )


def _headline(subject: Subject) -> Markup:
    """Return the mean error now and before, and the noise."""
    result = subject.result
    part = subject.part
    unit = leading_unit(result.error["calibrated"][part])
    before, after = (
        result.error[model][part][f"mean_{unit}"] for model in ("nominal", "calibrated")
    )
    rows = (
        "On set-ups not used by the calibration, each predicted with the model of the others"
        if result.left_out_mm is not None
        else _predicted(result)
        if part == "test"
        else "No poses were held out, so these are the errors of the fit itself, not of new "
        "poses: over all poses"
    )
    ratio = before / after if after > 0.0 else 1.0
    times = f" ({ratio:.1f} times as large)" if ratio >= REPORT.improved else ""
    noise = (
        "The declared noise of the instrument is"
        if result.noise["source"] == "declared"
        else "The residuals, which contain the noise and all errors that the model omits, have "
        "a standard deviation of"
    )
    return rich(
        "{}, the mean error of the model is <b>{}</b>; before calibration it was "
        "<b>{}</b>{}. {} {}.",
        *(rows, _size(after, unit), _size(before, unit), times, noise, noise_words(result.noise)),
    )


_APART = {
    "regions": "its region of joint space",
    "stretches": "its stretch of consecutive rows",
    "sessions": "its session",
    "random": "it",
}


def _predicted(result: Result) -> str:
    """Return at what poses the first errors of the page are."""
    validation = result.validation
    if validation is UNSET or validation.way not in _APART:
        return f"In {result.rows['test']} rows that the calibration has not used"
    return (
        f"Where each of {result.rows['test']} rows is predicted by a fit without "
        f"{_APART[validation.way]}"
    )


def _elsewhere(subject: Subject) -> Iterator[Markup]:
    """Yield the error that the model expects away from the measured poses."""
    found = subject.result.elsewhere
    if found is not UNSET:
        words = elsewhere_words(found, subject.result.error["calibrated"][subject.part])
        meaning = (
            "The model expects this by the uncertainty of its parameters, what it lacks and how "
            "the robot arrives."
        )
        yield paragraph(rich("Elsewhere: {}. {}", words, meaning))


def _worth(subject: Subject) -> Iterator[Markup]:
    """Yield how good predictions are, and what this rests on."""
    statement = subject.calibration.fit.statement
    if statement is not None and statement.worth:
        yield paragraph(
            rich("The model is {}; this rests on {}.", statement.worth, statement.rests_on)
        )


def _size(value: float, unit: str) -> str:
    return f"{value:.4f} {unit}" if value < 0.1 else f"{value:.3f} {unit}"


def _glance(subject: Subject) -> Iterator[Markup]:
    """Yield mean, 95 % and worst error, before and after."""
    before, after = (
        subject.result.error[model][subject.part] for model in ("nominal", "calibrated")
    )
    in_motion = (("m/s^2", " of acceleration"), ("mrad/s", " of angular rate"))
    for unit, suffix in (("mm", ""), ("mrad", " of orientation"), *in_motion):
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
                    (_size(before[key], "").rstrip(), _size(after[key], unit)),
                )
                for title, key in keys.items()
            ]
        )


def setup(subject: Subject) -> Section:
    """Robot, data, model and fit."""
    calibration = subject.calibration
    result = subject.result
    robot = subject.calibration.robot
    effects = dict.fromkeys(effect.name for effect in calibration.fit.options.effects)
    p_value = "" if result.chi2_p_value is None else f" (p {result.chi2_p_value:.2g})"
    items = (
        ("robot", _arm(robot)),
        ("joints", merged(map(code, robot.joint_names), ", ")),
        ("data", _data(subject)),
        (
            "model",
            merged((rich("<b>{}</b> ({})", name, effect_meaning(name)) for name in effects), "; "),
        ),
        (
            "fit",
            f"{result.iterations} iterations, {result.seconds:.2f} s in all; {result.rank} "
            f"combinations of parameters determined, condition number {result.condition:.2g}; "
            f"reduced chi-square {result.chi2_reduced:.3f}{p_value}",
        ),
        ("3D view", _view(subject)),
    )
    return Section("subject", "Robot, data and model", (facts(items),))


def _arm(robot: Robot) -> Markup:
    ends = (code(robot.base), code(robot.tip))
    return rich("{}: {} joints from {} to {}", robot.name, robot.n_joints, *ends)


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
        "{}{} in {}: {} rows fitted{}{}",
        name,
        train.kind,
        code(train.source),
        len(train),
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
    intro = rich(
        "The error at a pose is the distance from the predicted to the measured target: the "
        "<b>accuracy</b> of a single measurement (ISO 9283). It is not the <b>repeatability</b>, "
        "the scatter between repeated measurements of a pose, which no calibration improves. "
        "“Nominal” is the robot of the URDF, with only the placement of instrument and target "
        "fitted."
    )
    if "mean_mm" not in result.error["calibrated"]["train"]:
        intro = rich(
            "An IMU measures no positions: an error is a reading, filtered in time, minus "
            "its prediction. "
            "Most of it is vibration of the arm and noise, which no calibration improves."
        )
    blocks: list[PageBlock] = [paragraph(intro)]
    if not result.rows["test"]:
        text = (
            "No rows were held out: the errors are those of the poses that were fitted. Expect "
            "somewhat larger ones at new poses."
        )
        blocks.append(paragraph(text, "note"))
    if result.clocks is not UNSET:
        blocks += [heading("Clocks", "clocks"), paragraph(_CLOCKS), clock_table(result.clocks)]
    blocks += [
        error_table(result.error),
        figures("accuracy", error_drawings(subject.readings)),
        *_replicates(result),
    ]
    return Section("accuracy", "Before and after", tuple(blocks), "Accuracy")


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
        blocks += [paragraph(text), iso9283_table(iso)]
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
    shown = [_mean_error(record, subject.part) for record in records]
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
    record: Mapping[str, Any], part: str
) -> tuple[str, tuple[float, float], tuple[str, str]]:
    """Return what is shown of a station: its name, the errors before and after, and both in
    words.
    """
    nominal, calibrated = (
        by_part.get(part, by_part["train"]) for by_part in record["error"].values()
    )
    # A station that was left out is predicted with the model of the others.
    unit = leading_unit(calibrated)
    before = nominal[f"mean_{unit}"]
    after = record.get("left_out", calibrated)[f"mean_{unit}"]
    words = (f"{before:.3f}", f"{after:.4f} {unit}")
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


def where(subject: Subject) -> Section:
    """Errors by joint position, over the workspace, and in the order of measurement."""
    first = subject.readings[0]
    is_timed = subject.calibration.stations[0].train.time is not None
    key = Markup(
        '<span class="key"><span style="background:var(--before)"></span>before'
        '<span style="background:var(--after)"></span>after</span>'
    )
    by_joint = (
        "Lines are medians, bands contain 90 % of all poses, fitted and held out. A "
        "calibrated arm has flat bands; a "
        "remaining periodic pattern or slope means that the model lacks an effect of this joint. "
    )
    line = "" if is_timed else " No times were recorded, so the line of the table is used instead."
    residual = rich("A <b>residual</b> is the measured minus the predicted value.{}", line)
    blocks = (
        *(
            heading("By joint position"),
            paragraph(rich("{}{}", by_joint, key)),
            figures("joint", joint_drawings(first)),
        ),
        *(heading("Over the workspace"), figures("workspace", workspace_drawings(first))),
        *(
            heading("In the order of measurement"),
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
        f"The robot description has no usable masses for {len(found.links)} links. They were "
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
    intro = rich(
        "Symbols follow Denavit and Hartenberg: theta and d are about and along the joint axis, a "
        "and alpha along and about the link; s_x and s_y tilt the axis; x, y, z and rx, ry, rz are "
        "position and rotation of base and tool. k is a <b>compliance</b>, the rotation of a joint "
        "or bearing per unit of moment. Sigma is the standard deviation. Status: "
        "<b>identified</b>: determined by the data; <b>prior</b>: dominated by prior knowledge; "
        "<b>unidentifiable</b>: these poses cannot determine it by itself, whatever the noise; "
        "predictions at poses like these do not depend on it."
    )
    blocks: list[PageBlock] = [
        paragraph(intro),
        figures("correction", correction_drawings(result.parameters)),
    ]
    blocks += [parameter_table(result.parameters), heading("Strong correlations")]
    if result.correlations:
        text = (
            "Each of these pairs is known much better in combination than individually: an error "
            "of one is compensated by the other. Always use both together."
        )
        blocks += [paragraph(text), correlation_table(result.correlations)]
    else:
        blocks.append(paragraph("No two identified parameters have a correlation above 0.9."))
    return Section("parameters", "Parameters", tuple(blocks), "Parameters")


def unidentified(subject: Subject) -> Section:
    """Parameters that are not identified, by cause, with what to measure."""
    cards = [
        card(
            found.advice.title,
            paragraph(found.advice.text),
            paragraph(
                rich("{}: {}", len(found.names), merged(map(code, found.names), ", ")), "mute"
            ),
        )
        for found in unidentified_groups(shown_parameters(subject.result.parameters))
    ]
    blocks: list[PageBlock] = [
        arranged("cards", *cards) if cards else paragraph("All parameters are identified.")
    ]
    if subject.notes:
        blocks += [heading("Not included in the calibrated URDF"), bullets(subject.notes)]
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
    return Section("basis", "Provenance", (facts(items),), "Provenance")


def glossary(subject: Subject) -> Section:
    """The terms of the page."""
    return Section("glossary", "Glossary", (facts(TERMS),), "Glossary")
