"""Results as text that fits 100 columns: with colours on a terminal, plain elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any

from rich.console import Console
from rich.table import Table

from pincal.report.result import ParameterRow, Result
from pincal.report.survey import Survey

_WIDTH = 100
_STATISTICS = ("mean", "median", "rms", "p95", "max")
_STYLE = {"identified": "", "prior": "yellow", "fixed": "dim", "unidentifiable": "yellow", "at bound": "red"}


def console() -> Console:
    """Return where results are printed: stdout."""
    width = None if sys.stdout.isatty() else _WIDTH
    return Console(width=width, highlight=False, soft_wrap=False)


def print_result(result: Result, out: Console) -> None:
    """Print errors before and after, the parameters, and what the user should know."""
    out.print(_summary(result))
    out.print(error_table(result.error))
    out.print(parameter_table(result.parameters))
    print_reasons(result.parameters, out)
    for note in result.warnings:
        out.print(f"note: {note}", style="yellow", markup=False)


def _summary(result: Result) -> str:
    noise = result.noise
    sigma = f"noise {noise['sigma_m'] * 1e3:.4g} mm a coordinate ({noise['source']})"
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
    table = Table(title="Pose accuracy: distance from predicted to measured target", title_justify="left")
    for name in ("model", "rows", "unit"):
        table.add_column(name, no_wrap=True)
    for name in _STATISTICS:
        table.add_column(name, justify="right", no_wrap=True)
    words = {"nominal": "nominal, base and tool fitted", "calibrated": "calibrated"}
    parts = {"train": "fitted", "test": "held out"}
    for model, by_rows in error.items():
        for rows, values in by_rows.items():
            for unit in ("mm", "mrad"):
                if f"mean_{unit}" in values:
                    numbers = [f"{values[f'{name}_{unit}']:.4f}" for name in _STATISTICS]
                    table.add_row(words.get(model, model), parts.get(rows, rows), unit, *numbers)
    return table


def parameter_table(parameters: Iterable[ParameterRow]) -> Table:
    """Return the parameter table: mm and mrad, compliances in rad/(N m); reasons by number below it."""
    rows = list(parameters)
    notes = _numbered_reasons(rows)
    table = Table(title="Parameters", title_justify="left")
    for name in ("parameter", "unit"):
        table.add_column(name, no_wrap=True)
    for name in ("nominal", "value", "sigma"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("status", no_wrap=True)
    for row in rows:
        factor, unit = {"m": (1e3, "mm"), "rad": (1e3, "mrad")}.get(row.unit, (1.0, row.unit))
        numbers = [row.nominal * factor, row.value * factor]
        sigma = "-" if row.sigma is None else _number(row.sigma * factor, unit, digits=2)
        mark = f" ({notes[row.reason]})" if row.reason else ""
        table.add_row(
            row.name, unit, *(_number(v, unit) for v in numbers), sigma, row.status + mark, style=_STYLE[row.status]
        )
    return table


def _number(value: float, unit: str, *, digits: int = 4) -> str:
    if unit not in ("mm", "mrad"):
        return f"{value:.{digits - 1}e}" if value else "0"
    return f"{value:z.{digits}f}" if digits > 2 else f"{value:#.2g}"


def _numbered_reasons(rows: list[ParameterRow]) -> dict[str, int]:
    return {reason: i + 1 for i, reason in enumerate(dict.fromkeys(row.reason for row in rows if row.reason))}


def print_reasons(parameters: Iterable[ParameterRow], out: Console) -> None:
    """Print the reasons that the parameter table refers to by number."""
    for reason, number in _numbered_reasons(list(parameters)).items():
        out.print(f" ({number}) {reason}", markup=False)


def print_survey(survey: Survey, out: Console) -> None:
    """Print what a table can tell."""
    out.print(f"{survey.rows} rows of kind {survey.kind}; nominal robot, base and tool fitted: mean "
              f"{survey.nominal['mean_mm']:.3f} mm, max {survey.nominal['max_mm']:.3f} mm")  # fmt: skip
    out.print(f"noise {survey.noise['sigma_m'] * 1e3:.4g} mm a coordinate ({survey.noise['source']})")
    out.print(f"rank {survey.rank} of {survey.released} parameters, condition {survey.condition:.2g}")
    table = Table(title="Coverage of the joints", title_justify="left")
    for name in ("joint", "from", "to", "limits", "covered"):
        table.add_column(name, justify="left" if name == "joint" else "right")
    for joint in survey.joints:
        limits, share = "none", "-"
        if joint.lower_limit is not None and joint.upper_limit is not None:
            limits = f"{joint.lower_limit:.3f} .. {joint.upper_limit:.3f}"
            share = f"{100 * (joint.high - joint.low) / (joint.upper_limit - joint.lower_limit):.0f} %"
        table.add_row(joint.joint, f"{joint.low:.3f}", f"{joint.high:.3f}", limits, share)
    out.print(table)
    rows = [ParameterRow(p.name, p.unit, 0.0, 0.0, p.sigma, p.status, p.reason) for p in survey.parameters]
    out.print(expectation_table(rows))
    print_reasons(rows, out)
    for note in survey.warnings:
        out.print(f"note: {note}", style="yellow", markup=False)


def expectation_table(rows: list[ParameterRow]) -> Table:
    """Return what to expect of each parameter before anything is fitted."""
    notes = _numbered_reasons(rows)
    table = Table(title="What these poses can tell", title_justify="left")
    for name in ("parameter", "unit", "sigma to expect", "status"):
        table.add_column(name, justify="right" if name.startswith("sigma") else "left", no_wrap=True)
    for row in rows:
        factor, unit = {"m": (1e3, "mm"), "rad": (1e3, "mrad")}.get(row.unit, (1.0, row.unit))
        mark = f" ({notes[row.reason]})" if row.reason else ""
        table.add_row(row.name, unit, _number((row.sigma or 0.0) * factor, unit, digits=2), row.status + mark,
                      style=_STYLE[row.status])  # fmt: skip
    return table


def print_discovery(report: dict[str, Any], out: Console) -> None:
    """Print what was found, step by step, down to the noise floor."""
    before, after = report["gap"]["before"], report["gap"]["after"]
    out.print(
        f"Held-out error: mean {before['mean_mm']:.4f} -> {after['mean_mm']:.4f} mm, "
        f"rms {before['rms_mm']:.4f} -> {after['rms_mm']:.4f} mm; noise alone {report['noise_floor_mm']:.4f} mm rms\n"
        f"Verdict: {report['verdict']}, unexplained {report['unexplained_mm']:.4f} mm"
    )
    table = Table(title="Effects found", title_justify="left")
    for name in ("effect", "joint", "p", "mean before", "after", "could also be"):
        table.add_column(name, justify="right" if name in ("p", "mean before", "after") else "left")
    for entry in report["effects"]:
        also = "; ".join(_effect_words(other) for other in entry["equivalent"])
        numbers = (f"{entry['p_value']:.0e}", f"{entry['gap_before_mm']:.4f}", f"{entry['gap_after_mm']:.4f}")
        table.add_row(_effect_words(entry, joint=False), entry["joint"] or "whole arm", *numbers, also)
    out.print(table if report["effects"] else "No effect is missing that these data could show.")
    for place in report["where"]:
        out.print(f"where: {place['statement']} ({100 * place['share']:.0f} % of what was left)", markup=False)
    for entry in report["effects"]:
        if entry["tell_apart"]:
            out.print(f"to tell {_effect_words(entry)} from its rivals: {entry['tell_apart']}", markup=False)
    for entry in report["scatter"]:
        out.print(
            f"{entry['joint']} scatters by {entry['sigma_rad'] * 1e3:.3f} mrad; record {entry['missing']}", markup=False
        )
    reasons: dict[str, list[str]] = {}
    for entry in report["not_testable"]:
        reasons.setdefault(entry["reason"], []).append(entry["effect"])
    for reason, names in reasons.items():
        out.print(f"not testable: {', '.join(dict.fromkeys(names))}: {reason}", markup=False)


def _effect_words(entry: dict[str, Any], *, joint: bool = True) -> str:
    words = [entry["effect"]]
    if joint and entry["joint"]:
        words.append(f"of {entry['joint']}")
    if "source" in entry:
        words.append(f"by {entry['source']}")
    if entry.get("order", 1) != 1:
        words.append(f"order {entry['order']}")
    if "depends_on" in entry:
        words.append(f"({entry.get('shape', 'curve')} of {entry['depends_on']})")
    return " ".join(words)
