"""The page of promises names tests that are there."""

import re
from pathlib import Path

TESTS = Path(__file__).parent


def test_every_promise_has_its_tests(tests: dict[str, bool]) -> None:
    """Each row of the page's tables names one test or more, all are in this folder, and the long ones are marked."""
    page = (TESTS.parent / "docs" / "trust.md").read_text(encoding="utf-8")
    rows = [row for row in page.splitlines() if row.startswith("| ") and not row.startswith("| promise")]
    named = [re.findall(r"`(test_\w+)`", row) for row in rows]

    assert len(rows) > 10 and all(named)
    assert {name for names in named for name in names} - tests.keys() == set()
    for name, is_long in re.findall(r"`(test_\w+)`( \(long\))?", page):
        assert tests[name] == bool(is_long), name
