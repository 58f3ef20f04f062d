"""Code of others: registries, entry points and modules that the user names."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from pincal import plugins
from pincal.cli import main
from pincal.cli import pincal as pincal_command
from pincal.errors import BadInputError, Exit, PincalWarning
from pincal.plugins import Registry, load_plugin

# A module that registers a class of its own.
REGISTERS = """
from pincal.plugins import Registry
Registry("thing", group="", name_of=lambda cls: cls.__name__).register(type("Here", (), {"__module__": __name__}))
"""


class Thing:
    """What the registries of these tests hold."""

    name = "thing"


def registry() -> Registry[Thing]:
    return Registry("thing", group="pincal.things", name_of=lambda cls: cls.name)


def a_class(title: str, name: str) -> type[Thing]:
    """Return a class of a title, known under a name."""
    return type(title, (Thing,), {"name": name, "__qualname__": title})


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Return the current folder, an empty one; what is imported from it is forgotten again."""
    monkeypatch.chdir(tmp_path)
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        del sys.modules[name]


def test_a_registered_class_is_known_by_its_name() -> None:
    """Registering returns the class, and twice is as good as once."""
    things = registry()
    assert things.register(Thing) is things.register(Thing) is Thing
    assert things.known() == {"thing": Thing}


def test_a_name_belongs_to_one_class() -> None:
    """Another class under a known name is refused, the same class defined again takes its place."""
    things, first, again = registry(), a_class("First", "hose"), a_class("First", "hose")
    things.register(first)
    with pytest.raises(TypeError, match=r"thing 'hose' .* has the name of .*First; choose another name"):
        things.register(a_class("Second", "hose"))
    assert things.register(again) is things.known()["hose"]


def test_a_class_that_says_too_little_is_refused() -> None:
    """The check of a registry decides."""

    def refuse(cls: type[Thing]) -> None:
        raise TypeError(f"{cls.__name__} has no meaning")

    with pytest.raises(TypeError, match="Thing has no meaning"):
        Registry("thing", group="pincal.things", name_of=lambda cls: cls.name, check=refuse).register(Thing)


def test_entry_points_are_loaded_once_and_when_asked(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A class that an installed package declares is known; one that fails is told of, and nothing else is lost."""
    (folder / "good_package.py").write_text("class Good:\n    name = 'good'\n")
    (folder / "bad_package.py").write_text("raise RuntimeError('broken')\n")
    monkeypatch.syspath_prepend(folder)
    asked = list[str]()

    def points(*, group: str) -> list[EntryPoint]:
        asked.append(group)
        return [EntryPoint("bad", "bad_package:Bad", group), EntryPoint("good", "good_package:Good", group)]

    monkeypatch.setattr(plugins, "entry_points", points)
    things = registry()
    assert asked == []
    with pytest.warns(PincalWarning, match="thing 'bad' .* bad_package:Bad can't be loaded .*broken.*left out"):
        assert list(things.known()) == ["good"]
    assert list(things.known()) == ["good"] and asked == ["pincal.things"]


def test_a_plugin_is_a_module_or_a_file(folder: Path) -> None:
    """It is found in the current folder by name, elsewhere by path, and the search path stays as it was."""
    (folder / "elsewhere").mkdir()
    (folder / "here_effects.py").write_text(f"value = 1\n{REGISTERS}")
    (folder / "elsewhere" / "there_effects.py").write_text(f"value = 2\n{REGISTERS}")
    before = list(sys.path)

    assert load_plugin("here_effects").value == 1
    assert load_plugin("elsewhere/there_effects.py").value == 2
    assert load_plugin("here_effects").value == 1, "once more"
    assert sys.path == before


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "plugin 'mine': no such module; expected the name of an installed one, or a file"),
        ("import no_such_thing_at_all\n", "plugin 'mine' needs the module 'no_such_thing_at_all'"),
        ("1 / 0\n", "plugin 'mine' fails: ZeroDivisionError: division by zero"),
        ("def f(:\n", "plugin 'mine' fails: SyntaxError"),
        ("import sys; sys.exit(0)\n", "plugin 'mine' ends the program .SystemExit: 0.; expected a module that only"),
        ("raise SystemExit('done')\n", "plugin 'mine' ends the program .SystemExit: done."),
        ("value = 1\n", "plugin 'mine': registers neither an effect nor a sensor; expected .* @register_effect"),
    ],
)
def test_a_plugin_that_fails_is_a_fault_of_the_input(folder: Path, text: str | None, message: str) -> None:
    """The message says what is missing, or what went wrong."""
    if text is not None:
        (folder / "mine.py").write_text(text)
    with pytest.raises(BadInputError, match=message):
        load_plugin("mine")


def test_an_entry_point_that_exits_is_left_out(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As one that fails."""
    (folder / "exits_package.py").write_text("raise SystemExit(0)\n")
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setattr(plugins, "entry_points", lambda group: [EntryPoint("exits", "exits_package:Bad", group)])
    with pytest.warns(PincalWarning, match="can't be loaded .*SystemExit.*left out"):
        assert list(registry().known()) == []


def test_code_of_others_does_not_end_a_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """An effect that exits while rows are fitted is an error, exit code 3, and not work that was done."""

    def ended(**_: object) -> None:
        raise SystemExit(0)

    monkeypatch.setattr(pincal_command, "main", ended)
    with pytest.raises(SystemExit) as code:
        main(["calibrate"])
    assert code.value.code == Exit.BAD_INPUT and "ended the program (SystemExit: 0)" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["os", "json.decoder", ""])
def test_a_module_that_is_no_plugin_is_refused(name: str) -> None:
    """One that is imported long since, and a name that is none."""
    with pytest.raises(BadInputError, match=rf"plugin '{name}': .*expected"):
        load_plugin(name)


@pytest.mark.parametrize(
    "verb", ["check", "calibrate", "discover", "design", "validate", "predict", "compensate", "export", "view"]
)
def test_every_verb_that_reads_a_robot_or_a_model_loads_plugins(folder: Path, verb: str) -> None:
    """Plugins are loaded before anything else is looked at, and a wrong name is bad input."""
    (folder / "mine.py").write_text("raise SystemError('loaded')\n")

    for name, words in (("mine", "plugin 'mine' fails: SystemError: loaded"), ("yours", "plugin 'yours': no such module")):
        with pytest.raises(BadInputError, match=words):
            pincal_command.main(args=[verb, "no_robot", "no_table", "--plugin", name], standalone_mode=False)
