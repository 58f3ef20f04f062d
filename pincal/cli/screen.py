"""Results as text that fits 100 columns: in ten lines, or with all tables; with colours on a
terminal, plain elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from msgspec import UNSET
from rich.console import Console

from pincal.calibration import result_tables
from pincal.calibration.calibration import Calibration
from pincal.calibration.result import Result
from pincal.design.health import HealthCheck
from pincal.design.motion_design import MotionDesign
from pincal.design.plan_tables import motion_table, pose_count_table
from pincal.design.pose_design import SOURCES, Design
from pincal.design.study import RANDOM_DESIGNS
from pincal.discover.discovery_file import FoundEffect
from pincal.discover.policy import SIGHT
from pincal.discover.precheck import DataReport, DetectabilityTable
from pincal.discover.report import found_tables, precheck_tables
from pincal.discover.report.found_words import (
    HINTS,
    bootstrap_words,
    effect_words,
    line_words,
    subsample_only_words,
)
from pincal.discover.report.search_answer import SearchAnswer
from pincal.discover.run import Discovery
from pincal.errors import counted
from pincal.measure.registry import blocks_of
from pincal.model.effect import Family
from pincal.model.effect_registry import EFFECTS
from pincal.notes import Note, doubts_first, doubts_of
from pincal.report.judgement import judged, next_steps
from pincal.report.words import (
    elsewhere_words,
    noise_words,
    rank_words,
)
from pincal.result_table import hanging, one_line
from pincal.robot.robot import Robot
from pincal.thresholds import Count
from pincal.units import Quantity, format_small, show_chance
from pincal.validate.accuracy import cycle_words, leading_unit
from pincal.validate.lack_of_fit import LackOfFit

# Observability indices that are printed; the others are in --json.
_SHOWN = ("O1", "O2")
# Number of effects that are listed individually.
_EFFECTS: Count = 3
# Dimension -> mean distance of independent errors of standard deviation 1 (chi distribution).
_MEAN_DISTANCE = {1: np.sqrt(2.0 / np.pi), 2: np.sqrt(np.pi / 2.0), 3: np.sqrt(8.0 / np.pi)}


def print_brief(
    calibration: Calibration,
    discovery: Discovery | None,
    out: Console,
    *,
    more: str,
    notes: Sequence[str] = (),
) -> None:
    """Print the summary of a calibration or discovery; ``notes`` are on its files, ``more`` names
    further output.
    """
    result = calibration.result
    print_doubts(result.warnings, out)
    print_left_out(result, out)
    rows = f"{result.rows['train']} rows fitted, {held_out_words(result)}"
    _line(out, "robot", f"{_arm(calibration.robot)}; {rows}")
    for name, model in (("before", "nominal"), ("after", "calibrated")):
        _line(out, name, _errors(result.error[model], name))
    _print_elsewhere(result, out)
    kinds = " and ".join(dict.fromkeys(rows.train.kind for rows in calibration.stations))
    _line(out, "noise", f"{_noise_of(result.noise, kinds)} ({result.noise['source']})")
    for clock in () if result.clocks is UNSET else result.clocks:
        _line(out, "clock", result_tables.clock_words(clock))
    if result.stations is not UNSET and (moved := result_tables.station_changes(result.stations)):
        _line(out, "moved", moved)
    if discovery is not None:
        _line(out, "found", _found(discovery))
    search = None if discovery is None else SearchAnswer(discovery)
    verdict = judged(result, search)
    _line(out, "verdict", f"{verdict.judgement}. {verdict.reason}")
    _line(out, "next", next_steps(calibration, search)[0])
    print_first_notes([*result.warnings, *notes], out)
    _line(out, "more", more)


def _print_elsewhere(result: Result, out: Console) -> None:
    """Print the error that the model expects away from the measured poses."""
    if result.elsewhere is not UNSET:
        errors = result.error["calibrated"]
        error = errors.get("test", errors["train"])
        name = "task" if result.elsewhere.over else "anywhere"
        _line(out, name, elsewhere_words(result.elsewhere, error))


def print_brief_check(found: DataReport, robot: Robot, out: Console, *, command: str) -> None:
    """Print the summary of what a table can identify."""
    print_doubts(found.warnings, out)
    _line(out, "robot", _arm(robot))
    _line(out, "rows", f"{found.rows} {found.kind} measurements")
    _line(out, "before", f"{_nominal(found)}: nominal robot, base and tool fitted")
    _line(out, "noise", f"{_noise_of(found.noise, found.kind)} ({found.noise['source']})")
    shares = {
        joint.joint: share
        for joint in found.joints
        if (share := precheck_tables.covered_share(joint)) is not None
    }
    if shares:
        least = min(shares, key=lambda name: shares[name])
        _line(
            out, "covered", f"each joint's range by at least {100 * shares[least]:.0f} % ({least})"
        )
    statuses = [parameter.status for parameter in found.parameters]
    _line(
        out,
        "poses",
        rank_words(statuses, rank=found.rank, why="why: --verbose").removeprefix("these poses "),
    )
    print_first_notes(found.warnings, out)
    _line(out, "next", command)
    _line(
        out,
        "more",
        "--verbose: coverage, expected uncertainty of each parameter, smallest detectable effects",
    )


def _nominal(found: DataReport, form: str = ".4f") -> str:
    unit = leading_unit(found.nominal)
    return (
        f"mean {found.nominal[f'mean_{unit}']:{form}} {unit}, max "
        f"{found.nominal[f'max_{unit}']:{form}} {unit}"
    )


def print_first_notes(told: Sequence[Note | str], out: Console) -> None:
    """Print the first note and the number of others; doubts are printed before the
    result, in full.
    """
    notes = [note for note in doubts_first(told) if not note.is_doubt]
    if notes:
        rest = f" ({counted(len(notes) - 1, 'more note')} with --verbose)" if len(notes) > 1 else ""
        out.print(hanging("note:   ", f"{notes[0]}{rest}"), style="yellow")


def _noise_of(noise: Mapping[str, Any], kind: str) -> str:
    """Return the noise as a mean distance, and per coordinate.

    Example:
        >>> _noise_of({"sigma_m": 5e-5}, "position"), _noise_of({"sigma_m": 5e-5}, "distance")
        ('mean 0.0798 mm, 0.0500 mm per coordinate', 'mean 0.0399 mm, 0.0500 mm per coordinate')
    """
    # Of several kinds of readings, the first that has lengths.
    blocks = (block for each in kind.split(" and ") for block in blocks_of(each))
    size = next((block.size for block in blocks if block.unit == "m"), 0)
    if "sigma_m" not in noise or size not in _MEAN_DISTANCE:
        return noise_words(noise)
    return f"mean {1e3 * noise['sigma_m'] * _MEAN_DISTANCE[size]:.4f} mm, {noise_words(noise)}"


def _arm(robot: Robot) -> str:
    """Return the arm in words, with the option that selects another."""
    ways = "; ".join(
        f"{start} to {tip}" for start, tip in ((robot.path.start, robot.tip), *robot.links)
    )
    return f"{robot.name}, {robot.n_joints} joints from {ways} (--tip takes another link)"


def _errors(by_part: Mapping[str, Mapping[str, float]], name: str) -> str:
    part = "test" if "test" in by_part else "train"
    values = by_part[part]
    unit = leading_unit(values)
    words = (
        f"mean {values[f'mean_{unit}']:.4f} {unit}, 95 % {values[f'p95_{unit}']:.4f}, max "
        f"{values[f'max_{unit}']:.4f}"
    )
    model = "nominal, base and tool fitted" if name == "before" else "calibrated"
    named = result_tables.PARTS
    ways = [way for way in by_part if way not in ("train", "test")]
    lead = next((way for way in ways if by_part[way] == values), part)
    others = [
        f"; {named[way]} {by_part[way][f'mean_{unit}']:.4f}"
        for way in ways
        if way != lead and name != "before"
    ]
    return (
        f"{words}: {model}, "
        f"{'no rows held out' if lead == 'train' else named[lead]}{''.join(others)}"
    )


def _found(discovery: Discovery) -> str:
    effects = discovery.findings.effects
    if not effects:
        return "these data show no missing effect"
    # Elasticity, which every arm has, comes after other effects, and hints come last.
    elastic = [name for name, cls in EFFECTS.known().items() if cls.family is Family.ELASTICITY]
    named = [
        _named(entry)
        for entry in sorted(effects, key=lambda e: (e.is_hint, e.effect in elastic))[:_EFFECTS]
    ]
    more = len(effects) - _EFFECTS
    return ", ".join([*named, *([f"{more} more"] if more > 0 else [])])


def _named(entry: FoundEffect) -> str:
    chance = f"p {show_chance(entry.p_value)}"
    words = chance if entry.stability is None else f"{entry.stability} subsamples, {chance}"
    return f"{'perhaps ' if entry.is_hint else ''}{effect_words(entry)} ({words})"


def _line(out: Console, name: str, text: str) -> None:
    out.print(hanging(f"{name:8s}", one_line(text)), markup=False)


def print_result(result: Result, out: Console) -> None:
    """Print errors before and after, the parameters, and notes, doubts first."""
    print_doubts(result.warnings, out)
    print_left_out(result, out)
    out.print(_summary(result))
    if result.stations is not UNSET:
        out.print(result_tables.station_table(result.stations))
        for table in (
            result_tables.moved_table(result.stations),
            result_tables.repeated_table(result.stations),
        ):
            if table is not None:
                out.print(table)
    out.print(result_tables.error_table(result.error))
    _print_elsewhere(result, out)
    if result.clocks is not UNSET:
        out.print(result_tables.clock_table(result.clocks))
    if result.improvement is not UNSET:
        out.print(result_tables.improvement_table(result.improvement))
    print_replicates(result.iso9283, result.lack_of_fit, out)
    if result.repeatability is not UNSET:
        out.print(
            hanging("scatter:", f"{result.repeatability} (standard deviation of one coordinate)")
        )
    out.print(result_tables.parameter_table(result.parameters))
    print_notes(result.warnings, out)


def print_left_out(result: Result, out: Console) -> None:
    """Print the error of each station predicted from the others, if they were left out in turn."""
    if (means := result.left_out_mm) is not None:
        out.print(f"On a new set-up: mean {means[0]:.4f} mm; geometry alone {means[1]:.4f} mm")


def print_doubts(notes: Iterable[Note], out: Console) -> None:
    """Print the doubts about a result, before everything else, in every mode, in full."""
    for doubt in doubts_of(notes):
        out.print(hanging("doubt:", doubt.text), style="bold red")


def print_notes(notes: Iterable[Note | str], out: Console) -> None:
    """Print notes; doubts are printed before the result."""
    for note in doubts_first(notes):
        if not note.is_doubt:
            out.print(hanging("note:", note.text), style="yellow")


def _summary(result: Result) -> str:
    p_value = result.chi2_p_value
    chi2 = (
        ""
        if p_value is None
        else f", reduced chi-square {result.chi2_reduced:.3f} (p {p_value:.2g})"
    )
    rank = rank_words(
        (row.status for row in result.parameters), rank=result.rank, condition=result.condition
    )
    return (
        f"{result.rows['train']} rows fitted, {held_out_words(result)}; "
        f"{result.iterations} iterations, "
        f"{result.seconds:.2f} s\nnoise {noise_words(result.noise)} "
        f"({result.noise['source']}){chi2}\n{rank}"
    )


def held_out_words(result: Result) -> str:
    """Return how errors at rows that were not fitted were found, in words."""
    turns = (
        0 if result.stations is UNSET else sum("left_out" in station for station in result.stations)
    )
    if turns:
        return f"{turns} stations held out in turn"
    if result.validation is UNSET or not result.validation.folds:
        return f"{result.rows['test']} held out"
    return "errors by cross-validation"


def print_replicates(iso: Mapping[str, Any] | None, lack: LackOfFit | None, out: Console) -> None:
    """Print the results of replicated poses: ``iso9283`` of ``result.json``, and the test of lack
    of fit.
    """
    if iso is not None:
        out.print(result_tables.iso9283_table(iso))
        out.print(hanging("cycles:", cycle_words(iso)))
    if lack is not None:
        out.print(hanging("lack of fit:", f"{lack} (by {lack.scatter})"))


def print_precheck(precheck: DataReport, out: Console) -> None:
    """Print everything on what a table can identify."""
    print_doubts(precheck.warnings, out)
    words = (
        f"{precheck.rows} {precheck.kind} measurements; nominal robot, base and tool fitted: "
        f"{_nominal(precheck, '.3f')}"
    )
    out.print(words)
    out.print(f"noise {noise_words(precheck.noise)} ({precheck.noise['source']})")
    statuses = (parameter.status for parameter in precheck.parameters)
    out.print(rank_words(statuses, rank=precheck.rank, condition=precheck.condition))
    out.print(precheck_tables.coverage_table(precheck))
    out.print(precheck_tables.expectation_table(precheck))
    _print_detectability(precheck, precheck.detectable, out)
    print_notes(precheck.warnings, out)


def _print_detectability(precheck: DataReport, found: DetectabilityTable, out: Console) -> None:
    source = {"assumed": "assumed: not declared, and too few rows to estimate it"}
    out.print(
        "\nSmallest effects that pincal discover would find in addition to the "
        f"{found.model} model with a probability of "
        f"{100 * found.power:.0f} %, at a probability of {100 * found.alpha:g} % of any "
        "false name and a noise of "
        f"{noise_words(precheck.noise) if found.sigma_m is None else f'{found.sigma_m * 1e3:.4g} mm per coordinate'} "
        f"({source.get(found.source, found.source)}). An effect with several "
        "parameters is given by its amplitude, transmission_error by the rms of its "
        "curve, elastic effects by their largest "
        "rotation in these poses, joint_coupling by the range over the joints that may "
        "drive it. -: see below."
    )
    for table in precheck_tables.detectability_tables(precheck):
        out.print(table)
    whole = [
        (e.effect.name, precheck_tables.smallest_size([e]))
        for e in found.effects
        if e.effect.locus.joint is None
    ]
    sizes = [f"{name} {format_small(*size)}" for name, size in whole if isinstance(size, Quantity)]
    if sizes:
        out.print("Whole arm: " + ", ".join(sizes), markup=False)
    _print_untestable(
        ((e.effect.name, e.effect.locus.joint, e.reason) for e in found.effects),
        len(precheck.joints),
        out,
    )


def _print_untestable(
    entries: Iterable[tuple[str, str | None, str]], n_joints: int, out: Console
) -> None:
    for reason, names in found_tables.by_reason(entries, n_joints).items():
        out.print(hanging("not testable:", f"{names}: {reason}"))


def print_discovery(found: Discovery, out: Console) -> None:
    """Print where model and data disagreed, the effects found, and the errors after each step."""
    findings = found.findings
    print_doubts(found.calibration.result.warnings, out)
    print_left_out(found.calibration.result, out)
    out.print(
        hanging(
            "Verdict:",
            f"{findings.verdict}. {judged(found.calibration.result, SearchAnswer(found)).reason}",
        )
    )
    if findings.where:
        out.print(found_tables.location_table(findings.where))
    named, hints = (
        [e for e in findings.effects if e.is_hint == is_hint] for is_hint in (False, True)
    )
    if named or not hints:
        out.print(
            found_tables.effect_table(named) if named else "These data show no missing effect."
        )
    if hints:
        out.print(found_tables.effect_table(hints, HINTS))
    if findings.bootstrap:
        out.print(one_line(bootstrap_words(findings.bootstrap)), markup=False)
    if findings.only_in_halves:
        out.print(one_line(subsample_only_words(findings)), markup=False)
    out.print(found_tables.stage_table(findings.noise_floor_mm, found.gaps))
    _print_elsewhere(found.calibration.result, out)
    for entry in findings.effects:
        if words := line_words(entry):
            out.print(hanging(effect_words(entry), words))
        if entry.tell_apart:
            out.print(
                hanging(
                    "to distinguish",
                    f"{effect_words(entry)} from its alternatives: {entry.tell_apart}",
                )
            )
        if entry.period is not None:
            unit = {"time": "s", "temperature": "K", "payload": "kg"}.get(
                entry.depends_on or "", "rad"
            )
            out.print(
                one_line(f"{effect_words(entry)} repeats every {entry.period:.4g} {unit}"),
                markup=False,
            )
    for scatter in findings.scatter:
        text = (
            f"{scatter.joint} scatters by {scatter.sigma_rad * 1e3:.3f} mrad; record "
            f"{scatter.missing}"
        )
        out.print(one_line(text), markup=False)
    joints = found.calibration.fit.problem.chain.robot.joint_names
    _print_untestable(
        ((e.effect, e.joint, e.reason) for e in findings.not_testable), len(joints), out
    )


def print_plan(found: Design | HealthCheck | MotionDesign, out: Console) -> None:
    """Print the predicted accuracy of poses to measure, or of a motion to drive."""
    if isinstance(found, HealthCheck):
        print_check(found, out)
    elif isinstance(found, MotionDesign):
        _print_motion(found, out)
    else:
        _print_design(found, out)


def _print_design(found: Design, out: Console) -> None:
    """Print the request, the candidates that constraints removed, and the predicted accuracy by
    number of poses.
    """
    n = found.found.poses
    robot = found.robot
    noise = ", ".join(
        f"{1e3 * s:.3g} {'mm' if i == 0 else 'mrad'}"
        for i, s in enumerate(found.design_model.sigma)
    )
    rig = (
        f"{robot.path.start} to {robot.tip}: {found.rig.sensor}, noise {noise}; "
        f"{found.design_model.n_free} parameters"
    )
    out.print(hanging(f"{n} poses", f"of {robot.name}, {rig}"))
    for mark, text in _design_facts(found):
        out.print(hanging(f"{mark + ':':13s}", text))
    if found.curve:
        out.print(pose_count_table(found))
    print_notes(found.notes, out)


def _print_motion(found: MotionDesign, out: Console) -> None:
    """Print the predicted accuracy of a motion with an IMU, and how many poses with an instrument
    it saves.
    """
    force, rate, place = found.noise
    noise = f"noise {force:.3g} m/s^2, {1e3 * rate:.3g} mrad/s; {1e3 * place:.3g} mm for positions"
    out.print(
        hanging(
            f"{found.time[-1]:.0f} s",
            f"of {found.robot.name}, {len(found.time)} poses, with an IMU: {noise}",
        )
    )
    error = (
        f"{1e3 * found.error:.3f} mm rms within reach from errors that an IMU can determine, "
        "base and tool fitted"
    )
    for mark, text in (
        ("candidates", found.drawn.in_words()),
        (
            "predicted",
            f"{error} (before: {1e3 * found.before:.3f} mm); {1e3 * found.lengths:.3f} mm "
            "from lengths",
        ),
        ("random", f"{1e3 * found.random:.3f} mm ({found.random / found.error:.2f} times as much)"),
    ):
        out.print(hanging(f"{mark + ':':13s}", text))
    out.print(motion_table(found))


def print_check(found: HealthCheck, out: Console) -> None:
    """Print the poses of a health check, which changes it detects and which not, and the simulated
    rates.
    """
    out.print(one_line(found.summary()), markup=False)
    if not found.is_met:
        text = (
            f"too few poses to detect {1e3 * found.notice:.3g} mm; calibrate from more poses, "
            "or reduce the noise"
        )
        out.print(hanging("not met:", text))
    hardest = found.changes[0]
    where = f"{hardest.change.name} {hardest.change.joint or ''}".strip()
    parameters = ", ".join(hardest.change.parameters)
    signal = f"signal {hardest.noncentrality:.1f}, needed {hardest.needed:.1f}"
    out.print(hanging("hardest:", f"{where} ({parameters}): {signal}"))
    rates = (
        f"alarms in {100 * found.alarms:.1f} % of {found.draws} checks of an unchanged robot, in "
    )
    rates += (
        f"{100 * found.noticed:.1f} % of {found.draws} if the hardest change by "
        f"{1e3 * found.notice:.3g} mm has occurred"
    )
    out.print(hanging("simulated:", rates))
    if found.absorbed:
        known, new = (
            [c for c in found.absorbed if (c.effect is None) is is_known]
            for is_known in (True, False)
        )
        parts = [*dict.fromkeys(name for change in known for name in change.parameters)]
        names = ", ".join([*parts, *([f"{len(new)} new effects"] if new else [])])
        why = (
            "the new poses of instrument and target absorb them, or they never move any point "
            "this far"
        )
        out.print(hanging("undetectable:", f"{names}: {why}"))
    curves = "free curves of a drive, and dependences on temperature, time or direction of approach"
    out.print(hanging("not covered:", curves))
    out.print(hanging("candidates:", found.drawn.in_words()))
    print_notes(found.notes, out)


def _design_facts(found: Design) -> Iterator[tuple[str, str]]:
    """Yield how the poses were chosen, and their predicted accuracy compared with random ones."""
    designed = found.found.designed
    random = found.found.random
    yield "candidates", found.drawn.in_words()
    path = (
        f"{found.path_length:.1f} joint ranges from first to last pose, "
        f"{found.path_length_unordered:.1f} before ordering"
    )
    yield "path length", path
    if found.needed is not None:
        yield "accuracy", f"{found.needed} of the candidates are the fewest poses that reach it"
    what = found.design_model.quantity
    yield (
        "predicted",
        f"{what} error over the task {1e3 * designed.error:.4f} mm rms, if the model has "
        "the right form",
    )
    if found.before is not None:
        yield "before", f"{1e3 * found.before.error:.4f} mm with the poses already measured"
    ratio = (
        f"{random.error / designed.error:.2f} times as much, "
        if found.criterion != "tell apart"
        else ""
    )
    yield "random", f"{1e3 * random.error:.4f} mm ({ratio}median of {RANDOM_DESIGNS} draws)"
    if found.bound is not None:
        beyond = (
            "; the refined poses are better than all candidates"
            if designed.error < found.bound
            else ""
        )
        yield (
            "lower bound",
            f"no selection of the candidates has less than {1e3 * found.bound:.4f} mm{beyond}",
        )
    for mine, other, left, chance in zip(
        found.rivals, found.rivals[::-1], designed.apart, random.apart, strict=False
    ):
        verdict = (
            "distinguishable"
            if left >= SIGHT.told_apart
            else f"not distinguishable, {SIGHT.told_apart:g} are needed"
        )
        verdict += f" (random {chance:.3g})"
        yield (
            "rivals",
            f"{mine} of typical size leaves {left:.3g} that {other} can't explain: {verdict}",
        )
    yield "rank", f"{found.rank} identifiable directions of the parameters"
    for name in _SHOWN:
        if name in found.observability:
            numbers = (
                f"{found.observability[name]:.3g}, random {found.observability_random[name]:.3g}"
            )
            yield f"index {name}", f"{numbers} (observability, {SOURCES[name]})"
