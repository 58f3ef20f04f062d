"""The sections of the page on a calibration but the first and those of parameters: each a function
from the subject to a section, or to None.
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
    error_table,
    improvement_table,
    iso9283_table,
    moved_table,
    repeated_table,
    station_table,
)
from pincal.errors import counted, few
from pincal.report.blocks import (
    RESULT,
    PageBlock,
    Section,
    arranged,
    code,
    facts,
    folded,
    glance,
    heading,
    in_pointer,
    merged,
    paragraph,
    rich,
    sourced,
)
from pincal.report.illustrations import (
    course_drawings,
    error_drawings,
    figures,
    joint_drawings,
    order_drawings,
    workspace_drawings,
)
from pincal.report.subject import RowErrors, Subject
from pincal.report.words import (
    TERMS,
    effect_meaning,
)
from pincal.robot.robot import Robot
from pincal.thresholds import Count
from pincal.units import show_chance
from pincal.validate.accuracy import ERROR_UNITS, cycle_words, leading_unit
from pincal.validate.outcome import StationRecord

REPEATED = Markup(
    "<b>Pose accuracy AP</b> is the distance from the predicted pose to the mean of its "
    "measurements; <b>pose repeatability RP</b> their scatter about this mean, mean distance plus "
    "three standard deviations (ISO 9283). Calibration improves AP; it cannot improve RP, which "
    "includes the noise of the instrument."
)
"""Definition of accuracy and repeatability."""

# Number of rejected rows whose lines are listed.
_LISTED: Count = 12
# Rows of a table of repeated poses before it is folded: those of positions, fitted and held out.
_SHORT: Count = 4
# Joints whose errors are drawn before the rest is folded: a page of two robots has twelve and more,
# and a phone shows one beneath the other.
_DRAWN_JOINTS: Count = 8


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
    key = in_pointer(f"mean_{unit}")
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
