"""A test with rooms is left out only where git says that nothing in them has changed."""

from __future__ import annotations

import ast
import subprocess
from pathlib import Path

import pytest
from rooms import EVERYWHERE, changed_since, is_concerned, touches
from trees import parsed

ROOT = Path(__file__).parents[1]


def git(folder: Path, *words: str) -> None:
    """Run git, as somebody."""
    who = ["-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false"]
    subprocess.run(["git", *who, *words], cwd=folder, check=True, capture_output=True)


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Return a repository of two files."""
    for name in ("a.py", "b.py"):
        (tmp_path / name).write_text("1\n")
    git(tmp_path, "init")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-m", "first")
    return tmp_path


def test_whatever_differs_from_a_commit_has_changed(project: Path) -> None:
    """What was committed since, what is not committed yet, what git does not know, and both names of a file that moved."""
    assert changed_since("HEAD", project) == frozenset()
    (project / "a.py").write_text("2\n")
    git(project, "commit", "-a", "-m", "second")
    assert changed_since("HEAD~1", project) == {"a.py"}
    (project / "new.py").write_text("3\n")
    git(project, "mv", "b.py", "c.py")

    assert changed_since("HEAD~1", project) == {"a.py", "b.py", "c.py", "new.py"}


@pytest.mark.parametrize("commit", ["no-such-commit", ""])
def test_where_git_does_not_know_nothing_is_said_to_be_unchanged(project: Path, tmp_path: Path, commit: str) -> None:
    """A commit that is not there, and a folder that is no repository."""
    assert changed_since(commit, project) is None
    assert changed_since("HEAD", tmp_path / "nowhere") is None


def test_a_room_is_a_file_or_a_folder() -> None:
    """And no other of which its name is a part."""
    assert touches({"pincal/report/html.py"}, ["pincal/report"])
    assert touches({"pincal/units.py"}, ["pincal/units.py"])
    assert not touches({"pincal/report_more.py", "pincal"}, ["pincal/report"])


def test_tests_without_rooms_always_run(request: pytest.FixtureRequest) -> None:
    """So does this one, whatever has not changed; one with rooms does if they, its own file or the set-up changed."""
    item = request.node
    assert is_concerned(item, frozenset())
    item.add_marker(pytest.mark.rooms("pincal/report"))

    assert not is_concerned(item, frozenset({"pincal/robot/robot.py"}))
    for changed in ("pincal/report/html.py", "tests/test_rooms.py", *EVERYWHERE):
        assert is_concerned(item, frozenset({changed}))


def test_every_room_that_a_test_names_is_there() -> None:
    """A folder that was renamed would leave its tests out for ever."""
    named = set()
    for file in Path(__file__).parent.glob("test_*.py"):
        for node in ast.walk(parsed(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "pytest.mark.rooms":
                named |= {word.value for word in node.args if isinstance(word, ast.Constant)}

    assert named
    assert {room for room in named if not (ROOT / room).exists()} == set()
