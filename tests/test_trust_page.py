"""The page of promises names tests that are there."""

import re
from pathlib import Path

TESTS = Path(__file__).parent


def test_every_promise_has_its_tests() -> None:
    """Each row of the page's tables names one test or more, and all of them are in this folder."""
    page = (TESTS.parent / "docs" / "trust.md").read_text(encoding="utf-8")
    known = {
        name for file in TESTS.glob("test_*.py") for name in re.findall(r"^def (test_\w+)", file.read_text("utf-8"), re.M)
    }
    rows = [row for row in page.splitlines() if row.startswith("| ") and not row.startswith("| promise")]
    named = [re.findall(r"`(test_\w+)`", row) for row in rows]

    assert len(rows) > 10 and all(named)
    assert {name for names in named for name in names} - known == set()
