"""What a search writes and prints."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pincal.cli.fit_output import FitOutput
from pincal.discover.report.search_answer import SearchAnswer
from pincal.discover.run import Discovery

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class SearchOutput(FitOutput):
    """A discovery as a verb writes and prints it.

    Attributes:
        run: the search, with the calibration in which it ended.
    """

    run: Discovery

    @classmethod
    def of(cls, discovery: Discovery) -> SearchOutput:
        """Return the output of a search."""
        return cls(discovery.calibration, discovery)

    @property
    def discovery(self) -> Discovery:
        """The search, of the calibration as it is written."""
        return replace(self.run, calibration=self.calibration)

    @property
    def search(self) -> SearchAnswer:
        """What the search says of its calibration."""
        return SearchAnswer(self.discovery)

    def to_dict(self) -> dict[str, Any]:
        """Return the findings."""
        return self.discovery.report

    def write(self, folder: Path) -> None:
        """Write ``discovery.json``."""
        from pincal.io.strict_json import write_json

        write_json(folder / "discovery.json", self.discovery.report)

    def found(self) -> tuple[str, ...]:
        """Return all effects that were found, in full, without the evidence, and counted."""
        from pincal.discover.cli.search_screen import summary_of_search

        return summary_of_search(self.discovery)

    def print_all(self, out: Console) -> None:
        """Print the search step by step, and the notes on its calibration."""
        from pincal.cli.screen import print_notes
        from pincal.discover.cli.search_screen import print_discovery

        print_discovery(self.discovery, out)
        print_notes(self.calibration.result.warnings, out)
