"""What stands on the terminal: calm progress with the time left, and tables of 100 columns whatever names say."""

import io
import logging
import re
import sys
from pathlib import Path
from typing import Any

import pytest
from report_cases import HOSTILE
from rich.console import Console

from pincal.calibration.result_tables import ParameterRow, parameter_table
from pincal.cli import main, progress, show_progress
from pincal.cli.progress import console
from pincal.identify.explain import Cause, Reason, Status
from pincal.result_table import hanging, one_line

REASON = Reason(Cause.ALIASED, tuple(f"joint_{i}.theta" for i in range(1, 7)))
ROW = ParameterRow("joint_1.k_z", "rad/(N m)", 0.0, -1.234e-7, 1e-8, Status.UNIDENTIFIABLE, REASON)


class Terminal(io.StringIO):
    """Text that takes itself for a terminal."""

    def isatty(self) -> bool:
        """Return that it is one."""
        return True


@pytest.fixture(autouse=True)
def silence() -> Any:
    """Let no line of another test's command appear in these."""
    progress.end_progress()
    yield
    progress.end_progress()


def step(stage: str, iteration: int) -> None:
    logging.getLogger("pincal.identify.solve").info("%s: iteration %d", stage, iteration)


def test_a_fit_has_a_line_a_stage(capsys: pytest.CaptureFixture[str]) -> None:
    """Elsewhere than on a terminal the last step of each stage is told, not each step."""
    show_progress(False)
    for stage in ("all", "final"):
        for iteration in (1, 2, 3):
            step(stage, iteration)
    progress.end_progress()
    printed = capsys.readouterr()
    assert printed.err == "pincal: all: iteration 3\npincal: final: iteration 3\n" and printed.out == ""


def test_quiet_is_quiet(capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing is told if nothing was asked for."""
    show_progress(True)
    step("all", 1)
    assert capsys.readouterr() == ("", "")


def test_the_time_left_is_told_where_it_is_known(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two of five steps in a minute leave a minute and a half."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    show_progress(False)
    now[0] += 60.0
    logging.getLogger("pincal.discover.loop").info("found something", extra={"done": 2, "of": 5})
    assert capsys.readouterr().err == "pincal: found something [1 min 00 s, about 1 min 30 s left]\n"


def test_what_came_before_does_not_count_to_the_time_left(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a fit of a minute, subsamples of two seconds each leave two seconds each; nothing is left after the last."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    show_progress(False)
    now[0] += 60.0
    logging.getLogger("pincal.discover.loop").info("found something")
    for k in range(1, 11):
        now[0] += 2.0
        logging.getLogger("pincal.spread").info("subsample %d of %d", k, 10, extra={"done": k, "of": 10})
    lines = capsys.readouterr().err.splitlines()

    assert lines[0] == "pincal: found something [1 min 00 s]"
    assert lines[4] == "pincal: subsample 4 of 10 [1 min 08 s, about 12 s left]"
    assert lines[-1] == "pincal: subsample 10 of 10 [1 min 20 s]"


@pytest.mark.parametrize("width", [40, 60, 80])
def test_progress_fits_the_terminal(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """One line, whatever is done, with the time left behind it; it is cut between words."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    monkeypatch.setenv("COLUMNS", str(width))
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    show_progress(False)
    words = "assessing the convention of moments with all of the rows and some more words than fit anywhere at all"
    for k in (1, 2):
        now[0] += 100.0
        logging.getLogger("pincal.spread").info(words, extra={"done": k, "of": 9})
    progress._handler._progress.refresh()  # type: ignore[union-attr]
    progress.end_progress()
    shown = [re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", line) for line in re.split(r"[\r\n]", screen.getvalue())]
    full = [line for line in shown if "left" in line]

    assert full and max(map(len, shown)) <= width
    assert any("about 11 min 40 s left" in line for line in full)
    described = re.findall(r"(assessing.*?) …", full[-1])[0]
    assert words.startswith(f"{described} ")


def test_a_terminal_has_one_line_that_goes_away(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a terminal steps overwrite each other, events stay, and the line is erased in the end."""
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    show_progress(False)
    step("all", 1)
    logging.getLogger("pincal.discover.loop").info("found [bold]something")
    step("all", 2)
    progress.end_progress()
    text = screen.getvalue()
    assert "pincal: found [bold]something" in text and text.endswith("\x1b[2K")


def test_every_verb_tells_what_it_does(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    """From reading to writing there is a line; it is gone before the result is printed."""
    files = [str(tmp_path / name) for name in ("data.csv", "out", "poses.csv", "joints.csv")]
    model = str(tmp_path / "out" / "model.json")
    for words, steps in (
        (["simulate", "ur10", "--poses", "60", "--elastic", "0", "--out", files[0]], ("planning poses", "measuring them")),
        (["check", "ur10", files[0], "--model", "geometric"], ("reading robot", "analysing what these poses")),
        (
            ["calibrate", "ur10", files[0], "--model", "geometric", "--out", files[1]],
            ("assessing the fit", "drawing the report"),
        ),
        (["predict", model, files[0], "--out", files[2]], ("predicting 60 poses",)),
        (["compensate", model, files[0], "--out", files[3]], ("finding the joints of 60 rows",)),
    ):
        screen = Terminal()
        caplog.clear()
        with monkeypatch.context() as patch:
            patch.setattr(sys, "stderr", screen)
            with pytest.raises(SystemExit) as ended:
                main(words)
        assert ended.value.code == 0
        told = [record.getMessage() for record in caplog.records]
        assert all(any(step in line for line in told) for step in steps), told
        _, erased, after = screen.getvalue().rpartition("\x1b[2K")
        assert erased and (after == "" or after.startswith("pincal: note:"))
    assert "written to" in capsys.readouterr().out


def test_tables_fit_a_page_whatever_names_say(capsys: pytest.CaptureFixture[str]) -> None:
    """Long and hostile names neither break a table nor send control codes, and no box is drawn outside a terminal."""
    names = (ROW.name, HOSTILE + ".theta", "a_very_long_name_" * 8 + ".k_z", "\x1b[31mred[/red].d")
    rows = [ParameterRow(name, ROW.unit, 0.0, -1234.5678, 1e-8, ROW.status, ROW.reason) for name in names]
    out = console()
    out.print(parameter_table(rows))
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 100
    assert "\x1b" not in text and "<script>" in text and "[/red]" in text and not set("│┃━") & set(text)
    assert "a_very_long_name_" * 8 in "".join(line.split()[0] for line in text.splitlines() if line.strip())


def test_redirected_text_has_no_blanks_at_the_ends_of_lines(capsys: pytest.CaptureFixture[str]) -> None:
    """Neither tables nor paragraphs fill their lines; blanks within them and what ends no line stay."""
    out = console()
    out.print(parameter_table([ROW]))
    out.print(hanging("verdict ", "adequate. " * 20))
    out.print("a  b ", end="")
    lines = capsys.readouterr().out.split("\n")
    assert len(lines) > 5 and lines[-1] == "a  b "
    assert [line for line in lines[:-1] if line != line.rstrip()] == []


def test_a_terminal_has_boxes() -> None:
    """On a terminal the same table has lines."""
    screen = Console(file=Terminal(), width=100)
    screen.print(parameter_table([ROW]))
    assert "┃" in screen.file.getvalue() and one_line("a\tb") == "a b"
