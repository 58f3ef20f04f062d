"""From the quantities of a part to the entries of ``measured.json``: budgets, decisions,
repeatability.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pincal.features.budget import BudgetEntry, UncertaintyBudget, distribution_of
from pincal.features.decision import DecisionRule
from pincal.features.decision_numbers import DECISION
from pincal.features.fitted_part import FittedPart
from pincal.features.gauge_study import TypeOneStudy
from pincal.features.measured_file import (
    DatumEntry,
    FeatureEntry,
    MeasuredFile,
    QuantityCovariance,
    RepeatEntry,
    SourceEntry,
    ValueEntry,
    finite,
)
from pincal.features.part_feature import UNIT_OF, PartFeature
from pincal.features.part_values import PartValue, PartValues
from pincal.thresholds import Scale
from pincal.units import SIZES

# Of a two-sided interval of 95 %.
_UPPER: Scale = 0.975
# Units of the file by quantity; lengths are in mm, components of a direction have none.
_SHOWN = {"m": "mm", "rad": "mrad"}
_SHOWN_OF = {"angle": "deg"}


def shown_unit(quantity: str) -> str:
    """Return the unit of a quantity in files and tables."""
    return _SHOWN_OF.get(quantity) or _SHOWN.get(UNIT_OF.get(quantity, ""), "")


def size_of_shown(quantity: str) -> float:
    """Return the size of that unit in SI units."""
    unit = shown_unit(quantity)
    return SIZES[unit] if unit else 1.0


@dataclass(frozen=True, eq=False)
class PartResult:
    """What was measured of a part, from which the entries of its file follow.

    Attributes:
        features: fitted to the points of all passes.
        values: the quantities.
        passes: the quantities of each pass, where there are several.
        frame: in which the datum was found.
        rule: by which tolerances are decided.
    """

    features: FittedPart
    values: PartValues
    passes: Sequence[PartValues]
    frame: str
    rule: DecisionRule

    @cached_property
    def by_source(self) -> Mapping[str, np.ndarray]:
        """The covariance of the quantities by each source, shape (Q, Q), in SI units."""
        covariance = self.features.points.covariance
        return dict(covariance.contributions(self.values.sensitivity))

    @cached_property
    def sizes(self) -> np.ndarray:
        """Units of the quantities in SI units, shape (Q,)."""
        return np.array([size_of_shown(value.quantity) for value in self.values.values])

    def file(self) -> MeasuredFile:
        """Return the result as files have it."""
        return MeasuredFile(
            features=tuple(self._features()),
            covariance=self._covariance(),
            budget=self._budget(),
            datum=self._datum(),
            rule=self.rule.words,
        )

    def _features(self) -> Iterator[FeatureEntry]:
        """Yield the features that have quantities."""
        part = self.features.part
        for name, feature in part.features.items():
            rows = [i for i, of in enumerate(self.values.values) if of.feature == name]
            if rows:
                yield self._feature(feature, rows)

    def _feature(self, feature: PartFeature, rows: list[int]) -> FeatureEntry:
        points = self.features.points
        names = feature.of if feature.is_derived else (feature.name,)
        mine = np.flatnonzero(np.isin(points.feature, names))
        stops = frozenset().union(*(points.stops[i] for i in mine))
        fit = self.features.fitted.fits.get(feature.name)
        has_form = fit is not None and fit.kind != "point" and fit.dof > 0
        return FeatureEntry(
            name=feature.name,
            kind=feature.kind,
            values={self.values.values[i].quantity: self._value(i) for i in rows},
            form_mm=1e3 * fit.form_error if fit is not None and has_form else None,
            readings=int(points.readings[mine].sum()),
            stops=len(stops),
            repeatability=tuple(self._repeats(rows)),
        )

    def _value(self, i: int) -> ValueEntry:
        """Return the i-th quantity in its unit."""
        of = self.values.values[i]
        size = float(self.sizes[i])
        budget = self._budget_of(i)
        limits = of.limits
        decided = None
        if limits is not None:
            decided = self.rule.decide(of.value, budget.u, limits, budget.dof)
        return ValueEntry(
            value=of.value / size,
            unit=shown_unit(of.quantity),
            u=budget.u / size,
            U=budget.U / size,
            k=budget.k,
            dof=finite(budget.dof),
            nominal=None if of.nominal is None else of.nominal / size,
            deviation=None if of.deviation is None else of.deviation / size,
            limits=None if limits is None else (_in(limits.lower, size), _in(limits.upper, size)),
            decision=None if decided is None else decided.verdict,
            risk=None if decided is None else decided.risk,
            by_source={entry.source: entry.u / size for entry in budget.entries},
        )

    def _budget_of(self, i: int) -> UncertaintyBudget:
        """Return the budget of the i-th quantity, in SI units."""
        evidence = self.features.points.evidence
        entries = []
        for name, C in self.by_source.items():
            u = float(np.sqrt(max(C[i, i], 0.0)))
            entries.append(BudgetEntry(name, evidence[name].kind, u, evidence[name].dof))
        return UncertaintyBudget(tuple(entries), self.rule.coverage)

    def _repeats(self, rows: list[int]) -> Iterator[RepeatEntry]:
        """Yield how well the quantities of a feature were repeated."""
        for i in rows:
            of = self.values.values[i]
            found = [one.value for each in self.passes for one in each.values if _is_same(one, of)]
            if len(found) > 1:
                yield repeat_entry(of, np.array(found))

    def _covariance(self) -> QuantityCovariance:
        total = sum(self.by_source.values()) / np.outer(self.sizes, self.sizes)
        names = tuple(f"{of.feature}.{of.quantity}" for of in self.values.values)
        return QuantityCovariance(names, tuple(tuple(row) for row in total.tolist()))

    def _budget(self) -> tuple[SourceEntry, ...]:
        """Return the sources, root mean square over all lengths."""
        lengths = np.array([UNIT_OF.get(of.quantity) == "m" for of in self.values.values], bool)
        squares = {name: float(np.mean(np.diag(C)[lengths])) for name, C in self.by_source.items()}
        total = sum(squares.values())
        evidence = self.features.points.evidence
        entries = [
            SourceEntry(
                source=name,
                type=evidence[name].kind,
                u=1e3 * float(np.sqrt(square)),
                dof=finite(evidence[name].dof),
                share=square / total if total else 0.0,
                distribution=distribution_of(evidence[name].dof),
            )
            for name, square in squares.items()
        ]
        return tuple(sorted(entries, key=lambda entry: -entry.share))

    def _datum(self) -> DatumEntry:
        datum = self.features.part.datum
        frame = self.values.frame
        x, y, z = (1e3 * frame.origin).tolist()
        return DatumEntry(
            kind=datum.kind,
            features=datum.features,
            frame=self.frame,
            position_mm=(x, y, z),
            rotation=tuple(tuple(row) for row in frame.rotation.tolist()),
        )


def _in(limit: float, size: float) -> float | None:
    found = finite(limit)
    return None if found is None else found / size


def _is_same(one: PartValue, other: PartValue) -> bool:
    return (one.feature, one.quantity) == (other.feature, other.quantity)


def repeat_entry(of: PartValue, values: np.ndarray) -> RepeatEntry:
    """Return how well a quantity was repeated, from its values in several passes, shape (P,)."""
    from scipy.stats import chi2

    size = size_of_shown(of.quantity)
    dof = len(values) - 1
    s = float(np.std(values, ddof=1)) / size
    low, high = np.sqrt(dof / chi2.ppf([_UPPER, 1.0 - _UPPER], dof))
    study = _type_one(of, values)
    return RepeatEntry(
        quantity=of.quantity,
        unit=shown_unit(of.quantity),
        passes=len(values),
        s=s,
        s_interval=(float(s * low), float(s * high)),
        cg=None if study is None else finite(study.cg),
        cgk=None if study is None or study.cgk is None else finite(study.cgk),
    )


def _type_one(of: PartValue, values: np.ndarray) -> TypeOneStudy | None:
    """Return the study of a quantity with two limits and enough passes; None for another."""
    limits = of.limits
    if limits is None or len(values) < DECISION.least_repeats:
        return None
    tolerance = limits.upper - limits.lower
    return TypeOneStudy(values, of.nominal, tolerance) if np.isfinite(tolerance) else None
