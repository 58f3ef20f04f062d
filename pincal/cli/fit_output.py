"""What a verb that fits writes and prints."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from rich.console import Console

    from pincal.calibration.calibration import Calibration
    from pincal.calibration.result import Result
    from pincal.identity import Identity
    from pincal.report.judgement import SearchReport


@dataclass(frozen=True)
class FitOutput:
    """A calibration as a verb writes and prints it; verbs that find more than a calibration extend
    it.

    Attributes:
        calibration: the calibration.
    """

    calibration: Calibration

    @property
    def search(self) -> SearchReport | None:
        """What a search for missing effects says of it; None without one."""
        return None

    def with_result(self, result: Result) -> Self:
        """Return it with another result."""
        return replace(self, calibration=replace(self.calibration, result=result))

    def with_identity(self, identity: Identity) -> Self:
        """Return it with the identity that is stated of robot and result, if any."""
        if not identity:
            return self
        calibration = self.calibration
        result = replace(calibration.result, id=identity)
        fit = replace(calibration.fit, identity=identity)
        return replace(self, calibration=replace(calibration, fit=fit, result=result))

    def to_dict(self) -> dict[str, Any]:
        """Return what ``--json`` prints."""
        return self.calibration.result.to_dict()

    def write(self, folder: Path) -> None:
        """Write the files that a calibration does not have."""

    def found(self) -> tuple[str, ...]:
        """Return what was found, for the summary, in full and shorter; empty for a calibration."""
        return ()

    def print_all(self, out: Console) -> None:
        """Print everything that ``--verbose`` shows, but the notes on files."""
        from pincal.cli.screen import print_result

        print_result(self.calibration.result, out)
