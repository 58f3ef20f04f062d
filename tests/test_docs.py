"""The pages: some are made from the program, links lead somewhere, and the site builds without a warning."""

from __future__ import annotations

import csv
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import benchmark_history as history
import click
import nbformat
import pages
import pytest
import transcripts
from nbclient import NotebookClient

from pincal.cli import pincal
from pincal.io.entries import EFFECTS

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])


def is_played(page: Path) -> bool:
    """Return whether any block of a page is run."""
    return any(block.is_played for block in transcripts.blocks(page.read_text(encoding="utf-8")))


def anchors_of(page: Path) -> set[str]:
    """Return what a link into a page may name: its headings, as GitHub and the site write them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def links_of(page: Path) -> Iterator[str]:
    """Yield where the links of a page lead; code has none."""
    text = re.sub(r"^```.*?^```|`[^`\n]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    yield from re.findall(r"\]\(([^)\s]+)\)", text)


@pytest.mark.long
@pytest.mark.parametrize("name", pages.PAGES)
def test_reference_pages_are_those_of_the_program(name: str) -> None:
    """Made anew, a page is as it stands, and no cell of its tables is empty; ``python docs/pages.py`` writes them."""
    page = (ROOT / "docs" / "reference" / name).read_text(encoding="utf-8")

    assert page == pages.text_of(name)
    assert not re.search(r"^\|.*\|\s*\|$", page, re.MULTILINE)


def test_every_effect_is_drawn_and_explained() -> None:
    """What it is, its signature with a picture, its look-alikes, what tells it apart, and its source, of each effect."""
    page = (ROOT / "docs" / "reference" / "effects.md").read_text(encoding="utf-8")
    sections = dict(re.findall(r"^## (\w+)\n(.*?)(?=^## )", page, re.DOTALL | re.MULTILINE))
    names = {name for name, cls in EFFECTS.known().items() if cls.__module__.startswith("pincal.")}

    assert set(sections) == names
    for name, section in sections.items():
        assert re.findall(r"^\*[^*].*\*$|\*\*(\w[\w -]+)\*\*", section, re.MULTILINE) == [
            "", "Signature", "look-alikes" if "](" not in section else "Look-alikes", "Distinguished by", "Source"
        ], name  # fmt: skip
        # What stands for others has no picture of its own.
        assert f"](../pictures/effects/{name}.png)" in section or "those of the actual cause" in section, name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_somewhere(page: Path) -> None:
    """Files are there, and headings in them; other addresses are whole."""
    for link in links_of(page):
        if re.match(r"https?://", link):
            assert re.fullmatch(r"https?://[\w.-]+\.\w+(/\S*)?", link), link
            continue
        place, _, anchor = link.partition("#")
        file = (page.parent / place).resolve() if place else page
        assert file.exists(), link
        assert not anchor or anchor in anchors_of(file), link


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_pages_are_short_enough_to_read(page: Path) -> None:
    """A tutorial has 1200 words with all that its commands print, and other pages 3000; what is looked up may be longer."""
    words = len(re.sub(r"<!--.*?-->", "", page.read_text(encoding="utf-8"), flags=re.DOTALL).split())
    most = {"tutorials": 1200, "reference": sys.maxsize}.get(page.parent.name, 3000)

    assert words <= most or page.name == "CHANGELOG.md"


@pytest.mark.long
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    """Sphinx finds every page, name and reference; formulas are drawn without a script from anywhere."""
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", str(ROOT / "docs"), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)

    assert done.returncode == 0 and not done.stderr, done.stderr
    assert "calibrate" in (tmp_path / "reference" / "python.html").read_text(encoding="utf-8")
    model = (tmp_path / "model.html").read_text(encoding="utf-8")
    assert "<math" in model and not re.search(r"(?:src|stylesheet\" href)=\"https?:", model)


def test_the_history_of_speed_has_a_line_of_every_release() -> None:
    """The last line is that of the changelog's first heading; every figure is a number, paired but for the first line."""
    rows = list(csv.DictReader(history.HISTORY.open(encoding="utf-8")))
    versions = [row["version"] for row in rows]

    assert tuple(rows[0]) == history.COLUMNS and versions[-1] == history.current()
    assert len(set(versions)) == len(versions)
    for k, row in enumerate(rows):
        assert all(float(row[figure]) > 0.0 for figure in history.FIGURES)
        assert all(bool(row[f"{figure}_ratio"]) == (k > 0) for figure in history.FIGURES)


@pytest.mark.long
def test_the_history_of_speed_times_every_figure() -> None:
    """Of a small table, by public names alone."""
    found = history.probe(rows=60)

    assert tuple(found) == history.FIGURES and min(found.values()) > 0.0


