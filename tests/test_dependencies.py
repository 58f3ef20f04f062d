"""Environments of their own: the lowest declared versions, and the newest on another Python; every command runs."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path

import click
import pytest

from pincal.builtin import kuka_urdf_path
from pincal.cli import pincal as command_line

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
# Extras that commands use; the other ones are of documentation and tests.
EXTRAS = ("cluster", "excel", "fleet", "images", "ros", "xacro")
OTHER_PYTHON = "3.13"
# Every command, and a file that it writes; each uses what those before it wrote.
COMMANDS = (
    ("simulate robot.urdf --poses 40 --seed 1 --noise 0.05mm --out rows.csv", "rows.csv"),
    ("simulate robot.urdf --poses 14 --seed 1 --pose-seed 7 --noise 0.05mm --out new.csv", "new.csv"),
    ("check robot.urdf rows.csv", ""),
    ("calibrate robot.urdf rows.csv --model geometric --view --out calibrated", "calibrated/view3d.html"),
    ("discover robot.urdf rows.csv --noise 0.05mm --out found", "found/report.html"),
    ("design robot.urdf --poses 12 --out plan.csv", "plan.csv"),
    ("validate calibrated/model.json new.csv", ""),
    ("predict calibrated/model.json new.csv --out predicted.csv", "predicted.csv"),
    ("compensate calibrated/model.json rows.csv --out corrected.csv", "corrected.csv"),
    ("compensate calibrated/model.json a.src --out b.src", "b.src"),
    ("certificate calibrated/model.json --out certificate", "certificate/dcc.xml"),
    ("measure calibrated/model.json touched.csv --features part.toml --out measured", "measured/measured.json"),
    ("interim calibrated/model.json new.csv", "calibrated/model.checks.json"),
    ("diagnose calibrated/model.json new.csv --out diagnosis", "diagnosis/diagnosis.json"),
    ("update calibrated/model.json new.csv --out updated", "updated/model.json"),
    ("export calibrated/model.json --mjcf out.xml --c out --python out.py --page out.html", "out.html"),
    ("view calibrated/model.json --html view.html", "view.html"),
    ("fleet add store rows.csv --machine R1 --day 2026-01-05 --robot robot.urdf", "store/store.json"),
    ("fleet add store calibrated/model.json --machine R2 --day 2026-01-05", ""),
    ("fleet calibrate robot.urdf store --noise 0.05mm", ""),
    ("fleet learn store --out type.json", "type.json"),
    ("fleet check type.json store", ""),
    ("demo --out demo", "demo/report.html"),
)
PROGRAM = """DEF a( )
$TOOL = {X 0,Y 0,Z 0,A 0,B 0,C 0}
$BASE = {X 0,Y 0,Z 0,A 0,B 0,C 0}
PTP {A1 10,A2 20,A3 -20,A4 0,A5 30,A6 0}
END
"""
PART = 'unit = "mm"\n[feature.seat]\nkind = "point"\n'
TOUCHED = """joint_1,joint_2,joint_3,joint_4,joint_5,joint_6,feature
0.1,-1,1,0.2,0.3,0.4,seat
0.2,-1,1,0.1,0.3,0.4,seat
"""
# What extras are for, at their lowest versions: a workbook, SQL, images, recordings, a cluster, and xacro.
OF_EXTRAS = """
import cv2, distributed, fsspec, openpyxl, polars, rosbags, xacrodoc
from pincal import Robot
from pincal.fleet.store import open_store
from pincal.measure.table import read_measurements
if __name__ == "__main__":
    assert len(open_store("store").query("select distinct machine from tables")) == 1
    book = openpyxl.Workbook()
    for row in open("rows.csv", encoding="utf-8"):
        book.active.append(row.strip().split(","))
    book.save("rows.xlsx")
    assert len(read_measurements("rows.xlsx", Robot.from_urdf("robot.urdf"))) == 40
    open("r.urdf.xacro", "w").write(open("robot.urdf").read())
    assert Robot.from_urdf("r.urdf.xacro").n_joints == 6
