"""The structure behind ``measured.json``, the table, the report and the terminal: what a robot
measured of a part.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

import msgspec
import numpy as np

from pincal.features.decision import ConformityVerdict, overall_verdict
from pincal.identity import Identity
from pincal.io.strict_json import Fault
from pincal.notes import Note
from pincal.thresholds import Scale

# Expanded uncertainty that is rounding of what the datum holds [unit of the value].
_ROUNDING: Scale = 1e-9


class ValueEntry(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A quantity of a feature, all of it in its unit.

    Attributes:
        value: in the datum.
        unit: "mm", "mrad", "deg" or "" for a component of a direction.
        u: standard uncertainty.
        U: expanded uncertainty.
        k: coverage factor, for the coverage that the rule states.
        dof: effective degrees of freedom; null for infinite ones.
        nominal: as the part's file says.
        deviation: value minus nominal.
        limits: least and largest permissible value; null for none.
        decision: by the rule, where there are limits.
        risk: probability that the decision is wrong.
        by_source: standard uncertainty by each source.
    """

    value: float
    unit: str
    u: float
    U: float
    k: float
    dof: float | None
    nominal: float | None = None
    deviation: float | None = None
    limits: tuple[float | None, float | None] | None = None
    decision: ConformityVerdict | None = None
    risk: float | None = None
    by_source: dict[str, float] = {}

    @property
    def is_held(self) -> bool:
        """Whether the datum has it by definition: it was not measured, and has no uncertainty."""
        return self.U <= _ROUNDING

    def __post_init__(self) -> None:
        for name in ("u", "U", "k"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise Fault(f"is {getattr(self, name)}", "a number of 0 or more", key=f".{name}")
        lower, upper = self.limits or (None, None)
        if lower is not None and upper is not None and lower > upper:
            raise Fault(f"are {lower} and {upper}", "the least one first", key=".limits")


class RepeatEntry(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A quantity of a feature over several passes.

    Attributes:
        quantity: its name.
        unit: of what follows.
        passes: number of passes.
        s: standard deviation of one pass.
        s_interval: 95 % interval of it.
        cg: capability of the repetition, against the tolerance (type 1); null without limits.
        cgk: the same with the bias from the nominal; null without a nominal.
    """

    quantity: str
    unit: str
    passes: int
    s: float
    s_interval: tuple[float, float]
    cg: float | None = None
    cgk: float | None = None


class GaugeEntry(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Repeatability and reproducibility of a quantity, by analysis of variance over features
    (parts), appraisers (operators, days or robots) and passes; standard deviations in its unit.

    Attributes:
        quantity: its name.
        kind: of the features.
        unit: of what follows.
        parts: number of features.
        appraisers: number of them.
        repeats: passes of each.
        ev: repeatability, of passes of one appraiser.
        av: reproducibility, between appraisers, with their interaction with features.
        grr: both together.
        grr_interval: 95.45 % interval of it.
        pv: between features, of their deviations from nominal.
        share: grr relative to the total standard deviation.
        ndc: number of distinct categories; null for any number.
        of_tolerance: six times grr relative to the width of the tolerance; null where features have
            several widths or none.
    """

    quantity: str
    kind: str
    unit: str
    parts: int
    appraisers: int
    repeats: int
    ev: float
    av: float
    grr: float
    grr_interval: tuple[float, float]
    pv: float
    share: float
    ndc: int | None = None
    of_tolerance: float | None = None


class FeatureEntry(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A feature that was measured.

    Attributes:
        name: as in the part's file.
        kind: "point", "line", "plane", "circle", "sphere", "cylinder", "distance" or "angle".
        values: its quantities by name.
        form_mm: peak-to-valley deviation of its points from the fitted feature [mm].
        readings: number of readings.
        stops: number of stops of the robot.
        repeatability: over passes, where there were several.
    """

    name: str
    kind: str
    values: dict[str, ValueEntry]
    form_mm: float | None = None
    readings: int
    stops: int
    repeatability: tuple[RepeatEntry, ...] = ()


class SourceEntry(msgspec.Struct, frozen=True, kw_only=True):
    """A source of the uncertainty, over all lengths of all features, root mean square.

    Attributes:
        source: its name.
        type: "A" by statistics, "B" by other means.
        u: standard uncertainty [mm].
        dof: degrees of freedom; null for infinite ones.
        share: of the variance.
        distribution: by which u is expanded; not in files of earlier versions.
    """

    source: str
    type: Literal["A", "B"]
    u: float
    dof: float | None
    share: float
    distribution: Literal["normal", "t"] | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.u < np.inf:
            raise Fault(f"is {self.u}", "a number of 0 or more", key=".u")
        if not 0.0 <= self.share <= 1.0:
            raise Fault(f"is {self.share}", "a number from 0 to 1", key=".share")


class QuantityCovariance(msgspec.Struct, frozen=True):
    """The covariance of all quantities.

    Attributes:
        names: ``FEATURE.QUANTITY``.
        matrix: in the units of the quantities.
    """

    names: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        n = len(self.names)
        if len(self.matrix) != n or any(len(row) != n for row in self.matrix):
            raise Fault("is not of its names", f"{n} rows of {n} numbers", key=".matrix")


class DatumEntry(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The frame of all values.

    Attributes:
        kind: "calibrated", "best fit" or "3-2-1".
        features: that define it.
        frame: in which it was found: of the calibration's "instrument" or the robot's "base".
        position_mm: where its origin is in that frame [mm].
        rotation: the axes of the datum in that frame, as columns.
        residual_mm: root mean square deviation of the features that it was fitted to [mm].
    """

    kind: str
    features: tuple[str, ...]
    frame: str
    position_mm: tuple[float, float, float]
    rotation: tuple[tuple[float, float, float], ...]
    residual_mm: float | None = None


class MeasuredFile(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What was measured of a part.

    Attributes:
        features: in the order of the part's file.
        covariance: of all their quantities.
        budget: sources of uncertainty, the largest first.
        datum: the frame of all values.
        rule: by which it was decided.
        gauge: repeatability and reproducibility, where several appraisers measured repeatedly.
        warnings: doubts, those of the calibrated model among them, and notes.
        outside: which rows lie outside the range of the calibration, in words; "" for none.
        id: what is stated of robot, instrument and circumstances.
        provenance: version of pincal, time, input files with their SHA-256, command.
    """

    features: tuple[FeatureEntry, ...]
    covariance: QuantityCovariance
    budget: tuple[SourceEntry, ...]
    datum: DatumEntry
    rule: str
    gauge: tuple[GaugeEntry, ...] = ()
    warnings: tuple[Note, ...] = ()
    outside: str = ""
    id: Identity | None = None
    provenance: dict[str, Any] = {}

    @property
    def report(self) -> dict[str, Any]:
        """The result in JSON types."""
        found: dict[str, Any] = msgspec.to_builtins(self)
        return found

    @property
    def verdict(self) -> ConformityVerdict | None:
        """The verdict on the part by those on all its quantities; None without tolerances."""
        found = [value.decision for _, _, value in self.decided() if value.decision is not None]
        return overall_verdict(tuple(found)) if found else None

    def decided(self) -> Iterator[tuple[FeatureEntry, str, ValueEntry]]:
        """Yield each quantity with limits, with its feature and name."""
        for feature in self.features:
            for name, value in feature.values.items():
                if value.decision is not None:
                    yield feature, name, value

    def count(self, decision: ConformityVerdict) -> int:
        """Return the number of quantities with this decision."""
        return sum(value.decision == decision for _, _, value in self.decided())


def finite(number: float) -> float | None:
    """Return a number as files have it: null for an infinite one."""
    return float(number) if np.isfinite(number) else None
