"""The certificate of a measured part: of the ``measured.json`` that ``pincal measure`` wrote."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from scipy.special import ndtr, stdtr

from pincal.certificate.contents import (
    NOT_STATED,
    Budget,
    BudgetLine,
    Certificate,
    Figure,
    FigureGroup,
    Issue,
    StatedUncertainty,
    checksums_of_inputs,
)
from pincal.errors import BadInputError, counted
from pincal.features.measured_file import (
    DatumEntry,
    FeatureEntry,
    MeasuredFile,
    SourceEntry,
    ValueEntry,
)
from pincal.features.part_feature import QUANTITIES
from pincal.identity import Identity
from pincal.io.result_folder import file_hash
from pincal.io.strict_json import FileKind, read_json
from pincal.notes import doubts_of
from pincal.thresholds import Count

MEASURED = "measured.json"
_TABLE = "measured.csv"
# Of the probability that U covers: 0.9545.
_DIGITS: Count = 4
_MEASURED_FILE = FileKind(
    "a measured.json",
    BadInputError,
    "run pincal measure again",
    whole="a file written by pincal measure",
)


def certificate_of_measured(folder: Path, stated: Identity, issue: Issue) -> Certificate:
    """Return the certificate of a measured part.

    Args:
        folder: the folder that ``pincal measure`` wrote.
        stated: what is stated in addition to the identity in its ``measured.json``.
        issue: number and day of the certificate.

    Raises:
        BadInputError: if the folder has no such file, or it can't be read; or if it is of another
            robot than stated.
    """
    path = folder / MEASURED
    if not path.is_file():
        raise BadInputError(
            f"{folder}: holds no {MEASURED}; expected a model.json, or the folder that pincal "
            "measure wrote"
        )
    found = read_json(path, MeasuredFile, _MEASURED_FILE)
    known = found.id or Identity()
    stated.require(known, str(path))
    identity = stated.over(known.over(issue.usual))
    return Certificate(
        title="Certificate of a measured part",
        issue=issue,
        item=identity.note.get("part", f"part {NOT_STATED}"),
        identity=identity,
        facts={"datum": _words(found.datum)} | _decided(found) | _range(found),
        verdict=found.verdict or "",
        doubts=tuple(doubt.text for doubt in doubts_of(found.warnings)),
        groups=tuple(map(_group, found.features)),
        budget=_budget(found.budget),
        rule=found.rule,
        files=_files(path, found.provenance),
        versions={
            "measured with pincal": str(found.provenance.get("pincal", NOT_STATED)),
            "certificate by pincal": version("pincal"),
        },
    )


def _files(path: Path, provenance: Mapping[str, Any]) -> dict[str, str]:
    """Return the checksums of what was written, and of what it was made of."""
    written = (path, path.with_name(_TABLE))
    own = {file.name: file_hash(file) for file in written if file.is_file()}
    return own | checksums_of_inputs(provenance)


def _words(datum: DatumEntry) -> str:
    """Return the datum in words."""
    by = f" by {', '.join(datum.features)}" if datum.features else ""
    return f"{datum.kind}{by} in the frame of the {datum.frame}"


def _decided(found: MeasuredFile) -> dict[str, str]:
    """Return how many features there are, and how many quantities conform to their limits."""
    counts = Counter(str(value.decision) for _, _, value in found.decided())
    facts = {"features": str(len(found.features))}
    if counts:
        facts["decisions"] = ", ".join(f"{decision}: {count}" for decision, count in counts.items())
    return facts


def _range(found: MeasuredFile) -> dict[str, str]:
    """Return which rows lie outside the range of the calibration."""
    return {"outside the calibrated range": found.outside} if found.outside else {}


def _group(feature: FeatureEntry) -> FigureGroup:
    """Return the figures of a feature."""
    return FigureGroup(
        title=f"{feature.name} ({feature.kind})",
        figures=tuple(_figures(feature)),
        remark=counted(feature.readings, "reading") if feature.readings else "",
    )


def _figures(feature: FeatureEntry) -> Iterator[Figure]:
    for name, of in feature.values.items():
        # A k without a word would be taken for the coverage factor.
        said = name if name in QUANTITIES[feature.kind] else f"direction {name}"
        stated = None if of.is_held else StatedUncertainty(of.U, of.k, _probability(of))
        yield Figure(
            name=f"{said} (held by the datum)" if of.is_held else said,
            value=of.value,
            unit=of.unit,
            expanded=stated,
            nominal=of.nominal,
            limits=None if of.limits is None else _limits(of.limits),
            decision=of.decision,
        )
    if feature.form_mm is not None:
        yield Figure(name="form", value=feature.form_mm, unit="mm")


def _probability(of: ValueEntry) -> float:
    """Return the probability that U covers, by k and its degrees of freedom, to the digits that
    certificates give.
    """
    below = ndtr(of.k) if of.dof is None else stdtr(of.dof, of.k)
    return round(2.0 * float(below) - 1.0, _DIGITS)


def _limits(given: tuple[float | None, float | None]) -> tuple[float, float]:
    lower, upper = given
    return (-math.inf if lower is None else lower, math.inf if upper is None else upper)


def _budget(sources: tuple[SourceEntry, ...]) -> Budget | None:
    """Return the budget, the largest source first; None without any."""
    if not sources:
        return None
    lines = [
        BudgetLine(
            source=one.source, type=one.type, standard=one.u, degrees=one.dof, share=one.share
        )
        for one in sources
    ]
    return Budget(
        of="lengths of all features, root mean square",
        unit="mm",
        lines=tuple(sorted(lines, key=lambda line: -line.share)),
    )