"""


def lowest(requirements: Iterable[str]) -> list[str]:
    """Return requirements with the lowest versions that they allow."""
    return [line.replace(">=", "==") for line in requirements]


def environment(python: Path, folder: Path, *packages: str, only: bool = False) -> Path:
    """Return the interpreter of a new environment with packages, and this project; without an index the test skips."""
    subprocess.run([python, "-m", "venv", folder / "env"], check=True, capture_output=True)
    found = folder / "env" / "bin" / "python"
    for words in ([*packages] if only else [], ["--no-deps", ROOT] if only else [ROOT]):
        if words:
            command = [found, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *map(str, words)]
            done = subprocess.run(command, capture_output=True, text=True)
            if re.search("Temporary failure in name resolution|Connection refused|Network is unreachable", done.stderr):
                pytest.skip("no package index can be reached from here")
            assert done.returncode == 0, done.stderr[-3000:]
    return found


def failures(python: Path, folder: Path) -> list[str]:
    """Run every command in a folder; return those that failed, with the end of what they said."""
    shutil.copy(kuka_urdf_path(), folder / "robot.urdf")
    (folder / "a.src").write_text(PROGRAM, encoding="utf-8")
    (folder / "part.toml").write_text(PART, encoding="utf-8")
    (folder / "touched.csv").write_text(TOUCHED, encoding="utf-8")
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    found = []
    for command, file in COMMANDS:
        words = [python, "-m", "pincal", *command.split(), "--quiet"]
        done = subprocess.run(words, capture_output=True, text=True, cwd=folder, env=clean)
        if done.returncode or not (folder / file).exists():
            found.append(f"{command}: exit code {done.returncode}: {done.stderr[-500:]}")
    return found


def test_every_command_is_among_them() -> None:
    """What is run in other environments is all there is."""
    assert {command.split()[0] for command, _ in COMMANDS} == set(command_line.list_commands(click.Context(command_line)))


def test_lowest_versions_are_taken_of_all_dependencies() -> None:
    """Each declares one."""
    assert lowest(["a[b]>=1.2.3"]) == ["a[b]==1.2.3"]
    assert all(line.count(">=") == 1 for line in PROJECT["dependencies"])
    assert all(line.count(">=") == 1 for name in EXTRAS for line in PROJECT["optional-dependencies"][name])


@pytest.mark.long
@pytest.mark.installs
def test_every_command_works_with_the_lowest_declared_versions(tmp_path: Path) -> None:
    """On the oldest Python, extras included: pip installs them together, and nothing needs more than it declares."""
    oldest = PROJECT["requires-python"].removeprefix(">=")
    if sys.version_info[:2] != tuple(map(int, oldest.split("."))):
        pytest.skip(f"this is not Python {oldest}, the oldest, for which the lowest versions have wheels")
    needed = [*PROJECT["dependencies"], *(line for name in EXTRAS for line in PROJECT["optional-dependencies"][name])]
    python = environment(Path(sys.executable), tmp_path, *lowest(needed), only=True)
    assert failures(python, tmp_path) == []
    done = subprocess.run([python, "-c", OF_EXTRAS], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.mark.long
@pytest.mark.installs
def test_every_command_works_on_another_python_without_extras(tmp_path: Path) -> None:
    """With the newest versions that there are."""
    pyenv = sorted(Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")).glob(f"versions/{OTHER_PYTHON}*/bin/python3"))
    other = [found for found in (shutil.which(f"python{OTHER_PYTHON}"), *map(str, pyenv)) if found and _runs(found)]
    if not other:
        pytest.skip(f"no Python {OTHER_PYTHON} here")
    assert failures(environment(Path(other[0]), tmp_path), tmp_path) == []


def _runs(python: str) -> bool:
    """Return whether an interpreter is one; a version manager has scripts in its place for versions it does not use."""
    done = subprocess.run([python, "--version"], capture_output=True, text=True)
    return done.returncode == 0 and f"Python {OTHER_PYTHON}." in done.stdout
