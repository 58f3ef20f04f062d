"""Results as text that fits 100 columns: in ten lines, or with all tables; with colours on a
terminal, plain elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from msgspec import UNSET
from rich.console import Console, RenderableType

from pincal.calibration import result_tables
from pincal.calibration.precheck import DataReport
from pincal.calibration.result import Result
from pincal.errors import counted
from pincal.notes import Note, doubts_first, doubts_of
from pincal.report import precheck_tables
from pincal.report.words import (
    elsewhere_words,
    noise_origin,
    noise_words,
    rank_words,
)
from pincal.result_table import hanging, one_line
from pincal.robot.robot import Robot
from pincal.sensors.registry import blocks_of
from pincal.units import show_chance
from pincal.validate.accuracy import cycle_words, leading_unit
from pincal.validate.lack_of_fit import LackOfFit

# Dimension -> mean distance of independent errors of standard deviation 1 (chi distribution).
_MEAN_DISTANCE = {1: np.sqrt(2.0 / np.pi), 2: np.sqrt(np.pi / 2.0), 3: np.sqrt(8.0 / np.pi)}


def print_elsewhere(result: Result, out: Console) -> None:
    """Print the error that the model expects away from the measured poses."""
    if result.elsewhere is not UNSET:
        errors = result.error["calibrated"]
        error = errors.get("test", errors["train"])
        name = "task" if result.elsewhere.over else "anywhere"
        _line(out, name, elsewhere_words(result.elsewhere, error))


def print_brief_check(found: DataReport, robot: Robot, out: Console, *, command: str) -> None:
    """Print the summary of what a table can identify."""
    print_doubts(found.warnings, out)
    _line(out, "robot", arm_words(robot))
    _line(out, "rows", f"{found.rows} {found.kind} measurements")
    _line(out, "before", _nominal(found))
    _line(out, "noise", noise_line(found.noise, found.kind))
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
    out.print(f"next     {one_line(command)}", markup=False, soft_wrap=True)
    _line(
        out,
        "more",
        "--verbose: coverage, expected uncertainty of each parameter, smallest detectable effects",
    )


def _nominal(found: DataReport) -> str:
    """Return the errors of the nominal robot, as a calibration prints them."""
    words, ways = error_words(found.nominal, found.ways)
    return "; ".join([f"{words}: nominal, base and tool fitted, {ways[0]}", *ways[1:]])


def error_words(
    values: Mapping[str, float], by_way: Mapping[str, Mapping[str, float]], lead: str = ""
) -> tuple[str, list[str]]:
    """Return errors, and of which rows they are; further ways of leaving rows out follow with their
    mean error, unless it is the same.

    Args:
        values: the errors.
        by_way: the errors by each way of leaving rows out.
        lead: of which rows they are if none of these ways has them; default: fitted ones.
    """
    unit = leading_unit(values)
    words = (
        f"mean {values[f'mean_{unit}']:.4f} {unit}, 95 % {values[f'p95_{unit}']:.4f}, max "
        f"{values[f'max_{unit}']:.4f}"
    )
    own = next((way for way in by_way if by_way[way] == values), None)
    others = [
        f"{result_tables.PARTS[way].removeprefix('held-out ')} {of[f'mean_{unit}']:.4f}"
        for way, of in by_way.items()
        # Of few rows each is left out alone, whichever way.
        if of != values
    ]
    first = (lead or "no rows held out") if own is None else result_tables.PARTS[own]
    return words, [first, *others]


def print_first_notes(told: Sequence[Note | str], out: Console) -> None:
    """Print the first note and the number of others; doubts are printed before the
    result, in full.
    """
    notes = [note for note in doubts_first(told) if not note.is_doubt]
    if notes:
        rest = f" ({counted(len(notes) - 1, 'more note')} with --verbose)" if len(notes) > 1 else ""
        out.print(hanging("note:   ", f"{notes[0]}{rest}"), style="yellow")


def noise_line(noise: Mapping[str, Any], kind: str) -> str:
    """Return the noise as a mean distance and per coordinate, with its origin."""
    return f"{_noise_of(noise, kind)} ({noise_origin(noise)})"


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


def arm_words(robot: Robot, option: str = " (--tip takes another link)") -> str:
    """Return the arm in words, with the option that selects another."""
    ways = "; ".join(
        f"{start} to {tip}" for start, tip in ((robot.path.start, robot.tip), *robot.links)
    )
    return f"{robot.name}, {counted(robot.n_joints, 'joint')} from {ways}{option}"


def _line(out: Console, name: str, text: str) -> None:
    out.print(hanging(f"{name:8s}", one_line(text)), markup=False)


def print_lines(
    lines: Iterable[tuple[str, str]], out: Console, *, following: str | None = None
) -> None:
    """Print headings and lines, each behind its heading, and what to do next.

    Args:
        lines: headings and lines.
        out: where to print.
        following: the command to give next, in one line whatever the width; None for none.
    """
    lines = tuple(lines)
    width = max((len(heading) for heading, _ in lines), default=0)
    for paragraph in _paragraphs(lines):
        out.print(paragraph, markup=False)
    if following is not None:
        out.print(f"{'next':{width}s} {one_line(following)}", markup=False, soft_wrap=True)


def height_of(lines: Iterable[tuple[str, str]], out: Console) -> int:
    """Return how many lines of a terminal :func:`print_lines` takes."""
    return sum(len(out.render_lines(paragraph)) for paragraph in _paragraphs(tuple(lines)))


def _paragraphs(lines: Sequence[tuple[str, str]]) -> Iterator[RenderableType]:
    """Yield lines behind their headings."""
    width = max((len(heading) for heading, _ in lines), default=0)
    for heading, text in lines:
        yield hanging(f"{heading:{width}s}", text)


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
    print_elsewhere(result, out)
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
        else f", reduced chi-square {result.chi2_reduced:.3f} (p {show_chance(p_value)})"
    )
    rank = rank_words(
        (row.status for row in result.parameters), rank=result.rank, condition=result.condition
    )
    return (
        f"{result.rows['train']} rows fitted, "
        f"{held_out_words(result) or 'errors by cross-validation'}; "
        f"{counted(result.iterations, 'iteration')}, "
        f"{result.seconds:.2f} s\nnoise {noise_words(result.noise)} "
        f"({noise_origin(result.noise)}){chi2}\n{rank}"
    )


def held_out_words(result: Result) -> str:
    """Return how many rows or stations were held out; "" for cross-validation, whose errors name
    their rows.
    """
    turns = (
        0 if result.stations is UNSET else sum("left_out" in station for station in result.stations)
    )
    if turns:
        return f"{turns} stations held out in turn"
    if result.validation is UNSET or not result.validation.folds:
        return f"{result.rows['test']} held out"
    return ""


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
    out.print(f"{precheck.rows} {precheck.kind} measurements; {_nominal(precheck)}")
    out.print(f"noise {noise_words(precheck.noise)} ({noise_origin(precheck.noise)})")
    statuses = (parameter.status for parameter in precheck.parameters)
    out.print(rank_words(statuses, rank=precheck.rank, condition=precheck.condition))
    out.print(precheck_tables.coverage_table(precheck))
    out.print(precheck_tables.expectation_table(precheck))
    for section in precheck.further.values():
        for block in section.blocks(precheck):
            out.print(block)
    print_notes(precheck.warnings, out)
