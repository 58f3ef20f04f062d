"""What a page reports on."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

from pincal.calibration.calibration import Calibration
from pincal.calibration.result import Result
from pincal.discover.run import Discovery
from pincal.report.row_errors import RowErrors, evidence_of


@dataclass(frozen=True)
class Subject:
    """What a page reports on.

    Attributes:
        calibration: the calibration.
        provenance: versions, command, inputs with hashes.
        notes: what the exported URDF does not carry.
        discovery: what was found missing, if it was looked for.
        view: name of the file beside the report that holds the view in three dimensions, if there is one.
    """

    calibration: Calibration
    provenance: dict[str, Any]
    notes: tuple[str, ...] = ()
    discovery: Discovery | None = None
    view: str | None = None

    @property
    def result(self) -> Result:
        """The figures of the calibration."""
        return self.calibration.result

    @cached_property
    def readings(self) -> tuple[RowErrors, ...]:
        """Errors row by row, one for each kind of reading, positions first."""
        return evidence_of(self.calibration)

    @property
    def part(self) -> Literal["test", "train"]:
        """The rows whose errors are quoted first: held-out ones if there are any."""
        return "test" if "test" in self.result.error["calibrated"] else "train"
