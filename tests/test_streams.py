"""What a command prints does no harm, and where it can't be printed, the run is none the worse."""

import json
import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pincal.cli import main
from pincal.errors import BadInputError, PincalWarning, printable

GUARDED = """
import os, sys
from pincal.cli import guard_streams
lost = guard_streams()
with open(sys.argv[1], "w") as file:
    file.write("whole")
print("x" * 200_000, "\\x1b]0;title\\x07", "\\u9b00\\x9b2J", "\\x1b[31mred\\x1b[0m")
print("note", file=sys.stderr)
sys.stdout.flush()
os._exit(3 if lost.lost else 0)
"""
PINCAL = [sys.executable, "-m", "pincal"]
NOTHING_OPEN = ">&- 2>&- <&-"
REDIRECTED = {">/dev/full": 3, ">&-": 0, "| head -c 1 >/dev/null": 0, "2>/dev/full >/dev/null": 0, NOTHING_OPEN: 0}


# Where nobody hears of the limit of accuracy: a full disk, and nothing open.
UNHEARD = (">/dev/full", NOTHING_OPEN)


@pytest.mark.parametrize("redirection", REDIRECTED)
def test_a_stream_that_takes_nothing_harms_nothing(tmp_path: Path, redirection: str) -> None:
    """Closed, full or a broken pipe: the file is whole, nothing is printed into it, and a full disk is told."""
    command = f'set -o pipefail; "$0" -c "$1" "$2" {redirection}'
    ran = subprocess.run(["bash", "-c", command, sys.executable, GUARDED, tmp_path / "f"], capture_output=True, check=False)

    assert ran.returncode == REDIRECTED[redirection]
    assert (tmp_path / "f").read_text() == "whole"
    assert b"Traceback" not in ran.stderr


def test_no_control_character_is_printed(tmp_path: Path) -> None:
    """Elsewhere none at all; on a terminal colours only."""
    command = [sys.executable, "-c", GUARDED, tmp_path / "f"]
    plain = subprocess.run(command, capture_output=True, check=True).stdout.decode()
    assert plain.replace("\n", "").isprintable() and "\\x1b]0;title\\x07" in plain
    master, slave = pty.openpty()
    with subprocess.Popen(command, stdout=slave, stderr=slave) as process:
        os.close(slave)
        shown = b""
        while True:
            try:
                shown += os.read(master, 1 << 16)
            except OSError:
                break
        process.wait()
    os.close(master)

    assert b"\x1b[31mred\x1b[0m" in shown
    assert printable(shown.decode().replace("\r\n", "").replace("\x1b[31m", "").replace("\x1b[0m", "")).count("\x1b") == 0
    assert b"\x1b]" not in shown and "\x9b" not in shown.decode()


@pytest.mark.parametrize("kind", [BadInputError, PincalWarning])
def test_messages_are_short_and_hold_no_control_character(kind: type[Exception]) -> None:
    """Names come from files: an escape in one is shown as what it is, and no message has more than 2 kB."""
    text = str(kind("joint '\x1b[2J\x07\u009b\ud800': invalid\nsee the file"))
    assert text == "joint '\\x1b[2J\\x07\\x9b\\ud800': invalid\nsee the file"
    for letter in "aä漢\x1b":
        text = str(kind("start " + letter * 100_000 + " end"))
        assert len(text.encode()) < 2000
        assert text.startswith("start ") and text.endswith(" end") and " ... " in text


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a simulated table of 60 rows."""
    table = tmp_path_factory.mktemp("streams") / "a.csv"
    with pytest.raises(SystemExit) as ended:
        main(["simulate", "ur5", "--poses", "60", "--seed", "1", "--quiet", "--out", str(table)])
    assert not ended.value.code
    return table


# Streams one by one are closed and filled above; of whole calibrations the others are made before a release.
@pytest.mark.long
@pytest.mark.parametrize(
    "redirection",
    [pytest.param(of, marks=pytest.mark.rates if of in (">&-", "2>/dev/full >/dev/null") else ()) for of in REDIRECTED],
)
def test_a_calibration_is_whole_wherever_its_words_go(table: Path, tmp_path: Path, redirection: str) -> None:
    """The files are right, and so is the exit code; the limit of accuracy is checked though nobody hears of it."""
    pincal = f'"{sys.executable}" -m pincal'
    calibrate = f'set -o pipefail; {pincal} calibrate ur5 "{table}" --model geometric --out out'

    def exit_code(more: str = "") -> int:
        ran = subprocess.run(
            ["bash", "-c", f"{calibrate}{more} {redirection}"], cwd=tmp_path, capture_output=True, check=False
        )
        assert b"Traceback" not in ran.stderr
        files = json.loads((tmp_path / "out" / "model.json").read_text())["files"]
        assert {file.name for file in (tmp_path / "out").iterdir()} == {"model.json", *files}
        return ran.returncode

    if redirection in UNHEARD:
        assert exit_code(" --max-error 1um") == 5
    # Where nothing is open the code is that of other streams that take nothing; a full disk has one of its own.
    if redirection != NOTHING_OPEN:
        assert exit_code() == REDIRECTED[redirection]


@pytest.mark.long
def test_an_interruption_is_answered_within_a_second(table: Path, tmp_path: Path) -> None:
    """As Ctrl-C on a terminal, which reaches the workers, too: no traceback, no file, exit code 130."""
    words = ["discover", "ur5", table, "--out", tmp_path / "found"]
    for wait in (0.0, 1.0):
        running = subprocess.Popen([*PINCAL, *words], stderr=subprocess.PIPE, text=True, start_new_session=True)
        assert running.stderr is not None
        told = running.stderr.readline()
        time.sleep(wait)
        began = time.monotonic()
        os.killpg(running.pid, signal.SIGINT)
        told += running.communicate(timeout=60)[1]

        # A second, and what other tests on this machine take of it.
        assert time.monotonic() - began < 2.0
        assert running.returncode == 130
        assert "pincal: interrupted; nothing was written" in told and "Traceback" not in told
        assert not list(tmp_path.iterdir())
