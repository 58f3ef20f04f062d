"""The report of a calibration as one page that needs no network."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from pincal.calibration.result import ParameterRow, Result
from pincal.calibration.run import Calibration
from pincal.calibration.tables import shown_parameters
from pincal.discover.run import Discovery
from pincal.discover.shrink import gap_names
from pincal.report.advice import unidentified_groups
from pincal.report.glossary import TERMS, effect_meaning
from pincal.report.illustrations import Picture, illustrations
from pincal.report.summary import next_steps, verdict_of
from pincal.report.words import effect_words, noise_words
from pincal.units import format_digits, readable_unit, small_unit
from pincal.validate.lack_of_fit import lack_words, pure_words
from pincal.validate.replicates import ANGLE_WORDS, cycle_words

log = logging.getLogger(__name__)

_STATISTICS = (("mean", "mean"), ("p95", "95 %"), ("max", "worst"))
# An effect with more parameters than this is a curve; its numbers stand in discovery.json.
_FEW = 4


def write_report(
    path: Path,
    calibration: Calibration,
    provenance: dict[str, Any],
    notes: tuple[str, ...],
    discovery: Discovery | None = None,
    *,
    view: str | None = None,
) -> None:
    """Write ``report.html``: how good, where the errors are, what was missing, parameters, and what it all rests on.

    Args:
        path: the file.
        calibration: what to report.
        provenance: versions, command, inputs with hashes.
        notes: what the exported URDF does not carry.
        discovery: what was found missing, if it was looked for.
        view: name of the file beside the report that holds the view in three dimensions, if there is one.
    """
    path.write_text(report_page(calibration, provenance, notes, discovery, view=view), encoding="utf-8")


def report_page(
    calibration: Calibration,
    provenance: dict[str, Any],
    notes: tuple[str, ...],
    discovery: Discovery | None = None,
    *,
    view: str | None = None,
) -> str:
    """Return what :func:`write_report` writes."""
    import jinja2
    from markupsafe import Markup

    log.info("drawing the report")
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("pincal.report", "page"), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["svg"] = Markup  # drawn by pincal.report.svg, all text in it escaped
    result = calibration.result
    part = "test" if "test" in result.error["calibrated"] else "train"
    return environment.get_template("report.html.j2").render(
        calibration=calibration,
        robot=calibration.robot,
        result=result,
        noise_words=noise_words,
        part=part,
        glance=_glance(result, part),
        verdict=verdict_of(result, discovery),
        steps=next_steps(calibration, discovery),
        errors=_error_rows(result),
        cycle_words=cycle_words,
        lack_words=lack_words,
        pure_words=pure_words,
        angle_words=ANGLE_WORDS,
        parameters=[(row, *_readable(row)) for row in shown_parameters(result.parameters)],
        untold=unidentified_groups(shown_parameters(result.parameters)),
        notes=notes,
        provenance=provenance,
        discovery=discovery,
        found=[] if discovery is None else _effects(discovery.report),
        untestable=[] if discovery is None else _untestable(discovery.report),
        gaps=[] if discovery is None else list(zip(gap_names(discovery.gaps), discovery.gaps, strict=True)),
        pictures=_by_section(illustrations(calibration, discovery)),
        view=view,
        terms=TERMS,
        meaning=effect_meaning,
    )


def _by_section(pictures: list[Picture]) -> dict[str, list[Picture]]:
    found: dict[str, list[Picture]] = {}
    for picture in pictures:
        found.setdefault(picture.section, []).append(picture)
    return found


def _glance(result: Result, part: str) -> list[dict[str, Any]]:
    """Return mean, 95 % and worst error, before and after, with the lengths of their bars [%]."""
    before, after = (result.error[model][part] for model in ("nominal", "calibrated"))
    found = []
    for unit in ("mm", "mrad"):
        keys = [(f"{name}_{unit}", words) for name, words in _STATISTICS if f"{name}_{unit}" in after]
        largest = max((max(before[key], after[key]) for key, _ in keys), default=0.0) or 1.0
        for key, words in keys:
            shares = [100.0 * errors[key] / largest for errors in (before, after)]
            better = before[key] / after[key] if after[key] > 0.0 else None
            found.append({"words": words, "unit": unit, "before": before[key], "after": after[key], "bars": shares,
                          "better": better})  # fmt: skip
    return found


def _error_rows(result: Result) -> list[tuple[str, str, dict[str, float]]]:
    """Return (model, rows, statistics) for the table of errors."""
    models = {"nominal": "before: base and tool fitted", "calibrated": "after: calibrated"}
    rows = {"train": "fitted", "test": "held out"}
    return [
        (models.get(model, model), rows.get(part, part), values)
        for model, by_rows in result.error.items()
        for part, values in by_rows.items()
    ]


def _effects(report: dict[str, Any]) -> list[dict[str, Any]]:
    """Return what was found, each effect with all that is to be said of it."""
    found = []
    for entry in report["effects"]:
        parameters = [(name, _measured(p["value"], p["sigma"], p["unit"])) for name, p in entry["parameters"].items()]
        found.append(
            {
                "name": effect_words(entry),
                "meaning": effect_meaning(entry["effect"]),
                "parameters": parameters if len(parameters) <= _FEW else [],
                "count": len(parameters),
                "chance": f"{entry['p_value']:.0e}" if entry["p_value"] > 0.0 else "below 1e-300",
                "before": entry["gap_before_mm"],
                "after": entry["gap_after_mm"],
                "equivalent": [effect_words(other) for other in entry["equivalent"]],
                "tell_apart": entry["tell_apart"],
            }
        )
    return found


def _measured(value: float, sigma: float | None, unit: str) -> str:
    """Return a value with its standard deviation to two digits, in the unit that suits it."""
    factor, name = small_unit(unit)
    if not sigma:
        return f"{format_digits(value * factor)} {name}"
    places = max(0, 1 - int(np.floor(np.log10(sigma * factor))))
    return f"{value * factor:z.{places}f} ± {sigma * factor:.{places}f} {name}"


def _untestable(report: dict[str, Any]) -> list[tuple[str, str]]:
    """Return effects that could not be tested, by reason."""
    reasons: dict[str, list[str]] = {}
    for entry in report["not_testable"]:
        reason = entry["reason"].replace(entry["joint"], "this joint") if entry["joint"] else entry["reason"]
        reasons.setdefault(reason, []).append(entry["effect"])
    return [(", ".join(dict.fromkeys(names)), reason) for reason, names in reasons.items()]


def _readable(row: ParameterRow) -> tuple[str, str, str, str]:
    """Return unit, nominal, value and sigma of a parameter as text."""
    factor, unit = readable_unit(row.unit)
    form = "{:z.4f}" if factor != 1.0 else "{:.3e}"
    sigma = "-" if row.sigma is None else f"{row.sigma * factor:#.2g}"
    nominal, value = (form.format(v * factor) if v or unit in ("mm", "mrad") else "0" for v in (row.nominal, row.value))
    return unit, nominal, value, sigma
