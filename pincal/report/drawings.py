"""The figures of a calibration or a discovery, for notebooks."""

from __future__ import annotations

from collections.abc import Iterator

from pincal.calibration.calibration import Calibration
from pincal.calibration.result_tables import parameter_rows
from pincal.discover.run import Discovery
from pincal.report.illustrations import (
    Drawing,
    correction_drawings,
    discovery_drawings,
    error_drawings,
)
from pincal.report.subject import evidence_of


def drawings(of: Calibration | Discovery) -> tuple[Drawing, ...]:
    """Return the figures of a calibration or a discovery, as in the report.

    Args:
        of: the calibration, whose errors and corrections are drawn, or the discovery, whose steps
            are drawn.

    Returns:
        Figure of Matplotlib, title and caption of each.
    """
    if isinstance(of, Discovery):
        return tuple(discovery_drawings(of))
    return tuple(_of_calibration(of))


def _of_calibration(of: Calibration) -> Iterator[Drawing]:
    yield from error_drawings(evidence_of(of))
    yield from correction_drawings(parameter_rows(of.fit.fit))
