"""The figures of a calibration, or of a result of a satellite, for notebooks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

from pincal.calibration.calibration import Calibration
from pincal.calibration.result_tables import parameter_rows
from pincal.report.illustrations import Drawing, correction_drawings, error_drawings
from pincal.report.subject import evidence_of
from pincal.satellites import Place

# How to draw results of satellites, by the names of their types.
_FURTHER: Place[Callable[[Any], Iterable[Drawing]]] = Place("drawings")


def drawings(of: Any) -> tuple[Drawing, ...]:
    """Return the figures of a calibration or a discovery, as in the report.

    Args:
        of: the calibration, whose errors and corrections are drawn, or the discovery, whose steps
            are drawn.

    Returns:
        Figure of Matplotlib, title and caption of each.

    Raises:
        TypeError: if there are no figures of such a result.
    """
    if isinstance(of, Calibration):
        return tuple(_of_calibration(of))
    kind = type(of).__name__
    if kind not in _FURTHER:
        known = ", ".join(("Calibration", *_FURTHER.names()))
        raise TypeError(f"drawings: there are no figures of a {kind}; expected one of: {known}")
    return tuple(_FURTHER[kind](of))


def _of_calibration(of: Calibration) -> Iterator[Drawing]:
    yield from error_drawings(evidence_of(of))
    yield from correction_drawings(parameter_rows(of.fit.fit))