def told(page: str) -> tuple[list[str], list[float]]:
    """Return the words of a page without its numbers, and the numbers; those that are no more than rounding count as 0."""
    number = r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w])"
    numbers = [float(found) for found in re.findall(number, page)]
    return re.sub(number, "#", page).split(), [value if abs(value) > 1e-9 else 0.0 for value in numbers]


def test_every_block_is_run_or_says_why_not(tests: dict[str, bool]) -> None:
    """A block is played, a directive of the site, or marked: held by tests that are there, or not run for a reason."""
    not_run = []
    for page in transcripts.PAGES:
        for block in transcripts.blocks(page.read_text(encoding="utf-8")):
            if block.not_run:
                not_run.append(f"{page.stem}: {block.not_run}")
            elif block.held_by:
                assert set(block.held_by.split(", ")) <= tests.keys(), (page, block)
            else:
                assert block.language in transcripts.LANGUAGES or block.language.startswith("{"), (page, block)

    assert sorted(not_run) == [
        "CONTRIBUTING: it is what runs the tests",
        "README: it is what runs the tests",
        "cluster: it needs several machines",
        "install: it is what installs pincal",
    ]


@pytest.mark.parametrize("page", transcripts.PAGES, ids=lambda page: page.stem)
def test_commands_and_places_in_the_text_are_there(page: Path) -> None:
    """Verbs and options that a sentence or a block names are those of the program, and files are in the repository."""
    text = page.read_text(encoding="utf-8")
    context = click.Context(pincal)
    for line in re.findall(r"(?:^|^\$ |&& )pincal +(?![ -]|\w+ +\d)(.*(?:\\\n.*)*)", "\n".join(code_of(text)), re.MULTILINE):
        verb, *words = line.split("  #")[0].split()
        command = pincal.get_command(context, verb)
        if isinstance(command, click.Group) and words:
            command = command.get_command(context, words[0])
        assert command is not None, line
        known = {name for parameter in command.params for name in parameter.opts}
        assert {word.split("=")[0] for word in words if word.startswith("--")} <= {*known, "--help"}, line
    for place in re.findall(r"(?<![\w/.])(?:docs|examples|tests)/[\w/.-]*\w", text):
        assert (ROOT / place).exists(), place


def code_of(page: str) -> list[str]:
    """Return what stands in blocks and in single backquotes."""
    return [block or word for block, word in re.findall(r"```\S*\n(.*?)^```|`([^`]+)`", page, re.DOTALL | re.MULTILINE)]


# Three that take long are played before a release, as are two notebooks; other pages design and discover as well, and an
# example and the tests of motion do what the page on an IMU does.
SLOW = ("what-is-missing", "poses", "imu")


@pytest.mark.long
@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=page.stem, marks=pytest.mark.products if page.stem in SLOW else ())
        for page in transcripts.PAGES
        if is_played(page)
    ],
)
def test_pages_show_what_is_printed(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every block runs in an empty folder, and prints the words that it shows and, nearly, the numbers."""
    monkeypatch.chdir(tmp_path)
    # The pages show what the cell file saves.
    monkeypatch.delenv("PINCAL_CELL", raising=False)
    shown = page.read_text(encoding="utf-8")
    (words, numbers), (words_now, numbers_now) = told(shown), told(transcripts.played(shown))

    assert words_now == words
    assert numbers_now == pytest.approx(numbers, rel=0.1, abs=1e-9)


@pytest.mark.long
def test_notebooks_import_nothing_internal() -> None:
    """They take names from ``pincal`` and its packages for data, simulation and views only."""
    texts = [path.read_text("utf-8") for path in sorted((ROOT / "examples").glob("*.ipynb"))]
    modules = {found for text in texts for found in re.findall(r"from (pincal\.[\w.]+) import", text)}

    assert len(texts) == 3
    assert modules <= {"pincal.builtin", "pincal.simulate", "pincal.viewer"}


@pytest.mark.long
@pytest.mark.parametrize(
    "notebook",
    [
        pytest.param(path, id=path.stem, marks=() if path.stem == "calibrate" else pytest.mark.products)
        for path in sorted((ROOT / "examples").glob("*.ipynb"))
    ],
)
def test_notebooks_run_and_draw(notebook: Path, tmp_path: Path) -> None:
    """Every cell runs, figures are drawn and the robot in 3D, as notebooks are kept without outputs."""
    book = nbformat.read(notebook, 4)
    NotebookClient(book, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [kind for cell in book.cells for output in cell.get("outputs", ()) for kind in output.get("data", {})]
    figures, pages = shown.count("image/png"), list(tmp_path.glob("*.html"))

    assert len(pages) == 1 and pages[0].stat().st_size > 1e5
    assert figures or notebook.stem == "diagnose"
    assert not any(cell.get("outputs") for cell in nbformat.read(notebook, 4).cells), "notebooks are kept without outputs"
