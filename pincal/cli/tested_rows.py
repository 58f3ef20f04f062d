"""Tests of new rows beside their errors, for ``validate``; satellites hand them in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pincal.errors import Exit

if TYPE_CHECKING:
    from pincal.calibration.validation import Validation

ACCEPTANCE = "Acceptance"
"""Heading of the options of acceptance tests."""


@dataclass(frozen=True, kw_only=True)
class TestedRows:
    """A test that rows may be; here there is none."""

    @property
    def is_wanted(self) -> bool:
        """Whether the rows are such a test.

        Raises:
            click.UsageError: for options that contradict each other.
        """
        return False

    def judge(self, found: Sequence[Validation], *, as_json: bool, quiet: bool) -> Exit:
        """Judge rows by it, and print the outcome."""
        raise NotImplementedError
