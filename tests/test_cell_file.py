"""The cell file: what it gives to commands, who overrides it, what is refused, and who writes it."""

import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from command_line import run
from test_calibrate import paper_table
from test_cli import URDF, columns_of

from pincal import Robot
from pincal.cli import pincal
from pincal.cli.arguments import Verb
from pincal.cli.cell_file import CELL_KEYS, CellFile, write_cell
from pincal.discover.detectability import DetectabilityTable, detectable_effects
from pincal.discover.report import detectability_tables
from pincal.errors import BadInputError
from pincal.identify.fit import ModelFit
from pincal.measure.table import write_table

CONTEXT = click.Context(pincal)
MOST_SHOWN = 14


def verbs() -> dict[str, Verb]:
    """Return all verbs by name, those of groups included."""
    found: dict[str, Verb] = {}
    for name in pincal.list_commands(CONTEXT):
        command = pincal.get_command(CONTEXT, name)
        inner = command.commands if isinstance(command, click.Group) else {"": command}
        found |= {f"{name} {own}".strip(): each for own, each in inner.items() if isinstance(each, Verb)}
    return found


VERBS = verbs()


@pytest.fixture(scope="module", autouse=True)
def _one_outlook() -> Iterator[None]:
    """Work out once what a search could find: half of a check, and of no cell file's concern."""
    found: list[DetectabilityTable] = []

    def once(fit: ModelFit) -> DetectabilityTable:
        if not found:
            found.append(detectable_effects(fit))
        return found[0]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(detectability_tables, "detectable_effects", once)
        yield


