"""Repeatability and reproducibility of what was measured of a part, from passes of several
appraisers, which may be operators, days or robots.

The features of a kind are the parts of the analysis: what varies between them is their deviation
from nominal.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pincal.features.gauge_study import GaugeStudy
from pincal.features.measured_entries import shown_unit, size_of_shown
from pincal.features.measured_file import GaugeEntry
from pincal.features.part_feature import QUANTITIES
from pincal.features.part_values import PartValue, PartValues
from pincal.thresholds import Count, Scale

# Of parts, appraisers and passes, below which there is no analysis of variance.
_FEWEST: Count = 2
_ROUNDING: Scale = 1e-9
# Categories beyond which any number can be told apart.
_ANY: Count = 10**6


class PassOf(NamedTuple):
    """The quantities of one pass.

    Attributes:
        appraiser: who measured.
        values: the quantities.
    """

    appraiser: str
    values: PartValues


def gauge_entries(passes: Sequence[PassOf], kinds: Mapping[str, str]) -> Iterator[GaugeEntry]:
    """Yield the analysis of each quantity that two features or more of a kind have, in passes of
    two appraisers or more.

    Args:
        passes: of all appraisers; of more passes of some than of others, the first ones count.
        kinds: of the features by name.
    """
    found = dict[tuple[str, str], dict[str, dict[str, list[PartValue]]]]()
    for one in passes:
        for value in one.values.values:
            kind = kinds[value.feature]
            if value.quantity in QUANTITIES[kind]:
                of_kind = found.setdefault((kind, value.quantity), {})
                cells = of_kind.setdefault(value.feature, {})
                cells.setdefault(one.appraiser, []).append(value)
    appraisers = list(dict.fromkeys(one.appraiser for one in passes))
    for (kind, quantity), by_feature in found.items():
        whole = [cells for cells in by_feature.values() if len(cells) == len(appraisers)]
        if len(whole) < _FEWEST or len(appraisers) < _FEWEST:
            continue
        repeats = min(len(values) for cells in whole for values in cells.values())
        if repeats >= _FEWEST:
            table = [[cells[who][:repeats] for who in appraisers] for cells in whole]
            yield _entry(kind, quantity, table)


def _entry(kind: str, quantity: str, table: list[list[list[PartValue]]]) -> GaugeEntry:
    """Return the analysis of a table of parts, appraisers and passes."""
    size = size_of_shown(quantity)
    readings = np.array(
        [[[_deviation(value) / size for value in cell] for cell in row] for row in table]
    )
    study = GaugeStudy(readings)
    parts, appraisers, repeats = readings.shape
    low, high = study.gauge_interval()
    width = _tolerance([row[0][0] for row in table])
    return GaugeEntry(
        quantity=quantity,
        kind=kind,
        unit=shown_unit(quantity),
        parts=parts,
        appraisers=appraisers,
        repeats=repeats,
        ev=study.repeatability,
        av=study.reproducibility,
        grr=study.gauge,
        grr_interval=(low, high),
        pv=study.between_parts,
        share=study.share,
        ndc=study.categories if study.categories < _ANY else None,
        of_tolerance=None if width is None else study.of_tolerance(width / size),
    )


def _deviation(value: PartValue) -> float:
    return value.value if value.deviation is None else value.deviation


def _tolerance(values: Sequence[PartValue]) -> float | None:
    """Return the width of the tolerance that all features have, None where there is no such."""
    widths = [
        np.inf if value.limits is None else value.limits.upper - value.limits.lower
        for value in values
    ]
    is_one = np.ptp(widths) <= _ROUNDING * max(widths) if np.all(np.isfinite(widths)) else False
    return float(widths[0]) if is_one and widths[0] > 0.0 else None
