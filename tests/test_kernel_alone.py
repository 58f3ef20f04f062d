"""The kernel without its satellites: a copy of the package that lacks their folders runs the verbs of the kernel."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from test_calibrate import paper_table
from test_cli import URDF, columns_of
from test_layers import INNER, PACKAGE, SATELLITES

from pincal import Robot
from pincal.measure.table import write_table

KERNEL = [name for name in INNER if name.split(".")[1] not in (*SATELLITES, "__main__")]
# Imports modules, then runs commands in one process, and prints the exit code of each.
RUN = """
import importlib, json, sys
modules, commands = json.loads(sys.argv[1])
for module in modules:
    importlib.import_module(module)
from pincal.cli import main
for words in commands:
    try:
        main(words)
    except SystemExit as ended:
        print("=== ended with", ended.code, flush=True)
"""
# What is done with a table and its model.
DONE: list[list[str]] = [
    ["check", URDF, "data.csv", "--json"],
    ["calibrate", URDF, "data.csv", "--model", "geometric", "--test-fraction", "0.2", "--out", "out", "--quiet"],
    ["validate", "out/model.json", "data.csv"],
    ["predict", "out/model.json", "data.csv", "--out", "predicted.csv"],
    ["compensate", "out/model.json", "data.csv", "--out", "corrected.csv"],
    ["export", "out/model.json", "--urdf", "robot.urdf", "--python", "arm.py"],
]
# What takes a satellite, and what is said of it.
REFUSED: list[tuple[list[str], int, str]] = [
    (["discover", URDF, "data.csv", "--out", "found"], 2, "No such command 'discover'"),
    (
        ["calibrate", URDF, "data.csv", "--out", "seen", "--view"],
        3,
        "--view: this installation lacks pincal.viewer",
    ),
    (["check", URDF, "data.csv", "--type", "t.json"], 3, "--type: this installation lacks pincal.fleet"),
    (["export", "out/model.json", "--page", "p.html"], 3, "--page: this installation lacks pincal.programs"),
    (["check", URDF, "."], 3, ".: is a folder; expected a file"),
]


class Run(NamedTuple):
    """A run of the kernel alone: its folder, what it printed for each command, with the exit code, and its errors."""

    folder: Path
    printed: list[str]
    errors: str


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory, kuka: Robot) -> Run:
    """Return what all commands print where the folders of satellites are missing; one process, as it takes seconds."""
    package = tmp_path_factory.mktemp("kernel") / "pincal"
    package.mkdir()
    for entry in PACKAGE.iterdir():
        if entry.name not in SATELLITES:
            # A link, so that compiled loops stay cached.
            (package / entry.name).symlink_to(entry)
    folder = tmp_path_factory.mktemp("work")
    write_table(folder / "data.csv", columns_of(paper_table(kuka, 40, 0, 5e-5)))
    commands: list[Any] = [["--help"], ["calibrate", "--help", "all"], *DONE, *(words for words, *_ in REFUSED)]
    command = [sys.executable, "-P", "-c", RUN, json.dumps([KERNEL, commands])]
    environment = os.environ | {"PYTHONPATH": str(package.parent)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=folder, check=False)
    assert done.returncode == 0, done.stderr
    return Run(folder, done.stdout.split("=== ended with "), done.stderr)


def codes(run: Run) -> list[int]:
    """Return the exit codes of all commands."""
    return [int(text.split()[0]) for text in run.printed[1:]]


@pytest.mark.long
def test_the_kernel_works_with_all_satellites_absent(alone: Run) -> None:
    """All its modules are imported, and from a table it checks, calibrates, validates, predicts, compensates, exports."""
    check = alone.printed[2]

    assert codes(alone)[2 : 2 + len(DONE)] == [0] * len(DONE), alone.errors
    assert '"parameters"' in check and '"detectable"' not in check
    files = {path.relative_to(alone.folder).as_posix() for path in alone.folder.rglob("*")}
    assert {"out/result.json", "out/report.html", "predicted.csv", "corrected.csv", "robot.urdf", "arm.py"} <= files


@pytest.mark.long
def test_what_only_a_satellite_does_is_said_to_be_absent(alone: Run) -> None:
    """The help shows the verbs and options that there are; others are no commands, or name what they need."""
    general, calibrate, *_ = alone.printed
    verbs = [line.split()[0] for line in general.partition("Commands:\n")[2].partition("\n\n")[0].splitlines()]

    assert verbs == ["check", "calibrate", "validate", "predict", "compensate", "export"]
    assert "pincal demo" not in general and "pincal compensate results/model.json" in general
    assert "--imu" not in calibrate and "--loss" in calibrate
    assert codes(alone)[2 + len(DONE) :] == [code for _, code, _ in REFUSED]
    assert [words for *_, words in REFUSED if words not in alone.errors] == []
