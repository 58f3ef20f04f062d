"""The certificate of a measured part: of the ``measured.json`` that ``pincal measure`` wrote."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec

from pincal.certificate.statement import (
    NOT_STATED,
    Budget,
    BudgetLine,
    Certificate,
    ConformityWord,
    Figure,
    FigureGroup,
    Issue,
)
from pincal.errors import BadInputError
from pincal.identity import Identity
from pincal.io.result_folder import file_hash
from pincal.io.strict_json import FileKind, read_json
from pincal.notes import Note, doubts_of

MEASURED = "measured.json"
_MEASURED_FILE = FileKind(
    "a measured.json",
    BadInputError,
    "run pincal measure again",
    whole="a file written by pincal measure",
)


class _Value(msgspec.Struct, frozen=True):
    """A quantity of a feature, in its unit.

    Attributes:
        value: measured.
        unit: of all that follows.
        U: expanded uncertainty.
        k: coverage factor of it.
        nominal: what it should be.
        limits: least and largest permissible value; null for none.
        decision: whether it conforms to these.
    """

    value: float
    unit: str
    U: float
    k: float
    nominal: float | None = None
    limits: tuple[float | None, float | None] | None = None
    decision: ConformityWord | None = None


class _Feature(msgspec.Struct, frozen=True):
    """A feature: its name and kind, its quantities by name, and the number of its readings."""

    name: str
    kind: str
    values: dict[str, _Value]
    form_mm: float | None = None
    readings: int | None = None


class _Source(msgspec.Struct, frozen=True):
    """A line of the budget [mm]."""

    source: str
    type: str
    u: float
    share: float
    dof: float | None = None


class _MeasuredFile(msgspec.Struct, frozen=True):
    """What a certificate takes of ``measured.json``; other keys are of no concern to it."""

    features: tuple[_Feature, ...]
    budget: tuple[_Source, ...]
    rule: str
    datum: Any = None
    id: Identity | None = None
    warnings: tuple[Note, ...] = ()
    provenance: dict[str, Any] = {}


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
    found = read_json(path, _MeasuredFile, _MEASURED_FILE)
    known = found.id or Identity()
    stated.require(known, str(path))
    identity = stated.over(known)
    return Certificate(
        title="Certificate of a measured part",
        issue=issue,
        item=identity.note.get("part", f"part {NOT_STATED}"),
        identity=identity,
        facts={"datum": _words(found.datum), **_decided(found.features)},
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
    table = path.with_name("measured.csv")
    own = {file.name: file_hash(file) for file in (path, table) if file.is_file()}
    inputs = provenance.get("inputs")
    return own | (dict(inputs) if isinstance(inputs, Mapping) else {})


def _words(datum: Any) -> str:
    """Return the datum in words: a text, or its kind, the features that define it and the frame
    that it was found in.
    """
    if not isinstance(datum, dict):
        return NOT_STATED if datum is None else str(datum)
    features = datum.get("features")
    words = [str(datum.get("kind", NOT_STATED))]
    words += [f"by {', '.join(map(str, features))}"] if features else []
    words += [f"in the frame of the {datum['frame']}"] if "frame" in datum else []
    return " ".join(words)


def _decided(features: tuple[_Feature, ...]) -> dict[str, str]:
    """Return how many features there are, and how many quantities conform to their limits."""
    counts = Counter(
        value.decision for of in features for value in of.values.values() if value.decision
    )
    found = {"features": str(len(features))}
    if counts:
        found["decisions"] = ", ".join(f"{decision}: {count}" for decision, count in counts.items())
    return found


def _group(feature: _Feature) -> FigureGroup:
    """Return the figures of a feature."""
    return FigureGroup(
        title=f"{feature.name} ({feature.kind})",
        figures=tuple(_figures(feature)),
        remark="" if feature.readings is None else f"{feature.readings} readings",
    )


def _figures(feature: _Feature) -> Iterator[Figure]:
    for name, of in feature.values.items():
        yield Figure(
            name=name,
            value=of.value,
            unit=of.unit,
            expanded=of.U,
            coverage=of.k,
            nominal=of.nominal,
            limits=None if of.limits is None else _limits(of.limits),
            decision=of.decision,
        )
    if feature.form_mm is not None:
        yield Figure(name="form", value=feature.form_mm, unit="mm")


def _limits(given: tuple[float | None, float | None]) -> tuple[float, float]:
    lower, upper = given
    return (-math.inf if lower is None else lower, math.inf if upper is None else upper)


def _budget(sources: tuple[_Source, ...]) -> Budget | None:
    """Return the budget, the largest source first; None without any."""
    if not sources:
        return None
    lines = (
        BudgetLine(
            source=one.source, type=one.type, standard=one.u, degrees=one.dof, share=one.share
        )
        for one in sources
    )
    return Budget(
        of="features, root mean square",
        unit="mm",
        lines=tuple(sorted(lines, key=lambda x: -x.share)),
    )
