"""The script of docs/comparison.md runs, as far as the programs are installed, and the page shows what it prints."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from test_examples import ROOT

SCRIPT = ROOT / "docs" / "compare.py"


def table_rows(text: str) -> list[list[str]]:
    """Return the cells of the lines of what the script prints, which stand two or more blanks apart or in a column."""
    return [line.split() for line in text.splitlines() if re.match(r"[a-z]+ +\d+ ", line)]


@pytest.mark.long
def test_the_comparison_runs_with_what_is_installed(tmp_path: Path) -> None:
    """The adaptor of pincal finds all 27 parameters, and predicts far below the noise; nothing is installed for it."""
    command = [sys.executable, str(SCRIPT), "--tools", "pincal", "--poses", "100", "--keep", str(tmp_path / "kept")]
    done = subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True, timeout=600)
    header, *lines = done.stdout.splitlines()
    ((tool, poses, parameters, seconds, ratio, held_out),) = table_rows(done.stdout)

    assert re.split(r"  +", header) == ["tool", "poses", "parameters", "seconds", "ratio", "held out [um]"]
    assert len(lines) == 1 and (tool, poses, parameters, ratio) == ("pincal", "100", "27", "1")
    assert 0.0 < float(seconds) < 10.0
    # sqrt(27 / 300) of the noise of a position, 87 um, is 26 um; of the poses drawn, a few more.
    assert 15.0 < float(held_out) < 40.0
    assert not list(tmp_path.iterdir())


def test_the_page_has_the_table_of_the_script() -> None:
    """Every program that the script knows has its adaptor, and its rows on the page, with pincal's as the unit."""
    page = (ROOT / "docs" / "comparison.md").read_text(encoding="utf-8")
    rows = table_rows(page.split("python docs/compare.py")[1])
    tools = {path.stem.removeprefix("run_") for path in (ROOT / "docs" / "peers").glob("run_*.py")}

    assert {row[0] for row in rows} == tools and all(f'"{tool}"' in SCRIPT.read_text(encoding="utf-8") for tool in tools)
    for poses in ("100", "1000"):
        own = next(float(row[3]) for row in rows if row[:2] == ["pincal", poses])
        for row in rows:
            if row[1] == poses:
                assert float(row[4]) == pytest.approx(float(row[3]) / own, rel=0.05, abs=0.51), row
