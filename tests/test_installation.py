"""What a small installation lacks is refused where it is needed, with what to install, and nothing else is."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from pincal.builtin import kuka_urdf_path
from pincal.cli import outputs

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
# Runs a command in a process in which a package can't be imported.
RUN = (
    "import sys; sys.modules.update(dict.fromkeys(sys.argv[1].split(','))); from pincal.cli import main; main(sys.argv[2:])"
)


def run_without(package: str, *words: object, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a command where a package is not installed."""
    command = [sys.executable, "-c", RUN, package, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder, env=os.environ)


@pytest.mark.long
@pytest.mark.parametrize(
    ("package", "words", "advice"),
    [
        (
            "example_robot_data",
            ["simulate", "ur10", "--poses", "3", "--out", "t.csv"],
            "pip install example-robot-data-loaders",
        ),
        ("matplotlib", ["calibrate", "robot.urdf", "t.csv", "--out", "results"], "pip install matplotlib"),
        pytest.param("matplotlib", ["demo"], "pip install matplotlib", marks=pytest.mark.rates),
    ],
)
def test_what_needs_a_missing_package_is_refused(package: str, words: list[str], advice: str, tmp_path: Path) -> None:
    """Before any work is done, exit code 3."""
    done = run_without(package, *words, folder=tmp_path)

    assert done.returncode == 3 and advice in done.stderr
    assert "Traceback" not in done.stderr and not list(tmp_path.iterdir())


@pytest.mark.long
def test_programs_of_controllers_need_a_parser(tmp_path: Path) -> None:
    """Tables do not, and nothing is written."""
    model = Path(__file__).parent / "data" / "model_0_1_0_tracker.json"
    (tmp_path / "a.src").write_text("DEF a( )\nEND\n")
    done = run_without("lark", "compensate", model, "a.src", "--out", "b.src", folder=tmp_path)

    assert done.returncode == 3 and "programs of controllers need lark: run pip install lark" in done.stderr
    assert "Traceback" not in done.stderr and not (tmp_path / "b.src").exists()


@pytest.mark.long
def test_the_rest_needs_none_of_them(tmp_path: Path) -> None:
    """A table can be simulated and checked."""
    absent = "example_robot_data,matplotlib,meshcat,trimesh,yourdfpy"
    urdf, table = kuka_urdf_path(), tmp_path / "t.csv"
    for words in (["simulate", urdf, "--poses", "30", "--out", table], ["check", urdf, table]):
        assert run_without(absent, *words, folder=tmp_path).returncode == 0


def test_the_report_of_a_problem_names_what_is_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not installed is a version, too."""
    monkeypatch.setattr(outputs, "_PACKAGES", ("numpy", "no-such-package"))

    assert list(outputs.problem_report(["check"], []))[1].endswith(", no-such-package not installed")


def test_meshes_that_can_not_be_read_are_told_with_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The page shows simple shapes in their place."""
    from pincal.robot.robot import Robot
    from pincal.viewer.shapes import shapes_of

    (tmp_path / "link.stl").write_text("solid\nendsolid\n")
    visual = '<visual><geometry><mesh filename="link.stl"/></geometry></visual>'
    text = kuka_urdf_path().read_text().replace('<link name="link_1">', f'<link name="link_1">{visual}', 1)
    (tmp_path / "robot.urdf").write_text(text)
    monkeypatch.setitem(sys.modules, "trimesh", None)
    _, notes = shapes_of(Robot.from_urdf(tmp_path / "robot.urdf"), [tmp_path])

    assert any("pip install 'trimesh[easy]'" in note for note in notes)


@pytest.mark.long
def test_where_pinocchio_can_not_be_installed_a_page_says_what_to_do(tmp_path: Path) -> None:
    """As on Windows: exit code 3 and where to read on, no word of a bug."""
    words = ["simulate", kuka_urdf_path(), "--poses", "3", "--out", "t.csv"]
    done = run_without("pinocchio", *words, folder=tmp_path)
    page = (ROOT / "docs" / "install.md").read_text(encoding="utf-8")

    assert done.returncode == 3 and "pinocchio is not installed; docs/install.md lists" in done.stderr
    assert "## Where it installs" in page and "no wheels for Windows" in page


def test_the_environment_has_all_that_the_wheel_needs() -> None:
    """Each dependency by the same version from conda-forge, whose example-robot-data has its loaders in it."""
    needed = {re.split(r"[>\[]", line)[0]: line.split(">=")[1] for line in PROJECT["dependencies"]}
    text = (ROOT / "environment.yml").read_text(encoding="utf-8")
    offered = dict(re.findall(r"^ +- ([\w-]+) ?>=([\d.]+)", text, re.MULTILINE))
    names = {"pin": "pinocchio", "matplotlib": "matplotlib-base", "example-robot-data-loaders": "example-robot-data"}

    assert {name: version for name, version in needed.items() if offered.get(names.get(name, name)) is None} == {}
    assert offered["python"] == PROJECT["requires-python"].removeprefix(">=")


def test_the_release_has_one_version() -> None:
    """In the package's metadata and in the citation."""
    assert f"version: {PROJECT['version']}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
