"""Results as text that fits 100 columns: with colours on a terminal, plain elsewhere."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from pincal.calibration.result import ParameterRow, Result, shown_parameters
from pincal.cli.detectability import print_detectability
from pincal.cli.replicates import print_replicates
from pincal.cli.screen import cell, console, hanging, new_table
from pincal.discover.precheck import DataReport
from pincal.discover.shrink import StageError, gap_names
from pincal.report.words import effect_words, noise_words
from pincal.units import readable_unit

__all__ = [
    "console",
    "error_table",
    "expectation_table",
    "gap_table",
    "parameter_table",
    "print_discovery",
    "print_reasons",
    "print_result",
    "print_survey",
]

_STATISTICS = ("mean", "median", "rms", "p95", "max")
_STYLE = {"identified": "", "prior": "yellow", "fixed": "dim", "unidentifiable": "yellow", "at bound": "red"}


def print_result(result: Result, out: Console) -> None:
    """Print errors before and after, the parameters, and what the user should know."""
    out.print(_summary(result))
    out.print(error_table(result.error))
    print_replicates(result.iso9283, result.lack_of_fit, out)
    shown = shown_parameters(result.parameters)
    out.print(parameter_table(shown))
    print_reasons(shown, out)
    _tell_hidden_points(len(result.parameters) - len(shown), out)
    print_notes(result, out)


def print_notes(result: Result, out: Console) -> None:
    """Print what the user should know."""
    for note in result.warnings:
        out.print(hanging("note:", note), style="yellow")


def _summary(result: Result) -> str:
    noise = result.noise
    sigma = f"noise {noise_words(noise)} ({noise['source']})"
    chi2 = (
        ""
        if result.chi2_p_value is None
        else f", reduced chi-square {result.chi2_reduced:.3f} (p {result.chi2_p_value:.2g})"
    )
    free = sum(row.status in ("identified", "prior", "at bound", "unidentifiable") for row in result.parameters)
    return (
        f"{result.rows['train']} rows fitted, {result.rows['test']} held out; {result.iterations} iterations, "
        f"{result.seconds:.2f} s\n{sigma}{chi2}\nrank {result.rank} of {free} parameters, condition {result.condition:.2g}"
    )


def error_table(error: dict[str, dict[str, dict[str, float]]]) -> Table:
    """Return the errors before and after as a table, position and orientation in lines of their own."""
    table = new_table("Pose accuracy: distance from predicted to measured target")
    for name in ("model", "rows", "unit"):
        table.add_column(name, no_wrap=True)
    for name in _STATISTICS:
        table.add_column(name, justify="right", no_wrap=True)
    words = {"nominal": "nominal, base and tool fitted", "calibrated": "calibrated"}
    parts = {"train": "fitted", "test": "held out"}
    for model, by_rows in error.items():
        for rows, values in by_rows.items():
            for unit in ("mm", "mrad", "px"):
                if f"mean_{unit}" in values:
                    numbers = [f"{values[f'{name}_{unit}']:.4f}" for name in _STATISTICS]
                    table.add_row(words.get(model, model), parts.get(rows, rows), unit, *numbers)
    return table


def parameter_table(parameters: Iterable[ParameterRow]) -> Table:
    """Return the parameter table: mm and mrad, compliances in rad/(N m); reasons by number below it."""
    rows = list(parameters)
    notes = _numbered_reasons(rows)
    table = new_table("Parameters")
    table.add_column("parameter", overflow="fold")
    table.add_column("unit", no_wrap=True)
    for name in ("nominal", "value", "sigma"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("status", no_wrap=True)
    for row in rows:
        factor, unit = readable_unit(row.unit)
        numbers = [row.nominal * factor, row.value * factor]
        sigma = "-" if row.sigma is None else _number(row.sigma * factor, unit, digits=2)
        mark = f" ({notes[row.reason]})" if row.reason else ""
        cells = (unit, *(_number(v, unit) for v in numbers), sigma, row.status + mark)
        table.add_row(cell(row.name), *cells, style=_STYLE[row.status])
    return table


def _number(value: float, unit: str, *, digits: int = 4) -> str:
    if unit == "px":
        return f"{value:z.3f}"
    if unit not in ("mm", "mrad", "µrad/(N m)"):
        return f"{value:.{digits - 1}e}" if value else "0"
    return f"{value:z.{digits}f}" if digits > 2 else f"{value:#.2g}"


def _numbered_reasons(rows: Sequence[ParameterRow]) -> dict[str, int]:
    return {reason: i + 1 for i, reason in enumerate(dict.fromkeys(row.reason for row in rows if row.reason))}


def print_reasons(parameters: Iterable[ParameterRow], out: Console) -> None:
    """Print the reasons that the parameter table refers to by number."""
    for reason, number in _numbered_reasons(list(parameters)).items():
        out.print(hanging(f"{f'({number})':>5s}", reason))


def print_survey(precheck: DataReport, out: Console) -> None:
    """Print what a table can tell."""
    out.print(f"{precheck.rows} rows of kind {precheck.kind}; nominal robot, base and tool fitted: mean "
              f"{precheck.nominal['mean_mm']:.3f} mm, max {precheck.nominal['max_mm']:.3f} mm")  # fmt: skip
    out.print(f"noise {noise_words(precheck.noise)} ({precheck.noise['source']})")
    out.print(f"rank {precheck.rank} of {precheck.released} parameters, condition {precheck.condition:.2g}")
    table = new_table("Coverage of the joints")
    for name in ("joint", "from", "to", "limits", "covered"):
        table.add_column(name, justify="left" if name == "joint" else "right")
    for joint in precheck.joints:
        limits, share = "none", "-"
        if joint.lower_limit is not None and joint.upper_limit is not None:
            limits = f"{joint.lower_limit:.3f} .. {joint.upper_limit:.3f}"
            share = f"{100 * (joint.high - joint.low) / (joint.upper_limit - joint.lower_limit):.0f} %"
        table.add_row(cell(joint.joint), f"{joint.low:.3f}", f"{joint.high:.3f}", limits, share)
    out.print(table)
    rows = [ParameterRow(p.name, p.unit, 0.0, 0.0, p.sigma, p.status, p.reason, p.effect) for p in precheck.parameters]
    shown = shown_parameters(rows)
    out.print(expectation_table(shown))
    print_reasons(shown, out)
    _tell_hidden_points(len(rows) - len(shown), out)
    print_detectability(precheck.detectable, [joint.joint for joint in precheck.joints], out)
    for note in precheck.warnings:
        out.print(hanging("note:", note), style="yellow")


def _tell_hidden_points(coordinates: int, out: Console) -> None:
    if coordinates:
        out.print(f"and the places of {coordinates // 3} named points: with --json and in result.json")


def expectation_table(rows: Sequence[ParameterRow]) -> Table:
    """Return what to expect of each parameter before anything is fitted."""
    notes = _numbered_reasons(rows)
    table = new_table("What these poses can tell")
    table.add_column("parameter", overflow="fold")
    for name in ("unit", "sigma to expect", "status"):
        table.add_column(name, justify="right" if name.startswith("sigma") else "left", no_wrap=True)
    for row in rows:
        factor, unit = readable_unit(row.unit)
        mark = f" ({notes[row.reason]})" if row.reason else ""
        sigma = _number((row.sigma or 0.0) * factor, unit, digits=2)
        table.add_row(cell(row.name), unit, sigma, row.status + mark, style=_STYLE[row.status])
    return table


def print_discovery(report: dict[str, Any], out: Console, gaps: tuple[StageError, ...] = ()) -> None:
    """Print where the disagreement sat, what made it, and how the gap shrank down to the noise.

    Args:
        report: contents of ``discovery.json``.
        out: where to.
        gaps: errors on held-out rows step by step; only first and last without them.
    """
    out.print(f"Verdict: {report['verdict']}, {report['unexplained_mm']:.4f} mm rms unexplained")
    if report["where"]:
        out.print("Where model and data disagreed, before anything was named (shares of what is beyond the noise):")
    for place in report["where"]:
        out.print(hanging(f"  {100 * place['share']:3.0f} % ", place["statement"]))
    out.print(_effect_table(report["effects"]) if report["effects"] else "No effect is missing that these data could show.")
    out.print(gap_table(report, gaps))
    for entry in report["effects"]:
        if entry["tell_apart"]:
            out.print(hanging("to tell", f"{effect_words(entry)} from its rivals: {entry['tell_apart']}"))
        if "period" in entry:
            out.print(cell(f"{effect_words(entry)} repeats every {entry['period']:.4g} {_period_unit(entry)}"))
    for entry in report["scatter"]:
        out.print(cell(f"{entry['joint']} scatters by {entry['sigma_rad'] * 1e3:.3f} mrad; record {entry['missing']}"))
    reasons: dict[str, list[str]] = {}
    for entry in report["not_testable"]:
        reason = entry["reason"].replace(entry["joint"], "this joint") if entry["joint"] else entry["reason"]
        reasons.setdefault(reason, []).append(entry["effect"])
    for reason, names in reasons.items():
        out.print(hanging("not testable:", f"{', '.join(dict.fromkeys(names))}: {reason}"))


def _period_unit(entry: dict[str, Any]) -> str:
    return {"time": "s", "temperature": "K", "payload": "kg"}.get(entry["depends_on"], "rad")


def _effect_table(effects: list[dict[str, Any]]) -> Table:
    table = new_table("Effects found")
    for name in ("effect", "joint", "p", "mean before", "after", "could also be"):
        table.add_column(name, justify="right" if name in ("p", "mean before", "after") else "left")
    for entry in effects:
        also = "; ".join(effect_words(other) for other in entry["equivalent"])
        chance = f"{entry['p_value']:.0e}" if entry["p_value"] > 0.0 else "<1e-300"
        numbers = (chance, f"{entry['gap_before_mm']:.4f}", f"{entry['gap_after_mm']:.4f}")
        joint = cell(entry["joint"] or "whole arm")
        table.add_row(cell(effect_words(entry, joint=False)), joint, *numbers, cell(also))
    return table


def gap_table(report: dict[str, Any], gaps: tuple[StageError, ...] = ()) -> Table:
    """Return the errors on held-out rows, step by step where known, beside the noise."""
    table = new_table("How the gap shrank: errors on held-out rows in mm")
    table.add_column("model", overflow="fold")
    for name in ("mean", "rms", "max", "rms over noise"):
        table.add_column(name, justify="right", no_wrap=True)
    floor = report["noise_floor_mm"]
    rows = [(name, gap.to_dict()) for name, gap in zip(gap_names(gaps), gaps, strict=True)] if gaps else []
    for name, gap in rows or [("at the start", report["gap"]["before"]), ("all together", report["gap"]["after"])]:
        numbers = [f"{gap[key]:.4f}" for key in ("mean_mm", "rms_mm", "max_mm")]
        table.add_row(cell(name), *numbers, f"{gap['rms_mm'] / floor:.2f}" if floor > 0.0 else "-")
    table.add_row("noise alone", "", f"{floor:.4f}", "", "1.00", style="dim")
    return table
