"""What a certificate says, whatever it is written as."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import date
from typing import Literal

from pincal.errors import BadInputError
from pincal.features.budget import distribution_of
from pincal.identity import Identity

NOT_STATED = "not stated"
"""Stands where the user has stated nothing: a certificate leaves no gap unmarked."""


@dataclass(frozen=True)
class StatedUncertainty:
    """An expanded uncertainty.

    Attributes:
        value: U, in the unit of its figure.
        factor: coverage factor k.
        probability: that U covers, 0 to 1.
    """

    value: float
    factor: float
    probability: float


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A number with its unit and, where it is known, its uncertainty.

    Attributes:
        name: what it is, in words.
        value: the number, as it stands in the file that it was taken from.
        unit: its unit: "mm", "mrad", "deg" and so on; empty for a plain number.
        expanded: its expanded uncertainty.
        interval: ends of the interval of 95 %, in the unit; None for an end that is not known.
        nominal: what it should be, in the unit.
        limits: least and largest permissible value, in the unit; infinite for none.
        decision: whether it conforms to the limits.

    Raises:
        BadInputError: for a number that is not finite.
    """

    name: str
    value: float
    unit: str
    expanded: StatedUncertainty | None = None
    interval: tuple[float | None, float | None] | None = None
    nominal: float | None = None
    limits: tuple[float, float] | None = None
    decision: Literal["conforms", "does not conform", "undecided"] | None = None

    def __post_init__(self) -> None:
        ends = self.interval or ()
        stated = () if self.expanded is None else (self.expanded.value, self.expanded.factor)
        for value in (self.value, self.nominal, *stated, *ends):
            if value is not None and not math.isfinite(value):
                raise BadInputError(
                    f"{self.name}: {value}; a certificate states finite numbers only: repeat the "
                    "command that wrote the file"
                )


@dataclass(frozen=True, kw_only=True)
class FigureGroup:
    """Figures that belong together.

    Attributes:
        title: what they are of.
        figures: the figures.
        remark: how they are to be read; may be empty.
    """

    title: str
    figures: tuple[Figure, ...]
    remark: str = ""


@dataclass(frozen=True, kw_only=True)
class BudgetLine:
    """A source of uncertainty.

    Attributes:
        source: its name.
        type: "A", by statistics of readings, or "B", by other knowledge; empty if not known.
        standard: standard uncertainty, in the unit of the budget.
        degrees: degrees of freedom; None where they are not known.
        share: of the variance, 0 to 1.
    """

    source: str
    type: str
    standard: float
    degrees: float | None
    share: float

    @property
    def distribution(self) -> str:
        """The distribution by which the standard uncertainty is expanded, "normal" or "t"."""
        return distribution_of(self.degrees)


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Where an uncertainty comes from.

    Attributes:
        of: the uncertainty, in words.
        unit: of all lines.
        lines: the sources, the largest first.
    """

    of: str
    unit: str
    lines: tuple[BudgetLine, ...]


@dataclass(frozen=True, kw_only=True)
class Range:
    """Values for which a certificate is valid.

    Attributes:
        name: of a joint, or a condition.
        lower: the least.
        upper: the largest.
        unit: of both.
    """

    name: str
    lower: float
    upper: float
    unit: str


@dataclass(frozen=True, kw_only=True)
class Issue:
    """What belongs to a certificate and not to what was measured.

    Attributes:
        number: of the certificate; empty for one made of the checksum of its first file.
        day: on which it is issued.
        usual: who issues it, and for whom, where nothing else is stated.
    """

    number: str
    day: date
    usual: Identity = field(default_factory=Identity)


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """All that a certificate says.

    Attributes:
        title: of the document.
        issue: number and day.
        item: what was calibrated or measured.
        identity: what was stated of robot, instrument and circumstances.
        ranges: joint positions and conditions for which it is valid.
        facts: further entries of the scope and of the method, by their names.
        verdict: of the model; empty if there is none.
        doubts: reservations, in full.
        groups: the results.
        budget: where the uncertainty comes from; None where that is not known.
        rule: how it is decided whether figures conform; empty if nothing is decided.
        lengths: what gives the unit of length where no instrument measured; empty otherwise.
        files: SHA-256 by name of the files that it was made of, the first one that it certifies.
        versions: of the software, by what was done with it.
    """

    title: str
    issue: Issue
    item: str
    identity: Identity
    ranges: tuple[Range, ...] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
    verdict: str = ""
    doubts: tuple[str, ...] = ()
    groups: tuple[FigureGroup, ...]
    budget: Budget | None = None
    rule: str = ""
    lengths: str = ""
    files: Mapping[str, str]
    versions: Mapping[str, str]

    @property
    def number(self) -> str:
        """Number of the certificate."""
        first = next(iter(self.files.values()))
        return self.issue.number or f"pincal-{first[:16]}"

    @property
    def traceability(self) -> str:
        """What is known of the chain of calibrations to the unit of length."""
        instrument = self.identity.instrument or NOT_STATED
        certificate = self.identity.certificate or NOT_STATED
        source = (
            f"Lengths and angles are those of the instrument: {instrument}; its calibration "
            f"certificate: {certificate}."
        )
        scale = "the instrument's scale is included only where the budget lists it"
        if self.lengths:
            source = (
                f"No instrument measured the robot's lengths: they are those of {self.lengths}."
            )
            scale = "these lengths is included only as far as their uncertainty is stated"
        return (
            f"{source} These entries are as the user stated them and were not "
            "verified. The software is no link of a chain of calibrations and is not accredited; "
            f"an error of {scale}."
        )

    @property
    def lacking(self) -> tuple[str, ...]:
        """Keys of entries that a certificate needs and the user has not stated."""
        needed = ("robot", "instrument", "certificate", "operator", "date", "place", "laboratory",
                  "country", "customer")  # fmt: skip
        return tuple(key for key in needed if not getattr(self.identity, key))


def checksums_of_inputs(provenance: Mapping[str, object]) -> dict[str, str]:
    """Return the checksums of the files that results were made of, by name.

    Users may write a provenance of their own; what is no text there is no checksum.
    """
    inputs = provenance.get("inputs")
    if not isinstance(inputs, Mapping):
        return {}
    return {str(name): value for name, value in inputs.items() if isinstance(value, str)}
