"""The page of promises names tests that are there."""

import ast
import re
from pathlib import Path

TESTS = Path(__file__).parent


def test_every_promise_has_its_tests() -> None:
    """Each row of the page's tables names one test or more, all are in this folder, and the long ones are marked."""
    page = (TESTS.parent / "docs" / "trust.md").read_text(encoding="utf-8")
    known = {
        test.name: any(ast.unparse(mark) == "pytest.mark.long" for mark in test.decorator_list)
        for file in TESTS.glob("test_*.py")
        for test in ast.parse(file.read_text(encoding="utf-8")).body
        if isinstance(test, ast.FunctionDef)
    }
    rows = [row for row in page.splitlines() if row.startswith("| ") and not row.startswith("| promise")]
    named = [re.findall(r"`(test_\w+)`", row) for row in rows]

    assert len(rows) > 10 and all(named)
    assert {name for names in named for name in names} - known.keys() == set()
    for name, is_long in re.findall(r"`(test_\w+)`( \(long\))?", page):
        assert known[name] == bool(is_long), name
