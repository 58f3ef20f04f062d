"""The page of promises, and the pages of guarantees behind it, name tests that are there."""

import ast
import re
from pathlib import Path

import numpy as np
import pytest
from rates import interval, noticed, percent, power
from test_discovery_rates import CI
from trees import parsed

TESTS = Path(__file__).parent
DOCS = TESTS.parent / "docs"
PROMISES = (DOCS / "trust.md").read_text(encoding="utf-8")
PAGES = {path.name: path.read_text(encoding="utf-8") for path in [DOCS / "trust.md", *(DOCS / "guarantees").glob("*.md")]}


@pytest.mark.parametrize("page", PAGES.values(), ids=PAGES)
def test_every_promise_has_its_tests(page: str, tests: dict[str, bool]) -> None:
    """Each row of a page's tables names one test or more, all are in this folder, and the long ones are marked."""
    rows = [row for row in page.splitlines() if row.startswith("| ") and not row.startswith(("| guarantee", "| | promise"))]
    named = [re.findall(r"`(test_\w+)`", row) for row in rows]

    assert len(rows) > 5 and all(named)
    assert {name for names in named for name in names} - tests.keys() == set()
    for name, is_long in re.findall(r"`(test_\w+)`( \(long\))?", page):
        assert tests[name] == bool(is_long), name


def test_the_page_of_promises_has_fifteen_and_a_page_behind_each() -> None:
    """Promises are numbered, and the page that each row links has the row's test, too."""
    rows = re.findall(r"^\| (\d+) \|.*`(test_\w+)`.*\]\(guarantees/([\w-]+\.md)\)", PROMISES, re.MULTILINE)

    assert [int(number) for number, *_ in rows] == [*range(1, 16)]
    for _, test, behind in rows:
        assert test in PAGES[behind], f"{behind}: {test}"


def test_no_change_leaves_out_a_test_that_holds_a_promise() -> None:
    """Such a test names no rooms, and is not of the products that only ``.ci/run --all`` runs."""
    promised = set(re.findall(r"`(test_\w+)`", "".join(PAGES.values())))
    for file in TESTS.glob("test_*.py"):
        for test in parsed(file.read_text(encoding="utf-8")).body:
            if isinstance(test, ast.FunctionDef) and test.name in promised:
                marks = " ".join(map(ast.unparse, test.decorator_list))
                assert not re.search("ROOMS|[.]rooms|[.]products", marks), f"{file.name}: {test.name}"


def test_the_page_says_what_tests_of_rates_notice() -> None:
    """Each test's tables, the chance that it notices twice the rate, and from which rate on it does with nine in ten."""
    page = PAGES["effects.md"]
    for claim, rate, n, test in CI:
        seen = f"{percent(power(rate, n))} | {percent(noticed(rate, n))}"

        assert f"| {claim}: at most {percent(rate)} | {n} | {seen} | `{test}` (long) |" in page


def test_rates_stand_with_their_exact_intervals() -> None:
    """An interval that follows a count on a page, such as "3 of 300, 0.2 to 2.9 %", is that of Clopper and Pearson."""
    pages = [TESTS.parent / "README.md", *(TESTS.parent / "docs").rglob("*.md")]
    found = [
        match
        for page in pages
        for match in re.finditer(r"(\d+) of (\d+)[^;.()|]*?, ([\d.]+) to ([\d.]+) %", page.read_text(encoding="utf-8"))
    ]

    assert len(found) >= 4
    for match in found:
        hits, n, *written = match.groups()
        exact = 100.0 * np.array(interval(int(hits), int(n)))
        assert [f"{x:.{len(text.partition('.')[2])}f}" for x, text in zip(exact, written, strict=True)] == written, match[0]