@pytest.fixture
def folder(tmp_path: Path, kuka: Robot, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the current folder, with a robot and a table; cell files are found in it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PINCAL_CELL")
    shutil.copy(URDF, "robot.urdf")
    write_table("tracker.csv", columns_of(paper_table(kuka, 40, 0, 5e-5)))
    return tmp_path


def cell(text: str, name: str = "cell.toml") -> None:
    """Write a cell file."""
    Path(name).write_text(text, encoding="utf-8")


def count_in_the_opposite_sense(kuka: Robot, joint: str) -> None:
    """Write the table as of a controller on which a joint does, so that its sign is no mistake whose cause is sought."""
    columns = columns_of(paper_table(kuka, 40, 0, 5e-5))
    write_table("tracker.csv", columns | {joint: -columns[joint]})


def checked(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[dict[str, Any], str]:
    """Return what check says of the table as JSON, and what it prints on stderr."""
    assert run("check", *words, "--json") == 0
    said = capsys.readouterr()
    return json.loads(said.out), said.err


def test_a_table_is_enough_with_a_cell_beside_it(folder: Path, kuka: Robot, capsys: pytest.CaptureFixture[str]) -> None:
    """The same as with all options, and what came from the file is said once."""
    count_in_the_opposite_sense(kuka, "joint_4")
    whole, _ = checked(capsys, "robot.urdf", "tracker.csv", "--noise", "0.05mm", "--sign", "joint_4")
    cell('robot = "robot.urdf"\nnoise = "0.05mm"\nsign = ["joint_4"]\n')
    short, said = checked(capsys, "tracker.csv")

    assert short == whole
    assert said.count("cell.toml: ") == 1 and "cell.toml: robot, sign, noise\n" in said


def test_files_are_relative_to_the_cell(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From whichever folder the command is run, and by whichever way the cell is found."""
    (folder / "day").mkdir()
    shutil.move("tracker.csv", "day/tracker.csv")
    cell('robot = "../robot.urdf"\nnoise = "0.05mm"\n', "day/cell.toml")
    beside, said = checked(capsys, "day/tracker.csv")
    named, _ = checked(capsys, "day/tracker.csv", "--cell", str(folder / "day" / "cell.toml"))

    assert beside == named and "day/cell.toml: robot, noise" in said


def test_options_override_the_cell(folder: Path, kuka: Robot, capsys: pytest.CaptureFixture[str]) -> None:
    """By their names or by --set, lists as a whole; only what was taken is said."""
    count_in_the_opposite_sense(kuka, "joint_4")
    cell('robot = "robot.urdf"\nnoise = "0.05mm"\nsign = ["joint_4"]\n')
    for words in (["--noise", "0.2mm"], ["--set", "noise=0.2mm"]):
        found, said = checked(capsys, "tracker.csv", *words)
        assert found["noise"]["sigma_m"] == pytest.approx(2e-4)
        assert "cell.toml: robot, sign\n" in said or words[0] == "--set"
    count_in_the_opposite_sense(kuka, "joint_5")
    turned, _ = checked(capsys, "tracker.csv", "--sign", "joint_5")
    cell('robot = "robot.urdf"\nnoise = "0.05mm"\nsign = ["joint_5"]\n')
    assert turned == checked(capsys, "tracker.csv")[0]


def test_none_is_no_cell(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """As an option or in the environment; the environment may also name a file."""
    cell('robot = "robot.urdf"\nnoise = "0.05mm"\n')
    assert run("check", "tracker.csv", "--cell", "none") == 2
    told = capsys.readouterr().err
    assert "no cell file is to be used; expected ROBOT.urdf tracker.csv" in " ".join(told.split())
    shutil.move("cell.toml", "other.toml")
    monkeypatch.setenv("PINCAL_CELL", "other.toml")
    assert "other.toml: robot, noise" in checked(capsys, "tracker.csv")[1]
    monkeypatch.setenv("PINCAL_CELL", "none")
    assert run("check", "tracker.csv") == 2


@pytest.mark.parametrize(("gravity", "told"), [((0, 0, 0), "no joint bears a load"), ((0, 0, -1), "in proportion")])
def test_gravity_that_is_nowhere_on_earth_is_said(
    folder: Path, capsys: pytest.CaptureFixture[str], gravity: tuple[int, int, int], told: str
) -> None:
    """It may be meant, as in orbit; a unit vector or zeros to be filled in mostly are not."""
    cell(f'robot = "robot.urdf"\nnoise = "0.05mm"\ngravity = {list(gravity)}\n')
    assert run("check", "tracker.csv") == 0
    said = " ".join(capsys.readouterr().err.split())
    assert "note: gravity 0 0" in said and "nowhere on earth (9.76 to 9.84)" in said and told in said
    cell('robot = "robot.urdf"\nnoise = "0.05mm"\ngravity = [0, 0, -9.8]\n')
    assert run("check", "tracker.csv") == 0
    assert "nowhere on earth" not in capsys.readouterr().err


def test_a_file_of_the_cell_that_is_overridden_may_be_gone(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Only what is taken has to be there."""
    cell('robot = "gone.urdf"\nnoise = "0.05mm"\npoints = "gone.csv"\n')
    assert run("check", "robot.urdf", "tracker.csv") == 3
    assert "cell.toml: points = 'gone.csv'" in capsys.readouterr().err
    assert run("check", "tracker.csv") == 3
    assert "cell.toml: robot = 'gone.urdf': there is no such file; expected one" in capsys.readouterr().err
    cell('robot = "ur99"\n')
    assert run("check", "tracker.csv") == 3
    assert "cell.toml: robot = 'ur99' is neither a file nor a robot" in capsys.readouterr().err
    cell('robot = "gone.urdf"\nnoise = "0.05mm"\n')
    assert checked(capsys, "robot.urdf", "tracker.csv")[0]["noise"]["sigma_m"] == pytest.approx(5e-5)


@pytest.mark.long
def test_another_robot_takes_nothing_of_the_cells_robot(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its signs and its load are not those of the robot on the command line; the instrument is the same."""
    shutil.copy("robot.urdf", "other.urdf")
    cell('robot = "robot.urdf"\nnoise = "0.05mm"\nsign = ["joint_4"]\ntip = "nowhere"\n')
    found, said = checked(capsys, "other.urdf", "tracker.csv")

    assert "cell.toml: noise\n" in said
    assert found == checked(capsys, "other.urdf", "tracker.csv", "--noise", "0.05mm", "--cell", "none")[0]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("nois = '0.05mm'", "cell.toml: unknown key 'nois'; expected one of noise"),
        ("noise = 0.05", "cell.toml: noise: '0.05'; expected a number with a unit"),
        ("tool = [0, 0]", "cell.toml: tool: "),
        ("tool = 1", "cell.toml: tool = '1'; expected a list, such as [0, 0, 0.1]"),
        ("tip = ['a']", "cell.toml: tip = ('a',); expected one value, such as"),
        ("sign = {a = 1}", "cell.toml: sign = {'a': 1}; expected text, a number, or a list"),
        ("[id]\nrobt = '1'", "cell.toml: id.robt: no such entry; expected one of robot"),
        ("id = 3", "cell.toml: id = 3; expected a table [id]"),
        ("robot", "cell.toml: can't be read"),
        ("robot = ''", "cell.toml: robot = ''; expected a URDF or xacro file"),
        ("robot = '.'", "cell.toml: robot = '.'; expected a URDF or xacro file"),
        ("points = 'gone.csv'", "cell.toml: points = 'gone.csv': there is no such file; expected one relative to cell.toml"),
        ("robot = ['a', 'b']", "cell.toml: robot = ['a', 'b']; expected a URDF or xacro file"),
        (f"payload = {'1' * 5000}", "cell.toml: can't be read"),
        ('points = "a\\u0000b"', r"cell.toml: points = 'a\x00b'; expected text without the character NUL"),
    ],
)
def test_what_a_cell_can_not_say_is_refused(text: str, told: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With file, key and what is expected; exit code 3, nothing written."""
    cell(text)
    assert run("calibrate", "robot.urdf", "tracker.csv") == 3
    assert told in capsys.readouterr().err
    assert not (folder / "results").exists()


def test_a_cell_of_windows_is_read(tmp_path: Path) -> None:
    """With a byte order mark and its ends of lines."""
    path = tmp_path / "cell.toml"
    path.write_bytes(b"\xef\xbb\xbf" + b'noise = "0.05mm"\r\ntip = "tool0"\r\n')
    assert CellFile.read(path).entries == {"noise": "0.05mm", "tip": "tool0"}


@pytest.mark.parametrize("words", [["--set", "nois=1mm"], ["--set", "noise"], ["--noise", "1mm", "--set", "noise=2mm"]])
def test_settings_that_are_none_are_refused(words: list[str], folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Exit code 2, with the nearest keys."""
    assert run("check", "robot.urdf", "tracker.csv", *words) == 2
    assert "Invalid value for --set: " in capsys.readouterr().err


@pytest.mark.long
def test_settings_take_any_option_by_its_name(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Single values, several, and vectors."""
    plain = ["--points-in", "base", "--fix", "*.s_x", "--fix", "*.s_y", "--payload-com", "0", "0", "0.1"]
    settings = ["points_in=base", "fix=*.s_x", "fix=*.s_y", "payload-com=0,0,0.1"]
    by_name = [word for text in settings for word in ("--set", text)]

    table = ["robot.urdf", "tracker.csv", "--cell", "none"]
    assert checked(capsys, *table, *plain)[0] == checked(capsys, *table, *by_name)[0]


def test_check_writes_a_cell_of_what_it_was_told_and_suggests_the_short_command(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With comments on all keys; the next command needs the table and what no cell holds; it is not written twice."""
    given = ["--noise", "0.05mm", "--payload-com", "0", "0", ".1", "--loss", "huber", "--set", "id.robot=4711"]
    assert run("check", "robot.urdf", "tracker.csv", *given) == 0
    said = capsys.readouterr().out
    text = Path("cell.toml").read_text()

    assert "pincal calibrate tracker.csv --loss huber\n" in said and "written to cell.toml" in said
    assert {line.lstrip("# ").split(" = ")[0] for line in text.splitlines() if " = " in line} >= {*CELL_KEYS, "operator"}
    found = CellFile.read(Path("cell.toml"))
    assert found.entries == {"robot": "robot.urdf", "payload_com": ("0", "0", "0.1"), "noise": "0.05mm"}
    assert found.identity == {"robot": "4711"}
    assert run("check", "tracker.csv", "--noise", "0.1mm") == 0
    assert Path("cell.toml").read_text() == text
    assert "pincal calibrate tracker.csv --noise 0.1mm\n" in capsys.readouterr().out


def test_check_suggests_the_short_command_where_the_cell_says_the_same(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whoever wrote the cell; with other words than its own the whole command is suggested."""
    cell('robot = "robot.urdf"\nnoise = "0.05mm"\n')
    assert run("check", "robot.urdf", "tracker.csv", "--noise", "0.05mm") == 0
    assert "pincal calibrate tracker.csv\n" in capsys.readouterr().out
    assert run("check", "robot.urdf", "tracker.csv", "--noise", "0.1mm") == 0
    assert "pincal calibrate robot.urdf tracker.csv --noise 0.1mm\n" in capsys.readouterr().out


@pytest.mark.long
def test_known_places_of_a_command_line_stand_in_place_of_those_of_the_cell(
    folder: Path, kuka: Robot, capsys: pytest.CaptureFixture[str]
) -> None:
    """One distance on the command line is all that is known, whatever the cell knows of the sockets."""
    contacts = ["simulate", "robot.urdf", "--sockets", "3", "--poses", "40", "--noise", "0.05mm"]
    assert run(*contacts, "--points-out", "sockets.csv", "--out", "contacts.csv", "--no-floor") == 0
    known = ["--socket-distance", *Path("sockets.csv").read_text().splitlines()[1].split(",")[:1]]
    other = Path("sockets.csv").read_text().splitlines()[2].split(",")[0]
    capsys.readouterr()
    # As simulated, the sockets are 50 mm apart.
    assert run("check", "contacts.csv", *known, other, "50mm", "--json") == 0
    said = capsys.readouterr().err
    assert "cell.toml: " in said and "points" not in said.split("\n")[0]


def test_a_written_cell_is_valid_with_every_comment_removed(tmp_path: Path) -> None:
    """The examples in it can be used as they are."""
    path = tmp_path / "cell.toml"
    write_cell(path, {"robot": "a.urdf"}, {"note.order": "4711"}, by="pincal check")
    lines = [line.removeprefix("# ") if " = " in line else line for line in path.read_text().splitlines()]
    path.write_text("\n".join(line for line in lines if '"..."' not in line))
    found = CellFile.read(path)

    assert found.entries.keys() == CELL_KEYS.keys() and found.identity == {"note.order": "4711"}


def test_simulate_writes_a_cell_and_suggests_what_it_makes_short(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A cell of another machine stays as it is, and is not used for the new table."""
    simulate = ["simulate", "robot.urdf", "--poses", "5", "--out"]
    assert run(*simulate, "a.csv") == 0
    assert "next: pincal check a.csv\n" in capsys.readouterr().out
    text = Path("cell.toml").read_text()
    assert run(*simulate, "b.csv", "--pose-seed", "2") == 0
    assert "next: pincal check b.csv\n" in capsys.readouterr().out
    assert run(*simulate, "c.csv", "--noise", "0.1mm") == 0
    assert "next: pincal check robot.urdf c.csv --noise 0.1mm --cell none\n" in capsys.readouterr().out
    assert Path("cell.toml").read_text() == text
    assert CellFile.read(Path("cell.toml")).entries == {"robot": "robot.urdf", "noise": "0.05mm"}


def test_the_identity_of_the_cell_reaches_the_model_and_guards_it(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It is in model.json and result.json, and the model of another robot is refused; --set replaces an entry."""
    cell('robot = "robot.urdf"\nnoise = "0.05mm"\n[id]\nrobot = "4711"\noperator = "A"\ndate = 2026-11-28\n')
    assert run("calibrate", "tracker.csv", "--set", "id.operator=B", "--model", "geometric", "--quiet") == 0
    for name in ("model.json", "result.json"):
        stated = json.loads(Path("results", name).read_text())["id"]
        assert stated == {"robot": "4711", "operator": "B", "date": "2026-11-28"}
    inputs = json.loads(Path("results/model.json").read_text())["provenance"]["inputs"]
    assert inputs.keys() == {"robot.urdf", "tracker.csv", "cell.toml"}
    cell('[id]\nrobot = "4712"\n')
    assert run("predict", "results/model.json", "tracker.csv", "--out", "p.csv") == 3
    told = capsys.readouterr().err
    assert "4711" in told and "4712" in told and not Path("p.csv").exists()


@pytest.mark.long
def test_a_payload_of_the_cell_is_that_of_rows_without_one(
    folder: Path, kuka: Robot, capsys: pytest.CaptureFixture[str]
) -> None:
    """As if the table had the column; a column that there is stays."""
    columns = columns_of(paper_table(kuka, 40, 0, 5e-5))
    load = columns.pop("payload")
    write_table("bare.csv", columns)
    write_table("loaded.csv", columns | {"payload": 0 * load + 80.0})
    cell('robot = "robot.urdf"\nnoise = "0.05mm"\npayload = 80\n')

    bare, loaded = (checked(capsys, name)[0] for name in ("bare.csv", "loaded.csv"))
    assert bare == loaded
    with_own = checked(capsys, "tracker.csv")[0]
    assert with_own == checked(capsys, "robot.urdf", "tracker.csv", "--noise", "0.05mm", "--cell", "none")[0]


def test_noise_of_images_is_left_alone_by_options_of_lengths(folder: Path) -> None:
    """A cell with a camera serves diagnose as well, whose noise is a length."""
    cell('robot = "robot.urdf"\nnoise = "0.1px"\n')
    assert run("diagnose", "absent.json", "tracker.csv") == 3


def test_every_key_is_an_option_of_calibrate() -> None:
    """A cell file says nothing that could not be said on the command line, nor under another name."""
    known = {key for verb in VERBS.values() for key in verb._cell_keys.values()}

    assert known == CELL_KEYS.keys()
    assert {*VERBS["calibrate"]._cell_keys.values()} == CELL_KEYS.keys()


@pytest.mark.parametrize("name", VERBS)
def test_the_short_help_has_few_options(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """At most fourteen; with ``all`` every one; both end with an example."""
    verb = VERBS[name]
    assert run(*name.split(), "--help") == 0
    short = capsys.readouterr().out
    assert run(*name.split(), "--help", "all") == 0
    whole = capsys.readouterr().out
    options = [each for each in verb.params if isinstance(each, click.Option)]

    assert len(re.findall("^  -", short.partition("Example")[0], re.MULTILINE)) <= MOST_SHOWN
    assert all(f"  {each.opts[0]}" in whole for each in options)
    assert all(field in {each.name for each in options} for field in verb.shown or ())
    assert "Example" in short and "Example" in whole


def test_a_cell_that_is_no_file_is_refused(tmp_path: Path) -> None:
    """From Python, too."""
    with pytest.raises(BadInputError, match=r"can't be read .*expected a cell file in TOML"):
        CellFile.read(tmp_path)


@pytest.mark.parametrize(
    "words",
    [
        ["calibrate", "results/calibrated.urdf", "tracker.csv"],
        ["update", "updated/model.json", "tracker.csv"],
        ["diagnose", "diagnosis/model.json", "tracker.csv"],
    ],
)
def test_a_folder_of_results_that_are_read_is_not_replaced(
    words: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where --out is not given either: the model would be lost to what was made of it."""
    source = Path(words[1])
    source.parent.mkdir()
    source.write_text("read")

    assert run(*words) == 3
    told = " ".join(capsys.readouterr().err.split())
    assert f"--out {source.parent} with {source}: is read by this command" in told
    assert [path.name for path in source.parent.iterdir()] == [source.name] and source.read_text() == "read"


@pytest.mark.long
def test_a_column_sigma_stands_above_the_noise_of_the_cell_in_a_diagnosis(
    folder: Path, kuka: Robot, capsys: pytest.CaptureFixture[str]
) -> None:
    """A noise on the command line stands above both; rows without a column have that of the cell."""
    cell('robot = "robot.urdf"\nnoise = "0.05mm"\n')
    assert run("calibrate", "tracker.csv", "--model", "geometric", "--quiet") == 0
    new = columns_of(paper_table(kuka, 20, 1, 5e-5))
    write_table("bare.csv", new)
    write_table("each.csv", new | {"sigma": np.full(20, 4e-3)})

    def p_value(*words: str) -> float:
        assert run("diagnose", "results/model.json", *words, "--json", "--quiet") in (0, 6)
        capsys.readouterr()
        return float(json.loads(Path("diagnosis/diagnosis.json").read_text())["p_value"])

    cell('noise = "2mm"\n')
    assert p_value("bare.csv") == p_value("bare.csv", "--cell", "none", "--noise", "2mm")
    assert p_value("each.csv") == p_value("each.csv", "--cell", "none") != p_value("each.csv", "--noise", "2mm")
